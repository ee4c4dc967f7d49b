/* SPDX-License-Identifier: Apache-2.0
 *
 * A system call without libc (x86-64): for injected code, and for the engine's helper
 * that shares another task's thread-local storage and so must leave errno alone.
 */
#ifndef AVCKPT_SYSCALL_H
#define AVCKPT_SYSCALL_H

#include <stdint.h>

/* seccomp(2): <linux/audit.h> */
#define RAW_AUDIT_ARCH AUDIT_ARCH_X86_64

static inline long raw_syscall(long nr, uint64_t a, uint64_t b, uint64_t c, uint64_t d, uint64_t e,
			       uint64_t f)
{
	long ret;
	register uint64_t r10 __asm__("r10") = d;
	register uint64_t r8 __asm__("r8") = e;
	register uint64_t r9 __asm__("r9") = f;

	__asm__ volatile("syscall"
			 : "=a"(ret)
			 : "a"(nr), "D"(a), "S"(b), "d"(c), "r"(r10), "r"(r8), "r"(r9)
			 : "rcx", "r11", "memory");
	return ret;
}

/* Where the kernel begins a program: the stack is not as after a call. */
#define RAW_ENTRY __attribute__((force_align_arg_pointer))

static inline void cpu_relax(void)
{
	__asm__ volatile("pause");
}

/* The number of the CPU that runs it, plus one; 0: not known.  The kernel keeps it in the limit of a
 * segment that the GDT of each CPU has (GDT_ENTRY_CPUNODE, arch/x86/include/asm/segment.h): no system
 * call, which a filter could refuse. */
static inline uint32_t current_cpu(void)
{
	uint32_t limit;

	__asm__ volatile("lsl %1, %0" : "=r"(limit) : "r"(0x7b) : "cc");
	return (limit & 0xfff) + 1;
}

#endif
