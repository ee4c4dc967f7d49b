# SPDX-License-Identifier: Apache-2.0
"""Programs of Debian as their packages have them: how many of 15 kills each survives, in service.

    podman build --network=host -t localhost/avckpt-services testkit/services
    .venv/bin/python -m bench.services [--kills 15] [--services mosquitto,apache2]

Each runs in a protected container, with a checkpoint every 100 ms, while a
client asks it in a loop, from a container that shares its network; those of
databases are inside.  A round is a checkpoint, a random wait up to
0.3 s and SIGKILL.  After it the service has to answer a new client rightly, or
to go on with its computation.  Databases have `--restart=on-failure`: they may
be restored or started cold, and what they have acknowledged must be there.

Needs root and Podman.  Takes the machine's sidecar and hooks for itself.
Prints a table and writes bench/results/services.json.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from avckpt.cli.client import Client, Json
from avckpt.errors import AvckptError
from avckpt.guard import Command

from testkit.harness import (
    ROOT,
    RUN_DIR,
    CommandFailed,
    Container,
    ContainerFactory,
    Podman,
    machine_lock,
    running_sidecar,
    wait_until,
)

IMAGE = "localhost/avckpt-services:latest"
RESULTS = ROOT / "bench" / "results" / "services.json"
SOURCES = ROOT / "testkit" / "services"
WAIT_S = 0.3
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Service:
    """One program."""

    name: str
    title: str
    start: str
    """A shell's; ends with `exec`."""
    ask: str = ""
    """A shell's, of the client: fails if the service does not serve.  Empty: it computes, and its log grows."""
    labels: dict[str, str] = field(default_factory=dict)
    options: tuple[str, ...] = ()
    is_database: bool = False
    """May be started cold."""


HELLO = "2cf24dba5fb0a30e26e83b2ac5b9e29e1b161e5c1fa7425e73043362938b9824"  # sha256
REGISTRY = (
    "U=$(curl -fsS -X POST -D - localhost:5000/v2/a/blobs/uploads/ | awk '/^Location/ { print $2 }' | tr -d '\\r')"
    f' && curl -fsS -X PUT -H Content-Type:application/octet-stream --data-binary hello "$U&digest=sha256:{HELLO}"'
    f" && curl -fsS localhost:5000/v2/a/blobs/sha256:{HELLO} | grep -q hello"
)
HAPROXY = (
    "printf 'defaults\\n mode http\\n timeout client 5s\\n timeout connect 5s\\n timeout server 5s\\n"
    "frontend f\\n bind :80\\n default_backend b\\nbackend b\\n server s 127.0.0.1:81\\n"
    "frontend g\\n bind :81\\n http-request return status 200 content-type text/plain string hello\\n' > /tmp/h.cfg"
)
APACHE = ". /etc/apache2/envvars && mkdir -p $APACHE_RUN_DIR && exec apache2 -DFOREGROUND"
MEMCACHED = "printf 'set k 0 0 5\\r\\nhello\\r\\nget k\\r\\nquit\\r\\n' | curl -s telnet://localhost:11211"
MARIADB = (
    "mkdir -p /run/mysqld && chown mysql: /run/mysqld"
    " && { [ -d /var/lib/mysql/bank ] || mariadb-install-db --user=mysql >/dev/null; }"
    " && exec mariadbd --user=mysql --skip-networking --socket=/run/mysqld/mysqld.sock"
)
SQL = "mariadb -N --connect-timeout=5 -e"
BANK = (
    f'{SQL} "create database if not exists bank; create table if not exists bank.t (n int primary key) engine=innodb"'
    f' && n=$(cat /acknowledged 2>/dev/null || echo 0) && {SQL} "replace into bank.t values ($n + 1)"'
    " && echo $((n + 1)) > /acknowledged.new && mv /acknowledged.new /acknowledged"
)
BANK_CHECK = (
    f'set -- $({SQL} "select count(*), max(n) from bank.t"); [ "$1" = "$2" ] && [ "$2" -ge $(cat /acknowledged) ]'
    f' && {SQL} "check table bank.t extended" | grep -q OK'
)
ETCD = (
    "n=$(cat /acknowledged 2>/dev/null || echo 0) && ETCDCTL_API=3 etcdctl put k$((n + 1)) v >/dev/null"
    " && echo $((n + 1)) > /acknowledged.new && mv /acknowledged.new /acknowledged"
)
ETCD_CHECK = "n=$(cat /acknowledged) && [ $(ETCDCTL_API=3 etcdctl get --prefix k --keys-only | grep -c k) -ge $n ]"
MAKE = (
    "mkdir -p /tmp/m && cd /tmp/m && printf '"
    "all: $(foreach n,$(shell seq 3000),$n.o)\\n\\tcat *.o | sha256sum > sum && echo built; sleep 1000\\n"
    "%%.o:\\n\\tsleep 0.05; t=$$(mktemp) && seq $* > $$t && sort $$t > $@.new && mv $@.new $@ && rm $$t\\n' > Makefile"
    " && exec make -s -j4"
)

SERVICES = (
    Service(
        *("mosquitto", "mosquitto", "exec mosquitto"),
        "t=t$$; mosquitto_pub -t $t -r -m hello && mosquitto_sub -t $t -C 1 -W 9 | grep -q hello",
    ),
    Service("memcached", "memcached", "exec memcached -u nobody -t 4", f"{MEMCACHED} | grep -q hello"),
    Service(
        *("prometheus", "prometheus"),
        "exec prometheus --config.file=/etc/prometheus/prometheus.yml --storage.tsdb.path=/tmp/p",
        "curl -fsS 'localhost:9090/api/v1/query?query=up' | grep -q success",
    ),
    Service(
        "registry",
        "docker-registry",
        "sed '/^auth/,/path:/d' /etc/docker/registry/config.yml > /tmp/r.yml && exec docker-registry serve /tmp/r.yml",
        REGISTRY,
    ),
    Service("haproxy", "haproxy", f"{HAPROXY} && exec haproxy -f /tmp/h.cfg", "curl -fsS localhost | grep -q hello"),
    Service("apache2", "apache2 (event)", APACHE, "curl -fsS localhost | grep -q Apache2"),
    Service(
        *("apache2-prefork", "apache2 (prefork)"),
        f"a2dismod -q mpm_event && a2enmod -q mpm_prefork && {APACHE}",
        "curl -fsS localhost | grep -q Apache2",
    ),
    Service(
        *("php-fpm", "php-fpm"),
        "echo '<?php echo \"hello\";' > /tmp/a.php && mkdir -p /run/php && "
        "sed -i 's/^listen = .*/listen = 9000/' /etc/php/8.2/fpm/pool.d/www.conf && exec php-fpm8.2 -F",
        "SCRIPT_FILENAME=/tmp/a.php REQUEST_METHOD=GET cgi-fcgi -bind -connect localhost:9000 | grep hello",
        labels={"shm": "256MB"},  # of its opcode cache
    ),
    Service(
        *("nginx", "nginx (a worker for each CPU)", "exec nginx -g 'daemon off;'"),
        "curl -fsS localhost | grep -q '<html'",
    ),
    Service("redis", "redis-server", "exec redis-server --save ''", "redis-cli incr n | grep -q ."),
    Service("torch", "PyTorch", "exec python3 /sources/compute.py torch"),
    Service("onnx", "ONNX Runtime", "exec python3 /sources/compute.py onnx"),
    Service("opencv", "OpenCV", "exec python3 /sources/compute.py opencv"),
    Service("openblas", "NumPy with OpenBLAS", "exec python3 /sources/compute.py openblas"),
    Service("openmp", "OpenMP", "g++ -O2 -fopenmp -o /tmp/p /sources/parallel.cpp && exec /tmp/p"),
    Service("tbb", "TBB", "g++ -O2 -DTBB -o /tmp/p /sources/parallel.cpp -ltbb && exec /tmp/p"),
    Service(
        *("gstreamer", "GStreamer"),
        "exec gst-launch-1.0 -v videotestsrc is-live=true ! videoconvert ! identity silent=false ! fakesink",
    ),
    Service(
        *("ffmpeg", "ffmpeg"),
        "exec ffmpeg -loglevel error -re -f lavfi -i testsrc -c:v mpeg4 -f null -progress pipe:1 -",
    ),
    Service(
        *("mariadb", "MariaDB", MARIADB, BANK),
        labels={"io_uring": "off"},
        is_database=True,
    ),
    Service("etcd", "etcd", "exec etcd --data-dir /tmp/e", ETCD, is_database=True),
    Service("make", "make -j4", MAKE, "sleep 0.1; [ -e /tmp/m/1.o ]", is_database=True),
)
CHECKS = {
    "mariadb": BANK_CHECK,
    "etcd": ETCD_CHECK,
    "make": """cd /tmp/m && python3 -c "
import glob
for o in glob.glob('*.o'):
    assert open(o).read().split() == sorted(map(str, range(1, int(o[:-2]) + 1))), o
\"""",
}
"""What was acknowledged is there."""


@dataclass
class Outcome:
    """What came of a service's kills.  Times in ms, the median."""

    service: str
    kills: int = 0
    restored: int = 0
    cold: int = 0
    failures: list[str] = field(default_factory=list)
    threads: int = 0
    freeze_ms: list[float] = field(default_factory=list)
    restore_ms: list[float] = field(default_factory=list)
    version: str = ""
    begun: str = ""
    load: float = 0.0


class Failed(Exception):
    """Why a kill was not survived."""


def rounds(service: Service, kills: int, podman: Podman, outcome: Outcome) -> None:
    """All kills of one service.  Raises Failed with the first that it does not survive."""
    with running(service, podman) as (container, asker):
        client, rng = Client(RUN_DIR), random.Random(1)
        for _ in range(kills):
            checkpoint(client, container)
            time.sleep(rng.uniform(0, WAIT_S))
            before = row_of(client, container)
            outcome.threads = max(outcome.threads, before["threads"])
            outcome.freeze_ms.append(before["last_freeze_s"] * 1000)
            outcome.kills += 1
            os.kill(before["app_pid"], signal.SIGKILL)
            after = wait_back(client, container, before)
            if after["init_pid"] != before["init_pid"]:
                outcome.cold += 1
                ask_always(service, asker)  # the one before has ended with the container
            else:
                outcome.restored += 1
                outcome.restore_ms.append(after["last_restore_s"] * 1000)
            wait_serves(service, container, asker)
            late = row_of(client, container)
            if not service.is_database and late["restores"] != outcome.restored:
                raise Failed(f"it died by itself: {late['last_death']}: {tail(container)}")
        if service.name == "make":
            container.wait_for_log("built", 600)
            wait_serves(service, container, asker)


@contextlib.contextmanager
def running(service: Service, podman: Podman) -> Iterator[tuple[Container, Container]]:
    """It serves, a client asks it all the time: its container, and where commands of clients run."""
    factory = ContainerFactory(podman, f"avckpt-service-{service.name}-{os.getpid()}")
    options = ["--volume", f"{SOURCES}:/sources:ro", *service.options]
    if service.is_database:
        options.append("--restart=on-failure")
    try:
        labels = {"interval": "100ms", "restore.max": "60/1s", **service.labels}
        container = factory.protected("sh", "-c", service.start, labels=labels, options=options, image=IMAGE)
        asker = container
        if service.ask and not service.is_database:
            asker = factory("sleep", "inf", options=[f"--network=container:{container.name}"], image=IMAGE)
        wait_serves(service, container, asker)
        ask_always(service, asker)
        yield container, asker
    finally:
        factory.close()


def ask_always(service: Service, asker: Container) -> None:
    """Goes on, whatever becomes of what it asks."""
    if service.ask:
        loop = f"while :; do {service.ask}; done >&- 2>&-"
        asker.podman.run("exec", "--detach", asker.name, "sh", "-c", loop)


def row_of(client: Client, container: Container) -> Json:
    """Its entry in `avckpt ps`.  Raises Failed."""
    for row in client.containers(ended=True):
        if row["id"] == container.id and row["state"] != "ended":
            return row
    raise Failed(f"the sidecar knows no such container that runs: {tail(container)}")


def wait_back(client: Client, container: Container, before: Json) -> Json:
    """Its entry when it is restored, or started anew.  Raises Failed."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        with contextlib.suppress(Failed):
            row = row_of(client, container)
            if row["init_pid"] != before["init_pid"] or row["restores"] > before["restores"]:
                return row
        time.sleep(0.02)
    raise Failed(f"it does not come back: {tail(container)}")


def checkpoint(client: Client, container: Container) -> None:
    """One on command.  Raises Failed."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            client.command(container.id, Command.CHECKPOINT)
            return
        except AvckptError as error:
            if time.monotonic() > deadline:
                raise Failed(f"no checkpoint: {error}") from error
            time.sleep(0.2)


def wait_serves(service: Service, container: Container, asker: Container) -> None:
    """Raises Failed."""
    if not service.ask:
        # What it prints is looked at, too.
        size = len(container.logs())
        try:
            wait_until(lambda: len(container.logs()) > size, PATIENCE_S, "it goes on")
        except TimeoutError as error:
            raise Failed(f"{error}: {tail(container)}") from error
        if "WRONG" in container.logs():
            raise Failed("it computes something else")
    for command in (service.ask, CHECKS.get(service.name, "")):
        if not command:
            continue
        deadline = time.monotonic() + PATIENCE_S
        while (said := inside(asker, command)) is not None:
            if time.monotonic() > deadline:
                raise Failed(f"it does not serve ({said}): {tail(container)}")
            time.sleep(0.1)


def inside(container: Container, command: str) -> str | None:
    """What a command said that failed in there; None: it did not."""
    try:
        done = container.podman.run("exec", container.name, "timeout", "30", "sh", "-c", command, check=False)
    except CommandFailed as error:
        return str(error)
    return None if done.status == 0 else f"{done.status} {(done.stdout + done.stderr).strip()[-200:]}"


def tail(container: Container) -> str:
    """The end of its log, and of what was told of it."""
    with contextlib.suppress(AvckptError):
        told = [event for event in Client(RUN_DIR).history() if event.get("id") == container.id]
        return f"{container.logs()[-300:]} {[event['message'] for event in told[-6:]]}"
    return container.logs()[-300:]


def table(rows: list[Json]) -> str:
    """For docs/fidelity.md."""
    lines = ["| program | threads | kills | restored | cold | failed | freeze | restore |"]
    lines.append("|---|---:|---:|---:|---:|---:|---:|---:|")
    titles = {service.name: service.title for service in SERVICES}
    for row in rows:
        times = [f"{statistics.median(row[name] or [0]):.1f}" for name in ("freeze_ms", "restore_ms")]
        counts = [row["threads"], row["kills"], row["restored"], row["cold"]]
        cells = [titles[row["service"]], *counts, len(row["failures"]), *times]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--kills", type=int, default=15)
    parser.add_argument("--services", type=lambda text: text.split(","), default=[s.name for s in SERVICES])
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    podman = Podman()
    failed = False
    for service in SERVICES:
        if service.name not in options.services:
            continue
        outcome = Outcome(service.name, begun=datetime.now(UTC).isoformat(timespec="minutes"))
        with machine_lock(timeout_s=3600), running_sidecar(podman):
            try:
                rounds(service, options.kills, podman, outcome)
            except (Failed, CommandFailed, TimeoutError) as error:
                failed = True
                outcome.failures.append(str(error))
        outcome.load = round(os.getloadavg()[0], 1)
        said = f"{outcome.restored} restored, {outcome.cold} cold of {outcome.kills}; {outcome.failures}"
        print(f"{service.name}: {said}", flush=True)
        rows = json.loads(options.output.read_text()) if options.output.exists() else []
        rows = [*(row for row in rows if row["service"] != service.name), asdict(outcome)]
        order = [each.name for each in SERVICES]
        rows.sort(key=lambda row: order.index(row["service"]))
        options.output.write_text(json.dumps(rows, indent=1) + "\n")
    print(table(json.loads(options.output.read_text())))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
