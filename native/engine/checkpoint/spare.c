/* SPDX-License-Identifier: Apache-2.0
 *
 * A fork of a template, made while the app runs.  The longest part of a restore is the kernel's
 * copying of page tables.  With a spare they are already copied: the process that takes the app's
 * place is cloned with the spare's memory (clone(2), CLONE_VM), and owns it alone when the spare
 * has exited.  The template keeps its own, for the next time.
 */
#include <errno.h>
#include <sched.h>
#include <signal.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "checkpoint.h"

/* struct sched_attr, sched_setattr(2) */
static uint32_t policy_of(const struct scheduling *s)
{
	uint32_t policy;

	memcpy(&policy, s->attr + 4, sizeof policy);
	return policy;
}

/* What is made in advance must not hinder the app: not on a CPU that it has chosen (each thread
 * sets its affinity again, set_up() in parasite.c), and not at its priority. */
static bool step_aside(pid_t template, struct scheduling *was)
{
	const struct sched_param none = { 0 };
	unsigned long all[1024 / (8 * sizeof(unsigned long))];

	memset(all, 0xff, sizeof all);
	(void)syscall(SYS_sched_setaffinity, template, sizeof all, all);
	attributes_read_scheduling(template, was);
	return (policy_of(was) == SCHED_FIFO || policy_of(was) == SCHED_RR) &&
	       sched_setscheduler(template, SCHED_OTHER, &none) == 0;
}

static int step_back(pid_t pid, const struct scheduling *was)
{
	return (int)syscall(SYS_sched_setattr, pid, was->attr, 0);
}

static const struct parasite *parasite_of(const struct generation *generation)
{
	return &generation->image[0].process->parasite;
}

static struct inj_call *call_of(const struct generation *generation)
{
	return &parasite_slot(parasite_of(generation), generation->image[0].slot)->template_call;
}

static int begin_fork(struct generation *generation, struct avc_error *err)
{
	const struct parasite *parasite = parasite_of(generation);
	struct inj_call *call = call_of(generation);

	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_clone, CLONE_FILES | CLONE_PARENT | SIGCHLD);
	if (parasite_send(parasite, generation->image[0].template, &generation->image[0].base, call,
			  err) ||
	    parasite_start(generation->image[0].template, err))
		return -1;
	generation->spare.work = SPARE_FORK;
	return 0;
}

static int end_fork(struct generation *generation, struct avc_error *err)
{
	struct spare *spare = &generation->spare;

	if (parasite_await_clone(generation->image[0].template, call_of(generation), &spare->pid,
				 err)) {
		generation->image[0].process->lost |= err->code != AVC_LIMIT &&
						      err->code != AVC_DEADLINE;
		return -1;
	}
	if (!tracee_is_ours(spare->pid)) {
		/* The template was killed before it could report the spare, or
		 * init_channel_kill_lost() did not know it. */
		spare->pid = 0;
		generation->image[0].process->lost = true;
	}
	spare->pidfd = proc_pidfd_open(spare->pid);
	spare->base = generation->image[0].base;
	spare->work = SPARE_REST;
	return 0;
}

static bool name_spare(const struct generation *generation, const char *name)
{
	const struct parasite *parasite = parasite_of(generation);
	struct inj_call *call = call_of(generation);
	const pid_t spare = generation->spare.pid;
	struct avc_error gone = { 0 };

	memcpy(call->out, name, strlen(name) + 1);
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, SYS_prctl, PR_SET_NAME, parasite_remote(parasite, call->out));
	return parasite_send(parasite, spare, &generation->spare.base, call, &gone) == 0 &&
	       parasite_run(spare, call, &gone) == 0;
}

/* In its first stop. */
static bool introduce(const struct generation *generation)
{
	struct avc_error gone = { 0 };

	return generation->spare.pidfd >= 0 &&
	       tracee_await(generation->spare.pid, NULL, &gone) == STOP_TRAP &&
	       name_spare(generation, "avckpt-spare");
}

static int make(struct generation *generation, bool aside, struct avc_error *err)
{
	generation->spare.tried = true;
	generation->spare.aside = aside;
	return begin_fork(generation, err) || spare_await(generation, err) ? -1 : 0;
}

int spare_make(struct generation *generation, struct avc_error *err)
{
	struct spare *spare = &generation->spare;

	if (make(generation, step_aside(generation->image[0].template, &spare->scheduling), err) ==
	    0)
		return 0;
	/* A frozen cgroup, or busy CPUs; spare_await() continues. */
	return err->code == AVC_DEADLINE && spare->work ? 0 : -1;
}

int spare_make_now(struct generation *generation, struct avc_error *err)
{
	return make(generation, false, err);
}

int spare_await(struct generation *generation, struct avc_error *err)
{
	struct spare *spare = &generation->spare;
	struct avc_error refused = { 0 };

	if (!spare->work)
		return 0;
	if (spare->work == SPARE_FORK && end_fork(generation, &refused) &&
	    refused.code != AVC_LIMIT) {
		*err = refused;
		return -1;
	}
	if (spare->work == SPARE_REST && tracee_halt(generation->image[0].template, err))
		return -1;
	spare->work = SPARE_NO_WORK;
	if (spare->pid &&
	    (!introduce(generation) || (spare->aside && step_back(spare->pid, &spare->scheduling))))
		spare_drop(generation);
	if (spare->aside && step_back(generation->image[0].template, &spare->scheduling))
		return fail_errno(err, generation->image[0].template, "make spare", "sched_setattr",
				  "its scheduling cannot be put back");
	return 0;
}

bool spare_is_there(struct generation *generation)
{
	if (generation->spare.pid && pidfd_ended(generation->spare.pidfd))
		spare_drop(generation);
	return generation->spare.pid != 0;
}

bool spare_becomes_template(struct generation *generation)
{
	if (!spare_is_there(generation) || generation->spare.work)
		return false;
	if (name_spare(generation, "avckpt-tmpl"))
		return true;
	spare_drop(generation);
	return false;
}

bool spare_is_unknown(const struct generation *generation)
{
	return generation->spare.work == SPARE_FORK;
}

void spare_drop(struct generation *generation)
{
	if (generation->spare.pid)
		tracee_end(generation->spare.pid, generation->spare.pidfd);
	generation->spare.pid = 0;
	generation->spare.pidfd = -1;
}
