/* SPDX-License-Identifier: Apache-2.0
 *
 * Where a restored process is to be forked, so that it comes to stand where it stood.
 *
 * A process is in the session of the one that forked it, for good, unless it begins its own
 * (setsid(2)).  So one that is in another session than its parent was either there before that
 * one began its own, or comes of somebody who is gone.  For the former, the parent has a *keeper*
 * before it begins its session: a task that shares its memory, stays in the old session, and makes
 * children of it there (CLONE_PARENT).  For the latter, a keeper has the number of the leader that
 * is gone for a while, and begins the session anew.
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

/* Of an orphan anybody can be the parent for a moment. */
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
	/* It has its exit signal from the keeper. */
	if (image->exit_signal != SIGCHLD)
		return refuse(image, err);
	if (parent && leads(&generation->image[parent]) &&
	    (place[parent].before == PLACE_ANY || place[parent].before == born)) {
		place[parent].before = born;
		return 0;
	}
	/* There can be one with that number, and it is the child of one. */
	other = kept(place, generation, born);
	if (born <= 0 || leader_of(generation, born) >= 0 || (other && other->host != parent))
		return refuse(image, err);
	place[i].renewed = true;
	return 0;
}

/* Orphans of a session whose leader is gone: by the keeper that there has to be in any case, or by
 * one of the main process's. */
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
