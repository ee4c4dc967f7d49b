/* SPDX-License-Identifier: Apache-2.0
 *
 * Which pages of a process are present: /proc/PID/pagemap
 * (Documentation/admin-guide/mm/pagemap.rst).
 */
#include <errno.h>
#include <string.h>
#include <sys/ioctl.h>

#include "base.h"

#define REGIONS 256

/* Linux 6.7; the headers may be older. */
struct scan_region {
	uint64_t start, end, categories;
};

struct scan {
	uint64_t size, flags, start, end, walk_end, vec, vec_len, max_pages;
	uint64_t category_inverted, category_mask, category_anyof_mask, return_mask;
};

#define SCAN _IOWR('f', 16, struct scan)
#define SCAN_WRITE_PROTECT (1u << 0) /* flags: PM_SCAN_WP_MATCHING               */
#define SCAN_CHECK_ASYNC (1u << 1)   /* PM_SCAN_CHECK_WPASYNC                    */
#define SCAN_WRITTEN (1u << 1)
#define SCAN_FILE (1u << 2)
#define SCAN_PRESENT (1u << 3)
#define SCAN_SWAPPED (1u << 4)

/* As encoded in the page table: a swap entry of the last type, which is unused, with
 * PTE_MARKER_GUARD (include/linux/swapops.h) as its offset. */
#define GUARD_MARKER (UINT64_C(4) << 5 | 31)
#define WATCH_MARKER (UINT64_C(1) << 5 | 31) /* PTE_MARKER_UFFD_WP                   */

bool page_is_guard(uint64_t entry)
{
	return entry & PAGEMAP_GUARD ||
	       (entry & (PAGEMAP_PRESENT | PAGEMAP_SWAPPED | PAGEMAP_FRAME)) ==
		       (PAGEMAP_SWAPPED | GUARD_MARKER);
}

bool page_is_own(uint64_t entry)
{
	return entry & (PAGEMAP_PRESENT | PAGEMAP_SWAPPED) && !(entry & PAGEMAP_FILE) &&
	       (entry & (PAGEMAP_PRESENT | PAGEMAP_SWAPPED | PAGEMAP_FRAME)) !=
		       (PAGEMAP_SWAPPED | WATCH_MARKER);
}

int pagemap_walk(int pagemap, avc_remote start, avc_remote end,
		 int (*fn)(avc_remote start, avc_remote end, void *arg), void *arg)
{
	struct scan_region region[REGIONS];

	while (start < end) {
		struct scan scan = {
			.size = sizeof scan,
			.start = start,
			.end = end,
			.vec = (uint64_t)(uintptr_t)region,
			.vec_len = REGIONS,
			.category_inverted = SCAN_FILE,
			.category_mask = SCAN_FILE,
			.category_anyof_mask = SCAN_PRESENT | SCAN_SWAPPED,
		};
		const int found = ioctl(pagemap, SCAN, &scan);

		if (found < 0 && (errno == ENOTTY || errno == EINVAL))
			return fn(start, end, arg);
		if (found < 0)
			return -1;
		for (int i = 0; i < found; i++)
			if (fn(region[i].start, region[i].end, arg))
				return -1;
		start = scan.walk_end;
	}
	return 0;
}

bool pagemap_is_watched(int pagemap, avc_remote address)
{
	struct scan_region region;
	struct scan scan = {
		.size = sizeof scan,
		.flags = SCAN_CHECK_ASYNC,
		.start = address,
		.end = address + ARCH_PAGE_BYTES,
		.vec = (uint64_t)(uintptr_t)&region,
		.vec_len = 1,
		.category_mask = SCAN_WRITTEN,
		.return_mask = SCAN_WRITTEN,
	};

	return ioctl(pagemap, SCAN, &scan) >= 0;
}

int pagemap_written(int pagemap, avc_remote start, avc_remote end,
		    int (*fn)(avc_remote start, avc_remote end, void *arg), void *arg)
{
	struct scan_region region[REGIONS];

	while (start < end) {
		struct scan scan = {
			.size = sizeof scan,
			.flags = SCAN_WRITE_PROTECT | SCAN_CHECK_ASYNC,
			.start = start,
			.end = end,
			.vec = (uint64_t)(uintptr_t)region,
			.vec_len = REGIONS,
			.category_mask = SCAN_WRITTEN,
			.return_mask = SCAN_WRITTEN,
		};
		int found, errnum;

		memset(region, 0, sizeof region);
		found = ioctl(pagemap, SCAN, &scan);
		errnum = errno;
		/* After an error it reports what it had found, but not how many: these pages are
		 * protected again, and would otherwise be missed. */
		for (int i = 0; i < (found < 0 ? REGIONS : found) && region[i].end; i++)
			if (fn(region[i].start, region[i].end, arg))
				return -1;
		if (found < 0) {
			errno = errnum;
			return -1;
		}
		start = scan.walk_end;
	}
	return 0;
}
