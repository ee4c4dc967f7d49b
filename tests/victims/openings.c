/* SPDX-License-Identifier: Apache-2.0
 *
 * openings N KIND [--closes] [--again] [--claims] [--parent]: SIGUSR1 opens N descriptors of that kind
 * (null, file, eventfd, pair, pipe, tcp; peers: TCP connections with itself).  With --closes a file of its
 * own that was open from the start is closed before.  With --again it closes them and opens them anew, for
 * ever.  With --claims it has, too, ports, a name and a lock, and when it was restored takes them again at
 * once.  With --parent it has children, which do nothing.  counter[0] is how often it has opened them.
 * Beats every 1 ms.
 */
#include <netinet/in.h>
#include <signal.h>
#include <stddef.h>
#include <sys/eventfd.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/random.h>
#include <sys/socket.h>
#include <sys/un.h>

#include "victim.h"

#define OWN 100
#define LISTENER 99
#define LOCKED 98
#define CLAIMS 4
#define CHILDREN 4

static volatile sig_atomic_t asked;

static void on_signal(int sig)
{
	(void)sig;
	asked = 1;
}

/* By a listening socket that was there before.  They are reset when they are closed, so that their ports
 * are free again. */
static void connect_to_self(void)
{
	const struct linger none = { .l_onoff = 1 };
	struct sockaddr_in own = { 0 };
	socklen_t bytes = sizeof own;
	const int fd = socket(AF_INET, SOCK_STREAM, 0);

	must(!getsockname(LISTENER, (struct sockaddr *)&own, &bytes), "getsockname");
	must(fd >= 0 && !connect(fd, (struct sockaddr *)&own, bytes), "connect");
	must(!setsockopt(fd, SOL_SOCKET, SO_LINGER, &none, sizeof none), "SO_LINGER");
	must(accept(LISTENER, NULL, NULL) >= 0, "accept");
}

static void make_listener(void)
{
	const int fd = socket(AF_INET, SOCK_STREAM, 0);

	must(fd >= 0 && !listen(fd, 16) && dup2(fd, LISTENER) == LISTENER && !close(fd), "listen");
}

/* How many there are more. */
static int open_more(const char *kind)
{
	int ends[2];

	if (!strcmp(kind, "null"))
		must(open("/dev/null", O_RDONLY) >= 0, "open");
	else if (!strcmp(kind, "file"))
		must(open("/etc/passwd", O_RDONLY) >= 0, "open");
	else if (!strcmp(kind, "eventfd"))
		must(eventfd(0, 0) >= 0, "eventfd");
	else if (!strcmp(kind, "tcp"))
		must(socket(AF_INET, SOCK_STREAM, 0) >= 0, "socket");
	else if (!strcmp(kind, "pipe"))
		must(!pipe(ends), "pipe");
	else if (!strcmp(kind, "peers"))
		connect_to_self();
	else
		must(!socketpair(AF_UNIX, SOCK_STREAM, 0, ends), "socketpair");
	return strcmp(kind, "pair") && strcmp(kind, "pipe") && strcmp(kind, "peers") ? 1 : 2;
}

static uint16_t port;

static struct sockaddr_in own_port(void)
{
	return (struct sockaddr_in){ .sin_family = AF_INET,
				     .sin_port = htons(port),
				     .sin_addr = { htonl(INADDR_LOOPBACK) } };
}

/* What only one can have; -1 where somebody has it. */
static void take_claims(int fd[CLAIMS])
{
	const struct sockaddr_in own = own_port();
	const struct sockaddr *in = (const struct sockaddr *)&own;
	struct sockaddr_un name = { .sun_family = AF_UNIX };
	const socklen_t bytes = offsetof(struct sockaddr_un, sun_path) + 1 + sizeof port;
	bool failed[CLAIMS];

	memcpy(name.sun_path + 1, &port, sizeof port);
	fd[0] = socket(AF_INET, SOCK_STREAM, 0);
	fd[1] = socket(AF_INET, SOCK_DGRAM, 0);
	fd[2] = socket(AF_UNIX, SOCK_STREAM, 0);
	fd[3] = open("/proc/self/fd/98", O_RDONLY);
	failed[0] = bind(fd[0], in, sizeof own) || listen(fd[0], 8);
	failed[1] = bind(fd[1], in, sizeof own) || connect(fd[1], in, sizeof own);
	failed[2] = bind(fd[2], (const struct sockaddr *)&name, bytes);
	failed[3] = flock(fd[3], LOCK_EX | LOCK_NB);
	for (int i = 0; i < CLAIMS; i++)
		if (failed[i]) {
			close(fd[i]);
			fd[i] = -1;
		}
}

static void leave_claims(const int fd[CLAIMS])
{
	for (int i = 0; i < CLAIMS; i++)
		if (fd[i] >= 0)
			close(fd[i]);
}

static bool has_claims(const int fd[CLAIMS])
{
	return fd[0] >= 0 && fd[1] >= 0 && fd[2] >= 0 && fd[3] >= 0;
}

/* Ports that nobody has. */
static void find_claims(void)
{
	int fd[CLAIMS];
	bool found = false;

	must(dup2(memfd_create("locked", 0), LOCKED) == LOCKED, "memfd_create");
	for (int i = 0; i < 100 && !found; i++) {
		must(getrandom(&port, sizeof port, 0) == sizeof port, "getrandom");
		port = (uint16_t)(10000 + port % 20000);
		take_claims(fd);
		found = has_claims(fd);
		leave_claims(fd);
	}
	must(found, "there are ports");
}

static void retake_claims(void)
{
	int fd[CLAIMS];

	take_claims(fd);
	CHECK(has_claims(fd), "somebody has %s%s%s%s", fd[0] < 0 ? "the port, " : "",
	      fd[1] < 0 ? "the UDP port, " : "", fd[2] < 0 ? "the name, " : "",
	      fd[3] < 0 ? "the lock, " : "");
	leave_claims(fd);
}

static void have_child(void)
{
	const pid_t child = fork();

	must(child >= 0, "fork");
	while (!child)
		pause();
}

int main(int argc, char **argv)
{
	const bool closes = victim_flag(&argc, argv, "--closes");
	const bool with_claims = victim_flag(&argc, argv, "--claims");
	const bool again = victim_flag(&argc, argv, "--again");
	const bool parent = victim_flag(&argc, argv, "--parent");
	struct sigaction act = { .sa_handler = on_signal, .sa_flags = SA_RESTART };
	uint64_t opened = 0;
	int claimed[CLAIMS];

	victim_start(&argc, argv, 2, "N KIND [--closes] [--again] [--claims] [--parent]");
	victim_lift_descriptors();
	must(open("/etc/passwd", O_RDONLY) >= 0 && dup2(0, OWN) == OWN, "open");
	must(dup2(open("/etc/group", O_RDONLY), OWN) == OWN, "dup2");
	make_listener();
	if (with_claims)
		find_claims();
	for (int i = 0; parent && i < CHILDREN; i++)
		have_child();
	sigaction(SIGUSR1, &act, NULL);
	victim_ready();
	for (;;) {
		usleep(1000); /* cut short by the signal above */
		/* The board's is not rolled back. */
		if (with_claims && board->counter[0] != opened) {
			opened = board->counter[0];
			retake_claims();
		}
		beat();
		if (!asked)
			continue;
		asked = 0;
		CHECK(fcntl(OWN, F_GETFD) >= 0, "its file is not open");
		CHECK(fcntl(OWN + 50, F_GETFD) < 0, "what was opened since is still open");
		if (closes)
			close(OWN);
		for (int i = 0; i < atoi(argv[1]);)
			i += open_more(argv[2]);
		if (with_claims)
			take_claims(claimed);
		opened++;
		count(0, 1);
		if (again) {
			must(!syscall(SYS_close_range, OWN + 1, ~0u, 0), "close_range");
			for (int fd = STDERR_FILENO + 1; fd < OWN; fd++)
				close(fd);
			asked = 1;
		}
	}
}
