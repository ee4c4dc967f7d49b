/* SPDX-License-Identifier: Apache-2.0
 *
 * Memory that a clone does not carry as it is.
 *
 * - MADV_DONTFORK: missing in the clone.  In a process that was found to have such areas they are
 *   looked up while it is stopped, set to MADV_DOFORK right before it is cloned, and to MADV_DONTFORK
 *   right after that, by the process's own main thread, which does so even if the guard dies in
 *   between. (Not possible for device memory, nor on new kernels, seen on 7.3, for huge pages.)
 * - MADV_WIPEONFORK: zeroes in the clone (memory_wiped.c).
 * - Shared memory of the app alone: not copied by a clone.  Read while the app is stopped, up to a
 *   limit, and written back at a restore; once for all processes of the app.  With a name
 *   (shm_open(3), memfd_create(2)) other processes may have it as well, which would not be rolled
 *   back with the app: then it is left alone, which is reported.
 * - Locked memory: not locked in the clone.
 *
 * The areas of these kinds are known from the previous template; whether they are still right is
 * checked in the new template, when the app runs again.  If not, the checkpoint is taken once more.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/auxv.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "memory.h"

#define MSEAL 462 /* mseal(2), since Linux 6.10; the headers may be older */

const char *memory_refuses(const struct mapping *m)
{
	if (!strncmp(m->name, "/[aio]", 6))
		return "it uses kernel AIO (most programs do without: avckpt.io_uring=off)";
	/* Its descriptor may be closed. */
	if (!strncmp(m->name, "anon_inode:[io_uring]", 21))
		return "it uses io_uring (most programs do without: avckpt.io_uring=off)";
	/* The pool of these is small, and a process that writes to a shared one when it is empty is
	 * killed.  Those of files are found in the first clone, by the flag. */
	if (!m->shared &&
	    (m->flags & MAPPING_HUGETLB || (!m->offset && !strncmp(m->name, "/anon_hugepage", 14))))
		return "it has private huge pages (hugetlb): a clone shares them, and the "
		       "application could be killed for want of another when it writes to one";
	return NULL;
}

struct memory *memory_new(void)
{
	return calloc(1, sizeof(struct memory));
}

void memory_forget(struct memory *memory)
{
	areas_free(&memory->areas);
	areas_free(&memory->foreign);
	areas_free(&memory->unkept);
	free(memory->unforked_at);
	*memory = (struct memory){ 0 };
}

void memory_free(struct memory *memory)
{
	if (memory)
		memory_forget(memory);
	free(memory);
}

void mem_image_free(struct mem_image *image)
{
	if (!image)
		return;
	areas_free(&image->areas);
	wiped_free(&image->wiped);
	free(image);
}

uint32_t mem_image_marks(const struct mem_image *image, avc_remote address)
{
	for (uint32_t i = 0; image && i < image->kinds.count; i++)
		if (image->kinds.area[i].start <= address && address < image->kinds.area[i].end)
			return image->kinds.area[i].flags;
	return 0;
}

bool mem_image_has(const struct mem_image *image, enum mapping_flag flag)
{
	for (uint32_t i = 0; image && i < image->kinds.count; i++)
		if (image->kinds.area[i].flags & flag)
			return true;
	return false;
}

bool mem_image_is_special(const struct mem_image *image)
{
	return image && image->special;
}

uint64_t mem_image_kinds(const struct mem_image *image)
{
	uint64_t h = UINT64_C(0xcbf29ce484222325);

	for (uint32_t i = 0; i < image->kinds.count; i++) {
		const uint32_t flags = image->kinds.area[i].flags;
		/* The start of a stack changes as it grows. */
		const uint64_t part[] = {
			flags & MAPPING_GROWING ? 0 : image->kinds.area[i].start,
			image->kinds.area[i].end,
			flags,
		};

		for (size_t k = 0; k < sizeof part / sizeof *part; k++)
			h = (h ^ part[k]) * UINT64_C(0x100000001b3);
	}
	return h;
}

/* ---- before and during a freeze ------------------------------------------------ */

/* Its index in the table, or where to insert it. */
static struct mem_key *find_key(const struct mem_seen *seen, const struct mem_key *key)
{
	uint64_t at = (key->inode * 31 + key->offset) * UINT64_C(0x9E3779B97F4A7C15) >> 32;

	for (;; at++) {
		struct mem_key *k = &seen->key[at & (seen->room - 1)];

		if (!k->bytes || !memcmp(k, key, sizeof *k))
			return k;
	}
}

static bool make_seen_room(struct mem_seen *seen)
{
	struct mem_seen more = { .room = seen->room ? 2 * seen->room : 64 };

	if (2 * seen->count < seen->room)
		return true;
	more.key = calloc(more.room, sizeof *more.key);
	if (!more.key)
		return false;
	for (uint32_t i = 0; i < seen->room; i++)
		if (seen->key[i].bytes)
			*find_key(&more, &seen->key[i]) = seen->key[i];
	free(seen->key);
	seen->key = more.key;
	seen->room = more.room;
	return true;
}

void mem_seen_free(struct mem_seen *seen)
{
	free(seen->key);
	leases_free(&seen->leases);
	*seen = (struct mem_seen){ 0 };
}

static struct mem_key key_of(const struct area *a)
{
	return (struct mem_key){ a->device, a->inode, a->offset, area_bytes(a) };
}

bool mem_seen_has(const struct mem_seen *seen, const struct area *a)
{
	const struct mem_key key = key_of(a);

	return seen->room && find_key(seen, &key)->bytes;
}

bool mem_seen_add(struct mem_seen *seen, const struct area *a)
{
	const struct mem_key key = key_of(a);

	if (!make_seen_room(seen))
		return false;
	*find_key(seen, &key) = key;
	seen->count++;
	seen->shared_bytes += key.bytes;
	return true;
}

/* Whether an image gets its contents: once for all processes, and within the limit. */
static int see(struct mem_seen *seen, struct area *a, uint64_t limit, struct avc_error *err)
{
	a->again = a->left = false;
	if (a->wiped)
		return 0;
	a->again = mem_seen_has(seen, a);
	a->left = !a->again && seen->shared_bytes + area_bytes(a) > limit;
	if (!a->again && !a->left && !mem_seen_add(seen, a))
		return fail_memory(err, 0, "keep memory");
	return 0;
}

/* In an image. */
static size_t area_room(const struct area *a)
{
	return a->wiped || a->again || a->left ? 0 : area_bytes(a);
}

int memory_prepare(const struct process *process, struct mem_image **image, struct mem_seen *seen,
		   struct avc_error *err)
{
	const struct areas *areas = &process->memory->areas;
	uint64_t left_bytes = 0;
	size_t bytes = 0;

	*image = NULL;
	for (uint32_t i = 0; i < areas->count; i++) {
		struct area *a = &areas->area[i];

		if (see(seen, a, process->shm_bytes, err))
			return -1;
		bytes += area_room(a);
		left_bytes += a->left ? area_bytes(a) : 0;
	}
	*image = malloc(sizeof **image + bytes);
	if (!*image)
		return fail_memory(err, 0, "keep memory");
	/* Touch all of it: page faults now, not in the freeze. */
	memset(*image, 0, sizeof **image + bytes);
	(*image)->whole = true;
	(*image)->seen = seen;
	(*image)->bytes = bytes;
	(*image)->left_bytes = left_bytes;
	if (!areas_copy(&(*image)->areas, areas))
		return fail_memory(err, 0, "keep memory");
	return 0;
}

/* System V memory has no descriptors that fcntl(2) could be called with. */
static bool can_be_leased(const struct area *a)
{
	return a->named && a->device == area_device(a);
}

void memory_note_leases(const struct process *process, struct mem_seen *seen)
{
	const struct areas *areas = &process->memory->areas;
	bool any = false;

	for (uint32_t i = 0; !any && i < areas->count; i++)
		any = can_be_leased(&areas->area[i]);
	if (any)
		leases_read(&seen->leases);
}

static bool is_area(int path_fd, struct area *a)
{
	struct statx st;

	if (!fd_look(path_fd, STATX_INO | STATX_NLINK, &st) || st.stx_ino != a->inode ||
	    device_of(&st) != area_device(a))
		return false;
	a->linked = a->as_file && st.stx_nlink;
	return true;
}

/* Reads through the mapped file, if it still is the one that was found to be memory.  No single
 * process may have all of its pages mapped, and reading through /proc/PID/mem would allocate those
 * never written. */
static bool copy_area(pid_t pid, struct area *a, uint8_t *to, struct mem_image *image)
{
	const struct mapping m = { .device = area_device(a), .inode = a->inode };
	int path_fd = proc_open_mapped(pid, a->start, a->end, O_PATH), fd = -1;
	ssize_t n = -1;

	if (path_fd >= 0 && is_area(path_fd, a)) {
		fd = open_to_read(path_fd, &m, can_be_leased(a) ? &image->seen->leases : NULL);
		image->leased |= fd < 0 && errno == EBUSY;
	}
	if (fd >= 0)
		n = read_whole(fd, to, area_bytes(a), (off_t)a->offset);
	close_fd(&path_fd);
	close_fd(&fd);
	a->kept = n > 0 ? (size_t)n : 0;
	return n >= 0;
}

void memory_copy_own(const struct process *process, struct mem_image *image)
{
	wiped_copy(process, image);
}

void memory_copy_shared(const struct process *process, struct mem_image *image)
{
	uint8_t *to = image->data;

	for (uint32_t i = 0; i < image->areas.count; i++) {
		struct area *a = &image->areas.area[i];

		if (!area_room(a))
			continue;
		/* Before it is read: what is written meanwhile counts as written since. */
		if (a->as_file)
			a->writes = mem_others_writes(process->others, a);
		image->whole &= budget_step() && copy_area(process->pid, a, to, image);
		to += area_room(a);
	}
}

bool memory_needs_fork(const struct process *process)
{
	const struct memory *memory = process->memory;

	for (uint32_t i = 0; i < memory->areas.count; i++)
		if (memory->areas.area[i].wiped)
			return true;
	for (uint32_t i = 0; i < memory->kinds.count; i++)
		if (memory->kinds.area[i].flags & (MAPPING_KEYS | MAPPING_TAGGED))
			return true;
	return memory->dontfork || memory->grows || memory->receives;
}

/* ---- mappings, from /proc ------------------------------------------------------------ */

/* Mappings of drivers, and huge pages.  Whether the kernel refuses shows on our own vDSO, which is
 * one. */
static bool minds_fixed(void)
{
	static int minds = -1;

	if (__atomic_load_n(&minds, __ATOMIC_RELAXED) < 0) {
		void *vdso = (void *)getauxval(AT_SYSINFO_EHDR);

		__atomic_store_n(&minds, vdso && madvise(vdso, ARCH_PAGE_BYTES, MADV_DOFORK),
				 __ATOMIC_RELAXED);
	}
	return minds;
}

/* MADV_DOFORK is refused (mm/madvise.c: VM_IO; on 7.3 all of VM_SPECIAL). */
static bool keeps_dontfork(const struct mapping *m)
{
	return m->flags & MAPPING_DEVICE || (m->flags & MAPPING_FIXED && minds_fixed());
}

struct dontfork {
	struct memory *memory;
	bool found, kept, too_many;
};

static int find_dontfork(const struct mapping *m, void *arg)
{
	struct dontfork *look = arg;
	struct memory *memory = look->memory;
	struct stretch *last = memory->unforked ? &memory->unforked_at[memory->unforked - 1] : NULL;

	if (!(m->flags & MAPPING_DONTFORK) || m->start >= ARCH_USER_END)
		return 0;
	if (keeps_dontfork(m)) {
		look->kept = true;
		return 0;
	}
	look->found = true;
	if (last && last->end == m->start) {
		last->end = m->end;
		return 0;
	}
	if (memory->unforked == DONTFORK_MAX) {
		look->too_many = true;
		return -1;
	}
	memory->unforked_at[memory->unforked++] = (struct stretch){ m->start, m->end };
	return 0;
}

static int look_for_dontfork(struct process *process, struct dontfork *look, struct avc_error *err)
{
	struct memory *memory = process->memory;

	look->memory = memory;
	memory->unforked = 0;
	if (!memory->unforked_at)
		memory->unforked_at = calloc(DONTFORK_MAX, sizeof *memory->unforked_at);
	if (!memory->unforked_at)
		return fail_memory(err, process->pid, "look at memory");
	if (proc_mappings(process->pid, "smaps", find_dontfork, look))
		return fail_errno(err, process->pid, "look at memory", "read(smaps)",
				  "it has ended");
	if (look->too_many)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "look at memory", "",
			    "more than %d stretches of its memory are not inherited by a clone "
			    "(MADV_DONTFORK)",
			    DONTFORK_MAX);
	return 0;
}

int memory_find_unforked(struct process *process, struct avc_error *err)
{
	struct dontfork look = { 0 };

	return process->memory->dontfork ? look_for_dontfork(process, &look, err) : 0;
}

/* The list uses the memory of the restore's lists. */
void memory_advise(const struct process *process, uint32_t slot, int advice, struct inj_call *call)
{
	const struct memory *memory = process->memory;
	const uint32_t first = advice == MADV_DOFORK ? 0 : DONTFORK_MAX;
	struct inj_syscall *list = (struct inj_syscall *)(parasite_files(&process->parasite, slot) +
							  INJ_FILES_BYTES / 2) +
				   first;

	_Static_assert(2 * DONTFORK_MAX * sizeof *list <= INJ_FILES_BYTES / 2, "room for lists");
	for (uint32_t i = 0; i < memory->unforked; i++)
		list[i] = (struct inj_syscall){
			.nr = SYS_madvise,
			.arg = { memory->unforked_at[i].start,
				 memory->unforked_at[i].end - memory->unforked_at[i].start,
				 (uint64_t)advice },
		};
	if (memory->unforked)
		call_add(call, INJ_LIST, parasite_remote(&process->parasite, list),
			 memory->unforked);
}

bool memory_is_unforked(const struct memory *memory)
{
	return memory->unforked > 0;
}

int memory_learn(struct process *process, long missing_pages, struct avc_error *err)
{
	struct memory *memory = process->memory;
	struct dontfork look = { 0 };
	const bool known = memory->unforked > 0;

	if (look_for_dontfork(process, &look, err))
		return -1;
	memory->dontfork = known || look.found;
	if (look.kept)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
			    "it uses memory of a device, or huge pages, which a clone does not "
			    "inherit (MADV_DONTFORK)");
	if (!memory->dontfork)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
			    "%ld kB of its memory are not inherited by a clone",
			    missing_pages * ARCH_PAGE_BYTES / 1024);
	return fail(err, AVC_RETRY, 0, process->pid, "keep template", "",
		    "%ld kB of its memory are not inherited by a clone yet (MADV_DONTFORK)",
		    missing_pages * ARCH_PAGE_BYTES / 1024);
}

/* ---- when the app runs again ------------------------------------------------------------- */

static int find_locked(const struct mapping *m, void *arg)
{
	marks_add(arg, m, m->flags & MAPPING_LOCKED);
	return 0;
}

/* Pages become locked as they are touched (MLOCK_ONFAULT): faulting them all in at once would copy
 * all that memory before the process may run. */
static void lock_again(struct process *process, int64_t locked_kb, struct setup *setup)
{
	struct memory *memory = process->memory;
	const uint64_t start = now_ns();

	if (locked_kb == 0)
		memory->locked.count = 0;
	if (locked_kb > 0 &&
	    (locked_kb != memory->locked_kb || memory->layout != memory->locked_layout ||
	     start - memory->locked_read_ns > memory->locked_cost_ns * SMAPS_SHARE)) {
		struct marks found = { 0 };

		/* A process that has just died shows nothing any more; what was known is usually
		 * right. */
		if (proc_mappings(process->pid, "smaps", find_locked, &found) == 0 && found.count) {
			memory->locked = found;
			memory->locked_kb = locked_kb;
			memory->locked_layout = memory->layout;
		}
		memory->locked_read_ns = now_ns();
		memory->locked_cost_ns = memory->locked_read_ns - start;
	}
	for (uint32_t i = 0; i < memory->locked.count; i++)
		setup_add(setup, INJ_BEFORE, "mlock2", SYS_mlock2, memory->locked.area[i].start,
			  memory->locked.area[i].end - memory->locked.area[i].start, MLOCK_ONFAULT)
			->flags = INJ_MAY_FAIL;
}

static const struct {
	uint32_t flag;
	int advice;
} advices[] = {
	{ MAPPING_HUGE, MADV_HUGEPAGE },
	{ MAPPING_SMALL, MADV_NOHUGEPAGE },
	{ MAPPING_DONTDUMP, MADV_DONTDUMP },
	{ MAPPING_MERGEABLE, MADV_MERGEABLE },
};

static void advise_again(const struct memory *memory, struct setup *setup)
{
	for (uint32_t i = 0; i < memory->advised.count; i++)
		for (size_t k = 0; k < sizeof advices / sizeof *advices; k++)
			if (memory->advised.area[i].flags & advices[k].flag)
				setup_add(setup, INJ_BEFORE, "madvise", SYS_madvise,
					  memory->advised.area[i].start,
					  memory->advised.area[i].end -
						  memory->advised.area[i].start,
					  (uint64_t)advices[k].advice)
					->flags = INJ_MAY_FAIL;
}

/* After everything is mapped and advised.  Mappings sealed by the kernel
 * (CONFIG_MSEAL_SYSTEM_MAPPINGS) are inherited by fork; Podman's seccomp profile may lack
 * mseal(2). */
static void seal_again(const struct memory *memory, struct setup *setup)
{
	for (uint32_t i = 0; i < memory->kinds.count; i++)
		if ((memory->kinds.area[i].flags & (MAPPING_SEALED | MAPPING_SPECIAL)) ==
		    MAPPING_SEALED)
			setup_add(setup, INJ_BEFORE, "mseal", MSEAL, memory->kinds.area[i].start,
				  memory->kinds.area[i].end - memory->kinds.area[i].start)
				->flags = INJ_MAY_FAIL;
}

int memory_finish(struct image *image, int64_t locked_kb, struct setup *setup,
		  struct avc_error *err)
{
	struct process *process = image->process;
	const struct thread *main_thread = thread_find(process, process->pid);

	image->memory->seen = NULL; /* it was the freeze's                  */
	if (areas_check(image, err) || wiped_fill(image, setup, err))
		return -1;
	for (uint32_t i = 0; i < process->memory->unforked; i++)
		setup_add(setup, INJ_BEFORE, "madvise", SYS_madvise,
			  process->memory->unforked_at[i].start,
			  process->memory->unforked_at[i].end -
				  process->memory->unforked_at[i].start,
			  MADV_DONTFORK)
			->flags = INJ_MAY_FAIL;
	lock_again(process, locked_kb, setup);
	advise_again(process->memory, setup);
	if (process->descendant || image->recycled)
		seal_again(process->memory, setup);
	if (main_thread && main_thread->creds.future_lock)
		setup_add(setup, INJ_AFTER, "mlockall", SYS_mlockall,
			  (uint64_t)main_thread->creds.future_lock)
			->flags = INJ_MAY_FAIL;
	if (process->memory->others_bytes && !setup->notice.code)
		fail(&setup->notice, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
		     "%llu KiB of shared memory are also others', outside of the container, and are not rolled back",
		     (unsigned long long)process->memory->others_bytes / 1024);
	return 0;
}

void memory_note_left(const struct image *image, uint32_t images, struct avc_error *notice)
{
	uint64_t left_bytes = 0;

	for (uint32_t i = 0; i < images; i++)
		if (image[i].process)
			left_bytes += image[i].process->memory->left_bytes +
				      image[i].memory->left_bytes;
	if (left_bytes)
		fail(notice, AVC_UNSUPPORTED, 0, image->process->pid, "keep memory", "",
		     "avckpt.shm has no room for %llu KiB of shared memory, which are not rolled back",
		     (unsigned long long)left_bytes / 1024);
}

/* Whether it equals the image, read from the memory of a process. */
static bool is_equal(int mem_fd, const struct area *a, const uint8_t *image)
{
	uint8_t page[ARCH_PAGE_BYTES];

	for (size_t at = 0, bytes; at < a->kept; at += bytes) {
		bytes = a->kept - at < sizeof page ? a->kept - at : sizeof page;
		if (pread(mem_fd, page, bytes, (off_t)(a->start + at)) != (ssize_t)bytes ||
		    memcmp(page, image + at, bytes) != 0)
			return false;
	}
	return true;
}

/* What was sealed at the checkpoint has not changed. */
static int note_unless_equal(const struct area *a, int mem_fd, const uint8_t *from,
			     struct avc_error *notes)
{
	if (!is_equal(mem_fd, a, from))
		fail(notes, AVC_UNSUPPORTED, EPERM, 0, "restore", "write",
		     "%zu KiB of shared memory have been sealed or cut since, and are not rolled back",
		     area_bytes(a) / 1024);
	return 0;
}

/* The template has it at the same address, mapped as at the checkpoint. */
static bool put_by_mapping(const struct area *a, int mem_fd, const uint8_t *from)
{
	return pwrite(mem_fd, from, a->kept, (off_t)a->start) == (ssize_t)a->kept;
}

/* One restore. */
struct putting {
	const struct image *image;
	pid_t pid;
	int mem_fd; /* of the template                                        */
	struct avc_error *notes;
};

static int protect(const struct image *image, const struct area *a, int protection,
		   struct avc_error *err)
{
	const struct parasite *parasite = &image->process->parasite;
	struct inj_call *call = &parasite_slot(parasite, image->slot)->template_call;

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_mprotect, a->start, area_bytes(a), (uint64_t)protection);
	return parasite_send(parasite, image->template, &image->base, call, err) ||
			       parasite_run(image->template, call, err)
		       ? -1
		       : 0;
}

static bool put_by_file(const struct area *a, pid_t pid, const uint8_t *from)
{
	const int number = area_find_descriptor(pid, a);
	int pidfd = number < 0 ? -1 : proc_pidfd_open(pid);
	int fd = pidfd < 0 ? -1 : proc_borrow_fd(pidfd, number);
	const bool put = fd >= 0 && pwrite(fd, from, a->kept, (off_t)a->offset) == (ssize_t)a->kept;

	close_fd(&fd);
	close_fd(&pidfd);
	return put;
}

static int put_back(const struct putting *putting, struct area *a, const uint8_t *from,
		    struct avc_error *err)
{
	struct mem_others *others = putting->image->process->others;
	const bool opened = a->way == WAY_PROTECT;
	bool put = false;

	if (a->as_file && mem_others_writes(others, a) != a->writes) {
		fail(putting->notes, AVC_UNSUPPORTED, 0, putting->pid, "restore", "",
		     "%zu KiB of shared memory have been written as files since, and are not rolled back",
		     area_bytes(a) / 1024);
		return 0;
	}
	if (opened && protect(putting->image, a, PROT_READ | PROT_WRITE, err))
		return -1;
	if (a->way != WAY_FILE)
		put = put_by_mapping(a, putting->mem_fd, from);
	if (opened && protect(putting->image, a, a->protection, err))
		return -1;
	if (!put) {
		put = put_by_file(a, putting->pid, from);
		if (a->as_file) /* that was our own write */
			a->writes = mem_others_writes(others, a);
	}
	return put ? 0 : note_unless_equal(a, putting->mem_fd, from, putting->notes);
}

int memory_check_names(const struct image *image, const char *files, struct avc_error *err)
{
	const struct mem_image *memory = image->memory;

	for (uint32_t i = 0; memory && i < memory->areas.count; i++) {
		const struct area *a = &memory->areas.area[i];
		char link[48], name[256];
		struct statx st;

		(void)budget_step();
		snprintf(link, sizeof link, "map_files/%lx-%lx", (unsigned long)a->start,
			 (unsigned long)a->end);
		if (a->linked && proc_look(image->template, link, STATX_NLINK, &st) &&
		    !st.stx_nlink && !proc_link(image->template, link, name, sizeof name))
			return fail(err, AVC_UNSUPPORTED, 0, 0, "restore", "",
				    "avckpt.files=%s: the shared memory %.60s was deleted since "
				    "the checkpoint",
				    files, name);
	}
	return 0;
}

int memory_put_back(const struct image *image, pid_t pid, struct avc_error *notes,
		    struct avc_error *err)
{
	struct putting putting = { .image = image, .pid = pid, .notes = notes };
	struct mem_image *memory = image->memory;
	const uint8_t *from = memory ? memory->data : NULL;
	int result = 0;

	if (!memory || !memory->bytes)
		return 0;
	putting.mem_fd = proc_open(image->template, "mem", O_RDWR);
	if (putting.mem_fd < 0)
		return fail_errno(err, image->template, "restore", "open(mem)", "it was killed");
	for (uint32_t i = 0; !result && i < memory->areas.count; i++) {
		struct area *a = &memory->areas.area[i];

		(void)budget_step();
		if (area_room(a) && a->kept)
			result = put_back(&putting, a, from, err);
		from += area_room(a);
	}
	close_fd(&putting.mem_fd);
	return result;
}
