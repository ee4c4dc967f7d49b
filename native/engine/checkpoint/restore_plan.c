/* SPDX-License-Identifier: Apache-2.0
 *
 * What the processes of a generation have in memory of those that will fork them
 * (restore_tree.c): who forks whom, and a plan for each (remap.c).
 *
 * To compare big processes takes longer than to fork them: 50 ns a page, for the kernel
 * looks at each.  Templates do not change, so that it can be done as soon as they are there,
 * while nobody waits for it.  What that may cost is limited; what is left is done when it
 * is needed.
 */
#include <stdlib.h>

#include "checkpoint.h"

/* Fewer pages are compared in no time. */
#define WORTH_PAGES 1024
/* About what it takes to compare a page. */
#define PAGE_NS 60

struct plan_entry {
	int host;                  /* a branch, or PARENT_MAIN                        */
	struct snapshot *snapshot; /* NULL: nobody has asked yet                      */
	struct remap *plan;        /* the same                                        */
};

struct restore_plan {
	struct snapshot *main;
	uint64_t left_ns; /* to be spent ahead                                        */
	uint32_t next;    /* to be looked at ahead                                    */
	uint32_t entries;
	struct plan_entry entry[]; /* by branch                                              */
};

/* Who forks it: its parent; an orphan's is gone, and somebody of its session does. */
static int host_of(const struct generation *generation, const struct branch *branch)
{
	if (branch->parent != PARENT_INIT)
		return branch->parent;
	for (uint32_t i = 0; i < generation->branches && &generation->branch[i] != branch; i++)
		if (generation->branch[i].process &&
		    generation->branch[i].session == branch->session)
			return (int)i;
	return PARENT_MAIN;
}

int restore_plan_begin(struct generation *generation, uint64_t ahead_ns, struct avc_error *err)
{
	struct restore_plan *all;

	if (generation->plan)
		return 0;
	all = calloc(1, sizeof *all + generation->branches * sizeof *all->entry);
	if (!all)
		return fail_errno(err, 0, "restore memory", "calloc", "out of memory");
	all->left_ns = ahead_ns;
	all->entries = generation->branches;
	for (uint32_t i = 0; i < all->entries; i++)
		all->entry[i].host = host_of(generation, &generation->branch[i]);
	generation->plan = all;
	return 0;
}

int restore_plan_host(const struct generation *generation, uint32_t index)
{
	return generation->plan->entry[index].host;
}

static const struct generation *image_of(const struct generation *generation, int branch)
{
	return branch < 0 ? generation : generation->branch[branch].image;
}

static struct snapshot *look_at(const struct generation *generation, int branch,
				struct avc_error *err)
{
	const struct generation *image = image_of(generation, branch);

	return snapshot_new(image->template, image->image, err);
}

static struct snapshot *snapshot_of(struct generation *generation, int branch,
				    struct avc_error *err)
{
	struct restore_plan *all = generation->plan;
	struct snapshot **snapshot = branch < 0 ? &all->main : &all->entry[branch].snapshot;

	if (!*snapshot)
		*snapshot = look_at(generation, branch, err);
	return *snapshot;
}

/* What nobody is to be compared with any more needs no room. */
static void rest(const struct generation *generation, int branch)
{
	struct restore_plan *all = generation->plan;

	for (uint32_t i = 0; i < all->entries; i++)
		if (generation->branch[i].process && !all->entry[i].plan &&
		    (all->entry[i].host == branch || (int)i == branch))
			return;
	snapshot_rest(branch < 0 ? all->main : all->entry[branch].snapshot);
}

const struct remap *restore_plan_of(struct generation *generation, uint32_t index,
				    struct avc_error *err)
{
	struct plan_entry *entry = &generation->plan->entry[index];
	struct snapshot *want, *is;

	if (entry->plan)
		return entry->plan;
	want = snapshot_of(generation, (int)index, err);
	is = want ? snapshot_of(generation, entry->host, err) : NULL;
	if (!is)
		return NULL;
	entry->plan = remap_plan(generation->branch[index].process, want, is, err);
	rest(generation, (int)index);
	rest(generation, entry->host);
	return entry->plan;
}

int restore_plan_check(const struct generation *generation, struct avc_error *err)
{
	int result = 0;

	for (uint32_t i = 0; !result && i < generation->branches; i++) {
		const struct branch *branch = &generation->branch[i];
		const int host = host_of(generation, branch);
		struct snapshot *want, *is;

		/* Few have anything of the kind. */
		if (!branch->process ||
		    (!mem_image_has(branch->image->image, MAPPING_ONLY_HERE) &&
		     !mem_image_has(image_of(generation, host)->image, MAPPING_SEALED)))
			continue;
		want = look_at(generation, (int)i, err);
		is = want ? look_at(generation, host, err) : NULL;
		result = is ? remap_check(branch->process, want, is, err) : -1;
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
		const struct branch *branch = &generation->branch[i];
		const uint64_t pages = branch->image ? (uint64_t)branch->image->anon_pages : 0;
		struct avc_error later = { 0 }; /* the restore will say it */

		if (pages < WORTH_PAGES || pages * PAGE_NS > all->left_ns)
			continue;
		all->left_ns -= pages * PAGE_NS;
		(void)restore_plan_of(generation, i, &later);
		return true;
	}
	snapshot_rest(all->main);
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
		snapshot_free(all->main);
	free(all);
}
