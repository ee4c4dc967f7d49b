/* SPDX-License-Identifier: Apache-2.0
 *
 * What follows a death: a restore, or the end of init.
 */
#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <string.h>
#include <sys/wait.h>
#include <unistd.h>

#include "guard.h"

#define HOLDER_NS (1 * NS_PER_S) /* busy machines */
#define INIT_LOOK_NS (50 * NS_PER_MS)
#define ENDS_NS (20 * NS_PER_MS)
#define HOLD_AGAIN_NS (20 * NS_PER_MS) /* twice as long each time */
#define HOLD_TRIES 7
#define HOLD_LAST_NS (100 * NS_PER_MS) /* while init waits */
#define ROOM_STEP_US 10000

/* ---- death and restore --------------------------------------------------------- */

static bool is_late(const struct avc_guard *guard)
{
	return guard->late_ns && now_ns() > guard->late_ns;
}

/* Last chance to refuse: the app has not run an instruction yet. */
static int say_restored(void *arg, struct avc_error *err)
{
	struct avc_guard *guard = arg;

	if (is_late(guard))
		return fail(err, AVC_DEADLINE, 0, 0, "restore", "",
			    "it would come later than avckpt.deadline");
	/* No more PIDs are chosen: a sibling that is in the group, too, may choose its own. */
	last_pid_unlock(guard->channel.numbers_fd);
	if (guard->meeting && guard_meet_restored(guard, err))
		return -1;
	return init_channel_verdict(&guard->channel, AVC_VERDICT_RESTORED, err);
}

void guard_give_up(struct avc_guard *guard, const struct avc_report *report, enum avc_reason reason,
		   const struct avc_error *error)
{
	struct avc_error ignored = { 0 };
	struct avc_event event;

	if (reason != AVC_REASON_STOPPED && reason != AVC_REASON_CLEAN_EXIT)
		guard_await_seen(guard);
	event = guard_event(guard, AVC_EVENT_GAVE_UP);
	(void)init_channel_verdict(&guard->channel, AVC_VERDICT_GIVE_UP, &ignored);
	event.reason = reason;
	event.wait_status = report->status;
	event.died_ns = report->reaped_ns;
	event.error = *error;
	event.ticket = guard->restore_ticket;
	guard_emit(guard, &event);
	guard_drop_all(guard);
	process_unhold(&guard->main);
	process_close(&guard->main);
	/* init ends now, and the reason should remain the last event. One that does not is none of
	 * ours, and could report deaths as fast as it can write. */
	close_fd(&guard->channel.report_fd);
	guard->next_ns = POLICY_NEVER;
}

/* Nothing that processes started since had open may stay so: a port, a lock, the end of a pipe. */
static void release_new(struct avc_guard *guard, const struct generation *generation)
{
	for (uint32_t i = 0; i < guard->tree.processes; i++)
		if (guard->tree.process[i]->holder &&
		    !generation_image(generation, guard->tree.process[i]))
			guard_release(guard, guard->tree.process[i]);
}

/* From now on the processes are those of the generation; nothing that the dead ones had open is
 * open any more (generation_close_tables()). */
static void adopt_family(struct avc_guard *guard, const struct generation *generation)
{
	struct tree *tree = &guard->tree;

	generation_close_tables(generation, true);
	for (uint32_t i = 0; i < tree->processes; i++)
		if (tree->process[i]->descendant)
			tree_let_go(tree->process[i]);
	for (uint32_t i = 0; i < generation->images; i++) {
		const struct image *image = &generation->image[i];
		struct process *process = image->process;
		struct avc_error gone = { 0 };
		struct proc_stat stat;

		if (!process)
			continue;
		/* The next checkpoint notices one that has died again already; init reports the
		 * main process. */
		process->infected = proc_stat(image->pid, &stat) == 0 &&
				    process_open(process, image->pid, image->inside, &gone) == 0;
		if (process->infected)
			process->start = stat.start;
		process->shared = image->shared;
		/* The last checkpoint may have asked one that was dying, and got no answer. */
		process->adopts = image->adopts;
	}
	tree->count = 0;
	guard->main.childless = generation->images == 1;
}

/* A restore without a crash of this app. */
static bool is_command(enum avc_reason reason)
{
	return reason == AVC_REASON_COMMAND || reason == AVC_REASON_GROUP;
}

static void note_restore(struct avc_guard *guard, enum avc_reason reason)
{
	const uint64_t now = now_ns();

	guard->ahead_ns = now + AHEAD_AFTER_NS;
	guard->restores++;
	policy_restored(&guard->policy, guard->count - 1, !is_command(reason), now);
}

/* `error`: of a newer generation that could not be restored. */
static void tell_restored(struct avc_guard *guard, struct avc_event *event,
			  const struct restore *restore, const struct avc_error *error)
{
	const struct generation *generation = restore->generation;

	event->app_pid = restore->pid;
	event->app_pid_inside = guard->main.inside;
	event->freeze_ns = generation->freeze_ns;
	event->restore_ns = restore->restore_ns;
	event->fork_ns = restore->fork_ns;
	event->threads_ns = restore->threads_ns;
	event->threads = generation_threads(generation);
	event->generation = generation->number;
	event->line = guard->line;
	event->generations = guard->count;
	event->restores = guard->restores;
	event->error = error->code ? *error : restore->notes;
	event->again = restore->config->again;
	event->dropped = (uint32_t)restore->dropped;
	event->age_ns = restore->died_ns - generation->taken_ns;
	event->at_ns = now_ns();
	guard_emit(guard, event);
}

/* During long work.  An init that was killed waits for all of our tracees to be reaped. */
static void say_working(void *arg)
{
	struct avc_guard *guard = arg;
	const uint64_t now = now_ns();

	init_channel_working(&guard->channel);
	if (now - guard->init_seen_ns < INIT_LOOK_NS)
		return;
	guard->init_seen_ns = now;
	guard_send_posted(guard);
	if (proc_is_killed(guard->channel.init))
		restore_is_in_vain();
}

static void release(struct avc_guard *guard, uint32_t i)
{
	tracee_end(guard->remains[i].pid, guard->remains[i].pidfd);
	guard->remains_count--;
	for (; i < guard->remains_count; i++)
		guard->remains[i] = guard->remains[i + 1];
}

void guard_release_remains(struct avc_guard *guard, pid_t pid)
{
	for (uint32_t i = guard->remains_count; i-- > 0;)
		if (guard->remains[i].pid == pid)
			release(guard, i);
}

void guard_release_oldest_remains(struct avc_guard *guard, uint32_t left)
{
	while (guard->remains_count > left)
		release(guard, 0);
}

void guard_tend_remains(struct avc_guard *guard)
{
	for (uint32_t i = guard->remains_count; i-- > 0;)
		if (now_ns() >= guard->remains[i].until_ns || pidfd_ended(guard->remains[i].pidfd))
			release(guard, i);
}

/* The holder still has the dead app's memory; its open files belong to the restored one. */
static void keep_remains(struct avc_guard *guard)
{
	uint32_t i;

	if (!guard->config.remains_ns || !guard->main.holder) {
		process_unhold_soon(&guard->main);
		return;
	}
	guard_release_oldest_remains(guard, REMAINS_MAX - 1);
	if (guard->main.late)
		files_close_late(&guard->main);
	i = guard->remains_count++;
	guard->remains[i].pid = process_detach_holder(&guard->main, &guard->remains[i].pidfd);
	guard->remains[i].until_ns = now_ns() + guard->config.remains_ns;
	/* Memory of a dead process goes before that of any running one. */
	proc_set_oom_score_adj(guard->remains[i].pid, "1000");
}

void guard_begin_patience(struct avc_guard *guard)
{
	budget_begin(say_working, guard);
	restore_patience_begin(guard->late_ns);
	guard->init_seen_ns = now_ns();
}

static void drop_helper(struct avc_guard *guard)
{
	last_pid_end(guard->helper);
	guard->helper = NULL;
}

/* One for the newest generation. */
static void ready_helper(struct avc_guard *guard)
{
	const struct generation *newest;

	if (!guard->count)
		return;
	/* It would take a PID, just when siblings in the group choose theirs. */
	if (guard->config.together && guard->channel.numbers_fd >= 0)
		return;
	newest = &guard->generations[guard->count - 1];
	if (guard->helper &&
	    (guard->helper_for != newest->number || !last_pid_is_there(guard->helper)))
		drop_helper(guard);
	if (guard->helper)
		return;
	guard->helper = restore_ahead(newest, &guard->channel);
	guard->helper_for = newest->number;
}

/* If the app is killed during a checkpoint, init cannot reap a process before we have reaped those
 * of its threads that are our tracees. */
static void reap_tracees(void *arg)
{
	struct avc_guard *guard = arg;

	(void)guard_tend_stragglers(guard);
	guard_reap_unknown(guard);
}

/* `ending`: templates have been killed, and may not have ended yet. */
static int restore_newest(struct avc_guard *guard, struct restore *restore, bool ending,
			  bool *whole, struct avc_error *err)
{
	struct generation *generation = restore->generation;
	int result;

	release_new(guard, generation);
	/* Nor may templates lost by this death keep anything open.  And where processes are limited,
	 * they count, as spares do. */
	if (ending)
		guard_wait_ended(guard);
	if (!guard->meeting)
		files_ends_mend_own(generation->ends, generation->image, generation->images,
				    restore->config);
	init_channel_working(&guard->channel);
	(void)last_pid_lock(guard->channel.numbers_fd, true);
	guard->helper = NULL; /* restore_app() ends it */
	stand_in_begin(&guard->dirty, generation, guard->timer);
	result = restore_app(restore, err);
	last_pid_unlock(guard->channel.numbers_fd);
	*whole = stand_in_finish(&guard->dirty, generation, guard->timer);
	return result;
}

/* The newest could not be restored.  Perhaps because the new process or the spare was killed, or the
 * spare, or what is left of somebody dead, was one process too many: a template that is still whole
 * is good for `again`. */
static void prepare_next_try(struct avc_guard *guard, bool again, const struct avc_error *failed)
{
	struct generation *generation = &guard->generations[guard->count - 1];

	guard_release_oldest_remains(guard, 0);
	reap_tracees(guard); /* or because one of them still has the PID, or its group */
	if (again) {
		generation->spare.unwanted = generation->spare.pid && failed->errnum == EAGAIN;
		spare_drop(generation);
	} else {
		guard_drop_generation(guard, guard->count - 1);
		guard_leave_meeting(guard);
	}
	guard_kill_lost(guard);
}

/* It has failed for want of our own descriptors or memory, not the container's (AVC_LIMIT).  True: to be
 * tried again. */
static bool await_room(const struct avc_report *report, const struct avc_error *failed)
{
	if (failed->code != AVC_KERNEL || !is_shortage(failed->errnum) ||
	    !policy_awaits_room(report->reaped_ns, now_ns()))
		return false;
	usleep(ROOM_STEP_US);
	return budget_wait();
}

static struct avc_event restored_event(const struct avc_guard *guard,
				       const struct avc_report *report, enum avc_reason reason)
{
	struct avc_event event = guard_event(guard, AVC_EVENT_RESTORED);

	event.ticket = guard->restore_ticket;
	event.reason = reason;
	event.wait_status = report->status;
	event.died_ns = report->reaped_ns;
	/* note_restore() counts this one, too, but none on command. */
	event.attempt = policy_restores_within(&guard->policy, &guard->config, now_ns()) +
			!is_command(reason);
	return event;
}

bool guard_bring_back(struct avc_guard *guard, const struct avc_report *report,
		      enum avc_reason reason, uint32_t had, struct avc_error *error)
{
	struct avc_event event = restored_event(guard, report, reason);
	bool ending = guard->count < had, again = false, back = false, whole;
	const bool together = guard->meeting != NULL;
	struct avc_config config = guard->config;

	if (is_command(reason) || !policy_on_probation(&guard->policy, &config, now_ns()))
		config.again = AVC_AGAIN_SAME;
	if (together)
		ready_helper(guard); /* the newest may have changed since the death */
	/* In a group only this one: an older one belongs to another line. */
	while (guard->count && (guard->meeting || !together)) {
		struct generation *generation = &guard->generations[guard->count - 1];
		const struct image *image = &generation->image[0];
		struct restore restore = { .generation = generation,
					   .channel = &guard->channel,
					   .config = &config,
					   .timer = guard->timer,
					   .died_ns = report->reaped_ns,
					   .ready = say_restored,
					   .arg = guard,
					   .helper = guard->helper };
		struct avc_error failed = { 0 };

		if (is_late(guard)) {
			guard_drop_all(guard);
			break;
		}
		budget_begin(say_working, guard);
		shortage_begin();
		if (together && guard->dead.ended.count)
			fail(&restore.notes, AVC_UNSUPPORTED, 0, guard->main.inside,
			     "restore descriptors", "", "%u of its connections have ended: %s",
			     guard->dead.ended.count, guard->dead.ended.why);

		/* Written since the newest means written since all others, also where that cannot
		 * be seen any more. */
		if (guard_check_files(guard, generation, image->template, image->pidfd, &failed)) {
			if (shortage_check(&failed, "restore") && !together &&
			    await_room(report, &failed))
				continue;
			*error = failed;
			guard_drop_all(guard);
			break;
		}
		if (restore_newest(guard, &restore, ending, &whole, &failed) == 0) {
			adopt_family(guard, generation);
			generation->spare.tried = false; /* the spare is used up */
			note_restore(guard, reason);
			tell_restored(guard, &event, &restore, error);
			guard_rank_generations(guard);
			if (!whole)
				guard_lose_generation(guard, guard->count - 1, AVC_REASON_KILLED,
						      0);
			back = true;
			break;
		}
		if (!guard_may_meet(guard)) {
			/* Another member could not be restored; this one could. */
			*error = failed;
			guard_kill_lost(guard);
			break;
		}
		again = whole && (!again || (!together && await_room(report, &failed)));
		if (!again && !error->code)
			*error = failed;
		prepare_next_try(guard, again, &failed);
		ending = true;
	}
	keep_remains(guard);
	if (together)
		drop_helper(guard);
	return back;
}

static bool lacks_holder(const struct process *process)
{
	return process->infected && !process->adopts && !process->holder;
}

static bool hold(struct avc_guard *guard, struct process *process)
{
	struct avc_error ignored = { 0 };

	if (process_hold(process, guard->timer, guard->config.freeze_deadline_ns, &ignored) == 0)
		return true;
	guard->dying_until_ns = now_ns() + DYING_NS;
	return false;
}

/* Begins with none after end_ns.  False: not all have one. */
static bool hold_all(struct avc_guard *guard, uint64_t end_ns)
{
	const struct tree *tree = &guard->tree;
	uint32_t first = 0;
	bool all = true;

	while (first < tree->processes && !lacks_holder(tree->process[first]))
		first++;
	if (first == tree->processes)
		return true;
	if (!last_pid_lock(guard->channel.numbers_fd, false))
		return false;
	for (uint32_t i = first; i < tree->processes; i++)
		if (lacks_holder(tree->process[i]))
			all &= now_ns() < end_ns && hold(guard, tree->process[i]);
	last_pid_unlock(guard->channel.numbers_fd);
	return all;
}

void guard_hold_missing(struct avc_guard *guard)
{
	guard->hold_ns = now_ns() + HOLD_AGAIN_NS;
	/* What has not stopped yet would not do so for this either. */
	if (guard_tend_stragglers(guard))
		return;
	if (hold_all(guard, UINT64_MAX) || !guard->count || guard->hold_tries == HOLD_TRIES)
		guard->hold_ns = UINT64_MAX;
	else
		guard->hold_ns = now_ns() + (HOLD_AGAIN_NS << guard->hold_tries++);
}

/* Only holders keep open what the other processes have open.  The next checkpoint would make those that
 * are missing, and report why they were, but the next death may come before it. */
void guard_hold_all(struct avc_guard *guard)
{
	guard->hold_tries = 0;
	guard_hold_missing(guard);
}

/* The OOM killer also kills processes that share its victim's memory: the holder, too.  Until that
 * is gone, there is no room for the restored app. */
static void await_killed_holder(struct avc_guard *guard)
{
	const struct process *main = &guard->main;

	if (main->holder && proc_is_killed(main->holder))
		(void)pidfd_await_end(main->holder_pidfd, HOLDER_NS);
}

/* Before their PIDs are free, they have to end, and init to reap them.  While they do, the guard leaves
 * the CPUs to them. */
static void kill_descendants(const struct avc_guard *guard)
{
	const uint64_t end = now_ns() + ENDS_NS;

	for (uint32_t i = 0; i < guard->tree.processes; i++) {
		const struct process *process = guard->tree.process[i];

		if (!process->pid)
			continue;
		process_kill(process);
		process_hasten(process);
		(void)rt_priority_lend(guard->channel.init);
	}
	for (uint32_t i = 0; i < guard->tree.processes; i++) {
		struct pollfd ending = { .fd = guard->tree.process[i]->pidfd, .events = POLLIN };
		const uint64_t now = now_ns();

		if (guard->tree.process[i]->pid && now < end)
			(void)poll(&ending, 1, (int)((end - now) / NS_PER_MS));
	}
}

/* Tells it, and keeps what was asked for of the dead process. */
static void begin_death(struct avc_guard *guard, const struct avc_report *report,
			enum avc_reason reason)
{
	struct avc_event event = guard_event(guard, AVC_EVENT_DIED);

	guard->hold_ns = UINT64_MAX;
	guard->channel.death = report->seq;
	guard->channel.working_ns = now_ns();
	event.wait_status = report->status;
	event.died_ns = report->reaped_ns;
	if (guard->config.deadline_ns && reason != AVC_REASON_COMMAND)
		guard->late_ns = report->reaped_ns + guard->config.deadline_ns;
	guard_release_oldest_remains(guard, REMAINS_MAX - 1);
	event.remains_pid = guard->config.remains_ns ? guard->main.holder : 0;
	if (guard->config.remains_ns && guard->count)
		event.likeness_pid = guard->generations[guard->count - 1].image[0].template;
	guard->unseen = event.remains_pid ? event.remains_pid : event.likeness_pid;
	/* The daemon, once woken, could take the CPU that the app is about to be restored on. */
	guard_post(guard, &event);
	process_close(&guard->main);
	guard_kill_lost(guard);
}

static void end_death(struct avc_guard *guard)
{
	restore_patience_end();
	if (!guard->dead.waits)
		drop_helper(guard); /* if there was nothing to restore, after all */
	rt_priority_end();
	guard_end_recall(guard);
	guard_leave_meeting(guard);
	guard->restore_asked = AVC_REASON_NONE;
	guard->restore_ticket = 0;
	guard->restore_generation = 0;
	guard->late_ns = 0;
}

/* False: it has been restored as often as it may be, and is given up. */
static bool fall_back(struct avc_guard *guard, const struct avc_report *report,
		      enum avc_reason reason)
{
	struct avc_error error = { 0 };
	enum avc_reason over;

	if (is_command(reason) || !guard->count)
		return true;
	over = guard_fall_back(guard, report->status, reason == AVC_REASON_UNHEALTHY);
	if (guard->count)
		return true;
	fail(&error, AVC_EMPTY, 0, 0, "restore", "", "it was restored %u time(s) already",
	     guard->restores);
	guard_give_up(guard, report, over, &error);
	return false;
}

/* Nothing of it may be left. */
static int end_leftovers(struct avc_guard *guard, const struct avc_report *report,
			 struct avc_error *err)
{
	while (init_channel_kill_leftovers(&guard->channel, guard_owns, reap_tracees, guard, err)) {
		if (!await_room(report, err))
			return -1;
		*err = (struct avc_error){ 0 };
	}
	return 0;
}

/* `had`: how many generations there were at the death. */
static void restore_dead(struct avc_guard *guard, const struct avc_report *report,
			 enum avc_reason reason, uint32_t had)
{
	struct avc_error error = { 0 };

	if (reason == AVC_REASON_COMMAND && guard->restore_generation)
		guard_drop_newer(guard, guard->restore_generation);
	guard_begin_patience(guard);
	ready_helper(guard);
	/* They may lack holders since a restore just before: the last chance for what only they have
	 * open. */
	(void)hold_all(guard, now_ns() + HOLD_LAST_NS);
	kill_descendants(guard);
	await_killed_holder(guard);
	if (end_leftovers(guard, report, &error)) {
		guard_give_up(guard, report, AVC_REASON_FAILED, &error);
	} else if (!guard->count) {
		fail(&error, AVC_EMPTY, 0, 0, "restore", "", "no generation is held");
		guard_give_up(guard, report, AVC_REASON_EMPTY, &error);
	} else if (guard->config.together || guard->meeting) {
		guard_go_back(guard, report, reason, had);
	} else if (!guard_bring_back(guard, report, reason, had, &error)) {
		guard_give_up(guard, report, is_late(guard) ? AVC_REASON_LATE : AVC_REASON_FAILED,
			      &error);
	} else {
		if (guard->main.pid)
			guard_hold_all(guard);
		guard_pace_restored(guard);
	}
}

static struct policy_verdict judge(const struct avc_guard *guard, const struct avc_report *report)
{
	return policy_judge(&guard->config, report->status, report->flags & AVC_REPORT_STOP_ASKED,
			    guard->restore_asked);
}

void guard_app_ended(struct avc_guard *guard, const struct avc_report *report)
{
	if (!judge(guard, report).restore)
		guard_app_died(guard, report);
}

void guard_app_died(struct avc_guard *guard, const struct avc_report *report)
{
	const uint32_t had = guard->count;
	const struct policy_verdict verdict = judge(guard, report);
	struct avc_error none = { 0 };

	rt_priority_begin();
	if (verdict.restore)
		ready_helper(guard); /* meanwhile it enters the container */
	begin_death(guard, report, verdict.reason);
	if (!verdict.restore)
		guard_give_up(guard, report, verdict.reason, &none);
	else if (fall_back(guard, report, verdict.reason))
		restore_dead(guard, report, verdict.reason, had);
	end_death(guard);
}
