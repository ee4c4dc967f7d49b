/* SPDX-License-Identifier: Apache-2.0
 *
 * openings N KIND [--closes] [--again]: SIGUSR1 opens N descriptors of that kind (null, file, eventfd,
 * pair, tcp).  With --closes a file of its own that was open from the start is closed before.
 * With --again it closes them and opens them anew, for ever.  counter[0] is how often it has opened
 * them.  Beats every 1 ms.
 */
#include <signal.h>
#include <sys/eventfd.h>
#include <sys/resource.h>
#include <sys/socket.h>

#include "victim.h"

#define OWN 100

static volatile sig_atomic_t asked;

static void on_signal(int sig)
{
	(void)sig;
	asked = 1;
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
	else
		must(!socketpair(AF_UNIX, SOCK_STREAM, 0, ends), "socketpair");
	return strcmp(kind, "pair") ? 1 : 2;
}

int main(int argc, char **argv)
{
	const bool closes = victim_flag(&argc, argv, "--closes");
	const bool again = victim_flag(&argc, argv, "--again");
	struct sigaction act = { .sa_handler = on_signal, .sa_flags = SA_RESTART };
	struct rlimit limit;

	victim_start(&argc, argv, 2, "N KIND [--closes] [--again]");
	must(!getrlimit(RLIMIT_NOFILE, &limit), "getrlimit");
	limit.rlim_cur = limit.rlim_max;
	must(!setrlimit(RLIMIT_NOFILE, &limit), "setrlimit");
	must(open("/etc/passwd", O_RDONLY) >= 0 && dup2(0, OWN) == OWN, "open");
	must(dup2(open("/etc/group", O_RDONLY), OWN) == OWN, "dup2");
	sigaction(SIGUSR1, &act, NULL);
	victim_ready();
	for (;;) {
		usleep(1000); /* cut short by the signal above */
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
		count(0, 1);
		if (again) {
			must(!syscall(SYS_close_range, OWN + 1, ~0u, 0), "close_range");
			for (int fd = STDERR_FILENO + 1; fd < OWN; fd++)
				close(fd);
			asked = 1;
		}
	}
}
