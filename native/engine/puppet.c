/* SPDX-License-Identifier: Apache-2.0
 *
 * A task that a restored process has forked, at rest in a pad: it makes the system calls
 * that it is given, a list at a time, and gets descriptors over a socket.
 *
 * It stops by itself at the end of a list, by a signal to itself that we take away.  To be woken
 * up by it and to stop it then would be two turns instead of one, and turns are most of what a
 * small process costs.  Who dies with us (PTRACE_O_EXITKILL) can be left to such a stop; a holder
 * or a thread of the app's could not.
 */
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>

#include "internal.h"

#define SPARE 8 /* puppet_call() is used for so many in a row at most, puppet_ask() for more */
#define NOT_MADE INT64_MIN

/* The list of calls is where files_restore.c has its own, which is not in use any more;
 * what they refer to is behind it. */
void puppet_enter(struct puppet *puppet, const struct pad *pad, uint32_t slot)
{
	uint8_t *memory = pad_files(pad, slot) + INJ_FILES_BYTES / 2;

	puppet->pad = pad;
	puppet->call = &pad->control->holder;
	puppet->list = (struct inj_syscall *)memory;
	puppet->list_max = INJ_FILES_BYTES / 4 / sizeof *puppet->list;
	puppet->data = memory + INJ_FILES_BYTES / 4;
	puppet->listed = puppet->softs = 0;
}

void puppet_call(struct puppet *puppet, long nr, uint64_t a, uint64_t b, uint64_t c, uint64_t d,
		 uint64_t e, uint64_t f)
{
	if (puppet->listed < puppet->list_max)
		puppet->list[puppet->listed] = (struct inj_syscall){ .nr = nr,
								     .arg = { a, b, c, d, e, f },
								     .result = NOT_MADE };
	puppet->listed++;
}

void puppet_soften(struct puppet *puppet, const char *problem)
{
	if (puppet->softs < PUPPET_SOFTS)
		puppet->soft[puppet->softs++] = (struct soft){ puppet->listed - 1, problem };
}

/* At the end of its list; somebody else may have a signal for it, too. */
static int await_end(const struct puppet *puppet, const struct inj_syscall *last,
		     struct avc_error *err)
{
	for (;;) {
		struct stop stop;
		int signal = 0;

		tracee_watch(&puppet->call->done);
		stop = tracee_wait(puppet->pid, 0);
		tracee_watch(NULL);
		switch (stop.kind) {
		case STOP_SIGNAL:
			if (stop.signal != SIGSTOP)
				signal = stop.signal;
			else if (last->result != NOT_MADE)
				return 0;
			break;
		case STOP_EXIT:
		case STOP_DYING:
			return fail(err, AVC_GONE, 0, puppet->pid, "run injected code", "",
				    "it has ended");
		case STOP_DEADLINE:
			/* Some security modules let nobody send signals (LSM, task_kill). */
			if (__atomic_load_n(&puppet->call->done, __ATOMIC_ACQUIRE))
				return pad_finish(puppet->pid, puppet->call, err);
			return fail(err, AVC_DEADLINE, 0, puppet->pid, "run injected code", "",
				    "the task did not get to run in time");
		default:
			break;
		}
		if (ptrace(PTRACE_CONT, puppet->pid, NULL, (long)signal))
			return fail_errno(err, puppet->pid, "run injected code", "ptrace(CONT)",
					  "it has gone");
	}
}

static int run(struct puppet *puppet, struct avc_error *err)
{
	const uint32_t listed = puppet->listed;
	const uint64_t self = (uint64_t)puppet->inside;

	if (!listed)
		return 0;
	puppet_call(puppet, SYS_tgkill, self, self, SIGSTOP, 0, 0, 0);
	puppet->listed = 0;
	if (listed >= puppet->list_max)
		return fail(err, AVC_UNSUPPORTED, 0, puppet->pid, "restore", "",
			    "there is no room for so many system calls");
	call_begin(puppet->call, INJ_AFTER_PARK);
	call_add(puppet->call, INJ_LIST, pad_remote(puppet->pad, puppet->list), listed + 1, 0, 0,
		 0);
	return pad_send(puppet->pad, puppet->pid, &puppet->base, puppet->call, err) ||
			       pad_start(puppet->pid, err) ||
			       await_end(puppet, &puppet->list[listed - 1], err)
		       ? -1
		       : 0;
}

static const char *name_of(long nr)
{
	static const struct {
		long nr;
		const char *name;
	} names[] = {
		{ SYS_mmap, "mmap" },
		{ SYS_munmap, "munmap" },
		{ SYS_mprotect, "mprotect" },
		{ SYS_pkey_mprotect, "pkey_mprotect" },
		{ SYS_mremap, "mremap" },
		{ SYS_madvise, "madvise" },
		{ SYS_recvmsg, "recvmsg" },
		{ SYS_dup3, "dup3" },
		{ SYS_fcntl, "fcntl" },
		{ SYS_fchdir, "fchdir" },
		{ SYS_rt_sigaction, "rt_sigaction" },
		{ SYS_prctl, "prctl" },
		{ SYS_setsid, "setsid" },
		{ SYS_setpgid, "setpgid" },
		{ SYS_ioctl, "ioctl" },
		{ SYS_socketpair, "socketpair" },
		{ SYS_chroot, "chroot" },
		{ SYS_membarrier, "membarrier" },
		{ SYS_shmat, "shmat" },
	};

	for (size_t i = 0; i < sizeof names / sizeof *names; i++)
		if (names[i].nr == nr)
			return names[i].name;
	return "";
}

static const struct soft *soft_of(const struct puppet *puppet, uint32_t index)
{
	for (uint32_t i = 0; i < puppet->softs; i++)
		if (puppet->soft[i].index == index)
			return &puppet->soft[i];
	return NULL;
}

int puppet_flush(struct puppet *puppet, struct avc_error *err)
{
	const uint32_t listed = puppet->listed;
	int result = run(puppet, err);

	for (uint32_t i = 0; !result && i < listed; i++) {
		const struct inj_syscall *s = &puppet->list[i];
		const struct soft *soft;

		if (s->result >= 0 || s->result <= -4096)
			continue;
		soft = soft_of(puppet, i);
		if (!soft)
			result = fail(err, AVC_KERNEL, (int)-s->result, puppet->pid, "restore",
				      name_of(s->nr), "call %u of %u at %lx", i + 1, listed,
				      (unsigned long)s->arg[0]);
		else if (soft->problem)
			fail(puppet->notes, AVC_KERNEL, (int)-s->result, puppet->inside, "restore",
			     name_of(s->nr), "%s", soft->problem);
	}
	puppet->softs = 0;
	return result;
}

/* One of any number; those before it are made when there is no more room. */
int puppet_ask(struct puppet *puppet, long nr, uint64_t a, uint64_t b, uint64_t c, uint64_t d,
	       uint64_t e, uint64_t f, struct avc_error *err)
{
	if (puppet->listed + SPARE > puppet->list_max && puppet_flush(puppet, err))
		return -1;
	puppet_call(puppet, nr, a, b, c, d, e, f);
	return 0;
}

/* A little room for arguments, until the next flush. */
void *puppet_data(const struct puppet *puppet, avc_remote *remote)
{
	void *data = puppet->call->out;

	*remote = pad_remote(puppet->pad, data);
	return data;
}

static avc_remote write_letter(const struct puppet *puppet)
{
	avc_remote remote;
	struct files_letter *letter = puppet_data(puppet, &remote);

	_Static_assert(sizeof *letter <= sizeof puppet->call->out, "room for a letter");
	files_letter_write(letter, remote);
	return remote;
}

static int fetch(const struct puppet *puppet, int fd, struct avc_error *err)
{
	int pidfd = proc_pidfd_open(puppet->pid);
	const int ours = pidfd < 0 ? -1 : files_borrow(pidfd, fd);

	close_fd(&pidfd);
	if (ours < 0)
		fail_errno(err, puppet->pid, "restore", "pidfd_getfd", "it was killed");
	return ours;
}

/* Everything its parent had open is closed; descriptor 0 is a socket of which we have the
 * other end. */
int puppet_open_mail(struct puppet *puppet, const struct mail *mail, struct avc_error *err)
{
	avc_remote out;

	if (mail && mail->ours >= 0) {
		if (mail->theirs)
			puppet_call(puppet, SYS_dup3, (uint64_t)mail->theirs, 0, O_CLOEXEC, 0, 0,
				    0);
		puppet_call(puppet, SYS_close_range, 1, ~0u, 0, 0, 0, 0);
		puppet->socket = fcntl(mail->ours, F_DUPFD_CLOEXEC, 3);
		return puppet->socket < 0 ? fail_errno(err, puppet->pid, "restore", "fcntl",
						       "no descriptor is left for its socket")
					  : 0;
	}
	(void)puppet_data(puppet, &out);
	puppet_call(puppet, SYS_close_range, 0, ~0u, 0, 0, 0, 0);
	puppet_call(puppet, SYS_socketpair, AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, out, 0, 0);
	if (puppet_flush(puppet, err))
		return -1;
	puppet->socket = fetch(puppet, 1, err);
	puppet_call(puppet, SYS_close, 1, 0, 0, 0, 0, 0);
	return puppet->socket < 0 ? -1 : 0;
}

int puppet_share_mail(struct puppet *puppet, struct mail *mail, struct avc_error *err)
{
	avc_remote out;
	const int *ends = puppet_data(puppet, &out);

	puppet_call(puppet, SYS_socketpair, AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, out, 0, 0);
	puppet_soften(puppet, NULL);
	if (puppet_flush(puppet, err))
		return -1;
	if (puppet->list[0].result)
		return 0;
	mail->theirs = ends[0];
	mail->ours = fetch(puppet, ends[1], err);
	puppet_call(puppet, SYS_close, (uint64_t)ends[1], 0, 0, 0, 0, 0);
	return mail->ours < 0 || puppet_flush(puppet, err) ? -1 : 0;
}

int puppet_unshare_mail(struct puppet *puppet, struct mail *mail, struct avc_error *err)
{
	if (mail->ours < 0)
		return 0;
	close_fd(&mail->ours);
	puppet_call(puppet, SYS_close, (uint64_t)mail->theirs, 0, 0, 0, 0, 0);
	return puppet_flush(puppet, err);
}

/* It comes to the lowest number that is free, by the socket that has number `socket` there. */
static int hand_over(struct puppet *puppet, int socket, int fd, struct avc_error *err)
{
	/* What is not received yet waits in the socket. */
	if (files_send(puppet->socket, fd) &&
	    (errno != EAGAIN || puppet_flush(puppet, err) || files_send(puppet->socket, fd)))
		return fail_errno(err, puppet->pid, "restore", "sendmsg",
				  "a descriptor could not be handed over");
	return puppet_ask(puppet, SYS_recvmsg, (uint64_t)socket, write_letter(puppet),
			  MSG_CMSG_CLOEXEC | MSG_DONTWAIT, 0, 0, 0, err);
}

int puppet_give(struct puppet *puppet, int fd, struct avc_error *err)
{
	return hand_over(puppet, 0, fd, err);
}

/* From its parent's pad into its own. */
int puppet_change_pad(struct puppet *puppet, const struct target *target, uint32_t slot,
		      struct avc_error *err)
{
	const struct pad *pad = &target->pad;

	if (puppet_give(puppet, pad->fd, err))
		return -1;
	puppet_call(puppet, SYS_mmap, pad->base, INJ_CODE_BYTES, PAD_CODE_PROT, PAD_FLAGS, 1, 0);
	puppet_call(puppet, SYS_mmap, pad->base + INJ_CODE_BYTES, pad->bytes - INJ_CODE_BYTES,
		    PAD_DATA_PROT, PAD_FLAGS, 1, INJ_CODE_BYTES);
	puppet_call(puppet, SYS_close, 1, 0, 0, 0, 0, 0);
	if (puppet_flush(puppet, err))
		return -1;
	puppet_enter(puppet, pad, slot);
	return 0;
}

/* In order; what is received comes to the lowest number that is free.  The last of the calls
 * are made with what comes next. */
int puppet_put_files(struct puppet *puppet, const struct files_table *table, struct avc_error *err)
{
	int socket = 0, lowest = 0;

	/* Out of the way, between or behind those that are wanted. */
	for (uint32_t i = 0; i < table->count; i++)
		socket += table->entry[i].fd == socket;
	if (socket) {
		puppet_call(puppet, SYS_fcntl, 0, F_DUPFD_CLOEXEC, (uint64_t)socket, 0, 0, 0);
		puppet_call(puppet, SYS_close, 0, 0, 0, 0, 0, 0);
	}
	for (uint32_t i = 0, placed = 0; i < table->count; i++) {
		const int fd = table->entry[i].fd;

		/* The lowest number that is free; of those that are taken `placed` is the
		 * first that is not below it. */
		for (;; lowest++) {
			while (placed < i && table->entry[placed].fd < lowest)
				placed++;
			if (lowest != socket && !(placed < i && table->entry[placed].fd == lowest))
				break;
		}
		if (hand_over(puppet, socket, table->entry[i].ours, err))
			return -1;
		if (lowest != fd) {
			puppet_call(puppet, SYS_dup3, (uint64_t)lowest, (uint64_t)fd,
				    table->entry[i].cloexec ? O_CLOEXEC : 0, 0, 0, 0);
			puppet_call(puppet, SYS_close, (uint64_t)lowest, 0, 0, 0, 0, 0);
		} else if (!table->entry[i].cloexec) {
			puppet_call(puppet, SYS_fcntl, (uint64_t)fd, F_SETFD, 0, 0, 0, 0);
		}
	}
	puppet_call(puppet, SYS_close, (uint64_t)socket, 0, 0, 0, 0, 0);
	return 0;
}
