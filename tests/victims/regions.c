/* SPDX-License-Identifier: Apache-2.0
 *
 * Memory of kinds that few programs have, each in a mapping of its own.
 *
 *   regions SCENARIO FOLDER     see scenario.h
 *
 *   guard      guard pages without a mapping of their own (MADV_GUARD_INSTALL)
 *   unguard    a parent has them, its child has taken them away and uses the pages
 *   sealed     a memfd that nobody may write to any more, mapped shared
 *   late       one that nobody may map for writing any more, which is sealed so after the checkpoint
 *   changed    one that was written and sealed since: it cannot go back
 *   droppable  memory that is wiped in forks and dropped when it is short (MAP_DROPPABLE)
 *   growing    memory that grows downwards (MAP_GROWSDOWN)
 *   attached   System V shared memory
 *   readable   the same, attached for writing, and protected from it for now
 *   divided    the same, the first half protected from writing
 *   readonly   a file that was not open for writing, mapped shared
 *   unmoved    memory that nobody may unmap or protect otherwise (mseal(2))
 *   viewed     a file of FOLDER mapped shared that was not open for writing; others write to it
 *   published  the same, mapped for writing
 *   shielded   shared memory that is protected from writing, but for the moments of a change
 *   described  a memfd mapped for reading only, and written by a descriptor
 *   scattered  hundreds of areas of shared memory
 *   wiped      guard pages in memory that is wiped in forks (MADV_WIPEONFORK), and a page of it
 *              that is protected from reading
 *   reserved   gigabytes of such memory, of which little was ever touched
 */
#include <sys/ipc.h>
#include <sys/shm.h>

#include "scenario.h"

#define PAGE 4096
#ifndef MADV_GUARD_INSTALL
#define MADV_GUARD_INSTALL 102
#define MADV_GUARD_REMOVE 103
#endif
#ifndef F_SEAL_FUTURE_WRITE
#define F_SEAL_FUTURE_WRITE 0x10
#endif
#define DROPPABLE 0x08 /* MAP_DROPPABLE, since Linux 6.11 */

static char *at;

static char *map(size_t pages, int protection, int flags, int f)
{
	char *p = mmap(NULL, pages * PAGE, protection, flags, f, 0);

	must(p != MAP_FAILED, "mmap");
	return p;
}

/* ---- guard pages --------------------------------------------------------------------- */

enum { GUARDED_PAGES = 16, GUARD = 4, GUARDS = 4 };

/* The kernel reads it for us, and does not mind. */
static bool is_readable(const char *p)
{
	int ends[2];
	bool readable;

	must(!pipe(ends), "pipe");
	readable = write(ends[1], p, 1) == 1;
	CHECK(readable || errno == EFAULT, "write: %s", strerror(errno));
	close(ends[0]);
	close(ends[1]);
	return readable;
}

static void install(char *region)
{
	if (madvise(region + GUARD * PAGE, GUARDS * PAGE, MADV_GUARD_INSTALL))
		unavailable("MADV_GUARD_INSTALL");
}

/* So big that the engine looks only where there is something in it. */
static char *untouched;
enum { MANY_PAGES = 5 << 18 };

static void guard_setup(void)
{
	at = map(GUARDED_PAGES, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1);
	memset(at, 7, GUARDED_PAGES * PAGE);
	install(at);
	untouched = map(MANY_PAGES, PROT_READ | PROT_WRITE,
			MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1);
	install(untouched);
}

static void guard_disturb(void)
{
	must(!madvise(at, GUARDED_PAGES * PAGE, MADV_GUARD_REMOVE), "MADV_GUARD_REMOVE");
	memset(at, 8, GUARDED_PAGES * PAGE);
}

static void guard_verify(void)
{
	for (int i = 0; i < GUARDED_PAGES; i++) {
		const bool guard = i >= GUARD && i < GUARD + GUARDS;

		CHECK(is_readable(at + i * PAGE) == !guard &&
			      is_readable(untouched + i * PAGE) == !guard,
		      "page %d is a guard no more, or is one now", i);
		CHECK(guard || (at[i * PAGE] == 7 && !untouched[i * PAGE]), "page %d holds %d", i,
		      at[i * PAGE]);
	}
}

static struct {
	volatile uint64_t looks, wrong;
} * reported;

static void unguard_in_child(void)
{
	must(!madvise(at + GUARD * PAGE, GUARDS * PAGE, MADV_GUARD_REMOVE), "MADV_GUARD_REMOVE");
	memset(at + GUARD * PAGE, 5, 2 * PAGE);
	for (;;) {
		for (int i = 0; i < GUARDS; i++)
			reported->wrong += !is_readable(at + (GUARD + i) * PAGE) ||
					   at[(GUARD + i) * PAGE] != (i < 2 ? 5 : 0);
		reported->looks++;
		usleep(1000);
	}
}

static void unguard_verify(void)
{
	const uint64_t looks = reported->looks;

	for (int i = 0; i < 5000 && reported->looks < looks + 2; i++)
		nap_us(1000);
	CHECK(reported->looks >= looks + 2, "the child looks no more");
	CHECK(!reported->wrong, "the child's pages are not what they were");
	CHECK(!is_readable(at + GUARD * PAGE), "the parent has lost its guard pages");
}

static void unguard_setup(void)
{
	reported = (void *)map(1, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1);
	at = map(GUARDED_PAGES, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1);
	memset(at, 7, GUARDED_PAGES * PAGE);
	install(at);
	if (fork() == 0)
		unguard_in_child();
	unguard_verify();
}

/* ---- seals ---------------------------------------------------------------------------- */

/* fd[1] is the same for reading.  By the other one mapped, it could become writable, which would
 * be in the way of F_SEAL_WRITE; also in a template. */
static void open_memfd(void)
{
	char name[32];

	fd[0] = memfd_create("sealed", MFD_ALLOW_SEALING | MFD_CLOEXEC);
	snprintf(name, sizeof name, "/proc/self/fd/%d", fd[0]);
	fd[1] = open(name, O_RDONLY | O_CLOEXEC);
	must(fd[1] >= 0 && !ftruncate(fd[0], 2 * PAGE) && pwrite(fd[0], "then", 5, 0) == 5, name);
}

static void seal(int seals)
{
	must(!fcntl(fd[0], F_ADD_SEALS, seals | F_SEAL_GROW | F_SEAL_SHRINK), "F_ADD_SEALS");
}

static void expect_content(const char *text)
{
	CHECK(!strcmp(at, text), "it is \"%s\" and not \"%s\"", at, text);
}

static void sealed_setup(void)
{
	open_memfd();
	seal(F_SEAL_WRITE);
	at = map(2, PROT_READ, MAP_SHARED, fd[1]);
}

static void late_setup(void)
{
	open_memfd();
	at = map(2, PROT_READ | PROT_WRITE, MAP_SHARED, fd[0]);
}

static void late_disturb(void)
{
	seal(F_SEAL_FUTURE_WRITE);
	strcpy(at, "now");
}

static void expect_then(void)
{
	expect_content("then");
}

static void changed_setup(void)
{
	open_memfd();
	at = map(2, PROT_READ, MAP_SHARED, fd[1]);
}

static void changed_disturb(void)
{
	must(pwrite(fd[0], "now", 4, 0) == 4, "pwrite");
	seal(F_SEAL_WRITE);
}

static void expect_now(void)
{
	expect_content("now");
}

/* ---- what comes and goes -------------------------------------------------------------- */

static void droppable_setup(void)
{
	at = mmap(NULL, PAGE, PROT_READ | PROT_WRITE, MAP_ANONYMOUS | DROPPABLE, -1, 0);
	if (at == MAP_FAILED)
		unavailable("MAP_DROPPABLE");
	strcpy(at, "a seed");
}

static void droppable_verify(void)
{
	pid_t child;
	int status;

	strcpy(at, "a seed");
	child = fork();
	if (child == 0)
		_exit(*at != 0);
	CHECK(waitpid(child, &status, 0) == child && !status, "a fork has the seed of its parent");
}

enum { ROOM_PAGES = 2048 }; /* more than the kernel leaves free below (stack_guard_gap) */
static int grown;

static void growing_setup(void)
{
	char *room = map(ROOM_PAGES, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1);

	must(!munmap(room, ROOM_PAGES * PAGE), "munmap");
	at = mmap(room + (ROOM_PAGES - 1) * PAGE, PAGE, PROT_READ | PROT_WRITE,
		  MAP_PRIVATE | MAP_ANONYMOUS | MAP_GROWSDOWN | MAP_FIXED_NOREPLACE, -1, 0);
	must(at != MAP_FAILED, "MAP_GROWSDOWN");
	*at = 7;
}

static void growing_verify(void)
{
	CHECK(*at == 7, "it holds %d", *at);
	grown++;
	at[-grown * PAGE] = 7; /* a fault, if it does not grow */
}

static int segment;

static void attached_setup(void)
{
	segment = shmget(IPC_PRIVATE, 2 * PAGE, 0600);
	at = segment < 0 ? (void *)-1 : shmat(segment, NULL, 0);
	must(at != (void *)-1 && !shmctl(segment, IPC_RMID, NULL), "shmat");
	strcpy(at, "shared");
}

/* It would be gone if nobody had it attached. */
static void attached_verify(void)
{
	struct shmid_ds info;
	char *again = shmat(segment, NULL, 0);

	CHECK(again != (void *)-1 && !strcmp(again, "shared") && !strcmp(at, "shared"),
	      "the segment is another one");
	CHECK(!shmctl(segment, IPC_STAT, &info) && info.shm_nattch >= 2, "%lu have it attached",
	      (unsigned long)info.shm_nattch);
	CHECK(!shmdt(at), "shmdt: %s", strerror(errno));
	at = again;
}

static void readable_setup(void)
{
	attached_setup();
	must(!mprotect(at, 2 * PAGE, PROT_READ), "mprotect");
}

static void readable_verify(void)
{
	CHECK(!mprotect(at, 2 * PAGE, PROT_READ | PROT_WRITE), "mprotect: %s", strerror(errno));
	strcpy(at, "shared");
	attached_verify();
	must(!mprotect(at, 2 * PAGE, PROT_READ), "mprotect");
}

static void divided_setup(void)
{
	attached_setup();
	must(!mprotect(at, PAGE, PROT_READ), "mprotect");
}

static void divided_verify(void)
{
	at[PAGE]++;
	CHECK(!strcmp(at, "shared"), "it is \"%s\"", at);
}

static char *writable;

/* One after the other, which is found first. */
static void readonly_setup(void)
{
	const int f = make_file("map", "then", O_RDONLY | O_CLOEXEC);

	writable = map(1, PROT_READ | PROT_WRITE, MAP_SHARED, open(path_of("map"), O_RDWR));
	at = map(1, PROT_READ, MAP_SHARED, f);
	must(at < writable, "map");
}

static void readonly_verify(void)
{
	strcpy(writable, "now");
	CHECK(!strcmp(at, "now"), "it is \"%s\"", at);
	strcpy(writable, "then");
	CHECK(mprotect(at, PAGE, PROT_READ | PROT_WRITE) && errno == EACCES,
	      "it can be made writable");
}

static void unmoved_setup(void)
{
	at = map(1, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1);
	if (syscall(462 /* SYS_mseal */, at, PAGE, 0))
		unavailable("mseal");
	*at = 7;
}

/* ---- whose it is ------------------------------------------------------------------------- */

/* The test writes "now" into the file. */
static void viewed_setup(void)
{
	at = map(1, PROT_READ, MAP_SHARED, make_file("map", "then", O_RDONLY | O_CLOEXEC));
}

static void published_setup(void)
{
	const int f = make_file("map", "then", O_RDWR | O_CLOEXEC);

	at = map(1, PROT_READ | PROT_WRITE, MAP_SHARED, f);
	close(f);
}

static void shielded_setup(void)
{
	at = map(2, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1);
	strcpy(at, "then");
	must(!mprotect(at, PAGE, PROT_READ), "mprotect");
}

static void shielded_disturb(void)
{
	must(!mprotect(at, PAGE, PROT_READ | PROT_WRITE), "mprotect");
	strcpy(at, "now");
	must(!mprotect(at, PAGE, PROT_READ), "mprotect");
}

static void described_disturb(void)
{
	must(pwrite(fd[0], "now", 4, 0) == 4, "pwrite");
}

/* ---- much of it ---------------------------------------------------------------------------- */

enum { AREAS = 300 };
static int *area[AREAS];

/* With a gap between them, or the kernel makes one of them. */
static void scattered_setup(void)
{
	for (int i = 0; i < AREAS; i++) {
		area[i] = (int *)map(1, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1);
		map(1, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1);
		*area[i] = i;
	}
}

static void scattered_disturb(void)
{
	for (int i = 0; i < AREAS; i++)
		*area[i] = -1;
}

static void scattered_verify(void)
{
	for (int i = 0; i < AREAS; i++)
		CHECK(*area[i] == i, "area %d holds %d", i, *area[i]);
}

static void wiped_setup(void)
{
	at = map(GUARDED_PAGES, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1);
	memset(at, 7, GUARDED_PAGES * PAGE);
	must(!madvise(at, GUARDED_PAGES * PAGE, MADV_WIPEONFORK), "MADV_WIPEONFORK");
	install(at);
	must(!mprotect(at, PAGE, PROT_NONE), "mprotect");
}

static void wiped_disturb(void)
{
	must(!madvise(at, GUARDED_PAGES * PAGE, MADV_GUARD_REMOVE), "MADV_GUARD_REMOVE");
	memset(at + PAGE, 8, (GUARDED_PAGES - 1) * PAGE);
}

static void wiped_verify(void)
{
	CHECK(!is_readable(at), "the page is not protected any more");
	must(!mprotect(at, PAGE, PROT_READ | PROT_WRITE), "mprotect");
	for (int i = 0; i < GUARDED_PAGES; i++) {
		const bool guard = i >= GUARD && i < GUARD + GUARDS;

		CHECK(is_readable(at + i * PAGE) == !guard,
		      "page %d is a guard no more, or is one now", i);
		CHECK(guard || at[i * PAGE] == 7, "page %d holds %d", i, at[i * PAGE]);
	}
	must(!mprotect(at, PAGE, PROT_NONE), "mprotect");
}

enum { RESERVED_PAGES = 1 << 20, TOUCHED = 3 };
static const size_t touched[TOUCHED] = { 0, 5000, RESERVED_PAGES - 1 };

static void reserved_write(char value)
{
	for (int i = 0; i < TOUCHED; i++)
		at[touched[i] * PAGE] = value;
}

static void reserved_setup(void)
{
	at = map(RESERVED_PAGES, PROT_READ | PROT_WRITE,
		 MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1);
	must(!madvise(at, (size_t)RESERVED_PAGES * PAGE, MADV_WIPEONFORK), "MADV_WIPEONFORK");
	reserved_write(7);
}

static void reserved_disturb(void)
{
	reserved_write(8);
	at[PAGE] = 8;
}

static void reserved_verify(void)
{
	for (int i = 0; i < TOUCHED; i++)
		CHECK(at[touched[i] * PAGE] == 7, "page %zu holds %d", touched[i],
		      at[touched[i] * PAGE]);
	CHECK(!at[PAGE], "a page that was never touched holds %d", at[PAGE]);
}

static void unmoved_verify(void)
{
	CHECK(*at == 7, "it holds %d", *at);
	CHECK(mprotect(at, PAGE, PROT_READ) && errno == EPERM, "it is not sealed any more");
}

static const struct scenario scenarios[] = {
	{ "guard", guard_setup, guard_disturb, guard_verify },
	{ "unguard", unguard_setup, nothing, unguard_verify },
	{ "sealed", sealed_setup, nothing, expect_then },
	{ "late", late_setup, late_disturb, expect_then },
	{ "changed", changed_setup, changed_disturb, expect_now },
	{ "droppable", droppable_setup, nothing, droppable_verify },
	{ "growing", growing_setup, nothing, growing_verify },
	{ "attached", attached_setup, nothing, attached_verify },
	{ "readable", readable_setup, nothing, readable_verify },
	{ "divided", divided_setup, nothing, divided_verify },
	{ "readonly", readonly_setup, nothing, readonly_verify },
	{ "viewed", viewed_setup, nothing, expect_now },
	{ "published", published_setup, nothing, expect_now },
	{ "shielded", shielded_setup, shielded_disturb, expect_then },
	{ "described", changed_setup, described_disturb, expect_then },
	{ "scattered", scattered_setup, scattered_disturb, scattered_verify },
	{ "wiped", wiped_setup, wiped_disturb, wiped_verify },
	{ "reserved", reserved_setup, reserved_disturb, reserved_verify },
	{ "unmoved", unmoved_setup, nothing, unmoved_verify },
};

int main(int argc, char **argv)
{
	play(argc, argv, scenarios, sizeof scenarios / sizeof *scenarios);
}
