# SPDX-License-Identifier: Apache-2.0
"""The ROS pipeline of examples/ros/vehicle.yaml: brought up, looked at, and its nodes killed."""

from __future__ import annotations

import bisect
import contextlib
import json
import os
import random
import shutil
import signal
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from bench.ros_streams import Ruler, Stream, scan_stream
from testkit.harness import ROOT, CommandFailed, Podman, app_pid, avckpt_command, run, wait_until

MANIFEST = ROOT / "examples" / "ros" / "vehicle.yaml"
RESULTS = Path("/tmp/avckpt-ros")
"""What the containers write: the monitor's log."""
PERIOD_S = 0.1
LOST_M = 1.0
"""A pose this far from the truth is none: matching has lost track."""
NODES = {"voxel": "ros-voxel", "ndt": "ros-ndt", "watch": "ros-watch"}
NODE_NAMES = {"voxel": "voxel_grid_filter", "ndt": "ndt_matching"}
SERVICES = ("roscore", "monitor", "ndt", "watch", "voxel", "player")
START_S = 60.0


class PipelineFailed(Exception):
    """The chain does not do what it must before anything is measured; the message says what."""


@dataclass(frozen=True)
class Frame:
    """One scan, and what became of it.  Seconds since 1970."""

    stamp: float
    """Published."""
    filtered: float | None
    """When its cloud came to the monitor."""
    pose: float | None
    """When its pose did; None: it never came."""
    error_m: float
    """Distance of the pose from the truth."""

    @property
    def latency_s(self) -> float | None:
        return None if self.pose is None else self.pose - self.stamp


@dataclass
class Log:
    """The monitor's log, read as it grows."""

    path: Path
    _offset: int = 0
    _truth: dict[str, tuple[float, float]] = field(default_factory=dict)
    _filtered: dict[str, float] = field(default_factory=dict)
    _pose: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    _obstacle: dict[str, float] = field(default_factory=dict)
    _stamps: list[str] = field(default_factory=list)

    def read(self) -> None:
        """Takes in what was written since."""
        with contextlib.suppress(FileNotFoundError), self.path.open("rb") as file:
            file.seek(self._offset)
            text = file.read()
            whole = text.rfind(b"\n") + 1
            self._offset += whole
            for line in text[:whole].decode().splitlines():
                kind, arrived, _, stamp, x, y, _ = line.split()
                if kind == "T":
                    self._truth[stamp] = float(x), float(y)
                    self._stamps.append(stamp)
                elif kind == "V":
                    self._filtered.setdefault(stamp, float(arrived))
                elif kind == "P":
                    self._pose.setdefault(stamp, (float(arrived), float(x), float(y)))
                else:
                    self._obstacle.setdefault(stamp, float(arrived))

    def frames(self, since: float, until: float = float("inf")) -> list[Frame]:
        """The scans published in this time, oldest first."""
        self.read()
        first = bisect.bisect_left(self._stamps, since, key=float)
        return [self._frame(stamp) for stamp in self._stamps[first:] if float(stamp) <= until]

    def _frame(self, stamp: str) -> Frame:
        pose = self._pose.get(stamp)
        error = 0.0
        if pose is not None:
            x, y = self._truth[stamp]
            error = ((pose[1] - x) ** 2 + (pose[2] - y) ** 2) ** 0.5
        return Frame(float(stamp), self._filtered.get(stamp), pose[0] if pose else None, error)

    def watched(self, since: float) -> int:
        """How many scans published since then the rospy node has told about."""
        self.read()
        return sum(1 for stamp in self._obstacle if float(stamp) >= since)

    def delivers(self, since: float, frames: int = 3) -> bool:
        """Whether poses, right ones, of this many of the scans published since then came out."""
        good = [frame for frame in self.frames(since) if frame.pose is not None and frame.error_m < LOST_M]
        return len(good) >= frames

    def wait_delivers(self, since: float, timeout_s: float, frames: int = 20) -> None:
        """Raises PipelineFailed when the chain has not delivered so many frames by then."""
        try:
            wait_until(lambda: self.delivers(since, frames), timeout_s, "", every_s=0.05)
        except TimeoutError:
            seen = self.frames(since)
            poses = [frame for frame in seen if frame.pose is not None]
            raise PipelineFailed(
                f"the chain does not deliver: of {len(seen)} scans {len(poses)} became poses, "
                f"{sum(frame.error_m > LOST_M for frame in poses)} of them wrong"
            ) from None


@dataclass(frozen=True)
class Crash:
    """One order to crash."""

    kind: str
    """kill, segv or abort (signals from outside); segv, abort, throw, kill or exit (within a callback)."""
    place: str = ""
    """Within a callback: begin, middle or end; "message": while a scan is being read; "": anywhere."""


class Pipeline:
    """The containers; a context manager that takes them down."""

    def __init__(self, *, protect: bool, settings: Mapping[str, str] | None = None, results: Path = RESULTS) -> None:
        self.podman = Podman()
        self.protect = protect
        self.results = results
        self.log = Log(results / "monitor.log")
        self.ruler = Ruler()
        self._env = {"PROTECT": str(protect).lower(), "RESULTS": str(results), **(settings or {})}
        self._inits: dict[str, int] = {}

    def __enter__(self) -> Pipeline:
        shutil.rmtree(self.results, ignore_errors=True)
        (self.results / "faults").mkdir(parents=True)
        # Private parameters stay in the parameter server, but that is new as well.
        try:
            self.down()  # what an earlier run may have left
            run([*avckpt_command(), "up", "--install", "-f", str(MANIFEST), *SERVICES], env=self._env, timeout_s=180)
            self.wait_delivers(time.time(), START_S)
            self.learn()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.down()

    def down(self) -> None:
        """Takes the containers away."""
        run([*avckpt_command(), "down", "-f", str(MANIFEST)], env=self._env, timeout_s=120, shielded=True, check=False)

    def wait_delivers(self, since: float, timeout_s: float, frames: int = 20) -> None:
        """Raises PipelineFailed when the chain has not delivered so many frames by then."""
        self.log.wait_delivers(since, timeout_s, frames)

    def pid(self, node: str) -> int:
        """The node's process.  Raises LookupError while there is none."""
        name = NODES[node]
        if not self.protect:
            found: int = self.podman.inspect(name)["State"]["Pid"]
            if not found:
                raise LookupError(f"{name} does not run")
            return found
        if name not in self._inits:
            self._inits[name] = self.podman.inspect(name)["State"]["Pid"]
        try:
            # While a checkpoint or a restore is on its way there are two for a moment.
            for _ in range(50):
                with contextlib.suppress(LookupError):
                    return app_pid(self._inits[name])
                time.sleep(0.01)
            return app_pid(self._inits[name])
        except FileNotFoundError:
            del self._inits[name]
            raise LookupError(f"{name} has ended") from None

    def learn(self) -> None:
        """Looks at the scans' connection a few times between two scans."""
        with scan_stream(self.pid("voxel")) as stream:
            for _ in range(7):
                before, deadline = stream.taken, time.monotonic() + 10
                while stream.taken == before and time.monotonic() < deadline:
                    time.sleep(0.001)
                time.sleep(0.06)
                self.ruler.see(stream.taken)

    def crash(self, nodes: list[str], crash: Crash, rng: random.Random) -> tuple[float, int | None]:
        """Has nodes crash.  Returns when, and how far into a message the scans' connection then stood (None: n/a).

        In a callback: returns once the order was carried out.
        """
        if crash.place in ("begin", "middle", "end"):
            return self._crash_within(nodes, crash), None
        pids = [self.pid(node) for node in nodes]
        number = {"kill": signal.SIGKILL, "segv": signal.SIGSEGV, "abort": signal.SIGABRT}[crash.kind]
        with contextlib.ExitStack() as stack:
            stream = stack.enter_context(scan_stream(self.pid("voxel"))) if "voxel" in nodes else None
            pidfds = [os.pidfd_open(pid) for pid in pids]
            for pidfd in pidfds:
                stack.callback(os.close, pidfd)
            if crash.place == "message" and stream is not None:
                self._wait_inside(stream, rng)
            at = time.time()
            # Stopped first, so that where it died is known to the byte.
            for pidfd in pidfds:
                signal.pidfd_send_signal(pidfd, signal.SIGSTOP)
            inside = self.ruler.inside(stream.taken) if stream is not None else None
            for pidfd in pidfds:
                signal.pidfd_send_signal(pidfd, number)
                with contextlib.suppress(ProcessLookupError):  # SIGKILL does not wait for it
                    signal.pidfd_send_signal(pidfd, signal.SIGCONT)
        return at, inside

    def _wait_inside(self, stream: Stream, rng: random.Random) -> None:
        some = rng.randrange(1, 400_000)  # from there to its end, whenever we get to run
        deadline = time.monotonic() + 10
        while self.ruler.inside(stream.taken) < some:
            if time.monotonic() > deadline:
                raise PipelineFailed("no message was seen being read")

    def _crash_within(self, nodes: list[str], crash: Crash) -> float:
        orders = [self.results / "faults" / NODE_NAMES[node] for node in nodes]
        for order in orders:
            draft = order.with_suffix(".new")
            draft.write_text(f"{crash.kind} {crash.place}")
            draft.rename(order)
        wait_until(lambda: not any(order.exists() for order in orders), 10.0, "the faults happen", every_s=0.0005)
        return time.time()

    def mend(self, nodes: list[str]) -> None:
        """Starts containers anew, for a chain that does not deliver any more.  Raises PipelineFailed, CommandFailed."""
        for node in nodes:
            self.podman.run("restart", "--time", "0", NODES[node])
            self._inits.pop(NODES[node], None)
        since = time.time()
        self.wait_delivers(since, START_S)
        if self.protect:
            wait_until(lambda: self._protected(nodes), START_S, "the restarted nodes are protected", every_s=0.2)

    def _protected(self, nodes: list[str]) -> bool:
        entries = json.loads(run([*avckpt_command(), "ps", "--json"]).stdout)
        there = {entry["name"]: entry["state"] for entry in entries}
        return all(there.get(NODES[node]) == "protected" for node in nodes)


@contextlib.contextmanager
def sidecar() -> Iterator[None]:
    """Takes the sidecar that `avckpt up` may have started, and the hooks, away again."""
    from testkit.harness import DROP_IN, SIDECAR_NAME

    podman = Podman()
    installed, there = DROP_IN.exists(), podman.exists(SIDECAR_NAME)
    try:
        yield
    finally:
        if not there:
            podman.remove(SIDECAR_NAME)
        if not installed:
            run([*avckpt_command(), "uninstall"], shielded=True, check=False)


__all__ = ["CommandFailed", "Crash", "Frame", "Log", "Pipeline", "PipelineFailed", "sidecar"]
