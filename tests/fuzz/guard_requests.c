/* SPDX-License-Identifier: Apache-2.0
 *
 * A guard that gets rubbish from its socket: a good beginning, whose settings are the input's,
 * and then packets of any length.  Its init is this process, which shows it nothing.
 *
 * Input: kind, flags and length of each packet (a byte each), then its bytes.
 */
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "avckpt/guard.h"
#include "fuzz.h"
#include "guard.h"

static void send_start(int socket, const struct avc_request *request, const int fds[2],
		       size_t count)
{
	union {
		char bytes[CMSG_SPACE(2 * sizeof(int))];
		struct cmsghdr align;
	} control = { { 0 } };
	struct iovec data = { (void *)request, sizeof *request };
	struct msghdr message = { .msg_iov = &data, .msg_iovlen = 1 };
	struct cmsghdr *header;

	if (count) {
		message.msg_control = &control;
		message.msg_controllen = CMSG_SPACE(count * sizeof(int));
		header = CMSG_FIRSTHDR(&message);
		header->cmsg_level = SOL_SOCKET;
		header->cmsg_type = SCM_RIGHTS;
		header->cmsg_len = CMSG_LEN(count * sizeof(int));
		memcpy(CMSG_DATA(header), fds, count * sizeof(int));
	}
	must(sendmsg(socket, &message, 0) == sizeof *request, "sendmsg");
}

static struct avc_request request_of(const uint8_t *bytes, size_t size, uint32_t kind)
{
	struct avc_request request = { 0 };

	memcpy(&request, bytes, size < sizeof request ? size : sizeof request);
	request.magic = AVC_GUARD_MAGIC;
	request.kind = kind;
	return request;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct avc_request request = { 0 };
	int ends[2], fds[2];
	bool begun = false;

	must(socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0, ends) == 0, "socketpair");
	fds[0] = (int)syscall(SYS_pidfd_open, getpid(), 0);
	fds[1] = memfd_create("heartbeat", MFD_CLOEXEC);
	must(fds[0] >= 0 && fds[1] >= 0, "descriptors");
	while (size >= 3) {
		const uint8_t kind = data[0], how = data[1];
		const size_t bytes = data[2] < size - 3 ? data[2] : size - 3;

		data += 3;
		size -= 3;
		request = request_of(data, bytes, begun ? kind % 8 : AVC_REQUEST_START);
		if (!begun) {
			if (how & 1)
				request.config.keep = 1 + request.config.keep % AVC_KEEP_MAX;
			if (how & 2)
				request.config.restore_max %= AVC_RESTORES_MAX + 1;
			if (how & 4)
				request.magic++;
			must(how & 8 || ftruncate(fds[1], sizeof(struct avc_heartbeat)) == 0,
			     "ftruncate");
			/* It ends when it has got too few, and its process with it; here it would
			 * keep them. */
			send_start(ends[0], &request, fds, how & 4 ? 0 : 2);
		} else if (how & 1) {
			(void)send(ends[0], data, bytes, MSG_DONTWAIT | MSG_NOSIGNAL);
		} else {
			(void)send(ends[0], &request, sizeof request - (how & 2 ? 1 : 0),
				   MSG_DONTWAIT | MSG_NOSIGNAL);
		}
		begun = true;
		data += bytes;
		size -= bytes;
	}
	shutdown(ends[0], SHUT_WR);
	(void)guard_run(ends[1]);
	close(ends[0]);
	close(ends[1]);
	close(fds[0]);
	close(fds[1]);
	return 0;
}
