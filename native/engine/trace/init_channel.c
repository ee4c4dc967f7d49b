/* SPDX-License-Identifier: Apache-2.0
 *
 * The guard's end of the protocol in avckpt/ctl.h.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/statfs.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "trace.h"

static const char not_inits[] = "its control page is not one of avckpt-init's";

#define EXIT_NS (10 * NS_PER_MS)
#define LEFTOVERS_NS (100 * NS_PER_MS)
/* On a busy machine a killed process may wait long for a CPU to exit. Until then it can consume
 * what is put back into a pipe: a read(2) that finds data does not check for signals. */
#define LEFTOVERS_ALIVE_NS (10 * NS_PER_S)
#define LEFTOVERS_US 100
#define LEFTOVERS_LONG_US 1000
#define WORKING_NS (100 * NS_PER_MS)

void init_channel_init(struct init_channel *channel)
{
	*channel = (struct init_channel){
		.init_pidfd = -1, .ctl_fd = -1, .report_fd = -1, .verdict_fd = -1, .numbers_fd = -1
	};
}

/* init's descriptor number of the control page, or -1. */
static int find_ctl(pid_t init)
{
	char path[64], process[64];
	struct dirent *entry;
	int found = -1;
	DIR *dir;

	snprintf(path, sizeof path, "/proc/%d/fd", init);
	dir = opendir(path);
	if (!dir)
		return -1;
	while (found < 0 && (entry = readdir(dir))) {
		ssize_t n = readlinkat(dirfd(dir), entry->d_name, process, sizeof process - 1);

		if (n <= 0)
			continue;
		process[n] = 0;
		if (!strcmp(process, "/memfd:" AVC_CTL_NAME " (deleted)"))
			found = atoi(entry->d_name);
	}
	closedir(dir);
	return found;
}

#define PIPEFS_MAGIC_ 0x50495045 /* linux/magic.h */
#define TMPFS_MAGIC_ 0x01021994

/* What the container presents is checked before it is opened: through a duplicate of its own
 * descriptor, which carries no more rights than it has, and which it cannot replace meanwhile. Then
 * it is reopened, because O_NONBLOCK and flock(2) belong to the open file description. */
static int reopen(int *theirs, int flags)
{
	const int fd = open_again(*theirs, flags);

	close_fd(theirs);
	return fd;
}

static int reject(int *theirs)
{
	close_fd(theirs);
	errno = EPROTO;
	return -1;
}

/* init's end of a pipe, or the other one; it must be an anonymous pipe and not a named file, which
 * the container may be allowed only to read. */
static int open_pipe_of(const struct init_channel *channel, int number, int flags)
{
	int theirs = proc_borrow_fd(channel->init_pidfd, number);
	struct statfs fs;
	struct stat st;

	if (theirs < 0)
		return -1;
	if (fstat(theirs, &st) || !S_ISFIFO(st.st_mode) || fstatfs(theirs, &fs) ||
	    fs.f_type != PIPEFS_MAGIC_)
		return reject(&theirs);
	return reopen(&theirs, flags);
}

/* A memfd that cannot shrink under our mapping (SIGBUS), and without huge pages, which may be
 * exhausted (SIGBUS). Files of a tmpfs have seals, too, but never these. */
static int open_ctl_of(const struct init_channel *channel, int number)
{
	int theirs = proc_borrow_fd(channel->init_pidfd, number), seals;
	struct statfs fs;
	struct stat st;

	if (theirs < 0)
		return -1;
	seals = fcntl(theirs, F_GET_SEALS);
	if (seals < 0 || !(seals & F_SEAL_SHRINK) ||
	    (fcntl(theirs, F_GETFL) & O_ACCMODE) != O_RDWR || fstat(theirs, &st) ||
	    fstatfs(theirs, &fs) || fs.f_type != TMPFS_MAGIC_ ||
	    st.st_size < (off_t)sizeof(struct avc_ctl))
		return reject(&theirs);
	return reopen(&theirs, O_RDWR);
}

/* A file may have that name; and even a duplicate of it, once closed, is a request to a file
 * server. */
static bool is_file(pid_t init, int number)
{
	char name[24];
	struct statx st;

	snprintf(name, sizeof name, "fd/%d", number);
	return proc_look(init, name, STATX_INO, &st) && !device_is_memory(device_of(&st));
}

static int connect_all(struct init_channel *channel, int number, struct avc_error *err)
{
	const struct avc_ctl *ctl;

	channel->ctl_fd = open_ctl_of(channel, number);
	if (channel->ctl_fd < 0 && errno == EPROTO)
		return fail(err, AVC_PROTOCOL, 0, channel->init, "attach", "", "%s", not_inits);
	if (channel->ctl_fd < 0)
		return fail_errno(err, channel->init, "attach", "pidfd_getfd",
				  "its control page cannot be opened");
	if (flock(channel->ctl_fd, LOCK_EX | LOCK_NB))
		return fail(err, AVC_BUSY, errno, channel->init, "attach", "flock",
			    "another avckpt guards it already");
	channel->ctl = mmap(NULL, sizeof *ctl, PROT_READ | PROT_WRITE, MAP_SHARED, channel->ctl_fd,
			    0);
	if (channel->ctl == MAP_FAILED) {
		channel->ctl = NULL;
		return fail_errno(err, channel->init, "attach", "mmap",
				  "its control page cannot be mapped");
	}
	ctl = channel->ctl;
	if (ctl->version != AVC_CTL_VERSION)
		return fail(
			err, AVC_PROTOCOL, 0, channel->init, "attach", "",
			"avckpt-init speaks version %u, this is version %u: restart the container",
			ctl->version, (unsigned int)AVC_CTL_VERSION);
	channel->report_fd = open_pipe_of(channel, ctl->report_fd, O_RDONLY);
	channel->verdict_fd = open_pipe_of(channel, ctl->verdict_fd, O_WRONLY);
	if (channel->report_fd < 0 || channel->verdict_fd < 0)
		return fail_errno(err, channel->init, "attach", "open(fd)",
				  "its pipes cannot be opened");
	channel->init_inside = ctl->init_pid;
	if (ctl->is_unit)
		channel->numbers_fd = last_pid_lock_open(channel->init);
	return 0;
}

int init_channel_open(struct init_channel *channel, struct avc_error *err)
{
	int number, theirs, pidfd = channel->init_pidfd;
	uint64_t magic = 0;

	channel->init = proc_pidfd_pid(pidfd);
	if (channel->init < 0 && is_shortage(errno))
		return fail_errno(err, 0, "attach", "open(fdinfo)", "it cannot be seen");
	if (channel->init <= 0)
		return fail(err, AVC_GONE, ESRCH, 0, "attach", "",
			    "the container's main process has ended");
	number = find_ctl(channel->init);
	if (number < 0 || pidfd_ended(pidfd))
		return 0;
	if (is_file(channel->init, number))
		return fail(err, AVC_PROTOCOL, 0, channel->init, "attach", "", "%s", not_inits);
	/* The magic is written last: before that the page is incomplete. */
	theirs = proc_borrow_fd(pidfd, number);
	if (theirs < 0)
		return 0;
	if (fcntl(theirs, F_GET_SEALS) >= 0 && pread(theirs, &magic, sizeof magic, 0) >= 0 &&
	    magic != AVC_CTL_MAGIC) {
		close_fd(&theirs);
		return 0;
	}
	close_fd(&theirs);
	if (connect_all(channel, number, err) == 0)
		return 1;
	init_channel_close(channel);
	channel->init_pidfd = pidfd;
	/* Who exits closes his descriptors first, and is not to be told to run unprotected. */
	return pidfd_await_end(pidfd, EXIT_NS) ? 0 : -1;
}

/* Everything but the pidfd, which belongs to the guard. */
void init_channel_close(struct init_channel *channel)
{
	if (channel->ctl)
		munmap(channel->ctl, sizeof *channel->ctl);
	channel->ctl = NULL;
	close_fd(&channel->ctl_fd); /* releases the lock */
	close_fd(&channel->report_fd);
	close_fd(&channel->verdict_fd);
	close_fd(&channel->numbers_fd);
}

pid_t init_channel_app(const struct init_channel *channel)
{
	const int32_t inside = __atomic_load_n(&channel->ctl->app_pid, __ATOMIC_ACQUIRE);
	pid_t children[CHILDREN_MAX];
	int count = proc_children(channel->init, children, CHILDREN_MAX);

	for (int i = 0; inside > 0 && i < count; i++)
		if (proc_inside(children[i]) == inside)
			return children[i];
	return 0;
}

bool init_channel_app_started(const struct init_channel *channel, pid_t app)
{
	return proc_same_file(channel->init, proc_live_thread(app), "exe") == 0;
}

void init_channel_arm(struct init_channel *channel, bool armed)
{
	__atomic_store_n(&channel->ctl->armed, armed, __ATOMIC_RELEASE);
}

bool init_channel_listens(const struct init_channel *channel, pid_t pid)
{
	const pid_t keys = channel->ctl ? __atomic_load_n(&channel->ctl->keys_pid, __ATOMIC_ACQUIRE)
					: 0;

	return keys > 0 && proc_inside(pid) == keys;
}

bool init_channel_stop_asked(const struct init_channel *channel)
{
	const uint64_t asked = __atomic_load_n(&channel->ctl->stop_asked_ns, __ATOMIC_ACQUIRE);

	return asked && now_ns() - asked < AVC_CTL_STOP_MS * NS_PER_MS;
}

int init_channel_report(struct init_channel *channel, struct avc_report *report)
{
	return read(channel->report_fd, report, sizeof *report) == sizeof *report ? 1 : 0;
}

int init_channel_verdict(const struct init_channel *channel, enum avc_verdict_kind kind,
			 struct avc_error *err)
{
	const struct avc_verdict verdict = { .seq = channel->death, .kind = kind };

	/* Without a reader this raises SIGPIPE, which this thread has blocked. */
	if (write(channel->verdict_fd, &verdict, sizeof verdict) != sizeof verdict)
		return fail_errno(err, channel->init, "tell init", "write", "init does not listen");
	return 0;
}

void init_channel_working(struct init_channel *channel)
{
	const uint64_t now = now_ns();
	struct avc_error ignored = { 0 };

	heartbeat();
	if (now - channel->working_ns < WORKING_NS)
		return;
	channel->working_ns = now;
	(void)init_channel_verdict(channel, AVC_VERDICT_WORKING, &ignored);
}

void init_channel_kill_lost(const struct init_channel *channel,
			    bool (*known)(pid_t pid, const void *arg), const void *arg)
{
	pid_t children[CHILDREN_MAX];
	bool any;

	/* A killed process leaves behind the child that it was just cloning, and its other
	 * children. */
	do {
		const int count = proc_children(channel->init, children, CHILDREN_MAX);

		any = false;
		for (int i = 0; i < count; i++)
			if (!known(children[i], arg) && tracee_is_ours(children[i])) {
				tracee_kill(children[i]);
				any = true;
			}
	} while (any);
}

bool init_channel_has_zombies(const struct init_channel *channel)
{
	pid_t children[CHILDREN_MAX];
	const int count = proc_children(channel->init, children, CHILDREN_MAX);
	bool any = false;

	for (int i = 0; i < count; i++) {
		struct proc_stat stat;

		any |= proc_stat(children[i], &stat) == 0 && stat.state == 'Z' && stat.threads == 1;
	}
	return any;
}

/* Can still use what the app shares with others: it, or one of its threads, is not exiting yet. */
static bool may_run(const struct proc_stat *stat)
{
	return (stat->state != 'Z' && stat->state != 'X') || stat->threads > 1;
}

/* A child of init: 1 it runs, and has been sent SIGKILL; 0 it is a zombie; -1 it is no child of
 * init. */
static int kill_leftover(const struct init_channel *channel, pid_t pid)
{
	struct proc_stat stat;
	/* First: then it refers to the process that is checked, even if the PID is reused later. */
	int pidfd = proc_pidfd_open(pid), result = -1;

	if (proc_stat(pid, &stat) == 0 && stat.parent == channel->init)
		result = may_run(&stat);
	if (result > 0 && pidfd >= 0)
		syscall(SYS_pidfd_send_signal, pidfd, SIGKILL, NULL, 0);
	close_fd(&pidfd);
	return result;
}

int init_channel_kill_leftovers(struct init_channel *channel,
				bool (*keep)(pid_t pid, const void *arg), void (*tend)(void *arg),
				void *arg, struct avc_error *err)
{
	const uint64_t start = now_ns(), end = tracee_deadline(LEFTOVERS_ALIVE_NS);
	uint64_t alive_ns = start;
	pid_t alive;

	/* The children of a killed process become init's in turn. */
	for (;;) {
		pid_t children[CHILDREN_MAX];
		const uint64_t now = now_ns();
		const int count = proc_children(channel->init, children, CHILDREN_MAX);
		bool any = false;

		if (count < 0 && is_shortage(errno))
			return fail_errno(err, 0, "restore", "open(children)",
					  "its processes cannot be listed");
		alive = 0;
		for (int i = 0; i < count; i++) {
			const int runs = keep(children[i], arg)
						 ? -1
						 : kill_leftover(channel, children[i]);

			/* Its PID is not free before init has reaped it. */
			any |= runs >= 0;
			if (runs > 0) {
				alive = children[i];
				alive_ns = now;
			}
		}
		/* A zombie's PID may be needed or not: that shows later. */
		if (!any || now - alive_ns > LEFTOVERS_NS)
			return 0;
		if (alive && !tracee_has_time(end))
			return fail(err, AVC_DEADLINE, 0, alive, "restore", "",
				    "a process that was killed does not end");
		init_channel_working(channel);
		tend(arg);
		usleep(now - start < LEFTOVERS_NS ? LEFTOVERS_US : LEFTOVERS_LONG_US);
	}
}
