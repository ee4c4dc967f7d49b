/* SPDX-License-Identifier: Apache-2.0
 *
 * Aside: system calls that another process can block for as long as it likes: a file server does
 * not answer; a thread that waits in splice(2) holds the lock of its pipe. Such a call cannot be
 * interrupted, not even by killing the caller, so a separate thread makes it, which can be left
 * behind. The guard's main thread waits for it and does nothing else meanwhile, so the two need no
 * locks for shared data.
 */
#include <errno.h>
#include <limits.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#include "base.h"

#define STACK_BYTES (256u << 10)
#define BEAT_NS (500 * NS_PER_MS)

struct worker {
	pthread_mutex_t lock;
	pthread_cond_t changed;
	struct aside *job; /* NULL: it is done */
	pid_t tid;         /* 0: it has not started yet */
	bool urgent;       /* as the main thread was when it posted the job */
	bool left_behind;
	uint32_t steps; /* of the job, so far                                    */
};

static struct worker *worker; /* the main thread's; NULL: none yet                     */
static __thread struct worker *self;

bool aside_is_left_behind(void)
{
	return self && __atomic_load_n(&self->left_behind, __ATOMIC_ACQUIRE);
}

void aside_step(void)
{
	if (self)
		__atomic_fetch_add(&self->steps, 1, __ATOMIC_RELAXED);
}

static void *work(void *arg)
{
	struct aside *job;
	int *left_behind;

	self = arg;
	prctl(PR_SET_NAME, "avckpt-aside");
	pthread_mutex_lock(&self->lock);
	self->tid = (pid_t)syscall(SYS_gettid);
	for (;;) {
		while (!self->job)
			pthread_cond_wait(&self->changed, &self->lock);
		job = self->job;
		pthread_mutex_unlock(&self->lock);
		job->work(job);
		pthread_mutex_lock(&self->lock);
		if (self->left_behind)
			break;
		self->job = NULL;
		pthread_cond_signal(&self->changed);
	}
	pthread_mutex_unlock(&self->lock);
	pthread_cond_destroy(&self->changed);
	pthread_mutex_destroy(&self->lock);
	free(self);
	left_behind = job->left_behind;
	job->drop(job);
	__atomic_store_n(left_behind, 0, __ATOMIC_RELEASE);
	return NULL;
}

/* Blocks all signals of the guard. */
static struct worker *worker_new(void)
{
	struct worker *fresh = calloc(1, sizeof *fresh);
	pthread_condattr_t monotonic;
	pthread_attr_t small;
	pthread_t thread;
	sigset_t all, before;
	int failed;

	if (!fresh)
		return NULL;
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&fresh->changed, &monotonic);
	pthread_condattr_destroy(&monotonic);
	pthread_mutex_init(&fresh->lock, NULL);
	pthread_attr_init(&small);
	pthread_attr_setdetachstate(&small, PTHREAD_CREATE_DETACHED);
	pthread_attr_setstacksize(&small, STACK_BYTES);
	sigfillset(&all);
	pthread_sigmask(SIG_SETMASK, &all, &before);
	failed = pthread_create(&thread, &small, work, fresh);
	pthread_sigmask(SIG_SETMASK, &before, NULL);
	pthread_attr_destroy(&small);
	if (failed) {
		free(fresh);
		return NULL;
	}
	return fresh;
}

/* With the lock held: whether the job was done, none of its steps taking longer than that. */
static bool await(struct worker *on, uint64_t ns)
{
	uint64_t end = now_ns() + ns;
	uint32_t steps = 0;

	while (on->job) {
		const uint64_t now = now_ns(), next = now + BEAT_NS < end ? now + BEAT_NS : end;
		const struct timespec until = timespec_of(next);
		const uint32_t so_far = __atomic_load_n(&on->steps, __ATOMIC_RELAXED);

		if (so_far != steps)
			end = now + ns;
		else if (now >= end)
			return false;
		steps = so_far;
		heartbeat();
		pthread_cond_timedwait(&on->changed, &on->lock, &until);
	}
	return true;
}

bool aside_run(struct aside *job, uint64_t ns)
{
	struct worker *const on = worker = worker ? worker : worker_new();

	if (!on || __atomic_load_n(job->left_behind, __ATOMIC_ACQUIRE)) {
		job->drop(job);
		return false;
	}
	pthread_mutex_lock(&on->lock);
	if (on->tid && on->urgent != rt_priority_is()) {
		on->urgent = rt_priority_is();
		rt_priority_share(on->tid);
	}
	on->job = job;
	pthread_cond_signal(&on->changed);
	if (await(on, ns)) {
		pthread_mutex_unlock(&on->lock);
		return true;
	}
	__atomic_store_n(job->left_behind, 1, __ATOMIC_RELEASE);
	__atomic_store_n(&on->left_behind, true, __ATOMIC_RELEASE);
	worker = NULL;
	pthread_mutex_unlock(&on->lock);
	return false;
}
