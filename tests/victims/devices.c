/* SPDX-License-Identifier: Apache-2.0
 *
 * What a vehicle's program has open: a bus, a camera, an input device.
 *
 *   devices SCENARIO FOLDER     see scenario.h
 *
 *   can, buses      CAN sockets (raw, broadcast manager, ISO-TP) on the first CAN interface that
 *                   there is; `buses` closes them after the checkpoint, but for the manager's
 *   cycle           that closes the manager's
 *   camera          a V4L2 capture device of the driver vivid, with its buffers mapped, and the
 *                   same one open a second time; each disturbance ends with a picture taken and
 *                   not given back
 *   holding         the same, and the checkpoint finds it with a picture in its hands
 *   stopped         the camera is stopped after the checkpoint
 *   unused          it is only used after the checkpoint
 *   changed         it is used with other buffers after the checkpoint
 *   left            it is closed after the checkpoint
 *   again           it is closed, and used anew, after the checkpoint
 *   own             it fills memory of the program's own (V4L2_MEMORY_USERPTR)
 *   input           an input device of its own (uinput), and a reader who has it for himself
 */
#include <linux/can/bcm.h>
#include <linux/can/isotp.h>
#include <linux/can/raw.h>
#include <linux/uinput.h>
#include <linux/videodev2.h>
#include <net/if.h>
#include <net/if_arp.h>
#include <poll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>

#include "scenario.h"

/* Descriptors of the CAN scenarios. */
enum { LISTENER, SENDER, CYCLE, ASKS, ANSWERS };

#define WANTED 0x100 /* and what differs in the last four bits */
#define CYCLIC 0x105
#define OTHER 0x300
#define PATIENCE_MS ((int)(5000 * slowness()))

static unsigned int interface(void)
{
	struct if_nameindex *all = if_nameindex();
	const int s = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
	unsigned int found = 0;

	must(all && s >= 0, "if_nameindex");
	for (int i = 0; all[i].if_index && !found; i++) {
		struct ifreq r = { 0 };

		snprintf(r.ifr_name, sizeof r.ifr_name, "%s", all[i].if_name);
		if (ioctl(s, SIOCGIFHWADDR, &r) == 0 && r.ifr_hwaddr.sa_family == ARPHRD_CAN)
			found = all[i].if_index;
	}
	if_freenameindex(all);
	close(s);
	if (!found)
		unavailable("a CAN interface");
	return found;
}

static int can_socket(int type, int protocol, struct sockaddr_can at)
{
	const int s = socket(AF_CAN, type | SOCK_CLOEXEC | SOCK_NONBLOCK, protocol);

	if (s < 0)
		unavailable("socket(AF_CAN)");
	at.can_family = AF_CAN;
	at.can_ifindex = (int)interface();
	if (protocol == CAN_BCM)
		must(connect(s, (struct sockaddr *)&at, sizeof at) == 0, "connect");
	else if (protocol == CAN_RAW)
		must(bind(s, (struct sockaddr *)&at, sizeof at) == 0, "bind");
	return s;
}

static int isotp_socket(canid_t from, canid_t to)
{
	struct sockaddr_can at = { .can_addr.tp = { .tx_id = from, .rx_id = to } };
	const int s = can_socket(SOCK_DGRAM, CAN_ISOTP, at);

	at.can_family = AF_CAN;
	at.can_ifindex = (int)interface();
	must(bind(s, (struct sockaddr *)&at, sizeof at) == 0, "bind of ISO-TP");
	return s;
}

static void can_setup(void)
{
	const struct can_filter filter = { .can_id = WANTED,
					   .can_mask = CAN_EFF_FLAG | CAN_RTR_FLAG | 0x7f0 };
	const int yes = 1;
	struct {
		struct bcm_msg_head head;
		struct can_frame frame;
	} cycle = {
		.head = { .opcode = TX_SETUP,
			  .flags = SETTIMER | STARTTIMER,
			  .ival2 = { 0, 20000 },
			  .can_id = CYCLIC,
			  .nframes = 1 },
		.frame = { .can_id = CYCLIC, .can_dlc = 1, .data = { 42 } },
	};

	fd[LISTENER] = can_socket(SOCK_RAW, CAN_RAW, (struct sockaddr_can){ 0 });
	must(setsockopt(fd[LISTENER], SOL_CAN_RAW, CAN_RAW_FILTER, &filter, sizeof filter) == 0 &&
		     setsockopt(fd[LISTENER], SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &yes, sizeof yes) ==
			     0,
	     "options of the listener");
	fd[SENDER] = can_socket(SOCK_RAW, CAN_RAW, (struct sockaddr_can){ 0 });
	must(setsockopt(fd[SENDER], SOL_CAN_RAW, CAN_RAW_FILTER, NULL, 0) == 0, "no filter");
	must(setsockopt(fd[SENDER], SOL_CAN_RAW, CAN_RAW_FD_FRAMES, &yes, sizeof yes) == 0, "FD");
	fd[CYCLE] = can_socket(SOCK_DGRAM, CAN_BCM, (struct sockaddr_can){ 0 });
	must(write(fd[CYCLE], &cycle, sizeof cycle) == sizeof cycle, "TX_SETUP");
	fd[ASKS] = isotp_socket(0x701, 0x702);
	fd[ANSWERS] = isotp_socket(0x702, 0x701);
}

static void say(canid_t id, uint8_t what)
{
	const struct canfd_frame frame = { .can_id = id, .len = 64, .data = { what } };

	CHECK(write(fd[SENDER], &frame, sizeof frame) == sizeof frame,
	      "the bus does not take %x: %s", id, strerror(errno));
}

/* What is heard next, but for what comes in a cycle, or that where it is asked for. */
static struct canfd_frame hear(bool cyclic)
{
	struct canfd_frame frame;
	struct pollfd p = { .fd = fd[LISTENER], .events = POLLIN };

	do {
		memset(&frame, 0, sizeof frame);
		CHECK(poll(&p, 1, PATIENCE_MS) == 1, "nothing is heard on the bus");
		CHECK(read(fd[LISTENER], &frame, sizeof frame) >= (ssize_t)sizeof(struct can_frame),
		      "the listener: %s", strerror(errno));
	} while ((frame.can_id == CYCLIC) != cyclic);
	return frame;
}

static void silence(void)
{
	while (read(fd[LISTENER], scratch, sizeof scratch) > 0)
		;
}

static void talk(void)
{
	struct pollfd p = { .fd = fd[ANSWERS], .events = POLLIN };
	struct canfd_frame frame;

	silence();
	say(OTHER, 1);
	say(WANTED, 2);
	frame = hear(false);
	CHECK(frame.can_id == WANTED && frame.len == 64 && frame.data[0] == 2,
	      "heard %x with %d instead of %x with 2", frame.can_id, frame.data[0], WANTED);
	frame = hear(true);
	CHECK(frame.data[0] == 42, "the cycle says %d", frame.data[0]);
	memset(scratch, 'm', 500);
	CHECK(write(fd[ASKS], scratch, 500) == 500, "ISO-TP: %s", strerror(errno));
	CHECK(poll(&p, 1, PATIENCE_MS) == 1, "no message comes over ISO-TP");
	CHECK(read(fd[ANSWERS], scratch, sizeof scratch) == 500, "half a message over ISO-TP");
}

/* But for what cannot be made again. */
static void buses_disturb(void)
{
	for (int i = LISTENER; i <= ANSWERS; i++)
		if (i != CYCLE)
			close(fd[i]);
}

static void cycle_disturb(void)
{
	close(fd[CYCLE]);
}

#define BUFFERS 4

static struct {
	uint8_t *at;
	size_t bytes;
} picture[BUFFERS];

static bool xioctl(unsigned long request, void *argument)
{
	return ioctl(fd[0], request, argument) == 0;
}

static struct v4l2_buffer buffer(unsigned int index)
{
	return (struct v4l2_buffer){ .type = V4L2_BUF_TYPE_VIDEO_CAPTURE,
				     .memory = V4L2_MEMORY_MMAP,
				     .index = index };
}

static int open_camera(void)
{
	for (int i = 0; i < 16; i++) {
		struct v4l2_capability can = { 0 };
		char path[32];
		int f;

		snprintf(path, sizeof path, "/dev/video%d", i);
		f = open(path, O_RDWR | O_CLOEXEC);
		if (f < 0)
			continue;
		if (ioctl(f, VIDIOC_QUERYCAP, &can) == 0 && !strcmp((char *)can.driver, "vivid") &&
		    can.device_caps & V4L2_CAP_VIDEO_CAPTURE)
			return f;
		close(f);
	}
	unavailable("a camera of vivid");
}

static uint32_t last; /* picture of this film                                   */

static struct v4l2_buffer take(void)
{
	struct v4l2_buffer b = buffer(0);
	struct pollfd p = { .fd = fd[0], .events = POLLIN };

	/* A busy driver says POLLERR when the call is interrupted. */
	CHECK(poll(&p, 1, PATIENCE_MS) == 1, "no picture comes");
	CHECK(xioctl(VIDIOC_DQBUF, &b), "VIDIOC_DQBUF: %s", strerror(errno));
	CHECK(b.index < BUFFERS && b.bytesused == picture[b.index].bytes, "half a picture");
	CHECK(!last || b.sequence > last, "picture %u after %u", b.sequence, last);
	last = b.sequence;
	/* Bars in colours. */
	CHECK(memcmp(picture[b.index].at, picture[b.index].at + 320, 4), "a picture of nothing");
	return b;
}

static void give_back(struct v4l2_buffer b)
{
	CHECK(xioctl(VIDIOC_QBUF, &b), "VIDIOC_QBUF of %u: %s", b.index, strerror(errno));
}

static void order(unsigned long what)
{
	int type = V4L2_BUF_TYPE_VIDEO_CAPTURE;

	CHECK(xioctl(what, &type), "VIDIOC_STREAM: %s", strerror(errno));
}

static void request(unsigned int count)
{
	struct v4l2_requestbuffers r = { .count = count,
					 .type = V4L2_BUF_TYPE_VIDEO_CAPTURE,
					 .memory = V4L2_MEMORY_MMAP };

	CHECK(xioctl(VIDIOC_REQBUFS, &r) && r.count == count, "VIDIOC_REQBUFS of %u: %s", count,
	      strerror(errno));
}

static void start(void)
{
	struct v4l2_format format = { .type = V4L2_BUF_TYPE_VIDEO_CAPTURE };
	struct v4l2_streamparm rate = { .type = V4L2_BUF_TYPE_VIDEO_CAPTURE };

	CHECK(xioctl(VIDIOC_G_FMT, &format), "VIDIOC_G_FMT: %s", strerror(errno));
	/* Small ones: an emulated machine takes its time to paint a picture. */
	format.fmt.pix.width = 320;
	format.fmt.pix.height = 180;
	CHECK(xioctl(VIDIOC_S_FMT, &format), "VIDIOC_S_FMT: %s", strerror(errno));
	rate.parm.capture.timeperframe = (struct v4l2_fract){ 1, 30 }; /* not five, as usual */
	CHECK(xioctl(VIDIOC_S_PARM, &rate), "VIDIOC_S_PARM: %s", strerror(errno));
	request(BUFFERS);
	for (unsigned int i = 0; i < BUFFERS; i++) {
		struct v4l2_buffer b = buffer(i);

		CHECK(xioctl(VIDIOC_QUERYBUF, &b), "VIDIOC_QUERYBUF: %s", strerror(errno));
		picture[i].bytes = b.length;
		picture[i].at = (uint8_t *)mmap(NULL, b.length, PROT_READ | PROT_WRITE, MAP_SHARED,
						fd[0], b.m.offset);
		CHECK(picture[i].at != MAP_FAILED, "mmap of a picture: %s", strerror(errno));
		give_back(b);
	}
	last = 0;
	order(VIDIOC_STREAMON);
	give_back(take());
}

static void stop(void)
{
	order(VIDIOC_STREAMOFF);
	for (int i = 0; i < BUFFERS; i++)
		munmap(picture[i].at, picture[i].bytes);
	request(0);
}

static void camera_setup(void)
{
	fd[0] = open_camera();
	start();
	fd[1] = open_camera();
}

static void camera_disturb(void)
{
	for (int i = 0; i < 3; i++)
		give_back(take());
	(void)take();
}

static void camera_verify(void)
{
	unsigned int seen = 0;

	for (int i = 0; i < 2 * BUFFERS; i++) {
		const struct v4l2_buffer b = take();

		seen |= 1U << b.index;
		give_back(b);
	}
	CHECK(seen == (1U << BUFFERS) - 1, "of the buffers only %x are filled", seen);
}

static void unused_setup(void)
{
	fd[0] = open_camera();
}

static void stopped_disturb(void)
{
	order(VIDIOC_STREAMOFF);
}

/* Another film: its pictures are counted anew. */
static void stopped_verify(void)
{
	last = 0;
	camera_verify();
}

static void unused_verify(void)
{
	start();
	camera_verify();
	stop();
}

static void changed_disturb(void)
{
	stop();
	request(BUFFERS + 2);
}

static void left_disturb(void)
{
	order(VIDIOC_STREAMOFF);
	for (int i = 0; i < BUFFERS; i++)
		munmap(picture[i].at, picture[i].bytes);
	close(fd[0]);
}

/* It has no buffers, but a program may look at what it thinks are pictures. */
static void left_verify(void)
{
	struct v4l2_buffer b = buffer(0);

	for (int i = 0; i < BUFFERS; i++)
		CHECK(!memchr(picture[i].at, 1, picture[i].bytes), "a picture that was filled");
	CHECK(!xioctl(VIDIOC_DQBUF, &b), "a camera without buffers has filled one");
}

static void again_disturb(void)
{
	left_disturb();
	fd[0] = open_camera();
	start();
}

static void own_setup(void)
{
	struct v4l2_requestbuffers r = { .count = BUFFERS,
					 .type = V4L2_BUF_TYPE_VIDEO_CAPTURE,
					 .memory = V4L2_MEMORY_USERPTR };

	fd[0] = open_camera();
	must(xioctl(VIDIOC_REQBUFS, &r), "VIDIOC_REQBUFS");
}

static struct v4l2_buffer held;

static void holding_setup(void)
{
	camera_setup();
	held = take();
}

static void holding_disturb(void)
{
	give_back(held);
	for (int i = 0; i < 3; i++)
		give_back(take());
}

static void holding_verify(void)
{
	give_back(held);
	camera_verify();
	held = take();
}

static void emit(uint16_t type, uint16_t code, int value)
{
	const struct input_event event = { .type = type, .code = code, .value = value };

	CHECK(write(fd[0], &event, sizeof event) == sizeof event, "uinput: %s", strerror(errno));
}

static void press(void)
{
	struct input_event event;
	struct pollfd p = { .fd = fd[1], .events = POLLIN };

	while (read(fd[1], &event, sizeof event) > 0)
		;
	emit(EV_KEY, KEY_A, 1);
	emit(EV_SYN, SYN_REPORT, 0);
	emit(EV_KEY, KEY_A, 0);
	emit(EV_SYN, SYN_REPORT, 0);
	CHECK(poll(&p, 1, PATIENCE_MS) == 1 && read(fd[1], &event, sizeof event) == sizeof event,
	      "no event comes");
	CHECK(event.type == EV_KEY && event.code == KEY_A && event.value == 1,
	      "event %d, code %d, %d", event.type, event.code, event.value);
}

static void input_setup(void)
{
	const struct uinput_setup setup = { .id.bustype = BUS_VIRTUAL, .name = "avckpt test" };
	char name[64] = "";

	fd[0] = open("/dev/uinput", O_WRONLY | O_NONBLOCK | O_CLOEXEC);
	if (fd[0] < 0)
		unavailable("/dev/uinput");
	must(ioctl(fd[0], UI_SET_EVBIT, EV_KEY) == 0 && ioctl(fd[0], UI_SET_KEYBIT, KEY_A) == 0 &&
		     ioctl(fd[0], UI_DEV_SETUP, &setup) == 0 && ioctl(fd[0], UI_DEV_CREATE) == 0,
	     "uinput");
	for (int tries = 0; tries < 500 && !fd[1]; tries++) {
		const struct timespec pause = { 0, 10000000 };
		char path[64];

		nanosleep(&pause, NULL); /* udev makes it */
		for (int i = 0; i < 32 && !fd[1]; i++) {
			snprintf(path, sizeof path, "/dev/input/event%d", i);
			fd[1] = open(path, O_RDONLY | O_NONBLOCK | O_CLOEXEC);
			if (fd[1] >= 0 && ioctl(fd[1], EVIOCGNAME(sizeof name), name) > 0 &&
			    !strcmp(name, setup.name))
				break;
			if (fd[1] >= 0)
				close(fd[1]);
			fd[1] = 0;
		}
	}
	must(fd[1] > 0, "the input device");
	must(ioctl(fd[1], EVIOCGRAB, 1) == 0, "EVIOCGRAB");
}

static const struct scenario scenarios[] = {
	{ "can", can_setup, talk, talk },
	{ "buses", can_setup, buses_disturb, talk },
	{ "cycle", can_setup, cycle_disturb, nothing },
	{ "camera", camera_setup, camera_disturb, camera_verify },
	{ "holding", holding_setup, holding_disturb, holding_verify },
	{ "stopped", camera_setup, stopped_disturb, stopped_verify },
	{ "unused", unused_setup, start, unused_verify },
	{ "changed", camera_setup, changed_disturb, nothing },
	{ "left", camera_setup, left_disturb, left_verify },
	{ "again", camera_setup, again_disturb, stopped_verify },
	{ "own", own_setup, nothing, nothing },
	{ "input", input_setup, press, press },
};

int main(int argc, char **argv)
{
	play(argc, argv, scenarios, sizeof scenarios / sizeof *scenarios);
}
