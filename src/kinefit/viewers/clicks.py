"""A page on which joints are clicked in the images of one time: served to the browser by the standard library."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from threading import Event, Thread
from typing import Any
from urllib.parse import unquote

from kinefit.errors import KinefitError

Take = Callable[[dict[str, Any]], str]
"""What is done with clicks as JSON has them; it returns what to tell, or raises a `KinefitError`."""

_LARGEST = 1_000_000  # bytes of clicks


class ClickPage:
    """Images of one time in the browser, in which joints are clicked.

    Parameters
    ----------
    pictures : {camera: JPEG or PNG}
    joints : names that are asked for, in this order
    take : what is done with the clicks when the user is done; its message, or its error, is shown on the page
    step : of the images
    port : 0 for any free one
    """

    def __init__(
        self, pictures: Mapping[str, bytes], joints: Sequence[str], take: Take, *, step: int = 0, port: int = 0
    ) -> None:
        self.pictures, self.joints, self.take, self.step = dict(pictures), tuple(joints), take, step
        self.done = Event()
        self._server = ThreadingHTTPServer(("127.0.0.1", port), _handler(self))
        self._thread = Thread(target=self._server.serve_forever, daemon=True)

    @property
    def url(self) -> str:
        """Of the page."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/"

    def start(self) -> None:
        """Serve the page from now on; `done` is set when clicks were taken."""
        self._thread.start()

    def stop(self) -> None:
        """Serve it no more."""
        self._server.shutdown()
        self._server.server_close()


def _handler(page: ClickPage) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            """Say nothing on the screen."""

        def _answer(self, content: bytes, kind: str, status: int = 200) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def do_GET(self) -> None:
            name = unquote(self.path.partition("?")[0]).removeprefix("/")
            if not name:
                html = (resources.files("kinefit.viewers") / "clicks.html").read_bytes()
                self._answer(html, "text/html; charset=utf-8")
            elif name == "asked.json":
                asked = {"cameras": list(page.pictures), "joints": page.joints, "step": page.step}
                self._answer(json.dumps(asked).encode(), "application/json")
            elif name.removeprefix("picture/") in page.pictures:
                picture = page.pictures[name.removeprefix("picture/")]
                self._answer(picture, "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg")
            else:
                self._answer(b"no such page", "text/plain", 404)

        def do_POST(self) -> None:
            length = int(self.headers.get("Content-Length") or 0)
            try:
                told = json.loads(self.rfile.read(min(length, _LARGEST)))
                answer, taken = page.take(told), True
            except ValueError as error:
                answer, taken = f"no JSON: {error}", False
            except KinefitError as error:
                answer, taken = str(error), False
            self._answer(json.dumps({"taken": taken, "told": answer}).encode(), "application/json")
            if taken:
                page.done.set()

    return Handler
