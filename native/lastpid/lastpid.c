/* SPDX-License-Identifier: Apache-2.0
 *
 * The helper that chooses the next PID in a container's PID namespace.
 *
 * /proc/sys/kernel/ns_last_pid (pid_namespaces(7)) acts on the namespace of the task that writes
 * it, so a task of ours has to be in there, where a container with CAP_SYS_PTRACE can take it over.
 * So it has nothing worth taking:
 *
 *   memory        this program, a stack, one page shared with the guard, and pages that are
 *                 the application's own (its parasites)
 *   descriptors   the file itself
 *   namespaces,   the container's own, but for the user namespace: where the container has
 *   root, cwd     one of its own, it cannot reach the helper at all
 *   privileges    one capability, also in the bounding set, and no_new_privs; a user of its
 *                 own, who may have two processes and open no file
 *   system calls  those of serve(), by a seccomp filter that is there before the task is
 *
 * What remains is that the container can choose its own next PIDs, and so break its own restores.
 *
 * Two processes: the first waits outside of the namespace for a restore, with the privileges to
 * enter it, enters it, drops them, and forks the second, which is inside. No libc.
 */
#include <asm/unistd.h>
#include <errno.h>
#include <linux/audit.h>
#include <linux/capability.h>
#include <linux/filter.h>
#include <linux/futex.h>
#include <linux/prctl.h>
#include <linux/sched.h>
#include <linux/seccomp.h>
#include <stdbool.h>
#include <stddef.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/socket.h>

#include "lastpid.h"
#include "parasite.h"
#include "syscall.h"

#define SYS(nr, a, b, c) raw_syscall(nr, (uint64_t)(a), (uint64_t)(b), (uint64_t)(c), 0, 0, 0)
#define PAGE_BYTES 4096
#define CAPABILITY(cap) (UINT64_C(1) << (cap))
#define SIGKILL_ 9
#define SIGCHLD_ 17
#define USER_BASE 0x70000000 /* plus its PID: a user of its own */
/* A process that makes threads asks in quick succession, microseconds apart: spin on the word for a
 * while before sleeping on it. */
#define SPINS 4000
#define SLICE_NS 20000000
#define STAY_SLICES 50
/* To see that the number was used takes a system call each time. */
#define LOOKS 50
#define LOOK_NS 50000
#define LIFE_S 60        /* the longest a restore may take; the helper exits then in any case */
#define RT_MAX_US 200000 /* it has the guard's priority, and must not keep a CPU busy */

static struct inj_slot *slots[LASTPID_SLOTS_MAX];
static uint32_t slot_count;
static struct lastpid_page *page;

/* Some compilers call it even in a program without libc. */
void *memset(void *at, int byte, size_t n);

void *memset(void *at, int byte, size_t n)
{
	for (size_t i = 0; i < n; i++)
		((volatile uint8_t *)at)[i] = (uint8_t)byte;
	return at;
}

static _Noreturn void end(int status)
{
	for (;;)
		SYS(__NR_exit_group, status, 0, 0);
}

/* The guard sees that it has exited. */
static void must(long result)
{
	if (result < 0 && result > -4096)
		end(1);
}

/* ---- what is to be served ------------------------------------------------------------- */

static void *map(int fd, uint64_t offset)
{
	const long at = raw_syscall(__NR_mmap, 0, PAGE_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED,
				    (uint64_t)fd, offset);

	must(at);
	return (void *)at;
}

/* One message; returns whether it was the last. */
static bool take_slots(void)
{
	struct lastpid_message message = { 0 };
	union {
		char bytes[CMSG_SPACE(LASTPID_MESSAGE_SLOTS * sizeof(int))];
		struct cmsghdr align;
	} control;
	struct iovec data = { &message, sizeof message };
	struct msghdr head = { .msg_iov = &data,
			       .msg_iovlen = 1,
			       .msg_control = &control,
			       .msg_controllen = sizeof control };
	const struct cmsghdr *rights = CMSG_FIRSTHDR(&head);
	const int *fd = (const int *)CMSG_DATA(&control.align);

	if (SYS(__NR_recvmsg, LASTPID_SOCKET, &head, 0) != sizeof message)
		end(0); /* the guard has exited, or does not need us any more */
	if (message.count > LASTPID_MESSAGE_SLOTS ||
	    message.count > LASTPID_SLOTS_MAX - slot_count ||
	    head.msg_controllen < sizeof *rights ||
	    rights->cmsg_len != CMSG_LEN(message.count * sizeof(int)))
		end(1);
	for (uint32_t i = 0; i < message.count; i++) {
		slots[slot_count++] = map(fd[i], message.offset[i]);
		SYS(__NR_close, fd[i], 0, 0);
	}
	return message.go;
}

/* ---- what is given up --------------------------------------------------------------------- */

#define WORD(field) ((uint32_t)offsetof(struct seccomp_data, field))
#define ALLOW(nr) \
	BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, nr, 0, 1), BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW)

static void confine_calls(void)
{
	struct sock_filter code[] = {
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, WORD(arch)),
		BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, RAW_AUDIT_ARCH, 1, 0),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS),
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, WORD(nr)),
		ALLOW(__NR_futex),
		ALLOW(__NR_pwrite64),
		ALLOW(__NR_pread64),
		ALLOW(__NR_exit_group),
		ALLOW(__NR_restart_syscall), /* of a sleep that was stopped */
		/* Of the first process, and of the second in its first moments. */
		ALLOW(__NR_clone), /* a third one is beyond RLIMIT_NPROC */
		ALLOW(__NR_wait4),
		ALLOW(__NR_setitimer),
		BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, __NR_prctl, 0, 3),
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, WORD(args[0])),
		BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, PR_SET_PDEATHSIG, 0, 1),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS),
	};
	const struct sock_fprog filter = { sizeof code / sizeof *code, code };

	must(SYS(__NR_seccomp, SECCOMP_SET_MODE_FILTER, 0, &filter));
}

static void limit(int which, uint64_t most)
{
	const uint64_t both[2] = { most, most };

	must(raw_syscall(__NR_prlimit64, 0, (uint64_t)which, (uint64_t)both, 0, 0, 0));
}

/* Before Linux 5.9 this takes CAP_SYS_ADMIN. */
static int needed_capability(void)
{
	return SYS(__NR_prctl, PR_CAPBSET_READ, CAP_CHECKPOINT_RESTORE, 0) == 1
		       ? CAP_CHECKPOINT_RESTORE
		       : CAP_SYS_ADMIN;
}

/* Permitted and effective, and no others. */
static void capabilities(uint64_t which)
{
	struct __user_cap_header_struct header = { .version = _LINUX_CAPABILITY_VERSION_3 };
	struct __user_cap_data_struct data[2] = { 0 };

	data[0].permitted = data[0].effective = (uint32_t)which;
	data[1].permitted = data[1].effective = (uint32_t)(which >> 32);
	must(SYS(__NR_capset, &header, data, 0));
}

/* Ahead of time, because these are some ninety calls: drops all but what is needed to enter the
 * container's namespaces, and becomes a user of its own. */
static void drop_privileges(int keep)
{
	const long user = USER_BASE + SYS(__NR_getpid, 0, 0, 0);

	for (int cap = 0; SYS(__NR_prctl, PR_CAPBSET_READ, cap, 0) >= 0; cap++)
		if (cap != keep)
			must(SYS(__NR_prctl, PR_CAPBSET_DROP, cap, 0));
	must(SYS(__NR_prctl, PR_SET_KEEPCAPS, 1, 0));
	must(SYS(__NR_setgroups, 0, 0, 0));
	must(SYS(__NR_setresgid, user, user, user));
	must(SYS(__NR_setresuid, user, user, user));
	capabilities(CAPABILITY(CAP_SYS_ADMIN) | CAPABILITY(CAP_SYS_CHROOT) |
		     CAPABILITY(CAP_SYS_PTRACE) | CAPABILITY(keep));
	must(SYS(__NR_prctl, PR_SET_NO_NEW_PRIVS, 1, 0));
	must(SYS(__NR_prctl, PR_SET_DUMPABLE, 0, 0));
	limit(RLIMIT_NPROC, 2);
	limit(RLIMIT_CORE, 0);
	limit(RLIMIT_RTTIME, RT_MAX_US);
}

static bool guard_is_there(void)
{
	char byte;

	return raw_syscall(__NR_recvfrom, LASTPID_SOCKET, (uint64_t)&byte, 1,
			   MSG_PEEK | MSG_DONTWAIT, 0, 0) == -EAGAIN;
}

/* From here on its working directory and root are the container's. */
static void enter(int keep)
{
	const uint64_t spaces = CLONE_NEWNS | CLONE_NEWUTS | CLONE_NEWIPC | CLONE_NEWNET |
				CLONE_NEWPID | CLONE_NEWCGROUP;

	must(SYS(__NR_setns, LASTPID_INIT, spaces, 0));
	capabilities(CAPABILITY(keep));
	/* The change of credentials has cleared it; a parent that died before shows on the
	 * socket. */
	SYS(__NR_prctl, PR_SET_PDEATHSIG, SIGKILL_, 0);
	if (!guard_is_there())
		end(1);
	SYS(__NR_close, LASTPID_SOCKET, 0, 0);
	SYS(__NR_close, LASTPID_PAGE, 0, 0);
	SYS(__NR_close, LASTPID_INIT, 0, 0);
	limit(RLIMIT_NOFILE, 0);
	confine_calls();
}

/* ---- requests ------------------------------------------------------------------------------ */

static int32_t read_last_pid(void)
{
	char text[12];
	int32_t value = 0;
	const long n = raw_syscall(__NR_pread64, LASTPID_FILE, (uint64_t)text, sizeof text, 0, 0,
				   0);

	for (long i = 0; i < n && text[i] >= '0' && text[i] <= '9'; i++)
		value = value * 10 + (text[i] - '0');
	return value;
}

static int32_t write_last_pid(int32_t value)
{
	char text[12], *p = text + sizeof text;
	long r;

	do {
		*--p = (char)('0' + value % 10);
		value /= 10;
	} while (value);
	r = raw_syscall(__NR_pwrite64, LASTPID_FILE, (uint64_t)p,
			(uint64_t)(text + sizeof text - p), 0, 0, 0);
	return r < 0 ? (int32_t)-r : 0;
}

/* Sleeps while *word == value, so long at most. */
static void sleep_on(uint32_t *word, uint32_t value, int64_t ns)
{
	const int64_t slice[2] = { 0, ns };

	raw_syscall(__NR_futex, (uint64_t)word, FUTEX_WAIT, value, (uint64_t)slice, 0, 0);
}

/* While it spins, nobody else runs on its CPU: not if that is the one of who has asked, and has to go
 * on first; nor once a task has got a wrong number: that is because dead threads still have theirs
 * until they get a CPU (kernel/exit.c, release_task()), which a real-time task must not keep. */
static uint32_t spins_after(const struct inj_slot *slot, int32_t once)
{
	if (slot->last_pid == INJ_LAST_PID_FREE || slot->astray ||
	    (slot->cpu && slot->cpu == current_cpu()))
		return 0;
	return once ? LOOKS : SPINS;
}

static void serve(void)
{
	int32_t before = 0, once = 0;
	uint32_t spins = 0;

	while (!__atomic_load_n(&page->stop, __ATOMIC_ACQUIRE)) {
		const uint32_t serving = __atomic_load_n(&page->serving, __ATOMIC_ACQUIRE);
		struct inj_slot *slot = slots[serving < slot_count ? serving : 0];
		const uint32_t want = __atomic_load_n(&slot->want, __ATOMIC_ACQUIRE);
		const bool asked = want != slot->have;

		if (asked && slot->last_pid > 0) {
			if (!before) /* the guard holds the lock */
				before = read_last_pid();
			once = slot->once ? slot->last_pid : 0;
			page->error = write_last_pid(slot->last_pid);
		} else if (before > 0 && ((asked && slot->last_pid == INJ_LAST_PID_FREE) ||
					  (once > 0 && read_last_pid() != once))) {
			/* Others that fork are not to take the numbers after it: the next of the
			 * dead may need them. */
			write_last_pid(before);
			before = once = 0;
		}
		if (asked) {
			__atomic_store_n(&slot->have, want, __ATOMIC_RELEASE);
			SYS(__NR_futex, &slot->have, FUTEX_WAKE, INT32_MAX);
			spins = 0;
		} else if (++spins < spins_after(slot, once)) {
			cpu_relax();
		} else {
			sleep_on(&slot->want, want, once ? LOOK_NS : SLICE_NS);
		}
	}
	/* PIDs continue from where they were. Otherwise the next templates would get those of
	 * short-lived threads that older generations still refer to. */
	if (before > 0)
		write_last_pid(before);
	__atomic_store_n(&page->stopped, 1, __ATOMIC_RELEASE);
	SYS(__NR_futex, &page->stopped, FUTEX_WAKE, INT32_MAX);
	for (int i = 0; i < STAY_SLICES && page->stop == LASTPID_STOP; i++)
		sleep_on(&page->stop, LASTPID_STOP, SLICE_NS);
}

/* ---- both ------------------------------------------------------------------------------------ */

_Noreturn void lastpid_main(void);

RAW_ENTRY _Noreturn void lastpid_main(void)
{
	const int keep = needed_capability();
	const int64_t life[4] = { 0, 0, LIFE_S, 0 }; /* struct itimerval */
	long child;

	SYS(__NR_prctl, PR_SET_PDEATHSIG, SIGKILL_, 0);
	SYS(__NR_prctl, PR_SET_NAME, "avckpt-pid", 0);
	SYS(__NR_setsid, 0, 0, 0);
	page = map(LASTPID_PAGE, 0);
	drop_privileges(keep);
	SYS(__NR_prctl, PR_SET_PDEATHSIG, SIGKILL_, 0);
	while (!take_slots())
		;
	enter(keep);
	child = raw_syscall(__NR_clone, SIGCHLD_, 0, 0, 0, 0, 0);
	must(child);
	if (child == 0) {
		SYS(__NR_prctl, PR_SET_PDEATHSIG, SIGKILL_, 0);
		SYS(__NR_setitimer, 0 /* ITIMER_REAL */, life, 0); /* if that was set too late */
		serve();
		end(0);
	}
	raw_syscall(__NR_wait4, (uint64_t)child, 0, 0, 0, 0, 0);
	end(0);
}
