/* SPDX-License-Identifier: Apache-2.0
 *
 * The engine: a bounded queue of events and the descriptor that announces them.
 */
#include <errno.h>
#include <stdlib.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "guard.h"

#define QUEUE_MAX 4096

struct avc_engine {
	pthread_mutex_t lock;
	int event_fd;
	uint32_t first, count;
	struct avc_event queue[QUEUE_MAX];
};

const char *avc_version(void)
{
	return "0.1.0";
}

struct avc_engine *avc_engine_new(struct avc_error *err)
{
	struct avc_engine *engine;

	*err = (struct avc_error){ 0 };
	engine = calloc(1, sizeof *engine);
	if (!engine) {
		fail_errno(err, 0, "start engine", "calloc", "out of memory");
		return NULL;
	}
	engine->event_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
	if (engine->event_fd < 0) {
		fail_errno(err, 0, "start engine", "eventfd", "no descriptor for events");
		free(engine);
		return NULL;
	}
	pthread_mutex_init(&engine->lock, NULL);
	return engine;
}

int avc_engine_event_fd(struct avc_engine *engine)
{
	return engine->event_fd;
}

/* From any guard's thread. */
void engine_emit(struct avc_engine *engine, const struct avc_event *event)
{
	pthread_mutex_lock(&engine->lock);
	if (engine->count == QUEUE_MAX) {
		engine->first = (engine->first + 1) % QUEUE_MAX;
		engine->count--;
	}
	engine->queue[(engine->first + engine->count++) % QUEUE_MAX] = *event;
	eventfd_write(engine->event_fd, 1);
	pthread_mutex_unlock(&engine->lock);
}

int avc_engine_next_event(struct avc_engine *engine, struct avc_event *event)
{
	int found = 0;

	pthread_mutex_lock(&engine->lock);
	if (engine->count) {
		*event = engine->queue[engine->first];
		engine->first = (engine->first + 1) % QUEUE_MAX;
		engine->count--;
		found = 1;
	}
	if (!engine->count) {
		eventfd_t ignored;

		(void)eventfd_read(engine->event_fd, &ignored);
	}
	pthread_mutex_unlock(&engine->lock);
	return found;
}

void avc_engine_free(struct avc_engine *engine)
{
	close(engine->event_fd);
	pthread_mutex_destroy(&engine->lock);
	free(engine);
}
