/* SPDX-License-Identifier: Apache-2.0
 *
 * Where avckpt's parasite is in this process: for victims that do something to it.
 */
#ifndef PARASITE_PLACE_H
#define PARASITE_PLACE_H

#include "parasite.h"
#include "victim.h"

/* Parasites lie at multiples of 64 MB between these two (native/engine/process/porter.c). */
#define PLACES_START (UINT64_C(32) << 40)
#define PLACES_END (UINT64_C(64) << 40)
#define PLACES_DISTANCE (UINT64_C(64) << 20)

struct place {
	uint64_t start, bytes; /* 0: there is none yet */
};

static inline struct place find_parasite_of(const char *pid)
{
	struct place found = { 0, 0 };
	uint64_t start, end;
	char line[512], mode[5];
	FILE *maps;

	snprintf(line, sizeof(line), "/proc/%s/maps", pid);
	maps = fopen(line, "re");
	must(maps != NULL, line);
	while (fgets(line, sizeof(line), maps)) {
		if (sscanf(line, "%lx-%lx %4s", &start, &end, mode) != 3)
			continue;
		if (found.start && !found.bytes && !strcmp(mode, "rw-s"))
			found.bytes = end - found.start;
		if (!strcmp(mode, "r-xs") && start >= PLACES_START && start < PLACES_END &&
		    start % PLACES_DISTANCE == 0)
			found.start = start;
	}
	fclose(maps);
	return found;
}

static inline struct place find_parasite(void)
{
	return find_parasite_of("self");
}

static inline struct place await_parasite(void)
{
	struct place found;

	while (!(found = find_parasite()).bytes ||
	       ((struct inj_control *)(found.start + INJ_CODE_BYTES))->magic != INJ_MAGIC)
		usleep(1000);
	return found;
}

#endif
