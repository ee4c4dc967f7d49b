/* SPDX-License-Identifier: Apache-2.0
 *
 * /proc, see proc(5): opened and read here, parsed in proc_text.c.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/kcmp.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "base.h"

#define PF_EXITING 4 /* include/linux/sched.h; not for user space otherwise */
#define PF_SIGNALED 0x400
#define WAIT_STEP_NS (50 * NS_PER_MS)

int proc_open(pid_t pid, const char *name, int flags)
{
	char path[96];

	snprintf(path, sizeof path, "/proc/%d/%s", pid, name);
	return got_fd(open(path, flags | O_CLOEXEC));
}

struct mapped_path {
	char text[80];
};

static struct mapped_path mapped_path(pid_t pid, avc_remote start, avc_remote end)
{
	struct mapped_path path;

	snprintf(path.text, sizeof path.text, "/proc/%d/map_files/%lx-%lx", pid,
		 (unsigned long)start, (unsigned long)end);
	return path;
}

bool proc_mapped_for_writing(pid_t pid, avc_remote start, avc_remote end)
{
	struct stat st;

	return lstat(mapped_path(pid, start, end).text, &st) == 0 && st.st_mode & S_IWUSR;
}

int proc_open_mapped(pid_t pid, avc_remote start, avc_remote end, int flags)
{
	if ((flags & O_ACCMODE) != O_RDONLY && !proc_mapped_for_writing(pid, start, end)) {
		errno = EACCES;
		return -1;
	}
	return got_fd(open(mapped_path(pid, start, end).text, flags | O_CLOEXEC));
}

/* Reads from the start, even if it was read before; the result is terminated. */
static ssize_t read_text(int fd, char *buf, size_t size)
{
	const ssize_t n = pread(fd, buf, size - 1, 0);

	if (n >= 0)
		buf[n] = 0;
	return n;
}

ssize_t proc_read(pid_t pid, const char *name, char *buf, size_t size)
{
	int fd = proc_open(pid, name, O_RDONLY), saved;
	ssize_t n;

	if (fd < 0)
		return -1;
	n = read_text(fd, buf, size);
	saved = errno;
	close(fd);
	errno = saved;
	return n;
}

char *proc_text(pid_t pid, const char *name, char *first, size_t first_bytes)
{
	int fd = proc_open(pid, name, O_RDONLY), saved;
	size_t room = first_bytes, used = 0;
	char *text = first;
	ssize_t n = -1;

	while (fd >= 0 && (n = read(fd, text + used, room - used - 1)) > 0) {
		char *more;

		used += (size_t)n;
		if (used < room - 1) {
			n = 0; /* it has one record (fs/seq_file.c, single_open()) */
			break;
		}
		if (used > PROC_TEXT_MAX) {
			errno = EFBIG;
			n = -1;
			break;
		}
		more = got_memory(realloc(text == first ? NULL : text, 4 * room));
		if (!more) {
			n = -1;
			break;
		}
		if (text == first)
			memcpy(more, first, used);
		text = more;
		room *= 4;
	}
	saved = errno;
	close_fd(&fd);
	if (n == 0) {
		text[used] = 0;
		return text;
	}
	if (text != first)
		free(text);
	errno = saved;
	return NULL;
}

int proc_link(pid_t pid, const char *name, char *buf, size_t size)
{
	char path[64];
	ssize_t n;

	snprintf(path, sizeof path, "/proc/%d/%s", pid, name);
	n = readlink(path, buf, size - 1);
	if (n < 0)
		return -1;
	buf[n] = 0;
	return 0;
}

bool proc_look(pid_t pid, const char *name, unsigned int what, struct statx *st)
{
	char path[64];

	snprintf(path, sizeof path, "/proc/%d/%s", pid, name);
	return !statx(AT_FDCWD, path, AT_STATX_DONT_SYNC | AT_NO_AUTOMOUNT, what, st);
}

bool fd_look(int fd, unsigned int what, struct statx *st)
{
	return !statx(fd, "", AT_EMPTY_PATH | AT_STATX_DONT_SYNC | AT_NO_AUTOMOUNT, what, st);
}

int fd_option(int fd, int level, int name)
{
	int value = 0;
	socklen_t bytes = sizeof value;

	return getsockopt(fd, level, name, &value, &bytes) ? -1 : value;
}

int proc_same_file(pid_t a, pid_t b, const char *name)
{
	struct statx is, other;

	if (!proc_look(a, name, STATX_INO, &is) || !proc_look(b, name, STATX_INO, &other))
		return -1;
	return is.stx_ino == other.stx_ino && device_of(&is) == device_of(&other);
}

int proc_stat(pid_t pid, struct proc_stat *stat)
{
	char buf[1024];

	return proc_read(pid, "stat", buf, sizeof buf) < 0 ? -1 : proc_parse_stat(buf, stat);
}

/* pthread_getcpuclockid(3): readable for any process. */
uint64_t proc_cpu_ns(pid_t pid)
{
	clockid_t clock;

	return clock_getcpuclockid(pid, &clock) ? 0 : clock_ns(clock);
}

int proc_stat_of(int stat_fd, struct proc_stat *stat)
{
	char buf[1024];

	return read_text(stat_fd, buf, sizeof buf) < 0 ? -1 : proc_parse_stat(buf, stat);
}

pid_t proc_inside(pid_t tid)
{
	struct proc_status status;

	return proc_status(tid, &status) ? -1 : status.inside;
}

/* Its memory goes first, before it is a zombie. */
static bool is_live(pid_t tid)
{
	char buf[64];
	struct proc_stat stat;

	return proc_stat(tid, &stat) == 0 && stat.state != 'Z' && stat.state != 'X' &&
	       proc_read(tid, "statm", buf, sizeof buf) > 0 && atol(buf) > 0;
}

static int find_live(pid_t tid, void *arg)
{
	pid_t *found = arg;

	if (!is_live(tid))
		return 0;
	*found = tid;
	return -1;
}

pid_t proc_live_thread(pid_t pid)
{
	pid_t found = 0;
	int dirfd;

	errno = 0;
	if (is_live(pid))
		return pid;
	dirfd = is_shortage(errno) ? -1 : proc_open(pid, "task", O_RDONLY | O_DIRECTORY);
	if (dirfd >= 0) {
		(void)proc_numbers(dirfd, find_live, &found);
		close(dirfd);
	}
	if (!found && !is_shortage(errno))
		errno = ESRCH;
	return found;
}

void proc_await_end(pid_t tid)
{
	struct proc_stat stat;

	for (int us = 0; us < 1000000; us += 50) {
		if (proc_stat(tid, &stat) || stat.state == 'Z' || stat.state == 'X')
			return;
		usleep(50);
	}
}

#define LONGEST_NUMBER sizeof "4194304"
#define CHILDREN_TRIES 64

/* A read(2) of this file returns at most a page, and for the next one the kernel finds its place by
 * counting: if an earlier child is reaped in between, another one is left out (fs/proc/array.c,
 * get_children_pid()).  Two reads that say the same have left out none. */
static int read_children(int fd, pid_t *children, int max)
{
	char text[2][CHILDREN_MAX * LONGEST_NUMBER], *last = text[0];
	ssize_t n = 0;

	if (fd < 0)
		return -1;
	for (int i = 0; i < CHILDREN_TRIES; i++) {
		const ssize_t before = n;

		last = text[i % 2];
		n = read_whole(fd, (uint8_t *)last, sizeof *text - 1, 0);
		if (n < (ssize_t)(ARCH_PAGE_BYTES - LONGEST_NUMBER) ||
		    (n == before && !memcmp(text[0], text[1], (size_t)n)))
			break;
	}
	close(fd);
	if (n < 0)
		return -1;
	last[n] = 0;
	return proc_parse_children(last, children, max);
}

int proc_children_of(int task_dirfd, pid_t tid, pid_t *children, int max)
{
	char name[32];

	snprintf(name, sizeof name, "%d/children", tid);
	return read_children(got_fd(openat(task_dirfd, name, O_RDONLY | O_CLOEXEC)), children, max);
}

int proc_children(pid_t pid, pid_t *children, int max)
{
	char name[32];

	snprintf(name, sizeof name, "task/%d/children", pid);
	return read_children(proc_open(pid, name, O_RDONLY), children, max);
}

FILE *proc_lines(pid_t pid, const char *name, char buffer[PROC_LINES])
{
	char path[64];
	FILE *lines;

	snprintf(path, sizeof path, "/proc/%d/%s", pid, name);
	lines = got_memory(fopen(path, "re"));
	if (lines)
		(void)setvbuf(lines, buffer, _IOFBF, PROC_LINES);
	return lines;
}

int proc_mappings(pid_t pid, const char *file, int (*fn)(const struct mapping *mapping, void *arg),
		  void *arg)
{
	char buffer[PROC_LINES];
	FILE *maps = proc_lines(pid, file, buffer);
	int result;

	if (!maps)
		return -1;
	result = proc_parse_mappings(maps, !strcmp(file, "smaps"), fn, arg);
	fclose(maps);
	return result;
}

int proc_status(pid_t tid, struct proc_status *status)
{
	char first[8192], *text = proc_text(tid, "status", first, sizeof first);
	int result;

	if (!text)
		return -1;
	result = proc_parse_status(text, status);
	if (text != first)
		free(text);
	return result;
}

int proc_status_of(int status_fd, pid_t tid, struct proc_status *status)
{
	char text[8192];
	ssize_t n;

	if (status_fd < 0)
		return proc_status(tid, status);
	n = read_text(status_fd, text, sizeof text);
	if (n == 0)
		errno = ESRCH;
	if (n <= 0)
		return -1;
	/* Very many groups */
	return n == sizeof text - 1 ? proc_status(tid, status) : proc_parse_status(text, status);
}

int proc_limits(pid_t pid, uint64_t limit[LIMITS][2])
{
	char buf[4096];

	return proc_read(pid, "limits", buf, sizeof buf) <= 0 ? -1 : proc_parse_limits(buf, limit);
}

struct linux_dirent64 {
	uint64_t d_ino;
	int64_t d_off;
	unsigned short d_reclen;
	unsigned char d_type;
	char d_name[];
};

int proc_numbers(int dirfd, int (*fn)(pid_t number, void *arg), void *arg)
{
	char buf[16384] __attribute__((aligned(8)));

	if (lseek(dirfd, 0, SEEK_SET) < 0)
		return -1;
	for (;;) {
		long n = syscall(SYS_getdents64, dirfd, buf, sizeof buf);

		if (n < 0)
			return -1;
		if (n == 0)
			return 0;
		for (long at = 0; at < n;) {
			struct linux_dirent64 *entry = (struct linux_dirent64 *)(buf + at);

			at += entry->d_reclen;
			if (entry->d_name[0] != '.' && fn((pid_t)atoi(entry->d_name), arg) < 0)
				return -1;
		}
	}
}

bool proc_same_memory(pid_t a, pid_t b)
{
	return syscall(SYS_kcmp, a, b, KCMP_VM, 0, 0) == 0;
}

int proc_shares(pid_t a, pid_t b, enum shared what)
{
	const long order = syscall(SYS_kcmp, a, b, what == SHARED_FILES ? KCMP_FILES : KCMP_FS, 0,
				   0);

	return order < 0 ? -1 : order == 0;
}

/* A directory has a link for itself and one for each directory in it (fs/proc/base.c,
 * proc_task_getattr()). */
int proc_thread_count(int task_dirfd)
{
	struct stat st;

	return fstat(task_dirfd, &st) || st.st_nlink < 2 ? 0 : (int)st.st_nlink - 2;
}

long proc_vm_pages(int statm_fd, long *anonymous)
{
	char buf[128];
	long pages, of_no_file;

	if (read_text(statm_fd, buf, sizeof buf) <= 0 || proc_parse_statm(buf, &pages, &of_no_file))
		return -1;
	if (anonymous)
		*anonymous = of_no_file;
	return pages;
}

/* Of a line in kB, "\nNAME:"; -1: there is none. */
static long pages_of(const char *text, const char *name)
{
	const char *line = strstr(text, name);

	return line ? (long)(strtoul(line + strlen(name), NULL, 10) / (ARCH_PAGE_BYTES / 1024))
		    : -1;
}

long proc_private_pages(pid_t pid)
{
	char buf[2048];

	return proc_read(pid, "smaps_rollup", buf, sizeof buf) <= 0
		       ? -1
		       : pages_of(buf, "\nPrivate_Dirty:");
}

long proc_host_available(void)
{
	char buf[512];
	int fd = open("/proc/meminfo", O_RDONLY | O_CLOEXEC);
	const ssize_t n = fd < 0 ? -1 : read_text(fd, buf, sizeof buf);

	close_fd(&fd);
	return n <= 0 ? -1 : pages_of(buf, "\nMemAvailable:");
}

pid_t proc_pidfd_pid(int pidfd)
{
	char name[48], buf[1024], *line;

	snprintf(name, sizeof name, "fdinfo/%d", pidfd);
	if (proc_read(getpid(), name, buf, sizeof buf) < 0)
		return -1;
	line = strstr(buf, "Pid:");
	return line ? atoi(line + 4) : -1;
}

int proc_pidfd_open(pid_t pid)
{
	return got_fd((int)syscall(SYS_pidfd_open, pid, 0));
}

int proc_sched(pid_t tid, struct proc_sched *sched)
{
	char buf[4096];

	return proc_read(tid, "sched", buf, sizeof buf) <= 0 ? -1 : proc_parse_sched(buf, sched);
}

/* A task gets the flag before it closes any descriptor (kernel/exit.c, do_exit()). */
bool proc_is_exiting(pid_t tid)
{
	struct proc_stat stat;

	if (proc_stat(tid, &stat))
		return !is_shortage(errno);
	return stat.flags & PF_EXITING;
}

/* All threads get the flag before the kernel writes a core (kernel/signal.c, get_signal()). */
bool proc_is_dying(int stat_fd)
{
	struct proc_stat stat;

	return proc_stat_of(stat_fd, &stat) == 0 && stat.flags & PF_SIGNALED;
}

bool proc_is_dumping(pid_t pid)
{
	char buf[4096];

	return proc_read(pid, "status", buf, sizeof buf) > 0 && strstr(buf, "\nCoreDumping:\t1");
}

bool proc_is_killed(pid_t pid)
{
	static const char *const sets[] = { "\nSigPnd:", "\nShdPnd:" };
	char buf[4096];
	ssize_t n;

	if (proc_is_exiting(pid))
		return true;
	n = proc_read(pid, "status", buf, sizeof buf);
	if (n <= 0)
		return n == 0 || !is_shortage(errno);
	for (size_t i = 0; i < sizeof sets / sizeof *sets; i++) {
		const char *line = strstr(buf, sets[i]);

		if (line && strtoull(line + strlen(sets[i]), NULL, 16) & 1U << (SIGKILL - 1))
			return true;
	}
	return false;
}

bool pidfd_ended(int pidfd)
{
	struct pollfd p = { .fd = pidfd, .events = POLLIN };

	return poll_for(&p, 1, 0) == 1;
}

bool pidfd_await_end(int pidfd, uint64_t ns)
{
	const uint64_t end = now_ns() + restore_patience(ns);
	struct pollfd p = { .fd = pidfd, .events = POLLIN };

	while (poll_for(&p, 1, WAIT_STEP_NS < ns ? WAIT_STEP_NS : ns) != 1) {
		if (!budget_wait() || now_ns() >= end)
			return false;
	}
	return true;
}

int proc_borrow_fd(int pidfd, int fd)
{
	return got_fd((int)syscall(SYS_pidfd_getfd, pidfd, fd, 0));
}

int proc_oom_score_adj(pid_t pid)
{
	char text[16];

	return proc_read(pid, "oom_score_adj", text, sizeof text) > 0 ? atoi(text) : 0;
}

void proc_set_oom_score_adj(pid_t pid, const char *value)
{
	int fd = proc_open(pid, "oom_score_adj", O_WRONLY);

	if (fd < 0)
		return;
	if (write(fd, value, strlen(value)) < 0)
		errno = 0; /* best effort */
	close(fd);
}
