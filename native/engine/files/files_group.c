/* SPDX-License-Identifier: Apache-2.0
 *
 * A dead app that goes back together with others (avckpt.group.recovery=together): discards what
 * they have sent to each other since, while none runs that could send more.
 *
 * A connection is kept if both of its ends go back.  The kernel's sockets are the current ones:
 * both ends are read up to what the other one has written, and then the data in flight at the line
 * is sent again, by the socket that had sent it.  The receiving end has a copy of that data: it was
 * in its queue while all were stopped.  Where that cannot be done, and on all other connections on
 * which data moved, TCP is reset at both ends, before the restore reads their state: after the
 * other end's reset there may still be unread data.
 *
 * Guards match the ends of a connection on a board that they share (avckpt/guard.h).  An app without
 * a group has one of its own, for TCP connections between its own processes.
 */
#include <arpa/inet.h>
#include <fcntl.h>
#include <linux/sockios.h>
#include <linux/tcp.h>
#include <netinet/in.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

#include "avckpt/guard.h"
#include "files.h"

#define COMES_NS (2 * NS_PER_MS) /* of all, while everything is stopped                */
/* A process of the app's that reads slowly takes no more: its window is full, in every freeze. */
#define STEP_NS (NS_PER_MS / 4)
#define MEND_NS (500 * NS_PER_MS) /* of all, when everything is dead                     */
#define LOOK_US 20
#define COUNT_TRIES 16
#define ENDS_MAX 1024
#define SYN_BYTES 1 /* the connecting end counts its SYN as acknowledged              */
#define PROTOCOL_UNIX UINT32_C(256)
#define END_TEXT (INET6_ADDRSTRLEN + 8) /* an address and its port                      */

/* One end of a connection. */
struct group_end {
	uint64_t ino;
	struct avc_end_name own, other;
	bool over;       /* had ended already when all were dead                          */
	bool kept;       /* data in flight to it was copied                              */
	const char *why; /* it is not, or cannot be restored; NULL at a line: perhaps it can */
	uint8_t *content;
	uint32_t bytes;
	const struct file *file; /* of any image that has it                              */
	int fd;                  /* ours; -1: none                                          */
	int shown;               /* index on the board; -1: not there                       */
	uint64_t surplus;        /* bytes still to be discarded                              */
	uint32_t sent;
};

struct group_ends {
	bool alone; /* without a group: what cannot be kept is left to the restore */
	uint32_t count;
	struct group_end end[ENDS_MAX];
};

/* Data in flight at the checkpoint that has arrived since counts, too. */
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
		/* Data on a connection that is not accepted yet may be invalid now. */
		(void)file_turn_away(fd);
	} else if (s->type == SOCK_DGRAM) {
		if (s->domain != AF_UNIX || file_has_name(s))
			(void)file_empty_socket(fd, false);
	} else if (s->domain == AF_UNIX && s->connected && file_has_name(s) &&
		   !file_unix_is_bus(s)) {
		shutdown(fd, SHUT_RDWR);
		(void)file_empty_socket(fd, true);
	} else if (s->protocol == IPPROTO_TCP && (s->connected || then->tcp_state) &&
		   (config->tcp == AVC_TCP_RESET || has_moved(fd, then))) {
		/* This discards unread data, also if the connection is closed. */
		(void)file_reset_tcp(fd);
	}
}

/* ---- ends ----------------------------------------------------------------------------------- */

static bool is_tcp(const struct group_end *end)
{
	return end->own.protocol == IPPROTO_TCP;
}

static bool is_stream(const struct file *f)
{
	return f->socket->type == SOCK_STREAM;
}

static bool may_go_on(const struct file *f)
{
	const struct file_socket *s = f->kind == FILE_SOCKET ? f->socket : NULL;

	if (!s || f->outside || !s->connected || f->flags & O_PATH)
		return false;
	if (s->domain == AF_UNIX)
		return (s->type == SOCK_STREAM || s->type == SOCK_SEQPACKET) && s->peer;
	return s->protocol == IPPROTO_TCP && s->type == SOCK_STREAM;
}

static bool has_ended(int fd)
{
	struct pollfd state = { .fd = fd, .events = POLLRDHUP };

	return poll_for(&state, 1, 0) != 0;
}

/* NULL: it can be kept. */
static const char *why_not(int fd)
{
	struct pollfd state = { .fd = fd, .events = POLLRDHUP | POLLPRI };

	if (poll_for(&state, 1, 0) < 0 || state.revents & ~POLLPRI)
		return "an end of it was shut down or closed";
	if (state.revents)
		return "it has urgent data";
	return fd_option(fd, SOL_SOCKET, SO_PEEK_OFF) < 0 ? NULL : "it has SO_PEEK_OFF";
}

/* IPv4 as mapped to IPv6, because one end may use that. */
static bool name_address(struct avc_end_name *name, const struct sockaddr_storage *address,
			 uint64_t network)
{
	const struct sockaddr_in *v4 = (const struct sockaddr_in *)address;
	const struct sockaddr_in6 *v6 = (const struct sockaddr_in6 *)address;

	name->protocol = IPPROTO_TCP;
	if (address->ss_family == AF_INET) {
		name->address[10] = name->address[11] = 0xff;
		memcpy(name->address + 12, &v4->sin_addr, sizeof v4->sin_addr);
		name->port = v4->sin_port;
	} else if (address->ss_family == AF_INET6) {
		memcpy(name->address, &v6->sin6_addr, sizeof name->address);
		name->port = v6->sin6_port;
	} else {
		return false;
	}
	if (!memcmp(name->address, &in6addr_loopback, sizeof in6addr_loopback) ||
	    !memcmp(name->address, "\0\0\0\0\0\0\0\0\0\0\xff\xff\x7f", 13))
		name->where = network;
	return true;
}

static bool name_tcp(int fd, struct group_end *end)
{
	struct sockaddr_storage own = { 0 }, other = { 0 };
	socklen_t own_bytes = sizeof own, other_bytes = sizeof other;
	uint64_t network = 0;
	socklen_t bytes = sizeof network;

	return getsockopt(fd, SOL_SOCKET, SO_NETNS_COOKIE, &network, &bytes) == 0 &&
	       getsockname(fd, (struct sockaddr *)&own, &own_bytes) == 0 &&
	       getpeername(fd, (struct sockaddr *)&other, &other_bytes) == 0 &&
	       name_address(&end->own, &own, network) && name_address(&end->other, &other, network);
}

static void name_unix(const struct file *f, struct group_end *end)
{
	end->own = (struct avc_end_name){ .where = f->ino, .protocol = PROTOCOL_UNIX };
	end->other = (struct avc_end_name){ .where = f->socket->peer, .protocol = PROTOCOL_UNIX };
}

static const char uncounted[] = "its bytes could not be counted";

static const char *count_tcp_once(int fd, uint64_t *written, uint64_t *received, uint64_t *unread)
{
	struct tcp_info info = { 0 };
	socklen_t bytes = sizeof info;
	char layer[16];
	socklen_t layer_bytes = sizeof layer;
	int waiting = 0, going = 0;
	uint64_t sent;

	if (getsockopt(fd, IPPROTO_TCP, TCP_INFO, &info, &bytes) ||
	    bytes < offsetof(struct tcp_info, tcpi_dsack_dups) || ioctl(fd, SIOCINQ, &waiting) ||
	    ioctl(fd, SIOCOUTQ, &going))
		return "the kernel does not tell its state";
	if (info.tcpi_state != 1)
		return "it is not established";
	if (getsockopt(fd, IPPROTO_TCP, TCP_ULP, layer, &layer_bytes) == 0 && layer_bytes)
		return "it has kernel TLS, or is MPTCP";
	sent = info.tcpi_bytes_sent - info.tcpi_bytes_retrans + info.tcpi_notsent_bytes;
	*written = info.tcpi_bytes_acked + (uint64_t)going;
	*received = info.tcpi_bytes_received;
	*unread = (uint64_t)waiting;
	if (*written == sent + SYN_BYTES)
		*written = sent;
	return *written == sent ? NULL : uncounted;
}

/* Bytes written by the application, received, and received but unread; not NULL: unknown, and why.
 * An acknowledgement may come between two questions to the kernel: the other end may still run. */
static const char *count_tcp(int fd, uint64_t *written, uint64_t *received, uint64_t *unread)
{
	const char *why = uncounted;

	for (int tries = 0; why == uncounted && tries < COUNT_TRIES; tries++)
		why = count_tcp_once(fd, written, received, unread);
	return why;
}

static void show(struct group_end *end, struct avc_board *board, uint64_t written)
{
	const uint32_t at = __atomic_add_fetch(&board->ends, 1, __ATOMIC_ACQ_REL) - 1;

	if (at >= AVC_BOARD_ENDS)
		return;
	board->end[at] = (struct avc_end){ end->own, end->other, written, 0, 0 };
	end->shown = (int)at;
}

/* The board's ends by their names: there may be thousands, and everything is stopped. */
struct named_ends {
	const struct avc_end **end;
	uint32_t count;
};

static int by_name(const void *a, const void *b)
{
	const struct avc_end *x = *(const struct avc_end *const *)a;
	const struct avc_end *y = *(const struct avc_end *const *)b;

	return memcmp(&x->own, &y->own, sizeof x->own);
}

/* When all are on it.  Without memory: as if none were. */
static struct named_ends sort_board(const struct avc_board *board)
{
	const uint32_t all = __atomic_load_n(&board->ends, __ATOMIC_ACQUIRE);
	struct named_ends named = { .count = all < AVC_BOARD_ENDS ? all : AVC_BOARD_ENDS };

	named.end = malloc((named.count + 1) * sizeof(void *));
	if (!named.end)
		named.count = 0;
	for (uint32_t i = 0; i < named.count; i++)
		named.end[i] = &board->end[i];
	if (named.end)
		qsort(named.end, named.count, sizeof(void *), by_name);
	return named;
}

/* NULL: there is none, or more than one. */
static const struct avc_end *find_other(const struct group_end *end, const struct avc_board *board,
					const struct named_ends *named)
{
	const struct avc_end *found = NULL;
	uint32_t at = LOWER_BOUND(named->count, i,
				  memcmp(&named->end[i]->own, &end->other, sizeof end->other) < 0);

	for (; at < named->count; at++) {
		const struct avc_end *other = named->end[at];

		if (memcmp(&other->own, &end->other, sizeof end->other))
			break;
		if (other == &board->end[end->shown] ||
		    memcmp(&other->other, &end->own, sizeof end->own))
			continue;
		if (found)
			return NULL;
		found = other;
	}
	return found;
}

static struct group_end *find_end(struct group_ends *ends, uint64_t ino)
{
	for (uint32_t i = 0; ends && i < ends->count; i++)
		if (ends->end[i].ino == ino)
			return &ends->end[i];
	return NULL;
}

static void drop_end(struct group_end *end)
{
	close_fd(&end->fd);
	end->shown = -1;
}

/* ---- both ends of one application ----------------------------------------------------------- */

#define PAIR_BITS (UINT32_C(1) << 16)

struct pairs {
	uint64_t bit[PAIR_BITS / 64];
};

static uint32_t pair_bit(uint32_t from, uint32_t to)
{
	return (from * 40503 + to) % PAIR_BITS;
}

static bool is_own(const struct file *f, uint32_t *own, uint32_t *other)
{
	if (!may_go_on(f))
		return false;
	*own = address_port(&f->socket->local);
	*other = address_port(&f->socket->remote);
	return *own && *other;
}

/* A server may have thousands of connections, and the application is stopped: so this compares no
 * end with all others.  Those that only seem to have another one have none on the board. */
static bool has_other(const struct file *f, const struct pairs *pairs)
{
	uint32_t own, other, bit;

	if (!is_own(f, &own, &other))
		return false;
	bit = pair_bit(other, own);
	return pairs->bit[bit / 64] >> bit % 64 & 1;
}

static void mark_pairs(struct pairs *pairs, const struct image *image)
{
	const struct files *files = image->process ? image->files : NULL;

	for (uint32_t k = 0; files && k < files->count; k++) {
		uint32_t own, other, bit;

		if (!is_own(&files->file[k], &own, &other))
			continue;
		bit = pair_bit(own, other);
		pairs->bit[bit / 64] |= UINT64_C(1) << bit % 64;
	}
}

/* ---- a line ------------------------------------------------------------------------------------ */

static const char *examine(struct group_end *end, uint64_t *written)
{
	uint64_t ignored;
	const char *why;

	if (end->fd < 0)
		return "it could not be looked at";
	why = why_not(end->fd);
	if (end->file->socket->domain == AF_UNIX) {
		name_unix(end->file, end);
		return why;
	}
	if (!name_tcp(end->fd, end) && !why)
		why = "its addresses are unknown";
	return why ? why : count_tcp(end->fd, written, &ignored, &ignored);
}

/* Also one that cannot be kept: so a rollback can say why. */
static void add_end(struct group_ends *ends, const struct file *f, int pidfd,
		    struct avc_board *board)
{
	struct group_end *end = &ends->end[ends->count];
	uint64_t written = 0;

	if (ends->count == ENDS_MAX || find_end(ends, f->ino))
		return;
	*end = (struct group_end){ .ino = f->ino, .file = f, .shown = -1 };
	end->fd = proc_borrow_fd(pidfd, f->fd);
	end->why = examine(end, &written);
	if (end->why)
		drop_end(end);
	else
		show(end, board, written);
	ends->count++;
}

struct group_ends *files_ends_new(const struct image *image, uint32_t images,
				  struct avc_board *board)
{
	struct group_ends *ends = NULL;

	for (uint32_t i = 0; i < images; i++) {
		struct files *files = image[i].files;
		bool any = false;

		if (!files || !image[i].process)
			continue;
		files_find_peers(files, image[i].process->pid);
		for (uint32_t k = 0; k < files->count; k++)
			any |= may_go_on(&files->file[k]);
		if (any && !ends)
			ends = calloc(1, sizeof *ends);
		for (uint32_t k = 0; any && ends && k < files->count; k++)
			if (may_go_on(&files->file[k]))
				add_end(ends, &files->file[k], image[i].process->pidfd, board);
	}
	return ends;
}

/* The sender may wait for an acknowledgement before it sends the rest (Nagle). */
static void acknowledge(int fd)
{
	const int yes = 1;

	setsockopt(fd, IPPROTO_TCP, TCP_QUICKACK, &yes, sizeof yes);
}

/* How long to wait for what has not arrived: in all, and for more of it.  While one connection is
 * waited for, others arrive. */
struct patience {
	uint64_t began, until, step_ns;
};

/* Whether everything written has arrived. */
static bool has_come(const struct group_end *end, uint64_t written, uint64_t *unread,
		     const struct patience *patience)
{
	uint64_t ignored, received, before = UINT64_MAX, came_ns = patience->began, now;

	while (!count_tcp(end->fd, &ignored, &received, unread)) {
		if (received == written)
			return true;
		now = now_ns();
		if (before != UINT64_MAX && received != before)
			came_ns = now;
		before = received;
		if (now > patience->until || now - came_ns > patience->step_ns)
			break;
		acknowledge(end->fd);
		usleep(LOOK_US);
	}
	return false;
}

/* At most one message: peeking at more takes an option of the socket (SO_PEEK_OFF). */
static bool keep_bytes(struct group_end *end, uint64_t bytes)
{
	struct iovec io;
	struct msghdr head = { .msg_iov = &io, .msg_iovlen = 1 };
	ssize_t n;

	if (!bytes)
		return true;
	if (bytes > CONTENT_MAX || !budget_has(bytes) || !budget_take(bytes))
		return false;
	end->content = malloc(bytes);
	if (!end->content)
		return false;
	io = (struct iovec){ end->content, bytes };
	n = recvmsg(end->fd, &head, MSG_PEEK | MSG_DONTWAIT);
	end->bytes = (uint32_t)bytes;
	/* MSG_CTRUNC: it has descriptors or credentials with it. */
	return n == (ssize_t)bytes && !(head.msg_flags & (MSG_CTRUNC | MSG_TRUNC));
}

static void keep(struct group_ends *ends, struct avc_board *board, uint64_t step_ns)
{
	const uint64_t began = now_ns();
	const struct patience patience = { began, began + COMES_NS, step_ns };
	const struct named_ends named = sort_board(board);

	for (uint32_t i = 0; ends && i < ends->count; i++) {
		struct group_end *end = &ends->end[i];
		const struct avc_end *other = end->shown < 0 ? NULL
							     : find_other(end, board, &named);
		uint64_t unread = 0;
		int waiting = 0;

		if (end->why)
			continue;
		end->why = other ? "what was in flight cannot be kept"
				 : "its other end is not a connection of the group's";
		if (other && is_tcp(end)) {
			const bool come = has_come(end, other->written, &unread, &patience);

			end->kept = come && keep_bytes(end, unread);
			if (!come)
				end->why = "some bytes had not arrived at the line";
		} else if (other && ioctl(end->fd, SIOCINQ, &waiting) == 0) {
			struct pollfd some = { .fd = end->fd, .events = POLLIN };

			/* An empty message counts as one, too. */
			end->kept = (waiting || poll_for(&some, 1, 0) == 0) &&
				    keep_bytes(end, (uint64_t)waiting);
		}
		drop_end(end);
	}
	free(named.end);
}

void files_ends_keep(struct group_ends *ends, struct avc_board *board)
{
	keep(ends, board, COMES_NS);
}

/* Most have none: the first one makes `ends` and the board. */
static void add_own(struct group_ends **ends, const struct image *image, const struct pairs *pairs,
		    struct avc_board **board)
{
	const struct files *files = image->process ? image->files : NULL;

	for (uint32_t k = 0; files && k < files->count; k++) {
		if (!has_other(&files->file[k], pairs))
			continue;
		if (!*ends)
			*ends = calloc(1, sizeof **ends);
		if (!*board)
			*board = calloc(1, sizeof **board); /* only what is used takes memory */
		if (*ends && *board)
			add_end(*ends, &files->file[k], image->process->pidfd, *board);
	}
}

struct group_ends *files_ends_keep_own(const struct image *image, uint32_t images)
{
	struct pairs pairs = { 0 };
	struct group_ends *ends = NULL;
	struct avc_board *board = NULL;

	for (uint32_t i = 0; i < images; i++)
		mark_pairs(&pairs, &image[i]);
	for (uint32_t i = 0; i < images; i++)
		add_own(&ends, &image[i], &pairs, &board);
	if (ends && board)
		keep(ends, board, STEP_NS);
	free(board);
	return ends;
}

void files_ends_free(struct group_ends *ends)
{
	for (uint32_t i = 0; ends && i < ends->count; i++) {
		close_fd(&ends->end[i].fd);
		free(ends->end[i].content);
	}
	free(ends);
}

/* ---- a return ------------------------------------------------------------------------------------ */

/* A process that has the current descriptors of a dead one; -1: there is none. */
static int table_of(const struct image *image)
{
	if (!image->process || !image->files)
		return -1;
	if (!image->process->descendant)
		return image->pidfd;
	return image->process->holder ? image->process->holder_pidfd : -1;
}

/* A copy of that descriptor, if it still refers to the same file; -1: it does not. */
static int borrow(int pidfd, const struct file *f)
{
	struct stat st;
	int fd = proc_borrow_fd(pidfd, f->fd);

	if (fd >= 0 && (fstat(fd, &st) || st.st_ino != f->ino))
		close_fd(&fd);
	return fd;
}

static bool put_on_board(const struct group_end *end, struct avc_board *board)
{
	struct avc_end *shown = &board->end[end->shown];
	const uint32_t next = __atomic_add_fetch(&board->bytes, end->bytes, __ATOMIC_ACQ_REL);

	if (next > AVC_BOARD_BYTES || next < end->bytes)
		return false;
	shown->at = next - end->bytes;
	shown->bytes = end->bytes;
	if (end->bytes)
		memcpy(board->content + shown->at, end->content, end->bytes);
	return true;
}

/* False: it cannot be kept. */
static bool try_show(struct group_end *end, struct avc_board *board)
{
	uint64_t written = 0, ignored;

	if (!end->kept)
		return false; /* end->why says it */
	end->why = why_not(end->fd);
	if (!end->why && is_tcp(end))
		end->why = count_tcp(end->fd, &written, &ignored, &ignored);
	if (!end->why && end->bytes > CONTENT_MAX)
		end->why = "too much was in flight";
	if (end->why)
		return false;
	end->why = "its other end cannot be restored";
	if (!is_tcp(end))
		(void)file_empty_socket(end->fd, true);
	show(end, board, written);
	if (end->shown < 0 || put_on_board(end, board))
		return end->shown >= 0;
	end->why = "what was in flight cannot be kept";
	memset(&board->end[end->shown], 0, sizeof *board->end);
	return false;
}

void files_ends_show(struct group_ends *ends, struct image *image, uint32_t images,
		     const struct avc_config *config, struct avc_board *board)
{
	for (uint32_t i = 0; ends && i < ends->count; i++)
		drop_end(&ends->end[i]);
	for (uint32_t i = 0; i < images; i++) {
		struct files *files = image[i].files;
		const int pidfd = table_of(&image[i]);

		for (uint32_t k = 0; pidfd >= 0 && k < files->count; k++) {
			struct file *f = &files->file[k];
			struct group_end *end;
			int fd;

			f->goes_on = false;
			if (f->kind != FILE_SOCKET || !f->socket || f->outside ||
			    files_leader(files, f) != k)
				continue;
			end = find_end(ends, f->ino);
			if (end ? end->fd >= 0 : ends && ends->alone)
				continue;
			fd = borrow(pidfd, f);
			if (fd < 0)
				continue;
			if (end) {
				end->fd = fd;
				end->file = f;
				end->over = has_ended(fd); /* before any member resets it */
				if (!try_show(end, board))
					end->shown = -1;
			} else {
				forget(fd, f, config);
				close(fd);
			}
		}
	}
}

/* APART: it is not kept, or has no matching end.  TORN: it failed half-way. */
enum mend_state { APART, MENDING, MENDED, TORN };

static enum mend_state mend(struct group_end *end, const struct avc_end *other,
			    const struct avc_board *board)
{
	const uint32_t bytes = other->bytes;
	ssize_t n;

	if (end->surplus) {
		/* With MSG_TRUNC, TCP discards the data: tcp(7). */
		n = recv(end->fd, NULL, end->surplus < 1 << 30 ? end->surplus : 1 << 30,
			 MSG_TRUNC | MSG_DONTWAIT);
		if (n > 0)
			end->surplus -= (uint64_t)n;
		else if (n == 0)
			return TORN;
		else
			acknowledge(end->fd);
	}
	if (end->sent < bytes) {
		n = file_send_as_nobody(end->fd, board->content + other->at + end->sent,
					bytes - end->sent, NULL, 0);
		if (n > 0)
			end->sent += (uint32_t)n;
		else if (!is_stream(end->file))
			return TORN;
	}
	return end->surplus || end->sent < bytes ? MENDING : MENDED;
}

/* Other guards can change the board at any time, so it is read only once. */
static bool begin_mend(struct group_end *end, struct avc_end *copy, const struct avc_board *board,
		       const struct named_ends *named)
{
	const struct avc_end *other = end->shown < 0 ? NULL : find_other(end, board, named);
	uint64_t ignored, received = 0, unread = 0;

	if (!other)
		return false;
	*copy = *other;
	end->sent = 0;
	end->surplus = 0;
	if (copy->bytes > CONTENT_MAX || copy->at > AVC_BOARD_BYTES - copy->bytes)
		return false;
	if (!is_tcp(end))
		return true;
	/* Up to what the other end had written before any of this is sent, and no further. */
	if (count_tcp(end->fd, &ignored, &received, &unread) || copy->written + unread < received)
		return false;
	end->surplus = copy->written + unread - received;
	return true;
}

static void let_go_on(struct image *image, uint32_t images, uint64_t ino)
{
	for (uint32_t i = 0; i < images; i++)
		for (uint32_t k = 0; image[i].files && k < image[i].files->count; k++)
			if (image[i].files->file[k].kind == FILE_SOCKET &&
			    image[i].files->file[k].ino == ino)
				image[i].files->file[k].goes_on = true;
}

/* Both ends of a connection may be ours, so all take turns. */
static void mend_all(struct group_ends *ends, struct avc_end *others, enum mend_state *states,
		     const struct avc_board *board)
{
	const uint64_t until = now_ns() + MEND_NS;
	bool more = true;

	while (more && now_ns() < until) {
		bool waits = true;

		more = false;
		for (uint32_t i = 0; i < ends->count; i++) {
			const uint64_t surplus = ends->end[i].surplus;
			const uint32_t sent = ends->end[i].sent;

			if (states[i] != MENDING)
				continue;
			states[i] = mend(&ends->end[i], &others[i], board);
			more |= states[i] == MENDING;
			waits &= surplus == ends->end[i].surplus && sent == ends->end[i].sent;
		}
		(void)budget_step();
		if (more && waits)
			usleep(LOOK_US);
	}
}

static void say_address(char *text, const struct avc_end_name *name)
{
	const bool v4 = !memcmp(name->address, "\0\0\0\0\0\0\0\0\0\0\xff\xff", 12);
	char address[INET6_ADDRSTRLEN] = "?";

	if (v4)
		inet_ntop(AF_INET, name->address + 12, address, sizeof address);
	else
		inet_ntop(AF_INET6, name->address, address, sizeof address);
	snprintf(text, END_TEXT, v4 ? "%s:%u" : "[%s]:%u", address, ntohs((uint16_t)name->port));
}

static void say_why(struct group_ended *ended, const struct group_end *end)
{
	char own[END_TEXT], other[END_TEXT];

	ended->count++;
	say_address(own, &end->own);
	say_address(other, &end->other);
	if (is_tcp(end))
		snprintf(ended->why, sizeof ended->why, "%s (%s to %s)", end->why, own, other);
	else
		snprintf(ended->why, sizeof ended->why, "%s (descriptor %d)", end->why,
			 end->file->fd);
}

struct group_ended files_ends_mend(struct group_ends *ends, struct image *image, uint32_t images,
				   const struct avc_config *config, struct avc_board *board)
{
	struct avc_end *others = ends ? calloc(ends->count + 1, sizeof *others) : NULL;
	enum mend_state *states = ends ? calloc(ends->count + 1, sizeof *states) : NULL;
	struct group_ended ended = { 0 };
	const struct named_ends named = sort_board(board);

	for (uint32_t i = 0; others && states && i < ends->count; i++)
		states[i] = ends->end[i].fd >= 0 &&
					    begin_mend(&ends->end[i], &others[i], board, &named)
				    ? MENDING
				    : APART;
	if (others && states)
		mend_all(ends, others, states, board);
	for (uint32_t i = 0; ends && i < ends->count; i++) {
		struct group_end *end = &ends->end[i];
		const enum mend_state state = others && states ? states[i] : APART;

		if (end->fd < 0)
			continue;
		if (state == MENDED) {
			let_go_on(image, images, end->ino);
		} else if (state != APART && is_tcp(end)) {
			end->why = "what was in flight could not be put back";
			(void)file_reset_tcp(end->fd);
		} else if (!ends->alone) {
			forget(end->fd, end->file, config);
		}
		if (!end->over && has_ended(end->fd))
			say_why(&ended, end);
		drop_end(end);
	}
	free(named.end);
	free(others);
	free(states);
	return ended;
}

void files_ends_mend_own(struct group_ends *ends, struct image *image, uint32_t images,
			 const struct avc_config *config)
{
	struct avc_board *board = ends && config->tcp != AVC_TCP_RESET ? calloc(1, sizeof *board)
								       : NULL;

	if (!board)
		return;
	ends->alone = true;
	files_ends_show(ends, image, images, config, board);
	(void)files_ends_mend(ends, image, images, config, board);
	ends->alone = false;
	free(board);
}
