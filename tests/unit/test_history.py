# SPDX-License-Identifier: Apache-2.0
"""The history: bounded, numbered, and intact whatever happened to the sidecar that wrote it."""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest
from avckpt.events import archive
from avckpt.events.archive import Archive
from avckpt.events.history import History
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import Kind


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "history.jsonl"


def died(at: float = 0.0, detail: str = "") -> EventRecord:
    return EventRecord(Kind.DIED, container="web", at=at, wait_status=9, detail=detail)


def test_events_are_numbered_and_found_again_by_the_next_sidecar(path: Path) -> None:
    history = History(path)
    first, second = history.add(died(10.0)), history.add(died(20.0))
    assert first.seq > 0
    assert second.seq == first.seq + 1
    after_restart = History(path)
    assert after_restart.after() == [first, second]
    assert after_restart.add(died(30.0)).seq == second.seq + 1
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_after_and_since(path: Path) -> None:
    history = History(path)
    records = [history.add(died(float(at))) for at in (10, 20, 30)]
    assert history.after(records[0].seq) == records[1:]
    assert history.after(records[2].seq) == []
    assert history.after(since=20.0) == records[1:]
    assert history.after(records[1].seq, since=10.0) == records[2:]


def test_a_number_of_a_history_that_was_lost_gets_everything(path: Path) -> None:
    history = History(path)
    records = [history.add(died()) for _ in range(3)]
    assert history.after(records[2].seq + 1) == records
    # The other way round: numbers of a lost one are smaller than all new ones.
    path.unlink()
    time.sleep(1.1)
    assert History(path).add(died()).seq > records[0].seq


def test_one_container_takes_half_of_it(path: Path) -> None:
    """Whatever its nodes are called."""
    history = History(path, limit=10)
    others = [history.add(EventRecord(Kind.DIED, container=f"c{i}", at=float(i))) for i in range(8)]
    for i in range(100):
        history.add(EventRecord(Kind.REGISTERED, container=f"car/{i}"))
    assert history.after()[:5] == others[3:]
    assert [record.container for record in history.after()[5:]] == [f"car/{i}" for i in range(95, 100)]
    assert History(path, limit=10).after() == history.after()
    # Others go on to replace the oldest.
    newer = [history.add(EventRecord(Kind.DIED, container=f"d{i}")) for i in range(10)]
    assert history.after() == newer


def test_it_is_bounded_in_memory_and_in_the_file(path: Path) -> None:
    history = History(path, limit=10)
    longest = 0
    for number in range(95):
        history.add(died(float(number)))
        longest = max(longest, len(path.read_bytes().splitlines()))
    assert 10 <= longest <= 20
    assert [record.at for record in history.after()] == [float(n) for n in range(85, 95)]
    assert [record.at for record in History(path, limit=10).after()] == [float(n) for n in range(85, 95)]
    assert os.listdir(path.parent) == [path.name]


@pytest.mark.parametrize(
    "junk", [b'{"kind": "died", "at": 1', b"\x00\xff\x00\n", b"[1]\n", b"{}\n", b'{"kind": "novelty"}\n', b"\n"]
)
def test_a_torn_or_foreign_line_costs_that_line_only(path: Path, junk: bytes) -> None:
    first = History(path).add(died(1.0))
    with path.open("ab") as file:
        file.write(junk)
    history = History(path)
    assert history.after() == [first]
    second = history.add(died(2.0))
    assert History(path).after() == [first, second]
    assert len(path.read_bytes().splitlines()) == 2


def test_what_can_not_be_written_is_kept_in_memory_and_said_once(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path.mkdir()
    history = History(path)
    records = [history.add(died()) for _ in range(3)]
    assert history.after() == records
    assert [record.message for record in caplog.records] == [
        f"{path} cannot be used (Is a directory): events are kept in memory only"
    ]


def test_it_is_whole_again_once_it_can_be_written(
    path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is full for a while: here a limit on the length of files, met in the middle of a line."""
    caplog.set_level("INFO", "avckpt")
    history = History(path)
    records = [history.add(died(1.0))]
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 10, before[1]))
    try:
        records += [history.add(died(at)) for at in (2.0, 3.0)]
        monkeypatch.setattr("avckpt.events.history.AGAIN_S", 0.0)
        records.append(history.add(died(4.0)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    records.append(history.add(died(5.0)))
    assert History(path).after() == records
    assert [record.getMessage() for record in caplog.records] == [
        f"{path} cannot be used (File too large): events are kept in memory only",
        f"{path} is written again",
    ]


def test_a_writer_that_is_killed_at_any_instant_leaves_a_history_without_a_gap(path: Path) -> None:
    """Small limit, so that many of the kills hit a replacement of the file."""
    program = (
        "import sys\nfrom pathlib import Path\nfrom avckpt.events.history import History\n"
        "from avckpt.events.record import EventRecord, Kind\n"
        "h = History(Path(sys.argv[1]), limit=20)\nprint(flush=True)\n"
        "while True: print(h.add(EventRecord(Kind.DIED, wait_status=9)).seq, flush=True)\n"
    )
    newest = 0
    for _ in range(8):
        with subprocess.Popen([sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            writer.stdout.readline()
            time.sleep(random.uniform(0.01, 0.1))
            writer.send_signal(signal.SIGKILL)
            told = [int(word) for word in writer.stdout.read().split()]
        assert told
        assert told[0] > newest
        history = History(path, limit=20)
        numbers = [record.seq for record in history.after()]
        assert numbers == list(range(numbers[0], numbers[-1] + 1))
        # What was told was kept; at most one more was kept without being told.
        assert numbers[-1] - told[-1] in (0, 1)
        newest = numbers[-1]
        history.close()
    assert all(json.loads(line)["kind"] == "died" for line in path.read_text().splitlines())


def begun(path: Path, folder: Path, *more: float) -> list[EventRecord]:
    """What a sidecar knows that finds a history and an archive, and adds to both."""
    history = History(path, archive=Archive(folder))
    for at in more:
        history.add(died(at))
    history.close()
    return history.after()


def test_an_archive_outlives_the_history(path: Path, tmp_path: Path) -> None:
    folder = tmp_path / "disk"
    folder.mkdir()
    before = begun(path, folder, 1.0, 2.0)
    path.unlink()  # a reboot
    after = begun(path, folder, 3.0)
    assert after[:2] == before
    assert [(record.seq - before[0].seq, record.at) for record in after] == [(0, 1.0), (1, 2.0), (2, 3.0)]
    assert begun(path, folder) == History(path).after() == after
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert stat.S_IMODE((folder / path.name).stat().st_mode) == 0o600


def test_each_is_completed_by_the_other(path: Path, tmp_path: Path) -> None:
    """There was no archive at first, or a sidecar was killed before its disk had all."""
    folder = tmp_path / "disk"
    first = begun(path, folder, 1.0)
    assert not folder.exists()
    folder.mkdir()
    assert begun(path, folder) == first
    both = begun(path, tmp_path / "none", 2.0)
    assert begun(path, folder, 3.0)[:2] == both
    path.unlink()
    assert [record.at for record in begun(path, folder)] == [1.0, 2.0, 3.0]


def test_nobody_waits_for_a_disk(
    path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that does not answer: here a pipe in the place of the file."""
    for name in ("LOAD_S", "CLOSE_S"):
        monkeypatch.setattr(archive, name, 0.1)
    folder = tmp_path / "disk"
    folder.mkdir()
    os.mkfifo(folder / path.name)
    history = History(path, limit=10, archive=Archive(folder, limit=10))
    records = [history.add(died(float(at))) for at in range(30)]
    history.close()
    assert History(path, limit=10).after() == records[20:]
    assert [record.getMessage() for record in caplog.records] == [
        f"{folder} does not answer: earlier events are not known"
    ]


def test_what_is_in_its_place_holds_nobody_up(path: Path) -> None:
    os.mkfifo(path)
    record = History(path).add(died(10.0))
    assert path.is_file()
    assert History(path).after() == [record]


def test_of_a_long_file_only_the_end_is_read(path: Path) -> None:
    """Otherwise two million wrong lines take eight seconds, in which the sidecar does not answer."""
    record = History(path).add(died(10.0))
    events = path.read_bytes()
    path.write_bytes(b"{}\n" * 2_000_000 + events)
    used = time.process_time()
    assert History(path).after() == [record]
    assert time.process_time() - used < 2
    assert path.read_bytes() == events
    with path.open("r+b") as file:  # a hole, and a torn line
        file.seek(1 << 30)
        file.write(b"\n" + events)
    assert History(path).after() == [record]
    assert path.read_bytes() == events
