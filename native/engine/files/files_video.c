/* SPDX-License-Identifier: Apache-2.0
 *
 * Cameras (V4L2).  Of the buffers that a program has mapped, some are the driver's, to be filled
 * (VIDIOC_QBUF), and the others the program's (VIDIOC_DQBUF). The driver is not rolled back: a
 * buffer that the dead program held would never be filled again, and one that the restored program
 * holds, but has queued since, would be refused (EINVAL).
 *
 * While any process has one of its buffers mapped, a camera is in use, even if it was closed, and
 * opening it again fails (EBUSY). So templates do not keep them mapped, and the restored process
 * maps them again.
 *
 * Which are whose: linux/videodev2.h, V4L2_BUF_FLAG_QUEUED and V4L2_BUF_FLAG_DONE;
 * drivers/media/common/videobuf2/videobuf2-v4l2.c.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <poll.h>
#include <stdlib.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/sysmacros.h>
#include <unistd.h>

#include "files.h"

#define VIDEO4LINUX_MAJOR 81 /* Documentation/admin-guide/devices.txt */

/* The time that a slow camera (five frames a second) takes to fill its buffers; init waits 2 s. */
#define TAKE_NS (1500 * NS_PER_MS)

#define BUFFERS_MAX 64 /* as many as fit the mask; most drivers have 32 */

static const uint32_t types[] = { V4L2_BUF_TYPE_VIDEO_CAPTURE, V4L2_BUF_TYPE_VIDEO_CAPTURE_MPLANE };

struct buffer {
	struct v4l2_buffer v4l2;
	struct v4l2_plane plane[VIDEO_MAX_PLANES];
};

/* The guard's deadline timer interrupts it. */
static int tell(int fd, unsigned long request, void *argument)
{
	int result;

	while ((result = ioctl(fd, request, argument)) && errno == EINTR &&
	       !tracee_deadline_passed())
		;
	return result;
}

static int command(int fd, unsigned long request, struct buffer *b, uint32_t type, uint32_t index)
{
	*b = (struct buffer){ .v4l2 = {
				      .type = type, .index = index, .memory = V4L2_MEMORY_MMAP } };
	if (V4L2_TYPE_IS_MULTIPLANAR(type)) {
		b->v4l2.m.planes = b->plane;
		b->v4l2.length = VIDEO_MAX_PLANES;
	}
	return tell(fd, request, &b->v4l2);
}

bool file_is_video(const struct file *f)
{
	return f->kind == FILE_DEVICE && major(f->rdev) == VIDEO4LINUX_MAJOR &&
	       !(f->flags & O_PATH);
}

/* Any descriptor may query (VIDIOC_QUERYBUF); but only the owner may issue commands, which is
 * checked before the buffer's index. */
static bool is_anothers(int fd, uint32_t type)
{
	struct buffer b;

	return command(fd, VIDIOC_QBUF, &b, type, UINT32_MAX) && errno == EBUSY;
}

static void look_at_buffers(int fd, uint32_t type, struct file_video *video)
{
	struct buffer b;

	for (uint32_t i = 0; i < BUFFERS_MAX; i++) {
		if (command(fd, VIDIOC_QUERYBUF, &b, type, i))
			return;
		video->type = type;
		video->memory = b.v4l2.memory;
		video->count = i + 1;
		if (!(b.v4l2.flags & (V4L2_BUF_FLAG_QUEUED | V4L2_BUF_FLAG_DONE)))
			video->held |= UINT64_C(1) << i;
	}
}

int file_look_at_video(int fd, struct file_video *video)
{
	*video = (struct file_video){ 0 };
	for (size_t i = 0; i < sizeof types / sizeof *types && !video->count; i++)
		look_at_buffers(fd, types[i], video);
	if (video->count && is_anothers(fd, video->type))
		*video = (struct file_video){ 0 };
	return tracee_deadline_passed() ? -1 : 0;
}

static const char *free_buffers(int fd, const struct file_video *now)
{
	struct v4l2_requestbuffers none = { .type = now->type, .memory = now->memory };
	int type = (int)now->type;

	return tell(fd, VIDIOC_STREAMOFF, &type) || tell(fd, VIDIOC_REQBUFS, &none)
		       ? "its buffers could not be freed"
		       : NULL;
}

static const char *give(int fd, uint32_t type, uint64_t buffers)
{
	const char *problem = NULL;
	struct buffer b;

	for (uint32_t i = 0; i < BUFFERS_MAX; i++)
		if (buffers >> i & 1 &&
		    (command(fd, VIDIOC_QUERYBUF, &b, type, i) || tell(fd, VIDIOC_QBUF, &b.v4l2)))
			problem = "not all of its buffers could be given back to the driver";
	return problem;
}

/* Whether there is a frame.  If the driver is busy when the timer interrupts, poll(2) returns
 * POLLERR (vb2_fop_poll()), as it does where there will never be one. */
static bool wait_filled(int fd, uint64_t end_ns)
{
	for (uint64_t ns; (ns = now_ns()) < end_ns;) {
		struct pollfd p = { .fd = fd, .events = POLLIN };
		const int n = poll(&p, 1, (int)((end_ns - ns) / NS_PER_MS) + 1);

		if (n > 0 && p.revents & POLLIN)
			return true;
		if (n > 0)
			usleep(1000);
	}
	return false;
}

/* They are dequeued in the order in which they are filled: unwanted ones are queued again. */
static const char *take(int fd, uint32_t type, uint64_t buffers)
{
	const uint64_t end_ns = now_ns() + TAKE_NS;
	struct buffer b;

	while (buffers) {
		if (!wait_filled(fd, end_ns) || command(fd, VIDIOC_DQBUF, &b, type, 0))
			return "the driver has taken back a buffer that it holds";
		if (buffers >> b.v4l2.index & 1)
			buffers &= ~(UINT64_C(1) << b.v4l2.index);
		else if (give(fd, type, UINT64_C(1) << b.v4l2.index))
			return "a picture could not be given back to the driver";
	}
	return NULL;
}

const char *file_put_video(int fd, const struct file_video *want)
{
	const char *problem;
	struct file_video now;
	int type;

	if (file_look_at_video(fd, &now))
		return "it does not say which buffers are whose";
	if (!want->count)
		return now.count ? free_buffers(fd, &now) : NULL;
	if (now.type != want->type || now.count != want->count)
		return "its buffers have changed";
	problem = give(fd, want->type, now.held & ~want->held);
	/* It had been stopped (VIDIOC_STREAMOFF), which takes all buffers from the driver. */
	type = (int)want->type;
	if (now.held != want->held && now.held == (UINT64_C(2) << (now.count - 1)) - 1 &&
	    tell(fd, VIDIOC_STREAMON, &type))
		problem = "it could not be started again";
	return problem ? problem : take(fd, want->type, want->held & ~now.held);
}

static int note_area(const struct mapping *m, void *arg)
{
	struct files *files = arg;
	struct file_area *more;

	for (uint32_t i = 0; m->shared && i < files->count; i++) {
		const struct file *f = &files->file[i];

		if (!f->video.count || m->inode != f->ino ||
		    m->device != device_number(major(f->dev), minor(f->dev)))
			continue;
		more = realloc(files->area, (files->areas + 1) * sizeof *more);
		if (!more)
			return -1;
		files->area = more;
		files->area[files->areas++] = (struct file_area){
			.start = m->start,
			.bytes = m->end - m->start,
			.offset = m->offset,
			.protection = mapping_protection(m),
			.fd = f->fd,
		};
		return 0;
	}
	return 0;
}

void files_find_areas(struct files *files, pid_t pid)
{
	for (uint32_t i = 0; i < files->count; i++)
		if (files->file[i].video.count) {
			(void)proc_mappings(pid, "maps", note_area, files);
			return;
		}
}

/* Other memory is mapped in their place, so that the addresses stay in use, and if a camera is lost
 * for good, old frames are black instead of causing SIGBUS. */
void files_unmap_areas(const struct image *image)
{
	const struct parasite *parasite = &image->process->parasite;
	struct inj_call *call = &parasite_slot(parasite, image->slot)->template_call;
	const struct files *files = image->files;
	struct avc_error ignored = { 0 };

	for (uint32_t i = 0; i < files->areas;) {
		call_begin(call, INJ_AFTER_PARK);
		for (uint32_t n = 0; i < files->areas && n < INJ_CALLS_MAX; n++, i++)
			call_add(call, SYS_mmap, files->area[i].start, files->area[i].bytes,
				 (uint64_t)files->area[i].protection,
				 MAP_PRIVATE | MAP_ANONYMOUS | MAP_FIXED | MAP_NORESERVE, ~0u);
		if (parasite_send(parasite, image->template, &image->base, call, &ignored) ||
		    parasite_run(image->template, call, &ignored))
			return; /* it was killed, or they are mapped for some time more */
	}
}
