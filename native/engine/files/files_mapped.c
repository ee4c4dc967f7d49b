/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt.files=strict, for files that are mapped for writing: their contents.
 *
 * A write through a mapping changes the file's time when a page gets dirty, not again
 * before the kernel has written it out, and on a tmpfs never.  So the contents are
 * copied while everything is stopped, and compared at a restore.  What is too much to
 * be copied (avckpt.shm), or was mapped since, counts as written; and so does what cannot be opened
 * without an effect, or a request to a file server: it may be the app, which is stopped.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "files.h"

#define MAPPED_MAX 64

struct mapped_area {
	avc_remote start, end;
	uint64_t offset, inode, device;
	int fd; /* until it is copied: others may want a lease */
	uint8_t *content;
	ssize_t bytes; /* less than the mapping where the file ends earlier; -1: unreadable */
};

struct files_mapped {
	uint32_t count;
	struct mapped_area area[MAPPED_MAX];
};

/* Not on a disk: what it tells others cannot be taken back anyway. */
static bool is_data(const struct mapping *m)
{
	return m->shared && m->mode[1] == 'w' && m->inode && strncmp(m->name, "/dev/", 5) &&
	       strncmp(m->name, "/run/", 5) && !device_is_memory(m->device);
}

static int open_data(pid_t pid, const struct mapping *m, struct mounts *mounts,
		     struct leases *leases)
{
	int path_fd = proc_open_mapped(pid, m->start, m->end, O_PATH), fd = -1;
	const char *type = path_fd < 0 ? "" : mount_type(mounts, pid, path_fd);

	if (*type && !mount_is_served(type))
		fd = open_to_read(path_fd, m, leases);
	close_fd(&path_fd);
	return fd;
}

struct look {
	pid_t pid;
	struct mounts mounts;
	struct leases *leases;
	struct files_mapped *mapped;
	uint64_t bytes_left;
};

static int take_area(const struct mapping *m, void *arg)
{
	struct look *look = arg;
	struct files_mapped *mapped = look->mapped;
	struct mapped_area *a = &mapped->area[mapped->count];
	const size_t bytes = m->end - m->start;

	if (!is_data(m) || mapped->count == MAPPED_MAX || bytes > look->bytes_left)
		return 0;
	*a = (struct mapped_area){
		.start = m->start,
		.end = m->end,
		.offset = m->offset,
		.inode = m->inode,
		.device = m->device,
		.fd = open_data(look->pid, m, &look->mounts, look->leases),
	};
	if (a->fd < 0)
		return 0;
	a->content = malloc(bytes);
	/* Page faults and disk reads now, not in the freeze. */
	if (!a->content || read_whole(a->fd, a->content, bytes, (off_t)a->offset) < 0) {
		free(a->content);
		close_fd(&a->fd);
		return 0;
	}
	look->bytes_left -= bytes;
	mapped->count++;
	return 0;
}

struct files_mapped *files_mapped_prepare(pid_t pid, uint64_t limit_bytes, struct leases *leases)
{
	struct look look = {
		.pid = pid,
		.leases = leases,
		.mapped = calloc(1, sizeof *look.mapped),
		.bytes_left = limit_bytes,
	};

	/* What cannot be read counts as written at a restore. */
	if (look.mapped)
		(void)proc_mappings(pid, "maps", take_area, &look);
	mounts_free(&look.mounts);
	return look.mapped;
}

void files_mapped_copy(struct files_mapped *mapped)
{
	for (uint32_t i = 0; mapped && i < mapped->count; i++) {
		struct mapped_area *a = &mapped->area[i];

		a->bytes = read_whole(a->fd, a->content, a->end - a->start, (off_t)a->offset);
		close_fd(&a->fd);
	}
}

void files_mapped_free(struct files_mapped *mapped)
{
	for (uint32_t i = 0; mapped && i < mapped->count; i++) {
		close_fd(&mapped->area[i].fd);
		free(mapped->area[i].content);
	}
	free(mapped);
}

static bool is_unchanged(const struct mapped_area *a, pid_t template, struct mounts *mounts,
			 struct leases *leases)
{
	const struct mapping m = {
		.start = a->start, .end = a->end, .device = a->device, .inode = a->inode
	};
	const size_t bytes = a->end - a->start;
	int fd = open_data(template, &m, mounts, leases);
	uint8_t *now = got_memory(malloc(bytes));
	bool same;

	same = fd >= 0 && now && a->bytes >= 0 &&
	       read_whole(fd, now, bytes, (off_t)a->offset) == a->bytes &&
	       !memcmp(now, a->content, (size_t)a->bytes);
	free(now);
	close_fd(&fd);
	return same;
}

struct check {
	const struct files_mapped *mapped;
	bool any;
	struct avc_error *err;
};

static int check_known(const struct mapping *m, void *arg)
{
	struct check *check = arg;

	check->any = true;
	if (!is_data(m))
		return 0;
	for (uint32_t i = 0; i < check->mapped->count; i++) {
		const struct mapped_area *a = &check->mapped->area[i];

		if (a->start == m->start && a->end == m->end && a->offset == m->offset &&
		    a->inode == m->inode)
			return 0;
	}
	return fail(check->err, AVC_UNSUPPORTED, 0, 0, "restore", "",
		    "avckpt.files=strict: %.60s is mapped for writing", m->name);
}

static int check_process(pid_t pid, struct check *check)
{
	check->any = false;
	if (proc_mappings(pid, "maps", check_known, check) == 0 && check->any)
		return 0;
	if (check->err->code)
		return -1;
	return fail(check->err, AVC_UNSUPPORTED, 0, pid, "restore", "open(maps)",
		    "avckpt.files=strict: what files were mapped cannot be told");
}

int files_mapped_check(const struct image *image, pid_t holder, struct avc_error *err)
{
	struct check check = { .mapped = image->mapped, .err = err };
	struct mounts mounts = { 0 };
	struct leases leases = { 0 };
	bool same = true;

	if (!image->mapped)
		return fail(err, AVC_UNSUPPORTED, 0, 0, "restore", "",
			    "avckpt.files=strict: was set after the checkpoint");
	/* The template has what was mapped then, the holder what was mapped last. */
	if (check_process(image->template, &check) || check_process(holder, &check))
		return -1;
	for (uint32_t i = 0; same && i < check.mapped->count; i++)
		same = is_unchanged(&check.mapped->area[i], image->template, &mounts, &leases);
	leases_free(&leases);
	mounts_free(&mounts);
	return same ? 0
		    : fail(err, AVC_UNSUPPORTED, 0, 0, "restore", "",
			   "avckpt.files=strict: a file that is mapped for writing was written "
			   "since the checkpoint");
}
