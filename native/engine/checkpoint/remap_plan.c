/* SPDX-License-Identifier: Apache-2.0
 *
 * How the memory of a process differs from that of the one that will fork it.
 *
 * Where both have the same mapping at the same address it stays, and with it the pages that they
 * share: those with equal page frames (pagemap, Documentation/admin-guide/mm/pagemap.rst).
 * Everything else is unmapped, mapped, and copied (restore/remap.c).  The difference is found in
 * the templates of both, before the process exists.
 */
#include <stdlib.h>
#include <string.h>

#include "remap.h"

/* ---- mappings ------------------------------------------------------------------- */

static bool is_stack(const struct mapping *m)
{
	return !strcmp(m->name, "[stack]");
}

/* By which it was mapped. */
uint32_t mapping_kind(const struct mapping *m)
{
	return (m->flags & (MAPPING_DROPPABLE | MAPPING_GROWING)) |
	       (is_stack(m) ? MAPPING_GROWING : 0);
}

static bool same_backing(const struct mapping *a, const struct mapping *b)
{
	return a->shared == b->shared && is_stack(a) == is_stack(b) && a->inode == b->inode &&
	       mapping_is_special(a) == mapping_is_special(b) &&
	       mapping_kind(a) == mapping_kind(b) &&
	       (!mapping_is_file(a) ||
		(a->offset - a->start == b->offset - b->start && !strcmp(a->name, b->name)));
}

/* The range of our parasite is not touched, and what the kernel maps is moved there by itself. */
static bool is_fixed(const struct remap *r, const struct mapping *wanted, avc_remote address)
{
	return (wanted && mapping_is_special(wanted)) ||
	       parasite_contains(&r->process->parasite, address);
}

static const struct mapping *at(const struct mappings *maps, uint32_t *next, avc_remote address)
{
	while (*next < maps->count && maps->map[*next].end <= address)
		++*next;
	return *next < maps->count && maps->map[*next].start <= address ? &maps->map[*next] : NULL;
}

static avc_remote boundary(const struct mappings *maps, uint32_t next, avc_remote address)
{
	if (next == maps->count)
		return UINT64_MAX;
	return maps->map[next].start > address ? maps->map[next].start : maps->map[next].end;
}

/* Merges both lists. */
static int cut(struct remap *r, struct avc_error *err)
{
	const struct mappings *is_maps = &r->is->maps, *want_maps = &r->want->maps;
	avc_remote address = 0;
	uint32_t is = 0, want = 0;

	r->piece = calloc(2 * (is_maps->count + want_maps->count) + 2, sizeof *r->piece);
	if (!r->piece)
		return fail_memory(err, 0, "restore memory");
	for (;;) {
		const struct mapping *a = at(is_maps, &is, address);
		const struct mapping *b = at(want_maps, &want, address);
		const avc_remote x = boundary(is_maps, is, address);
		const avc_remote y = boundary(want_maps, want, address);
		const avc_remote end = x < y ? x : y;

		if (end == UINT64_MAX)
			return 0;
		/* The parent's vDSO has been moved away when anything is mapped in its place. */
		if (a && mapping_is_special(a))
			a = NULL;
		if (is_fixed(r, b, address))
			a = b = NULL;
		if (a || b)
			r->piece[r->pieces++] = (struct piece){
				.start = address,
				.end = end,
				.is = a,
				.want = b,
				.kept = a && b && same_backing(a, b),
			};
		address = end;
	}
}

bool mapping_same_protection(const struct mapping *a, const struct mapping *b)
{
	return mapping_protection(a) == mapping_protection(b) && mapping_key(a) == mapping_key(b);
}

const struct mapping *mappings_find(const struct mappings *maps, const char *name)
{
	for (uint32_t i = 0; i < maps->count; i++)
		if (!strcmp(maps->map[i].name, name))
			return &maps->map[i];
	return NULL;
}

/* ---- pages -------------------------------------------------------------------------- */

/* Of a private mapping.  Pages of a file need no copy. */
static enum page compare(uint64_t want, uint64_t is)
{
	if (page_is_guard(want))
		return page_is_guard(is) ? PAGE_SAME : PAGE_GUARD;
	if (page_is_guard(is))
		return page_is_own(want) ? PAGE_OPEN_COPY : PAGE_OPEN;
	if (!page_is_own(want))
		return page_is_own(is) ? PAGE_DROP : PAGE_SAME;
	if (page_is_own(is) && want & PAGEMAP_FRAME &&
	    !((want ^ is) & (PAGEMAP_FRAME | PAGEMAP_PRESENT | PAGEMAP_SWAPPED)))
		return PAGE_SAME;
	return PAGE_COPY;
}

static int add_run(struct remap *r, const struct mapping *m, enum page what, avc_remote start,
		   avc_remote end, struct avc_error *err)
{
	const bool plain = m->mode[0] == 'r' && m->mode[1] == 'w';
	struct run *last = r->runs ? &r->run[r->runs - 1] : NULL;

	if (last && last->what == what && last->end == start && last->plain == plain) {
		last->end = end;
		return 0;
	}
	if (!make_room(&r->run, r->runs, &r->room, sizeof *r->run))
		return fail_memory(err, 0, "restore memory");
	r->run[r->runs++] = (struct run){ start, end, what, plain };
	return 0;
}

static int compare_piece(struct remap *r, const struct piece *piece, struct avc_error *err)
{
	static const struct pages nothing;
	const struct pages *wanted = snapshot_pages(r->want, piece->want, err);
	const struct pages *had = piece->kept ? snapshot_pages(r->is, piece->is, err) : &nothing;
	uint32_t next_wanted = 0, next_had = 0;

	if (!wanted || !had)
		return -1;
	for (avc_remote start = piece->start, end; start < piece->end; start = end) {
		const uint64_t *want, *is;

		end = piece->end;
		want = pages_frames(wanted, &next_wanted, start, &end);
		is = pages_frames(had, &next_had, start, &end);
		if (!want && !is)
			continue;
		for (size_t i = 0, count = (end - start) / PAGE; i < count; i++) {
			const avc_remote page = start + i * PAGE;
			const enum page what = compare(want ? want[i] : 0, is ? is[i] : 0);

			if (what != PAGE_SAME &&
			    add_run(r, piece->want, what, page, page + PAGE, err))
				return -1;
		}
	}
	return 0;
}

/* ---- all of it ----------------------------------------------------------------------- */

struct remap *remap_plan(const struct process *process, struct snapshot *want, struct snapshot *is,
			 struct avc_error *err)
{
	struct remap *r = calloc(1, sizeof *r);

	if (!r) {
		fail_memory(err, 0, "restore memory");
		return NULL;
	}
	*r = (struct remap){ .process = process, .want = want, .is = is };
	if (cut(r, err))
		goto failed;
	for (uint32_t i = 0; i < r->pieces; i++) {
		const struct piece *piece = &r->piece[i];

		if (piece->want && !piece->want->shared && compare_piece(r, piece, err))
			goto failed;
	}
	return r;
failed:
	remap_free(r);
	return NULL;
}

/* mseal(2): it cannot be unmapped or protected differently, not even in a fork. */
static bool is_stuck(const struct piece *piece)
{
	return piece->is && piece->is->flags & MAPPING_SEALED &&
	       (!piece->kept || !mapping_same_protection(piece->is, piece->want));
}

static bool is_lost(const struct piece *piece)
{
	return piece->want && piece->want->flags & MAPPING_ONLY_HERE && !piece->kept;
}

int remap_check(const struct process *process, struct snapshot *want, struct snapshot *is,
		struct avc_error *err)
{
	struct remap r = { .process = process, .want = want, .is = is };
	const struct mapping *a = mappings_find(&is->maps, "[vdso]");
	const struct mapping *b = mappings_find(&want->maps, "[vdso]");
	int result = cut(&r, err);

	if (!result && a && b && a->flags & MAPPING_SEALED && a->start != b->start)
		result = fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
			      "process %d has executed another program, and the kernel seals its "
			      "vDSO (mseal(2))",
			      process->inside);
	if (!result && b && !a)
		result = fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
			      "process %d has a vDSO, and its parent has unmapped its own",
			      process->inside);
	for (uint32_t i = 0; !result && i < r.pieces; i++) {
		if (is_lost(&r.piece[i]))
			result = fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
				      "process %d has mapped what no other process can map: %s",
				      process->inside, r.piece[i].want->name);
		else if (is_stuck(&r.piece[i]))
			result = fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
				      "process %d has other memory than its parent where that has "
				      "sealed it (mseal(2))",
				      process->inside);
	}
	free(r.piece);
	return result;
}

void remap_free(struct remap *r)
{
	if (!r)
		return;
	free(r->piece);
	free(r->run);
	free(r);
}
