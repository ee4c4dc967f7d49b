/* SPDX-License-Identifier: Apache-2.0
 *
 * The state of a descriptor besides the file itself: offsets, flags, counts, timers, unread bytes,
 * locks (files.h).
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/can/isotp.h>
#include <linux/netlink.h>
#include <linux/sock_diag.h>
#include <linux/sockios.h>
#include <linux/unix_diag.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <sys/file.h>
#include <sys/ioctl.h>
#include <sys/signalfd.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/sysmacros.h>
#include <sys/timerfd.h>
#include <sys/uio.h>
#include <sys/un.h>
#include <sys/vfs.h>
#include <unistd.h>

#include "files.h"

#define AUTOBOUND 5       /* hexadecimal digits */
#define OVERFLOW_ID 65534 /* a user that has no number (kernel.overflowuid) */
#define DRAIN_READS 16384 /* more than the small messages that a socket has room for */
#define TCP_TRIES 8
#define SET_TICKS _IOW('T', 0, uint64_t) /* linux/timerfd.h, which does not go with the libc's */
/* fcntl(F_SETFL) changes these. */
#define STATUS_FLAGS (O_APPEND | O_NONBLOCK | O_DIRECT | O_NOATIME)

/* ---- sockets ---------------------------------------------------------------- */

static bool is_idle(int fd, const struct file_socket *s)
{
	struct pollfd state = { .fd = fd, .events = POLLRDHUP };

	if ((s->domain != AF_UNIX && s->domain != AF_INET && s->domain != AF_INET6) ||
	    s->type == SOCK_RAW || s->listening || s->connected || poll_for(&state, 1, 0) < 0 ||
	    state.revents & (POLLRDHUP | POLLERR))
		return false;
	/* A stream without a connection reports HUP, but not while connecting (tcp_poll()). */
	return s->type == SOCK_DGRAM || state.revents & POLLHUP;
}

bool file_is_connecting(int fd, const struct file_socket *s)
{
	struct tcp_info info = { 0 };
	socklen_t bytes = sizeof info;

	return s->protocol == IPPROTO_TCP &&
	       getsockopt(fd, IPPROTO_TCP, TCP_INFO, &info, &bytes) == 0 &&
	       info.tcpi_state == TCP_SYN_SENT;
}

/* net/can/af_can.c does not remember it: 0, if it cannot be told from another one. */
static int can_protocol(int fd, int type)
{
	struct can_isotp_options options;
	socklen_t bytes = sizeof options;

	if (type == SOCK_RAW)
		return CAN_RAW;
	return getsockopt(fd, SOL_CAN_ISOTP, CAN_ISOTP_OPTS, &options, &bytes) ? 0 : CAN_ISOTP;
}

/* What the kernel calls a datagram socket that sends with SO_PASSCRED and has no name yet
 * (unix_autobind()), one of a pair, too. */
static bool is_autobound(const struct sockaddr_storage *address, socklen_t bytes)
{
	const char *name = ((const struct sockaddr_un *)address)->sun_path;

	return bytes == sizeof(sa_family_t) + 1 + AUTOBOUND && !name[0] &&
	       strspn(name + 1, "0123456789abcdef") >= AUTOBOUND;
}

/* It gets another one when it sends. */
static void forget_autobound(struct file_socket *s)
{
	const bool local = is_autobound(&s->local, s->local_bytes),
		   remote = is_autobound(&s->remote, s->remote_bytes);

	if (s->domain != AF_UNIX || s->type != SOCK_DGRAM || !s->connected ||
	    !(local || s->local_bytes == sizeof(sa_family_t)) ||
	    !(remote || s->remote_bytes == sizeof(sa_family_t)))
		return;
	s->local_bytes = s->remote_bytes = sizeof(sa_family_t);
}

void file_look_at_socket(int fd, struct file *file)
{
	struct file_socket *s = got_memory(calloc(1, sizeof *s));

	if (!s)
		return;
	s->domain = fd_option(fd, SOL_SOCKET, SO_DOMAIN);
	s->type = fd_option(fd, SOL_SOCKET, SO_TYPE);
	s->protocol = s->domain == AF_CAN ? can_protocol(fd, s->type)
					  : fd_option(fd, SOL_SOCKET, SO_PROTOCOL);
	s->listening = fd_option(fd, SOL_SOCKET, SO_ACCEPTCONN) > 0;
	s->local_bytes = sizeof s->local;
	if (getsockname(fd, (struct sockaddr *)&s->local, &s->local_bytes))
		s->local_bytes = 0;
	s->remote_bytes = sizeof s->remote;
	s->connected = getpeername(fd, (struct sockaddr *)&s->remote, &s->remote_bytes) == 0;
	forget_autobound(s);
	if (s->listening && s->protocol == IPPROTO_TCP) {
		struct tcp_info info = { 0 };
		socklen_t bytes = sizeof info;

		/* Of a listening socket, tcp_get_info() says it there (net/ipv4/tcp.c). */
		if (getsockopt(fd, IPPROTO_TCP, TCP_INFO, &info, &bytes) == 0)
			s->backlog = (int)info.tcpi_sacked;
	}
	if (s->listening && s->domain == AF_UNIX)
		s->backlog = -1;
	s->idle = is_idle(fd, s);
	s->connecting = !s->idle && !s->connected && !s->listening && file_is_connecting(fd, s);
	file_socket_free(file->socket);
	file->socket = s;
}

static bool is_connected(int fd)
{
	struct sockaddr_storage remote;
	socklen_t bytes = sizeof remote;

	return getpeername(fd, (struct sockaddr *)&remote, &bytes) == 0;
}

/* As linux/tcp.h has it; glibc's struct ends before. */
struct tcp_info_tail {
	struct tcp_info head;
	uint64_t pacing_rate, max_pacing_rate, bytes_acked, bytes_received;
};

/* The peer's FIN counts as a byte that was received, and not as one that is unread (tcp_fin(),
 * tcp_inq()).  A socket that was closed by both is TCP_CLOSE, too. */
static bool has_received_end(int state)
{
	return state == TCP_CLOSE_WAIT || state == TCP_LAST_ACK || state == TCP_CLOSING ||
	       state == TCP_TIME_WAIT || state == TCP_CLOSE;
}

static bool has_failed(int fd)
{
	struct pollfd state = { .fd = fd };

	return poll_for(&state, 1, 0) > 0 && state.revents & POLLERR;
}

void file_look_at_tcp(int fd, struct file *file, const struct file_socket *s)
{
	struct tcp_info_tail info = { 0 }, before;
	int unread = 0, unacknowledged = 0;
	socklen_t bytes = sizeof info;

	if (!s || s->type != SOCK_STREAM || s->listening ||
	    (s->domain != AF_INET && s->domain != AF_INET6))
		return;
	if (s->protocol != IPPROTO_TCP) { /* MPTCP, SCTP */
		if (is_connected(fd))
			file->tcp_state = TCP_ESTABLISHED;
		return;
	}
	if (getsockopt(fd, IPPROTO_TCP, TCP_INFO, &info, &bytes))
		return;
	/* The peer keeps running: what arrives, or is acknowledged, between two of these calls
	 * would be in only one of the figures. */
	for (int try = 0; try < TCP_TRIES; try++) {
		before = info;
		if (ioctl(fd, SIOCINQ, &unread))
			unread = 0;
		if (ioctl(fd, SIOCOUTQ, &unacknowledged))
			unacknowledged = 0;
		bytes = sizeof info;
		if (getsockopt(fd, IPPROTO_TCP, TCP_INFO, &info, &bytes))
			return;
		file->tcp_counted = info.bytes_acked == before.bytes_acked &&
				    info.bytes_received == before.bytes_received;
		if (file->tcp_counted)
			break;
	}
	file->tcp_state = info.head.tcpi_state;
	file->tcp_written = info.bytes_acked + (uint64_t)unacknowledged;
	file->tcp_taken = info.bytes_received - (uint64_t)unread -
			  has_received_end(file->tcp_state);
	file->tcp_unread = (uint64_t)unread;
	file->tcp_failed = file->tcp_state == TCP_CLOSE && has_failed(fd);
	file->tcp_coming = file_was_coming(&info.head, unread);
	file->tcp_going = file_is_going(fd);
}

struct diag_request {
	struct nlmsghdr head;
	struct unix_diag_req ask;
};

/* Asks sock_diag(7) for the peer of a Unix socket, and for the backlog of one that listens
 * (unix_diag_rqlen).  `ino` 0: for all. */
static bool ask_diag(int diag, uint64_t ino)
{
	const struct diag_request request = {
		.head = { .nlmsg_len = sizeof request,
			  .nlmsg_type = SOCK_DIAG_BY_FAMILY,
			  .nlmsg_flags = ino ? NLM_F_REQUEST : NLM_F_REQUEST | NLM_F_DUMP },
		.ask = { .sdiag_family = AF_UNIX,
			 .udiag_states = ~0u,
			 .udiag_ino = (uint32_t)ino,
			 .udiag_show = UDIAG_SHOW_PEER | UDIAG_SHOW_RQLEN,
			 .udiag_cookie = { ~0u, ~0u } },
	};

	return send(diag, &request, sizeof request, 0) == sizeof request;
}

bool file_has_name(const struct file_socket *s)
{
	return s->local_bytes > sizeof(sa_family_t) || s->remote_bytes > sizeof(sa_family_t);
}

/* What one message of the answer says. */
static void hear_diag(const struct nlmsghdr *head, struct file_socket *s)
{
	const struct unix_diag_msg *message = (const struct unix_diag_msg *)(head + 1);
	size_t at = sizeof *head + sizeof *message;

	while (at + sizeof(struct nlattr) <= head->nlmsg_len) {
		const struct nlattr *attribute = (const struct nlattr *)((const char *)head + at);
		struct unix_diag_rqlen queue;
		uint32_t peer;

		if (attribute->nla_len < sizeof *attribute)
			break;
		if (attribute->nla_type == UNIX_DIAG_PEER) {
			memcpy(&peer, attribute + 1, sizeof peer);
			s->peer = peer;
		}
		if (attribute->nla_type == UNIX_DIAG_SHUTDOWN)
			memcpy(&s->shut, attribute + 1, sizeof s->shut);
		if (attribute->nla_type == UNIX_DIAG_RQLEN && s->listening) {
			memcpy(&queue, attribute + 1, sizeof queue);
			s->backlog = (int)queue.udiag_wqueue;
		}
		at += (attribute->nla_len + 3u) & ~3u;
	}
}

/* Comes from socketpair(2), or from connect(2) and accept(2).  A datagram socket with a name, or
 * connected by one, may have many others. */
static bool maybe_pair(const struct file *f)
{
	return f->kind == FILE_SOCKET && f->socket && f->socket->domain == AF_UNIX &&
	       f->socket->connected && (f->socket->type != SOCK_DGRAM || !file_has_name(f->socket));
}

static int by_inode(const void *a, const void *b)
{
	const struct file *x = *(const struct file *const *)a, *y = *(const struct file *const *)b;

	return (x->ino > y->ino) - (x->ino < y->ino);
}

#define DIAG_BYTES 32768

/* Until the answer ends, to one question or to that for all sockets. */
static void hear_all(int diag, struct file **asked, uint32_t count, bool one)
{
	char answer[DIAG_BYTES] __attribute__((aligned(8)));
	ssize_t n;

	while ((n = recv(diag, answer, sizeof answer, MSG_DONTWAIT)) > 0 && budget_step()) {
		const struct nlmsghdr *head = (const struct nlmsghdr *)answer;

		for (; NLMSG_OK(head, (size_t)n); head = NLMSG_NEXT(head, n)) {
			const struct unix_diag_msg *message =
				(const struct unix_diag_msg *)(head + 1);
			struct file key = { 0 }, *wanted = &key, **found;

			if (head->nlmsg_type != SOCK_DIAG_BY_FAMILY ||
			    head->nlmsg_len < sizeof *head + sizeof *message)
				return;
			key.ino = message->udiag_ino;
			found = bsearch(&wanted, asked, count, sizeof wanted, by_inode);
			for (; found && found > asked && by_inode(found - 1, &wanted) == 0; found--)
				;
			for (; found && found < asked + count && by_inode(found, &wanted) == 0;
			     found++)
				hear_diag(head, (*found)->socket);
		}
		if (one)
			return;
	}
}

/* Once; but a connection has no other end before it is accepted. */
static bool wants_peer(const struct file *f)
{
	struct file_socket *s = f->kind == FILE_SOCKET ? f->socket : NULL;
	const bool pair = maybe_pair(f);

	if (!s || !(pair || s->backlog < 0) ||
	    (s->asked && !(pair && file_has_name(s) && !s->peer && !s->shut)))
		return false;
	s->asked = true;
	if (s->listening)
		s->backlog = SOMAXCONN;
	return true;
}

/* The kernel takes as long to find one socket as to list all (net/unix/diag.c). */
#define ASKED_EACH 4

void files_find_peers(struct files *files, pid_t pid)
{
	struct file **asked = got_memory(calloc(files->count + 1, sizeof *asked));
	uint32_t count = 0;
	int diag;

	for (uint32_t i = 0; asked && i < files->count; i++)
		if (wants_peer(&files->file[i]))
			asked[count++] = &files->file[i];
	diag = count ? file_socket_of(pid, AF_NETLINK, SOCK_RAW, NETLINK_SOCK_DIAG) : -1;
	if (diag >= 0) {
		qsort(asked, count, sizeof(void *), by_inode);
		if (count > ASKED_EACH && ask_diag(diag, 0))
			hear_all(diag, asked, count, false);
		for (uint32_t i = 0; count <= ASKED_EACH && i < count; i++)
			if (ask_diag(diag, asked[i]->ino))
				hear_all(diag, asked, count, true);
	}
	close_fd(&diag);
	free(asked);
}

/* ---- bytes in pipes and socket pairs ------------------------------------------ */

static bool reads(const struct file *f)
{
	return f->kind == FILE_PIPE && (f->flags & O_ACCMODE) == O_RDONLY;
}

/* Of a pipe those to write to come first: a process may have thousands of each. */
static int by_end(const void *a, const void *b)
{
	const struct file *x = *(const struct file *const *)a, *y = *(const struct file *const *)b;

	if (x->ino != y->ino)
		return x->ino < y->ino ? -1 : 1;
	if (reads(x) != reads(y))
		return reads(x) ? 1 : -1;
	return (x->fd > y->fd) - (x->fd < y->fd);
}

/* There may be thousands. */
static bool sort_ends(struct files *files)
{
	if (files->ends)
		return true;
	files->ends = got_memory(malloc((files->count + 1) * sizeof *files->ends));
	for (uint32_t i = 0; files->ends && i < files->count; i++)
		if (files->file[i].kind == FILE_PIPE || files->file[i].kind == FILE_SOCKET)
			files->ends[files->end_count++] = &files->file[i];
	if (files->ends)
		qsort(files->ends, files->end_count, sizeof(void *), by_end);
	return files->ends;
}

const struct file *files_other_end(struct files *files, const struct file *file)
{
	const uint64_t ino = file->kind == FILE_SOCKET ? file->socket ? file->socket->peer : 0
						       : file->ino;
	uint32_t at;

	if (!ino || (file->kind == FILE_PIPE && !reads(file)) || !sort_ends(files))
		return NULL;
	at = LOWER_BOUND(files->end_count, i, files->ends[i]->ino < ino);
	return at < files->end_count && files->ends[at]->ino == ino &&
			       files->ends[at]->kind == file->kind && !reads(files->ends[at])
		       ? files->ends[at]
		       : NULL;
}

static bool scratch_open(struct scratch *scratch, int bytes)
{
	int ends[2];

	if (scratch->in < 0) {
		if (got_fd(pipe2(ends, O_CLOEXEC | O_NONBLOCK)))
			return false;
		scratch->in = ends[0];
		scratch->out = ends[1];
		scratch->bytes = fcntl(scratch->out, F_GETPIPE_SZ);
	}
	if (bytes > scratch->bytes && fcntl(scratch->out, F_SETPIPE_SZ, bytes) > 0)
		scratch->bytes = bytes;
	return true;
}

void scratch_close(struct scratch *scratch)
{
	close_fd(&scratch->in);
	close_fd(&scratch->out);
}

/* Reads without consuming: tee(2) shares the pages with a pipe of ours. */
static void keep_pipe(int fd, struct file *file, uint32_t bytes, struct scratch *scratch)
{
	uint32_t got = 0;
	ssize_t n;

	if (!scratch_open(scratch, file->pipe_bytes)) {
		file->content_lost = true;
		return;
	}
	/* It always begins at the front, so only one call is useful. */
	if (tee(fd, scratch->out, bytes, SPLICE_F_NONBLOCK) == (ssize_t)bytes)
		while (got < bytes && (n = read(scratch->in, file->content + got, bytes - got)) > 0)
			got += (uint32_t)n;
	file->content_bytes = got;
	file->content_lost = got != bytes;
	if (file->content_lost)
		scratch_close(scratch); /* with what is left in it */
}

void file_keep_content(struct process *process, int fd, struct file *file, struct scratch *scratch)
{
	int bytes = 0;

	if (ioctl(fd, FIONREAD, &bytes) || bytes <= 0)
		return;
	if (file->kind == FILE_SOCKET) {
		file_keep_messages(process, fd, file, (uint32_t)bytes);
		return;
	}
	if (bytes > CONTENT_MAX || !budget_has((uint64_t)bytes)) {
		file->content_lost = true;
		return;
	}
	(void)budget_take((uint64_t)bytes);
	file->content = malloc((size_t)bytes);
	if (!file->content) {
		file->content_lost = true;
		return;
	}
	keep_pipe(fd, file, (uint32_t)bytes, scratch);
}

bool file_drain(int fd, bool pipe)
{
	char buf[65536];
	int reads = 0;
	ssize_t n;

	do {
		n = pipe ? read(fd, buf, sizeof buf) : recv(fd, buf, sizeof buf, MSG_DONTWAIT);
	} while (n > 0 && ++reads < DRAIN_READS);
	return n <= 0;
}

#define PASSED_MAX 253 /* SCM_MAX_FD (include/net/scm.h) */

ssize_t file_send_as_nobody(int fd, const void *data, size_t bytes, const int *passed,
			    uint32_t count)
{
	const size_t senders = CMSG_SPACE(sizeof(struct ucred));
	union {
		char bytes[CMSG_SPACE(sizeof(struct ucred)) + CMSG_SPACE(PASSED_MAX * sizeof(int))];
		struct cmsghdr head;
	} control = { .head = { .cmsg_len = CMSG_LEN(sizeof(struct ucred)),
				.cmsg_level = SOL_SOCKET,
				.cmsg_type = SCM_CREDENTIALS } };
	struct cmsghdr *rights = (void *)(control.bytes + senders);
	const struct ucred nobody = { getpid(), OVERFLOW_ID, OVERFLOW_ID };
	struct iovec io = { (void *)data, bytes };
	const struct msghdr head = {
		.msg_iov = &io,
		.msg_iovlen = 1,
		.msg_control = &control,
		.msg_controllen = senders + (count ? CMSG_SPACE(count * sizeof(int)) : 0)
	};

	memcpy(CMSG_DATA(&control.head), &nobody, sizeof nobody);
	if (count) {
		*rights = (struct cmsghdr){ .cmsg_len = CMSG_LEN(count * sizeof(int)),
					    .cmsg_level = SOL_SOCKET,
					    .cmsg_type = SCM_RIGHTS };
		memcpy(CMSG_DATA(rights), passed, count * sizeof(int));
	}
	return sendmsg(fd, &head, MSG_DONTWAIT | MSG_NOSIGNAL);
}

/* One message, or the bytes of a stream that go with descriptors in flight, and those to them. */
static ssize_t put_message(int out, const struct file *want, uint32_t at, const int *passed)
{
	const bool stream = want->socket->type == SOCK_STREAM;
	const uint8_t *from = want->content + at;
	uint32_t bytes = want->content_bytes - at, count = 0;
	int with[PASSED_MAX];

	for (uint32_t i = 0; i < want->flight_count; i++) {
		const struct file_flight *f = &want->flight[i];
		const uint32_t edge = f->at > at ? f->at : f->end;

		if (edge > at && edge - at < bytes)
			bytes = edge - at;
		if (f->at == at && passed && passed[i] >= 0 && count < PASSED_MAX)
			with[count++] = passed[i];
	}
	if (!stream) {
		memcpy(&bytes, from, sizeof bytes);
		from += sizeof bytes;
	}
	return file_send_as_nobody(out, from, bytes, with, count);
}

static bool all_passed(const struct file *want, const int *passed)
{
	for (uint32_t i = 0; i < want->flight_count; i++)
		if (!passed || passed[i] < 0)
			return false;
	return !want->rights_lost;
}

/* The kernel takes messages until the room is used up, and pieces of another size than those in which it
 * was written take more.  Of a stream that was full the last ones would not fit. */
struct room {
	int bytes, locks; /* -1: not known (before Linux 5.14) */
};

static bool get_more_room(int out, struct room *room)
{
	room->locks = fd_option(out, SOL_SOCKET, SO_BUF_LOCK_);
	room->bytes = fd_option(out, SOL_SOCKET, SO_SNDBUF);
	return room->bytes > 0 &&
	       setsockopt(out, SOL_SOCKET, SO_SNDBUFFORCE, &room->bytes, sizeof room->bytes) == 0;
}

static void give_room_back(int out, const struct room *room)
{
	const int half = room->bytes / 2; /* the kernel doubles it */

	(void)setsockopt(out, SOL_SOCKET, SO_SNDBUFFORCE, &half, sizeof half);
	if (room->locks >= 0)
		(void)setsockopt(out, SOL_SOCKET, SO_BUF_LOCK_, &room->locks, sizeof room->locks);
}

const char *file_put_content(int fd, int other_fd, const struct file *want, const int *passed)
{
	const bool pipe = want->kind == FILE_PIPE,
		   messages = !pipe && want->socket->type != SOCK_STREAM;
	/* Of a pipe, for an O_NONBLOCK of our own. */
	int in = pipe ? open_again(fd, O_RDONLY) : fd,
	    out = pipe ? open_again(other_fd, O_WRONLY) : other_fd;
	const char *problem = NULL;
	struct room room;
	uint32_t put = 0;
	bool emptied, has_more = false;

	/* Unchanged, it still has its senders and descriptors. */
	if (!pipe && file_has_messages(fd, want))
		return NULL;
	emptied = in >= 0 && out >= 0 && file_drain(in, pipe);
	if (emptied) {
		while (put < want->content_bytes) {
			const ssize_t n = pipe ? write(out, want->content + put,
						       want->content_bytes - put)
					       : put_message(out, want, put, passed);

			if (n < 0 && errno == EAGAIN && !pipe && !has_more &&
			    (has_more = get_more_room(out, &room)))
				continue;
			if (n <= 0)
				break;
			put += (uint32_t)n + (messages ? (uint32_t)sizeof(uint32_t) : 0);
		}
	}
	if (has_more)
		give_room_back(out, &room);
	if (put < want->content_bytes || !emptied)
		problem = "its contents could not be put back";
	else if (!all_passed(want, passed))
		problem = "descriptors in flight in it are lost";
	else if (want->content_lost)
		problem = "its contents are lost";
	else if (want->senders_lost)
		problem = "the senders of its contents are not known any more";
	if (pipe) {
		close_fd(&in);
		close_fd(&out);
	}
	return problem;
}

/* ---- counts, timers, masks, offsets --------------------------------------------- */

static const char *put_count(int fd, const struct file *want, const struct file *now)
{
	uint64_t value, count;
	struct iovec io = { &value, sizeof value };

	if (now && now->count == want->count)
		return NULL;
	count = file_count(fd); /* another process that has it may have restored it */
	if (count == want->count)
		return NULL;
	/* Never blocks, whatever its flags are.  A semaphore is decremented by one; one that is far
	 * too high has been replaced (files_restore.c). */
	for (int i = 0; count > want->count && i < FILE_COUNT_READS; i++) {
		if (preadv2(fd, &io, 1, -1, RWF_NOWAIT) != sizeof value)
			return "its count could not be put back";
		count -= value < count ? value : count;
	}
	if (count > want->count)
		return "its count could not be put back";
	value = want->count - count;
	if (value && pwritev2(fd, &io, 1, -1, RWF_NOWAIT) != sizeof value &&
	    write(fd, &value, sizeof value) < 0)
		return "its count could not be put back";
	return NULL;
}

/* Skips the instants at which it would have expired; returns their number; 0: never again. */
static uint64_t next_of(const struct file *want, uint64_t now_of_clock, uint64_t *ticks)
{
	const uint64_t late = now_of_clock - want->deadline_ns;

	if (!want->deadline_ns || now_of_clock < want->deadline_ns)
		return want->deadline_ns;
	*ticks += 1 + (want->interval_ns ? late / want->interval_ns : 0);
	return want->interval_ns ? now_of_clock + want->interval_ns - late % want->interval_ns : 0;
}

/* One that has expired and is not read is not rearmed until then, and does not show since when. */
static bool stands_still(const struct file *want)
{
	return want->ticks && want->interval_ns && !want->deadline_ns;
}

/* Expires when it would have; unread expiries can be read.  An older kernel cannot set their
 * number, and gets the instant before the next. */
static const char *put_timer(int fd, const struct file *want)
{
	const uint64_t set_ticks_of = want->ticks && !stands_still(want) ? want->ticks : 0;
	int flags = want->settime_flags & (TFD_TIMER_ABSTIME | TFD_TIMER_CANCEL_ON_SET);
	const uint64_t now = clock_ns(want->clock);
	uint64_t next, ticks = set_ticks_of;
	struct itimerspec t = { .it_interval = timespec_of(want->interval_ns) };

	if (!now)
		return "its timer could not be set";
	next = stands_still(want) ? now + 1 : next_of(want, now, &ticks);
	t.it_value = timespec_of(next && !(flags & TFD_TIMER_ABSTIME) ? next - now : next);
	if (timerfd_settime(fd, flags, &t, NULL))
		return "its timer could not be set";
	if (!ticks || !ioctl(fd, SET_TICKS, &ticks))
		return NULL;
	t.it_value = timespec_of(next > want->interval_ns ? next - want->interval_ns : 1);
	flags |= TFD_TIMER_ABSTIME;
	return timerfd_settime(fd, flags, &t, NULL) ? "its timer could not be set" : NULL;
}

bool file_is_locked(int fd)
{
	struct flock lock = { .l_type = F_WRLCK, .l_whence = SEEK_SET };

	return fcntl(fd, F_OFD_GETLK, &lock) || lock.l_type != F_UNLCK;
}

bool file_is_remote(int fd)
{
	/* linux/magic.h; requests for locks would go to the server, or to a program */
	static const uint32_t remote[] = { 0x6969,     0x65735546, 0xfe534d42, 0xff534d42,
					   0x517b,     0x01021997, 0x00c36400, 0x5346414f,
					   0x01161970, 0x7461636f, 0x73757245 };
	struct statfs fs;

	if (fstatfs(fd, &fs))
		return true;
	for (size_t i = 0; i < sizeof remote / sizeof *remote; i++)
		if ((uint32_t)fs.f_type == remote[i])
			return true;
	return false;
}

bool file_is_memory(const struct file *file)
{
	return device_is_memory(device_number(major(file->dev), minor(file->dev)));
}

static const char *put_flocks(int fd, const struct file *want, const struct file *now)
{
	int was = 0, is = 0;

	for (uint32_t i = 0; i < want->lock_count; i++)
		if (want->lock[i].kind == LOCK_FLOCK_)
			was = want->lock[i].exclusive ? LOCK_EX : LOCK_SH;
	for (uint32_t i = 0; now && i < now->lock_count; i++)
		if (now->lock[i].kind == LOCK_FLOCK_)
			is = now->lock[i].exclusive ? LOCK_EX : LOCK_SH;
	/* Repeating a lock changes nothing; but it might be a request to a server. */
	if (want->lock_unsure || (want->remote && was == is))
		return NULL;
	return flock(fd, (was ? was : LOCK_UN) | LOCK_NB) && was ? "its lock is somebody else's now"
								 : NULL;
}

static const char *put_ofd_locks(int fd, const struct file *want, const struct file *now)
{
	const char *problem = NULL;
	struct flock lock = { .l_whence = SEEK_SET };

	for (uint32_t i = 0; now && i < now->lock_count; i++)
		if (now->lock[i].kind == LOCK_OFD_) {
			(void)budget_step();
			lock.l_type = F_UNLCK;
			lock.l_start = now->lock[i].start;
			lock.l_len = now->lock[i].end < 0
					     ? 0
					     : now->lock[i].end - now->lock[i].start + 1;
			fcntl(fd, F_OFD_SETLK, &lock);
		}
	for (uint32_t i = 0; i < want->lock_count; i++)
		if (want->lock[i].kind == LOCK_OFD_) {
			(void)budget_step();
			lock.l_type = want->lock[i].exclusive ? F_WRLCK : F_RDLCK;
			lock.l_start = want->lock[i].start;
			lock.l_len = want->lock[i].end < 0
					     ? 0
					     : want->lock[i].end - want->lock[i].start + 1;
			if (fcntl(fd, F_OFD_SETLK, &lock))
				problem = "its lock is somebody else's now";
		}
	return problem;
}

static bool same_ofd_locks(const struct file *a, const struct file *b)
{
	uint32_t n = 0;

	for (uint32_t i = 0; i < a->lock_count; i++) {
		bool found = a->lock[i].kind != LOCK_OFD_;

		(void)budget_step();
		for (uint32_t k = 0; !found && k < b->lock_count; k++)
			found = !memcmp(&a->lock[i], &b->lock[k], sizeof *a->lock);
		if (!found)
			return false;
		n += a->lock[i].kind == LOCK_OFD_;
	}
	for (uint32_t i = 0; i < b->lock_count; i++)
		n -= b->lock[i].kind == LOCK_OFD_;
	return n == 0;
}

const char *file_put_state(int fd, const struct file *want, const struct file *now, bool rewind)
{
	const char *problem = NULL, *other;

	if (want->flags & O_PATH)
		return NULL;
	/* FASYNC is only cleared here: the process that sets it becomes the owner. */
	if ((!now || (now->flags ^ want->flags) & (STATUS_FLAGS | FASYNC)) && !want->outside) {
		const int keep = ~(STATUS_FLAGS | (want->flags & FASYNC ? 0 : FASYNC));

		if (fcntl(fd, F_SETFL, (fcntl(fd, F_GETFL) & keep) | (want->flags & STATUS_FLAGS)))
			problem = "its flags could not be put back";
	}
	switch (want->kind) {
	case FILE_REGULAR:
	case FILE_DIRECTORY:
		/* Appended to: the offset does not matter. */
		if (want->offset >= 0 && !want->outside && !(want->flags & O_APPEND && now) &&
		    (rewind || !now) && (!now || now->offset != want->offset) &&
		    lseek(fd, want->offset, SEEK_SET) < 0)
			problem = "its offset could not be put back";
		other = put_flocks(fd, want, now);
		problem = problem ? problem : other;
		if (now ? !same_ofd_locks(want, now) : want->lock_count) {
			other = put_ofd_locks(fd, want, now);
			problem = problem ? problem : other;
		}
		break;
	case FILE_EVENTFD:
		other = put_count(fd, want, now);
		problem = problem ? problem : other;
		break;
	case FILE_TIMERFD:
		other = put_timer(fd, want);
		problem = problem ? problem : other;
		break;
	case FILE_DEVICE:
		/* One that was reopened has lost more, which is reported. */
		if (now && file_is_video(want)) {
			other = file_put_video(fd, &want->video);
			problem = problem ? problem : other;
		}
		break;
	case FILE_SIGNALFD:
		if ((!now || now->mask != want->mask) &&
		    syscall(SYS_signalfd4, fd, &want->mask, 8, 0) < 0)
			problem = "its mask could not be put back";
		break;
	default:
		break;
	}
	return problem;
}

bool file_tcp_moved(const struct file *want, const struct file *now)
{
	return !want->tcp_counted || !now->tcp_counted || want->tcp_written != now->tcp_written ||
	       want->tcp_taken != now->tcp_taken || (want->tcp_failed && !now->tcp_failed);
}

static bool is_tcp(const struct file *f)
{
	return f->socket && f->socket->protocol == IPPROTO_TCP;
}

uint32_t address_port(const struct sockaddr_storage *address)
{
	/* It is at the same place in an IPv6 address. */
	return address->ss_family == AF_INET || address->ss_family == AF_INET6
		       ? ntohs(((const struct sockaddr_in *)address)->sin_port)
		       : 0;
}

void files_find_accepted(struct files *files)
{
	bool listening[UINT16_MAX + 1] = { false };

	for (uint32_t i = 0; i < files->count; i++)
		if (is_tcp(&files->file[i]) && files->file[i].socket->listening)
			listening[address_port(&files->file[i].socket->local)] = true;
	for (uint32_t i = 0; i < files->count; i++)
		files->file[i].accepted = is_tcp(&files->file[i]) &&
					  listening[address_port(&files->file[i].socket->local)];
}

bool file_tcp_is_cut(const struct file *f)
{
	return is_tcp(f) && !f->accepted &&
	       (f->tcp_failed || f->tcp_unread || f->tcp_state == TCP_ESTABLISHED ||
		f->tcp_state == TCP_FIN_WAIT1 || f->tcp_state == TCP_FIN_WAIT2);
}

int file_break_tcp(int fd, int domain)
{
	const struct sockaddr_in here = { .sin_family = AF_INET,
					  .sin_addr.s_addr = htonl(INADDR_LOOPBACK) };
	const struct sockaddr_in6 here6 = { .sin6_family = AF_INET6,
					    .sin6_addr = IN6ADDR_LOOPBACK_INIT };
	const struct sockaddr nobody = { .sa_family = AF_UNSPEC };
	const int on = TCP_REPAIR_ON, off = TCP_REPAIR_OFF_NO_WP;
	int failed;

	if (connect(fd, &nobody, sizeof nobody) ||
	    setsockopt(fd, IPPROTO_TCP, TCP_REPAIR, &on, sizeof on))
		return -1;
	failed = domain == AF_INET ? connect(fd, (const struct sockaddr *)&here, sizeof here)
				   : connect(fd, (const struct sockaddr *)&here6, sizeof here6);
	setsockopt(fd, IPPROTO_TCP, TCP_REPAIR, &off, sizeof off);
	return failed ? -1 : connect(fd, &nobody, sizeof nobody);
}

/* connect(2) to nothing resets it, shutdown(2) makes it read as closed. */
const char *file_reset_tcp(int fd)
{
	struct sockaddr nobody = { .sa_family = AF_UNSPEC };
	int error;
	socklen_t bytes = sizeof error;

	if (connect(fd, &nobody, sizeof nobody))
		return "its connection could not be reset";
	shutdown(fd, SHUT_RDWR); /* returns ENOTCONN, but works (net/ipv4/af_inet.c) */
	getsockopt(fd, SOL_SOCKET, SO_ERROR, &error, &bytes);
	return NULL;
}

/* Also one that has ended since: it may still have unread bytes, after those that were read. */
const char *file_lose_tcp(int fd, const struct file *want)
{
	if (!file_tcp_is_cut(want) || file_break_tcp(fd, want->socket->domain))
		return file_reset_tcp(fd);
	shutdown(fd, SHUT_RDWR);
	return NULL;
}
