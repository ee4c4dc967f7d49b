# SPDX-License-Identifier: Apache-2.0
"""Whether this machine can keep containers alive, and if not, what to do.

`gather()` looks, and `judge()` makes up its mind from what was seen alone, so
that every verdict can be tested without a machine that deserves it.
"""

from __future__ import annotations

import contextlib
import enum
import json
import os
import platform
import shutil
import struct
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import avckpt
from avckpt.cli import containers_conf, install, sidecar_container
from avckpt.cli.client import run_it
from avckpt.cli.install import DROP_IN, HOOK_PROGRAM, HOOKS_DIR, INIT_PROGRAM, Manifest
from avckpt.errors import AvckptError


class Status(str, enum.Enum):
    """What a check came to."""

    OK = "ok"
    WARN = "warn"  # works, or may work, but not as well as it could
    FAIL = "fail"  # no container is protected before this is mended


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    status: Status
    detail: str
    remedy: str = ""
    """What to do, as an imperative; empty when there is nothing to do."""


@dataclass(frozen=True)
class PodmanFacts:
    """What `podman info` says."""

    version: str
    runtime: str
    """Name of the OCI runtime."""
    rootless: bool
    seccomp_profile: str
    remote: bool = False


@dataclass(frozen=True)
class ConfigFacts:
    """The file with defaults for all containers."""

    path: str
    found: bool
    problem: str
    """Why it was refused, or would be; empty: it is right."""
    outdated: bool = False
    """It was written after the sidecar had read it last."""


@dataclass(frozen=True)
class Facts:
    """What `gather()` found; None: it could not find out."""

    kernel: str
    machine: str
    capabilities: int
    """CapEff of this process."""
    in_container: bool
    yama_scope: int | None
    ns_last_pid: bool
    map_files: bool
    pidfd: bool
    core_pattern: str
    """Empty: it is not known."""
    podman: PodmanFacts | str
    """A string: why Podman does not answer."""
    hooks_dir_problems: tuple[str, ...]
    service: PodmanFacts | str | None
    """Podman's REST service.  None: nobody has set it up."""
    service_problems: tuple[str, ...]
    installed_version: str | None
    """None: nothing is installed."""
    missing_files: tuple[str, ...]
    """Files of the installation that are gone."""
    outdated_files: tuple[str, ...]
    """Those that are not as this avckpt has them."""
    hook_problem: str
    """What went wrong when the hook was started without a stage; empty: nothing."""
    init_problem: str
    sidecar_version: str | None
    """None: it does not answer."""
    sidecar_problem: str
    sidecar_outdated: bool
    """Its container was made of another image than there is now."""
    sidecar_blind: bool
    """It is in a PID namespace of its own, where it sees no container's processes."""
    engine_problem: str
    """What the engine's own probe said; empty: it is content."""
    config: ConfigFacts
    root: bool = True
    """Without it most of the others cannot be found out."""


KERNEL_LEAST = (5, 13)  # PTRACE_GET_RSEQ_CONFIGURATION, the newest call that the engine needs
PODMAN_LEAST = (4, 3)  # `podman generate spec`, by which the precreate hook learns labels
MACHINES = ("x86_64",)
UNKNOWN = "unknown"
"""Version of an installation whose manifest is damaged."""
SERVICE = Path("/run/podman/podman.sock")  # root's, where podman.socket has it
_CAPABILITIES = {"CAP_SYS_PTRACE": 19, "CAP_SYS_ADMIN": 21}


def checks() -> list[Check]:
    """Looks at this machine and says what it thinks of it.  Raises nothing that a broken machine could cause."""
    return judge(gather())


def judge(facts: Facts) -> list[Check]:
    """The verdicts on what was seen, in the order in which a person should mend things."""
    if not facts.root:
        hidden = "privileges", "engine"
        found = [check for check in _judge_machine(facts) if check.name not in hidden]
        what = "this is not root: Podman, hooks, engine and sidecar are root's, and were not looked at"
        return [*found, Check("privileges", Status.FAIL, what, "run: sudo avckpt doctor")]
    found = [*_judge_machine(facts)]
    if facts.in_container and isinstance(facts.podman, str):
        found.append(
            Check(
                "podman", Status.WARN, "not looked at: this is inside a container", "run avckpt doctor on the host too"
            )
        )
        return [*found, _judge_sidecar(facts), _judge_config(facts.config)]
    found += [*_judge_podman(facts), *_judge_installation(facts)]
    return [*found, _judge_sidecar(facts), _judge_config(facts.config)]


def _judge_machine(facts: Facts) -> Iterator[Check]:
    if facts.machine in MACHINES:
        yield Check("processor", Status.OK, facts.machine)
    else:
        yield Check("processor", Status.FAIL, f"{facts.machine} is not supported", f"use one of: {', '.join(MACHINES)}")
    if _numbers(facts.kernel) >= KERNEL_LEAST:
        yield Check("kernel", Status.OK, f"Linux {facts.kernel}")
    else:
        least = ".".join(map(str, KERNEL_LEAST))
        yield Check("kernel", Status.FAIL, f"Linux {facts.kernel} is too old", f"use Linux {least} or newer")
    absent = [
        name
        for name, there in (
            ("/proc/sys/kernel/ns_last_pid (CONFIG_CHECKPOINT_RESTORE)", facts.ns_last_pid),
            ("/proc/PID/map_files (CONFIG_CHECKPOINT_RESTORE)", facts.map_files),
            ("pidfd_open(2)", facts.pidfd),
        )
        if not there
    ]
    if absent:
        yield Check(
            "kernel features",
            Status.FAIL,
            "missing: " + ", ".join(absent),
            "use a kernel built with CONFIG_CHECKPOINT_RESTORE=y, as all large distributions have it",
        )
    else:
        yield Check("kernel features", Status.OK, "ns_last_pid, map_files, pidfd")
    if facts.yama_scope == 3:
        yield Check(
            "ptrace",
            Status.FAIL,
            "kernel.yama.ptrace_scope=3 forbids ptrace to everybody until the next boot",
            "set kernel.yama.ptrace_scope=1 in /etc/sysctl.d and boot again",
        )
    else:
        shown = "no Yama" if facts.yama_scope is None else f"kernel.yama.ptrace_scope={facts.yama_scope}"
        yield Check("ptrace", Status.OK, f"{shown}, which leaves ptrace to a privileged sidecar")
    if facts.core_pattern.startswith("|"):
        collector = facts.core_pattern[1:].split()[:1]
        yield Check(
            "core dumps",
            Status.WARN,
            f"a death by SIGSEGV or abort() is complete only when {''.join(collector)} has read the core",
            "have containers that should be back at once leave none: --ulimit core=1:1 (0 does not do it), and "
            "avckpt.core",
        )
    else:
        yield Check("core dumps", Status.OK, f"kernel.core_pattern={facts.core_pattern}")
    lacking = [name for name, bit in _CAPABILITIES.items() if not facts.capabilities >> bit & 1]
    if lacking:
        yield Check(
            "privileges",
            Status.FAIL if facts.in_container else Status.WARN,
            f"this process lacks {', '.join(lacking)}",
            "start the sidecar with --privileged" if facts.in_container else "run avckpt doctor as root",
        )
    else:
        yield Check("privileges", Status.OK, ", ".join(_CAPABILITIES))
    if facts.engine_problem:
        status = Status.WARN if lacking and not facts.in_container else Status.FAIL
        yield Check("engine", status, facts.engine_problem, "mend what is said above, or install avckpt again")
    else:
        yield Check("engine", Status.OK, "its own probe is content")


def _judge_podman(facts: Facts) -> Iterator[Check]:
    podman = facts.podman
    if isinstance(podman, str):
        yield Check("podman", Status.FAIL, podman, "install podman, and see that `podman info` works")
        return
    if podman.remote:
        yield Check("podman", Status.FAIL, "this is a remote client", "run avckpt on the machine of the containers")
        return
    if podman.rootless:
        yield Check("podman", Status.FAIL, "this is a rootless Podman", "protected containers must be root's: use sudo")
    elif _numbers(podman.version) < PODMAN_LEAST:
        least = ".".join(map(str, PODMAN_LEAST))
        detail = f"{podman.version} is too old: its hooks cannot learn a container's labels"
        yield Check("podman", Status.FAIL, detail, f"use Podman {least} or newer")
    else:
        yield Check("podman", Status.OK, podman.version)
    if podman.runtime in ("crun", "runc"):
        yield Check("runtime", Status.OK, podman.runtime)
    else:
        yield Check("runtime", Status.WARN, f"{podman.runtime} was never tried", "use crun or runc")
    yield Check("seccomp", Status.OK, podman.seccomp_profile or "off")


def _judge_installation(facts: Facts) -> Iterator[Check]:
    again = "run: sudo avckpt install"
    if facts.installed_version is None:
        yield Check("hooks", Status.FAIL, "not installed: labels do nothing, and Podman does not say so", again)
        return
    if facts.installed_version == UNKNOWN:
        what, _, remedy = facts.hook_problem.rpartition(": ")
        yield Check("hooks", Status.FAIL, what, f"{remedy}; then run: sudo avckpt install")
        return
    if facts.missing_files:
        yield Check("hooks", Status.FAIL, f"a part of the installation is missing: {_few(facts.missing_files)}", again)
    elif facts.hook_problem:
        yield Check("hooks", Status.FAIL, f"{HOOK_PROGRAM} does not run: {facts.hook_problem}", again)
    elif facts.installed_version != avckpt.__version__:
        yield Check("hooks", Status.WARN, f"of version {facts.installed_version}, this is {avckpt.__version__}", again)
    elif facts.outdated_files:
        yield Check("hooks", Status.WARN, f"of another build than this avckpt: {_few(facts.outdated_files)}", again)
    else:
        yield Check("hooks", Status.OK, f"version {facts.installed_version}, {HOOK_PROGRAM}")
    if str(INIT_PROGRAM) in facts.missing_files:
        pass  # said above
    elif facts.init_problem:
        yield Check("init", Status.FAIL, facts.init_problem, again)
    else:
        yield Check("init", Status.OK, str(INIT_PROGRAM))
    if str(DROP_IN) in facts.missing_files:
        pass  # it is what tells Podman
    elif facts.hooks_dir_problems:
        for problem in facts.hooks_dir_problems:
            what, _, remedy = problem.rpartition(": ")
            yield Check("hooks_dir", Status.FAIL, what, remedy)
    else:
        yield Check("hooks_dir", Status.OK, f"Podman looks into {HOOKS_DIR}")
    yield from _judge_service(facts)


def _judge_service(facts: Facts) -> Iterator[Check]:
    """Containers that podman-py, Ansible or a client of Docker's starts are the service's."""
    name = "podman service"
    for problem in facts.service_problems:
        what, _, remedy = problem.rpartition(": ")
        yield Check(name, Status.WARN, what, remedy)
    service = facts.service
    again = "run: sudo systemctl restart podman.socket podman.service"
    if isinstance(service, str):
        yield Check(name, Status.WARN, f"it does not answer: {service}", again)
    elif service is not None and isinstance(facts.podman, PodmanFacts) and service.version != facts.podman.version:
        what = f"the one that runs is of version {service.version}, podman of {facts.podman.version}"
        yield Check(name, Status.WARN, what, again)
    elif service is not None and not facts.service_problems:
        yield Check(name, Status.OK, f"answers, version {service.version}")


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (" ..." if len(names) > 3 else "")


def _judge_sidecar(facts: Facts) -> Check:
    if facts.sidecar_version is None:
        what, _, remedy = facts.sidecar_problem.partition(": ")
        return Check("sidecar", Status.FAIL, what, remedy)
    if facts.sidecar_blind:
        what = "it does not see the host's processes, and protects nothing"
        return Check("sidecar", Status.FAIL, what, f"start it with --pid=host: {run_it(_run_dir())}")
    if facts.sidecar_version != avckpt.__version__:
        return Check(
            "sidecar",
            Status.WARN,
            f"of version {facts.sidecar_version}, this is {avckpt.__version__}",
            "run: sudo avckpt install --sidecar (or build its image again as before, and start it anew)",
        )
    if facts.sidecar_outdated:
        return Check("sidecar", Status.WARN, sidecar_container.OUTDATED, f"run: {run_it(_run_dir())}")
    return Check("sidecar", Status.OK, f"answers, version {facts.sidecar_version}")


def _judge_config(config: ConfigFacts) -> Check:
    if config.problem:
        return Check("config", Status.WARN, f"refused: {config.problem}", "mend it, then run: sudo avckpt reload")
    if config.outdated:
        return Check(
            "config", Status.WARN, f"{config.path} has changed since the sidecar read it", "run: sudo avckpt reload"
        )
    shown = config.path if config.found else f"no {config.path}: the built-in defaults hold"
    return Check("config", Status.OK, shown)


def gather() -> Facts:
    """Looks at this machine.  Changes nothing."""
    installed, missing, outdated, broken = _installation()
    info, problem = _sidecar()
    return Facts(
        kernel=platform.release(),
        machine=platform.machine(),
        capabilities=_capabilities(),
        in_container=Path("/run/.containerenv").exists() or Path("/.dockerenv").exists(),
        yama_scope=_number_in(Path("/proc/sys/kernel/yama/ptrace_scope")),
        ns_last_pid=os.path.exists("/proc/sys/kernel/ns_last_pid"),
        map_files=os.path.exists("/proc/self/map_files"),
        pidfd=_has_pidfd(),
        core_pattern=_text_in(Path("/proc/sys/kernel/core_pattern")),
        podman=podman_facts(),
        hooks_dir_problems=tuple(containers_conf.problems(HOOKS_DIR, environ=os.environ)),
        service=service_facts(SERVICE),
        service_problems=tuple(install.service_problems()),
        installed_version=installed,
        missing_files=missing,
        outdated_files=outdated,
        hook_problem=broken or (_hook_problem() if installed and not missing else ""),
        init_problem=init_problem(INIT_PROGRAM) if installed else "",
        sidecar_version=str(info["version"]) if info else None,
        sidecar_problem=problem,
        sidecar_outdated=_sidecar_outdated(),
        sidecar_blind=_sidecar_blind(info),
        engine_problem=_engine_problem(),
        config=_config(info),
        root=os.geteuid() == 0,
    )


def init_problem(path: Path) -> str:
    """What is wrong with an avckpt-init; empty: nothing.

    It runs in containers of any make, so it must not need a dynamic linker.
    """
    try:
        head = path.read_bytes()[:4096]
    except OSError as error:
        return f"{path}: {error.strerror}"
    if not os.access(path, os.X_OK):
        return f"{path} is not executable"
    if head[:6] != b"\x7fELF\x02\x01":
        return f"{path} is not a 64-bit program"
    headers_at, header_size, count = *struct.unpack_from("<Q", head, 32), *struct.unpack_from("<HH", head, 54)
    kinds = [struct.unpack_from("<I", head, headers_at + i * header_size)[0] for i in range(count)]
    pt_interp = 3
    return f"{path} is not static" if pt_interp in kinds else ""


def _installation() -> tuple[str | None, tuple[str, ...], tuple[str, ...], str]:
    """Version, missing and outdated files, and what keeps us from knowing."""
    try:
        manifest = Manifest.read()
    except AvckptError as error:
        return UNKNOWN, (), (), str(error)
    if manifest is None or DROP_IN not in manifest.files:  # or only what running containers will call
        return None, (), (), ""
    outdated: tuple[str, ...] = ()
    with contextlib.suppress(AvckptError):  # nothing of our own to compare them with
        outdated = tuple(map(str, install.outdated()))
    return manifest.version, tuple(str(path) for path in manifest.files if not path.exists()), outdated, ""


def _hook_problem() -> str:
    # Without a stage it says how it is to be called: Python and package are there.
    try:
        done = subprocess.run([HOOK_PROGRAM], capture_output=True, text=True, timeout=10, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if "precreate, prestart, poststop" in done.stderr:
        return ""
    lines = done.stderr.strip().splitlines()
    return lines[-1] if lines else f"exit status {done.returncode}"


def podman_facts() -> PodmanFacts | str:
    """What `podman info` says, or why it says nothing."""
    if shutil.which("podman") is None:
        return "podman is not here"
    try:
        done = subprocess.run(
            ["podman", "info", "--format", "json"], capture_output=True, text=True, timeout=30, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"podman info: {error}"
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        return f"podman info: {lines[-1] if lines else 'failed'}"
    try:
        return _facts_of(json.loads(done.stdout))
    except (ValueError, KeyError, TypeError) as error:
        return f"podman info: unexpected answer ({error})"


def service_facts(socket: Path) -> PodmanFacts | str | None:
    """What the service at that socket says of itself, or why it does not; None: there is no socket."""
    if not socket.is_socket():
        return None
    # Here, so that machines without a service do not wait for the import.
    from podman import PodmanClient

    try:
        with PodmanClient(base_url=f"unix://{socket}", timeout=10) as client:
            return _facts_of(client.info())  # type: ignore[no-untyped-call]
    except OSError as error:  # podman-py's own errors are, too, and their first cause says most
        cause: BaseException = error
        while cause.__context__ is not None:
            cause = cause.__context__
        return str(cause)
    except (ValueError, KeyError, TypeError) as error:
        return f"unexpected answer ({error})"


def _facts_of(info: dict[str, Any]) -> PodmanFacts:
    host = info["host"]
    return PodmanFacts(
        version=str(info["version"]["Version"]),
        runtime=str(host["ociRuntime"]["name"]),
        rootless=bool(host["security"]["rootless"]),
        seccomp_profile=str(host["security"].get("seccompProfilePath", "")),
        remote=bool(host.get("serviceIsRemote", False)),
    )


def _sidecar() -> tuple[dict[str, Any], str]:
    """What it says of itself, empty when it does not answer, and why not."""
    from avckpt.cli.client import Client

    try:
        info = Client(_run_dir()).info()
    except AvckptError as error:
        return {}, str(error)
    except OSError as error:
        return {}, f"the sidecar does not answer as it should ({error}): start it again"
    if "version" not in info:
        return {}, "the sidecar does not say its version: start it again"
    return info, ""


def _run_dir() -> Path:
    from avckpt_hooks.shared import protocol

    return Path(protocol.run_dir())


def _sidecar_outdated() -> bool:
    try:
        return sidecar_container.is_outdated()
    except AvckptError:
        return False  # no Podman here, of which more is said elsewhere


def _sidecar_blind(info: dict[str, Any]) -> bool:
    from avckpt.cli.client import Client

    if "pid" not in info:
        return False
    try:
        here = Client(_run_dir()).pid()
    except (AvckptError, OSError):
        return False  # it has just gone
    return here not in (0, info["pid"])  # 0: we are the ones who do not see it


def _config(info: dict[str, Any]) -> ConfigFacts:
    """What the sidecar goes by; without one, what it would."""
    from avckpt import config

    said = info.get("config") or {}
    if not said:
        path = config.default_path()
        problems = "; ".join(map(str, config.examine(path)[1]))
        return ConfigFacts(str(path), path.exists(), problems)
    try:
        written_at = os.stat(said["path"]).st_mtime
    except OSError:
        written_at = 0.0
    outdated = not said["problem"] and written_at > (said["loaded_at"] or 0.0)
    return ConfigFacts(said["path"], bool(said.get("found")), said["problem"], outdated)


def _engine_problem() -> str:
    try:
        from avckpt import engine

        engine.probe()
    except AvckptError as error:
        return str(error)
    return ""


def _capabilities() -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        name, _, value = line.partition(":")
        if name == "CapEff":
            return int(value, 16)
    return 0


def _number_in(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


def _text_in(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""


def _has_pidfd() -> bool:
    try:
        os.close(os.pidfd_open(os.getpid()))
    except OSError:
        return False
    return True


def _numbers(version: str) -> tuple[int, ...]:
    """The leading numbers of a version: "6.1.0-18-amd64" is (6, 1, 0)."""
    numbers = []
    for part in version.replace("-", ".").replace("+", ".").split("."):
        if not part.isdecimal():
            break
        numbers.append(int(part))
    return tuple(numbers)
