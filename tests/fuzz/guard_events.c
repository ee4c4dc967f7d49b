/* SPDX-License-Identifier: Apache-2.0
 *
 * A daemon that gets rubbish from a guard.  The guard is rubbish.c, which says what the input says:
 * flags and length of each packet (a byte each), then its bytes.
 */
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdbool.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "avckpt/engine.h"
#include "fuzz.h"

enum { COOKIE = 7, PATIENCE_MS = 15000 };

static const char *rubbish(void)
{
	static char path[4096];
	ssize_t n;
	char *slash;

	if (*path)
		return path;
	n = readlink("/proc/self/exe", path, sizeof path - 16);
	must(n > 0, "/proc/self/exe");
	path[n] = 0;
	slash = strrchr(path, '/');
	strcpy(slash + 1, "rubbish");
	must(access(path, X_OK) == 0, path);
	return path;
}

static void check(const struct avc_event *event)
{
	must(event->cookie == COOKIE, "a guard speaks of its own container");
	must(event->kind >= AVC_EVENT_ATTACHED && event->kind <= AVC_EVENT_WAITS, "its kind");
	must(event->reason >= AVC_REASON_NONE && event->reason <= AVC_REASON_FILTER, "its reason");
	must(event->images >= AVC_IMAGES_FORK && event->images <= AVC_IMAGES_DIRTY, "its images");
	must(event->fork_reason >= AVC_FORK_NONE && event->fork_reason <= AVC_FORK_BUDGET,
	     "why it was forked");
	must(event->again <= (AVC_AGAIN_DROP_INPUT | AVC_AGAIN_STAGGER), "what was changed");
	must(memchr(event->error.detail, 0, sizeof event->error.detail) != NULL, "a clause ends");
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static int input = -1, own;
	const struct avc_config config = { .keep = 1, .init_pidfd = own };
	struct avc_error err;
	struct avc_engine *engine;
	struct avc_guard *guard;
	struct avc_event event;
	struct pollfd news;
	bool over = false;

	if (input < 0) {
		char number[16];

		/* Which rubbish reads; not where its socket will be. */
		input = fcntl(memfd_create("input", MFD_CLOEXEC), F_DUPFD, 10);
		own = (int)syscall(SYS_pidfd_open, getpid(), 0);
		snprintf(number, sizeof number, "%d", input);
		setenv("RUBBISH", number, 1);
		return LLVMFuzzerTestOneInput(data, size);
	}
	must(ftruncate(input, 0) == 0 && pwrite(input, data, size, 0) == (ssize_t)size, "pwrite");
	engine = avc_engine_new(rubbish(), &err);
	must(engine != NULL, "avc_engine_new");
	guard = avc_guard_start(engine, &config, COOKIE, &err);
	must(guard != NULL, "avc_guard_start");
	news = (struct pollfd){ .fd = avc_engine_event_fd(engine), .events = POLLIN };
	/* The fuzzer's own timer interrupts it. */
	while (!over && (poll(&news, 1, PATIENCE_MS) == 1 || errno == EINTR))
		while (avc_engine_next_event(engine, &event)) {
			check(&event);
			over |= event.kind == AVC_EVENT_GUARD_LOST || event.kind == AVC_EVENT_ENDED;
		}
	must(over, "its end is told");
	avc_guard_stop(guard);
	avc_engine_free(engine);
	return 0;
}
