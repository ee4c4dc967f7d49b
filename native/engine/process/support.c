/* SPDX-License-Identifier: Apache-2.0
 *
 * Checks for what cannot be protected, while the app runs; and whether this is a quiescent moment.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/capability.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/ptrace.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "process.h"

/* Before injection; from then on the look before each freeze (files_prepare()) does the same. */
static int check_descriptors(struct process *process, const struct process *parent,
			     struct avc_error *err)
{
	const char *refused = NULL;

	if (process->infected)
		return 0;
	if (files_survey(process, parent && parent->infected ? parent : NULL, &refused))
		return fail_errno(err, process->pid, "check", "open(fd)", "it has ended");
	return refused ? fail(err, AVC_UNSUPPORTED, 0, process->pid, "check", "", "%s", refused)
		       : 0;
}

static int check_mapping(const struct mapping *m, void *arg)
{
	const char **reason = arg;

	*reason = memory_refuses(m);
	return *reason ? -1 : 0;
}

/* Only when its size has changed: the file is long. */
static int check_mappings(struct process *process, struct avc_error *err)
{
	const long pages = proc_vm_pages(process->statm_fd, NULL);
	const char *reason = NULL;

	if (pages == process->surveyed_pages)
		return 0;
	if (proc_mappings(process->pid, "maps", check_mapping, &reason) && !reason)
		return fail_errno(err, process->pid, "check", "read(maps)", "it has ended");
	process->surveyed_pages = reason ? -1 : pages;
	return reason ? fail(err, AVC_UNSUPPORTED, 0, process->pid, "check", "", "%s", reason) : 0;
}

/* For an exiting process they are gone, or the result is EACCES. */
static int not_seen(pid_t pid, struct avc_error *err)
{
	const int errnum = errno;

	if (proc_is_exiting(pid))
		return fail(err, AVC_GONE, ESRCH, pid, "check", "stat(ns)", "it has ended");
	errno = errnum;
	return fail_errno(err, pid, "check", "stat(ns)", "its namespaces cannot be seen");
}

/* Children are forked by their parents, which must have the same namespaces. */
static int check_descendant(const struct process *process, const struct proc_status *status,
			    struct avc_error *err)
{
	static const char *const spaces[] = { "mnt", "net", "ipc", "uts", "user", "cgroup", "pid" };

	for (size_t i = 0; i < sizeof spaces / sizeof *spaces; i++) {
		char path[64];
		struct stat own, inits;

		snprintf(path, sizeof path, "/proc/%d/ns/%s", process->pid, spaces[i]);
		if (stat(path, &own))
			return not_seen(process->pid, err);
		snprintf(path, sizeof path, "/proc/%d/ns/%s", process->init, spaces[i]);
		if (stat(path, &inits) || own.st_ino != inits.st_ino)
			return fail(err, AVC_UNSUPPORTED, 0, process->pid, "check", "",
				    "process %d has a %s namespace of its own", process->inside,
				    spaces[i]);
	}
	/* What they are is compared later (filters.c). */
	if (status->seccomp_filters >= process->main_filters)
		return 0;
	if (proc_is_exiting(process->pid)) /* it has none any more */
		return fail(err, AVC_GONE, ESRCH, process->pid, "check", "open(status)",
			    "it has ended");
	return fail(err, AVC_UNSUPPORTED, 0, process->pid, "check", "",
		    "process %d has not the seccomp filters of the main one, which its restore "
		    "would give it",
		    process->inside);
}

/* The shadow stack would not match the calls made in the parasite, and the thread would fault on
 * return: so before injection.  A program has it from its start, or not at all. */
static int check_shadow_stack(const struct process *process, const struct proc_status *status,
			      struct avc_error *err)
{
	if (!process->infected && status->shadow_stack)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "check", "",
			    "it has shadow stacks (CET), which cannot be put back; "
			    "GLIBC_TUNABLES=glibc.cpu.x86_shstk=off runs it without");
	return 0;
}

/* Before it is stopped for the first time: the kernel numbers its calls in another way, so that an
 * interrupted one is not repeated for it (trace/rewind.c).  Of 32-bit words the first two of the
 * auxiliary vector are a type and its value, which is not 0. */
static int check_word_size(const struct process *process, struct avc_error *err)
{
	uint64_t type = 0;
	int fd;

	if (process->infected)
		return 0;
	fd = proc_open(process->pid, "auxv", O_RDONLY);
	if (fd >= 0 && read(fd, &type, sizeof type) != sizeof type)
		type = 0; /* it is exiting, and has no memory */
	close_fd(&fd);
	return type >> 32 ? fail(err, AVC_UNSUPPORTED, 0, process->pid, "check", "",
				 "it is a 32-bit program")
			  : 0;
}

/* unshare(2) and setns(2): its next child is the first process of another namespace.  A
 * clone of ours would be that, and the namespace would end with it. */
static int check_namespaces(struct process *process, struct avc_error *err)
{
	static const struct {
		const char *own, *of_children, *reason;
	} kinds[] = {
		{ "ns/pid", "ns/pid_for_children",
		  "its children get a PID namespace of their own (a container in the container)" },
		{ "ns/time", "ns/time_for_children",
		  "its children get a time namespace of their own" },
	};

	for (size_t i = 0; i < sizeof kinds / sizeof *kinds; i++) {
		char path[64], own[64] = "", theirs[64] = "";

		snprintf(path, sizeof path, "/proc/%d/%s", process->pid, kinds[i].own);
		if (readlink(path, own, sizeof own - 1) < 0)
			continue; /* the kernel has none of these; or it has ended */
		/* A namespace that has no process yet is not shown. */
		snprintf(path, sizeof path, "/proc/%d/%s", process->pid, kinds[i].of_children);
		if (readlink(path, theirs, sizeof theirs - 1) < 0) {
			char other[64];

			if (errno != ENOENT)
				continue;
			/* Nor is any of an exiting process (kernel/exit.c,
			 * exit_task_namespaces()). */
			snprintf(path, sizeof path, "/proc/%d/ns/uts", process->pid);
			if (readlink(path, other, sizeof other) < 0)
				return fail(err, AVC_GONE, ESRCH, process->pid, "check", "readlink",
					    "it has ended");
		}
		/* Behind the kind: "pid:[4026531836]". */
		if (strcmp(own + strcspn(own, "["), theirs + strcspn(theirs, "[")) != 0)
			return fail(err, AVC_UNSUPPORTED, 0, process->pid, "check", "", "%s",
				    kinds[i].reason);
	}
	return 0;
}

/* Threads are queried again when there are more of them. */
static void note_filters(struct process *process, uint32_t count)
{
	for (uint32_t i = 0; process->filters != count && i < process->thread_count; i++)
		process->threads[i].known = false;
	process->filters = count;
}

/* Its parent forks it with its own, and a process enters another one with the rights of its parent. */
static int check_root(const struct process *process, const struct process *parent,
		      struct avc_error *err)
{
	struct proc_status status;

	if (!parent || proc_same_file(process->pid, parent->pid, "root") != 0 ||
	    proc_status(parent->pid, &status) ||
	    status.caps[STATUS_EFFECTIVE] >> CAP_SYS_CHROOT & 1)
		return 0;
	return fail(err, AVC_UNSUPPORTED, 0, process->pid, "check", "",
		    "process %d has a root directory of its own, and its parent has given up the "
		    "right to chroot(2)",
		    process->inside);
}

int support_check(struct process *process, const struct process *parent, struct avc_error *err)
{
	struct proc_status status;

	if (proc_status_of(process->status_fd, process->pid, &status))
		return fail_errno(err, process->pid, "check", "open(status)", "it has ended");
	if (check_word_size(process, err) || check_shadow_stack(process, &status, err) ||
	    check_namespaces(process, err) || check_descriptors(process, parent, err) ||
	    check_mappings(process, err))
		return -1;
	dying_note_caught(process, &status);
	(void)seccomp_is_containers(&status, process->plain_filters);
	note_filters(process, status.seccomp_filters);
	if (!process->descendant)
		return 0;
	return check_descendant(process, &status, err) ? -1 : check_root(process, parent, err);
}

/* Through the process: a second dentry for each thread in /proc would make its exit slower (see
 * thread_ask()). */
static int is_awake(pid_t tid, void *arg)
{
	const pid_t pid = *(const pid_t *)arg;
	char name[48], buf[512], *p;

	snprintf(name, sizeof name, "task/%d/stat", tid);
	if (proc_read(pid, name, buf, sizeof buf) <= 0)
		return 0;
	p = strrchr(buf, ')');
	return p && p[1] == ' ' && p[2] == 'R' ? -1 : 0;
}

/* Takes duplicates of a running app's sockets, which cost something (files_descriptor.c): only for a stream of
 * messages (avckpt.tcp=messages). */
static bool is_in_message(const struct process *process)
{
	for (uint32_t i = 0; i < process->socket_count; i++) {
		int fd = (int)syscall(SYS_pidfd_getfd, process->pidfd, process->sockets[i], 0),
		    bytes = 0;

		if (fd < 0)
			continue; /* closed since */
		if (ioctl(fd, FIONREAD, &bytes))
			bytes = 0; /* not one with bytes to read */
		if (file_is_coming(fd))
			bytes = 1;
		close(fd);
		if (bytes)
			return true;
	}
	return false;
}

bool process_is_quiescent(const struct process *process)
{
	pid_t pid = process->pid;
	struct proc_stat stat;

	if (proc_stat_of(process->stat_fd, &stat) == 0 && stat.threads == 1) {
		if (stat.state == 'R')
			return false;
	} else if (proc_numbers(process->task_dirfd, is_awake, &pid)) {
		return false;
	}
	return !(process->tcp_messages && is_in_message(process));
}
