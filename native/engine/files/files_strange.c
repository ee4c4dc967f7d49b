/* SPDX-License-Identifier: Apache-2.0
 *
 * Unix connections between the app and processes outside of it, which are not rolled back (files.h).
 * The kernel does not count their bytes: what the app has asked or heard since the checkpoint, and has
 * forgotten at a restore, is not known of any of them.  So files_restore.c cuts them.
 */
#include <stdlib.h>
#include <sys/socket.h>

#include "files.h"

struct known_ends {
	uint64_t *ino; /* of all sockets, sorted */
	uint32_t count;
	struct socket_names listening;
	bool listed; /* those are                */
};

static int by_number(const void *a, const void *b)
{
	const uint64_t x = *(const uint64_t *)a, y = *(const uint64_t *)b;

	return (x > y) - (x < y);
}

static int list_sockets(struct known_ends *known, const struct image *image, uint32_t images)
{
	uint32_t room = 1;

	for (uint32_t i = 0; i < images; i++)
		room += image[i].files ? image[i].files->count : 0;
	known->ino = malloc(room * sizeof *known->ino);
	if (!known->ino)
		return -1;
	for (uint32_t i = 0; i < images; i++)
		for (uint32_t k = 0; image[i].files && k < image[i].files->count; k++)
			if (image[i].files->file[k].kind == FILE_SOCKET)
				known->ino[known->count++] = image[i].files->file[k].ino;
	qsort(known->ino, known->count, sizeof *known->ino, by_number);
	return 0;
}

static void list_listening(struct known_ends *known, const struct image *image, uint32_t images)
{
	for (uint32_t i = 0; i < images; i++)
		for (uint32_t k = 0; image[i].files && k < image[i].files->count; k++) {
			const struct file_socket *s = image[i].files->file[k].socket;

			if (s && s->domain == AF_UNIX && s->listening)
				(void)socket_names_add(&known->listening, s);
		}
	socket_names_sort(&known->listening);
	known->listed = true;
}

/* Whether the server that it has connected to, but that has not accepted it, is the app's. */
static bool listens_for(const struct image *image, uint32_t images, const struct file_socket *s,
			struct known_ends *known)
{
	if (!known->listed)
		list_listening(known, image, images);
	return socket_names_have_peer(&known->listening, s);
}

/* One that the app was started with cannot be made again by it, nor can a pair without names. */
static bool may_be_strange(const struct file *f)
{
	const struct file_socket *s = f->kind == FILE_SOCKET ? f->socket : NULL;

	return s && s->domain == AF_UNIX && s->type != SOCK_DGRAM && s->connected &&
	       file_has_name(s) && !f->ended && !f->outside && !f->goes_on && !file_unix_is_bus(s);
}

static bool has_strange_end(const struct image *image, uint32_t images, const struct file_socket *s,
			    struct known_ends *known)
{
	if (!s->peer)
		return s->remote_bytes > sizeof(sa_family_t) &&
		       !listens_for(image, images, s, known);
	if (!known->ino && list_sockets(known, image, images))
		return true;
	return !bsearch(&s->peer, known->ino, known->count, sizeof *known->ino, by_number);
}

void files_find_strange(const struct image *image, uint32_t images, const struct avc_config *config)
{
	const bool cuts = config->tcp == AVC_TCP_RESET || config->tcp == AVC_TCP_RESET_MOVED;
	struct known_ends known = { 0 };

	for (uint32_t i = 0; i < images; i++)
		for (uint32_t k = 0; image[i].files && k < image[i].files->count; k++) {
			struct file *f = &image[i].files->file[k];

			(void)budget_step();
			f->strange = cuts && may_be_strange(f) &&
				     has_strange_end(image, images, f->socket, &known);
		}
	free(known.ino);
	socket_names_free(&known.listening);
}
