/* SPDX-License-Identifier: Apache-2.0
 *
 * What the restored process has to do itself to restore its descriptors (files.h), as a list of
 * calls in its slot: epoll and signalfd are bound to the process that registers, owners and POSIX
 * locks to its PID.
 */
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/sysmacros.h>
#include <unistd.h>

#include "files.h"

/* ---- what is opened anew -------------------------------------------------------------------- */

/* The process that a path below /proc names; 0: none. */
static pid_t named_in(const char *name)
{
	int pid, end = 0;

	if (!name || strncmp(name, "/proc/", 6) || sscanf(name, "/proc/%d%n", &pid, &end) != 1)
		return 0;
	return name[end] && name[end] != '/' ? 0 : pid;
}

/* The application may have mounted something else there, or see another /proc. */
static bool is_in_proc(const struct file *f, pid_t template)
{
	int fd = open_in_root_of(template, "/proc", O_NOFOLLOW);
	struct mounts mounts = { 0 };
	struct statx st;
	bool is;

	/* Nothing is asked that may not answer, nor mounted (autofs). */
	is = fd >= 0 && !strcmp(mount_type(&mounts, template, fd), "proc") &&
	     !statx(fd, "", AT_EMPTY_PATH, STATX_TYPE, &st) &&
	     makedev(st.stx_dev_major, st.stx_dev_minor) == f->dev;
	mounts_free(&mounts);
	close_fd(&fd);
	return is;
}

static bool is_there(const struct image *image, uint32_t images, pid_t inside)
{
	for (uint32_t i = 0; i < images; i++)
		if (image[i].process && image[i].inside == inside)
			return true;
	return false;
}

/* A process with seccomp filters of its own would have to be allowed openat(2) for that. */
void files_find_own(struct image *image, uint32_t images)
{
	for (uint32_t i = 0; i < images; i++) {
		struct files *files = image[i].files;

		for (uint32_t k = 0; files && !image[i].sandboxed && k < files->count; k++) {
			struct file *f = &files->file[k];
			const pid_t inside = named_in(f->name);

			if (inside > 0 && is_there(image, images, inside) &&
			    is_in_proc(f, image[i].template))
				f->pid_inside = inside;
		}
	}
}

/* ---- the list ------------------------------------------------------------------------------- */

static void list_lock(struct setup *setup, const struct file *w, const struct file_lock *lock,
		      short type)
{
	const struct flock l = {
		.l_type = type,
		.l_whence = SEEK_SET,
		.l_start = lock->start,
		.l_len = lock->end < 0 ? 0 : lock->end - lock->start + 1,
	};

	setup_add(setup, INJ_DESCRIPTORS, type == F_UNLCK ? "" : "fcntl(F_SETLK)",
		  type == F_UNLCK ? SYS_fcntl : INJ_LOCK, (uint64_t)w->fd, F_SETLK,
		  setup_data(setup, &l, sizeof l))
		->flags = INJ_MAY_FAIL;
}

static bool has_lock(const struct file *f, const struct file_lock *lock)
{
	(void)budget_step();
	for (uint32_t i = 0; i < f->lock_count; i++)
		if (!memcmp(&f->lock[i], lock, sizeof *lock))
			return true;
	return false;
}

/* POSIX locks belong to the table, so they outlive the app; but closing any descriptor of the file
 * drops them, and we may have.  And the process that took them is recorded as their owner. */
static void list_locks(struct setup *setup, const struct file *w, const struct file *n)
{
	for (uint32_t i = 0; n && i < n->lock_count; i++)
		if (n->lock[i].kind == LOCK_POSIX_ && !has_lock(w, &n->lock[i]))
			list_lock(setup, w, &n->lock[i], F_UNLCK);
	for (uint32_t i = 0; i < w->lock_count; i++)
		if (w->lock[i].kind == LOCK_POSIX_)
			list_lock(setup, w, &w->lock[i], w->lock[i].exclusive ? F_WRLCK : F_RDLCK);
}

/* A thread can be an owner, so all of them have to exist. */
static void list_owner(struct setup *setup, const struct file *w)
{
	struct f_owner_ex owner = { .type = (int)w->owner_type, .pid = w->owner_inside };

	setup_add(setup, INJ_OWNERS, "fcntl(F_SETOWN)", SYS_fcntl, (uint64_t)w->fd, F_SETOWN_EX,
		  setup_data(setup, &owner, sizeof owner))
		->flags = INJ_MAY_FAIL;
	setup_add(setup, INJ_OWNERS, "fcntl(F_SETSIG)", SYS_fcntl, (uint64_t)w->fd, F_SETSIG,
		  (uint64_t)w->owner_signal)
		->flags = INJ_MAY_FAIL;
	setup_add(setup, INJ_OWNERS, "fcntl(F_SETFL)", SYS_fcntl, (uint64_t)w->fd, F_SETFL,
		  (uint64_t)w->flags)
		->flags = INJ_MAY_FAIL;
}

static struct inj_setup *list_open(struct setup *setup, const struct file *w)
{
	if (w->kind == FILE_PIDFD)
		return setup_add(setup, INJ_OWNERS, "", SYS_pidfd_open, (uint64_t)w->pid_inside,
				 (uint64_t)w->flags & (O_NONBLOCK | O_EXCL));
	return setup_add(setup, INJ_OWNERS, "", SYS_openat, (uint64_t)AT_FDCWD,
			 setup_data(setup, w->name, strlen(w->name) + 1),
			 (uint64_t)w->flags | O_CLOEXEC);
}

/* What was open refers to a dead process. */
static void list_anew(struct setup *setup, const struct file *w)
{
	const uint64_t cloexec = w->cloexec ? O_CLOEXEC : 0;
	struct inj_setup *opens, *move;

	if (w->shared != w->fd) {
		setup_add(setup, INJ_OWNERS, "dup3", SYS_dup3, (uint64_t)w->shared, (uint64_t)w->fd,
			  cloexec)
			->flags = INJ_MAY_FAIL;
		return;
	}
	opens = list_open(setup, w);
	opens->flags = INJ_MAY_FAIL;
	move = setup_add(setup, INJ_OWNERS, "open", INJ_MOVE, (uint64_t)w->fd, 0, cloexec);
	move->flags = INJ_MAY_FAIL;
	if (!setup->full)
		opens->store = parasite_remote(setup->parasite, &move->call.arg[1]);
	if (w->offset > 0)
		setup_add(setup, INJ_OWNERS, "lseek", SYS_lseek, (uint64_t)w->fd,
			  (uint64_t)w->offset, SEEK_SET)
			->flags = INJ_MAY_FAIL;
}

static bool has_anew(const struct files *files)
{
	for (uint32_t i = 0; i < files->count; i++)
		if (files->file[i].pid_inside)
			return true;
	return false;
}

static bool needs_numbers(const struct files *want)
{
	return has_anew(want) || files_watch_closed(want);
}

void files_lift_limit(const struct files *want, pid_t pid)
{
	if (needs_numbers(want))
		process_attrs_lift_limit(pid, RLIMIT_NOFILE,
					 (uint64_t)want->file[want->count - 1].fd + 2);
}

/* Of the main process; the others put all of theirs back (process_attrs.c). */
static void list_limit(const struct files_work *work, struct setup *setup)
{
	uint64_t limit[LIMITS][2];

	if (proc_limits(work->image->template, limit) == 0)
		setup_add(setup, INJ_OWNERS, "", INJ_LIMIT, RLIMIT_NOFILE,
			  setup_data(setup, limit[RLIMIT_NOFILE], sizeof limit[RLIMIT_NOFILE]))
			->flags = INJ_MAY_FAIL;
}

/* Recreated and bound (files_make.c).  Clients see who called listen(2) (unix(7), SO_PEERCRED), so
 * the process must have its own credentials by then. */
static void list_listen(const struct files_work *work, struct setup *setup, const struct file *w,
			const struct file *n)
{
	const struct file_socket *s = w->socket;

	if (!n && s && s->domain == AF_UNIX && s->listening && (!w->family || w->family == w) &&
	    work->lost[files_index(work->want, w)])
		setup_add(setup, INJ_OWNERS, "listen", SYS_listen, (uint64_t)w->fd,
			  (uint64_t)s->backlog)
			->flags = INJ_MAY_FAIL;
}

/* The template has unmapped it (files_video.c).  A mapping that fails there would leave a hole
 * (mmap(2), MAP_FIXED), so it is made elsewhere first. */
static void list_area(struct setup *setup, const struct file_area *area)
{
	struct inj_setup *map, *move;

	map = setup_add(setup, INJ_DESCRIPTORS, "mmap", SYS_mmap, 0, area->bytes,
			(uint64_t)area->protection, MAP_SHARED, (uint64_t)area->fd);
	map->call.arg[5] = area->offset;
	map->flags = INJ_MAY_FAIL;
	move = setup_add(setup, INJ_DESCRIPTORS, "", SYS_mremap, 0, area->bytes, area->bytes,
			 MREMAP_MAYMOVE | MREMAP_FIXED, area->start);
	move->flags = INJ_MAY_FAIL;
	if (!setup->full)
		map->store = parasite_remote(setup->parasite, &move->call.arg[0]);
}

void files_list_calls(struct files_work *work)
{
	struct inj_slot *slot = parasite_slot(&work->process->parasite, work->image->slot);
	struct setup list, *setup = &list;

	*setup = (struct setup){
		.parasite = &work->process->parasite,
		.slot = slot,
		.memory = parasite_files(&work->process->parasite, work->image->slot),
		.tail[INJ_DESCRIPTORS] = &slot->setup[INJ_DESCRIPTORS],
		.tail[INJ_OWNERS] = &slot->setup[INJ_OWNERS],
	};
	slot->setup[INJ_DESCRIPTORS] = 0;
	slot->setup[INJ_OWNERS] = 0;
	for (uint32_t i = 0; i < work->want->areas; i++)
		list_area(setup, &work->want->area[i]);
	for (uint32_t i = 0; i < work->want->count; i++)
		if (work->want->file[i].pid_inside)
			list_anew(setup, &work->want->file[i]);
	if (!work->process->descendant && needs_numbers(work->want))
		list_limit(work, setup);
	/* Numbers are used temporarily, and closing a file drops its locks. */
	for (uint32_t i = 0; i < work->want->count; i++)
		if (work->want->file[i].kind == FILE_EPOLL &&
		    files_leader(work->want, &work->want->file[i]) == i)
			files_list_epoll(work, setup, &work->want->file[i], files_now_of(work, i));
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i], *n = files_now_of(work, i);

		if (files_leader(work->want, w) != i)
			continue;
		list_listen(work, setup, w, n);
		if (w->kind == FILE_REGULAR && (w->lock_count || (n && n->lock_count)))
			list_locks(setup, w, n);
		if (w->owner_inside)
			list_owner(setup, w);
	}
	if (setup->full && !work->problems++)
		fail(work->notes, AVC_UNSUPPORTED, 0, work->process->inside, "restore descriptors",
		     "",
		     "it has too many watches of epoll, locks and listening sockets: not all are as they were");
}

void files_check_calls(const struct parasite *parasite, uint32_t slot, pid_t inside,
		       struct avc_error *notes)
{
	const struct inj_setup *failed = setup_failed_stage(parasite, slot, INJ_DESCRIPTORS);

	if (!failed)
		failed = setup_failed_stage(parasite, slot, INJ_OWNERS);
	if (failed)
		fail(notes, AVC_KERNEL, (int)-failed->call.result, inside, "restore descriptors",
		     failed->name, "descriptor %d is not quite as it was",
		     (int)failed->call.arg[failed->call.nr == SYS_mmap ? 4 : 0]);
}
