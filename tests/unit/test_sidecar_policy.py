# SPDX-License-Identifier: Apache-2.0
"""From labels to the engine's configuration."""

from __future__ import annotations

import pytest
from avckpt.cli.run import settings_of_run
from avckpt.errors import LabelsWrong
from avckpt.guard import Again, Files, GuardConfig, Images, Tcp
from avckpt.policy import changes, settings_of


def test_a_group_that_recovers_together_has_a_fixed_interval() -> None:
    together = {"avckpt.enable": "true", "avckpt.group": "drive", "avckpt.group.recovery": "together"}
    alone, member = settings_of({"avckpt.enable": "true"}), settings_of(together)
    assert (member.config.interval_s, member.config.interval_min_s, member.config.keep) == (3.0, 0.0, 2)
    assert (alone.in_force["interval"], member.in_force["interval"]) == ("auto", "3s")
    assert "interval auto -> 3s" in map(str, changes(alone, member))


def test_defaults_are_those_of_the_label_table() -> None:
    assert settings_of({"avckpt.enable": "true"}).config == GuardConfig(
        interval_s=3.0,
        interval_min_s=0.02,
        keep=3,
        restore_on_signal=True,
        restore_on_exit=True,
        restore_on_statuses=frozenset(),
        restore_max=5,
        restore_window_s=60.0,
        quiesce_s=0.02,
        files=Files.AUTO,
        images=Images.AUTO,
        remains_s=1.0,
    )


def test_every_label_arrives() -> None:
    config = settings_of(
        {
            "avckpt.enable": "true",
            "avckpt.interval": "250ms",
            "avckpt.keep": "7",
            "avckpt.keep.apart": "10s",
            "avckpt.restore.on": "signal,3,99",
            "avckpt.restore.max": "9/2m",
            "avckpt.restore.again": "stagger",
            "avckpt.quiesce": "0",
            "avckpt.files": "strict",
            "avckpt.tcp": "reset-moved",
            "avckpt.images": "dirty",
            "avckpt.version": "0.1.0",
            "avckpt.name": "web",
            "io.podman.annotations.foo": "bar",
        }
    ).config
    assert config == GuardConfig(
        interval_s=0.25,
        keep=8,
        apart_s=10.0,
        restore_on_signal=True,
        restore_on_exit=False,
        restore_on_statuses=frozenset({3, 99}),
        restore_max=9,
        restore_window_s=120.0,
        again=Again.STAGGER,
        quiesce_s=0.0,
        files=Files.STRICT,
        tcp=Tcp.RESET_MOVED,
        images=Images.DIRTY,
        remains_s=1.0,
    )


def test_a_wrong_label_is_one_line() -> None:
    with pytest.raises(LabelsWrong, match=r"^label avckpt\.keep=none: .*whole number") as caught:
        settings_of({"avckpt.enable": "true", "avckpt.keep": "none"})
    assert "\n" not in str(caught.value)


def test_run_implies_enable() -> None:
    assert settings_of_run({"avckpt.interval": "1s"}).config.interval_s == 1.0


@pytest.mark.parametrize(
    "labels", [{"avckpt.enable": "false"}, {"app": "web"}, {"avckpt.intervall": "1s"}, {"avckpt.tcp": "drop"}]
)
def test_run_refuses_what_it_can_not_honour(labels: dict[str, str]) -> None:
    with pytest.raises(LabelsWrong):
        settings_of_run(labels)
