/* SPDX-License-Identifier: Apache-2.0
 *
 * What is in pipes and sockets during a freeze.
 */
#include <fcntl.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "files_look.h"

#define READ_TOGETHER 128

/* Whether the app has the other end.  With several processes that is found out at a restore, when
 * it matters. */
static bool may_be_ours(struct files *files, const struct file *f)
{
	if (!files->several)
		return files_other_end(files, f);
	return !f->outside && (f->kind == FILE_PIPE || (f->socket && f->socket->peer));
}

/* Heirs are what they were before the freeze. */
static bool has_other_end(struct files *files, const struct file *f)
{
	return files_other_end(files, f) || (files->heirs && files_other_end(files->heirs, f));
}

bool file_may_have_content(const struct file *f)
{
	return !(f->kind == FILE_PIPE && (f->flags & O_ACCMODE) == O_WRONLY) &&
	       f->shared == f->fd && !f->outside && file_is_channel(f);
}

void file_copy_content(const struct files *parent, struct file *f)
{
	const struct file *from = files_find(parent, f->inherited->shared);

	f->ended = from->ended;
	f->content_lost = from->content_lost;
	f->rights_lost = from->rights_lost || from->flight_count;
	f->senders_lost = from->senders_lost;
	f->rights = from->rights;
	/* What is restored once is kept in one of them (files_family.c). */
	if (!from->content_bytes || !from->ended)
		return;
	f->content = budget_has(from->content_bytes) && budget_take(from->content_bytes)
			     ? malloc(from->content_bytes)
			     : NULL;
	f->content_lost |= !f->content;
	if (!f->content)
		return;
	memcpy(f->content, from->content, from->content_bytes);
	f->content_bytes = from->content_bytes;
}

/* Ends that are read together. */
struct reading {
	const struct image *image;
	struct scratch *scratch;
	struct pollfd end[READ_TOGETHER];
	struct file *file[READ_TOGETHER];
	uint32_t count;
	uint32_t begun, kept; /* of all files: [kept, begun) have duplicates            */
};

/* Most duplicates are numbered one after the other. */
static void drop_duplicates(struct reading *reading)
{
	struct file *file = reading->image->files->file;
	int first = 0, next = 0; /* [first, next) */

	for (; reading->kept < reading->begun; reading->kept++) {
		const int fd = file[reading->kept].ours;

		file[reading->kept].ours = 0;
		if (fd <= 0)
			continue;
		if (fd != next) {
			if (first < next)
				syscall(SYS_close_range, first, next - 1, 0);
			first = fd;
		}
		next = fd + 1;
	}
	if (first < next)
		syscall(SYS_close_range, first, next - 1, 0);
}

static void keep_end(struct reading *reading, struct file *f, short revents)
{
	struct files *files = reading->image->files;

	if (!revents)
		return;
	if (revents & POLLRDHUP && f->socket)
		f->socket->shut |= SHUT_IN;
	f->ended = revents & POLLHUP && !has_other_end(files, f);
	if (revents & POLLIN && (f->ended || may_be_ours(files, f)))
		file_keep_content(reading->image->process, f->ours, f, reading->scratch);
}

static void keep_gathered(struct reading *reading)
{
	if (reading->count && poll_for(reading->end, reading->count, 0) > 0)
		for (uint32_t i = 0; i < reading->count; i++)
			keep_end(reading, reading->file[i], reading->end[i].revents);
	reading->count = 0;
	drop_duplicates(reading);
}

static void keep_content(struct reading *reading, struct file *f)
{
	const struct image *image = reading->image;

	/* What is inherited: files_fill_heirs(). */
	if (f->inherited || !file_may_have_content(f))
		return;
	if (f->pipe_bytes < 0) {
		f->content_lost = true;
		return;
	}
	if (f->ours <= 0)
		f->ours = proc_borrow_fd(image->process->pidfd, f->fd);
	if (f->ours < 0)
		return;
	reading->end[reading->count] = (struct pollfd){ .fd = f->ours,
							.events = POLLIN | POLLRDHUP };
	reading->file[reading->count++] = f;
	if (reading->count == READ_TOGETHER)
		keep_gathered(reading);
}

void file_drop_ours(struct file *f)
{
	if (f->ours > 0)
		close(f->ours);
	f->ours = 0;
}

void files_keep_contents(const struct image *image, struct scratch *scratch)
{
	struct reading reading = { .image = image, .scratch = scratch };

	while (reading.begun < image->files->count) {
		struct file *f = &image->files->file[reading.begun++];

		if (budget_step())
			keep_content(&reading, f);
	}
	keep_gathered(&reading);
}
