/* SPDX-License-Identifier: Apache-2.0
 *
 * Descriptors for a process being restored: one at a time, over a socket (unix(7), SCM_RIGHTS).
 */
#include <errno.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <sys/uio.h>

#include "trace.h"

int fd_send(int socket, int fd)
{
	uint8_t byte = 0, control[CMSG_SPACE(sizeof fd)] __attribute__((aligned(8))) = { 0 };
	struct iovec io = { &byte, 1 };
	struct msghdr head = { .msg_iov = &io,
			       .msg_iovlen = 1,
			       .msg_control = control,
			       .msg_controllen = sizeof control };
	struct cmsghdr *c = CMSG_FIRSTHDR(&head);

	c->cmsg_level = SOL_SOCKET;
	c->cmsg_type = SCM_RIGHTS;
	c->cmsg_len = CMSG_LEN(sizeof fd);
	memcpy(CMSG_DATA(c), &fd, sizeof fd);
	return sendmsg(socket, &head, MSG_DONTWAIT | MSG_NOSIGNAL) == 1 ? 0 : -1;
}

void fd_letter_write(struct fd_letter *letter, avc_remote remote)
{
	*letter = (struct fd_letter){ 0 };
	letter->io = (struct iovec){ (void *)(remote + offsetof(struct fd_letter, byte)), 1 };
	letter->head = (struct msghdr){
		.msg_iov = (void *)(remote + offsetof(struct fd_letter, io)),
		.msg_iovlen = 1,
		.msg_control = (void *)(remote + offsetof(struct fd_letter, control)),
		.msg_controllen = sizeof letter->control,
	};
}

int fd_letter_number(const struct fd_letter *letter)
{
	const size_t bytes = letter->head.msg_controllen;
	int fd;

	if (bytes < CMSG_LEN(sizeof fd) || bytes > sizeof letter->control)
		return -1;
	memcpy(&fd, letter->control + CMSG_LEN(0), sizeof fd);
	return fd;
}

int fd_receive(int socket)
{
	struct fd_letter letter;
	ssize_t n;

	fd_letter_write(&letter, (avc_remote)&letter);
	do
		n = recvmsg(socket, &letter.head, MSG_CMSG_CLOEXEC);
	while (n < 0 && errno == EINTR);
	if (n > 0 && letter.head.msg_flags & MSG_CTRUNC)
		errno = EMFILE; /* there was one, but no number for it */
	return n > 0 ? fd_letter_number(&letter) : -1;
}

void fd_table_free(struct fd_table *table)
{
	for (uint32_t i = 0; i < table->count; i++)
		close_fd(&table->entry[i].ours);
	free(table->entry);
	*table = (struct fd_table){ 0 };
}
