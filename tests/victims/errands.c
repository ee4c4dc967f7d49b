/* SPDX-License-Identifier: Apache-2.0
 *
 * errands: a process that gives numbered errands to its child through a pipe, each once the
 * one before is done.  For HOLD_MS one waits in the pipe (counter 0 is 1), then the child waits
 * for one (counter 0 is 2), and so on.  Counter 1: errands done.
 */
#include <poll.h>
#include <signal.h>

#include "victim.h"

enum { HOLD_MS = 400, STEP_MS = 10, PATIENCE_MS = 5000, IN_PIPE = 1, CHILD_WAITS = 2 };

static _Noreturn void run_errands(int from, int to)
{
	uint64_t n, done;

	for (done = 0;; done = n) {
		if (done % 2 == 0)
			nap_us(HOLD_MS * 1000);
		/* Without a parent it is only waiting for its own end. */
		while (read(from, &n, sizeof(n)) != sizeof(n))
			pause();
		CHECK(n == done + 1, "errand %lu after %lu", n, done);
		must(write(to, &n, sizeof(n)) == sizeof(n), "write");
	}
}

static void hold(uint64_t what)
{
	board->counter[0] = what;
	for (int ms = 0; ms < HOLD_MS; ms += STEP_MS) {
		nap_us(STEP_MS * 1000);
		beat();
	}
	board->counter[0] = 0;
}

static void await_answer(int from, uint64_t n)
{
	struct pollfd answer = { .fd = from, .events = POLLIN };
	uint64_t said;
	int ms = 0;

	while (poll(&answer, 1, STEP_MS) == 0) {
		beat();
		ms += STEP_MS;
		CHECK(ms < PATIENCE_MS * (int)slowness(), "errand %lu was never run", n);
	}
	CHECK(read(from, &said, sizeof(said)) == sizeof(said) && said == n,
	      "errand %lu: the answer is %lu", n, said);
}

int main(int argc, char **argv)
{
	int orders[2], answers[2];

	victim_start(&argc, argv, 0, "");
	must(!pipe(orders) && !pipe(answers), "pipe");
	switch (fork()) {
	case -1:
		must(false, "fork");
		break;
	case 0:
		close(orders[1]);
		close(answers[0]);
		run_errands(orders[0], answers[1]);
	}
	close(orders[0]);
	close(answers[1]);
	victim_ready();
	for (uint64_t n = 1;; n++) {
		if (n % 2 == 0)
			hold(CHILD_WAITS);
		must(write(orders[1], &n, sizeof(n)) == sizeof(n), "write");
		if (n % 2)
			hold(IN_PIPE);
		await_answer(answers[0], n);
		count(1, 1);
	}
}
