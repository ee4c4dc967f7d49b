/* SPDX-License-Identifier: Apache-2.0
 *
 * The guard: one thread per container that waits, decides and reports.  It makes
 * every ptrace call for its container, so that it may.
 */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/prctl.h>
#include <unistd.h>

#include "guard.h"

#define LOOK_AGAIN_NS (20 * NS_PER_MS)   /* for init to set itself up        */
#define LOOK_SELDOM_NS (250 * NS_PER_MS) /* after LOOK_OFTEN_NS of that      */
#define LOOK_OFTEN_NS (5 * NS_PER_S)
#define STRAGGLER_NS (NS_PER_MS / 5)
#define STRAGGLER_LONG_NS (20 * NS_PER_MS)

/* ---- telling ---------------------------------------------------------------- */

struct avc_event event_new(const struct avc_guard *guard, enum avc_event_kind kind)
{
	return (struct avc_event){
		.kind = kind,
		.cookie = guard->cookie,
		.at_ns = now_ns(),
		.app_pid = guard->target.leader,
		.app_pid_inside = guard->target.inside,
		.generations = guard->count,
		.restores = guard->restores,
	};
}

void emit(struct avc_guard *guard, const struct avc_event *event)
{
	engine_emit(guard->engine, event);
}

void emit_error(struct avc_guard *guard, enum avc_event_kind kind, uint64_t ticket,
		const struct avc_error *error)
{
	struct avc_event event = event_new(guard, kind);

	event.ticket = ticket;
	event.error = *error;
	emit(guard, &event);
}

void refuse(struct avc_guard *guard, uint64_t ticket, enum avc_code code, const char *why)
{
	struct avc_error error = { 0 };

	fail(&error, code, 0, guard->target.pid, "command", "", "%s", why);
	emit_error(guard, AVC_EVENT_REFUSED, ticket, &error);
}

/* ---- commands -------------------------------------------------------------------- */

static void drop_oldest(struct avc_guard *guard, uint64_t ticket)
{
	if (!guard->count) {
		guard->room = 0;
		refuse(guard, ticket, AVC_EMPTY, "no generation is held");
		return;
	}
	guard->room = guard->count - 1;
	lose_generation(guard, dispensable(guard, false), AVC_REASON_MEMORY, ticket);
}

static void refill(struct avc_guard *guard)
{
	if (guard->room == guard->config.keep)
		return;
	guard->room = guard->config.keep;
	if (!guard->count && guard->config.interval_ns)
		guard->next_ns = now_ns();
}

static void vouch(struct avc_guard *guard)
{
	guard->vouching = true;
	guard->proved = true;
	/* A check that has just passed may have looked at something that a hung app
	 * left a moment ago: what was taken since the last one waits for the next. */
	for (uint32_t i = 0; i < guard->count; i++) {
		guard->generations[i].vouched |= guard->generations[i].seen;
		guard->generations[i].seen = true;
	}
}

static void unvouch(struct avc_guard *guard)
{
	guard->vouching = false;
	for (uint32_t i = 0; i < guard->count; i++)
		guard->generations[i].vouched = guard->generations[i].seen = false;
}

static void roll_back(struct avc_guard *guard, uint64_t ticket, enum avc_reason reason)
{
	struct avc_error error = { 0 };

	if (!guard->count || !guard->target.pid) {
		refuse(guard, ticket, AVC_EMPTY, "no generation is held yet");
		return;
	}
	if (init_channel_stop_asked(&guard->channel)) {
		refuse(guard, ticket, AVC_GONE, "the application has been asked to stop");
		return;
	}
	/* An app that hangs is better started anew than left as it is. */
	if (reason == AVC_REASON_COMMAND &&
	    check_strict(guard, &guard->generations[guard->count - 1], guard->target.pid,
			 guard->target.pidfd, &error)) {
		emit_error(guard, AVC_EVENT_REFUSED, ticket, &error);
		return;
	}
	guard->restore_asked = reason;
	guard->restore_ticket = ticket;
	/* init reports the death; the rest is as after any other. */
	target_kill(&guard->target);
}

static bool take_command(struct avc_guard *guard, struct command *command)
{
	bool found = false;

	pthread_mutex_lock(&guard->lock);
	if (guard->command_count) {
		*command = guard->commands[0];
		memmove(guard->commands, guard->commands + 1,
			--guard->command_count * sizeof *guard->commands);
		found = true;
	}
	pthread_mutex_unlock(&guard->lock);
	return found;
}

static void obey(struct avc_guard *guard, const struct command *command)
{
	switch (command->command) {
	case AVC_COMMAND_CHECKPOINT:
		checkpoint(guard, command->ticket);
		break;
	case AVC_COMMAND_RESTORE:
		roll_back(guard, command->ticket, AVC_REASON_COMMAND);
		break;
	case AVC_COMMAND_UNHEALTHY:
		roll_back(guard, command->ticket, AVC_REASON_UNHEALTHY);
		break;
	case AVC_COMMAND_DROP_OLDEST:
		drop_oldest(guard, command->ticket);
		break;
	case AVC_COMMAND_REFILL:
		refill(guard);
		break;
	case AVC_COMMAND_VOUCH:
		vouch(guard);
		break;
	case AVC_COMMAND_UNVOUCH:
		unvouch(guard);
		break;
	}
}

static void carry_out(struct avc_guard *guard)
{
	struct command command;
	eventfd_t ignored;

	(void)eventfd_read(guard->wake_fd, &ignored);
	take_config(guard);
	while (take_command(guard, &command)) {
		if (!guard->attached)
			refuse(guard, command.ticket, AVC_EMPTY, "avckpt-init has not started yet");
		else
			obey(guard, &command);
	}
}

/* ---- the thread --------------------------------------------------------------------- */

static bool must_stop(struct avc_guard *guard)
{
	bool stop;

	pthread_mutex_lock(&guard->lock);
	stop = guard->stop;
	pthread_mutex_unlock(&guard->lock);
	return stop;
}

/* Until init has set itself up: the hook runs before the container does. */
static void attach(struct avc_guard *guard)
{
	struct avc_error error = { 0 };
	const uint64_t now = now_ns();

	switch (init_channel_open(&guard->channel, &error)) {
	case 1:
		if (find_app(guard, &error)) {
			init_channel_close(&guard->channel);
			break;
		}
		guard->attached = true;
		guard->unprotected = false;
		guard->next_ns = interval_end(guard);
		{
			const struct avc_event event = event_new(guard, AVC_EVENT_ATTACHED);

			emit(guard, &event);
		}
		return;
	case -1:
		unprotect(guard, 0, &error);
	}
	guard->next_ns = now +
			 (now - guard->started_ns < LOOK_OFTEN_NS ? LOOK_AGAIN_NS : LOOK_SELDOM_NS);
}

static void watch(struct avc_guard *guard, nfds_t *n, int fd)
{
	if (*n == guard->fds_room) {
		struct pollfd *more = realloc(guard->fds, 2 * (*n + 32) * sizeof *more);

		if (!more)
			return; /* its news will be seen with the next */
		guard->fds = more;
		guard->fds_room = 2 * (*n + 32);
	}
	guard->fds[(*n)++] = (struct pollfd){ .fd = fd, .events = POLLIN };
}

uint32_t all_stragglers(struct avc_guard *guard)
{
	uint32_t left = stragglers(&guard->target);

	for (uint32_t i = 0; i < guard->tree.members; i++)
		left += stragglers(guard->tree.member[i]);
	return left;
}

static bool any_lost(const struct avc_guard *guard)
{
	bool lost = guard->target.lost;

	for (uint32_t i = 0; i < guard->tree.members; i++)
		lost |= guard->tree.member[i]->lost;
	return lost;
}

/* Calls of the app's that a checkpoint has interrupted.  When the first of those that are
 * left is to be ended. */
static uint64_t end_waits(struct avc_guard *guard)
{
	uint64_t due;

	waits_end(&guard->target, guard->timer);
	due = guard->target.due_ns;
	for (uint32_t i = 0; i < guard->tree.members; i++) {
		waits_end(guard->tree.member[i], guard->timer);
		if (guard->tree.member[i]->due_ns < due)
			due = guard->tree.member[i]->due_ns;
	}
	return due;
}

static void wait_for_news(struct avc_guard *guard, bool straggling)
{
	const uint64_t waits_ns = end_waits(guard);
	const uint64_t now = now_ns();
	const uint64_t check_ns = exec_check_due(guard);
	const uint64_t ahead_ns = tracee_ending_pidfd(0) < 0 ? guard->ahead_ns
							     : tracee_ending_due();
	const uint64_t sooner_ns = check_ns < ahead_ns ? check_ns : ahead_ns;
	const uint64_t soon_ns = waits_ns < sooner_ns ? waits_ns : sooner_ns;
	const uint64_t due = guard->next_ns < soon_ns ? guard->next_ns : soon_ns;
	uint64_t ns = due > now ? due - now : 0;
	struct timespec timeout;
	nfds_t n = 0;

	watch(guard, &n, guard->wake_fd);
	watch(guard, &n, guard->channel.init_pidfd);
	watch(guard, &n, guard->channel.report_fd);
	watch(guard, &n, guard->target.holder_pidfd);
	for (uint32_t i = 0; i < guard->tree.members; i++) {
		watch(guard, &n, guard->tree.member[i]->pidfd);
		watch(guard, &n, guard->tree.member[i]->holder_pidfd);
	}
	for (uint32_t i = 0; i < guard->count; i++) {
		watch(guard, &n, guard->generations[i].pidfd);
		if (guard->generations[i].spare.pid)
			watch(guard, &n, guard->generations[i].spare.pidfd);
		for (uint32_t k = 0; k < guard->generations[i].branches; k++)
			if (guard->generations[i].branch[k].image)
				watch(guard, &n, guard->generations[i].branch[k].image->pidfd);
	}
	for (uint32_t i = 0; tracee_ending_pidfd(i) >= 0; i++)
		watch(guard, &n, tracee_ending_pidfd(i));
	if (straggling) {
		const bool fresh = now - guard->stragglers_since_ns < NS_PER_S;
		const uint64_t slice = fresh ? STRAGGLER_NS : STRAGGLER_LONG_NS;

		ns = ns < slice ? ns : slice;
	}
	timeout = (struct timespec){ .tv_sec = (time_t)(ns / NS_PER_S),
				     .tv_nsec = (long)(ns % NS_PER_S) };
	(void)ppoll(guard->fds, n, due == UINT64_MAX && !straggling ? NULL : &timeout, NULL);
}

/* Nobody is to believe that there are checkpoints when there are none. */
static void tell_straggling(struct avc_guard *guard)
{
	const uint64_t now = now_ns();
	struct avc_error error = { 0 };

	guard->next_ns = now + STRAGGLER_LONG_NS;
	if (now - guard->told_stragglers_ns < NS_PER_S)
		return;
	guard->told_stragglers_ns = now;
	fail(&error, AVC_DEADLINE, 0, guard->target.pid, "stop", "",
	     "a thread that was to stop has not done so for a second");
	emit_error(guard, AVC_EVENT_MISSED, 0, &error);
}

static void let_go(struct avc_guard *guard)
{
	const uint64_t end = now_ns() + NS_PER_S;

	if (guard->channel.ctl)
		init_channel_arm(&guard->channel, false);
	drop_all(guard);
	unhold(&guard->target);
	for (uint32_t i = 0; i < guard->tree.members; i++)
		unhold(guard->tree.member[i]);
	/* The end of this thread detaches what is left. */
	tracee_end_now();
	while (((guard->target.threads && all_stragglers(guard)) || tracee_reap_ending()) &&
	       now_ns() < end)
		usleep(200);
	tree_free(&guard->tree);
	target_close(&guard->target);
	parasite_close(&guard->target.parasite);
	init_channel_close(&guard->channel);
	close_fd(&guard->channel.init_pidfd);
}

static void *guard_main(void *arg)
{
	struct avc_guard *guard = arg;
	struct avc_error error = { 0 };
	bool ended = false;

	prctl(PR_SET_NAME, "avckpt-guard");
	if (tracee_timer_new(&guard->timer, &error)) {
		emit_error(guard, AVC_EVENT_UNPROTECTED, 0, &error);
		ended = true;
	}
	while (!ended && !must_stop(guard)) {
		const uint32_t straggling = all_stragglers(guard);
		const bool dying = now_ns() < guard->dying_until_ns;
		struct avc_report report;

		if (!straggling && !dying)
			guard->stragglers_since_ns = now_ns();
		if (!straggling)
			guard->told_stragglers_ns = now_ns(); /* there are none */
		if (any_lost(guard))
			kill_lost(guard);
		if (dying)
			reap_unknown(guard);
		wait_for_news(guard, straggling || dying);
		if (guard->attached && init_channel_report(&guard->channel, &report)) {
			died(guard, &report);
			continue;
		}
		reap_dead(guard);
		tend_tree(guard);
		if (pidfd_ended(guard->channel.init_pidfd)) {
			ended = true;
			break;
		}
		carry_out(guard);
		if (now_ns() >= guard->ahead_ns && tracee_ending_pidfd(0) < 0)
			work_ahead(guard);
		if (now_ns() < guard->next_ns)
			continue;
		if (!guard->attached)
			attach(guard);
		else if (all_stragglers(guard))
			tell_straggling(guard);
		else
			checkpoint(guard, 0);
	}
	let_go(guard);
	timer_delete(guard->timer);
	pthread_mutex_lock(&guard->lock);
	guard->ended = true;
	pthread_mutex_unlock(&guard->lock);
	if (ended) {
		const struct avc_event event = event_new(guard, AVC_EVENT_ENDED);

		emit(guard, &event);
	}
	return NULL;
}

/* ---- the interface ---------------------------------------------------------------------- */

struct avc_guard *avc_guard_start(struct avc_engine *engine, const struct avc_config *config,
				  uint64_t cookie, struct avc_error *err)
{
	struct avc_guard *guard = NULL;
	int result;

	*err = (struct avc_error){ 0 };
	if (config_check(config, err))
		return NULL;
	guard = calloc(1, sizeof *guard);
	if (!guard) {
		fail_errno(err, 0, "start guard", "calloc", "out of memory");
		return NULL;
	}
	guard->engine = engine;
	guard->cookie = cookie;
	guard->room = config->keep;
	guard->started_ns = now_ns();
	pthread_mutex_init(&guard->lock, NULL);
	init_channel_init(&guard->channel);
	target_init(&guard->target);
	guard->tree = (struct tree){
		.main = &guard->target,
		.slots = config->keep + 1,
		.kin = calloc(PROCESSES_MAX, sizeof *guard->tree.kin),
		.member = calloc(2 * PROCESSES_MAX, sizeof *guard->tree.member),
		.is_ours = is_ours,
		.arg = guard,
	};
	config_set(guard, config);
	guard->channel.init_pidfd = fcntl(config->init_pidfd, F_DUPFD_CLOEXEC, 3);
	guard->wake_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
	if (!target_make_room(&guard->target) || !guard->tree.kin || !guard->tree.member ||
	    guard->channel.init_pidfd < 0 || guard->wake_fd < 0) {
		fail_errno(err, 0, "start guard", "eventfd", "out of memory or descriptors");
		goto failed;
	}
	result = pthread_create(&guard->thread, NULL, guard_main, guard);
	if (result) {
		errno = result;
		fail_errno(err, 0, "start guard", "pthread_create", "no thread");
		goto failed;
	}
	return guard;
failed:
	close_fd(&guard->channel.init_pidfd);
	close_fd(&guard->wake_fd);
	target_free_room(&guard->target);
	tree_free(&guard->tree);
	free(guard->fds);
	free(guard);
	return NULL;
}

int avc_guard_command(struct avc_guard *guard, enum avc_command command, uint64_t ticket,
		      struct avc_error *err)
{
	int result = 0;

	*err = (struct avc_error){ 0 };
	if (command < AVC_COMMAND_CHECKPOINT || command > AVC_COMMAND_UNVOUCH)
		return fail(err, AVC_CONFIG, EINVAL, 0, "command", "", "no such command");
	pthread_mutex_lock(&guard->lock);
	if (guard->ended)
		result = fail(err, AVC_GONE, ESRCH, 0, "command", "", "the container has ended");
	else if (guard->command_count == COMMANDS_MAX)
		result = fail(err, AVC_BUSY, EAGAIN, 0, "command", "",
			      "too many commands are waiting");
	else
		guard->commands[guard->command_count++] = (struct command){ command, ticket };
	pthread_mutex_unlock(&guard->lock);
	if (!result)
		eventfd_write(guard->wake_fd, 1);
	return result;
}

void avc_guard_stop(struct avc_guard *guard)
{
	pthread_mutex_lock(&guard->lock);
	guard->stop = true;
	pthread_mutex_unlock(&guard->lock);
	eventfd_write(guard->wake_fd, 1);
	pthread_join(guard->thread, NULL);
	files_written_free(guard->written);
	close_fd(&guard->wake_fd);
	pthread_mutex_destroy(&guard->lock);
	target_free_room(&guard->target);
	tree_free(&guard->tree);
	free(guard->fds);
	free(guard);
}
