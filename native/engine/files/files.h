/* SPDX-License-Identifier: Apache-2.0
 *
 * Descriptors: what the app has open at one instant, and how it is restored.
 *
 *   files.c         a table
 *   files_look.c    reads it
 *   files_descriptor.c ... one descriptor
 *   files_inherited.c ... what a child shares with its parent
 *   files_shared.c  ... which descriptors are of one description
 *   files_contents.c ... what is in pipes and sockets
 *   files_capture.c when a checkpoint reads what
 *   files_info.c    what /proc/PID/fdinfo says
 *   files_input.c   unread input, to be dropped
 *   files_late.c    connections that are closed when the application runs again
 *   files_state.c   what is behind a descriptor: offsets, counts, timers, bytes, locks
 *   files_messages.c contents of Unix sockets, and which ends are shut down
 *   files_options.c options of sockets, and whether one can be recreated
 *   files_unix.c    names of Unix sockets
 *   files_strange.c Unix connections to processes outside
 *   files_make.c    reopens and recreates what is lost
 *   files_order.c   descriptors by object, sockets by name
 *   files_restore.c compares two tables and makes the one the other
 *   files_heirs.c   checks what a child shares with its parent
 *   files_family.c  all tables of an app: what its processes share
 *   files_calls.c   what the restored process has to do itself
 *   files_watches.c inotify
 *   files_epoll.c   epoll
 *   files_pipes.c   sizes of pipes
 *   files_video.c   buffers of cameras
 *   files_auto.c    whether a file was written in place (avckpt.files=auto)
 *   files_strict.c  whether a file was written (avckpt.files=strict)
 *   files_mapped.c  the same of files that are mapped
 *   files_written.c the same of files that are not open any more
 *
 * Reading uses a duplicate (pidfd_getfd(2)) that lives for microseconds: while it exists, the app's
 * close(2) does not release the file.  So there are hardly any while the app runs.
 */
#ifndef AVCKPT_FILES_H
#define AVCKPT_FILES_H

#include <signal.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <time.h>

#include "avckpt/engine.h"
#include "state.h"

#define SO_BUF_LOCK_ 72 /* asm/socket.h; a C library may lack it */

/* ---- for the layers above ------------------------------------------------------- */

/* Before a freeze: reads what can be read of the app's descriptors while it runs.  `parent`: a
 * process that was prepared just before, with which it may share many, or NULL. */
int files_prepare(struct process *process, const struct process *parent,
		  struct avc_error *err) warn_unused;
/* During it: reads the state of this instant of all processes, or records why that of one could not
 * be read. */
void files_capture(struct image *image, uint32_t images);
/* Right after it, with the app running again: what children share with their parents, which the freeze
 * has not written down for each of them. */
int files_fill_heirs(struct image *image, uint32_t images, struct avc_error *err) warn_unused;
/* Checks what the freeze left out, in the templates (files_heirs.c).  AVC_RETRY: what a process
 * shares with its parent has changed meanwhile. */
int files_check_heirs(struct image *image, uint32_t images, struct avc_error *err) warn_unused;
/* Whether the heirs of this process may be assumed to be what they were. */
bool files_trusts_heirs(const struct process *process);
/* Those of this one were not: if it has just been started, no other such one is trusted either. */
void files_note_young(struct process *main, const struct process *process);
/* After it. */
void files_settle(struct image *image);
/* Of cameras, in the template (files_video.c). */
void files_unmap_areas(const struct image *image);
/* The same for all processes: which open files they share, and which of them are referred to.
 * `before`: the previous checkpoint's images. */
void files_settle_family(struct image *image, uint32_t images, struct image *before,
			 uint32_t befores);
/* After that: what is open below /proc/PID of the app's own processes. */
void files_find_own(struct image *image, uint32_t images);
void files_forget(struct process *process);
/* Why one that has /dev/fuse open cannot be protected: and whoever exits with a file of its server's
 * open waits for that. */
extern const char files_serves[];
/* Before a process is looked at for the first time: whether it has what cannot be protected.  The
 * descriptors of `parent` (may be NULL) have been looked at already.  -1 with errno: it has ended. */
int files_survey(struct process *process, const struct process *parent,
		 const char **refused) warn_unused;
/* Why a process that has a descriptor of that name cannot be protected, or NULL. */
const char *files_refuses(const char *name);
void files_free(struct files *files);
/* Restores the tables of a dead app: that of the main process, which its templates hold, at once;
 * for the others it fills in image.table.  Lists what the restored processes have to do themselves.
 * What could not be restored is reported in *notes.  Returns the number of descriptors whose input
 * was dropped (config->again); -1 is for fatal errors. */
int files_restore(struct image *image, uint32_t images, const struct avc_config *config, pid_t init,
		  struct avc_error *notes, struct avc_error *err) warn_unused;
/* files_late.c: after files_restore(), the holder of the main process may be busy (process->late): it
 * closes what the restored process must not find open any more.  Before that runs, waits for it; what is
 * left are connections. */
void files_await_late(const struct process *process);
/* Has the holder close all that its table has, and does not wait; it must have one that the application
 * does not use.  False: it was killed, and has nothing open any more. */
bool files_start_closing(const struct process *process);
/* The same, of a table where claims have been looked for (process->late): only what the process `had`. */
bool files_start_closing_claims(const struct process *process, const struct files *had);
/* What the holder of the main process has left (process->late).  Afterwards it is used no more. */
void files_close_late(const struct process *process);
/* A process that is being restored opens its pidfds itself: raises its descriptor limit for that,
 * until it sets the limit again. */
void files_lift_limit(const struct files *want, pid_t pid);
/* A descriptor of that device, as stat(2) numbers it; -1: there is none. */
int files_find_device(const struct files *files, uint32_t rdev);
/* Whether a device or the kernel may write to the process's memory by one of them, unseen by its
 * page table: pages that were pinned before (files_pinned.c). */
bool files_may_pin(const struct files *files);
/* Whether the restored process could do all of it. */
void files_check_calls(const struct parasite *parasite, uint32_t slot, pid_t inside,
		       struct avc_error *notes);
/* -1 if a file was written since, with AVC_UNSUPPORTED and its name.  `pid` is a process that has
 * the table as it is now, `holder` one that has the memory. */
int files_check_strict(const struct image *image, pid_t pid, int pidfd, pid_t init, pid_t holder,
		       struct avc_error *err) warn_unused;

/* Whether the time of day was set since: then a time stamp does not say what came first. */
bool files_clock_was_set(const struct files *files);
/* Whether it looks like a database, as of files_prepare(): writes by other processes matter,
 * too. */
bool files_is_database(const struct process *process);
/* For one that does, whether the image is invalidated by a write to the file `st`. True also if the
 * image does not know the file. */
bool files_is_older(const struct image *image, int fd, const struct stat *st);
/* -1 if its memory belongs to its files, and those were written since, with AVC_UNSUPPORTED and the
 * name.  `pidfd` is that of a process with the current table; -1: no process has it any more. */
int files_check_auto(const struct image *image, int pidfd, pid_t init,
		     struct avc_error *err) warn_unused;

/* files_group.c: connections between apps that are rolled back together.  At a line: lists the ends
 * of a stopped app (NULL: there are none, or no memory); keeps what is in flight, when all members
 * are stopped. */
struct avc_board;
struct group_ends *files_ends_new(const struct image *image, uint32_t images,
				  struct avc_board *board);
void files_ends_keep(struct group_ends *ends, struct avc_board *board);
void files_ends_free(struct group_ends *ends);
/* At a rollback, when all members are dead: discards what others have sent since, and publishes the
 * ends that can be kept; when all members have done that, puts back in flight what was.  Returns how
 * many connections had to be closed, and why the last of them. */
struct group_ended {
	uint32_t count;
	char why[160];
};
void files_ends_show(struct group_ends *ends, struct image *image, uint32_t images,
		     const struct avc_config *config, struct avc_board *board);
struct group_ended files_ends_mend(struct group_ends *ends, struct image *image, uint32_t images,
				   const struct avc_config *config, struct avc_board *board);

/* TCP connections of which both ends are the application's, without a group: it is stopped; later,
 * it is dead.  The others are left alone.  NULL: there are none, or no memory. */
struct group_ends *files_ends_keep_own(const struct image *image, uint32_t images);
void files_ends_mend_own(struct group_ends *ends, struct image *image, uint32_t images,
			 const struct avc_config *config);

/* files_mapped.c: contents of files that are mapped for writing.  Before a freeze; NULL: out of
 * memory. */
struct files_mapped *files_mapped_prepare(pid_t pid, uint64_t limit_bytes, struct leases *leases);
/* While everything is stopped; NULL: nothing. */
void files_mapped_copy(struct files_mapped *mapped);
void files_mapped_free(struct files_mapped *mapped);
int files_mapped_check(const struct image *image, pid_t holder, struct avc_error *err) warn_unused;

/* files_written.c: what is written in the container's mount namespace. */
struct files_written *files_written_new(void);
void files_written_free(struct files_written *written);
/* From now on; *notice if it cannot be. */
void files_written_watch(struct files_written *written, pid_t pid, struct avc_error *notice);
/* Whether a file was written since the last call, and which; inherited ones in `files` (may be
 * NULL) do not count, nor what `counts` (may be NULL: all do) says no to. */
typedef bool files_counts(int fd, const struct stat *st, const void *arg);
bool files_written_since(struct files_written *written, const struct files *files,
			 files_counts *counts, const void *arg, char name[FILES_NAME]);

/* ---- shared by its own files --------------------------------------------- */

enum file_kind {
	FILE_OTHER,
	FILE_REGULAR,
	FILE_DIRECTORY,
	FILE_DEVICE,
	FILE_FIFO, /* with a name                                                */
	FILE_PIPE,
	FILE_SOCKET,
	FILE_EVENTFD,
	FILE_TIMERFD,
	FILE_SIGNALFD,
	FILE_EPOLL,
	FILE_INOTIFY,
	FILE_PIDFD
};

struct file_lock {
	enum { LOCK_FLOCK_, LOCK_POSIX_, LOCK_OFD_ } kind;
	bool exclusive;
	int64_t start, end; /* last byte; -1: to the end of the file */
};

struct file_watch { /* of an epoll set                                         */
	int fd;
	uint32_t events;
	uint64_t data;
	uint64_t dev, ino; /* of what is watched, as encoded by the kernel */
	uint32_t at;       /* of those with this number, in the kernel's order     */
	/* The number of what is watched, which may be closed, or another file's, if another
	 * descriptor is of the same description; -1: of none that is known          */
	int of;
};

struct file_mark { /* of inotify                                               */
	int wd;
	uint32_t mask;
	uint64_t dev, ino; /* as encoded by the kernel */
	uint32_t handle_bytes;
	int handle_type;
	uint8_t handle[128]; /* open_by_handle_at(2)                           */
};

/* A camera with buffers, of V4L2.                                              */
struct file_video {
	uint32_t type, memory, count; /* 0: it has none                           */
	uint64_t held; /* those held by the program, by index; the driver has the others */
};

/* Where a camera's buffers are mapped.                                        */
struct file_area {
	avc_remote start;
	uint64_t bytes, offset;
	int protection, fd;
};

struct file_socket {
	uint32_t others; /* other tables that have it */
	int domain, type, protocol;
	bool listening, connected;
	bool idle;       /* has never been connected, and does not listen                    */
	bool connecting; /* of TCP: a connect(2) is under way                             */
	int backlog;     /* -1: not read yet */
	uint8_t shut;    /* of a pair's end: SHUT_IN, SHUT_OUT                          */
	/* For those that can be recreated: file_socket_is_alone() */
	uint32_t uid, gid;
	struct file_option *option; /* files_options.c, allocated               */
	size_t option_bytes;
	struct file_node *node; /* files_unix.c, allocated, NULL: none or not known */
	uint64_t peer;          /* inode of the other end of a Unix socket, 0: not known    */
	bool asked;             /* for that                                               */
	socklen_t local_bytes, remote_bytes;
	struct sockaddr_storage local, remote;
};

/* Of a process, as of the checkpoint, in our own user namespace. */
#define RIGHTS_GROUPS STATUS_GROUPS
struct file_rights {
	bool known;
	uint32_t user, group;
	uint64_t caps; /* effective                                             */
	int group_count;
	uint32_t groups[RIGHTS_GROUPS];
};

/* A descriptor in flight (SCM_RIGHTS). */
struct file_flight {
	uint32_t at, end; /* in the contents: what it came with; 0: to the end       */
	uint64_t dev, ino;
	uint32_t mode;
	int flags;                  /* F_GETFL                                   */
	int domain, type, protocol; /* of a socket                             */
};

struct file {
	int fd;
	enum file_kind kind;
	uint64_t dev, ino, rdev;
	uint64_t id; /* of an eventfd, 0: unknown */
	uint32_t mode;
	int flags; /* F_GETFL                                                       */
	bool cloexec;
	int ours;     /* our duplicate, for as long as a look takes; 0: none            */
	bool outside; /* its open file description is also init's                  */
	int shared;   /* lowest fd with the same open file description             */
	/* The first one, of all processes, that shares it; NULL: only this process */
	const struct file *family;
	bool known; /* the same object as in `known` of files_look(); at a restore
		       * the name and what does not change is left to that   */
	char *name; /* as from readlink(2), allocated */
	/* F_GETOWN_EX: in our namespace, and in its own (0: not the app's); F_GETSIG */
	int owner_type, owner, owner_inside, owner_signal;
	int64_t offset; /* -1: it has none                                          */
	int64_t bytes;  /* size of the file                                         */
	struct timespec modified, changed;
	/* eventfd */
	uint64_t count;
	bool semaphore;
	/* timerfd: when it expires next, by its own clock; 0: never */
	int clock, settime_flags;
	uint64_t ticks, deadline_ns, interval_ns;
	uint64_t mask; /* signalfd                                                  */
	/* pidfd: in our namespace */
	pid_t pid;
	/* Of a pidfd, or a file below /proc/PID: the process or thread of the app, in its own
	 * namespace.  The restored process opens it anew. */
	pid_t pid_inside;
	uint32_t watch_count;
	struct file_watch *watch; /* epoll, allocated                              */
	uint32_t mark_count;
	struct file_mark *mark; /* inotify, allocated                              */
	bool unread;            /* it has unread events */
	/* As in fdinfo */
	int told_flags;
	uint64_t told_ino;
	int64_t told_offset;
	struct file_lock *lock; /* allocated                                     */
	uint32_t lock_count;
	int pipe_bytes;             /* F_GETPIPE_SZ; -1: it does not answer              */
	bool remote;                /* a network file system: no requests while frozen */
	uint64_t mount;             /* on which that was found; 0: not known           */
	bool lock_unsure;           /* flock(2) may have been called just around the freeze   */
	struct file_socket *socket; /* allocated                                   */
	uint64_t tcp_written, tcp_taken; /* bytes, by the app                      */
	uint64_t tcp_unread;             /* received, and not read yet */
	bool tcp_counted;                /* these three are exact                  */
	bool tcp_failed;                 /* it has an error that was not read yet (SO_ERROR) */
	int tcp_state; /* 0: no connection over a network                           */
	/* In the middle of a message, as far as known (files_stream.c) */
	bool tcp_coming, tcp_going;
	bool accepted; /* at a restore: it is a server's (files_find_accepted())   */
	bool goes_on;  /* at a restore: its other end was rolled back, too (files_group.c) */
	bool strange;  /* at a restore: a Unix connection to a process outside of the app  */
	/* What can be read from it, when its other end is the app's own as well   */
	uint8_t *content; /* of messages: each with its length in front, uint32_t  */
	uint32_t content_bytes;
	bool content_lost; /* it had contents that cannot be restored */
	bool ended;        /* its other end is closed: its contents are final */
	uint8_t shut;      /* at a restore, of a socket of now: SHUT_IN, SHUT_OUT      */
	bool rights_lost;  /* descriptors in flight (SCM_RIGHTS)                     */
	bool senders_lost; /* readers see the sender (SCM_CREDENTIALS) */
	uint64_t rights;   /* a hash of these, as far as known; 0: none */
	/* Those, allocated */
	struct file_flight *flight;
	uint32_t flight_count;
	struct file_video video;
	/* The same open file description in `parent` of files_look(); NULL: not known to be.
	 * Afterwards only in the images of a freeze, where all are at the same time. */
	const struct file *inherited;
	bool heir; /* of a read before a freeze: it was one */
};

/* What is not where it was. */
struct files_missing {
	uint32_t count;
	const struct file **file; /* by dev and ino                              */
	bool port;                /* one of them is a socket that listens            */
};

struct files {
	uint32_t others; /* who have it, too                                          */
	uint32_t count, room;
	const struct file **ends; /* pipes and sockets by inode, built on demand: allocated */
	uint32_t end_count;
	/* Of a read before a freeze: its number and that of the parent's, from which the heirs are;
	 * which are no heirs, by index (allocated); and whether some were not compared again. */
	uint64_t number, parent_number;
	uint32_t *own, own_count;
	bool reused;
	bool trusted; /* its heirs were not read in the freeze */
	/* In a freeze: heirs of this one are not in here yet (files_fill_heirs()); NULL: all are. */
	struct files *heirs;
	/* What children cannot have from here unseen, ascending (allocated), and whether it is known. */
	int *varied;
	uint32_t varied_count;
	bool varied_known;
	int64_t open;           /* at a restore: how many the table has; 0: unknown     */
	uint64_t mounts;        /* mounts_stamp(), when that was found out: */
	bool served;            /* some file system may be a file server's                 */
	bool several;           /* other processes may have the other ends of pipes        */
	bool with_tcp;          /* count the bytes of connections, during a freeze, too      */
	uint64_t taken_ns;      /* CLOCK_REALTIME                                       */
	uint64_t boot_ns;       /* CLOCK_BOOTTIME at that instant                       */
	struct file *file;      /* by fd, ascending                                     */
	struct file_area *area; /* allocated                                       */
	uint32_t areas;
	/* A table that has just been read in the same way.  What this one shares with it, as
	 * children do with their parents, is not read again. */
	const struct files *parent;
	pid_t parent_pid;
	uint32_t *ours;          /* during a freeze: duplicates, of all tables      */
	struct process *process; /* likewise                                       */
	struct file_rights rights;
	/* At a restore: of what is not in `known`, only what may be one of these is read. */
	const struct files_missing *missing;
};

struct files_work;
struct tcp_info;

enum files_depth {
	FILES_BEFORE, /* everything that does not change; the app runs */
	FILES_FROZEN, /* the state of this instant; the rest from `known` */
	FILES_NOW     /* at a restore: what may have changed since `known`          */
};

/* files.c */
struct files *files_new(uint32_t room);
struct file *files_find(const struct files *files, int fd);
bool files_same_object(const struct file *a, const struct file *b);
/* Orders them by the object: file, socket, pipe, ...; 0: the same, opened for the same. */
int files_compare(const struct file *a, const struct file *b);

/* files_order.c */
struct files_order {
	const struct file **file;
	uint32_t *next; /* of the first of an object: how many are not free any more */
	uint32_t count;
};

bool files_order(struct files_order *order, const struct files *files);
void files_order_free(struct files_order *order);
/* One of the same object as `like` that is free, by number; it will not be asked for again. */
const struct file *files_order_take(struct files_order *order, const struct file *like,
				    bool (*is_free)(const struct file *file, const void *arg),
				    const void *arg);
/* Any end of that pipe. */
const struct file *files_order_pipe(const struct files_order *order, uint64_t ino);

struct socket_names {
	const struct file_socket **socket;
	uint32_t count, room;
};

bool socket_names_add(struct socket_names *names, const struct file_socket *socket);
/* After the last, and before one is sought. */
void socket_names_sort(struct socket_names *names);
/* Whether one of them has the name that `socket` is connected to. */
bool socket_names_have_peer(const struct socket_names *names, const struct file_socket *socket);
void socket_names_free(struct socket_names *names);

/* files_look.c */
/* Whose they are. */
struct files_owner {
	pid_t pid;
	int pidfd;
	pid_t init;
	bool reuses;     /* what was found before need not be compared again */
	uint8_t *likely; /* process->heirs_likely                          */
	int likely_count;
};
/* `files->parent` may be set. */
int files_look(struct files *files, const struct files_owner *owner, enum files_depth depth,
	       struct files *known, struct avc_error *err) warn_unused;
/* Sorts them. */
void files_missing_sort(struct files_missing *missing);

/* files_capture.c */
/* In a freeze: the table, but for sizes and contents. */
static inline bool files_are_read(const struct image *image)
{
	return image->process && !image->files_error.code;
}

/* files_shared.c */
/* Finds out which of them are of the same open file description: `first` is the first of
 * those.  They are sorted anew. */
struct files_held {
	struct file *file;
	const struct file *before; /* the same in the checkpoint before, or NULL       */
	pid_t pid;                 /* the process that has it */
	uint32_t number;
	struct file *first;
};
void files_group(struct files_held *held, uint32_t count);
/* Since it was read. */
bool files_is_closed(const struct files_held *held);

/* files_info.c */
/* fdinfo of a descriptor: O_CLOEXEC, locks, and what is in anonymous inodes.  True if
 * it says that it is of that kind. */
bool file_read_info(pid_t pid, struct file *file);
/* The same of the text, which it changes. */
bool file_parse_info(struct file *file, char *text);
/* Of an eventfd of ours. */
uint64_t file_count(int fd);

/* files_messages.c */
#define CONTENT_MAX (1 << 20)
/* Reads the contents of a Unix socket, of so many bytes. */
void file_keep_messages(struct process *process, int fd, struct file *file, uint32_t bytes);
/* Whether that is unchanged.  At a restore. */
bool file_has_messages(int fd, const struct file *want);
/* Closing a descriptor may be a request to a file server: files_land() does it. */
void file_close_later(int fd);
/* Closes these, and those that came with peeked messages: not in a freeze. */
void files_land(void);
/* As shutdown(2) has left it, of one of ours whose process is dead. */
#define SHUT_IN 1
#define SHUT_OUT 2
uint8_t file_shut(int fd);

/* files_state.c */
/* How often a count is read at most, to lower it to what it was. */
#define FILE_COUNT_READS 1000
void file_look_at_socket(int fd, struct file *file);
void file_look_at_tcp(int fd, struct file *file, const struct file_socket *socket);
void files_find_peers(struct files *files, pid_t pid);
/* Whether it, or what it is connected to, was bound. */
bool file_has_name(const struct file_socket *socket);
/* Whether both ends of this pipe or socket pair are in the table. */
const struct file *files_other_end(struct files *files, const struct file *file);
/* Our own pipe, through which others are read; { -1, -1, 0 } at first. */
struct scratch {
	int in, out, bytes;
};
void file_keep_content(struct process *process, int fd, struct file *file, struct scratch *scratch);
void scratch_close(struct scratch *scratch);
/* Whether it has POSIX or OFD locks; and its file system. */
bool file_is_locked(int fd);
bool file_is_remote(int fd);
/* Whether it is no file but memory (memfd_create(2)); its name does not tell. */
bool file_is_memory(const struct file *file);
/* Puts the state of `want` into the descriptor `fd` of ours, which shares the app's
 * open file description; `now` is what it is (NULL: fresh). Returns NULL or why not. */
const char *file_put_state(int fd, const struct file *want, const struct file *now, bool rewind);
/* Reads what is in it; a pipe has to be O_NONBLOCK.  False if it does not become empty: a process outside
 * of the application keeps writing. */
bool file_drain(int fd, bool pipe);
/* As send(2), with `count` descriptors.  The kernel tells readers who has sent it (SO_PASSCRED,
 * unix(7)): that is not known any more, but it was not us. */
ssize_t file_send_as_nobody(int fd, const void *data, size_t bytes, const int *passed,
			    uint32_t count);
/* `passed`: descriptors of ours for want->flight, -1: lost; NULL: all are. */
const char *file_put_content(int fd, int other_fd, const struct file *want, const int *passed);
bool file_tcp_moved(const struct file *want, const struct file *now);
/* 0: no internet address, or it has none. */
uint32_t address_port(const struct sockaddr_storage *address);
/* Which ones belong to a server: a port on which the app listens. */
void files_find_accepted(struct files *files);
/* Whether it is a client's, and its peer may have had more to say: the end of file would make what was
 * received so far count as complete (HTTP/1.0, FTP), and without an error some wait on who poll for a
 * connection.  A server knows the end of a request by its contents; not all survive an error. */
bool file_tcp_is_cut(const struct file *file);
const char *file_reset_tcp(int fd);
/* The same, with the error of a connection that was reset (ECONNRESET), also if it is none any more: it
 * is connected to nobody before, without a packet (TCP_REPAIR). */
int file_break_tcp(int fd, int domain);
/* The one or the other. */
const char *file_lose_tcp(int fd, const struct file *want);

/* files_options.c */
/* Takes a reference; may be NULL. */
struct file_socket *file_socket_share(struct file_socket *socket);
void file_socket_free(struct file_socket *socket);
/* Whether it can be recreated: it needs no peer. */
bool file_socket_is_alone(const struct file_socket *socket);
/* What only matters if it has to be recreated: options, user, the file of its name. */
void file_look_at_options(int fd, struct file_socket *socket, pid_t init);
/* Whether that reads any. */
bool file_socket_has_options(const struct file_socket *socket);
/* Whether one that was idle has got a name or a connection since. */
bool file_socket_was_used(int fd, const struct file_socket *socket);
/* Whether a connect(2) of TCP is under way. */
bool file_is_connecting(int fd, const struct file_socket *socket);
/* Whether getsockname(2) says the same of `fd`. */
bool file_socket_has_name(int fd, const struct file_socket *socket);
/* Sets those that differ.  Returns NULL or what failed. */
const char *file_put_options(int fd, const struct file_socket *socket);

/* files_strange.c: sets `strange` of all, as the configuration says. */
void files_find_strange(const struct image *image, uint32_t images,
			const struct avc_config *config);

/* files_unix.c */
bool file_unix_is_alone(const struct file_socket *socket);
/* Where the file of its name is, and whose. */
void file_look_at_node(int fd, struct file_socket *socket, pid_t init);
/* Whether that file was deleted since. */
bool file_unix_is_deleted(int fd, const struct file_socket *socket);
/* Whether it is connected to a D-Bus: a program that asks one numbers its requests, and most end when
 * they lose it. */
bool file_unix_is_bus(const struct file_socket *socket);
/* `template` resolves names as the app did. 0, or -1 and *why; *why may be set on success as well:
 * what differs. */
int file_bind_unix(int fd, const struct file_socket *socket, pid_t template, pid_t init,
		   const char **why) warn_unused;
/* When all have their names: connects datagram sockets that were recreated, or were connected to
 * one. */
void files_connect_again(struct files_work *work);

/* files_stream.c */
/* Whether bytes are arriving; whether some to be sent did not fit. */
bool file_is_coming(int fd);
bool file_was_coming(const struct tcp_info *info, int unread);
bool file_is_going(int fd);
/* Finds in epoll sets which sockets are waited on for writing. */
void files_find_going(struct files *files);
/* avckpt.tcp=messages: a connection that a restore leaves between two messages is kept, one that
 * can be brought there is, any other is reset.  Returns NULL or what failed. */
const char *file_put_stream(int fd, const struct file *want, const struct file *now);

/* files_pipes.c */
/* Of all that are not shared with init. */
void files_measure_pipes(struct image *image, uint32_t images);

/* files_input.c */
/* Drops what has not been read from `fd`, a descriptor of ours; whether there was something.  `inside`: the
 * app has the other end of it. */
bool file_drop_input(int fd, const struct file *file, bool inside);
/* Resets the connections that wait to be accepted; whether there were any. */
bool file_turn_away(int fd);
/* Reads what is in a socket, and forgets it; whether there was something.  Messages may be empty; `ends`:
 * nothing means that the other end is closed. */
bool file_empty_socket(int fd, bool ends);

/* files_watches.c */
/* Gives the inotify descriptor `fd` of ours the watches of `want`; `now` is what it is
 * (NULL: fresh).  Returns NULL or why not all of them. */
const char *file_put_marks(int fd, const struct file *want, const struct file *now, pid_t init);

/* files_video.c */
bool file_is_video(const struct file *file);
/* Only the descriptor that streams has buffers, not others of the same camera. -1: it does not
 * answer before the guard's deadline. */
int file_look_at_video(int fd, struct file_video *video) warn_unused;
/* May wait until the camera has filled buffers that were queued since.  Returns NULL or what
 * failed. */
const char *file_put_video(int fd, const struct file_video *want);
void files_find_areas(struct files *files, pid_t pid);

/* files_rights.c */
/* Ours, while we have others. */
struct file_rights_own {
	uint32_t user, group;
	int group_count;
	uint32_t groups[RIGHTS_GROUPS];
};
/* `status`: that process's. */
void file_rights_note(struct file_rights *rights, pid_t pid, const struct proc_status *status);
/* The calling thread opens files as that process would, until it switches back; nothing else may be
 * done in between. -1: it cannot, and nothing has changed. */
int file_rights_take(const struct file_rights *rights, struct file_rights_own *own) warn_unused;
void file_rights_give_back(const struct file_rights_own *own);
/* socketpair(2) of a type, or pipe2(2) for 0, as that process would call it: the kernel tells
 * whoever has one of these sockets who did (unix(7), SO_PEERCRED). */
int file_rights_pair(const struct file_rights *rights, int type, int ends[2]) warn_unused;

/* files_make.c */
/* The slave side of a pseudoterminal. */
bool file_is_pts(const struct file *file);
/* The file that it was, by its path: an O_PATH descriptor, or -1.  With our own rights if `rights` is
 * NULL. */
int file_open_path(const struct file *want, pid_t init, const struct file_rights *rights);
/* The file that it was, by its path or because it is still mapped: an O_PATH descriptor; or -1, with
 * errno: ESTALE if another one has its name. */
int file_find(const struct file *want, pid_t template, pid_t init);
/* A new socket in the network namespace of that process: another one would give it a way into ours. */
int file_socket_of(pid_t pid, int domain, int type, int protocol);
/* A descriptor of ours for what is not in the table any more, or -1 with *why.  *why may be set on
 * success as well: what differs. */
int file_make(const struct file *want, pid_t template, pid_t init, const struct file_rights *rights,
	      const char **why);
/* Both ends of a pipe or socket pair; of a pipe the one to read from comes first. */
int file_make_pair(const struct file *want, const struct file *other,
		   const struct file_rights *rights, int ends[2]);

/* files_restore.c and files_calls.c */
/* One restore of a table: from `now` to `want`. */
struct files_work {
	struct process *process;
	struct image *image;
	const struct avc_config *config;
	pid_t init;
	/* A task that has the table as it was at the death: the template, or the holder;
	 * 0: the table is gone. */
	pid_t table;
	int table_pidfd;
	struct files *want, *now;
	struct files_order order; /* of now                                              */
	int *local;               /* of want, by group leader: a descriptor of ours, or -1  */
	int *claimed_by;          /* of now: leader (index in want) of the group that has it */
	int *source;              /* of want, by group leader: index in now, or -1          */
	bool *closed;             /* of now: by us                                          */
	bool *lost;               /* of want: has to be restored */
	bool *kept;               /* of want: inherited from the process that forks it */
	struct files_work *host;  /* of which process that is; NULL: none            */
	uint32_t listed;          /* calls for the template, not made yet */
	bool busy;                /* the task makes calls */
	uint32_t problems;
	struct avc_error *notes;
};

int files_work_begin(struct files_work *work, struct avc_error *err) warn_unused;
/* Afterwards the holder of a descendant is busy; to be halted, and then awaited. */
int files_work_gather(struct files_work *work, struct avc_error *err) warn_unused;
int files_work_halt(struct files_work *work, struct avc_error *err) warn_unused;
int files_work_await(struct files_work *work, struct avc_error *err) warn_unused;
int files_work_place(struct files_work *work, struct avc_error *err) warn_unused;
void files_work_finish(struct files_work *work);
int files_work_table(const struct files_work *work, struct fd_table *table,
		     struct avc_error *err) warn_unused;
void files_work_end(struct files_work *work);
/* A duplicate of what is at this place of the table now. */
int files_borrow_placed(const struct files_work *work, const struct file *w);
/* Makes the listed calls. */
int files_work_flush(struct files_work *work, struct avc_error *err) warn_unused;
void files_note(struct files_work *work, const struct file *f, const char *problem);

/* Before the listed calls close what is new: leaves thousands of connections to the holder. */
void files_take_late(const struct files_work *work);
/* Whether to do so: what has a number below is looked at.  0: it is not worthwhile, or not possible. */
uint64_t files_looked_at(const struct files_work *work);

uint32_t files_index(const struct files *files, const struct file *file);
/* Index of the first descriptor of the same open file description. */
uint32_t files_leader(const struct files *files, const struct file *file);
/* What is `want`'s i-th already, or NULL if it is made anew. */
const struct file *files_now_of(const struct files_work *work, uint32_t i);
void files_list_calls(struct files_work *work);

/* files_epoll.c */
/* After a freeze: finds out what is watched under a number that no longer belongs to it. */
void files_find_closed(struct files *files, pid_t pid);
/* What the set `now` (may be NULL) watches just as `watch` says, or NULL. */
const struct file_watch *files_find_watch(const struct file *now, const struct file_watch *watch);
/* Whether there are calls of files_list_epoll() that take a number beyond the last. */
bool files_watch_closed(const struct files *files);
/* Sets that cannot be restored in place are recreated. */
int files_give_up_sets(struct files_work *work, struct avc_error *err) warn_unused;
void files_list_epoll(const struct files_work *work, struct setup *setup, const struct file *w,
		      const struct file *n);

#endif
