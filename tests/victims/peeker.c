/* SPDX-License-Identifier: Apache-2.0
 *
 * peeker: datagrams and records lie in sockets unread.  What a look at them (MSG_PEEK) finds,
 * and every option of theirs that such a look could change, stays as it was, also an offset
 * that the program has set itself (SO_PEEK_OFF).
 */
#include <sys/socket.h>

#include "victim.h"

#define MESSAGES 3

static const int types[] = { SOCK_DGRAM, SOCK_SEQPACKET, SOCK_DGRAM };
#define PAIRS (sizeof types / sizeof *types)
static int end[PAIRS];

static int peek_offset(int fd)
{
	int offset = -2;
	socklen_t bytes = sizeof offset;

	must(getsockopt(fd, SOL_SOCKET, SO_PEEK_OFF, &offset, &bytes) == 0, "SO_PEEK_OFF");
	return offset;
}

static void fill(size_t i)
{
	const int zero = 0;
	int ends[2];
	char message[8];

	must(socketpair(AF_UNIX, types[i], 0, ends) == 0, "socketpair");
	for (int k = 0; k < MESSAGES; k++) {
		snprintf(message, sizeof message, "msg%d", k);
		must(send(ends[1], message, 4, 0) == 4, "send");
	}
	end[i] = ends[0];
	if (i == PAIRS - 1)
		must(setsockopt(ends[0], SOL_SOCKET, SO_PEEK_OFF, &zero, sizeof zero) == 0,
		     "SO_PEEK_OFF");
}

int main(int argc, char **argv)
{
	victim_start(&argc, argv, 0, "");
	for (size_t i = 0; i < PAIRS; i++)
		fill(i);
	victim_ready();
	for (;;) {
		for (size_t i = 0; i < PAIRS; i++) {
			char message[8] = "";
			const int offset = i == PAIRS - 1 ? 0 : -1;
			const int zero = 0;

			CHECK(peek_offset(end[i]) == offset, "SO_PEEK_OFF of socket %zu is %d", i,
			      peek_offset(end[i]));
			CHECK(recv(end[i], message, sizeof message, MSG_PEEK | MSG_DONTWAIT) == 4 &&
				      !memcmp(message, "msg0", 4),
			      "the first message of socket %zu is \"%s\"", i, message);
			/* Its own look has moved it on. */
			if (!offset)
				setsockopt(end[i], SOL_SOCKET, SO_PEEK_OFF, &zero, sizeof zero);
		}
		beat();
		nap_us(200);
	}
}
