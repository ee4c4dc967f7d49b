/* SPDX-License-Identifier: Apache-2.0
 *
 * intruder SECONDS [--count N] [--inject | --command]: what a container with CAP_SYS_PTRACE
 * gains by a task that comes into its PID namespace from outside.  Waits for N of them (1), takes
 * them over, and says what they have that the container has not; with --inject it also has
 * them make a system call; with --command they are to become ordinary processes of the
 * container.  Ends with 0 when they were looked at, with 3 when too few came.
 */
#include <ctype.h>
#include <dirent.h>
#include <elf.h>
#include <sys/ptrace.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <sys/user.h>

#include "victim.h"

#ifdef __x86_64__
#define SYSCALL "\x0f\x05"
#define SP rsp
#define PC rip
#define NUMBER rax
#define ARGUMENT_0 rdi
#define ARGUMENT_1 rsi
#define ARGUMENT_2 rdx
#else
#define SYSCALL "\x01\0\0\xd4"
#define SP sp
#define PC pc
#define NUMBER regs[8]
#define ARGUMENT_0 regs[0]
#define ARGUMENT_1 regs[1]
#define ARGUMENT_2 regs[2]
#endif

static const char *const spaces[] = { "mnt", "net", "ipc", "uts", "cgroup", "pid" };

static bool commands;

static void gain(const char *format, ...) __attribute__((format(printf, 1, 2)));
static void gain(const char *format, ...)
{
	va_list args;

	va_start(args, format);
	printf("GAIN: ");
	vprintf(format, args);
	printf("\n");
	va_end(args);
}

static char *read_text(int pid, const char *name)
{
	static char text[65536];
	char path[64];
	ssize_t n = 0, r;
	int fd;

	snprintf(path, sizeof path, "/proc/%d/%s", pid, name);
	fd = open(path, O_RDONLY | O_CLOEXEC);
	while (fd >= 0 && (r = read(fd, text + n, sizeof text - 1 - (size_t)n)) > 0)
		n += r;
	if (fd >= 0)
		close(fd);
	text[n] = 0;
	return text;
}

/* Its parent is none of the container's, and it is neither its first process nor we. */
static bool is_foreign(int pid)
{
	const char *end = strrchr(read_text(pid, "stat"), ')');

	return pid != 1 && pid != getpid() && end && atoi(end + 4) == 0;
}

static unsigned long long field(const char *status, const char *name, int base)
{
	const char *at = strstr(status, name);

	return at ? strtoull(at + strlen(name), NULL, base) : ~0ULL;
}

static unsigned long long capabilities(const char *status)
{
	return field(status, "CapPrm:", 16) | field(status, "CapEff:", 16) |
	       field(status, "CapBnd:", 16);
}

static void look_at_status(int pid)
{
	const unsigned long long own = capabilities(read_text(getpid(), "status"));
	const char *status = read_text(pid, "status");
	const unsigned long long caps = capabilities(status);

	if (commands) {
		if (caps & ~own)
			gain("capabilities %llx", caps & ~own);
		return;
	}
	if (__builtin_popcountll(caps) > 1 || field(status, "CapInh:", 16) ||
	    field(status, "CapAmb:", 16))
		gain("capabilities %llx", caps);
	if (field(status, "NoNewPrivs:", 10) != 1)
		gain("it may gain privileges (no_new_privs)");
	if (field(status, "Seccomp:", 10) != 2)
		gain("it has no seccomp filter");
}

static void look_at_descriptors(int pid)
{
	char path[300], link[256];
	struct dirent *entry;
	DIR *dir;

	snprintf(path, sizeof path, "/proc/%d/fd", pid);
	dir = opendir(path);
	while (dir && (entry = readdir(dir))) {
		ssize_t n;

		if (!isdigit((unsigned char)*entry->d_name))
			continue;
		snprintf(path, sizeof path, "/proc/%d/fd/%s", pid, entry->d_name);
		n = readlink(path, link, sizeof link - 1);
		link[n > 0 ? n : 0] = 0;
		if (commands
			    ? strstr(link, "cgroup") || strstr(link, "pidfd") || strstr(link, "env")
			    : !strstr(link, "sys/kernel/ns_last_pid"))
			gain("descriptor %s: %s", entry->d_name, link);
	}
	if (dir)
		closedir(dir);
}

static void compare(int pid, const char *name)
{
	struct stat own, its;
	char path[64];

	snprintf(path, sizeof path, "/proc/self/%s", name);
	must(stat(path, &own) == 0, path);
	snprintf(path, sizeof path, "/proc/%d/%s", pid, name);
	if (stat(path, &its) == 0 && (own.st_dev != its.st_dev || own.st_ino != its.st_ino))
		gain("%s of its own", name);
}

static void look_at_places(int pid)
{
	char name[32], path[64];
	int fd;

	for (size_t i = 0; i < sizeof spaces / sizeof *spaces; i++) {
		snprintf(name, sizeof name, "ns/%s", spaces[i]);
		compare(pid, name);
	}
	compare(pid, "root");
	must(chdir("/") == 0, "chdir");
	if (!commands)
		compare(pid, "cwd");
	snprintf(path, sizeof path, "/proc/%d/exe", pid);
	fd = open(path, O_WRONLY | O_CLOEXEC);
	if (fd >= 0)
		gain("its program can be written to");
	if (fd >= 0)
		close(fd);
}

static void look_at_memory(int pid)
{
	char *line = strtok(read_text(pid, "maps"), "\n");
	unsigned long start, end, private = 0;
	char mode[5];

	for (; line; line = strtok(NULL, "\n")) {
		if (sscanf(line, "%lx-%lx %4s", &start, &end, mode) != 3)
			continue;
		if (mode[3] == 'p' && !strstr(line, "[v"))
		private += end - start;
		if (!commands && strchr(line, '/') && !strstr(line, "/memfd:avckpt-pid") &&
		    !strstr(line, "/memfd:avckpt-parasite"))
			gain("mapped: %s", strchr(line, '/'));
	}
	if (!commands && private > 512 << 10)
		gain("%lu kB of memory of its own", private >> 10);
}

/* Has it open a file. */
static void inject(int pid)
{
	struct user_regs_struct regs;
	const struct iovec iov = { &regs, sizeof regs };
	unsigned long start, end, at = 0;
	char path[64], *line;
	uint8_t code[8192], *found = NULL;
	int fd, status;

	snprintf(path, sizeof path, "/proc/%d/mem", pid);
	fd = open(path, O_RDWR | O_CLOEXEC);
	must(fd >= 0, path);
	for (line = strtok(read_text(pid, "maps"), "\n"); line && !at; line = strtok(NULL, "\n")) {
		ssize_t n;

		if (sscanf(line, "%lx-%lx r-xp", &start, &end) != 2 || !strstr(line, "r-xp"))
			continue;
		n = pread(fd, code, sizeof code, (off_t)start);
		if (n > 0)
			found = memmem(code, (size_t)n, SYSCALL, sizeof SYSCALL - 1);
		if (found)
			at = start + (unsigned long)(found - code);
	}
	must(at && ptrace(PTRACE_GETREGSET, pid, NT_PRSTATUS, &iov) == 0, "PTRACE_GETREGSET");
	must(pwrite(fd, "/", 2, (off_t)regs.SP) == 2, "write(mem)");
	regs.PC = at;
	regs.NUMBER = SYS_openat;
	regs.ARGUMENT_0 = (unsigned long long)AT_FDCWD;
	regs.ARGUMENT_1 = regs.SP;
	regs.ARGUMENT_2 = O_RDONLY;
#ifdef __x86_64__
	regs.orig_rax = -1ULL; /* it is in no call */
#else
	ptrace(PTRACE_SETREGSET, pid, NT_ARM_SYSTEM_CALL,
	       &(struct iovec){ &(int){ -1 }, sizeof(int) });
#endif
	must(ptrace(PTRACE_SETREGSET, pid, NT_PRSTATUS, &iov) == 0, "PTRACE_SETREGSET");
	must(ptrace(PTRACE_SYSCALL, pid, NULL, NULL) == 0, "PTRACE_SYSCALL");
	/* Its entry, its exit, and what comes of it. */
	for (int stops = 0; stops < 3; stops++) {
		must(waitpid(pid, &status, __WALL) == pid, "waitpid");
		if (!WIFSTOPPED(status))
			break;
		ptrace(PTRACE_SYSCALL, pid, NULL, NULL);
	}
	if (WIFSTOPPED(status))
		gain("it makes system calls: open");
	else
		printf("killed by signal %d\n", WTERMSIG(status));
}

static bool look_at(int pid, bool injecting)
{
	int status;

	if (ptrace(PTRACE_SEIZE, pid, NULL, NULL) || ptrace(PTRACE_INTERRUPT, pid, NULL, NULL)) {
		printf("not to be taken over: %s\n", strerror(errno));
		return false;
	}
	if (waitpid(pid, &status, __WALL) != pid || !WIFSTOPPED(status))
		return false;
	look_at_status(pid);
	look_at_descriptors(pid);
	look_at_places(pid);
	look_at_memory(pid);
	printf("looked at %d, %s", pid, read_text(pid, "comm"));
	if (injecting)
		inject(pid);
	else
		ptrace(PTRACE_DETACH, pid, NULL, NULL);
	return true;
}

int main(int argc, char **argv)
{
	const bool injecting = victim_flag(&argc, argv, "--inject");
	long wanted = 1;
	uint64_t end;
	int last = 0;

	commands = victim_flag(&argc, argv, "--command");
	victim_start(&argc, argv, 1, "SECONDS [--count N] [--inject | --command]");
	end = now_ns() + strtoul(argv[1], NULL, 10) * 1000000000;
	if (argc == 4 && !strcmp(argv[2], "--count"))
		wanted = atol(argv[3]);
	victim_ready();
	while (now_ns() < end) {
		DIR *dir = opendir("/proc");
		struct dirent *entry;

		while (dir && (entry = readdir(dir))) {
			const int pid = atoi(entry->d_name);

			if (pid <= 0 || pid == last || !is_foreign(pid) || !look_at(pid, injecting))
				continue;
			last = pid;
			if (!--wanted)
				return 0;
		}
		if (dir)
			closedir(dir);
	}
	return 3;
}
