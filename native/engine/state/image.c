/* SPDX-License-Identifier: Apache-2.0
 *
 * Which image is whose.
 */
#include "state.h"

struct branch *generation_branch(const struct generation *generation, const struct process *process)
{
	for (uint32_t i = 0; generation && i < generation->branches; i++)
		if (generation->branch[i].process == process)
			return &generation->branch[i];
	return NULL;
}
