/* SPDX-License-Identifier: Apache-2.0
 *
 * lengthy: the main thread writes far more than fits into a pipe with each write(2), and so waits in
 * that call nearly all the time, for a thread that reads.  Every byte has to arrive once.
 *
 * All registers are to be what they were (inlined.h).
 *
 * With --unix and --tcp it writes into a socket; with --send by send(2).  With --receive it is the main
 * thread that receives, all of it at once (MSG_WAITALL), and the other one that writes.
 *
 * With --hang-up the other thread closes its end after a part of it: the call returns that, and the next
 * one says so.  With --alarm a signal ends the call, with the same result as if there was no checkpoint.
 *
 * With --stall (and --receive) the other thread sends a part and then waits: the call returns that when
 * its timeout is over (SO_RCVTIMEO), no earlier and not much later.
 *
 * counter[0]: such calls; counter[1]: those that returned before everything was done;
 * counter[2]: --alarm: signals
 */
#include <arpa/inet.h>
#include <sys/socket.h>
#include <sys/time.h>

#include "inlined.h"

#define BYTES (1 << 20)
#define PIECE_BYTES 8192
#define PAUSE_US 200
#define ALARM_MS 7
#define TIMEOUT_NS (300 * UINT64_C(1000000))
#define LATE_NS (2 * TIMEOUT_NS)

static int own, other; /* ends */
static bool hangs_up, over_unix, over_tcp, sends, receives, alarms, stalls;
static uint8_t written[BYTES], received[BYTES];
static volatile sig_atomic_t alarm_came;

static void on_alarm(int signal)
{
	(void)signal;
	alarm_came = 1;
	count(2, 1);
}

static ssize_t move_piece(uint8_t *piece, size_t at)
{
	const size_t bytes = at + PIECE_BYTES <= BYTES ? PIECE_BYTES : BYTES - at;
	ssize_t n;

	if (receives) {
		n = write(other, written + at, bytes);
		CHECK(n > 0, "write: %zd, %s", n, strerror(errno));
		return n;
	}
	n = read(other, piece, PIECE_BYTES);
	CHECK(n > 0, "read: %zd, %s", n, strerror(errno));
	for (ssize_t i = 0; i < n; i++)
		CHECK(piece[i] == written[(at + (size_t)i) % BYTES], "another byte came at %zu",
		      (at + (size_t)i) % BYTES);
	return n;
}

static void *serve(void *arg)
{
	static uint8_t piece[PIECE_BYTES];
	size_t at = 0;

	(void)arg;
	for (;;) {
		at = (at + (size_t)move_piece(piece, at)) % BYTES;
		nap_us(PAUSE_US);
		if (hangs_up && at > BYTES / 2) {
			close(other);
			return NULL;
		}
	}
}

static void connect_tcp(int ends[2])
{
	struct sockaddr_in at = { .sin_family = AF_INET, .sin_addr = { htonl(INADDR_LOOPBACK) } };
	socklen_t bytes = sizeof at;
	const int listener = socket(AF_INET, SOCK_STREAM, 0);

	must(listener >= 0 && bind(listener, (struct sockaddr *)&at, sizeof at) == 0 &&
		     listen(listener, 1) == 0 &&
		     getsockname(listener, (struct sockaddr *)&at, &bytes) == 0,
	     "listen");
	ends[1] = socket(AF_INET, SOCK_STREAM, 0);
	must(connect(ends[1], (struct sockaddr *)&at, sizeof at) == 0, "connect");
	ends[0] = accept(listener, NULL, NULL);
	must(ends[0] >= 0, "accept");
	close(listener);
}

/* A stream: --tcp or --unix. */
static void connect_stream(int ends[2])
{
	if (over_tcp)
		connect_tcp(ends);
	else
		must(socketpair(AF_UNIX, SOCK_STREAM, 0, ends) == 0, "socketpair");
}

static void begin(void)
{
	sigset_t all, before;
	pthread_t thread;
	int ends[2];

	if (over_tcp || over_unix)
		connect_stream(ends);
	else
		must(pipe(ends) == 0, "pipe");
	other = ends[0];
	own = ends[1];
	sigfillset(&all);
	pthread_sigmask(SIG_SETMASK, &all, &before); /* signals are for the main thread */
	must(pthread_create(&thread, NULL, serve, NULL) == 0, "pthread_create");
	pthread_sigmask(SIG_SETMASK, &before, NULL);
	pthread_detach(thread);
}

static ssize_t call(size_t done)
{
	const uint64_t fd = (uint64_t)own, bytes = BYTES - done;

	if (receives)
		return inlined("recv", SYS_recvfrom, fd, (uint64_t)(received + done), bytes,
			       MSG_WAITALL, 0, inlined_next());
	if (sends)
		return inlined("send", SYS_sendto, fd, (uint64_t)(written + done), bytes, 0, 0,
			       inlined_next());
	return inlined("write", SYS_write, fd, (uint64_t)(written + done), bytes, inlined_next(),
		       inlined_next(), inlined_next());
}

/* False: the other end has been closed. */
static bool do_all(void)
{
	size_t done = 0;

	while (done < BYTES) {
		const ssize_t n = call(done);

		if (hangs_up && (n < 0 ? errno == EPIPE || errno == ECONNRESET : n == 0)) {
			close(own);
			return false;
		}
		if (alarms && n < 0 && errno == EINTR)
			continue;
		CHECK(n > 0, "result %zd, %s", n, strerror(errno));
		done += (size_t)n;
		if (done < BYTES && !alarm_came)
			count(1, 1);
		alarm_came = 0;
	}
	CHECK(!receives || memcmp(received, written, BYTES) == 0, "something else was received");
	return true;
}

static void set_alarms(void)
{
	const struct sigaction action = { .sa_handler = on_alarm };
	const struct timeval every = { .tv_usec = ALARM_MS * 1000 };

	must(sigaction(SIGALRM, &action, NULL) == 0, "sigaction");
	must(setitimer(ITIMER_REAL, &(struct itimerval){ every, every }, NULL) == 0, "setitimer");
}

static void stall(void)
{
	const struct timeval timeout = { .tv_usec = TIMEOUT_NS / 1000 };
	uint64_t began;
	int ends[2];

	connect_stream(ends);
	must(setsockopt(ends[1], SOL_SOCKET, SO_RCVTIMEO, &timeout, sizeof timeout) == 0,
	     "SO_RCVTIMEO");
	own = ends[1];
	victim_ready();
	for (;;) {
		CHECK(write(ends[0], written, PIECE_BYTES) == PIECE_BYTES, "write: %s",
		      strerror(errno));
		began = now_ns();
		CHECK(call(0) == PIECE_BYTES, "another result: %s", strerror(errno));
		CHECK(now_ns() - began > TIMEOUT_NS - TIMEOUT_NS / 10, "too early");
		CHECK(now_ns() - began < TIMEOUT_NS + LATE_NS, "too late");
		count(0, 1);
		beat();
	}
}

int main(int argc, char **argv)
{
	hangs_up = victim_flag(&argc, argv, "--hang-up");
	over_unix = victim_flag(&argc, argv, "--unix");
	over_tcp = victim_flag(&argc, argv, "--tcp");
	sends = victim_flag(&argc, argv, "--send");
	receives = victim_flag(&argc, argv, "--receive");
	alarms = victim_flag(&argc, argv, "--alarm");
	stalls = victim_flag(&argc, argv, "--stall");
	victim_start(&argc, argv, 0,
		     "[--hang-up] [--unix|--tcp] [--send|--receive] [--alarm|--stall]");
	signal(SIGPIPE, SIG_IGN);
	for (size_t i = 0; i < BYTES; i++)
		written[i] = (uint8_t)(i * 2654435761U >> 13);
	if (stalls)
		stall();
	begin();
	if (alarms)
		set_alarms();
	victim_ready();
	for (;;) {
		if (!do_all())
			begin();
		memset(received, 0, receives ? BYTES : 0);
		count(0, 1);
		beat();
	}
}
