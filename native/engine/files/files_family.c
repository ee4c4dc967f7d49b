/* SPDX-License-Identifier: Apache-2.0
 *
 * The descriptor tables of all processes of an app (files.h), and what they share: a pipe or socket
 * pair with ends in different processes is recreated once, for all of them, and its contents are
 * restored once.
 */
#include <fcntl.h>
#include <netinet/in.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/stat.h>
#include <unistd.h>

#include "files.h"

/* ---- after a checkpoint ---------------------------------------------------------- */

/* What is of the same object as in the checkpoint before. */
static const struct file *find_before(const struct image *before, const struct file *f)
{
	const struct file *b = before && before->files ? files_find(before->files, f->fd) : NULL;

	return b && files_same_object(f, b) ? b : NULL;
}

static uint32_t list_held(struct files_held *held, const struct image *image,
			  const struct image *before)
{
	uint32_t count = 0;

	for (uint32_t i = 0; image->files && i < image->files->count; i++) {
		struct file *f = &image->files->file[i];

		if (f->shared != f->fd || f->outside || f->inherited)
			continue;
		if (held)
			held[count] = (struct files_held){ .file = f,
							   .before = find_before(before, f),
							   .pid = image->template };
		count++;
	}
	return count;
}

/* What has been closed since the freeze (a worker does that when its parent has died) cannot be
 * compared any more; usually it was shared in the previous checkpoint. */
static void group_closed(struct files_held *held, uint32_t count)
{
	for (uint32_t i = 0; i < count; i++) {
		const struct file *before = held[i].before;

		if (!before || !before->family || held[i].first != held[i].file ||
		    !files_is_closed(&held[i]))
			continue;
		for (uint32_t k = 0; k < count && held[i].first == held[i].file; k++)
			if (k != i && held[k].before && held[k].before->family == before->family)
				held[i].first = held[k].first;
	}
}

static pid_t inside_of(const struct image *image, uint32_t images, pid_t pid)
{
	for (uint32_t i = 0; i < images; i++)
		if (image[i].pid == pid)
			return image[i].inside;
	return 0;
}

/* Pidfds and owners: what the process itself is called is known already (files_capture.c). */
static void name_others(const struct image *image, uint32_t images, struct files *files)
{
	for (uint32_t i = 0; files && i < files->count; i++) {
		struct file *f = &files->file[i];

		if (f->kind == FILE_PIDFD && !f->pid_inside)
			f->pid_inside = inside_of(image, images, f->pid);
		if (f->owner && !f->owner_inside && f->owner_type == F_OWNER_PID)
			f->owner_inside = inside_of(image, images, f->owner);
	}
}

/* What the freeze found to share the parent's descriptions.  Parents come first. */
static void join_parents(const struct image *image, uint32_t index)
{
	const int parent = image[index].parent < 0 ? 0 : image[index].parent;
	const struct files *files = image[index].files, *parents = image[parent].files;

	for (uint32_t i = 0; index && files && i < files->count; i++) {
		struct file *f = &files->file[i], *is;

		if (f->inherited && f->shared == f->fd && !f->outside) {
			is = files_find(parents, f->inherited->shared);
			if (!is->family)
				is->family = is;
			f->family = is->family;
		}
		f->inherited = NULL;
	}
}

/* In the templates, which share the processes' tables.  A descriptor that was replaced since is
 * found to be unshared. */
void files_settle_family(struct image *image, uint32_t images, struct image *before,
			 uint32_t befores)
{
	struct files_held *held = NULL;
	uint32_t count;

	for (uint32_t i = 0; i < images; i++)
		name_others(image, images, image[i].files);
	for (int pass = 0; pass < 2; pass++) {
		count = 0;
		for (uint32_t i = 0; i < images; i++)
			if (image[i].process)
				count += list_held(held ? held + count : NULL, &image[i],
						   image_find(before, befores, image[i].process));
		if (!held)
			held = calloc(count + 1, sizeof *held);
		if (!held)
			return;
	}
	files_group(held, count);
	group_closed(held, count);
	for (uint32_t i = 0; i < count; i++)
		if (held[i].first != held[i].file)
			held[i].file->family = held[i].first->family = held[i].first;
	free(held);
	for (uint32_t i = 0; i < images; i++)
		join_parents(image, i);
}

/* ---- a restore -------------------------------------------------------------------- */

/* Where something is wanted: its number in a table. */
struct spot {
	uint64_t key; /* its inode; or the first one of its description            */
	uint32_t table, k;
};

/* Sorted, because there are as many as processes times descriptors. */
struct spots {
	struct spot *spot;
	uint32_t count;
};

struct tables {
	struct files_work *work;
	uint32_t count;
	struct spots ends; /* of pipes and sockets                                */
	struct spots family;
};

static int by_spot(const void *a, const void *b)
{
	const struct spot *x = a, *y = b;

	if (x->key != y->key)
		return x->key < y->key ? -1 : 1;
	if (x->table != y->table)
		return x->table < y->table ? -1 : 1;
	return (x->k > y->k) - (x->k < y->k);
}

static const struct file *file_at(const struct tables *tables, const struct spot *spot)
{
	return &tables->work[spot->table].want->file[spot->k];
}

static uint64_t key_of(const struct file *f, bool family)
{
	if (family)
		return (uint64_t)(uintptr_t)f->family;
	return f->kind == FILE_PIPE || f->kind == FILE_SOCKET ? f->ino : 0;
}

static int list_spots(const struct tables *tables, struct spots *spots, bool family)
{
	uint32_t room = 1;

	for (uint32_t i = 0; i < tables->count; i++)
		room += tables->work[i].want->count;
	spots->spot = malloc(room * sizeof *spots->spot);
	if (!spots->spot)
		return -1;
	for (uint32_t i = 0; i < tables->count; i++)
		for (uint32_t k = 0; k < tables->work[i].want->count; k++) {
			const uint64_t key = key_of(&tables->work[i].want->file[k], family);

			if (key)
				spots->spot[spots->count++] = (struct spot){ key, i, k };
		}
	qsort(spots->spot, spots->count, sizeof *spots->spot, by_spot);
	return 0;
}

/* The first that has this key, as all that follow until it is another one. */
static const struct spot *first_spot(const struct spots *spots, uint64_t key)
{
	return spots->spot + LOWER_BOUND(spots->count, i, spots->spot[i].key < key);
}

static bool has_key(const struct spots *spots, const struct spot *spot, uint64_t key)
{
	return spot < spots->spot + spots->count && spot->key == key;
}

#define EACH_SPOT(at, spots, wanted) \
	for (const struct spot *at = first_spot(spots, wanted); has_key(spots, at, wanted); at++)

static bool is_pair(const struct file *f)
{
	return f->kind == FILE_PIPE || (f->kind == FILE_SOCKET && f->socket && f->socket->peer);
}

static bool same_end(const struct file *a, const struct file *b)
{
	return a->kind == b->kind && a->ino == b->ino &&
	       (a->kind != FILE_PIPE || !((a->flags ^ b->flags) & O_ACCMODE));
}

static bool other_end(const struct file *a, const struct file *b)
{
	if (a->kind != b->kind)
		return false;
	if (a->kind == FILE_SOCKET)
		return b->ino == a->socket->peer;
	return a->ino == b->ino && (a->flags ^ b->flags) & O_ACCMODE;
}

static uint64_t other_key(const struct file *f)
{
	return f->kind == FILE_SOCKET ? f->socket->peer : f->ino;
}

/* One of them that is there, of any process: its descriptor in *fd, ours. */
static bool borrow(const struct tables *tables, const struct spot *spot, int *fd)
{
	const struct files_work *work = &tables->work[spot->table];
	const struct file *w = file_at(tables, spot);

	if (work->lost[spot->k] && work->local[files_leader(work->want, w)] < 0)
		return false;
	*fd = files_borrow_placed(work, w);
	return *fd >= 0;
}

static bool find_same(const struct tables *tables, const struct file *like, int *fd)
{
	EACH_SPOT(at, &tables->ends, like->ino)
	if (same_end(like, file_at(tables, at)) && borrow(tables, at, fd))
		return true;
	return false;
}

static bool find_opposite(const struct tables *tables, const struct file *like, int *fd)
{
	EACH_SPOT(at, &tables->ends, other_key(like))
	if (other_end(like, file_at(tables, at)) && borrow(tables, at, fd))
		return true;
	return false;
}

static bool find_family(const struct tables *tables, const struct file *like, int *fd)
{
	EACH_SPOT(at, &tables->family, (uint64_t)(uintptr_t)like->family)
	if (borrow(tables, at, fd))
		return true;
	return false;
}

static int reopen(int fd, int flags)
{
	const int opened = open_again(fd, flags & O_ACCMODE);

	close(fd);
	return opened;
}

/* Finds who has the other end, and whether it comes from one that still exists. */
static const struct file *find_other(const struct tables *tables, const struct file *w,
				     bool *made_already)
{
	EACH_SPOT(at, &tables->ends, other_key(w))
	{
		const struct files_work *work = &tables->work[at->table];
		const struct file *other = file_at(tables, at);
		const uint32_t leader = files_leader(work->want, other);

		if (!other_end(w, other))
			continue;
		*made_already = work->local[leader] >= 0 && work->source[leader] < 0;
		return other;
	}
	return NULL;
}

/* To every process that had it.  An end that still exists belongs to a broken pair. */
static void give_end(const struct tables *tables, const struct file *w, int end)
{
	EACH_SPOT(at, &tables->ends, w->ino)
	{
		struct files_work *work = &tables->work[at->table];
		const uint32_t k = at->k;

		if (!same_end(w, file_at(tables, at)))
			continue;
		work->lost[k] = true;
		if (files_leader(work->want, file_at(tables, at)) != k)
			continue;
		work->source[k] = -1;
		close_fd(&work->local[k]);
		work->local[k] = got_fd(fcntl(end, F_DUPFD_CLOEXEC, 0));
	}
	close(end);
}

/* What another process still has, or has again, is shared with this one. */
static void join_family(const struct tables *tables, struct files_work *work)
{
	for (uint32_t k = 0; k < work->want->count; k++) {
		const struct file *w = &work->want->file[k];
		int fd;

		if (work->lost[k] && !work->kept[k] && w->family && work->local[k] < 0 &&
		    find_family(tables, w, &fd))
			work->local[k] = fd;
	}
}

static void join_lost(const struct tables *tables, struct files_work *work, const struct file *w)
{
	const uint32_t group = files_leader(work->want, w);
	const struct file *other;
	bool made_already;
	int fd, ends[2], writer;

	if (find_same(tables, w, &fd)) {
		work->local[group] = fd;
		return;
	}
	if (w->kind == FILE_PIPE && find_opposite(tables, w, &fd)) {
		work->local[group] = reopen(fd, w->flags);
		return;
	}
	other = find_other(tables, w, &made_already);
	if (!other || made_already || file_make_pair(w, other, &work->want->rights, ends))
		return;
	/* pipe(2): the first is the one to read from. */
	writer = w->kind == FILE_PIPE && (w->flags & O_ACCMODE) == O_WRONLY;
	give_end(tables, w, ends[writer]);
	give_end(tables, other, ends[!writer]);
}

static void join(const struct tables *tables)
{
	for (uint32_t i = 0; i < tables->count; i++) {
		struct files_work *work = &tables->work[i];

		join_family(tables, work);
		for (uint32_t k = 0; k < work->want->count; k++) {
			const struct file *w = &work->want->file[k];

			(void)budget_step();
			if (is_pair(w) && work->lost[k] && !work->kept[k] &&
			    work->local[files_leader(work->want, w)] < 0)
				join_lost(tables, work, w);
		}
	}
}

/* Once, however many processes have a readable end. */
static bool is_first(const struct tables *tables, const struct file *w)
{
	EACH_SPOT(at, &tables->ends, w->ino)
	if (same_end(w, file_at(tables, at)))
		return file_at(tables, at) == w;
	return false;
}

static const struct file *content_of(const struct tables *tables, const struct file *w)
{
	EACH_SPOT(at, &tables->ends, w->ino)
	{
		const struct file *f = file_at(tables, at);

		if (same_end(w, f) && (f->content_bytes || f->content_lost))
			return f;
	}
	return w;
}

/* The process with the other end of this pipe had already exited, leaving its contents. */
static bool has_ended(const struct tables *tables, const struct file *w)
{
	EACH_SPOT(at, &tables->ends, other_key(w))
	if (other_end(w, file_at(tables, at)))
		return false;
	return w->ended || (tables->work[0].want->several && !w->outside);
}

/* What was in flight, as somebody has it (what is no file, pipe or socket cannot be told from others of
 * its kind); -1: nobody has. */
static int find_flight(const struct tables *tables, const struct file_flight *flight)
{
	const mode_t kind = flight->mode & S_IFMT;
	int fd;

	for (uint32_t i = 0; kind && i < tables->count; i++)
		for (uint32_t k = 0; k < tables->work[i].want->count; k++) {
			const struct spot at = { 0, i, k };
			const struct file *w = file_at(tables, &at);

			(void)budget_step();
			if (w->ino == flight->ino && w->dev == flight->dev &&
			    (w->mode & S_IFMT) == kind &&
			    !((w->flags ^ flight->flags) & O_ACCMODE) && borrow(tables, &at, &fd))
				return fd;
		}
	return -1;
}

/* A connection that nobody has any more reads as closed, as that of a descriptor does (files_make.c).
 * Allocated; NULL: none. */
static int *find_flights(const struct tables *tables, const struct files_work *work,
			 const struct file *content)
{
	int *passed = content->flight_count
			      ? got_memory(calloc(content->flight_count, sizeof *passed))
			      : NULL;

	for (uint32_t i = 0; passed && i < content->flight_count; i++) {
		const struct file_flight *flight = &content->flight[i];
		struct file_socket socket = { .domain = flight->domain,
					      .type = flight->type,
					      .protocol = flight->protocol };
		const struct file dead = { .kind = FILE_SOCKET, .socket = &socket };
		const char *why;

		passed[i] = find_flight(tables, flight);
		if (passed[i] < 0 && socket.protocol == IPPROTO_TCP)
			passed[i] = file_make(&dead, work->image->template, work->init,
					      &work->want->rights, &why);
	}
	return passed;
}

static void put_contents(const struct tables *tables)
{
	for (uint32_t i = 0; i < tables->count; i++) {
		struct files_work *work = &tables->work[i];

		for (uint32_t k = 0; k < work->want->count; k++) {
			const struct file *w = &work->want->file[k], *content;
			int fd = -1, other_fd = -1, bytes = 0;
			bool found;

			(void)budget_step();
			if (!(is_pair(w) || (w->kind == FILE_PIPE && w->ended)) ||
			    (w->kind == FILE_PIPE && (w->flags & O_ACCMODE) == O_WRONLY) ||
			    !is_first(tables, w) || !find_same(tables, w, &fd))
				continue;
			content = content_of(tables, w);
			found = find_opposite(tables, w, &other_fd);
			if (!found && w->kind == FILE_PIPE && has_ended(tables, w)) {
				other_fd = got_fd(fcntl(fd, F_DUPFD_CLOEXEC, 0));
				found = true;
			}
			if (found && (content->content_bytes || content->content_lost ||
				      (ioctl(fd, FIONREAD, &bytes) == 0 && bytes))) {
				int *passed = find_flights(tables, work, content);

				files_note(work, w,
					   file_put_content(fd, other_fd, content, passed));
				for (uint32_t n = 0; passed && n < content->flight_count; n++)
					close_fd(&passed[n]);
				free(passed);
			}
			close_fd(&fd);
			close_fd(&other_fd);
		}
	}
}

/* The number of descriptors that had any.  What is shared with avckpt-init belongs to others, too. */
static int drop_input(const struct tables *tables)
{
	int dropped = 0;

	for (uint32_t i = 0; i < tables->count; i++) {
		const struct files_work *work = &tables->work[i];

		for (uint32_t k = 0; k < work->want->count; k++) {
			const struct spot at = { 0, i, k };
			const struct file *w = file_at(tables, &at);
			bool ignored;
			int fd;

			(void)budget_step();
			if (w->outside || work->kept[k] || files_leader(work->want, w) != k ||
			    !borrow(tables, &at, &fd))
				continue;
			dropped += file_drop_input(fd, w,
						   is_pair(w) && find_other(tables, w, &ignored));
			close(fd);
		}
	}
	return dropped;
}

/* Of both ends of a connection (net/unix/af_unix.c, unix_shutdown()). */
static uint8_t shut_of(const struct file *f, const struct file *other)
{
	const uint8_t others = f->socket->type == SOCK_DGRAM ? 0 : other->socket->shut;

	return (uint8_t)(f->socket->shut | (others & SHUT_OUT ? SHUT_IN : 0) |
			 (others & SHUT_IN ? SHUT_OUT : 0));
}

/* As it is now; -1: no process has it any more. */
static int shut_now(const struct tables *tables, const struct file *w)
{
	EACH_SPOT(at, &tables->ends, w->ino)
	{
		const struct file *now = files_now_of(&tables->work[at->table], at->k);

		if (same_end(w, file_at(tables, at)) && now)
			return now->shut;
	}
	return -1;
}

/* Whether there are contents to restore that can no longer be sent through `other` to `w`. */
static bool is_blocked(const struct tables *tables, const struct file *w, int is, int others)
{
	const struct file *content = content_of(tables, w);
	bool blocked = is & SHUT_IN || others & SHUT_OUT;
	int fd;

	if (!blocked || !(content->content_bytes || content->content_lost))
		return false;
	if (!find_same(tables, w, &fd))
		return false;
	blocked = !file_has_messages(fd, content);
	close(fd);
	return blocked;
}

/* shutdown(2) cannot be undone: such a pair is recreated, and shut down after its contents have
 * been restored. */
static void renew_pair(const struct tables *tables, const struct file *w, const struct file *other,
		       const struct file_rights *rights)
{
	const int is = shut_now(tables, w), others = shut_now(tables, other);
	int ends[2];

	if (is < 0 || others < 0 || !(is | others))
		return;
	if (!(is & ~shut_of(w, other)) && !(others & ~shut_of(other, w)) &&
	    !is_blocked(tables, w, is, others) && !is_blocked(tables, other, others, is))
		return;
	if (file_make_pair(w, other, rights, ends))
		return;
	give_end(tables, w, ends[0]);
	give_end(tables, other, ends[1]);
}

static void shut_end(const struct tables *tables, const struct file *w, uint8_t shut)
{
	int fd;

	if (!shut || !find_same(tables, w, &fd))
		return;
	shutdown(fd, shut == SHUT_IN ? SHUT_RD : shut == SHUT_OUT ? SHUT_WR : SHUT_RDWR);
	close(fd);
}

/* Renews them, or shuts their ends. */
static void see_to_pairs(const struct tables *tables, bool renew)
{
	for (uint32_t i = 0; i < tables->count; i++)
		for (uint32_t k = 0; k < tables->work[i].want->count; k++) {
			const struct file *w = &tables->work[i].want->file[k], *other;
			bool ignored;

			if (w->kind != FILE_SOCKET || !is_pair(w) || !is_first(tables, w))
				continue;
			other = find_other(tables, w, &ignored);
			if (!other || !other->socket)
				continue;
			if (renew)
				renew_pair(tables, w, other, &tables->work[i].want->rights);
			else
				shut_end(tables, w, shut_of(w, other));
		}
}

static struct files_work *work_of(const struct tables *tables, const struct process *process)
{
	for (uint32_t i = 0; i < tables->count; i++)
		if (tables->work[i].process == process)
			return &tables->work[i];
	return NULL;
}

/* Until no holder makes the calls of files_work_gather() any more. */
static int await_gathered(struct tables *tables, struct avc_error *err)
{
	int result = 0;

	for (uint32_t i = 0; i < tables->count; i++)
		if (tables->work[i].busy && files_work_halt(&tables->work[i], err))
			result = -1;
	for (uint32_t i = 0; i < tables->count; i++)
		if (tables->work[i].busy && files_work_await(&tables->work[i], err))
			result = -1;
	return result;
}

/* One work for each table, and what of it is still there. */
static int tables_begin(struct tables *tables, struct image *image, uint32_t images,
			const struct files_work *common, struct avc_error *err)
{
	for (uint32_t i = 0; i < images; i++) {
		const struct process *process = image[i].process;
		/* The table of one that had exited before is gone. */
		const bool held = process && process->descendant;
		struct files_work *work = &tables->work[tables->count];

		if (!process || image[i].shared & CLONE_FILES)
			continue;
		*work = *common;
		work->process = image[i].process;
		work->image = &image[i];
		work->table = held ? process->holder : image[i].template;
		work->table_pidfd = held ? process->holder_pidfd : image[i].pidfd;
		work->want = image[i].files;
		if (held)
			work->host = work_of(
				tables, image[image_table_owner(image, image[i].host)].process);
		tables->count++;
		if (files_work_begin(work, err))
			return -1;
	}
	for (uint32_t i = 0; i < tables->count; i++)
		if (files_work_gather(&tables->work[i], err))
			return -1;
	return await_gathered(tables, err);
}

/* Those of one table come from where they still are. */
static int place(struct tables *tables, struct avc_error *err)
{
	if (list_spots(tables, &tables->ends, false) || list_spots(tables, &tables->family, true))
		return fail_memory(err, 0, "restore descriptors");
	see_to_pairs(tables, true);
	if (tables->count > 1)
		join(tables);
	for (uint32_t i = 0; i < tables->count; i++) {
		if (i)
			join_family(tables, &tables->work[i]);
		if (files_work_place(&tables->work[i], err))
			return -1;
	}
	return 0;
}

static int tables_finish(struct tables *tables, struct avc_error *err)
{
	for (uint32_t i = 0; i < tables->count; i++) {
		struct files_work *work = &tables->work[i];

		files_work_finish(work);
		if (work->process->descendant && files_work_table(work, &work->image->table, err))
			return -1;
	}
	return 0;
}

static void tables_end(struct tables *tables)
{
	for (uint32_t i = 0; i < tables->count; i++)
		files_work_end(&tables->work[i]);
	free(tables->ends.spot);
	free(tables->family.spot);
	free(tables->work);
}

int files_restore(struct image *image, uint32_t images, const struct avc_config *config, pid_t init,
		  struct avc_error *notes, struct avc_error *err)
{
	const struct files_work common = { .config = config, .init = init, .notes = notes };
	struct tables tables = { .work = calloc(images, sizeof *tables.work) };
	struct avc_error ignored = { 0 };
	int result, dropped = 0;

	if (!tables.work)
		return fail_memory(err, 0, "restore descriptors");
	files_find_strange(image, images, config);
	result = tables_begin(&tables, image, images, &common, err);
	if (!result)
		result = place(&tables, err);
	if (!result) {
		put_contents(&tables);
		if (config->again & AVC_AGAIN_DROP_INPUT)
			dropped = drop_input(&tables);
		see_to_pairs(&tables, false);
		result = tables_finish(&tables, err);
	}
	if (!result)
		result = shortage_check(err, "restore descriptors");
	if (result)
		(void)await_gathered(&tables, &ignored);
	tables_end(&tables);
	return result ? -1 : dropped;
}
