/* SPDX-License-Identifier: Apache-2.0
 *
 * A dead app that goes back together with others (avckpt.group.recovery=together): what they
 * have sent to each other since is taken away, and nobody runs who could send more.
 *
 * TCP connections on which something moved are reset, at both ends, before anything of them
 * is looked at for the restore: after the other end's reset there may still be something to
 * read.  Nothing counts the bytes of a Unix connection or the datagrams.
 */
#include <fcntl.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

#include "files.h"

#define EMPTY_NS (100 * NS_PER_MS) /* of one socket; others may go on to send to it        */

static void empty(int fd)
{
	const uint64_t end = now_ns() + EMPTY_NS;
	char buf[4096];

	while (recv(fd, buf, sizeof buf, MSG_DONTWAIT | MSG_TRUNC) > 0 && now_ns() < end)
		(void)budget_step();
}

/* What has been said on a connection that nobody has accepted yet may not be true any more.  That
 * it does not wait now is put back with all other flags. */
static void turn_away(int fd)
{
	const struct linger reset = { .l_onoff = 1 };
	const uint64_t end = now_ns() + EMPTY_NS;
	int caller = 0;

	if (fcntl(fd, F_SETFL, fcntl(fd, F_GETFL) | O_NONBLOCK))
		return;
	while (caller >= 0 && now_ns() < end) {
		caller = accept4(fd, NULL, NULL, SOCK_CLOEXEC);
		if (caller < 0)
			break;
		setsockopt(caller, SOL_SOCKET, SO_LINGER, &reset, sizeof reset);
		close(caller);
	}
}

/* Both ends of one without a name are the app's own (socketpair(2)). */
static bool has_name(const struct file_socket *s)
{
	return s->local_bytes > sizeof(sa_family_t) || s->remote_bytes > sizeof(sa_family_t);
}

/* What was on its way at the checkpoint and has come since counts, too. */
static bool has_moved(int fd, const struct file *then)
{
	struct file now = { 0 };

	file_look_at_tcp(fd, &now, then->socket);
	return now.tcp_state != then->tcp_state || file_tcp_moved(then, &now) ||
	       now.tcp_unread != then->tcp_unread;
}

static void forget(int fd, const struct file *then, const struct avc_config *config)
{
	const struct file_socket *s = then->socket;

	if (s->domain != AF_UNIX && s->domain != AF_INET && s->domain != AF_INET6)
		return;
	if (s->listening) {
		turn_away(fd);
	} else if (s->type == SOCK_DGRAM) {
		if (s->domain != AF_UNIX || has_name(s))
			empty(fd);
	} else if (s->domain == AF_UNIX && s->connected && has_name(s)) {
		shutdown(fd, SHUT_RDWR);
		empty(fd);
	} else if (s->protocol == IPPROTO_TCP && (s->connected || then->tcp_state) &&
		   (config->tcp == AVC_TCP_RESET || has_moved(fd, then))) {
		/* Which takes away what there is to be read, also of one that is closed. */
		(void)file_reset_tcp(fd);
	}
}

void files_forget_others(const struct image *image, int pidfd, const struct avc_config *config)
{
	const struct files *files = image->files;

	for (uint32_t i = 0; files && i < files->count; i++) {
		const struct file *f = &files->file[i];
		struct stat st;
		int fd;

		if (f->kind != FILE_SOCKET || !f->socket || f->outside ||
		    files_leader(files, f) != i)
			continue;
		fd = proc_borrow_fd(pidfd, f->fd);
		/* Or it was closed since. */
		if (fd >= 0 && fstat(fd, &st) == 0 && st.st_ino == f->ino)
			forget(fd, f, config);
		close_fd(&fd);
	}
}
