/* SPDX-License-Identifier: Apache-2.0
 *
 * commands [--gate]: a shell's $(cmd), one after the other.
 *
 * Each starts a program, reads what it says until the pipe ends, and reaps it.
 * With --gate a program has spoken and still runs until counter 8 of the board,
 * which a test writes, is its number or more: the pipe ends then, and not when a
 * template of the program goes.
 * Counter 0: commands done; 1: longest time from a program's last word to the end
 * of its pipe, in ns; 2: the sum of these; 3: commands started.
 */
#include "family.h"

static const char *board_path;

/* commands --say NUMBER GATED [BOARD] */
static _Noreturn void say(char **argv)
{
	const uint64_t number = strtoul(argv[2], NULL, 10);
	struct timespec ts = { 0, 1000000 };

	if (argv[4])
		board_open(argv[4]);
	printf("%lu %lu\n", number, now_ns());
	fflush(stdout);
	while (atoi(argv[3]) && __atomic_load_n(&board->counter[8], __ATOMIC_ACQUIRE) < number)
		clock_nanosleep(CLOCK_MONOTONIC, 0, &ts, NULL);
	_exit((int)(number % 100));
}

static pid_t start(uint64_t number, bool gated, int *fd)
{
	char text[24], gate[2] = { gated ? '1' : '0', 0 };
	char *argv[] = {
		(char *)"commands", (char *)"--say", text, gate, (char *)board_path, NULL
	};
	int fds[2];
	pid_t pid;

	snprintf(text, sizeof(text), "%lu", number);
	must(pipe(fds) == 0, "pipe");
	pid = fork();
	must(pid >= 0, "fork");
	if (pid == 0) {
		dup2(fds[1], STDOUT_FILENO);
		close(fds[0]);
		close(fds[1]);
		execv("/proc/self/exe", argv);
		_exit(127);
	}
	close(fds[1]);
	*fd = fds[0];
	return pid;
}

static void hear(uint64_t number, int fd, pid_t pid)
{
	uint64_t said = 0, at = 0, took;
	char text[64];
	size_t n = 0;
	ssize_t more;
	int status = 0;

	while ((more = read(fd, text + n, sizeof(text) - 1 - n)) > 0)
		n += (size_t)more;
	took = now_ns();
	close(fd);
	CHECK(more == 0, "command %lu: read: %s", number, strerror(errno));
	text[n] = 0;
	if (waitpid(pid, &status, 0) != pid)
		came_apart("command %lu: waitpid: %s", number, strerror(errno));
	if (WIFSIGNALED(status))
		came_apart("command %lu was killed by signal %d", number, WTERMSIG(status));
	CHECK(WIFEXITED(status) && WEXITSTATUS(status) == (int)(number % 100),
	      "command %lu ended with %x", number, status);
	CHECK(sscanf(text, "%lu %lu", &said, &at) == 2 && said == number, "command %lu said %s",
	      number, text);
	took -= at;
	if (took > board->counter[1])
		board->counter[1] = took;
	count(2, took);
	count(0, 1);
}

int main(int argc, char **argv)
{
	const bool gated = victim_flag(&argc, argv, "--gate");
	uint64_t number;
	int i, fd = -1;

	if (argc > 3 && !strcmp(argv[1], "--say"))
		say(argv);
	for (i = 1; i + 1 < argc; i++)
		if (!strcmp(argv[i], "--board"))
			board_path = argv[i + 1];
	victim_start(&argc, argv, 0, "[--gate]");
	family.main = getpid();
	know_family("commands");
	victim_ready();
	for (number = 1;; number++) {
		const pid_t pid = start(number, gated, &fd);

		board->counter[3] = number;
		hear(number, fd, pid);
		check_place();
		check_nothing_to_wait_for();
		beat();
	}
}
