/* SPDX-License-Identifier: Apache-2.0
 *
 * leave N: N threads live for a tenth of a second each and end with a robust mutex
 * held; they are joined, and the mutex says that its owner died.  What the kernel
 * does at a thread's end (clear_child_tid, the robust list) it must also do for a
 * thread that was restored in between.  Counter 0: threads that have ended; each is a beat.
 */
#include <pthread.h>

#include "victim.h"

enum { MAX = 64 };

static pthread_mutex_t mutex[MAX];

static void *leave(void *arg)
{
	size_t me = (size_t)arg;
	uint64_t random = me + 1 + now_ns();
	int err = pthread_mutex_lock(&mutex[me]);

	CHECK(err == 0, "lock of a free mutex: %s", strerror(err));
	nap_us(50000 + (long)(next_random(&random) % 100000));
	return (void *)(me + 1); /* never unlocked */
}

static void see_off(pthread_t thread, size_t n)
{
	struct timespec at;
	void *result;
	int err, tries = 0;

	/* By tries, not by the clock: who is stopped is not stuck. */
	do {
		clock_gettime(CLOCK_REALTIME, &at);
		at.tv_nsec += 10000000;
		at.tv_sec += at.tv_nsec / 1000000000;
		at.tv_nsec %= 1000000000;
		err = pthread_timedjoin_np(thread, &result, &at);
	} while (err == ETIMEDOUT && ++tries < 300);
	CHECK(err == 0, "thread %zu cannot be joined: %s", n, strerror(err));
	CHECK(result == (void *)(n + 1), "thread %zu returned %p", n, result);
	err = pthread_mutex_trylock(&mutex[n]);
	CHECK(err == EOWNERDEAD, "the mutex of dead thread %zu: %s", n, strerror(err));
	CHECK(!pthread_mutex_consistent(&mutex[n]) && !pthread_mutex_unlock(&mutex[n]),
	      "mutex %zu cannot be made good", n);
	count(0, 1);
	beat();
}

int main(int argc, char **argv)
{
	pthread_t thread[MAX];
	pthread_mutexattr_t attr;
	size_t n, i;

	victim_start(&argc, argv, 1, "N");
	n = (size_t)atol(argv[1]);
	must(n > 0 && n <= MAX, "N");
	pthread_mutexattr_init(&attr);
	pthread_mutexattr_setrobust(&attr, PTHREAD_MUTEX_ROBUST);
	for (i = 0; i < n; i++)
		must(!pthread_mutex_init(&mutex[i], &attr), "pthread_mutex_init");
	for (i = 0; i < n; i++)
		must(!pthread_create(&thread[i], NULL, leave, (void *)i), "pthread_create");
	victim_ready();
	for (i = 0;; i = (i + 1) % n) {
		see_off(thread[i], i);
		CHECK(!pthread_create(&thread[i], NULL, leave, (void *)i), "pthread_create");
	}
}
