# SPDX-License-Identifier: Apache-2.0
"""A shell script that loops over child processes, and a Python program with a pool of workers, protected."""

from __future__ import annotations

import random
import subprocess
import time
from pathlib import Path

import pytest

from testkit.harness import ContainerFactory, Sidecar, wait_until
from testkit.trees import LONG, RESTORE_S, Tree, check_laps, laps, start_tree, write_files

pytestmark = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; checkpoints and short-lived children race"
)

KILLS = 50 if LONG else 4

SHELL = """
i=0
wrong() { echo "WRONG $*"; exit 0; }
while :; do
    i=$((i + 1))
    text=$(printf '%s\\n' "$i" | tr 0-9 a-j | tr a-j 0-9)
    [ "$text" = "$i" ] || wrong "pipeline: $text, not $i"
    (exit $((i % 7)))
    status=$?
    [ $status = $((i % 7)) ] || wrong "status $status, not $((i % 7))"
    sleep 0.01 & first=$!
    sh -c 'exit 3' & second=$!
    wait $second
    status=$?
    [ $status = 3 ] || wrong "status of a background job: $status"
    wait $first || wrong "status of sleep: $?"
    [ -z "$(jobs -r)" ] || wrong "jobs: $(jobs)"
    lines=$(seq 1 500 | while read -r n; do echo "$n"; done | wc -l)
    [ "$lines" = 500 ] || wrong "$lines lines"
    echo "lap $i"
done
"""

POOL = """
import multiprocessing, multiprocessing.shared_memory, os, sys

def work(n):
    with counter.get_lock():
        counter.value += 1
    slots[n] += 1
    block.buf[n] = (block.buf[n] + 1) % 256
    return n * n, os.getpid()

def wrong(what):
    print("WRONG", what, flush=True)
    sys.exit(0)

counter = multiprocessing.Value("q", 0)
slots = multiprocessing.Array("q", 64, lock=False)
block = multiprocessing.shared_memory.SharedMemory(create=True, size=64)

if __name__ == "__main__":
    with multiprocessing.Pool(4) as pool:
        lap = 0
        while True:
            lap += 1
            results = pool.map(work, range(64), chunksize=4)
            if [r for r, _ in results] != [n * n for n in range(64)]:
                wrong(f"results {results}")
            if counter.value != 64 * lap:
                wrong(f"lap {lap}: the counter is {counter.value}, not {64 * lap}")
            if list(slots) != [lap] * 64:
                wrong(f"lap {lap}: slots {list(slots)}")
            if bytes(block.buf[:64]) != bytes([lap % 256] * 64):
                wrong(f"lap {lap}: shared block {bytes(block.buf[:64])}")
            print("lap", lap, flush=True)
"""


def kill_and_see_it_go_on(tree: Tree, kills: int, pause_s: float = 0.3) -> None:
    """After each kill the log goes on from the checkpoint, without an error in it."""
    rng = random.Random(7)
    for n in range(1, kills + 1):
        tree.next_generation()
        time.sleep(rng.uniform(0, pause_s))
        tree.kill()
        seen = len(laps(tree.container.logs()))
        wait_until(
            lambda seen=seen: len(laps(tree.container.logs())) > seen + 3,  # type: ignore[misc]
            RESTORE_S,
            f"the log of {tree.container.name} goes on after restore {n}: {tree.container.logs()[-500:]}",
            every_s=0.1,
        )
        assert "WRONG" not in tree.container.logs(), tree.container.logs()[-1000:]
    check_laps(laps(tree.container.logs()), kills)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("shell", ["bash", "sh"])
def test_a_script_that_loops_over_children(
    shell: str, sidecar: Sidecar, container: ContainerFactory, tmp_path: Path
) -> None:
    write_files(tmp_path, {"loop.sh": SHELL})
    tree = start_tree(sidecar, container, shell, "/files/loop.sh", options=["--volume", f"{tmp_path}:/files:ro"])
    kill_and_see_it_go_on(tree, KILLS)


@pytest.mark.timeout(900)
def test_a_pool_of_workers_with_shared_memory(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    """multiprocessing's Pool, Value, Array and SharedMemory, whose semaphores are in shared memory, too."""
    write_files(tmp_path, {"pool.py": POOL})
    tree = start_tree(sidecar, container, "python3", "/files/pool.py", options=["--volume", f"{tmp_path}:/files:ro"])
    kill_and_see_it_go_on(tree, KILLS)


def test_exec_sessions_survive(sidecar: Sidecar, container: ContainerFactory, tmp_path: Path) -> None:
    """A process started by `podman exec` is no part of the application, and neither are its children."""
    write_files(tmp_path, {"loop.sh": SHELL})
    tree = start_tree(sidecar, container, "bash", "/files/loop.sh", options=["--volume", f"{tmp_path}:/files:ro"])
    command = 'while read -r line; do echo "$(echo "$line" | tr a-z A-Z)"; done; sleep 0.1; echo end'
    with subprocess.Popen(
        ["podman", "exec", "-i", tree.container.name, "bash", "-c", command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    ) as session:
        assert session.stdin is not None
        assert session.stdout is not None
        for n in range(3):
            session.stdin.write(f"line {n}\n")
            assert session.stdout.readline() == f"LINE {n}\n"
            tree.kill()
            tree.next_generation()
        session.stdin.write("last\n")
        assert session.stdout.readline() == "LAST\n"
        session.stdin.close()
        assert session.stdout.readline() == "end\n"
        assert session.wait(RESTORE_S) == 0
    entry = sidecar.find(tree.container)
    assert entry is not None
    assert entry["state"] == "protected"


def test_a_terminal_with_jobs(sidecar: Sidecar, container: ContainerFactory) -> None:
    """`podman run -it bash`: job control, the foreground group and the shell's variables are there after a restore."""
    made = container.protected(
        *("bash", "--norc", "-i"),
        labels={"interval": "100ms", "restore.max": "64/1s"},
        options=["--interactive", "--tty"],
    )
    tree = Tree(sidecar, made)
    sidecar.wait_generation(made, 2, 2 * RESTORE_S)
    with subprocess.Popen(
        ["script", "-qec", f"podman attach {made.name}", "/dev/null"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as terminal:
        assert terminal.stdin is not None

        def say(text: str) -> None:
            assert terminal.stdin is not None
            terminal.stdin.write(text.encode() + b"\n")
            terminal.stdin.flush()

        say("value=kept; sleep 1000 &")
        wait_until(lambda: any(m.name == "sleep" for m in tree.members()), RESTORE_S, "the job")
        tree.next_generation()
        before = tree.places()
        for n in range(3):
            tree.kill()
            assert tree.places() == before
            say(f"echo answer {n} $value $(jobs | grep -c Running)")
            made.wait_for_log(f"answer {n} kept 1", RESTORE_S)
            tree.next_generation()
        say("fg")
        wait_until(lambda: foreground(tree) == "sleep", RESTORE_S, "the job is in the foreground")
        tree.next_generation()
        tree.kill()
        wait_until(lambda: foreground(tree) == "sleep", RESTORE_S, "the job is in the foreground again")
        terminal.stdin.write(b"\x03")
        terminal.stdin.flush()
        wait_until(lambda: foreground(tree) == "bash", RESTORE_S, "^C has ended it")
        say("echo the end")
        made.wait_for_log("\nthe end", RESTORE_S)
        terminal.kill()


def foreground(tree: Tree) -> str:
    """The name of the process whose group is in the foreground of the application's terminal."""
    stat = Path(f"/proc/{tree.main}/stat").read_text().rpartition(")")[2].split()
    front = int(stat[5])
    names = {m.pid: m.name for m in tree.members()}
    return names.get(front, f"none of it ({front})")
