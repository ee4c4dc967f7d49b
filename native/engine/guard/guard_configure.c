/* SPDX-License-Identifier: Apache-2.0
 *
 * What a guard is told to do, at its start and while it runs.
 */
#include "guard.h"

#define FREEZE_DEADLINE_NS (50 * NS_PER_MS)

uint64_t guard_interval_end(const struct avc_guard *guard)
{
	const uint64_t interval_ns = guard->config.interval_ns;

	return interval_ns ? now_ns() + interval_ns : UINT64_MAX;
}

void guard_set_config(struct avc_guard *guard, const struct avc_config *config)
{
	guard->config = *config;
	if (!guard->config.freeze_deadline_ns)
		guard->config.freeze_deadline_ns = FREEZE_DEADLINE_NS;
	guard->main.shm_bytes = config->shm_bytes;
	/* A generation whose bytes were not counted has none: its connections all moved. */
	guard->main.tcp_messages = config->tcp == AVC_TCP_MESSAGES;
	guard->main.tcp_moved = config->tcp == AVC_TCP_RESET_MOVED ||
				config->tcp == AVC_TCP_MESSAGES;
}

/* A death that comes next is judged by the new settings. */
void guard_take_config(struct avc_guard *guard, const struct avc_config *config)
{
	const uint32_t keep = guard->config.keep;
	uint64_t next;

	guard_set_config(guard, config);
	/* Who gave generations up because memory is short goes on without them. */
	if (guard->room == keep || guard->room > config->keep)
		guard->room = config->keep;
	while (guard->count > guard->room)
		guard_drop_generation(guard, guard_dispensable(guard, false));
	guard_rank_generations(guard);
	if (!guard->attached)
		return;
	next = guard_interval_end(guard);
	if (next < guard->next_ns || !config->interval_ns)
		guard->next_ns = next;
}
