/* SPDX-License-Identifier: Apache-2.0
 *
 * What templates may cost in memory, and the OOM killer's choice of victim.
 *
 * It kills the process with the most points: its resident pages, plus its oom_score_adj in
 * thousandths of the limit (mm/oom_kill.c, oom_badness()).
 *
 * - Older generations go first, the oldest before all others: 1000, or a little less.
 * - The newest one must survive an application that leaks until it is killed.  Without a limit it
 *   has the value of the application, which has more points, because it has grown since.
 * - With a limit it has as many points as the application has when it alone fills 95 % of the
 *   limit.  So the kernel kills an application that has leaked that much, and the template where
 *   the application would have room without it: it never dies because of its template.
 *
 * No template gets less than the application's own value: that would take CAP_SYS_RESOURCE.
 */
#include <fcntl.h>
#include <stdio.h>

#include "guard.h"

#define FIRST 1000
#define OWN_MAX (FIRST - 1)
#define STEP 2
/* In percent of the limit: above KILLED the app is killed; above FULL no checkpoint is taken. */
#define KILLED 95
#define FULL 90
/* What templates by copies may have of their own, in percent of the app (dirty.c): one copy of all
 * that it writes, and a part of each template's. */
#define COPIES 140
/* In percent of what the host has available, before there are any. */
#define HOSTS_SHARE 50

static void tell(struct image *image, int value)
{
	char text[16];

	if (!image->template)
		return;
	if (!image->oom_known)
		image->oom_own = image->oom_told = proc_oom_score_adj(image->template);
	image->oom_known = true;
	if (value < image->oom_own)
		value = image->oom_own;
	if (image->oom_told == value)
		return;
	image->oom_told = value;
	snprintf(text, sizeof text, "%d", value);
	proc_set_oom_score_adj(image->template, text);
}

/* The points of the smallest process, if it alone grew until all processes fill the limit. */
static long points_wanted(const struct generation *generation, long limit)
{
	long least = generation->image[0].anon_pages, others = 0;

	for (uint32_t i = 0; i < generation->images; i++) {
		const struct image *image = &generation->image[i];

		if (!image->template)
			continue;
		others += image->anon_pages;
		if (image->anon_pages < least)
			least = image->anon_pages;
	}
	return limit * KILLED / 100 - (others - least);
}

static void rank_newest(struct generation *newest, long limit)
{
	const long points = limit ? points_wanted(newest, limit) : 0;

	for (uint32_t i = 0; i < newest->images; i++) {
		struct image *image = &newest->image[i];
		long more = 0;

		if (!image->oom_known)
			tell(image, -FIRST); /* as it is */
		if (points > image->anon_pages)
			more = (points - image->anon_pages) * FIRST / limit;
		more += image->oom_own;
		tell(image, more > OWN_MAX ? OWN_MAX : (int)more);
	}
}

/* A newer one is larger if the app grows: its value makes up for that. */
static void rank_older(struct generation *older, uint32_t k, long oldest_pages, long limit)
{
	const long grown = older->image[0].anon_pages - oldest_pages;
	const long more = limit ? grown * FIRST / limit : 0;
	const long value = FIRST - STEP * (long)k - (more > 0 ? more : 0);

	for (uint32_t i = 0; i < older->images; i++)
		tell(&older->image[i], (int)value);
}

void guard_rank_generations(struct avc_guard *guard)
{
	const long limit = (long)(guard->config.memory_limit_bytes / ARCH_PAGE_BYTES);

	for (uint32_t k = 0; k + 1 < guard->count; k++)
		rank_older(&guard->generations[k], k, guard->generations[0].image[0].anon_pages,
			   limit);
	if (guard->count)
		rank_newest(&guard->generations[guard->count - 1], limit);
}

bool guard_app_is_full(const struct avc_guard *guard)
{
	const uint64_t limit = guard->config.memory_limit_bytes;
	long pages = 0, anon = 0;
	int fd;

	if (!limit || !guard->main.pid)
		return false;
	fd = proc_open(guard->main.leader, "statm", O_RDONLY);
	pages = fd < 0 ? 0 : proc_vm_pages(fd, &anon);
	close_fd(&fd);
	return pages && (uint64_t)anon * ARCH_PAGE_BYTES > limit / 100 * FULL;
}

/* ---- copies ------------------------------------------------------------------------ */

bool guard_has_room_for_copies(const struct avc_guard *guard)
{
	const struct generation *newest = guard->count ? &guard->generations[guard->count - 1]
						       : NULL;
	const long limit = (long)(guard->config.memory_limit_bytes / ARCH_PAGE_BYTES);
	long app = 0;

	/* Generations were given up because memory is short. */
	if (guard->policy.room < guard->config.keep)
		return false;
	if (!newest || guard->config.images != AVC_IMAGES_AUTO)
		return true;
	for (uint32_t i = 0; i < newest->images; i++)
		app += newest->image[i].anon_pages;
	/* No process is copied, or little of it: saves a look at the machine's memory. */
	if (app < DIRTY_SMALL_PAGES)
		return true;
	if (limit)
		return app * (100 + COPIES) <= limit * FULL;
	/* Those that exist are no longer available: the sidecar sees when memory becomes short. */
	return newest->image[0].recycled || app * COPIES <= proc_host_available() * HOSTS_SHARE;
}
