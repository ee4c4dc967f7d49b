/* SPDX-License-Identifier: Apache-2.0
 *
 * lengthy: the main thread writes far more than fits into a pipe with each write(2), and so waits in
 * that call nearly all the time, for a thread that reads.  Every byte has to arrive once.
 *
 * counter[0]: such writes; counter[1]: those that returned before everything was written
 */
#include <pthread.h>

#include "victim.h"

#define BYTES (1 << 20)
#define READ_BYTES 8192
#define PAUSE_US 200

static int ends[2];
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
	}
	return NULL;
}

int main(int argc, char **argv)
{
	pthread_t reader;

	victim_start(&argc, argv, 0, "");
	for (size_t i = 0; i < BYTES; i++)
		written[i] = (uint8_t)(i * 2654435761U >> 13);
	must(pipe(ends) == 0, "pipe");
	must(pthread_create(&reader, NULL, take, NULL) == 0, "pthread_create");
	victim_ready();
	for (;;) {
		size_t done = 0;

		while (done < BYTES) {
			const ssize_t n = write(ends[1], written + done, BYTES - done);

			CHECK(n > 0, "write: %zd, %s", n, strerror(errno));
			done += (size_t)n;
			if (done < BYTES)
				count(1, 1);
		}
		count(0, 1);
		beat();
	}
}
