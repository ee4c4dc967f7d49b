/* SPDX-License-Identifier: Apache-2.0
 *
 * Signals for a whole process group that the app is in.
 *
 * A task of init is in that group, too, and gets the same signals at the same instant (kill_pgrp(),
 * under one lock).
 *
 *   - Was Ctrl-C or Ctrl-\ pressed on the app's terminal?  It sends the signal to its foreground
 *     group, which is the app's, and an app that handles it may exit with any status.  The kernel
 *     tells whether a signal came from a terminal (SI_KERNEL) or a process.
 *   - Has a unit's program, which is in init's own group, got a signal that init has got?  Then it
 *     was for all, as roslaunch's are, and must not come twice: a second SIGINT interrupts how a
 *     program ends after the first.  Nothing else tells: kill(2) says the same to each of a group.
 *
 * While that task exists, the group's number is taken.  Where that is the app's PID, it is killed
 * before a death is reported to the guard.
 */
#ifndef AVCKPT_KEYS_H
#define AVCKPT_KEYS_H

#include <stdbool.h>
#include <stdint.h>
#include <sys/types.h>

/* Starts the task in that group, 0: in ours; returns its PID, 0 on failure. All signals are
 * blocked. */
pid_t keys_listen(pid_t group);
/* That task has exited, and has been reaped. */
void keys_ended(pid_t pid);
/* Kills it; returns the CLOCK_MONOTONIC ns of the last key, 0: never. */
uint64_t keys_pressed(void);
/* Whether the task is there. */
bool keys_are_heard(void);
/* Whether the task has got a signal of a process, which init has just got, since it was last asked.
 * False, too, if it does not answer; then it is killed. */
bool keys_group_got(int sig);

#endif
