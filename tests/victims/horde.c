/* SPDX-License-Identifier: Apache-2.0
 *
 * horde N KIND [again]: has so many descriptors from the start: pipes; ends of one pipe; streams
 * (connected to sockets of its own that accept nothing); datagrams (connected to one of its own);
 * listeners; ports (TCP); or locks of one file; or watches of one epoll set, all by the same number.
 * SIGUSR1 closes them all, opens as many others where it is to do it again, and counts that in
 * counter[0].  Beats every 1 ms.
 */
#include <netinet/in.h>
#include <signal.h>
#include <stddef.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <sys/un.h>

#include "victim.h"

#define FIRST 100
#define BACKLOG 1000

static volatile sig_atomic_t asked;

static void on_signal(int sig)
{
	(void)sig;
	asked = 1;
}

static uint64_t own;

/* A name of its own, in the abstract namespace. */
static socklen_t name_of(struct sockaddr_un *name, int number)
{
	*name = (struct sockaddr_un){ .sun_family = AF_UNIX };
	return (socklen_t)offsetof(struct sockaddr_un, sun_path) + 1 +
	       (socklen_t)sprintf(name->sun_path + 1, "horde-%llx-%d", (unsigned long long)own,
				  number);
}

static int listener(int number, int type)
{
	struct sockaddr_un name;
	const socklen_t bytes = name_of(&name, number);
	const int fd = socket(AF_UNIX, type, 0);

	must(fd >= 0 && !bind(fd, (struct sockaddr *)&name, bytes), "bind");
	must(type == SOCK_DGRAM || !listen(fd, BACKLOG), "listen");
	return fd;
}

static int client(int number, int type)
{
	struct sockaddr_un name;
	const socklen_t bytes = name_of(&name, number);
	const int fd = socket(AF_UNIX, type, 0);

	must(fd >= 0 && !connect(fd, (struct sockaddr *)&name, bytes), "connect");
	return fd;
}

static void move_up(int fd, int least)
{
	must(fcntl(fd, F_DUPFD, least) >= least && !close(fd), "dup");
}

static void lock(int fd, int at)
{
	struct flock one = { .l_type = F_WRLCK, .l_start = at, .l_len = 1 };

	must(!fcntl(fd, F_OFD_SETLK, &one), "F_OFD_SETLK");
}

/* Each by the same number. */
static void watch(int *set, int number)
{
	struct epoll_event event = { .events = EPOLLIN };
	const int fd = eventfd(0, 0);

	if (*set < 0)
		*set = epoll_create1(0);
	must(fd >= 0 && dup2(fd, number) == number, "dup2");
	must(!epoll_ctl(*set, EPOLL_CTL_ADD, number, &event), "epoll_ctl");
}

static void port(void)
{
	const int fd = socket(AF_INET, SOCK_STREAM, 0);

	must(fd >= 0 && !listen(fd, 1), "listen");
}

static int reopen(int fd, int flags)
{
	char path[40];

	snprintf(path, sizeof path, "/proc/self/fd/%d", fd);
	return open(path, flags | O_NONBLOCK);
}

static void open_all(int n, const char *kind)
{
	int ends[2], set = -1, first = fcntl(memfd_create("horde", 0), F_DUPFD, FIRST);

	for (int i = 0; i < n; i++)
		if (!strcmp(kind, "pipes"))
			must(i % 2 || !pipe(ends), "pipe");
		else if (!strcmp(kind, "ends") && !i)
			must(!pipe(ends), "pipe");
		else if (!strcmp(kind, "ends"))
			must(reopen(ends[0], i < n / 2 ? O_RDONLY : O_WRONLY) >= 0, "open");
		else if (!strcmp(kind, "locks"))
			lock(first, 2 * i);
		else if (!strcmp(kind, "watches"))
			watch(&set, first);
		else if (!strcmp(kind, "ports"))
			port();
		else if (!strcmp(kind, "streams"))
			client(i / BACKLOG, SOCK_STREAM);
		else if (!strcmp(kind, "datagrams"))
			client(0, SOCK_DGRAM);
		else
			listener(i, SOCK_STREAM);
}

int main(int argc, char **argv)
{
	struct sigaction act = { .sa_handler = on_signal };
	const char *kind;
	int n, most;

	victim_start(&argc, argv, 2, "N KIND [again]");
	n = atoi(argv[1]);
	kind = argv[2];
	must(getrandom(&own, sizeof own, 0) == sizeof own, "getrandom");
	most = (int)victim_lift_descriptors();
	if (n > most - 2 * FIRST) {
		printf("this machine allows %d descriptors\n", most);
		return UNAVAILABLE_STATUS;
	}
	if (!strcmp(kind, "streams"))
		for (int i = 0; i <= n / BACKLOG; i++)
			move_up(listener(i, SOCK_STREAM), most - 100);
	if (!strcmp(kind, "datagrams"))
		move_up(listener(0, SOCK_DGRAM), most - 100);
	open_all(n, kind);
	sigaction(SIGUSR1, &act, NULL);
	victim_ready();
	for (;;) {
		usleep(1000);
		beat();
		if (asked) {
			asked = 0;
			must(!close_range(3, UINT32_MAX, 0), "close_range");
			if (argc > 3)
				open_all(n, kind);
			count(0, 1);
			pause();
		}
	}
}
