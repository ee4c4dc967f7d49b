/* SPDX-License-Identifier: Apache-2.0
 *
 * The protocol between avckpt-init and the guard (avckpt-guard, one process for each container).
 *
 * init creates, before it starts the app:
 *   - a memfd named AVC_CTL_NAME that holds one struct avc_ctl.  The guard
 *     finds it in /proc/INIT/fd by its name, maps it, and takes flock(2)
 *     LOCK_EX|LOCK_NB on a description of its own: one guard per container.
 *   - the report pipe (init keeps both ends, O_NONBLOCK; the guard opens the
 *     read end through /proc/INIT/fd): one struct avc_report per death.
 *   - the verdict pipe (init keeps the read end *only*; the guard opens it for
 *     writing through /proc/INIT/fd): one struct avc_verdict per report.  A
 *     guard that dies closes the only write end, init's poll(2) says POLLHUP,
 *     and init ends with the app's status at once.
 *
 * Every message is shorter than PIPE_BUF, so a write is all or nothing.
 * PIDs in here are those of init's own PID namespace.
 */
#ifndef AVCKPT_CTL_H
#define AVCKPT_CTL_H

#include <stdint.h>

#define AVC_CTL_NAME "avckpt-ctl"
#define AVC_CTL_MAGIC UINT64_C(0x314c544354504b43) /* "CKPTCTL1" in memory */
#define AVC_CTL_VERSION 1

/* How long init waits for a verdict from a guard that lives but is silent. */
#define AVC_CTL_WAIT_MS_DEFAULT 2000

/* If a stop was requested less than this long ago, the app's exit is final. */
#define AVC_CTL_STOP_MS 60000

struct avc_ctl {
	uint64_t magic;   /* AVC_CTL_MAGIC, written last by init               */
	uint32_t version; /* AVC_CTL_VERSION                                   */
	int32_t init_pid;
	int32_t app_pid;    /* the app's main process; 0 until it is started */
	int32_t report_fd;  /* init's number of the report pipe's read end       */
	int32_t verdict_fd; /* init's number of the verdict pipe's read end      */
	uint32_t wait_ms;   /* how long init waits for a verdict */
	/* Written by the guard: 1 while at least one generation is held. With 0 init does not ask,
	 * and exits with the app's status. */
	uint32_t armed;
	/* Written by init: CLOCK_MONOTONIC ns when a stop was forwarded to the app last, 0 if
	 * never. The guard takes no checkpoint for AVC_CTL_STOP_MS after it: an app that is
	 * shutting down makes no useful image. */
	uint64_t stop_asked_ns;
	/* Written by init: errno if exec of the app failed, else 0. */
	int32_t exec_errno;
	/* Written by init: 1 if there may be other avckpt-inits in its PID namespace. */
	int32_t is_unit;
	/* Written by init: its child that watches the keys of a terminal, 0: none. It does not
	 * belong to the app, and is killed before a death is reported. */
	int32_t keys_pid;
};

enum avc_report_kind { AVC_REPORT_DEATH = 1 };

enum avc_report_flag {
	AVC_REPORT_STOP_ASKED = 1 /* the app was asked to stop: this exit is final */
};

struct avc_report {
	uint32_t kind;  /* enum avc_report_kind                              */
	uint32_t seq;   /* of this death, from 1                             */
	int32_t pid;    /* of the dead app                                   */
	int32_t status; /* as from waitpid(2)                                */
	uint32_t flags; /* enum avc_report_flag                              */
	uint32_t reserved;
	uint64_t reaped_ns; /* CLOCK_MONOTONIC just after waitpid(2) returned    */
};

enum avc_verdict_kind {
	AVC_VERDICT_RESTORED = 1, /* the app exists again under the same PID; written before it
	                           * runs */
	AVC_VERDICT_GIVE_UP = 2,  /* end with the app's status                   */
	AVC_VERDICT_WORKING = 3   /* none yet: wait for another wait_ms */
};

struct avc_verdict {
	uint32_t seq;  /* of the report it answers                               */
	uint32_t kind; /* enum avc_verdict_kind                                  */
};

#endif
