/* SPDX-License-Identifier: Apache-2.0
 *
 * The next PID of another PID namespace.
 *
 * /proc/sys/kernel/ns_last_pid acts on the namespace of the task that writes it, so a task has to
 * be inside: avckpt-pid (lastpid/lastpid.c), for the duration of one restore, sharing nothing with
 * us. It is started ahead of time, outside, because that takes longer than its work.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/futex.h>
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include "lastpid.h"
#include "syscall.h"
#include "trace.h"

/* Its program, built by the Makefile. */
__asm__(".pushsection .rodata\n"
	"lastpid_program: .incbin \"avckpt-pid\"\n"
	"lastpid_program_end:\n"
	".popsection\n");
/* Hidden; otherwise aarch64's linker resolves both through one GOT entry. */
#define HIDDEN __attribute__((visibility("hidden")))
extern const uint8_t lastpid_program[] __asm__("lastpid_program") HIDDEN;
extern const uint8_t lastpid_program_end[] __asm__("lastpid_program_end") HIDDEN;

#ifndef MFD_EXEC
#define MFD_EXEC 0x10U /* since Linux 6.3 */
#endif
#define STACK_BYTES 16384
#define HIGH_FD 16 /* above those that it is given */
#define ENGINE_SPINS 100
#define SLICE_NS (20 * (long)NS_PER_MS)
#define END_NS NS_PER_S
#define KILL_NS (100 * NS_PER_MS)
#define STOP_NS (100 * NS_PER_MS)
#define LOCK_NS (300 * NS_PER_MS)
#define LOCK_URGENT_NS NS_PER_S
#define LOCK_STEP_US 50
#define LOCK_STEPS 20 /* of a checkpoint, which has time */

struct last_pid {
	pid_t task;
	int pidfd, socket;
	struct lastpid_page *page;
	struct inj_slot **slot;
	uint32_t count;
};

/* ---- who chooses, and who forks ------------------------------------------------------ */

int last_pid_lock_open(pid_t init)
{
	return proc_open(init, "ns/pid", O_RDONLY);
}

bool last_pid_lock(int fd, bool urgent)
{
	const uint64_t end = tracee_deadline(urgent ? LOCK_URGENT_NS : LOCK_NS);

	while (fd >= 0 && flock(fd, (urgent ? LOCK_EX : LOCK_SH) | LOCK_NB)) {
		if (!tracee_has_time(end))
			return false;
		usleep(urgent ? LOCK_STEP_US : LOCK_STEPS * LOCK_STEP_US);
	}
	return true;
}

void last_pid_unlock(int fd)
{
	if (fd >= 0)
		(void)flock(fd, LOCK_UN);
}

/* ---- its process ------------------------------------------------------------------- */

struct birth {
	int program_fd, fd[LASTPID_FDS];
	int error;
	uint8_t stack[STACK_BYTES] __attribute__((aligned(16)));
};

/* Runs in the new task, which shares our memory until it executes its program, while we wait. */
#if defined(__SANITIZE_ADDRESS__)
__attribute__((no_sanitize("address", "undefined")))
#endif
static int
become(void *arg)
{
	static const char *const nothing[] = { NULL };
	struct birth *birth = arg;
	long high[LASTPID_FDS], program;

	program = raw_syscall(SYS_fcntl, (uint64_t)birth->program_fd, F_DUPFD_CLOEXEC, HIGH_FD, 0,
			      0, 0);
	for (int i = 0; i < LASTPID_FDS; i++)
		high[i] = raw_syscall(SYS_fcntl, (uint64_t)birth->fd[i], F_DUPFD_CLOEXEC, HIGH_FD,
				      0, 0, 0);
	/* The kernel also says EINVAL where the limit is below. */
	birth->error = program < 0 ? EMFILE : 0;
	for (int i = 0; i < LASTPID_FDS; i++)
		if (high[i] < 0)
			birth->error = EMFILE;
	if (birth->error)
		return 1;
	for (int i = 0; i < LASTPID_FDS; i++)
		raw_syscall(SYS_dup3, (uint64_t)high[i], (uint64_t)i, 0, 0, 0, 0);
	raw_syscall(SYS_dup3, (uint64_t)program, LASTPID_FDS, O_CLOEXEC, 0, 0, 0);
	raw_syscall(SYS_close_range, LASTPID_FDS + 1, ~UINT32_C(0), 0, 0, 0, 0);
	birth->error = (int)-raw_syscall(SYS_execveat, LASTPID_FDS, (uint64_t) "",
					 (uint64_t)nothing, (uint64_t)nothing, AT_EMPTY_PATH, 0);
	return 1;
}

/* Sealed: it cannot be written even through /proc/PID/exe. -1 with errno. */
static int sealed_program(void)
{
	const size_t bytes = (size_t)(lastpid_program_end - lastpid_program);
	int fd = memfd_create("avckpt-pid", MFD_CLOEXEC | MFD_ALLOW_SEALING | MFD_EXEC);

	if (fd < 0 && errno == EINVAL)
		fd = memfd_create("avckpt-pid", MFD_CLOEXEC | MFD_ALLOW_SEALING);
	if (fd >= 0 &&
	    (write(fd, lastpid_program, bytes) != (ssize_t)bytes ||
	     fcntl(fd, F_ADD_SEALS, F_SEAL_WRITE | F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL)))
		close_fd(&fd);
	return fd;
}

/* It cannot be truncated under us. */
static int shared_page(struct lastpid_page **page)
{
	int fd = memfd_create("avckpt-pid", MFD_CLOEXEC | MFD_ALLOW_SEALING);
	void *map = MAP_FAILED;

	if (fd >= 0 && ftruncate(fd, ARCH_PAGE_BYTES) == 0 &&
	    fcntl(fd, F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL) == 0)
		map = mmap(NULL, ARCH_PAGE_BYTES, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
	if (map == MAP_FAILED)
		close_fd(&fd);
	else
		*page = map;
	return fd;
}

static void helper_free(struct last_pid *helper)
{
	if (helper->page)
		munmap(helper->page, ARCH_PAGE_BYTES);
	close_fd(&helper->pidfd);
	close_fd(&helper->socket);
	free(helper->slot);
	free(helper);
}

static void birth_free(struct birth *birth)
{
	close_fd(&birth->program_fd);
	close_fd(&birth->fd[LASTPID_SOCKET]);
	close_fd(&birth->fd[LASTPID_FILE]);
	close_fd(&birth->fd[LASTPID_PAGE]);
	free(birth);
}

static int give_birth(struct last_pid *helper, struct birth *birth, int init_pidfd,
		      struct avc_error *err)
{
	int ends[2];

	birth->fd[LASTPID_INIT] = init_pidfd;
	birth->fd[LASTPID_FILE] = open("/proc/sys/kernel/ns_last_pid", O_RDWR | O_CLOEXEC);
	if (birth->fd[LASTPID_FILE] < 0)
		return fail_errno(err, 0, "restore", "open(ns_last_pid)",
				  "needs CONFIG_CHECKPOINT_RESTORE and a writable /proc/sys");
	birth->program_fd = sealed_program();
	birth->fd[LASTPID_PAGE] = shared_page(&helper->page);
	if (birth->program_fd < 0 || birth->fd[LASTPID_PAGE] < 0)
		return fail_errno(err, 0, "restore", "memfd_create", "no memory for the helper");
	if (socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, ends))
		return fail_errno(err, 0, "restore", "socketpair", "no descriptors");
	helper->socket = ends[0];
	birth->fd[LASTPID_SOCKET] = ends[1];
	/* No exit signal: its exit concerns only us. */
	helper->task = clone(become, birth->stack + STACK_BYTES, CLONE_VM | CLONE_VFORK, birth);
	if (helper->task < 0) {
		helper->task = 0;
		return fail_errno(err, 0, "restore", "clone", "no helper for the next PID");
	}
	helper->pidfd = proc_pidfd_open(helper->task);
	if (birth->error || helper->pidfd < 0) {
		errno = birth->error ? birth->error : errno;
		return fail_errno(err, 0, "restore", "execveat", "no helper for the next PID");
	}
	return 0;
}

/* The process inside does not outlive the one outside: it has set PR_SET_PDEATHSIG, unless it was
 * taken over before it could.  Returns whether it was there. */
static bool kill_inside(const struct last_pid *helper)
{
	pid_t children[4];
	const int count = proc_children(helper->task, children, 4);
	bool found = false;

	for (int i = 0; i < count; i++) {
		int pidfd = proc_pidfd_open(children[i]);
		struct proc_stat stat;

		/* Still its child: the pidfd refers to it. */
		if (pidfd >= 0 && proc_stat(children[i], &stat) == 0 && stat.parent == helper->task)
			found |= syscall(SYS_pidfd_send_signal, pidfd, SIGKILL, NULL, 0) == 0;
		close_fd(&pidfd);
	}
	return found;
}

static void helper_end(struct last_pid *helper)
{
	struct pollfd ending = { .fd = helper->pidfd, .events = POLLIN };
	/* One that was serving and not stopped has written nothing, and the slots may be gone. */
	const bool unused = helper->slot && !helper->page->stop;

	if (helper->task && (unused || helper->pidfd < 0 || poll_for(&ending, 1, END_NS) != 1)) {
		/* It reaps the one inside, and exits.  Otherwise the machine's init would have to
		 * reap that: until then the container's init cannot exit (zap_pid_ns_processes()). */
		if (!kill_inside(helper) || poll_for(&ending, 1, KILL_NS) != 1)
			kill(helper->task, SIGKILL); /* our unreaped child: the PID is its own */
	}
	if (helper->task)
		while (waitpid(helper->task, NULL, __WALL | __WNOTHREAD) < 0 && errno == EINTR)
			;
	helper_free(helper);
}

static struct last_pid *helper_new(int init_pidfd, struct avc_error *err)
{
	struct last_pid *helper = calloc(1, sizeof *helper);
	struct birth *birth = NULL;
	int result = -1;

	if (helper && posix_memalign((void **)&birth, 64, sizeof *birth))
		birth = NULL;
	if (!birth) {
		free(helper);
		fail_memory(err, 0, "restore");
		return NULL;
	}
	memset(birth, 0, offsetof(struct birth, stack));
	helper->pidfd = helper->socket = birth->program_fd = -1;
	for (int i = 0; i < LASTPID_FDS; i++)
		birth->fd[i] = -1;
	result = give_birth(helper, birth, init_pidfd, err);
	birth_free(birth);
	if (result) {
		close_fd(&helper->socket); /* it exits, if it is there */
		helper_end(helper);
		return NULL;
	}
	return helper;
}

/* ---- one that waits ------------------------------------------------------------------ */

static struct last_pid *waiting; /* this process guards one container */

void last_pid_prepare(int init_pidfd)
{
	struct avc_error later = { 0 };

	if (!waiting)
		waiting = helper_new(init_pidfd, &later); /* last_pid_start() reports why not */
}

void last_pid_forget(void)
{
	if (!waiting)
		return;
	close_fd(&waiting->socket);
	helper_end(waiting);
	waiting = NULL;
}

/* ---- a restore ------------------------------------------------------------------------- */

static int send_slots(struct last_pid *helper, const struct last_pid_slot *slot, uint32_t count,
		      bool last)
{
	struct lastpid_message message = { .count = count, .go = last };
	union {
		char bytes[CMSG_SPACE(LASTPID_MESSAGE_SLOTS * sizeof(int))];
		struct cmsghdr align;
	} control = { { 0 } };
	struct iovec data = { &message, sizeof message };
	struct msghdr head = { .msg_iov = &data,
			       .msg_iovlen = 1,
			       .msg_control = &control,
			       .msg_controllen = CMSG_SPACE(count * sizeof(int)) };
	struct cmsghdr *rights = CMSG_FIRSTHDR(&head);

	rights->cmsg_level = SOL_SOCKET;
	rights->cmsg_type = SCM_RIGHTS;
	rights->cmsg_len = CMSG_LEN(count * sizeof(int));
	for (uint32_t i = 0; i < count; i++) {
		struct inj_slot *const at = parasite_slot(slot[i].parasite, slot[i].number);

		message.offset[i] = (uint64_t)((uint8_t *)at - slot[i].parasite->map) -
				    INJ_CODE_BYTES;
		memcpy(CMSG_DATA(rights) + i * sizeof(int), &slot[i].parasite->data_fd,
		       sizeof(int));
		at->want = at->have = 0;
		helper->slot[helper->count++] = at;
	}
	return sendmsg(helper->socket, &head, MSG_NOSIGNAL) == (ssize_t)sizeof message ? 0 : -1;
}

/* It needs a CPU as urgently as we do. */
static void lend_priority(const struct last_pid *helper)
{
	struct sched_param own;
	const int policy = sched_getscheduler(0);

	if (policy > SCHED_OTHER && sched_getparam(0, &own) == 0)
		(void)sched_setscheduler(helper->task, policy, &own);
}

struct last_pid *last_pid_start(int init_pidfd, const struct last_pid_slot *slot, uint32_t count,
				struct avc_error *err)
{
	struct last_pid *helper = waiting ? waiting : helper_new(init_pidfd, err);
	int result = 0;

	waiting = NULL;
	if (!helper)
		return NULL;
	helper->slot = calloc(count, sizeof(struct inj_slot *));
	if (!helper->slot)
		result = fail_memory(err, 0, "restore");
	lend_priority(helper);
	for (uint32_t i = 0; !result && i < count; i += LASTPID_MESSAGE_SLOTS) {
		const uint32_t left = count - i;
		const bool last = left <= LASTPID_MESSAGE_SLOTS;

		if (send_slots(helper, slot + i, last ? left : LASTPID_MESSAGE_SLOTS, last))
			result = fail_errno(err, 0, "restore", "sendmsg", "the helper has ended");
	}
	if (!result)
		return helper;
	close_fd(&helper->socket);
	helper_end(helper);
	return NULL;
}

bool last_pid_is_there(const struct last_pid *helper)
{
	return !pidfd_ended(helper->pidfd);
}

static struct inj_slot *served(const struct last_pid *helper)
{
	const uint32_t i = __atomic_load_n(&helper->page->serving, __ATOMIC_RELAXED);

	return helper->slot[i < helper->count ? i : 0];
}

/* Sleeps while *word == value, a slice at most. */
static void sleep_on(uint32_t *word, uint32_t value)
{
	const struct timespec slice = { .tv_nsec = SLICE_NS };

	syscall(SYS_futex, word, FUTEX_WAIT, value, &slice, NULL, 0);
}

static void wake(uint32_t *word)
{
	syscall(SYS_futex, word, FUTEX_WAKE, INT32_MAX, NULL, NULL, 0);
}

/* Waits until the helper has set *word as wanted; false: not until `end`, or it has exited. */
static bool await_word(const struct last_pid *helper, uint32_t *word, uint32_t wanted, uint64_t end)
{
	uint32_t value;

	for (uint32_t spins = 0; (value = __atomic_load_n(word, __ATOMIC_ACQUIRE)) != wanted;
	     spins++) {
		if (spins < ENGINE_SPINS) {
			cpu_relax();
			continue;
		}
		if (!tracee_has_time(end) || pidfd_ended(helper->pidfd))
			return false;
		sleep_on(word, value);
	}
	return true;
}

static uint32_t request(struct inj_slot *slot, pid_t value)
{
	uint32_t want;

	slot->last_pid = value;
	slot->once = slot->cpu = 0;
	want = __atomic_add_fetch(&slot->want, 1, __ATOMIC_ACQ_REL);
	wake(&slot->want);
	return want;
}

static int fail_silent(struct avc_error *err)
{
	return fail(err, AVC_KERNEL, ETIMEDOUT, 0, "restore", "write(ns_last_pid)",
		    "the helper does not answer (setns(2) into the container takes "
		    "CAP_SYS_ADMIN and CAP_SYS_CHROOT)");
}

static int fail_refused(const struct last_pid *helper, struct avc_error *err)
{
	const int32_t error = __atomic_load_n(&helper->page->error, __ATOMIC_RELAXED);

	return error ? fail(err, AVC_DENIED, error, 0, "restore", "write(ns_last_pid)",
			    "the next PID cannot be chosen (CAP_CHECKPOINT_RESTORE or CAP_SYS_ADMIN "
			    "is needed)")
		     : 0;
}

int last_pid_set(struct last_pid *helper, pid_t value, struct avc_error *err)
{
	struct inj_slot *slot = served(helper);
	const uint32_t want = request(slot, value);

	if (!await_word(helper, &slot->have, want, tracee_deadline(NS_PER_S)))
		return fail_silent(err);
	return fail_refused(helper, err);
}

/* It may be asleep on the word of the slot that it serves. When woken it has nothing to write. */
static void rouse(struct inj_slot *slot)
{
	(void)request(slot, 0);
}

const struct inj_syscall *last_pid_ask(const struct last_pid *helper,
				       const struct parasite *parasite, struct inj_call *call,
				       pid_t value)
{
	return call_add(call, INJ_LAST_PID, parasite_remote(parasite, served(helper)),
			(uint64_t)value);
}

int last_pid_answered(const struct last_pid *helper, const struct inj_syscall *asked,
		      struct avc_error *err)
{
	return asked->result ? fail_silent(err) : fail_refused(helper, err);
}

void last_pid_free(struct last_pid *helper)
{
	(void)request(served(helper), INJ_LAST_PID_FREE);
}

void last_pid_serve(struct last_pid *helper, struct inj_slot *slot)
{
	struct inj_slot *before = served(helper);

	for (uint32_t i = 0; i < helper->count; i++)
		if (helper->slot[i] == slot)
			__atomic_store_n(&helper->page->serving, i, __ATOMIC_RELEASE);
	if (before != slot)
		rouse(before);
}

void last_pid_stop(struct last_pid *helper)
{
	__atomic_store_n(&helper->page->stop, LASTPID_STOP, __ATOMIC_RELEASE);
	rouse(served(helper));
}

void last_pid_await_stop(struct last_pid *helper)
{
	(void)await_word(helper, &helper->page->stopped, 1, now_ns() + STOP_NS);
}

void last_pid_end(struct last_pid *helper)
{
	if (!helper)
		return;
	if (helper->page->stop) {
		__atomic_store_n(&helper->page->stop, LASTPID_GO, __ATOMIC_RELEASE);
		wake(&helper->page->stop);
	}
	helper_end(helper);
}
