/* SPDX-License-Identifier: Apache-2.0
 *
 * fpu N: N threads keep known values in every floating-point and vector register
 * there is, with control words of their own, across long loops and across system
 * calls, and look whether they are still there.
 */
#include <linux/futex.h>
#include <pthread.h>
#include <stddef.h>

#include "victim.h"

struct registers;

/* Loads everything from *in, makes the system call `number` (none if negative)
 * with two arguments, turns `spin` times, and stores everything to *out.  In one
 * piece of assembly: no compiler in between. */
typedef void hold_fn(const struct registers *in, struct registers *out, long number, long a, long b,
		     long spin);

#define TO15 "0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15"
#define TO31 TO15 ",16,17,18,19,20,21,22,23,24,25,26,27,28,29,30,31"

static hold_fn *hold;

#if defined(__x86_64__)
#include "fpu_x86_64.h"
#elif defined(__aarch64__)
#include "fpu_aarch64.h"
#else
#error "fpu knows no registers of this CPU"
#endif

static void *keep(void *arg)
{
	uint64_t random = (uint64_t)arg + 99, n;
	uint32_t word = 0;

	for (n = 0;; n++) {
		struct timespec ts = { 0, (long)(next_random(&random) % 3000000) };
		struct registers in, out;
		long number = -1, a = 0, b = 0, spin = 1;

		fill(&in, &random);
		memset(&out, 0, sizeof(out));
		switch (n % 4) {
		case 0:
			spin = 200000 + (long)(next_random(&random) % 200000);
			break;
		case 1:
			number = SYS_nanosleep;
			a = (long)&ts;
			break;
		case 2:
			number = SYS_sched_yield;
			break;
		case 3: /* comes back at once: the word is not 1 */
			number = SYS_futex;
			a = (long)&word;
			b = FUTEX_WAKE | FUTEX_PRIVATE_FLAG;
			break;
		}
		hold(&in, &out, number, a, b, spin);
		compare(&in, &out, number);
		CHECK(number < 0 || out.result == 0, "system call %ld answered %ld", number,
		      out.result);
		count(0, 1);
	}
	return NULL;
}

int main(int argc, char **argv)
{
	long n, i;

	victim_start(&argc, argv, 1, "N");
	choose();
	n = atol(argv[1]);
	for (i = 0; i < n; i++) {
		pthread_t thread;

		must(!pthread_create(&thread, NULL, keep, (void *)i), "pthread_create");
	}
	victim_ready();
	for (;;) {
		beat();
		nap_us(1000);
	}
}
