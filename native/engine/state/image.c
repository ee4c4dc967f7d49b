/* SPDX-License-Identifier: Apache-2.0
 *
 * Finding the image of a process.
 */
#include "state.h"

struct image *image_find(struct image *image, uint32_t images, const struct process *process)
{
	for (uint32_t i = 0; i < images; i++)
		if (image[i].process == process)
			return &image[i];
	return NULL;
}
