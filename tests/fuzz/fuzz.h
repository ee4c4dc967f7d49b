/* SPDX-License-Identifier: Apache-2.0
 *
 * What the targets share.  A target is one LLVMFuzzerTestOneInput() (libFuzzer's), which must
 * take any bytes; what it may not do, ASan, UBSan or must() says.
 */
#ifndef FUZZ_H
#define FUZZ_H

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static inline void must(int holds, const char *what)
{
	if (holds)
		return;
	fprintf(stderr, "not so: %s\n", what);
	abort();
}

/* The bytes as a string, with nothing behind it. */
static inline char *text_of(const uint8_t *data, size_t size)
{
	char *text = malloc(size + 1);

	must(text != NULL, "there is memory");
	if (size)
		memcpy(text, data, size);
	text[size] = 0;
	return text;
}

#endif
