/* SPDX-License-Identifier: Apache-2.0
 *
 * What injected code cannot say in C (aarch64).
 */
#include "home.h"

#define NR_EXIT 93
#define NR_RT_SIGPROCMASK 135
#define NR_RT_SIGRETURN 139
#define NR_PRCTL 167
#define NR_GETTID 178
#define NR_CLONE 220
#define PR_SVE_SET_VL 50

	.text

/* inj_enter(call, stack): inj_run(-, call) on that stack, by a thread of the app's.
 *
 * It comes with the app's own stack pointer, and leaves that only when all signals are
 * blocked: the tracer blocks them as well, but may die before it has.  A handler never
 * runs on the small stack in here. */
	.globl	inj_enter
	.type	inj_enter, @function
inj_enter:
	mov	x19, x0
	mov	x20, x1
	mov	x0, #2				/* SIG_SETMASK */
	adr	x1, all_signals
	mov	x2, #0
	mov	x3, #8
	mov	x8, #NR_RT_SIGPROCMASK
	svc	#0
	mov	sp, x20
	mov	x29, #0
	mov	x30, #0
	mov	x1, x19
	bl	inj_run
	brk	#0
	.balign	8
all_signals:
	.quad	-1

/* Go back to the context in `home`, signal mask included.  The vector registers are the
 * app's own all the time, and so are put into the frame only here; unless they were longer
 * ones, which no system call leaves alone: those the tracer has put there.  No signal
 * comes before the kernel has read the frame. */
	.globl	inj_go_home
	.type	inj_go_home, @function
inj_go_home:
	adrp	x0, home
	add	x0, x0, :lo12:home
	mov	sp, x0
	mrs	x2, fpsr
	mrs	x3, fpcr
	add	x1, x0, #HOME_FPSIMD
	stp	w2, w3, [x1, #8]
	stp	q0, q1, [x1, #16]
	stp	q2, q3, [x1, #48]
	stp	q4, q5, [x1, #80]
	stp	q6, q7, [x1, #112]
	stp	q8, q9, [x1, #144]
	stp	q10, q11, [x1, #176]
	stp	q12, q13, [x1, #208]
	stp	q14, q15, [x1, #240]
	stp	q16, q17, [x1, #272]
	stp	q18, q19, [x1, #304]
	stp	q20, q21, [x1, #336]
	stp	q22, q23, [x1, #368]
	stp	q24, q25, [x1, #400]
	stp	q26, q27, [x1, #432]
	stp	q28, q29, [x1, #464]
	stp	q30, q31, [x1, #496]
	mov	w1, #1
	str	w1, [x0, #HOME_ARRIVED]
	mov	x8, #NR_RT_SIGRETURN
	svc	#0
	brk	#0

/* clone(2) without a new stack; its last two arguments are the other way round than on
 * x86-64.  The child is meant to be stopped and sent elsewhere by the tracer; if there is
 * none any more it leaves at once, and without touching memory: a CLONE_VM child shares
 * this very stack. */
	.globl	inj_clone
	.type	inj_clone, @function
inj_clone:
	mov	x9, x3
	mov	x3, x4
	mov	x4, x9
	mov	x8, #NR_CLONE
	svc	#0
	cbz	x0, 2f
	ret
2:	mov	x0, #0
	mov	x8, #NR_EXIT
	svc	#0
	b	2b

/* A thread: long inj_spawn(flags, stack, tls, thread, slot, tid).  A child with
 * another number than `tid` leaves at once and without touching its stack, on
 * which the next attempt may run already. */
	.globl	inj_spawn
	.type	inj_spawn, @function
inj_spawn:
	mov	x9, x3
	mov	x10, x4
	mov	w11, w5
	mov	x3, x2
	mov	x2, #0
	mov	x4, #0
	mov	x8, #NR_CLONE
	svc	#0
	cbz	x0, 3f
	ret
3:	mov	x8, #NR_GETTID
	svc	#0
	cmp	w0, w11
	b.ne	2b
	mov	x29, #0
	mov	x30, #0
	mov	x0, x10
	mov	x1, x9
	bl	inj_thread
	brk	#0

/* The vector length that the frame has (x0: the frame): rt_sigreturn(2) takes no other. */
	.globl	inj_make_room
	.type	inj_make_room, @function
inj_make_room:
	ldrh	w1, [x0, #HOME_SVE_VL]
	mov	x0, #PR_SVE_SET_VL
	mov	x8, #NR_PRCTL
	svc	#0
	ret

	.globl	inj_sigreturn
	.type	inj_sigreturn, @function
inj_sigreturn:
	mov	sp, x0
	mov	x8, #NR_RT_SIGRETURN
	svc	#0
	brk	#0

	.globl	inj_cut_at
	.set	inj_cut_at, INJ_CUT_OFFSET

	.section .note.GNU-stack,"",@progbits
