/* SPDX-License-Identifier: Apache-2.0
 *
 * Which descriptors are of the same open file description (kcmp(2)).
 */
#include <fcntl.h>
#include <linux/kcmp.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "files_look.h"

static int compare_keys(const struct file *a, const struct file *b)
{
	if (a->dev != b->dev)
		return a->dev < b->dev ? -1 : 1;
	if (a->ino != b->ino)
		return a->ino < b->ino ? -1 : 1;
	if (a->kind != b->kind)
		return a->kind < b->kind ? -1 : 1;
	if (a->id != b->id)
		return a->id < b->id ? -1 : 1;
	return 0;
}

static int by_key(const void *a, const void *b)
{
	const struct files_held *x = a, *y = b;
	const int order = compare_keys(x->file, y->file);

	return order ? order : (x->number > y->number) - (x->number < y->number);
}

/* kcmp(2)'s order; -1: one of them has been closed since. */
static long compare_held(const struct files_held *a, const struct files_held *b)
{
	/* A socket cannot be opened twice, but its file (O_PATH) can. */
	if (a->file->kind == FILE_SOCKET && !((a->file->flags | b->file->flags) & O_PATH))
		return 0;
	return syscall(SYS_kcmp, a->pid, b->pid, KCMP_FILE, a->file->fd, b->file->fd);
}

bool files_is_closed(const struct files_held *held)
{
	return syscall(SYS_kcmp, held->pid, held->pid, KCMP_FILE, held->file->fd, held->file->fd);
}

/* Among `kinds`, which are in order, of what `held` is: its index, or -1 with *at where it
 * would be.  Those that have been closed since have no place in the order, and are taken out. */
static int find_kind(struct files_held **kinds, uint32_t *count, const struct files_held *held,
		     uint32_t *at)
{
	uint32_t low = 0, high = *count;

	while (low < high) {
		const uint32_t middle = (low + high) / 2;
		const long order = compare_held(held, kinds[middle]);

		if (order == 0)
			return (int)middle;
		if (order < 0 && files_is_closed(held)) {
			*at = *count;
			return -1;
		}
		if (order < 0) {
			memmove(&kinds[middle], &kinds[middle + 1],
				(*count - middle - 1) * sizeof *kinds);
			--*count;
			high--;
		} else if (order == 1) {
			high = middle;
		} else {
			low = middle + 1;
		}
	}
	*at = low;
	return -1;
}

/* Only descriptors of the same file can share a description, and kcmp(2) gives an order, so that
 * few calls are needed. */
void files_group(struct files_held *held, uint32_t count)
{
	struct files_held **kinds = calloc(count + 1, sizeof *kinds);

	for (uint32_t i = 0; i < count; i++) {
		held[i].number = i;
		held[i].first = held[i].file;
	}
	if (!kinds)
		return;
	qsort(held, count, sizeof *held, by_key);
	for (uint32_t i = 0, kind_count = 0; i < count; i++) {
		uint32_t at = 0;
		int found;

		aside_step();
		if (i && compare_keys(held[i].file, held[i - 1].file))
			kind_count = 0;
		found = find_kind(kinds, &kind_count, &held[i], &at);
		if (found >= 0) {
			held[i].first = kinds[found]->file;
			continue;
		}
		memmove(&kinds[at + 1], &kinds[at], (kind_count - at) * sizeof *kinds);
		kinds[at] = &held[i];
		kind_count++;
	}
	free(kinds);
}

/* Which descriptors are of the same open file description. */
void files_find_shared(struct files *files, pid_t pid)
{
	struct files_held *held = calloc(files->count + 1, sizeof *held);

	if (!held)
		return;
	for (uint32_t i = 0; i < files->count; i++)
		held[i] = (struct files_held){ .file = &files->file[i], .pid = pid };
	files_group(held, files->count);
	for (uint32_t i = 0; i < files->count; i++)
		held[i].file->shared = held[i].first->fd;
	free(held);
}

static bool is_shared_by_parent(const struct files *files, const struct file *f)
{
	const struct file *first = files_find(files, f->shared);

	return f->inherited && f->inherited->shared == f->shared && first && first->inherited;
}

void files_check_shared(struct files *files, pid_t pid)
{
	for (uint32_t i = 0; i < files->count; i++) {
		struct file *f = &files->file[i];

		if (f->known && (f->shared == f->fd || is_shared_by_parent(files, f) ||
				 syscall(SYS_kcmp, pid, pid, KCMP_FILE, f->fd, f->shared) == 0))
			continue;
		f->shared = f->fd;
		for (uint32_t j = 0; j < files->count; j++) {
			const struct file *g = &files->file[j];

			if (g->fd != f->fd && g->shared == g->fd && !compare_keys(f, g) &&
			    syscall(SYS_kcmp, pid, pid, KCMP_FILE, f->fd, g->fd) == 0) {
				f->shared = g->fd;
				break;
			}
		}
	}
}
