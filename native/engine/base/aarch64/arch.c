/* SPDX-License-Identifier: Apache-2.0 */
#include "base.h"

#include <elf.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/auxv.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#define SVC 0xd4000001U /* svc #0 */
#define PSTATE_MODE 0x1fU
#define CALLS_MAX 1024
#define FRAME_BYTES 4688 /* struct rt_sigframe, arch/arm64/kernel/signal.c */
#define FRAME_RECORD_BYTES 16

#define NT_ARM_SVE_ 0x405
#define NT_ARM_SSVE_ 0x40b
#define NT_ARM_ZA_ 0x40c
#define HWCAP_SVE_ (1UL << 22)
#define HWCAP2_SME_ (1UL << 23)

static int regset(pid_t tid, long request, long set, void *at, size_t bytes)
{
	struct iovec iov = { at, bytes };

	return ptrace(request, tid, set, &iov) == -1 ? -1 : 0;
}

/* ---- the call that a thread is in -------------------------------------------------- */

static bool is_again(long result)
{
	return result == -ERESTARTSYS || result == -ERESTARTNOINTR || result == -ERESTARTNOHAND ||
	       result == -ERESTART_RESTARTBLOCK;
}

/* What the call has returned, judging by what calls of its kind return. */
static long answer_of(const struct arch_regs *regs)
{
	if (regs->r.regs[8] >> 32)
		return -ERESTARTNOHAND; /* marked: it was rewound */
	switch (regs->nr) {
	case SYS_restart_syscall:
		return -ERESTART_RESTARTBLOCK;
	case SYS_ppoll:
	case SYS_pselect6:
	case SYS_rt_sigsuspend:
	case SYS_nanosleep:
	case SYS_clock_nanosleep:
		return -ERESTARTNOHAND;
	case SYS_futex:
		return regs->r.regs[3] ? -ERESTARTNOHAND : -ERESTARTSYS;
	default:
		return -ERESTARTSYS;
	}
}

/* The first argument, which only the kernel still has: /proc shows it for a thread that is in a
 * call. */
static int first_argument(pid_t tid, int nr, unsigned long long *argument)
{
	const int none = -1;
	char path[40], text[256], *at;
	ssize_t n = -1;
	int fd;

	snprintf(path, sizeof path, "/proc/%d/syscall", tid);
	if (regset(tid, PTRACE_SETREGSET, NT_ARM_SYSTEM_CALL, &nr, sizeof nr))
		return -1;
	fd = open(path, O_RDONLY | O_CLOEXEC);
	if (fd >= 0) {
		n = read(fd, text, sizeof text - 1);
		close(fd);
	}
	if (regset(tid, PTRACE_SETREGSET, NT_ARM_SYSTEM_CALL, (void *)&none, sizeof none) || n <= 0)
		return -1;
	text[n] = 0;
	if (strtol(text, &at, 10) != nr || at == text)
		return -1;
	*argument = strtoull(at, NULL, 16);
	return 0;
}

/* A page that the program has never touched is not read: it would be there from then on.  This is
 * less than a page long. */
static bool is_touched(pid_t tid, avc_remote start, avc_remote end)
{
	const avc_remote page[2] = { start / ARCH_PAGE_BYTES, end / ARCH_PAGE_BYTES };
	int pagemap = proc_open(tid, "pagemap", O_RDONLY);
	bool touched = pagemap >= 0;

	for (int i = 0; touched && i < 2; i++) {
		uint64_t entry = 0;

		touched = pread(pagemap, &entry, sizeof entry, (off_t)(page[i] * sizeof entry)) >=
				  0 &&
			  entry & (PAGEMAP_PRESENT | PAGEMAP_SWAPPED);
	}
	close_fd(&pagemap);
	return touched;
}

/* Whether it has just come back from a handler, with the result of a call that the signal has
 * interrupted: then the frame from which it came is still below its stack, and nothing of it has
 * changed.  One that an earlier handler has left there may be taken for it, if the program does the
 * same again with the same registers: it then meets another EINTR, as it did before.  Frames on
 * alternate stacks are not found. */
static bool has_been_in_handler(pid_t tid, const struct user_regs_struct *r)
{
	const avc_remote record = (r->sp - FRAME_RECORD_BYTES) & ~UINT64_C(15);
	struct inj_home frame;
	const struct iovec to = { &frame, offsetof(struct inj_home, padding) },
			   from = { (void *)(record - FRAME_BYTES), to.iov_len };

	return is_touched(tid, record - FRAME_BYTES, record - FRAME_BYTES + to.iov_len) &&
	       process_vm_readv(tid, &to, 1, &from, 1, 0) == (ssize_t)to.iov_len &&
	       frame.sp == r->sp && frame.pc == r->pc &&
	       memcmp(frame.regs, r->regs, sizeof frame.regs) == 0;
}

static void find_call(pid_t tid, struct arch_regs *regs)
{
	const int nr = (int)regs->r.regs[8];
	unsigned long long argument;
	uint32_t code[2];
	long word;

	if (nr < 0 || nr >= CALLS_MAX)
		return;
	errno = 0;
	word = ptrace(PTRACE_PEEKTEXT, tid, (void *)(regs->r.pc - 4), NULL);
	if (errno)
		return;
	memcpy(code, &word, sizeof code);
	if (code[1] == SVC) {
		regs->nr = nr;
		regs->result = answer_of(regs);
		regs->r.pc += ARCH_SYSCALL_BYTES;
	} else if (code[0] == SVC &&
		   ((long)regs->r.regs[0] == -EINTR
			    ? !has_been_in_handler(tid, &regs->r)
			    : nr == SYS_recvmmsg || nr == SYS_clone || nr == SYS_clone3) &&
		   first_argument(tid, nr, &argument) == 0) {
		regs->nr = nr;
		regs->result = (long)regs->r.regs[0];
		regs->r.regs[0] = argument;
	}
}

int arch_regs_get(pid_t tid, struct arch_regs *regs)
{
	int nr = -1;

	memset(regs, 0, sizeof *regs);
	if (regset(tid, PTRACE_GETREGSET, NT_PRSTATUS, &regs->r, sizeof regs->r) ||
	    regset(tid, PTRACE_GETREGSET, NT_ARM_TLS, &regs->tls, sizeof regs->tls) ||
	    regset(tid, PTRACE_GETREGSET, NT_ARM_SYSTEM_CALL, &nr, sizeof nr))
		return -1;
	regs->nr = nr;
	regs->result = (long)regs->r.regs[0];
	if (nr < 0)
		find_call(tid, regs);
	errno = 0;
	return 0;
}

int arch_regs_set(pid_t tid, const struct arch_regs *regs)
{
	const int none = -1;
	struct arch_regs r = *regs;

	arch_resume(&r);
	return regset(tid, PTRACE_SETREGSET, NT_ARM_SYSTEM_CALL, (void *)&none, sizeof none) ||
			       regset(tid, PTRACE_SETREGSET, NT_ARM_TLS, &r.tls, sizeof r.tls) ||
			       regset(tid, PTRACE_SETREGSET, NT_PRSTATUS, &r.r, sizeof r.r)
		       ? -1
		       : 0;
}

int arch_result_set(pid_t tid, long result)
{
	struct arch_regs regs;

	if (arch_regs_get(tid, &regs))
		return -1;
	if (regs.nr < 0)
		regs.r.regs[0] = (unsigned long long)result;
	regs.result = result;
	return arch_regs_set(tid, &regs);
}

int arch_call_mark_set(pid_t tid, struct arch_regs *regs, uint32_t mark)
{
	regs->r.regs[8] = (uint64_t)mark << 32 | (uint32_t)regs->nr;
	return arch_regs_set(tid, regs);
}

bool arch_is_native(const struct arch_regs *regs)
{
	return !(regs->r.pstate & PSTATE_MODE); /* EL0t; AArch32 has a bit of its own in it */
}

void arch_rewind(struct arch_regs *regs)
{
	if (regs->nr >= 0 && is_again(regs->result)) {
		regs->r.pc -= ARCH_SYSCALL_BYTES;
		if (!(regs->r.regs[8] >> 32))
			regs->r.regs[8] = (unsigned long long)regs->nr;
	} else if (regs->nr >= 0) {
		regs->r.regs[0] = (unsigned long long)regs->result;
		if (regs->r.regs[8] >> 32) /* marked: it was rewound, and is over */
			regs->r.regs[8] = (unsigned long long)regs->nr;
	}
	regs->nr = -1;
}

void arch_call_rest(struct arch_regs *regs, avc_remote place)
{
	(void)regs, (void)place;
}

void arch_resume(struct arch_regs *regs)
{
	if (regs->nr >= 0 && regs->result == -ERESTART_RESTARTBLOCK)
		arch_syscall_nr_set(regs, SYS_restart_syscall);
	arch_rewind(regs);
}

bool arch_may_continue(long nr)
{
	return nr == SYS_nanosleep || nr == SYS_clock_nanosleep || nr == SYS_futex;
}

/* One with an absolute deadline is restarted: it ends at the same moment. */
void arch_note_slept(struct arch_regs *regs)
{
	const bool relative = regs->nr == SYS_nanosleep ||
			      (regs->nr == SYS_clock_nanosleep && !regs->r.regs[1]) ||
			      (regs->nr == SYS_futex && regs->r.regs[3] &&
			       !((unsigned int)regs->r.regs[1] & 127)); /* FUTEX_WAIT */

	if (relative && regs->result == -ERESTARTNOHAND)
		regs->result = -ERESTART_RESTARTBLOCK;
}

bool arch_is_syscall(const uint8_t code[ARCH_SYSCALL_BYTES])
{
	uint32_t word;

	memcpy(&word, code, sizeof word);
	return word == SVC;
}

long arch_syscall_nr_before(const uint8_t code[ARCH_CODE_BYTES])
{
	uint32_t word[2];

	memcpy(word, code, sizeof word);
	/* mov x8, #nr or mov w8, #nr; svc #0 */
	if (word[1] != SVC || (word[0] & 0x7fe0001fU) != 0x52800008U)
		return -1;
	return word[0] >> 5 & 0xffff;
}

void arch_enter(struct arch_regs *regs, const struct arch_regs *base, avc_remote pc, uint64_t a,
		uint64_t b)
{
	*regs = *base;
	regs->nr = -1;
	regs->r.pc = pc;
	regs->r.pstate &= ~UINT64_C(0xc00); /* no indirect branch leads here (BTI) */
	regs->r.regs[0] = a;
	regs->r.regs[1] = b;
}

void arch_call(struct arch_regs *regs, const struct arch_regs *base, avc_remote pc, avc_remote sp,
	       uint64_t arg)
{
	arch_enter(regs, base, pc, arg, arg);
	regs->r.sp = sp & ~UINT64_C(15);
	regs->r.regs[29] = 0;
	regs->r.regs[30] = 0;
}

/* ---- extended state and signal frames ------------------------------------ */

#define FPSIMD_MAGIC 0x46508001U
#define SVE_MAGIC 0x53564501U
#define FPSIMD_BYTES 528
#define SVE_IS_SVE 1  /* user_sve_header.flags: SVE_PT_REGS_SVE */
#define SVE_VL_MAX 96 /* what is left of the frame has no room for more */
#define SVE_ROOM 16384

struct sve_header {
	uint32_t bytes, bytes_max;
	uint16_t vl, vl_max, flags, reserved;
};

struct sve_record {
	uint32_t magic, bytes;
	uint16_t vl, flags, reserved[2];
};

/* A stack_t that leaves the alternate stack unchanged: rt_sigreturn(2) ignores that it is refused
 * (kernel/signal.c, restore_altstack()). */
#define NO_ALTSTACK (UINT64_C(0x7f))

static void fill_frame(struct inj_home *frame, const struct arch_regs *regs, uint64_t sigmask)
{
	_Static_assert(offsetof(struct inj_home, end) - offsetof(struct inj_home, fp_magic) ==
			       FPSIMD_BYTES,
		       "home.h");

	memset(frame, 0, offsetof(struct inj_home, fpsr));
	frame->altstack[1] = NO_ALTSTACK;
	frame->sigmask = sigmask;
	memcpy(frame->regs, regs->r.regs, sizeof frame->regs);
	frame->sp = regs->r.sp;
	frame->pc = regs->r.pc;
	frame->pstate = regs->r.pstate;
	frame->fp_magic = FPSIMD_MAGIC;
	frame->fp_bytes = FPSIMD_BYTES;
}

void arch_home_set(struct inj_home *home, const struct arch_regs *regs, uint64_t sigmask)
{
	fill_frame(home, regs, sigmask);
	memset(home->end, 0, sizeof home->end);
}

size_t arch_xstate_bytes(void)
{
	return FPSIMD_BYTES;
}

size_t arch_frame_bytes(void)
{
	return (FRAME_BYTES + 63) & ~(size_t)63;
}

static int read_fpsimd(pid_t tid, struct inj_home *frame)
{
	struct user_fpsimd_struct fp;

	if (regset(tid, PTRACE_GETREGSET, NT_PRFPREG, &fp, sizeof fp))
		return -1;
	memcpy(frame->vregs, fp.vregs, sizeof frame->vregs);
	frame->fpsr = fp.fpsr;
	frame->fpcr = fp.fpcr;
	return 0;
}

static bool has_sve(void)
{
	return getauxval(AT_HWCAP) & HWCAP_SVE_;
}

/* Nothing but the header; its flags say whether there is more than the 128 bits of each. */
static int read_sve_header(pid_t tid, struct sve_header *header)
{
	return regset(tid, PTRACE_GETREGSET, NT_ARM_SVE_, header, sizeof *header);
}

bool arch_is_delicate(pid_t tid)
{
	struct sve_header sve;

	return has_sve() && read_sve_header(tid, &sve) == 0 && sve.flags & SVE_IS_SVE;
}

static int refuse_sme(pid_t tid)
{
	struct sve_header header;

	if (!(getauxval(AT_HWCAP2) & HWCAP2_SME_))
		return 0;
	if (regset(tid, PTRACE_GETREGSET, NT_ARM_SSVE_, &header, sizeof header) ||
	    header.flags & SVE_IS_SVE ||
	    regset(tid, PTRACE_GETREGSET, NT_ARM_ZA_, &header, sizeof header) ||
	    header.bytes > sizeof header) {
		errno = ENOTSUP;
		return -1;
	}
	return 0;
}

static int read_sve(pid_t tid, uint8_t *to)
{
	static __thread _Alignas(16) uint8_t data[SVE_ROOM];
	struct sve_header header;
	struct sve_record record = { .magic = SVE_MAGIC };
	size_t bytes;

	if (read_sve_header(tid, &header))
		return -1;
	if (!(header.flags & SVE_IS_SVE))
		return 0;
	if (header.vl > SVE_VL_MAX || header.vl % 16 || header.bytes > sizeof data) {
		errno = ENOTSUP;
		return -1;
	}
	if (regset(tid, PTRACE_GETREGSET, NT_ARM_SVE_, data, header.bytes))
		return -1;
	/* Z0 to Z31, P0 to P15 and FFR: in both one behind the other. */
	bytes = (size_t)header.vl * 32 + (size_t)header.vl / 8 * 17;
	record.vl = header.vl;
	record.bytes = (uint32_t)((sizeof record + bytes + 15) & ~(size_t)15);
	memcpy(to, &record, sizeof record);
	memcpy(to + sizeof record, data + sizeof header, bytes);
	memset(to + record.bytes, 0, 16);
	return 0;
}

int arch_frame_read_xstate(pid_t tid, void *frame)
{
	struct inj_home *f = frame;

	memset(f->end, 0, sizeof f->end);
	if (read_fpsimd(tid, f) || refuse_sme(tid))
		return -1;
	return has_sve() ? read_sve(tid, (uint8_t *)f->end) : 0;
}

bool arch_frame_needs_room(const void *frame)
{
	uint32_t magic;

	memcpy(&magic, (const uint8_t *)frame + HOME_SVE, sizeof magic);
	return magic == SVE_MAGIC;
}

avc_remote arch_frame_build(void *frame, avc_remote remote, const struct arch_regs *regs,
			    uint64_t sigmask, const uint64_t altstack[3])
{
	struct inj_home *f = frame;
	struct arch_regs r = *regs;

	arch_rewind(&r);
	fill_frame(f, &r, sigmask);
	memcpy(f->altstack, altstack, sizeof f->altstack);
	return remote;
}

bool arch_signal_frame_find(const uint8_t *stack, size_t bytes, avc_remote at, size_t *next,
			    struct arch_signal_frame *found)
{
	const size_t needed = offsetof(struct inj_home, fpsr);

	for (; *next + needed <= bytes; *next += 16) {
		const struct inj_home *f = (const struct inj_home *)(stack + *next);
		uint32_t signal;

		/* arch/arm64/kernel/signal.c, setup_sigframe(): this record comes first. */
		if (f->uc_flags || f->uc_link || f->pstate & PSTATE_MODE ||
		    f->fp_magic != FPSIMD_MAGIC || f->fp_bytes != FPSIMD_BYTES)
			continue;
		memcpy(&signal, f->siginfo, sizeof signal);
		found->at = at + *next + offsetof(struct inj_home, uc_flags);
		found->sigmask = f->sigmask;
		found->pc = f->pc;
		found->signal = signal <= 64 ? (int)signal : 0;
		*next += 16;
		return true;
	}
	return false;
}

/* ---- the stub ------------------------------------------------------------- */

/* As on x86-64; what is behind 2: goes home.  rt_sigreturn(2) does not look at the siginfo with
 * which a frame begins: the stub itself is in its place. */
#define STUB_LAST 36
static const uint32_t stub_code[] = {
	SVC,        /*    svc #0                        */
	0xb4000120, /*    cbz x0, 1f                    */
	0xb7f80180, /*    tbnz x0, #63, 2f              */
	0xd2800001, /*    mov x1, #0                    */
	0x52a80002, /*    mov w2, #__WALL               */
	0xd2800003, /*    mov x3, #0                    */
	0xd2802088, /*    mov x8, #wait4                */
	SVC,        /*    svc #0                        */
	0x14000006, /*    b 2f                          */
	SVC,        /*    svc #0 (STUB_LAST)            */
	0xd2800000, /* 1: mov x0, #0                    */
	0xd2800ba8, /*    mov x8, #exit                 */
	SVC,        /*    svc #0                        */
	0x17fffffd, /*    b 1b                          */
	0x10fffe40, /* 2: adr x0, the beginning         */
	0x9100001f, /*    mov sp, x0                    */
	0xd2801168, /*    mov x8, #rt_sigreturn         */
	SVC,        /*    svc #0                        */
	0xd4200000, /*    brk #0                        */
};
_Static_assert(SYS_wait4 == 260 && SYS_exit == 93 && SYS_rt_sigreturn == 139, "stub_code");
_Static_assert(sizeof stub_code <= sizeof((struct inj_home *)0)->siginfo, "stub_code");
_Static_assert(sizeof(struct inj_home) <= ARCH_STUB_BYTES, "arch_cpu.h");

size_t arch_stub_build(uint8_t *code, const struct arch_regs *regs, uint64_t sigmask)
{
	struct inj_home frame;

	memset(&frame, 0, sizeof frame);
	fill_frame(&frame, regs, sigmask);
	memcpy(frame.siginfo, stub_code, sizeof stub_code);
	memcpy(code, &frame, sizeof frame);
	return sizeof frame;
}

int arch_stub_read_xstate(pid_t tid, uint8_t *code)
{
	struct inj_home frame;

	memcpy(&frame, code, sizeof frame);
	if (read_fpsimd(tid, &frame))
		return -1;
	memcpy(code, &frame, sizeof frame);
	return 0;
}

bool arch_is_stub(const uint8_t *code)
{
	return memcmp(code, stub_code, sizeof stub_code) == 0;
}

void arch_stub_call(struct arch_regs *regs, const struct arch_regs *base, avc_remote stub,
		    bool last, long nr, const uint64_t arg[6])
{
	arch_enter(regs, base, last ? stub + STUB_LAST : stub, 0, 0);
	regs->r.regs[8] = (unsigned long long)nr;
	for (unsigned int i = 0; i < 6; i++)
		regs->r.regs[i] = arg[i];
}
