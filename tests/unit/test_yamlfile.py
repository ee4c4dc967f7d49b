# SPDX-License-Identifier: Apache-2.0
"""YAML that would keep a reader busy forever, or fill its memory, is refused with one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from avckpt import yamlfile
from avckpt.config import examine
from avckpt.yamlfile import Unreadable

LONG_S = 20


def doubled(first: str, more: str, last: str = "") -> str:
    """Every line twice what the one above it is, 40 times over."""
    return "\n".join([first, *(more.format(n=n, m=n - 1) for n in range(1, 41)), last]) + "\n"


MERGED = doubled("x0: &a0 {avckpt.keep: '3'}", "x{n}: &a{n} {{<<: [*a{m}, *a{m}]}}", "services: {web: {labels: *a40}}")
LISTED = doubled("x0: &a0 [1]", "x{n}: &a{n} [*a{m}, *a{m}]", "services: {web: {labels: *a40}}")


def check(path: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "avckpt", "check", str(path)],
        capture_output=True,
        text=True,
        timeout=LONG_S,
        check=False,
    )
    assert done.returncode == 1
    return done.stdout


@pytest.mark.parametrize("text", [MERGED, LISTED])
def test_aliases_of_aliases(tmp_path: Path, text: str) -> None:
    path = tmp_path / "compose.yaml"
    path.write_text(text)
    [problem, _] = check(path).splitlines()
    assert problem.endswith("with its aliases replaced more than 100000 values")


def test_a_configuration_file_of_aliases(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(doubled("defaults: &a0 {interval: 1s}", "x{n}: &a{n} [*a{m}, *a{m}]"))
    _, [problem] = examine(path)
    assert "more than 100000 values" in problem.message


@pytest.mark.parametrize("text", ["a: &a [*a]\n", "a: &a {<<: *a}\n", "a: &a {b: {c: [*a]}}\n"])
def test_an_anchor_that_holds_itself(tmp_path: Path, text: str) -> None:
    path = tmp_path / "compose.yaml"
    path.write_text(text)
    with pytest.raises(Unreadable, match=r"compose.yaml:1: an anchor that holds itself"):
        yamlfile.read(path)


def test_aliases_within_reason(tmp_path: Path) -> None:
    path = tmp_path / "compose.yaml"
    path.write_text("a: &a {k: 1}\n" + "".join(f"s{n}: {{<<: *a, own: *a}}\n" for n in range(1000)))
    assert len(yamlfile.entries(yamlfile.read(path))) == 1001


def test_a_file_without_an_end() -> None:
    with pytest.raises(Unreadable, match="longer than"):
        yamlfile.read(Path("/dev/zero"))


def test_a_chain_of_services_is_followed_so_far(tmp_path: Path) -> None:
    """Each one's settings are read once, however many extend it."""
    (tmp_path / "other.yaml").write_text(
        "services:\n"
        + "".join(f"  s{n}: {{extends: s{n + 1}}}\n" for n in range(2000))
        + "  s2000: {image: x, labels: [avckpt.enable=true]}\n"
    )
    path = tmp_path / "compose.yaml"
    extends = "{{extends: {{file: other.yaml, service: s{n}}}}}"
    path.write_text("services:\n" + "".join(f"  w{n}: {extends.format(n=n)}\n" for n in range(2000)))
    said = check(path)
    assert "extends more than 50 services, one by way of the other" in said


def test_a_pipe_is_read_once() -> None:
    """Compose, or Kubernetes: that takes a look of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "avckpt", "check", "/dev/stdin"],
        input="services: {web: {image: x, labels: [avckpt.keep=many]}}\n",
        capture_output=True,
        text=True,
    )
    assert "keep" in done.stdout
    assert done.returncode == 1
