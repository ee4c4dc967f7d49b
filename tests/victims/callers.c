/* SPDX-License-Identifier: Apache-2.0
 *
 * Processes of one application that ask each other over Unix sockets connected by a name, as
 * clients of Python's multiprocessing managers, of D-Bus and X11 do; or over TCP, as Dask does.
 *
 *   callers CLIENTS stream|record|tcp|tcp6 [--again] [PATH]
 *
 * The main process answers each number with the next one.  Each client is a child that asks, and
 * waits for its answer, all the time; with --again it hangs up after every tenth, and calls again.
 * An answer to another question is a violation, and so is the end of a connection that has been
 * answered; a question without an answer shows in the counter of that client, which stands still.
 *
 * With PATH the server there is another program, or with no CLIENTS the clients are: then connections
 * may end, of clients with an error.
 */
#include <netinet/in.h>
#include <poll.h>
#include <stddef.h>
#include <sys/socket.h>
#include <sys/un.h>

#include "victim.h"

enum { CLIENTS_MAX = 32, ANSWERS_EACH = 10 };

static union {
	struct sockaddr any;
	struct sockaddr_un un;
	struct sockaddr_in v4;
	struct sockaddr_in6 v6;
} address;
static socklen_t address_bytes;
static int type;
static bool again, outside;

static int call(void)
{
	const int fd = socket(address.any.sa_family, type | SOCK_CLOEXEC, 0);

	must(fd >= 0, "socket");
	must(!connect(fd, &address.any, address_bytes), "connect");
	return fd;
}

static void ask(int number)
{
	uint64_t asked = (uint64_t)number << 32, answer;
	int fd = -1, answers = 0;

	for (;;) {
		ssize_t n = -1;

		if (fd < 0)
			fd = call();
		if (send(fd, &asked, sizeof asked, MSG_NOSIGNAL) == sizeof asked)
			n = recv(fd, &answer, sizeof answer, MSG_WAITALL);
		if (n != sizeof answer) {
			/* It had not been accepted at the checkpoint. */
			CHECK((again && !answers) || (outside && n < 0),
			      "hung up by the server after %d answers (%zd)", answers, n);
			close(fd);
			fd = -1;
			continue;
		}
		CHECK(answer == asked + 1, "%lx is no answer to %lx", answer, asked);
		asked = answer;
		count((unsigned)number, 1);
		/* Over the loopback without a pause, nobody else gets a CPU for seconds. */
		if (address.any.sa_family != AF_UNIX)
			usleep(500);
		if (!again || ++answers % ANSWERS_EACH)
			continue;
		close(fd);
		fd = -1;
		answers = 0;
	}
}

static void answer(struct pollfd *client)
{
	uint64_t asked;
	const ssize_t n = recv(client->fd, &asked, sizeof asked, MSG_WAITALL);

	if (n == sizeof asked && ++asked &&
	    send(client->fd, &asked, sizeof asked, MSG_NOSIGNAL) == sizeof asked)
		return;
	/* One that called since the checkpoint, and died before it was accepted, may have asked. */
	CHECK((again || outside) && (n <= 0 || n == sizeof asked), "a client has gone: %zd", n);
	close(client->fd);
	client->fd = -1;
}

static void serve(struct pollfd *client, uint32_t room)
{
	for (;;) {
		beat();
		if (poll(client, room, 5) < 0)
			continue;
		for (uint32_t i = 1; i < room; i++)
			if (client[i].fd >= 0 && client[i].revents)
				answer(&client[i]);
		for (uint32_t i = 1; client->revents && i < room; i++)
			if (client[i].fd < 0) {
				client[i].fd = accept4(client->fd, NULL, NULL, SOCK_CLOEXEC);
				must(client[i].fd >= 0, "accept");
				break;
			}
	}
}

static void name_server(const char *how, const char *path)
{
	char *name = address.un.sun_path;
	size_t room = sizeof address.un.sun_path;

	if (!strcmp(how, "tcp")) {
		address.v4.sin_family = AF_INET;
		address.v4.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
		address_bytes = sizeof address.v4;
		return;
	}
	if (!strcmp(how, "tcp6")) {
		address.v6.sin6_family = AF_INET6;
		address.v6.sin6_addr = in6addr_loopback;
		address_bytes = sizeof address.v6;
		return;
	}
	address.un.sun_family = AF_UNIX;
	if (path)
		name += snprintf(name, room, "%s", path);
	else /* an abstract name, which no other has: the board's */
		name += 1 + snprintf(name + 1, room - 1, "callers-%lx", now_ns());
	address_bytes = (socklen_t)(name - (char *)&address);
}

int main(int argc, char **argv)
{
	struct pollfd client[2 * CLIENTS_MAX + 1];
	int clients;

	again = victim_flag(&argc, argv, "--again");
	victim_start(&argc, argv, 2, "CLIENTS stream|record|tcp|tcp6 [--again] [PATH]");
	clients = atoi(argv[1]);
	outside = argv[3];
	must(clients >= !outside && clients <= CLIENTS_MAX, "CLIENTS");
	type = strcmp(argv[2], "record") ? SOCK_STREAM : SOCK_SEQPACKET;
	for (uint32_t i = 0; i < sizeof client / sizeof *client; i++)
		client[i] = (struct pollfd){ .fd = -1, .events = POLLIN };
	name_server(argv[2], argv[3]);
	if (!outside || !clients) {
		client->fd = socket(address.any.sa_family, type | SOCK_CLOEXEC, 0);
		must(client->fd >= 0 && !bind(client->fd, &address.any, address_bytes) &&
			     !listen(client->fd, CLIENTS_MAX) &&
			     !getsockname(client->fd, &address.any, &address_bytes),
		     "listen");
	}
	for (int i = 0; i < clients; i++)
		if (fork() == 0)
			ask(i);
	victim_ready();
	serve(client, sizeof client / sizeof *client);
}
