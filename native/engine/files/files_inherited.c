/* SPDX-License-Identifier: Apache-2.0
 *
 * Reads what a child shares with its parent: only what belongs to the table itself, and of heirs
 * (files_heirs.c) not even that, until the app runs again.
 */
#include <linux/kcmp.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "files_look.h"

/* A child shares most descriptors with its parent: then only what belongs to the table itself is
 * left to read. */
static bool is_parents(const struct look *look, const struct file *is)
{
	return syscall(SYS_kcmp, look->pid, look->files->parent_pid, KCMP_FILE, is->fd, is->fd) ==
	       0;
}

/* Everything but what has an owner. */
static void copy_of(struct file *f, const struct file *is)
{
	*f = *is;
	f->name = NULL;
	f->socket = NULL;
	f->watch = NULL;
	f->mark = NULL;
	f->lock = NULL;
	f->content = NULL;
	f->flight = NULL;
	f->watch_count = f->mark_count = f->lock_count = f->content_bytes = f->flight_count = 0;
	f->ours = 0;
	f->shared = is->fd;
	f->family = NULL;
	f->inherited = is;
}

/* Only files have locks, each process its own. */
static bool has_no_lock(const struct look *look, const struct file *is)
{
	struct file own = { .fd = is->fd, .kind = is->kind, .told_flags = -1 };

	if (is->kind != FILE_REGULAR)
		return true;
	(void)file_read_info(look->pid, &own);
	free(own.lock);
	return own.told_flags >= 0 && !own.lock_count;
}

static bool is_unchanged(const struct file *k, const struct file *is)
{
	return files_same_object(k, is) && k->mode == is->mode;
}

/* It was its parent's before, which still has such a file there.  The checkpoint finds out whether it
 * is the same one, in any case.  But locks are asked for again. */
static bool was_parents(const struct look *look, const struct file *is)
{
	const struct file *k = look->reuses ? files_find(look->known, is->fd) : NULL;

	if (!look->known && is->fd < look->likely_count)
		return look->likely[is->fd] && is->kind != FILE_REGULAR;
	return k && k->heir && is->kind != FILE_REGULAR && is_unchanged(k, is);
}

static bool copy_before(const struct look *look, const struct file *is, struct file *f)
{
	size_t bytes;
	char *name;

	if (file_is_anonymous(is) || is->lock_count || !is->name)
		return false;
	if (was_parents(look, is))
		look->files->reused = true;
	else if (!is_parents(look, is) || !has_no_lock(look, is))
		return false;
	bytes = strlen(is->name) + 1;
	name = budget_take(bytes) ? malloc(bytes) : NULL;
	if (!name)
		return false;
	copy_of(f, is);
	f->name = memcpy(name, is->name, bytes);
	f->socket = is->socket;
	if (f->socket)
		file_socket_share(f->socket);
	return true;
}

/* For locks and watches there is more to read. */
static bool may_copy(const struct file *k, const struct file *is)
{
	return k && is && is->known && !k->remote && !k->lock_count && !is->lock_count &&
	       !is->watch_count && !is->mark_count && files_same_object(k, is) &&
	       !(is->kind == FILE_REGULAR && is->told_ino);
}

static bool take_over(const struct look *look, const struct file *is, struct file *f)
{
	copy_of(f, is);
	if (!look_take_known(look, f))
		return false;
	if (!f->socket) /* it was left to its parent's look */
		f->socket = file_socket_share(is->socket);
	return true;
}

static bool copy_frozen(const struct look *look, const struct file *is, struct file *f)
{
	const struct file *k = files_find(look->known, is->fd);

	return may_copy(k, is) && ((look->trusts && k->heir) || is_parents(look, is)) &&
	       take_over(look, is, f);
}

/* What belongs to the table matters as little as in a freeze; and a table of its own is rebuilt. */
static bool copy_now(const struct look *look, const struct file *is, struct file *f)
{
	if (!copy_frozen(look, is, f))
		return false;
	f->inherited = NULL;
	return true;
}

/* In a freeze an ancestor may have it, from whom the parent has it. */
static const struct file *find_parents(const struct files *files, int number)
{
	const struct file *is, *k;

	for (files = files->parent; files; files = files->parent) {
		is = files_find(files, number);
		k = is ? NULL : files_find(files->heirs, number);
		if (is || !k || !k->heir)
			return is;
	}
	return NULL;
}

bool look_at_inherited(const struct look *look, int number, struct file *f)
{
	const struct file *is = find_parents(look->files, number);

	if (!is || is->remote)
		return false;
	switch (look->depth) {
	case FILES_BEFORE:
		return copy_before(look, is, f);
	case FILES_FROZEN:
		return copy_frozen(look, is, f);
	default:
		return copy_now(look, is, f);
	}
}

/* ---- heirs -------------------------------------------------------------------------------- */

static int by_value(const void *a, const void *b)
{
	const int x = *(const int *)a, y = *(const int *)b;

	return (x > y) - (x < y);
}

static void add_varied(struct files *files, const struct file *k)
{
	if (!may_copy(k, files_find(files, k->fd)) || !is_unchanged(k, files_find(files, k->fd)))
		files->varied[files->varied_count++] = k->fd;
}

/* Its children's heirs are like `known`, for each of which this is done once, and not once for each
 * child. */
void files_note_varied(struct files *files, const struct files *known)
{
	const struct files *parent = files->heirs ? files->parent : NULL;
	uint32_t room = 1 + known->count + (parent ? parent->varied_count : 0);

	files->varied = budget_take(room * sizeof(int)) ? malloc(room * sizeof(int)) : NULL;
	if (!files->varied)
		return;
	if (!parent)
		for (uint32_t i = 0; i < known->count; i++)
			add_varied(files, &known->file[i]);
	for (uint32_t i = 0; parent && i < known->own_count; i++)
		add_varied(files, &known->file[known->own[i]]);
	for (uint32_t i = 0; parent && i < parent->varied_count; i++) {
		const struct file *k = files_find(known, parent->varied[i]);

		if (k && k->heir)
			files->varied[files->varied_count++] = k->fd;
	}
	qsort(files->varied, files->varied_count, sizeof *files->varied, by_value);
	files->varied_known = true;
}

bool look_may_leave_heirs(const struct look *look)
{
	const struct files *files = look->files, *parent = files->parent, *known = look->known;

	if (!look->trusts || !parent || !parent->varied_known ||
	    known->parent_number != parent->process->files_before->number)
		return false;
	for (uint32_t i = 0; i < known->own_count; i++) {
		const struct file *f = &files->file[known->own[i]];

		if (f->shared != f->fd &&
		    syscall(SYS_kcmp, look->pid, look->pid, KCMP_FILE, f->fd, f->shared))
			return false;
	}
	return true;
}

/* Closes the gaps between its own and `at`, both by index and ascending. */
static void keep_looked_at(struct look *look, const uint32_t *at, uint32_t count)
{
	const struct files *known = look->known;
	struct files *files = look->files;

	files->count = 0;
	for (uint32_t own = 0, other = 0; own < known->own_count || other < count;) {
		const bool is_own = other == count ||
				    (own < known->own_count && known->own[own] < at[other]);
		const uint32_t i = is_own ? known->own[own++] : at[other++];

		if (files->file[i].fd >= 0)
			files->file[files->count++] = files->file[i];
	}
}

/* There may be as many as processes times the descriptors of the first: so they are written down when
 * the app runs again (files_fill_heirs()), except for what has to be read. */
int look_leave_heirs(struct look *look, struct avc_error *err)
{
	struct files *files = look->files, *known = look->known;
	const struct files *parent = files->parent;
	uint32_t *at = calloc(parent->varied_count + 1, sizeof *at), count = 0;
	bool ignored;
	int result = 0;

	if (!at)
		return fail_memory(err, look->pid, "freeze");
	for (uint32_t i = 0; !result && i < parent->varied_count; i++) {
		const struct file *k = files_find(known, parent->varied[i]);

		if (!k || !k->heir)
			continue;
		at[count++] = (uint32_t)(k - known->file);
		result = look_at_place(look, at[count - 1], &ignored, err);
	}
	keep_looked_at(look, at, result ? 0 : count);
	free(at);
	if (result)
		return -1;
	if (!budget_take((uint64_t)(known->count - files->count) * sizeof *files->file))
		return budget_check(look->pid, err);
	files->heirs = files_share(known);
	return 0;
}

/* The parent's are complete.  In place, from the last one: all others move up. */
static int fill_in(struct image *image, const struct files *parent, struct avc_error *err)
{
	struct files *files = image->files, *known = files->heirs;
	const struct look look = {
		.files = files, .known = known, .pid = image->process->pid, .depth = FILES_FROZEN
	};
	uint32_t left = files->count, at = left;
	int result = 0;

	for (uint32_t i = 0; i < known->count; i++)
		at += known->file[i].heir && !files_find(files, known->file[i].fd);
	files->count = at;
	for (uint32_t i = known->count; i > 0 && at > left; i--) {
		const struct file *k = &known->file[i - 1], *is = files_find(parent, k->fd);
		struct file *f;

		while (left && files->file[left - 1].fd > k->fd)
			files->file[--at] = files->file[--left];
		if (!k->heir || (left && files->file[left - 1].fd == k->fd))
			continue;
		f = &files->file[--at];
		if (is && take_over(&look, is, f))
			continue;
		*f = (struct file){ .fd = k->fd, .shared = k->fd, .offset = -1 };
		image->process->heirs_vary = true;
		result = fail(err, AVC_RETRY, 0, image->pid, "freeze", "",
			      "descriptor %d was changed meanwhile", k->fd);
	}
	files->heirs = NULL;
	files_free(known);
	free(files->ends);
	files->ends = NULL;
	files->end_count = 0;
	return result;
}

int files_fill_heirs(struct image *image, uint32_t images, struct avc_error *err)
{
	for (uint32_t i = 1; i < images; i++) {
		const struct files *parent = image[image[i].parent < 0 ? 0 : image[i].parent].files;
		struct files *files = image[i].files;

		if (!files_are_read(&image[i]))
			continue;
		if (files->heirs) {
			if (fill_in(&image[i], parent, err)) {
				files_note_young(image[0].process, image[i].process);
				return -1;
			}
			files_find_owners(image[i].process, files);
			files_find_own_pidfds(image[i].process, files);
		}
		for (uint32_t k = 0; k < files->count; k++) {
			struct file *f = &files->file[k];

			if (!f->inherited)
				continue;
			f->inherited = files_find(parent, f->fd); /* that was moved */
			if (file_may_have_content(f))
				file_copy_content(parent, f);
		}
	}
	return 0;
}
