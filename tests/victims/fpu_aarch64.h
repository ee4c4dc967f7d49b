/* SPDX-License-Identifier: Apache-2.0
 *
 * fpu.c, aarch64: the vector registers, with SVE in all their length and the predicates (which no
 * system call keeps: arch/arm64/sve.rst), and what controls them.
 */
#ifndef FPU_AARCH64_H
#define FPU_AARCH64_H

#include <sys/auxv.h>
#include <sys/prctl.h>

#define VECTOR_BYTES_MAX 256
#define NEON_BYTES 16
#define FPCR_KEPT UINT64_C(0x03c00000) /* rounding, FZ, DN                                  */
#define FPSR_KEPT UINT64_C(0x0800009f) /* what has happened, and saturated                  */

struct registers {
	uint8_t vector[32][VECTOR_BYTES_MAX];
	uint8_t predicate[16][VECTOR_BYTES_MAX / 8];
	uint64_t fpcr, fpsr;
	int64_t result; /* of the system call */
};
_Static_assert(offsetof(struct registers, predicate) == 8192, "as the assembly has it");
_Static_assert(offsetof(struct registers, fpcr) == 8704, "as the assembly has it");
_Static_assert(offsetof(struct registers, fpsr) == 8712, "as the assembly has it");
_Static_assert(offsetof(struct registers, result) == 8720, "as the assembly has it");

hold_fn hold_neon, hold_sve;

#define HOLD(name, load, store)                                                                    \
	__asm__(".text\n.arch armv8.2-a+sve\n"                                                     \
		".globl " #name "\n.type " #name ", @function\n" #name ":\n"                       \
		"stp d8, d9, [sp, #-128]!\n stp d10, d11, [sp, #16]\n"                             \
		"stp d12, d13, [sp, #32]\n stp d14, d15, [sp, #48]\n"                              \
		"stp x19, x20, [sp, #64]\n stp x21, x22, [sp, #80]\n"                              \
		"mrs x9, fpcr\n mrs x10, fpsr\n stp x9, x10, [sp, #96]\n"                          \
		"mov x19, x0\n mov x20, x1\n mov x21, x2\n mov x22, x5\n"                          \
		"ldr x9, [x19, #8704]\n msr fpcr, x9\n ldr x9, [x19, #8712]\n msr fpsr, x9\n" load \
		"tbnz x21, #63, 1f\n"                                                              \
		"mov x8, x21\n mov x0, x3\n mov x1, x4\n mov x2, #0\n mov x3, #0\n"                \
		"svc #0\n str x0, [x20, #8720]\n"                                                  \
		"1: subs x22, x22, #1\n b.gt 1b\n" store                                           \
		"mrs x9, fpcr\n str x9, [x20, #8704]\n mrs x9, fpsr\n str x9, [x20, #8712]\n"      \
		"ldp x9, x10, [sp, #96]\n msr fpcr, x9\n msr fpsr, x10\n"                          \
		"ldp x21, x22, [sp, #80]\n ldp x19, x20, [sp, #64]\n"                              \
		"ldp d14, d15, [sp, #48]\n ldp d12, d13, [sp, #32]\n"                              \
		"ldp d10, d11, [sp, #16]\n ldp d8, d9, [sp], #128\n ret\n"                         \
		".size " #name ", .-" #name "\n.arch armv8-a\n")

#define EACH(registers, place, bytes, does) \
	".irp n," registers "\nmov x10, #" place "+" bytes "*\\n\n" does "\n.endr\n"

HOLD(hold_neon, EACH(TO31, "0", "256", "ldr q\\n, [x19, x10]"),
     EACH(TO31, "0", "256", "str q\\n, [x20, x10]"));
HOLD(hold_sve,
     EACH(TO31, "0", "256", "add x9, x19, x10\nldr z\\n, [x9]")
	     EACH(TO15, "8192", "32", "add x9, x19, x10\nldr p\\n, [x9]"),
     EACH(TO31, "0", "256", "add x9, x20, x10\nstr z\\n, [x9]")
	     EACH(TO15, "8192", "32", "add x9, x20, x10\nstr p\\n, [x9]"));

static int vector_bytes = NEON_BYTES;

static void fill(struct registers *r, uint64_t *random)
{
	memset(r, 0, sizeof(*r));
	for (int i = 0; i < 32; i++)
		for (int k = 0; k < vector_bytes; k++)
			r->vector[i][k] = (uint8_t)(next_random(random) >> 24);
	for (int i = 0; i < 16; i++)
		for (int k = 0; k < vector_bytes / 8; k++)
			r->predicate[i][k] = (uint8_t)(next_random(random) >> 24);
	r->fpcr = next_random(random) & FPCR_KEPT;
	r->fpsr = next_random(random) & FPSR_KEPT;
}

static void compare(const struct registers *in, const struct registers *out, long number)
{
	const int bytes = number < 0 ? vector_bytes : NEON_BYTES;

	for (int i = 0; i < 32; i++)
		CHECK(!memcmp(in->vector[i], out->vector[i], (size_t)bytes),
		      "vector register %d changed (system call %ld)", i, number);
	for (int i = 0; i < 16 && bytes > NEON_BYTES; i++)
		CHECK(!memcmp(in->predicate[i], out->predicate[i], (size_t)bytes / 8),
		      "p%d changed (system call %ld)", i, number);
	CHECK(in->fpcr == (out->fpcr & FPCR_KEPT), "FPCR was %lx, is %lx", in->fpcr, out->fpcr);
	CHECK(in->fpsr == (out->fpsr & FPSR_KEPT), "FPSR was %lx, is %lx", in->fpsr, out->fpsr);
}

static void choose(void)
{
	hold = hold_neon;
	if (getauxval(AT_HWCAP) & HWCAP_SVE) {
		hold = hold_sve;
		vector_bytes = prctl(PR_SVE_GET_VL) & PR_SVE_VL_LEN_MASK;
	}
	board->counter[1] = (uint64_t)vector_bytes;
}

#endif
