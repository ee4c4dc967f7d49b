/* SPDX-License-Identifier: Apache-2.0
 *
 * Restores watches of inotify(7) under their own numbers (files.h).
 *
 * A watch is on an inode.  fdinfo names that by file system and handle, and the container
 * has the file system mounted somewhere: from any place on it a handle can be opened.
 */
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/inotify.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "files.h"

/* The number that the next watch gets (linux/inotify.h, since Linux 4.16). */
#define SET_NEXT_WD _IOW('I', 0, int32_t)

/* ---- where it is ---------------------------------------------------------------- */

/* Not just O_PATH, for open_by_handle_at(2); but opening a device has side effects. */
static int open_anchor(int at)
{
	struct stat st;

	if (fstat(at, &st) || !(S_ISREG(st.st_mode) || S_ISDIR(st.st_mode)))
		return -1;
	return open_again(at, O_RDONLY);
}

struct file_system {
	uint64_t dev;
	int anchor; /* anything that is on it, or -1                           */
	/* The root of most containers.  Its handles cannot be opened, but in them are
	 * those of the file system below, to which the anchor belongs.           */
	bool overlay;
	char point[PATH_MAX]; /* where it is mounted                               */
};

static void try_mount(struct file_system *fs, pid_t init, char *line)
{
	struct proc_mount mount;
	struct proc_stat stat;
	char *upper;
	int at = -1;

	if (!proc_parse_mount(line, &mount) ||
	    ((uint64_t)mount.major << 20 | mount.minor) != fs->dev || mount_is_served(mount.type) ||
	    strlen(mount.point) >= sizeof fs->point)
		return;
	strcpy(fs->point, mount.point);
	fs->overlay = !strcmp(mount.type, "overlay");
	upper = fs->overlay ? strstr(mount.details, ",upperdir=") : NULL;
	if (upper) {
		upper += 10;
		upper[strcspn(upper, ",")] = 0;
		proc_unescape(upper);
		/* A path of the host's; init's parent is the container's monitor there. */
		if (proc_stat(init, &stat) == 0)
			at = open_in_root_of(stat.parent, upper, O_NOFOLLOW);
	} else if (!fs->overlay) {
		at = open_in_root_of(init, mount.point, O_NOFOLLOW);
	}
	if (at >= 0)
		fs->anchor = open_anchor(at);
	close_fd(&at);
}

static void open_file_system(struct file_system *fs, pid_t init, uint64_t dev)
{
	char buffer[PROC_LINES], *line = NULL;
	size_t size = 0;
	FILE *mounts;

	close_fd(&fs->anchor);
	fs->dev = dev;
	mounts = proc_lines(init, "mountinfo", buffer);
	while (mounts && fs->anchor < 0 && getline(&line, &size, mounts) > 0)
		try_mount(fs, init, line);
	free(line);
	if (mounts)
		fclose(mounts);
}

static int open_handle(int anchor, int type, const uint8_t *bytes, uint32_t count)
{
	struct {
		struct file_handle head;
		uint8_t bytes[sizeof((struct file_mark *)0)->handle];
	} handle = { .head = { .handle_bytes = count, .handle_type = type } };

	if (!count || count > sizeof handle.bytes) {
		errno = EOPNOTSUPP;
		return -1;
	}
	memcpy(handle.head.f_handle, bytes, count);
	return got_fd(open_by_handle_at(anchor, &handle.head, O_PATH | O_CLOEXEC));
}

/* fs/overlayfs/overlayfs.h: struct ovl_fh, behind three bytes of padding. */
struct overlay_handle {
	uint8_t padding[3], version, magic, bytes, flags, type, uuid[16];
	uint8_t real[];
};

/* The lower file has a path, and some tail of it is the path in the overlay. */
static int open_overlaid(const struct file_system *fs, const struct file_mark *mark, pid_t init)
{
	const struct overlay_handle *handle = (const struct overlay_handle *)mark->handle;
	char below[2048], path[sizeof below + sizeof fs->point];
	struct stat st;
	ssize_t n;
	int real;

	if (mark->handle_bytes <= sizeof *handle || handle->magic != 0xfb)
		return -1;
	real = open_handle(fs->anchor, handle->type, handle->real,
			   mark->handle_bytes - (uint32_t)sizeof *handle);
	if (real < 0)
		return -1;
	n = readlink(fd_path(real).text, below, sizeof below - 1);
	close(real);
	below[n > 0 ? n : 0] = 0;
	for (const char *end = below; *end; end += 1 + strcspn(end + 1, "/")) {
		int fd;

		snprintf(path, sizeof path, "%s%s", fs->point, end);
		fd = open_in_root_of(init, path, O_NOFOLLOW);
		if (fd >= 0 && fstat(fd, &st) == 0 && st.st_ino == mark->ino)
			return fd;
		close_fd(&fd);
	}
	return -1;
}

static int open_marked(const struct file_system *fs, const struct file_mark *mark, pid_t init)
{
	if (fs->anchor < 0)
		return -1;
	if (fs->overlay)
		return open_overlaid(fs, mark, init);
	return open_handle(fs->anchor, mark->handle_type, mark->handle, mark->handle_bytes);
}

/* ---- what it is to have ----------------------------------------------------------- */

static const struct file_mark *find_mark(const struct file *f, const struct file_mark *mark)
{
	const uint32_t count = f ? f->mark_count : 0;
	const uint32_t at = LOWER_BOUND(count, i, f->mark[i].wd < mark->wd);
	const struct file_mark *m = at < count ? &f->mark[at] : NULL;

	return m && m->wd == mark->wd && m->dev == mark->dev && m->ino == mark->ino ? m : NULL;
}

/* More than the longest queue (fs.inotify.max_queued_events) holds. */
#define READS_MAX 1024

/* Reads events one by one, as long as they are without a name. */
static void take_events(int fd, int bytes)
{
	struct inotify_event event;
	int left;

	for (; bytes > 0; bytes -= (int)sizeof event)
		if (ioctl(fd, FIONREAD, &left) || left < (int)sizeof event ||
		    read(fd, &event, sizeof event) != sizeof event)
			return;
}

/* Removes those that were added since.  That causes an event, IN_IGNORED, which the app would not
 * understand; if the queue has no other events, it can be read here. */
static void remove_new(int fd, const struct file *want, const struct file *now)
{
	uint32_t kept = 0;
	int before = 0, removed = 0, reads = 0;
	char buf[65536];

	for (uint32_t i = 0; i < now->mark_count; i++)
		kept += find_mark(want, &now->mark[i]) != NULL;
	if (ioctl(fd, FIONREAD, &before))
		before = 0;
	for (uint32_t i = 0; i < now->mark_count; i++)
		if (!find_mark(want, &now->mark[i]) && inotify_rm_watch(fd, now->mark[i].wd) == 0)
			removed++;
	if (!before)
		take_events(fd, removed * (int)sizeof(struct inotify_event));
	/* No event in it is of a known watch, or was in it at the checkpoint. */
	while (before && !kept && !want->unread && ++reads < READS_MAX &&
	       ioctl(fd, FIONREAD, &before) == 0 && before && read(fd, buf, sizeof buf) > 0)
		;
}

/* Adds those that are missing, or have another mask. */
static uint32_t add_missing(int fd, const struct file *want, const struct file *now, pid_t init)
{
	struct file_system fs = { .anchor = -1 };
	uint32_t failed = 0;

	for (uint32_t i = 0; i < want->mark_count && budget_step(); i++) {
		const struct file_mark *mark = &want->mark[i], *is = find_mark(now, mark);
		int at, wd;

		if (is && is->mask == mark->mask)
			continue;
		if (fs.dev != mark->dev)
			open_file_system(&fs, init, mark->dev);
		at = open_marked(&fs, mark, init);
		if (at < 0 || (!is && ioctl(fd, SET_NEXT_WD, mark->wd))) {
			close_fd(&at);
			failed++;
			continue;
		}
		wd = inotify_add_watch(fd, fd_path(at).text, mark->mask);
		close(at);
		if (wd >= 0 && wd != mark->wd)
			inotify_rm_watch(fd, wd);
		failed += wd != mark->wd;
	}
	close_fd(&fs.anchor);
	return failed;
}

#define EVENTS_MAX (1 << 16) /* four times fs.inotify.max_queued_events               */
#define EVENTS_EACH 256

/* Two equal events in a row would be merged.  The kernel reports no events for files not opened by
 * a name.  Returns the bytes in the queue; true: it is full. */
static bool fill(int fd, int memory, int *bytes)
{
	const int file = open_again(memory, O_RDWR);
	int before = -1;
	char byte;

	while (file >= 0 && *bytes != before &&
	       *bytes < EVENTS_MAX * (int)sizeof(struct inotify_event)) {
		before = *bytes;
		for (int i = 0; i < EVENTS_EACH / 2; i++)
			if (pwrite(file, "", 1, 0) != 1 || pread(file, &byte, 1, 0) != 1)
				break;
		if (!budget_step() || ioctl(fd, FIONREAD, bytes))
			break;
	}
	if (file >= 0)
		close(file);
	return *bytes && *bytes == before;
}

/* Events cannot be requeued.  But one reports that some were lost (inotify(7), IN_Q_OVERFLOW), the
 * last that the kernel puts into a full queue: those before it are read and discarded. */
static const char *put_overflow(int fd)
{
	const int file = memfd_create("avckpt", MFD_CLOEXEC), event = sizeof(struct inotify_event);
	int wd, bytes = 0;
	bool full;
	char buf[EVENTS_EACH * sizeof(struct inotify_event)];

	wd = file < 0 ? -1 : inotify_add_watch(fd, fd_path(file).text, IN_MODIFY | IN_ACCESS);
	full = wd >= 0 && fill(fd, file, &bytes);
	/* There must be no room for the event caused by this. */
	if (wd >= 0)
		inotify_rm_watch(fd, wd);
	if (!full)
		bytes += 2 * event;
	while (bytes > event) {
		const size_t most = (size_t)(bytes - event);
		const ssize_t n = read(fd, buf, most < sizeof buf ? most : sizeof buf);

		if (n <= 0)
			break;
		bytes -= (int)n;
	}
	if (file >= 0)
		close(file);
	return full ? "events in it were lost, and it says so (IN_Q_OVERFLOW)"
		    : "events in it were lost";
}

static int highest(const struct file *f, int so_far)
{
	for (uint32_t i = 0; f && i < f->mark_count; i++)
		so_far = f->mark[i].wd > so_far ? f->mark[i].wd : so_far;
	return so_far;
}

const char *file_put_marks(int fd, const struct file *want, const struct file *now, pid_t init)
{
	const char *problem = NULL;
	uint32_t failed;
	int bytes = 0;

	if (now)
		remove_new(fd, want, now);
	failed = add_missing(fd, want, now, init);
	if (want->unread && !ioctl(fd, FIONREAD, &bytes) && !bytes)
		problem = put_overflow(fd);
	/* So that a number is not reused soon, as usual. */
	ioctl(fd, SET_NEXT_WD, highest(now, highest(want, 0)) + 1);
	return problem ? problem : failed ? "not all of what it watched is there any more" : NULL;
}
