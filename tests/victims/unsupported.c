/* SPDX-License-Identifier: Apache-2.0
 *
 * unsupported KIND [AFTER_SECONDS [FOR_SECONDS]]: a process that cannot be
 * checkpointed, from AFTER_SECONDS after its start (0), for FOR_SECONDS (0: for
 * ever; not every kind can be undone); AFTER_SECONDS "signal": from SIGUSR1 on.  Beats every 1 ms; counter 0 is 1 while it
 * is as it says.
 *
 *   iouring   has an io_uring
 *   ringonly  has an io_uring that is mapped and has no descriptor
 *   aio       has a kernel AIO context
 *   aioinstead  the same, and as much less of other memory
 *   received  has memory in which a TCP socket puts what it receives
 *   direct    has a file open for O_DIRECT
 *   traced    somebody else traces it
 *   sysvshm   has a SysV shared memory segment attached
 *   sysvsem   has SysV semaphores with undo
 *   shared    64 MB of anonymous shared memory
 *   userfault has a userfaultfd
 *   huge      private memory of huge pages
 *   nested    children would get a PID namespace of their own
 *   strict    its main thread is in seccomp's strict mode
 *   filter    one thread under a seccomp filter that asks another process (SECCOMP_RET_USER_NOTIF)
 *   groups    one thread with other groups, which the main thread may not set
 *   hugefile  the same, of a file (a memfd)
 *   folder    one thread with a working directory of its own
 *   files     one thread with descriptors of its own
 *   network   one thread in a network of its own
 *   bounds    one thread with a smaller bounding set, which the main thread may not lower
 *   locked, locked-child  one thread, or a child process, without a securebit that the main
 *             thread has locked
 *   rooted-child  a child with a root directory of its own, whose parent is another user since
 *   unfiltered-child, other-filter   the main process has a seccomp filter that a child process has
 *             not; and the child has another one instead
 *   user      one thread of another user, and the main thread has locked that capabilities are
 *             not kept over that
 *   dropped   one thread of another user, and the main thread has become a third one's
 *   vfork     a thread waits for a child that never executes a program (vfork(2))
 *   vdso      a child of a process that has unmapped its vDSO since
 *   siblings-files   two child processes with the same descriptors, which are not their parent's
 *   dispatch  its system calls are dispatched by itself, and while it makes none are blocked
 *             (PR_SET_SYSCALL_USER_DISPATCH)
 *   limited   may have 32 MB of memory more (RLIMIT_AS)
 *   ring      has a packet socket's ring mapped
 *   secret    has memory of memfd_secret(2) mapped
 *   future    has a memfd mapped for writing that is sealed against that (F_SEAL_FUTURE_WRITE)
 *   stuck     has sealed memory (mseal(2)), and a child that is another program
 */
#include <arpa/inet.h>
#include <linux/aio_abi.h>
#include <linux/capability.h>
#include <linux/filter.h>
#include <linux/if_ether.h>
#include <linux/if_packet.h>
#include <linux/io_uring.h>
#include <linux/seccomp.h>
#include <linux/securebits.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <stddef.h>
#include <sys/ipc.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/resource.h>
#include <sys/sem.h>
#include <sys/shm.h>
#include <sys/socket.h>
#include <sys/wait.h>

#include "victim.h"

static int fd = -1, pipe_fd[2];
static void *memory, *room;
static aio_context_t aio;

static bool start_iouring(void)
{
	struct io_uring_params params = { 0 };

	fd = (int)syscall(SYS_io_uring_setup, 4, &params);
	return fd >= 0;
}

static bool start_ringonly(void)
{
	if (!start_iouring())
		return false;
	memory = mmap(NULL, 4096, PROT_READ, MAP_SHARED, fd, IORING_OFF_SQ_RING);
	close(fd);
	return memory != MAP_FAILED;
}

static bool start_received(void)
{
	fd = socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
	memory = mmap(NULL, 4096, PROT_READ, MAP_SHARED, fd, 0);
	return memory != MAP_FAILED;
}

static bool start_direct(void)
{
	fd = open("/proc/self/exe", O_RDONLY | O_DIRECT | O_CLOEXEC);
	return fd >= 0;
}

static bool start_userfault(void)
{
	fd = (int)syscall(SYS_userfaultfd, O_CLOEXEC | 1 /* UFFD_USER_MODE_ONLY */);
	return fd >= 0;
}

static void stop_fd(void)
{
	close(fd);
}

static bool start_aio(void)
{
	return syscall(SYS_io_setup, 4, &aio) == 0;
}

/* Without the heap of stdio: the process stays as large as it was. */
static bool start_aioinstead(void)
{
	static char text[65536];
	unsigned long start, end;
	ssize_t n, bytes = 0;
	char *line;
	int maps;

	if (!start_aio())
		return false;
	maps = open("/proc/self/maps", O_RDONLY | O_CLOEXEC);
	must(maps >= 0, "/proc/self/maps");
	while ((n = read(maps, text + bytes, sizeof text - 1 - (size_t)bytes)) > 0)
		bytes += n;
	close(maps);
	line = strstr(text, "[aio]");
	must(line != NULL, "its ring");
	while (line > text && line[-1] != '\n')
		line--;
	must(sscanf(line, "%lx-%lx", &start, &end) == 2, "its addresses");
	must(!munmap(room, end - start), "munmap");
	return true;
}

static void stop_aio(void)
{
	syscall(SYS_io_destroy, aio);
}

/* The tracer is no child of ours: a grandchild, left to init. */
static bool start_traced(void)
{
	pid_t me = getpid(), pid;
	char c = 0;

	if (pipe(pipe_fd) < 0)
		return false;
	prctl(PR_SET_PTRACER, PR_SET_PTRACER_ANY); /* where Yama asks for it */
	pid = fork();
	if (pid == 0) {
		if (fork() != 0)
			_exit(0);
		c = ptrace(PTRACE_SEIZE, me, NULL, NULL) == 0;
		if (write(pipe_fd[1], &c, 1) != 1)
			_exit(1);
		/* Ends with the victim, and when told to. */
		for (;;) {
			int status;

			if (waitpid(me, &status, 0) < 0 || !WIFSTOPPED(status))
				_exit(0);
			/* Signals go on; what stops us by ptrace goes on, too. */
			ptrace(PTRACE_CONT, me, NULL, status >> 16 ? 0 : WSTOPSIG(status));
		}
	}
	waitpid(pid, NULL, 0);
	return read(pipe_fd[0], &c, 1) == 1 && c;
}

static bool start_sysvshm(void)
{
	int id = shmget(IPC_PRIVATE, 1 << 20, 0600);

	if (id < 0)
		return false;
	memory = shmat(id, NULL, 0);
	shmctl(id, IPC_RMID, NULL); /* goes when we go */
	return memory != (void *)-1;
}

static void stop_sysvshm(void)
{
	shmdt(memory);
}

static bool start_sysvsem(void)
{
	struct sembuf give = { .sem_op = 1, .sem_flg = SEM_UNDO };
	int id;

	if (unshare(CLONE_NEWIPC) < 0 && errno != EPERM)
		return false;
	id = semget(IPC_PRIVATE, 1, 0600);
	return id >= 0 && semop(id, &give, 1) == 0;
}

static bool start_shared(void)
{
	memory = mmap(NULL, 64 << 20, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
	if (memory == MAP_FAILED)
		return false;
	memset(memory, 7, 64 << 20);
	return true;
}

static void stop_shared(void)
{
	munmap(memory, 64 << 20);
}

static bool start_huge(void)
{
	memory = mmap(NULL, 2 << 20, PROT_READ | PROT_WRITE,
		      MAP_PRIVATE | MAP_ANONYMOUS | MAP_HUGETLB, -1, 0);
	if (memory == MAP_FAILED)
		return false;
	memset(memory, 7, 2 << 20);
	return true;
}

static bool start_hugefile(void)
{
	int file = memfd_create("huge", MFD_CLOEXEC | MFD_HUGETLB);

	if (file < 0 || ftruncate(file, 2 << 20))
		return false;
	memory = mmap(NULL, 2 << 20, PROT_READ | PROT_WRITE, MAP_PRIVATE, file, 0);
	close(file);
	if (memory == MAP_FAILED)
		return false;
	memset(memory, 7, 2 << 20);
	return true;
}

static void stop_huge(void)
{
	munmap(memory, 2 << 20);
}

static bool start_nested(void)
{
	return unshare(CLONE_NEWPID) == 0;
}

static bool add_filter(void)
{
	struct sock_filter all[] = { BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW) };
	struct sock_fprog program = { 1, all };

	return !prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) &&
	       !syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, 0, &program);
}

static void *filtered(void *arg)
{
	struct sock_filter ask[] = {
		BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
		BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_getppid, 0, 1),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_USER_NOTIF),
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
	};
	struct sock_fprog program = { 4, ask };

	if (prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) ||
	    syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, 0, &program))
		unavailable("seccomp");
	(void)arg;
	for (;;)
		pause();
	return NULL;
}

static bool start_filter(void)
{
	pthread_t thread;

	return !pthread_create(&thread, NULL, filtered, NULL);
}

static bool give_up_groups(void)
{
	struct __user_cap_header_struct header = { _LINUX_CAPABILITY_VERSION_3, 0 };
	struct __user_cap_data_struct data[2] = { { 0 } };

	if (syscall(SYS_capget, &header, data))
		return false;
	data[0].effective &= ~(1u << CAP_SETGID);
	data[0].permitted &= ~(1u << CAP_SETGID);
	return !syscall(SYS_capset, &header, data);
}

static void *grouped(void *arg)
{
	const gid_t group = 4711;

	/* The main thread has no less than it: that is refused, too. */
	if (syscall(SYS_setgroups, 1, &group) || !give_up_groups())
		unavailable("setgroups");
	*(volatile bool *)arg = true;
	for (;;)
		pause();
	return NULL;
}

static bool start_groups(void)
{
	static volatile bool done;
	pthread_t thread;

	if (pthread_create(&thread, NULL, grouped, (void *)&done))
		return false;
	while (!done)
		nap_us(100);
	return give_up_groups();
}

static volatile bool together_again;

static void *apart(void *arg)
{
	const int flag = *(const int *)arg,
		  network = open("/proc/thread-self/ns/net", O_RDONLY | O_CLOEXEC);

	if (unshare(flag))
		unavailable("unshare");
	count(1, 1);
	while (flag != CLONE_NEWNET || !together_again)
		nap_us(1000);
	must(!setns(network, CLONE_NEWNET), "setns");
	count(1, 1);
	for (;;)
		pause();
	return NULL;
}

static void give_up(struct __user_cap_data_struct *data)
{
	data[0].effective &= ~(1u << CAP_SETPCAP);
	data[0].permitted &= ~(1u << CAP_SETPCAP);
}

/* The other one has given the right up, too, or would be refused for having more. */
static void *bounded(void *arg)
{
	struct __user_cap_header_struct header = { _LINUX_CAPABILITY_VERSION_3, 0 };
	struct __user_cap_data_struct data[2] = { { 0 } };

	if (prctl(PR_CAPBSET_DROP, CAP_CHOWN, 0, 0, 0) || syscall(SYS_capget, &header, data))
		unavailable("PR_CAPBSET_DROP");
	give_up(data);
	if (syscall(SYS_capset, &header, data))
		unavailable("capset");
	count(1, 1);
	for (;;)
		pause();
	return arg;
}

static bool start_thread(void *(*work)(void *), int arg)
{
	static int given;
	const uint64_t before = board->counter[1];
	pthread_t thread;

	given = arg;
	if (pthread_create(&thread, NULL, work, &given))
		return false;
	while (board->counter[1] == before)
		nap_us(100);
	return true;
}

static bool start_folder(void)
{
	return start_thread(apart, CLONE_FS);
}

static bool start_files(void)
{
	return start_thread(apart, CLONE_FILES);
}

static bool start_network(void)
{
	return start_thread(apart, CLONE_NEWNET);
}

static void stop_network(void)
{
	const uint64_t before = board->counter[1];

	together_again = true;
	while (board->counter[1] == before)
		nap_us(100);
}

static bool start_bounds(void)
{
	struct __user_cap_header_struct header = { _LINUX_CAPABILITY_VERSION_3, 0 };
	struct __user_cap_data_struct data[2] = { { 0 } };

	if (!start_thread(bounded, 0) || syscall(SYS_capget, &header, data))
		return false;
	give_up(data);
	return !syscall(SYS_capset, &header, data);
}

static void *other_user(void *arg)
{
	if (*(const int *)arg && syscall(SYS_setresuid, 1001, 1001, 1001))
		unavailable("setresuid");
	count(1, 1);
	for (;;)
		pause();
	return arg;
}

static bool lock_securebits(unsigned long bits)
{
	return !prctl(PR_SET_SECUREBITS, bits, 0, 0, 0);
}

static bool start_locked(void)
{
	return start_thread(other_user, false) &&
	       lock_securebits(SECBIT_NOROOT | SECBIT_NOROOT_LOCKED);
}

static bool start_user(void)
{
	return lock_securebits(SECBIT_KEEP_CAPS_LOCKED) && start_thread(other_user, true);
}

static bool start_dropped(void)
{
	return start_thread(other_user, true) && !syscall(SYS_setresuid, 1000, 1000, 1000);
}

static void *wait_for_ever(void *arg)
{
	count(1, 1);
	/* The child has our stack: it must not return. */
	if (!vfork())
		for (;;)
			pause();
	return arg;
}

static bool start_vfork(void)
{
	return start_thread(wait_for_ever, 0);
}

static bool start_child(unsigned long flags)
{
	const long child = syscall(SYS_clone, flags | SIGCHLD, 0, 0, 0, 0);

	if (!child)
		for (;;)
			pause();
	return child > 0;
}

static bool start_locked_child(void)
{
	return start_child(0) && lock_securebits(SECBIT_NOROOT | SECBIT_NOROOT_LOCKED);
}

static bool become_another_user(void)
{
	return !setgid(1234) && !setuid(1234);
}

/* As lldpd: both have given up their rights, the child after it has changed its root. */
static bool start_rooted_child(void)
{
	int ready[2];
	long child;
	char byte;

	must(!pipe(ready), "pipe");
	child = syscall(SYS_clone, SIGCHLD, 0, 0, 0, 0);
	if (!child) {
		must(!chroot("/tmp") && !chdir("/") && become_another_user(), "chroot");
		close(ready[0]);
		close(ready[1]);
		for (;;)
			pause();
	}
	close(ready[1]);
	must(read(ready[0], &byte, 1) == 0, "read");
	close(ready[0]);
	return child > 0 && become_another_user();
}

static bool start_filtered_child(void)
{
	const pid_t pid = fork();

	if (pid == 0) {
		must(add_filter(), "seccomp");
		for (;;)
			pause();
	}
	return pid > 0;
}

static bool start_unfiltered_child(void)
{
	return start_child(0) && add_filter();
}

static bool start_other_filter(void)
{
	struct sock_filter other[] = { BPF_STMT(BPF_LD | BPF_W | BPF_IMM, 0),
				       BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW) };
	struct sock_fprog program = { 2, other };

	return start_filtered_child() && !prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) &&
	       !syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, 0, &program);
}

/* A child of a process that has unmapped its vDSO afterwards. */
static bool start_vdso(void)
{
	const pid_t pid = fork();

	if (pid)
		return pid > 0;
	if (fork())
		(void)victim_vdso(getpid(), true);
	for (;;)
		pause();
}

/* Two children with the descriptors that were their parent's, which has its own now. */
static bool start_siblings_files(void)
{
	return start_child(CLONE_FILES) && start_child(CLONE_FILES) && unshare(CLONE_FILES) == 0;
}

static volatile char selector; /* of the dispatch: 1 blocks */
static bool dispatched;

static void on_dispatch(int signal, siginfo_t *info, void *context)
{
	(void)signal;
	(void)context;
	selector = 0;
	violation("system call %d, which it has not made, has come to it", info->si_syscall);
}

static bool start_dispatch(void)
{
	const struct sigaction act = { .sa_sigaction = on_dispatch, .sa_flags = SA_SIGINFO };

	sigaction(SIGSYS, &act, NULL);
	dispatched = !prctl(59 /* PR_SET_SYSCALL_USER_DISPATCH */, 1, 0, 0, &selector);
	return dispatched;
}

static void stop_dispatch(void)
{
	dispatched = prctl(59, 0, 0, 0, 0) != 0;
}

/* Without a system call: not every clock can do without. */
static void be_dispatched(void)
{
	selector = 1;
	for (volatile int i = 0; i < 2000000; i++)
		;
	selector = 0;
}

static bool strict;
static int nudges[2];

static void *nudge(void *arg)
{
	while (write(nudges[1], "", 1) == 1)
		nap_us(1000);
	return arg;
}

static bool start_strict(void)
{
	pthread_t thread;

	strict = !pipe(nudges) && !pthread_create(&thread, NULL, nudge, NULL);
	return strict;
}

/* Without the clock, which may be a system call. */
static void be_strict(void)
{
	char c;

	must(!prctl(PR_SET_SECCOMP, SECCOMP_MODE_STRICT), "PR_SET_SECCOMP");
	while (read(nudges[0], &c, 1) == 1)
		__atomic_add_fetch(&board->beats, 1, __ATOMIC_RELEASE);
	syscall(SYS_exit, 1);
}

static bool start_limited(void)
{
	struct rlimit limit;
	long pages = 0;
	FILE *statm = fopen("/proc/self/statm", "re");

	if (!statm || fscanf(statm, "%ld", &pages) != 1 || getrlimit(RLIMIT_AS, &limit))
		return false;
	fclose(statm);
	limit.rlim_cur = (rlim_t)pages * 4096 + (32 << 20);
	return !setrlimit(RLIMIT_AS, &limit);
}

static void stop_limited(void)
{
	struct rlimit limit;

	must(!getrlimit(RLIMIT_AS, &limit), "getrlimit");
	limit.rlim_cur = limit.rlim_max;
	must(!setrlimit(RLIMIT_AS, &limit), "setrlimit");
}

static bool start_ring(void)
{
	struct tpacket_req ring = { 65536, 2, 2048, 64 };

	fd = socket(AF_PACKET, SOCK_RAW, htons(ETH_P_ALL));
	if (fd < 0 || setsockopt(fd, SOL_PACKET, PACKET_RX_RING, &ring, sizeof ring))
		return false;
	memory = mmap(NULL, 131072, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
	return memory != MAP_FAILED;
}

static void stop_ring(void)
{
	munmap(memory, 131072);
	close(fd);
}

static bool map_file(int file)
{
	if (file < 0 || ftruncate(file, 4096))
		return false;
	memory = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
	fd = file;
	return memory != MAP_FAILED;
}

static bool start_secret(void)
{
	return map_file((int)syscall(447 /* SYS_memfd_secret */, O_CLOEXEC));
}

static bool start_future(void)
{
	return map_file(memfd_create("future", MFD_ALLOW_SEALING | MFD_CLOEXEC)) &&
	       !fcntl(fd, F_ADD_SEALS, 0x10 /* F_SEAL_FUTURE_WRITE */);
}

static void stop_file(void)
{
	munmap(memory, 4096);
	close(fd);
}

static pid_t other;

static bool start_stuck(void)
{
	memory = mmap(NULL, 65536, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
	if (memory == MAP_FAILED || syscall(462 /* SYS_mseal */, memory, 65536, 0))
		return false;
	other = fork();
	if (other == 0) {
		execl("/bin/sleep", "sleep", "1000", NULL);
		_exit(1);
	}
	return other > 0;
}

static void stop_stuck(void)
{
	kill(other, SIGKILL);
	waitpid(other, NULL, 0);
}

static const struct kind {
	const char *name;
	bool (*start)(void);
	void (*stop)(void);
} kinds[] = {
	{ "iouring", start_iouring, stop_fd },
	{ "ringonly", start_ringonly, NULL },
	{ "aio", start_aio, stop_aio },
	{ "aioinstead", start_aioinstead, NULL },
	{ "received", start_received, NULL },
	{ "direct", start_direct, stop_fd },
	{ "traced", start_traced, NULL },
	{ "sysvshm", start_sysvshm, stop_sysvshm },
	{ "sysvsem", start_sysvsem, NULL },
	{ "shared", start_shared, stop_shared },
	{ "userfault", start_userfault, stop_fd },
	{ "huge", start_huge, stop_huge },
	{ "nested", start_nested, NULL },
	{ "strict", start_strict, NULL },
	{ "filter", start_filter, NULL },
	{ "groups", start_groups, NULL },
	{ "hugefile", start_hugefile, stop_huge },
	{ "folder", start_folder, NULL },
	{ "files", start_files, NULL },
	{ "network", start_network, stop_network },
	{ "bounds", start_bounds, NULL },
	{ "locked", start_locked, NULL },
	{ "locked-child", start_locked_child, NULL },
	{ "rooted-child", start_rooted_child, NULL },
	{ "unfiltered-child", start_unfiltered_child, NULL },
	{ "other-filter", start_other_filter, NULL },
	{ "user", start_user, NULL },
	{ "dropped", start_dropped, NULL },
	{ "vfork", start_vfork, NULL },
	{ "vdso", start_vdso, NULL },
	{ "siblings-files", start_siblings_files, NULL },
	{ "dispatch", start_dispatch, stop_dispatch },
	{ "limited", start_limited, stop_limited },
	{ "ring", start_ring, stop_ring },
	{ "secret", start_secret, stop_file },
	{ "future", start_future, stop_file },
	{ "stuck", start_stuck, stop_stuck },
};

int main(int argc, char **argv)
{
	const struct kind *kind = kinds, *end = kinds + sizeof(kinds) / sizeof(kinds[0]);
	uint64_t from_ns, to_ns = 0;
	bool on_signal;
	sigset_t usr1;

	victim_start(&argc, argv, 1, "KIND [AFTER_SECONDS [FOR_SECONDS]]");
	while (kind < end && strcmp(kind->name, argv[1]))
		kind++;
	if (kind == end) {
		fprintf(stderr, "unsupported: no kind is called %s\n", argv[1]);
		return 2;
	}
	sigemptyset(&usr1);
	sigaddset(&usr1, SIGUSR1);
	sigprocmask(SIG_BLOCK, &usr1, NULL);
	on_signal = argc > 2 && !strcmp(argv[2], "signal");
	from_ns = on_signal ? UINT64_MAX
			    : now_ns() + (uint64_t)((argc > 2 ? atof(argv[2]) : 0) * 1e9);
	board->counter[0] = 0;
	room = victim_memory(1 << 20, false);
	while (now_ns() < from_ns || !board->counter[0]) {
		if (on_signal && sigtimedwait(&usr1, NULL, &(struct timespec){ 0 }) == SIGUSR1)
			from_ns = now_ns();
		if (now_ns() >= from_ns) {
			if (!kind->start())
				unavailable(kind->name);
			board->counter[0] = 1;
		}
		if (!board->ready)
			victim_ready();
		beat();
		nap_us(1000);
	}
	if (argc > 3 && atof(argv[3]) > 0)
		to_ns = from_ns + (uint64_t)(atof(argv[3]) * 1e9);
	for (;;) {
		if (to_ns && now_ns() >= to_ns && kind->stop) {
			kind->stop();
			to_ns = 0;
			board->counter[0] = 0;
		}
		if (dispatched)
			be_dispatched();
		if (strict)
			be_strict();
		beat();
		nap_us(1000);
	}
}
