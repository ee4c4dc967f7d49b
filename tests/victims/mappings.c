/* SPDX-License-Identifier: Apache-2.0
 *
 * mappings [SHARED_KB] [--inherited] [--huge] [--segment] [--memfd] [--future] [--large]
 * [--unbound] [--twice]: memory of every kind a plain fork does not carry as it is, and kinds that are easily
 * forgotten.  Each is written and read all the time.
 *
 * - anonymous, MADV_DONTFORK: not in a fork at all (V8 marks its heap so)
 * - anonymous, MADV_WIPEONFORK: zeroes in a fork
 * - anonymous, read-only, PROT_NONE guards between them: protections stay
 * - private mapping of a file, pages changed
 * - private mapping of a file that has been deleted
 * - the heap (brk), which goes on growing where it was
 * - locked memory (mlock), as far as the limits allow
 * - anonymous shared memory of SHARED_KB (64; 0: none), which must be of one
 *   instant with the private memory
 * - areas with a memory policy, and with marks (MADV_HUGEPAGE and others)
 * - mappings that come and go all the time
 *
 * With --inherited the first two are ordinary memory; with --huge the shared memory is of huge pages,
 * with --segment System V's, with --memfd a memfd's; with --large there are 64 MB more of shared memory
 * that others can find in /dev/shm, of which nothing is expected; with --future all memory that comes
 * is locked (mlockall); with --unbound no area has a policy; with --twice the shared memory is mapped a
 * second time, to be read, as just-in-time compilers map code.
 */
#include <linux/mempolicy.h>
#include <setjmp.h>
#include <signal.h>
#include <sys/resource.h>
#include <sys/shm.h>

#include "victim.h"

enum { WORDS = 512, PAGES = 16, BYTES = PAGES * 4096 };

struct region {
	const char *name;
	uint64_t *at;
	size_t words;
};

static uint64_t version; /* of everything; in ordinary memory */
static sigjmp_buf trap;

static void on_fault(int sig)
{
	siglongjmp(trap, sig);
}

static void *map(int protection, int flags, int fd)
{
	void *at = mmap(NULL, BYTES, protection, flags, fd, 0);

	must(at != MAP_FAILED, "mmap");
	return at;
}

/* As PostgreSQL has some: others can attach it. */
static void *attach(size_t bytes)
{
	const int id = shmget(IPC_PRIVATE, bytes, 0600);
	void *at = id < 0 ? (void *)-1 : shmat(id, NULL, 0);

	must(at != (void *)-1 && !shmctl(id, IPC_RMID, NULL), "shmat");
	return at;
}

static void *map_file(int fd, size_t bytes)
{
	void *at = MAP_FAILED;

	if (fd >= 0 && !ftruncate(fd, (off_t)bytes))
		at = mmap(NULL, bytes, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
	must(at != MAP_FAILED, "mmap");
	close(fd);
	return at;
}

/* Of a length of 0, mremap(2) maps shared memory once more. */
static struct region see_again(const struct region *region)
{
	const size_t bytes = region->words * sizeof *region->at;
	void *at = mremap(region->at, 0, bytes, MREMAP_MAYMOVE);

	must(at != MAP_FAILED && !mprotect(at, bytes, PROT_READ), "mremap");
	return (struct region){ "shared memory, seen again", at, region->words };
}

static int make_file(void)
{
	static char page[4096];
	int fd = open("/tmp", O_TMPFILE | O_RDWR | O_CLOEXEC, 0600), i;

	if (fd < 0) { /* a file system without it */
		char name[] = "/tmp/victim-mappings-XXXXXX";

		fd = mkstemp(name);
		must(fd >= 0 && !unlink(name), "mkstemp");
	}
	memset(page, 'f', sizeof(page));
	for (i = 0; i < PAGES; i++)
		must(write(fd, page, sizeof(page)) == (ssize_t)sizeof(page), "write");
	return fd;
}

static void write_all(const struct region *regions, int n)
{
	size_t w;
	int i;

	for (i = 0; i < n; i++)
		for (w = 0; w < regions[i].words; w++)
			regions[i].at[w] = mix(w, version);
}

static void check_all(const struct region *regions, int n)
{
	size_t w;
	int i;

	for (i = 0; i < n; i++)
		for (w = 0; w < regions[i].words; w++)
			CHECK(regions[i].at[w] == mix(w, version),
			      "%s: word %zu is %lx, not of version %lu", regions[i].name, w,
			      regions[i].at[w], version);
}

/* Touching it must fault, now as in the beginning. */
static void check_fault(volatile uint64_t *at, bool by_writing, const char *what)
{
	if (sigsetjmp(trap, 1) == 0) {
		if (by_writing)
			*at = 1;
		else
			(void)*at;
		violation("%s did not fault", what);
	}
}

static bool future;

/* What is new is locked.  (Not what was mapped just before a checkpoint: which areas are
 * locked is looked at now and then only.) */
static void check_future(void)
{
	bool locked = false;

	for (int tries = 0; future && !locked && tries < 5; tries++) {
		void *at = map(PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1);

		locked = madvise(at, BYTES, MADV_DONTNEED) && errno == EINVAL;
		munmap(at, BYTES);
	}
	CHECK(locked || !future, "new memory is not locked");
}

static void come_and_go(void)
{
	uint64_t *at = map(PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1);

	CHECK(at[17] == 0, "a new mapping is not empty");
	at[17] = version;
	CHECK(!mprotect(at, 4096, PROT_READ), "mprotect: %s", strerror(errno));
	CHECK(at[17] == version, "a mapping forgot");
	CHECK(!munmap(at, BYTES), "munmap: %s", strerror(errno));
}

static uint64_t *bound; /* to a node of memory; NULL: the kernel knows none */

/* Areas of which a test compares the marks. */
static void mark_kinds(bool unbound)
{
	static const int kinds[] = { MADV_HUGEPAGE, MADV_NOHUGEPAGE, MADV_DONTDUMP,
				     MADV_MERGEABLE };
	const unsigned long node = 1;

	/* A kernel may be without one or the other. */
	for (size_t i = 0; i < sizeof kinds / sizeof *kinds; i++)
		must(!madvise(map(PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1), BYTES,
			      kinds[i]) ||
			     errno == EINVAL,
		     "madvise");
	bound = map(PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1);
	if (unbound || syscall(SYS_mbind, bound, BYTES, MPOL_BIND, &node, 64, 0))
		bound = NULL;
}

static void check_bound(void)
{
	int policy = -1;

	CHECK(!bound || (!syscall(SYS_get_mempolicy, &policy, NULL, 0, bound, MPOL_F_ADDR) &&
			 policy == MPOL_BIND),
	      "the policy of an area is %d", policy);
}

int main(int argc, char **argv)
{
	struct sigaction act = { .sa_handler = on_fault };
	struct region regions[8], view = { 0 };
	size_t shared_kb, lap;
	uint64_t *read_only, *none, *heap;
	char *brk_at;
	bool inherited, huge, segment, memfd, large, unbound, twice;
	int n = 0, fd;

	inherited = victim_flag(&argc, argv, "--inherited");
	huge = victim_flag(&argc, argv, "--huge");
	segment = victim_flag(&argc, argv, "--segment");
	future = victim_flag(&argc, argv, "--future");
	memfd = victim_flag(&argc, argv, "--memfd");
	large = victim_flag(&argc, argv, "--large");
	unbound = victim_flag(&argc, argv, "--unbound");
	twice = victim_flag(&argc, argv, "--twice");
	victim_start(
		&argc, argv, 0,
		"[SHARED_KB] [--inherited] [--huge] [--segment] [--memfd] [--future] [--large] "
		"[--unbound] [--twice]");
	shared_kb = argc > 1 ? (size_t)atol(argv[1]) : 64;
	sigaction(SIGSEGV, &act, NULL);

	regions[n++] =
		(struct region){ "MADV_DONTFORK memory",
				 map(PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1),
				 BYTES / 8 };
	must(inherited || !madvise(regions[n - 1].at, BYTES, MADV_DONTFORK), "MADV_DONTFORK");
	regions[n++] =
		(struct region){ "MADV_WIPEONFORK memory",
				 map(PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1),
				 BYTES / 8 };
	must(inherited || !madvise(regions[n - 1].at, BYTES, MADV_WIPEONFORK), "MADV_WIPEONFORK");
	fd = make_file();
	/* The second half stays the file's own. */
	regions[n++] = (struct region){ "a private file mapping",
					map(PROT_READ | PROT_WRITE, MAP_PRIVATE, fd), BYTES / 16 };
	close(fd);
	regions[n++] =
		(struct region){ "locked memory",
				 map(PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1),
				 BYTES / 8 };
	board->counter[1] = mlock(regions[n - 1].at, BYTES) == 0;
	heap = sbrk(BYTES);
	must(heap != (void *)-1, "sbrk");
	regions[n++] = (struct region){ "the heap", heap, BYTES / 8 };
	if (shared_kb) {
		void *at = segment ? attach(shared_kb << 10)
			   : memfd ? map_file(memfd_create("heap", MFD_CLOEXEC), shared_kb << 10)
				   : mmap(NULL, shared_kb << 10, PROT_READ | PROT_WRITE,
					  MAP_SHARED | MAP_ANONYMOUS | (huge ? MAP_HUGETLB : 0), -1,
					  0);

		must(at != MAP_FAILED, "mmap");
		regions[n++] = (struct region){ "shared memory", at, (shared_kb << 10) / 8 };
		if (twice)
			view = see_again(&regions[n - 1]);
	}
	/* Below the other, so that it is found first. */
	if (large)
		map_file(mkstemp((char[]){ "/dev/shm/victim-large-XXXXXX" }), 64 << 20);
	mark_kinds(unbound);
	read_only = map(PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1);
	read_only[3] = 333;
	must(!mprotect(read_only, BYTES, PROT_READ), "mprotect");
	none = map(PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1);
	write_all(regions, n);
	must(!future || !mlockall(MCL_FUTURE), "mlockall");
	victim_ready();
	for (lap = 0;; lap++) {
		check_all(regions, n);
		check_all(&view, twice);
		version++;
		write_all(regions, n);
		check_fault(none, false, "PROT_NONE memory");
		check_fault(read_only, true, "read-only memory");
		CHECK(read_only[3] == 333, "read-only memory changed");
		CHECK(((char *)regions[2].at)[BYTES - 1] == 'f', "the file's own page is %x",
		      ((unsigned char *)regions[2].at)[BYTES - 1]);
		come_and_go();
		check_future();
		check_bound();
		if (lap % 1024 == 0 && lap < 65536) {
			brk_at = sbrk(4096);
			CHECK(brk_at != (void *)-1, "sbrk: %s", strerror(errno));
			memset(brk_at, 1, 4096);
		}
		board->counter[0]++;
		beat();
		nap_us(500);
	}
}
