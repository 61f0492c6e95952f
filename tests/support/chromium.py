"""A headless Chromium, driven by the DevTools protocol over a pipe.

Protocol: chromedevtools.github.io/devtools-protocol. Over a pipe, messages are JSON, each ended by a zero
byte. Chromium reads them from file descriptor 3 and writes them to 4.
"""

import base64
import json
import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome")
PATIENCE_S = 60.0


def found() -> str | None:
    """Return the path of an installed browser, or None."""
    return next((path for name in NAMES if (path := shutil.which(name))), None)


@dataclass
class Page:
    """One page of the browser."""

    reading: int
    writing: int
    session: str = ""
    requests: list[str] = field(default_factory=list)
    """Addresses that the page requested."""
    errors: list[str] = field(default_factory=list)
    """Exceptions of the page's scripts."""
    _buffer: bytes = b""
    _count: int = 0

    def open(self, address: str, width: int = 1280) -> None:
        """Open an address and wait until the page and its resources are loaded."""
        self.requests.clear()
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        answer = self.call("Page.navigate", url=address)
        assert "errorText" not in answer, answer
        self.wait_until("document.readyState === 'complete' && location.href !== 'about:blank'")

    def value(self, script: str) -> Any:  # noqa: ANN401 - whatever the script gives
        """Return the value of a script, evaluated on the page; None while the page is replaced by another."""
        try:
            answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        except AssertionError as error:
            if "Inspected target navigated" in str(error):
                return None
            raise
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_until(self, script: str) -> None:
        """Wait until a script's value is true; fail with the page's text on a timeout."""
        deadline = time.monotonic() + PATIENCE_S
        while not self.value(script):
            assert time.monotonic() < deadline, f"{script} never held; the page: {self.text()[:2000]}"
            time.sleep(0.1)

    def wait_for(self, text: str) -> None:
        """Wait until the page shows a text."""
        self.wait_until(f"document.body?.innerText.includes({json.dumps(text)})")

    def click(self, text: str) -> None:
        """Click on the element with exactly this text, once it exists."""
        every = "[...document.querySelectorAll('body *')]"
        found = f"{every}.filter(element => element.textContent.trim() === {json.dumps(text)})"
        self.wait_until(f"{found}.length")
        self.value(f"{found}.at(-1).click()")

    def text(self) -> str:
        """Return the text that the page shows."""
        return str(self.value("document.body.innerText"))

    def picture(self, path: Path) -> None:
        """Save a screenshot as PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:  # noqa: ANN401
        """Send a command to the browser and return its answer."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.writing, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._count:
            self._record(answer)
        assert "error" not in answer, (method, answer["error"])
        return dict(answer["result"])

    def _next(self) -> dict[str, Any]:
        deadline = time.monotonic() + PATIENCE_S
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self.reading], [], [], max(deadline - time.monotonic(), 0))
            assert ready, "the browser does not answer"
            received = os.read(self.reading, 1 << 16)
            assert received, "the browser has ended"
            self._buffer += received
        message, _, self._buffer = self._buffer.partition(b"\0")
        return dict(json.loads(message))

    def _record(self, event: dict[str, Any]) -> None:
        match event.get("method"):
            case "Network.requestWillBeSent":
                self.requests.append(event["params"]["request"]["url"])
            case "Runtime.exceptionThrown":
                self.errors.append(str(event["params"]["exceptionDetails"]))


@contextmanager
def chromium(program: str, profile: Path) -> Iterator[Page]:
    """Start a browser with an empty profile and yield a page of it."""
    (theirs_in, ours_out), (ours_in, theirs_out) = os.pipe(), os.pipe()
    arguments = "--headless --no-sandbox --disable-gpu --no-first-run --remote-debugging-pipe"
    # A shell moves the pipes to the file descriptors that Chromium uses.
    command = f'exec "$0" {arguments} --user-data-dir="$1" 3<&{theirs_in} 4>&{theirs_out}'
    process = subprocess.Popen(
        ["/bin/bash", "-c", command, program, str(profile)],
        pass_fds=(theirs_in, theirs_out),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(theirs_in)
    os.close(theirs_out)
    page = Page(ours_in, ours_out)
    try:
        target = page.call("Target.createTarget", url="about:blank")["targetId"]
        page.session = page.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Runtime"):
            page.call(f"{domain}.enable")
        yield page
        page.session = ""
        with suppress(AssertionError, OSError):
            page.call("Browser.close")
    finally:
        os.close(ours_out)
        os.close(ours_in)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
