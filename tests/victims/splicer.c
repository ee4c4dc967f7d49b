/* SPDX-License-Identifier: Apache-2.0
 *
 * splicer [--leave]: a thread moves bytes from a socket into a pipe (splice(2)), and waits for the
 * next one in that call nearly all the time: with the pipe's lock.  With --leave it does not; then
 * there is one byte in the pipe, which stays there.
 *
 * counter[0]: bytes moved; counter[1], counter[2]: the pipe's descriptors
 */
#include <pthread.h>
#include <sys/socket.h>

#include "victim.h"

#define PAUSE_US 2000
#define BEATS_PER_BYTE 2500

static int sockets[2], ends[2];

static void *move(void *arg)
{
	(void)arg;
	for (uint8_t expected = 0;; expected++) {
		uint8_t byte;
		ssize_t n = splice(sockets[0], NULL, ends[1], NULL, 1, 0);

		CHECK(n == 1, "splice: %zd, %s", n, strerror(errno));
		CHECK(read(ends[0], &byte, 1) == 1 && byte == expected, "another byte came");
		count(0, 1);
	}
	return NULL;
}

int main(int argc, char **argv)
{
	pthread_t mover;
	uint8_t byte = 0;
	bool leave;

	leave = victim_flag(&argc, argv, "--leave");
	victim_start(&argc, argv, 0, "[--leave]");
	must(socketpair(AF_UNIX, SOCK_STREAM, 0, sockets) == 0, "socketpair");
	must(pipe(ends) == 0, "pipe");
	board->counter[1] = (uint64_t)ends[0];
	board->counter[2] = (uint64_t)ends[1];
	if (leave)
		must(write(ends[1], &byte, 1) == 1, "write");
	else
		must(pthread_create(&mover, NULL, move, NULL) == 0, "pthread_create");
	victim_ready();
	for (uint64_t i = 0;; i++) {
		if (!leave && i % BEATS_PER_BYTE == 0) {
			must(write(sockets[1], &byte, 1) == 1, "write");
			byte++;
		}
		nap_us(PAUSE_US);
		beat();
	}
}
