/* SPDX-License-Identifier: Apache-2.0
 *
 * The memory of a template: its mappings, and for private ones the frames of its own pages.
 * Templates do not run, so it can be read at any time.
 *
 * A page that two templates share stays shared, and one that they do not share stays unshared,
 * whatever the kernel does with its frame meanwhile.
 */
#include <fcntl.h>
#include <stdlib.h>
#include <unistd.h>

#include "checkpoint.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)
/* Runtimes reserve terabytes of which they use little: beyond this size, empty ranges are not
 * read. */
#define SPARSE_BYTES (UINT64_C(4) << 30)
static int add_mapping(const struct mapping *m, void *arg)
{
	struct mappings *maps = arg;

	if (m->start >= ARCH_USER_END)
		return 0;
	if (!make_room(&maps->map, maps->count, &maps->room, sizeof *maps->map))
		return -1;
	maps->map[maps->count++] = *m;
	return 0;
}

struct snapshot *snapshot_new(pid_t template, const struct mem_image *image, struct avc_error *err)
{
	struct snapshot *snapshot = calloc(1, sizeof *snapshot);

	if (!snapshot) {
		fail_memory(err, template, "restore memory");
		return NULL;
	}
	snapshot->template = template;
	snapshot->pagemap = -1;
	if (proc_mappings(template, "maps", add_mapping, &snapshot->maps)) {
		fail_errno(err, template, "restore memory", "read(maps)", "it was killed");
		snapshot_free(snapshot);
		return NULL;
	}
	for (uint32_t i = 0; i < snapshot->maps.count; i++)
		snapshot->maps.map[i].flags = mem_image_marks(image, snapshot->maps.map[i].start);
	snapshot->pages = calloc(snapshot->maps.count + 1, sizeof *snapshot->pages);
	if (!snapshot->pages) {
		fail_memory(err, template, "restore memory");
		snapshot_free(snapshot);
		return NULL;
	}
	return snapshot;
}

void snapshot_rest(struct snapshot *snapshot)
{
	for (uint32_t i = 0; snapshot && snapshot->pages && i < snapshot->maps.count; i++) {
		struct pages *pages = &snapshot->pages[i];

		for (uint32_t k = 0; k < pages->count; k++)
			free(pages->extent[k].frame);
		free(pages->extent);
		*pages = (struct pages){ 0 };
	}
	if (snapshot)
		close_fd(&snapshot->pagemap);
}

void snapshot_free(struct snapshot *snapshot)
{
	if (!snapshot)
		return;
	snapshot_rest(snapshot);
	free(snapshot->pages);
	free(snapshot->maps.map);
	free(snapshot);
}

static int read_extent(struct snapshot *snapshot, struct pages *pages, avc_remote start,
		       avc_remote end)
{
	const size_t bytes = (end - start) / PAGE * sizeof(uint64_t);
	struct extent *extent;

	if (!make_room(&pages->extent, pages->count, &pages->room, sizeof *pages->extent))
		return -1;
	extent = &pages->extent[pages->count];
	*extent = (struct extent){ .start = start, .end = end, .frame = malloc(bytes) };
	if (!extent->frame)
		return -1;
	pages->count++;
	return pread(snapshot->pagemap, extent->frame, bytes,
		     (off_t)(start / PAGE * sizeof(uint64_t))) == (ssize_t)bytes
		       ? 0
		       : -1;
}

struct sparse {
	struct snapshot *snapshot;
	struct pages *pages;
};

static int read_sparse(avc_remote start, avc_remote end, void *arg)
{
	const struct sparse *sparse = arg;

	return read_extent(sparse->snapshot, sparse->pages, start, end);
}

/* Of a private mapping of the snapshot. */
const struct pages *snapshot_pages(struct snapshot *snapshot, const struct mapping *m,
				   struct avc_error *err)
{
	struct pages *pages = &snapshot->pages[m - snapshot->maps.map];
	struct sparse sparse = { snapshot, pages };
	int result;

	if (pages->known)
		return pages;
	if (snapshot->pagemap < 0)
		snapshot->pagemap = proc_open(snapshot->template, "pagemap", O_RDONLY);
	snapshot->read_bytes += m->end - m->start;
	if (snapshot->read_bytes >= SPARSE_BYTES)
		result = pagemap_walk(snapshot->pagemap, m->start, m->end, read_sparse, &sparse);
	else
		result = read_extent(snapshot, pages, m->start, m->end);
	if (result) {
		fail_errno(err, snapshot->template, "restore memory", "read(pagemap)",
			   "its pages cannot be compared");
		return NULL;
	}
	pages->known = true;
	return pages;
}

/* From `address` on; NULL where there is nothing.  `end` comes down to where that changes,
 * `next` is where the search goes on. */
const uint64_t *pages_frames(const struct pages *pages, uint32_t *next, avc_remote address,
			     avc_remote *end)
{
	const struct extent *extent;

	while (*next < pages->count && pages->extent[*next].end <= address)
		++*next;
	if (*next == pages->count)
		return NULL;
	extent = &pages->extent[*next];
	if (extent->start > address) {
		if (extent->start < *end)
			*end = extent->start;
		return NULL;
	}
	if (extent->end < *end)
		*end = extent->end;
	return extent->frame + (address - extent->start) / PAGE;
}
