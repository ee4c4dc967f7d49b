/* SPDX-License-Identifier: Apache-2.0
 *
 * places KIND: where processes stand, in sessions, in groups and in what their parents know of
 * them.  The victim says all the time what it finds, and nothing may ever be other than it was.
 *
 *   ended      children of which nobody has taken the end, of every kind; some lead a session or
 *              a group, or are in one of those
 *   leader     the main process leads a session
 *   terminal   likewise, and has a terminal with it
 *   front      likewise, and a child of it is in the foreground
 *   stayed     children that were there before their parent began a session
 *   orphans    the children of a session's leader that is gone
 *   adopted    likewise, of the main process, which adopts orphans; some have ended
 *   unwaited   the same where the leader was not waited for
 *   groups     processes in groups whose leaders are gone, in several sessions
 */
#include <signal.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <termios.h>

#include "victim.h"

#define KIDS 80

/* Of all processes; each says who its parent is. */
static struct shared {
	volatile pid_t parent[KIDS], pid[KIDS];
	volatile uint64_t laps[KIDS];
} * shared;

static struct {
	pid_t pid;
	bool ended;
} kid[KIDS];
static int kids, terminal = -1;
static pid_t others[KIDS]; /* that are no children                                    */
static char was[8192], is[8192];

static _Noreturn void rest(int slot)
{
	for (;; nap_us(1000)) {
		shared->parent[slot] = getppid();
		shared->laps[slot]++;
	}
}

/* In the child 0, in its own place among those that tell. */
static pid_t begin(int slot)
{
	const pid_t pid = fork();

	must(pid >= 0, "fork");
	if (!pid)
		shared->pid[slot] = getpid();
	return pid;
}

static void wait_told(int slot)
{
	for (int i = 0; i < 5000 && !shared->laps[slot]; i++)
		nap_us(1000);
	must(shared->laps[slot], "it tells");
}

/* What those that are left tell is of now: the parent of some has ended since they told last. */
static void wait_laps(void)
{
	for (int i = 0; i < KIDS; i++) {
		const uint64_t before = shared->pid[i] ? shared->laps[i] : 0;

		while (before && shared->laps[i] < before + 2)
			nap_us(1000);
	}
}

static void wait_ended(pid_t pid)
{
	siginfo_t info;

	must(!waitid(P_PID, (id_t)pid, &info, WEXITED | WNOWAIT), "waitid");
}

static void keep(pid_t pid, bool ended)
{
	kid[kids].pid = pid;
	kid[kids++].ended = ended;
}

/* ---- ended -------------------------------------------------------------------------------- */

static _Noreturn void end(int status, int signum)
{
	const struct rlimit none = { 0, 0 };
	sigset_t all;

	if (!signum)
		_exit(status);
	setrlimit(RLIMIT_CORE, &none);
	sigfillset(&all);
	signal(signum, SIG_DFL);
	sigprocmask(SIG_UNBLOCK, &all, NULL);
	kill(getpid(), signum);
	_exit(99);
}

static void make_ended(int status, int signum)
{
	const pid_t pid = fork();

	must(pid >= 0, "fork");
	if (!pid)
		end(status, signum);
	wait_ended(pid);
	keep(pid, true);
}

static void setup_ended(void)
{
	static const int signals[] = { SIGHUP,  SIGINT,  SIGQUIT, SIGILL,  SIGTRAP,  SIGABRT,
				       SIGBUS,  SIGFPE,  SIGKILL, SIGUSR1, SIGSEGV,  SIGUSR2,
				       SIGPIPE, SIGALRM, SIGTERM, SIGXCPU, SIGXFSZ,  SIGVTALRM,
				       SIGPROF, SIGIO,   SIGPWR,  SIGSYS,  SIGSTKFLT };
	pid_t leader;

	for (size_t i = 0; i < sizeof signals / sizeof *signals; i++)
		make_ended(0, signals[i]);
	make_ended(0, SIGRTMIN);
	make_ended(0, SIGRTMAX);
	make_ended(0, 0);
	make_ended(255, 0);
	leader = begin(0);
	if (!leader) {
		pid_t second;

		setsid();
		second = fork();
		if (!second) {
			pause();
			_exit(0);
		}
		kill(second, SIGKILL);
		wait_ended(second);
		shared->pid[1] = second;
		rest(0);
	}
	wait_told(0);
	keep(leader, false);
	others[0] = shared->pid[1];
	for (int i = 0; i < 2; i++) { /* they lead a group, or a session */
		leader = fork();
		if (!leader) {
			must(i ? setsid() > 0 : !setpgid(0, 0), "setsid");
			pause();
		}
		while (getpgid(leader) != leader)
			nap_us(1000);
		kill(leader, SIGKILL);
		wait_ended(leader);
		keep(leader, true);
	}
}

/* ---- leader, terminal, front --------------------------------------------------------------- */

static void setup_leader(void)
{
	const pid_t other = fork();

	/* Nobody who leads a group may begin a session (setsid(2)). */
	if (!other)
		for (;;)
			pause();
	must(!setpgid(other, other) && !setpgid(0, other), "setpgid");
	must(setsid() == getpid(), "setsid");
	kill(other, SIGKILL);
	must(waitpid(other, NULL, 0) == other, "waitpid");
}

static void setup_terminal(void)
{
	const int other = posix_openpt(O_RDWR | O_NOCTTY);

	setup_leader();
	must(other >= 0 && !grantpt(other) && !unlockpt(other), "posix_openpt");
	terminal = open(ptsname(other), O_RDWR);
	must(terminal >= 0, "open");
	must(!ioctl(terminal, TIOCSCTTY, 0) && tcgetsid(terminal) == getpid(), "TIOCSCTTY");
	signal(SIGHUP, SIG_IGN);
}

static void setup_front(void)
{
	pid_t pid;

	setup_terminal();
	signal(SIGTTOU, SIG_IGN);
	pid = begin(0);
	if (!pid) {
		setpgid(0, 0);
		rest(0);
	}
	wait_told(0);
	keep(pid, false);
	must(!tcsetpgrp(terminal, pid), "tcsetpgrp");
}

/* ---- stayed --------------------------------------------------------------------------------- */

static void setup_stayed(void)
{
	const pid_t pid = begin(0);

	if (!pid) {
		if (!begin(1)) {
			if (!begin(2))
				rest(2);
			wait_told(2);
			setsid();
			rest(1);
		}
		if (!begin(3)) {
			setpgid(0, 0);
			rest(3);
		}
		wait_told(1);
		wait_told(3);
		setsid();
		if (!begin(4))
			rest(4);
		wait_told(4);
		rest(0);
	}
	wait_told(0);
	keep(pid, false);
	for (int i = 1; i < 5; i++)
		others[i] = shared->pid[i];
}

/* ---- orphans, adopted ----------------------------------------------------------------------- */

/* Leads a session, has had these children, and goes. */
static void make_orphans(int first, bool also_ended)
{
	const pid_t pid = fork();

	must(pid >= 0, "fork");
	if (!pid) {
		setsid();
		if (!begin(first))
			rest(first);
		if (!begin(first + 1)) {
			setpgid(0, 0);
			if (!begin(first + 2))
				rest(first + 2);
			wait_told(first + 2);
			rest(first + 1);
		}
		wait_told(first);
		wait_told(first + 1);
		if (also_ended) {
			const pid_t ended = fork();

			if (!ended)
				_exit(7);
			wait_ended(ended);
			shared->pid[first + 3] = ended;
		}
		_exit(0);
	}
	must(waitpid(pid, NULL, 0) == pid, "waitpid");
	for (int i = first; i < first + 3; i++)
		others[i] = shared->pid[i];
}

static void setup_orphans(void)
{
	make_orphans(0, false);
	make_orphans(4, false);
}

/* Their session's leader has ended, and nobody has waited for it. */
static void setup_unwaited(void)
{
	const pid_t pid = fork();

	must(pid >= 0, "fork");
	if (!pid) {
		setsid();
		if (!begin(0))
			rest(0);
		wait_told(0);
		_exit(7);
	}
	wait_ended(pid);
	keep(pid, true);
	others[0] = shared->pid[0];
}

static void setup_adopted(void)
{
	must(!prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0), "PR_SET_CHILD_SUBREAPER");
	make_orphans(0, true);
	for (int i = 0; i < 2; i++)
		keep(shared->pid[i], false);
	keep(shared->pid[3], true);
}

/* ---- groups ---------------------------------------------------------------------------------- */

static void lose_leader(int first)
{
	const pid_t leader = fork();

	if (!leader)
		rest(first + 2);
	must(!setpgid(leader, leader), "setpgid");
	for (int i = first; i < first + 2; i++) {
		const pid_t pid = begin(i);

		if (!pid)
			rest(i);
		must(!setpgid(pid, leader), "setpgid");
		wait_told(i);
		if (!first)
			keep(pid, false);
	}
	kill(leader, SIGKILL);
	must(waitpid(leader, NULL, 0) == leader, "waitpid");
}

static void setup_groups(void)
{
	pid_t pid;

	lose_leader(0);
	pid = begin(3);
	if (!pid) {
		setsid();
		lose_leader(4);
		rest(3);
	}
	wait_told(3);
	keep(pid, false);
	others[4] = shared->pid[4];
	others[5] = shared->pid[5];
}

/* ---- what there is to see ---------------------------------------------------------------------- */

__attribute__((format(printf, 1, 2))) static void say(const char *format, ...)
{
	const size_t length = strlen(is);
	va_list args;

	va_start(args, format);
	vsnprintf(is + length, sizeof is - length, format, args);
	va_end(args);
}

static void look(void)
{
	is[0] = 0;
	say("I: session %d, group %d", getsid(0), getpgrp());
	if (terminal >= 0)
		say(", terminal of %d, in front %d", tcgetsid(terminal), tcgetpgrp(terminal));
	for (int i = 0; i < kids; i++) {
		siginfo_t info = { 0 };
		const int ended = waitid(P_PID, (id_t)kid[i].pid, &info,
					 WEXITED | WNOWAIT | WNOHANG);

		say("; child %d: session %d, group %d, wait %d %d %d", kid[i].pid,
		    getsid(kid[i].pid), getpgid(kid[i].pid), ended, info.si_code, info.si_status);
		CHECK(kid[i].ended == (info.si_pid != 0), "child %d: ended %d, code %d, status %d",
		      kid[i].pid, kid[i].ended, info.si_code, info.si_status);
	}
	for (int i = 0; i < KIDS; i++)
		if (others[i])
			say("; process %d: session %d, group %d", others[i], getsid(others[i]),
			    getpgid(others[i]));
	for (int i = 0; i < KIDS; i++)
		if (shared->laps[i])
			say("; %d is a child of %d", i, shared->parent[i]);
}

static const struct {
	const char *name;
	void (*setup)(void);
} kinds[] = {
	{ "ended", setup_ended },     { "leader", setup_leader }, { "terminal", setup_terminal },
	{ "front", setup_front },     { "stayed", setup_stayed }, { "orphans", setup_orphans },
	{ "adopted", setup_adopted }, { "groups", setup_groups }, { "unwaited", setup_unwaited },
};

int main(int argc, char **argv)
{
	void (*setup)(void) = NULL;

	victim_start(&argc, argv, 1, "KIND");
	for (size_t i = 0; i < sizeof kinds / sizeof *kinds; i++)
		if (!strcmp(argv[1], kinds[i].name))
			setup = kinds[i].setup;
	must(setup != NULL, "no such kind");
	shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1,
		      0);
	must(shared != MAP_FAILED, "mmap");
	setup();
	wait_laps();
	look();
	strcpy(was, is);
	victim_ready();
	for (;; nap_us(1000)) {
		look();
		CHECK(!strcmp(is, was), "it was \"%s\", now it is \"%s\"", was, is);
		beat();
	}
}
