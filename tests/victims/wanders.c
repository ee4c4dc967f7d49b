/* SPDX-License-Identifier: Apache-2.0
 *
 * wanders: goes from one directory to the next, with another umask in each, and finds out that
 * it is still there.  counter[0] is how often it has gone.
 */
#include <sys/stat.h>

#include "victim.h"

#define STEP_US 100

int main(int argc, char **argv)
{
	static const char *const folders[] = { "/", "/proc", "/usr", "/dev" };
	static const mode_t masks[] = { 022, 077, 0, 027, 07 };
	char here[64];

	victim_start(&argc, argv, 0, "");
	victim_ready();
	for (unsigned int n = 0;; n++) {
		const char *folder = folders[n % (sizeof folders / sizeof *folders)];
		const mode_t mask = masks[n % (sizeof masks / sizeof *masks)];

		must(!chdir(folder), folder);
		umask(mask);
		nap_us(STEP_US * (n % 32));
		must(getcwd(here, sizeof here) != NULL, "getcwd");
		CHECK(!strcmp(here, folder), "it went to %s and is in %s", folder, here);
		CHECK(umask(mask) == mask, "its umask is not %#o any more", mask);
		count(0, 1);
		beat();
	}
}
