# SPDX-License-Identifier: Apache-2.0
"""Runs a command in a container, bounded in time: health checks, notifications.

The command runs as with `podman exec`: in the container's namespaces and
control groups, with the user, groups, capabilities, resource limits, seccomp
filters, environment and working directory of the container's main process. It
has its own session and no parent in there, so that neither the application nor
its checkpoints notice. What the program `avckpt-exec` does is in
native/exec/exec.c; here it is started and waited for, without a thread.

AppArmor profiles and SELinux labels of the container are not applied.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import functools
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from avckpt_hooks.shared.files import TooLong, read_bounded
from avckpt_hooks.shared.tell import printable

from avckpt.artifacts import inside_binary
from avckpt.containers.cgroup import groups_of
from avckpt.containers.looks import in_own_thread, look
from avckpt.containers.process import has_ended, pid_of, status
from avckpt.errors import AvckptError, KernelError, TargetGone

ENVIRONMENT_BYTES = 1 << 20
"""A process can set the place and length of its environment itself (PR_SET_MM); execve(2) allows 6 MB."""
OUTPUT_BYTES = 4096
"""How much of a command's output is kept; the rest is read and discarded, ..."""
OUTPUT_S = 0.01
"""... a pipe full in this time at most: one that never stops writing must not keep us busy."""
GROUPS_MOST = 1024
"""The kernel allows 65536, each of which would have to be converted."""
GRACE_S = 2.0
"""How long after the timeout the helper itself is killed, which should have killed the command."""
KILL_S = 0.5
"""How long the helper has to kill its command when it is told to."""


@dataclass(frozen=True)
class Done:
    """A command that has exited, or was killed."""

    status: int
    """Exit status, 128+N if signal N killed it, 127 if there is no such program."""
    timed_out: bool
    output: str
    """The beginning of stdout and stderr together."""
    took_s: float


async def run_inside(
    init_pidfd: int,
    command: Sequence[str],
    *,
    timeout_s: float,
    stdin: bytes = b"",
    env: Mapping[str, str] | None = None,
) -> Done:
    """Runs `command` in the container of which `init_pidfd` is avckpt-init; `env` is added to its environment.

    After `timeout_s` it is killed, with its process group.  Takes the pidfd's
    container as it is now; the pidfd stays the caller's.

    Raises TargetGone when the container has ended, AvckptError when the command
    cannot be started in there.  Precondition: the event loop's main thread.
    """
    pid = pid_of(init_pidfd)
    if not pid:
        raise TargetGone("the container has ended")
    try:
        credentials, groups = _credentials(pid)
        procs = [str(path) for path in groups_of(pid).procs if os.access(path, os.W_OK)]
        environ = await look("environment", pid, lambda: read_bounded(f"/proc/{pid}/environ", ENVIRONMENT_BYTES))
    except (FileNotFoundError, ProcessLookupError) as error:
        raise TargetGone("the container has ended", pid=pid) from error
    except TooLong as error:
        raise AvckptError(f"its environment is longer than {ENVIRONMENT_BYTES} bytes", pid=pid) from error
    environment = _with(environ, env or {})
    with contextlib.ExitStack() as undo:
        stdin_fd = _memory_file(undo, "avckpt-stdin", stdin)
        env_fd = _memory_file(undo, "avckpt-env", environment)
        output, output_end = _pipe(undo)
        failure, failure_end = _pipe(undo)
        program = _sealed_program()
        argv = [
            *("avckpt-exec", str(init_pidfd), str(pid), str(max(int(timeout_s * 1000), 1))),
            *(str(failure_end), str(env_fd), credentials, str(len(groups)), *groups),
            *(str(len(procs)), *procs, *command),
        ]
        # Checked only now: what was read above belongs to this container.
        if has_ended(init_pidfd):
            raise TargetGone("the container has ended", pid=pid)
        started = time.monotonic()
        try:
            process = subprocess.Popen(
                argv,
                executable=f"/proc/self/fd/{program}",
                stdin=stdin_fd,
                stdout=output_end,
                stderr=output_end,
                env={},
                cwd="/",
                pass_fds=(init_pidfd, failure_end, env_fd, program),
            )
        except OSError as error:
            raise KernelError("avckpt-exec cannot be started", syscall="execve", errno=error.errno or 0) from error
        os.close(output_end)
        os.close(failure_end)
        kept = await _wait(process, output, timeout_s + GRACE_S)
        took_s = time.monotonic() - started
        said = printable(os.read(failure, 512).decode(errors="replace").strip()) if _readable(failure) else ""
    timed_out = said == "timeout" or process.returncode in (-signal.SIGALRM, -signal.SIGKILL)
    if said and not timed_out:
        if has_ended(init_pidfd):
            raise TargetGone("the container has ended", pid=pid)
        raise AvckptError(f"a command cannot be run in the container: {said}", pid=pid)
    return Done(process.returncode, timed_out, kept.decode(errors="replace").strip(), took_s)


async def _wait(process: subprocess.Popen[bytes], output: int, timeout_s: float) -> bytes:
    """Waits for the helper's end and keeps the beginning of the output; does not wait for the output's end."""
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    kept = bytearray()

    later: asyncio.TimerHandle | None = None

    def read() -> bool:
        """Whether there may be more."""
        with contextlib.suppress(BlockingIOError):
            text = os.read(output, 65536)
            kept.extend(text[: OUTPUT_BYTES - len(kept)])
            return bool(text)
        return True

    def drain() -> None:
        nonlocal later
        loop.remove_reader(output)
        if read():
            later = loop.call_later(OUTPUT_S, loop.add_reader, output, drain)

    pidfd = os.pidfd_open(process.pid)
    loop.add_reader(pidfd, ended.set)
    loop.add_reader(output, drain)
    ending = None
    try:
        await asyncio.wait_for(ended.wait(), timeout_s)
    except asyncio.TimeoutError:
        pass
    finally:
        loop.remove_reader(pidfd)
        # Both at once: output is closed next, and its number may be another reader's then.
        loop.remove_reader(output)
        if later is not None:
            later.cancel()
        os.close(pidfd)
        if not ended.is_set():
            # On request, it kills the command's whole process group; if killed itself, only the command dies
            # with it (PR_SET_PDEATHSIG).
            process.terminate()
            ending = in_own_thread(functools.partial(_end, process))
    if ending is None:
        process.wait()
    else:
        await ending
    read()
    return bytes(kept)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Waits for the helper, which waits for its command: that may not end even when it is killed (state D)."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(KILL_S)
    process.kill()
    process.wait()


def _credentials(pid: int) -> tuple[str, list[str]]:
    """What avckpt-exec needs from /proc/PID/status: UID:GID:capabilities:NNP, and the
    groups.

    The ids are converted to the container's user namespace, where they are set: /proc
    shows those of ours.
    """
    fields = status(pid)
    uid = _inside(int(fields["Uid"].split()[1]), Path(f"/proc/{pid}/uid_map").read_text())
    gid_map = Path(f"/proc/{pid}/gid_map").read_text()
    gid = _inside(int(fields["Gid"].split()[1]), gid_map)
    if uid is None or gid is None:
        raise AvckptError("its main process has a user or group that its user namespace does not", pid=pid)
    all_groups = fields["Groups"].split()
    if len(all_groups) > GROUPS_MOST:
        raise AvckptError(f"its main process is in more than {GROUPS_MOST} groups", pid=pid)
    sets = [fields[name] for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")]
    # A group without an id in there (one kept from the host) cannot be set.
    groups = [_inside(int(group), gid_map) for group in all_groups]
    return (
        ":".join([str(uid), str(gid), *sets, fields["NoNewPrivs"]]),
        [str(group) for group in groups if group is not None],
    )


def _inside(number: int, id_map: str) -> int | None:
    """Converts a UID or GID of ours to the user namespace of a uid_map or gid_map; None: unmapped."""
    for line in id_map.splitlines():
        first, ours, count = map(int, line.split())
        if ours <= number < ours + count:
            return first + number - ours
    return None


def _with(environ: bytes, more: Mapping[str, str]) -> bytes:
    kept = [
        entry
        for entry in environ.split(b"\0")
        if entry and entry.partition(b"=")[0].decode("utf-8", "replace") not in more
    ]
    kept += [f"{key}={value}".encode() for key, value in more.items()]
    return b"".join(entry + b"\0" for entry in kept)


def _memory_file(undo: contextlib.ExitStack, name: str, content: bytes) -> int:
    fd = os.memfd_create(name)
    undo.callback(os.close, fd)
    os.write(fd, content)
    os.lseek(fd, 0, os.SEEK_SET)
    return fd


def _pipe(undo: contextlib.ExitStack) -> tuple[int, int]:
    """A pipe whose read end does not block; the write end may be closed early."""
    read_end, write_end = os.pipe2(os.O_CLOEXEC)
    os.set_blocking(read_end, False)
    undo.callback(os.close, read_end)
    undo.callback(_close_if_open, write_end, os.fstat(write_end).st_ino)
    return read_end, write_end


def _close_if_open(fd: int, inode: int) -> None:
    with contextlib.suppress(OSError):
        if os.fstat(fd).st_ino == inode:
            os.close(fd)


def _readable(fd: int) -> bool:
    import select

    poller = select.poll()  # select(2) takes no descriptor above 1023
    poller.register(fd, select.POLLIN)
    return bool(poller.poll(0))


@functools.cache
def _sealed_program() -> int:
    """avckpt-exec in sealed memory, which cannot be written even through /proc/PID/exe in a container."""
    fd = os.memfd_create("avckpt-exec", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        content = inside_binary().read_bytes()
        while content:
            content = content[os.write(fd, content) :]
        fcntl.fcntl(
            fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_SEAL
        )
    except BaseException:
        os.close(fd)
        raise
    return fd
