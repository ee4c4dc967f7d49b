/* SPDX-License-Identifier: Apache-2.0
 *
 * What /proc/PID/fdinfo says of a descriptor (proc(5)).
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "files.h"

/* Of the arrays: how many elements there is memory for. */
struct rooms {
	uint32_t locks, watches, marks;
};

/* As make_room(), within the checkpoint's budget. */
static bool take_room(void *array, uint32_t count, uint32_t *room, size_t bytes)
{
	return count < *room ||
	       (budget_take((*room ? *room : 16) * bytes) && make_room(array, count, room, bytes));
}

/* "1: POSIX  ADVISORY  WRITE 14092 fe:00:2147490 5 14" */
static void add_lock(struct file *file, const char *line, uint32_t *room)
{
	char kind[16], mode[16], way[16], end[24];
	struct file_lock lock;
	long long start;

	if (sscanf(line, "%*d: %15s %15s %15s %*d %*s %lld %23s", kind, mode, way, &start, end) !=
	    5)
		return;
	if (!strcmp(kind, "FLOCK"))
		lock.kind = LOCK_FLOCK_;
	else if (!strcmp(kind, "POSIX"))
		lock.kind = LOCK_POSIX_;
	else if (!strcmp(kind, "OFDLCK"))
		lock.kind = LOCK_OFD_;
	else
		return; /* a lease */
	lock.exclusive = !strcmp(way, "WRITE");
	lock.start = start;
	lock.end = strcmp(end, "EOF") ? atoll(end) : -1;
	if (take_room(&file->lock, file->lock_count, room, sizeof lock))
		file->lock[file->lock_count++] = lock;
}

static void add_watch(struct file *file, const char *line, uint32_t *room)
{
	struct file_watch watch = { 0 };
	unsigned long long data, ino = 0;
	unsigned int dev = 0;

	if (sscanf(line, " %d events: %x data: %llx pos:%*d ino:%llx sdev:%x", &watch.fd,
		   &watch.events, &data, &ino, &dev) < 3)
		return;
	watch.data = data;
	watch.ino = ino;
	watch.dev = dev;
	watch.at = file->watch_count;
	watch.of = watch.fd;
	if (take_room(&file->watch, file->watch_count, room, sizeof watch))
		file->watch[file->watch_count++] = watch;
}

/* Two hex digits for each byte.  False: there is less. */
static bool parse_handle(const char *text, uint8_t *handle, uint32_t bytes)
{
	if (strspn(text, "0123456789abcdef") < 2 * (size_t)bytes)
		return false;
	for (uint32_t i = 0; i < bytes; i++)
		(void)sscanf(text + 2 * i, "%2hhx", &handle[i]);
	return true;
}

/* "5 ino:3f7e8 sdev:fe00000 mask:fff ignored_mask:0 fhandle-bytes:8 fhandle-type:1
 * f_handle:e8f7030000000000"; without what begins with f for a file system without. */
static void add_mark(struct file *file, const char *line, uint32_t *room)
{
	struct file_mark mark = { 0 };
	unsigned long ino;
	unsigned int wd, dev, type = 0;
	int at = 0;

	if (sscanf(line,
		   "%x ino:%lx sdev:%x mask:%x ignored_mask:%*x fhandle-bytes:%x fhandle-type:%x"
		   " f_handle:%n",
		   &wd, &ino, &dev, &mark.mask, &mark.handle_bytes, &type, &at) < 4)
		return;
	mark.wd = (int)wd;
	mark.ino = ino;
	mark.dev = dev;
	mark.handle_type = (int)type;
	if (!at || mark.handle_bytes > sizeof mark.handle ||
	    !parse_handle(line + at, mark.handle, mark.handle_bytes))
		mark.handle_bytes = 0;
	if (take_room(&file->mark, file->mark_count, room, sizeof mark))
		file->mark[file->mark_count++] = mark;
}

static uint64_t nanoseconds(const char *value)
{
	unsigned long long s, ns;

	return sscanf(value, " (%llu, %llu)", &s, &ns) == 2 ? s * NS_PER_S + ns : 0;
}

static void timer_deadline(struct file *file, uint64_t left_ns)
{
	const uint64_t now = left_ns ? clock_ns(file->clock) : 0;

	file->deadline_ns = now ? now + left_ns : 0;
}

static void take_line(struct file *file, const char *key, const char *value, struct rooms *room,
		      uint64_t *left_ns)
{
	if (!strcmp(key, "flags")) {
		file->told_flags = (int)strtoul(value, NULL, 8);
		file->cloexec = file->told_flags & O_CLOEXEC;
	} else if (!strcmp(key, "pos"))
		file->told_offset = atoll(value);
	else if (!strcmp(key, "ino"))
		file->told_ino = strtoull(value, NULL, 10);
	else if (!strcmp(key, "lock"))
		add_lock(file, value, &room->locks);
	else if (!strcmp(key, "eventfd-count"))
		file->count = strtoull(value, NULL, 16);
	else if (!strcmp(key, "eventfd-id"))
		file->id = strtoull(value, NULL, 10) + 1;
	else if (!strcmp(key, "eventfd-semaphore"))
		file->semaphore = atoi(value);
	else if (!strcmp(key, "clockid"))
		file->clock = atoi(value);
	else if (!strcmp(key, "ticks"))
		file->ticks = strtoull(value, NULL, 10);
	else if (!strcmp(key, "settime flags"))
		file->settime_flags = (int)strtol(value, NULL, 8);
	else if (!strcmp(key, "it_value"))
		*left_ns = nanoseconds(value);
	else if (!strcmp(key, "it_interval"))
		file->interval_ns = nanoseconds(value);
	else if (!strcmp(key, "sigmask"))
		file->mask = strtoull(value, NULL, 16);
	else if (!strcmp(key, "Pid"))
		file->pid = atoi(value);
	else if (!strcmp(key, "tfd"))
		add_watch(file, value, &room->watches);
	else if (!strcmp(key, "inotify wd"))
		add_mark(file, value, &room->marks);
}

/* The kernel uses its own order; there may be tens of thousands to compare. */
static int by_number(const void *a, const void *b)
{
	const struct file_watch *x = a, *y = b;

	if (x->fd != y->fd)
		return x->fd < y->fd ? -1 : 1;
	return (x->at > y->at) - (x->at < y->at);
}

static int by_wd(const void *a, const void *b)
{
	const struct file_mark *x = a, *y = b;

	return (x->wd > y->wd) - (x->wd < y->wd);
}

static void sort_watched(struct file *file)
{
	if (file->watch_count)
		qsort(file->watch, file->watch_count, sizeof *file->watch, by_number);
	for (uint32_t i = 0; i < file->watch_count; i++)
		file->watch[i].at = i && file->watch[i].fd == file->watch[i - 1].fd
					    ? file->watch[i - 1].at + 1
					    : 0;
	if (file->mark_count)
		qsort(file->mark, file->mark_count, sizeof *file->mark, by_wd);
}

uint64_t file_count(int fd)
{
	struct file file = { .fd = fd, .kind = FILE_EVENTFD };

	return file_read_info(getpid(), &file) ? file.count : 0;
}

static const struct {
	enum file_kind kind;
	const char *key;
} telling[] = {
	{ FILE_EVENTFD, "eventfd-count" },
	{ FILE_TIMERFD, "clockid" },
	{ FILE_SIGNALFD, "sigmask" },
	{ FILE_EPOLL, "tfd" },
	{ FILE_PIDFD, "Pid" },
};

bool file_parse_info(struct file *file, char *text)
{
	char *line, *next;
	uint64_t left_ns = 0;
	struct rooms room = { 0 };
	bool told = false;

	file->lock_count = 0;
	file->watch_count = 0;
	file->mark_count = 0;
	for (line = text; *line; line = next) {
		char *colon;

		next = line + strcspn(line, "\n");
		if (*next)
			*next++ = 0;
		colon = strchr(line, ':');
		if (!colon)
			continue;
		*colon = 0;
		take_line(file, line, colon + 1, &room, &left_ns);
		for (size_t i = 0; i < sizeof telling / sizeof *telling; i++)
			told |= file->kind == telling[i].kind && !strcmp(line, telling[i].key);
	}
	sort_watched(file);
	if (file->kind == FILE_TIMERFD)
		timer_deadline(file, left_ns);
	return told;
}

bool file_read_info(pid_t pid, struct file *file)
{
	char name[32], first[4096], *text;
	bool told;

	snprintf(name, sizeof name, "fdinfo/%d", file->fd);
	text = proc_text(pid, name, first, sizeof first);
	if (!text && errno == EFBIG)
		budget_exceed(
			AVC_UNSUPPORTED,
			"it watches more by one epoll or inotify descriptor than can be kept");
	if (!text)
		return false;
	told = file_parse_info(file, text);
	if (text != first)
		free(text);
	return told;
}
