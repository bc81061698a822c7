"""Chromium without a window, by its DevTools protocol: open a page, click in it, take its image."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from websockets.sync.client import connect

_OPTIONS = (
    "--headless=new", "--no-sandbox", "--hide-scrollbars", "--remote-debugging-port=0", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip


class Browser:
    """One page of Chromium; `size` (width, height) [px] of its window. Use it as a context."""

    def __init__(self, size: tuple[int, int] = (1300, 900)) -> None:
        program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
        if program is None:
            raise SystemExit("Images of pages need Chromium. Install it.")
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [program, *_OPTIONS, f"--user-data-dir={self._folder.name}", "about:blank"], stderr=subprocess.DEVNULL
        )
        port_file = Path(self._folder.name) / "DevToolsActivePort"
        _until(lambda: port_file.is_file() and "\n" in port_file.read_text(), 30.0, "Chromium does not start")
        port = port_file.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            address = next(page["webSocketDebuggerUrl"] for page in json.load(answer) if page["type"] == "page")
        self._socket, self._count = connect(address, max_size=None), 0
        self.resize(size)

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(10)
        self._folder.cleanup()

    def resize(self, size: tuple[int, int]) -> None:
        """Set the window's width and height [px]."""
        metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
        self._call("Emulation.setDeviceMetricsOverride", **metrics)

    def open(self, address: str) -> None:
        """Load an address, and wait until the page is there."""
        self._call("Page.navigate", url=address)
        self.wait("location.href !== 'about:blank' && document.readyState === 'complete'")

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression."""
        told = self._call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        return told["result"].get("value")

    def wait(self, condition: str, seconds: float = 60.0) -> None:
        """Wait until a JavaScript expression is true."""
        _until(lambda: self.run(f"!!({condition})"), seconds, f"the page never had {condition}")

    def click(self, x: float, y: float) -> None:
        """Press and release the left button at a place [px] of the window."""
        for kind in ("mousePressed", "mouseReleased"):
            self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def image(self, height: int | None = None) -> NDArray:
        """(H, W, 3) uint8 BGR of the window, or of the page's first `height` [px] whatever the window's."""
        options: dict[str, Any] = {"format": "png"}
        if height is not None:
            clip = {"x": 0, "y": 0, "width": self.run("innerWidth"), "height": height, "scale": 1}
            options |= {"clip": clip, "captureBeyondViewport": True}
        data = base64.b64decode(self._call("Page.captureScreenshot", **options)["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)

    def _call(self, method: str, **arguments: Any) -> Any:
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": arguments}))
        while True:
            told = json.loads(self._socket.recv(timeout=120))
            if told.get("id") == self._count:
                if "error" in told:
                    raise RuntimeError(f"{method}: {told['error']['message']}")
                return told["result"]


def _until(condition: Any, seconds: float, problem: str) -> None:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise RuntimeError(f"{problem} within {seconds:g} s")
        time.sleep(0.1)
