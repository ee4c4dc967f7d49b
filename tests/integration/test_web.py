# SPDX-License-Identifier: Apache-2.0
"""`avckpt web` in a real browser: headless Chromium, by its own driver."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from email.message import Message
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from avckpt.cli.client import _UnixConnection
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By

from testkit.harness import avckpt_command, wait_until
from testkit.local_sidecar import LocalSidecar, local_sidecar

SLEEPER = ["sleep", "1000"]
LABELS = {"avckpt.enable": "true", "avckpt.interval": "500ms", "avckpt.group": "drive"}
PATIENCE_S = 60
pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="the engine needs root")


@dataclass
class Site:
    """A running `avckpt web`."""

    url: str
    process: subprocess.Popen[str]

    @property
    def token(self) -> str:
        return urlsplit(self.url).fragment.partition("=")[2]

    @property
    def port(self) -> int:
        port = urlsplit(self.url).port
        assert port is not None
        return port

    def ask(self, path: str, method: str = "GET", **headers: str) -> tuple[int, str]:
        """Status and body; with the token unless `headers` has an Authorization."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        with contextlib.closing(connection):
            connection.request(method, path, headers={"Authorization": f"Bearer {self.token}", **headers})
            answer = connection.getresponse()
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
            return answer.status, answer.read().decode()


@contextlib.contextmanager
def site(local: LocalSidecar, *options: str) -> Iterator[Site]:
    process = subprocess.Popen(
        [*avckpt_command(), "web", "--port", "0", *options],
        env={**os.environ, **local.env},
        stdout=subprocess.PIPE,
        stderr=local.run_dir.with_name("web.err").open("w"),
        text=True,
    )
    try:
        assert process.stdout is not None
        yield Site(process.stdout.readline().strip(), process)
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 0


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[webdriver.Chrome]:
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    assert binary, "chromium is missing: make test installs it"
    assert driver, "chromium-driver is missing: make test installs it"
    options = Options()
    options.binary_location = binary
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--window-size=1400,1500",
        f"--user-data-dir={tmp_path}/chromium",
    ):
        options.add_argument(argument)
    made = webdriver.Chrome(options=options, service=Service(driver))
    try:
        yield made
    finally:
        made.quit()


def texts(browser: webdriver.Chrome, selector: str) -> list[str]:
    """The texts of all matching elements in one call, since the page may redraw at any time."""
    found: list[str] = browser.execute_script(
        "return [...document.querySelectorAll(arguments[0])].map((each) => each.textContent)", selector
    )
    return found


def wait_text(browser: webdriver.Chrome, selector: str, part: str) -> None:
    wait_until(lambda: any(part in text for text in texts(browser, selector)), PATIENCE_S, f"{selector}: {part}")


@pytest.mark.shared_machine("a browser on a busy machine may take longer than its driver waits")
def test_the_page_shows_a_crash_live(local: LocalSidecar, browser: webdriver.Chrome) -> None:
    lidar, planner = (local.protected(name, SLEEPER, LABELS) for name in ("lidar", "planner"))
    for each in (lidar, planner):
        local.wait_for(each, state="protected")
    with site(local) as page:
        browser.get(page.url)
        wait_text(browser, "#link", "live")
        assert "token" not in browser.current_url
        wait_text(browser, "#tiles", "2 of 2")
        assert texts(browser, "#names div")[1:] == ["lidar", "planner"]
        os.kill(lidar.app_pid, signal.SIGSEGV)
        wait_text(browser, "#crashes td", "killed by SIGSEGV, restored in")
        browser.execute_script("document.querySelector('#crashes tbody tr').click()")
        wait_text(browser, "#detail h2", "lidar: restored")
        wait_text(browser, "#detail li", "lidar: died: killed by SIGSEGV")
        wait_text(browser, "#plots", "Restore death to running again1 measured")
        browser.execute_script(
            "const find = document.getElementById('find'); find.value = 'plan'; find.dispatchEvent(new Event('input'))"
        )
        wait_until(lambda: texts(browser, "#names div")[1:] == ["planner"], PATIENCE_S, "only what is looked for")
        # Read only: no button that does anything.
        assert texts(browser, "#units button") == []
        assert browser.get_log("browser") == []  # type: ignore[no-untyped-call]


@pytest.mark.shared_machine("a browser on a busy machine may take longer than its driver waits")
def test_the_page_goes_on_with_the_next_sidecar(local: LocalSidecar, browser: webdriver.Chrome) -> None:
    local.wait_for(local.protected("lidar", SLEEPER, LABELS), state="protected")
    with site(local) as page:
        browser.get(page.url)
        wait_text(browser, "#link", "live")
        local.stop()
        wait_text(browser, "#link", "the sidecar")
        local.start()
        wait_text(browser, "#link", "live")
        wait_text(browser, "#units td", "lidar")


@pytest.mark.shared_machine("a browser on a busy machine may take longer than its driver waits")
def test_the_page_gives_commands_when_it_may(local: LocalSidecar, browser: webdriver.Chrome) -> None:
    lidar = local.protected("lidar", SLEEPER, {**LABELS, "avckpt.interval": "1h"})
    with site(local, "--control") as page:
        browser.get(page.url)
        wait_text(browser, "#units button", "Roll back")
        browser.execute_script("window.confirm = () => true")
        browser.find_element(By.XPATH, "//table[@id='units']//button[text()='Checkpoint']").click()
        local.wait_for(lidar, state="protected")
        browser.find_element(By.XPATH, "//table[@id='units']//button[text()='Roll back']").click()
        wait_text(browser, "#crashes td", "rolled back on command")


@pytest.mark.shared_machine("a browser on a busy machine may take longer than its driver waits")
def test_a_page_that_was_first_learns_what_it_may(local: LocalSidecar, browser: webdriver.Chrome) -> None:
    """Opened while there was no sidecar: it may give commands all the same."""
    with site(local, "--control") as page:
        local.stop()
        browser.get(page.url)
        wait_text(browser, "#link", "the sidecar")
        local.start()
        local.protected("lidar", SLEEPER, LABELS)
        wait_text(browser, "#units button", "Roll back")
        wait_text(browser, "#sidecar", "since")


@pytest.mark.shared_machine("a browser on a busy machine may take longer than its driver waits")
@pytest.mark.parametrize("chosen", ["#crashes tbody tr", "#units button"])
def test_what_is_in_hand_stays_where_it_is(local: LocalSidecar, browser: webdriver.Chrome, chosen: str) -> None:
    """The focus, when the tables change: rows are not made anew."""
    lidar = local.protected("lidar", SLEEPER, LABELS)
    local.wait_for(lidar, state="protected")
    with site(local, "--control") as page:
        browser.get(page.url)
        os.kill(lidar.app_pid, signal.SIGSEGV)
        wait_text(browser, "#crashes td", "killed by SIGSEGV, restored in")
        wait_text(browser, chosen, "")
        browser.execute_script(f"window.chosen = document.querySelector('{chosen}'); chosen.focus()")
        before = len(texts(browser, "#crashes tr"))
        local.protected("later", SLEEPER, LABELS)
        wait_text(browser, "#units td", "later")
        local.wait_for(lidar, state="protected")
        os.kill(lidar.app_pid, signal.SIGSEGV)
        wait_until(lambda: len(texts(browser, "#crashes tr")) > before, PATIENCE_S, "one crash more")
        assert browser.execute_script("return document.activeElement === window.chosen")


@pytest.mark.shared_machine("a browser on a busy machine may take longer than its driver waits")
def test_a_launcher_is_no_unit_that_lacks_protection(local: LocalSidecar, browser: webdriver.Chrome) -> None:
    for name in ("unit10", "unit9"):  # told in the order of their numbers
        local.wait_for(local.protected(name, SLEEPER, LABELS), state="protected")
    launcher = local.protected("car", SLEEPER, {"avckpt.enable": "true", "avckpt.scope": "nodes"})
    local.wait_for(launcher, state="nodes")
    with site(local, "--control") as page:
        browser.get(page.url)
        wait_text(browser, "#units td", "car")
        wait_text(browser, "#tiles", "2 of 2")
        rows = browser.execute_script(
            "const rows = [...document.querySelectorAll('#units tbody tr')];"
            "return rows.map((row) => [...row.cells].map((cell) => cell.textContent))"
        )
        assert [(row[0], row[3] == "-", bool(row[9])) for row in rows] == [
            ("car", True, False),
            ("unit9", False, True),
            ("unit10", False, True),
        ]


@pytest.mark.shared_machine("a browser on a busy machine may take longer than its driver waits")
def test_crashes_stay_when_checkpoints_are_many(local: LocalSidecar, browser: webdriver.Chrome) -> None:
    with site(local) as page:
        browser.get(page.url)
        left = browser.execute_async_script(
            """
            const done = arguments[arguments.length - 1];
            import("/kept.js").then(({kept}) => {
              const routine = (n) => Array.from({length: n}, () => ({seq: 0}));
              const all = [{seq: 1}, ...routine(50), {seq: 2}, ...routine(50)];
              const stored = Array.from({length: 101}, (_, n) => ({seq: n + 1}));
              done([all.slice(0, 100), all, stored].map((each) => kept(each, 100)).map(
                (each) => [each.length, each.filter((one) => one.seq).length, each.at(-1).seq]));
            });
            """
        )
        assert left == [[100, 2, 0], [77, 2, 0], [76, 76, 101]]


@pytest.mark.shared_machine("a browser on a busy machine may take longer than its driver waits")
def test_without_the_token_there_is_a_form(local: LocalSidecar, browser: webdriver.Chrome) -> None:
    with site(local) as page:
        browser.get(page.url.partition("#")[0])
        wait_until(lambda: browser.find_element(By.ID, "login").is_displayed(), PATIENCE_S, "the form")
        browser.find_element(By.ID, "token").send_keys(page.token)
        browser.find_element(By.CSS_SELECTOR, "#login button").click()
        wait_text(browser, "#link", "live")


def test_strangers_get_nothing(local: LocalSidecar) -> None:
    with site(local) as page:
        status, body = page.ask("/v1/info")
        assert (status, json.loads(body)["containers"]) == (200, 0)
        for wrong in ("", "Bearer", f"Bearer {page.token}x", f"Basic {page.token}", "Bearer \u00e9"):
            assert page.ask("/v1/info", Authorization=wrong)[0] == 401
        assert page.ask("/metrics", Authorization="")[0] == 401
        # A name of somebody else's that resolves to us; a page of somebody else's.
        assert page.ask("/v1/info", Host=f"evil.example:{page.port}")[0] == 403
        assert page.ask("/", Host="evil.example")[0] == 403
        assert page.ask("/v1/info", Origin="http://evil.example")[0] == 403
        assert page.ask("/v1/info", Host=f"localhost:{page.port}", Origin=f"http://localhost:{page.port}")[0] == 200
        # Only what is named is passed on.
        for path in ("/v1/openapi.json", "/v1/reload", "/../etc/passwd", "/%2e%2e/server.py", "/server.py"):
            assert page.ask(path)[0] in (403, 404), path
        assert page.ask("/v1/reload", "POST")[0] == 404
        assert page.ask("/v1/containers/x/restore", "POST") == (
            403,
            '{"error": {"kind": "web", "message": "read only: start it with --control"}}',
        )
    with site(local, "--control", "--name", "vehicle.example") as page:
        assert page.ask("/v1/containers/x/restore", "POST", Host="vehicle.example")[0] == 404  # no such container


def test_it_answers_as_http_has_it(local: LocalSidecar) -> None:
    def headers(connection: http.client.HTTPConnection, method: str, path: str, token: str) -> tuple[int, Message]:
        with contextlib.closing(connection):
            connection.request(method, path, headers={"Authorization": f"Bearer {token}"})
            answer = connection.getresponse()
            return answer.status, answer.headers

    def api() -> http.client.HTTPConnection:
        return _UnixConnection(local.run_dir / "api.sock", PATIENCE_S)

    with site(local) as page:

        def web() -> http.client.HTTPConnection:
            return http.client.HTTPConnection("127.0.0.1", page.port, timeout=PATIENCE_S)

        metrics = headers(api(), "GET", "/metrics", "")[1]["Content-Type"]
        assert "version=" in metrics
        assert headers(web(), "GET", "/metrics", page.token)[1]["Content-Type"] == metrics
        assert headers(web(), "GET", "/metrics", "wrong")[1]["WWW-Authenticate"] == "Bearer"
        for connect in (api, web):
            for method, path, allowed in (("DELETE", "/v1/info", "GET,HEAD"), ("HEAD", "/v1/events", "GET")):
                status, said = headers(connect(), method, path, page.token)
                assert (status, said["Allow"]) == (405, allowed)


def test_strangers_keep_nobody_out_and_fill_no_log(local: LocalSidecar) -> None:
    with site(local) as served, contextlib.ExitStack() as held:
        resource.prlimit(served.process.pid, resource.RLIMIT_NOFILE, (64, 64))

        def say(text: bytes) -> None:
            connection = held.enter_context(socket.create_connection(("127.0.0.1", served.port)))
            connection.sendall(text)

        for _ in range(10):
            say(b"\x1b nonsense\r\n\r\n")
        for _ in range(100):
            say(b"GET / HT")
        assert served.ask("/v1/access")[0] == 200
        assert local.run_dir.with_name("web.err").read_text() == ""


def test_a_token_of_the_users_own(local: LocalSidecar, tmp_path: Path) -> None:
    file = tmp_path / "token"
    said = local.avckpt("web", "--token-file", str(file), check=False)
    assert said.status == 1
    assert f"make one: (umask 077; openssl rand -hex 24 > {file})" in said.stderr
    file.write_text("open-sesame-open-sesame\n")
    file.chmod(0o644)
    said = local.avckpt("web", "--port", "0", "--token-file", str(file), check=False)
    assert said.status != 0
    assert f"others may read {file}: chmod 600 {file}" in said.stderr
    file.chmod(0o600)
    with site(local, "--token-file", str(file)) as page:
        assert page.token == "open-sesame-open-sesame"
        assert page.ask("/v1/info")[0] == 200
    file.write_text("short\n")
    said = local.avckpt("web", "--port", "0", "--token-file", str(file), check=False)
    assert "holds no token" in said.stderr


def test_without_a_sidecar_it_says_so(tmp_path: Path) -> None:
    with local_sidecar(tmp_path) as nobody:
        said = nobody.avckpt("web", "--port", "0", check=False)
        assert said.status == 3
        assert "the sidecar is not running" in said.stderr
        assert "start it with: " in said.stderr
