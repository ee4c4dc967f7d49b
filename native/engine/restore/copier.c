/* SPDX-License-Identifier: Apache-2.0
 *
 * Copies memory from templates into new processes on a second CPU, while the guard does everything
 * else that they need, and on both when nothing else is left to do.
 *
 * Reads from /proc/PID/mem, not by process_vm_readv(2): that pins pages, and pinning a shared page
 * copies it (mm/gup.c, gup_must_unshare()).  Writes by process_vm_writev(2): /proc/PID/mem copies
 * each page once more, and a written page is unshared anyway.
 */
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdlib.h>
#include <sys/uio.h>
#include <unistd.h>

#include "restore.h"

#define BUFFER_BYTES (256u << 10)
/* The chunk that a thread takes at a time. */
#define CHUNK_BYTES (UINT64_C(2) << 20)
/* Less than this is copied before a thread has been started. */
#define WORTH_BYTES (UINT64_C(1) << 20)

struct chunk {
	uint32_t from; /* index of its source */
	avc_remote start, end;
};

struct source {
	int from, to;
	pid_t template, pid;
};

struct copier {
	pthread_t thread;
	bool started, stop;
	pthread_mutex_t lock;
	pthread_cond_t changed;
	struct source *source;
	uint32_t sources, sources_room;
	struct chunk *chunk;
	uint32_t chunks, chunks_room, next, busy;
	uint8_t *buffer[2]; /* the guard's, the thread's                           */
	struct avc_error error;
};

struct copier *copier_new(struct avc_error *err)
{
	struct copier *copier = calloc(1, sizeof *copier);

	if (copier)
		copier->buffer[0] = malloc(BUFFER_BYTES);
	if (!copier || !copier->buffer[0]) {
		free(copier);
		fail_memory(err, 0, "restore memory");
		return NULL;
	}
	pthread_mutex_init(&copier->lock, NULL);
	pthread_cond_init(&copier->changed, NULL);
	return copier;
}

/* The kernel reports no error when it fails at a page after others. */
static bool is_all(ssize_t done, size_t bytes)
{
	if (done >= 0 && (size_t)done < bytes)
		errno = EIO;
	return done == (ssize_t)bytes;
}

/* Only a tracer may access memory that its owner may not read or write, by /proc/PID/mem
 * (fs/proc/base.c, proc_mem_foll_force()); a kernel may lack the other
 * (CONFIG_CROSS_MEMORY_ATTACH). */
static bool put(const struct source *source, uint8_t *buffer, size_t bytes, avc_remote at,
		bool plain)
{
	const struct iovec here = { buffer, bytes }, there = { (void *)at, bytes };

	return (plain &&
		process_vm_writev(source->pid, &here, 1, &there, 1, 0) == (ssize_t)bytes) ||
	       is_all(pwrite(source->to, buffer, bytes, (off_t)at), bytes);
}

static int copy(const struct source *source, uint8_t *buffer, avc_remote start, avc_remote end,
		bool plain, struct avc_error *err)
{
	for (avc_remote at = start; at < end;) {
		const size_t bytes = end - at < BUFFER_BYTES ? end - at : BUFFER_BYTES;

		if (!is_all(pread(source->from, buffer, bytes, (off_t)at), bytes))
			return fail_errno(err, source->template, "restore memory", "read(mem)",
					  "it cannot be read at %lx", (unsigned long)at);
		if (!put(source, buffer, bytes, at, plain))
			return fail_errno(err, source->pid, "restore memory", "write(mem)",
					  "it cannot be written at %lx", (unsigned long)at);
		at += bytes;
	}
	return 0;
}

/* With the lock held, which is released while it copies. */
static void take_chunk(struct copier *copier, uint8_t *buffer)
{
	const struct chunk chunk = copier->chunk[copier->next++];
	const struct source source = copier->source[chunk.from];
	struct avc_error failed = { 0 };
	int result;

	copier->busy++;
	pthread_mutex_unlock(&copier->lock);
	result = copy(&source, buffer, chunk.start, chunk.end, true, &failed);
	pthread_mutex_lock(&copier->lock);
	copier->busy--;
	if (result && !copier->error.code)
		copier->error = failed;
	pthread_cond_broadcast(&copier->changed);
}

static void *work(void *arg)
{
	struct copier *copier = arg;

	pthread_mutex_lock(&copier->lock);
	while (!copier->stop) {
		if (copier->next < copier->chunks)
			take_chunk(copier, copier->buffer[1]);
		else
			pthread_cond_wait(&copier->changed, &copier->lock);
	}
	pthread_mutex_unlock(&copier->lock);
	return NULL;
}

int copier_open(struct copier *copier, pid_t template, pid_t pid, struct avc_error *err)
{
	struct source source = {
		.from = proc_open(template, "mem", O_RDONLY),
		.to = proc_open(pid, "mem", O_RDWR),
		.template = template,
		.pid = pid,
	};
	int result = 0;

	if (source.from < 0 || source.to < 0)
		result = fail_errno(err, pid, "restore memory", "open(mem)",
				    "it cannot be reached");
	pthread_mutex_lock(&copier->lock);
	if (!result && !make_room(&copier->source, copier->sources, &copier->sources_room,
				  sizeof *copier->source))
		result = fail_memory(err, 0, "restore memory");
	if (!result)
		copier->source[copier->sources++] = source;
	pthread_mutex_unlock(&copier->lock);
	if (result) {
		close_fd(&source.from);
		close_fd(&source.to);
	}
	return result;
}

/* With the lock held. */
static int add_chunks(struct copier *copier, avc_remote start, avc_remote end,
		      struct avc_error *err)
{
	while (start < end) {
		const avc_remote up_to = end - start > CHUNK_BYTES ? start + CHUNK_BYTES : end;

		if (!make_room(&copier->chunk, copier->chunks, &copier->chunks_room,
			       sizeof *copier->chunk))
			return fail_memory(err, 0, "restore memory");
		copier->chunk[copier->chunks++] = (struct chunk){ copier->sources - 1, start,
								  up_to };
		start = up_to;
	}
	return 0;
}

/* Best effort: without a second thread everything is copied by the first. */
static void start(struct copier *copier)
{
	copier->buffer[1] = malloc(BUFFER_BYTES);
	copier->started = copier->buffer[1] &&
			  pthread_create(&copier->thread, NULL, work, copier) == 0;
}

int copier_add(struct copier *copier, avc_remote from, avc_remote to, bool plain,
	       struct avc_error *err)
{
	int result;

	if (!plain || to - from < WORTH_BYTES)
		return copy(&copier->source[copier->sources - 1], copier->buffer[0], from, to,
			    plain, err);
	if (!copier->started)
		start(copier);
	pthread_mutex_lock(&copier->lock);
	result = add_chunks(copier, from, to, err);
	pthread_cond_broadcast(&copier->changed);
	pthread_mutex_unlock(&copier->lock);
	return result;
}

static void close_sources(struct copier *copier)
{
	for (; copier->sources; copier->sources--) {
		close_fd(&copier->source[copier->sources - 1].from);
		close_fd(&copier->source[copier->sources - 1].to);
	}
}

bool copier_help(struct copier *copier)
{
	bool more;

	pthread_mutex_lock(&copier->lock);
	if (copier->next < copier->chunks)
		take_chunk(copier, copier->buffer[0]);
	else if (copier->busy)
		pthread_cond_wait(&copier->changed, &copier->lock);
	more = copier->next < copier->chunks || copier->busy;
	pthread_mutex_unlock(&copier->lock);
	return more;
}

int copier_finish(struct copier *copier, struct avc_error *err)
{
	pthread_mutex_lock(&copier->lock);
	if (copier->error.code)
		*err = copier->error;
	close_sources(copier);
	copier->chunks = copier->next = 0;
	pthread_mutex_unlock(&copier->lock);
	return copier->error.code ? -1 : 0;
}

void copier_free(struct copier *copier)
{
	if (!copier)
		return;
	pthread_mutex_lock(&copier->lock);
	copier->next = copier->chunks; /* cancels what is not begun */
	copier->stop = true;
	pthread_cond_broadcast(&copier->changed);
	pthread_mutex_unlock(&copier->lock);
	if (copier->started)
		pthread_join(copier->thread, NULL);
	close_sources(copier);
	pthread_mutex_destroy(&copier->lock);
	pthread_cond_destroy(&copier->changed);
	free(copier->buffer[0]);
	free(copier->buffer[1]);
	free(copier->source);
	free(copier->chunk);
	free(copier);
}
