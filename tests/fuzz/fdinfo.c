/* SPDX-License-Identifier: Apache-2.0
 *
 * /proc/PID/fdinfo.  The first byte says of what kind the descriptor is; the text is read twice,
 * as that of one that was known before.
 */
#include "files.h"
#include "fuzz.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct file file = { 0 };

	if (!size)
		return 0;
	file.kind = data[0] % (FILE_PIDFD + 1);
	for (int i = 0; i < 2; i++) {
		char *text = text_of(data + 1, size - 1);

		(void)file_parse_info(&file, text);
		free(text);
		for (uint32_t k = 0; k < file.mark_count; k++)
			must(file.mark[k].handle_bytes <= sizeof file.mark[k].handle,
			     "a handle has room");
	}
	free(file.lock);
	free(file.watch);
	free(file.mark);
	return 0;
}
