/* SPDX-License-Identifier: Apache-2.0
 *
 * Whether two processes have the same mappings.  A mapping that is watched (tracker.c) and what is
 * mapped beside it later are two to the kernel, and one in a process that is not watched.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "checkpoint.h"

#define STEP (64u << 10)

bool layout_read(pid_t pid, char **text, size_t *bytes)
{
	const int fd = proc_open(pid, "maps", O_RDONLY);
	size_t used = 0;
	ssize_t n = fd < 0 ? -1 : 0;

	while (fd >= 0) {
		if (*bytes - used < 2 && *bytes < PROC_TEXT_MAX) {
			char *more = realloc(*text, *bytes + STEP);

			if (!more) {
				n = -1;
				break;
			}
			*text = more;
			*bytes += STEP;
		}
		n = read(fd, *text + used, *bytes - used - 1);
		if (n <= 0)
			break;
		used += (size_t)n;
	}
	if (*text)
		(*text)[used] = 0;
	if (fd >= 0)
		close(fd);
	return n == 0 && used;
}

static bool continues(const struct mapping *last, const struct mapping *m)
{
	return last->end == m->start && !strcmp(last->mode, m->mode) && last->inode == m->inode &&
	       last->device == m->device && !strcmp(last->name, m->name) &&
	       (!m->inode || last->offset + (last->end - last->start) == m->offset);
}

static int add(const struct mapping *m, void *arg)
{
	struct mappings *maps = arg;

	if (maps->count && continues(&maps->map[maps->count - 1], m)) {
		maps->map[maps->count - 1].end = m->end;
		return 0;
	}
	if (!make_room(&maps->map, maps->count, &maps->room, sizeof *maps->map))
		return -1;
	maps->map[maps->count++] = *m;
	return 0;
}

static bool parse(char *text, struct mappings *maps)
{
	FILE *file = fmemopen(text, strlen(text), "r");
	const bool parsed = file && proc_parse_mappings(file, false, add, maps) == 0;

	if (file)
		fclose(file);
	return parsed;
}

static bool same(const struct mapping *a, const struct mapping *b)
{
	return a->start == b->start && a->end == b->end && !strcmp(a->mode, b->mode) &&
	       a->inode == b->inode && a->device == b->device && !strcmp(a->name, b->name) &&
	       (!a->inode || a->offset == b->offset);
}

bool layout_equal(char *a, char *b)
{
	struct mappings first = { 0 }, second = { 0 };
	bool equal;

	/* Of two that are watched in the same way, as a rule. */
	if (!strcmp(a, b))
		return true;
	equal = parse(a, &first) && parse(b, &second) && first.count == second.count;
	for (uint32_t i = 0; equal && i < first.count; i++)
		equal = same(&first.map[i], &second.map[i]);
	free(first.map);
	free(second.map);
	return equal;
}
