/* SPDX-License-Identifier: Apache-2.0
 *
 * Names of Unix sockets (files.h).  A path name is also a file: that of a recreated socket is where
 * the old one was, with its mode and owner, and getsockname(2) returns the same.
 */
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <unistd.h>

#include "files.h"

/* linux/un.h, which does not go with sys/un.h; since Linux 4.11. */
#define UNIX_FILE (SIOCPROTOPRIVATE + 0)
#define DELETED " (deleted)"
#define TAKEN "it was closed since the checkpoint and its address is taken now"

/* The file of a name. */
struct file_node {
	uint64_t folder_dev, folder_ino;
	uint32_t mode, uid, gid;
	bool deleted;
	char path[PATH_MAX]; /* as in the container                                 */
};

static bool is_named(socklen_t bytes)
{
	return bytes > sizeof(sa_family_t);
}

static bool is_path(const struct sockaddr_storage *address, socklen_t bytes)
{
	return is_named(bytes) && ((const struct sockaddr_un *)address)->sun_path[0];
}

/* unix(7): its peer has a name, or is the other end of a socketpair(2). */
bool file_unix_is_alone(const struct file_socket *s)
{
	if (s->type != SOCK_DGRAM)
		return s->listening;
	return is_named(s->local_bytes) || !s->connected || is_named(s->remote_bytes);
}

static bool is_connected(const struct file_socket *s)
{
	return s && s->domain == AF_UNIX && s->type == SOCK_DGRAM && s->connected &&
	       is_named(s->remote_bytes);
}

static const char *base_of(const char *path)
{
	const char *slash = strrchr(path, '/');

	return slash ? slash + 1 : path;
}

bool file_unix_is_bus(const struct file_socket *s)
{
	const struct sockaddr_un *remote = (const struct sockaddr_un *)&s->remote;
	char name[sizeof remote->sun_path + 1] = "";
	const char *base;

	if (!is_named(s->remote_bytes))
		return false;
	memcpy(name, remote->sun_path, s->remote_bytes - offsetof(struct sockaddr_un, sun_path));
	base = base_of(name[0] ? name : name + 1);
	return !strcmp(base, "bus") || !strcmp(base, "system_bus_socket") ||
	       !strncmp(base, "dbus-", 5);
}

/* ---- looking ------------------------------------------------------------------- */

static int open_folder(int root, const char *path)
{
	char folder[PATH_MAX];

	snprintf(folder, sizeof folder, "%.*s/", (int)(base_of(path) - path), path);
	return open_below(root, folder, O_DIRECTORY, 0);
}

static bool path_of(int fd, char path[PATH_MAX])
{
	const ssize_t n = readlink(fd_path(fd).text, path, PATH_MAX - 1);

	path[n > 0 ? n : 0] = 0;
	return path[0] == '/';
}

static void look_at_file(int file, int root, struct file_node *node)
{
	const size_t suffix = strlen(DELETED);
	struct stat st, folder;
	size_t bytes;
	int folder_fd;

	if (fstat(file, &st) || !path_of(file, node->path))
		return;
	bytes = strlen(node->path);
	node->deleted = !st.st_nlink;
	if (node->deleted && bytes > suffix && !strcmp(node->path + bytes - suffix, DELETED))
		node->path[bytes - suffix] = 0;
	node->mode = st.st_mode & 07777;
	node->uid = st.st_uid;
	node->gid = st.st_gid;
	folder_fd = open_folder(root, node->path);
	if (folder_fd >= 0 && fstat(folder_fd, &folder) == 0) {
		node->folder_dev = folder.st_dev;
		node->folder_ino = folder.st_ino;
	}
	close_fd(&folder_fd);
}

void file_look_at_node(int fd, struct file_socket *s, pid_t init)
{
	struct file_node node = { 0 };
	int file, root;

	if (s->domain != AF_UNIX || !is_path(&s->local, s->local_bytes))
		return;
	file = ioctl(fd, UNIX_FILE);
	root = proc_open(init, "root", O_PATH | O_DIRECTORY);
	if (file >= 0 && root >= 0)
		look_at_file(file, root, &node);
	close_fd(&file);
	close_fd(&root);
	if (!node.folder_ino)
		return;
	/* A path is rarely of maximum length. */
	s->node = malloc(offsetof(struct file_node, path) + strlen(node.path) + 1);
	if (s->node)
		memcpy(s->node, &node, offsetof(struct file_node, path) + strlen(node.path) + 1);
}

bool file_unix_is_deleted(int fd, const struct file_socket *s)
{
	int file = s->node && !s->node->deleted ? ioctl(fd, UNIX_FILE) : -1;
	struct stat st;
	const bool deleted = file >= 0 && fstat(file, &st) == 0 && !st.st_nlink;

	close_fd(&file);
	return deleted;
}

/* ---- calls that look a name up ---------------------------------------------------- */

/* Where the process resolves names: its root and working directory, as of the checkpoint.  If it
 * has changed them after bind(2): the container's root, and the directory of its file. */
struct errand {
	bool connects; /* or binds                                                 */
	int fd;
	const struct file_node *node; /* NULL: not known                           */
	const struct sockaddr_storage *address;
	socklen_t bytes;
	const struct file_rights *rights; /* of the application, to connect        */
	int root[2], folder[2];
	int errnum;
};

static int call(const struct errand *errand)
{
	const struct sockaddr *address = (const struct sockaddr *)errand->address;

	struct file_rights_own own;
	int result, errnum;

	if (!errand->connects)
		return bind(errand->fd, address, errand->bytes);
	/* To the current socket of that name. */
	if (file_rights_take(errand->rights, &own)) {
		errno = EPERM;
		return -1;
	}
	result = connect(errand->fd, address, errand->bytes);
	errnum = errno;
	file_rights_give_back(&own);
	errno = errnum;
	return result;
}

/* A separate thread, which does not return to normal: root and working directory belong to a thread
 * once they are unshared. */
static void *errand_main(void *arg)
{
	struct errand *errand = arg;

	errand->errnum = unshare(CLONE_FS) ? errno : ENOENT;
	umask(0777); /* no access to the file until it has its mode and owner */
	for (int i = 0; i < 2 && errand->errnum == ENOENT; i++)
		errand->errnum = fchdir(errand->root[i]) || chroot(".") ||
						 fchdir(errand->folder[i]) || call(errand)
					 ? errno
					 : 0;
	return NULL;
}

/* Compares a relative name with the file's path: the rest is where the app was. */
static int open_old_folder(const struct errand *errand, int root)
{
	const char *name = ((const struct sockaddr_un *)errand->address)->sun_path;
	const size_t bytes = strnlen(name, errand->bytes - sizeof(sa_family_t));
	char path[PATH_MAX];
	size_t front;

	if (!errand->node || strlen(errand->node->path) <= bytes)
		return -1;
	front = strlen(errand->node->path) - bytes;
	if (strncmp(errand->node->path + front, name, bytes))
		return -1;
	/* Up to and including the slash: the directory of the rest. */
	snprintf(path, sizeof path, "%.*s", (int)front, errand->node->path);
	return path[front - 1] == '/' ? open_folder(root, path) : -1;
}

static int call_there(struct errand *errand, pid_t template, pid_t init)
{
	const bool relative = ((const struct sockaddr_un *)errand->address)->sun_path[0] != '/';
	pthread_t thread;
	int failed;

	if (!is_path(errand->address, errand->bytes))
		return call(errand);
	errand->root[0] = proc_open(template, "root", O_PATH | O_DIRECTORY);
	errand->folder[0] = proc_open(template, "cwd", O_PATH | O_DIRECTORY);
	errand->root[1] = proc_open(init, "root", O_PATH | O_DIRECTORY);
	errand->folder[1] = relative ? open_old_folder(errand, errand->root[1])
				     : got_fd(fcntl(errand->root[1], F_DUPFD_CLOEXEC, 0));
	failed = pthread_create(&thread, NULL, errand_main, errand);
	if (failed)
		errand->errnum = failed;
	else
		pthread_join(thread, NULL);
	for (int i = 0; i < 2; i++) {
		close_fd(&errand->root[i]);
		close_fd(&errand->folder[i]);
	}
	errno = errand->errnum;
	return errno ? -1 : 0;
}

/* ---- making again ------------------------------------------------------------------- */

/* Whether this socket file is stale.  A socket of another type can try without being accepted, and
 * a datagram one is not noticed (connect(2), ECONNREFUSED). */
static bool is_dead(int file)
{
	struct sockaddr_un address = { .sun_family = AF_UNIX };
	struct stat st;
	int fd;
	bool dead;

	if (fstat(file, &st) || !S_ISSOCK(st.st_mode))
		return false;
	fd = got_fd(socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0));
	strcpy(address.sun_path, fd_path(file).text);
	dead = fd >= 0 && connect(fd, (const struct sockaddr *)&address, sizeof address) &&
	       errno == ECONNREFUSED;
	close_fd(&fd);
	return dead;
}

static bool make_way(int folder, const char *name)
{
	int file = got_fd(openat(folder, name, O_PATH | O_NOFOLLOW | O_CLOEXEC));
	bool dead;

	if (file < 0)
		return errno == ENOENT;
	dead = is_dead(file);
	close(file);
	return dead && unlinkat(folder, name, 0) == 0;
}

static bool is_there(int folder, const char *name, int file)
{
	struct stat st, is;

	return fstat(file, &is) == 0 && fstatat(folder, name, &st, AT_SYMLINK_NOFOLLOW) == 0 &&
	       st.st_dev == is.st_dev && st.st_ino == is.st_ino;
}

/* bind(2) has created it where the name resolves to now; and the app may have renamed it. */
static bool move(int file, int root, int folder, const char *name)
{
	char path[PATH_MAX];
	int from = path_of(file, path) ? open_folder(root, path) : -1;
	bool moved = false;

	if (from >= 0 && is_there(from, base_of(path), file)) {
		moved = renameat2(from, base_of(path), folder, name, RENAME_NOREPLACE) == 0;
		if (!moved)
			unlinkat(from, base_of(path), 0);
	}
	close_fd(&from);
	return moved;
}

static int put_file(int fd, int root, int folder, const struct file_node *node, const char **why)
{
	const char *name = base_of(node->path);
	int file = ioctl(fd, UNIX_FILE), result = 0;

	if (file < 0 || (!is_there(folder, name, file) && !move(file, root, folder, name))) {
		*why = "it was closed since the checkpoint and its file cannot be put back";
		result = -1;
	} else if (node->deleted) {
		unlinkat(folder, name, 0);
	} else if (fchownat(file, "", node->uid, node->gid, AT_EMPTY_PATH) ||
		   chmod(fd_path(file).text,
			 node->mode)) { /* in this order: chown(2) takes bits away */
		*why = "its file has not the owner and mode that it had";
	}
	close_fd(&file);
	return result;
}

static bool is_folder(int fd, const struct file_node *node)
{
	struct stat st;

	return fd >= 0 && fstat(fd, &st) == 0 && st.st_dev == node->folder_dev &&
	       st.st_ino == node->folder_ino;
}

/* Created with the engine's rights, so only where it was: in the same directory. */
static int bind_path(struct errand *errand, const struct file_node *node, pid_t template,
		     pid_t init, const char **why)
{
	int root = proc_open(init, "root", O_PATH | O_DIRECTORY), result = -1;
	int folder = root < 0 ? -1 : open_folder(root, node->path);

	if (!is_folder(folder, node))
		*why = "it was closed since the checkpoint and the folder of its file is gone";
	else if (!make_way(folder, base_of(node->path)))
		*why = TAKEN;
	else if (call_there(errand, template, init))
		*why = errno == EADDRINUSE
			       ? TAKEN
			       : "it was closed since the checkpoint and cannot be bound again";
	else
		result = put_file(errand->fd, root, folder, node, why);
	close_fd(&root);
	close_fd(&folder);
	return result;
}

int file_bind_unix(int fd, const struct file_socket *s, pid_t template, pid_t init,
		   const char **why)
{
	struct errand errand = {
		.fd = fd, .node = s->node, .address = &s->local, .bytes = s->local_bytes
	};

	if (!is_named(s->local_bytes))
		return 0;
	if (is_path(&s->local, s->local_bytes) && s->node)
		return bind_path(&errand, s->node, template, init, why);
	*why = TAKEN;
	if (is_path(&s->local, s->local_bytes))
		*why = "it was closed since the checkpoint and its file is not known";
	else if (call(&errand) == 0)
		*why = NULL;
	return *why ? -1 : 0;
}

static const char *connect_unix(const struct files_work *work, int fd, const struct file_socket *s)
{
	struct errand errand = { .connects = true,
				 .fd = fd,
				 .rights = &work->want->rights,
				 .address = &s->remote,
				 .bytes = s->remote_bytes };

	return call_there(&errand, work->image->template, work->init)
		       ? "it was closed since the checkpoint and cannot be connected again"
		       : NULL;
}

/* The names of recreated sockets. */
static void list_new(const struct files_work *work, struct socket_names *names)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file_socket *s = work->want->file[i].socket;

		if (s && s->domain == AF_UNIX && is_named(s->local_bytes) && !files_now_of(work, i))
			(void)socket_names_add(names, s);
	}
	socket_names_sort(names);
}

/* When all have their names: connects Unix datagram sockets that were recreated, or were connected
 * to one. */
void files_connect_again(struct files_work *work)
{
	struct socket_names new_names = { 0 };

	list_new(work, &new_names);
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];
		int fd;

		if (files_leader(work->want, w) != i || work->kept[i] || !is_connected(w->socket) ||
		    (files_now_of(work, i) && !socket_names_have_peer(&new_names, w->socket)))
			continue;
		(void)budget_step();
		fd = files_borrow_placed(work, w);
		if (fd >= 0)
			files_note(work, w, connect_unix(work, fd, w->socket));
		close_fd(&fd);
	}
	socket_names_free(&new_names);
}
