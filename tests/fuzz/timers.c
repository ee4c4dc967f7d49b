/* SPDX-License-Identifier: Apache-2.0
 *
 * /proc/PID/timers.
 */
#include "fuzz.h"
#include "state.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct timers *timers = timers_new();
	char *text = text_of(data, size);

	must(timers != NULL, "there is memory");
	timers_parse(timers, text);
	free(text);
	free(timers);
	return 0;
}
