"""A headless Chromium, controlled by the W3C WebDriver protocol through chromedriver."""

import base64
import json
import os
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None
)
DRIVER = shutil.which("chromedriver")

_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--window-size=1000,700",
)


class Browser:
    """A browser window."""

    def __init__(self, port: int) -> None:
        self._base = f"http://127.0.0.1:{port}/session"

    def _call(self, method: str, path: str, body: Any = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(  # noqa: S310  (to chromedriver on this machine)
            self._base + path, data, {"Content-Type": "application/json"}, method=method
        )
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(request, timeout=120) as answer:
            return json.load(answer)["value"]

    def begin(self, profile: Path) -> None:
        """Open the window."""
        options = {
            "binary": CHROMIUM,
            "args": [*_FLAGS, f"--user-data-dir={profile}"],
            "perfLoggingPrefs": {"enableNetwork": True},
        }
        wanted = {
            "goog:chromeOptions": options,
            "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
            "timeouts": {"script": 110_000},  # milliseconds, below that of the connection
        }
        told = self._call("POST", "", {"capabilities": {"alwaysMatch": wanted}})
        self._base += f"/{told['sessionId']}"

    def open(self, page: Path | str, address: str = "", *, limit_s: float = 120.0) -> None:
        """Open or reload a page from disk or at a URL, and wait until it is ready."""
        self._call("POST", "/url", {"url": "about:blank"})
        self._call("POST", "/url", {"url": (page if isinstance(page, str) else page.as_uri()) + address})
        end = time.monotonic() + limit_s
        while (state := self.js("return document.documentElement.dataset.ready")) is None:
            assert time.monotonic() < end, self.text("message")
            time.sleep(0.05)
        assert state == "yes", self.text("message")

    def wait(self, script: str) -> Any:
        """The return value of a script as soon as it is true."""
        end = time.monotonic() + 30
        while not (value := self.js(script)):
            assert time.monotonic() < end, script
            time.sleep(0.05)
        return value

    def js(self, script: str, *args: Any) -> Any:
        """The return value of a script."""
        return self._call("POST", "/execute/sync", {"script": script, "args": list(args)})

    def text(self, element: str) -> str:
        """The text of an element, "" if it is hidden."""
        return str(self.js("return document.getElementById(arguments[0]).innerText", element))

    def mouse(self, *actions: dict[str, Any]) -> None:
        """Perform mouse actions."""
        source = {"type": "pointer", "id": "mouse", "actions": list(actions)}
        self._call("POST", "/actions", {"actions": [source]})

    def click(self, x: float, y: float) -> None:
        """Click at a point of the window."""
        to = {"type": "pointerMove", "x": round(x), "y": round(y)}
        self.mouse(to, {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0})

    def drag(self, start: tuple[int, int], stop: tuple[int, int], button: int = 0) -> None:
        """Drag with the mouse."""
        first, last = ({"type": "pointerMove", "x": x, "y": y, "duration": 50} for x, y in (start, stop))
        self.mouse(
            first, {"type": "pointerDown", "button": button}, last, {"type": "pointerUp", "button": button}
        )

    def keys(self, *keys: str) -> None:
        """Press keys in sequence."""
        pressed = [{"type": kind, "value": key} for key in keys for kind in ("keyDown", "keyUp")]
        self._call("POST", "/actions", {"actions": [{"type": "key", "id": "keys", "actions": pressed}]})

    def write(self, text: str) -> None:
        """Insert text at the caret, like an input method, independent of the keyboard layout."""
        self.tell("Input.insertText", text=text)

    def tell(self, command: str, **params: Any) -> None:
        """Send a command of the Chrome DevTools protocol."""
        self._call("POST", "/goog/cdp/execute", {"cmd": command, "params": params})

    def phone(self, width: int, height: int) -> None:
        """Emulate a phone with a touch screen; width 0 ends the emulation."""
        if width:
            self.tell(
                "Emulation.setDeviceMetricsOverride",
                width=width,
                height=height,
                deviceScaleFactor=2,
                mobile=True,
            )
        else:
            self.tell("Emulation.clearDeviceMetricsOverride")
        self.tell("Emulation.setTouchEmulationEnabled", enabled=bool(width), maxTouchPoints=5)

    def touch(self, *steps: list[tuple[float, float]]) -> None:
        """Touch at the positions of the first step, move through the others, and release."""
        for number, places in enumerate(steps):
            points = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(places)]
            kind = "touchMove" if number else "touchStart"
            self.tell("Input.dispatchTouchEvent", type=kind, touchPoints=points)
            self.settle()
        self.tell("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        self.settle()

    def settle(self) -> None:
        """Wait until changes are drawn."""
        script = (
            "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => done(1)))"
        )
        self._call("POST", "/execute/async", {"script": script, "args": []})

    def screenshot(self) -> bytes:
        """A screenshot of the window as PNG."""
        self.settle()
        return base64.b64decode(self._call("GET", "/screenshot"))

    def complaints(self) -> list[str]:
        """Warnings and errors of the browser's console since the last call."""
        return [entry["message"] for entry in self._call("POST", "/se/log", {"type": "browser"})]

    def requests(self) -> set[str]:
        """URLs that pages have requested since the last call; not those of the browser's own pages."""
        entries = [
            json.loads(e["message"])["message"]
            for e in self._call("POST", "/se/log", {"type": "performance"})
        ]
        urls = {e["params"]["request"]["url"] for e in entries if e["method"] == "Network.requestWillBeSent"}
        return {url for url in urls if not url.startswith("chrome:")}

    def end(self) -> None:
        """Close the window."""
        self._call("DELETE", "")


@contextmanager
def browser(folder: Path) -> Iterator[Browser]:
    """A new window with an empty profile in a folder.

    Where there is no browser the test is skipped, but in CI it fails.
    """
    if not (CHROMIUM and DRIVER):
        message = (
            "no chromium and chromedriver here: the page is not tried (Debian: chromium chromium-driver)"
        )
        if os.environ.get("CI") == "true":
            pytest.fail(message)
        pytest.skip(message)
    with subprocess.Popen(
        [DRIVER, "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as driver:
        try:
            assert driver.stdout is not None
            port = next(
                m[1]
                for line in driver.stdout
                if (m := re.search(r"started successfully on port (\d+)", line))
            )
            window = Browser(int(port))
            window.begin(folder / "profile")
            try:
                yield window
            finally:
                window.end()
        finally:
            driver.terminate()
