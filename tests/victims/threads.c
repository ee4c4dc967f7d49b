/* SPDX-License-Identifier: Apache-2.0
 *
 * threads N MB [--no-churn]: everything in which a thread's identity or a lock's
 * owner is kept: by the kernel, by libc, by the program.
 *
 * N workers take error-checking, recursive, robust and priority-inheriting
 * mutexes and a read-write lock, wait on condition variables with and without
 * timeouts, and meet at barriers; a thread creates and joins short-lived threads
 * without a pause, some of which die with a robust mutex held.  Each thread
 * compares what the kernel says of it with what it knew from its start.
 */
#include <pthread.h>
#include <semaphore.h>

#include "victim.h"

enum { PARTY = 4, PAGE_WORDS = 512, STUCK_TICKS = 3000 };

static pthread_mutex_t checking, recursive, robust, inheriting, plain = PTHREAD_MUTEX_INITIALIZER;
static pthread_rwlock_t readers = PTHREAD_RWLOCK_INITIALIZER;
static pthread_mutex_t page_lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_mutex_t queue_lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t queue_filled = PTHREAD_COND_INITIALIZER;
static pthread_cond_t timed;
static pthread_barrier_t barrier;
static sem_t tokens;
static long queue_length;

/* Two of each, which are equal whenever the lock is free. */
static struct {
	volatile uint64_t a, b;
} guarded[5];

static uint64_t *memory;
static uint32_t *page_version;
static size_t pages;

struct worker {
	pthread_t thread;
	size_t number;
	volatile uint64_t laps;
};

static pid_t main_pid;
static _Thread_local pid_t my_tid;
static _Thread_local pthread_t my_self;
static _Thread_local uint64_t my_laps;
static _Thread_local uint64_t my_tag;

static void know_thyself(uint64_t tag)
{
	my_tid = gettid();
	my_self = pthread_self();
	my_tag = tag;
}

static void check_thyself(uint64_t tag)
{
	CHECK(syscall(SYS_gettid) == my_tid, "I was thread %d", my_tid);
	CHECK(getpid() == main_pid && syscall(SYS_getpid) == main_pid, "I was in process %d",
	      main_pid);
	CHECK(pthread_equal(pthread_self(), my_self), "pthread_self() changed");
	CHECK(my_tag == tag, "thread-local storage holds %lx, not %lx", my_tag, tag);
}

static void expect(int got, int wanted, const char *what)
{
	CHECK(got == wanted, "%s: %s (%d), not %s", what, strerror(got), got,
	      wanted ? strerror(wanted) : "success");
}

/* Some work with the lock held, which shows whether it kept the others out. */
static void change(int which)
{
	uint64_t was = guarded[which].a;
	volatile int spin;

	CHECK(guarded[which].b == was, "lock %d kept nobody out: %lu %lu", which, was,
	      guarded[which].b);
	guarded[which].a = was + 1;
	for (spin = 0; spin < 50; spin++)
		;
	CHECK(guarded[which].a == was + 1, "lock %d kept nobody out", which);
	guarded[which].b = was + 1;
}

static void lock_robust(void)
{
	int err = pthread_mutex_lock(&robust);

	if (err == EOWNERDEAD) { /* one of the short-lived: it left things half-done */
		guarded[2].b = guarded[2].a;
		expect(pthread_mutex_consistent(&robust), 0, "pthread_mutex_consistent");
		count(2, 1);
	} else {
		expect(err, 0, "lock of the robust mutex");
	}
}

static void use_locks(uint64_t *random)
{
	expect(pthread_mutex_lock(&checking), 0, "lock of the error-checking mutex");
	expect(pthread_mutex_lock(&checking), EDEADLK, "second lock of the error-checking mutex");
	change(0);
	expect(pthread_mutex_unlock(&checking), 0, "unlock of the error-checking mutex");
	/* Not ours: EPERM whether it is free or another's. */
	expect(pthread_mutex_unlock(&checking), EPERM, "unlock of another's mutex");

	expect(pthread_mutex_lock(&recursive), 0, "lock of the recursive mutex");
	expect(pthread_mutex_lock(&recursive), 0, "second lock of the recursive mutex");
	change(1);
	expect(pthread_mutex_unlock(&recursive), 0, "unlock of the recursive mutex");
	expect(pthread_mutex_unlock(&recursive), 0, "last unlock of the recursive mutex");

	lock_robust();
	change(2);
	if (next_random(random) % 8 == 0)
		nap_us(50);
	expect(pthread_mutex_unlock(&robust), 0, "unlock of the robust mutex");

	/* The kernel compares the word with the TID of the caller. */
	expect(pthread_mutex_lock(&inheriting), 0, "lock of the inheriting mutex");
	change(3);
	if (next_random(random) % 8 == 0)
		nap_us(50);
	expect(pthread_mutex_unlock(&inheriting), 0, "unlock of the inheriting mutex");

	if (next_random(random) % 4 == 0) {
		expect(pthread_rwlock_wrlock(&readers), 0, "write lock");
		change(4);
	} else {
		expect(pthread_rwlock_rdlock(&readers), 0, "read lock");
		CHECK(guarded[4].a == guarded[4].b, "a writer is among the readers");
	}
	expect(pthread_rwlock_unlock(&readers), 0, "unlock of the read-write lock");
}

static struct timespec soon(clockid_t clock, long us)
{
	struct timespec ts;

	clock_gettime(clock, &ts);
	ts.tv_nsec += us * 1000;
	if (ts.tv_nsec >= 1000000000) {
		ts.tv_sec++;
		ts.tv_nsec -= 1000000000;
	}
	return ts;
}

static void wait_on_conditions(uint64_t *random)
{
	struct timespec at = soon(CLOCK_MONOTONIC, 2000);
	int err;

	expect(pthread_mutex_lock(&plain), 0, "lock of the plain mutex");
	err = pthread_cond_timedwait(&timed, &plain, &at);
	CHECK(err == 0 || err == ETIMEDOUT, "timed wait: %s", strerror(err));
	expect(pthread_mutex_unlock(&plain), 0, "unlock of the plain mutex");

	/* As many take as give: whoever waits is woken sooner or later. */
	expect(pthread_mutex_lock(&queue_lock), 0, "lock of the queue");
	if (next_random(random) % 2 || queue_length > 1000) {
		at = soon(CLOCK_REALTIME, 20000);
		for (err = 0; queue_length == 0 && err != ETIMEDOUT;) {
			err = pthread_cond_timedwait(&queue_filled, &queue_lock, &at);
			CHECK(err == 0 || err == ETIMEDOUT, "wait for the queue: %s",
			      strerror(err));
		}
		queue_length -= queue_length > 0;
	} else {
		queue_length++;
		pthread_cond_signal(&queue_filled);
	}
	expect(pthread_mutex_unlock(&queue_lock), 0, "unlock of the queue");
	pthread_cond_broadcast(&timed);

	CHECK(sem_wait(&tokens) == 0, "sem_wait: %s", strerror(errno));
	CHECK(sem_post(&tokens) == 0, "sem_post: %s", strerror(errno));
}

/* Every word of a page says which page and which version it is of. */
static void check_page(uint64_t *random)
{
	size_t page, i;

	if (!pages)
		return;
	page = next_random(random) % pages;
	expect(pthread_mutex_lock(&page_lock), 0, "lock of the pages");
	for (i = 0; i < PAGE_WORDS; i++)
		CHECK(memory[page * PAGE_WORDS + i] ==
			      mix(page * PAGE_WORDS + i, page_version[page]),
		      "page %zu, word %zu: %lx is not of version %u", page, i,
		      memory[page * PAGE_WORDS + i], page_version[page]);
	page_version[page]++;
	for (i = 0; i < PAGE_WORDS; i++)
		memory[page * PAGE_WORDS + i] = mix(page * PAGE_WORDS + i, page_version[page]);
	expect(pthread_mutex_unlock(&page_lock), 0, "unlock of the pages");
}

static void *work(void *arg)
{
	struct worker *me = arg;
	uint64_t random = me->number + 1, laps;

	know_thyself(mix(me->number, 1));
	for (laps = 0;; laps++) {
		check_thyself(mix(me->number, 1));
		CHECK(me->laps == laps && my_laps == laps, "lap %lu, but %lu and %lu in memory",
		      laps, me->laps, my_laps);
		use_locks(&random);
		wait_on_conditions(&random);
		check_page(&random);
		if (me->number < PARTY && laps % 16 == 0) {
			int err = pthread_barrier_wait(&barrier);

			CHECK(err == 0 || err == PTHREAD_BARRIER_SERIAL_THREAD, "barrier: %s",
			      strerror(err));
		}
		nap_us((long)(next_random(&random) % 1000));
		my_laps = laps + 1;
		me->laps = laps + 1;
	}
	return NULL;
}

static void *live_shortly(void *arg)
{
	uint64_t number = (uint64_t)arg;

	know_thyself(number);
	CHECK(!pthread_equal(my_self, 0), "no pthread_self()");
	if (number % 16 == 5) {
		lock_robust(); /* never unlocked: the kernel walks the robust list */
		guarded[2].a++;
	}
	if (number % 4 == 1)
		nap_us(100);
	check_thyself(number);
	return (void *)(number * 3);
}

/* Freezing and thread creation race with each other. */
static void *churn(void *arg)
{
	struct worker *me = arg;
	uint64_t number;

	know_thyself(4242);
	for (number = 1;; number++) {
		pthread_t thread[2];
		void *result;
		int i;

		for (i = 0; i < 2; i++)
			expect(pthread_create(&thread[i], NULL, live_shortly,
					      (void *)(number + (uint64_t)i)),
			       0, "pthread_create");
		for (i = 0; i < 2; i++) {
			expect(pthread_join(thread[i], &result), 0, "pthread_join");
			CHECK(result == (void *)((number + (uint64_t)i) * 3),
			      "a thread's result is %p", result);
		}
		count(1, 2);
		check_thyself(4242);
		me->laps++;
		nap_us(500);
	}
	return NULL;
}

static void make_mutex(pthread_mutex_t *mutex, int type, int robustness, int protocol)
{
	pthread_mutexattr_t attr;

	pthread_mutexattr_init(&attr);
	pthread_mutexattr_settype(&attr, type);
	pthread_mutexattr_setrobust(&attr, robustness);
	pthread_mutexattr_setprotocol(&attr, protocol);
	must(!pthread_mutex_init(mutex, &attr), "pthread_mutex_init");
}

static void fill_memory(size_t mb)
{
	size_t i;

	pages = (mb << 20) / (PAGE_WORDS * 8);
	memory = malloc(pages * PAGE_WORDS * 8 + 1);
	page_version = calloc(pages + 1, sizeof(*page_version));
	must(memory && page_version, "malloc");
	for (i = 0; i < pages * PAGE_WORDS; i++)
		memory[i] = mix(i, 0);
}

int main(int argc, char **argv)
{
	bool churning = !victim_flag(&argc, argv, "--no-churn");
	pthread_condattr_t monotonic;
	struct worker *workers;
	uint64_t *seen, *ticks;
	size_t n, i, all;

	victim_start(&argc, argv, 2, "N MB [--no-churn]");
	n = (size_t)atol(argv[1]);
	all = n + churning;
	main_pid = getpid();
	know_thyself(1);
	fill_memory((size_t)atol(argv[2]));
	make_mutex(&checking, PTHREAD_MUTEX_ERRORCHECK, PTHREAD_MUTEX_STALLED, PTHREAD_PRIO_NONE);
	make_mutex(&recursive, PTHREAD_MUTEX_RECURSIVE, PTHREAD_MUTEX_STALLED, PTHREAD_PRIO_NONE);
	make_mutex(&robust, PTHREAD_MUTEX_NORMAL, PTHREAD_MUTEX_ROBUST, PTHREAD_PRIO_NONE);
	make_mutex(&inheriting, PTHREAD_MUTEX_NORMAL, PTHREAD_MUTEX_STALLED, PTHREAD_PRIO_INHERIT);
	pthread_condattr_init(&monotonic);
	pthread_condattr_setclock(&monotonic, CLOCK_MONOTONIC);
	pthread_cond_init(&timed, &monotonic);
	pthread_barrier_init(&barrier, NULL, n < PARTY ? (unsigned int)(n ? n : 1) : PARTY);
	sem_init(&tokens, 0, 2);
	workers = calloc(all + 1, sizeof(*workers));
	seen = calloc(all + 1, sizeof(*seen));
	ticks = calloc(all + 1, sizeof(*ticks));
	must(workers && seen && ticks, "calloc");
	for (i = 0; i < all; i++) {
		workers[i].number = i;
		must(!pthread_create(&workers[i].thread, NULL, i < n ? work : churn, &workers[i]),
		     "pthread_create");
	}
	victim_ready();
	for (;;) {
		uint64_t laps = 0;

		/* In ticks of its own, not by the clock: who is stopped is not stuck. */
		for (i = 0; i < all; i++) {
			ticks[i] = workers[i].laps == seen[i] ? ticks[i] + 1 : 0;
			seen[i] = workers[i].laps;
			laps += seen[i];
			CHECK(ticks[i] < STUCK_TICKS, "thread %zu is stuck at lap %lu", i, seen[i]);
		}
		check_thyself(1);
		board->counter[0] = laps;
		beat();
		nap_us(5000);
	}
}
