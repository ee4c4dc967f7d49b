/* SPDX-License-Identifier: Apache-2.0
 *
 * The next PID of another PID namespace.
 *
 * /proc/sys/kernel/ns_last_pid (pid_namespaces(7)) acts on the namespace of the
 * task that writes it, so somebody has to be inside.  The helper is a task of our
 * own that shares our memory, lives for the length of one restore, and makes
 * nothing but raw system calls: it shares this thread's TLS, errno included.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/futex.h>
#include <sched.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "syscall.h"
#include "trace.h"

#define STACK_BYTES 16384
/* Requests come in quick succession, for a restore is a matter of microseconds:
 * look at the word for a while before sleeping on it.  Only for a while, and only
 * if there is a CPU for both: on a busy machine the other side could not run. */
#define HELPER_SPINS 4000
#define ENGINE_SPINS 100
#define SLICE_NS (20 * (long)NS_PER_MS)

struct last_pid {
	pid_t task;
	int fd;
	struct inj_slot *slot; /* want, have: requests, ours and the new process' */
	int32_t error;
	int32_t before; /* what it was, to be put back at the end          */
	uint32_t stop;
	uint8_t stack[STACK_BYTES] __attribute__((aligned(16)));
};

static int32_t write_last_pid(int fd, int32_t value)
{
	char text[12], *p = text + sizeof text;
	long r;

	do {
		*--p = (char)('0' + value % 10);
		value /= 10;
	} while (value);
	r = raw_syscall(SYS_pwrite64, (uint64_t)fd, (uint64_t)p, (uint64_t)(text + sizeof text - p),
			0, 0, 0);
	return r < 0 ? (int32_t)r : 0;
}

/* Sleeps while *word == value, a slice at most. */
static void sleep_on(uint32_t *word, uint32_t value)
{
	const struct timespec slice = { .tv_nsec = SLICE_NS };

	raw_syscall(SYS_futex, (uint64_t)word, FUTEX_WAIT, value, (uint64_t)&slice, 0, 0);
}

static void wake(uint32_t *word)
{
	raw_syscall(SYS_futex, (uint64_t)word, FUTEX_WAKE, INT32_MAX, 0, 0, 0);
}

static int32_t read_last_pid(int fd)
{
	char text[12];
	int32_t value = 0;
	long n = raw_syscall(SYS_pread64, (uint64_t)fd, (uint64_t)text, sizeof text, 0, 0, 0);

	for (long i = 0; i < n && text[i] >= '0' && text[i] <= '9'; i++)
		value = value * 10 + (text[i] - '0');
	return value;
}

#if defined(__SANITIZE_ADDRESS__)
__attribute__((no_sanitize("address", "undefined")))
#endif
static int
serve(void *arg)
{
	struct last_pid *helper = arg;
	uint32_t spins = 0;

	raw_syscall(SYS_prctl, PR_SET_PDEATHSIG, SIGKILL, 0, 0, 0, 0);
	helper->before = read_last_pid(helper->fd);
	while (!__atomic_load_n(&helper->stop, __ATOMIC_ACQUIRE)) {
		struct inj_slot *slot = __atomic_load_n(&helper->slot, __ATOMIC_ACQUIRE);
		const uint32_t want = __atomic_load_n(&slot->want, __ATOMIC_ACQUIRE);

		if (want != slot->have) {
			if (slot->last_pid > 0)
				helper->error = write_last_pid(helper->fd, slot->last_pid);
			__atomic_store_n(&slot->have, want, __ATOMIC_RELEASE);
			wake(&slot->have);
			spins = 0;
		} else if (++spins < HELPER_SPINS) {
			cpu_relax();
		} else {
			sleep_on(&slot->want, want);
		}
	}
	/* Numbers go on from where they were.  Else the next templates would get
	 * those of short-lived threads that older generations still name. */
	if (helper->before > 0)
		write_last_pid(helper->fd, helper->before);
	return 0;
}

struct last_pid *last_pid_start(int pidns_fd, struct inj_slot *slot, struct avc_error *err)
{
	struct last_pid *helper = NULL;
	int own = open("/proc/self/ns/pid", O_RDONLY | O_CLOEXEC);

	if (posix_memalign((void **)&helper, 64, sizeof *helper))
		helper = NULL;
	if (!helper || own < 0) {
		fail_errno(err, 0, "restore", "open(ns/pid)", "no helper");
		goto out;
	}
	memset(helper, 0, offsetof(struct last_pid, stack));
	helper->slot = slot;
	slot->want = slot->have = 0;
	helper->fd = open("/proc/sys/kernel/ns_last_pid", O_RDWR | O_CLOEXEC);
	if (helper->fd < 0) {
		fail_errno(err, 0, "restore", "open(ns_last_pid)",
			   "needs CONFIG_CHECKPOINT_RESTORE and a writable /proc/sys");
		goto out;
	}
	if (setns(pidns_fd, CLONE_NEWPID)) {
		fail_errno(err, 0, "restore", "setns",
			   "the container's PID namespace can not be entered");
		goto out;
	}
	/* No exit signal: nobody but this thread is to hear of it. */
	helper->task = clone(serve, helper->stack + STACK_BYTES, CLONE_VM | CLONE_FILES | CLONE_FS,
			     helper);
	if (helper->task < 0) {
		helper->task = 0;
		fail_errno(err, 0, "restore", "clone",
			   "no helper in the container's PID namespace");
	}
	if (setns(own, CLONE_NEWPID))
		fail_errno(err, 0, "restore", "setns", "the way back into our own PID namespace");
out:
	close_fd(&own);
	if (helper && !helper->task) {
		if (helper->fd > 0)
			close(helper->fd);
		free(helper);
		helper = NULL;
	}
	return helper;
}

int last_pid_set(struct last_pid *helper, pid_t value, struct avc_error *err)
{
	const uint64_t end = now_ns() + NS_PER_S;
	struct inj_slot *slot = helper->slot;
	uint32_t want, have;

	slot->last_pid = value;
	want = __atomic_add_fetch(&slot->want, 1, __ATOMIC_ACQ_REL);
	wake(&slot->want);
	for (uint32_t spins = 0; (have = __atomic_load_n(&slot->have, __ATOMIC_ACQUIRE)) != want;
	     spins++) {
		if (spins < ENGINE_SPINS) {
			cpu_relax();
			continue;
		}
		if (now_ns() > end)
			return fail(err, AVC_KERNEL, ETIMEDOUT, 0, "restore", "write(ns_last_pid)",
				    "the helper does not answer");
		sleep_on(&slot->have, have);
	}
	if (helper->error)
		return fail(
			err, AVC_DENIED, -helper->error, 0, "restore", "write(ns_last_pid)",
			"the next PID can not be chosen (CAP_CHECKPOINT_RESTORE or CAP_SYS_ADMIN is needed)");
	return 0;
}

void last_pid_serve(struct last_pid *helper, struct inj_slot *slot)
{
	struct inj_slot *before = helper->slot;

	slot->want = slot->have = 0;
	__atomic_store_n(&helper->slot, slot, __ATOMIC_RELEASE);
	/* It may be asleep on the other one's word.  Woken up it has nothing to write. */
	before->last_pid = 0;
	__atomic_add_fetch(&before->want, 1, __ATOMIC_ACQ_REL);
	wake(&before->want);
}

void last_pid_stop(struct last_pid *helper)
{
	if (!helper)
		return;
	__atomic_store_n(&helper->stop, 1, __ATOMIC_RELEASE);
	/* Another value, so that it can not fall asleep on the old one just now. */
	__atomic_add_fetch(&helper->slot->want, 1, __ATOMIC_ACQ_REL);
	wake(&helper->slot->want);
	while (waitpid(helper->task, NULL, __WALL | __WNOTHREAD) < 0 && errno == EINTR)
		;
	close(helper->fd);
	free(helper);
}
