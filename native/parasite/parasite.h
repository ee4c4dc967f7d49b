/* SPDX-License-Identifier: Apache-2.0
 *
 * The *parasite*: a small shared mapping in the app's address space that holds the
 * injected code and everything it works with.  The engine maps the same pages,
 * so arguments and results are plain memory on both sides.  Being MAP_SHARED
 * the parasite is the same memory in the app, in every template cloned from it and
 * in every process restored from those.
 *
 *   0                   code      (read, execute)
 *   INJ_CODE_BYTES      struct inj_control
 *   INJ_SLOTS_OFFSET    one slot per generation: struct inj_slot, then
 *                       INJ_SETUP_BYTES of calls to be made at a restore and
 *                       their arguments, then one block per thread (struct
 *                       inj_thread, its stack, and the signal frame it is
 *                       restored from)
 *
 * Addresses in here are the target's.
 */
#ifndef AVCKPT_PARASITE_H
#define AVCKPT_PARASITE_H

#include <stdint.h>

#include "home.h"

#define INJ_MAGIC UINT64_C(0x3130444150545043) /* "CPTPAD01" in memory */
#define INJ_CODE_BYTES 8192
#define INJ_SLOTS_OFFSET (INJ_CODE_BYTES + 40960)
#define INJ_TIMERS_MAX 64
#define INJ_CPU_WORDS 16 /* 1024 CPUs */
#define INJ_CALLS_MAX 96
#define INJ_WILLS_MAX 4
#define INJ_STACK_BYTES 4096
#define INJ_SETUP_BYTES (512 * 1024)
/* The same for INJ_DESCRIPTORS and INJ_OWNERS, and as much again for lists of calls that a template
 * makes (INJ_LIST). */
#define INJ_FILES_BYTES (2 * INJ_SETUP_BYTES)

/* Default time for which code without a tracer waits for one before it returns by itself. */
#define INJ_PARK_MS 100
/* Longer than a restore with all its attempts (restore_patience()). */
#define INJ_GO_S 60

struct inj_syscall {
	int64_t nr;
	uint64_t arg[6];
	int64_t result;
};

/* As the kernel has it, struct itimerspec or itimerval: seconds, then nano- or microseconds. */
struct inj_timer {
	int64_t interval[2], left[2];
};

/* Instead of a number of a system call: arg[1] calls, struct inj_syscall at arg[0]. */
#define INJ_LIST (-1)
/* wait4(2) for the task that the previous call has created. */
#define INJ_WAIT (-3)
/* Waits for the tracer (inj_call.pause), park_ms at most. */
#define INJ_PAUSE (-4)
/* Likewise; the result is mlockall(2)'s setting for future memory. */
#define INJ_FUTURE_LOCK (-2)
/* The result is a set of capabilities: the bounding set (arg[0] PR_CAPBSET_READ) or the ambient one
 * (PR_CAP_AMBIENT; arg[1]: where capget(2) has stored the others). */
#define INJ_CAPS (-5)
/* Closes what is open from number arg[0] to arg[1], except what claims nothing that others could miss
 * at once: connections and sockets without a name, and pipes. */
#define INJ_CLOSE_CLAIMS (-6)
/* Asks the engine's helper for the next PID, arg[1] + 1, through the slot arg[0]: right before the clone
 * that is to have it, because any fork in the namespace can take it. */
#define INJ_LAST_PID (-7)

enum inj_after {
	INJ_AFTER_HOME = 0, /* go back to the interrupted context (struct inj_home) */
	INJ_AFTER_PARK = 1  /* wait forever: templates and holders */
};

enum inj_pause { INJ_PAUSE_NONE = 0, INJ_PAUSED = 1, INJ_PAUSE_OVER = 2 };

/* A list of system calls for one task, and the stack to make them on. */
struct inj_call {
	uint32_t done;  /* futex: 1 when all calls were made                    */
	uint32_t pause; /* futex: enum inj_pause                                */
	uint32_t count;
	uint32_t after;   /* enum inj_after                                      */
	uint32_t park_ms; /* INJ_AFTER_HOME: how long it waits for the tracer    */
	struct inj_syscall call[INJ_CALLS_MAX];
	/* INJ_AFTER_HOME: calls of a thread without a tracer before it returns, to undo the
	 * tracer's changes to the app. */
	uint32_t wills;
	struct inj_syscall will[INJ_WILLS_MAX];
	uint64_t will_data[INJ_WILLS_MAX];
	uint8_t out[512]; /* where calls may leave results                      */
	uint8_t stack[INJ_STACK_BYTES] __attribute__((aligned(64)));
};

/* Right after the code, so that the code reaches `home` without a register. */
struct inj_control {
	struct inj_home home; /* first: home.h and the linker script rely on it */
	uint64_t magic;       /* INJ_MAGIC once the parasite is complete             */
	uint64_t nonce;       /* of the guard that made it                      */
	uint32_t arrived;     /* 1: who goes home by itself needs `home` no more        */
	/* Where calls that were cut short return to, from the same place in the code; once set, it
	 * stays.  0: not used yet. */
	uint64_t cut[INJ_CUT_PLACES];
	struct inj_call runner __attribute__((aligned(64))); /* a live thread of the app */
	struct inj_call holder __attribute__((aligned(64)));
	/* Its own: it is still closing while the children of the process are restored, by lists that
	 * use `holder` (syscall_batch.c). */
	struct inj_call late __attribute__((aligned(64)));
	/* What is left of the app's timers (timers.c). */
	struct inj_timer timer[INJ_TIMERS_MAX];
};
_Static_assert(offsetof(struct inj_control, arrived) == HOME_ARRIVED, "parasite.S");
#ifdef HOME_CUT
_Static_assert(offsetof(struct inj_control, cut) == HOME_CUT, "parasite.S");
#endif
_Static_assert(sizeof(struct inj_control) <= INJ_SLOTS_OFFSET - INJ_CODE_BYTES, "control area");

/* A call that a process makes while it is restored: one of a list. Lists are made once, with the
 * generation, and executed at every restore from it. */
struct inj_setup {
	uint64_t next;  /* address of the one after it, 0: the last             */
	uint64_t store; /* where the result is put as well, e.g. an argument of
	                 * a later call; 0: nowhere                             */
	uint32_t flags; /* enum inj_setup_flag                                  */
	char name[20];  /* for messages                                         */
	struct inj_syscall call;
};

/* Instead of a system call: timer_create(clock, event, &id) that gives the id arg[3]. */
#define INJ_TIMER_CREATE (-1)
/* Likewise: what an earlier call has opened, arg[1], becomes the descriptor arg[0] with the flags
 * arg[2]; if that call failed, its result. */
#define INJ_MOVE (-2)
/* Likewise, for each capability of the set arg[1]: removes it from the bounding set (arg[0]
 * PR_CAPBSET_DROP) or adds it to the ambient one (PR_CAP_AMBIENT). */
#define INJ_CAPS_CHANGE (-3)
/* Likewise: setrlimit(arg[0], arg[1]), as far as permitted for a process that may not raise its
 * hard limit. */
#define INJ_LIMIT (-4)
/* Likewise: timer_settime(2) or setitimer(2) (arg[0], their number) of the timer arg[1], with what
 * is left of the struct inj_timer at arg[2], read at arg[3] ns of the process's CLOCK_MONOTONIC (it
 * may be in a time namespace).  arg[4]: its signal ends the process. */
#define INJ_TIMER_SET (-5)
/* Likewise: fcntl(arg[0], arg[1], arg[2]), so that the caller is recorded as the owner of the lock.
 * Setting an existing one again changes nothing, not even its recorded owner. */
#define INJ_LOCK (-6)

enum inj_setup_flag {
	INJ_MUST = 0,
	INJ_MAY_FAIL = 1 /* the restore goes on without it                      */
};

enum inj_stage {
	INJ_DESCRIPTORS, /* before INJ_BEFORE; built at each restore */
	INJ_OWNERS,      /* before INJ_AFTER; likewise                           */
	INJ_BEFORE,      /* by the main thread, before there are others              */
	INJ_AFTER,       /* by the main thread, when all others are ready */
	INJ_STAGES
};

/* One thread to be restored. */
struct inj_thread {
	/* stack pointer for rt_sigreturn(2), 0: a main thread that ends instead  */
	uint64_t frame;
	uint64_t stack; /* initial stack pointer of the new thread          */
	uint64_t tls;
	uint64_t clear_tid; /* set_tid_address(2)                               */
	uint64_t robust_list;
	uint64_t robust_bytes;
	uint64_t rseq;        /* address, 0: none registered                      */
	uint64_t other_base;  /* a second base register (x86: gs), 0: none       */
	uint64_t large_state; /* registers without room yet, 0: none */
	uint64_t setup;       /* list of struct inj_setup, by the thread itself   */
	uint32_t rseq_bytes;
	uint32_t rseq_signature;
	int32_t tid; /* inside                                           */
	uint32_t affinity_bytes;
	uint64_t affinity[INJ_CPU_WORDS];
	uint64_t pause_ms; /* it goes on so long after `go`                       */
	char name[16];
};

enum inj_state {
	INJ_IDLE = 0,
	INJ_FAILED = 1, /* error, error_at, error_tid say what               */
	INJ_READY = 2   /* all threads exist and wait for `go`               */
};

enum inj_go {
	INJ_GO_NOT = 0,
	INJ_GO_ENDED = 1, /* a main thread that ends (inj_thread.frame)         */
	INJ_GO_ALL = 2    /* to the app                                      */
};

enum inj_step {
	INJ_STEP_NONE,
	INJ_STEP_SESSION,
	INJ_STEP_GROUP,
	INJ_STEP_TTY,
	INJ_STEP_ROBUST,
	INJ_STEP_RSEQ,
	INJ_STEP_THREAD,
	INJ_STEP_TID,
	INJ_STEP_BASE,
	INJ_STEP_SETUP
};

/* No number is to be chosen any more: the namespace's PIDs continue from where they were. */
#define INJ_LAST_PID_FREE (-1)

/* A generation's restore, in the restored process. */
struct inj_slot {
	uint32_t state;   /* futex, enum inj_state                          */
	uint32_t go;      /* futex, enum inj_go, set by the engine          */
	uint32_t spawned; /* futex: 1 when all threads exist, or it has failed   */
	uint32_t ready;   /* threads that have set themselves up            */
	uint32_t running; /* threads about to return to the app */
	uint32_t astray;  /* tasks were made with wrong numbers, and may have yet to end */
	/* ns_last_pid, written by the engine's helper on request               */
	uint32_t want;     /* incremented by R for each request              */
	uint32_t have;     /* set to `want` by the helper                    */
	int32_t last_pid;  /* the value R wants, or INJ_LAST_PID_FREE        */
	uint32_t once;     /* the number is for one clone, and then as FREE  */
	uint32_t cpu;      /* of R, current_cpu(), when it asked             */
	int32_t error;     /* errno                                          */
	uint32_t error_at; /* enum inj_step                                  */
	int32_t error_tid;
	int32_t pid;   /* the app's, inside                              */
	int32_t group; /* process group, inside                          */
	uint32_t session_leader;
	uint32_t placed; /* session and group are already right */
	/* -1, or a descriptor of its session's terminal, or of the one whose foreground it was
	 * in */
	int32_t tty_fd;
	uint32_t threads;
	uint32_t block_bytes;       /* of one thread's block                          */
	uint64_t blocks;            /* address of the first                           */
	uint64_t setup[INJ_STAGES]; /* lists of struct inj_setup                */
	uint64_t error_setup;       /* the one that failed                            */
	struct inj_call template_call __attribute__((aligned(64)));
};

/* Entry points, at the addresses the linker put them (parasite_blob.h). */
/* A task may be sent there out of a clone(2) that has been reported but has not returned yet; on
 * aarch64 its result then comes into the register of the first argument. */
void inj_run(uint64_t result, struct inj_call *call);
void inj_restore(struct inj_slot *slot);
void inj_end(void) __attribute__((noreturn));

/* Of arch/ARCH/parasite.S. */
void inj_enter(struct inj_call *call, uint64_t stack) __attribute__((noreturn));
void inj_go_home(void) __attribute__((noreturn));
long inj_clone(uint64_t flags, uint64_t stack, uint64_t a, uint64_t b, uint64_t c);
long inj_spawn(uint64_t flags, uint64_t stack, uint64_t tls, struct inj_thread *thread,
	       struct inj_slot *slot, int32_t tid);
void inj_thread(struct inj_slot *slot, struct inj_thread *thread) __attribute__((noreturn));
void inj_make_room(uint64_t state);
void inj_sigreturn(uint64_t frame) __attribute__((noreturn));

#endif
