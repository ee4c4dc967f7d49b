/* SPDX-License-Identifier: Apache-2.0
 *
 * Closing late.  A server that dies may have thousands of connections that it has not had at the
 * checkpoint.  All have to be closed, and the kernel takes 4 to 10 us for each.  So the holder of
 * the main process, which dies anyway when that runs again, takes them along: it gets a table of
 * its own before they are closed in the application's, and there closes at once what claims
 * something that the restored process, or others, may want: ports, names, locks, devices
 * (INJ_CLOSE_CLAIMS).  To look takes a microsecond.  Peers of the rest are told some milliseconds
 * later that it is closed.
 *
 * The holder never closes anything in the application's table: if it gets no CPU for long, that is
 * in use again by then.
 *
 * Other processes of the application get new tables.  Their holders close in the old ones what claims
 * something and what is in both, and the rest when the application runs again.
 */
#include <fcntl.h>
#include <linux/close_range.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "files.h"

/* With fewer it takes longer to ask the holder. */
#define LATE_LEAST 1000
#define LATE_MAX (1 << 20)
/* So many times as many numbers as there are descriptors are looked at. */
#define SPARSE 2
#define SAMPLES 16
#define ENDS_NS NS_PER_S

/* A socket that has to be made anew may need a port that a connection keeps. */
static bool makes_socket(const struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];

		if (w->kind == FILE_SOCKET && work->lost[i] &&
		    work->local[files_leader(work->want, w)] < 0)
			return true;
	}
	return false;
}

/* All but those that are `closed` already (NULL: none is), in ranges.  False: `more` calls would have no
 * room after them. */
static bool close_all(struct inj_call *call, const struct files *files, const bool *closed,
		      uint32_t more)
{
	uint32_t next;

	for (uint32_t i = 0; i < files->count; i = next) {
		next = i + 1;
		if (closed && closed[i])
			continue;
		while (next < files->count && !(closed && closed[next]) &&
		       files->file[next].fd == files->file[next - 1].fd + 1)
			next++;
		if (call->count == INJ_CALLS_MAX - more)
			return false;
		call_add(call, SYS_close_range, (uint64_t)files->file[i].fd,
			 (uint64_t)files->file[next - 1].fd);
	}
	return true;
}

/* Sockets and pipes take the time; to look at all the others is in vain. */
static bool are_mostly_sockets(pid_t pid, int64_t open)
{
	const int dir = proc_open(pid, "fd", O_RDONLY | O_DIRECTORY);
	int found = 0;

	for (int i = 0; dir >= 0 && i < SAMPLES; i++) {
		char number[16], link[16] = "";

		snprintf(number, sizeof number, "%d", (int)(open * (i + 1) / (SAMPLES + 1)));
		(void)!readlinkat(dir, number, link, sizeof link - 1);
		found += !strncmp(link, "socket:", 7) || !strncmp(link, "pipe:", 5);
	}
	if (dir >= 0)
		close(dir);
	return found > SAMPLES / 2;
}

/* Its own filters were asked for less. */
static bool may_ask(const struct process *process)
{
	struct proc_status status;

	return proc_status(process->holder, &status) == 0 &&
	       seccomp_is_containers(&status, process->plain_filters) && !seccomp_refuses_asking();
}

/* Has the holder begin with its calls. */
static int start(const struct process *process, struct inj_call *call)
{
	struct avc_error ignored = { 0 };

	return parasite_send(&process->parasite, process->holder, &process->holder_base, call,
			     &ignored) ||
			       parasite_start(process->holder, &ignored)
		       ? -1
		       : 0;
}

static int finish(const struct process *process, struct inj_call *call)
{
	struct avc_error ignored = { 0 };

	return parasite_finish(process->holder, call, &ignored);
}

/* Whatever it still has is closed with it. */
static void end(const struct process *process)
{
	syscall(SYS_pidfd_send_signal, process->holder_pidfd, SIGKILL, NULL, 0);
	(void)pidfd_await_end(process->holder_pidfd, ENDS_NS);
}

uint64_t files_looked_at(const struct files_work *work)
{
	const int64_t open = work->now->open;

	return open >= LATE_LEAST + (int64_t)work->now->count && open <= LATE_MAX &&
			       work->process->holder && !makes_socket(work) &&
			       are_mostly_sockets(work->table, open) && may_ask(work->process)
		       ? (uint64_t)(SPARSE * open)
		       : 0;
}

void files_take_late(const struct files_work *work)
{
	struct process *process = work->process;
	struct inj_call *call = &process->parasite.control->late;
	const uint64_t looked_at = files_looked_at(work);

	if (!looked_at)
		return;
	call_begin(call, INJ_AFTER_PARK);
	/* Filters that forbid unshare(2) allow this. */
	call_add(call, SYS_close_range, ~0u, ~0u, CLOSE_RANGE_UNSHARE);
	if (start(process, call) || finish(process, call)) {
		end(process);
		return;
	}
	if (call->call[0].result)
		return;
	call_begin(call, INJ_AFTER_PARK);
	/* What goes on is the application's alone, from now on. */
	if (close_all(call, work->now, work->closed, 2)) {
		call_add(call, INJ_CLOSE_CLAIMS, 0, looked_at - 1);
		call_add(call, SYS_close_range, looked_at, ~0u);
		process->late = start(process, call) == 0;
	}
	if (!process->late)
		end(process);
}

void files_await_late(const struct process *process)
{
	if (process->late && finish(process, &process->parasite.control->late))
		end(process);
}

bool files_start_closing(const struct process *process)
{
	struct inj_call *call = &process->parasite.control->holder;

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_close_range, 0, ~0u);
	return start(process, call) == 0;
}

bool files_start_closing_claims(const struct process *process, const struct files *had)
{
	struct inj_call *call = &process->parasite.control->holder;

	call_begin(call, INJ_AFTER_PARK);
	return close_all(call, had, NULL, 0) ? start(process, call) == 0
					     : files_start_closing(process);
}

void files_close_late(const struct process *process)
{
	if (files_start_closing(process) && finish(process, &process->parasite.control->holder))
		end(process);
}
