/* SPDX-License-Identifier: Apache-2.0
 *
 * Whether two processes have the same mappings, and the calls that make them equal.  A watched
 * mapping (tracker.c) and a later adjacent one are separate to the kernel, but merged in a process
 * that is not watched.
 */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "checkpoint.h"

#define STEP (64u << 10)
#define READ_TRIES 16

static bool read_once(pid_t pid, char **text, size_t *bytes)
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

/* Since Linux 6.17 (fs/proc/task_mmu.c) a file "maps" is read without the lock of the mappings: one
 * that a thread merges with the next one meanwhile is there twice, as it was and as it is. */
static bool is_torn(const char *text)
{
	unsigned long last_end = 0;

	for (const char *line = text; *line;) {
		char *rest;
		const unsigned long start = strtoul(line, &rest, 16);

		if (start < last_end || *rest != '-')
			return true;
		last_end = strtoul(rest + 1, NULL, 16);
		line = strchr(rest, '\n');
		if (!line)
			return true;
		line++;
	}
	return false;
}

bool layout_read(pid_t pid, char **text, size_t *bytes)
{
	for (int i = 0; i < READ_TRIES; i++) {
		if (!read_once(pid, text, bytes))
			return false;
		if (!is_torn(*text))
			return true;
	}
	return false;
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

	/* Usually both are watched in the same way. */
	if (!strcmp(a, b))
		return true;
	equal = parse(a, &first) && parse(b, &second) && first.count == second.count;
	for (uint32_t i = 0; equal && i < first.count; i++)
		equal = same(&first.map[i], &second.map[i]);
	free(first.map);
	free(second.map);
	return equal;
}

/* ---- from the one to the other --------------------------------------------------------------- */

#define STACK "[stack]"
#define HEAP "[heap]"

static bool is_heap(const struct mapping *m)
{
	return !strcmp(m->name, HEAP);
}

static bool is_plain(const struct mapping *m)
{
	return m->mode[3] == 'p' && !m->inode &&
	       (!m->name[0] || is_heap(m) || !strcmp(m->name, STACK));
}

static bool add_step(struct layout_steps *steps, enum layout_step_kind kind,
		     const struct stretch *where, int protection)
{
	struct layout_step *last = steps->count ? &steps->step[steps->count - 1] : NULL;

	if (last && last->kind == kind && last->end == where->start &&
	    last->protection == protection) {
		last->end = where->end;
		return true;
	}
	if (!make_room(&steps->step, steps->count, &steps->room, sizeof *steps->step))
		return false;
	steps->step[steps->count++] = (struct layout_step){ where->start, where->end, kind,
							    protection };
	return true;
}

static bool take_away(struct layout_steps *steps, const struct stretch *where,
		      const struct mapping *was)
{
	if (mapping_is_special(was))
		return false;
	return add_step(steps, is_heap(was) ? LAYOUT_SHRINK : LAYOUT_UNMAP, where, 0);
}

static bool bring(struct layout_steps *steps, const struct stretch *where,
		  const struct mapping *wanted)
{
	if (!is_plain(wanted))
		return false;
	if (is_heap(wanted))
		return add_step(steps, LAYOUT_GROW, where, 0);
	if (wanted->name[0])
		return add_step(steps, LAYOUT_STACK, where, 0);
	return add_step(steps, LAYOUT_MAP, where, mapping_protection(wanted));
}

static bool is_object(const struct mapping *a, const struct mapping *b)
{
	return a->mode[3] == b->mode[3] && a->inode == b->inode && a->device == b->device &&
	       !strcmp(a->name, b->name) &&
	       (!a->inode || a->offset - a->start == b->offset - b->start);
}

static bool change(struct layout_steps *steps, const struct stretch *where,
		   const struct mapping *was, const struct mapping *wanted)
{
	if (!wanted)
		return take_away(steps, where, was);
	if (!was)
		return bring(steps, where, wanted);
	if (!is_object(was, wanted))
		return take_away(steps, where, was) && bring(steps, where, wanted);
	if (!strcmp(was->mode, wanted->mode))
		return true;
	return wanted->mode[3] == 'p' && !mapping_is_special(wanted) &&
	       add_step(steps, LAYOUT_PROTECT, where, mapping_protection(wanted));
}

/* The first that does not end before `at`. */
static const struct mapping *find(const struct mappings *maps, uint32_t *next, avc_remote at)
{
	while (*next < maps->count && maps->map[*next].end <= at)
		++*next;
	return *next < maps->count ? &maps->map[*next] : NULL;
}

static void clip(avc_remote at, const struct mapping **m, avc_remote *end)
{
	const avc_remote border = !*m ? *end : (*m)->start > at ? (*m)->start : (*m)->end;

	if (border < *end)
		*end = border;
	if (*m && (*m)->start > at)
		*m = NULL;
}

bool layout_steps_find(char *is, char *want, struct layout_steps *steps)
{
	struct mappings first = { 0 }, second = { 0 };
	uint32_t i = 0, k = 0;
	bool found = parse(is, &first) && parse(want, &second);

	steps->count = 0;
	for (avc_remote at = 0, end; found; at = end) {
		const struct mapping *was = find(&first, &i, at), *wanted = find(&second, &k, at);

		if (!was && !wanted)
			break;
		end = UINT64_MAX;
		clip(at, &was, &end);
		clip(at, &wanted, &end);
		if (was || wanted)
			found = change(steps, &(struct stretch){ at, end }, was, wanted);
	}
	free(first.map);
	free(second.map);
	return found;
}
