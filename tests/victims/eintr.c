/* SPDX-License-Identifier: Apache-2.0
 *
 * eintr KIND SECONDS [--quiet] [--late S]: blocks in one system call, again and again.  No
 * signal is ever caught here, so the call must never answer EINTR, and a timeout
 * must take its time: no less, and not much more.
 *
 * By default a second thread wakes the call every 50 ms (kinds that can not be
 * woken run into their timeout) and beats.  With --quiet there is no other
 * thread: nothing but the timeout ends the call.  SECONDS 0 means no timeout,
 * for kinds that have one; kinds without one ignore it.  With --late a timeout
 * that comes more than S seconds too late is a violation.
 *
 * KIND "all" has a thread for every kind but io_getevents (with --quiet: every
 * kind that has a timeout), and main beats.
 *
 * On the board: counter 0 calls, 1 EINTRs (each is a violation, too, but it goes
 * on, so that they can be counted), 2 shortest and 3 longest time a call took that
 * ended by its timeout (ns), 4 timeouts, 5 wake-ups, 6 when the running call
 * was made (CLOCK_MONOTONIC ns); from 8 on the calls of each kind, as listed.
 */
#include <linux/aio_abi.h>
#include <linux/futex.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <sys/epoll.h>
#include <sys/ipc.h>
#include <sys/msg.h>
#include <sys/select.h>
#include <sys/sem.h>
#include <sys/sendfile.h>
#include <sys/socket.h>
#include <sys/uio.h>
#include <sys/un.h>

#include "victim.h"

enum { CALLS, EINTRS, SHORTEST, LONGEST, TIMEOUTS, WAKES, STARTED, KINDS = 8 };

static bool quiet;
static double late_seconds = 1e9;
static sigset_t usr1, waiting; /* the mask of this process, and another one */

/* What one kind works with. */
struct place {
	double seconds; /* 0: no timeout */
	struct timespec timeout;
	int pipe_fd[2], pair_fd[2], listen_fd, epoll_fd, program_fd, sem_id, msg_id;
	struct sockaddr_un listen_at;
	socklen_t listen_len;
	uint32_t word;
	aio_context_t aio;
};

/* Of the kind that this thread calls, or wakes. */
static _Thread_local struct place *here;

static struct timespec after(double s)
{
	struct timespec ts = { (time_t)s, (long)((s - (double)(time_t)s) * 1e9) };

	return ts;
}

static struct timespec *timeout(void)
{
	here->timeout = after(here->seconds);
	return here->seconds > 0 ? &here->timeout : NULL;
}

static int timeout_ms(void)
{
	return here->seconds > 0 ? (int)(here->seconds * 1000) : -1;
}

static int drain(long ready)
{
	char c;

	if (ready > 0)
		return read(here->pipe_fd[0], &c, 1) == 1 ? 1 : -1;
	return (int)ready;
}

static void set_timeout(int fd, int option)
{
	struct timeval tv = { (time_t)here->seconds,
			      (long)((here->seconds - (double)(time_t)here->seconds) * 1e6) };

	must(!setsockopt(fd, SOL_SOCKET, option, &tv, sizeof(tv)), "a timeout");
}

/* The calls: 1 woken, 0 timed out, -1 with errno. */

static int do_epoll_wait(void)
{
	struct epoll_event event;

	return drain(syscall(SYS_epoll_wait, here->epoll_fd, &event, 1, timeout_ms()));
}

static int do_epoll_pwait(void)
{
	struct epoll_event event;
	return drain(epoll_pwait(here->epoll_fd, &event, 1, timeout_ms(), &waiting));
}

static int do_epoll_pwait2(void)
{
	struct epoll_event event;

	return drain(syscall(SYS_epoll_pwait2, here->epoll_fd, &event, 1, timeout(), NULL, 8));
}

static int do_poll(void)
{
	struct pollfd fd = { .fd = here->pipe_fd[0], .events = POLLIN };

	return drain(syscall(SYS_poll, &fd, 1, timeout_ms()));
}

static int do_ppoll(void)
{
	struct pollfd fd = { .fd = here->pipe_fd[0], .events = POLLIN };
	return drain(ppoll(&fd, 1, timeout(), &waiting));
}

static int do_select(void)
{
	struct timeval tv = { (time_t)here->seconds,
			      (long)((here->seconds - (double)(time_t)here->seconds) * 1e6) };
	fd_set set;

	FD_ZERO(&set);
	FD_SET(here->pipe_fd[0], &set);
	return drain(syscall(SYS_select, here->pipe_fd[0] + 1, &set, NULL, NULL,
			     here->seconds > 0 ? &tv : NULL));
}

static int do_pselect(void)
{
	fd_set set;

	FD_ZERO(&set);
	FD_SET(here->pipe_fd[0], &set);
	return drain(pselect(here->pipe_fd[0] + 1, &set, NULL, NULL, timeout(), &waiting));
}

static int futex_wait(int op, struct timespec *ts)
{
	if (syscall(SYS_futex, &here->word, op | FUTEX_PRIVATE_FLAG, 0, ts, NULL,
		    FUTEX_BITSET_MATCH_ANY) < 0 &&
	    errno != EAGAIN)
		return errno == ETIMEDOUT ? 0 : -1;
	__atomic_store_n(&here->word, 0, __ATOMIC_SEQ_CST);
	return 1;
}

static int do_futex(void)
{
	return futex_wait(FUTEX_WAIT, timeout());
}

static int do_futex_abs(void)
{
	struct timespec ts = after((double)now_ns() / 1e9 + here->seconds);

	return futex_wait(FUTEX_WAIT_BITSET, here->seconds > 0 ? &ts : NULL);
}

static int do_nanosleep(void)
{
	struct timespec ts = after(here->seconds > 0 ? here->seconds : 1e6);

	return (int)syscall(SYS_nanosleep, &ts, NULL);
}

static int do_clock_nanosleep(void)
{
	struct timespec ts = after(here->seconds > 0 ? here->seconds : 1e6);

	return (int)syscall(SYS_clock_nanosleep, CLOCK_MONOTONIC, 0, &ts, NULL);
}

static int do_clock_nanosleep_abs(void)
{
	struct timespec ts =
		after((double)now_ns() / 1e9 + (here->seconds > 0 ? here->seconds : 1e6));

	return (int)syscall(SYS_clock_nanosleep, CLOCK_MONOTONIC, TIMER_ABSTIME, &ts, NULL);
}

static int do_read(void)
{
	return drain(1);
}

static int do_accept(void)
{
	int fd = accept4(here->listen_fd, NULL, NULL, SOCK_CLOEXEC);

	if (fd < 0)
		return errno == EAGAIN ? 0 : -1;
	close(fd);
	return 1;
}

static int do_recv(void)
{
	char c;

	if (recv(here->pair_fd[0], &c, 1, 0) < 0)
		return errno == EAGAIN ? 0 : -1;
	return 1;
}

static int do_sigtimedwait(void)
{
	long sig = syscall(SYS_rt_sigtimedwait, &usr1, NULL, timeout(), 8);

	if (sig < 0)
		return errno == EAGAIN ? 0 : -1;
	return 1;
}

static int sem_take(struct timespec *ts)
{
	struct sembuf take = { .sem_op = -1 };

	if (syscall(SYS_semtimedop, here->sem_id, &take, 1, ts) < 0)
		return errno == EAGAIN ? 0 : -1;
	return 1;
}

static int do_semtimedop(void)
{
	return sem_take(timeout());
}

static int do_semop(void)
{
	return sem_take(NULL);
}

static int do_msgrcv(void)
{
	struct {
		long type;
		char text[8];
	} message;

	return msgrcv(here->msg_id, &message, sizeof(message.text), 0, 0) < 0 ? -1 : 1;
}

static int do_io_getevents(void)
{
	struct io_event event;

	return (int)syscall(SYS_io_getevents, here->aio, 1, 1, &event, timeout());
}

static int do_preadv2(void)
{
	char c;
	struct iovec to = { &c, 1 };

	if (preadv2(here->pair_fd[0], &to, 1, -1, 0) < 0)
		return errno == EAGAIN ? 0 : -1;
	return 1;
}

/* Waits when nobody has read the datagrams before it. */
static int do_sendfile(void)
{
	off_t at = 0;

	if (sendfile(here->pair_fd[0], here->program_fd, &at, 1) < 0)
		return errno == EAGAIN ? 0 : -1;
	return 1;
}

/* The wake-ups. */

static void wake_pipe(void)
{
	must(write(here->pipe_fd[1], "", 1) == 1, "write");
}

static void wake_futex(void)
{
	__atomic_store_n(&here->word, 1, __ATOMIC_SEQ_CST);
	syscall(SYS_futex, &here->word, FUTEX_WAKE | FUTEX_PRIVATE_FLAG, 1, NULL, NULL, 0);
}

static void wake_accept(void)
{
	int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);

	must(fd >= 0, "socket");
	must(!connect(fd, (struct sockaddr *)&here->listen_at, here->listen_len), "connect");
	close(fd);
}

static void wake_recv(void)
{
	must(send(here->pair_fd[1], "", 1, 0) == 1, "send");
}

/* Who waits for room is told when there is plenty (net/unix/af_unix.c, unix_writable()). */
static void wake_send(void)
{
	char c;

	while (recv(here->pair_fd[1], &c, 1, MSG_DONTWAIT) == 1)
		;
	must(errno == EAGAIN, "recv");
}

static void wake_signal(void)
{
	kill(getpid(), SIGUSR1); /* blocked in every thread: it is only waited for */
}

static void wake_sem(void)
{
	struct sembuf give = { .sem_op = 1 };

	must(!semop(here->sem_id, &give, 1), "semop");
}

static void wake_msg(void)
{
	struct {
		long type;
		char text[8];
	} message = { .type = 1 };

	must(!msgsnd(here->msg_id, &message, sizeof(message.text), 0), "msgsnd");
}

static const struct kind {
	const char *name;
	int (*call)(void);
	void (*wake)(void);
	bool untimed; /* has no timeout */
} kinds[] = {
	{ "epoll_wait", do_epoll_wait, wake_pipe, false },
	{ "epoll_pwait", do_epoll_pwait, wake_pipe, false },
	{ "epoll_pwait2", do_epoll_pwait2, wake_pipe, false },
	{ "poll", do_poll, wake_pipe, false },
	{ "ppoll", do_ppoll, wake_pipe, false },
	{ "select", do_select, wake_pipe, false },
	{ "pselect", do_pselect, wake_pipe, false },
	{ "futex", do_futex, wake_futex, false },
	{ "futex_abs", do_futex_abs, wake_futex, false },
	{ "nanosleep", do_nanosleep, NULL, false },
	{ "clock_nanosleep", do_clock_nanosleep, NULL, false },
	{ "clock_nanosleep_abs", do_clock_nanosleep_abs, NULL, false },
	{ "read", do_read, wake_pipe, true },
	{ "accept", do_accept, wake_accept, false },
	{ "recv", do_recv, wake_recv, false },
	{ "sigtimedwait", do_sigtimedwait, wake_signal, false },
	{ "semtimedop", do_semtimedop, wake_sem, false },
	{ "semop", do_semop, wake_sem, true },
	{ "msgrcv", do_msgrcv, wake_msg, true },
	{ "io_getevents", do_io_getevents, NULL, false },
	{ "preadv2", do_preadv2, wake_recv, false },
	{ "sendfile", do_sendfile, wake_send, false },
};

static struct place places[sizeof(kinds) / sizeof(kinds[0])];

static void set_up(const struct kind *kind, double seconds)
{
	struct epoll_event event = { .events = EPOLLIN };

	here = &places[kind - kinds];
	here->seconds = kind->untimed ? 0 : seconds;
	must(!pipe(here->pipe_fd), "pipe");
	must(!socketpair(AF_UNIX, SOCK_DGRAM, 0, here->pair_fd), "socketpair");
	here->program_fd = open("/proc/self/exe", O_RDONLY);
	must(here->program_fd >= 0, "/proc/self/exe");
	here->epoll_fd = epoll_create1(0);
	must(here->epoll_fd >= 0 &&
		     !epoll_ctl(here->epoll_fd, EPOLL_CTL_ADD, here->pipe_fd[0], &event),
	     "epoll");
	/* An abstract address of the kernel's choice: nothing to clean up. */
	here->listen_fd = socket(AF_UNIX, SOCK_STREAM, 0);
	here->listen_at.sun_family = AF_UNIX;
	must(here->listen_fd >= 0 && !bind(here->listen_fd, (struct sockaddr *)&here->listen_at,
					   sizeof(sa_family_t)),
	     "bind");
	here->listen_len = sizeof(here->listen_at);
	must(!getsockname(here->listen_fd, (struct sockaddr *)&here->listen_at, &here->listen_len),
	     "getsockname");
	must(!listen(here->listen_fd, 8), "listen");
	if (here->seconds > 0) {
		set_timeout(here->listen_fd, SO_RCVTIMEO);
		set_timeout(here->pair_fd[0], SO_RCVTIMEO);
		set_timeout(here->pair_fd[0], SO_SNDTIMEO);
	}
	if (kind->call == do_semtimedop || kind->call == do_semop)
		must((here->sem_id = semget(IPC_PRIVATE, 1, 0600)) >= 0, "semget");
	if (kind->call == do_msgrcv)
		must((here->msg_id = msgget(IPC_PRIVATE, 0600)) >= 0, "msgget");
	if (kind->call == do_io_getevents && syscall(SYS_io_setup, 4, &here->aio) < 0)
		unavailable("io_setup");
}

static void record_timeout(uint64_t took_ns)
{
	count(TIMEOUTS, 1);
	if (!board->counter[SHORTEST] || took_ns < board->counter[SHORTEST])
		board->counter[SHORTEST] = took_ns;
	if (took_ns > board->counter[LONGEST])
		board->counter[LONGEST] = took_ns;
}

static void call_once(const struct kind *kind)
{
	const double seconds = here->seconds;
	uint64_t start_ns = now_ns(), took_ns;
	int result, err;

	board->counter[STARTED] = start_ns;
	result = kind->call();
	err = errno;
	took_ns = now_ns() - start_ns;
	count(CALLS, 1);
	count(KINDS + (unsigned int)(kind - kinds), 1);
	if (result > 0) {
		count(WAKES, 1);
	} else if (result == 0) {
		CHECK(seconds > 0, "%s has no timeout, and timed out", kind->name);
		/* Milliseconds are rounded, and so are the kernel's ticks. */
		CHECK((double)took_ns > seconds * 1e9 - 1e6, "%s of %.3f s was over after %.3f",
		      kind->name, seconds, (double)took_ns / 1e9);
		CHECK((double)took_ns < (seconds + late_seconds) * 1e9, "%s of %.3f s took %.3f",
		      kind->name, seconds, (double)took_ns / 1e9);
		record_timeout(took_ns);
	} else if (err == EINTR) {
		count(EINTRS, 1);
		complain("%s answered EINTR after %.3f s", kind->name, (double)took_ns / 1e9);
	} else {
		violation("%s answered %s", kind->name, strerror(err));
	}
}

/* One of "all". */
static void *call_for_ever(void *arg)
{
	const struct kind *kind = arg;

	here = &places[kind - kinds];
	for (;;)
		call_once(kind);
	return NULL;
}

static bool is_chosen(const struct kind *kind, const char *name)
{
	if (strcmp(name, "all"))
		return !strcmp(kind->name, name);
	return kind->call != do_io_getevents && !(quiet && kind->untimed);
}

/* Wakes every chosen kind each 50 ms, and beats. */
static void *wake_and_beat(void *arg)
{
	const struct kind *kind, *end = kinds + sizeof(kinds) / sizeof(kinds[0]);
	int i;

	for (i = 1;; i++) {
		nap_us(10000);
		beat();
		if (i % 5 || quiet)
			continue;
		for (kind = kinds; kind < end; kind++) {
			here = &places[kind - kinds];
			if (is_chosen(kind, arg) && kind->wake)
				kind->wake();
		}
	}
	return NULL;
}

int main(int argc, char **argv)
{
	const struct kind *kind, *end = kinds + sizeof(kinds) / sizeof(kinds[0]), *last = NULL;
	pthread_t thread;
	bool all;
	int i;

	quiet = victim_flag(&argc, argv, "--quiet");
	victim_start(&argc, argv, 2, "KIND|all SECONDS [--quiet] [--late S]");
	for (i = 3; i + 1 < argc; i++)
		if (!strcmp(argv[i], "--late"))
			late_seconds = atof(argv[i + 1]);
	all = !strcmp(argv[1], "all");
	/* SysV objects outlive a killed process, unless their namespace goes with it. */
	if ((all || strstr(argv[1], "sem") || strstr(argv[1], "msg")) &&
	    unshare(CLONE_NEWIPC) < 0 && errno != EPERM)
		must(false, "unshare");
	sigemptyset(&usr1);
	sigaddset(&usr1, SIGUSR1);
	waiting = usr1;
	sigaddset(&waiting, SIGUSR2);
	pthread_sigmask(SIG_BLOCK, &usr1, NULL);
	for (kind = kinds; kind < end; kind++)
		if (is_chosen(kind, argv[1])) {
			set_up(kind, atof(argv[2]));
			last = kind;
		}
	if (!last) {
		fprintf(stderr, "eintr: no kind is called %s; there are: all", argv[1]);
		for (kind = kinds; kind < end; kind++)
			fprintf(stderr, " %s", kind->name);
		fprintf(stderr, "\n");
		return 2;
	}
	for (kind = kinds; all && kind < end; kind++)
		if (is_chosen(kind, argv[1]))
			must(!pthread_create(&thread, NULL, call_for_ever, (void *)kind),
			     "pthread_create");
	if (!all && !quiet)
		must(!pthread_create(&thread, NULL, wake_and_beat, argv[1]), "pthread_create");
	victim_ready();
	if (all)
		wake_and_beat(argv[1]);
	for (;;) {
		call_once(last);
		if (quiet)
			beat();
	}
}
