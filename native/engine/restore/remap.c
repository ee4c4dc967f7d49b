/* SPDX-License-Identifier: Apache-2.0
 *
 * The memory of a process that its restored parent has forked: it is the parent's, and
 * is made that of the template.
 *
 * Where both have the same mapped at the same place it stays, and with it the pages that
 * they share: of equal page frames (pagemap, Documentation/admin-guide/mm/pagemap.rst)
 * there is nothing to do.  Everything else is unmapped, mapped, and copied.  What that is
 * is found out by the templates of both, before there is a process that it is for.
 */
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/shm.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "internal.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
#define DROPPABLE 0x08 /* MAP_DROPPABLE, since Linux 6.11; the headers may be older */

/* A stretch that is in one mapping of both at most. */
struct piece {
	avc_remote start, end;
	const struct mapping *is, *want; /* NULL: nothing is mapped             */
	bool kept;
};

enum page {
	PAGE_SAME,
	PAGE_COPY,
	PAGE_DROP,
	PAGE_GUARD,    /* becomes a guard page                                   */
	PAGE_OPEN,     /* is one, and is to be empty                             */
	PAGE_OPEN_COPY /* is one, and is to be copied                           */
};

struct run {
	avc_remote start, end;
	enum page what;
	bool plain; /* it may be read and written                           */
};

struct remap {
	const struct target *target;
	struct snapshot *is, *want;
	struct piece *piece;
	uint32_t pieces;
	struct run *run;
	uint32_t runs, room;
};

/* ---- mappings ------------------------------------------------------------------- */

static bool is_stack(const struct mapping *m)
{
	return !strcmp(m->name, "[stack]");
}

static bool is_file(const struct mapping *m)
{
	return m->inode != 0;
}

/* By which it was mapped. */
static uint32_t kind_of(const struct mapping *m)
{
	return (m->flags & (MAPPING_DROPPABLE | MAPPING_GROWING)) |
	       (is_stack(m) ? MAPPING_GROWING : 0);
}

static bool same_backing(const struct mapping *a, const struct mapping *b)
{
	return a->shared == b->shared && is_stack(a) == is_stack(b) && a->inode == b->inode &&
	       mapping_is_special(a) == mapping_is_special(b) && kind_of(a) == kind_of(b) &&
	       (!is_file(a) ||
		(a->offset - a->start == b->offset - b->start && !strcmp(a->name, b->name)));
}

/* What stays where it is whatever happens; where our parasite is nothing else is touched. */
static bool is_fixed(const struct remap *r, const struct mapping *m, avc_remote address)
{
	return mapping_is_special(m) || parasite_contains(&r->target->parasite, address);
}

static const struct mapping *at(const struct mappings *maps, uint32_t *next, avc_remote address)
{
	while (*next < maps->count && maps->map[*next].end <= address)
		++*next;
	return *next < maps->count && maps->map[*next].start <= address ? &maps->map[*next] : NULL;
}

static avc_remote boundary(const struct mappings *maps, uint32_t next, avc_remote address)
{
	if (next == maps->count)
		return UINT64_MAX;
	return maps->map[next].start > address ? maps->map[next].start : maps->map[next].end;
}

/* Both lists side by side. */
static int cut(struct remap *r, struct avc_error *err)
{
	const struct mappings *is_maps = &r->is->maps, *want_maps = &r->want->maps;
	avc_remote address = 0;
	uint32_t is = 0, want = 0;

	r->piece = calloc(2 * (is_maps->count + want_maps->count) + 2, sizeof *r->piece);
	if (!r->piece)
		return fail_errno(err, 0, "restore memory", "calloc", "out of memory");
	for (;;) {
		const struct mapping *a = at(is_maps, &is, address);
		const struct mapping *b = at(want_maps, &want, address);
		const avc_remote x = boundary(is_maps, is, address);
		const avc_remote y = boundary(want_maps, want, address);
		const avc_remote end = x < y ? x : y;

		if (end == UINT64_MAX)
			return 0;
		if ((a && is_fixed(r, a, address)) || (b && is_fixed(r, b, address)))
			a = b = NULL;
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

static uint32_t key_of(const struct mapping *m)
{
	return (m->flags & MAPPING_KEYS) / MAPPING_KEY_ONE;
}

static bool same_protection(const struct mapping *a, const struct mapping *b)
{
	return mapping_protection(a) == mapping_protection(b) && key_of(a) == key_of(b);
}

static int unmap(const struct remap *r, struct syscall_batch *batch, struct avc_error *err)
{
	for (uint32_t i = 0; i < r->pieces; i++) {
		const uint32_t first = i;

		if (!r->piece[i].is || r->piece[i].kept)
			continue;
		while (i + 1 < r->pieces && r->piece[i + 1].start == r->piece[i].end &&
		       r->piece[i + 1].is && !r->piece[i + 1].kept)
			i++;
		if (syscall_batch_ask(batch, SYS_munmap, r->piece[first].start,
				      r->piece[i].end - r->piece[first].start, 0, 0, 0, 0, err))
			return -1;
	}
	return 0;
}

static const struct mapping *find_special(const struct mappings *maps, const char *name)
{
	for (uint32_t i = 0; i < maps->count; i++)
		if (!strcmp(maps->map[i].name, name))
			return &maps->map[i];
	return NULL;
}

/* Of a program that was executed anew the vDSO is somewhere else.  By way of a place that
 * neither has anything at: behind the parasite. */
static int move_special(const struct remap *r, struct syscall_batch *batch, struct avc_error *err)
{
	static const char *const names[] = { "[vvar]", "[vvar_vclock]", "[vdso]" };
	avc_remote between = r->target->parasite.base + r->target->parasite.bytes + PAGE;

	for (int away = 1; away >= 0; away--)
		for (size_t i = 0; i < sizeof names / sizeof *names; i++) {
			const struct mapping *a = find_special(&r->is->maps, names[i]);
			const struct mapping *b = find_special(&r->want->maps, names[i]);
			const uint64_t bytes = a ? a->end - a->start : 0;

			if (!a || !b || a->start == b->start)
				continue;
			if (b->end - b->start != bytes)
				return fail(err, AVC_UNSUPPORTED, 0, batch->pid, "restore memory",
					    "", "its vDSO is of another size");
			if (away)
				syscall_batch_add(batch, SYS_mremap, a->start, bytes, bytes,
						  MREMAP_MAYMOVE | MREMAP_FIXED, between, 0);
			else
				syscall_batch_add(batch, SYS_mremap, between, bytes, bytes,
						  MREMAP_MAYMOVE | MREMAP_FIXED, b->start, 0);
			between += bytes;
			if (i + 1 == sizeof names / sizeof *names)
				between = r->target->parasite.base + r->target->parasite.bytes +
					  PAGE;
		}
	return 0;
}

/* By a descriptor for more, what is shared could be made writable that never was; and of a file
 * in an overlay a copy would be made. */
static int open_mapped(pid_t template, const struct mapping *m)
{
	const int fd = m->shared ? proc_open_mapped(template, m->start, m->end, O_RDWR) : -1;

	return fd >= 0 ? fd : proc_open_mapped(template, m->start, m->end, O_RDONLY);
}

/* Libraries are mapped in several pieces, one after the other: opened once. */
static int give_file(const struct remap *r, struct syscall_batch *batch, const struct mapping *m,
		     const struct mapping **given, struct avc_error *err)
{
	int fd, result;

	if (m && *given && m->device == (*given)->device && m->inode == (*given)->inode &&
	    !m->shared && !(*given)->shared)
		return 0;
	if (*given && syscall_batch_ask(batch, SYS_close, 1, 0, 0, 0, 0, 0, err))
		return -1;
	*given = m;
	if (!m)
		return 0;
	fd = open_mapped(r->want->template, m);
	if (fd < 0)
		return fail_errno(err, batch->pid, "restore memory", "open(map_files)",
				  "%s can not be opened", m->name);
	result = syscall_batch_give(batch, fd, err);
	close(fd);
	return result;
}

static bool is_sysv(const struct mapping *m)
{
	return m->shared && !strncmp(m->name, "/SYSV", 5);
}

/* All of a segment, and not a part that is protected otherwise. */
static bool is_whole(pid_t template, const struct piece *piece)
{
	const struct mapping *m = piece->want;
	struct stat st = { 0 };
	int fd = open_mapped(template, m);

	if (fd < 0 || fstat(fd, &st))
		st.st_size = 0;
	close_fd(&fd);
	return !m->offset && piece->start == m->start && piece->end == m->end &&
	       ((uint64_t)st.st_size + PAGE - 1) / PAGE == (m->end - m->start) / PAGE;
}

/* In the place of what has been mapped, or shmdt(2) would not know it.  Who may not attach it any
 * more keeps that.  Its inode has the number of the segment (ipc/shm.c, newseg()). */
static int attach(const struct remap *r, struct syscall_batch *batch, const struct piece *piece,
		  struct avc_error *err)
{
	static const char only_mapped[] =
		"System V shared memory is only mapped: it can not be detached";
	const struct mapping *m = piece->want;
	int flags = SHM_REMAP | (m->mode[2] == 'x' ? SHM_EXEC : 0);

	if (!is_sysv(m))
		return 0;
	if (!is_whole(r->want->template, piece)) {
		fail(batch->notes, AVC_UNSUPPORTED, 0, batch->inside, "restore", "", "%s",
		     only_mapped);
		return 0;
	}
	if (!proc_mapped_for_writing(r->want->template, m->start, m->end))
		flags |= SHM_RDONLY;
	if (syscall_batch_ask(batch, SYS_shmat, m->inode, m->start, (uint64_t)flags, 0, 0, 0, err))
		return -1;
	syscall_batch_soften(batch, only_mapped);
	return syscall_batch_ask(batch, SYS_mprotect, m->start, m->end - m->start,
				 (uint64_t)mapping_protection(m), 0, 0, 0, err) ||
			       syscall_batch_flush(batch, err)
		       ? -1
		       : 0;
}

static int map_piece(const struct remap *r, struct syscall_batch *batch, const struct piece *piece,
		     const struct mapping **given, struct avc_error *err)
{
	const struct mapping *m = piece->want;
	const uint64_t bytes = piece->end - piece->start, prot = (uint64_t)mapping_protection(m);
	const int flags = MAP_FIXED |
			  (m->shared                      ? MAP_SHARED
			   : m->flags & MAPPING_DROPPABLE ? DROPPABLE
							  : MAP_PRIVATE | MAP_NORESERVE);
	const int growing = kind_of(m) & MAPPING_GROWING ? MAP_GROWSDOWN : 0;

	if (!is_file(m))
		return syscall_batch_ask(batch, SYS_mmap, piece->start, bytes, prot,
					 (uint64_t)(flags | MAP_ANONYMOUS | growing), (uint64_t)-1,
					 0, err);
	return give_file(r, batch, m, given, err) ||
			       syscall_batch_ask(batch, SYS_mmap, piece->start, bytes, prot,
						 (uint64_t)flags, 1,
						 m->offset + (piece->start - m->start), err) ||
			       attach(r, batch, piece, err)
		       ? -1
		       : 0;
}

static int protect_piece(struct syscall_batch *batch, const struct piece *piece,
			 struct avc_error *err)
{
	const struct mapping *want = piece->want;
	const uint64_t mode = (uint64_t)mapping_protection(want), bytes = piece->end - piece->start;
	const uint32_t key = key_of(want);

	/* Without keys, pkey_mprotect(2) may not know key 0 either. */
	if (!key && (!piece->is || !key_of(piece->is)))
		return syscall_batch_ask(batch, SYS_mprotect, piece->start, bytes, mode, 0, 0, 0,
					 err);
	/* What can only be executed has a key that the kernel took (pkeys(7)).  Where this process
	 * has inherited such a key the first call sets it, and the second is refused; where it has
	 * not, no key is free to be taken (process_attrs_take_keys), and the second call sets it. */
	if (mode == PROT_EXEC &&
	    syscall_batch_ask(batch, SYS_mprotect, piece->start, bytes, mode, 0, 0, 0, err))
		return -1;
	if (syscall_batch_ask(batch, SYS_pkey_mprotect, piece->start, bytes, mode, key, 0, 0, err))
		return -1;
	if (mode == PROT_EXEC)
		syscall_batch_soften(batch, NULL);
	return 0;
}

/* What it maps has to be there before it is filled; all else can wait for the next calls. */
static int map_new(const struct remap *r, struct syscall_batch *batch, struct avc_error *err)
{
	const struct mapping *given = NULL;
	bool changed = false;

	for (uint32_t i = 0; i < r->pieces; i++) {
		const struct piece *piece = &r->piece[i];

		if (!piece->want || (piece->kept && same_protection(piece->is, piece->want)))
			continue;
		changed = true;
		if (!piece->kept && map_piece(r, batch, piece, &given, err))
			return -1;
		if ((piece->kept || key_of(piece->want)) && protect_piece(batch, piece, err))
			return -1;
	}
	return give_file(r, batch, NULL, &given, err) ||
			       (changed && syscall_batch_flush(batch, err))
		       ? -1
		       : 0;
}

/* ---- pages -------------------------------------------------------------------------- */

#define PAGEMAP_PRESENT (UINT64_C(1) << 63)
#define PAGEMAP_SWAPPED (UINT64_C(1) << 62)
#define PAGEMAP_FILE (UINT64_C(1) << 61)
#define PAGEMAP_GUARD (UINT64_C(1) << 58) /* since Linux 6.15                   */
#define PAGEMAP_FRAME ((UINT64_C(1) << 55) - 1)
/* Where it stands in the page table: a swap entry of the last type, which is none, with
 * PTE_MARKER_GUARD (include/linux/swapops.h) for an offset. */
#define GUARD_MARKER (UINT64_C(4) << 5 | 31)
/* MADV_GUARD_INSTALL, MADV_GUARD_REMOVE; the headers may be older. */
#define GUARD_INSTALL 102
#define GUARD_REMOVE 103

/* A guard page without a mapping of its own (madvise(2), Linux 6.13). */
static bool is_guard(uint64_t frame)
{
	return frame & PAGEMAP_GUARD ||
	       (frame & (PAGEMAP_PRESENT | PAGEMAP_SWAPPED | PAGEMAP_FRAME)) ==
		       (PAGEMAP_SWAPPED | GUARD_MARKER);
}

static bool is_own(uint64_t frame)
{
	return frame & (PAGEMAP_PRESENT | PAGEMAP_SWAPPED) && !(frame & PAGEMAP_FILE);
}

/* Of a private mapping.  What is of a file is there by itself. */
static enum page compare(uint64_t want, uint64_t is)
{
	if (is_guard(want))
		return is_guard(is) ? PAGE_SAME : PAGE_GUARD;
	if (is_guard(is))
		return is_own(want) ? PAGE_OPEN_COPY : PAGE_OPEN;
	if (!is_own(want))
		return is_own(is) ? PAGE_DROP : PAGE_SAME;
	if (is_own(is) && want & PAGEMAP_FRAME &&
	    !((want ^ is) & (PAGEMAP_FRAME | PAGEMAP_PRESENT | PAGEMAP_SWAPPED)))
		return PAGE_SAME;
	return PAGE_COPY;
}

static int add_run(struct remap *r, const struct mapping *m, enum page what, avc_remote start,
		   avc_remote end, struct avc_error *err)
{
	const bool plain = m->mode[0] == 'r' && m->mode[1] == 'w';
	struct run *last = r->runs ? &r->run[r->runs - 1] : NULL;

	if (last && last->what == what && last->end == start && last->plain == plain) {
		last->end = end;
		return 0;
	}
	if (!make_room(&r->run, r->runs, &r->room, sizeof *r->run))
		return fail_errno(err, 0, "restore memory", "realloc", "out of memory");
	r->run[r->runs++] = (struct run){ start, end, what, plain };
	return 0;
}

static int compare_piece(struct remap *r, const struct piece *piece, struct avc_error *err)
{
	static const struct pages nothing;
	const struct pages *wanted = snapshot_pages(r->want, piece->want, err);
	const struct pages *had = piece->kept ? snapshot_pages(r->is, piece->is, err) : &nothing;
	uint32_t next_wanted = 0, next_had = 0;

	if (!wanted || !had)
		return -1;
	for (avc_remote start = piece->start, end; start < piece->end; start = end) {
		const uint64_t *want, *is;

		end = piece->end;
		want = pages_frames(wanted, &next_wanted, start, &end);
		is = pages_frames(had, &next_had, start, &end);
		if (!want && !is)
			continue;
		for (size_t i = 0, count = (end - start) / PAGE; i < count; i++) {
			const avc_remote page = start + i * PAGE;
			const enum page what = compare(want ? want[i] : 0, is ? is[i] : 0);

			if (what != PAGE_SAME &&
			    add_run(r, piece->want, what, page, page + PAGE, err))
				return -1;
		}
	}
	return 0;
}

static int advice_of(enum page what)
{
	switch (what) {
	case PAGE_DROP:
		return MADV_DONTNEED;
	case PAGE_GUARD:
		return GUARD_INSTALL;
	case PAGE_OPEN:
	case PAGE_OPEN_COPY:
		return GUARD_REMOVE;
	default:
		return 0;
	}
}

static int fill(const struct remap *r, struct syscall_batch *batch, struct copier *copier,
		struct avc_error *err)
{
	bool opened = false;

	if (copier_open(copier, r->want->template, batch->pid, err))
		return -1;
	for (uint32_t i = 0; i < r->runs; i++) {
		const struct run *run = &r->run[i];
		const int advice = advice_of(run->what);

		opened = opened || run->what == PAGE_OPEN_COPY;
		if (advice &&
		    syscall_batch_ask(batch, SYS_madvise, run->start, run->end - run->start,
				      (uint64_t)advice, 0, 0, 0, err))
			return -1;
	}
	/* Nothing can be written where a guard page still is. */
	if (opened && syscall_batch_flush(batch, err))
		return -1;
	for (uint32_t i = 0; i < r->runs; i++) {
		const struct run *run = &r->run[i];

		if ((run->what == PAGE_COPY || run->what == PAGE_OPEN_COPY) &&
		    copier_add(copier, run->start, run->end, run->plain, err))
			return -1;
	}
	return 0;
}

/* ---- all of it ----------------------------------------------------------------------- */

struct remap *remap_plan(const struct target *target, struct snapshot *want, struct snapshot *is,
			 struct avc_error *err)
{
	struct remap *r = calloc(1, sizeof *r);

	if (!r) {
		fail_errno(err, 0, "restore memory", "calloc", "out of memory");
		return NULL;
	}
	*r = (struct remap){ .target = target, .want = want, .is = is };
	if (cut(r, err))
		goto failed;
	for (uint32_t i = 0; i < r->pieces; i++) {
		const struct piece *piece = &r->piece[i];

		if (piece->want && !piece->want->shared && compare_piece(r, piece, err))
			goto failed;
	}
	return r;
failed:
	remap_free(r);
	return NULL;
}

/* mseal(2): nobody takes it away or protects it otherwise, not in a fork either. */
static bool is_stuck(const struct piece *piece)
{
	return piece->is && piece->is->flags & MAPPING_SEALED &&
	       (!piece->kept || !same_protection(piece->is, piece->want));
}

static bool is_lost(const struct piece *piece)
{
	return piece->want && piece->want->flags & MAPPING_ONLY_HERE && !piece->kept;
}

int remap_check(const struct target *target, struct snapshot *want, struct snapshot *is,
		struct avc_error *err)
{
	struct remap r = { .target = target, .want = want, .is = is };
	const struct mapping *a = find_special(&is->maps, "[vdso]");
	const struct mapping *b = find_special(&want->maps, "[vdso]");
	int result = cut(&r, err);

	if (!result && a && b && a->flags & MAPPING_SEALED && a->start != b->start)
		result = fail(err, AVC_UNSUPPORTED, 0, target->pid, "keep memory", "",
			      "process %d has executed another program, and the kernel seals its "
			      "vDSO (mseal(2))",
			      target->inside);
	for (uint32_t i = 0; !result && i < r.pieces; i++) {
		if (is_lost(&r.piece[i]))
			result = fail(err, AVC_UNSUPPORTED, 0, target->pid, "keep memory", "",
				      "process %d has mapped what no other process can map: %s",
				      target->inside, r.piece[i].want->name);
		else if (is_stuck(&r.piece[i]))
			result = fail(err, AVC_UNSUPPORTED, 0, target->pid, "keep memory", "",
				      "process %d has other memory than its parent where that has "
				      "sealed it (mseal(2))",
				      target->inside);
	}
	free(r.piece);
	return result;
}

int remap(const struct remap *r, struct syscall_batch *batch, struct copier *copier,
	  struct avc_error *err)
{
	return unmap(r, batch, err) || move_special(r, batch, err) || map_new(r, batch, err) ||
			       fill(r, batch, copier, err)
		       ? -1
		       : 0;
}

void remap_free(struct remap *r)
{
	if (!r)
		return;
	free(r->piece);
	free(r->run);
	free(r);
}
