/* SPDX-License-Identifier: Apache-2.0
 *
 * children: a process with some thousand children reaps the oldest ones, one after the other; those that stay
 * are to be in every list.  Prints how many lists were read, and how many of them had left out one.
 */
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/wait.h>
#include <unistd.h>

#include "base.h"

#define PASSING 800
#define STAYING 1200

static struct {
	pid_t staying[STAYING];
	volatile bool ready, over;
} * shared;

static pid_t start(void)
{
	const pid_t pid = fork();

	if (pid < 0)
		exit(1);
	if (pid)
		return pid;
	for (;;)
		pause();
}

static _Noreturn void reap(void)
{
	pid_t passing[PASSING];

	for (int i = 0; i < PASSING; i++)
		passing[i] = start();
	for (int i = 0; i < STAYING; i++)
		shared->staying[i] = start();
	shared->ready = true;
	for (int i = 0; i < PASSING; i++) {
		kill(passing[i], SIGKILL);
		waitpid(passing[i], NULL, 0);
		usleep(2000);
	}
	shared->over = true;
	for (int i = 0; i < STAYING; i++)
		kill(shared->staying[i], SIGKILL);
	_exit(0);
}

static bool has_all(const pid_t *children, int count)
{
	int at = 0;

	for (int i = 0; i < STAYING; i++, at++) {
		while (at < count && children[at] != shared->staying[i])
			at++;
		if (at == count)
			return false;
	}
	return true;
}

int main(void)
{
	pid_t children[CHILDREN_MAX], parent;
	int lists = 0, lacking = 0;

	shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1,
		      0);
	parent = fork();
	if (!parent)
		reap();
	while (!shared->ready)
		usleep(1000);
	for (;;) {
		const int count = proc_children(parent, children, CHILDREN_MAX);

		if (shared->over)
			break;
		lists++;
		lacking += !has_all(children, count);
	}
	waitpid(parent, NULL, 0);
	printf("%d %d\n", lists, lacking);
	return 0;
}
