/* SPDX-License-Identifier: Apache-2.0
 *
 * The context a borrowed thread goes back to by itself (aarch64). No jump preserves all registers,
 * so it goes back by rt_sigreturn(2), from a signal frame.
 */
#ifndef AVCKPT_HOME_H
#define AVCKPT_HOME_H

#define HOME_FPSIMD 592 /* struct fpsimd_context in it; parasite.S fills in the registers */
#define HOME_SVE 1120   /* what follows that                                               */
#define HOME_SVE_VL 1128
#define HOME_ARRIVED 1152 /* struct inj_control */

/* No call goes on here (ARCH_FORGETS_CALLS). */
#define INJ_CUT_OFFSET 8192
#define INJ_CUT_PLACES 1
#define INJ_CUT_BYTES 8

#ifndef __ASSEMBLER__
#include <stddef.h>
#include <stdint.h>

/* struct rt_sigframe (arch/arm64/kernel/signal.c), without most of the room at its end. */
struct inj_home {
	uint8_t siginfo[128];
	uint64_t uc_flags, uc_link;
	uint64_t altstack[3]; /* stack_t: sp, flags, size */
	uint64_t sigmask;
	uint64_t unused[16];
	uint64_t fault_address;
	uint64_t regs[31];
	uint64_t sp, pc, pstate;
	uint64_t padding;
	uint32_t fp_magic, fp_bytes, fpsr, fpcr;
	uint8_t vregs[32][16];
	uint64_t end[2]; /* a record of no bytes: the last */
} __attribute__((aligned(16)));
_Static_assert(offsetof(struct inj_home, fault_address) == 128 + 176, "linux/ucontext.h");
_Static_assert(offsetof(struct inj_home, fp_magic) == HOME_FPSIMD, "parasite.S");
_Static_assert(offsetof(struct inj_home, end) == HOME_SVE, "parasite.S");
#endif

#endif
