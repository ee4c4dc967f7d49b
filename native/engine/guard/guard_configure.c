/* SPDX-License-Identifier: Apache-2.0
 *
 * A guard's settings, at its start and while it runs.
 */
#include "guard.h"

#define FREEZE_DEADLINE_NS (50 * NS_PER_MS)

void guard_set_config(struct avc_guard *guard, const struct avc_config *config)
{
	guard->config = *config;
	if (!guard->config.freeze_deadline_ns)
		guard->config.freeze_deadline_ns = FREEZE_DEADLINE_NS;
	guard->main.shm_bytes = config->shm_bytes;
	/* In generations taken without byte counts, all connections count as moved. */
	guard->main.tcp_messages = config->tcp == AVC_TCP_MESSAGES;
	guard->main.tcp_moved = config->tcp == AVC_TCP_RESET_MOVED ||
				config->tcp == AVC_TCP_MESSAGES || config->together;
}

/* The next death is already judged by the new settings. */
void guard_take_config(struct avc_guard *guard, const struct avc_config *config)
{
	const uint32_t keep = guard->config.keep;
	const uint8_t suspends = guard->config.suspends;
	const uint64_t tasks_max = guard->config.tasks_max,
		       memory = guard->config.memory_limit_bytes;

	guard_set_config(guard, config);
	guard->config.suspends = suspends;
	policy_resize(&guard->policy, keep, config->keep);
	while (guard->count > guard->policy.room)
		guard_drop_generation(guard, policy_dispensable(&guard->policy));
	guard_rank_generations(guard);
	/* It may not have to be refused any more, and there may be room for spares. */
	if (config->tasks_max != tasks_max) {
		policy_retry(&guard->policy);
		policy_roomier(&guard->policy);
	}
	/* 0, too: it says no more than that the limit is not where memory runs out. */
	if (memory && config->memory_limit_bytes > memory)
		policy_roomier(&guard->policy);
	if (guard->attached)
		guard->next_ns = policy_due_again(config, guard->next_ns, now_ns());
}
