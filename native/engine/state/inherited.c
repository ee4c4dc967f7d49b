/* SPDX-License-Identifier: Apache-2.0
 *
 * What a fork inherits besides memory and descriptors.  A template that is updated instead of being
 * forked again has these as of its fork: they must equal what the process has now.
 */
#include <fcntl.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "state.h"

#define PR_GET_MDWE_ 66         /* since Linux 6.3; the headers may be older       */
#define PR_GET_MEMORY_MERGE_ 68 /* since Linux 6.4                                 */
#define BARRIERS_REGISTERED (1 << 9)
#define FIRST_LAYOUT_FIELD 26 /* of /proc/PID/stat, counted from `state` as 3     */
#define LAST_LAYOUT_FIELD 28
#define SECOND_LAYOUT_FIELD 45
#define END_LAYOUT_FIELD 51

/* Memory of the list of calls, with room for its answers. */
struct list {
	struct inj_syscall call[INHERITED_SIGNALS + INHERITED_VALUES + 1];
	uint64_t action[INHERITED_SIGNALS][4];
	uint64_t robust[2]; /* that list of a template's; not used */
};

static struct list *list_of(const struct parasite *parasite, uint32_t slot)
{
	_Static_assert(sizeof(struct list) <= INJ_FILES_BYTES / 2, "room for the list");
	return (struct list *)(parasite_files(parasite, slot) + INJ_FILES_BYTES / 2);
}

/* No call tells the Landlock domain that a task is in.  But it may not look into one outside of it,
 * nor into its own template if it has entered it since (ptrace(2), PTRACE_MODE_READ). */
void inherited_ask(const struct parasite *parasite, uint32_t slot, pid_t template,
		   struct inj_call *call)
{
	struct list *list = list_of(parasite, slot);
	const uint64_t robust = parasite_remote(parasite, list->robust);
	const uint64_t asked[INHERITED_VALUES][4] = {
		[INHERITED_BREAK] = { SYS_brk },
		{ SYS_prctl, PR_GET_THP_DISABLE },
		{ SYS_prctl, PR_GET_MEMORY_MERGE_ },
		{ SYS_prctl, PR_GET_MDWE_ },
		{ SYS_membarrier, BARRIERS_REGISTERED },
		{ SYS_prctl, PR_MCE_KILL_GET },
		{ SYS_prctl, PR_GET_IO_FLUSHER },
		{ SYS_prctl, PR_GET_SPECULATION_CTRL, PR_SPEC_STORE_BYPASS },
		{ SYS_prctl, PR_GET_SPECULATION_CTRL, PR_SPEC_INDIRECT_BRANCH },
		{ SYS_prctl, PR_GET_KEEPCAPS },
		{ SYS_get_robust_list, (uint64_t) template, robust, robust + 8 },
	};
	uint32_t n = 0;

	memset(list, 0, sizeof *list);
	for (int i = 0; i < INHERITED_SIGNALS; i++)
		list->call[n++] = (struct inj_syscall){
			.nr = SYS_rt_sigaction,
			.arg = { (uint64_t)i + 1, 0, parasite_remote(parasite, list->action[i]), 8 }
		};
	for (int i = 0; i < INHERITED_VALUES; i++)
		list->call[n++] = (struct inj_syscall){
			.nr = (int64_t)asked[i][0], .arg = { asked[i][1], asked[i][2], asked[i][3] }
		};
	list->call[n++] = (struct inj_syscall){ .nr = SYS_prctl, .arg = { PR_GET_DUMPABLE } };
	call_add(call, INJ_LIST, parasite_remote(parasite, list), n);
}

void inherited_answer(const struct parasite *parasite, uint32_t slot, struct inherited *inherited,
		      int64_t *dumpable)
{
	const struct list *list = list_of(parasite, slot);

	memcpy(inherited->action, list->action, sizeof inherited->action);
	for (int i = 0; i < INHERITED_VALUES; i++)
		inherited->value[i] = list->call[INHERITED_SIGNALS + i].result;
	*dumpable = list->call[INHERITED_SIGNALS + INHERITED_VALUES].result;
}

/* What prctl(2), PR_SET_MM, may change. */
static int read_layout(struct inherited *inherited, pid_t pid)
{
	char buf[1024], *p;

	if (proc_read(pid, "stat", buf, sizeof buf) <= 0 || !(p = strrchr(buf, ')')))
		return -1;
	inherited->stat = 0;
	p++;
	for (int field = 3; p && field <= END_LAYOUT_FIELD; field++) {
		const char *value = ++p;

		p = strchr(p, ' ');
		if ((field >= FIRST_LAYOUT_FIELD && field <= LAST_LAYOUT_FIELD) ||
		    field >= SECOND_LAYOUT_FIELD)
			inherited->stat = hash_bytes(inherited->stat, value,
						     p ? (size_t)(p - value) : strlen(value));
	}
	return 0;
}

static int read_places(struct inherited *inherited, pid_t pid)
{
	static const char *const places[] = {
		"cwd",    "root",   "exe",     "ns/mnt",    "ns/net",
		"ns/ipc", "ns/uts", "ns/user", "ns/cgroup", "ns/pid"
	};

	inherited->places = 0;
	for (size_t i = 0; i < sizeof places / sizeof *places; i++) {
		struct statx st;
		uint64_t what[3];

		/* Not on a file system that may not answer: FUSE or network. */
		if (!proc_look(pid, places[i], STATX_INO | STATX_MNT_ID, &st))
			return -1;
		what[0] = device_of(&st);
		what[1] = st.stx_ino;
		what[2] = st.stx_mnt_id;
		inherited->places = hash_bytes(inherited->places, what, sizeof what);
	}
	return 0;
}

int inherited_read(struct inherited *inherited, pid_t pid, struct avc_error *err)
{
	struct proc_status status;
	char buf[64];

	if (proc_status(pid, &status) || proc_limits(pid, inherited->limit) ||
	    read_layout(inherited, pid) || read_places(inherited, pid))
		return fail_errno(err, pid, "read state", "open(/proc)", "it has ended");
	inherited->umask = status.umask;
	inherited->dumped = proc_read(pid, "coredump_filter", buf, sizeof buf) > 0
				    ? (uint32_t)strtoul(buf, NULL, 16)
				    : 0;
	return 0;
}

void inherited_creds(struct inherited *inherited, const struct thread *thread)
{
	inherited->creds = thread->creds;
	/* These are not inherited by fork; a restored process sets them. */
	inherited->creds.death_signal = inherited->creds.subreaper = 0;
	inherited->creds.future_lock = 0;
}

bool inherited_equal(const struct inherited *a, const struct inherited *b)
{
	struct inherited same = *a;

	same.value[INHERITED_BREAK] = b->value[INHERITED_BREAK];
	return !memcmp(&same, b, sizeof same);
}
