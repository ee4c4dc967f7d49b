/* SPDX-License-Identifier: Apache-2.0
 *
 * A process that is already dying: one of its threads is in its own handler of a fatal signal,
 * writing a report, closing descriptors.  Such an image would die at every restore.
 *
 * Where a thread is in a handler, the kernel's signal frame lies above its stack pointer, and says
 * what the thread had blocked before and (SA_SIGINFO) which signal it was.  Frames of handlers that
 * have returned remain as well: programs that rely on faults (virtual machines, garbage collectors)
 * leave many.  So a frame counts only
 *   - on the alternate stack, if the thread is there now;
 *   - if the thread has more signals blocked than before, as in a handler;
 *   - if the signal was caught before and is not now: a handler that runs only once.
 * One without any of these signs (SA_NODEFER, nothing blocked, no stack of its own, installed
 * permanently) is not recognized.
 */
#include <fcntl.h>
#include <signal.h>
#include <string.h>
#include <unistd.h>

#include "process.h"

/* How much of a stack is searched, from its pointer upwards: more than handlers use; and of an
 * alternate one, where the first frame is. */
#define LOOK_BYTES (256 * 1024)
#define LOOK_TOP_BYTES (32 * 1024)
/* Where a signal was caught and is not now.  Redis tests memory by its handler, with 1 MB of stack. */
#define LOOK_FAR_BYTES (4 * 1024 * 1024)
#define CHUNK_BYTES (16 * 1024)
/* Some programs run permanently in their handlers: of calls trapped by a filter (SIGSYS) and of
 * breakpoints, or with the third sign. */
#define PATIENCE_NS (10 * NS_PER_S)

void dying_note_caught(struct process *process, const struct proc_status *status)
{
	process->caught |= status->caught & FATAL_SIGNALS;
}

void dying_begin(struct process *process)
{
	struct proc_status status;

	process->uncaught = 0;
	process->alive = false;
	if (process->caught && proc_status_of(process->status_fd, process->pid, &status) == 0)
		process->uncaught = process->caught & ~status.caught;
}

void dying_end(struct process *process)
{
	if (!process->alive)
		process->dying_ns = 0;
	process->caught &= ~process->uncaught;
}

static bool on_altstack(const struct thread *t, avc_remote address)
{
	return address - t->altstack[0] < t->altstack[2];
}

static bool is_single(uint64_t set)
{
	return set && !(set & (set - 1));
}

/* The fatal signal in whose handler the thread is according to this frame, 0: none; *surely: it
 * will not return from it. */
static int handled(const struct process *process, const struct thread *t,
		   const struct arch_signal_frame *frame, bool *surely)
{
	const uint64_t bit = frame->signal ? SIGNAL_BIT(frame->signal) : 0;
	const uint64_t more = t->sigmask & ~frame->sigmask;
	const bool nested = !(frame->sigmask & ~t->sigmask);
	uint64_t maybe = more & FATAL_SIGNALS & process->caught;

	*surely = false;
	if (bit & FATAL_SIGNALS) {
		const bool alternate = on_altstack(t, arch_sp(&t->regs)) &&
				       on_altstack(t, frame->at);

		*surely = (alternate || (more && nested)) &&
			  !(bit & (SIGNAL_BIT(SIGSYS) | SIGNAL_BIT(SIGTRAP)));
		return alternate || (more && nested) || bit & process->uncaught ? frame->signal : 0;
	}
	/* Without SA_SIGINFO the kernel does not store the signal there. */
	if (!nested || more & bit)
		return 0;
	*surely = is_single(more) && !(more & (SIGNAL_BIT(SIGSYS) | SIGNAL_BIT(SIGTRAP)));
	if (!maybe)
		maybe = process->uncaught;
	return maybe ? __builtin_ctzll(maybe) + 1 : 0;
}

typedef int frame_test(const struct process *process, const struct thread *t,
		       const struct arch_signal_frame *frame, bool *surely);

/* Reads memory of the process, in which pages that it has never touched are zeros: to read those
 * would make them present, which mincore(2) shows. Ends where nothing may be read. */
static size_t read_touched(const struct process *process, int pagemap, uint8_t *to, size_t bytes,
			   avc_remote at)
{
	uint64_t entry[(CHUNK_BYTES + ARCH_SIGNAL_FRAME_BYTES) / ARCH_PAGE_BYTES + 2] = { 0 };
	const avc_remote first = at / ARCH_PAGE_BYTES;
	/* Fewer at the end of the address space. */
	const bool known = pread(pagemap, entry, sizeof entry, (off_t)(first * sizeof *entry)) > 0;
	size_t done = 0;

	while (done < bytes) {
		const avc_remote from = at + done;
		const uint64_t page = entry[from / ARCH_PAGE_BYTES - first];
		const size_t left = ARCH_PAGE_BYTES - from % ARCH_PAGE_BYTES;
		const size_t n = left < bytes - done ? left : bytes - done;

		if (known && !(page & PAGEMAP_PRESENT) && !page_is_own(page & ~PAGEMAP_FILE))
			memset(to + done, 0, n);
		else if (pread(process->mem_fd, to + done, n, (off_t)from) != (ssize_t)n)
			return done;
		done += n;
	}
	return done;
}

/* What fits() says of the first frame that it does not answer by 0. */
static int look(const struct process *process, const struct thread *t, frame_test *fits,
		avc_remote from, avc_remote end, bool *surely)
{
	/* Frames across the end of a chunk are found in the next one. */
	static uint8_t chunk[CHUNK_BYTES + ARCH_SIGNAL_FRAME_BYTES] __attribute__((aligned(16)));
	int pagemap = proc_open(process->pid, "pagemap", O_RDONLY);
	int signal = 0;

	for (avc_remote at = from & ~UINT64_C(15); at < end && !signal; at += CHUNK_BYTES) {
		const size_t n = read_touched(process, pagemap, chunk, sizeof chunk, at);
		struct arch_signal_frame frame;
		size_t next = 0;

		while (!signal && arch_signal_frame_find(chunk, n, at, &next, &frame))
			signal = fits(process, t, &frame, surely);
		if (n < sizeof chunk)
			break;
	}
	close_fd(&pagemap);
	return signal;
}

/* Thread-local storage is above the stack in a library's allocation; beyond it is other memory. */
static avc_remote stack_end(const struct process *process, const struct thread *t)
{
	const avc_remote sp = arch_sp(&t->regs), tls = arch_tls(&t->regs);
	const uint64_t bytes = process->uncaught ? LOOK_FAR_BYTES : LOOK_BYTES;

	if (on_altstack(t, sp) && t->altstack[0] + t->altstack[2] - sp < bytes)
		return t->altstack[0] + t->altstack[2];
	return tls > sp && tls - sp < bytes ? tls : sp + bytes;
}

static int find(const struct process *process, const struct thread *t, frame_test *fits,
		bool *surely)
{
	const avc_remote sp = arch_sp(&t->regs), top = t->altstack[0] + t->altstack[2];
	const int signal = look(process, t, fits, sp, stack_end(process, t), surely);

	if (!signal && on_altstack(t, sp) && top - sp > LOOK_BYTES)
		return look(process, t, fits, top - LOOK_TOP_BYTES, top, surely);
	return signal;
}

/* Threads are mostly blocked. */
static bool was_looked_at(const struct thread *t)
{
	return t->looked_at.pc == arch_pc(&t->regs) && t->looked_at.sp == arch_sp(&t->regs) &&
	       t->looked_at.sigmask == t->sigmask;
}

int dying_check(struct process *process, struct thread *t, struct avc_error *err)
{
	const uint64_t now = now_ns();
	bool surely;
	int signal;

	if (!(t->sigmask & FATAL_SIGNALS && process->caught) && !process->uncaught &&
	    !on_altstack(t, arch_sp(&t->regs)))
		return 0;
	if (!process->uncaught && was_looked_at(t))
		return 0;
	/* It may have another alternate stack by now. */
	if (t->known && t->asked && thread_ask(process, t, err))
		return -1;
	signal = find(process, t, handled, &surely);
	if (!signal) {
		t->looked_at.pc = arch_pc(&t->regs);
		t->looked_at.sp = arch_sp(&t->regs);
		t->looked_at.sigmask = t->sigmask;
		return 0;
	}
	if (!process->dying_ns)
		process->dying_ns = now;
	if (!surely && now - process->dying_ns > PATIENCE_NS) {
		process->alive = true;
		return 0;
	}
	/* A fault that the handler repairs takes no time: the next attempt will succeed. */
	return fail(err, AVC_RETRY, 0, process->pid, "freeze", "",
		    "it is in its own handler of signal %d", signal);
}

static int returns_to_old(const struct process *process, const struct thread *t,
			  const struct arch_signal_frame *frame, bool *surely)
{
	(void)t;
	(void)surely;
	return parasite_is_needed(process, frame->pc);
}

static int returns_to_parasite(const struct process *process, const struct thread *t,
			       const struct arch_signal_frame *frame, bool *surely)
{
	(void)t;
	(void)surely;
	return parasite_contains(&process->parasite, frame->pc);
}

static bool any_returns(const struct process *process, frame_test *fits)
{
	bool ignored;

	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].stopped &&
		    find(process, &process->threads[i], fits, &ignored))
			return true;
	return false;
}

bool process_needs_old(const struct process *process)
{
	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].stopped &&
		    parasite_is_needed(process, arch_pc(&process->threads[i].regs)))
			return true;
	return any_returns(process, returns_to_old);
}

bool process_is_home(const struct process *process)
{
	for (uint32_t i = 0; i < process->thread_count; i++)
		if (process->threads[i].stopped &&
		    parasite_contains(&process->parasite, arch_pc(&process->threads[i].regs)))
			return false;
	return !any_returns(process, returns_to_parasite);
}
