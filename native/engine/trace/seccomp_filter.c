/* SPDX-License-Identifier: Apache-2.0
 *
 * What a seccomp filter says of a call that has not been made.
 */
#include <linux/seccomp.h>
#include <stddef.h>

#include "seccomp.h"

/* The classic BPF of seccomp(2), with only the number, the architecture and, if it is not ANY, the
 * first argument known. A filter that reads anything else may return anything that is in it. */
#define DEPENDS 0xffff0000U /* no action                                            */

static bool load(uint32_t at, long nr, uint64_t arg, uint32_t *value)
{
	if (at == offsetof(struct seccomp_data, nr))
		*value = (uint32_t)nr;
	else if (at == offsetof(struct seccomp_data, arch))
		*value = ARCH_AUDIT;
	else if (arg != ANY && at == offsetof(struct seccomp_data, args))
		*value = (uint32_t)arg;
	else if (arg != ANY && at == offsetof(struct seccomp_data, args) + 4)
		*value = (uint32_t)(arg >> 32);
	else
		return false;
	return true;
}

static bool compute(uint16_t op, uint32_t operand, uint32_t *a)
{
	switch (op) {
	case BPF_ADD:
		*a += operand;
		return true;
	case BPF_SUB:
		*a -= operand;
		return true;
	case BPF_AND:
		*a &= operand;
		return true;
	case BPF_OR:
		*a |= operand;
		return true;
	case BPF_XOR:
		*a ^= operand;
		return true;
	case BPF_LSH:
		*a = operand < 32 ? *a << operand : 0;
		return true;
	case BPF_RSH:
		*a = operand < 32 ? *a >> operand : 0;
		return true;
	case BPF_NEG:
		*a = -*a;
		return true;
	default:
		return false;
	}
}

static bool compare(uint16_t op, uint32_t a, uint32_t operand)
{
	switch (op) {
	case BPF_JEQ:
		return a == operand;
	case BPF_JGT:
		return a > operand;
	case BPF_JGE:
		return a >= operand;
	default:
		return a & operand; /* BPF_JSET */
	}
}

static uint32_t run(const struct filter *filter, long nr, uint64_t arg)
{
	uint32_t a = 0, x = 0, mem[BPF_MEMWORDS] = { 0 };

	/* All jumps go forward. */
	for (long pc = 0; pc < filter->count; pc++) {
		const struct sock_filter *f = &filter->insn[pc];
		const uint32_t operand = BPF_SRC(f->code) == BPF_X ? x : f->k;
		uint32_t *to = BPF_CLASS(f->code) == BPF_LDX ? &x : &a;

		switch (BPF_CLASS(f->code)) {
		case BPF_LD:
		case BPF_LDX:
			if (BPF_MODE(f->code) == BPF_IMM)
				*to = f->k;
			else if (BPF_MODE(f->code) == BPF_MEM && f->k < BPF_MEMWORDS)
				*to = mem[f->k];
			else if (BPF_MODE(f->code) != BPF_ABS || !load(f->k, nr, arg, to))
				return DEPENDS;
			break;
		case BPF_ST:
		case BPF_STX:
			if (f->k >= BPF_MEMWORDS)
				return DEPENDS;
			mem[f->k] = BPF_CLASS(f->code) == BPF_ST ? a : x;
			break;
		case BPF_ALU:
			if (!compute(BPF_OP(f->code), operand, &a))
				return DEPENDS;
			break;
		case BPF_JMP:
			if (BPF_OP(f->code) == BPF_JA)
				pc += f->k;
			else
				pc += compare(BPF_OP(f->code), a, operand) ? f->jt : f->jf;
			break;
		case BPF_RET:
			return BPF_RVAL(f->code) == BPF_A ? a : f->k;
		default: /* BPF_MISC */
			if (BPF_MISCOP(f->code) == BPF_TAX)
				x = a;
			else
				a = x;
		}
	}
	return DEPENDS;
}

static enum verdict verdict_of(uint32_t result)
{
	switch (result & SECCOMP_RET_ACTION_FULL) {
	case SECCOMP_RET_ALLOW:
	case SECCOMP_RET_LOG:
		return PASSES;
	case SECCOMP_RET_ERRNO:
		return result & SECCOMP_RET_DATA ? REFUSES : ENDS;
	default:
		return ENDS;
	}
}

static bool may_end(const struct filter *filter)
{
	for (long i = 0; i < filter->count; i++)
		if (BPF_CLASS(filter->insn[i].code) == BPF_RET &&
		    (BPF_RVAL(filter->insn[i].code) == BPF_A ||
		     verdict_of(filter->insn[i].k) == ENDS))
			return true;
	return false;
}

enum verdict filter_verdict(const struct filter *filter, const struct kind *kind)
{
	const uint32_t result = run(filter, kind->nr, kind->arg);

	if (result == DEPENDS)
		return may_end(filter) ? ENDS : MAY_REFUSE;
	return verdict_of(result);
}

bool filter_refuses_any(const struct filter *filter, const struct kinds *kinds)
{
	for (size_t i = 0; i < kinds->count; i++)
		if (filter_verdict(filter, &kinds->kind[i]) != PASSES)
			return true;
	return false;
}
