# SPDX-License-Identifier: Apache-2.0
"""What README.md and docs/ name exists, and what exists is named there.

Fields of events, paths of the API and kinds of errors: test_openapi.py, test_evidence.py, test_sidecar_errors.py.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from avckpt.cli.commands import main
from avckpt.events.metrics import Metrics
from avckpt_hooks.shared.labels import LABELS, RESERVED

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "examples").rglob("*.md"))]
NO_LABELS = {"avckpt.conf": "a file", "avckpt.options": "part of containerd's configuration", "avckpt.kep": "a mistake"}


def table(text: str, heading: str) -> dict[str, list[str]]:
    """The first cell of each row of the first table below that line, without backquotes, and the other cells."""
    below = text.partition(f"{heading}\n")[2].splitlines()
    assert below, heading
    first = next(n for n, line in enumerate(below) if line.startswith("|"))
    rows: dict[str, list[str]] = {}
    for line in below[first + 2 :]:
        if not line.startswith("|"):
            break
        name, *others = (cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1])
        rows[name] = others
    return rows


def test_every_label_is_in_the_readme_with_its_default() -> None:
    rows = table((ROOT / "README.md").read_text(), "## Labels")
    defaults = {f"`{name}`": f"`{label.default}`" if label.default else "" for name, label in LABELS.items()}
    assert {name: others[0] for name, others in rows.items()} == defaults


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_labels_that_are_named_exist(page: Path) -> None:
    named = set(re.findall(r"(?<![\w./-])avckpt\.[a-z][a-z_.]*[a-z]\b(?![\w(/])", page.read_text()))
    assert named - {*LABELS, *RESERVED, *NO_LABELS} == set()


def test_every_command_is_in_the_readme() -> None:
    first_cells = " ".join(table((ROOT / "README.md").read_text(), "    sudo podman logs node"))
    assert set(re.findall(r"`avckpt ([a-z]+)", first_cells)) == set(main.commands)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_their_options_that_are_named_exist(page: Path) -> None:
    for name, words in re.findall(
        r"(?:^    (?:# |sudo )?|`(?:sudo )?)(?:\.venv/bin/)?avckpt ([a-z]+)([^`\n]*)", page.read_text(), re.M
    ):
        assert name in main.commands, name
        known = {option for parameter in main.commands[name].params for option in parameter.opts}
        own = words.partition(" -- ")[0].partition("    #")[0]
        assert set(re.findall(r"(?<!\S)(--[a-z-]+)", own)) <= {*known, "--help", "--"}, f"avckpt {name}{words}"


def test_every_metric_is_in_the_manual() -> None:
    rows = table((ROOT / "docs/api.md").read_text(), "## Metrics")
    named = set()
    for cell in rows:
        before, braces, after = re.fullmatch(r"`(\w+)(?:\{([\w,]+)\})?(\w*)`", cell).groups()  # type: ignore[union-attr]
        named |= {before + each + after for each in (braces or "").split(",")}
    families = Metrics("1", "1")._registry.collect()
    exist = {each.name + ("_total" if each.type == "counter" else "") for each in families}
    assert named == exist
