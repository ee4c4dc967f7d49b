# SPDX-License-Identifier: Apache-2.0
"""/etc/avckpt/config.yaml: what it may contain, and messages when it contains something else."""

from __future__ import annotations

from pathlib import Path

import pytest
from avckpt.config import Configuration, Defaults, examine, read
from avckpt.errors import ConfigError, LabelsWrong
from avckpt.policy import changes, settings_of
from avckpt_hooks.shared.labels import LABELS

ENABLED = {"avckpt.enable": "true"}
GOOD = """\
defaults:
  interval: 500ms
  keep: 3            # a number, as people write it
  restore.on: signal
names:
  "*_lidar_*":
    interval: 100ms
  "front_*":
    interval: 200ms
    restore.max: 20/60s
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "config.yaml"


def problems(path: Path, text: str) -> list[str]:
    path.write_text(text)
    return [str(problem).removeprefix(f"{path}:") for problem in examine(path)[1]]


def test_labels_win_over_names_and_names_over_defaults(path: Path) -> None:
    path.write_text(GOOD)
    defaults = read(path)
    enable = {"avckpt.enable": "true"}
    assert settings_of(defaults.under(enable, "planner")).config.interval_s == 0.5
    assert settings_of(defaults.under(enable, "rear_lidar_1")).config.interval_s == 0.1
    # Of two patterns, the later.
    both = settings_of(defaults.under(enable, "front_lidar_1")).config
    assert (both.interval_s, both.restore_max, both.keep, both.restore_on_exit) == (0.2, 20, 3, False)
    labelled = defaults.under({**enable, "avckpt.interval": "1s", "avckpt.restore.on": "exit"}, "front_lidar_1")
    own = settings_of(labelled).config
    assert (own.interval_s, own.restore_on_signal, own.restore_on_exit, own.restore_max) == (1.0, False, True, 20)


@pytest.mark.parametrize("text", ["", "# nothing\n", "defaults:\n", "defaults: {}\nnames:\n", "names:\n  a:\n"])
def test_a_file_that_says_nothing_changes_nothing(path: Path, text: str) -> None:
    path.write_text(text)
    assert read(path).under({"avckpt.keep": "4"}, "a") == {"avckpt.keep": "4"}


def test_no_file_is_no_mistake(path: Path) -> None:
    assert read(path) == Defaults()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("defaults:\n  interval: 5\n", "2: defaults.interval: 5: a duration needs a unit; allowed: "),
        ("defaults:\n  keep: 2\n  keep: 99\n", "3: defaults.keep: 99: not within 1 to 16"),
        ("defaults:\n  interval:\n    - 3s\n", "2: defaults.interval: not a single value"),
        ("defaults:\n  intervall: 3s\n", "2: defaults.intervall: unknown key; did you mean interval?"),
        ("defaults:\n  restore: {on: exit}\n", "2: defaults.restore: unknown key; did you mean restore.on?"),
        ("defaults:\n  avckpt.keep: 2\n", "2: defaults.avckpt.keep: here the keys have no prefix; write keep"),
        ("\ndefaults:\n\n  enable: true\n", "4: defaults.enable: cannot be a default"),
        ("defaults:\n  interval: ''\n", "2: defaults.interval: an empty value: not a duration"),
        ("names:\n  web*:\n    quiesce: 5s\n", "3: names.web*.quiesce: 5s: more than 1s"),
        ("names:\n  web*: 3s\n", "2: names.web*: not a mapping"),
        ("default:\n  interval: 3s\n", "1: default: unknown key; known are defaults, names and sidecar"),
        ("- interval\n", "1: the file: not a mapping"),
        ("defaults:\n  interval: [3s\nnames:\n", "3: not YAML: while parsing a flow sequence"),
        ("defaults: &a\n  keep: [*a]\n", "1: an anchor that holds itself"),
        ("defaults:\n  restore.on: unhealthy\n  keep: 1\n", "3: keep: 1: too few for avckpt.restore.on=unhealthy"),
        (
            "defaults:\n  restore.on: unhealthy\nnames:\n  a: {interval: 1s}\n  b:\n    keep: 1\n",
            "6: keep: 1: too few for avckpt.restore.on=unhealthy",
        ),
    ],
)
def test_what_is_wrong_is_said_with_its_line(path: Path, text: str, problem: str) -> None:
    found = problems(path, text)
    assert any(line.startswith(problem) for line in found), found
    with pytest.raises(ConfigError) as caught:
        read(path)
    assert "\n" not in str(caught.value)


def test_every_problem_is_said_in_the_order_of_the_lines(path: Path) -> None:
    found = problems(path, "other: 1\ndefaults:\n  keep: 0\n  keep: 2\n  x: 1\nnames:\n  a: {interval: 1}\n")
    assert [line.split(":")[0] for line in found] == ["1", "4", "5", "7"]
    assert "given in line 3 already" in found[1]


def test_a_value_comes_from_an_anchor(path: Path) -> None:
    text = "defaults: &usual\n  interval: 1s\n  keep: 4\nnames:\n  fast:\n    <<: *usual\n    interval: 50ms\n"
    assert problems(path, text) == []
    assert read(path).by_name == (("fast", {"avckpt.keep": "4", "avckpt.interval": "50ms"}),)


@pytest.mark.parametrize("label", sorted(LABELS))
def test_every_label_but_those_of_the_start_may_have_a_default(path: Path, label: str) -> None:
    key = label.removeprefix("avckpt.")
    found = problems(path, f"defaults:\n  {key}: '?!'\n")
    assert len(found) == 1
    assert ("cannot be a default" in found[0]) == (key in ("enable", "io_uring", "scope"))
    assert "unknown key" not in found[0]


def test_a_receiver_by_default_takes_a_group(path: Path) -> None:
    path.write_text("defaults: {notify: 'signal:USR1'}\n")
    defaults = read(path)
    assert settings_of(defaults.under(ENABLED, "a")).policy.notify is None
    grouped = settings_of(defaults.under({**ENABLED, "avckpt.group": "g"}, "a"))
    assert grouped.policy.notify is not None
    # In a label it is a mistake, and said.
    with pytest.raises(LabelsWrong, match="without a group"):
        settings_of(defaults.under({**ENABLED, "avckpt.notify": "signal:USR1"}, "a"))


def test_what_changes_is_what_means_something_else() -> None:
    before = settings_of({**ENABLED, "avckpt.interval": "3s", "avckpt.keep": "2", "avckpt.group": "a"})
    after = settings_of({**ENABLED, "avckpt.interval": "3000ms", "avckpt.files": " keep "})
    assert [str(change) for change in changes(before, after)] == ["files auto -> keep", "group a -> none"]
    assert changes(before, before) == []


def test_a_broken_file_leaves_everything_as_it_was(path: Path) -> None:
    path.write_text(GOOD)
    configuration = Configuration(path)
    configuration.load()
    before = configuration.defaults
    loaded_at = configuration.loaded_at
    path.write_text("defaults:\n  interval: soon\n")
    with pytest.raises(ConfigError, match=r"config\.yaml:2: defaults\.interval: soon: not a duration"):
        configuration.load()
    assert configuration.defaults is before
    assert configuration.loaded_at == loaded_at
    assert "soon" in configuration.problem
    path.unlink()
    configuration.load()
    assert (configuration.defaults, configuration.problem) == (Defaults(), "")


def test_a_directory_is_no_file(path: Path) -> None:
    path.mkdir()
    with pytest.raises(ConfigError, match="Is a directory"):
        read(path)


def test_the_sidecar_has_settings_of_its_own(path: Path) -> None:
    path.write_text("sidecar: {budget.cpu: 12.5 %}\n")
    assert read(path).cpu_total == 0.125
    path.write_text("defaults: {budget.cpu: 1%}\n")
    assert read(path).cpu_total == Defaults().cpu_total == 0.25


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("{budget.cpu: 0%}", "sidecar.budget.cpu: 0%: allowed: a percentage of one CPU from 0.1% to 9999%, as 25%"),
        ("{budget.cpu: [1]}", "sidecar.budget.cpu: not a single value: allowed: a percentage of one CPU"),
        ("{keep: 3}", "sidecar.keep: unknown key; known is budget.cpu"),
        ("3", "sidecar: not a mapping"),
    ],
)
def test_what_is_wrong_with_them_is_said(path: Path, text: str, problem: str) -> None:
    (found,) = problems(path, f"sidecar: {text}\n")
    assert found.startswith(f"1: {problem}")
