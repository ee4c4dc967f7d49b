# SPDX-License-Identifier: Apache-2.0
"""`avckpt top`: all units on one screen, live."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from rich.markup import escape
from rich.text import Text
from textual import work
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.css.query import NoMatches
from textual.screen import ModalScreen
from textual.widgets import DataTable, Footer, Label, RichLog, Static

from avckpt.cli.commands import STATE_STYLES
from avckpt.cli.events import COLOURS, RETRY_S, UNGUARDED, called
from avckpt.errors import AvckptError
from avckpt.guard import Command

if TYPE_CHECKING:
    from textual.events import Resize
    from textual.notifications import SeverityLevel

    from avckpt.cli.client import Client, Json

LOOK_S = 1.0
NAME_LEAST = 10
"""Columns that a name may always take; on a wide screen it is a third."""
SPARKS = "▁▂▃▄▅▆▇█"
KEPT = 12
"""Freezes and restores that a sparkline has."""
LINES = 500
"""Events that can be scrolled back to."""
COLUMNS = ("UNIT", "STATE", "GENS", "CHECKPOINT", "FREEZE", "FREEZES", "RESTORES", "RESTORE", "LAST CRASH")
HELP = """[b]avckpt top[/b]

c       take a checkpoint of the chosen unit
r       roll the chosen unit back to its newest checkpoint (asks first)
e       events of the chosen unit only, or of all
s       sort by name, or those that crashed last first
?       this help
q       leave, as does Ctrl-C; Ctrl-Z stops it

FREEZES and RESTORE have the last twelve, each against the longest of them.
Any key closes this."""


@dataclass
class Seen:
    """What the events of a unit have told so far."""

    freezes_s: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    restores_s: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    crash: str = ""
    """The last one, in a sentence."""
    crash_at: float = 0.0

    def take(self, event: Json) -> None:
        """Takes in an event."""
        if event["kind"] == "checkpoint":
            self.freezes_s.append(event.get("freeze_s", 0.0))
        elif event["kind"] in ("restored", "gave_up") and event.get("outcome") not in ("clean_exit", "stopped"):
            self.crash, self.crash_at = event["message"], event["at"]
            if "restore_s" in event:
                self.restores_s.append(event["restore_s"])


def sparkline(values: Iterable[float]) -> str:
    """One character for each value, against the greatest."""
    values = list(values)
    most = max(values, default=0.0) or 1.0
    return "".join(SPARKS[min(int(value / most * len(SPARKS)), len(SPARKS) - 1)] for value in values)


def shortened(name: str, length: int) -> str:
    """Without its middle: where it begins and ends is where names of one machine differ."""
    begin = length // 2
    return name if len(name) <= length else f"{name[:begin]}…{name[begin + 1 - length :]}"


class Ask(ModalScreen[bool]):
    """A question that y answers; any other key is no."""

    DEFAULT_CSS = (
        "Ask { align: center middle; } "
        "Ask Label { background: $panel; padding: 0 1; border: round $accent; max-width: 100%; }"
    )

    def __init__(self, question: str) -> None:
        super().__init__()
        self._question = question

    def compose(self) -> ComposeResult:
        """The question."""
        yield Label(self._question)

    def on_key(self, event: object) -> None:
        """Any key closes it."""
        self.dismiss(getattr(event, "key", "") == "y")


class EventLog(RichLog):
    """Lines of events, each wrapped where the screen ends."""

    # The bar has its place before there is anything to scroll, or the first lines would be too long by it.
    DEFAULT_CSS = "EventLog { scrollbar-gutter: stable; }"

    def __init__(self, write_all: Callable[[], None]) -> None:
        super().__init__(id="events", max_lines=LINES, min_width=0, wrap=True)
        self._write_all = write_all

    def on_resize(self, event: Resize) -> None:
        """Wraps them anew; Textual calls the handler of the class above by itself."""
        self._write_all()


class Top(App[None]):
    """The screen.  Asks the sidecar in threads of its own, so that keys never wait for it."""

    CSS = "#head { height: 1; } #units { height: 2fr; } #events { height: 1fr; border-top: solid $accent; }"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        # A narrow screen shows the first ones, and the others in the help.
        Binding("q", "quit", "Leave"),
        Binding("question_mark", "help", "Help"),
        Binding("c", "checkpoint", "Checkpoint"),
        Binding("r", "restore", "Roll back"),
        Binding("e", "events", "Events of one / all"),
        Binding("s", "sort", "Sort"),
        # As in any other program, also while a question is asked; Textual itself only says how to leave.
        Binding("ctrl+c", "quit", show=False, priority=True),
        Binding("ctrl+z", "suspend_process", show=False, priority=True),
    ]

    def __init__(self, client: Client) -> None:
        super().__init__()
        self._client = client
        self._rows: list[Json] = []
        self._seen: dict[str, Seen] = {}
        self._told: deque[Json] = deque(maxlen=LINES)
        self._only: str = ""
        """The unit whose events are shown; empty: all."""
        self._crashed_first = False
        self._problem = ""

    def compose(self) -> ComposeResult:
        """A line about all, the units, and the events."""
        yield Static(id="head")
        with Vertical():
            table: DataTable[Text] = DataTable(id="units", cursor_type="row", zebra_stripes=True)
            yield table
            yield EventLog(self._write_events)
        yield Footer()

    def on_mount(self) -> None:
        """Begins to look."""
        for name in COLUMNS:
            self._table.add_column(name, key=name)
        self._table.focus()
        # The terminal is to be as it was before.
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, self.exit, None, 128 + signal.SIGTERM)
        # A thread that nobody waits for: it may be in a read when somebody leaves.
        threading.Thread(target=self._follow, daemon=True).start()
        self._look()
        self.set_interval(LOOK_S, self._look)

    # What comes

    @work(thread=True, exclusive=True, group="look")
    def _look(self) -> None:
        try:
            rows, problem = self._client.containers(memory=False), ""
        except AvckptError as error:
            rows, problem = self._rows, str(error).partition(":")[0]
        self._hand(self._show, rows, problem)

    def _follow(self) -> None:
        after: int | None = None
        while self.is_running:
            # That the sidecar went away, the line about all says.
            with contextlib.suppress(AvckptError):
                for event in self._client.events(after, routine=True):
                    after = event["seq"] or after
                    self._hand(self._take, event)
            time.sleep(RETRY_S)

    def _hand(self, callback: Callable[..., object], *args: object) -> None:
        """Calls it in the screen's thread, from another one; does nothing when the screen is being left."""
        with contextlib.suppress(RuntimeError, CancelledError, NoMatches):  # the last: widgets go first
            self.call_from_thread(callback, *args)

    def _take(self, event: Json) -> None:
        self._seen.setdefault(event["id"], Seen()).take(event)
        if event["kind"] != "checkpoint":
            self._told.append(event)
            self._write_event(event)

    # What is shown

    @property
    def _table(self) -> DataTable[Text]:
        return self.query_one("#units", DataTable)

    @property
    def _event_log(self) -> EventLog:
        return self.query_one("#events", EventLog)

    def _write_event(self, event: Json) -> None:
        if self._only in ("", event["id"]) or not event["id"]:
            self._event_log.write(_line(event), expand=True)

    def _write_events(self) -> None:
        self._event_log.clear()
        for event in self._told:
            self._write_event(event)

    def _show(self, rows: list[Json], problem: str) -> None:
        self._rows, self._problem = rows, problem
        units = [row for row in rows if row["state"] not in UNGUARDED]
        sound = sum(row["state"] == "protected" for row in units)
        restores = sum(row["restores"] for row in rows)
        head = f"[b]avckpt[/b]  {sound} of {len(units)} protected, {restores} restores"
        self.query_one("#head", Static).update(f"{head}  [red]{escape(problem)}[/red]" if problem else head)
        rows = sorted(rows, key=self._order)
        wanted = {row["id"]: self._cells(row) for row in rows}
        table = self._table
        if list(wanted) != [key.value for key in table.rows]:
            chosen = self._chosen()
            table.clear()
            for key, cells in wanted.items():
                table.add_row(*cells, key=key)
            if chosen in wanted:
                table.move_cursor(row=list(wanted).index(chosen))
            return
        for key, cells in wanted.items():
            for column, before, cell in zip(COLUMNS, table.get_row(key), cells):
                if cell != before:  # what is the same would be measured and painted again
                    table.update_cell(key, column, cell, update_width=True)

    def _order(self, row: Json) -> tuple[float, str]:
        crash_at = self._seen.get(row["id"], Seen()).crash_at if self._crashed_first else 0.0
        return -crash_at, called(row)

    def _cells(self, row: Json) -> list[Text]:
        seen = self._seen.get(row["id"], Seen())
        age_s = None if row["last_checkpoint_at"] is None else max(0.0, time.time() - row["last_checkpoint_at"])
        restores = " ".join(filter(None, (sparkline(seen.restores_s), _ms(row["last_restore_s"]))))
        return [
            Text(shortened(called(row), max(self.size.width // 3, NAME_LEAST))),
            Text(row["state"], style=STATE_STYLES.get(row["state"], "")),
            Text("-" if row["state"] in UNGUARDED else f"{row['generations']}/{row['keep']}"),
            Text("-" if age_s is None else f"{age_s:.1f} s", justify="right"),
            Text(_ms(row["last_freeze_s"]), justify="right"),
            Text(sparkline(seen.freezes_s)),
            Text(str(row["restores"]), justify="right"),
            Text(restores),
            Text(seen.crash or row["reason"]),
        ]

    # Keys

    def _chosen(self) -> str:
        """The id of the unit under the cursor; empty: there is none."""
        table = self._table
        if not table.row_count:
            return ""
        return str(table.coordinate_to_cell_key(table.cursor_coordinate).row_key.value)

    def action_checkpoint(self) -> None:
        """Takes a checkpoint."""
        if self._chosen():
            self._command(self._chosen(), Command.CHECKPOINT)

    def action_restore(self) -> None:
        """Rolls back, once confirmed."""
        unit = self._chosen()
        name = next((called(row) for row in self._rows if row["id"] == unit), "")

        def go(yes: bool | None) -> None:
            if yes:
                self._command(unit, Command.RESTORE)

        if name:
            self.push_screen(Ask(f"Roll {escape(name)} back to its newest checkpoint?  y / n"), go)

    @work(thread=True, group="command")
    def _command(self, unit: str, command: Command) -> None:
        try:
            said, severity = str(self._client.command(unit, command)["event"]["message"]), "information"
        except AvckptError as error:
            said, severity = str(error), "error"
        self._hand(self._notice, said, severity)

    def _notice(self, text: str, severity: SeverityLevel) -> None:
        self.notify(escape(text), severity=severity)

    def action_events(self) -> None:
        """Shows the events of one unit, or of all."""
        self._only = "" if self._only else self._chosen()
        self._write_events()

    def action_sort(self) -> None:
        """Sorts the other way."""
        self._crashed_first = not self._crashed_first
        self._show(self._rows, self._problem)

    def action_help(self) -> None:
        """Says what the keys do."""
        self.push_screen(Ask(HELP))


def _ms(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds * 1000:.1f} ms"


def _line(event: Json) -> Text:
    at = time.strftime("%H:%M:%S", time.localtime(event["at"]))
    text = Text(f"{at} {event['container']}: " if event["container"] else f"{at} ")
    return text.append(event["message"], style=COLOURS.get(event["kind"], ""))
