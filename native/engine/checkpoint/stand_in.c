/* SPDX-License-Identifier: Apache-2.0
 *
 * A restore without a fork, also right after a checkpoint: the template gives its memory away
 * (clone(2), CLONE_VM), as a spare does, and the idle template, which is nearly the same, replaces
 * it.  Pages that differ are read before that, and written when the app runs again.
 */
#include <signal.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "dirty.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
#define PAGES_MAX 16384
#define READ_PAGE_NS 700
#define APPROACH_NS NS_PER_S /* the application is dead: then rather a fork */
/* It runs again, and a generation is worth waiting for a CPU; the daemon kills a guard that is silent
 * for longer (avc_guard_check()). */
#define FINISH_NS (4 * NS_PER_S)

/* It is not worth it if reading the pages that differ takes longer than a fork. */
static bool is_near(const struct dirty *dirty, const struct generation *generation)
{
	const struct idle_template *idle = &dirty->idle;
	const struct image *image = &generation->image[0];
	const uint64_t pages = pageset_count(&idle->differs);

	return idle->pid && idle->near && idle->near == generation->number &&
	       idle->tracker == image->tracker && idle->kinds == image->kinds && image->inherited &&
	       inherited_equal(image->inherited, idle->inherited) && pages <= PAGES_MAX &&
	       pages * READ_PAGE_NS < dirty->fork_ns;
}

bool stand_in_is_there(const struct dirty_tree *dirty, const struct generation *generation)
{
	const struct dirty *one = dirty_find(dirty, generation->image[0].process);

	return one && is_near(one, generation);
}

/* Gives the idle template the mappings of the other one, from which these pages are read. */
static bool approach(struct dirty *dirty, struct template_calls *calls, const struct image *image,
		     const struct pageset *pages)
{
	struct avc_error why = { 0 };

	return layout_read(image->template, &dirty->layout, &dirty->layout_bytes) &&
	       !template_follow_layout(calls, dirty->layout, &why) &&
	       !template_set_break(calls, image->inherited->value[INHERITED_BREAK], &why) &&
	       copy_make_room(dirty, pageset_count(pages) * PAGE) &&
	       copy_read_template(dirty, image->template, pages);
}

bool stand_in_catch_up(struct dirty_tree *tree, const struct generation *generation, timer_t timer)
{
	const struct image *image = &generation->image[0];
	struct dirty *dirty = dirty_find(tree, image->process);
	struct pageset pages = { 0 }, same = { 0 };
	struct template_calls calls;
	struct avc_error why = { 0 };
	bool caught;

	if (!dirty || !dirty->idle.catching_up || !is_near(dirty, generation) ||
	    !dirty->idle.differs.count)
		return false;
	calls = template_calls_begin(&image->process->parasite, &dirty->idle, image->slot);
	tracee_deadline_set(timer, NS_PER_S);
	caught = pageset_take(&dirty->idle.differs, COPY_BATCH_PAGES / 2, &pages) &&
		 pageset_take(dirty->idle.stale, COPY_BATCH_PAGES / 2, &same) &&
		 approach(dirty, &calls, image, &pages) && !copy_write(dirty, &calls, &why);
	tracee_deadline_clear(timer);
	pageset_free(&pages);
	pageset_free(&same);
	/* approach() may have cleared it; the mappings are the generation's now. */
	dirty->idle.near = generation->number;
	if (!caught)
		dirty_drop_idle_one(dirty);
	return caught && dirty->idle.differs.count;
}

static void exchange(struct dirty *dirty, struct generation *generation)
{
	struct image *image = &generation->image[0];
	const struct idle_template *idle = &dirty->idle;

	spare_drop(generation);
	generation->spare.pid = image->template;
	generation->spare.pidfd = image->pidfd;
	generation->spare.base = image->base;
	generation->spare.alone = true;
	image->template = idle->pid;
	image->pidfd = idle->pidfd;
	image->base = idle->base;
	image->forked_ns = idle->forked_ns;
	image->copied = idle->copied;
	image->oom_told = IDLE_OOM_SCORE;
	dirty->standing_in = true;
}

/* Now the other one belongs to the generation. */
static void settle(struct dirty *dirty, struct generation *generation)
{
	struct image *image = &generation->image[0];

	dirty->standing_in = false;
	generation->spare.alone = false;
	free(image->inherited);
	image->inherited = dirty->idle.inherited;
	dirty->idle.inherited = NULL;
	dirty_leave_idle_one(dirty);
	/* The plan is for the other template's memory. */
	restore_plan_free(generation->plan);
	generation->plan = NULL;
}

void stand_in_begin(struct dirty_tree *tree, struct generation *generation, timer_t timer)
{
	struct image *image = &generation->image[0];
	struct dirty *dirty = dirty_find(tree, image->process);
	/* Other processes are forked from it, and compared with it. */
	const bool at_once = generation->images > 1;
	struct template_calls calls;
	struct avc_error why = { 0 };
	bool ready, lent;

	if (!dirty || spare_is_there(generation) || generation->spare.work ||
	    !is_near(dirty, generation) || pidfd_ended(image->pidfd) ||
	    pidfd_ended(dirty->idle.pidfd))
		return;
	calls = template_calls_begin(&image->process->parasite, &dirty->idle, image->slot);
	lent = rt_priority_lend(dirty->idle.pid);
	tracee_deadline_set(timer, APPROACH_NS);
	ready = approach(dirty, &calls, image, &dirty->idle.differs) &&
		(!at_once || !copy_write(dirty, &calls, &why));
	tracee_deadline_clear(timer);
	if (lent)
		rt_priority_reclaim(dirty->idle.pid);
	if (!ready) {
		dirty_drop_idle_one(dirty);
		return;
	}
	exchange(dirty, generation);
	if (at_once)
		settle(dirty, generation);
}

bool stand_in_finish(struct dirty_tree *tree, struct generation *generation, timer_t timer)
{
	struct image *image = &generation->image[0];
	struct dirty *dirty = dirty_find(tree, image->process);
	struct template_calls calls;
	struct avc_error why = { 0 };
	bool whole, lent;

	if (!dirty || !dirty->standing_in)
		return true;
	calls = template_calls_begin(&image->process->parasite, &dirty->idle, image->slot);
	heartbeat();
	lent = rt_priority_lend(dirty->idle.pid);
	tracee_deadline_set(timer, FINISH_NS);
	whole = copy_write(dirty, &calls, &why) == 0;
	tracee_deadline_clear(timer);
	if (lent)
		rt_priority_reclaim(dirty->idle.pid);
	settle(dirty, generation);
	return whole;
}
