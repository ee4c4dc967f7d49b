/* SPDX-License-Identifier: Apache-2.0
 *
 * The guard's sign of life, in memory that it shares with the daemon (avckpt/guard.h).
 */
#include <sys/mman.h>
#include <sys/stat.h>

#include "avckpt/guard.h"
#include "base.h"

static struct avc_heartbeat *shared;

int heartbeat_open(int fd)
{
	struct stat st;
	void *map;

	if (fstat(fd, &st) || st.st_size < (off_t)sizeof *shared)
		return -1;
	map = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
	close_fd(&fd);
	if (map == MAP_FAILED)
		return -1;
	shared = map;
	return 0;
}

void heartbeat(void)
{
	rt_priority_step();
	if (shared) /* a probe has none */
		__atomic_fetch_add(&shared->beats, 1, __ATOMIC_RELAXED);
}

void heartbeat_rest(uint64_t until_ns)
{
	if (shared)
		__atomic_store_n(&shared->rests_until_ns, until_ns, __ATOMIC_RELAXED);
}
