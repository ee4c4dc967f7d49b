# SPDX-License-Identifier: Apache-2.0
"""avckpt doctor: its results for machines unlike this one."""

from __future__ import annotations

import dataclasses
import socket
import subprocess
from pathlib import Path

import avckpt
import pytest
from avckpt.cli import doctor, install
from avckpt.cli.doctor import ConfigFacts, Facts, PodmanFacts, Status

GOOD = Facts(
    kernel="6.1.0-18-amd64",
    machine="x86_64",
    capabilities=(1 << 41) - 1,
    in_container=False,
    yama_scope=1,
    ns_last_pid=True,
    map_files=True,
    pidfd=True,
    core_pattern="core",
    podman=PodmanFacts("4.3.1", "crun", False, "/usr/share/containers/seccomp.json"),
    hooks_dir_problems=(),
    service=None,
    service_problems=(),
    installed_version=avckpt.__version__,
    missing_files=(),
    outdated_files=(),
    hook_problem="",
    init_problem="",
    sidecar_version=avckpt.__version__,
    sidecar_problem="",
    sidecar_outdated=False,
    sidecar_blind=False,
    engine_problem="",
    config=ConfigFacts("/etc/avckpt/config.yaml", True, ""),
)
OTHER = PodmanFacts("4.2.0", "crun", False, "")
REMOTE = PodmanFacts("4.3.1", "crun", False, "", remote=True)


def test_a_good_machine() -> None:
    found = doctor.judge(GOOD)
    assert {check.status for check in found} == {Status.OK}
    assert {check.remedy for check in found} == {""}
    names = [check.name for check in found]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("change", "name", "status", "detail", "remedy"),
    [
        ({"machine": "riscv64"}, "processor", "fail", "riscv64 is not supported", "x86_64"),
        ({"kernel": "5.10.0-28-amd64"}, "kernel", "fail", "Linux 5.10.0-28-amd64 is too old", "5.13 or newer"),
        ({"kernel": "5.13"}, "kernel", "ok", "Linux 5.13", ""),
        ({"ns_last_pid": False}, "kernel features", "fail", "ns_last_pid", "CONFIG_CHECKPOINT_RESTORE=y"),
        ({"map_files": False, "pidfd": False}, "kernel features", "fail", "pidfd_open", "CONFIG_CHECKPOINT_RESTORE=y"),
        ({"yama_scope": 3}, "ptrace", "fail", "ptrace_scope=3", "boot again"),
        ({"yama_scope": None}, "ptrace", "ok", "no Yama", ""),
        ({"core_pattern": "|/usr/bin/apport -p%p"}, "core dumps", "warn", "/usr/bin/apport has", "--ulimit core=1:1"),
        ({"core_pattern": "|"}, "core dumps", "warn", "has read the core", "--ulimit core=1:1"),
        ({"capabilities": 1 << 19}, "privileges", "warn", "lacks CAP_SYS_ADMIN", "as root"),
        ({"capabilities": 1 << 21, "in_container": True}, "privileges", "fail", "CAP_SYS_PTRACE", "--privileged"),
        ({"engine_problem": "no"}, "engine", "fail", "no", "install avckpt again"),
        ({"engine_problem": "no", "capabilities": 0}, "engine", "warn", "no", "mend"),
        ({"podman": "podman is not here"}, "podman", "fail", "podman is not here", "install podman"),
        ({"podman": "x", "in_container": True}, "podman", "warn", "inside a container", "on the host"),
        ({"podman": REMOTE}, "podman", "fail", "remote", "machine of the containers"),
        ({"podman": PodmanFacts("4.3.1", "crun", True, "")}, "podman", "fail", "rootless", "sudo"),
        ({"podman": PodmanFacts("4.2.0", "crun", False, "")}, "podman", "fail", "4.2.0 is too old", "4.3 or newer"),
        ({"podman": PodmanFacts("4.3.0-rc1", "crun", False, "")}, "podman", "ok", "4.3.0-rc1", ""),
        ({"podman": PodmanFacts("5.4.2", "kata", False, "")}, "runtime", "warn", "kata was never tried", "crun"),
        ({"installed_version": None}, "hooks", "fail", "not installed", "avckpt install"),
        ({"missing_files": ("/a", "/b", "/c", "/d")}, "hooks", "fail", "/a, /b, /c ...", "avckpt install"),
        ({"hook_problem": "bad interpreter"}, "hooks", "fail", "bad interpreter", "avckpt install"),
        ({"installed_version": "0.0.1"}, "hooks", "warn", "version 0.0.1", "avckpt install"),
        (
            {"outdated_files": ("/a", "/b", "/c", "/d")},
            "hooks",
            "warn",
            "another build than this avckpt: /a",
            "install",
        ),
        ({"root": False, "podman": "x", "engine_problem": "y"}, "privileges", "fail", "not root", "sudo avckpt doctor"),
        (
            {"installed_version": "unknown", "hook_problem": "/m is damaged: remove it"},
            "hooks",
            "fail",
            "/m is",
            "remove",
        ),
        ({"init_problem": "/i is not static"}, "init", "fail", "/i is not static", "avckpt install"),
        ({"hooks_dir_problems": ("it is hidden: write this",)}, "hooks_dir", "fail", "it is hidden", "write this"),
        ({"service_problems": ("it is old: restart it",)}, "podman service", "warn", "it is old", "restart it"),
        ({"service": OTHER}, "podman service", "warn", "runs is of version 4.2.0, podman of 4.3.1", "restart podman"),
        ({"service": "refused"}, "podman service", "warn", "does not answer: refused", "restart podman.socket"),
        ({"service": GOOD.podman}, "podman service", "ok", "answers, version 4.3.1", ""),
        ({"config": ConfigFacts("/c", True, "/c:3: x")}, "config", "warn", "refused: /c:3: x", "avckpt reload"),
        ({"config": ConfigFacts("/c", True, "", True)}, "config", "warn", "/c has changed", "avckpt reload"),
        ({"config": ConfigFacts("/c", False, "")}, "config", "ok", "no /c: the built-in defaults hold", ""),
        ({"sidecar_version": None, "sidecar_problem": "is away: start it"}, "sidecar", "fail", "is away", "start it"),
        ({"sidecar_version": "0.0.1"}, "sidecar", "warn", "version 0.0.1", "build its image again"),
        ({"sidecar_blind": True}, "sidecar", "fail", "does not see the host's processes", "--pid=host"),
        ({"sidecar_outdated": True}, "sidecar", "warn", "of another build", "podman run -d --replace"),
    ],
)
def test_what_is_wrong_is_said_with_a_remedy(
    change: dict[str, object], name: str, status: str, detail: str, remedy: str
) -> None:
    found = doctor.judge(dataclasses.replace(GOOD, **change))  # type: ignore[arg-type]
    [check] = [check for check in found if check.name == name]
    assert check.status.value == status
    assert detail in check.detail
    assert remedy in check.remedy
    assert all(check.remedy for check in found if check.status is not Status.OK)


@pytest.mark.parametrize("gone", [str(install.DROP_IN), str(install.INIT_PROGRAM)])
def test_an_installed_file_that_is_gone_has_one_remedy(gone: str) -> None:
    change = {
        "missing_files": (gone,),
        "hooks_dir_problems": ("Podman does not look there: write x",),
        "init_problem": f"{gone}: No such file or directory",
    }
    if gone == str(install.INIT_PROGRAM):
        del change["hooks_dir_problems"]
    else:
        del change["init_problem"]
    found = doctor.judge(dataclasses.replace(GOOD, **change))  # type: ignore[arg-type]
    assert [(each.name, each.remedy) for each in found if each.status is not Status.OK] == [
        ("hooks", "run: sudo avckpt install")
    ]


def test_what_uninstall_has_left_for_running_containers_is_no_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    left = install.Manifest(avckpt.__version__, (install.HOOK_PROGRAM,))
    monkeypatch.setattr(install.Manifest, "read", lambda: left)
    assert doctor._installation() == (None, (), (), "")


def test_looking_at_this_machine_ends_in_verdicts() -> None:
    found = {check.name: check for check in doctor.checks()}
    assert found["kernel"].detail.startswith("Linux ")
    assert {"processor", "ptrace", "engine", "podman", "hooks", "sidecar"} <= set(found)


def test_a_service_that_is_not_there_or_answers_nothing(tmp_path: Path) -> None:
    path = tmp_path / "podman.sock"
    assert doctor.service_facts(path) is None
    with socket.socket(socket.AF_UNIX) as left_behind:
        left_behind.bind(str(path))
        answer = doctor.service_facts(path)  # nobody listens
    assert isinstance(answer, str)
    assert "Connection refused" in answer


def test_an_init_must_be_static(tmp_path: Path) -> None:
    assert doctor.init_problem(tmp_path / "none") == f"{tmp_path}/none: No such file or directory"
    script = tmp_path / "script"
    script.write_text("#!/bin/sh\n")
    assert "is not executable" in doctor.init_problem(script)
    script.chmod(0o755)
    assert "is not a 64-bit program" in doctor.init_problem(script)
    for kind, options in (("dynamic", []), ("static", ["-static"])):
        program = tmp_path / kind
        subprocess.run(
            ["cc", *options, "-x", "c", "-o", program, "-"], input=b"int main(void) { return 0; }", check=True
        )
        assert doctor.init_problem(program) == ("" if kind == "static" else f"{program} is not static")
