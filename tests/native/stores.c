/* SPDX-License-Identifier: Apache-2.0
 *
 * In a guard that was built with -fsanitize=thread, but linked with this in place of that library:
 * dies before one of its stores to memory that it shares with the application or with init.
 * Before which, a number in the file AVCKPT_STORES says: it is counted down, 0: before none.  The compiler tells of each store of the guard's (__tsan_write*), and the linker of
 * memcpy(3) and the like (--wrap).  What the kernel writes there is of a system call.
 */
#include <fcntl.h>
#include <signal.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <unistd.h>

#define AREAS_MAX 256
#define HEARTBEAT_BYTES 16 /* struct avc_heartbeat, which only the daemon reads        */

static struct {
	uintptr_t start, end;
} areas[AREAS_MAX];
static unsigned int count;
static int64_t *left; /* in the file; NULL: not mapped yet                       */

void *__real_mmap(void *at, size_t bytes, int prot, int flags, int fd, off_t offset);

static bool map_left(void)
{
	const char *path = getenv("AVCKPT_STORES");
	const int fd = path ? open(path, O_RDWR | O_CLOEXEC) : -1;
	void *map = fd < 0 ? MAP_FAILED
			   : __real_mmap(NULL, sizeof *left, PROT_READ | PROT_WRITE, MAP_SHARED, fd,
					 0);

	if (fd >= 0)
		close(fd);
	if (map != MAP_FAILED)
		left = map;
	return left;
}

static void hit(const volatile void *at)
{
	const uintptr_t where = (uintptr_t)at;

	for (unsigned int i = 0; i < count; i++) {
		if (where < areas[i].start || where >= areas[i].end)
			continue;
		if ((left || map_left()) && *left > 0 && --*left == 0)
			syscall(SYS_kill, getpid(), SIGKILL);
		return;
	}
}

void *__wrap_mmap(void *at, size_t bytes, int prot, int flags, int fd, off_t offset);
void *__wrap_mmap(void *at, size_t bytes, int prot, int flags, int fd, off_t offset)
{
	void *map = __real_mmap(at, bytes, prot, flags, fd, offset);

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
#define STORE(name)         \
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
SIZES(STORE, __tsan_write)
SIZES(STORE, __tsan_unaligned_write)
SIZES(STORE, __tsan_volatile_write)
SIZES(STORE, __tsan_unaligned_volatile_write)

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
