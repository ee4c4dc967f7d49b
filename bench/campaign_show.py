# SPDX-License-Identifier: Apache-2.0
"""Table and picture of bench/results/campaign.json.

python -m bench.campaign_show        into docs/campaign.md (between its marks) and docs/images/campaign.svg
"""

from __future__ import annotations

import json
from collections import Counter
from html import escape
from typing import Any

from bench.campaign import OUTCOMES, RESULTS
from testkit.harness import ROOT

PAGE = ROOT / "docs" / "campaign.md"
PICTURE = ROOT / "docs" / "images" / "campaign.svg"
BEGIN, END = "<!-- bench/campaign_show.py -->\n", "<!-- end -->\n"
COLOURS = {
    "recovered": "#3a8f5c",
    "recrashed": "#c9a227",
    "wrong": "#a02c50",
    "cold": "#8a5a3c",
    "stuck": "#666666",
    "unharmed": "#9fb8cc",
}
ROW, BAR, LEFT = 15, 280, 290

Json = dict[str, Any]


def table(cells: list[Json]) -> str:
    """Markdown: a row for each fault and language, and sums."""
    head = [
        f"| fault | language | runs | {' | '.join(OUTCOMES)} | detection, ms | restore, ms |",
        f"|---|---|{'---:|' * (len(OUTCOMES) + 3)}",
    ]
    rows = [
        _row(cell["fault"], cell["language"], cell, cell["detected_max_s"], cell["restored_max_s"])
        for cell in sorted(cells, key=lambda each: (each["fault"], each["language"]))
    ]
    for language in sorted({cell["language"] for cell in cells}):
        total: Counter[str] = Counter()
        for cell in cells:
            if cell["language"] == language:
                total.update({name: cell[name] for name in ("runs", *OUTCOMES)})
        rows.append(_row("**all**", language, total))
    return "\n".join([*head, *rows]) + "\n"


def _row(fault: str, language: str, counted: Any, *longest_s: float | None) -> str:
    numbers = " | ".join(str(counted[name] or "") for name in OUTCOMES)
    longest = " | ".join("" if each is None else f"{each * 1000:.1f}" for each in longest_s or (None, None))
    return f"| {fault} | {language} | {counted['runs']} | {numbers} | {longest} |"


def picture(cells: list[Json]) -> str:
    """An SVG: a bar for each fault and language."""
    cells = sorted((cell for cell in cells if cell["runs"]), key=lambda each: (each["language"], each["fault"]))
    height = ROW * (len(cells) + 2) + 10
    width = LEFT + BAR + 10
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" font-size="10"><rect width="100%" height="100%" fill="white"/>'
    ]
    at: float = 10
    for name in OUTCOMES:
        out.append(f'<rect x="{at:g}" y="6" width="9" height="9" fill="{COLOURS[name]}"/>')
        out.append(f'<text x="{at + 12:g}" y="14">{name}</text>')
        at += 22 + 6.2 * len(name)
    for i, cell in enumerate(cells):
        y = ROW * (i + 2)
        out.append(
            f'<text x="{LEFT - 6}" y="{y + 9}" text-anchor="end">{escape(cell["language"])}: '
            f"{escape(cell['fault'])}</text>"
        )
        x = float(LEFT)
        for name in OUTCOMES:
            part = BAR * cell[name] / cell["runs"]
            if part:
                out.append(f'<rect x="{x:.1f}" y="{y}" width="{part:.1f}" height="{ROW - 4}" fill="{COLOURS[name]}"/>')
            x += part
    return "\n".join([*out, "</svg>"]) + "\n"


def main() -> None:
    """Writes both."""
    cells = json.loads(RESULTS.read_text())
    before, _, rest = PAGE.read_text().partition(BEGIN)
    PAGE.write_text(before + BEGIN + table(cells) + END + rest.partition(END)[2])
    PICTURE.write_text(picture(cells))


if __name__ == "__main__":
    main()
