/* SPDX-License-Identifier: Apache-2.0
 *
 * The protocol between the daemon and a guard process (avckpt-guard).
 *
 * The daemon starts one guard per protected container, with one end of a SOCK_SEQPACKET
 * pair as descriptor AVC_GUARD_FD.  Each message is one struct:
 *
 *   daemon to guard   struct avc_request, the first one AVC_REQUEST_START with two
 *                     descriptors (SCM_RIGHTS): the pidfd of avckpt-init, and a memfd that
 *                     holds one struct avc_heartbeat
 *   guard to daemon   struct avc_event (engine.h)
 *
 * End of file tells the guard to stop: it releases the application (which keeps running,
 * unprotected), drops its generations and exits with 0. The same happens when the daemon dies; a
 * restore under way is finished first. End of file tells the daemon that the guard has exited; if
 * unrequested, its status says why.
 *
 * Both are of one build, as `magic` confirms.
 */
#ifndef AVCKPT_GUARD_PROTOCOL_H
#define AVCKPT_GUARD_PROTOCOL_H

#include <stdint.h>

#include "avckpt/engine.h"

#define AVC_GUARD_FD 3
/* Exit status: its own seccomp filter does not let it suspend those that the app has now.  Another
 * one, with avc_config.suspends, can. */
#define AVC_GUARD_HINDERED 5
#define AVC_GUARD_MAGIC                                                     \
	(UINT32_C(0x47560000) + (uint32_t)sizeof(struct avc_request) * 31 + \
	 (uint32_t)sizeof(struct avc_event))

enum avc_request_kind {
	AVC_REQUEST_START = 1,     /* cookie, config                                  */
	AVC_REQUEST_COMMAND = 2,   /* command, ticket, generation                     */
	AVC_REQUEST_CONFIGURE = 3, /* config                                          */
	/* With the memfd of a struct avc_meeting (SCM_RIGHTS).                       */
	AVC_REQUEST_LINE = 4,   /* line, ticket                                       */
	AVC_REQUEST_RECALL = 5, /* line, generation, ticket                           */
};

struct avc_request {
	uint32_t magic;      /* AVC_GUARD_MAGIC                                  */
	uint32_t kind;       /* enum avc_request_kind                            */
	uint32_t command;    /* enum avc_command                                 */
	uint32_t lent;       /* RECALL: it was given real-time priority for it   */
	uint64_t ticket;     /* of the command                                   */
	uint64_t until_ns;   /* CLOCK_MONOTONIC: later it is refused; 0: never too late */
	uint64_t cookie;     /* of the guard's events                            */
	uint64_t generation; /* AVC_COMMAND_RESTORE: which, 0: the newest      */
	uint64_t line;       /* of the group                                     */
	struct avc_config config;
};

/* Shared memory of the guards of a group: a barrier with steps, in order, each taken when all
 * members have arrived at it. `state` is the step that is being gathered for, or
 * AVC_MEETING_BROKEN: a member that cannot continue, or has waited too long, breaks it, and it
 * changes only by compare and exchange, so that all members see the same. So none waits longer than
 * that for one that has died, and what a compromised guard writes here affects only its own
 * group. */
enum {
	AVC_MEETING_STEPS = 4,
	AVC_MEETING_LINES = 64,
	AVC_BOARD_ENDS = 4096,
	AVC_BOARD_BYTES = 32 << 20
};

/* One end of a connection: address and port of TCP, inode of a Unix socket. */
struct avc_end_name {
	uint64_t where; /* inode; or network namespace of a loopback address                    */
	uint8_t address[16];
	uint32_t port, protocol;
};

struct avc_end {
	struct avc_end_name own, other;
	uint64_t written;   /* TCP: bytes that the application has written to it           */
	uint32_t at, bytes; /* in avc_board.content: data in flight to this end             */
};

/* Where guards match the ends of connections.  Readers check the bounds of what they find here. */
struct avc_board {
	uint32_t ends, bytes; /* allocated; may be more than there are                     */
	struct avc_end end[AVC_BOARD_ENDS];
	uint8_t content[AVC_BOARD_BYTES];
};

/* A line that members hold, so that all replace the same one by the next. */
struct avc_held_line {
	uint64_t line;     /* 0: none                                          */
	uint32_t holders;  /* how many members hold it                         */
	uint32_t keepers;  /* of them, those whose health check needs it       */
	uint32_t suspects; /* ... those on probation since a restore from it, or
	                    * from one that it descends from                   */
};

struct avc_meeting {
	uint32_t members; /* how many are expected                            */
	uint32_t state;
	uint32_t arrived[AVC_MEETING_STEPS];
	uint32_t clone_ms; /* expected duration of the slowest member's clone    */
	struct avc_held_line held[AVC_MEETING_LINES];
	struct avc_board board;
};

#define AVC_MEETING_BROKEN UINT32_C(99)

/* Memory shared by daemon and guard.  The guard counts up as long work progresses; before it sleeps
 * it stores until when: AVC_HEARTBEAT_NS at most.  It counts as silent since its last beat, or
 * since it should have woken up, whichever is later. */
struct avc_heartbeat {
	uint64_t beats;
	uint64_t rests_until_ns; /* CLOCK_MONOTONIC; 0: it does not sleep            */
};

#define AVC_HEARTBEAT_NS UINT64_C(3000000000)

#endif
