/* SPDX-License-Identifier: Apache-2.0
 *
 * lengthy: the main thread writes far more than fits into a pipe with each write(2), and so waits in
 * that call nearly all the time, for a thread that reads.  Every byte has to arrive once.
 *
 * With --hang-up the reader closes each pipe after a part of it: the write returns that, and the next
 * one fails.
 *
 * counter[0]: such writes; counter[1]: those that returned before everything was written
 */
#include <pthread.h>

#include "victim.h"

#define BYTES (1 << 20)
#define READ_BYTES 8192
#define PAUSE_US 200

static int ends[2];
static bool hangs_up;
static uint8_t written[BYTES];

static void *take(void *arg)
{
	static uint8_t got[READ_BYTES];
	size_t at = 0;

	(void)arg;
	for (;;) {
		const ssize_t n = read(ends[0], got, sizeof got);

		CHECK(n > 0, "read: %zd, %s", n, strerror(errno));
		for (ssize_t i = 0; i < n; i++, at = (at + 1) % BYTES)
			CHECK(got[i] == written[at], "another byte came at %zu", at);
		nap_us(PAUSE_US);
		if (hangs_up && at > BYTES / 2) {
			close(ends[0]);
			return NULL;
		}
	}
}

static void begin(void)
{
	pthread_t reader;

	must(pipe(ends) == 0, "pipe");
	must(pthread_create(&reader, NULL, take, NULL) == 0, "pthread_create");
	pthread_detach(reader);
}

static bool write_all(void)
{
	size_t done = 0;

	while (done < BYTES) {
		const ssize_t n = write(ends[1], written + done, BYTES - done);

		if (hangs_up && n < 0 && errno == EPIPE) {
			close(ends[1]);
			return false;
		}
		CHECK(n > 0, "write: %zd, %s", n, strerror(errno));
		done += (size_t)n;
		if (done < BYTES)
			count(1, 1);
	}
	return true;
}

int main(int argc, char **argv)
{
	hangs_up = victim_flag(&argc, argv, "--hang-up");
	victim_start(&argc, argv, 0, "[--hang-up]");
	signal(SIGPIPE, SIG_IGN);
	for (size_t i = 0; i < BYTES; i++)
		written[i] = (uint8_t)(i * 2654435761U >> 13);
	begin();
	victim_ready();
	for (;;) {
		if (!write_all())
			begin();
		count(0, 1);
		beat();
	}
}
