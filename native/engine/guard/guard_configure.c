/* SPDX-License-Identifier: Apache-2.0
 *
 * What a guard is told to do, at its start and while it runs.
 */
#include <errno.h>
#include <sys/eventfd.h>

#include "guard.h"

#define FREEZE_DEADLINE_NS (50 * NS_PER_MS)

int guard_check_config(const struct avc_config *config, struct avc_error *err)
{
	if (config->keep < 1 || config->keep > AVC_KEEP_MAX)
		return fail(err, AVC_CONFIG, EINVAL, 0, "configure guard", "",
			    "keep must be 1 to %d", AVC_KEEP_MAX);
	if (config->restore_max > RESTORES_MAX)
		return fail(err, AVC_CONFIG, EINVAL, 0, "configure guard", "",
			    "restore_max must be at most %d", RESTORES_MAX);
	return 0;
}

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
	guard->target.shm_bytes = config->shm_bytes;
	/* A generation whose bytes were not counted has none: its connections all moved. */
	guard->target.tcp_messages = config->tcp == AVC_TCP_MESSAGES;
	guard->target.tcp_moved = config->tcp == AVC_TCP_RESET_MOVED ||
				  config->tcp == AVC_TCP_MESSAGES;
}

/* What is held stays, unless there are more than are wanted now.  A death that comes
 * next is judged by the new settings. */
void guard_take_config(struct avc_guard *guard)
{
	const uint32_t keep = guard->config.keep;
	struct avc_config config;
	uint64_t next;
	bool waiting;

	pthread_mutex_lock(&guard->lock);
	waiting = guard->config_waiting;
	config = guard->next_config;
	guard->config_waiting = false;
	pthread_mutex_unlock(&guard->lock);
	if (!waiting)
		return;
	guard_set_config(guard, &config);
	/* Who gave generations up because memory is short goes on without them. */
	if (guard->room == keep || guard->room > config.keep)
		guard->room = config.keep;
	while (guard->count > guard->room)
		guard_drop_generation(guard, guard_dispensable(guard, false));
	if (!guard->attached)
		return;
	next = guard_interval_end(guard);
	if (next < guard->next_ns || !config.interval_ns)
		guard->next_ns = next;
}

int avc_guard_configure(struct avc_guard *guard, const struct avc_config *config,
			struct avc_error *err)
{
	int result = 0;

	*err = (struct avc_error){ 0 };
	if (guard_check_config(config, err))
		return -1;
	pthread_mutex_lock(&guard->lock);
	if (guard->ended) {
		result = fail(err, AVC_GONE, ESRCH, 0, "configure guard", "",
			      "the container has ended");
	} else {
		guard->next_config = *config;
		guard->config_waiting = true;
	}
	pthread_mutex_unlock(&guard->lock);
	if (!result)
		eventfd_write(guard->wake_fd, 1);
	return result;
}
