/* SPDX-License-Identifier: Apache-2.0
 *
 * phoenix TEMPLATE_FD APP_FD: a process that can be put in its own place again,
 * without avckpt: what a test of avckpt-init needs from a guard.
 *
 * It starts a sibling (CLONE_PARENT: init's child, as a template is) that obeys
 * TEMPLATE_FD; it obeys APP_FD itself.  Both are stream sockets that carry lines.
 *
 * To the template:  spawn PID   make a process with that PID, init's child, that
 *                               does nothing but wait; answers "spawned PID", or
 *                               "failed ERRNO"
 *                   go          let it run: as the app, it obeys APP_FD
 * To the app:       ping        answers "pong PID PGRP FOREGROUND"
 *                   catch       from now on answers "signal N VALUE" to signals
 *                   exit N, die N
 *                   orphans N   leaves N zombies-to-be to init; answers "done"
 */
#include <errno.h>
#include <linux/sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

static int template_fd, app_fd;

static void answer(int fd, const char *text)
{
	if (write(fd, text, strlen(text)) < 0)
		_exit(98);
}

static void read_line(int fd, char *line, size_t size)
{
	size_t len = 0;

	while (len < size - 1) {
		ssize_t n = read(fd, line + len, 1);

		if (n < 0 && errno == EINTR)
			continue;
		if (n <= 0)
			_exit(97); /* the test is gone */
		if (line[len] == '\n')
			break;
		len++;
	}
	line[len] = '\0';
}

static void on_signal(int sig, siginfo_t *info, void *context)
{
	char text[64];
	int saved = errno;

	(void)context;
	snprintf(text, sizeof(text), "signal %d %d\n", sig,
		 info->si_code == SI_QUEUE ? info->si_value.sival_int : -1);
	answer(app_fd, text);
	errno = saved;
}

static void catch_all(void)
{
	struct sigaction act = { .sa_sigaction = on_signal, .sa_flags = SA_SIGINFO | SA_RESTART };
	int sig;

	sigfillset(&act.sa_mask);
	for (sig = 1; sig < NSIG; sig++)
		if (sig != SIGCHLD)
			sigaction(sig, &act, NULL);
}

static void make_orphans(int n)
{
	while (n--) {
		pid_t pid = fork();

		if (pid == 0) {
			if (fork() == 0)
				usleep(1000);
			_exit(0);
		}
		if (pid < 0)
			_exit(96);
		waitpid(pid, NULL, 0);
	}
	answer(app_fd, "done\n");
}

static _Noreturn void be_app(void)
{
	char line[128], text[128];
	int n;

	for (;;) {
		read_line(app_fd, line, sizeof(line));
		if (!strcmp(line, "ping")) {
			snprintf(text, sizeof(text), "pong %d %d %d\n", getpid(), getpgrp(),
				 tcgetpgrp(0));
			answer(app_fd, text);
		} else if (!strcmp(line, "catch")) {
			catch_all();
			answer(app_fd, "caught\n");
		} else if (sscanf(line, "exit %d", &n) == 1) {
			_exit(n);
		} else if (sscanf(line, "die %d", &n) == 1) {
			signal(n, SIG_DFL);
			kill(getpid(), n);
		} else if (sscanf(line, "orphans %d", &n) == 1) {
			make_orphans(n);
		} else {
			answer(app_fd, "what?\n");
		}
	}
}

/* A child of our own parent, with a chosen PID if pid is not 0. */
static pid_t clone_sibling(pid_t pid)
{
	struct clone_args args = {
		.flags = CLONE_PARENT, /* the exit signal is inherited, too */
		.set_tid = pid ? (uint64_t)(uintptr_t)&pid : 0,
		.set_tid_size = pid ? 1 : 0,
	};

	return (pid_t)syscall(SYS_clone3, &args, sizeof(args));
}

static _Noreturn void be_template(void)
{
	char line[128], text[128];
	int gate[2] = { -1, -1 };
	pid_t pid;

	prctl(PR_SET_NAME, "phoenix-tmpl");
	/* As a member of the app's group it would keep the number in use. */
	if (setpgid(0, 0) < 0)
		_exit(93);
	for (;;) {
		read_line(template_fd, line, sizeof(line));
		if (sscanf(line, "spawn %d", &pid) == 1) {
			close(gate[0]);
			close(gate[1]);
			if (pipe(gate) < 0)
				_exit(95);
			pid = clone_sibling(pid);
			if (pid == 0) {
				char c;

				close(gate[1]);
				setpgid(0, 0);
				if (read(gate[0], &c, 1) != 1)
					_exit(94);
				close(gate[0]);
				be_app();
			}
			/* Ready means that nothing is left to do but to run. */
			while (pid > 0 && getpgid(pid) != pid)
				usleep(100);
			if (pid < 0)
				snprintf(text, sizeof(text), "failed %d\n", errno);
			else
				snprintf(text, sizeof(text), "spawned %d\n", pid);
			answer(template_fd, text);
		} else if (!strcmp(line, "go")) {
			if (write(gate[1], "", 1) != 1)
				answer(template_fd, "nobody\n");
			else
				answer(template_fd, "gone\n");
		}
	}
}

int main(int argc, char **argv)
{
	pid_t pid;

	if (argc != 3)
		return 2;
	template_fd = atoi(argv[1]);
	app_fd = atoi(argv[2]);
	signal(SIGPIPE, SIG_IGN);
	pid = clone_sibling(0);
	if (pid < 0)
		return 3;
	if (pid == 0)
		be_template();
	be_app();
}
