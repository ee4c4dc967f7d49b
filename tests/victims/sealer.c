/* SPDX-License-Identifier: Apache-2.0
 *
 * sealer MB: at SIGUSR1 it seals one more page of a mapping (mseal(2)).  It checks that it cannot
 * make those that it has sealed read-only.
 *
 * counter 0: how many are sealed.
 */
#include "victim.h"

enum { PAGE = 4096, PAGES = 256 };

int main(int argc, char **argv)
{
	const struct timespec nap = { 0, 1000000 };
	size_t bytes, sealed = 0;
	char *pages;
	sigset_t usr1;

	sigemptyset(&usr1);
	sigaddset(&usr1, SIGUSR1);
	sigprocmask(SIG_BLOCK, &usr1, NULL);
	victim_start(&argc, argv, 1, "MB");
	bytes = (size_t)atoi(argv[1]) << 20;
	memset(victim_memory(bytes, false), 1, bytes);
	pages = victim_memory((size_t)PAGES * PAGE, false);
	victim_ready();
	for (;;) {
		if (sealed < PAGES && sigtimedwait(&usr1, NULL, &nap) == SIGUSR1) {
			if (syscall(462 /* SYS_mseal */, pages + sealed * PAGE, PAGE, 0))
				unavailable("mseal");
			sealed++;
		}
		board->counter[0] = sealed;
		for (size_t i = 0; i < sealed; i++)
			CHECK(mprotect(pages + i * PAGE, PAGE, PROT_READ) && errno == EPERM,
			      "page %zu of %zu is not sealed", i, sealed);
		beat();
	}
}
