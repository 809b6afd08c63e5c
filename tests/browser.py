"""Open a report in headless Chromium as a phone, a laptop and a printer would, and say what is wrong.

    python tests/browser.py runs/demo/figures/report.html [--chromium PATH] [--shots FOLDER]

Wrong is: the page is wider than the window, something sticks out of it that cannot be scrolled, the console
says anything, something is fetched. Exits with the number of wrongs. Needs the package websockets (MLflow's
server brings it) and a Chromium; so it is no part of the tests.
"""

from __future__ import annotations

import argparse
import base64
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

SIZES = {"phone": (360, 740, 3.0), "phone-wide": (740, 360, 3.0), "laptop": (1366, 768, 1.0)}
PRINTED = {"print-a4": (8.27, 11.69), "print-letter": (8.5, 11.0)}  # inches
PRINT_WIDTH = 687  # CSS pixels of an A4 page between margins of 14 mm
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
    "--remote-debugging-port=0",
]
# What is wider than the window, and is neither scrolled by itself nor inside something that is.
STICKS_OUT = """
[...document.querySelectorAll('body *')].filter(it => {
  if (it.getBoundingClientRect().right <= document.documentElement.clientWidth + 1) return false;
  for (let up = it.parentElement; up; up = up.parentElement)
    if (['auto', 'scroll'].includes(getComputedStyle(up).overflowX)) return false;
  return true;
}).map(it => it.tagName + ' ' + (it.textContent || it.alt || '').slice(0, 60))
"""
UNFOLD = """
document.querySelectorAll('details').forEach(it => { it.open = true; });
document.querySelectorAll('input').forEach(it => { it.checked = true; });
"""


class Browser:
    """One page, spoken to by the DevTools protocol."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._number = 0
        self.events: list[dict[str, Any]] = []

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and wait for its result; keeps the events that come meanwhile."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            message: dict[str, Any] = json.loads(self._socket.recv(timeout=120.0))
            if message.get("id") == self._number:
                assert "error" not in message, message
                return dict(message["result"])
            self.events.append(message)

    def value(self, expression: str) -> Any:
        """What a JavaScript expression is."""
        return self.ask("Runtime.evaluate", expression=expression, returnByValue=True)["result"]["value"]

    def open(self, address: str) -> None:
        """Load a page, whole."""
        self.events.clear()
        self.ask("Page.navigate", url=address)
        while self.value("document.readyState + location.protocol") != "completefile:":
            time.sleep(0.05)


@contextmanager
def browser(chromium: str) -> Iterator[Browser]:
    """A headless Chromium with one empty page."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = subprocess.Popen(
            [chromium, *FLAGS, f"--user-data-dir={folder}", "about:blank"], stderr=subprocess.PIPE, text=True
        )
        try:
            assert process.stderr is not None
            line = next(line for line in process.stderr if "DevTools listening" in line)
            port = re.search(r":(\d+)/", line)
            assert port is not None, line
            with urllib.request.urlopen(f"http://127.0.0.1:{port[1]}/json") as reply:
                page = next(it for it in json.load(reply) if it["type"] == "page")
            with connect(page["webSocketDebuggerUrl"], max_size=None) as socket:
                yield Browser(socket)
        finally:
            process.terminate()
            process.wait()


def wrongs(page: Browser, address: str, shots: Path) -> Iterator[str]:
    """Open the page at every size; what is wrong, in sentences."""
    for domain in ("Page", "Runtime", "Log", "Network"):
        page.ask(f"{domain}.enable")
    for name, (width, height, scale) in SIZES.items():
        yield from _at_size(page, address, shots / f"{name}.png", (width, height, scale), "screen")
    yield from _at_size(page, address, shots / "print.png", (PRINT_WIDTH, 1000, 2.0), "print")
    for name, (paper_width, paper_height) in PRINTED.items():
        printed = page.ask(
            "Page.printToPDF", paperWidth=paper_width, paperHeight=paper_height, preferCSSPageSize=False
        )
        (shots / f"{name}.pdf").write_bytes(base64.b64decode(printed["data"]))


def _at_size(
    page: Browser, address: str, shot: Path, size: tuple[int, int, float], medium: str
) -> Iterator[str]:
    width, height, scale = size
    page.ask("Emulation.setEmulatedMedia", media=medium)
    page.ask(
        "Emulation.setDeviceMetricsOverride",
        width=width,
        height=height,
        deviceScaleFactor=scale,
        mobile=scale > 2.0,
    )
    page.open(address)
    yield from _too_wide(page, shot.stem, width)
    for event in page.events:
        method, said = event["method"], event.get("params", {})
        if method in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
            yield f"{shot.stem}: the console says {json.dumps(said)[:300]}"
        if method == "Network.requestWillBeSent" and not said["request"]["url"].startswith(
            ("file:", "data:")
        ):
            yield f"{shot.stem}: fetches {said['request']['url'][:100]}"
    tall = min(12_000, page.value("document.documentElement.scrollHeight"))
    picture = page.ask(
        "Page.captureScreenshot",
        captureBeyondViewport=True,
        clip={"x": 0, "y": 0, "width": width, "height": tall, "scale": 1.0 / scale},
    )
    shot.write_bytes(base64.b64decode(picture["data"]))
    page.ask("Runtime.evaluate", expression=UNFOLD)
    yield from _too_wide(page, f"{shot.stem}, all unfolded and magnified", width)


def _too_wide(page: Browser, what: str, width: int) -> Iterator[str]:
    wide = page.value("document.documentElement.scrollWidth")
    if wide > width:
        yield f"{what}: the page is {wide} wide, the window {width}"
    for element in page.value(STICKS_OUT):
        yield f"{what}: sticks out: {element}"


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("page", type=Path)
    parser.add_argument("--chromium", default=shutil.which("chromium") or "chromium")
    parser.add_argument("--shots", type=Path, help="keep what the sizes look like here")
    arguments = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder, browser(arguments.chromium) as page:
        shots = arguments.shots or Path(folder)
        shots.mkdir(parents=True, exist_ok=True)
        found = list(wrongs(page, arguments.page.absolute().as_uri(), shots))
    print("\n".join(found) or f"{arguments.page}: right at {', '.join([*SIZES, 'print'])}")
    return len(found)


if __name__ == "__main__":
    sys.exit(main())
