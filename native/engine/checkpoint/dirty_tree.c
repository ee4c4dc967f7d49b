/* SPDX-License-Identifier: Apache-2.0
 *
 * Checkpoints by copies of all processes of an app.  Whether to copy or fork is decided for each:
 * one may write too much, another be new.
 */
#include <stdlib.h>

#include "dirty.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)

struct dirty *dirty_find(const struct dirty_tree *tree, const struct process *process)
{
	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->of[i]->process == process)
			return tree->of[i];
	return NULL;
}

static void drop(struct dirty_tree *tree, uint32_t i)
{
	struct process *process = tree->of[i]->process;

	dirty_free_one(tree->of[i]);
	tracker_end(process);
	tree->of[i] = tree->of[--tree->count];
	if (process->descendant)
		process->images--;
}

void dirty_forget(struct dirty_tree *tree, const struct process *process)
{
	for (uint32_t i = tree->count; i-- > 0;)
		if (tree->of[i]->process == process)
			drop(tree, i);
}

/* Processes that have ended, or been restored, which makes them new ones. */
static void forget_ended(struct dirty_tree *tree)
{
	for (uint32_t i = tree->count; i-- > 0;) {
		const struct dirty *dirty = tree->of[i];

		if (dirty->process->leader != dirty->leader ||
		    dirty->process->start != dirty->start)
			drop(tree, i);
	}
}

/* process->images keeps the process from being freed. */
static struct dirty *get(struct dirty_tree *tree, struct process *process)
{
	struct dirty *dirty = dirty_find(tree, process);

	if (dirty)
		return dirty;
	if (!make_room(&tree->of, tree->count, &tree->room, sizeof(struct dirty *)))
		return NULL;
	dirty = calloc(1, sizeof *dirty);
	if (!dirty)
		return NULL;
	dirty->process = process;
	dirty->leader = process->leader;
	dirty->start = process->start;
	dirty->idle.pidfd = -1;
	if (process->descendant)
		process->images++;
	return tree->of[tree->count++] = dirty;
}

/* Rounds need a large buffer, one process at a time: they share one. */
static void swap_batch(struct dirty_tree *tree, struct dirty *dirty)
{
	uint8_t *data = tree->batch;
	const size_t bytes = tree->batch_bytes;

	tree->batch = dirty->data;
	tree->batch_bytes = dirty->data_bytes;
	dirty->data = data;
	dirty->data_bytes = bytes;
}

/* ---- one checkpoint ------------------------------------------------------------------------------ */

/* The first reason found; the main process comes first. */
static void sum_up(struct dirty_tree *tree, const struct dirty *dirty)
{
	if (!tree->reason)
		tree->reason = dirty->reason;
}

void dirty_prepare(struct dirty_tree *dirty, const struct tree *tree,
		   const struct avc_config *config, enum avc_fork_reason fork, uint32_t slot,
		   timer_t timer)
{
	forget_ended(dirty);
	dirty->reason = AVC_FORK_NONE;
	dirty->copied = 0;
	for (uint32_t i = 0; i < tree->count; i++) {
		struct process *process = tree->entry[i].process;
		const struct attempt attempt = { config, process, fork, slot, timer };
		struct dirty *one = process ? get(dirty, process) : NULL;

		if (process)
			process->recycling = 0;
		if (!one) {
			if (process)
				dirty->reason = AVC_FORK_FIRST;
			continue;
		}
		heartbeat();
		swap_batch(dirty, one);
		dirty_prepare_one(one, &attempt);
		swap_batch(dirty, one);
		if (process->recycling && !copy_make_room(one, one->wanted)) {
			process->recycling = 0;
			one->reason = AVC_FORK_FIRST;
		}
		sum_up(dirty, one);
	}
}

int dirty_capture(struct dirty_tree *dirty, const struct generation *generation,
		  struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->images; i++) {
		const struct image *image = &generation->image[i];

		if (image->process && image->process->recycling &&
		    dirty_capture_one(dirty_find(dirty, image->process), image, err))
			return -1;
	}
	return 0;
}

int dirty_apply(struct dirty_tree *dirty, struct generation *generation, struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->images; i++) {
		struct image *image = &generation->image[i];
		struct dirty *one = image->process && image->process->recycling
					    ? dirty_find(dirty, image->process)
					    : NULL;

		if (!one)
			continue;
		heartbeat();
		if (dirty_apply_one(one, image, err))
			return -1;
		dirty->copied += one->copied;
	}
	return 0;
}

int dirty_check(struct dirty_tree *dirty, const struct generation *generation,
		struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->images; i++) {
		const struct image *image = &generation->image[i];

		if (image->recycled &&
		    dirty_check_one(dirty_find(dirty, image->process), image, err))
			return -1;
	}
	return 0;
}

/* ---- templates ----------------------------------------------------------------------------------- */

void dirty_follow(struct dirty_tree *dirty, const struct generation *generation)
{
	for (uint32_t i = 0; i < generation->images; i++) {
		struct image *image = &generation->image[i];
		struct dirty *one = image->process ? dirty_find(dirty, image->process) : NULL;

		if (one)
			dirty_follow_one(one, image);
	}
}

void dirty_recycle(struct dirty_tree *dirty, const struct generation *generation)
{
	if (generation->spare.work)
		return;
	for (uint32_t i = 0; i < generation->images; i++) {
		struct image *image = &generation->image[i];
		struct dirty *one = image->process ? dirty_find(dirty, image->process) : NULL;

		if (one)
			dirty_recycle_one(one, image);
	}
}

/* The main process's. */
static struct dirty *of_main(const struct dirty_tree *dirty, const struct generation *generation)
{
	return dirty_find(dirty, generation->image[0].process);
}

void dirty_take_spare(struct dirty_tree *dirty, struct generation *generation)
{
	struct dirty *one = of_main(dirty, generation);

	if (one)
		dirty_take_spare_one(one, generation);
}

void dirty_drop_stale(struct dirty_tree *dirty, struct generation *generation)
{
	struct dirty *one = of_main(dirty, generation);

	if (one && dirty_is_stale_one(one) && !generation->spare.work && spare_is_there(generation))
		dirty_drop_idle_one(one);
}

bool dirty_wants_spare(const struct dirty_tree *dirty, const struct generation *generation)
{
	struct dirty *one = of_main(dirty, generation);

	return one && dirty_wants_spare_one(one, &generation->image[0]);
}

void dirty_compare(struct dirty_tree *dirty, const struct generation *generation)
{
	struct dirty *one = of_main(dirty, generation);

	if (one)
		dirty_compare_one(one, &generation->image[0], generation->number);
}

void dirty_drop_idle(struct dirty_tree *dirty)
{
	for (uint32_t i = 0; i < dirty->count; i++)
		dirty_drop_idle_one(dirty->of[i]);
}

void dirty_drop_ended(struct dirty_tree *dirty)
{
	for (uint32_t i = 0; i < dirty->count; i++)
		if (dirty->of[i]->idle.pid && pidfd_ended(dirty->of[i]->idle.pidfd))
			dirty_drop_idle_one(dirty->of[i]);
}

bool dirty_owns(const struct dirty_tree *dirty, pid_t pid)
{
	for (uint32_t i = 0; i < dirty->count; i++)
		if (dirty->of[i]->idle.pid == pid)
			return true;
	return false;
}

void dirty_free(struct dirty_tree *dirty)
{
	while (dirty->count)
		drop(dirty, dirty->count - 1);
	free(dirty->of);
	free(dirty->batch);
	*dirty = (struct dirty_tree){ 0 };
}
