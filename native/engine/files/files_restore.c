/* SPDX-License-Identifier: Apache-2.0
 *
 * Restores the descriptor table of the checkpoint (files.h).
 *
 * The dead app's table lives on in its template and its holder.  The engine gets or recreates what
 * is missing, and the template, by injected calls, receives it over a socket and moves it to its
 * number: no other task with this table runs meanwhile.  What depends on the process (epoll and
 * signalfd, owners, POSIX locks) is left to the restored process itself, as a list of calls in its
 * slot.
 *
 * Only the main process gets this table.  The others are forked by their parents and get new
 * tables, from what is collected here (files_work_table()): in the old one, which the holder has,
 * only new descriptors are closed, until all processes exist.
 */
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/ioctl.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <termios.h>
#include <unistd.h>

#include "files.h"

#define NAME_SHOWN 48

void files_note(struct files_work *work, const struct file *f, const char *problem)
{
	if (!problem)
		return;
	if (!work->problems++) {
		const size_t bytes = strlen(f->name);
		const bool cut = bytes > NAME_SHOWN;

		fail(work->notes, AVC_UNSUPPORTED, 0, work->process->inside, "restore descriptors",
		     "", "descriptor %d (%s%s): %s", f->fd, cut ? "..." : "",
		     f->name + (cut ? bytes - NAME_SHOWN : 0), problem);
	}
}

uint32_t files_index(const struct files *files, const struct file *f)
{
	return (uint32_t)(f - files->file);
}

/* Index of the first descriptor of the same open file description. */
uint32_t files_leader(const struct files *files, const struct file *f)
{
	const struct file *l = files_find(files, f->shared);

	return files_index(files, l ? l : f);
}

/* ---- what stays, and where the rest comes from ---------------------------------- */

/* By number: the first one claims the open file description. */
static void find_staying(struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i], *n = files_find(work->now, w->fd);
		const uint32_t group = files_leader(work->want, w);
		uint32_t description;

		work->lost[i] = true;
		if (!n || !files_same_object(w, n))
			continue;
		description = files_leader(work->now, n);
		if (work->claimed_by[description] < 0 && work->source[group] < 0) {
			work->claimed_by[description] = (int)group;
			work->source[group] = (int)description;
		}
		work->lost[i] = work->source[group] != (int)description;
	}
}

/* A pair with a closed end is broken: both ends are recreated. */
static void break_pairs(struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];
		const struct file *other;

		if (w->kind != FILE_SOCKET || work->source[files_leader(work->want, w)] >= 0)
			continue;
		other = files_other_end(work->want, w);
		if (other)
			work->source[files_leader(work->want, other)] = -1;
	}
	for (uint32_t i = 0; i < work->want->count; i++)
		if (work->source[files_leader(work->want, &work->want->file[i])] < 0)
			work->lost[i] = true;
}

/* A terminal whose session's leader has died is hung up: what was open of it stays dead
 * (drivers/tty/tty_io.c, __tty_hangup()), and has to be opened again. */
static bool is_hung_up(int fd, const struct file *w)
{
	struct termios settings;

	(void)w;
	return tcgetattr(fd, &settings) && errno == EIO;
}

static bool has_the_last(const struct file *w)
{
	return w->kind == FILE_SOCKET && w->ended && w->content;
}

/* What was read since from a socket without a peer cannot be sent again. */
static bool was_read(int fd, const struct file *w)
{
	int bytes = 0;

	return ioctl(fd, FIONREAD, &bytes) || (uint32_t)bytes != w->content_bytes;
}

static bool has_node(const struct file *w)
{
	return w->socket && w->socket->node;
}

/* A Unix socket whose file was deleted since cannot be reached: a recreated one has a file. */
static bool is_deleted(int fd, const struct file *w)
{
	return file_unix_is_deleted(fd, w->socket);
}

static bool was_idle(const struct file *w)
{
	return w->socket && w->socket->idle;
}

/* A restored process repeats its bind(2) or connect(2), and the kernel refuses the second one
 * (EINVAL, EISCONN). */
static bool was_used(int fd, const struct file *w)
{
	return file_socket_was_used(fd, w->socket);
}

static bool was_connecting(const struct file *w)
{
	return w->socket && w->socket->connecting;
}

static bool has_connected(int fd, const struct file *w)
{
	return !file_is_connecting(fd, w->socket);
}

static bool is_semaphore(const struct file *w)
{
	return w->kind == FILE_EVENTFD && w->semaphore;
}

/* Each read(2) decrements it by one. */
static bool counts_too_much(int fd, const struct file *w)
{
	const uint64_t count = file_count(fd);

	return count > w->count && count - w->count > FILE_COUNT_READS;
}

/* It still exists, but is useless: a new one is made. */
static void give_up_useless(struct files_work *work)
{
	static const struct {
		bool (*concerns)(const struct file *w);
		bool (*is_useless)(int fd, const struct file *w);
	} doubts[] = {
		{ is_semaphore, counts_too_much },
		{ file_is_pts, is_hung_up },
		{ has_the_last, was_read },
		{ has_node, is_deleted },
		{ was_idle, was_used },
		{ was_connecting, has_connected },
	};

	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];

		for (size_t k = 0; k < sizeof doubts / sizeof *doubts; k++) {
			int fd = -1;

			if (work->source[i] >= 0 && doubts[k].concerns(w))
				fd = proc_borrow_fd(work->table_pidfd,
						    work->now->file[work->source[i]].fd);
			if (fd >= 0 && doubts[k].is_useless(fd, w))
				work->source[i] = -1;
			close_fd(&fd);
		}
	}
}

/* The process outside is told at once: other generations have the connection open as well. */
static void cut_strange(struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];
		int fd;

		if (!w->strange || work->source[i] < 0)
			continue;
		fd = proc_borrow_fd(work->table_pidfd, work->now->file[work->source[i]].fd);
		if (fd >= 0)
			shutdown(fd, SHUT_RDWR);
		close_fd(&fd);
		work->source[i] = -1;
	}
}

/* Of a process of the app: it refers to a dead one. */
static void give_up_own(struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];

		if (!w->pid_inside)
			continue;
		work->source[files_leader(work->want, w)] = -1;
		work->lost[i] = true;
	}
}

static bool is_unclaimed(const struct file *n, const void *arg)
{
	const struct files_work *work = arg;
	const uint32_t k = files_index(work->now, n);

	return work->claimed_by[k] < 0 && files_leader(work->now, n) == k;
}

/* Somewhere else in the table, perhaps: the app may have moved it. */
static void find_moved(struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i], *n;

		if (files_leader(work->want, w) != i || work->source[i] >= 0 ||
		    (!(w->mode & S_IFMT) && !w->id))
			continue;
		(void)budget_step();
		n = files_order_take(&work->order, w, is_unclaimed, work);
		if (n) {
			work->source[i] = (int)files_index(work->now, n);
			work->claimed_by[work->source[i]] = (int)i;
		}
	}
}

static void make_pair(struct files_work *work, const struct file *w)
{
	const struct file *other = files_other_end(work->want, w);
	int ends[2];
	uint32_t a, b;

	if (!other)
		return;
	a = files_leader(work->want, w);
	b = files_leader(work->want, other);
	if (a == b || work->local[a] >= 0 || work->local[b] >= 0 || work->source[a] >= 0 ||
	    work->source[b] >= 0 || file_make_pair(w, other, &work->want->rights, ends))
		return;
	work->local[a] = ends[0];
	work->local[b] = ends[1];
}

static const struct file *pipe_in_table(const struct files_work *work, const struct file *w)
{
	return w->kind == FILE_PIPE ? files_order_pipe(&work->order, w->ino) : NULL;
}

/* An end of a pipe of which another end is still open, anywhere in the table. */
static int reopen_pipe(const struct files_work *work, const struct file *w)
{
	const struct file *n = pipe_in_table(work, w);
	char path[48];

	if (!n)
		return -1;
	snprintf(path, sizeof path, "/proc/%d/fd/%d", work->table, n->fd);
	/* With O_NONBLOCK, or it would wait for somebody at the other end. */
	return got_fd(open(path, (w->flags & O_ACCMODE) | O_NONBLOCK | O_CLOEXEC));
}

/* IPv6 has ports of its own. */
static uint32_t port_number(const struct sockaddr_storage *address)
{
	return address_port(address) | (address->ss_family == AF_INET6 ? UINT32_C(1) << 16 : 0);
}

static bool is_listening(const struct file *w)
{
	return w->socket && w->socket->listening &&
	       (w->socket->domain == AF_INET || w->socket->domain == AF_INET6);
}

static bool is_lost_listener(const struct files_work *work, uint32_t i)
{
	const struct file *w = &work->want->file[i];

	return work->lost[i] && !work->kept[i] && is_listening(w) &&
	       work->local[files_leader(work->want, w)] < 0;
}

/* Connections that lost listening sockets had accepted keep their ports, and without SO_REUSEADDR
 * (socket(7)) to themselves. */
static void share_ports(const struct files_work *work)
{
	bool wanted[2 << 16] = { false };
	const int yes = 1;

	for (uint32_t i = 0; i < work->want->count; i++)
		if (is_lost_listener(work, i))
			wanted[port_number(&work->want->file[i].socket->local)] = true;
	for (uint32_t k = 0; k < work->now->count; k++) {
		struct sockaddr_storage address = { 0 };
		socklen_t bytes = sizeof address;
		int fd;

		if (work->now->file[k].kind != FILE_SOCKET)
			continue;
		(void)budget_step();
		fd = proc_borrow_fd(work->table_pidfd, work->now->file[k].fd);
		if (fd >= 0 && getsockname(fd, (struct sockaddr *)&address, &bytes) == 0 &&
		    address_port(&address) && wanted[port_number(&address)])
			setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes);
		close_fd(&fd);
	}
}

/* While it is still somewhere in the table: takes one descriptor of ours for every open file
 * description that has to be restored. */
static void gather(struct files_work *work)
{
	bool any = false;

	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];
		const uint32_t group = files_leader(work->want, w);

		if (!work->lost[i] || work->kept[i] || work->local[group] >= 0)
			continue;
		(void)budget_step();
		if (work->source[group] >= 0)
			work->local[group] = proc_borrow_fd(
				work->table_pidfd, work->now->file[work->source[group]].fd);
		if (work->local[group] < 0)
			work->local[group] = reopen_pipe(work, w);
		any |= is_lost_listener(work, i);
	}
	if (any)
		share_ports(work);
}

/* The rest, after what the app has opened since is closed, and its ports are free. */
static void make_lost(struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		(void)budget_step();
		if (work->lost[i] && !pipe_in_table(work, &work->want->file[i]))
			make_pair(work, &work->want->file[i]);
	}
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];
		const uint32_t group = files_leader(work->want, w);
		const char *why = NULL;

		if (!work->lost[i] || work->kept[i] || work->local[group] >= 0)
			continue;
		(void)budget_step();
		work->local[group] = file_make(w, work->image->template, work->init,
					       &work->want->rights, &why);
		files_note(work, w, why);
		if (work->local[group] < 0)
			files_note(work, w, "it cannot be made again");
	}
}

/* Whether the listed calls have to be made at once: locks of what is to be closed would block
 * others. */
static bool is_urgent(const struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++)
		if (work->lost[i] || work->want->file[i].lock_count)
			return true;
	return false;
}

/* ---- in the table ------------------------------------------------------------------ */

/* After the calls for the restored process (files_calls.c): one message header, then a list. */
static struct fd_letter *letter_of(const struct files_work *work)
{
	return (struct fd_letter *)(parasite_files(&work->process->parasite, work->image->slot) +
				    INJ_FILES_BYTES / 2);
}

static struct inj_syscall *list_of(const struct files_work *work)
{
	return (struct inj_syscall *)(letter_of(work) + 1);
}

#define LISTED_MAX ((INJ_FILES_BYTES / 2 - sizeof(struct fd_letter)) / sizeof(struct inj_syscall))

/* Of the task that has the table. */
static struct inj_call *call_of(const struct files_work *work)
{
	return work->process->descendant
		       ? &work->process->parasite.control->holder
		       : &parasite_slot(&work->process->parasite, work->image->slot)->template_call;
}

/* The list becomes the task's next calls. */
static void close_list(struct files_work *work)
{
	if (work->listed)
		call_add(call_of(work), INJ_LIST,
			 parasite_remote(&work->process->parasite, list_of(work)), work->listed);
	work->listed = 0;
}

/* The results of the last calls. */
static void note_refused(struct files_work *work, uint32_t count)
{
	for (uint32_t i = 0; i < count; i++) {
		const struct inj_syscall *s = &list_of(work)[i];
		const struct file *w = s->nr == SYS_dup3 && s->result < 0
					       ? files_find(work->want, (int)s->arg[1])
					       : NULL;

		if (w)
			files_note(work, w, "it could not be put in its place");
	}
}

/* Has the task begin with its calls. */
static int start_calls(struct files_work *work, struct avc_error *err)
{
	const struct process *process = work->process;
	struct inj_call *call = call_of(work);

	close_list(work);
	if (!call->count)
		return 0;
	work->busy = parasite_send(&process->parasite, work->table,
				   process->descendant ? &process->holder_base : &work->image->base,
				   call, err) == 0 &&
		     parasite_start(work->table, err) == 0;
	return work->busy ? 0 : -1;
}

int files_work_halt(struct files_work *work, struct avc_error *err)
{
	if (!work->busy || parasite_halt(work->table, call_of(work), err) == 0)
		return 0;
	work->busy = false;
	return -1;
}

int files_work_await(struct files_work *work, struct avc_error *err)
{
	const bool stopped = !work->busy || tracee_await(work->table, NULL, err) == STOP_TRAP;

	work->busy = false;
	call_begin(call_of(work), INJ_AFTER_PARK);
	return stopped ? 0 : -1;
}

int files_work_flush(struct files_work *work, struct avc_error *err)
{
	const uint32_t listed = work->listed;
	int result = start_calls(work, err) || files_work_halt(work, err);

	if (files_work_await(work, err))
		result = -1;
	if (!result)
		note_refused(work, listed);
	return result ? -1 : 0;
}

static int inject(struct files_work *work, struct avc_error *err, long nr, uint64_t a, uint64_t b,
		  uint64_t c)
{
	if (work->listed == LISTED_MAX && files_work_flush(work, err))
		return -1;
	list_of(work)[work->listed++] = (struct inj_syscall){ .nr = nr, .arg = { a, b, c } };
	return 0;
}

/* Whether this epoll set watches what it did not watch at the checkpoint. */
static bool is_watched_since(const struct files_work *work, const struct file *want,
			     const struct file_watch *watch)
{
	const struct file *w = files_find(work->want, watch->fd);

	(void)budget_step();
	return !files_find_watch(want, watch) || !w || work->lost[files_index(work->want, w)];
}

/* A set watches a number and an open file description, and drops them when no process has the
 * description open any more (epoll(7), Questions and answers): a process outside of the app may
 * still have it, and where a table is rebuilt the old one stays for a while.  Under the same number
 * another file may then be watched as well.  Only in the table where the two belong together can
 * the entry be removed. */
static int forget_watches(struct files_work *work, struct avc_error *err)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];
		const struct file *n = w->kind == FILE_EPOLL ? files_now_of(work, i) : NULL;

		if (!n || files_leader(work->want, w) != i)
			continue;
		for (uint32_t k = 0; k < n->watch_count; k++)
			if (is_watched_since(work, w, &n->watch[k]) &&
			    inject(work, err, SYS_epoll_ctl, (uint64_t)n->fd, EPOLL_CTL_DEL,
				   (uint64_t)n->watch[k].fd))
				return -1;
	}
	return 0;
}

/* POSIX locks belong to the table (fcntl(2)), and the rebuilt one has to get them. */
static int unlock_all(struct files_work *work, struct avc_error *err)
{
	struct flock *all = (struct flock *)letter_of(work);

	*all = (struct flock){ .l_type = F_UNLCK, .l_whence = SEEK_SET };
	for (uint32_t i = 0; i < work->now->count; i++)
		if (work->now->file[i].lock_count &&
		    inject(work, err, SYS_fcntl, (uint64_t)work->now->file[i].fd, F_SETLK,
			   parasite_remote(&work->process->parasite, all)))
			return -1;
	return 0;
}

/* Nothing, or something else, was there at the checkpoint. */
static bool is_new(const struct files_work *work, const struct file *n)
{
	const struct file *w = files_find(work->want, n->fd);

	return !w || work->lost[files_index(work->want, w)];
}

/* Of numbers below `looked_at` only what claims something (files_late.c). */
static int close_range_of(struct files_work *work, uint64_t first, uint64_t last,
			  uint64_t looked_at, struct avc_error *err)
{
	const uint64_t looked_last = last < looked_at ? last : looked_at - 1;

	if (first > last)
		return 0;
	if (first >= looked_at)
		return inject(work, err, SYS_close_range, first, last, 0);
	return inject(work, err, INJ_CLOSE_CLAIMS, first, looked_last, 0) ||
			       close_range_of(work, looked_last + 1, last, looked_at, err)
		       ? -1
		       : 0;
}

/* Whatever the checkpoint does not have, in ranges: a program may have opened thousands since,
 * which are not read. */
static int close_new(struct files_work *work, struct avc_error *err)
{
	const struct files *now = work->now;
	uint64_t next = 0, looked_at = 0;

	if (!work->table)
		return 0;
	if (work->process->descendant)
		looked_at = files_looked_at(work);
	work->process->late = looked_at > 0;

	for (uint32_t i = 0; i < now->count; i++) {
		const uint64_t fd = (uint64_t)now->file[i].fd;

		work->closed[i] = is_new(work, &now->file[i]);
		if (work->closed[i])
			continue;
		if (fd && close_range_of(work, next, fd - 1, looked_at, err))
			return -1;
		next = fd + 1;
	}
	return close_range_of(work, next, UINT32_MAX, looked_at, err);
}

/* Cheaper to set than to check; and by the template, for which the app's own seccomp filter is
 * suspended. */
static int set_cloexec(struct files_work *work, struct avc_error *err)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];

		if (!work->lost[i] && inject(work, err, SYS_fcntl, (uint64_t)w->fd, F_SETFD,
					     w->cloexec ? FD_CLOEXEC : 0))
			return -1;
	}
	return 0;
}

/* Which numbers are in use, to predict the one that the kernel assigns next. */
struct numbers {
	uint8_t *taken;
	int room;
	int low; /* all below are */
};

/* Room for all that are wanted, and for some more while they are handed over. */
static int numbers_begin(struct numbers *numbers, const struct files_work *work,
			 struct avc_error *err)
{
	const struct files *want = work->want;

	numbers->room = 16 + (want->count ? want->file[want->count - 1].fd : 0);
	numbers->taken = calloc((size_t)numbers->room, 1);
	if (!numbers->taken)
		return fail_memory(err, 0, "restore descriptors");
	for (uint32_t i = 0; i < work->now->count; i++)
		if (!work->closed[i])
			numbers->taken[work->now->file[i].fd] = 1;
	return 0;
}

/* The one that the kernel assigns next. */
static int lowest_free(struct numbers *numbers)
{
	while (numbers->low < numbers->room && numbers->taken[numbers->low])
		numbers->low++;
	return numbers->low < numbers->room ? numbers->low : -1;
}

/* One that nothing of the checkpoint has. */
static int free_beside(const struct numbers *numbers, const struct files *want)
{
	for (int fd = 0; fd < numbers->room; fd++)
		if (!numbers->taken[fd] && !files_find(want, fd))
			return fd;
	return -1;
}

static avc_remote lay_out_letter(const struct files_work *work)
{
	struct fd_letter *letter = letter_of(work);
	const avc_remote remote = parasite_remote(&work->process->parasite, letter);

	fd_letter_write(letter, remote);
	return remote;
}

/* One message header for all: recvmsg(2) leaves it unchanged, because the lengths are equal. */
static int receive(struct files_work *work, struct numbers *numbers, int ours, int theirs,
		   struct avc_error *err)
{
	const avc_remote letter = lay_out_letter(work);

	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];
		const int from = work->local[files_leader(work->want, w)];
		int to;

		if (!work->lost[i] || from < 0)
			continue;
		(void)budget_step();
		to = lowest_free(numbers);
		/* Descriptors not yet received wait in the socket, which holds some hundred. */
		if (fd_send(ours, from) &&
		    (errno != EAGAIN || files_work_flush(work, err) || fd_send(ours, from))) {
			files_note(work, w, "it could not be handed over");
			continue;
		}
		if (inject(work, err, SYS_recvmsg, (uint64_t)theirs, letter,
			   MSG_CMSG_CLOEXEC | MSG_DONTWAIT))
			return -1;
		if (to != w->fd) {
			if (inject(work, err, SYS_dup3, (uint64_t)to, (uint64_t)w->fd,
				   w->cloexec ? O_CLOEXEC : 0) ||
			    inject(work, err, SYS_close, (uint64_t)to, 0, 0))
				return -1;
		} else if (!w->cloexec && inject(work, err, SYS_fcntl, (uint64_t)to, F_SETFD, 0)) {
			return -1;
		}
		numbers->taken[w->fd] = 1;
	}
	return 0;
}

/* A pair of sockets: `ours` here, and `theirs`, a number in their table that is in nobody's way. */
static int begin_handing_over(struct files_work *work, struct numbers *numbers, int *ours,
			      int *theirs, struct avc_error *err)
{
	struct inj_call *call = call_of(work);
	int32_t ends[2];

	call_add(call, SYS_socketpair, AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0,
		 parasite_remote(&work->process->parasite, call->out));
	if (files_work_flush(work, err))
		return -1;
	memcpy(ends, call->out, sizeof ends);
	if (call->call[0].result || ends[0] < 0 || ends[0] >= numbers->room || ends[1] < 0 ||
	    ends[1] >= numbers->room)
		return fail(err, AVC_KERNEL, (int)-call->call[0].result, work->process->inside,
			    "restore descriptors", "socketpair",
			    "descriptors could not be handed over");
	*ours = proc_borrow_fd(work->image->pidfd, ends[1]);
	if (*ours < 0)
		return fail_errno(err, work->image->template, "restore descriptors", "pidfd_getfd",
				  "descriptors could not be handed over");
	numbers->taken[ends[0]] = numbers->taken[ends[1]] = 1;
	*theirs = free_beside(numbers, work->want);
	numbers->taken[ends[0]] = numbers->taken[ends[1]] = 0;
	numbers->taken[*theirs] = 1;
	return inject(work, err, SYS_fcntl, (uint64_t)ends[0], F_DUPFD_CLOEXEC,
		      (uint64_t)*theirs) ||
			       inject(work, err, SYS_close, (uint64_t)ends[0], 0, 0) ||
			       inject(work, err, SYS_close, (uint64_t)ends[1], 0, 0)
		       ? -1
		       : 0;
}

static bool any_lost(const struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++)
		if (work->lost[i] &&
		    work->local[files_leader(work->want, &work->want->file[i])] >= 0)
			return true;
	return false;
}

static int put_lost(struct files_work *work, struct avc_error *err)
{
	struct rlimit limit = { RLIM_INFINITY, RLIM_INFINITY };
	struct numbers numbers = { 0 };
	int ours = -1, theirs = -1, result = -1;

	if (!any_lost(work))
		return 0;
	if (numbers_begin(&numbers, work, err))
		return -1;
	if (files_work_flush(work, err))
		goto out;
	/* Passing descriptors takes some more, and one may have a number above the current
	 * limit. */
	if (prlimit(work->table, RLIMIT_NOFILE, NULL, &limit) == 0 &&
	    limit.rlim_cur < (rlim_t)numbers.room)
		process_attrs_lift_limit(work->table, RLIMIT_NOFILE, (uint64_t)numbers.room);
	if (begin_handing_over(work, &numbers, &ours, &theirs, err) == 0 &&
	    receive(work, &numbers, ours, theirs, err) == 0 &&
	    inject(work, err, SYS_close, (uint64_t)theirs, 0, 0) == 0)
		result = files_work_flush(work, err);
	close_fd(&ours);
	if (limit.rlim_cur < (rlim_t)numbers.room)
		prlimit(work->table, RLIMIT_NOFILE, &limit, NULL);
out:
	free(numbers.taken);
	return result;
}

/* ---- what is behind them ------------------------------------------------------------ */

const struct file *files_now_of(const struct files_work *work, uint32_t i)
{
	const int source = work->source[files_leader(work->want, &work->want->file[i])];

	return source < 0 ? NULL : &work->now->file[source];
}

/* A duplicate of what is at this place of the table now. */
int files_borrow_placed(const struct files_work *work, const struct file *w)
{
	const int local = work->local[files_leader(work->want, w)];

	return local >= 0 ? got_fd(fcntl(local, F_DUPFD_CLOEXEC, 0))
			  : proc_borrow_fd(work->table_pidfd, w->fd);
}

/* What `tcp` says of a connection that is still open.  One that is still being made has had nothing that
 * could be lost. */
static const char *put_connection(const struct files_work *work, int fd, const struct file *w,
				  const struct file *n)
{
	const enum avc_tcp tcp = work->config->tcp;

	if (w->goes_on || was_connecting(w) || !n || !n->tcp_state)
		return NULL;
	if (tcp == AVC_TCP_RESET || (tcp == AVC_TCP_RESET_MOVED && file_tcp_moved(w, n)))
		return file_lose_tcp(fd, w);
	return tcp == AVC_TCP_MESSAGES && file_tcp_moved(w, n) ? file_put_stream(fd, w, n) : NULL;
}

static void put_states(struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i], *n = files_now_of(work, i);
		const int local = work->local[i];
		int fd;

		(void)budget_step();
		if (files_leader(work->want, w) != i || work->kept[i])
			continue;
		if (w->remote && n && n->offset == w->offset && n->flags == w->flags &&
		    !n->lock_count && !w->lock_count)
			continue;
		fd = local >= 0 ? local : proc_borrow_fd(work->table_pidfd, w->fd);
		if (fd < 0) {
			files_note(work, w, "it could not be put in its place");
			continue;
		}
		files_note(work, w,
			   file_put_state(fd, w, n, work->config->files != AVC_FILES_KEEP));
		if (w->kind == FILE_INOTIFY)
			files_note(work, w, file_put_marks(fd, w, n, work->init));
		files_note(work, w, put_connection(work, fd, w, n));
		if (fd != local)
			close(fd);
	}
}

/* ---- all of it ------------------------------------------------------------------------------ */

static void *filled(uint32_t count, int value)
{
	int *array = malloc((count + 1) * sizeof *array);

	for (uint32_t i = 0; array && i < count; i++)
		array[i] = value;
	return array;
}

/* What they are that have no source. */
static int find_missing(const struct files_work *work, struct files_missing *missing,
			struct avc_error *err)
{
	missing->file = calloc(work->want->count + 1, sizeof *missing->file);
	if (!missing->file)
		return fail_memory(err, 0, "restore descriptors");
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];

		if (files_leader(work->want, w) != i || work->source[i] >= 0)
			continue;
		missing->file[missing->count++] = w;
		missing->port |= w->socket && w->socket->listening;
	}
	files_missing_sort(missing);
	return 0;
}

static int look_once(struct files_work *work, const struct files_missing *missing,
		     struct avc_error *err)
{
	const struct files_owner owner = { .pid = work->table,
					   .pidfd = work->table_pidfd,
					   .init = work->init };
	int result = 0;

	work->now->missing = missing;
	if (work->host && work->host->table) {
		work->now->parent = work->host->now;
		work->now->parent_pid = work->host->table;
	}
	if (work->table)
		result = files_look(work->now, &owner, FILES_NOW, work->want, err);
	work->now->missing = NULL;
	work->now->parent = NULL;
	if (result)
		return -1;
	work->claimed_by = filled(work->now->count, -1);
	if (!work->claimed_by)
		return fail_memory(err, 0, "restore descriptors");
	find_staying(work);
	return 0;
}

/* First only the numbers in use at the checkpoint, because all others are closed anyway.  But what
 * is missing may be at any of them now; and an epoll set that is new may show where a thread waits
 * to send a message. */
static int look(struct files_work *work, struct avc_error *err)
{
	struct files_missing missing = { 0 };
	int result;

	if (work->config->tcp == AVC_TCP_MESSAGES)
		return look_once(work, NULL, err);
	if (look_once(work, &missing, err))
		return -1;
	if (find_missing(work, &missing, err))
		return -1;
	if (!missing.count) {
		free(missing.file);
		return 0;
	}
	free(work->claimed_by);
	work->claimed_by = NULL;
	files_free(work->now);
	work->now = files_new(work->want->count + 64);
	for (uint32_t i = 0; i < work->want->count; i++) {
		work->source[i] = -1;
		work->lost[i] = false;
	}
	result = work->now ? look_once(work, &missing, err)
			   : fail_memory(err, 0, "restore descriptors");
	free(missing.file);
	return result;
}

int files_work_begin(struct files_work *work, struct avc_error *err)
{
	work->now = files_new(work->want->count + 64);
	work->local = filled(work->want->count, -1);
	work->source = filled(work->want->count, -1);
	work->lost = calloc(work->want->count + 1, sizeof *work->lost);
	work->kept = calloc(work->want->count + 1, sizeof *work->kept);
	if (!work->now || !work->local || !work->source || !work->lost || !work->kept)
		return fail_memory(err, 0, "restore descriptors");
	/* The app died while it was cloning (guard_checkpoint.c, abandon()). */
	if (work->table && work->process->descendant && work->process->doubtful &&
	    tracee_halt(work->table, err))
		return -1;
	if (look(work, err))
		return -1;
	files_find_accepted(work->want);
	if (work->config->tcp == AVC_TCP_MESSAGES) {
		files_find_going(work->want);
		files_find_going(work->now);
	}
	work->closed = calloc(work->now->count + 1, sizeof *work->closed);
	if (!work->closed || !files_order(&work->order, work->now))
		return fail_memory(err, 0, "restore descriptors");
	find_moved(work);
	give_up_useless(work);
	cut_strange(work);
	give_up_own(work);
	break_pairs(work);
	return shortage_check(err, "restore descriptors");
}

void files_work_end(struct files_work *work)
{
	if (work->problems > 1) {
		char rest[32];

		snprintf(rest, sizeof rest, " (and %u more)", work->problems - 1);
		strncat(work->notes->detail, rest,
			sizeof work->notes->detail - strlen(work->notes->detail) - 1);
	}
	for (uint32_t i = 0; work->local && i < work->want->count; i++)
		close_fd(&work->local[i]);
	free(work->local);
	free(work->source);
	free(work->lost);
	free(work->kept);
	free(work->claimed_by);
	free(work->closed);
	files_order_free(&work->order);
	files_free(work->now);
}

/* What a fork of that process passes on; the index of its description there, or -1. */
static int find_in_host(const struct files_work *work, const struct file *w)
{
	const struct files *host = work->host ? work->host->want : NULL;
	const struct file *h = w->fd >= FD_KEPT_MIN ? files_find(host, w->fd) : NULL;
	const struct file *first = &work->want->file[files_leader(work->want, w)];

	if (!h || w->pid_inside || !first->family ||
	    first->family != host->file[files_leader(host, h)].family)
		return -1;
	return (int)files_index(host, h);
}

static bool host_has(const struct files_work *host, int h)
{
	return !host->lost[h] || host->kept[h] ||
	       host->local[files_leader(host->want, &host->want->file[h])] >= 0;
}

/* One that the host has lost it gets from the first of its children that still has it. */
static void give_to_host(struct files_work *work, uint32_t i)
{
	const struct file *w = &work->want->file[i];
	const int h = find_in_host(work, w), local = work->local[files_leader(work->want, w)];

	if (h < 0 || local < 0 || host_has(work->host, h))
		return;
	work->host->local[files_leader(work->host->want, &work->host->want->file[h])] =
		got_fd(fcntl(local, F_DUPFD_CLOEXEC, 0));
}

/* All other processes get a rebuilt table.  Its holder closes what is new only when everything has
 * been taken from it; all holders do so at the same time (files_work_await()). */
static int gather_anew(struct files_work *work, struct avc_error *err)
{
	if (unlock_all(work, err))
		return -1;
	for (uint32_t i = 0; i < work->want->count; i++) {
		const int h = find_in_host(work, &work->want->file[i]);

		work->lost[i] = true;
		work->kept[i] = h >= 0 && host_has(work->host, h);
	}
	gather(work);
	for (uint32_t i = 0; i < work->want->count; i++)
		give_to_host(work, i);
	return shortage_check(err, "restore descriptors") ? -1 : start_calls(work, err);
}

int files_work_gather(struct files_work *work, struct avc_error *err)
{
	gather(work);
	call_begin(call_of(work), INJ_AFTER_PARK);
	/* Before what the next try would find in the table is closed. */
	if (shortage_check(err, "restore descriptors") || forget_watches(work, err) ||
	    close_new(work, err))
		return -1;
	if (work->process->descendant)
		return gather_anew(work, err);
	files_take_late(work);
	/* What is left on the list is made just before the fork (restore.c). */
	return set_cloexec(work, err) || (is_urgent(work) && files_work_flush(work, err)) ? -1 : 0;
}

int files_work_place(struct files_work *work, struct avc_error *err)
{
	if (files_give_up_sets(work, err))
		return -1;
	make_lost(work);
	if (shortage_check(err, "restore descriptors"))
		return -1;
	if (!work->process->descendant && put_lost(work, err))
		return -1;
	put_states(work);
	return 0;
}

/* What was recreated belongs to the generation from now on: the next restore finds it, also where
 * other processes share it. */
static void remember_made(struct files_work *work)
{
	for (uint32_t i = 0; i < work->want->count; i++) {
		struct file *w = &work->want->file[i];
		const int fd = work->local[files_leader(work->want, w)];
		struct stat st;

		if (work->kept[i] && w->kind == FILE_SOCKET)
			w->ino = files_find(work->host->want, w->fd)->ino;

		/* But not a substitute for one whose name was taken. */
		if (fd >= 0 && !files_now_of(work, i) && w->socket &&
		    file_socket_is_alone(w->socket) && file_socket_has_name(fd, w->socket) &&
		    fstat(fd, &st) == 0)
			w->ino = st.st_ino;
	}
}

void files_work_finish(struct files_work *work)
{
	files_connect_again(work);
	remember_made(work);
	files_list_calls(work);
	if (!work->process->descendant)
		close_list(work);
}

int files_work_table(const struct files_work *work, struct fd_table *table, struct avc_error *err)
{
	table->entry = calloc(work->want->count + 1, sizeof *table->entry);
	if (!table->entry)
		return fail_memory(err, 0, "restore descriptors");
	for (uint32_t i = 0; i < work->want->count; i++) {
		const struct file *w = &work->want->file[i];
		const int local = work->local[files_leader(work->want, w)];

		if (local < 0 && !work->kept[i])
			continue; /* reported already */
		table->entry[table->count].fd = w->fd;
		table->entry[table->count].cloexec = w->cloexec;
		table->entry[table->count].changed =
			work->kept[i] && files_find(work->host->want, w->fd)->cloexec != w->cloexec;
		table->entry[table->count].ours = work->kept[i] ? -1
								: fcntl(local, F_DUPFD_CLOEXEC, 0);
		if (!work->kept[i] && table->entry[table->count].ours < 0)
			return fail_errno(err, 0, "restore descriptors", "fcntl",
					  "there is no room for descriptor %d", w->fd);
		table->count++;
	}
	return 0;
}
