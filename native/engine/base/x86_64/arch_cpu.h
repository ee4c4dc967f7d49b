/* SPDX-License-Identifier: Apache-2.0
 *
 * What of arch.h is the CPU's own (x86-64): its registers, its numbers, and what is so short that
 * it is inline.
 */
#ifndef AVCKPT_ARCH_CPU_H
#define AVCKPT_ARCH_CPU_H

#ifndef AVCKPT_ARCH_H
#error "include arch.h"
#endif

#define ARCH_NAME "x86-64"
#define ARCH_AUDIT AUDIT_ARCH_X86_64           /* as seccomp filters know it (linux/audit.h) */
#define ARCH_USER_END UINT64_C(0x7ffffffff000) /* of user addresses */
#define ARCH_PAGE_BYTES 4096

struct arch_regs {
	struct user_regs_struct r;
};

/* The system call a stopped thread is in, -1 if it is in none.  The kernel has it from the
 * lower half of rax (arch/x86/entry/entry_64.S, do_syscall_64()). */
static inline long arch_syscall_nr(const struct arch_regs *regs)
{
	return (int32_t)regs->r.orig_rax;
}
/* A mark on a call that is to be made again: it stays on that call over all stops, and
 * nobody but us sees it.  It is the upper half of rax, which the kernel keeps beside the
 * number and loads again with it, and which holds the result when the call returns. */
static inline uint32_t arch_call_mark(const struct arch_regs *regs)
{
	return (uint32_t)(regs->r.orig_rax >> 32);
}
/* The same of a thread that is just about to make the call. */
static inline uint32_t arch_result_mark(const struct arch_regs *regs)
{
	return (uint32_t)(regs->r.rax >> 32);
}
static inline void arch_syscall_nr_set(struct arch_regs *regs, long nr)
{
	regs->r.orig_rax = (unsigned long long)nr;
}
static inline long arch_syscall_result(const struct arch_regs *regs)
{
	return (long)regs->r.rax;
}
static inline void arch_result_note(struct arch_regs *regs, long result)
{
	regs->r.rax = (unsigned long long)result;
}
uint64_t arch_syscall_arg(const struct arch_regs *regs, unsigned int n);
void arch_syscall_arg_set(struct arch_regs *regs, unsigned int n, uint64_t value);

static inline avc_remote arch_pc(const struct arch_regs *regs)
{
	return regs->r.rip;
}
static inline avc_remote arch_sp(const struct arch_regs *regs)
{
	return regs->r.rsp;
}
static inline avc_remote arch_tls(const struct arch_regs *regs)
{
	return regs->r.fs_base;
}

static inline void arch_tls_set(struct arch_regs *regs, avc_remote tls)
{
	regs->r.fs_base = tls;
}
static inline uint64_t arch_other_base(const struct arch_regs *regs)
{
	return regs->r.gs_base;
}
static inline void arch_pc_set(struct arch_regs *regs, avc_remote pc)
{
	regs->r.rip = pc;
}

#define ARCH_CODE_BYTES 7
#define ARCH_SYSCALL_BYTES 2

/* Whether a stopped thread does not tell that the kernel goes on with such a call and does not
 * begin it again, but by its having slept in it. */
static inline bool arch_may_continue(long nr)
{
	(void)nr;
	return false;
}
static inline void arch_note_slept(struct arch_regs *regs)
{
	(void)regs;
}

/* Whether the thread has registers that no system call leaves alone, so that it is not to be
 * borrowed now. */
static inline bool arch_is_delicate(pid_t tid)
{
	(void)tid;
	return false;
}

/* A process has to ask for the permission to have state for which there is no room before it is
 * used (arch_frame_needs_room()), once: the call, what it is
 * asked with (what is permitted comes as 64 bits, the address is the next argument), what it
 * asks with, for the state with this number (arch/x86/kernel/fpu/xstate.c). */
#define ARCH_STATE_CALL SYS_arch_prctl
#define ARCH_STATE_PERMITTED 0x1022 /* ARCH_GET_XCOMP_PERM */
#define ARCH_STATE_ASK 0x1023       /* ARCH_REQ_XCOMP_PERM */
#define ARCH_STATE_NUMBER 18        /* XFEATURE_XTILE_DATA */

#define ARCH_STUB_BYTES 224
/* Adds the extended state, where going back needs it. */
static inline int arch_stub_read_xstate(pid_t tid, uint8_t *code)
{
	(void)tid, (void)code;
	return 0;
}

#endif
