/* SPDX-License-Identifier: Apache-2.0
 *
 * Interval timers (setitimer(2), alarm(2)) and POSIX timers (timer_create(2)), none
 * of which a clone inherits.
 *
 * They are listed in /proc/PID/timers while everything is stopped; only the process itself can
 * report the remaining time, in the same list of calls that clones it.  At a restore they are
 * recreated with their own ids and set to what is left now: a deadline stays where it was, ticks
 * keep their phase, and a timer that counts CPU time continues from where it was.
 */
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#include "state.h"

#define ITIMERS 3                  /* ITIMER_REAL, ITIMER_VIRTUAL, ITIMER_PROF */
#define CLOCK (INJ_TIMERS_MAX - 1) /* where the time of the query is stored */
#define POSIX_MAX (CLOCK - ITIMERS)

struct posix_timer {
	int32_t id, signal, notify, clock;
	uint64_t value;
	pid_t tid; /* in our namespace; of SIGEV_THREAD_ID                      */
};

struct timers {
	uint32_t count; /* of posix[]                                           */
	bool too_many;
	struct posix_timer posix[POSIX_MAX];
	struct inj_timer setting[INJ_TIMERS_MAX];
	bool valid[INJ_TIMERS_MAX];
	uint64_t asked_ns; /* by the CLOCK_MONOTONIC of the process' time namespace */
	uint64_t took_ns;  /* from the query until the pending signals were read */
	char text[16384];
};

struct timers *timers_new(void)
{
	return calloc(1, sizeof(struct timers));
}

/* Lines "ID: 0", "signal: 34/000000000000abcd", "notify: signal/tid.123", "ClockID: 1"
 * (fs/proc/base.c, show_timer). */
void timers_parse(struct timers *timers, char *text)
{
	struct posix_timer *t = NULL;
	char *save = NULL;

	timers->count = 0;
	timers->too_many = false;
	for (char *line = strtok_r(text, "\n", &save); line; line = strtok_r(NULL, "\n", &save)) {
		unsigned long value;
		char how[8], whom[4];
		int a, b;

		if (sscanf(line, "ID: %d", &a) == 1) {
			if (timers->count == POSIX_MAX) {
				timers->too_many = true;
				return;
			}
			t = &timers->posix[timers->count++];
			*t = (struct posix_timer){ .id = a };
		} else if (!t) {
			continue;
		} else if (sscanf(line, "signal: %d/%lx", &a, &value) == 2) {
			t->signal = a;
			t->value = value;
		} else if (sscanf(line, "notify: %7[a-z]/%3[a-z].%d", how, whom, &b) == 3) {
			t->notify = !strcmp(how, "none")     ? SIGEV_NONE
				    : !strcmp(how, "thread") ? SIGEV_THREAD
							     : SIGEV_SIGNAL;
			if (!strcmp(whom, "tid")) {
				t->notify |= SIGEV_THREAD_ID;
				t->tid = b;
			}
		} else if (sscanf(line, "ClockID: %d", &a) == 1) {
			t->clock = a;
		}
	}
}

void timers_ask(struct process *process, struct inj_call *call)
{
	struct timers *timers = process->timers;
	const avc_remote out = parasite_remote(&process->parasite,
					       process->parasite.control->timer);
	size_t read = 0;
	ssize_t n;

	for (int which = 0; which < ITIMERS; which++)
		call_add(call, SYS_getitimer, (uint64_t)which,
			 out + (uint64_t)which * sizeof(struct inj_timer));
	/* The kernel gives a page at a time.  There is room for more than POSIX_MAX. */
	do {
		n = pread(process->timers_fd, timers->text + read, sizeof timers->text - 1 - read,
			  (off_t)read);
		read += n > 0 ? (size_t)n : 0;
	} while (n > 0);
	timers->text[read] = 0;
	timers_parse(timers, timers->text);
	for (uint32_t i = 0; i < timers->count; i++)
		call_add(call, SYS_timer_gettime, (uint64_t)timers->posix[i].id,
			 out + (ITIMERS + i) * sizeof(struct inj_timer));
	call_add(call, SYS_clock_gettime, CLOCK_MONOTONIC, out + CLOCK * sizeof(struct inj_timer));
}

void timers_answer(struct process *process, const struct inj_call *call, uint64_t took_ns)
{
	struct timers *timers = process->timers;
	struct timespec asked;

	timers->took_ns = took_ns;
	for (uint32_t i = 0; i < ITIMERS + timers->count; i++) {
		timers->valid[i] = call->call[i].result == 0;
		timers->setting[i] = process->parasite.control->timer[i];
	}
	memcpy(&asked, &process->parasite.control->timer[CLOCK], sizeof asked);
	timers->asked_ns = timespec_ns(&asked);
}

/* On CPU time, which starts over with the process. */
static bool counts_cpu(int32_t clock)
{
	return clock < 0 || clock == CLOCK_PROCESS_CPUTIME_ID || clock == CLOCK_THREAD_CPUTIME_ID;
}

static bool runs(const struct inj_timer *s)
{
	return s->left[0] || s->left[1];
}

/* It expired between the two, and its signal is among the pending ones: once is enough. */
static bool has_just_expired(const struct process *process, const struct inj_timer *s,
			     int64_t unit_ns, int signal, int id)
{
	return !s->interval[0] && !s->interval[1] && !s->left[0] &&
	       s->left[1] * unit_ns <= (int64_t)process->timers->took_ns &&
	       pending_contains(process->pending, signal, id);
}

/* ITIMER_REAL with its signal pending is not running until that is delivered, and shows nothing
 * left (kernel/time/itimer.c). */
static bool ticks(const struct inj_timer *s)
{
	return s->interval[0] || s->interval[1];
}

/* Whether the process dies of such a signal. */
static bool ends_it(const struct proc_status *status, int signal)
{
	const uint64_t spared = status->caught | status->ignored | status->blocked;

	return signal > 0 && signal < NSIG && signal_ends_by_default(signal) &&
	       !(spared & SIGNAL_BIT(signal));
}

enum counts {
	COUNTS_CPU,   /* time of its own                                        */
	COUNTS_CLOCK, /* until a deadline                                       */
	COUNTS_DOWN   /* until the process ends of it                           */
};

static enum counts counts(bool cpu, const struct proc_status *status, int signal)
{
	return cpu ? COUNTS_CPU : ends_it(status, signal) ? COUNTS_DOWN : COUNTS_CLOCK;
}

static void add_setting(struct setup *setup, const struct timers *timers, long nr, uint64_t timer,
			const struct inj_timer *s, enum counts counts)
{
	const char *name = nr == SYS_setitimer ? "setitimer" : "timer_settime";
	const avc_remote at = setup_data(setup, s, sizeof *s);
	struct inj_setup *set;

	if (counts != COUNTS_CPU)
		set = setup_add(setup, INJ_AFTER, name, INJ_TIMER_SET, (uint64_t)nr, timer, at,
				timers->asked_ns, counts == COUNTS_DOWN);
	else if (nr == SYS_setitimer)
		set = setup_add(setup, INJ_AFTER, name, nr, timer, at);
	else
		set = setup_add(setup, INJ_AFTER, name, nr, timer, 0, at);
	set->flags = INJ_MAY_FAIL;
}

static void add_posix(struct process *process, const struct posix_timer *t,
		      const struct inj_timer *s, bool valid, const struct proc_status *status,
		      struct setup *setup)
{
	const int32_t id = t->id;
	struct sigevent event = {
		.sigev_notify = t->notify,
		.sigev_signo = t->signal,
		.sigev_value.sival_ptr = (void *)t->value,
	};

	if (t->notify & SIGEV_THREAD_ID) {
		const struct thread *thread = thread_find(process, t->tid);

		if (!thread || thread->block < 0)
			return; /* the thread had exited: it could not fire any more */
		event._sigev_un._tid = thread->inside;
	}
	setup_add(setup, INJ_AFTER, "timer_create", INJ_TIMER_CREATE, (uint64_t)(int64_t)t->clock,
		  setup_data(setup, &event, sizeof event), setup_data(setup, &id, sizeof id),
		  (uint64_t)id)
		->flags = INJ_MAY_FAIL;
	if (valid && runs(s) && !has_just_expired(process, s, 1, t->signal, t->id))
		add_setting(setup, process->timers, SYS_timer_settime, (uint64_t)id, s,
			    counts(counts_cpu(t->clock), status,
				   t->notify & SIGEV_NONE ? 0 : t->signal));
}

static int by_id(const void *a, const void *b)
{
	const struct posix_timer *const *x = a, *const *y = b;

	return ((*x)->id > (*y)->id) - ((*x)->id < (*y)->id);
}

void timers_setup(struct process *process, const struct proc_status *status, struct setup *setup)
{
	const struct timers *timers = process->timers;
	const struct posix_timer *sorted[POSIX_MAX];

	/* Ascending, for kernels on which ids can only be reached by counting up. */
	for (uint32_t i = 0; i < timers->count; i++)
		sorted[i] = &timers->posix[i];
	qsort(sorted, timers->count, sizeof *sorted, by_id);
	for (uint32_t i = 0; i < timers->count; i++) {
		const size_t k = (size_t)(sorted[i] - timers->posix);

		add_posix(process, sorted[i], &timers->setting[ITIMERS + k],
			  timers->valid[ITIMERS + k], status, setup);
	}
	for (int which = 0; which < ITIMERS; which++) {
		const struct inj_timer *s = &timers->setting[which];
		const bool real = which == ITIMER_REAL;

		if (timers->valid[which] && (runs(s) || (real && ticks(s))) &&
		    !(real && has_just_expired(process, s, 1000, SIGALRM, -1)))
			add_setting(setup, timers, SYS_setitimer, (uint64_t)which, s,
				    counts(!real, status, SIGALRM));
	}
	if (timers->too_many && !setup->notice.code)
		fail(&setup->notice, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
		     "it has more than %d POSIX timers; the others are lost at a restore",
		     POSIX_MAX);
}
