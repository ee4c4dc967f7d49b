/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt.files=strict, and auto beside a database, for files that are opened, written and closed
 * between two looks at the table, also by a child or by a program that was executed since:
 * fanotify(7) reports everything written in the container's mount namespace.
 *
 * The kernel queues an event within the write(2) that causes it, so after a death the queue has all
 * of them.  No process waits for us, and the queue vanishes with our process.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/openat2.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/fanotify.h>
#include <sys/stat.h>
#include <unistd.h>

#include "files.h"

struct files_written {
	int fd;          /* -1: it cannot be watched                            */
	int errnum;      /* why                                                  */
	uint64_t mounts; /* a hash of what was marked                            */
};

struct files_written *files_written_new(void)
{
	struct files_written *written = calloc(1, sizeof *written);

	if (!written)
		return NULL;
	/* Events come with an open file: a fifo must not block us. */
	written->fd = fanotify_init(FAN_CLASS_NOTIF | FAN_CLOEXEC | FAN_NONBLOCK,
				    O_RDONLY | O_CLOEXEC | O_LARGEFILE | O_NONBLOCK);
	written->errnum = written->fd < 0 ? errno : 0;
	return written;
}

void files_written_free(struct files_written *written)
{
	if (written)
		close_fd(&written->fd);
	free(written);
}

static bool is_one_of(const char *text, const char *const *words)
{
	for (; *words; words++)
		if (!strcmp(text, *words))
			return true;
	return false;
}

static bool is_at_or_below(const char *point, const char *place)
{
	const size_t length = strlen(place);

	return !strncmp(point, place, length) && (!point[length] || point[length] == '/');
}

/* Without data, or where opening a file has side effects (devices) or may wait for a server. */
static bool is_worth_it(const char *point, const char *options, const char *type)
{
	static const char *const types[] = { "proc",     "sysfs",  "cgroup",  "cgroup2",
					     "devpts",   "mqueue", "tracefs", "debugfs",
					     "devtmpfs", "bpf",    NULL };

	return strncmp(options, "ro", 2) && !is_at_or_below(point, "/dev") &&
	       !is_at_or_below(point, "/proc") && !is_at_or_below(point, "/sys") &&
	       !is_one_of(type, types) && !mount_is_served(type);
}

#define TRIES 3 /* a rename elsewhere may come in between */

/* The way to a mount point is in the kernel's memory: no file server on it is asked. */
static int open_point(int root, const char *point)
{
	int fd = -1;

	for (int i = 0; i < TRIES && fd < 0 && (!i || errno == EAGAIN); i++)
		fd = open_below(root, point, 0, RESOLVE_CACHED);
	return fd;
}

/* By its name the app may have put something else there, or a mount over it: then no path leads to
 * it. */
static int mark(struct files_written *written, int root, char *line)
{
	struct proc_mount mount;
	int point, result = 0;

	if (!proc_parse_mount(line, &mount) || !is_worth_it(mount.point, mount.options, mount.type))
		return 0;
	point = open_point(root, mount.point);
	if (point < 0 || (mount_of(point) == mount.id &&
			  fanotify_mark(written->fd, FAN_MARK_ADD | FAN_MARK_MOUNT, FAN_MODIFY,
					AT_FDCWD, fd_path(point).text)))
		result = errno == ENOENT || errno == EACCES ? 0 : errno;
	close_fd(&point);
	return result;
}

/* 0, or why not all of them. */
static int mark_all(struct files_written *written, pid_t pid, FILE *info)
{
	int root = proc_open(pid, "root", O_PATH | O_DIRECTORY), result = root < 0 ? errno : 0;
	char *line = NULL;
	size_t size = 0;

	while (root >= 0 && getline(&line, &size, info) > 0) {
		const int failed = mark(written, root, line);

		result = result ? result : failed;
	}
	free(line);
	close_fd(&root);
	return result;
}

static bool is_our_mount_namespace(pid_t pid)
{
	struct stat ours, theirs;
	char path[64];

	snprintf(path, sizeof path, "/proc/%d/ns/mnt", pid);
	return stat("/proc/self/ns/mnt", &ours) || stat(path, &theirs) ||
	       (ours.st_ino == theirs.st_ino && ours.st_dev == theirs.st_dev);
}

void files_written_watch(struct files_written *written, pid_t pid, struct avc_error *notice)
{
	char *line = NULL, path[64];
	size_t size = 0;
	uint64_t mounts = 1;
	FILE *info;

	if (written->fd < 0)
		goto tell;
	snprintf(path, sizeof path, "/proc/%d/mountinfo", pid);
	info = fopen(path, "re");
	if (!info)
		return; /* it has ended */
	while (getline(&line, &size, info) > 0)
		mounts = hash_bytes(mounts, line, strlen(line));
	/* New mounts are marked before the next checkpoint. */
	if (mounts != written->mounts) {
		rewind(info);
		written->errnum = is_our_mount_namespace(pid) ? ENOTSUP
							      : mark_all(written, pid, info);
		/* Tried again if it was a matter of time. */
		written->mounts = written->errnum == EAGAIN ? 0 : mounts;
	}
	free(line);
	fclose(info);
tell:
	if (written->errnum && !notice->code)
		fail(notice, AVC_KERNEL, written->errnum, pid, "watch files", "fanotify_mark",
		     "avckpt.files=strict does not see files that are written and closed "
		     "between checkpoints");
}

/* stdin, stdout and stderr are often a log that others share. */
static bool is_inherited(const struct files *files, const struct stat *st)
{
	for (uint32_t i = 0; files && i < files->count; i++)
		if (files->file[i].outside && files->file[i].ino == st->st_ino &&
		    files->file[i].dev == st->st_dev)
			return true;
	return false;
}

static bool is_written_data(int fd, const struct files *files, files_counts *counts,
			    const void *arg, char name[FILES_NAME])
{
	struct stat st;
	ssize_t n;

	if (fstat(fd, &st) || !S_ISREG(st.st_mode) || is_inherited(files, &st) ||
	    (counts && !counts(fd, &st, arg)))
		return false;
	n = readlink(fd_path(fd).text, name, FILES_NAME - 1);
	name[n < 0 ? 0 : n] = 0;
	return true;
}

bool files_written_since(struct files_written *written, const struct files *files,
			 files_counts *counts, const void *arg, char name[FILES_NAME])
{
	_Alignas(struct fanotify_event_metadata) char buf[4096];
	bool found = false;

	if (written->fd < 0)
		return false;
	for (;;) {
		const ssize_t n = read(written->fd, buf, sizeof buf);
		const struct fanotify_event_metadata *m = (void *)buf;
		ssize_t left = n;

		if (n < 0 && errno == EINTR)
			continue;
		if (n <= 0) {
			/* A file that cannot be opened for us any more was written, too. */
			if (n < 0 && errno != EAGAIN && !found) {
				found = true;
				snprintf(name, FILES_NAME, "a file");
			}
			if (n < 0 && errno != EAGAIN && errno != EMFILE && errno != ENFILE)
				continue;
			return found;
		}
		for (; FAN_EVENT_OK(m, left); m = FAN_EVENT_NEXT(m, left)) {
			int fd = m->fd;

			if (m->mask & FAN_Q_OVERFLOW && !found) {
				found = true;
				snprintf(name, FILES_NAME, "a file");
			}
			if (fd >= 0 && !found)
				found = is_written_data(fd, files, counts, arg, name);
			close_fd(&fd);
		}
	}
}
