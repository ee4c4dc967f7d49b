/* SPDX-License-Identifier: Apache-2.0
 *
 * How the memory of one process differs from another's: found by remap_plan.c, applied by
 * restore/remap.c.
 */
#ifndef AVCKPT_REMAP_H
#define AVCKPT_REMAP_H

#include <string.h>

#include "checkpoint.h"

#define PAGE ((avc_remote)ARCH_PAGE_BYTES)

/* A range within at most one mapping of each. */
struct piece {
	avc_remote start, end;
	const struct mapping *is, *want; /* NULL: nothing is mapped             */
	bool kept;
};

enum page {
	PAGE_SAME,
	PAGE_COPY,
	PAGE_DROP,
	PAGE_GUARD,    /* becomes a guard page                                   */
	PAGE_OPEN,     /* is one, and must be empty */
	PAGE_OPEN_COPY /* is one, and must be copied */
};

struct run {
	avc_remote start, end;
	enum page what;
	bool plain; /* it may be read and written                           */
};

struct remap {
	const struct process *process;
	struct snapshot *is, *want;
	struct piece *piece;
	uint32_t pieces;
	struct run *run;
	uint32_t runs, room;
};

/* By which it was mapped. */
uint32_t mapping_kind(const struct mapping *m);
bool mapping_same_protection(const struct mapping *a, const struct mapping *b);
const struct mapping *mappings_find(const struct mappings *maps, const char *name);

static inline bool mapping_is_file(const struct mapping *m)
{
	return m->inode != 0;
}

static inline uint32_t mapping_key(const struct mapping *m)
{
	return (m->flags & MAPPING_KEYS) / MAPPING_KEY_ONE;
}

#endif
