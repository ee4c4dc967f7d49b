/* SPDX-License-Identifier: Apache-2.0
 *
 * What looks like something else to whoever opens it with more rights, or opens it at all.
 *
 *   baits WHAT FOLDER     see scenario.h
 */
#include <pthread.h>
#include <sys/mount.h>
#include <sys/stat.h>
#include <sys/sysmacros.h>

#include "scenario.h"
#include "server.h"

static volatile uint64_t *shared;

static void share(int file)
{
	must(ftruncate(file, 4096) == 0, "ftruncate");
	shared = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
	must(shared != MAP_FAILED, "mmap");
	*shared = 1;
}

static void rewrite(void)
{
	*shared = 2;
}

static void is_not_rolled_back(void)
{
	CHECK(*shared == 2, "a file was written over: %lu", *shared);
	*shared = 1;
}

/* ---- a mount point that another mount covers, with a link by its name -------------------- */

static void mount_at(const char *path)
{
	must((mkdir(path, 0700) == 0 || errno == EEXIST) &&
		     mount("bait", path, "tmpfs", 0, NULL) == 0,
	     path);
}

static void covered_setup(void)
{
	mount_at(path_of("stage"));
	mount_at(path_of("stage/point"));
	mount_at(path_of("stage"));
	must(symlink(folder, path_of("stage/point")) == 0, "symlink");
}

/* ---- leases: opening the file sends SIGIO to whoever has one ----------------------------- */

static void on_broken(int signal)
{
	(void)signal;
	violation("its lease was broken");
}

static void lease(int file)
{
	signal(SIGIO, on_broken);
	must(fcntl(file, F_SETLEASE, F_WRLCK) == 0, "F_SETLEASE");
	fd[0] = file;
}

static void still_leased(void)
{
	CHECK(fcntl(fd[0], F_GETLEASE) == F_WRLCK, "its lease is %d", fcntl(fd[0], F_GETLEASE));
}

static void leased_memory_setup(void)
{
	static const char path[] = "/dev/shm/avckpt-bait";
	const int file = open(path, O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0600);

	must(file >= 0 && unlink(path) == 0, path);
	share(file);
	lease(file);
}

static void leased_file_setup(void)
{
	const int file = make_file("leased", "", O_RDWR);

	share(file);
	lease(file);
}

/* ---- a device: opening one may have an effect -------------------------------------------- */

#define LOOP_MAJOR 7

static void device_setup(void)
{
	const char *path = path_of("bait");
	int file;

	must(mknod(path, S_IFBLK | 0600, makedev(LOOP_MAJOR, 0)) == 0, path);
	file = open(path, O_RDWR | O_CLOEXEC);
	if (file < 0 || mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0) == MAP_FAILED)
		unavailable(path);
	close(file);
}

/* ---- a file that has the name of memory ------------------------------------------------------ */

static void named_setup(void)
{
	char *root = path_of("root"), *old = path_of("root/old");

	mount_at(root);
	must(mkdir(old, 0700) == 0 && syscall(SYS_pivot_root, root, old) == 0, "pivot_root");
	share(open("/memfd:bait", O_RDWR | O_CREAT | O_CLOEXEC, 0600));
}

/* ---- a file server --------------------------------------------------------------------------- */

static int device;

static void *serve(void *arg)
{
	for (;;)
		server_serve(device, "avckpt-guard");
	return arg;
}

static void serve_by(const char *device_path)
{
	pthread_t thread;

	device = server_mount(device_path, path_of("mount"));
	must(pthread_create(&thread, NULL, serve, NULL) == 0, "pthread_create");
}

static void server_setup(void)
{
	serve_by("/dev/fuse");
}

#define MISC_MAJOR 10
#define FUSE_MINOR 229

static void other_server_setup(void)
{
	must(mknod(path_of("bait"), S_IFCHR | 0600, makedev(MISC_MAJOR, FUSE_MINOR)) == 0, "mknod");
	serve_by(path_of("bait"));
}

/* ---- a file on one that does not answer ------------------------------------------------------ */

/* Another descriptor all the time: one that was not there when the guard looked before a freeze. */
static void *duplicate(void *arg)
{
	while (dup(fd[0]) >= 0)
		nap_us(5000);
	return arg;
}

static void served_setup(void)
{
	pthread_t thread;

	fd[0] = open(path_of("mount/" SERVED_NAME), O_RDWR | O_CLOEXEC);
	must(fd[0] >= 0, SERVED_NAME);
	must(pthread_create(&thread, NULL, duplicate, NULL) == 0, "pthread_create");
}

/* By a child, whose mappings are looked at in the freeze. */
static void served_map_setup(void)
{
	pid_t child;

	fd[0] = open(path_of("mount/" SERVED_NAME), O_RDWR | O_CLOEXEC);
	must(fd[0] >= 0, SERVED_NAME);
	child = fork();
	must(child >= 0, "fork");
	if (child == 0) {
		share(fd[0]);
		count(3, 1);
		for (;;)
			pause();
	}
	while (!board->counter[3])
		nap_us(1000);
}

static const struct scenario scenarios[] = {
	{ "covered", covered_setup, nothing, nothing },
	{ "leased-memory", leased_memory_setup, rewrite, still_leased },
	{ "leased-file", leased_file_setup, rewrite, still_leased },
	{ "device", device_setup, nothing, nothing },
	{ "server", server_setup, nothing, nothing },
	{ "other-server", other_server_setup, nothing, nothing },
	{ "served", served_setup, nothing, nothing },
	{ "served-map", served_map_setup, nothing, nothing },
	{ "named", named_setup, rewrite, is_not_rolled_back },
};

int main(int argc, char **argv)
{
	play(argc, argv, scenarios, sizeof scenarios / sizeof *scenarios);
}
