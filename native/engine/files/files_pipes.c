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

#define AT_A_TIME 256
#define ANSWER_NS (200 * NS_PER_MS)

struct inquiry {
	struct aside aside; /* first */
	uint32_t count;
	struct {
		int fd, bytes;
		struct file *file;
	} pipe[AT_A_TIME];
};

/* An end of a pipe, in the table of this process. */
struct end {
	struct file *file;
	int pidfd;
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

/* All that have been collected; one that does not answer keeps -1.  Their descriptors are the job's
 * until it has come back. */
static void ask_gathered(struct inquiry *job)
{
	if (!aside_run(&job->aside, ANSWER_NS))
		return;
	for (uint32_t i = 0; i < job->count; i++) {
		job->pipe[i].file->pipe_bytes = job->pipe[i].bytes;
		job->pipe[i].file->ours = job->pipe[i].fd;
	}
	free(job);
}

static struct inquiry *inquiry_new(void)
{
	static int left_behind;
	struct inquiry *job = calloc(1, sizeof *job);

	if (job)
		job->aside = (struct aside){ ask, drop, &left_behind };
	return job;
}

static void gather(struct inquiry *job, const struct end *end)
{
	struct file *f = end->file;
	const int fd = f->ours > 0 ? f->ours : proc_borrow_fd(end->pidfd, f->fd);

	f->ours = 0;
	if (fd < 0)
		return;
	job->pipe[job->count].fd = fd;
	job->pipe[job->count++].file = f;
}

static bool is_same(const struct end *a, const struct end *b)
{
	return a->file->ino == b->file->ino && a->file->dev == b->file->dev;
}

static bool can_be_read(const struct file *f)
{
	return (f->flags & O_ACCMODE) != O_WRONLY;
}

/* Of one pipe, ends that can be read come first. */
static int by_pipe(const void *a, const void *b)
{
	const struct file *x = ((const struct end *)a)->file, *y = ((const struct end *)b)->file;

	if (x->ino != y->ino)
		return x->ino < y->ino ? -1 : 1;
	return can_be_read(y) - can_be_read(x);
}

/* Each pipe once, by one of its ends.  One that the app only writes to, such as a container's output,
 * is neither read now nor made again. */
static void ask_all(struct end *end, uint32_t count)
{
	struct inquiry *job = NULL;

	qsort(end, count, sizeof *end, by_pipe);
	for (uint32_t i = 0; i < count; i++) {
		if ((i && is_same(&end[i], &end[i - 1])) || !can_be_read(end[i].file))
			continue;
		if (!job)
			job = inquiry_new();
		if (!job)
			return;
		gather(job, &end[i]);
		if (job->count == AT_A_TIME) {
			ask_gathered(job);
			job = NULL;
		}
	}
	if (job)
		ask_gathered(job);
	for (uint32_t i = 1; i < count; i++)
		if (is_same(&end[i], &end[i - 1]))
			end[i].file->pipe_bytes = end[i - 1].file->pipe_bytes;
}

static bool is_measured(const struct file *f)
{
	return f->kind == FILE_PIPE && !f->outside;
}

/* Those that are not inherited; `end` may be NULL.  Returns how many. */
static uint32_t find_ends(struct image *image, uint32_t images, struct end *end)
{
	uint32_t count = 0;

	for (uint32_t i = 0; i < images; i++)
		for (uint32_t k = 0; files_are_read(&image[i]) && k < image[i].files->count; k++) {
			struct file *f = &image[i].files->file[k];

			if (!is_measured(f) || f->inherited)
				continue;
			f->pipe_bytes = -1;
			if (end)
				end[count] = (struct end){ f, image[i].process->pidfd };
			count++;
		}
	return count;
}

void files_measure_pipes(struct image *image, uint32_t images)
{
	const uint32_t count = find_ends(image, images, NULL);
	struct end *end = count ? calloc(count, sizeof *end) : NULL;

	if (end)
		ask_all(end, find_ends(image, images, end));
	free(end);
	/* Parents come before their children. */
	for (uint32_t i = 0; i < images; i++)
		for (uint32_t k = 0; files_are_read(&image[i]) && k < image[i].files->count; k++) {
			struct file *f = &image[i].files->file[k];

			if (is_measured(f) && f->inherited)
				f->pipe_bytes = f->inherited->pipe_bytes;
		}
}
