/* SPDX-License-Identifier: Apache-2.0
 *
 * Copies pages of a process to an idle template of it: at once while the application runs; while it
 * is stopped they are only read.
 */
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#include "dirty.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
#define FREEZE_PAGES 16384 /* read in a freeze, at most                       */
#define VECTORS 1024

enum run_kind { RUN_DATA, RUN_EMPTY, RUN_GUARD };

struct run {
	avc_remote start, end;
	enum run_kind kind;
	size_t at; /* offset of its contents in dirty.data                      */
};

/* ---- runs ------------------------------------------------------------------------------------ */

static enum run_kind kind_of(uint64_t entry)
{
	return page_is_guard(entry) ? RUN_GUARD : page_is_own(entry) ? RUN_DATA : RUN_EMPTY;
}

static bool add_run(struct dirty *dirty, avc_remote start, avc_remote end, enum run_kind kind)
{
	if (!make_room(&dirty->run, dirty->runs, &dirty->run_room, sizeof *dirty->run))
		return false;
	dirty->run[dirty->runs++] = (struct run){ start, end, kind, dirty->used };
	if (kind == RUN_DATA)
		dirty->used += end - start;
	return true;
}

/* Splits part of a chunk into runs of the same kind. */
static bool sort_stretch(struct dirty *dirty, int pagemap, avc_remote start, avc_remote end)
{
	uint64_t entry[PAGESET_PAGES];
	const size_t pages = (end - start) / PAGE;

	if (pread(pagemap, entry, pages * sizeof *entry, (off_t)(start / PAGE * sizeof *entry)) !=
	    (ssize_t)(pages * sizeof *entry))
		return false;
	for (size_t i = 0, k; i < pages; i = k) {
		const enum run_kind kind = kind_of(entry[i]);

		for (k = i + 1; k < pages && kind_of(entry[k]) == kind; k++)
			;
		if (!add_run(dirty, start + i * PAGE, start + k * PAGE, kind))
			return false;
	}
	return true;
}

bool copy_make_room(struct dirty *dirty, size_t bytes)
{
	uint8_t *more;

	if (dirty->data_bytes >= bytes)
		return true;
	free(dirty->data);
	more = malloc(bytes);
	dirty->data = more;
	dirty->data_bytes = more ? bytes : 0;
	if (more)
		memset(more, 0, bytes); /* page faults now, not in a freeze */
	return more != NULL;
}

/* process_vm_readv(2) or process_vm_writev(2), for the runs that have contents; `mem` is for those
 * that the process itself could not read or write. */
typedef ssize_t transfer(pid_t pid, const struct iovec *here, unsigned long heres,
			 const struct iovec *there, unsigned long theres, unsigned long flags);

static bool move_one(const struct dirty *dirty, const struct run *run, int mem, bool reading)
{
	uint8_t *data = dirty->data + run->at;
	const size_t bytes = run->end - run->start;
	const ssize_t n = reading ? pread(mem, data, bytes, (off_t)run->start)
				  : pwrite(mem, data, bytes, (off_t)run->start);

	return n == (ssize_t)bytes;
}

static bool move(const struct dirty *dirty, pid_t pid, int mem, bool reading)
{
	transfer *const step = reading ? process_vm_readv : process_vm_writev;
	struct iovec there[VECTORS];

	for (uint32_t i = 0; i < dirty->runs;) {
		struct iovec here = { NULL, 0 };
		uint32_t first = i, count = 0;

		for (; i < dirty->runs && count < VECTORS; i++) {
			const struct run *run = &dirty->run[i];

			if (run->kind != RUN_DATA)
				continue;
			if (!count)
				here.iov_base = dirty->data + run->at;
			there[count++] = (struct iovec){ (void *)run->start,
							 run->end - run->start };
			here.iov_len += run->end - run->start;
		}
		if (!count || step(pid, &here, 1, there, count, 0) == (ssize_t)here.iov_len)
			continue;
		for (; first < i; first++)
			if (dirty->run[first].kind == RUN_DATA &&
			    !move_one(dirty, &dirty->run[first], mem, reading))
				return false;
	}
	return true;
}

/* ---- while the application runs -------------------------------------------------------------- */

/* Pages that cannot be copied yet stay in the set; empty ones always do. */
static void copy_batch(struct dirty *dirty, const struct process *process, int mem)
{
	struct idle_template *idle = &dirty->idle;
	const bool copied = move(dirty, process->pid, process->mem_fd, true) &&
			    move(dirty, idle->pid, mem, false);

	for (uint32_t i = 0; i < dirty->runs; i++) {
		const struct run *run = &dirty->run[i];

		if (copied && run->kind == RUN_DATA)
			dirty->copied += (run->end - run->start) / PAGE;
		else
			process->tracker->broken |= !pageset_add(idle->stale, run->start, run->end);
	}
	dirty->runs = 0;
	dirty->used = 0;
}

void copy_stale(struct dirty *dirty, const struct process *process)
{
	struct pageset todo = *dirty->idle.stale;
	struct page_cursor at = { 0 };
	avc_remote start, end;
	int mem = proc_open(dirty->idle.pid, "mem", O_RDWR);

	if (mem < 0)
		return;
	*dirty->idle.stale = (struct pageset){ 0 };
	dirty->runs = 0;
	dirty->used = 0;
	while (pageset_next(&todo, &at, &start, &end)) {
		heartbeat();
		if (!sort_stretch(dirty, process->tracker->pagemap, start, end))
			process->tracker->broken |= !pageset_add(dirty->idle.stale, start, end);
		if (dirty->used >= COPY_BATCH_PAGES / 2 * PAGE)
			copy_batch(dirty, process, mem);
	}
	copy_batch(dirty, process, mem);
	pageset_free(&todo);
	close(mem);
}

/* ---- in the freeze, and after it --------------------------------------------------------------- */

/* false: there is not enough room for all contents, or there are too many. */
static bool sort(struct dirty *dirty, int pagemap, const struct pageset *pages)
{
	struct page_cursor at = { 0 };
	avc_remote start, end;

	dirty->runs = 0;
	dirty->used = 0;
	while (pageset_next(pages, &at, &start, &end))
		if (!sort_stretch(dirty, pagemap, start, end) || dirty->used > dirty->data_bytes ||
		    dirty->used > FREEZE_PAGES * PAGE)
			return false;
	return true;
}

bool copy_read(struct dirty *dirty, const struct process *process)
{
	return sort(dirty, process->tracker->pagemap, dirty->idle.stale) &&
	       move(dirty, process->pid, process->mem_fd, true);
}

bool copy_read_template(struct dirty *dirty, pid_t template, const struct pageset *pages)
{
	int pagemap = proc_open(template, "pagemap", O_RDONLY);
	int mem = proc_open(template, "mem", O_RDONLY);
	const bool read = pagemap >= 0 && mem >= 0 && sort(dirty, pagemap, pages) &&
			  move(dirty, template, mem, true);

	close_fd(&pagemap);
	close_fd(&mem);
	return read;
}

static int advise(struct template_calls *calls, avc_remote start, avc_remote end, int advice,
		  struct avc_error *err)
{
	return template_call(
		calls,
		&(struct inj_syscall){ .nr = SYS_madvise,
				       .arg = { start, end - start, (uint64_t)advice } },
		err);
}

/* Removes what the template has in one run and the process has not. */
static int prepare_run(struct template_calls *calls, const struct run *run, int pagemap,
		       struct avc_error *err)
{
	uint64_t entry[PAGESET_PAGES];
	const size_t pages = (run->end - run->start) / PAGE;
	bool own = false, guard = false;

	if (run->kind == RUN_GUARD)
		return advise(calls, run->start, run->end, GUARD_INSTALL, err);
	if (pread(pagemap, entry, pages * sizeof *entry,
		  (off_t)(run->start / PAGE * sizeof *entry)) != (ssize_t)(pages * sizeof *entry))
		return fail_errno(err, calls->idle->pid, "keep template", "read(pagemap)",
				  "it was killed");
	for (size_t i = 0; i < pages; i++) {
		own |= page_is_own(entry[i]);
		guard |= page_is_guard(entry[i]);
	}
	if (guard && advise(calls, run->start, run->end, GUARD_REMOVE, err))
		return -1;
	return own && run->kind == RUN_EMPTY
		       ? advise(calls, run->start, run->end, MADV_DONTNEED, err)
		       : 0;
}

static int prepare(const struct dirty *dirty, struct template_calls *calls, int pagemap, bool data,
		   struct avc_error *err)
{
	for (uint32_t i = 0; i < dirty->runs; i++)
		if ((dirty->run[i].kind == RUN_DATA) == data &&
		    prepare_run(calls, &dirty->run[i], pagemap, err))
			return -1;
	return template_calls_end(calls, err);
}

int copy_write(struct dirty *dirty, struct template_calls *calls, struct avc_error *err)
{
	const struct idle_template *idle = &dirty->idle;
	int mem = proc_open(idle->pid, "mem", O_RDWR);
	int pagemap = proc_open(idle->pid, "pagemap", O_RDONLY);
	int result = prepare(dirty, calls, pagemap, false, err);

	/* What is to be written needs it only where there are guards, which cannot be written to. */
	if (!result && !move(dirty, idle->pid, mem, false)) {
		result = prepare(dirty, calls, pagemap, true, err);
		if (!result && !move(dirty, idle->pid, mem, false))
			result = fail_errno(err, idle->pid, "keep template", "process_vm_writev",
					    "its memory cannot be written");
	}
	close_fd(&mem);
	close_fd(&pagemap);
	for (uint32_t i = 0; i < dirty->runs; i++)
		if (dirty->run[i].kind == RUN_DATA)
			dirty->copied += (dirty->run[i].end - dirty->run[i].start) / PAGE;
	return result;
}
