/* SPDX-License-Identifier: Apache-2.0
 *
 * client ADDRESS PORT --every-us N [--log FILE] [--board FILE] [--seconds N]
 *
 * Sends a request every N us, whether or not earlier ones were answered (a client
 * that waited would ask nothing while the server stands still, and so not see it),
 * and takes the answers as they come.  When the connection ends it connects
 * again, every millisecond until that works.
 *
 * Board: a beat is an answer, so its gap is the longest time without one.  Counters:
 *   0 answers   1 connections   2 the server's PID   3 its token   4 requests it
 *   remembers   5 requests sent   6 connections that ended   7 connections refused
 * --log: for each answer when its request was sent and when it came, u64 ns each.
 */
#include <arpa/inet.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/prctl.h>
#include <sys/socket.h>

#include "exchange.h"
#include "victim.h"

enum { BUFFER = 1 << 16, RETRY_NS = 1000000 };

static FILE *log_file;
static struct sockaddr_in at = { .sin_family = AF_INET };
static unsigned char buffer[BUFFER];
static size_t length;

/* -1: not now. */
static int connect_once(void)
{
	int fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0), one = 1;

	must(fd >= 0, "socket");
	if (connect(fd, (struct sockaddr *)&at, sizeof(at))) {
		close(fd);
		count(7, 1);
		return -1;
	}
	setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof(one));
	count(1, 1);
	length = 0;
	return fd;
}

static void take(const struct reply *reply)
{
	const uint64_t times[2] = { reply->sent_ns, now_ns() };

	count(0, 1);
	board->counter[2] = reply->pid;
	board->counter[3] = reply->token;
	board->counter[4] = reply->served;
	beat();
	if (log_file)
		fwrite(times, sizeof(times), 1, log_file);
}

/* False: the connection has ended. */
static bool receive(int fd)
{
	ssize_t n = recv(fd, buffer + length, BUFFER - length, MSG_DONTWAIT);
	size_t done;

	if (n < 0)
		return errno == EAGAIN || errno == EINTR;
	if (n == 0)
		return false;
	length += (size_t)n;
	for (done = 0; done + sizeof(struct reply) <= length; done += sizeof(struct reply)) {
		struct reply reply;

		memcpy(&reply, buffer + done, sizeof(reply));
		take(&reply);
	}
	length -= done;
	memmove(buffer, buffer + done, length);
	return true;
}

static bool send_one(int fd, uint64_t number)
{
	const struct request request = { number, now_ns() };
	ssize_t n = send(fd, &request, sizeof(request), MSG_NOSIGNAL | MSG_DONTWAIT);

	if (n == sizeof(request)) {
		count(5, 1);
		return true;
	}
	/* A server that stands still for seconds fills the buffers: nothing is sent. */
	return n < 0 && errno == EAGAIN;
}

static void close_log(void)
{
	if (log_file)
		fclose(log_file);
}

int main(int argc, char **argv)
{
	uint64_t every_ns = 1000000, next_ns, retry_ns = 0, end_ns;
	int fd = -1;

	victim_start(&argc, argv, 2, "ADDRESS PORT --every-us N [--log FILE]");
	/* Ends by itself below, after the log is written. */
	end_ns = victim_end_ns;
	victim_end_ns = 0;
	for (int i = 1; i + 1 < argc; i++) {
		if (!strcmp(argv[i], "--every-us"))
			every_ns = (uint64_t)atol(argv[i + 1]) * 1000;
		if (!strcmp(argv[i], "--log"))
			must((log_file = fopen(argv[i + 1], "w")) != NULL, argv[i + 1]);
	}
	must(inet_pton(AF_INET, argv[1], &at.sin_addr) == 1, "ADDRESS");
	at.sin_port = htons((uint16_t)atoi(argv[2]));
	prctl(PR_SET_TIMERSLACK, 1);
	victim_ready();
	next_ns = now_ns();
	for (uint64_t number = 1;;) {
		struct pollfd readable = { .fd = fd, .events = POLLIN };
		struct timespec wait = { 0, 0 };
		uint64_t now = now_ns();

		if (end_ns && now >= end_ns)
			break;
		if (fd < 0 && now >= retry_ns) {
			fd = connect_once();
			retry_ns = now + RETRY_NS;
			readable.fd = fd;
		}
		if (now >= next_ns) {
			/* Late by more than a few: leave out, or a slow client would make a burst. */
			next_ns = now > next_ns + 4 * every_ns ? now + every_ns
							       : next_ns + every_ns;
			if (fd >= 0 && !send_one(fd, number++)) {
				count(6, 1);
				close(fd);
				fd = readable.fd = -1;
			}
		}
		now = now_ns();
		if (next_ns > now)
			wait.tv_nsec = (long)(next_ns - now);
		if (fd < 0 && wait.tv_nsec > RETRY_NS)
			wait.tv_nsec = RETRY_NS;
		if (ppoll(&readable, 1, &wait, NULL) > 0 && !receive(fd)) {
			count(6, 1);
			close(fd);
			fd = -1;
		}
	}
	close_log();
	return 0;
}
