# SPDX-License-Identifier: Apache-2.0
"""The pictures in docs/images: `avckpt top` and `avckpt web` of eight units, some of which crash.

python -m scripts.screenshots
"""

from __future__ import annotations

import asyncio
import os
import random
import re
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from avckpt.cli.client import Client
from avckpt.cli.top import Top
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service

from testkit.harness import ROOT, avckpt_command, wait_until
from testkit.local_sidecar import Container, LocalSidecar, local_sidecar

IMAGES = ROOT / "docs" / "images"
UNITS = ("lidar", "camera-front", "camera-rear", "localization", "map", "planner", "control", "diagnostics")
CRASHES = 12
DEADLY = (signal.SIGSEGV, signal.SIGABRT, signal.SIGFPE, signal.SIGKILL)


def main() -> None:
    """Makes all of them."""
    IMAGES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, local_sidecar(Path(folder)) as sidecar:
        sidecar.start()
        units = [
            sidecar.protected(
                name,
                ["sleep", "1000"],
                {"avckpt.enable": "true", "avckpt.interval": "1s", "avckpt.group": "drive" if i > 4 else "perception"},
            )
            for i, name in enumerate(UNITS)
        ]
        for unit in units:
            sidecar.wait_for(unit, state="protected")
        web = subprocess.Popen(
            [*avckpt_command(), "web", "--port", "0"],
            env={**os.environ, **sidecar.env},
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert web.stdout is not None
            picture_web(web.stdout.readline().strip(), units)
        finally:
            web.send_signal(signal.SIGINT)
            web.wait()
        asyncio.run(picture_top(sidecar))


def picture_web(url: str, units: list[Container]) -> None:
    """The page in both colours, with a crash chosen."""
    options = Options()
    for argument in ("--headless=new", "--no-sandbox", "--window-size=1400,1560", "--hide-scrollbars"):
        options.add_argument(argument)
    browser = webdriver.Chrome(options=options, service=Service("/usr/bin/chromedriver"))
    try:
        browser.get(url)
        chance = random.Random(1)
        for _ in range(CRASHES):
            time.sleep(chance.uniform(0.5, 3))
            os.kill(chance.choice(units).app_pid, chance.choice(DEADLY))
        rows = "return document.querySelectorAll('#crashes tbody tr').length"
        wait_until(lambda: browser.execute_script(rows) >= CRASHES, 60, "all crashes")
        browser.execute_script(
            "document.getElementById('span').value = '60'; document.querySelectorAll('#crashes tr')[3].click()"
        )
        time.sleep(6)  # the histograms are looked at every five seconds
        for theme in ("light", "dark"):
            button = browser.find_element("id", "theme")
            if (button.text == "Light") != (theme == "dark"):
                button.click()
                time.sleep(1)
            browser.save_screenshot(str(IMAGES / f"web-{theme}.png"))
    finally:
        browser.quit()


async def picture_top(sidecar: LocalSidecar) -> None:
    """The terminal, as SVG."""
    app = Top(Client(sidecar.run_dir))
    async with app.run_test(size=(150, 28)) as pilot:
        await pilot.pause(8)
        picture = app.export_screenshot(title="avckpt top")
        # Nobody's fonts: a document loads nothing from elsewhere.
        (IMAGES / "top.svg").write_text(re.sub(r"@font-face\s*{.*?}", "", picture, flags=re.DOTALL))


if __name__ == "__main__":
    main()
