/* SPDX-License-Identifier: Apache-2.0
 *
 * The CPU-specific part of arch.h (aarch64). The names are those of x86_64/arch_cpu.h, where they
 * are explained; differences are noted here.
 *
 * When a thread stops in a system call, the kernel has already reset its registers to restart the
 * call, if it is to be restarted, and reveals neither that it was in one nor what the call returned
 * (arch/arm64/kernel/signal.c, do_signal()). struct arch_regs still has the meaning that it has on
 * x86-64: arch_regs_get() derives it from the instruction at the program counter, and
 * arch_regs_set() converts it back.
 */
#ifndef AVCKPT_ARCH_CPU_H
#define AVCKPT_ARCH_CPU_H

#ifndef AVCKPT_ARCH_H
#error "include arch.h"
#endif

#include <errno.h>

#define ARCH_NAME "aarch64"
#define ARCH_AUDIT AUDIT_ARCH_AARCH64
#define ARCH_USER_END (UINT64_C(1) << 48)
#define ARCH_PAGE_BYTES 4096
#define ARCH_HOME_FORGETS true /* by rt_sigreturn(2) */

struct arch_regs {
	struct user_regs_struct r; /* in a call: pc behind it, and its first argument */
	uint64_t tls;
	long nr; /* of the call it is in, -1                            */
	long result;
};

static inline long arch_syscall_nr(const struct arch_regs *regs)
{
	return regs->nr;
}
/* The upper half of x8, which the kernel ignores (do_el0_svc()). The call preserves it; but the app
 * cannot rely on x8, because a restarted call has the number of restart_syscall(2) in it. */
static inline uint32_t arch_call_mark(const struct arch_regs *regs)
{
	return regs->nr >= 0 ? (uint32_t)(regs->r.regs[8] >> 32) : 0;
}
/* A thread that is about to make the call looks like one that is in it. */
static inline uint32_t arch_result_mark(const struct arch_regs *regs)
{
	(void)regs;
	return 0;
}
static inline void arch_syscall_nr_set(struct arch_regs *regs, long nr)
{
	regs->nr = nr;
	regs->r.regs[8] = (unsigned long long)nr;
	if (nr < 0) /* at its entry: it is not made, and its result is this */
		regs->r.regs[0] = (unsigned long long)-ENOSYS;
}
static inline long arch_syscall_result(const struct arch_regs *regs)
{
	return regs->result;
}
static inline void arch_result_note(struct arch_regs *regs, long result)
{
	regs->result = result;
}
static inline uint64_t arch_syscall_arg(const struct arch_regs *regs, unsigned int n)
{
	return n < 6 ? regs->r.regs[n] : 0;
}

/* See ARCH_FORGETS_CALLS: none is made again. */
static inline uint32_t arch_call_done(const struct arch_regs *regs)
{
	(void)regs;
	return 0;
}

static inline avc_remote arch_pc(const struct arch_regs *regs)
{
	return regs->r.pc;
}
static inline avc_remote arch_sp(const struct arch_regs *regs)
{
	return regs->r.sp;
}
static inline avc_remote arch_tls(const struct arch_regs *regs)
{
	return regs->tls;
}
static inline void arch_tls_set(struct arch_regs *regs, avc_remote tls)
{
	regs->tls = tls;
}
static inline uint64_t arch_other_base(const struct arch_regs *regs)
{
	(void)regs;
	return 0;
}
static inline void arch_pc_set(struct arch_regs *regs, avc_remote pc)
{
	regs->r.pc = pc;
}

#define ARCH_CODE_BYTES 8
#define ARCH_SYSCALL_BYTES 4

/* Whether the kernel continues such a call instead of restarting it cannot be seen: it is known
 * only for a thread that slept in it. */
bool arch_may_continue(long nr);
void arch_note_slept(struct arch_regs *regs);

#define ARCH_ROOM_CALLS { SYS_prctl, 50 /* PR_SVE_SET_VL */ },

/* arch/arm64/kernel/signal.c, do_signal(): it compares the program counter with what it was. */
#define ARCH_FORGETS_CALLS true

/* Whether the thread has registers that no system call preserves: it must not be borrowed now. */
bool arch_is_delicate(pid_t tid);

/* No permission is needed: PR_SVE_GET_VL stores nothing. */
#define ARCH_STATE_CALL SYS_prctl
#define ARCH_STATE_PERMITTED 51
#define ARCH_STATE_ASK 51
#define ARCH_STATE_NUMBER 63

/* The stub returns by rt_sigreturn(2), from a signal frame that it contains. */
#define ARCH_STUB_BYTES 1152
/* The vector registers, without which there is no signal frame. */
int arch_stub_read_xstate(pid_t tid, uint8_t *code);

#endif
