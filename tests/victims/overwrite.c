/* SPDX-License-Identifier: Apache-2.0
 *
 * overwrite: tries to write avckpt's code in it: through a mapping that it makes writable, through
 * /proc/self/mem, and by taking the pages away.
 *
 * counter[0] says that it has tried; counter[1..3] are what the kernel answered (errno), 0 where it
 * was let.
 */
#include "parasite_place.h"

static uint64_t answer(bool worked)
{
	return worked ? 0 : (uint64_t)errno;
}

int main(int argc, char **argv)
{
	volatile uint8_t *last;
	struct place place;
	uint8_t byte;
	int mem;

	victim_start(&argc, argv, 0, "");
	mem = open("/proc/self/mem", O_RDWR | O_CLOEXEC);
	must(mem >= 0, "/proc/self/mem");
	victim_ready();
	place = await_parasite();
	last = (uint8_t *)place.start + INJ_CODE_BYTES - 1; /* behind the code itself */
	byte = *last;
	count(1, answer(mprotect((void *)place.start, INJ_CODE_BYTES,
				 PROT_READ | PROT_WRITE | PROT_EXEC) == 0));
	if (board->counter[1] == 0)
		*last = (uint8_t)~byte;
	count(2, answer(pwrite(mem, &byte, 1, (off_t)(uintptr_t)last) == 1));
	count(3, answer(madvise((void *)place.start, INJ_CODE_BYTES, MADV_REMOVE) == 0));
	count(0, 1);
	for (;;) {
		usleep(5000);
		beat();
	}
}
