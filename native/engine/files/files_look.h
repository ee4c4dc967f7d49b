/* SPDX-License-Identifier: Apache-2.0
 *
 * Shared by the files that read tables of descriptors.
 *
 *   files_look.c       a table
 *   files_descriptor.c one descriptor
 *   files_inherited.c  what a child shares with its parent
 *   files_shared.c     which of them are of one description
 *   files_contents.c   what is in pipes and sockets
 *   files_capture.c    when: before a freeze, and in it
 */
#ifndef AVCKPT_FILES_LOOK_H
#define AVCKPT_FILES_LOOK_H

#include "files.h"

/* One reading of a table. */
struct look {
	struct files *files, *known;
	pid_t pid, init;
	int pidfd, fd_dir;
	enum files_depth depth;
	bool trusts; /* heirs are assumed unchanged: files_check_heirs() */
	bool reuses; /* the same before a freeze */
	const uint8_t *likely;
	int likely_count; /* of files_survey(): by number, which are the parent's */
	uint32_t later;   /* how many new sockets may still be left to the freeze */
	const char *refuses;
	struct {
		uint64_t dev, ino; /* 0: unknown */
	} init_stdio[3];
	struct mounts mounts;
};

/* files.c */
/* Takes a reference; the last holder frees it, which may be a thread that was left behind
 * (aside.c). */
struct files *files_share(struct files *files);
/* Among the first `count`, which are in order. */
struct file *files_find_among(const struct files *files, uint32_t count, int fd);

/* files_look.c */
/* One that existed before, in its place in `known`; *same: unless it has changed. */
int look_at_place(struct look *look, uint32_t i, bool *same, struct avc_error *err) warn_unused;

/* files_descriptor.c */
/* Adds it to the table, if it is open.  Fails if it cannot be read in time, or may not be open in an
 * app that is protected. */
int look_at_descriptor(struct look *look, int number, struct avc_error *err) warn_unused;
/* Takes over what was read before the freeze, if this is still the same; NULL: it is not. */
struct file *look_take_known(const struct look *look, struct file *f);
bool file_is_anonymous(const struct file *f);
/* A pipe, or a Unix socket that does not listen. */
bool file_is_channel(const struct file *f);

/* files_inherited.c */
/* Whether it is the parent's, and has been read with it. */
bool look_at_inherited(const struct look *look, int number, struct file *f);
/* Of a table that was read in a freeze; `known`: before it. */
void files_note_varied(struct files *files, const struct files *known);
/* Whether what it shares with its parent can be written down after the freeze (files_fill_heirs()).
 * Then that is left, except for what has to be read. */
bool look_may_leave_heirs(const struct look *look);
int look_leave_heirs(struct look *look, struct avc_error *err) warn_unused;

/* files_shared.c */
void files_find_shared(struct files *files, pid_t pid);
/* The same during a freeze: what was found before it is only checked. */
void files_check_shared(struct files *files, pid_t pid);

/* files_contents.c */
/* Once for each object, from an end that can be read. */
bool file_may_have_content(const struct file *f);
/* What its parent's look has found in it. */
void file_copy_content(const struct files *parent, struct file *f);
void files_keep_contents(const struct image *image, struct scratch *scratch);
/* The duplicate. */
void file_drop_ours(struct file *f);

/* files_capture.c */
/* Of pidfds, of the app itself, whose process will be a new one with the same PID. */
void files_find_own_pidfds(const struct process *process, struct files *files);
/* Only the app itself, its threads and its group can be named again. */
void files_find_owners(const struct process *process, struct files *files);

#endif
