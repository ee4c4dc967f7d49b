/* SPDX-License-Identifier: Apache-2.0
 *
 * Speaks in a guard's place: packets from the file whose descriptor is $RUBBISH (guard_events.c),
 * as the daemon started it: with its socket, and what the daemon sent first in it.
 */
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "avckpt/guard.h"

int main(void)
{
	static uint8_t input[1 << 16];
	const char *number = getenv("RUBBISH");
	const ssize_t size = number ? pread(atoi(number), input, sizeof input, 0) : -1;

	for (ssize_t at = 0; at + 2 <= size;) {
		const uint8_t how = input[at], length = input[at + 1];
		const ssize_t left = size - at - 2, bytes = length < left ? length : left;
		struct avc_event event = { 0 };

		at += 2;
		memcpy(&event, input + at, (size_t)bytes); /* it is longer than a packet can be */
		if (!(how & 1))
			event.cookie = 7;
		if (how & 2)
			memset(&event.error, 'x', sizeof event.error);
		if (how & 4)
			event.error.code = 0;
		if (how & 8)
			(void)send(AVC_GUARD_FD, input + at, (size_t)bytes, MSG_NOSIGNAL);
		else
			(void)send(AVC_GUARD_FD, &event, sizeof event, MSG_NOSIGNAL);
		at += bytes;
	}
	return 0;
}
