/* SPDX-License-Identifier: Apache-2.0
 *
 * Reads one descriptor.
 *
 * While the app runs, it may close what we have a duplicate of, and would find it open still: its
 * address taken, its lock held, its events in an epoll set.  So the first look has none where the
 * second, or an earlier one, says as much.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/kcmp.h>
#include <linux/videodev2.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/sysmacros.h>
#include <sys/xattr.h>
#include <unistd.h>

#include "files_look.h"

/* A number that no other mount gets, since Linux 6.8. */
#define STATX_MNT_ID_UNIQUE_ 0x4000
#define OURS_MAX 1024 /* duplicates at a time                                          */

bool file_is_anonymous(const struct file *f)
{
	return !(f->mode & S_IFMT);
}

static enum file_kind kind_of(const struct file *f)
{
	static const struct {
		const char *name;
		enum file_kind kind;
	} kinds[] = {
		{ "anon_inode:[eventfd]", FILE_EVENTFD },
		{ "anon_inode:[timerfd]", FILE_TIMERFD },
		{ "anon_inode:[signalfd]", FILE_SIGNALFD },
		{ "anon_inode:[eventpoll]", FILE_EPOLL },
		{ "anon_inode:inotify", FILE_INOTIFY },
		{ "anon_inode:[inotify]", FILE_INOTIFY },
		{ "anon_inode:[pidfd]", FILE_PIDFD },
	};

	switch (f->mode & S_IFMT) {
	case S_IFREG:
		return strncmp(f->name, "anon_inode:", 11) ? FILE_REGULAR : FILE_OTHER;
	case S_IFDIR:
		return FILE_DIRECTORY;
	case S_IFCHR:
	case S_IFBLK:
		return FILE_DEVICE;
	case S_IFIFO:
		return strncmp(f->name, "pipe:", 5) ? FILE_FIFO : FILE_PIPE;
	case S_IFSOCK:
		return FILE_SOCKET;
	}
	for (size_t i = 0; i < sizeof kinds / sizeof *kinds; i++)
		if (!strcmp(f->name, kinds[i].name))
			return kinds[i].kind;
	return FILE_OTHER;
}

static char *read_name(const struct look *look, int fd)
{
	char number[16], name[4096];
	ssize_t n;

	snprintf(number, sizeof number, "%d", fd);
	n = readlinkat(look->fd_dir, number, name, sizeof name - 1);
	if (n < 0)
		return NULL;
	name[n] = 0;
	return budget_take((uint64_t)n) ? got_memory(strdup(name)) : NULL;
}

static bool learn_name(struct look *look, struct file *f)
{
	f->name = read_name(look, f->fd);
	if (!f->name)
		return false;
	f->kind = kind_of(f);
	if (!look->refuses)
		look->refuses = files_refuses(f->name);
	return true;
}

/* stdio shared with init: other processes use the same offset. */
static bool is_inits(const struct look *look, const struct file *f)
{
	for (int i = 0; i < 3; i++)
		if (look->init_stdio[i].ino && look->init_stdio[i].dev == f->dev &&
		    look->init_stdio[i].ino == f->ino &&
		    syscall(SYS_kcmp, look->pid, look->init, KCMP_FILE, f->fd, i) == 0)
			return true;
	return false;
}

static void look_at_owner(int fd, struct file *f)
{
	struct f_owner_ex owner = { 0 };

	if (f->flags & O_PATH || fcntl(fd, F_GETOWN_EX, &owner))
		return;
	f->owner_type = owner.type;
	f->owner = owner.pid;
	f->owner_signal = fcntl(fd, F_GETSIG);
}

struct file *look_take_known(const struct look *look, struct file *f)
{
	struct file *k = files_find(look->known, f->fd);

	if (!k || !k->name || k->dev != f->dev || k->ino != f->ino || k->rdev != f->rdev ||
	    k->mode != f->mode || (k->flags ^ f->flags) & (O_ACCMODE | O_PATH))
		return NULL;
	f->kind = k->kind;
	if (file_is_anonymous(f) && !f->inherited && !file_read_info(look->pid, f)) {
		char *name = read_name(look, f->fd);
		const bool same = name && !strcmp(name, k->name);

		free(name);
		if (!same) {
			const int fd = f->fd, flags = f->flags;

			free(f->watch);
			free(f->mark);
			*f = (struct file){ .fd = fd,
					    .shared = fd,
					    .offset = -1,
					    .dev = f->dev,
					    .ino = f->ino,
					    .rdev = f->rdev,
					    .mode = f->mode,
					    .flags = flags };
			return NULL;
		}
	}
	f->known = true;
	f->remote = k->remote;
	if (look->depth == FILES_NOW) {
		if (!file_is_anonymous(f))
			f->id = k->id;
		return k;
	}
	if (!file_is_anonymous(f))
		f->cloexec = k->cloexec;
	f->outside = k->outside;
	f->id = k->id;
	f->shared = k->shared;
	f->name = k->name;
	f->socket = file_socket_share(k->socket); /* the next first look needs it, too */
	f->lock = k->lock;
	f->lock_count = k->lock_count;
	k->name = NULL;
	k->lock = NULL;
	k->lock_count = 0;
	return k;
}

/* No request goes to a file server while the app is stopped, or dead: it may be the app itself
 * (FUSE), or not answer; closing a duplicate is such a request, too (flush). fdinfo has to
 * suffice. */
static bool look_at_remote(const struct look *look, int number, struct file *f)
{
	const struct file *k = look->known ? files_find(look->known, number) : NULL;

	if (!k || !k->remote || !k->name)
		return false;
	*f = (struct file){ .fd = number, .shared = number, .kind = FILE_REGULAR };
	file_read_info(look->pid, f);
	free(f->lock);
	if (f->told_ino != k->told_ino || (f->told_flags ^ k->told_flags) & (O_ACCMODE | O_PATH))
		return false;
	*f = (struct file){
		.fd = number,
		.shared = number,
		.dev = k->dev,
		.ino = k->ino,
		.rdev = k->rdev,
		.mode = k->mode,
		.flags = f->told_flags & ~O_CLOEXEC,
		.offset = f->told_offset,
		.bytes = k->bytes,
		.modified = k->modified,
		.changed = k->changed,
	};
	if (!look_take_known(look, f))
		return false;
	file_read_info(look->pid, f);
	return true;
}

bool file_is_channel(const struct file *f)
{
	return f->kind == FILE_PIPE || (f->kind == FILE_SOCKET && f->socket &&
					f->socket->domain == AF_UNIX && !f->socket->listening);
}

/* Neither idle nor connected: it was just being connected when it was read. */
static bool was_connecting(const struct file_socket *s)
{
	return !s->connected && !s->listening && s->type != SOCK_DGRAM && s->local_bytes &&
	       (s->domain == AF_UNIX || s->domain == AF_INET || s->domain == AF_INET6);
}

/* Only the freezes look at it. */
static bool is_connection(const struct file_socket *s)
{
	return (s->domain == AF_INET || s->domain == AF_INET6) && s->type == SOCK_STREAM &&
	       s->connected && !s->listening;
}

static bool has_ended(int fd)
{
	struct sockaddr_storage remote;
	socklen_t bytes = sizeof remote;

	return getpeername(fd, (struct sockaddr *)&remote, &bytes);
}

/* A change of an idle socket between the two reads must not be missed. */
static bool is_outdated(int fd, const struct file_socket *s)
{
	int listens = 0;
	socklen_t bytes = sizeof listens;

	if (is_connection(s))
		return has_ended(fd);
	return (s->idle || was_connecting(s)) &&
	       (file_socket_was_used(fd, s) ||
		(!getsockopt(fd, SOL_SOCKET, SO_ACCEPTCONN, &listens, &bytes) && listens));
}

static void note_stat(struct file *f, const struct statx *st)
{
	f->dev = makedev(st->stx_dev_major, st->stx_dev_minor);
	f->ino = st->stx_ino;
	f->rdev = makedev(st->stx_rdev_major, st->stx_rdev_minor);
	f->mode = st->stx_mode;
	f->bytes = (int64_t)st->stx_size;
	f->modified = (struct timespec){ st->stx_mtime.tv_sec, st->stx_mtime.tv_nsec };
	f->changed = (struct timespec){ st->stx_ctime.tv_sec, st->stx_ctime.tv_nsec };
}

/* TCP or UDP: reading it takes no look at a file system, for which the app may not be stopped.  Or it
 * has been closed since its name was read: the app may open the next one under its number before we
 * have a duplicate, and close that. */
static bool is_internet_or_closed(const struct look *look, int number)
{
	char path[48], protocol[32] = "";

	snprintf(path, sizeof path, "/proc/%d/fd/%d", look->pid, number);
	if (getxattr(path, "system.sockprotoname", protocol, sizeof protocol - 1) < 0)
		return errno == ENOENT || errno == EOPNOTSUPP || errno == ENODATA;
	return !strncmp(protocol, "TCP", 3) || !strncmp(protocol, "UDP", 3);
}

static bool takes_duplicate(struct look *look, struct file *f)
{
	const struct file *was = look->known ? files_find(look->known, f->fd) : NULL;
	struct file_socket *s = was && was->dev == f->dev && was->ino == f->ino ? was->socket
										: NULL;

	if (f->kind != FILE_SOCKET)
		return file_is_video(f);
	if (!s && look->later && is_internet_or_closed(look, f->fd)) {
		look->later--;
		return false;
	}
	if (!s || (s->domain != AF_UNIX && s->domain != AF_INET && s->domain != AF_INET6))
		return true;
	if (is_connection(s))
		f->socket = file_socket_share(s);
	return file_socket_has_options(s);
}

/* Without asking it, as statfs(2) would.  But one that is mounted elsewhere, from where it was
 * inherited or received, can be known only so. */
static bool is_remote(struct look *look, int fd, const struct file *f)
{
	const char *type = mount_type(&look->mounts, look->pid, fd);

	if (*type || file_is_memory(f))
		return mount_is_served(type);
	return look->depth != FILES_BEFORE || file_is_remote(fd);
}

static bool is_on_server(struct look *look, const char *number, const struct file *f)
{
	int fd = got_fd(openat(look->fd_dir, number, O_PATH | O_CLOEXEC));
	const bool is = fd >= 0 && is_remote(look, fd, f);

	close_fd(&fd);
	return is;
}

enum looked { LOOKED, LOOKED_TOO_LITTLE, LOOKED_CLOSED };

/* Opened since it was looked at while the app ran. */
static bool is_new_on_server(struct look *look, int number)
{
	const struct file *k = files_find(look->known, number);
	struct file f = { 0 };
	struct statx st;
	char name[16];

	snprintf(name, sizeof name, "%d", number);
	if (!look->known->served ||
	    statx(look->fd_dir, name, AT_STATX_DONT_SYNC | AT_NO_AUTOMOUNT, STATX_BASIC_STATS, &st))
		return false;
	note_stat(&f, &st);
	return (S_ISREG(f.mode) || S_ISDIR(f.mode)) &&
	       !(k && !k->remote && k->dev == f.dev && k->ino == f.ino) &&
	       is_on_server(look, name, &f);
}

/* The first look, without a duplicate. */
static enum looked look_at_running(struct look *look, int number, struct file *f)
{
	const int sync = look->depth == FILES_BEFORE ? AT_STATX_SYNC_AS_STAT : AT_STATX_DONT_SYNC;
	enum looked result = LOOKED;
	const struct file *was;
	char name[16];
	struct statx st;

	snprintf(name, sizeof name, "%d", number);
	*f = (struct file){ .fd = number, .shared = number, .offset = -1, .told_flags = -1 };
	if (statx(look->fd_dir, name, sync | AT_NO_AUTOMOUNT,
		  STATX_BASIC_STATS | STATX_MNT_ID_UNIQUE_, &st))
		return LOOKED_CLOSED;
	note_stat(f, &st);
	if (!learn_name(look, f))
		return LOOKED_CLOSED;
	file_read_info(look->pid, f);
	f->flags = f->told_flags & ~O_CLOEXEC;
	f->offset = look->depth == FILES_BEFORE ? -1 : f->told_offset;
	if (f->told_flags < 0)
		result = LOOKED_CLOSED;
	else if (takes_duplicate(look, f))
		result = LOOKED_TOO_LITTLE;
	if (result != LOOKED) {
		free(f->name);
		free(f->lock);
		free(f->watch);
		free(f->mark);
		file_socket_free(f->socket);
		return result;
	}
	f->outside = is_inits(look, f);
	if ((f->kind == FILE_REGULAR || f->kind == FILE_DIRECTORY) && !(f->flags & O_PATH)) {
		f->mount = st.stx_mask & STATX_MNT_ID_UNIQUE_ ? st.stx_mnt_id : 0;
		was = look->known && f->mount ? files_find(look->known, number) : NULL;
		f->remote = was && was->mount == f->mount ? was->remote
							  : is_on_server(look, name, f);
	}
	return LOOKED;
}

static int make_room_for_one(const struct look *look, struct avc_error *err)
{
	struct files *files = look->files;
	struct file *more;

	if (files->count < files->room)
		return 0;
	if (look->depth == FILES_FROZEN)
		return fail(err, AVC_DEADLINE, 0, look->pid, "freeze", "",
			    "more descriptors than prepared for");
	more = realloc(files->file, 2 * files->room * sizeof *more);
	if (!more)
		return fail_memory(err, look->pid, "look at descriptors");
	memset(more + files->room, 0, files->room * sizeof *more);
	files->file = more;
	files->room *= 2;
	return 0;
}

/* Everything that does not change.  False: it has been closed. */
static bool read_in_full(struct look *look, int fd, struct file *f)
{
	if (!learn_name(look, f))
		return false;
	f->outside = is_inits(look, f);
	if (f->kind == FILE_SOCKET)
		file_look_at_socket(fd, f);
	/* What was opened since is not recreated. */
	if (f->socket && look->depth != FILES_NOW)
		file_look_at_options(fd, f->socket, look->init);
	return true;
}

static void read_socket_again(const struct look *look, int fd, struct file *f, struct file *known)
{
	f->known = !f->socket; /* for its heirs (look_at_inherited())         */
	file_look_at_socket(fd, f);
	if (f->socket)
		file_look_at_options(fd, f->socket, look->init);
	file_socket_free(known->socket);
	known->socket = file_socket_share(f->socket);
}

/* What a read, a write or a lock changes. */
static void read_place(struct look *look, int fd, struct file *f, const struct file *known)
{
	const bool in_files = (f->kind == FILE_REGULAR || f->kind == FILE_DIRECTORY) &&
			      !(f->flags & O_PATH);
	const uint32_t locks = known ? known->lock_count + f->lock_count : 0;
	int unread;

	if (!known && in_files)
		f->remote = is_remote(look, fd, f);
	if (!known ||
	    (f->kind == FILE_REGULAR && in_files && (locks || f->remote || file_is_locked(fd))))
		file_read_info(look->pid, f);
	if (in_files)
		f->offset = lseek(fd, 0, SEEK_CUR);
	f->unread = f->kind == FILE_INOTIFY && !ioctl(fd, FIONREAD, &unread) && unread;
}

static void read_traffic(const struct look *look, int fd, struct file *f, const struct file *known)
{
	const bool is_now = look->depth == FILES_NOW;
	const struct file_socket *socket = known && is_now ? known->socket : f->socket;

	if (is_now && socket && socket->peer)
		f->shut = file_shut(fd);
	if (f->kind == FILE_SOCKET && (is_now || look->files->with_tcp))
		file_look_at_tcp(fd, f, socket);
}

static void part_with(const struct look *look, int fd, struct file *f)
{
	if (look->depth == FILES_FROZEN && file_is_channel(f) && *look->files->ours < OURS_MAX) {
		f->ours = fd; /* until files_keep_contents() */
		++*look->files->ours;
	} else if (f->remote) {
		file_close_later(fd);
	} else {
		close(fd);
	}
}

static int look_at_duplicate(struct look *look, int number, struct file *f, struct avc_error *err)
{
	const int sync = look->depth == FILES_FROZEN ? AT_STATX_DONT_SYNC : AT_STATX_SYNC_AS_STAT;
	struct file *known;
	struct statx st;
	bool silent;
	int fd;

	fd = proc_borrow_fd(look->pidfd, number);
	if (fd < 0 && errno == EBADF)
		return 0; /* closed meanwhile */
	if (fd < 0)
		return fail_errno(err, look->pid, "look at descriptors", "pidfd_getfd",
				  "descriptor %d", number);
	*f = (struct file){ .fd = number, .shared = number, .offset = -1 };
	if (statx(fd, "", AT_EMPTY_PATH | sync, STATX_BASIC_STATS, &st)) {
		close(fd);
		return 0;
	}
	note_stat(f, &st);
	f->flags = fcntl(fd, F_GETFL);
	known = look->depth == FILES_BEFORE ? NULL : look_take_known(look, f);
	if (!known && !read_in_full(look, fd, f)) {
		close(fd);
		return 0;
	}
	if (!known || look->depth == FILES_FROZEN)
		look_at_owner(fd, f);
	if (look->depth == FILES_FROZEN && known && f->kind == FILE_SOCKET &&
	    (!f->socket || is_outdated(fd, f->socket)))
		read_socket_again(look, fd, f, known);
	read_place(look, fd, f, known);
	read_traffic(look, fd, f, known);
	silent = look->depth != FILES_NOW && file_is_video(f) && file_look_at_video(fd, &f->video);
	part_with(look, fd, f);
	look->files->count++;
	if (silent)
		return fail(err, AVC_DEADLINE, 0, look->pid, "look at descriptors", "ioctl",
			    "%s does not answer", f->name);
	if (f->video.memory == V4L2_MEMORY_USERPTR)
		return fail(err, AVC_UNSUPPORTED, 0, look->pid, "look at descriptors", "",
			    "%s fills memory of the program's own (V4L2_MEMORY_USERPTR)", f->name);
	return 0;
}

int look_at_descriptor(struct look *look, int number, struct avc_error *err)
{
	struct files *files = look->files;
	struct file *f;

	if (aside_is_left_behind())
		return -1;
	if (!budget_step() || !budget_take(sizeof *f))
		return budget_check(look->pid, err);
	if (make_room_for_one(look, err))
		return -1;
	f = &files->file[files->count];
	if ((look->depth != FILES_BEFORE && look_at_remote(look, number, f)) ||
	    look_at_inherited(look, number, f)) {
		files->count++;
		return 0;
	}
	if (look->depth == FILES_BEFORE || (look->known && is_new_on_server(look, number))) {
		const enum looked looked = look_at_running(look, number, f);

		files->count += looked == LOOKED;
		if (looked != LOOKED_TOO_LITTLE)
			return 0;
	}
	return look_at_duplicate(look, number, f, err);
}
