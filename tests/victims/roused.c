/* SPDX-License-Identifier: Apache-2.0
 *
 * roused: two threads, the main one among them, wait for a signal, in epoll_pwait(2) and ppoll(2) by
 * turns, without a timeout.  Only in there is the signal not blocked, so that it cannot come too
 * early, and a third thread sends it once for each call.  Its handler has to end the call: if it
 * runs and the call goes on, nothing ever ends that.
 *
 * counter[0] and counter[1] are the calls of each.
 */
#include <poll.h>
#include <pthread.h>
#include <sys/epoll.h>

#include "victim.h"

#define PATIENCE_NS UINT64_C(10000000000)

static struct waiter {
	pthread_t thread;
	uint64_t calls, over; /* begun, and ended */
	volatile uint64_t handled;
} waiters[2];
static _Thread_local struct waiter *self;
static int epoll_fd;

static void handle(int signal)
{
	(void)signal;
	self->handled++;
}

static void *wait_for_ever(void *arg)
{
	struct epoll_event event;
	sigset_t none;

	self = arg;
	sigemptyset(&none);
	for (uint64_t n = 1;; n++) {
		int result;

		__atomic_store_n(&self->calls, n, __ATOMIC_RELEASE);
		result = n % 2 ? epoll_pwait(epoll_fd, &event, 1, -1, &none)
			       : ppoll(NULL, 0, NULL, &none);
		CHECK(result == -1 && errno == EINTR, "a call answered %d, %s", result,
		      strerror(errno));
		CHECK(self->handled == n, "%lu calls were ended by %lu signals", (unsigned long)n,
		      (unsigned long)self->handled);
		count((unsigned int)(self - waiters), 1);
		__atomic_store_n(&self->over, n, __ATOMIC_RELEASE);
	}
	return NULL;
}

static void rouse(struct waiter *waiter, uint64_t n)
{
	const uint64_t end = now_ns() + PATIENCE_NS * slowness();

	while (__atomic_load_n(&waiter->calls, __ATOMIC_ACQUIRE) < n)
		nap_us(50);
	nap_us((long)(n * 37 % 1000));
	must(!pthread_kill(waiter->thread, SIGUSR1), "pthread_kill");
	while (__atomic_load_n(&waiter->over, __ATOMIC_ACQUIRE) < n) {
		CHECK(now_ns() < end, "the handler ran %lu times, and call %lu goes on",
		      (unsigned long)waiter->handled, (unsigned long)n);
		nap_us(50);
	}
}

static void *rouse_for_ever(void *unused)
{
	for (uint64_t n = 1;; n++) {
		rouse(&waiters[0], n);
		rouse(&waiters[1], n);
		beat();
	}
	return unused;
}

int main(int argc, char **argv)
{
	const struct sigaction action = { .sa_handler = handle };
	pthread_t thread;
	sigset_t usr1;

	victim_start(&argc, argv, 0, "");
	epoll_fd = epoll_create1(EPOLL_CLOEXEC);
	must(epoll_fd >= 0, "epoll_create1");
	sigemptyset(&usr1);
	sigaddset(&usr1, SIGUSR1);
	must(!sigaction(SIGUSR1, &action, NULL), "sigaction");
	must(!pthread_sigmask(SIG_BLOCK, &usr1, NULL), "pthread_sigmask");
	waiters[0].thread = pthread_self();
	must(!pthread_create(&waiters[1].thread, NULL, wait_for_ever, &waiters[1]),
	     "pthread_create");
	must(!pthread_create(&thread, NULL, rouse_for_ever, NULL), "pthread_create");
	victim_ready();
	wait_for_ever(&waiters[0]);
}
