/* SPDX-License-Identifier: Apache-2.0
 *
 * Drops what an app has been sent and has not read, at a restore that is to be unlike the last one
 * (AVC_AGAIN_DROP_INPUT): a message that kills it again and again may be among that.  No process of
 * the app runs.
 *
 * Messages, and bytes in pipes, are read and forgotten.  Of a connection's bytes some may have been
 * read already, so it is ended instead, as by the end of a process; so are those that wait to be
 * accepted.
 */
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include "files.h"

#define WAITING_MAX 65536 /* connections, or messages */
#define ERRORS_MAX 3

static bool has_input(int fd)
{
	struct pollfd state = { .fd = fd, .events = POLLIN };

	return poll_for(&state, 1, 0) > 0 && state.revents & POLLIN;
}

static bool has_bytes(int fd)
{
	int bytes = 0;

	return ioctl(fd, FIONREAD, &bytes) == 0 && bytes > 0;
}

/* With nothing lingering, close(2) resets it. */
static bool end_waiting(int fd)
{
	const struct linger at_once = { .l_onoff = 1, .l_linger = 0 };
	const int flags = fcntl(fd, F_GETFL);
	bool ended = false;

	if (flags < 0 || !has_input(fd))
		return false;
	/* Another container's process that has the socket, too, may accept what was there. */
	(void)fcntl(fd, F_SETFL, flags | O_NONBLOCK);
	for (int i = 0; i < WAITING_MAX; i++) {
		const int connection = accept4(fd, NULL, NULL, SOCK_CLOEXEC);

		if (connection < 0)
			break;
		(void)setsockopt(connection, SOL_SOCKET, SO_LINGER, &at_once, sizeof at_once);
		close(connection);
		ended = true;
	}
	(void)fcntl(fd, F_SETFL, flags);
	return ended;
}

static bool end_connection(int fd, int domain)
{
	if (!has_bytes(fd))
		return false;
	return domain == AF_INET || domain == AF_INET6 ? !file_reset_tcp(fd)
						       : shutdown(fd, SHUT_RDWR) == 0;
}

/* They may be empty.  `ends`: nothing then means that the other end is closed. */
static bool drop_messages(int fd, bool ends)
{
	bool dropped = false;
	int errors = 0;
	char byte;

	for (int i = 0; i < WAITING_MAX && errors < ERRORS_MAX; i++) {
		const ssize_t bytes = recv(fd, &byte, sizeof byte, MSG_DONTWAIT);

		if ((bytes < 0 && errno == EAGAIN) || (!bytes && ends))
			break;
		errors += bytes < 0; /* one that was pending, as ECONNREFUSED */
		dropped |= bytes >= 0;
	}
	return dropped;
}

static bool drop_from_socket(int fd, bool inside)
{
	const int type = file_option(fd, SOL_SOCKET, SO_TYPE),
		  domain = file_option(fd, SOL_SOCKET, SO_DOMAIN);

	if (file_option(fd, SOL_SOCKET, SO_ACCEPTCONN) > 0)
		return end_waiting(fd);
	if (type != SOCK_STREAM)
		return drop_messages(fd, type == SOCK_SEQPACKET);
	if (!inside)
		return end_connection(fd, domain);
	return has_bytes(fd) && file_drain(fd, false);
}

static bool drop_from_pipe(int fd)
{
	int own; /* for an O_NONBLOCK of our own */
	bool dropped;

	if (!has_bytes(fd))
		return false;
	own = open_again(fd, O_RDONLY);
	dropped = own >= 0 && file_drain(own, true);
	close_fd(&own);
	return dropped;
}

bool file_drop_input(int fd, const struct file *file, bool inside)
{
	switch (file->kind) {
	case FILE_PIPE:
	case FILE_FIFO:
		return (file->flags & O_ACCMODE) != O_WRONLY && drop_from_pipe(fd);
	case FILE_SOCKET:
		return drop_from_socket(fd, inside);
	default:
		return false;
	}
}
