/* SPDX-License-Identifier: Apache-2.0
 *
 * inlined.h, aarch64: general registers, flags, the vector registers' 128 bits (no call keeps more
 * of them) and what controls them.
 */
#ifndef INLINED_AARCH64_H
#define INLINED_AARCH64_H

#define NZCV_KEPT UINT64_C(0xf0000000)
#define FPCR_KEPT UINT64_C(0x03c00000) /* rounding, FZ, DN                                  */
#define FPSR_KEPT UINT64_C(0x0800009f) /* what has happened, and saturated                  */

enum { X0, X8 = 8, SP = 31, NZCV, FPCR, FPSR, REGS = 36 };

struct inlined {
	uint64_t before[REGS], after[REGS]; /* the assembly below knows where they are */
	uint64_t vectors_before[64], vectors_after[64];
};
_Static_assert(offsetof(struct inlined, after) == 288, "the assembly below");
_Static_assert(offsetof(struct inlined, vectors_before) == 576, "the assembly below");
_Static_assert(offsetof(struct inlined, vectors_after) == 1088, "the assembly below");

void inlined_enter(struct inlined *all);
extern const char inlined_after[];

/* The pointer to the struct is on the stack while the registers are the pattern's. */
__asm__(".text\n"
	".globl inlined_enter, inlined_after\n"
	".type inlined_enter, @function\n"
	"inlined_enter:\n"
	"stp x29, x30, [sp, #-176]!\n stp x19, x20, [sp, #16]\n stp x21, x22, [sp, #32]\n"
	"stp x23, x24, [sp, #48]\n stp x25, x26, [sp, #64]\n stp x27, x28, [sp, #80]\n"
	"stp d8, d9, [sp, #96]\n stp d10, d11, [sp, #112]\n stp d12, d13, [sp, #128]\n"
	"stp d14, d15, [sp, #144]\n str x0, [sp, #160]\n mov x1, sp\n"
	"str x1, [x0, #248]\n"
	"ldp x1, x2, [x0, #264]\n msr fpcr, x1\n msr fpsr, x2\n"
	"add x1, x0, #576\n ldp q0, q1, [x1, #0]\n ldp q2, q3, [x1, #32]\n"
	"ldp q4, q5, [x1, #64]\n ldp q6, q7, [x1, #96]\n ldp q8, q9, [x1, #128]\n"
	"ldp q10, q11, [x1, #160]\n ldp q12, q13, [x1, #192]\n ldp q14, q15, [x1, #224]\n"
	"ldp q16, q17, [x1, #256]\n ldp q18, q19, [x1, #288]\n ldp q20, q21, [x1, #320]\n"
	"ldp q22, q23, [x1, #352]\n ldp q24, q25, [x1, #384]\n ldp q26, q27, [x1, #416]\n"
	"ldp q28, q29, [x1, #448]\n ldp q30, q31, [x1, #480]\n ldr x1, [x0, #256]\n"
	"msr nzcv, x1\n"
	"ldp x2, x3, [x0, #16]\n ldp x4, x5, [x0, #32]\n ldp x6, x7, [x0, #48]\n"
	"ldp x8, x9, [x0, #64]\n ldp x10, x11, [x0, #80]\n ldp x12, x13, [x0, #96]\n"
	"ldp x14, x15, [x0, #112]\n ldp x16, x17, [x0, #128]\n ldp x18, x19, [x0, #144]\n"
	"ldp x20, x21, [x0, #160]\n ldp x22, x23, [x0, #176]\n ldp x24, x25, [x0, #192]\n"
	"ldp x26, x27, [x0, #208]\n ldp x28, x29, [x0, #224]\n ldr x30, [x0, #240]\n"
	"ldp x0, x1, [x0]\n"
	"svc #0\n"
	"inlined_after:\n"
	"stp x0, x1, [sp, #-16]!\n ldr x0, [sp, #176]\n add x0, x0, #288\n"
	"stp x2, x3, [x0, #16]\n stp x4, x5, [x0, #32]\n stp x6, x7, [x0, #48]\n"
	"stp x8, x9, [x0, #64]\n stp x10, x11, [x0, #80]\n stp x12, x13, [x0, #96]\n"
	"stp x14, x15, [x0, #112]\n stp x16, x17, [x0, #128]\n stp x18, x19, [x0, #144]\n"
	"stp x20, x21, [x0, #160]\n stp x22, x23, [x0, #176]\n stp x24, x25, [x0, #192]\n"
	"stp x26, x27, [x0, #208]\n stp x28, x29, [x0, #224]\n str x30, [x0, #240]\n"
	"ldp x2, x3, [sp], #16\n stp x2, x3, [x0]\n mov x1, sp\n"
	"mrs x2, nzcv\n stp x1, x2, [x0, #248]\n mrs x1, fpcr\n"
	"mrs x2, fpsr\n stp x1, x2, [x0, #264]\n msr fpcr, xzr\n"
	"add x0, x0, #800\n stp q0, q1, [x0, #0]\n stp q2, q3, [x0, #32]\n"
	"stp q4, q5, [x0, #64]\n stp q6, q7, [x0, #96]\n stp q8, q9, [x0, #128]\n"
	"stp q10, q11, [x0, #160]\n stp q12, q13, [x0, #192]\n stp q14, q15, [x0, #224]\n"
	"stp q16, q17, [x0, #256]\n stp q18, q19, [x0, #288]\n stp q20, q21, [x0, #320]\n"
	"stp q22, q23, [x0, #352]\n stp q24, q25, [x0, #384]\n stp q26, q27, [x0, #416]\n"
	"stp q28, q29, [x0, #448]\n stp q30, q31, [x0, #480]\n"
	"ldp x19, x20, [sp, #16]\n ldp x21, x22, [sp, #32]\n ldp x23, x24, [sp, #48]\n"
	"ldp x25, x26, [sp, #64]\n ldp x27, x28, [sp, #80]\n ldp d8, d9, [sp, #96]\n"
	"ldp d10, d11, [sp, #112]\n ldp d12, d13, [sp, #128]\n ldp d14, d15, [sp, #144]\n"
	"ldp x29, x30, [sp], #176\n ret\n");

static inline void inlined_fill(struct inlined *all, long nr, const uint64_t arg[6])
{
	for (int i = 0; i < REGS; i++)
		all->before[i] = inlined_next();
	for (int i = 0; i < 64; i++)
		all->vectors_before[i] = inlined_next();
	memcpy(&all->before[X0], arg, 6 * sizeof *arg);
	all->before[X8] = (uint64_t)nr;
	all->before[NZCV] &= NZCV_KEPT;
	all->before[FPCR] &= FPCR_KEPT;
	all->before[FPSR] &= FPSR_KEPT;
}

static inline void inlined_compare(struct inlined *all, const char *what)
{
	/* The kernel's own, too: it calls restart_syscall(2) by it, and looks at its lower half. */
	const uint32_t nr = (uint32_t)all->after[X8];

	CHECK(nr == all->before[X8] || nr == SYS_restart_syscall, "%s: x8 was %#lx and is %#lx",
	      what, (unsigned long)all->before[X8], (unsigned long)all->after[X8]);
	for (int i = 1; i <= FPSR; i++)
		if (i != X8)
			CHECK(all->before[i] == all->after[i], "%s: %s %d was %#lx and is %#lx",
			      what, i < SP ? "x" : "sp, nzcv, fpcr, fpsr from 31 on:", i,
			      (unsigned long)all->before[i], (unsigned long)all->after[i]);
	CHECK(!memcmp(all->vectors_before, all->vectors_after, sizeof all->vectors_before),
	      "%s: vector registers are others", what);
}

static inline long inlined_result(const struct inlined *all)
{
	return (long)all->after[X0];
}

/* As a signal handler finds them. */
#define INLINED_SP(context) ((uintptr_t)(context)->uc_mcontext.sp)
#define INLINED_PC(context) ((uintptr_t)(context)->uc_mcontext.pc)
#define INLINED_RESULT(context) ((long)(context)->uc_mcontext.regs[0])

#endif
