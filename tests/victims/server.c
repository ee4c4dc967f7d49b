/* SPDX-License-Identifier: Apache-2.0
 *
 *   server FOLDER     mounts a file system of its own at FOLDER/mount (server.h)
 */
#include "server.h"

int main(int argc, char **argv)
{
	char path[512];
	int device;

	victim_start(&argc, argv, 1, "FOLDER");
	snprintf(path, sizeof path, "%s/mount", argv[1]);
	device = server_mount("/dev/fuse", path);
	victim_ready();
	for (;;)
		server_serve(device);
}
