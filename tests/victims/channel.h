/* SPDX-License-Identifier: Apache-2.0
 *
 * Numbered records in pipes and stream sockets: none may be lost, doubled or
 * torn, and some are always under way.
 */
#ifndef CHANNEL_H
#define CHANNEL_H

#include <sys/ioctl.h>

#include "family.h"

enum { IN_FLIGHT = 3, AT_ONCE = 16 };

/* Records of eight bytes: which channel, and the how-manieth. */
struct channel {
	int fd;
	uint64_t id, seq;
};

static void send_some(struct channel *c, uint64_t *random)
{
	int n = (int)(next_random(random) % 6);

	while (n--) {
		const uint64_t record = mix(c->id, c->seq + 1);
		const ssize_t done = write(c->fd, &record, sizeof(record));

		if (done < 0 && errno == EAGAIN)
			return;
		if (done < 0 && (errno == EPIPE || errno == ECONNRESET))
			came_apart("channel %lu: %s", c->id, strerror(errno));
		CHECK(done == sizeof(record), "channel %lu: write: %zd, %s", c->id, done,
		      strerror(errno));
		c->seq++;
	}
}

static void take(struct channel *c)
{
	uint64_t record = 0;
	const ssize_t done = read(c->fd, &record, sizeof(record));

	if (done == 0 || (done < 0 && errno == ECONNRESET))
		came_apart("channel %lu has ended after record %lu", c->id, c->seq);
	CHECK(done == sizeof(record), "channel %lu: read: %zd, %s", c->id, done, strerror(errno));
	CHECK(record == mix(c->id, c->seq + 1), "channel %lu: record %lu is %lx", c->id, c->seq + 1,
	      record);
	c->seq++;
}

/* Leaves some, so that there are always bytes on the way.  Nor does it take all of a full pipe:
 * where CPUs are short, whoever reads from many others would never get round. */
static void take_some(struct channel *c)
{
	int bytes = 0, n;

	CHECK(ioctl(c->fd, FIONREAD, &bytes) == 0, "FIONREAD: %s", strerror(errno));
	CHECK(bytes % 8 == 0, "channel %lu holds %d bytes", c->id, bytes);
	for (n = 0; n < AT_ONCE && bytes > 8 * IN_FLIGHT; n++, bytes -= 8)
		take(c);
}

static void make_pipe(int *in, int *out)
{
	int fds[2];

	must(pipe(fds) == 0, "pipe");
	must(fcntl(fds[1], F_SETFL, O_NONBLOCK) == 0, "F_SETFL");
	*in = fds[0];
	*out = fds[1];
}

#endif
