/* SPDX-License-Identifier: Apache-2.0
 *
 * Peeks at the contents of Unix sockets: bytes or messages, and descriptors in flight with them
 * (SCM_RIGHTS). Each peek receives these, because there is no other way to identify them.  Closing
 * one may block on a file server, so that waits for the end of the freeze, and is done aside.
 */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/sysmacros.h>
#include <sys/uio.h>
#include <unistd.h>

#include "files.h"

#define MESSAGE_MAX (256 << 10) /* the default size of a socket's buffer */
#define LANDED_MAX 1024
#define LAND_NS NS_PER_S
#define RIGHTS_UNKNOWN UINT64_MAX
#define SCM_PIDFD_ 4 /* linux/socket.h, since Linux 6.5                              */
/* Ancillary data of a message: 253 descriptors, and more that socket options request. */
#define CONTROL_BYTES 2048

/* ---- descriptors that came along ----------------------------------------------------------------- */

struct landing {
	struct aside aside;
	uint32_t count;
	int fd[LANDED_MAX];
};

static struct landing *landing; /* NULL: none                                          */
static int left_behind;

static void close_landed(struct aside *aside)
{
	struct landing *job = (struct landing *)aside;

	while (job->count) {
		aside_step();
		close(job->fd[--job->count]);
	}
}

static void drop_landing(struct aside *aside)
{
	free(aside);
}

static bool can_land(void)
{
	if (!landing && !__atomic_load_n(&left_behind, __ATOMIC_ACQUIRE))
		landing = calloc(1, sizeof *landing);
	return landing && landing->count + CONTROL_BYTES / sizeof(int) <= LANDED_MAX;
}

void file_close_later(int fd)
{
	if (can_land())
		landing->fd[landing->count++] = fd;
	else
		close(fd);
}

void files_land(void)
{
	struct landing *job = landing;

	if (!job || !job->count)
		return;
	landing = NULL;
	job->aside = (struct aside){ close_landed, drop_landing, &left_behind };
	if (aside_run(&job->aside, LAND_NS))
		free(job);
}

/* One more, or none if there is no memory: then it is lost. */
static void note_flight(int fd, const struct statx *st, struct file *file)
{
	struct file_flight *more = realloc(file->flight,
					   (file->flight_count + 1) * sizeof *file->flight);

	file->rights_lost |= !more;
	if (!more)
		return;
	file->flight = more;
	more[file->flight_count] = (struct file_flight){
		.at = file->content_bytes,
		.dev = makedev(st->stx_dev_major, st->stx_dev_minor),
		.ino = st->stx_ino,
		.mode = st->stx_mode,
		.flags = fcntl(fd, F_GETFL),
	};
	if (S_ISSOCK(st->stx_mode)) {
		more[file->flight_count].domain = fd_option(fd, SOL_SOCKET, SO_DOMAIN);
		more[file->flight_count].type = fd_option(fd, SOL_SOCKET, SO_TYPE);
		more[file->flight_count].protocol = fd_option(fd, SOL_SOCKET, SO_PROTOCOL);
	}
	file->flight_count++;
}

/* Not in a freeze: it may block. */
static void note_rights(int fd, struct file *file)
{
	struct statx st = { 0 };
	uint64_t mark = RIGHTS_UNKNOWN;

	if (fd_look(fd, STATX_TYPE | STATX_INO, &st))
		mark = st.stx_ino * 31 + st.stx_dev_minor * 7919 + st.stx_dev_major +
		       ((uint64_t)st.stx_mode << 48) + ((uint64_t)st.stx_rdev_minor << 32);
	note_flight(fd, &st, file);
	file->rights = file->rights * 1099511628211u + mark + 1;
}

static void land(const struct cmsghdr *c, bool rights, struct file *file)
{
	const size_t count = (c->cmsg_len - CMSG_LEN(0)) / sizeof(int);

	for (size_t i = 0; i < count; i++) {
		int fd;

		memcpy(&fd, CMSG_DATA(c) + i * sizeof fd, sizeof fd);
		landing->fd[landing->count++] = fd;
		if (rights)
			note_rights(fd, file);
	}
}

static void hear_control(struct msghdr *head, struct file *file)
{
	for (struct cmsghdr *c = CMSG_FIRSTHDR(head); c; c = CMSG_NXTHDR(head, c)) {
		if (c->cmsg_level != SOL_SOCKET)
			continue;
		if (c->cmsg_type == SCM_RIGHTS || c->cmsg_type == SCM_PIDFD_)
			land(c, c->cmsg_type == SCM_RIGHTS, file);
		file->senders_lost |= c->cmsg_type == SCM_CREDENTIALS;
	}
}

/* ---- looks --------------------------------------------------------------------------------------- */

/* Only peeks.  Bytes, or -1; a message is truncated, but its full length is returned. */
static ssize_t peek(int fd, struct file *file, void *to, size_t room)
{
	uint8_t control[CONTROL_BYTES] __attribute__((aligned(8)));
	struct iovec io = { to, room };
	const bool lands = can_land();
	struct msghdr head = { .msg_iov = &io,
			       .msg_iovlen = 1,
			       .msg_control = lands ? control : NULL,
			       .msg_controllen = lands ? sizeof control : 0 };
	const ssize_t n = recvmsg(fd, &head,
				  MSG_PEEK | MSG_DONTWAIT | MSG_TRUNC | MSG_CMSG_CLOEXEC);

	if (n < 0)
		return n;
	if (lands)
		hear_control(&head, file);
	/* No room for them: truncation shows that there are some. */
	if (head.msg_flags & MSG_CTRUNC && (lands || fd_option(fd, SOL_SOCKET, SO_PASSCRED) <= 0)) {
		file->rights_lost = true;
		file->rights = RIGHTS_UNKNOWN;
	}
	return n;
}

/* The kernel advances with every peek, once an offset is set.  Messages are kept with their lengths
 * before them; in a stream, data with descriptors is a separate piece. */
static void look_through(int fd, struct file *file)
{
	const bool stream = file->socket->type == SOCK_STREAM;
	const size_t length = stream ? 0 : sizeof(uint32_t);
	size_t used = 0;

	for (;;) {
		uint8_t *more = realloc(file->content, used + length + MESSAGE_MAX);
		uint32_t bytes;
		ssize_t n;

		if (more)
			file->content = more;
		file->content_bytes = (uint32_t)used; /* where what comes along belongs */
		n = more ? peek(fd, file, more + used + length, MESSAGE_MAX) : MESSAGE_MAX + 1;
		/* The peek offset cannot move past an empty datagram; on other sockets it is the
		 * end. */
		file->content_lost |=
			n > MESSAGE_MAX ||
			(n > 0 && (used + (size_t)n > CONTENT_MAX || !budget_has((uint64_t)n))) ||
			(n == 0 && file->socket->type == SOCK_DGRAM);
		if (n <= 0 || file->content_lost)
			break;
		bytes = (uint32_t)n;
		(void)budget_take(bytes);
		memcpy(file->content + used, &bytes, length);
		used += length + bytes;
		for (uint32_t i = file->flight_count;
		     i && file->flight[i - 1].at == file->content_bytes; i--)
			file->flight[i - 1].end = (uint32_t)used;
	}
	file->content_bytes = (uint32_t)used;
}

/* There was room for the largest. */
static void trim(struct file *file)
{
	uint8_t *less = file->content_bytes ? realloc(file->content, file->content_bytes) : NULL;

	if (!file->content_bytes) {
		free(file->content);
		file->content = NULL;
	} else if (less) {
		file->content = less;
	}
}

/* It is an option of the app's socket, which is reset even if we die. */
static void look_again(struct process *process, int fd, struct file *file)
{
	const int first = 0, before = fd_option(fd, SOL_SOCKET, SO_PEEK_OFF);

	if (parasite_set_undo(process, SYS_setsockopt,
			      ARGUMENTS((uint64_t)file->fd, SOL_SOCKET, SO_PEEK_OFF,
					(uint64_t)(int64_t)before, sizeof before))) {
		file->content_lost = true;
		return;
	}
	if (setsockopt(fd, SOL_SOCKET, SO_PEEK_OFF, &first, sizeof first))
		file->content_lost = true;
	else
		look_through(fd, file);
	setsockopt(fd, SOL_SOCKET, SO_PEEK_OFF, &before, sizeof before);
	parasite_clear_undo(process);
	trim(file);
}

void file_keep_messages(struct process *process, int fd, struct file *file, uint32_t bytes)
{
	ssize_t n;

	if (file->socket->type != SOCK_STREAM) {
		look_again(process, fd, file);
		return;
	}
	file->content = bytes <= CONTENT_MAX && budget_take(bytes) ? malloc(bytes) : NULL;
	if (!file->content) {
		file->content_lost = true;
		return;
	}
	n = peek(fd, file, file->content, bytes);
	file->content_bytes = n > 0 ? (uint32_t)n : 0;
	if (n == bytes)
		return;
	/* A peek ends at a descriptor in flight. */
	file->rights = file->flight_count = 0;
	look_again(process, fd, file);
	file->content_lost |= file->content_bytes != bytes;
}

bool file_has_messages(int fd, const struct file *want)
{
	const int first = 0, before = fd_option(fd, SOL_SOCKET, SO_PEEK_OFF);
	struct file is = { .kind = FILE_SOCKET, .socket = want->socket };
	bool same;

	if (!want->content_bytes || want->content_lost || want->rights == RIGHTS_UNKNOWN ||
	    setsockopt(fd, SOL_SOCKET, SO_PEEK_OFF, &first, sizeof first))
		return false;
	look_through(fd, &is);
	setsockopt(fd, SOL_SOCKET, SO_PEEK_OFF, &before, sizeof before);
	files_land();
	same = !is.content_lost && is.content_bytes == want->content_bytes &&
	       is.rights == want->rights && !memcmp(is.content, want->content, is.content_bytes);
	free(is.content);
	free(is.flight);
	return same;
}

/* ---- ends that are shut ---------------------------------------------------------------------------- */

/* The kernel checks whether sending is possible before it reads the message. */
static bool is_out_shut(int fd)
{
	return send(fd, (const void *)1, 1, MSG_DONTWAIT | MSG_NOSIGNAL) < 0 && errno == EPIPE;
}

uint8_t file_shut(int fd)
{
	struct pollfd in = { .fd = fd, .events = POLLRDHUP };
	const bool is_in = poll_for(&in, 1, 0) == 1 && in.revents & POLLRDHUP;

	return (uint8_t)((is_in ? SHUT_IN : 0) | (is_out_shut(fd) ? SHUT_OUT : 0));
}
