/* SPDX-License-Identifier: Apache-2.0
 *
 * Heirs: descriptors that a child shares with its parent, under the same number.  There may be as
 * many as processes times the descriptors of the first.  So a freeze assumes that those that occur
 * once in a child are unchanged (files.c, walk_frozen()), which is checked afterwards, in the
 * templates.  A child that has replaced one cannot get it back unnoticed, except by exchanging two
 * of them twice within that time.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/kcmp.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "files.h"

#define ASKED_MAX (INJ_FILES_BYTES / 2 / sizeof(struct inj_syscall))

static int check(struct image *image, const struct image *parent, struct avc_error *err)
{
	for (uint32_t i = 0; image->files->trusted && i < image->files->count; i++) {
		const struct file *f = &image->files->file[i];

		if (!f->inherited || syscall(SYS_kcmp, image->template, parent->template, KCMP_FILE,
					     f->fd, f->fd) == 0)
			continue;
		image->process->heirs_vary = true;
		return fail(err, AVC_RETRY, 0, image->pid, "freeze", "kcmp",
			    "descriptor %d was changed meanwhile", f->fd);
	}
	return 0;
}

/* O_CLOEXEC belongs to the table.  The template has the same table. */
static int ask_flags(struct image *image, struct avc_error *err)
{
	const struct parasite *parasite = &image->process->parasite;
	struct inj_call *call = &parasite_slot(parasite, image->slot)->template_call;
	struct inj_syscall *list =
		(struct inj_syscall *)(parasite_files(parasite, image->slot) + INJ_FILES_BYTES / 2);
	struct files *files = image->files;

	for (uint32_t begin = 0, end; begin < files->count; begin = end) {
		uint32_t n = 0;

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
		    parasite_run(image->template, call, err))
			return -1;
		n = 0;
		for (uint32_t i = begin; i < end; i++)
			if (files->file[i].inherited)
				files->file[i].cloexec = list[n++].result == FD_CLOEXEC;
	}
	return 0;
}

int files_check_heirs(struct image *image, uint32_t images, struct avc_error *err)
{
	for (uint32_t i = 1; i < images; i++) {
		const struct image *parent = &image[image[i].parent < 0 ? 0 : image[i].parent];

		if (image[i].process &&
		    (check(&image[i], parent, err) || ask_flags(&image[i], err)))
			return -1;
	}
	return 0;
}
