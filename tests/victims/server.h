/* SPDX-License-Identifier: Apache-2.0
 *
 * A file server of one file (FUSE), which does not answer one program.  If it is slow, it takes a
 * while for each read, into the pages of whoever reads, and each finds other contents.
 */
#ifndef SERVER_H
#define SERVER_H

#include <linux/fuse.h>
#include <sys/mount.h>
#include <sys/stat.h>

#include "victim.h"

#define SERVED_NAME "served"
#define SERVED_BYTES 4096
#define ROOT_INODE 1
#define SERVED_INODE 2
#define SLOW_US 3000

static bool server_is_slow;

static inline struct fuse_attr server_attr(uint64_t inode)
{
	return (struct fuse_attr){
		.ino = inode,
		.size = SERVED_BYTES,
		.mode = inode == ROOT_INODE ? S_IFDIR | 0700 : S_IFREG | 0600,
		.nlink = 1,
		.blksize = SERVED_BYTES,
	};
}

static inline void server_answer(int device, uint64_t unique, int error, const void *data,
				 size_t bytes)
{
	char answer[sizeof(struct fuse_out_header) + SERVED_BYTES];
	const struct fuse_out_header head = {
		.len = (uint32_t)(sizeof head + bytes),
		.error = -error,
		.unique = unique,
	};

	memcpy(answer, &head, sizeof head);
	if (bytes)
		memcpy(answer + sizeof head, data, bytes);
	/* ENOENT: it was interrupted. */
	must(write(device, answer, head.len) == (ssize_t)head.len || errno == ENOENT, "/dev/fuse");
}

static inline bool server_is_asked_by(const struct fuse_in_header *in, const char *program)
{
	char path[48], name[16] = "";
	int comm;

	snprintf(path, sizeof path, "/proc/%u/comm", in->pid);
	comm = open(path, O_RDONLY | O_CLOEXEC);
	if (comm >= 0) {
		must(read(comm, name, sizeof name - 1) >= 0, path);
		close(comm);
	}
	name[strcspn(name, "\n")] = 0;
	return !strcmp(name, program);
}

static inline void server_answer_to(int device, const struct fuse_in_header *in)
{
	static uint64_t content[SERVED_BYTES / sizeof(uint64_t)];
	const struct fuse_init_out init = {
		.major = FUSE_KERNEL_VERSION,
		.minor = FUSE_KERNEL_MINOR_VERSION,
		.max_write = SERVED_BYTES,
	};
	/* Names and attributes do not get old. */
	const struct fuse_entry_out entry = {
		.nodeid = SERVED_INODE,
		.entry_valid = 3600,
		.attr_valid = 3600,
		.attr = server_attr(SERVED_INODE),
	};
	const struct fuse_attr_out attr = {
		.attr_valid = 3600,
		.attr = server_attr(in->nodeid),
	};
	const struct fuse_open_out opened = {
		.fh = 1,
		.open_flags = server_is_slow ? FOPEN_DIRECT_IO : 0,
	};

	switch (in->opcode) {
	case FUSE_INIT:
		server_answer(device, in->unique, 0, &init, sizeof init);
		break;
	case FUSE_LOOKUP:
		server_answer(device, in->unique, 0, &entry, sizeof entry);
		break;
	case FUSE_GETATTR:
	case FUSE_SETATTR:
		server_answer(device, in->unique, 0, &attr, sizeof attr);
		break;
	case FUSE_OPEN:
		server_answer(device, in->unique, 0, &opened, sizeof opened);
		break;
	case FUSE_READ:
		if (server_is_slow)
			nap_us(SLOW_US);
		for (size_t i = 0; server_is_slow && i < sizeof content / sizeof *content; i++)
			content[i]++;
		server_answer(device, in->unique, 0, content, sizeof content);
		break;
	case FUSE_FLUSH:
	case FUSE_RELEASE:
		server_answer(device, in->unique, 0, NULL, 0);
		break;
	case FUSE_FORGET:
	case FUSE_BATCH_FORGET:
	case FUSE_INTERRUPT:
		break;
	default:
		server_answer(device, in->unique, ENOSYS, NULL, 0);
	}
}

/* Mounts it there. */
static inline int server_mount(const char *device_path, const char *path)
{
	const int device = open(device_path, O_RDWR | O_CLOEXEC);
	char options[96];

	if (device < 0)
		unavailable(device_path);
	snprintf(options, sizeof options, "fd=%d,rootmode=40000,user_id=0,group_id=0", device);
	must(mkdir(path, 0700) == 0 && mount("bait", path, "fuse", 0, options) == 0, path);
	return device;
}

static inline void server_serve(int device, const char *unanswered)
{
	static char request[FUSE_MIN_READ_BUFFER + SERVED_BYTES] __attribute__((aligned(8)));
	const struct fuse_in_header *in = (const struct fuse_in_header *)request;
	const ssize_t n = read(device, request, sizeof request);

	if (n > 0 && server_is_asked_by(in, unanswered))
		return;
	if (n > 0)
		server_answer_to(device, in);
	else
		must(errno == EINTR || errno == ENOENT || errno == EAGAIN, "/dev/fuse");
}

#endif
