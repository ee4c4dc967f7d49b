/* SPDX-License-Identifier: Apache-2.0
 *
 * Opening what a container names, or has: neither may lead out of it, wait for it, or have an
 * effect on it (docs/security.md).
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/openat2.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "base.h"

#define NS_GET_MNTNS_ID_ _IOR(0xb7, 5, uint64_t) /* linux/nsfs.h, since Linux 6.11 */
#define MOUNTS_LISTED 256                        /* at a time                      */

int open_below(int root, const char *path, uint64_t flags, uint64_t resolve)
{
	struct open_how how = {
		.flags = O_PATH | O_CLOEXEC | flags,
		.resolve = RESOLVE_IN_ROOT | RESOLVE_NO_MAGICLINKS | resolve,
	};

	return got_fd((int)syscall(SYS_openat2, root, path, &how, sizeof how));
}

int open_in_root_of(pid_t pid, const char *path, uint64_t flags)
{
	int root = proc_open(pid, "root", O_PATH | O_DIRECTORY), fd;

	if (root < 0)
		return -1;
	fd = open_below(root, path, flags, 0);
	close(root);
	return fd;
}

struct fd_path fd_path(int fd)
{
	struct fd_path path;

	snprintf(path.text, sizeof path.text, "/proc/thread-self/fd/%d", fd);
	return path;
}

int open_again(int fd, int flags)
{
	return got_fd(open(fd_path(fd).text, flags | O_NONBLOCK | O_NOCTTY | O_CLOEXEC));
}

int open_device(int fd, int flags)
{
	return got_limited_fd(open(fd_path(fd).text, flags | O_NONBLOCK | O_NOCTTY | O_CLOEXEC));
}

/* ---- file systems ------------------------------------------------------------------------- */

uint64_t mount_of(int fd)
{
	struct statx st;

	return fd_look(fd, STATX_MNT_ID, &st) && st.stx_mask & STATX_MNT_ID ? st.stx_mnt_id : 0;
}

bool mount_is_served(const char *type)
{
	static const char *const served[] = { "fuse", "nfs",      "cifs",     "smb",    "9p",
					      "ceph", "afs",      "virtiofs", "vboxsf", "lustre",
					      "gpfs", "orangefs", "coda",     "autofs" };

	for (size_t i = 0; i < sizeof served / sizeof *served; i++)
		if (!strncmp(type, served[i], strlen(served[i])))
			return true;
	return false;
}

static void read_mounts(struct mounts *mounts, pid_t pid)
{
	char *line = NULL, buffer[PROC_LINES];
	struct proc_mount mount;
	size_t size = 0;
	FILE *info = proc_lines(pid, "mountinfo", buffer);

	mounts->read = true;
	while (info && getline(&line, &size, info) > 0 && proc_parse_mount(line, &mount) &&
	       make_room(&mounts->mount, mounts->count, &mounts->room, sizeof *mounts->mount)) {
		struct mounted *m = &mounts->mount[mounts->count++];

		m->id = mount.id;
		snprintf(m->type, sizeof m->type, "%s", mount.type);
	}
	free(line);
	if (info)
		fclose(info);
}

const char *mount_type(struct mounts *mounts, pid_t pid, int fd)
{
	const uint64_t id = mount_of(fd);

	if (!mounts->read)
		read_mounts(mounts, pid);
	for (uint32_t i = 0; i < mounts->count; i++)
		if (mounts->mount[i].id == id)
			return mounts->mount[i].type;
	return "";
}

bool mounts_may_be_served(struct mounts *mounts, pid_t pid)
{
	if (!mounts->read)
		read_mounts(mounts, pid);
	for (uint32_t i = 0; i < mounts->count; i++)
		if (mount_is_served(mounts->mount[i].type))
			return true;
	return !mounts->count;
}

/* The mount namespace by its number, and in it the mounts by theirs: none is given twice while the
 * machine runs.  Costs a tenth of mountinfo. */
uint64_t mounts_stamp(pid_t pid)
{
	struct {
		uint32_t size, spare;
		uint64_t below, after, in;
	} request = { .size = sizeof request, .below = UINT64_MAX /* LSMT_ROOT */ };
	int fd = proc_open(pid, "ns/mnt", O_RDONLY);
	const bool known = fd >= 0 && !ioctl(fd, NS_GET_MNTNS_ID_, &request.in);
	uint64_t id[MOUNTS_LISTED], stamp = hash_bytes(1, &request.in, sizeof request.in);
	long listed = known ? MOUNTS_LISTED : -1;

	close_fd(&fd);
	while (listed == MOUNTS_LISTED) {
		listed = syscall(SYS_LISTMOUNT, &request, id, MOUNTS_LISTED, 0);
		if (listed <= 0)
			break;
		stamp = hash_bytes(stamp, id, (size_t)listed * sizeof *id);
		request.after = id[listed - 1];
	}
	return listed < 0 ? 0 : stamp;
}

void mounts_free(struct mounts *mounts)
{
	free(mounts->mount);
	*mounts = (struct mounts){ 0 };
}

#define HUGE_SHIFTS 40 /* of sizes of pages: MFD_HUGE_2MB and others */
#define HUGE_SHIFT_BIT 26

static bool memory_is_known;
static uint64_t memory_device[HUGE_SHIFTS + 1];

static void find_memory(void)
{
	bool all = true;

	for (unsigned int shift = 0; shift <= HUGE_SHIFTS; shift++) {
		const unsigned int huge = shift ? MFD_HUGETLB | shift << HUGE_SHIFT_BIT : 0;
		int fd = memfd_create("avckpt", MFD_CLOEXEC | huge);
		struct statx st;

		all &= fd >= 0 || (errno != EMFILE && errno != ENFILE);
		if (fd >= 0 && fd_look(fd, STATX_TYPE, &st))
			memory_device[shift] = device_of(&st);
		close_fd(&fd);
	}
	memory_is_known = all;
}

bool device_is_memory(uint64_t device)
{
	if (!memory_is_known)
		find_memory();
	for (size_t i = 0; device && i < sizeof memory_device / sizeof *memory_device; i++)
		if (memory_device[i] == device)
			return true;
	return false;
}

/* ---- leases ------------------------------------------------------------------------------- */

void leases_read(struct leases *leases)
{
	unsigned int major, minor;
	char *line = NULL;
	size_t size = 0;
	unsigned long inode;
	FILE *locks;

	if (leases->known)
		return;
	locks = got_memory(fopen("/proc/locks", "re"));
	leases->known = locks != NULL;
	while (leases->known && getline(&line, &size, locks) > 0) {
		if (sscanf(line, "%*d: LEASE %*s %*s %*d %x:%x:%lu", &major, &minor, &inode) != 3)
			continue;
		leases->known = make_room(&leases->file, leases->count, &leases->room,
					  sizeof *leases->file);
		if (leases->known)
			leases->file[leases->count++] =
				(struct leased){ device_number(major, minor), inode };
	}
	free(line);
	if (locks)
		fclose(locks);
}

static bool is_leased(struct leases *leases, uint64_t device, uint64_t inode)
{
	leases_read(leases);
	for (uint32_t i = 0; i < leases->count; i++)
		if (leases->file[i].device == device && leases->file[i].inode == inode)
			return true;
	return !leases->known;
}

void leases_free(struct leases *leases)
{
	free(leases->file);
	*leases = (struct leases){ 0 };
}

int open_to_read(int path_fd, const struct mapping *m, struct leases *leases)
{
	struct statx st;
	int fd;

	if (!fd_look(path_fd, STATX_TYPE, &st))
		return -1;
	if (!S_ISREG(st.stx_mode)) {
		errno = S_ISCHR(st.stx_mode) || S_ISBLK(st.stx_mode) ? EACCES : ENXIO;
		return -1;
	}
	if (leases && is_leased(leases, m->device, m->inode)) {
		errno = EBUSY;
		return -1;
	}
	fd = open_again(path_fd, O_RDONLY | O_NOATIME);
	/* Of a user that we do not know. */
	return fd < 0 && errno == EPERM ? open_again(path_fd, O_RDONLY) : fd;
}
