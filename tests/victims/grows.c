/* SPDX-License-Identifier: Apache-2.0
 *
 * grows KILOBYTES: fallocate(2) of so much, in huge pages, again and again: it takes long, and does
 * not fail.  counter[0] is how often it was done.
 */
#include "victim.h"

int main(int argc, char **argv)
{
	long bytes;
	int fd;

	victim_start(&argc, argv, 1, "KILOBYTES");
	bytes = atol(argv[1]) * 1024;
	fd = memfd_create("grows", MFD_CLOEXEC | MFD_HUGETLB);
	if (fd < 0)
		unavailable("memfd_create");
	if (fallocate(fd, 0, 0, bytes))
		unavailable("fallocate");
	victim_ready();
	for (;;) {
		must(!ftruncate(fd, 0), "ftruncate");
		CHECK(!fallocate(fd, 0, 0, bytes), "fallocate: %s", strerror(errno));
		count(0, 1);
		beat();
	}
}
