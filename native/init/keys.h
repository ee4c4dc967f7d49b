/* SPDX-License-Identifier: Apache-2.0
 *
 * Whether Ctrl-C or Ctrl-\ was pressed on the application's terminal.
 *
 * The terminal sends the signal to its foreground group, which is the app's. An app that handles it
 * may exit with any status. So a task of init is in that group, too, and gets the same signals at
 * the same instant (kill_pgrp(), under one lock). The kernel tells whether a signal came from a
 * terminal (SI_KERNEL) or a process.
 *
 * While that task exists, the app's PID is taken (as its process group), so it is killed before a
 * death is reported to the guard.
 */
#ifndef AVCKPT_KEYS_H
#define AVCKPT_KEYS_H

#include <stdint.h>
#include <sys/types.h>

/* Starts the task in the group of the app; returns its PID, 0 on failure. All signals are
 * blocked. */
pid_t keys_listen(pid_t app);
/* That task has exited, and has been reaped. */
void keys_ended(pid_t pid);
/* Kills it; returns the CLOCK_MONOTONIC ns of the last key, 0: never. */
uint64_t keys_pressed(void);

#endif
