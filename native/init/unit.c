/* SPDX-License-Identifier: Apache-2.0
 *
 * A unit of protection below a launcher: registers itself with the sidecar.
 *
 *   $AVCKPT_INIT [--name NAME] [--label avckpt.KEY=VALUE ...] -- PROGRAM [ARG...]
 *
 * It connects to the sidecar's socket for units and sends one packet, with a pidfd of its own:
 * fields that end with a NUL, "avckpt-unit 1", "name=NAME", "program=PROGRAM" and any number of
 * "label=KEY=VALUE". The answer is one packet, too: "ok", "later WHY" or "no WHY". The connection
 * stays open: when it closes, the sidecar has exited, and init looks for the next one.
 *
 * The program does not wait for any of this: it runs, protected or not.
 */
#include "init.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#define GREETING "avckpt-unit 1"
#define PACKET_MAX 16384 /* UNIT_BYTES of the sidecar's */
#define ANSWER_MAX 1024
#define RETRY_NS (2000 * NS_PER_MS)
#define END_MS 500

/* Where the sidecar's socket may be, in this order: as set by `avckpt run`, where the hook has put
 * it in a container, and on the host. */
#define UNITS_ENV "AVCKPT_UNITS"
#define UNITS_IN_CONTAINER "/run/avckpt-units/units.sock"
#define UNITS_ON_HOST "/units/units.sock"
#define RUN_DIR "/run/avckpt"

static struct {
	char packet[PACKET_MAX];
	size_t used;
	bool wanted;
	const char *name;
	char path[sizeof(((struct sockaddr_un *)0)->sun_path)];
	bool looking; /* for a sidecar, or answer */
	bool told;    /* that there is none */
	int fd;
	uint64_t due_ns;
} unit = { .fd = -1 };

static bool add(const char *key, const char *value)
{
	const size_t left = sizeof(unit.packet) - unit.used;
	const int n = snprintf(unit.packet + unit.used, left, "%s%s", key, value);

	if (n < 0 || (size_t)n >= left)
		return false;
	unit.used += (size_t)n + 1; /* the NUL is part of it */
	return true;
}

static bool begin_packet(void)
{
	return unit.used || add(GREETING, "");
}

bool unit_take_label(const char *text)
{
	unit.wanted = true;
	return text && strchr(text, '=') && begin_packet() && add("label=", text);
}

bool unit_take_name(const char *text)
{
	unit.wanted = true;
	unit.name = text;
	return text && *text && begin_packet() && add("name=", text);
}

bool unit_is_wanted(void)
{
	return unit.wanted || getenv("AVCKPT_INIT");
}

/* Separated by blanks: a value with blanks needs the option. */
static bool add_labels_of_environment(void)
{
	const char *at = getenv("AVCKPT_LABELS");

	while (at && *at) {
		const size_t blank = strspn(at, " \t\n"), length = strcspn(at + blank, " \t\n");
		char label[1024];

		at += blank;
		if (!length)
			break;
		if (length >= sizeof(label))
			return false;
		memcpy(label, at, length);
		label[length] = '\0';
		if (!add("label=", label))
			return false;
		at += length;
	}
	return true;
}

/* Whether a socket exists, or can appear there. */
static bool try_path(const char *directory, const char *file)
{
	char folder[PATH_MAX];
	struct stat st;
	char *slash;
	int n;

	n = snprintf(unit.path, sizeof(unit.path), "%s%s", directory, file);
	if (n < 0 || (size_t)n >= sizeof(unit.path))
		return false;
	snprintf(folder, sizeof(folder), "%s", unit.path);
	slash = strrchr(folder, '/');
	if (!slash)
		return false;
	*slash = '\0';
	return stat(folder, &st) == 0 && S_ISDIR(st.st_mode);
}

static bool find_socket(void)
{
	const char *given = getenv(UNITS_ENV), *run_dir = getenv("AVCKPT_RUN_DIR");

	if (given)
		return try_path(given, "");
	return try_path(UNITS_IN_CONTAINER, "") ||
	       try_path(run_dir && *run_dir ? run_dir : RUN_DIR, UNITS_ON_HOST);
}

bool unit_begin(const char *program)
{
	const char *outer = getenv("AVCKPT_UNIT");
	const char *slash = strrchr(program, '/');

	if (outer) {
		say("%s is part of %s, and is protected with it", program, outer);
		return false;
	}
	/* The last one wins: options over the environment. */
	if (unit.used) {
		static char options[PACKET_MAX];
		const size_t from = strlen(GREETING) + 1, length = unit.used - from;

		memcpy(options, unit.packet + from, length);
		unit.used = 0;
		if (!begin_packet() || !add_labels_of_environment() ||
		    length > sizeof(unit.packet) - unit.used)
			goto too_long;
		memcpy(unit.packet + unit.used, options, length);
		unit.used += length;
	} else if (!begin_packet() || !add_labels_of_environment()) {
		goto too_long;
	}
	if (!unit.name)
		unit.name = slash ? slash + 1 : program;
	if (!add("program=", slash ? slash + 1 : program))
		goto too_long;
	if (!find_socket()) {
		say("%s runs unprotected: there is no avckpt here; in a container that takes the label "
		    "avckpt.scope=nodes",
		    program);
		return false;
	}
	unit.looking = true;
	return true;
too_long:
	say("%s runs unprotected: its labels are longer than %d bytes", program, PACKET_MAX);
	return false;
}

void unit_mark_environment(void)
{
	setenv("AVCKPT_UNIT", unit.name, 1);
}

int unit_fd(void)
{
	return unit.fd;
}

uint64_t unit_due_ns(void)
{
	return unit.looking && unit.fd < 0 ? unit.due_ns : UINT64_MAX;
}

static void hang_up(void)
{
	if (unit.fd >= 0)
		close(unit.fd);
	unit.fd = -1;
	unit.due_ns = now_ns() + RETRY_NS;
}

static int send_packet(void)
{
	int pidfd = (int)syscall(SYS_pidfd_open, getpid(), 0), sent;
	union {
		char bytes[CMSG_SPACE(sizeof(int))];
		struct cmsghdr align;
	} control = { { 0 } };
	struct iovec data = { unit.packet, unit.used };
	struct msghdr message = { .msg_iov = &data,
				  .msg_iovlen = 1,
				  .msg_control = &control,
				  .msg_controllen = sizeof(control) };
	struct cmsghdr *header = CMSG_FIRSTHDR(&message);

	if (pidfd < 0)
		return -1;
	header->cmsg_level = SOL_SOCKET;
	header->cmsg_type = SCM_RIGHTS;
	header->cmsg_len = CMSG_LEN(sizeof(int));
	memcpy(CMSG_DATA(header), &pidfd, sizeof(pidfd));
	sent = sendmsg(unit.fd, &message, MSG_NOSIGNAL | MSG_DONTWAIT) == (ssize_t)unit.used ? 0
											     : -1;
	close(pidfd);
	return sent;
}

static int connect_and_send(void)
{
	struct sockaddr_un address = { .sun_family = AF_UNIX };

	memcpy(address.sun_path, unit.path, sizeof(address.sun_path));
	unit.fd = above_stdio(socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
	if (unit.fd < 0 || connect(unit.fd, (struct sockaddr *)&address, sizeof(address)))
		return -1;
	return send_packet();
}

/* The sidecar's answer is a message for the user, except for its first word. */
static void take_answer(const char *program, char *answer)
{
	const bool later = !strncmp(answer, "later ", 6);

	if (!strcmp(answer, "ok")) {
		unit.told = false;
		return;
	}
	if (!later || !unit.told)
		say("%s runs unprotected: %s", program,
		    strchr(answer, ' ') ? strchr(answer, ' ') + 1 : answer);
	unit.told = true;
	unit.looking = later;
	hang_up();
}

void unit_tend(const char *program)
{
	char answer[ANSWER_MAX + 1];
	ssize_t n;

	if (unit.fd < 0) {
		if (!unit.looking || now_ns() < unit.due_ns || connect_and_send() == 0)
			return;
		if (!unit.told)
			say("%s runs unprotected until the sidecar is started (%s: %s)", program,
			    unit.path, strerror(errno));
		unit.told = true;
		hang_up();
		return;
	}
	n = recv(unit.fd, answer, ANSWER_MAX, MSG_DONTWAIT);
	if (n < 0 && (errno == EAGAIN || errno == EINTR))
		return;
	if (n <= 0) {
		hang_up();
		return;
	}
	answer[n] = '\0';
	take_answer(program, answer);
}

/* ---- its end ------------------------------------------------------------------------ */

static bool file_begins(pid_t pid, const char *file, const char *start)
{
	char path[64], text[32];
	ssize_t n;
	int fd;

	snprintf(path, sizeof(path), "/proc/%d/%s", pid, file);
	fd = open(path, O_RDONLY | O_CLOEXEC);
	n = fd < 0 ? -1 : read(fd, text, sizeof(text) - 1);
	if (fd >= 0)
		close(fd);
	text[n > 0 ? n : 0] = '\0';
	return n > 0 && !strncmp(text, start, strlen(start));
}

/* A child of ours that never runs the program's code; a zombie still has its name. */
static bool is_template(pid_t pid)
{
	return file_begins(pid, "comm", "avckpt-tmpl\n") ||
	       file_begins(pid, "comm", "avckpt-spare\n") ||
	       file_begins(pid, "comm", "avckpt-hold\n");
}

static bool kill_templates(void)
{
	char path[64], text[4096], *at = text, *end;
	bool any = false;
	ssize_t n;
	int fd;

	snprintf(path, sizeof(path), "/proc/self/task/%d/children", getpid());
	fd = open(path, O_RDONLY | O_CLOEXEC);
	n = fd < 0 ? -1 : read(fd, text, sizeof(text) - 1);
	if (fd >= 0)
		close(fd);
	text[n > 0 ? n : 0] = '\0';
	if (n == (ssize_t)sizeof(text) - 1)
		*(strrchr(text, ' ') ?: text) = '\0'; /* a number may be cut in two */
	/* Unreaped children of ours: no number in here can be stale. */
	for (;; at = end) {
		const pid_t pid = (pid_t)strtol(at, &end, 10);

		if (end == at)
			return any;
		if (pid <= 1 || !is_template(pid))
			continue;
		any = true;
		kill(pid, SIGKILL);
		waitpid(pid, NULL, WNOHANG | __WALL);
	}
}

void unit_end_templates(void)
{
	const uint64_t deadline_ns = now_ns() + END_MS * NS_PER_MS;
	const struct timespec nap = { .tv_nsec = (long)NS_PER_MS };

	while (kill_templates() && now_ns() < deadline_ns)
		nanosleep(&nap, NULL);
}

void unit_finish(int status)
{
	const struct rlimit none = { 0, 0 };
	const struct sigaction plain = { .sa_handler = SIG_DFL };
	uint64_t mask;

	if (!WIFSIGNALED(status))
		_exit(WEXITSTATUS(status));
	/* The launcher wants the signal that killed it, but not a core of ours. */
	setrlimit(RLIMIT_CORE, &none);
	sigaction(WTERMSIG(status), &plain, NULL);
	mask = ~(UINT64_C(1) << (WTERMSIG(status) - 1));
	syscall(SYS_rt_sigprocmask, SIG_SETMASK, &mask, NULL, sizeof(mask));
	syscall(SYS_kill, getpid(), WTERMSIG(status));
	_exit(128 + WTERMSIG(status)); /* PID 1 cannot be killed that way */
}
