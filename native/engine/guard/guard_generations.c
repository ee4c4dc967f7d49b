/* SPDX-License-Identifier: Apache-2.0
 *
 * Which generations are held, and what ends them.
 */
#include <poll.h>
#include <string.h>
#include <sys/wait.h>
#include <unistd.h>

#include "guard.h"

#define CONTAINER_END_MS 20
#define CONTAINER_ENDS_MS 1000
#define LATE_SPARE_NS (1 * NS_PER_MS)
#define ENDED_NS (50 * NS_PER_MS)
#define ENDED_STEP_US 200

/* ---- generations ------------------------------------------------------------ */

void guard_drop_generation(struct avc_guard *guard, uint32_t i)
{
	/* Disarmed first: init then takes a death in between as final. */
	if (guard->count == 1 && guard->channel.ctl)
		init_channel_arm(&guard->channel, false);
	guard->main.lost |= spare_is_unknown(&guard->generations[i]);
	generation_drop(&guard->generations[i]);
	guard->count--;
	memmove(&guard->generations[i], &guard->generations[i + 1],
		(guard->count - i) * sizeof *guard->generations);
	policy_drop(&guard->policy, i);
	guard_rank_generations(guard);
}

void guard_drop_all(struct avc_guard *guard)
{
	while (guard->count)
		guard_drop_generation(guard, 0);
	dirty_drop_idle(&guard->dirty);
}

int guard_find_generation(const struct avc_guard *guard, uint64_t number)
{
	for (uint32_t i = guard->count; i-- > 0;)
		if (guard->generations[i].number == number)
			return (int)i;
	return -1;
}

void guard_drop_newer(struct avc_guard *guard, uint64_t number)
{
	while (guard->count && guard->generations[guard->count - 1].number > number)
		guard_drop_generation(guard, guard->count - 1);
}

uint32_t guard_free_slot(const struct avc_guard *guard)
{
	for (uint32_t slot = 0;; slot++) {
		bool used = false;

		for (uint32_t i = 0; i < guard->count; i++)
			used |= guard->generations[i].image[0].slot == slot;
		if (!used)
			return slot;
	}
}

/* Dropped early; the caller emits the event. */
static struct avc_event lost_generation(struct avc_guard *guard, uint32_t i, enum avc_reason reason)
{
	const struct policy_generation lost = guard->policy.held[i];
	const uint64_t taken_ns = guard->generations[i].taken_ns;
	struct avc_event event;

	guard_drop_generation(guard, i);
	event = guard_event(guard, AVC_EVENT_DROPPED);
	event.reason = reason;
	event.generation = lost.number;
	event.age_ns = event.at_ns - taken_ns;
	event.attempt = lost.crashes > lost.lost ? lost.crashes : lost.lost;
	return event;
}

void guard_lose_generation(struct avc_guard *guard, uint32_t i, enum avc_reason reason,
			   uint64_t ticket)
{
	struct avc_event event = lost_generation(guard, i, reason);

	event.ticket = ticket;
	guard_emit(guard, &event);
}

bool guard_owns(pid_t pid, const void *arg)
{
	const struct avc_guard *guard = arg;

	if (tracee_is_ending(pid) || dirty_owns(&guard->dirty, pid))
		return true;
	for (uint32_t i = 0; i < guard->remains_count; i++)
		if (guard->remains[i].pid == pid)
			return true;
	for (uint32_t i = 0; i < guard->tree.processes; i++)
		if (guard->tree.process[i]->holder == pid)
			return true;
	for (uint32_t i = 0; i < guard->count; i++) {
		const struct generation *generation = &guard->generations[i];

		if (generation->spare.pid == pid)
			return true;
		for (uint32_t k = 0; k < generation->images; k++)
			if (generation->image[k].template == pid)
				return true;
	}
	return init_channel_listens(&guard->channel, pid);
}

/* Ours, or a process of the app. */
static bool knows_process(pid_t pid, const void *arg)
{
	const struct avc_guard *guard = arg;

	for (uint32_t i = 0; i < guard->tree.processes; i++)
		if (guard->tree.process[i]->leader == pid)
			return true;
	return guard_owns(pid, guard);
}

void guard_wait_ended(struct avc_guard *guard)
{
	const uint64_t end = tracee_deadline(ENDED_NS);
	bool lent;

	tracee_end_now();
	while (tracee_reap_ending() && tracee_has_time(end))
		usleep(ENDED_STEP_US);
	/* On a busy machine it would not get to it in time. */
	lent = rt_priority_lend(guard->channel.init);
	while (init_channel_has_zombies(&guard->channel) && tracee_has_time(end)) {
		/* It cannot reap one of ours before we have. */
		(void)guard_tend_stragglers(guard);
		guard_reap_unknown(guard);
		usleep(ENDED_STEP_US);
	}
	if (lent)
		rt_priority_reclaim(guard->channel.init);
}

/* Collects late spares (spare_make) that have been made by now. */
void guard_await_spares(struct avc_guard *guard)
{
	for (uint32_t i = 0; i < guard->count; i++) {
		struct avc_error late = { 0 };

		if (!guard->generations[i].spare.work)
			continue;
		tracee_deadline_set(guard->timer, LATE_SPARE_NS);
		/* AVC_DEADLINE: still under way; guard_reap_dead() handles one that was killed. */
		if (spare_await(&guard->generations[i], &late))
			guard->main.lost |= late.code != AVC_DEADLINE;
		tracee_deadline_clear(guard->timer);
	}
}

static bool has_thread(const struct process *process, pid_t tid)
{
	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].tid == tid && process->threads[i].attached)
			return true;
	return false;
}

static bool is_known(pid_t tid, const void *arg)
{
	const struct avc_guard *guard = arg;

	if (guard_owns(tid, guard))
		return true;
	for (uint32_t i = 0; i < guard->tree.processes; i++)
		if (has_thread(guard->tree.process[i], tid))
			return true;
	return false;
}

bool guard_knows_tracee(pid_t tid, const void *arg)
{
	const struct avc_guard *guard = arg;

	return is_known(tid, guard) || tree_has_parasite(&guard->tree, tracee_pc(tid));
}

/* One that is not in a parasite belongs to the app (CLONE_PARENT, CLONE_PTRACE), or ends by itself
 * (holder.c); it is released. */
static bool is_not_lost(pid_t pid, const void *arg)
{
	const struct avc_guard *guard = arg;

	return knows_process(pid, guard) || is_known(pid, guard) || !tracee_is_ours(pid) ||
	       !tree_has_parasite(&guard->tree, tracee_pc(pid));
}

void guard_kill_lost(struct avc_guard *guard)
{
	guard_await_spares(guard);
	init_channel_kill_lost(&guard->channel, is_not_lost, guard);
	tracee_release_strangers();
	for (uint32_t i = 0; i < guard->tree.processes; i++)
		guard->tree.process[i]->lost = false;
}

/* Also one that has been made since the last checkpoint, and whose parent has ended. */
static bool shares_table(const struct avc_guard *guard, pid_t template)
{
	pid_t children[CHILDREN_MAX];
	const int count = proc_children(guard->channel.init, children, CHILDREN_MAX);

	for (uint32_t i = 0; i < guard->tree.processes; i++)
		if (guard->tree.process[i]->pid &&
		    proc_shares(template, guard->tree.process[i]->pid, SHARED_FILES) == 1)
			return true;
	for (int i = 0; i < count; i++)
		if (proc_shares(template, children[i], SHARED_FILES) == 1 &&
		    !guard_owns(children[i], guard))
			return true;
	return false;
}

void guard_release(struct avc_guard *guard, struct process *process)
{
	for (uint32_t i = 0; i < guard->count; i++) {
		const struct image *image = generation_image(&guard->generations[i], process);

		if (image)
			generation_close_files(image, shares_table(guard, image->template));
	}
	dirty_forget(&guard->dirty, process);
	tree_let_go(process);
}

#define EXEC_CHECK_NS (1 * NS_PER_MS)
#define EXEC_CHECK_LONG_NS (200 * NS_PER_MS)
#define TABLES_NS (100 * NS_PER_MS)

static bool found_executed(struct process *process, uint64_t now)
{
	uint64_t pause = (now - process->held_ns) / 8;

	if (pause < EXEC_CHECK_NS)
		pause = EXEC_CHECK_NS;
	if (pause > EXEC_CHECK_LONG_NS)
		pause = EXEC_CHECK_LONG_NS;
	/* Its end was reported, and is dealt with elsewhere. */
	if (process->exec_sign.over && pidfd_ended(process->pidfd)) {
		process->exec_check_ns = UINT64_MAX;
		return false;
	}
	/* First, so that no exec between the two is missed. */
	process->exec_check_ns = process_listen_for_exec(process) ? UINT64_MAX : now + pause;
	return process_has_executed(process);
}

/* Whether it has something of ours that has to go after an exec.  One that was refused has no holder
 * any more, but is infected. */
static bool has_ours(const struct process *process)
{
	return process->pid && (process->infected || process->holder);
}

/* What was saved of the main process, with the descriptors that it has left behind. */
static void lose_images(struct avc_guard *guard, enum avc_reason reason)
{
	while (guard->count)
		guard_lose_generation(guard, 0, reason, 0);
	dirty_drop_idle(&guard->dirty);
	guard_release_oldest_remains(guard, 0);
	tracee_end_now(); /* they have the descriptors from before */
	process_unhold(&guard->main);
}

/* The main process runs another program: everything saved is of the old one. */
static void lose_program(struct avc_guard *guard)
{
	tracker_end(&guard->main);
	lose_images(guard, AVC_REASON_EXECUTED);
	policy_roomier(&guard->policy);
	guard->main.infected = false; /* the parasite went with its memory */
}

/* unshare(2) and close_range(2) (CLOSE_RANGE_UNSHARE) leave a table to whoever shares it, and change
 * nothing where nobody does: what the process closes from then on would stay open in its holder and
 * templates.  A task that is exiting has none, and one whose core is being written has one of its own
 * (fs/coredump.c, do_coredump()). */
static bool has_left_holder(const struct process *process)
{
	return process->pid && process->holder &&
	       proc_shares(process->pid, process->holder, SHARED_FILES) == 0 &&
	       !proc_is_exiting(process->pid) && !pidfd_ended(process->pidfd) &&
	       !proc_is_dying(process->stat_fd) && !proc_is_exiting(process->holder);
}

/* A process that executes another program closes its O_CLOEXEC descriptors, and another process may
 * be waiting for just that.  Where the kernel does not report it, we poll: often at first, because
 * most do it at once if at all. */
bool guard_let_executed_go(struct avc_guard *guard, bool all)
{
	const uint64_t now = now_ns();
	const bool tables = all || now - guard->tables_ns > TABLES_NS;
	bool any = false;

	if (tables)
		guard->tables_ns = now;
	for (uint32_t i = 0; i < guard->tree.processes; i++) {
		struct process *process = guard->tree.process[i];
		/* The kernel does not report it. */
		const bool left = tables && has_left_holder(process);
		/* Which is a way to leave its table, too. */
		const bool executed = has_ours(process) &&
				      (all || left || now >= process->exec_check_ns) &&
				      found_executed(process, now);

		if (!left && !executed)
			continue;
		any = true;
		if (process->descendant)
			guard_release(guard, process);
		else if (executed)
			lose_program(guard);
		else
			lose_images(guard, AVC_REASON_UNSHARED);
	}
	return any;
}

void guard_hear_exec(struct avc_guard *guard, int fd)
{
	for (uint32_t i = 0; i < guard->tree.processes; i++) {
		struct process *process = guard->tree.process[i];

		if (process->exec_sign.fd != fd)
			continue;
		process->exec_sign.over = true; /* it reports only one */
		process->exec_check_ns = 0;
		if (!process->descendant)
			guard->next_ns = policy_executed(&guard->policy, &guard->config,
							 guard->next_ns, now_ns());
	}
}

uint64_t guard_exec_check_due(const struct avc_guard *guard)
{
	uint64_t due = UINT64_MAX;

	for (uint32_t i = 0; i < guard->tree.processes; i++) {
		const struct process *process = guard->tree.process[i];

		if (has_ours(process) && process->exec_check_ns < due)
			due = process->exec_check_ns;
	}
	return due;
}

/* When the main process ends, the others do, too, and all are restored with what the holders have.
 * Some end by themselves as soon as it has closed its descriptors: before its own end can be seen.
 * So its end is checked last. */
void guard_let_ended_go(struct avc_guard *guard)
{
	const struct process *main = &guard->main;

	for (uint32_t i = 0; i < guard->tree.processes; i++) {
		struct process *process = guard->tree.process[i];

		if (!process->descendant || !process->pid || !pidfd_ended(process->pidfd))
			continue;
		if (!main->pid || pidfd_ended(main->pidfd) || proc_is_exiting(main->pid))
			return;
		guard_release(guard, process);
	}
	tree_sweep(&guard->tree);
}

void guard_tend_tree(struct avc_guard *guard)
{
	(void)guard_let_executed_go(guard, false);
	guard_let_ended_go(guard);
}

/* An app that is killed while its threads are being stopped may leave a thread that was just being
 * created: our tracee, unknown to us, and its leader cannot be reaped before it. */
void guard_reap_unknown(const struct avc_guard *guard)
{
	/* A known one that has ended would hide the others. */
	(void)tracee_reap_ending();
	while (tracee_reap_unknown(is_known, guard))
		;
}

static bool has_ended(const struct generation *generation)
{
	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].process && pidfd_ended(generation->image[i].pidfd))
			return true;
	return false;
}

/* init has been killed, and may have to wait for a CPU. */
static bool container_ends(const struct avc_guard *guard, int ms)
{
	return ms < CONTAINER_ENDS_MS && proc_is_killed(guard->channel.init);
}

/* The last one held, as the event says: the next may have to wait. */
static void note_killed(struct avc_guard *guard, struct avc_event *event)
{
	const uint64_t pause = policy_killed(&guard->policy, now_ns());

	if (pause)
		fail(&event->error, AVC_LIMIT, 0, 0, "", "",
		     "no other is made for %u s, as they are killed at once",
		     (unsigned)(pause / NS_PER_S));
}

/* Templates that were killed: by us, from inside the container or by the OOM killer. */
void guard_reap_dead(struct avc_guard *guard)
{
	struct avc_event events[AVC_KEEP_MAX];
	struct pollfd news[] = {
		{ .fd = guard->channel.init_pidfd, .events = POLLIN },
		{ .fd = guard->channel.report_fd, .events = POLLIN },
	};
	uint32_t count = 0;

	/* When the PID namespace ends, everything dies, init last, once we have reaped our tracees:
	 * then lost generations are not reported.  A death of the app is handled at once. */
	for (int ms = 0; ms < CONTAINER_END_MS || container_ends(guard, ms); ms++) {
		(void)tracee_reap_ending();
		for (uint32_t i = 0; i < guard->count; i++)
			(void)spare_is_there(&guard->generations[i]);
		for (uint32_t i = guard->count; i-- > 0;)
			if (has_ended(&guard->generations[i]))
				events[count++] = lost_generation(guard, i, AVC_REASON_KILLED);
		for (uint32_t i = 0; i < guard->tree.processes; i++)
			if (guard->tree.process[i]->holder &&
			    pidfd_ended(guard->tree.process[i]->holder_pidfd))
				process_unhold(guard->tree.process[i]);
		dirty_drop_ended(&guard->dirty);
		if (!count || (poll_for(news, 2, NS_PER_MS) > 0 && news[0].revents))
			return;
		/* init waits for all of our tracees, too. */
		(void)guard_tend_stragglers(guard);
		guard_reap_unknown(guard);
		if (news[1].revents & POLLIN)
			break;
		if (news[1].revents)
			news[1].fd = -1; /* init is just ending */
	}
	/* It had reported a death that it does not undo. */
	if (proc_is_killed(guard->channel.init))
		return;
	if (!guard->count)
		note_killed(guard, &events[count - 1]);
	for (uint32_t i = 0; i < count; i++)
		guard_emit(guard, &events[i]);
}

/* ---- which generations are worth keeping ------------------------------------------ */

uint64_t guard_keep_generation(struct avc_guard *guard, struct generation *fresh)
{
	const uint64_t now = now_ns();
	struct policy_generation record = policy_new_generation(&guard->policy, &guard->config,
								fresh->number, now);
	uint64_t replaced = 0;

	record.line = guard->line;

	/* Only the newest has a spare. */
	for (uint32_t i = 0; i < guard->count; i++)
		spare_drop(&guard->generations[i]);
	while (guard->count >= guard->policy.room) {
		const uint32_t i = guard->line
					   ? guard_line_replaced(guard)
					   : policy_replaced(&guard->policy, &guard->config, now);

		replaced = guard->generations[i].number;
		if (guard_has_room_for_copies(guard))
			dirty_recycle(&guard->dirty, &guard->generations[i]);
		guard_drop_generation(guard, i);
	}
	guard->generations[guard->count++] = *fresh;
	policy_hold(&guard->policy, record);
	guard_rank_generations(guard);
	return replaced;
}

enum avc_reason guard_fall_back(struct avc_guard *guard, int status, bool hung)
{
	const struct policy_fallback left = policy_crashed(&guard->policy, &guard->config, status,
							   hung, now_ns());

	if (!left.trusted)
		guard_await_seen(guard);
	while (guard->count > left.healthy)
		guard_lose_generation(guard, guard->count - 1, AVC_REASON_UNHEALTHY, 0);
	while (guard->count > left.trusted)
		guard_lose_generation(guard, guard->count - 1, AVC_REASON_CRASHED, 0);
	return left.looping ? AVC_REASON_LOOP : AVC_REASON_LIMIT;
}

/* ---- avckpt.files=auto and strict ---------------------------------------------- */

/* File is older than the generation, and open in none of its processes. */
static bool is_old(int fd, const struct stat *st, const void *arg)
{
	const struct generation *generation = arg;

	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].process && !files_is_older(&generation->image[i], fd, st))
			return false;
	return true;
}

/* Before the next generation is taken, and before one is restored: a write to a file makes all
 * generations for which writes count invalid. */
void guard_note_written(struct avc_guard *guard)
{
	const struct generation *newest = guard->count ? &guard->generations[guard->count - 1]
						       : NULL;
	char name[FILES_NAME];

	if (!guard->written ||
	    !files_written_since(guard->written, newest ? newest->image[0].files : NULL,
				 guard->config.files == AVC_FILES_AUTO && newest ? is_old : NULL,
				 newest, name))
		return;
	for (uint32_t i = 0; i < guard->count; i++)
		if (guard->generations[i].watched)
			memcpy(guard->generations[i].written, name, sizeof name);
}

/* All processes, also those that have ended: what they have written belongs to the others. */
static int check_auto(const struct avc_guard *guard, const struct generation *generation, int pidfd,
		      struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->images; i++) {
		const struct image *image = &generation->image[i];
		const struct process *process = image->process;

		if (!process)
			continue;
		if (process->descendant)
			pidfd = process->holder ? process->holder_pidfd : -1;
		if (files_check_auto(image, pidfd, guard->channel.init, err))
			return -1;
	}
	return 0;
}

/* Whether memory may go back although files do not.  `pid`, `pidfd`: a process that has the current
 * descriptors. */
int guard_check_files(struct avc_guard *guard, const struct generation *generation, pid_t pid,
		      int pidfd, struct avc_error *err)
{
	const bool strict = guard->config.files == AVC_FILES_STRICT;

	if (!strict && guard->config.files != AVC_FILES_AUTO)
		return 0;
	guard_note_written(guard);
	if (generation->written[0])
		return fail(err, AVC_UNSUPPORTED, 0, 0, "restore", "",
			    "avckpt.files=%s: %.80s was written since the checkpoint",
			    strict ? "strict" : "auto", generation->written);
	for (uint32_t i = 0; i < generation->images; i++)
		if (memory_check_names(&generation->image[i], strict ? "strict" : "auto", err))
			return -1;
	if (!strict)
		return check_auto(guard, generation, pidfd, err);
	for (uint32_t i = 0; i < generation->images; i++) {
		const struct image *image = &generation->image[i];
		const struct process *process = image->process;

		/* guard_note_written() has seen the writes of one that has ended before. */
		if (!process || (process->descendant && !process->holder))
			continue;
		if (files_check_strict(image, process->descendant ? process->holder : pid,
				       process->descendant ? process->holder_pidfd : pidfd,
				       guard->channel.init, process->holder, err))
			return -1;
	}
	return 0;
}
