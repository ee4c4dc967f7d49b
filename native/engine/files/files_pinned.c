/* SPDX-License-Identifier: Apache-2.0
 *
 * Through open descriptors, a device or the kernel may write to the process's memory bypassing its
 * page table: pages that were pinned before.
 */
#include <fcntl.h>
#include <sys/sysmacros.h>

#include "files.h"

#define MEMORY_MAJOR 1 /* null, zero, random and the like                        */
#define TTY_MAJOR 5
#define PTS_MAJOR_FIRST 136
#define PTS_MAJOR_LAST 143

static bool is_harmless_device(const struct file *file)
{
	const unsigned int major_number = major(file->rdev);

	return major_number == MEMORY_MAJOR || major_number == TTY_MAJOR ||
	       (major_number >= PTS_MAJOR_FIRST && major_number <= PTS_MAJOR_LAST);
}

static bool pins(const struct file *file)
{
	switch (file->kind) {
	case FILE_OTHER:
		return true;
	case FILE_DEVICE:
		return !is_harmless_device(file);
	case FILE_REGULAR:
		return (file->flags | file->told_flags) & O_DIRECT;
	case FILE_SOCKET:
		return file->socket && file->socket->domain == AF_XDP;
	default:
		return false;
	}
}

bool files_may_pin(const struct files *files)
{
	for (uint32_t i = 0; files && i < files->count; i++)
		if (pins(&files->file[i]))
			return true;
	return false;
}
