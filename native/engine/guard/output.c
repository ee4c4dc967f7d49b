/* SPDX-License-Identifier: Apache-2.0
 *
 * Detects that the app sends: a perf event of the kernel's tracepoint sock:sock_send_length on each
 * of its threads (perf_event_open(2)), which is enabled only while a checkpoint is wanted.  The app
 * is not modified; threads that are created later inherit the event.
 *
 * An inherited event cannot have a ring buffer (perf_mmap()), and the data sent does not matter:
 * the event sends us SIGIO (O_ASYNC), which is blocked, so that at most one is pending, and read by
 * signalfd(2).
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/mount.h>
#include <linux/perf_event.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/signalfd.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "guard.h"

#define TRACEPOINT "events/sock/sock_send_length/id"
#define EVENTS_MAX 512 /* a descriptor each: beyond that, only quiescence is used */

/* The tracepoint's number; -1: this kernel has none, or denies access.  The file system is not
 * attached to any mount point. */
static int tracepoint(void)
{
	const int fs = (int)syscall(SYS_fsopen, "tracefs", FSOPEN_CLOEXEC);
	int root = -1, id_fd = -1, id = -1;
	char text[16] = "";

	if (fs >= 0 && !syscall(SYS_fsconfig, fs, FSCONFIG_CMD_CREATE, NULL, NULL, 0))
		root = (int)syscall(SYS_fsmount, fs, FSMOUNT_CLOEXEC, 0);
	if (root >= 0)
		id_fd = openat(root, TRACEPOINT, O_RDONLY | O_CLOEXEC);
	if (id_fd >= 0 && read(id_fd, text, sizeof text - 1) > 0)
		id = atoi(text);
	close_fd(&id_fd);
	close_fd(&root);
	if (fs >= 0)
		close(fs);
	return id > 0 ? id : -1;
}

void output_learn(struct output *output)
{
	if (!output->known)
		output->known = tracepoint();
}

/* ---- its events ------------------------------------------------------------------- */

static void close_all(struct output *output)
{
	for (uint32_t i = 0; i < output->count; i++)
		close(output->event[i].fd);
	output->count = 0;
	output->armed = false;
}

/* From here on only the app's quiescence is used. */
static void go_deaf(struct output *output)
{
	close_all(output);
	output->tracepoint = -1;
}

static bool is_of(const struct output_event *event, const struct process *process)
{
	return event->leader == process->leader && event->start == process->start;
}

static bool is_followed(const struct output *output, const struct process *process)
{
	for (uint32_t i = 0; i < output->count; i++)
		if (is_of(&output->event[i], process))
			return true;
	return false;
}

static bool has_thread(const struct output *output, pid_t tid)
{
	for (uint32_t i = 0; i < output->count; i++)
		if (output->event[i].tid == tid)
			return true;
	return false;
}

static int open_event(const struct output *output, pid_t tid)
{
	struct perf_event_attr what = {
		.type = PERF_TYPE_TRACEPOINT,
		.size = sizeof what,
		.config = (uint64_t)output->tracepoint,
		.sample_period = 1,
		.wakeup_events = 1,
		.disabled = 1,
		.inherit = 1,
		.inherit_thread = 1, /* not by templates, nor by what the app forks      */
	};
	const int fd = (int)syscall(SYS_perf_event_open, &what, tid, -1, -1, PERF_FLAG_FD_CLOEXEC);

	if (fd < 0)
		return -1;
	if (fcntl(fd, F_SETOWN, getpid()) || fcntl(fd, F_SETFL, O_ASYNC | O_NONBLOCK)) {
		close(fd);
		return -1;
	}
	return fd;
}

struct follow {
	struct output *output;
	const struct process *process;
	bool found;
};

static int follow_thread(pid_t tid, void *arg)
{
	struct follow *follow = arg;
	struct output *output = follow->output;
	int fd;

	if (has_thread(output, tid))
		return 0;
	if (output->count == EVENTS_MAX)
		return -1;
	fd = open_event(output, tid);
	if (fd < 0)
		return errno == ESRCH ? 0 : -1; /* it has just ended */
	output->event[output->count++] = (struct output_event){ .fd = fd,
								.tid = tid,
								.leader = follow->process->leader,
								.start = follow->process->start };
	follow->found = true;
	return 0;
}

/* Until a walk finds no new thread: one created by a thread without the event has none. */
static int follow(struct output *output, const struct process *process)
{
	struct follow look = { .output = output, .process = process, .found = true };

	while (look.found) {
		look.found = false;
		if (proc_tasks(process->task_dirfd, follow_thread, &look) < 0)
			return proc_is_exiting(process->pid) ? 0 : -1;
	}
	return 0;
}

static bool is_there(const struct tree *tree, const struct output_event *event)
{
	for (uint32_t i = 0; i < tree->processes; i++)
		if (tree->process[i]->pid && is_of(event, tree->process[i]))
			return true;
	return false;
}

static void forget_ended(struct output *output, const struct tree *tree)
{
	uint32_t left = 0;

	for (uint32_t i = 0; i < output->count; i++) {
		if (is_there(tree, &output->event[i]))
			output->event[left++] = output->event[i];
		else
			close(output->event[i].fd);
	}
	output->count = left;
}

static void enable(const struct output *output, unsigned long request)
{
	for (uint32_t i = 0; i < output->count; i++)
		(void)ioctl(output->event[i].fd, request, 0);
}

/* ---- what the guard does with it ------------------------------------------------------- */

static bool begin(struct output *output)
{
	sigset_t io;

	sigemptyset(&io);
	sigaddset(&io, SIGIO);
	if (sigprocmask(SIG_BLOCK, &io, NULL))
		return false;
	output->signal_fd = signalfd(-1, &io, SFD_CLOEXEC | SFD_NONBLOCK);
	output->event = calloc(EVENTS_MAX, sizeof *output->event);
	return output->signal_fd >= 0 && output->event;
}

void output_arm(struct output *output, const struct tree *tree)
{
	if (!output->tracepoint) {
		output_learn(output);
		output->tracepoint = output->known;
		if (output->tracepoint > 0 && !begin(output))
			output->tracepoint = -1;
	}
	if (output->tracepoint < 0 || output->armed)
		return;
	forget_ended(output, tree);
	for (uint32_t i = 0; i < tree->processes; i++) {
		const struct process *process = tree->process[i];

		if (process->pid && !is_followed(output, process) && follow(output, process)) {
			go_deaf(output);
			return;
		}
	}
	enable(output, PERF_EVENT_IOC_ENABLE);
	output->armed = true;
}

void output_disarm(struct output *output)
{
	struct signalfd_siginfo ignored;

	if (!output->armed)
		return;
	enable(output, PERF_EVENT_IOC_DISABLE);
	output->armed = false;
	while (read(output->signal_fd, &ignored, sizeof ignored) > 0)
		;
}

int output_fd(const struct output *output)
{
	return output->armed ? output->signal_fd : -1;
}

bool output_heard(struct output *output)
{
	struct signalfd_siginfo news;

	if (!output->armed || read(output->signal_fd, &news, sizeof news) != sizeof news)
		return false;
	output_disarm(output);
	return true;
}

void output_end(struct output *output)
{
	if (output->tracepoint <= 0)
		return;
	close_all(output);
	close_fd(&output->signal_fd);
	free(output->event);
	output->event = NULL;
	output->tracepoint = -1;
}
