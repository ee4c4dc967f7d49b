# SPDX-License-Identifier: Apache-2.0
"""Fuzzes parsers of input from containers, hooks and files: `make fuzz SECONDS=60`.

    python -m tests.fuzz [--seconds N] [NAME...]      each target for so long, one after the other

Targets are the functions of targets.py (atheris), the programs of *.c (libFuzzer), and `parasite`:
a victim that writes at random into the memory that it shares with its guard.  What leads somewhere
new is kept in build/fuzz/NAME for the next time, what fails in build/fuzz/found.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
HERE = ROOT / "tests" / "fuzz"
KEPT = ROOT / "build" / "fuzz"
FOUND = KEPT / "found"
PARASITE = "parasite"
C_TARGETS = sorted(path.stem for path in HERE.glob("*.c") if path.stem not in ("seeds", "rubbish"))
PATIENCE_S = 20
"""For one input."""
BUILD_S = 400
"""For the guard with sanitizers, which is built first, and the last victim, on a busy machine."""


def fuzz_python(name: str, arguments: list[str]) -> None:
    """One target under atheris, in this process; does not return."""
    import atheris

    with atheris.instrument_imports(include=["avckpt", "avckpt_hooks"]):
        from tests.fuzz.targets import TARGETS
    atheris.Setup([name, *arguments], TARGETS[name])
    atheris.Fuzz()


def command(name: str, seconds: int) -> list[str]:
    """What fuzzes a target for so long."""
    if name == PARASITE:
        test = "tests/native/test_engine_sanitized.py"
        return [sys.executable, "-m", "pytest", "-q", test, "-k", "at_random", "--timeout", str(seconds + BUILD_S)]
    program = [str(HERE / "build" / name)] if name in C_TARGETS else [sys.executable, "-m", "tests.fuzz", "--one", name]
    (KEPT / name).mkdir(parents=True, exist_ok=True)
    FOUND.mkdir(exist_ok=True)
    return [
        *program,
        f"-max_total_time={seconds}",
        f"-timeout={PATIENCE_S}",
        "-max_len=8192",
        "-rss_limit_mb=2048",
        "-print_final_stats=1",
        f"-artifact_prefix={FOUND}/{name}-",
        str(KEPT / name),
        str(HERE / "corpus" / name),
    ]


def fuzz(name: str, seconds: int) -> bool:
    """Whether nothing was found."""
    started = time.monotonic()
    env = {**os.environ, "AVCKPT_FUZZ_S": str(seconds)}
    done = subprocess.run(
        command(name, seconds), cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    runs = [line.split()[1] for line in done.stdout.splitlines() if line.startswith("stat::number_of_executed_units")]
    what = f"{runs[0]} inputs" if runs else "no inputs counted"
    print(f"{name:16} {time.monotonic() - started:5.0f} s  {'fine' if done.returncode == 0 else 'FAILED'}, {what}")
    if done.returncode != 0:
        print(done.stdout[-6000:])
    sys.stdout.flush()
    return done.returncode == 0


def names() -> list[str]:
    """All targets."""
    from tests.fuzz.targets import TARGETS

    return [*C_TARGETS, PARASITE, *TARGETS]


def main() -> int:
    """See above."""
    if sys.argv[1:2] == ["--one"]:
        fuzz_python(sys.argv[2], sys.argv[3:])
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=int, default=60, help="for each target (60)")
    parser.add_argument("names", nargs="*", help="targets (all)")
    args = parser.parse_args()
    wanted = args.names or names()
    if set(wanted) & set(C_TARGETS):
        subprocess.run(["make", "-s", "-C", str(HERE)], check=True)
    failed = [name for name in wanted if not fuzz(name, args.seconds)]
    if failed:
        print(f"found something: {', '.join(failed)}; the inputs are in {FOUND}")
        print("mend it, and keep the input as a seed: tests/fuzz/corpus/NAME (CONTRIBUTING.md)")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
