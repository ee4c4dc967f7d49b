/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt-init in two files: init.c is an init; unit.c adds what it does in front of one program
 * below a launcher.
 */
#ifndef AVCKPT_INIT_H
#define AVCKPT_INIT_H

#include <stdbool.h>
#include <stdint.h>
#include <sys/signalfd.h>
#include <sys/types.h>

#define NS_PER_MS UINT64_C(1000000)

uint64_t now_ns(void);
__attribute__((format(printf, 1, 2))) void say(const char *format, ...);
/* Moves a new descriptor above stderr; see there. */
int above_stdio(int fd);

/* ---- unit.c ------------------------------------------------------------------------- */

/* --label and --name make this the init of a unit. False: the value is invalid. */
bool unit_take_label(const char *text);
bool unit_take_name(const char *text);
/* Whether it is to be one: it was given a label or a name, or, for a container's launcher,
 * AVCKPT_INIT in the environment. */
bool unit_is_wanted(void);
/* Finds the sidecar's socket. False: there is none, which has been reported. */
bool unit_begin(const char *program);
/* Makes the environment of the program that of a unit. */
void unit_mark_environment(void);
/* The connection to the sidecar, which closes it when it exits; -1: there is none. */
int unit_fd(void);
/* When unit_tend() is due without any input; UINT64_MAX: never. */
uint64_t unit_due_ns(void);
/* Connects when it is time to, and reads the sidecar's answer. */
void unit_tend(const char *program);
/* Kills those children that belong to avckpt, because the launcher must not inherit them. */
void unit_end_templates(void);
/* Exits as the program did, also by a signal. */
_Noreturn void unit_finish(int status);

#endif
