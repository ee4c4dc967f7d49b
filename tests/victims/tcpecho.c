/* SPDX-License-Identifier: Apache-2.0
 *
 * tcpecho PORT: one thread, epoll, any number of connections.  PORT 0: any; the
 * port is board counter 1.  A line is answered by "NUMBER LINE", NUMBER being how
 * many lines this connection has sent.  Some lines do more:
 *
 *   close          closes the connection (after the answer)
 *   listenclose    closes the listening socket
 *   open FILE      opens a file for appending, creating it
 *   write TEXT     writes a line to it
 *   fclose         closes it
 *   pid            the answer is "NUMBER pid PID"
 *
 * Board counter 0: lines answered over all restores.
 */
#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <signal.h>
#include <sys/epoll.h>
#include <sys/socket.h>

#include "victim.h"

enum { LINE = 4096 };

struct connection {
	int fd;
	uint64_t lines;
	size_t length;
	char buffer[LINE];
};

static int epoll_fd, listen_fd, file_fd = -1;
static struct connection listener; /* its address marks the listening socket */

static void watch(int fd, void *who)
{
	struct epoll_event event = { .events = EPOLLIN, .data.ptr = who };

	must(!epoll_ctl(epoll_fd, EPOLL_CTL_ADD, fd, &event), "epoll_ctl");
}

static void hang_up(struct connection *c)
{
	close(c->fd);
	free(c);
}

static void take_connection(void)
{
	int fd = accept4(listen_fd, NULL, NULL, SOCK_CLOEXEC), one = 1;
	struct connection *c;

	if (fd < 0) {
		CHECK(errno == EAGAIN || errno == ECONNABORTED, "accept: %s", strerror(errno));
		return;
	}
	setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof(one));
	c = calloc(1, sizeof(*c));
	must(c, "calloc");
	c->fd = fd;
	watch(fd, c);
}

/* False: the connection is over. */
static bool answer(struct connection *c, char *line)
{
	char text[LINE + 32];
	int n;

	if (!strcmp(line, "listenclose") && listen_fd >= 0) {
		close(listen_fd);
		listen_fd = -1;
	} else if (!strncmp(line, "open ", 5)) {
		file_fd = open(line + 5, O_RDWR | O_CREAT | O_APPEND | O_CLOEXEC, 0666);
		CHECK(file_fd >= 0, "open %s: %s", line + 5, strerror(errno));
	} else if (!strncmp(line, "write ", 6)) {
		CHECK(dprintf(file_fd, "%s\n", line + 6) > 0, "write: %s", strerror(errno));
	} else if (!strcmp(line, "fclose")) {
		CHECK(!close(file_fd), "close: %s", strerror(errno));
		file_fd = -1;
	}
	c->lines++;
	if (!strcmp(line, "pid"))
		n = snprintf(text, sizeof(text), "%lu pid %d\n", c->lines, getpid());
	else
		n = snprintf(text, sizeof(text), "%lu %s\n", c->lines, line);
	if (send(c->fd, text, (size_t)n, MSG_NOSIGNAL) != n)
		return false;
	count(0, 1);
	return strcmp(line, "close") != 0;
}

static void serve(struct connection *c)
{
	ssize_t n = recv(c->fd, c->buffer + c->length, LINE - 1 - c->length, MSG_DONTWAIT);
	char *end;

	if (n < 0 && errno == EAGAIN)
		return;
	if (n <= 0) {
		CHECK(n == 0 || errno == ECONNRESET || errno == ETIMEDOUT, "recv: %s",
		      strerror(errno));
		hang_up(c);
		return;
	}
	c->length += (size_t)n;
	c->buffer[c->length] = '\0';
	while ((end = strchr(c->buffer, '\n'))) {
		*end = '\0';
		if (!answer(c, c->buffer)) {
			hang_up(c);
			return;
		}
		c->length -= (size_t)(end + 1 - c->buffer);
		memmove(c->buffer, end + 1, c->length + 1);
	}
}

int main(int argc, char **argv)
{
	struct sockaddr_in at = { .sin_family = AF_INET };
	socklen_t length = sizeof(at);
	int one = 1;

	victim_start(&argc, argv, 1, "PORT");
	signal(SIGPIPE, SIG_IGN);
	epoll_fd = epoll_create1(EPOLL_CLOEXEC);
	listen_fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0);
	must(epoll_fd >= 0 && listen_fd >= 0, "socket");
	setsockopt(listen_fd, SOL_SOCKET, SO_REUSEADDR, &one, sizeof(one));
	at.sin_port = htons((uint16_t)atoi(argv[1]));
	must(!bind(listen_fd, (struct sockaddr *)&at, sizeof(at)), "bind");
	must(!listen(listen_fd, 64), "listen");
	must(!getsockname(listen_fd, (struct sockaddr *)&at, &length), "getsockname");
	board->counter[1] = ntohs(at.sin_port);
	watch(listen_fd, &listener);
	victim_ready();
	for (;;) {
		struct epoll_event events[16];
		int n = epoll_wait(epoll_fd, events, 16, 5), i;

		CHECK(n >= 0, "epoll_wait: %s", strerror(errno));
		beat();
		for (i = 0; i < n; i++) {
			if (events[i].data.ptr == &listener)
				take_connection();
			else
				serve(events[i].data.ptr);
		}
	}
}
