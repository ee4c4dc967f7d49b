/* SPDX-License-Identifier: Apache-2.0
 *
 * fpu.c, x86-64: vector registers as wide as this CPU has them, masks, the x87 stack, and control words.
 */
#ifndef FPU_X86_64_H
#define FPU_X86_64_H

struct registers {
	uint8_t vector[32][64];
	uint64_t mask[8];
	uint8_t x87[8][16]; /* 10 bytes used */
	uint32_t mxcsr;
	uint16_t control;
	uint16_t unused;
	int64_t result; /* of the system call */
} __attribute__((aligned(64)));
_Static_assert(offsetof(struct registers, x87) == 2112, "as the assembly has it");
_Static_assert(offsetof(struct registers, mxcsr) == 2240, "as the assembly has it");
_Static_assert(offsetof(struct registers, control) == 2244, "as the assembly has it");
_Static_assert(offsetof(struct registers, result) == 2248, "as the assembly has it");

hold_fn hold_sse, hold_avx, hold_avx512;

#define HOLD(name, load, store, finish)                                            \
	__asm__(".text\n"                                                          \
		".globl " #name "\n"                                               \
		".type " #name ", @function\n" #name ":\n"                         \
		"push %rbx; push %r12; push %r13; push %r14; push %r15\n"          \
		"sub $16, %rsp\n"                                                  \
		"stmxcsr (%rsp); fnstcw 8(%rsp)\n"                                 \
		"mov %rdi, %r12; mov %rsi, %r13; mov %rdx, %r14\n"                 \
		"mov %rcx, %rbx; mov %r9, %r15\n"                                  \
		"fninit; fldcw 2244(%r12); ldmxcsr 2240(%r12)\n"                   \
		".irp n,7,6,5,4,3,2,1,0\n"                                         \
		"fldt 2112+16*\\n(%r12)\n"                                         \
		".endr\n" load "test %r14, %r14; js 1f\n"                          \
		"mov %r14, %rax; mov %rbx, %rdi; mov %r8, %rsi\n"                  \
		"xor %edx, %edx; xor %r10d, %r10d\n"                               \
		"syscall\n"                                                        \
		"mov %rax, 2248(%r13)\n"                                           \
		"1: dec %r15; jg 1b\n" store ".irp n,0,1,2,3,4,5,6,7\n"            \
		"fstpt 2112+16*\\n(%r13)\n"                                        \
		".endr\n"                                                          \
		"stmxcsr 2240(%r13); fnstcw 2244(%r13)\n"                          \
		"fninit; fldcw 8(%rsp); ldmxcsr (%rsp)\n" finish "add $16, %rsp\n" \
		"pop %r15; pop %r14; pop %r13; pop %r12; pop %rbx\n"               \
		"ret\n"                                                            \
		".size " #name ", .-" #name "\n")

HOLD(hold_sse, ".irp n," TO15 "\nmovdqu 64*\\n(%r12), %xmm\\n\n.endr\n",
     ".irp n," TO15 "\nmovdqu %xmm\\n, 64*\\n(%r13)\n.endr\n", "");
HOLD(hold_avx, ".irp n," TO15 "\nvmovdqu 64*\\n(%r12), %ymm\\n\n.endr\n",
     ".irp n," TO15 "\nvmovdqu %ymm\\n, 64*\\n(%r13)\n.endr\n", "vzeroupper\n");
HOLD(hold_avx512,
     ".irp n," TO31 "\nvmovdqu64 64*\\n(%r12), %zmm\\n\n.endr\n"
     ".irp n,0,1,2,3,4,5,6,7\nkmovq 2048+8*\\n(%r12), %k\\n\n.endr\n",
     ".irp n," TO31 "\nvmovdqu64 %zmm\\n, 64*\\n(%r13)\n.endr\n"
     ".irp n,0,1,2,3,4,5,6,7\nkmovq %k\\n, 2048+8*\\n(%r13)\n.endr\n",
     "vzeroupper\n");

static int vectors, vector_bytes, masks;

static void fill(struct registers *r, uint64_t *random)
{
	size_t i;

	memset(r, 0, sizeof(*r));
	for (i = 0; i < sizeof(r->vector); i++)
		((uint8_t *)r->vector)[i] = (uint8_t)(next_random(random) >> 24);
	for (i = 0; i < 8; i++) {
		/* A normal number: the top bit of the mantissa is set. */
		uint64_t mantissa = next_random(random) | UINT64_C(1) << 63;
		uint16_t exponent = (uint16_t)(0x3fff + next_random(random) % 1000);

		r->mask[i] = next_random(random);
		memcpy(r->x87[i], &mantissa, 8);
		memcpy(r->x87[i] + 8, &exponent, 2);
	}
	/* Exceptions masked; rounding, flush-to-zero, precision as it comes. */
	r->mxcsr = 0x1f80 | (uint32_t)(next_random(random) % 4) << 13 |
		   (uint32_t)(next_random(random) % 2) << 15;
	r->control = (uint16_t)(0x007f | (next_random(random) % 4) << 10 |
				(next_random(random) % 2 ? 0x300 : 0x200));
}

static void compare(const struct registers *in, const struct registers *out, long number)
{
	int i;

	for (i = 0; i < vectors; i++)
		CHECK(!memcmp(in->vector[i], out->vector[i], (size_t)vector_bytes),
		      "vector register %d changed (system call %ld)", i, number);
	for (i = 0; i < masks; i++)
		CHECK(in->mask[i] == out->mask[i], "k%d changed (system call %ld)", i, number);
	for (i = 0; i < 8; i++)
		CHECK(!memcmp(in->x87[i], out->x87[i], 10), "st(%d) changed (system call %ld)", i,
		      number);
	CHECK((in->mxcsr & 0xffc0) == (out->mxcsr & 0xffc0), "MXCSR was %x, is %x", in->mxcsr,
	      out->mxcsr);
	CHECK(in->control == out->control, "x87 control word was %x, is %x", in->control,
	      out->control);
}

static void choose(void)
{
	if (__builtin_cpu_supports("avx512bw")) {
		hold = hold_avx512;
		vectors = 32;
		vector_bytes = 64;
		masks = 8;
	} else if (__builtin_cpu_supports("avx")) {
		hold = hold_avx;
		vectors = 16;
		vector_bytes = 32;
	} else {
		hold = hold_sse;
		vectors = 16;
		vector_bytes = 16;
	}
	board->counter[1] = (uint64_t)vector_bytes;
}

#endif
