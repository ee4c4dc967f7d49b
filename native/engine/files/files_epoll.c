/* SPDX-License-Identifier: Apache-2.0
 *
 * What an epoll set watches (files.h).
 *
 * The kernel identifies an entry by a number and an open file description, and keeps watching that
 * when the number is closed, as long as any process has the description open (epoll(7), Questions
 * and answers).  The number may belong to another file by then, which can be watched as well.  Only
 * kcmp(2) shows what such an entry refers to.
 */
#include <fcntl.h>
#include <linux/kcmp.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/syscall.h>
#include <sys/sysmacros.h>
#include <unistd.h>

#include "files.h"

/* Only kcmp(2) distinguishes anonymous inodes, and the kernel takes longer the more a set watches.
 * So in a large one it is only called where something is inconsistent. */
#define ANONYMOUS_ASKED 128

static bool is_of(const struct file_watch *watch, const struct file *f)
{
	/* linux/kdev_t.h: as the kernel has them.  Not reported before Linux 4.14. */
	return !watch->ino || (f->ino == watch->ino &&
			       ((uint64_t)major(f->dev) << 20 | minor(f->dev)) == watch->dev);
}

/* On an overlay stat(2) returns another number. */
static bool has_name(const struct file *f)
{
	return f->kind == FILE_FIFO || f->kind == FILE_DEVICE;
}

static bool is_same(const struct file_watch *a, const struct file_watch *b)
{
	return a->fd == b->fd && a->ino == b->ino && a->dev == b->dev;
}

static bool is_target(pid_t pid, int fd, int set, const struct file_watch *watch)
{
	struct kcmp_epoll_slot slot = { .efd = (uint32_t)set,
					.tfd = (uint32_t)watch->fd,
					.toff = watch->at };

	return syscall(SYS_kcmp, pid, pid, KCMP_EPOLL_TFD, fd, &slot) == 0;
}

static bool is_odd(const struct files *files, const struct file *set, uint32_t i)
{
	const struct file_watch *watch = &set->watch[i];
	const struct file *of = files_find(files, watch->fd);

	return !of || !is_of(watch, of) || watch->at ||
	       (i + 1 < set->watch_count && watch[1].fd == watch->fd) ||
	       (!(of->mode & S_IFMT) && set->watch_count <= ANONYMOUS_ASKED);
}

static int find_target(const struct files *files, pid_t pid, const struct file *set,
		       const struct file_watch *watch)
{
	if (is_target(pid, watch->fd, set->fd, watch))
		return watch->fd;
	for (uint32_t i = 0; i < files->count && budget_step(); i++) {
		const struct file *f = &files->file[i];

		if (f->shared == f->fd && (is_of(watch, f) || has_name(f)) &&
		    is_target(pid, f->fd, set->fd, watch))
			return f->fd;
	}
	return -1;
}

void files_find_closed(struct files *files, pid_t pid)
{
	for (uint32_t i = 0; i < files->count; i++) {
		struct file *set = &files->file[i];

		if (set->kind != FILE_EPOLL || set->shared != set->fd)
			continue;
		/* To find one that has the number of others takes the kernel as long as there are. */
		for (uint32_t k = 0; k < set->watch_count; k++)
			if (is_odd(files, set, k) && budget_step())
				set->watch[k].of = find_target(files, pid, set, &set->watch[k]);
	}
}

bool files_watch_closed(const struct files *files)
{
	for (uint32_t i = 0; i < files->count; i++)
		for (uint32_t k = 0; k < files->file[i].watch_count; k++)
			if (files->file[i].watch[k].of != files->file[i].watch[k].fd)
				return true;
	return false;
}

/* The first with this number. */
static uint32_t first_of(const struct file *set, int fd)
{
	return LOWER_BOUND(set->watch_count, i, set->watch[i].fd < fd);
}

const struct file_watch *files_find_watch(const struct file *now, const struct file_watch *watch)
{
	const struct file_watch *found = NULL;

	for (uint32_t i = now ? first_of(now, watch->fd) : 0;
	     now && i < now->watch_count && now->watch[i].fd == watch->fd; i++) {
		const struct file_watch *is = &now->watch[i];

		if (!is_same(is, watch))
			continue;
		if (is->data == watch->data)
			return is;
		found = is;
	}
	return found;
}

/* ---- what the restored process has to do ------------------------------------------- */

/* Whether it has to be registered again: an edge since the checkpoint is gone, and a signalfd is
 * bound to the process that registered it.  Where the process has both from the one that forks it, that
 * one does it: two at a time would remove and add in any order, and one of them finds it there (EEXIST). */
static bool renew(const struct files_work *work, const struct file *w, const struct file *n,
		  const struct file_watch *watch)
{
	const struct file *of = files_find(work->want, watch->of);
	const struct file_watch *is = files_find_watch(n, watch);

	if (work->kept[files_index(work->want, w)] && work->kept[files_index(work->want, of)])
		return false;
	return !is || is->events != watch->events || is->data != watch->data ||
	       work->lost[files_index(work->want, of)] || of->kind == FILE_SIGNALFD ||
	       of->kind == FILE_EPOLL || watch->events & (EPOLLET | EPOLLONESHOT);
}

/* `to` becomes a duplicate of `from`. */
static void list_dup(struct setup *setup, enum inj_stage stage, int from, int to, int flags)
{
	setup_add(setup, stage, "dup3", SYS_dup3, (uint64_t)from, (uint64_t)to, (uint64_t)flags);
}

static void list_close(struct setup *setup, enum inj_stage stage, int fd)
{
	setup_add(setup, stage, "close", SYS_close, (uint64_t)fd);
}

static void list_watch(struct setup *setup, enum inj_stage stage, const struct file *set,
		       const struct file_watch *watch)
{
	struct epoll_event event = { .events = watch->events };

	event.data.u64 = watch->data;
	setup_add(setup, stage, "", SYS_epoll_ctl, (uint64_t)set->fd, EPOLL_CTL_DEL,
		  (uint64_t)watch->fd)
		->flags = INJ_MAY_FAIL;
	setup_add(setup, stage, "epoll_ctl", SYS_epoll_ctl, (uint64_t)set->fd, EPOLL_CTL_ADD,
		  (uint64_t)watch->fd, setup_data(setup, &event, sizeof event))
		->flags = INJ_MAY_FAIL;
}

/* The watched file temporarily gets its old number. */
static void list_closed_watch(const struct files_work *work, struct setup *setup,
			      enum inj_stage stage, const struct file *set,
			      const struct file_watch *watch)
{
	const struct file *holds = files_find(work->want, watch->fd);
	const int aside = work->want->file[work->want->count - 1].fd + 1;

	if (holds)
		list_dup(setup, stage, holds->fd, aside, O_CLOEXEC);
	list_dup(setup, stage, watch->of, watch->fd, 0);
	list_watch(setup, stage, set, watch);
	if (holds)
		list_dup(setup, stage, aside, holds->fd, holds->cloexec ? O_CLOEXEC : 0);
	list_close(setup, stage, holds ? aside : watch->fd);
}

/* What it watches since the checkpoint has been removed (files_restore.c). */
void files_list_epoll(const struct files_work *work, struct setup *setup, const struct file *w,
		      const struct file *n)
{
	for (uint32_t i = 0; i < w->watch_count; i++) {
		const struct file_watch *watch = &w->watch[i];
		const struct file *of = files_find(work->want, watch->of);
		enum inj_stage stage;

		if (!of || !renew(work, w, n, watch))
			continue;
		stage = of->pid_inside ? INJ_OWNERS : INJ_DESCRIPTORS; /* when it is there */
		if (watch->of == watch->fd)
			list_watch(setup, stage, w, watch);
		else
			list_closed_watch(work, setup, stage, w, watch);
	}
}

/* ---- sets that are made again ------------------------------------------------------- */

/* What it watches since the checkpoint was removed.  What is still in it is watched under a closed
 * number, and cannot be reached any more (or is registered differently again). */
static bool is_spoilt(const struct files_work *work, const struct file *w, const struct file *n)
{
	struct file is = { .fd = n->fd, .kind = FILE_EPOLL };
	bool spoilt = false;

	if (!file_read_info(work->table, &is))
		return false;
	for (uint32_t i = 0; i < is.watch_count && !spoilt; i++)
		spoilt = !files_find_watch(w, &is.watch[i]);
	free(is.watch);
	return spoilt;
}

static bool has_more(const struct file *w, const struct file *n)
{
	for (uint32_t i = 0; i < n->watch_count; i++)
		if (!files_find_watch(w, &n->watch[i]))
			return true;
	return false;
}

int files_give_up_sets(struct files_work *work, struct avc_error *err)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];
		const struct file *n = w->kind == FILE_EPOLL && w->shared == w->fd
					       ? files_now_of(work, i)
					       : NULL;

		if (!n || !work->table || !has_more(w, n))
			continue;
		if (files_work_flush(work, err))
			return -1;
		if (!is_spoilt(work, w, n))
			continue;
		work->source[i] = -1;
		close_fd(&work->local[i]);
		for (uint32_t k = 0; k < work->want->count; k++)
			if (work->want->file[k].shared == w->fd)
				work->lost[k] = true;
	}
	return 0;
}
