/* SPDX-License-Identifier: Apache-2.0
 *
 * Parses files of /proc, see proc(5).
 *
 * The kernel writes them, but the application controls names, paths and lengths in them: nothing
 * here assumes the end of a line, a field or its length (tests/fuzz).
 */
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>

#include "base.h"

static int not_understood(void)
{
	errno = EPROTO;
	return -1;
}

int proc_parse_stat(const char *text, struct proc_stat *stat)
{
	const char *name = strchr(text, '('), *last = strrchr(text, ' '), *p;
	int tty;
	unsigned long long faults, start;

	/* The name may hold anything, also ") R": the last ')' ends it. */
	p = strrchr(text, ')');
	if (!name || !last || !p || p < name ||
	    sscanf(p + 1,
		   " %c %d %d %d %d %d %u %llu %*u %*u %*u %*u %*u %*d %*d %*d %*d %d %*d %llu"
		   " %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %*s %d %u",
		   &stat->state, &stat->parent, &stat->group, &stat->session, &tty,
		   &stat->tty_group, &stat->flags, &faults, &stat->threads, &start,
		   &stat->exit_signal, &stat->cpu) != 12)
		return not_understood();
	stat->tty = (uint32_t)tty;
	stat->faults = faults;
	stat->start = start;
	stat->exit_status = atoi(last + 1);
	snprintf(stat->name, sizeof stat->name, "%.*s", (int)(p - name - 1), name + 1);
	return 0;
}

int proc_parse_statm(const char *text, long *pages, long *anonymous)
{
	long resident, of_files;

	if (sscanf(text, "%ld %ld %ld", pages, &resident, &of_files) != 3 || *pages < 0 ||
	    resident < 0 || of_files < 0)
		return not_understood();
	*anonymous = resident - of_files;
	return 0;
}

int proc_parse_sched(const char *text, struct proc_sched *sched)
{
	/* The name comes first, unescaped, line feeds included: too short to contain both a line
	 * feed and a key. */
	const char *rest = strstr(text, "\n------"), *ran, *sleeps, *migrations, *counted;
	unsigned long long ms, ns, counted_ns;

	if (!rest)
		return not_understood();
	ran = strstr(rest, "\nse.exec_start");
	sleeps = strstr(rest, "\nnr_voluntary_switches");
	migrations = strstr(rest, "\nse.nr_migrations");
	if (!ran || !sleeps || !migrations || sscanf(ran, " %*s : %llu.%6llu", &ms, &ns) != 2 ||
	    sscanf(sleeps, " %*s : %lu", &sched->sleeps) != 1 ||
	    sscanf(migrations, " %*s : %lu", &sched->migrations) != 1)
		return not_understood();
	sched->ran_ns = ms * NS_PER_MS + ns;
	counted = strstr(rest, "\nse.avg.last_update_time");
	if (counted && sscanf(counted, " %*s : %llu", &counted_ns) == 1 &&
	    counted_ns > sched->ran_ns)
		sched->ran_ns = counted_ns;
	return 0;
}

int proc_parse_children(const char *text, pid_t *children, int max)
{
	int count = 0;

	while (count < max) {
		char *next;
		const long child = strtol(text, &next, 10);

		if (next == text)
			break;
		children[count++] = (pid_t)child;
		text = next;
	}
	return count;
}

/* ---- maps, smaps ---------------------------------------------------------------- */

static const struct {
	char name[3];
	enum mapping_flag flag;
} mapping_flags[] = {
	{ "dc", MAPPING_DONTFORK },  { "wf", MAPPING_WIPEONFORK }, { "io", MAPPING_DEVICE },
	{ "lo", MAPPING_LOCKED },    { "dp", MAPPING_DROPPABLE },  { "ht", MAPPING_HUGETLB },
	{ "hg", MAPPING_HUGE },      { "nh", MAPPING_SMALL },      { "dd", MAPPING_DONTDUMP },
	{ "mg", MAPPING_MERGEABLE }, { "gd", MAPPING_GROWING },    { "sl", MAPPING_SEALED },
	{ "de", MAPPING_FIXED },     { "pf", MAPPING_FIXED },      { "mm", MAPPING_FIXED },
	{ "mt", MAPPING_TAGGED },
};

/* " rd wr mr mw me ac " */
static uint32_t parse_flags(const char *p)
{
	uint32_t flags = 0;

	for (; p[0] == ' ' && p[1] && p[2]; p += 3)
		for (size_t i = 0; i < sizeof mapping_flags / sizeof *mapping_flags; i++)
			if (!strncmp(p + 1, mapping_flags[i].name, 2))
				flags |= mapping_flags[i].flag;
	return flags;
}

static bool parse_mapping(const char *line, struct mapping *m)
{
	unsigned long major, minor;
	size_t length;
	char *p;

	*m = (struct mapping){ 0 };
	m->start = strtoul(line, &p, 16);
	if (p == line || *p != '-')
		return false;
	m->end = strtoul(p + 1, &p, 16);
	if (*p != ' ' || strcspn(p + 1, " \n") != 4)
		return false;
	memcpy(m->mode, p + 1, 4);
	m->shared = m->mode[3] == 's';
	m->offset = strtoul(p + 5, &p, 16);
	major = strtoul(p, &p, 16);
	if (*p != ':')
		return false;
	minor = strtoul(p + 1, &p, 16);
	m->device = device_number((unsigned int)major, (unsigned int)minor);
	m->inode = strtoul(p, &p, 10);
	p += strspn(p, " ");
	length = strcspn(p, "\n");
	memcpy(m->name, p, length < sizeof m->name ? length : sizeof m->name - 1);
	return true;
}

int proc_parse_mappings(FILE *text, bool smaps, int (*fn)(const struct mapping *mapping, void *arg),
			void *arg)
{
	struct mapping m = { 0 };
	bool known = false; /* smaps: the lines belong to m */
	char *line = NULL;
	size_t size = 0;
	int result = 0;

	while (!result && getline(&line, &size, text) > 0) {
		heartbeat();
		if (smaps && !strncmp(line, "ProtectionKey:", 14)) {
			m.flags = (uint32_t)strtoul(line + 14, NULL, 10) * MAPPING_KEY_ONE &
				  MAPPING_KEYS;
		} else if (smaps && !strncmp(line, "VmFlags:", 8)) {
			m.flags |= parse_flags(line + 8);
			if (known)
				result = fn(&m, arg);
			known = false;
		} else if (!smaps || !(line[0] >= 'A' && line[0] <= 'Z')) {
			known = parse_mapping(line, &m);
			if (known && !smaps)
				result = fn(&m, arg);
		}
	}
	if (ferror(text))
		result = -1;
	free(line);
	return result < 0 ? -1 : 0;
}

int mapping_protection(const struct mapping *m)
{
	return (m->mode[0] == 'r' ? PROT_READ : 0) | (m->mode[1] == 'w' ? PROT_WRITE : 0) |
	       (m->mode[2] == 'x' ? PROT_EXEC : 0);
}

bool mapping_is_special(const struct mapping *m)
{
	return !strncmp(m->name, "[vdso", 5) || !strncmp(m->name, "[vvar", 5);
}

/* ---- status ---------------------------------------------------------------------- */

/* Those that every process has, a zombie too. */
enum {
	HAS_INSIDE = 1,
	HAS_TRACER = 2,
	HAS_CAUGHT = 4,
	HAS_IGNORED = 8,
	HAS_UID = 16,
	HAS_GID = 32,
	HAS_CAPS = 64, /* and those after it */
	HAS_ALL = 64 * 32 - 1
};

static bool parse_ids(const char *p, uint32_t id[4])
{
	return sscanf(p, "%u %u %u %u", &id[0], &id[1], &id[2], &id[3]) == 4;
}

static void parse_groups(const char *p, struct proc_status *status)
{
	char *next;

	while (status->group_count < STATUS_GROUPS) {
		const unsigned long group = strtoul(p, &next, 10);

		if (next == p)
			return;
		status->groups[status->group_count++] = (uint32_t)group;
		p = next;
	}
}

/* Which of the above the line has. */
static uint32_t parse_status_line(const char *line, size_t length, struct proc_status *status)
{
	static const char *const caps[STATUS_CAPS] = { "CapInh:", "CapPrm:", "CapEff:", "CapBnd:",
						       "CapAmb:" };
	const char *value = memchr(line, '\t', length), *last;

	if (!value)
		return 0;
	last = memrchr(line, '\t', length);
	if (!strncmp(line, "NSpid:", 6)) {
		status->inside = atoi(last + 1);
		return HAS_INSIDE;
	}
	if (!strncmp(line, "NSpgid:", 7))
		status->group = atoi(last + 1);
	if (!strncmp(line, "NSsid:", 6))
		status->session = atoi(last + 1);
	if (!strncmp(line, "TracerPid:", 10)) {
		status->tracer = atoi(value);
		return HAS_TRACER;
	}
	if (!strncmp(line, "SigCgt:", 7)) {
		status->caught = strtoull(value, NULL, 16);
		return HAS_CAUGHT;
	}
	if (!strncmp(line, "SigIgn:", 7)) {
		status->ignored = strtoull(value, NULL, 16);
		return HAS_IGNORED;
	}
	if (!strncmp(line, "Uid:", 4))
		return parse_ids(value, status->uid) ? HAS_UID : 0;
	if (!strncmp(line, "Gid:", 4))
		return parse_ids(value, status->gid) ? HAS_GID : 0;
	for (int i = 0; i < STATUS_CAPS; i++)
		if (!strncmp(line, caps[i], 7)) {
			status->caps[i] = strtoull(value, NULL, 16);
			return (uint32_t)HAS_CAPS << i;
		}
	if (!strncmp(line, "SigPnd:", 7))
		status->pending = strtoull(value, NULL, 16);
	else if (!strncmp(line, "ShdPnd:", 7))
		status->shared_pending = strtoull(value, NULL, 16);
	else if (!strncmp(line, "SigBlk:", 7))
		status->blocked = strtoull(value, NULL, 16);
	else if (!strncmp(line, "VmLck:", 6))
		status->locked_kb = strtoll(value, NULL, 10);
	else if (!strncmp(line, "Groups:", 7) && !status->group_count)
		parse_groups(value, status);
	else if (!strncmp(line, "Umask:", 6))
		status->umask = (uint32_t)strtoul(value, NULL, 8);
	else if (!strncmp(line, "NoNewPrivs:", 11))
		status->no_new_privs = (uint32_t)atoi(value);
	else if (!strncmp(line, "x86_Thread_features:", 20))
		status->shadow_stack = memmem(value, length - (size_t)(value - line), "shstk", 5);
	else if (!strncmp(line, "Seccomp:", 8))
		status->seccomp = (uint32_t)atoi(value);
	else if (!strncmp(line, "Seccomp_filters:", 16))
		status->seccomp_filters = (uint32_t)atoi(value);
	return 0;
}

int proc_parse_status(const char *text, struct proc_status *status)
{
	uint32_t has = 0;

	*status = (struct proc_status){ .locked_kb = -1, .umask = 022 };
	while (*text) {
		const size_t length = strcspn(text, "\n");

		has |= parse_status_line(text, length, status);
		text += length + (text[length] == '\n');
	}
	/* Half of it would look like an application without capabilities or filters. */
	return has == HAS_ALL ? 0 : not_understood();
}

/* ---- limits ------------------------------------------------------------------------ */

#define LIMIT_NAME 26 /* columns: fs/proc/base.c, proc_pid_limits() */
#define LIMIT_VALUE 21

int proc_parse_limits(const char *text, uint64_t limit[LIMITS][2])
{
	for (int i = 0; i < LIMITS; i++) {
		text = strchr(text, '\n');
		if (!text || strcspn(++text, "\n") < LIMIT_NAME + LIMIT_VALUE)
			return not_understood();
		for (int k = 0; k < 2; k++) {
			const char *value = text + LIMIT_NAME + k * LIMIT_VALUE;

			limit[i][k] = *value == 'u' ? ~UINT64_C(0) : strtoull(value, NULL, 10);
		}
	}
	return 0;
}

/* ---- mountinfo ---------------------------------------------------------------------- */

static bool is_octal(const char *p)
{
	for (int i = 0; i < 3; i++)
		if (p[i] < '0' || p[i] > (i ? '7' : '3'))
			return false;
	return true;
}

void proc_unescape(char *text)
{
	char *to = text;

	for (const char *p = text; *p;) {
		if (*p == '\\' && is_octal(p + 1)) {
			*to++ = (char)((p[1] - '0') * 64 + (p[2] - '0') * 8 + (p[3] - '0'));
			p += 4;
		} else {
			*to++ = *p++;
		}
	}
	*to = 0;
}

bool proc_parse_mount(char *line, struct proc_mount *mount)
{
	char *const end = line + strcspn(line, "\n");
	char *rest = line, *id, *device, *word;

	*end = 0;
	id = strsep(&rest, " ");
	(void)strsep(&rest, " "); /* its parent's */
	device = strsep(&rest, " ");
	(void)strsep(&rest, " "); /* which part of the file system it is    */
	mount->point = strsep(&rest, " ");
	mount->options = strsep(&rest, " ");
	do
		word = strsep(&rest, " ");
	while (word && strcmp(word, "-"));
	mount->type = strsep(&rest, " ");
	(void)strsep(&rest, " "); /* what is mounted          */
	mount->details = rest ? rest : end;
	if (!mount->type || sscanf(device, "%u:%u", &mount->major, &mount->minor) != 2)
		return false;
	mount->id = strtoull(id, NULL, 10);
	proc_unescape(mount->point);
	return true;
}
