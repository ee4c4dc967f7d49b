/* SPDX-License-Identifier: Apache-2.0
 *
 * Tracks which pages of a process are written: asynchronous write protection (userfaultfd(2),
 * UFFD_FEATURE_WP_ASYNC, Linux 6.7).  The kernel itself resolves the fault of the first write to a
 * page; PAGEMAP_SCAN reports those and protects them again in the same walk.
 *
 * The descriptor has to be created by a task with the process's memory.  The holder clones one for
 * that, which unshares the application's descriptor table first, so that it uses no number in it;
 * the guard takes the descriptor from it, and the task exits.  When the guard dies, the last
 * reference goes, and the kernel removes every mark.
 *
 * Protecting empty memory takes page tables, and programs reserve terabytes.  So only *parts* are
 * protected, of 2 MB each, which is the range of one page table: where the process, or a template
 * of it, has or had a page of its own.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/close_range.h>
#include <linux/userfaultfd.h>
#include <sched.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "process.h"

#ifndef UFFD_FEATURE_WP_UNPOPULATED
#define UFFD_FEATURE_WP_UNPOPULATED (1 << 13)
#endif
#ifndef UFFD_FEATURE_WP_ASYNC
#define UFFD_FEATURE_WP_ASYNC (1 << 15)
#endif
#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
#define MAKE_NS NS_PER_S
#define HAND_OVER_S 1 /* for so long a task waits for the watcher                */

/* ---- the descriptor ------------------------------------------------------------------------ */

/* A task of ours with the process's memory; *child is in its first stop. */
static int make_task(struct process *process, pid_t *child, struct arch_regs *base,
		     struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->holder;

	if (arch_regs_get(process->holder, base))
		return fail_errno(err, process->holder, "watch memory", "ptrace(GETREGS)",
				  "it was killed");
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_clone, CLONE_VM | CLONE_FILES | CLONE_PARENT | SIGCHLD);
	if (parasite_send(&process->parasite, process->holder, base, call, err))
		return -1;
	if (parasite_run_clone(process->holder, call, child, err)) {
		process->lost |= err->code != AVC_LIMIT;
		return -1;
	}
	if (tracee_await(*child, NULL, err) != STOP_TRAP)
		return -1;
	if (parasite_own(&process->parasite, *child))
		return fail_errno(err, *child, "watch memory", "ptrace(SETOPTIONS)",
				  "it was killed");
	return tracee_settle(process->holder, err);
}

/* -1, and it is closed: it is none. */
static int only_userfaultfd(int fd)
{
	char name[32] = "";

	if (fd >= 0 && (readlink(fd_path(fd).text, name, sizeof name - 1) <= 0 ||
			strcmp(name, "anon_inode:[userfaultfd]")))
		close_fd(&fd);
	return fd;
}

/* Number 0 of an unshared table. */
static int open_in(struct process *process, pid_t child, const struct arch_regs *base,
		   struct avc_error *err)
{
	struct inj_call *call = &process->parasite.control->runner;
	struct inj_syscall *made;
	int pidfd, fd;

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_close_range, 0, ~0u, CLOSE_RANGE_UNSHARE);
	made = call_add(call, SYS_userfaultfd, TRACKER_UFFD_FLAGS);
	if (parasite_send(&process->parasite, child, base, call, err))
		return -1;
	/* Containers' filters do not allow this call. */
	if (seccomp_supervise(child, SECCOMP_WATCHER, (long)TRACE_OPTIONS_OURS,
			      process->parasite.base, INJ_CODE_BYTES))
		return fail(err, AVC_DEADLINE, 0, child, "watch memory", "", "too many at once");
	if (parasite_run(child, call, err))
		return -1;
	if (made->result < 0) {
		errno = (int)-made->result;
		return is_shortage(errno) ? fail_errno(err, child, "watch memory", "userfaultfd",
						       "there is none left")
					  : fail(err, AVC_UNSUPPORTED, errno, child, "watch memory",
						 "userfaultfd", "the kernel does not allow it");
	}
	pidfd = proc_pidfd_open(child);
	fd = only_userfaultfd(pidfd < 0 ? -1 : proc_borrow_fd(pidfd, 0));
	close_fd(&pidfd);
	return fd >= 0 ? fd
		       : fail(err, AVC_DEADLINE, 0, child, "watch memory", "pidfd_getfd",
			      "no userfaultfd was made");
}

/* By the watcher.  Between two tracers, and without one if both die, it waits for a while in a table
 * of its own and exits.  The watcher turns that exit into the call, which has the same argument: so it
 * is never made under a filter that may kill for it. */
static int open_by_watcher(struct process *process, pid_t child, const struct arch_regs *base,
			   struct avc_error *err)
{
	const struct timespec patience = { .tv_sec = HAND_OVER_S };
	struct inj_call *call = &process->parasite.control->runner;
	int pidfd, fd = -1, errnum;

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_close_range, 0, ~0u, CLOSE_RANGE_UNSHARE);
	if (parasite_send(&process->parasite, child, base, call, err) ||
	    parasite_run(child, call, err))
		return -1;
	memcpy(call->out, &patience, sizeof patience);
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_ppoll, 0, 0, parasite_remote(&process->parasite, call->out));
	call_add(call, SYS_exit_group, TRACKER_UFFD_FLAGS);
	if (parasite_send(&process->parasite, child, base, call, err))
		return -1;
	errno = 0;
	pidfd = proc_pidfd_open(child);
	errnum = errno;
	if (pidfd >= 0 && ptrace(PTRACE_DETACH, child, NULL, NULL) == 0) {
		fd = only_userfaultfd(watcher_open(child, pidfd));
		errnum = errno;
		syscall(SYS_pidfd_send_signal, pidfd, SIGKILL, NULL, 0);
	}
	close_fd(&pidfd);
	if (fd >= 0)
		return fd;
	errno = errnum;
	return is_shortage(errno)
		       ? fail_errno(err, child, "watch memory", "pidfd_open", "it was killed")
		       : fail(err, AVC_UNSUPPORTED, 0, child, "watch memory", "userfaultfd",
			      "it was not made in time, or the kernel does not allow it");
}

static int open_uffd(struct process *process, struct avc_error *err)
{
	struct uffdio_api api = { .api = UFFD_API,
				  .features = UFFD_FEATURE_WP_ASYNC | UFFD_FEATURE_WP_UNPOPULATED };
	struct arch_regs base;
	pid_t child = 0;
	int fd = -1;

	if (make_task(process, &child, &base, err) == 0)
		fd = watcher_is_there() ? open_by_watcher(process, child, &base, err)
					: open_in(process, child, &base, err);
	if (child) {
		if (tracee_is_ours(child))
			tracee_kill(child);
		seccomp_end_supervision(child);
	}
	if (fd >= 0 && ioctl(fd, UFFDIO_API, &api)) {
		fail_errno(err, process->pid, "watch memory", "ioctl(UFFDIO_API)",
			   "the kernel cannot watch it (since Linux 6.7)");
		err->code = AVC_UNSUPPORTED;
		close_fd(&fd);
	}
	return fd;
}

int tracker_begin(struct process *process, timer_t timer, struct avc_error *err)
{
	static uint64_t number;
	struct tracker *tracker = calloc(1, sizeof *tracker);

	if (!tracker)
		return fail_memory(err, 0, "watch memory");
	tracker->number = ++number;
	tracker->scanned_ns = now_ns();
	tracker->pagemap = proc_open(process->pid, "pagemap", O_RDONLY);
	tracee_deadline_set(timer, MAKE_NS);
	tracker->uffd = open_uffd(process, err);
	tracee_deadline_clear(timer);
	process->tracker = tracker;
	if (tracker->uffd >= 0 && tracker->pagemap >= 0)
		return 0;
	if (tracker->uffd >= 0)
		fail_errno(err, process->pid, "watch memory", "open(pagemap)", "it has ended");
	tracker_end(process);
	return -1;
}

void tracker_end(struct process *process)
{
	struct tracker *tracker = process->tracker;

	process->tracker = NULL;
	if (!tracker)
		return;
	close_fd(&tracker->uffd);
	close_fd(&tracker->pagemap);
	pageset_free(&tracker->found);
	pageset_free(&tracker->of_files);
	free(tracker->area);
	free(tracker->file);
	free(tracker->part);
	free(tracker);
}

/* ---- what is watched ----------------------------------------------------------------------- */

struct watch {
	struct tracker *tracker;
	struct stretch refused; /* one that cannot be, or was gone just then             */
};

static bool add_file(struct tracker *tracker, avc_remote start, avc_remote end)
{
	if (!make_room(&tracker->file, tracker->files, &tracker->file_room, sizeof *tracker->file))
		return false;
	tracker->file[tracker->files++] = (struct stretch){ start, end };
	return true;
}

static bool add_area(struct tracker *tracker, avc_remote start, avc_remote end)
{
	if (tracker->areas && tracker->area[tracker->areas - 1].end == start) {
		tracker->area[tracker->areas - 1].end = end;
		return true;
	}
	if (!make_room(&tracker->area, tracker->areas, &tracker->area_room, sizeof *tracker->area))
		return false;
	tracker->area[tracker->areas++] = (struct stretch){ start, end };
	return true;
}

static bool is_private(const struct mapping *m)
{
	return !m->shared && m->start < ARCH_USER_END && !mapping_is_special(m);
}

/* A mapping that mremap(2) moves is no longer watched, nor is the whole mapping that it becomes a
 * part of there.  Old marks stay in the page table, even of pages that are written then: they are
 * removed, so that all of it counts as written.  What is watched is left alone: it may cease to be
 * at any moment, and that has to be noticed. */
static bool register_area(struct tracker *tracker, avc_remote start, avc_remote end)
{
	struct uffdio_register area = { .range = { start, end - start },
					.mode = UFFDIO_REGISTER_MODE_WP };
	struct uffdio_writeprotect none = { .range = { start, end - start } };

	if (pagemap_is_watched(tracker->pagemap, start))
		return true;
	if (ioctl(tracker->uffd, UFFDIO_REGISTER, &area))
		return false;
	tracker->broken |= ioctl(tracker->uffd, UFFDIO_WRITEPROTECT, &none) != 0;
	return true;
}

static int watch_mapping(const struct mapping *m, void *arg)
{
	struct watch *watch = arg;

	if (!is_private(m))
		return 0;
	if (!register_area(watch->tracker, m->start, m->end)) {
		watch->refused = (struct stretch){ m->start, m->end };
		return 0;
	}
	if (m->inode && !add_file(watch->tracker, m->start, m->end))
		return -1;
	return add_area(watch->tracker, m->start, m->end) ? 0 : -1;
}

/* Droppable memory is not watched, and is not in a template either (memory_areas.c). */
static int check_refused(const struct mapping *m, void *arg)
{
	const struct watch *watch = arg;

	if (!is_private(m) || m->flags & MAPPING_DROPPABLE || m->start != watch->refused.start ||
	    m->end != watch->refused.end)
		return 0;
	return register_area(watch->tracker, m->start, m->end) ? 0 : -1;
}

int tracker_watch(struct process *process, char *layout, struct avc_error *err)
{
	struct watch watch = { .tracker = process->tracker };
	FILE *text = fmemopen(layout, strlen(layout), "r");
	int result;

	process->tracker->areas = process->tracker->files = 0;
	result = text ? proc_parse_mappings(text, false, watch_mapping, &watch) : -1;
	if (text)
		fclose(text);
	if (result)
		return fail_memory(err, process->pid, "watch memory");
	errno = 0;
	if (watch.refused.end && proc_mappings(process->pid, "smaps", check_refused, &watch))
		return is_shortage(errno)
			       ? fail_errno(err, process->pid, "watch memory", "open(smaps)",
					    "it cannot be seen")
			       : fail(err, AVC_UNSUPPORTED, errno, process->pid, "watch memory",
				      "ioctl(UFFDIO_REGISTER)", "some of it cannot be watched");
	return 0;
}

/* ---- parts --------------------------------------------------------------------------------- */

/* The first that does not end before `address`. */
static uint32_t find_part(const struct tracker *tracker, avc_remote address)
{
	uint32_t low = 0, high = tracker->parts;

	while (low < high) {
		const uint32_t middle = low + (high - low) / 2;

		if (tracker->part[middle].end <= address)
			low = middle + 1;
		else
			high = middle;
	}
	return low;
}

/* None of it is in a part yet; adjacent ones are merged. */
static int add_part(avc_remote start, avc_remote end, void *arg)
{
	struct tracker *tracker = arg;
	uint32_t i;

	start &= ~(PAGESET_CHUNK - 1);
	end = (end + PAGESET_CHUNK - 1) & ~(PAGESET_CHUNK - 1);
	i = find_part(tracker, start);
	if (i < tracker->parts && tracker->part[i].start <= start)
		start = tracker->part[i].start;
	if (i && tracker->part[i - 1].end == start)
		start = tracker->part[--i].start;
	while (i < tracker->parts && tracker->part[i].start <= end) {
		if (tracker->part[i].end > end)
			end = tracker->part[i].end;
		tracker->parts--;
		memmove(&tracker->part[i], &tracker->part[i + 1],
			(tracker->parts - i) * sizeof *tracker->part);
	}
	if (!make_room(&tracker->part, tracker->parts, &tracker->part_room, sizeof *tracker->part))
		return -1;
	memmove(&tracker->part[i + 1], &tracker->part[i],
		(tracker->parts - i) * sizeof *tracker->part);
	tracker->part[i] = (struct stretch){ start, end };
	tracker->parts++;
	return 0;
}

/* Calls fn for the ranges of an area that are in parts, or are not. */
static int each(struct tracker *tracker, const struct stretch *area, bool in_parts,
		int (*fn)(struct tracker *tracker, avc_remote start, avc_remote end, int pagemap),
		int pagemap)
{
	avc_remote at = area->start;

	while (at < area->end) {
		const uint32_t i = find_part(tracker, at);
		const bool inside = i < tracker->parts && tracker->part[i].start <= at;
		avc_remote end = i == tracker->parts ? area->end
				 : inside            ? tracker->part[i].end
						     : tracker->part[i].start;

		if (end > area->end)
			end = area->end;
		if (inside == in_parts && fn(tracker, at, end, pagemap))
			return -1;
		at = end;
	}
	return 0;
}

static int look_for_pages(struct tracker *tracker, avc_remote start, avc_remote end, int pagemap)
{
	return pagemap_walk(pagemap, start, end, add_part, tracker);
}

static int find_parts(struct tracker *tracker, int pagemap)
{
	for (uint32_t i = 0; i < tracker->areas; i++)
		if (each(tracker, &tracker->area[i], false, look_for_pages, pagemap))
			return -1;
	return 0;
}

/* ---- private mappings of files ------------------------------------------------------------- */

/* Of what was found written; both are in order. */
static bool keep_found(struct tracker *tracker)
{
	struct page_cursor at = { 0 };
	avc_remote start, end;
	uint32_t i = 0;

	while (pageset_next(&tracker->found, &at, &start, &end)) {
		while (i < tracker->files && tracker->file[i].end <= start)
			i++;
		for (uint32_t k = i; k < tracker->files && tracker->file[k].start < end; k++) {
			const struct stretch *file = &tracker->file[k];

			if (!pageset_add(&tracker->of_files,
					 file->start > start ? file->start : start,
					 file->end < end ? file->end : end))
				return false;
		}
	}
	return true;
}

/* madvise(MADV_DONTNEED) gives back a page of its own but leaves the mark
 * (zap_install_uffd_wp_if_needed() in mm/memory.c): that does not count as written.  So the pages
 * that it had are looked up. */
static bool find_given_back(struct tracker *tracker)
{
	struct pageset had = tracker->of_files;
	uint64_t entry[PAGESET_PAGES];
	struct page_cursor at = { 0 };
	avc_remote start, end;
	bool done = true;

	tracker->of_files = (struct pageset){ 0 };
	while (done && pageset_next(&had, &at, &start, &end)) {
		const size_t bytes = (end - start) / PAGE * sizeof *entry;

		done = pread(tracker->pagemap, entry, bytes,
			     (off_t)(start / PAGE * sizeof *entry)) == (ssize_t)bytes;
		for (size_t i = 0; done && start < end; i++, start += PAGE)
			done = pageset_add(page_is_own(entry[i]) ? &tracker->of_files
								 : &tracker->found,
					   start, start + PAGE);
	}
	pageset_free(&had);
	return done;
}

/* ---- scans --------------------------------------------------------------------------------- */

static int note(avc_remote start, avc_remote end, void *arg)
{
	struct tracker *tracker = arg;

	tracker->broken |= !pageset_add(&tracker->found, start, end);
	return 0;
}

static int look_for_written(struct tracker *tracker, avc_remote start, avc_remote end, int pagemap)
{
	return pagemap_written(pagemap, start, end, note, tracker);
}

int tracker_scan(struct tracker *tracker, pid_t template, uint64_t *pages)
{
	int result = find_parts(tracker, tracker->pagemap);

	if (!result && template) {
		int pagemap = proc_open(template, "pagemap", O_RDONLY);

		result = pagemap < 0 ? -1 : find_parts(tracker, pagemap);
		close_fd(&pagemap);
	}
	tracker->found.count = 0;
	for (uint32_t i = 0; !result && i < tracker->areas; i++)
		result = each(tracker, &tracker->area[i], true, look_for_written, tracker->pagemap);
	tracker->broken |= !keep_found(tracker) || !find_given_back(tracker);
	*pages = pageset_count(&tracker->found);
	tracker->scanned_ns = now_ns();
	for (uint32_t i = 0; i < tracker->sets; i++)
		tracker->broken |= !pageset_add_all(tracker->set[i], &tracker->found);
	return result || tracker->broken ? -1 : 0;
}

bool tracker_add(struct tracker *tracker, struct pageset *set)
{
	if (tracker->sets == TRACKER_SETS)
		return false;
	tracker->set[tracker->sets++] = set;
	return true;
}

void tracker_remove(struct tracker *tracker, const struct pageset *set)
{
	for (uint32_t i = 0; i < tracker->sets; i++)
		if (tracker->set[i] == set)
			tracker->set[i--] = tracker->set[--tracker->sets];
}
