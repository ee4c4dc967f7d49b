/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt.files=auto: whether the program's files allow its memory to go back.
 *
 * A log, or any other output, is only appended to; lines unknown to a restored program do no harm.
 * A database has the layout of its files in memory, and memory that goes back behind them
 * overwrites new pages with old ones.  Such a file is also open for reading, or is locked, and it
 * is written elsewhere than at its end.  And a file that has been deleted since belonged to work
 * that is done.
 *
 * Beside such a file, what is not open counts as well (files_written.c): each PostgreSQL session is
 * a separate process that writes to its log and exits.
 */
#include <errno.h>
#include <fcntl.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "files.h"

/* Timestamps of most kernels advance by a tick (files_strict.c). */
#define TICK_NS (10 * NS_PER_MS)

/* A page that is mapped and dirty can be written again unnoticed, until the kernel has written it
 * out (vm.dirty_expire_centisecs, and the flusher's own interval). */
#define DIRTY_NS (35 * NS_PER_S)

/* Data that a program publishes, and does not read back (/tmp/hsperfdata_USER of Java,
 * queries.active of Prometheus), is mapped and small. */
#define STATUS_BYTES 65536

/* Not on a disk; shared memory is handled elsewhere. */
static bool is_data(const struct file *f)
{
	static const char *const elsewhere[] = { "/dev/", "/proc/", "/sys/" };

	if (f->kind != FILE_REGULAR || f->flags & O_PATH || f->outside || f->remote || !f->name ||
	    file_is_memory(f))
		return false;
	for (size_t i = 0; i < sizeof elsewhere / sizeof *elsewhere; i++)
		if (!strncmp(f->name, elsewhere[i], strlen(elsewhere[i])))
			return false;
	return true;
}

static int is_mapping_of(const struct mapping *m, void *arg)
{
	const struct file *w = arg;

	return m->shared && m->mode[1] == 'w' && m->inode == w->ino ? -1 : 0;
}

/* For writing. */
static bool is_mapped(pid_t pid, const struct file *w)
{
	struct file key = { .ino = w->ino };

	return proc_mappings(pid, "maps", is_mapping_of, &key) != 0;
}

/* `offset`: the current one; -1: it was closed since. */
static bool is_in_the_way(const struct image *image, const struct file *w, const struct stat *st,
			  int64_t offset)
{
	const bool output = (w->flags & O_ACCMODE) == O_WRONLY;
	const uint64_t modified = timespec_ns(&w->modified);
	const bool changed = st->st_size != w->bytes || timespec_ns(&st->st_mtim) != modified ||
			     modified + TICK_NS > image->files->taken_ns;

	if (w->flags & O_APPEND || (output && !w->lock_count))
		return false;
	/* Nothing is in it, then and now: only its times were set, as a sign of life (gunicorn). */
	if (!w->bytes && !st->st_size)
		return false;
	if (!changed)
		return w->bytes > STATUS_BYTES && modified + DIRTY_NS > image->files->taken_ns &&
		       is_mapped(image->template, w);
	/* Appended to, from end to end; one that has not grown was overwritten. */
	if (w->offset == w->bytes && offset == st->st_size && offset > w->offset)
		return false;
	return w->bytes > STATUS_BYTES || st->st_size > STATUS_BYTES ||
	       !is_mapped(image->template, w);
}

/* Its current descriptor, or its replacement's, in the table; -1: none. */
static int borrow(const struct file *w, int pidfd, struct stat *st)
{
	int fd = pidfd < 0 ? -1 : proc_borrow_fd(pidfd, w->fd);

	if (fd >= 0 && (fstat(fd, st) || st->st_ino != w->ino || st->st_dev != w->dev))
		close_fd(&fd);
	return fd;
}

static int check(const struct image *image, const struct file *w, int pidfd, pid_t init,
		 struct avc_error *err)
{
	const bool readable = (w->flags & O_ACCMODE) != O_WRONLY;
	int64_t offset = -1;
	struct stat st = { 0 };
	int fd = borrow(w, pidfd, &st), missing;

	if (fd >= 0) {
		offset = lseek(fd, 0, SEEK_CUR);
	} else {
		fd = file_find(w, image->template, init);
		missing = errno;
		if (fd < 0 || fstat(fd, &st)) {
			close_fd(&fd);
			/* A rotated log continues under another name. */
			if (w->flags & O_APPEND || (missing == ESTALE && !readable))
				return 0;
			/* A file that was read is replaced as a whole (rename(2)). */
			if (missing == ESTALE && (w->flags & O_ACCMODE) == O_RDONLY)
				return 0;
			return fail(err, AVC_UNSUPPORTED, 0, 0, "restore", "",
				    "avckpt.files=auto: %.60s, which it had open, was deleted "
				    "since the checkpoint",
				    w->name);
		}
	}
	close(fd);
	if ((w->flags & O_ACCMODE) == O_RDONLY || !is_in_the_way(image, w, &st, offset))
		return 0;
	return fail(err, AVC_UNSUPPORTED, 0, 0, "restore", "",
		    "avckpt.files=auto: %.60s was written in place since the checkpoint, so memory "
		    "cannot go back",
		    w->name);
}

bool files_is_database(const struct process *process)
{
	const struct files *files = process->files_before;

	for (uint32_t i = 0; files && i < files->count; i++) {
		const struct file *f = &files->file[i];

		if (is_data(f) && (f->flags & O_ACCMODE) == O_RDWR && !(f->flags & O_APPEND) &&
		    (f->bytes > STATUS_BYTES || !is_mapped(process->pid, f)))
			return true;
	}
	return false;
}

/* The time of day may have been another one when it was created, even a later one than now. */
static bool is_born_since(const struct files *files, int fd)
{
	struct statx born;
	uint64_t born_ns;

	if (!fd_look(fd, STATX_BTIME, &born) || !(born.stx_mask & STATX_BTIME))
		return false;
	born_ns = (uint64_t)born.stx_btime.tv_sec * NS_PER_S + born.stx_btime.tv_nsec;
	return born_ns > files->taken_ns && born_ns <= clock_ns(CLOCK_REALTIME) &&
	       !files_clock_was_set(files);
}

bool files_is_older(const struct image *image, int fd, const struct stat *st)
{
	/* One that was created since does not matter. */
	if (is_born_since(image->files, fd))
		return false;
	/* Of what was open for writing, files_check_auto() knows more. */
	for (uint32_t i = 0; i < image->files->count; i++) {
		const struct file *w = &image->files->file[i];

		if (w->ino == st->st_ino && w->dev == st->st_dev && w->kind == FILE_REGULAR &&
		    (w->flags & O_ACCMODE) != O_RDONLY)
			return false;
	}
	return true;
}

int files_check_auto(const struct image *image, int pidfd, pid_t init, struct avc_error *err)
{
	for (uint32_t i = 0; i < image->files->count; i++) {
		const struct file *w = &image->files->file[i];

		(void)budget_step();
		if (is_data(w) && check(image, w, pidfd, init, err))
			return -1;
	}
	return 0;
}
