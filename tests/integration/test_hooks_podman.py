# SPDX-License-Identifier: Apache-2.0
"""The hooks under a real Podman: what a container, a sidecar and a user see of them.

Where a test is about what hooks say to the sidecar, a few lines that speak the
real protocol stand in for it: the sidecar has tests of its own.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from avckpt_hooks.shared import protocol

from testkit.harness import (
    ROOT,
    SLOWNESS,
    Container,
    ContainerFactory,
    Podman,
    avckpt_command,
    hooks_installed,
    run,
    wait_until,
    write_hooks,
)

SHARED = pytest.mark.shared_machine("hooks give up after seconds, and come later than that where they get no CPU")
CRUN_DIES = "crun dies of SIGPIPE, if a hook that is not there fails before it is written to"

INIT = "/run/avckpt-init --wait-ms 2000 --stop-signal"
# With the newline that journald waits for.
SHOW_PID_1 = "tr '\\0' ' ' </proc/1/cmdline; echo"


@pytest.fixture
def run_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The run directory that these hooks share with their sidecar."""
    monkeypatch.setenv("AVCKPT_RUN_DIR", str(tmp_path / "run"))
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


@pytest.fixture
def hooks_dir(tmp_path: Path, run_dir: Path) -> Path:
    """The project's hook JSON, pointing to the hooks of this checkout."""
    if not (ROOT / "native" / "build" / "avckpt-init").exists():
        pytest.fail("avckpt-init is not built: run make -C native")
    folder = tmp_path / "oci-hooks.d"
    write_hooks(folder, run_dir)
    return folder


@pytest.fixture
def hooked(podman: Podman, hooks_dir: Path) -> Podman:
    """Podman with these hooks and no others."""
    return Podman("--hooks-dir", str(hooks_dir))


@pytest.fixture
def make(hooked: Podman, base_image: str) -> Iterator[ContainerFactory]:
    factory = ContainerFactory(hooked, f"avckpt-hooks-{os.getpid()}")
    yield factory
    factory.close()


@pytest.fixture
def name(podman: Podman) -> Iterator[str]:
    """The name of a container that the test runs in the foreground."""
    chosen = f"avckpt-hooks-{os.getpid()}-front"
    yield chosen
    podman.remove(chosen)


class Receiver:
    """Answers hooks as a sidecar would, and records their requests."""

    def __init__(self) -> None:
        self.registered: list[protocol.Register] = []
        self.deregistered: list[str] = []
        self.pids: list[int] = []
        """What each pidfd stood for."""
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(protocol.hooks_socket())
        self._listener.listen(8)
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            # precreate only looks whether anybody is there.
            with connection, contextlib.suppress(OSError, protocol.ProtocolError):
                request, pidfd = protocol.receive_request(connection)
                if isinstance(request, protocol.Register):
                    assert pidfd is not None
                    fdinfo = Path(f"/proc/self/fdinfo/{pidfd}").read_text()
                    self.pids.append(int(fdinfo.split("\nPid:")[1].split()[0]))
                    os.close(pidfd)
                    self.registered.append(request)
                else:
                    self.deregistered.append(request.id)
                connection.send(protocol.encode_reply())

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()


@pytest.fixture
def receiver(run_dir: Path) -> Iterator[Receiver]:
    receiver = Receiver()
    yield receiver
    receiver.close()


def foreground(
    podman: Podman, name: str, *args: str, image: str = "", command: str = SHOW_PID_1
) -> tuple[int, str, str]:
    """`podman run ARGS IMAGE sh -c COMMAND`: status, standard output and standard error."""
    full = ("run", "--pull=never", "--name", name, *args, *([image] if image else []), "sh", "-c", command)
    done = podman.run(*full, check=False)
    return done.status, done.stdout, done.stderr


def records(run_dir: Path) -> list[str]:
    folder = run_dir / "containers"
    return sorted(os.listdir(folder)) if folder.exists() else []


def test_an_unlabelled_container_is_left_alone(hooked: Podman, run_dir: Path, base_image: str, name: str) -> None:
    status, out, err = foreground(hooked, name, "--network=none", image=base_image)
    assert (status, err) == (0, "")
    assert out.startswith("sh -c")
    config = json.loads(Path(hooked.inspect(name)["OCIConfigPath"]).read_text())
    assert not [key for key in config["annotations"] if key.startswith("avckpt.")]
    assert not [mount for mount in config["mounts"] if "avckpt" in mount["destination"]]
    assert not config.get("hooks")
    assert records(run_dir) == []


OPTIONS = {
    "plain": [],
    "init": ["--init"],
    "read-only": ["--read-only"],
    "user": ["--user", "1000:1000"],
    "terminal": ["-t"],
    "host network": ["--network=host"],
    "no cgroup": ["--cgroups=disabled"],
    "tmpfs on /run": ["--tmpfs", "/run"],
    "no capabilities": ["--cap-drop=all", "--security-opt=no-new-privileges"],
    "privileged": ["--privileged"],
    "runc": ["--runtime", "runc"],
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS.keys())
def test_init_runs_in_front_of_a_protected_container(
    hooked: Podman, receiver: Receiver, base_image: str, name: str, options: list[str]
) -> None:
    if "runc" in options and shutil.which("runc") is None:
        pytest.skip("runc is not installed")
    podman = Podman(*hooked.command[1:], *options) if "--runtime" in options else hooked
    options = [] if "--runtime" in options else options
    network = [] if "--network=host" in options else ["--network=none"]
    # Whoami and rights say that nothing about the process has changed.
    command = f"{SHOW_PID_1}; id -u; grep CapEff /proc/self/status; test -t 1 && echo terminal; exit 7"
    status, out, err = foreground(
        podman, name, "--label", "avckpt.enable=true", *network, *options, image=base_image, command=command
    )
    assert (status, err) == (7, "")
    lines = out.replace("\r\n", "\n").splitlines()
    assert lines[0].startswith(f"{INIT} 15 -- sh -c tr")
    plain_name = f"{name}-plain"
    try:
        _, plain, _ = foreground(podman, plain_name, *network, *options, image=base_image, command=command)
    finally:
        podman.remove(plain_name)
    assert lines[1:] == plain.replace("\r\n", "\n").splitlines()[1:]
    assert hooked.inspect(name)["Config"]["Cmd"][0] == "sh"


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--systemd=always"], "Podman starts it as systemd"),
        (["--entrypoint", '["/init", "-c"]'], "its command is /init"),
    ],
    ids=["systemd", "s6-overlay"],
)
def test_what_must_be_process_1_is_left_alone(
    *, hooked: Podman, receiver: Receiver, base_image: str, name: str, tmp_path: Path, options: list[str], why: str
) -> None:
    init = tmp_path / "init"
    init.write_text('#!/bin/sh\nexec sh "$@"\n')
    init.chmod(0o755)
    full = ["--label", "avckpt.enable=true", "--network=none", "--volume", f"{init}:/init:ro", *options]
    words = [SHOW_PID_1] if "--entrypoint" in options else ["sh", "-c", SHOW_PID_1]
    done = hooked.run("run", "--pull=never", "--name", name, *full, base_image, *words)
    assert not done.stdout.startswith(INIT)
    assert done.stderr.startswith(f"avckpt: container {name} runs unprotected: {why}, which must itself be PID 1; ")
    assert done.stderr.count("\n") == 1
    assert receiver.registered == []


def test_output_for_the_log_goes_to_process_2(hooked: Podman, receiver: Receiver, base_image: str, name: str) -> None:
    """Cron images write to /proc/1/fd/1; under avckpt-init process 1 is not the application."""
    command = "for n in 1 2; do (echo by way of $n >>/proc/$n/fd/1) 2>/dev/null; done; cat /proc/1/comm"
    options = ["--label", "avckpt.enable=true", "--network=none"]
    _, out, _ = foreground(hooked, name, *options, image=base_image, command=command)
    assert out.splitlines() == ["by way of 2", "avckpt-init"]


def test_the_stop_signal_reaches_init(hooked: Podman, receiver: Receiver, base_image: str, name: str) -> None:
    options = ["--label", "avckpt.enable=true", "--network=none", "--stop-signal", "SIGINT"]
    _, out, _ = foreground(hooked, name, *options, image=base_image)
    assert out.startswith(f"{INIT} 2 -- sh")


def test_annotations_protect_too(hooked: Podman, receiver: Receiver, base_image: str, name: str) -> None:
    _, out, _ = foreground(hooked, name, "--annotation", "avckpt.enable=true", "--network=none", image=base_image)
    assert out.startswith(INIT)


def test_labels_of_the_image_protect_too(hooked: Podman, receiver: Receiver, make: ContainerFactory, name: str) -> None:
    image = f"localhost/avckpt-hooks-{os.getpid()}"
    hooked.run("commit", "--change", "LABEL avckpt.enable=true", make("true", options=["--network=none"]).name, image)
    try:
        _, out, _ = foreground(hooked, name, "--network=none", image=image)
        hooked.remove(name)
    finally:
        hooked.run("rmi", image)
    assert out.startswith(INIT)


def test_a_pod_that_shares_its_pid_namespace(hooked: Podman, receiver: Receiver, base_image: str, name: str) -> None:
    pod = f"{name}-pod"
    hooked.run("pod", "create", "--name", pod, "--share", "pid")
    try:
        options = ["--label", "avckpt.enable=true", "--pod", pod]
        # Not process 1, so the parent of the shell.
        status, out, _ = foreground(
            hooked, name, *options, image=base_image, command="tr '\\0' ' ' </proc/$PPID/cmdline; exit 5"
        )
    finally:
        hooked.run("pod", "rm", "--force", "--time", "0", pod)
    assert (status, out.startswith(INIT)) == (5, True)
    assert [registration.name for registration in receiver.registered] == [name]


def test_containers_of_another_store(podman: Podman, hooked: Podman, receiver: Receiver, base_image: str) -> None:
    rootfs = podman.run("image", "mount", base_image).stdout.strip()
    # Podman wants a short path here.
    store = tempfile.mkdtemp(prefix="avckpt-", dir="/tmp")
    options = ["--root", f"{store}/root", "--runroot", f"{store}/run", "--tmpdir", f"{store}/tmp"]
    other = Podman(*hooked.command[1:], *options)
    try:
        options = ["--rm", "--label", "avckpt.enable=true", "--network=none", "--rootfs", f"{rootfs}:O"]
        status, out, err = foreground(other, "web", *options)
    finally:
        podman.run("image", "unmount", base_image)
        subprocess.run(["umount", f"{store}/root/overlay"], check=False, stderr=subprocess.DEVNULL)
        shutil.rmtree(store)
    # In a store that it has never seen, Podman 4 looks at CNI's files, and may find the plugins missing.
    said = [line for line in err.splitlines() if "Error validating CNI config file" not in line]
    assert (status, said) == (0, [])
    assert out.startswith(INIT)


def test_a_container_registers_and_deregisters(
    make: ContainerFactory, receiver: Receiver, run_dir: Path, podman: Podman
) -> None:
    container = make.protected("sleep", "300", labels={"interval": "500ms"}, options=["--network=none"])
    [registration] = receiver.registered
    assert (registration.id, registration.name, registration.pid) == (container.id, container.name, container.pid)
    assert receiver.pids == [container.pid]
    assert registration.annotations["avckpt.interval"] == "500ms"
    assert Path(registration.bundle, "config.json").exists()
    record = json.loads(Path(protocol.record_path(container.id)).read_text())
    assert protocol.Register.from_record(record).record() == registration.record()
    assert receiver.deregistered == []

    container.stop(timeout_s=3)
    assert receiver.deregistered == [container.id]
    assert records(run_dir) == []

    podman = make.podman
    podman.run("start", container.name)
    assert [again.pid for again in receiver.registered] == [registration.pid, container.pid]
    assert records(run_dir) == [f"{container.id}.json"]

    podman.run("kill", "--signal", "KILL", container.name)
    # The record goes first, and `podman kill` waits for neither.
    wait_until(lambda: records(run_dir) == [], 5, "record removed after podman kill")
    wait_until(lambda: receiver.deregistered == [container.id] * 2, 5, "deregistered after podman kill")


def test_a_container_removed_by_force_deregisters(make: ContainerFactory, receiver: Receiver, run_dir: Path) -> None:
    container = make.protected("sleep", "300", options=["--network=none"])
    assert records(run_dir) == [f"{container.id}.json"]
    make.podman.run("rm", "--force", "--time", "0", container.name)
    assert records(run_dir) == []
    assert receiver.deregistered == [container.id]


def test_a_bad_label_is_refused_where_the_user_sees_it(
    hooked: Podman, run_dir: Path, base_image: str, name: str
) -> None:
    status, out, err = foreground(
        hooked,
        name,
        *("--network=none", "--label", "avckpt.enable=true", "--label", "avckpt.interval=banana"),
        image=base_image,
    )
    assert (status, out) == (126, "")
    assert err.startswith(
        f"avckpt: container {name}: label avckpt.interval=banana: not a duration; "
        "allowed: auto, or a number with ms, s, m or h, from 10ms to 24h, as 500ms, 3s or 1m\n"
    )
    assert records(run_dir) == []


@pytest.mark.parametrize(
    ("label", "status", "shown"),
    [
        ("avckpt.\x1b]0;x\x07\nfake: line", 126, "label avckpt.?]0;x??fake: line: unknown label; "),
        ("avckpt_\x1b[2J\nfake: line", 0, r"the label avckpt_\x1b[2J\nfake: line means nothing; "),
    ],
)
def test_what_a_label_is_called_does_nothing_to_the_terminal(
    *, hooked: Podman, receiver: Receiver, base_image: str, name: str, label: str, status: int, shown: str
) -> None:
    done = foreground(hooked, name, "--network=none", "--label", f"{label}=1", image=base_image)
    assert done[0] == status
    line = done[2].splitlines()[0]
    assert line.startswith(f"avckpt: container {name}: {shown}")
    assert line.isprintable()


def test_a_bad_label_is_refused_in_the_background_too(make: ContainerFactory) -> None:
    done = make.podman.run(
        *("run", "--detach", "--rm", "--network=none", "--pull=never", "--label", "avckpt.enabled=true"),
        *("localhost/avckpt-base", "true"),
        check=False,
    )
    assert done.status == 126
    assert ": label avckpt.enabled: unknown label; did you mean avckpt.enable?\n" in done.stderr


@pytest.mark.parametrize("runtime", ["crun", "runc"])
def test_a_client_of_the_service_is_told_too(
    hooked: Podman, base_image: str, name: str, tmp_path: Path, runtime: str
) -> None:
    if shutil.which(runtime) is None:
        pytest.skip(f"{runtime} is not installed")
    from podman import PodmanClient
    from podman.errors import APIError

    path = tmp_path / "podman.sock"
    command = [*hooked.command, "--runtime", runtime, "system", "service", "--time", "0", f"unix://{path}"]
    service = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    try:
        wait_until(path.exists, 10, "Podman's service")
        with PodmanClient(base_url=f"unix://{path}") as client:
            labels = {"avckpt.enable": "true", "avckpt.keep": "99"}
            made = client.containers.create(base_image, ["true"], name=name, labels=labels, network_mode="none")
            with pytest.raises(APIError, match=f"avckpt: container {name}: label avckpt.keep=99: not within 1 to 16"):
                made.start()
    finally:
        service.terminate()
        service.wait(timeout=10)


@pytest.mark.parametrize("how", ["foreground", "background"])
def test_without_a_sidecar_a_container_runs_and_the_user_is_told(
    make: ContainerFactory, run_dir: Path, base_image: str, name: str, how: str
) -> None:
    options = ["--label", "avckpt.enable=true", "--network=none"]
    if how == "background":
        options.append("--detach")
    status, _, err = foreground(make.podman, name, *options, image=base_image)
    assert status == 0
    assert err == (
        f"avckpt: container {name} runs unprotected until the sidecar is started "
        f"({run_dir}/hooks.sock: No such file or directory)\n"
    )


@SHARED
def test_a_stuck_sidecar_does_not_keep_a_container_from_running(
    make: ContainerFactory, run_dir: Path, base_image: str
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as stuck:
        stuck.bind(protocol.hooks_socket())
        stuck.listen(8)
        container = make.protected("sh", "-c", f"{SHOW_PID_1}; sleep 300", options=["--network=none"])
        logs = container.wait_for_log(INIT)
        assert f"avckpt: container {container.name} runs unprotected: the sidecar did not answer within 1 s" in logs
        assert records(run_dir) == [f"{container.id}.json"]  # a sidecar that is started again adopts it
        container.stop(timeout_s=3)
    assert records(run_dir) == []


def test_a_broken_hook_does_not_keep_a_container_from_running(
    podman: Podman, hooks_dir: Path, tmp_path: Path, base_image: str, name: str
) -> None:
    """An installation with a missing file, as after an interrupted upgrade."""
    broken = tmp_path / "libexec"
    shutil.copytree(ROOT / "hooks", broken, symlinks=True)
    (broken / "avckpt_hooks" / "shared" / "labels.py").unlink()
    [hook_json] = hooks_dir.glob("*.json")
    hook_json.write_text(hook_json.read_text().replace(str(ROOT / "hooks"), str(broken)))
    status, out, err = foreground(
        Podman("--hooks-dir", str(hooks_dir)),
        name,
        *("--label", "avckpt.enable=true", "--network=none"),
        image=base_image,
    )
    assert status == 0
    assert out.startswith("sh -c")
    assert err.startswith("avckpt: a container runs unprotected: ")


@SHARED
@pytest.mark.parametrize(("stage", "seconds"), [("precreate", 11), ("prestart", 6)])
def test_a_slow_machine_does_not_keep_a_container_from_running(
    *, podman: Podman, hooks_dir: Path, tmp_path: Path, base_image: str, name: str, stage: str, seconds: int
) -> None:
    """A runtime that kills a hook for its timeout does not start the container, so hooks give up earlier."""
    slow = tmp_path / "libexec"
    shutil.copytree(ROOT / "hooks", slow, symlinks=True)
    shutil.copy(ROOT / "native" / "build" / "avckpt-init", slow)
    main = slow / "avckpt_hooks" / "__main__.py"
    delay = f"import time\nif sys.argv[1] == {stage!r}:\n    time.sleep({seconds})\n"
    main.write_text(main.read_text().replace("import sys\n", f"import sys\n{delay}", 1))
    [hook_json] = hooks_dir.glob("*.json")
    hook_json.write_text(hook_json.read_text().replace(str(ROOT / "hooks"), str(slow)))
    status, out, _ = foreground(
        Podman("--hooks-dir", str(hooks_dir)),
        name,
        *("--label", "avckpt.enable=true", "--network=none"),
        image=base_image,
    )
    assert status == 0
    assert out.startswith(INIT)


def test_uninstalled_while_a_container_runs(machine: None, podman: Podman, name: str) -> None:
    """The container still ends in an orderly way; the last hook is removed only after that."""
    factory = ContainerFactory(podman, name)
    with hooks_installed(), contextlib.ExitStack() as undo:
        undo.callback(run, [*avckpt_command(), "install"])  # others may count on them
        undo.callback(factory.close)
        container = factory.protected("sh", "-c", f"{SHOW_PID_1}; sleep 300", options=["--network=none"])
        container.wait_for_log(INIT)
        said = run([*avckpt_command(), "uninstall"]).stdout
        assert f"left /usr/local/libexec/avckpt/avckpt-hook: {container.name} will call it when ended" in said
        container.stop(timeout_s=3)
        assert container.status == "exited"
        assert not os.path.exists(protocol.record_path(container.id))
        assert "avckpt-hook" in run([*avckpt_command(), "uninstall"]).stdout
        assert not os.path.exists("/usr/local/libexec/avckpt")


@pytest.mark.skipif(SLOWNESS > 1, reason=CRUN_DIES)
@pytest.mark.shared_machine(CRUN_DIES)
def test_hooks_that_go_away_do_not_keep_a_container_from_ending(
    podman: Podman, hooks_dir: Path, tmp_path: Path, base_image: str, run_dir: Path
) -> None:
    """The hooks were deleted by hand while the container ran."""
    libexec = tmp_path / "libexec"
    shutil.copytree(ROOT / "hooks", libexec, symlinks=True)
    shutil.copy(ROOT / "native" / "build" / "avckpt-init", libexec)
    [hook_json] = hooks_dir.glob("*.json")
    hook_json.write_text(hook_json.read_text().replace(str(ROOT / "hooks"), str(libexec)))
    factory = ContainerFactory(Podman("--hooks-dir", str(hooks_dir)), f"avckpt-hooks-{os.getpid()}-gone")
    try:
        container = factory.protected("sh", "-c", f"{SHOW_PID_1}; sleep 300", options=["--network=none"])
        container.wait_for_log(INIT)
        shutil.rmtree(libexec)
        container.stop(timeout_s=3)
        assert container.status == "exited"
        factory.podman.run("start", container.name)
        assert container.wait_for_log("sh -c", count=2).count(INIT) == 1
    finally:
        factory.close()


def test_podmans_own_restarts_keep_the_hooks(machine: None, podman: Podman, base_image: str, name: str) -> None:
    with hooks_installed():
        options = ["--label", "avckpt.enable=true", "--label", "avckpt.restore.on=signal", "--restart=on-failure:2"]
        podman.run(
            *("run", "--detach", "--pull=never", "--name", name, "--network=none", *options),
            *(base_image, "sh", "-c", f"{SHOW_PID_1}; exit 3"),
        )
        container = Container(podman, name, "")
        container.wait_for_log(INIT, count=3)
        assert container.wait() == 3
        shown = [line for line in container.logs().splitlines() if "sh -c" in line]
        assert len(shown) == 3
        assert all(line.startswith(INIT) for line in shown)
