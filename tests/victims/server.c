/* SPDX-License-Identifier: Apache-2.0
 *
 *   server FOLDER [PROGRAM] [--slow]   mounts a file system of its own at FOLDER/mount (server.h),
 *                                      which does not answer processes of that name (avckpt-guard)
 */
#include "server.h"

int main(int argc, char **argv)
{
	char path[512];
	int device;

	server_is_slow = victim_flag(&argc, argv, "--slow");
	victim_start(&argc, argv, 1, "FOLDER");
	snprintf(path, sizeof path, "%s/mount", argv[1]);
	device = server_mount("/dev/fuse", path);
	victim_ready();
	for (;;)
		server_serve(device, argc > 2 ? argv[2] : "avckpt-guard");
}
