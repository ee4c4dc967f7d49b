# SPDX-License-Identifier: Apache-2.0
"""`avckpt run --label avckpt.scope=nodes`: what a launcher starts by $AVCKPT_INIT, with no sidecar.

As in run.py, but that avckpt-init in front of the launcher is a plain init, and each node gets a
guard of its own when it says so on our socket.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import selectors
import shutil
import socket
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from avckpt.budget import CpuBudget
from avckpt.cli.run import Job, Supervisor, limited, say
from avckpt.containers import units
from avckpt.containers.process import has_ended, pid_of, status
from avckpt.containers.strangers import let_go, receive
from avckpt.engine import Engine, Guard
from avckpt.errors import AvckptError, Busy, Denied
from avckpt.events.journal import Journal
from avckpt.events.record import of_guard
from avckpt.events.vocabulary import Kind
from avckpt.guard import Event, GuardConfig
from avckpt.policy import settings_of

LOOK_S = 0.02
"""Seconds between looks whether the init in front of the launcher takes signals already."""


@dataclass
class _Node:
    name: str
    peer: units.Peer
    guard: Guard
    config: GuardConfig
    """By its labels."""
    share: float
    """Of a CPU, as its guard was told."""
    journal: Journal = field(default_factory=Journal)


@contextlib.contextmanager
def socket_for_nodes(init: Path) -> Iterator[socket.socket]:
    """Where nodes register, which the environment tells them."""
    directory = Path(tempfile.mkdtemp(prefix="avckpt-"))
    try:
        directory.chmod(0o711)  # a launcher may start them as somebody else
        path = directory / "units.sock"
        with units.listen(path) as listening:
            os.environ.update({"AVCKPT_INIT": str(init), "AVCKPT_UNITS": str(path)})
            os.environ.pop("AVCKPT_UNIT", None)
            yield listening
    finally:
        shutil.rmtree(directory, ignore_errors=True)


class NodesSupervisor(Supervisor):
    """Forwards signals, guards nodes and tells events until the launcher's init has ended."""

    def __init__(self, name: str, init_pidfd: int, signals_fd: int, verbose: bool, job: Job | None) -> None:
        super().__init__(name, init_pidfd, signals_fd, verbose, job)
        self._pid = pid_of(init_pidfd)
        self._nodes: dict[int, _Node] = {}
        self._cookies = itertools.count(1)
        self._cpu = CpuBudget()
        self._engine: Engine
        self._selector: selectors.BaseSelector
        self._listening: socket.socket
        self._labels: Mapping[str, str]

    def watch_nodes(self, listening: socket.socket, labels: Mapping[str, str]) -> None:
        """Guards whoever registers; the labels hold for all of them.  Returns when init has ended."""
        self._listening, self._labels = listening, labels
        with Engine() as self._engine, selectors.DefaultSelector() as self._selector:
            for fd in (self._pidfd, self._engine.event_fd, self._signals_fd, self._listening):
                self._selector.register(fd, selectors.EVENT_READ)
            while not has_ended(self._pidfd):
                wait_s = None if self._job is None else Job.LOOK_EVERY_S
                for key, _ in self._selector.select(wait_s if self._ready else LOOK_S):
                    if key.fileobj == self._signals_fd:
                        self._take_signals()
                    elif key.fileobj is self._listening:
                        self._accept()
                    elif isinstance(key.fileobj, socket.socket):
                        self._serve(key.fileobj, key.data)
                    elif key.data is not None:
                        self._end(key.data)
                if not self._ready and self._takes_signals():
                    self._become_ready()
                self._take_events(self._engine)
                if self._job is not None:
                    self._job.look()
            for cookie in list(self._nodes):
                self._end(cookie)
            self._take_events(self._engine)

    def _takes_signals(self) -> bool:
        """It has blocked them all, and reads them: before that the kernel drops them."""
        with contextlib.suppress(OSError, KeyError):
            return int(status(self._pid)["SigBlk"], 16) & 0x7FFF == 0x7FFF & ~(1 << 8)
        return True  # it has ended

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionAbortedError):
            connection, _ = self._listening.accept()
            connection.setblocking(False)
            if sum(isinstance(key.fileobj, socket.socket) for key in self._selector.get_map().values()) > 64:
                let_go(connection.detach())
            else:
                self._selector.register(connection, selectors.EVENT_READ)

    def _serve(self, readable: socket.socket, connection: socket.socket | None) -> None:
        """There is a request; or it has been read, of that connection."""
        if connection is None:
            self._selector.unregister(readable)
            try:
                self._selector.register(receive(readable, units.UNIT_BYTES), selectors.EVENT_READ, readable)
            except (OSError, RuntimeError):  # too many files or threads: it tries again
                let_go(readable.detach())
            return
        with contextlib.suppress(BlockingIOError):
            refused = units.serve(connection, readable, self._register)
            self._selector.unregister(readable)
            readable.close()
            if refused is not None:
                let_go(connection.detach())
                say(f"refused a unit: {refused.partition(' ')[2]}")

    def _register(self, claim: units.Claim, peer: units.Peer) -> None:
        if units.pid_namespace(peer.pid) != units.pid_namespace(self._pid):
            raise Denied("it was not started by this launcher")
        inits = {node.peer.pid: node for node in self._nodes.values()}
        for pid in units.ancestors(peer.pid):
            if pid in inits:
                raise Denied(f"it is part of {inits[pid].name}, which is protected as a whole")
        if peer.pid in inits:
            raise Busy("it is registered already")
        if len(inits) >= units.UNITS_MOST:
            raise Busy(f"there are {units.UNITS_MOST} units already")
        config = settings_of(units.labels_of_node(claim.labels, self._labels)).config
        cookie = next(self._cookies)
        config = limited(replace(config, remains_s=0.0), peer.pid)
        share = self._cpu.share(cookie, config, time.monotonic())
        guard = self._engine.start_guard(peer.pidfd, replace(config, budget_cpu=share), cookie)
        name = units.unique_name(claim.name, [node.name for node in self._nodes.values()])
        self._nodes[cookie] = _Node(name, peer, guard, config, share)
        self._selector.register(peer.pidfd, selectors.EVENT_READ, cookie)

    def _end(self, cookie: int) -> None:
        node = self._nodes[cookie]
        self._selector.unregister(node.peer.pidfd)
        node.guard.stop()
        self._take_events(self._engine)
        del self._nodes[cookie]
        os.close(node.peer.pidfd)
        let_go(node.peer.connection.detach())

    def _take_events(self, engine: Engine) -> None:
        while (event := engine.next_event()) is not None:
            node = self._nodes.get(event.cookie)
            if node is None:
                continue
            if event.kind is Kind.CHECKPOINT:
                self._share_cpu(event, node)
            line = node.journal.line(of_guard(event))
            if line is None:
                continue
            level, text = line
            quiet = level < logging.WARNING or event.kind is Kind.MISSED
            if self._verbose or not quiet:
                say(f"{node.name}: {text}")

    def _share_cpu(self, taken: Event, node: _Node) -> None:
        """It has taken checkpoints; others that also do have begun or ended."""
        share = self._cpu.share(taken.cookie, node.config, time.monotonic(), taken)
        if share != node.share:
            # One that cannot be told now is ending, or is told after its next one.
            with contextlib.suppress(AvckptError):
                node.guard.configure(replace(node.config, budget_cpu=share))
                node.share = share
