/* SPDX-License-Identifier: Apache-2.0
 *
 * The attributes of a process other than the main one, besides memory and descriptors: signal
 * handlers, root and working directory, limits, groups, and its layout as known to the kernel.
 */
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "state.h"

#define SIGNALS 64
#define AUXV_BYTES 1024
#ifndef PR_SET_MEMORY_MERGE
#define PR_SET_MEMORY_MERGE 67 /* since Linux 6.4 */
#define PR_GET_MEMORY_MERGE 68
#endif
#define KEYS 16 /* of memory, at most (pkeys(7)); the first one is the default */
/* membarrier(2).  Only since Linux 6.3 it reports what is registered; but an unregistered command
 * is refused, and the command that registers it is its double. */
#define BARRIERS_REGISTERED (1 << 9)
#define BARRIER_GLOBAL (1 << 1)
static const int barriers[] = { 1 << 3, 1 << 5, 1 << 7 };

/* ---- after a checkpoint ------------------------------------------------------------ */

struct action { /* struct sigaction as the kernel has it                          */
	uint64_t handler, flags, restorer, mask;
};

struct process_attrs {
	struct action action[SIGNALS];
	int64_t brk;
	uint32_t personality;
	uint64_t state_permitted;       /* arch_cpu.h, ARCH_STATE_PERMITTED               */
	int64_t no_huge_pages, merging; /* prctl(2), PR_GET_THP_DISABLE, PR_GET_MEMORY_MERGE */
	int64_t barriers;               /* membarrier(2): commands that register it          */
	uint32_t keys;                  /* pkey_alloc(2): by number; 0: the CPU has none */
	uint32_t umask;
	int64_t dumped;            /* core(5), coredump_filter; -1: the kernel has no core dumps */
	uint64_t mm[11];           /* of struct prctl_mm_map, but for brk                   */
	uint64_t limit[LIMITS][2]; /* getrlimit(2)                                  */
	uint32_t auxv_bytes;
	uint8_t auxv[AUXV_BYTES];
};

enum {
	START_CODE,
	END_CODE,
	START_DATA,
	END_DATA,
	START_BRK,
	BRK,
	START_STACK,
	ARG_START,
	ARG_END,
	ENV_START,
	ENV_END
};

static int read_mm(pid_t pid, struct process_attrs *attrs)
{
	/* Fields of /proc/PID/stat after the name, counted from `state` as 3. */
	static const struct {
		int field, to;
	} fields[] = { { 26, START_CODE }, { 27, END_CODE }, { 28, START_STACK },
		       { 45, START_DATA }, { 46, END_DATA }, { 47, START_BRK },
		       { 48, ARG_START },  { 49, ARG_END },  { 50, ENV_START },
		       { 51, ENV_END } };
	char buf[1024], *p;
	ssize_t n;
	int fd;

	if (proc_read(pid, "stat", buf, sizeof buf) <= 0 || !(p = strrchr(buf, ')')))
		return -1;
	p++;
	for (int field = 3; *p; field++) {
		char *next;

		while (*p == ' ')
			p++;
		for (size_t i = 0; i < sizeof fields / sizeof *fields; i++)
			if (fields[i].field == field)
				attrs->mm[fields[i].to] = strtoull(p, NULL, 10);
		next = strchr(p, ' ');
		if (!next)
			break;
		p = next;
	}
	fd = proc_open(pid, "auxv", O_RDONLY);
	n = fd < 0 ? -1 : read(fd, attrs->auxv, sizeof attrs->auxv);
	close_fd(&fd);
	attrs->auxv_bytes = n > 0 ? (uint32_t)n : 0;
	return 0;
}

static int read_status(pid_t pid, struct process_attrs *attrs)
{
	struct proc_status status;
	char buf[64];

	if (proc_status(pid, &status))
		return -1;
	attrs->umask = status.umask;
	attrs->dumped = proc_read(pid, "coredump_filter", buf, sizeof buf) > 0
				? (int64_t)strtoul(buf, NULL, 16)
				: -1;
	return 0;
}

static bool has_keys(void)
{
	static int has = -1;

	if (__atomic_load_n(&has, __ATOMIC_RELAXED) < 0) {
		const long key = syscall(SYS_pkey_alloc, 0, 0);

		if (key >= 0)
			syscall(SYS_pkey_free, key);
		__atomic_store_n(&has, key >= 0, __ATOMIC_RELAXED);
	}
	return has;
}

/* Those of another process cannot be read.  The template allocates all free ones, and those that it
 * does not get are in use.  It keeps them: it never runs, and no process is forked from it. */
static uint32_t keys_of(const struct inj_syscall given[KEYS - 1])
{
	uint32_t taken = (1u << KEYS) - 2;

	if (!has_keys())
		return 0;
	for (int i = 0; i < KEYS - 1; i++)
		if (given[i].result > 0)
			taken &= ~(1u << given[i].result);
	return taken;
}

static int64_t barriers_of(const struct inj_syscall *told, const struct inj_syscall *made)
{
	/* The kernel does not tell whether it registered for global barriers; registering is
	 * cheap. */
	int64_t registered = BARRIER_GLOBAL << 1;

	if (told->result >= 0)
		return told->result;
	for (size_t i = 0; i < sizeof barriers / sizeof *barriers; i++)
		if (made[i].result == 0)
			registered |= barriers[i] << 1;
	return registered;
}

int process_attrs_learn(struct image *image, struct avc_error *err)
{
	const struct parasite *parasite = &image->process->parasite;
	struct inj_call *call = &parasite_slot(parasite, image->slot)->template_call;
	uint8_t *memory = parasite_files(parasite, image->slot) + INJ_FILES_BYTES / 2;
	struct inj_syscall *list = (struct inj_syscall *)memory;
	struct action *action = (struct action *)(list + SIGNALS + 8 + KEYS);
	const struct thread *main_thread = thread_find(image->process, image->process->pid);
	struct process_attrs *attrs = calloc(1, sizeof *attrs);
	const struct inj_syscall *keys;
	uint32_t n = 0;

	image->attrs = attrs;
	if (!attrs)
		return fail_memory(err, 0, "keep template");
	for (int i = 0; i < SIGNALS; i++)
		list[n++] = (struct inj_syscall){
			.nr = SYS_rt_sigaction,
			.arg = { (uint64_t)i + 1, 0, parasite_remote(parasite, &action[i]), 8 }
		};
	list[n++] = (struct inj_syscall){ .nr = SYS_brk };
	list[n++] = (struct inj_syscall){ .nr = SYS_prctl, .arg = { PR_GET_THP_DISABLE } };
	list[n++] = (struct inj_syscall){ .nr = SYS_prctl, .arg = { PR_GET_MEMORY_MERGE } };
	list[n++] = (struct inj_syscall){ .nr = SYS_membarrier, .arg = { BARRIERS_REGISTERED } };
	for (size_t i = 0; i < sizeof barriers / sizeof *barriers; i++)
		list[n++] = (struct inj_syscall){ .nr = SYS_membarrier,
						  .arg = { (uint64_t)barriers[i] } };
	keys = &list[n];
	for (int i = 0; i < KEYS - 1; i++)
		list[n++] = (struct inj_syscall){ .nr = SYS_pkey_alloc };
	call_begin(call, INJ_AFTER_PARK);
	call_add(call, INJ_LIST, parasite_remote(parasite, list), n);
	if (parasite_send(parasite, image->template, &image->base, call, err) ||
	    parasite_run(image->template, call, err))
		return -1;
	memcpy(attrs->action, action, sizeof attrs->action);
	attrs->brk = list[SIGNALS].result;
	attrs->no_huge_pages = list[SIGNALS + 1].result;
	attrs->merging = list[SIGNALS + 2].result;
	attrs->barriers = barriers_of(&list[SIGNALS + 3], &list[SIGNALS + 4]);
	attrs->keys = keys_of(keys);
	/* These are not shared with its holder: the process itself was queried, in the freeze. */
	attrs->personality = main_thread->creds.personality;
	attrs->state_permitted = main_thread->creds.state_permitted;
	/* The template has the limits of when the holder was created. */
	if (read_mm(image->template, attrs) || read_status(image->template, attrs) ||
	    (proc_limits(image->process->pid, attrs->limit) &&
	     proc_limits(image->template, attrs->limit)))
		return fail_errno(err, image->template, "keep template", "open(/proc)",
				  "it was killed");
	return 0;
}

void process_attrs_forget(struct image *image)
{
	free(image->attrs);
	image->attrs = NULL;
}

/* ---- a restore ------------------------------------------------------------------------ */

/* Arguments of the calls, in the batch's memory. */
struct arguments {
	struct action action[SIGNALS];
	struct { /* struct prctl_mm_map                                     */
		uint64_t mm[11];
		uint64_t auxv;
		uint32_t auxv_bytes, exe_fd;
	} map;
	uint8_t auxv[AUXV_BYTES];
	char here[8];
};

static struct arguments *arguments_of(const struct syscall_batch *batch)
{
	return (struct arguments *)batch->data;
}

/* Only affects what `ps` shows, and where its heap may grow. */
static void put_mm(struct syscall_batch *batch, const struct process_attrs *attrs)
{
	struct arguments *arguments = arguments_of(batch);

	memcpy(arguments->map.mm, attrs->mm, sizeof attrs->mm);
	memcpy(arguments->auxv, attrs->auxv, attrs->auxv_bytes);
	arguments->map.mm[BRK] = (uint64_t)attrs->brk;
	arguments->map.auxv = attrs->auxv_bytes ? parasite_remote(batch->parasite, arguments->auxv)
						: 0;
	arguments->map.auxv_bytes = attrs->auxv_bytes;
	arguments->map.exe_fd = ~0u;
	syscall_batch_add(batch, SYS_prctl, PR_SET_MM, PR_SET_MM_MAP,
			  parasite_remote(batch->parasite, &arguments->map), sizeof arguments->map);
	syscall_batch_soften(batch,
			     "its heap and argument addresses (PR_SET_MM) could not be put back");
}

void process_attrs_lift_limit(pid_t pid, int which, uint64_t least)
{
	struct rlimit now, lifted;

	if (prlimit(pid, which, NULL, &now))
		return;
	lifted.rlim_cur = lifted.rlim_max = now.rlim_max > least ? now.rlim_max : least;
	/* Usually there is nothing to lift. */
	if ((lifted.rlim_cur == now.rlim_cur && lifted.rlim_max == now.rlim_max) ||
	    prlimit(pid, which, &lifted, NULL) == 0)
		return;
	/* Not permitted; but up to the hard limit it is. */
	now.rlim_cur = now.rlim_max;
	(void)prlimit(pid, which, &now, NULL);
}

void process_attrs_lift_limits(pid_t pid, const struct image *image, uint32_t files)
{
	/* The descriptor limit is bounded (sysctl fs.nr_open). */
	for (int i = 0; i < LIMITS; i++)
		process_attrs_lift_limit(pid, i, i == RLIMIT_NOFILE ? files : RLIM_INFINITY);
	process_attrs_lift_limit(pid, RLIMIT_NOFILE, image->attrs->limit[RLIMIT_NOFILE][1]);
}

void process_attrs_setup_limits(const struct image *image, struct setup *setup)
{
	for (uint64_t i = 0; i < LIMITS; i++)
		setup_add(setup, INJ_AFTER, "prlimit", INJ_LIMIT, i,
			  setup_data(setup, image->attrs->limit[i], sizeof image->attrs->limit[i]))
			->flags = INJ_MAY_FAIL;
}

/* Changes to a directory of the template. */
static int enter(struct syscall_batch *batch, pid_t template, const char *name,
		 struct avc_error *err)
{
	int folder = proc_open(template, name, O_PATH | O_DIRECTORY);

	if (folder < 0)
		return fail_errno(err, batch->pid, "restore", "open", "its %s directory is gone",
				  name);
	if (syscall_batch_give(batch, folder, err)) {
		close(folder);
		return -1;
	}
	close(folder);
	syscall_batch_add(batch, SYS_fchdir, (uint64_t)batch->given);
	syscall_batch_add(batch, SYS_close, (uint64_t)batch->given);
	return 0;
}

/* It inherits its parent's, and may change it only if the parent still has that right. */
static int put_folders(struct syscall_batch *batch, pid_t template, struct avc_error *err)
{
	struct arguments *arguments = arguments_of(batch);

	if (proc_same_file(template, batch->pid, "root") != 1) {
		if (enter(batch, template, "root", err))
			return -1;
		strcpy(arguments->here, ".");
		syscall_batch_add(batch, SYS_chroot,
				  parasite_remote(batch->parasite, arguments->here));
	}
	return enter(batch, template, "cwd", err);
}

static void put_dumped(struct syscall_batch *batch, int64_t dumped)
{
	int fd;

	if (dumped < 0)
		return;
	fd = proc_open(batch->pid, "coredump_filter", O_WRONLY);
	if (fd < 0 || dprintf(fd, "0x%x", (unsigned int)dumped) < 0)
		fail_errno(batch->notes, batch->inside, "restore", "write(coredump_filter)",
			   "its core dump settings could not be put back");
	close_fd(&fd);
}

int process_attrs_take_keys(struct syscall_batch *batch, struct avc_error *err)
{
	if (!has_keys())
		return 0;
	for (int i = 0; i < KEYS - 1; i++) {
		if (syscall_batch_ask(batch, err, SYS_pkey_alloc))
			return -1;
		syscall_batch_soften(batch, NULL);
	}
	return 0;
}

static int free_keys(struct syscall_batch *batch, uint32_t kept, struct avc_error *err)
{
	if (!has_keys())
		return 0;
	for (uint64_t key = 1; key < KEYS; key++) {
		if (kept & 1u << key)
			continue;
		if (syscall_batch_ask(batch, err, SYS_pkey_free, key))
			return -1;
		syscall_batch_soften(batch, NULL);
	}
	return 0;
}

int process_attrs_put(struct syscall_batch *batch, const struct image *image, struct avc_error *err)
{
	const struct process_attrs *attrs = image->attrs;
	struct arguments *arguments = arguments_of(batch);

	if (put_folders(batch, image->template, err) || free_keys(batch, attrs->keys, err))
		return -1;
	syscall_batch_add(batch, SYS_umask, attrs->umask);
	syscall_batch_add(batch, SYS_personality, attrs->personality);
	memcpy(arguments->action, attrs->action, sizeof arguments->action);
	for (int i = 0; i < SIGNALS; i++)
		if (i + 1 != SIGKILL && i + 1 != SIGSTOP &&
		    syscall_batch_ask(batch, err, SYS_rt_sigaction, (uint64_t)i + 1,
				      parasite_remote(batch->parasite, &arguments->action[i]), 0,
				      8))
			return -1;
	for (int64_t left = attrs->barriers; left > 0; left &= left - 1)
		syscall_batch_add(batch, SYS_membarrier, (uint64_t)(left & -left));
	put_mm(batch, attrs);
	put_dumped(batch, attrs->dumped);
	if (attrs->state_permitted >> ARCH_STATE_NUMBER & 1)
		syscall_batch_add(batch, ARCH_STATE_CALL, ARCH_STATE_ASK, ARCH_STATE_NUMBER);
	/* Since Linux 6.18 the answer includes flags, which are set by a separate argument. */
	if (attrs->no_huge_pages >= 0)
		syscall_batch_add(batch, SYS_prctl, PR_SET_THP_DISABLE,
				  (uint64_t)attrs->no_huge_pages & 1,
				  (uint64_t)attrs->no_huge_pages & ~UINT64_C(1));
	if (attrs->merging >= 0) {
		syscall_batch_add(batch, SYS_prctl, PR_SET_MEMORY_MERGE, (uint64_t)attrs->merging);
		syscall_batch_soften(batch,
				     "its setting for merging pages (KSM) could not be put back");
	}
	return 0;
}
