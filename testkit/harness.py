# SPDX-License-Identifier: Apache-2.0
"""What tests on real containers need: Podman, containers that are always removed, the sidecar.

The fixtures are in conftest.py; import the classes from here for annotations.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from avckpt.cli.client import CPU_SHARES, Client
from avckpt.cli.sidecar_container import answers
from avckpt.errors import AvckptError
from avckpt.guard import Command

from testkit.procfs import started

ROOT = Path(__file__).resolve().parent.parent
BASE_IMAGE = "localhost/avckpt-base:latest"
SIDECAR_IMAGE = "localhost/avckpt-sidecar:latest"

LANE = os.environ.get("AVCKPT_LANE", "")
"""Of a run of tests beside others: hooks and a sidecar of its own, where others have those of this machine."""

SIDECAR_NAME = f"avckpt-sidecar-{LANE}" if LANE else "avckpt-sidecar"
OURS = "io.github.avckpt.test"
"""Label of every container made here, so that an aborted run's leftovers can be told from a user's containers."""

DROP_IN = Path("/etc/containers/containers.conf.d/50-avckpt.conf")
MACHINE_CONF = DROP_IN.with_name("10-avckpt-machine.conf")
RUN_DIR = Path(f"/run/{SIDECAR_NAME}" if LANE else os.environ.get("AVCKPT_RUN_DIR") or "/run/avckpt")
CONFIG_DIR = Path(f"/run/{SIDECAR_NAME}-etc" if LANE else "/etc/avckpt")
CONFIG = CONFIG_DIR / "config.yaml"
OF_A_TEST = "# of a test: what a killed run has left is removed by the next\n"
"""First line of each that a test writes."""
LOCK = Path(f"/run/lock/avckpt-tests{LANE}.lock")

SLOWNESS = float(os.environ.get("AVCKPT_SLOWNESS", "1"))
"""How many times slower than a machine this one is: an emulated one is (test-machine.sh). Victims look at it, too."""

NAMING_LOOKS = 100

T = TypeVar("T")


def avckpt_command() -> list[str]:
    """The command line `avckpt` of the environment the tests run in."""
    return [sys.executable, "-m", "avckpt"]


def free_port() -> int:
    """A TCP port that nobody listens on now.  It can be taken before it is used: bind it soon."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def wait_until(condition: Callable[[], T], timeout_s: float, what: str, every_s: float = 0.02) -> T:
    """Calls `condition` until it returns something true, and returns that.

    Raises TimeoutError naming `what` after `timeout_s` seconds.
    """
    deadline = time.monotonic() + timeout_s
    while True:
        result = condition()
        if result:
            return result
        if time.monotonic() > deadline:
            raise TimeoutError(f"not within {timeout_s:g} s: {what}")
        time.sleep(every_s)


@dataclass(frozen=True)
class Completed:
    """A command that has ended."""

    args: tuple[str, ...]
    status: int
    stdout: str
    stderr: str
    took_s: float

    def __str__(self) -> str:
        said = (self.stderr.strip() or self.stdout.strip())[-2000:]
        return f"`{' '.join(self.args)}` ended with {self.status} after {self.took_s:.2f} s: {said}"


def take_checkpoint(client: Client, name: str, timeout_s: float = 20 * SLOWNESS) -> int:
    """As soon as there is something to take one of; returns its generation.

    A busy machine may be too slow for the freeze deadline; the guard then tries again by itself, and there is one
    generation more.
    """

    def taken() -> int:
        with contextlib.suppress(AvckptError):
            return int(client.command(name, Command.CHECKPOINT)["event"]["generation"])
        return 0

    return wait_until(taken, timeout_s, f"a checkpoint of {name}", every_s=0.1)


class CommandFailed(AssertionError):
    """A command that had to succeed did not; `.completed` has all of it."""

    def __init__(self, completed: Completed) -> None:
        super().__init__(str(completed))
        self.completed = completed


def run(
    args: Sequence[str],
    *,
    timeout_s: float = 60.0 * SLOWNESS,
    check: bool = True,
    stdin: str | None = None,
    env: Mapping[str, str] | None = None,
    shielded: bool = False,
) -> Completed:
    """Runs a command to its end.

    `shielded`: in a session of its own, so that an impatient second Ctrl-C does
    not reach a command that cleans up.

    Raises CommandFailed when `check` and the status is not 0, and
    subprocess.TimeoutExpired (the command is killed) after `timeout_s`.
    """
    started = time.monotonic()
    # A file and not a pipe: conmon and its like inherit a pipe's write end, and
    # reading to its end would then wait for the container.
    with (
        open(os.memfd_create("stdout"), "w+", errors="replace") as out,
        open(os.memfd_create("stderr"), "w+", errors="replace") as err,
    ):
        done = subprocess.run(
            args,
            stdout=out,
            stderr=err,
            timeout=timeout_s,
            text=True,
            check=False,
            env=None if env is None else {**os.environ, **env},
            input=stdin or "",
            start_new_session=shielded,
        )
        out.seek(0)
        err.seek(0)
        completed = Completed(tuple(args), done.returncode, out.read(), err.read(), time.monotonic() - started)
    if check and completed.status != 0:
        raise CommandFailed(completed)
    return completed


class Podman:
    """The podman command line."""

    def __init__(self, *global_options: str) -> None:
        self.command = ("podman", *global_options)

    def run(
        self,
        *args: str,
        timeout_s: float = 60.0 * SLOWNESS,
        check: bool = True,
        stdin: str | None = None,
        shielded: bool = False,
    ) -> Completed:
        """`podman ARGS`; see `run()` above."""
        return run([*self.command, *args], timeout_s=timeout_s, check=check, stdin=stdin, shielded=shielded)

    def json(self, *args: str, timeout_s: float = 60.0 * SLOWNESS) -> Any:
        """What `podman ARGS` prints, read as JSON."""
        return json.loads(self.run(*args, timeout_s=timeout_s).stdout)

    def inspect(self, name: str) -> dict[str, Any]:
        """`podman inspect` of one container."""
        found: list[dict[str, Any]] = self.json("inspect", "--type", "container", name)
        return found[0]

    def exists(self, name: str) -> bool:
        """Is there a container of exactly this name?"""
        return self.run("container", "exists", name, check=False).status == 0

    def remove(self, name: str) -> None:
        """Removes a container, running or not; no error when it is not there."""
        self.run("rm", "--force", "--ignore", "--time", "0", name, shielded=True)


@dataclass
class Container:
    """A container a test has made."""

    podman: Podman
    name: str
    id: str
    _main: tuple[int, int] = field(default=(0, 0), repr=False)
    """The main process as Podman named it, and when it started."""

    @property
    def pid(self) -> int:
        """The main process (avckpt-init, if protected), in the host's PID namespace; 0: does not run."""
        pid, since = self._main
        if not since or started(pid) != since:  # it has ended, and there may be another
            pid = self.inspect()["State"]["Pid"]
            self._main = (pid, started(pid) if pid else 0)
        return pid

    @property
    def status(self) -> str:
        """As `podman ps` has it: "running", "exited", ..."""
        status: str = self.inspect()["State"]["Status"]
        return status

    @property
    def exit_code(self) -> int:
        code: int = self.inspect()["State"]["ExitCode"]
        return code

    @property
    def ip(self) -> str:
        """Address in the bridge network; empty for others."""
        address: str = self.inspect()["NetworkSettings"]["IPAddress"]
        return address

    def inspect(self) -> dict[str, Any]:
        return self.podman.inspect(self.name)

    def logs(self) -> str:
        """Everything the container has written, stdout and stderr."""
        done = self.podman.run("logs", self.name)
        return done.stdout + done.stderr

    def wait_for_log(self, text: str, timeout_s: float = 20.0 * SLOWNESS, count: int = 1) -> str:
        """Waits until `text` was logged `count` times; returns the log."""

        def seen() -> str:
            log = self.logs()
            return log if log.count(text) >= count else ""

        try:
            return wait_until(seen, timeout_s, f"{text!r} in the log of {self.name}", every_s=0.1)
        except TimeoutError as error:
            raise TimeoutError(f"{error}; the log: {self.logs()[-2000:]!r}") from None

    def exec(self, *command: str, timeout_s: float = 30.0 * SLOWNESS, check: bool = True) -> Completed:
        """`podman exec`: a command inside."""
        return self.podman.run("exec", self.name, *command, timeout_s=timeout_s, check=check)

    def signal(self, name: str) -> None:
        """`podman kill`: a signal to the main process, i.e. to avckpt-init."""
        self.podman.run("kill", "--signal", name, self.name)

    def stop(self, timeout_s: float = 5.0) -> Completed:
        """`podman stop`, with its own time until SIGKILL."""
        return self.podman.run("stop", "--time", str(int(timeout_s)), self.name, timeout_s=timeout_s + 30 * SLOWNESS)

    def wait(self, timeout_s: float = 30.0 * SLOWNESS) -> int:
        """Waits for the container's end; returns its exit status."""
        return int(self.podman.run("wait", self.name, timeout_s=timeout_s).stdout)

    def remove(self) -> None:
        self.podman.remove(self.name)


@dataclass
class ContainerFactory:
    """Makes containers, and removes every one of them in `close()`."""

    podman: Podman
    prefix: str
    made: list[Container] = field(default_factory=list)
    _numbers: Iterator[int] = field(default_factory=itertools.count)

    def __call__(
        self,
        *command: str,
        labels: Mapping[str, str] | None = None,
        options: Sequence[str] = (),
        image: str = BASE_IMAGE,
        name: str | None = None,
        timeout_s: float = 60.0 * SLOWNESS,
    ) -> Container:
        """`podman run -d OPTIONS --label ... IMAGE COMMAND`.  Raises CommandFailed when it does not start."""
        name = name or f"{self.prefix}-{next(self._numbers)}"
        words = [word for key, value in (labels or {}).items() for word in ("--label", f"{key}={value}")]
        # Known before it is made: Podman leaves a container behind when a hook refuses it.
        made = Container(self.podman, name, "")
        self.made.append(made)
        done = self.podman.run(
            *("run", "--detach", "--pull=never", "--name", name, "--label", f"{OURS}=1"),
            *(*words, *options, image, *command),
            timeout_s=timeout_s,
        )
        made.id = done.stdout.strip()
        return made

    def protected(
        self, *command: str, labels: Mapping[str, str] | None = None, options: Sequence[str] = (), **more: Any
    ) -> Container:
        """The same with `avckpt.enable=true`; `labels` may leave out the prefix `avckpt.`."""
        full = {"avckpt.enable": "true"}
        full.update(
            {key if key.startswith("avckpt.") else f"avckpt.{key}": value for key, value in (labels or {}).items()}
        )
        return self(*command, labels=full, options=options, **more)

    def close(self) -> None:
        """Removes everything made; goes on after a failure and raises the first at the end."""
        failures: list[Exception] = []
        while self.made:
            try:
                self.made.pop().remove()
            except (CommandFailed, subprocess.TimeoutExpired) as error:
                failures.append(error)
        if failures:
            raise failures[0]


@dataclass
class Sidecar:
    """The sidecar container, with the hooks installed."""

    podman: Podman

    def avckpt(self, *args: str, timeout_s: float = 30.0 * SLOWNESS, check: bool = True) -> Completed:
        """`avckpt ARGS` on the host."""
        return run([*avckpt_command(), *args], timeout_s=timeout_s, check=check)

    @property
    def client(self) -> Client:
        """Asks what `avckpt` asks: tests look often, and a process for each look is most of what a look costs."""
        return Client(RUN_DIR)

    def ps(self, *, ended: bool = False) -> list[dict[str, Any]]:
        """As `avckpt ps --json` has it."""
        return self.client.containers(ended=ended)

    def find(self, container: Container) -> dict[str, Any] | None:
        """What `avckpt ps` says of one container; None: it does not know it."""
        return next((entry for entry in self.ps() if entry["id"] == container.id), None)

    def wait_generation(
        self, container: Container, at_least: int = 1, timeout_s: float = 20.0 * SLOWNESS
    ) -> dict[str, Any]:
        """Waits until generation number `at_least` was taken; returns the container's entry of `avckpt ps`."""
        return self.wait_for(
            container, lambda entry: entry["generation"] >= at_least, f"generation {at_least}", timeout_s
        )

    def wait_restores(
        self, container: Container, at_least: int = 1, timeout_s: float = 20.0 * SLOWNESS
    ) -> dict[str, Any]:
        """Waits until the container was restored `at_least` times."""
        return self.wait_for(container, lambda entry: entry["restores"] >= at_least, f"restore {at_least}", timeout_s)

    def wait_for(
        self,
        container: Container,
        condition: Callable[[dict[str, Any]], bool],
        what: str,
        timeout_s: float = 20.0 * SLOWNESS,
    ) -> dict[str, Any]:
        """Waits until `avckpt ps` has an entry that fits."""
        last: dict[str, Any] | None = None

        def look() -> dict[str, Any] | None:
            nonlocal last
            last = self.find(container)
            return last if last is not None and condition(last) else None

        try:
            found = wait_until(look, timeout_s, f"{what} of {container.name}", every_s=0.1)
        except TimeoutError as error:
            # Has it ended?  Then that is what a person wants to read.
            ended = [entry for entry in self.ps(ended=True) if entry["id"] == container.id]
            raise TimeoutError(f"{error}; avckpt ps says {last or ended or 'nothing of it'}") from None
        assert found is not None
        return found

    def app_pid(self, container: Container) -> int:
        """The app's main process, in the host's PID namespace: the one child of avckpt-init that is no template.

        Raises LookupError when there is not one for a second: it is being restored.
        """
        init = container.pid
        deadline = time.monotonic() + 1
        while True:
            try:
                return app_pid(init)
            except LookupError:
                # In a checkpoint the clone has the app's name until it is given its own.
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.005)

    @property
    def running(self) -> bool:
        done = self.podman.run("inspect", "--format", "{{.State.Running}}", SIDECAR_NAME, check=False)
        return done.stdout.strip() == "true"

    def start(self, timeout_s: float = 20.0 * SLOWNESS) -> None:
        """Starts the container and waits until the daemon answers."""
        RUN_DIR.mkdir(mode=0o755, exist_ok=True)
        # Made by `avckpt install`; an older installation has none.
        config = ("--volume", f"{CONFIG_DIR}:/etc/avckpt:ro") if CONFIG_DIR.is_dir() else ()
        self.podman.run(
            *("run", "--detach", "--pull=never", "--name", SIDECAR_NAME, "--label", f"{OURS}=1"),
            *("--privileged", "--pid=host", "--network=none", f"--cpu-shares={CPU_SHARES}"),
            *("--volume", f"{RUN_DIR}:/run/avckpt"),
            *(*config, SIDECAR_IMAGE),
        )
        try:
            wait_until(self.answers, timeout_s, f"the sidecar answers on {RUN_DIR}/api.sock", every_s=0.05)
        except TimeoutError as error:
            raise TimeoutError(f"{error}; its log: {self.logs()[-2000:]}") from None

    def answers(self) -> bool:
        return answers(self.client)

    def kill(self) -> None:
        """SIGKILL, as a crash would."""
        self.podman.run("kill", "--signal", "KILL", SIDECAR_NAME)
        self.podman.run("wait", SIDECAR_NAME)

    def stop(self) -> None:
        """Stops and removes the container; no error when there is none."""
        self.podman.run("rm", "--force", "--ignore", "--time", "5", SIDECAR_NAME, shielded=True)

    def restart(self) -> None:
        self.stop()
        self.start()

    def logs(self) -> str:
        done = self.podman.run("logs", SIDECAR_NAME, check=False)
        return done.stdout + done.stderr


def app_pid(init_pid: int) -> int:
    """The app below avckpt-init: its only child that is neither template nor holder, and no zombie.

    Raises LookupError when there is none at this moment (it is being restored), or one too many
    for longer than a template takes to be named.
    """
    for _ in range(NAMING_LOOKS):
        found = _children_of_init(init_pid)
        if len(found) <= 1:
            break
        time.sleep(0.005)
    if len(found) != 1:
        raise LookupError(f"children of avckpt-init {init_pid} that could be the app: {found}")
    return found[0]


def _children_of_init(init_pid: int) -> list[int]:
    children = Path(f"/proc/{init_pid}/task/{init_pid}/children").read_text().split()
    found = []
    for child in children:
        with contextlib.suppress(OSError):
            stat = Path(f"/proc/{child}/stat").read_text()
            name, rest = stat[stat.index("(") + 1 :].rsplit(")", 1)
            state, threads = rest.split()[0], int(rest.split()[17])
            # The main thread may have ended while others go on.
            if not name.startswith("avckpt-") and (state not in "ZX" or threads > 1):
                found.append(int(child))
    return found


@contextlib.contextmanager
def machine_lock(timeout_s: float) -> Iterator[None]:
    """Only one run of tests or demo at a time may own the hooks and the sidecar of this machine."""
    with LOCK.open("w") as lock:
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise TimeoutError(f"another run of avckpt's tests or demo holds {LOCK}") from None
                time.sleep(0.5)
        yield


@contextlib.contextmanager
def hooks_installed() -> Iterator[None]:
    """Installs the hooks of this tree; removes them afterwards unless there were some before."""
    if LANE:
        with _hooks_of_lane():
            yield
        return
    before = DROP_IN.exists()
    run([*avckpt_command(), "install"])
    try:
        yield
    finally:
        if not before:
            run([*avckpt_command(), "uninstall"], shielded=True)


@contextlib.contextmanager
def _hooks_of_lane() -> Iterator[None]:
    """The environment of what is started meanwhile: this lane's sidecar, and Podman with its hooks.

    In its configuration, not as an option: conmon, which restarts containers, passes no options on.
    """
    with tempfile.TemporaryDirectory() as folder:
        hooks, conf = Path(folder, "hooks.d"), Path(folder, "containers.conf")
        write_hooks(hooks, RUN_DIR)
        # Podman reads no other one then (setup-podman.sh).
        limits = MACHINE_CONF.read_text() if MACHINE_CONF.exists() else ""
        conf.write_text(f"{limits}[engine]\nhooks_dir = {json.dumps([str(hooks)])}\n")
        ours = {"AVCKPT_RUN_DIR": str(RUN_DIR), "AVCKPT_CONFIG": str(CONFIG), "CONTAINERS_CONF": str(conf)}
        os.environ.update(ours)
        try:
            yield
        finally:
            for name in ours:
                del os.environ[name]
            shutil.rmtree(RUN_DIR, ignore_errors=True)


@contextlib.contextmanager
def running_sidecar(podman: Podman) -> Iterator[Sidecar]:
    """Hooks and sidecar for as long as the block runs."""
    sidecar = Sidecar(podman)
    if podman.exists(SIDECAR_NAME):
        if OURS not in (podman.inspect(SIDECAR_NAME)["Config"]["Labels"] or {}):
            raise RuntimeError(f"a container {SIDECAR_NAME} that is not the tests' own is here: stop it first")
        sidecar.stop()  # left by a run that was killed
    if CONFIG.exists() and CONFIG.read_text().startswith(OF_A_TEST):
        CONFIG.unlink()
    with hooks_installed():
        try:
            sidecar.start()
            yield sidecar
        finally:
            sidecar.stop()


def write_hooks(folder: Path, run_dir: Path) -> None:
    """The hook JSON into a new folder, for the hooks of this checkout and the sidecar of that run directory."""
    folder.mkdir()
    for source in (ROOT / "oci-hooks.d").glob("*.json"):
        data = json.loads(source.read_text())
        data["hook"]["path"] = str(ROOT / "hooks" / "avckpt-hook")
        data["hook"]["env"].append(f"AVCKPT_RUN_DIR={run_dir}")
        (folder / source.name).write_text(json.dumps(data))
