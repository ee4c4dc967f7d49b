/* SPDX-License-Identifier: Apache-2.0
 *
 * Stops every thread of every process, until none is left that could create another one; and
 * releases them.
 */
#include <errno.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "freeze.h"

#define LOOKS 64
#define LOOK_US 100
#define ENDS_NS (20 * NS_PER_MS)
#define TEND_NS (NS_PER_MS / 2)

/* Whether there are threads of the other kind. */
static bool interrupt(struct tree *tree, bool real_time)
{
	bool others = false;

	for (uint32_t i = 0; i < tree->count; i++)
		if (tree->entry[i].process && tree->entry[i].process->infected)
			others |= process_interrupt(tree->entry[i].process, real_time);
	return others;
}

static int stop_all(struct process *process, struct avc_error *err)
{
	if (process_stop_all(process, err))
		return -1;
	process->stage = FREEZE_STOPPED;
	return 0;
}

/* What `wait` says of each known one; a descendant may have ended. */
static int await(const struct tree *tree, int (*wait)(struct process *, struct avc_error *),
		 struct avc_error *err)
{
	for (uint32_t i = 0; i < tree->count; i++) {
		struct process *process = tree->entry[i].process;
		struct avc_error failed = { 0 };

		if (process && process->infected && wait(process, &failed) &&
		    (!process->descendant || failed.code != AVC_GONE)) {
			*err = failed;
			return -1;
		}
	}
	return 0;
}

/* A child that is killed ends within a moment, which is awaited before anything is stopped: where workers
 * are killed and replaced all the time, one of them is nearly always dying.  One whose core is being
 * written takes longer, and must not write it with our priority: nobody else would get a CPU. */
static int await_dying(struct process *process, uint64_t end, struct avc_error *err)
{
	struct avc_error dies = { 0 };

	if (process_check_dying(process, &dies) == 0)
		return 0;
	if (process->descendant && !proc_is_dumping(process->pid)) {
		process_hasten(process);
		/* A thread of it that we trace, such as the porter that was killed with it, is reaped by
		 * us alone, and until then the process does not end. */
		for (; now_ns() < end; (void)threads_tend_stragglers(process))
			if (pidfd_await_end(process->pidfd, TEND_NS))
				return 0;
		process_hasten_no_more(process);
	}
	*err = dies;
	return -1;
}

int freeze_stop_prepare(struct tree *tree, struct avc_error *err)
{
	const uint64_t end = now_ns() + ENDS_NS;

	for (uint32_t i = 0; i < tree->processes; i++)
		process_stop_begin(tree->process[i]);
	for (uint32_t i = 0; i < tree->processes; i++)
		if (await_dying(tree->process[i], end, err))
			return -1;
	return 0;
}

int freeze_stop_known(struct tree *tree, struct avc_error *err)
{
	/* So that they stop at the same time, and not one after the other. */
	if (interrupt(tree, false)) {
		if (await(tree, process_await, err))
			return -1;
		interrupt(tree, true);
	}
	return await(tree, stop_all, err);
}

/* Those that have ended. */
static uint64_t the_dead(const struct tree *tree)
{
	uint64_t dead = 0;

	for (uint32_t i = 1; i < tree->count; i++)
		if (tree->entry[i].ended || !tree->entry[i].pid)
			dead = hash_bytes(dead, &tree->entry[i].pid, sizeof tree->entry[i].pid);
	return dead;
}

int freeze_stop_others(struct tree *tree, struct avc_error *err)
{
	uint64_t dead = the_dead(tree), dead_before;

	/* It had no other one at the last checkpoint; the clone shows whether that is still so. */
	if (tree->count <= 1 && tree_main(tree)->childless)
		return 0;
	for (int looks = 0; looks < LOOKS; looks++) {
		bool all = true;

		if (tree_scan(tree, err))
			return -1;
		/* One that ended during this look may have left a child to a process whose children had been
		 * listed before: a daemon that has just forked twice. */
		dead_before = dead;
		dead = the_dead(tree);
		all = dead == dead_before;
		for (uint32_t i = 1; i < tree->count; i++) {
			struct process *t = tree->entry[i].process;
			struct avc_error failed = { 0 };

			if (tree->entry[i].ending) {
				all = false;
				usleep(LOOK_US);
			}
			if (!t || t->stage >= FREEZE_STOPPED)
				continue;
			all = false;
			if (!process_check_dying(t, &failed) && !stop_all(t, &failed))
				continue;
			if (failed.code != AVC_GONE) {
				*err = failed;
				return -1;
			}
			usleep(LOOK_US); /* until it is a zombie, or nothing */
		}
		if (all)
			return 0;
	}
	return fail(err, AVC_RETRY, 0, tree_main(tree)->pid, "freeze", "",
		    "its processes come and go too fast");
}
