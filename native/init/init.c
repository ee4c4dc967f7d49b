/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt-init: the main process of a protected container, parent of the app.
 *
 *   avckpt-init [--wait-ms N] [--stop-signal N] [--] PROGRAM [ARG...]
 *
 * Below a launcher it is the parent of one program, a unit (unit.c):
 *
 *   avckpt-init [--name NAME] [--label avckpt.KEY=VALUE ...] [--] PROGRAM [ARG...]
 *
 * It does what every container init does (forwards signals, reaps zombies, ends with the app's
 * status), and one thing more: when the app dies unrequested, it does not exit but reports the
 * death to the guard, and becomes the parent of the process that the guard puts in the app's place.
 * Their protocol is in avckpt/ctl.h.
 *
 * The app comes first. Whatever fails in here before the app is started makes it run unprotected,
 * under a plain init, but never prevents it from running.
 *
 * Nothing is allocated after the start, and nothing blocks but one ppoll(2).
 * All signals are blocked for good and read from a signalfd, so there are no
 * handlers and no races with them.
 */
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <poll.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/signalfd.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <time.h>
#include <unistd.h>

#include "avckpt/ctl.h"
#include "init.h"
#include "keys.h"
#include "program.h"

#define NAME "avckpt-init"
#define EXIT_USAGE 125 /* init's own failure, as for Podman */
#define END_CHILDREN_MS 500
#define READER_MS 200 /* whoever reads our messages does so within this time */
#define KEYS_MS 10000 /* an exit within this time after Ctrl-C was requested */
#define VERDICTS_PER_ROUND 1024

#ifndef MFD_NOEXEC_SEAL
#define MFD_NOEXEC_SEAL 8U
#endif

#define SIGBIT(sig) (UINT64_C(1) << ((sig)-1))

/* Our descriptors; all of them are close-on-exec and above stderr. */
enum {
	CTL,
	REPORT_READ,
	REPORT_WRITE,
	VERDICT,
	VERDICT_WRITE,
	EXEC,
	EXEC_WRITE,
	SIGNALS,
	TTY,
	FDS
};

static struct {
	struct avc_ctl *ctl; /* NULL: this is a plain init */
	int fd[FDS];         /* -1: none */
	pid_t pid;
	pid_t app_pid;
	const char *app_name;
	int stop_signal;
	uint32_t wait_ms;
	bool is_unit;      /* below a launcher: unit.c */
	bool shares_group; /* the program is in our process group */

	bool waiting; /* reported death `seq`, waits for the verdict */
	uint32_t seq;
	int status;              /* of the death that was reported */
	int attempt_status;      /* of the last app that died while waiting ... */
	uint64_t attempt_ns;     /* ... and when */
	uint64_t deadline_ns;    /* of the wait */
	uint64_t deferred;       /* SIGBITs that arrived while there was no app */
	uint64_t stop_ns;        /* when a stop was last requested, 0: never */
	uint64_t sent_ns[_NSIG]; /* when each signal was forwarded last */

	uint64_t mask;         /* the signal mask we were started with */
	struct sigaction chld; /* the SIGCHLD disposition we were started with */
} self = { .fd = { [0 ... FDS - 1] = -1 } };

uint64_t now_ns(void)
{
	struct timespec ts;

	clock_gettime(CLOCK_MONOTONIC, &ts);
	return (uint64_t)ts.tv_sec * 1000 * NS_PER_MS + (uint64_t)ts.tv_nsec;
}

/* One line on stderr, in one write so that it is not torn. Where nobody reads it is left out: the app
 * must not fail to start, get a signal or end because of it. */
void say(const char *format, ...)
{
	struct pollfd out = { .fd = STDERR_FILENO, .events = POLLOUT };
	char line[PIPE_BUF] = NAME ": ";
	size_t len = strlen(line);
	va_list args;
	int n;

	va_start(args, format);
	n = vsnprintf(line + len, sizeof(line) - len - 1, format, args);
	va_end(args);
	if (n < 0)
		return;
	len += (size_t)n < sizeof(line) - len - 1 ? (size_t)n : sizeof(line) - len - 2;
	line[len++] = '\n';
	/* A pipe that has room has room for PIPE_BUF. Nowhere to report a failure. */
	if (poll(&out, 1, READER_MS) != 1 || write(STDERR_FILENO, line, len) < 0)
		return;
}

/* glibc's sigset functions hide the two signals it uses itself; a container's
 * init has to see every one.  The kernel's mask is 64 bits on Linux. */
static int mask_set(uint64_t mask, uint64_t *old)
{
	return (int)syscall(SYS_rt_sigprocmask, SIG_SETMASK, &mask, old, sizeof(mask));
}

/* Moves a new descriptor above stderr: if 0..2 were closed at our start, new ones land there, and
 * our messages would be written into them. */
int above_stdio(int fd)
{
	int high;

	if (fd < 0 || fd > STDERR_FILENO)
		return fd;
	high = fcntl(fd, F_DUPFD_CLOEXEC, STDERR_FILENO + 1);
	close(fd);
	return high;
}

static void close_fd(int which)
{
	if (self.fd[which] >= 0)
		close(self.fd[which]);
	self.fd[which] = -1;
}

static int make_pipe(int read_end, int write_end)
{
	int ends[2];

	if (pipe2(ends, O_CLOEXEC | O_NONBLOCK) < 0)
		return -1;
	self.fd[read_end] = above_stdio(ends[0]);
	self.fd[write_end] = above_stdio(ends[1]);
	return self.fd[read_end] < 0 || self.fd[write_end] < 0 ? -1 : 0;
}

static int make_ctl_memfd(void)
{
	int fd = memfd_create(AVC_CTL_NAME, MFD_CLOEXEC | MFD_ALLOW_SEALING | MFD_NOEXEC_SEAL);

	if (fd < 0 && errno == EINVAL) /* before Linux 6.3 */
		fd = memfd_create(AVC_CTL_NAME, MFD_CLOEXEC | MFD_ALLOW_SEALING);
	return above_stdio(fd);
}

/* Creates all that the guard needs. On failure reports it and leaves ctl NULL. */
static void protect(void)
{
	const char *what;
	struct avc_ctl *ctl;
	int i;

	what = "memfd_create";
	self.fd[CTL] = make_ctl_memfd();
	if (self.fd[CTL] < 0)
		goto fail;
	what = "ftruncate";
	if (ftruncate(self.fd[CTL], sizeof(*ctl)) < 0)
		goto fail;
	/* Neither side can truncate the page under the other (SIGBUS). */
	what = "seal";
	if (fcntl(self.fd[CTL], F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL) < 0)
		goto fail;
	what = "mmap";
	ctl = mmap(NULL, sizeof(*ctl), PROT_READ | PROT_WRITE, MAP_SHARED, self.fd[CTL], 0);
	if (ctl == MAP_FAILED)
		goto fail;
	what = "pipe";
	if (make_pipe(REPORT_READ, REPORT_WRITE) < 0 || make_pipe(VERDICT, VERDICT_WRITE) < 0 ||
	    make_pipe(EXEC, EXEC_WRITE) < 0)
		goto fail;
	/* The guard's will be the only write end: that is how we see it die. */
	close_fd(VERDICT_WRITE);
	/* An app of the same user must not reach all this through /proc/PID/fd. The app's exec
	 * makes it dumpable again. */
	what = "prctl(PR_SET_DUMPABLE)";
	if (prctl(PR_SET_DUMPABLE, 0, 0, 0, 0) < 0)
		goto fail;

	ctl->version = AVC_CTL_VERSION;
	ctl->init_pid = self.pid;
	ctl->report_fd = self.fd[REPORT_READ];
	ctl->verdict_fd = self.fd[VERDICT];
	ctl->wait_ms = self.wait_ms;
	ctl->is_unit = self.is_unit;
	__atomic_store_n(&ctl->magic, AVC_CTL_MAGIC, __ATOMIC_RELEASE);
	self.ctl = ctl;
	return;
fail:
	say("%s: %s; %s runs unprotected", what, strerror(errno), self.app_name);
	for (i = CTL; i <= EXEC_WRITE; i++)
		close_fd(i);
}

/* Keeps a descriptor of the terminal if we may give it to the app: we are the session leader, or in
 * the foreground group. (A group whose leader is outside our PID namespace is number 0 to us; so is
 * the foreground group if it is outside. Then it is unknown, and foreground is the likely case: a
 * background init would have its own group.) */
static void find_terminal(void)
{
	pid_t foreground = tcgetpgrp(STDIN_FILENO);

	if (foreground < 0) /* no terminal, or not our controlling one */
		return;
	if (getsid(0) != self.pid && foreground != getpgrp())
		return;
	self.fd[TTY] = fcntl(STDIN_FILENO, F_DUPFD_CLOEXEC, STDERR_FILENO + 1);
}

/* The child's way to the app. Everything the app inherits must be as we inherited it. */
static _Noreturn void become_app(char **argv)
{
	char number[16];
	const char *listen_pid = getenv("LISTEN_PID");
	int err;

	if (self.is_unit) {
		/* A unit stays in the launcher's group, and a signal that kills us, the process
		 * known to the launcher, is meant for the program. */
		unit_mark_environment();
		if (getpid() != self.pid) {
			prctl(PR_SET_PDEATHSIG, SIGKILL, 0, 0, 0);
			if (getppid() != self.pid)
				raise(SIGKILL);
		}
	}
	if (!self.shares_group) {
		/* A group of its own, so that the app's kill(0) does not come back to it through
		 * us, and only the app gets the terminal's signals. */
		setpgid(0, 0);
	}
	if (self.fd[TTY] >= 0)
		tcsetpgrp(self.fd[TTY], getpid()); /* SIGTTOU is blocked here */
	/* Socket activation names the process the sockets are for: it was us. */
	if (listen_pid && atoi(listen_pid) == self.pid) {
		snprintf(number, sizeof(number), "%d", getpid());
		setenv("LISTEN_PID", number, 1);
	}
	sigaction(SIGCHLD, &self.chld, NULL);
	mask_set(self.mask, NULL);
	if (self.is_unit)
		execvp(argv[0], argv); /* as nice(1) and env(1) do */
	else
		program_execute(argv);
	err = errno;
	if (self.ctl)
		__atomic_store_n(&self.ctl->exec_errno, err, __ATOMIC_RELEASE);
	/* Without an init in front, Podman's runtime says this before the container is even
	 * started. Here the container ends with the same status. */
	say("%s: %s", argv[0], strerror(err));
	_exit(err == ENOENT ? 127 : 126);
}

/* Closes what we inherited and do not use. What the app closes must be closed: a listening port
 * would stay taken, a pipe's reader would see no end. stderr stays for our messages. */
static void drop_inherited(void)
{
	unsigned int from = STDERR_FILENO + 1;
	int fd, null_fd;

	for (;;) {
		unsigned int next = UINT_MAX;
		int i;

		for (i = 0; i < FDS; i++)
			if (self.fd[i] >= (int)from && (unsigned int)self.fd[i] < next)
				next = (unsigned int)self.fd[i];
		if (next > from)
			syscall(SYS_close_range, from, next - 1, 0); /* Linux 5.9 */
		if (next == UINT_MAX)
			break;
		from = next + 1;
	}
	null_fd = open("/dev/null", O_RDWR | O_CLOEXEC);
	if (null_fd < 0)
		return;
	for (fd = STDIN_FILENO; fd <= STDOUT_FILENO; fd++)
		if (null_fd != fd && fcntl(fd, F_GETFD) >= 0)
			dup2(null_fd, fd);
	if (null_fd > STDERR_FILENO)
		close(null_fd);
}

/* Hears what the app's group is sent; the guard must know that this task is ours. */
static void listen_to_keys(void)
{
	const bool listens = self.is_unit ? self.shares_group : self.fd[TTY] >= 0;
	const pid_t pid = self.ctl && listens ? keys_listen(self.is_unit ? 0 : self.app_pid) : 0;

	if (self.ctl)
		__atomic_store_n(&self.ctl->keys_pid, pid, __ATOMIC_RELEASE);
}

/* Forks the app.  On failure *becomes* the app, with no init at all. */
static void start_app(char **argv)
{
	self.app_pid = fork();
	if (self.app_pid < 0)
		say("fork: %s; %s runs without an init", strerror(errno), self.app_name);
	if (self.app_pid <= 0)
		become_app(argv);
	close_fd(EXEC_WRITE); /* the child's closes by itself when its exec succeeds */
	drop_inherited();
	listen_to_keys();
}

/* Only now may the guard examine the app: before, it was a copy of us. */
static void app_started(void)
{
	close_fd(EXEC);
	if (self.ctl && !__atomic_load_n(&self.ctl->exec_errno, __ATOMIC_ACQUIRE))
		__atomic_store_n(&self.ctl->app_pid, self.app_pid, __ATOMIC_RELEASE);
}

/* The PIDs of our children as text, or of as many as fit in. Unreaped children of ours: no PID in
 * it can be stale. */
static void read_children(char *text, size_t size)
{
	char path[64];
	ssize_t len;
	int fd;

	snprintf(path, sizeof(path), "/proc/self/task/%d/children", self.pid);
	fd = open(path, O_RDONLY | O_CLOEXEC);
	len = fd < 0 ? 0 : read(fd, text, size - 1);
	if (fd >= 0)
		close(fd);
	if (len == (ssize_t)size - 1)
		while (len > 0 && text[len - 1] != ' ')
			len--; /* a number may be cut in two */
	text[len > 0 ? len : 0] = '\0';
}

/* Kills and reaps all our children, within END_CHILDREN_MS.  For the PID 1 of a
 * namespace the kernel does it.  Elsewhere they are the app's orphans and the
 * guard's templates, and would outlive the container. */
static void end_children(void)
{
	uint64_t deadline_ns = now_ns() + END_CHILDREN_MS * NS_PER_MS;
	char text[4096];

	do {
		struct timespec nap = { .tv_nsec = 2 * (long)NS_PER_MS };
		char *at = text, *end;

		read_children(text, sizeof(text));
		for (;; at = end) {
			pid_t pid = (pid_t)strtol(at, &end, 10);

			if (end == at)
				break;
			if (pid > 1)
				kill(pid, SIGKILL);
		}
		while (waitpid(-1, NULL, WNOHANG | __WALL) > 0)
			;
		if (waitpid(-1, NULL, WNOHANG | __WALL) < 0 && errno == ECHILD)
			return;
		/* Killing a child gives us its own children: repeat. */
		nanosleep(&nap, NULL);
	} while (now_ns() < deadline_ns);
}

/* Whether this child is one of avckpt's: a template, a holder, or the listener to keys. */
static bool is_ours(pid_t pid)
{
	char path[64], name[16] = "";
	int fd;

	snprintf(path, sizeof(path), "/proc/%d/comm", pid);
	fd = open(path, O_RDONLY | O_CLOEXEC);
	if (fd < 0)
		return true; /* it has ended */
	if (read(fd, name, sizeof(name) - 1) < 0)
		name[0] = '\0';
	close(fd);
	return !strncmp(name, "avckpt-", strlen("avckpt-"));
}

/* A program that puts itself into the background has ended, as far as a container is concerned. */
static void tell_of_a_daemon(void)
{
	char text[4096], *at = text, *end;

	read_children(text, sizeof(text));
	for (;; at = end) {
		pid_t pid = (pid_t)strtol(at, &end, 10);

		if (end == at)
			return;
		if (!is_ours(pid))
			break;
	}
	say("%s has ended, and what it left in the background ends with it; a daemon has to be "
	    "started in the foreground",
	    self.app_name);
}

/* Ends as the app ended. A PID 1 cannot die by a signal, so the shell's convention is used, as in
 * every container init. */
static _Noreturn void finish(int status)
{
	if (self.is_unit) {
		/* Other children are what the program has left behind on purpose. */
		(void)keys_pressed();
		unit_end_templates();
		unit_finish(status);
	}
	if (self.pid != 1)
		end_children();
	/* A shell that started us takes its terminal back itself, a plain program does not. The
	 * session leader has no one to give it to. */
	if (self.fd[TTY] >= 0 && getsid(0) != self.pid && getpgrp() > 0)
		tcsetpgrp(self.fd[TTY], getpgrp());
	_exit(WIFSIGNALED(status) ? 128 + WTERMSIG(status) : WEXITSTATUS(status));
}

static _Noreturn void finish_unrestored(const char *why)
{
	if (WIFSIGNALED(self.status))
		say("%s died by signal %d (%s) and was not restored: %s", self.app_name,
		    WTERMSIG(self.status), strsignal(WTERMSIG(self.status)), why);
	else
		say("%s ended with status %d and was not restored: %s", self.app_name,
		    WEXITSTATUS(self.status), why);
	finish(self.status);
}

static bool within_stop_time(uint64_t then_ns, uint64_t at_ns)
{
	return then_ns && at_ns - then_ns < AVC_CTL_STOP_MS * NS_PER_MS;
}

/* Was this exit requested? By a stop, by a sender of the very signal that it died of, or by the
 * keys of a terminal: `keys_ns` is when one was pressed last. A hang-up is recognized by the signal
 * that the app died of, or the status that shells use for it. */
static bool was_wanted(int status, uint64_t at_ns, uint64_t keys_ns)
{
	static const int fatal[] = { SIGABRT, SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGTRAP, SIGSYS };
	int sig = WIFSIGNALED(status) ? WTERMSIG(status) : WEXITSTATUS(status) - 128;

	if (within_stop_time(self.stop_ns, at_ns))
		return true;
	if (keys_ns && (keys_ns > at_ns || at_ns - keys_ns < KEYS_MS * NS_PER_MS))
		return true;
	if (WIFSIGNALED(status) && within_stop_time(self.sent_ns[sig], at_ns))
		return true;
	/* These have no other meaning: a program that handles one shuts down, and exits with its
	 * own status. */
	for (size_t i = 0; WIFEXITED(status) && i < sizeof(fatal) / sizeof(*fatal); i++)
		if (within_stop_time(self.sent_ns[fatal[i]], at_ns))
			return true;
	return self.fd[TTY] >= 0 && (sig == SIGINT || sig == SIGQUIT || sig == SIGHUP);
}

/* The app's main process was reaped, and was not a failed attempt to restore it. Reports every
 * death, including final ones (the guard reports the reason); waits for an answer only if there can
 * be one. */
static void app_died(int status, uint64_t at_ns)
{
	bool wanted = was_wanted(status, at_ns, self.is_unit ? 0 : keys_pressed());
	struct avc_report report = {
		.kind = AVC_REPORT_DEATH,
		.seq = ++self.seq,
		.pid = self.app_pid,
		.status = status,
		.flags = wanted ? AVC_REPORT_STOP_ASKED : 0,
		.reaped_ns = at_ns,
	};
	bool told;

	self.status = status;
	if (!wanted && !self.is_unit && status == 0)
		tell_of_a_daemon();
	if (!self.ctl)
		finish(status);
	/* Both ends are ours: this neither blocks nor raises SIGPIPE. It fails only if the guard
	 * has not read for a long time. */
	told = write(self.fd[REPORT_WRITE], &report, sizeof(report)) == (ssize_t)sizeof(report);
	if (wanted || (WIFEXITED(status) && WEXITSTATUS(status) == 0))
		finish(status);
	if (!__atomic_load_n(&self.ctl->armed, __ATOMIC_ACQUIRE) || !self.wait_ms)
		finish(status);
	if (!told)
		finish_unrestored("the guard does not read");
	self.waiting = true;
	/* The guard's time begins when it is told: without a CPU, that is long after the death. */
	self.deadline_ns = now_ns() + self.wait_ms * NS_PER_MS;
}

static bool is_stop(int sig)
{
	return sig == SIGTERM || sig == SIGINT || sig == SIGQUIT || sig == self.stop_signal;
}

static void note_stop(uint64_t at_ns)
{
	self.stop_ns = at_ns;
	if (self.ctl)
		__atomic_store_n(&self.ctl->stop_asked_ns, at_ns, __ATOMIC_RELEASE);
}

/* Forwards one signal to the app's main process. `info` is NULL for one that waited for a
 * restore. */
static void forward(int sig, const struct signalfd_siginfo *info)
{
	uint64_t at_ns = now_ns();

	if (is_stop(sig))
		note_stop(at_ns);
	self.sent_ns[sig] = at_ns;
	if (info && info->ssi_code == SI_QUEUE) {
		union sigval value = { .sival_ptr = (void *)(uintptr_t)info->ssi_ptr };

		if (sigqueue(self.app_pid, sig, value) == 0)
			return;
	}
	kill(self.app_pid, sig);
}

/* The guard has put a new process under the app's PID.  It may be running, or
 * dead, or not running yet. */
static void app_restored(void)
{
	siginfo_t info = { 0 };
	int sig;

	self.waiting = false;
	/* It may have died, and been reaped, before we read this: see reap(). */
	if (waitid(P_PID, (id_t)self.app_pid, &info, WEXITED | WNOHANG | WNOWAIT | __WALL) < 0) {
		app_died(self.attempt_status, self.attempt_ns);
		return;
	}
	/* The terminal still belongs to the dead app's group: the same number, but
	 * not the same group to the kernel. */
	if (self.fd[TTY] >= 0 && tcgetpgrp(self.fd[TTY]) == self.app_pid)
		tcsetpgrp(self.fd[TTY], self.app_pid);
	if (!self.is_unit)
		listen_to_keys(); /* a unit's still does: it is in init's group */
	for (sig = 1; self.deferred; sig++) {
		if (!(self.deferred & SIGBIT(sig)))
			continue;
		self.deferred &= ~SIGBIT(sig);
		forward(sig, NULL);
	}
}

/* Reads the guard's answer; call it only while waiting. Returns still waiting, or with the app
 * restored, or not at all. */
static void take_verdict(void)
{
	struct avc_verdict verdict;
	int i;

	for (i = 0; i < VERDICTS_PER_ROUND; i++) {
		ssize_t n = read(self.fd[VERDICT], &verdict, sizeof(verdict));

		if (n < 0)
			return; /* EAGAIN: nothing yet */
		if (n == 0)
			finish_unrestored("the guard is gone");
		if (n != (ssize_t)sizeof(verdict))
			finish_unrestored("the guard does not speak our protocol");
		if (verdict.seq != self.seq)
			continue; /* a late answer to an earlier death */
		if (verdict.kind == AVC_VERDICT_RESTORED) {
			app_restored();
			return;
		}
		if (verdict.kind == AVC_VERDICT_GIVE_UP)
			finish_unrestored("the guard gave up");
		if (verdict.kind == AVC_VERDICT_WORKING)
			self.deadline_ns = now_ns() + self.wait_ms * NS_PER_MS;
	}
}

/* Reaps every child that has exited, and checks whether the app is among them.
 *
 * While we wait for a verdict, a process with the app's PID that dies is either a failed attempt to
 * restore it (the guard's business) or the restored app itself, dead again before we have read the
 * verdict (a new death). The verdict tells which, but only one that is read *after* the reaping:
 * while the zombie exists its PID is taken, and once it is gone the guard may make the next attempt
 * and report that. So a death while waiting is only noted, and app_restored() checks whether the
 * process of the verdict exists.
 *
 * A traced child shows up here after its tracer has reaped it. */
static void reap(void)
{
	pid_t pid;
	int status;

	while ((pid = waitpid(-1, &status, WNOHANG | __WALL)) > 0) {
		uint64_t at_ns = now_ns();

		keys_ended(pid);
		if (pid != self.app_pid)
			continue;
		if (self.waiting) {
			self.attempt_status = status;
			self.attempt_ns = at_ns;
		} else {
			app_died(status, at_ns);
		}
	}
	/* No child at all, and no death was seen: this should not happen, but init would hang
	 * forever. */
	if (pid < 0 && errno == ECHILD && !self.waiting)
		finish(self.status);
}

/* A shell that has started a unit as a job waits for us to stop with the program. */
static void stop_along(void)
{
	siginfo_t info = { 0 };

	if (!self.waiting && waitid(P_PID, (id_t)self.app_pid, &info, WSTOPPED | WNOHANG) == 0 &&
	    info.si_pid == self.app_pid &&
	    (info.si_status == SIGTSTP || info.si_status == SIGTTIN || info.si_status == SIGTTOU))
		kill(self.pid, SIGSTOP);
}

/* The stop key stops the app, and if init leads the session no shell could continue it: the
 * terminal would be dead for good. As the main process of its container the app would not have been
 * stopped in the first place. */
static void continue_stopped(void)
{
	siginfo_t info = { 0 };

	if (self.is_unit) {
		stop_along();
		return;
	}
	if (self.fd[TTY] < 0 || getsid(0) != self.pid || self.waiting)
		return;
	if (waitid(P_PID, (id_t)self.app_pid, &info, WSTOPPED | WNOHANG) == 0 &&
	    info.si_pid == self.app_pid && info.si_status == SIGTSTP)
		kill(-self.app_pid, SIGCONT);
}

/* A unit's program is in our group, so what was sent to the whole group, by the terminal or a
 * process, it has got itself. */
static bool app_has_it(int sig, const struct signalfd_siginfo *info)
{
	bool has = self.shares_group && info->ssi_code == SI_KERNEL;

	if (self.shares_group && info->ssi_code == SI_USER) {
		has = keys_group_got(sig);
		if (!keys_are_heard())
			listen_to_keys();
	}
	if (!has || self.waiting)
		return false;
	if (is_stop(sig))
		note_stop(now_ns());
	self.sent_ns[sig] = now_ns();
	return true;
}

static void take_signals(void)
{
	struct signalfd_siginfo info;

	while (read(self.fd[SIGNALS], &info, sizeof(info)) == (ssize_t)sizeof(info)) {
		int sig = (int)info.ssi_signo;

		/* A SIGPIPE of our own is not for the app. A SIGSEGV read here was sent by a
		 * process: our own fault would kill us despite the mask. */
		if (sig == SIGCHLD || (pid_t)info.ssi_pid == self.pid)
			continue;
		if (app_has_it(sig, &info))
			continue;
		/* The terminal hung up on the session's leader: the app goes too. */
		if (sig == SIGHUP && info.ssi_code == SI_KERNEL)
			note_stop(now_ns());
		if (!self.waiting) {
			forward(sig, &info);
			continue;
		}
		/* There is no app at the moment. A stop is passed on to the restored app, so that
		 * it shuts down in its own way; a second request does not wait. */
		if (is_stop(sig)) {
			if (self.deferred & SIGBIT(sig))
				finish_unrestored("told to stop");
			note_stop(now_ns());
		}
		self.deferred |= SIGBIT(sig);
	}
}

/* We may have got no CPU, or been stopped, between our last look and the deadline: what the guard
 * has said meanwhile, it has said in time. */
static void look_at_deadline(void)
{
	if (!self.waiting || now_ns() < self.deadline_ns)
		return;
	take_verdict();
	if (self.waiting && now_ns() >= self.deadline_ns)
		finish_unrestored("the guard did not answer in time");
}

/* Sleeps until there is something to do. */
static void wait_event(void)
{
	/* Without a guard the verdict pipe has no writer, and would report POLLHUP all the time: it
	 * is polled only while an answer is due. */
	struct pollfd fds[] = {
		{ .fd = self.fd[SIGNALS], .events = POLLIN },
		{ .fd = self.waiting ? self.fd[VERDICT] : -1, .events = POLLIN },
		{ .fd = self.fd[EXEC], .events = POLLIN },
		{ .fd = self.is_unit ? unit_fd() : -1, .events = POLLIN },
	};
	uint64_t due_ns = UINT64_MAX, at_ns = now_ns();
	struct timespec left;

	if (self.waiting)
		due_ns = self.deadline_ns;
	/* A child that fails to execute the program needs no protection. */
	if (self.is_unit && self.fd[EXEC] < 0 && unit_due_ns() < due_ns)
		due_ns = unit_due_ns();
	due_ns = due_ns > at_ns ? due_ns - at_ns : 0;
	left.tv_sec = (time_t)(due_ns / (1000 * NS_PER_MS));
	left.tv_nsec = (long)(due_ns % (1000 * NS_PER_MS));
	ppoll(fds, sizeof(fds) / sizeof(fds[0]), due_ns > UINT64_MAX / 2 ? NULL : &left, NULL);
	if (fds[2].revents)
		app_started();
	if (self.is_unit && self.ctl && self.fd[EXEC] < 0)
		unit_tend(self.app_name);
}

static _Noreturn void usage(void)
{
	say("usage: " NAME " [--name NAME] [--label avckpt.KEY=VALUE ...] [--wait-ms N] "
	    "[--stop-signal N] [--] PROGRAM [ARG...]");
	_exit(EXIT_USAGE);
}

static uint32_t number_of(const char *text, uint32_t max)
{
	char *end = NULL;
	unsigned long n;

	if (!text || *text < '0' || *text > '9')
		usage();
	errno = 0;
	n = strtoul(text, &end, 10);
	if (errno || *end || n > max)
		usage();
	return (uint32_t)n;
}

static char **take_options(char **argv)
{
	bool of_container = false;

	self.wait_ms = AVC_CTL_WAIT_MS_DEFAULT;
	self.stop_signal = SIGTERM;
	for (argv++; *argv && **argv == '-'; argv += 2) {
		if (!strcmp(*argv, "--")) {
			argv++;
			break;
		}
		of_container |= !strcmp(*argv, "--wait-ms");
		if (!strcmp(*argv, "--wait-ms"))
			self.wait_ms = number_of(argv[1], 3600 * 1000);
		else if (!strcmp(*argv, "--stop-signal"))
			self.stop_signal = (int)number_of(argv[1], _NSIG - 1);
		else if ((!strcmp(*argv, "--label") || !strcmp(*argv, "-l")) &&
			 unit_take_label(argv[1]))
			continue;
		else if (!strcmp(*argv, "--name") && unit_take_name(argv[1]))
			continue;
		else
			usage();
	}
	if (!*argv)
		usage();
	/* The hook, too, starts us with an environment that the image may have set. */
	self.is_unit = !of_container && unit_is_wanted();
	return argv;
}

int main(int argc, char **argv)
{
	struct sigaction plain = { .sa_handler = SIG_DFL };
	uint64_t all = ~UINT64_C(0);

	(void)argc;
	self.pid = getpid();
	argv = take_options(argv);
	self.app_name = argv[0];
	self.status = W_EXITCODE(EXIT_USAGE, 0);
	if (self.is_unit && !unit_begin(argv[0])) {
		int err;

		execvp(argv[0], argv);
		err = errno;
		say("%s: %s", argv[0], strerror(err));
		_exit(err == ENOENT ? 127 : 126);
	}

	mask_set(all, &self.mask);
	/* Inherited as ignored it would reap our children for us. */
	sigaction(SIGCHLD, &plain, &self.chld);
	self.fd[SIGNALS] = above_stdio(
		(int)syscall(SYS_signalfd4, -1, &all, sizeof(all), SFD_CLOEXEC | SFD_NONBLOCK));
	if (self.fd[SIGNALS] < 0) {
		say("signalfd: %s; %s runs without an init", strerror(errno), self.app_name);
		become_app(argv);
	}
	/* Become the parent of orphans even if we are not PID 1. */
	prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0);
	/* A group that is outside our PID namespace (number 0) cannot be entered again. */
	self.shares_group = self.is_unit && getpgrp() > 0;
	if (!self.is_unit)
		find_terminal();
	protect();
	start_app(argv);
	for (;;) {
		if (self.waiting)
			take_verdict();
		reap();
		continue_stopped();
		look_at_deadline();
		wait_event();
		take_signals();
	}
}
