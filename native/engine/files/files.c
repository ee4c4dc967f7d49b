/* SPDX-License-Identifier: Apache-2.0
 *
 * Reads a table of descriptors (files.h).
 *
 * A checkpoint reads it twice: before the freeze everything, names included, while the app runs;
 * and during the freeze the state of that instant, while the kernel clones.  A descriptor that has
 * been replaced in between is read in full again.
 *
 * While the app runs, it may close what we have a duplicate of, and would find it open still: its
 * address taken, its lock held, its events in an epoll set.  So the first look has none where the
 * second, or an earlier one, says as much.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/kcmp.h>
#include <linux/major.h>
#include <linux/videodev2.h>
#include <poll.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/sysmacros.h>
#include <sys/xattr.h>
#include <unistd.h>

#include "files.h"

/* A number that no other mount gets, since Linux 6.8. */
#define STATX_MNT_ID_UNIQUE_ 0x4000
#define FUSE_MINOR 229 /* include/linux/miscdevice.h                                   */
#define ROOM_SPARE 64
#define OURS_MAX 1024 /* duplicates at a time                                          */
#define READ_TOGETHER 128
/* So many new sockets of a process are read in the freeze, where each makes it longer by 2 us, or by
 * some 20 if it could be recreated. */
#define SOCKETS_LATER 128

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

struct look {
	struct files *files, *known;
	pid_t pid, init;
	int pidfd, fd_dir;
	enum files_depth depth;
	bool trusts; /* heirs are assumed unchanged: files_check_heirs() */
	bool reuses; /* the same before a freeze */
	const uint8_t *likely;
	int likely_count; /* of files_survey(): by number, which are the parent's */
	uint32_t later;   /* how many new sockets may still be left to the freeze */
	const char *refuses;
	struct {
		uint64_t dev, ino; /* 0: unknown */
	} init_stdio[3];
	struct mounts mounts;
};

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

/* Takes a reference; the last holder frees it, which may be a thread that was left behind
 * (aside.c). */
static struct files *files_share(struct files *files)
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
	}
	files_free(files->heirs);
	free(files->varied);
	free(files->own);
	free(files->ends);
	free(files->file);
	free(files->area);
	free(files);
}

/* Among the first `count`, which are in order. */
static struct file *find_among(const struct files *files, uint32_t count, int fd)
{
	uint32_t at = (uint32_t)fd;

	/* Most tables have no gaps, and a freeze may look up tens of thousands. */
	if (at >= count || files->file[at].fd != fd)
		at = LOWER_BOUND(count, i, files->file[i].fd < fd);
	return at < count && files->file[at].fd == fd ? &files->file[at] : NULL;
}

struct file *files_find(const struct files *files, int fd)
{
	return find_among(files, files ? files->count : 0, fd);
}

/* The same file, socket, pipe...; of anonymous inodes only eventfds have an id. */
bool files_same_object(const struct file *a, const struct file *b)
{
	return a->kind == b->kind && a->dev == b->dev && a->ino == b->ino && a->rdev == b->rdev &&
	       a->id == b->id && !((a->flags ^ b->flags) & (O_ACCMODE | O_PATH));
}

static bool is_anonymous(const struct file *f)
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
	return budget_take((uint64_t)n) ? strdup(name) : NULL;
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

/* Takes over what was read before the freeze, if this is still the same. */
static struct file *take_known(const struct look *look, struct file *f)
{
	struct file *k = files_find(look->known, f->fd);

	if (!k || !k->name || k->dev != f->dev || k->ino != f->ino || k->rdev != f->rdev ||
	    k->mode != f->mode || (k->flags ^ f->flags) & (O_ACCMODE | O_PATH))
		return NULL;
	f->kind = k->kind;
	if (is_anonymous(f) && !f->inherited && !file_read_info(look->pid, f)) {
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
		if (!is_anonymous(f))
			f->id = k->id;
		return k;
	}
	if (!is_anonymous(f))
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
	if (!take_known(look, f))
		return false;
	file_read_info(look->pid, f);
	return true;
}

/* A child shares most descriptors with its parent: then only what belongs to the table itself is
 * left to read. */
static bool is_parents(const struct look *look, const struct file *is)
{
	return syscall(SYS_kcmp, look->pid, look->files->parent_pid, KCMP_FILE, is->fd, is->fd) ==
	       0;
}

/* Everything but what has an owner. */
static void copy_of(struct file *f, const struct file *is)
{
	*f = *is;
	f->name = NULL;
	f->socket = NULL;
	f->watch = NULL;
	f->mark = NULL;
	f->lock = NULL;
	f->content = NULL;
	f->watch_count = f->mark_count = f->lock_count = f->content_bytes = 0;
	f->ours = 0;
	f->shared = is->fd;
	f->family = NULL;
	f->inherited = is;
}

/* Only files have locks, each process its own. */
static bool has_no_lock(const struct look *look, const struct file *is)
{
	struct file own = { .fd = is->fd, .kind = is->kind, .told_flags = -1 };

	if (is->kind != FILE_REGULAR)
		return true;
	(void)file_read_info(look->pid, &own);
	free(own.lock);
	return own.told_flags >= 0 && !own.lock_count;
}

static bool is_unchanged(const struct file *k, const struct file *is)
{
	return files_same_object(k, is) && k->mode == is->mode;
}

/* It was its parent's before, which still has such a file there.  The checkpoint finds out whether it
 * is the same one, in any case.  But locks are asked for again. */
static bool was_parents(const struct look *look, const struct file *is)
{
	const struct file *k = look->reuses ? files_find(look->known, is->fd) : NULL;

	if (!look->known && is->fd < look->likely_count)
		return look->likely[is->fd] && is->kind != FILE_REGULAR;
	return k && k->heir && is->kind != FILE_REGULAR && is_unchanged(k, is);
}

static bool copy_before(const struct look *look, const struct file *is, struct file *f)
{
	size_t bytes;
	char *name;

	if (is_anonymous(is) || is->lock_count || !is->name)
		return false;
	if (was_parents(look, is))
		look->files->reused = true;
	else if (!is_parents(look, is) || !has_no_lock(look, is))
		return false;
	bytes = strlen(is->name) + 1;
	name = budget_take(bytes) ? malloc(bytes) : NULL;
	if (!name)
		return false;
	copy_of(f, is);
	f->name = memcpy(name, is->name, bytes);
	f->socket = is->socket;
	if (f->socket)
		file_socket_share(f->socket);
	return true;
}

/* For locks and watches there is more to read. */
static bool may_copy(const struct file *k, const struct file *is)
{
	return k && is && is->known && !k->remote && !k->lock_count && !is->lock_count &&
	       !is->watch_count && !is->mark_count && files_same_object(k, is) &&
	       !(is->kind == FILE_REGULAR && is->told_ino);
}

static bool take_over(const struct look *look, const struct file *is, struct file *f)
{
	copy_of(f, is);
	if (!take_known(look, f))
		return false;
	if (!f->socket) /* it was left to its parent's look */
		f->socket = file_socket_share(is->socket);
	return true;
}

static bool copy_frozen(const struct look *look, const struct file *is, struct file *f)
{
	const struct file *k = files_find(look->known, is->fd);

	return may_copy(k, is) && ((look->trusts && k->heir) || is_parents(look, is)) &&
	       take_over(look, is, f);
}

/* What belongs to the table matters as little as in a freeze; and a table of its own is rebuilt. */
static bool copy_now(const struct look *look, const struct file *is, struct file *f)
{
	if (!copy_frozen(look, is, f))
		return false;
	f->inherited = NULL;
	return true;
}

/* In a freeze an ancestor may have it, from whom the parent has it. */
static const struct file *find_parents(const struct files *files, int number)
{
	const struct file *is, *k;

	for (files = files->parent; files; files = files->parent) {
		is = files_find(files, number);
		k = is ? NULL : files_find(files->heirs, number);
		if (is || !k || !k->heir)
			return is;
	}
	return NULL;
}

static bool look_at_inherited(const struct look *look, int number, struct file *f)
{
	const struct file *is = find_parents(look->files, number);

	if (!is || is->remote)
		return false;
	switch (look->depth) {
	case FILES_BEFORE:
		return copy_before(look, is, f);
	case FILES_FROZEN:
		return copy_frozen(look, is, f);
	default:
		return copy_now(look, is, f);
	}
}

static bool is_channel(const struct file *f)
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

/* TCP or UDP: reading it takes no look at a file system, for which the app may not be stopped. */
static bool is_internet(const struct look *look, int number)
{
	char path[48], protocol[32] = "";

	snprintf(path, sizeof path, "/proc/%d/fd/%d", look->pid, number);
	return getxattr(path, "system.sockprotoname", protocol, sizeof protocol - 1) > 0 &&
	       (!strncmp(protocol, "TCP", 3) || !strncmp(protocol, "UDP", 3));
}

static bool takes_duplicate(struct look *look, struct file *f)
{
	const struct file *was = look->known ? files_find(look->known, f->fd) : NULL;
	struct file_socket *s = was && was->dev == f->dev && was->ino == f->ino ? was->socket
										: NULL;

	if (f->kind != FILE_SOCKET)
		return file_is_video(f);
	if (!s && look->later && is_internet(look, f->fd)) {
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
	int fd = openat(look->fd_dir, number, O_PATH | O_CLOEXEC);
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

static int look_at(struct look *look, int number, struct avc_error *err)
{
	struct files *files = look->files;
	const int sync = look->depth == FILES_FROZEN ? AT_STATX_DONT_SYNC : AT_STATX_SYNC_AS_STAT;
	struct statx st;
	struct file *f, *known;
	const struct file_socket *socket;
	uint32_t locks;
	bool silent;
	int fd, unread;

	if (aside_is_left_behind())
		return -1;
	if (!budget_step() || !budget_take(sizeof *f))
		return budget_check(look->pid, err);
	if (files->count == files->room) {
		if (look->depth != FILES_FROZEN) {
			struct file *more = realloc(files->file, 2 * files->room * sizeof *more);

			if (!more)
				return fail_errno(err, look->pid, "look at descriptors", "realloc",
						  "out of memory");
			memset(more + files->room, 0, files->room * sizeof *more);
			files->file = more;
			files->room *= 2;
		} else {
			return fail(err, AVC_DEADLINE, 0, look->pid, "freeze", "",
				    "more descriptors than prepared for");
		}
	}
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
	fd = proc_borrow_fd(look->pidfd, number);
	if (fd < 0) {
		if (errno == EBADF)
			return 0; /* closed meanwhile */
		return fail_errno(err, look->pid, "look at descriptors", "pidfd_getfd",
				  "descriptor %d", number);
	}
	*f = (struct file){ .fd = number, .shared = number, .offset = -1 };
	if (statx(fd, "", AT_EMPTY_PATH | sync, STATX_BASIC_STATS, &st)) {
		close(fd);
		return 0;
	}
	note_stat(f, &st);
	f->flags = fcntl(fd, F_GETFL);
	known = look->depth == FILES_BEFORE ? NULL : take_known(look, f);
	if (!known) {
		if (!learn_name(look, f)) {
			close(fd);
			return 0;
		}
		f->outside = is_inits(look, f);
		if (f->kind == FILE_SOCKET)
			file_look_at_socket(fd, f);
		/* What was opened since is not recreated. */
		if (f->socket && look->depth != FILES_NOW)
			file_look_at_options(fd, f->socket, look->init);
	}
	if (!known || look->depth == FILES_FROZEN)
		look_at_owner(fd, f);
	if (look->depth == FILES_FROZEN && known && f->kind == FILE_SOCKET &&
	    (!f->socket || is_outdated(fd, f->socket))) {
		f->known = !f->socket; /* for its heirs (look_at_inherited())         */
		file_look_at_socket(fd, f);
		if (f->socket)
			file_look_at_options(fd, f->socket, look->init);
		file_socket_free(known->socket);
		known->socket = file_socket_share(f->socket);
	}
	if (!known && (f->kind == FILE_REGULAR || f->kind == FILE_DIRECTORY) &&
	    !(f->flags & O_PATH))
		f->remote = is_remote(look, fd, f);
	locks = known ? known->lock_count + f->lock_count : 0;
	if (!known || (f->kind == FILE_REGULAR && !(f->flags & O_PATH) &&
		       (locks || f->remote || file_is_locked(fd))))
		file_read_info(look->pid, f);
	if ((f->kind == FILE_REGULAR || f->kind == FILE_DIRECTORY) && !(f->flags & O_PATH))
		f->offset = lseek(fd, 0, SEEK_CUR);
	f->unread = f->kind == FILE_INOTIFY && !ioctl(fd, FIONREAD, &unread) && unread;
	socket = known && look->depth == FILES_NOW ? known->socket : f->socket;
	if (look->depth == FILES_NOW && socket && socket->peer)
		f->shut = file_shut(fd);
	if (f->kind == FILE_SOCKET && (look->depth == FILES_NOW || look->files->with_tcp))
		file_look_at_tcp(fd, f, socket);
	silent = look->depth != FILES_NOW && file_is_video(f) && file_look_at_video(fd, &f->video);
	if (look->depth == FILES_FROZEN && is_channel(f) && *files->ours < OURS_MAX) {
		f->ours = fd; /* until keep_contents() */
		++*files->ours;
	} else if (f->remote) {
		file_close_later(fd);
	} else {
		close(fd);
	}
	files->count++;
	if (silent)
		return fail(err, AVC_DEADLINE, 0, look->pid, "look at descriptors", "ioctl",
			    "%s does not answer", f->name);
	if (f->video.memory == V4L2_MEMORY_USERPTR)
		return fail(err, AVC_UNSUPPORTED, 0, look->pid, "look at descriptors", "",
			    "%s fills memory of the program's own (V4L2_MEMORY_USERPTR)", f->name);
	return 0;
}

int files_find_device(const struct files *files, uint32_t rdev)
{
	for (uint32_t i = 0; files && i < files->count; i++)
		if (files->file[i].kind == FILE_DEVICE && files->file[i].rdev == rdev &&
		    !(files->file[i].flags & O_PATH))
			return files->file[i].fd;
	return -1;
}

static int by_fd(const void *a, const void *b)
{
	return ((const struct file *)a)->fd - ((const struct file *)b)->fd;
}

static int compare_keys(const struct file *a, const struct file *b)
{
	if (a->dev != b->dev)
		return a->dev < b->dev ? -1 : 1;
	if (a->ino != b->ino)
		return a->ino < b->ino ? -1 : 1;
	if (a->kind != b->kind)
		return a->kind < b->kind ? -1 : 1;
	if (a->id != b->id)
		return a->id < b->id ? -1 : 1;
	return 0;
}

static int by_key(const void *a, const void *b)
{
	const struct files_held *x = a, *y = b;
	const int order = compare_keys(x->file, y->file);

	return order ? order : (x->number > y->number) - (x->number < y->number);
}

/* kcmp(2)'s order; -1: one of them has been closed since. */
static long compare_held(const struct files_held *a, const struct files_held *b)
{
	/* A socket cannot be opened twice, but its file (O_PATH) can. */
	if (a->file->kind == FILE_SOCKET && !((a->file->flags | b->file->flags) & O_PATH))
		return 0;
	return syscall(SYS_kcmp, a->pid, b->pid, KCMP_FILE, a->file->fd, b->file->fd);
}

bool files_is_closed(const struct files_held *held)
{
	return syscall(SYS_kcmp, held->pid, held->pid, KCMP_FILE, held->file->fd, held->file->fd);
}

/* Among `kinds`, which are in order, of what `held` is: its index, or -1 with *at where it
 * would be.  Those that have been closed since have no place in the order, and are taken out. */
static int find_kind(struct files_held **kinds, uint32_t *count, const struct files_held *held,
		     uint32_t *at)
{
	uint32_t low = 0, high = *count;

	while (low < high) {
		const uint32_t middle = (low + high) / 2;
		const long order = compare_held(held, kinds[middle]);

		if (order == 0)
			return (int)middle;
		if (order < 0 && files_is_closed(held)) {
			*at = *count;
			return -1;
		}
		if (order < 0) {
			memmove(&kinds[middle], &kinds[middle + 1],
				(*count - middle - 1) * sizeof *kinds);
			--*count;
			high--;
		} else if (order == 1) {
			high = middle;
		} else {
			low = middle + 1;
		}
	}
	*at = low;
	return -1;
}

/* Only descriptors of the same file can share a description, and kcmp(2) gives an order, so that
 * few calls are needed. */
void files_group(struct files_held *held, uint32_t count)
{
	struct files_held **kinds = calloc(count + 1, sizeof *kinds);

	for (uint32_t i = 0; i < count; i++) {
		held[i].number = i;
		held[i].first = held[i].file;
	}
	if (!kinds)
		return;
	qsort(held, count, sizeof *held, by_key);
	for (uint32_t i = 0, kind_count = 0; i < count; i++) {
		uint32_t at = 0;
		int found;

		aside_step();
		if (i && compare_keys(held[i].file, held[i - 1].file))
			kind_count = 0;
		found = find_kind(kinds, &kind_count, &held[i], &at);
		if (found >= 0) {
			held[i].first = kinds[found]->file;
			continue;
		}
		memmove(&kinds[at + 1], &kinds[at], (kind_count - at) * sizeof *kinds);
		kinds[at] = &held[i];
		kind_count++;
	}
	free(kinds);
}

/* Which descriptors are of the same open file description. */
static void find_shared(struct files *files, pid_t pid)
{
	struct files_held *held = calloc(files->count + 1, sizeof *held);

	if (!held)
		return;
	for (uint32_t i = 0; i < files->count; i++)
		held[i] = (struct files_held){ .file = &files->file[i], .pid = pid };
	files_group(held, files->count);
	for (uint32_t i = 0; i < files->count; i++)
		held[i].file->shared = held[i].first->fd;
	free(held);
}

static bool is_shared_by_parent(const struct files *files, const struct file *f)
{
	const struct file *first = files_find(files, f->shared);

	return f->inherited && f->inherited->shared == f->shared && first && first->inherited;
}

/* The same during a freeze: what was found before it is only checked. */
static void check_shared(struct files *files, pid_t pid)
{
	for (uint32_t i = 0; i < files->count; i++) {
		struct file *f = &files->file[i];

		if (f->known && (f->shared == f->fd || is_shared_by_parent(files, f) ||
				 syscall(SYS_kcmp, pid, pid, KCMP_FILE, f->fd, f->shared) == 0))
			continue;
		f->shared = f->fd;
		for (uint32_t j = 0; j < files->count; j++) {
			const struct file *g = &files->file[j];

			if (g->fd != f->fd && g->shared == g->fd && !compare_keys(f, g) &&
			    syscall(SYS_kcmp, pid, pid, KCMP_FILE, f->fd, g->fd) == 0) {
				f->shared = g->fd;
				break;
			}
		}
	}
}

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

/* Once for each object, from an end that can be read. */
static bool may_have_content(const struct file *f)
{
	return !(f->kind == FILE_PIPE && (f->flags & O_ACCMODE) == O_WRONLY) &&
	       f->shared == f->fd && !f->outside && is_channel(f);
}

/* What its parent's look has found in it. */
static void copy_content(const struct files *parent, struct file *f)
{
	const struct file *from = files_find(parent, f->inherited->shared);

	f->ended = from->ended;
	f->content_lost = from->content_lost;
	f->rights_lost = from->rights_lost;
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
	if (f->inherited || !may_have_content(f))
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

static void drop_ours(struct file *f)
{
	if (f->ours > 0)
		close(f->ours);
	f->ours = 0;
}

static void keep_contents(const struct image *image, struct scratch *scratch)
{
	struct reading reading = { .image = image, .scratch = scratch };

	while (reading.begun < image->files->count) {
		struct file *f = &image->files->file[reading.begun++];

		if (budget_step())
			keep_content(&reading, f);
	}
	keep_gathered(&reading);
}

struct linux_dirent64 {
	uint64_t d_ino;
	int64_t d_off;
	unsigned short d_reclen;
	unsigned char d_type;
	char d_name[];
};

static int by_object(const void *a, const void *b)
{
	const struct file *x = *(const struct file *const *)a, *y = *(const struct file *const *)b;

	if (x->dev != y->dev)
		return x->dev < y->dev ? -1 : 1;
	return (x->ino > y->ino) - (x->ino < y->ino);
}

void files_missing_sort(struct files_missing *missing)
{
	if (missing->count)
		qsort(missing->file, missing->count, sizeof(void *), by_object);
}

/* A program may have opened thousands since, which only have to be closed. */
static bool is_of_interest(const struct look *look, const char *name)
{
	const struct files_missing *missing = look->files->missing;
	struct file key = { 0 };
	const struct file *wanted = &key;
	struct statx st;

	if (!missing || files_find(look->known, atoi(name)))
		return true;
	if (!missing->count || statx(look->fd_dir, name, AT_STATX_DONT_SYNC | AT_NO_AUTOMOUNT,
				     STATX_TYPE | STATX_INO, &st))
		return false;
	key.dev = makedev(st.stx_dev_major, st.stx_dev_minor);
	key.ino = st.stx_ino;
	return (missing->port && S_ISSOCK(st.stx_mode)) ||
	       bsearch(&wanted, missing->file, missing->count, sizeof wanted, by_object);
}

static int walk_known(struct look *look, struct avc_error *err)
{
	for (uint32_t i = 0; i < look->known->count; i++)
		if (look_at(look, look->known->file[i].fd, err))
			return -1;
	return 0;
}

static int walk(struct look *look, uint32_t seen, struct avc_error *err)
{
	char buf[16384] __attribute__((aligned(8)));

	for (;;) {
		const long n = syscall(SYS_getdents64, look->fd_dir, buf, sizeof buf);

		if (n < 0)
			return fail_errno(err, look->pid, "look at descriptors", "getdents64",
					  "it has ended");
		if (n == 0)
			return 0;
		for (long at = 0; at < n;) {
			const struct linux_dirent64 *entry = (struct linux_dirent64 *)(buf + at);

			at += entry->d_reclen;
			if (entry->d_name[0] != '.' && is_of_interest(look, entry->d_name) &&
			    !find_among(look->files, seen, atoi(entry->d_name)) &&
			    look_at(look, atoi(entry->d_name), err))
				return -1;
		}
	}
}

/* How many it has, since Linux 6.2. */
static int64_t size_of_table(const struct look *look)
{
	struct stat st;

	return fstat(look->fd_dir, &st) ? -1 : st.st_size;
}

/* Most have what they had before, or what their parent has; and to list a table takes longer than to
 * look for those. */
static int walk_before(struct look *look, struct avc_error *err)
{
	const struct files *likely = look->known ? look->known : look->files->parent;

	for (uint32_t i = 0; likely && i < likely->count; i++)
		if (look_at(look, likely->file[i].fd, err))
			return -1;
	return size_of_table(look) == look->files->count ? 0 : walk(look, look->files->count, err);
}

/* One that existed before, in its place. */
static int look_at_place(struct look *look, uint32_t i, bool *same, struct avc_error *err)
{
	struct files *files = look->files;

	files->count = i;
	if (look_at(look, look->known->file[i].fd, err))
		return -1;
	if (files->count == i)
		files->file[i].fd = -1; /* it has been closed             */
	*same &= files->count > i && files->file[i].known;
	return 0;
}

static int look_at_heirs(struct look *look, bool *same, struct avc_error *err)
{
	for (uint32_t i = 0; i < look->known->count; i++)
		if (look->known->file[i].heir && look_at_place(look, i, same, err))
			return -1;
	return 0;
}

/* Whether all others still exist. */
static int look_at_own(struct look *look, bool *same, struct avc_error *err)
{
	*same = true;
	for (uint32_t i = 0; i < look->known->own_count; i++)
		if (look_at_place(look, look->known->own[i], same, err))
			return -1;
	return 0;
}

static int by_value(const void *a, const void *b)
{
	const int x = *(const int *)a, y = *(const int *)b;

	return (x > y) - (x < y);
}

static void add_varied(struct files *files, const struct file *k)
{
	if (!may_copy(k, files_find(files, k->fd)) || !is_unchanged(k, files_find(files, k->fd)))
		files->varied[files->varied_count++] = k->fd;
}

/* Its children's heirs are like `known`, for each of which this is done once, and not once for each
 * child. */
static void note_varied(struct files *files, const struct files *known)
{
	const struct files *parent = files->heirs ? files->parent : NULL;
	uint32_t room = 1 + known->count + (parent ? parent->varied_count : 0);

	files->varied = budget_take(room * sizeof(int)) ? malloc(room * sizeof(int)) : NULL;
	if (!files->varied)
		return;
	if (!parent)
		for (uint32_t i = 0; i < known->count; i++)
			add_varied(files, &known->file[i]);
	for (uint32_t i = 0; parent && i < known->own_count; i++)
		add_varied(files, &known->file[known->own[i]]);
	for (uint32_t i = 0; parent && i < parent->varied_count; i++) {
		const struct file *k = files_find(known, parent->varied[i]);

		if (k && k->heir)
			files->varied[files->varied_count++] = k->fd;
	}
	qsort(files->varied, files->varied_count, sizeof *files->varied, by_value);
	files->varied_known = true;
}

/* Whether what it shares with its parent can be written down after the freeze. */
static bool may_leave_heirs(const struct look *look)
{
	const struct files *files = look->files, *parent = files->parent, *known = look->known;

	if (!look->trusts || !parent || !parent->varied_known ||
	    known->parent_number != parent->process->files_before->number)
		return false;
	for (uint32_t i = 0; i < known->own_count; i++) {
		const struct file *f = &files->file[known->own[i]];

		if (f->shared != f->fd &&
		    syscall(SYS_kcmp, look->pid, look->pid, KCMP_FILE, f->fd, f->shared))
			return false;
	}
	return true;
}

/* Closes the gaps between its own and `at`, both by index and ascending. */
static void keep_looked_at(struct look *look, const uint32_t *at, uint32_t count)
{
	const struct files *known = look->known;
	struct files *files = look->files;

	files->count = 0;
	for (uint32_t own = 0, other = 0; own < known->own_count || other < count;) {
		const bool is_own = other == count ||
				    (own < known->own_count && known->own[own] < at[other]);
		const uint32_t i = is_own ? known->own[own++] : at[other++];

		if (files->file[i].fd >= 0)
			files->file[files->count++] = files->file[i];
	}
}

/* There may be as many as processes times the descriptors of the first: so they are written down when
 * the app runs again (files_fill_heirs()), except for what has to be read. */
static int leave_heirs(struct look *look, struct avc_error *err)
{
	struct files *files = look->files, *known = look->known;
	const struct files *parent = files->parent;
	uint32_t *at = calloc(parent->varied_count + 1, sizeof *at), count = 0;
	bool ignored;
	int result = 0;

	if (!at)
		return fail_errno(err, look->pid, "freeze", "calloc", "out of memory");
	for (uint32_t i = 0; !result && i < parent->varied_count; i++) {
		const struct file *k = files_find(known, parent->varied[i]);

		if (!k || !k->heir)
			continue;
		at[count++] = (uint32_t)(k - known->file);
		result = look_at_place(look, at[count - 1], &ignored, err);
	}
	keep_looked_at(look, at, result ? 0 : count);
	free(at);
	if (result)
		return -1;
	if (!budget_take((uint64_t)(known->count - files->count) * sizeof *files->file))
		return budget_check(look->pid, err);
	files->heirs = files_share(known);
	return 0;
}

static void close_gaps(struct files *files, uint32_t count)
{
	files->count = 0;
	for (uint32_t i = 0; i < count; i++)
		if (files->file[i].fd >= 0)
			files->file[files->count++] = files->file[i];
}

/* Heirs are by far the most numerous, and take time.  A process with the same number of
 * descriptors, and with its own unchanged, most likely still has them, which is checked when it
 * runs again.  With the same number, there is no new one. */
static int walk_frozen(struct look *look, struct avc_error *err)
{
	const uint32_t count = look->known->count;
	const int64_t size = size_of_table(look);
	bool same;

	if (look_at_own(look, &same, err))
		return -1;
	look->trusts = same && size == count && !look->files->process->heirs_vary;
	look->files->trusted = look->trusts;
	if (may_leave_heirs(look))
		return leave_heirs(look, err);
	if (look_at_heirs(look, &same, err))
		return -1;
	close_gaps(look->files, count);
	return size == look->files->count ? 0 : walk(look, look->files->count, err);
}

static bool are_in_order(const struct files *files)
{
	for (uint32_t i = 1; i < files->count; i++)
		if (files->file[i - 1].fd > files->file[i].fd)
			return false;
	return true;
}

int files_look(struct files *files, const struct files_owner *owner, enum files_depth depth,
	       struct files *known, struct avc_error *err)
{
	const pid_t pid = owner->pid, init = owner->init;
	struct look look = { .files = files,
			     .known = known,
			     .pid = pid,
			     .init = init,
			     .pidfd = owner->pidfd,
			     .later = SOCKETS_LATER,
			     .reuses = owner->reuses,
			     .likely = owner->likely,
			     .likely_count = owner->reuses ? owner->likely_count : 0,
			     .depth = depth };
	struct timespec now;
	int result;

	look.fd_dir = proc_open(pid, "fd", O_RDONLY | O_DIRECTORY);
	if (look.fd_dir < 0)
		return fail_errno(err, pid, "look at descriptors", "open(fd)", "it has ended");
	for (int i = 0; i < 3 && depth != FILES_FROZEN && init; i++) {
		char name[8];
		struct statx st;

		snprintf(name, sizeof name, "fd/%d", i);
		if (!proc_look(init, name, STATX_INO, &st))
			continue;
		look.init_stdio[i].dev = makedev(st.stx_dev_major, st.stx_dev_minor);
		look.init_stdio[i].ino = st.stx_ino;
	}
	files->count = 0;
	clock_gettime(CLOCK_REALTIME, &now);
	files->taken_ns = (uint64_t)now.tv_sec * NS_PER_S + (uint64_t)now.tv_nsec;
	if (files->missing && !files->missing->count)
		result = walk_known(&look, err);
	else if (depth == FILES_FROZEN && known && known->count <= files->room)
		result = walk_frozen(&look, err);
	else if (depth == FILES_BEFORE)
		result = walk_before(&look, err);
	else
		result = walk(&look, 0, err);
	close(look.fd_dir);
	files->served = depth == FILES_BEFORE ? mounts_may_be_served(&look.mounts, pid)
					      : known && known->served;
	mounts_free(&look.mounts);
	if (!result && depth == FILES_BEFORE && look.refuses)
		result = fail(err, AVC_UNSUPPORTED, 0, pid, "look at descriptors", "", "%s",
			      look.refuses);
	if (!result && depth != FILES_NOW &&
	    files_find_device(files, makedev(MISC_MAJOR, FUSE_MINOR)) >= 0)
		result = fail(err, AVC_UNSUPPORTED, 0, pid, "look at descriptors", "", "%s",
			      files_serves);
	if (result) {
		for (uint32_t i = 0; i < files->count; i++)
			drop_ours(&files->file[i]);
		return -1;
	}
	if (!are_in_order(files))
		qsort(files->file, files->count, sizeof *files->file, by_fd);
	if (depth == FILES_FROZEN) {
		check_shared(files, pid);
		files_find_peers(files, pid); /* of pairs that are quite new */
		files_find_areas(files, pid);
	} else {
		find_shared(files, pid);
		if (depth == FILES_BEFORE)
			files_find_peers(files, pid);
	}
	return 0;
}

/* Those of the app itself, whose process will be a new one with the same PID. */
static void find_own_pidfds(const struct process *process, struct files *files)
{
	for (uint32_t i = 0; i < files->count; i++) {
		struct file *f = &files->file[i];

		if (f->kind != FILE_PIDFD)
			continue;
		f->pid_inside = f->pid == process->leader ? process->inside : 0;
		for (uint32_t k = 0; !f->pid_inside && k < process->thread_count; k++)
			if (process->threads[k].tid == f->pid)
				f->pid_inside = process->threads[k].inside;
	}
}

/* Only the app itself, its threads and its group can be named again. */
static void find_owners(const struct process *process, struct files *files)
{
	for (uint32_t i = 0; i < files->count; i++) {
		struct file *f = &files->file[i];

		if (!f->owner || f->owner_inside)
			continue;
		if (f->owner_type == F_OWNER_PGRP)
			f->owner_inside = proc_inside(f->owner);
		else if (f->owner == process->leader)
			f->owner_inside = process->inside;
		for (uint32_t k = 0; f->owner_type == F_OWNER_TID && k < process->thread_count; k++)
			if (process->threads[k].tid == f->owner)
				f->owner_inside = process->threads[k].inside;
		if (f->owner_inside < 0)
			f->owner_inside = 0;
	}
}

/* The read before the freeze, while the app may be using its descriptors. */
struct survey {
	struct aside aside;
	struct files *files, *last; /* last: of the last checkpoint, or NULL     */
	struct files_owner owner;
	int result;
	struct avc_error error;
};
#define SURVEY_NS (5 * NS_PER_S)
#define SURVEY_STOPPED_NS (200 * NS_PER_MS) /* of a process found in the freeze                 */

static void survey(struct aside *aside)
{
	struct survey *job = (struct survey *)aside;

	job->result = files_look(job->files, &job->owner, FILES_BEFORE, job->last, &job->error);
}

/* Only heirs that occur once: one that occurs twice could be moved and moved back unnoticed. */
static bool note_heirs(struct files *files)
{
	static uint64_t number;

	files->number = ++number;
	files->parent_number = files->parent ? files->parent->number : 0;
	files->own = malloc((files->count + 1) * sizeof *files->own);
	if (!files->own)
		return false;
	for (uint32_t i = 0; i < files->count; i++)
		files->file[i].heir = files->file[i].inherited;
	for (uint32_t i = 0; i < files->count; i++)
		if (files->file[i].shared != files->file[i].fd)
			files->file[i].heir = files_find(files, files->file[i].shared)->heir =
				false;
	for (uint32_t i = 0; i < files->count; i++)
		if (!files->file[i].heir)
			files->own[files->own_count++] = i;
	return true;
}

/* Not needed afterwards. */
static void forget_parent(struct files *files)
{
	files_free((struct files *)files->parent);
	files->parent = NULL;
	for (uint32_t i = 0; i < files->count; i++)
		files->file[i].inherited = NULL;
}

static void drop_survey(struct aside *aside)
{
	struct survey *job = (struct survey *)aside;

	if (job->files)
		forget_parent(job->files);
	files_free(job->files);
	files_free(job->last);
	free(job->owner.likely);
	close_fd(&job->owner.pidfd);
	free(job);
}

static struct files *look_before(struct process *process, const struct process *parent,
				 struct avc_error *err)
{
	static int left_behind;
	struct survey *job = calloc(1, sizeof *job);
	struct files *files = NULL;

	if (job)
		*job = (struct survey){
			.aside = { survey, drop_survey, &left_behind },
			.files = files_new(process->files_seen + ROOM_SPARE),
			.owner = { .pid = process->pid,
				   .pidfd = fcntl(process->pidfd, F_DUPFD_CLOEXEC, 3),
				   .init = process->init,
				   .reuses = !process->heirs_change && !process->heirs_vary }
		};
	if (!job || !job->files || job->owner.pidfd < 0) {
		fail_errno(err, process->pid, "look at descriptors", "calloc", "out of memory");
		if (job)
			drop_survey(&job->aside);
		return NULL;
	}
	job->owner.likely = process->heirs_likely;
	job->owner.likely_count = process->heirs_count;
	process->heirs_likely = NULL;
	process->heirs_count = 0;
	if (process->files_before)
		job->last = files_share(process->files_before);
	if (parent && parent->files_before) {
		job->files->parent = files_share(parent->files_before);
		job->files->parent_pid = parent->pid;
	}
	if (!aside_run(&job->aside, rt_priority_is() ? SURVEY_STOPPED_NS : SURVEY_NS)) {
		fail(err, AVC_DEADLINE, 0, process->pid, "look at descriptors", "",
		     "one of its files does not answer");
		return NULL;
	}
	if (job->result) {
		*err = err->code ? *err : job->error;
	} else if (!note_heirs(job->files)) {
		fail_errno(err, process->pid, "look at descriptors", "malloc", "out of memory");
	} else {
		files = job->files;
		job->files = NULL;
		forget_parent(files);
	}
	drop_survey(&job->aside);
	return files;
}

static void note_sockets(struct process *process, const struct files *files)
{
	process->socket_count = 0;
	for (uint32_t i = 0; i < files->count && process->socket_count < SOCKETS_MAX; i++)
		if (files->file[i].kind == FILE_SOCKET)
			process->sockets[process->socket_count++] = files->file[i].fd;
}

int files_prepare(struct process *process, const struct process *parent, struct avc_error *err)
{
	struct files *before, *image;

	files_free(process->files_image);
	process->files_image = NULL;
	if (process->shared & CLONE_FILES) {
		files_free(process->files_before);
		process->files_before = NULL;
		process->files_image = files_new(1); /* they are its parent's */
		return process->files_image ? 0
					    : fail_errno(err, process->pid, "look at descriptors",
							 "calloc", "out of memory");
	}
	before = look_before(process, parent, err);
	if (!before)
		return -1;
	files_free(process->files_before);
	process->files_before = before;
	process->files_seen = before->count;
	note_sockets(process, before);
	image = files_new(before->count + before->count / 4 + ROOM_SPARE);
	if (!image)
		return fail_errno(err, process->pid, "look at descriptors", "calloc",
				  "out of memory");
	/* Touched now: otherwise the first touch would fault while the app is stopped. (A compiler
	 * leaves out memset(3) after calloc(3).) */
	explicit_bzero(image->file, image->room * sizeof *image->file);
	image->with_tcp = process->tcp_moved;
	process->files_image = image;
	return 0;
}

/* All but the contents. */
static void look_frozen(struct image *image, const struct image *parent, bool several,
			uint32_t *ours)
{
	struct process *process = image->process;
	const struct files_owner owner = { .pid = process->pid,
					   .pidfd = process->pidfd,
					   .init = process->init };
	struct files *files = process->files_image;

	process->files_image = NULL;
	image->files = files;
	files->several = several;
	files->parent = parent ? parent->files : NULL;
	files->parent_pid = parent ? parent->process->pid : 0;
	files->ours = ours;
	files->process = process;
	if (image->shared & CLONE_FILES)
		return;
	if (parent && files_are_read(parent) && parent->process->files_before &&
	    !parent->files->varied)
		note_varied(parent->files, parent->process->files_before);
	if (files_look(files, &owner, FILES_FROZEN, process->files_before, &image->files_error))
		return;
	find_owners(process, files);
	find_own_pidfds(process, files);
}

/* Contents last: the sizes of all pipes are asked for at once. */
void files_capture(struct image *image, uint32_t images)
{
	struct scratch scratch = { -1, -1, 0 };
	uint32_t ours = 0;

	for (uint32_t i = 0; i < images; i++)
		/* An orphan shares most with the main process, if at all. */
		if (image[i].process)
			look_frozen(&image[i],
				    i ? &image[image[i].parent < 0 ? 0 : image[i].parent] : NULL,
				    images > 1, &ours);
	files_measure_pipes(image, images);
	for (uint32_t i = 0; i < images; i++)
		if (files_are_read(&image[i]))
			keep_contents(&image[i], &scratch);
	for (uint32_t i = 0; i < images; i++) {
		if (!image[i].process)
			continue;
		image[i].files->parent = NULL; /* may be gone before this one */
		image[i].files->ours = NULL;
		image[i].files->process = NULL;
	}
	scratch_close(&scratch);
}

/* The parent's are complete.  In place, from the last one: all others move up. */
static int fill_in(struct image *image, const struct files *parent, struct avc_error *err)
{
	struct files *files = image->files, *known = files->heirs;
	const struct look look = {
		.files = files, .known = known, .pid = image->process->pid, .depth = FILES_FROZEN
	};
	uint32_t left = files->count, at = left;
	int result = 0;

	for (uint32_t i = 0; i < known->count; i++)
		at += known->file[i].heir && !files_find(files, known->file[i].fd);
	files->count = at;
	for (uint32_t i = known->count; i > 0 && at > left; i--) {
		const struct file *k = &known->file[i - 1], *is = files_find(parent, k->fd);
		struct file *f;

		while (left && files->file[left - 1].fd > k->fd)
			files->file[--at] = files->file[--left];
		if (!k->heir || (left && files->file[left - 1].fd == k->fd))
			continue;
		f = &files->file[--at];
		if (is && take_over(&look, is, f))
			continue;
		*f = (struct file){ .fd = k->fd, .shared = k->fd, .offset = -1 };
		image->process->heirs_vary = true;
		result = fail(err, AVC_RETRY, 0, image->pid, "freeze", "",
			      "descriptor %d was changed meanwhile", k->fd);
	}
	files->heirs = NULL;
	files_free(known);
	free(files->ends);
	files->ends = NULL;
	files->end_count = 0;
	return result;
}

int files_fill_heirs(struct image *image, uint32_t images, struct avc_error *err)
{
	for (uint32_t i = 1; i < images; i++) {
		const struct files *parent = image[image[i].parent < 0 ? 0 : image[i].parent].files;
		struct files *files = image[i].files;

		if (!files_are_read(&image[i]))
			continue;
		if (files->heirs) {
			if (fill_in(&image[i], parent, err))
				return -1;
			find_owners(image[i].process, files);
			find_own_pidfds(image[i].process, files);
		}
		for (uint32_t k = 0; k < files->count; k++) {
			struct file *f = &files->file[k];

			if (!f->inherited)
				continue;
			f->inherited = files_find(parent, f->fd); /* that was moved */
			if (may_have_content(f))
				copy_content(parent, f);
		}
	}
	return 0;
}

/* flock(2) cannot be observed cheaply: a lock that exists after the freeze, but not before, may be
 * from either side of it, and is left alone at a restore. */
void files_settle(struct image *image)
{
	files_land();
	files_find_closed(image->files, image->template);
	for (uint32_t i = 0; i < image->files->count; i++) {
		struct file *f = &image->files->file[i];
		struct file now = { .fd = f->fd, .kind = FILE_REGULAR };

		if (f->inherited)
			f->lock_unsure = f->inherited->lock_unsure;
		if (f->inherited || f->kind != FILE_REGULAR || f->flags & O_PATH)
			continue;
		file_read_info(image->process->pid, &now);
		for (uint32_t k = 0; k < now.lock_count; k++)
			f->lock_unsure |= now.lock[k].kind == LOCK_FLOCK_;
		for (uint32_t k = 0; k < f->lock_count; k++)
			f->lock_unsure &= f->lock[k].kind != LOCK_FLOCK_;
		free(now.lock);
	}
}

void files_forget(struct process *process)
{
	files_free(process->files_before);
	files_free(process->files_image);
	process->files_before = NULL;
	process->files_image = NULL;
	free(process->heirs_likely);
	process->heirs_likely = NULL;
	process->heirs_count = 0;
}
