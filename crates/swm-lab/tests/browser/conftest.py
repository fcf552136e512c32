"""A lab in a temporary home folder, and pages of it in Chromium.

`SWM` names the program, `SWM_CHROMIUM` the browser (default: `chromium`).
"""

import json
import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest
from playwright.sync_api import sync_playwright

SWM = os.environ.get("SWM", "swm")
SCREENSHOTS = os.environ.get("SWM_SCREENSHOTS")


def screenshot(page, name, **options):
    """Stores a screenshot of the documentation, if `SWM_SCREENSHOTS` names a folder for them."""
    if SCREENSHOTS:
        page.mouse.move(0, 0)
        page.evaluate("window.scrollTo(0, 0)")
        page.wait_for_timeout(300)
        page.screenshot(path=Path(SCREENSHOTS) / f"lab-{name}.png", **options)


class Lab:
    """A running lab."""

    def __init__(self, home):
        """Starts it on a free port."""
        self.home = home
        self._environment = {**os.environ, "STABLEWM_HOME": str(home)}
        command = [SWM, "lab", "--no-open", "--port", "0"]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, env=self._environment, text=True)
        self.url = self._process.stdout.readline().strip()

    def swm(self, *arguments):
        """Runs a command in the home folder of the lab."""
        done = subprocess.run(
            [SWM, *arguments], cwd=self.home, env=self._environment, check=True, capture_output=True, text=True
        )
        return done.stdout

    def stop(self):
        """Ends it as Ctrl-C does."""
        self._process.terminate()
        assert self._process.wait(timeout=30) == 0


@pytest.fixture(scope="session")
def lab(tmp_path_factory):
    """A lab with two datasets and one run."""
    lab = Lab(tmp_path_factory.mktemp("home"))
    lab.swm("collect", "swm/TwoRoom-v1", "-o", "rooms", "--episodes", "120", "--image", "64")
    lab.swm("collect", "swm/PushT-v1", "-o", "pushes", "--policy", "weak", "--episodes", "6", "--image", "64")
    for name, scale in [("lewm", 2.0), ("pldm", 1.0)]:
        log = lab.home / "checkpoints" / name / "train.jsonl"
        log.parent.mkdir(parents=True)
        lines = [{"step": 10 * i, "loss": scale / (i + 1), "optimizer/lr": 1e-3} for i in range(200)]
        log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    yield lab
    lab.stop()


@pytest.fixture(scope="session")
def browser():
    """A headless Chromium."""
    program = shutil.which(os.environ.get("SWM_CHROMIUM", "chromium"))
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def open_page(lab, browser):
    """Returns a function that opens a page of the lab; errors and requests to other hosts fail the test."""
    problems, contexts = [], []

    def open_page(fragment="", width=1280, height=800, theme="light"):
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=theme)
        context.grant_permissions(["clipboard-read", "clipboard-write"], origin=lab.url.rsplit("/", 2)[0])
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda message: problems.append(message.text) if message.type == "error" else None)
        own = (lab.url, "ws" + lab.url[4:], "blob:", "data:")
        page.on("request", lambda request: None if request.url.startswith(own) else problems.append(request.url))
        page.goto(lab.url + fragment)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert problems == []


def wait_until(holds, patience=30):
    """Waits until a condition holds that no element of a page shows."""
    until = time.monotonic() + patience
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.05)
