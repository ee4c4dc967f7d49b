/* SPDX-License-Identifier: Apache-2.0
 *
 * The memory of a process that its restored parent has forked: it is the parent's, and
 * is made that of the template.
 *
 * Where both have the same mapped at the same place it stays, and with it the pages that
 * they share: of equal page frames (pagemap, Documentation/admin-guide/mm/pagemap.rst)
 * there is nothing to do.  Everything else is unmapped, mapped, and copied.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#include "internal.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
#define COPY_BYTES (512u << 10)
#define MAP_PAGES 16384u /* of pagemap, read at a time                        */

#define PAGEMAP_PRESENT (UINT64_C(1) << 63)
#define PAGEMAP_SWAPPED (UINT64_C(1) << 62)
#define PAGEMAP_FILE (UINT64_C(1) << 61)
#define PAGEMAP_FRAME ((UINT64_C(1) << 55) - 1)

struct maps {
	struct mapping *map;
	uint32_t count, room;
};

/* A stretch that is in one mapping of both at most. */
struct piece {
	avc_remote start, end;
	const struct mapping *is, *want; /* NULL: nothing is mapped             */
	bool kept;
};

struct remap {
	struct puppet *puppet;
	const struct target *target;
	pid_t template, parent;
	struct maps is, want;
	struct piece *piece;
	uint32_t pieces;
	int want_mem, is_mem, want_pages, parent_pages;
	uint8_t *buffer;
	uint64_t *frame, *parent_frame;
	struct avc_error *err;
};

/* ---- mappings ------------------------------------------------------------------- */

static bool is_special(const struct mapping *m)
{
	return !strncmp(m->name, "[vdso", 5) || !strncmp(m->name, "[vvar", 5);
}

static bool is_stack(const struct mapping *m)
{
	return !strcmp(m->name, "[stack]");
}

static bool is_file(const struct mapping *m)
{
	return m->inode != 0;
}

static int add_mapping(const struct mapping *m, void *arg)
{
	struct maps *maps = arg;

	if (m->start >= ARCH_USER_END)
		return 0;
	if (maps->count == maps->room) {
		const uint32_t room = maps->room ? 2 * maps->room : 256;
		struct mapping *more = realloc(maps->map, room * sizeof *more);

		if (!more)
			return -1;
		maps->map = more;
		maps->room = room;
	}
	maps->map[maps->count++] = *m;
	return 0;
}

static bool same_backing(const struct mapping *a, const struct mapping *b)
{
	return a->shared == b->shared && is_stack(a) == is_stack(b) && a->inode == b->inode &&
	       is_special(a) == is_special(b) &&
	       (!is_file(a) ||
		(a->offset - a->start == b->offset - b->start && !strcmp(a->name, b->name)));
}

/* What is of ours in either, or stays where it is whatever happens. */
static bool is_fixed(const struct remap *r, const struct mapping *m)
{
	return is_special(m) || pad_contains(&r->target->pad, m->start);
}

static const struct mapping *at(const struct maps *maps, uint32_t *next, avc_remote address)
{
	while (*next < maps->count && maps->map[*next].end <= address)
		++*next;
	return *next < maps->count && maps->map[*next].start <= address ? &maps->map[*next] : NULL;
}

static avc_remote boundary(const struct maps *maps, uint32_t next, avc_remote address)
{
	if (next == maps->count)
		return UINT64_MAX;
	return maps->map[next].start > address ? maps->map[next].start : maps->map[next].end;
}

/* Both lists side by side. */
static int cut(struct remap *r)
{
	avc_remote address = 0;
	uint32_t is = 0, want = 0;

	r->piece = calloc(2 * (r->is.count + r->want.count) + 2, sizeof *r->piece);
	if (!r->piece)
		return fail_errno(r->err, 0, "restore memory", "calloc", "out of memory");
	for (;;) {
		const struct mapping *a = at(&r->is, &is, address);
		const struct mapping *b = at(&r->want, &want, address);
		const avc_remote x = boundary(&r->is, is, address);
		const avc_remote y = boundary(&r->want, want, address);
		const avc_remote end = x < y ? x : y;

		if (end == UINT64_MAX)
			return 0;
		if (a && is_fixed(r, a))
			a = b = NULL;
		if (b && is_fixed(r, b))
			b = NULL;
		if (a || b)
			r->piece[r->pieces++] = (struct piece){
				.start = address,
				.end = end,
				.is = a,
				.want = b,
				.kept = a && b && same_backing(a, b),
			};
		address = end;
	}
}

static int protection(const struct mapping *m)
{
	return (m->mode[0] == 'r' ? PROT_READ : 0) | (m->mode[1] == 'w' ? PROT_WRITE : 0) |
	       (m->mode[2] == 'x' ? PROT_EXEC : 0);
}

static void unmap(struct remap *r)
{
	for (uint32_t i = 0; i < r->pieces; i++) {
		const uint32_t first = i;

		if (!r->piece[i].is || r->piece[i].kept)
			continue;
		while (i + 1 < r->pieces && r->piece[i + 1].start == r->piece[i].end &&
		       r->piece[i + 1].is && !r->piece[i + 1].kept)
			i++;
		puppet_call(r->puppet, SYS_munmap, r->piece[first].start,
			    r->piece[i].end - r->piece[first].start, 0, 0, 0, 0);
	}
}

static const struct mapping *find_special(const struct maps *maps, const char *name)
{
	for (uint32_t i = 0; i < maps->count; i++)
		if (!strcmp(maps->map[i].name, name))
			return &maps->map[i];
	return NULL;
}

/* Of a program that was executed anew the vDSO is somewhere else.  By way of a place that
 * neither has anything at: behind the pad. */
static int move_special(struct remap *r)
{
	static const char *const names[] = { "[vvar]", "[vvar_vclock]", "[vdso]" };
	avc_remote between = r->target->pad.base + r->target->pad.bytes + PAGE;

	for (int away = 1; away >= 0; away--)
		for (size_t i = 0; i < sizeof names / sizeof *names; i++) {
			const struct mapping *a = find_special(&r->is, names[i]);
			const struct mapping *b = find_special(&r->want, names[i]);
			const uint64_t bytes = a ? a->end - a->start : 0;

			if (!a || !b || a->start == b->start)
				continue;
			if (b->end - b->start != bytes)
				return fail(r->err, AVC_UNSUPPORTED, 0, r->puppet->pid,
					    "restore memory", "", "its vDSO is of another size");
			if (away)
				puppet_call(r->puppet, SYS_mremap, a->start, bytes, bytes,
					    MREMAP_MAYMOVE | MREMAP_FIXED, between, 0);
			else
				puppet_call(r->puppet, SYS_mremap, between, bytes, bytes,
					    MREMAP_MAYMOVE | MREMAP_FIXED, b->start, 0);
			between += bytes;
			if (i + 1 == sizeof names / sizeof *names)
				between = r->target->pad.base + r->target->pad.bytes + PAGE;
		}
	return 0;
}

static int open_mapped(const struct remap *r, const struct mapping *m)
{
	char name[64];
	int fd = -1;

	snprintf(name, sizeof name, "map_files/%lx-%lx", (unsigned long)m->start,
		 (unsigned long)m->end);
	if (m->shared)
		fd = proc_open(r->template, name, O_RDWR);
	return fd >= 0 ? fd : proc_open(r->template, name, O_RDONLY);
}

static int map_piece(struct remap *r, const struct piece *piece)
{
	const struct mapping *m = piece->want;
	int flags = MAP_FIXED | (m->shared ? MAP_SHARED : MAP_PRIVATE | MAP_NORESERVE), fd;

	if (!is_file(m)) {
		flags |= MAP_ANONYMOUS | (is_stack(m) ? MAP_GROWSDOWN | MAP_STACK : 0);
		puppet_call(r->puppet, SYS_mmap, piece->start, piece->end - piece->start,
			    (uint64_t)protection(m), (uint64_t)flags, (uint64_t)-1, 0);
		return 0;
	}
	fd = open_mapped(r, m);
	if (fd < 0)
		return fail_errno(r->err, r->puppet->pid, "restore memory", "open(map_files)",
				  "%s can not be opened", m->name);
	if (puppet_give(r->puppet, fd, r->err)) {
		close(fd);
		return -1;
	}
	close(fd);
	puppet_call(r->puppet, SYS_mmap, piece->start, piece->end - piece->start,
		    (uint64_t)protection(m), (uint64_t)flags, 1,
		    m->offset + (piece->start - m->start));
	puppet_call(r->puppet, SYS_close, 1, 0, 0, 0, 0, 0);
	return 0;
}

static int map_new(struct remap *r)
{
	for (uint32_t i = 0; i < r->pieces; i++) {
		const struct piece *piece = &r->piece[i];

		if (piece->want && !piece->kept && map_piece(r, piece))
			return -1;
		if (piece->kept && protection(piece->is) != protection(piece->want))
			puppet_call(r->puppet, SYS_mprotect, piece->start,
				    piece->end - piece->start, (uint64_t)protection(piece->want), 0,
				    0, 0);
	}
	return puppet_flush(r->puppet, "mmap", r->err);
}

/* ---- pages -------------------------------------------------------------------------- */

static int copy_pages(struct remap *r, const struct mapping *m, avc_remote start, avc_remote end)
{
	while (start < end) {
		const size_t bytes = end - start < COPY_BYTES ? end - start : COPY_BYTES;
		struct iovec here = { r->buffer, bytes }, there = { (void *)start, bytes };

		if ((m->mode[0] != 'r' ||
		     process_vm_readv(r->template, &here, 1, &there, 1, 0) != (ssize_t)bytes) &&
		    pread(r->want_mem, r->buffer, bytes, (off_t)start) != (ssize_t)bytes)
			return fail_errno(r->err, r->template, "restore memory", "read(mem)",
					  "it can not be read at %lx", (unsigned long)start);
		if ((m->mode[1] != 'w' ||
		     process_vm_writev(r->puppet->pid, &here, 1, &there, 1, 0) != (ssize_t)bytes) &&
		    pwrite(r->is_mem, r->buffer, bytes, (off_t)start) != (ssize_t)bytes)
			return fail_errno(r->err, r->puppet->pid, "restore memory", "write(mem)",
					  "it can not be written at %lx", (unsigned long)start);
		start += bytes;
	}
	return 0;
}

enum page { PAGE_SAME, PAGE_COPY, PAGE_DROP };

/* Of a private mapping.  What is of a file is there by itself. */
static enum page compare(uint64_t want, uint64_t is, bool kept)
{
	const bool own = want & (PAGEMAP_PRESENT | PAGEMAP_SWAPPED) && !(want & PAGEMAP_FILE);
	const bool parents = kept && is & (PAGEMAP_PRESENT | PAGEMAP_SWAPPED) &&
			     !(is & PAGEMAP_FILE);

	if (!own)
		return parents ? PAGE_DROP : PAGE_SAME;
	if (parents && want & PAGEMAP_FRAME &&
	    !((want ^ is) & (PAGEMAP_FRAME | PAGEMAP_PRESENT | PAGEMAP_SWAPPED)))
		return PAGE_SAME;
	return PAGE_COPY;
}

static int apply(struct remap *r, const struct piece *piece, enum page what, avc_remote start,
		 avc_remote end)
{
	if (what == PAGE_COPY)
		return copy_pages(r, piece->want, start, end);
	if (what == PAGE_DROP)
		puppet_call(r->puppet, SYS_madvise, start, end - start, MADV_DONTNEED, 0, 0, 0);
	return 0;
}

static int read_frames(int fd, avc_remote at_address, uint64_t *frames, size_t count)
{
	const size_t bytes = count * sizeof *frames;

	return pread(fd, frames, bytes, (off_t)(at_address / PAGE * 8)) == (ssize_t)bytes ? 0 : -1;
}

static int fill_piece(struct remap *r, const struct piece *piece)
{
	for (avc_remote from = piece->start; from < piece->end; from += MAP_PAGES * PAGE) {
		const avc_remote left = (piece->end - from) / PAGE;
		const size_t count = left < MAP_PAGES ? left : MAP_PAGES;
		enum page run = PAGE_SAME;
		size_t begin = 0;

		if (read_frames(r->want_pages, from, r->frame, count) ||
		    (piece->kept && read_frames(r->parent_pages, from, r->parent_frame, count)))
			return fail_errno(r->err, r->template, "restore memory", "read(pagemap)",
					  "its pages can not be compared");
		for (size_t i = 0; i <= count; i++) {
			const enum page now =
				i == count
					? PAGE_SAME
					: compare(r->frame[i], piece->kept ? r->parent_frame[i] : 0,
						  piece->kept);

			if (now == run && i < count)
				continue;
			if (run != PAGE_SAME &&
			    apply(r, piece, run, from + begin * PAGE, from + i * PAGE))
				return -1;
			run = now;
			begin = i;
		}
	}
	return 0;
}

static int fill(struct remap *r, avc_remote touched)
{
	for (uint32_t i = 0; i < r->pieces; i++) {
		const struct piece *piece = &r->piece[i];

		if (!piece->want || piece->want->shared)
			continue;
		if (fill_piece(r, piece))
			return -1;
		/* The kernel has written to it since (rseq(2)). */
		if (touched >= piece->start && touched < piece->end) {
			const avc_remote page = touched & ~(PAGE - 1);

			if (read_frames(r->want_pages, page, r->frame, 1) == 0 &&
			    compare(r->frame[0], 0, false) == PAGE_COPY &&
			    copy_pages(r, piece->want, page, page + PAGE))
				return -1;
		}
	}
	return 0; /* the last calls are made with what comes next */
}

/* ---- all of it ----------------------------------------------------------------------- */

int remap(struct puppet *puppet, const struct target *target, pid_t template, pid_t parent,
	  avc_remote touched, struct avc_error *err)
{
	struct remap r = {
		.puppet = puppet,
		.target = target,
		.template = template,
		.parent = parent,
		.want_mem = proc_open(template, "mem", O_RDONLY),
		.is_mem = proc_open(puppet->pid, "mem", O_RDWR),
		.want_pages = proc_open(template, "pagemap", O_RDONLY),
		.parent_pages = proc_open(parent, "pagemap", O_RDONLY),
		.buffer = malloc(COPY_BYTES),
		.frame = malloc(MAP_PAGES * sizeof *r.frame),
		.parent_frame = malloc(MAP_PAGES * sizeof *r.parent_frame),
		.err = err,
	};
	int result = -1;

	if (r.want_mem < 0 || r.is_mem < 0 || r.want_pages < 0 || r.parent_pages < 0 || !r.buffer ||
	    !r.frame || !r.parent_frame)
		fail_errno(err, puppet->pid, "restore memory", "open(mem)",
			   "it can not be reached");
	else if (proc_mappings(puppet->pid, "maps", add_mapping, &r.is) ||
		 proc_mappings(template, "maps", add_mapping, &r.want))
		fail_errno(err, puppet->pid, "restore memory", "read(maps)", "it was killed");
	else if (cut(&r) == 0) {
		unmap(&r);
		if (move_special(&r) == 0 && map_new(&r) == 0)
			result = fill(&r, touched);
	}
	close_fd(&r.want_mem);
	close_fd(&r.is_mem);
	close_fd(&r.want_pages);
	close_fd(&r.parent_pages);
	free(r.buffer);
	free(r.frame);
	free(r.parent_frame);
	free(r.is.map);
	free(r.want.map);
	free(r.piece);
	return result;
}
