/* SPDX-License-Identifier: Apache-2.0
 *
 * A task that a restored process has forked, stopped in a parasite: it makes the system calls that
 * it is given, a batch at a time, and gets descriptors over a socket.
 *
 * It stops by itself at the end of a batch, by a signal to itself that we suppress. A wake-up of
 * the guard and then a stop would take two wake-ups instead of one, and wake-ups are most of the
 * cost of a small process. This is only safe for tasks that die with us (PTRACE_O_EXITKILL), not
 * for a holder or a thread of the app.
 */
#include <errno.h>
#include <fcntl.h>
#include <signal.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/wait.h>

#include "trace.h"

#define SPARE \
	8 /* syscall_batch_add() is used for so many in a row at most, syscall_batch_ask() for more */
#define NOT_MADE INT64_MIN

/* The batch uses the memory of files_restore.c's list, which is no longer in use; its arguments
 * follow it. */
void syscall_batch_enter(struct syscall_batch *batch, const struct parasite *parasite,
			 uint32_t slot)
{
	uint8_t *memory = parasite_files(parasite, slot) + INJ_FILES_BYTES / 2;

	batch->parasite = parasite;
	batch->call = &parasite->control->holder;
	batch->list = (struct inj_syscall *)memory;
	batch->list_max = INJ_FILES_BYTES / 4 / sizeof *batch->list;
	batch->data = memory + INJ_FILES_BYTES / 4;
	batch->listed = batch->softs = batch->running = 0;
}

/* Where several children of one process begin, in its parasite, behind data of its own. */
struct bed {
	struct inj_call call;
	struct inj_syscall list[];
};
#define BED_BYTES (16u << 10)
_Static_assert((BATCH_BEDS + 1) * BED_BYTES <= INJ_FILES_BYTES / 4, "room for all beds");

void syscall_batch_lie_down(struct syscall_batch *batch, uint32_t bed)
{
	struct bed *place = (struct bed *)(batch->data + (bed + 1) * BED_BYTES);

	batch->call = &place->call;
	batch->list = place->list;
	batch->list_max = (BED_BYTES - sizeof *place) / sizeof *batch->list;
	batch->listed = batch->softs = batch->running = 0;
}

void syscall_batch_append(struct syscall_batch *batch, long nr, const uint64_t arg[6])
{
	struct inj_syscall *call;

	if (batch->listed++ >= batch->list_max)
		return;
	call = &batch->list[batch->listed - 1];
	*call = (struct inj_syscall){ .nr = nr, .result = NOT_MADE };
	memcpy(call->arg, arg, sizeof call->arg);
}

void syscall_batch_soften(struct syscall_batch *batch, const char *problem)
{
	if (batch->softs < BATCH_SOFTS)
		batch->soft[batch->softs++] = (struct soft){ batch->listed - 1, problem };
}

/* Its own SIGSTOP has done its work: it must not be reported again (tracee_wait). */
static int taken(pid_t pid)
{
	(void)waitpid(pid, NULL, __WALL | __WNOTHREAD | WNOHANG);
	return 0;
}

/* At the end of its batch; it may have got a signal from another process, too. */
static int await_end(const struct syscall_batch *batch, const struct inj_syscall *last,
		     struct avc_error *err)
{
	for (;;) {
		struct stop stop;
		int signal = 0;

		tracee_watch(&batch->call->done);
		stop = tracee_wait(batch->pid, 0);
		tracee_watch(NULL);
		switch (stop.kind) {
		case STOP_SIGNAL:
			if (stop.signal != SIGSTOP)
				signal = stop.signal;
			else if (last->result != NOT_MADE)
				return taken(batch->pid);
			break;
		case STOP_EXIT:
		case STOP_DYING:
			return fail(err, AVC_GONE, 0, batch->pid, "run injected code", "",
				    "it has ended");
		case STOP_DEADLINE:
			/* Some security modules deny sending signals (LSM, task_kill). */
			if (__atomic_load_n(&batch->call->done, __ATOMIC_ACQUIRE))
				return parasite_finish(batch->pid, batch->call, err);
			return fail(err, AVC_DEADLINE, 0, batch->pid, "run injected code", "",
				    "the task did not get to run in time");
		default:
			break;
		}
		if (stop.kind == STOP_SIGNAL && !signal)
			stop.kind = STOP_OTHER;
		if (seccomp_go_on(batch->pid, &stop))
			return fail_errno(err, batch->pid, "run injected code", "ptrace(CONT)",
					  "it has gone");
	}
}

/* It is not supervised, whatever filters its process had: it has only those of the main one, which
 * allow its calls, and gets others when nothing is left to be done. */
int syscall_batch_send(const struct syscall_batch *batch, struct inj_call *call,
		       struct avc_error *err)
{
	if (parasite_send(batch->parasite, batch->pid, &batch->base, call, err))
		return -1;
	seccomp_end_supervision(batch->pid);
	return 0;
}

int syscall_batch_start(struct syscall_batch *batch, struct avc_error *err)
{
	const uint32_t listed = batch->listed;
	const uint64_t self = (uint64_t)batch->inside;

	if (!listed)
		return 0;
	syscall_batch_add(batch, SYS_tgkill, self, self, SIGSTOP);
	batch->listed = 0;
	if (listed >= batch->list_max)
		return fail(err, AVC_UNSUPPORTED, 0, batch->pid, "restore", "",
			    "there is no room for so many system calls");
	call_begin(batch->call, INJ_AFTER_PARK);
	call_add(batch->call, INJ_LIST, parasite_remote(batch->parasite, batch->list), listed + 1);
	if (syscall_batch_send(batch, batch->call, err) || parasite_start(batch->pid, err))
		return -1;
	batch->running = listed;
	return 0;
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

static const struct soft *soft_of(const struct syscall_batch *batch, uint32_t index)
{
	for (uint32_t i = 0; i < batch->softs; i++)
		if (batch->soft[i].index == index)
			return &batch->soft[i];
	return NULL;
}

int syscall_batch_await(struct syscall_batch *batch, struct avc_error *err)
{
	const uint32_t listed = batch->running;
	int result = listed ? await_end(batch, &batch->list[listed - 1], err) : 0;

	batch->running = 0;
	for (uint32_t i = 0; !result && i < listed; i++) {
		const struct inj_syscall *s = &batch->list[i];
		const struct soft *soft;

		if (s->result >= 0 || s->result <= -4096)
			continue;
		soft = soft_of(batch, i);
		if (!soft)
			result = fail(err, AVC_KERNEL, (int)-s->result, batch->pid, "restore",
				      name_of(s->nr), "call %u of %u at %lx", i + 1, listed,
				      (unsigned long)s->arg[0]);
		else if (soft->problem)
			fail(batch->notes, AVC_KERNEL, (int)-s->result, batch->inside, "restore",
			     name_of(s->nr), "%s", soft->problem);
	}
	batch->softs = 0;
	return result;
}

int syscall_batch_flush(struct syscall_batch *batch, struct avc_error *err)
{
	return syscall_batch_start(batch, err) || syscall_batch_await(batch, err) ? -1 : 0;
}

/* One of any number; earlier ones are flushed when there is no more room. */
int syscall_batch_append_any(struct syscall_batch *batch, struct avc_error *err, long nr,
			     const uint64_t arg[6])
{
	if (batch->listed + SPARE > batch->list_max && syscall_batch_flush(batch, err))
		return -1;
	syscall_batch_append(batch, nr, arg);
	return 0;
}

/* A little room for arguments, until the next flush. */
void *syscall_batch_data(const struct syscall_batch *batch, avc_remote *remote)
{
	void *data = batch->call->out;

	*remote = parasite_remote(batch->parasite, data);
	return data;
}

static avc_remote write_letter(const struct syscall_batch *batch)
{
	avc_remote remote;
	struct fd_letter *letter = syscall_batch_data(batch, &remote);

	_Static_assert(sizeof *letter <= sizeof batch->call->out, "room for a letter");
	fd_letter_write(letter, remote);
	return remote;
}

static int fetch(const struct syscall_batch *batch, int fd, struct avc_error *err)
{
	int pidfd = proc_pidfd_open(batch->pid);
	const int ours = pidfd < 0 ? -1 : proc_borrow_fd(pidfd, fd);

	close_fd(&pidfd);
	if (ours < 0)
		fail_errno(err, batch->pid, "restore", "pidfd_getfd", "it was killed");
	return ours;
}

/* Closes the gaps between those that are kept. */
static int close_others(struct syscall_batch *batch, uint64_t first, const struct fd_table *table,
			struct avc_error *err)
{
	for (uint32_t i = 0; i < table->count; i++) {
		const uint64_t fd = (uint64_t)table->entry[i].fd;

		if (table->entry[i].ours >= 0)
			continue;
		if (first < fd && syscall_batch_ask(batch, err, SYS_close_range, first, fd - 1))
			return -1;
		first = fd + 1;
	}
	return syscall_batch_ask(batch, err, SYS_close_range, first, ~0u);
}

/* A socket whose other end is ours; closes that there, too. */
int syscall_batch_make_fd_channel(struct syscall_batch *batch, struct avc_error *err)
{
	avc_remote out;
	const int *ends = syscall_batch_data(batch, &out);

	syscall_batch_add(batch, SYS_socketpair, AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, out);
	if (syscall_batch_flush(batch, err))
		return -1;
	/* The lowest free number is that of the other end, then. */
	batch->theirs = ends[0];
	batch->given = ends[1];
	batch->socket = fetch(batch, batch->given, err);
	syscall_batch_add(batch, SYS_close, (uint64_t)batch->given);
	return batch->socket < 0 ? -1 : 0;
}

void syscall_batch_close_fd_channel(struct syscall_batch *batch)
{
	syscall_batch_add(batch, SYS_close, (uint64_t)batch->theirs);
}

int syscall_batch_open_fd_channel(struct syscall_batch *batch, struct fd_channel *inherited,
				  const struct fd_table *table, struct avc_error *err)
{
	if (inherited->ours >= 0) {
		batch->theirs = 0;
		batch->given = 1;
		batch->socket = inherited->ours;
		inherited->ours = -1;
		if (inherited->theirs)
			syscall_batch_add(batch, SYS_dup3, (uint64_t)inherited->theirs, 0,
					  O_CLOEXEC);
		return close_others(batch, 1, table, err);
	}
	return close_others(batch, 0, table, err) || syscall_batch_make_fd_channel(batch, err) ? -1
											       : 0;
}

int syscall_batch_share_fd_channel(struct syscall_batch *batch, struct fd_channel *fd_channel,
				   struct avc_error *err)
{
	avc_remote out;
	const int *ends = syscall_batch_data(batch, &out);

	syscall_batch_add(batch, SYS_socketpair, AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, out);
	syscall_batch_soften(batch, NULL);
	if (syscall_batch_flush(batch, err))
		return -1;
	if (batch->list[0].result)
		return 0;
	fd_channel->theirs = ends[0];
	fd_channel->ours = fetch(batch, ends[1], err);
	syscall_batch_add(batch, SYS_close, (uint64_t)ends[1]);
	return fd_channel->ours < 0 || syscall_batch_flush(batch, err) ? -1 : 0;
}

void syscall_batch_pass_socket(const struct fd_channel *fd_channel, const struct parasite *parasite,
			       struct inj_call *call, struct fd_channel *passed)
{
	struct fd_letter *letter = (struct fd_letter *)call->out;
	int ends[2];

	*passed = (struct fd_channel){ -1, -1 };
	if (fd_channel->ours < 0 ||
	    got_fd(socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends)))
		return;
	if (fd_send(fd_channel->ours, ends[1]) == 0) {
		const avc_remote remote = parasite_remote(parasite, letter);

		fd_letter_write(letter, remote);
		call_add(call, SYS_recvmsg, (uint64_t)fd_channel->theirs, remote,
			 MSG_CMSG_CLOEXEC | MSG_DONTWAIT);
		passed->ours = ends[0];
	} else {
		close(ends[0]);
	}
	close(ends[1]);
}

void syscall_batch_note_passed(const struct inj_call *call, struct fd_channel *passed)
{
	if (passed->ours < 0)
		return;
	passed->theirs = fd_letter_number((const struct fd_letter *)call->out);
	if (passed->theirs < 0)
		close_fd(&passed->ours); /* it has no number left for one more */
}

int syscall_batch_unshare_fd_channel(struct syscall_batch *batch, struct fd_channel *fd_channel,
				     struct avc_error *err)
{
	if (fd_channel->ours < 0)
		return 0;
	close_fd(&fd_channel->ours);
	syscall_batch_add(batch, SYS_close, (uint64_t)fd_channel->theirs);
	return syscall_batch_flush(batch, err);
}

/* It gets the lowest free number, over the socket that has number `socket` there. */
static int hand_over(struct syscall_batch *batch, int socket, int fd, struct avc_error *err)
{
	/* Descriptors not yet received wait in the socket. */
	if (fd_send(batch->socket, fd) &&
	    (errno != EAGAIN || syscall_batch_flush(batch, err) || fd_send(batch->socket, fd)))
		return fail_errno(err, batch->pid, "restore", "sendmsg",
				  "a descriptor could not be handed over");
	return syscall_batch_ask(batch, err, SYS_recvmsg, (uint64_t)socket, write_letter(batch),
				 MSG_CMSG_CLOEXEC | MSG_DONTWAIT);
}

int syscall_batch_give(struct syscall_batch *batch, int fd, struct avc_error *err)
{
	return hand_over(batch, batch->theirs, fd, err);
}

int syscall_batch_map_parasite(struct syscall_batch *batch, const struct parasite *parasite,
			       struct avc_error *err)
{
	if (syscall_batch_give(batch, parasite->code_fd, err))
		return -1;
	syscall_batch_add(batch, SYS_mmap, parasite->base, INJ_CODE_BYTES, PARASITE_CODE_PROT,
			  PARASITE_FLAGS, (uint64_t)batch->given);
	syscall_batch_add(batch, SYS_close, (uint64_t)batch->given);
	if (syscall_batch_give(batch, parasite->data_fd, err))
		return -1;
	syscall_batch_add(batch, SYS_mmap, parasite->base + INJ_CODE_BYTES,
			  parasite->bytes - INJ_CODE_BYTES, PARASITE_DATA_PROT, PARASITE_FLAGS,
			  (uint64_t)batch->given);
	syscall_batch_add(batch, SYS_close, (uint64_t)batch->given);
	return 0;
}

/* In order, because received descriptors get the lowest free number. The last calls are flushed
 * with the next batch. */
int syscall_batch_put_files(struct syscall_batch *batch, const struct fd_table *table,
			    struct avc_error *err)
{
	int socket = 0, lowest = 0;

	/* Moved to a number that is not wanted. */
	for (uint32_t i = 0; i < table->count; i++)
		socket += table->entry[i].fd == socket;
	if (socket) {
		syscall_batch_add(batch, SYS_fcntl, 0, F_DUPFD_CLOEXEC, (uint64_t)socket);
		syscall_batch_add(batch, SYS_close);
	}
	for (uint32_t i = 0, at = 0; i < table->count; i++) {
		const int fd = table->entry[i].fd;

		if (table->entry[i].ours < 0) {
			if (table->entry[i].changed &&
			    syscall_batch_ask(batch, err, SYS_fcntl, (uint64_t)fd, F_SETFD,
					      table->entry[i].cloexec ? FD_CLOEXEC : 0))
				return -1;
			continue;
		}
		/* The lowest free number: neither an earlier one nor a kept one. */
		for (;; lowest++) {
			while (at < table->count && table->entry[at].fd < lowest)
				at++;
			if (lowest != socket &&
			    !(at < table->count && table->entry[at].fd == lowest &&
			      (at < i || table->entry[at].ours < 0)))
				break;
		}
		if (hand_over(batch, socket, table->entry[i].ours, err))
			return -1;
		if (lowest != fd) {
			syscall_batch_add(batch, SYS_dup3, (uint64_t)lowest, (uint64_t)fd,
					  table->entry[i].cloexec ? O_CLOEXEC : 0);
			syscall_batch_add(batch, SYS_close, (uint64_t)lowest);
		} else if (!table->entry[i].cloexec) {
			syscall_batch_add(batch, SYS_fcntl, (uint64_t)fd, F_SETFD);
		}
	}
	syscall_batch_add(batch, SYS_close, (uint64_t)socket);
	return 0;
}
