/* SPDX-License-Identifier: Apache-2.0
 *
 * Whether somebody has pressed Ctrl-C or Ctrl-\ on the application's terminal.
 *
 * The terminal sends the signal to its foreground group, and that is the app's alone.  An app that
 * handles it by ending in its own way ends with any status.  So a task of init's is in that
 * group, too, and gets the same signals at the same instant (kill_pgrp(), under one lock).  The
 * kernel says of a signal whether a terminal has sent it (SI_KERNEL) or a process.
 *
 * As long as there is that task, the app's number is taken (it is the group's), so it is ended
 * before the guard hears of a death.
 */
#ifndef AVCKPT_KEYS_H
#define AVCKPT_KEYS_H

#include <stdint.h>
#include <sys/types.h>

/* Begins to listen in the group of the app: the task's number, 0 if that cannot be done.  All
 * signals are blocked. */
pid_t keys_listen(pid_t app);
/* That task has ended, and has been waited for. */
void keys_ended(pid_t pid);
/* Ends it: CLOCK_MONOTONIC ns when a key was pressed last, 0: never. */
uint64_t keys_pressed(void);

#endif
