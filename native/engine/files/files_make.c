/* SPDX-License-Identifier: Apache-2.0
 *
 * Reopens and recreates what is not in the table any more (files.h).  A file is only opened if it
 * is the same one: the app gets nothing that it did not have.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/major.h>
#include <netinet/in.h>
#include <sched.h>
#include <stdio.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/inotify.h>
#include <sys/signalfd.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/sysmacros.h>
#include <sys/timerfd.h>
#include <unistd.h>

#include "files.h"

/* drivers/tty/pty.c */
#define PTMX_MINOR 2

static bool is_the_one(int fd, const struct file *want)
{
	struct stat st;

	return fstat(fd, &st) == 0 && st.st_dev == want->dev && st.st_ino == want->ino &&
	       (st.st_mode & S_IFMT) == (want->mode & S_IFMT) && st.st_rdev == want->rdev;
}

/* From any descriptor of a file to one with the flags that the app had. */
static int open_as(int fd, const struct file *want)
{
	/* O_TMPFILE is more than one bit, and has O_DIRECTORY. */
	const int flags = want->flags &
			  ~(O_CREAT | O_EXCL | O_TRUNC | O_NOFOLLOW | O_TMPFILE | FASYNC);
	int again, reader;

	if (want->flags & O_PATH)
		return got_fd(fcntl(fd, F_DUPFD_CLOEXEC, 3));
	if (want->kind == FILE_DEVICE)
		return open_device(fd, flags);
	again = open_again(fd, flags);
	if (again < 0 && errno == ENXIO && want->kind == FILE_FIFO) {
		/* For writing, without a reader: there must be one temporarily. */
		reader = open_again(fd, O_RDONLY);
		again = open_again(fd, flags);
		close_fd(&reader);
	}
	return again;
}

int file_open_path(const struct file *want, pid_t init, const struct file_rights *rights)
{
	struct file_rights_own own;
	int root = proc_open(init, "root", O_PATH | O_DIRECTORY), fd = -1;

	if (root < 0)
		return -1;
	if (want->name[0] == '/' && (!rights || !file_rights_take(rights, &own))) {
		fd = open_below(root, want->name, 0, 0);
		if (rights)
			file_rights_give_back(&own);
	}
	close(root);
	if (fd >= 0 && !is_the_one(fd, want)) {
		close(fd);
		fd = -1;
		errno = ESTALE;
	}
	return fd;
}

struct mapped_look {
	const struct file *want;
	pid_t template;
	int fd;
};

static int try_mapped(const struct mapping *m, void *arg)
{
	struct mapped_look *look = arg;

	if (m->inode != look->want->ino)
		return 0;
	look->fd = proc_open_mapped(look->template, m->start, m->end, O_PATH);
	if (look->fd >= 0 && !is_the_one(look->fd, look->want))
		close_fd(&look->fd);
	return look->fd >= 0 ? -1 : 0;
}

/* A file without a name may still be mapped into the template. */
static int open_mapped(const struct file *want, pid_t template)
{
	struct mapped_look look = { .want = want, .template = template, .fd = -1 };

	(void)proc_mappings(template, "maps", try_mapped, &look);
	return look.fd;
}

int file_find(const struct file *want, pid_t template, pid_t init)
{
	const int found = file_open_path(want, init, NULL), missing = errno;
	const int mapped = found < 0 ? open_mapped(want, template) : -1;

	errno = missing;
	return found < 0 ? mapped : found;
}

static int open_empty(const struct file *want)
{
	return got_fd(open("/dev/null", (want->flags & (O_ACCMODE | O_PATH)) | O_CLOEXEC));
}

bool file_is_pts(const struct file *f)
{
	return f->kind == FILE_DEVICE && major(f->rdev) >= UNIX98_PTY_SLAVE_MAJOR &&
	       major(f->rdev) < UNIX98_PTY_SLAVE_MAJOR + UNIX98_PTY_MAJOR_COUNT;
}

/* Whether it has state per open: not /dev/null and its like, nor terminals, but /dev/ptmx. */
static bool is_another_instance(const struct file *want)
{
	if (want->kind != FILE_DEVICE || want->flags & O_PATH || file_is_pts(want))
		return false;
	switch (major(want->rdev)) {
	case MEM_MAJOR:
	case TTY_MAJOR:
		return false;
	case TTYAUX_MAJOR:
		return minor(want->rdev) == PTMX_MINOR;
	}
	return true;
}

static int make_named(const struct file *want, pid_t template, pid_t init,
		      const struct file_rights *rights, const char **why)
{
	struct file_rights_own own;
	int found = file_open_path(want, init, rights), fd = -1;

	if (found < 0)
		found = open_mapped(want, template);
	if (found < 0) {
		*why = "it was closed since the checkpoint and is not there any more";
	} else if (file_rights_take(rights, &own)) {
		*why = "it was closed since the checkpoint, and it is not known who may open it";
	} else {
		fd = open_as(found, want);
		file_rights_give_back(&own);
		if (fd < 0)
			*why = "it was closed since the checkpoint and cannot be opened again";
		else if (is_another_instance(want))
			*why = "it was closed since the checkpoint: the device was opened anew";
	}
	close_fd(&found);
	return fd >= 0 ? fd : open_empty(want);
}

static const char not_again[] = "it was closed since the checkpoint and cannot be made again";

int file_socket_of(pid_t pid, int domain, int type, int protocol)
{
	int own = got_fd(open("/proc/thread-self/ns/net", O_RDONLY | O_CLOEXEC));
	int theirs = proc_open(pid, "ns/net", O_RDONLY), fd = -1;

	if (own >= 0 && theirs >= 0 && setns(theirs, CLONE_NEWNET) == 0) {
		fd = got_fd(socket(domain, type | SOCK_CLOEXEC, protocol));
		if (setns(own, CLONE_NEWNET))
			close_fd(&fd);
	}
	close_fd(&own);
	close_fd(&theirs);
	return fd;
}

/* What the peer had sent before it closed. */
static void leave_content(int fd, int other_fd, const struct file *want)
{
	if (want->ended && want->content)
		(void)file_put_content(fd, other_fd, want, NULL);
}

/* Likewise for a Unix socket (file_tcp_is_cut()): only the server's has a name. */
static bool is_cut_unix(const struct file *f)
{
	const struct file_socket *s = f->socket;

	return s && s->domain == AF_UNIX && s->connected && !f->ended &&
	       s->local_bytes <= sizeof(sa_family_t) && s->remote_bytes > sizeof(sa_family_t);
}

/* A socket or pipe that reads as closed by the peer, after its contents; one that was cut off, first as
 * reset. */
static int make_dead(const struct file *want, pid_t template, const struct file_rights *rights)
{
	const struct file_socket *s = want->socket;
	int ends[2], fd;

	if (want->kind == FILE_PIPE) {
		const int mine = (want->flags & O_ACCMODE) == O_RDONLY ? 0 : 1;

		if (file_rights_pair(rights, 0, ends))
			return -1;
		if (mine == 0)
			leave_content(ends[0], ends[1], want);
		close(ends[!mine]);
		return ends[mine];
	}
	if (s && s->protocol == IPPROTO_TCP) {
		fd = file_socket_of(template, s->domain, SOCK_STREAM, IPPROTO_TCP);
		if (fd >= 0) {
			if (file_tcp_is_cut(want))
				(void)file_break_tcp(fd, s->domain);
			shutdown(fd, SHUT_RDWR); /* ENOTCONN, and done (net/ipv4/af_inet.c) */
			return fd;
		}
	}
	if (file_rights_pair(rights, s && s->type == SOCK_SEQPACKET ? SOCK_SEQPACKET : SOCK_STREAM,
			     ends))
		return -1;
	leave_content(ends[0], ends[1], want);
	/* Who closes with something unread resets (unix_release_sock()). */
	if (is_cut_unix(want))
		(void)send(ends[0], "", 1, MSG_DONTWAIT | MSG_NOSIGNAL);
	close(ends[1]);
	return ends[0];
}

static int bind_socket(int fd, const struct file_socket *s, const char **why)
{
	const int yes = 1;

	/* Connections that it had accepted still have its port. */
	if (s->type == SOCK_STREAM)
		setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
	/* One without a port must not get one. */
	if ((file_socket_has_name(fd, s) ||
	     bind(fd, (const struct sockaddr *)&s->local, s->local_bytes) == 0) &&
	    (!s->listening || listen(fd, s->backlog) == 0) &&
	    (!s->connected ||
	     connect(fd, (const struct sockaddr *)&s->remote, s->remote_bytes) == 0))
		return 0;
	*why = s->listening ? "it was closed since the checkpoint and its port is taken now"
			    : "it was closed since the checkpoint and its address is taken now";
	return -1;
}

/* Whoever waits in a connect(2) makes it again; its port was of the kernel's choice, as a rule.  Whoever
 * polls for its end is told of an error, for some programs wait on when there is neither an error nor
 * a peer. */
static int make_connecting(int fd, const struct file *want)
{
	return want->flags & O_NONBLOCK ? file_break_tcp(fd, want->socket->domain) : 0;
}

/* Those that need no peer.  For a Unix socket, listen(2) is left to the restored process, which
 * clients see as the server (unix(7), SO_PEERCRED), and connect(2) until all have their names
 * (files_restore.c). */
static int make_socket(const struct file *want, pid_t template, pid_t init,
		       const struct file_rights *rights, const char **why)
{
	const struct file_socket *s = want->socket;
	const char *problem;
	int fd;

	if (!s || !file_socket_is_alone(s)) {
		/* A closed connection need not be reported. */
		if (s && s->domain != AF_UNIX && s->domain != AF_INET && s->domain != AF_INET6)
			*why = not_again;
		return make_dead(want, template, rights);
	}
	fd = file_socket_of(template, s->domain, s->type, s->protocol);
	if (fd < 0)
		return make_dead(want, template, rights);
	/* Only sockets of one user can share a port (socket(7), SO_REUSEPORT). */
	if (fchown(fd, s->uid, s->gid))
		*why = "it does not belong to its user any more";
	file_put_options(fd, s);
	if (s->connecting          ? make_connecting(fd, want)
	    : s->domain == AF_UNIX ? file_bind_unix(fd, s, template, init, why)
				   : bind_socket(fd, s, why)) {
		close(fd);
		return make_dead(want, template, rights);
	}
	problem = file_put_options(fd, s); /* one was in the way of bind(2) */
	*why = *why ? *why : problem;
	return fd;
}

/* init has the stdio that the app was started with. */
static int take_from_init(const struct file *want, pid_t init)
{
	int pidfd = proc_pidfd_open(init), fd = -1;

	for (int i = 0; pidfd >= 0 && fd < 0 && i < 3; i++) {
		fd = proc_borrow_fd(pidfd, i);
		if (fd >= 0 && (!is_the_one(fd, want) ||
				(fcntl(fd, F_GETFL) & O_ACCMODE) != (want->flags & O_ACCMODE)))
			close_fd(&fd);
	}
	close_fd(&pidfd);
	return fd;
}

/* Since Linux 6.9 the inode distinguishes a process from another that has reused its PID. */
static int make_pidfd(const struct file *want, pid_t init)
{
	struct stat own = { 0 };
	int fd = proc_pidfd_open(init);
	const bool told = fd >= 0 && fstat(fd, &own) == 0 &&
			  (own.st_ino != want->ino || want->pid == init);

	close_fd(&fd);
	if (!told || want->pid <= 0)
		return -1;
	fd = got_fd((int)syscall(SYS_pidfd_open, want->pid, want->flags & (O_NONBLOCK | O_EXCL)));
	if (fd >= 0 && !is_the_one(fd, want))
		close_fd(&fd);
	return fd;
}

int file_make(const struct file *want, pid_t template, pid_t init, const struct file_rights *rights,
	      const char **why)
{
	const int nonblock = want->flags & O_NONBLOCK;
	int fd;

	*why = NULL;
	if (want->pid_inside)
		return open_empty(want); /* for the moment: files_calls.c */
	switch (want->kind) {
	case FILE_REGULAR:
	case FILE_DIRECTORY:
	case FILE_DEVICE:
	case FILE_FIFO:
		fd = want->outside ? take_from_init(want, init) : -1;
		return fd >= 0 ? fd : make_named(want, template, init, rights, why);
	case FILE_PIPE:
		fd = take_from_init(want, init);
		return fd >= 0 ? fd : make_dead(want, template, rights);
	case FILE_SOCKET:
		fd = take_from_init(want, init);
		return fd >= 0 ? fd : make_socket(want, template, init, rights, why);
	case FILE_EVENTFD:
		return got_fd(eventfd(0, EFD_CLOEXEC | (nonblock ? EFD_NONBLOCK : 0) |
						 (want->semaphore ? EFD_SEMAPHORE : 0)));
	case FILE_TIMERFD:
		return got_fd(
			timerfd_create(want->clock, TFD_CLOEXEC | (nonblock ? TFD_NONBLOCK : 0)));
	case FILE_SIGNALFD:
		return got_fd((int)syscall(SYS_signalfd4, -1, &want->mask, 8,
					   SFD_CLOEXEC | (nonblock ? SFD_NONBLOCK : 0)));
	case FILE_EPOLL:
		return got_fd(epoll_create1(EPOLL_CLOEXEC));
	case FILE_INOTIFY:
		return got_limited_fd(inotify_init1(IN_CLOEXEC | (nonblock ? IN_NONBLOCK : 0)));
	case FILE_PIDFD:
		fd = make_pidfd(want, init);
		if (fd < 0)
			*why = "it was closed since the checkpoint, and its process has ended";
		return fd >= 0 ? fd : open_empty(want);
	case FILE_OTHER:
		break;
	}
	*why = not_again;
	return open_empty(want);
}

int file_make_pair(const struct file *want, const struct file *other,
		   const struct file_rights *rights, int ends[2])
{
	if (file_rights_pair(rights, want->kind == FILE_PIPE ? 0 : want->socket->type, ends))
		return -1;
	if (want->kind == FILE_PIPE) {
		if (want->pipe_bytes > 0 && want->pipe_bytes != fcntl(ends[0], F_GETPIPE_SZ))
			(void)fcntl(ends[0], F_SETPIPE_SZ, want->pipe_bytes);
		return 0;
	}
	file_put_options(ends[0], want->socket);
	file_put_options(ends[1], other->socket);
	return 0;
}
