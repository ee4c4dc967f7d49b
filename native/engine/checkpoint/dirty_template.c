/* SPDX-License-Identifier: Apache-2.0
 *
 * Only an idle template itself can change its mappings to those of the process.  New ones are
 * empty; their contents are copied, because they count as written (tracker.c).
 */
#include <errno.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>

#include "dirty.h"

#define LISTED_MAX (INJ_FILES_BYTES / 2 / sizeof(struct inj_syscall))
#define LAYOUT_TRIES 3 /* a heap grows in the first, and is protected in the second       */

struct template_calls template_calls_begin(const struct parasite *parasite,
					   struct idle_template *idle, uint32_t slot)
{
	return (struct template_calls){
		.parasite = parasite,
		.idle = idle,
		.slot = slot,
		.list = (struct inj_syscall *)(parasite_files(parasite, slot) +
					       INJ_FILES_BYTES / 2),
	};
}

static bool was_made(const struct inj_syscall *call)
{
	switch (call->nr) {
	case SYS_mmap:
	case SYS_brk:
		return call->result == (int64_t)call->arg[0];
	case SYS_times:
		return call->result >= 0 || call->result < -4095;
	default:
		return call->result == 0;
	}
}

int template_calls_end(struct template_calls *calls, struct avc_error *err)
{
	struct inj_call *call = &parasite_slot(calls->parasite, calls->slot)->template_call;
	const uint32_t count = calls->count;

	calls->count = 0;
	if (!count)
		return 0;
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, INJ_LIST, parasite_remote(calls->parasite, calls->list), count);
	if (parasite_send(calls->parasite, calls->idle->pid, &calls->idle->base, call, err) ||
	    parasite_run(calls->idle->pid, call, err))
		return -1;
	for (uint32_t i = 0; i < count; i++)
		if (!was_made(&calls->list[i]))
			return fail(err, AVC_RETRY, (int)-calls->list[i].result, calls->idle->pid,
				    "keep template", "", "call %ld was refused",
				    (long)calls->list[i].nr);
	return 0;
}

int template_call(struct template_calls *calls, const struct inj_syscall *call,
		  struct avc_error *err)
{
	if (calls->count == LISTED_MAX && template_calls_end(calls, err))
		return -1;
	calls->list[calls->count++] = *call;
	return 0;
}

/* ---- mappings -------------------------------------------------------------------------------- */

/* times(2) writes to the lowest page of the stack, so that the kernel grows it. */
static struct inj_syscall call_of(const struct layout_step *step)
{
	const uint64_t start = step->start, bytes = step->end - start;
	const uint64_t protection = (uint64_t)step->protection;

	switch (step->kind) {
	case LAYOUT_UNMAP:
		return (struct inj_syscall){ .nr = SYS_munmap, .arg = { start, bytes } };
	case LAYOUT_MAP:
		return (struct inj_syscall){ .nr = SYS_mmap,
					     .arg = { start, bytes, protection,
						      MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED,
						      UINT64_MAX, 0 } };
	case LAYOUT_PROTECT:
		return (struct inj_syscall){ .nr = SYS_mprotect,
					     .arg = { start, bytes, protection } };
	case LAYOUT_SHRINK:
		return (struct inj_syscall){ .nr = SYS_brk, .arg = { start } };
	case LAYOUT_GROW:
		return (struct inj_syscall){ .nr = SYS_brk, .arg = { step->end } };
	case LAYOUT_STACK:
		break;
	}
	return (struct inj_syscall){ .nr = SYS_times, .arg = { start } };
}

static int take_steps(struct template_calls *calls, const struct layout_steps *steps,
		      struct avc_error *err)
{
	/* Contents of memory that is unmapped are in no set. */
	calls->idle->near = 0;
	for (uint32_t i = 0; i < steps->count; i++) {
		const struct layout_step *step = &steps->step[i];
		const struct inj_syscall call = call_of(step);

		/* Unknown: these only reach the end of a page. */
		if (step->kind == LAYOUT_SHRINK || step->kind == LAYOUT_GROW)
			calls->idle->inherited->value[INHERITED_BREAK] = 0;
		if (template_call(calls, &call, err))
			return -1;
	}
	return template_calls_end(calls, err);
}

int template_follow_layout(struct template_calls *calls, char *layout, struct avc_error *err)
{
	struct layout_steps steps = { 0 };
	char *theirs = NULL;
	size_t bytes = 0;
	int result = 1;

	for (int tries = 0; result > 0; tries++) {
		if (!layout_read(calls->idle->pid, &theirs, &bytes)) {
			result = fail(err, AVC_RETRY, 0, calls->idle->pid, "keep template",
				      "read(maps)", "it was killed");
		} else if (layout_equal(layout, theirs)) {
			result = 0;
		} else if (tries == LAYOUT_TRIES || !layout_steps_find(theirs, layout, &steps)) {
			result = fail(err, AVC_RETRY, 0, calls->idle->pid, "keep template", "",
				      "its mappings have changed");
		} else if (take_steps(calls, &steps, err)) {
			result = -1;
		}
	}
	free(steps.step);
	free(theirs);
	return result;
}

int template_set_break(struct template_calls *calls, int64_t end, struct avc_error *err)
{
	const struct inj_syscall call = { .nr = SYS_brk, .arg = { (uint64_t)end } };

	if (calls->idle->inherited->value[INHERITED_BREAK] == end)
		return 0;
	if (template_call(calls, &call, err) || template_calls_end(calls, err))
		return -1;
	calls->idle->inherited->value[INHERITED_BREAK] = end;
	return 0;
}
