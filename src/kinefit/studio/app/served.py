"""What has an address of its own: 3D scenes, and reports and check pages, whose scripts may be of strangers."""

from __future__ import annotations

import os
import secrets
import threading
from pathlib import Path

from kinefit.studio.serving.access import APP_PAGES, Access
from kinefit.studio.serving.server import Page, PageServer
from kinefit.studio.viewers.player import Player
from kinefit.studio.viewers.show import ViewerContent
from kinefit.studio.viewers.stage import open_server, quiet

_KEY_BYTES = 18
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "base-uri 'none'; form-action 'none'; sandbox allow-scripts allow-downloads"
)
"""A page with its own scripts and images and without connections, of an origin that no other page has."""


class FilePages(PageServer):
    """A server of pages that lie among recordings.

    Parameters
    ----------
    root : folder whose pages, and those in all folders below it, are served

    Attributes
    ----------
    folders : set of Path, `root` and others whose pages are served
    """

    def __init__(self, root: Path) -> None:
        self.folders = {root}
        self._keys: dict[Path, str] = {}
        super().__init__(Access())

    def address(self, file: Path) -> str | None:
        """Address of a page; None where the file, after all links, is no page, or lies outside of all folders."""
        found = Path(os.path.realpath(file))  # `Path.resolve` raises where links go in a circle
        within = any(found.is_relative_to(os.path.realpath(folder)) for folder in self.folders)
        if not within or found.suffix.lower() != ".html" or not found.is_file():
            return None
        return f"{self.url}{self._keys.setdefault(found, secrets.token_urlsafe(_KEY_BYTES))}"

    def page(self, path: str) -> Page | None:
        """The file of an address."""
        file = next((file for file, key in self._keys.items() if path == f"/{key}"), None)
        if file is None or not (self.address(file) or "").endswith(path):  # a link by now
            return None
        return Page(file.read_bytes(), policy=_POLICY, framed_by=APP_PAGES)


_END_TIMEOUT_S = 5.0  # of the frame that is shown


class ScenePage:
    """A player of motions that runs until it is closed.

    Parameters
    ----------
    content : ViewerContent
    with_panel : whether the player's controls are open at first

    Attributes
    ----------
    address : of its page, with the token
    player : Player

    Raises
    ------
    ExportError
        No port is free.
    """

    def __init__(self, content: ViewerContent, *, with_panel: bool = True) -> None:
        access = Access()
        self._server = open_server(0, access, label=content.name)
        self.address = access.url(self._server.get_port())
        self.player = Player(self._server, content)
        if not with_panel:
            self._server.gui.main_panel.minimize()
        self._ended = threading.Event()
        self._running = threading.Thread(target=self.player.run, args=(self._ended.is_set,), daemon=True)
        self._running.start()

    def close(self) -> None:
        """End the player and its server."""
        self._ended.set()
        self._running.join(_END_TIMEOUT_S)
        with quiet():
            self._server.stop()
