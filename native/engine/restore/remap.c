/* SPDX-License-Identifier: Apache-2.0
 *
 * The memory of a process that its restored parent has forked: turned from the parent's into that
 * of the template, by the plan of checkpoint/remap_plan.c.
 */
#include <fcntl.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/shm.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "remap.h"
#include "restore.h"

#define DROPPABLE 0x08 /* MAP_DROPPABLE, since Linux 6.11; the headers may be older */

static int unmap(const struct remap *r, struct syscall_batch *batch, struct avc_error *err)
{
	for (uint32_t i = 0; i < r->pieces; i++) {
		const uint32_t first = i;

		if (!r->piece[i].is || r->piece[i].kept)
			continue;
		while (i + 1 < r->pieces && r->piece[i + 1].start == r->piece[i].end &&
		       r->piece[i + 1].is && !r->piece[i + 1].kept)
			i++;
		if (syscall_batch_ask(batch, err, SYS_munmap, r->piece[first].start,
				      r->piece[i].end - r->piece[first].start))
			return -1;
	}
	return 0;
}

/* After execve(2) the vDSO is at another address.  Moved by way of a range that is unused in both:
 * behind the parasite. */
static int move_special(const struct remap *r, struct syscall_batch *batch, struct avc_error *err)
{
	static const char *const names[] = { "[vvar]", "[vvar_vclock]", "[vdso]" };
	avc_remote between = r->process->parasite.base + r->process->parasite.bytes + PAGE;

	for (int away = 1; away >= 0; away--)
		for (size_t i = 0; i < sizeof names / sizeof *names; i++) {
			const struct mapping *a = mappings_find(&r->is->maps, names[i]);
			const struct mapping *b = mappings_find(&r->want->maps, names[i]);
			const uint64_t bytes = a ? a->end - a->start : 0;

			if (!a || (b && a->start == b->start) || (!b && !away))
				continue;
			if (!b) { /* it has unmapped it */
				syscall_batch_add(batch, SYS_munmap, a->start, bytes);
				continue;
			}
			if (b->end - b->start != bytes)
				return fail(err, AVC_UNSUPPORTED, 0, batch->pid, "restore memory",
					    "", "its vDSO is of another size");
			if (away)
				syscall_batch_add(batch, SYS_mremap, a->start, bytes, bytes,
						  MREMAP_MAYMOVE | MREMAP_FIXED, between);
			else
				syscall_batch_add(batch, SYS_mremap, between, bytes, bytes,
						  MREMAP_MAYMOVE | MREMAP_FIXED, b->start);
			between += bytes;
			if (i + 1 == sizeof names / sizeof *names)
				between = r->process->parasite.base + r->process->parasite.bytes +
					  PAGE;
		}
	return 0;
}

/* A descriptor with more rights would allow making shared memory writable that never was; and a
 * file in an overlay would be copied up. */
static int open_mapped(pid_t template, const struct mapping *m)
{
	const int fd = m->shared ? proc_open_mapped(template, m->start, m->end, O_RDWR) : -1;

	return fd >= 0 ? fd : proc_open_mapped(template, m->start, m->end, O_RDONLY);
}

/* Libraries are mapped in several consecutive pieces: opened once. */
static int give_file(const struct remap *r, struct syscall_batch *batch, const struct mapping *m,
		     const struct mapping **given, struct avc_error *err)
{
	int fd, result;

	if (m && *given && m->device == (*given)->device && m->inode == (*given)->inode &&
	    !m->shared && !(*given)->shared)
		return 0;
	if (*given && syscall_batch_ask(batch, err, SYS_close, (uint64_t)batch->given))
		return -1;
	*given = m;
	if (!m)
		return 0;
	fd = open_mapped(r->want->template, m);
	if (fd < 0)
		return fail_errno(err, batch->pid, "restore memory", "open(map_files)",
				  "%s cannot be opened", m->name);
	result = syscall_batch_give(batch, fd, err);
	close(fd);
	return result;
}

static bool is_sysv(const struct mapping *m)
{
	return m->shared && !strncmp(m->name, "/SYSV", 5);
}

/* A whole segment, not a part with other protection. */
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

/* In place of the mapping; otherwise shmdt(2) would not recognize it.  A process that may not
 * attach it any more keeps the mapping.  Its inode number is the segment's id (ipc/shm.c,
 * newseg()). */
static int attach(const struct remap *r, struct syscall_batch *batch, const struct piece *piece,
		  struct avc_error *err)
{
	static const char only_mapped[] =
		"System V shared memory is only mapped: it cannot be detached";
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
	if (syscall_batch_ask(batch, err, SYS_shmat, m->inode, m->start, (uint64_t)flags))
		return -1;
	syscall_batch_soften(batch, only_mapped);
	return syscall_batch_ask(batch, err, SYS_mprotect, m->start, m->end - m->start,
				 (uint64_t)mapping_protection(m)) ||
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
	const int growing = mapping_kind(m) & MAPPING_GROWING ? MAP_GROWSDOWN : 0;

	if (!mapping_is_file(m))
		return syscall_batch_ask(batch, err, SYS_mmap, piece->start, bytes, prot,
					 (uint64_t)(flags | MAP_ANONYMOUS | growing), (uint64_t)-1);
	return give_file(r, batch, m, given, err) ||
			       syscall_batch_ask(batch, err, SYS_mmap, piece->start, bytes, prot,
						 (uint64_t)flags, (uint64_t)batch->given,
						 m->offset + (piece->start - m->start)) ||
			       attach(r, batch, piece, err)
		       ? -1
		       : 0;
}

static int protect_piece(struct syscall_batch *batch, const struct piece *piece,
			 struct avc_error *err)
{
	const struct mapping *want = piece->want;
	const uint64_t mode = (uint64_t)mapping_protection(want), bytes = piece->end - piece->start;
	const uint32_t key = mapping_key(want);

	/* Without protection keys, pkey_mprotect(2) may reject key 0, too. */
	if (!key && (!piece->is || !mapping_key(piece->is)))
		return syscall_batch_ask(batch, err, SYS_mprotect, piece->start, bytes, mode);
	/* Execute-only memory has a key that the kernel allocated (pkeys(7)).  If this process has
	 * inherited such a key, the first call sets it, and the second fails; if not, no key is
	 * free (process_attrs_take_keys), and the second call sets it. */
	if (mode == PROT_EXEC &&
	    syscall_batch_ask(batch, err, SYS_mprotect, piece->start, bytes, mode))
		return -1;
	if (syscall_batch_ask(batch, err, SYS_pkey_mprotect, piece->start, bytes, mode, key))
		return -1;
	if (mode == PROT_EXEC)
		syscall_batch_soften(batch, NULL);
	return 0;
}

static int map_new(const struct remap *r, struct syscall_batch *batch, bool *changed,
		   struct avc_error *err)
{
	const struct mapping *given = NULL;

	for (uint32_t i = 0; i < r->pieces; i++) {
		const struct piece *piece = &r->piece[i];

		if (!piece->want ||
		    (piece->kept && mapping_same_protection(piece->is, piece->want)))
			continue;
		*changed = true;
		if (!piece->kept && map_piece(r, batch, piece, &given, err))
			return -1;
		if ((piece->kept || mapping_key(piece->want)) && protect_piece(batch, piece, err))
			return -1;
	}
	return give_file(r, batch, NULL, &given, err);
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

int remap_map(const struct remap *r, struct syscall_batch *batch, bool *changed,
	      struct avc_error *err)
{
	*changed = false;
	return unmap(r, batch, err) || move_special(r, batch, err) ||
			       map_new(r, batch, changed, err)
		       ? -1
		       : 0;
}

int remap_fill(const struct remap *r, struct syscall_batch *batch, struct copier *copier,
	       struct avc_error *err)
{
	bool opened = false;

	if (copier_open(copier, r->want->template, batch->pid, err))
		return -1;
	for (uint32_t i = 0; i < r->runs; i++) {
		const struct run *run = &r->run[i];
		const int advice = advice_of(run->what);

		opened = opened || run->what == PAGE_OPEN_COPY;
		if (advice && syscall_batch_ask(batch, err, SYS_madvise, run->start,
						run->end - run->start, (uint64_t)advice))
			return -1;
	}
	/* Guard pages cannot be written to. */
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
