# SPDX-License-Identifier: Apache-2.0
"""Notifications between real containers, as requested by their labels."""

from __future__ import annotations

import json
import os
import signal

import pytest

from testkit.harness import SIDECAR_NAME, Container, ContainerFactory, Podman, Sidecar, wait_until

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; notifications have time limits"
)

LISTENER = (
    "import signal, time\n"
    "signal.signal(signal.SIGUSR1, lambda *_: print('USR1', flush=True))\n"
    "print('READY', flush=True)\n"
    "while True: time.sleep(100)"
)
GROUP = {"interval": "200ms", "group": f"chain-{os.getpid()}"}


def crash(sidecar: Sidecar, container: Container, restores: int = 1) -> None:
    os.kill(sidecar.app_pid(container), signal.SIGKILL)
    sidecar.wait_restores(container, restores)


def test_a_signal_goes_from_container_to_container(sidecar: Sidecar, container: ContainerFactory) -> None:
    friend = container.protected("python3", "-uc", LISTENER, labels={**GROUP, "notify": "signal:USR1"})
    web = container.protected("sleep", "1000", labels=GROUP)
    wait_until(lambda: "READY" in friend.logs(), 10, "the other one listens")
    sidecar.wait_generation(friend)
    sidecar.wait_generation(web)
    crash(sidecar, web)
    wait_until(lambda: "USR1" in friend.logs(), 5, "the signal comes")


def test_one_that_is_not_protected_itself_hears_too(sidecar: Sidecar, container: ContainerFactory) -> None:
    group = {f"avckpt.{key}": value for key, value in GROUP.items() if key == "group"}
    friend = container("python3", "-uc", LISTENER, labels={**group, "avckpt.notify": "signal:USR1"})
    command = {"avckpt.notify": "exec:sh -c 'echo $AVCKPT_CONTAINER >> /tmp/heard'"}
    other = container("sleep", "1000", labels={**group, **command})
    web = container.protected("sleep", "1000", labels=GROUP)
    wait_until(lambda: "READY" in friend.logs(), 10, "the other one listens")
    sidecar.wait_generation(web)
    for each in (friend, other):
        entry = sidecar.find(each)
        assert entry is not None
        assert (entry["state"], entry["generations"]) == ("listening", 0)
        assert sidecar.avckpt("checkpoint", each.name, check=False).status == 5
    assert friend.exec("cat", "/proc/1/comm").stdout == "python3\n"
    crash(sidecar, web)
    wait_until(lambda: friend.logs().count("USR1") == 1, 10, "the signal comes")
    sidecar.restart()
    sidecar.wait_generation(web)
    crash(sidecar, web)
    wait_until(lambda: friend.logs().count("USR1") == 2, 10, "the signal comes from a new sidecar, too")

    def heard() -> str:
        return other.exec("cat", "/tmp/heard", check=False).stdout

    wait_until(lambda: heard() == f"{web.name}\n" * 2, 10, "the command has run")
    # Its end is its own.
    os.kill(friend.pid, signal.SIGKILL)
    assert friend.wait() == 137
    wait_until(lambda: sidecar.find(friend) is None, 10, "the sidecar has heard of it")


@pytest.mark.parametrize(
    ("options", "user"),
    [
        ((), "0:0"),
        (("--user", "1000:1001"), "1000:1001"),
        (("--user", "1000:1001", "--read-only", "--cap-drop=all", "--security-opt=no-new-privileges"), "1000:1001"),
    ],
)
def test_a_command_is_one_of_the_containers_own(
    sidecar: Sidecar, container: ContainerFactory, options: tuple[str, ...], user: str
) -> None:
    script = (
        "cd /tmp; cat > event; id -u > user; id -g >> user; hostname > host; cat /proc/self/cgroup > cgroup;"
        ' grep -E "^Cap|^NoNewPrivs|^Seccomp:" /proc/self/status > status; echo $OF_THE_CONTAINER > env; echo > done'
    )
    web = container.protected(
        *("sleep", "1000"),
        labels={**GROUP, "notify.self": f"exec:sh -c '{script}'"},
        options=(*options, "--tmpfs", "/tmp:mode=1777", "--env", "OF_THE_CONTAINER=yes"),
    )
    sidecar.wait_generation(web)
    crash(sidecar, web)
    wait_until(lambda: web.exec("test", "-e", "/tmp/done", check=False).status == 0, 10, "the command has run")

    def read(name: str) -> str:
        return web.exec("cat", f"/tmp/{name}").stdout.strip()

    assert read("user").replace("\n", ":") == user
    assert read("host") == web.id[:12]
    assert read("env") == "yes"
    event = json.loads(read("event"))
    assert (event["kind"], event["id"], event["container"]) == ("restored", web.id, web.name)
    # As restricted as the application is: capabilities, no_new_privs, seccomp.
    wanted = web.exec("grep", "-E", "^Cap|^NoNewPrivs|^Seccomp:", "/proc/1/status").stdout.strip()
    assert read("status") == wanted
    assert "Seccomp:\t2" in wanted
    # And within its limits.
    own = web.exec("cat", "/proc/1/cgroup").stdout.strip()
    assert read("cgroup") == own
    # From inside the sidecar's container, too.
    listed = sidecar.podman.run("exec", SIDECAR_NAME, "avckpt", "events", "--json").stdout.splitlines()
    mine = [e for e in map(json.loads, listed) if e["id"] == web.id]
    # What says more about the death comes when it is found out; where others take the CPU, a checkpoint is missed.
    kinds = [e["kind"] for e in mine if e["kind"] not in ("crash", "missed")]
    assert kinds == ["registered", "checkpoint", "died", "restored"]
    assert event in mine


def test_podman_does_not_wait_for_a_stuck_receiver(
    sidecar: Sidecar, container: ContainerFactory, podman: Podman
) -> None:
    web = container.protected("sleep", "1000", labels={**GROUP, "notify.self": "exec:sleep 4712"})
    sidecar.wait_generation(web)
    crash(sidecar, web)
    wait_until(lambda: "sleep 4712" in podman.run("top", web.name, "args").stdout, 5, "it runs")
    podman.run("stop", "--time", "5", web.name, timeout_s=20)
    assert podman.inspect(web.name)["State"]["ExitCode"] == 128 + signal.SIGTERM
