/* SPDX-License-Identifier: Apache-2.0
 *
 * In a guard that was built with -fsanitize=thread, but linked with this in place of that library:
 * dies before one of its system calls that may change something, or before one of its stores to
 * memory that it shares with the application or with init.  Before which, two numbers in the file
 * AVCKPT_STEPS say, of calls and of stores: they are counted down, 0: before none.  The compiler tells of
 * each store of the guard's (__tsan_write*), and the linker of its calls, memcpy(3) and the like
 * (--wrap).  What the kernel writes to that memory is of a system call.
 *
 * No tracer could do it: each call would take so long that the application comes too late.
 */
#include <fcntl.h>
#include <sched.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

#define AREAS_MAX 256
#define HEARTBEAT_BYTES 16 /* struct avc_heartbeat, which only the daemon reads        */

enum step { CALL, STORE, STEPS };

static struct {
	uintptr_t start, end;
} areas[AREAS_MAX];
static unsigned int count;
static int64_t *left; /* in the file; NULL: not mapped yet                       */
static pid_t guard;

void *__real_mmap(void *at, size_t bytes, int prot, int flags, int fd, off_t offset);
int __real_close(int fd);
long __real_syscall(long nr, ...);

static bool map_left(void)
{
	const char *path = getenv("AVCKPT_STEPS");
	const int fd = path ? open(path, O_RDWR | O_CLOEXEC) : -1;
	void *map = fd < 0 ? MAP_FAILED
			   : __real_mmap(NULL, STEPS * sizeof *left, PROT_READ | PROT_WRITE,
					 MAP_SHARED, fd, 0);

	if (fd >= 0)
		__real_close(fd);
	if (map != MAP_FAILED)
		left = map;
	guard = getpid();
	return left;
}

/* Not in what it forks. */
static void step(enum step what)
{
	if ((left || map_left()) && left[what] > 0 && getpid() == guard && --left[what] == 0)
		__real_syscall(SYS_kill, guard, SIGKILL);
}

static void hit(const volatile void *at)
{
	const uintptr_t where = (uintptr_t)at;

	for (unsigned int i = 0; i < count; i++)
		if (where >= areas[i].start && where < areas[i].end) {
			step(STORE);
			return;
		}
}

#define WRAP(type, name, parameters, arguments) \
	type __real_##name parameters;          \
	type __wrap_##name parameters;          \
	type __wrap_##name parameters           \
	{                                       \
		step(CALL);                     \
		return __real_##name arguments; \
	}

WRAP(int, close, (int fd), (fd))
WRAP(ssize_t, write, (int fd, const void *from, size_t bytes), (fd, from, bytes))
WRAP(ssize_t, pwrite, (int fd, const void *from, size_t bytes, off_t at), (fd, from, bytes, at))
WRAP(ssize_t, process_vm_writev,
     (pid_t pid, const struct iovec *from, unsigned long n, const struct iovec *to, unsigned long m,
      unsigned long flags),
     (pid, from, n, to, m, flags))
WRAP(int, setsockopt, (int fd, int level, int option, const void *value, socklen_t bytes),
     (fd, level, option, value, bytes))
WRAP(ssize_t, sendmsg, (int fd, const struct msghdr *message, int flags), (fd, message, flags))
WRAP(int, epoll_ctl, (int epoll, int what, int fd, struct epoll_event *event),
     (epoll, what, fd, event))
WRAP(int, kill, (pid_t pid, int signal), (pid, signal))
WRAP(int, prlimit, (pid_t pid, int which, const struct rlimit *limit, struct rlimit *old),
     (pid, which, limit, old))
WRAP(int, sched_setscheduler, (pid_t pid, int policy, const struct sched_param *param),
     (pid, policy, param))

/* A variadic function may read arguments that were not passed: they are in registers. */
static void take(va_list from, long *arg, int n)
{
	for (int i = 0; i < n; i++)
		arg[i] = va_arg(from, long);
}

int __real_ioctl(int fd, unsigned long request, ...);
int __wrap_ioctl(int fd, unsigned long request, ...);
int __wrap_ioctl(int fd, unsigned long request, ...)
{
	long arg[1];
	va_list list;

	step(CALL);
	va_start(list, request);
	take(list, arg, 1);
	va_end(list);
	return __real_ioctl(fd, request, arg[0]);
}

int __real_fcntl(int fd, int command, ...);
int __wrap_fcntl(int fd, int command, ...);
int __wrap_fcntl(int fd, int command, ...)
{
	long arg[1];
	va_list list;

	step(CALL);
	va_start(list, command);
	take(list, arg, 1);
	va_end(list);
	return __real_fcntl(fd, command, arg[0]);
}

long __real_ptrace(int request, ...);
long __wrap_ptrace(int request, ...);
long __wrap_ptrace(int request, ...)
{
	long arg[3];
	va_list list;

	step(CALL);
	va_start(list, request);
	take(list, arg, 3);
	va_end(list);
	return __real_ptrace(request, arg[0], arg[1], arg[2]);
}

long __wrap_syscall(long nr, ...);
long __wrap_syscall(long nr, ...)
{
	long arg[6];
	va_list list;

	if (nr != SYS_futex) /* a wait, as often as it takes */
		step(CALL);
	va_start(list, nr);
	take(list, arg, 6);
	va_end(list);
	return __real_syscall(nr, arg[0], arg[1], arg[2], arg[3], arg[4], arg[5]);
}

void *__wrap_mmap(void *at, size_t bytes, int prot, int flags, int fd, off_t offset);
void *__wrap_mmap(void *at, size_t bytes, int prot, int flags, int fd, off_t offset)
{
	void *map;

	step(CALL);
	map = __real_mmap(at, bytes, prot, flags, fd, offset);
	if (map != MAP_FAILED && flags & MAP_SHARED && prot & PROT_WRITE && fd >= 0 &&
	    bytes > HEARTBEAT_BYTES && count < AREAS_MAX) {
		areas[count].start = (uintptr_t)map;
		areas[count++].end = (uintptr_t)map + bytes;
	}
	return map;
}

int __real_munmap(void *at, size_t bytes);
int __wrap_munmap(void *at, size_t bytes);
int __wrap_munmap(void *at, size_t bytes)
{
	step(CALL);
	for (unsigned int i = 0; i < count; i++)
		if (areas[i].start >= (uintptr_t)at && areas[i].start < (uintptr_t)at + bytes)
			areas[i].end = areas[i].start;
	return __real_munmap(at, bytes);
}

void *__real_memcpy(void *to, const void *from, size_t bytes);
void *__wrap_memcpy(void *to, const void *from, size_t bytes);
void *__wrap_memcpy(void *to, const void *from, size_t bytes)
{
	hit(to);
	return __real_memcpy(to, from, bytes);
}

void *__real_memmove(void *to, const void *from, size_t bytes);
void *__wrap_memmove(void *to, const void *from, size_t bytes);
void *__wrap_memmove(void *to, const void *from, size_t bytes)
{
	hit(to);
	return __real_memmove(to, from, bytes);
}

void *__real_memset(void *to, int byte, size_t bytes);
void *__wrap_memset(void *to, int byte, size_t bytes);
void *__wrap_memset(void *to, int byte, size_t bytes)
{
	hit(to);
	return __real_memset(to, byte, bytes);
}

#define NOTHING(name)       \
	void name(void *);  \
	void name(void *at) \
	{                   \
		(void)at;   \
	}
#define WRITE(name)         \
	void name(void *);  \
	void name(void *at) \
	{                   \
		hit(at);    \
	}
#define SIZES(macro, name) \
	macro(name##1) macro(name##2) macro(name##4) macro(name##8) macro(name##16)

SIZES(NOTHING, __tsan_read)
SIZES(NOTHING, __tsan_unaligned_read)
SIZES(NOTHING, __tsan_volatile_read)
SIZES(NOTHING, __tsan_unaligned_volatile_read)
SIZES(WRITE, __tsan_write)
SIZES(WRITE, __tsan_unaligned_write)
SIZES(WRITE, __tsan_volatile_write)
SIZES(WRITE, __tsan_unaligned_volatile_write)

void __tsan_init(void);
void __tsan_init(void)
{
}

void __tsan_func_entry(void *);
void __tsan_func_entry(void *caller)
{
	(void)caller;
}

void __tsan_func_exit(void);
void __tsan_func_exit(void)
{
}

void __tsan_read_range(void *, size_t);
void __tsan_read_range(void *at, size_t bytes)
{
	(void)at;
	(void)bytes;
}

void __tsan_write_range(void *, size_t);
void __tsan_write_range(void *at, size_t bytes)
{
	(void)bytes;
	hit(at);
}

#define ATOMIC(bits)                                                                             \
	uint##bits##_t __tsan_atomic##bits##_load(const volatile uint##bits##_t *at, int order); \
	uint##bits##_t __tsan_atomic##bits##_load(const volatile uint##bits##_t *at, int order)  \
	{                                                                                        \
		(void)order;                                                                     \
		return __atomic_load_n(at, __ATOMIC_SEQ_CST);                                    \
	}                                                                                        \
	void __tsan_atomic##bits##_store(volatile uint##bits##_t *at, uint##bits##_t v, int o);  \
	void __tsan_atomic##bits##_store(volatile uint##bits##_t *at, uint##bits##_t v, int o)   \
	{                                                                                        \
		(void)o;                                                                         \
		hit(at);                                                                         \
		__atomic_store_n(at, v, __ATOMIC_SEQ_CST);                                       \
	}                                                                                        \
	uint##bits##_t __tsan_atomic##bits##_exchange(volatile uint##bits##_t *at,               \
						      uint##bits##_t v, int o);                  \
	uint##bits##_t __tsan_atomic##bits##_exchange(volatile uint##bits##_t *at,               \
						      uint##bits##_t v, int o)                   \
	{                                                                                        \
		(void)o;                                                                         \
		hit(at);                                                                         \
		return __atomic_exchange_n(at, v, __ATOMIC_SEQ_CST);                             \
	}                                                                                        \
	uint##bits##_t __tsan_atomic##bits##_fetch_add(volatile uint##bits##_t *at,              \
						       uint##bits##_t v, int o);                 \
	uint##bits##_t __tsan_atomic##bits##_fetch_add(volatile uint##bits##_t *at,              \
						       uint##bits##_t v, int o)                  \
	{                                                                                        \
		(void)o;                                                                         \
		hit(at);                                                                         \
		return __atomic_fetch_add(at, v, __ATOMIC_SEQ_CST);                              \
	}                                                                                        \
	int __tsan_atomic##bits##_compare_exchange_strong(volatile uint##bits##_t *at,           \
							  uint##bits##_t *expected,              \
							  uint##bits##_t v, int o, int failed);  \
	int __tsan_atomic##bits##_compare_exchange_strong(volatile uint##bits##_t *at,           \
							  uint##bits##_t *expected,              \
							  uint##bits##_t v, int o, int failed)   \
	{                                                                                        \
		(void)o;                                                                         \
		(void)failed;                                                                    \
		hit(at);                                                                         \
		return __atomic_compare_exchange_n(at, expected, v, false, __ATOMIC_SEQ_CST,     \
						   __ATOMIC_SEQ_CST);                            \
	}                                                                                        \
	uint##bits##_t __tsan_atomic##bits##_fetch_sub(volatile uint##bits##_t *at,              \
						       uint##bits##_t v, int o);                 \
	uint##bits##_t __tsan_atomic##bits##_fetch_sub(volatile uint##bits##_t *at,              \
						       uint##bits##_t v, int o)                  \
	{                                                                                        \
		(void)o;                                                                         \
		hit(at);                                                                         \
		return __atomic_fetch_sub(at, v, __ATOMIC_SEQ_CST);                              \
	}

ATOMIC(8)
ATOMIC(16)
ATOMIC(32)
ATOMIC(64)
