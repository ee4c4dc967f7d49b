/* SPDX-License-Identifier: Apache-2.0
 *
 * Runs a target once for each file that is named: main() where there is no libFuzzer.
 */
#include "fuzz.h"

int main(int argc, char **argv)
{
	static uint8_t data[1 << 20];

	for (int i = 1; i < argc; i++) {
		FILE *file = fopen(argv[i], "re");
		uint8_t *exact;
		size_t size;

		must(file != NULL, argv[i]);
		size = fread(data, 1, sizeof data, file);
		fclose(file);
		printf("%s\n", argv[i]);
		fflush(stdout);
		exact = (uint8_t *)text_of(data, size);
		LLVMFuzzerTestOneInput(exact, size);
		free(exact);
	}
	return 0;
}
