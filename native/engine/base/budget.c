/* SPDX-License-Identifier: Apache-2.0
 *
 * What one checkpoint or restore may cost. The application, which may be hostile or broken,
 * determines how much there is to read and to keep: every loop whose length it controls checks this
 * budget. A guard is one process for one container, so there is one budget.
 */
#include "base.h"

#define BYTES_MAX (UINT64_C(128) << 20)
/* A restore with all its attempts, and each step of one, however late it begins. */
#define RESTORE_NS (30 * NS_PER_S)
#define STEP_NS (5 * NS_PER_S)

static struct {
	uint64_t bytes, end_ns;
	const char *exceeded; /* in words; NULL: nothing                        */
	enum avc_code code;
	void (*working)(void *arg);
	void *arg;
	uint64_t patient_until_ns; /* 0: there is no restore                          */
	bool in_vain;              /* ... or nothing to restore to                    */
} budget;

void budget_begin(void (*working)(void *arg), void *arg)
{
	budget.bytes = budget.end_ns = 0;
	budget.exceeded = NULL;
	budget.working = working;
	budget.arg = arg;
}

void budget_deadline(uint64_t ns)
{
	budget.end_ns = ns ? now_ns() + ns : 0;
}

void budget_exceed(enum avc_code code, const char *what)
{
	if (budget.exceeded)
		return;
	budget.exceeded = what;
	budget.code = code;
}

bool budget_has(uint64_t bytes)
{
	return budget.bytes + bytes <= BYTES_MAX;
}

bool budget_take(uint64_t bytes)
{
	if (!budget_has(bytes)) {
		budget_exceed(AVC_UNSUPPORTED,
			      "the state of its open files takes more than 128 MB");
		return false;
	}
	budget.bytes += bytes;
	return true;
}

bool budget_step(void)
{
	heartbeat();
	aside_step();
	if (budget.working)
		budget.working(budget.arg);
	if (budget.end_ns && now_ns() > budget.end_ns)
		budget_exceed(AVC_DEADLINE,
			      "reading its state takes longer than it may stand still");
	return !budget.exceeded;
}

bool budget_wait(void)
{
	heartbeat();
	if (budget.patient_until_ns && budget.working)
		budget.working(budget.arg);
	return !budget.in_vain;
}

void restore_patience_begin(uint64_t until_ns)
{
	const uint64_t end = now_ns() + RESTORE_NS;

	budget.patient_until_ns = until_ns && until_ns < end ? until_ns : end;
	budget.in_vain = false;
}

void restore_is_in_vain(void)
{
	budget.in_vain = budget.patient_until_ns;
}

void restore_patience_end(void)
{
	budget.patient_until_ns = 0;
	budget.in_vain = false;
}

uint64_t restore_patience(uint64_t ns)
{
	const uint64_t now = now_ns(), until = budget.patient_until_ns;
	uint64_t patience = STEP_NS;

	if (!until || budget.in_vain)
		return ns;
	if (until > now + patience)
		patience = until - now;
	return ns > patience ? ns : patience;
}

int budget_check(pid_t pid, struct avc_error *err)
{
	return budget.exceeded ? fail(err, budget.code, 0, pid, "keep within bounds", "", "%s",
				      budget.exceeded)
			       : 0;
}
