/* SPDX-License-Identifier: Apache-2.0
 *
 * How the processes of a generation are made from those that will fork them (restore_tree.c): which
 * forks which, and a memory plan for each (remap.c).
 *
 * Comparing processes takes longer than forking them: 0.4 ms, and 50 ns a page, because the kernel
 * walks each.  Templates do not change, so it can be done as soon as they exist, while nothing waits
 * for it.  Its cost is limited; the rest is done when it is needed.
 */
#include <stdlib.h>

#include "checkpoint.h"

/* The approximate time to compare a process, and each of its pages. */
#define PROCESS_NS (400 * NS_PER_MS / 1000)
#define PAGE_NS 60

/* Of one image. */
struct plan_entry {
	struct snapshot *snapshot; /* NULL: not needed yet */
	struct remap *plan;        /* the same                                        */
};

struct restore_plan {
	uint64_t left_ns; /* to be spent ahead                                        */
	uint32_t next;    /* next one to be planned ahead */
	uint32_t entries;
	struct place *place;       /* by image                                        */
	struct plan_entry entry[]; /* by image                                       */
};

int restore_plan_begin(struct generation *generation, uint64_t ahead_ns, struct avc_error *err)
{
	struct restore_plan *all;

	if (generation->plan)
		return 0;
	all = calloc(1, sizeof *all + generation->images * sizeof *all->entry);
	if (!all)
		return fail_memory(err, 0, "restore memory");
	all->left_ns = ahead_ns;
	all->next = 1;
	all->entries = generation->images;
	all->place = calloc(generation->images, sizeof *all->place);
	if (!all->place || places_find(generation, all->place, err)) {
		if (!all->place)
			fail_memory(err, 0, "restore memory");
		free(all->place);
		free(all);
		return -1;
	}
	generation->plan = all;
	return 0;
}

const struct place *restore_plan_place(const struct generation *generation, uint32_t index)
{
	return &generation->plan->place[index];
}

static struct snapshot *look_at(const struct image *image, struct avc_error *err)
{
	return snapshot_new(image->template, image->memory, err);
}

static struct snapshot *snapshot_of(struct generation *generation, uint32_t index,
				    struct avc_error *err)
{
	struct snapshot **snapshot = &generation->plan->entry[index].snapshot;

	if (!*snapshot)
		*snapshot = look_at(&generation->image[index], err);
	return *snapshot;
}

/* Frees what is no longer needed for a comparison. */
static void rest(const struct generation *generation, uint32_t index)
{
	struct restore_plan *all = generation->plan;

	for (uint32_t i = 1; i < all->entries; i++)
		if (generation->image[i].process && !all->entry[i].plan &&
		    (all->place[i].memory == index || i == index))
			return;
	snapshot_rest(all->entry[index].snapshot);
}

const struct remap *restore_plan_of(struct generation *generation, uint32_t index,
				    struct avc_error *err)
{
	struct plan_entry *entry = &generation->plan->entry[index];
	const uint32_t host = generation->plan->place[index].memory;
	struct snapshot *want, *is;

	if (entry->plan)
		return entry->plan;
	want = snapshot_of(generation, index, err);
	is = want ? snapshot_of(generation, host, err) : NULL;
	if (!is)
		return NULL;
	entry->plan = remap_plan(generation->image[index].process, want, is, err);
	rest(generation, index);
	rest(generation, host);
	return entry->plan;
}

int restore_plan_check(const struct generation *generation, struct avc_error *err)
{
	struct place place[PROCESSES_MAX];
	int result = places_find(generation, place, err);

	for (uint32_t i = 1; !result && i < generation->images; i++) {
		struct image *image = &generation->image[i];

		image->host = place[i].memory;
		/* Shared with that one, and not with a keeper that begins a session again. */
		if (image->shared &&
		    (image->host != (image->parent < 0 ? 0 : (uint32_t)image->parent) ||
		     place[i].renewed))
			result = fail(err, AVC_UNSUPPORTED, 0, image->pid, "check", "",
				      "process %d shares its descriptor table, or directories, "
				      "with one that could not fork it in its session",
				      image->inside);
	}
	for (uint32_t i = 1; !result && i < generation->images; i++) {
		const struct image *image = &generation->image[i];
		const struct image *host = &generation->image[place[i].memory];
		struct snapshot *want, *is;

		/* Few have any. */
		if (!image->process ||
		    (!mem_image_has(image->memory, MAPPING_ONLY_HERE) &&
		     !mem_image_has(host->memory, MAPPING_SEALED) &&
		     (!mem_image_is_special(image->memory) || mem_image_is_special(host->memory))))
			continue;
		want = look_at(image, err);
		is = want ? look_at(host, err) : NULL;
		result = is ? remap_check(image->process, want, is, err) : -1;
		snapshot_free(want);
		snapshot_free(is);
	}
	return result;
}

bool restore_plan_next(struct generation *generation)
{
	struct restore_plan *all = generation->plan;

	if (!all)
		return false;
	while (all->next < all->entries) {
		const uint32_t i = all->next++;
		const struct image *image = &generation->image[i];
		const uint64_t takes_ns = PROCESS_NS + (uint64_t)image->anon_pages * PAGE_NS;
		struct avc_error later = { 0 }; /* the restore will report it */

		if (!image->process || takes_ns > all->left_ns)
			continue;
		all->left_ns -= takes_ns;
		(void)restore_plan_of(generation, i, &later);
		return true;
	}
	for (uint32_t i = 0; i < all->entries; i++)
		snapshot_rest(all->entry[i].snapshot);
	return false;
}

void restore_plan_free(struct restore_plan *all)
{
	for (uint32_t i = 0; all && i < all->entries; i++) {
		remap_free(all->entry[i].plan);
		snapshot_free(all->entry[i].snapshot);
	}
	if (all)
		free(all->place);
	free(all);
}
