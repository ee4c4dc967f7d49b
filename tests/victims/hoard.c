/* SPDX-License-Identifier: Apache-2.0
 *
 * hoard MB [always]: so much memory, all of it written once.  SIGUSR1: writes all
 * of it again at once; SIGUSR2: 1 MB of it every 100 ms, once through; `always`: all
 * of it, all the time, without a pause.  Every write under a checkpoint costs a page
 * more.  counter[0] is how many MB were written again so far.  Beats every 1 ms but
 * while it writes at once.
 */
#include <signal.h>

#include "victim.h"

static volatile sig_atomic_t at_once, slowly;

static void on_signal(int sig)
{
	if (sig == SIGUSR1)
		at_once = 1;
	else
		slowly = 1;
}

int main(int argc, char **argv)
{
	struct sigaction act = { .sa_handler = on_signal, .sa_flags = SA_RESTART };
	volatile uint8_t *memory;
	size_t mb, at = 0, loops = 0;

	victim_start(&argc, argv, 1, "MB");
	mb = (size_t)atol(argv[1]);
	memory = mmap(NULL, mb << 20, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
	must(memory != MAP_FAILED, "mmap");
	for (size_t i = 0; i < mb << 20; i += 4096)
		memory[i] = 1;
	sigaction(SIGUSR1, &act, NULL);
	sigaction(SIGUSR2, &act, NULL);
	victim_ready();
	while (argc > 2) {
		for (size_t i = 0; i < mb; i++) {
			memset((void *)(memory + (i << 20)), (int)++loops, 1 << 20);
			count(0, 1);
			beat();
		}
	}
	for (;;) {
		usleep(1000); /* cut short by the signals above */
		beat();
		if (at_once) {
			at_once = 0;
			for (size_t i = 0; i < mb << 20; i += 4096)
				memory[i]++;
			count(0, mb);
		}
		if (slowly && ++loops % 100 == 0) {
			for (size_t i = 0; i < 1 << 20; i += 4096)
				memory[(at << 20) + i]++;
			count(0, 1);
			if (++at == mb)
				at = 0, slowly = 0;
		}
	}
}
