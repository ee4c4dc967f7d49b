/* SPDX-License-Identifier: Apache-2.0
 *
 * Runs inside the app, its templates and the processes restored from them:
 * no libc, no thread-local storage, no vector registers.
 */
#include "parasite.h"

#include <asm/stat.h>
#include <asm/unistd.h>
#include <linux/futex.h>
#include <linux/mman.h>
#include <linux/prctl.h>
#include <linux/sched.h>
#include <stdbool.h>
#include <stddef.h>

#include "syscall.h"

#define SYS0(nr) raw_syscall(nr, 0, 0, 0, 0, 0, 0)
#define SYS1(nr, a) raw_syscall(nr, (uint64_t)(a), 0, 0, 0, 0, 0)
#define SYS2(nr, a, b) raw_syscall(nr, (uint64_t)(a), (uint64_t)(b), 0, 0, 0, 0)
#define SYS3(nr, a, b, c) raw_syscall(nr, (uint64_t)(a), (uint64_t)(b), (uint64_t)(c), 0, 0, 0)
#define SYS4(nr, a, b, c, d) \
	raw_syscall(nr, (uint64_t)(a), (uint64_t)(b), (uint64_t)(c), (uint64_t)(d), 0, 0)

#define __WALL_ 0x40000000 /* <linux/wait.h> */
#define PAUSE_US 50
#define PAUSE_SHARE 16 /* it may end so much later than it could, as a part of it */
#define SPAWN_TRIES 4000
#define SPAWN_TRIES_AT_ONCE 8
#define SPAWN_PAUSE_US 100
#define EAGAIN_ 11
#define ETIMEDOUT_ 110

/* For the answer of the engine's helper, which is fast when it has a CPU. */
#define ASK_SPINS 2000
#define ASK_SLEEPS 500 /* as long as a step of a restore */
#define ASK_SLEEP_MS 10
#define ASK_ONCE_SLEEPS 100 /* as long as the engine waits for an answer of its own */
#define ASK_TRIES 4

struct inj_timespec {
	int64_t s, ns;
};

/* asm-generic/fcntl.h, which does not go with the compiler's. */
#define F_RDLCK_ 0
#define F_WRLCK_ 1
#define F_UNLCK_ 2
struct inj_flock {
	int16_t type, whence;
	int64_t start, bytes;
	int32_t pid;
};

static void futex_wake(uint32_t *word)
{
	SYS3(__NR_futex, word, FUTEX_WAKE, 0x7fffffff);
}

/* Waits while *word == value, `ms` at most (< 0: forever). Returns 0 or -errno. */
static long futex_wait(uint32_t *word, uint32_t value, int64_t ms)
{
	struct inj_timespec t = { ms / 1000, ms % 1000 * 1000000 };

	return SYS4(__NR_futex, word, FUTEX_WAIT, value, ms < 0 ? 0 : (uint64_t)&t);
}

/* Sleeps for a while (< 0: forever). By ppoll(2), because it has no restart block: a timed futex
 * wait or a nanosleep that the tracer interrupts would overwrite the one that the borrowed thread's
 * call still needs. */
static void park_us(int64_t us)
{
	struct inj_timespec t = { us / 1000000, us % 1000000 * 1000 };

	raw_syscall(__NR_ppoll, 0, 0, us < 0 ? 0 : (uint64_t)&t, 0, 8, 0);
}

static void park(int64_t ms)
{
	park_us(ms < 0 ? ms : ms * 1000);
}

static void pause_us(int64_t us)
{
	struct inj_timespec t = { 0, us * 1000 };

	SYS2(__NR_nanosleep, &t, 0);
}

/* Only new memory shows it: locked memory cannot be dropped, and is present at once unless it is
 * locked on fault. */
static long find_future_lock(void)
{
	const long at = raw_syscall(__NR_mmap, 0, 4096, PROT_READ | PROT_WRITE,
				    MAP_PRIVATE | MAP_ANONYMOUS, (uint64_t)-1, 0);
	uint8_t present = 0;
	long flags = 0;

	if (at < 0 && at > -4096)
		return at;
	if (SYS3(__NR_madvise, at, 4096, MADV_DONTNEED)) {
		SYS3(__NR_mincore, at, 4096, &present);
		flags = MCL_FUTURE | (present & 1 ? 0 : MCL_ONFAULT);
	}
	SYS2(__NR_munmap, at, 4096);
	return flags;
}

static long capability(uint64_t option, uint64_t ambient, uint64_t number)
{
	return option == PR_CAP_AMBIENT ? raw_syscall(__NR_prctl, option, ambient, number, 0, 0, 0)
					: SYS2(__NR_prctl, option, number);
}

/* Each call returns only one of them. */
static long find_caps(uint64_t option, const uint32_t *others)
{
	long set = 0, r;

	/* Ambient capabilities are inheritable, of which there are few. */
	if (option == PR_CAP_AMBIENT && !(others[2] | others[5]))
		return 0;
	for (uint64_t i = 0; i < 63; i++) {
		r = capability(option, PR_CAP_AMBIENT_IS_SET, i);
		if (r < 0)
			break; /* the kernel has no more */
		set |= r << i;
	}
	return set;
}

static long change_caps(uint64_t option, uint64_t set)
{
	for (uint64_t i = 0; i < 63; i++) {
		const long r = set >> i & 1 ? capability(option, PR_CAP_AMBIENT_RAISE, i) : 0;

		if (r < 0)
			return r;
	}
	return 0;
}

#define ENOTSOCK_ 88
#define EBADF_ 9
#define IPPROTO_TCP_ 6
#define TCP_INFO_ 11 /* its first byte is the state */
#define TCP_CLOSE_ 7
#define TCP_LISTEN_ 10
#define AF_UNIX_ 1
#define AF_INET_ 2
#define AF_INET6_ 10
#define S_IFMT_ 0170000
#define S_IFIFO_ 0010000
#define NO_NAME 2 /* bytes of a Unix socket's address without one */

struct inj_name {
	uint16_t family, port; /* port: not of a Unix socket */
	uint8_t rest[124];
	uint32_t bytes;
};

static bool ask_name(long nr, uint64_t fd, struct inj_name *name)
{
	name->bytes = offsetof(struct inj_name, bytes);
	return SYS3(nr, fd, name, &name->bytes) == 0;
}

static bool has_no_name(uint64_t fd)
{
	struct inj_name name;

	if (!ask_name(__NR_getsockname, fd, &name))
		return false;
	return name.family == AF_UNIX_
		       ? name.bytes <= NO_NAME
		       : (name.family == AF_INET_ || name.family == AF_INET6_) && name.port == 0;
}

/* An accepted one shows the name of the socket that accepted it; clients have none. */
static bool was_accepted(uint64_t fd)
{
	struct inj_name peer;

	return ask_name(__NR_getpeername, fd, &peer) && peer.family == AF_UNIX_ &&
	       peer.bytes <= NO_NAME;
}

/* A port, a name, a lock, a device: what others could miss while it is open, or have for themselves.  A
 * TCP connection keeps the port of its listening socket, or most often one that the kernel chose.
 * *nameless: what the one before was, and this may be. */
static bool claims(uint64_t fd, bool *nameless)
{
	struct stat stat;
	uint8_t state = 0;
	uint32_t bytes = sizeof state;
	long r;

	if (*nameless && has_no_name(fd))
		return false;
	*nameless = false;
	r = raw_syscall(__NR_getsockopt, fd, IPPROTO_TCP_, TCP_INFO_, (uint64_t)&state,
			(uint64_t)&bytes, 0);
	if (r == -EBADF_)
		return false;
	if (r == -ENOTSOCK_)
		return SYS2(__NR_fstat, fd, &stat) || (stat.st_mode & S_IFMT_) != S_IFIFO_;
	if (r == 0 && state != TCP_CLOSE_ && state != TCP_LISTEN_)
		return false;
	*nameless = has_no_name(fd);
	return !*nameless && !was_accepted(fd);
}

static void close_claims(uint64_t fd, uint64_t last)
{
	bool nameless = false;

	for (; fd <= last; fd++)
		if (claims(fd, &nameless))
			SYS1(__NR_close, fd);
}

static uint32_t request_last_pid(struct inj_slot *slot, int32_t value, uint32_t once)
{
	uint32_t want;

	slot->last_pid = value;
	slot->once = once;
	slot->cpu = current_cpu();
	want = __atomic_add_fetch(&slot->want, 1, __ATOMIC_ACQ_REL);
	futex_wake(&slot->want);
	return want;
}

/* Returns 0, -ETIMEDOUT, or -EAGAIN: it has slept, and others may have taken the number meanwhile. */
static long await_last_pid(struct inj_slot *slot, uint32_t want, uint32_t sleeps)
{
	uint32_t have;

	for (uint32_t tries = 0; (have = __atomic_load_n(&slot->have, __ATOMIC_ACQUIRE)) != want;
	     tries++) {
		if (tries < ASK_SPINS) {
			cpu_relax();
			continue;
		}
		if (tries >= ASK_SPINS + sleeps)
			return -ETIMEDOUT_;
		futex_wait(&slot->have, have, ASK_SLEEP_MS);
		if (__atomic_load_n(&slot->have, __ATOMIC_ACQUIRE) == want)
			return -EAGAIN_;
	}
	return 0;
}

/* Asks the engine's helper to set ns_last_pid, which the container may not. */
static long ask_last_pid(struct inj_slot *slot, int32_t value, uint32_t once)
{
	const uint32_t sleeps = once ? ASK_ONCE_SLEEPS : ASK_SLEEPS;
	long r = -EAGAIN_;

	for (int i = 0; r == -EAGAIN_ && i < ASK_TRIES; i++)
		r = await_last_pid(slot, request_last_pid(slot, value, once), sleeps);
	return r == -EAGAIN_ ? 0 : r;
}

static void make_list(struct inj_syscall *s, uint64_t count)
{
	for (; count; count--, s++)
		if (s->nr == INJ_CLOSE_CLAIMS)
			close_claims(s->arg[0], s->arg[1]);
		else
			s->result = raw_syscall(s->nr, s->arg[0], s->arg[1], s->arg[2], s->arg[3],
						s->arg[4], s->arg[5]);
}

/* A tracer can interrupt it: not ours, but the next one when ours has died.  So it sleeps as park()
 * does.  Without a tracer its filters may refuse that call, with any error.  False: no tracer has
 * ended it. */
static bool make_pause(struct inj_call *call)
{
	__atomic_store_n(&call->pause, INJ_PAUSED, __ATOMIC_RELEASE);
	futex_wake(&call->pause);
	for (uint64_t us = 0, step; us < call->park_ms * UINT64_C(1000); us += step) {
		if (__atomic_load_n(&call->pause, __ATOMIC_ACQUIRE) != INJ_PAUSED)
			return true;
		step = us / PAUSE_SHARE > PAUSE_US ? us / PAUSE_SHARE : PAUSE_US;
		park_us((int64_t)step);
	}
	return false;
}

__attribute__((section(".text.entry"))) void inj_run(uint64_t result, struct inj_call *call)
{
	bool alone = false;

	(void)result;
	for (uint32_t i = 0; i < call->count && i < INJ_CALLS_MAX; i++) {
		struct inj_syscall *s = &call->call[i];

		if (s->nr == INJ_LIST)
			make_list((struct inj_syscall *)s->arg[0], s->arg[1]);
		else if (s->nr == INJ_WAIT)
			s->result = i && s[-1].result > 0
					    ? raw_syscall(__NR_wait4, (uint64_t)s[-1].result, 0,
							  __WALL_, 0, 0, 0)
					    : 0;
		else if (s->nr == INJ_PAUSE)
			alone = !make_pause(call);
		else if (s->nr == INJ_FUTURE_LOCK)
			s->result = find_future_lock();
		else if (s->nr == INJ_LAST_PID)
			s->result = ask_last_pid((struct inj_slot *)s->arg[0], (int32_t)s->arg[1],
						 1);
		else if (s->nr == INJ_CAPS)
			s->result = find_caps(s->arg[0], (const uint32_t *)s->arg[1]);
		else if (s->nr == __NR_clone)
			s->result = inj_clone(s->arg[0], s->arg[1], s->arg[2], s->arg[3],
					      s->arg[4]);
		else
			make_list(s, 1);
	}
	__atomic_store_n(&call->done, 1, __ATOMIC_RELEASE);
	if (call->after == INJ_AFTER_HOME && !call->park_ms && !call->wills)
		inj_go_home(); /* nobody waits for it: parasite_cut_short() */
	futex_wake(&call->done);
	/* The tracer now stops this task and sends it back. If there is no tracer any more, a
	 * thread of the app returns by itself. */
	if (call->after == INJ_AFTER_HOME) {
		park(alone ? 0 : call->park_ms);
		make_list(call->will, call->wills < INJ_WILLS_MAX ? call->wills : INJ_WILLS_MAX);
		inj_go_home();
	}
	for (;;)
		park(-1);
}

static void leave(void)
{
	for (;;)
		SYS1(__NR_exit_group, 0);
}

static void say(struct inj_slot *slot, enum inj_state state)
{
	__atomic_store_n(&slot->state, state, __ATOMIC_RELEASE);
	futex_wake(&slot->state);
}

/* It asks for no more TIDs. */
static void say_spawned(struct inj_slot *slot)
{
	__atomic_store_n(&slot->spawned, 1, __ATOMIC_RELEASE);
	futex_wake(&slot->spawned);
}

/* The first failure wins; any thread may have one. */
static void fail(struct inj_slot *slot, enum inj_step at, int32_t tid, long error)
{
	uint32_t none = INJ_STEP_NONE;

	if (__atomic_compare_exchange_n(&slot->error_at, &none, at, 0, __ATOMIC_ACQ_REL,
					__ATOMIC_RELAXED)) {
		slot->error = (int32_t)-error;
		slot->error_tid = tid;
	}
	say(slot, INJ_FAILED);
	say_spawned(slot);
	leave();
}

static struct inj_thread *thread_of(struct inj_slot *slot, uint32_t i)
{
	return (struct inj_thread *)(slot->blocks + (uint64_t)i * slot->block_bytes);
}

#define PR_TIMER_CREATE_RESTORE_IDS_ 77 /* since Linux 6.15 */
#define TIMER_TRIES 100000
#define CLOCK_MONOTONIC_ 1
#define NS_PER_S INT64_C(1000000000)
#define WATCHDOG_NS (60 * NS_PER_S) /* hardly one is set for longer */

/* timer_create(2) with the id *id. On an older kernel the ids count up: those in between are
 * deleted. */
static long make_timer(uint64_t clock, uint64_t event, int32_t *id, int32_t wanted)
{
	long r = SYS2(__NR_prctl, PR_TIMER_CREATE_RESTORE_IDS_, 1);

	*id = wanted;
	if (r == 0) {
		r = SYS3(__NR_timer_create, clock, event, id);
		SYS2(__NR_prctl, PR_TIMER_CREATE_RESTORE_IDS_, 0);
		return r;
	}
	for (int i = 0; i < TIMER_TRIES; i++) {
		r = SYS3(__NR_timer_create, clock, event, id);
		if (r || *id == wanted)
			return r;
		SYS1(__NR_timer_delete, *id);
	}
	return -17; /* EEXIST */
}

/* At the last moment: the remaining time shrinks during the restore.
 *
 * Deadlines stay where they were, with one exception.  A timer that rings once, or whose signal ends
 * the program, and soon, may be a watchdog, which the program sets anew all the time.  With its old
 * deadline it would end a program that has gone back further than that before this could set it again,
 * so it has the time that it had at the checkpoint.  Late by what was lost is what any timer may be. */
static long set_timer(uint64_t nr, uint64_t timer, const struct inj_timer *was, uint64_t asked_ns,
		      bool ends)
{
	const int64_t unit = nr == __NR_setitimer ? 1000 : 1;
	const int64_t interval = was->interval[0] * NS_PER_S + was->interval[1] * unit;
	const int64_t had = was->left[0] * NS_PER_S + was->left[1] * unit;
	const int64_t least = had < WATCHDOG_NS ? had : WATCHDOG_NS;
	int64_t now[2], left = had;
	struct inj_timer is;
	long r = SYS2(__NR_clock_gettime, CLOCK_MONOTONIC_, now);

	if (r)
		return r;
	left -= now[0] * NS_PER_S + now[1] - (int64_t)asked_ns;
	if (left <= 0 && interval > 0)
		left = interval - -left % interval; /* in phase */
	if ((interval == 0 || ends) && left < least)
		left = least;
	if (left < unit)
		left = unit; /* at once; 0 would be never */
	is.interval[0] = was->interval[0];
	is.interval[1] = was->interval[1];
	is.left[0] = left / NS_PER_S;
	is.left[1] = left % NS_PER_S / unit;
	if (nr == __NR_setitimer)
		return SYS3(nr, timer, &is, 0);
	return SYS4(nr, timer, 0, &is, 0);
}

static long move_descriptor(uint64_t fd, int64_t opened, uint64_t cloexec)
{
	long r;

	if (opened < 0)
		return opened;
	r = SYS3(__NR_dup3, opened, fd, cloexec);
	SYS1(__NR_close, opened);
	return r;
}

static long put_limit(uint64_t which, const uint64_t *limit)
{
	const long r = SYS4(__NR_prlimit64, 0, which, limit, 0);
	uint64_t now[2]; /* soft, hard */

	if (r && SYS4(__NR_prlimit64, 0, which, 0, now) == 0) {
		now[0] = limit[0] < now[1] ? limit[0] : now[1];
		SYS4(__NR_prlimit64, 0, which, now, 0);
	}
	return r;
}

/* Briefly converted to the other kind, so that no waiting writer gets it. Where others hold a read
 * lock, too, it cannot be converted, and they keep writers out while it is released and taken
 * again. */
static long own_lock(uint64_t fd, uint64_t command, struct inj_flock *lock)
{
	const int16_t type = lock->type;

	lock->type = type == F_RDLCK_ ? F_WRLCK_ : F_RDLCK_;
	if (SYS3(__NR_fcntl, fd, command, lock)) {
		lock->type = F_UNLCK_;
		SYS3(__NR_fcntl, fd, command, lock);
	}
	lock->type = type;
	return SYS3(__NR_fcntl, fd, command, lock);
}

static long make_call(const struct inj_syscall *s)
{
	const uint64_t *arg = s->arg;

	if (s->nr == INJ_TIMER_CREATE)
		return make_timer(arg[0], arg[1], (int32_t *)arg[2], (int32_t)arg[3]);
	if (s->nr == INJ_TIMER_SET)
		return set_timer(arg[0], arg[1], (const struct inj_timer *)arg[2], arg[3], arg[4]);
	if (s->nr == INJ_LOCK)
		return own_lock(arg[0], arg[1], (struct inj_flock *)arg[2]);
	if (s->nr == INJ_MOVE)
		return move_descriptor(arg[0], (int64_t)arg[1], arg[2]);
	if (s->nr == INJ_CAPS_CHANGE)
		return change_caps(arg[0], arg[1]);
	if (s->nr == INJ_LIMIT)
		return put_limit(arg[0], (const uint64_t *)arg[1]);
	return raw_syscall(s->nr, arg[0], arg[1], arg[2], arg[3], arg[4], arg[5]);
}

/* Makes the calls of a list. */
static void run_setup(struct inj_slot *slot, int32_t tid, uint64_t list)
{
	while (list) {
		struct inj_setup *s = (struct inj_setup *)list;
		const long r = make_call(&s->call);

		s->call.result = r;
		if (s->store)
			*(int64_t *)s->store = r;
		if (r < 0 && r > -4096 && !(s->flags & INJ_MAY_FAIL)) {
			slot->error_setup = list;
			fail(slot, INJ_STEP_SETUP, tid, r);
		}
		list = s->next;
	}
}

/* What every thread has to do itself, before any of them runs. */
static void set_up(struct inj_slot *slot, struct inj_thread *t)
{
	long r;

	SYS1(__NR_set_tid_address, t->clear_tid);
	SYS2(__NR_prctl, PR_SET_NAME, t->name);
	if (t->robust_bytes) {
		r = SYS2(__NR_set_robust_list, t->robust_list, t->robust_bytes);
		if (r)
			fail(slot, INJ_STEP_ROBUST, t->tid, r);
	}
	/* A CPU that is gone is no reason not to run. */
	if (t->affinity_bytes)
		SYS3(__NR_sched_setaffinity, 0, t->affinity_bytes, t->affinity);
	if (t->rseq) {
		r = SYS4(__NR_rseq, t->rseq, t->rseq_bytes, 0, t->rseq_signature);
		if (r)
			fail(slot, INJ_STEP_RSEQ, t->tid, r);
	}
#ifdef __x86_64__
	if (t->other_base) {
		r = SYS2(__NR_arch_prctl, 0x1001 /* ARCH_SET_GS */, t->other_base);
		if (r)
			fail(slot, INJ_STEP_BASE, t->tid, r);
	}
#endif
	if (t->large_state)
		inj_make_room(t->large_state);
	run_setup(slot, t->tid, t->setup);
}

/* Per thread, not per process. */
__attribute__((section(".text.entry"))) void inj_end(void)
{
	for (;;)
		SYS1(__NR_exit, 0);
}

/* Waits for the engine's `go`. An engine that died never sends it: then init ends the container,
 * and this process must not linger. */
static void wait_for_go(struct inj_slot *slot, enum inj_go stage, const struct inj_thread *t)
{
	uint32_t go;

	while ((go = __atomic_load_n(&slot->go, __ATOMIC_ACQUIRE)) < stage) {
		if (futex_wait(&slot->go, go, INJ_GO_S * 1000) == -ETIMEDOUT_)
			leave();
	}
	/* Set with `go`. */
	if (t->pause_ms)
		futex_wait(&slot->go, go, t->pause_ms);
	__atomic_add_fetch(&slot->running, 1, __ATOMIC_ACQ_REL);
	if (__atomic_load_n(&slot->running, __ATOMIC_ACQUIRE) == slot->threads)
		futex_wake(&slot->running);
}

void inj_thread(struct inj_slot *slot, struct inj_thread *t)
{
	set_up(slot, t);
	if (__atomic_add_fetch(&slot->ready, 1, __ATOMIC_ACQ_REL) == slot->threads)
		futex_wake(&slot->ready);
	wait_for_go(slot, INJ_GO_ALL, t);
	inj_sigreturn(t->frame);
}

static void spawn(struct inj_slot *slot, struct inj_thread *t, int32_t *last)
{
	const uint64_t flags = CLONE_VM | CLONE_FS | CLONE_FILES | CLONE_SIGHAND | CLONE_THREAD |
			       CLONE_SYSVSEM | CLONE_SETTLS;
	long tid = 0;

	for (int i = 0; i < SPAWN_TRIES; i++) {
		/* Another process's fork took the number, or the dead app's thread still has it:
		 * the kernel lets its leader be reaped slightly before it frees the number
		 * (kernel/exit.c, release_task(), free_pids()), and the dying thread may be waiting
		 * for a CPU just then. */
		if (i >= SPAWN_TRIES_AT_ONCE || tid < 0)
			pause_us(SPAWN_PAUSE_US);
		if (*last + 1 != t->tid && (tid = ask_last_pid(slot, t->tid - 1, 0)))
			fail(slot, INJ_STEP_TID, t->tid, tid);
		tid = inj_spawn(flags, t->stack, t->tls, t, slot, t->tid);
		/* At the limit of tasks one that has gone astray, and has yet to get a CPU for its
		 * end, is one too many. */
		if (tid < 0 && !(tid == -EAGAIN_ && slot->astray))
			break;
		*last = (int32_t)tid;
		if (tid == t->tid)
			return;
		*last = -1;
		slot->astray = 1;
	}
	if (tid < 0)
		fail(slot, INJ_STEP_THREAD, t->tid, tid);
	fail(slot, INJ_STEP_TID, t->tid, -17 /* EEXIST */);
}

__attribute__((section(".text.entry"))) void inj_restore(struct inj_slot *slot)
{
	struct inj_thread *me = thread_of(slot, 0);
	int32_t last = -1;
	long r;

	if (slot->placed) {
		/* by the engine, because its children need them, too */
	} else if (slot->session_leader) {
		r = SYS0(__NR_setsid);
		if (r < 0)
			fail(slot, INJ_STEP_SESSION, me->tid, r);
	} else {
		r = SYS2(__NR_setpgid, 0, slot->group);
		if (r)
			fail(slot, INJ_STEP_GROUP, me->tid, r);
	}
	/* The terminal's foreground group is a reference to the dead leader's struct pid, not a
	 * number. SIGTTOU is blocked here, so this is allowed. A terminal that becomes controlling
	 * has the leader's group in the foreground; with several processes the engine sets it. */
	if (slot->tty_fd >= 0 && !(slot->session_leader && slot->placed)) {
		r = slot->session_leader
			    ? SYS3(__NR_ioctl, slot->tty_fd, 0x540e /* TIOCSCTTY */, 0)
			    : SYS3(__NR_ioctl, slot->tty_fd, 0x5410 /* TIOCSPGRP */, &slot->group);
		if (r)
			fail(slot, INJ_STEP_TTY, me->tid, r);
	}
	run_setup(slot, me->tid, slot->setup[INJ_DESCRIPTORS]);
	run_setup(slot, me->tid, slot->setup[INJ_BEFORE]);
	for (uint32_t i = 1; i < slot->threads; i++)
		spawn(slot, thread_of(slot, i), &last);
	if (slot->threads > 1)
		request_last_pid(slot, INJ_LAST_PID_FREE, 0);
	say_spawned(slot);
	set_up(slot, me);
	if (__atomic_add_fetch(&slot->ready, 1, __ATOMIC_ACQ_REL) != slot->threads) {
		uint32_t n;

		while ((n = __atomic_load_n(&slot->ready, __ATOMIC_ACQUIRE)) != slot->threads)
			futex_wait(&slot->ready, n, 1000);
	}
	run_setup(slot, me->tid, slot->setup[INJ_OWNERS]);
	run_setup(slot, me->tid, slot->setup[INJ_AFTER]);
	say(slot, INJ_READY);
	if (!me->frame) {
		wait_for_go(slot, INJ_GO_ENDED, me);
		inj_end();
	}
	wait_for_go(slot, INJ_GO_ALL, me);
	inj_sigreturn(me->frame);
}
