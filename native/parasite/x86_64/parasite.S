/* SPDX-License-Identifier: Apache-2.0
 *
 * What injected code cannot say in C (x86-64).
 */
#include "home.h"

#define ENOTSOCK 88
#define NR_RT_SIGPROCMASK 14
#define NR_RT_SIGRETURN 15
#define NR_CLONE 56
#define NR_EXIT 60
#define NR_GETTID 186

	.text

/* inj_enter(call, stack): inj_run(-, call) on that stack, by a thread of the app's.
 *
 * It comes with the app's own stack pointer, and leaves that only when all signals are
 * blocked: the tracer blocks them as well, but may die before it has.  A handler never
 * runs on the small stack in here. */
	.globl	inj_enter
	.type	inj_enter, @function
inj_enter:
	movq	%rdi, %rbx
	movq	%rsi, %rbp
	movl	$NR_RT_SIGPROCMASK, %eax
	movl	$2, %edi			/* SIG_SETMASK */
	leaq	all_signals(%rip), %rsi
	xorl	%edx, %edx
	movl	$8, %r10d
	syscall
	movq	%rbp, %rsp
	xorl	%ebp, %ebp
	movq	%rbx, %rsi
	call	inj_run
	ud2
	.balign	8
all_signals:
	.quad	-1

/* Go back to the context in `home`, signal mask included.
 *
 * The stack pointer is the app's own before any signal can come in again: a
 * handler that runs between here and home then finds the stack (and the red
 * zone, which the kernel leaves alone) as if it had come a moment earlier.
 * From there on nothing is written to the stack, so flags are put back without
 * popf.
 *
 * Such a handler returns here, and may take its time: `home` stays as it is until
 * `arrived` is set, and a stop of the whole process has shown that no thread is here any more,
 * nor in a handler that returns here (process/stop.c): the last instruction still needs it. */
	.globl	inj_go_home
	.type	inj_go_home, @function
inj_go_home:
	movq	home+120(%rip), %rsp
	movl	$NR_RT_SIGPROCMASK, %eax
	movl	$2, %edi			/* SIG_SETMASK */
	leaq	home+HOME_SIGMASK(%rip), %rsi
	xorl	%edx, %edx
	movl	$8, %r10d
	syscall
	movl	home+HOME_FLAGS(%rip), %eax
	cld
	cmpl	$0, home+HOME_DIRECTION(%rip)
	je	1f
	std
1:	addb	$1, %al				/* OF */
	sahf					/* the others */
	movq	home+0(%rip), %r15
	movq	home+8(%rip), %r14
	movq	home+16(%rip), %r13
	movq	home+24(%rip), %r12
	movq	home+32(%rip), %rbp
	movq	home+40(%rip), %rbx
	movq	home+48(%rip), %r11
	movq	home+56(%rip), %r10
	movq	home+64(%rip), %r9
	movq	home+72(%rip), %r8
	movq	home+80(%rip), %rax
	movq	home+88(%rip), %rcx
	movq	home+96(%rip), %rdx
	movq	home+104(%rip), %rsi
	movq	home+112(%rip), %rdi
	movl	$1, home+HOME_ARRIVED(%rip)
	jmp	*home+HOME_RIP(%rip)

/* clone(2) without a new stack.  The child is meant to be stopped and sent
 * elsewhere by the tracer; if there is none any more it leaves at once, and
 * without touching memory: a CLONE_VM child shares this very stack. */
	.globl	inj_clone
	.type	inj_clone, @function
inj_clone:
	movq	%rcx, %r10
	movl	$NR_CLONE, %eax
	syscall
	testq	%rax, %rax
	jz	2f
	ret
2:	movl	$NR_EXIT, %eax
	xorl	%edi, %edi
	syscall
	jmp	2b

/* A thread: long inj_spawn(flags, stack, tls, thread, slot, tid).  A child with
 * another number than `tid` leaves at once and without touching its stack, on
 * which the next attempt may run already. */
	.globl	inj_spawn
	.type	inj_spawn, @function
inj_spawn:
	pushq	%r12
	pushq	%r13
	pushq	%r14
	movq	%r8, %r12
	movq	%rcx, %r13
	movl	%r9d, %r14d
	movq	%rdx, %r8
	xorl	%edx, %edx
	xorl	%r10d, %r10d
	movl	$NR_CLONE, %eax
	syscall
	testq	%rax, %rax
	jz	3f
	popq	%r14
	popq	%r13
	popq	%r12
	ret
3:	movl	$NR_GETTID, %eax
	syscall
	cmpl	%eax, %r14d
	jne	2b
	movq	%r12, %rdi
	movq	%r13, %rsi
	call	inj_thread
	ud2

/* To use AMX tiles makes the kernel give the thread room for them.  (%rdi: XSAVE image) */
	.globl	inj_make_room
	.type	inj_make_room, @function
inj_make_room:
	movl	$0x40000, %eax
	xorl	%edx, %edx
	xrstor64 (%rdi)
	ret

	.globl	inj_sigreturn
	.type	inj_sigreturn, @function
inj_sigreturn:
	movq	%rdi, %rsp
	movl	$NR_RT_SIGRETURN, %eax
	syscall
	ud2

/* Where a call that a stop has cut short goes on (engine/trace/cut.c): a place for each instruction of
 * the app's that makes such calls, to which it returns.  The call comes with its first argument's
 * upper half, of which the kernel takes no notice, saying how much was done before; with the address
 * and the size of what is left; and with nothing else changed.  So all there is to know is in
 * registers, and may be interrupted and copied like the app's own.
 *
 * A call that has done a part does not tell of an error but returns the part.  The next one tells,
 * but for errors that a socket tells only once (their numbers begin at ENOTSOCK): these are told now.
 *
 * A system call preserves flags, too, and leaves the address after it in rcx: that alone is free here. */
	.globl	inj_cut_at
	.set	inj_cut_at, INJ_CUT_OFFSET
	.section .text.cut,"ax",@progbits
	.globl	inj_cut
	.type	inj_cut, @function
inj_cut:
	.set	place, 0
	.rept	INJ_CUT_PLACES
	syscall
	bswapq	%rdi
	movl	%edi, %ecx
	bswapl	%ecx				/* how much was done before */
	leaq	(%rdx,%rcx), %rdx
	notq	%rcx
	leaq	1(%rsi,%rcx), %rsi
	movq	%rax, %rcx
	bswapq	%rcx
	movl	%ecx, %ecx
	jrcxz	2f				/* no error */
	leaq	ENOTSOCK-1(%rax), %rcx
	bswapq	%rcx
	movl	%ecx, %ecx
	jrcxz	1f
	jmp	3f
1:	movl	$0, %eax
2:	movl	%edi, %ecx
	bswapl	%ecx
	leaq	(%rax,%rcx), %rax
3:	bswapq	%rdi
	movl	%edi, %edi
	movq	home+HOME_CUT+8*place(%rip), %rcx
	jmp	*%rcx
	.balign	8
	.set	place, place+1
	.endr
	.org	inj_cut + INJ_CUT_PLACES * INJ_CUT_BYTES

	.section .note.GNU-stack,"",@progbits
