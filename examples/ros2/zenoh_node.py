# SPDX-License-Identifier: Apache-2.0
"""A node as ROS 2's rmw_zenoh has them: sends at a fixed rate, and hears another one.  dds_node.c is the same on DDS.

    python3 zenoh_node.py --listen tcp/0.0.0.0:7447                     # protected
    python3 zenoh_node.py --connect tcp/ADDRESS:7447 --in from_node --out to_node --retry-ms 20

zenoh numbers the frames of a session.  What a node can do when its numbers have gone back with its memory:

    (nothing)               with avckpt.tcp=reset the connection ends at the restore; a peer that connects again soon
                            (--retry-ms, zenoh's connect/retry; its own default is 1 s) starts from new numbers
    --after-restore skip    sends as many fillers as there were messages since the checkpoint (kept.py); they must not
                            be batched (express), for numbers are those of frames

--log: for each message heard, 4 x 64 bits: now (CLOCK_MONOTONIC, ns), and its count, sent and heard.  Appended, so
that a restore does not overwrite what was written since its checkpoint.  Standard error tells each message that is not
the next one after the last one remembered: "after 41 came 43".
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import sys
import time
from typing import Any

import zenoh  # type: ignore[import-not-found,unused-ignore]
from kept import Kept  # type: ignore[import-not-found,unused-ignore]

FIELDS = struct.Struct("<3Q")
RECORD = struct.Struct("<4Q")
FILLER = FIELDS.pack(0, 0, 0)


class Node:
    """One session, one publisher, one subscriber."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.skip = options.after_restore == "skip"
        self.log = os.open(options.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND) if options.log else None
        self.padding = bytes(options.size)
        self.heard = 0
        self.heard_count = 0
        self.sent = 0
        self.kept = Kept()
        self.session = zenoh.open(configuration(options))
        self.publisher = self.session.declare_publisher(options.out, express=True)
        self.subscriber = self.session.declare_subscriber(options.topic_in, self.on_message)

    def on_message(self, sample: Any) -> None:
        """Called in one of zenoh's threads."""
        now = time.monotonic_ns()
        count, sent, heard = FIELDS.unpack_from(sample.payload.to_bytes())
        if count == 0:
            return
        self.heard = sent
        if self.heard_count and count != self.heard_count + 1:
            print(f"zenoh_node: after {self.heard_count} came {count}", file=sys.stderr, flush=True)
        self.heard_count = count
        if self.log is not None:
            os.write(self.log, RECORD.pack(now, count, sent, heard))

    def send(self) -> None:
        """One message, and before it what makes it new to the peer."""
        forgotten = self.kept.forgotten() if self.skip else 0
        for _ in range(forgotten):
            self.kept.count()
            self.publisher.put(FILLER)
        if forgotten:
            print(f"zenoh_node: skipped {forgotten} numbers", file=sys.stderr, flush=True)
        self.kept.count()
        self.sent += 1
        self.publisher.put(FIELDS.pack(self.sent, time.monotonic_ns(), self.heard) + self.padding)


def configuration(options: argparse.Namespace) -> Any:
    """A peer that knows whom to talk to, as rmw_zenoh's do."""
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([options.listen] if options.listen else []))
    if options.connect:
        config.insert_json5("connect/endpoints", json.dumps([options.connect]))
        config.insert_json5("connect/timeout_ms", "-1")
        config.insert_json5("connect/exit_on_failure", "false")
    if options.retry_ms:
        every = {
            "period_init_ms": options.retry_ms,
            "period_max_ms": options.retry_ms,
            "period_increase_factor": 1,
        }
        config.insert_json5("connect/retry", json.dumps(every))
    return config


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--listen", default="")
    parser.add_argument("--connect", default="")
    parser.add_argument("--retry-ms", type=int, default=0)
    parser.add_argument("--in", dest="topic_in", default="to_node")
    parser.add_argument("--out", default="from_node")
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--size", type=int, default=0)
    parser.add_argument("--after-restore", choices=("none", "skip"), default="none")
    parser.add_argument("--log", default="")
    options = parser.parse_args()
    zenoh.init_log_from_env_or("error")
    node = Node(options)
    period = int(1e9 / options.rate)
    due = time.monotonic_ns()
    print("zenoh_node: ready", file=sys.stderr, flush=True)
    while True:
        time.sleep(max(0, due - time.monotonic_ns()) / 1e9)
        node.send()
        due += period
        # As a ROS timer: ticks that were missed are not made up for.
        late = time.monotonic_ns() - due
        if late > 0:
            due += late // period * period + period


if __name__ == "__main__":
    main()
