/* SPDX-License-Identifier: Apache-2.0
 *
 * inlined.h, x86-64: general registers, flags, x87, SSE, AVX and AVX-512, the second base register.
 */
#ifndef INLINED_X86_64_H
#define INLINED_X86_64_H

#include <asm/prctl.h>
#include <cpuid.h>

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
	uint64_t base;
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
static inline void inlined_fill_area(uint8_t *area)
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

static inline void inlined_fill(struct inlined *all, long nr, const uint64_t arg[6])
{
	uint64_t *const r = all->before;

	for (int i = 0; i < REGS; i++)
		r[i] = inlined_next();
	r[RAX] = (uint64_t)nr;
	r[RDI] = arg[0];
	r[RSI] = arg[1];
	r[RDX] = arg[2];
	r[R10] = arg[3];
	r[R8] = arg[4];
	r[R9] = arg[5];
	r[FLAGS] = (r[FLAGS] & FLAGS_KEPT) | 0x202;
	all->area_before = inlined_areas.before;
	all->area_after = inlined_areas.after;
	all->components = inlined_components();
	inlined_fill_area(inlined_areas.before);
	all->base = inlined_next() >> 18; /* an address */
	syscall(SYS_arch_prctl, ARCH_SET_GS, all->base);
}

static inline void inlined_compare(struct inlined *all, const char *what)
{
	static const char *const name[] = { "rax", "rbx", "rcx", "rdx",   "rsi", "rdi",
					    "rbp", "r8",  "r9",  "r10",   "r11", "r12",
					    "r13", "r14", "r15", "flags", "rsp" };
	const uint8_t *before = all->area_before, *after = all->area_after;
	unsigned int offset, bytes;
	uint64_t base = 0;

	/* What the instruction itself leaves there. */
	all->before[RCX] = (uint64_t)inlined_after;
	all->before[R11] = all->before[FLAGS];
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
	syscall(SYS_arch_prctl, ARCH_GET_GS, &base);
	CHECK(base == all->base, "%s: gs was %#lx and is %#lx", what, (unsigned long)all->base,
	      (unsigned long)base);
}

static inline long inlined_result(const struct inlined *all)
{
	return (long)all->after[RAX];
}

/* As a signal handler finds them. */
#define INLINED_SP(context) ((uintptr_t)(context)->uc_mcontext.gregs[REG_RSP])
#define INLINED_PC(context) ((uintptr_t)(context)->uc_mcontext.gregs[REG_RIP])
#define INLINED_RESULT(context) ((long)(context)->uc_mcontext.gregs[REG_RAX])

#endif
