# SPDX-License-Identifier: Apache-2.0
"""See the package."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from testkit.answers.servers import SERVERS, missing
from testkit.answers.trial import run


def main() -> int:
    """1 if any answer was another request's."""
    parser = argparse.ArgumentParser(prog="python -m testkit.answers", description=__doc__)
    parser.add_argument("servers", nargs="*", default=list(SERVERS), help="%(default)s")
    parser.add_argument("--requests", type=int, default=20_000, help="of each server (%(default)s)")
    parser.add_argument("--tcp", help="avckpt.tcp; left out: the default")
    parser.add_argument("--seed", type=int, default=1, help="%(default)s")
    asked = parser.parse_args()
    wrong = 0
    for server in asked.servers:
        if why := missing(server):
            print(f"{server}: {why}")
            continue
        with tempfile.TemporaryDirectory() as folder:
            labels = {"avckpt.tcp": asked.tcp} if asked.tcp else {}
            outcome = run(server, asked.requests, Path(folder), labels, asked.seed)
        print(outcome, flush=True)
        wrong += len(outcome.wrong)
    return int(wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main())
