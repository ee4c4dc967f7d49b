# SPDX-License-Identifier: Apache-2.0
"""Processes of ours that are forked off one which has imported what they import: most of what their start costs.

They inherit from that one, not from the test, what a process inherits: limits, CPUs, control group.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.reduction
import os
import signal
import subprocess
import sys
import weakref
from collections.abc import Callable, Sequence
from typing import Any

_CONTEXT = multiprocessing.get_context("forkserver")
_preloaded: list[str] = []


def preload(module: str) -> None:
    """From the first fork on, each has that module.  To be called when a module of the testkit is imported."""
    _preloaded.append(module)
    _CONTEXT.set_forkserver_preload(_preloaded)


class _Descriptor:
    """What is pickled for the new process is a duplicate."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple[Callable[..., int], tuple[object]]:
        return _number_there, (multiprocessing.reduction.DupFd(self.number),)


def _number_there(duplicate: Any) -> int:
    number: int = duplicate.detach()
    return number


class Forked:
    """Runs a function of a module as the main program, with these arguments; as subprocess.Popen where tests use it."""

    def __init__(
        self,
        main: Callable[[], None],
        arguments: Sequence[str],
        *,
        stdin: int = 0,
        stdout: int = 1,
        stderr: int = 2,
        env: dict[str, str] | None = None,
    ) -> None:
        standard = [_Descriptor(number) for number in (stdin, stdout, stderr)]
        self._process = _CONTEXT.Process(target=_be, args=(main, list(arguments), standard, env or dict(os.environ)))
        self._process.start()
        assert self._process.pid is not None
        self.pid: int = self._process.pid
        # Nobody but the process that forked it takes its end.
        self._pidfd = os.pidfd_open(self.pid)
        weakref.finalize(self, os.close, self._pidfd)

    @property
    def returncode(self) -> int | None:
        """None while it runs."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """The same."""
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """Its exit status.  Raises subprocess.TimeoutExpired."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("avckpt", timeout or 0.0)
        return self._process.exitcode

    def send_signal(self, signum: int) -> None:
        """Nothing, if it has ended."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._pidfd, signum)

    def kill(self) -> None:
        """SIGKILL."""
        self.send_signal(signal.SIGKILL)


def _be(main: Callable[[], None], arguments: list[str], standard: list[int], env: dict[str, str]) -> None:
    for number, descriptor in enumerate(standard):
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.environ.clear()
    os.environ.update(env)
    sys.argv[1:] = arguments
    main()
