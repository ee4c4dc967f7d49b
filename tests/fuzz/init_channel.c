/* SPDX-License-Identifier: Apache-2.0
 *
 * What init shows: its control page, and reports.  This process is the init.  First byte: seals,
 * and how long the page is; then the page, then what is in the report pipe.  In the page, numbers
 * of descriptors that would be chance are made ours.
 */
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "avckpt/ctl.h"
#include "fuzz.h"
#include "trace.h"

enum { PIPES = 4 };

static int make_page(const uint8_t *data, size_t size, const int pipes[PIPES], int how)
{
	union {
		struct avc_ctl ctl;
		uint8_t bytes[sizeof(struct avc_ctl)];
	} page = { 0 };
	const int fd = memfd_create(AVC_CTL_NAME, MFD_CLOEXEC | MFD_ALLOW_SEALING);

	must(fd >= 0, "memfd_create");
	memcpy(page.bytes, data, size < sizeof page ? size : sizeof page);
	if (page.ctl.report_fd >= 0)
		page.ctl.report_fd = pipes[page.ctl.report_fd % PIPES];
	if (page.ctl.verdict_fd >= 0)
		page.ctl.verdict_fd = pipes[page.ctl.verdict_fd % PIPES];
	must(write(fd, &page, how & 1 ? sizeof page - 1 : sizeof page) > 0, "write");
	if (how & 2)
		must(fcntl(fd, F_ADD_SEALS, F_SEAL_SHRINK) == 0, "F_ADD_SEALS");
	if (how & 4)
		must(fcntl(fd, F_ADD_SEALS, F_SEAL_FUTURE_WRITE) == 0, "F_ADD_SEALS");
	return fd;
}

static void use(struct init_channel *channel)
{
	struct avc_report report;
	struct avc_error err = { 0 };

	init_channel_arm(channel, true);
	(void)init_channel_app(channel);
	(void)init_channel_stop_asked(channel);
	while (init_channel_report(channel, &report))
		channel->death = report.seq;
	(void)init_channel_verdict(channel, AVC_VERDICT_GIVE_UP, &err);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct init_channel channel;
	struct avc_error err = { 0 };
	int pipes[PIPES], page, how;
	size_t split;

	if (!size)
		return 0;
	how = *data++;
	size--;
	split = size < sizeof(struct avc_ctl) ? size : sizeof(struct avc_ctl);
	must(pipe2(pipes, O_CLOEXEC | O_NONBLOCK) == 0 &&
		     pipe2(pipes + 2, O_CLOEXEC | O_NONBLOCK) == 0,
	     "pipe2");
	if (size > split)
		must(write(pipes[1], data + split, size - split) > 0, "write");
	page = make_page(data, split, pipes, how);
	init_channel_init(&channel);
	channel.init_pidfd = (int)syscall(SYS_pidfd_open, getpid(), 0);
	if (init_channel_open(&channel, &err) == 1) {
		must(how & 2 && !(how & 1), "a page that can shrink is not mapped");
		use(&channel);
	}
	init_channel_close(&channel);
	close(channel.init_pidfd);
	close(page);
	for (int i = 0; i < PIPES; i++)
		close(pipes[i]);
	return 0;
}
