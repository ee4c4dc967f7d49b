/* SPDX-License-Identifier: Apache-2.0
 *
 * modes KIND: a thread whose CPU is in an unusual mode half of the time (x86-64), in which code of
 * somebody else's would not survive.  Beats once in each round.
 *
 *   trap    traps after each instruction (TF), always the same number of times
 *   narrow  executes 32-bit code
 */
#include "victim.h"

#define TRAPPED 300
#define SPUN 300000

static volatile uint64_t traps;

static void handle(int signal)
{
	(void)signal;
	traps++;
}

static void spin(uint64_t rounds)
{
	__asm__ volatile("1: dec %0; jnz 1b" : "+r"(rounds) : : "cc");
}

/* The flags are set before the first of `rounds` rounds, and cleared after the last. */
static void spin_with(uint64_t flags, uint64_t rounds)
{
	uint64_t after;

	__asm__ volatile("lea -128(%%rsp), %%rsp\n"
			 "pushf\n"
			 "or %2, (%%rsp)\n"
			 "popf\n"
			 "1: dec %1\n"
			 "jnz 1b\n"
			 "pushf\n"
			 "pop %0\n"
			 "push %0\n"
			 "andq %3, (%%rsp)\n"
			 "popf\n"
			 "lea 128(%%rsp), %%rsp\n"
			 : "=&r"(after), "+r"(rounds)
			 : "r"(flags), "r"(~flags)
			 : "cc", "memory");
	CHECK((after & flags) == flags, "the flags are %#lx", after);
}

static void trap(void)
{
	static uint64_t usual;

	traps = 0;
	spin_with(0x100, TRAPPED);
	if (!usual)
		usual = traps;
	CHECK(traps == usual, "%lu traps, not %lu", traps, usual);
	spin(TRAPPED * 100);
}

/* Both halves lie below 4 GB, with the stack that the second one has. */
__asm__(".pushsection .rodata\n"
	"narrow:\n"
	"	mov %rsp, 256(%rdi)\n"
	"	lea 3840(%rdi), %rsp\n"
	"	lea 1f-narrow(%rdi), %eax\n"
	"	mov %eax, 264(%rdi)\n"
	"	movw $0x23, 268(%rdi)\n"
	"	lcall *264(%rdi)\n"
	"	mov 256(%rdi), %rsp\n"
	"	ret\n"
	".code32\n"
	"1:	mov $300000, %ecx\n"
	"2:	dec %ecx\n"
	"	jnz 2b\n"
	"	lret\n"
	".code64\n"
	"narrow_end:\n"
	".popsection\n");
extern const uint8_t narrow[], narrow_end[];

static void execute_narrow(void)
{
	static uint8_t *low;

	if (!low) {
		low = mmap(NULL, 4096, PROT_READ | PROT_WRITE | PROT_EXEC,
			   MAP_PRIVATE | MAP_ANONYMOUS | MAP_32BIT, -1, 0);
		must(low != MAP_FAILED, "mmap");
		memcpy(low, narrow, (size_t)(narrow_end - narrow));
	}
	((void (*)(uint8_t *))(uintptr_t)low)(low);
	spin(SPUN);
}

int main(int argc, char **argv)
{
	static const struct {
		const char *name;
		void (*round)(void);
	} kinds[] = { { "trap", trap }, { "narrow", execute_narrow } };
	struct sigaction action = { .sa_handler = handle };

	victim_start(&argc, argv, 1, "KIND");
	must(!sigaction(SIGTRAP, &action, NULL), "sigaction");
	for (size_t i = 0; i < sizeof kinds / sizeof *kinds; i++) {
		if (strcmp(argv[1], kinds[i].name))
			continue;
		kinds[i].round();
		victim_ready();
		for (;;) {
			kinds[i].round();
			beat();
		}
	}
	must(false, "KIND");
}
