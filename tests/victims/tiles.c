/* SPDX-License-Identifier: Apache-2.0
 *
 * tiles N: N threads keep known values in the AMX tiles across long loops and across system
 * calls, and look whether they are still there; threads come that use them for the first
 * time, and signals of which the frames have them.  Needs a CPU with AMX.
 */
#include <pthread.h>

#include "victim.h"

#ifdef __x86_64__
#include <cpuid.h>
#include <signal.h>

#define ARCH_REQ_XCOMP_PERM 0x1023
#define TILE_DATA 18
#define TILES 8
#define TILE_BYTES 1024

struct tiles {
	uint8_t byte[TILES][TILE_BYTES];
} __attribute__((aligned(64)));

/* Palette 1: 16 rows of 64 bytes each. */
static const struct {
	uint8_t palette, start_row, reserved[14];
	uint16_t row_bytes[16];
	uint8_t rows[16];
} __attribute__((aligned(64))) layout = {
	.palette = 1,
	.row_bytes = { 64, 64, 64, 64, 64, 64, 64, 64 },
	.rows = { 16, 16, 16, 16, 16, 16, 16, 16 },
};

/* Loads all tiles, makes the system call `number` (none if negative) with two arguments,
 * turns `spin` times, and stores them. */
static long hold(const struct tiles *in, struct tiles *out, long number, long a, long b, long spin)
{
	long result = 0;
	const long row = 64;

	__asm__ volatile("ldtilecfg %[layout]\n"
			 ".irp n,0,1,2,3,4,5,6,7\n"
			 "tileloadd 1024*\\n(%[in],%[row],1), %%tmm\\n\n"
			 ".endr\n"
			 "test %[number], %[number]\n"
			 "js 1f\n"
			 "mov %[number], %%rax\n"
			 "syscall\n"
			 "mov %%rax, %[result]\n"
			 "1: dec %[spin]\n"
			 "jg 1b\n"
			 ".irp n,0,1,2,3,4,5,6,7\n"
			 "tilestored %%tmm\\n, 1024*\\n(%[out],%[row],1)\n"
			 ".endr\n"
			 "tilerelease\n"
			 : [result] "+r"(result), [spin] "+r"(spin), "+D"(a), "+S"(b)
			 : [layout] "m"(layout), [in] "r"(in), [out] "r"(out), [row] "r"(row),
			   [number] "r"(number)
			 : "rax", "rcx", "r11", "memory", "cc");
	return result;
}

static void turn(uint64_t *random, uint64_t n)
{
	static __thread struct tiles in, out;
	struct timespec ts = { 0, (long)(next_random(random) % 3000000) };
	const bool sleeps = n % 2;
	long result;

	for (size_t i = 0; i < sizeof in; i++)
		((uint8_t *)in.byte)[i] = (uint8_t)(next_random(random) >> 24);
	memset(&out, 0, sizeof out);
	result = hold(&in, &out, sleeps ? SYS_nanosleep : -1, (long)&ts, 0,
		      sleeps ? 1 : (long)(next_random(random) % 400000));
	CHECK(result == 0, "nanosleep answered %ld", result);
	for (int i = 0; i < TILES; i++)
		CHECK(!memcmp(in.byte[i], out.byte[i], TILE_BYTES), "tile %d changed", i);
	count(0, 1);
}

static void *keep(void *arg)
{
	uint64_t random = (uint64_t)arg + 99;

	for (uint64_t n = 0;; n++)
		turn(&random, n);
	return NULL;
}

/* Not used yet at one checkpoint, used at the next. */
static void *begin(void *arg)
{
	uint64_t random = (uint64_t)arg;

	nap_us(20000);
	turn(&random, 0);
	turn(&random, 1);
	return NULL;
}

/* A handler runs on a frame of more than 8 kB. */
static void on_signal(int signal)
{
	(void)signal;
}

int main(int argc, char **argv)
{
	const size_t stack_bytes = 65536;
	stack_t stack = { .ss_sp = malloc(stack_bytes), .ss_size = stack_bytes };
	struct sigaction action = { .sa_handler = on_signal, .sa_flags = SA_ONSTACK };
	uint64_t random = 7;
	unsigned int a, b, c, d = 0;
	long n, i;

	victim_start(&argc, argv, 1, "N");
	__get_cpuid_count(7, 0, &a, &b, &c, &d);
	errno = ENODEV;
	if (!(d >> 24 & 1) || syscall(SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, TILE_DATA))
		unavailable("AMX");
	must(!sigaltstack(&stack, NULL), "sigaltstack");
	sigaction(SIGUSR2, &action, NULL);
	n = atol(argv[1]);
	for (i = 0; i < n; i++) {
		pthread_t thread;

		must(!pthread_create(&thread, NULL, keep, (void *)i), "pthread_create");
	}
	victim_ready();
	for (i = 0;; i++) {
		pthread_t thread;

		CHECK(!pthread_create(&thread, NULL, begin, (void *)i), "pthread_create");
		turn(&random, (uint64_t)i);
		CHECK(raise(SIGUSR2) == 0, "raise");
		CHECK(!pthread_join(thread, NULL), "pthread_join");
		CHECK(!sigaltstack(NULL, &stack) && stack.ss_size == stack_bytes, "another stack");
		beat();
	}
}

#else

int main(void)
{
	errno = ENOSYS;
	unavailable("tiles knows no registers of this CPU");
}

#endif
