# SPDX-License-Identifier: Apache-2.0
"""What Prometheus reads."""

from __future__ import annotations

import re

import pytest
from avckpt.containers.protected import Protected, State
from avckpt.errors import DeadlineMissed
from avckpt.events.metrics import Metrics
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import GAVE_UP_WORDS, Kind, Reason
from avckpt.policy import settings_of
from prometheus_client.parser import text_string_to_metric_families

from testkit.harness import ROOT

EXAMPLES = ROOT / "examples" / "prometheus"


def samples(text: bytes) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    found = {}
    for family in text_string_to_metric_families(text.decode()):
        for sample in family.samples:
            found[sample.name, frozenset(sample.labels.items())] = sample.value
    return found


def value(text: bytes, name: str, **labels: str) -> float | None:
    return samples(text).get((name, frozenset(labels.items())))


def test_events_are_counted_by_container_reason_and_outcome() -> None:
    metrics = Metrics("1.0", "1.0")
    for _ in range(3):
        metrics.take(EventRecord(Kind.CHECKPOINT, container="web", freeze_s=0.0015))
    metrics.take(EventRecord(Kind.MISSED, container="web", freeze_s=0.05, error=DeadlineMissed("slow")))
    metrics.take(
        EventRecord(
            Kind.RESTORED,
            container="web",
            reason=Reason.SIGNAL,
            outcome=Reason.RESTORED,
            restore_s=0.004,
            freeze_s=0.002,
            lost_s=1.5,
        )
    )
    metrics.take(EventRecord(Kind.GAVE_UP, container="db", reason=Reason.EXIT, outcome=Reason.LIMIT))
    metrics.take(EventRecord(Kind.NOTIFY_FAILED, container="db"))
    metrics.take(EventRecord(Kind.DIED, container="db", reason=Reason.EXIT))
    text = metrics.render([])
    assert value(text, "avckpt_checkpoints_total", container="web") == 3
    assert value(text, "avckpt_checkpoints_missed_total", container="web", reason="deadline") == 1
    assert value(text, "avckpt_freeze_seconds_count", container="web") == 3
    assert value(text, "avckpt_freeze_seconds_bucket", container="web", le="0.001") == 0
    assert value(text, "avckpt_freeze_seconds_bucket", container="web", le="0.002") == 3
    assert value(text, "avckpt_restore_seconds_sum", container="web") == 0.004
    assert value(text, "avckpt_restores_total", container="web", reason="signal", outcome="restored") == 1
    assert value(text, "avckpt_lost_seconds_sum", container="web") == 1.5
    assert value(text, "avckpt_last_lost_seconds", container="web") == 1.5
    assert value(text, "avckpt_last_lost_seconds", container="db") is None
    assert value(text, "avckpt_restores_total", container="db", reason="exit", outcome="limit") == 1
    assert value(text, "avckpt_restore_seconds_count", container="db") is None
    assert value(text, "avckpt_notifications_total", container="db", outcome="failed") == 1


def test_what_alerts_ask_for_is_zero_from_the_start() -> None:
    metrics = Metrics("1.0", "1.1")
    metrics.begin("web")
    text = metrics.render([])
    assert value(text, "avckpt_build_info", version="1.0", native_version="1.1") == 1
    assert value(text, "avckpt_checkpoints_total", container="web") == 0
    assert value(text, "avckpt_restores_total", container="web", reason="signal", outcome="restored") == 0
    assert value(text, "avckpt_restores_total", container="web", reason="exit", outcome="failed") == 0
    for histogram in ("freeze", "restore", "lost"):
        assert value(text, f"avckpt_{histogram}_seconds_count", container="web") == 0
    metrics.forget_all_but([])
    assert b'"web"' not in metrics.render([])


def test_the_examples_and_the_series_know_every_death_that_should_have_been_undone() -> None:
    """A crash loop is one (loop), and so is a restore that was abandoned (late)."""
    failures = {reason.value for reason in GAVE_UP_WORDS} - {"clean_exit", "stopped", "policy"}
    for name in ("alerts.yaml", "grafana.json"):
        text = (EXAMPLES / name).read_text().replace('\\"', '"')
        (asked,) = re.findall(r'outcome=~"([a-z_|]+)"', text)
        assert set(asked.split("|")) == failures, name
    metrics = Metrics("1.0", "1.1")
    metrics.begin("web")
    text_of_metrics = metrics.render([])
    for outcome in failures:
        assert value(text_of_metrics, "avckpt_restores_total", container="web", reason="signal", outcome=outcome) == 0


def container(name: str, state: State, generations: int) -> Protected:
    made = Protected(name[0] * 64, name, 1, 1, settings_of({}).config, 0.0, state=state)
    made.generations, made.memory_bytes = generations, 1000
    return made


def test_gauges_are_of_live_containers_only() -> None:
    metrics = Metrics("1.0", "1.0")
    web, db = container("web", State.PROTECTED, 2), container("db", State.UNPROTECTED, 0)
    text = metrics.render([web, db], [web, db])
    assert value(text, "avckpt_generations", container="web") == 2
    assert value(text, "avckpt_protected", container="web") == 1
    assert value(text, "avckpt_generations_memory_bytes", container="web") == 1000
    assert value(text, "avckpt_generations_memory_bytes", container="db") == 0
    assert value(text, "avckpt_protected", container="db") == 0
    assert value(text, "avckpt_last_checkpoint_timestamp_seconds", container="web") is None
    web.last_checkpoint_at = 1700000000.5
    assert value(metrics.render([web]), "avckpt_last_checkpoint_timestamp_seconds", container="web") == 1700000000.5
    web.state = State.RESTORING
    text = metrics.render([web])
    assert value(text, "avckpt_protected", container="web") == 0
    assert value(text, "avckpt_protected", container="db") is None


@pytest.mark.parametrize("state", [State.LISTENING, State.NODES])
def test_who_has_no_guard_by_design_has_no_gauges(state: State) -> None:
    """Of a launcher, avckpt_protected would be 0 for ever, and alert."""
    text = Metrics("1.0", "1.0").render([container("ear", state, 0)])
    assert b'"ear"' not in text


def test_a_forgotten_container_leaves_no_series() -> None:
    metrics = Metrics("1.0", "1.0")
    for name in ("old", "new"):
        metrics.take(EventRecord(Kind.CHECKPOINT, container=name, freeze_s=0.001))
        metrics.take(EventRecord(Kind.NOTIFIED, container=name))
    metrics.forget_all_but(["new"])
    text = metrics.render([])
    assert b'"old"' not in text
    assert value(text, "avckpt_checkpoints_total", container="new") == 1
    metrics.take(EventRecord(Kind.CHECKPOINT, container="old", freeze_s=0.001))
    assert value(metrics.render([]), "avckpt_checkpoints_total", container="old") == 1
