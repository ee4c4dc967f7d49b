/* SPDX-License-Identifier: Apache-2.0
 *
 * Detects that a handler of the app's has just been run for a fault.  A program that is about to
 * end itself for it has often left the handler by then: a Go panic runs its deferred functions,
 * waits for the other goroutines and prints a report before it exits.  An image of that time would
 * die at every restore, and no signal frame shows it (dying.c).
 *
 * Faults are counted for a moment before each checkpoint, of programs with such handlers only.  If
 * there was one, also during the freeze, the checkpoint is put off: by then a dying program has
 * ended.  Programs that live
 * on after faults, as a matter of course, are soon not asked any more.
 */
#include <signal.h>

#include "guard.h"

#define LISTEN_NS (100 * NS_PER_MS)
#define PUT_OFF_MAX 5  /* times in a row */
#define SURVIVED_MAX 8 /* faults after which it lived on */

static const struct thread_event_kind FAULTS = {
	.tracepoint = "events/signal/signal_deliver/id",
	.filter = "sig == 4 || sig == 7 || sig == 8 || sig == 11", /* ILL, BUS, FPE, SEGV */
};

#define FAULT_SIGNALS \
	(SIGNAL_BIT(SIGILL) | SIGNAL_BIT(SIGBUS) | SIGNAL_BIT(SIGFPE) | SIGNAL_BIT(SIGSEGV))

void faults_learn(struct faults *faults)
{
	thread_events_learn(&faults->events, &FAULTS);
}

static bool handles_faults(const struct tree *tree)
{
	for (uint32_t i = 0; i < tree->processes; i++)
		if (tree->process[i]->pid && tree->process[i]->caught & FAULT_SIGNALS)
			return true;
	return false;
}

uint64_t faults_due(const struct faults *faults, const struct tree *tree, uint64_t checkpoint_ns)
{
	if (faults->armed || checkpoint_ns == UINT64_MAX || faults->events.number < 0 ||
	    faults->survived == SURVIVED_MAX || !handles_faults(tree))
		return UINT64_MAX;
	return checkpoint_ns > LISTEN_NS ? checkpoint_ns - LISTEN_NS : 0;
}

void faults_arm(struct faults *faults, const struct tree *tree)
{
	faults->armed = thread_events_enable(&faults->events, &FAULTS, tree);
}

void faults_disarm(struct faults *faults)
{
	thread_events_drop(&faults->events);
	faults->armed = false;
	faults->put_off = 0;
	faults->heard_ns = 0;
}

void faults_settle(struct faults *faults, const struct tree *tree, uint64_t next_ns)
{
	faults->put_off = 0;
	if (!faults->armed)
		return;
	if (faults->survived < SURVIVED_MAX && next_ns < now_ns() + LISTEN_NS)
		faults_arm(faults, tree); /* there may be new processes */
	else
		faults_disarm(faults);
}

bool faults_heard(struct faults *faults)
{
	if (!faults->armed || !thread_events_heard(&faults->events))
		return false;
	faults->heard_ns = now_ns();
	return true;
}

uint64_t faults_put_off(struct faults *faults, uint64_t now)
{
	const bool heard = faults_heard(faults);
	const uint64_t until = faults->heard_ns ? faults->heard_ns + LISTEN_NS : 0;

	if (now < until && ++faults->put_off <= PUT_OFF_MAX)
		return until;
	faults->survived += faults->put_off != 0;
	if (heard)
		faults_disarm(faults); /* there are always some */
	return 0;
}

void faults_end(struct faults *faults)
{
	thread_events_close(&faults->events);
	faults->armed = false;
}
