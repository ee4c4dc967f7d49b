/* SPDX-License-Identifier: Apache-2.0
 *
 * The system calls of injected code, for seccomp filters.
 */
#include <sched.h>
#include <signal.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/syscall.h>

#include "seccomp.h"

#define KINDS(array)                                   \
	{                                              \
		array, sizeof(array) / sizeof *(array) \
	}

static const struct kind wanted[] = {
	/* control */
	{ SYS_futex, ANY },
	{ SYS_ppoll, ANY },
	{ SYS_nanosleep, ANY },
	{ SYS_rt_sigprocmask, SIG_SETMASK },
	{ SYS_exit, ANY },
	{ SYS_exit_group, ANY },
	{ SYS_wait4, ANY },
	{ SYS_clone, CLONE_FILES | CLONE_PARENT | SIGCHLD },
	{ SYS_clone, CLONE_VM | CLONE_FILES },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_THREAD | CLONE_SIGHAND | CLONE_FS },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_PARENT | SIGCHLD },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_SIGHAND },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_SIGHAND | SIGCHLD },
	{ SYS_clone, SPAWN_FLAGS },
	{ SYS_setpgid, ANY },
	{ SYS_setsid, ANY },
	/* queries of a template */
	{ SYS_brk, 0 },
	{ SYS_prctl, PR_GET_THP_DISABLE },
	{ SYS_prctl, 68 /* PR_GET_MEMORY_MERGE */ },
	{ SYS_pkey_alloc, ANY },
	{ SYS_get_robust_list, ANY },
	/* queries */
	{ SYS_prctl, PR_GET_TID_ADDRESS },
	{ SYS_prctl, PR_GET_NAME },
	{ SYS_prctl, PR_GET_DUMPABLE },
	{ SYS_prctl, PR_GET_SECUREBITS },
	{ SYS_prctl, PR_GET_NO_NEW_PRIVS },
	{ SYS_prctl, PR_GET_TIMERSLACK },
	{ SYS_prctl, PR_GET_PDEATHSIG },
	{ SYS_prctl, PR_GET_CHILD_SUBREAPER },
	{ SYS_prctl, PR_CAPBSET_READ },
	{ SYS_gettid, ANY },
	{ SYS_getpid, ANY },
	{ SYS_sigaltstack, ANY },
	{ SYS_getgroups, ANY },
	{ SYS_getresuid, ANY },
	{ SYS_getresgid, ANY },
	{ SYS_setfsuid, ANY },
	{ SYS_setfsgid, ANY },
	{ SYS_capget, ANY },
	{ SYS_get_mempolicy, ANY },
	{ SYS_personality, 0xffffffff },
	{ ARCH_STATE_CALL, ARCH_STATE_PERMITTED },
	{ SYS_getitimer, ANY },
	{ SYS_timer_gettime, ANY },
	{ SYS_clock_gettime, ANY },
	{ SYS_waitid, ANY },
	{ SYS_mincore, ANY },
	{ SYS_rseq, ANY },
	{ SYS_prctl, PR_SET_NAME },
	{ SYS_prctl, PR_SET_CHILD_SUBREAPER },
	{ SYS_rt_sigaction, ANY },
	/* memory and descriptors */
	{ SYS_mmap, ANY },
	{ SYS_munmap, ANY },
	{ SYS_mprotect, ANY },
	{ SYS_mremap, ANY },
	{ SYS_madvise, ANY },
	{ SYS_membarrier, ANY },
	{ SYS_mlockall, ANY },
	{ SYS_close, ANY },
	{ SYS_close_range, ANY },
	{ SYS_dup3, ANY },
	{ SYS_fcntl, ANY },
	{ SYS_epoll_ctl, ANY },
	{ SYS_pidfd_open, ANY },
	{ SYS_socketpair, ANY },
	{ SYS_recvmsg, ANY },
	{ SYS_setsockopt, ANY },
};

static const struct kind wanted_to_restore[] = {
	{ SYS_prctl, PR_SET_DUMPABLE },
	{ SYS_prctl, PR_SET_KEEPCAPS },
	{ SYS_prctl, PR_SET_SECUREBITS },
	{ SYS_prctl, PR_SET_NO_NEW_PRIVS },
	{ SYS_prctl, PR_SET_TIMERSLACK },
	{ SYS_prctl, PR_SET_PDEATHSIG },
	{ SYS_prctl, PR_CAPBSET_DROP },
	{ SYS_prctl, PR_CAP_AMBIENT },
	{ SYS_prctl, 77 /* PR_TIMER_CREATE_RESTORE_IDS */ },
	{ SYS_set_tid_address, ANY },
	{ SYS_set_robust_list, ANY },
	{ SYS_rt_sigqueueinfo, ANY },
	{ SYS_rt_tgsigqueueinfo, ANY },
	{ SYS_tgkill, ANY },
	{ SYS_sched_setaffinity, ANY },
	{ SYS_set_mempolicy, ANY },
	{ SYS_setgroups, ANY },
	{ SYS_setresuid, ANY },
	{ SYS_setresgid, ANY },
	{ SYS_capset, ANY },
	{ SYS_prlimit64, ANY },
	{ SYS_setitimer, ANY },
	{ SYS_timer_create, ANY },
	{ SYS_timer_settime, ANY },
	{ SYS_timer_delete, ANY },
	{ SYS_mlock2, ANY },
	{ SYS_listen, ANY },
	{ SYS_userfaultfd, ANY },
	{ SYS_ioctl, ANY }, /* TIOCSPGRP, TIOCSCTTY                            */
	{ SYS_umask, ANY },
	{ SYS_fchdir, ANY },
	{ SYS_rt_sigtimedwait, ANY },
	{ SYS_pkey_free, ANY },
	{ SYS_pkey_mprotect, ANY },
	ARCH_ROOM_CALLS
};

static const struct kind wanted_for_trees[] = {
	{ SYS_clone, CLONE_FILES | SIGCHLD },
	{ SYS_clone, SIGCHLD },
	{ SYS_personality, ANY },
	{ SYS_brk, ANY },
	{ SYS_shmat, ANY },
	{ SYS_chroot, ANY },
	{ SYS_fcntl, ANY },
	{ SYS_write, ANY },
	{ SYS_read, ANY },
	{ SYS_kill, ANY },
	{ SYS_prctl, 41 /* PR_SET_THP_DISABLE */ },
	{ SYS_prctl, 67 /* PR_SET_MEMORY_MERGE */ },
	{ SYS_prctl, PR_SET_MM },
};

static const struct kind needed[] = {
	/* of the porter, and the stub that clones it (porter.c) */
	{ SYS_rt_sigprocmask, SIG_SETMASK },
	{ SYS_clone, CLONE_VM | CLONE_FILES },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_THREAD | CLONE_SIGHAND | CLONE_FS },
	{ SYS_clone, CLONE_VM | CLONE_FILES | CLONE_PARENT | SIGCHLD },
	{ SYS_wait4, ANY },
	{ SYS_waitid, ANY },
	{ SYS_mmap, ANY },
	{ SYS_mprotect, ANY },
	{ SYS_close_range, ANY },
	{ SYS_socketpair, AF_UNIX },
	{ SYS_recvmsg, ANY },
	{ SYS_close, ANY },
	{ SYS_exit, ANY },
};

static const struct kind needed_to_watch[] = { { SYS_userfaultfd, ANY } };

static const struct kind needed_to_ask[] = {
	{ SYS_getsockopt, ANY },
	{ SYS_getsockname, ANY },
	{ SYS_getpeername, ANY },
	{ SYS_fstat, ANY },
};

static const struct kind homeward[] = {
	{ SYS_rt_sigprocmask, SIG_SETMASK },
	{ SYS_rt_sigreturn, ANY },
	{ SYS_munmap, ANY },
	{ SYS_madvise, ANY },
	{ SYS_exit, ANY },
};
const char *const seccomp_homeward_name[] = { "rt_sigprocmask", "rt_sigreturn", "munmap", "madvise",
					      "exit" };

static const struct kind restarts[] = { { SYS_restart_syscall, ANY } };

static const struct kind rests[] = {
	{ SYS_write, ANY },
	{ SYS_sendto, ANY },
	{ SYS_recvfrom, ANY },
};

const struct kinds seccomp_wanted = KINDS(wanted);
const struct kinds seccomp_wanted_to_restore = KINDS(wanted_to_restore);
const struct kinds seccomp_wanted_for_trees = KINDS(wanted_for_trees);
const struct kinds seccomp_needed = KINDS(needed);
const struct kinds seccomp_needed_to_watch = KINDS(needed_to_watch);
const struct kinds seccomp_needed_to_ask = KINDS(needed_to_ask);
const struct kinds seccomp_homeward = KINDS(homeward);
const struct kinds seccomp_restarts = KINDS(restarts);
const struct kinds seccomp_rests = KINDS(rests);
