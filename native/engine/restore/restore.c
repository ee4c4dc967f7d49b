/* SPDX-License-Identifier: Apache-2.0
 *
 * A template becomes the app again: it forks a process with the app's own PID, or its spare gives
 * its memory to one (spare.c), which restores itself (parasite.c, inj_restore) and waits until
 * everything is ready; then all its threads are released at once.  The new process is not traced.
 */
#include <dirent.h>
#include <errno.h>
#include <linux/futex.h>
#include <sched.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/random.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "parasite_blob.h"
#include "restore.h"

#define TRIES 8 /* at once */
#define TRY_NS NS_PER_S
#define TRY_AGAIN_NS (NS_PER_MS / 2)
#define NAP_MAX_NS (10 * NS_PER_MS)
#define READY_NS (2 * NS_PER_S)
#define GONE_NS NS_PER_S
#define STEP_NS (5 * NS_PER_S)
#define STAGGER_MS 20

static const char *const step_names[] = {
	[INJ_STEP_SESSION] = "setsid",      [INJ_STEP_GROUP] = "setpgid",
	[INJ_STEP_TTY] = "ioctl(terminal)", [INJ_STEP_ROBUST] = "set_robust_list",
	[INJ_STEP_RSEQ] = "rseq",           [INJ_STEP_THREAD] = "clone",
	[INJ_STEP_TID] = "clone",           [INJ_STEP_BASE] = "arch_prctl",
};

/* Waits while *word == value; false after `end`, or when the process has ended. */
static bool wait_word(uint32_t *word, uint32_t value, int pidfd, uint64_t end)
{
	const struct timespec slice = { .tv_nsec = (long)NS_PER_MS };

	while (__atomic_load_n(word, __ATOMIC_ACQUIRE) == value) {
		if (!tracee_has_time(end) || pidfd_ended(pidfd))
			return false;
		syscall(SYS_futex, word, FUTEX_WAIT, value, &slice, NULL, 0);
	}
	return true;
}

/* Until the new process has restored itself, or has failed. */
static int await_state(struct inj_slot *slot, struct sandbox *sandbox, int pidfd,
		       struct avc_error *err)
{
	const uint64_t end = tracee_deadline(READY_NS);

	if (sandbox ? sandbox_wait(sandbox, &slot->state, end)
		    : wait_word(&slot->state, INJ_IDLE, pidfd, end))
		return 0;
	return pidfd_ended(pidfd) ? fail(err, AVC_GONE, ESRCH, slot->pid, "restore", "",
					 "the new process was killed")
				  : fail(err, AVC_KERNEL, ETIMEDOUT, slot->pid, "restore", "",
					 "the new process does not answer");
}

static void reset(const struct parasite *parasite, uint32_t slot_number)
{
	struct inj_slot *slot = parasite_slot(parasite, slot_number);

	slot->state = INJ_IDLE;
	slot->go = INJ_GO_NOT;
	slot->spawned = 0;
	slot->astray = 0;
	slot->ready = 0;
	slot->running = 0;
	slot->error = 0;
	slot->error_at = INJ_STEP_NONE;
	slot->error_tid = 0;
	slot->error_setup = 0;
	slot->block_bytes = (uint32_t)parasite->block_bytes;
	slot->blocks = parasite_remote(parasite, parasite_thread(parasite, slot_number, 0));
}

/* Sets a stopped process to inj_restore() and detaches. */
static int send_off(const struct image *image, pid_t child, struct sandbox **sandbox,
		    struct avc_error *err)
{
	const struct parasite *parasite = &image->process->parasite;
	struct arch_regs regs;

	/* Its stack is the first thread's, in the slot. */
	arch_call(&regs, &image->base, parasite->base + INJ_RESTORE_OFFSET,
		  parasite_remote(parasite, parasite_stack(parasite, image->slot, 0)),
		  parasite_remote(parasite, parasite_slot(parasite, image->slot)));
	/* The template is a clone of a holder, whose attribute dates from its creation. */
	if (!image->headless)
		arch_tls_set(&regs, parasite_thread(parasite, image->slot, 0)->tls);
	if ((image->sandboxed || image->stop_signal) && arch_regs_set(child, &regs) == 0) {
		*sandbox = sandbox_begin(image, child, err);
		if (*sandbox)
			return 0;
		tracee_kill(child);
		return -1;
	}
	if (arch_regs_set(child, &regs) || ptrace(PTRACE_DETACH, child, NULL, 0L)) {
		fail_errno(err, child, "restore", "ptrace(DETACH)", "the new process was killed");
		tracee_kill(child);
		return -1;
	}
	return 0;
}

/* Where a spare has died, the template has the same memory; but not one that stands in for it, and gets
 * the last pages only afterwards. */
static int check_memory(struct generation *generation, struct avc_error *err)
{
	return spare_is_there(generation) || !generation->spare.alone
		       ? 0
		       : fail(err, AVC_GONE, 0, generation->image[0].inside, "restore", "",
			      "the template that gives it its memory was killed");
}

/* One fork of the template, or the process that takes over its spare's memory; restore->pid stays 0 if
 * it has another number.  If it is to have children, it stays stopped. */
static int fork_template(struct restore *restore, bool again, struct avc_error *err)
{
	struct generation *generation = restore->generation;
	const struct image *image = &generation->image[0];
	const struct parasite *parasite = &image->process->parasite;
	struct inj_slot *slot = parasite_slot(parasite, image->slot);
	struct inj_call *call = &slot->template_call;
	const bool spare = spare_is_there(generation);
	const pid_t from = spare ? generation->spare.pid : image->template;
	const struct arch_regs *base = spare ? &generation->spare.base : &image->base;
	const struct inj_syscall *asked;
	pid_t child = 0;
	bool failed;

	if (check_memory(generation, err))
		return -1;
	/* The first time there are calls of files_restore() before it. */
	if (again)
		call_begin(call, INJ_AFTER_PARK);
	asked = last_pid_ask(restore->helper, parasite, call, slot->pid - 1);
	call_add(call, SYS_clone, (spare ? CLONE_VM : 0) | CLONE_FILES | CLONE_PARENT | SIGCHLD);
	failed = parasite_send(parasite, from, base, call, err) ||
		 parasite_run_clone(from, call, &child, err);
	/* What comes next takes time, and others fork meanwhile: with the numbers after this one, which
	 * may be those of the dead who are to come back next. */
	last_pid_free(restore->helper);
	if (failed)
		return -1;
	if (tracee_await(child, NULL, err) != STOP_TRAP)
		return -1;
	if (last_pid_answered(restore->helper, asked, err)) {
		tracee_kill(child);
		return -1;
	}
	close_fd(&restore->pidfd);
	restore->pidfd = proc_pidfd_open(child);
	if (restore->pidfd < 0) {
		fail_errno(err, child, "restore", "pidfd_open", "the new process was killed");
		tracee_kill(child);
		return -1;
	}
	/* Another process's fork took the number.  It never runs: its stack is the next one's. */
	if (proc_inside(child) != slot->pid) {
		tracee_kill(child);
		return tracee_settle(from, err);
	}
	files_lift_limit(image->files, child);
	if (!restore->tree && send_off(image, child, &restore->sandbox, err))
		return -1;
	restore->pid = child;
	/* The template can park meanwhile. */
	return tracee_settle(from, err);
}

static int describe_failure(const struct parasite *parasite, const struct inj_slot *slot,
			    struct avc_error *err)
{
	const uint32_t at = __atomic_load_n(&slot->error_at, __ATOMIC_RELAXED);
	const char *name = at < sizeof step_names / sizeof *step_names ? step_names[at] : NULL;

	if (at == INJ_STEP_TID)
		return fail(err, AVC_KERNEL, slot->error, slot->pid, "restore", "clone",
			    "thread number %d is taken by somebody else", slot->error_tid);
	if (at == INJ_STEP_SETUP)
		return fail(err, AVC_KERNEL, slot->error, slot->pid, "restore",
			    setup_name(parasite, slot->error_setup),
			    "thread %d could not be put back", slot->error_tid);
	return fail(err, AVC_KERNEL, slot->error, slot->pid, "restore", name,
		    "thread %d could not be put back", slot->error_tid);
}

/* A number is taken as long as a process has it, or as its group or session (kernel/pid.c,
 * __change_pid()), which a zombie keeps. */
static bool has_number(const struct proc_status *status, pid_t number)
{
	return status->inside == number || status->group == number || status->session == number;
}

int restore_fail_taken(pid_t init, pid_t number, struct avc_error *err)
{
	char inside[64] = "", its[64];
	DIR *proc = proc_link(init, "ns/pid", inside, sizeof inside) < 0
			    ? NULL
			    : got_memory(opendir("/proc"));
	struct proc_status status;
	struct proc_stat stat;
	struct dirent *entry;
	pid_t pid = 0;

	while (!pid && proc && (entry = readdir(proc))) {
		const pid_t other = (pid_t)atoi(entry->d_name);

		if (other > 0 && proc_link(other, "ns/pid", its, sizeof its) >= 0 &&
		    !strcmp(its, inside) && !proc_status(other, &status) &&
		    has_number(&status, number))
			pid = other;
	}
	if (proc)
		closedir(proc);
	if (!pid || proc_stat(pid, &stat))
		return fail(err, AVC_KERNEL, EEXIST, number, "restore", "clone",
			    "PID %d is taken by somebody else", number);
	return fail(err, AVC_KERNEL, EEXIST, number, "restore", "clone",
		    "PID %d is taken by process %d (%s, state %c)%s", number, pid, stat.name,
		    stat.state,
		    status.inside == number  ? ""
		    : status.group == number ? " as its group"
					     : " as its session");
}

/* A dead process has it, or one that is dying: until init gets a CPU to reap it. */
static bool the_dead_have(pid_t init, pid_t number)
{
	pid_t children[CHILDREN_MAX];
	const int count = proc_children(init, children, CHILDREN_MAX);

	for (int i = 0; i < count; i++) {
		struct proc_status status;
		struct proc_stat stat;

		if (!proc_status(children[i], &status) && !proc_stat(children[i], &stat) &&
		    has_number(&status, number) &&
		    (stat.state == 'Z' || stat.state == 'X' || proc_is_killed(children[i])))
			return true;
	}
	return false;
}

bool restore_number_gets_free(const struct restore *restore, pid_t number, uint64_t *since_ns)
{
	const uint64_t end = tracee_deadline(TRY_NS);

	uint64_t nap_ns = TRY_AGAIN_NS;

	while (the_dead_have(restore->channel->init, number)) {
		if (!tracee_has_time(end))
			return false;
		/* Each look takes from what CPU there may be for both of us. */
		usleep((useconds_t)(nap_ns / 1000));
		nap_ns = nap_ns < NAP_MAX_NS ? 2 * nap_ns : nap_ns;
		*since_ns = now_ns();
	}
	return now_ns() - *since_ns < TRY_NS;
}

/* The total time depends on the size, and on who gets a CPU: deadlines are per step. */
void restore_go_on(const struct restore *restore)
{
	tracee_deadline_set(restore->timer, restore_patience(STEP_NS));
	init_channel_working(restore->channel);
}

/* Forks until the PID is the app's; in a shared PID namespace other processes may fork in
 * between. */
static int rebuild(struct restore *restore, struct avc_error *err)
{
	const struct image *image = &restore->generation->image[0];
	const struct parasite *parasite = &image->process->parasite;
	struct inj_slot *slot = parasite_slot(parasite, image->slot);
	uint64_t since = now_ns();
	struct avc_error failed = { 0 };

	for (int i = 0; !i || restore_number_gets_free(restore, slot->pid, &since) || i < TRIES;
	     i++) {
		uint64_t start;

		restore_go_on(restore);
		/* The dead app's number may be free only some time after it was
		 * reaped; see spawn() in parasite.c. */
		if (i >= TRIES || failed.code)
			usleep(TRY_AGAIN_NS / 1000);
		start = now_ns();
		reset(parasite, image->slot);
		slot->astray = i > 0;
		failed.code = AVC_OK;
		if (fork_template(restore, i > 0, &failed)) {
			/* At the limit of tasks the one with a wrong number is one too many, until
			 * init has reaped it. */
			if (i && failed.code == AVC_LIMIT)
				continue;
			break;
		}
		if (!restore->pid)
			continue;
		restore->fork_ns = now_ns() - start;
		if (restore->tree) {
			if (restore_tree_make(restore->tree, err) ||
			    restore_tree_begin(restore->tree, err) ||
			    send_off(image, restore->pid, &restore->sandbox, err))
				return -1;
			restore->fork_ns = now_ns() - start;
		}
		start = now_ns();
		attributes_put_back_oom(image->attributes, restore->pid); /* meanwhile */
		if (await_state(slot, restore->sandbox, restore->pidfd, err))
			return -1;
		restore->threads_ns = now_ns() - start;
		if (slot->state == INJ_READY)
			return restore->sandbox ? sandbox_halt(restore->sandbox, err) : 0;
		if (restore->sandbox)
			sandbox_end(restore->sandbox);
		restore->sandbox = NULL;
		return describe_failure(parasite, slot, err);
	}
	if (failed.code) {
		*err = failed;
		return -1;
	}
	return restore_fail_taken(restore->channel->init, slot->pid, err);
}

/* ---- one of several ---------------------------------------------------------------- */

int restore_start(const struct image *image, struct last_pid *helper, pid_t pid,
		  struct sandbox **sandbox, struct avc_error *err)
{
	const struct parasite *parasite = &image->process->parasite;

	reset(parasite, image->slot);
	if (helper)
		last_pid_serve(helper, parasite_slot(parasite, image->slot));
	return send_off(image, pid, sandbox, err);
}

void restore_await_spawned(const struct image *image, int pidfd)
{
	struct inj_slot *slot = parasite_slot(&image->process->parasite, image->slot);

	(void)wait_word(&slot->spawned, 0, pidfd, tracee_deadline(READY_NS));
}

int restore_await(const struct image *image, int pidfd, struct sandbox *sandbox,
		  struct avc_error *err)
{
	const struct parasite *parasite = &image->process->parasite;
	struct inj_slot *slot = parasite_slot(parasite, image->slot);

	if (await_state(slot, sandbox, pidfd, err))
		return -1;
	if (slot->state != INJ_READY)
		return describe_failure(parasite, slot, err);
	return sandbox ? sandbox_halt(sandbox, err) : 0;
}

/* What was allowed to fail, and did: to be reported. */
static void note_failed(const struct parasite *parasite, uint32_t slot, pid_t pid,
			struct avc_error *notice)
{
	const struct inj_setup *s = setup_failed(parasite, slot);

	if (s)
		fail(notice, AVC_KERNEL, (int)-s->call.result, pid, "restore",
		     setup_name(parasite, parasite_remote(parasite, s)),
		     "not everything could be put back");
}

static void let_go(struct inj_slot *slot, enum inj_go stage)
{
	__atomic_store_n(&slot->go, stage, __ATOMIC_RELEASE);
	syscall(SYS_futex, &slot->go, FUTEX_WAKE, INT32_MAX, NULL, NULL, 0);
}

/* As other processes saw it: its main thread has exited, it is stopped. */
void restore_go(const struct image *image, struct sandbox *sandbox)
{
	const struct parasite *parasite = &image->process->parasite;

	if (sandbox)
		sandbox_go(sandbox);
	let_go(parasite_slot(parasite, image->slot), INJ_GO_ALL);
}

void restore_note(const struct image *image, pid_t pid, struct avc_error *notes)
{
	const struct parasite *parasite = &image->process->parasite;

	note_failed(parasite, image->slot, pid, notes);
	files_check_calls(parasite, image->slot, parasite_slot(parasite, image->slot)->pid, notes);
	attributes_put_back(image->attributes, pid, notes);
}

/* ---- all of it --------------------------------------------------------------------- */

/* It serves all processes that request PIDs: those that are not zombies. */
static struct last_pid *start_helper(const struct generation *generation,
				     const struct init_channel *channel, struct avc_error *err)
{
	struct last_pid_slot *slot = calloc(generation->images, sizeof *slot);
	struct last_pid *helper = NULL;
	uint32_t count = 0;

	if (!slot) {
		fail_memory(err, 0, "restore");
		return NULL;
	}
	for (uint32_t i = 0; i < generation->images; i++) {
		const struct image *image = &generation->image[i];

		if (image->process)
			slot[count++] = (struct last_pid_slot){ &image->process->parasite,
								image->slot };
	}
	helper = last_pid_start(channel->init_pidfd, slot, count, err);
	free(slot);
	return helper;
}

/* The fork takes so long that another process could take the PID; where units of one container fork and
 * die together, any fork does. */
static int make_spare_first(struct restore *restore, struct avc_error *err)
{
	struct generation *generation = restore->generation;
	const uint64_t start = now_ns();
	int result = spare_await(generation, err) || check_memory(generation, err) ? -1 : 0;

	if (!result &&
	    (generation->image[0].anon_pages >= COPIED_PAGES ||
	     restore->channel->numbers_fd >= 0) &&
	    !generation->spare.unwanted && !spare_is_there(generation))
		result = spare_make_now(generation, err);
	restore->fork_ns = now_ns() - start;
	return result;
}

/* In a group that is neither its own nor init's: led by one of its processes, or by one that is
 * gone. */
static bool is_in_another_group(const struct restore *restore)
{
	const struct image *main = &restore->generation->image[0];
	struct proc_stat init;

	return main->group > 0 && main->group != main->inside &&
	       proc_stat(restore->channel->init, &init) == 0 && init.group != main->stat.group;
}

/* Until everything is ready; nothing of the app has run yet. */
static int make(struct restore *restore, struct avc_error *err)
{
	struct generation *generation = restore->generation;
	uint64_t spare_ns;
	int result;

	if (make_spare_first(restore, err))
		return -1;
	restore_go_on(restore);
	restore->dropped = files_restore(generation->image, generation->images, restore->config,
					 restore->channel->init, &restore->notes, err);
	if (restore->dropped < 0)
		return -1;
	if (generation->images > 1 || is_in_another_group(restore)) {
		restore->tree = restore_tree_new(restore, err);
		if (!restore->tree)
			return -1;
	}
	spare_ns = restore->fork_ns;
	result = rebuild(restore, err);
	restore->fork_ns += spare_ns;
	if (result || (restore->tree && restore_tree_start(restore->tree, err)))
		return -1;
	files_await_late(generation->image[0].process);
	generation_close_tables(generation, false);
	return 0;
}

/* The PIDs it holds must be free before another generation is tried. */
static void take_back(struct restore *restore)
{
	/* It waits for `go`. */
	if (restore->sandbox)
		sandbox_end(restore->sandbox);
	if (restore->pidfd >= 0) {
		syscall(SYS_pidfd_send_signal, restore->pidfd, SIGKILL, NULL, 0);
		(void)pidfd_await_end(restore->pidfd, GONE_NS);
	}
	if (restore->tree)
		restore_tree_kill(restore->tree);
	restore->pid = 0;
}

/* Each thread goes on so long after `go`, at most: two that have done each other harm, always after the
 * same time, meet at another one.  Those of a process in a sandbox are released by the guard, all at
 * once. */
static void set_pauses(const struct image *image, uint32_t most_ms)
{
	const struct parasite *parasite = &image->process->parasite;
	uint16_t random[THREADS_MAX] = { 0 };

	if (most_ms && getrandom(random, sizeof random, 0) < 0)
		return;
	for (uint32_t i = 0; i < image->threads && i < parasite->threads_max; i++)
		parasite_thread(parasite, image->slot, i)->pause_ms = random[i % THREADS_MAX] %
								      (most_ms + 1);
}

/* Until all threads of the process are back; or it has died again already. */
static void await_running(const struct image *image, int pidfd, uint64_t end)
{
	struct inj_slot *slot = parasite_slot(&image->process->parasite, image->slot);
	uint32_t running;

	while ((running = __atomic_load_n(&slot->running, __ATOMIC_ACQUIRE)) != slot->threads &&
	       wait_word(&slot->running, running, pidfd, end))
		;
}

static void go(struct restore *restore)
{
	struct generation *generation = restore->generation;
	const struct image *main = &generation->image[0];
	struct inj_slot *slot = parasite_slot(&main->process->parasite, main->slot);
	const bool staggers = restore->config->again & AVC_AGAIN_STAGGER;
	const uint64_t end = now_ns() + READY_NS;

	for (uint32_t i = 0; staggers && i < generation->images; i++)
		if (generation->image[i].process)
			set_pauses(&generation->image[i], STAGGER_MS);
	if (restore->tree)
		restore_tree_go(restore->tree);
	if (!restore->sandbox && main->headless) {
		let_go(slot, INJ_GO_ENDED);
		proc_await_end(restore->pid);
	}
	restore_go(main, restore->sandbox);
	spare_drop(generation); /* it shares memory with what runs now */
	await_running(main, restore->pidfd, end);
	/* The others take no longer, unless they are to. */
	for (uint32_t i = 0; staggers && i < generation->images; i++) {
		const struct image *image = &generation->image[i];

		if (i && image->process)
			await_running(image, restore_tree_pidfd(restore->tree, i), end);
		if (image->process)
			set_pauses(image, 0);
	}
	restore->restore_ns = now_ns() - restore->died_ns;
	for (uint32_t i = 0; i < generation->images; i++)
		generation->image[i].pid = i ? restore_tree_pid(restore->tree, i) : restore->pid;
}

struct last_pid *restore_ahead(const struct generation *generation,
			       const struct init_channel *channel)
{
	struct avc_error later = { 0 }; /* reported when it is needed */

	return start_helper(generation, channel, &later);
}

int restore_app(struct restore *restore, struct avc_error *err)
{
	struct generation *generation = restore->generation;
	const struct image *main = &generation->image[0];
	int result;

	restore->pid = 0;
	restore->pidfd = -1;
	if (!restore->helper)
		restore->helper = start_helper(generation, restore->channel, err);
	if (!restore->helper)
		return -1;
	restore_go_on(restore);
	result = make(restore, err);
	tracee_deadline_clear(restore->timer);
	last_pid_stop(restore->helper);
	for (uint32_t i = 0; i < generation->images; i++)
		fd_table_free(&generation->image[i].table);
	if (!result) {
		restore_note(main, restore->pid, &restore->notes);
		result = memory_put_back(main, restore->pid, &restore->notes, err);
	}
	last_pid_await_stop(restore->helper);
	/* Something has been left out, or taken for gone. */
	if (shortage_check(err, "restore"))
		result = -1;
	if (!result)
		result = restore->ready(restore->arg, err);
	if (!result)
		restore_patience_end(); /* it has its verdict, and is not to wait for anybody */
	if (result)
		take_back(restore);
	else
		go(restore);
	/* The app runs: it need not wait for two processes to exit. */
	last_pid_end(restore->helper);
	restore_tree_free(restore->tree);
	close_fd(&restore->pidfd);
	return result;
}
