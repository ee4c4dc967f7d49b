/* SPDX-License-Identifier: Apache-2.0
 *
 * The options, user and name of a socket that can be recreated (files.h).  An option with its
 * default value is not set, so that the kernel is not asked for more than the app had asked for.
 */
#include <linux/can/isotp.h>
#include <linux/can/raw.h>
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
#define SO_PASSPIDFD_ 76

/* In the order in which they are set.  A kernel or a kind of socket that lacks one reports it when
 * it is read. */
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
	{ SOL_CAN_RAW, CAN_RAW_FILTER, 0 },
	{ SOL_CAN_RAW, CAN_RAW_ERR_FILTER, 0 },
	{ SOL_CAN_RAW, CAN_RAW_LOOPBACK, 0 },
	{ SOL_CAN_RAW, CAN_RAW_RECV_OWN_MSGS, 0 },
	{ SOL_CAN_RAW, CAN_RAW_FD_FRAMES, 0 },
	{ SOL_CAN_RAW, CAN_RAW_JOIN_FILTERS, 0 },
	{ SOL_CAN_ISOTP, CAN_ISOTP_OPTS, 0 },
	{ SOL_CAN_ISOTP, CAN_ISOTP_RECV_FC, 0 },
	{ SOL_CAN_ISOTP, CAN_ISOTP_TX_STMIN, 0 },
	{ SOL_CAN_ISOTP, CAN_ISOTP_RX_STMIN, 0 },
	{ SOL_CAN_ISOTP, CAN_ISOTP_LL_OPTS, 0 },
};

#define OPTIONS (sizeof options / sizeof *options)

/* The longest there is: as many filters as a CAN socket can have. */
#define VALUE_MAX (CAN_RAW_FILTER_MAX * sizeof(struct can_filter))

struct file_option {
	uint32_t which; /* of options[]                                          */
	uint32_t bytes;
	uint8_t value[];
};

union any_option {
	struct file_option option;
	uint8_t room[sizeof(struct file_option) + VALUE_MAX];
};

static bool read_option(int fd, uint32_t which, struct file_option *option)
{
	socklen_t bytes = VALUE_MAX;

	if (getsockopt(fd, options[which].level, options[which].name, option->value, &bytes))
		return false;
	option->which = which;
	option->bytes = bytes;
	return true;
}

/* They are stored consecutively. */
static size_t size_of(const struct file_option *option)
{
	return (sizeof *option + option->bytes + 3) & ~(size_t)3;
}

static const struct file_option *first_option(const struct file_socket *s)
{
	return s->option_bytes ? s->option : NULL;
}

static const struct file_option *next_option(const struct file_socket *s,
					     const struct file_option *option)
{
	const uint8_t *next = (const uint8_t *)option + size_of(option);

	return next < (const uint8_t *)s->option + s->option_bytes
		       ? (const struct file_option *)(const void *)next
		       : NULL;
}

static void read_options(int fd, struct file_socket *s)
{
	union any_option one;

	free(s->option);
	s->option = NULL;
	s->option_bytes = 0;
	for (uint32_t i = 0; i < OPTIONS; i++) {
		uint8_t *more;

		if (!read_option(fd, i, &one.option))
			continue;
		more = realloc(s->option, s->option_bytes + size_of(&one.option));
		if (!more)
			return;
		memcpy(more + s->option_bytes, &one, size_of(&one.option));
		s->option = (struct file_option *)(void *)more;
		s->option_bytes += size_of(&one.option);
	}
}

static bool same_option(int fd, const struct file_option *option)
{
	union any_option now;

	return read_option(fd, option->which, &now.option) && now.option.bytes == option->bytes &&
	       !memcmp(now.option.value, option->value, option->bytes);
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

	for (const struct file_option *o = first_option(s); o; o = next_option(s, o)) {
		if (same_option(fd, o))
			continue;
		set_option(fd, o);
		if (!same_option(fd, o))
			problem = "not all of its options could be put back";
	}
	return problem;
}

struct file_socket *file_socket_share(struct file_socket *s)
{
	if (s)
		__atomic_fetch_add(&s->others, 1, __ATOMIC_RELAXED);
	return s;
}

void file_socket_free(struct file_socket *s)
{
	if (!s || __atomic_fetch_sub(&s->others, 1, __ATOMIC_ACQ_REL))
		return;
	free(s->option);
	free(s->node);
	free(s);
}

bool file_socket_is_alone(const struct file_socket *s)
{
	if (s->idle || s->connecting)
		return true;
	if (s->domain == AF_UNIX)
		return file_unix_is_alone(s);
	if (s->domain == AF_CAN)
		return s->protocol == CAN_RAW || s->protocol == CAN_ISOTP;
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

/* socketpair(2): a connection by name has one end with a name. */
static bool is_of_pair(const struct file_socket *s)
{
	return s->domain == AF_UNIX && s->connected && s->local_bytes == sizeof(sa_family_t) &&
	       s->remote_bytes == sizeof(sa_family_t);
}

bool file_socket_has_options(const struct file_socket *s)
{
	return file_socket_is_alone(s) || is_of_pair(s);
}

void file_look_at_options(int fd, struct file_socket *s, pid_t init)
{
	struct stat st;

	if (!file_socket_has_options(s) || fstat(fd, &st))
		return;
	s->uid = st.st_uid;
	s->gid = st.st_gid;
	read_options(fd, s);
	file_look_at_node(fd, s, init);
}
