/* SPDX-License-Identifier: Apache-2.0
 *
 * The state of a process except descriptors: read while it is stopped, kept in an image, restored.
 *
 *   image.c         finds the image of a process
 *   attributes.c    scheduling, credentials, prctl settings
 *   process_attrs.c what only a template can tell: signal handlers, limits, directories
 *   inherited.c     what of it a fork inherits
 *   pending.c       signals that have not been delivered
 *   timers.c        interval timers, POSIX timers
 *   memory*.c       memory that a clone does not carry as it is
 *   filters.c       seccomp filters that a fork of the main process has not
 *   sandbox.c       restoring an app that has a seccomp filter of its own
 */
#ifndef AVCKPT_STATE_H
#define AVCKPT_STATE_H

#include "trace.h"

#define FILES_NAME 81 /* of a file, for messages */

/* What is saved of one process. */
struct image {
	struct process *process; /* NULL: it was a zombie */
	int parent;              /* the place of its parent's image, or ...         */
	uint32_t host;           /* the same for the one that forks it in a restore */
	uint64_t shared;         /* struct process; with that one                   */
	pid_t inside;
	/* Its session and group, and the foreground group of its terminal; inside, 0: outside of
	 * the app, or not visible. */
	pid_t session, group, tty_group;
	pid_t pid;             /* as of the freeze; then as restored last          */
	int exit_signal;       /* struct proc_stat                                */
	int status;            /* of a zombie, as from wait(2) */
	char name[16];         /* the same                                        */
	struct proc_stat stat; /* as of the freeze                                */
	pid_t template;
	int pidfd;
	uint32_t slot;
	uint32_t threads;
	uint64_t taken_ns;
	struct arch_regs base; /* a user context of the template                */
	long vm_pages;         /* of the process when it was taken                */
	long anon_pages;       /* resident anonymous ones */
	/* oom_score_adj: the app's own, and that of the template (guard_memory.c) */
	int oom_own, oom_told;
	bool oom_known;
	bool sandboxed;    /* has seccomp filters of its own                   */
	bool installs;     /* ... some of them while it is restored: filters.c                */
	struct seal *seal; /* of each of its threads                          */
	uint32_t seals;
	uint64_t shared_filters; /* a hash of those that all of its threads have          */
	bool adopts;             /* struct process; then                              */
	bool headless;           /* its main thread had ended                       */
	int stop_signal;         /* stopped by that (job control), 0: it was not     */
	bool stop_heard;         /* struct process                                   */
	int64_t dumpable;        /* prctl(2), PR_GET_DUMPABLE                        */
	struct attributes *attributes;
	struct process_attrs *attrs;  /* of one to be forked by its parent */
	struct mem_image *memory;     /* that is not in the template                     */
	struct files *files;          /* descriptors                                     */
	struct avc_error files_error; /* why they could not be read             */
	struct files_mapped *mapped;  /* avckpt.files=strict; NULL: it was not set */
	struct fd_table table;        /* at a restore: what it must have open */
	struct avc_error notice;      /* what of it cannot be restored */
	struct inherited *inherited;  /* dirty.c: what its template inherited; or NULL */
	struct pageset *stale;        /* ... and where its memory differs from the process's */
	uint64_t tracker;             /* ... as recorded by this one (struct tracker) */
	uint64_t forked_ns, copied;   /* as in struct idle_template                          */
	uint64_t kinds;               /* mem_image_kinds(), then                              */
	bool recycled;                /* an older one was updated for it */
};
#define PARENT_INIT (-1)

/* ---- image.c ---------------------------------------------------------------------- */

/* The place of the one whose descriptor table this has: its own, unless it shares that. */
uint32_t image_table_owner(const struct image *image, uint32_t index);
/* Among all images of a checkpoint; NULL: none. */
struct image *image_find(struct image *image, uint32_t images, const struct process *process);

/* Signals typical of crashes. */
#define FATAL_SIGNALS                                                                         \
	(SIGNAL_BIT(SIGSEGV) | SIGNAL_BIT(SIGBUS) | SIGNAL_BIT(SIGFPE) | SIGNAL_BIT(SIGILL) | \
	 SIGNAL_BIT(SIGABRT) | SIGNAL_BIT(SIGTRAP) | SIGNAL_BIT(SIGSYS))

/* ---- pending.c ------------------------------------------------------------------ */

struct pending *pending_new(void);
/* While everything is stopped: those of all threads that are in the image.  Sets thread.signalled.
 * AVC_GONE: it was killed meanwhile. */
int pending_read(struct process *process, struct avc_error *err) warn_unused;
/* -1 if there is one of which the process will die as soon as it runs again, or will report its own
 * crash. */
int pending_check(const struct process *process, struct avc_error *err) warn_unused;
/* Whether there is such a signal; of a POSIX timer, if timer >= 0. */
bool pending_contains(const struct pending *pending, int signal, int timer);
/* Whether a process without a handler dies of it (signal(7)). */
bool signal_ends_by_default(int signal);
/* When the app runs again: one thread's, after setup_thread(); the process's. */
void pending_setup_thread(const struct process *process, const struct thread *thread,
			  struct setup *setup);
void pending_setup(const struct process *process, struct setup *setup);

/* ---- timers.c -------------------------------------------------------------------- */

struct timers *timers_new(void);
/* Parses /proc/PID/timers, and modifies the text. */
void timers_parse(struct timers *timers, char *text);
/* While everything is stopped: adds the first calls to the list; takes their results. */
void timers_ask(struct process *process, struct inj_call *call);
void timers_answer(struct process *process, const struct inj_call *call, uint64_t took_ns);
/* When the app runs again; `status` is its own. */
void timers_setup(struct process *process, const struct proc_status *status, struct setup *setup);

/* ---- attributes.c ----------------------------------------------------------------- */

#define ATTRIBUTES_ASK_BYTES 376
/* While it is stopped, from outside. */
void attributes_read_scheduling(pid_t tid, struct scheduling *scheduling);
/* Calls that query a thread; it stores what they answer at `out`, ATTRIBUTES_ASK_BYTES in its
 * parasite.  Returns the first of the calls. */
const struct inj_syscall *attributes_ask(const struct parasite *parasite, struct inj_call *call,
					 void *out);
/* While it is still stopped. */
int attributes_answer(pid_t tid, const struct inj_syscall *first, const void *out,
		      struct creds *creds, struct avc_error *err) warn_unused;
/* When the app runs again: each thread, after setup_thread(); the process. */
int attributes_setup_thread(const struct process *process, const struct thread *main_thread,
			    const struct thread *thread, struct setup *setup,
			    struct avc_error *err) warn_unused;
int attributes_keep(struct image *image, struct avc_error *err) warn_unused;
/* Before the restored threads run: what can only be done from outside.  The first at any time before. */
void attributes_put_back_oom(const struct attributes *attributes, pid_t pid);
void attributes_put_back(const struct attributes *attributes, pid_t pid, struct avc_error *notice);

/* ---- process_attrs.c ------------------------------------------------------------------------ */

/* After the app runs again: what only the template can report. */
int process_attrs_learn(struct image *image, struct avc_error *err) warn_unused;
void process_attrs_forget(struct image *image);
/* Allocates all protection keys, before its memory uses some and so that the kernel does not choose
 * one (pkeys(7), for execute-only memory). process_attrs_put() frees those that it did not have. */
int process_attrs_take_keys(struct syscall_batch *batch, struct avc_error *err) warn_unused;
/* A restored process gets it, with the batch's next flush. */
int process_attrs_put(struct syscall_batch *batch, const struct image *image,
		      struct avc_error *err) warn_unused;
/* Lifts all limits until then: it may have more than its limits allow, and its parent may have
 * lowered its own since.  Its descriptors are below `files`. */
void process_attrs_lift_limits(pid_t pid, const struct image *image, uint32_t files);
/* Lifts one limit to its maximum, at least `least`; beyond the hard limit that takes
 * CAP_SYS_RESOURCE (setrlimit(2)), without which it is lifted up to that. */
void process_attrs_lift_limit(pid_t pid, int which, uint64_t least);
/* By the process itself, as the last: to set another user's takes CAP_SYS_RESOURCE (prlimit(2)). */
void process_attrs_setup_limits(const struct image *image, struct setup *setup);

/* ---- inherited.c ------------------------------------------------------------------ */

#define INHERITED_SIGNALS 64
#define INHERITED_VALUES 11
#define INHERITED_BREAK 0

/* What a process inherits by fork, besides memory and descriptors: as of the fork, or as its parent
 * has it now.  Compared by memcmp(). */
struct inherited {
	uint64_t action[INHERITED_SIGNALS][4]; /* rt_sigaction(2)                    */
	int64_t value[INHERITED_VALUES];       /* prctl(2), membarrier(2), brk(2), ... */
	struct creds creds;
	uint64_t limit[LIMITS][2];
	uint64_t stat;   /* a hash of the layout in /proc/PID/stat */
	uint64_t places; /* ... of its directories, namespaces and program       */
	uint32_t umask;
	uint32_t dumped; /* core(5), coredump_filter                            */
};

/* Adds a call to a list (INJ_LIST), which leaves its answers in that slot; takes these, once made;
 * reads /proc; and takes the thread's own attributes, queried with the rest.  `template`: the one to
 * compare with, as seen by the process; 0: it is the template. */
void inherited_ask(const struct parasite *parasite, uint32_t slot, pid_t template,
		   struct inj_call *call);
void inherited_answer(const struct parasite *parasite, uint32_t slot, struct inherited *inherited,
		      int64_t *dumpable);
int inherited_read(struct inherited *inherited, pid_t pid, struct avc_error *err) warn_unused;
void inherited_creds(struct inherited *inherited, const struct thread *thread);
bool inherited_equal(const struct inherited *a, const struct inherited *b);

/* ---- filters.c --------------------------------------------------------------------- */

/* What a thread must be under before it runs. */
struct seal {
	pid_t inside;
	uint64_t filters; /* a hash                                            */
};

/* A stopped thread's: sets creds.filters, and keeps what a restore has to install. */
void filters_read(struct process *process, struct thread *thread);
/* Whether it has installed one since then. */
bool filters_are_more(const struct thread *thread);
void filters_forget(struct process *process);
/* When the app runs again: seals, and what all threads install together; then what each does by
 * itself, after everything else. */
int filters_setup(struct image *image, const struct thread *main_thread, struct setup *setup,
		  struct avc_error *err) warn_unused;
void filters_setup_thread(const struct image *image, const struct thread *thread,
			  struct setup *setup);
/* Of a restored thread that is stopped; NULL: there was none with its number.  Whether it is under
 * what it was under. */
const struct seal *filters_seal_of(const struct image *image, pid_t tid);
int filters_check(const struct seal *seal, pid_t tid, struct avc_error *err) warn_unused;

/* ---- sandbox.c --------------------------------------------------------------------- */

/* Keeps a new process, which is stopped, as a tracee, and resumes it. */
struct sandbox *sandbox_begin(const struct image *image, pid_t child, struct avc_error *err);
/* Waits while *state is INJ_IDLE; false when it exited or was too late. */
bool sandbox_wait(struct sandbox *sandbox, const uint32_t *state, uint64_t end);
/* Ends it: kills it. */
void sandbox_end(struct sandbox *sandbox);
/* When it is ready: stops its threads, and checks that they are under their filters. */
int sandbox_halt(struct sandbox *sandbox, struct avc_error *err) warn_unused;
/* And releases them to where they were; those of a process that is stopped by job control stop
 * there.  Ends it, too. */
void sandbox_go(struct sandbox *sandbox);

/* ---- memory.c ------------------------------------------------------------------ */

/* Shared memory that an image of the same checkpoint has, because one copy is enough; and the part
 * of the limit that all have used. */
#define WIPED_MAX (16u << 20)     /* bytes of MADV_WIPEONFORK memory                 */
#define WIPED_RUNS_MAX (1u << 14) /* ranges of it, and guard pages within */
struct mem_key {
	uint64_t device, inode, offset, bytes;
};
struct mem_seen {
	uint32_t count, room;
	struct mem_key *key;
	struct leases leases;
	uint64_t shared_bytes, wiped_bytes;
	uint32_t runs;
};
void mem_seen_free(struct mem_seen *seen);

/* memory_others.c: other processes that have the application's shared memory; one for all its
 * processes. */
struct mem_others *mem_others_new(void);
void mem_others_free(struct mem_others *others);

struct memory *memory_new(void);
void memory_forget(struct memory *memory); /* it executes another program */
void memory_free(struct memory *memory);
/* A process that has just been forked has the shared memory of its parent: which to copy in its first
 * freeze.  That takes a second freeze for a process of which this is not known. */
void memory_expect(struct process *process, const struct process *parent);
/* Which of its shared memory may not be opened in the freeze.  What is leased between this and the
 * freeze is opened. */
void memory_note_leases(const struct process *process, struct mem_seen *seen);
/* Allocates memory for what is copied in the freeze. */
int memory_prepare(const struct process *process, struct mem_image **image, struct mem_seen *seen,
		   struct avc_error *err) warn_unused;
void mem_image_free(struct mem_image *image);
/* Flags of a mapping (enum mapping_flag) that only smaps shows and a restore needs, as of the
 * checkpoint.  And whether any mapping has it. */
uint32_t mem_image_marks(const struct mem_image *image, avc_remote address);
bool mem_image_has(const struct mem_image *image, enum mapping_flag flag);
/* Whether it has a vDSO. */
bool mem_image_is_special(const struct mem_image *image);
/* A hash of the properties of its mappings that /proc/PID/maps does not show. */
uint64_t mem_image_kinds(const struct mem_image *image);
/* While everything is stopped: copies; private memory when the process is stopped, shared memory
 * when all are. */
void memory_copy_own(const struct process *process, struct mem_image *image);
void memory_copy_shared(const struct process *process, struct mem_image *image);
/* While it is stopped: finds what a clone would not inherit (MADV_DONTFORK); whether there is any;
 * and the calls of its main thread right before the clone (MADV_DOFORK), and right after it
 * (MADV_DONTFORK). Both before it begins. */
int memory_find_unforked(struct process *process, struct avc_error *err) warn_unused;
bool memory_is_unforked(const struct memory *memory);
void memory_advise(const struct process *process, uint32_t slot, int advice, struct inj_call *call);
/* The template is smaller than the app: always fails, with AVC_RETRY if the next attempt can
 * succeed. */
int memory_learn(struct process *process, long missing_pages, struct avc_error *err);
/* Why a process that has this mapping cannot be protected; NULL: it can. */
const char *memory_refuses(const struct mapping *m);
/* When the app runs again.  Fails with AVC_RETRY if what had to be copied was not. */
int memory_finish(struct image *image, int64_t locked_kb, struct setup *setup,
		  struct avc_error *err) warn_unused;
/* Whether only a fork preserves its properties: advice, protection keys, growth. */
bool memory_needs_fork(const struct process *process);
/* When all exist: -1 if there is shared memory that is not rolled back although several processes
 * have it, of which one that goes back would wait for what another one has done already; or although
 * only one has it, whose own state it is. */
int memory_check_unkept(const struct image *image, uint32_t images,
			struct avc_error *err) warn_unused;
/* When all of a checkpoint are finished: fails if that is more than may be kept. */
void memory_note_left(const struct image *image, uint32_t images, struct avc_error *notice);
/* Before a restore: fails if memory that only the application has, such as that of sem_open(3), has
 * lost its name since.  A process that went back would look for it by that name, and wait for what
 * will never come.  `files`: the label's value that asks for this. */
int memory_check_names(const struct image *image, const char *files,
		       struct avc_error *err) warn_unused;
/* At a restore, before anything runs; *notes: what could not be written. */
int memory_put_back(const struct image *image, pid_t pid, struct avc_error *notes,
		    struct avc_error *err) warn_unused;

#endif
