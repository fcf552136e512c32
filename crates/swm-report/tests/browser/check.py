"""Opens pages in headless Chromium, at three widths, light and dark, and lists texts that are cut off or overlap.

    python3 check.py [--screenshots DIR] PAGE...

Prints one JSON document per page, width and theme; the exit code is 1 if one of them has faults. `SWM_CHROMIUM` names
the program (default: `chromium`).
"""

import argparse
import base64
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

WIDTHS = [400, 800, 1400]
THEMES = ["light", "dark"]
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
]


class Browser:
    """A headless Chromium with one page, driven through its debugging pipe."""

    def __init__(self, profile):
        """Starts the browser; `profile` is an empty folder for its files."""
        commands, self._commands = os.pipe()
        self._replies, replies = os.pipe()

        def connect():
            # Chromium reads commands from file 3 and writes replies to file 4.
            for given, high in [(commands, 13), (replies, 14)]:
                os.dup2(given, high)
            for high, expected in [(13, 3), (14, 4)]:
                os.dup2(high, expected)

        program = os.environ.get("SWM_CHROMIUM", "chromium")
        arguments = [program, *FLAGS, f"--user-data-dir={profile}"]
        log = open(Path(profile) / "log.txt", "wb")
        self._process = subprocess.Popen(arguments, preexec_fn=connect, close_fds=False, stdout=log, stderr=log)
        os.close(commands)
        os.close(replies)
        self._buffer, self._next, self._session = b"", 0, None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self.call("Page.enable")

    def call(self, method, **parameters):
        """Sends a command and returns its result."""
        self._next += 1
        message = {"id": self._next, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        reply = self._wait(lambda message: message.get("id") == self._next)
        if "error" in reply:
            raise RuntimeError(f"{method}: {reply['error']}")
        return reply["result"]

    def _wait(self, is_wanted):
        """Reads messages until one is wanted."""
        while True:
            while b"\0" not in self._buffer:
                read = os.read(self._replies, 1 << 20)
                if not read:
                    raise RuntimeError("Chromium has ended")
                self._buffer += read
            text, self._buffer = self._buffer.split(b"\0", 1)
            message = json.loads(text)
            if is_wanted(message):
                return message

    def open(self, page, width, theme):
        """Opens a file in a window of a width, in pixels."""
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": theme}])
        self.call("Page.navigate", url=Path(page).resolve().as_uri())
        self._wait(lambda message: message.get("method") == "Page.loadEventFired")

    def evaluate(self, expression):
        """Returns the value of an expression of JavaScript."""
        reply = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in reply:
            raise RuntimeError(json.dumps(reply["exceptionDetails"]))
        return reply["result"]["value"]

    def screenshot(self, file):
        """Writes the whole page as a PNG file."""
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"x": 0, "y": 0, "width": size["width"], "height": min(size["height"], 16000), "scale": 1}
        image = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True, clip=clip)
        Path(file).write_bytes(base64.b64decode(image["data"]))

    def close(self):
        """Ends the browser."""
        self._process.terminate()
        self._process.wait()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="+", metavar="PAGE")
    parser.add_argument("--screenshots", metavar="DIR", help="folder of an image of every page, width and theme")
    arguments = parser.parse_args()
    script = (Path(__file__).parent / "check.js").read_text()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = Browser(profile)
        found = 0
        try:
            for page in arguments.pages:
                for width in WIDTHS:
                    for theme in THEMES:
                        browser.open(page, width, theme)
                        if arguments.screenshots:
                            Path(arguments.screenshots).mkdir(parents=True, exist_ok=True)
                            name = f"{Path(page).parent.name}-{width}-{theme}.png"
                            browser.screenshot(Path(arguments.screenshots) / name)
                        measured = browser.evaluate(script)
                        if measured["width"] != width or measured["dark"] != (theme == "dark"):
                            raise RuntimeError(f"the page is not {width} pixels wide and {theme}: {measured}")
                        print(json.dumps({"page": page, "theme": theme, **measured}))
                        found += len(measured["faults"])
        finally:
            browser.close()
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
