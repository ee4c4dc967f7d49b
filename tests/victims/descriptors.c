/* SPDX-License-Identifier: Apache-2.0
 *
 * Descriptors of every kind, disturbed after a checkpoint and looked at after a restore.
 *
 *   descriptors SCENARIO FOLDER     see scenario.h
 */
#include <arpa/inet.h>
#include <grp.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <pthread.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/file.h>
#include <sys/ioctl.h>
#include <sys/resource.h>
#include <sys/signalfd.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/timerfd.h>

#include "scenario.h"

static int open_count(void)
{
	int count = 0;

	for (int f = 0; f < 1100; f++)
		count += is_open(f);
	return count;
}

/* ---- opened since --------------------------------------------------------------- */

static int count_at_start;

static void opened_setup(void)
{
	count_at_start = open_count();
}

static void opened_disturb(void)
{
	int ends[2];

	for (int i = 0; i < 20; i++)
		must(open("/etc/passwd", O_RDONLY) >= 0, "open");
	must(pipe(ends) == 0 && socketpair(AF_UNIX, SOCK_STREAM, 0, ends) == 0, "pipe");
	must(dup2(0, 900) == 900 && eventfd(0, 0) >= 0 && epoll_create1(0) >= 0, "dup2");
}

static void opened_verify(void)
{
	CHECK(open_count() == count_at_start, "%d descriptors are open instead of %d", open_count(),
	      count_at_start);
}

/* ---- closed since ----------------------------------------------------------------- */

static void closed_setup(void)
{
	fd[0] = make_file("closed", "0123456789", O_RDWR);
	lseek(fd[0], 4, SEEK_SET);
	fd[1] = open(folder, O_RDONLY | O_DIRECTORY | O_CLOEXEC);
	must(mkfifo(path_of("fifo"), 0600) == 0 || errno == EEXIST, "mkfifo");
	fd[2] = open(path_of("fifo"), O_RDWR | O_NONBLOCK);
	fd[3] = open("/dev/zero", O_RDONLY);
	fd[4] = dup(fd[0]);
	fd[5] = open(path_of("closed"), O_PATH | O_CLOEXEC);
	fd[6] = open(path_of("fifo"), O_WRONLY | O_NONBLOCK);
	must(dup2(fd[0], 700) == 700, "dup2");
	fd[7] = 700;
	fd[8] = make_file("appended", "abc", O_WRONLY | O_APPEND | O_CLOEXEC);
}

static void closed_disturb(void)
{
	for (int i = 0; i <= 8; i++)
		close(fd[i]);
}

static void closed_verify(void)
{
	struct stat st, other;

	for (int i = 0; i <= 8; i++)
		CHECK(is_open(fd[i]), "descriptor %d of closed_setup() is not open", i);
	expect_text(fd[0], "456789", "a closed file");
	CHECK(lseek(fd[4], 0, SEEK_CUR) == 10 && lseek(700, 0, SEEK_CUR) == 10,
	      "what shared an offset does not any more");
	lseek(fd[4], 4, SEEK_SET);
	CHECK(write(fd[0], "4", 1) == 1, "a file opened again cannot be written: %s",
	      strerror(errno));
	lseek(fd[4], 4, SEEK_SET);
	CHECK((fcntl(fd[0], F_GETFL) & O_ACCMODE) == O_RDWR, "not read-write");
	CHECK(!fcntl(fd[0], F_GETFD) && fcntl(fd[1], F_GETFD) == FD_CLOEXEC &&
		      fcntl(fd[5], F_GETFD) == FD_CLOEXEC && fcntl(fd[8], F_GETFD) == FD_CLOEXEC &&
		      !fcntl(fd[2], F_GETFD),
	      "O_CLOEXEC is not what it was");
	CHECK(fstat(fd[1], &st) == 0 && S_ISDIR(st.st_mode), "not a directory");
	CHECK(fstat(fd[2], &st) == 0 && S_ISFIFO(st.st_mode), "not a fifo");
	CHECK((fcntl(fd[2], F_GETFL) & (O_ACCMODE | O_NONBLOCK)) == (O_RDWR | O_NONBLOCK),
	      "not that of a fifo");
	CHECK((fcntl(fd[6], F_GETFL) & (O_ACCMODE | O_NONBLOCK)) == (O_WRONLY | O_NONBLOCK),
	      "not to write");
	CHECK(read(fd[3], scratch, 8) == 8 && fstat(fd[3], &st) == 0 && S_ISCHR(st.st_mode),
	      "not /dev/zero");
	CHECK(fcntl(fd[5], F_GETFL) & O_PATH, "not O_PATH");
	CHECK(fstat(fd[5], &other) == 0 && fstat(fd[0], &st) == 0 && st.st_ino == other.st_ino,
	      "another file");
	CHECK(fcntl(fd[8], F_GETFL) & O_APPEND, "not O_APPEND");
}

/* ---- replaced since, and a second open file description of the same file ------------ */

static void replaced_setup(void)
{
	fd[0] = make_file("one", "the first file", O_RDONLY);
	fd[1] = make_file("two", "the second file", O_RDONLY);
	fd[2] = open(path_of("one"), O_RDONLY);
	fd[3] = dup(fd[2]);
	fd[4] = open(path_of("one"), O_RDONLY | O_CLOEXEC);
	lseek(fd[0], 4, SEEK_SET);
	lseek(fd[2], 10, SEEK_SET);
}

static void replaced_disturb(void)
{
	must(dup2(fd[1], fd[0]) == fd[0], "dup2"); /* another file */
	must(dup2(fd[4], fd[2]) == fd[2], "dup2"); /* another description of the same */
	close(fd[1]);
	must(open("/etc/hostname", O_RDONLY) == fd[1] || true, "open");
	fcntl(fd[4], F_SETFD, 0);
	lseek(fd[4], 1, SEEK_SET);
}

static void replaced_verify(void)
{
	expect_text(fd[0], "first file", "a replaced file");
	expect_text(fd[1], "the second file", "a closed and reused descriptor");
	CHECK(lseek(fd[2], 0, SEEK_CUR) == 10 && lseek(fd[3], 0, SEEK_CUR) == 10, "not at 10");
	CHECK(lseek(fd[4], 0, SEEK_CUR) == 0, "the third is at %ld",
	      (long)lseek(fd[4], 0, SEEK_CUR));
	lseek(fd[3], 12, SEEK_SET);
	CHECK(lseek(fd[2], 0, SEEK_CUR) == 12 && lseek(fd[4], 0, SEEK_CUR) == 0,
	      "shares with the wrong one");
	lseek(fd[2], 10, SEEK_SET);
	lseek(fd[0], 4, SEEK_SET);
	lseek(fd[1], 0, SEEK_SET);
	CHECK(fcntl(fd[4], F_GETFD) == FD_CLOEXEC, "O_CLOEXEC has gone");
}

/* ---- deleted, but still mapped -------------------------------------------------------- */

static void deleted_setup(void)
{
	fd[0] = make_file("deleted", "still here", O_RDWR);
	must(unlink(path_of("deleted")) == 0, "unlink");
	must(mmap(NULL, 4096, PROT_READ, MAP_SHARED, fd[0], 0) != MAP_FAILED, "mmap");
}

static void deleted_disturb(void)
{
	close(fd[0]);
}

static void deleted_verify(void)
{
	expect_text(fd[0], "still here", "a deleted file");
	lseek(fd[0], 0, SEEK_SET);
}

/* ---- never had a name ------------------------------------------------------------------ */

static void unnamed_setup(void)
{
	fd[0] = open(folder, O_TMPFILE | O_RDWR | O_CLOEXEC, 0600);
	if (fd[0] < 0)
		unavailable("O_TMPFILE");
	must(write(fd[0], "still here", 10) == 10 && lseek(fd[0], 0, SEEK_SET) == 0, "write");
	must(mmap(NULL, 4096, PROT_READ, MAP_SHARED, fd[0], 0) != MAP_FAILED, "mmap");
}

/* ---- more than can be undone one by one ----------------------------------------------- */

enum { SEMAPHORES = 60, COUNTED = 5 };
static const uint64_t enormous = UINT64_C(1) << 40;

static void semaphores_setup(void)
{
	const uint64_t counted = COUNTED;

	for (int i = 0; i < SEMAPHORES; i++) {
		fd[i] = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC | (i % 2 ? 0 : EFD_SEMAPHORE));
		must(fd[i] >= 0 && (i % 3 || write(fd[i], &counted, 8) == 8), "eventfd");
	}
}

static void semaphores_disturb(void)
{
	for (int i = 0; i < SEMAPHORES; i++)
		must(write(fd[i], &enormous, 8) == 8, "write");
}

static void semaphores_verify(void)
{
	for (int i = 0; i < SEMAPHORES; i++) {
		const uint64_t counted = i % 3 ? 0 : COUNTED;
		uint64_t value, sum = 0;

		while (sum <= COUNTED && read(fd[i], &value, 8) == 8)
			sum += value;
		CHECK(sum == counted, "eventfd %d holds %lu and not %lu", i, sum, counted);
		must(!counted || write(fd[i], &counted, 8) == 8, "write");
	}
}

enum { MANY = 19000 };

/* Not one after the other either. */
static void many_disturb(void)
{
	victim_lift_descriptors();
	for (int i = 0; i < MANY; i++)
		must(open("/dev/null", O_RDONLY) >= 0, "open");
	for (int i = 100; i < MANY; i += 1000)
		close(i);
}

static void many_verify(void)
{
	for (int i = 10; i < MANY; i++)
		CHECK(!is_open(i), "descriptor %d is still open", i);
}

/* ---- what it may not open any more --------------------------------------------------- */

/* The test takes everybody's rights to the first file away. */
static void revoked_setup(void)
{
	fd[0] = make_file("revoked", "0123456789", O_RDWR);
	fd[1] = make_file("allowed", "0123456789", O_RDWR);
	must(!fchmod(fd[0], 0666) && !fchmod(fd[1], 0666), "fchmod");
	must(!setgroups(0, NULL) && !setresgid(65534, 65534, 65534) &&
		     !setresuid(65534, 65534, 65534),
	     "setresuid");
}

static void revoked_disturb(void)
{
	close(fd[0]);
	close(fd[1]);
}

static void revoked_verify(void)
{
	lseek(fd[1], 0, SEEK_SET);
	expect_text(fd[1], "0123456789", "a file that it may open");
	CHECK(read(fd[0], scratch, 10) == 0, "a file that it may not open any more is open again");
}

/* ---- gone for good: reads as empty, and is told ------------------------------------------ */

static void gone_setup(void)
{
	fd[0] = make_file("gone", "not for long", O_RDWR);
	must(unlink(path_of("gone")) == 0, "unlink");
}

static void gone_verify(void)
{
	CHECK(read(fd[0], scratch, 10) == 0, "something is read from what has gone");
}

/* ---- offsets --------------------------------------------------------------------------- */

static void offset_setup(void)
{
	fd[0] = make_file("numbers", "0123456789", O_RDWR);
	fd[1] = make_file("log", "line\n", O_RDWR | O_APPEND);
	lseek(fd[0], 3, SEEK_SET);
}

static void offset_disturb(void)
{
	must(read(fd[0], scratch, 4) == 4, "read");
	must(write(fd[1], "more\n", 5) == 5, "write");
}

static void offset_verify(void)
{
	CHECK(lseek(fd[0], 0, SEEK_CUR) == 3, "at %ld instead of 3",
	      (long)lseek(fd[0], 0, SEEK_CUR));
	CHECK(lseek(fd[1], 0, SEEK_CUR) > 5, "what is appended to was rewound");
}

static void keep_verify(void)
{
	CHECK(lseek(fd[0], 0, SEEK_CUR) == 7, "at %ld instead of 7",
	      (long)lseek(fd[0], 0, SEEK_CUR));
	lseek(fd[0], 3, SEEK_SET);
}

/* ---- lost sockets and pipes ----------------------------------------------------------------- */

static int listener;

static int connect_to(int server)
{
	struct sockaddr_in address;
	socklen_t bytes = sizeof address;
	int s = socket(AF_INET, SOCK_STREAM, 0);

	must(getsockname(server, (struct sockaddr *)&address, &bytes) == 0, "getsockname");
	must(connect(s, (struct sockaddr *)&address, sizeof address) == 0, "connect");
	return s;
}

static int listen_somewhere(void)
{
	struct sockaddr_in address = { .sin_family = AF_INET,
				       .sin_addr.s_addr = htonl(INADDR_LOOPBACK) };
	int s = socket(AF_INET, SOCK_STREAM, 0);

	must(bind(s, (struct sockaddr *)&address, sizeof address) == 0 && listen(s, 7) == 0,
	     "listen");
	return s;
}

static void lost_setup(void)
{
	int ends[2];
	struct sockaddr_in address = { .sin_family = AF_INET,
				       .sin_addr.s_addr = htonl(INADDR_LOOPBACK) };

	signal(SIGPIPE, SIG_IGN);
	listener = listen_somewhere();
	fd[0] = connect_to(listener);
	fd[1] = accept(listener, NULL, NULL);
	must(socketpair(AF_UNIX, SOCK_STREAM, 0, ends) == 0, "socketpair");
	fd[2] = ends[0];
	close(ends[1]);
	must(pipe(ends) == 0, "pipe");
	fd[3] = ends[0];
	close(ends[1]);
	fd[4] = socket(AF_INET, SOCK_DGRAM, 0);
	must(bind(fd[4], (struct sockaddr *)&address, sizeof address) == 0, "bind");
	fd[5] = listener;
	must(getsockname(fd[5], (struct sockaddr *)scratch, &(socklen_t){ 64 }) == 0,
	     "getsockname");
	memcpy(&fd[6], scratch, 8); /* family, port, address */
	must(getsockname(fd[4], (struct sockaddr *)scratch, &(socklen_t){ 64 }) == 0,
	     "getsockname");
	memcpy(&fd[8], scratch, 8);
}

static void lost_disturb(void)
{
	for (int i = 0; i <= 5; i++)
		close(fd[i]);
}

static void lost_verify(void)
{
	struct sockaddr_in address;
	socklen_t bytes = sizeof address;
	struct stat st;
	int client, server;

	for (int i = 0; i <= 3; i++) {
		struct pollfd p = { .fd = fd[i], .events = POLLIN };
		ssize_t n = read(fd[i], scratch, 10);

		/* Of a connection, once: listeners.c, received_verify() */
		if (i <= 1 && n < 0 && errno == ECONNRESET)
			n = read(fd[i], scratch, 10);
		CHECK(n == 0, "lost descriptor %d: read says %zd, %s", i, n, strerror(errno));
		CHECK(poll(&p, 1, 0) == 1 && p.revents & (POLLHUP | POLLIN),
		      "lost descriptor %d is not readable", i);
		CHECK(i == 3 || write(fd[i], "x", 1) < 0, "lost descriptor %d can be written", i);
	}
	CHECK(fstat(fd[3], &st) == 0 && S_ISFIFO(st.st_mode), "the pipe is none");
	CHECK(getsockname(fd[4], (struct sockaddr *)&address, &bytes) == 0 &&
		      !memcmp(&address, &fd[8], 8),
	      "the UDP socket is not bound where it was");
	CHECK(getsockname(fd[5], (struct sockaddr *)&address, &bytes) == 0 &&
		      !memcmp(&address, &fd[6], 8),
	      "the listening socket is not bound where it was");
	client = connect_to(fd[5]);
	server = accept(fd[5], NULL, NULL);
	CHECK(server >= 0, "the listening socket does not listen: %s", strerror(errno));
	close(client);
	close(server);
}

/* ---- bytes in pipes and socket pairs ------------------------------------------------------------- */

#define PIPE_BYTES (256 * 1024)

static void content_setup(void)
{
	const struct timeval patience = { 7, 0 };
	const int buffer = 100000;

	must(pipe2(fd, O_NONBLOCK) == 0, "pipe");
	must(write(fd[1], "wake", 4) == 4, "write");
	must(socketpair(AF_UNIX, SOCK_STREAM, 0, fd + 2) == 0, "socketpair");
	must(write(fd[2], "hello ", 6) == 6 && write(fd[2], "you", 3) == 3, "write");
	must(pipe2(fd + 4, O_NONBLOCK) == 0, "pipe"); /* empty */
	must(pipe(fd + 6) == 0, "pipe");
	memset(scratch, 'p', 50000);
	must(write(fd[7], scratch, 50000) == 50000, "write");
	must(pipe(fd + 8) == 0 && write(fd[9], "one end", 7) == 7, "pipe");
	must(pipe(fd + 10) == 0 && write(fd[11], "both ends", 9) == 9, "pipe");
	must(fcntl(fd[10], F_SETPIPE_SZ, PIPE_BYTES) == PIPE_BYTES, "F_SETPIPE_SZ");
	must(socketpair(AF_UNIX, SOCK_STREAM, 0, fd + 12) == 0 && write(fd[13], "pair", 4) == 4,
	     "socketpair");
	must(!setsockopt(fd[12], SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience) &&
		     !setsockopt(fd[13], SOL_SOCKET, SO_SNDBUF, &buffer, sizeof buffer),
	     "setsockopt");
}

static void content_disturb(void)
{
	must(read(fd[0], scratch, 10) >= 0, "read");
	must(read(fd[3], scratch, 3) == 3 && write(fd[3], "answer", 6) == 6, "read");
	must(write(fd[5], "new", 3) == 3, "write");
	must(read(fd[6], scratch, 1000) == 1000, "read");
	close(fd[9]);
	close(fd[10]);
	close(fd[11]);
	close(fd[12]);
}

static void content_verify(void)
{
	struct timeval patience = { 0 };
	socklen_t length = sizeof patience;
	int bytes = 0;

	expect_text(fd[0], "wake", "a pipe");
	expect_text(fd[3], "hello you", "a socket pair");
	CHECK(recv(fd[2], scratch, 10, MSG_DONTWAIT) < 0 && errno == EAGAIN,
	      "an answer from the future");
	CHECK(read(fd[4], scratch, 10) < 0 && errno == EAGAIN, "a pipe that was empty is not");
	CHECK(ioctl(fd[6], FIONREAD, &bytes) == 0 && bytes == 50000, "%d bytes instead of 50000",
	      bytes);
	expect_text(fd[8], "one end", "a pipe whose writing end was closed");
	expect_text(fd[10], "both ends", "a pipe that was closed");
	CHECK(write(fd[11], "x", 1) == 1 && read(fd[10], scratch, 1) == 1,
	      "a pipe made again does not work");
	expect_text(fd[12], "pair", "a pair of which one end was closed");
	CHECK(write(fd[12], "x", 1) == 1 && read(fd[13], scratch, 1) == 1,
	      "a pair made again does not work");
	bytes = fcntl(fd[11], F_GETPIPE_SZ);
	CHECK(bytes == PIPE_BYTES, "a pipe made again has room for %d bytes", bytes);
	CHECK(!getsockopt(fd[12], SOL_SOCKET, SO_RCVTIMEO, &patience, &length) &&
		      patience.tv_sec == 7,
	      "an end of a pair made again has no timeout");
	length = sizeof bytes;
	CHECK(!getsockopt(fd[13], SOL_SOCKET, SO_SNDBUF, &bytes, &length) && bytes == 200000,
	      "an end of a pair made again has room for %d bytes", bytes);
	/* As it was, for the next time. */
	must(write(fd[1], "wake", 4) == 4 && write(fd[2], "hello you", 9) == 9, "write");
	must(write(fd[9], "one end", 7) == 7 && write(fd[11], "both ends", 9) == 9 &&
		     write(fd[13], "pair", 4) == 4,
	     "write");
}

/* ---- a device of which each who opens it has another one ------------------------------------- */

static void device_setup(void)
{
	fd[0] = open("/dev/ptmx", O_RDWR | O_NOCTTY);
	fd[1] = open("/dev/null", O_RDWR);
	must(fd[0] >= 0 && fd[1] >= 0, "open");
}

static void device_disturb(void)
{
	close(fd[0]);
	close(fd[1]);
}

static void device_verify(void)
{
	CHECK(is_open(fd[0]) && is_open(fd[1]), "a device is not open");
}

/* ---- no room for more ------------------------------------------------------------------------- */

#define FULL 64
#define BEYOND 900

/* All numbers are taken that the process may have, and one that it may have no more. */
static void full_setup(void)
{
	struct rlimit limit;

	must(!getrlimit(RLIMIT_NOFILE, &limit) && limit.rlim_max > BEYOND, "RLIMIT_NOFILE");
	fd[0] = open("/dev/zero", O_RDONLY);
	must(dup2(fd[0], BEYOND) == BEYOND, "dup2");
	limit.rlim_cur = FULL;
	must(!setrlimit(RLIMIT_NOFILE, &limit), "setrlimit");
	while (dup(fd[0]) >= 0)
		;
}

static void full_disturb(void)
{
	close(FULL - 1);
	close(BEYOND);
}

static void full_verify(void)
{
	struct rlimit limit;

	CHECK(is_open(FULL - 1) && is_open(BEYOND), "%d: %d, %d: %d", FULL - 1, is_open(FULL - 1),
	      BEYOND, is_open(BEYOND));
	CHECK(dup(fd[0]) < 0 && errno == EMFILE && !getrlimit(RLIMIT_NOFILE, &limit) &&
		      limit.rlim_cur == FULL,
	      "another limit");
}

/* ---- eventfd, timerfd, signalfd -------------------------------------------------------------------- */

static uint64_t timer_end_ns;

static void events_setup(void)
{
	const struct itimerspec soon = { .it_value = { .tv_sec = 1000 },
					 .it_interval = { .tv_sec = 5 } };
	sigset_t mask;

	fd[0] = eventfd(5, EFD_NONBLOCK);
	fd[1] = eventfd(3, EFD_SEMAPHORE);
	fd[2] = eventfd(0, EFD_NONBLOCK);
	fd[3] = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK);
	must(timerfd_settime(fd[3], 0, &soon, NULL) == 0, "timerfd_settime");
	timer_end_ns = now_ns() + 1000000000000;
	fd[4] = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK);
	sigemptyset(&mask);
	sigaddset(&mask, SIGUSR2);
	sigprocmask(SIG_BLOCK, &mask, NULL);
	fd[5] = signalfd(-1, &mask, SFD_NONBLOCK | SFD_CLOEXEC);
	fd[6] = eventfd(7, EFD_CLOEXEC);
	fd[7] = timerfd_create(CLOCK_REALTIME, TFD_CLOEXEC);
	must(timerfd_settime(fd[7], 0, &soon, NULL) == 0, "timerfd_settime");
	fd[8] = signalfd(-1, &mask, SFD_NONBLOCK);
}

static void events_disturb(void)
{
	const struct itimerspec never = { 0 }, other = { .it_value = { .tv_sec = 7 } };
	const uint64_t more = 10;
	sigset_t mask;

	must(write(fd[0], &more, 8) == 8 && read(fd[1], scratch, 8) == 8 &&
		     write(fd[2], &more, 8) == 8,
	     "eventfd");
	must(timerfd_settime(fd[3], 0, &never, NULL) == 0 &&
		     timerfd_settime(fd[4], 0, &other, NULL) == 0,
	     "timerfd");
	sigemptyset(&mask);
	sigaddset(&mask, SIGHUP);
	must(signalfd(fd[5], &mask, 0) == fd[5], "signalfd");
	close(fd[6]);
	close(fd[7]);
	close(fd[8]);
}

static void expect_timer(int f, const char *what)
{
	struct itimerspec t;
	const int64_t left = (int64_t)(timer_end_ns - now_ns()) / 1000000;

	CHECK(timerfd_gettime(f, &t) == 0 && t.it_interval.tv_sec == 5, "%s: its interval is %ld",
	      what, (long)t.it_interval.tv_sec);
	CHECK(llabs(t.it_value.tv_sec * 1000 + t.it_value.tv_nsec / 1000000 - left) < 100,
	      "%s goes off in %ld s instead of %ld", what, (long)t.it_value.tv_sec,
	      (long)left / 1000);
}

static void expect_count(int f, uint64_t count, const char *what)
{
	uint64_t n = 0;

	CHECK(read(f, &n, 8) == 8 && n == count, "%s: %lu instead of %lu", what, n, count);
}

static void events_verify(void)
{
	struct itimerspec t;
	struct signalfd_siginfo info;

	expect_count(fd[0], 5, "an eventfd");
	for (int i = 0; i < 3; i++)
		expect_count(fd[1], 1, "a semaphore");
	CHECK(poll(&(struct pollfd){ .fd = fd[1], .events = POLLIN }, 1, 0) == 0,
	      "the semaphore is more than 3");
	CHECK(read(fd[2], scratch, 8) < 0 && errno == EAGAIN, "an eventfd that was 0 is not");
	expect_count(fd[6], 7, "a closed eventfd");
	CHECK(fcntl(fd[6], F_GETFD) == FD_CLOEXEC && !(fcntl(fd[6], F_GETFL) & O_NONBLOCK),
	      "its flags");
	expect_timer(fd[3], "a timer");
	expect_timer(fd[7], "a closed timer");
	CHECK(timerfd_gettime(fd[4], &t) == 0 && !t.it_value.tv_sec && !t.it_value.tv_nsec,
	      "an idle timer runs");
	for (int i = 5; i <= 8; i += 3) {
		raise(SIGUSR2);
		CHECK(read(fd[i], &info, sizeof info) == sizeof info && info.ssi_signo == SIGUSR2,
		      "the signalfd has another mask");
	}
	must(eventfd_write(fd[0], 5) == 0 && eventfd_write(fd[1], 3) == 0 &&
		     eventfd_write(fd[6], 7) == 0,
	     "eventfd");
}

/* ---- a timer that went off meanwhile -------------------------------------------------------------- */

static void timer_setup(void)
{
	const struct itimerspec soon = { .it_value = { .tv_nsec = 300000000 } };

	fd[0] = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK);
	must(timerfd_settime(fd[0], 0, &soon, NULL) == 0, "timerfd_settime");
}

static void timer_disturb(void)
{
	/* Takes the expiry; in a second life it was taken already. */
	if (poll(&(struct pollfd){ .fd = fd[0], .events = POLLIN }, 1, 500) == 1)
		must(read(fd[0], scratch, 8) == 8, "read");
}

static void timer_verify(void)
{
	nap_us(1000);
	CHECK(read(fd[0], scratch, 8) == 8, "a timer that was to go off does not: %s",
	      strerror(errno));
}

/* ---- epoll -------------------------------------------------------------------------------------- */

static void epoll_add(int set, int f, uint32_t events, uint64_t data)
{
	struct epoll_event event = { .events = events, .data.u64 = data };

	must(epoll_ctl(set, EPOLL_CTL_ADD, f, &event) == 0, "epoll_ctl");
}

static void epoll_setup(void)
{
	sigset_t mask;

	sigemptyset(&mask);
	sigaddset(&mask, SIGUSR2);
	sigprocmask(SIG_BLOCK, &mask, NULL);
	fd[0] = epoll_create1(EPOLL_CLOEXEC);
	for (int i = 1; i <= 6; i++)
		fd[i] = eventfd(0, EFD_NONBLOCK);
	epoll_add(fd[0], fd[1], EPOLLIN, 0x1111111111111111);
	epoll_add(fd[0], fd[2], EPOLLIN | EPOLLET, 2);
	epoll_add(fd[0], fd[3], EPOLLIN | EPOLLONESHOT, 3);
	epoll_add(fd[0], fd[4], EPOLLIN, 4);
	epoll_add(fd[0], fd[5], EPOLLIN, 5);
	fd[7] = signalfd(-1, &mask, SFD_NONBLOCK);
	epoll_add(fd[0], fd[7], EPOLLIN, 7);
	must(pipe(fd + 8) == 0, "pipe");
	epoll_add(fd[0], fd[8], EPOLLIN | EPOLLET, 8);
	fd[10] = epoll_create1(0);
	epoll_add(fd[10], fd[1], EPOLLIN, 10);
	fd[11] = epoll_create1(0);
	epoll_add(fd[11], fd[10], EPOLLIN, 11);
}

static void epoll_disturb(void)
{
	struct epoll_event event[16], other = { .events = EPOLLOUT, .data.u64 = 99 };

	epoll_ctl(fd[0], EPOLL_CTL_DEL, fd[1], NULL);
	epoll_ctl(fd[0], EPOLL_CTL_MOD, fd[4], &other);
	epoll_add(fd[0], fd[6], EPOLLIN, 6);
	close(fd[5]);
	must(eventfd_write(fd[3], 1) == 0 && write(fd[9], "x", 1) == 1, "write");
	must(epoll_wait(fd[0], event, 16, 0) >= 2,
	     "epoll_wait"); /* the oneshot and the edge are spent */
	close(fd[10]);
}

static void expect_event(int set, int f, uint64_t data)
{
	struct epoll_event event[16];
	int n;

	must(eventfd_write(f, 1) == 0, "eventfd_write");
	n = epoll_wait(set, event, 16, 200);
	CHECK(n == 1 && event[0].data.u64 == data, "event %lx: %d came, the first %lx", data, n,
	      n > 0 ? event[0].data.u64 : 0);
	must(read(f, scratch, 8) == 8, "read");
	CHECK(epoll_wait(set, event, 16, 0) == 0, "event %lx comes for ever", data);
}

static void epoll_verify(void)
{
	struct epoll_event event[16];
	struct signalfd_siginfo info;
	int n;

	/* Nothing is there to be had now (an edge triggered one may tell of itself). */
	n = epoll_wait(fd[0], event, 16, 0);
	CHECK(n == 0, "%d events, the first %lx", n, event[0].data.u64);
	expect_event(fd[0], fd[1], 0x1111111111111111);
	expect_event(fd[0], fd[2], 2);
	expect_event(fd[0], fd[3], 3);
	expect_event(fd[0], fd[4], 4);
	expect_event(fd[0], fd[5], 5);
	must(eventfd_write(fd[6], 1) == 0, "eventfd_write");
	CHECK(epoll_wait(fd[0], event, 16, 0) == 0, "added after the checkpoint, and there");
	must(read(fd[6], scratch, 8) == 8, "read");
	raise(SIGUSR2);
	n = epoll_wait(fd[0], event, 16, 200);
	CHECK(n == 1 && event[0].data.u64 == 7, "a signalfd does not wake epoll");
	must(read(fd[7], &info, sizeof info) == sizeof info, "read");
	must(write(fd[9], "y", 1) == 1, "write");
	n = epoll_wait(fd[0], event, 16, 200);
	CHECK(n == 1 && event[0].data.u64 == 8, "an edge of a pipe is lost");
	must(read(fd[8], scratch, 1) == 1, "read");
	must(eventfd_write(fd[1], 1) == 0, "eventfd_write");
	n = epoll_wait(fd[11], event, 16, 200);
	CHECK(n == 1 && event[0].data.u64 == 11, "epoll in epoll: %d", n);
	n = epoll_wait(fd[10], event, 16, 0);
	CHECK(n == 1 && event[0].data.u64 == 10, "a closed epoll set: %d", n);
	must(read(fd[1], scratch, 8) == 8, "read");
	{
		struct epoll_event again = { .events = EPOLLIN | EPOLLONESHOT, .data.u64 = 3 };

		must(epoll_ctl(fd[0], EPOLL_CTL_MOD, fd[3], &again) == 0, "epoll_ctl");
	}
}

/* Under a watched number something else is watched, of which somebody else (the test: the
 * number is counter 3) may have a descriptor as well. */
static void watched_setup(void)
{
	fd[0] = epoll_create1(EPOLL_CLOEXEC);
	must(socketpair(AF_UNIX, SOCK_STREAM, 0, fd + 1) == 0, "socketpair");
	epoll_add(fd[0], fd[1], EPOLLIN, 1);
	board->counter[3] = (uint64_t)fd[1];
}

static void watched_disturb(void)
{
	const int was = fd[1];
	int also;

	must(close(fd[1]) == 0 && close(fd[2]) == 0, "close");
	must(socketpair(AF_UNIX, SOCK_STREAM, 0, fd + 1) == 0 && fd[1] == was, "socketpair");
	epoll_add(fd[0], fd[1], EPOLLIN, 1);
	also = dup(fd[1]);
	must(also >= 0, "dup");
	epoll_add(fd[0], also, EPOLLIN, 2);
	must(write(fd[2], "x", 1) == 1, "write");
}

static void watched_verify(void)
{
	struct epoll_event event[16];
	int n = epoll_wait(fd[0], event, 16, 0);

	CHECK(n == 0, "%d event(s), of %lu first, of what was watched since the checkpoint", n,
	      event[0].data.u64);
	must(write(fd[2], "x", 1) == 1, "write");
	n = epoll_wait(fd[0], event, 16, 200);
	CHECK(n == 1 && event[0].data.u64 == 1, "%d events, not the one that came", n);
	must(read(fd[1], scratch, 2) == 1, "read");
}

/* ---- flags and owners ---------------------------------------------------------------------------- */

static pid_t owner_tid;

static void *owner_thread(void *arg)
{
	(void)arg;
	__atomic_store_n(&owner_tid, (pid_t)syscall(SYS_gettid), __ATOMIC_RELEASE);
	for (;;)
		pause();
	return NULL;
}

static void flags_setup(void)
{
	struct f_owner_ex owner = { .type = F_OWNER_TID };
	pthread_t thread;
	sigset_t mask;

	sigemptyset(&mask);
	sigaddset(&mask, SIGUSR2);
	sigprocmask(SIG_BLOCK, &mask, NULL);
	must(pthread_create(&thread, NULL, owner_thread, NULL) == 0, "pthread_create");
	while (!__atomic_load_n(&owner_tid, __ATOMIC_ACQUIRE))
		nap_us(100);
	must(socketpair(AF_UNIX, SOCK_STREAM, 0, fd) == 0 && pipe(fd + 2) == 0 && pipe(fd + 4) == 0,
	     "pipe");
	fcntl(fd[0], F_SETFL, O_NONBLOCK);
	fcntl(fd[2], F_SETOWN, getpid());
	fcntl(fd[2], F_SETSIG, SIGUSR2);
	fcntl(fd[2], F_SETFL, O_ASYNC);
	owner.pid = owner_tid;
	must(fcntl(fd[3], F_SETOWN_EX, &owner) == 0, "F_SETOWN_EX");
}

static void flags_disturb(void)
{
	fcntl(fd[0], F_SETFL, 0);
	fcntl(fd[1], F_SETFL, O_NONBLOCK);
	fcntl(fd[2], F_SETFL, 0);
	fcntl(fd[4], F_SETOWN, getpid());
	fcntl(fd[4], F_SETFL, O_ASYNC | O_NONBLOCK);
}

static void flags_verify(void)
{
	struct timespec second = { 1, 0 };
	struct f_owner_ex owner = { 0 };
	siginfo_t info;
	sigset_t mask;

	CHECK(fcntl(fd[3], F_GETOWN_EX, &owner) == 0 && owner.type == F_OWNER_TID &&
		      owner.pid == owner_tid,
	      "a thread is no owner any more");
	CHECK(fcntl(fd[0], F_GETFL) & O_NONBLOCK, "O_NONBLOCK has gone");
	CHECK(!(fcntl(fd[1], F_GETFL) & O_NONBLOCK), "O_NONBLOCK has come");
	CHECK(!(fcntl(fd[4], F_GETFL) & (O_ASYNC | O_NONBLOCK)), "O_ASYNC has come");
	CHECK(fcntl(fd[2], F_GETFL) & O_ASYNC && fcntl(fd[2], F_GETOWN) == getpid() &&
		      fcntl(fd[2], F_GETSIG) == SIGUSR2,
	      "owner or signal are not what they were: %x, %d, %d", fcntl(fd[2], F_GETFL),
	      fcntl(fd[2], F_GETOWN), fcntl(fd[2], F_GETSIG));
	must(write(fd[3], "x", 1) == 1, "write");
	sigemptyset(&mask);
	sigaddset(&mask, SIGUSR2);
	CHECK(sigtimedwait(&mask, &info, &second) == SIGUSR2 && info.si_fd == fd[2],
	      "no signal for descriptor %d", fd[2]);
	must(read(fd[2], scratch, 1) == 1, "read");
}

/* ---- locks ----------------------------------------------------------------------------------------- */

static void lock(int f, int how, short type, int64_t start, int64_t bytes)
{
	struct flock l = { .l_type = type, .l_whence = SEEK_SET, .l_start = start, .l_len = bytes };

	must(fcntl(f, how, &l) == 0, "fcntl(F_SETLK)");
}

static void locks_setup(void)
{
	fd[0] = make_file("posix", "0123456789", O_RDWR);
	fd[1] = make_file("flock", "0123456789", O_RDWR);
	fd[2] = make_file("ofd", "0123456789", O_RDWR);
	fd[3] = make_file("unlocked", "0123456789", O_RDWR);
	fd[4] = make_file("closedlock", "0123456789", O_RDWR);
	fd[5] = make_file("held", "0123456789", O_RDWR);
	lock(fd[0], F_SETLK, F_WRLCK, 2, 3);
	must(flock(fd[1], LOCK_EX) == 0, "flock");
	lock(fd[2], F_OFD_SETLK, F_WRLCK, 1, 0);
	must(flock(fd[4], LOCK_EX) == 0, "flock");
	lock(fd[4], F_SETLK, F_RDLCK, 0, 0);
	lock(fd[5], F_SETLK, F_WRLCK, 0, 0); /* left alone */
	must(flock(fd[5], LOCK_SH) == 0, "flock");
}

static void locks_disturb(void)
{
	lock(fd[0], F_SETLK, F_UNLCK, 0, 0);
	lock(fd[0], F_SETLK, F_WRLCK, 7, 2);
	must(flock(fd[1], LOCK_UN) == 0, "flock");
	lock(fd[2], F_OFD_SETLK, F_UNLCK, 0, 0);
	must(flock(fd[3], LOCK_EX) == 0, "flock");
	close(fd[4]);
	must(open(path_of("held"), O_RDWR) >= 0, "open"); /* closing it loses POSIX locks */
}

/* What somebody else would find. */
static bool taken(const char *name, int how, short type, int64_t start, int64_t bytes)
{
	struct flock l = { .l_type = type, .l_whence = SEEK_SET, .l_start = start, .l_len = bytes };
	int f = open(path_of(name), O_RDWR);
	bool is;

	if (how == LOCK_EX) {
		is = flock(f, LOCK_EX | LOCK_NB) != 0;
		flock(f, LOCK_UN);
	} else {
		must(fcntl(f, F_OFD_GETLK, &l) == 0, "F_OFD_GETLK");
		is = l.l_type != F_UNLCK;
	}
	/* Not closed: that would lose our own POSIX locks.  It is closed by the next restore. */
	return is;
}

static void locks_verify(void)
{
	CHECK(taken("posix", 0, F_WRLCK, 2, 3) && !taken("posix", 0, F_WRLCK, 5, 5) &&
		      !taken("posix", 0, F_WRLCK, 0, 2),
	      "POSIX locks are not what they were");
	CHECK(taken("flock", LOCK_EX, 0, 0, 0), "a flock was released and still is");
	CHECK(taken("ofd", 0, F_WRLCK, 5, 1) && !taken("ofd", 0, F_WRLCK, 0, 1),
	      "an OFD lock is not what it was");
	CHECK(!taken("unlocked", LOCK_EX, 0, 0, 0), "a flock that was taken since is still there");
	CHECK(taken("closedlock", LOCK_EX, 0, 0, 0) && taken("closedlock", 0, F_WRLCK, 3, 1),
	      "locks of a closed file are not there");
	CHECK(taken("held", LOCK_EX, 0, 0, 0) && taken("held", 0, F_WRLCK, 3, 1),
	      "locks that were held are not");
}

/* ---- files for avckpt.files=strict --------------------------------------------------------------------- */

static void strict_setup(void)
{
	fd[0] = make_file("data", "0123456789", O_RDWR);
}

static void strict_disturb(void)
{
	must(pwrite(fd[0], "x", 1, 3) == 1, "pwrite");
}

static const struct scenario scenarios[] = {
	{ "opened", opened_setup, opened_disturb, opened_verify },
	{ "closed", closed_setup, closed_disturb, closed_verify },
	{ "replaced", replaced_setup, replaced_disturb, replaced_verify },
	{ "deleted", deleted_setup, deleted_disturb, deleted_verify },
	{ "unnamed", unnamed_setup, deleted_disturb, deleted_verify },
	{ "semaphores", semaphores_setup, semaphores_disturb, semaphores_verify },
	{ "many", nothing, many_disturb, many_verify },
	{ "revoked", revoked_setup, revoked_disturb, revoked_verify },
	{ "gone", gone_setup, deleted_disturb, gone_verify },
	{ "offset", offset_setup, offset_disturb, offset_verify },
	{ "keep", offset_setup, offset_disturb, keep_verify },
	{ "device", device_setup, device_disturb, device_verify },
	{ "full", full_setup, full_disturb, full_verify },
	{ "lost", lost_setup, lost_disturb, lost_verify },
	{ "content", content_setup, content_disturb, content_verify },
	{ "events", events_setup, events_disturb, events_verify },
	{ "timer", timer_setup, timer_disturb, timer_verify },
	{ "epoll", epoll_setup, epoll_disturb, epoll_verify },
	{ "watched", watched_setup, watched_disturb, watched_verify },
	{ "flags", flags_setup, flags_disturb, flags_verify },
	{ "locks", locks_setup, locks_disturb, locks_verify },
	{ "strict", strict_setup, strict_disturb, nothing },
	{ "quiet", strict_setup, nothing, nothing },
};

int main(int argc, char **argv)
{
	play(argc, argv, scenarios, sizeof scenarios / sizeof *scenarios);
}
