# SPDX-License-Identifier: Apache-2.0
"""Prometheus metrics: counters updated by events, gauges read when scraped."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any, TypeVar

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4, generate_latest

from avckpt.containers.protected import Protected, State
from avckpt.events.record import EventRecord
from avckpt.events.vocabulary import FAILURES, Kind, Reason

Metric = TypeVar("Metric", Counter, Gauge, Histogram)

CONTENT_TYPE = CONTENT_TYPE_PLAIN_0_0_4
FREEZE_BUCKETS_S = (0.0005, 0.001, 0.002, 0.003, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25)
RESTORE_BUCKETS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.25, 0.5, 1.0)
LOST_BUCKETS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)
DETECT_BUCKETS_S = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.05, 0.1, 0.5, 1.0, 5.0)
UNWANTED = (Reason.SIGNAL, Reason.EXIT, Reason.UNHEALTHY)
"""Causes of restores whose series exist from the start: a rate never shows the first sample of a new
series."""


class Metrics:
    """All metrics of a sidecar, by container."""

    def __init__(self, version: str, native_version: str) -> None:
        self._registry = CollectorRegistry()
        build = Gauge("avckpt_build_info", "1; who serves this", ["version", "native_version"], registry=self._registry)
        build.labels(version, native_version).set(1)
        self._freeze = Histogram(
            "avckpt_freeze_seconds",
            "How long checkpoints held the application; of several within a second, the longest",
            ["container"],
            buckets=FREEZE_BUCKETS_S,
            registry=self._registry,
        )
        self._restore = Histogram(
            "avckpt_restore_seconds",
            "Death of the application to its last thread running again",
            ["container"],
            buckets=RESTORE_BUCKETS_S,
            registry=self._registry,
        )
        self._lost = Histogram(
            "avckpt_lost_seconds",
            "What the application lost by a restore: age of what it went back to, and the restore itself",
            ["container"],
            buckets=LOST_BUCKETS_S,
            registry=self._registry,
        )
        self._taken = self._counter("avckpt_checkpoints_total", "Checkpoints taken")
        self._missed = self._counter("avckpt_checkpoints_missed_total", "Checkpoints not taken, by error", "reason")
        self._restores = self._counter(
            "avckpt_restores_total",
            "Deaths and roll backs, by cause and by what followed (restored, or why not)",
            "reason",
            "outcome",
        )
        self._notifications = self._counter(
            "avckpt_notifications_total", "Notifications for a container, by outcome", "outcome"
        )
        self._generations = self._gauge("avckpt_generations", "Generations held")
        self._memory = self._gauge(
            "avckpt_generations_memory_bytes",
            "Memory that a container's generations hold and its application does not use",
        )
        self._protected = self._gauge("avckpt_protected", "1 while at least one generation is held, else 0")
        self._checkpoint_at = self._gauge(
            "avckpt_last_checkpoint_timestamp_seconds", "When the newest checkpoint was taken, since 1970"
        )
        self._detect = Histogram(
            "avckpt_detect_seconds",
            "Fatal signal to avckpt-init knowing of the death",
            ["container"],
            buckets=DETECT_BUCKETS_S,
            registry=self._registry,
        )
        self._late = self._counter("avckpt_late_total", "Recoveries that took longer than avckpt.deadline")
        self._longest = {
            metric: self._gauge(f"avckpt_{name}_max_seconds", f"The longest of avckpt_{name}_seconds")
            for metric, name in (
                (self._freeze, "freeze"),
                (self._restore, "restore"),
                (self._lost, "lost"),
                (self._detect, "detect"),
            )
        }
        self._maxima: dict[tuple[Histogram, str], float] = {}
        self._last_lost = self._gauge("avckpt_last_lost_seconds", "What the application lost by its last restore")
        self._series: dict[str, dict[tuple[Counter | Gauge | Histogram, tuple[str, ...]], Any]] = {}

    def begin(self, container: str) -> None:
        """Creates the series of a container that is to be protected, at zero."""
        self._of(self._taken, container)
        self._of(self._late, container)
        for histogram in self._longest:
            self._of(histogram, container)
        for cause in UNWANTED:
            for outcome in (Reason.RESTORED, *FAILURES):
                self._of(self._restores, container, cause.value, outcome.value)

    def take(self, record: EventRecord) -> None:
        """Counts an event."""
        container = record.container
        if record.kind is Kind.CHECKPOINT:
            self._of(self._taken, container).inc(record.checkpoints or 1)
            self._observe(self._freeze, container, record.freeze_max_s or record.freeze_s or 0.0)
        elif record.kind is Kind.MISSED:
            self._of(self._missed, container, record.error.kind if record.error else "failed").inc()
        elif record.kind in (Kind.RESTORED, Kind.GAVE_UP):
            cause = record.reason.value if record.reason else ""
            self._of(self._restores, container, cause, record.outcome.value if record.outcome else "").inc()
            if record.restore_s is not None:
                self._observe(self._restore, container, record.restore_s)
            if record.lost_s is not None:
                self._observe(self._lost, container, record.lost_s)
                self._of(self._last_lost, container).set(record.lost_s)
        elif record.kind is Kind.CRASH and record.detected_s is not None:
            self._observe(self._detect, container, record.detected_s)
        elif record.kind is Kind.LATE:
            self._of(self._late, container).inc()
        elif record.kind in (Kind.NOTIFIED, Kind.NOTIFY_FAILED):
            outcome = "delivered" if record.kind is Kind.NOTIFIED else "failed"
            self._of(self._notifications, container, outcome).inc()

    def forget_all_but(self, containers: Iterable[str]) -> None:
        """Drops the series of forgotten containers; otherwise a year of new names would fill memory."""
        for gone in set(self._series) - set(containers):
            for metric, labels in self._series.pop(gone):
                metric.remove(*labels)
            for histogram in self._longest:
                self._maxima.pop((histogram, gone), None)

    def render(self, live: Iterable[Protected], measured: Collection[Protected] = ()) -> bytes:
        """The text for Prometheus; only those that were `measured` have their `memory_bytes` in it."""
        for gauge in (self._generations, self._memory, self._protected, self._checkpoint_at):
            gauge.clear()
        for container in live:
            if not container.state.guarded:
                continue  # it has asked for no protection, or only its nodes are protected
            self._generations.labels(container.label).set(container.generations)
            if container in measured:
                self._memory.labels(container.label).set(container.memory_bytes if container.generations else 0)
            self._protected.labels(container.label).set(container.state is State.PROTECTED)
            if container.last_checkpoint_at is not None:
                self._checkpoint_at.labels(container.label).set(container.last_checkpoint_at)
        return generate_latest(self._registry)

    def _observe(self, histogram: Histogram, container: str, seconds: float) -> None:
        self._of(histogram, container).observe(seconds)
        if seconds > self._maxima.get((histogram, container), -1.0):
            self._maxima[histogram, container] = seconds
            self._of(self._longest[histogram], container).set(seconds)

    def _counter(self, name: str, text: str, *labels: str) -> Counter:
        return Counter(name, text, ["container", *labels], registry=self._registry)

    def _gauge(self, name: str, text: str) -> Gauge:
        return Gauge(name, text, ["container"], registry=self._registry)

    def _of(self, metric: Metric, *labels: str) -> Metric:
        of_container = self._series.setdefault(labels[0], {})
        series: Metric | None = of_container.get((metric, labels))
        if series is None:
            series = of_container[metric, labels] = metric.labels(*labels)
        return series
