/* SPDX-License-Identifier: Apache-2.0
 *
 * Sets of pages: a bitmap for each 2 MB that has any.
 */
#include <stdlib.h>
#include <string.h>

#include "base.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
#define WORD_BITS 64

static avc_remote chunk_of(avc_remote address)
{
	return address & ~(PAGESET_CHUNK - 1);
}

/* The first chunk that does not end before `start`. */
static uint32_t find(const struct pageset *set, avc_remote start)
{
	/* Pages are usually added in order. */
	if (set->count && set->chunk[set->count - 1].start < start)
		return set->count;
	return LOWER_BOUND(set->count, i, set->chunk[i].start < start);
}

static struct page_chunk *chunk_at(struct pageset *set, avc_remote start)
{
	const uint32_t i = find(set, start);

	if (i < set->count && set->chunk[i].start == start)
		return &set->chunk[i];
	if (!make_room(&set->chunk, set->count, &set->room, sizeof *set->chunk))
		return NULL;
	memmove(&set->chunk[i + 1], &set->chunk[i], (set->count - i) * sizeof *set->chunk);
	set->chunk[i] = (struct page_chunk){ .start = start };
	set->count++;
	return &set->chunk[i];
}

static void set_bits(struct page_chunk *chunk, uint32_t from, uint32_t to)
{
	while (from < to) {
		const uint32_t bit = from % WORD_BITS;
		const uint32_t bits = to - from < WORD_BITS - bit ? to - from : WORD_BITS - bit;

		chunk->bits[from / WORD_BITS] |= (~UINT64_C(0) >> (WORD_BITS - bits)) << bit;
		from += bits;
	}
}

bool pageset_add(struct pageset *set, avc_remote start, avc_remote end)
{
	while (start < end) {
		const avc_remote first = chunk_of(start);
		const avc_remote stop = end - first > PAGESET_CHUNK ? first + PAGESET_CHUNK : end;
		struct page_chunk *chunk = chunk_at(set, first);

		if (!chunk)
			return false;
		set_bits(chunk, (uint32_t)((start - first) / PAGE),
			 (uint32_t)((stop - first) / PAGE));
		start = stop;
	}
	return true;
}

bool pageset_add_all(struct pageset *set, const struct pageset *more)
{
	for (uint32_t i = 0; i < more->count; i++) {
		struct page_chunk *chunk = chunk_at(set, more->chunk[i].start);

		if (!chunk)
			return false;
		for (size_t k = 0; k < sizeof chunk->bits / sizeof *chunk->bits; k++)
			chunk->bits[k] |= more->chunk[i].bits[k];
	}
	return true;
}

static bool has(const struct page_chunk *chunk, uint32_t bit)
{
	return chunk->bits[bit / WORD_BITS] >> bit % WORD_BITS & 1;
}

static uint32_t find_bit(const struct page_chunk *chunk, uint32_t bit)
{
	while (bit < PAGESET_PAGES) {
		const uint64_t word = chunk->bits[bit / WORD_BITS] >> bit % WORD_BITS;

		if (word)
			return bit + (uint32_t)__builtin_ctzll(word);
		bit += WORD_BITS - bit % WORD_BITS;
	}
	return PAGESET_PAGES;
}

bool pageset_next(const struct pageset *set, struct page_cursor *at, avc_remote *start,
		  avc_remote *end)
{
	for (; at->chunk < set->count; at->chunk++, at->bit = 0) {
		const struct page_chunk *chunk = &set->chunk[at->chunk];
		const uint32_t first = find_bit(chunk, at->bit);
		uint32_t last = first;

		if (first == PAGESET_PAGES)
			continue;
		while (last < PAGESET_PAGES && has(chunk, last))
			last++;
		at->bit = last;
		*start = chunk->start + first * PAGE;
		*end = chunk->start + last * PAGE;
		return true;
	}
	return false;
}

static uint64_t pages_in(const struct page_chunk *chunk)
{
	uint64_t pages = 0;

	for (size_t k = 0; k < sizeof chunk->bits / sizeof *chunk->bits; k++)
		if (chunk->bits[k]) /* few have any */
			pages += (uint64_t)__builtin_popcountll(chunk->bits[k]);
	return pages;
}

uint64_t pageset_count(const struct pageset *set)
{
	uint64_t pages = 0;

	for (uint32_t i = 0; i < set->count; i++)
		pages += pages_in(&set->chunk[i]);
	return pages;
}

bool pageset_take(struct pageset *from, uint64_t pages, struct pageset *to)
{
	uint32_t first = from->count;
	uint64_t taken = 0;

	while (first && taken < pages)
		taken += pages_in(&from->chunk[--first]);
	if (first == from->count)
		return true;
	to->chunk = calloc(from->count - first, sizeof *to->chunk);
	if (!to->chunk)
		return false;
	to->count = to->room = from->count - first;
	memcpy(to->chunk, &from->chunk[first], to->count * sizeof *to->chunk);
	from->count = first;
	return true;
}

void pageset_free(struct pageset *set)
{
	free(set->chunk);
	*set = (struct pageset){ 0 };
}
