/* SPDX-License-Identifier: Apache-2.0
 *
 * Everything CPU-specific in the engine. Each CPU has a folder with arch_cpu.h (definitions) and
 * arch.c (functions). ptrace(2) errors are returned as -1 with errno.
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

/* The kernel's own codes for "make this call again" (include/linux/errno.h); they never reach user
 * space, but ptrace sees them. */
#define ERESTARTSYS 512
#define ERESTARTNOINTR 513
#define ERESTARTNOHAND 514
#define ERESTART_RESTARTBLOCK 516

/* An address in a process, never to be dereferenced here. */
typedef uint64_t avc_remote;

#include "arch_cpu.h"

int arch_regs_get(pid_t tid, struct arch_regs *regs);
int arch_regs_set(pid_t tid, const struct arch_regs *regs);
/* Sets the result of the system call the stopped thread is in, nothing else. */
int arch_result_set(pid_t tid, long result);
/* See arch_call_mark(). */
int arch_call_mark_set(pid_t tid, struct arch_regs *regs, uint32_t mark);

/* False for a task in 32-bit mode. */
bool arch_is_native(const struct arch_regs *regs);

/* `regs` as of a stop inside a system call that is to be restarted: sets them as the kernel would.
 * Not in a call: unchanged. */
void arch_rewind(struct arch_regs *regs);

/* The call number a compiler would have loaded with the instruction before the
 * system call at `pc` (the address after it), or -1: `code` are the ARCH_CODE_BYTES
 * before `pc`. */
long arch_syscall_nr_before(const uint8_t code[ARCH_CODE_BYTES]);

/* Whether `code` is a system call instruction. */
bool arch_is_syscall(const uint8_t code[ARCH_SYSCALL_BYTES]);

/* A call that has done a part, which is its result: the rest of it is to be made at `place` (inj_cut()),
 * where the kernel restarts it. */
void arch_call_rest(struct arch_regs *regs, avc_remote place);

/* Like arch_rewind(), for the *same* task continuing without the kernel's help: its restart block
 * is still there and is continued, not restarted. */
void arch_resume(struct arch_regs *regs);

/* `base` (a live user context of the task) sent to `pc` with one argument, as the first and as the
 * second: a call that it is still in may put its result in the place of the first (inj_run()). */
void arch_call(struct arch_regs *regs, const struct arch_regs *base, avc_remote pc, avc_remote sp,
	       uint64_t arg);

/* Likewise with two arguments, the stack as it is. */
void arch_enter(struct arch_regs *regs, const struct arch_regs *base, avc_remote pc, uint64_t a,
		uint64_t b);

/* Fills in the context that inj_go_home() returns to. */
void arch_home_set(struct inj_home *home, const struct arch_regs *regs, uint64_t sigmask);

/* The extended (FPU, vector) state of a stopped thread. `arch_xstate_bytes` is its size on this
 * machine, 0 if unknown. */
size_t arch_xstate_bytes(void);

/* The size of a thread's signal frame, and how it is built: first, while the thread is stopped, the
 * extended state is read straight into the frame; later the rest is filled in. `frame` is where the
 * engine sees it (aligned to 64), `remote` where the process will. Returns the stack pointer for
 * inj_sigreturn(). ENOTSUP: the thread has state that does not fit in a frame. */
size_t arch_frame_bytes(void);
int arch_frame_read_xstate(pid_t tid, void *frame);
/* Whether the frame, as read, has state for which the kernel allocates room in a new thread only at
 * first use (AMX tiles, SVE): inj_make_room() has to be called before. */
bool arch_frame_needs_room(const void *frame);
avc_remote arch_frame_build(void *frame, avc_remote remote, const struct arch_regs *regs,
			    uint64_t sigmask, const uint64_t altstack[3]);

/* A signal frame that the kernel has made on a stack. */
struct arch_signal_frame {
	avc_remote at;    /* what the handler gets as its third argument            */
	uint64_t sigmask; /* before the handler                                     */
	avc_remote pc;    /* where it returns to                                    */
	int signal;       /* 0: unknown */
};
#define ARCH_SIGNAL_FRAME_BYTES 1024
/* The next one in the `bytes` bytes of a stack that begin at `at` (a multiple of 16); *next is
 * where to continue, initially 0. Data that looks like one is not distinguished. */
bool arch_signal_frame_find(const uint8_t *stack, size_t bytes, avc_remote at, size_t *next,
			    struct arch_signal_frame *found);

/* A stub that makes one system call (registers preset by arch_stub_call), usually clone(2), and
 * then returns to `regs` by itself, signal mask included. A new task exits; its creator reaps it by
 * ARCH_STUB_WAIT before it returns. Writes at most ARCH_STUB_BYTES to `code`. */
#define ARCH_STUB_WAIT SYS_wait4
size_t arch_stub_build(uint8_t *code, const struct arch_regs *regs, uint64_t sigmask);
/* Whether `code` was written by arch_stub_build(). */
bool arch_is_stub(const uint8_t *code);
/* `last`: the task exits after the call instead of returning. */
void arch_stub_call(struct arch_regs *regs, const struct arch_regs *base, avc_remote stub,
		    bool last, long nr, const uint64_t arg[6]);

#endif
