/* SPDX-License-Identifier: Apache-2.0
 *
 * The sizes of pipes (files.h).
 *
 * F_GETPIPE_SZ takes the pipe's lock, and a thread that waits in splice(2) for data to put into a
 * pipe holds it for as long as none arrives.  No thread of the app does so while it is stopped, but
 * one outside of it may.  So the call is made aside, and a pipe that does not answer is left alone:
 * any other operation takes the same lock.
 */
#include <fcntl.h>
#include <stdlib.h>
#include <unistd.h>

#include "files.h"

#define AT_A_TIME 64
#define ANSWER_NS (200 * NS_PER_MS)

struct inquiry {
	struct aside aside; /* first */
	uint32_t count;
	struct {
		int fd, bytes;
		struct file *file;
	} pipe[AT_A_TIME];
};

static void ask(struct aside *aside)
{
	struct inquiry *job = (struct inquiry *)aside;

	for (uint32_t i = 0; i < job->count && !aside_is_left_behind(); i++)
		job->pipe[i].bytes = fcntl(job->pipe[i].fd, F_GETPIPE_SZ);
}

static void drop(struct aside *aside)
{
	struct inquiry *job = (struct inquiry *)aside;

	for (uint32_t i = 0; i < job->count; i++)
		close(job->pipe[i].fd);
	free(job);
}

/* All that have been collected; one that does not answer keeps -1. */
static void ask_gathered(struct inquiry *job)
{
	if (!aside_run(&job->aside, ANSWER_NS))
		return;
	for (uint32_t i = 0; i < job->count; i++)
		job->pipe[i].file->pipe_bytes = job->pipe[i].bytes;
	drop(&job->aside);
}

static struct inquiry *inquiry_new(void)
{
	static int left_behind;
	struct inquiry *job = calloc(1, sizeof *job);

	if (job)
		job->aside = (struct aside){ ask, drop, &left_behind };
	return job;
}

void files_measure_pipes(struct files *files, int pidfd)
{
	struct inquiry *job = NULL;

	for (uint32_t i = 0; i < files->count; i++) {
		struct file *f = &files->file[i];
		int fd;

		if (f->kind != FILE_PIPE || f->outside)
			continue;
		f->pipe_bytes = -1;
		if (f->inherited) {
			f->pipe_bytes = f->inherited->pipe_bytes;
			continue;
		}
		if (!job)
			job = inquiry_new();
		fd = job ? proc_borrow_fd(pidfd, f->fd) : -1;
		if (fd < 0)
			continue;
		job->pipe[job->count].fd = fd;
		job->pipe[job->count++].file = f;
		if (job->count == AT_A_TIME) {
			ask_gathered(job);
			job = NULL;
		}
	}
	if (job)
		ask_gathered(job);
}
