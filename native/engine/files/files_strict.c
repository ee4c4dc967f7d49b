/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt.files=strict: memory does not go back behind files that were written (files.h).
 */
#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include "files.h"

static bool is_data(const struct file *f)
{
	return f->kind == FILE_REGULAR && (f->flags & O_ACCMODE) != O_RDONLY &&
	       !(f->flags & O_PATH) && !f->outside && f->name && !file_is_memory(f);
}

/* Timestamps of most kernels advance by a tick: a write in the same tick as the
 * checkpoint may not show. */
#define TICK_NS (10 * NS_PER_MS)

static bool was_written(const struct files *want, const struct file *w, const struct stat *st)
{
	return st->st_size != w->bytes || timespec_ns(&st->st_mtim) != timespec_ns(&w->modified) ||
	       timespec_ns(&st->st_ctim) != timespec_ns(&w->changed) ||
	       timespec_ns(&w->modified) + TICK_NS > want->taken_ns;
}

int files_check_strict(const struct image *image, pid_t pid, int pidfd, pid_t init, pid_t holder,
		       struct avc_error *err)
{
	const struct files_owner owner = { .pid = pid, .pidfd = pidfd, .init = init };
	const struct files *want = image->files;
	struct files *now = files_new(want->count + 64);
	int result = -1;

	if (!now || files_look(now, &owner, FILES_NOW, image->files, err))
		goto out;
	for (uint32_t i = 0; i < want->count; i++) {
		const struct file *w = &want->file[i];
		const struct file *n = files_find(now, w->fd);
		struct stat st = { 0 };
		int fd;

		if (!is_data(w))
			continue;
		n = n && files_same_object(w, n) ? n : NULL;
		fd = n ? proc_borrow_fd(pidfd, n->fd) : file_open_path(w, init, NULL);
		if (fd < 0 || fstat(fd, &st)) {
			close_fd(&fd);
			fail(err, AVC_UNSUPPORTED, 0, 0, "restore", "",
			     "avckpt.files=strict: %.80s is not there any more", w->name);
			goto out;
		}
		close(fd);
		if (was_written(want, w, &st) || (n && n->offset != w->offset)) {
			fail(err, AVC_UNSUPPORTED, 0, 0, "restore", "",
			     "avckpt.files=strict: %.80s was written since the checkpoint",
			     w->name);
			goto out;
		}
	}
	for (uint32_t i = 0; i < now->count; i++) {
		const struct file *n = &now->file[i], *w = files_find(want, n->fd);

		if (is_data(n) && !(w && files_same_object(w, n)) &&
		    (timespec_ns(&n->modified) + TICK_NS > want->taken_ns ||
		     files_clock_was_set(want))) {
			fail(err, AVC_UNSUPPORTED, 0, 0, "restore", "",
			     "avckpt.files=strict: %.80s was written since the checkpoint",
			     n->name);
			goto out;
		}
	}
	result = files_mapped_check(image, holder, err);
out:
	files_free(now);
	return result;
}
