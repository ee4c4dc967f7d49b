/* SPDX-License-Identifier: Apache-2.0
 *
 * Files are opened for an application as it could open them itself: with its user, groups and
 * capabilities.  That it had them open once is not enough: the mode may have been changed since, or
 * another file may have reused the inode number.
 */
#include <errno.h>
#include <fcntl.h>
#include <grp.h>
#include <linux/capability.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "files.h"

static bool same_users(pid_t pid)
{
	static char own[64]; /* a guard never leaves it */
	char theirs[64];

	return (*own || proc_link(getpid(), "ns/user", own, sizeof own) == 0) &&
	       proc_link(pid, "ns/user", theirs, sizeof theirs) == 0 && !strcmp(own, theirs);
}

void file_rights_note(struct file_rights *rights, pid_t pid, const struct proc_status *status)
{
	rights->known = true;
	rights->user = status->uid[3];
	rights->group = status->gid[3];
	/* In a user namespace of its own they mean nothing outside. */
	rights->caps = same_users(pid) ? status->caps[STATUS_EFFECTIVE] : 0;
	rights->group_count = status->group_count;
	memcpy(rights->groups, status->groups, sizeof rights->groups);
}

static int set_effective(uint64_t caps)
{
	struct __user_cap_header_struct header = { .version = _LINUX_CAPABILITY_VERSION_3 };
	struct __user_cap_data_struct data[2];

	if (syscall(SYS_capget, &header, data))
		return -1;
	data[0].effective = data[0].permitted & (uint32_t)caps;
	data[1].effective = data[1].permitted & (uint32_t)(caps >> 32);
	return (int)syscall(SYS_capset, &header, data);
}

/* The system calls, and not the library's functions: these would change all threads. */
static void set_user(uint32_t user, uint32_t group)
{
	syscall(SYS_setfsgid, group);
	syscall(SYS_setfsuid, user);
}

static bool is_user(uint32_t user, uint32_t group)
{
	/* -1 changes nothing, and both return the previous value. */
	return (uint32_t)syscall(SYS_setfsuid, -1) == user &&
	       (uint32_t)syscall(SYS_setfsgid, -1) == group;
}

static int take_groups(const struct file_rights *rights, struct file_rights_own *own)
{
	if (!rights->known)
		return -1;
	own->group_count = (int)syscall(SYS_getgroups, RIGHTS_GROUPS, own->groups);
	return own->group_count < 0 || syscall(SYS_setgroups, rights->group_count, rights->groups)
		       ? -1
		       : 0;
}

static void give_groups_back(const struct file_rights_own *own)
{
	(void)syscall(SYS_setgroups, own->group_count, own->groups);
}

int file_rights_take(const struct file_rights *rights, struct file_rights_own *own)
{
	own->user = (uint32_t)syscall(SYS_setfsuid, -1);
	own->group = (uint32_t)syscall(SYS_setfsgid, -1);
	if (take_groups(rights, own))
		return -1;
	set_user(rights->user, rights->group);
	if (set_effective(rights->caps) || !is_user(rights->user, rights->group)) {
		file_rights_give_back(own);
		return -1;
	}
	return 0;
}

/* The real user and the permitted capabilities are still our own: all of this is allowed. */
void file_rights_give_back(const struct file_rights_own *own)
{
	set_user(own->user, own->group);
	(void)set_effective(~UINT64_C(0));
	give_groups_back(own);
}

static void set_effective_user(uint32_t user, uint32_t group)
{
	syscall(SYS_setresgid, -1, group, -1);
	syscall(SYS_setresuid, -1, user, -1);
}

static bool is_effective_user(uint32_t user, uint32_t group)
{
	return (uint32_t)syscall(SYS_geteuid) == user && (uint32_t)syscall(SYS_getegid) == group;
}

int file_rights_pair(const struct file_rights *rights, int type, int ends[2])
{
	struct file_rights_own own = { .user = (uint32_t)syscall(SYS_geteuid),
				       .group = (uint32_t)syscall(SYS_getegid) };
	int result = -1;

	if (take_groups(rights, &own))
		return -1;
	set_effective_user(rights->user, rights->group);
	if (!is_effective_user(rights->user, rights->group))
		errno = EPERM;
	else
		result = got_fd(type ? socketpair(AF_UNIX, type | SOCK_CLOEXEC, 0, ends)
				     : pipe2(ends, O_CLOEXEC));
	/* The real user is still our own, and our capabilities come back with it. */
	syscall(SYS_setresuid, -1, own.user, -1);
	syscall(SYS_setresgid, -1, own.group, -1);
	give_groups_back(&own);
	return result;
}
