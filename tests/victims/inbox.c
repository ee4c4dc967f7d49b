/* SPDX-License-Identifier: Apache-2.0
 *
 * inbox: has messages waiting that kill it as soon as it looks.  It beats until counter[3] is set
 * (by a test); then any input in one of its inboxes is poison: abort().  Without any it beats on,
 * and counts in counter[0].
 *
 * Its inboxes: a pipe, a FIFO that has lost its name, pairs of datagram and stream sockets, all of
 * which it fills itself; a UDP socket (port: counter[1]); a listening TCP socket (counter[2]) and
 * the first connection of that, after which counter[4] is 1.
 */
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/stat.h>

#include "victim.h"

enum { PIPE, FIFO, DATAGRAMS, STREAM, UDP, LISTENING, CONNECTION, INBOXES };

static struct pollfd inbox[INBOXES];

static int bound(int type, int port_counter)
{
	struct sockaddr_in at = { .sin_family = AF_INET,
				  .sin_addr.s_addr = htonl(INADDR_LOOPBACK) };
	socklen_t bytes = sizeof at;
	const int fd = socket(AF_INET, type, 0);

	must(fd >= 0 && !bind(fd, (struct sockaddr *)&at, sizeof at) &&
		     !getsockname(fd, (struct sockaddr *)&at, &bytes),
	     "bind");
	board->counter[port_counter] = ntohs(at.sin_port);
	return fd;
}

static void fill(int fd)
{
	must(write(fd, "poison", 6) == 6, "write");
}

/* An end is none; an empty message is. */
static bool has_input(int i)
{
	char byte;

	if (!(inbox[i].revents & POLLIN))
		return false;
	if (i == LISTENING)
		return accept(inbox[i].fd, NULL, NULL) >= 0;
	if (i == PIPE || i == FIFO)
		return read(inbox[i].fd, &byte, 1) > 0;
	return recv(inbox[i].fd, &byte, 1, MSG_DONTWAIT) >= (i != DATAGRAMS && i != UDP);
}

int main(int argc, char **argv)
{
	char name[] = "/tmp/avckpt-inbox-XXXXXX";
	int ends[2];

	victim_start(&argc, argv, 0, "");
	must(!pipe(ends), "pipe");
	inbox[PIPE].fd = ends[0];
	fill(ends[1]);
	close(mkstemp(name));
	must(!unlink(name) && !mkfifo(name, 0600), "mkfifo");
	inbox[FIFO].fd = open(name, O_RDWR);
	must(inbox[FIFO].fd >= 0 && !unlink(name), "open");
	fill(inbox[FIFO].fd);
	must(!socketpair(AF_UNIX, SOCK_DGRAM, 0, ends), "socketpair");
	inbox[DATAGRAMS].fd = ends[0];
	fill(ends[1]);
	must(!socketpair(AF_UNIX, SOCK_STREAM, 0, ends), "socketpair");
	inbox[STREAM].fd = ends[0];
	fill(ends[1]);
	inbox[UDP].fd = bound(SOCK_DGRAM, 1);
	inbox[LISTENING].fd = bound(SOCK_STREAM, 2);
	must(!listen(inbox[LISTENING].fd, 8), "listen");
	victim_ready();
	inbox[CONNECTION].fd = accept(inbox[LISTENING].fd, NULL, NULL);
	must(inbox[CONNECTION].fd >= 0, "accept");
	for (int i = 0; i < INBOXES; i++)
		inbox[i].events = POLLIN;
	board->counter[4] = 1;
	for (;;) {
		usleep(1000);
		beat();
		if (!board->counter[3])
			continue;
		must(poll(inbox, INBOXES, 0) >= 0, "poll");
		for (int i = 0; i < INBOXES; i++)
			if (has_input(i))
				abort();
		count(0, 1);
	}
}
