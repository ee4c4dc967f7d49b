# SPDX-License-Identifier: Apache-2.0
"""A real sidecar daemon and real avckpt-init processes in a private run-time directory, without Podman."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from avckpt.artifacts import hooks_source, init_binary
from avckpt.cli.client import Client
from avckpt.cli.commands import main
from avckpt.containers.process import has_ended
from avckpt.errors import SidecarUnreachable
from avckpt_hooks import VERSION

from testkit.forked import Forked, preload
from testkit.harness import ROOT, SLOWNESS, Completed, Podman, avckpt_command, run, wait_until, write_hooks
from testkit.procfs import children_of, inside

preload("avckpt.daemon")

QUICK = {"avckpt.enable": "true", "avckpt.interval": "100ms"}
ON_COMMAND = {"avckpt.enable": "true", "avckpt.interval": "1h"}


@dataclass
class Container:
    """What a container is to the sidecar: an avckpt-init, PID 1 of a PID namespace of its own."""

    id: str
    name: str
    env: dict[str, str]
    process: subprocess.Popen[bytes]
    init_pid: int
    pidfd: int
    output: Path

    @property
    def app_pid(self) -> int:
        """The application's main process, in our PID namespace."""
        return app_of(self.init_pid)

    def hook(self, stage: str, labels: dict[str, str] | None = None) -> str:
        """Runs a real hook as the OCI runtime would; returns what it had to tell."""
        annotations = {**(labels or {}), "avckpt.version": VERSION, "avckpt.name": self.name}
        state = {"ociVersion": "1.0.2", "id": self.id, "pid": self.init_pid, "bundle": "/b", "annotations": annotations}
        # A hook tells the program that called it, on that one's standard error:
        # here a shell, which must stay to be told.
        done = run(
            ["sh", "-c", '"$@"; exit $?', "sh", sys.executable, str(hooks_source() / "__main__.py"), stage],
            stdin=json.dumps(state),
            env=self.env,
            timeout_s=10 * SLOWNESS,
        )
        return done.stdout + done.stderr

    def status(self, timeout_s: float = 10.0 * SLOWNESS) -> int:
        """Waits for its end; its exit status."""
        return self.process.wait(timeout_s)

    def close(self) -> None:
        """Kills it, if it still runs."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, signal.SIGKILL)
        os.close(self.pidfd)
        self.process.wait(10 * SLOWNESS)


@dataclass
class LocalSidecar:
    """A sidecar daemon of this machine's own environment; `start()` it."""

    run_dir: Path
    command: Sequence[str] = field(default_factory=avckpt_command)
    process: subprocess.Popen[bytes] | Forked | None = None
    containers: list[Container] = field(default_factory=list)

    @property
    def env(self) -> dict[str, str]:
        return {"AVCKPT_RUN_DIR": str(self.run_dir), "AVCKPT_CONFIG": str(self.config)}

    @property
    def config(self) -> Path:
        """Its configuration file; there is none until a test writes one."""
        return self.run_dir.with_name("config.yaml")

    @property
    def log(self) -> str:
        """Everything it has logged, over all its lives."""
        path = self.run_dir.with_suffix(".log")
        return path.read_text() if path.exists() else ""

    def start(self, *options: str, stderr: int | None = None, inherits: bool = False) -> None:
        """Starts it and waits until it answers; `inherits`: from this process, limits for example."""
        env = {**os.environ, **self.env}
        with self.run_dir.with_suffix(".log").open("ab") as log, open(os.devnull, "rb") as null:
            stderr = log.fileno() if stderr is None else stderr
            if inherits or self.command != avckpt_command():
                self.process = subprocess.Popen(
                    [*self.command, "sidecar", *options], stderr=stderr, env=env, stdin=null
                )
            else:
                self.process = Forked(_main, ["sidecar", *options], stdin=null.fileno(), stderr=stderr, env=env)
        wait_until(self._answers, 60 * SLOWNESS, "the sidecar answers")

    def stop(self, signum: int = signal.SIGTERM) -> int:
        """Ends it by a signal; its exit status as subprocess has it."""
        assert self.process is not None
        self.process.send_signal(signum)
        return self.process.wait(20 * SLOWNESS)

    def avckpt(self, *args: str, check: bool = True) -> Completed:
        """Runs the command line against it."""
        return run([*avckpt_command(), *args], env=self.env, check=check, timeout_s=60 * SLOWNESS)

    @property
    def client(self) -> Client:
        """Asks what `avckpt` asks: tests look often, and a process for each look is most of what a look costs."""
        return Client(self.run_dir)

    def ps(self, *, ended: bool = False) -> list[dict[str, Any]]:
        """As `avckpt ps --json` has it."""
        return self.client.containers(ended=ended)

    def events(self, name: str, kind: str) -> list[dict[str, Any]]:
        """What `avckpt events` tells of that container, of that kind, oldest first."""
        return [event for event in self.client.history() if event["container"] == name and event["kind"] == kind]

    def row(self, container: Container, *, ended: bool = False) -> dict[str, Any]:
        """What `avckpt ps` knows of a container; empty: nothing."""
        rows = self.ps(ended=ended)
        ours = (row for row in rows if row["id"] == container.id and row["init_pid"] == container.init_pid)
        return next(ours, {})

    def wait_for(self, container: Container, timeout_s: float = 10.0 * SLOWNESS, **wanted: Any) -> dict[str, Any]:
        """Waits until `avckpt ps -a` shows these values for the container."""
        last: dict[str, Any] = {}

        def fits() -> bool:
            nonlocal last
            last = self.row(container, ended=True)
            return bool(last) and all(last[key] == value for key, value in wanted.items())

        try:
            wait_until(fits, timeout_s, f"{container.name}: {wanted}", every_s=0.05)
        except TimeoutError as error:
            raise AssertionError(f"{error}; it is {last}; log:\n{self.log}") from None
        return last

    def container(
        self,
        name: str,
        argv: Sequence[str],
        container_id: str | None = None,
        *,
        init: bool = True,
        stderr: int | None = None,
    ) -> Container:
        """Starts avckpt-init with a program, or the program alone; nobody is told of it yet."""
        output = self.run_dir.parent / f"{name}-{len(self.containers)}.out"
        command = (str(init_binary()), "--wait-ms", "2000", "--") if init else ()
        # unshare stays as the parent, so that the container has an exit status to wait for.
        with output.open("wb") as out:
            process = subprocess.Popen(
                ["unshare", "--pid", "--fork", "--mount-proc", *command, *argv],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out if stderr is None else stderr,
                cwd=ROOT,
            )
        init_pid = wait_until(lambda: next(iter(children_of(process.pid)), 0), 5 * SLOWNESS, "init starts")
        pidfd = os.pidfd_open(init_pid)
        if init:
            wait_until(lambda: children_of(init_pid), 5 * SLOWNESS, "the application starts")
        made = Container(
            container_id or f"{len(self.containers) + 1:x}".rjust(2, "c") * 32,
            name,
            self.env,
            process,
            init_pid,
            pidfd,
            output,
        )
        self.containers.append(made)
        return made

    def protected(
        self, name: str, argv: Sequence[str], labels: dict[str, str] = QUICK, *, stderr: int | None = None
    ) -> Container:
        """Starts one and registers it by the prestart hook."""
        container = self.container(name, argv, stderr=stderr)
        said = container.hook("prestart", labels)
        for _ in range(5):
            # A machine that is busy with much else; to register twice is to register once.
            if "did not answer within" in said:
                said = container.hook("prestart", labels)
        assert said == "", said
        return container

    def close(self) -> None:
        """Ends everything."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        for container in self.containers:
            container.close()

    def _answers(self) -> bool:
        assert self.process is not None
        if self.process.poll() is not None:
            raise AssertionError(f"the sidecar ended with {self.process.returncode}:\n{self.log}")
        try:
            pid: int = self.client.info()["pid"]
            return pid in (self.process.pid, *children_of(self.process.pid))  # it may have a watchdog
        except SidecarUnreachable:
            return False


def _main() -> None:
    main(prog_name="avckpt")


@contextlib.contextmanager
def local_sidecar(directory: Path) -> Iterator[LocalSidecar]:
    """A sidecar that has not been started, in `directory`; everything it knows is ended afterwards."""
    sidecar = LocalSidecar(directory / "run")
    try:
        yield sidecar
    finally:
        sidecar.close()


def hooked_podman(sidecar: LocalSidecar) -> Podman:
    """A Podman whose containers this sidecar protects: with the hooks of this checkout, and no others."""
    folder = sidecar.run_dir.with_name("oci-hooks.d")
    write_hooks(folder, sidecar.run_dir)
    return Podman("--hooks-dir", str(folder))


def app_of(init_pid: int) -> int:
    """The application under an init that is PID 1 of its namespace: its first child there was number 2."""
    for pid in children_of(init_pid):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if inside(pid) == 2:
                return pid
    return 0


def ended(container: Container) -> bool:
    """Whether its init has ended."""
    return has_ended(container.pidfd)
