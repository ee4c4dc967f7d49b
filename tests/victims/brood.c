/* SPDX-License-Identifier: Apache-2.0
 *
 * brood [--late-us N]: has children of every kind that clone(2) and clone3(2) know, one after
 * the other, and expects each to end within three seconds, as it wanted to.  A child lives
 * for up to N us (300).
 *
 * counter[0]: children so far; counter[1]: kinds; counter[2]: slowest child, in us
 */
#include <linux/sched.h>
#include <poll.h>
#include <sched.h>

#include "victim.h"

#define STATUS 7
#define STACK_BYTES 65536
#define PATIENCE_MS 3000

static const uint64_t choices[] = { CLONE_PTRACE, CLONE_UNTRACED, CLONE_FILES,
				    CLONE_FS,     CLONE_PARENT,   CLONE_IO };
#define CHOICES (sizeof choices / sizeof *choices)
static const uint64_t memories[] = { 0, CLONE_VFORK, CLONE_VM, CLONE_VM | CLONE_VFORK,
				     CLONE_VM | CLONE_SIGHAND };
#define MEMORIES (sizeof memories / sizeof *memories)
#define KINDS ((1 << CHOICES) * MEMORIES * 2)

static volatile uint64_t *done; /* shared by all: children that have come to their end */
static uint8_t stack[STACK_BYTES] __attribute__((aligned(64)));
static long late_us = 300;

static int be(void *arg)
{
	const struct timespec pause = { .tv_nsec = (long)(uintptr_t)arg * 1000 };

	if (pause.tv_nsec)
		syscall(SYS_nanosleep, &pause, NULL);
	__atomic_add_fetch(done, 1, __ATOMIC_RELEASE);
	syscall(SYS_exit_group, STATUS);
	return 0;
}

static long make(uint64_t flags, bool third, long us, int *pidfd)
{
	long pid;

	if (flags & CLONE_VM)
		return clone(be, stack + sizeof stack, (int)(flags | CLONE_PIDFD | SIGCHLD),
			     (void *)us, pidfd);
	if (third) {
		struct clone_args args = { .flags = flags | CLONE_PIDFD,
					   .pidfd = (uintptr_t)pidfd,
					   /* its exit signal would be its sibling's */
					   .exit_signal = flags & CLONE_PARENT ? 0 : SIGCHLD };

		pid = syscall(SYS_clone3, &args, sizeof args);
	} else {
		pid = syscall(SYS_clone, flags | CLONE_PIDFD | SIGCHLD, NULL, pidfd, NULL, 0);
	}
	if (pid == 0)
		be((void *)us);
	return pid;
}

static void raise_one(uint64_t kind, uint64_t n)
{
	const uint64_t memory = memories[kind % MEMORIES];
	const bool third = kind / MEMORIES % 2;
	const uint64_t before = *done, start = now_ns();
	uint64_t flags = memory;
	struct pollfd ending = { .events = POLLIN };
	int status = 0;
	long pid;

	for (size_t i = 0; i < CHOICES; i++)
		if (kind / MEMORIES / 2 >> i & 1)
			flags |= choices[i];
	pid = make(flags, third, (long)(mix(n, 1) % (uint64_t)(late_us + 1)), &ending.fd);
	CHECK(pid > 0, "clone(%lx): %s", flags, strerror(errno));
	CHECK(poll(&ending, 1, PATIENCE_MS) == 1, "child %ld of clone(%lx)%s has not ended", pid,
	      flags, third ? " (clone3)" : "");
	close(ending.fd);
	if (!(flags & CLONE_PARENT)) {
		CHECK(waitpid((pid_t)pid, &status, __WALL) == pid, "waitpid: %s", strerror(errno));
		CHECK(WIFEXITED(status) && WEXITSTATUS(status) == STATUS,
		      "child of clone(%lx) ended with %x", flags, status);
	}
	CHECK(*done == before + 1, "child of clone(%lx) has not come to its end", flags);
	if ((now_ns() - start) / 1000 > board->counter[2])
		board->counter[2] = (now_ns() - start) / 1000;
}

int main(int argc, char **argv)
{
	victim_start(&argc, argv, 0, "[--late-us N]");
	if (argc == 3 && !strcmp(argv[1], "--late-us"))
		late_us = atol(argv[2]);
	done = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
	must(done != MAP_FAILED, "mmap");
	board->counter[1] = KINDS;
	victim_ready();
	for (uint64_t n = 0;; n++) {
		/* In an order in which each kind has every other one before it. */
		raise_one(n * 7919 % KINDS, n);
		board->counter[0] = n + 1;
		beat();
	}
}
