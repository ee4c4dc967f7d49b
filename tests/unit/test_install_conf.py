# SPDX-License-Identifier: Apache-2.0
"""Which hook directories are in force, according to containers.conf."""

from __future__ import annotations

from pathlib import Path

import pytest
from avckpt.cli import containers_conf
from avckpt.cli.containers_conf import DEFAULT, HooksDirs

OURS = Path("/ours")


def write(root: Path, path: str, text: str) -> Path:
    target = root / path.lstrip("/")
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(text)
    return Path(path)


def test_podmans_default(tmp_path: Path) -> None:
    assert containers_conf.read(tmp_path) == HooksDirs(DEFAULT, None)


def test_the_last_file_that_says_so_wins(tmp_path: Path) -> None:
    write(tmp_path, "/usr/share/containers/containers.conf", '[engine]\nhooks_dir=["/0"]\n')
    write(tmp_path, "/etc/containers/containers.conf", '[engine]\nhooks_dir=["/1"]\n')
    last = write(tmp_path, "/etc/containers/containers.conf.d/b.conf", '[engine]\nhooks_dir=["/3"]\n')
    write(tmp_path, "/etc/containers/containers.conf.d/a.conf", '[engine]\nhooks_dir=["/2"]\n')
    write(tmp_path, "/etc/containers/containers.conf.d/c.conf", "[containers]\n")
    write(tmp_path, "/etc/containers/containers.conf.d/d.conf.bak", '[engine]\nhooks_dir=["/4"]\n')
    assert containers_conf.read(tmp_path) == HooksDirs(("/3",), last)
    assert containers_conf.read(tmp_path, without=last).directories == ("/2",)


@pytest.mark.parametrize(
    ("text", "directories"),
    [
        ('[engine]\nhooks_dir = ["/a", "/b"]\n', ("/a", "/b")),
        ("[engine]\n  hooks_dir=[\n\"/a\", # one, two]\n'/b',\n]\n", ("/a", "/b")),
        ('engine.hooks_dir = ["/a"]\n', ("/a",)),
        ('[engine]\ncdi = ["x"]\nhooks_dir = ["/a#1"]\n[engine.runtimes]\ncrun = ["/usr/bin/crun"]\n', ("/a#1",)),
        ("[engine]\nhooks_dir = []\n", ()),
        ('[containers]\nhooks_dir = ["/a"]\n', DEFAULT),
        ('[engine]\n#hooks_dir = ["/a"]\n', DEFAULT),
        ('[engine]\n[network]\nhooks_dir = ["/a"]\n', DEFAULT),
        ('[engine] # table\nenv = ["A=[engine]"]\nhooks_dir = ["/a"] # yes\n', ("/a",)),
    ],
)
def test_toml(tmp_path: Path, text: str, directories: tuple[str, ...]) -> None:
    write(tmp_path, "/etc/containers/containers.conf", text)
    assert containers_conf.read(tmp_path).directories == directories


@pytest.mark.parametrize(
    ("lists", "directories"),
    [
        (['"/a"', '"/b", {append=true}'], ("/a", "/b")),
        (['"/a", { append = true }', '"/b"'], (*DEFAULT, "/a", "/b")),
        (['"/a"', '"/b"', '"/c",\n{append=true},\n', '"/d"'], ("/b", "/c", "/d")),  # as containers.conf(5) has it
        (['"/a", {append=true}', '"/b"', '"/c", {append=false}', '"/d"'], ("/d",)),
        (["{append=true}", '"/b"'], (*DEFAULT, "/b")),
    ],
)
def test_lists_that_are_added_to_earlier_ones(tmp_path: Path, lists: list[str], directories: tuple[str, ...]) -> None:
    for n, entries in enumerate(lists):
        write(tmp_path, f"/etc/containers/containers.conf.d/{n}.conf", f"[engine]\nhooks_dir = [{entries}]\n")
    assert containers_conf.read(tmp_path).directories == directories


def test_a_list_behind_ours_that_is_added_hides_nothing(tmp_path: Path) -> None:
    write(tmp_path, "/etc/containers/containers.conf.d/50-avckpt.conf", '[engine]\nhooks_dir=["/ours"]\n')
    write(tmp_path, "/etc/containers/containers.conf.d/99-mine.conf", '[engine]\nhooks_dir=["/mine", {append=true}]\n')
    assert containers_conf.problems(OURS, tmp_path) == []


def test_containers_conf_in_the_environment_hides_the_drop_in(tmp_path: Path) -> None:
    write(tmp_path, "/etc/containers/containers.conf.d/50-avckpt.conf", '[engine]\nhooks_dir=["/ours"]\n')
    mine = write(tmp_path, "/etc/mine.conf", "[containers]\n")
    environ = {"CONTAINERS_CONF": str(mine)}
    assert containers_conf.problems(OURS, tmp_path) == []
    assert containers_conf.problems(OURS, tmp_path, environ) == [
        "CONTAINERS_CONF is set, so Podman reads /etc/mine.conf and no other configuration: "
        f'write hooks_dir = ["{DEFAULT[0]}", "/ours"] under [engine] in /etc/mine.conf'
    ]
    write(tmp_path, "/etc/mine.conf", '[engine]\nhooks_dir = ["/ours"]\n')
    assert containers_conf.problems(OURS, tmp_path, environ) == []
