/* SPDX-License-Identifier: Apache-2.0
 *
 * Sockets with messages in them, and what else holds on to others.
 *
 *   sockets SCENARIO FOLDER     see scenario.h
 */
#include <grp.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/epoll.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>

#include "scenario.h"

/* ---- messages ------------------------------------------------------------------ */

static void say(int f, const char *text)
{
	must(send(f, text, strlen(text), MSG_NOSIGNAL) == (ssize_t)strlen(text), "send");
}

static void say_all(void)
{
	say(fd[0], "one");
	say(fd[0], "and two");
	say(fd[2], "a record");
	say(fd[2], "another");
	say(fd[4], "of a closed pair");
}

static void messages_setup(void)
{
	must(socketpair(AF_UNIX, SOCK_DGRAM, 0, fd) == 0 &&
		     socketpair(AF_UNIX, SOCK_SEQPACKET, 0, fd + 2) == 0 &&
		     socketpair(AF_UNIX, SOCK_DGRAM, 0, fd + 4) == 0 &&
		     socketpair(AF_UNIX, SOCK_SEQPACKET, 0, fd + 6) == 0,
	     "socketpair");
	say_all();
}

static void messages_disturb(void)
{
	must(read(fd[1], scratch, 100) == 3, "read");
	say(fd[1], "an answer");
	must(read(fd[3], scratch, 100) == 8 && read(fd[3], scratch, 100) == 7, "read");
	close(fd[5]);
	say(fd[7], "new");
}

static void expect_none(int f)
{
	CHECK(recv(f, scratch, 10, MSG_DONTWAIT) < 0 && errno == EAGAIN,
	      "a message that was not there");
}

static void messages_verify(void)
{
	int offset = 0;
	socklen_t bytes = sizeof offset;

	expect_text(fd[1], "one", "a datagram");
	expect_text(fd[1], "and two", "the second datagram");
	expect_text(fd[3], "a record", "a record");
	expect_text(fd[3], "another", "the second record");
	expect_text(fd[5], "of a closed pair", "a pair that was closed");
	for (int i = 0; i < 8; i++)
		expect_none(fd[i]);
	CHECK(getsockopt(fd[1], SOL_SOCKET, SO_PEEK_OFF, &offset, &bytes) == 0 && offset == -1,
	      "SO_PEEK_OFF is %d", offset);
	say_all();
}

/* ---- descriptors in flight that stay there -------------------------------------------- */

static void give(int to, const char *text, int f)
{
	char control[CMSG_SPACE(sizeof(int))] = { 0 };
	struct iovec io = { (void *)(uintptr_t)text, strlen(text) };
	struct msghdr head = { .msg_iov = &io,
			       .msg_iovlen = 1,
			       .msg_control = control,
			       .msg_controllen = sizeof control };
	struct cmsghdr *c = CMSG_FIRSTHDR(&head);

	c->cmsg_level = SOL_SOCKET;
	c->cmsg_type = SCM_RIGHTS;
	c->cmsg_len = CMSG_LEN(sizeof(int));
	memcpy(CMSG_DATA(c), &f, sizeof f);
	must(sendmsg(to, &head, 0) == (ssize_t)strlen(text), "sendmsg");
}

static struct ucred sender;

/* The descriptor that came with it, or -1. */
static int take(int from, const char *text)
{
	char control[256], got[64];
	struct iovec io = { got, sizeof got };
	struct msghdr head = { .msg_iov = &io,
			       .msg_iovlen = 1,
			       .msg_control = control,
			       .msg_controllen = sizeof control };
	const ssize_t n = recvmsg(from, &head, MSG_DONTWAIT);
	int f = -1;

	CHECK(n == (ssize_t)strlen(text) && !memcmp(got, text, (size_t)n), "%zd of \"%s\"", n,
	      text);
	memset(&sender, 0, sizeof sender);
	for (struct cmsghdr *c = CMSG_FIRSTHDR(&head); c; c = CMSG_NXTHDR(&head, c))
		if (c->cmsg_type == SCM_RIGHTS)
			memcpy(&f, CMSG_DATA(c), sizeof f);
		else if (c->cmsg_type == SCM_CREDENTIALS)
			memcpy(&sender, CMSG_DATA(c), sizeof sender);
	return f;
}

/* `out` and `in` of a pipe; `inner` is a socket of a pair, of which fd[11] is the other one. */
static void send_flight(int out, int in, int inner)
{
	must(write(in, "of it", 5) == 5, "write");
	give(fd[0], "with a pipe", out);
	say(fd[0], "with none");
	give(fd[2], "a record", in);
	say(fd[4], "before ");
	give(fd[4], "with", fd[10]);
	say(fd[4], " after");
	give(fd[11], "nested", fd[10]);
	give(fd[6], "outer", inner);
	say(fd[8], "who am I");
	close(out);
	close(in);
	close(inner);
}

static void flight_setup(void)
{
	const int on = 1;
	int ends[2], pair[2];

	for (int i = 0; i < 5; i++)
		must(socketpair(AF_UNIX,
				i == 1   ? SOCK_SEQPACKET
				: i == 2 ? SOCK_STREAM
					 : SOCK_DGRAM,
				0, fd + 2 * i) == 0,
		     "socketpair");
	fd[10] = open("/etc/passwd", O_RDONLY);
	must(!setsockopt(fd[9], SOL_SOCKET, SO_PASSCRED, &on, sizeof on), "SO_PASSCRED");
	must(!pipe(ends) && !socketpair(AF_UNIX, SOCK_DGRAM, 0, pair), "pipe");
	fd[11] = pair[0];
	send_flight(ends[0], ends[1], pair[1]);
}

static bool is_passwd(int f)
{
	return f >= 0 && syscall(SYS_kcmp, getpid(), getpid(), 0, f, fd[10]) == 0;
}

static void flight_verify(void)
{
	const int out = take(fd[1], "with a pipe");
	int in, inner, file;

	CHECK(take(fd[1], "with none") < 0, "a descriptor with the second message");
	in = take(fd[3], "a record");
	CHECK(out >= 0 && in >= 0, "descriptors of the pipe: %d, %d", out, in);
	expect_text(out, "of it", "the pipe that was on its way");
	must(write(in, "new", 3) == 3, "write");
	expect_text(out, "new", "the pipe whose ends were on their way");
	file = take(fd[5], "before with"); /* a descriptor ends what is read at once */
	CHECK(is_passwd(file), "descriptor %d of the stream", file);
	CHECK(take(fd[5], " after") < 0, "a descriptor with the last bytes");
	inner = take(fd[7], "outer");
	CHECK(inner >= 0, "no socket was on its way");
	close(file);
	file = take(inner, "nested");
	CHECK(is_passwd(file), "descriptor %d of what is in it", file);
	(void)take(fd[9], "who am I");
	CHECK(sender.pid == getpid(), "it came from %d", sender.pid);
	close(file);
	send_flight(out, in, inner);
}

/* ---- descriptors in flight that are taken, and used up: as a server's that gives its connections to
 * workers ---- */

/* A connection that nobody else has, as given away. */
static int connection(void)
{
	struct sockaddr_in here = { .sin_family = AF_INET,
				    .sin_addr.s_addr = htonl(INADDR_LOOPBACK) };
	socklen_t bytes = sizeof here;
	const int l = socket(AF_INET, SOCK_STREAM, 0), client = socket(AF_INET, SOCK_STREAM, 0);
	int accepted;

	must(!bind(l, (void *)&here, sizeof here) && !listen(l, 1) &&
		     !getsockname(l, (void *)&here, &bytes) &&
		     !connect(client, (void *)&here, bytes),
	     "connect");
	accepted = accept(l, NULL, NULL);
	must(accepted >= 0, "accept");
	close(l);
	close(client);
	return accepted;
}

static void send_all(void)
{
	const int given = connection();

	say(fd[0], "nothing, ");
	give(fd[0], "a connection", given);
	give(fd[0], "a file", fd[10]);
	say(fd[0], " and the end");
	give(fd[2], "a pipe", fd[5]);
	say(fd[2], "a record without");
	give(fd[2], "itself", fd[3]);
	close(given);
}

static void taken_setup(void)
{
	int ends[2];

	must(socketpair(AF_UNIX, SOCK_STREAM, 0, fd) == 0 &&
		     socketpair(AF_UNIX, SOCK_SEQPACKET, 0, fd + 2) == 0 && pipe(ends) == 0,
	     "socketpair");
	fd[4] = ends[0];
	fd[5] = ends[1];
	fd[10] = open("/etc/passwd", O_RDONLY);
	send_all();
}

static void taken_take(void)
{
	const int given = take(fd[1], "nothing, a connection"), file = take(fd[1], "a file"),
		  none = take(fd[1], " and the end"), in = take(fd[3], "a pipe");
	int other;

	CHECK(given >= 0 && recv(given, scratch, 1, MSG_DONTWAIT) == 0,
	      "descriptor %d is no connection that has ended", given);
	CHECK(is_passwd(file), "descriptor %d is another file", file);
	CHECK(none < 0, "a descriptor with the last bytes");
	CHECK(in >= 0 && write(in, "through it", 10) == 10, "descriptor %d is no pipe", in);
	expect_text(fd[4], "through it", "the pipe whose end was given");
	CHECK(take(fd[3], "a record without") < 0, "a descriptor with a record without one");
	other = take(fd[3], "itself");
	CHECK(syscall(SYS_kcmp, getpid(), getpid(), 0, other, fd[3]) == 0,
	      "descriptor %d is another socket", other);
	close(given);
	close(file);
	close(in);
	close(other);
}

/* Its next life takes them again. */
static void taken_verify(void)
{
	taken_take();
	send_all();
}

/* ---- descriptors in flight that nobody has any more: lost, and told --------------------------------- */

static void rights_setup(void)
{
	int ends[2];

	must(socketpair(AF_UNIX, SOCK_STREAM, 0, fd) == 0 && pipe(ends) == 0, "socketpair");
	give(fd[0], "x", ends[0]);
	close(ends[0]);
	close(ends[1]);
}

static void rights_disturb(void)
{
	must(read(fd[1], scratch, 1) == 1, "read");
}

/* ---- ends that are shut ------------------------------------------------------------------ */

static const int shut_types[] = { SOCK_DGRAM, SOCK_SEQPACKET, SOCK_STREAM };

static void shut_setup(void)
{
	struct epoll_event event = { .events = EPOLLIN };

	fd[20] = epoll_create1(0);
	for (int i = 0; i < 3; i++) {
		must(socketpair(AF_UNIX, shut_types[i], 0, fd + 6 * i) == 0 &&
			     socketpair(AF_UNIX, shut_types[i], 0, fd + 6 * i + 2) == 0 &&
			     socketpair(AF_UNIX, shut_types[i], 0, fd + 6 * i + 4) == 0,
		     "socketpair");
		say(fd[6 * i], "the last");
		must(!shutdown(fd[6 * i], SHUT_WR), "shutdown");
		say(fd[6 * i + 2], "still open");
		say(fd[6 * i + 4], "is closed");
		for (int k = 1; k < 6; k += 2) {
			event.data.fd = fd[6 * i + k];
			must(!epoll_ctl(fd[20], EPOLL_CTL_ADD, event.data.fd, &event), "epoll_ctl");
		}
	}
}

/* The third pair is closed. */
static void shut_disturb(void)
{
	for (int i = 0; i < 3; i++) {
		(void)recv(fd[6 * i + 1], scratch, 8, MSG_DONTWAIT); /* verify() reads it, too */
		must(!shutdown(fd[6 * i + 2], SHUT_WR), "shutdown");
		must(!shutdown(fd[6 * i + 3], i == 1 ? SHUT_RDWR : SHUT_WR), "shutdown");
		close(fd[6 * i + 4]);
		close(fd[6 * i + 5]);
	}
}

static void shut_verify(void)
{
	static bool last_is_read; /* before the checkpoint                              */
	struct epoll_event events[16];
	int seen = 0;

	for (int i = 0; i < 3; i++) {
		if (!last_is_read)
			expect_text(fd[6 * i + 1], "the last", "a pair that is shut");
		CHECK(send(fd[6 * i], "x", 1, MSG_NOSIGNAL) < 0 && errno == EPIPE, "it is open");
		CHECK(i == 0 || recv(fd[6 * i + 1], scratch, 1, MSG_DONTWAIT) == 0, "no end");
		say(fd[6 * i + 1], "back");
		expect_text(fd[6 * i], "back", "the other way");
		expect_text(fd[6 * i + 3], "still open", "a pair that is open");
		expect_text(fd[6 * i + 5], "is closed", "a pair that is closed later");
		for (int k = 2; k < 6; k++) {
			say(fd[6 * i + k], "and is");
			expect_text(fd[6 * i + (k ^ 1)], "and is", "it");
		}
		say(fd[6 * i + 2], "still open");
		say(fd[6 * i + 4], "is closed");
	}
	last_is_read = true;
	for (int n = epoll_wait(fd[20], events, 16, 0), i = 0; i < n; i++)
		for (int k = 0; k < 18; k++)
			seen += k % 6 != 1 && events[i].data.fd == fd[k] ? 1 : 0;
	CHECK(seen == 6, "%d of the open pairs were heard of", seen);
}

/* ---- pidfds ----------------------------------------------------------------------------- */

static int pidfd_of(pid_t pid, unsigned int flags)
{
	return (int)syscall(SYS_pidfd_open, pid, flags);
}

static void pidfds_setup(void)
{
	fd[0] = pidfd_of(getppid(), 0);
	fd[1] = pidfd_of(getpid(), 0);
	fd[2] = pidfd_of(getpid(), O_NONBLOCK);
	fd[3] = dup(fd[1]);
	must(fd[0] >= 0 && fd[1] >= 0 && fd[2] >= 0 && fd[3] >= 0, "pidfd_open");
}

static void pidfds_disturb(void)
{
	close(fd[0]);
	close(fd[2]);
}

static void expect_process(int f, pid_t pid)
{
	struct pollfd p = { .fd = f, .events = POLLIN };
	char path[48], text[512], *line;
	ssize_t n;
	int info;

	CHECK(poll(&p, 1, 0) == 0, "the process of pidfd %d has ended", f);
	CHECK(!syscall(SYS_pidfd_send_signal, f, 0, NULL, 0), "pidfd %d: %s", f, strerror(errno));
	snprintf(path, sizeof path, "/proc/self/fdinfo/%d", f);
	info = open(path, O_RDONLY);
	n = read(info, text, sizeof text - 1);
	close(info);
	text[n > 0 ? n : 0] = 0;
	line = strstr(text, "\nPid:");
	CHECK(line && atoi(line + 5) == pid, "pidfd %d is not of %d: %s", f, pid, text);
}

static void pidfds_verify(void)
{
	expect_process(fd[0], getppid());
	for (int i = 1; i <= 3; i++)
		expect_process(fd[i], getpid());
	CHECK(fcntl(fd[2], F_GETFL) & O_NONBLOCK && fcntl(fd[2], F_GETFD) == FD_CLOEXEC &&
		      !fcntl(fd[3], F_GETFD),
	      "the flags of a pidfd");
}

/* ---- and no room for more ------------------------------------------------------------------ */

#define FULL 64
#define BEYOND 900

/* All numbers are taken that it may have, and a pidfd has one that it may have no more. */
static void full_setup(void)
{
	struct rlimit limit;

	fd[0] = pidfd_of(getpid(), 0);
	must(dup2(fd[0], BEYOND) == BEYOND, "dup2");
	must(!getrlimit(RLIMIT_NOFILE, &limit), "getrlimit");
	limit.rlim_cur = FULL;
	must(!setrlimit(RLIMIT_NOFILE, &limit), "setrlimit");
	while (dup(STDOUT_FILENO) >= 0)
		;
}

static void full_verify(void)
{
	struct rlimit limit;

	CHECK(dup(STDOUT_FILENO) < 0 && errno == EMFILE && !getrlimit(RLIMIT_NOFILE, &limit) &&
		      limit.rlim_cur == FULL && limit.rlim_max > BEYOND,
	      "another limit");
	close(FULL - 1);
	expect_process(fd[0], getpid());
	expect_process(BEYOND, getpid());
	CHECK(dup(STDOUT_FILENO) == FULL - 1, "another number");
}

/* ---- a child that is watched, as event loops do ------------------------------------------- */

static pid_t watched;

static void watch_child(void)
{
	struct epoll_event event = { .events = EPOLLIN, .data.u64 = 7 };

	watched = fork();
	must(watched >= 0, "fork");
	while (!watched)
		pause();
	fd[1] = pidfd_of(watched, 0);
	must(fd[1] >= 0 && epoll_ctl(fd[0], EPOLL_CTL_ADD, fd[1], &event) == 0, "epoll_ctl");
}

static void child_setup(void)
{
	fd[0] = epoll_create1(EPOLL_CLOEXEC);
	watch_child();
}

static void end_child(void)
{
	struct epoll_event event = { 0 };
	int n;

	must(kill(watched, SIGKILL) == 0, "kill");
	n = epoll_wait(fd[0], &event, 1, 2000);
	CHECK(n == 1 && event.data.u64 == 7, "the end of a child was not told");
	CHECK(waitpid(watched, NULL, 0) == watched, "waitpid: %s", strerror(errno));
	close(fd[1]);
}

/* Another one in its place. */
static void child_disturb(void)
{
	end_child();
	watch_child();
}

static void child_verify(void)
{
	struct epoll_event event;

	CHECK(epoll_wait(fd[0], &event, 1, 0) == 0, "a child that is there was said to have ended");
	expect_process(fd[1], watched);
	end_child();
	watch_child();
}

/* ---- who made them -------------------------------------------------------------------- */

enum { NOBODY = 65534 };

static void user_setup(void)
{
	must(!setgroups(0, NULL) && !setresgid(NOBODY, NOBODY, NOBODY) &&
		     !setresuid(NOBODY, NOBODY, NOBODY),
	     "setresuid");
	must(socketpair(AF_UNIX, SOCK_STREAM, 0, fd) == 0 &&
		     socketpair(AF_UNIX, SOCK_SEQPACKET, 0, fd + 2) == 0 &&
		     socketpair(AF_UNIX, SOCK_STREAM, 0, fd + 4) == 0 && pipe(fd + 6) == 0,
	     "socketpair");
	close(fd[5]);
}

static void user_disturb(void)
{
	for (int i = 0; i < 8; i++)
		close(fd[i]);
}

static void user_verify(void)
{
	struct stat st;

	for (int i = 0; i < 5; i++) {
		struct ucred peer = { 0 };
		socklen_t bytes = sizeof peer;

		CHECK(getsockopt(fd[i], SOL_SOCKET, SO_PEERCRED, &peer, &bytes) == 0 &&
			      peer.uid == NOBODY && peer.gid == NOBODY,
		      "socket %d is of user %d", i, (int)peer.uid);
	}
	CHECK(fstat(fd[6], &st) == 0 && st.st_uid == NOBODY, "a pipe is of user %d",
	      (int)st.st_uid);
}

/* ---- who sent what is in them ------------------------------------------------------- */

static uid_t sender_of_order(int from)
{
	union {
		char bytes[CMSG_SPACE(sizeof(struct ucred))];
		struct cmsghdr head;
	} control;
	struct iovec io = { scratch, 100 };
	struct msghdr head = { .msg_iov = &io,
			       .msg_iovlen = 1,
			       .msg_control = &control,
			       .msg_controllen = sizeof control };
	struct ucred ucred;

	must(recvmsg(from, &head, MSG_DONTWAIT) == 5 && head.msg_controllen, "recvmsg");
	memcpy(&ucred, CMSG_DATA(&control.head), sizeof ucred);
	return ucred.uid;
}

static void senders_setup(void)
{
	const int yes = 1;

	must(!setgroups(0, NULL) && !setresgid(NOBODY, NOBODY, NOBODY) &&
		     !setresuid(NOBODY, NOBODY, NOBODY),
	     "setresuid");
	must(socketpair(AF_UNIX, SOCK_SEQPACKET, 0, fd) == 0 &&
		     setsockopt(fd[1], SOL_SOCKET, SO_PASSCRED, &yes, sizeof yes) == 0,
	     "socketpair");
	/* This has the kernel name the one that sends. */
	must(socketpair(AF_UNIX, SOCK_DGRAM, 0, fd + 2) == 0 &&
		     setsockopt(fd[2], SOL_SOCKET, SO_PASSCRED, &yes, sizeof yes) == 0 &&
		     setsockopt(fd[3], SOL_SOCKET, SO_PASSCRED, &yes, sizeof yes) == 0,
	     "socketpair");
	say(fd[0], "order");
	say(fd[2], "order");
}

static void senders_disturb(void)
{
	must(sender_of_order(fd[1]) == NOBODY && sender_of_order(fd[3]) == NOBODY, "sender");
}

static void senders_verify(void)
{
	CHECK(sender_of_order(fd[1]) == NOBODY, "an order has become one of root");
	CHECK(sender_of_order(fd[3]) == NOBODY,
	      "an order between named ones has become one of root");
}

static const struct scenario scenarios[] = {
	{ "messages", messages_setup, messages_disturb, messages_verify },
	{ "child", child_setup, child_disturb, child_verify },
	{ "pidfds", pidfds_setup, pidfds_disturb, pidfds_verify },
	{ "full", full_setup, nothing, full_verify },
	{ "rights", rights_setup, rights_disturb, nothing },
	{ "taken", taken_setup, taken_take, taken_verify },
	{ "flight", flight_setup, nothing, flight_verify },
	{ "shut", shut_setup, shut_disturb, shut_verify },
	{ "user", user_setup, user_disturb, user_verify },
	{ "senders", senders_setup, senders_disturb, senders_verify },
};

int main(int argc, char **argv)
{
	play(argc, argv, scenarios, sizeof scenarios / sizeof *scenarios);
}
