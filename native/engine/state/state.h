/* SPDX-License-Identifier: Apache-2.0
 *
 * What a process has, but for what it has open: asked while it is stopped, kept in an image, put
 * back.
 *
 *   image.c         which image is whose
 *   attributes.c    scheduling, credentials, prctl settings
 *   process_attrs.c what only a template can tell: signal handlers, limits, directories
 *   inherited.c     what a fork has of all that by itself
 *   pending.c       signals that have not been delivered
 *   timers.c        interval timers, POSIX timers
 *   memory*.c       memory that a clone does not carry as it is
 *   sandbox.c       restoring an app that has a seccomp filter of its own
 */
#ifndef AVCKPT_STATE_H
#define AVCKPT_STATE_H

#include "trace.h"

#define FILES_NAME 81 /* of a file, for people                                  */

/* What is saved of one process. */
struct image {
	struct process *process; /* NULL: it had ended, and nobody had waited for it */
	int parent;              /* the place of its parent's image, or ...         */
	uint32_t host;           /* the same of the one that forks it in a restore  */
	pid_t inside;
	/* Of its session and group, and of the group in the foreground of its terminal; inside, 0:
	 * outside of the app, or none that could be seen. */
	pid_t session, group, tty_group;
	pid_t pid;             /* as of the freeze; then as restored last          */
	int exit_signal;       /* struct proc_stat                                */
	int status;            /* of one that had ended, as from wait(2)           */
	char name[16];         /* the same                                        */
	struct proc_stat stat; /* as of the freeze                                */
	pid_t template;
	int pidfd;
	uint32_t slot;
	uint32_t threads;
	uint64_t taken_ns;
	struct arch_regs base; /* a user context of the template                */
	long vm_pages;         /* of the process when it was taken                */
	long anon_pages;       /* resident ones that are of no file                */
	/* The OOM killer's: the app's own, and what it was told of the template (guard_memory.c) */
	int oom_own, oom_told;
	bool oom_known;
	bool sandboxed;   /* has seccomp filters of its own                   */
	bool headless;    /* its main thread had ended                       */
	int stop_signal;  /* stopped by that (job control), 0: it was not     */
	int64_t dumpable; /* prctl(2), PR_GET_DUMPABLE                        */
	struct attributes *attributes;
	struct process_attrs *attrs;  /* of one that its parent is to fork               */
	struct mem_image *memory;     /* that is not in the template                     */
	struct files *files;          /* descriptors                                     */
	struct avc_error files_error; /* why they could not be read             */
	struct files_mapped *mapped;  /* avckpt.files=strict; NULL: it was not             */
	struct fd_table table;        /* at a restore: what it is to have open           */
	struct avc_error notice;      /* what of it cannot be put back              */
	struct inherited *inherited;  /* dirty.c: what its template was forked with; or NULL */
	struct pageset *stale;        /* ... and where its memory is not the process's       */
	uint64_t tracker;             /* ... as this one has noted it (struct tracker)        */
	uint64_t forked_ns, copied;   /* when the template was; pages written to it since     */
	uint64_t kinds;               /* mem_image_kinds(), then                              */
	bool recycled;                /* it is an older one that was brought up to date       */
};
#define PARENT_INIT (-1)

/* ---- image.c ---------------------------------------------------------------------- */

/* Among all images of a checkpoint; NULL: it has none. */
struct image *image_find(struct image *image, uint32_t images, const struct process *process);

/* What a crash is known by. */
#define SIGNAL_BIT(signal) (UINT64_C(1) << ((signal)-1))
#define FATAL_SIGNALS                                                                         \
	(SIGNAL_BIT(SIGSEGV) | SIGNAL_BIT(SIGBUS) | SIGNAL_BIT(SIGFPE) | SIGNAL_BIT(SIGILL) | \
	 SIGNAL_BIT(SIGABRT) | SIGNAL_BIT(SIGTRAP) | SIGNAL_BIT(SIGSYS))

/* ---- pending.c ------------------------------------------------------------------ */

struct pending *pending_new(void);
/* While everything is stopped: those of all threads that are in the image.  Sets
 * thread.signalled.  AVC_GONE: who was killed meanwhile has none any more. */
int pending_read(struct process *process, struct avc_error *err) warn_unused;
/* -1 if there is one that the process dies of as soon as it runs again, or reports its own
 * crash. */
int pending_check(const struct process *process, struct avc_error *err) warn_unused;
/* Is there such a signal; of a POSIX timer, if timer >= 0? */
bool pending_contains(const struct pending *pending, int signal, int timer);
/* When the app runs again: one thread's, after setup_thread(); the process's. */
void pending_setup_thread(const struct process *process, const struct thread *thread,
			  struct setup *setup);
void pending_setup(const struct process *process, struct setup *setup);

/* ---- timers.c -------------------------------------------------------------------- */

struct timers *timers_new(void);
/* What /proc/PID/timers says, which it changes. */
void timers_parse(struct timers *timers, char *text);
/* While everything is stopped: what to call first in the list; when that was done. */
void timers_ask(struct process *process, struct inj_call *call);
void timers_answer(struct process *process, const struct inj_call *call, uint64_t took_ns);
/* When the app runs again. */
void timers_setup(struct process *process, struct setup *setup);

/* ---- attributes.c ----------------------------------------------------------------- */

#define ATTRIBUTES_ASK_BYTES 376
/* While it is stopped, from outside. */
void attributes_read_scheduling(pid_t tid, struct scheduling *scheduling);
/* Calls that ask a thread, and its answers; `out` (for it: `remote`) is where it is to
 * leave them.  Returns the first of the calls. */
const struct inj_syscall *attributes_ask(struct inj_call *call, void *out, avc_remote remote);
void attributes_answer(const struct inj_syscall *first, const void *out, struct creds *creds);
/* When the app runs again: each thread, after setup_thread(); the process. */
int attributes_setup_thread(const struct process *process, const struct thread *main_thread,
			    const struct thread *thread, struct setup *setup,
			    struct avc_error *err) warn_unused;
/* Of a stopped thread: its seccomp filters, whatever they say. */
uint64_t attributes_read_filters(pid_t tid);
int attributes_keep(struct image *image, struct avc_error *err) warn_unused;
/* Before the restored threads go: what can be done from outside only. */
void attributes_put_back(const struct attributes *attributes, pid_t pid, struct avc_error *notice);

/* ---- process_attrs.c ------------------------------------------------------------------------ */

/* After the app runs again: what only the template can tell. */
int process_attrs_learn(struct image *image, struct avc_error *err) warn_unused;
void process_attrs_forget(struct image *image);
/* All protection keys, before its memory refers to some and while the kernel must not choose one
 * (pkeys(7), of what can only be executed).  process_attrs_put() frees those that it did not have. */
int process_attrs_take_keys(struct syscall_batch *batch, struct avc_error *err) warn_unused;
/* A restored process gets it, with the batch's next flush. */
int process_attrs_put(struct syscall_batch *batch, const struct image *image,
		      struct avc_error *err) warn_unused;
/* Until then nothing is limited: it may have more than it may have now, and its parent may have
 * lowered its own limits since.  Its descriptors are below `files`. */
void process_attrs_lift_limits(pid_t pid, const struct image *image, uint32_t files);
/* One limit, to as much as there is, and to `least` at least; beyond the hard one that takes
 * CAP_SYS_RESOURCE (setrlimit(2)), without which it is lifted up to there. */
void process_attrs_lift_limit(pid_t pid, int which, uint64_t least);
/* By the process itself, as the last: to set another user's takes CAP_SYS_RESOURCE (prlimit(2)). */
void process_attrs_setup_limits(const struct image *image, struct setup *setup);

/* ---- inherited.c ------------------------------------------------------------------ */

#define INHERITED_SIGNALS 64
#define INHERITED_VALUES 10
#define INHERITED_BREAK 0

/* What a process has from the one that forked it, besides memory and descriptors: as it was then, or
 * as the other has it now.  Compared with memcmp(). */
struct inherited {
	uint64_t action[INHERITED_SIGNALS][4]; /* rt_sigaction(2)                    */
	int64_t value[INHERITED_VALUES];       /* prctl(2), membarrier(2), brk(2)    */
	struct creds creds;
	uint64_t limit[LIMITS][2];
	uint64_t stat;   /* a hash of what /proc/PID/stat tells of its layout    */
	uint64_t places; /* ... of its directories, namespaces and program       */
	uint32_t umask;
	uint32_t dumped; /* core(5), coredump_filter                            */
};

/* One more call for a list (INJ_LIST), which leaves its answers in that slot; these, once made;
 * what /proc says; and the thread's own attributes, as asked for with the rest. */
void inherited_ask(const struct parasite *parasite, uint32_t slot, struct inj_call *call);
void inherited_answer(const struct parasite *parasite, uint32_t slot, struct inherited *inherited,
		      int64_t *dumpable);
int inherited_read(struct inherited *inherited, pid_t pid, struct avc_error *err) warn_unused;
void inherited_creds(struct inherited *inherited, const struct thread *thread);
bool inherited_equal(const struct inherited *a, const struct inherited *b);

/* ---- sandbox.c --------------------------------------------------------------------- */

/* Keeps a new process, which is stopped, as a tracee, and lets it go on. */
struct sandbox *sandbox_begin(pid_t child, pid_t inside, struct avc_error *err);
/* Waits while *state is INJ_IDLE; false when it ended or was too late. */
bool sandbox_wait(struct sandbox *sandbox, const uint32_t *state, uint64_t end);
/* The end of it: killed, or let go to where the threads of the slot were; stop_signal: where
 * they stop (job control), 0: go on. */
void sandbox_end(struct sandbox *sandbox);
void sandbox_go(struct sandbox *sandbox, const struct parasite *parasite, uint32_t slot,
		int stop_signal);

/* ---- memory.c ------------------------------------------------------------------ */

/* Shared memory that an image of the same checkpoint has: one is enough; and what all of them have
 * taken of what they may. */
#define WIPED_MAX (16u << 20)     /* bytes of MADV_WIPEONFORK memory                 */
#define WIPED_RUNS_MAX (1u << 14) /* stretches of it, and guard pages within          */
struct mem_key {
	uint64_t device, inode, offset, bytes;
};
struct mem_seen {
	uint32_t count, room;
	struct mem_key *key;
	uint64_t shared_bytes, wiped_bytes;
	uint32_t runs;
};
void mem_seen_free(struct mem_seen *seen);

/* memory_others.c: who else has shared memory of the application's; one for all its processes. */
struct mem_others *mem_others_new(void);
void mem_others_free(struct mem_others *others);

struct memory *memory_new(void);
void memory_forget(struct memory *memory); /* it is another program         */
void memory_free(struct memory *memory);
/* Room for what is to be copied in the freeze. */
int memory_prepare(const struct process *process, struct mem_image **image, struct mem_seen *seen,
		   struct avc_error *err) warn_unused;
void mem_image_free(struct mem_image *image);
/* What only "smaps" tells of a mapping and a restore has to know, as of the checkpoint: enum
 * mapping_flag.  And whether it is so of any. */
uint32_t mem_image_marks(const struct mem_image *image, avc_remote address);
bool mem_image_has(const struct mem_image *image, enum mapping_flag flag);
/* Whether it has a vDSO. */
bool mem_image_is_special(const struct mem_image *image);
/* What its mappings are that /proc/PID/maps does not tell of; a number. */
uint64_t mem_image_kinds(const struct mem_image *image);
/* While everything is stopped: copies, what is its own when it stands still, what is shared
 * when everybody does. */
void memory_copy_own(const struct process *process, struct mem_image *image);
void memory_copy_shared(const struct process *process, struct mem_image *image);
/* When it stands still: looks what a clone would not inherit (MADV_DONTFORK); whether there is any;
 * and what its main thread has to call right before the clone (MADV_DOFORK), and right after it
 * (MADV_DONTFORK).  Both before it begins. */
int memory_look(struct process *process, struct avc_error *err) warn_unused;
bool memory_is_unforked(const struct memory *memory);
void memory_advise(const struct process *process, uint32_t slot, int advice, struct inj_call *call);
/* The template is smaller than the app: always fails, with AVC_RETRY if the next
 * attempt will be better. */
int memory_learn(struct process *process, long missing_pages, struct avc_error *err);
/* When the app runs again.  Fails with AVC_RETRY if what had to be copied was not. */
/* Why a process that has private mappings of hugetlbfs is not cloned: the pool of huge
 * pages is small, and whoever writes to a shared one when it is empty is killed. */
extern const char memory_private_huge_pages[];
int memory_finish(struct image *image, int64_t locked_kb, struct setup *setup,
		  struct avc_error *err) warn_unused;
/* Whether only a fork carries what it has: advice, protection keys. */
bool memory_needs_fork(const struct process *process);
/* When all of them are there: -1 if several processes have shared memory that is not rolled back
 * with them.  One that went back would wait for what another one had done. */
int memory_check_unkept(const struct image *image, uint32_t images,
			struct avc_error *err) warn_unused;
/* When all of a checkpoint are finished: what is more than may be kept. */
void memory_note_left(const struct image *image, uint32_t images, struct avc_error *notice);
/* At a restore, before anything runs; *notes: what cannot be written. */
int memory_put_back(const struct image *image, pid_t pid, struct avc_error *notes,
		    struct avc_error *err) warn_unused;

#endif
