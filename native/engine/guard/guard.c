/* SPDX-License-Identifier: Apache-2.0
 *
 * The guard: one process per container, whose main thread waits, decides and reports.
 * It makes every ptrace call: a process can only be traced by one thread.
 */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

#include "guard.h"

#define LOOK_AGAIN_NS (20 * NS_PER_MS)   /* whether init is ready            */
#define LOOK_SELDOM_NS (250 * NS_PER_MS) /* after LOOK_OFTEN_NS of that      */
#define LOOK_OFTEN_NS (5 * NS_PER_S)
#define LEFT_NS (2 * NS_PER_S) /* helpers of a guard that was killed have ended */
#define STRAGGLER_NS (NS_PER_MS / 5)
#define STRAGGLER_LONG_NS (20 * NS_PER_MS)
#define UNPOLLED_US 10000
#define LAST_WORDS_NS NS_PER_S
#define SEEN_NS (200 * NS_PER_MS)     /* for the daemon to look at the memory of the dead */
#define REQUEST_FDS 2                 /* sent with one, at most                                  */
#define DEAD_LOOK_NS (50 * NS_PER_MS) /* while it waits for its group: init is notified */
#define GUARD_UNTOLD 3 /* exit status: no valid start message from the same build      */

/* ---- events ----------------------------------------------------------------- */

struct avc_event guard_event(const struct avc_guard *guard, enum avc_event_kind kind)
{
	return (struct avc_event){
		.kind = kind,
		.cookie = guard->cookie,
		.at_ns = now_ns(),
		.app_pid = guard->main.leader,
		.app_pid_inside = guard->main.inside,
		.generations = guard->count,
		.restores = guard->restores,
	};
}

/* A daemon that does not read must not block the guard: events that the socket has no room for
 * wait here, and when this is full, the oldest are lost. */
void guard_send_posted(struct avc_guard *guard)
{
	uint32_t sent = 0;

	while (sent < guard->outbox_count &&
	       (send(guard->socket, &guard->outbox[sent], sizeof guard->outbox[sent],
		     MSG_DONTWAIT | MSG_NOSIGNAL) >= 0 ||
		(errno != EAGAIN && errno != ENOBUFS)))
		sent++;
	guard->outbox_count -= sent;
	memmove(guard->outbox, guard->outbox + sent, guard->outbox_count * sizeof *guard->outbox);
}

static void post(struct avc_guard *guard, const struct avc_event *event)
{
	if (guard->outbox_count == OUTBOX_MAX)
		memmove(guard->outbox, guard->outbox + 1,
			--guard->outbox_count * sizeof *guard->outbox);
	guard->outbox[guard->outbox_count++] = *event;
}

void guard_post(struct avc_guard *guard, const struct avc_event *event)
{
	struct avc_event before;

	if (guard_take_untold(guard, &before)) /* in order */
		post(guard, &before);
	post(guard, event);
}

void guard_emit(struct avc_guard *guard, const struct avc_event *event)
{
	guard_post(guard, event);
	guard_send_posted(guard);
}

void guard_emit_error(struct avc_guard *guard, enum avc_event_kind kind, uint64_t ticket,
		      const struct avc_error *error)
{
	struct avc_event event = guard_event(guard, kind);

	event.ticket = ticket;
	event.error = *error;
	guard_emit(guard, &event);
}

void guard_refuse(struct avc_guard *guard, uint64_t ticket, enum avc_code code, const char *why)
{
	struct avc_error error = { 0 };

	fail(&error, code, 0, guard->main.pid, "command", "", "%s", why);
	guard_emit_error(guard, AVC_EVENT_REFUSED, ticket, &error);
}

/* ---- commands -------------------------------------------------------------------- */

static void drop_oldest(struct avc_guard *guard, uint64_t ticket)
{
	policy_shrink(&guard->policy);
	dirty_drop_idle(&guard->dirty); /* worth less than any generation */
	if (!guard->count) {
		guard_refuse(guard, ticket, AVC_EMPTY, "no generation is held");
		return;
	}
	guard_lose_generation(guard, policy_dispensable(&guard->policy), AVC_REASON_MEMORY, ticket);
}

static void refill(struct avc_guard *guard)
{
	if (policy_refill(&guard->policy, &guard->config))
		guard->next_ns = now_ns();
}

static void roll_back(struct avc_guard *guard, const struct avc_request *request,
		      enum avc_reason reason)
{
	const uint64_t ticket = request->ticket;
	const int i = request->generation ? guard_find_generation(guard, request->generation)
					  : (int)guard->count - 1;
	struct avc_error error = { 0 };

	if (!guard->count || !guard->main.pid) {
		guard_refuse(guard, ticket, AVC_EMPTY, "no generation is held yet");
		return;
	}
	if (i < 0) {
		guard_refuse(guard, ticket, AVC_EMPTY,
			     "that generation is not held: avckpt inspect lists those that are");
		return;
	}
	if (init_channel_stop_asked(&guard->channel)) {
		guard_refuse(guard, ticket, AVC_GONE, "the application has been asked to stop");
		return;
	}
	budget_begin(NULL, NULL);
	/* A hung app is killed in any case: a fresh start is better than the hang. */
	if (reason == AVC_REASON_COMMAND &&
	    guard_check_files(guard, &guard->generations[i], guard->main.pid, guard->main.pidfd,
			      &error)) {
		guard_emit_error(guard, AVC_EVENT_REFUSED, ticket, &error);
		return;
	}
	guard->restore_asked = reason;
	guard->restore_ticket = ticket;
	guard->restore_generation = request->generation;
	/* init reports the death, which is then handled like any other. */
	process_kill(&guard->main);
}

static void list(struct avc_guard *guard, uint64_t ticket)
{
	struct avc_event event = guard_event(guard, AVC_EVENT_HELD);

	event.ticket = ticket;
	if (!guard->count)
		guard_emit(guard, &event);
	for (uint32_t i = 0; i < guard->count; i++) {
		const struct generation *generation = &guard->generations[i];

		event.generation = generation->number;
		event.age_ns = event.at_ns - generation->taken_ns;
		event.freeze_ns = generation->freeze_ns;
		event.threads = generation_threads(generation);
		event.attempt = guard->policy.held[i].crashes;
		guard_emit(guard, &event);
	}
}

static void obey(struct avc_guard *guard, const struct avc_request *request)
{
	const uint64_t ticket = request->ticket;

	if (!guard->attached) {
		guard_refuse(guard, ticket, AVC_EMPTY, "avckpt-init has not started yet");
		return;
	}
	switch ((enum avc_command)request->command) {
	case AVC_COMMAND_ABANDON:
		guard_abandon(guard, ticket);
		break;
	case AVC_COMMAND_CHECKPOINT:
		if (guard->dead.waits) {
			guard_refuse(guard, ticket, AVC_BUSY, "it waits for its group");
			break;
		}
		guard_checkpoint(guard, ticket);
		break;
	case AVC_COMMAND_RESTORE:
		roll_back(guard, request, AVC_REASON_COMMAND);
		break;
	case AVC_COMMAND_UNHEALTHY:
		roll_back(guard, request, AVC_REASON_UNHEALTHY);
		break;
	case AVC_COMMAND_DROP_OLDEST:
		drop_oldest(guard, ticket);
		break;
	case AVC_COMMAND_REFILL:
		refill(guard);
		break;
	case AVC_COMMAND_VOUCH:
		policy_vouch(&guard->policy);
		break;
	case AVC_COMMAND_UNVOUCH:
		policy_unvouch(&guard->policy);
		break;
	case AVC_COMMAND_RELEASE:
		guard_release_remains(guard, (pid_t)ticket);
		break;
	case AVC_COMMAND_SEEN: /* guard_await_seen(); it was restored meanwhile */
		break;
	case AVC_COMMAND_LIST:
		list(guard, ticket);
		break;
	}
}

/* The client has reported a failure by then: a late command must not take effect. */
static void obey_in_time(struct avc_guard *guard, const struct avc_request *request)
{
	if (request->until_ns && now_ns() > request->until_ns)
		guard_refuse(guard, request->ticket, AVC_DEADLINE, "it came too late");
	else
		obey(guard, request);
}

/* ---- the daemon ------------------------------------------------------------------- */

/* Like recvmsg(2); *count: received descriptors, no more than there is room for. */
static ssize_t receive(int socket, struct avc_request *request, int flags, int fds[REQUEST_FDS],
		       size_t *count)
{
	union {
		char bytes[CMSG_SPACE(REQUEST_FDS * sizeof *fds)];
		struct cmsghdr align;
	} control;
	struct iovec data = { request, sizeof *request };
	struct msghdr message = { .msg_iov = &data,
				  .msg_iovlen = 1,
				  .msg_control = &control,
				  .msg_controllen = sizeof control };
	const ssize_t n = recvmsg(socket, &message, flags | MSG_CMSG_CLOEXEC);
	const struct cmsghdr *header = n < 0 ? NULL : CMSG_FIRSTHDR(&message);

	*count = 0;
	if (header && header->cmsg_type == SCM_RIGHTS) {
		*count = (header->cmsg_len - CMSG_LEN(0)) / sizeof *fds;
		memcpy(fds, CMSG_DATA(header), *count * sizeof *fds);
	}
	return n;
}

/* 1: received; 0: none now; -1: there will be no more.  *fd: the descriptor sent with it, or -1. */
static int next_request(struct avc_guard *guard, struct avc_request *request, int *fd)
{
	int fds[REQUEST_FDS];
	size_t count;
	const ssize_t n = receive(guard->socket, request, MSG_DONTWAIT, fds, &count);

	*fd = count ? fds[0] : -1;
	if (count > 1)
		close_fd(&fds[1]); /* only the first message has two */
	if (n < 0)
		return errno == EAGAIN || errno == EINTR ? 0 : -1;
	return n == sizeof *request && request->magic == AVC_GUARD_MAGIC ? 1 : -1;
}

static void carry_out_one(struct avc_guard *guard, const struct avc_request *request, int fd)
{
	struct avc_error error = { 0 };

	switch (request->kind) {
	case AVC_REQUEST_COMMAND:
		obey_in_time(guard, request);
		break;
	case AVC_REQUEST_CONFIGURE:
		if (!config_check(&request->config, &error))
			guard_take_config(guard, &request->config);
		break;
	case AVC_REQUEST_LINE:
		guard_take_line(guard, request, fd);
		break;
	case AVC_REQUEST_RECALL:
		guard_recall(guard, request, fd);
		break;
	}
}

/* An init that ends takes the memory of the dead with it.  Does not carry out anything: what comes
 * before the answer ends the wait. */
void guard_await_seen(struct avc_guard *guard)
{
	const pid_t pid = guard->unseen;
	const uint64_t end = now_ns() + SEEN_NS;
	struct avc_request request;
	size_t count;
	int fds[REQUEST_FDS];

	guard->unseen = 0;
	if (!pid)
		return;
	guard_send_posted(guard);
	for (uint64_t now; (now = now_ns()) < end;) {
		const struct timespec left = timespec_of(end - now);
		struct pollfd socket = { .fd = guard->socket, .events = POLLIN };

		if (ppoll(&socket, 1, &left, NULL) <= 0)
			continue;
		if (receive(guard->socket, &request, MSG_DONTWAIT | MSG_PEEK, fds, &count) ==
			    sizeof request &&
		    !count && request.kind == AVC_REQUEST_COMMAND &&
		    request.command == AVC_COMMAND_SEEN && request.ticket == (uint64_t)pid)
			(void)receive(guard->socket, &request, MSG_DONTWAIT, fds, &count);
		else
			for (size_t i = 0; i < count; i++)
				close_fd(&fds[i]); /* of a peeked message these are duplicates */
		break;
	}
}

static void carry_out(struct avc_guard *guard)
{
	struct avc_request request;
	int found, fd;

	guard_send_posted(guard);
	while ((found = next_request(guard, &request, &fd)) > 0) {
		carry_out_one(guard, &request, fd);
		close_fd(&fd);
	}
	close_fd(&fd);
	guard->stop = found < 0;
}

/* ---- the cycle -------------------------------------------------------------------- */

/* Retried until init is ready: the hook runs before the container does. */
static void attach(struct avc_guard *guard)
{
	struct avc_error error = { 0 };
	const uint64_t now = now_ns();

	switch (init_channel_open(&guard->channel, &error)) {
	case 1:
		/* From a guard that was killed while it waited for init (guard_wait_ended()). */
		rt_priority_reclaim(guard->channel.init);
		if (guard_find_app(guard, &error)) {
			init_channel_close(&guard->channel);
			break;
		}
		guard->attached = true;
		guard->unprotected = false;
		policy_retry(&guard->policy);
		guard->next_ns = policy_first_due(&guard->config, now_ns());
		if (guard->config.late)
			guard->next_ns = policy_without(&guard->policy, guard->next_ns, now_ns());
		{
			const struct avc_event event = guard_event(guard, AVC_EVENT_ATTACHED);

			guard_emit(guard, &event);
		}
		return;
	case -1:
		/* Its helpers share the lock of a guard that was killed, and may wait for a CPU to end. */
		if (error.code != AVC_BUSY || now - guard->started_ns > LEFT_NS)
			guard_unprotect(guard, 0, &error);
	}
	guard->next_ns = now +
			 (now - guard->started_ns < LOOK_OFTEN_NS ? LOOK_AGAIN_NS : LOOK_SELDOM_NS);
}

static void watch(struct avc_guard *guard, nfds_t *n, int fd)
{
	if (*n == guard->fds_room) {
		struct pollfd *more = realloc(guard->fds, 2 * (*n + 32) * sizeof *more);

		if (!more)
			return; /* it is checked with the next event of another one */
		guard->fds = more;
		guard->fds_room = 2 * (*n + 32);
	}
	guard->fds[(*n)++] = (struct pollfd){ .fd = fd, .events = POLLIN };
}

uint32_t guard_tend_stragglers(struct avc_guard *guard)
{
	uint32_t left = 0;

	for (uint32_t i = 0; i < guard->tree.processes; i++)
		left += threads_tend_stragglers(guard->tree.process[i]);
	return left;
}

static bool any_lost(const struct avc_guard *guard)
{
	for (uint32_t i = 0; i < guard->tree.processes; i++)
		if (guard->tree.process[i]->lost)
			return true;
	return false;
}

uint64_t guard_end_waits(struct avc_guard *guard)
{
	uint64_t due = UINT64_MAX;

	for (uint32_t i = 0; i < guard->tree.processes; i++) {
		waits_end(guard->tree.process[i], guard->timer);
		if (guard->tree.process[i]->due_ns < due)
			due = guard->tree.process[i]->due_ns;
	}
	return due;
}

static uint64_t earlier(uint64_t a, uint64_t b)
{
	return a < b ? a : b;
}

/* When there is work even if no descriptor becomes ready. */
static uint64_t work_due(struct avc_guard *guard)
{
	uint64_t due = earlier(guard->next_ns, guard_end_waits(guard));

	due = earlier(due, faults_due(&guard->faults, &guard->tree, guard->next_ns));
	due = earlier(due, guard_tell_due(guard));
	due = earlier(due, guard->hold_ns);
	for (uint32_t i = 0; i < guard->remains_count; i++)
		due = earlier(due, guard->remains[i].until_ns);
	if (guard->dead.waits)
		due = earlier(due, now_ns() + DEAD_LOOK_NS);
	return earlier(due, tracee_ending_pidfd(0) < 0 ? guard->ahead_ns : tracee_ending_due());
}

/* How many descriptors became ready; -1: a tracee has stopped, for which a straggling guard waits, too. */
static int poll_until(struct pollfd *fds, nfds_t n, uint64_t until, bool straggling)
{
	const uint64_t now = now_ns();
	const struct timespec timeout = timespec_of(until > now ? until - now : 0);
	int ready;

	heartbeat_rest(until);
	ready = straggling ? tracee_poll(fds, n, &timeout) : ppoll(fds, n, &timeout, NULL);
	if (ready < 0 && errno == EINVAL) {
		/* They are more than it may have open by now (RLIMIT_NOFILE, poll(2)): looks at all. */
		usleep(UNPOLLED_US);
		ready = 1;
	}
	heartbeat_rest(0);
	heartbeat();
	return ready;
}

/* Whether a descriptor became ready. */
static bool wait_for_news(struct avc_guard *guard, bool straggling)
{
	uint64_t due = work_due(guard);
	nfds_t n = 0;
	int ready;

	watch(guard, &n, guard->socket);
	if (n && guard->outbox_count)
		guard->fds[0].events |= POLLOUT;
	watch(guard, &n, guard->channel.init_pidfd);
	watch(guard, &n, guard->channel.report_fd);
	watch(guard, &n, output_fd(&guard->output));
	for (uint32_t i = 0; i < guard->remains_count; i++)
		watch(guard, &n, guard->remains[i].pidfd);
	for (uint32_t i = 0; i < guard->tree.processes; i++) {
		const struct process *process = guard->tree.process[i];

		/* init reports the end of the main process. */
		if (process->descendant)
			watch(guard, &n, process->pidfd);
		watch(guard, &n, process->holder_pidfd);
		if (!process->exec_sign.over)
			watch(guard, &n, process->exec_sign.fd);
	}
	for (uint32_t i = 0; i < guard->count; i++) {
		if (guard->generations[i].spare.pid)
			watch(guard, &n, guard->generations[i].spare.pidfd);
		for (uint32_t k = 0; k < guard->generations[i].images; k++)
			watch(guard, &n, guard->generations[i].image[k].pidfd);
	}
	for (uint32_t i = 0; tracee_ending_pidfd(i) >= 0; i++)
		watch(guard, &n, tracee_ending_pidfd(i));
	if (straggling) {
		const uint64_t now = now_ns();
		const bool fresh = now - guard->stragglers_since_ns < NS_PER_S;

		due = earlier(due, now + (fresh ? STRAGGLER_NS : STRAGGLER_LONG_NS));
	}
	/* An idle guard only wakes to beat, and to check whether a program was executed. */
	while (!(ready = poll_until(guard->fds, n,
				    earlier(due, earlier(now_ns() + AVC_HEARTBEAT_NS,
							 guard_exec_check_due(guard))),
				    straggling)) &&
	       !guard_let_executed_go(guard, false)) {
		if (now_ns() < due)
			continue;
		if (straggling || !guard_pace_dozes(guard))
			break;
		due = work_due(guard);
	}
	for (nfds_t i = 0; i < n; i++)
		if (guard->fds[i].revents)
			guard_hear_exec(guard, guard->fds[i].fd);
	return ready > 0;
}

/* Without this, users would believe that checkpoints are taken. */
static void tell_straggling(struct avc_guard *guard)
{
	const uint64_t now = now_ns();
	struct avc_error error = { 0 };

	guard->next_ns = now + STRAGGLER_LONG_NS;
	if (now - guard->told_stragglers_ns < NS_PER_S)
		return;
	guard->told_stragglers_ns = now;
	fail(&error, AVC_DEADLINE, 0, guard->main.pid, "stop", "",
	     "a thread that was to stop has not done so for a second");
	guard_tell_unstoppable(guard, &error);
}

/* A checkpoint that is due, of an app that may be dying. */
static bool put_off(struct avc_guard *guard)
{
	const uint64_t until = faults_put_off(&guard->faults, now_ns());

	if (until)
		guard->next_ns = until;
	return until != 0;
}

static void let_go(struct avc_guard *guard)
{
	const uint64_t end = now_ns() + NS_PER_S;

	guard_leave_meeting(guard);
	if (guard->channel.ctl)
		init_channel_arm(&guard->channel, false);
	last_pid_end(guard->helper);
	last_pid_forget();
	output_end(&guard->output);
	faults_end(&guard->faults);
	guard_drop_all(guard);
	guard_release_oldest_remains(guard, 0);
	for (uint32_t i = 0; i < guard->tree.processes; i++)
		process_unhold(guard->tree.process[i]);
	/* When this process exits, the kernel detaches the rest. */
	tracee_end_now();
	while ((guard_tend_stragglers(guard) || tracee_reap_ending()) && now_ns() < end)
		usleep(200);
	dirty_free(&guard->dirty); /* before the tree: it refers to its processes */
	tree_free(&guard->tree);
	process_close(&guard->main);
	parasite_close(&guard->main.parasite);
	init_channel_close(&guard->channel);
	close_fd(&guard->channel.init_pidfd);
}

/* Whoever has ended, and what the daemon asks for.  True: init has ended. */
static bool hear(struct avc_guard *guard, bool news)
{
	if (news || now_ns() >= tracee_ending_due())
		guard_reap_dead(guard);
	else
		dirty_drop_ended(&guard->dirty); /* of which no descriptor is watched */
	guard_tend_remains(guard);
	(void)guard_let_executed_go(guard, false);
	if (news)
		guard_let_ended_go(guard);
	if (news && pidfd_ended(guard->channel.init_pidfd))
		return true;
	if (news)
		carry_out(guard);
	return false;
}

/* What is due. */
static void work(struct avc_guard *guard)
{
	guard_pace_listen(guard);
	if (now_ns() >= guard_tell_due(guard))
		guard_tell_untold(guard);
	if (now_ns() >= guard->hold_ns) {
		rt_priority_begin();
		guard_hold_missing(guard);
		rt_priority_end();
	}
	if (now_ns() >= guard->ahead_ns && tracee_ending_pidfd(0) < 0)
		guard_work_ahead(guard);
	if (now_ns() >= faults_due(&guard->faults, &guard->tree, guard->next_ns))
		faults_arm(&guard->faults, &guard->tree);
	if (now_ns() < guard->next_ns)
		return;
	if (!guard->attached)
		attach(guard);
	else if (guard_tend_stragglers(guard))
		tell_straggling(guard);
	else if (guard_pace_wants(guard) && !put_off(guard))
		guard_checkpoint(guard, 0);
}

static void guard_main(struct avc_guard *guard)
{
	struct avc_error error = { 0 };
	bool ended = false;

	if (tracee_timer_new(&guard->timer, &error)) {
		guard_emit_error(guard, AVC_EVENT_UNPROTECTED, 0, &error);
		ended = true;
	}
	tracee_know(guard_knows_tracee, guard);
	while (!ended && !guard->stop) {
		const uint32_t straggling = guard_tend_stragglers(guard);
		const bool dying = now_ns() < guard->dying_until_ns;
		struct avc_report report;
		bool news;

		if (!straggling && !dying && !tracee_expects_strangers())
			guard->stragglers_since_ns = now_ns();
		if (!straggling)
			guard->told_stragglers_ns = now_ns(); /* reported after a second of them */
		if (any_lost(guard))
			guard_kill_lost(guard);
		if (dying)
			guard_reap_unknown(guard);
		tracee_release_strangers();
		news = wait_for_news(guard, straggling || dying || tracee_expects_strangers());
		if (news && guard->attached && init_channel_report(&guard->channel, &report)) {
			guard_app_died(guard, &report);
			continue;
		}
		ended = hear(guard, news);
		/* It may have reported, and ended, since that was looked for. */
		if (ended && guard->attached && init_channel_report(&guard->channel, &report))
			guard_app_ended(guard, &report);
		if (ended)
			break;
		if (guard->dead.waits)
			guard_tend_dead(guard);
		else if (seccomp_must_suspend())
			break;
		work(guard);
	}
	guard_tell_untold(guard);
	let_go(guard);
	timer_delete(guard->timer);
	if (ended) {
		const struct avc_event event = guard_event(guard, AVC_EVENT_ENDED);

		guard_emit(guard, &event);
	}
}

/* ---- start and end ----------------------------------------------------------------- */

/* The first message; *init_pidfd and *heartbeat_fd are sent with it. */
static int receive_start(int socket, struct avc_request *request, int *init_pidfd,
			 int *heartbeat_fd)
{
	int fds[REQUEST_FDS];
	size_t count;

	if (receive(socket, request, 0, fds, &count) != sizeof *request ||
	    request->magic != AVC_GUARD_MAGIC || request->kind != AVC_REQUEST_START || count != 2)
		return -1;
	*init_pidfd = fds[0];
	*heartbeat_fd = fds[1];
	return 0;
}

static struct avc_guard *guard_new(int socket, const struct avc_request *start, int init_pidfd)
{
	struct avc_guard *guard = calloc(1, sizeof *guard);

	if (!guard)
		return NULL;
	guard->socket = socket;
	guard->cookie = start->cookie;
	guard->policy.room = start->config.keep;
	guard->hold_ns = UINT64_MAX;
	guard->started_ns = now_ns();
	guard->daemon = getppid();
	init_channel_init(&guard->channel);
	process_init(&guard->main);
	guard->tree = (struct tree){
		.slots = start->config.keep + 1,
		.is_ours = guard_owns,
		.arg = guard,
	};
	guard_set_config(guard, &start->config);
	guard->channel.init_pidfd = init_pidfd;
	return guard;
}

static void guard_free(struct avc_guard *guard)
{
	files_written_free(guard->written);
	process_free_room(&guard->main);
	tree_free(&guard->tree);
	mem_others_free(guard->main.others);
	free(guard->fds);
	free(guard);
}

/* Unsent events, as long as the daemon reads. */
static void send_last_words(struct avc_guard *guard)
{
	struct pollfd daemon = { .fd = guard->socket, .events = POLLOUT };

	guard_send_posted(guard);
	while (guard->outbox_count && poll_for(&daemon, 1, LAST_WORDS_NS) == 1 &&
	       !(daemon.revents & (POLLERR | POLLHUP)))
		guard_send_posted(guard);
}

int guard_run(int socket)
{
	struct avc_request start;
	struct avc_error error = { 0 };
	struct avc_guard *guard;
	int init_pidfd, heartbeat_fd;
	bool hindered;

	if (receive_start(socket, &start, &init_pidfd, &heartbeat_fd) ||
	    config_check(&start.config, &error) || heartbeat_open(heartbeat_fd))
		return GUARD_UNTOLD;
	guard = guard_new(socket, &start, init_pidfd);
	if (!guard)
		return GUARD_UNTOLD;
	guard->main.others = mem_others_new();
	if (!process_make_room(&guard->main) || !guard->main.others ||
	    tree_init(&guard->tree, &guard->main)) {
		fail(&error, AVC_KERNEL, ENOMEM, 0, "start guard", "calloc", "out of memory");
		guard_emit_error(guard, AVC_EVENT_UNPROTECTED, 0, &error);
	} else {
		guard_main(guard);
	}
	send_last_words(guard);
	hindered = seccomp_must_suspend();
	guard_free(guard);
	return hindered ? AVC_GUARD_HINDERED : 0;
}
