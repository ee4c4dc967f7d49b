/* SPDX-License-Identifier: Apache-2.0
 *
 * A perf event of one of the kernel's tracepoints on each thread of the app (perf_event_open(2)).
 * The app is not modified; threads that are created later inherit the event.  Enabled or not, it
 * makes each switch from or to one of the threads some 0.2 us longer.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/mount.h>
#include <linux/perf_event.h>
#include <stdlib.h>
#include <sys/ioctl.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "guard.h"

#define EVENTS_MAX 512 /* a descriptor each: beyond that, there are none */

/* The tracepoint's number; -1: this kernel has none, or denies access.  The file system is not
 * attached to any mount point. */
static int number_of(const char *tracepoint)
{
	const int fs = (int)syscall(SYS_fsopen, "tracefs", FSOPEN_CLOEXEC);
	int root = -1, id_fd = -1, id = -1;
	char text[16] = "";

	if (fs >= 0 && !syscall(SYS_fsconfig, fs, FSCONFIG_CMD_CREATE, NULL, NULL, 0))
		root = (int)syscall(SYS_fsmount, fs, FSMOUNT_CLOEXEC, 0);
	if (root >= 0)
		id_fd = openat(root, tracepoint, O_RDONLY | O_CLOEXEC);
	if (id_fd >= 0 && read(id_fd, text, sizeof text - 1) > 0)
		id = atoi(text);
	close_fd(&id_fd);
	close_fd(&root);
	if (fs >= 0)
		close(fs);
	return id > 0 ? id : -1;
}

void thread_events_learn(struct thread_events *events, const struct thread_event_kind *kind)
{
	if (!events->number)
		events->number = number_of(kind->tracepoint);
}

void thread_events_drop(struct thread_events *events)
{
	for (uint32_t i = 0; i < events->count; i++)
		close(events->event[i].fd);
	events->count = 0;
}

void thread_events_close(struct thread_events *events)
{
	thread_events_drop(events);
	free(events->event);
	events->event = NULL;
	events->number = -1;
}

static bool is_of(const struct thread_event *event, const struct process *process)
{
	return event->leader == process->leader && event->start == process->start;
}

static bool is_followed(const struct thread_events *events, const struct process *process)
{
	for (uint32_t i = 0; i < events->count; i++)
		if (is_of(&events->event[i], process))
			return true;
	return false;
}

static bool has_thread(const struct thread_events *events, pid_t tid)
{
	for (uint32_t i = 0; i < events->count; i++)
		if (events->event[i].tid == tid)
			return true;
	return false;
}

static int open_event(const struct thread_events *events, const struct thread_event_kind *kind,
		      pid_t tid)
{
	struct perf_event_attr what = {
		.type = PERF_TYPE_TRACEPOINT,
		.size = sizeof what,
		.config = (uint64_t)events->number,
		.sample_period = kind->signals,
		.wakeup_events = kind->signals,
		.disabled = 1,
		.inherit = 1,
		.inherit_thread = 1, /* not by templates, nor by what the app forks      */
	};
	const int fd = (int)syscall(SYS_perf_event_open, &what, tid, -1, -1, PERF_FLAG_FD_CLOEXEC);

	if (fd < 0)
		return -1;
	if ((kind->filter && ioctl(fd, PERF_EVENT_IOC_SET_FILTER, kind->filter)) ||
	    (kind->signals &&
	     (fcntl(fd, F_SETOWN, getpid()) || fcntl(fd, F_SETFL, O_ASYNC | O_NONBLOCK)))) {
		close(fd);
		return -1;
	}
	return fd;
}

struct follow {
	struct thread_events *events;
	const struct thread_event_kind *kind;
	const struct process *process;
	bool found;
};

static int follow_thread(pid_t tid, void *arg)
{
	struct follow *follow = arg;
	struct thread_events *events = follow->events;
	int fd;

	if (has_thread(events, tid))
		return 0;
	if (events->count == EVENTS_MAX)
		return -1;
	fd = open_event(events, follow->kind, tid);
	if (fd < 0)
		return errno == ESRCH ? 0 : -1; /* it has just ended */
	events->event[events->count++] = (struct thread_event){ .fd = fd,
								.tid = tid,
								.leader = follow->process->leader,
								.start = follow->process->start };
	follow->found = true;
	return 0;
}

/* Until a walk finds no new thread: one created by a thread without the event has none. */
static int follow(struct thread_events *events, const struct thread_event_kind *kind,
		  const struct process *process)
{
	struct follow look = { .events = events, .kind = kind, .process = process, .found = true };

	while (look.found) {
		look.found = false;
		if (proc_numbers(process->task_dirfd, follow_thread, &look) < 0)
			return proc_is_exiting(process->pid) ? 0 : -1;
	}
	return 0;
}

static bool is_there(const struct tree *tree, const struct thread_event *event)
{
	for (uint32_t i = 0; i < tree->processes; i++)
		if (tree->process[i]->pid && is_of(event, tree->process[i]))
			return true;
	return false;
}

static void forget_ended(struct thread_events *events, const struct tree *tree)
{
	uint32_t left = 0;

	for (uint32_t i = 0; i < events->count; i++) {
		if (is_there(tree, &events->event[i]))
			events->event[left++] = events->event[i];
		else
			close(events->event[i].fd);
	}
	events->count = left;
}

static void request(const struct thread_events *events, unsigned long what)
{
	for (uint32_t i = 0; i < events->count; i++)
		(void)ioctl(events->event[i].fd, what, 0);
}

bool thread_events_enable(struct thread_events *events, const struct thread_event_kind *kind,
			  const struct tree *tree)
{
	thread_events_learn(events, kind);
	if (events->number > 0 && !events->event)
		events->event = calloc(EVENTS_MAX, sizeof *events->event);
	if (!events->event) {
		thread_events_close(events);
		return false;
	}
	forget_ended(events, tree);
	for (uint32_t i = 0; i < tree->processes; i++) {
		const struct process *process = tree->process[i];

		if (process->pid && !is_followed(events, process) &&
		    follow(events, kind, process)) {
			thread_events_close(events);
			return false;
		}
	}
	request(events, PERF_EVENT_IOC_ENABLE);
	return true;
}

void thread_events_disable(const struct thread_events *events)
{
	request(events, PERF_EVENT_IOC_DISABLE);
}

bool thread_events_heard(struct thread_events *events)
{
	bool heard = false;

	for (uint32_t i = 0; i < events->count; i++) {
		struct thread_event *event = &events->event[i];
		uint64_t count;

		if (read(event->fd, &count, sizeof count) != sizeof count)
			continue;
		heard |= count != event->heard;
		event->heard = count;
	}
	return heard;
}
