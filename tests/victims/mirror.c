/* SPDX-License-Identifier: Apache-2.0
 *
 * mirror: reads all that the kernel tells it of itself, again and again: /proc, prctl(2), limits,
 * timers, masks, handlers, socket options, mincore(2), fstat(2).  Whatever is not as it was before anybody
 * protected it is a violation, but for what docs/limits.md names: the parasite, what /proc says for
 * a moment of a thread that has not come home yet, and who shares a page (Rss, Locked).
 * counter[0] is how often it has looked.
 */
#include <dirent.h>
#include <linux/futex.h>
#include <poll.h>
#include <pthread.h>
#include <sched.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/inotify.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/signalfd.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/timerfd.h>

#include "victim.h"

#ifndef SYS_poll
#define SYS_poll SYS_ppoll /* newer CPUs */
#endif

#define VIEW_BYTES (1 << 20)
#define REGION_PAGES 64
#define OPTIONS 90
#define SIGNALS 64
#define PRCTLS 80
#define PR_GET_MDWE_ 66 /* the headers may be older */
#define PR_GET_MEMORY_MERGE_ 68
#define IOPRIO_WHO_PROCESS 1
#define WAITERS 6
#define LOOKS 50

static char first[VIEW_BYTES], view[VIEW_BYTES], file_text[256 * 1024];
static size_t used;
static char *region, *mapped, *shared;
static int sockets[2], datagrams[2], pipes[2];
static uint32_t never;
static volatile int waiting;

__attribute__((format(printf, 1, 2))) static void say(const char *format, ...)
{
	va_list args;

	va_start(args, format);
	used += (size_t)vsnprintf(view + used, VIEW_BYTES - used, format, args);
	va_end(args);
	must(used < VIEW_BYTES, "a longer view than there is room for");
}

/* ---- what there is to be seen --------------------------------------------------------- */

static void wait_for_ever(int which)
{
	struct pollfd none = { .fd = pipes[0], .events = POLLIN };
	struct epoll_event event;
	char byte;

	switch (which) {
	case 0:
		syscall(SYS_futex, &never, FUTEX_WAIT_PRIVATE, 0, NULL, NULL, 0);
		break;
	case 1:
		poll(&none, 1, -1);
		break;
	case 2:
		epoll_wait(epoll_create1(EPOLL_CLOEXEC), &event, 1, -1);
		break;
	case 3:
		must(read(pipes[0], &byte, 1) > 0, "read");
		break;
	case 4:
		recv(sockets[0], &byte, 1, 0);
		break;
	default:
		pause();
	}
	violation("a wait for ever (%d) has ended: %s", which, strerror(errno));
}

static void *waiter(void *arg)
{
	const int which = (int)(intptr_t)arg;
	char name[16];

	snprintf(name, sizeof name, "waits %d", which);
	prctl(PR_SET_NAME, name);
	__atomic_add_fetch(&waiting, 1, __ATOMIC_RELEASE);
	wait_for_ever(which);
	return NULL;
}

static void on_signal(int signal)
{
	(void)signal;
}

static void *page(int i)
{
	return region + i * 4096;
}

static void make_memory(void)
{
	const int file = open("/proc/self/exe", O_RDONLY | O_CLOEXEC);

	const int memory = memfd_create("mirror", MFD_CLOEXEC);

	must(memory >= 0 && !ftruncate(memory, REGION_PAGES * 4096), "memfd_create");
	shared = mmap(NULL, REGION_PAGES * 4096, PROT_READ | PROT_WRITE, MAP_SHARED, memory, 0);
	region = mmap(NULL, REGION_PAGES * 4096, PROT_READ | PROT_WRITE,
		      MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
	mapped = mmap(NULL, 16384, PROT_READ, MAP_SHARED, file, 0);
	must(region != MAP_FAILED && mapped != MAP_FAILED && shared != MAP_FAILED, "mmap");
	for (int i = 0; i < REGION_PAGES; i += 3)
		region[i * 4096] = shared[i * 4096] = 1;
	must(!madvise(page(8), 8192, MADV_DONTFORK) && !madvise(page(12), 8192, MADV_WIPEONFORK) &&
		     !madvise(page(16), 8192, MADV_NOHUGEPAGE) &&
		     !madvise(page(20), 8192, MADV_DONTDUMP) &&
		     !madvise(page(24), 8192, MADV_SEQUENTIAL) &&
		     !mprotect(page(28), 8192, PROT_NONE) && !mprotect(page(32), 8192, PROT_READ),
	     "madvise");
	must(!mlock(page(36), 8192), "mlock");
}

static void make_files(void)
{
	const struct itimerspec later = { { 3600, 0 }, { 0, 0 } };
	const struct epoll_event event = { .events = EPOLLIN | EPOLLET, .data.u64 = 42 };
	const int epoll_fd = epoll_create1(0), counts = eventfd(7, EFD_SEMAPHORE);
	const int watches = inotify_init1(IN_CLOEXEC), at = open("/etc/passwd", O_RDONLY);
	const int timer = timerfd_create(CLOCK_MONOTONIC, 0);
	const int offset = 3;
	sigset_t some;

	sigemptyset(&some);
	sigaddset(&some, SIGUSR2);
	must(signalfd(-1, &some, SFD_CLOEXEC) >= 0 && !timerfd_settime(timer, 0, &later, NULL) &&
		     inotify_add_watch(watches, "/", IN_ATTRIB) >= 0 && lseek(at, 5, SEEK_SET) == 5,
	     "files");
	must(!epoll_ctl(epoll_fd, EPOLL_CTL_ADD, counts, (struct epoll_event *)&event), "epoll");
	must(!pipe2(pipes, O_CLOEXEC) && !socketpair(AF_UNIX, SOCK_STREAM, 0, sockets) &&
		     !socketpair(AF_UNIX, SOCK_DGRAM, 0, datagrams),
	     "pipes");
	for (int i = 0; i < 3; i++)
		must(send(datagrams[1], "letter", (size_t)i + 3, 0) > 0, "send");
	must(!setsockopt(datagrams[0], SOL_SOCKET, SO_PEEK_OFF, &offset, sizeof offset), "peek");
}

static void make_signals(void)
{
	const struct itimerval later = { { 0, 0 }, { 3600, 0 } };
	const struct itimerspec also = { { 0, 0 }, { 7200, 0 } };
	struct sigaction action = { .sa_handler = on_signal, .sa_flags = SA_ONSTACK | SA_RESTART };
	static char stack[65536];
	const stack_t alternate = { .ss_sp = stack, .ss_size = sizeof stack };
	struct sigevent event = { .sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGRTMIN + 3 };
	timer_t timer;
	sigset_t some;

	sigemptyset(&some);
	sigaddset(&some, SIGUSR2);
	sigaddset(&some, SIGRTMIN + 5);
	must(!sigaction(SIGHUP, &action, NULL) && !sigaltstack(&alternate, NULL) &&
		     !setitimer(ITIMER_REAL, &later, NULL) &&
		     !timer_create(CLOCK_MONOTONIC, &event, &timer) &&
		     !timer_settime(timer, 0, &also, NULL) && !sigprocmask(SIG_BLOCK, &some, NULL),
	     "signals");
	signal(SIGPIPE, SIG_IGN);
	must(!kill(getpid(), SIGRTMIN + 5) && !pthread_kill(pthread_self(), SIGUSR2), "kill");
	prctl(PR_SET_PDEATHSIG, SIGTERM);
	prctl(PR_SET_TIMERSLACK, 77777);
	umask(027);
}

/* ---- how it is seen ------------------------------------------------------------------- */

/* Whether a line is to be the same for ever. */
typedef bool (*is_kept)(const char *line);

static bool begins(const char *line, const char *with)
{
	return !strncmp(line, with, strlen(with));
}

static bool all_of(const char *line)
{
	return !strstr(line, "avckpt-");
}

static bool no_memory_or_switches(const char *line)
{
	static const char *const which[] = { "VmPeak",  "VmSize",   "VmHWM",     "VmRSS",
					     "RssAnon", "VmData",   "VmPTE",     "VmSwap",
					     "RssFile", "RssShmem", "voluntary", "nonvoluntary",
					     "State",   "VmLib",    "SigQ" };

	for (size_t i = 0; i < sizeof which / sizeof *which; i++)
		if (begins(line, which[i]))
			return false;
	return true;
}

/* Others may unmount what they have mounted below. */
static bool own_mounts(const char *line)
{
	return strstr(line, " / / ") || strstr(line, " / /proc ");
}

/* The kernel continues some calls by restart_syscall(2) after a stop, whoever stops it. */
static bool not_continued(const char *line)
{
	char continued[8], poll_number[8];

	snprintf(continued, sizeof continued, "%d ", SYS_restart_syscall);
	snprintf(poll_number, sizeof poll_number, "%d ", SYS_poll);
	return !begins(line, continued) && !begins(line, poll_number);
}

static bool is_ours; /* the mapping that smaps is at */

static bool flags_and_sizes(const char *line)
{
	static const char *const which[] = { "Size",     "KernelPageSize", "MMUPageSize",
					     "VmFlags",  "THPeligible",    "ProtectionKey",
					     "LazyFree", "AnonHugePages",  "Anonymous" };

	if (strchr("0123456789abcdef", *line) && memchr(line, '-', 17)) {
		/* The stub that brings the parasite in is in a page of the vDSO. */
		is_ours = strstr(line, "avckpt-") || strstr(line, "[vdso]");
		return all_of(line);
	}
	for (size_t i = 0; i < sizeof which / sizeof *which; i++)
		if (begins(line, which[i]) && !is_ours)
			return true;
	return false;
}

static bool no_time_left(const char *line)
{
	return !begins(line, "it_value");
}

/* Each line apart, as a string of its own. */
static void look_at(const char *path, is_kept kept)
{
	char *const text = file_text;
	const int fd = open(path, O_RDONLY | O_CLOEXEC);
	size_t bytes = 0;
	ssize_t n;

	if (fd < 0) {
		say("%s: %s\n", path, strerror(errno));
		return;
	}
	while ((n = read(fd, text + bytes, sizeof file_text - 1 - bytes)) > 0)
		bytes += (size_t)n;
	close(fd);
	for (size_t i = 0; i < bytes; i++) /* environ, cmdline, auxv */
		if (!text[i])
			text[i] = '~';
	text[bytes] = 0;
	is_ours = false;
	for (char *line = text, *end; *line; line = end) {
		end = strchr(line, '\n');
		if (end)
			*end++ = 0;
		else
			end = line + strlen(line);
		if (kept(line))
			say("%s: %s\n", path, line);
	}
}

/* Fields by number, of stat(5). */
static void look_at_stat(const char *path)
{
	static const char same[] = { 4,  5,  6,  7,  8,  9,  18, 19, 20, 21, 22, 25, 26, 27, 28,
				     31, 32, 33, 34, 38, 40, 41, 45, 46, 47, 48, 49, 50, 51, 52 };
	char text[2048], *field;
	const int fd = open(path, O_RDONLY | O_CLOEXEC);
	const ssize_t n = read(fd, text, sizeof text - 1);
	int number = 2;

	close(fd);
	must(n > 0, path);
	text[n] = 0;
	for (field = strtok(strrchr(text, ')'), " "); field; field = strtok(NULL, " \n"), number++)
		if (number > 2 && memchr(same, number, sizeof same))
			say("%s: %d is %s\n", path, number, field);
}

static void look_at_thread(const char *name)
{
	const bool self = atoi(name) == (int)syscall(SYS_gettid);
	char path[320];

	snprintf(path, sizeof path, "/proc/self/task/%s/status", name);
	look_at(path, no_memory_or_switches);
	snprintf(path, sizeof path, "/proc/self/task/%s/stat", name);
	look_at_stat(path);
	snprintf(path, sizeof path, "/proc/self/task/%s/children", name);
	look_at(path, all_of);
	if (self)
		return;
	snprintf(path, sizeof path, "/proc/self/task/%s/wchan", name);
	look_at(path, all_of);
	snprintf(path, sizeof path, "/proc/self/task/%s/syscall", name);
	look_at(path, not_continued);
}

static void look_at_descriptor(const char *name)
{
	char path[320], target[256];
	struct stat st;
	ssize_t n;

	snprintf(path, sizeof path, "/proc/self/fd/%s", name);
	if (atoi(name) <= STDERR_FILENO) /* what it says goes there */
		return;
	n = readlink(path, target, sizeof target);
	say("%s: %.*s\n", path, n > 0 ? (int)n : 0, target);
	if (!stat(path, &st))
		say("%s: %#x, %ld bytes in %ld, read %ld.%09ld, written %ld.%09ld\n", path,
		    st.st_mode, st.st_size, st.st_blocks, st.st_atim.tv_sec, st.st_atim.tv_nsec,
		    st.st_mtim.tv_sec, st.st_mtim.tv_nsec);
	snprintf(path, sizeof path, "/proc/self/fdinfo/%s", name);
	look_at(path, no_time_left);
}

static void for_each(const char *folder, void (*look)(const char *name))
{
	DIR *dir = opendir(folder);
	struct dirent *entry;

	must(dir, folder);
	while ((entry = readdir(dir)))
		if (*entry->d_name != '.' && atoi(entry->d_name) != dirfd(dir))
			look(entry->d_name);
	closedir(dir);
}

static void look_at_calls(void)
{
	unsigned char pages[REGION_PAGES];
	struct sigaction action;
	struct rlimit limit;
	struct itimerval timer;
	stack_t stack;
	sigset_t set;
	cpu_set_t cpus;
	size_t robust_bytes = 0;
	unsigned long robust = 0;
	int value;

	for (int k = 0; k < 2; k++) {
		must(!mincore(k ? shared : region, REGION_PAGES * 4096, pages), "mincore");
		for (int i = 0; i < REGION_PAGES; i++)
			say("mincore: page %d of %d is %d\n", i, k, pages[i] & 1);
	}
	for (int i = 1; i <= SIGNALS; i++)
		if (!sigaction(i, NULL, &action))
			say("sigaction: %d is %p, %#x, %#lx\n", i, (void *)action.sa_handler,
			    (unsigned int)action.sa_flags, *(uint64_t *)&action.sa_mask);
	for (int i = 0; i < RLIM_NLIMITS; i++)
		if (!getrlimit(i, &limit))
			say("getrlimit: %d is %lu, %lu\n", i, limit.rlim_cur, limit.rlim_max);
	for (int i = 0; i < PRCTLS; i++) {
		static const int asking[] = { PR_GET_PDEATHSIG, PR_GET_TID_ADDRESS, PR_GET_TSC,
					      PR_GET_CHILD_SUBREAPER };
		static const int plain[] = { PR_GET_DUMPABLE,    PR_GET_KEEPCAPS,
					     PR_GET_TIMING,      PR_GET_SECUREBITS,
					     PR_GET_TIMERSLACK,  PR_GET_NO_NEW_PRIVS,
					     PR_GET_THP_DISABLE, PR_MCE_KILL_GET,
					     PR_GET_IO_FLUSHER,  PR_GET_SECCOMP,
					     PR_GET_MDWE_,       PR_GET_MEMORY_MERGE_ };
		uint64_t answer = 0;

		for (size_t k = 0; k < sizeof asking / sizeof *asking; k++)
			if (asking[k] == i)
				say("prctl: %d is %d, %#lx\n", i, prctl(i, &answer, 0, 0, 0),
				    answer);
		for (size_t k = 0; k < sizeof plain / sizeof *plain; k++)
			if (plain[k] == i)
				say("prctl: %d is %d\n", i, prctl(i, 0, 0, 0, 0));
	}
	for (int i = 0; i < 2 * OPTIONS; i++) {
		socklen_t bytes = sizeof value;
		const int fd = i < OPTIONS ? sockets[0] : datagrams[0];

		/* SO_PEERPIDFD and its like open something. */
		if (i % OPTIONS != 76 && i % OPTIONS != 77 && i % OPTIONS != SO_ERROR &&
		    !getsockopt(fd, SOL_SOCKET, i % OPTIONS, &value, &bytes) &&
		    bytes == sizeof value)
			say("getsockopt: %d of %d is %d\n", i % OPTIONS, fd, value);
	}
	sigprocmask(SIG_SETMASK, NULL, &set);
	say("sigprocmask: %#lx\n", *(uint64_t *)&set);
	sigpending(&set);
	say("sigpending: %#lx\n", *(uint64_t *)&set);
	sigaltstack(NULL, &stack);
	say("sigaltstack: %p %#x %zu\n", stack.ss_sp, (unsigned int)stack.ss_flags, stack.ss_size);
	getitimer(ITIMER_REAL, &timer);
	say("getitimer: %d\n", timer.it_value.tv_sec > 1000);
	say("waitpid: %d\n", waitpid(-1, NULL, WNOHANG | __WALL));
	say("getpriority: %d, scheduler %d\n", getpriority(PRIO_PROCESS, 0), sched_getscheduler(0));
	must(!sched_getaffinity(0, sizeof cpus, &cpus) &&
		     !syscall(SYS_get_robust_list, 0, &robust, &robust_bytes),
	     "get_robust_list");
	say("CPUs: %d, I/O priority %ld, robust list %#lx, %zu\n", CPU_COUNT(&cpus),
	    syscall(SYS_ioprio_get, IOPRIO_WHO_PROCESS, 0), robust, robust_bytes);
	value = (int)umask(027);
	say("umask: %o, pid %d, parent %d, group %d, session %d\n", (unsigned int)value, getpid(),
	    getppid(), getpgrp(), getsid(0));
}

static void look(void)
{
	static const char *const files[] = {
		"maps",          "limits",   "cgroup",    "oom_score_adj",   "environ",
		"cmdline",       "auxv",     "comm",      "coredump_filter", "personality",
		"timerslack_ns", "loginuid", "sessionid", "uid_map",         "gid_map",
		"setgroups",     "cpuset",   "autogroup", "timers",          "timens_offsets",
		"attr/current",
	};
	char path[64];

	used = 0;
	for (size_t i = 0; i < sizeof files / sizeof *files; i++) {
		snprintf(path, sizeof path, "/proc/self/%s", files[i]);
		look_at(path, all_of);
	}
	look_at("/proc/self/mountinfo", own_mounts);
	look_at("/proc/self/smaps", flags_and_sizes);
	look_at("/proc/self/status", no_memory_or_switches);
	look_at_stat("/proc/self/stat");
	for_each("/proc/self/task", look_at_thread);
	for_each("/proc/self/fd", look_at_descriptor);
	look_at_calls();
}

/* Complains of the first line that differs, unless it is to be `quiet`. */
static bool is_the_same(bool quiet)
{
	const char *a = first, *b = view;

	while (*a && *b) {
		const int m = (int)strcspn(a, "\n"), n = (int)strcspn(b, "\n");

		if (m != n || memcmp(a, b, (size_t)m)) {
			if (!quiet)
				complain("was \"%.*s\", is \"%.*s\"", m, a, n, b);
			return false;
		}
		a += m + (a[m] != 0);
		b += n + (b[n] != 0);
	}
	if (*a || *b) {
		if (!quiet)
			complain("there is more or less to see: %.99s%.99s", a, b);
		return false;
	}
	return true;
}

/* Threads are let go one after another: another one may still stand, or be on its way back into
 * its call. */
static void look_again(void)
{
	int looks = 0;

	for (look(); !is_the_same(looks < LOOKS); look()) {
		if (++looks > LOOKS) {
			memcpy(first, view, sizeof first); /* told once */
			break;
		}
		nap_us(1000);
	}
}

int main(int argc, char **argv)
{
	pthread_t thread;

	victim_start(&argc, argv, 0, "");
	make_memory();
	make_files();
	make_signals();
	for (intptr_t i = 0; i < WAITERS; i++)
		must(!pthread_create(&thread, NULL, waiter, (void *)i), "pthread_create");
	while (waiting < WAITERS)
		nap_us(1000);
	nap_us(200000); /* they wait; what is seen after all this is seen for ever */
	memset(first, 1, sizeof first); /* is all there */
	memset(view, 1, sizeof view);
	memset(file_text, 1, sizeof file_text); /* smaps becomes longer */
	look();
	do {
		memcpy(first, view, sizeof first);
		look();
	} while (memcmp(first, view, sizeof first)); /* a waiter that is woken to wait again */
	victim_ready();
	for (;;) {
		look_again();
		count(0, 1);
		beat();
		nap_us(1000);
	}
}
