/* SPDX-License-Identifier: Apache-2.0
 *
 *   crowd KIND PROCESSES [MANY] [FOLDER]
 *
 * PROCESSES children, each with much of what a checkpoint might have to keep:
 *
 *   shared   MANY areas of shared memory of its own, of a page each
 *   wiped    MANY MB of memory that is wiped in forks (MADV_WIPEONFORK), never touched
 *   named    MANY descriptors of a file, made below the working folder, whose path has 3,000 characters
 *   common   MANY MB of shared memory that all of them have
 *   watched  nothing of its own, but MANY epoll sets and what they watch from their parent
 *   renewed  nothing: with each beat the oldest of them is killed and replaced
 *   shells   nothing: and there are more of them, shells that run short commands with redirections
 */
#include <signal.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/stat.h>
#include <sys/wait.h>

#include "victim.h"

static void *map(size_t bytes, int protection, int flags)
{
	void *at = mmap(NULL, bytes, protection, flags | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);

	must(at != MAP_FAILED, "mmap");
	return at;
}

static void open_named(size_t many)
{
	char name[251];

	victim_lift_descriptors();
	memset(name, 'n', sizeof name - 1);
	name[sizeof name - 1] = 0;
	for (int depth = 0; depth < 12; depth++)
		must((!mkdir(name, 0700) || errno == EEXIST) && !chdir(name), "mkdir");
	for (size_t i = 0; i < many; i++)
		must(open(name, O_RDWR | O_CREAT, 0600) >= 0, "open");
}

static void open_watched(size_t many)
{
	struct epoll_event event = { .events = EPOLLIN };

	victim_lift_descriptors();
	for (size_t i = 0; i < many; i++) {
		const int set = epoll_create1(0), watched = eventfd(0, 0);

		must(set >= 0 && watched >= 0 && !epoll_ctl(set, EPOLL_CTL_ADD, watched, &event),
		     "epoll");
	}
}

static void have(const char *kind, size_t many)
{
	if (!strcmp(kind, "wiped"))
		must(!madvise(map(many << 20, PROT_READ | PROT_WRITE, MAP_PRIVATE), many << 20,
			      MADV_WIPEONFORK),
		     "MADV_WIPEONFORK");
	else if (!strcmp(kind, "named"))
		open_named(many);
	else if (!strcmp(kind, "shared"))
		for (size_t i = 0; i < many; i++) {
			*(int *)map(4096, PROT_READ | PROT_WRITE, MAP_SHARED) = 1;
			/* Between them, or the kernel makes one of them. */
			map(4096, PROT_NONE, MAP_PRIVATE);
		}
}

static void renew(pid_t *oldest)
{
	must(!kill(*oldest, SIGKILL) && waitpid(*oldest, NULL, 0) == *oldest, "waitpid");
	*oldest = fork();
	must(*oldest >= 0, "fork");
	while (!*oldest)
		pause();
}

static void run_shell(void)
{
	const pid_t shell = fork();

	must(shell >= 0, "fork");
	if (!shell) {
		execl("/bin/sh", "sh", "-c", "sleep 0.01; (true; sleep 0.02) | cat >/dev/null",
		      NULL);
		_exit(1);
	}
	usleep(10000);
	while (waitpid(-1, NULL, WNOHANG) > 0)
		;
}

int main(int argc, char **argv)
{
	volatile uint64_t *there;
	pid_t *worker;
	int processes;
	size_t many;

	victim_start(&argc, argv, 2, "KIND PROCESSES [MANY] [FOLDER]");
	must(argc < 5 || !chdir(argv[4]), "chdir");
	processes = atoi(argv[2]);
	many = argc > 3 ? (size_t)atol(argv[3]) : 0;
	worker = calloc((size_t)processes, sizeof *worker);
	must(worker != NULL, "calloc");
	there = map(4096, PROT_READ | PROT_WRITE, MAP_SHARED);
	if (!strcmp(argv[1], "common"))
		map(many << 20, PROT_READ | PROT_WRITE, MAP_SHARED);
	else if (!strcmp(argv[1], "watched"))
		open_watched(many);
	for (int i = 0; i < processes; i++) {
		const pid_t child = fork();

		must(child >= 0, "fork");
		worker[i] = child;
		if (child)
			continue;
		have(argv[1], many);
		__atomic_add_fetch(there, 1, __ATOMIC_RELEASE);
		for (;;)
			pause();
	}
	while (*there < (uint64_t)processes)
		usleep(1000);
	victim_ready();
	for (uint64_t i = 0;; i++) {
		beat();
		if (!strcmp(argv[1], "renewed"))
			renew(&worker[i % (uint64_t)processes]);
		if (!strcmp(argv[1], "shells"))
			run_shell();
		usleep(1000);
	}
}
