/* SPDX-License-Identifier: Apache-2.0
 *
 * /proc, see proc(5).
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

int proc_open(pid_t pid, const char *name, int flags)
{
	char path[96];

	snprintf(path, sizeof path, "/proc/%d/%s", pid, name);
	return open(path, flags | O_CLOEXEC);
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
	return open(mapped_path(pid, start, end).text, flags | O_CLOEXEC);
}

/* From the start, also of one that was read before; what is read is terminated. */
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

static int parse_stat(const char *buf, struct proc_stat *stat)
{
	const char *name = strchr(buf, '('), *last = strrchr(buf, ' '), *p;
	int tty;
	unsigned long long start;

	/* The name may hold anything, also ") R": the last ')' ends it. */
	p = strrchr(buf, ')');
	if (!name || !last || !p ||
	    sscanf(p + 1,
		   " %c %d %d %d %d %d %u %*u %*u %*u %*u %*u %*u %*d %*d %*d %*d %d %*d %llu"
		   " %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %d",
		   &stat->state, &stat->parent, &stat->group, &stat->session, &tty,
		   &stat->tty_group, &stat->flags, &stat->threads, &start,
		   &stat->exit_signal) != 10) {
		errno = EPROTO;
		return -1;
	}
	stat->tty = (uint32_t)tty;
	stat->start = start;
	stat->exit_status = atoi(last + 1);
	snprintf(stat->name, sizeof stat->name, "%.*s", (int)(p - name - 1), name + 1);
	return 0;
}

int proc_stat(pid_t pid, struct proc_stat *stat)
{
	char buf[1024];

	return proc_read(pid, "stat", buf, sizeof buf) < 0 ? -1 : parse_stat(buf, stat);
}

int proc_stat_of(int stat_fd, struct proc_stat *stat)
{
	char buf[1024];

	return read_text(stat_fd, buf, sizeof buf) < 0 ? -1 : parse_stat(buf, stat);
}

pid_t proc_inside(pid_t tid)
{
	char buf[4096], *line, *last, *end;

	if (proc_read(tid, "status", buf, sizeof buf) < 0)
		return -1;
	line = strstr(buf, "\nNSpid:");
	if (!line)
		return -1;
	line++;
	end = strchr(line, '\n');
	if (end)
		*end = 0;
	last = strrchr(line, '\t');
	return last ? atoi(last) : -1;
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

	if (is_live(pid))
		return pid;
	dirfd = proc_open(pid, "task", O_RDONLY | O_DIRECTORY);
	if (dirfd < 0)
		return 0;
	(void)proc_tasks(dirfd, find_live, &found);
	close(dirfd);
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

int proc_children_of(int task_dirfd, pid_t tid, pid_t *children, int max)
{
	char name[32], buf[CHILDREN_MAX * sizeof "4194304"], *p = buf;
	int count = 0, fd;
	ssize_t n;

	snprintf(name, sizeof name, "%d/children", tid);
	fd = openat(task_dirfd, name, O_RDONLY | O_CLOEXEC);
	if (fd < 0)
		return -1;
	/* One read(2) of many is a page at most. */
	n = read_whole(fd, (uint8_t *)buf, sizeof buf - 1, 0);
	close(fd);
	if (n < 0)
		return -1;
	buf[n] = 0;
	while (count < max) {
		char *next;
		long child = strtol(p, &next, 10);

		if (next == p)
			break;
		children[count++] = (pid_t)child;
		p = next;
	}
	return count;
}

int proc_children(pid_t pid, pid_t *children, int max)
{
	const int task_dirfd = proc_open(pid, "task", O_RDONLY | O_DIRECTORY);
	int count;

	if (task_dirfd < 0)
		return -1;
	count = proc_children_of(task_dirfd, pid, children, max);
	close(task_dirfd);
	return count;
}

static const struct {
	char name[3];
	enum mapping_flag flag;
} mapping_flags[] = {
	{ "dc", MAPPING_DONTFORK },  { "wf", MAPPING_WIPEONFORK }, { "io", MAPPING_DEVICE },
	{ "lo", MAPPING_LOCKED },    { "dp", MAPPING_DROPPABLE },  { "ht", MAPPING_HUGETLB },
	{ "hg", MAPPING_HUGE },      { "nh", MAPPING_SMALL },      { "dd", MAPPING_DONTDUMP },
	{ "mg", MAPPING_MERGEABLE }, { "gd", MAPPING_GROWING },    { "sl", MAPPING_SEALED },
	{ "de", MAPPING_FIXED },     { "pf", MAPPING_FIXED },      { "mm", MAPPING_FIXED },
};

static uint32_t parse_flags(const char *p)
{
	uint32_t flags = 0;

	for (; *p == ' '; p += strlen(p) > 3 ? 3 : strlen(p))
		for (size_t i = 0; i < sizeof mapping_flags / sizeof *mapping_flags; i++)
			if (!strncmp(p + 1, mapping_flags[i].name, 2))
				flags |= mapping_flags[i].flag;
	return flags;
}

static bool parse_mapping(const char *line, struct mapping *m)
{
	unsigned long start, end, offset, inode;
	unsigned int major, minor;
	int name = 0;

	*m = (struct mapping){ 0 };
	if (sscanf(line, "%lx-%lx %4s %lx %x:%x %lu %n", &start, &end, m->mode, &offset, &major,
		   &minor, &inode, &name) < 7)
		return false;
	m->device = (uint64_t)major << 32 | minor;
	m->start = start;
	m->end = end;
	m->offset = offset;
	m->inode = inode;
	m->shared = m->mode[3] == 's';
	snprintf(m->name, sizeof m->name, "%.*s", (int)strcspn(line + name, "\n"), line + name);
	return true;
}

int proc_mappings(pid_t pid, const char *file, int (*fn)(const struct mapping *mapping, void *arg),
		  void *arg)
{
	const bool smaps = !strcmp(file, "smaps");
	struct mapping m = { 0 };
	char path[64], *line = NULL;
	size_t size = 0;
	int result = 0;
	FILE *maps;

	snprintf(path, sizeof path, "/proc/%d/%s", pid, file);
	maps = fopen(path, "re");
	if (!maps)
		return -1;
	while (!result && getline(&line, &size, maps) > 0) {
		heartbeat();
		if (smaps && !strncmp(line, "ProtectionKey:", 14)) {
			m.flags = (uint32_t)strtoul(line + 14, NULL, 10) * MAPPING_KEY_ONE &
				  MAPPING_KEYS;
		} else if (smaps && !strncmp(line, "VmFlags:", 8)) {
			m.flags |= parse_flags(line + 8);
			result = fn(&m, arg);
		} else if (!smaps || !(line[0] >= 'A' && line[0] <= 'Z')) {
			if (parse_mapping(line, &m) && !smaps)
				result = fn(&m, arg);
		}
	}
	if (ferror(maps))
		result = -1;
	free(line);
	fclose(maps);
	return result < 0 ? -1 : 0;
}

int mapping_protection(const struct mapping *m)
{
	return (m->mode[0] == 'r' ? PROT_READ : 0) | (m->mode[1] == 'w' ? PROT_WRITE : 0) |
	       (m->mode[2] == 'x' ? PROT_EXEC : 0);
}

bool mapping_is_special(const struct mapping *m)
{
	return !strncmp(m->name, "[vdso", 5) || !strncmp(m->name, "[vvar", 5);
}

static void parse_ids(const char *p, uint32_t id[4])
{
	sscanf(p, "%u %u %u %u", &id[0], &id[1], &id[2], &id[3]);
}

static void parse_groups(const char *p, struct proc_status *status)
{
	char *next;

	while (status->group_count < STATUS_GROUPS) {
		const unsigned long group = strtoul(p, &next, 10);

		if (next == p)
			return;
		status->groups[status->group_count++] = (uint32_t)group;
		p = next;
	}
}

#define LIMIT_NAME 26 /* columns: fs/proc/base.c, proc_pid_limits() */
#define LIMIT_VALUE 21

int proc_status(pid_t tid, struct proc_status *status)
{
	static const char *const caps[5] = { "CapInh:", "CapPrm:", "CapEff:", "CapBnd:",
					     "CapAmb:" };
	char buf[8192], *line, *save = NULL;

	*status = (struct proc_status){ .locked_kb = -1 };
	if (proc_read(tid, "status", buf, sizeof buf) <= 0)
		return -1;
	for (line = strtok_r(buf, "\n", &save); line; line = strtok_r(NULL, "\n", &save)) {
		const char *value = strchr(line, '\t');

		if (!value)
			continue;
		if (!strncmp(line, "NSpid:", 6))
			status->inside = atoi(strrchr(line, '\t') + 1);
		else if (!strncmp(line, "TracerPid:", 10))
			status->tracer = atoi(value);
		else if (!strncmp(line, "SigCgt:", 7))
			status->caught = strtoull(value, NULL, 16);
		else if (!strncmp(line, "VmLck:", 6))
			status->locked_kb = strtoll(value, NULL, 10);
		else if (!strncmp(line, "Uid:", 4))
			parse_ids(value, status->uid);
		else if (!strncmp(line, "Gid:", 4))
			parse_ids(value, status->gid);
		else if (!strncmp(line, "Groups:", 7))
			parse_groups(value, status);
		else if (!strncmp(line, "NoNewPrivs:", 11))
			status->no_new_privs = (uint32_t)atoi(value);
		else if (!strncmp(line, "x86_Thread_features:", 20))
			status->shadow_stack = strstr(value, "shstk") != NULL;
		else if (!strncmp(line, "Seccomp:", 8))
			status->seccomp = (uint32_t)atoi(value);
		else if (!strncmp(line, "Seccomp_filters:", 16))
			status->seccomp_filters = (uint32_t)atoi(value);
		else
			for (int i = 0; i < 5; i++)
				if (!strncmp(line, caps[i], 7))
					status->caps[i] = strtoull(value, NULL, 16);
	}
	return 0;
}

int proc_limits(pid_t pid, uint64_t limit[LIMITS][2])
{
	char buf[4096], *line;

	if (proc_read(pid, "limits", buf, sizeof buf) <= 0)
		return -1;
	line = buf;
	for (int i = 0; i < LIMITS; i++) {
		line = strchr(line, '\n');
		if (!line || strlen(++line) < LIMIT_NAME)
			return -1;
		for (int k = 0; k < 2; k++) {
			char *value = line + LIMIT_NAME + k * LIMIT_VALUE;

			limit[i][k] = *value == 'u' ? ~UINT64_C(0) : strtoull(value, NULL, 10);
		}
	}
	return 0;
}

struct linux_dirent64 {
	uint64_t d_ino;
	int64_t d_off;
	unsigned short d_reclen;
	unsigned char d_type;
	char d_name[];
};

int proc_tasks(int task_dirfd, int (*fn)(pid_t tid, void *arg), void *arg)
{
	char buf[16384] __attribute__((aligned(8)));

	if (lseek(task_dirfd, 0, SEEK_SET) < 0)
		return -1;
	for (;;) {
		long n = syscall(SYS_getdents64, task_dirfd, buf, sizeof buf);

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
	long pages, resident, of_files;

	if (read_text(statm_fd, buf, sizeof buf) <= 0 ||
	    sscanf(buf, "%ld %ld %ld", &pages, &resident, &of_files) != 3)
		return -1;
	if (anonymous)
		*anonymous = resident - of_files;
	return pages;
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
	return (int)syscall(SYS_pidfd_open, pid, 0);
}

int proc_sched(pid_t tid, struct proc_sched *sched)
{
	char buf[4096];
	const char *ran, *switches, *migrations;
	unsigned long long ms, ns;

	if (proc_read(tid, "sched", buf, sizeof buf) <= 0)
		return -1;
	ran = strstr(buf, "\nse.exec_start");
	switches = strstr(buf, "\nnr_switches");
	migrations = strstr(buf, "\nse.nr_migrations");
	if (!ran || !switches || !migrations || sscanf(ran, " %*s : %llu.%6llu", &ms, &ns) != 2 ||
	    sscanf(switches, " %*s : %lu", &sched->switches) != 1 ||
	    sscanf(migrations, " %*s : %lu", &sched->migrations) != 1)
		return -1;
	sched->ran_ns = ms * NS_PER_MS + ns;
	return 0;
}

/* A task gets the flag before it closes anything (kernel/exit.c, do_exit()). */
bool proc_is_exiting(pid_t tid)
{
	struct proc_stat stat;

	return proc_stat(tid, &stat) || stat.flags & PF_EXITING;
}

bool proc_is_killed(pid_t pid)
{
	static const char *const sets[] = { "\nSigPnd:", "\nShdPnd:" };
	char buf[4096];

	if (proc_is_exiting(pid) || proc_read(pid, "status", buf, sizeof buf) <= 0)
		return true;
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

	return poll(&p, 1, 0) == 1;
}

int proc_borrow_fd(int pidfd, int fd)
{
	return (int)syscall(SYS_pidfd_getfd, pidfd, fd, 0);
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
