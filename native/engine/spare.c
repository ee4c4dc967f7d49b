/* SPDX-License-Identifier: Apache-2.0
 *
 * A fork of a template, made while the app runs.  What a restore takes longest for is the
 * kernel's copying of page tables.  With a spare they are copied already: the process that
 * takes the app's place is made with the spare's memory (clone(2), CLONE_VM), and has it for
 * itself when the spare has ended.  The template keeps its own, for the next time.
 */
#include <errno.h>
#include <sched.h>
#include <signal.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "internal.h"

/* struct sched_attr, sched_setattr(2) */
static uint32_t policy_of(const struct scheduling *s)
{
	uint32_t policy;

	memcpy(&policy, s->attr + 4, sizeof policy);
	return policy;
}

/* What is made in advance must not keep the app from running: not on a CPU that it has
 * chosen (each thread chooses again, set_up() in inject.c), and not at its priority. */
static bool step_aside(pid_t template, struct scheduling *was)
{
	const struct sched_param none = { 0 };
	unsigned long all[1024 / (8 * sizeof(unsigned long))];

	memset(all, 0xff, sizeof all);
	(void)syscall(SYS_sched_setaffinity, template, sizeof all, all);
	scheduling_read(template, was);
	return (policy_of(was) == SCHED_FIFO || policy_of(was) == SCHED_RR) &&
	       sched_setscheduler(template, SCHED_OTHER, &none) == 0;
}

static int step_back(pid_t pid, const struct scheduling *was)
{
	return (int)syscall(SYS_sched_setattr, pid, was->attr, 0);
}

static int fork_spare(struct target *target, struct generation *generation, struct avc_error *err)
{
	const struct pad *pad = &target->pad;
	struct inj_call *call = &pad_slot(pad, generation->slot)->template_call;
	pid_t spare = 0;

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_clone, CLONE_FILES | CLONE_PARENT | SIGCHLD, 0, 0, 0, 0);
	if (pad_send(pad, generation->template, &generation->base, call, err) ||
	    pad_run_clone(generation->template, call, &spare, err)) {
		target->lost = target->lost || err->code != AVC_KERNEL;
		return -1;
	}
	generation->spare = spare;
	generation->spare_pidfd = proc_pidfd_open(spare);
	return tracee_settle(generation->template, err);
}

static bool name_spare(const struct target *target, const struct generation *generation)
{
	const struct pad *pad = &target->pad;
	struct inj_call *call = &pad_slot(pad, generation->slot)->template_call;
	const pid_t spare = generation->spare;
	struct avc_error gone = { 0 };

	memcpy(call->out, "avckpt-spare", 13);
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_prctl, PR_SET_NAME, pad_remote(pad, call->out), 0, 0, 0);
	return generation->spare_pidfd >= 0 && tracee_await(spare, NULL, &gone) == STOP_TRAP &&
	       pad_send(pad, spare, &generation->base, call, &gone) == 0 &&
	       pad_run(spare, call, &gone) == 0;
}

int spare_make(struct target *target, struct generation *generation, struct avc_error *err)
{
	struct avc_error refused = { 0 };
	struct scheduling was;
	const bool aside = step_aside(generation->template, &was);
	const int result = fork_spare(target, generation, &refused);

	if (generation->spare && (result || !name_spare(target, generation) ||
				  (aside && step_back(generation->spare, &was))))
		spare_drop(generation);
	if (result && refused.code != AVC_KERNEL) {
		*err = refused;
		return -1;
	}
	if (aside && step_back(generation->template, &was))
		return fail_errno(err, generation->template, "make spare", "sched_setattr",
				  "its scheduling can not be put back");
	return 0;
}

bool spare_is_there(struct generation *generation)
{
	if (generation->spare && pidfd_ended(generation->spare_pidfd))
		spare_drop(generation);
	return generation->spare != 0;
}

void spare_drop(struct generation *generation)
{
	if (generation->spare)
		tracee_end(generation->spare, generation->spare_pidfd);
	generation->spare = 0;
	generation->spare_pidfd = -1;
}
