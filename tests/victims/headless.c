/* SPDX-License-Identifier: Apache-2.0
 *
 * headless N [--changing]: a process whose main thread has ended while N threads go on.
 * Each looks all the time whether it is still itself, and whether the main thread is still
 * what it was: a zombie.  SIGUSR1: all end, and with
 * the last of them the process (status 7).  With --changing another one takes the place of each
 * after 20 ms.
 */
#include <pthread.h>
#include <signal.h>

#include "victim.h"

#define STATUS 7

static volatile sig_atomic_t leaving;
static uint64_t laps; /* of all, under the lock; goes back with a restore */
static pthread_mutex_t lock;
static bool changing;

static void *work(void *arg);

static void start(void *arg)
{
	pthread_attr_t detached;
	pthread_t thread;

	pthread_attr_init(&detached);
	pthread_attr_setdetachstate(&detached, PTHREAD_CREATE_DETACHED);
	must(!pthread_create(&thread, &detached, work, arg), "pthread_create");
}

static char main_state(void)
{
	char path[48], text[512], *p;
	ssize_t n;
	int fd;

	snprintf(path, sizeof path, "/proc/%d/stat", getpid());
	/* An open file of /proc does not survive a restore: then once more. */
	for (int tries = 0; tries < 5; tries++) {
		fd = open(path, O_RDONLY | O_CLOEXEC);
		n = fd < 0 ? -1 : read(fd, text, sizeof text - 1);
		close(fd);
		if (n > 0)
			break;
	}
	CHECK(n > 0, "%s: %s", path, strerror(errno));
	text[n > 0 ? n : 0] = 0;
	p = strrchr(text, ')');
	return p ? p[2] : '?';
}

static void *work(void *arg)
{
	const pid_t tid = (pid_t)syscall(SYS_gettid);
	const bool beats = arg == NULL;
	const uint64_t until_ns = now_ns() + 20000000;
	char name[16], is[16];

	snprintf(name, sizeof name, "worker-%d", tid);
	pthread_setname_np(pthread_self(), name);
	/* pthread_create(3) has not returned in time for board.ready. */
	while (beats && main_state() != 'Z')
		nap_us(200);
	if (beats)
		victim_ready();
	while (!leaving && !(changing && now_ns() > until_ns)) {
		CHECK(syscall(SYS_gettid) == tid, "thread %d is %ld now", tid, syscall(SYS_gettid));
		CHECK(!pthread_getname_np(pthread_self(), is, sizeof is) && !strcmp(is, name),
		      "%s is called %s", name, is);
		CHECK(!pthread_mutex_lock(&lock), "the lock is broken");
		laps++;
		CHECK(pthread_mutex_lock(&lock) == EDEADLK, "the lock has another owner");
		CHECK(!pthread_mutex_unlock(&lock), "the lock is not mine");
		if (beats && board->ready) {
			CHECK(main_state() == 'Z', "the main thread is '%c'", main_state());
			beat();
		}
		usleep(500); /* SIGUSR1 may cut it short */
	}
	if (!leaving) {
		start(arg);
		return NULL;
	}
	for (;;)
		syscall(SYS_exit, STATUS);
	return NULL;
}

static void leave(int signal)
{
	(void)signal;
	leaving = 1;
}

int main(int argc, char **argv)
{
	pthread_mutexattr_t checking;
	long n;

	changing = victim_flag(&argc, argv, "--changing");
	victim_start(&argc, argv, 1, "N [--changing]");
	signal(SIGUSR1, leave);
	pthread_mutexattr_init(&checking);
	pthread_mutexattr_settype(&checking, PTHREAD_MUTEX_ERRORCHECK);
	pthread_mutex_init(&lock, &checking);
	n = atol(argv[1]);
	for (long i = 0; i < n; i++)
		start((void *)i);
	for (;;)
		syscall(SYS_exit, 0);
}
