/* SPDX-License-Identifier: Apache-2.0
 *
 * Seccomp filters for victims that put themselves under some.
 */
#ifndef VICTIM_CONFINE_H
#define VICTIM_CONFINE_H

#include <linux/filter.h>
#include <linux/seccomp.h>
#include <stddef.h>
#include <sys/prctl.h>

#include "victim.h"

/* In a filter that has loaded the call's number. */
#define ALLOW(nr)                                        \
	BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, (nr), 0, 1), \
		BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW)

/* What a filter has to allow for its application to be protected (native/engine/trace/seccomp_calls.c). */
#define ALLOW_HOMEWARD                                                                             \
	ALLOW(SYS_rt_sigprocmask), ALLOW(SYS_rt_sigreturn), ALLOW(SYS_munmap), ALLOW(SYS_madvise), \
		ALLOW(SYS_exit)

static inline void install_filter(struct sock_filter *filter, size_t length, unsigned int flags)
{
	struct sock_fprog program = { (unsigned short)length, filter };

	must(!prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), "PR_SET_NO_NEW_PRIVS");
	must(!syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, flags, &program), "seccomp");
}

#endif
