/* SPDX-License-Identifier: Apache-2.0
 *
 * rises COPY: gives up root, waits for SIGUSR1 and executes COPY, a set-user-ID copy of itself that
 * belongs to root.  That says who it is, and beats on.
 */
#include "victim.h"

#define NOBODY 65534

static volatile sig_atomic_t asked;

static void on_signal(int signal)
{
	(void)signal;
	asked = 1;
}

static void go_on(void)
{
	char line[64];
	const int n = snprintf(line, sizeof line, "user %d, effectively %d\n", getuid(), geteuid());

	must(write(STDOUT_FILENO, line, (size_t)n) == n, "write");
	for (;;)
		nap_us(1000);
}

int main(int argc, char **argv)
{
	char *const no_environment[] = { NULL };
	char *const risen[] = { "rises", "--risen", NULL };
	int copy;

	if (victim_flag(&argc, argv, "--risen"))
		go_on();
	victim_start(&argc, argv, 1, "COPY");
	copy = open(argv[1], O_PATH | O_CLOEXEC); /* nobody else may look for it */
	must(copy >= 0, argv[1]);
	must(!setresgid(NOBODY, NOBODY, NOBODY) && !setresuid(NOBODY, NOBODY, NOBODY), "setresuid");
	signal(SIGUSR1, on_signal);
	victim_ready();
	while (!asked) {
		usleep(1000); /* cut short by the signal */
		beat();
	}
	syscall(SYS_execveat, copy, "", risen, no_environment, AT_EMPTY_PATH);
	violation("execveat: %s", strerror(errno));
}
