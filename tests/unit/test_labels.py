# SPDX-License-Identifier: Apache-2.0
"""Values of labels, and messages for wrong ones."""

from __future__ import annotations

import contextlib
import random
import signal
import string
from pathlib import Path

import pytest
from avckpt_hooks.shared.labels import (
    LABELS,
    RESTORES_MAX,
    LabelError,
    Notify,
    Policy,
    RestoreOn,
    merge,
    of_container,
    parse_policy,
    shown,
)

ON = {"avckpt.enable": "true"}


TOGETHER = {**ON, "avckpt.group": "g", "avckpt.group.recovery": "together"}


def test_a_group_that_goes_back_together() -> None:
    assert parse_policy(TOGETHER).together
    assert not parse_policy({**ON, "avckpt.group": "g"}).together
    assert not parse_policy({**TOGETHER, "avckpt.enable": "false"}).together


@pytest.mark.parametrize(
    ("labels", "says"),
    [
        ({"avckpt.group": None}, "label avckpt.group.recovery=together: there is no group; add avckpt.group=NAME"),
        ({"avckpt.tcp": "keep"}, "label avckpt.tcp=keep: a group that recovers together would receive"),
        ({"avckpt.tcp": "messages"}, "label avckpt.tcp=messages: a group that recovers together would"),
        (
            {"avckpt.interval": "auto"},
            "label avckpt.interval=auto: a group that recovers together needs a fixed interval",
        ),
        (
            {"avckpt.deadline": "50ms", "avckpt.deadline.late": "cold"},
            "label avckpt.deadline.late=cold: no member of a group that recovers together",
        ),
        (
            {"avckpt.restore.again": "stagger"},
            "label avckpt.restore.again=stagger: a group that recovers together goes back to one instant",
        ),
        ({"avckpt.keep.apart": "3s"}, "label avckpt.keep.apart=3s: a group that recovers together keeps its newest"),
    ],
)
def test_what_does_not_go_with_a_return_together(labels: dict[str, str | None], says: str) -> None:
    merged = {key: value for key, value in {**TOGETHER, **labels}.items() if value is not None}
    with pytest.raises(LabelError) as raised:
        parse_policy(merged)
    assert str(raised.value).startswith(says)


def test_no_label_means_no_protection_and_the_defaults_of_the_table() -> None:
    policy = parse_policy({"unrelated": "x"})
    assert policy == Policy(
        enable=False,
        interval_s=3.0,
        keep=2,
        restore_on=RestoreOn(signal=True, exit=True, statuses=frozenset()),
        restore_max=5,
        restore_window_s=60.0,
        quiesce_s=0.02,
    )


def test_every_default_of_the_table_means_what_leaving_it_out_means() -> None:
    written_out = {key: label.default for key, label in LABELS.items() if label.default}
    assert parse_policy(written_out) == parse_policy({})


@pytest.mark.parametrize("text", ["true", "1", "yes", "on", "True", "YES", " on "])
def test_enable(text: str) -> None:
    assert parse_policy({"avckpt.enable": text}).enable


@pytest.mark.parametrize("text", ["false", "0", "no", "off", "FALSE"])
def test_disable(text: str) -> None:
    assert not parse_policy({"avckpt.enable": text}).enable


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("500ms", 0.5), ("3s", 3), ("1m", 60), ("10ms", 0.01), ("1.5s", 1.5), ("24h", 86400), ("0.5m", 30)],
)
def test_interval(text: str, seconds: float) -> None:
    assert parse_policy({"avckpt.interval": text}).interval_s == pytest.approx(seconds)


def test_the_rest_of_the_table() -> None:
    policy = parse_policy(
        {
            **ON,
            "avckpt.keep": "16",
            "avckpt.keep.apart": "1m",
            "avckpt.restore.on": "signal, 3,42",
            "avckpt.restore.max": "1/1h",
            "avckpt.restore.again": "drop-input, stagger",
            "avckpt.quiesce": "0",
        }
    )
    assert (policy.keep, policy.keep_apart_s) == (16, 60)
    assert policy.restore_on == RestoreOn(signal=True, exit=False, statuses=frozenset({3, 42}))
    assert (policy.restore_max, policy.restore_window_s) == (1, 3600)
    assert policy.again == {"drop-input", "stagger"}
    assert parse_policy({**ON, "avckpt.restore.again": "same"}).again == frozenset()
    assert policy.quiesce_s == 0


@pytest.mark.parametrize(
    ("key", "value", "why"),
    [
        ("enable", "maybe", "neither true nor false"),
        ("enable", "", "neither true nor false"),
        ("interval", "banana", "not a duration"),
        ("interval", "3", "a duration needs a unit"),
        ("interval", "-3s", "not a duration"),
        ("interval", "nans", "not a duration"),
        ("interval", "1e3s", "not a duration"),
        ("interval", "３s", "not a duration"),
        ("interval", "9ms", "less than 10ms"),
        ("interval", "25h", "more than 24h"),
        ("interval", "9" * 400 + "s", "more than 24h"),
        ("restore.again", "other", "other is unknown"),
        ("restore.again", "stagger,", '"" is unknown'),
        ("restore.again", "same,stagger", "same goes with nothing else"),
        ("keep", "0", "not within 1 to 16"),
        ("keep", "17", "not within 1 to 16"),
        ("keep", "-1", "not a whole number"),
        ("keep", "²", "not a whole number"),
        ("restore.on", "", "an entry is empty"),
        ("restore.on", "signal,,exit", "an entry is empty"),
        ("restore.on", "sigsegv", "sigsegv is unknown"),
        ("restore.on", "0", "0 is not an exit code that can mean failure"),
        ("restore.on", "256", "256 is not an exit code that can mean failure"),
        ("restore.on", "²", "² is unknown"),
        ("restore.max", "5", "not a number of restores, a slash and a time"),
        ("restore.max", "0/60s", "not within 1 to 64"),
        ("restore.max", "5/60", "a duration needs a unit"),
        ("restore.max", "5/0s", "less than 1s"),
        ("restore.max", "65/60s", "not within 1 to 64"),
        ("tcp", "drop", "unknown value"),
        ("files", "Rewind", "unknown value"),
        ("shm", "big", "not a size"),
        ("shm", "4IB", "not a size"),
        ("shm", "2GB", "too large"),
        ("shm", "4", "less than a page: is its unit missing?"),
        ("quiesce", "2s", "more than 1s"),
        ("quiesce", "20", "a duration needs a unit"),
        ("group", "two words", "not a name"),
        ("notify", "mail:me", "neither a signal nor a command"),
        ("notify", "signal:", "neither a signal nor a command"),
        ("notify", "signal:USR3", "USR3 is no signal"),
        ("notify", "signal:0", "not within 1 to 64"),
        ("notify", "signal:33", "33 is no signal"),
        ("notify", "signal:RTMAX+1", "RTMAX+1 is no signal"),
        ("notify.self", "signal:KILL", "cannot be caught"),
        ("notify.self", "exec:echo 'a", "a quotation that does not end"),
        ("notify.self", "exec:echo " + "a" * 2048, "longer than 2048 characters"),
        ("restore.on", "signal," * 400 + "exit", "longer than 2048 characters"),
    ],
)
@pytest.mark.parametrize("enable", ["true", "false"])
def test_a_bad_value_is_an_error_whether_protected_or_not(key: str, value: str, why: str, enable: str) -> None:
    key = f"avckpt.{key}"
    with pytest.raises(LabelError) as caught:
        parse_policy({"avckpt.enable": enable, key: value})
    error = caught.value
    assert (error.key, error.value) == (key, value)
    assert why in error.why
    assert str(error).startswith(f"label {key}=")
    assert LABELS[key].allowed in str(error)


@pytest.mark.parametrize(
    ("text", "means"),
    [
        ("signal:USR1", Notify(signal=signal.SIGUSR1)),
        ("signal: sigusr2", Notify(signal=signal.SIGUSR2)),
        ("signal:10", Notify(signal=10)),
        ("signal:RTMIN+3", Notify(signal=signal.SIGRTMIN + 3)),
        ("signal:SIGRTMAX-1", Notify(signal=signal.SIGRTMAX - 1)),
        ("exec:/bin/reconnect --to 'a b'", Notify(command=("/bin/reconnect", "--to", "a b"))),
        ("exec:sh -c 'echo $AVCKPT_EVENT'", Notify(command=("sh", "-c", "echo $AVCKPT_EVENT"))),
    ],
)
def test_how_a_container_wants_to_be_notified(text: str, means: Notify) -> None:
    policy = parse_policy({**ON, "avckpt.group": "lidar.front", "avckpt.notify": text, "avckpt.notify.self": text})
    assert (policy.group, policy.notify, policy.notify_self) == ("lidar.front", means, means)


def test_the_engine_takes_every_number_of_restores_that_a_label_may_ask_for() -> None:
    """More would be a container that runs unprotected."""
    source = (Path(__file__).parents[2] / "native" / "include" / "avckpt" / "engine.h").read_text()
    assert f"#define AVC_RESTORES_MAX {RESTORES_MAX}" in source
    assert parse_policy({**ON, "avckpt.restore.max": f"{RESTORES_MAX}/1s"}).restore_max == RESTORES_MAX


def test_a_container_that_would_hear_of_nobody_is_told() -> None:
    label = {"avckpt.notify": "signal:USR1"}
    with pytest.raises(LabelError, match=r"without a group there are no recoveries to report; add avckpt\.group=NAME"):
        parse_policy({**ON, **label})
    assert parse_policy(label).notify is not None
    assert not parse_policy(label).listens
    assert parse_policy({**label, "avckpt.group": "g"}).listens
    assert parse_policy({**ON, "avckpt.notify.self": "signal:USR1"}).notify_self is not None


@pytest.mark.parametrize("text", ["4MB", "4mb", "4000KB", "4000000", "4M"])
def test_the_default_of_shm_however_it_is_written(text: str) -> None:
    assert parse_policy({**ON, "avckpt.shm": text}) == parse_policy(ON)


@pytest.mark.parametrize(("text", "size"), [("0", 0), ("8MB", 8_000_000), ("64KiB", 65536)])
def test_sizes_of_shm(text: str, size: int) -> None:
    assert parse_policy({**ON, "avckpt.shm": text}).shm_bytes == size


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("avckpt.enabled", "did you mean avckpt.enable?"),
        ("avckpt.intervall", "did you mean avckpt.interval?"),
        ("avckpt.restore_on", "did you mean avckpt.restore.on?"),
        ("avckpt.zzzzzzzzzzzz", "known are avckpt.budget.cpu,"),
    ],
)
def test_an_unknown_label_is_an_error_with_a_hint(key: str, hint: str) -> None:
    with pytest.raises(LabelError) as caught:
        parse_policy({key: "true"})
    assert str(caught.value).startswith(f"label {key}: unknown label; ")
    assert hint in str(caught.value)


def test_what_the_hook_stamps_is_left_alone() -> None:
    assert parse_policy({**ON, "avckpt.version": "0.1.0", "avckpt.name": "web"}).enable


def test_an_error_is_one_short_printable_line_whatever_the_value() -> None:
    random.seed(20)
    alphabet = string.printable + "\x00\x1b\u202e\u2028äß"
    for _ in range(300):
        key = random.choice(sorted(LABELS))
        value = "".join(random.choice(alphabet) for _ in range(random.randrange(200)))
        with contextlib.suppress(LabelError):
            parse_policy({key: value})
            continue
        with pytest.raises(LabelError) as caught:
            parse_policy({key: value})
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < 400


def test_merge_takes_labels_and_annotations() -> None:
    assert merge({"avckpt.keep": "3", "a": "b"}, {"avckpt.interval": "1s", "c": "d"}) == {
        "avckpt.keep": "3",
        "avckpt.interval": "1s",
    }
    assert merge({"avckpt.keep": "3"}, {"avckpt.keep": " 3"}) == {"avckpt.keep": "3"}


def test_merge_refuses_two_minds() -> None:
    with pytest.raises(LabelError, match="the annotation of the same name says 4"):
        merge({"avckpt.keep": "3"}, {"avckpt.keep": "4"})


def test_an_annotation_may_be_meant_for_one_container_of_a_pod() -> None:
    annotations = {
        "avckpt.keep": "1",
        "avckpt.keep/lidar": "2",
        "avckpt.keep/front-lidar": "3",
        "avckpt.enable/lidar": "true",
        "io.podman/lidar": "x",
    }
    others = {"io.podman/lidar": "x"}
    assert of_container(annotations, "drive-lidar") == {"avckpt.keep": "2", "avckpt.enable": "true", **others}
    assert of_container(annotations, "drive/lidar") == {"avckpt.keep": "2", "avckpt.enable": "true", **others}
    assert of_container(annotations, "drive-front-lidar")["avckpt.keep"] == "3"
    assert of_container(annotations, "drive-radar") == {"avckpt.keep": "1", **others}


@pytest.mark.parametrize("key", ["avckpt.version", "avckpt.name"])
def test_merge_keeps_what_is_stamped_to_itself(key: str) -> None:
    assert merge({}, {key: "of an earlier start"}) == {}
    with pytest.raises(LabelError, match="avckpt sets this itself"):
        merge({key: "mine"}, {})


@pytest.mark.parametrize(
    ("value", "means"),
    [
        ("exec:/bin/told --password=x", "exec:/bin/told ..."),
        ("exec: /bin/told --password=x", "exec: ..."),
        ("exec:/bin/told", "exec:/bin/told"),
        ("exce:/bin/told --password=x", "exce:/bin/told ..."),
        ("/bin/told --password=x", "/bin/told ..."),
        ("signal:USR1", "signal:USR1"),
    ],
)
def test_of_a_command_only_the_program_is_shown(value: str, means: str) -> None:
    """Its arguments may be secret, and errors go to the journal."""
    assert shown(value, "avckpt.notify") == means
    error = LabelError("avckpt.notify", value, "wrong", "allowed: right")
    assert "password" not in str(error)
    assert f"avckpt.notify={means}" in str(error)
