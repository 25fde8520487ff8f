"""A headless Chromium to look at pages with, over its DevTools pipe: no driver, no port, no network."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-pipe",
)
_LIMIT_S = 60.0


def find_chromium() -> str | None:
    """The browser on the PATH, by any of the names that distributions give it."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next((path for name in names if (path := shutil.which(name))), None)


class Chromium:
    """One browser with one page. Use it as a context: the browser ends with it.

    - `events`: every DevTools event so far, oldest first.
    """

    def __init__(self, program: str, profile: Path):
        self.events: list[dict[str, Any]] = []
        self._last_id = 0
        self._unread = b""
        from_us, self._to_browser = os.pipe()
        self._from_browser, to_us = os.pipe()
        # Chromium reads commands from descriptor 3 and answers on 4; bash is what can put them there.
        redirect = f'exec "$@" 3<&{from_us} 4>&{to_us}'
        self._log = (profile.parent / f"{profile.name}.log").open("wb")
        self._process = subprocess.Popen(
            ["bash", "-c", redirect, "bash", program, *_FLAGS, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(from_us, to_us),
            stdout=subprocess.DEVNULL,
            stderr=self._log,
        )
        os.close(from_us)
        os.close(to_us)
        self._session = ""
        target = self.call("Target.createTarget", {"url": "about:blank"})["targetId"]
        self._session = self.call("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable", {})

    def __enter__(self) -> Chromium:
        return self

    def __exit__(self, *_: object) -> None:
        self._session = ""
        try:
            self.call("Browser.close", {})
            self._process.wait(timeout=10)
        except (OSError, RuntimeError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        os.close(self._to_browser)
        os.close(self._from_browser)
        self._log.close()

    def call(self, method: str, params: dict[str, Any]) -> dict[str, Any]:
        """A DevTools command and its result.

        **Raises:** `RuntimeError` where the browser refuses it or does not answer in time.
        """
        self._last_id += 1
        message = {"id": self._last_id, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to_browser, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + _LIMIT_S
        while True:
            answer = self._next_message(until)
            if answer.get("id") == self._last_id:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return answer["result"]
            self.events.append(answer)

    def open(self, page: Path, width_px: int = 1366, height_px: int = 768) -> None:
        """Load a file into a window of this size, and wait until it is there."""
        size = {"width": width_px, "height": height_px, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", size)
        self.events.clear()
        self.call("Page.navigate", {"url": page.resolve().as_uri()})
        until = time.monotonic() + _LIMIT_S
        while not self.seen("Page.loadEventFired"):
            self.events.append(self._next_message(until))

    def seen(self, method: str) -> list[dict[str, Any]]:
        """The parameters of every event of this kind since the page was opened."""
        return [event["params"] for event in self.events if event.get("method") == method]

    def complaints(self) -> list[str]:
        """What a developer would see in red or yellow in the console."""
        thrown = [event["exceptionDetails"].get("text", "") for event in self.seen("Runtime.exceptionThrown")]
        logged = [event["entry"]["text"] for event in self.seen("Log.entryAdded")]
        said = [str(e["args"]) for e in self.seen("Runtime.consoleAPICalled") if e["type"] in ("error", "warning")]
        return thrown + logged + said

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression; a promise is awaited.

        **Raises:** `RuntimeError` where it throws.
        """
        asked = {"expression": expression, "returnByValue": True, "awaitPromise": True}
        answer = self.call("Runtime.evaluate", asked)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def click(self, selector: str) -> None:
        """Scroll to an element and press the mouse in its middle, as a user does."""
        x, y = self.evaluate(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            " e.scrollIntoView({block: 'center', behavior: 'instant'});"
            " const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            at = {"type": kind, "x": x, "y": y, "button": "left", "clickCount": 1}
            self.call("Input.dispatchMouseEvent", at)

    def press(self, key: str) -> None:
        """Press and release a key that has a name (`Enter`)."""
        codes = {"Enter": (13, "\r"), "Escape": (27, "")}
        code, text = codes[key]
        pressed = {"key": key, "code": key, "windowsVirtualKeyCode": code}
        self.call("Input.dispatchKeyEvent", {"type": "keyDown", "text": text, **pressed})
        self.call("Input.dispatchKeyEvent", {"type": "keyUp", **pressed})

    def type_text(self, text: str) -> None:
        """Type into what has the focus."""
        self.call("Input.insertText", {"text": text})

    def screenshot(self, whole_page: bool = False) -> bytes:
        """PNG of the window, or of the whole page."""
        asked = {"format": "png", "captureBeyondViewport": whole_page}
        if whole_page:
            size = self.call("Page.getLayoutMetrics", {})["cssContentSize"]
            asked["clip"] = {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}
        return base64.b64decode(self.call("Page.captureScreenshot", asked)["data"])

    def pdf(self) -> bytes:
        """The page as printed on paper, A4, with the page's own margins."""
        asked = {"preferCSSPageSize": False, "printBackground": False, "paperWidth": 8.27, "paperHeight": 11.69}
        return base64.b64decode(self.call("Page.printToPDF", asked)["data"])

    def _next_message(self, until: float) -> dict[str, Any]:
        while b"\0" not in self._unread:
            left_s = until - time.monotonic()
            ready = select.select([self._from_browser], [], [], max(0.0, left_s))[0]
            read = os.read(self._from_browser, 1 << 16) if ready else b""
            if not read:
                raise RuntimeError("chromium: " + ("has ended" if ready else f"no answer in {_LIMIT_S:g} s"))
            self._unread += read
        message, self._unread = self._unread.split(b"\0", 1)
        return json.loads(message)
