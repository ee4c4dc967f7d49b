/* SPDX-License-Identifier: Apache-2.0 */
#include <errno.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/eventfd.h>
#include <time.h>
#include <unistd.h>

#include "base.h"

/* Never reads beyond the size of the buffer: names also come from the parasite, where the
 * application may overwrite the terminator. */
static void copy(char *to, size_t size, const char *from)
{
	snprintf(to, size, "%.*s", (int)size - 1, from ? from : "");
}

static int vfail(struct avc_error *err, enum avc_code code, int errnum, pid_t pid,
		 const char *operation, const char *syscall, const char *detail, va_list args)
{
	if (err->code) {
		err->undo_failures++;
		return -1;
	}
	err->code = code;
	err->errnum = errnum;
	err->pid = pid;
	copy(err->operation, sizeof err->operation, operation);
	copy(err->syscall, sizeof err->syscall, syscall);
	vsnprintf(err->detail, sizeof err->detail, detail, args);
	return -1;
}

int fail(struct avc_error *err, enum avc_code code, int errnum, pid_t pid, const char *operation,
	 const char *syscall, const char *detail, ...)
{
	va_list args;

	va_start(args, detail);
	vfail(err, code, errnum, pid, operation, syscall, detail, args);
	va_end(args);
	return -1;
}

bool is_shortage(int errnum)
{
	return errnum == EMFILE || errnum == ENFILE || errnum == ENOMEM;
}

static int lacking; /* the errno; threads that help set it, too */

static void remember(int errnum)
{
	if (is_shortage(errnum))
		__atomic_store_n(&lacking, errnum, __ATOMIC_RELAXED);
}

int got_fd(int fd)
{
	if (fd < 0)
		remember(errno);
	return fd;
}

void *got_memory(void *memory)
{
	if (!memory)
		remember(errno);
	return memory;
}

int got_limited_fd(int fd)
{
	const int errnum = errno;
	int other = fd < 0 && is_shortage(errnum) ? got_fd(eventfd(0, EFD_CLOEXEC)) : -1;

	close_fd(&other);
	errno = errnum;
	return fd;
}

void shortage_begin(void)
{
	__atomic_store_n(&lacking, 0, __ATOMIC_RELAXED);
}

static const char *shortage(int errnum)
{
	switch (errnum) {
	case EMFILE:
		return "its guard may not open any more files";
	case ENFILE:
		return "too many files are open on this machine";
	default:
		return "its guard gets no more memory";
	}
}

int shortage_check(struct avc_error *err, const char *operation)
{
	const int errnum = __atomic_load_n(&lacking, __ATOMIC_RELAXED);

	if (!errnum)
		return 0;
	*err = (struct avc_error){ 0 };
	return fail(err, AVC_KERNEL, errnum, 0, operation, "", "%s", shortage(errnum));
}

int fail_memory(struct avc_error *err, pid_t pid, const char *operation)
{
	remember(ENOMEM);
	return fail(err, AVC_KERNEL, ENOMEM, pid, operation, "malloc", "%s", shortage(ENOMEM));
}

int fail_errno(struct avc_error *err, pid_t pid, const char *operation, const char *syscall,
	       const char *detail, ...)
{
	const int errnum = errno;
	enum avc_code code = AVC_KERNEL;
	va_list args;

	remember(errnum);
	if (is_shortage(errnum))
		return fail(err, code, errnum, pid, operation, syscall, "%s", shortage(errnum));
	/* For a process that has just been reaped, Yama (ptrace_scope 1, as on Ubuntu) returns
	 * EPERM. */
	if (errnum == ESRCH || errnum == ENOENT)
		code = AVC_GONE;
	else if (errnum == EPERM || errnum == EACCES)
		code = pid > 0 && proc_is_exiting(pid) ? AVC_GONE : AVC_DENIED;
	va_start(args, detail);
	vfail(err, code, errnum, pid, operation, syscall, detail, args);
	va_end(args);
	return -1;
}

uint64_t now_ns(void)
{
	return clock_ns(CLOCK_MONOTONIC);
}

uint64_t clock_ns(clockid_t clock)
{
	struct timespec t;

	return clock_gettime(clock, &t) ? 0 : timespec_ns(&t);
}

uint64_t timespec_ns(const struct timespec *t)
{
	return (uint64_t)t->tv_sec * NS_PER_S + (uint64_t)t->tv_nsec;
}

struct timespec timespec_of(uint64_t ns)
{
	return (struct timespec){ .tv_sec = (time_t)(ns / NS_PER_S),
				  .tv_nsec = (long)(ns % NS_PER_S) };
}

int poll_for(struct pollfd *fds, uint32_t count, uint64_t ns)
{
	const uint64_t end = now_ns() + ns;
	int ready;

	do {
		const uint64_t now = now_ns();
		const struct timespec left = timespec_of(now < end ? end - now : 0);

		ready = ppoll(fds, count, &left, NULL);
	} while (ready < 0 && errno == EINTR);
	return ready;
}

void close_fd(int *fd)
{
	if (*fd >= 0)
		close(*fd);
	*fd = -1;
}

ssize_t read_whole(int fd, uint8_t *to, size_t bytes, off_t at)
{
	size_t done = 0;

	while (done < bytes) {
		const ssize_t n = pread(fd, to + done, bytes - done, at + (off_t)done);

		if (n < 0)
			return -1;
		if (n == 0)
			break;
		done += (size_t)n;
	}
	return (ssize_t)done;
}

bool make_room(void *array, uint32_t count, uint32_t *room, size_t bytes)
{
	void *before, *more;
	const uint32_t wanted = *room ? 2 * *room : 16;

	if (count < *room)
		return true;
	memcpy(&before, array, sizeof before);
	more = realloc(before, wanted * bytes);
	if (!more)
		return false;
	memcpy(array, &more, sizeof more);
	*room = wanted;
	return true;
}

uint64_t hash_bytes(uint64_t before, const void *data, size_t bytes)
{
	const uint8_t *p = data;

	for (size_t i = 0; i < bytes; i++)
		before = (before ^ p[i]) * UINT64_C(0x100000001b3); /* FNV-1a */
	return before;
}
