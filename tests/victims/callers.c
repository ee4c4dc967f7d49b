/* SPDX-License-Identifier: Apache-2.0
 *
 * Processes of one application that ask each other over Unix sockets connected by a name, as
 * clients of Python's multiprocessing managers, of D-Bus and X11 do.
 *
 *   callers CLIENTS stream|record [--again] [PATH]
 *
 * The main process answers each number with the next one.  Each client is a child that asks, and
 * waits for its answer, all the time; with --again it hangs up after every tenth, and calls again.
 * An answer to another question is a violation, and so is the end of a connection that has been
 * answered; a question without an answer shows in the counter of that client, which stands still.
 *
 * With PATH the server there is another program, or with no CLIENTS the clients are: then connections
 * may end, of clients with an error.
 */
#include <poll.h>
#include <stddef.h>
#include <sys/socket.h>
#include <sys/un.h>

#include "victim.h"

enum { CLIENTS_MAX = 32, ANSWERS_EACH = 10 };

static struct sockaddr_un address = { .sun_family = AF_UNIX };
static socklen_t address_bytes;
static int type;
static bool again, outside;

static int call(void)
{
	const int fd = socket(AF_UNIX, type | SOCK_CLOEXEC, 0);

	must(fd >= 0, "socket");
	must(!connect(fd, (struct sockaddr *)&address, address_bytes), "connect");
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

static void name_server(const char *path)
{
	char *name = address.sun_path;
	size_t room = sizeof address.sun_path;

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
	victim_start(&argc, argv, 2, "CLIENTS stream|record [--again] [PATH]");
	clients = atoi(argv[1]);
	outside = argv[3];
	must(clients >= !outside && clients <= CLIENTS_MAX, "CLIENTS");
	type = strcmp(argv[2], "record") ? SOCK_STREAM : SOCK_SEQPACKET;
	for (uint32_t i = 0; i < sizeof client / sizeof *client; i++)
		client[i] = (struct pollfd){ .fd = -1, .events = POLLIN };
	name_server(argv[3]);
	if (!outside || !clients) {
		client->fd = socket(AF_UNIX, type | SOCK_CLOEXEC, 0);
		must(client->fd >= 0 &&
			     !bind(client->fd, (struct sockaddr *)&address, address_bytes) &&
			     !listen(client->fd, CLIENTS_MAX),
		     "listen");
	}
	for (int i = 0; i < clients; i++)
		if (fork() == 0)
			ask(i);
	victim_ready();
	serve(client, sizeof client / sizeof *client);
}
