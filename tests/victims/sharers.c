/* SPDX-License-Identifier: Apache-2.0
 *
 * sharers KIND FOLDER     see scenario.h: processes with one descriptor table, clone(2), CLONE_FILES
 *
 *   files     children of the main process, and a child of one of them; one has what the main process
 *             had, in a table of its own, and one the directories, too (CLONE_FS)
 *   orphans   one whose parent has ended, and so has what the main process has
 *   leaving   a child that is asked to leave what it has to another one, and to end
 *   many      more of them than make their own channels for descriptors, each with memory of its own
 */
#include <linux/kcmp.h>
#include <sched.h>
#include <sys/stat.h>

#include "scenario.h"

enum { SHARERS_MAX = 8, MEMORY = 4 << 20, WAIT_MS = 10000 };

/* What one does for the main process. */
enum errand { NOTHING, READ, OPEN, CLOSE, GO, LEAVE };
static struct sharer {
	volatile pid_t pid;
	volatile int errand, fd, answer;
	volatile uint64_t flags; /* with the main process                                */
	char text[256];          /* what was read; a path                                */
} * sharer;
static int sharers;
static bool was_open[64];
static char *memory; /* each its own */

static _Noreturn void live(struct sharer *me);
static struct sharer *begin(uint64_t flags);

static void run(struct sharer *me)
{
	ssize_t n;

	switch (me->errand) {
	case READ:
		n = pread(me->fd, me->text, sizeof me->text - 1, 0);
		me->text[n > 0 ? n : 0] = 0;
		me->answer = n < 0 ? -errno : (int)n;
		break;
	case OPEN:
		me->answer = open(me->text, O_RDONLY);
		break;
	case CLOSE:
		me->answer = close(me->fd);
		break;
	case GO:
		me->answer = chdir(me->text);
		break;
	case LEAVE:
		if (begin(CLONE_FILES))
			_exit(0);
		live(me + 1);
	default:
		break;
	}
	me->errand = NOTHING;
}

static _Noreturn void live(struct sharer *me)
{
	memset(memory, (int)(me - sharer) + 1, MEMORY);
	me->pid = getpid();
	for (;; nap_us(200)) {
		CHECK(memory[0] == me - sharer + 1 && memory[MEMORY - 1] == memory[0], "memory");
		if (me->errand)
			run(me);
	}
}

static int ask(struct sharer *of, enum errand errand, int f, const char *text)
{
	of->fd = f;
	snprintf(of->text, sizeof of->text, "%s", text);
	of->errand = (int)errand;
	for (int i = 0; of->errand && i < WAIT_MS; i++)
		nap_us(1000);
	CHECK(!of->errand, "process %d does nothing", of->pid);
	return of->answer;
}

/* In the child NULL. */
static struct sharer *begin(uint64_t flags)
{
	struct sharer *made = &sharer[sharers];
	const long pid = syscall(SYS_clone, flags | SIGCHLD, 0, 0, 0, 0);

	must(pid >= 0, "clone");
	if (!pid)
		return NULL;
	sharers++;
	return made;
}

static void wait_begun(struct sharer *made)
{
	for (int i = 0; !made->pid && i < WAIT_MS; i++)
		nap_us(1000);
	must(made->pid, "it lives");
}

static void add(uint64_t flags)
{
	struct sharer *made;

	sharer[sharers].flags = flags;
	made = begin(flags);
	if (!made)
		live(&sharer[sharers]);
	wait_begun(made);
}

/* By a child that has the same, and waits for it or has ended. */
static void add_grandchild(uint64_t flags, uint64_t flags_below, bool orphan)
{
	struct sharer *made;

	sharer[sharers].flags = flags;
	sharer[sharers + 1].flags = flags_below;
	made = begin(flags);
	if (!made) {
		made = &sharer[sharers++];
		if (!begin(flags_below))
			live(&sharer[sharers]);
		if (orphan)
			_exit(0);
		live(made);
	}
	sharers++;
	wait_begun(made + 1);
	if (!orphan) {
		wait_begun(made);
		return;
	}
	must(wait(NULL) > 0, "wait");
	sharer++;
	sharers--;
}

static void open_files(void)
{
	int ends[2];

	fd[0] = make_file("first", "0123456789", O_RDWR);
	must(lseek(fd[0], 4, SEEK_SET) == 4, "lseek");
	must(!pipe(ends) && write(ends[1], "unread", 6) == 6, "pipe");
	fd[1] = ends[0];
	fd[2] = ends[1];
	close(make_file("second", "second", O_RDONLY));
	mkdir(path_of("there"), 0700);
	must(!chdir(folder), "chdir");
	sharer = mmap(NULL, SHARERS_MAX * sizeof *sharer, PROT_READ | PROT_WRITE,
		      MAP_SHARED | MAP_ANONYMOUS, -1, 0);
	memory = mmap(NULL, MEMORY, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
	must(sharer != MAP_FAILED && memory != MAP_FAILED, "mmap");
}

/* One of them has opened it. */
static void note_open(void)
{
	fd[3] = ask(&sharer[0], OPEN, 0, path_of("second"));
	must(fd[3] > fd[2], "open");
	for (int i = 0; i < 64; i++)
		was_open[i] = is_open(i);
}

static void setup_files(void)
{
	open_files();
	add_grandchild(CLONE_FILES, CLONE_FILES, false);
	add_grandchild(CLONE_FILES, 0, false);
	add(CLONE_FILES | CLONE_FS);
	add(CLONE_FS);
	note_open();
	add(0);
}

static void setup_orphans(void)
{
	open_files();
	add_grandchild(CLONE_FILES, CLONE_FILES, true);
	note_open();
}

static void setup_many(void)
{
	open_files();
	for (int i = 0; i < 6; i++)
		add(i == 3 ? 0 : CLONE_FILES);
	note_open();
}

static void setup_leaving(void)
{
	open_files();
	add(0);
}

static void disturb_leaving(void)
{
	sharer[0].errand = LEAVE;
	must(wait(NULL) == sharer[0].pid, "wait");
	wait_begun(&sharer[1]);
}

static void disturb(void)
{
	lseek(fd[0], 0, SEEK_SET);
	must(read(fd[1], scratch, 6) == 6, "read");
	close(fd[2]);
	for (int i = 0; i < sharers; i++) {
		must(ask(&sharer[i], OPEN, 0, path_of("first")) >= 0, "open");
		if (sharer[i].flags & CLONE_FILES)
			must(!ask(&sharer[i], CLOSE, i % 2 ? fd[3] : fd[1], "") || i > 1, "close");
		if (sharer[i].flags & CLONE_FS)
			must(!ask(&sharer[i], GO, 0, path_of("there")), "chdir");
	}
}

static bool is_same(const struct sharer *other, int what)
{
	return syscall(SYS_kcmp, getpid(), other->pid, what, 0, 0) == 0;
}

/* What one opens, closes or enters, the others have open, closed, entered; or not. */
static void verify_shared(struct sharer *other)
{
	const bool files = other->flags & CLONE_FILES, folders = other->flags & CLONE_FS;
	char here[512], there[512];
	int f = open(path_of("second"), O_RDONLY), answer;

	CHECK(is_same(other, KCMP_FILES) == files, "the table of %d", other->pid);
	CHECK(is_same(other, KCMP_FS) == folders, "the directories of %d", other->pid);
	answer = ask(other, READ, f, "");
	CHECK(answer == (files ? 6 : -EBADF), "what is open here: %d in %d", answer, other->pid);
	close(f);
	f = ask(other, OPEN, 0, path_of("second"));
	CHECK(f >= 0 && (!files || is_open(f)), "what is open in %d: %d", other->pid, f);
	CHECK(ask(other, CLOSE, f, "") == 0 && (!files || !is_open(f)), "what is closed in %d",
	      other->pid);
	must(getcwd(here, sizeof here) && !ask(other, GO, 0, path_of("there")), "chdir");
	must(getcwd(there, sizeof there), "getcwd");
	CHECK(!strcmp(here, there) == !folders, "%d goes to %s", other->pid, there);
	must(!ask(other, GO, 0, folder), "chdir");
}

static void verify(void)
{
	for (int i = 0; i < 64; i++)
		CHECK(is_open(i) == was_open[i], "descriptor %d", i);
	expect_text(fd[0], "456789", "a file");
	must(lseek(fd[0], 4, SEEK_SET) == 4, "lseek");
	expect_text(fd[1], "unread", "a pipe");
	must(write(fd[2], "unread", 6) == 6, "write");
	for (int i = 0; i < sharers; i++)
		verify_shared(&sharer[i]);
	expect_text(fd[3], "second", "what another has opened");
	must(lseek(fd[3], 0, SEEK_SET) == 0, "lseek");
	for (int i = 0; i < sharers; i++)
		CHECK(!(sharer[i].flags & CLONE_FILES) || ask(&sharer[i], READ, fd[3], "") == 6,
		      "what another has opened, in %d", sharer[i].pid);
}

int main(int argc, char **argv)
{
	static const struct scenario scenarios[] = {
		{ "files", setup_files, disturb, verify },
		{ "orphans", setup_orphans, disturb, verify },
		{ "leaving", setup_leaving, disturb_leaving, nothing },
		{ "many", setup_many, disturb, verify },
	};

	play(argc, argv, scenarios, sizeof scenarios / sizeof *scenarios);
}
