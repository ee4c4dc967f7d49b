/* SPDX-License-Identifier: Apache-2.0
 *
 * Sockets with names and options, closed after a checkpoint.
 *
 *   listeners SCENARIO FOLDER     see scenario.h
 */
#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stddef.h>
#include <sys/epoll.h>
#include <sys/fsuid.h>
#include <sys/mount.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>

#include "scenario.h"

static struct sockaddr_un name[64];
static socklen_t name_bytes[64];

/* `path` begins with '@' for an abstract name (unix(7)), which gets a number of its own: the previous
 * test's victim may still have it. */
static int bind_unix(int type, const char *path)
{
	struct sockaddr_un address = { .sun_family = AF_UNIX };
	const bool abstract = path[0] == '@';
	const int s = socket(AF_UNIX, type, 0);
	const int bytes = abstract
				  ? snprintf(address.sun_path, sizeof address.sun_path, "%s-%llx",
					     path, (unsigned long long)now_ns())
				  : snprintf(address.sun_path, sizeof address.sun_path, "%s", path);

	must(s >= 0 && bytes < (int)sizeof address.sun_path, "socket");
	if (abstract)
		address.sun_path[0] = 0;
	must(bind(s, (struct sockaddr *)&address,
		  (socklen_t)offsetof(struct sockaddr_un, sun_path) + (socklen_t)bytes +
			  !abstract) == 0,
	     path);
	return s;
}

static int listen_unix(int type, const char *path, int backlog)
{
	const int s = bind_unix(type, path);

	must(listen(s, backlog) == 0, "listen");
	return s;
}

/* At a port of 127.0.0.1, 0: one that is free. With `reuse` (SO_REUSEADDR) it is free although
 * connections to it have ended a moment ago. */
static int listen_inet(uint16_t port, int flags, int reuse)
{
	const struct sockaddr_in address = { .sin_family = AF_INET,
					     .sin_port = port,
					     .sin_addr.s_addr = htonl(INADDR_LOOPBACK) };
	const int s = socket(AF_INET, SOCK_STREAM | flags, 0);

	must(setsockopt(s, SOL_SOCKET, SO_REUSEADDR, &reuse, sizeof reuse) == 0 &&
		     bind(s, (const struct sockaddr *)&address, sizeof address) == 0 &&
		     listen(s, 7) == 0,
	     "listen");
	return s;
}

static void remember_name(int i)
{
	name_bytes[i] = sizeof name[i];
	must(getsockname(fd[i], (struct sockaddr *)&name[i], &name_bytes[i]) == 0, "getsockname");
}

static uint16_t remembered_port(int i)
{
	struct sockaddr_in address;

	memcpy(&address, &name[i], sizeof address);
	return address.sin_port;
}

static void expect_name(int i)
{
	struct sockaddr_un is;
	socklen_t bytes = sizeof is;

	CHECK(getsockname(fd[i], (struct sockaddr *)&is, &bytes) == 0 && bytes == name_bytes[i] &&
		      !memcmp(&is, &name[i], bytes),
	      "socket %d has another name: %u bytes, %.50s", i, bytes, is.sun_path + 1);
}

/* Clients come in, and find this process behind it. */
static void expect_server(int i, int type, const struct sockaddr_un *address, socklen_t bytes)
{
	const int client = socket(AF_UNIX, type, 0);
	struct ucred peer;
	socklen_t peer_bytes = sizeof peer;
	int server;

	CHECK(connect(client, (const struct sockaddr *)address, bytes) == 0,
	      "socket %d cannot be connected to: %s", i, strerror(errno));
	server = accept(fd[i], NULL, NULL);
	CHECK(server >= 0, "socket %d accepts nobody: %s", i, strerror(errno));
	must(write(client, "hello", 5) == 5, "write");
	expect_text(server, "hello", "a connection");
	CHECK(getsockopt(client, SOL_SOCKET, SO_PEERCRED, &peer, &peer_bytes) == 0 &&
		      peer.pid == getpid() && peer.uid == getuid(),
	      "behind socket %d is process %d, user %u", i, peer.pid, peer.uid);
	close(client);
	close(server);
}

static struct sockaddr_un path_address(const char *file)
{
	struct sockaddr_un address = { .sun_family = AF_UNIX };

	snprintf(address.sun_path, sizeof address.sun_path, "%s", path_of(file));
	return address;
}

/* ---- Unix sockets that listen ---------------------------------------------------- */

static struct stat file_before[8];

static void unix_setup(void)
{
	struct epoll_event event = { .events = EPOLLIN | EPOLLET, .data.u64 = 77 };

	must(chdir(folder) == 0 && (mkdir("sub", 0700) == 0 || errno == EEXIST), "mkdir");
	fd[0] = listen_unix(SOCK_STREAM | SOCK_CLOEXEC, path_of("server"), 3);
	must(chmod("server", 04640) == 0 && chown("server", 123, 456) == 0, "chmod");
	fd[1] = listen_unix(SOCK_SEQPACKET | SOCK_NONBLOCK, "@avckpt-test-listeners", 9);
	fd[2] = listen_unix(SOCK_STREAM, path_of("moved.new"), 5); /* as systemd does it */
	must(rename("moved.new", "moved") == 0, "rename");
	fd[3] = listen_unix(SOCK_SEQPACKET, "sub/relative", 5);
	fd[4] = listen_unix(SOCK_STREAM, path_of("deleted"), 5);
	must(unlink("deleted") == 0, "unlink");
	fd[5] = listen_unix(SOCK_STREAM, "./here", 5);
	fd[6] = epoll_create1(0);
	must(epoll_ctl(fd[6], EPOLL_CTL_ADD, fd[0], &event) == 0, "epoll_ctl");
	/* Seen by nobody outside */
	must((mkdir("private", 0700) == 0 || errno == EEXIST) &&
		     mount("none", path_of("private"), "tmpfs", 0, NULL) == 0,
	     "mount");
	fd[7] = listen_unix(SOCK_STREAM, path_of("private/server"), 5);
	for (int i = 0; i <= 7; i++)
		if (i != 6)
			remember_name(i);
	must(chdir("sub") == 0, "chdir"); /* and "sub/relative" leads nowhere */
	must(stat("../server", &file_before[0]) == 0, "stat");
}

static void unix_disturb(void)
{
	/* Files are left, or removed; or somebody was there in between; or only files are. */
	const uint64_t turn = board->counter[0] % 4;

	for (int i = 0; i <= 7; i++)
		if (i != 6 && turn != 3)
			close(fd[i]);
	if (turn)
		must(unlink("../server") == 0 && unlink("../moved") == 0 && unlink("relative") == 0,
		     "unlink");
	if (turn == 2)
		fd[20] = listen_unix(SOCK_STREAM, path_of("server"), 1);
}

static int backlog_of(int s)
{
	struct sockaddr_un address;
	socklen_t bytes = sizeof address;
	int client[40], n;

	must(getsockname(s, (struct sockaddr *)&address, &bytes) == 0, "getsockname");
	for (n = 0; n < 40; n++) {
		client[n] = socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK, 0);
		if (connect(client[n], (struct sockaddr *)&address, bytes))
			break;
	}
	for (int i = 0; i <= n && i < 40; i++)
		close(client[i]);
	for (int i = 0; i < n; i++)
		close(accept(s, NULL, NULL));
	return n - 1; /* the kernel lets in one more */
}

static void unix_verify(void)
{
	struct sockaddr_un address = path_address("moved");
	struct epoll_event event[4];
	struct stat st;
	int n, client;

	for (int i = 0; i <= 7; i++)
		if (i != 6)
			expect_name(i);
	CHECK(fcntl(fd[0], F_GETFD) == FD_CLOEXEC && fcntl(fd[1], F_GETFL) & O_NONBLOCK, "flags");
	n = epoll_wait(fd[6], event, 4, 0);
	CHECK(n == 0, "epoll says %x of a server without clients", event[0].events);
	n = backlog_of(fd[0]);
	CHECK(n == 3, "%d clients may wait instead of 3", n);
	client = socket(AF_UNIX, SOCK_STREAM, 0);
	must(connect(client, (struct sockaddr *)&name[0], name_bytes[0]) == 0, "connect");
	n = epoll_wait(fd[6], event, 4, 1000);
	CHECK(n == 1 && event[0].events == EPOLLIN && event[0].data.u64 == 77,
	      "epoll does not tell of a client: %d", n);
	close(accept(fd[0], NULL, NULL));
	close(client);
	expect_server(0, SOCK_STREAM, &name[0], name_bytes[0]);
	expect_server(1, SOCK_SEQPACKET, &name[1], name_bytes[1]);
	expect_server(2, SOCK_STREAM, &address, sizeof address);
	address = path_address("sub/relative");
	expect_server(3, SOCK_SEQPACKET, &address, sizeof address);
	must(chdir("..") == 0, "chdir");
	expect_server(5, SOCK_STREAM, &name[5], name_bytes[5]);
	must(chdir("sub") == 0, "chdir");
	expect_server(7, SOCK_STREAM, &name[7], name_bytes[7]);
	CHECK(stat("../server", &st) == 0 && st.st_mode == file_before[0].st_mode &&
		      st.st_uid == 123 && st.st_gid == 456,
	      "the file has mode %o and owner %u:%u", st.st_mode, st.st_uid, st.st_gid);
	CHECK(access("../moved.new", F_OK) && access("../deleted", F_OK),
	      "files that were not there");
}

/* ---- of a process that could not make it again ------------------------------------- */

static void dropped_setup(void)
{
	must(chdir(folder) == 0 && (mkdir("open", 0755) == 0 || errno == EEXIST), "mkdir");
	must(chdir("open") == 0, "chdir");
	fd[0] = listen_unix(SOCK_STREAM, "server", 3);
	fd[1] = bind_unix(SOCK_DGRAM, path_of("open/datagrams"));
	must(chmod("server", 0666) == 0 && chmod("datagrams", 0666) == 0, "chmod");
	remember_name(0);
	remember_name(1);
	/* A root of its own, and no right to write there, or to become anybody else. */
	must(chroot(".") == 0 && setgid(1234) == 0 && setuid(1234) == 0, "setuid");
}

static void dropped_disturb(void)
{
	close(fd[0]);
	close(fd[1]);
}

static void dropped_verify(void)
{
	struct sockaddr_un address = { AF_UNIX, "/datagrams" };
	struct stat st;
	int s = socket(AF_UNIX, SOCK_DGRAM, 0);

	expect_name(0);
	expect_name(1);
	expect_server(0, SOCK_STREAM, &name[0], name_bytes[0]);
	CHECK(sendto(s, "a", 1, 0, (struct sockaddr *)&address, sizeof address) == 1, "sendto: %s",
	      strerror(errno));
	close(s);
	expect_text(fd[1], "a", "a datagram");
	CHECK(stat("/server", &st) == 0 && st.st_uid == 0 && (st.st_mode & 0777) == 0666,
	      "the file has mode %o and owner %u", st.st_mode, st.st_uid);
}

/* ---- shared with another process --------------------------------------------------------- */

#define CLOSED 5 /* counter: the child has closed it */

static pid_t child;

static _Noreturn void serve(void)
{
	asked = 0;
	for (;;) {
		const struct timespec pause = { 0, 1000000 };
		const int client = accept(fd[0], NULL, NULL);
		const pid_t pid = getpid();

		if (client >= 0 && write(client, &pid, sizeof pid) > 0)
			close(client);
		nanosleep(&pause, NULL);
		if (asked) {
			asked = 0;
			close(fd[0]);
			count(CLOSED, 1);
		}
	}
}

static void family_setup(void)
{
	fd[0] = listen_unix(SOCK_STREAM | SOCK_NONBLOCK, path_of("server"), 3);
	remember_name(0);
	signal(SIGPIPE, SIG_IGN);
	child = fork();
	if (!child)
		serve();
}

static void family_disturb(void)
{
	const uint64_t before = board->counter[CLOSED];

	close(fd[0]);
	if (board->counter[0] % 2)
		return; /* the child has it still */
	must(kill(child, SIGUSR1) == 0, "kill");
	while (__atomic_load_n(&board->counter[CLOSED], __ATOMIC_ACQUIRE) == before)
		nap_us(100);
}

static void family_verify(void)
{
	const struct timeval patience = { 5, 0 };
	const int client = socket(AF_UNIX, SOCK_STREAM, 0);
	pid_t by = 0;
	ssize_t n;

	expect_name(0);
	setsockopt(client, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
	CHECK(connect(client, (struct sockaddr *)&name[0], name_bytes[0]) == 0, "connect: %s",
	      strerror(errno));
	do {
		n = read(client, &by, sizeof by); /* cut short by a signal: socket(7) */
	} while (n < 0 && errno == EINTR);
	CHECK(n == sizeof by && by == child, "served by %d instead of %d: %zd, %s", by, child, n,
	      n < 0 ? strerror(errno) : "");
	close(client);
}

/* ---- shared with workers that give up as soon as their parent has died ------------------- */

static ino_t shared_ino;

static _Noreturn void work(pid_t parent)
{
	struct stat st;

	for (;;) {
		const bool deserted = getppid() != parent;

		if (deserted) {
			close(fd[0]);
			close(fd[1]);
		} else {
			CHECK(accept(fd[0], NULL, NULL) < 0 && errno == EAGAIN,
			      "a listening socket does not listen: %s", strerror(errno));
			CHECK(fstat(fd[1], &st) == 0 && st.st_ino == shared_ino,
			      "another file than it shared with its parent");
		}
		nap_us(deserted ? 1000000 : 50);
	}
}

static void deserted_setup(void)
{
	const pid_t parent = getpid();
	struct stat st;

	fd[0] = listen_inet(0, SOCK_NONBLOCK, 0);
	fd[1] = make_file("shared", "", O_RDWR);
	must(unlink(path_of("shared")) == 0 && fstat(fd[1], &st) == 0, "unlink");
	shared_ino = st.st_ino;
	for (int i = 0; i < 3; i++)
		if (!fork())
			work(parent);
}

/* ---- a port that goes over to a new worker ----------------------------------------------- */

static void handed_over_setup(void)
{
	fd[0] = listen_inet(0, SOCK_NONBLOCK, 1);
	remember_name(0);
}

static void handed_over_disturb(void)
{
	int ready[2];
	char word = 0;

	close(fd[0]);
	must(pipe(ready) == 0, "pipe");
	if (!fork()) {
		listen_inet(remembered_port(0), 0, 1);
		must(write(ready[1], &word, 1) == 1, "write");
		for (;;)
			pause();
	}
	must(read(ready[0], &word, 1) == 1, "the worker");
	close(ready[0]);
	close(ready[1]);
}

static void handed_over_verify(void)
{
	const int client = socket(AF_INET, SOCK_STREAM, 0);
	int server;

	CHECK(connect(client, (struct sockaddr *)&name[0], name_bytes[0]) == 0,
	      "port %d cannot be connected to: %s", ntohs(remembered_port(0)), strerror(errno));
	server = accept(fd[0], NULL, NULL);
	CHECK(server >= 0, "nobody comes in: %s", strerror(errno));
	close(server);
	close(client);
}

/* ---- one that somebody else has the name of ------------------------------------------ */

static void taken_setup(void)
{
	fd[0] = listen_unix(SOCK_STREAM, path_of("server"), 3);
}

static void taken_disturb(void)
{
	close(fd[0]);
	must(unlink(path_of("server")) == 0, "unlink");
}

static void taken_verify(void)
{
	CHECK(accept(fd[0], NULL, NULL) < 0, "there is a client");
}

/* ---- datagrams --------------------------------------------------------------------------- */

static void connect_name(int s, int i)
{
	must(connect(s, (struct sockaddr *)&name[i], name_bytes[i]) == 0, "connect");
}

static void datagrams_setup(void)
{
	must(chdir(folder) == 0, "chdir");
	fd[1] = bind_unix(SOCK_DGRAM, path_of("receiver"));
	must(chmod(path_of("receiver"), 0600) == 0, "chmod");
	fd[2] = bind_unix(SOCK_DGRAM, "@avckpt-test-receiver");
	fd[3] = bind_unix(SOCK_DGRAM, "kept");
	for (int i = 1; i <= 3; i++)
		remember_name(i);
	/* The first is made again before the one that it is connected to. */
	fd[0] = socket(AF_UNIX, SOCK_DGRAM, 0);
	fd[4] = bind_unix(SOCK_DGRAM, "connected");
	fd[5] = socket(AF_UNIX, SOCK_DGRAM, 0);
	fd[6] = socket(AF_UNIX, SOCK_DGRAM, 0);
	fd[7] = socket(AF_UNIX, SOCK_DGRAM, 0); /* to nobody */
	connect_name(fd[0], 1);
	connect_name(fd[4], 2);
	connect_name(fd[5], 3);
	connect_name(fd[6], 1); /* stays open, but what it is connected to does not */
	remember_name(4);
}

static void datagrams_disturb(void)
{
	for (int i = 0; i <= 7; i++)
		if (i != 3 && i != 6)
			close(fd[i]);
}

static void datagrams_verify(void)
{
	struct sockaddr_un from;
	socklen_t bytes = sizeof from;
	struct stat st;

	for (int i = 1; i <= 4; i++)
		expect_name(i);
	CHECK(stat(path_of("receiver"), &st) == 0 && (st.st_mode & 0777) == 0600, "mode %o",
	      st.st_mode);
	CHECK(send(fd[0], "a", 1, 0) == 1, "the first: %s", strerror(errno));
	expect_text(fd[1], "a", "a datagram");
	CHECK(send(fd[4], "b", 1, 0) == 1, "one with a name: %s", strerror(errno));
	CHECK(recvfrom(fd[2], scratch, 10, 0, (struct sockaddr *)&from, &bytes) == 1 &&
		      bytes == name_bytes[4] && !memcmp(&from, &name[4], bytes),
	      "it came from somebody else");
	CHECK(send(fd[5], "c", 1, 0) == 1, "to one that was kept: %s", strerror(errno));
	expect_text(fd[3], "c", "a datagram to one that was kept");
	CHECK(send(fd[6], "d", 1, 0) == 1, "from one that was kept: %s", strerror(errno));
	expect_text(fd[1], "d", "a datagram from one that was kept");
	CHECK(sendto(fd[7], "e", 1, 0, (struct sockaddr *)&name[3], name_bytes[3]) == 1,
	      "one without a name: %s", strerror(errno));
	expect_text(fd[3], "e", "a datagram from one without a name");
}

/* ---- the same address again, by number and all ------------------------------------------- */

static void rebound_setup(void)
{
	fd[0] = listen_inet(0, 0, 0);
	fd[1] = listen_unix(SOCK_STREAM, path_of("server"), 3);
	remember_name(0);
	remember_name(1);
}

static void rebound_disturb(void)
{
	close(fd[0]);
	must(listen_inet(remembered_port(0), 0, 0) == fd[0], "another number");
	close(fd[1]);
	unlink(path_of("server"));
	must(listen_unix(SOCK_STREAM, path_of("server"), 3) == fd[1], "another number");
}

static void rebound_verify(void)
{
	int client = socket(AF_INET, SOCK_STREAM, 0), server;

	expect_name(0);
	expect_name(1);
	must(connect(client, (struct sockaddr *)&name[0], name_bytes[0]) == 0, "connect");
	server = accept(fd[0], NULL, NULL);
	CHECK(server >= 0, "accept: %s", strerror(errno));
	close(client); /* so that it is not this side that waits (TIME_WAIT) */
	CHECK(read(server, scratch, 1) == 0, "read");
	close(server);
	expect_server(1, SOCK_STREAM, &name[1], name_bytes[1]);
}

/* ---- that were only just made --------------------------------------------------------------- */

#define EARLY 7

static const struct {
	int domain, type;
	bool connects;
} early[EARLY] = {
	{ AF_INET, SOCK_STREAM, false },    { AF_INET, SOCK_STREAM, true },
	{ AF_INET6, SOCK_STREAM, false },   { AF_INET, SOCK_DGRAM, false },
	{ AF_UNIX, SOCK_STREAM, false },    { AF_UNIX, SOCK_STREAM, true },
	{ AF_UNIX, SOCK_SEQPACKET, false },
};

static void early_setup(void)
{
	const int yes = 1;

	for (int i = 0; i < EARLY; i++) {
		fd[i] = socket(early[i].domain, early[i].type, 0);
		must(fd[i] >= 0 && !setsockopt(fd[i], SOL_SOCKET, SO_KEEPALIVE, &yes, sizeof yes),
		     "socket");
	}
	fd[EARLY] = listen_inet(0, 0, 0);
	fd[EARLY + 1] = listen_unix(SOCK_STREAM, "@early", 100);
	remember_name(EARLY);
	remember_name(EARLY + 1);
}

static void early_disturb(void)
{
	for (int i = 0; i < EARLY; i++) {
		const int to = early[i].domain == AF_UNIX ? EARLY + 1 : EARLY;
		struct sockaddr_storage any = { .ss_family = (sa_family_t)early[i].domain };
		/* Of a Unix socket: an abstract name that the kernel chooses. */
		const socklen_t bytes = early[i].domain == AF_UNIX   ? sizeof any.ss_family
					: early[i].domain == AF_INET ? sizeof(struct sockaddr_in)
								     : sizeof(struct sockaddr_in6);

		CHECK(!(early[i].connects
				? connect(fd[i], (struct sockaddr *)&name[to], name_bytes[to])
				: bind(fd[i], (struct sockaddr *)&any, bytes)),
		      "socket %d cannot be used: %s", i, strerror(errno));
		if (early[i].connects)
			close(accept(fd[to], NULL, NULL)); /* there is not much room */
		CHECK(early[i].connects || early[i].type == SOCK_DGRAM || !listen(fd[i], 5),
		      "socket %d cannot listen: %s", i, strerror(errno));
	}
}

static void early_verify(void)
{
	for (int i = 0; i < EARLY; i++) {
		struct sockaddr_storage is = { 0 };
		socklen_t bytes = sizeof is;
		int yes = 0;

		CHECK(!getsockname(fd[i], (struct sockaddr *)&is, &bytes) &&
			      (early[i].domain == AF_UNIX ? bytes == sizeof is.ss_family
							  : !((struct sockaddr_in *)&is)->sin_port),
		      "socket %d has a name", i);
		bytes = sizeof is;
		CHECK(getpeername(fd[i], (struct sockaddr *)&is, &bytes) && errno == ENOTCONN,
		      "socket %d is connected", i);
		bytes = sizeof yes;
		CHECK(!getsockopt(fd[i], SOL_SOCKET, SO_KEEPALIVE, &yes, &bytes) && yes,
		      "socket %d has lost an option", i);
	}
}

/* ---- that are made, bound and closed all the time ------------------------------------------ */

static int listen_later(void)
{
	const struct sockaddr_in any = { .sin_family = AF_INET };
	const int s = socket(AF_INET, SOCK_STREAM, 0);

	must(s >= 0, "socket");
	nap_us(300);
	CHECK(!bind(s, (const struct sockaddr *)&any, sizeof any), "bind: %s", strerror(errno));
	return s;
}

static void *be_brief(void *unused)
{
	for (;;) {
		const int s = listen_later();
		struct sockaddr_in is = { 0 };
		socklen_t bytes = sizeof is;

		nap_us(300);
		CHECK(!getsockname(s, (struct sockaddr *)&is, &bytes) && is.sin_port,
		      "a socket has lost its name");
		close(s);
	}
	return unused;
}

static void brief_setup(void)
{
	pthread_t thread;

	must(!pthread_create(&thread, NULL, be_brief, NULL), "pthread_create");
}

/* ---- options --------------------------------------------------------------------------------- */

#define TCP_SERVER 0
#define UDP 1
#define UDP_SAME 2 /* the same port, and somebody else's */
#define UDP6 4
#define DATAGRAM 5
#define UNIX_SERVER 6
#define UNBOUND 7
#define SOCKETS 8

static const struct {
	int socket, level, name, value;
} set[] = {
	{ TCP_SERVER, SOL_SOCKET, SO_REUSEADDR, 1 },
	{ TCP_SERVER, SOL_SOCKET, SO_KEEPALIVE, 1 },
	{ TCP_SERVER, SOL_SOCKET, SO_OOBINLINE, 1 },
	{ TCP_SERVER, SOL_SOCKET, SO_RCVBUF, 3000000 },
	{ TCP_SERVER, SOL_SOCKET, SO_SNDBUF, 30000 },
	{ TCP_SERVER, IPPROTO_TCP, TCP_NODELAY, 1 },
	{ TCP_SERVER, IPPROTO_TCP, TCP_DEFER_ACCEPT, 5 },
	{ TCP_SERVER, IPPROTO_TCP, TCP_FASTOPEN, 6 },
	{ TCP_SERVER, IPPROTO_TCP, TCP_USER_TIMEOUT, 12345 },
	{ TCP_SERVER, IPPROTO_TCP, TCP_KEEPIDLE, 33 },
	{ TCP_SERVER, IPPROTO_IP, IP_TTL, 33 },
	{ UDP, SOL_SOCKET, SO_REUSEPORT, 1 },
	{ UDP, SOL_SOCKET, SO_BROADCAST, 1 },
	{ UDP, SOL_SOCKET, SO_MARK, 7 },
	{ UDP, IPPROTO_IP, IP_TOS, 0x10 },
	{ UDP, SOL_SOCKET, SO_PRIORITY, 3 },
	{ UDP, SOL_SOCKET, SO_RCVBUF, 50000 },
	{ UDP, IPPROTO_IP, IP_PKTINFO, 1 },
	{ UDP, IPPROTO_IP, IP_MULTICAST_TTL, 9 },
	{ UDP, IPPROTO_IP, IP_MULTICAST_LOOP, 0 },
	{ UDP_SAME, SOL_SOCKET, SO_REUSEPORT, 1 },
	{ UDP_SAME + 1, SOL_SOCKET, SO_REUSEPORT, 1 },
	{ UDP6, IPPROTO_IPV6, IPV6_V6ONLY, 1 },
	{ UDP6, SOL_SOCKET, SO_REUSEPORT, 1 },
	{ UDP6, IPPROTO_IPV6, IPV6_TCLASS, 0x20 },
	{ DATAGRAM, SOL_SOCKET, SO_PASSCRED, 1 },
	{ DATAGRAM, SOL_SOCKET, SO_SNDBUF, 40000 },
	{ UNIX_SERVER, SOL_SOCKET, SO_PASSCRED, 1 },
	{ UNBOUND, SOL_SOCKET, SO_BROADCAST, 1 },
};
static int got[sizeof set / sizeof *set];

static int option(size_t i)
{
	int value = -1;
	socklen_t bytes = sizeof value;

	must(getsockopt(fd[set[i].socket], set[i].level, set[i].name, &value, &bytes) == 0,
	     "getsockopt");
	return value;
}

static void options_setup(void)
{
	const struct timeval time = { 3, 500000 };
	const struct linger linger = { 1, 11 };
	/* Where nobody else's ports are taken from. */
	struct sockaddr_in here = { .sin_family = AF_INET,
				    .sin_addr.s_addr =
					    htonl(0x7f4d0001 + (now_ns() >> 10) % 65534) };
	struct sockaddr_in6 here6 = { .sin6_family = AF_INET6 };
	socklen_t bytes = sizeof here;

	fd[TCP_SERVER] = socket(AF_INET, SOCK_STREAM, 0);
	fd[UDP] = socket(AF_INET, SOCK_DGRAM, 0);
	setfsuid(1234);
	fd[UDP_SAME] = socket(AF_INET, SOCK_DGRAM, 0);
	fd[UDP_SAME + 1] = socket(AF_INET, SOCK_DGRAM, 0);
	setfsuid(0);
	fd[UDP6] = socket(AF_INET6, SOCK_DGRAM, 0);
	fd[DATAGRAM] = bind_unix(SOCK_DGRAM, path_of("datagram"));
	fd[UNBOUND] = socket(AF_INET, SOCK_DGRAM, 0);
	fd[UNIX_SERVER] = bind_unix(SOCK_STREAM, path_of("server"));
	for (size_t i = 0; i < sizeof set / sizeof *set; i++) {
		must(setsockopt(fd[set[i].socket], set[i].level, set[i].name, &set[i].value,
				sizeof set[i].value) == 0,
		     "setsockopt");
	}
	must(!setsockopt(fd[UDP], SOL_SOCKET, SO_RCVTIMEO, &time, sizeof time) &&
		     !setsockopt(fd[UNIX_SERVER], SOL_SOCKET, SO_SNDTIMEO, &time, sizeof time) &&
		     !setsockopt(fd[TCP_SERVER], SOL_SOCKET, SO_LINGER, &linger, sizeof linger) &&
		     !setsockopt(fd[UDP], SOL_SOCKET, SO_BINDTODEVICE, "lo", 3),
	     "setsockopt");
	must(bind(fd[TCP_SERVER], (struct sockaddr *)&here, sizeof here) == 0 &&
		     listen(fd[TCP_SERVER], 7) == 0 && listen(fd[UNIX_SERVER], 7) == 0,
	     "listen");
	must(bind(fd[UDP], (struct sockaddr *)&here, sizeof here) == 0, "bind");
	must(bind(fd[UDP_SAME], (struct sockaddr *)&here, sizeof here) == 0, "bind");
	must(getsockname(fd[UDP_SAME], (struct sockaddr *)&here, &bytes) == 0, "getsockname");
	must(bind(fd[UDP_SAME + 1], (struct sockaddr *)&here, sizeof here) == 0, "bind");
	/* Without V6ONLY it would be in the way of those. */
	here6.sin6_port = here.sin_port;
	must(bind(fd[UDP6], (struct sockaddr *)&here6, sizeof here6) == 0, "bind");
	for (int i = 0; i < SOCKETS; i++)
		remember_name(i);
	for (size_t i = 0; i < sizeof set / sizeof *set; i++)
		got[i] = option(i);
}

static void options_disturb(void)
{
	for (int i = 0; i < SOCKETS; i++)
		if (i != UDP_SAME)
			close(fd[i]);
}

static void expect_option(int s, int option_name, const void *value, socklen_t bytes)
{
	char is[16] = { 0 };
	socklen_t is_bytes = sizeof is;

	CHECK(!getsockopt(fd[s], SOL_SOCKET, option_name, is, &is_bytes) && is_bytes == bytes &&
		      !memcmp(is, value, bytes),
	      "socket %d has lost option %d", s, option_name);
}

static void options_verify(void)
{
	const struct timeval time = { 3, 500000 };
	const struct linger linger = { 1, 11 };

	for (int i = 0; i < SOCKETS; i++)
		expect_name(i);
	for (size_t i = 0; i < sizeof set / sizeof *set; i++)
		CHECK(option(i) == got[i], "option %d:%d of socket %d is %d instead of %d",
		      set[i].level, set[i].name, set[i].socket, option(i), got[i]);
	expect_option(UDP, SO_RCVTIMEO, &time, sizeof time);
	expect_option(UNIX_SERVER, SO_SNDTIMEO, &time, sizeof time);
	expect_option(TCP_SERVER, SO_LINGER, &linger, sizeof linger);
	expect_option(UDP, SO_BINDTODEVICE, "lo", 3);
}

/* ---- a connect(2) that waits for its server ------------------------------------------------ */

static atomic_bool connected;

static void *connect_and_wait(void *arg)
{
	must(!connect(fd[1], (struct sockaddr *)&name[0], name_bytes[0]), "connect");
	connected = true;
	for (;;)
		pause();
	return arg;
}

static bool is_connecting(void)
{
	struct tcp_info info = { 0 };
	socklen_t bytes = sizeof info;

	return !getsockopt(fd[1], IPPROTO_TCP, TCP_INFO, &info, &bytes) &&
	       info.tcpi_state == TCP_SYN_SENT;
}

/* Of a server: one that waits to be accepted, and one more whose SYN is not answered. */
static void fill_queue(void)
{
	fd[0] = listen_inet(0, SOCK_NONBLOCK, 1);
	must(!listen(fd[0], 0), "listen");
	remember_name(0);
	for (int i = 2; i < 4; i++) {
		fd[i] = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK, 0);
		must(!connect(fd[i], (struct sockaddr *)&name[0], name_bytes[0]) ||
			     errno == EINPROGRESS,
		     "connect");
	}
}

static void connecting_setup(void)
{
	const struct timeval time = { 30, 0 };
	pthread_t thread;

	fill_queue();
	fd[1] = socket(AF_INET, SOCK_STREAM, 0);
	must(!setsockopt(fd[1], SOL_SOCKET, SO_SNDTIMEO, &time, sizeof time) &&
		     !pthread_create(&thread, NULL, connect_and_wait, NULL),
	     "pthread_create");
	while (!is_connecting())
		usleep(1000);
}

/* With the next of its SYNs. */
static void accept_until_connected(void)
{
	for (; !connected; usleep(1000))
		(void)!accept(fd[0], NULL, NULL);
}

static void closed_disturb(void)
{
	accept_until_connected();
	close(fd[1]);
}

static void connecting_verify(void)
{
	const struct timeval time = { 30, 0 };
	struct sockaddr_storage server;
	socklen_t bytes = sizeof server;

	accept_until_connected();
	CHECK(!getpeername(fd[1], (struct sockaddr *)&server, &bytes), "not connected: %s",
	      strerror(errno));
	expect_option(1, SO_SNDTIMEO, &time, sizeof time);
}

/* ---- the same without blocking ----------------------------------------------------------- */

static void connect_and_poll(void)
{
	struct epoll_event event = { .events = EPOLLOUT | EPOLLIN | EPOLLET };

	fd[1] = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK, 0);
	fd[5] = epoll_create1(0);
	must(connect(fd[1], (struct sockaddr *)&name[0], name_bytes[0]) && errno == EINPROGRESS &&
		     !epoll_ctl(fd[5], EPOLL_CTL_ADD, fd[1], &event),
	     "connect");
}

static void polled_setup(void)
{
	fill_queue();
	connect_and_poll();
}

/* As Go has it: with an error or a peer. */
static bool has_ended(void)
{
	struct sockaddr_storage server;
	socklen_t bytes = sizeof server, error_bytes = sizeof(int);
	int error = 0;

	must(!getsockopt(fd[1], SOL_SOCKET, SO_ERROR, &error, &error_bytes), "SO_ERROR");
	return error || !getpeername(fd[1], (struct sockaddr *)&server, &bytes);
}

static void polled_disturb(void)
{
	struct epoll_event event;

	do
		(void)!accept(fd[0], NULL, NULL);
	while (epoll_wait(fd[5], &event, 1, 1) == 0);
	must(has_ended() && send(fd[1], "hello", 5, 0) == 5, "neither an error nor a peer");
}

static void close_disturb(void)
{
	close(fd[1]);
}

static void polled_verify(void)
{
	struct epoll_event event;

	CHECK(epoll_wait(fd[5], &event, 1, 20000) == 1 && has_ended(), "a connect that never ends");
}

/* ---- one that is made, which its process has not seen yet -------------------------------------- */

static void unseen_setup(void)
{
	fd[0] = listen_inet(0, SOCK_NONBLOCK, 1);
	remember_name(0);
	connect_and_poll();
}

static void unseen_disturb(void)
{
	must(has_ended() && send(fd[1], "hello", 5, 0) == 5, "neither an error nor a peer");
}

/* ---- one that was refused, likewise ---------------------------------------------------------------- */

static void refused_setup(void)
{
	fd[0] = listen_inet(0, SOCK_NONBLOCK, 1);
	remember_name(0);
	close(fd[0]);
	connect_and_poll();
}

static void refused_disturb(void)
{
	must(has_ended() && !has_ended(), "no error");
}

/* ---- the end of what a peer sends ---------------------------------------------------------------- */

static char received[64];

static void received_setup(void)
{
	fd[0] = listen_inet(0, 0, 1);
	remember_name(0);
	fd[1] = socket(AF_INET, SOCK_STREAM, 0);
	must(!connect(fd[1], (struct sockaddr *)&name[0], name_bytes[0]), "connect");
	fd[2] = accept(fd[0], NULL, NULL);
	must(send(fd[2], "one ", 4, 0) == 4 && recv(fd[1], received, 4, MSG_WAITALL) == 4, "recv");
}

/* It has said all that it will, but does hear the rest. */
static void received_half_setup(void)
{
	received_setup();
	must(!shutdown(fd[1], SHUT_WR), "shutdown");
}

static void send_the_rest(void)
{
	must(send(fd[2], "two three", 9, 0) == 9, "send");
	close(fd[2]);
	usleep(10000);
}

static void received_disturb(void)
{
	send_the_rest();
	must(recv(fd[1], received + 4, 4, MSG_WAITALL) == 4, "recv");
}

static void received_closed_disturb(void)
{
	received_disturb();
	close(fd[1]);
}

/* Neither the third without the second, nor the end after the first. */
static void received_verify(void)
{
	const ssize_t n = recv(fd[1], received + 4, 9, 0);

	CHECK(n < 0 && errno == ECONNRESET, "it received '%.*s' and has not heard of a loss: %zd",
	      (int)sizeof received, received, n);
}

/* A message is cut in half. */
static void received_part_setup(void)
{
	received_setup();
	must(send(fd[2], "two", 3, 0) == 3, "send");
	usleep(10000);
}

static void received_part_disturb(void)
{
	must(send(fd[2], " three", 6, 0) == 6, "send");
	must(recv(fd[1], received + 4, 4, MSG_WAITALL) == 4, "recv");
	close(fd[2]);
	usleep(10000);
}

static void unread_verify(void)
{
	CHECK(recv(fd[1], received + 4, 9, MSG_PEEK | MSG_WAITALL) == 9 &&
		      !strcmp(received, "one two three"),
	      "what nobody had read is lost: %s", strerror(errno));
}

/* ---- the server of a Unix socket, outside ------------------------------------------------------- */

static void connect_outside(const char *file)
{
	const struct sockaddr_un server = path_address(file);

	fd[1] = socket(AF_UNIX, SOCK_STREAM, 0);
	must(!connect(fd[1], (const struct sockaddr *)&server, sizeof server) &&
		     recv(fd[1], received, 4, MSG_WAITALL) == 4,
	     "recv");
}

static void outside_setup(void)
{
	connect_outside("server");
}

static void nothing_disturb(void)
{
}

static void bus_setup(void)
{
	connect_outside("bus");
}

static void bus_verify(void)
{
	CHECK(send(fd[1], "two", 3, MSG_NOSIGNAL) == 3, "its bus is lost: %s", strerror(errno));
	CHECK(recv(fd[1], received, 1, MSG_DONTWAIT) < 0 && errno == EAGAIN, "its bus has ended");
}

static const struct scenario scenarios[] = {
	{ "unix", unix_setup, unix_disturb, unix_verify },
	{ "dropped", dropped_setup, dropped_disturb, dropped_verify },
	{ "family", family_setup, family_disturb, family_verify },
	{ "deserted", deserted_setup, nothing, nothing },
	{ "handed-over", handed_over_setup, handed_over_disturb, handed_over_verify },
	{ "taken", taken_setup, taken_disturb, taken_verify },
	{ "datagrams", datagrams_setup, datagrams_disturb, datagrams_verify },
	{ "rebound", rebound_setup, rebound_disturb, rebound_verify },
	{ "early", early_setup, early_disturb, early_verify },
	{ "brief", brief_setup, nothing, nothing },
	{ "connecting", connecting_setup, accept_until_connected, connecting_verify },
	{ "connecting-closed", connecting_setup, closed_disturb, connecting_verify },
	{ "polled", polled_setup, polled_disturb, polled_verify },
	{ "polled-closed", polled_setup, close_disturb, polled_verify },
	{ "unseen", unseen_setup, unseen_disturb, polled_verify },
	{ "unseen-closed", unseen_setup, close_disturb, polled_verify },
	{ "refused", refused_setup, refused_disturb, polled_verify },
	{ "refused-closed", refused_setup, close_disturb, polled_verify },
	{ "received", received_setup, received_disturb, received_verify },
	{ "received-half", received_half_setup, received_disturb, received_verify },
	{ "received-closed", received_setup, received_closed_disturb, received_verify },
	{ "received-part", received_part_setup, received_part_disturb, received_verify },
	{ "outside", outside_setup, close_disturb, received_verify },
	{ "outside-open", outside_setup, nothing_disturb, received_verify },
	{ "bus", bus_setup, nothing_disturb, bus_verify },
	{ "unread", received_setup, send_the_rest, unread_verify },
	{ "unread-half", received_half_setup, send_the_rest, unread_verify },
	{ "options", options_setup, options_disturb, options_verify },
};

int main(int argc, char **argv)
{
	play(argc, argv, scenarios, sizeof scenarios / sizeof *scenarios);
}
