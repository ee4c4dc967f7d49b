# SPDX-License-Identifier: Apache-2.0
"""The precreate hook on real configurations from Podman 4.3.1.

`hooks_samples/` holds them with what `podman generate spec` printed for the same
container; the seccomp profile was removed, because it is long and not read.  The
hook's Podman is a program that prints that answer.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import subprocess
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from avckpt_hooks import podman
from avckpt_hooks.shared import protocol

SAMPLES = Path(__file__).parent / "hooks_samples"
CHECKOUT = Path(__file__).resolve().parents[2]
HOOK = CHECKOUT / "hooks" / "avckpt-hook"
PROTECTED = ["labelled", "init", "readonly_tty_user", "no_cgroups", "pod"]


@dataclass
class Result:
    status: int
    out: bytes
    said: str
    asked: str
    """The arguments that Podman was called with."""

    @property
    def config(self) -> dict[str, Any]:
        config: dict[str, Any] = json.loads(self.out)
        return config


Hook = Callable[..., Result]


@pytest.fixture
def hook(tmp_path: Path) -> Hook:
    """Runs the real hook program below a process that is called like Podman's."""
    if not (CHECKOUT / "native" / "build" / "avckpt-init").exists():
        pytest.fail("avckpt-init is not built: run make -C native")

    def run(config: bytes, spec: str | None, arguments: tuple[str, ...] = ("run",)) -> Result:
        bin_dir = tmp_path / "bin"
        bin_dir.mkdir(exist_ok=True)
        fake = bin_dir / "podman"
        answer = f"cat {tmp_path}/spec" if spec is not None else "echo 'Error: no such container' >&2; exit 125"
        fake.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/asked\n{answer}\n')
        fake.chmod(0o755)
        (tmp_path / "spec").write_text(spec or "")
        (tmp_path / "asked").write_text("")
        env = {"PATH": f"{bin_dir}:{os.environ['PATH']}", "AVCKPT_RUN_DIR": str(tmp_path / "run")}
        # A shell is the hook's parent; "; exit $?" keeps it from becoming the hook
        # itself.  Not dash: while it waits its own standard error is the hook's.
        done = subprocess.run(
            ["bash", "-c", f"{HOOK} precreate 2>/dev/null; exit $?", *arguments],
            input=config,
            capture_output=True,
            env=env,
            timeout=20,
            check=False,
        )
        return Result(done.returncode, done.stdout, done.stderr.decode(), (tmp_path / "asked").read_text())

    return run


def sample(name: str) -> tuple[bytes, str]:
    return (SAMPLES / f"{name}.config.json").read_bytes(), (SAMPLES / f"{name}.spec.json").read_text()


def with_labels(spec: str, **labels: str) -> str:
    data = json.loads(spec)
    data["labels"] = {f"avckpt.{key.replace('_', '.')}": value for key, value in labels.items()}
    return json.dumps(data)


def test_an_unlabelled_container_passes_byte_for_byte(hook: Hook) -> None:
    config, spec = sample("plain")
    config = config.replace(b'","', b'" ,\n"')  # formatting that no serialiser would give back
    result = hook(config, spec)
    assert result.out == config
    assert (result.status, result.said) == (0, "")


def test_an_unprotected_container_passes_byte_for_byte(hook: Hook) -> None:
    config, spec = sample("labelled")
    result = hook(config, with_labels(spec, enable="false", interval="1s"))
    assert result.out == config


@pytest.mark.parametrize("name", PROTECTED)
def test_init_is_put_in_front_and_nothing_else_touched(hook: Hook, name: str) -> None:
    config, spec = sample(name)
    before = json.loads(config)
    result = hook(config, spec)
    assert result.status == 0
    after = result.config
    args = after["process"].pop("args")
    dashes = args.index("--")
    assert args[:dashes] == [
        "/run/avckpt-init",
        "--wait-ms",
        "2000",
        "--stop-signal",
        "2" if name == "init" else "15",
    ]
    original = before["process"].pop("args")
    assert args[dashes + 1 :] == (original[2:] if name == "init" else original)
    assert after["process"] == before["process"]
    assert after["linux"] == before["linux"]
    mount = after["mounts"].pop()
    assert after["mounts"] == before["mounts"]
    assert mount["destination"] == "/run/avckpt-init"
    assert os.access(mount["source"], os.X_OK)
    assert {"bind", "ro", "nosuid", "nodev"} <= set(mount["options"])
    assert "noexec" not in mount["options"]
    stamped = {key: value for key, value in after["annotations"].items() if key not in before["annotations"]}
    assert stamped.pop("avckpt.version")
    assert stamped.pop("avckpt.name") == "web"
    labels = {key: value for key, value in json.loads(spec)["labels"].items() if key.startswith("avckpt.")}
    assert stamped == labels
    assert json.loads(spec)["name"] == "web"


def test_a_launcher_is_left_as_it_is_and_lent_an_init(hook: Hook) -> None:
    config, spec = sample("labelled")
    before = json.loads(config)
    before["process"]["env"].append("AVCKPT_INIT=/evil")
    result = hook(json.dumps(before).encode(), with_labels(spec, enable="true", scope="nodes"))
    assert (result.status, result.config["hooks"].keys()) == (0, {"prestart", "poststop"})
    after = result.config
    init, units = after["mounts"][-2:]
    assert after["mounts"][:-2] == before["mounts"]
    assert (init["destination"], units["destination"]) == ("/run/avckpt-init", "/run/avckpt-units")
    assert os.access(init["source"], os.X_OK)
    assert Path(units["source"]).is_dir()
    assert all({"bind", "ro", "nosuid", "nodev"} <= set(mount["options"]) for mount in (init, units))
    assert after["process"].pop("env") == [*before["process"].pop("env")[:-1], "AVCKPT_INIT=/run/avckpt-init"]
    assert after["process"] == before["process"]
    # The hook stands in two directories.
    assert hook(result.out, with_labels(spec, enable="true", scope="nodes")).out == result.out


def test_the_other_two_hooks_are_added_behind_those_that_are_there(hook: Hook) -> None:
    config, spec = sample("labelled")
    data = json.loads(config)
    theirs = {"path": "/bin/true", "args": ["true"]}
    data["hooks"] = {"prestart": [theirs]}
    hooks = hook(json.dumps(data).encode(), spec).config["hooks"]
    assert hooks["prestart"][0] == theirs
    for stage in ("prestart", "poststop"):
        ours = hooks[stage][-1]
        assert ours["path"] == str(HOOK)
        assert ours["args"][:2] == ["avckpt-hook", stage]
        assert any(entry.startswith("PATH=") for entry in ours["env"])
        assert any(entry.startswith("AVCKPT_RUN_DIR=") for entry in ours["env"])


def test_a_second_time_changes_nothing(hook: Hook) -> None:
    config, spec = sample("labelled")
    once = hook(config, spec).out
    assert hook(once, spec).out == once


def make_directory(path: Path) -> None:
    path.mkdir()


def make_file(path: Path) -> None:
    path.write_text("its own")


def make_link(path: Path) -> None:
    path.symlink_to("/etc/passwd")


def make_loop(path: Path) -> None:
    path.symlink_to(path.name)


def make_fifo(path: Path) -> None:
    os.mkfifo(path)


@pytest.mark.parametrize("make", [make_directory, make_file, make_link, make_loop, make_fifo])
@pytest.mark.parametrize("where", ["image", "volume"])
def test_what_a_container_has_in_inits_place_stays_there(
    hook: Hook, make: Callable[[Path], None], where: str, tmp_path: Path
) -> None:
    """Over a directory or an endless link the runtime can mount nothing; a link would lead to another file."""
    config, spec = sample("labelled")
    data = json.loads(config)
    data["root"]["path"] = str(tmp_path / "root")
    (tmp_path / "root" / "run").mkdir(parents=True)
    (tmp_path / "volume").mkdir()
    folder = tmp_path / "root" / "run"
    if where == "volume":
        make_directory(folder / "avckpt-init")  # which the volume hides
        folder = tmp_path / "volume"
        data["mounts"].append({"destination": "/run/", "type": "bind", "source": str(folder), "options": ["rbind"]})
    config = json.dumps(data).encode()
    # As it is after each earlier start.
    (folder / "avckpt-init").touch()
    assert hook(config, spec).config["process"]["args"][0] == "/run/avckpt-init"
    (folder / "avckpt-init").unlink()
    make(folder / "avckpt-init")
    result = hook(config, spec)
    assert result.out == config
    assert "web runs unprotected: it has a /run/avckpt-init of its own" in result.said


def test_what_is_mounted_in_inits_place_stays_there(hook: Hook) -> None:
    config, spec = sample("labelled")
    data = json.loads(config)
    data["mounts"].append({"destination": "/run/avckpt-init", "type": "bind", "source": "/tmp", "options": ["rbind"]})
    config = json.dumps(data).encode()
    result = hook(config, spec)
    assert result.out == config
    assert "it has a /run/avckpt-init of its own" in result.said


def test_a_launcher_with_something_in_the_place_of_its_units(hook: Hook, tmp_path: Path) -> None:
    config, spec = sample("labelled")
    data = json.loads(config)
    data["root"]["path"] = str(tmp_path / "root")
    (tmp_path / "root" / "run").mkdir(parents=True)
    make_file(tmp_path / "root" / "run" / "avckpt-units")
    config = json.dumps(data).encode()
    result = hook(config, with_labels(spec, enable="true", scope="nodes"))
    assert result.out == config
    assert "it has a /run/avckpt-units of its own" in result.said


def test_a_bad_label_fails_and_tells_the_one_who_started_podman(hook: Hook) -> None:
    config, spec = sample("labelled")
    result = hook(config, with_labels(spec, enable="true", interval="banana"))
    assert result.status != 0
    assert result.out == b""
    assert result.said.startswith("avckpt: container web: label avckpt.interval=banana: not a duration; allowed: ")
    assert result.said.count("\n") == 1


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("avckpt_enable", "did you mean avckpt.enable?"),
        ("avckpt", "did you mean avckpt.enable?"),
        ("avckpt-enable", "did you mean avckpt.enable?"),
        ("AVCKPT.enable", "did you mean avckpt.enable?"),
        ("Avckpt.Restore_On", "did you mean avckpt.restore.on?"),
        ("avckpt_colour", "avckpt's begin with avckpt."),
        ("avkpt.enable", "did you mean avckpt.enable?"),
        ("avcpkt.interval", "did you mean avckpt.interval?"),
    ],
)
def test_a_label_that_looks_like_one_of_ours_is_said(hook: Hook, key: str, hint: str) -> None:
    config, spec = sample("plain")
    spec = json.dumps({**json.loads(spec), "labels": {key: "true"}})
    name = json.loads(spec)["name"]
    result = hook(config, spec)
    assert (result.status, result.out) == (0, config)
    assert result.said == f"avckpt: container {name}: the label {key} means nothing; {hint}\n"
    annotated = json.loads(config)
    annotated["annotations"][key] = "true"
    assert f"the label {key} means nothing" in hook(json.dumps(annotated).encode(), None).said


def test_an_image_cannot_have_warnings_without_end(hook: Hook) -> None:
    config, spec = sample("labelled")
    about = json.loads(spec)
    about["labels"].update({f"avckpt-{i}": "true" for i in range(20000)})
    result = hook(config, json.dumps(about))
    assert result.status == 0
    assert result.said.count("means nothing") == 16


def test_a_client_of_the_rest_service_finds_the_reason_in_the_configuration(hook: Hook) -> None:
    config, spec = sample("labelled")
    result = hook(config, with_labels(spec, enable="true", keep="99"), ("system", "service"))
    assert result.status == 0
    [broken] = result.config["hooks"]["prestart"]
    assert broken["path"].startswith("avckpt: container web: label avckpt.keep=99: ")


def test_without_a_sidecar_the_user_is_told(hook: Hook) -> None:
    config, spec = sample("labelled")
    result = hook(config, spec)
    assert "container web runs unprotected until the sidecar is started" in result.said
    assert "--told" in result.config["hooks"]["prestart"][-1]["args"]


@pytest.mark.parametrize("comes", [True, False])
def test_a_sidecar_that_is_starting_is_waited_for(
    hook: Hook, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, comes: bool
) -> None:
    monkeypatch.setenv("AVCKPT_RUN_DIR", str(tmp_path / "run"))
    (tmp_path / "run").mkdir()
    config, spec = sample("labelled")
    with open(protocol.starting_lock(), "w") as starting, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as hooks:
        fcntl.flock(starting, fcntl.LOCK_SH)
        hooks.bind(protocol.hooks_socket())

        def step() -> None:
            (hooks.listen if comes else starting.close)()

        timer = threading.Timer(1.0, step)
        timer.start()
        result = hook(config, spec)
        early = timer.is_alive()
        timer.join()
    assert not early
    assert ("runs unprotected until the sidecar is started" in result.said) is not comes


def test_labels_that_can_not_be_read_let_the_container_start_and_are_said(hook: Hook) -> None:
    config, _ = sample("plain")
    result = hook(config, None)
    assert (result.status, result.out) == (0, config)
    assert "cannot read a container's labels (podman generate spec: Error: no such container)" in result.said


def test_annotations_are_enough_when_labels_can_not_be_read(hook: Hook) -> None:
    config, _ = sample("readonly_tty_user")
    assert hook(config, None).config["process"]["args"][0] == "/run/avckpt-init"


def test_annotations_of_one_container_reach_no_other(hook: Hook) -> None:
    """As `podman kube play` gives all of a pod's to each of its containers."""
    config, spec = sample("plain")
    name = json.loads(spec)["name"]
    data = json.loads(config)
    data["annotations"].update({f"avckpt.enable/{name}": "true", "avckpt.keep/other": "4"})
    result = hook(json.dumps(data).encode(), spec)
    assert result.config["process"]["args"][0] == "/run/avckpt-init"
    stamped = {key: value for key, value in result.config["annotations"].items() if key.startswith("avckpt.")}
    assert stamped["avckpt.enable"] == "true"
    assert not any("/" in key for key in stamped)
    data["annotations"] = {"avckpt.enable/other": "true"}
    result = hook(json.dumps(data).encode(), spec)
    assert (result.status, result.config["process"]["args"]) == (0, data["process"]["args"])


@pytest.mark.parametrize(
    "command", ["/sbin/init", "/usr/local/sbin/init", "/init", "/opt/systemd/systemd --user", "s6-svscan /etc/s6"]
)
def test_what_must_itself_be_process_1_is_left_alone(hook: Hook, command: str) -> None:
    config, spec = sample("labelled")
    data = json.loads(config)
    data["process"]["args"] = command.split()
    config = json.dumps(data).encode()
    result = hook(config, spec)
    assert result.out == config
    assert result.said == (
        f"avckpt: container web runs unprotected: its command is {command.split()[0]}, which must itself be PID 1; "
        "to protect its program, start that without it (--entrypoint)\n"
    )


def test_what_podman_takes_for_systemd_is_left_alone(hook: Hook) -> None:
    config, spec = sample("labelled")
    data = json.loads(config)
    # As Podman does for --systemd=always, and by default for the commands it knows.
    data["process"]["env"].append(f"container_uuid={podman.container_id(config)[:32]}")
    config = json.dumps(data).encode()
    result = hook(config, spec)
    assert result.out == config
    assert result.said == (
        "avckpt: container web runs unprotected: Podman starts it as systemd, which must itself be PID 1; "
        "if it is none, give --systemd=false\n"
    )
    data["process"]["env"][-1] = "container_uuid=of the user's own"
    assert hook(json.dumps(data).encode(), spec).config["process"]["args"][0] == "/run/avckpt-init"


def test_nonsense_on_standard_input_comes_out_again(hook: Hook) -> None:
    result = hook(b'{"avckpt.": ', None)
    assert (result.status, result.out) == (0, b'{"avckpt.": ')
    assert "runs unprotected" in result.said


def test_podman_is_asked_for_the_container_of_the_configuration(hook: Hook) -> None:
    config, spec = sample("pod")
    wanted = podman.container_id(config)
    assert hook(config, spec).asked.splitlines()[0].split() == ["generate", "spec", "-c", "-n=false", wanted]


@pytest.mark.parametrize("name", ["plain", *PROTECTED])
def test_the_id_is_that_of_the_container(name: str) -> None:
    config, _ = sample(name)
    found = podman.container_id(config)
    [mounted] = [m["source"] for m in json.loads(config)["mounts"] if m["destination"] == "/etc/hostname"]
    assert mounted.endswith(f"-containers/{found}/userdata/hostname")
    # Podman names a container's host after its id.
    assert f"HOSTNAME={found[:12]}" in json.loads(config)["process"]["env"] or name == "pod"


@pytest.mark.parametrize(
    "path",
    [
        "machine.slice:libpod:{id}",
        "/machine.slice/libpod-{id}.scope",
        "machine-libpod_pod_{other}.slice:libpod:{id}",
        "/libpod_parent/{other}/libpod-{id}",
        "/libpod_parent/libpod-{id}/container",
    ],
)
def test_the_id_in_every_shape_of_a_cgroup_path(path: str) -> None:
    path = path.format(id="ab" * 32, other="cd" * 32)
    config = json.dumps(
        {"annotations": {"cgroupsPath": "ef" * 32}, "linux": {"cgroupsPath": path}}, separators=(",", ":")
    )
    assert podman.container_id(config.encode()) == "ab" * 32


def test_the_id_without_a_cgroup_and_without_containerenv() -> None:
    config, _ = sample("readonly_tty_user")
    wanted = podman.container_id(config)
    data = json.loads(config)
    del data["linux"]["cgroupsPath"]
    assert podman.container_id(json.dumps(data).encode()) == wanted


def test_no_id_is_said_so() -> None:
    with pytest.raises(podman.Unknown):
        podman.container_id(b'{"linux":{"cgroupsPath":"/split"},"mounts":[]}')


@pytest.mark.parametrize(
    ("line", "flags"),
    [
        ("podman run x", []),
        ("podman --root /a --runroot=/b run --root /c x", ["--root=/a", "--runroot=/b"]),
        ("podman --log-level debug --remote=false --root /a run", ["--root=/a"]),
        (
            "podman --syslog --hooks-dir /h --storage-opt a=b --storage-opt=c=d create",
            ["--storage-opt=a=b", "--storage-opt=c=d"],
        ),
        ("podman --transient-store --root /a run", ["--transient-store", "--root=/a"]),
        ("podman --root /a --transient-store=true container", ["--root=/a", "--transient-store=true"]),
        ("podman --tmpdir", []),
    ],
)
def test_the_flags_that_say_where_containers_are(line: str, flags: list[str]) -> None:
    assert podman.store_flags(line.split()) == flags


def test_flags_behind_the_subcommand_are_found_when_looked_for() -> None:
    assert podman.store_flags(["podman", "run", "--root", "/c", "-d", "x"], anywhere=True) == ["--root=/c"]


def test_one_that_only_listens_is_made_known_and_not_touched(hook: Hook) -> None:
    config, spec = sample("plain")
    before = json.loads(config)
    result = hook(config, with_labels(spec, group="g", notify="signal:USR1"))
    assert (result.status, result.said) == (0, "")
    after = result.config
    annotations, hooks = after.pop("annotations"), after.pop("hooks")
    assert (
        annotations.items() >= {"avckpt.group": "g", "avckpt.notify": "signal:USR1", "avckpt.version": "0.1.0"}.items()
    )
    assert {"prestart", "poststop"} <= hooks.keys()
    for each in ("annotations", "hooks"):
        before.pop(each, None)
    assert after == before
    # Without a group there is nobody to hear of, and nothing to do.
    assert hook(config, with_labels(spec, notify="signal:USR1")).out == config


IO_URING = {"io_uring_setup", "io_uring_enter", "io_uring_register", "io_setup"}


@pytest.mark.parametrize(
    "seccomp",
    [
        None,
        {
            "defaultAction": "SCMP_ACT_ERRNO",
            "syscalls": [
                {"names": ["read", "io_uring_enter", "io_setup", "io_uring_setup"], "action": "SCMP_ACT_ALLOW"},
                {"names": ["io_uring_register"], "action": "SCMP_ACT_ALLOW"},
            ],
        },
    ],
)
def test_io_uring_is_taken_away_by_the_seccomp_profile(hook: Hook, seccomp: dict[str, Any] | None) -> None:
    config, spec = (json.loads((SAMPLES / f"labelled.{kind}.json").read_text()) for kind in ("config", "spec"))
    if seccomp is not None:
        config["linux"]["seccomp"] = seccomp
    spec["labels"]["avckpt.io_uring"] = "off"
    profile = hook(json.dumps(config).encode(), json.dumps(spec)).config["linux"]["seccomp"]
    rules = [(set(rule["names"]), rule["action"]) for rule in profile["syscalls"]]
    assert rules[-1] == (IO_URING, "SCMP_ACT_ERRNO")
    assert profile["syscalls"][-1]["errnoRet"] == 38
    assert all(not names & IO_URING for names, _ in rules[:-1])
    if seccomp is None:
        assert profile["defaultAction"] == "SCMP_ACT_ALLOW"
        assert len(rules) == 1
    else:
        assert rules[0] == ({"read"}, "SCMP_ACT_ALLOW")
        assert profile["defaultAction"] == "SCMP_ACT_ERRNO"
