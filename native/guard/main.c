/* SPDX-License-Identifier: Apache-2.0
 *
 * avckpt-guard: the process that protects one container.  The daemon starts it
 * (client.c), with its end of a socket as descriptor AVC_GUARD_FD.
 *
 *   avckpt-guard guards, as the daemon requests (avckpt/guard.h)
 *   avckpt-guard --probe  writes a struct avc_error there: whether it could
 *
 * A failure in here costs only one container its protection, briefly: memory, descriptors and
 * privileges are separate for each guard.
 */
#include <linux/capability.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "avckpt/guard.h"
#include "guard.h"

#define DESCRIPTORS_MAX 32768 /* a template's are examined one by one, and a few of each kept */
#define MEMORY_MAX (UINT64_C(1) << 30)
#define REFUSED 4 /* exit status: it could not be confined                          */

/* What a guard uses each for. All others are dropped for good. */
static const uint8_t needed[] = {
	CAP_SYS_PTRACE,         /* ptrace(2), process_vm_*(2), /proc/PID of others         */
	CAP_SYS_ADMIN,          /* PTRACE_O_SUSPEND_SECCOMP, setns(2), pagemap, perf events */
	CAP_CHECKPOINT_RESTORE, /* ns_last_pid, /proc/PID/map_files                        */
	CAP_KILL,               /* templates have the application's user                   */
	CAP_SYS_RESOURCE,       /* prlimit(2) beyond a hard limit, oom_score_adj           */
	CAP_SYS_NICE,           /* SCHED_RR while an application waits                   */
	CAP_DAC_OVERRIDE,       /* sockets and files in the container, of its users        */
	CAP_DAC_READ_SEARCH,
	CAP_FOWNER,
	CAP_CHOWN,
	CAP_FSETID,
	CAP_SETUID, /* the same, as its users                                  */
	CAP_SETGID,
	CAP_SETPCAP,    /* to drop capabilities */
	CAP_NET_ADMIN,  /* TCP_REPAIR, SO_*BUFFORCE                                */
	CAP_NET_RAW,    /* raw sockets that are recreated */
	CAP_SYS_CHROOT, /* setns(2) into a mount namespace                         */
	CAP_IPC_OWNER,  /* System V objects                                        */
	CAP_IPC_LOCK,   /* locked memory of the application                        */
};

static int limit(int which, uint64_t most)
{
	struct rlimit now;

	if (getrlimit(which, &now))
		return -1;
	if (now.rlim_max == RLIM_INFINITY || now.rlim_max > most)
		now.rlim_max = most;
	now.rlim_cur = now.rlim_max;
	return setrlimit(which, &now);
}

static int drop_capabilities(void)
{
	struct __user_cap_header_struct header = { .version = _LINUX_CAPABILITY_VERSION_3 };
	struct __user_cap_data_struct data[2] = { 0 };
	uint64_t keep = 0;

	for (size_t i = 0; i < sizeof needed / sizeof *needed; i++)
		keep |= UINT64_C(1) << needed[i];
	/* The first one unknown to the kernel ends the loop. */
	for (int cap = 0; prctl(PR_CAPBSET_READ, cap, 0, 0, 0) >= 0; cap++)
		if (!(keep >> cap & 1) && prctl(PR_CAPBSET_DROP, cap, 0, 0, 0))
			return -1;
	if (syscall(SYS_capget, &header, data))
		return -1;
	for (int i = 0; i < 2; i++) {
		data[i].permitted &= (uint32_t)(keep >> 32 * i);
		data[i].effective = data[i].permitted;
		data[i].inheritable = 0;
	}
	return syscall(SYS_capset, &header, data) ||
			       prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_CLEAR_ALL, 0, 0, 0)
		       ? -1
		       : 0;
}

/* Its memory holds parts of applications: no core file, no access without CAP_SYS_PTRACE. */
static int confine(void)
{
#ifdef __SANITIZE_ADDRESS__
	return drop_capabilities(); /* it reserves terabytes, and finds leaks by ptrace(2) */
#endif
	return limit(RLIMIT_NOFILE, DESCRIPTORS_MAX) || limit(RLIMIT_DATA, MEMORY_MAX) ||
			       limit(RLIMIT_CORE, 0) || drop_capabilities() ||
			       prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) ||
			       prctl(PR_SET_DUMPABLE, 0, 0, 0, 0)
		       ? -1
		       : 0;
}

int main(int argc, char **argv)
{
	struct avc_error error = { 0 };

	if (argc == 2 && !strcmp(argv[1], "--probe")) {
		(void)guard_probe(&error);
		return write(AVC_GUARD_FD, &error, sizeof error) == sizeof error ? 0 : 1;
	}
	return confine() ? REFUSED : guard_run(AVC_GUARD_FD);
}
