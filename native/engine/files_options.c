/* SPDX-License-Identifier: Apache-2.0
 *
 * What a socket that can be made again is to be like: its options, user, name (files.h).  An
 * option that a new socket has anyway is not set, so that nothing is asked of the kernel that
 * the app had not asked for.
 */
#include <linux/netlink.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <netinet/udp.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>

#include "files.h"

/* linux/udp.h, asm/socket.h; names that a C library may lack. */
#define UDP_SEGMENT_ 103
#define UDP_GRO_ 104
#define SO_BUF_LOCK_ 72
#define SO_PASSPIDFD_ 76

/* In the order in which they are set.  A kernel or a kind of socket that does not know one
 * says so when it is read. */
static const struct {
	int level, name;
	int forced; /* sets it beyond the limits for users, to twice the value: socket(7) */
} options[] = {
	{ SOL_SOCKET, SO_REUSEADDR, 0 },
	{ SOL_SOCKET, SO_REUSEPORT, 0 },
	{ SOL_SOCKET, SO_BINDTODEVICE, 0 },
	{ IPPROTO_IPV6, IPV6_V6ONLY, 0 },
	{ IPPROTO_IP, IP_FREEBIND, 0 },
	{ IPPROTO_IP, IP_TRANSPARENT, 0 },
	{ SOL_SOCKET, SO_BROADCAST, 0 },
	{ SOL_SOCKET, SO_KEEPALIVE, 0 },
	{ SOL_SOCKET, SO_LINGER, 0 },
	{ SOL_SOCKET, SO_OOBINLINE, 0 },
	{ SOL_SOCKET, SO_DONTROUTE, 0 },
	{ SOL_SOCKET, SO_RCVTIMEO, 0 },
	{ SOL_SOCKET, SO_SNDTIMEO, 0 },
	{ SOL_SOCKET, SO_PASSCRED, 0 },
	{ SOL_SOCKET, SO_PASSSEC, 0 },
	{ SOL_SOCKET, SO_PASSPIDFD_, 0 },
	{ SOL_SOCKET, SO_PEEK_OFF, 0 },
	{ SOL_SOCKET, SO_TIMESTAMP, 0 },
	{ SOL_SOCKET, SO_TIMESTAMPNS, 0 },
	{ SOL_SOCKET, SO_TIMESTAMPING, 0 },
	{ SOL_SOCKET, SO_RXQ_OVFL, 0 },
	{ SOL_SOCKET, SO_NO_CHECK, 0 },
	{ SOL_SOCKET, SO_BUSY_POLL, 0 },
	{ SOL_SOCKET, SO_ZEROCOPY, 0 },
	{ SOL_SOCKET, SO_MARK, 0 },
	/* Changes the size of a TCP socket's buffer, unless that was set. */
	{ SOL_SOCKET, SO_RCVLOWAT, 0 },
	{ SOL_SOCKET, SO_RCVBUF, SO_RCVBUFFORCE },
	{ SOL_SOCKET, SO_SNDBUF, SO_SNDBUFFORCE },
	{ SOL_SOCKET, SO_BUF_LOCK_, 0 },
	{ IPPROTO_IP, IP_TTL, 0 },
	/* Sets the priority as well. */
	{ IPPROTO_IP, IP_TOS, 0 },
	{ SOL_SOCKET, SO_PRIORITY, 0 },
	{ IPPROTO_IP, IP_MTU_DISCOVER, 0 },
	{ IPPROTO_IP, IP_HDRINCL, 0 },
	{ IPPROTO_IP, IP_PKTINFO, 0 },
	{ IPPROTO_IP, IP_RECVTTL, 0 },
	{ IPPROTO_IP, IP_RECVTOS, 0 },
	{ IPPROTO_IP, IP_RECVERR, 0 },
	{ IPPROTO_IP, IP_RECVORIGDSTADDR, 0 },
	{ IPPROTO_IP, IP_BIND_ADDRESS_NO_PORT, 0 },
	{ IPPROTO_IP, IP_UNICAST_IF, 0 },
	{ IPPROTO_IP, IP_MULTICAST_IF, 0 },
	{ IPPROTO_IP, IP_MULTICAST_TTL, 0 },
	{ IPPROTO_IP, IP_MULTICAST_LOOP, 0 },
	{ IPPROTO_IP, IP_MULTICAST_ALL, 0 },
	{ IPPROTO_IPV6, IPV6_UNICAST_HOPS, 0 },
	{ IPPROTO_IPV6, IPV6_TCLASS, 0 },
	{ IPPROTO_IPV6, IPV6_MTU_DISCOVER, 0 },
	{ IPPROTO_IPV6, IPV6_RECVPKTINFO, 0 },
	{ IPPROTO_IPV6, IPV6_RECVHOPLIMIT, 0 },
	{ IPPROTO_IPV6, IPV6_RECVTCLASS, 0 },
	{ IPPROTO_IPV6, IPV6_RECVERR, 0 },
	{ IPPROTO_IPV6, IPV6_MULTICAST_IF, 0 },
	{ IPPROTO_IPV6, IPV6_MULTICAST_HOPS, 0 },
	{ IPPROTO_IPV6, IPV6_MULTICAST_LOOP, 0 },
	{ IPPROTO_TCP, TCP_NODELAY, 0 },
	{ IPPROTO_TCP, TCP_CORK, 0 },
	{ IPPROTO_TCP, TCP_MAXSEG, 0 },
	{ IPPROTO_TCP, TCP_KEEPIDLE, 0 },
	{ IPPROTO_TCP, TCP_KEEPINTVL, 0 },
	{ IPPROTO_TCP, TCP_KEEPCNT, 0 },
	{ IPPROTO_TCP, TCP_SYNCNT, 0 },
	{ IPPROTO_TCP, TCP_LINGER2, 0 },
	{ IPPROTO_TCP, TCP_DEFER_ACCEPT, 0 },
	{ IPPROTO_TCP, TCP_WINDOW_CLAMP, 0 },
	{ IPPROTO_TCP, TCP_USER_TIMEOUT, 0 },
	{ IPPROTO_TCP, TCP_NOTSENT_LOWAT, 0 },
	{ IPPROTO_TCP, TCP_FASTOPEN, 0 },
	{ IPPROTO_TCP, TCP_CONGESTION, 0 },
	{ IPPROTO_UDP, UDP_CORK, 0 },
	{ IPPROTO_UDP, UDP_SEGMENT_, 0 },
	{ IPPROTO_UDP, UDP_GRO_, 0 },
	{ SOL_NETLINK, NETLINK_PKTINFO, 0 },
	{ SOL_NETLINK, NETLINK_BROADCAST_ERROR, 0 },
	{ SOL_NETLINK, NETLINK_NO_ENOBUFS, 0 },
	{ SOL_NETLINK, NETLINK_CAP_ACK, 0 },
	{ SOL_NETLINK, NETLINK_EXT_ACK, 0 },
	{ SOL_NETLINK, NETLINK_GET_STRICT_CHK, 0 },
};

#define OPTIONS (sizeof options / sizeof *options)

struct file_option {
	uint8_t which; /* of options[]                                           */
	uint8_t bytes;
	uint8_t value[16]; /* the longest: a struct timeval, a name                 */
};

static bool read_option(int fd, size_t which, struct file_option *option)
{
	socklen_t bytes = sizeof option->value;

	*option = (struct file_option){ .which = (uint8_t)which };
	if (getsockopt(fd, options[which].level, options[which].name, option->value, &bytes))
		return false;
	option->bytes = (uint8_t)bytes;
	return true;
}

static void read_options(int fd, struct file_socket *s)
{
	struct file_option all[OPTIONS];
	uint32_t count = 0;

	for (size_t i = 0; i < OPTIONS; i++)
		count += read_option(fd, i, &all[count]);
	s->option = calloc(count + 1, sizeof *s->option);
	if (!s->option)
		return;
	memcpy(s->option, all, count * sizeof *s->option);
	s->option_count = count;
}

static bool same_option(int fd, const struct file_option *option)
{
	struct file_option now;

	return read_option(fd, option->which, &now) && !memcmp(&now, option, sizeof now);
}

static void set_option(int fd, const struct file_option *option)
{
	const int level = options[option->which].level, forced = options[option->which].forced;
	int value;

	if (forced) {
		/* The kernel doubles what it is given. */
		memcpy(&value, option->value, sizeof value);
		value /= 2;
		if (setsockopt(fd, level, forced, &value, sizeof value))
			setsockopt(fd, level, options[option->which].name, &value, sizeof value);
		return;
	}
	setsockopt(fd, level, options[option->which].name, option->value, option->bytes);
}

const char *file_put_options(int fd, const struct file_socket *s)
{
	const char *problem = NULL;

	for (uint32_t i = 0; i < s->option_count; i++) {
		if (same_option(fd, &s->option[i]))
			continue;
		set_option(fd, &s->option[i]);
		if (!same_option(fd, &s->option[i]))
			problem = "not all of its options could be put back";
	}
	return problem;
}

void file_socket_free(struct file_socket *s)
{
	if (!s)
		return;
	free(s->option);
	free(s->node);
	free(s);
}

bool file_socket_is_alone(const struct file_socket *s)
{
	if (s->idle)
		return true;
	if (s->domain == AF_UNIX)
		return file_unix_is_alone(s);
	return (s->domain == AF_INET || s->domain == AF_INET6 || s->domain == AF_NETLINK) &&
	       (s->type != SOCK_STREAM || s->listening);
}

bool file_socket_has_name(int fd, const struct file_socket *s)
{
	struct sockaddr_storage local = { 0 };
	socklen_t bytes = sizeof local;

	return getsockname(fd, (struct sockaddr *)&local, &bytes) == 0 && bytes == s->local_bytes &&
	       !memcmp(&local, &s->local, bytes);
}

bool file_socket_was_used(int fd, const struct file_socket *s)
{
	struct sockaddr_storage remote;
	socklen_t bytes = sizeof remote;

	return !file_socket_has_name(fd, s) || !getpeername(fd, (struct sockaddr *)&remote, &bytes);
}

/* socketpair(2): whoever is connected by name has one end with a name. */
static bool is_of_pair(const struct file_socket *s)
{
	return s->domain == AF_UNIX && s->connected && s->local_bytes == sizeof(sa_family_t) &&
	       s->remote_bytes == sizeof(sa_family_t);
}

void file_look_at_manner(int fd, struct file_socket *s, pid_t init)
{
	struct stat st;

	if (!(file_socket_is_alone(s) || is_of_pair(s)) || fstat(fd, &st))
		return;
	s->uid = st.st_uid;
	s->gid = st.st_gid;
	read_options(fd, s);
	file_look_at_node(fd, s, init);
}
