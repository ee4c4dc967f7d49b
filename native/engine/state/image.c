/* SPDX-License-Identifier: Apache-2.0
 *
 * Finding the image of a process.
 */
#include <sched.h>

#include "state.h"

/* Parents come first, and the main process shares with none. */
uint32_t image_table_owner(const struct image *image, uint32_t index)
{
	while (image[index].shared & CLONE_FILES)
		index = image[index].parent < 0 ? 0 : (uint32_t)image[index].parent;
	return index;
}

struct image *image_find(struct image *image, uint32_t images, const struct process *process)
{
	for (uint32_t i = 0; i < images; i++)
		if (image[i].process == process)
			return &image[i];
	return NULL;
}
