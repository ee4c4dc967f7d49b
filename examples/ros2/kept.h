/* SPDX-License-Identifier: Apache-2.0
 *
 * A count that a restore does not take back: how many messages this process has
 * sent, also those that it does not remember.
 *
 * After a restore the middleware's sequence numbers are the checkpoint's, and a
 * peer ignores numbers that it has had before.  kept_forgotten() says how many
 * those are.  Send so many fillers (any valid message, as small as it can be),
 * and the next message is new to the peer:
 *
 *      struct kept kept;
 *      kept_open(&kept);                                 once per writer
 *
 *      for (n = kept_forgotten(&kept); n > 0; n--) {     before each message
 *              kept_count(&kept);
 *              send(filler);
 *      }
 *      kept_count(&kept);
 *      send(message);
 *
 * It works because shared memory whose name begins with "avckpt-kept" is left
 * alone by a restore (docs/fidelity.md), while everything else goes back.  It needs
 * nothing from avckpt, and does nothing without it.  C and C++; one writer, one thread.
 */
#ifndef KEPT_H
#define KEPT_H

#include <stdint.h>
#include <sys/mman.h>
#include <unistd.h>

struct kept {
	volatile uint64_t *sent; /* shared memory: stays */
	uint64_t remembered;     /* goes back with everything else */
};

/* 0, or -1 and errno: memfd_create(2), ftruncate(2), mmap(2). */
static inline int kept_open(struct kept *kept)
{
	const int fd = memfd_create("avckpt-kept", MFD_CLOEXEC);
	void *page = MAP_FAILED;

	if (fd < 0)
		return -1;
	if (ftruncate(fd, sizeof(uint64_t)) == 0)
		page = mmap(NULL, sizeof(uint64_t), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
	close(fd);
	if (page == MAP_FAILED)
		return -1;
	kept->sent = (volatile uint64_t *)page;
	kept->remembered = 0;
	return 0;
}

/* How many messages were sent that this process does not remember; 0: there was no restore. */
static inline uint64_t kept_forgotten(const struct kept *kept)
{
	return *kept->sent > kept->remembered ? *kept->sent - kept->remembered : 0;
}

/* Before a message is given to the middleware: one filler too many is harmless, one too few is not. */
static inline void kept_count(struct kept *kept)
{
	kept->remembered++;
	if (*kept->sent < kept->remembered)
		*kept->sent = kept->remembered;
}

#endif
