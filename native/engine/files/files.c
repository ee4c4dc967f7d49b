/* SPDX-License-Identifier: Apache-2.0
 *
 * A table of descriptors: what every other file here needs.
 */
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>

#include "files_look.h"

const char files_serves[] = "it serves a file system (FUSE): after a restore, requests that it had "
			    "read would have no answer";

static const struct {
	const char *prefix, *reason;
} refused[] = {
	{ "anon_inode:[io_uring]", "it uses io_uring (most programs do without: "
				   "avckpt.io_uring=off)" },
	{ "anon_inode:[userfaultfd]", "it uses userfaultfd" },
	{ "anon_inode:[perf_event]", "it has performance counters open" },
	{ "/dev/nvidia", "it has a GPU device open" },
	{ "/dev/dri/", "it has a GPU device open" },
	{ "/dev/kfd", "it has a GPU device open" },
	{ "/dev/kvm", "it runs virtual machines" },
	{ "/dev/fuse", files_serves },
};

const char *files_refuses(const char *name)
{
	for (size_t i = 0; i < sizeof refused / sizeof *refused; i++)
		if (!strncmp(name, refused[i].prefix, strlen(refused[i].prefix)))
			return refused[i].reason;
	return NULL;
}

struct files *files_new(uint32_t room)
{
	struct files *files = calloc(1, sizeof *files);

	if (!files)
		return NULL;
	files->room = room;
	files->file = calloc(room, sizeof *files->file);
	if (!files->file) {
		free(files);
		return NULL;
	}
	return files;
}

struct files *files_share(struct files *files)
{
	__atomic_fetch_add(&files->others, 1, __ATOMIC_RELAXED);
	return files;
}

void files_free(struct files *files)
{
	if (!files || __atomic_fetch_sub(&files->others, 1, __ATOMIC_ACQ_REL))
		return;
	for (uint32_t i = 0; i < files->count; i++) {
		struct file *f = &files->file[i];

		free(f->name);
		free(f->watch);
		free(f->mark);
		free(f->lock);
		file_socket_free(f->socket);
		free(f->content);
		free(f->flight);
	}
	files_free(files->heirs);
	free(files->varied);
	free(files->own);
	free(files->ends);
	free(files->file);
	free(files->area);
	free(files);
}

struct file *files_find_among(const struct files *files, uint32_t count, int fd)
{
	uint32_t at = (uint32_t)fd;

	/* Most tables have no gaps, and a freeze may look up tens of thousands. */
	if (at >= count || files->file[at].fd != fd)
		at = LOWER_BOUND(count, i, files->file[i].fd < fd);
	return at < count && files->file[at].fd == fd ? &files->file[at] : NULL;
}

struct file *files_find(const struct files *files, int fd)
{
	return files_find_among(files, files ? files->count : 0, fd);
}

/* Of anonymous inodes only eventfds have an id. */
int files_compare(const struct file *a, const struct file *b)
{
	const uint64_t x[] = { a->kind, a->ino, a->dev,
			       a->rdev, a->id,  (uint64_t)(a->flags & (O_ACCMODE | O_PATH)) };
	const uint64_t y[] = { b->kind, b->ino, b->dev,
			       b->rdev, b->id,  (uint64_t)(b->flags & (O_ACCMODE | O_PATH)) };

	for (size_t i = 0; i < sizeof x / sizeof *x; i++)
		if (x[i] != y[i])
			return x[i] < y[i] ? -1 : 1;
	return 0;
}

bool files_same_object(const struct file *a, const struct file *b)
{
	return !files_compare(a, b);
}

int files_find_device(const struct files *files, uint32_t rdev)
{
	for (uint32_t i = 0; files && i < files->count; i++)
		if (files->file[i].kind == FILE_DEVICE && files->file[i].rdev == rdev &&
		    !(files->file[i].flags & O_PATH))
			return files->file[i].fd;
	return -1;
}
