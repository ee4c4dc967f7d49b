# SPDX-License-Identifier: Apache-2.0
"""The programs: how each is started, and who its client is."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass

from testkit.harness import BASE_IMAGE, ROOT, Podman
from testkit.programs import nginx, redis
from testkit.programs.lines import LineSession
from testkit.programs.wire import Session

IMAGE = "localhost/avckpt-programs:latest"
"""Has all of them; scripts/setup-programs.sh makes it."""
SOURCES = ROOT / "testkit/programs"
BUILD = ROOT / "build/programs"


@dataclass(frozen=True)
class Program:
    """A real program."""

    name: str
    title: str
    command: tuple[str, ...]
    version: tuple[str, ...]
    """Prints its version."""
    session: type[Session] = LineSession
    in_base: bool = False
    """Whether the base image has all it needs."""
    compiled: str = ""
    """A C++ source that the host's compiler makes static, for the base image."""


def compiled_by(path: str, pattern: str) -> tuple[str, ...]:
    """A command that prints what a compiler has left of itself in a program."""
    return ("python3", "-c", f"import re; print(re.search(rb'{pattern}', open('{path}', 'rb').read())[0].decode())")


PROGRAMS = (
    Program("redis", "redis-server", redis.COMMAND, ("redis-server", "--version"), redis.RedisSession, in_base=True),
    Program("nginx", "nginx (one process)", nginx.COMMAND, ("nginx", "-v"), nginx.NginxSession),
    Program(
        *("asyncio", "CPython asyncio", ("python3", "/sources/server_asyncio.py"), ("python3", "--version")),
        in_base=True,
    ),
    Program(
        *("threads", "CPython threads", ("python3", "/sources/server_threads.py"), ("python3", "--version")),
        in_base=True,
    ),
    Program("node", "Node.js", ("node", "/sources/server_node.js"), ("node", "--version")),
    Program("go", "Go", ("/programs/server_go",), compiled_by("/programs/server_go", r"go1\.[0-9.]+")),
    Program("jvm", "JVM", ("java", "-Xmx256m", "-cp", "/programs", "ServerJvm"), ("java", "--version")),
    Program(
        *("cpp", "C++", ("/programs/server_cpp",), compiled_by("/programs/server_cpp", r"GCC: [^\0]+")),
        compiled="server_cpp.cpp",
    ),
)


class Missing(Exception):
    """A program cannot be run here, and why."""


def find(name: str) -> Program:
    """Raises KeyError."""
    return {program.name: program for program in PROGRAMS}[name]


def place(program: Program, podman: Podman) -> tuple[str, list[str]]:
    """An image that has the program, and the options of `podman run` it needs.  Raises Missing."""
    options = ["--volume", f"{SOURCES}:/sources:ro"]
    if podman.run("image", "exists", IMAGE, check=False).status == 0:
        return IMAGE, options
    if program.in_base:
        return BASE_IMAGE, options
    if not program.compiled:
        raise Missing(f"no {program.title} here: `make test-programs` builds {IMAGE}, which has it")
    if shutil.which("c++") is None:
        raise Missing("no C++ compiler on this machine (Debian's g++)")
    BUILD.mkdir(parents=True, exist_ok=True)
    built = BUILD / program.compiled.removesuffix(".cpp")
    source = SOURCES / program.compiled
    if not built.exists() or built.stat().st_mtime < source.stat().st_mtime:
        command = ["c++", "-std=c++20", "-O2", "-pthread", "-static", "-o", f"{built}.new", str(source)]
        subprocess.run(command, check=True)
        built.with_name(f"{built.name}.new").replace(built)
    return BASE_IMAGE, [*options, "--volume", f"{BUILD}:/programs:ro"]
