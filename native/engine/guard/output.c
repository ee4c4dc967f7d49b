/* SPDX-License-Identifier: Apache-2.0
 *
 * Detects that the app sends: a perf event of the kernel's tracepoint sock:sock_send_length on each
 * of its threads (thread_events.c), which is enabled only while a checkpoint is wanted.
 *
 * An inherited event cannot have a ring buffer (perf_mmap()), and the data sent does not matter:
 * the event sends us SIGIO (O_ASYNC), which is blocked, so that at most one is pending, and read by
 * signalfd(2).
 */
#include <linux/perf_event.h>
#include <signal.h>
#include <sys/signalfd.h>
#include <unistd.h>

#include "guard.h"

static const struct thread_event_kind SENDS = {
	.tracepoint = "events/sock/sock_send_length/id",
	.signals = true,
};

void output_learn(struct output *output)
{
	thread_events_learn(&output->events, &SENDS);
}

static bool begin(struct output *output)
{
	sigset_t io;

	sigemptyset(&io);
	sigaddset(&io, SIGIO);
	if (sigprocmask(SIG_BLOCK, &io, NULL))
		return false;
	output->signal_fd = signalfd(-1, &io, SFD_CLOEXEC | SFD_NONBLOCK);
	return output->signal_fd >= 0;
}

void output_arm(struct output *output, const struct tree *tree)
{
	if (output->armed || (!output->begun && !begin(output)))
		return;
	output->begun = true;
	output->armed = thread_events_enable(&output->events, &SENDS, tree);
}

void output_disarm(struct output *output)
{
	struct signalfd_siginfo ignored;

	if (!output->armed)
		return;
	thread_events_disable(&output->events);
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
	thread_events_close(&output->events);
	output->armed = false;
	if (output->begun)
		close_fd(&output->signal_fd);
	output->begun = false;
}
