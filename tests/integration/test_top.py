# SPDX-License-Identifier: Apache-2.0
"""`avckpt top` with a real sidecar: driven by its keys, and once on a terminal."""

from __future__ import annotations

import asyncio
import os
import pty
import select
import signal
import subprocess
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from avckpt.cli.client import Client, Json
from avckpt.cli.top import COLUMNS, Ask, Top, shortened, sparkline
from avckpt.guard import Command
from rich.text import Text
from textual.pilot import Pilot
from textual.widgets import DataTable, Label, RichLog
from textual.widgets._footer import FooterKey

from testkit.harness import avckpt_command, take_checkpoint, wait_until
from testkit.local_sidecar import ON_COMMAND, LocalSidecar

SLEEPER = ["sleep", "1000"]
LABELS = {"avckpt.enable": "true", "avckpt.interval": "300ms"}
PATIENCE_S = 60
pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root")


def cells(app: Top, column: str) -> list[str]:
    table = app.query_one("#units", DataTable)
    return [str(table.get_row_at(row)[COLUMNS.index(column)]) for row in range(table.row_count)]


def events(app: Top) -> str:
    return "\n".join(line.text for line in app.query_one("#events", RichLog).lines)


async def until(pilot: Pilot[None], holds: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < deadline, what
        await pilot.pause(0.05)


def driven(local: LocalSidecar, steps: Callable[[Top, Pilot[None]], Awaitable[None]]) -> None:
    async def drive() -> None:
        app = Top(Client(local.run_dir))
        async with app.run_test(size=(160, 40)) as pilot:
            await steps(app, pilot)

    asyncio.run(drive())


@pytest.mark.shared_machine("restores and screens on a busy machine may take longer than the test waits")
def test_units_crashes_and_keys(local: LocalSidecar) -> None:
    lidar, planner = (local.protected(name, SLEEPER, LABELS) for name in ("lidar", "planner"))
    for each in (lidar, planner):
        local.wait_for(each, state="protected")

    async def steps(app: Top, pilot: Pilot[None]) -> None:
        await until(pilot, lambda: cells(app, "UNIT") == ["lidar", "planner"], "both units")
        await until(pilot, lambda: len(cells(app, "FREEZES")[0]) > 1, "a sparkline of freezes")
        os.kill(planner.app_pid, signal.SIGSEGV)
        await until(pilot, lambda: "killed by SIGSEGV, restored in" in cells(app, "LAST CRASH")[1], "the crash")
        assert cells(app, "RESTORES") == ["0", "1"]
        await pilot.press("s")
        await until(pilot, lambda: cells(app, "UNIT") == ["planner", "lidar"], "who crashed last comes first")
        await pilot.press("s", "home")
        await until(pilot, lambda: cells(app, "UNIT") == ["lidar", "planner"], "by name again")
        app.query_one("#units", DataTable).move_cursor(row=0)
        await pilot.press("r", "n")
        await pilot.press("r", "y")
        await until(pilot, lambda: "lidar: rolled back on command" in events(app), "the roll back")
        assert "planner: killed by SIGSEGV" in events(app)
        await pilot.press("e")
        await until(pilot, lambda: "planner" not in events(app), "only what happened to the chosen one")
        assert "lidar: rolled back" in events(app)
        assert events(app).count("lidar: rolled back on command") == 1

    driven(local, steps)


@pytest.mark.shared_machine("restores and screens on a busy machine may take longer than the test waits")
def test_a_sidecar_that_goes_and_comes(local: LocalSidecar) -> None:
    local.wait_for(local.protected("lidar", SLEEPER, LABELS), state="protected")

    async def steps(app: Top, pilot: Pilot[None]) -> None:
        head = app.query_one("#head")
        await until(pilot, lambda: "1 of 1" in str(head.render()), "one is protected")
        await asyncio.to_thread(local.stop)
        await until(pilot, lambda: "the sidecar is not running" in str(head.render()), "it says so")
        await asyncio.to_thread(local.start)
        await until(pilot, lambda: "not running" not in str(head.render()), "it is back")

    driven(local, steps)


def test_what_comes_while_the_screen_is_left_is_told_nobody(local: LocalSidecar) -> None:
    """Its widgets are gone then, but not the loop; the thread's traceback would be on the terminal."""

    async def steps(app: Top, pilot: Pilot[None]) -> None:
        await pilot.pause()
        await asyncio.to_thread(app._hand, app.query_one, "#gone")

    driven(local, steps)


def test_a_launcher_is_no_unit_that_lacks_protection(local: LocalSidecar) -> None:
    local.wait_for(local.protected("lidar", SLEEPER, LABELS), state="protected")
    launcher = local.protected("car", SLEEPER, {"avckpt.enable": "true", "avckpt.scope": "nodes"})
    local.wait_for(launcher, state="nodes")

    async def steps(app: Top, pilot: Pilot[None]) -> None:
        await until(pilot, lambda: cells(app, "UNIT") == ["car", "lidar"], "both units")
        assert "1 of 1 protected" in str(app.query_one("#head").render())
        assert cells(app, "GENS")[0] == "-"

    driven(local, steps)


@pytest.mark.shared_machine("restores and screens on a busy machine may take longer than the test waits")
def test_only_what_has_changed_is_painted(local: LocalSidecar, monkeypatch: pytest.MonkeyPatch) -> None:
    unit = local.protected("lidar", SLEEPER, ON_COMMAND)
    take_checkpoint(local.client, "lidar")
    local.wait_for(unit, state="protected")  # by one checkpoint, or by two if the first was missed
    looks, painted = 0, []
    show, update_cell = Top._show, DataTable.update_cell

    def look(app: Top, rows: list[Json], problem: str) -> None:
        nonlocal looks
        show(app, rows, problem)
        looks += 1

    def paint(table: DataTable[Text], row: str, column: str, cell: Text, **options: bool) -> None:
        update_cell(table, row, column, cell, **options)
        painted.append(column)

    monkeypatch.setattr(Top, "_show", look)
    monkeypatch.setattr(DataTable, "update_cell", paint)

    async def steps(app: Top, pilot: Pilot[None]) -> None:
        await until(pilot, lambda: "█" in "".join(cells(app, "FREEZES")), "the unit, and its events")
        freezes = len(cells(app, "FREEZES")[0])
        painted.clear()
        before = looks
        await until(pilot, lambda: looks > before + 2, "it has looked again")
        assert set(painted) == {"CHECKPOINT"}  # its age
        await asyncio.to_thread(take_checkpoint, local.client, "lidar")
        await until(pilot, lambda: len(cells(app, "FREEZES")[0]) == freezes + 1, "the next one")
        assert "UNIT" not in painted

    driven(local, steps)


@pytest.mark.shared_machine("restores and screens on a busy machine may take longer than the test waits")
def test_what_is_said_fits_the_screen(local: LocalSidecar) -> None:
    local.protected("lidar", SLEEPER, ON_COMMAND)
    take_checkpoint(local.client, "lidar")

    async def steps(app: Top, pilot: Pilot[None]) -> None:
        log = app.query_one("#events", RichLog)

        def fits() -> bool:
            lines = [line.text.rstrip() for line in log.lines]
            return "registered" in "".join(lines) and max(map(len, lines)) <= log.scrollable_content_region.width

        await until(pilot, lambda: "registered" in events(app), "the first event")
        await asyncio.to_thread(local.client.command, "lidar", Command.RESTORE)
        await until(pilot, lambda: "rolled back on command" in events(app), "a long one")
        for columns in (40, 25, 100):
            await pilot.resize_terminal(columns, 20)
            await until(pilot, fits, f"all of it in {columns} columns")
            await pilot.press("r")
            await until(pilot, lambda: isinstance(app.screen, Ask), "a question")
            await until(pilot, lambda: app.screen.query_one(Label).size.width > 0, "it is laid out")
            assert app.screen.query_one(Label).region.right <= columns
            await pilot.press("n")

    driven(local, steps)


@pytest.mark.shared_machine("screens on a busy machine may take longer than the test waits")
def test_a_long_name_leaves_room_for_the_rest(local: LocalSidecar) -> None:
    name = f"vehicle-{'x' * 100}-lidar"
    local.wait_for(local.protected(name, SLEEPER, LABELS), state="protected")

    async def steps(app: Top, pilot: Pilot[None]) -> None:
        table = app.query_one("#units", DataTable)

        def is_seen() -> bool:
            before = sum(table.ordered_columns[n].get_render_width(table) for n in range(2))
            return bool(cells(app, "UNIT")) and before <= table.size.width

        for columns in (160, 80, 40, 120):
            await pilot.resize_terminal(columns, 20)
            await until(pilot, is_seen, f"its state in {columns} columns")
            assert cells(app, "STATE") == ["protected"]
            (shown,) = cells(app, "UNIT")
            assert shown.startswith("vehic")
            assert shown.endswith("idar")
            leave = next(key for key in app.query(FooterKey) if key.description == "Leave")
            assert leave.region.right <= columns

    driven(local, steps)


@pytest.mark.parametrize(
    ("name", "length", "shown"), [("lidar", 5, "lidar"), ("a-lidar", 5, "a-…ar"), ("abcdefg", 6, "abc…fg")]
)
def test_a_name_is_shortened_in_the_middle(name: str, length: int, shown: str) -> None:
    assert shortened(name, length) == shown


@dataclass
class Shown:
    """`avckpt top` on a terminal, and what it has drawn there."""

    process: subprocess.Popen[bytes]
    leader: int
    screen: bytes = b""

    def sees(self, text: bytes) -> bool:
        while select.select([self.leader], [], [], 0)[0]:
            self.screen += os.read(self.leader, 65536)
        return text in self.screen

    def press(self, key: bytes) -> None:
        os.write(self.leader, key)

    def ends(self) -> int:
        wait_until(
            lambda: self.sees(b"\x1b[?1049l") and self.process.poll() is not None,
            PATIENCE_S,
            "the terminal is as before",
        )
        return int(self.process.returncode)


@pytest.fixture
def shown(local: LocalSidecar) -> Iterator[Shown]:
    local.protected("lidar", SLEEPER, LABELS)
    leader, terminal = pty.openpty()
    env = {**os.environ, **local.env, "TERM": "xterm-256color"}
    process = subprocess.Popen([*avckpt_command(), "top"], stdin=terminal, stdout=terminal, stderr=terminal, env=env)
    try:
        shown = Shown(process, leader)
        wait_until(lambda: shown.sees(b"lidar"), PATIENCE_S, "the unit")
        yield shown
    finally:
        process.kill()
        process.wait()
        os.close(terminal)
        os.close(leader)


@pytest.mark.shared_machine("a screen is given a time to show what it should")
@pytest.mark.parametrize("keys", [b"q", b"\x03", b"r\x03"], ids=["q", "ctrl-c", "ctrl-c, when asked"])
def test_on_a_terminal(shown: Shown, keys: bytes) -> None:
    if keys.startswith(b"r"):
        shown.press(b"r")
        wait_until(lambda: shown.sees(b"Roll"), PATIENCE_S, "the question")
    shown.press(keys[-1:])
    assert shown.ends() == 0


@pytest.mark.shared_machine("a screen is given a time to show what it should")
def test_what_ends_it_leaves_the_terminal_as_it_was(shown: Shown) -> None:
    shown.process.send_signal(signal.SIGTERM)
    assert shown.ends() == 128 + signal.SIGTERM


@pytest.mark.shared_machine("a screen is given a time to show what it should")
def test_ctrl_z_stops_it(shown: Shown) -> None:
    def state() -> str:
        return Path(f"/proc/{shown.process.pid}/stat").read_text().rpartition(") ")[2][0]

    shown.press(b"\x1a")
    wait_until(lambda: shown.sees(b"\x1b[?1049l") and state() == "T", PATIENCE_S, "it is stopped")
    shown.screen = b""
    shown.process.send_signal(signal.SIGCONT)
    wait_until(lambda: shown.sees(b"lidar"), PATIENCE_S, "it is back")
    shown.press(b"q")
    assert shown.ends() == 0


def test_a_terminal_that_cannot_show_it(local: LocalSidecar) -> None:
    leader, terminal = pty.openpty()
    top, env = [*avckpt_command(), "top"], {**os.environ, **local.env, "TERM": "xterm-256color"}
    no = subprocess.DEVNULL
    try:
        for stdin, stdout, stderr, name in (
            (terminal, terminal, terminal, "dumb"),
            (terminal, terminal, terminal, ""),
            (no, terminal, terminal, "xterm"),
            (terminal, terminal, no, "xterm"),
        ):
            said = subprocess.run(
                top, stdin=stdin, stdout=stdout, stderr=stderr, env={**env, "TERM": name}, timeout=PATIENCE_S
            )
            assert said.returncode == 2
        assert b"\x1b" not in os.read(leader, 65536)
    finally:
        os.close(terminal)
        os.close(leader)


def test_without_a_terminal_or_a_sidecar_it_says_so(local: LocalSidecar) -> None:
    said = local.avckpt("top", check=False)
    assert (said.status, "it needs a terminal" in said.stderr) == (2, True)
    local.stop()
    said = local.avckpt("top", check=False)
    assert (said.status, "the sidecar is not running" in said.stderr) == (3, True)


def test_a_sparkline_is_against_its_greatest() -> None:
    assert sparkline([]) == ""
    assert sparkline([0.0, 0.0]) == "▁▁"
    assert sparkline([1.0, 4.0, 8.0]) == "▂▅█"
