# SPDX-License-Identifier: Apache-2.0
"""Plots (PNG and SVG) and tables (Markdown) of bench/results/ros.json.

python -m bench.ros_show [bench/results/ros.json]
"""

from __future__ import annotations

import json
import math
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bench.ros_cost import beside_checkpoints
from bench.ros_endurance import OUTPUT as ENDURANCE
from bench.ros_endurance import summary
from testkit.harness import ROOT

Json = dict[str, Any]
COLOURS = {"avckpt": "tab:blue", "cold start": "tab:red", "plain": "tab:gray", "protected": "tab:blue"}
VARIANTS = ("avckpt", "cold start")
DISTURBED_MS = 50.0
"""Median latency before a crash; twice the usual one."""


def spread(values: Sequence[float], digits: int = 0) -> str:
    """Mean and standard deviation."""
    values = [value for value in values if math.isfinite(value)]
    if not values:
        return "-"
    deviation = statistics.stdev(values) if len(values) > 1 else 0.0
    return f"{statistics.mean(values):.{digits}f} ± {deviation:.{digits}f}"


def latency_table(runs: list[Json]) -> str:
    """The thesis's figures."""
    by_variant = {name: [r for r in runs if r["variant"] == name and steady(r)] for name in VARIANTS}
    disturbed = {
        name: sum(r["variant"] == name and "failed" not in r and not steady(r) for r in runs) for name in VARIANTS
    }
    failed = {name: sum(r["variant"] == name and "failed" in r for r in runs) for name in VARIANTS}
    rows: list[tuple[str, Callable[[Json], float], int]] = [
        ("median latency before, ms", lambda r: r["median_before_ms"], 1),
        ("maximum latency before, ms", lambda r: r["max_before_ms"], 1),
        ("increase of the median, ms", lambda r: r["median_after_ms"] - r["median_before_ms"], 1),
        ("increase of the maximum, ms", lambda r: r["max_after_ms"] - r["max_before_ms"], 1),
        ("same, a lost scan counted until the next pose: median, ms", _median_age, 1),
        ("same: maximum, ms", lambda r: r["max_age_after_ms"] - r["max_before_ms"], 1),
        ("longest gap between two poses, ms", lambda r: r["gap_ms"], 0),
        ("of it more than before the crash, ms", lambda r: r["gap_ms"] - r["gap_before_ms"], 0),
        ("crash to next filtered cloud, ms", lambda r: r["to_next_cloud_ms"], 0),
        ("crash to next pose, ms", lambda r: r["to_next_pose_ms"], 0),
        ("scans lost", lambda r: r["lost"], 2),
    ]
    lines = ["| | avckpt | cold start |", "|---|---:|---:|"]
    lines.append(f"| runs | {len(by_variant['avckpt'])} | {len(by_variant['cold start'])} |")
    lines.append(f"| runs left out: disturbed before the crash | {disturbed['avckpt']} | {disturbed['cold start']} |")
    lines.append(f"| runs that did not recover by themselves | {failed['avckpt']} | {failed['cold start']} |")
    for title, value, digits in rows:
        cells = [spread([value(run) for run in by_variant[name]], digits) for name in VARIANTS]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    restores = [r["restore_ms"] for r in by_variant["avckpt"] if r["restore_ms"] is not None]
    lines.append(f"| death to running again, by avckpt's own clock, ms | {spread(restores, 1)} | |")
    return "\n".join(lines)


def steady(run: Json) -> bool:
    """Whether the chain was well before the crash: a machine without CPU to give is no crash's doing."""
    return "failed" not in run and run["median_before_ms"] <= DISTURBED_MS


def _median_age(run: Json) -> float:
    return float(run["median_age_after_ms"] - run["median_before_ms"])


def cut_table(runs: list[Json]) -> str:
    """What became of connections in the middle of a message."""
    lines = [
        "| `avckpt.tcp` | crash | crashes | in mid-message | chain delivers again | scans lost | to next pose, ms |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    for tcp in dict.fromkeys(r["tcp"] for r in runs):
        for place in ("anywhere", "message"):
            group = [r for r in runs if r["tcp"] == tcp and r["place"] == place]
            good = [r for r in group if r["recovered"]]
            lines.append(
                f"| `{tcp}` | {'at random' if place == 'anywhere' else 'while a scan is read'} | {len(group)} "
                f"| {sum(bool(r['inside']) for r in group)} | {len(good)} "
                f"| {spread([r['lost'] for r in good], 1)} | {spread([r['to_next_pose_ms'] for r in good])} |"
            )
    return "\n".join(lines)


def cost_table(cost: Json) -> str:
    """CPU, memory and freezes."""
    voxel = [c for c in cost["protected"]["checkpoints"] if c["container"] == "ros-voxel"]
    ndt = [c for c in cost["protected"]["checkpoints"] if c["container"] == "ros-ndt"]
    during, others = beside_checkpoints(cost["protected"])
    lines = ["| | without | with |", "|---|---:|---:|"]
    for title, key, digits in (("CPU, percent of a core", "cpu_percent", 1), ("memory, MB", "memory_mb", 1)):
        cells = [spread([s[key] for s in cost[name]["samples"]], digits) for name in ("plain", "protected")]
        lines.append(f"| voxel filter's container: {title} | {' | '.join(cells)} |")
    plain = [f[1] * 1e3 for f in cost["plain"]["frames"] if f[1] is not None]
    lines.append(
        f"| latency median / longest, ms | {statistics.median(plain):.1f} / {max(plain):.1f} "
        f"| {statistics.median([*during, *others]) * 1e3:.1f} / {max([*during, *others]) * 1e3:.1f} |"
    )
    met = f"{statistics.median(during) * 1e3:.1f} / {max(during) * 1e3:.1f}" if during else "-"
    lines.append(
        f"| of it scans that met a checkpoint of voxel or ndt: {len(during)} of {len(during) + len(others)} | | {met} |"
    )
    for name, found in (("voxel", voxel), ("ndt", ndt)):
        freezes = [c["freeze_s"] * 1e3 for c in found]
        lines.append(f"| freeze of {name}, ms ({len(found)} checkpoints) | | {spread(freezes, 2)} |")
    return "\n".join(lines)


def endurance_table(results: list[Json]) -> str:
    """Counts of the long run."""
    lines = ["| crash | survived |", "|---|---:|"]
    for title, key in (("of", "nodes"), ("kind", "kind"), ("place", "place")):
        groups: dict[str, list[Json]] = {}
        for result in results:
            value = result[key]
            groups.setdefault("+".join(value) if isinstance(value, list) else value or "anywhere", []).append(result)
        for name in sorted(groups):
            lines.append(f"| {title} {name} | {sum(r['survived'] for r in groups[name])} of {len(groups[name])} |")
    total = summary(results)
    lines.append(f"| **all** | **{total['survived']} of {total['crashes']}** |")
    lines.append(
        f"| no scan lost / one / more | {total['no_frame_lost']} / {total['one_frame_lost']} / {total['more_lost']} |"
    )
    return "\n".join(lines)


def plot_latency(runs: list[Json], folder: Path) -> None:
    """Gaps and increases, one dot a run."""
    plt = _plotting()
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6))
    panels: tuple[tuple[str, Callable[[Json], float]], ...] = (
        ("longest gap between two poses, ms", lambda r: r["gap_ms"]),
        ("increase of the maximum latency, ms", lambda r: r["max_age_after_ms"] - r["max_before_ms"]),
        ("crash to next pose, ms", lambda r: r["to_next_pose_ms"]),
    )
    for axis, (title, value) in zip(axes, panels):
        for place, name in enumerate(VARIANTS):
            values = [value(r) for r in runs if r["variant"] == name and steady(r)]
            values = [one for one in values if math.isfinite(one)]
            if not values:
                continue
            spots = [place + 0.24 * (i / max(1, len(values) - 1) - 0.5) for i in range(len(values))]
            axis.plot(spots, values, ".", color=COLOURS[name])
            axis.errorbar(
                [place + 0.25],
                [statistics.mean(values)],
                [statistics.stdev(values) if len(values) > 1 else 0.0],
                fmt="o",
                color="black",
                capsize=4,
            )
        axis.set_xticks(range(len(VARIANTS)), VARIANTS)
        axis.set_xlim(-0.5, 1.6)
        axis.set_ylim(bottom=min(0, axis.get_ylim()[0]))
        axis.set_title(title, fontsize=10)
        axis.grid(axis="y", alpha=0.3)
    figure.suptitle("a crash of voxel_grid_filter (dots: runs; bars: mean and standard deviation)", fontsize=11)
    _save(figure, folder, "ros-latency")


def plot_cost(cost: Json, folder: Path) -> None:
    """CPU and memory of the voxel filter over time, checkpoints marked."""
    plt = _plotting()
    figure, axes = plt.subplots(2, 1, figsize=(10, 5), sharex=True)
    for axis, key, title in ((axes[0], "cpu_percent", "CPU, % of a core"), (axes[1], "memory_mb", "memory, MB")):
        for name, label in (("plain", "without avckpt"), ("protected", "checkpoint every 3 s, kept 3 s")):
            samples = cost[name]["samples"]
            axis.plot([s["at"] for s in samples], [s[key] for s in samples], color=COLOURS[name], label=label, lw=1.2)
        for one in cost["protected"]["checkpoints"]:
            if one["container"] == "ros-voxel":
                axis.axvline(one["at"], color="tab:green", alpha=0.5, lw=0.8)
        axis.set_ylabel(title)
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    axes[0].legend(loc="upper right", fontsize=8)
    axes[1].set_xlabel("s (green: checkpoints)")
    figure.suptitle("voxel_grid_filter's container under repeated checkpoints", fontsize=11)
    _save(figure, folder, "ros-cost")


def _plotting() -> Any:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def _save(figure: Any, folder: Path, name: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    figure.tight_layout()
    figure.savefig(folder / f"{name}.png", dpi=110)


def show(path: Path) -> None:
    """Writes plots and ros.md beside the results, and prints the tables."""
    results: Json = json.loads(path.read_text())
    parts = [f"measured {results['machine']['at']}: {results['machine']}"]
    if "latency" in results:
        plot_latency(results["latency"], path.parent)
        parts.append(latency_table(results["latency"]))
    if "cut" in results:
        parts.append(cut_table(results["cut"]))
    if "cost" in results:
        plot_cost(results["cost"], path.parent)
        parts.append(cost_table(results["cost"]))
    if ENDURANCE.exists():
        parts.append(endurance_table([json.loads(line) for line in ENDURANCE.read_text().splitlines()]))
    text = "\n\n".join(parts)
    path.with_suffix(".md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    show(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "bench" / "results" / "ros.json")
