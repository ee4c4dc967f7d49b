/* SPDX-License-Identifier: Apache-2.0
 *
 * Seccomp filters stay in force over injected code.  The container's allow what it calls; so do most
 * that applications install.  Where they refuse it, injected code is supervised (seccomp_supervise.c).
 * Filters that could do harm once the guard has died are found here: their process is not protected.
 */
#include <errno.h>
#include <linux/seccomp.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ptrace.h>
#include <unistd.h>

#include "seccomp.h"

/* ---- whether injected code can live with a filter ------------------------------------------------ */

/* Whether it prevents a call of injected code.  Fails if such code would do harm under it without a
 * tracer.  The app cannot have made a call that the container's own filters refuse, so that is not
 * needed. */
static int judge(const struct filter *p, bool containers, pid_t tid, bool *barred,
		 struct avc_error *err)
{
	for (size_t i = 0; i < seccomp_wanted.count; i++) {
		const enum verdict v = filter_verdict(p, &seccomp_wanted.kind[i]);

		if (v == ENDS)
			return fail(
				err, AVC_UNSUPPORTED, 0, tid, "check", "",
				"it has a seccomp filter that may kill it, if the guard dies in "
				"a checkpoint, for what that calls (system call %ld)",
				seccomp_wanted.kind[i].nr);
		*barred |= v == MAY_REFUSE || (v == REFUSES && !containers);
	}
	for (size_t i = 0; i < seccomp_homeward.count; i++)
		if (filter_verdict(p, &seccomp_homeward.kind[i]) != PASSES)
			return fail(err, AVC_UNSUPPORTED, 0, tid, "check", "",
				    "it has a seccomp filter that may refuse %s, without which it "
				    "would not go on as before if the guard died in a checkpoint",
				    seccomp_homeward_name[i]);
	return 0;
}

static bool hinders_trees(const struct filter *p)
{
	return filter_refuses_any(p, &seccomp_wanted_to_restore) ||
	       filter_refuses_any(p, &seccomp_wanted_for_trees);
}

/* The container's filters, as of the first thread that was looked at. */
static struct {
	bool known, hinder, refuse_watching, refuse_asking, bar_restart, bar_rest;
} containers_filters;

static void note_containers(const struct filter *p, bool barred)
{
	containers_filters.hinder |= filter_refuses_any(p, &seccomp_needed) || barred;
	containers_filters.refuse_asking |= filter_refuses_any(p, &seccomp_needed_to_ask);
	containers_filters.bar_restart |= filter_refuses_any(p, &seccomp_restarts);
	containers_filters.bar_rest |= filter_refuses_any(p, &seccomp_rests);
	containers_filters.refuse_watching |= filter_refuses_any(p, &seccomp_needed_to_watch);
}

/* ---- a guard that has a filter of its own ----------------------------------------------------- */

/* The kernel lets it neither read the filters of others nor suspend them (kernel/seccomp.c,
 * seccomp_get_filter(); kernel/ptrace.c, check_ptrace_options()). So it can only go on as long as no
 * task has more filters than the container, whose filters it has read before. */
static struct {
	bool is, met;
} confined;

bool seccomp_can_be_confined(void)
{
	return containers_filters.known && !containers_filters.hinder;
}

bool seccomp_refuses_watching(void)
{
	return containers_filters.refuse_watching;
}

bool seccomp_refuses_asking(void)
{
	return containers_filters.refuse_asking;
}

void seccomp_confined(void)
{
	confined.is = true;
}

bool seccomp_is_confined(void)
{
	return confined.is;
}

bool seccomp_must_suspend(void)
{
	return confined.met;
}

long seccomp_suspend_option(void)
{
	return confined.is ? 0 : PTRACE_O_SUSPEND_SECCOMP;
}

static struct seccomp_counts counts_in(const struct proc_status *status)
{
	return (struct seccomp_counts){ .umask = status->umask,
					.mode = status->seccomp,
					.filters = status->seccomp_filters };
}

static bool parse_counts(const char *text, struct seccomp_counts *counts)
{
	const char *mode = strstr(text, "\nSeccomp:"), *count = strstr(text, "\nSeccomp_filters:"),
		   *umask = strstr(text, "\nUmask:");

	if (!mode || !count || !umask)
		return false;
	*counts = (struct seccomp_counts){
		.umask = (uint32_t)strtoul(umask + strlen("\nUmask:"), NULL, 8),
		.mode = (uint32_t)atoi(mode + strlen("\nSeccomp:")),
		.filters = (uint32_t)atoi(count + strlen("\nSeccomp_filters:")),
	};
	return true;
}

/* Only these lines, and from an open file where there is one, because all of this is done while
 * the application is stopped. */
static int read_counts(pid_t tid, int status_fd, struct seccomp_counts *counts)
{
	struct proc_status status;
	char text[8192];
	const ssize_t n = status_fd < 0 ? -1 : pread(status_fd, text, sizeof text - 1, 0);

	if (n > 0) {
		text[n] = 0;
		if (parse_counts(text, counts))
			return 0;
	}
	if (proc_status(tid, &status))
		return -1;
	*counts = counts_in(&status);
	return 0;
}

int seccomp_counts(struct process *process, struct seccomp_counts *counts)
{
	if (!process->counts.known) {
		/* One that runs could change them, and end. */
		const bool last = threads_all_stopped(process);

		if (read_counts(process->pid, process->status_fd, &process->counts))
			return -1;
		process->counts.known = last;
	}
	*counts = process->counts;
	return 0;
}

void seccomp_counts_forget(struct process *process)
{
	process->counts.known = process->filters_seen = false;
}

void seccomp_own_forget(struct process *process)
{
	process->filters_seen = false;
}

static int counts_of(struct process *process, struct thread *thread, struct seccomp_counts *counts)
{
	if (thread->tid == process->pid ? seccomp_counts(process, counts)
					: read_counts(thread->tid, -1, counts))
		return -1;
	thread->umask = (int32_t)counts->umask;
	return 0;
}

static bool are_containers(const struct seccomp_counts *counts, uint32_t containers)
{
	const bool is = counts->mode != SECCOMP_MODE_STRICT && counts->filters <= containers;

	confined.met |= confined.is && !is;
	return is;
}

bool seccomp_is_containers(const struct proc_status *status, uint32_t containers)
{
	const struct seccomp_counts counts = counts_in(status);

	return are_containers(&counts, containers);
}

/* It is stopped: nothing but another thread of its process could give it a filter. */
static int read_confined(struct process *process, struct thread *thread, struct avc_error *err)
{
	struct seccomp_counts counts;

	if (counts_of(process, thread, &counts))
		return fail_errno(err, thread->tid, "run injected code", "open(status)",
				  "it has ended");
	thread->seccomp = process->plain_filters ? SECCOMP_IN_FORCE : SECCOMP_NONE;
	return are_containers(&counts, process->plain_filters)
		       ? 0
		       : fail(err, AVC_DEADLINE, 0, thread->tid, "run injected code", "",
			      "it has a seccomp filter of its own now, which takes another guard");
}

static long filter_get(pid_t tid, uint32_t index, void *insn)
{
	return ptrace(PTRACE_SECCOMP_GET_FILTER, tid, (long)index, insn);
}

/* A task without any filter may be in strict mode. */
static int read_none(struct process *process, struct thread *thread, struct avc_error *err)
{
	struct seccomp_counts counts;

	if (counts_of(process, thread, &counts))
		return fail_errno(err, thread->tid, "run injected code", "open(status)",
				  "it has ended");
	thread->seccomp = SECCOMP_NONE;
	return counts.mode == SECCOMP_MODE_STRICT
		       ? fail(err, AVC_UNSUPPORTED, 0, thread->tid, "check", "",
			      "it is in seccomp's strict mode, which would kill it if the guard "
			      "died in a checkpoint")
		       : 0;
}

int seccomp_read(struct process *process, struct thread *thread, struct avc_error *err)
{
	const uint32_t containers = process->plain_filters;
	bool barred = false, less = false;
	struct filter p;
	uint32_t i;

	if (confined.is)
		return read_confined(process, thread, err);
	/* Filters are only ever added. */
	if (thread->filters_known && filter_get(thread->tid, thread->filters_known, NULL) < 0 &&
	    errno == ENOENT)
		return 0;
	for (i = 0; (p.count = filter_get(thread->tid, i, p.insn)) > 0; i++) {
		if (judge(&p, i < containers, thread->tid, &barred, err))
			return -1;
		if (i < containers && !containers_filters.known)
			note_containers(&p, barred);
		less = less || (i >= containers && hinders_trees(&p));
	}
	if (errno == EMEDIUMTYPE)
		return fail(err, AVC_UNSUPPORTED, 0, thread->tid, "check", "",
			    "it has a seccomp filter that cannot be read");
	if (errno != ENOENT && errno != EINVAL)
		return fail_errno(err, thread->tid, "run injected code",
				  "ptrace(SECCOMP_GET_FILTER)", "its filters cannot be read");
	containers_filters.known |= i >= containers;
	if (!i)
		return read_none(process, thread, err);
	thread->filters_known = i;
	thread->seccomp = barred ? SECCOMP_SUPERVISED : less ? SECCOMP_LESS : SECCOMP_IN_FORCE;
	return 0;
}

/* A guard that cannot read them assumes it of all that are not the container's. */
static bool has_own(struct process *process)
{
	struct seccomp_counts counts;

	if (!process->filters_seen)
		process->filters_own = seccomp_counts(process, &counts) == 0 &&
				       !are_containers(&counts, process->plain_filters);
	process->filters_seen = true;
	return process->filters_own;
}

static bool own_refuse(struct process *process, pid_t tid, const struct kinds *kinds)
{
	struct filter p;

	if (confined.is)
		return has_own(process);
	for (uint32_t i = process->plain_filters; (p.count = filter_get(tid, i, p.insn)) > 0; i++)
		if (filter_refuses_any(&p, kinds))
			return true;
	return errno == EMEDIUMTYPE; /* it cannot be read */
}

bool seccomp_bars_restart(struct process *process, pid_t tid)
{
	return containers_filters.bar_restart || own_refuse(process, tid, &seccomp_restarts);
}

bool seccomp_bars_rest(struct process *process, pid_t tid)
{
	return !containers_filters.known || containers_filters.bar_rest ||
	       own_refuse(process, tid, &seccomp_rests);
}
