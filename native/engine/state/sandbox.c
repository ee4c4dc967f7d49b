/* SPDX-License-Identifier: Apache-2.0
 *
 * Restoring a process that has put itself under a seccomp filter: the calls that restore it would be
 * denied.  So it stays traced and is supervised (seccomp_supervise.c) until all is ready; its own
 * first call without us is rt_sigreturn(2).  The code and lists that it executes until then are in the
 * parasite, where the app could have written anything: it cannot make more calls than injected code
 * may.  That holds for one that has yet to install its filters (filters.c), too, and none of its
 * threads runs that is not under its own.
 */
#include <errno.h>
#include <sched.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/wait.h>
#include <unistd.h>

#include "parasite_blob.h"
#include "state.h"

#define LOOK_US 50
#define LOOKS_AT_ONCE 200
#define SANDBOX_OPTIONS ((long)(PTRACE_O_EXITKILL | PTRACE_O_TRACECLONE | PTRACE_O_TRACESYSGOOD))
#define END_NS NS_PER_S

struct sandbox {
	const struct image *image;
	pid_t pid, inside;
	uint32_t count;
	bool in_stop; /* of job control, when it was halted last */
	pid_t tid[THREADS_MAX];
};

struct sandbox *sandbox_begin(const struct image *image, pid_t child, struct avc_error *err)
{
	struct sandbox *sandbox = calloc(1, sizeof *sandbox);

	if (!sandbox || ptrace(PTRACE_SETOPTIONS, child, NULL, SANDBOX_OPTIONS) ||
	    ptrace(PTRACE_SYSCALL, child, NULL, 0L)) {
		fail_errno(err, child, "restore", "ptrace(SETOPTIONS)",
			   "the new process was killed");
		free(sandbox);
		return NULL;
	}
	sandbox->image = image;
	sandbox->pid = child;
	sandbox->inside = image->process->inside;
	sandbox->tid[sandbox->count++] = child;
	return sandbox;
}

static void at_call(const struct sandbox *sandbox, pid_t tid, long options)
{
	if (sandbox->image->installs)
		seccomp_at_call_only(tid, sandbox->inside, options);
	else
		seccomp_at_call(tid, sandbox->inside, options);
}

/* Takes one event of the new process or its threads; false: there is none. */
static bool pump(struct sandbox *sandbox, bool *ended)
{
	int status;
	const pid_t tid = waitpid(-1, &status, __WALL | __WNOTHREAD | WNOHANG);
	unsigned long born = 0;

	if (tid <= 0)
		return false;
	if (!WIFSTOPPED(status)) {
		*ended = *ended || tid == sandbox->pid;
		return true;
	}
	/* A thread with a wrong TID exits again, and is not found later. */
	if (status >> 16 == PTRACE_EVENT_CLONE &&
	    ptrace(PTRACE_GETEVENTMSG, tid, NULL, &born) == 0 && sandbox->count < THREADS_MAX)
		sandbox->tid[sandbox->count++] = (pid_t)born;
	if (WSTOPSIG(status) == (SIGTRAP | 0x80))
		at_call(sandbox, tid, SANDBOX_OPTIONS);
	ptrace(PTRACE_SYSCALL, tid, NULL, 0L);
	return true;
}

bool sandbox_wait(struct sandbox *sandbox, const uint32_t *state, uint64_t end)
{
	bool ended = false;

	/* It stops so often that sleeping would take most of the time. */
	for (int looks = 0; __atomic_load_n(state, __ATOMIC_ACQUIRE) == INJ_IDLE;) {
		if (ended || !tracee_has_time(end))
			return false;
		if (pump(sandbox, &ended))
			looks = 0;
		else if (looks++ < LOOKS_AT_ONCE)
			sched_yield();
		else
			usleep(LOOK_US);
	}
	return true;
}

void sandbox_end(struct sandbox *sandbox)
{
	const uint64_t end = tracee_deadline(END_NS);
	bool ended = false;

	tracee_signal(sandbox->pid, SIGKILL);
	/* The first thread is reported when all the others have been waited for. */
	while (!ended && tracee_has_time(end))
		if (!pump(sandbox, &ended))
			usleep(LOOK_US);
	free(sandbox);
}

static int thread_of(const struct image *image, pid_t tid)
{
	const struct parasite *parasite = &image->process->parasite;
	const pid_t inside = proc_inside(tid);

	for (uint32_t i = 0; i < image->threads && i < parasite->threads_max; i++)
		if (parasite_thread(parasite, image->slot, i)->tid == inside)
			return (int)i;
	return -1;
}

static bool is_over(const struct stop *stop)
{
	return stop->kind == STOP_EXIT || stop->kind == STOP_DYING || stop->kind == STOP_DEADLINE;
}

/* Lets it make the call that returns it to the app, and not one step more. */
static void bring_home(pid_t tid)
{
	for (int stops = 0; stops < 2;) {
		struct stop stop;

		if (ptrace(PTRACE_SYSCALL, tid, NULL, 0L))
			return;
		stop = tracee_wait(tid, 0);
		if (is_over(&stop))
			return;
		stops += stop.kind == STOP_SYSCALL;
	}
}

/* False: it has exited, or was killed. */
static bool halt(struct sandbox *sandbox, pid_t tid)
{
	if (ptrace(PTRACE_INTERRUPT, tid, NULL, NULL))
		return false;
	for (;;) {
		const struct stop stop = tracee_wait(tid, 0);

		if (stop.kind == STOP_TRAP || stop.kind == STOP_GROUP) {
			sandbox->in_stop = stop.kind == STOP_GROUP;
			return true;
		}
		if (is_over(&stop))
			return false;
		if (stop.kind == STOP_SYSCALL)
			at_call(sandbox, tid, SANDBOX_OPTIONS);
		/* Again after each stop, which clears it (tracee_await_while()), and before it goes
		 * on: the kernel would make it continue its wait by restart_syscall(2). */
		if (ptrace(PTRACE_INTERRUPT, tid, NULL, NULL))
			return false;
		ptrace(PTRACE_SYSCALL, tid, NULL, 0L);
	}
}

/* It is about to call exit(2), which its own filters may refuse, for ever, or kill the process for:
 * supervised until they have no say any more. */
static void see_off(const struct sandbox *sandbox, pid_t tid)
{
	while (ptrace(PTRACE_SYSCALL, tid, NULL, 0L) == 0) {
		const struct stop stop = tracee_wait(tid, 0);

		if (is_over(&stop))
			return;
		if (stop.event == PTRACE_EVENT_EXIT) {
			ptrace(PTRACE_DETACH, tid, NULL, 0L);
			return;
		}
		if (stop.kind == STOP_SYSCALL)
			at_call(sandbox, tid, SANDBOX_OPTIONS | PTRACE_O_TRACEEXIT);
	}
}

/* Each is stopped where it waits for `go`, and is to return from there.  One that is none of its
 * threads ends; so does a main thread that had ended, but when all is ready. */
static int halt_one(struct sandbox *sandbox, pid_t tid, uint32_t *halted, struct avc_error *err)
{
	const struct image *image = sandbox->image;
	const struct parasite *parasite = &image->process->parasite;
	struct arch_regs regs, now;
	const struct seal *seal;
	uint64_t frame = 0;
	int block;

	if (!halt(sandbox, tid) || arch_regs_get(tid, &now))
		return 0;
	seal = filters_seal_of(image, tid);
	block = seal ? thread_of(image, tid) : -1;
	if (block >= 0)
		frame = parasite_thread(parasite, image->slot, (uint32_t)block)->frame;
	if (seal && image->sandboxed && filters_check(seal, tid, err))
		return -1;
	if (frame)
		arch_call(&regs, &now, parasite->base + INJ_SIGRETURN_OFFSET, arch_sp(&now), frame);
	else
		arch_call(&regs, &now, parasite->base + INJ_END_OFFSET, arch_sp(&now), 0);
	*halted += frame != 0;
	(void)arch_regs_set(tid, &regs); /* fails if it was killed */
	if (!frame && tid != sandbox->pid)
		see_off(sandbox, tid);
	return 0;
}

int sandbox_halt(struct sandbox *sandbox, struct avc_error *err)
{
	uint32_t halted = 0;

	for (uint32_t i = 0; i < sandbox->count; i++)
		if (halt_one(sandbox, sandbox->tid[i], &halted, err))
			return -1;
	return halted == sandbox->image->seals ? 0
					       : fail(err, AVC_GONE, 0, sandbox->pid, "restore", "",
						      "the new process was killed");
}

void sandbox_go(struct sandbox *sandbox)
{
	const struct image *image = sandbox->image;
	const struct parasite *parasite = &image->process->parasite;
	struct inj_slot *slot = parasite_slot(parasite, image->slot);

	for (uint32_t i = 0; image->stop_signal && i < sandbox->count; i++)
		if (filters_seal_of(image, sandbox->tid[i]))
			bring_home(sandbox->tid[i]);
	/* One whose parent has heard of it is in that stop already (restore_tree.c), unless somebody has
	 * continued it since. */
	if (image->stop_signal && !(image->stop_heard && sandbox->in_stop))
		tracee_signal(sandbox->pid, image->stop_signal);
	slot->running = slot->threads;
	if (image->headless) { /* the others regard it as exited */
		see_off(sandbox, sandbox->pid);
		proc_await_end(sandbox->pid);
	}
	for (uint32_t i = 0; i < sandbox->count; i++)
		ptrace(PTRACE_DETACH, sandbox->tid[i], NULL, 0L);
	/* Its parent may check at once. */
	for (uint64_t end = now_ns() + END_NS; image->stop_signal && now_ns() < end;) {
		struct proc_stat stat;

		if (proc_stat(sandbox->pid, &stat) || stat.state == 'T')
			break;
		usleep(LOOK_US);
	}
	/* One that was killed meanwhile is still a tracee, until it is reaped. */
	for (bool ended = false; pump(sandbox, &ended);)
		;
	free(sandbox);
}
