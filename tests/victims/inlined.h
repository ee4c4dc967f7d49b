/* SPDX-License-Identifier: Apache-2.0
 *
 * A system call as a compiler inlines it: the arguments are in registers, and so is all else
 * that the program holds.  inlined() loads every register with a pattern, makes the call, and
 * compares all that the call may not change: the registers (inlined_x86_64.h, inlined_aarch64.h),
 * the signal mask, the alternate stack.
 */
#ifndef INLINED_H
#define INLINED_H

#include <pthread.h>
#include <stddef.h>

#include "victim.h"

static _Thread_local uint64_t inlined_random;
static uint64_t inlined_calls;

static inline uint64_t inlined_next(void)
{
	if (!inlined_random)
		inlined_random = mix((uint64_t)syscall(SYS_gettid), now_ns()) | 1;
	return next_random(&inlined_random);
}

#ifdef __x86_64__
#include "inlined_x86_64.h"
#else
#include "inlined_aarch64.h"
#endif

/* As syscall(2), for the call named `what`. */
static inline long inlined(const char *what, long nr, uint64_t a, uint64_t b, uint64_t c,
			   uint64_t d, uint64_t e, uint64_t f)
{
	const uint64_t arg[6] = { a, b, c, d, e, f };
	struct inlined all;
	sigset_t mask_before, mask_after;
	stack_t stack_before, stack_after;
	long result;

	inlined_fill(&all, nr, arg);
	pthread_sigmask(SIG_SETMASK, NULL, &mask_before);
	sigaltstack(NULL, &stack_before);
	inlined_enter(&all);
	inlined_compare(&all, what);
	sigaltstack(NULL, &stack_after);
	pthread_sigmask(SIG_SETMASK, NULL, &mask_after);
	CHECK(!memcmp(&mask_before, &mask_after, 8), "%s: another signal mask", what);
	CHECK(stack_before.ss_sp == stack_after.ss_sp &&
		      stack_before.ss_size == stack_after.ss_size &&
		      stack_before.ss_flags == stack_after.ss_flags,
	      "%s: another alternate stack", what);
	__atomic_add_fetch(&inlined_calls, 1, __ATOMIC_RELAXED);
	result = inlined_result(&all);
	if (result < 0 && result > -4096) {
		errno = (int)-result;
		return -1;
	}
	return result;
}

#endif
