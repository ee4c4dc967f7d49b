/* SPDX-License-Identifier: Apache-2.0
 *
 * Finds what is wanted among tens of thousands of descriptors (files.h): how many there are, and what,
 * is up to the app, and while they are compared with each other everybody waits for us.
 */
#include <stdlib.h>
#include <string.h>

#include "files.h"

/* ---- descriptors by object ----------------------------------------------------------- */

static int by_object(const void *a, const void *b)
{
	const struct file *x = *(const struct file *const *)a, *y = *(const struct file *const *)b;
	const int order = files_compare(x, y);

	return order ? order : (x->fd > y->fd) - (x->fd < y->fd);
}

bool files_order(struct files_order *order, const struct files *files)
{
	order->file = malloc((files->count + 1) * sizeof *order->file);
	order->next = calloc(files->count + 1, sizeof *order->next);
	if (!order->file || !order->next)
		return false;
	for (uint32_t i = 0; i < files->count; i++)
		order->file[i] = &files->file[i];
	order->count = files->count;
	qsort(order->file, order->count, sizeof(void *), by_object);
	return true;
}

void files_order_free(struct files_order *order)
{
	free(order->file);
	free(order->next);
	*order = (struct files_order){ 0 };
}

const struct file *files_order_take(struct files_order *order, const struct file *like,
				    bool (*is_free)(const struct file *file, const void *arg),
				    const void *arg)
{
	const uint32_t first = LOWER_BOUND(order->count, i,
					   files_compare(order->file[i], like) < 0);

	/* What is not free will not be: it is not looked at again. */
	for (uint32_t at = first + (first < order->count ? order->next[first] : 0);
	     at < order->count && !files_compare(order->file[at], like); at++) {
		order->next[first]++;
		if (is_free(order->file[at], arg))
			return order->file[at];
	}
	return NULL;
}

const struct file *files_order_pipe(const struct files_order *order, uint64_t ino)
{
	const uint32_t at = LOWER_BOUND(order->count, i,
					order->file[i]->kind < FILE_PIPE ||
						(order->file[i]->kind == FILE_PIPE &&
						 order->file[i]->ino < ino));

	return at < order->count && order->file[at]->kind == FILE_PIPE &&
			       order->file[at]->ino == ino
		       ? order->file[at]
		       : NULL;
}

/* ---- Unix sockets by name ------------------------------------------------------------- */

static int compare_names(const struct sockaddr_storage *a, socklen_t a_bytes,
			 const struct sockaddr_storage *b, socklen_t b_bytes)
{
	return a_bytes != b_bytes ? (a_bytes > b_bytes) - (a_bytes < b_bytes)
				  : memcmp(a, b, a_bytes);
}

static int by_name(const void *a, const void *b)
{
	const struct file_socket *x = *(const struct file_socket *const *)a;
	const struct file_socket *y = *(const struct file_socket *const *)b;

	return compare_names(&x->local, x->local_bytes, &y->local, y->local_bytes);
}

bool socket_names_add(struct socket_names *names, const struct file_socket *socket)
{
	if (!make_room(&names->socket, names->count, &names->room, sizeof *names->socket))
		return false;
	names->socket[names->count++] = socket;
	return true;
}

void socket_names_sort(struct socket_names *names)
{
	if (names->count)
		qsort(names->socket, names->count, sizeof *names->socket, by_name);
}

bool socket_names_have_peer(const struct socket_names *names, const struct file_socket *socket)
{
	const uint32_t at = LOWER_BOUND(names->count, i,
					compare_names(&names->socket[i]->local,
						      names->socket[i]->local_bytes,
						      &socket->remote, socket->remote_bytes) < 0);

	return at < names->count && names->socket[at]->local_bytes == socket->remote_bytes &&
	       !memcmp(&names->socket[at]->local, &socket->remote, socket->remote_bytes);
}

void socket_names_free(struct socket_names *names)
{
	free(names->socket);
	*names = (struct socket_names){ 0 };
}
