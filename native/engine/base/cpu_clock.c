/* SPDX-License-Identifier: Apache-2.0
 *
 * The scheduler's clocks, on which /proc/PID/sched tells when a task last ran.
 *
 * Each CPU has its own, which stops while interrupts and the hypervisor take time from that CPU
 * (kernel/sched/core.c, update_rq_clock_task()). So they differ, and no file shows them. But a
 * thread of the guard that runs on that CPU can read when it last ran itself: now. Since `ran_ns`
 * at least as much time has passed as this clock shows, because it only ever lags behind.
 */
#include <sched.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "base.h"

#define LOOK_NS (2 * NS_PER_MS)

struct reading {
	uint64_t said_ns, at_ns; /* at_ns: on CLOCK_MONOTONIC, then or a little later */
};

struct look {
	struct aside aside; /* first */
	uint32_t cpu;
	struct reading is;
};

/* The latest one of each CPU. */
static struct reading readings[CPU_SETSIZE];

/* Reading its CPU time makes the kernel update the thread's times (task_sched_runtime()). */
static void look(struct aside *aside)
{
	struct look *job = (struct look *)aside;
	const pid_t self = (pid_t)syscall(SYS_gettid);
	cpu_set_t before, there;
	struct timespec used;
	struct proc_sched sched;

	CPU_ZERO(&there);
	CPU_SET(job->cpu, &there);
	if (sched_getaffinity(0, sizeof before, &before) ||
	    sched_setaffinity(0, sizeof there, &there))
		return;
	if (clock_gettime(CLOCK_THREAD_CPUTIME_ID, &used) == 0 && proc_sched(self, &sched) == 0)
		job->is = (struct reading){ sched.ran_ns, now_ns() };
	(void)sched_setaffinity(0, sizeof before, &before);
}

static void drop(struct aside *aside)
{
	free(aside);
}

/* In a separate thread at ordinary priority: if other tasks take all of that CPU's time, it is left
 * behind. */
static void read_clock(uint32_t cpu)
{
	static int left_behind;
	struct look *job = calloc(1, sizeof *job);

	if (!job)
		return;
	job->aside = (struct aside){ look, drop, &left_behind };
	job->cpu = cpu;
	if (!aside_run(&job->aside, LOOK_NS))
		return;
	if (job->is.at_ns)
		readings[cpu] = job->is;
	drop(&job->aside);
}

uint64_t cpu_clock_least(uint64_t ns)
{
	return ns / 1000 * 999;
}

uint64_t cpu_clock_when(uint32_t cpu, uint64_t ran_ns)
{
	const struct reading *is;

	if (cpu >= CPU_SETSIZE)
		return 0;
	is = &readings[cpu];
	if (is->said_ns < ran_ns)
		read_clock(cpu);
	return is->said_ns >= ran_ns ? is->at_ns - cpu_clock_least(is->said_ns - ran_ns) : 0;
}
