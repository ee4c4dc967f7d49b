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
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include "files.h"

#define EMPTY_NS (100 * NS_PER_MS) /* of one socket; outsiders may keep sending to it */
#define ERRORS_MAX 3

static bool has_bytes(int fd)
{
	int bytes = 0;

	return ioctl(fd, FIONREAD, &bytes) == 0 && bytes > 0;
}

/* With nothing lingering, close(2) resets them.  Other containers' processes that have the socket, too,
 * may accept what was there: so it must not block. */
bool file_turn_away(int fd)
{
	const struct linger reset = { .l_onoff = 1 };
	const uint64_t end = now_ns() + EMPTY_NS;
	const int flags = fcntl(fd, F_GETFL);
	bool any = false;

	if (flags < 0 || fcntl(fd, F_SETFL, flags | O_NONBLOCK))
		return false;
	while (now_ns() < end) {
		const int caller = accept4(fd, NULL, NULL, SOCK_CLOEXEC);

		if (caller < 0)
			break;
		(void)setsockopt(caller, SOL_SOCKET, SO_LINGER, &reset, sizeof reset);
		close(caller);
		any = true;
	}
	(void)fcntl(fd, F_SETFL, flags);
	return any;
}

bool file_empty_socket(int fd, bool ends)
{
	const uint64_t end = now_ns() + EMPTY_NS;
	bool any = false;
	int errors = 0;
	char buf[4096];

	while (errors < ERRORS_MAX && now_ns() < end) {
		const ssize_t bytes = recv(fd, buf, sizeof buf, MSG_DONTWAIT | MSG_TRUNC);

		if ((bytes < 0 && errno == EAGAIN) || (!bytes && ends))
			break;
		errors += bytes < 0; /* one that was pending, as ECONNREFUSED */
		any |= bytes >= 0;
		(void)budget_step();
	}
	return any;
}

static bool end_connection(int fd, int domain, const struct file *file)
{
	if (!has_bytes(fd))
		return false;
	return domain == AF_INET || domain == AF_INET6 ? !file_lose_tcp(fd, file)
						       : shutdown(fd, SHUT_RDWR) == 0;
}

static bool drop_from_socket(int fd, const struct file *file, bool inside)
{
	const int type = fd_option(fd, SOL_SOCKET, SO_TYPE),
		  domain = fd_option(fd, SOL_SOCKET, SO_DOMAIN);

	if (fd_option(fd, SOL_SOCKET, SO_ACCEPTCONN) > 0)
		return file_turn_away(fd);
	if (type == SOCK_STREAM && !inside)
		return end_connection(fd, domain, file);
	return file_empty_socket(fd, type == SOCK_STREAM || type == SOCK_SEQPACKET);
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
		return drop_from_socket(fd, file, inside || file->goes_on);
	default:
		return false;
	}
}
