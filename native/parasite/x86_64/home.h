/* SPDX-License-Identifier: Apache-2.0
 *
 * The context a borrowed thread goes back to by itself (x86-64).  Offsets are
 * used by parasite.S.
 */
#ifndef AVCKPT_HOME_H
#define AVCKPT_HOME_H

#define HOME_SIGMASK 128
#define HOME_FLAGS 136
#define HOME_DIRECTION 140
#define HOME_RIP 144
#define HOME_ARRIVED 168 /* struct inj_control */
#define HOME_CUT 176     /* likewise */

/* Where calls go on that were cut short (inj_cut()), in every version of the code: a guard has to
 * recognize those of an earlier one. */
#define INJ_CUT_OFFSET (8192 - INJ_CUT_PLACES * INJ_CUT_BYTES)
#define INJ_CUT_PLACES 24
#define INJ_CUT_BYTES 72 /* of each */

#ifndef __ASSEMBLER__
#include <stddef.h>
#include <stdint.h>

struct inj_home {
	uint64_t r15, r14, r13, r12, rbp, rbx, r11, r10;
	uint64_t r9, r8, rax, rcx, rdx, rsi, rdi, rsp;
	uint64_t sigmask;
	uint32_t flags;     /* low byte: 0x7f if OF, else 0; next: SF ZF AF PF CF */
	uint32_t direction; /* DF                                                 */
	uint64_t rip;
};
_Static_assert(offsetof(struct inj_home, rsp) == 120, "parasite.S");
_Static_assert(offsetof(struct inj_home, sigmask) == HOME_SIGMASK, "parasite.S");
_Static_assert(offsetof(struct inj_home, flags) == HOME_FLAGS, "parasite.S");
_Static_assert(offsetof(struct inj_home, direction) == HOME_DIRECTION, "parasite.S");
_Static_assert(offsetof(struct inj_home, rip) == HOME_RIP, "parasite.S");
#endif

#endif
