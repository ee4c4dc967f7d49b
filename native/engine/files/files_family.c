/* SPDX-License-Identifier: Apache-2.0
 *
 * The tables of descriptors of all processes of an app (files.h), and what is between
 * them: a pipe or socket pair whose ends different processes have is made again once, for
 * all of them, and what was in it is put back once.
 */
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <unistd.h>

#include "files.h"

/* ---- after a checkpoint ---------------------------------------------------------- */

/* What is of the same object as in the checkpoint before. */
static const struct file *find_before(const struct image *before, const struct file *f)
{
	const struct file *b = before && before->files ? files_find(before->files, f->fd) : NULL;

	return b && files_same_object(f, b) ? b : NULL;
}

static uint32_t list_held(struct files_held *held, const struct image *image,
			  const struct image *before)
{
	uint32_t count = 0;

	for (uint32_t i = 0; image->files && i < image->files->count; i++) {
		struct file *f = &image->files->file[i];

		if (f->shared != f->fd || f->outside)
			continue;
		if (held)
			held[count] = (struct files_held){ .file = f,
							   .before = find_before(before, f),
							   .pid = image->template };
		count++;
	}
	return count;
}

/* What has been closed since the freeze (a worker does that when its parent has died) cannot
 * be compared any more; as a rule it was shared in the checkpoint before. */
static void group_closed(struct files_held *held, uint32_t count)
{
	for (uint32_t i = 0; i < count; i++) {
		const struct file *before = held[i].before;

		if (!before || !before->family || held[i].first != held[i].file ||
		    !files_is_closed(&held[i]))
			continue;
		for (uint32_t k = 0; k < count && held[i].first == held[i].file; k++)
			if (k != i && held[k].before && held[k].before->family == before->family)
				held[i].first = held[k].first;
	}
}

static pid_t inside_of(const struct image *image, uint32_t images, pid_t pid)
{
	for (uint32_t i = 0; i < images; i++)
		if (image[i].pid == pid)
			return image[i].inside;
	return 0;
}

/* Pidfds and owners: what the process itself is called is known already (files.c). */
static void name_others(const struct image *image, uint32_t images, struct files *files)
{
	for (uint32_t i = 0; files && i < files->count; i++) {
		struct file *f = &files->file[i];

		if (f->kind == FILE_PIDFD && !f->pid_inside)
			f->pid_inside = inside_of(image, images, f->pid);
		if (f->owner && !f->owner_inside && f->owner_type == F_OWNER_PID)
			f->owner_inside = inside_of(image, images, f->owner);
	}
}

/* By the templates, which have the tables as the processes have them.  What a process has
 * put in a place since is found to be shared with nobody. */
void files_settle_family(struct image *image, uint32_t images, struct image *before,
			 uint32_t befores)
{
	struct files_held *held = NULL;
	uint32_t count;

	for (uint32_t i = 0; i < images; i++)
		name_others(image, images, image[i].files);
	for (int pass = 0; pass < 2; pass++) {
		count = 0;
		for (uint32_t i = 0; i < images; i++)
			if (image[i].process)
				count += list_held(held ? held + count : NULL, &image[i],
						   image_find(before, befores, image[i].process));
		if (!held)
			held = calloc(count + 1, sizeof *held);
		if (!held)
			return;
	}
	files_group(held, count);
	group_closed(held, count);
	for (uint32_t i = 0; i < count; i++)
		if (held[i].first != held[i].file)
			held[i].file->family = held[i].first->family = held[i].first;
	free(held);
}

/* ---- a restore -------------------------------------------------------------------- */

struct tables {
	struct files_work *work;
	uint32_t count;
};

static bool is_pair(const struct file *f)
{
	return f->kind == FILE_PIPE || (f->kind == FILE_SOCKET && f->socket && f->socket->peer);
}

static bool same_end(const struct file *a, const struct file *b)
{
	return a->kind == b->kind && a->ino == b->ino &&
	       (a->kind != FILE_PIPE || !((a->flags ^ b->flags) & O_ACCMODE));
}

static bool other_end(const struct file *a, const struct file *b)
{
	if (a->kind != b->kind)
		return false;
	if (a->kind == FILE_SOCKET)
		return b->ino == a->socket->peer;
	return a->ino == b->ino && (a->flags ^ b->flags) & O_ACCMODE;
}

/* Something like `like` that is there, of any process: its descriptor in *fd, ours. */
static bool find_end(const struct tables *tables, const struct file *like,
		     bool (*fits)(const struct file *a, const struct file *b), int *fd)
{
	for (uint32_t i = 0; i < tables->count; i++) {
		const struct files_work *work = &tables->work[i];

		for (uint32_t k = 0; k < work->want->count; k++) {
			const struct file *w = &work->want->file[k];

			if (w->kind != like->kind || !fits(like, w) ||
			    (work->lost[k] && work->local[files_leader(work->want, w)] < 0))
				continue;
			*fd = files_borrow_placed(work, w);
			if (*fd >= 0)
				return true;
		}
	}
	return false;
}

static int reopen(int fd, int flags)
{
	char path[40];
	int opened;

	snprintf(path, sizeof path, "/proc/thread-self/fd/%d", fd);
	/* With O_NONBLOCK, or it would wait for somebody at the other end. */
	opened = open(path, (flags & O_ACCMODE) | O_NONBLOCK | O_CLOEXEC);
	close(fd);
	return opened;
}

/* Whoever has the other end, and whether it came of what is still there. */
static const struct file *find_other(const struct tables *tables, const struct file *w,
				     bool *made_already)
{
	for (uint32_t i = 0; i < tables->count; i++)
		for (uint32_t k = 0; k < tables->work[i].want->count; k++) {
			const struct files_work *work = &tables->work[i];
			const struct file *other = &work->want->file[k];
			const uint32_t leader = files_leader(work->want, other);

			if (!other_end(w, other))
				continue;
			*made_already = work->local[leader] >= 0 && work->source[leader] < 0;
			return other;
		}
	return NULL;
}

/* To everybody who has had it.  An end that is still there belongs to a pair that is none
 * any more. */
static void give_end(const struct tables *tables, const struct file *w, int end)
{
	for (uint32_t i = 0; i < tables->count; i++) {
		struct files_work *work = &tables->work[i];

		for (uint32_t k = 0; k < work->want->count; k++) {
			const uint32_t leader = files_leader(work->want, &work->want->file[k]);

			if (!same_end(w, &work->want->file[k]))
				continue;
			work->lost[k] = true;
			if (leader != k)
				continue;
			work->source[k] = -1;
			close_fd(&work->local[k]);
			work->local[k] = fcntl(end, F_DUPFD_CLOEXEC, 0);
		}
	}
	close(end);
}

static bool same_family(const struct file *a, const struct file *b)
{
	return a->family && a->family == b->family;
}

/* What another process has still, or again, this one has as well. */
static void join_family(const struct tables *tables, struct files_work *work)
{
	for (uint32_t k = 0; k < work->want->count; k++) {
		const struct file *w = &work->want->file[k];
		int fd;

		if (work->lost[k] && w->family && work->local[k] < 0 &&
		    find_end(tables, w, same_family, &fd))
			work->local[k] = fd;
	}
}

static void join_lost(const struct tables *tables, struct files_work *work, const struct file *w)
{
	const uint32_t group = files_leader(work->want, w);
	const struct file *other;
	bool made_already;
	int fd, ends[2], writer;

	if (find_end(tables, w, same_end, &fd)) {
		work->local[group] = fd;
		return;
	}
	if (w->kind == FILE_PIPE && find_end(tables, w, other_end, &fd)) {
		work->local[group] = reopen(fd, w->flags);
		return;
	}
	other = find_other(tables, w, &made_already);
	if (!other || made_already || file_make_pair(w, other, ends))
		return;
	/* pipe(2): the first is the one to read from. */
	writer = w->kind == FILE_PIPE && (w->flags & O_ACCMODE) == O_WRONLY;
	give_end(tables, w, ends[writer]);
	give_end(tables, other, ends[!writer]);
}

static void join(const struct tables *tables)
{
	for (uint32_t i = 0; i < tables->count; i++) {
		struct files_work *work = &tables->work[i];

		join_family(tables, work);
		for (uint32_t k = 0; k < work->want->count; k++) {
			const struct file *w = &work->want->file[k];

			(void)budget_step();
			if (is_pair(w) && work->lost[k] &&
			    work->local[files_leader(work->want, w)] < 0)
				join_lost(tables, work, w);
		}
	}
}

/* Once, however many have an end that can be read. */
static bool is_first(const struct tables *tables, uint32_t table, const struct file *w)
{
	for (uint32_t i = 0; i <= table; i++)
		for (uint32_t k = 0; k < tables->work[i].want->count; k++)
			if (same_end(w, &tables->work[i].want->file[k]))
				return &tables->work[i].want->file[k] == w;
	return false;
}

static const struct file *content_of(const struct tables *tables, const struct file *w)
{
	for (uint32_t i = 0; i < tables->count; i++)
		for (uint32_t k = 0; k < tables->work[i].want->count; k++) {
			const struct file *f = &tables->work[i].want->file[k];

			if (same_end(w, f) && (f->content_bytes || f->content_lost))
				return f;
		}
	return w;
}

/* Whoever had the other end of this pipe had ended already, and left it what is in it. */
static bool has_ended(const struct tables *tables, const struct file *w)
{
	for (uint32_t i = 0; i < tables->count; i++)
		for (uint32_t k = 0; k < tables->work[i].want->count; k++)
			if (other_end(w, &tables->work[i].want->file[k]))
				return false;
	return w->ended || (tables->work[0].want->several && !w->outside);
}

static void put_contents(const struct tables *tables)
{
	for (uint32_t i = 0; i < tables->count; i++) {
		struct files_work *work = &tables->work[i];

		for (uint32_t k = 0; k < work->want->count; k++) {
			const struct file *w = &work->want->file[k], *content;
			int fd = -1, other_fd = -1, bytes = 0;
			bool found;

			(void)budget_step();
			if (!(is_pair(w) || (w->kind == FILE_PIPE && w->ended)) ||
			    (w->kind == FILE_PIPE && (w->flags & O_ACCMODE) == O_WRONLY) ||
			    !is_first(tables, i, w) || !find_end(tables, w, same_end, &fd))
				continue;
			content = content_of(tables, w);
			found = find_end(tables, w, other_end, &other_fd);
			if (!found && w->kind == FILE_PIPE && has_ended(tables, w)) {
				other_fd = fcntl(fd, F_DUPFD_CLOEXEC, 0);
				found = true;
			}
			if (found && (content->content_bytes || content->content_lost ||
				      (ioctl(fd, FIONREAD, &bytes) == 0 && bytes)))
				files_note(work, w, file_put_content(fd, other_fd, content));
			close_fd(&fd);
			close_fd(&other_fd);
		}
	}
}

int files_restore(struct image *image, uint32_t images, const struct avc_config *config, pid_t init,
		  struct avc_error *notes, struct avc_error *err)
{
	struct tables tables = { .work = calloc(images, sizeof *tables.work) };
	int result = -1;

	if (!tables.work)
		return fail_errno(err, 0, "restore descriptors", "calloc", "out of memory");
	for (uint32_t i = 0; i < images; i++) {
		const struct process *process = image[i].process;
		/* Of one that has ended before, nobody has the table. */
		const bool held = process && process->descendant;

		if (!process)
			continue;
		tables.work[tables.count++] = (struct files_work){
			.process = image[i].process,
			.image = &image[i],
			.config = config,
			.init = init,
			.table = held ? process->holder : image[i].template,
			.table_pidfd = held ? process->holder_pidfd : image[i].pidfd,
			.want = image[i].files,
			.notes = notes,
		};
		if (files_work_begin(&tables.work[tables.count - 1], err))
			goto out;
	}
	for (uint32_t i = 0; i < tables.count; i++)
		if (files_work_gather(&tables.work[i], err))
			goto out;
	if (tables.count > 1)
		join(&tables);
	for (uint32_t i = 0; i < tables.count; i++) {
		if (i)
			join_family(&tables, &tables.work[i]);
		if (files_work_place(&tables.work[i], err))
			goto out;
	}
	put_contents(&tables);
	for (uint32_t i = 0; i < tables.count; i++) {
		struct files_work *work = &tables.work[i];

		files_work_finish(work);
		if (work->process->descendant && files_work_table(work, &work->image->table, err))
			goto out;
	}
	result = 0;
out:
	for (uint32_t i = 0; i < tables.count; i++)
		files_work_end(&tables.work[i]);
	free(tables.work);
	return result;
}
