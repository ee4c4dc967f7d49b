/* SPDX-License-Identifier: Apache-2.0
 *
 * Stopped tasks: ptrace(2), threads of the app, and our code run in them.
 *
 *   tracee.c        seize, stop, wait, release
 *   thread.c        a thread of the app: stopped, released
 *   rewind.c        interrupted system calls
 *   cut.c           ... that have done a part
 *   parasite.c      the parasite as the engine sees it, code run in a process
 *   seccomp.c       ... despite the app's seccomp filters (seccomp.h)
 *   setup.c         lists of calls that a restored process makes
 *   syscall_batch.c calls of a process that is being created
 *   fd_channel.c    ... and descriptors for it
 *   last_pid.c      the next PID of another PID namespace
 *   init_channel.c  to avckpt-init: control page, reports, verdicts
 */
#ifndef AVCKPT_TRACE_H
#define AVCKPT_TRACE_H

#include <poll.h>
#include <sys/socket.h>
#include <sys/uio.h>

#include "avckpt/ctl.h"
#include "base.h"
#include "parasite.h"

#define THREADS_MAX 4096
#define OLD_PARASITES_MAX 128
#define SOCKETS_MAX 64
/* PTRACE_GET_RSEQ_CONFIGURATION, since Linux 5.13; glibc before 2.35 lacks the name. */
#define PTRACE_GET_RSEQ 0x420f
#define SS_AUTODISARM_ (1u << 31) /* linux/signal.h, which does not go with signal.h */

/* The call that a thread was in when it was last stopped. */
struct call {
	long nr;
	avc_remote pc, sp;
	uint64_t arg[3];
};

/* What is remembered of a call that was rewound (rewind.c). */
struct rewound {
	uint32_t mark; /* of that call; 0: none                            */
	int answer;    /* its result when its time is up                   */
	uint64_t since_ns, due_ns;
	/* It began at this time by the clock of that CPU (cpu_clock.c), not yet converted;
	 * 0: nothing to convert. */
	uint64_t ran_ns;
	uint32_t cpu, looks;
	uint64_t sleeps; /* of the thread, once it waited again (waits.c) */
	bool sleeps_known, waiting;
};

/* A thread that slept, as far as one can tell from outside, just before it was stopped. */
struct sleeper {
	bool known, timed; /* timed: a call of it with a timeout was rewound before */
	uint32_t cpu;
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
	uint64_t state_permitted; /* arch_cpu.h, ARCH_STATE_PERMITTED                 */
	uint32_t personality;
	uint32_t securebits, no_new_privs;
	uint32_t death_signal, subreaper;
	uint64_t filters; /* of seccomp: a hash                               */
	uint32_t fenced;  /* in a Landlock domain that the main process is not in (fence.c) */
	int32_t group_count;
	uint32_t group[GROUPS_KEPT]; /* supplementary                             */
	int32_t memory_policy;       /* set_mempolicy(2), -1: the kernel has none */
	uint64_t nodes[NODE_WORDS];
	uint64_t slack_ns;   /* of timers                                        */
	int32_t future_lock; /* mlockall(2), of the main thread only            */
};

/* Queries to a thread (process.c); NULL: not made. */
struct questions {
	const struct inj_syscall *tid_address, *altstack, *inside, *name, *locks, *attributes,
		*dumpable, *sight;
};

/* How injected code gets along with the app's seccomp filters (seccomp.c). */
enum seccomp_way {
	SECCOMP_NONE,      /* there are none                                       */
	SECCOMP_IN_FORCE,  /* they allow its calls                                 */
	SECCOMP_LESS,      /* ... but not all that restoring several processes takes */
	SECCOMP_SUPERVISED /* they refuse some: seccomp_supervise()                */
};

struct thread {
	pid_t tid; /* in our namespace                                 */
	bool seen; /* there at this freeze                             */
	bool attached, stopped;
	bool plain;      /* traced with TRACE_OPTIONS_APP, unless it is supervised    */
	int stop_signal; /* the process is stopped by job control           */
	int block;       /* of the slot, main thread 0; -1: not in the image */
	bool borrowed;   /* sent into the parasite; regs and sigmask are its own  */
	struct parasite *borrowed_for; /* NULL: before there is one (porter.c)              */
	avc_remote stub;               /* where it has been sent instead                     */
	uint32_t filters_known;        /* of seccomp, at the last check                   */
	uint32_t filter_count;         /* ... when it was queried (state/filters.c)        */
	enum seccomp_way seccomp;
	bool vetted;           /* thread_vet() has checked it at this stop                */
	int32_t umask;         /* of its process, as read at this stop; -1: it was not        */
	bool sent_back;        /* into its call, at this stop (ARCH_FORGETS_CALLS)        */
	struct arch_regs regs; /* as of the stop, EINTR already replaced        */
	uint64_t sigmask;
	uint64_t robust_list, robust_bytes;
	uint64_t rseq;
	uint32_t rseq_bytes, rseq_signature;
	uint64_t affinity[INJ_CPU_WORDS];
	uint32_t affinity_bytes;
	/* Queried from the thread itself, or slow to read; kept between checkpoints as long as it
	 * looks like the same thread. */
	bool known;
	uint32_t asked; /* checkpoints since                                */
	bool due;       /* to be queried again in the freeze                        */
	bool young;     /* queried only once: it may just be initializing           */
	pid_t inside;
	uint64_t known_tls;
	uint64_t clear_tid;
	uint64_t altstack[3]; /* sp, flags, size                                */
	bool disarmed;        /* it is in a handler on it (SS_AUTODISARM)       */
	char name[16];
	struct creds creds;
	struct scheduling scheduling; /* at this freeze                         */
	struct call call;
	struct rewound rewound;
	struct sleeper sleeper;
	uint64_t stopped_ns;
	struct {
		avc_remote pc, sp;
		uint64_t sigmask;
	} looked_at;    /* when it was in no handler (dying.c)                     */
	bool signalled; /* was about to run a handler                       */
};

struct parasite {
	avc_remote base; /* 0: none                                          */
	enum seccomp_way seccomp;
	pid_t inside; /* the infected process, in its own namespace            */
	size_t bytes;
	uint8_t *map; /* our view of the same pages                       */
	struct inj_control *control;
	uint32_t slots, threads_max;
	size_t slot_bytes, block_bytes;
	/* When a thread has left it by itself, until a stop of the process has shown that it is home; or
	 * 0.  It may still be in the handler of a signal that came on the way, and return to it: where
	 * it goes home to must not be overwritten, and it is in no image. */
	uint64_t left_ns;
	bool late; /* the last stop has shown that it was not            */
	/* Memory of the guard, not of the app: the code, sealed against writing; and the rest,
	 * which the app can write as well. */
	int code_fd, data_fd;
};
#define PARASITE_NAME "avckpt-parasite"
#define PARASITE_MAPPED "/memfd:" PARASITE_NAME " (deleted)"
/* How it is mapped in two parts. */
#define PARASITE_CODE_PROT (PROT_READ | PROT_EXEC)
#define PARASITE_DATA_PROT (PROT_READ | PROT_WRITE)
#define PARASITE_FLAGS (MAP_SHARED | MAP_FIXED_NOREPLACE | MAP_NORESERVE)
#define PARASITE_FLAGS_OVER (MAP_SHARED | MAP_FIXED | MAP_NORESERVE)

/* How far a freeze has come with a process. */
enum freeze_stage {
	FREEZE_RUNS,    /* or not all of its threads are known to be stopped        */
	FREEZE_STOPPED, /* all its threads are stopped                          */
	FREEZE_BEGUN    /* and it is being read, cloned and queried                   */
};

/* A live process of the app. */
struct process {
	/* The thread by which /proc and ptrace(2) reach the process: the main thread, or, when that
	 * has ended, any other (process_follow).  0: none                         */
	pid_t pid;
	pid_t leader; /* the process's own PID                               */
	pid_t inside; /* the same in its own namespace                       */
	int pidfd, task_dirfd, mem_fd, timers_fd, stat_fd, statm_fd, status_fd;
	int leader_pidfd; /* when pidfd is of another thread: of the process    */
	struct parasite parasite;
	bool infected; /* the parasite is known to be in this process           */
	pid_t holder;  /* 0: none                                          */
	pid_t holder_inside;
	int holder_pidfd;
	struct arch_regs holder_base; /* a user context of it                              */
	/* When the holder was made, of a process that is not the main one: root and working
	 * directory, umask. */
	struct folders {
		uint64_t device[2], inode[2], mount[2], umask;
	} folders;
	struct thread *threads;
	uint32_t thread_count, thread_room;
	uint64_t due_ns; /* when the first of its calls has to be ended (waits.c)  */
	uint64_t nonce;
	/* Parasites left behind by dead guards; unmapped by the second checkpoint, when no thread
	 * can be in them any more. */
	struct {
		avc_remote base;
		size_t bytes;
	} old_parasite[OLD_PARASITES_MAX];
	uint32_t old_parasites, checkpoints;
	uint64_t given; /* signals for any thread: those released at this stop get them */
	/* Stubs that stay, because a task may still be in them, or return there (cave.c). */
	avc_remote stubs_start, stubs_end;
	/* A thread died while it may have been cloning: there may be a tracee that is on no list
	 * (init_channel_kill_lost). */
	bool lost;
	/* CLONE_FILES, CLONE_FS: it has the descriptor table, or the directories, of the process
	 * that will fork it (tree.c). */
	uint64_t shared;
	bool childless;                     /* it had no child process at the last checkpoint   */
	const struct inj_syscall *children; /* the query whether it has, in a freeze   */
	struct questions questions;         /* and the other queries                   */
	uint64_t asked_ns;
	bool asked;
	uint32_t blocks;     /* of the slot, that its threads take up in this freeze     */
	long surveyed_pages; /* size when its mappings were last read           */
	uint64_t pinned_ns;  /* when files_may_pin() was last true: dirty.c             */
	int sockets[SOCKETS_MAX];
	uint32_t socket_count;
	struct pending *pending;
	bool stop_heard; /* stopped by job control, and its parent has waited for that */
	struct timers *timers;
	struct memory *memory;
	struct mem_others *others; /* of the main one, and so of all             */
	uint64_t shm_bytes;        /* shared memory that is rolled back, at most       */
	uint32_t plain_filters;    /* seccomp filters of init: the container's        */
	uint32_t filters;          /* ... its own, at the last check                  */
	/* Whether it has any of its own, and whether that is known since it was stopped. */
	bool filters_own, filters_seen;
	/* What its status says, read once in a freeze: each time takes some 8 us. */
	struct seccomp_counts {
		bool known;
		uint32_t umask, mode, filters;
	} counts;
	uint32_t main_filters; /* ... of the main process                         */
	struct chains *chains; /* ... of its threads (state/filters.c)            */
	pid_t init;            /* avckpt-init                                      */
	struct files *files_before, *files_image; /* files_capture.c           */
	uint32_t files_seen;
	/* By number: found to be the parent's before the first look; allocated, NULL: not known. */
	uint8_t *heirs_likely;
	int heirs_count;
	bool heirs_change; /* inherited files have changed between two checkpoints    */
	bool heirs_vary;   /* ... in a freeze                                        */
	bool young_vary;   /* of the main one: ... of one that had just been started     */
	bool tcp_moved;    /* bytes of connections are counted                 */
	bool tcp_messages; /* quiescent only between two messages              */
	/* Of a process that is not the main one (tree.c). */
	bool descendant;
	uint64_t start;               /* start time; tells it from one with the same PID  */
	uint32_t images;              /* generations that have one of it                  */
	enum freeze_stage stage;      /* in this freeze                                    */
	bool cloning;                 /* by its holder, the main one by itself: freeze_tree()  */
	pid_t cloned;                 /* it is done already, and this is the clone; 0: no      */
	long clone_pages;             /* its size when that began                         */
	long anon_pages;              /* of its last template; 0: none yet                */
	uint64_t caught;              /* fatal signals that it has had handlers for        */
	uint64_t uncaught;            /* and has no longer                                 */
	uint64_t dying_ns;            /* since when it has been in one                     */
	bool alive;                   /* for too long: it goes on running in the handler   */
	bool doubtful;                /* it was cloning when a checkpoint failed          */
	const struct creds *forebear; /* of a process forked from the main one             */
	const struct process *main;   /* that one; NULL: this is it                        */
	bool blind;                   /* it may not even look at its holder                 */
	bool renewed;                 /* its holder was, for the threads' sake (fence.c)    */
	bool undumpable;              /* prctl(2), PR_GET_DUMPABLE, when it was last asked  */
	bool late;                    /* its holder closes descriptors late (files_late.c)   */
	bool adopts;                  /* it or an ancestor adopts orphans, or may do so     */
	bool paused; /* between process_pause_adoption() and process_resume_adoption()         */
	struct tracker *tracker; /* process/tracker.c; NULL: its memory is not watched         */
	pid_t recycling; /* in this freeze that template (PID inside) is brought up to date  */
	/* Readable when it may have executed another program (executed.c); fd -1: not used. */
	struct exec_sign {
		int fd;
		void *page;
		bool over; /* it reports nothing any more: to be closed, which takes some 70 us */
	} exec_sign;
	uint64_t held_ns, exec_check_ns; /* since when it has a holder; next check for that */
};

/* ---- tracee.c ---------------------------------------------------------------- */

/* The one signal the library uses, thread-directed, to end a wait(2) or a tracee_seize() in time: it
 * interrupts calls and does nothing else. */
int tracee_timer_signal(void);
int tracee_timer_new(timer_t *timer, struct avc_error *err) warn_unused;
/* ppoll(2), which ends with EINTR, too, as soon as a tracee has stopped or ended, even before the call. */
int tracee_poll(struct pollfd *fds, nfds_t n, const struct timespec *timeout);
void tracee_deadline_set(timer_t timer, uint64_t ns);
void tracee_deadline_clear(timer_t timer);
bool tracee_deadline_passed(void);
/* For a loop that waits, with looks at something else: when it is to end (restore_patience()), and
 * before each look whether it may go on. */
uint64_t tracee_deadline(uint64_t ns);
bool tracee_has_time(uint64_t end_ns);

enum stop_kind {
	STOP_TRAP,  /* our PTRACE_INTERRUPT, or a new tracee's first stop     */
	STOP_GROUP, /* job control: the app is stopped by a signal            */
	STOP_FORK,  /* FORK, VFORK, CLONE event; `message` is the child       */
	STOP_SYSCALL,
	STOP_SIGNAL,   /* about to receive `signal`                              */
	STOP_EXIT,     /* gone; reaped                                           */
	STOP_DYING,    /* killed, to be reaped later (threads_tend_stragglers())              */
	STOP_DEADLINE, /* did not stop in time                                   */
	STOP_NONE,     /* WNOHANG: no stop                                       */
	STOP_OTHER
};

struct stop {
	enum stop_kind kind;
	int event, signal, status;
	pid_t message;
};

/* From now on a wait also ends (as at the deadline) when *word is not 0; NULL: no more. */
void tracee_watch(const uint32_t *word);
/* Waits for the next stop of one tracee of this thread; options: 0 or WNOHANG.  A STOP_SIGNAL is
 * reported again until the tracee continues: so the application gets its signal even if we die. */
struct stop tracee_wait(pid_t tid, int options);
/* For a running tracee that was interrupted (or is new): waits until it is in a plain trap stop
 * (STOP_TRAP); signals in between are delivered.  A task that it creates is returned in *child
 * (NULL: not expected).  Anything but STOP_TRAP is an error. */
enum stop_kind tracee_await(pid_t tid, pid_t *child, struct avc_error *err) warn_unused;
/* The same; tick() is called now and then, as long as there is a deadline. */
enum stop_kind tracee_await_while(pid_t tid, void (*tick)(void), pid_t *child,
				  struct avc_error *err) warn_unused;
/* The job control signal by which the tracee awaited last is stopped; 0: it is not. */
int tracee_group_signal(void);
/* From a stop of another kind to a plain trap stop, on the way back to user mode, where the kernel
 * handles interrupted calls and signals. */
int tracee_settle(pid_t tid, struct avc_error *err) warn_unused;
/* The same for a task of ours that may be running. */
int tracee_halt(pid_t tid, struct avc_error *err) warn_unused;
/* The program counter of a tracee once it is stopped; 0: it did not stop for some milliseconds, or
 * has ended. */
avc_remote tracee_pc(pid_t tid);
/* Tracees that are not reported to us: clone(2) with CLONE_PTRACE attaches a child to its parent's
 * tracer, if there is one by then; but whether to report it is decided at the start of the call
 * (kernel/fork.c, kernel_clone()).  One that is not known() is released once it has stopped. */
void tracee_know(bool (*known)(pid_t tid, const void *arg), const void *arg);
void tracee_release_strangers(void);
/* One may appear: it is looked for during a second. */
void tracee_expect_strangers(void);
bool tracee_expects_strangers(void);
/* Reaps a dead tracee of this thread that is not known(): true if there was one.  A task that a
 * thread was creating when it was killed is our tracee without having been reported. */
bool tracee_reap_unknown(bool (*known)(pid_t tid, const void *arg), const void *arg);
/* To a tracee (a process), unless we have reaped it: until then its PID is not reused. */
void tracee_signal(pid_t pid, int signal);
/* Kills (SIGKILL) and reaps a tracee that is no thread of a live app. */
void tracee_kill(pid_t pid);
/* The same some milliseconds later, and without waiting for its end: the kernel takes some 10 ms
 * for each GB that it has mapped, and longer if it gets no CPU.  Takes `pidfd`.  Until
 * tracee_reap_ending() has killed and reaped it, tracee_is_ending().  tracee_reap_ending() returns
 * how many are left, and tracee_ending_due() when to call it again if no pidfd becomes ready:
 * CLOCK_MONOTONIC, UINT64_MAX: never. */
void tracee_end(pid_t pid, int pidfd);
uint32_t tracee_reap_ending(void);
uint64_t tracee_ending_due(void);
/* Kills them now. */
void tracee_end_now(void);
bool tracee_is_ending(pid_t pid);
/* Of the i-th of them, to be polled; -1: there are no more. */
int tracee_ending_pidfd(uint32_t i);
/* Whether a STOP_SYSCALL is at the entry of the call, not at its exit. */
bool tracee_enters_call(pid_t tid);
/* Whether it is a tracee of this thread. */
bool tracee_is_ours(pid_t tid);
/* PTRACE_SEIZE.  EAGAIN: a thread of its process executes another program, and that may take longer
 * than there is time, or wait for us. */
int tracee_seize(pid_t tid, long options) warn_unused;
/* Whether a tracee has stopped or ended, and tracee_wait() would return at once. */
bool tracee_has_stopped(pid_t tid);
/* Holders, and processes that are being created: they must not outlive us. */
#define TRACE_OPTIONS_OURS (PTRACE_O_EXITKILL | TRACE_OPTIONS_APP)
#define TRACE_OPTIONS_APP \
	(PTRACE_O_TRACEFORK | PTRACE_O_TRACECLONE | PTRACE_O_TRACEVFORK | PTRACE_O_TRACESYSGOOD)

/* ---- thread.c ------------------------------------------------------------------ */

/* Room for THREADS_MAX; false: out of memory. */
bool threads_reserve(struct process *process);
void threads_free(struct process *process);
/* The entry for a tid; NULL when there is no room. */
struct thread *thread_find(struct process *process, pid_t tid);
struct thread *thread_add(struct process *process, pid_t tid, struct avc_error *err);
void threads_forget_unseen(struct process *process);
/* Then no thread is left that could create another one. */
bool threads_all_stopped(const struct process *process);
/* Attaches and interrupts; thread_await() then waits for the stop, reads the registers and handles
 * the interrupted call (rewind_call()). */
int thread_stop(struct process *process, struct thread *thread, struct avc_error *err) warn_unused;
int thread_await(struct process *process, struct thread *thread, struct avc_error *err) warn_unused;
/* After injected code in it has failed: notes if it may still be running. */
void thread_runs_on(struct thread *thread, const struct avc_error *err);
/* Releases it without a trace.  A thread that could not be stopped stays attached: a straggler. */
void thread_release(struct process *process, struct thread *thread);
/* The same after a freeze: its duration does not count as part of a call's timeout. */
void thread_let_go(struct process *process, struct thread *thread);
/* Releases stragglers that have stopped; does not wait.  Returns how many are left. */
uint32_t threads_tend_stragglers(struct process *process);
/* Moves a thread inside a restartable sequence to its abort handler (rseq(2)). */
void thread_fix_rseq(int mem_fd, struct thread *thread);
/* Whether a stopped thread can run injected code. */
int thread_check_dispatch(pid_t tid, struct avc_error *err) warn_unused;

/* ---- cut.c ------------------------------------------------------------------------ */

/* If the call of a stopped thread has been cut short, sets the thread to go on with the rest. */
void cut_go_on(struct process *process, struct thread *thread);
/* Whether that is where, in the parasite at this address: the thread is in a call of its own. */
bool cut_contains(avc_remote parasite, avc_remote address);
/* ... in the parasite of this process, or in one that a dead guard has left. */
bool cut_is_place(const struct process *process, avc_remote address);

/* ---- rewind.c --------------------------------------------------------------------- */

/* Whether a thread is about to make this call again: released a moment ago, it has been stopped again before
 * it was back in it, and the kernel had moved it to the instruction, with the call's number for a result. */
bool rewind_is_before(const struct process *process, const struct arch_regs *regs, long nr);

/* A thread that just stopped: notes which call it is in.  If only we have interrupted that, sets
 * the thread to repeat it, or to return its timeout's result when its time is up. */
void rewind_call(struct process *process, struct thread *thread);
/* Before it is released: the same where its filter bars the call by which the kernel would continue
 * the interrupted one. */
void rewind_continued(struct process *process, struct thread *thread);
/* Just before it continues: subtracts the duration of the stop from a remaining timeout. */
void rewind_count_stop(const struct process *process, const struct thread *thread);
/* Registers as the app had them, before rewind_call() marked the call or the kernel replaced it by
 * restart_syscall(2). */
void rewind_original(const struct thread *thread, struct arch_regs *regs);
/* The registers with which it goes home by itself.  Where it could not continue its call there, but
 * would get EINTR from restart_syscall(2), the call begins again. */
void rewind_home(const struct thread *thread, struct arch_regs *home);
/* Shortly before a thread is stopped: if it may be in such a call, notes since when it sleeps. */
void rewind_prepare(struct thread *thread);
/* Once the thread runs again: finds out when its rewound call began, if that is still unknown. */
void rewind_date(struct thread *thread);

/* ---- seccomp.c -------------------------------------------------------------------- */

/* Reads a stopped thread's filters.  Fails if injected code would do harm under them that loses its
 * tracer. */
int seccomp_read(struct process *process, struct thread *thread, struct avc_error *err) warn_unused;
/* The umask, the seccomp mode and the number of filters of a stopped process; -1 with errno.  Read once
 * until they are forgotten: when it begins to be stopped, and when it runs again. */
int seccomp_counts(struct process *process, struct seccomp_counts *counts);
void seccomp_counts_forget(struct process *process);
/* What was concluded from them while other threads were still running: before it is released. */
void seccomp_own_forget(struct process *process);
/* Whether the guard may come under a filter of its own, and still protect an application that has
 * none. */
bool seccomp_can_be_confined(void);
/* Whether the container's filters refuse a userfaultfd. */
bool seccomp_refuses_watching(void);
/* ... or what it takes to find out what a socket is (INJ_CLOSE_CLAIMS). */
bool seccomp_refuses_asking(void);
/* It has come under one. */
void seccomp_confined(void);
bool seccomp_is_confined(void);
/* It has met a task whose filters would have to be suspended: another guard is needed. */
bool seccomp_must_suspend(void);
/* Whether a task has no more filters than its container. */
bool seccomp_is_containers(const struct proc_status *status, uint32_t containers);
/* Whether a filter of this (stopped) thread prevents restart_syscall(2). */
bool seccomp_bars_restart(struct process *process, pid_t tid);
/* Whether one looks at more than the number of a call that was cut short (cut.c). */
bool seccomp_bars_rest(struct process *process, pid_t tid);

/* ---- seccomp_supervise.c ---------------------------------------------------------- */

/* From now on, until seccomp_end_supervision(): `options` are its other ptrace options, `inside` is
 * the PID of its process in its own namespace, `code` and `bytes` are where injected code is. */
int seccomp_supervise(pid_t tid, pid_t inside, long options, avc_remote code,
		      size_t bytes) warn_unused;
#define SECCOMP_WATCHER (-1) /* for `inside`: the one that opens a userfaultfd       */
void seccomp_end_supervision(pid_t tid);
bool seccomp_is_supervised(pid_t tid);
/* The same for this stop alone, which is of a system call (STOP_SYSCALL), and wherever its code is:
 * for one that has none of the app's to run yet. */
void seccomp_at_call(pid_t tid, pid_t inside, long options);
/* The same for a task that has yet to get its filters, by calls from memory that the application
 * could change: it makes no other call than those of a restore. */
void seccomp_at_call_only(pid_t tid, pid_t inside, long options);
/* ptrace(PTRACE_CONT) for tasks that run injected code: from `stop`, with its signal if it is one;
 * NULL: that stop was handled before. */
long seccomp_go_on(pid_t tid, const struct stop *stop);

/* ---- parasite.c ------------------------------------------------------------------- */

/* Makes the memory for a layout, with code and control filled in; no process has mapped it yet. */
int parasite_make(struct parasite *parasite, uint64_t nonce, struct avc_error *err) warn_unused;
size_t parasite_layout(struct parasite *parasite, uint32_t slots, uint32_t threads_max);
void parasite_close(struct parasite *parasite);
struct inj_slot *parasite_slot(const struct parasite *parasite, uint32_t slot);
avc_remote parasite_remote(const struct parasite *parasite, const void *local);
/* But not where calls of the app's go on (cut.c). */
bool parasite_contains(const struct parasite *parasite, avc_remote address);
/* Block of thread `i` in a slot, its signal frame, the top of its stack. */
struct inj_thread *parasite_thread(const struct parasite *parasite, uint32_t slot, uint32_t i);
void *parasite_frame(const struct parasite *parasite, uint32_t slot, uint32_t i);
void *parasite_stack(const struct parasite *parasite, uint32_t slot, uint32_t i);

uint8_t *parasite_setup(const struct parasite *parasite, uint32_t slot); /* INJ_SETUP_BYTES */
uint8_t *parasite_files(const struct parasite *parasite, uint32_t slot); /* INJ_FILES_BYTES */

/* Of a system call; missing ones are 0. */
#define ARGUMENTS(...) ((const uint64_t[6]){ __VA_ARGS__ })
/* Prepares a list of calls; returns the next call to fill in. */
void call_begin(struct inj_call *call, enum inj_after after);
struct inj_syscall *call_append(struct inj_call *call, long nr, const uint64_t arg[6]);
#define call_add(call, nr, ...) call_append(call, nr, ARGUMENTS(__VA_ARGS__))
/* Sends a stopped task into the parasite to make the calls.  `base` is a user context
 * of the task.  For a thread of the app use thread_borrow(). */
int parasite_send(const struct parasite *parasite, pid_t tid, const struct arch_regs *base,
		  struct inj_call *call, struct avc_error *err) warn_unused;
/* Resumes it until all calls were made; it is in a plain trap stop then. */
int parasite_run(pid_t tid, struct inj_call *call, struct avc_error *err) warn_unused;
/* Resumes it until it pauses (INJ_PAUSE), and from there. */
int parasite_run_to_pause(pid_t tid, struct inj_call *call, struct avc_error *err) warn_unused;
int parasite_run_on(pid_t tid, struct inj_call *call, struct avc_error *err) warn_unused;
/* Resumes it until it has cloned; it is in the event's stop then.  If the kernel does
 * not let it, fails with AVC_LIMIT, and it is in a plain trap stop. */
int parasite_run_clone(pid_t tid, const struct inj_call *call, pid_t *child,
		       struct avc_error *err) warn_unused;
/* The same in parts, for several at a time.  parasite_halt() waits until the calls are made and
 * interrupts it; parasite_finish() also waits for its stop. */
int parasite_start(pid_t tid, struct avc_error *err) warn_unused;
int parasite_halt(pid_t tid, struct inj_call *call, struct avc_error *err) warn_unused;
int parasite_finish(pid_t tid, struct inj_call *call, struct avc_error *err) warn_unused;
int parasite_await_clone(pid_t tid, const struct inj_call *call, pid_t *child,
			 struct avc_error *err) warn_unused;
/* The same; `meanwhile` is called once while the kernel clones. */
int parasite_run_clone_while(pid_t tid, const struct inj_call *call, void (*meanwhile)(void *arg),
			     void *arg, pid_t *child, struct avc_error *err) warn_unused;
/* While the main thread is in its parasite: a call that it makes before it returns if we have died,
 * with the address of arg[3] as its fourth argument.  Undoes a change of the app's state that we
 * are about to make, and must not make if this fails.  When the last change has been undone:
 * parasite_clear_undo(). */
int parasite_set_undo(struct process *process, long nr, const uint64_t arg[6]) warn_unused;
void parasite_clear_undo(struct process *process);
/* Whether the thread that has left it by itself says that it is home. */
bool parasite_says_home(const struct parasite *parasite);
/* Whether this is in a parasite left behind by a dead guard, or in a stub that stays; not where calls of
 * the app's go on. */
bool parasite_is_old(const struct process *process, avc_remote address);
/* The same, there as well. */
bool parasite_is_needed(const struct process *process, avc_remote address);
/* Options for a stopped task of ours, which has the memory of the parasite's process. */
int parasite_own(const struct parasite *parasite, pid_t tid) warn_unused;
/* May this stopped thread be borrowed?  As far as that is to be read in its memory. */
int thread_vet(struct process *process, struct thread *thread, struct avc_error *err) warn_unused;
/* The same as parasite_run* for a stopped thread of the app, which returns by itself if we die:
 * thread_borrow, parasite_run*, thread_give_back.  thread_give_back() needs a plain trap stop. */
int thread_borrow(struct process *process, struct thread *thread,
		  struct avc_error *err) warn_unused;
/* For a thread that did not get to run in time, unless its list changes memory: it makes no more
 * calls, and goes home as soon as it runs.  Others are released before it does, and may put it under
 * a filter that kills for such calls (SECCOMP_FILTER_FLAG_TSYNC). */
void parasite_cut_short(struct inj_call *call, const struct avc_error *err);
/* The registers of a borrowed thread that goes home by itself, whatever its signal mask. */
void thread_head_home(const struct thread *thread, struct arch_regs *regs);
int thread_give_back(struct thread *thread, struct avc_error *err);

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
	struct avc_error notice; /* the first thing that cannot be restored  */
	struct inj_setup spare;  /* written to when there is no room         */
};

void setup_begin(struct setup *setup, const struct parasite *parasite, uint32_t slot);
/* One more call for a stage or (after setup_thread()) for a thread; `name` is for messages.  The
 * caller may also set call.arg[5], store, flags. */
struct inj_setup *setup_append(struct setup *setup, enum inj_stage stage, const char *name, long nr,
			       const uint64_t arg[6]);
#define setup_add(setup, stage, name, nr, ...) \
	setup_append(setup, stage, name, nr, ARGUMENTS(__VA_ARGS__))
void setup_thread(struct setup *setup, struct inj_thread *thread);
struct inj_setup *setup_append_thread(struct setup *setup, const char *name, long nr,
				      const uint64_t arg[6]);
#define setup_add_thread(setup, name, nr, ...) \
	setup_append_thread(setup, name, nr, ARGUMENTS(__VA_ARGS__))
/* A copy of `bytes` bytes where the process can read it; the process's address. */
avc_remote setup_data(struct setup *setup, const void *data, size_t bytes);
/* -1 if there was not enough room for it all. */
int setup_end(const struct setup *setup, pid_t pid, struct avc_error *err) warn_unused;
/* After a restore: the first call of the slot that was allowed to fail, and did. */
const struct inj_setup *setup_failed(const struct parasite *parasite, uint32_t slot);
/* The same for one stage; calls without a name do not count. */
const struct inj_setup *setup_failed_stage(const struct parasite *parasite, uint32_t slot,
					   enum inj_stage stage);
/* The name of a call by the process's address of it. */
const char *setup_name(const struct parasite *parasite, avc_remote address);

/* ---- fd_channel.c ------------------------------------------------------------------ */

/* In a parasite: what recvmsg(2) needs for one descriptor, `remote` there; the header is first. */
struct fd_letter {
	struct msghdr head;
	struct iovec io;
	uint8_t byte;
	uint8_t control[CMSG_SPACE(sizeof(int))] __attribute__((aligned(8)));
};
void fd_letter_write(struct fd_letter *letter, avc_remote remote);
/* The number that the descriptor in it has got; -1: none. */
int fd_letter_number(const struct fd_letter *letter);
/* One descriptor over a socket (unix(7), SCM_RIGHTS). */
int fd_send(int socket, int fd);
/* One that fd_send() has sent; -1: there was none with it, or the other end is closed. */
int fd_receive(int socket) warn_unused;
/* The descriptors that a new process is to have. */
struct fd_table {
	uint32_t count;
	struct {
		int fd, ours; /* -1: it has it from the fork                      */
		bool cloexec;
		bool changed; /* not so in the process that forks it              */
	} * entry;            /* by fd, ascending                                        */
};
void fd_table_free(struct fd_table *table);

/* ---- syscall_batch.c ----------------------------------------------------------------------- */

#define BATCH_SOFTS 64

/* A task that a restored process has forked, and that becomes a copy of a template. */
struct syscall_batch {
	pid_t pid;
	const struct parasite *parasite; /* the one it runs in                              */
	struct inj_call *call;
	struct arch_regs base;
	struct inj_syscall *list; /* in the parasite: calls not made yet                  */
	uint32_t listed, list_max;
	uint8_t *data; /* in the parasite: data that the calls point to            */
	struct soft {
		uint32_t index;
		const char *problem;
	} soft[BATCH_SOFTS]; /* of the calls, those that may fail                  */
	uint32_t softs;
	uint32_t running; /* calls of the batch that was started                   */
	pid_t inside;     /* for notes: soft failures                            */
	struct avc_error *notes;
	int socket; /* ours, through which it gets descriptors; -1     */
	int theirs; /* its end; and what number it gets each as, until that is closed     */
	int given;
};

/* From now on it runs in that parasite. */
void syscall_batch_enter(struct syscall_batch *batch, const struct parasite *parasite,
			 uint32_t slot);
/* One more call.  All of them are made by syscall_batch_flush(), which leaves the results in
 * batch->list and reports the first that failed. */
void syscall_batch_append(struct syscall_batch *batch, long nr, const uint64_t arg[6]);
#define syscall_batch_add(batch, nr, ...) syscall_batch_append(batch, nr, ARGUMENTS(__VA_ARGS__))
/* The same, for any number: those before it are made when there is no more room. */
int syscall_batch_append_any(struct syscall_batch *batch, struct avc_error *err, long nr,
			     const uint64_t arg[6]) warn_unused;
#define syscall_batch_ask(batch, err, nr, ...) \
	syscall_batch_append_any(batch, err, nr, ARGUMENTS(__VA_ARGS__))
/* The last one may fail: then `problem`, if any, is noted. */
void syscall_batch_soften(struct syscall_batch *batch, const char *problem);
int syscall_batch_flush(struct syscall_batch *batch, struct avc_error *err) warn_unused;
/* The same in parts, for several tasks at a time.  Nothing listed: there is nothing to wait for. */
int syscall_batch_start(struct syscall_batch *batch, struct avc_error *err) warn_unused;
int syscall_batch_await(struct syscall_batch *batch, struct avc_error *err) warn_unused;
/* Fresh from fork(2), in the parasite of its parent, whose batch this is a copy of: from now on it
 * has a list of its own there, as up to BATCH_BEDS siblings at a time. */
#define BATCH_BEDS 15
void syscall_batch_lie_down(struct syscall_batch *batch, uint32_t bed);
/* parasite_send(): the task makes those calls when it is resumed. */
int syscall_batch_send(const struct syscall_batch *batch, struct inj_call *call,
		       struct avc_error *err) warn_unused;
void *syscall_batch_data(const struct syscall_batch *batch, avc_remote *remote);
/* Two ends of a socket: ours, and the number of the other one there.  Both -1: there is none. */
struct fd_channel {
	int ours, theirs;
};

/* Closes inherited descriptors, except those that it keeps; from then on it can be given
 * descriptors: by an inherited channel, if any, which it takes, or its own. */
int syscall_batch_open_fd_channel(struct syscall_batch *batch, struct fd_channel *inherited,
				  const struct fd_table *table, struct avc_error *err) warn_unused;
#define FD_KEPT_MIN 2 /* 0 and 1 are for the channel                               */
/* The same in a table that it shares with its parent (CLONE_FILES), and so closes nothing of.
 * Nobody else may use that until syscall_batch_close_fd_channel(). */
int syscall_batch_make_fd_channel(struct syscall_batch *batch, struct avc_error *err) warn_unused;
void syscall_batch_close_fd_channel(struct syscall_batch *batch);
/* Of a process that forks several: it passes each of them a channel, which takes less time than
 * their making their own.  None where there is no descriptor number left for it. */
int syscall_batch_share_fd_channel(struct syscall_batch *batch, struct fd_channel *fd_channel,
				   struct avc_error *err) warn_unused;
int syscall_batch_unshare_fd_channel(struct syscall_batch *batch, struct fd_channel *fd_channel,
				     struct avc_error *err) warn_unused;
/* One of its next calls, before a fork: it receives the other end of a new channel.  When it has:
 * notes its number.  Both -1: there is none. */
void syscall_batch_pass_socket(const struct fd_channel *fd_channel, const struct parasite *parasite,
			       struct inj_call *call, struct fd_channel *passed);
void syscall_batch_note_passed(const struct inj_call *call, struct fd_channel *passed);
int syscall_batch_give(struct syscall_batch *batch, int fd, struct avc_error *err) warn_unused;
/* That of its own, beside its parent's. */
int syscall_batch_map_parasite(struct syscall_batch *batch, const struct parasite *parasite,
			       struct avc_error *err) warn_unused;
/* Its descriptors; it gets no more after that. */
int syscall_batch_put_files(struct syscall_batch *batch, const struct fd_table *table,
			    struct avc_error *err) warn_unused;

/* ---- last_pid.c ------------------------------------------------------------------- */

/* A slot whose requests the helper serves. */
struct last_pid_slot {
	const struct parasite *parasite;
	uint32_t number;
};
/* In a PID namespace with several guards, either one of them chooses PIDs, for a restore (urgent), or
 * any number of them fork: a template or spare that one makes meanwhile would take the chosen PID.
 * Members of a group fork while they wait for each other.  Any process in the namespace can take the
 * lock: false if it was not free in time.  fd < 0: not needed. */
int last_pid_lock_open(pid_t init);
bool last_pid_lock(int fd, bool urgent);
void last_pid_unlock(int fd);
/* Starts the helper of the next restore, which waits for it; best effort. */
void last_pid_prepare(int init_pidfd);
void last_pid_forget(void);
/* Has it write to ns_last_pid in init's PID namespace until last_pid_stop(): as requested by the
 * process restored in the first slot, or in that of last_pid_serve().  last_pid_set() is the
 * engine's own request. */
struct last_pid *last_pid_start(int init_pidfd, const struct last_pid_slot *slot, uint32_t count,
				struct avc_error *err);
/* It lives for a minute, and may have failed. */
bool last_pid_is_there(const struct last_pid *helper);
int last_pid_set(struct last_pid *helper, pid_t value, struct avc_error *err) warn_unused;
/* Adds the request to a task's calls, before the clone(2) that is to have the next number: others that
 * fork have less time to take it.  The task's parasite has the slot that is served.  When the calls were
 * made, last_pid_answered() tells of the answer. */
const struct inj_syscall *last_pid_ask(const struct last_pid *helper,
				       const struct parasite *parasite, struct inj_call *call,
				       pid_t value);
int last_pid_answered(const struct last_pid *helper, const struct inj_syscall *asked,
		      struct avc_error *err) warn_unused;
/* No number is needed until the next request: who forks until then takes none near it.  Does not
 * wait. */
void last_pid_free(struct last_pid *helper);
/* From now on serves requests of another slot. */
void last_pid_serve(struct last_pid *helper, struct inj_slot *slot);
/* Nothing is to be written any more: the namespace's PIDs continue from where they were.  That has come
 * true after last_pid_await_stop(), while its processes stay. */
void last_pid_stop(struct last_pid *helper);
void last_pid_await_stop(struct last_pid *helper);
/* Stops it, and waits until its processes are gone; NULL: nothing to do. */
void last_pid_end(struct last_pid *helper);

/* ---- boost.c ---------------------------------------------------------------------- */

/* Until boost_end(), or the next one, the task has the guard's priority, if that is real-time. */
void boost_begin(pid_t tid);
void boost_end(void);

/* ---- init_channel.c -------------------------------------------------------------- */

struct init_channel {
	int init_pidfd, ctl_fd, report_fd, verdict_fd;
	int numbers_fd; /* last_pid_lock(), where others restore in its PID namespace, too */
	pid_t init, init_inside;
	struct avc_ctl *ctl;
	uint32_t death;      /* about which init awaits a verdict: struct avc_report, seq */
	uint64_t working_ns; /* when that was, or init was last told that it takes longer */
};

void init_channel_init(struct init_channel *channel);
/* True once the app's main process runs a program of its own. */
bool init_channel_app_started(const struct init_channel *channel, pid_t app);
/* 1: connected, 0: init is not ready yet, -1: error. */
int init_channel_open(struct init_channel *channel, struct avc_error *err) warn_unused;
void init_channel_close(struct init_channel *channel);
/* The app's main process in our namespace, 0 if it is not there (yet). */
pid_t init_channel_app(const struct init_channel *channel);
void init_channel_arm(struct init_channel *channel, bool armed);
/* Whether a child of init is the one that reads the keys of a terminal. */
bool init_channel_listens(const struct init_channel *channel, pid_t pid);
bool init_channel_stop_asked(const struct init_channel *channel);
int init_channel_report(struct init_channel *channel, struct avc_report *report);
/* For the last death.  init waits for a limited time, which starts anew with each
 * init_channel_working(); that may be called whenever there is progress. */
int init_channel_verdict(const struct init_channel *channel, enum avc_verdict_kind kind,
			 struct avc_error *err);
void init_channel_working(struct init_channel *channel);
/* Whether a child of init has ended that init has not reaped yet. */
bool init_channel_has_zombies(const struct init_channel *channel);
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

#endif
