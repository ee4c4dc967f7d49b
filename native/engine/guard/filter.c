/* SPDX-License-Identifier: Apache-2.0
 *
 * The guard's own seccomp filter: the system calls that it makes, and no others.  A call that is
 * not listed fails with ENOSYS, as on a kernel that lacks it: libraries know how to do without.
 *
 * The helper of a restore (last_pid.c) is started under it, and adds its own.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/audit.h>
#include <linux/filter.h>
#include <linux/perf_event.h>
#include <linux/seccomp.h>
#include <linux/sockios.h>
#include <linux/userfaultfd.h>
#include <sched.h>
#include <signal.h>
#include <stddef.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/socket.h>
#include <sys/syscall.h>

#include "guard.h"
#include "lastpid.h"

/* Whatever their arguments are. */
static const int plain[] = {
	/* processes, and their memory */
	SYS_process_vm_readv,
	SYS_process_vm_writev,
	SYS_pidfd_open,
	SYS_pidfd_getfd,
	SYS_pidfd_send_signal,
	SYS_kill,
	SYS_tgkill,
	SYS_wait4,
	SYS_waitid,
	SYS_kcmp,
	SYS_getppid,
	SYS_perf_event_open,
	SYS_get_robust_list,
	SYS_prlimit64,
	SYS_sched_getaffinity,
	SYS_sched_setaffinity,
	SYS_sched_getattr,
	SYS_sched_setattr,
	SYS_sched_getparam,
	SYS_sched_getscheduler,
	SYS_sched_setscheduler,
	SYS_sched_get_priority_max,
	SYS_sched_get_priority_min,
	SYS_sched_yield,
	SYS_ioprio_get,
	SYS_ioprio_set,
	/* files */
	SYS_openat,
	SYS_openat2,
	SYS_open_by_handle_at,
	SYS_close,
	SYS_close_range,
	SYS_read,
	SYS_readv,
	SYS_pread64,
	SYS_preadv,
	SYS_preadv2,
	SYS_write,
	SYS_writev,
	SYS_pwrite64,
	SYS_pwritev,
	SYS_pwritev2,
	SYS_lseek,
	SYS_ftruncate,
	SYS_dup3,
	SYS_fcntl,
	SYS_flock,
	SYS_fstat,
	SYS_newfstatat,
	SYS_statx,
	SYS_fstatfs,
	SYS_getxattr,
	SYS_getdents64,
	SYS_getcwd,
	SYS_LISTMOUNT,
	SYS_fchdir,
	SYS_chroot,
	SYS_umask,
	SYS_readlinkat,
	SYS_faccessat,
	SYS_faccessat2,
	SYS_fchmodat,
	SYS_fchown,
	SYS_fchownat,
	SYS_unlinkat,
	SYS_renameat2,
	SYS_memfd_create,
	SYS_pipe2,
	SYS_tee,
	SYS_eventfd2,
	SYS_signalfd4,
	SYS_timerfd_create,
	SYS_timerfd_settime,
	SYS_inotify_init1,
	SYS_inotify_add_watch,
	SYS_inotify_rm_watch,
	SYS_fanotify_init,
	SYS_fanotify_mark,
	SYS_epoll_create1,
	SYS_ppoll,
	/* sockets; socket(2) is below */
	SYS_socketpair,
	SYS_bind,
	SYS_listen,
	SYS_accept4,
	SYS_connect,
	SYS_shutdown,
	SYS_getsockname,
	SYS_getpeername,
	SYS_getsockopt,
	SYS_setsockopt,
	SYS_sendto,
	SYS_sendmsg,
	SYS_recvfrom,
	SYS_recvmsg,
	/* its user, as which it opens files */
	SYS_getuid,
	SYS_geteuid,
	SYS_getgid,
	SYS_getegid,
	SYS_getgroups,
	SYS_setgroups,
	SYS_setfsuid,
	SYS_setfsgid,
	SYS_setresuid,
	SYS_setresgid,
	SYS_capget,
	SYS_capset,
	/* itself */
	SYS_brk,
	SYS_munmap,
	SYS_mremap,
	SYS_madvise,
	SYS_pkey_alloc, /* whether there is another key */
	SYS_pkey_free,
	SYS_futex,
	SYS_rseq,
	SYS_set_robust_list,
	SYS_set_tid_address,
	SYS_getpid,
	SYS_gettid,
	SYS_setsid,
	SYS_getrandom,
	SYS_uname,
	SYS_sysinfo,
	SYS_seccomp, /* filters are only added */
	SYS_rt_sigaction,
	SYS_rt_sigprocmask,
	SYS_rt_sigreturn,
	SYS_rt_sigtimedwait,
	SYS_restart_syscall,
	SYS_clock_gettime,
	SYS_clock_getres,
	SYS_clock_nanosleep,
	SYS_nanosleep,
	SYS_setitimer,
	SYS_timer_create,
	SYS_timer_settime,
	SYS_timer_delete,
	SYS_exit,
	SYS_exit_group,
#ifdef __x86_64__ /* older forms, which its libc uses */
	SYS_poll,
	SYS_readlink,
	SYS_chmod,
	SYS_renameat,
#endif
};

/* With one argument of these, of which bits outside of `mask` are ignored.  Grouped by number. */
struct rule {
	int nr, arg;
	uint32_t value, mask;
};

#define IS(value) (uint32_t)(value), ~UINT32_C(0)
#define THREAD (CLONE_VM | CLONE_FS | CLONE_FILES | CLONE_SIGHAND | CLONE_THREAD | CLONE_SYSVSEM)
#define SPACES \
	(CLONE_NEWNS | CLONE_NEWUTS | CLONE_NEWIPC | CLONE_NEWNET | CLONE_NEWPID | CLONE_NEWCGROUP)

static const struct rule rules[] = {
	{ SYS_ptrace, 0, IS(PTRACE_SYSCALL) },
	{ SYS_ptrace, 0, IS(PTRACE_CONT) },
	{ SYS_ptrace, 0, IS(PTRACE_INTERRUPT) },
	{ SYS_ptrace, 0, IS(PTRACE_SEIZE) },
	{ SYS_ptrace, 0, IS(PTRACE_DETACH) },
	{ SYS_ptrace, 0, IS(PTRACE_SETOPTIONS) },
	{ SYS_ptrace, 0, IS(PTRACE_GETEVENTMSG) },
	{ SYS_ptrace, 0, IS(PTRACE_GETSIGMASK) },
	{ SYS_ptrace, 0, IS(PTRACE_SETSIGMASK) },
	{ SYS_ptrace, 0, IS(PTRACE_GETREGSET) },
	{ SYS_ptrace, 0, IS(PTRACE_SETREGSET) },
#ifdef __x86_64__
	{ SYS_ptrace, 0, IS(PTRACE_GETREGS) },
	{ SYS_ptrace, 0, IS(PTRACE_SETREGS) },
	{ SYS_ptrace, 0, IS(PTRACE_POKEUSER) },
#endif
	{ SYS_ptrace, 0, IS(PTRACE_PEEKTEXT) },
	{ SYS_ptrace, 0, IS(PTRACE_PEEKDATA) },
	{ SYS_ptrace, 0, IS(PTRACE_PEEKSIGINFO) },
	{ SYS_ptrace, 0, IS(0x420e /* PTRACE_GET_SYSCALL_INFO */) },
	{ SYS_ptrace, 0, IS(0x420f /* PTRACE_GET_RSEQ_CONFIGURATION */) },
	{ SYS_ptrace, 0, IS(0x4211 /* PTRACE_GET_SYSCALL_USER_DISPATCH_CONFIG */) },

	{ SYS_ioctl, 1, IS(FIONREAD) }, /* SIOCINQ */
	{ SYS_ioctl, 1, IS(TIOCOUTQ) }, /* SIOCOUTQ */
	{ SYS_ioctl, 1, IS(SIOCPROTOPRIVATE) /* SIOCUNIXFILE */ },
	{ SYS_ioctl, 1, IS(TCGETS) },
	{ SYS_ioctl, 1, IS(_IOW('I', 0, int32_t)) /* INOTIFY_IOC_SETNEXTWD */ },
	{ SYS_ioctl, 1, IS(_IOW('T', 0, uint64_t)) /* TFD_IOC_SET_TICKS */ },
	{ SYS_ioctl, 1, IS(_IOC(_IOC_READ | _IOC_WRITE, 'f', 16, 96)) /* PAGEMAP_SCAN */ },
	{ SYS_ioctl, 1, IS(UFFDIO_API) },
	{ SYS_ioctl, 1, IS(UFFDIO_REGISTER) },
	{ SYS_ioctl, 1, IS(UFFDIO_WRITEPROTECT) },
	{ SYS_ioctl, 1, IS(PERF_EVENT_IOC_ENABLE) },
	{ SYS_ioctl, 1, IS(PERF_EVENT_IOC_DISABLE) },
	{ SYS_ioctl, 1, IS(PERF_EVENT_IOC_SET_FILTER) },
	{ SYS_ioctl, 1, 'V' << 8, 0xff00 },  /* cameras */
	{ SYS_ioctl, 1, 0xff << 8, 0xff00 }, /* namespaces of a pidfd */
	{ SYS_ioctl, 1, IS(_IOR(0xb7, 5, uint64_t)) /* NS_GET_MNTNS_ID */ },

	{ SYS_socket, 0, IS(AF_UNIX) },
	{ SYS_socket, 0, IS(AF_INET) },
	{ SYS_socket, 0, IS(AF_INET6) },
	{ SYS_socket, 0, IS(AF_NETLINK) },
	{ SYS_socket, 0, IS(AF_PACKET) },

	{ SYS_prctl, 0, IS(PR_SET_NAME) },
	{ SYS_prctl, 0, IS(PR_SET_PDEATHSIG) },
	{ SYS_prctl, 0, IS(PR_SET_KEEPCAPS) },
	{ SYS_prctl, 0, IS(PR_SET_DUMPABLE) },
	{ SYS_prctl, 0, IS(PR_SET_NO_NEW_PRIVS) },
	{ SYS_prctl, 0, IS(PR_CAPBSET_READ) },
	{ SYS_prctl, 0, IS(PR_CAPBSET_DROP) },

	/* Threads; the helper, before and after it executes its program. */
	{ SYS_clone, 0, THREAD, THREAD | SPACES | CLONE_NEWUSER },
	{ SYS_clone, 0, IS(CLONE_VM | CLONE_VFORK) },
	{ SYS_clone, 0, IS(SIGCHLD) },

	{ SYS_setns, 1, IS(CLONE_NEWNET) }, /* of sockets */
	{ SYS_setns, 1, IS(SPACES) },       /* the helper's */
	{ SYS_unshare, 0, IS(CLONE_FS) },

	/* No new code in its memory. */
	{ SYS_mmap, 2, 0, PROT_EXEC },
	{ SYS_mprotect, 2, 0, PROT_EXEC },

	/* The helper's program, by a descriptor (become(), last_pid.c). */
	{ SYS_execveat, 0, IS(LASTPID_FDS) },
};

#define COUNT(array) (sizeof(array) / sizeof *(array))
#define WORD(field) ((uint32_t)offsetof(struct seccomp_data, field))
#define LOAD(at) ((struct sock_filter)BPF_STMT(BPF_LD | BPF_W | BPF_ABS, at))
#define EQUAL(value, yes, no) \
	((struct sock_filter)BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, value, yes, no))
#define SKIP(count) ((struct sock_filter)BPF_JUMP(BPF_JMP | BPF_JA, count, 0, 0))
#define RETURN(what) ((struct sock_filter)BPF_STMT(BPF_RET | BPF_K, what))

struct program {
	struct sock_filter insn[COUNT(plain) * 2 + COUNT(rules) * 7 + 8];
	unsigned short count;
};

static void add(struct program *p, struct sock_filter insn)
{
	p->insn[p->count++] = insn;
}

static uint32_t low_word(int arg)
{
	return WORD(args) + (uint32_t)arg * (uint32_t)sizeof(uint64_t); /* little endian */
}

/* All rules of one call, of which the first is rules[i].  Returns the first of the next one. */
static size_t add_rules(struct program *p, size_t i)
{
	const int nr = rules[i].nr;
	const unsigned short head = p->count;

	add(p, EQUAL((uint32_t)nr, 1, 0));
	add(p, SKIP(0));
	for (; i < COUNT(rules) && rules[i].nr == nr; i++) {
		add(p, LOAD(low_word(rules[i].arg)));
		add(p, (struct sock_filter)BPF_STMT(BPF_ALU | BPF_AND | BPF_K, rules[i].mask));
		add(p, EQUAL(rules[i].value, 0, 1));
		add(p, RETURN(SECCOMP_RET_ALLOW));
	}
	add(p, RETURN(SECCOMP_RET_ERRNO | ENOSYS));
	p->insn[head + 1].k = (uint32_t)(p->count - head - 2);
	return i;
}

int guard_filter_enter(void)
{
	struct program p = { .count = 0 };
	const struct sock_fprog filter = { .filter = p.insn };
	struct sock_fprog whole = filter;

	add(&p, LOAD(WORD(arch)));
	add(&p, EQUAL(ARCH_AUDIT, 1, 0));
	add(&p, RETURN(SECCOMP_RET_KILL_PROCESS));
	add(&p, LOAD(WORD(nr)));
	for (size_t i = 0; i < COUNT(rules);)
		i = add_rules(&p, i);
	/* The kernel remembers which calls pass in any case, and does not run this for them. */
	for (size_t i = 0; i < COUNT(plain); i++) {
		add(&p, EQUAL((uint32_t)plain[i], 0, 1));
		add(&p, RETURN(SECCOMP_RET_ALLOW));
	}
	add(&p, RETURN(SECCOMP_RET_ERRNO | ENOSYS));
	whole.len = p.count;
	return syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER,
		       SECCOMP_FILTER_FLAG_TSYNC | SECCOMP_FILTER_FLAG_SPEC_ALLOW, &whole)
		       ? -1
		       : 0;
}

static bool has_own_filters(const struct process *process)
{
	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].seccomp == SECCOMP_SUPERVISED ||
		    process->threads[i].filters_known > process->plain_filters)
			return true;
	return false;
}

void guard_filter(struct avc_guard *guard)
{
	if (guard->filter_decided)
		return;
	guard->filter_decided = true;
#ifdef __SANITIZE_ADDRESS__
	return; /* its library makes calls of its own */
#endif
	if (guard->config.suspends || !seccomp_can_be_confined())
		return;
	for (uint32_t i = 0; i < guard->tree.processes; i++)
		if (has_own_filters(guard->tree.process[i]))
			return;
	output_learn(&guard->output);
	faults_learn(&guard->faults);
	/* Without one there are forks only. */
	if (guard->config.images != AVC_IMAGES_FORK && seccomp_refuses_watching())
		(void)watcher_start();
	if (!guard_filter_enter())
		seccomp_confined();
}
