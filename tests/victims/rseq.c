/* SPDX-License-Identifier: Apache-2.0
 *
 * rseq N: N threads count per CPU inside restartable sequences (rseq(2)), on the
 * area that glibc has registered, and hop from CPU to CPU.  A sequence that goes
 * on where it must start again, or an area that the kernel no longer knows, loses
 * counts or shows a wrong CPU.
 */
#include <pthread.h>
#include <sched.h>
#include <stddef.h>
#include <sys/rseq.h>

#include "victim.h"

enum { CPUS = 1024, ROUND = 20000, SPREAD = 8 /* a cache line per counter */ };

static uint64_t counters[CPUS * SPREAD];
static volatile uint64_t *rounds_done;
static pthread_barrier_t barrier;
static long threads;
static cpu_set_t allowed;
static _Thread_local uint64_t aborts;

static struct rseq *area(void)
{
	return (struct rseq *)((char *)__builtin_thread_pointer() + __rseq_offset);
}

/* The instructions of try_count(); SIGNATURE is RSEQ_SIG, in front of where it is aborted to. */
#ifdef __x86_64__
#define ENTER "leaq 3b(%%rip), %%rax; movq %%rax, %c[cs](%[rs])\n"
#define COUNT                                      \
	"cmpl %[cpu], %c[id](%[rs]); jne 4f\n"     \
	"movq (%[counter]), %%rax\n"               \
	"movl $60, %%ecx; 5: decl %%ecx; jnz 5b\n" \
	"incq %%rax; movq %%rax, (%[counter])\n"
#define SIGNATURE ".byte 0x0f, 0xb9, 0x3d; .long 0x53053053\n"
#define JUMP "jmp"
#define CHANGED "rax", "rcx"
#else /* aarch64 */
#define ENTER "adrp x9, 3b; add x9, x9, :lo12:3b; str x9, [%[rs], %[cs]]\n"
#define COUNT                                                \
	"ldr w9, [%[rs], %[id]]; cmp w9, %w[cpu]; b.ne 4f\n" \
	"ldr x9, [%[counter]]\n"                             \
	"mov w10, #60; 5: subs w10, w10, #1; b.ne 5b\n"      \
	"add x9, x9, #1; str x9, [%[counter]]\n"
#define SIGNATURE ".inst 0xd428bc00\n"
#define JUMP "b"
#define CHANGED "x9", "x10"
#endif

/* One more for the CPU we are on, if nothing happens to us in the middle.  The
 * pause between reading and writing makes it likely that something does. */
static bool try_count(struct rseq *rs, uint32_t cpu)
{
	uint64_t *counter = &counters[cpu * SPREAD];

	__asm__ goto(
		".pushsection __rseq_cs, \"aw\"\n"
		".balign 32\n"
		"3: .long 0, 0\n"
		".quad 1f, 2f - 1f, 4f\n"
		".popsection\n" ENTER "1:\n" COUNT "2:\n"
		".pushsection __rseq_abort, \"ax\"\n" SIGNATURE "4: " JUMP " %l[aborted]\n"
		".popsection\n"
		:
		: [rs] "r"(rs), [cpu] "r"(cpu), [counter] "r"(counter),
		  [cs] "i"(offsetof(struct rseq, rseq_cs)), [id] "i"(offsetof(struct rseq, cpu_id))
		: CHANGED, "memory", "cc"
		: aborted);
	return true;
aborted:
	aborts++;
	return false;
}

static void check_area(struct rseq *rs)
{
	uint32_t cpu = __atomic_load_n(&rs->cpu_id, __ATOMIC_RELAXED);

	CHECK(cpu < CPUS && CPU_ISSET(cpu, &allowed), "rseq says CPU %d", (int)cpu);
}

/* After a move the kernel has to have told us. */
static void hop(struct rseq *rs, uint64_t *random)
{
	cpu_set_t one;
	uint32_t cpu;

	do
		cpu = (uint32_t)(next_random(random) % CPUS);
	while (!CPU_ISSET(cpu, &allowed));
	CPU_ZERO(&one);
	CPU_SET(cpu, &one);
	CHECK(sched_setaffinity(0, sizeof(one), &one) == 0, "sched_setaffinity: %s",
	      strerror(errno));
	CHECK(__atomic_load_n(&rs->cpu_id, __ATOMIC_RELAXED) == cpu,
	      "moved to CPU %u, rseq says %u, getcpu %d", cpu, rs->cpu_id, sched_getcpu());
	CHECK(sched_setaffinity(0, sizeof(allowed), &allowed) == 0, "sched_setaffinity: %s",
	      strerror(errno));
}

static void *work(void *arg)
{
	struct rseq *rs = area();
	uint64_t random = (uint64_t)arg + 7;
	cpu_set_t mine;

	for (;;) {
		int i;

		for (i = 0; i < ROUND; i++) {
			while (!try_count(rs, __atomic_load_n(&rs->cpu_id, __ATOMIC_RELAXED)))
				check_area(rs);
			if (i % 500 == 0)
				hop(rs, &random);
		}
		CHECK(area() == rs, "the rseq area moved");
		CHECK(sched_getaffinity(0, sizeof(mine), &mine) > -1 && CPU_EQUAL(&mine, &allowed),
		      "the affinity changed");
		count(1, aborts);
		aborts = 0;
		/* Everybody has finished a round: the sums must agree.  One looks,
		 * then all go on. */
		if (pthread_barrier_wait(&barrier) == PTHREAD_BARRIER_SERIAL_THREAD) {
			uint64_t sum = 0, wanted = ++*rounds_done * (uint64_t)threads * ROUND;

			for (i = 0; i < CPUS; i++)
				sum += counters[i * SPREAD];
			CHECK(sum == wanted, "counted %lu, should be %lu", sum, wanted);
			count(0, 1);
		}
		pthread_barrier_wait(&barrier);
	}
	return NULL;
}

int main(int argc, char **argv)
{
	static volatile uint64_t done;
	long i;

	victim_start(&argc, argv, 1, "N");
	rounds_done = &done;
	errno = ENOSYS;
	if (!__rseq_size || (int)area()->cpu_id < 0)
		unavailable("rseq is not registered");
	threads = atol(argv[1]);
	must(sched_getaffinity(0, sizeof(allowed), &allowed) == 0, "sched_getaffinity");
	must(!pthread_barrier_init(&barrier, NULL, (unsigned int)threads), "pthread_barrier_init");
	for (i = 0; i < threads; i++) {
		pthread_t thread;

		must(!pthread_create(&thread, NULL, work, (void *)i), "pthread_create");
	}
	victim_ready();
	for (;;) {
		check_area(area());
		beat();
		nap_us(1000);
	}
}
