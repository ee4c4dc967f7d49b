/* SPDX-License-Identifier: Apache-2.0
 *
 * The attributes of a thread: scheduling, I/O priority, credentials, prctl(2) settings.
 *
 * A restored process inherits from its template, which is a fork of the main thread: most
 * attributes are right without further action.  The rest are
 *   - what fork(2) resets: parent-death signal, child subreaper;
 *   - threads that differ from the main thread: they set their attributes again themselves, except
 *     for scheduling, which a process may have without the right to set it: the guard sets that.
 */
#include <errno.h>
#include <fcntl.h>
#include <linux/capability.h>
#include <linux/securebits.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "state.h"

#define IOPRIO_WHO_PROCESS 1
#define CAPABILITY_VERSION_3 0x20080522
#define NODE_BITS (64 * NODE_WORDS)
#define LOCKS 0xaaaaaaaau /* securebits: each locks the one below it (linux/securebits.h) */

struct attributes {
	char oom_score_adj[16];
	uint32_t count;
	struct {
		pid_t inside;
		struct scheduling scheduling;
	} thread[]; /* those to be set from outside                            */
};

/* Where the kernel stores answers; the rest are results. */
struct answers {
	uint32_t uid[3], gid[3];
	uint32_t caps[6];
	uint32_t death_signal, subreaper;
	uint32_t header[2];
	int32_t memory_policy;
	uint32_t group[GROUPS_KEPT];
	uint64_t nodes[NODE_WORDS];
	uint64_t state_permitted;
};

enum {
	FSUID,
	FSGID,
	SECUREBITS,
	NO_NEW_PRIVS,
	SLACK,
	GROUP_COUNT,
	POLICY,
	PERSONALITY,
	CAPS,
	BOUNDING,
	AMBIENT
};

void attributes_read_scheduling(pid_t tid, struct scheduling *s)
{
	memset(s, 0, sizeof *s);
	if (syscall(SYS_sched_getattr, tid, s->attr, sizeof s->attr, 0))
		memset(s->attr, 0, sizeof s->attr);
	s->io_priority = (int32_t)syscall(SYS_ioprio_get, IOPRIO_WHO_PROCESS, tid);
}

/* A supervised task would stop twice for each capability that there is: /proc is read instead. */
static void ask_caps(const struct parasite *parasite, struct inj_call *call, avc_remote others)
{
	if (parasite->seccomp == SECCOMP_SUPERVISED) {
		call_add(call, INJ_LIST); /* an empty one */
		call_add(call, INJ_LIST);
	} else {
		call_add(call, INJ_CAPS, PR_CAPBSET_READ);
		call_add(call, INJ_CAPS, PR_CAP_AMBIENT, others);
	}
}

const struct inj_syscall *attributes_ask(const struct parasite *parasite, struct inj_call *call,
					 void *out)
{
	const avc_remote remote = parasite_remote(parasite, out);
	struct answers *a = out;
	const struct inj_syscall *first;

	a->header[0] = CAPABILITY_VERSION_3;
	a->header[1] = 0;
#define AT(field) (remote + offsetof(struct answers, field))
	first = call_add(call, SYS_setfsuid, (uint64_t)-1); /* changes nothing */
	call_add(call, SYS_setfsgid, (uint64_t)-1);
	call_add(call, SYS_prctl, PR_GET_SECUREBITS);
	call_add(call, SYS_prctl, PR_GET_NO_NEW_PRIVS);
	call_add(call, SYS_prctl, PR_GET_TIMERSLACK);
	call_add(call, SYS_getgroups);
	call_add(call, SYS_get_mempolicy, AT(memory_policy), AT(nodes), NODE_BITS);
	call_add(call, SYS_personality, 0xffffffff);
	call_add(call, SYS_capget, AT(header), AT(caps));
	ask_caps(parasite, call, AT(caps));
	call_add(call, ARCH_STATE_CALL, ARCH_STATE_PERMITTED, AT(state_permitted));
	call_add(call, SYS_getgroups, GROUPS_KEPT, AT(group));
	call_add(call, SYS_getresuid, AT(uid), AT(uid) + 4, AT(uid) + 8);
	call_add(call, SYS_getresgid, AT(gid), AT(gid) + 4, AT(gid) + 8);
	call_add(call, SYS_prctl, PR_GET_PDEATHSIG, AT(death_signal));
	call_add(call, SYS_prctl, PR_GET_CHILD_SUBREAPER, AT(subreaper));
#undef AT
	return first;
}

int attributes_answer(pid_t tid, const struct inj_syscall *first, const void *out, struct creds *c,
		      struct avc_error *err)
{
	const struct answers *a = out;
	const bool has_caps = first[BOUNDING].nr == INJ_CAPS;
	struct proc_status status;

	_Static_assert(sizeof *a <= ATTRIBUTES_ASK_BYTES, "room for the answers");
	if (!has_caps && proc_status(tid, &status))
		return fail_errno(err, tid, "read state", "read(status)", "it has ended");
	memset(c, 0, sizeof *c); /* compared by memcmp() */
	memcpy(c->uid, a->uid, sizeof a->uid);
	memcpy(c->gid, a->gid, sizeof a->gid);
	memcpy(c->caps, a->caps, sizeof c->caps);
	c->bounding = has_caps ? (uint64_t)first[BOUNDING].result : status.caps[STATUS_BOUNDING];
	c->ambient = has_caps ? (uint64_t)first[AMBIENT].result : status.caps[STATUS_AMBIENT];
	c->personality = (uint32_t)first[PERSONALITY].result;
	c->state_permitted = a->state_permitted;
	c->fsuid = (uint32_t)first[FSUID].result;
	c->fsgid = (uint32_t)first[FSGID].result;
	c->securebits = (uint32_t)first[SECUREBITS].result;
	c->no_new_privs = first[NO_NEW_PRIVS].result == 1;
	c->group_count = (int32_t)first[GROUP_COUNT].result;
	if (c->group_count > 0 && c->group_count <= GROUPS_KEPT)
		memcpy(c->group, a->group, (size_t)c->group_count * sizeof *c->group);
	c->memory_policy = first[POLICY].result ? -1 : a->memory_policy;
	if (!first[POLICY].result)
		memcpy(c->nodes, a->nodes, sizeof c->nodes);
	c->slack_ns = (uint64_t)first[SLACK].result;
	c->death_signal = a->death_signal;
	c->subreaper = a->subreaper;
	return 0;
}

/* ---- when the app runs again ------------------------------------------------------------ */

static bool differ_in_groups(const struct creds *a, const struct creds *b)
{
	return a->group_count != b->group_count || memcmp(a->group, b->group, sizeof a->group);
}

enum { EFFECTIVE, PERMITTED, INHERITABLE };

static uint64_t caps_of(const struct creds *c, int set)
{
	return c->caps[set] | (uint64_t)c->caps[set + 3] << 32;
}

static void add_capset(struct setup *setup, uint64_t effective, uint64_t permitted,
		       uint64_t inheritable)
{
	const struct {
		uint32_t header[2], caps[6];
	} data = {
		.header = { CAPABILITY_VERSION_3, 0 },
		.caps = { (uint32_t)effective, (uint32_t)permitted, (uint32_t)inheritable,
			  (uint32_t)(effective >> 32), (uint32_t)(permitted >> 32),
			  (uint32_t)(inheritable >> 32) },
	};
	const avc_remote at = setup_data(setup, &data, sizeof data);

	setup_add_thread(setup, "capset", SYS_capset, at, at + sizeof data.header);
}

static bool differ_in_securebits(const struct creds *from, const struct creds *to)
{
	return ((from->securebits ^ to->securebits) & ~(uint32_t)SECBIT_KEEP_CAPS) != 0;
}

static bool raises_ambient(const struct creds *from, const struct creds *to)
{
	/* Another user has none of these capabilities. */
	return to->ambient &&
	       (to->ambient != from->ambient || memcmp(from->uid, to->uid, sizeof to->uid));
}

/* A thread that has fewer privileges than the main thread, or others.  It must not continue with
 * more than it had: these calls must succeed. */
static void lower(const struct creds *from, const struct creds *to, struct setup *setup)
{
	const bool uids = memcmp(from->uid, to->uid, sizeof to->uid) != 0;
	const bool gids = memcmp(from->gid, to->gid, sizeof to->gid) != 0;
	/* A daemon that takes its rights back when it needs them. */
	const bool raised = (uids || gids || differ_in_groups(from, to)) &&
			    caps_of(from, EFFECTIVE) != caps_of(from, PERMITTED);
	const bool caps = uids || raised || memcmp(from->caps, to->caps, sizeof to->caps) ||
			  from->bounding != to->bounding || from->ambient != to->ambient ||
			  differ_in_securebits(from, to) ||
			  /* A change of the file-system user changes capabilities, too. */
			  from->fsuid != to->fsuid;
	uint32_t bits = from->securebits;

	if (raised)
		add_capset(setup, caps_of(from, PERMITTED), caps_of(from, PERMITTED),
			   caps_of(from, INHERITABLE));
	if (differ_in_groups(from, to))
		setup_add_thread(setup, "setgroups", SYS_setgroups, (uint64_t)to->group_count,
				 setup_data(setup, to->group, sizeof to->group));
	if (gids)
		setup_add_thread(setup, "setresgid", SYS_setresgid, to->gid[0], to->gid[1],
				 to->gid[2]);
	/* Otherwise the capabilities would be dropped with the user. */
	if (uids && !(bits & SECBIT_KEEP_CAPS)) {
		setup_add_thread(setup, "prctl(KEEPCAPS)", SYS_prctl, PR_SET_KEEPCAPS, 1);
		bits |= SECBIT_KEEP_CAPS;
	}
	if (uids)
		setup_add_thread(setup, "setresuid", SYS_setresuid, to->uid[0], to->uid[1],
				 to->uid[2]);
	if ((bits ^ to->securebits) & SECBIT_KEEP_CAPS)
		setup_add_thread(setup, "prctl(KEEPCAPS)", SYS_prctl, PR_SET_KEEPCAPS,
				 (to->securebits & SECBIT_KEEP_CAPS) != 0);
	/* The effective ones were cleared anyway, and are needed once more. */
	if (caps)
		add_capset(setup, caps_of(from, PERMITTED), caps_of(from, PERMITTED),
			   caps_of(to, INHERITABLE));
	if (from->fsgid != to->fsgid || to->fsgid != to->gid[1])
		setup_add_thread(setup, "setfsgid", SYS_setfsgid, to->fsgid);
	if (from->fsuid != to->fsuid || to->fsuid != to->uid[1])
		setup_add_thread(setup, "setfsuid", SYS_setfsuid, to->fsuid);
	/* After the inheritable set, which must stay within the bounding set. */
	if (from->bounding != to->bounding)
		setup_add_thread(setup, "prctl(CAPBSET_DROP)", INJ_CAPS_CHANGE, PR_CAPBSET_DROP,
				 from->bounding & ~to->bounding);
	if (from->ambient & ~to->ambient)
		setup_add_thread(setup, "prctl(CAP_AMBIENT)", SYS_prctl, PR_CAP_AMBIENT,
				 PR_CAP_AMBIENT_CLEAR_ALL);
	if (raises_ambient(from, to))
		setup_add_thread(setup, "prctl(CAP_AMBIENT)", INJ_CAPS_CHANGE, PR_CAP_AMBIENT,
				 to->ambient);
	if (differ_in_securebits(from, to))
		setup_add_thread(setup, "prctl(SECUREBITS)", SYS_prctl, PR_SET_SECUREBITS,
				 to->securebits);
	if (caps)
		add_capset(setup, caps_of(to, EFFECTIVE), caps_of(to, PERMITTED),
			   caps_of(to, INHERITABLE));
	if (to->no_new_privs && !from->no_new_privs)
		setup_add_thread(setup, "prctl(NO_NEW_PRIVS)", SYS_prctl, PR_SET_NO_NEW_PRIVS, 1);
}

/* Whether each capability set of `to` is within those of `from`. */
static bool has_less(const struct creds *from, const struct creds *to)
{
	return !(caps_of(to, PERMITTED) & ~caps_of(from, PERMITTED)) &&
	       !(to->bounding & ~from->bounding) &&
	       !(caps_of(to, INHERITABLE) &
		 ~(caps_of(from, INHERITABLE) | (caps_of(from, PERMITTED) & from->bounding)));
}

/* Dropping from these sets takes a capability itself. */
static bool may_be_lowered(const struct creds *from, const struct creds *to)
{
	const bool may = caps_of(from, PERMITTED) >> CAP_SETPCAP & 1;

	return (may || (from->bounding == to->bounding && !differ_in_securebits(from, to))) &&
	       !(from->securebits & SECBIT_NO_CAP_AMBIENT_RAISE && raises_ambient(from, to));
}

/* What is locked in `from` is locked and equal in `to`, too, and lower() need not change it
 * temporarily, which is impossible (prctl(2), PR_SET_SECUREBITS and PR_SET_KEEPCAPS). */
static bool fits_locks(const struct creds *from, const struct creds *to)
{
	const uint32_t locks = from->securebits & LOCKS;
	uint32_t changed = from->securebits ^ to->securebits;

	if (memcmp(from->uid, to->uid, sizeof to->uid) && !(from->securebits & SECBIT_KEEP_CAPS))
		changed |= SECBIT_KEEP_CAPS;
	return !(locks & ~to->securebits) && !(locks >> 1 & changed);
}

static bool is_among(uint32_t id, const uint32_t ids[3], uint32_t of_files)
{
	return id == ids[0] || id == ids[1] || id == ids[2] || id == of_files;
}

/* setresuid(2), setfsuid(2): an id that it has, in one role or the other. */
static bool may_take_ids(const uint32_t from[3], const uint32_t to[3])
{
	return is_among(to[0], from, from[0]) && is_among(to[1], from, from[0]) &&
	       is_among(to[2], from, from[0]);
}

/* Calls of lower() must not be refused at a restore, when it is too late. */
static bool may_become(const struct creds *from, const struct creds *to)
{
	const uint64_t may = caps_of(from, PERMITTED);

	return (may >> CAP_SETGID & 1 ||
		(may_take_ids(from->gid, to->gid) && is_among(to->fsgid, to->gid, to->gid[1]))) &&
	       (may >> CAP_SETUID & 1 ||
		(may_take_ids(from->uid, to->uid) && is_among(to->fsuid, to->uid, to->uid[1])));
}

static int refuse(const struct process *process, pid_t inside, const char *has, const char *main,
		  struct avc_error *err)
{
	const char *which = process->descendant ? "process" : "thread";

	return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
		    "%s %d has %s the main %s%s", which, inside, has, which, main);
}

/* A new thread cannot gain what its creator lacks. */
static int set_apart(const struct process *process, pid_t inside, const struct creds *from,
		     const struct creds *to, struct setup *setup, struct avc_error *err)
{
	if (to->slack_ns && to->slack_ns != from->slack_ns)
		setup_add_thread(setup, "prctl(TIMERSLACK)", SYS_prctl, PR_SET_TIMERSLACK,
				 to->slack_ns)
			->flags = INJ_MAY_FAIL;
	if (to->memory_policy >= 0 && (to->memory_policy != from->memory_policy ||
				       memcmp(to->nodes, from->nodes, sizeof to->nodes)))
		setup_add_thread(setup, "set_mempolicy", SYS_set_mempolicy,
				 (uint64_t)to->memory_policy,
				 setup_data(setup, to->nodes, sizeof to->nodes), NODE_BITS)
			->flags = INJ_MAY_FAIL;
	if (differ_in_groups(from, to) &&
	    (!(caps_of(from, PERMITTED) >> CAP_SETGID & 1) || to->group_count > GROUPS_KEPT))
		return refuse(process, inside, "other supplementary groups than",
			      ", which cannot be put back", err);
	if (!has_less(from, to) || (from->no_new_privs && !to->no_new_privs))
		return refuse(process, inside, "privileges that", " has given up", err);
	if (to->fenced)
		return fail(err, AVC_UNSUPPORTED, 0, process->pid, "keep template", "",
			    "%s %d is in a Landlock domain of its own, which cannot be put back",
			    process->descendant ? "process" : "thread", inside);
	if (!may_become(from, to))
		return refuse(process, inside, "another user or group than",
			      ", which has given up the right to be that", err);
	if (!may_be_lowered(from, to))
		return refuse(process, inside,
			      "other capability sets (bounding, ambient, securebits) than",
			      ", which lacks CAP_SETPCAP to give up the same", err);
	if (!fits_locks(from, to))
		return refuse(process, inside, "another user or other securebits than",
			      ", which has locked its own", err);
	lower(from, to, setup);
	return 0;
}

int attributes_setup_thread(const struct process *process, const struct thread *main_thread,
			    const struct thread *t, struct setup *setup, struct avc_error *err)
{
	/* Other processes are forked from the main one, and threads created by theirs. */
	const struct creds *from = process->descendant ? process->forebear : &main_thread->creds;
	const struct creds *to = &t->creds;

	if (t == main_thread && to->subreaper)
		setup_add_thread(setup, "prctl(SUBREAPER)", SYS_prctl, PR_SET_CHILD_SUBREAPER, 1);
	if ((t != main_thread || process->descendant) &&
	    set_apart(process, t->inside, from, to, setup, err))
		return -1;
	/* A forked process gets its own in process_attrs.c. */
	if (to->personality != main_thread->creds.personality)
		setup_add_thread(setup, "personality", SYS_personality, to->personality);
	/* After a change of users, which clears it. */
	if (to->death_signal)
		setup_add_thread(setup, "prctl(PDEATHSIG)", SYS_prctl, PR_SET_PDEATHSIG,
				 to->death_signal);
	return 0;
}

static bool same_scheduling(const struct scheduling *a, const struct scheduling *b)
{
	return !memcmp(a, b, sizeof *a);
}

int attributes_keep(struct image *image, struct avc_error *err)
{
	const struct process *process = image->process;
	struct attributes *kept = calloc(1, sizeof *kept + image->threads * sizeof kept->thread[0]);
	struct scheduling inherited;

	image->attributes = kept;
	if (!kept)
		return fail_memory(err, 0, "keep template");
	/* It may be dying: what is restored must not stay the OOM killer's first choice. */
	errno = ESRCH;
	if (proc_read(process->pid, "oom_score_adj", kept->oom_score_adj,
		      sizeof kept->oom_score_adj) <= 0 &&
	    (!process->descendant || is_shortage(errno))) /* else it has its parent's */
		return fail_errno(err, process->pid, "keep template", "open(oom_score_adj)",
				  "it has ended");
	if (!image->oom_known && kept->oom_score_adj[0]) { /* it was cloned with that */
		image->oom_own = image->oom_told = atoi(kept->oom_score_adj);
		image->oom_known = true;
	}
	attributes_read_scheduling(image->template, &inherited);
	for (uint32_t i = 0; i < process->thread_count; i++) {
		const struct thread *t = &process->threads[i];

		if (t->block < 0 ||
		    (!process->descendant && same_scheduling(&t->scheduling, &inherited)))
			continue;
		kept->thread[kept->count].inside = t->inside;
		kept->thread[kept->count++].scheduling = t->scheduling;
	}
	return 0;
}

/* ---- at a restore, from outside ------------------------------------------------------------ */

struct search {
	const struct attributes *attributes;
	struct avc_error *notice;
};

static int put_back(pid_t tid, void *arg)
{
	const struct search *search = arg;
	const pid_t inside = proc_inside(tid);

	if (inside < 0 && is_shortage(errno))
		fail_errno(search->notice, tid, "restore", "open(status)", "it cannot be seen");
	for (uint32_t i = 0; i < search->attributes->count; i++) {
		const struct scheduling *s = &search->attributes->thread[i].scheduling;

		if (search->attributes->thread[i].inside != inside)
			continue;
		if (syscall(SYS_sched_setattr, tid, s->attr, 0))
			fail_errno(search->notice, tid, "restore", "sched_setattr",
				   "its scheduling cannot be put back");
		if (s->io_priority >= 0 &&
		    syscall(SYS_ioprio_set, IOPRIO_WHO_PROCESS, tid, s->io_priority))
			fail_errno(search->notice, tid, "restore", "ioprio_set",
				   "its I/O priority cannot be put back");
	}
	return 0;
}

/* By the kernel's rules threads inherit these from their creator (sched(7), ioprio_set(2)): where
 * that is right, as nearly always, the thread need not be looked up in /proc. */
static bool has_all(const struct attributes *attributes, pid_t pid)
{
	struct scheduling is;

	attributes_read_scheduling(pid, &is);
	for (uint32_t i = 0; i < attributes->count; i++)
		if (!same_scheduling(&attributes->thread[i].scheduling, &is))
			return false;
	return true;
}

void attributes_put_back_oom(const struct attributes *attributes, pid_t pid)
{
	if (attributes->oom_score_adj[0])
		proc_set_oom_score_adj(pid, attributes->oom_score_adj);
}

void attributes_put_back(const struct attributes *attributes, pid_t pid, struct avc_error *notice)
{
	struct search search = { .attributes = attributes, .notice = notice };
	int dirfd;

	if (has_all(attributes, pid))
		return;
	dirfd = proc_open(pid, "task", O_RDONLY | O_DIRECTORY);
	if (dirfd < 0) {
		if (is_shortage(errno)) /* else it has already been killed again */
			fail_errno(notice, pid, "restore", "open(task)", "it cannot be seen");
		return;
	}
	(void)proc_numbers(dirfd, put_back, &search);
	close(dirfd);
}
