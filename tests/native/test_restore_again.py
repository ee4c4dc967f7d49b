# SPDX-License-Identifier: Apache-2.0
"""avckpt.restore.again: what a restore changes soon after another one."""

from __future__ import annotations

import socket
import statistics
import time
from functools import partial
from pathlib import Path

import pytest
from avckpt.guard import Again

from testkit.guarded import PATIENCE_S, GuardProcess, Json, Victim, config
from testkit.harness import wait_until

INBOXES = 7


@pytest.fixture(autouse=True)
def built(init_built: None, victims_built: Path) -> None:
    """avckpt-init and the victims."""


def counter(victim: Victim, which: int) -> int:
    return victim.see().counter[which]


def restored(guard: GuardProcess) -> list[Json]:
    return [event for event in guard.events if event["kind"] == "restored"]


@pytest.mark.parametrize("command", ["inbox", "inbox --in-child"])
@pytest.mark.parametrize("again", [Again.SAME, Again.STAGGER, Again.DROP_INPUT], ids=["same", "stagger", "drop-input"])
def test_waiting_messages_that_kill_are_dropped_at_the_second_try(tmp_path: Path, again: Again, command: str) -> None:
    settings = config(again=again, restore_max=3, restore_window_s=60.0)
    with Victim(command, tmp_path) as victim, GuardProcess(settings, [victim.pid]) as guard:
        listening = ("127.0.0.1", counter(victim, 2))
        with (
            socket.create_connection(listening) as accepted,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams,
        ):
            wait_until(lambda: counter(victim, 4) == 1, PATIENCE_S, "it has a connection")
            accepted.sendall(b"poison")
            for message in (b"", b"poison"):
                datagrams.sendto(message, ("127.0.0.1", counter(victim, 1)))
            with socket.create_connection(listening) as waiting:
                assert guard.checkpoint()["kind"] == "checkpoint"
                victim.board.set_counter(3, 1)
                if again is not Again.DROP_INPUT:
                    assert guard.wait("gave_up")["reason"] == "loop"
                    assert all(not event.get("input_dropped") for event in restored(guard))
                    return
                wait_until(lambda: counter(victim, 0) > 10, PATIENCE_S, "it lives on")
                first, second = restored(guard)
                assert ("again" in first, second["again"]) == (False, "drop-input")
                if "--in-child" in command:  # what a child had that ends before its parent is made anew, and empty
                    assert second["input_dropped"] <= INBOXES
                else:
                    assert (second["input_dropped"], second.get("error")) == (INBOXES, None)
                for client in (accepted, waiting):
                    client.settimeout(PATIENCE_S)
                    with pytest.raises(ConnectionResetError):
                        client.recv(1)
                # Both its sockets are what they were.
                datagrams.sendto(b"more", ("127.0.0.1", counter(victim, 1)))
                guard.wait("died", count=3)


def test_what_is_rolled_back_on_command_keeps_its_input(tmp_path: Path) -> None:
    settings = config(again=Again.DROP_INPUT, restore_max=3, restore_window_s=60.0)
    with (
        Victim("inbox", tmp_path) as victim,
        GuardProcess(settings, [victim.pid]) as guard,
        socket.create_connection(("127.0.0.1", counter(victim, 2))),
    ):
        wait_until(lambda: counter(victim, 4) == 1, PATIENCE_S, "it has a connection")
        guard.checkpoint()
        for _ in range(3):
            assert "again" not in guard.command("restore")
        victim.board.set_counter(3, 1)
        # Nor is a first crash a repeated one, whatever was before it.
        assert "again" not in guard.wait_for(lambda event: event.get("reason") == "signal", "a restore")


PAIRS = 6
WINDOW_S = 1.0


@pytest.mark.shared_machine("a checkpoint that comes late is not of threads that sleep")
def test_threads_go_on_at_random_times_at_the_second_try_and_only_then(tmp_path: Path) -> None:
    settings = config(again=Again.STAGGER, restore_max=64, restore_window_s=WINDOW_S)
    apart_ms: dict[str, list[float]] = {"": [], "stagger": []}
    with Victim("meeting", tmp_path) as victim, GuardProcess(settings, [victim.pid]) as guard:
        wait_until(lambda: counter(victim, 1) == 1, PATIENCE_S, "they sleep", every_s=0.001)
        assert guard.checkpoint()["kind"] == "checkpoint"
        assert counter(victim, 0) == 0
        for number in range(2 * PAIRS):
            if number % 2 == 0:
                time.sleep(WINDOW_S)
            woken = counter(victim, 0)
            victim.kill_app()
            event = guard.wait("restored", count=number + 1)
            wait_until(partial(have_woken, victim, woken + 2), PATIENCE_S, "they have woken")
            seen = victim.see().counter
            apart_ms[event.get("again", "")].append(abs(seen[2] - seen[3]) / 1e6)
        assert [len(each) for each in apart_ms.values()] == [PAIRS, PAIRS]
        # A pause of up to 20 ms for each, beside what the machine takes to wake both.
        assert statistics.median(apart_ms["stagger"]) > 2 * statistics.median(apart_ms[""]), apart_ms


def have_woken(victim: Victim, times: int) -> bool:
    return counter(victim, 0) >= times
