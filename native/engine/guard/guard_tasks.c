/* SPDX-License-Identifier: Apache-2.0
 *
 * How many of its container's tasks may be ours.
 *
 * Templates, spare and holders count where tasks are limited (cgroup, pids.max), and clone(2) of the
 * app must not fail because of them.  So of what the app itself leaves free, a quarter stays free:
 * by so many it can grow until the next checkpoint, which makes way again.
 */
#include "guard.h"

#define PERCENT 75

/* What the app has, with init and a zombie of each process that has ended. */
static uint64_t of_app(const struct avc_guard *guard)
{
	uint64_t tasks = 1;

	for (uint32_t i = 0; i < guard->tree.count; i++) {
		const struct tree_entry *entry = &guard->tree.entry[i];

		tasks += entry->stat.threads > 1 ? (uint64_t)entry->stat.threads : 1;
	}
	return tasks;
}

static uint64_t spares(const struct avc_guard *guard)
{
	uint64_t tasks = 0;

	for (uint32_t i = 0; i < guard->count; i++)
		tasks += guard->generations[i].spare.pid != 0;
	return tasks;
}

static uint64_t held(const struct avc_guard *guard)
{
	uint64_t tasks = guard->remains_count + spares(guard);

	for (uint32_t i = 0; i < guard->tree.processes; i++)
		tasks += guard->tree.process[i]->holder != 0;
	for (uint32_t i = 0; i < guard->dirty.count; i++)
		tasks += guard->dirty.of[i]->idle.pid != 0;
	for (uint32_t i = 0; i < guard->count; i++) {
		const struct generation *generation = &guard->generations[i];

		for (uint32_t k = 0; k < generation->images; k++)
			tasks += generation->image[k].template != 0;
	}
	return tasks;
}

/* Of each process a holder and a template; and another one, where none is held yet: the newest is
 * kept until there is the next. */
static uint64_t needed(const struct avc_guard *guard)
{
	uint64_t tasks = 0;

	for (uint32_t i = 0; i < guard->tree.count; i++) {
		const struct process *process = guard->tree.entry[i].process;

		tasks += guard->count ? 1 : 2;
		tasks += !process || !process->holder;
	}
	return tasks;
}

/* Gives up what can be done without, so that no more than `most` are ours. */
static bool keep_to(struct avc_guard *guard, uint64_t most)
{
	const uint64_t more = needed(guard);

	if (held(guard) + more <= most)
		return true;
	dirty_drop_idle(&guard->dirty);
	guard_release_oldest_remains(guard, 0);
	for (uint32_t i = 0; i < guard->count; i++)
		spare_drop(&guard->generations[i]);
	while (guard->count > 1 && held(guard) + more > most)
		guard_drop_generation(guard, 0);
	guard_wait_ended(guard);
	return held(guard) + more <= most;
}

int guard_make_room_for_tasks(struct avc_guard *guard, struct avc_error *err)
{
	const uint64_t limit = guard->config.tasks_max, app = of_app(guard);
	const uint64_t most = limit > app ? (limit - app) * PERCENT / 100 : 0;

	guard->cramped = false;
	if (!limit)
		return 0;
	guard->cramped = held(guard) - spares(guard) + needed(guard) >= most;
	if (keep_to(guard, most))
		return 0;
	return fail(
		err, AVC_UNSUPPORTED, 0, guard->main.pid, "check", "",
		"its container may have %llu tasks (pids limit), of which it has %llu: the "
		"%llu that protection takes would leave less than a quarter of the others to it",
		(unsigned long long)limit, (unsigned long long)app,
		(unsigned long long)(held(guard) + needed(guard)));
}
