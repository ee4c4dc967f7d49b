/* SPDX-License-Identifier: Apache-2.0
 *
 * Everything the engine knows about the CPU (x86-64).  A second CPU is a second
 * folder with the same names.  ptrace(2) errors are returned as -1 with errno.
 */
#ifndef AVCKPT_ARCH_H
#define AVCKPT_ARCH_H

#include <linux/audit.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/types.h>
#include <sys/user.h>

#include "home.h"

#define ARCH_NAME "x86-64"
#define ARCH_AUDIT AUDIT_ARCH_X86_64           /* as seccomp filters know it (linux/audit.h) */
#define ARCH_USER_END UINT64_C(0x7ffffffff000) /* of user addresses */
#define ARCH_PAGE_BYTES 4096

struct arch_regs {
	struct user_regs_struct r;
};

/* An address in a process, never to be dereferenced here. */
typedef uint64_t avc_remote;

int arch_regs_get(pid_t tid, struct arch_regs *regs);
int arch_regs_set(pid_t tid, const struct arch_regs *regs);
/* Sets the result of the system call the stopped thread is in, nothing else. */
int arch_result_set(pid_t tid, long result);

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
int arch_call_mark_set(pid_t tid, struct arch_regs *regs, uint32_t mark);
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

/* False for a task in 32-bit mode. */
bool arch_is_native(const struct arch_regs *regs);

/* `regs` as of a stop inside a system call that is to be made again: as the
 * kernel would leave them, but in one piece.  Not in a call: unchanged. */
void arch_rewind(struct arch_regs *regs);

/* The call number a compiler would have loaded with the instruction before the
 * system call at `pc` (the address after it), or -1: `code` are the ARCH_CODE_BYTES
 * before `pc`. */
#define ARCH_CODE_BYTES 7
long arch_syscall_nr_before(const uint8_t code[ARCH_CODE_BYTES]);

/* Whether `code` is the instruction for a system call. */
#define ARCH_SYSCALL_BYTES 2
bool arch_is_syscall(const uint8_t code[ARCH_SYSCALL_BYTES]);

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

/* Like arch_rewind(), for the *same* task going on without the kernel's help:
 * a restart block is still there and is continued, not begun again. */
void arch_resume(struct arch_regs *regs);

/* `base` (a live user context of the task) sent to `pc` with one argument. */
void arch_call(struct arch_regs *regs, const struct arch_regs *base, avc_remote pc, avc_remote sp,
	       uint64_t arg);

/* Likewise with two arguments, the stack as it is. */
void arch_enter(struct arch_regs *regs, const struct arch_regs *base, avc_remote pc, uint64_t a,
		uint64_t b);

/* Fills in the context that inj_go_home() goes back to. */
void arch_home_set(struct inj_home *home, const struct arch_regs *regs, uint64_t sigmask);

/* The extended (FPU, vector) state of a stopped thread.  `arch_xstate_bytes` is
 * its size on this machine, 0 if it cannot be found out. */
size_t arch_xstate_bytes(void);

/* Room one thread's signal frame takes, and how it is built: first, while the
 * thread is stopped, the extended state is read straight into the frame; later
 * the rest is filled in.  `frame` is where the engine sees it (aligned to 64),
 * `remote` where the process will.  Returns the stack pointer for
 * inj_sigreturn(). */
size_t arch_frame_bytes(void);
int arch_frame_read_xstate(pid_t tid, void *frame);
/* Whether the frame, which was read, has state that the kernel gives a new thread no room
 * for until it uses it (AMX tiles): inj_make_room() has to be called before. */
bool arch_frame_needs_room(const void *frame);
/* A process has to ask for the permission to have such state, once: the call, what it is
 * asked with (what is permitted comes as 64 bits, the address is the next argument), what it
 * asks with, for the state with this number (arch/x86/kernel/fpu/xstate.c). */
#define ARCH_STATE_CALL SYS_arch_prctl
#define ARCH_STATE_PERMITTED 0x1022 /* ARCH_GET_XCOMP_PERM */
#define ARCH_STATE_ASK 0x1023       /* ARCH_REQ_XCOMP_PERM */
#define ARCH_STATE_NUMBER 18        /* XFEATURE_XTILE_DATA */
avc_remote arch_frame_build(void *frame, avc_remote remote, const struct arch_regs *regs,
			    uint64_t sigmask, const uint64_t altstack[3]);

/* A signal frame that the kernel has made on a stack. */
struct arch_signal_frame {
	avc_remote at;    /* what the handler gets as its third argument            */
	uint64_t sigmask; /* before the handler                                     */
	int signal;       /* 0: it does not say                                        */
};
#define ARCH_SIGNAL_FRAME_BYTES 1024
/* The next one in the `bytes` bytes of a stack that begin at `at` (a multiple of 16); *next is
 * where to look on, at first 0.  What only looks like one is not told from one. */
bool arch_signal_frame_find(const uint8_t *stack, size_t bytes, avc_remote at, size_t *next,
			    struct arch_signal_frame *found);

/* A stub that makes one system call (registers preset by arch_stub_call), clone(2) as a rule, and
 * then goes back to `regs` by itself, signal mask included.  A new task ends; who made it waits for
 * it before it goes home, by ARCH_STUB_WAIT.  Writes at most ARCH_STUB_BYTES to `code`. */
#define ARCH_STUB_WAIT SYS_wait4
#define ARCH_STUB_BYTES 224
size_t arch_stub_build(uint8_t *code, const struct arch_regs *regs, uint64_t sigmask);
/* Adds the extended state, where going back needs it. */
static inline int arch_stub_read_xstate(pid_t tid, uint8_t *code)
{
	(void)tid, (void)code;
	return 0;
}
/* Whether `code` is what arch_stub_build() has written once. */
bool arch_is_stub(const uint8_t *code);
/* `last`: the task ends after the call, and does not go back. */
void arch_stub_call(struct arch_regs *regs, const struct arch_regs *base, avc_remote stub,
		    bool last, long nr, const uint64_t arg[6]);

#endif
