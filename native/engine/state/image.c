/* SPDX-License-Identifier: Apache-2.0
 *
 * Which image is whose.
 */
#include "state.h"

struct image *image_find(struct image *image, uint32_t images, const struct process *process)
{
	for (uint32_t i = 0; i < images; i++)
		if (image[i].process == process)
			return &image[i];
	return NULL;
}
