/* SPDX-License-Identifier: Apache-2.0
 *
 * Injects the parasite into the live app through its main thread.
 *
 * The parasite is memory that the guard makes (parasite.c), so that what the app does to its own
 * mapping affects only the app.  A stub (cave.c) in which the main thread clones a task (porter.c) is
 * all that is written to the app's own memory; it ends by loading the thread's own registers, so the
 * thread returns without us, and a porter without a guard exits by itself.
 */
#include <fcntl.h>
#include <sys/random.h>

#include "infect.h"

/* The main thread, stopped, with all that borrowing it needs read. */
static struct thread *stop_main(struct process *process, struct avc_error *err)
{
	struct thread *t = thread_find(process, process->pid);

	if (!t)
		t = thread_add(process, process->pid, err);
	if (!t || t->attached) {
		fail(err, AVC_DEADLINE, 0, process->pid, "stop", "",
		     "not back from an earlier attempt yet");
		return NULL;
	}
	t->seen = true;
	rewind_prepare(t);
	if (thread_stop(process, t, err) || thread_await(process, t, err) || thread_read(t, err)) {
		thread_release(process, t);
		return NULL;
	}
	return t;
}

/* The same, and all others stopped, too. */
static struct thread *stop_all(struct process *process, struct avc_error *err)
{
	struct thread *t;

	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].attached) {
			fail(err, AVC_DEADLINE, 0, process->threads[i].tid, "stop", "",
			     "not back from an earlier attempt yet");
			return NULL;
		}
	waits_prepare(process);
	if (process_stop(process, err))
		return NULL;
	t = thread_find(process, process->pid);
	if (!t || !t->stopped) {
		fail(err, AVC_GONE, 0, process->pid, "stop", "", "it has ended");
		return NULL;
	}
	return thread_read(t, err) ? NULL : t;
}

struct thread *infect_stop_all(struct process *process, timer_t timer, uint64_t deadline_ns,
			       struct avc_error *err)
{
	struct thread *thread;

	rt_priority_begin();
	tracee_deadline_set(timer, deadline_ns);
	thread = stop_all(process, err);
	if (!thread)
		process_go_on(process, timer);
	return thread;
}

static int check_task(struct process *process, const struct thread *t, struct avc_error *err)
{
	if (!arch_is_native(&t->regs))
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "infect", "",
			    "it is a 32-bit program");
	if (arch_is_delicate(t->tid))
		return fail(err, AVC_DEADLINE, 0, t->tid, "infect", "",
			    "it is in the middle of vector code");
	return 0;
}

/* Forgets what an earlier guard, or the program before an exec, has left of a parasite. */
static int begin_anew(struct process *process, struct avc_error *err)
{
	tracker_end(process);
	parasite_close(&process->parasite);
	process->parasite.inside = process->inside;
	memory_forget(process->memory);
	if (getrandom(&process->nonce, sizeof process->nonce, 0) < 0)
		return fail_errno(err, 0, "infect", "getrandom", "no random number");
	/* An exec since then has made another address space of it. */
	close_fd(&process->mem_fd);
	process->mem_fd = proc_open(process->pid, "mem", O_RDWR);
	return process->mem_fd >= 0
		       ? 0
		       : fail_errno(err, process->pid, "infect", "open(mem)", "it has ended");
}

/* It ends with the thread's own context.  -1: not written. */
static int write_stub(struct process *process, struct thread *thread, avc_remote cave,
		      size_t *bytes, struct avc_error *err)
{
	uint8_t stub[ARCH_STUB_BYTES];
	struct arch_regs home;

	thread_fix_rseq(process->mem_fd, thread);
	rewind_home(thread, &home);
	*bytes = arch_stub_build(stub, &home, thread->sigmask);
	if (arch_stub_read_xstate(thread->tid, stub))
		return fail_errno(err, thread->tid, "infect", "ptrace(GETREGSET)", "it has ended");
	return cave_write(process, cave, stub, *bytes, err);
}

/* For twice as many threads as there are: some more may begin. */
static uint32_t room_for_threads(const struct process *process)
{
	uint32_t room = 32;

	while (room < process->thread_count * 2)
		room *= 2;
	return room;
}

static int infect_thread(struct process *process, struct thread *thread, uint32_t slots,
			 struct avc_error *err)
{
	const uint32_t threads = room_for_threads(process);
	bool stub_is_free = true;
	avc_remote cave;
	size_t bytes;
	int result;

	if (begin_anew(process, err) || thread_check_dispatch(thread->tid, err) ||
	    check_task(process, thread, err) || seccomp_read(process, thread, err) ||
	    cave_find(process, arch_pc(&thread->regs), &cave, err) ||
	    write_stub(process, thread, cave, &bytes, err))
		return -1;
	result = porter_bring(process, thread, cave,
			      parasite_layout(&process->parasite, slots, threads), &stub_is_free,
			      err);
	if (!thread->stopped || (thread->borrowed && thread_give_back(thread, err)))
		stub_is_free = false;
	if (!stub_is_free || parasite_is_old(process, cave))
		cave_keep(process, cave);
	else if (cave_erase(process, cave, bytes)) /* no thread is in it any more */
		err->undo_failures++;
	if (result)
		parasite_close(&process->parasite);
	process->infected = !result;
	process->checkpoints = 0;
	return result;
}

/* While all of it is stopped. */
static int infect_at_rest(struct process *process, uint32_t slots, timer_t timer,
			  uint64_t deadline_ns, struct avc_error *err)
{
	struct thread *thread = infect_stop_all(process, timer, deadline_ns, err);
	int result;

	if (!thread)
		return -1;
	result = infect_thread(process, thread, slots, err);
	process_go_on(process, timer);
	return result;
}

int process_infect(struct process *process, uint32_t slots, timer_t timer, uint64_t deadline_ns,
		   struct avc_error *err)
{
	struct thread *thread = NULL;
	int result;

	/* Another thread may be waiting for children of any kind (__WALL).  Or install a filter for all
	 * that kills the one that makes our calls, which a guard with a filter could not suspend. */
	if ((process->descendant && !porter_can_be_thread()) || seccomp_is_confined())
		return infect_at_rest(process, slots, timer, deadline_ns, err);
	rt_priority_begin();
	tracee_deadline_set(timer, deadline_ns);
	if (process_check_dying(process, err) == 0)
		thread = stop_main(process, err);
	result = thread ? infect_thread(process, thread, slots, err) : -1;
	if (thread)
		thread_let_go(process, thread);
	tracee_deadline_clear(timer);
	rt_priority_end();
	return result;
}

int process_infect_stopped(struct process *process, uint32_t slots, struct avc_error *err)
{
	struct thread *thread = thread_find(process, process->pid);

	if (!thread || !thread->stopped)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "infect", "",
			    "its main thread has ended");
	if (thread_read(thread, err))
		return -1;
	return infect_thread(process, thread, slots, err);
}
