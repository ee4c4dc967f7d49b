/* SPDX-License-Identifier: Apache-2.0
 *
 * Memory that is wiped in a clone (MADV_WIPEONFORK). The application's flag must stay, because
 * programs rely on it for security (random number generators); so the contents are read while the
 * application is stopped, and written into the template, where the flag is removed; the restored
 * process sets it again.
 *
 * Programs reserve far more of it than they use: only pages present are read.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "memory.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
#define ENTRIES 512 /* of pagemap, at a time                                       */

struct copying {
	const struct process *process;
	struct mem_image *image;
	int pagemap;
};

static bool add_run(struct mem_image *image, avc_remote page, bool guard)
{
	struct wiped *wiped = &image->wiped;
	struct wiped_run *last = wiped->runs ? &wiped->run[wiped->runs - 1] : NULL;

	if (last && last->end == page && last->guard == guard) {
		last->end += PAGE;
		return true;
	}
	if (image->seen->runs == WIPED_RUNS_MAX) {
		image->too_much = true;
		return false;
	}
	if (!make_room(&wiped->run, wiped->runs, &wiped->room, sizeof *wiped->run))
		return false;
	wiped->run[wiped->runs++] = (struct wiped_run){ page, page + PAGE, guard };
	image->seen->runs++;
	return true;
}

static bool add_page(const struct copying *copying, avc_remote page)
{
	struct mem_image *image = copying->image;
	struct wiped *wiped = &image->wiped;

	if (image->seen->wiped_bytes + PAGE > WIPED_MAX) {
		image->too_much = true;
		return false;
	}
	if (wiped->used + PAGE > wiped->size) {
		const size_t size = wiped->size ? 2 * wiped->size : 16 * PAGE;
		uint8_t *more = realloc(wiped->bytes, size);

		if (!more)
			return false;
		wiped->bytes = more;
		wiped->size = size;
	}
	if (pread(copying->process->mem_fd, wiped->bytes + wiped->used, PAGE, (off_t)page) !=
		    (ssize_t)PAGE ||
	    !add_run(image, page, false))
		return false;
	wiped->used += PAGE;
	image->seen->wiped_bytes += PAGE;
	return true;
}

static int copy_stretch(avc_remote start, avc_remote end, void *arg)
{
	const struct copying *copying = arg;
	uint64_t entry[ENTRIES];

	while (start < end) {
		const size_t pages = (end - start) / PAGE < ENTRIES ? (end - start) / PAGE
								    : ENTRIES;
		const size_t bytes = pages * sizeof *entry;

		if (!budget_step() ||
		    pread(copying->pagemap, entry, bytes, (off_t)(start / PAGE * sizeof *entry)) !=
			    (ssize_t)bytes)
			return -1;
		for (size_t i = 0; i < pages; i++, start += PAGE)
			if (page_is_guard(entry[i])
				    ? !add_run(copying->image, start, true)
				    : page_is_own(entry[i]) && !add_page(copying, start))
				return -1;
	}
	return 0;
}

void wiped_copy(const struct process *process, struct mem_image *image)
{
	struct copying copying = { .process = process, .image = image, .pagemap = -1 };

	for (uint32_t i = 0; image->whole && i < image->areas.count; i++) {
		const struct area *a = &image->areas.area[i];

		if (!a->wiped)
			continue;
		if (copying.pagemap < 0)
			copying.pagemap = proc_open(process->pid, "pagemap", O_RDONLY);
		image->whole = copying.pagemap >= 0 &&
			       !pagemap_walk(copying.pagemap, a->start, a->end, copy_stretch,
					     &copying);
	}
	close_fd(&copying.pagemap);
}

void wiped_free(struct wiped *wiped)
{
	free(wiped->run);
	free(wiped->bytes);
	*wiped = (struct wiped){ 0 };
}

static int flush(const struct image *image, struct inj_call *call, struct avc_error *err)
{
	if (call->count &&
	    (parasite_send(&image->process->parasite, image->template, &image->base, call, err) ||
	     parasite_run(image->template, call, err)))
		return -1;
	call_begin(call, INJ_AFTER_PARK);
	return 0;
}

static int advise(const struct image *image, struct inj_call *call, avc_remote start,
		  avc_remote end, int advice, struct avc_error *err)
{
	if (call->count >= INJ_CALLS_MAX && flush(image, call, err))
		return -1;
	call_add(call, SYS_madvise, start, end - start, (uint64_t)advice);
	return 0;
}

int wiped_fill(const struct image *image, struct setup *setup, struct avc_error *err)
{
	struct inj_call *call = &setup->slot->template_call;
	struct mem_image *memory = image->memory;
	const uint8_t *from = memory->wiped.bytes;
	int mem_fd = -1, result = 0;

	call_begin(call, INJ_AFTER_PARK);
	if (memory->wiped.runs)
		mem_fd = proc_open(image->template, "mem", O_RDWR);
	for (uint32_t i = 0; !result && i < memory->wiped.runs; i++) {
		const struct wiped_run *run = &memory->wiped.run[i];
		const size_t bytes = run->end - run->start;

		if (run->guard) {
			result = advise(image, call, run->start, run->end, GUARD_INSTALL, err);
		} else if (pwrite(mem_fd, from, bytes, (off_t)run->start) != (ssize_t)bytes) {
			result = fail_errno(err, image->template, "keep memory", "write(mem)",
					    "it was killed");
		} else {
			from += bytes;
		}
	}
	for (uint32_t i = 0; !result && i < memory->areas.count; i++) {
		const struct area *a = &memory->areas.area[i];

		if (!a->wiped)
			continue;
		result = advise(image, call, a->start, a->end, MADV_KEEPONFORK, err);
		setup_add(setup, INJ_BEFORE, "madvise", SYS_madvise, a->start, area_bytes(a),
			  MADV_WIPEONFORK);
	}
	close_fd(&mem_fd);
	wiped_free(&memory->wiped);
	return result || flush(image, call, err) ? -1 : 0;
}
