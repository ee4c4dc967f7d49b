/* SPDX-License-Identifier: Apache-2.0
 *
 * Where the first injected instructions fit: a *stub*, in the zero padding behind an executable
 * mapping, usually the vDSO.
 *
 * Stubs and parasites of guards that died are found in the same survey, because a thread may still be
 * in one of them, or have to return to it.
 */
#include <errno.h>
#include <string.h>
#include <unistd.h>

#include "infect.h"

/* At the end of a page: what is in it is aligned. */
#define CAVE_BYTES ((ARCH_STUB_BYTES + 255) & ~255)
#define CAVES 4 /* so many stubs of guards that died are left as they are      */

/* True if the last bytes of the mapping are a stub that a dead guard has left. */
static bool has_stub(int mem_fd, avc_remote end)
{
	uint8_t bytes[CAVE_BYTES];

	return pread(mem_fd, bytes, sizeof bytes, (off_t)(end - sizeof bytes)) == sizeof bytes &&
	       arch_is_stub(bytes);
}

/* True if the last bytes of the mapping are zero padding. */
static bool has_cave(int mem_fd, avc_remote end)
{
	uint8_t bytes[CAVE_BYTES];

	if (pread(mem_fd, bytes, sizeof bytes, (off_t)(end - sizeof bytes)) != sizeof bytes)
		return false;
	for (size_t i = 0; i < sizeof bytes; i++)
		if (bytes[i])
			return false;
	return true;
}

/* The mapping of a guard that died before it wrote anything is recognized by its address. */
static void note_old_parasite(struct process *process, avc_remote base, avc_remote end)
{
	uint64_t magic;

	if (process->old_parasites == OLD_PARASITES_MAX || base == process->parasite.base ||
	    end - base < INJ_CODE_BYTES + sizeof(struct inj_control) ||
	    pread(process->mem_fd, &magic, sizeof magic,
		  (off_t)(base + INJ_CODE_BYTES + offsetof(struct inj_control, magic))) !=
		    sizeof magic ||
	    (magic != INJ_MAGIC && (magic || !porter_is_place(base))))
		return;
	process->old_parasite[process->old_parasites].base = base;
	process->old_parasite[process->old_parasites++].bytes = end - base;
}

struct survey {
	struct process *process;
	avc_remote pc, cave, start, end; /* start, end: of the parasite being scanned */
	bool in_stub, is_vdso;           /* is_vdso: the cave                             */
};

/* Of an existing parasite, or one that was being injected (porter.c). */
static bool is_of_parasite(const struct mapping *m)
{
	return !strcmp(m->name, PARASITE_MAPPED) || !strcmp(m->name, "/dev/zero (deleted)");
}

/* In a stub that is there already a task may still be, or a handler may return to it: a thread that
 * leaves it without us has its own signal mask there.  So it stays as it is, until process_drop_stubs(). */
static void survey_caves(struct survey *survey, const struct mapping *m)
{
	struct process *process = survey->process;
	const bool is_vdso = !strcmp(m->name, "[vdso]");
	avc_remote end = m->end;

	for (int i = 0; i < CAVES && end - m->start > CAVE_BYTES; i++, end -= CAVE_BYTES) {
		if (has_stub(process->mem_fd, end)) {
			survey->in_stub |= survey->pc < end && survey->pc >= end - CAVE_BYTES;
			process->stubs_start = end - CAVE_BYTES;
			process->stubs_end = m->end;
			continue;
		}
		if ((!survey->cave || (is_vdso && !survey->is_vdso)) &&
		    has_cave(process->mem_fd, end)) {
			survey->cave = end - CAVE_BYTES;
			survey->is_vdso = is_vdso;
		}
		return;
	}
}

static int survey_mapping(const struct mapping *m, void *arg)
{
	struct survey *survey = arg;
	struct process *process = survey->process;

	/* In adjacent pieces. */
	if (is_of_parasite(m)) {
		if (m->start != survey->end || porter_is_place(m->start)) {
			note_old_parasite(process, survey->start, survey->end);
			survey->start = m->start;
		}
		survey->end = m->end;
	}
	if (m->mode[0] == 'r' && m->mode[2] == 'x' && !m->shared)
		survey_caves(survey, m);
	return 0;
}

int cave_find(struct process *process, avc_remote pc, avc_remote *cave, struct avc_error *err)
{
	struct survey survey = { .process = process, .pc = pc };

	*cave = 0;
	process->stubs_start = process->stubs_end = 0;
	process->old_parasites = 0;
	if (proc_mappings(process->pid, "maps", survey_mapping, &survey))
		return fail_errno(err, process->pid, "infect", "read(maps)", "it has ended");
	note_old_parasite(process, survey.start, survey.end);
	*cave = survey.cave;
	if (!*cave && process->stubs_end) /* all are full: the one that has been so the longest */
		*cave = process->stubs_end - CAVE_BYTES;
	if (survey.in_stub || parasite_is_old(process, pc))
		return fail(err, AVC_DEADLINE, 0, process->pid, "infect", "",
			    "still on its way home from a guard that died");
	/* It has no memory any more. */
	if (!*cave && proc_is_exiting(process->pid))
		return fail(err, AVC_GONE, ESRCH, process->pid, "infect", "read(maps)",
			    "it has ended");
	if (!*cave)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "infect", "",
			    "there is no room for the first injected instructions");
	return 0;
}

int cave_write(const struct process *process, avc_remote cave, const uint8_t *stub, size_t bytes,
	       struct avc_error *err)
{
	if (pwrite(process->mem_fd, stub, bytes, (off_t)cave) == (ssize_t)bytes)
		return 0;
	return fail_errno(err, process->pid, "infect", "write(mem)", "its code cannot be written");
}

/* As before survey_caves(). */
int cave_erase(const struct process *process, avc_remote cave, size_t bytes)
{
	const uint8_t zero[CAVE_BYTES] = { 0 };

	return pwrite(process->mem_fd, zero, bytes, (off_t)cave) == (ssize_t)bytes ? 0 : -1;
}

void cave_keep(struct process *process, avc_remote stub)
{
	if (!process->stubs_end || stub < process->stubs_start)
		process->stubs_start = stub;
	if (stub + CAVE_BYTES > process->stubs_end)
		process->stubs_end = stub + CAVE_BYTES;
}

void process_drop_stubs(struct process *process)
{
	const uint8_t zero[CAVES * CAVE_BYTES] = { 0 };
	const size_t bytes = process->stubs_end - process->stubs_start;

	if (bytes <= sizeof zero)
		(void)pwrite(process->mem_fd, zero, bytes, (off_t)process->stubs_start);
	process->stubs_start = process->stubs_end = 0;
}
