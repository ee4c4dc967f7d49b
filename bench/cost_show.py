# SPDX-License-Identifier: Apache-2.0
"""Tables and plots of bench/results/cost.json."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

Json = dict[str, Any]

COLOURS = {1: "#5aa469", 10: "#1f6fb4", 100: "#c8641b", 500: "#a02c50"}
FALLBACK = "#666666"


def _us(value: float) -> str:
    return f"{value:.0f}" if value < 9999.5 else f"{value / 1e3:.1f} ms"


def _base(cells: list[Json], cell: Json) -> Json | None:
    """The same without checkpoints."""
    return next(
        (
            each
            for each in cells
            if each["kind"] == "none" and (each["mb"], each["rate_mb_s"]) == (cell["mb"], cell["rate_mb_s"])
        ),
        None,
    )


def fault_us(cell: Json, base: Json | None) -> float | None:
    """What a copy-on-write fault adds to the writing of a page; None: too few to tell."""
    if base is None or cell["kind"] == "none" or cell["faults_per_page"] < 0.02:
        return None
    added: float = (cell["page_us"] - base["page_us"]) / (cell["faults_per_page"] - base["faults_per_page"])
    return added


def latency_table(cells: list[Json]) -> str:
    """Markdown; latencies in us."""
    lines = [
        "| MB | MB/s | checkpoints | median | p99 | p99.9 | longest | freeze, ms | taken | missed | faults/s "
        "| us/fault |",
        "|---:|---:|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for cell in cells:
        quantiles = cell["quantiles_us"]
        fault = fault_us(cell, _base(cells, cell))
        is_none = cell["kind"] == "none"
        words = [
            cell["mb"],
            cell["rate_mb_s"],
            "none" if is_none else f"{cell['kind']}, {cell['interval_s']:g} s",
            *(_us(quantiles[q]) for q in ("0.5", "0.99", "0.999")),
            _us(cell["worst_us"]),
            "-" if is_none else f"{cell['freeze_ms']:.1f}",
            "-" if is_none else cell["checkpoints"],
            "-" if is_none else cell["missed"],
            f"{cell['faults_per_s']:.0f}",
            "-" if fault is None else f"{fault:.1f}",
        ]
        lines.append("| " + " | ".join(map(str, words)) + " |")
    return "\n".join(lines) + "\n"


def memory_table(memory: list[Json]) -> str:
    """Markdown: MB held at most, by rate and generations."""
    keeps = sorted({entry["keep"] for entry in memory})
    lines = [
        "| MB/s | " + " | ".join(f"{keep} generation{'s' if keep > 1 else ''}" for keep in keeps) + " |",
        "|---:" * (len(keeps) + 1) + "|",
    ]
    for rate in sorted({entry["rate_mb_s"] for entry in memory}):
        held = {entry["keep"]: entry for entry in memory if entry["rate_mb_s"] == rate}
        words = [f"{held[keep]['pages_mb'] + held[keep]['tables_mb']:.0f}" if keep in held else "-" for keep in keeps]
        lines.append(f"| {rate} | " + " | ".join(words) + " |")
    return "\n".join(lines) + "\n"


def plot_latency(cells: list[Json], path: Path) -> None:
    """One panel per quantile, one colour per rate; dotted: no checkpoints; thin: plain forks."""
    cells = [cell for cell in cells if cell["mb"] == 256]
    panels = {"0.5": "median", "0.99": "p99", "0.999": "p99.9"}
    figure, axes = plt.subplots(1, len(panels), figsize=(12, 4.2), sharey=True, layout="constrained")
    for axis, (quantile, title) in zip(axes, panels.items()):
        for rate in sorted({cell["rate_mb_s"] for cell in cells}):
            colour = COLOURS.get(rate, FALLBACK)
            mine = [cell for cell in cells if cell["rate_mb_s"] == rate]
            for kind, style in (
                ("avckpt", {"marker": "o", "linewidth": 1.8}),
                ("fork", {"marker": "x", "linewidth": 0.7}),
            ):
                points = [
                    (cell["interval_s"], cell["quantiles_us"][quantile] / 1e3) for cell in mine if cell["kind"] == kind
                ]
                if points:
                    label = f"{rate} MB/s" if kind == "avckpt" else f"{rate} MB/s, plain fork"
                    axis.plot(*zip(*sorted(points)), color=colour, label=label, **style)
            for cell in mine:
                if cell["kind"] == "none":
                    axis.axhline(cell["quantiles_us"][quantile] / 1e3, color=colour, linestyle=":", linewidth=0.9)
        axis.set_xscale("log")
        axis.set_yscale("log")
        intervals = sorted({cell["interval_s"] for cell in cells if cell["interval_s"]})
        axis.set_xticks(intervals, [f"{interval:g}" for interval in intervals])
        axis.minorticks_off()
        axis.set_title(title)
        axis.set_xlabel("interval, s")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("latency, ms (dotted: no checkpoints)")
    axes[-1].legend(fontsize="x-small")
    _save(figure, path)


def plot_memory(memory: list[Json], path: Path) -> None:
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for rate in sorted({entry["rate_mb_s"] for entry in memory}):
        points = sorted(
            (entry["keep"], entry["pages_mb"] + entry["tables_mb"]) for entry in memory if entry["rate_mb_s"] == rate
        )
        axis.plot(*zip(*points), marker="o", color=COLOURS.get(rate, FALLBACK), label=f"{rate} MB/s")
    axis.set_xlabel("generations kept, interval 1 s")
    axis.set_ylabel("MB held by them at most")
    axis.set_title("memory of generations of a 256 MB process")
    axis.set_xticks(sorted({entry["keep"] for entry in memory}))
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small")
    _save(figure, path)


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path.with_suffix(".png"), dpi=110)
    plt.close(figure)


def show(results: Json, path: Path) -> None:
    """Prints the tables, and writes them and the plots beside the results."""
    parts = []
    if results["cells"]:
        parts.append(latency_table(results["cells"]))
        plot_latency(results["cells"], path.with_name("cost-latency"))
    if results["memory"]:
        parts.append(memory_table(results["memory"]))
        plot_memory(results["memory"], path.with_name("cost-memory"))
    text = "\n".join(parts)
    path.with_suffix(".md").write_text(text)
    print(text)
    print(f"written: {path}, {path.with_suffix('.md')}, cost-latency and cost-memory (.png) beside them")
