/* SPDX-License-Identifier: Apache-2.0
 *
 * How every function of libavckpt reports errors.
 *
 * The struct belongs to the caller: nothing is allocated while a target is
 * stopped.  The first error wins; what fails later, while things are being
 * undone, only adds to `undo_failures`.
 */
#ifndef AVCKPT_ERROR_H
#define AVCKPT_ERROR_H

#include <stdint.h>

enum avc_code {
	AVC_OK = 0,
	AVC_GONE = 1,        /* the process (or its container) has ended            */
	AVC_DENIED = 2,      /* a privilege is missing (EPERM, EACCES)              */
	AVC_UNSUPPORTED = 3, /* this process cannot be protected; `detail` is why */
	AVC_BUSY = 4,        /* another process traces or protects it */
	AVC_DEADLINE = 5,    /* not stopped within the freeze deadline              */
	AVC_PROTOCOL = 6,    /* the peer is not a (matching) avckpt-init */
	AVC_CONFIG = 7,      /* a value of struct avc_config is invalid */
	AVC_KERNEL = 8,      /* the kernel refused what it should have allowed */
	AVC_EMPTY = 9,       /* there is no generation to restore from              */
	AVC_LIMIT = 10,      /* a limit, or memory, leaves no room for a process    */
	/* The guard's knowledge of the process was outdated, and has been updated: the next attempt
	 * will succeed. Does not leave the engine. */
	AVC_RETRY = 11
};

struct avc_error {
	int32_t code;           /* enum avc_code                                    */
	int32_t errnum;         /* the errno behind it, 0 if none                   */
	int32_t pid;            /* the process concerned, caller's namespace; 0: none */
	uint32_t undo_failures; /* steps that could not be undone afterwards        */
	char operation[32];     /* what was being done, e.g. "freeze"               */
	char syscall[32];       /* the call that failed, "" if none                 */
	char detail[160];       /* one clause for users */
};

#endif
