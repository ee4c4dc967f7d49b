/* SPDX-License-Identifier: Apache-2.0
 *
 * Memory that a clone does not carry as it is (memory*.c):
 *
 *   memory.c         prepare, copy, restore
 *   memory_areas.c   finds the areas
 *   memory_wiped.c   those that are wiped in a fork (MADV_WIPEONFORK)
 *   memory_others.c  shared memory that other processes have, too
 */
#ifndef AVCKPT_MEMORY_H
#define AVCKPT_MEMORY_H

#include "state.h"

/* How shared memory is written: only in a way that the application itself could use. */
enum area_way {
	WAY_MAPPING, /* mapped for writing */
	WAY_PROTECT, /* it is protected, and was open for writing: mprotect(2) opens it */
	WAY_FILE,    /* it was not, but a descriptor is                          */
	WAY_NONE     /* so its contents do not belong to the application */
};

struct area {
	avc_remote start, end;
	uint64_t offset, inode;
	uint64_t device;    /* of System V memory with more: segment_device()          */
	bool wiped;         /* MADV_WIPEONFORK; else shared memory                     */
	bool named;         /* other processes can have it as well */
	bool as_file;       /* ... or open by that name                                */
	bool linked;        /* which it had at the checkpoint                          */
	bool found;         /* others can find it later: by a name in /dev/shm, or a System V key */
	bool again;         /* another area of the app is of the same memory, and kept       */
	bool left;          /* no room for it */
	uint8_t protection; /* as mmap(2) has it                                     */
	enum area_way way;
	uint32_t writes; /* memory_others.c: as of the checkpoint                   */
	size_t kept;     /* bytes that are in the image: less where the file ends earlier */
};

/* System V memory: a segment's inode is its number, which is its own in its IPC namespace only. */
bool mapping_is_segment(const struct mapping *mapping);
/* A device, and the IPC namespace of a process above it, which tells such segments apart, also from
 * other memory; and the device alone. */
uint64_t segment_device(uint64_t device, pid_t pid);
static inline uint64_t area_device(const struct area *a)
{
	return a->device & UINT32_MAX;
}

struct areas {
	uint32_t count, room;
	struct area *area;
};

#define MARKS_MAX 64
#define SMAPS_SHARE 50 /* smaps is read in at most 1/50 of the time */

/* Ranges of memory with certain flags. */
struct marks {
	uint32_t count;
	struct {
		avc_remote start, end;
		uint32_t flags; /* enum mapping_flag                            */
	} area[MARKS_MAX];
};

#define DONTFORK_MAX 2000

struct stretch {
	avc_remote start, end;
};

/* What is known about a process's memory from one checkpoint to the next. */
struct memory {
	/* Some of it was not inherited by a clone (MADV_DONTFORK): which is looked up in each
	 * freeze.  As of the last: */
	bool dontfork;
	uint32_t unforked;
	struct stretch *unforked_at; /* of DONTFORK_MAX; NULL: there never was any       */
	struct areas areas;
	struct areas foreign; /* also of other processes; by identity, not address */
	struct areas unkept;  /* beyond the limit, or not writable here; likewise    */
	uint64_t layout;      /* a hash of the mappings when the areas were read */
	uint64_t read_ns, cost_ns;
	uint64_t left_bytes;   /* shared memory beyond the limit                  */
	uint64_t others_bytes; /* and shared with other processes */
	struct marks advised;  /* advice given by madvise(2), where a restore maps it again */
	struct marks locked;
	struct marks kinds; /* as mem_image.kinds                              */
	bool special;       /* the same                                        */
	bool grows;         /* some, other than its stack, grows downwards     */
	bool receives;      /* a socket replaces pages of it: TCP_ZEROCOPY_RECEIVE     */
	int64_t locked_kb;
	uint64_t locked_layout, locked_read_ns, locked_cost_ns;
};

struct wiped_run {
	avc_remote start, end;
	bool guard; /* guard pages; else they are copied                        */
};

/* Until it is in the template. */
struct wiped {
	struct wiped_run *run;
	uint32_t runs, room;
	uint8_t *bytes;
	size_t used, size;
};

struct mem_image {
	struct areas areas;
	struct marks kinds;    /* what a restore has to know about mappings */
	bool special;          /* it has a vDSO                                   */
	bool whole;            /* everything could be read                        */
	bool leased;           /* some could not: a lease would have been broken   */
	bool too_much;         /* ... of what is wiped, not                       */
	uint64_t left_bytes;   /* of shared memory, for all processes together     */
	struct mem_seen *seen; /* during a freeze                                */
	struct wiped wiped;
	size_t bytes;
	uint8_t data[];
};

static inline size_t area_bytes(const struct area *a)
{
	return a->end - a->start;
}

/* ---- memory.c ---------------------------------------------------------------- */

bool mem_seen_has(const struct mem_seen *seen, const struct area *area);
/* One that it has not; false: out of memory. */
bool mem_seen_add(struct mem_seen *seen, const struct area *area);

/* ---- memory_areas.c ---------------------------------------------------------- */

/* Shrinks it to what it holds; false: out of memory. */
bool areas_copy(struct areas *to, const struct areas *from);
void areas_free(struct areas *areas);
/* Those beyond MARKS_MAX are not recorded: harmless for advice, and what cannot be mapped again
 * shows at the restore. */
void marks_add(struct marks *marks, const struct mapping *m, uint32_t flags);
/* Whether the areas copied are those that exist.  Reads smaps only periodically, and when the
 * layout has changed. */
int areas_check(const struct image *image, struct avc_error *err) warn_unused;
/* A descriptor of that process, open for writing, for the area's file; -1: none. */
int area_find_descriptor(pid_t pid, const struct area *area);

/* ---- memory_wiped.c --------------------------------------------------------- */

/* While the process is stopped. */
void wiped_copy(const struct process *process, struct mem_image *image);
/* Writes it into the template, which is stopped, and frees it. */
int wiped_fill(const struct image *image, struct setup *setup, struct avc_error *err) warn_unused;
void wiped_free(struct wiped *wiped);

/* ---- memory_others.c -------------------------------------------------------- */

/* Marks the areas that processes outside of the app's PID namespace have, too, by a scan not older
 * than `since`. */
void mem_others_scan(struct mem_others *others, const struct process *process,
		     const struct areas *areas, uint64_t since);
bool mem_others_have(const struct mem_others *others, const struct area *area);
/* Watches it for writes as to a file from now on. */
void mem_others_watch(struct mem_others *others, pid_t template, const struct area *area);
/* Counts these; the same number: none since. */
uint32_t mem_others_writes(struct mem_others *others, const struct area *area);

#endif
