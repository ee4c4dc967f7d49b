/* SPDX-License-Identifier: Apache-2.0
 *
 * Calls that a process makes while it is restored, as lists in its slot of the parasite (struct
 * inj_setup). They are built with the generation, when the app runs again, so that a restore only
 * has to execute them.
 */
#include <string.h>

#include "trace.h"

void setup_begin(struct setup *setup, const struct parasite *parasite, uint32_t slot)
{
	*setup = (struct setup){ .parasite = parasite,
				 .slot = parasite_slot(parasite, slot),
				 .memory = parasite_setup(parasite, slot) };
	for (int i = 0; i < INJ_STAGES; i++) {
		setup->slot->setup[i] = 0;
		setup->tail[i] = &setup->slot->setup[i];
	}
}

static void *room(struct setup *setup, size_t bytes)
{
	void *at = setup->memory + setup->used;

	bytes = (bytes + 15) & ~(size_t)15;
	if (bytes > INJ_SETUP_BYTES - setup->used) {
		setup->full = true;
		return NULL;
	}
	setup->used += bytes;
	return at;
}

static struct inj_setup *add(struct setup *setup, uint64_t **tail, const char *name, long nr,
			     const uint64_t arg[6])
{
	struct inj_setup *s = room(setup, sizeof *s);

	if (!s)
		return &setup->spare;
	*s = (struct inj_setup){ .call = { .nr = nr } };
	memcpy(s->call.arg, arg, sizeof s->call.arg);
	strncpy(s->name, name, sizeof s->name - 1);
	**tail = parasite_remote(setup->parasite, s);
	*tail = &s->next;
	return s;
}

struct inj_setup *setup_append(struct setup *setup, enum inj_stage stage, const char *name, long nr,
			       const uint64_t arg[6])
{
	return add(setup, &setup->tail[stage], name, nr, arg);
}

void setup_thread(struct setup *setup, struct inj_thread *thread)
{
	thread->setup = 0;
	setup->thread_tail = &thread->setup;
}

struct inj_setup *setup_append_thread(struct setup *setup, const char *name, long nr,
				      const uint64_t arg[6])
{
	return add(setup, &setup->thread_tail, name, nr, arg);
}

avc_remote setup_data(struct setup *setup, const void *data, size_t bytes)
{
	void *at = room(setup, bytes);

	if (!at)
		return 0;
	memcpy(at, data, bytes);
	return parasite_remote(setup->parasite, at);
}

int setup_end(const struct setup *setup, pid_t pid, struct avc_error *err)
{
	if (setup->full)
		return fail(err, AVC_UNSUPPORTED, 0, pid, "keep template", "",
			    "it has more timers, signals and descriptors than there is room for");
	return 0;
}

/* Our address of what the process has at `address`; the app can overwrite the parasite, so its
 * contents are not trusted. */
static const struct inj_setup *local(const struct parasite *parasite, avc_remote address)
{
	if (address < parasite->base ||
	    address - parasite->base > parasite->bytes - sizeof(struct inj_setup) || address % 8)
		return NULL;
	return (const struct inj_setup *)(parasite->map + (address - parasite->base));
}

static const struct inj_setup *failed(const struct parasite *parasite, avc_remote list)
{
	const struct inj_setup *s;

	for (size_t i = 0; i < INJ_SETUP_BYTES / sizeof *s && (s = local(parasite, list));
	     i++, list = s->next)
		if (s->call.result < 0 && s->call.result > -4096)
			return s;
	return NULL;
}

const struct inj_setup *setup_failed(const struct parasite *parasite, uint32_t slot_number)
{
	const struct inj_slot *slot = parasite_slot(parasite, slot_number);
	const struct inj_setup *found = failed(parasite, slot->setup[INJ_BEFORE]);

	for (uint32_t i = 0; !found && i < slot->threads && i < parasite->threads_max; i++)
		found = failed(parasite, parasite_thread(parasite, slot_number, i)->setup);
	return found ? found : failed(parasite, slot->setup[INJ_AFTER]);
}

const struct inj_setup *setup_failed_stage(const struct parasite *parasite, uint32_t slot_number,
					   enum inj_stage stage)
{
	const struct inj_setup *s;
	avc_remote list = parasite_slot(parasite, slot_number)->setup[stage];

	for (size_t i = 0; i < INJ_SETUP_BYTES / sizeof *s && (s = local(parasite, list));
	     i++, list = s->next)
		if (s->name[0] && s->call.result < 0 && s->call.result > -4096)
			return s;
	return NULL;
}

const char *setup_name(const struct parasite *parasite, avc_remote address)
{
	const struct inj_setup *s = local(parasite, address);

	return s && memchr(s->name, 0, sizeof s->name) ? s->name : "";
}
