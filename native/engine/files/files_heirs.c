/* SPDX-License-Identifier: Apache-2.0
 *
 * Heirs: descriptors that a child shares with its parent, under the same number.  There may be as
 * many as processes times the descriptors of the first.  So a freeze assumes that those that occur
 * once in a child are unchanged (files_look.c, walk_frozen()), and does not even list them for each child
 * (look_leave_heirs()); and the look before it assumes that they are as in the checkpoint before
 * (was_parents()).  Both are checked afterwards, in the templates: the one comparison for each heir.
 *
 * A child that has replaced one cannot get it back unnoticed, except by exchanging two of them, and
 * exchanging them again between a freeze and its check, or by receiving it back then.  One that is
 * found to have others than before is compared before each freeze from then on (heirs_change), so a
 * habit of exchanging does not stay unnoticed.
 *
 * One that has just been started may be about to redirect what it has inherited, as the commands of a
 * shell do.  Where that was found once (young_vary), each is compared until it is known for some
 * checkpoints: otherwise the next ones of them would make every checkpoint fail.
 */
#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <linux/kcmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "files.h"

/* So many times as many numbers as there are descriptors are tried, and these. */
#define SPARSE 4
#define SPARSE_LEAST 64
#define NUMBERS_MAX (1 << 20)
#define YOUNG 4 /* checkpoints, or tries of one                                          */
#define ASKED_MAX (INJ_FILES_BYTES / 2 / sizeof(struct inj_syscall))

/* ---- which of them are trusted ------------------------------------------------------------- */

static bool is_young(const struct process *process)
{
	return process->descendant && process->checkpoints < YOUNG;
}

bool files_trusts_heirs(const struct process *process)
{
	return !process->heirs_vary &&
	       !(process->main && process->main->young_vary && is_young(process));
}

void files_note_young(struct process *main, const struct process *process)
{
	main->young_vary |= is_young(process);
}

/* ---- before the first look ---------------------------------------------------------------- */

/* Whether there is one. */
static bool look_at_name(int dir, const char *number, const char **refused)
{
	char link[128];
	const ssize_t n = readlinkat(dir, number, link, sizeof link - 1);

	if (n <= 0)
		return false;
	link[n] = 0;
	if (!*refused)
		*refused = files_refuses(link);
	return true;
}

static void look_at_listed(int dir, const char **refused)
{
	const int again = dup(dir);
	DIR *list = again < 0 ? NULL : fdopendir(again);
	struct dirent *entry;

	while (list && !*refused && (entry = readdir(list)))
		(void)look_at_name(dir, entry->d_name, refused);
	if (list)
		closedir(list);
	else if (again >= 0)
		close(again);
}

/* Most of a child's are its parent's, under small numbers: a comparison takes a third of the time of
 * reading a name, and a list of the table takes as long again.  True if these are all. */
static bool look_beside(struct process *process, const struct process *parent, int dir,
			const char **refused)
{
	struct stat st;
	int most, seen = 0;

	/* The number of descriptors, since Linux 6.2. */
	if (fstat(dir, &st) || st.st_size <= 0 || st.st_size > NUMBERS_MAX)
		return false;
	most = SPARSE * (int)st.st_size + SPARSE_LEAST;
	process->heirs_likely = calloc((size_t)most, 1);
	if (!process->heirs_likely)
		return false;
	process->heirs_count = most;
	for (int fd = 0; fd < most && seen < st.st_size && !*refused; fd++) {
		char number[16];

		snprintf(number, sizeof number, "%d", fd);
		process->heirs_likely[fd] = syscall(SYS_kcmp, process->pid, parent->pid, KCMP_FILE,
						    fd, fd) == 0;
		seen += process->heirs_likely[fd] || look_at_name(dir, number, refused);
	}
	return seen == st.st_size;
}

int files_survey(struct process *process, const struct process *parent, const char **refused)
{
	const int dir = proc_open(process->pid, "fd", O_RDONLY | O_DIRECTORY);

	if (dir < 0)
		return -1;
	free(process->heirs_likely);
	process->heirs_likely = NULL;
	process->heirs_count = 0;
	if (!parent || (!look_beside(process, parent, dir, refused) && !*refused))
		look_at_listed(dir, refused);
	close(dir);
	return 0;
}

/* ---- after a freeze ------------------------------------------------------------------------- */

static int check(struct image *image, const struct image *parent, struct avc_error *err)
{
	for (uint32_t i = 0; image->files->trusted && i < image->files->count; i++) {
		const struct file *f = &image->files->file[i];

		if (!f->inherited || syscall(SYS_kcmp, image->template, parent->template, KCMP_FILE,
					     f->fd, f->fd) == 0)
			continue;
		if (image->process->files_before->reused)
			image->process->heirs_change = true;
		else
			image->process->heirs_vary = true;
		return fail(err, AVC_RETRY, 0, image->pid, "freeze", "kcmp",
			    "descriptor %d was changed meanwhile", f->fd);
	}
	return 0;
}

/* O_CLOEXEC belongs to the table.  The template has the same table, and answers while the comparisons
 * are made. */
static int ask_and_check(struct image *image, const struct image *parent, struct avc_error *err)
{
	const struct parasite *parasite = &image->process->parasite;
	struct inj_call *call = &parasite_slot(parasite, image->slot)->template_call;
	struct inj_syscall *list =
		(struct inj_syscall *)(parasite_files(parasite, image->slot) + INJ_FILES_BYTES / 2);
	struct files *files = image->files;
	bool checked = false;

	for (uint32_t begin = 0, end; begin < files->count; begin = end) {
		struct avc_error ignored = { 0 };
		uint32_t n = 0;
		int result;

		for (end = begin; end < files->count && n < ASKED_MAX; end++)
			if (files->file[end].inherited)
				list[n++] = (struct inj_syscall){
					.nr = SYS_fcntl,
					.arg = { (uint64_t)files->file[end].fd, F_GETFD }
				};
		if (!n)
			break;
		call_begin(call, INJ_AFTER_PARK);
		call_add(call, INJ_LIST, parasite_remote(parasite, list), n);
		if (parasite_send(parasite, image->template, &image->base, call, err) ||
		    parasite_start(image->template, err))
			return -1;
		result = checked ? 0 : check(image, parent, err);
		checked = true;
		if (parasite_finish(image->template, call, result ? &ignored : err) || result)
			return -1;
		n = 0;
		for (uint32_t i = begin; i < end; i++)
			if (files->file[i].inherited)
				files->file[i].cloexec = list[n++].result == FD_CLOEXEC;
	}
	return 0;
}

/* All of them: many may have replaced the same file, and are to be known as such by the next try. */
int files_check_heirs(struct image *image, uint32_t images, struct avc_error *err)
{
	int result = 0;

	for (uint32_t i = 1; i < images; i++) {
		const struct image *parent = &image[image[i].parent < 0 ? 0 : image[i].parent];
		struct avc_error failed = { 0 };

		if (!image[i].process || ask_and_check(&image[i], parent, &failed) == 0)
			continue;
		*err = failed;
		result = -1;
		if (failed.code != AVC_RETRY)
			break;
		files_note_young(image[0].process, image[i].process);
	}
	return result;
}
