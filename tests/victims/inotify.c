/* SPDX-License-Identifier: Apache-2.0
 *
 * inotify watches, changed after a checkpoint.
 *
 *   inotify SCENARIO FOLDER     see scenario.h; FOLDER has a link "other" to a folder of another
 *                               file system
 */
#include <sys/inotify.h>
#include <sys/stat.h>

#include "scenario.h"

enum { FOLDER, FILE_, GONE, LINK, OTHER, WATCHES };

static int watch[WATCHES];
static const char *target(int which)
{
	static const char *const names[] = { "folder", "file", "gone", "link", "other" };

	return path_of(names[which]);
}

static uint32_t mask_of(int which)
{
	return which == FOLDER  ? IN_CREATE | IN_DELETE | IN_ONLYDIR
	       : which == LINK  ? IN_ATTRIB | IN_DONT_FOLLOW
	       : which == OTHER ? IN_CREATE
				: IN_MODIFY | IN_EXCL_UNLINK;
}

static void watches_setup(void)
{
	fd[0] = inotify_init1(IN_NONBLOCK | IN_CLOEXEC);
	must(fd[0] >= 0, "inotify_init1");
	must(mkdir(path_of("folder"), 0700) == 0, "mkdir");
	close(make_file("file", "text", O_RDONLY));
	close(make_file("gone", "text", O_RDONLY));
	must(symlink("nowhere", path_of("link")) == 0, "symlink");
	/* Numbers with gaps, not in the order of the watches. */
	for (int i = 0; i < 5; i++)
		must(inotify_rm_watch(fd[0], inotify_add_watch(fd[0], "/", IN_DELETE)) == 0, "rm");
	for (int i = WATCHES; i-- > 0;) {
		watch[i] = inotify_add_watch(fd[0], target(i), mask_of(i));
		must(watch[i] == 6 + 2 * (WATCHES - 1 - i), "inotify_add_watch");
		must(inotify_rm_watch(fd[0], inotify_add_watch(fd[0], "/", IN_DELETE)) == 0, "rm");
	}
	must(read(fd[0], scratch, sizeof scratch) > 0, "read"); /* IN_IGNORED */
}

static void changed_disturb(void)
{
	must(inotify_rm_watch(fd[0], watch[FOLDER]) == 0 &&
		     inotify_rm_watch(fd[0], watch[LINK]) == 0 &&
		     inotify_rm_watch(fd[0], watch[OTHER]) == 0,
	     "inotify_rm_watch");
	must(inotify_add_watch(fd[0], target(FILE_), IN_OPEN) == watch[FILE_], "another mask");
	must(inotify_add_watch(fd[0], "/etc", IN_DELETE) > 0, "one more");
	must(read(fd[0], scratch, sizeof scratch) > 0, "read"); /* IN_IGNORED */
}

static void closed_disturb(void)
{
	close(fd[0]);
}

static void reused_disturb(void)
{
	close(fd[0]);
	must(inotify_init1(0) == fd[0], "inotify_init1");
	must(inotify_add_watch(fd[0], "/", IN_DELETE) == 1, "inotify_add_watch");
}

static void expect_event(int which, uint32_t mask, const char *name)
{
	struct inotify_event *event = (struct inotify_event *)scratch;
	const ssize_t n = read(fd[0], scratch, sizeof scratch);

	CHECK(n >= (ssize_t)sizeof *event, "watch %d tells nothing: %s", which, strerror(errno));
	CHECK(event->wd == watch[which] && event->mask == mask,
	      "%d, mask %x instead of %d, mask %x", event->wd, event->mask, watch[which], mask);
	CHECK(!name || (event->len && !strcmp(event->name, name)), "an event without its name");
	CHECK(n == (ssize_t)(sizeof *event + event->len), "watch %d tells too much", which);
}

static void touch(const char *folder_, const char *name)
{
	char path[600];

	snprintf(path, sizeof path, "%s/%s", folder_, name);
	close(open(path, O_WRONLY | O_CREAT, 0600));
}

static void append(const char *path)
{
	int f = open(path, O_WRONLY | O_APPEND);

	CHECK(f >= 0 && write(f, "x", 1) == 1, "%s: %s", path, strerror(errno));
	close(f);
}

static void watches_verify(void)
{
	char path[600];

	CHECK(read(fd[0], scratch, sizeof scratch) < 0 && errno == EAGAIN,
	      "an event that nobody has caused");
	touch(path_of("folder"), "a");
	expect_event(FOLDER, IN_CREATE, "a");
	snprintf(path, sizeof path, "%s/a", path_of("folder"));
	unlink(path);
	expect_event(FOLDER, IN_DELETE, "a");
	append(path_of("file"));
	expect_event(FILE_, IN_MODIFY, NULL);
	append(path_of("gone"));
	expect_event(GONE, IN_MODIFY, NULL);
	must(lchown(path_of("link"), getuid(), getgid()) == 0, "lchown");
	expect_event(LINK, IN_ATTRIB, NULL);
	touch(path_of("other"), "b");
	expect_event(OTHER, IN_CREATE, "b");
	snprintf(path, sizeof path, "%s/b", path_of("other"));
	unlink(path);
	CHECK(inotify_add_watch(fd[0], path_of("file"), mask_of(FILE_)) == watch[FILE_],
	      "a file that is watched gets a second watch");
}

static void gone_disturb(void)
{
	must(inotify_rm_watch(fd[0], watch[GONE]) == 0 && unlink(path_of("gone")) == 0, "unlink");
	must(read(fd[0], scratch, sizeof scratch) > 0, "read"); /* IN_IGNORED */
}

static void gone_verify(void)
{
	append(path_of("file"));
	expect_event(FILE_, IN_MODIFY, NULL);
}

static const struct scenario scenarios[] = {
	{ "changed", watches_setup, changed_disturb, watches_verify },
	{ "closed", watches_setup, closed_disturb, watches_verify },
	{ "reused", watches_setup, reused_disturb, watches_verify },
	{ "gone", watches_setup, gone_disturb, gone_verify },
};

int main(int argc, char **argv)
{
	play(argc, argv, scenarios, sizeof scenarios / sizeof *scenarios);
}
