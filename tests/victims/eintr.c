/* SPDX-License-Identifier: Apache-2.0
 *
 * eintr KIND SECONDS [--quiet] [--late S]: blocks in one system call, again and again.  No
 * signal is ever caught here (but by those calls that nothing else ends), so the call must
 * never answer EINTR, and a timeout must take its time: no less, and not much more.  All
 * registers are to be what they were (inlined.h).
 *
 * By default a second thread wakes the call every 50 ms (kinds that cannot be
 * woken run into their timeout) and beats.  With --quiet there is no other
 * thread: nothing but the timeout ends the call.  SECONDS 0 means no timeout,
 * for kinds that have one; kinds without one ignore it.  With --late a timeout
 * that comes more than S seconds too late is a violation, once a test has set PUNCTUAL.
 *
 * KIND "all" has a thread for every kind but io_(p)getevents and splice (with --quiet: every
 * kind that has a timeout), and main beats.
 *
 * On the board: counter 0 calls, 1 EINTRs (each is a violation, too, but it goes
 * on, so that they can be counted), 2 shortest and 3 longest time a call took that
 * ended by its timeout (ns), 4 timeouts, 5 wake-ups, 6 when the running call
 * was made (CLOCK_MONOTONIC ns), 7 PUNCTUAL; from 8 on the calls of each kind, as listed.
 */
#include <linux/aio_abi.h>
#include <linux/futex.h>
#include <mqueue.h>
#include <netinet/in.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/file.h>
#include <sys/inotify.h>
#include <sys/ipc.h>
#include <sys/msg.h>
#include <sys/select.h>
#include <sys/sem.h>
#include <sys/sendfile.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <sys/un.h>
#include <ucontext.h>

#include "inlined.h"

#define FUTEX_OF_32_BITS 2 /* FUTEX2_SIZE_U32; the headers may be older */
#define ERESTARTSYS 512    /* linux/errno.h; never to be seen by a program */

enum { CALLS, EINTRS, SHORTEST, LONGEST, TIMEOUTS, WAKES, STARTED, PUNCTUAL, KINDS = 8 };

static bool quiet;
static double late_seconds = 1e9;
static sigset_t usr1, waiting; /* the mask of this process, and another one */

/* What one kind works with. */
struct place {
	double seconds; /* 0: no timeout */
	struct timespec timeout;
	const char *name;
	void *constant; /* the same as `timeout`, in memory that can only be read */
	pthread_t thread;
	bool has_thread, call_is_pause, locked;
	volatile unsigned long handled, handled_before;
	int pipe_fd[2], pair_fd[2], lock_fd[2], listen_fd, epoll_fd, program_fd, sem_id, msg_id;
	int other_fd[2], count_fd, watch_fd, fifo_fd, tcp_fd;
	mqd_t queue;
	struct sockaddr_in tcp_at;
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

/* Newer architectures lack these: what their libc calls instead, and how it says how long. */
#ifdef SYS_epoll_wait
#define EPOLL_WAIT(...) CALL4(SYS_epoll_wait, __VA_ARGS__)
#define POLL(fds, n, ms) CALL3(SYS_poll, fds, n, ms)
#define SELECT(...) CALL5(SYS_select, __VA_ARGS__)
#define PAUSE() CALL2(SYS_pause, inlined_next(), inlined_next())
#define SELECT_UNIT_NS 1000
#else
#define EPOLL_WAIT(...) CALL6(SYS_epoll_pwait, __VA_ARGS__, NULL, 8)
#define POLL(fds, n, ms) CALL5(SYS_ppoll, fds, n, timeout(), NULL, 8)
#define SELECT(...) CALL6(SYS_pselect6, __VA_ARGS__, NULL)
#define PAUSE() CALL5(SYS_ppoll, NULL, 0, NULL, NULL, 8)
#define SELECT_UNIT_NS 1
#endif

/* In one line, with all registers checked (inlined.h). */
#define CALL6(nr, a, b, c, d, e, f)                                                         \
	inlined(here->name, nr, (uint64_t)(a), (uint64_t)(b), (uint64_t)(c), (uint64_t)(d), \
		(uint64_t)(e), (uint64_t)(f))
#define CALL5(nr, a, b, c, d, e) CALL6(nr, a, b, c, d, e, inlined_next())
#define CALL4(nr, a, b, c, d) CALL5(nr, a, b, c, d, inlined_next())
#define CALL3(nr, a, b, c) CALL4(nr, a, b, c, inlined_next())
#define CALL2(nr, a, b) CALL3(nr, a, b, inlined_next())

/* The calls: 1 woken, 0 timed out, -1 with errno. */

static int timed_out(long result)
{
	return result >= 0 ? 1 : errno == EAGAIN ? 0 : -1;
}

static int do_epoll_wait(void)
{
	struct epoll_event event;

	return drain(EPOLL_WAIT(here->epoll_fd, &event, 1, timeout_ms()));
}

static int do_epoll_pwait(void)
{
	struct epoll_event event;

	return drain(CALL6(SYS_epoll_pwait, here->epoll_fd, &event, 1, timeout_ms(), &waiting, 8));
}

static int do_epoll_pwait2(void)
{
	struct epoll_event event;

	return drain(CALL6(SYS_epoll_pwait2, here->epoll_fd, &event, 1, timeout(), &waiting, 8));
}

static int do_poll(void)
{
	struct pollfd fd = { .fd = here->pipe_fd[0], .events = POLLIN };

	return drain(POLL(&fd, 1, timeout_ms()));
}

static int do_ppoll(void)
{
	struct pollfd fd = { .fd = here->pipe_fd[0], .events = POLLIN };

	return drain(CALL5(SYS_ppoll, &fd, 1, timeout(), &waiting, 8));
}

static int do_ppoll_const(void)
{
	struct pollfd fd = { .fd = here->pipe_fd[0], .events = POLLIN };

	return drain(CALL5(SYS_ppoll, &fd, 1, here->constant, &waiting, 8));
}

static int do_select_with(void *tv)
{
	fd_set set;
	long n;

	FD_ZERO(&set);
	FD_SET(here->pipe_fd[0], &set);
	n = SELECT(here->pipe_fd[0] + 1, &set, NULL, NULL, tv);
	CHECK(n || !FD_ISSET(here->pipe_fd[0], &set), "select: nothing is ready, says its result");
	return drain(n);
}

static int do_select(void)
{
	struct timespec ts = after(here->seconds);

	ts.tv_nsec /= SELECT_UNIT_NS;
	return do_select_with(here->seconds > 0 ? &ts : NULL);
}

static int do_select_const(void)
{
	return do_select_with(here->constant);
}

struct mask_argument {
	const sigset_t *mask;
	size_t bytes;
};

static int do_pselect_with(void *ts)
{
	struct mask_argument mask = { &waiting, 8 };
	fd_set set;

	FD_ZERO(&set);
	FD_SET(here->pipe_fd[0], &set);
	return drain(CALL6(SYS_pselect6, here->pipe_fd[0] + 1, &set, NULL, NULL, ts, &mask));
}

static int do_pselect(void)
{
	return do_pselect_with(timeout());
}

static int do_pselect_const(void)
{
	return do_pselect_with(here->constant);
}

static int futex_wait(int op, struct timespec *ts)
{
	if (CALL6(SYS_futex, &here->word, op | FUTEX_PRIVATE_FLAG, 0, ts, 0,
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

static struct timespec *deadline(void)
{
	here->timeout = after((double)now_ns() / 1e9 + (here->seconds > 0 ? here->seconds : 1e6));
	return &here->timeout;
}

static int do_futex_abs(void)
{
	return futex_wait(FUTEX_WAIT_BITSET, deadline());
}

static int do_nanosleep(void)
{
	struct timespec ts = after(here->seconds > 0 ? here->seconds : 1e6);

	return (int)CALL2(SYS_nanosleep, &ts, NULL);
}

static int do_clock_nanosleep(void)
{
	struct timespec ts = after(here->seconds > 0 ? here->seconds : 1e6);

	return (int)CALL4(SYS_clock_nanosleep, CLOCK_MONOTONIC, 0, &ts, NULL);
}

static int do_clock_nanosleep_abs(void)
{
	return (int)CALL4(SYS_clock_nanosleep, CLOCK_MONOTONIC, TIMER_ABSTIME, deadline(), NULL);
}

static int do_read(void)
{
	char c;

	return (int)CALL3(SYS_read, here->pipe_fd[0], &c, 1);
}

static int accepted(long fd)
{
	if (fd >= 0)
		close((int)fd);
	return timed_out(fd);
}

static int do_accept(void)
{
	return accepted(CALL4(SYS_accept4, here->listen_fd, NULL, NULL, SOCK_CLOEXEC));
}

static int do_accept_old(void)
{
	return accepted(CALL3(SYS_accept, here->listen_fd, NULL, NULL));
}

static int do_connect(void)
{
	const int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
	int result;

	must(fd >= 0, "socket");
	if (here->seconds > 0)
		set_timeout(fd, SO_SNDTIMEO);
	result = timed_out(CALL3(SYS_connect, fd, &here->listen_at, here->listen_len));
	close(fd);
	return result;
}

static int do_recv(void)
{
	char c;

	return timed_out(CALL6(SYS_recvfrom, here->pair_fd[0], &c, 1, 0, NULL, NULL));
}

static int do_read_socket(void)
{
	char c;

	return timed_out(CALL3(SYS_read, here->pair_fd[0], &c, 1));
}

static int do_readv(void)
{
	char c;
	struct iovec to = { &c, 1 };

	return timed_out(CALL3(SYS_readv, here->pair_fd[0], &to, 1));
}

static int do_preadv2(void)
{
	char c;
	struct iovec to = { &c, 1 };

	return timed_out(CALL6(SYS_preadv2, here->pair_fd[0], &to, 1, -1, -1, 0));
}

static int do_recvmsg(void)
{
	char c;
	struct iovec to = { &c, 1 };
	struct msghdr message = { .msg_iov = &to, .msg_iovlen = 1 };

	return timed_out(CALL3(SYS_recvmsg, here->pair_fd[0], &message, 0));
}

static int do_recvmmsg(void)
{
	char c;
	struct iovec to = { &c, 1 };
	const struct mmsghdr message = { .msg_hdr = { .msg_iov = &to, .msg_iovlen = 1 } };
	struct mmsghdr two[] = { message, message };

	/* It may answer that it got one. */
	return timed_out(CALL5(SYS_recvmmsg, here->pair_fd[0], two, 2, 0, NULL));
}

/* Those that write wait when nobody has read the datagrams before. */

static int do_send(void)
{
	return timed_out(CALL6(SYS_sendto, here->pair_fd[0], "", 1, 0, NULL, 0));
}

static int do_write(void)
{
	return timed_out(CALL3(SYS_write, here->pair_fd[0], "", 1));
}

static int do_writev(void)
{
	struct iovec from = { "", 1 };

	return timed_out(CALL3(SYS_writev, here->pair_fd[0], &from, 1));
}

static int do_pwritev2(void)
{
	struct iovec from = { "", 1 };

	return timed_out(CALL6(SYS_pwritev2, here->pair_fd[0], &from, 1, -1, -1, 0));
}

static int do_sendmsg(void)
{
	struct iovec from = { "", 1 };
	struct msghdr message = { .msg_iov = &from, .msg_iovlen = 1 };

	return timed_out(CALL3(SYS_sendmsg, here->pair_fd[0], &message, 0));
}

static int do_sendmmsg(void)
{
	struct iovec from = { "", 1 };
	struct mmsghdr message = { .msg_hdr = { .msg_iov = &from, .msg_iovlen = 1 } };

	return timed_out(CALL4(SYS_sendmmsg, here->pair_fd[0], &message, 1, 0));
}

static int do_sendfile(void)
{
	off_t at = 0;

	return timed_out(CALL4(SYS_sendfile, here->pair_fd[0], here->program_fd, &at, 1));
}

static int do_splice(void)
{
	if (timed_out(CALL6(SYS_splice, here->pair_fd[0], NULL, here->pipe_fd[1], NULL, 1, 0)))
		return drain(1);
	return 0;
}

static int do_sigtimedwait(void)
{
	return timed_out(CALL4(SYS_rt_sigtimedwait, &usr1, NULL, timeout(), 8));
}

static int sem_take(long nr, struct timespec *ts)
{
	struct sembuf take = { .sem_op = -1 };

	return timed_out(CALL4(nr, here->sem_id, &take, 1, ts));
}

static int do_semtimedop(void)
{
	return sem_take(SYS_semtimedop, timeout());
}

static int do_semop(void)
{
	return sem_take(SYS_semop, NULL);
}

struct message {
	long type;
	char text[8];
};

static int do_msgrcv(void)
{
	struct message message;

	return CALL5(SYS_msgrcv, here->msg_id, &message, sizeof(message.text), 0, 0) < 0 ? -1 : 1;
}

static int do_msgsnd(void)
{
	struct message message = { .type = 1 };

	return CALL4(SYS_msgsnd, here->msg_id, &message, sizeof(message.text), 0) < 0 ? -1 : 1;
}

static int do_futex_waitv(void)
{
	const struct {
		uint64_t value, address;
		uint32_t flags, reserved;
	} waiter = { 0, (uintptr_t)&here->word, FUTEX_OF_32_BITS | FUTEX_PRIVATE_FLAG, 0 };

	if (CALL5(SYS_futex_waitv, &waiter, 1, 0, deadline(), CLOCK_MONOTONIC) < 0 &&
	    errno != EAGAIN)
		return errno == ETIMEDOUT ? 0 : -1;
	__atomic_store_n(&here->word, 0, __ATOMIC_SEQ_CST);
	return 1;
}

/* Who wakes it locks it again. */
static int do_futex_pi(void)
{
	if (CALL4(SYS_futex, &here->word, FUTEX_LOCK_PI | FUTEX_PRIVATE_FLAG, 0, NULL) < 0)
		return -1;
	must(syscall(SYS_futex, &here->word, FUTEX_UNLOCK_PI | FUTEX_PRIVATE_FLAG, 0, NULL) == 0,
	     "FUTEX_UNLOCK_PI");
	return 1;
}

static struct timespec *date(clockid_t clock)
{
	struct timespec now;

	clock_gettime(clock, &now);
	here->timeout = after((double)now.tv_sec + (double)now.tv_nsec / 1e9 +
			      (here->seconds > 0 ? here->seconds : 1e6));
	return &here->timeout;
}

static int do_clock_nanosleep_tai(void)
{
	return (int)CALL4(SYS_clock_nanosleep, CLOCK_TAI, TIMER_ABSTIME, date(CLOCK_TAI), NULL);
}

static int do_mq_receive(void)
{
	char text[8];

	if (CALL5(SYS_mq_timedreceive, here->queue, text, sizeof text, NULL,
		  here->seconds > 0 ? date(CLOCK_REALTIME) : NULL) < 0)
		return errno == ETIMEDOUT ? 0 : -1;
	return 1;
}

static int do_mq_send(void)
{
	if (CALL5(SYS_mq_timedsend, here->queue, "", 1, 0,
		  here->seconds > 0 ? date(CLOCK_REALTIME) : NULL) < 0)
		return errno == ETIMEDOUT ? 0 : -1;
	return 1;
}

static int do_open(void)
{
	char path[32];
	long fd;

	snprintf(path, sizeof(path), "/proc/self/fd/%d", here->fifo_fd);
	fd = CALL4(SYS_openat, AT_FDCWD, path, O_RDONLY | O_CLOEXEC, 0);
	if (fd < 0)
		return -1;
	close((int)fd);
	return 1;
}

static int do_eventfd(void)
{
	uint64_t n;

	return CALL3(SYS_read, here->count_fd, &n, sizeof n) < 0 ? -1 : 1;
}

static int do_inotify(void)
{
	char event[512];

	return CALL3(SYS_read, here->watch_fd, event, sizeof event) < 0 ? -1 : 1;
}

/* To a port whose queue is full: it is accepted with the next of its SYNs, seconds later. */
static int do_connect_tcp(void)
{
	const int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
	int result = 1;

	must(fd >= 0, "socket");
	if (here->seconds > 0)
		set_timeout(fd, SO_SNDTIMEO);
	/* EALREADY: made again by a restored process, for which nobody ends it in time. */
	if (CALL3(SYS_connect, fd, &here->tcp_at, sizeof here->tcp_at) < 0)
		result = errno == EINPROGRESS || errno == EALREADY ? 0 : -1;
	close(fd);
	return result;
}

static int do_tee(void)
{
	const long n = CALL4(SYS_tee, here->pipe_fd[0], here->other_fd[1], 1, 0);
	char c;

	if (n == 1)
		must(read(here->other_fd[0], &c, 1) == 1, "read");
	return drain(n);
}

static int do_io_getevents(void)
{
	struct io_event event;

	return (int)CALL5(SYS_io_getevents, here->aio, 1, 1, &event, timeout());
}

static int do_io_pgetevents(void)
{
	struct mask_argument mask = { &waiting, 8 };
	struct io_event event;

	return (int)CALL6(SYS_io_pgetevents, here->aio, 1, 1, &event, timeout(), &mask);
}

/* Locks: another open file has it, until it is woken; then it gets it again. */

static int do_flock(void)
{
	if (CALL2(SYS_flock, here->lock_fd[0], LOCK_EX) < 0)
		return -1;
	must(!flock(here->lock_fd[0], LOCK_UN) && !flock(here->lock_fd[1], LOCK_EX), "flock");
	return 1;
}

static void lock_range(int fd, int type)
{
	struct flock range = { .l_type = (short)type };

	must(!fcntl(fd, F_OFD_SETLKW, &range), "fcntl");
}

static int do_fcntl(void)
{
	struct flock range = { .l_type = F_WRLCK };

	if (CALL3(SYS_fcntl, here->lock_fd[0], F_OFD_SETLKW, &range) < 0)
		return -1;
	lock_range(here->lock_fd[0], F_UNLCK);
	lock_range(here->lock_fd[1], F_WRLCK);
	return 1;
}

/* Those that a signal ends.  Its handler sees the thread just behind its call, and on its
 * own stack. */

static int interrupted(long result)
{
	return result < 0 && errno == EINTR && here->handled != here->handled_before ? 1 : -1;
}

static int do_pause(void)
{
	here->handled_before = here->handled;
	return interrupted(PAUSE());
}

static int do_sigsuspend(void)
{
	here->handled_before = here->handled;
	return interrupted(CALL2(SYS_rt_sigsuspend, &usr1, 8));
}

static void handle(int signal, siginfo_t *info, void *context)
{
	const ucontext_t *was = context;
	const uintptr_t sp = INLINED_SP(was), at = (uintptr_t)&was;

	(void)signal;
	(void)info;
	CHECK(at < sp && sp - at < 16384, "a handler runs %#lx away from its stack", sp - at);
	if (!here)
		return; /* not one of "all" */
	if (here->call_is_pause && INLINED_PC(was) == (uintptr_t)inlined_after)
		CHECK(INLINED_RESULT(was) == -EINTR, "%s: a handler sees the result %#lx",
		      here->name, (unsigned long)INLINED_RESULT(was));
	here->handled++;
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

/* Takes one out of a queue that is full. */
static void wake_connect(void)
{
	const int fd = accept4(here->listen_fd, NULL, NULL, SOCK_CLOEXEC);

	must(fd >= 0, "accept");
	close(fd);
}

static void wake_flock(void)
{
	must(!flock(here->lock_fd[1], LOCK_UN), "flock");
}

static void wake_fcntl(void)
{
	lock_range(here->lock_fd[1], F_UNLCK);
}

static void wake_thread(void)
{
	if (here->has_thread)
		pthread_kill(here->thread, SIGUSR2);
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

static void wake_msgsnd(void)
{
	struct message message;

	while (msgrcv(here->msg_id, &message, sizeof(message.text), 0, IPC_NOWAIT) >= 0)
		;
	must(errno == ENOMSG, "msgrcv");
}

static void wake_futex_pi(void)
{
	if (here->locked)
		must(syscall(SYS_futex, &here->word, FUTEX_UNLOCK_PI | FUTEX_PRIVATE_FLAG, 0,
			     NULL) == 0,
		     "FUTEX_UNLOCK_PI");
	while (syscall(SYS_futex, &here->word, FUTEX_LOCK_PI | FUTEX_PRIVATE_FLAG, 0, NULL))
		must(errno == EINTR || errno == EAGAIN, "FUTEX_LOCK_PI");
	here->locked = true;
}

static void wake_mq_receive(void)
{
	must(!mq_send(here->queue, "", 1, 0) || errno == EAGAIN, "mq_send");
}

static void wake_mq_send(void)
{
	const struct timespec past = { 0 };
	char text[8];

	while (mq_timedreceive(here->queue, text, sizeof text, NULL, &past) >= 0)
		;
	must(errno == ETIMEDOUT, "mq_receive");
}

static void wake_open(void)
{
	char path[32];
	int fd;

	snprintf(path, sizeof(path), "/proc/self/fd/%d", here->fifo_fd);
	fd = open(path, O_WRONLY | O_NONBLOCK | O_CLOEXEC);
	must(fd >= 0 || errno == ENXIO, path);
	if (fd >= 0)
		close(fd);
}

static void wake_eventfd(void)
{
	must(!eventfd_write(here->count_fd, 1), "write");
}

static void wake_inotify(void)
{
	char path[32];

	snprintf(path, sizeof(path), "/proc/self/fd/%d", here->fifo_fd);
	must(!chmod(path, 0600), path);
}

static void wake_connect_tcp(void)
{
	const int fd = accept4(here->tcp_fd, NULL, NULL, SOCK_CLOEXEC | SOCK_NONBLOCK);

	if (fd >= 0)
		close(fd);
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
	{ "io_pgetevents", do_io_pgetevents, NULL, false },
	{ "ppoll_const", do_ppoll_const, wake_pipe, false },
	{ "select_const", do_select_const, wake_pipe, false },
	{ "pselect_const", do_pselect_const, wake_pipe, false },
	{ "accept_old", do_accept_old, wake_accept, false },
	{ "connect", do_connect, wake_connect, false },
	{ "read_socket", do_read_socket, wake_recv, false },
	{ "readv", do_readv, wake_recv, false },
	{ "recvmsg", do_recvmsg, wake_recv, false },
	{ "recvmmsg", do_recvmmsg, wake_recv, false },
	{ "send", do_send, wake_send, false },
	{ "write", do_write, wake_send, false },
	{ "writev", do_writev, wake_send, false },
	{ "pwritev2", do_pwritev2, wake_send, false },
	{ "sendmsg", do_sendmsg, wake_send, false },
	{ "sendmmsg", do_sendmmsg, wake_send, false },
	{ "splice", do_splice, wake_recv, false },
	{ "flock", do_flock, wake_flock, true },
	{ "fcntl", do_fcntl, wake_fcntl, true },
	{ "pause", do_pause, wake_thread, true },
	{ "sigsuspend", do_sigsuspend, wake_thread, true },
	{ "msgsnd", do_msgsnd, wake_msgsnd, true },
	{ "futex_waitv", do_futex_waitv, wake_futex, false },
	{ "futex_pi", do_futex_pi, wake_futex_pi, true },
	{ "clock_nanosleep_tai", do_clock_nanosleep_tai, NULL, false },
	{ "mq_receive", do_mq_receive, wake_mq_receive, false },
	{ "mq_send", do_mq_send, wake_mq_send, false },
	{ "open", do_open, wake_open, true },
	{ "eventfd", do_eventfd, wake_eventfd, true },
	{ "inotify", do_inotify, wake_inotify, true },
	{ "connect_tcp", do_connect_tcp, wake_connect_tcp, false },
	{ "tee", do_tee, wake_pipe, true },
};

static struct place places[sizeof(kinds) / sizeof(kinds[0])];

static bool is_aio(const struct kind *kind)
{
	return kind->call == do_io_getevents || kind->call == do_io_pgetevents;
}

static void *constant(long unit_ns)
{
	struct timespec *ts = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS,
				   -1, 0);

	must(ts != MAP_FAILED, "mmap");
	*ts = after(here->seconds);
	ts->tv_nsec /= unit_ns;
	must(!mprotect(ts, 4096, PROT_READ), "mprotect");
	return ts;
}

static void fill_queue(void)
{
	int fd;

	do {
		fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
		must(fd >= 0, "socket");
	} while (!connect(fd, (struct sockaddr *)&here->listen_at, here->listen_len));
	must(errno == EAGAIN, "connect");
	close(fd);
}

static void open_locked(bool whole)
{
	char path[32];

	here->lock_fd[0] = memfd_create("eintr", MFD_CLOEXEC);
	snprintf(path, sizeof(path), "/proc/self/fd/%d", here->lock_fd[0]);
	here->lock_fd[1] = open(path, O_RDWR | O_CLOEXEC);
	must(here->lock_fd[1] >= 0, path);
	if (whole)
		must(!flock(here->lock_fd[1], LOCK_EX), "flock");
	else
		lock_range(here->lock_fd[1], F_WRLCK);
}

static void make_fifo(void)
{
	char path[32] = "/tmp/eintr-XXXXXX";

	must(mkdtemp(path) != NULL, path);
	here->watch_fd = inotify_init1(IN_CLOEXEC);
	must(!chdir(path) && !mkfifo("fifo", 0600), path);
	here->fifo_fd = open("fifo", O_PATH | O_CLOEXEC);
	must(here->fifo_fd >= 0 && inotify_add_watch(here->watch_fd, "fifo", IN_ATTRIB) >= 0, path);
	must(!unlink("fifo") && !chdir("/") && !rmdir(path), path);
}

static void open_queue(void)
{
	struct mq_attr attr = { .mq_maxmsg = 8, .mq_msgsize = 8 };
	char name[32];

	snprintf(name, sizeof(name), "/eintr-%d-%d", getpid(), (int)(here - places));
	here->queue = mq_open(name, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0600, &attr);
	if (here->queue < 0)
		unavailable("mq_open");
	must(!mq_unlink(name), name);
}

static void listen_tcp(void)
{
	socklen_t bytes = sizeof here->tcp_at;

	here->tcp_at.sin_family = AF_INET;
	here->tcp_at.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
	here->tcp_fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
	must(here->tcp_fd >= 0 &&
		     !bind(here->tcp_fd, (struct sockaddr *)&here->tcp_at, sizeof here->tcp_at) &&
		     !listen(here->tcp_fd, 0) &&
		     !getsockname(here->tcp_fd, (struct sockaddr *)&here->tcp_at, &bytes),
	     "listen");
	for (int i = 0; i < 2; i++) {
		const int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);

		must(fd >= 0 && (!connect(fd, (struct sockaddr *)&here->tcp_at, bytes) ||
				 errno == EINPROGRESS),
		     "connect");
	}
}

static void set_up(const struct kind *kind, double seconds)
{
	struct epoll_event event = { .events = EPOLLIN };

	here = &places[kind - kinds];
	here->name = kind->name;
	here->seconds = kind->untimed ? 0 : seconds;
	here->constant = here->seconds > 0
				 ? constant(kind->call == do_select_const ? SELECT_UNIT_NS : 1)
				 : NULL;
	here->call_is_pause = kind->call == do_pause || kind->call == do_sigsuspend;
	must(!pipe(here->pipe_fd), "pipe");
	must(!socketpair(AF_UNIX, kind->call == do_splice ? SOCK_STREAM : SOCK_DGRAM, 0,
			 here->pair_fd),
	     "socketpair");
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
	must(!listen(here->listen_fd, kind->call == do_connect ? 0 : 8), "listen");
	if (kind->call == do_connect)
		fill_queue();
	if (kind->call == do_flock || kind->call == do_fcntl)
		open_locked(kind->call == do_flock);
	if (here->seconds > 0) {
		set_timeout(here->listen_fd, SO_RCVTIMEO);
		set_timeout(here->pair_fd[0], SO_RCVTIMEO);
		set_timeout(here->pair_fd[0], SO_SNDTIMEO);
	}
	if (kind->call == do_semtimedop || kind->call == do_semop)
		must((here->sem_id = semget(IPC_PRIVATE, 1, 0600)) >= 0, "semget");
	if (kind->call == do_msgrcv)
		must((here->msg_id = msgget(IPC_PRIVATE, 0600)) >= 0, "msgget");
	if (kind->call == do_msgsnd)
		must((here->msg_id = msgget(IPC_PRIVATE, 0600)) >= 0, "msgget");
	here->count_fd = eventfd(0, EFD_CLOEXEC);
	must(here->count_fd >= 0 && !pipe2(here->other_fd, O_CLOEXEC), "eventfd");
	if (kind->call == do_open || kind->call == do_inotify)
		make_fifo();
	if (kind->call == do_mq_receive || kind->call == do_mq_send)
		open_queue();
	if (kind->call == do_connect_tcp)
		listen_tcp();
	if (is_aio(kind) && syscall(SYS_io_setup, 4, &here->aio) < 0)
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

/* By how much a call may be over too soon.  A socket's time is counted in ticks, of which some may be
 * late when it begins, and the last one is lost to whatever wakes it, as a stop does. */
static double rounded_ns(const struct kind *kind)
{
	const bool in_ticks = kind->wake == wake_accept || kind->wake == wake_recv ||
			      kind->wake == wake_send || kind->wake == wake_connect ||
			      kind->wake == wake_connect_tcp;

	return in_ticks ? 3 * 4e6 : 1e6;
}

static void call_once(const struct kind *kind)
{
	const double seconds = here->seconds;
	const bool punctual = board->counter[PUNCTUAL];
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
		CHECK((double)took_ns > seconds * 1e9 - rounded_ns(kind),
		      "%s of %.3f s was over after %.3f", kind->name, seconds,
		      (double)took_ns / 1e9);
		CHECK(!punctual || (double)took_ns < (seconds + late_seconds) * 1e9,
		      "%s of %.3f s took %.3f", kind->name, seconds, (double)took_ns / 1e9);
		record_timeout(took_ns);
	} else if (err == EINTR) {
		count(EINTRS, 1);
		complain("%s answered EINTR after %.3f s", kind->name, (double)took_ns / 1e9);
	} else if (err == ERESTARTSYS && kind->call == do_recvmmsg) {
		/* The kernel's own: the call before, interrupted when it had one message, has left
		 * it to the socket (net/socket.c, do_recvmmsg()). */
		complain("%s answered ERESTARTSYS", kind->name);
	} else {
		violation("%s answered %s", kind->name, strerror(err));
	}
}

/* One of "all". */
static void *call_for_ever(void *arg)
{
	const struct kind *kind = arg;

	here = &places[kind - kinds];
	if (kind->call == do_sigsuspend)
		pthread_sigmask(SIG_BLOCK, &waiting, NULL);
	here->thread = pthread_self();
	__atomic_store_n(&here->has_thread, true, __ATOMIC_SEQ_CST);
	for (;;)
		call_once(kind);
	return NULL;
}

static bool is_chosen(const struct kind *kind, const char *name)
{
	if (strcmp(name, "all"))
		return !strcmp(kind->name, name);
	/* splice(2) keeps its pipe locked for as long, and others who ask it anything waiting. */
	return !is_aio(kind) && kind->call != do_splice && !(quiet && kind->untimed);
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
	const struct sigaction action = { .sa_sigaction = handle, .sa_flags = SA_SIGINFO };
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
	must(!sigaction(SIGUSR2, &action, NULL), "sigaction");
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
	here = &places[last - kinds];
	for (;;) {
		call_once(last);
		if (quiet)
			beat();
	}
}
