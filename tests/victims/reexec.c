/* SPDX-License-Identifier: Apache-2.0
 *
 * reexec MS [THREADS] [--slow]: executes itself again every MS milliseconds, and beats in between.
 * With THREADS others, which sleep until then, a thread other than the main one does it.  --slow:
 * with so many empty arguments that the kernel needs 0.1 s or more before anything of the program
 * is replaced, and looks at no signal but SIGKILL.
 */
#include <pthread.h>
#include <sys/resource.h>

#include "victim.h"

#define EMPTY 600000
#define STACK_BYTES (64 << 20) /* a quarter of which arguments may take, but 6 MB at most */

static char **again;
static uint64_t end;

__attribute__((noreturn)) static void *wait_for_exec(void *arg)
{
	(void)arg;
	for (;;)
		pause();
}

static void *work(void *arg)
{
	(void)arg;
	while (now_ns() < end) {
		beat();
		nap_us(500);
	}
	count(0, 1);
	execv("/proc/self/exe", again);
	must(false, "execv");
	return NULL;
}

static void have_arguments(int argc, char **argv)
{
	struct rlimit stack;
	bool slow = false;
	int count = 0;

	again = calloc((size_t)argc + EMPTY + 1, sizeof *again);
	must(again != NULL, "calloc");
	for (int i = 0; i < argc; i++) {
		slow |= !strcmp(argv[i], "--slow");
		if (strcmp(argv[i], "--in-child")) /* it is one then */
			again[count++] = argv[i];
	}
	for (int i = 0; slow && i < EMPTY; i++)
		again[count++] = "";
	if (!slow)
		return;
	must(!getrlimit(RLIMIT_STACK, &stack), "getrlimit");
	stack.rlim_cur = STACK_BYTES;
	must(!setrlimit(RLIMIT_STACK, &stack), "setrlimit");
}

int main(int argc, char **argv)
{
	long threads;
	pthread_t thread;

	while (argc > 1 && !*argv[argc - 1])
		argv[--argc] = NULL;
	have_arguments(argc, argv);
	(void)victim_flag(&argc, argv, "--slow");
	victim_start(&argc, argv, 1, "MS [THREADS] [--slow]");
	board->starts = 1;
	victim_ready();
	end = now_ns() + (uint64_t)atol(argv[1]) * 1000000;
	threads = argc > 2 ? atol(argv[2]) : 0;
	if (!threads)
		work(NULL);
	for (long i = 0; i < threads; i++)
		must(!pthread_create(&thread, NULL, wait_for_exec, NULL), "pthread_create");
	must(!pthread_create(&thread, NULL, work, NULL), "pthread_create");
	wait_for_exec(NULL);
}
