/* SPDX-License-Identifier: Apache-2.0 */
#include "program.h"

#include <errno.h>
#include <limits.h>
#include <paths.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

void program_execute(char *const argv[])
{
	const char *path = getenv("PATH") ? getenv("PATH") : _PATH_DEFPATH;
	char file[PATH_MAX];
	int error = ENOENT;

	if (strchr(argv[0], '/')) {
		execv(argv[0], argv);
		return;
	}
	for (const char *end; argv[0][0] && path; path = *end ? end + 1 : NULL) {
		end = strchrnul(path, ':');
		if (snprintf(file, sizeof(file), "%.*s%s%s", (int)(end - path), path,
			     end > path ? "/" : "", argv[0]) >= (int)sizeof(file))
			continue;
		execv(file, argv);
		if (errno == EACCES)
			error = EACCES; /* unless there is another one */
		else if (errno != ENOENT && errno != ENOTDIR)
			return;
	}
	errno = error;
}
