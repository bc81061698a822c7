"""A page on which joints are clicked in the images of one time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from threading import Event
from typing import Any
from urllib.parse import unquote

import msgspec

from kinefit.errors import KinefitError
from kinefit.studio.serving.access import Access
from kinefit.studio.serving.server import Connection, Page, PageServer

Take = Callable[[dict[str, Any]], str]
"""What is done with clicks as JSON has them; it returns what to tell, or raises a `KinefitError`."""

_POLICY = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'"
_FILES = {
    "/": ("clicks.html", "text/html; charset=utf-8"), "/clicks.css": ("clicks.css", "text/css; charset=utf-8"),
    "/clicks.js": ("clicks.js", "text/javascript; charset=utf-8"),
}  # fmt: skip


class _ClicksMessage(msgspec.Struct, forbid_unknown_fields=True):
    """What the page sends when the user is done; no part of it is of any depth."""

    step: int
    points: dict[str, dict[str, list[float]]]


class ClickPage(PageServer):
    """Images of one time in the browser, in which joints are clicked; served from the start until `close`.

    Parameters
    ----------
    pictures : {camera: JPEG or PNG}
    joints : names that are asked for, in this order
    take : what is done with the clicks when the user is done; its message, or its error, is shown on the page
    step : of the images

    Attributes
    ----------
    done : Event, set when clicks were taken
    """

    def __init__(self, pictures: Mapping[str, bytes], joints: Sequence[str], take: Take, *, step: int = 0) -> None:
        self.pictures, self.take = dict(pictures), take
        self.done = Event()
        self._asked = msgspec.json.encode({"cameras": list(pictures), "joints": list(joints), "step": step}).decode()
        self._taking = asyncio.Lock()
        super().__init__(Access())

    def page(self, path: str) -> Page | None:
        """The page, its style and script, and the images."""
        if path in _FILES:
            name, kind = _FILES[path]
            return Page((resources.files("kinefit.studio.viewers") / name).read_bytes(), kind, _POLICY)
        picture = self.pictures.get(unquote(path).removeprefix("/picture/"))
        if picture is None:
            return None
        return Page(picture, "image/png" if picture.startswith(b"\x89PNG") else "image/jpeg")

    async def talk(self, connection: Connection) -> None:
        """Say what is asked for, and answer clicks."""
        await connection.send(self._asked)
        while True:
            text = await connection.recv(decode=False)
            async with self._taking:  # files are written
                answer, taken = await asyncio.to_thread(self._answer, text)
            try:
                await connection.send(msgspec.json.encode({"taken": taken, "answer": answer}).decode())
            finally:  # also where the browser is gone
                if taken:
                    self.done.set()

    def _answer(self, text: bytes) -> tuple[str, bool]:
        try:
            return self.take(msgspec.to_builtins(msgspec.json.decode(text, type=_ClicksMessage))), True
        except msgspec.DecodeError as error:
            return f"These clicks cannot be used: {error}.", False
        except KinefitError as error:
            return str(error), False
