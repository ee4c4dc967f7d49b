/* SPDX-License-Identifier: Apache-2.0
 *
 * reporter SIGNAL STYLE [--in-thread] [--report-ms N] [--into FILE]: a program with a crash handler
 * that takes N ms (150) for its report and then dies of the signal, in the styles of the field.
 * It crashes whenever counter[0] is raised from outside.  With FILE it writes 100 kB over that file
 * for its report, half of it at once, as Java does.
 *
 * SIGNAL: segv, bus, fpe, ill, abrt, trap, sys.  STYLE:
 *   plain      signal(2): the signal itself is blocked meanwhile (C, Java)
 *   full       on an alternate stack, all signals blocked (Go, Ruby)
 *   open       on an alternate stack of 8 MB, SA_NODEFER and SA_RESETHAND, all others blocked, and
 *              the report is made far down that stack (backward-cpp)
 *   python     on an alternate stack, SA_NODEFER, no other blocked, and the first thing that it
 *              does is to put the default back (faulthandler)
 *   sysv       SA_RESETHAND and SA_NODEFER, nothing blocked (signal(2) of System V), and a report
 *              that takes 1 MB of the ordinary stack (Redis)
 *   breakpad   on an alternate stack; a child traces the process and makes the report
 *   exit       as plain; it tears down and ends with status 1
 *   leave      on an alternate stack, which it leaves for good; then it makes its report and ends
 *              with status 2 (a Go panic)
 *
 * mend: no crashes at all; a fault every millisecond is seen to by the handler, in all
 * threads, one of which blocks all signals, as virtual machines and garbage collectors do.
 *
 * counter[1]: crashes; counter[2]: reports begun
 */
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <setjmp.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>

#include "victim.h"

#define STACK_BYTES (8 << 20)
#define REPORT_BYTES 100000

static const struct {
	const char *name;
	int signal;
} signals[] = { { "segv", SIGSEGV }, { "bus", SIGBUS },   { "fpe", SIGFPE }, { "ill", SIGILL },
		{ "abrt", SIGABRT }, { "trap", SIGTRAP }, { "sys", SIGSYS } };

static const char *style;
static long report_ms = 150;
static const char *report_file;
static uint8_t *page;  /* that cannot be touched */
static sigjmp_buf out; /* of the handler */

static bool is(const char *name)
{
	return !strcmp(style, name);
}

static void sleep_ms(long ms)
{
	const struct timespec pause = { ms / 1000, ms % 1000 * 1000000 };

	nanosleep(&pause, NULL);
}

static __attribute__((noinline)) void report(int depth)
{
	volatile uint8_t room[4096];

	room[0] = room[sizeof room - 1] = (uint8_t)depth;
	if (depth)
		report(depth - 1);
	else
		sleep_ms(report_ms);
	room[1] = room[0];
}

static void report_to_file(void)
{
	static const char text[REPORT_BYTES];
	const int fd = open(report_file, O_RDWR | O_CREAT | O_CLOEXEC, 0600);

	must(write(fd, text, REPORT_BYTES / 2) == REPORT_BYTES / 2, report_file);
	report(3);
	must(write(fd, text, REPORT_BYTES / 2) == REPORT_BYTES / 2, report_file);
	close(fd);
}

static void have_it_reported(void)
{
	const pid_t parent = getpid(), child = fork();
	int status;

	if (child == 0) {
		if (ptrace(PTRACE_ATTACH, parent, NULL, NULL) == 0)
			waitpid(parent, &status, __WALL);
		sleep_ms(report_ms);
		_exit(0); /* which lets it go */
	}
	waitpid(child, &status, 0);
}

static void on_crash(int signal_number)
{
	const struct sigaction plain = { .sa_handler = SIG_DFL };
	sigset_t set;

	if (is("leave"))
		siglongjmp(out, 1);
	if (is("python"))
		sigaction(signal_number, &plain, NULL);
	board->counter[2]++;
	if (is("breakpad"))
		have_it_reported();
	else if (report_file)
		report_to_file();
	else
		report(is("open") || is("sysv") ? 300 : 3);
	if (is("exit"))
		_exit(1);
	sigaction(signal_number, &plain, NULL);
	sigemptyset(&set);
	sigaddset(&set, signal_number);
	raise(signal_number);
	pthread_sigmask(SIG_UNBLOCK, &set, NULL);
}

static void on_fault(int signal_number)
{
	(void)signal_number;
	board->counter[2]++;
	must(mprotect(page, 4096, PROT_READ | PROT_WRITE) == 0, "mprotect");
}

static void install(int signal_number)
{
	struct sigaction action = { .sa_handler = is("mend") ? on_fault : on_crash };

	if (is("full") || is("open"))
		sigfillset(&action.sa_mask);
	if (is("open"))
		sigdelset(&action.sa_mask, signal_number);
	if (is("open") || is("sysv") || is("python"))
		action.sa_flags |= SA_NODEFER;
	if (is("open") || is("sysv"))
		action.sa_flags |= SA_RESETHAND;
	if (is("full") || is("open") || is("python") || is("breakpad") || is("leave"))
		action.sa_flags |= SA_ONSTACK;
	must(sigaction(signal_number, &action, NULL) == 0, "sigaction");
}

static void own_stack(void)
{
	const stack_t stack = { .ss_sp = malloc(STACK_BYTES), .ss_size = STACK_BYTES };

	must(stack.ss_sp && sigaltstack(&stack, NULL) == 0, "sigaltstack");
}

static void crash(int signal_number)
{
	volatile int zero = 0;

	if (sigsetjmp(out, 1)) {
		board->counter[2]++;
		report(3);
		_exit(2);
	}
	board->counter[1]++;
	switch (signal_number) {
	case SIGSEGV:
		*(volatile uint8_t *)page = 1;
		break;
	case SIGFPE:
		zero = 1000 / zero;
		break;
	case SIGILL:
		__builtin_trap();
	case SIGABRT:
		abort();
	default:
		raise(signal_number);
	}
}

static void wait_to_crash(int signal_number)
{
	for (;;) {
		if (board->counter[0] > board->counter[1])
			crash(signal_number);
		if (is("mend")) {
			*(volatile uint8_t *)page = 1;
			must(mprotect(page, 4096, PROT_NONE) == 0, "mprotect");
		}
		beat();
		nap_us(1000);
	}
}

static int wanted;

static void *be_in_thread(void *unused)
{
	(void)unused;
	own_stack();
	wait_to_crash(wanted);
	return NULL;
}

static void *be_deaf(void *unused)
{
	volatile uint8_t room[65536]; /* of what was there before */
	sigset_t all;

	(void)unused;
	sigfillset(&all);
	pthread_sigmask(SIG_SETMASK, &all, NULL);
	for (room[0] = 0;; room[0]++)
		nap_us(500);
	return NULL;
}

int main(int argc, char **argv)
{
	const bool in_thread = victim_flag(&argc, argv, "--in-thread");
	pthread_t thread;

	victim_start(&argc, argv, 2, "SIGNAL STYLE [--in-thread] [--report-ms N] [--into FILE]");
	for (size_t i = 0; i < sizeof signals / sizeof *signals; i++)
		if (!strcmp(argv[1], signals[i].name))
			wanted = signals[i].signal;
	style = argv[2];
	for (int i = 3; i + 1 < argc; i += 2) {
		if (!strcmp(argv[i], "--report-ms"))
			report_ms = atol(argv[i + 1]);
		if (!strcmp(argv[i], "--into"))
			report_file = argv[i + 1];
	}
	page = mmap(NULL, 4096, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
	must(wanted && page != MAP_FAILED, "SIGNAL");
	prctl(PR_SET_PTRACER, -1L, 0, 0, 0); /* where Yama is in force */
	own_stack();
	install(wanted);
	if (is("mend"))
		must(!pthread_create(&thread, NULL, be_deaf, NULL), "pthread_create");
	if (in_thread)
		must(!pthread_create(&thread, NULL, be_in_thread, NULL), "pthread_create");
	victim_ready();
	if (in_thread)
		for (;;)
			pause();
	wait_to_crash(wanted);
}
