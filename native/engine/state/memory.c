/* SPDX-License-Identifier: Apache-2.0
 *
 * Memory that a clone does not carry as it is.
 *
 * - MADV_DONTFORK: missing in the clone.  A process that was found to have such
 *   areas is told MADV_DOFORK for its whole address space in the same breath as it
 *   is cloned, so there is no moment at which a new one could be missed.  Its own
 *   forks then copy those areas, too.  (Only those are left that the kernel keeps so: a
 *   device's, and on new kernels, seen on 7.3, huge pages.)
 * - MADV_WIPEONFORK: zeroes in the clone.  The app's flag must stay, for others rely on
 *   it for their safety (random number generators); so the contents are read while
 *   the app is stopped and written into the template, which gets the flag off, and the
 *   restored process on again.
 * - Shared memory that is nobody else's: is not copied by a clone.  Read while the app
 *   is stopped, up to a limit, and written back at a restore; once for all processes of
 *   the app.  With a name (shm_open(3), memfd_create(2)) it may be somebody else's as
 *   well, who would not go back with the app: then it is left alone, and that is told.
 * - Locked memory: a clone's is not.
 *
 * What areas there are of these kinds is known from the template before; whether
 * that was right is seen in the new template, when the app runs again.  If not, the
 * checkpoint is taken once more.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/auxv.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "state.h"

#define AREAS_MAX 64
#define HOLES_MAX 24
#define MSEAL 462            /* mseal(2), since Linux 6.10; the headers may be older */
#define WIPED_MAX (4u << 20) /* bytes copied of MADV_WIPEONFORK areas */
#define OTHERS_NS (10 * NS_PER_S)
#define SMAPS_SHARE 50 /* the long file is read in at most 1/50 of the time */

const char memory_private_huge_pages[] =
	"it has private huge pages (hugetlb): a clone shares them, and the application could be "
	"killed for want of another when it writes to one";

struct area {
	avc_remote start, end;
	uint64_t offset, inode, device;
	bool wiped;  /* MADV_WIPEONFORK; else shared memory                     */
	bool huge;   /* hugetlbfs, which does not know write(2)                */
	bool again;  /* another process of the app has it, too, and its image keeps it */
	int fd;      /* of the shared memory                                    */
	size_t kept; /* bytes that are in the image: less where the file ends earlier */
};

/* Memory with a name, and whether processes that are not the app's have it. */
struct named {
	uint64_t device, inode, checked_ns;
	bool others;
};

struct areas {
	uint32_t count;
	bool too_many;
	struct area area[AREAS_MAX];
};

/* Stretches of memory with one or the other of some flags. */
struct marks {
	uint32_t count;
	struct {
		avc_remote start, end;
		uint32_t flags; /* enum mapping_flag                            */
	} area[AREAS_MAX];
};

/* What is known of a process's memory from one checkpoint to the next. */
struct memory {
	bool dontfork;
	/* Where a device (or the kernel's vvar) is mapped, or what else keeps_dontfork():
	 * madvise(2) stops there. */
	uint32_t holes;
	struct {
		avc_remote start, end;
	} hole[HOLES_MAX];
	struct areas areas;
	uint64_t layout; /* a hash of the mappings when the areas were read */
	uint64_t read_ns, cost_ns;
	uint64_t left_bytes;   /* shared memory beyond the limit                  */
	uint64_t others_bytes; /* and that of others, too                        */
	uint32_t named_count;
	struct named named[AREAS_MAX];
	uint64_t look_ns;     /* what the last look at all processes took          */
	struct marks advised; /* what madvise(2) was told, where a restore maps it anew */
	struct marks locked;
	struct marks kinds; /* as mem_image.kinds                              */
	int64_t locked_kb;
	uint64_t locked_layout, locked_read_ns, locked_cost_ns;
};

struct mem_image {
	struct areas areas; /* descriptors are duplicates                      */
	struct marks kinds; /* what a restore has to know of mappings          */
	bool whole;         /* everything could be read                        */
	size_t bytes;
	uint8_t data[];
};

static size_t area_bytes(const struct area *a)
{
	return a->end - a->start;
}

/* In an image. */
static size_t area_room(const struct area *a)
{
	return a->again ? 0 : area_bytes(a);
}

static void areas_close(struct areas *areas)
{
	for (uint32_t i = 0; i < areas->count; i++)
		if (!areas->area[i].wiped)
			close_fd(&areas->area[i].fd);
	areas->count = 0;
}

struct memory *memory_new(void)
{
	return calloc(1, sizeof(struct memory));
}

void memory_forget(struct memory *memory)
{
	areas_close(&memory->areas);
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
	if (image)
		areas_close(&image->areas);
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

/* ---- before and during a freeze ------------------------------------------------ */

/* True if it was seen before. */
static bool see(struct mem_seen *seen, const struct area *a)
{
	for (uint32_t i = 0; i < seen->count; i++)
		if (seen->area[i].device == a->device && seen->area[i].inode == a->inode &&
		    seen->area[i].offset == a->offset && seen->area[i].bytes == area_bytes(a))
			return true;
	if (seen->count < sizeof seen->area / sizeof *seen->area) {
		seen->area[seen->count].device = a->device;
		seen->area[seen->count].inode = a->inode;
		seen->area[seen->count].offset = a->offset;
		seen->area[seen->count++].bytes = area_bytes(a);
	}
	return false;
}

int memory_prepare(struct memory *memory, struct mem_image **image, struct mem_seen *seen,
		   struct avc_error *err)
{
	size_t bytes = 0;

	*image = NULL;
	for (uint32_t i = 0; i < memory->areas.count; i++) {
		struct area *a = &memory->areas.area[i];

		a->again = !a->wiped && see(seen, a);
		bytes += area_room(a);
	}
	*image = malloc(sizeof **image + bytes);
	if (!*image)
		return fail_errno(err, 0, "keep memory", "malloc", "out of memory");
	(*image)->areas.count = (*image)->kinds.count = 0;
	(*image)->whole = true;
	(*image)->bytes = bytes;
	memset((*image)->data, 0, bytes); /* page faults now, not in the freeze */
	for (uint32_t i = 0; i < memory->areas.count; i++) {
		struct area *a = &(*image)->areas.area[i];

		*a = memory->areas.area[i];
		if (!a->wiped)
			a->fd = fcntl(a->fd, F_DUPFD_CLOEXEC, 3);
		(*image)->areas.count++;
		if (!a->wiped && a->fd < 0)
			return fail_errno(err, 0, "keep memory", "fcntl", "out of descriptors");
	}
	return 0;
}

static void copy_areas(const struct process *process, struct mem_image *image, bool wiped)
{
	uint8_t *next = image ? image->data : NULL;

	for (uint32_t i = 0; image && i < image->areas.count; i++) {
		struct area *a = &image->areas.area[i];
		uint8_t *to = next;
		ssize_t n = 0;

		next += area_room(a);
		if (a->wiped != wiped)
			continue;
		if (wiped)
			n = read_whole(process->mem_fd, to, area_bytes(a), (off_t)a->start);
		else if (!a->again)
			n = read_whole(a->fd, to, area_bytes(a), (off_t)a->offset);
		a->kept = n > 0 ? (size_t)n : 0;
		image->whole = image->whole && n >= 0 && (!wiped || a->kept == area_bytes(a));
	}
}

void memory_copy_own(const struct process *process, struct mem_image *image)
{
	copy_areas(process, image, true);
}

void memory_copy_shared(const struct process *process, struct mem_image *image)
{
	copy_areas(process, image, false);
}

/* Told of holes (-ENOMEM), madvise(2) goes on; at a device it stops (-EINVAL). */
void memory_dofork(const struct memory *memory, struct inj_call *call)
{
	avc_remote at = ARCH_PAGE_BYTES;

	if (!memory->dontfork)
		return;
	for (uint32_t i = 0; i < memory->holes; i++) {
		if (memory->hole[i].start > at)
			call_add(call, SYS_madvise, at, memory->hole[i].start - at, MADV_DOFORK, 0,
				 0);
		at = memory->hole[i].end;
	}
	call_add(call, SYS_madvise, at, ARCH_USER_END - at, MADV_DOFORK, 0, 0);
}

/* ---- mappings, from /proc ------------------------------------------------------------ */

/* What drivers map, and huge pages.  Whether the kernel minds shows on our own vDSO, which is so. */
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
	bool found, kept;
};

static int find_dontfork(const struct mapping *m, void *arg)
{
	struct dontfork *look = arg;
	struct memory *memory = look->memory;

	if (m->flags & MAPPING_DONTFORK) {
		if (keeps_dontfork(m))
			look->kept = true;
		else
			look->found = true;
	}
	if (!keeps_dontfork(m) || m->start >= ARCH_USER_END)
		return 0;
	if (memory->holes && memory->hole[memory->holes - 1].end == m->start) {
		memory->hole[memory->holes - 1].end = m->end;
		return 0;
	}
	if (memory->holes == HOLES_MAX)
		return -1;
	memory->hole[memory->holes].start = m->start;
	memory->hole[memory->holes++].end = m->end;
	return 0;
}

int memory_learn(struct process *process, long missing_pages, struct avc_error *err)
{
	struct memory *memory = process->memory;
	struct dontfork look = { .memory = memory };
	int result;

	memory->holes = 0;
	result = proc_mappings(process->pid, "smaps", find_dontfork, &look);
	memory->dontfork = !result && (memory->dontfork || look.found);
	if (look.kept)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
			    "it uses memory of a device, or huge pages, which a clone does not "
			    "inherit (MADV_DONTFORK)");
	if (!memory->dontfork)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
			    "%ld kB of its memory are not inherited by a clone",
			    missing_pages * ARCH_PAGE_BYTES / 1024);
	/* Known before, it should not be missing again; but a device may have been
	 * mapped since, at which the call stopped. */
	return fail(err, AVC_RETRY, 0, process->pid, "keep template", "",
		    "%ld kB of its memory are not inherited by a clone yet (MADV_DONTFORK)",
		    missing_pages * ARCH_PAGE_BYTES / 1024);
}

struct survey {
	const struct process *process;
	pid_t template;
	struct memory *memory;
	struct areas *areas;
	uint64_t layout, shared_bytes, limit;
	uint64_t left_bytes, others_bytes;
	bool private_huge;
};

static uint64_t hash(uint64_t h, uint64_t value)
{
	h = (h ^ value) * UINT64_C(0x9E3779B97F4A7C15);
	return h ^ h >> 29;
}

static bool is_pad(const struct process *process, avc_remote at)
{
	if (parasite_contains(&process->parasite, at))
		return true;
	for (uint32_t i = 0; i < process->old_parasites; i++)
		if (at - process->old_parasite[i].base < process->old_parasite[i].bytes)
			return true;
	return false;
}

/* Only its descendants can have it, too. */
static bool is_shared(const struct mapping *m)
{
	return m->shared && (!strcmp(m->name, "/dev/zero (deleted)") ||
			     !strcmp(m->name, "/anon_hugepage (deleted)"));
}

/* By its name the app may say that it is to stay as it is. */
static bool has_name(const struct mapping *m)
{
	const char *name = NULL;

	if (!strncmp(m->name, "/dev/shm/", 9))
		name = m->name + 9;
	else if (!strncmp(m->name, "/memfd:", 7))
		name = m->name + 7;
	return m->shared && m->inode && name && strncmp(name, "avckpt-kept", 11) != 0;
}

static int is_it(const struct mapping *m, void *arg)
{
	const struct mapping *wanted = arg;

	return m->inode == wanted->inode && m->device == wanted->device ? -1 : 0;
}

/* Does a process outside of the app's PID namespace map it?  Those inside are the app, and
 * whoever was sent in to look after it. */
static bool look_for_others(const struct process *process, const struct mapping *m)
{
	struct mapping wanted = *m;
	char inside[64] = "", its[64];
	DIR *proc = opendir("/proc");
	struct dirent *entry;
	bool others = false;

	(void)proc_link(process->init, "ns/pid", inside, sizeof inside);
	while (proc && !others && (entry = readdir(proc))) {
		const pid_t pid = (pid_t)atoi(entry->d_name);

		if (pid <= 0 || pid == getpid() || proc_link(pid, "ns/pid", its, sizeof its) < 0 ||
		    !strcmp(its, inside))
			continue;
		errno = 0;
		others = proc_mappings(pid, "maps", is_it, &wanted) < 0 && errno == 0;
	}
	if (proc)
		closedir(proc);
	return others;
}

static bool is_others(struct memory *memory, const struct process *process, const struct mapping *m)
{
	struct named *named = NULL;
	uint64_t now = now_ns();

	for (uint32_t i = 0; i < memory->named_count && !named; i++)
		if (memory->named[i].inode == m->inode && memory->named[i].device == m->device)
			named = &memory->named[i];
	if (named && now - named->checked_ns < OTHERS_NS + memory->look_ns * SMAPS_SHARE)
		return named->others;
	if (!named && memory->named_count == AREAS_MAX)
		return true;
	if (!named)
		named = &memory->named[memory->named_count++];
	*named = (struct named){
		.device = m->device,
		.inode = m->inode,
		.others = look_for_others(process, m),
	};
	named->checked_ns = now_ns();
	memory->look_ns = named->checked_ns - now;
	return named->others;
}

static int hash_mapping(const struct mapping *m, void *arg)
{
	struct survey *survey = arg;

	survey->layout = hash(hash(hash(survey->layout, m->start), m->end),
			      m->inode ^ m->offset << 8 ^ (uint64_t)m->shared);
	return 0;
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

static uint32_t advice_of(const struct mapping *m)
{
	uint32_t flags = 0;

	/* The kernel itself has marked those. */
	if (m->flags & (MAPPING_DEVICE | MAPPING_DROPPABLE))
		return 0;
	for (size_t i = 0; i < sizeof advices / sizeof *advices; i++)
		flags |= m->flags & advices[i].flag;
	return flags;
}

/* Those beyond AREAS_MAX are not known: of advice that is no harm, and what can not be mapped
 * again is seen at the restore. */
static void mark(struct marks *marks, const struct mapping *m, uint32_t flags)
{
	if (!flags || m->start >= ARCH_USER_END)
		return;
	if (marks->count && marks->area[marks->count - 1].end == m->start &&
	    marks->area[marks->count - 1].flags == flags) {
		marks->area[marks->count - 1].end = m->end;
		return;
	}
	if (marks->count == AREAS_MAX)
		return;
	marks->area[marks->count].start = m->start;
	marks->area[marks->count].end = m->end;
	marks->area[marks->count++].flags = flags;
}

/* A file, or a device.  It is not opened to find out whether it can be: that breaks leases, and may
 * take its time. */
static bool has_path(const struct mapping *m)
{
	static const char *const others[] = { "/memfd:", "/secretmem", "/dmabuf:" };

	for (size_t i = 0; i < sizeof others / sizeof *others; i++)
		if (!strncmp(m->name, others[i], strlen(others[i])))
			return false;
	return m->name[0] == '/';
}

/* A restored process that does not have it from its parent would have to map it itself, of what
 * is behind it: not of a socket's ring (packet(7)), of memfd_secret(2), or for writing of a memfd
 * that is sealed. */
static bool is_only_here(pid_t template, const struct mapping *m)
{
	int fd, seals;

	if (!m->shared || !m->inode || has_path(m))
		return false;
	fd = proc_open_mapped(template, m->start, m->end, O_RDONLY | O_NONBLOCK);
	if (fd < 0)
		return errno == ENXIO;
	seals = fcntl(fd, F_GET_SEALS); /* -1: it knows none */
	close(fd);
	return m->mode[1] == 'w' && seals > 0 && seals & (F_SEAL_WRITE | F_SEAL_FUTURE_WRITE);
}

static uint32_t kind_of(const struct survey *survey, const struct mapping *m)
{
	const uint32_t kind = m->flags &
			      (MAPPING_DROPPABLE | MAPPING_GROWING | MAPPING_SEALED | MAPPING_KEYS);

	if (kind && mapping_is_special(m))
		return kind | MAPPING_SPECIAL;
	return survey->process->descendant && is_only_here(survey->template, m)
		       ? kind | MAPPING_ONLY_HERE
		       : kind;
}

static int find_area(const struct mapping *m, void *arg)
{
	struct survey *survey = arg;
	struct areas *areas = survey->areas;
	/* What the kernel may drop at any time (vDSO getrandom's state) may be
	 * wiped as well, and is better so: nothing random comes twice. */
	const bool wiped = (m->flags & (MAPPING_WIPEONFORK | MAPPING_DROPPABLE)) ==
			   MAPPING_WIPEONFORK;

	hash_mapping(m, arg);
	if (!is_pad(survey->process, m->start)) {
		mark(&survey->memory->kinds, m, kind_of(survey, m));
		if (survey->process->descendant)
			mark(&survey->memory->advised, m, advice_of(m));
	}
	survey->private_huge |= m->flags & MAPPING_HUGETLB && !m->shared;
	if ((!wiped && !is_shared(m) && !has_name(m)) || is_pad(survey->process, m->start))
		return 0;
	if (!wiped) {
		/* One that is too large does not keep small ones from being rolled back. */
		if (survey->shared_bytes + (m->end - m->start) > survey->limit) {
			survey->left_bytes += m->end - m->start;
			return 0;
		}
		if (has_name(m) && is_others(survey->memory, survey->process, m)) {
			survey->others_bytes += m->end - m->start;
			return 0;
		}
		survey->shared_bytes += m->end - m->start;
	}
	if (areas->count == AREAS_MAX) {
		areas->too_many = true;
		return 0;
	}
	areas->area[areas->count++] = (struct area){
		.start = m->start,
		.end = m->end,
		.offset = m->offset,
		.inode = m->inode,
		.device = m->device,
		.wiped = wiped,
		.huge = m->flags & MAPPING_HUGETLB,
		.fd = -1,
	};
	return 0;
}

static bool same_area(const struct area *a, const struct area *b)
{
	return a->start == b->start && a->end == b->end && a->offset == b->offset &&
	       a->inode == b->inode && a->wiped == b->wiped;
}

static bool same_areas(const struct areas *a, const struct areas *b)
{
	if (a->count != b->count)
		return false;
	for (uint32_t i = 0; i < a->count; i++)
		if (!same_area(&a->area[i], &b->area[i]))
			return false;
	return true;
}

/* The shared memory itself, by the mapping of the template. */
static int open_area(pid_t template, struct area *a, struct avc_error *err)
{
	a->fd = proc_open_mapped(template, a->start, a->end, O_RDWR);
	if (a->fd < 0)
		return fail_errno(err, template, "keep memory", "open(map_files)",
				  "shared memory can not be reached");
	return 0;
}

/* Takes `found` for what is there from now on. */
static int remember(struct process *process, pid_t template, struct areas *found,
		    struct avc_error *err)
{
	struct memory *memory = process->memory;
	uint64_t wiped = 0;

	areas_close(&memory->areas);
	memory->areas.count = 0;
	if (found->too_many)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
			    "it has more than %d areas of shared or MADV_WIPEONFORK memory",
			    AREAS_MAX);
	for (uint32_t i = 0; i < found->count; i++) {
		struct area *a = &found->area[i];

		if (!a->wiped && open_area(template, a, err))
			return -1;
		wiped += a->wiped ? area_bytes(a) : 0;
		memory->areas.area[memory->areas.count++] = *a;
	}
	if (wiped > WIPED_MAX) {
		areas_close(&memory->areas);
		return fail(
			err, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
			"%llu kB of its memory are wiped in a clone (MADV_WIPEONFORK), which is too much to copy",
			(unsigned long long)wiped / 1024);
	}
	return 0;
}

/* Were the areas that were copied those that there are?  Of the long file only as
 * often as it is worth it, and when the layout has changed. */
static int check_areas(struct process *process, const struct image *image, struct avc_error *err)
{
	static const struct areas none;
	struct memory *memory = process->memory;
	const struct areas *copied = image->memory ? &image->memory->areas : &none;
	struct survey survey = { .process = process, .limit = process->shm_bytes };
	struct areas *found;
	uint64_t start = now_ns();
	int result = 0;

	if (proc_mappings(image->template, "maps", hash_mapping, &survey))
		return fail_errno(err, image->template, "keep memory", "read(maps)",
				  "it was killed");
	if (survey.layout == memory->layout &&
	    start - memory->read_ns < memory->cost_ns * SMAPS_SHARE)
		goto out;
	found = calloc(1, sizeof *found);
	if (!found)
		return fail_errno(err, 0, "keep memory", "calloc", "out of memory");
	start = now_ns();
	survey = (struct survey){
		.process = process,
		.template = image->template,
		.memory = memory,
		.limit = process->shm_bytes,
		.areas = found,
	};
	memory->advised.count = memory->kinds.count = 0;
	if (proc_mappings(image->template, "smaps", find_area, &survey))
		result = fail_errno(err, image->template, "keep memory", "read(smaps)",
				    "it was killed");
	memory->read_ns = now_ns();
	memory->cost_ns = memory->read_ns - start;
	memory->left_bytes = survey.left_bytes;
	memory->others_bytes = survey.others_bytes;
	if (!result && survey.private_huge)
		result = fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "", "%s",
			      memory_private_huge_pages);
	if (!result && !same_areas(found, copied)) {
		result = remember(process, image->template, found, err);
		if (!result)
			result = fail(err, AVC_RETRY, 0, process->pid, "keep memory", "",
				      "it has new shared or MADV_WIPEONFORK memory");
	}
	memory->layout = result ? 0 : survey.layout;
	free(found);
out:
	if (image->memory)
		image->memory->kinds = memory->kinds;
	if (!result && image->memory && !image->memory->whole)
		result = fail(err, AVC_DEADLINE, 0, process->pid, "keep memory", "",
			      "its shared memory can not be read");
	return result;
}

/* ---- when the app runs again ------------------------------------------------------------- */

/* Puts the wiped areas into the template, which is stopped. */
static int fill_wiped(struct process *process, struct image *image, struct setup *setup,
		      struct avc_error *err)
{
	struct inj_call *call = &setup->slot->template_call;
	const struct mem_image *kept = image->memory;
	const uint8_t *from = kept ? kept->data : NULL;
	int mem_fd = -1, result = 0;

	call_begin(call, INJ_AFTER_PARK);
	for (uint32_t i = 0; !result && kept && i < kept->areas.count; i++) {
		const struct area *a = &kept->areas.area[i];

		if (a->wiped && mem_fd < 0)
			mem_fd = proc_open(image->template, "mem", O_RDWR);
		if (a->wiped &&
		    pwrite(mem_fd, from, area_bytes(a), (off_t)a->start) != (ssize_t)area_bytes(a))
			result = fail_errno(err, image->template, "keep memory", "write(mem)",
					    "it was killed");
		if (a->wiped) {
			call_add(call, SYS_madvise, a->start, area_bytes(a), MADV_KEEPONFORK, 0, 0);
			setup_add(setup, INJ_BEFORE, "madvise", SYS_madvise, a->start,
				  area_bytes(a), MADV_WIPEONFORK, 0, 0);
		}
		if (call->count >= INJ_CALLS_MAX || (call->count && i + 1 == kept->areas.count)) {
			if (parasite_send(&process->parasite, image->template, &image->base, call,
					  err) ||
			    parasite_run(image->template, call, err))
				result = -1;
			call_begin(call, INJ_AFTER_PARK);
		}
		from += area_room(a);
	}
	close_fd(&mem_fd);
	return result;
}

static int find_locked(const struct mapping *m, void *arg)
{
	mark(arg, m, m->flags & MAPPING_LOCKED);
	return 0;
}

/* Pages become locked as they are touched (MLOCK_ONFAULT): to bring them all in at once
 * would make a copy of all that memory before the process may run. */
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

		/* Of one that has just died there is nothing to be seen any more; what
		 * was known of it is right, as a rule. */
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
			  memory->locked.area[i].end - memory->locked.area[i].start, MLOCK_ONFAULT,
			  0, 0)
			->flags = INJ_MAY_FAIL;
}

static void advise_again(const struct memory *memory, struct setup *setup)
{
	for (uint32_t i = 0; i < memory->advised.count; i++)
		for (size_t k = 0; k < sizeof advices / sizeof *advices; k++)
			if (memory->advised.area[i].flags & advices[k].flag)
				setup_add(setup, INJ_BEFORE, "madvise", SYS_madvise,
					  memory->advised.area[i].start,
					  memory->advised.area[i].end -
						  memory->advised.area[i].start,
					  (uint64_t)advices[k].advice, 0, 0)
					->flags = INJ_MAY_FAIL;
}

/* After all that is mapped and advised.  What the kernel has sealed (CONFIG_MSEAL_SYSTEM_MAPPINGS)
 * is so in a fork; Podman's seccomp profile need not know mseal(2). */
static void seal_again(const struct memory *memory, struct setup *setup)
{
	for (uint32_t i = 0; i < memory->kinds.count; i++)
		if ((memory->kinds.area[i].flags & (MAPPING_SEALED | MAPPING_SPECIAL)) ==
		    MAPPING_SEALED)
			setup_add(setup, INJ_BEFORE, "mseal", MSEAL, memory->kinds.area[i].start,
				  memory->kinds.area[i].end - memory->kinds.area[i].start, 0, 0, 0)
				->flags = INJ_MAY_FAIL;
}

int memory_finish(struct process *process, struct image *image, int64_t locked_kb,
		  struct setup *setup, struct avc_error *err)
{
	const struct thread *main_thread = thread_find(process, process->pid);

	if (check_areas(process, image, err) || fill_wiped(process, image, setup, err))
		return -1;
	lock_again(process, locked_kb, setup);
	advise_again(process->memory, setup);
	if (process->descendant)
		seal_again(process->memory, setup);
	if (main_thread && main_thread->creds.future_lock)
		setup_add(setup, INJ_AFTER, "mlockall", SYS_mlockall,
			  (uint64_t)main_thread->creds.future_lock, 0, 0, 0, 0)
			->flags = INJ_MAY_FAIL;
	if (process->memory->left_bytes && !setup->notice.code)
		fail(&setup->notice, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
		     "%llu kB of shared memory are more than avckpt.shm allows, and are not rolled back",
		     (unsigned long long)process->memory->left_bytes / 1024);
	if (process->memory->others_bytes && !setup->notice.code)
		fail(&setup->notice, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
		     "%llu kB of shared memory are also others', outside of the container, and are not rolled back",
		     (unsigned long long)process->memory->others_bytes / 1024);
	return 0;
}

/* Whether it is what the image has, by the memory of a process. */
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

/* By the process's memory, which may still be written though the file may not
 * (F_SEAL_FUTURE_WRITE, and hugetlbfs does not know write(2)). */
static int put_into_memory(const struct area *a, pid_t pid, const uint8_t *from,
			   struct avc_error *notes, struct avc_error *err)
{
	int mem_fd = proc_open(pid, "mem", O_RDWR), result = 0;

	if (pwrite(mem_fd, from, a->kept, (off_t)a->start) == (ssize_t)a->kept)
		;
	else if (a->huge)
		result = fail_errno(err, pid, "restore", "write(mem)",
				    "shared memory can not be written");
	else if (!is_equal(mem_fd, a, from)) /* what was sealed at the checkpoint is */
		fail(notes, AVC_UNSUPPORTED, EPERM, pid, "restore", "pwrite",
		     "%zu kB of shared memory have been sealed since, and are not rolled back",
		     area_bytes(a) / 1024);
	close_fd(&mem_fd);
	return result;
}

/* By the file, which need not be mapped for writing. */
static int put_back(const struct area *a, pid_t pid, const uint8_t *from, struct avc_error *notes,
		    struct avc_error *err)
{
	const ssize_t n = a->huge ? 0 : pwrite(a->fd, from, a->kept, (off_t)a->offset);

	if (n == (ssize_t)a->kept)
		return 0;
	if (a->huge || (n < 0 && errno == EPERM))
		return put_into_memory(a, pid, from, notes, err);
	return fail_errno(err, pid, "restore", "pwrite", "shared memory can not be written");
}

int memory_put_back(const struct mem_image *image, pid_t pid, struct avc_error *notes,
		    struct avc_error *err)
{
	const uint8_t *from = image ? image->data : NULL;
	int result = 0;

	for (uint32_t i = 0; !result && image && i < image->areas.count; i++) {
		const struct area *a = &image->areas.area[i];

		if (!a->wiped && a->kept)
			result = put_back(a, pid, from, notes, err);
		from += area_room(a);
	}
	return result;
}
