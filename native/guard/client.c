/* SPDX-License-Identifier: Apache-2.0
 *
 * The daemon's side of its guards: starts them, sends them requests, queues their events. This is
 * all of the native code that runs in the daemon.
 */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <spawn.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "avckpt/guard.h"
#include "base.h"

#define QUEUE_MAX 4096
#define STOP_MS 15000     /* a guard may be in the middle of a restore */
#define END_NS NS_PER_S   /* from the end of its socket to the exit of the process */
#define EVENTS_AT_ONCE 64 /* taken from one guard before it is the others' turn */
#define STARVED_FACTOR 10 /* factor of patience for one that only waits for a CPU */

extern char **environ;

struct avc_guard {
	struct avc_engine *engine;
	struct avc_guard *next;
	uint64_t cookie;
	struct avc_config config; /* its own; init_pidfd is a duplicate                    */
	pid_t pid;
	int pidfd, socket;
	const struct avc_heartbeat *heartbeat;
	uint64_t beats, beats_ns; /* the last ones seen, and when */
	bool stopping;            /* its exit was requested */
	bool ended;               /* its socket is at end of file, and its pidfd is waited for */
	uint64_t ended_ns;        /* since when */
	bool hung;                /* and we have killed it                          */
	bool mad;                 /* likewise, for an invalid message */
	int status;               /* of the ended process, as from waitpid(2)       */
};

struct avc_engine {
	pthread_mutex_t lock;
	char *program;
	int epoll_fd; /* its guards' sockets, and queue_fd                        */
	int queue_fd; /* eventfd: something is queued                             */
	struct avc_guard *guards;
	uint32_t first, count;
	struct avc_event queue[QUEUE_MAX];
};

const char *avc_version(void)
{
	return AVC_VERSION;
}

/* ---- the queue ------------------------------------------------------------------ */

struct avc_engine *avc_engine_new(const char *program, struct avc_error *err)
{
	struct epoll_event on = { .events = EPOLLIN };
	struct avc_engine *engine;

	*err = (struct avc_error){ 0 };
	engine = calloc(1, sizeof *engine);
	if (!engine) {
		fail_errno(err, 0, "start engine", "calloc", "out of memory");
		return NULL;
	}
	engine->program = strdup(program);
	engine->queue_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
	engine->epoll_fd = epoll_create1(EPOLL_CLOEXEC);
	pthread_mutex_init(&engine->lock, NULL);
	if (!engine->program || engine->queue_fd < 0 || engine->epoll_fd < 0 ||
	    epoll_ctl(engine->epoll_fd, EPOLL_CTL_ADD, engine->queue_fd, &on)) {
		fail_errno(err, 0, "start engine", "epoll_create1", "no descriptor for events");
		avc_engine_free(engine);
		return NULL;
	}
	return engine;
}

int avc_engine_event_fd(struct avc_engine *engine)
{
	return engine->epoll_fd;
}

static void queue_event(struct avc_engine *engine, const struct avc_event *event)
{
	if (engine->count == QUEUE_MAX) {
		engine->first = (engine->first + 1) % QUEUE_MAX;
		engine->count--;
	}
	engine->queue[(engine->first + engine->count++) % QUEUE_MAX] = *event;
	eventfd_write(engine->queue_fd, 1);
}

static void guard_kill(const struct avc_guard *guard)
{
	syscall(SYS_pidfd_send_signal, guard->pidfd, SIGKILL, NULL, 0);
}

/* Whether it has exited, and is reaped. */
static bool guard_reap(struct avc_guard *guard)
{
	if (guard->pid && waitpid(guard->pid, &guard->status, WNOHANG) == guard->pid)
		guard->pid = 0;
	return !guard->pid;
}

/* One that waits for a file server that does not answer does not end when it is killed either: it
 * stays a child of ours. */
static void guard_end(struct avc_guard *guard, uint64_t patience_ns)
{
	struct pollfd ending = { .fd = guard->pidfd, .events = POLLIN };

	if (!guard->pid)
		return;
	if (poll_for(&ending, 1, patience_ns) != 1) {
		guard_kill(guard);
		(void)poll_for(&ending, 1, END_NS);
	}
	(void)guard_reap(guard);
}

/* It has exited without a request: the daemon must start another one. */
static void guard_lost(struct avc_guard *guard)
{
	struct avc_event event = { .kind = AVC_EVENT_GUARD_LOST,
				   .cookie = guard->cookie,
				   .at_ns = now_ns() };

	if (guard->mad)
		fail(&event.error, AVC_PROTOCOL, 0, 0, "", "",
		     "its guard sent an invalid message and was killed");
	else if (guard->pid)
		fail(&event.error, AVC_DEADLINE, 0, 0, "", "",
		     "its guard was killed and does not end");
	else if (guard->hung)
		fail(&event.error, AVC_DEADLINE, 0, 0, "", "",
		     "its guard gave no sign of life and was killed");
	else if (WIFSIGNALED(guard->status))
		fail(&event.error, AVC_GONE, 0, 0, "", "", "its guard was killed by signal %d",
		     WTERMSIG(guard->status));
	else
		fail(&event.error, AVC_GONE, 0, 0, "", "", "its guard ended with status %d",
		     WEXITSTATUS(guard->status));
	queue_event(guard->engine, &event);
}

static bool guard_wait_for(struct avc_guard *guard, int fd)
{
	struct epoll_event on = { .events = EPOLLIN, .data.ptr = guard };

	return epoll_ctl(guard->engine->epoll_fd, EPOLL_CTL_ADD, fd, &on) == 0;
}

static void guard_wait_no_more(const struct avc_guard *guard)
{
	epoll_ctl(guard->engine->epoll_fd, EPOLL_CTL_DEL, guard->socket, NULL);
	epoll_ctl(guard->engine->epoll_fd, EPOLL_CTL_DEL, guard->pidfd, NULL);
}

static int guard_spawn(struct avc_guard *guard, struct avc_error *err);
static void guard_release(struct avc_guard *guard);

/* Its own seccomp filter stood in its way: another one, without a filter, takes its place. */
static void guard_succeed(struct avc_guard *guard)
{
	struct avc_event event = { .kind = AVC_EVENT_GUARD_LOST,
				   .reason = AVC_REASON_FILTER,
				   .cookie = guard->cookie,
				   .at_ns = now_ns() };

	fail(&event.error, AVC_GONE, 0, 0, "", "", "it takes one to suspend the application's own");
	guard_release(guard);
	guard->config.suspends = guard->config.late = 1;
	guard->beats = 0;
	guard->beats_ns = now_ns();
	if (guard_spawn(guard, &event.error) == 0 && guard_wait_for(guard, guard->socket))
		guard->ended = false;
	else
		event.reason = AVC_REASON_NONE;
	queue_event(guard->engine, &event);
}

static bool is_text(const char *chars, size_t size)
{
	return memchr(chars, 0, size) != NULL;
}

/* A guard reads data of containers, and may have been compromised: its events are accepted for its
 * own container only. */
static bool event_is_sound(const struct avc_guard *guard, const struct avc_event *event)
{
	return event->cookie == guard->cookie && event->kind >= AVC_EVENT_ATTACHED &&
	       event->kind <= AVC_EVENT_WAITS && event->kind != AVC_EVENT_GUARD_LOST &&
	       event->reason >= AVC_REASON_NONE && event->reason <= AVC_REASON_UNSHARED &&
	       (event->images == AVC_IMAGES_FORK || event->images == AVC_IMAGES_DIRTY) &&
	       event->fork_reason >= AVC_FORK_NONE && event->fork_reason <= AVC_FORK_BUDGET &&
	       event->again <= (AVC_AGAIN_DROP_INPUT | AVC_AGAIN_STAGGER) &&
	       event->error.code >= AVC_OK && event->error.code <= AVC_RETRY &&
	       is_text(event->error.operation, sizeof event->error.operation) &&
	       is_text(event->error.syscall, sizeof event->error.syscall) &&
	       is_text(event->error.detail, sizeof event->error.detail);
}

/* As recv(2).  When it has exited without reading a last command, the kernel says so (unix_release_sock(),
 * net/unix/af_unix.c), once, and before the events that it has sent. */
static ssize_t receive_event(int socket, struct avc_event *event)
{
	const int flags = MSG_DONTWAIT | MSG_TRUNC;
	const ssize_t n = recv(socket, event, sizeof *event, flags);

	return n < 0 && errno == ECONNRESET ? recv(socket, event, sizeof *event, flags) : n;
}

/* Its process has ended, or does not end. */
static void guard_bury(struct avc_guard *guard)
{
	guard_wait_no_more(guard);
	if (!guard->mad && !guard->hung && !guard->config.suspends && WIFEXITED(guard->status) &&
	    WEXITSTATUS(guard->status) == AVC_GUARD_HINDERED)
		guard_succeed(guard);
	else
		guard_lost(guard);
}

/* Queues its events so far, or a part of them: one that never stops sending must not keep us
 * busy. */
static void guard_listen(struct avc_guard *guard)
{
	struct avc_event event;
	ssize_t n = 0;

	for (int i = 0; i < EVENTS_AT_ONCE; i++) {
		n = receive_event(guard->socket, &event);
		if (n <= 0)
			break;
		guard->mad = n != sizeof event || !event_is_sound(guard, &event);
		if (guard->mad)
			break;
		/* Its last event, after which it exits by itself. */
		guard->stopping |= event.kind == AVC_EVENT_ENDED;
		queue_event(guard->engine, &event);
	}
	if (!guard->mad && (n > 0 || (n < 0 && (errno == EAGAIN || errno == EINTR))))
		return;
	guard->ended = true;
	guard->ended_ns = now_ns();
	guard_wait_no_more(guard);
	if (guard->stopping && !guard->mad)
		return;
	if (guard->mad)
		guard_kill(guard);
	/* It exits a moment later, for which nobody waits here. */
	if (!guard_wait_for(guard, guard->pidfd))
		guard_bury(guard);
}

static void guard_attend(struct avc_guard *guard)
{
	if (!guard->ended)
		guard_listen(guard);
	else if (guard_reap(guard))
		guard_bury(guard);
}

int avc_engine_next_event(struct avc_engine *engine, struct avc_event *event)
{
	eventfd_t ignored;
	int found = 0;

	pthread_mutex_lock(&engine->lock);
	if (!engine->count) {
		struct epoll_event ready[16];
		const int n = epoll_wait(engine->epoll_fd, ready, 16, 0);

		for (int i = 0; i < n; i++)
			if (ready[i].data.ptr)
				guard_attend(ready[i].data.ptr);
	}
	if (engine->count) {
		*event = engine->queue[engine->first];
		engine->first = (engine->first + 1) % QUEUE_MAX;
		engine->count--;
		found = 1;
	}
	if (!engine->count)
		(void)eventfd_read(engine->queue_fd, &ignored);
	pthread_mutex_unlock(&engine->lock);
	return found;
}

void avc_engine_free(struct avc_engine *engine)
{
	close_fd(&engine->epoll_fd);
	close_fd(&engine->queue_fd);
	pthread_mutex_destroy(&engine->lock);
	free(engine->program);
	free(engine);
}

/* ---- processes ------------------------------------------------------------------- */

/* `program`, with `socket` as AVC_GUARD_FD, no signal blocked or ignored, and in its own session:
 * keys of our terminal must not reach it. */
static int spawn(const char *program, char *const argv[], int socket, pid_t *pid)
{
	posix_spawn_file_actions_t actions;
	posix_spawnattr_t attributes;
	sigset_t none, all;
	int result;

	sigemptyset(&none);
	sigfillset(&all);
	posix_spawn_file_actions_init(&actions);
	posix_spawnattr_init(&attributes);
	posix_spawnattr_setsigmask(&attributes, &none);
	posix_spawnattr_setsigdefault(&attributes, &all);
	posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETSIGMASK | POSIX_SPAWN_SETSIGDEF |
						      POSIX_SPAWN_SETSID);
	result = posix_spawn_file_actions_adddup2(&actions, socket, AVC_GUARD_FD);
	if (!result)
		result = posix_spawn(pid, program, &actions, &attributes, argv, environ);
	posix_spawnattr_destroy(&attributes);
	posix_spawn_file_actions_destroy(&actions);
	errno = result;
	return result ? -1 : 0;
}

int avc_engine_probe(const char *program, struct avc_error *err)
{
	char *const argv[] = { (char *)"avckpt-guard", (char *)"--probe", NULL };
	struct avc_error answer;
	int ends[2], status;
	ssize_t n = -1;
	pid_t pid;

	*err = (struct avc_error){ 0 };
	if (pipe2(ends, O_CLOEXEC))
		return fail_errno(err, 0, "probe", "pipe2", "no descriptors");
	if (spawn(program, argv, ends[1], &pid)) {
		fail_errno(err, 0, "probe", "posix_spawn", "%s cannot be started: %s", program,
			   strerror(errno));
		pid = 0;
	}
	close_fd(&ends[1]);
	if (pid) {
		while ((n = read(ends[0], &answer, sizeof answer)) < 0 && errno == EINTR)
			;
		while (waitpid(pid, &status, 0) < 0 && errno == EINTR)
			;
	}
	close_fd(&ends[0]);
	if (pid && n != sizeof answer)
		return fail(err, AVC_KERNEL, 0, 0, "probe", "", "%s did not answer", program);
	if (pid)
		*err = answer;
	return err->code ? -1 : 0;
}

/* ---- one guard ----------------------------------------------------------------------- */

static ssize_t send_with(int socket, const struct avc_request *request, const int *fds,
			 size_t count)
{
	union {
		char bytes[CMSG_SPACE(2 * sizeof *fds)];
		struct cmsghdr align;
	} control = { { 0 } };
	struct iovec data = { (void *)request, sizeof *request };
	struct msghdr message = { .msg_iov = &data, .msg_iovlen = 1 };
	struct cmsghdr *header;

	if (count) {
		message.msg_control = &control;
		message.msg_controllen = CMSG_SPACE(count * sizeof *fds);
		header = CMSG_FIRSTHDR(&message);
		header->cmsg_level = SOL_SOCKET;
		header->cmsg_type = SCM_RIGHTS;
		header->cmsg_len = CMSG_LEN(count * sizeof *fds);
		memcpy(CMSG_DATA(header), fds, count * sizeof *fds);
	}
	return sendmsg(socket, &message, MSG_NOSIGNAL | MSG_DONTWAIT);
}

static int send_start(int socket, const struct avc_config *config, uint64_t cookie,
		      int heartbeat_fd)
{
	const struct avc_request request = { .magic = AVC_GUARD_MAGIC,
					     .kind = AVC_REQUEST_START,
					     .cookie = cookie,
					     .config = *config };
	const int fds[2] = { config->init_pidfd, heartbeat_fd };

	return send_with(socket, &request, fds, 2) < 0 ? -1 : 0;
}

/* What belongs to its process. */
static void guard_release(struct avc_guard *guard)
{
	if (guard->heartbeat)
		munmap((void *)guard->heartbeat, sizeof *guard->heartbeat);
	guard->heartbeat = NULL;
	close_fd(&guard->pidfd);
	close_fd(&guard->socket);
}

static void guard_free(struct avc_guard *guard)
{
	guard_release(guard);
	close_fd(&guard->config.init_pidfd);
	free(guard);
}

/* Its memory, its process; guard_free() cleans up after a failure. */
static int guard_spawn(struct avc_guard *guard, struct avc_error *err)
{
	char *const argv[] = { (char *)"avckpt-guard", NULL };
	int ends[2], heartbeat_fd, result;
	void *map;

	heartbeat_fd = memfd_create("avckpt-heartbeat", MFD_CLOEXEC);
	if (heartbeat_fd < 0 || ftruncate(heartbeat_fd, sizeof *guard->heartbeat))
		map = MAP_FAILED;
	else
		map = mmap(NULL, sizeof *guard->heartbeat, PROT_READ, MAP_SHARED, heartbeat_fd, 0);
	if (map == MAP_FAILED) {
		fail_errno(err, 0, "start guard", "memfd_create", "no memory to share");
		close_fd(&heartbeat_fd);
		return -1;
	}
	guard->heartbeat = map;
	if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, ends)) {
		close_fd(&heartbeat_fd);
		return fail_errno(err, 0, "start guard", "socketpair", "no descriptors");
	}
	guard->socket = ends[0];
	/* Before it starts: the message waits for it. */
	result = send_start(guard->socket, &guard->config, guard->cookie, heartbeat_fd);
	if (result)
		fail_errno(err, 0, "start guard", "sendmsg", "it cannot be told what to do");
	else if (spawn(guard->engine->program, argv, ends[1], &guard->pid))
		result = fail_errno(err, 0, "start guard", "posix_spawn",
				    "%s cannot be started: %s", guard->engine->program,
				    strerror(errno));
	close_fd(&ends[1]);
	close_fd(&heartbeat_fd);
	if (result)
		return -1;
	guard->pidfd = (int)syscall(SYS_pidfd_open, guard->pid, 0);
	if (guard->pidfd >= 0)
		return 0;
	fail_errno(err, 0, "start guard", "pidfd_open", "no descriptor");
	kill(guard->pid, SIGKILL); /* our unreaped child: the PID is still its own */
	waitpid(guard->pid, NULL, 0);
	guard->pid = 0;
	return -1;
}

struct avc_guard *avc_guard_start(struct avc_engine *engine, const struct avc_config *config,
				  uint64_t cookie, struct avc_error *err)
{
	struct avc_guard *guard;

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
	guard->pidfd = guard->socket = -1;
	guard->beats_ns = now_ns();
	guard->config = *config;
	guard->config.init_pidfd = fcntl(config->init_pidfd, F_DUPFD_CLOEXEC, 0);
	if (guard->config.init_pidfd < 0)
		fail_errno(err, 0, "start guard", "fcntl", "no descriptors");
	if (err->code || guard_spawn(guard, err)) {
		guard_free(guard);
		return NULL;
	}
	pthread_mutex_lock(&engine->lock);
	guard->next = engine->guards;
	engine->guards = guard;
	if (!guard_wait_for(guard, guard->socket))
		fail_errno(err, 0, "start guard", "epoll_ctl", "its events cannot be waited for");
	pthread_mutex_unlock(&engine->lock);
	if (err->code) {
		avc_guard_stop(guard);
		return NULL;
	}
	return guard;
}

int32_t avc_guard_pid(struct avc_guard *guard)
{
	int32_t pid;

	pthread_mutex_lock(&guard->engine->lock);
	pid = guard->pid;
	pthread_mutex_unlock(&guard->engine->lock);
	return pid;
}

/* Whether it is runnable but gets no CPU; an endless loop is caught by STARVED_FACTOR. */
static bool is_runnable(pid_t pid)
{
	struct proc_stat stat;

	return proc_stat(pid, &stat) == 0 && stat.state == 'R';
}

/* One that has been killed, or has closed its socket, for so long. */
static void guard_give_up(struct avc_guard *guard, uint64_t patience_ns)
{
	const uint64_t since_ns = now_ns() - guard->ended_ns;

	if (since_ns <= END_NS)
		return;
	guard_kill(guard);
	if (since_ns <= END_NS + patience_ns * (is_runnable(guard->pid) ? STARVED_FACTOR : 1))
		return;
	guard->ended = guard->stopping = true;
	guard_bury(guard);
}

void avc_guard_check(struct avc_guard *guard, uint64_t patience_ns)
{
	uint64_t beats, rests_ns, silent_ns;

	pthread_mutex_lock(&guard->engine->lock);
	rests_ns = __atomic_load_n(&guard->heartbeat->rests_until_ns, __ATOMIC_RELAXED);
	beats = __atomic_load_n(&guard->heartbeat->beats, __ATOMIC_RELAXED);
	if (beats != guard->beats) {
		guard->beats = beats;
		guard->beats_ns = now_ns();
	}
	silent_ns = now_ns() - guard->beats_ns;
	/* It cannot claim to sleep for longer than it may. */
	if (rests_ns > guard->beats_ns + AVC_HEARTBEAT_NS)
		rests_ns = guard->beats_ns + AVC_HEARTBEAT_NS;
	if (rests_ns > guard->beats_ns)
		silent_ns = now_ns() > rests_ns ? now_ns() - rests_ns : 0;
	if (guard->pid && !guard->stopping && (guard->hung || guard->ended)) {
		guard_give_up(guard, patience_ns);
	} else if (guard->pid && !guard->stopping && silent_ns > patience_ns &&
		   (!is_runnable(guard->pid) || silent_ns > STARVED_FACTOR * patience_ns)) {
		guard->hung = true;
		guard->ended_ns = now_ns();
		guard_kill(guard);
	}
	pthread_mutex_unlock(&guard->engine->lock);
}

/* `fd` is sent along; -1: none. */
static int guard_send(struct avc_guard *guard, const struct avc_request *request, int fd,
		      struct avc_error *err)
{
	int result = 0;

	pthread_mutex_lock(&guard->engine->lock);
	if (guard->ended || guard->stopping)
		result = fail(err, AVC_GONE, ESRCH, 0, "command", "", "the container has ended");
	else if (send_with(guard->socket, request, &fd, fd >= 0) < 0)
		result = errno == EAGAIN || errno == ENOBUFS
				 ? fail(err, AVC_BUSY, errno, 0, "command", "send",
					"too many commands are waiting")
				 : fail(err, AVC_GONE, errno, 0, "command", "send",
					"its guard has ended");
	pthread_mutex_unlock(&guard->engine->lock);
	return result;
}

int avc_guard_command(struct avc_guard *guard, enum avc_command command, uint64_t ticket,
		      uint64_t generation, uint64_t until_ns, struct avc_error *err)
{
	const struct avc_request request = { .magic = AVC_GUARD_MAGIC,
					     .kind = AVC_REQUEST_COMMAND,
					     .command = command,
					     .generation = generation,
					     .ticket = ticket,
					     .until_ns = until_ns };

	*err = (struct avc_error){ 0 };
	if (command < AVC_COMMAND_CHECKPOINT || command > AVC_COMMAND_SEEN)
		return fail(err, AVC_CONFIG, EINVAL, 0, "command", "", "no such command");
	return guard_send(guard, &request, -1, err);
}

int avc_guard_configure(struct avc_guard *guard, const struct avc_config *config,
			struct avc_error *err)
{
	const struct avc_request request = { .magic = AVC_GUARD_MAGIC,
					     .kind = AVC_REQUEST_CONFIGURE,
					     .config = *config };
	uint8_t suspends;
	int init_pidfd;

	*err = (struct avc_error){ 0 };
	if (config_check(config, err) || guard_send(guard, &request, -1, err))
		return -1;
	pthread_mutex_lock(&guard->engine->lock);
	init_pidfd = guard->config.init_pidfd;
	suspends = guard->config.suspends;
	guard->config = *config;
	guard->config.init_pidfd = init_pidfd;
	guard->config.suspends = suspends;
	pthread_mutex_unlock(&guard->engine->lock);
	return 0;
}

int avc_meeting_new(uint32_t members, struct avc_error *err)
{
	int fd = memfd_create("avckpt-meeting", MFD_CLOEXEC | MFD_ALLOW_SEALING);

	*err = (struct avc_error){ 0 };
	if (fd >= 0 && ftruncate(fd, sizeof(struct avc_meeting)) == 0 &&
	    pwrite(fd, &members, sizeof members, offsetof(struct avc_meeting, members)) ==
		    sizeof members &&
	    fcntl(fd, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW) == 0)
		return fd;
	fail_errno(err, 0, "meet", "memfd_create", "no memory to share");
	close_fd(&fd);
	return -1;
}

int avc_guard_line(struct avc_guard *guard, int meeting, uint64_t line, uint64_t ticket,
		   struct avc_error *err)
{
	const struct avc_request request = {
		.magic = AVC_GUARD_MAGIC, .kind = AVC_REQUEST_LINE, .line = line, .ticket = ticket
	};

	*err = (struct avc_error){ 0 };
	return guard_send(guard, &request, meeting, err);
}

int avc_guard_recall(struct avc_guard *guard, int meeting, uint64_t line, uint64_t generation,
		     uint64_t ticket, struct avc_error *err)
{
	const pid_t pid = avc_guard_pid(guard);
	const struct avc_request request = { .magic = AVC_GUARD_MAGIC,
					     .kind = AVC_REQUEST_RECALL,
					     .lent = rt_priority_lend(pid),
					     .line = line,
					     .generation = generation,
					     .ticket = ticket };

	*err = (struct avc_error){ 0 };
	if (guard_send(guard, &request, meeting, err) == 0)
		return 0;
	if (request.lent)
		rt_priority_reclaim(pid);
	return -1;
}

void avc_guard_stop(struct avc_guard *guard)
{
	struct avc_engine *engine = guard->engine;
	const uint64_t end = now_ns() + STOP_MS * NS_PER_MS;
	struct avc_guard **at;

	pthread_mutex_lock(&engine->lock);
	guard->stopping = true;
	shutdown(guard->socket, SHUT_WR);
	/* Its remaining events are queued, or it could not send all of them. */
	while (!guard->ended && now_ns() < end) {
		struct pollfd news = { .fd = guard->socket, .events = POLLIN };

		pthread_mutex_unlock(&engine->lock);
		(void)poll_for(&news, 1, END_NS);
		pthread_mutex_lock(&engine->lock);
		if (!guard->ended)
			guard_listen(guard);
	}
	guard_wait_no_more(guard);
	for (at = &engine->guards; *at != guard; at = &(*at)->next)
		;
	*at = guard->next;
	pthread_mutex_unlock(&engine->lock);
	guard_end(guard, guard->ended ? END_NS : 0);
	guard_free(guard);
}
