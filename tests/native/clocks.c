/* SPDX-License-Identifier: Apache-2.0
 *
 * Which files count as created since a checkpoint, when somebody has set the time of day: nobody sets
 * that of the machine here, the checkpoint says it was taken at another one.
 */
#include <fcntl.h>
#include <stdio.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "checkpoint.h"

#define HOUR_NS (3600 * NS_PER_S)
#define AGO_NS (5 * NS_PER_S)

static uint64_t now_of(clockid_t clock)
{
	struct timespec now;

	clock_gettime(clock, &now);
	return (uint64_t)now.tv_sec * NS_PER_S + (uint64_t)now.tv_nsec;
}

int main(int argc, char **argv)
{
	const int fd = argc > 1 ? open(argv[1], O_RDWR | O_CREAT | O_CLOEXEC, 0600) : -1;
	struct files files = { .boot_ns = now_of(CLOCK_BOOTTIME) - AGO_NS,
			       .taken_ns = now_of(CLOCK_REALTIME) - AGO_NS };
	const struct image image = { .files = &files };
	const uint64_t taken = files.taken_ns;
	struct stat st;

	if (fd < 0 || fstat(fd, &st))
		return 1;
	printf("created since: %d\n", files_is_older(&image, fd, &st));
	files.taken_ns = taken - HOUR_NS;
	printf("set forward since: %d\n", files_is_older(&image, fd, &st));
	files.taken_ns = taken + HOUR_NS;
	printf("set back since: %d\n", files_is_older(&image, fd, &st));
	return 0;
}
