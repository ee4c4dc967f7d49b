/* SPDX-License-Identifier: Apache-2.0
 *
 * When and how a checkpoint is taken, and what is reported when none can be.
 */
#include <errno.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "guard.h"

#define SPARE_NS (NS_PER_S / 2)
#define READ_NS (2 * NS_PER_S) /* to read its state while it is stopped                        */
#define QUIESCE_STEP_NS NS_PER_MS
#define TEMPLATE_NS (20 * NS_PER_MS) /* to make one ready, where there are many         */
#define LOOK_NS (100 * NS_PER_MS)
#define TAKE_TRIES 4
#define SEE_OFF_NS (5 * NS_PER_MS)
#define SEE_OFF_STEP_NS (NS_PER_MS / 5)
#define VFORK_NS (2 * NS_PER_S)
#define HOMEWARD_NS (2 * NS_PER_S)
/* So many new threads are asked in the freeze, where each makes it longer by some 0.05 ms.  More are
 * worth a stop of their process for that alone. */
#define ASK_IN_FREEZE 8
/* Work ahead takes at most one of so many parts of an interval's CPU time. */
#define INHERIT_SHARE 100
#define SPARE_SHARE 20

/* ---- checkpoint --------------------------------------------------------------- */

static void let_go_of_holders(struct avc_guard *guard)
{
	guard->hold_ns = UINT64_MAX;
	for (uint32_t i = 0; i < guard->tree.processes; i++)
		process_unhold(guard->tree.process[i]);
}

/* The app cannot be protected as it is: reports that once, and drops everything. */
void guard_unprotect(struct avc_guard *guard, uint64_t ticket, const struct avc_error *error)
{
	guard_drop_all(guard);
	let_go_of_holders(guard);
	if (!guard->unprotected || ticket)
		guard_emit_error(guard, AVC_EVENT_UNPROTECTED, ticket, error);
	guard->unprotected = true;
}

int guard_find_app(struct avc_guard *guard, struct avc_error *err)
{
	struct proc_status init;
	pid_t app;

	if (guard->main.pid)
		return 0;
	errno = 0;
	app = init_channel_app(&guard->channel);
	if (!app || !init_channel_app_started(&guard->channel, app))
		return is_shortage(errno) ? fail_errno(err, 0, "attach", "open(children)",
						       "the application cannot be looked for")
					  : fail(err, AVC_DEADLINE, 0, 0, "attach", "",
						 "the application has not been started yet");
	guard->main.init = guard->channel.init;
	if (proc_status(guard->channel.init, &init) == 0)
		guard->main.plain_filters = init.seccomp_filters;
	return process_open(&guard->main, app, proc_inside(app), err);
}

static void wait_quiescent(struct avc_guard *guard, bool *found)
{
	const uint64_t end = now_ns() + guard->config.quiesce_ns;
	/* A death ends the wait. */
	struct pollfd death = { .fd = guard->channel.report_fd, .events = POLLIN };

	*found = false;
	if (!guard->config.quiesce_ns)
		return;
	while (!(*found = process_is_quiescent(&guard->main)) && now_ns() < end &&
	       poll_for(&death, 1, QUIESCE_STEP_NS) == 0)
		;
}

/* The first touch of a page costs a fault: not while the app is stopped. */
static void touch_slot(const struct parasite *parasite, uint32_t slot, uint32_t threads)
{
	for (uint32_t i = 0; i < threads && i < parasite->threads_max; i++) {
		volatile uint8_t *frame = parasite_frame(parasite, slot, i);

		for (size_t at = 0; at < arch_frame_bytes(); at += ARCH_PAGE_BYTES)
			frame[at] = 0;
		frame[arch_frame_bytes() - 1] = 0;
		*(volatile uint64_t *)parasite_thread(parasite, slot, i) = 0;
	}
}

/* With another parasite, templates are of another program, or their slots too small. */
static void drop_images(struct avc_guard *guard, const struct process *process)
{
	for (uint32_t i = guard->count; i-- > 0;)
		if (generation_image(&guard->generations[i], process))
			guard_drop_generation(guard, i);
}

/* We do not fork while another guard in the same PID namespace chooses PIDs. */
static int lock_numbers(const struct avc_guard *guard, struct avc_error *err)
{
	if (last_pid_lock(guard->channel.numbers_fd, false))
		return 0;
	return fail(err, AVC_DEADLINE, 0, guard->main.pid, "checkpoint", "flock",
		    "others in its PID namespace choose numbers all the time");
}

static int infect(struct avc_guard *guard, struct process *process, struct avc_error *err)
{
	int result;

	if (lock_numbers(guard, err))
		return -1;
	result = process_infect(process, guard->config.keep + 1, guard->timer,
				guard->config.freeze_deadline_ns, err);
	last_pid_unlock(guard->channel.numbers_fd);
	return result;
}

static int hold(struct avc_guard *guard, struct process *process, struct avc_error *err)
{
	int result;

	if (lock_numbers(guard, err))
		return -1;
	result = process_hold(process, guard->timer, guard->config.freeze_deadline_ns, err);
	last_pid_unlock(guard->channel.numbers_fd);
	return result;
}

/* It has come under seccomp filters after its holder was made. */
static bool has_filters_since(const struct process *process)
{
	struct proc_status own, holders;

	return !seccomp_is_confined() && proc_status(process->pid, &own) == 0 &&
	       proc_status(process->holder, &holders) == 0 &&
	       own.seccomp_filters > holders.seccomp_filters;
}

/* The handler of a signal that came on a thread's way home ends soon, or never (siglongjmp(3)).
 * Then the process gets another parasite. */
static int await_home(struct process *process, struct avc_error *err)
{
	const struct parasite *parasite = &process->parasite;
	const bool says_home = parasite->left_ns && parasite_says_home(parasite);

	if (!parasite->left_ns || (says_home && !parasite->late))
		return 0;
	process->infected = now_ns() - parasite->left_ns < HOMEWARD_NS;
	return process->infected && !says_home ? fail(err, AVC_DEADLINE, 0, process->pid, "stop",
						      "", "a thread is still on its way home")
					       : 0;
}

static int prepare_process(struct avc_guard *guard, uint32_t entry, uint32_t *later,
			   struct avc_error *err)
{
	struct process *process = guard->tree.entry[entry].process;
	const int above = guard->tree.entry[entry].parent;
	const struct process *parent = entry ? guard->tree.entry[above < 0 ? 0 : above].process
					     : NULL;
	const uint64_t deadline = guard->config.freeze_deadline_ns;

	if (process_follow(process, err) || support_check(process, parent, err) ||
	    process_list_threads(process, err))
		return -1;
	if (process->infected && (process->thread_count > process->parasite.threads_max ||
				  guard->config.keep >= process->parasite.slots))
		process->infected = false;
	if (process->infected && await_home(process, err))
		return -1;
	if (!process->infected) {
		if (process->descendant)
			drop_images(guard, process);
		else
			guard_drop_all(guard);
		process_unhold(process);
		for (uint32_t i = 0; i < process->thread_count; i++)
			process->threads[i].known = false;
		if (infect(guard, process, err))
			return -1;
		if (parent)
			memory_expect(process, parent);
	}
	/* Its holder makes calls from memory that the process can write. */
	if ((process->holder && has_filters_since(process)) || process_has_moved(process, -1))
		process_unhold(process);
	/* That of the main process is what its threads are asked about (fence.c). */
	if (!process->descendant && !process->holder && hold(guard, process, err))
		return -1;
	if (process_query_new_threads(process, guard->timer, deadline, later, err))
		return -1;
	process->adopts = process->descendant && tree_has_reaper(&guard->tree, entry);
	/* Below a process that adopts orphans, only when that one is stopped, too. */
	if (!process->holder && !process->adopts && hold(guard, process, err))
		return -1;
	return 0;
}

/* Whatever failed for a child that was killed meanwhile: the freeze handles one that is ending. */
static bool is_ending(const struct process *process, const struct avc_error *failed)
{
	struct avc_error dies = { 0 };

	return failed->code == AVC_GONE || process_check_dying(process, &dies);
}

/* Its threads that we trace are reaped by us alone, and its parent, which waits for it, runs.  A thread
 * that is being killed takes a moment to get that far. */
static void see_off(struct process *process)
{
	const uint64_t end = now_ns() + SEE_OFF_NS;

	while (threads_tend_stragglers(process) && now_ns() < end)
		(void)pidfd_await_end(process->pidfd, SEE_OFF_STEP_NS);
}

static int renew_holders(struct avc_guard *guard, struct avc_error *err)
{
	for (uint32_t i = 0; i < guard->tree.processes; i++) {
		struct process *process = guard->tree.process[i];

		if (!process->doubtful)
			continue;
		if (proc_is_exiting(guard->main.pid))
			return fail(err, AVC_GONE, 0, guard->main.pid, "attach", "",
				    "it has ended");
		process_unhold(process);
	}
	return 0;
}

/* A parent that waits for its child to execute a program or end (vfork(2)) cannot be stopped, and
 * every checkpoint would be missed.  Few children take longer than VFORK_NS. */
static int check_vfork(const struct tree *tree, struct avc_error *err)
{
	const uint64_t tick_ns = NS_PER_S / (uint64_t)sysconf(_SC_CLK_TCK);
	const uint64_t now = clock_ns(CLOCK_BOOTTIME);

	for (uint32_t i = 1; i < tree->count; i++) {
		const struct tree_entry *entry = &tree->entry[i];
		const uint64_t age_ns = now - entry->stat.start * tick_ns;

		if (entry->process && !entry->process->infected && age_ns > VFORK_NS &&
		    age_ns < INT64_MAX && tree_shares_memory(tree, i))
			return fail(err, AVC_UNSUPPORTED, 0, entry->pid, "check", "",
				    "process %d has its parent's memory, and executes no program "
				    "(vfork)",
				    entry->process->inside);
	}
	return 0;
}

static int prepare(struct avc_guard *guard, struct avc_error *err)
{
	struct tree *tree = &guard->tree;
	uint32_t later = ASK_IN_FREEZE;

	if (guard_find_app(guard, err) || renew_holders(guard, err))
		return -1;
	/* Before anything is checked: if it is refused, what it executes from now on is not. */
	(void)process_listen_for_exec(&guard->main);
	tree->init = guard->channel.init;
	tree->slots = guard->config.keep + 1;
	(void)guard_let_executed_go(guard, true);
	if (tree_scan(tree, err) || check_vfork(tree, err) || guard_make_room_for_tasks(guard, err))
		return -1;
	for (uint32_t i = 0; i < tree->count; i++) {
		struct process *process = tree->entry[i].process;
		struct avc_error failed = { 0 };

		if (!process || (!process->infected && tree_shares_memory(tree, i)))
			continue;
		if (!budget_step())
			return budget_check(guard->main.pid, err);
		process->main_filters = guard->main.filters;
		process->shm_bytes = guard->main.shm_bytes;
		process->tcp_moved = guard->main.tcp_moved;
		if (prepare_process(guard, i, &later, &failed) == 0)
			continue;
		if (i == 0 || !is_ending(process, &failed)) {
			*err = failed;
			return -1;
		}
		see_off(process);
	}
	return 0;
}

void guard_tell_unstoppable(struct avc_guard *guard, const struct avc_error *error)
{
	struct avc_error why = { 0 };

	if (guard->main.pid && !tree_scan(&guard->tree, &why))
		(void)check_vfork(&guard->tree, &why);
	if (policy_missed(&guard->policy, why.code, false, now_ns()))
		guard_unprotect(guard, 0, &why);
	else
		guard_emit_error(guard, AVC_EVENT_MISSED, 0,
				 why.code == AVC_UNSUPPORTED ? &why : error);
}

/* Descriptors that are read while the app runs make the freeze shorter. */
static int prepare_files(struct avc_guard *guard, struct avc_error *err)
{
	struct tree *tree = &guard->tree;

	for (uint32_t i = 0; i < tree->count; i++) {
		struct process *process = tree->entry[i].process;
		/* An orphan shares most with the main process, if at all. */
		const int parent = tree->entry[i].parent < 0 ? 0 : tree->entry[i].parent;
		struct avc_error failed = { 0 };

		if (process &&
		    files_prepare(process, i ? tree->entry[parent].process : NULL, &failed) &&
		    (i == 0 || !is_ending(process, &failed))) {
			*err = failed;
			return -1;
		}
	}
	return 0;
}

/* After a failed checkpoint: holders that were cloning must not be used for another one.  But if it
 * failed because the app died, they still have its open files. */
static void abandon(struct avc_guard *guard, struct generation *fresh)
{
	generation_drop(fresh);
	tracee_end_now(); /* its templates have open files of processes in no generation yet */
	for (uint32_t i = 0; i < guard->tree.processes; i++)
		guard->tree.process[i]->doubtful |= guard->tree.process[i]->descendant &&
						    guard->tree.process[i]->lost;
	if (guard->tree.processes > 1)
		guard_kill_lost(guard);
	guard_let_ended_go(guard);
}

static bool is_database(const struct avc_guard *guard)
{
	for (uint32_t i = 0; i < guard->tree.count; i++)
		if (guard->tree.entry[i].process && files_is_database(guard->tree.entry[i].process))
			return true;
	return false;
}

static bool is_watched(const struct avc_guard *guard)
{
	for (uint32_t i = 0; i < guard->count; i++)
		if (guard->generations[i].watched)
			return true;
	return false;
}

/* avckpt.files=strict, or auto and a database: from here on, all writes to files are detected.  They
 * count for this generation.  One that was taken before the database was opened knows nothing of its
 * contents. */
static void watch_files(struct avc_guard *guard, struct generation *fresh, struct leases *leases)
{
	const bool strict = guard->config.files == AVC_FILES_STRICT;
	struct image *main = &fresh->image[0];
	struct process *process = main->process;
	struct avc_error untold = { 0 };

	fresh->watched = strict || (guard->config.files == AVC_FILES_AUTO && is_database(guard));
	if (!fresh->watched && !is_watched(guard)) {
		files_written_free(guard->written);
		guard->written = NULL;
		return;
	}
	if (!guard->written)
		guard->written = files_written_new();
	if (guard->written)
		files_written_watch(guard->written, process->pid, strict ? &main->notice : &untold);
	if (strict)
		main->mapped = files_mapped_prepare(process->pid, process->shm_bytes, leases);
}

/* Work that a restore would have to do is done ahead, when the guard is idle. */
static void begin_ahead(struct avc_guard *guard, struct generation *fresh)
{
	const uint64_t interval_ns = policy_interval(&guard->pace, &guard->config);
	struct avc_error later = { 0 };

	guard->ahead_ns = now_ns();
	if (!stand_in_is_there(&guard->dirty, fresh))
		guard->ahead_ns += AHEAD_AFTER_NS;
	if (fresh->images > 1 &&
	    restore_plan_begin(fresh, interval_ns ? interval_ns / INHERIT_SHARE : UINT64_MAX,
			       &later))
		guard->ahead_ns = UINT64_MAX; /* out of memory */
}

/* Where checkpoints are copies, a spare is not made after each of them but, for example, after a
 * restore: it may take its share of the time since the last one. */
static bool may_make_spare(const struct avc_guard *guard, const struct generation *newest)
{
	const uint64_t interval_ns = policy_interval(&guard->pace, &guard->config);

	return !interval_ns || newest->clone_ns <= interval_ns / SPARE_SHARE ||
	       (newest->image[0].inherited &&
		newest->clone_ns <= (now_ns() - guard->spare_ns) / SPARE_SHARE);
}

static bool wants_spare(const struct avc_guard *guard, const struct generation *newest)
{
	return !newest->spare.tried && !newest->spare.unwanted && !guard->cramped &&
	       now_ns() >= guard->policy.spares_ns && may_make_spare(guard, newest) &&
	       (!stand_in_is_there(&guard->dirty, newest) ||
		dirty_wants_spare(&guard->dirty, newest));
}

static void make_spare(struct avc_guard *guard, struct generation *newest)
{
	struct avc_error error = { 0 };

	if (!last_pid_lock(guard->channel.numbers_fd, false))
		return;
	guard->spare_ns = now_ns();
	tracee_deadline_set(guard->timer, SPARE_NS);
	/* guard_reap_dead() handles a template that was killed. */
	if (spare_make(newest, &error) && error.code != AVC_GONE &&
	    !pidfd_ended(newest->image[0].pidfd))
		guard_lose_generation(guard, guard->count - 1, AVC_REASON_KILLED, 0);
	tracee_deadline_clear(guard->timer);
	last_pid_unlock(guard->channel.numbers_fd);
}

/* It may be in our PID namespace, and is not to have the number of a dead application whose guard
 * chooses numbers there now. */
static void prepare_helper(const struct avc_guard *guard)
{
	if (!last_pid_lock(guard->channel.numbers_fd, false))
		return;
	last_pid_prepare(guard->channel.init_pidfd);
	last_pid_unlock(guard->channel.numbers_fd);
}

static void work_ahead(struct avc_guard *guard)
{
	struct generation *newest;
	bool more = true;

	guard->ahead_ns = UINT64_MAX;
	if (!guard->count)
		return;
	prepare_helper(guard);
	newest = &guard->generations[guard->count - 1];
	if (wants_spare(guard, newest)) {
		make_spare(guard, newest);
		if (guard->count)
			dirty_drop_stale(&guard->dirty, &guard->generations[guard->count - 1]);
	} else if (stand_in_catch_up(&guard->dirty, newest, guard->timer))
		; /* to be continued before anything else */
	else
		more = !newest->spare.work &&
		       restore_plan_next(newest); /* which reads its memory */
	if (more)
		guard->ahead_ns = now_ns();
}

void guard_work_ahead(struct avc_guard *guard)
{
	guard_pace_begin(guard);
	work_ahead(guard);
	guard_pace_end(guard);
}

/* What can be done before the app is stopped. */
static int prepare_freeze(struct avc_guard *guard, struct freeze *freeze, struct avc_error *err)
{
	struct image *main = &freeze->generation->image[0];

	if (prepare_files(guard, err) ||
	    memory_prepare(main->process, &main->memory, &freeze->seen, err))
		return -1;
	/* For those of its children, too, that the freeze finds. */
	if (guard->config.files == AVC_FILES_STRICT)
		leases_read(&freeze->seen.leases);
	for (uint32_t i = 0; i < guard->tree.count; i++)
		if (guard->tree.entry[i].process)
			memory_note_leases(guard->tree.entry[i].process, &freeze->seen);
	watch_files(guard, freeze->generation, &freeze->seen.leases);
	if (guard->count)
		dirty_take_spare(&guard->dirty, &guard->generations[guard->count - 1]);
	dirty_prepare(&guard->dirty, &guard->tree, &guard->config, guard_why_fork(guard),
		      main->slot, guard->timer);
	for (uint32_t i = 0; i < guard->tree.count; i++) {
		const struct process *process = guard->tree.entry[i].process;

		if (process && process->infected)
			touch_slot(&process->parasite, main->slot, process->thread_count);
	}
	wait_quiescent(guard, &freeze->generation->quiescent);
	return 0;
}

/* From here on with real-time priority: where several are stopped in one instant, whoever gets its
 * CPU late keeps all others stopped. */
static int stop_and_freeze(struct avc_guard *guard, struct freeze *freeze, struct avc_error *err)
{
	int result;

	if (guard->meeting && guard_meet_ready(guard, err))
		return -1;
	for (uint32_t i = 0; i < guard->tree.count; i++)
		if (guard->tree.entry[i].process)
			waits_prepare(guard->tree.entry[i].process);
	budget_deadline(READ_NS);
	/* Writes between here and the freeze count as later than it. */
	guard_note_written(guard);
	if (lock_numbers(guard, err))
		return -1;
	result = freeze_tree(freeze, err);
	last_pid_unlock(guard->channel.numbers_fd);
	return result;
}

static int finish(struct avc_guard *guard, struct generation *fresh, struct avc_error *err)
{
	int result;

	if (generation_files_error(fresh, err) ||
	    files_fill_heirs(fresh->image, fresh->images, err))
		return -1;
	if (faults_heard(&guard->faults))
		return fail(err, AVC_DEADLINE, 0, guard->main.pid, "freeze", "",
			    "it has just handled a fault, and may be dying");
	tracee_deadline_set(guard->timer, NS_PER_S + fresh->images * TEMPLATE_NS);
	result = dirty_apply(&guard->dirty, fresh, err);
	if (!result)
		result = generation_finish(fresh, err);
	if (!result)
		result = dirty_check(&guard->dirty, fresh, err);
	if (!result)
		result = files_check_heirs(fresh->image, fresh->images, err);
	tracee_deadline_clear(guard->timer);
	return result;
}

/* The app runs again, and decides how long this takes. */
static int settle_files(struct avc_guard *guard, struct generation *fresh, struct avc_error *err)
{
	const struct generation *before = guard->count ? &guard->generations[guard->count - 1]
						       : NULL;

	budget_deadline(READ_NS);
	for (uint32_t i = 0; i < fresh->images; i++)
		if (fresh->image[i].process)
			files_settle(&fresh->image[i]);
	if (fresh->images > 1)
		files_settle_family(fresh->image, fresh->images, before ? before->image : NULL,
				    before ? before->images : 0);
	files_find_own(fresh->image, fresh->images);
	budget_deadline(0);
	return budget_check(guard->main.pid, err);
}

static int take_by(struct avc_guard *guard, struct freeze *freeze, struct avc_event *event,
		   struct avc_error *err)
{
	struct generation *fresh = freeze->generation;
	int result;

	if (prepare_freeze(guard, freeze, err)) {
		generation_drop(fresh);
		return -1;
	}
	rt_priority_begin();
	result = stop_and_freeze(guard, freeze, err);
	rt_priority_end();
	budget_deadline(0);
	if (!result)
		result = budget_check(guard->main.pid, err);
	guard->held_ns += freeze->freeze_ns;
	event->freeze_ns = freeze->freeze_ns;
	event->stop_ns = freeze->stop_ns;
	event->clone_ns = freeze->clone_ns;
	event->wait_ns = freeze->wait_ns;
	event->threads = generation_threads(fresh);
	if (result || finish(guard, fresh, err) || settle_files(guard, fresh, err) ||
	    (guard->meeting && guard_meet_taken(guard, err))) {
		abandon(guard, fresh);
		return -1;
	}
	event->at_ns = fresh->taken_ns;
	event->error = *generation_notice(fresh);
	fresh->number = ++guard->number;
	if (!guard->main.recycling)
		guard->dirty.fork_ns = freeze->clone_ns;
	dirty_follow(&guard->dirty, fresh);
	fresh->clone_ns = guard->dirty.fork_ns;
	fresh->freeze_ns = freeze->freeze_ns;
	event->replaced = guard_keep_generation(guard, fresh);
	dirty_compare(&guard->dirty, fresh);
	begin_ahead(guard, &guard->generations[guard->count - 1]);
	init_channel_arm(&guard->channel, true);
	event->images = guard->dirty.reason ? AVC_IMAGES_FORK : AVC_IMAGES_DIRTY;
	event->fork_reason = guard->dirty.reason;
	event->copied = guard->dirty.copied;
	event->generation = fresh->number;
	event->line = guard->line;
	event->generations = guard->count;
	event->quiescent = fresh->quiescent;
	guard_tend_tree(guard);
	return 0;
}

static int take_once(struct avc_guard *guard, struct avc_event *event, struct avc_error *err)
{
	struct generation fresh;
	struct freeze freeze = { .tree = &guard->tree,
				 .generation = &fresh,
				 .dirty = &guard->dirty,
				 .timer = guard->timer,
				 .deadline_ns = guard->config.freeze_deadline_ns };
	int result;

	if (generation_new(&fresh, &guard->main, guard_free_slot(guard), err))
		return -1;
	if (guard->meeting) {
		freeze.meet = guard_meet_frozen;
		freeze.arg = guard;
	}
	result = take_by(guard, &freeze, event, err);
	mem_seen_free(&freeze.seen);
	return result;
}

/* A limit on processes or memory leaves no room for a template: drops spares and idle templates,
 * and waits for processes that are ending. */
static bool make_way(struct avc_guard *guard, const struct avc_error *err)
{
	if (err->code != AVC_LIMIT)
		return false;
	dirty_drop_idle(&guard->dirty);
	guard_release_oldest_remains(guard, 1);
	guard_await_spares(guard);
	for (uint32_t i = 0; i < guard->count; i++) {
		if (guard->generations[i].spare.pid)
			(void)policy_crowded(&guard->policy, now_ns());
		spare_drop(&guard->generations[i]);
	}
	if (tracee_ending_pidfd(0) < 0)
		return false;
	guard_wait_ended(guard);
	return true;
}

/* With hundreds of processes a checkpoint can take longer than init waits for an answer to a death:
 * then it is given up. */
static void look_at_main(void *arg)
{
	struct avc_guard *guard = arg;

	if (!guard->main.pid || now_ns() - guard->looked_ns < LOOK_NS)
		return;
	guard->looked_ns = now_ns();
	if (proc_is_exiting(guard->main.pid))
		budget_exceed(AVC_GONE, "it has ended");
}

static int take(struct avc_guard *guard, struct avc_event *event, struct avc_error *err)
{
	guard->looked_ns = now_ns();
	for (int tries = 1;; tries++) {
		*err = (struct avc_error){ 0 };
		budget_begin(look_at_main, guard);
		if (prepare(guard, err) == 0) {
			guard_filter(guard);
			if (take_once(guard, event, err) == 0)
				return 0;
		}
		if (tries < TAKE_TRIES && guard_may_meet(guard) &&
		    (make_way(guard, err) || err->code == AVC_RETRY))
			continue;
		if (err->code == AVC_RETRY)
			err->code = AVC_DEADLINE;
		return -1;
	}
}

/* However short its interval is: the app runs for at least as long as it was just stopped. */
static void let_it_run(struct avc_guard *guard)
{
	guard->next_ns = policy_due_after(guard->next_ns,
					  policy_rest(guard->held_ns, guard->writes_ns), now_ns());
}

/* One was missed.  avckpt.interval=auto has pauses of its own (guard_pace_missed()). */
static void try_soon(struct avc_guard *guard)
{
	if (!policy_is_automatic(&guard->config))
		guard->next_ns = policy_without(&guard->policy, guard->next_ns, now_ns());
	let_it_run(guard);
}

/* What the attempt had found out is in `event`. */
static void miss(struct avc_guard *guard, uint64_t ticket, struct avc_event *event,
		 const struct avc_error *error)
{
	guard_pace_missed(guard);
	faults_settle(&guard->faults, &guard->tree, guard->next_ns);
	if (seccomp_must_suspend()) {
		guard->next_ns = now_ns(); /* guard_main() ends it, which is told */
		if (!ticket)
			return;
	}
	if (error->code == AVC_GONE)
		guard->dying_until_ns = now_ns() + DYING_NS;
	/* If the app has died, init's report follows: only a command needs an answer. */
	if (error->code == AVC_GONE && guard->main.pid && pidfd_ended(guard->main.pidfd)) {
		if (ticket)
			guard_emit_error(guard, AVC_EVENT_MISSED, ticket, error);
		return;
	}
	if (policy_missed(&guard->policy, error->code, error->pid == guard->main.pid, now_ns())) {
		if (!seccomp_must_suspend())
			guard->next_ns = policy_refused(&guard->policy, guard->next_ns, now_ns());
		guard_unprotect(guard, ticket, error);
		return;
	}
	try_soon(guard);
	/* At a limit of its own (RLIMIT_NPROC) the app needs them more, and each attempt makes clone(2)
	 * fail for it. */
	if (error->code == AVC_LIMIT && !guard->count) {
		let_go_of_holders(guard);
		guard->next_ns = policy_refused(&guard->policy, guard->next_ns, now_ns());
	}
	event->kind = AVC_EVENT_MISSED;
	event->generations = guard->count; /* with a new parasite, all may have been dropped */
	event->ticket = ticket;
	event->error = *error;
	guard_emit(guard, event);
}

void guard_checkpoint(struct avc_guard *guard, uint64_t ticket)
{
	struct avc_event event = guard_event(guard, AVC_EVENT_CHECKPOINT);
	struct avc_error error = { 0 };

	guard->next_ns = policy_due(&guard->config, now_ns());
	if (init_channel_stop_asked(&guard->channel)) {
		if (ticket)
			guard_refuse(guard, ticket, AVC_GONE,
				     "the application has been asked to stop");
		return;
	}
	if (!guard->policy.room) {
		if (ticket)
			guard_refuse(guard, ticket, AVC_BUSY,
				     "memory is short, so no generation is held");
		return;
	}
	guard->held_ns = guard->writes_ns = 0;
	if (guard_app_is_full(guard)) {
		fail(&error, AVC_LIMIT, 0, guard->main.pid, "checkpoint", "",
		     "it fills the memory of its container: what it had before is kept");
		guard_emit_error(guard, AVC_EVENT_MISSED, ticket, &error);
		try_soon(guard);
		return;
	}
	if (ticket)
		policy_retry(&guard->policy);
	guard_pace_begin(guard);
	if (take(guard, &event, &error)) {
		miss(guard, ticket, &event, &error);
		return;
	}
	guard->hold_ns = UINT64_MAX; /* all have one */
	event.ticket = ticket;
	event.app_pid = guard->main.leader;
	event.app_pid_inside = guard->main.inside;
	guard_pace_taken(guard, &event);
	let_it_run(guard);
	faults_settle(&guard->faults, &guard->tree, guard->next_ns);
	guard_tell_taken(guard, &event);
	guard->unprotected = false;
}
