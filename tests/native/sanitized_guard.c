/* SPDX-License-Identifier: Apache-2.0
 *
 * sanitized_guard GUARD INIT_PID INTERVAL_MS COMMANDS: the daemon's side, built with ASan and
 * UBSan as the program GUARD is, guards one container, so that a test sees what they find.
 * Prints one word per event; sends COMMANDS checkpoint commands; stops the guard on SIGTERM,
 * frees everything (LeakSanitizer looks at the end, in both) and ends with 0.
 */
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "avckpt/engine.h"

static volatile sig_atomic_t stop;

static void on_term(int signal)
{
	(void)signal;
	stop = 1;
}

static const char *const names[] = { "?",           "attached", "checkpoint", "missed",
				     "unprotected", "died",     "restored",   "gave-up",
				     "ended",       "refused",  "dropped",    "guard-lost" };

int main(int argc, char **argv)
{
	struct avc_config config = { .keep = 3,
				     .shm_bytes = 4 << 20,
				     .restore_on_signal = 1,
				     .restore_on_exit = 1,
				     .restore_max = 64,
				     .restore_window_ns = 1000000000 };
	struct avc_error error;
	struct avc_engine *engine;
	struct avc_guard *guard;
	struct sigaction action = { .sa_handler = on_term };
	struct pollfd news = { .events = POLLIN };
	int ended = 0;

	if (argc != 5)
		return 2;
	sigaction(SIGTERM, &action, NULL);
	setvbuf(stdout, NULL, _IOLBF, 0);
	config.interval_ns = strtoull(argv[3], NULL, 10) * 1000000;
	config.init_pidfd = (int)syscall(SYS_pidfd_open, atoi(argv[2]), 0);
	engine = avc_engine_new(argv[1], &error);
	if (!engine || avc_engine_probe(argv[1], &error))
		goto failed;
	guard = avc_guard_start(engine, &config, 7, &error);
	if (!guard)
		goto failed;
	news.fd = avc_engine_event_fd(engine);
	for (int i = 0; i < atoi(argv[4]); i++)
		if (avc_guard_command(guard, AVC_COMMAND_CHECKPOINT, (uint64_t)i + 1, 0, 0, &error))
			goto failed;
	while (!stop && !ended) {
		struct avc_event event;

		poll(&news, 1, 100);
		while (avc_engine_next_event(engine, &event)) {
			printf("%s %d %s\n", names[event.kind], event.error.code,
			       event.error.detail);
			ended = event.kind == AVC_EVENT_ENDED;
		}
	}
	avc_guard_stop(guard);
	avc_engine_free(engine);
	close(config.init_pidfd);
	return 0;
failed:
	fprintf(stderr, "%s: %s\n", error.operation, error.detail);
	return 1;
}
