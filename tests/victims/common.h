/* SPDX-License-Identifier: Apache-2.0
 *
 * What processes have in common: counters in shared memory behind a lock, the
 * offset of an inherited file, the tokens of an eventfd.  Each who takes part
 * knows its own share for itself, so that the two can be compared.
 */
#ifndef COMMON_H
#define COMMON_H

#include <sys/eventfd.h>

#include "family.h"

enum { WORKERS_MAX = 250, SLOTS_MAX = 2048, TOKENS = 5, FILE_WORDS = 4096 };

struct shared {
	pthread_mutex_t lock;
	uint64_t first, second; /* equal whenever the lock is free */
	uint64_t laps;          /* the sum of slot[] */
	uint64_t position;      /* of the file, in words */
	uint64_t tokens_out;
	uint64_t slot[SLOTS_MAX];
	volatile pid_t leader[WORKERS_MAX + 1];
	pid_t group[WORKERS_MAX + 1], session[WORKERS_MAX + 1];
};

static struct shared *shared;

struct party { /* one thread that takes part */
	int slot;
	uint64_t laps, random;
	bool token;
};

static int file_fd, event_fd;

static void make_shared(void)
{
	pthread_mutexattr_t attr;
	char path[] = "/tmp/tree-XXXXXX";
	int i;

	shared = mmap(NULL, sizeof(*shared), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1,
		      0);
	must(shared != MAP_FAILED, "mmap");
	pthread_mutexattr_init(&attr);
	pthread_mutexattr_settype(&attr, PTHREAD_MUTEX_ERRORCHECK);
	pthread_mutexattr_setpshared(&attr, PTHREAD_PROCESS_SHARED);
	must(!pthread_mutex_init(&shared->lock, &attr), "pthread_mutex_init");
	file_fd = mkstemp(path);
	must(file_fd >= 0 && unlink(path) == 0, path);
	for (i = 0; i < FILE_WORDS; i++) {
		const uint64_t word = mix((uint64_t)i, 99);

		must(write(file_fd, &word, sizeof(word)) == sizeof(word), "write");
	}
	must(lseek(file_fd, 0, SEEK_SET) == 0, "lseek");
	event_fd = eventfd(TOKENS, EFD_SEMAPHORE | EFD_NONBLOCK);
	must(event_fd >= 0, "eventfd");
}

static void read_file(void)
{
	const uint64_t word = shared->position % FILE_WORDS;
	const off_t at = lseek(file_fd, 0, SEEK_CUR);
	uint64_t got = 0;

	CHECK(at == (off_t)(word * 8), "the file's offset is %ld, and %lu words were read",
	      (long)at, word);
	CHECK(read(file_fd, &got, 8) == 8 && got == mix(word, 99), "the file's word %lu is %lx",
	      word, got);
	shared->position++;
	if (word + 1 == FILE_WORDS)
		CHECK(lseek(file_fd, 0, SEEK_SET) == 0, "lseek: %s", strerror(errno));
}

/* UINT64_MAX: it could not be read; the open file may be of before a restore. */
static uint64_t tokens_left(void)
{
	char path[48], line[128];
	uint64_t left = UINT64_MAX;
	FILE *file;

	snprintf(path, sizeof(path), "/proc/thread-self/fdinfo/%d", event_fd);
	file = fopen(path, "re");
	while (file && fgets(line, sizeof(line), file))
		if (sscanf(line, "eventfd-count: %lx", &left) == 1)
			break;
	if (file)
		fclose(file);
	return left;
}

static void pass_tokens(struct party *me)
{
	uint64_t n = 1;
	int tries;

	if (me->token) {
		CHECK(write(event_fd, &n, 8) == 8, "a token cannot be given back: %s",
		      strerror(errno));
		shared->tokens_out--;
		me->token = false;
	} else if (shared->tokens_out < TOKENS) {
		CHECK(read(event_fd, &n, 8) == 8 && n == 1, "%lu tokens are out, but: %s",
		      shared->tokens_out, strerror(errno));
		shared->tokens_out++;
		me->token = true;
	}
	if (me->laps % 8 == 0) {
		for (tries = 0; (n = tokens_left()) == UINT64_MAX && tries < 5; tries++)
			;
		CHECK(n == TOKENS - shared->tokens_out, "%lu tokens are out, and %lu are left",
		      shared->tokens_out, n);
	}
}

static void lock_shared(void)
{
	struct timespec at;
	int err, tries = 0;

	/* Many short waits: an old one has run out when it is restored. */
	do {
		clock_gettime(CLOCK_REALTIME, &at);
		at.tv_sec++;
		err = pthread_mutex_timedlock(&shared->lock, &at);
	} while (err == ETIMEDOUT && tries++ < APART_S);
	if (err == ETIMEDOUT)
		came_apart("the lock is not given free; its owner is %d",
			   shared->lock.__data.__owner);
	CHECK(!err, "lock: %s", strerror(err));
}

static void meet(struct party *me)
{
	int err;

	lock_shared();
	CHECK(shared->first == shared->second, "the lock kept nobody out: %lu %lu", shared->first,
	      shared->second);
	shared->first++;
	CHECK(shared->slot[me->slot] == me->laps, "slot %d holds %lu laps, I have made %lu",
	      me->slot, shared->slot[me->slot], me->laps);
	read_file();
	pass_tokens(me);
	me->laps++;
	shared->slot[me->slot] = me->laps;
	shared->laps++;
	shared->second++;
	err = pthread_mutex_unlock(&shared->lock);
	CHECK(!err, "unlock: %s", strerror(err));
}

#endif
