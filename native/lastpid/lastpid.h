/* SPDX-License-Identifier: Apache-2.0
 *
 * The protocol between the guard (last_pid.c) and the helper that writes ns_last_pid.
 *
 * The guard starts the helper (lastpid.c, from a sealed memfd) ahead of time, with four
 * descriptors and nothing else.  At a restore it sends the slots whose requests are to be
 * served, one struct lastpid_message after the other, the last one with `go`.
 */
#ifndef AVCKPT_LASTPID_H
#define AVCKPT_LASTPID_H

#include <stdint.h>

enum lastpid_fd {
	LASTPID_SOCKET, /* SOCK_SEQPACKET: messages                               */
	LASTPID_FILE,   /* /proc/sys/kernel/ns_last_pid, open for both            */
	LASTPID_PAGE,   /* a sealed memfd with one struct lastpid_page            */
	LASTPID_INIT,   /* pidfd of the container's avckpt-init                   */
	LASTPID_FDS
};

#define LASTPID_MESSAGE_SLOTS 32
#define LASTPID_SLOTS_MAX 1024 /* one for each process of an app                        */

/* With one descriptor (SCM_RIGHTS) for each slot: the parasite's memory. */
struct lastpid_message {
	uint32_t count, go;
	uint64_t offset[LASTPID_MESSAGE_SLOTS]; /* of the struct inj_slot, a page's   */
};

/* Its end takes time on a CPU, which the app, about to run, may need: it stays until it may go, a second
 * at most. */
enum lastpid_stop { LASTPID_SERVE, LASTPID_STOP, LASTPID_GO };

/* Shared by the two, and accessible to a container that has CAP_SYS_PTRACE: false contents can do
 * no more harm than a failed restore. */
struct lastpid_page {
	uint32_t serving; /* index of the slot whose requests are served           */
	uint32_t stop;    /* futex, enum lastpid_stop                              */
	int32_t error;    /* errno of the last request, 0: done                    */
	uint32_t stopped; /* no more writes */
};

#endif
