/* SPDX-License-Identifier: Apache-2.0
 *
 * What client.c and server.c say to each other.
 */
#ifndef EXCHANGE_H
#define EXCHANGE_H

#include <stdint.h>

struct request {
	uint64_t number;
	uint64_t sent_ns; /* the client's CLOCK_MONOTONIC */
};

struct reply {
	uint64_t number, sent_ns; /* the request's */
	uint64_t pid;             /* the server's, as it sees itself */
	uint64_t token;           /* drawn when the program started */
	uint64_t served;          /* requests since then, by its memory */
};

#endif
