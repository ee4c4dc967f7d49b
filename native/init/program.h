/* SPDX-License-Identifier: Apache-2.0
 *
 * A program is executed as the container's runtime would do it: by execvp(3) but for its shell, which
 * reads what the kernel takes for no program (ENOEXEC).
 */
#ifndef AVCKPT_INIT_PROGRAM_H
#define AVCKPT_INIT_PROGRAM_H

/* Returns only if it fails: errno of execve(2); ENOENT: it is in no directory of PATH. */
void program_execute(char *const argv[]);

#endif
