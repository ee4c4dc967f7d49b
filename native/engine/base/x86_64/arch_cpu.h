/* SPDX-License-Identifier: Apache-2.0
 *
 * The CPU-specific part of arch.h (x86-64): registers, numbers, and inline functions.
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
/* Whether going home by itself (inj_go_home()) makes a thread forget what restart_syscall(2) would
 * continue. */
#define ARCH_HOME_FORGETS false

struct arch_regs {
	struct user_regs_struct r;
};

/* The system call a stopped thread is in, -1 if it is in none.  The kernel has it from the
 * lower half of rax (arch/x86/entry/entry_64.S, do_syscall_64()). */
static inline long arch_syscall_nr(const struct arch_regs *regs)
{
	return (int32_t)regs->r.orig_rax;
}
/* A mark on a call that is to be restarted: it stays on that call over all stops, invisible to the
 * app. It is the upper half of rax, which the kernel saves and reloads with the syscall number, and
 * which the result overwrites when the call returns. */
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
/* Of a call whose first argument is a descriptor, an int: how much it had done before it was made again
 * (inj_cut()). */
static inline uint32_t arch_call_done(const struct arch_regs *regs)
{
	return (uint32_t)(regs->r.rdi >> 32);
}

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

/* Whether only a thread's having slept in such a call shows that the kernel continues it instead of
 * restarting it. */
static inline bool arch_may_continue(long nr)
{
	(void)nr;
	return false;
}
static inline void arch_note_slept(struct arch_regs *regs)
{
	(void)regs;
}

/* What inj_make_room() calls: {number, first argument}, each with a comma behind it. */
#define ARCH_ROOM_CALLS

/* Whether the kernel, once a tracer has set the registers of a thread in a call, does not know any more
 * that there was one (trace/thread.c, end_call_by_signal()). */
#define ARCH_FORGETS_CALLS false

/* Whether the thread has registers that no system call preserves, so that it must not be borrowed
 * now. */
static inline bool arch_is_delicate(pid_t tid)
{
	(void)tid;
	return false;
}

/* A process has to request permission, once, for state without room before its first use
 * (arch_frame_needs_room()): the call, its code to query the permissions (64 bits; the address is
 * the next argument), its code to request one, and the number of the state
 * (arch/x86/kernel/fpu/xstate.c). */
#define ARCH_STATE_CALL SYS_arch_prctl
#define ARCH_STATE_PERMITTED 0x1022 /* ARCH_GET_XCOMP_PERM */
#define ARCH_STATE_ASK 0x1023       /* ARCH_REQ_XCOMP_PERM */
#define ARCH_STATE_NUMBER 18        /* XFEATURE_XTILE_DATA */

#define ARCH_STUB_BYTES 224
/* Adds the extended state, where returning needs it. */
static inline int arch_stub_read_xstate(pid_t tid, uint8_t *code)
{
	(void)tid, (void)code;
	return 0;
}

#endif
