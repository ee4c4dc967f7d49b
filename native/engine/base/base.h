/* SPDX-License-Identifier: Apache-2.0
 *
 * The lowest of the engine's layers: errors, /proc, real-time priority. It knows nothing about
 * applications.
 *
 * Everything in the engine runs in the guard's main thread unless said otherwise: a process can
 * only be traced by one thread.  A layer's header includes those below it, and no layer calls one above
 * (native/layers.py).
 *
 *   error.c         errors
 *   config.c        validity of settings
 *   heartbeat.c     the guard's sign of life
 *   budget.c        what one checkpoint or restore may cost
 *   aside.c         calls that may block forever
 *   proc.c          /proc
 *   proc_text.c     parsers of its files
 *   opens.c         files that a container names, or has
 *   cpu_clock.c     the scheduler's per-CPU clocks
 *   pagemap.c       which pages of a process are present
 *   pageset.c       sets of them
 *   rt_priority.c   a CPU at once while an app waits for us
 *   CPU/arch.c      everything about the CPU
 */
#ifndef AVCKPT_BASE_H
#define AVCKPT_BASE_H

#include <poll.h>
#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <time.h>

#include "arch.h"
#include "avckpt/engine.h"
#include "avckpt/error.h"

#define NS_PER_MS UINT64_C(1000000)
#define NS_PER_S UINT64_C(1000000000)
#define SIGNAL_BIT(signal) (UINT64_C(1) << ((signal)-1))
#define CHILDREN_MAX 4096 /* of init: orphans, holders and templates, too   */

#define warn_unused __attribute__((warn_unused_result))

/* The first index i below `count` of which `before`, an expression of i, is false; `count`: of none.
 * It is true of all before that one, and of none after it. */
#define LOWER_BOUND(count, i, before)                                 \
	({                                                            \
		uint32_t low_ = 0, high_ = (count);                   \
		while (low_ < high_) {                                \
			const uint32_t i = low_ + (high_ - low_) / 2; \
			if (before)                                   \
				low_ = i + 1;                         \
			else                                          \
				high_ = i;                            \
		}                                                     \
		low_;                                                 \
	})

/* ---- error.c --------------------------------------------------------------- */

/* Fills *err in unless it holds an error already.  Always returns -1. */
int fail(struct avc_error *err, enum avc_code code, int errnum, pid_t pid, const char *operation,
	 const char *syscall, const char *detail, ...) __attribute__((format(printf, 7, 8)));
/* The same with the code that suits errno: ESRCH gone, EPERM denied, else kernel.  Of a shortage it
 * says that instead of `detail`. */
int fail_errno(struct avc_error *err, pid_t pid, const char *operation, const char *syscall,
	       const char *detail, ...) __attribute__((format(printf, 5, 6)));
/* malloc(3) and the like have failed, perhaps some calls ago. */
int fail_memory(struct avc_error *err, pid_t pid, const char *operation);
/* Whether it means that we, or the machine, have no descriptors or memory left: which says nothing
 * about the process that was looked at. */
bool is_shortage(int errnum);
/* What a call has returned that opens (-1, errno), or allocates (NULL), as it is.  A shortage is remembered
 * until shortage_begin(), because most callers do without what they do not get. */
int got_fd(int fd);
void *got_memory(void *memory);
/* The same where the errno may also mean a limit of the user's (inotify(7)), or whatever a driver wants:
 * only if there is no other descriptor, either. */
int got_limited_fd(int fd);
void shortage_begin(void);
/* -1 if there was one since: *err says so, whatever it has said of what followed. */
int shortage_check(struct avc_error *err, const char *operation) warn_unused;
uint64_t now_ns(void);
struct timespec timespec_of(uint64_t ns);
uint64_t timespec_ns(const struct timespec *t);
/* 0 if the clock cannot be read. */
uint64_t clock_ns(clockid_t clock);
void close_fd(int *fd);
/* Like poll(2), and for as long although a signal comes: the timer of a deadline (trace.h) ticks
 * meanwhile, and with one pending poll(2) fails even if it is not to wait (fs/select.c, do_poll()). */
int poll_for(struct pollfd *fds, uint32_t count, uint64_t ns);
/* Returns the bytes read; -1: unreadable. */
ssize_t read_whole(int fd, uint8_t *to, size_t bytes, off_t at);
/* Room for one more element of `bytes` in *array, which has `count`; false: out of memory,
 * and nothing has changed. */
bool make_room(void *array, uint32_t count, uint32_t *room, size_t bytes);
/* Of `before` and these; for what nobody gains by a collision (else keyed_sum()). */
uint64_t hash_bytes(uint64_t before, const void *data, size_t bytes);

/* ---- keyed_sum.c ------------------------------------------------------------ */

/* Of `before` and words of 64 bits, by a key of this process: SipHash-2-4. */
uint64_t keyed_sum(uint64_t before, const void *words, size_t count);

/* ---- heartbeat.c ------------------------------------------------------------ */

/* Takes the memory for it, and closes the descriptor.  0 or -1. */
int heartbeat_open(int fd) warn_unused;
/* A sign of progress: the daemon kills a guard that has been silent for seconds. */
void heartbeat(void);
/* The guard sleeps until then, CLOCK_MONOTONIC; 0: it is awake again. */
void heartbeat_rest(uint64_t until_ns);

/* ---- budget.c --------------------------------------------------------------- */

/* Begins a checkpoint or restore. `working` is called periodically; may be NULL. */
void budget_begin(void (*working)(void *arg), void *arg);
/* Sets the time left from now; 0: unlimited. */
void budget_deadline(uint64_t ns);
/* Marks it as exceeded, for that reason (a static string). */
void budget_exceed(enum avc_code code, const char *what);
/* Memory that is to be kept: takes it if there is room. budget_has() only checks. */
bool budget_has(uint64_t bytes);
bool budget_take(uint64_t bytes);
/* Progress. False when the budget is exceeded. */
bool budget_step(void);
/* To be called in each wait for somebody else, which is work, too.  False: it is in vain. */
bool budget_wait(void);
/* -1 with that code and the reason as text when it is exceeded. */
int budget_check(pid_t pid, struct avc_error *err) warn_unused;

/* Between the two nothing of the application is alive that waiting could harm.  So whoever gets no CPU
 * is waited for, and a generation is not given up because a step of its restore is late.  `until_ns`:
 * when a restore would come too late, CLOCK_MONOTONIC; 0: never. */
void restore_patience_begin(uint64_t until_ns);
void restore_patience_end(void);
/* The container has ended meanwhile: all waits end at once. */
void restore_is_in_vain(void);
/* How long to wait for a step that is otherwise given so long: the same in a checkpoint. */
uint64_t restore_patience(uint64_t ns);

/* ---- aside.c ---------------------------------------------------------------- */

/* The head of a job, in its own memory. */
struct aside {
	void (*work)(struct aside *job);
	void (*drop)(struct aside *job); /* frees it: no thread waits for it any more */
	int *left_behind;                /* set while a job of this kind is left behind */
};

/* Runs it in a separate thread. False: a step took too long, and job->drop() is called as soon as
 * it ends; or at once, while another job of its kind is left behind. Main thread only. */
bool aside_run(struct aside *job, uint64_t ns);
/* The calling thread makes progress with its job, if it has one. */
void aside_step(void);
/* Whether the main thread no longer waits for this thread. */
bool aside_is_left_behind(void);

/* ---- cpu_clock.c ------------------------------------------------------------ */

/* Converts a time by the scheduler's clock of that CPU to CLOCK_MONOTONIC. The result may be late,
 * but never early. 0: unknown, for instance because the CPU is too busy. Main thread only. */
uint64_t cpu_clock_when(uint32_t cpu, uint64_t ran_ns);
/* A thousandth less: the scheduler's clocks are not adjusted as CLOCK_MONOTONIC is. */
uint64_t cpu_clock_least(uint64_t ns);

/* ---- config.c -------------------------------------------------------------- */

int config_check(const struct avc_config *config, struct avc_error *err) warn_unused;

/* ---- proc.c ---------------------------------------------------------------- */

struct proc_stat {
	char state;
	pid_t parent, group, session, tty_group;
	uint32_t tty, flags; /* PF_*                                            */
	int threads;
	uint64_t faults; /* minor faults, of all its threads */
	uint64_t start;  /* clock ticks after boot                            */
	int exit_signal; /* sent to its parent when it exits, 0: none */
	uint32_t cpu;    /* the one it runs on, or ran on last */
	int exit_status; /* of a zombie, as from wait(2) */
	char name[16];
};

/* Reads a whole small file of /proc.  Returns its length or -1 with errno. */
ssize_t proc_read(pid_t pid, const char *name, char *buf, size_t size);
/* Reads a whole file of one record (status, fdinfo), as a string: into `first` if that is large
 * enough, else allocated, because the application determines its length. NULL with errno; EFBIG: too
 * long. */
#define PROC_TEXT_MAX (8u << 20) /* about 100,000 watched descriptors, or 60,000 files */
char *proc_text(pid_t pid, const char *name, char *first, size_t first_bytes);
int proc_stat(pid_t pid, struct proc_stat *stat);
/* The first write to a page that others have mapped, too (first_write.c). */
uint64_t first_write_ns(void);
/* The CPU time of all threads of a process so far; 0: it is gone. */
uint64_t proc_cpu_ns(pid_t pid);
/* From an open /proc/PID/stat, which refers to that very process: -1 when it is gone. */
int proc_stat_of(int stat_fd, struct proc_stat *stat);
/* The number of a task in its own (innermost) PID namespace, or -1. */
pid_t proc_inside(pid_t tid);
/* A live thread of the process: the main thread, if it has not exited.  0: none (errno ESRCH), or it
 * cannot be seen (any other). */
pid_t proc_live_thread(pid_t pid);
/* Waits until that thread has exited; a second at most. */
void proc_await_end(pid_t tid);
/* Children of a (single-threaded) process; returns how many (at most max), or -1. */
int proc_children(pid_t pid, pid_t *children, int max);
/* The same for one thread, from the open /proc/PID/task of its process. */
int proc_children_of(int task_dirfd, pid_t tid, pid_t *children, int max);
/* Calls fn for every number in an open directory of /proc (PID/task, PID/fd) from its start; stops when
 * it returns < 0, with -1. */
int proc_numbers(int dirfd, int (*fn)(pid_t number, void *arg), void *arg);
/* Whether two tasks have the same memory (kcmp(2)). */
bool proc_same_memory(pid_t a, pid_t b);
/* Likewise the same descriptor table, or the same working directory and umask: 1 or 0; -1: unknown.
 * An exiting task has none. */
enum shared { SHARED_FILES, SHARED_FOLDERS };
int proc_shares(pid_t a, pid_t b, enum shared what);
/* How many threads there are, by an open /proc/PID/task; 0: the process is gone. */
int proc_thread_count(int task_dirfd);
/* Size of the address space in pages, by an open /proc/PID/statm, or -1; *anonymous (may be
 * NULL): how many are resident and of no file. */
long proc_vm_pages(int statm_fd, long *anonymous);
/* How many pages it shares with no other process (slow: reads its page tables), or -1. */
long proc_private_pages(pid_t pid);
/* How many pages the host has for programs, without swapping, or -1. */
long proc_host_available(void);
/* The PID of a pidfd, in our namespace, or -1. */
pid_t proc_pidfd_pid(int pidfd);
int proc_pidfd_open(pid_t pid);
/* readlink(2) of "/proc/PID/NAME", as a string.  0 or -1. */
int proc_link(pid_t pid, const char *name, char *buf, size_t size);
/* statx(2) of "/proc/PID/NAME", and of a descriptor of ours, without a request to a file server. */
bool proc_look(pid_t pid, const char *name, unsigned int what, struct statx *st);
bool fd_look(int fd, unsigned int what, struct statx *st);
/* An integer option, getsockopt(2); -1: it has none of that name. */
int fd_option(int fd, int level, int name);
/* A device as in struct mapping. */
static inline uint64_t device_number(unsigned int major, unsigned int minor)
{
	return (uint64_t)major << 32 | minor;
}
static inline uint64_t device_of(const struct statx *st)
{
	return device_number(st->stx_dev_major, st->stx_dev_minor);
}
/* Whether that link of both leads to the same file: 1 or 0; -1: unknown.  Asks no file server. */
int proc_same_file(pid_t a, pid_t b, const char *name);
/* It is exiting, and may have closed its descriptors already.  Not if it cannot be seen (is_shortage()):
 * then neither this nor proc_is_killed() says that it ends. */
bool proc_is_exiting(pid_t tid);
/* Whether it was killed by SIGKILL, even if it has not exited yet. */
bool proc_is_killed(pid_t pid);
/* The kernel writes its core. */
bool proc_is_dumping(pid_t pid);
/* Whether a signal is killing it, by an open /proc/PID/stat; the kernel may be writing its core. */
bool proc_is_dying(int stat_fd);
bool pidfd_ended(int pidfd);
/* Waits for that, so long or as long as a restore waits; false: it has not ended. */
bool pidfd_await_end(int pidfd, uint64_t ns);
enum mapping_flag {
	MAPPING_DONTFORK = 1,     /* dc */
	MAPPING_WIPEONFORK = 2,   /* wf */
	MAPPING_DEVICE = 4,       /* io */
	MAPPING_LOCKED = 8,       /* lo */
	MAPPING_DROPPABLE = 16,   /* dp */
	MAPPING_HUGETLB = 32,     /* ht */
	MAPPING_HUGE = 64,        /* hg: transparent huge pages               */
	MAPPING_SMALL = 128,      /* nh */
	MAPPING_DONTDUMP = 256,   /* dd */
	MAPPING_MERGEABLE = 512,  /* mg */
	MAPPING_GROWING = 1024,   /* gd: downwards                           */
	MAPPING_SEALED = 2048,    /* sl: mseal(2)                            */
	MAPPING_ONLY_HERE = 4096, /* no other process could map it: memory.c */
	MAPPING_SPECIAL = 8192,   /* mapping_is_special()                    */
	MAPPING_FIXED = 16384,    /* de, pf, mm: a driver's, or huge pages   */
	MAPPING_TAGGED = 32768,   /* mt: aarch64's MTE                       */
	MAPPING_KEYS = 15 << 16   /* the number of its protection key (pkeys(7)) */
};
#define MAPPING_KEY_ONE (1 << 16)

struct mapping {
	avc_remote start, end;
	uint64_t offset, inode, device;
	char mode[5]; /* "rwxp"                                           */
	bool shared;
	uint32_t flags; /* enum mapping_flag; of "smaps", or of an image    */
	char name[64];  /* its beginning                                    */
};

/* Opens a file of many lines.  The kernel fills a page for each read(2), if there is room. */
#define PROC_LINES 4096
FILE *proc_lines(pid_t pid, const char *name, char buffer[PROC_LINES]);
/* Calls fn for every mapping of /proc/PID/maps or (slow) smaps; stops when it
 * returns < 0.  0 or -1. */
int proc_mappings(pid_t pid, const char *file, int (*fn)(const struct mapping *mapping, void *arg),
		  void *arg);

/* The vDSO, or a mapping that belongs to it. */
bool mapping_is_special(const struct mapping *m);
/* As mmap(2) has it. */
int mapping_protection(const struct mapping *m);

/* /proc/PID/limits, as getrlimit(2) numbers them; ~0: no limit.  0 or -1. */
#define LIMITS 16
int proc_limits(pid_t pid, uint64_t limit[LIMITS][2]);

/* A task's scheduler statistics (/proc/PID/sched). */
struct proc_sched {
	/* When it last ran, or a little later, by the clock of its current CPU (cpu_clock.c). Since
	 * Linux 6.12 a sleeping task may be moved to another CPU with a time by the old CPU's clock;
	 * the kernel updates its load average when it arrives there, so the later of the two counts. */
	uint64_t ran_ns;
	uint64_t sleeps, migrations;
};

/* -1: not available, or it has exited. */
int proc_sched(pid_t tid, struct proc_sched *sched);

#define STATUS_GROUPS 64
/* Sets of capabilities. */
enum {
	STATUS_INHERITABLE,
	STATUS_PERMITTED,
	STATUS_EFFECTIVE,
	STATUS_BOUNDING,
	STATUS_AMBIENT,
	STATUS_CAPS
};

/* The relevant fields of /proc/PID/status. */
struct proc_status {
	int64_t locked_kb; /* -1: it has no memory any more */
	pid_t inside;      /* in the innermost PID namespace                   */
	/* Its process group and session there; 0: led from outside. */
	pid_t group, session;
	pid_t tracer;     /* a thread, in our namespace; 0: none              */
	uint64_t caught;  /* signals it has handlers for, as in sigset_t      */
	uint64_t ignored; /* likewise, and so are the following               */
	uint64_t blocked, pending, shared_pending;
	uint32_t umask;
	uint32_t uid[4], gid[4]; /* real, effective, saved, file system         */
	int group_count;         /* supplementary; further ones are not known */
	uint32_t groups[STATUS_GROUPS];
	uint64_t caps[STATUS_CAPS];
	uint32_t no_new_privs, seccomp, seccomp_filters;
	bool shadow_stack; /* x86: CET                                        */
};

int proc_status(pid_t tid, struct proc_status *status);
/* The same from its status file that is open; -1: from that of `tid`. */
int proc_status_of(int status_fd, pid_t tid, struct proc_status *status);
/* "/proc/PID/NAME" opened, or -1 with errno. */
int proc_open(pid_t pid, const char *name, int flags);
/* Opens what is mapped there (proc(5), map_files); -1 with errno. Needs CAP_CHECKPOINT_RESTORE or
 * CAP_SYS_ADMIN. For writing only if the process, and all that share its memory, are stopped (a
 * template): otherwise it could map something else meanwhile, which it may only read; and only if
 * it was open for writing there, too. */
int proc_open_mapped(pid_t pid, avc_remote start, avc_remote end, int flags);
/* Whether that was open for writing, not only for reading, according to the link (fs/proc/base.c,
 * proc_map_files_instantiate()). */
bool proc_mapped_for_writing(pid_t pid, avc_remote start, avc_remote end);
/* A duplicate of a descriptor of another process, or -1. */
int proc_borrow_fd(int pidfd, int fd);
/* The OOM killer kills those with a higher value first; best effort. */
void proc_set_oom_score_adj(pid_t pid, const char *value);
int proc_oom_score_adj(pid_t pid);

/* ---- proc_text.c -------------------------------------------------------------------- */

/* Parsers for the functions above; -1 with EPROTO: unexpected contents. */
int proc_parse_stat(const char *text, struct proc_stat *stat);
int proc_parse_statm(const char *text, long *pages, long *anonymous);
int proc_parse_status(const char *text, struct proc_status *status);
int proc_parse_sched(const char *text, struct proc_sched *sched);
int proc_parse_limits(const char *text, uint64_t limit[LIMITS][2]);
int proc_parse_children(const char *text, pid_t *children, int max);
int proc_parse_mappings(FILE *text, bool smaps, int (*fn)(const struct mapping *mapping, void *arg),
			void *arg);

/* A line of mountinfo; the strings point into it. */
struct proc_mount {
	uint64_t id;
	uint32_t major, minor;
	char *point;
	const char *options, *type;
	char *details; /* of the file system's own; escaped                  */
};

/* False: not such a line. Modifies it. */
bool proc_parse_mount(char *line, struct proc_mount *mount);
/* Replaces escapes such as "\\040". */
void proc_unescape(char *text);

/* ---- opens.c ------------------------------------------------------------------------- */

/* A path as it is resolved below `root`, a descriptor: no link leads out of it, and none of /proc to
 * what a process has open.  An O_PATH descriptor, or -1 with errno.  `flags` and `resolve` as of
 * openat2(2), added. */
int open_below(int root, const char *path, uint64_t flags, uint64_t resolve);
/* The same below the root of a process: init's is the container's, others may have changed theirs. */
int open_in_root_of(pid_t pid, const char *path, uint64_t flags);
/* For calls that take a path: of what a descriptor of ours refers to. */
struct fd_path {
	char text[40];
};
struct fd_path fd_path(int fd);
/* Another open file description of that.  With O_NONBLOCK: there may be no process at the other end
 * of a pipe. */
int open_again(int fd, int flags);
/* The same of a device. */
int open_device(int fd, int flags);
/* The id of the mount by which it was opened, as in mountinfo; 0: unknown. */
uint64_t mount_of(int fd);
/* Whether a file system of that type asks a server, or a program (FUSE), which may not answer, or be
 * the application itself. */
bool mount_is_served(const char *type);
/* The file systems that are mounted for a process, read when first needed; { 0 } before. */
struct mounts {
	bool read;
	uint32_t count, room;
	struct mounted {
		uint64_t id;
		char type[16];
	} * mount;
};
void mounts_free(struct mounts *mounts);
#define SYS_LISTMOUNT 458 /* all CPUs, since Linux 6.8 */
/* Changes when anything is mounted or unmounted for that process, or it has another mount namespace;
 * 0: the kernel does not tell (before Linux 6.11). */
uint64_t mounts_stamp(pid_t pid);
/* The type of the one that a descriptor is on, without asking it; "": it is none of these. */
const char *mount_type(struct mounts *mounts, pid_t pid, int fd);
/* Whether any of these is served, or none is known. */
bool mounts_may_be_served(struct mounts *mounts, pid_t pid);
/* Whether what is on that device (struct mapping) is memory by memfd_create(2) or shmget(2), to which
 * no path leads. */
bool device_is_memory(uint64_t device);
/* Opening a file breaks a lease (fcntl(2), F_SETLEASE): whoever has it gets SIGIO, which may end it,
 * and who opens waits for it.  Those of all processes, read when first needed; { 0 } before.  That
 * takes the kernel some 10 ms (fs/locks.c: it waits for all CPUs), so before a freeze. */
struct leases {
	bool known;
	uint32_t count, room;
	struct leased {
		uint64_t device, inode;
	} * file;
};
void leases_read(struct leases *leases);
void leases_free(struct leases *leases);
/* The regular file that is mapped so, from its O_PATH descriptor, without an effect on it.  -1 with
 * EACCES: it is a device; ENXIO: it can only be mapped; EBUSY: it is leased (`leases` may be NULL:
 * it cannot be). */
int open_to_read(int path_fd, const struct mapping *mapping, struct leases *leases);

/* ---- pagemap.c ------------------------------------------------------------------------ */

/* An entry, of one page. */
#define PAGEMAP_PRESENT (UINT64_C(1) << 63)
#define PAGEMAP_SWAPPED (UINT64_C(1) << 62)
#define PAGEMAP_FILE (UINT64_C(1) << 61)
#define PAGEMAP_GUARD (UINT64_C(1) << 58) /* since Linux 6.15                   */
#define PAGEMAP_FRAME ((UINT64_C(1) << 55) - 1)
/* MADV_GUARD_INSTALL, MADV_GUARD_REMOVE (Linux 6.13); the headers may be older. */
#define GUARD_INSTALL 102
#define GUARD_REMOVE 103

/* A guard page without its own mapping (madvise(2)), not just the mark of an unwritten empty page
 * (pagemap_written()). */
bool page_is_guard(uint64_t entry);
bool page_is_own(uint64_t entry);
/* Calls fn for every range with anonymous pages or guard pages; for the whole if the kernel cannot
 * tell (before Linux 6.7). Stops when fn does not return 0. 0 or -1. */
int pagemap_walk(int pagemap, avc_remote start, avc_remote end,
		 int (*fn)(avc_remote start, avc_remote end, void *arg), void *arg);

/* Whether the mapping there is watched so: see pagemap_written(). */
bool pagemap_is_watched(int pagemap, avc_remote address);
/* Calls fn for every range written since the last such call, and protects it again. The mappings
 * must all be watched (userfaultfd(2), WP_ASYNC), else EPERM. 0, or -1 with errno. */
int pagemap_written(int pagemap, avc_remote start, avc_remote end,
		    int (*fn)(avc_remote start, avc_remote end, void *arg), void *arg);

/* ---- pageset.c ------------------------------------------------------------------------ */

#define PAGESET_PAGES 512
#define PAGESET_CHUNK ((avc_remote)PAGESET_PAGES * ARCH_PAGE_BYTES)
struct page_chunk {
	avc_remote start;
	uint64_t bits[PAGESET_PAGES / 64];
};

struct pageset {
	uint32_t count, room;
	struct page_chunk *chunk; /* in order                                        */
};

/* False: out of memory. */
bool pageset_add(struct pageset *set, avc_remote start, avc_remote end);
bool pageset_add_all(struct pageset *set, const struct pageset *more);
/* Iterates over ranges; a cursor begins as { 0 }. */
struct page_cursor {
	uint32_t chunk, bit;
};
bool pageset_next(const struct pageset *set, struct page_cursor *at, avc_remote *start,
		  avc_remote *end);
uint64_t pageset_count(const struct pageset *set);
/* Moves this many of the last ones, or a few more, to a set that was empty.  False: none. */
bool pageset_take(struct pageset *from, uint64_t pages, struct pageset *to);
void pageset_free(struct pageset *set);

/* ---- rt_priority.c -------------------------------------------------------------------- */

/* Between the two, the calling thread gets a CPU before others; best effort. May be nested. */
void rt_priority_begin(void);
void rt_priority_end(void);
/* Whether it is between the two, and has not taken too much CPU time since. */
bool rt_priority_is(void);
/* To be called now and then (heartbeat() does): it gets an ordinary priority if it has. */
void rt_priority_step(void);
/* Gives another thread the calling one's priority; best effort. */
void rt_priority_share(pid_t tid);
/* Takes it back. */
void rt_priority_unshare(pid_t tid);
/* Gives it to a task of ours for good, but not to its children; best effort. */
bool rt_priority_give(pid_t tid);
/* Gives it to a process that has an ordinary one, but not to its children; it has to end it itself
 * (rt_priority_begin_lent()), or rt_priority_reclaim().  False: it was not given. */
bool rt_priority_lend(pid_t pid);
void rt_priority_reclaim(pid_t pid);
/* rt_priority_begin() of a thread to which it was lent. */
void rt_priority_begin_lent(void);

#endif
