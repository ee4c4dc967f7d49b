/* SPDX-License-Identifier: Apache-2.0
 *
 * Processes that have what their parent has open, but for a few descriptors of their own.
 *
 *   heirs PROCESSES/PAIRS FOLDER     see scenario.h; so many children, so many socket pairs
 */
#include <linux/kcmp.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>

#include "scenario.h"

enum { HEIRS_MAX = 100, FIRST = 10, CLOSED = FIRST, MARKED, OTHER, SWAPPED, SWAPPED_TOO };

static int heirs, pairs;
static pid_t heir[HEIRS_MAX], grandchild;

static void live_as_heir(void)
{
	must(fcntl(MARKED, F_SETFD, FD_CLOEXEC) == 0, "fcntl");
	close(CLOSED);
	must(dup2(open("/etc/passwd", O_RDONLY), OTHER) == OTHER, "dup2");
	close(CLOSED); /* it was the lowest number that was free */
	must(dup2(SWAPPED, 9) == 9 && dup2(SWAPPED_TOO, SWAPPED) == SWAPPED &&
		     dup2(9, SWAPPED_TOO) == SWAPPED_TOO,
	     "dup2");
	close(9);
}

static void rest(int ready)
{
	must(write(ready, "x", 1) == 1, "write");
	close(ready);
	for (;;)
		pause();
}

static void heirs_setup(void)
{
	struct rlimit limit = { 4096, 4096 };
	int ready[2];

	must(!setrlimit(RLIMIT_NOFILE, &limit), "setrlimit");
	must(pipe(ready) == 0, "pipe");
	must(dup2(ready[0], 7) == 7 && dup2(ready[1], 8) == 8, "dup2");
	for (int f = 3; f < 7; f++)
		close(f);
	for (int f = 3; f < FIRST; f++)
		if (f != 7 && f != 8)
			must(dup2(open("/dev/null", O_RDONLY), f) == f, "dup2");
	for (int i = 0; i < pairs; i++)
		must(socketpair(AF_UNIX, i % 2 ? SOCK_STREAM : SOCK_DGRAM, 0, fd) == 0, "pair");
	must(fd[1] == FIRST + 2 * pairs - 1, "numbers");
	must(send(FIRST + 20, "unread", 6, 0) == 6, "send");
	for (int i = 0; i < heirs; i++) {
		heir[i] = fork();
		must(heir[i] >= 0, "fork");
		if (heir[i])
			continue;
		live_as_heir();
		/* One of them has a child of its own. */
		if (i == 1 && fork() == 0)
			rest(8);
		rest(8);
	}
	for (int i = 0; i < heirs + (heirs > 1); i++)
		must(read(7, scratch, 1) == 1, "read");
}

/* The main process has others now, its children have theirs still. */
static void heirs_disturb(void)
{
	for (int f = FIRST; f < FIRST + 2 * pairs; f += 3)
		close(f);
	for (int i = 0; i < 20; i++)
		must(open("/etc/passwd", O_RDONLY) >= 0, "open");
}

static bool is_same(pid_t pid, int theirs, int ours)
{
	return syscall(SYS_kcmp, getpid(), pid, KCMP_FILE, ours, theirs) == 0;
}

static bool is_marked(pid_t pid, int f)
{
	char path[64], text[512], *flags;
	ssize_t n;
	int info;

	snprintf(path, sizeof path, "/proc/%d/fdinfo/%d", pid, f);
	info = open(path, O_RDONLY | O_CLOEXEC);
	n = read(info, text, sizeof text - 1);
	close(info);
	text[n > 0 ? n : 0] = 0;
	flags = strstr(text, "flags:");
	return flags && strtoul(flags + 6, NULL, 8) & O_CLOEXEC;
}

static void expect_heir(pid_t pid)
{
	char path[64];
	struct stat st, passwd;

	for (int f = FIRST; f < FIRST + 2 * pairs; f++) {
		const int ours = f == SWAPPED ? SWAPPED_TOO : f == SWAPPED_TOO ? SWAPPED : f;

		if (f != CLOSED && f != OTHER)
			CHECK(is_same(pid, f, ours), "descriptor %d of %d is not ours", f, pid);
		if (f != CLOSED)
			CHECK(is_marked(pid, f) == (f == MARKED), "O_CLOEXEC of %d of %d", f, pid);
	}
	snprintf(path, sizeof path, "/proc/%d/fd/%d", pid, CLOSED);
	CHECK(stat(path, &st), "descriptor %d of %d is open", CLOSED, pid);
	snprintf(path, sizeof path, "/proc/%d/fd/%d", pid, OTHER);
	CHECK(!stat(path, &st) && !stat("/etc/passwd", &passwd) && st.st_ino == passwd.st_ino,
	      "descriptor %d of %d is another file", OTHER, pid);
	snprintf(path, sizeof path, "/proc/%d/fd/%d", pid, FIRST + 2 * pairs);
	CHECK(stat(path, &st), "one more descriptor of %d is open", pid);
}

static void heirs_verify(void)
{
	char path[64], text[32] = "";
	FILE *children;

	for (int f = FIRST; f < FIRST + 2 * pairs; f++)
		CHECK(is_open(f) && !is_marked(getpid(), f), "descriptor %d", f);
	CHECK(!is_open(FIRST + 2 * pairs), "one more descriptor is open");
	for (int i = 0; i < heirs; i++)
		expect_heir(heir[i]);
	if (heirs > 1) {
		snprintf(path, sizeof path, "/proc/%d/task/%d/children", heir[1], heir[1]);
		children = fopen(path, "re");
		CHECK(children && fgets(text, sizeof text, children), "no grandchild");
		fclose(children);
		grandchild = atoi(text);
		expect_heir(grandchild);
	}
	expect_text(FIRST + 21, "unread", "a message");
	CHECK(recv(FIRST + 21, scratch, 10, MSG_DONTWAIT) < 0, "another message");
	must(send(FIRST + 20, "unread", 6, 0) == 6, "send");
}

int main(int argc, char **argv)
{
	static struct scenario scenario = { NULL, heirs_setup, heirs_disturb, heirs_verify };

	if (argc < 3 || sscanf(argv[1], "%d/%d", &heirs, &pairs) != 2 || heirs > HEIRS_MAX) {
		fprintf(stderr, "usage: %s PROCESSES/PAIRS FOLDER\n", argv[0]);
		return 2;
	}
	scenario.name = argv[1];
	play(argc, argv, &scenario, 1);
}
