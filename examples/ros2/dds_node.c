/* SPDX-License-Identifier: Apache-2.0
 *
 * A node as ROS 2 has them, on CycloneDDS: sends a message at a fixed rate, and
 * hears those of another node.  Run two of them, one protected, and kill it.
 *
 *   dds_node [--in TOPIC] [--out TOPIC] [--rate HZ] [--size BYTES] [--best-effort]
 *            [--after-restore none|skip|endpoints|participant] [--log FILE]
 *
 * --after-restore is what is shown here, what a node can do about its writers'
 * sequence numbers, which have gone back with its memory:
 *
 *   skip         sends as many fillers as there were messages since the checkpoint
 *                (kept.h).  Needs no notification.
 *   endpoints    on SIGUSR1 (avckpt.notify.self=signal:USR1) makes a new writer and
 *                a new reader.
 *   participant  on SIGUSR1 makes a new participant with all that belongs to it.
 *
 * The old ones are deleted by a thread: deleting a writer whose messages are not
 * acknowledged takes half a second, and these never will be.
 *
 * --log: for each message heard, 4 x 64 bits: now (CLOCK_MONOTONIC, ns), and its
 * count, sent and heard.  Appended, so that a restore does not overwrite what was
 * written since its checkpoint.
 *
 * Standard error tells each message that is not the next one after the last one
 * remembered: "after 41 came 43".
 */
#include <dds/dds.h>
#include <errno.h>
#include <fcntl.h>
#include <getopt.h>
#include <inttypes.h>
#include <pthread.h>
#include <signal.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "beat.h"
#include "kept.h"

#define NS_PER_S UINT64_C(1000000000)
#define HISTORY 10
#define BATCH 64

enum remedy { NONE, SKIP, ENDPOINTS, PARTICIPANT };
static const char *const remedies[] = { "none", "skip", "endpoints", "participant" };

static struct {
	const char *in, *out;
	double rate_hz;
	int size_bytes;
	bool best_effort;
	enum remedy remedy;
	int log_fd;
} opt = { .in = "to_node", .out = "from_node", .rate_hz = 100, .log_fd = -1 };

static struct {
	dds_entity_t participant, reader, writer, waitset;
} dds;

static volatile sig_atomic_t restored, stopped;

static void on_signal(int sig)
{
	if (sig == SIGUSR1)
		restored = 1;
	else
		stopped = 1;
}

static void die(const char *what, const char *why)
{
	fprintf(stderr, "dds_node: %s: %s\n", what, why);
	exit(1);
}

static dds_entity_t must(dds_entity_t entity, const char *what)
{
	if (entity < 0)
		die(what, dds_strretcode(-entity));
	return entity;
}

static uint64_t now_ns(void)
{
	struct timespec t;

	clock_gettime(CLOCK_MONOTONIC, &t);
	return (uint64_t)t.tv_sec * NS_PER_S + (uint64_t)t.tv_nsec;
}

static void make_endpoints(void)
{
	dds_qos_t *qos = dds_create_qos();
	dds_entity_t topic;

	dds_qset_reliability(
		qos, opt.best_effort ? DDS_RELIABILITY_BEST_EFFORT : DDS_RELIABILITY_RELIABLE,
		DDS_SECS(1));
	dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, HISTORY);
	topic = must(dds_create_topic(dds.participant, &lab_Beat_desc, opt.in, NULL, NULL), opt.in);
	dds.reader = must(dds_create_reader(dds.participant, topic, qos, NULL), "reader");
	must(dds_set_status_mask(dds.reader, DDS_DATA_AVAILABLE_STATUS), "status mask");
	must(dds_waitset_attach(dds.waitset, dds.reader, 0), "waitset");
	topic = must(dds_create_topic(dds.participant, &lab_Beat_desc, opt.out, NULL, NULL),
		     opt.out);
	dds.writer = must(dds_create_writer(dds.participant, topic, qos, NULL), "writer");
	dds_delete_qos(qos);
}

static void make_participant(void)
{
	dds.participant = must(dds_create_participant(DDS_DOMAIN_DEFAULT, NULL, NULL),
			       "participant");
	dds.waitset = must(dds_create_waitset(dds.participant), "waitset");
	make_endpoints();
}

static void *delete (void *entity)
{
	dds_delete((dds_entity_t)(intptr_t)entity);
	return NULL;
}

static void delete_later(dds_entity_t entity)
{
	pthread_t thread;

	if (pthread_create(&thread, NULL, delete, (void *)(intptr_t)entity) == 0)
		pthread_detach(thread);
}

/* What is new comes first, then what is old goes. */
static void renew(void)
{
	const dds_entity_t participant = dds.participant, reader = dds.reader, writer = dds.writer;

	if (opt.remedy == PARTICIPANT) {
		make_participant();
		delete_later(participant);
	} else if (opt.remedy == ENDPOINTS) {
		dds_waitset_detach(dds.waitset, reader);
		make_endpoints();
		delete_later(writer);
		delete_later(reader);
	}
}

static void take(lab_Beat *out)
{
	static uint64_t last_count;
	void *samples[BATCH] = { NULL };
	dds_sample_info_t infos[BATCH];
	int n;

	while ((n = dds_take(dds.reader, samples, infos, BATCH, BATCH)) > 0) {
		const uint64_t now = now_ns();

		for (int i = 0; i < n; i++) {
			const lab_Beat *in = samples[i];
			const uint64_t record[] = { now, in->count, in->sent, in->heard };

			if (!infos[i].valid_data || in->count == 0)
				continue;
			out->heard = in->sent;
			if (last_count != 0 && in->count != last_count + 1)
				fprintf(stderr, "dds_node: after %" PRIu64 " came %" PRIu64 "\n",
					last_count, in->count);
			last_count = in->count;
			if (opt.log_fd >= 0 &&
			    write(opt.log_fd, record, sizeof(record)) != sizeof(record))
				die("log", strerror(errno));
		}
		dds_return_loan(dds.reader, samples, n);
		samples[0] = NULL;
	}
}

static void send_all(struct kept *kept, lab_Beat *out)
{
	const lab_Beat filler = { 0 };

	if (opt.remedy == SKIP) {
		const uint64_t forgotten = kept_forgotten(kept);

		for (uint64_t i = 0; i < forgotten; i++) {
			kept_count(kept);
			must(dds_write(dds.writer, &filler), "filler");
		}
		if (forgotten > 0)
			fprintf(stderr, "dds_node: skipped %" PRIu64 " numbers\n", forgotten);
	}
	kept_count(kept);
	out->count++;
	out->sent = now_ns();
	must(dds_write(dds.writer, out), "write");
}

static void parse(int argc, char **argv)
{
	static const struct option options[] = {
		{ "in", required_argument, NULL, 'i' },
		{ "out", required_argument, NULL, 'o' },
		{ "rate", required_argument, NULL, 'r' },
		{ "size", required_argument, NULL, 's' },
		{ "best-effort", no_argument, NULL, 'b' },
		{ "after-restore", required_argument, NULL, 'a' },
		{ "log", required_argument, NULL, 'l' },
		{ NULL, 0, NULL, 0 },
	};
	int c;

	while ((c = getopt_long(argc, argv, "", options, NULL)) != -1) {
		switch (c) {
		case 'i':
			opt.in = optarg;
			break;
		case 'o':
			opt.out = optarg;
			break;
		case 'r':
			opt.rate_hz = atof(optarg);
			break;
		case 's':
			opt.size_bytes = atoi(optarg);
			break;
		case 'b':
			opt.best_effort = true;
			break;
		case 'a':
			for (opt.remedy = NONE; strcmp(remedies[opt.remedy], optarg) != 0;)
				if (++opt.remedy > PARTICIPANT)
					die(optarg, "none, skip, endpoints or participant");
			break;
		case 'l':
			opt.log_fd = open(
				optarg, O_WRONLY | O_CREAT | O_TRUNC | O_APPEND | O_CLOEXEC, 0644);
			if (opt.log_fd < 0)
				die(optarg, strerror(errno));
			break;
		default:
			exit(2);
		}
	}
	if (optind != argc || opt.rate_hz <= 0 || opt.size_bytes < 0)
		die("usage", "see the head of dds_node.c");
}

int main(int argc, char **argv)
{
	lab_Beat out = { 0 };
	struct kept kept;
	uint64_t period, next;

	parse(argc, argv);
	signal(SIGUSR1, on_signal);
	signal(SIGTERM, on_signal);
	signal(SIGINT, on_signal);
	if (kept_open(&kept) != 0)
		die("kept_open", strerror(errno));
	make_participant();
	if (opt.size_bytes > 0) {
		out.payload._length = out.payload._maximum = (uint32_t)opt.size_bytes;
		out.payload._buffer = calloc(1, (size_t)opt.size_bytes);
	}
	period = (uint64_t)((double)NS_PER_S / opt.rate_hz);
	next = now_ns();
	fprintf(stderr, "dds_node: ready\n");
	while (!stopped) {
		const uint64_t now = now_ns();

		dds_waitset_wait(dds.waitset, NULL, 0, next > now ? (int64_t)(next - now) : 0);
		if (restored) {
			restored = 0;
			renew();
		}
		take(&out);
		if (now_ns() < next)
			continue;
		send_all(&kept, &out);
		next += period;
		/* As a ROS timer: ticks that were missed are not made up for. */
		if (next < now_ns())
			next += (now_ns() - next) / period * period + period;
	}
	dds_delete(DDS_CYCLONEDDS_HANDLE);
	return 0;
}
