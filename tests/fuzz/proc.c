/* SPDX-License-Identifier: Apache-2.0
 *
 * The texts of /proc.  The first byte says which, the rest is the text.
 */
#include "base.h"
#include "fuzz.h"

static int look_at(const struct mapping *m, void *arg)
{
	unsigned int *count = arg;

	must(strlen(m->mode) == 4, "a mapping has a mode");
	must(strlen(m->name) < sizeof m->name, "its name is a string");
	(void)mapping_protection(m);
	(void)mapping_is_special(m);
	return ++*count > 1000 ? -1 : 0;
}

static void parse_mappings(const uint8_t *data, size_t size, bool smaps)
{
	FILE *text = size ? fmemopen((void *)data, size, "r") : NULL;
	unsigned int count = 0;

	if (!text)
		return;
	(void)proc_parse_mappings(text, smaps, look_at, &count);
	fclose(text);
}

static void parse_mount(char *line)
{
	const char *end = line + strlen(line);
	struct proc_mount mount;

	if (!proc_parse_mount(line, &mount))
		return;
	must(mount.point + strlen(mount.point) <= end && mount.options && mount.type,
	     "all of a mount's fields are in its line");
	proc_unescape(mount.details);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct proc_stat stat;
	struct proc_status status;
	struct proc_sched sched;
	uint64_t limit[LIMITS][2];
	pid_t children[16];
	long pages, anonymous;
	char *text;

	if (!size)
		return 0;
	text = text_of(data + 1, size - 1);
	switch (data[0]) {
	case 's':
		if (proc_parse_stat(text, &stat) == 0)
			must(strlen(stat.name) < sizeof stat.name, "a name is a string");
		break;
	case 'S':
		(void)proc_parse_status(text, &status);
		break;
	case 'r':
		(void)proc_parse_sched(text, &sched);
		break;
	case 'v':
		if (proc_parse_statm(text, &pages, &anonymous) == 0)
			must(pages >= 0, "there are not less than no pages");
		break;
	case 'l':
		(void)proc_parse_limits(text, limit);
		break;
	case 'c':
		must(proc_parse_children(text, children, 16) <= 16, "there is room for them");
		break;
	case 'm':
	case 'M':
		parse_mappings(data + 1, size - 1, data[0] == 'M');
		break;
	case 'i':
		parse_mount(text);
		break;
	}
	free(text);
	return 0;
}
