# SPDX-License-Identifier: Apache-2.0
"""Events of a real daemon: the stream, the history over its restarts, the API's description, metrics."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from avckpt.cli.client import Client
from avckpt.events.history import History
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import Kind
from jsonschema import Draft202012Validator
from prometheus_client.parser import text_string_to_metric_families

from testkit.harness import avckpt_command, take_checkpoint, wait_until
from testkit.local_sidecar import ON_COMMAND, QUICK, Container, LocalSidecar, ended

SLEEPER = ["sleep", "1000"]
Stream = Generator[dict[str, Any], None, None]
pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root")
SHARED = pytest.mark.shared_machine(
    "init waits two seconds for its guard, which may get no CPU for as long; events are given a time to come"
)


class Connection(http.client.HTTPConnection):
    """Plain HTTP on the sidecar's socket, without our own client."""

    def __init__(self, local: LocalSidecar, timeout_s: float = 10.0) -> None:
        super().__init__("localhost", timeout=timeout_s)
        self._path = local.run_dir / "api.sock"

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(str(self._path))


def get(local: LocalSidecar, target: str, method: str = "GET") -> tuple[int, str, bytes]:
    """Status, content type and body."""
    with contextlib.closing(Connection(local)) as connection:
        connection.request(method, target)
        answer = connection.getresponse()
        return answer.status, answer.headers["Content-Type"], answer.read()


def stream(local: LocalSidecar, query: str = "", headers: dict[str, str] | None = None) -> Stream:
    """Server-sent events from now on, each {"id": ..., "data": ...}, until the other end closes."""
    connection = Connection(local)
    connection.request("GET", f"/v1/events{query}", headers=headers or {})
    answer = connection.getresponse()
    assert answer.status == 200
    assert answer.headers["Content-Type"] == "text/event-stream"
    return read_stream(connection, answer)


def read_stream(connection: Connection, answer: http.client.HTTPResponse) -> Stream:
    with contextlib.closing(connection):
        fields: dict[str, Any] = {}
        for line in answer:
            name, _, value = line.decode().rstrip("\n").partition(": ")
            if name == "data":
                fields["data"] = json.loads(value)
            elif name == "id":
                fields["id"] = int(value)
            elif not name and fields:
                yield fields
                fields = {}


def crash(local: LocalSidecar, container: Container, restores: int = 1) -> None:
    told = crashes_told(local)
    os.kill(container.app_pid, signal.SIGKILL)
    local.wait_for(container, restores=restores, state="protected")
    wait_until(lambda: crashes_told(local) > told, 10, "what it died of is told", every_s=0.05)


def crashes_told(local: LocalSidecar) -> int:
    return [event["kind"] for event in Client(local.run_dir).history()].count("crash")


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("/v1/containers?al=1", "there is no parameter al; it takes all, memory"),
        ("/v1/info?all=1", "there is no parameter all; it takes none"),
        ("/v1/containers?all=2", "all is 2, neither true nor false"),
        ("/metrics?name=web", "there is no parameter name; it takes none"),
    ],
)
def test_a_parameter_that_does_nothing_is_refused(target: str, said: str, local: LocalSidecar) -> None:
    status, _, body = get(local, target)
    assert status == 400
    assert said in json.loads(body)["error"]["message"]


@SHARED
def test_the_stream_tells_a_crash_as_it_happens_and_ends_with_the_sidecar(local: LocalSidecar) -> None:
    events = stream(local, "?all=1")
    web = local.protected("web", SLEEPER, {**QUICK, "avckpt.group": "chain"})
    told = [next(events)["data"] for _ in range(3)]
    assert [event["kind"] for event in told] == ["registered", "attached", "checkpoint"]
    os.kill(web.app_pid, signal.SIGKILL)
    while told[-1]["kind"] != "restored":
        told.append(next(events)["data"])
    restored = told[-1]
    assert (restored["container"], restored["id"], restored["group"]) == ("web", web.id, "chain")
    assert (restored["reason"], restored["outcome"]) == ("signal", "restored")
    assert restored["wait_status"] == signal.SIGKILL
    assert restored["lost_s"] == pytest.approx(restored["age_s"] + restored["restore_s"])
    assert 0 < restored["freeze_s"] < 5
    assert 0 < restored["restore_s"] < 5
    assert restored["attempt"] == 1
    assert abs(restored["at"] - time.time()) < 10
    assert abs(restored["monotonic_s"] - time.monotonic()) < 10
    taken = {event["generation"]: event["freeze_s"] for event in told if event["kind"] == "checkpoint"}
    assert restored["freeze_s"] == taken[restored["generation"]]
    assert local.stop() == 0
    list(events)  # it ends
    assert not ended(web)


@SHARED
def test_routine_is_told_only_to_those_who_asked_and_has_no_id(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    everything, kept = stream(local, "?all=1"), stream(local)
    first = [next(kept), next(kept)]
    assert [event["data"]["kind"] for event in first] == ["registered", "checkpoint"]
    assert [event["id"] for event in first] == [event["data"]["seq"] for event in first]
    for _ in range(2):
        next(everything)
    routine = next(everything)
    assert routine["data"]["kind"] == "checkpoint"
    assert routine["data"]["seq"] == 0
    assert "id" not in routine
    os.kill(web.app_pid, signal.SIGKILL)
    assert next(kept)["data"]["kind"] == "died"


@SHARED
def test_who_comes_back_with_the_last_id_misses_nothing_and_hears_nothing_twice(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    events = stream(local)
    last = [next(events) for _ in range(2)][-1]["id"]
    events.close()
    crash(local, web)
    local.stop(signal.SIGKILL)
    local.start()
    local.wait_for(web, state="protected")
    again = stream(local, headers={"Last-Event-ID": str(last)})
    told = [next(again) for _ in range(6)]
    # Whether the sidecar tells of itself before the first checkpoint or after it depends on the interval.
    assert [event["data"]["kind"] for event in told[:4]] == ["died", "restored", "crash", "registered"]
    assert {event["data"]["kind"] for event in told[4:]} == {"sidecar_started", "checkpoint"}
    assert [event["id"] for event in told] == list(range(last + 1, last + 7))
    assert told[3]["data"]["detail"].startswith("adopted")
    by_query = stream(local, f"?after={told[3]['id']}")
    assert next(by_query)["id"] == told[4]["id"]


@SHARED
@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_the_history_outlives_the_sidecar(local: LocalSidecar, how: signal.Signals) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    crash(local, web)
    before = Client(local.run_dir).history()
    assert [event["kind"] for event in before] == ["registered", "checkpoint", "died", "restored", "crash"]
    local.stop(how)
    local.start()
    assert Client(local.run_dir).history()[:5] == before
    local.wait_for(web, state="protected", adopted=True)
    crash(local, web)
    kinds = [event["kind"] for event in Client(local.run_dir).history() if event["container"]]
    assert kinds[5:] == ["registered", "checkpoint", "died", "restored", "crash"]


@SHARED
def test_a_follower_that_does_not_read_holds_nobody_up(local: LocalSidecar) -> None:
    local.stop()
    # More than a socket holds: the sidecar is stuck with the first it sends.
    history = History(local.run_dir / "history.jsonl")
    for _ in range(1000):
        history.add(EventRecord(Kind.ENDED, detail="x" * 1000))
    local.start()
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    with contextlib.closing(Connection(local)) as stuck:
        stuck.request("GET", "/v1/events?all=1")
        for restores in range(1, 4):
            crash(local, web, restores)
        assert Client(local.run_dir).history()[-1]["kind"] == "crash"
        started = time.monotonic()
        assert local.stop() == 0
        assert time.monotonic() - started < 8


@SHARED
def test_a_roll_back_is_manual_and_a_refused_command_is_told(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER, ON_COMMAND)
    local.wait_for(web, app_pid_inside=2)
    take_checkpoint(local.client, "web")
    answer = json.loads(local.avckpt("restore", "web", "--json").stdout)
    assert answer["event"]["reason"] == "manual"
    died, restored = [e for e in Client(local.run_dir).history() if e["kind"] in ("died", "restored")]
    assert (died["reason"], restored["reason"]) == ("manual", "manual")
    assert "SIGKILL" not in died["message"] + restored["message"]
    assert restored == answer["event"]
    crash(local, web, 2)
    assert Client(local.run_dir).history()[-1]["reason"] == "signal"


@SHARED
def test_roll_backs_on_command_are_no_crashes(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER, ON_COMMAND)
    local.wait_for(web, app_pid_inside=2)
    take_checkpoint(local.client, "web")
    for _ in range(2):
        assert json.loads(local.avckpt("restore", "web", "--json").stdout)["event"]["attempt"] == 0
    crash(local, web, 3)
    restored = json.loads(local.avckpt("restore", "web", "--json").stdout)["event"]
    assert (restored["attempt"], restored["restores"]) == (1, 4)
    (row,) = local.client.containers()
    assert "keeps crashing" not in row["reason"]


@SHARED
def test_the_end_of_a_container_is_told(local: LocalSidecar) -> None:
    web = local.protected("web", ["sh", "-c", "exec sleep 1000"])
    local.wait_for(web, state="protected")
    signal.pidfd_send_signal(web.pidfd, signal.SIGTERM)
    web.status()
    local.wait_for(web, state="ended")
    told = Client(local.run_dir).history()[-3:]
    assert [event["kind"] for event in told] == ["died", "gave_up", "ended"]
    assert told[1]["outcome"] == "stopped"
    assert "asked to stop" in told[2]["detail"]


# The command line


@SHARED
def test_the_command_events(local: LocalSidecar) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    crash(local, web)
    lines = local.avckpt("events").stdout.splitlines()
    assert len(lines) == 5
    assert "  web: killed by SIGKILL, restored in " in lines[-2]
    as_json = [json.loads(line) for line in local.avckpt("events", "--json").stdout.splitlines()]
    assert as_json == Client(local.run_dir).history()
    time.sleep(1.1)
    assert local.avckpt("events", "--since", "1s").stdout == ""
    assert len(local.avckpt("events", "--since", "10m").stdout.splitlines()) == 5
    assert local.avckpt("events", "web", "--kind", "restored").stdout.splitlines() == [
        line for line in lines if "restored in" in line
    ]


@SHARED
def test_following_goes_on_over_a_restart_of_the_sidecar(local: LocalSidecar, tmp_path: Path) -> None:
    web = local.protected("web", SLEEPER)
    local.wait_for(web, state="protected")
    out, err = tmp_path / "out", tmp_path / "err"
    with out.open("wb") as stdout, err.open("wb") as stderr:
        follower = subprocess.Popen(
            [*avckpt_command(), "events", "--follow", "--json"],
            env={**os.environ, **local.env},
            stdout=stdout,
            stderr=stderr,
        )
    try:

        def seen() -> list[str]:
            return [json.loads(line)["kind"] for line in out.read_text().splitlines()]

        wait_until(lambda: len(seen()) == 2, 10, "what is kept is told")
        crash(local, web)
        wait_until(lambda: len(seen()) == 5, 5, "the crash is told at once")
        local.stop(signal.SIGKILL)
        local.start()
        local.wait_for(web, state="protected")
        crash(local, web)
        wait_until(lambda: len(seen()) == 11, 10, "what happened meanwhile is told")
        follower.send_signal(signal.SIGINT)
        assert follower.wait(10) == 0
    finally:
        follower.kill()
        follower.wait()
    numbers = [json.loads(line)["seq"] for line in out.read_text().splitlines()]
    assert numbers == list(range(numbers[0], numbers[0] + 11))
    assert err.read_text().count("waiting for the next one") == 1


# The API


@SHARED
def test_what_the_sidecar_answers_is_what_its_description_says(local: LocalSidecar) -> None:
    status, content_type, body = get(local, "/v1/openapi.json")
    assert (status, content_type) == (200, "application/json; charset=utf-8")
    document = json.loads(body)
    web = local.protected("web", SLEEPER, {**QUICK, "avckpt.group": "chain"})
    tree = local.protected("tree", ["sh", "-c", "exec 9<>/dev/null; sleep 1000; true"])
    local.wait_for(web, state="protected")
    crash(local, web)
    gone = local.protected("gone", SLEEPER)
    local.wait_for(gone, state="protected")
    signal.pidfd_send_signal(gone.pidfd, signal.SIGKILL)
    local.wait_for(gone, state="ended")
    local.wait_for(tree)

    def check(method: str, target: str, path: str, status: int = 200) -> Any:
        found, _, answer = get(local, target, method)
        assert found == status, answer
        responses = document["paths"][path][method.lower()]["responses"]
        if status == 200:
            schema = responses["200"]["content"]["application/json"]["schema"]
        else:
            schema = document["components"]["responses"]["Error"]["content"]["application/json"]["schema"]
        validator = Draft202012Validator({**schema, "components": document["components"]})
        data = json.loads(answer)
        assert [error.message for error in validator.iter_errors(data)] == []
        return data

    check("GET", "/v1/info", "/v1/info")
    assert len(check("GET", "/v1/containers?all=1", "/v1/containers")["containers"]) == 3
    kinds = {event["kind"] for event in check("GET", "/v1/history", "/v1/history")["events"]}
    assert {"registered", "checkpoint", "died", "restored", "ended"} <= kinds
    check("POST", "/v1/reload", "/v1/reload")
    assert check("GET", "/v1/containers/web", "/v1/containers/{name}")["crashes"]
    wait_until(lambda: get(local, "/v1/containers/web/checkpoint", "POST")[0] == 200, 10, "a checkpoint")
    check("POST", "/v1/containers/web/restore", "/v1/containers/{name}/restore")
    for target, status, kind in (
        ("/v1/containers/nobody/restore", 404, "no_such_container"),
        ("/v1/containers/c/checkpoint", 409, "ambiguous"),
    ):
        error = check("POST", target, "/v1/containers/{name}/restore", status)["error"]
        assert error["kind"] == kind
    Draft202012Validator({**document["components"]["schemas"]["Event"], "components": document["components"]}).validate(
        next(stream(local))["data"]
    )


@pytest.mark.parametrize(
    ("method", "target", "status", "kind"),
    [
        ("GET", "/v1/nothing", 404, "not_found"),
        ("POST", "/v1/containers/x/explode", 404, "not_found"),
        ("GET", "/v1/containers/x/restore", 405, "method_not_allowed"),
        ("GET", "/v1/events?after=x", 400, "bad_request"),
        ("GET", "/v1/containers/nobody", 404, "no_such_container"),
        ("POST", "/v1/containers/x/restore?generation=-1", 400, "bad_request"),
        ("POST", "/v1/containers/x/checkpoint?generation=1", 400, "bad_request"),
        ("GET", "/v1/history?after=-1", 400, "bad_request"),
        ("GET", "/v1/history?since=noon", 400, "bad_request"),
        ("GET", "/v1/history?since=nan", 400, "bad_request"),
    ],
)
def test_wrong_requests_are_json_errors(local: LocalSidecar, method: str, target: str, status: int, kind: str) -> None:
    found, content_type, body = get(local, target, method)
    assert found == status
    assert content_type.startswith("application/json")
    assert json.loads(body)["error"]["kind"] == kind


def scrape(local: LocalSidecar) -> dict[str, float]:
    """Every sample of /metrics, by name and labels."""
    status, content_type, body = get(local, "/metrics")
    assert status == 200
    assert content_type.startswith("text/plain")
    found = {}
    for family in text_string_to_metric_families(body.decode()):
        for sample in family.samples:
            found[f"{sample.name}{sorted(sample.labels.values())}"] = sample.value
    return found


@SHARED
def test_metrics_of_a_crash(local: LocalSidecar) -> None:
    program = "import time\nx = bytearray(20_000_000)\nwhile 1:\n  x[::4096] = bytes(len(x[::4096])); time.sleep(.05)"
    web = local.protected("web", [sys.executable, "-c", program])
    local.wait_for(web, state="protected")
    crash(local, web)
    local.wait_for(web, generations=2)

    row = local.row(web)
    metrics = scrape(local)
    assert metrics["avckpt_checkpoints_total['web']"] >= row["checkpoints"] >= 2
    assert metrics["avckpt_freeze_seconds_count['web']"] - metrics["avckpt_checkpoints_total['web']"] in (-1, 0)
    assert metrics["avckpt_restores_total['restored', 'signal', 'web']"] == 1
    assert metrics["avckpt_restore_seconds_sum['web']"] == pytest.approx(row["last_restore_s"])
    assert metrics["avckpt_protected['web']"] == 1
    # The application writes to all of its 20 MB between two generations.
    wait_until(lambda: scrape(local)["avckpt_generations_memory_bytes['web']"] > 15e6, 5, "memory of the templates")
    signal.pidfd_send_signal(web.pidfd, signal.SIGKILL)
    local.wait_for(web, state="ended")
    assert "avckpt_protected['web']" not in scrape(local)


@SHARED
def test_memory_that_several_generations_hold_together_counts_once(local: LocalSidecar, tmp_path: Path) -> None:
    """Pages shared by templates are no process's private memory, and must be counted nevertheless."""
    again = tmp_path / "again"
    program = (
        "import os, time\nx = bytearray(30_000_000)\nx[::4096] = b'1' * len(x[::4096])\n"
        f"print('ready', flush=True)\nwhile not os.path.exists({str(again)!r}): time.sleep(.02)\n"
        "x[::4096] = b'2' * len(x[::4096])\nprint('written', flush=True)\ntime.sleep(1000)"
    )
    web = local.protected("web", [sys.executable, "-c", program], ON_COMMAND)
    wait_until(lambda: "ready" in web.output.read_text(), 20, "it has its memory")
    for number in (1, 2):
        take_checkpoint(local.client, "web")
        local.wait_for(web, generations=number)
    again.touch()
    wait_until(lambda: "written" in web.output.read_text(), 20, "it has written to all of it")
    assert 29e6 < scrape(local)["avckpt_generations_memory_bytes['web']"] < 36e6
    assert 29e6 < local.row(web)["memory_bytes"] < 36e6


@SHARED
def test_an_application_can_not_write_lines_of_its_own(local: LocalSidecar, tmp_path: Path) -> None:
    """File names that the application chooses appear in messages, in the log and on terminals."""
    name = "x\n2026-01-01 ERROR web: all is lost\x1b[2K"
    path = tmp_path / name
    program = (
        "import os, signal, sys\n"
        f"fd = os.open({str(path)!r}, os.O_RDONLY | os.O_CREAT)\n"
        f"signal.signal(signal.SIGUSR1, lambda *_: (os.close(fd), os.unlink({str(path)!r})))\n"
        "while True: signal.pause()\n"
    )
    web = local.protected("web", [sys.executable, "-c", program], {**ON_COMMAND, "avckpt.files": "rewind"})
    wait_until(path.exists, 5, "the file is open")
    take_checkpoint(local.client, "web")
    os.kill(web.app_pid, signal.SIGUSR1)
    wait_until(lambda: not path.exists(), 5, "it is closed and gone")
    crash(local, web)
    (restored,) = [event for event in Client(local.run_dir).history() if event["kind"] == "restored"]
    assert r"x\n2026-01-01 ERROR web: all is lost\x1b[2K" in restored["message"]
    assert "\x1b" not in local.log + local.avckpt("events").stdout + local.avckpt("ps").stdout
    assert "2026-01-01" not in [line[:10] for line in local.log.splitlines()]
