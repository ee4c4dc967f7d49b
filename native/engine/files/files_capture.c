/* SPDX-License-Identifier: Apache-2.0
 *
 * The two looks of a checkpoint at the tables of an app, and what is found out after them.
 */
#include <fcntl.h>
#include <sched.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "files_look.h"

#define ROOM_SPARE 64

void files_find_own_pidfds(const struct process *process, struct files *files)
{
	for (uint32_t i = 0; i < files->count; i++) {
		struct file *f = &files->file[i];

		if (f->kind != FILE_PIDFD)
			continue;
		f->pid_inside = f->pid == process->leader ? process->inside : 0;
		for (uint32_t k = 0; !f->pid_inside && k < process->thread_count; k++)
			if (process->threads[k].tid == f->pid)
				f->pid_inside = process->threads[k].inside;
	}
}

void files_find_owners(const struct process *process, struct files *files)
{
	for (uint32_t i = 0; i < files->count; i++) {
		struct file *f = &files->file[i];

		if (!f->owner || f->owner_inside)
			continue;
		if (f->owner_type == F_OWNER_PGRP)
			f->owner_inside = proc_inside(f->owner);
		else if (f->owner == process->leader)
			f->owner_inside = process->inside;
		for (uint32_t k = 0; f->owner_type == F_OWNER_TID && k < process->thread_count; k++)
			if (process->threads[k].tid == f->owner)
				f->owner_inside = process->threads[k].inside;
		if (f->owner_inside < 0)
			f->owner_inside = 0;
	}
}

/* The read before the freeze, while the app may be using its descriptors. */
struct survey {
	struct aside aside;
	struct files *files, *last; /* last: of the last checkpoint, or NULL     */
	struct files_owner owner;
	int result;
	struct avc_error error;
};
#define SURVEY_NS (5 * NS_PER_S)
#define SURVEY_STOPPED_NS (200 * NS_PER_MS) /* of a process found in the freeze                 */

static void survey(struct aside *aside)
{
	struct survey *job = (struct survey *)aside;

	job->result = files_look(job->files, &job->owner, FILES_BEFORE, job->last, &job->error);
}

/* Only heirs that occur once: one that occurs twice could be moved and moved back unnoticed. */
static bool note_heirs(struct files *files)
{
	static uint64_t number;

	files->number = ++number;
	files->parent_number = files->parent ? files->parent->number : 0;
	files->own = malloc((files->count + 1) * sizeof *files->own);
	if (!files->own)
		return false;
	for (uint32_t i = 0; i < files->count; i++)
		files->file[i].heir = files->file[i].inherited;
	for (uint32_t i = 0; i < files->count; i++)
		if (files->file[i].shared != files->file[i].fd)
			files->file[i].heir = files_find(files, files->file[i].shared)->heir =
				false;
	for (uint32_t i = 0; i < files->count; i++)
		if (!files->file[i].heir)
			files->own[files->own_count++] = i;
	return true;
}

/* Not needed afterwards. */
static void forget_parent(struct files *files)
{
	files_free((struct files *)files->parent);
	files->parent = NULL;
	for (uint32_t i = 0; i < files->count; i++)
		files->file[i].inherited = NULL;
}

static void drop_survey(struct aside *aside)
{
	struct survey *job = (struct survey *)aside;

	if (job->files)
		forget_parent(job->files);
	files_free(job->files);
	files_free(job->last);
	free(job->owner.likely);
	close_fd(&job->owner.pidfd);
	free(job);
}

static struct files *look_before(struct process *process, const struct process *parent,
				 struct avc_error *err)
{
	static int left_behind;
	struct survey *job = calloc(1, sizeof *job);
	struct files *files = NULL;

	if (job)
		*job = (struct survey){
			.aside = { survey, drop_survey, &left_behind },
			.files = files_new(process->files_seen + ROOM_SPARE),
			.owner = { .pid = process->pid,
				   .pidfd = fcntl(process->pidfd, F_DUPFD_CLOEXEC, 3),
				   .init = process->init,
				   .reuses = !process->heirs_change && files_trusts_heirs(process) }
		};
	if (!job || !job->files || job->owner.pidfd < 0) {
		if (!job || !job->files)
			fail_memory(err, process->pid, "look at descriptors");
		else
			fail_errno(err, process->pid, "look at descriptors", "fcntl(DUPFD)",
				   "its pidfd cannot be duplicated");
		if (job)
			drop_survey(&job->aside);
		return NULL;
	}
	job->owner.likely = process->heirs_likely;
	job->owner.likely_count = process->heirs_count;
	process->heirs_likely = NULL;
	process->heirs_count = 0;
	if (process->files_before)
		job->last = files_share(process->files_before);
	if (parent && parent->files_before) {
		job->files->parent = files_share(parent->files_before);
		job->files->parent_pid = parent->pid;
	}
	if (!aside_run(&job->aside, rt_priority_is() ? SURVEY_STOPPED_NS : SURVEY_NS)) {
		fail(err, AVC_DEADLINE, 0, process->pid, "look at descriptors", "",
		     "one of its files does not answer");
		return NULL;
	}
	if (job->result) {
		*err = err->code ? *err : job->error;
	} else if (!note_heirs(job->files)) {
		fail_memory(err, process->pid, "look at descriptors");
	} else {
		files = job->files;
		job->files = NULL;
		forget_parent(files);
	}
	drop_survey(&job->aside);
	return files;
}

static void note_sockets(struct process *process, const struct files *files)
{
	process->socket_count = 0;
	for (uint32_t i = 0; i < files->count && process->socket_count < SOCKETS_MAX; i++)
		if (files->file[i].kind == FILE_SOCKET)
			process->sockets[process->socket_count++] = files->file[i].fd;
}

int files_prepare(struct process *process, const struct process *parent, struct avc_error *err)
{
	struct files *before, *image;

	files_free(process->files_image);
	process->files_image = NULL;
	if (process->shared & CLONE_FILES) {
		files_free(process->files_before);
		process->files_before = NULL;
		process->files_image = files_new(1); /* they are its parent's */
		return process->files_image ? 0
					    : fail_memory(err, process->pid, "look at descriptors");
	}
	before = look_before(process, parent, err);
	if (!before)
		return -1;
	files_free(process->files_before);
	process->files_before = before;
	process->files_seen = before->count;
	note_sockets(process, before);
	image = files_new(before->count + before->count / 4 + ROOM_SPARE);
	if (!image)
		return fail_memory(err, process->pid, "look at descriptors");
	/* Touched now: otherwise the first touch would fault while the app is stopped. (A compiler
	 * leaves out memset(3) after calloc(3).) */
	explicit_bzero(image->file, image->room * sizeof *image->file);
	image->with_tcp = process->tcp_moved;
	process->files_image = image;
	return 0;
}

/* All but the contents. */
static void look_frozen(struct image *image, const struct image *parent, bool several,
			uint32_t *ours)
{
	struct process *process = image->process;
	const struct files_owner owner = { .pid = process->pid,
					   .pidfd = process->pidfd,
					   .init = process->init };
	struct files *files = process->files_image;

	process->files_image = NULL;
	image->files = files;
	files->several = several;
	files->parent = parent ? parent->files : NULL;
	files->parent_pid = parent ? parent->process->pid : 0;
	files->ours = ours;
	files->process = process;
	if (image->shared & CLONE_FILES)
		return;
	if (parent && files_are_read(parent) && parent->process->files_before &&
	    !parent->files->varied)
		files_note_varied(parent->files, parent->process->files_before);
	if (files_look(files, &owner, FILES_FROZEN, process->files_before, &image->files_error))
		return;
	files_find_owners(process, files);
	files_find_own_pidfds(process, files);
}

/* Contents last: the sizes of all pipes are asked for at once. */
void files_capture(struct image *image, uint32_t images)
{
	struct scratch scratch = { -1, -1, 0 };
	uint32_t ours = 0;

	for (uint32_t i = 0; i < images; i++)
		/* An orphan shares most with the main process, if at all. */
		if (image[i].process)
			look_frozen(&image[i],
				    i ? &image[image[i].parent < 0 ? 0 : image[i].parent] : NULL,
				    images > 1, &ours);
	files_measure_pipes(image, images);
	for (uint32_t i = 0; i < images; i++)
		if (files_are_read(&image[i]))
			files_keep_contents(&image[i], &scratch);
	for (uint32_t i = 0; i < images; i++) {
		if (!image[i].process)
			continue;
		image[i].files->parent = NULL; /* may be gone before this one */
		image[i].files->ours = NULL;
		image[i].files->process = NULL;
	}
	scratch_close(&scratch);
}

/* flock(2) cannot be observed cheaply: a lock that exists after the freeze, but not before, may be
 * from either side of it, and is left alone at a restore. */
void files_settle(struct image *image)
{
	files_land();
	files_find_closed(image->files, image->template);
	for (uint32_t i = 0; i < image->files->count; i++) {
		struct file *f = &image->files->file[i];
		struct file now = { .fd = f->fd, .kind = FILE_REGULAR };

		if (f->inherited)
			f->lock_unsure = f->inherited->lock_unsure;
		if (f->inherited || f->kind != FILE_REGULAR || f->flags & O_PATH)
			continue;
		file_read_info(image->process->pid, &now);
		for (uint32_t k = 0; k < now.lock_count; k++)
			f->lock_unsure |= now.lock[k].kind == LOCK_FLOCK_;
		for (uint32_t k = 0; k < f->lock_count; k++)
			f->lock_unsure &= f->lock[k].kind != LOCK_FLOCK_;
		free(now.lock);
	}
}

void files_forget(struct process *process)
{
	files_free(process->files_before);
	files_free(process->files_image);
	process->files_before = NULL;
	process->files_image = NULL;
	free(process->heirs_likely);
	process->heirs_likely = NULL;
	process->heirs_count = 0;
}
