/* SPDX-License-Identifier: Apache-2.0
 *
 * What waits to be told: by epoll, inotify, timers; and who is said to hold a lock.
 *
 *   events SCENARIO FOLDER     see scenario.h
 */
#include <poll.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/inotify.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <sys/timerfd.h>
#include <sys/wait.h>

#include "scenario.h"

/* ---- watched under a number that is closed ------------------------------------------- */

enum { NUMBER = 50 };

static int sets[2], pipes[3][2], counts[2];

static void add(int set, int f, uint64_t data, uint32_t more)
{
	struct epoll_event event = { .events = EPOLLIN | more, .data.u64 = data };

	must(epoll_ctl(set, EPOLL_CTL_ADD, f, &event) == 0, "epoll_ctl");
}

static void add_as(int set, int f, int number, uint64_t data)
{
	must(dup2(f, number) == number, "dup2");
	add(set, number, data, 0);
	close(number);
}

static void numbers_setup(void)
{
	for (int i = 0; i < 3; i++)
		must(pipe2(pipes[i], O_NONBLOCK) == 0, "pipe2");
	for (int i = 0; i < 2; i++)
		must((counts[i] = eventfd(0, EFD_NONBLOCK)) >= 0, "eventfd");
	for (int i = 0; i < 2; i++) {
		sets[i] = epoll_create1(EPOLL_CLOEXEC);
		/* Three under one number, of which one has it still. */
		add_as(sets[i], pipes[0][0], NUMBER, 103);
		add_as(sets[i], pipes[1][0], NUMBER, 101);
	}
	must(dup2(pipes[2][0], NUMBER) == NUMBER, "dup2");
	add(sets[0], NUMBER, 102, 0);
	/* One under the number of another one, which is not watched. */
	add_as(sets[1], counts[0], 60, 104);
	must(dup2(counts[1], 60) == 60, "dup2");
	/* And without more ado. */
	add(sets[1], counts[1], 105, EPOLLET);
}

static void numbers_disturb(void)
{
	struct epoll_event other = { .events = EPOLLIN, .data.u64 = 7 };

	must(epoll_ctl(sets[0], EPOLL_CTL_MOD, NUMBER, &other) == 0, "epoll_ctl");
	add_as(sets[0], counts[0], 70, 8);
}

static void numbers_close(void)
{
	close(sets[0]);
	close(sets[1]);
	close(NUMBER);
}

static void expect_data(int set, uint64_t data)
{
	struct epoll_event event[8];
	const int n = epoll_wait(set, event, 8, 200);

	CHECK(n == 1 && event[0].data.u64 == data, "%d event(s), data %ld instead of %ld", n,
	      n > 0 ? (long)event[0].data.u64 : -1, (long)data);
}

static void expect_of_pipe(int i, uint64_t first, uint64_t second)
{
	must(write(pipes[i][1], "x", 1) == 1, "write");
	if (first)
		expect_data(sets[0], first);
	if (second)
		expect_data(sets[1], second);
	must(read(pipes[i][0], scratch, 2) == 1, "read");
}

static void expect_of_count(int i, uint64_t data)
{
	const uint64_t one = 1;

	must(write(counts[i], &one, 8) == 8, "write");
	expect_data(sets[1], data);
	must(read(counts[i], scratch, 8) == 8, "read");
}

static void numbers_verify(void)
{
	struct epoll_event event[8];

	expect_of_pipe(0, 103, 103);
	expect_of_pipe(1, 101, 101);
	expect_of_pipe(2, 102, 0);
	expect_of_count(0, 104);
	expect_of_count(1, 105);
	CHECK(epoll_wait(sets[0], event, 8, 0) == 0 && epoll_wait(sets[1], event, 8, 0) == 0,
	      "an event of nothing");
	CHECK(!is_open(70) && !is_open(61) && is_open(60) && is_open(NUMBER), "a number is open");
}

/* ---- events that nobody has read, when nothing is watched any more -------------------------- */

static char was_told[4096];
static ssize_t was_told_bytes;

/* The same events each time: what is in another instance. */
static int instance(void)
{
	const int f = inotify_init1(IN_NONBLOCK);

	must(f >= 0 && mkdir(path_of("watched"), 0755) == 0, "mkdir");
	must(inotify_add_watch(f, path_of("watched"), IN_ALL_EVENTS) == 1, "inotify_add_watch");
	close(open(path_of("watched/file"), O_CREAT | O_RDWR, 0644));
	must(unlink(path_of("watched/file")) == 0 && rmdir(path_of("watched")) == 0, "rmdir");
	return f;
}

static void unread_setup(void)
{
	fd[0] = instance();
	was_told_bytes = read(fd[0], was_told, sizeof was_told);
	close(fd[0]);
	fd[0] = instance();
	must(was_told_bytes > 100, "events");
}

static void unread_disturb(void)
{
}

static void unread_verify(void)
{
	const ssize_t n = read(fd[0], scratch, sizeof scratch);

	CHECK(n == was_told_bytes && !memcmp(scratch, was_told, (size_t)n),
	      "%zd bytes of events instead of %zd", n, was_told_bytes);
	CHECK(read(fd[0], scratch, sizeof scratch) < 0 && errno == EAGAIN, "events of nothing");
	close(fd[0]);
	fd[0] = instance();
}

static void read_disturb(void)
{
	must(read(fd[0], scratch, sizeof scratch) > 0, "read");
}

static void reopened_disturb(void)
{
	close(fd[0]);
}

/* Nobody can put them back; but nobody may wait for them for ever. */
static void lost_verify(void)
{
	const struct inotify_event *event = (const struct inotify_event *)scratch;
	const ssize_t n = read(fd[0], scratch, sizeof scratch);

	CHECK(n == sizeof *event && event->mask == IN_Q_OVERFLOW && event->wd == -1,
	      "%zd bytes, mask %x, where events were lost", n, event->mask);
	CHECK(read(fd[0], scratch, sizeof scratch) < 0 && errno == EAGAIN, "events of nothing");
	close(fd[0]);
	fd[0] = instance();
}

/* ---- timers as fdinfo shows them ----------------------------------------------------------- */

enum { TIMERS = 8 };

static struct timer {
	const char *what;
	int clock, flags;
	struct itimerspec spec;
	bool expires; /* once, before the checkpoint                                  */
} timers[TIMERS] = {
	{ "relative", CLOCK_MONOTONIC, 0, { .it_value = { 1000, 0 } }, false },
	{ "absolute", CLOCK_MONOTONIC, TFD_TIMER_ABSTIME, { .it_value = { 900000, 0 } }, false },
	{ "cancelled",
	  CLOCK_REALTIME,
	  TFD_TIMER_ABSTIME | 2 /* TFD_TIMER_CANCEL_ON_SET */,
	  { .it_value = { 9000000000, 0 } },
	  false },
	{ "periodic", CLOCK_BOOTTIME, 0, { { 500, 0 }, { 700, 0 } }, false },
	{ "unread", CLOCK_MONOTONIC, 0, { .it_value = { 0, 1 } }, true },
	{ "unread, periodic", CLOCK_MONOTONIC, 0, { { 300, 0 }, { 0, 1 } }, true },
	{ "unread, going on", CLOCK_MONOTONIC, 0, { { 400, 0 }, { 0, 1 } }, true },
	{ "never", CLOCK_MONOTONIC, 0, { { 0, 0 }, { 0, 0 } }, false },
};

struct shown {
	unsigned int clock, flags;
	unsigned long long ticks, value_s, value_ns, interval_s, interval_ns;
};

static struct shown shown_of(int f)
{
	struct shown shown = { 0 };
	char path[48], text[1024], *line;
	ssize_t n;
	int info;

	snprintf(path, sizeof path, "/proc/self/fdinfo/%d", f);
	info = open(path, O_RDONLY);
	n = read(info, text, sizeof text - 1);
	close(info);
	text[n > 0 ? n : 0] = 0;
	line = strstr(text, "clockid:");
	must(line && sscanf(line,
			    "clockid: %u ticks: %llu settime flags: %o it_value: (%llu, %llu) "
			    "it_interval: (%llu, %llu)",
			    &shown.clock, &shown.ticks, &shown.flags, &shown.value_s,
			    &shown.value_ns, &shown.interval_s, &shown.interval_ns) == 7,
	     "fdinfo");
	return shown;
}

static struct shown shown[TIMERS];
static uint64_t shown_ns;

static void timers_setup(void)
{
	struct itimerspec now;

	for (int i = 0; i < TIMERS; i++) {
		struct pollfd end = { .events = POLLIN };

		end.fd = fd[i] = timerfd_create(timers[i].clock, TFD_NONBLOCK);
		must(fd[i] >= 0, "timerfd_create");
		if (i != TIMERS - 1)
			must(timerfd_settime(fd[i], timers[i].flags, &timers[i].spec, NULL) == 0,
			     timers[i].what);
		must(!timers[i].expires || poll(&end, 1, 2000) == 1, "poll");
	}
	/* The kernel sets it going again, and counts. */
	must(timerfd_gettime(fd[6], &now) == 0, "timerfd_gettime");
	for (int i = 0; i < TIMERS; i++)
		shown[i] = shown_of(fd[i]);
	shown_ns = now_ns();
}

static void timers_disturb(void)
{
	const struct itimerspec other = { .it_value = { 5, 0 } };

	for (int i = 0; i < TIMERS; i++)
		if (i % 3)
			must(timerfd_settime(fd[i], 0, &other, NULL) == 0, "timerfd_settime");
		else
			close(fd[i]);
}

static void timers_verify(void)
{
	for (int i = 0; i < TIMERS; i++) {
		const struct shown is = shown_of(fd[i]), was = shown[i];
		const int64_t left_ns = (int64_t)(is.value_s * 1000000000 + is.value_ns),
			      left_then_ns = (int64_t)(was.value_s * 1000000000 + was.value_ns),
			      since_ns = (int64_t)(now_ns() - shown_ns);

		CHECK(is.clock == was.clock && is.flags == was.flags && is.ticks == was.ticks &&
			      is.interval_s == was.interval_s && is.interval_ns == was.interval_ns,
		      "timer %s: clock %u, flags %o, ticks %llu, interval %llu instead of %u, %o, %llu, %llu",
		      timers[i].what, is.clock, is.flags, is.ticks, is.interval_s, was.clock,
		      was.flags, was.ticks, was.interval_s);
		CHECK(left_then_ns ? llabs(left_ns - (left_then_ns - since_ns)) < 50000000
				   : !left_ns,
		      "timer %s: %ld ms left instead of %ld", timers[i].what,
		      (long)(left_ns / 1000000), (long)((left_then_ns - since_ns) / 1000000));
	}
}

/* ---- periods that pass while it is dead ------------------------------------------------------- */

static uint64_t beats_from_ns;

static void periods_setup(void)
{
	const struct itimerspec spec = { { 0, 1000000 }, { 0, 1000000 } };

	fd[0] = timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK);
	must(fd[0] >= 0 && timerfd_settime(fd[0], 0, &spec, NULL) == 0, "timerfd_settime");
	beats_from_ns = now_ns();
}

/* Sum and time agree, but for what an expiry that stood unread has hidden. */
static void periods_verify(void)
{
	struct pollfd end = { .fd = fd[0], .events = POLLIN };
	uint64_t ticks = 0, most = (now_ns() - beats_from_ns) / 1000000 + 2;

	CHECK(poll(&end, 1, 1000) == 1 && read(fd[0], &ticks, 8) == 8 && ticks >= 1 &&
		      ticks <= most,
	      "%lu ticks of %lu", ticks, most);
}

/* ---- locks ------------------------------------------------------------------------------------ */

static void owner_setup(void)
{
	fd[0] = make_file("written", "0123456789", O_RDWR);
	fd[1] = make_file("read", "0123456789", O_RDWR);
	fd[2] = make_file("read-only", "0123456789", O_RDONLY);
	fd[3] = make_file("write-only", "0123456789", O_WRONLY);
	for (int i = 0; i < 4; i++) {
		struct flock l = { .l_type = i == 0 || i == 3 ? F_WRLCK : F_RDLCK,
				   .l_start = i,
				   .l_len = i == 1 ? 0 : 5 };

		must(fcntl(fd[i], F_SETLK, &l) == 0, "fcntl(F_SETLK)");
	}
}

/* As somebody else is told, and fdinfo says. */
static void expect_owner(int f)
{
	const pid_t own = getpid(), child = fork();
	int status, shown_pid = -1;
	char path[48], line[256];
	FILE *info;

	if (child == 0) {
		struct flock l = { .l_type = F_WRLCK };
		const int again = open(path_of(f == fd[3]   ? "write-only"
					       : f == fd[2] ? "read-only"
					       : f == fd[1] ? "read"
							    : "written"),
				       O_RDWR);

		_exit(fcntl(again, F_GETLK, &l) || l.l_type == F_UNLCK || l.l_pid != own);
	}
	must(child > 0 && waitpid(child, &status, 0) == child, "fork");
	CHECK(status == 0, "lock of %d: another owner", f);
	snprintf(path, sizeof path, "/proc/self/fdinfo/%d", f);
	info = fopen(path, "r");
	while (info && fgets(line, sizeof line, info))
		(void)sscanf(line, "lock: %*d: POSIX ADVISORY %*s %d", &shown_pid);
	fclose(info);
	CHECK(shown_pid == own, "lock of %d: fdinfo says %d", f, shown_pid);
}

static void owner_verify(void)
{
	for (int i = 0; i < 4; i++)
		expect_owner(fd[i]);
}

static const struct scenario scenarios[] = {
	{ "numbers", numbers_setup, numbers_disturb, numbers_verify },
	{ "numbers-closed", numbers_setup, numbers_close, numbers_verify },
	{ "numbers-left", numbers_setup, nothing, numbers_verify },
	{ "unread", unread_setup, unread_disturb, unread_verify },
	{ "unread-read", unread_setup, read_disturb, lost_verify },
	{ "unread-closed", unread_setup, reopened_disturb, lost_verify },
	{ "timers", timers_setup, timers_disturb, timers_verify },
	{ "periods", periods_setup, nothing, periods_verify },
	{ "owner", owner_setup, nothing, owner_verify },
};

int main(int argc, char **argv)
{
	play(argc, argv, scenarios, sizeof scenarios / sizeof *scenarios);
}
