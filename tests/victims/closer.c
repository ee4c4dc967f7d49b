/* SPDX-License-Identifier: Apache-2.0
 *
 * closer KIND: what it closes is closed, for everybody, when close(2) returns, or a moment later:
 * whoever reads its /proc/PID/fd holds it for less than a microsecond.  One thread; beats once in
 * each round.
 *
 *   events   a connection with unread bytes, after which an epoll set has no event of it
 *   port     a UDP socket, whose port is free
 *   listen   a TCP socket that listens, whose port is free
 *   lock     a file, whose lock (flock(2)) is free
 *   program  a file that was written, and can be executed
 *   pipe     the end of a pipe, of which the other end reads that
 */
#include <arpa/inet.h>
#include <poll.h>
#include <spawn.h>
#include <sys/epoll.h>
#include <sys/file.h>
#include <sys/socket.h>
#include <sys/stat.h>

#include "victim.h"

#define MOMENT_US 1000
#define SOON(what, ...)                           \
	do {                                      \
		if (!(what)) {                    \
			nap_us(MOMENT_US);        \
			CHECK(what, __VA_ARGS__); \
		}                                 \
	} while (0)

static struct sockaddr_in own = { .sin_family = AF_INET };
static socklen_t bytes = sizeof own;
static int listener, epoll_fd;
static char path[64] = "/tmp/avckpt-closer-XXXXXX";

static int bound(int type)
{
	const int fd = socket(AF_INET, type | SOCK_CLOEXEC, 0);

	must(fd >= 0, "socket");
	SOON(!bind(fd, (struct sockaddr *)&own, sizeof own), "bind: %s", strerror(errno));
	must(!getsockname(fd, (struct sockaddr *)&own, &bytes), "getsockname");
	return fd;
}

static void start_events(void)
{
	own.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
	listener = bound(SOCK_STREAM);
	must(!listen(listener, 16), "listen");
	epoll_fd = epoll_create1(EPOLL_CLOEXEC);
	must(epoll_fd >= 0, "epoll_create1");
}

static void events(void)
{
	const struct linger reset = { .l_onoff = 1 };
	struct epoll_event event = { .events = EPOLLIN };
	const int out = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
	int in;

	must(!setsockopt(out, SOL_SOCKET, SO_LINGER, &reset, sizeof reset), "setsockopt");
	must(!connect(out, (struct sockaddr *)&own, sizeof own), "connect");
	in = accept(listener, NULL, NULL);
	must(in >= 0, "accept");
	must(!epoll_ctl(epoll_fd, EPOLL_CTL_ADD, in, &event), "epoll_ctl");
	must(write(out, "x", 1) == 1, "write");
	must(epoll_wait(epoll_fd, &event, 1, 1000) == 1, "epoll_wait");
	close(in);
	SOON(epoll_wait(epoll_fd, &event, 1, 0) == 0, "an event of what is closed");
	close(out);
}

static void port(void)
{
	close(bound(SOCK_DGRAM));
}

static void listens(void)
{
	const int fd = bound(SOCK_STREAM);

	SOON(!listen(fd, 1), "listen: %s", strerror(errno));
	close(fd);
}

static void start_file(void)
{
	const int fd = mkostemp(path, O_CLOEXEC);

	must(fd >= 0 && !fchmod(fd, 0700), path);
	close(fd);
}

static void lock(void)
{
	const int fd = open(path, O_RDWR | O_CLOEXEC);

	must(fd >= 0, path);
	SOON(!flock(fd, LOCK_EX | LOCK_NB), "flock: %s", strerror(errno));
	close(fd);
}

static void program(void)
{
	static const char text[] = "#!/bin/false\n";
	char *args[] = { path, NULL };
	const int fd = open(path, O_WRONLY | O_TRUNC | O_CLOEXEC);
	int status;
	pid_t pid;

	must(fd >= 0 && write(fd, text, sizeof text - 1) == sizeof text - 1, path);
	close(fd);
	SOON(!posix_spawn(&pid, path, NULL, NULL, args, NULL), "it cannot be executed");
	must(waitpid(pid, &status, 0) == pid, "waitpid");
}

static void pipes(void)
{
	int ends[2];
	char c;

	must(!pipe2(ends, O_CLOEXEC | O_NONBLOCK), "pipe2");
	close(ends[1]);
	SOON(read(ends[0], &c, 1) == 0, "read: %s", strerror(errno));
	close(ends[0]);
}

static void nothing(void)
{
}

int main(int argc, char **argv)
{
	static const struct {
		const char *name;
		void (*start)(void), (*round)(void);
	} kinds[] = { { "events", start_events, events }, { "port", nothing, port },
		      { "listen", nothing, listens },     { "lock", start_file, lock },
		      { "program", start_file, program }, { "pipe", nothing, pipes } };

	victim_start(&argc, argv, 1, "KIND");
	for (size_t i = 0; i < sizeof kinds / sizeof *kinds; i++) {
		if (strcmp(argv[1], kinds[i].name))
			continue;
		kinds[i].start();
		victim_ready();
		for (;;) {
			kinds[i].round();
			beat();
		}
	}
	must(false, "KIND");
}
