/* SPDX-License-Identifier: Apache-2.0
 *
 * stream: takes one connection after another, and messages from it, slowly: four bytes
 * of length, then as many bytes 'm'.  What is no such message is counted.
 *
 * Board counters: 0 whole messages, 1 the port, 2 connections taken, 3 what was no
 * message, 4 bytes read in all; over all restores.
 */
#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include "victim.h"

enum { LONGEST = 1 << 20, CHUNK = 4096, PAUSE_US = 1000 };

static bool take(int fd, void *to, size_t bytes)
{
	size_t got = 0;

	while (got < bytes) {
		const size_t want = bytes - got < CHUNK ? bytes - got : CHUNK;
		ssize_t n = recv(fd, (char *)to + got, want, 0);

		if (n <= 0)
			return false;
		got += (size_t)n;
		count(4, (uint64_t)n);
		if (bytes > CHUNK)
			usleep(PAUSE_US);
	}
	return true;
}

static void serve(int fd, char *body)
{
	uint32_t length;

	while (take(fd, &length, sizeof(length))) {
		if (length > LONGEST || !take(fd, body, length)) {
			count(3, 1);
			return;
		}
		if (length && (body[0] != 'm' || body[length - 1] != 'm'))
			count(3, 1);
		else
			count(0, 1);
	}
}

int main(int argc, char **argv)
{
	struct sockaddr_in at = { .sin_family = AF_INET };
	socklen_t bytes = sizeof(at);
	char *body = malloc(LONGEST);
	int listen_fd;

	victim_start(&argc, argv, 0, "");
	listen_fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
	must(body && listen_fd >= 0, "socket");
	must(!bind(listen_fd, (struct sockaddr *)&at, sizeof(at)), "bind");
	must(!listen(listen_fd, 64), "listen");
	must(!getsockname(listen_fd, (struct sockaddr *)&at, &bytes), "getsockname");
	board->counter[1] = ntohs(at.sin_port);
	victim_ready();
	for (;;) {
		int fd = accept(listen_fd, NULL, NULL);

		if (fd < 0)
			continue;
		count(2, 1);
		serve(fd, body);
		close(fd);
	}
}
