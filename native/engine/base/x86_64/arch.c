/* SPDX-License-Identifier: Apache-2.0 */
#include "arch.h"

#include <cpuid.h>
#include <elf.h>
#include <errno.h>
#include <stddef.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/uio.h>

#define USER_CS 0x33
#define FLAG_CF 0x001
#define FLAG_PF 0x004
#define FLAG_AF 0x010
#define FLAG_ZF 0x040
#define FLAG_SF 0x080
#define FLAG_TF 0x100
#define FLAG_DF 0x400
#define FLAG_OF 0x800
/* Injected code has none of these.  With TF it would trap after each instruction, which ends a thread
 * that has blocked the signal for that. */
#define FLAGS_OWN (FLAG_TF | FLAG_DF)

int arch_regs_get(pid_t tid, struct arch_regs *regs)
{
	return ptrace(PTRACE_GETREGS, tid, NULL, &regs->r) == -1 ? -1 : 0;
}

int arch_regs_set(pid_t tid, const struct arch_regs *regs)
{
	return ptrace(PTRACE_SETREGS, tid, NULL, &regs->r) == -1 ? -1 : 0;
}

int arch_result_set(pid_t tid, long result)
{
	long r = ptrace(PTRACE_POKEUSER, tid, offsetof(struct user, regs.rax), result);

	return r == -1 ? -1 : 0;
}

int arch_call_mark_set(pid_t tid, struct arch_regs *regs, uint32_t mark)
{
	regs->r.orig_rax = (uint64_t)mark << 32 | (uint32_t)regs->r.orig_rax;
	return ptrace(PTRACE_POKEUSER, tid, offsetof(struct user, regs.orig_rax),
		      regs->r.orig_rax) == -1
		       ? -1
		       : 0;
}

uint64_t arch_syscall_arg(const struct arch_regs *regs, unsigned int n)
{
	const struct user_regs_struct *r = &regs->r;
	const uint64_t arg[6] = { r->rdi, r->rsi, r->rdx, r->r10, r->r8, r->r9 };

	return n < 6 ? arg[n] : 0;
}

static void arg_set(struct arch_regs *regs, unsigned int n, uint64_t value)
{
	unsigned long long *arg[6] = { &regs->r.rdi, &regs->r.rsi, &regs->r.rdx,
				       &regs->r.r10, &regs->r.r8,  &regs->r.r9 };

	if (n < 6)
		*arg[n] = value;
}

bool arch_is_native(const struct arch_regs *regs)
{
	return regs->r.cs == USER_CS;
}

static void again(struct arch_regs *regs, long nr)
{
	regs->r.rax = (unsigned long long)nr;
	regs->r.rip -= ARCH_SYSCALL_BYTES;
}

void arch_rewind(struct arch_regs *regs)
{
	if (arch_syscall_nr(regs) >= 0) {
		switch (-arch_syscall_result(regs)) {
		case ERESTARTSYS:
		case ERESTARTNOINTR:
		case ERESTARTNOHAND:
		case ERESTART_RESTARTBLOCK:
			again(regs, arch_syscall_nr(regs));
		}
	}
	regs->r.orig_rax = -1ULL;
}

/* If a signal with a handler is pending, the result becomes EINTR, and the call returns its part. */
void arch_call_rest(struct arch_regs *regs, avc_remote place)
{
	const uint64_t part = regs->r.rax;

	regs->r.rdi += part << 32;
	regs->r.rsi += part;
	regs->r.rdx -= part;
	regs->r.rip = place + ARCH_SYSCALL_BYTES;
	regs->r.rax = (unsigned long long)-ERESTARTNOHAND;
	regs->r.orig_rax = (uint32_t)regs->r.orig_rax;
}

void arch_resume(struct arch_regs *regs)
{
	if (arch_syscall_nr(regs) >= 0 && arch_syscall_result(regs) == -ERESTART_RESTARTBLOCK) {
		again(regs, SYS_restart_syscall);
		regs->r.orig_rax = -1ULL;
	} else {
		arch_rewind(regs);
	}
}

bool arch_is_syscall(const uint8_t code[ARCH_SYSCALL_BYTES])
{
	return code[0] == 0x0f && code[1] == 0x05;
}

long arch_syscall_nr_before(const uint8_t code[ARCH_CODE_BYTES])
{
	int32_t nr;

	if (code[0] != 0xb8 || code[5] != 0x0f || code[6] != 0x05) /* mov $nr, %eax; syscall */
		return -1;
	memcpy(&nr, code + 1, sizeof nr);
	return nr;
}

void arch_call(struct arch_regs *regs, const struct arch_regs *base, avc_remote pc, avc_remote sp,
	       uint64_t arg)
{
	*regs = *base;
	regs->r.rip = pc;
	/* As after a call instruction (System V ABI: 16-byte aligned before it). */
	regs->r.rsp = (sp & ~UINT64_C(15)) - 8;
	regs->r.rbp = 0;
	regs->r.rdi = regs->r.rsi = arg;
	regs->r.rax = 0;
	regs->r.orig_rax = -1ULL;
	regs->r.eflags &= ~(unsigned long long)FLAGS_OWN;
}

void arch_enter(struct arch_regs *regs, const struct arch_regs *base, avc_remote pc, uint64_t a,
		uint64_t b)
{
	*regs = *base;
	regs->r.rip = pc;
	regs->r.rdi = a;
	regs->r.rsi = b;
	regs->r.rax = 0;
	regs->r.orig_rax = -1ULL;
	regs->r.eflags &= ~(unsigned long long)FLAGS_OWN;
}

/* What `add $1, %al; sahf` needs in %eax to bring the flags back. */
static uint32_t flags_word(uint64_t eflags)
{
	uint32_t low = eflags & FLAG_OF ? 0x7f : 0;
	uint32_t high = eflags & (FLAG_SF | FLAG_ZF | FLAG_AF | FLAG_PF | FLAG_CF);

	return low | (high | 2) << 8;
}

void arch_home_set(struct inj_home *home, const struct arch_regs *regs, uint64_t sigmask)
{
	const struct user_regs_struct *r = &regs->r;

	*home = (struct inj_home){
		.r15 = r->r15,
		.r14 = r->r14,
		.r13 = r->r13,
		.r12 = r->r12,
		.rbp = r->rbp,
		.rbx = r->rbx,
		.r11 = r->r11,
		.r10 = r->r10,
		.r9 = r->r9,
		.r8 = r->r8,
		.rax = r->rax,
		.rcx = r->rcx,
		.rdx = r->rdx,
		.rsi = r->rsi,
		.rdi = r->rdi,
		.rsp = r->rsp,
		.sigmask = sigmask,
		.flags = flags_word(r->eflags),
		.direction = (r->eflags & FLAG_DF) != 0,
		.rip = r->rip,
	};
}

/* ---- extended state and signal frames ------------------------------------ */

/* The kernel's frame for rt_sigreturn(2) on x86-64 (arch/x86/include/uapi/asm/
 * sigcontext.h, ucontext.h), as seen from the stack pointer at the call. */
struct frame {
	uint64_t uc_flags;
	uint64_t uc_link;
	uint64_t altstack[3]; /* stack_t: sp, flags, size */
	uint64_t r8, r9, r10, r11, r12, r13, r14, r15;
	uint64_t rdi, rsi, rbp, rbx, rdx, rax, rcx, rsp, rip, eflags;
	uint16_t cs, gs, fs, ss;
	uint64_t err, trapno, oldmask, cr2;
	uint64_t fpstate;
	uint64_t reserved[8];
	uint64_t sigmask;
	uint8_t siginfo[128];
};

#define UC_FP_XSTATE 1
#define UC_SIGCONTEXT_SS 2
#define UC_STRICT_RESTORE_SS 4

/* struct _fpx_sw_bytes at offset 464 of the legacy area tells the kernel that
 * an XSAVE image follows. */
#define SW_OFFSET 464
#define SW_MAGIC1 0x46505853U
#define SW_MAGIC2 0x46505845U

struct sw_bytes {
	uint32_t magic1;
	uint32_t extended_bytes;
	uint64_t features;
	uint32_t xstate_bytes;
	uint32_t padding[7];
};

size_t arch_xstate_bytes(void)
{
	/* Queried once: under a hypervisor every cpuid traps, which takes microseconds, and this is
	 * called for each thread of a stopped app. Racing threads write the same value. */
	static size_t bytes;
	unsigned int a, b, c, d;

	/* Leaf 0xd: ebx is the size of the standard format for what XCR0 enables. */
	if (!__atomic_load_n(&bytes, __ATOMIC_RELAXED) && __get_cpuid_count(0xd, 0, &a, &b, &c, &d))
		__atomic_store_n(&bytes, b, __ATOMIC_RELAXED);
	return __atomic_load_n(&bytes, __ATOMIC_RELAXED);
}

/* AMX tile data (arch/x86/kernel/fpu/xstate.c, XFEATURE_MASK_USER_DYNAMIC). A thread has these 8 kB
 * only from their first use, and until then its signal frames are smaller: from one of another size
 * rt_sigreturn(2) restores only the SSE registers. */
#define DYNAMIC (UINT64_C(1) << 18)
#define FEATURES_OFFSET 512 /* of XSTATE_BV */
#define LEGACY_BYTES 576    /* with the header behind it */

static uint64_t enabled_features(void)
{
	uint32_t low, high;

	__asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
	return (uint64_t)high << 32 | low;
}

/* For a thread without tiles. */
static size_t plain_bytes(void)
{
	static size_t bytes; /* see above */
	size_t found = LEGACY_BYTES;

	if (__atomic_load_n(&bytes, __ATOMIC_RELAXED))
		return __atomic_load_n(&bytes, __ATOMIC_RELAXED);
	for (unsigned int i = 2; i < 63; i++) {
		unsigned int size, offset, c, d;

		if ((enabled_features() & ~DYNAMIC) >> i & 1 &&
		    __get_cpuid_count(0xd, i, &size, &offset, &c, &d) && offset + size > found)
			found = offset + size;
	}
	__atomic_store_n(&bytes, found, __ATOMIC_RELAXED);
	return found;
}

bool arch_frame_needs_room(const void *frame)
{
	uint64_t features;

	memcpy(&features, (const uint8_t *)frame + FEATURES_OFFSET, sizeof features);
	return features & DYNAMIC;
}

static size_t xstate_room(void)
{
	return (arch_xstate_bytes() + sizeof(uint32_t) + 63) & ~(size_t)63;
}

size_t arch_frame_bytes(void)
{
	return xstate_room() + ((sizeof(struct frame) + 63) & ~(size_t)63);
}

int arch_frame_read_xstate(pid_t tid, void *frame)
{
	size_t bytes = plain_bytes();

	for (;;) {
		struct iovec iov = { frame, bytes };

		if (ptrace(PTRACE_GETREGSET, tid, NT_X86_XSTATE, &iov) == -1)
			return -1;
		if (iov.iov_len != bytes) {
			errno = EOVERFLOW;
			return -1;
		}
		if (bytes == arch_xstate_bytes() || !arch_frame_needs_room(frame))
			return 0;
		bytes = arch_xstate_bytes();
	}
}

avc_remote arch_frame_build(void *frame, avc_remote remote, const struct arch_regs *regs,
			    uint64_t sigmask, const uint64_t altstack[3])
{
	const struct user_regs_struct *r = &regs->r;
	uint8_t *xstate = frame;
	const bool dynamic = arch_frame_needs_room(frame);
	const size_t bytes = dynamic ? arch_xstate_bytes() : plain_bytes();
	const uint32_t magic2 = SW_MAGIC2;
	struct sw_bytes sw = { .magic1 = SW_MAGIC1,
			       .extended_bytes = (uint32_t)(bytes + sizeof magic2),
			       .xstate_bytes = (uint32_t)bytes };
	struct frame *f = (struct frame *)(xstate + xstate_room());

	/* ptrace stores XCR0 where the signal frame has its feature mask. */
	memcpy(&sw.features, xstate + SW_OFFSET, sizeof sw.features);
	if (!dynamic)
		sw.features &= ~DYNAMIC;
	memcpy(xstate + SW_OFFSET, &sw, sizeof sw);
	memcpy(xstate + bytes, &magic2, sizeof magic2);

	*f = (struct frame){
		.uc_flags = UC_FP_XSTATE | UC_SIGCONTEXT_SS | UC_STRICT_RESTORE_SS,
		.altstack = { altstack[0], altstack[1], altstack[2] },
		.r8 = r->r8,
		.r9 = r->r9,
		.r10 = r->r10,
		.r11 = r->r11,
		.r12 = r->r12,
		.r13 = r->r13,
		.r14 = r->r14,
		.r15 = r->r15,
		.rdi = r->rdi,
		.rsi = r->rsi,
		.rbp = r->rbp,
		.rbx = r->rbx,
		.rdx = r->rdx,
		.rax = r->rax,
		.rcx = r->rcx,
		.rsp = r->rsp,
		.rip = r->rip,
		.eflags = r->eflags,
		.cs = (uint16_t)r->cs,
		.ss = (uint16_t)r->ss,
		.fpstate = remote,
		.sigmask = sigmask,
	};
	return remote + xstate_room();
}

#define USER_SS 0x2b
#define FLAG_FIXED 0x002 /* of eflags: always 1 */
#define FLAGS_KNOWN 0x3fffff
#define XSTATE_NEAR 4096

/* arch/x86/kernel/signal_64.c, x64_setup_rt_frame(): what it stores there is the same for every
 * program. */
static bool is_signal_frame(const struct frame *f, avc_remote at)
{
	return !(f->uc_flags &
		 ~(uint64_t)(UC_FP_XSTATE | UC_SIGCONTEXT_SS | UC_STRICT_RESTORE_SS)) &&
	       !f->uc_link && f->cs == USER_CS && f->ss == USER_SS && f->eflags & FLAG_FIXED &&
	       !(f->eflags & ~(uint64_t)FLAGS_KNOWN) &&
	       (!f->fpstate || (f->fpstate % 64 == 0 && f->fpstate - at < XSTATE_NEAR));
}

static uint32_t signal_of(const struct frame *f)
{
	const uint32_t signal = *(const uint32_t *)f->siginfo;

	return signal <= 64 ? signal : 0;
}

bool arch_signal_frame_find(const uint8_t *stack, size_t bytes, avc_remote at, size_t *next,
			    struct arch_signal_frame *found)
{
	_Static_assert(sizeof(struct frame) <= ARCH_SIGNAL_FRAME_BYTES, "arch.h");

	for (; *next + sizeof(struct frame) <= bytes; *next += 16) {
		const struct frame *f = (const struct frame *)(stack + *next);

		if (!is_signal_frame(f, at + *next))
			continue;
		found->at = at + *next;
		found->sigmask = f->sigmask;
		found->pc = f->rip;
		found->signal = (int)signal_of(f);
		*next += 16;
		return true;
	}
	return false;
}

/* ---- the stub ------------------------------------------------------------- */

struct writer {
	uint8_t *at;
};

static void put(struct writer *w, const void *bytes, size_t n)
{
	memcpy(w->at, bytes, n);
	w->at += n;
}

/* movabs $value, %reg (0 rax, 1 rcx, 2 rdx, 6 rsi, 7 rdi, 8.. r8..) */
static void put_mov(struct writer *w, unsigned int reg, uint64_t value)
{
	const uint8_t op[2] = { reg >= 8 ? 0x49 : 0x48, (uint8_t)(0xb8 + (reg & 7)) };

	put(w, op, 2);
	put(w, &value, sizeof value);
}

/* What follows the system call: a new task exits at once, and its creator waits for it, whether or
 * not it is its child (ECHILD). And a call after which the task exits. Nothing is written to
 * memory. */
/* clang-format off */
#define STUB_LAST 29
static const uint8_t stub_start[] = {
	0x0f, 0x05,                   /*    syscall                       */
	0x85, 0xc0,                   /*    test %eax, %eax               */
	0x74, 0x19,                   /*    jz 1f                         */
	0x78, 0x22,                   /*    js 2f                         */
	0x89, 0xc7,                   /*    mov %eax, %edi                */
	0xb8, SYS_wait4, 0, 0, 0,     /*    wait4(it, NULL, __WALL, NULL) */
	0x31, 0xf6,
	0xba, 0, 0, 0, 0x40,
	0x45, 0x31, 0xd2,
	0x0f, 0x05,
	0xeb, 0x0d,                   /*    jmp 2f                        */
	0x0f, 0x05,                   /*    syscall (STUB_LAST)           */
	0x31, 0xff,                   /* 1: exit(0)                       */
	0xb8, SYS_exit, 0, 0, 0,
	0x0f, 0x05,
	0xeb, 0xf5,                   /*    jmp 1b                        */
};                                    /* 2:                               */
/* clang-format on */

size_t arch_stub_build(uint8_t *code, const struct arch_regs *regs, uint64_t sigmask)
{
	static const uint8_t syscall_insn[2] = { 0x0f, 0x05 };
	static const uint8_t lea_rsi[3] = { 0x48, 0x8d, 0x35 }; /* lea disp(%rip), %rsi */
	static const uint8_t flags[3] = { 0x04, 0x01, 0x9e };   /* add $1, %al; sahf    */
	static const uint8_t jump[2] = { 0xff, 0x25 };          /* jmp *disp(%rip)      */
	const struct user_regs_struct *r = &regs->r;
	struct writer w = { code };
	uint8_t *mask_disp, direction = r->eflags & FLAG_DF ? 0xfd : 0xfc; /* std, cld */
	uint64_t rip = r->rip;
	int32_t disp = 0;

	put(&w, stub_start, sizeof stub_start);
	/* rt_sigprocmask(SIG_SETMASK, &mask, NULL, 8), the stack pointer being the app's own
	 * throughout: a signal may arrive as soon as it returns. */
	put_mov(&w, 0, SYS_rt_sigprocmask);
	put_mov(&w, 7, 2);
	put(&w, lea_rsi, 3);
	mask_disp = w.at;
	put(&w, &disp, 4);
	put_mov(&w, 2, 0);
	put_mov(&w, 10, 8);
	put(&w, syscall_insn, 2);
	put_mov(&w, 0, flags_word(r->eflags));
	put(&w, &direction, 1);
	put(&w, flags, 3);
	put_mov(&w, 0, r->rax);
	put_mov(&w, 1, r->rcx);
	put_mov(&w, 2, r->rdx);
	put_mov(&w, 6, r->rsi);
	put_mov(&w, 7, r->rdi);
	put_mov(&w, 8, r->r8);
	put_mov(&w, 9, r->r9);
	put_mov(&w, 10, r->r10);
	put_mov(&w, 11, r->r11);
	put(&w, jump, 2);
	put(&w, &disp, 4); /* 0: the quad right behind */
	put(&w, &rip, 8);
	disp = (int32_t)(w.at - (mask_disp + 4));
	memcpy(mask_disp, &disp, 4);
	put(&w, &sigmask, 8);
	return (size_t)(w.at - code);
}

bool arch_is_stub(const uint8_t *code)
{
	return memcmp(code, stub_start, sizeof stub_start) == 0;
}

void arch_stub_call(struct arch_regs *regs, const struct arch_regs *base, avc_remote stub,
		    bool last, long nr, const uint64_t arg[6])
{
	*regs = *base;
	regs->r.rip = last ? stub + STUB_LAST : stub;
	regs->r.eflags &= ~(unsigned long long)FLAGS_OWN;
	regs->r.orig_rax = -1ULL;
	regs->r.rax = (unsigned long long)nr;
	for (unsigned int i = 0; i < 6; i++)
		arg_set(regs, i, arg[i]);
}
