/* SPDX-License-Identifier: Apache-2.0
 *
 * Reads a table of descriptors (files.h).
 *
 * A checkpoint reads it twice: before the freeze everything, names included, while the app runs;
 * and during the freeze the state of that instant, while the kernel clones.  A descriptor that has
 * been replaced in between is read in full again.
 */
#include <fcntl.h>
#include <linux/major.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>
#include <time.h>
#include <unistd.h>

#include "files_look.h"

#define FUSE_MINOR 229 /* include/linux/miscdevice.h                                   */
/* So many new sockets of a process are read in the freeze, where each makes it longer by 2 us, or by
 * some 20 if it could be recreated. */
#define SOCKETS_LATER 128

static int by_object(const void *a, const void *b)
{
	const struct file *x = *(const struct file *const *)a, *y = *(const struct file *const *)b;

	if (x->dev != y->dev)
		return x->dev < y->dev ? -1 : 1;
	return (x->ino > y->ino) - (x->ino < y->ino);
}

void files_missing_sort(struct files_missing *missing)
{
	if (missing->count)
		qsort(missing->file, missing->count, sizeof(void *), by_object);
}

/* A program may have opened thousands since, which only have to be closed. */
static bool is_of_interest(const struct look *look, int number)
{
	const struct files_missing *missing = look->files->missing;
	struct file key = { 0 };
	const struct file *wanted = &key;
	struct statx st;
	char name[16];

	if (!missing || files_find(look->known, number))
		return true;
	snprintf(name, sizeof name, "%d", number);
	if (!missing->count || statx(look->fd_dir, name, AT_STATX_DONT_SYNC | AT_NO_AUTOMOUNT,
				     STATX_TYPE | STATX_INO, &st))
		return false;
	key.dev = makedev(st.stx_dev_major, st.stx_dev_minor);
	key.ino = st.stx_ino;
	return (missing->port && S_ISSOCK(st.stx_mode)) ||
	       bsearch(&wanted, missing->file, missing->count, sizeof wanted, by_object);
}

static int walk_known(struct look *look, struct avc_error *err)
{
	for (uint32_t i = 0; i < look->known->count; i++)
		if (look_at_descriptor(look, look->known->file[i].fd, err))
			return -1;
	return 0;
}

struct walk {
	struct look *look;
	uint32_t seen; /* the first so many of the table are there already */
	bool failed;
	struct avc_error *err;
};

static int look_at_number(pid_t number, void *arg)
{
	struct walk *walk = arg;

	walk->failed = is_of_interest(walk->look, number) &&
		       !files_find_among(walk->look->files, walk->seen, number) &&
		       look_at_descriptor(walk->look, number, walk->err);
	return walk->failed ? -1 : 0;
}

static int walk(struct look *look, uint32_t seen, struct avc_error *err)
{
	struct walk walk = { .look = look, .seen = seen, .err = err };

	if (proc_numbers(look->fd_dir, look_at_number, &walk) == 0)
		return 0;
	return walk.failed ? -1
			   : fail_errno(err, look->pid, "look at descriptors", "getdents64",
					"it has ended");
}

/* How many it has, since Linux 6.2. */
static int64_t size_of_table(const struct look *look)
{
	struct stat st;

	return fstat(look->fd_dir, &st) ? -1 : st.st_size;
}

/* Most have what they had before, or what their parent has; and to list a table takes longer than to
 * look for those. */
static int walk_before(struct look *look, struct avc_error *err)
{
	const struct files *likely = look->known ? look->known : look->files->parent;

	for (uint32_t i = 0; likely && i < likely->count; i++)
		if (look_at_descriptor(look, likely->file[i].fd, err))
			return -1;
	return size_of_table(look) == look->files->count ? 0 : walk(look, look->files->count, err);
}

int look_at_place(struct look *look, uint32_t i, bool *same, struct avc_error *err)
{
	struct files *files = look->files;

	files->count = i;
	if (look_at_descriptor(look, look->known->file[i].fd, err))
		return -1;
	if (files->count == i)
		files->file[i].fd = -1; /* it has been closed             */
	*same &= files->count > i && files->file[i].known;
	return 0;
}

static int look_at_heirs(struct look *look, bool *same, struct avc_error *err)
{
	for (uint32_t i = 0; i < look->known->count; i++)
		if (look->known->file[i].heir && look_at_place(look, i, same, err))
			return -1;
	return 0;
}

/* Whether all others still exist. */
static int look_at_own(struct look *look, bool *same, struct avc_error *err)
{
	*same = true;
	for (uint32_t i = 0; i < look->known->own_count; i++)
		if (look_at_place(look, look->known->own[i], same, err))
			return -1;
	return 0;
}

static void close_gaps(struct files *files, uint32_t count)
{
	files->count = 0;
	for (uint32_t i = 0; i < count; i++)
		if (files->file[i].fd >= 0)
			files->file[files->count++] = files->file[i];
}

/* Heirs are by far the most numerous, and take time.  A process with the same number of
 * descriptors, and with its own unchanged, most likely still has them, which is checked when it
 * runs again.  With the same number, there is no new one. */
static int walk_frozen(struct look *look, struct avc_error *err)
{
	const uint32_t count = look->known->count;
	const int64_t size = size_of_table(look);
	bool same;

	if (look_at_own(look, &same, err))
		return -1;
	look->trusts = same && size == count && files_trusts_heirs(look->files->process);
	look->files->trusted = look->trusts;
	if (look_may_leave_heirs(look))
		return look_leave_heirs(look, err);
	if (look_at_heirs(look, &same, err))
		return -1;
	close_gaps(look->files, count);
	return size == look->files->count ? 0 : walk(look, look->files->count, err);
}

static int by_fd(const void *a, const void *b)
{
	return ((const struct file *)a)->fd - ((const struct file *)b)->fd;
}

static bool are_in_order(const struct files *files)
{
	for (uint32_t i = 1; i < files->count; i++)
		if (files->file[i - 1].fd > files->file[i].fd)
			return false;
	return true;
}

/* Most have the mounts that they had before, or that their parent has. */
static bool may_be_served(struct look *look)
{
	const struct files *files = look->files, *seen = look->known ? look->known : files->parent;

	if (seen && files->mounts && files->mounts == seen->mounts)
		return seen->served;
	return mounts_may_be_served(&look->mounts, look->pid);
}

#define ASIDE_NS NS_PER_MS
#define ASIDE_TRIES 3

/* Both clocks at one instant: without what may have come in between the two calls. */
static void read_clocks(uint64_t *real_ns, uint64_t *boot_ns)
{
	for (int i = 0; i < ASIDE_TRIES; i++) {
		*boot_ns = clock_ns(CLOCK_BOOTTIME);
		*real_ns = clock_ns(CLOCK_REALTIME);
		if (clock_ns(CLOCK_BOOTTIME) < *boot_ns + ASIDE_NS)
			break;
	}
}

/* What both clocks may differ by in a second that nobody has set one in is 0.5 ms (adjtimex(2)). */
#define SET_NS (50 * NS_PER_MS)
#define SLEW 1000

bool files_clock_was_set(const struct files *files)
{
	uint64_t real_ns, boot_ns;
	int64_t passed, shown;

	read_clocks(&real_ns, &boot_ns);
	passed = (int64_t)(boot_ns - files->boot_ns);
	shown = (int64_t)(real_ns - files->taken_ns);
	return llabs(shown - passed) > (int64_t)SET_NS + passed / SLEW;
}

/* Which files init's stdio is: is_inits(). */
static void look_at_init(struct look *look)
{
	for (int i = 0; i < 3; i++) {
		char name[8];
		struct statx st;

		snprintf(name, sizeof name, "fd/%d", i);
		if (!proc_look(look->init, name, STATX_INO, &st))
			continue;
		look->init_stdio[i].dev = makedev(st.stx_dev_major, st.stx_dev_minor);
		look->init_stdio[i].ino = st.stx_ino;
	}
}

static int walk_as_deep(struct look *look, struct avc_error *err)
{
	const struct files *files = look->files, *known = look->known;

	if (files->missing && !files->missing->count)
		return walk_known(look, err);
	if (look->depth == FILES_FROZEN && known && known->count <= files->room)
		return walk_frozen(look, err);
	if (look->depth == FILES_BEFORE)
		return walk_before(look, err);
	return walk(look, 0, err);
}

static int check_allowed(const struct look *look, struct avc_error *err)
{
	const dev_t fuse = makedev(MISC_MAJOR, FUSE_MINOR);
	const char *why = NULL;

	if (look->depth == FILES_BEFORE && look->refuses)
		why = look->refuses;
	else if (look->depth != FILES_NOW && files_find_device(look->files, fuse) >= 0)
		why = files_serves;
	return why ? fail(err, AVC_UNSUPPORTED, 0, look->pid, "look at descriptors", "", "%s", why)
		   : 0;
}

int files_look(struct files *files, const struct files_owner *owner, enum files_depth depth,
	       struct files *known, struct avc_error *err)
{
	const pid_t pid = owner->pid;
	struct look look = { .files = files,
			     .known = known,
			     .pid = pid,
			     .init = owner->init,
			     .pidfd = owner->pidfd,
			     .later = SOCKETS_LATER,
			     .reuses = owner->reuses,
			     .likely = owner->likely,
			     .likely_count = owner->reuses ? owner->likely_count : 0,
			     .depth = depth };
	int result;

	look.fd_dir = proc_open(pid, "fd", O_RDONLY | O_DIRECTORY);
	if (look.fd_dir < 0)
		return fail_errno(err, pid, "look at descriptors", "open(fd)", "it has ended");
	if (depth != FILES_FROZEN && look.init)
		look_at_init(&look);
	files->count = 0;
	files->mounts = depth == FILES_BEFORE ? mounts_stamp(pid) : 0;
	read_clocks(&files->taken_ns, &files->boot_ns);
	result = walk_as_deep(&look, err);
	if (depth == FILES_NOW)
		files->open = size_of_table(&look);
	close(look.fd_dir);
	files->served = depth == FILES_BEFORE ? may_be_served(&look) : known && known->served;
	mounts_free(&look.mounts);
	if (result || check_allowed(&look, err)) {
		for (uint32_t i = 0; i < files->count; i++)
			file_drop_ours(&files->file[i]);
		return -1;
	}
	if (!are_in_order(files))
		qsort(files->file, files->count, sizeof *files->file, by_fd);
	if (depth == FILES_FROZEN) {
		files_check_shared(files, pid);
		files_find_peers(files, pid); /* of pairs that are quite new */
		files_find_areas(files, pid);
	} else {
		files_find_shared(files, pid);
		if (depth == FILES_BEFORE)
			files_find_peers(files, pid);
	}
	return 0;
}
