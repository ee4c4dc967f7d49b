# SPDX-License-Identifier: Apache-2.0
"""Tables and plots of bench/results/peers.json."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

Json = dict[str, Any]

COLOURS = {
    "fork": "#999999",
    "avckpt engine": "#7fb3e6",
    "avckpt": "#1f6fb4",
    "CRIU": "#e6a15c",
    "CRIU, Podman, crun": "#c8641b",
    "CRIU, Podman, runc": "#8f4410",
    "restart policy": "#5aa469",
    "podman start": "#2f6b3f",
}


def median(values: list[float]) -> float | None:
    return statistics.median(values) if values else None


def _ms(values: list[float]) -> str:
    middle = median(values)
    if middle is None:
        return "-"
    return f"{middle:.2f}" if middle < 10 else f"{middle:.0f}"


def _of(row: Json, key: str) -> str:
    return "-" if row[key] is None else f"{row[key]}/{row['cycles']}"


def compact(results: Json, key: str) -> str:
    """Markdown: medians of one figure, a row per workload, a column per subject."""
    rows = [row for row in results["rows"] if row[key]]
    subjects = [name for name in COLOURS if any(row["subject"] == name for row in rows)]
    lines = ["| MB | threads | " + " | ".join(subjects) + " |", "|---:" * (len(subjects) + 2) + "|"]
    for mb, threads in sorted({(row["mb"], row["threads"]) for row in rows}):
        mine = {row["subject"]: row[key] for row in rows if (row["mb"], row["threads"]) == (mb, threads)}
        cells = [_ms(mine.get(name, [])) for name in subjects]
        lines.append(f"| {mb} | {threads} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def table(results: Json) -> str:
    """Markdown.  Medians in ms; what survived as so many of so many."""
    lines = [
        "| MB | threads | subject | freeze | outage | outage, longest | memory, MB | PID | memory kept | TCP | run |",
        "|---:|---:|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in results["rows"]:
        worst = f"{max(row['outage_ms']):.0f}" if row["outage_ms"] and row["subject"] != "fork" else "-"
        memory = median(row["memory_mb"])
        cells = [
            row["mb"],
            row["threads"],
            row["subject"],
            _ms(row["freeze_ms"]),
            _ms(row["outage_ms"]),
            worst,
            "-" if memory is None else f"{memory:.2f}" if memory < 10 else f"{memory:.0f}",
        ]
        if row["subject"] == "fork":
            cells += ["-"] * 4
        else:
            cells += [_of(row, key) for key in ("same_pid", "same_memory", "same_connection", "same_run")]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines) + "\n"


def stops(results: Json) -> str:
    """CRIU's own way: ended by the dump and restored, without a crash."""
    lines = [
        "| MB | threads | subject | from the dump's beginning to the next answer | TCP kept |",
        "|---:|---:|---|---:|---:|",
    ]
    for row in results["rows"]:
        if row["stops"]:
            kept = f"{row['stop_same_connection']}/{row['stops']}"
            lines.append(
                f"| {row['mb']} | {row['threads']} | {row['subject']} | {_ms(row['stop_outage_ms'])} | {kept} |"
            )
    return "\n".join(lines) + "\n"


def failures(results: Json) -> str:
    """What could not be done, in the peer's own words."""
    return "".join(
        f"- {row['subject']}, {row['mb']} MB, {row['threads']} threads ({row['cycles']} cycles done, "
        f"{row.get('refused', 0)} tries again): {failure}\n"
        for row in results["rows"]
        for failure in row["failures"]
    )


def plot(results: Json, key: str, title: str, path: Path) -> None:
    """Bars by workload, logarithmic: the subjects are orders of magnitude apart.  The lines: least and most."""
    rows = [row for row in results["rows"] if row[key]]
    workloads = sorted({(row["mb"], row["threads"]) for row in rows})
    subjects = [name for name in COLOURS if any(row["subject"] == name for row in rows)]
    figure, axes = plt.subplots(figsize=(11, 4.5), layout="constrained")
    width = 0.85 / max(1, len(subjects))
    for number, name in enumerate(subjects):
        mine = {(row["mb"], row["threads"]): row[key] for row in rows if row["subject"] == name}
        places = [at for at, workload in enumerate(workloads) if workload in mine]
        values = [mine[workloads[at]] for at in places]
        middles = [statistics.median(each) for each in values]
        spread = [
            [middle - min(each) for middle, each in zip(middles, values)],
            [max(each) - middle for middle, each in zip(middles, values)],
        ]
        axes.bar(
            [at + (number - (len(subjects) - 1) / 2) * width for at in places],
            middles,
            width,
            yerr=spread,
            error_kw={"linewidth": 0.7, "ecolor": "#333333"},
            label=name,
            color=COLOURS[name],
        )
    axes.set_yscale("log")
    axes.set_ylabel("ms")
    axes.set_title(title)
    axes.set_xticks(range(len(workloads)), [f"{mb} MB\n{threads} thr." for mb, threads in workloads])
    axes.grid(axis="y", which="major", alpha=0.3)
    axes.legend(ncols=4, fontsize="small", loc="upper left")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * 8)
    figure.savefig(path.with_suffix(".png"), dpi=110)
    plt.close(figure)


def show(results: Json, path: Path) -> None:
    """Prints the tables, and writes them and the plots beside the results."""
    text = f"Freeze, ms\n\n{compact(results, 'freeze_ms')}\n"
    text += f"Outage, ms\n\n{compact(results, 'outage_ms')}\n{table(results)}"
    if any(row["stops"] for row in results["rows"]):
        text += f"\n{stops(results)}"
    if failed := failures(results):
        text += f"\n{failed}"
    path.with_suffix(".md").write_text(text)
    if results["rows"]:
        plot(results, "freeze_ms", "freeze: the server stands still at a checkpoint", path.with_name("peers-freeze"))
        plot(results, "outage_ms", "outage: from kill -9 to the next answer", path.with_name("peers-outage"))
    print(text)
    print(f"written: {path}, {path.with_suffix('.md')}, peers-freeze and peers-outage (.png) beside them")
