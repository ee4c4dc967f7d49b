/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt.group.recovery=together: what the guards of a group do in the same instant.
 *
 * The daemon starts a meeting (struct avc_meeting) for one line, or for one return to a line.
 * From then on they depend only on the memory that they share: none waits for the daemon while an
 * app is stopped.  Every wait is bounded, and a guard that waits too long breaks the meeting for
 * all.
 *
 *   a line     0 ready        the app still runs; slow preparations are done
 *              1 still        everything is read and cloned: no member sends any more
 *              2 frozen       data in flight between them is copied, too: all are released
 *              3 taken        it can be restored everywhere: all keep it, or none
 *   a return   0 able         the app may still run; it could go back
 *              1 dead         nothing that could send runs any more
 *              2 shown        its ends of connections are published: now they are restored
 *                             (files_group.c)
 *              3 restored     everything is restored: now all run
 */
#include <limits.h>
#include <linux/futex.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "guard.h"

#define MEMBERS_MAX 1024
#define SLICE_NS (2 * NS_PER_MS) /* between checks whether the app has died              */
#define READY_NS (1 * NS_PER_S)  /* the app runs                                         */
#define TAKEN_NS (1 * NS_PER_S)  /* ... again                                            */
#define CLONES 4                 /* wait for so many times the slowest expected clone    */
#define FIRST_CLONE_MS 250       /* assumed before the first one was measured            */
#define DEAD_NS (3 * NS_PER_S)
#define RESTORED_NS (3 * NS_PER_S) /* init is notified meanwhile; INJ_GO_S is longer      */
#define WAITS_NS (5 * NS_PER_S)    /* for the daemon to choose a line                      */

enum line_step { LINE_READY = 0, LINE_STILL = 1, LINE_FROZEN = 2, LINE_TAKEN = 3, LINE_STEPS };
enum recall_step {
	RECALL_ABLE = 0,
	RECALL_DEAD = 1,
	RECALL_SHOWN = 2,
	RECALL_RESTORED = 3,
	RECALL_STEPS
};

/* ---- a meeting ---------------------------------------------------------------- */

static int fail_broken(const struct avc_guard *guard, struct avc_error *err)
{
	return fail(err, AVC_DEADLINE, 0, guard->main.pid, "meet", "",
		    "another member of its group could not, or came too late");
}

static bool enter_meeting(struct avc_guard *guard, const struct avc_request *request, int fd)
{
	struct stat st;
	void *map;

	guard_leave_meeting(guard);
	if (fd < 0 || fstat(fd, &st) || st.st_size < (off_t)sizeof *guard->meeting)
		return false;
	map = mmap(NULL, sizeof *guard->meeting, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
	if (map == MAP_FAILED)
		return false;
	guard->meeting = map;
	guard->members = guard->meeting->members;
	guard->line = request->line;
	guard->recall = request->generation;
	guard->step = 0;
	guard->steps = request->kind == AVC_REQUEST_LINE ? LINE_STEPS : RECALL_STEPS;
	if (guard->members && guard->members <= MEMBERS_MAX)
		return true;
	guard_leave_meeting(guard);
	return false;
}

static void wake_all(struct avc_meeting *meeting)
{
	syscall(SYS_futex, &meeting->state, FUTEX_WAKE, INT_MAX, NULL, NULL, 0);
}

/* Only from the current step, so that all members see the same outcome. */
static bool move(struct avc_meeting *meeting, uint32_t from, uint32_t to)
{
	if (!__atomic_compare_exchange_n(&meeting->state, &from, to, false, __ATOMIC_ACQ_REL,
					 __ATOMIC_ACQUIRE))
		return false;
	wake_all(meeting);
	return true;
}

static uint32_t state_of(const struct avc_meeting *meeting)
{
	return __atomic_load_n(&meeting->state, __ATOMIC_ACQUIRE);
}

/* Has no effect if all have arrived at this step already. */
static void break_at(struct avc_guard *guard, uint32_t step)
{
	(void)move(guard->meeting, step, AVC_MEETING_BROKEN);
}

void guard_leave_meeting(struct avc_guard *guard)
{
	if (!guard->meeting)
		return;
	if (guard->step < guard->steps)
		break_at(guard, guard->step);
	munmap(guard->meeting, sizeof *guard->meeting);
	guard->meeting = NULL;
	guard->line = 0;
}

bool guard_may_meet(const struct avc_guard *guard)
{
	return !guard->meeting || state_of(guard->meeting) == guard->step;
}

/* Whether something urgent has happened: the app has died, or init. */
static bool is_called_away(const struct avc_guard *guard)
{
	struct pollfd news[] = {
		{ .fd = guard->dead.waits ? -1 : guard->channel.report_fd, .events = POLLIN },
		{ .fd = guard->channel.init_pidfd, .events = POLLIN },
	};

	return poll_for(news, 2, 0) > 0;
}

/* Until all have arrived at this step, for `ns` at most. */
static int meet(struct avc_guard *guard, uint32_t step, uint64_t ns, struct avc_error *err)
{
	struct avc_meeting *meeting = guard->meeting;
	const struct timespec slice = { .tv_nsec = SLICE_NS };
	const uint64_t end = now_ns() + ns;

	if (guard->step != step || state_of(meeting) != step)
		return fail_broken(guard, err);
	guard->step = step + 1;
	if (__atomic_add_fetch(&meeting->arrived[step], 1, __ATOMIC_ACQ_REL) == guard->members)
		(void)move(meeting, step, step + 1);
	while (state_of(meeting) == step) {
		if (now_ns() > end || is_called_away(guard))
			break_at(guard, step);
		else
			syscall(SYS_futex, &meeting->state, FUTEX_WAIT, step, &slice, NULL, 0);
		heartbeat();
		if (guard->dead.waits)
			init_channel_working(&guard->channel);
		if (step == LINE_TAKEN && guard->steps == LINE_STEPS) {
			(void)guard_tend_stragglers(guard);
			(void)guard_end_waits(guard);
		}
	}
	return state_of(meeting) == AVC_MEETING_BROKEN ? fail_broken(guard, err) : 0;
}

int guard_meet_restored(struct avc_guard *guard, struct avc_error *err)
{
	return meet(guard, RECALL_RESTORED, RESTORED_NS, err);
}

/* ---- lines --------------------------------------------------------------------- */

void guard_take_line(struct avc_guard *guard, const struct avc_request *request, int fd)
{
	if (!enter_meeting(guard, request, fd) || !guard->attached || guard->dead.waits)
		guard_refuse(guard, request->ticket, AVC_EMPTY,
			     "it has no part in a line of its group now");
	else
		guard_checkpoint(guard, request->ticket);
	guard_leave_meeting(guard);
}

static uint64_t expected_ms(const struct avc_guard *guard)
{
	return guard->dirty.fork_ns ? guard->dirty.fork_ns / NS_PER_MS : FIRST_CLONE_MS;
}

/* The entry for that line; NULL: there is none, or `add` and no room. */
static struct avc_held_line *find_line(struct avc_meeting *meeting, uint64_t line, bool add)
{
	for (uint32_t i = 0; i < AVC_MEETING_LINES; i++) {
		struct avc_held_line *held = &meeting->held[i];
		uint64_t found = __atomic_load_n(&held->line, __ATOMIC_ACQUIRE);

		if (!found && !add)
			return NULL;
		if (!found && __atomic_compare_exchange_n(&held->line, &found, line, false,
							  __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE))
			return held;
		if (found == line)
			return held;
	}
	return NULL;
}

/* What is held does not change until the line is taken. */
static void say_held(struct avc_guard *guard)
{
	const uint64_t now = now_ns();

	for (uint32_t i = 0; i < guard->count; i++) {
		const uint64_t line = guard->policy.held[i].line;
		const struct policy_line say = policy_line(&guard->policy, &guard->config, i, now);
		struct avc_held_line *held = line ? find_line(guard->meeting, line, true) : NULL;

		if (!held)
			continue;
		__atomic_add_fetch(&held->holders, 1, __ATOMIC_ACQ_REL);
		__atomic_add_fetch(&held->keepers, say.kept, __ATOMIC_ACQ_REL);
		__atomic_add_fetch(&held->suspects, say.suspect, __ATOMIC_ACQ_REL);
	}
}

uint32_t guard_line_replaced(const struct avc_guard *guard)
{
	struct policy_line said[AVC_KEEP_MAX] = { 0 };

	for (uint32_t i = 0; i < guard->count; i++) {
		const uint64_t line = guard->policy.held[i].line;
		const struct avc_held_line *held = line ? find_line(guard->meeting, line, false)
							: NULL;

		if (held)
			said[i] = (struct policy_line){ .held = held->holders == guard->members,
							.kept = held->keepers > 0,
							.suspect = held->suspects > 0 };
	}
	return policy_line_replaced(&guard->policy, said);
}

int guard_meet_ready(struct avc_guard *guard, struct avc_error *err)
{
	const uint64_t own = expected_ms(guard);
	uint32_t *most = &guard->meeting->clone_ms, was = __atomic_load_n(most, __ATOMIC_RELAXED);

	say_held(guard);
	while (was < own && !__atomic_compare_exchange_n(most, &was, (uint32_t)own, false,
							 __ATOMIC_RELAXED, __ATOMIC_RELAXED))
		;
	return meet(guard, LINE_READY, READY_NS, err);
}

/* No thread of the app is in the parasite any more: if this process dies, all of them continue. */
int guard_meet_frozen(void *arg, struct generation *whole, struct avc_error *err)
{
	struct avc_guard *guard = arg;
	struct avc_board *board = &guard->meeting->board;
	uint64_t ms = __atomic_load_n(&guard->meeting->clone_ms, __ATOMIC_RELAXED);

	if (!whole) {
		break_at(guard, guard->step);
		return fail_broken(guard, err);
	}
	ms = ms < NS_PER_S / NS_PER_MS ? ms : NS_PER_S / NS_PER_MS;
	whole->ends = files_ends_new(whole->image, whole->images, board);
	if (meet(guard, LINE_STILL, guard->config.freeze_deadline_ns + CLONES * ms * NS_PER_MS,
		 err)) {
		files_ends_free(whole->ends); /* before the app can close them */
		whole->ends = NULL;
		return -1;
	}
	files_ends_keep(whole->ends, board);
	return meet(guard, LINE_FROZEN, guard->config.freeze_deadline_ns, err);
}

/* Until then any member may fail to complete its generation, and all have what they had. */
int guard_meet_taken(struct avc_guard *guard, struct avc_error *err)
{
	return meet(guard, LINE_TAKEN, TAKEN_NS, err);
}

/* ---- a return -------------------------------------------------------------------- */

static void wait_for_group(struct avc_guard *guard, const struct avc_error *error)
{
	struct avc_event event = guard_event(guard, AVC_EVENT_WAITS);

	guard->dead.waits = true;
	guard->dead.until_ns = now_ns() + WAITS_NS;
	guard->next_ns = POLICY_NEVER;
	event.generation = guard->policy.held[guard->count - 1].number;
	event.reason = guard->dead.reason;
	event.wait_status = guard->dead.report.status;
	event.died_ns = guard->dead.report.reaped_ns;
	event.ticket = guard->dead.ticket;
	event.error = *error;
	/* Everybody waits for it to choose a line; then it ends this itself. */
	if (getppid() == guard->daemon)
		(void)rt_priority_lend(guard->daemon);
	guard_emit(guard, &event);
}

static void end_dead(struct avc_guard *guard, enum avc_reason reason, const struct avc_error *error)
{
	guard->dead.waits = false;
	guard->restore_ticket = guard->dead.ticket;
	guard_give_up(guard, &guard->dead.report, reason, error);
	guard->restore_ticket = 0;
}

/* All are dead. */
static int meet_shown(struct avc_guard *guard, struct avc_error *err)
{
	struct generation *to = &guard->generations[guard->count - 1];
	struct avc_board *board = &guard->meeting->board;

	files_ends_show(to->ends, to->image, to->images, &guard->config, board);
	if (meet(guard, RECALL_SHOWN, DEAD_NS, err))
		return -1;
	guard->dead.ended = files_ends_mend(to->ends, to->image, to->images, &guard->config, board);
	return 0;
}

/* This app is dead; waits until all others are. */
static void go_back(struct avc_guard *guard)
{
	struct avc_error error = { 0 };
	bool back = false;

	rt_priority_begin();
	guard_begin_patience(guard);
	guard->dead.waits = true; /* so that meet() notifies init of progress */
	if (guard_find_generation(guard, guard->recall) >= 0 &&
	    meet(guard, RECALL_DEAD, DEAD_NS, &error) == 0) {
		guard_drop_newer(guard, guard->recall);
		guard->restore_ticket = guard->dead.ticket;
		back = meet_shown(guard, &error) == 0 &&
		       guard_bring_back(guard, &guard->dead.report, guard->dead.reason,
					guard->dead.had, &error);
	}
	restore_patience_end();
	guard_leave_meeting(guard);
	guard->dead.waits = false;
	if (back) {
		if (guard->main.pid)
			guard_hold_all(guard);
		guard_pace_restored(guard);
	} else if (guard->count) {
		wait_for_group(guard, &error);
	} else {
		end_dead(guard, AVC_REASON_FAILED, &error);
	}
	guard->restore_ticket = 0;
	rt_priority_end();
}

void guard_go_back(struct avc_guard *guard, const struct avc_report *report, enum avc_reason reason,
		   uint32_t had)
{
	const struct avc_error none = { 0 };

	guard->dead = (struct group_death){
		.report = *report, .reason = reason, .ticket = guard->restore_ticket, .had = had
	};
	if (guard->meeting)
		go_back(guard);
	else
		wait_for_group(guard, &none);
}

/* Checked first: otherwise a running app might be killed in vain. */
static int check_able(struct avc_guard *guard, struct avc_error *err)
{
	const int i = guard_find_generation(guard, guard->recall);

	if (i < 0)
		return fail(err, AVC_EMPTY, 0, guard->main.pid, "go back", "",
			    "it does not hold that line");
	if (guard->dead.waits)
		return 0;
	if (!guard->main.pid || init_channel_stop_asked(&guard->channel))
		return fail(err, AVC_GONE, 0, guard->main.pid, "go back", "",
			    "it has ended, or has been asked to stop");
	return guard_check_files(guard, &guard->generations[i], guard->main.pid, guard->main.pidfd,
				 err);
}

/* The others are dead, or just ending. */
static void begin_recall(struct avc_guard *guard, const struct avc_request *request)
{
	if (guard->urgent)
		return;
	guard->urgent = true;
	if (request->lent)
		rt_priority_begin_lent();
	else
		rt_priority_begin();
}

void guard_end_recall(struct avc_guard *guard)
{
	rt_priority_reclaim(guard->channel.init);
	if (guard->urgent)
		rt_priority_end();
	guard->urgent = false;
}

/* It goes back, or is about to: init reports its death.  False: it does not. */
static bool recall(struct avc_guard *guard, const struct avc_request *request, int fd)
{
	struct avc_error error = { 0 };

	if (!enter_meeting(guard, request, fd) || !guard->attached) {
		guard_leave_meeting(guard);
		guard_refuse(guard, request->ticket, AVC_EMPTY, "it cannot go back now");
		return false;
	}
	if (check_able(guard, &error) || meet(guard, RECALL_ABLE, READY_NS, &error)) {
		guard_leave_meeting(guard);
		guard_emit_error(guard, AVC_EVENT_REFUSED, request->ticket, &error);
		return false;
	}
	if (guard->dead.waits) {
		guard->dead.ticket = request->ticket;
		go_back(guard);
		return false;
	}
	guard->restore_asked = AVC_REASON_GROUP;
	guard->restore_ticket = request->ticket;
	process_kill(&guard->main);
	/* Both need a CPU before that. */
	process_hasten(&guard->main);
	(void)rt_priority_lend(guard->channel.init);
	return true;
}

void guard_recall(struct avc_guard *guard, const struct avc_request *request, int fd)
{
	budget_begin(NULL, NULL);
	begin_recall(guard, request);
	if (!recall(guard, request, fd))
		guard_end_recall(guard);
}

void guard_abandon(struct avc_guard *guard, uint64_t ticket)
{
	struct avc_error error = { 0 };

	if (!guard->dead.waits)
		return;
	guard->dead.ticket = ticket;
	fail(&error, AVC_EMPTY, 0, 0, "restore", "",
	     "its group has no line to go back to together");
	end_dead(guard, AVC_REASON_FAILED, &error);
}

void guard_tend_dead(struct avc_guard *guard)
{
	struct avc_error error = { 0 };

	init_channel_working(&guard->channel);
	if (guard->count && now_ns() < guard->dead.until_ns)
		return;
	fail(&error, AVC_DEADLINE, 0, 0, "restore", "", "its group did not go back with it");
	end_dead(guard, AVC_REASON_FAILED, &error);
}
