/* SPDX-License-Identifier: Apache-2.0
 *
 * A system call without libc (aarch64): for injected code, and for the engine's helper
 * that shares another task's thread-local storage and so must leave errno alone.
 */
#ifndef AVCKPT_SYSCALL_H
#define AVCKPT_SYSCALL_H

#include <stdint.h>

/* seccomp(2): <linux/audit.h> */
#define RAW_AUDIT_ARCH AUDIT_ARCH_AARCH64

static inline long raw_syscall(long nr, uint64_t a, uint64_t b, uint64_t c, uint64_t d, uint64_t e,
			       uint64_t f)
{
	register long x8 __asm__("x8") = nr;
	register uint64_t x0 __asm__("x0") = a;
	register uint64_t x1 __asm__("x1") = b;
	register uint64_t x2 __asm__("x2") = c;
	register uint64_t x3 __asm__("x3") = d;
	register uint64_t x4 __asm__("x4") = e;
	register uint64_t x5 __asm__("x5") = f;

	/* The kernel itself changes x8 when it restarts a call. */
	__asm__ volatile("svc #0"
			 : "+r"(x0), "+r"(x8)
			 : "r"(x1), "r"(x2), "r"(x3), "r"(x4), "r"(x5)
			 : "memory", "cc");
	return (long)x0;
}

/* Where the kernel begins a program: the stack is as anywhere. */
#define RAW_ENTRY

static inline void cpu_relax(void)
{
	__asm__ volatile("yield");
}

/* The number of the CPU that runs it, plus one; 0: not known.  Here only a system call tells. */
static inline uint32_t current_cpu(void)
{
	return 0;
}

#endif
