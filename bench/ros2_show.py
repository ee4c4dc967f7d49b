# SPDX-License-Identifier: Apache-2.0
"""Table and plots of bench/ros2.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Protocol

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot


class Trial(Protocol):
    """See bench/ros2.py."""

    subject: str
    remedy: str
    rate_hz: int
    interval_s: float | None
    age_s: float
    restore_ms: float
    freeze_ms: float
    out_ms: float | None
    in_ms: float | None
    steady_ms: float
    lost: int | None


def _both(values: Sequence[float | None]) -> str:
    """Median / largest."""
    there = [value for value in values if value is not None]
    lost = len(values) - len(there)
    text = f"{median(there):.0f} / {max(there):.0f}" if there else "-"
    return text + (f" ({lost} never)" if lost and there else "")


def table(trials: Sequence[Trial]) -> str:
    """Markdown; median / largest, ms."""
    lines = [
        "| middleware | remedy | Hz | interval s | n | freeze | restore | checkpoint's age | peer hears node again "
        "| node hears peer again | largest gap just before | lost |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    groups: dict[tuple[str, str, int, float | None], list[Trial]] = {}
    for trial in trials:
        groups.setdefault((trial.subject, trial.remedy, trial.rate_hz, trial.interval_s), []).append(trial)
    for (subject, remedy, rate, interval), group in groups.items():
        every = "auto" if interval is None else f"{interval:g}"
        cells = (
            *(subject, remedy, str(rate), every, str(len(group)), f"{group[0].freeze_ms:.1f}"),
            _both([t.restore_ms for t in group]),
            _both([1000 * t.age_s for t in group]),
            _both([t.out_ms for t in group]),
            "-" if subject == "ddsperf" else _both([t.in_ms for t in group]),
            "-" if subject == "ddsperf" else _both([t.steady_ms for t in group]),
            _both([t.lost for t in group]),
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(trials: Sequence[Trial], stem: Path) -> None:
    """STEM.png: the outage against the checkpoint's age."""
    figure, panels = pyplot.subplots(1, 2, figsize=(11, 4.6), sharex=True, sharey=True)
    plain = [t for t in trials if t.remedy in ("none", "best-effort")]
    mended = [t for t in trials if t.remedy not in ("none", "best-effort")]
    for panel, title, shown in zip(panels, ("nothing done", "something done"), (plain, mended)):
        kinds = sorted({(t.subject, t.remedy, t.rate_hz) for t in shown})
        for number, kind in enumerate(kinds):
            points = [(t.age_s, t.out_ms) for t in shown if (t.subject, t.remedy, t.rate_hz) == kind and t.out_ms]
            name = kind[0] + (f", {kind[1]}" if kind[1] != "none" else "")
            marker = "o^svDPX*<>"[number % 10]
            panel.scatter(*zip(*points), s=14, marker=marker, alpha=0.7, label=f"{name}, {kind[2]} Hz")
        panel.plot([0.001, 4], [1, 4000], color="grey", linewidth=0.8, linestyle="--", label="outage = age")
        panel.set_title(title)
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_xlabel("age of the restored checkpoint, s")
        panel.legend(fontsize=7, loc="upper left")
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("the peer hears nothing for, ms")
    figure.tight_layout()
    figure.savefig(stem.with_suffix(".png"), dpi=120)
    pyplot.close(figure)
