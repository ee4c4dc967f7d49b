/* SPDX-License-Identifier: Apache-2.0
 *
 * A system call as a compiler inlines it: the arguments are in registers, and so is all else
 * that the program holds.  inlined() loads every register with a pattern, makes the call, and
 * compares all that the call may not change: general registers, flags, x87, SSE, AVX and
 * AVX-512, the second base register, the signal mask, the alternate stack.  (x86-64)
 */
#ifndef INLINED_H
#define INLINED_H

#include <asm/prctl.h>
#include <cpuid.h>
#include <pthread.h>
#include <stddef.h>

#include "victim.h"

#define AREA_BYTES 8192
#define AREA_HEADER 512 /* XSTATE_BV */
#define AREA_FIRST 576
/* x87, SSE, AVX, the three of AVX-512; neither protection keys nor tiles. */
#define COMPONENTS 0xe7u
#define FLAGS_KEPT 0xcd5u /* CF PF AF ZF SF DF OF */

enum { RAX, RBX, RCX, RDX, RSI, RDI, RBP, R8, R9, R10, R11, R12, R13, R14, R15, FLAGS, RSP, REGS };

struct inlined {
	uint64_t before[REGS], after[REGS]; /* the assembly below knows where they are */
	void *area_before, *area_after;
	uint64_t components;
};
_Static_assert(offsetof(struct inlined, area_before) == 272, "the assembly below");

void inlined_enter(struct inlined *all);
extern const char inlined_after[];

/* The pointer to the struct is on the stack while the registers are the pattern's; nothing
 * between popfq and pushfq changes flags. */
__asm__(".text\n"
	".globl inlined_enter, inlined_after\n"
	".type inlined_enter, @function\n"
	"inlined_enter:\n"
	"push %rbx\n push %rbp\n push %r12\n push %r13\n push %r14\n push %r15\n push %rdi\n"
	"mov %rsp, 128(%rdi)\n"
	"mov 272(%rdi), %rcx\n mov 288(%rdi), %rax\n xor %edx, %edx\n xrstor64 (%rcx)\n"
	"pushq 120(%rdi)\n popfq\n"
	"mov 0(%rdi), %rax\n mov 8(%rdi), %rbx\n mov 24(%rdi), %rdx\n mov 32(%rdi), %rsi\n"
	"mov 48(%rdi), %rbp\n mov 56(%rdi), %r8\n mov 64(%rdi), %r9\n mov 72(%rdi), %r10\n"
	"mov 88(%rdi), %r12\n mov 96(%rdi), %r13\n mov 104(%rdi), %r14\n mov 112(%rdi), %r15\n"
	"mov 40(%rdi), %rdi\n"
	"syscall\n"
	"inlined_after:\n"
	"push %rdi\n mov 8(%rsp), %rdi\n"
	"mov %rax, 136(%rdi)\n mov %rbx, 144(%rdi)\n mov %rcx, 152(%rdi)\n mov %rdx, 160(%rdi)\n"
	"mov %rsi, 168(%rdi)\n popq 176(%rdi)\n mov %rbp, 184(%rdi)\n mov %r8, 192(%rdi)\n"
	"mov %r9, 200(%rdi)\n mov %r10, 208(%rdi)\n mov %r11, 216(%rdi)\n mov %r12, 224(%rdi)\n"
	"mov %r13, 232(%rdi)\n mov %r14, 240(%rdi)\n mov %r15, 248(%rdi)\n"
	"pushfq\n popq 256(%rdi)\n mov %rsp, 264(%rdi)\n"
	"cld\n"
	"mov 280(%rdi), %rcx\n mov 288(%rdi), %rax\n xor %edx, %edx\n xsave64 (%rcx)\n"
	"fninit\n vzeroupper\n"
	"pop %rdi\n pop %r15\n pop %r14\n pop %r13\n pop %r12\n pop %rbp\n pop %rbx\n"
	"ret\n");

struct inlined_areas {
	uint8_t before[AREA_BYTES], after[AREA_BYTES];
} __attribute__((aligned(64)));

static _Thread_local struct inlined_areas inlined_areas;
static _Thread_local uint64_t inlined_random;
static uint64_t inlined_calls;

static inline uint64_t inlined_next(void)
{
	if (!inlined_random)
		inlined_random = mix((uint64_t)syscall(SYS_gettid), now_ns()) | 1;
	return next_random(&inlined_random);
}

static inline uint64_t inlined_components(void)
{
	unsigned int low, high;

	__asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
	return low & COMPONENTS;
}

static inline bool inlined_component(unsigned int i, unsigned int *offset, unsigned int *bytes)
{
	unsigned int c, d;

	return inlined_components() >> i & 1 && __get_cpuid_count(0xd, i, bytes, offset, &c, &d) &&
	       *offset + *bytes <= AREA_BYTES;
}

/* Any bits will do for all but what controls. */
static inline void inlined_fill(uint8_t *area)
{
	const uint16_t fcw = 0x37f, round[] = { 0x1f80, 0x3f80, 0x5f80, 0x7f80 };
	const uint64_t components = inlined_components();
	uint64_t word;

	for (unsigned int i = 0; i < AREA_BYTES; i += sizeof word) {
		word = inlined_next();
		memcpy(area + i, &word, sizeof word);
	}
	memset(area, 0, 32);
	memcpy(area, &fcw, 2);
	area[4] = 0xff; /* all eight x87 registers hold something */
	memcpy(area + 24, &round[inlined_next() % 4], 2);
	for (int i = 0; i < 8; i++)
		memset(area + 32 + 16 * i + 10, 0, 6);
	memset(area + AREA_HEADER, 0, 64);
	memcpy(area + AREA_HEADER, &components, sizeof components);
}

static inline void inlined_compare(const struct inlined *all, const char *what)
{
	static const char *const name[] = { "rax", "rbx", "rcx", "rdx",   "rsi", "rdi",
					    "rbp", "r8",  "r9",  "r10",   "r11", "r12",
					    "r13", "r14", "r15", "flags", "rsp" };
	const uint8_t *before = all->area_before, *after = all->area_after;
	unsigned int offset, bytes;

	for (int i = 0; i < REGS; i++)
		if (i != RAX)
			CHECK(all->before[i] == all->after[i], "%s: %s was %#lx and is %#lx", what,
			      name[i], (unsigned long)all->before[i], (unsigned long)all->after[i]);
	CHECK(!memcmp(before, after, 28) && !memcmp(before + 32, after + 32, 416 - 32),
	      "%s: x87 or SSE registers are others", what);
	for (unsigned int i = 2; i < 8; i++)
		if (inlined_component(i, &offset, &bytes))
			CHECK(!memcmp(before + offset, after + offset, bytes),
			      "%s: state component %u is another", what, i);
}

/* As syscall(2), for the call named `what`. */
static inline long inlined(const char *what, long nr, uint64_t a, uint64_t b, uint64_t c,
			   uint64_t d, uint64_t e, uint64_t f)
{
	struct inlined all = { .area_before = inlined_areas.before,
			       .area_after = inlined_areas.after,
			       .components = inlined_components() };
	uint64_t *const r = all.before, base = 0, own_base;
	sigset_t mask_before, mask_after;
	stack_t stack_before, stack_after;
	long result;

	for (int i = 0; i < REGS; i++)
		r[i] = inlined_next();
	r[RAX] = (uint64_t)nr;
	r[RDI] = a;
	r[RSI] = b;
	r[RDX] = c;
	r[R10] = d;
	r[R8] = e;
	r[R9] = f;
	r[FLAGS] = (r[FLAGS] & FLAGS_KEPT) | 0x202;
	inlined_fill(inlined_areas.before);
	own_base = inlined_next() >> 18; /* an address */
	syscall(SYS_arch_prctl, ARCH_SET_GS, own_base);
	pthread_sigmask(SIG_SETMASK, NULL, &mask_before);
	sigaltstack(NULL, &stack_before);
	inlined_enter(&all);
	/* What the instruction itself leaves there. */
	r[RCX] = (uint64_t)inlined_after;
	r[R11] = r[FLAGS];
	inlined_compare(&all, what);
	sigaltstack(NULL, &stack_after);
	pthread_sigmask(SIG_SETMASK, NULL, &mask_after);
	syscall(SYS_arch_prctl, ARCH_GET_GS, &base);
	CHECK(base == own_base, "%s: gs was %#lx and is %#lx", what, (unsigned long)own_base,
	      (unsigned long)base);
	CHECK(!memcmp(&mask_before, &mask_after, 8), "%s: another signal mask", what);
	CHECK(stack_before.ss_sp == stack_after.ss_sp &&
		      stack_before.ss_size == stack_after.ss_size &&
		      stack_before.ss_flags == stack_after.ss_flags,
	      "%s: another alternate stack", what);
	__atomic_add_fetch(&inlined_calls, 1, __ATOMIC_RELAXED);
	result = (long)all.after[RAX];
	if (result < 0 && result > -4096) {
		errno = (int)-result;
		return -1;
	}
	return result;
}

#endif
