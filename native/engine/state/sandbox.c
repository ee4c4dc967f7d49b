/* SPDX-License-Identifier: Apache-2.0
 *
 * Restoring an app that has put itself under a seccomp filter, or into strict mode: the calls that
 * restore a process would be denied, or kill it.  So it stays traced and is supervised (seccomp.c)
 * until all is ready; its own first call without us is rt_sigreturn(2).  The code and lists that it
 * executes until then are in the parasite, where the app could have written anything: it cannot
 * make more calls than injected code may.
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
	pid_t pid, inside;
	uint32_t count;
	pid_t tid[THREADS_MAX];
};

struct sandbox *sandbox_begin(pid_t child, pid_t inside, struct avc_error *err)
{
	struct sandbox *sandbox = calloc(1, sizeof *sandbox);

	if (!sandbox || ptrace(PTRACE_SETOPTIONS, child, NULL, SANDBOX_OPTIONS) ||
	    ptrace(PTRACE_SYSCALL, child, NULL, 0L)) {
		fail_errno(err, child, "restore", "ptrace(SETOPTIONS)",
			   "the new process was killed");
		free(sandbox);
		return NULL;
	}
	sandbox->pid = child;
	sandbox->inside = inside;
	sandbox->tid[sandbox->count++] = child;
	return sandbox;
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
		seccomp_at_call(tid, sandbox->inside, SANDBOX_OPTIONS);
	ptrace(PTRACE_SYSCALL, tid, NULL, 0L);
	return true;
}

bool sandbox_wait(struct sandbox *sandbox, const uint32_t *state, uint64_t end)
{
	bool ended = false;

	/* It stops so often that sleeping would take most of the time. */
	for (int looks = 0; __atomic_load_n(state, __ATOMIC_ACQUIRE) == INJ_IDLE;) {
		if (ended || now_ns() > end)
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
	const uint64_t end = now_ns() + END_NS;
	bool ended = false;

	tracee_signal(sandbox->pid, SIGKILL);
	/* The first thread is reported when all the others have been waited for. */
	while (!ended && now_ns() < end)
		if (!pump(sandbox, &ended))
			usleep(LOOK_US);
	free(sandbox);
}

static int thread_of(const struct parasite *parasite, uint32_t slot, pid_t tid)
{
	const pid_t inside = proc_inside(tid);

	for (uint32_t i = 0;
	     i < parasite_slot(parasite, slot)->threads && i < parasite->threads_max; i++)
		if (parasite_thread(parasite, slot, i)->tid == inside)
			return (int)i;
	return -1;
}

/* Lets it make the call that returns it to the app, and not one step more. */
static void bring_home(pid_t tid)
{
	for (int stops = 0; stops < 2;) {
		struct stop stop;

		if (ptrace(PTRACE_SYSCALL, tid, NULL, 0L))
			return;
		stop = tracee_wait(tid, 0);
		if (stop.kind == STOP_EXIT || stop.kind == STOP_DYING || stop.kind == STOP_DEADLINE)
			return;
		stops += stop.kind == STOP_SYSCALL;
	}
}

/* Each is stopped where it waits for `go`, and returns from there. */
void sandbox_go(struct sandbox *sandbox, const struct parasite *parasite, uint32_t slot_number,
		int stop_signal)
{
	struct inj_slot *slot = parasite_slot(parasite, slot_number);
	struct avc_error ignored = { 0 };

	for (uint32_t i = 0; i < sandbox->count; i++) {
		const pid_t tid = sandbox->tid[i];
		struct arch_regs regs, now;
		uint64_t frame;
		int block;

		if (ptrace(PTRACE_INTERRUPT, tid, NULL, NULL) ||
		    seccomp_supervise(tid, sandbox->inside, SANDBOX_OPTIONS) ||
		    tracee_await(tid, NULL, &ignored) != STOP_TRAP || arch_regs_get(tid, &now))
			continue; /* it has exited, or was killed */
		seccomp_end_supervision(tid);
		block = thread_of(parasite, slot_number, tid);
		if (block < 0)
			continue;
		frame = parasite_thread(parasite, slot_number, (uint32_t)block)->frame;
		if (frame)
			arch_call(&regs, &now, parasite->base + INJ_SIGRETURN_OFFSET, arch_sp(&now),
				  frame);
		else
			arch_call(&regs, &now, parasite->base + INJ_END_OFFSET, arch_sp(&now), 0);
		(void)arch_regs_set(tid, &regs); /* fails if it was killed */
		if (frame && stop_signal)
			bring_home(tid);
	}
	if (stop_signal)
		tracee_signal(sandbox->pid, stop_signal);
	slot->running = slot->threads;
	for (uint32_t i = 0; i < sandbox->count; i++) {
		ptrace(PTRACE_DETACH, sandbox->tid[i], NULL, 0L);
		/* The others regard it as exited. */
		if (i == 0 && !parasite_thread(parasite, slot_number, 0)->frame)
			proc_await_end(sandbox->pid);
	}
	/* Its parent may check at once. */
	for (uint64_t end = now_ns() + END_NS; stop_signal && now_ns() < end;) {
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
