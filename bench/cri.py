# SPDX-License-Identifier: Apache-2.0
"""A pod of two containers through containerd's CRI socket, as the kubelet makes it, and many crashes.

make bench-cri (KILLS=500).  No kubelet: what it would count as a restart is a container that has
exited, or was started again.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from avckpt.cli.client import Client

from testkit.harness import ROOT, Podman, wait_until
from testkit.local_sidecar import LocalSidecar, local_sidecar

DEBIANS = ROOT / "build/docker/root/usr"
NAMES = ("lidar", "radar")
ANNOTATIONS = {"avckpt.enable": "true", "avckpt.interval": "50ms", "avckpt.restore.max": "64/1s"}
COUNT = "import itertools, time\nfor n in itertools.count():\n    print(n, flush=True)\n    time.sleep(0.02)"
SIGNALS = (signal.SIGSEGV, signal.SIGKILL, signal.SIGABRT)
RUNNING = 1
BASE, PAUSE = "localhost/avckpt-base:latest", "localhost/avckpt-pause:latest"
CRI = 'plugins."io.containerd.grpc.v1.cri"'


@contextlib.contextmanager
def containerd(folder: Path, run_dir: Path) -> Iterator[None]:
    """A daemon of our own, with the two images."""
    runtime = folder / "runtime"
    runtime.write_text(f'#!/bin/sh\nexec {ROOT}/hooks/avckpt-runtime --avckpt-run-dir={run_dir} "$@"\n')
    runtime.chmod(0o755)
    (folder / "config.toml").write_text(f"""
version = 2
root = "{folder}/root"
state = "{folder}/state"
[grpc]
  address = "{folder}/sock"
[{CRI}]
  sandbox_image = "{PAUSE}"
  restrict_oom_score_adj = true
[{CRI}.containerd.runtimes.runc]
  runtime_type = "io.containerd.runc.v2"
[{CRI}.containerd.runtimes.avckpt]
  runtime_type = "io.containerd.runc.v2"
  pod_annotations = ["avckpt.*"]
[{CRI}.containerd.runtimes.avckpt.options]
  BinaryName = "{runtime}"
""")
    env = {**os.environ, "PATH": f"{DEBIANS}/bin:{os.environ['PATH']}"}
    with (folder / "log").open("wb") as log:
        daemon = subprocess.Popen(["containerd", "-c", f"{folder}/config.toml"], env=env, stdout=log, stderr=log)
    try:
        wait_until((folder / "sock").exists, 20, "containerd listens")
        podman = Podman()
        idle = podman.run("create", "--pull=never", "--network=none", BASE).stdout.strip()
        podman.run("commit", "--change", 'CMD ["sleep", "infinity"]', idle, PAUSE, timeout_s=120)
        podman.run("rm", idle)
        for image in (BASE, PAUSE):
            (folder / "image.tar").unlink(missing_ok=True)
            podman.run("save", "-o", f"{folder}/image.tar", image, timeout_s=120)
            ctr = ["ctr", "-a", f"{folder}/sock", "-n", "k8s.io", "images", "import", f"{folder}/image.tar"]
            subprocess.run(ctr, env=env, check=True, stdout=subprocess.DEVNULL)
        podman.run("rmi", PAUSE)
        yield
    finally:
        daemon.terminate()
        daemon.wait()


def service(folder: Path) -> tuple[Any, Any]:
    """The messages, and what speaks them."""
    grpc, protoc = (importlib.import_module(name) for name in ("grpc", "grpc_tools.protoc"))
    here = Path(__file__).parent
    if protoc.main(["", f"-I{here}", f"--python_out={folder}", f"--grpc_python_out={folder}", f"{here}/cri.proto"]):
        raise SystemExit("cri.proto could not be compiled")
    sys.path.insert(0, str(folder))
    messages, stubs = importlib.import_module("cri_pb2"), importlib.import_module("cri_pb2_grpc")
    return messages, stubs.RuntimeServiceStub(grpc.insecure_channel(f"unix://{folder}/sock"))


def measure(folder: Path, sidecar: LocalSidecar, kills: int) -> None:
    """Prints what came of it."""
    cri, runtime = service(folder)
    host = cri.NamespaceOption(network=cri.NODE)  # no CNI plugin is needed
    pod = cri.PodSandboxConfig(
        metadata=cri.PodSandboxMetadata(name="drive", uid="1", namespace="default"),
        annotations=ANNOTATIONS,
        log_directory=f"{folder}/logs",
        linux=cri.LinuxPodSandbox(security_context=cri.SandboxSecurity(namespace_options=host)),
    )
    request = cri.RunPodSandboxRequest(config=pod, runtime_handler="avckpt")
    sandbox = runtime.RunPodSandbox(request).pod_sandbox_id
    containers = {}
    for name in NAMES:
        config = cri.ContainerConfig(
            metadata=cri.ContainerMetadata(name=name),
            image=cri.ImageSpec(image=BASE),
            command=["python3", "-c", COUNT],
            log_path=f"{name}.log",
            linux=cri.LinuxContainer(security_context=cri.ContainerSecurity(namespace_options=host)),
        )
        made = cri.CreateContainerRequest(pod_sandbox_id=sandbox, config=config, sandbox_config=pod)
        containers[name] = cri.Container(container_id=runtime.CreateContainer(made).container_id)
        runtime.StartContainer(containers[name])
    begun = {name: runtime.ContainerStatus(each).status.started_at for name, each in containers.items()}

    def row(name: str) -> dict[str, Any]:
        rows = Client(sidecar.run_dir).containers(memory=False)
        return next((each for each in rows if each["name"] == f"drive/{name}"), {})

    restores_ms = []
    for n in range(kills):
        name, before = NAMES[n % 2], n // 2
        wait_until(lambda: row(name).get("state") == "protected", 20, f"{name} is protected")  # noqa: B023
        os.kill(row(name)["app_pid"], SIGNALS[n % 3])
        wait_until(lambda: row(name).get("restores") == before + 1, 20, f"{name} is restored")  # noqa: B023
        restores_ms.append(row(name)["last_restore_s"] * 1000)
    for name, each in containers.items():
        status = runtime.ContainerStatus(each).status
        same = status.state == RUNNING and status.started_at == begun[name] and status.metadata.attempt == 0
        starts = [line.split()[-1] for line in (folder / f"logs/{name}.log").read_text().splitlines()].count("0")
        print(f"{name}: {'runs, never restarted' if same else 'WAS RESTARTED'}; its program started {starts} time(s)")
    print(f"{kills} kills; restore: median {statistics.median(restores_ms):.1f} ms, longest {max(restores_ms):.1f} ms")
    for each in containers.values():
        runtime.StopContainer(cri.StopContainerRequest(container_id=each.container_id, timeout=5))
    runtime.StopPodSandbox(cri.PodSandbox(pod_sandbox_id=sandbox))
    runtime.RemovePodSandbox(cri.PodSandbox(pod_sandbox_id=sandbox))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=500)
    kills = parser.parse_args().kills
    with tempfile.TemporaryDirectory(prefix="avckpt-cri-") as name:
        folder = Path(name)
        with local_sidecar(folder) as sidecar:
            sidecar.start()
            with containerd(folder, sidecar.run_dir):
                started = time.monotonic()
                measure(folder, sidecar, kills)
                print(f"in {time.monotonic() - started:.0f} s")


if __name__ == "__main__":
    main()
