# SPDX-License-Identifier: Apache-2.0
"""The servers: how each is started below avckpt-init.  nginx and haproxy pass half or all on to a backend."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from testkit.harness import ROOT, free_port, wait_until

PREFORK = ROOT / "testkit/answers/server_prefork.py"

NGINX = """
daemon off;
user root;
worker_processes 2;
error_log stderr crit;
pid {folder}/nginx.pid;
events {{ worker_connections 256; }}
http {{
    access_log off;
    client_body_temp_path {folder};
    proxy_temp_path {folder};
    fastcgi_temp_path {folder};
    uwsgi_temp_path {folder};
    scgi_temp_path {folder};
    keepalive_requests 1000000;
    default_type text/plain;
    upstream backend {{ server 127.0.0.1:{backend}; keepalive 8; }}
    server {{
        listen 127.0.0.1:{port};
        location ~ [02468]$ {{ return 200 "$uri"; }}
        location / {{
            proxy_pass http://backend;
            proxy_http_version 1.1;
            proxy_set_header Connection "";
        }}
    }}
}}
"""

HAPROXY = """
global
    nbthread 2
    stats socket {folder}/haproxy.sock
defaults
    mode http
    timeout connect 1s
    timeout client 1m
    timeout server 1m
    http-reuse always
frontend all
    bind 127.0.0.1:{port}
    default_backend one
backend one
    server one 127.0.0.1:{backend} pool-max-conn 8
"""

Command = Callable[[Path, int, int], list[str]]
"""Folder, port and the backend's port to a command line."""


def _nginx(folder: Path, port: int, backend: int) -> list[str]:
    path = folder / "nginx.conf"
    path.write_text(NGINX.format(folder=folder, port=port, backend=backend))
    return [str(shutil.which("nginx")), "-e", "stderr", "-c", str(path)]


def _haproxy(folder: Path, port: int, backend: int) -> list[str]:
    path = folder / "haproxy.cfg"
    path.write_text(HAPROXY.format(folder=folder, port=port, backend=backend))
    return [str(shutil.which("haproxy")), "-db", "-f", str(path)]


def _prefork(folder: Path, port: int, backend: int) -> list[str]:
    return [sys.executable, str(PREFORK), str(port)]


SERVERS: dict[str, Command] = {"nginx": _nginx, "haproxy": _haproxy, "prefork": _prefork}


def missing(name: str) -> str:
    """Why it cannot be run here; empty if it can."""
    return "" if name == "prefork" or shutil.which(name) else f"no {name} on this machine"


@contextlib.contextmanager
def backend() -> Iterator[int]:
    """An unprotected server for proxies; its port."""
    port = free_port()
    process = subprocess.Popen([sys.executable, str(PREFORK), str(port)], start_new_session=True)
    try:
        wait_answers(port)
        yield port
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def wait_answers(port: int) -> None:
    """Until somebody listens."""

    def connects() -> bool:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
            return True
        return False

    wait_until(connects, 20, f"somebody listens on port {port}", every_s=0.02)
