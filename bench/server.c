/* SPDX-License-Identifier: Apache-2.0
 *
 * server MB THREADS PORT [--beat-us N] [--write-mb-s R] [--touch N]
 *        [--fork-ms N --keep K] [--board FILE]
 *
 * A request/reply server over TCP with so much touched memory and so many threads
 * (the main one serves, the others are blocked).  One thread more writes whole
 * pages, one after the other through all of the memory, if R is given.
 *
 * A request changes a word in N pages chosen at random, and is answered by who
 * answers: PID, a number drawn at the program's start, and how many requests it
 * has in its memory.  A process that came back with its memory says the same
 * number and goes on counting; one that was started again does not.
 *
 * --fork-ms makes it take its own checkpoints as a program might: a plain fork(2)
 * every N ms, whose child waits for ever; K are kept.
 *
 * Board: beats of the main thread every N us (0, the default: none), and counters:
 *   0 requests   1 pages written   2 time that took, ns   3 page faults of it
 *   4 longest fork(2), ns          5 forks                6 rounds begun late
 */
#include <arpa/inet.h>
#include <netinet/tcp.h>
#include <pthread.h>
#include <signal.h>
#include <sys/epoll.h>
#include <sys/prctl.h>
#include <sys/random.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/wait.h>

#include "exchange.h"
#include "victim.h"

enum { PAGE = 4096, WORDS = PAGE / 8, EVENTS = 16, MAX_KEEP = 16, ROUND_US = 1000 };

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t never = PTHREAD_COND_INITIALIZER;
static uint64_t *memory;
static size_t pages;
static double write_bytes_per_us;
static int epoll_fd;

static void *block(void *unused)
{
	(void)unused;
	pthread_mutex_lock(&lock);
	for (;;)
		pthread_cond_wait(&never, &lock);
	return NULL;
}

static void *write_pages(void *unused)
{
	uint64_t next_ns = now_ns();
	size_t at = 0;
	double due = 0;

	(void)unused;
	prctl(PR_SET_TIMERSLACK, 1);
	for (uint64_t round = 1;; round++) {
		struct rusage before, after;
		struct timespec ts;
		uint64_t start_ns = now_ns();
		long n;

		if (start_ns > next_ns + 2000 * (uint64_t)ROUND_US) {
			/* What was missed is not made up for: the rate is that of a program that
			 * works on its input as it comes. */
			next_ns = start_ns;
			count(6, 1);
		}
		due += write_bytes_per_us * ROUND_US / PAGE;
		n = (long)due;
		due -= (double)n;
		getrusage(RUSAGE_THREAD, &before);
		start_ns = now_ns();
		for (long i = 0; i < n; i++) {
			memset(memory + at * WORDS, (int)round & 0xff, PAGE);
			at = at + 1 < pages ? at + 1 : 0;
		}
		count(2, now_ns() - start_ns);
		getrusage(RUSAGE_THREAD, &after);
		count(1, (uint64_t)n);
		count(3, (uint64_t)(after.ru_minflt - before.ru_minflt));
		next_ns += 1000 * (uint64_t)ROUND_US;
		ts.tv_sec = (time_t)(next_ns / 1000000000);
		ts.tv_nsec = (long)(next_ns % 1000000000);
		while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &ts, NULL) == EINTR)
			;
	}
	return NULL;
}

static void watch(int fd)
{
	struct epoll_event event = { .events = EPOLLIN, .data.fd = fd };

	must(!epoll_ctl(epoll_fd, EPOLL_CTL_ADD, fd, &event), "epoll_ctl");
}

static void take_connection(int listen_fd)
{
	int fd = accept4(listen_fd, NULL, NULL, SOCK_CLOEXEC | SOCK_NONBLOCK), one = 1;

	if (fd < 0)
		return;
	setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof(one));
	watch(fd);
}

/* Requests are small and sent whole, so they are read whole. */
static void serve(int fd, struct reply *reply, long touch, uint64_t *random)
{
	for (;;) {
		struct request request;
		ssize_t n = recv(fd, &request, sizeof(request), MSG_DONTWAIT);

		if (n < 0 && (errno == EAGAIN || errno == EINTR))
			return;
		if (n != sizeof(request)) {
			close(fd);
			return;
		}
		for (long i = 0; i < touch; i++)
			memory[next_random(random) % pages * WORDS]++;
		reply->number = request.number;
		reply->sent_ns = request.sent_ns;
		reply->served++;
		count(0, 1);
		if (send(fd, reply, sizeof(*reply), MSG_NOSIGNAL) != sizeof(*reply)) {
			close(fd);
			return;
		}
	}
}

/* A checkpoint as a program can take it of itself; the oldest child is dropped first. */
static void fork_once(long keep)
{
	static pid_t children[MAX_KEEP];
	static unsigned int turn;
	pid_t *slot = &children[turn++ % (unsigned int)keep];
	uint64_t start_ns, took_ns;

	if (*slot) {
		kill(*slot, SIGKILL);
		waitpid(*slot, NULL, 0);
	}
	start_ns = now_ns();
	*slot = fork();
	if (*slot == 0) {
		prctl(PR_SET_PDEATHSIG, SIGKILL);
		for (;;)
			pause();
	}
	must(*slot > 0, "fork");
	took_ns = now_ns() - start_ns;
	if (took_ns > board->counter[4])
		board->counter[4] = took_ns;
	count(5, 1);
}

static long number_option(int argc, char **argv, const char *name, long otherwise)
{
	for (int i = 1; i + 1 < argc; i++)
		if (!strcmp(argv[i], name))
			return atol(argv[i + 1]);
	return otherwise;
}

static int listen_on(int port)
{
	struct sockaddr_in at = { .sin_family = AF_INET, .sin_port = htons((uint16_t)port) };
	int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0), one = 1;

	must(fd >= 0, "socket");
	setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &one, sizeof(one));
	must(!bind(fd, (struct sockaddr *)&at, sizeof(at)), "bind");
	must(!listen(fd, 16), "listen");
	return fd;
}

static void start_threads(long threads)
{
	pthread_attr_t attr;
	pthread_t thread;

	pthread_attr_init(&attr);
	pthread_attr_setstacksize(&attr, 64 << 10);
	for (long i = 1; i < threads; i++)
		must(!pthread_create(&thread, &attr, block, NULL), "pthread_create");
	if (write_bytes_per_us > 0)
		must(!pthread_create(&thread, &attr, write_pages, NULL), "pthread_create");
}

int main(int argc, char **argv)
{
	struct reply reply = { 0 };
	uint64_t random = 4711, fork_ns;
	long beat_us, touch, fork_ms, keep;
	int listen_fd;

	victim_start(&argc, argv, 3, "MB THREADS PORT");
	beat_us = number_option(argc, argv, "--beat-us", 0);
	touch = number_option(argc, argv, "--touch", 0);
	fork_ms = number_option(argc, argv, "--fork-ms", 0);
	keep = number_option(argc, argv, "--keep", 1);
	must(keep >= 1 && keep <= MAX_KEEP, "--keep");
	write_bytes_per_us = (double)number_option(argc, argv, "--write-mb-s", 0) * 1.048576;
	pages = ((size_t)atol(argv[1]) << 20) / PAGE;
	memory = mmap(NULL, pages * PAGE, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1,
		      0);
	must(memory != MAP_FAILED, "mmap");
	for (size_t page = 0; page < pages; page++)
		memory[page * WORDS] = page + 1;
	must(getrandom(&reply.token, sizeof(reply.token), 0) == sizeof(reply.token), "getrandom");
	reply.pid = (uint64_t)getpid();
	prctl(PR_SET_TIMERSLACK, 1);
	epoll_fd = epoll_create1(EPOLL_CLOEXEC);
	must(epoll_fd >= 0, "epoll_create1");
	listen_fd = listen_on(atoi(argv[3]));
	watch(listen_fd);
	start_threads(atol(argv[2]));
	victim_ready();
	fork_ns = now_ns();
	for (;;) {
		struct timespec wait = { 0, beat_us * 1000 };
		struct epoll_event events[EVENTS];
		int n;

		if (fork_ms)
			wait.tv_nsec = 1000000;
		/* EINTR: some checkpoint tools let a program see that it was stopped. */
		n = epoll_pwait2(epoll_fd, events, EVENTS, beat_us || fork_ms ? &wait : NULL, NULL);
		must(n >= 0 || errno == EINTR, "epoll_pwait2");
		for (int i = 0; i < n; i++)
			if (events[i].data.fd == listen_fd)
				take_connection(listen_fd);
			else
				serve(events[i].data.fd, &reply, touch, &random);
		if (beat_us)
			beat();
		if (fork_ms && now_ns() - fork_ns >= (uint64_t)fork_ms * 1000000) {
			fork_ns = now_ns();
			fork_once(keep);
		}
	}
}
