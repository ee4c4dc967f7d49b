/* SPDX-License-Identifier: Apache-2.0
 *
 * steady: a main thread that is not to notice anything, whoever borrows it and dies.  A signal
 * comes every millisecond; its handler has to run on the program's own stack (now and
 * then: on its alternate one), and takes more of that than a borrower could have.  Between
 * two calls, and over each of them, registers, mask and stacks are the same (inlined.h).
 * The handler of SIGUSR2 takes half a second.
 */
#include <sys/epoll.h>
#include <sys/time.h>

#include "inlined.h"

#define STACK_BYTES (256 * 1024)
#define USED_BYTES (48 * 1024)
#define DWELL_NS 500000000

static uintptr_t own_low, own_high;
static uint8_t other[STACK_BYTES];
static volatile bool is_on_other;

static void handle(int signal)
{
	volatile uint8_t used[USED_BYTES];
	const uintptr_t at = (uintptr_t)used;
	const bool on_other = at - (uintptr_t)other < sizeof other;

	(void)signal;
	CHECK(on_other || (at >= own_low && at < own_high), "a handler runs at %#lx", at);
	CHECK(on_other == is_on_other, "a handler runs on the %s stack",
	      on_other ? "alternate" : "ordinary");
	for (unsigned int i = 0; i < USED_BYTES; i += 512)
		used[i] = 1;
	count(1, 1);
}

static void set_handler(bool on_other)
{
	const struct sigaction action = { .sa_handler = handle,
					  .sa_flags = on_other ? SA_ONSTACK : 0 };
	sigset_t alarm, before;

	sigemptyset(&alarm);
	sigaddset(&alarm, SIGALRM);
	sigprocmask(SIG_BLOCK, &alarm, &before);
	is_on_other = on_other;
	must(!sigaction(SIGALRM, &action, NULL), "sigaction");
	sigprocmask(SIG_SETMASK, &before, NULL);
}

static void dwell(int signal)
{
	const uint64_t end = now_ns() + DWELL_NS;

	(void)signal;
	while (now_ns() < end)
		usleep(1000);
	count(2, 1);
}

int main(int argc, char **argv)
{
	const struct itimerval often = { { 0, 1000 }, { 0, 1000 } };
	const stack_t alternate = { .ss_sp = other, .ss_size = sizeof other };
	struct sigaction slow = { .sa_handler = dwell };
	const int epoll_fd = epoll_create1(EPOLL_CLOEXEC);
	struct timespec ts = { 0, 3000000 };
	sigset_t mask_at_first, mask;
	struct epoll_event event;

	victim_start(&argc, argv, 0, "");
	own_high = (uintptr_t)__builtin_frame_address(0);
	own_low = own_high - (1 << 20);
	must(!sigaltstack(&alternate, NULL), "sigaltstack");
	sigfillset(&slow.sa_mask);
	must(!sigaction(SIGUSR2, &slow, NULL), "sigaction");
	set_handler(false);
	must(!setitimer(ITIMER_REAL, &often, NULL), "setitimer");
	sigprocmask(SIG_SETMASK, NULL, &mask_at_first);
	victim_ready();
	for (unsigned int i = 0;; i++) {
		const long slept = inlined("nanosleep", SYS_nanosleep, (uint64_t)&ts, 0, 3, 4, 5,
					   6);
		const int slept_errno = errno;
		const long waited = inlined("epoll_pwait", SYS_epoll_pwait, (uint64_t)epoll_fd,
					    (uint64_t)&event, 1, 3, 0, 8);

		CHECK(slept == 0 || slept_errno == EINTR, "nanosleep: %s", strerror(slept_errno));
		CHECK(waited == 0 || errno == EINTR, "epoll_pwait: %s", strerror(errno));
		for (volatile int k = 0; k < 100000; k++)
			;
		sigprocmask(SIG_SETMASK, NULL, &mask);
		CHECK(!memcmp(&mask, &mask_at_first, 8), "it has another signal mask");
		beat();
		if (i % 64 == 0)
			set_handler(i % 128 == 0);
	}
}
