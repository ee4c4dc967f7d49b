# SPDX-License-Identifier: Apache-2.0
"""Nodes below launchers in real containers: a shell script, supervisord, roslaunch."""

from __future__ import annotations

import json
import os
import random
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from testkit.harness import RUN_DIR, wait_until
from testkit.nodes import SUPERVISORD, SUPERVISORD_CONF, app_pid, nodes_of, supervisor_options

if TYPE_CHECKING:
    from testkit.harness import Container, ContainerFactory, Podman, Sidecar

pytestmark = pytest.mark.shared_machine("init waits two seconds for its guard, which may get no CPU for as long")
NODE = """
import os, sys, time
i = 0
while True:
    with open(sys.argv[1], "a") as out:
        print(i, os.getpid(), time.monotonic(), file=out)
    i += 1
    time.sleep(0.02)
"""
LAUNCHER = """
trap 'kill $a $b; wait $a; echo a $?; wait $b; echo b $?; exit 0' TERM
$AVCKPT_INIT --name a -- python3 /node/node.py /node/a.out & a=$!
$AVCKPT_INIT --label avckpt.keep=3 -- python3 /node/node.py /node/b.out & b=$!
echo $$ $a $b
while :; do wait -n; echo ended $?; sleep 1; done
"""
NODES = {"scope": "nodes", "interval": "100ms", "restore.max": "64/1s"}
SIGNALS = (signal.SIGKILL, signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS)


@pytest.fixture
def node(tmp_path: Path) -> Path:
    (tmp_path / "node.py").write_text(NODE)
    tmp_path.chmod(0o777)  # for other users in the container
    return tmp_path


def wait_nodes(
    sidecar: Sidecar, container: Container, count: int, timeout_s: float = 60.0
) -> dict[str, dict[str, Any]]:
    """Waits until that many nodes are protected, with two generations each."""

    def found() -> dict[str, dict[str, Any]]:
        known = nodes_of(sidecar, container)
        ready = [row for row in known.values() if row["state"] == "protected" and row["generations"] >= 2]
        return known if len(ready) >= count else {}

    try:
        return wait_until(found, timeout_s, f"{count} nodes are protected", every_s=0.2)
    except TimeoutError as error:
        raise AssertionError(f"{error}: {sidecar.ps()}; {container.logs()[-2000:]}; {sidecar.logs()[-3000:]}") from None


def numbers(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines()]


def test_a_shell_launcher(container: ContainerFactory, sidecar: Sidecar, node: Path) -> None:
    car = container.protected("bash", "-c", LAUNCHER, labels=NODES, options=("-v", f"{node}:/node"))
    found = wait_nodes(sidecar, car, 2)
    assert sorted(found) == ["a", "python3"]
    assert {row["name"] for row in found.values()} == {f"{car.name}/a", f"{car.name}/python3"}
    assert (found["a"]["keep"], found["python3"]["keep"]) == (2, 3)
    launcher = sidecar.find(car)
    assert launcher is not None
    assert (launcher["state"], launcher["init_pid"], launcher["guard_pid"]) == ("nodes", car.pid, 0)
    # Nothing stands in front of the launcher.
    assert car.logs().split()[0] == "1"
    for restores, signum in enumerate(SIGNALS, 1):
        for name, file in (("a", "a"), ("python3", "b")):
            before = nodes_of(sidecar, car)[name]
            os.kill(app_pid(before), signum)
            row = wait_until(
                lambda: (lambda r: r if r["restores"] >= restores else {})(nodes_of(sidecar, car)[name]),  # noqa: B023
                20,
                f"{name} is restored",
            )
            assert row["last_death"] == f"killed by {signum.name}"
            assert row["app_pid_inside"] == before["app_pid_inside"]
            count = len(numbers(node / f"{file}.out"))
            wait_until(lambda: len(numbers(node / f"{file}.out")) > count + 5, 20, "it goes on")  # noqa: B023
    assert "ended" not in car.logs()
    for file in "ab":
        seen = numbers(node / f"{file}.out")
        assert len({line[1] for line in seen}) == 1
        assert [line[0] for line in seen].count("0") == 1
    said = sidecar.avckpt("events", "--json", "--since", "1h").stdout
    events = [json.loads(line) for line in said.splitlines()]
    assert f"{car.name}/a" in {event["container"] for event in events if event["kind"] == "restored"}
    done = car.stop(9)
    assert done.took_s < 8
    assert car.logs().split("\n")[1:3] == ["a 143", "b 143"]
    assert nodes_of(sidecar, car) == {}


def test_a_restarted_sidecar_knows_them_again(container: ContainerFactory, sidecar: Sidecar, node: Path) -> None:
    car = container.protected("bash", "-c", LAUNCHER, labels=NODES, options=("-v", f"{node}:/node", "--user", "1000"))
    before = wait_nodes(sidecar, car, 2)
    sidecar.restart()
    after = wait_nodes(sidecar, car, 2)
    assert {row["init_pid"] for row in before.values()} == {row["init_pid"] for row in after.values()}
    os.kill(app_pid(after["a"]), signal.SIGKILL)
    wait_until(lambda: nodes_of(sidecar, car)["a"]["restores"] == 1, 20, "it is restored")
    assert "ended" not in car.logs()


def test_what_a_container_may_not_do(container: ContainerFactory, sidecar: Sidecar, podman: Podman) -> None:
    """It may register only processes of its own, and none at all without the label."""
    script = "/run/avckpt-init --label avckpt.keep=3 -- sleep 3; echo status $?"
    for labels, options, says in (
        ({"scope": "container"}, (), "there is no avckpt here"),
        (
            {"scope": "container"},
            ("-v", f"{RUN_DIR}/units:/run/avckpt-units"),
            "its container was not started with avckpt.scope=nodes",
        ),
    ):
        web = container.protected("sh", "-c", script, labels=labels, options=options)
        web.wait_for_log("status 0")
        assert says in web.logs()
        assert nodes_of(sidecar, web) == {}
    car = container.protected(
        "sh", "-c", "$AVCKPT_INIT --label avckpt.group=x -- sleep 3; echo status $?", labels={"scope": "nodes"}
    )
    car.wait_for_log("status 0")
    assert "label avckpt.group: it is for whoever starts the container to give, not for a node" in car.logs()


PROGRAMS = """\
loglevel=debug

[program:a]
command=%(ENV_AVCKPT_INIT)s --name a -- python3 /node/node.py /node/a.out
stopasgroup=true

[program:b]
command=%(ENV_AVCKPT_INIT)s --name b -- python3 /node/node.py /node/b.out

[program:c]
command=%(ENV_AVCKPT_INIT)s --name c --label avckpt.restore.on=signal -- sh -c "sleep 3; exit 7"
startsecs=1
autorestart=unexpected
exitcodes=7
"""


def test_supervisord(container: ContainerFactory, sidecar: Sidecar, node: Path) -> None:
    lent = supervisor_options()
    if not lent:
        pytest.skip("PyPI's supervisor is not in .venv: pip install supervisor")
    (node / "supervisord.conf").write_text(SUPERVISORD_CONF + PROGRAMS)
    car = container.protected(
        *SUPERVISORD, "/node/supervisord.conf", labels=NODES, options=("-v", f"{node}:/node", *lent)
    )
    wait_nodes(sidecar, car, 2)
    car.wait_for_log("exited: c (exit status 7; expected)")
    dice = random.Random(1)
    for restores in range(1, 6):
        for name in "ab":
            wait_until(lambda: nodes_of(sidecar, car)[name]["generations"] == 2, 20, "two generations")  # noqa: B023
            os.kill(app_pid(nodes_of(sidecar, car)[name]), dice.choice(SIGNALS))
            wait_until(lambda: nodes_of(sidecar, car)[name]["restores"] == restores, 20, f"{name} is restored")  # noqa: B023
    log = car.logs()
    assert log.count("exited:") == 1, log
    assert log.count("spawned:") == 3, log
    assert "reaped unknown pid" not in log, log
    car.stop(20)
    log = car.logs()
    assert "stopped: a (terminated by SIGTERM)" in log, log
    assert "stopped: b (terminated by SIGTERM)" in log, log
