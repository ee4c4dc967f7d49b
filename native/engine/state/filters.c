/* SPDX-License-Identifier: Apache-2.0
 *
 * The seccomp filters of a thread, oldest first (a chain).  A restored process inherits those of
 * the main thread's template, from the kernel.  What a child, or a thread, has beyond these is
 * installed again while it is restored, before it can run: what all threads of a process have, by
 * its main thread before there are others, so that they share it
 * (SECCOMP_FILTER_FLAG_TSYNC works on); the rest by each thread, as its last call.
 *
 * The programs lie in the parasite until then, where the application could change them, or the
 * calls that install them.  So each thread is stopped before it runs, and its filters are compared
 * with those that it had (filters_check()).
 */
#include <errno.h>
#include <linux/capability.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "state.h"

#define CHAINS_MAX 8             /* of the threads of a process                           */
#define PROGRAMS_MAX (32u << 20) /* bytes, of all processes                               */
#define GET_METADATA ((enum __ptrace_request)0x420d) /* linux/ptrace.h                      */

/* One that the container has not; its program follows. */
struct filter {
	struct filter *next; /* newer                                                    */
	uint64_t before;     /* a hash of all that are older                             */
	uint64_t flags;
	bool asks; /* a supervisor, or nobody knows whom: it cannot be installed again     */
	uint16_t count;
	struct sock_filter program[];
};

struct chain {
	uint64_t sum; /* struct creds.filters                                            */
	struct filter *oldest;
};

struct chains {
	uint32_t count;
	struct chain chain[CHAINS_MAX];
};

static size_t programs; /* bytes                                                     */

/* ---- while it is stopped ------------------------------------------------------------------ */

/* A thread could install others with the same sum, if it could find some: so it has a key. */
static uint64_t add_to_sum(uint64_t sum, const struct sock_filter *program, long count)
{
	_Static_assert(sizeof(uint64_t) == sizeof *program, "an instruction is a word");
	return keyed_sum(sum, program, (size_t)count);
}

static long get(pid_t tid, uint32_t index, struct sock_filter *program)
{
	return ptrace(PTRACE_SECCOMP_GET_FILTER, tid, (long)index, program);
}

static uint64_t sum_of(pid_t tid, uint32_t *count)
{
	struct sock_filter program[BPF_MAXINSNS];
	uint64_t sum = 0;
	long n;

	for (*count = 0; (n = get(tid, *count, program)) > 0; ++*count)
		sum = add_to_sum(sum, program, n);
	return sum; /* that was the last one; or there is none */
}

static bool asks(const struct sock_filter *program, long count)
{
	for (long i = 0; i < count; i++)
		if (BPF_CLASS(program[i].code) == BPF_RET &&
		    (BPF_RVAL(program[i].code) == BPF_A ||
		     (program[i].k & SECCOMP_RET_ACTION_FULL) == SECCOMP_RET_USER_NOTIF))
			return true;
	return false;
}

static size_t bytes_of(const struct filter *filter)
{
	return sizeof *filter + filter->count * sizeof *filter->program;
}

static void drop(struct chain *chain)
{
	for (struct filter *filter = chain->oldest, *next; filter; filter = next) {
		next = filter->next;
		programs -= bytes_of(filter);
		free(filter);
	}
	chain->oldest = NULL;
}

static struct filter *keep_one(pid_t tid, uint32_t index, uint64_t before,
			       const struct sock_filter *program, long count)
{
	struct { /* struct seccomp_metadata                                        */
		uint64_t filter_off, flags;
	} metadata = { .filter_off = index };
	struct filter *filter = malloc(sizeof *filter + (size_t)count * sizeof *program);

	if (!filter)
		return NULL;
	if (ptrace(GET_METADATA, tid, sizeof metadata, &metadata) < 0)
		metadata.flags = 0; /* before Linux 4.16; logging */
	*filter = (struct filter){ .before = before,
				   .flags = metadata.flags,
				   .asks = asks(program, count),
				   .count = (uint16_t)count };
	memcpy(filter->program, program, (size_t)count * sizeof *program);
	programs += bytes_of(filter);
	return filter;
}

static void keep(pid_t tid, uint32_t containers, struct chain *chain)
{
	struct sock_filter program[BPF_MAXINSNS];
	struct filter **end = &chain->oldest;
	uint64_t sum = 0;
	long n;

	for (uint32_t i = 0; (n = get(tid, i, program)) > 0; i++) {
		if (i >= containers && programs < PROGRAMS_MAX) {
			*end = keep_one(tid, i, sum, program, n);
			if (!*end)
				break;
			end = &(*end)->next;
		}
		sum = add_to_sum(sum, program, n);
	}
	chain->sum = sum;
}

static struct chain *find(const struct process *process, uint64_t sum)
{
	for (uint32_t i = 0; process->chains && i < process->chains->count; i++)
		if (process->chains->chain[i].sum == sum)
			return &process->chains->chain[i];
	return NULL;
}

static bool is_used(const struct process *process, uint64_t sum)
{
	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].creds.filters == sum)
			return true;
	return false;
}

static void drop_unused(struct process *process)
{
	struct chains *chains = process->chains;

	for (uint32_t i = chains->count; i-- > 0;) {
		if (is_used(process, chains->chain[i].sum))
			continue;
		drop(&chains->chain[i]);
		chains->chain[i] = chains->chain[--chains->count];
	}
}

void filters_read(struct process *process, struct thread *thread)
{
	static uint64_t last;

	/* Then all have the same: those of the container. */
	if (seccomp_is_confined()) {
		thread->creds.filters = last;
		return;
	}
	thread->creds.filters = last = sum_of(thread->tid, &thread->filter_count);
	if (thread->filter_count <= process->plain_filters || find(process, last))
		return;
	if (!process->chains)
		process->chains = calloc(1, sizeof *process->chains);
	if (!process->chains)
		return; /* what is missing is noticed in filters_setup() */
	drop_unused(process);
	if (process->chains->count < CHAINS_MAX)
		keep(thread->tid, process->plain_filters,
		     &process->chains->chain[process->chains->count++]);
}

bool filters_are_more(const struct thread *thread)
{
	return thread->known && !seccomp_is_confined() &&
	       get(thread->tid, thread->filter_count, NULL) >= 0;
}

void filters_forget(struct process *process)
{
	for (uint32_t i = 0; process->chains && i < process->chains->count; i++)
		drop(&process->chains->chain[i]);
	free(process->chains);
	process->chains = NULL;
}

/* ---- when the app runs again ------------------------------------------------------------ */

/* The oldest filter of a thread that one with `from` has not; *known: false if `from` are not all
 * among its filters. */
static const struct filter *beyond(const struct process *process, const struct creds *from,
				   const struct creds *to, bool *known)
{
	const struct chain *chain = find(process, to->filters);
	const struct filter *filter = chain ? chain->oldest : NULL;

	*known = true;
	if (to->filters == from->filters)
		return NULL;
	while (filter && filter->before != from->filters)
		filter = filter->next;
	*known = filter != NULL;
	return filter;
}

static int refuse(const struct process *process, const struct thread *t, struct avc_error *err)
{
	if (process->descendant)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
			    "process %d has other seccomp filters than the main one, whose filters "
			    "its restore would give it",
			    t->inside);
	return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
		    "its threads differ in their seccomp filters (thread %d)", t->inside);
}

/* Whether a thread that has `from` may become one that has `to`. */
static int check_thread(const struct process *process, const struct creds *from,
			const struct thread *t, struct avc_error *err)
{
	bool known;
	const struct filter *filter = beyond(process, from, &t->creds, &known);

	if (!known)
		return refuse(process, t, err);
	for (const struct filter *f = filter; f; f = f->next)
		if (f->asks)
			return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
				    "a seccomp filter of thread %d asks another process "
				    "(SECCOMP_RET_USER_NOTIF), which cannot be put back",
				    t->inside);
	/* seccomp(2): or CAP_SYS_ADMIN, which most give up before, or with it. */
	if (filter && !t->creds.no_new_privs)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
			    "thread %d has installed a seccomp filter without PR_SET_NO_NEW_PRIVS, "
			    "and may not do so again",
			    t->inside);
	return 0;
}

static const struct creds *inherited_by(const struct process *process,
					const struct thread *main_thread)
{
	/* Other processes are forked from the main one, and threads created by theirs. */
	return process->descendant ? process->forebear : &main_thread->creds;
}

/* What all threads of a process have: the filters of its main thread that are older than
 * `shared`. */
static uint64_t shared_sum(const struct process *process, const struct creds *from,
			   const struct thread *main_thread)
{
	uint64_t shared = main_thread->creds.filters;
	bool known;

	for (uint32_t i = 0; i < process->thread_count; i++) {
		const struct creds *to = &process->threads[i].creds;
		const struct filter *a = beyond(process, from, &main_thread->creds, &known);
		const struct filter *b = beyond(process, from, to, &known);
		uint64_t sum = from->filters;

		if (process->threads[i].block < 0)
			continue;
		for (; a && b && sum != shared; a = a->next, b = b->next) {
			const uint64_t next_a = a->next ? a->next->before
							: main_thread->creds.filters;
			const uint64_t next_b = b->next ? b->next->before : to->filters;

			if (next_a != next_b)
				break;
			sum = next_a;
		}
		shared = sum;
	}
	return shared;
}

static avc_remote program_at(struct setup *setup, const struct filter *filter)
{
	const struct {
		uint64_t count;
		avc_remote program;
	} fprog = { filter->count,
		    setup_data(setup, filter->program, filter->count * sizeof *filter->program) };

	return setup_data(setup, &fprog, sizeof fprog);
}

int filters_setup(struct image *image, const struct thread *main_thread, struct setup *setup,
		  struct avc_error *err)
{
	const struct process *process = image->process;
	const struct creds *from = inherited_by(process, main_thread);
	bool known;

	image->seal = calloc(process->thread_count, sizeof *image->seal);
	if (!image->seal)
		return fail_memory(err, 0, "keep template");
	image->seals = 0;
	for (uint32_t i = 0; i < process->thread_count; i++) {
		const struct thread *t = &process->threads[i];

		if (t->block < 0)
			continue;
		if (check_thread(process, from, t, err))
			return -1;
		image->installs |= t->creds.filters != from->filters;
		image->seal[image->seals++] = (struct seal){ t->inside, t->creds.filters };
	}
	image->shared_filters = shared_sum(process, from, main_thread);
	if (image->shared_filters == from->filters)
		return 0;
	setup_add(setup, INJ_BEFORE, "prctl(NO_NEW_PRIVS)", SYS_prctl, PR_SET_NO_NEW_PRIVS, 1);
	for (const struct filter *f = beyond(process, from, &main_thread->creds, &known);
	     f && f->before != image->shared_filters; f = f->next)
		setup_add(setup, INJ_BEFORE, "seccomp", SYS_seccomp, SECCOMP_SET_MODE_FILTER,
			  f->flags, program_at(setup, f));
	return 0;
}

void filters_setup_thread(const struct image *image, const struct thread *t, struct setup *setup)
{
	const struct creds shared = { .filters = image->shared_filters };
	bool known;

	for (const struct filter *f = beyond(image->process, &shared, &t->creds, &known); f;
	     f = f->next)
		setup_add_thread(setup, "seccomp", SYS_seccomp, SECCOMP_SET_MODE_FILTER, f->flags,
				 program_at(setup, f));
}

/* ---- at a restore ------------------------------------------------------------------------ */

const struct seal *filters_seal_of(const struct image *image, pid_t tid)
{
	const pid_t inside = proc_inside(tid);

	for (uint32_t i = 0; i < image->seals; i++)
		if (image->seal[i].inside == inside)
			return &image->seal[i];
	return NULL;
}

int filters_check(const struct seal *seal, pid_t tid, struct avc_error *err)
{
	uint32_t count;

	if (sum_of(tid, &count) == seal->filters)
		return 0;
	return fail(err, AVC_UNSUPPORTED, 0, tid, "restore", "seccomp",
		    "thread %d would not be under the seccomp filters that it had", seal->inside);
}
