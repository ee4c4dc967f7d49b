/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt.tcp=messages: streams of messages, and the position of a connection in them.
 *
 * The kernel does not know where a message begins.  But a stream of messages has pauses, and the
 * bytes of one message arrive without notable ones.  So a connection that has been silent for a
 * moment, with nothing unread and nothing waiting to be written, is between two messages.
 */
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>

#include "files.h"

/* A sender may lose its CPU in the middle of a message.  Longer would be safer, but too long for a
 * stream of 100 messages a second. */
#define SILENCE_NS (8 * NS_PER_MS)
/* tcpi_last_data_recv counts in ticks of the kernel's clock (HZ is 250 at least). */
#define TICK_NS (4 * NS_PER_MS)
/* How long to wait for the end of a message, while no thread reads. */
#define DRAIN_NS (100 * NS_PER_MS)

/* For how long at least nothing has arrived. */
static uint64_t silent_ns(const struct tcp_info *info)
{
	const uint64_t silent = info->tcpi_last_data_recv * NS_PER_MS;

	if (info->tcpi_state != TCP_ESTABLISHED)
		return UINT64_MAX;
	return silent > TICK_NS ? silent - TICK_NS : 0;
}

static struct tcp_info info_of(int fd)
{
	struct tcp_info info = { 0 };
	socklen_t bytes = sizeof info;

	getsockopt(fd, IPPROTO_TCP, TCP_INFO, &info, &bytes);
	return info;
}

bool file_was_coming(const struct tcp_info *info, int unread)
{
	return unread > 0 || silent_ns(info) < SILENCE_NS;
}

bool file_is_coming(int fd)
{
	const struct tcp_info info = info_of(fd);
	int unread = 0;

	return file_was_coming(&info, ioctl(fd, FIONREAD, &unread) ? 0 : unread);
}

bool file_is_going(int fd)
{
	struct pollfd writable = { .fd = fd, .events = POLLOUT };

	return poll_for(&writable, 1, 0) == 0;
}

/* A writer that has written part of a message waits for room to write more.  Edge-triggered sets
 * always wait for that. */
void files_find_going(struct files *files)
{
	for (uint32_t i = 0; i < files->count; i++) {
		const struct file *epoll = &files->file[i];

		for (uint32_t k = 0; epoll->kind == FILE_EPOLL && k < epoll->watch_count; k++) {
			const struct file_watch *watch = &epoll->watch[k];
			struct file *file = files_find(files, watch->fd);

			if (file && watch->events & EPOLLOUT && !(watch->events & EPOLLET))
				file->tcp_going = true;
		}
	}
}

/* Discards the rest of a message.  False if it does not end. */
static bool drain(int fd)
{
	const uint64_t begun = now_ns();
	const struct tcp_info info = info_of(fd);
	const uint64_t silent = silent_ns(&info);
	uint64_t last = begun - (silent < begun ? silent : begun), now;

	while ((now = now_ns()) - begun < DRAIN_NS) {
		struct pollfd readable = { .fd = fd, .events = POLLIN };
		/* TCP discards data read with MSG_TRUNC, without a copy: tcp(7). */
		const ssize_t n = recv(fd, NULL, 1 << 30, MSG_TRUNC | MSG_DONTWAIT);

		if (n > 0) {
			last = now;
			continue;
		}
		if (n == 0)
			return true; /* closed by the peer, which the app will see */
		if (now - last >= SILENCE_NS)
			return true;
		poll(&readable, 1, (int)((SILENCE_NS - (now - last)) / NS_PER_MS) + 1);
	}
	return false;
}

const char *file_put_stream(int fd, const struct file *want, const struct file *now)
{
	const bool in = want->tcp_taken != now->tcp_taken;
	const bool out = want->tcp_written != now->tcp_written;

	/* The half message that either side has would be continued by another message. */
	if ((in && want->tcp_coming) || (out && (want->tcp_going || now->tcp_going)))
		return file_lose_tcp(fd, want);
	if (in && now->tcp_coming && !drain(fd))
		return file_lose_tcp(fd, want);
	return NULL;
}
