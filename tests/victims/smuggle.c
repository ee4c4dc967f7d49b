/* SPDX-License-Identifier: Apache-2.0
 *
 * smuggle WHERE FOLDER [--little]: an application whose own seccomp filter refuses it mkdir(2), and
 * with --little all but a few calls, has what avckpt runs in it make that call:
 *
 *   lists    it is written into the list of calls that a thread of its is about to make, by an
 *            accomplice outside: nothing of the application runs then
 *   code     it maps code of its own over that of the parasite
 *   setup    it writes it into what a process restored from it will call
 *
 * It begins at SIGUSR1, when there is one parasite only.  counter[0] says that it has found it,
 * counter[1] how often the call was made and refused, counter[2] how often it was not; counter[3] is
 * the address of FOLDER.
 *
 * smuggle outside PID ADDRESS: the accomplice, of the process PID, with FOLDER at ADDRESS there.
 */
#include <pthread.h>
#include <sys/stat.h>

#include "confine.h"
#include "parasite_place.h"

#define SLOTS 3 /* avckpt.keep is 2 in the tests */
#define UNTOUCHED INT64_C(0x7777)
#define LISTED 48

static const char *folder, *where;
static struct inj_setup fake;
static volatile int64_t outcome = UNTOUCHED;
static volatile sig_atomic_t asked;

static void ask(int signal)
{
	(void)signal;
	asked = 1;
}

static void confine(bool little)
{
	struct sock_filter most[] = {
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
		BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_mkdirat, 0, 1),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | EPERM),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
	};
	struct sock_filter few[] = {
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
		ALLOW(SYS_clock_nanosleep),
		ALLOW(SYS_restart_syscall),
		ALLOW_HOMEWARD,
		ALLOW(SYS_openat),
		ALLOW(SYS_newfstatat),
		ALLOW(SYS_fstat),
		ALLOW(SYS_read),
		ALLOW(SYS_close),
		ALLOW(SYS_mmap),
		ALLOW(SYS_mremap),
		ALLOW(SYS_brk),
		ALLOW(SYS_exit_group),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ERRNO | EPERM),
	};

	if (little)
		install_filter(few, sizeof(few) / sizeof(*few), SECCOMP_FILTER_FLAG_TSYNC);
	else
		install_filter(most, sizeof(most) / sizeof(*most), SECCOMP_FILTER_FLAG_TSYNC);
	CHECK(mkdirat(AT_FDCWD, folder, 0700) < 0 && errno == EPERM, "the filter does not hold");
}

static void note(int64_t result)
{
	if (result == -EPERM)
		count(1, 1);
	else if (result == 0)
		count(2, 1);
}

/* As it is after a checkpoint. */
static void read_lists(struct inj_call *call)
{
	for (unsigned int i = 0; i < LISTED; i++) {
		struct inj_syscall *s = &call->call[i];

		if (__atomic_load_n(&s->nr, __ATOMIC_RELAXED) == SYS_mkdirat &&
		    s->result != UNTOUCHED && s->result != -ENOSYS) {
			note(s->result);
			s->result = UNTOUCHED;
		}
	}
}

static void write_lists(struct inj_call *call, uint64_t name)
{
	/* The first of a list is not yet made while the others are being written. */
	for (unsigned int i = 0; i < LISTED; i++) {
		struct inj_syscall *s = &call->call[i];

		if (s->nr == SYS_mkdirat)
			continue;
		s->arg[0] = (uint64_t)AT_FDCWD;
		s->arg[1] = name;
		s->arg[2] = 0700;
		s->result = UNTOUCHED;
		__atomic_store_n(&s->nr, SYS_mkdirat, __ATOMIC_RELEASE);
	}
}

static void outside(const char *pid, uint64_t name)
{
	const struct place place = find_parasite_of(pid);
	const uint64_t start = place.start + INJ_CODE_BYTES;
	struct inj_control *control;
	char path[128];
	int fd;

	must(place.bytes, "a parasite");
	snprintf(path, sizeof(path), "/proc/%s/map_files/%lx-%lx", pid, start,
		 place.start + place.bytes);
	fd = open(path, O_RDWR | O_CLOEXEC);
	must(fd >= 0, path);
	control = mmap(NULL, sizeof(*control), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
	must(control != MAP_FAILED, "mmap");
	for (;;)
		write_lists(&control->runner, name);
}

/* mkdir(folder, 0700), and what came of it; behind a great many nops. */
struct __attribute__((packed)) smuggled {
#ifdef __x86_64__
	uint8_t number[1]; /* mov $SYS_mkdirat, %eax; mov $AT_FDCWD, %edi */
	uint32_t nr;
	uint8_t in_folder[1];
	int32_t cwd;
	uint8_t named[2]; /* mov $folder, %rsi */
	uint64_t name;
	uint8_t rest[9]; /* mov $0700, %edx; syscall; mov $outcome, %rdi */
	uint64_t to;
	uint8_t end[5]; /* mov %rax, (%rdi); jmp . */
#else
	uint32_t insn[8]; /* mov x8, #SYS_mkdirat; mov x0, #AT_FDCWD; ldr x1, name; mov x2, #0700;
			   * svc #0; ldr x3, to; str x0, [x3]; b . */
	uint64_t name, to;
#endif
};

#ifdef __x86_64__
#define NOP "\x90\x90\x90\x90"
#else
#define NOP "\x1f\x20\x03\xd5"
#endif

static void map_code(const struct place *place)
{
	uint8_t *code = mmap(NULL, INJ_CODE_BYTES, PROT_READ | PROT_WRITE | PROT_EXEC,
			     MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
	const struct smuggled smuggled = {
#ifdef __x86_64__
		.number = { 0xb8 },
		.nr = SYS_mkdirat,
		.in_folder = { 0xbf },
		.cwd = AT_FDCWD,
		.named = { 0x48, 0xbe },
		.rest = { 0xba, 0xc0, 0x01, 0, 0, 0x0f, 0x05, 0x48, 0xbf },
		.end = { 0x48, 0x89, 0x07, 0xeb, 0xfe },
#else
		.insn = { 0xd2800008 | SYS_mkdirat << 5, 0x92800c60, 0x580000c1, 0xd2803802,
			  0xd4000001, 0x580000a3, 0xf9000060, 0x14000000 },
#endif
		.name = (uint64_t)folder,
		.to = (uint64_t)&outcome,
	};

	must(code != MAP_FAILED, "mmap");
	for (size_t i = 0; i < INJ_CODE_BYTES; i += 4)
		memcpy(code + i, NOP, 4);
	memcpy(code + INJ_CODE_BYTES - 64, &smuggled, sizeof smuggled);
	__builtin___clear_cache((char *)code, (char *)code + INJ_CODE_BYTES);
	must(mremap(code, INJ_CODE_BYTES, INJ_CODE_BYTES, MREMAP_MAYMOVE | MREMAP_FIXED,
		    (void *)place->start) != MAP_FAILED,
	     "mremap");
}

static void write_setup(const struct place *place)
{
	const uint64_t slot_bytes = (place->bytes - INJ_SLOTS_OFFSET) / SLOTS;

	for (unsigned int i = 0; i < SLOTS; i++) {
		struct inj_slot *slot =
			(struct inj_slot *)(place->start + INJ_SLOTS_OFFSET + i * slot_bytes);

		if (slot->setup[INJ_AFTER] && slot->setup[INJ_AFTER] != (uint64_t)&fake)
			slot->setup[INJ_AFTER] = (uint64_t)&fake;
	}
	if (fake.call.result != UNTOUCHED) {
		note(fake.call.result);
		fake.call.result = UNTOUCHED;
	}
}

static void *attack(void *unused)
{
	struct inj_control *control;
	struct place place;

	while (!asked)
		usleep(1000);
	place = await_parasite();
	control = (struct inj_control *)(place.start + INJ_CODE_BYTES);
	fake = (struct inj_setup){ .flags = INJ_MAY_FAIL,
				   .call = { .nr = SYS_mkdirat,
					     .arg = { (uint64_t)AT_FDCWD, (uint64_t)folder, 0700 },
					     .result = UNTOUCHED } };
	count(3, (uint64_t)folder);
	count(0, 1);
	if (!strcmp(where, "code"))
		map_code(&place);
	for (;;) {
		if (!strcmp(where, "lists"))
			read_lists(&control->runner);
		else if (!strcmp(where, "setup"))
			write_setup(&place);
		if (outcome != UNTOUCHED) {
			note(outcome);
			outcome = UNTOUCHED;
		}
	}
	return unused;
}

int main(int argc, char **argv)
{
	const bool little = victim_flag(&argc, argv, "--little");
	pthread_t thread;

	if (argc == 4 && !strcmp(argv[1], "outside"))
		outside(argv[2], strtoull(argv[3], NULL, 0));
	victim_start(&argc, argv, 2, "WHERE FOLDER [--little]");
	where = argv[1];
	folder = argv[2];
	signal(SIGUSR1, ask);
	must(!pthread_create(&thread, NULL, attack, NULL), "pthread_create");
	usleep(20000);
	confine(little);
	victim_ready();
	for (;;) {
		usleep(1000);
		beat();
	}
}
