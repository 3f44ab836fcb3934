"""A headless Chromium for tests, spoken to by the protocol of its own developer tools.

It needs the program `chromium` (Debian's package of that name) and nothing else: no driver, no
library, no network.
"""

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

PROGRAM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
MISSING = "there is no chromium here; `apt-get install chromium` brings it"
_PATIENCE = 60.0  # for an answer [s]
# The protocol is read from this descriptor and written to the next one.
_READS, _WRITES = 3, 4


class Browser:
    """One page in a browser without a window; `with Browser(folder) as browser: ...`.

    Args:
        folder: Where it keeps its own files.

    Attributes:
        problems: What the page has complained of: errors on the console, exceptions, requests.
    """

    def __init__(self, folder: Path) -> None:
        assert PROGRAM is not None, MISSING
        theirs_in, self._out = os.pipe()
        self._in, theirs_out = os.pipe()
        self.problems: list[str] = []
        self._count, self._rest, self._session = 0, b"", None

        def placed() -> None:
            # First out of the way of the places where they have to be.
            read, write = os.dup(theirs_in), os.dup(theirs_out)
            os.dup2(read, _READS)
            os.dup2(write, _WRITES)

        options = ("--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe")
        options += ("--hide-scrollbars", "--no-first-run", f"--user-data-dir={folder}")
        self._process = subprocess.Popen(
            [PROGRAM, *options, "about:blank"],
            preexec_fn=placed,
            close_fds=False,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        found = self.ask("Target.attachToTarget", targetId=target, flatten=True)
        self._session = found["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._in)
        os.close(self._out)

    def ask(self, method: str, **parameters: Any) -> Any:
        """Send a command and return its result."""
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        return self._until(lambda answer: answer.get("id") == message["id"])["result"]

    def open(self, path: Path, width: int = 1280, height: int = 900) -> None:
        """Open a file in a view of so many pixels, and wait until its scripts have run."""
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        self.problems.clear()
        self.ask("Page.navigate", url=path.resolve().as_uri())
        deadline = time.monotonic() + _PATIENCE
        while self.value("document.readyState") != "complete" or self.value("location.href") == (
            "about:blank"
        ):
            assert time.monotonic() < deadline, "the page was not loaded"
            time.sleep(0.02)

    def value(self, expression: str) -> Any:
        """Return what an expression is in the page."""
        answer = self.ask(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def press(self, key: str, shift: bool = False) -> None:
        """Press a key where the focus is."""
        codes = {" ": 32, "Tab": 9, "Enter": 13, "ArrowLeft": 37, "ArrowRight": 39}
        codes |= {"Home": 36, "End": 35}
        given: dict[str, Any] = {"key": key, "windowsVirtualKeyCode": codes.get(key, ord(key[0]))}
        given["modifiers"] = 8 if shift else 0
        text = (
            {"text": {" ": " ", "Enter": "\r"}.get(key, key)}
            if len(key) == 1 or key == ("Enter")
            else {}
        )
        self.ask("Input.dispatchKeyEvent", type="keyDown", **given, **text)
        self.ask("Input.dispatchKeyEvent", type="keyUp", **given)

    def screenshot(self, path: Path, whole: bool = True) -> None:
        """Write a picture of the page."""
        found = self.ask("Page.captureScreenshot", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(found["data"]))

    def _until(self, wanted: Any) -> Any:
        deadline = time.monotonic() + _PATIENCE
        while True:
            while b"\0" in self._rest:
                line, _, self._rest = self._rest.partition(b"\0")
                answer = json.loads(line)
                self._note(answer)
                if wanted(answer):
                    assert "error" not in answer, answer["error"]
                    return answer
            ready, _, _ = select.select([self._in], [], [], deadline - time.monotonic())
            assert ready, "the browser does not answer"
            part = os.read(self._in, 1 << 20)
            assert part, "the browser has ended"
            self._rest += part

    def _note(self, event: dict[str, Any]) -> None:
        method, said = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(said["exceptionDetails"])[:500])
        elif method == "Runtime.consoleAPICalled" and said["type"] in ("error", "warning"):
            self.problems.append(json.dumps(said["args"])[:500])
        elif method == "Log.entryAdded" and said["entry"]["level"] in ("error", "warning"):
            self.problems.append(said["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            url = said["request"]["url"]
            if not url.startswith(("file:", "data:", "about:")):
                self.problems.append(f"it asked for {url}")
