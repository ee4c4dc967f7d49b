/* SPDX-License-Identifier: Apache-2.0
 *
 * Memory that a clone does not carry as it is (memory*.c):
 *
 *   memory.c         prepared for, copied, put back
 *   memory_areas.c   which areas there are
 *   memory_wiped.c   those that are wiped in a fork (MADV_WIPEONFORK)
 *   memory_others.c  shared memory that is not the application's alone
 */
#ifndef AVCKPT_MEMORY_H
#define AVCKPT_MEMORY_H

#include "state.h"

/* How shared memory is written: in no way that the application itself could not. */
enum area_way {
	WAY_MAPPING, /* it is mapped for writing                                 */
	WAY_PROTECT, /* it is protected, and was open for writing: mprotect(2) opens it */
	WAY_FILE,    /* it was not, but a descriptor is                          */
	WAY_NONE     /* so its contents are none of the application's            */
};

struct area {
	avc_remote start, end;
	uint64_t offset, inode, device;
	bool wiped;         /* MADV_WIPEONFORK; else shared memory                     */
	bool named;         /* memory that others can have as well                     */
	bool as_file;       /* ... or open by that name                                */
	bool again;         /* another process of the app has it, too, and its image keeps it */
	bool left;          /* there is no room for it                                  */
	uint8_t protection; /* as mmap(2) has it                                     */
	enum area_way way;
	uint32_t writes; /* memory_others.c: as of the checkpoint                   */
	size_t kept;     /* bytes that are in the image: less where the file ends earlier */
};

struct areas {
	uint32_t count, room;
	struct area *area;
};

#define MARKS_MAX 64
#define SMAPS_SHARE 50 /* the long file is read in at most 1/50 of the time */

/* Stretches of memory with one or the other of some flags. */
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

/* What is known of a process's memory from one checkpoint to the next. */
struct memory {
	/* Some of it was not inherited by a clone (MADV_DONTFORK): which, is looked for in each
	 * freeze.  As of the last: */
	bool dontfork;
	uint32_t unforked;
	struct stretch *unforked_at; /* of DONTFORK_MAX; NULL: there never was any       */
	struct areas areas;
	struct areas foreign; /* of others, too; by what they are, not where        */
	struct areas unkept;  /* beyond the limit, or not writable here; likewise    */
	uint64_t layout;      /* a hash of the mappings when the areas were read */
	uint64_t read_ns, cost_ns;
	uint64_t left_bytes;   /* shared memory beyond the limit                  */
	uint64_t others_bytes; /* and that of others, too                        */
	struct marks advised;  /* what madvise(2) was told, where a restore maps it anew */
	struct marks locked;
	struct marks kinds; /* as mem_image.kinds                              */
	bool special;       /* the same                                        */
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
	struct marks kinds;    /* what a restore has to know of mappings          */
	bool special;          /* it has a vDSO                                   */
	bool whole;            /* everything could be read                        */
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

/* ---- memory_areas.c ---------------------------------------------------------- */

bool areas_add(struct areas *areas, const struct area *area);
/* Room for no more than there is; false: out of memory. */
bool areas_copy(struct areas *to, const struct areas *from);
void areas_free(struct areas *areas);
/* Those beyond MARKS_MAX are not known: of advice that is no harm, and what cannot be mapped
 * again is seen at the restore. */
void marks_add(struct marks *marks, const struct mapping *m, uint32_t flags);
/* Were the areas that were copied those that there are?  Of the long file only as
 * often as it is worth it, and when the layout has changed. */
int areas_check(const struct image *image, struct avc_error *err) warn_unused;
/* A descriptor of that process, open for writing, of what the area is; -1: none. */
int area_find_descriptor(pid_t pid, const struct area *area);

/* ---- memory_wiped.c --------------------------------------------------------- */

/* While the process is stopped. */
void wiped_copy(const struct process *process, struct mem_image *image);
/* Puts it into the template, which is stopped, and forgets it. */
int wiped_fill(const struct image *image, struct setup *setup, struct avc_error *err) warn_unused;
void wiped_free(struct wiped *wiped);

/* ---- memory_others.c -------------------------------------------------------- */

/* Marks those areas that processes outside of the app's PID namespace have, too; `since`: a look
 * that is older is not good enough. */
void others_look(struct mem_others *others, const struct process *process,
		 const struct areas *areas, uint64_t since);
bool others_have(const struct mem_others *others, const struct area *area);
/* From now on it is known whether anybody writes to it as to a file. */
void others_watch(struct mem_others *others, pid_t template, const struct area *area);
/* How often that was known to have happened; the same number: it has not. */
uint32_t others_writes(struct mem_others *others, const struct area *area);

#endif
