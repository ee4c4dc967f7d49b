/* SPDX-License-Identifier: Apache-2.0
 *
 * redirect KIND: a child that puts a file of its own in the place of what it has from its parent,
 * and puts that back, as fast as it can.
 *
 *   kept    it has the parent's under another number, too
 *   twins   the parent has it twice
 *   saved   it keeps it as long as its own is there
 *   for-good   one after the other, and nothing comes back
 */
#include <linux/kcmp.h>
#include <sys/socket.h>

#include "victim.h"

enum { FIRST = 20, HEIRS = 300, OWN = 700, KEPT = 701 };

static pid_t parent;

static bool is_same(pid_t a, int fd, pid_t b, int other)
{
	return syscall(SYS_kcmp, a, b, KCMP_FILE, fd, other) == 0;
}

static void look(int fd, bool own)
{
	CHECK(is_same(getpid(), fd, getpid(), OWN) == own, "descriptor %d is%s its own", fd,
	      own ? " not" : "");
	if (is_same(getpid(), fd, parent, fd) != own)
		return;
	/* The parent that was killed has nothing open any more. */
	while (!is_same(parent, fd, parent, fd))
		pause();
	CHECK(is_same(getpid(), fd, parent, fd) != own, "descriptor %d is%s its parent's", fd,
	      own ? "" : " not");
}

static void rest(unsigned int step)
{
	nap_us(step * 7919 % 2500);
}

static void redirect(const char *kind, unsigned int step)
{
	const bool twins = !strcmp(kind, "twins"), saved = !strcmp(kind, "saved");
	const int fd = FIRST + (int)(step % 10) * 2;
	const int from = twins ? fd + 1 : saved ? dup(fd) : KEPT + (int)(step % 10);

	must(dup2(OWN, fd) == fd, "dup2");
	look(fd, true);
	rest(step);
	look(fd, true);
	must(dup2(from, fd) == fd, "dup2");
	if (saved)
		close(from);
	look(fd, false);
	rest(step + 1);
	look(fd, false);
}

static void lose(unsigned int step)
{
	const unsigned int gone = step < HEIRS ? step : HEIRS;

	if (step < HEIRS)
		must(dup2(OWN, FIRST + (int)step) == FIRST + (int)step, "dup2");
	rest(step);
	for (unsigned int i = 0; i < HEIRS; i++)
		look(FIRST + (int)i, i < gone + (step < HEIRS));
}

int main(int argc, char **argv)
{
	bool twins;
	pid_t pid;
	int pair[2], status;

	victim_start(&argc, argv, 1, "KIND");
	twins = !strcmp(argv[1], "twins");
	for (int i = 0; i < HEIRS; i += 2) {
		must(!socketpair(AF_UNIX, SOCK_DGRAM, 0, pair), "socketpair");
		must(dup2(pair[0], OWN + 100) >= 0 && dup2(pair[1], OWN + 101) >= 0, "dup2");
		if (pair[0] < FIRST)
			close(pair[0]);
		if (pair[1] < FIRST)
			close(pair[1]);
		must(dup2(OWN + 100, FIRST + i) >= 0, "dup2");
		must(dup2(twins ? OWN + 100 : OWN + 101, FIRST + i + 1) >= 0, "dup2");
	}
	close(OWN + 100);
	close(OWN + 101);
	parent = getpid();
	pid = fork();
	must(pid >= 0, "fork");
	if (pid) {
		must(waitpid(pid, &status, 0) == pid, "waitpid");
		return WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
	}
	must(dup2(open("/etc/passwd", O_RDONLY), OWN) == OWN, "dup2");
	for (int i = 0; i < 10 && !strcmp(argv[1], "kept"); i++)
		must(dup2(FIRST + 2 * i, KEPT + i) >= 0, "dup2");
	victim_ready();
	for (unsigned int step = 0;; step++) {
		if (!strcmp(argv[1], "for-good"))
			lose(step);
		else
			redirect(argv[1], step);
		beat();
	}
}
