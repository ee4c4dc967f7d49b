/* SPDX-License-Identifier: Apache-2.0
 *
 * Other processes may also have shared memory with a name, or a descriptor, and would not be rolled
 * back with the application.
 *
 * Others are the processes outside of its PID namespace: those inside are the application, and
 * commands sent in to look after it.  For a unit below a launcher, whose init is not PID 1 there,
 * they are all processes not below its init.  Processes that have mapped it or have it open for
 * writing are searched periodically.  Those that open it by its name, write and close it in between
 * are reported by inotify(7), which covers write(2) but not writes through a mapping; nor does it
 * tell who it was, so what the application itself writes in this way is not rolled back either.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/inotify.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <unistd.h>

#include "memory.h"

#define LOOK_NS (10 * NS_PER_S)
#define LOOK_SHARE 50     /* at most this share of the time is spent on scans */
#define DEVICES_MAX 16    /* file systems that the application has such memory of */
#define OBJECTS_MAX 65536 /* of others, on these                                  */
#define WATCHES_MAX 1024
#define ANCESTORS_MAX 256
#define READS_MAX 64 /* more than that need not be counted */

struct object {
	uint64_t device, inode;
};

struct watch {
	int number;
	struct object object;
	uint32_t writes;
};

struct mem_others {
	uint64_t looked_ns, cost_ns;
	uint32_t devices, count, room;
	uint64_t device[DEVICES_MAX];
	struct object *object; /* in order                                        */
	bool unknown;          /* there were too many: everything may be shared with others */
	int inotify;
	uint32_t watches, watch_room, lost;
	struct watch *watch;
};

struct mem_others *mem_others_new(void)
{
	struct mem_others *others = calloc(1, sizeof *others);

	if (others)
		others->inotify = -1;
	return others;
}

void mem_others_free(struct mem_others *others)
{
	if (!others)
		return;
	close_fd(&others->inotify);
	free(others->object);
	free(others->watch);
	free(others);
}

/* ---- who has it --------------------------------------------------------------------- */

static int compare(const void *a, const void *b)
{
	const struct object *x = a, *y = b;

	if (x->device != y->device)
		return x->device < y->device ? -1 : 1;
	return (x->inode > y->inode) - (x->inode < y->inode);
}

static bool is_wanted(const struct mem_others *others, uint64_t device)
{
	for (uint32_t i = 0; i < others->devices; i++)
		if (others->device[i] == device)
			return true;
	return false;
}

static void add_object(struct mem_others *others, uint64_t device, uint64_t inode)
{
	if (!is_wanted(others, device))
		return;
	if (others->count == OBJECTS_MAX ||
	    !make_room(&others->object, others->count, &others->room, sizeof *others->object)) {
		others->unknown = true;
		return;
	}
	others->object[others->count++] = (struct object){ device, inode };
}

struct looking {
	struct mem_others *others;
	pid_t pid;
};

static int add_mapped(const struct mapping *m, void *arg)
{
	const struct looking *at = arg;

	if (mapping_is_segment(m))
		add_object(at->others, segment_device(m->device, at->pid), m->inode);
	else if (m->shared && m->inode)
		add_object(at->others, m->device, m->inode);
	return 0;
}

/* From /proc/PID/fd, without asking a file server. */
static bool look_at_descriptor(int fd_dir, const char *number, struct statx *st)
{
	struct stat link;

	return fstatat(fd_dir, number, &link, AT_SYMLINK_NOFOLLOW) == 0 && link.st_mode & S_IWUSR &&
	       statx(fd_dir, number, AT_STATX_DONT_SYNC | AT_NO_AUTOMOUNT, STATX_TYPE | STATX_INO,
		     st) == 0 &&
	       S_ISREG(st->stx_mode);
}

static void add_opened(struct mem_others *others, pid_t pid)
{
	const int fd = proc_open(pid, "fd", O_RDONLY | O_DIRECTORY);
	DIR *dir = fd < 0 ? NULL : fdopendir(fd);
	struct dirent *entry;
	struct statx st;

	while (dir && (entry = readdir(dir)))
		if (entry->d_name[0] != '.' && look_at_descriptor(fd, entry->d_name, &st))
			add_object(others, device_of(&st), st.stx_ino);
	if (dir)
		closedir(dir);
	else if (fd >= 0)
		close(fd);
}

int area_find_descriptor(pid_t pid, const struct area *a)
{
	const int fd = proc_open(pid, "fd", O_RDONLY | O_DIRECTORY);
	DIR *dir = fd < 0 ? NULL : fdopendir(fd);
	struct dirent *entry;
	struct statx st;
	int found = -1;

	while (dir && found < 0 && (entry = readdir(dir)))
		if (entry->d_name[0] != '.' && look_at_descriptor(fd, entry->d_name, &st) &&
		    st.stx_ino == a->inode && device_of(&st) == a->device)
			found = atoi(entry->d_name);
	if (dir)
		closedir(dir);
	else if (fd >= 0)
		close(fd);
	return found;
}

/* Whether a process in the application's PID namespace belongs to the application. */
static bool is_below(pid_t pid, pid_t init)
{
	struct proc_stat stat;

	for (int i = 0; pid != init && i < ANCESTORS_MAX; i++) {
		if (pid <= 1 || proc_stat(pid, &stat))
			return false;
		pid = stat.parent;
	}
	return pid == init;
}

static void look(struct mem_others *others, const struct process *process)
{
	const bool whole = proc_inside(process->init) == 1;
	char inside[64] = "", its[64];
	DIR *proc = got_memory(opendir("/proc"));
	struct dirent *entry;

	others->looked_ns = now_ns();
	others->count = 0;
	others->unknown = !proc || proc_link(process->init, "ns/pid", inside, sizeof inside) < 0;
	while (!others->unknown && (entry = readdir(proc))) {
		const pid_t pid = (pid_t)atoi(entry->d_name);

		if (pid <= 0 || pid == getpid() || proc_link(pid, "ns/pid", its, sizeof its) < 0 ||
		    (!strcmp(its, inside) && (whole || is_below(pid, process->init))))
			continue;
		heartbeat();
		(void)proc_mappings(pid, "maps", add_mapped, &(struct looking){ others, pid });
		add_opened(others, pid);
	}
	if (proc)
		closedir(proc);
	if (others->count)
		qsort(others->object, others->count, sizeof *others->object, compare);
	others->cost_ns = now_ns() - others->looked_ns;
}

void mem_others_scan(struct mem_others *others, const struct process *process,
		     const struct areas *areas, uint64_t since)
{
	bool any = false,
	     fresh = now_ns() - others->looked_ns < LOOK_NS + others->cost_ns * LOOK_SHARE;

	for (uint32_t i = 0; i < areas->count; i++) {
		const struct area *a = &areas->area[i];

		if (!a->named)
			continue;
		any = true;
		if (is_wanted(others, a->device))
			continue;
		fresh = false;
		if (others->devices < DEVICES_MAX)
			others->device[others->devices++] = a->device;
	}
	if (any && (!fresh || others->looked_ns < since))
		look(others, process);
}

bool mem_others_have(const struct mem_others *others, const struct area *a)
{
	const struct object wanted = { a->device, a->inode };

	return others->unknown || !is_wanted(others, a->device) ||
	       (others->count &&
		bsearch(&wanted, others->object, others->count, sizeof wanted, compare));
}

/* ---- who writes to it --------------------------------------------------------------- */

static struct watch *find_number(struct mem_others *others, int number)
{
	for (uint32_t i = 0; i < others->watches; i++)
		if (others->watch[i].number == number)
			return &others->watch[i];
	return NULL;
}

static void take_event(struct mem_others *others, const struct inotify_event *event)
{
	struct watch *watch = find_number(others, event->wd);

	if (event->mask & IN_Q_OVERFLOW)
		others->lost++;
	else if (watch && event->mask & IN_IGNORED) /* its name is gone */
		*watch = others->watch[--others->watches];
	else if (watch)
		watch->writes++;
}

static void take_events(struct mem_others *others)
{
	char buf[16384] __attribute__((aligned(8)));
	int reads = 0;
	ssize_t n = 0;

	while (others->inotify >= 0 && reads++ < READS_MAX &&
	       (n = read(others->inotify, buf, sizeof buf)) > 0)
		for (ssize_t at = 0; at < n;) {
			const struct inotify_event *event =
				(const struct inotify_event *)(buf + at);

			at += (ssize_t)(sizeof *event + event->len);
			take_event(others, event);
		}
	if (n > 0)
		others->lost++;
}

void mem_others_watch(struct mem_others *others, pid_t template, const struct area *a)
{
	const struct object object = { a->device, a->inode };
	char path[96];
	int number;

	for (uint32_t i = 0; i < others->watches; i++)
		if (!compare(&others->watch[i].object, &object))
			return;
	if (others->inotify < 0)
		others->inotify = inotify_init1(IN_NONBLOCK | IN_CLOEXEC);
	if (others->watches == WATCHES_MAX ||
	    !make_room(&others->watch, others->watches, &others->watch_room, sizeof *others->watch))
		return;
	snprintf(path, sizeof path, "/proc/%d/map_files/%lx-%lx", template, (unsigned long)a->start,
		 (unsigned long)a->end);
	number = inotify_add_watch(others->inotify, path, IN_MODIFY);
	if (number >= 0)
		others->watch[others->watches++] = (struct watch){ number, object, 0 };
}

uint32_t mem_others_writes(struct mem_others *others, const struct area *a)
{
	const struct object object = { a->device, a->inode };

	take_events(others);
	for (uint32_t i = 0; i < others->watches; i++)
		if (!compare(&others->watch[i].object, &object))
			return others->lost + others->watch[i].writes;
	return others->lost;
}
