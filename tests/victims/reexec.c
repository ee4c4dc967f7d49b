/* SPDX-License-Identifier: Apache-2.0
 *
 * reexec MS: executes itself again every MS milliseconds, and beats in between.
 */
#include "victim.h"

int main(int argc, char **argv)
{
	char *again[8] = { argv[0] };
	uint64_t end;

	must(argc < 8, "too many arguments");
	for (int i = 0; i < argc; i++)
		again[i] = argv[i];
	victim_start(&argc, argv, 1, "MS");
	board->starts = 1;
	victim_ready();
	end = now_ns() + (uint64_t)atol(argv[1]) * 1000000;
	while (now_ns() < end) {
		beat();
		nap_us(500);
	}
	count(0, 1);
	execv("/proc/self/exe", again);
	must(false, "execv");
}
