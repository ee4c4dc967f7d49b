/* SPDX-License-Identifier: Apache-2.0
 *
 * The engine's own declarations.  Everything here runs in the guard's thread
 * unless said otherwise; one guard is one tracer thread.
 *
 *   guard.c      the thread: waits, obeys, tells; guard_*.c: see guard.h
 *   init_channel.c       to avckpt-init: control page, reports, verdicts
 *   freeze.c     one checkpoint: stop everything, read it, clone it, let go; see freeze.h
 *   restore.c    templates become the app again
 *   restore_tree.c    a restored process makes its children
 *   remap.c      ... and their memory
 *   restore_plan.c    ... of which they have some from their parents
 *   copier.c     ... which a second thread helps to copy
 *   snapshot.c   mappings and pages of a template
 *   process_attrs.c     ... and what else they have
 *   syscall_batch.c     a process that is being made
 *   tree.c       the processes of an app
 *   generation.c templates kept
 *   pending.c    signals that have not been delivered
 *   timers.c     interval timers, POSIX timers
 *   attributes.c scheduling, credentials, prctl settings
 *   sandbox.c    restoring an app that has a seccomp filter of its own
 *   memory.c     memory that a clone does not carry as it is
 *   infect.c     parasite and holder brought into a live app
 *   target.c     the app's process and its threads
 *   waits.c      ... whose calls are to be ended
 *   setup.c      lists of calls that a restored process makes
 *   files*.c     descriptors: looked at, put back
 *   parasite.c        the parasite as the engine sees it, code run in a target
 *   tracee.c     ptrace: seize, stop, wait, release
 *   rewind.c     interrupted system calls
 *   support.c    what can not be protected; quiescence
 *   last_pid.c    the next PID of another PID namespace
 *   rt_priority.c     a CPU at once while an app waits for us
 *   proc.c       /proc
 */
#ifndef AVCKPT_INTERNAL_H
#define AVCKPT_INTERNAL_H

#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>
#include <sys/socket.h>
#include <sys/types.h>

#include "arch.h"
#include "avckpt/ctl.h"
#include "avckpt/engine.h"
#include "parasite.h"

#define NS_PER_MS UINT64_C(1000000)
#define NS_PER_S UINT64_C(1000000000)
#define THREADS_MAX 4096
#define OLD_PARASITES_MAX 128
#define SOCKETS_MAX 64
#define PROCESSES_MAX 512 /* of one app                                     */
#define CHILDREN_MAX 4096 /* of init: orphans, holders and templates, too   */
/* PTRACE_GET_RSEQ_CONFIGURATION, since Linux 5.13; glibc before 2.35 lacks the name. */
#define PTRACE_GET_RSEQ 0x420f
#define SS_AUTODISARM_ (1u << 31) /* linux/signal.h, which does not go with signal.h */

#define warn_unused __attribute__((warn_unused_result))

/* ---- error.c --------------------------------------------------------------- */

/* Fills *err in unless it holds an error already.  Always returns -1. */
int fail(struct avc_error *err, enum avc_code code, int errnum, pid_t pid, const char *operation,
	 const char *syscall, const char *detail, ...) __attribute__((format(printf, 7, 8)));
/* The same with the code that suits errno: ESRCH gone, EPERM denied, else kernel. */
int fail_errno(struct avc_error *err, pid_t pid, const char *operation, const char *syscall,
	       const char *detail, ...) __attribute__((format(printf, 5, 6)));
uint64_t now_ns(void);
void close_fd(int *fd);
/* As much of it as there is; -1: it can not be read. */
ssize_t read_whole(int fd, uint8_t *to, size_t bytes, off_t at);
/* Room for one more element of `bytes` in *array, which has `count`; false: out of memory,
 * and nothing has changed. */
bool make_room(void *array, uint32_t count, uint32_t *room, size_t bytes);

/* ---- proc.c ---------------------------------------------------------------- */

struct proc_stat {
	char state;
	pid_t parent, group, session, tty_group;
	uint32_t tty, flags; /* PF_*                                            */
	int threads;
	uint64_t start;  /* clock ticks after boot                            */
	int exit_signal; /* that its parent gets when it ends, 0: none        */
	int exit_status; /* of a zombie, as wait(2) says it                   */
	char name[16];
};

/* Reads a whole small file of /proc.  Returns its length or -1 with errno. */
ssize_t proc_read(pid_t pid, const char *name, char *buf, size_t size);
int proc_stat(pid_t pid, struct proc_stat *stat);
/* By an open /proc/PID/stat, which stands for that very process: -1, when it is gone. */
int proc_stat_of(int stat_fd, struct proc_stat *stat);
/* The number of a task in its own (innermost) PID namespace, or -1. */
pid_t proc_inside(pid_t tid);
/* A thread of the process that has not ended: the main thread, as long as it has not.
 * 0: none. */
pid_t proc_live_thread(pid_t pid);
/* Until that thread has ended; a second at most. */
void proc_await_end(pid_t tid);
/* Children of a (single-threaded) process; returns how many (at most max), or -1. */
int proc_children(pid_t pid, pid_t *children, int max);
/* The same of one thread, by the open /proc/PID/task of its process. */
int proc_children_of(int task_dirfd, pid_t tid, pid_t *children, int max);
/* Calls fn for every task of an open /proc/PID/task; stops when it returns < 0. */
int proc_tasks(int task_dirfd, int (*fn)(pid_t tid, void *arg), void *arg);
/* Whether two tasks have the same memory (kcmp(2)). */
bool proc_same_memory(pid_t a, pid_t b);
/* Likewise the same descriptor table, or the same working directory and umask: 1 or 0; -1: it can
 * not be told.  One that is just ending has none. */
enum shared { SHARED_FILES, SHARED_FOLDERS };
int proc_shares(pid_t a, pid_t b, enum shared what);
/* How many threads there are, by an open /proc/PID/task; 0: the process is gone. */
int proc_thread_count(int task_dirfd);
/* Size of the address space in pages, by an open /proc/PID/statm, or -1; *anonymous (may be
 * NULL): how many are resident and of no file. */
long proc_vm_pages(int statm_fd, long *anonymous);
/* The PID a pidfd stands for, in our namespace, or -1. */
pid_t proc_pidfd_pid(int pidfd);
int proc_pidfd_open(pid_t pid);
/* readlink(2) of "/proc/PID/NAME", as a string.  0 or -1. */
int proc_link(pid_t pid, const char *name, char *buf, size_t size);
/* It is just ending, and may have closed already what it had open. */
bool proc_is_exiting(pid_t tid);
bool pidfd_ended(int pidfd);
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

/* Calls fn for every mapping of /proc/PID/maps or (slow) smaps; stops when it
 * returns < 0.  0 or -1. */
int proc_mappings(pid_t pid, const char *file, int (*fn)(const struct mapping *mapping, void *arg),
		  void *arg);

/* The vDSO, or what belongs to it. */
bool mapping_is_special(const struct mapping *m);
/* As mmap(2) has it. */
int mapping_protection(const struct mapping *m);

/* /proc/PID/limits, as getrlimit(2) numbers them; ~0: no limit.  0 or -1. */
#define LIMITS 16
int proc_limits(pid_t pid, uint64_t limit[LIMITS][2]);

/* A task as the scheduler sees it (/proc/PID/sched). */
struct proc_sched {
	uint64_t ran_ns; /* when it ran last, by the clock of the CPU it ran on    */
	uint64_t switches, migrations;
};

/* -1: the kernel does not tell, or it has ended. */
int proc_sched(pid_t tid, struct proc_sched *sched);

/* What is of interest in /proc/PID/status. */
struct proc_status {
	int64_t locked_kb;       /* -1: it has no memory any more                    */
	pid_t inside;            /* in the innermost PID namespace                   */
	pid_t tracer;            /* a thread, in our namespace; 0: none              */
	uint64_t caught;         /* signals it has handlers for, as in sigset_t      */
	uint32_t uid[4], gid[4]; /* real, effective, saved, file system         */
	uint64_t caps[5];        /* inheritable, permitted, effective, bounding, ambient */
	uint32_t no_new_privs, seccomp, seccomp_filters;
	bool shadow_stack; /* x86: CET                                        */
};

int proc_status(pid_t tid, struct proc_status *status);
/* "/proc/PID/NAME" opened, or -1 with errno. */
int proc_open(pid_t pid, const char *name, int flags);
/* What is mapped there (proc(5), map_files), or -1 with errno.  Needs CAP_CHECKPOINT_RESTORE or
 * CAP_SYS_ADMIN. */
int proc_open_mapped(pid_t pid, avc_remote start, avc_remote end, int flags);
/* Whether that was open for writing, and not for reading alone: the link says so (fs/proc/base.c,
 * proc_map_files_instantiate()). */
bool proc_mapped_for_writing(pid_t pid, avc_remote start, avc_remote end);

/* ---- threads and targets ---------------------------------------------------- */

/* The call a thread was in when it was stopped last. */
struct call {
	long nr;
	avc_remote pc, sp;
	uint64_t arg[3];
};

/* What is remembered of a call that was rewound (rewind.c). */
struct rewound {
	uint32_t mark; /* of that call; 0: none                            */
	int answer;    /* when its time is up                              */
	uint64_t due_ns;
	uint64_t runs; /* how often the thread had run when it was waiting again */
	bool runs_known, waiting; /* waits.c                                        */
};

/* A thread that slept, as far as one can tell from outside, just before it was stopped. */
struct sleeper {
	bool known;
	struct proc_sched sched;
};

/* struct sched_attr (sched_setattr(2)) as of version 0, and ioprio_get(2). */
struct scheduling {
	uint8_t attr[48] __attribute__((aligned(8)));
	int32_t io_priority;
	int32_t reserved;
};

#define GROUPS_KEPT 32 /* of a thread; of one with more it is only known how many */
#define NODE_WORDS 16  /* 1024 nodes of memory                                   */

struct creds {
	uint32_t uid[3], gid[3]; /* real, effective, saved                      */
	uint32_t fsuid, fsgid;
	uint32_t caps[6]; /* as capget(2) has them                            */
	uint64_t bounding, ambient;
	uint64_t state_permitted; /* arch.h, ARCH_STATE_PERMITTED                     */
	uint32_t personality;
	uint32_t securebits, no_new_privs;
	uint32_t death_signal, subreaper;
	int32_t seccomp;  /* mode                                             */
	uint64_t filters; /* of seccomp: a hash                               */
	int32_t group_count;
	uint32_t group[GROUPS_KEPT]; /* supplementary                             */
	int32_t memory_policy;       /* set_mempolicy(2), -1: the kernel has none */
	uint64_t nodes[NODE_WORDS];
	uint64_t slack_ns;   /* of timers                                        */
	int32_t future_lock; /* mlockall(2), of the main thread only            */
};

/* What a thread is asked (target.c); NULL: not that. */
struct questions {
	const struct inj_syscall *tid_address, *altstack, *inside, *name, *locks, *attributes;
};

struct thread {
	pid_t tid; /* in our namespace                                 */
	bool seen; /* there at this freeze                             */
	bool attached, stopped;
	int stop_signal; /* the process is stopped by job control           */
	int block;       /* of the slot, main thread 0; -1: not in the image */
	bool borrowed;   /* sent into the parasite; regs and sigmask are its own  */
	const struct parasite *borrowed_for; /* NULL: not yet a parasite (infect.c)         */
	bool vetted;                         /* vet() has been at this stop                      */
	struct arch_regs regs;               /* as of the stop, EINTR already mended          */
	uint64_t sigmask;
	uint64_t robust_list, robust_bytes;
	uint64_t rseq;
	uint32_t rseq_bytes, rseq_signature;
	uint64_t affinity[INJ_CPU_WORDS];
	uint32_t affinity_bytes;
	/* Asked of the thread itself, or slow to read; kept between checkpoints
	 * as long as it looks like the same thread. */
	bool known;
	uint32_t asked; /* checkpoints since                                */
	bool young;     /* was asked once only: it may just be setting itself up    */
	pid_t inside;
	uint64_t known_tls;
	uint64_t clear_tid;
	uint64_t altstack[3]; /* sp, flags, size                                */
	bool disarmed;        /* has none as long as it is in a handler on it   */
	char name[16];
	struct creds creds;
	struct scheduling scheduling; /* at this freeze                         */
	struct call call;
	struct rewound rewound;
	struct sleeper sleeper;
	uint64_t stopped_ns;
	bool signalled; /* was just about to run a handler                  */
};

struct parasite {
	avc_remote base; /* 0: none                                          */
	size_t bytes;
	uint8_t *map; /* our view of the same pages                       */
	struct inj_control *control;
	uint32_t slots, threads_max;
	size_t slot_bytes, block_bytes;
	int fd; /* of those pages                                              */
};
/* How it is mapped in two parts. */
#define PARASITE_CODE_PROT (PROT_READ | PROT_EXEC)
#define PARASITE_DATA_PROT (PROT_READ | PROT_WRITE)
#define PARASITE_FLAGS (MAP_SHARED | MAP_FIXED_NOREPLACE | MAP_NORESERVE)

struct files;
struct last_pid;
struct sandbox;

/* The live main process of the app. */
struct target {
	/* The thread that stands for the process to /proc and ptrace(2): the main thread,
	 * or, when that has ended, any other (target_follow).  0: none           */
	pid_t pid;
	pid_t leader; /* the process's own number                            */
	pid_t inside; /* the same in its own namespace                       */
	int pidfd, task_dirfd, mem_fd, timers_fd, stat_fd, statm_fd;
	int leader_pidfd; /* when pidfd is of another thread: of the process    */
	struct parasite parasite;
	bool infected; /* the parasite is known to be in this process           */
	pid_t holder;  /* 0: none                                          */
	int holder_pidfd;
	struct thread *threads;
	uint32_t thread_count, thread_room;
	uint64_t due_ns; /* when the first of its calls is to be ended (waits.c)   */
	uint64_t nonce;
	/* Parasites that a guard which died left behind; they go with the second
	 * checkpoint, when no thread can be in them any more. */
	struct {
		avc_remote base;
		size_t bytes;
	} old_parasite[OLD_PARASITES_MAX];
	uint32_t old_parasites, checkpoints;
	/* A thread died while it may have been cloning: there may be a tracee that
	 * nobody knows (init_channel_kill_lost). */
	bool lost;
	bool childless;                     /* it had no child process at the last checkpoint   */
	const struct inj_syscall *children; /* the question whether it has, in a freeze */
	struct questions questions;         /* and what else it is asked               */
	uint64_t asked_ns;
	bool asked;
	uint32_t blocks;     /* of the slot, that its threads take up in this freeze     */
	long surveyed_pages; /* size when its mappings were looked at last      */
	int sockets[SOCKETS_MAX];
	uint32_t socket_count;
	struct pending *pending;
	struct timers *timers;
	struct memory *memory;
	uint64_t shm_bytes;     /* shared memory that is rolled back, at most       */
	uint32_t plain_filters; /* seccomp filters of init: the container's        */
	pid_t init;             /* avckpt-init                                      */
	struct files *files_before, *files_image; /* files.c                   */
	uint32_t files_seen;
	bool tcp_moved;    /* bytes of connections are to be counted           */
	bool tcp_messages; /* quiescent is only who is between two messages    */
	/* Of a process that is not the main one (tree.c). */
	bool descendant;
	uint64_t start;                  /* when it began; tells it from one with its number */
	uint32_t images;                 /* generations that have one of it                  */
	struct arch_regs holder_base;    /* a user context of the holder, which clones       */
	bool cloning;                    /* by its holder, the main one by itself: freeze()  */
	long clone_pages;                /* its size when that began                         */
	long anon_pages;                 /* of its last template; 0: none yet                */
	bool closing;                    /* by its holder: generation_close_tables()      */
	bool doubtful;                   /* it was cloning when a checkpoint came to nothing */
	bool waiting;                    /* its main thread is to wait for a task of ours       */
	const struct creds *forebear;    /* what a process that is made from the main one has */
	bool frozen;                     /* stopped in this freeze                            */
	bool begun;                      /* and read, and asked                               */
	bool adopts;                     /* it or one above it adopts orphans, or may do so    */
	bool paused;                     /* between adopt_no_more() and adopt_again()         */
	uint64_t held_ns, exec_check_ns; /* since when, and when to look again whether it has
					  * executed another program                       */
};

#define FILES_NAME 81 /* of a file, for people                                  */

/* What a generation has of a process that is not the main one. */
struct branch {
	struct target *target;    /* NULL: it had ended, and nobody had waited for it */
	struct generation *image; /* of this process alone                   */
	int parent;               /* index of its parent's branch, or ...    */
	pid_t inside;
	pid_t session, group;        /* inside; 0: outside of the app           */
	struct process_attrs *attrs; /* process_attrs.c                                */
	pid_t pid;                   /* as of the freeze; then as restored last */
	int exit_signal;             /* struct proc_stat                       */
	int status;                  /* of one that had ended, as from wait(2)  */
	char name[16];               /* the same                                */
};
#define PARENT_MAIN (-1)
#define PARENT_INIT (-2)

struct restore_plan;

/* A fork of a template, for the next restore (spare.c). */
struct spare {
	pid_t pid; /* 0: none                                           */
	int pidfd;
	bool tried;    /* it was begun to make one                               */
	bool unwanted; /* it was one process too many for a restore              */
	/* What the template has been told to do for it and has not done yet. */
	enum { SPARE_NO_WORK, SPARE_FORK, SPARE_REST } work;
	struct scheduling scheduling; /* the template's own                        */
	bool aside;                   /* it has another policy for as long         */
};

/* Also the image of one process of several: then what is of the whole is unused. */
struct generation {
	uint64_t number; /* 0: unused                                        */
	pid_t template;
	int pidfd;
	struct spare spare;
	uint32_t slot;
	uint32_t threads;
	uint64_t taken_ns;
	uint64_t clone_ns; /* what the clones of it took                      */
	bool quiescent;
	/* Taken from a process that had been restored lately: of the same lineage
	 * as what that one was restored from, and as suspect. */
	uint32_t lineage;
	uint32_t crashes;      /* of its lineage, soon after a restore             */
	uint32_t lost;         /* restores from it that came to nothing            */
	bool seen;             /* held when the app was healthy; again so: vouched */
	bool vouched;          /* the app was healthy well after it was taken      */
	struct arch_regs base; /* a user context of the template                */
	long vm_pages;         /* of the app when it was taken                     */
	long anon_pages;       /* resident ones that are of no file                */
	bool sandboxed;        /* has seccomp filters of its own                   */
	bool headless;         /* its main thread had ended                       */
	int stop_signal;       /* stopped by that (job control), 0: it was not     */
	int64_t dumpable;      /* prctl(2), PR_GET_DUMPABLE                        */
	struct proc_stat stat; /* as of the freeze                                */
	/* The main process' group, and the one in the foreground of its terminal; inside,
	 * 0: none that could be seen. */
	pid_t group, tty_group;
	struct attributes *attributes;
	struct mem_image *image;      /* of memory that is not in the template       */
	struct avc_error notice;      /* what of it can not be put back              */
	struct files *files;          /* descriptors                                     */
	struct avc_error files_error; /* why they could not be read             */
	/* avckpt.files=strict */
	struct files_mapped *mapped; /* NULL: it was not strict                         */
	char written[FILES_NAME];    /* a file that was written since; "": none         */
	struct branch *branch;       /* the other processes, parents first        */
	uint32_t branches;
	struct restore_plan *plan; /* restore_plan.c; NULL: not begun                */
};

/* One process of the app, as it was found. */
struct kin {
	pid_t pid;
	int parent;  /* index, PARENT_INIT; the main process is 0           */
	bool ended;  /* a zombie                                         */
	bool ending; /* neither a process any more nor a zombie yet      */
	struct proc_stat stat;
	struct target *target;
};

/* All processes of an app (tree.c). */
struct tree {
	struct target *main;
	pid_t init;
	uint32_t slots;  /* of a parasite                                         */
	struct kin *kin; /* parents before children                        */
	uint32_t count;
	struct target **member; /* of those that are not the main process; those
				 * that have ended as long as there are images of them */
	uint32_t members;
	/* Is this child of init one of our own? */
	bool (*is_ours)(pid_t pid, const void *arg);
	const void *arg;
};

struct init_channel {
	int init_pidfd, ctl_fd, report_fd, verdict_fd;
	pid_t init, init_inside;
	struct avc_ctl *ctl;
	int pidns_fd;        /* of the container                                 */
	uint32_t death;      /* of which init waits to hear: struct avc_report, seq  */
	uint64_t working_ns; /* when that was, or it was told that it takes longer   */
};

/* ---- tracee.c ---------------------------------------------------------------- */

/* The one signal the library uses, thread-directed, to end a wait(2) in time. */
int tracee_timer_new(timer_t *timer, struct avc_error *err) warn_unused;
void tracee_deadline_set(timer_t timer, uint64_t ns);
void tracee_deadline_clear(timer_t timer);
bool tracee_deadline_passed(void);

enum stop_kind {
	STOP_TRAP,  /* our PTRACE_INTERRUPT, or a new tracee's first stop     */
	STOP_GROUP, /* job control: the app is stopped by a signal            */
	STOP_FORK,  /* FORK, VFORK, CLONE event; `message` is the child       */
	STOP_SYSCALL,
	STOP_SIGNAL,   /* about to receive `signal`                              */
	STOP_EXIT,     /* gone; reaped                                           */
	STOP_DYING,    /* killed, to be reaped later (stragglers())              */
	STOP_DEADLINE, /* did not stop in time                                   */
	STOP_NONE,     /* WNOHANG: nothing new                                   */
	STOP_OTHER
};

struct stop {
	enum stop_kind kind;
	int event, signal, status;
	pid_t message;
};

/* From now on a wait also ends (as at the deadline) when *word is not 0; NULL: no more. */
void tracee_watch(const uint32_t *word);
/* Waits for the next stop of one tracee of this thread; options: 0 or WNOHANG. */
struct stop tracee_wait(pid_t tid, int options);
/* For a running tracee that was interrupted (or is new): waits until it is in a
 * plain trap stop (STOP_TRAP); signals that come in between are delivered.  A new
 * tracee that it brings forth goes to *child (NULL: not expected).  Anything but
 * STOP_TRAP is an error. */
enum stop_kind tracee_await(pid_t tid, pid_t *child, struct avc_error *err) warn_unused;
/* The signal by which the one awaited last is stopped (job control); 0: it is not. */
int tracee_group_signal(void);
/* From a stop of another kind to a plain trap stop, on the kernel's way back to
 * the app, where it sees to interrupted calls and signals. */
int tracee_settle(pid_t tid, struct avc_error *err) warn_unused;
/* The same of a task of ours of which it is not known whether it runs. */
int tracee_halt(pid_t tid, struct avc_error *err) warn_unused;
/* Reaps a dead tracee of this thread that is not known(): true if there was one.  One
 * that a thread has brought forth when it was killed is a tracee nobody heard of. */
bool tracee_reap_unknown(bool (*known)(pid_t tid, const void *arg), const void *arg);
/* Kills (SIGKILL) and reaps a tracee that is no thread of a live app. */
void tracee_kill(pid_t pid);
/* The same some milliseconds later, and without waiting for its end: the kernel takes some 10 ms
 * for each GB that it has mapped, and longer if it gets no CPU.  Takes `pidfd`.  Until
 * tracee_reap_ending() has killed and reaped it, it is_ending(): the task, of this thread.  That
 * returns how many are left, and tracee_ending_due() when to call it again if there is no news of
 * theirs: CLOCK_MONOTONIC, UINT64_MAX: never. */
void tracee_end(pid_t pid, int pidfd);
uint32_t tracee_reap_ending(void);
uint64_t tracee_ending_due(void);
/* Kills them now. */
void tracee_end_now(void);
bool tracee_is_ending(pid_t pid);
/* Of the i-th of them, to be watched; -1: there are no more. */
int tracee_ending_pidfd(uint32_t i);
/* Is this thread the one that traces it? */
bool tracee_is_ours(pid_t tid);
/* Holders, and processes that are being made: never to run on without us. */
#define TRACE_OPTIONS_OURS (PTRACE_O_EXITKILL | PTRACE_O_SUSPEND_SECCOMP | TRACE_OPTIONS_APP)
#define TRACE_OPTIONS_APP \
	(PTRACE_O_TRACEFORK | PTRACE_O_TRACECLONE | PTRACE_O_TRACEVFORK | PTRACE_O_TRACESYSGOOD)

/* ---- parasite.c ------------------------------------------------------------------- */

/* Maps the pages at `base` of process `pid` here and fills in code and control. */
int parasite_open(struct parasite *parasite, pid_t pid, avc_remote base, size_t bytes,
		  uint64_t nonce, struct avc_error *err) warn_unused;
size_t parasite_layout(struct parasite *parasite, uint32_t slots, uint32_t threads_max);
void parasite_close(struct parasite *parasite);
struct inj_slot *parasite_slot(const struct parasite *parasite, uint32_t slot);
avc_remote parasite_remote(const struct parasite *parasite, const void *local);
bool parasite_contains(const struct parasite *parasite, avc_remote address);
/* Block of thread `i` in a slot, its signal frame, the top of its stack. */
struct inj_thread *parasite_thread(const struct parasite *parasite, uint32_t slot, uint32_t i);
void *parasite_frame(const struct parasite *parasite, uint32_t slot, uint32_t i);
void *parasite_stack(const struct parasite *parasite, uint32_t slot, uint32_t i);

uint8_t *parasite_setup(const struct parasite *parasite, uint32_t slot); /* INJ_SETUP_BYTES */
uint8_t *parasite_files(const struct parasite *parasite, uint32_t slot); /* INJ_FILES_BYTES */

/* Prepares a list of calls; returns the next call to fill in. */
void call_begin(struct inj_call *call, enum inj_after after);
struct inj_syscall *call_add(struct inj_call *call, long nr, uint64_t a, uint64_t b, uint64_t c,
			     uint64_t d, uint64_t e);
/* Sends a stopped task into the parasite to make the calls.  `base` is a user context
 * of the task.  For a thread of the app use borrow(). */
int parasite_send(const struct parasite *parasite, pid_t tid, const struct arch_regs *base,
		  struct inj_call *call, struct avc_error *err) warn_unused;
/* Resumes it until all calls were made; it is in a plain trap stop then. */
int parasite_run(pid_t tid, struct inj_call *call, struct avc_error *err) warn_unused;
/* Resumes it until it pauses (INJ_PAUSE), and from there. */
int parasite_run_to_pause(pid_t tid, struct inj_call *call, struct avc_error *err) warn_unused;
int parasite_run_on(pid_t tid, struct inj_call *call, struct avc_error *err) warn_unused;
/* Resumes it until it has cloned; it is in the event's stop then.  If the kernel does
 * not let it, fails with AVC_KERNEL, and it is in a plain trap stop. */
int parasite_run_clone(pid_t tid, const struct inj_call *call, pid_t *child,
		       struct avc_error *err) warn_unused;
/* The same in parts, for several at a time.  parasite_halt() waits until it is done and
 * interrupts it; its stop is still to come, for which parasite_finish() waits, too. */
int parasite_start(pid_t tid, struct avc_error *err) warn_unused;
int parasite_halt(pid_t tid, struct inj_call *call, struct avc_error *err) warn_unused;
int parasite_finish(pid_t tid, struct inj_call *call, struct avc_error *err) warn_unused;
int parasite_await_clone(pid_t tid, const struct inj_call *call, pid_t *child,
			 struct avc_error *err) warn_unused;
/* The same; `meanwhile` is called once while the kernel clones. */
int parasite_run_clone_while(pid_t tid, const struct inj_call *call, void (*meanwhile)(void *arg),
			     void *arg, pid_t *child, struct avc_error *err) warn_unused;
/* exec puts another program in its place, at any moment, and the parasite is gone: whether it
 * is there, in a stopped thread.  If not, the target is not infected any more. */
int parasite_check(struct target *target, pid_t tid, struct avc_error *err) warn_unused;
/* In what a guard that died left behind? */
bool in_old_parasite(const struct target *target, avc_remote address);
/* Until it is let go: it runs only what is ours meanwhile. */
int suspend_seccomp(const struct thread *thread, struct avc_error *err) warn_unused;
/* May this stopped thread be borrowed?  What of that is to be read in its memory. */
int vet(struct target *target, struct thread *thread, struct avc_error *err) warn_unused;
/* The same as parasite_run* for a stopped thread of the app, which gets home by itself if we die:
 * borrow, parasite_run*, give_back.  give_back() needs a plain trap stop. */
int borrow(struct target *target, struct thread *thread, struct avc_error *err) warn_unused;
int give_back(struct thread *thread, struct avc_error *err);

/* ---- setup.c ------------------------------------------------------------------- */

/* The lists of calls of one slot, while they are being made.  Used by
 * generation_finish() and what it calls, in this order: setup_begin(), any number
 * of the others, setup_end(). */
struct setup {
	const struct parasite *parasite;
	struct inj_slot *slot;
	uint8_t *memory;
	size_t used;
	uint64_t *tail[INJ_STAGES]; /* where the next one's address goes        */
	uint64_t *thread_tail;
	bool full;
	struct avc_error notice; /* what can not be put back, the first of it */
	struct inj_setup spare;  /* written to when there is no room         */
};

void setup_begin(struct setup *setup, const struct parasite *parasite, uint32_t slot);
/* One more call for a stage or (after setup_thread()) for a thread; `name` is for
 * messages.  To be filled in further: call.arg[5], store, flags. */
struct inj_setup *setup_add(struct setup *setup, enum inj_stage stage, const char *name, long nr,
			    uint64_t a, uint64_t b, uint64_t c, uint64_t d, uint64_t e);
void setup_thread(struct setup *setup, struct inj_thread *thread);
struct inj_setup *setup_add_thread(struct setup *setup, const char *name, long nr, uint64_t a,
				   uint64_t b, uint64_t c, uint64_t d, uint64_t e);
/* A copy of `bytes` bytes where the target can read it; the target's address. */
avc_remote setup_data(struct setup *setup, const void *data, size_t bytes);
/* -1 if there was not enough room for it all. */
int setup_end(const struct setup *setup, pid_t pid, struct avc_error *err) warn_unused;
/* After a restore: the first call of the slot that was allowed to fail, and did. */
const struct inj_setup *setup_failed(const struct parasite *parasite, uint32_t slot);
/* The same for one stage; calls without a name do not count. */
const struct inj_setup *setup_failed_stage(const struct parasite *parasite, uint32_t slot,
					   enum inj_stage stage);
/* The name of a call by the target's address of it. */
const char *setup_name(const struct parasite *parasite, avc_remote address);

/* ---- pending.c ------------------------------------------------------------------ */

struct pending *pending_new(void);
/* While everything is stopped: those of all threads that are in the image.  Sets
 * thread.signalled.  AVC_GONE: who was killed meanwhile has none any more. */
int pending_read(struct target *target, struct avc_error *err) warn_unused;
/* One that the app dies of as soon as it runs again; 0: none. */
int pending_deadly(const struct pending *pending);
/* Is there such a signal; of a POSIX timer, if timer >= 0? */
bool pending_contains(const struct pending *pending, int signal, int timer);
/* When the app runs again: one thread's, after setup_thread(); the process's. */
void pending_setup_thread(const struct target *target, const struct thread *thread,
			  struct setup *setup);
void pending_setup(const struct target *target, struct setup *setup);

/* ---- timers.c -------------------------------------------------------------------- */

struct timers *timers_new(void);
/* While everything is stopped: what to call first in the list; when that was done. */
void timers_ask(struct target *target, struct inj_call *call);
void timers_answer(struct target *target, const struct inj_call *call, uint64_t took_ns);
/* When the app runs again. */
void timers_setup(struct target *target, struct setup *setup);

/* ---- attributes.c ----------------------------------------------------------------- */

#define ATTRIBUTES_ASK_BYTES 376
/* While it is stopped, from outside. */
void scheduling_read(pid_t tid, struct scheduling *scheduling);
/* Calls that ask a thread, and its answers; `out` (for it: `remote`) is where it is to
 * leave them.  Returns the first of the calls. */
const struct inj_syscall *attributes_ask(struct inj_call *call, void *out, avc_remote remote);
void attributes_answer(const struct inj_syscall *first, const void *out, struct creds *creds);
/* When the app runs again: each thread, after setup_thread(); the process. */
int attributes_setup_thread(const struct target *target, const struct thread *main_thread,
			    const struct thread *thread, struct setup *setup,
			    struct avc_error *err) warn_unused;
/* Of a stopped thread: its seccomp filters, whatever they say. */
uint64_t filters_read(pid_t tid);
int attributes_keep(const struct target *target, struct generation *generation,
		    struct avc_error *err) warn_unused;
/* Before the restored threads go: what can be done from outside only. */
void attributes_put_back(const struct attributes *attributes, pid_t pid, struct avc_error *notice);

/* ---- sandbox.c --------------------------------------------------------------------- */

/* Keeps a new process, which is stopped, as a tracee, and lets it go on. */
struct sandbox *sandbox_begin(pid_t child, struct avc_error *err);
/* Waits while *state is INJ_IDLE; false when it ended or was too late. */
bool sandbox_wait(struct sandbox *sandbox, const uint32_t *state, uint64_t end);
/* The end of it: killed, or let go to where the threads of the slot were; stop_signal: where
 * they stop (job control), 0: go on. */
void sandbox_end(struct sandbox *sandbox);
void sandbox_go(struct sandbox *sandbox, const struct parasite *parasite, uint32_t slot,
		int stop_signal);

/* ---- memory.c ------------------------------------------------------------------ */

/* Shared memory that an image of the same checkpoint has: one is enough. */
struct mem_seen {
	uint32_t count;
	struct {
		uint64_t device, inode, offset, bytes;
	} area[256];
};

struct memory *memory_new(void);
void memory_forget(struct memory *memory); /* it is another program         */
void memory_free(struct memory *memory);
/* Room for what is to be copied in the freeze. */
int memory_prepare(struct memory *memory, struct mem_image **image, struct mem_seen *seen,
		   struct avc_error *err) warn_unused;
void mem_image_free(struct mem_image *image);
/* What only "smaps" tells of a mapping and a restore has to know, as of the checkpoint: enum
 * mapping_flag.  And whether it is so of any. */
uint32_t mem_image_marks(const struct mem_image *image, avc_remote address);
bool mem_image_has(const struct mem_image *image, enum mapping_flag flag);
/* While everything is stopped: copies, what is its own when it stands still, what is shared
 * when everybody does; and what to call before the clone. */
void memory_copy_own(const struct target *target, struct mem_image *image);
void memory_copy_shared(const struct target *target, struct mem_image *image);
void memory_dofork(const struct memory *memory, struct inj_call *call);
/* The template is smaller than the app: always fails, with EAGAIN if the next
 * attempt will be better. */
int memory_learn(struct target *target, long missing_pages, struct avc_error *err);
/* When the app runs again.  Fails with EAGAIN if what had to be copied was not. */
/* Why a process that has private mappings of hugetlbfs is not cloned: the pool of huge
 * pages is small, and whoever writes to a shared one when it is empty is killed. */
extern const char private_huge_pages[];
int memory_finish(struct target *target, struct generation *generation, int64_t locked_kb,
		  struct setup *setup, struct avc_error *err) warn_unused;
/* At a restore, before anything runs; *notes: what can not be written. */
int memory_put_back(const struct mem_image *image, pid_t pid, struct avc_error *notes,
		    struct avc_error *err) warn_unused;

/* ---- infect.c ----------------------------------------------------------------- */

/* Brings the parasite into the app, through its main thread.  The other threads run. */
int infect(struct target *target, uint32_t slots, timer_t timer, uint64_t deadline_ns,
	   struct avc_error *err) warn_unused;
/* The same while everything is stopped. */
int infect_stopped(struct target *target, uint32_t slots, struct avc_error *err) warn_unused;
/* The holder of one that is not the main process, by its stopped main thread. */
int hold_stopped(struct target *target, pid_t init, struct avc_error *err) warn_unused;
/* A stopped process that adopts orphans (PR_SET_CHILD_SUBREAPER) does not for a while: they
 * are init's.  If we die meanwhile it does again all by itself. */
int adopt_no_more(struct target *target, struct avc_error *err) warn_unused;
int adopt_again(struct target *target, struct avc_error *err) warn_unused;
/* Makes the holder; unhold() drops it.  unhold_soon() does not wait until what it has open is
 * closed and its memory gone. */
int hold(struct target *target, timer_t timer, uint64_t deadline_ns,
	 struct avc_error *err) warn_unused;
void unhold(struct target *target);
void unhold_soon(struct target *target);

/* ---- tree.c --------------------------------------------------------------------- */

/* Looks who there is; new ones are opened. */
int tree_look(struct tree *tree, struct avc_error *err) warn_unused;
/* Whether kin[i] or a process above it adopts orphans, or could not be asked whether it does. */
bool tree_has_reaper(const struct tree *tree, uint32_t i);
/* Whether kin[i] has its parent's memory, and not its own: after vfork(2) until it has
 * executed a program. */
bool tree_shares_memory(const struct tree *tree, uint32_t i);
/* Frees those that have ended and of which there is no image. */
void tree_sweep(struct tree *tree);
/* It is gone, or another program: what it had open must not stay open by us. */
void tree_let_go(struct target *target);
void tree_free(struct tree *tree);

/* ---- target.c ----------------------------------------------------------------- */

void target_init(struct target *target);
/* Room for threads and all else that a target has; false: out of memory. */
bool target_make_room(struct target *target);
void target_free_room(struct target *target);
int target_open(struct target *target, pid_t pid, pid_t inside, struct avc_error *err) warn_unused;
/* Before anything else is done with it: the main thread may have ended, and others go
 * on (pthread_exit(3)). */
int target_follow(struct target *target, struct avc_error *err) warn_unused;
/* All of it, whichever of its threads have ended meanwhile. */
void target_kill(const struct target *target);
/* Forgets the process (the parasite stays mapped here: templates live in it). */
void target_close(struct target *target);
/* The entry for a tid; NULL when there is no room. */
struct thread *thread_find(struct target *target, pid_t tid);
struct thread *thread_add(struct target *target, pid_t tid, struct avc_error *err);
void threads_forget_unseen(struct target *target);
/* Attaches and interrupts; thread_await() then waits for the stop, reads the
 * registers and mends the interrupted call. */
int thread_stop(struct target *target, struct thread *thread, struct avc_error *err) warn_unused;
int thread_await(struct target *target, struct thread *thread, struct avc_error *err) warn_unused;
/* After injected code in it has failed: what did not come back in time is still on its way. */
void thread_runs_on(struct thread *thread, const struct avc_error *err);
/* Lets it go on as if nothing had been.  A thread that could not be stopped stays
 * attached: a straggler. */
void thread_release(struct thread *thread);
/* Looks after stragglers without waiting; returns how many are left. */
uint32_t stragglers(struct target *target);
/* What ptrace can read of a stopped thread: mask, robust list, rseq. */
int thread_read(struct thread *thread, struct avc_error *err) warn_unused;
/* What only a thread itself can tell (clear_child_tid, sigaltstack, credentials): added to
 * calls that it makes anyway, and what came of it.  `with_locks`: of its process, what is to
 * be locked in memory; there is a mapping more while that is found out. */
void ask_add(const struct target *target, bool with_locks, struct inj_call *call,
	     struct questions *questions);
int ask_answer(struct thread *thread, const struct inj_call *call,
	       const struct questions *questions, struct avc_error *err) warn_unused;
/* Asks a stopped thread just that; if it is the main thread, ask_others(). */
int ask(struct target *target, struct thread *thread, struct avc_error *err) warn_unused;
/* The main thread was asked, and had other credentials before: a change may be one of all
 * threads (nptl(7), setuid(3)), so these are to be asked again, too (EAGAIN). */
int ask_others(struct target *target, const struct thread *thread, const struct creds *was,
	       struct avc_error *err) warn_unused;
/* The threads there are now; those that ended are forgotten. */
int take_stock(struct target *target, struct avc_error *err) warn_unused;
/* Gets known every thread that is not yet, one at a time, before a freeze. */
int acquaint(struct target *target, timer_t timer, uint64_t deadline_ns,
	     struct avc_error *err) warn_unused;
/* Where a thread inside a restartable sequence has to go on (rseq(2)). */
void rseq_fixup(int mem_fd, struct thread *thread);

/* ---- files*.c (files.h) --------------------------------------------------------- */

/* Before a freeze: what can be known of the app's descriptors while it runs. */
int files_prepare(struct target *target, struct avc_error *err) warn_unused;
/* A pipe of our own, through which others are read; { -1, -1, 0 } at first. */
struct scratch {
	int in, out, bytes;
};
void scratch_close(struct scratch *scratch);
/* During it: what is of this instant.  `several`: the app has other processes, which may
 * have the other ends of pipes.  `kin`: what process `kin_pid` has, of the same freeze, or
 * NULL. */
int files_capture(struct target *target, struct generation *generation, bool several,
		  const struct files *kin, pid_t kin_pid, struct scratch *scratch,
		  struct avc_error *err);
/* After it. */
void files_settle(struct target *target, struct generation *generation);
/* Of cameras, in the template (files_video.c). */
void files_unmap_areas(struct target *target, const struct generation *generation);
/* The same for all processes: what they share of open files, and who of them is named.
 * `before`: the checkpoint before, or NULL. */
void files_settle_family(const struct target *main, struct generation *generation,
			 const struct generation *before);
void files_forget(struct target *target);
void files_free(struct files *files);
/* A table that is made anew: what is to be in it. */
struct files_table {
	uint32_t count;
	struct {
		int fd, ours;
		bool cloexec;
	} * entry; /* by fd, ascending                                        */
};
/* Makes the tables of a dead app the generation's again: that of the main process, which
 * its templates hold, at once; of the others (table[], by branch) what is to be in them.
 * Lists what the restored processes have to do themselves.  What could not be put back is
 * told in *notes; -1 is for what must not go on. */
int files_restore(struct target *target, struct generation *generation,
		  const struct avc_config *config, pid_t init, struct files_table *table,
		  struct avc_error *notes, struct avc_error *err) warn_unused;
/* A process that is to be restored opens its pidfds itself: as many descriptors as it takes, until
 * it puts its limit back after that. */
void files_lift_limit(const struct files *want, pid_t pid);
void files_table_free(struct files_table *table);
/* A descriptor of that device, as stat(2) numbers it; -1: there is none. */
int files_find_device(const struct files *files, uint32_t rdev);
/* A duplicate of a descriptor of another process, or -1. */
int files_borrow(int pidfd, int fd);
/* In a parasite: what recvmsg(2) needs for one descriptor, `remote` there; the header is first. */
struct files_letter {
	struct msghdr head;
	struct iovec io;
	uint8_t byte;
	uint8_t control[CMSG_SPACE(sizeof(int))] __attribute__((aligned(8)));
};
void files_letter_write(struct files_letter *letter, avc_remote remote);
/* One descriptor over a socket (unix(7), SCM_RIGHTS). */
int files_send(int socket, int fd);
/* Whether the restored process could do it all. */
void files_check_calls(const struct parasite *parasite, uint32_t slot, pid_t inside,
		       struct avc_error *notes);
/* -1 if a file was written since, with AVC_UNSUPPORTED and which.  `pid` is a process
 * that has the table as it is now, `holder` one that has the memory. */
int files_check_strict(const struct generation *generation, pid_t pid, int pidfd, pid_t init,
		       pid_t holder, struct avc_error *err) warn_unused;

/* files_mapped.c: what is in files that are mapped for writing.  Before a freeze; NULL:
 * out of memory. */
struct files_mapped *files_mapped_prepare(pid_t pid, uint64_t limit_bytes);
/* While everything is stopped; NULL: nothing. */
void files_mapped_copy(struct files_mapped *mapped);
void files_mapped_free(struct files_mapped *mapped);
int files_mapped_check(const struct generation *generation, pid_t holder,
		       struct avc_error *err) warn_unused;

/* files_written.c: what is written in the container's mount namespace. */
struct files_written *files_written_new(void);
void files_written_free(struct files_written *written);
/* From now on; *notice if it can not be. */
void files_written_watch(struct files_written *written, pid_t pid, struct avc_error *notice);
/* Whether a file was written since the last time this was asked, and which; inherited
 * ones in `files` (may be NULL) do not count. */
bool files_written_since(struct files_written *written, const struct files *files,
			 char name[FILES_NAME]);

/* ---- freeze.c ------------------------------------------------------------------ */

struct freeze_times {
	uint64_t freeze_ns, stop_ns, clone_ns;
};

/* Every thread of one process is stopped; all go on. */
int stop_process(struct target *target, struct avc_error *err) warn_unused;
void let_go_process(struct target *target);
/* Takes one checkpoint into *generation (slot and number given by the caller); `seen`: the
 * shared memory that is prepared for already.
 * On return the app runs, whatever happened. */
int freeze(struct tree *tree, timer_t timer, uint64_t deadline_ns, struct generation *generation,
	   struct mem_seen *seen, struct freeze_times *times, struct avc_error *err) warn_unused;

/* ---- generation.c -------------------------------------------------------------- */

/* After the app runs again: finishes the template and its slot. */
int generation_finish(struct target *target, struct generation *generation,
		      struct avc_error *err) warn_unused;
void generation_drop(struct generation *generation);
/* That of a process that is not the main one, or NULL; `generation` may be NULL. */
struct branch *generation_branch(const struct generation *generation, const struct target *target);
/* Of all its processes. */
uint32_t generation_threads(const struct generation *generation);
/* Closes what the template of a process that has ended still has open. */
void generation_close_files(struct target *target, struct generation *image);
/* The same of all processes but the main one, once they are restored and have tables of
 * their own: before they go on, for what they close is to be closed. */
void generation_close_tables(const struct generation *generation);
void oom_score_adj_set(pid_t pid, const char *value);

/* ---- restore.c ------------------------------------------------------------------ */

/* What takes less than a millisecond or so to fork gets the number that it is to have sooner or
 * later, also where others fork all the time.  What has more pages is copied first (spare.c). */
#define COPIED_PAGES 16384

struct restore_times {
	uint64_t restore_ns, fork_ns, threads_ns;
	struct avc_error notice; /* what could not be put back                  */
};

/* Makes the app anew from the generation; *notes is what is not as it was.  `ready` is called when everything is
 * there, before anything runs: it sends the verdict.  On success *pid is the new
 * main process. */
int restore(struct target *target, struct generation *generation, struct init_channel *channel,
	    const struct avc_config *config, timer_t timer, uint64_t died_ns,
	    int (*ready)(void *arg, struct avc_error *err), void *arg, pid_t *pid,
	    struct restore_times *times, struct avc_error *notes,
	    struct avc_error *err) warn_unused;

/* ---- syscall_batch.c ----------------------------------------------------------------------- */

#define BATCH_SOFTS 64

/* A task that a restored process has forked, and that is made what a template is. */
struct syscall_batch {
	pid_t pid;
	const struct parasite *parasite; /* the one it runs in                              */
	struct inj_call *call;
	struct arch_regs base;
	struct inj_syscall *list; /* in the parasite: calls not made yet                  */
	uint32_t listed, list_max;
	uint8_t *data; /* in the parasite: for what the calls refer to             */
	struct soft {
		uint32_t index;
		const char *problem;
	} soft[BATCH_SOFTS]; /* of the calls, those that may fail                  */
	uint32_t softs;
	pid_t inside; /* for notes: what did fail                            */
	struct avc_error *notes;
	int socket; /* ours, through which it gets descriptors; -1     */
};

/* From now on it runs in that parasite. */
void syscall_batch_enter(struct syscall_batch *batch, const struct parasite *parasite,
			 uint32_t slot);
/* One more call.  All of them are made by syscall_batch_flush(), which leaves the results in
 * batch->list and tells the first that failed. */
void syscall_batch_add(struct syscall_batch *batch, long nr, uint64_t a, uint64_t b, uint64_t c,
		       uint64_t d, uint64_t e, uint64_t f);
/* The same, for any number: those before it are made when there is no more room. */
int syscall_batch_ask(struct syscall_batch *batch, long nr, uint64_t a, uint64_t b, uint64_t c,
		      uint64_t d, uint64_t e, uint64_t f, struct avc_error *err) warn_unused;
/* The last one may fail: then `problem`, if any, is noted. */
void syscall_batch_soften(struct syscall_batch *batch, const char *problem);
int syscall_batch_flush(struct syscall_batch *batch, struct avc_error *err) warn_unused;
void *syscall_batch_data(const struct syscall_batch *batch, avc_remote *remote);
/* Two ends of a socket: ours, and the number of the other one there.  Both -1: there is none. */
struct fd_channel {
	int ours, theirs;
};

/* Closes what it has from its parent; from here on it can be given descriptors, each to be
 * number 1 until that is closed.  By the `fd_channel` that it has from its parent, if any, or its own. */
int syscall_batch_open_fd_channel(struct syscall_batch *batch, const struct fd_channel *fd_channel,
				  struct avc_error *err) warn_unused;
/* Of the main process, for its children, who have it from the fork: to make one takes longer than
 * all that comes by it.  None where there is no number left for it. */
int syscall_batch_share_fd_channel(struct syscall_batch *batch, struct fd_channel *fd_channel,
				   struct avc_error *err) warn_unused;
int syscall_batch_unshare_fd_channel(struct syscall_batch *batch, struct fd_channel *fd_channel,
				     struct avc_error *err) warn_unused;
int syscall_batch_give(struct syscall_batch *batch, int fd, struct avc_error *err) warn_unused;
/* From its parent's parasite into its own. */
int syscall_batch_change_parasite(struct syscall_batch *batch, const struct target *target,
				  uint32_t slot, struct avc_error *err) warn_unused;
/* Its descriptors; it gets no more after that. */
int syscall_batch_put_files(struct syscall_batch *batch, const struct files_table *table,
			    struct avc_error *err) warn_unused;

/* ---- process_attrs.c ------------------------------------------------------------------------ */

/* After the app runs again: what only the template can tell. */
int branch_learn(struct branch *branch, struct avc_error *err) warn_unused;
void branch_forget(struct branch *branch);
/* All protection keys, before its memory refers to some and while the kernel must not choose one
 * (pkeys(7), of what can only be executed).  process_attrs_put() frees those that it did not have. */
int process_attrs_take_keys(struct syscall_batch *batch, struct avc_error *err) warn_unused;
/* A restored process gets it, with the batch's next flush. */
int process_attrs_put(struct syscall_batch *batch, const struct branch *branch,
		      struct avc_error *err) warn_unused;
/* Until then nothing is limited: it may have more than it may have now, and its parent may have
 * lowered its own limits since.  Its descriptors are below `files`. */
void process_attrs_lift_limits(pid_t pid, const struct branch *branch, uint32_t files);
/* One limit, to as much as there is, and to `least` at least; beyond the hard one that takes
 * CAP_SYS_RESOURCE (setrlimit(2)), without which it is lifted up to there. */
void limit_lift(pid_t pid, int which, uint64_t least);
/* By the process itself, as the last: to set another user's takes CAP_SYS_RESOURCE (prlimit(2)). */
void process_attrs_setup_limits(const struct branch *branch, struct setup *setup);

/* ---- restore_tree.c ------------------------------------------------------------------------- */

/* All processes of a generation, of which the main one is there; each is stopped.
 * `table`: of each branch. */
struct restore_tree;
struct restore_tree *restore_tree_new(struct target *main, struct generation *generation,
				      struct last_pid *helper, struct init_channel *channel,
				      timer_t timer, const struct files_table *table,
				      struct avc_error *err);
/* The main process (a stopped tracee) brings forth the others. */
int restore_tree_make(struct restore_tree *tree, pid_t main_pid, struct avc_error *notes,
		      struct avc_error *err) warn_unused;
/* They put themselves together, but for the main one. */
int restore_tree_start(struct restore_tree *tree, struct avc_error *notes,
		       struct avc_error *err) warn_unused;
void restore_tree_go(struct restore_tree *tree);
void restore_tree_kill(struct restore_tree *tree);
void restore_tree_free(struct restore_tree *tree);
/* PID of a branch's process, when all of it is there. */
pid_t restore_tree_pid(const struct restore_tree *tree, uint32_t branch);

/* ---- snapshot.c --------------------------------------------------------------------- */

struct mappings {
	struct mapping *map;
	uint32_t count, room;
};

/* A stretch of a mapping, and what pagemap says of each page. */
struct extent {
	avc_remote start, end;
	uint64_t *frame;
};

struct pages {
	bool known;
	uint32_t count, room;
	struct extent *extent; /* in order                                           */
};

struct snapshot {
	pid_t template;
	int pagemap;
	struct mappings maps;
	struct pages *pages; /* by mapping, of those that were asked for              */
};

/* `image`: of the same process. */
struct snapshot *snapshot_new(pid_t template, const struct mem_image *image, struct avc_error *err);
void snapshot_free(struct snapshot *snapshot);
/* Frees what it knows of pages, until it is asked for them again; NULL: nothing to do. */
void snapshot_rest(struct snapshot *snapshot);
/* Of one of its mappings, a private one.  NULL on error. */
const struct pages *snapshot_pages(struct snapshot *snapshot, const struct mapping *mapping,
				   struct avc_error *err);
/* From `address` on; NULL where there is nothing.  `*end` is lowered to where that changes;
 * `*next`, 0 at first, is where the search for a higher address begins. */
const uint64_t *pages_frames(const struct pages *pages, uint32_t *next, avc_remote address,
			     avc_remote *end);

/* ---- copier.c ----------------------------------------------------------------------- */

struct copier;

struct copier *copier_new(struct avc_error *err); /* NULL on error */
/* What is added from here on goes from `template` to `pid`. */
int copier_open(struct copier *copier, pid_t template, pid_t pid,
		struct avc_error *err) warn_unused;
/* One stretch of memory.  `plain`: the mapping may be read and written. */
int copier_add(struct copier *copier, avc_remote from, avc_remote to, bool plain,
	       struct avc_error *err) warn_unused;
/* Lends a hand; false when nothing is left, and then it can be finished. */
bool copier_help(struct copier *copier);
int copier_finish(struct copier *copier, struct avc_error *err) warn_unused;
void copier_free(struct copier *copier);

/* ---- remap.c ----------------------------------------------------------------------- */

struct remap;

/* What makes the memory of a fork of `is` that of `want`.  Both snapshots have to stay.
 * NULL on error. */
struct remap *remap_plan(const struct target *target, struct snapshot *want, struct snapshot *is,
			 struct avc_error *err);
/* Whether there is a way from the one to the other, while it is not needed yet: of some mappings
 * only who has them can give them to others, and only by a fork. */
int remap_check(const struct target *target, struct snapshot *want, struct snapshot *is,
		struct avc_error *err) warn_unused;
/* Does it, with a batch that is in the parasite of the plan's target already; but the copier
 * may not have finished. */
int remap(const struct remap *plan, struct syscall_batch *batch, struct copier *copier,
	  struct avc_error *err) warn_unused;
void remap_free(struct remap *plan);

/* ---- restore_plan.c --------------------------------------------------------------------- */

/* Of a generation that is whole; once is enough.  `ahead_ns`: CPU time that restore_plan_next() may
 * spend on it, about. */
int restore_plan_begin(struct generation *generation, uint64_t ahead_ns,
		       struct avc_error *err) warn_unused;
/* Who is to fork a branch's process: another branch, or PARENT_MAIN. */
int restore_plan_host(const struct generation *generation, uint32_t index);
/* How it is made of that fork; NULL on error. */
const struct remap *restore_plan_of(struct generation *generation, uint32_t index,
				    struct avc_error *err);
/* Of a checkpoint: whether the processes can be made of their parents at all. */
int restore_plan_check(const struct generation *generation, struct avc_error *err) warn_unused;
/* Finds out about one more of them, so that a restore need not; false: that is all. */
bool restore_plan_next(struct generation *generation);
void restore_plan_free(struct restore_plan *plan);

/* ---- spare.c ------------------------------------------------------------------------ */

/* Makes one for a generation that is whole, if the kernel lets it, and if it comes to that
 * before the deadline.  -1: nothing can be restored from the generation any more. */
int spare_make(struct target *target, struct generation *generation,
	       struct avc_error *err) warn_unused;
/* While the app is dead: at the template's own priority, and until it is there or refused. */
int spare_make_now(struct target *target, struct generation *generation,
		   struct avc_error *err) warn_unused;
/* Before the template is used for anything else: waits until it has done what it had not at
 * the deadline of spare_make().  -1: it has not, AVC_DEADLINE, or as above. */
int spare_await(struct target *target, struct generation *generation,
		struct avc_error *err) warn_unused;
bool spare_is_there(struct generation *generation);
/* There may be one that only the kernel knows of (init_channel_kill_lost). */
bool spare_is_unknown(const struct generation *generation);
void spare_drop(struct generation *generation);

/* ---- restore.c, for one process of several ----------------------------------------- */

/* Lets a stopped process that is what its template is put itself together; waits until
 * it has; tells what of it failed; lets it go. */
int restore_start(struct target *target, struct generation *image, struct last_pid *helper,
		  pid_t pid, struct sandbox **sandbox, struct avc_error *err) warn_unused;
int restore_await(struct target *target, struct generation *image, pid_t pid,
		  struct sandbox *sandbox, struct avc_error *err) warn_unused;
void restore_note(struct target *target, struct generation *image, pid_t pid,
		  struct avc_error *notes);
void restore_go(struct target *target, struct generation *image, struct sandbox *sandbox);

/* ---- rt_priority.c -------------------------------------------------------------------- */

/* The calling thread gets a CPU before others from here to the other; best effort.
 * May be nested. */
void rt_priority_begin(void);
void rt_priority_end(void);

/* ---- last_pid.c ------------------------------------------------------------------- */

/* Starts a helper task inside the PID namespace; it serves the slot's requests
 * until last_pid_stop().  last_pid_set() is the engine's own request. */
struct last_pid *last_pid_start(int pidns_fd, struct inj_slot *slot, struct avc_error *err);
int last_pid_set(struct last_pid *helper, pid_t value, struct avc_error *err) warn_unused;
/* From now on those of another slot. */
void last_pid_serve(struct last_pid *helper, struct inj_slot *slot);
void last_pid_stop(struct last_pid *helper);

/* ---- rewind.c --------------------------------------------------------------------- */

/* A thread that just stopped: remembers which call it is in.  If that was only interrupted
 * by us, the thread is set to make it again, or, when the call's time is up, to answer that. */
void rewind_call(struct target *target, struct thread *thread);
/* Just before it goes on: takes off what the stop has added to a wait. */
void rewind_count_stop(const struct target *target, const struct thread *thread);
/* Registers as the app had them, before rewind_call() marked the call or the kernel made
 * restart_syscall(2) of it. */
void rewind_original(const struct thread *thread, struct arch_regs *regs);

/* Shortly before a thread is stopped that may be in such a call, as far as one knows: since when
 * it sleeps. */
void rewind_prepare(struct thread *thread);

/* ---- waits.c ---------------------------------------------------------------------- */

/* Before a freeze: looks at those that may be waiting. */
void waits_prepare(struct target *target);
/* Ends the calls that were rewound and whose time is up; the next one's is at
 * target->due_ns (UINT64_MAX: none). */
void waits_end(struct target *target, timer_t timer);

/* ---- support.c --------------------------------------------------------------------- */

/* Looks at a running app for what can not be protected.  0, or -1 with
 * AVC_UNSUPPORTED and the reason in words. */
int support_check(struct target *target, struct avc_error *err) warn_unused;
/* The same of a stopped thread. */
int support_check_thread(pid_t tid, struct avc_error *err) warn_unused;
/* Whether the (running, infected) process has another program: what was brought into it
 * is gone. */
bool has_executed(const struct target *target);
/* True if this looks like a moment at which nobody is in the middle of anything. */
bool quiescent(const struct target *target);

/* ---- init_channel.c -------------------------------------------------------------------------- */

void init_channel_init(struct init_channel *channel);
/* True once the app's main process runs a program of its own. */
bool init_channel_app_started(const struct init_channel *channel, pid_t app);
/* 1: connected, 0: init is not ready yet, -1: error. */
int init_channel_open(struct init_channel *channel, struct avc_error *err) warn_unused;
void init_channel_close(struct init_channel *channel);
/* The app's main process in our namespace, 0 if it is not there (yet). */
pid_t init_channel_app(const struct init_channel *channel);
void init_channel_arm(struct init_channel *channel, bool armed);
bool init_channel_stop_asked(const struct init_channel *channel);
int init_channel_report(struct init_channel *channel, struct avc_report *report);
/* Of the last death.  init waits for only so long, and anew from each init_channel_working() on,
 * which may be called as often as there is progress. */
int init_channel_verdict(const struct init_channel *channel, enum avc_verdict_kind kind,
			 struct avc_error *err);
void init_channel_working(struct init_channel *channel);
/* Kills and reaps the children of init that are tracees of ours but not known:
 * clones of which we never heard, because the thread that made them was killed before
 * it could tell.  They would keep the app's number (as a process group's) and, as
 * zombies, the container from ending. */
void init_channel_kill_lost(const struct init_channel *channel,
			    bool (*known)(pid_t pid, const void *arg), const void *arg);
/* Kills what the dead app left behind: children of init, but those to keep.  tend() is called
 * while it waits for their end.  0: none of them runs any more; AVC_DEADLINE: one does. */
int init_channel_kill_leftovers(struct init_channel *channel,
				bool (*keep)(pid_t pid, const void *arg), void (*tend)(void *arg),
				void *arg, struct avc_error *err) warn_unused;

/* ---- engine.c --------------------------------------------------------------------------- */

void engine_emit(struct avc_engine *engine, const struct avc_event *event);

#endif
