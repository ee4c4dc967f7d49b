# SPDX-License-Identifier: Apache-2.0
"""The sidecar's daemon: one guard per protected container.

asyncio, one thread. It sleeps until something happens: a hook's request, an event of a guard,
an init that exits, an API request, a signal, or a timer to check guards and records. What is
urgent (death to resume) happens in the guards, which are separate processes.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import itertools
import logging
import math
import os
import signal
import socket
import time
from collections.abc import Coroutine, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from avckpt_hooks.shared.labels import Notify
from avckpt_hooks.shared.protocol import Deregister, Register

from avckpt import __version__
from avckpt.api.server import ApiServer
from avckpt.budget import CpuBudget
from avckpt.config import PATH as CONFIG_PATH
from avckpt.config import Configuration
from avckpt.containers import cgroup, units
from avckpt.containers.listener import HookListener
from avckpt.containers.looks import in_own_thread
from avckpt.containers.names import Names
from avckpt.containers.presence import Presence
from avckpt.containers.process import has_ended, is_foreign, pid_of
from avckpt.containers.protected import Protected, State
from avckpt.containers.records import NOT_SEEN, Records, keep_hooks_folders
from avckpt.containers.registry import Registry
from avckpt.containers.strangers import let_go
from avckpt.engine import Engine, Guard
from avckpt.engine import version as native_version
from avckpt.errors import (
    AvckptError,
    Busy,
    ConfigError,
    Denied,
    LabelsWrong,
    NothingToRestore,
    Paused,
    TargetGone,
    Unprotected,
)
from avckpt.events.archive import archive_of
from avckpt.events.container_log import ContainerLog
from avckpt.events.feed import Feed
from avckpt.events.history import History
from avckpt.events.journal import Journal
from avckpt.events.log import Log
from avckpt.events.metrics import Metrics
from avckpt.events.record import EventRecord, of_guard
from avckpt.events.system_journal import SystemJournal
from avckpt.events.vocabulary import Kind, Reason
from avckpt.evidence.inquests import Inquests
from avckpt.guard import Command, Event, GuardConfig, generation_to_json
from avckpt.lock import Lock
from avckpt.orders import Orders
from avckpt.policy import Reloaded, Settings, changes, settings_of
from avckpt.supervision import watchdog
from avckpt.supervision.caretaker import Caretaker
from avckpt.supervision.groups import Groups
from avckpt.supervision.notify import Notifier

log = logging.getLogger("avckpt")

LOOK_S = 5.0
"""Seconds between retries for containers that could not be protected at start."""
GUARD_LOOK_S = 1.0
"""Seconds between checks whether guards are alive."""
GUARD_PATIENCE_S = 5.0
"""A guard that gives no sign of life for this long is killed and replaced."""
EVENTS_AT_ONCE = 64
EVENTS_QUEUED = 4096
"""QUEUE_MAX of native/guard/client.c."""
GUARD_AGAIN_S = 30.0
"""A guard that is lost sooner than this after the previous one is replaced at the next scan, not at once."""


@dataclass
class Watch:
    """What the daemon holds for one live container: its own pidfd of init, and the guard."""

    container: Protected
    pidfd: int
    labels: Mapping[str, str]
    settings: Settings
    request: Register
    """What a sidecar that starts later has to know."""
    rolling_back: Reason | None = None
    """The reason for a commanded rollback that is still unanswered."""
    journal: Journal = field(default_factory=Journal)
    guard: Guard | None = None
    guard_lost_s: float = -math.inf
    """When a guard was lost last, time.monotonic()."""
    bundle: str = ""
    """Its OCI bundle, on the host."""
    connection: socket.socket | None = None
    """A unit's connection: when it closes, avckpt-init looks for another sidecar."""
    units: units.Allowance = field(default_factory=units.Allowance)
    """Of a launcher's container."""
    space: int = 0
    """Its PID namespace; 0: it is no launcher's."""
    own_log: ContainerLog = field(default_factory=ContainerLog)

    @property
    def notify(self) -> Notify | None:
        """How to notify it of others."""
        return self.settings.policy.notify

    @property
    def notify_self(self) -> Notify | None:
        """How to notify it of its own recoveries."""
        return self.settings.policy.notify_self


class Daemon:
    """The whole state of the sidecar. `run()` it once."""

    def __init__(self, run_dir: Path, config_path: Path, beat_fd: int = -1, lock: Lock | None = None) -> None:
        self.run_dir = run_dir
        self._lock = lock
        self._listeners: list[ApiServer | HookListener | units.UnitListener] = []
        self._misplaced = ""
        """What was wrong with the runtime directory at the last look."""
        self._beat_fd = beat_fd
        self.configuration = Configuration(config_path)
        self.registry = Registry()
        self.records = Records(run_dir / "containers")
        self.feed = Feed()
        self.history = History(run_dir / "history.jsonl", archive=archive_of(run_dir))
        self._system_journal = SystemJournal()
        self.metrics = Metrics(__version__, native_version())
        self.notifier = Notifier(self._tell_of_notification)
        self.caretaker: Caretaker[Watch] = Caretaker(run_dir, self.tell)
        self.inquests: Inquests[Watch] = Inquests(self.tell, self.history, run_dir / "cores", self._app_pids)
        self.started_at = time.time()
        self._engine = Engine()
        self._watches: dict[int, Watch] = {}
        self._cookies = itertools.count(1)
        self.orders = Orders()
        self._endings: set[asyncio.Task[None]] = set()
        self._host_units = units.Allowance()
        self._names = Names()
        self._presence = Presence(run_dir / "present.json")
        self._log = Log()
        self.groups = Groups(self.orders, self._log)
        self._cpu = CpuBudget()

    async def run(self) -> None:
        """Serves until SIGTERM or SIGINT, then releases every container, unprotected.

        Raises OSError when a socket cannot be made.
        """
        loop = asyncio.get_running_loop()
        stop = asyncio.Event()
        for signum in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(signum, stop.set)
        loop.add_signal_handler(signal.SIGHUP, self._reload_on_signal)
        try:
            self.configuration.load()
        except ConfigError as error:
            # A wrong interval is better than no sidecar.
            log.error("the built-in defaults hold: %s", error)
        if self.configuration.path != CONFIG_PATH and not self.configuration.problem:
            self._say_what_holds()  # somebody has named that file
        self._cpu.total = self.configuration.defaults.cpu_total
        loop.add_reader(self._engine.event_fd, self._take_events)
        api = ApiServer(self, self.run_dir / "api.sock")
        # Listen first, adopt second: a container that starts in between is then seen twice, not missed.
        hooks = HookListener(self.run_dir / "hooks.sock", self._hook)
        nodes = looking = None
        try:
            if self._beat_fd >= 0:
                self._beat()
            self.inquests.start()
            self.caretaker.start()
            await api.start()
            self._adopt()
            # After the containers that they are in.
            path = self.run_dir / "units" / "units.sock"
            nodes = units.UnitListener(path, self._register_unit, self._is_launchers)
            self._listeners = [api, hooks, nodes]
            looking = loop.create_task(self._keep_catching_up())
            log.info("avckpt %s is ready, %d container(s) found", __version__, len(self._watches))
            outage = self._presence.since_then(self.registry.live(), self.records.has)
            if outage:
                self._tell_of_itself(Kind.SIDECAR_STARTED, outage)
            await stop.wait()
            log.info("asked to stop: %d container(s) run on unprotected", len(self._watches))
            self._presence.stop(self.registry.live())
            self._tell_of_itself(Kind.SIDECAR_STOPPED, f"{len(self._watches)} container(s) run on unprotected")
        finally:
            if looking is not None:
                looking.cancel()
            hooks.close()
            if nodes is not None:
                nodes.close()
            self.feed.close()
            await api.close()
            await self.groups.close()
            await self.notifier.close()
            await self.caretaker.close()
            for watch in list(self._watches.values()):
                self._begin_end(watch)
            while self._endings:
                await asyncio.wait(self._endings)
            await self.inquests.close()
            loop.remove_reader(self._engine.event_fd)
            self._engine.close()
            self.history.close()
            self._system_journal.close()

    def _beat(self) -> None:
        """Gives signs of life to the watchdog, from now on while the loop runs."""
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._beat_fd, b".")
        asyncio.get_running_loop().call_later(watchdog.LOOK_S, self._beat)

    async def command(self, name: str, command: Command, generation: int = 0) -> tuple[Protected, EventRecord]:
        """Gives a command to a container and waits for the answer; `generation` to restore, 0: the newest.

        Raises NoSuchContainer, Ambiguous, Unprotected, NothingToRestore, Paused,
        DeadlineMissed, TargetGone, or the engine's own error.
        """
        watch = self._watches[self.registry.find(name).cookie]
        container = watch.container
        if watch.guard is None:
            if container.state is State.NODES:
                name = container.label
                raise Unprotected(f"{name} is a launcher: name one of its nodes, as {name}/NODE (avckpt ps lists them)")
            raise Unprotected(f"{container.label} runs unprotected: {container.reason}")
        if command is Command.RESTORE and container.generations == 0:
            raise NothingToRestore(f"{container.label} has nothing to go back to: {container.reason}")
        if cgroup.is_paused(container.init_pid):
            raise Paused(f"{container.label} is paused: `podman unpause {container.label}` first")
        if watch.settings.policy.together and command in (Command.CHECKPOINT, Command.RESTORE):
            return container, await self.groups.command(watch, command, generation)
        try:
            if command is Command.RESTORE:
                watch.rolling_back = Reason.COMMAND
            return container, await self.orders.give(watch.guard, container, command, generation)
        finally:
            if command is Command.RESTORE:
                watch.rolling_back = None

    async def inspect(self, name: str) -> dict[str, object]:
        """All that is known about a container. Raises NoSuchContainer, Ambiguous, DeadlineMissed or
        TargetGone."""
        watch = self._watches[self.registry.find(name).cookie]
        container = watch.container
        held = await self.orders.held(watch.guard, container) if watch.guard is not None else []
        return {
            "container": container.to_json(),
            "settings": watch.settings.in_force,
            "generations": [generation_to_json(event) for event in held],
            "crashes": [record.to_json() for record in self.inquests.crashes_of(container)],
        }

    def _say_what_holds(self) -> None:
        path = self.configuration.path
        if self.configuration.found:
            log.info("%s was read", path)
        else:
            log.warning("no %s: the built-in defaults hold", path)

    def reload(self) -> list[Reloaded]:
        """Reloads the configuration file for all containers, including those missed so far.

        Running ones keep their guard and its generations. Returns those for which something
        changed, or should have. Raises ConfigError, and nothing changes, when the file is
        wrong.
        """
        self.configuration.load()
        self._cpu.total = self.configuration.defaults.cpu_total
        self._say_what_holds()
        outcomes = [self._reconfigure(watch) for watch in list(self._watches.values())]
        self._catch_up()
        return [outcome for outcome in outcomes if outcome is not None]

    def _reconfigure(self, watch: Watch) -> Reloaded | None:
        container = watch.container
        try:
            after = self._settings_of(watch.labels, container.name)
            changed = tuple(changes(watch.settings, after))
            if not after.policy.guarded:  # it only listens
                changed = tuple(change for change in changed if change.setting in ("group", "notify"))
            if not changed:
                return None
            config = dataclasses.replace(
                after.config,
                memory_limit_bytes=container.config.memory_limit_bytes,
                tasks_max=container.config.tasks_max,
            )
            config = self._with_share(container, config, after.config)
            if watch.guard is not None:
                watch.guard.configure(config)
        except TargetGone:
            return None  # it is ending at this moment
        except AvckptError as error:
            self.tell(watch, EventRecord(Kind.CONFIGURED, detail="goes on with its old settings", error=error))
            return Reloaded(container.label, (), str(error))
        self.groups.leave(watch)
        watch.settings = after
        container.config = config
        container.group = after.policy.group
        self.groups.join(watch)
        self.caretaker.change(watch, after.policy)
        outcome = Reloaded(container.label, changed)
        self.tell(watch, EventRecord(Kind.CONFIGURED, detail=f"new settings: {outcome.what}"))
        return outcome

    def _reload_on_signal(self) -> None:
        try:
            self.reload()
        except ConfigError as error:
            log.error("the new configuration was refused, what was in force stays so: %s", error)

    def _settings_of(self, labels: Mapping[str, str], name: str) -> Settings:
        """The labels over the file.  Raises LabelsWrong when they do not go together."""
        return settings_of(self.configuration.defaults.under(labels, name))

    def _settings_at_start(self, labels: Mapping[str, str], name: str) -> tuple[Settings, LabelsWrong | None]:
        """The same, and what is wrong: then only the labels apply. Raises LabelsWrong when they are the
        problem."""
        try:
            return self._settings_of(labels, name), None
        except LabelsWrong as error:
            return settings_of(labels), error

    # Hooks and records

    def _hook(self, request: Register | Deregister, pidfd: int | None) -> None:
        if isinstance(request, Deregister):
            # Nothing to do: init's pidfd tells the same, and cannot be confused with a later run's.
            log.debug("%s: stopped, says its hook", request.id[:12])
        elif pidfd is not None:
            self._watch(request, pidfd, adopted=False)

    def _adopt(self) -> None:
        for record, pidfd in self.records.adoptable(lambda container_id: self._live_run(container_id) is not None):
            try:
                self._watch(record, pidfd, adopted=True)
            except (AvckptError, OSError) as error:
                self.records.complain(record.id, f"{record.name or record.id[:12]}: runs unprotected: {error}")

    def _catch_up(self) -> None:
        """Retries containers that could not be protected at start, for lack of descriptors, threads, memory
        or an answer."""
        self._adopt()
        self._look_at_names()
        self._presence.keep(self.registry.live())
        self._log.tell_what_is_left_out()
        for watch in list(self._watches.values()):
            if watch.guard is None and watch.settings.policy.guarded and not has_ended(watch.pidfd):
                self._start_guard(watch)

    def _look_at_names(self) -> None:
        """`podman rename` causes no event."""
        for watch in self._watches.values():
            container = watch.container
            before, name = container.name, self._names.of(container.id, watch.bundle, container.init_pid)
            if name and name != before:
                container.name = name
                if watch.settings.policy.guarded:
                    self.metrics.begin(name)
                self.tell(watch, EventRecord(Kind.CONFIGURED, detail=f"was called {before or 'nothing'} before"))

    async def _keep_catching_up(self) -> None:
        due_s = time.monotonic() + LOOK_S
        while True:
            guards = [watch.guard for watch in self._watches.values() if watch.guard is not None]
            for guard in guards:
                guard.check(GUARD_PATIENCE_S)
            await asyncio.sleep(GUARD_LOOK_S if guards else LOOK_S)
            if time.monotonic() < due_s:
                continue
            due_s = time.monotonic() + LOOK_S
            try:
                await self._keep_place()
                self._catch_up()
            except Exception:
                log.exception("looking for containers that are not protected; it is tried again")

    async def _keep_place(self) -> None:
        """Makes again what was removed of the runtime directory, or could not be written.

        Guards need nothing there: where that fails, containers that run stay protected, and the log says once
        that new ones are not.
        """
        problem = ""
        try:
            if self._lock is not None and not self._lock.is_in_place():
                self.run_dir.mkdir(mode=0o755, parents=True, exist_ok=True)
                self._lock.take()
                log.warning("%s was emptied: it is made again", self.run_dir)
                keep_hooks_folders(self.run_dir)
                self.history.write_again()
            for listener in self._listeners:
                if await listener.keep():
                    log.warning("a socket in %s was removed or replaced: it is made again", self.run_dir)
        except Busy as error:
            problem = f"{self.run_dir} was emptied: {error}"
        except OSError as error:
            problem = (
                f"{error.filename or self.run_dir} was removed and cannot be made again ({error.strerror}): no "
                f"container that starts now is protected until the sidecar is restarted"
            )
        if problem and problem != self._misplaced:
            log.error("%s", problem)
        self._misplaced = problem
        if not problem:
            self._keep_records()

    def _keep_records(self) -> None:
        for watch in self._watches.values():
            container = watch.container
            if container.node_of or self.records.has(container.id) or has_ended(watch.pidfd):
                continue
            with contextlib.suppress(OSError):  # its hook has said so
                self.records.write(watch.request, container.init_pid)

    def _live_run(self, container_id: str) -> Protected | None:
        """The run of a container that is watched, unless it has just ended."""
        known = self.registry.by_id(container_id)
        return None if known is None or has_ended(self._watches[known.cookie].pidfd) else known

    def _register_unit(self, claim: units.Claim, peer: units.Peer) -> None:
        """A node below a launcher, or a unit of the host.  Raises AvckptError or OSError to refuse it."""
        launcher = self._launcher_of(peer.pid)
        if launcher is None:
            if peer.uid != 0 or not units.is_of_host(peer.pid):
                raise Denied("its container was not started with avckpt.scope=nodes, and of the host only root may")
            owner = prefix = units.HOST
            self._host_units.take()
            labels = units.labels_of_host_unit(claim.labels)
        else:
            owner, prefix = launcher.container.id, launcher.container.label
            launcher.units.take()
            labels = units.labels_of_node(claim.labels, launcher.labels)
        inits = {each.container.init_pid: each for each in self._watches.values() if each.guard is not None}
        for pid in units.ancestors(peer.pid):
            if pid in inits:
                raise Denied(f"it is part of {inits[pid].container.label}, which is protected as a whole")
        unit = units.unit_id(owner, peer.pid)
        if has_ended(peer.pidfd):
            raise TargetGone("it has ended already")  # then what was read may belong to another process
        if self._live_run(unit) is None:
            siblings = [each.name for each in self.registry.live() if each.node_of == owner]
            if len(siblings) >= units.UNITS_MOST:
                raise Busy(f"{prefix} has {units.UNITS_MOST} units already")
            name = units.unique_name(f"{prefix}/{claim.name}", siblings)
            request = Register(id=unit, name=name, pid=peer.pid, starttime=0, bundle="", annotations=labels)
            self._watch(request, os.dup(peer.pidfd), adopted=False, node_of=owner)
        known = self._live_run(unit)
        if known is None:
            raise TargetGone("it has just ended")
        watch = self._watches[known.cookie]
        if watch.connection is not None:
            let_go(watch.connection.detach())
        watch.connection = peer.connection
        os.close(peer.pidfd)

    def _is_launchers(self, space: int) -> bool:
        return any(watch.space == space for watch in self._watches.values())

    def _launcher_of(self, pid: int) -> Watch | None:
        """The container of which a process may be a node.  Raises OSError when it is gone."""
        for watch in self._watches.values():
            if watch.container.state is State.NODES and not has_ended(watch.pidfd):
                with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                    if units.is_in(pid, watch.container.id, watch.container.init_pid):
                        return watch
        return None

    def _watch(self, request: Register, pidfd: int, *, adopted: bool, node_of: str = "") -> None:
        """Starts protecting a container. Takes ownership of `pidfd`, even on failure."""
        with closed_on_error(pidfd):
            if has_ended(pidfd):
                raise TargetGone("the container has ended already")
            if is_foreign(pidfd):
                raise Denied(NOT_SEEN)
            known = self._live_run(request.id)
            if known is not None:
                # Both are alive, so the same PID is the same process.
                if known.init_pid == pid_of(pidfd):
                    os.close(pidfd)
                    return
                raise Busy(f"another run of {known.label} is guarded", pid=known.init_pid)
            settings, problem = self._settings_at_start(request.annotations, request.name)
            container = Protected(
                id=request.id,
                name=request.name,
                cookie=next(self._cookies),
                init_pid=pid_of(pidfd),
                config=settings.config,
                registered_at=time.time(),
                adopted=adopted,
                node_of=node_of,
            )
            container.group = settings.policy.group
        watch = Watch(container, pidfd, request.annotations, settings, request, bundle=request.bundle)
        self.registry.add(container)
        self._watches[container.cookie] = watch
        self._presence.keep(self.registry.live())
        asyncio.get_running_loop().add_reader(pidfd, self._begin_end, watch)
        how = "adopted" if adopted else "registered"
        self.tell(watch, EventRecord(Kind.REGISTERED, detail=f"{how}, init {container.init_pid}"))
        if problem is not None:
            detail = f"{self.configuration.path} does not hold for it"
            self.tell(watch, EventRecord(Kind.CONFIGURED, detail=detail, error=problem))
        if settings.policy.guarded:
            self.metrics.begin(container.label)
            self._start_guard(watch)
        elif settings.policy.enable:
            container.launch()
            with contextlib.suppress(OSError):  # it has just ended
                watch.space = units.pid_namespace(container.init_pid)
        else:
            container.listen()

    def _start_guard(self, watch: Watch) -> None:
        """A failure to start is reported, and retried at the next scan."""
        container = watch.container
        try:
            container.config = self._with_share(container, container.config, watch.settings.config)
            late = container.adopted or watch.guard_lost_s > -math.inf
            config = dataclasses.replace(container.config, late=late)
            watch.guard = self._engine.start_guard(watch.pidfd, config, container.cookie)
        except AvckptError as error:
            container.fail(str(error))
            self.tell(watch, EventRecord(Kind.UNPROTECTED, error=error))
        else:
            container.guard_pid = watch.guard.pid
            self.caretaker.begin(watch, watch.settings.policy)
            self.groups.join(watch)

    # Events

    def tell(self, watch: Watch, record: EventRecord) -> EventRecord:
        """Distributes an event of a container; returns it as distributed.

        Fills in the container and the time (now) where the record lacks them.
        """
        container = watch.container
        if not record.id:
            record = dataclasses.replace(
                record,
                container=container.label,
                id=container.id,
                group=container.group,
                at=record.at or time.time(),
                monotonic_s=record.monotonic_s or time.monotonic(),
            )
        line = watch.journal.line(record)
        if line is not None and line[0] >= logging.INFO:
            record = self.history.add(record)
        self.notifier.take(record, container, self._watches.values())
        if line is not None and self._log.tell(container.label, *line) and line[0] >= logging.INFO:
            self._system_journal.tell(container.init_pid, container.label, *line)
        if record.kind is Kind.RESTORED and watch.settings.policy.mark:
            watch.own_log.tell(watch.pidfd, record.message)
        self.metrics.take(record)
        self.feed.publish(record)
        return record

    def _tell_of_itself(self, kind: Kind, detail: str) -> None:
        record = EventRecord(kind, at=time.time(), monotonic_s=time.monotonic(), detail=detail)
        self.feed.publish(self.history.add(record))

    def _tell_of_notification(self, container: Protected, kind: Kind, detail: str) -> None:
        watch = self._watches.get(container.cookie)
        if watch is not None:
            self.tell(watch, EventRecord(kind, detail=detail))

    def _app_pids(self) -> set[int]:
        return {watch.container.app_pid for watch in self._watches.values()}

    def _take_events(self, most: int = EVENTS_AT_ONCE) -> None:
        """Of guards.  They can come faster than they are dealt with: what else there is to do comes in between."""
        for event in itertools.islice(iter(self._engine.next_event, None), most):
            watch = self._watches.get(event.cookie)
            if watch is None:
                continue  # the last events of a guard that has been stopped
            container = watch.container
            at = time.time() - (time.monotonic_ns() - event.at_ns) / 1e9
            if event.kind is Kind.MISSED and self.caretaker.is_paused(watch):
                event = dataclasses.replace(event, error=Paused("it is paused (podman unpause)"))
            container.apply(event, at)
            if event.kind is Kind.ENDED:
                # The end of the container is reported once it is known.
                if watch.guard is not None and not has_ended(watch.pidfd):
                    self._lose_guard(watch, watch.guard)
                continue
            if event.kind is Kind.HELD:
                self.orders.answer(event, None)
                continue
            record = self.tell(watch, self._record(watch, event, at))
            self.inquests.take(watch, event, record)
            self.groups.hear(watch, event)
            if event.kind is Kind.CHECKPOINT and watch.guard is not None:
                self._share_cpu(watch, watch.guard, event)
            if event.kind is Kind.GUARD_LOST and watch.guard is not None:
                if event.reason is Reason.FILTER:
                    self._follow_guard(watch, watch.guard)
                else:
                    self._replace_guard(watch, watch.guard)
            self.orders.answer(event, record)

    def _with_share(
        self, container: Protected, config: GuardConfig, by_labels: GuardConfig, taken: Event | None = None
    ) -> GuardConfig:
        """With what its guard may use now of the machine's CPUs."""
        share = self._cpu.share(container.cookie, by_labels, time.monotonic(), taken)
        return config if share == config.budget_cpu else dataclasses.replace(config, budget_cpu=share)

    def _share_cpu(self, watch: Watch, guard: Guard, taken: Event) -> None:
        """It has taken checkpoints; others that also do have begun or ended."""
        container = watch.container
        config = self._with_share(container, container.config, watch.settings.config, taken)
        if config is not container.config:
            # One that cannot be told now is ending, or is told after its next one.
            with contextlib.suppress(AvckptError):
                guard.configure(config)
                container.config = config

    def _lose_guard(self, watch: Watch, guard: Guard) -> None:
        """It could not do its work, and said why; the next one may succeed."""
        self.caretaker.end(watch)
        self.groups.leave(watch)
        # Its process has ended, or was killed and does not end: nobody waits for that.
        self._begin_task(self._stop(guard))
        watch.guard = None
        watch.container.guard_pid = 0

    def _follow_guard(self, watch: Watch, guard: Guard) -> None:
        """Its process has been replaced by one without a seccomp filter."""
        self.caretaker.end(watch)
        self.groups.leave(watch)
        self.orders.fail(watch.container, "its guard was replaced before it could be done")
        watch.container.guard_pid = guard.pid
        self.caretaker.begin(watch, watch.settings.policy)
        self.groups.join(watch)

    def _replace_guard(self, watch: Watch, guard: Guard) -> None:
        """Its process died or hung. One that dies repeatedly must not keep us busy."""
        self._lose_guard(watch, guard)
        self.orders.fail(watch.container, "its guard died before it could be done")
        now = time.monotonic()
        since_s, watch.guard_lost_s = now - watch.guard_lost_s, now
        if since_s > GUARD_AGAIN_S and not has_ended(watch.pidfd):
            self._start_guard(watch)

    def _record(self, watch: Watch, event: Event, at: float) -> EventRecord:
        container = watch.container
        return of_guard(
            event,
            container=container.label,
            id=container.id,
            group=container.group,
            at=at,
            commanded=watch.rolling_back,
        )

    # The end of a container, or of the sidecar

    def _begin_end(self, watch: Watch) -> None:
        loop = asyncio.get_running_loop()
        if not loop.remove_reader(watch.pidfd):
            return  # it has begun already
        self.caretaker.end(watch)
        self.groups.leave(watch)
        self._begin_task(self._end(watch))

    def _begin_task(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._endings.add(task)
        task.add_done_callback(self._endings.discard)

    @staticmethod
    async def _stop(guard: Guard) -> None:
        """Blocks for as long as a checkpoint that is under way: others, too, where there can be no thread for it."""
        try:
            stopped = in_own_thread(guard.stop)
        except RuntimeError:
            guard.stop()
        else:
            await stopped

    async def _end(self, watch: Watch) -> None:
        container = watch.container
        if watch.guard is not None:
            await self._stop(watch.guard)
            self._take_events(EVENTS_QUEUED)  # it may have reported how the container ended
        ended = has_ended(watch.pidfd)
        os.close(watch.pidfd)
        if watch.connection is not None:
            let_go(watch.connection.detach())
        del self._watches[container.cookie]
        self.registry.remove(container)
        self._names.forget(container.id, container.init_pid)
        if ended:
            self._presence.keep(self.registry.live())
            container.end(time.time())
            self.tell(watch, EventRecord(Kind.ENDED, detail=container.reason))
            self.metrics.forget_all_but(each.label for each in self.registry.live() + self.registry.ended())
        self.orders.fail(container, "ended before it could be done")


@contextmanager
def closed_on_error(fd: int) -> Iterator[None]:
    """Closes `fd` when the body raises."""
    try:
        yield
    except BaseException:
        os.close(fd)
        raise
