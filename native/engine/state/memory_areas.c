/* SPDX-License-Identifier: Apache-2.0
 *
 * Finds the areas of a process that a clone does not carry, in its template.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "memory.h"

#define AREAS_MAX 4096

static bool add_area(struct areas *areas, const struct area *area)
{
	if (!make_room(&areas->area, areas->count, &areas->room, sizeof *areas->area))
		return false;
	areas->area[areas->count++] = *area;
	return true;
}

bool areas_copy(struct areas *to, const struct areas *from)
{
	to->count = to->room = 0;
	to->area = malloc((from->count + 1) * sizeof *to->area);
	if (!to->area)
		return false;
	to->room = from->count + 1;
	to->count = from->count;
	if (from->count)
		memcpy(to->area, from->area, from->count * sizeof *to->area);
	return true;
}

void areas_free(struct areas *areas)
{
	free(areas->area);
	*areas = (struct areas){ 0 };
}

struct survey {
	const struct process *process;
	pid_t template;
	struct memory *memory;
	struct areas areas, foreign, unkept;
	struct mem_seen kept, left; /* the same memory may be mapped more than once           */
	uint64_t layout, since, others_bytes;
	const char *refused;
	bool too_many, lost_some, unforked;
	bool recycled; /* image.recycled                                             */
	struct mounts mounts;
	struct leases leases;
};

static uint64_t hash(uint64_t h, uint64_t value)
{
	h = (h ^ value) * UINT64_C(0x9E3779B97F4A7C15);
	return h ^ h >> 29;
}

/* That of a guard that has died is forgotten when it is unmapped, and a template may still have it: it is
 * no shared memory of the application's. */
static bool is_of_parasite(const struct process *process, const struct mapping *m)
{
	const avc_remote at = m->start;

	if (parasite_contains(&process->parasite, at) || !strcmp(m->name, PARASITE_MAPPED))
		return true;
	for (uint32_t i = 0; i < process->old_parasites; i++)
		if (at - process->old_parasite[i].base < process->old_parasite[i].bytes)
			return true;
	return false;
}

/* Only its descendants can share it. */
static bool is_shared(const struct mapping *m)
{
	return m->shared && device_is_memory(m->device) &&
	       (!strcmp(m->name, "/dev/zero (deleted)") ||
		!strcmp(m->name, "/anon_hugepage (deleted)"));
}

/* By its name the app can ask to leave it as it is. */
static bool has_name(const struct mapping *m)
{
	const char *name = NULL;

	if (!strncmp(m->name, "/dev/shm/", 9))
		name = m->name + 9;
	else if (!strncmp(m->name, "/memfd:", 7))
		name = m->name + 7;
	return m->shared && m->inode && name && strncmp(name, "avckpt-kept", 11) != 0;
}

/* Others can still come to have it, without being given a descriptor. */
static bool can_be_found(const struct mapping *m, bool segment)
{
	const size_t length = strlen(m->name), tail = strlen(" (deleted)");

	if (segment)
		return strncmp(m->name, "/SYSV00000000", 13) != 0;
	return !strncmp(m->name, "/dev/shm/", 9) &&
	       !(length > tail && !strcmp(m->name + length - tail, " (deleted)"));
}

bool mapping_is_segment(const struct mapping *m)
{
	return m->shared && device_is_memory(m->device) && !strncmp(m->name, "/SYSV", 5);
}

uint64_t segment_device(uint64_t device, pid_t pid)
{
	struct statx st;

	return proc_look(pid, "ns/ipc", STATX_INO, &st) ? device | st.stx_ino << 32 : device;
}

/* A file on a disk may have such a name. */
static bool is_memory(struct survey *survey, const struct mapping *m)
{
	const char *type = "";
	int fd;

	if (device_is_memory(m->device))
		return true;
	fd = proc_open_mapped(survey->template, m->start, m->end, O_PATH);
	if (fd >= 0)
		type = mount_type(&survey->mounts, survey->template, fd);
	close_fd(&fd);
	return !strncmp(m->name, "/dev/", 5) &&
	       (!strcmp(type, "tmpfs") || !strcmp(type, "hugetlbfs"));
}

static int hash_mapping(const struct mapping *m, void *arg)
{
	struct survey *survey = arg;

	survey->layout = hash(hash(hash(survey->layout, m->start), m->end),
			      m->inode ^ m->offset << 8 ^
				      (uint64_t)(m->shared ? 1 + mapping_protection(m) : 0));
	return 0;
}

static uint32_t advice_of(const struct mapping *m)
{
	/* These are marked by the kernel itself. */
	if (m->flags & (MAPPING_DEVICE | MAPPING_DROPPABLE))
		return 0;
	return m->flags & (MAPPING_HUGE | MAPPING_SMALL | MAPPING_DONTDUMP | MAPPING_MERGEABLE);
}

void marks_add(struct marks *marks, const struct mapping *m, uint32_t flags)
{
	if (!flags || m->start >= ARCH_USER_END)
		return;
	if (marks->count && marks->area[marks->count - 1].end == m->start &&
	    marks->area[marks->count - 1].flags == flags) {
		marks->area[marks->count - 1].end = m->end;
		return;
	}
	if (marks->count == MARKS_MAX)
		return;
	marks->area[marks->count].start = m->start;
	marks->area[marks->count].end = m->end;
	marks->area[marks->count++].flags = flags;
}

/* A file, or a device.  It is not opened to find out whether it can be: that breaks leases, and may
 * block. */
static bool has_path(const struct mapping *m)
{
	static const char *const others[] = { "/secretmem", "/dmabuf:" };

	if (device_is_memory(m->device) && !strncmp(m->name, "/memfd:", 7))
		return false;
	for (size_t i = 0; i < sizeof others / sizeof *others; i++)
		if (!strncmp(m->name, others[i], strlen(others[i])))
			return false;
	return m->name[0] == '/';
}

/* A restored process that does not inherit it would have to map it from the file behind it:
 * impossible for a socket's ring (packet(7)), memfd_secret(2), or a memfd sealed against writable
 * mappings. */
static bool is_only_here(struct survey *survey, const struct mapping *m)
{
	int path_fd, fd, seals;

	if (!m->shared || !m->inode || has_path(m))
		return false;
	path_fd = proc_open_mapped(survey->template, m->start, m->end, O_PATH);
	if (path_fd < 0)
		return false;
	fd = open_to_read(path_fd, m, &survey->leases);
	close(path_fd);
	if (fd < 0)
		return errno == ENXIO;
	seals = fcntl(fd, F_GET_SEALS); /* -1: no seals */
	close(fd);
	return m->mode[1] == 'w' && seals > 0 && seals & (F_SEAL_WRITE | F_SEAL_FUTURE_WRITE);
}

static uint32_t kind_of(struct survey *survey, const struct mapping *m)
{
	const uint32_t kind = m->flags & (MAPPING_DROPPABLE | MAPPING_GROWING | MAPPING_SEALED |
					  MAPPING_TAGGED | MAPPING_KEYS);

	if (kind && mapping_is_special(m))
		return kind | MAPPING_SPECIAL;
	return survey->process->descendant && is_only_here(survey, m) ? kind | MAPPING_ONLY_HERE
								      : kind;
}

static int find_area(const struct mapping *m, void *arg)
{
	struct survey *survey = arg;
	struct area area;
	/* What the kernel may drop at any time (vDSO getrandom's state) may be wiped as well, and
	 * should be: no random data is repeated. */
	const bool wiped = (m->flags & (MAPPING_WIPEONFORK | MAPPING_DROPPABLE)) ==
			   MAPPING_WIPEONFORK;
	const bool ours = is_of_parasite(survey->process, m);
	bool segment, named;

	hash_mapping(m, arg);
	survey->unforked |= survey->recycled && m->flags & MAPPING_DONTFORK &&
			    m->start < ARCH_USER_END;
	if (!ours) {
		marks_add(&survey->memory->kinds, m, kind_of(survey, m));
		survey->memory->special |= mapping_is_special(m);
		survey->memory->grows |= m->flags & MAPPING_GROWING &&
					 strcmp(m->name, "[stack]") != 0;
		survey->memory->receives |= !strncmp(m->name, "socket:", 7);
		if (survey->process->descendant || survey->recycled)
			marks_add(&survey->memory->advised, m, advice_of(m));
	}
	if (!survey->refused)
		survey->refused = memory_refuses(m);
	segment = !wiped && mapping_is_segment(m);
	named = segment || (!wiped && has_name(m) && is_memory(survey, m));
	if ((!wiped && !is_shared(m) && !named) || ours)
		return 0;
	if (survey->areas.count == AREAS_MAX) {
		survey->too_many = true;
		return 0;
	}
	area = (struct area){
		.start = m->start,
		.end = m->end,
		.offset = m->offset,
		.inode = m->inode,
		.device = segment ? segment_device(m->device, survey->process->pid) : m->device,
		.wiped = wiped,
		.named = named,
		/* Any process that sees the file system can open it. */
		.as_file = named && !segment && !device_is_memory(m->device),
		.found = can_be_found(m, segment),
		.protection = (uint8_t)mapping_protection(m),
		.way = m->mode[1] == 'w' ? WAY_MAPPING : WAY_NONE,
	};
	return add_area(&survey->areas, &area) ? 0 : -1;
}

/* ---- what of it is to be rolled back ----------------------------------------------------- */

static bool same_object(const struct area *a, const struct area *b)
{
	return a->inode == b->inode && a->device == b->device;
}

static bool is_known(const struct memory *memory, const struct area *wanted)
{
	for (uint32_t i = 0; i < memory->areas.count; i++)
		if (same_object(&memory->areas.area[i], wanted))
			return true;
	for (uint32_t i = 0; i < memory->foreign.count; i++)
		if (same_object(&memory->foreign.area[i], wanted))
			return true;
	return false;
}

/* For new ones it is not known yet whether others have it, too. */
static void look_for_others(const struct survey *survey)
{
	bool known = true;

	for (uint32_t i = 0; known && i < survey->areas.count; i++)
		known = !survey->areas.area[i].named ||
			is_known(survey->memory, &survey->areas.area[i]);
	mem_others_scan(survey->process->others, survey->process, &survey->areas,
			known ? 0 : survey->since);
}

/* By the mapping, by its file, or by a descriptor; never with rights that the application lacks. */
static enum area_way way_of(pid_t template, const struct area *a)
{
	if (a->wiped || a->way == WAY_MAPPING)
		return a->way;
	if (proc_mapped_for_writing(template, a->start, a->end))
		return WAY_PROTECT;
	return area_find_descriptor(template, a) >= 0 ? WAY_FILE : WAY_NONE;
}

/* A second mapping of the same memory takes none: code that a just-in-time compiler writes through one
 * and executes through the other, the heap of ZGC. */
static bool has_room(struct survey *survey, const struct area *a)
{
	if (mem_seen_has(&survey->kept, a))
		return true;
	if (survey->kept.shared_bytes + area_bytes(a) > survey->process->shm_bytes)
		return false;
	survey->lost_some |= !mem_seen_add(&survey->kept, a);
	return true;
}

/* One that is too large does not prevent small ones from being rolled back. */
static bool is_to_be_kept(struct survey *survey, struct area *a)
{
	if (a->wiped)
		return true;
	if (a->named && mem_others_have(survey->process->others, a)) {
		survey->others_bytes += area_bytes(a);
		/* If there is no memory to record it, it is searched again. */
		(void)add_area(&survey->foreign, a);
		return false;
	}
	a->way = way_of(survey->template, a);
	if (a->way == WAY_NONE || !has_room(survey, a)) {
		if (a->way != WAY_NONE && !mem_seen_has(&survey->left, a))
			survey->lost_some |= !mem_seen_add(&survey->left, a);
		survey->lost_some |= !add_area(&survey->unkept, a);
		return false;
	}
	if (a->as_file)
		mem_others_watch(survey->process->others, survey->template, a);
	return true;
}

static void sort_out(struct survey *survey)
{
	struct areas *areas = &survey->areas;
	uint32_t kept = 0;

	look_for_others(survey);
	for (uint32_t i = 0; i < areas->count; i++)
		if (is_to_be_kept(survey, &areas->area[i]))
			areas->area[kept++] = areas->area[i];
	areas->count = kept;
}

static bool same_area(const struct area *a, const struct area *b)
{
	return a->start == b->start && a->end == b->end && a->offset == b->offset &&
	       same_object(a, b) && a->wiped == b->wiped && a->way == b->way &&
	       a->protection == b->protection;
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

/* From now on, uses what was found. */
static int remember(struct survey *survey, struct avc_error *err)
{
	struct memory *memory = survey->memory;

	areas_free(&memory->areas);
	memory->areas = survey->areas;
	survey->areas = (struct areas){ 0 };
	return fail(err, AVC_RETRY, 0, survey->process->pid, "keep memory", "",
		    "it has new shared or MADV_WIPEONFORK memory");
}

static int read_areas(struct survey *survey, const struct areas *copied, struct avc_error *err)
{
	struct memory *memory = survey->memory;
	const pid_t pid = survey->process->pid;
	const uint64_t start = now_ns();
	int result = 0;

	memory->advised.count = memory->kinds.count = 0;
	memory->special = memory->grows = memory->receives = false;
	/* Advice given to the process since its template was forked is missing in the template. */
	if (proc_mappings(survey->recycled ? pid : survey->template, "smaps", find_area, survey))
		return fail_errno(err, survey->template, "keep memory", "read(smaps)",
				  "it was killed");
	sort_out(survey);
	memory->read_ns = now_ns();
	memory->cost_ns = memory->read_ns - start;
	memory->left_bytes = survey->left.shared_bytes;
	memory->others_bytes = survey->others_bytes;
	areas_free(&memory->foreign);
	memory->foreign = survey->foreign;
	survey->foreign = (struct areas){ 0 };
	areas_free(&memory->unkept);
	memory->unkept = survey->unkept;
	survey->unkept = (struct areas){ 0 };
	if (survey->lost_some)
		return fail_memory(err, 0, "keep memory");
	if (survey->refused)
		result = fail(err, AVC_UNSUPPORTED, 0, pid, "keep memory", "", "%s",
			      survey->refused);
	else if (survey->too_many)
		result = fail(err, AVC_UNSUPPORTED, 0, pid, "keep memory", "",
			      "it has more than %d areas of shared or MADV_WIPEONFORK memory",
			      AREAS_MAX);
	else if (!same_areas(&survey->areas, copied))
		result = remember(survey, err);
	memory->dontfork |= survey->unforked;
	if (!result && survey->unforked)
		result = fail(err, AVC_RETRY, 0, pid, "keep memory", "",
			      "some of its memory is not inherited by a clone (MADV_DONTFORK)");
	return result;
}

/* ---- what a new process has, probably ------------------------------------------------------- */

struct expected {
	const struct areas *parents;
	uint32_t next; /* of these, which are ordered by address, as mappings are */
	struct areas areas;
};

static int find_expected(const struct mapping *m, void *arg)
{
	struct expected *expected = arg;
	const struct area *a;

	while (expected->next < expected->parents->count &&
	       expected->parents->area[expected->next].start < m->start)
		expected->next++;
	if (expected->next == expected->parents->count)
		return -1;
	a = &expected->parents->area[expected->next];
	if (a->start != m->start || a->end != m->end || a->offset != m->offset ||
	    a->inode != m->inode || area_device(a) != m->device ||
	    a->protection != mapping_protection(m))
		return 0;
	return add_area(&expected->areas, a) ? 0 : -1;
}

void memory_expect(struct process *process, const struct process *parent)
{
	struct expected expected = { .parents = &parent->memory->areas };

	/* What is missing, or too much, is found after the first clone. */
	if (expected.parents->count)
		(void)proc_mappings(process->pid, "maps", find_expected, &expected);
	areas_free(&process->memory->areas);
	process->memory->areas = expected.areas;
}

/* ---- whether that is so --------------------------------------------------------------------- */

static int check_layout(const struct image *image, struct avc_error *err)
{
	struct process *process = image->process;
	struct memory *memory = process->memory;
	struct survey survey = { .process = process };
	const uint64_t start = now_ns();
	int result;

	/* A template that copies were made to has no seal or advice that the process has given to a
	 * part of a mapping since, and so is not split there. */
	if (memory->layout && start - memory->read_ns < memory->cost_ns * SMAPS_SHARE) {
		const pid_t pid = image->recycled ? process->pid : image->template;

		if (proc_mappings(pid, "maps", hash_mapping, &survey))
			return fail_errno(err, pid, "keep memory", "read(maps)", "it was killed");
		if (survey.layout == memory->layout)
			return 0;
	}
	survey = (struct survey){
		.process = process,
		.template = image->template,
		.memory = memory,
		.since = image->taken_ns,
		.recycled = image->recycled,
	};
	result = read_areas(&survey, &image->memory->areas, err);
	memory->layout = result ? 0 : survey.layout;
	areas_free(&survey.areas);
	areas_free(&survey.foreign);
	areas_free(&survey.unkept);
	mem_seen_free(&survey.kept);
	mem_seen_free(&survey.left);
	leases_free(&survey.leases);
	mounts_free(&survey.mounts);
	return result;
}

/* ---- what several processes have ------------------------------------------------------------ */

struct unkept {
	uint64_t device, inode, offset, bytes;
	pid_t pid;
	bool written, found;
};

struct unkept_list {
	uint32_t count, room;
	struct unkept *item;
};

static bool add_unkept(struct unkept_list *list, const struct process *process,
		       const struct mem_image *image)
{
	const struct areas *of[] = { &process->memory->unkept, &image->areas };

	for (uint32_t k = 0; k < 2; k++) {
		for (uint32_t i = 0; i < of[k]->count; i++) {
			const struct area *a = &of[k]->area[i];

			if (of[k] == &image->areas && !a->left)
				continue;
			if (!make_room(&list->item, list->count, &list->room, sizeof *list->item))
				return false;
			list->item[list->count++] = (struct unkept){
				.device = a->device,
				.inode = a->inode,
				.offset = a->offset,
				.bytes = area_bytes(a),
				.pid = process->pid,
				.written = a->way != WAY_NONE,
				.found = a->found,
			};
		}
	}
	return true;
}

/* Mappings of the same memory are neighbours then, those that can be written first. */
static int compare_unkept(const void *a, const void *b)
{
	const struct unkept *x = a, *y = b;

	if (x->device != y->device)
		return x->device < y->device ? -1 : 1;
	if (x->inode != y->inode)
		return x->inode < y->inode ? -1 : 1;
	if (x->offset != y->offset)
		return x->offset < y->offset ? -1 : 1;
	if (x->bytes != y->bytes)
		return x->bytes < y->bytes ? -1 : 1;
	return y->written - x->written;
}

static bool same_unkept(const struct unkept *a, const struct unkept *b)
{
	return a->inode == b->inode && a->device == b->device;
}

/* The first one that several processes have and at least one can write; NULL: none. */
static const struct unkept *find_common(const struct unkept_list *list)
{
	const struct unkept *first = list->item;
	bool several = false, written = false;

	for (uint32_t i = 0; i < list->count; i++) {
		const struct unkept *u = &list->item[i];

		if (!same_unkept(first, u)) {
			first = u;
			several = written = false;
		}
		several |= u->pid != first->pid;
		written |= u->written;
		if (several && written)
			return first;
	}
	return NULL;
}

/* What one process has to itself is its own state, like a heap that it has mapped from a memfd (Java
 * with ZGC): registers, stacks and the rest would go back, and meet its contents of now.  What others
 * can find is mostly messages to them. */
static uint64_t own_bytes(const struct unkept_list *list)
{
	uint64_t bytes = 0;

	for (uint32_t i = 0; i < list->count; i++) {
		const struct unkept *u = &list->item[i];
		const bool again = i && same_unkept(u - 1, u) && u[-1].offset == u->offset &&
				   u[-1].bytes == u->bytes;

		if (u->written && !u->found && !again)
			bytes += u->bytes;
	}
	return bytes;
}

int memory_check_unkept(const struct image *image, uint32_t images, struct avc_error *err)
{
	struct unkept_list list = { 0 };
	const struct unkept *common;
	uint64_t own;
	bool added = true;
	int result = 0;

	for (uint32_t i = 0; added && i < images; i++)
		if (image[i].process)
			added = add_unkept(&list, image[i].process, image[i].memory);
	if (!added) {
		result = fail_memory(err, 0, "keep memory");
	} else if (list.count) {
		qsort(list.item, list.count, sizeof *list.item, compare_unkept);
		common = find_common(&list);
		if (common)
			result = fail(err, AVC_UNSUPPORTED, 0, common->pid, "keep memory", "",
				      "avckpt.shm has no room for memory that several of its "
				      "processes share (one area has %llu KiB)",
				      (unsigned long long)common->bytes / 1024);
		/* 0: the user wants none to be rolled back. */
		else if (image->process->shm_bytes && (own = own_bytes(&list)))
			result = fail(err, AVC_UNSUPPORTED, 0, image->process->pid, "keep memory",
				      "",
				      "avckpt.shm has no room for %llu KiB of shared memory that "
				      "nobody else has",
				      (unsigned long long)own / 1024);
	}
	free(list.item);
	return result;
}

int areas_check(const struct image *image, struct avc_error *err)
{
	struct process *process = image->process;
	const int result = check_layout(image, err);

	image->memory->kinds = process->memory->kinds;
	image->memory->special = process->memory->special;
	if (!result && image->memory->too_much)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
			    "more than %u MB of its memory are wiped in a clone (MADV_WIPEONFORK), "
			    "which is too much to copy",
			    WIPED_MAX >> 20);
	if (!result && image->memory->leased)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep memory", "",
			    "it has shared memory with a lease (fcntl(2), F_SETLEASE), which would "
			    "be broken by reading it");
	if (!result && !image->memory->whole)
		return fail(err, AVC_DEADLINE, 0, process->pid, "keep memory", "",
			    "its shared or MADV_WIPEONFORK memory cannot be read");
	return result;
}
