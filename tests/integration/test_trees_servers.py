# SPDX-License-Identifier: Apache-2.0
"""Web servers with worker processes, protected, under load: nginx and gunicorn."""

from __future__ import annotations

import os
import random
import signal
import time
from pathlib import Path

import pytest

from testkit.harness import ContainerFactory, Sidecar, wait_until
from testkit.procfs import figures
from testkit.trees import LONG, RESTORE_S, Load, Tree, start_tree, write_files

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; clients have time limits of their own"
)

KILLS = 50 if LONG else 4

NGINX = """
daemon off;
worker_processes 4;
error_log stderr;
pid /tmp/nginx.pid;
events { worker_connections 64; }
http {
    access_log off;
    keepalive_requests 1000000;
    server {
        listen 8000 reuseport;
        root /files;
        location = /pid { return 200 "$pid"; }
    }
}
"""
SMALL = b"".join(b"%07d\n" % n for n in range(512))
LARGE = b"".join(b"%07d\n" % n for n in range(65536))

GUNICORN = """
import os, hashlib
DATA = [hashlib.sha256(b"%d" % n).hexdigest() for n in range(200000)]
count = 0

def app(environ, start_response):
    global count
    count += 1
    path = environ["PATH_INFO"]
    body = DATA[int(path[1:])] if path[1:].isdigit() else "%d %d" % (os.getpid(), count)
    start_response("200 OK", [("Content-Type", "text/plain"), ("Content-Length", str(len(body)))])
    return [body.encode()]
"""


def nginx(sidecar: Sidecar, container: ContainerFactory, folder: Path) -> Tree:
    write_files(folder, {"nginx.conf": NGINX, "small": SMALL, "large": LARGE})
    return start_tree(
        sidecar,
        container,
        *("nginx", "-e", "stderr", "-c", "/files/nginx.conf"),
        options=["--volume", f"{folder}:/files:ro"],
    )


def gunicorn(sidecar: Sidecar, container: ContainerFactory, folder: Path) -> Tree:
    write_files(folder, {"service.py": GUNICORN})
    return start_tree(
        sidecar,
        container,
        *("gunicorn", "--workers", "4", "--preload", "--bind", "0.0.0.0:8000", "--keep-alive", "60"),
        *("--worker-class", "gthread", "--threads", "4"),
        *("--worker-tmp-dir", "/dev/shm", "--chdir", "/files", "service:app"),
        options=["--volume", f"{folder}:/files:ro"],
    )


SERVERS = {"nginx": nginx, "gunicorn": gunicorn}


def paths_of(server: str) -> dict[str, bytes | None]:
    if server == "nginx":
        return {"/small": SMALL, "/large": LARGE, "/pid": None}
    import hashlib

    some = {f"/{n}": hashlib.sha256(b"%d" % n).hexdigest().encode() for n in (0, 7, 199999)}
    return {**some, "/": None}


def workers(tree: Tree) -> list[int]:
    """The workers' PIDs on the host."""
    main = tree.main
    return [member.pid for member in tree.members() if member.pid != main and not member.is_zombie]


@pytest.mark.timeout(900)
@pytest.mark.parametrize("server", SERVERS)
def test_restored_whole_under_load(server: str, sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    """The same processes with the same PIDs; every answer is right, and answers keep coming."""
    tree = SERVERS[server](sidecar, container, tmp_path)
    rng = random.Random(server)
    wait_until(lambda: len(workers(tree)) == 4, RESTORE_S, "four workers")
    before = tree.places()
    with Load(tree.container.ip, 8000, paths_of(server)) as load:
        for _ in range(KILLS):
            tree.next_generation()
            time.sleep(rng.uniform(0, 0.3))
            tree.kill()
            load.wait_answers(100)
            assert tree.places() == before
    assert tree.container.inspect()["State"]["Pid"] == tree.container.pid


@pytest.mark.parametrize("server", SERVERS)
def test_a_killed_worker_is_its_masters_business(
    server: str, sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    """The master replaces it, nothing is restored, and checkpoints are taken as before."""
    tree = SERVERS[server](sidecar, container, tmp_path)
    wait_until(lambda: len(workers(tree)) == 4, RESTORE_S, "four workers")
    with Load(tree.container.ip, 8000, paths_of(server)) as load:
        for _ in range(3):
            victim = workers(tree)[0]
            os.kill(victim, signal.SIGKILL)
            wait_until(
                lambda gone=victim: gone not in workers(tree) and len(workers(tree)) == 4,  # type: ignore[misc]
                RESTORE_S,
                "a new worker",
            )
            load.wait_answers(50)
            tree.next_generation()
        entry = sidecar.find(tree.container)
        assert entry is not None
        assert (entry["restores"], entry["state"]) == (0, "protected")
        tree.kill()
        load.wait_answers(50)


def test_workers_share_their_memory_after_a_restore(
    sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    """gunicorn --preload: workers inherit 25 MB of data from their master."""
    tree = gunicorn(sidecar, container, tmp_path)
    wait_until(lambda: len(workers(tree)) == 4, RESTORE_S, "four workers")
    tree.next_generation()
    before = sum(figures(member.pid)["Pss"] for member in tree.members())
    tree.kill()
    after = sum(figures(member.pid)["Pss"] for member in tree.members())
    # The templates that share it before, and may be gone after, make a copy's difference; four workers with
    # copies of their own would make three more.
    assert after < before + 2 * 25 * 1024, (before, after)
