/* SPDX-License-Identifier: Apache-2.0
 *
 * Where to fork a restored process, so that it is in its session again.
 *
 * A process is in the session of the one that forked it, for good, unless it begins its own
 * (setsid(2)).  So one that is in another session than its parent was either forked before the
 * parent began its own, or descends from a process that is gone.  For the former, the parent gets a
 * *keeper* before it begins its session: a task that shares its memory, stays in the old session,
 * and clones children of the parent there (CLONE_PARENT). For the latter, a keeper temporarily
 * takes the PID of the leader that is gone, and begins the session again.
 */
#include <signal.h>
#include <stdlib.h>

#include "checkpoint.h"

static bool leads(const struct image *image)
{
	return image->session > 0 && image->session == image->inside;
}

/* -1: it is gone. */
static int leader_of(const struct generation *generation, pid_t session)
{
	for (uint32_t i = 0; i < generation->images; i++)
		if (generation->image[i].session == session && leads(&generation->image[i]))
			return (int)i;
	return -1;
}

/* One that is forked by the keeper of a session whose leader is gone; NULL: none yet. */
static const struct place *kept(const struct place *place, const struct generation *generation,
				pid_t session)
{
	for (uint32_t i = 1; i < generation->images; i++)
		if (place[i].renewed && place[i].born == session)
			return &place[i];
	return NULL;
}

static int refuse(const struct image *image, struct avc_error *err)
{
	return fail(
		err, AVC_UNSUPPORTED, 0, image->pid, "check", "",
		"process %d is in session %d, which its parent is not in, and could not come to "
		"be there again",
		image->inside, image->session);
}

/* Any process can temporarily be the parent of an orphan. */
static int place_orphan(const struct generation *generation, uint32_t i, struct place *place,
			struct avc_error *err)
{
	const pid_t born = place[i].born;
	const int leader = leader_of(generation, born);

	if (born == PLACE_ANY || born == generation->image[0].session)
		return 0;
	if (born <= 0)
		return refuse(&generation->image[i], err);
	if (leader >= 0)
		place[i].host = (uint32_t)leader;
	return 0;
}

static int place_child(const struct generation *generation, uint32_t i, struct place *place,
		       struct avc_error *err)
{
	const struct image *image = &generation->image[i];
	const uint32_t parent = place[i].host;
	const pid_t born = place[i].born;
	const struct place *other;

	if (born == PLACE_ANY || born == generation->image[parent].session)
		return 0;
	/* It inherits its exit signal from the keeper. */
	if (image->exit_signal != SIGCHLD)
		return refuse(image, err);
	if (parent && leads(&generation->image[parent]) &&
	    (place[parent].before == PLACE_ANY || place[parent].before == born)) {
		place[parent].before = born;
		return 0;
	}
	/* There can only be one process with that PID, and it has one parent. */
	other = kept(place, generation, born);
	if (born <= 0 || leader_of(generation, born) >= 0 || (other && other->host != parent))
		return refuse(image, err);
	place[i].renewed = true;
	return 0;
}

/* Orphans of a session whose leader is gone: by the keeper that is needed in any case, or by one of
 * the main process. */
static void place_renewed(const struct generation *generation, uint32_t i, struct place *place)
{
	const pid_t born = place[i].born;
	const struct place *other;

	if (generation->image[i].parent != PARENT_INIT || born <= 0 ||
	    born == generation->image[0].session || leader_of(generation, born) >= 0)
		return;
	other = kept(place, generation, born);
	place[i].host = other ? other->host : 0;
	place[i].renewed = true;
}

/* Children come after their parents. */
int places_find(const struct generation *generation, struct place *place, struct avc_error *err)
{
	for (uint32_t i = 0; i < generation->images; i++) {
		const int parent = generation->image[i].parent;

		place[i] = (struct place){ .host = i && parent != PARENT_INIT ? (uint32_t)parent
									      : 0,
					   .born = PLACE_ANY,
					   .before = PLACE_ANY };
	}
	for (uint32_t i = generation->images; i-- > 1;) {
		const struct image *image = &generation->image[i];

		place[i].born = leads(image) ? place[i].before : image->session;
		if (image->parent == PARENT_INIT ? place_orphan(generation, i, place, err)
						 : place_child(generation, i, place, err))
			return -1;
	}
	for (uint32_t i = 1; i < generation->images; i++)
		place_renewed(generation, i, place);
	for (uint32_t i = 1; i < generation->images; i++) {
		place[i].memory = place[i].host;
		while (!generation->image[place[i].memory].process)
			place[i].memory = place[place[i].memory].host;
	}
	return 0;
}
