"""Reports and check pages, which may be of strangers: each has an address of its own, and its scripts go nowhere."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from kinefit.serving.access import Access
from kinefit.serving.policy import APP_PAGES
from kinefit.serving.server import Connection, Page, PageServer

_KEY_BYTES = 18
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "base-uri 'none'; form-action 'none'; sandbox allow-scripts allow-downloads"
)
"""A page with its own scripts and images and without connections, of an origin that no other page has."""


class FilePages:
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
        self._server = PageServer(Access(), 0, page=self._page, talk=_hang_up)

    def address(self, file: Path) -> str | None:
        """Address of a page; None where the file, after all links, is no page, or lies outside of all folders."""
        found = Path(os.path.realpath(file))  # `Path.resolve` raises where links go in a circle
        within = any(found.is_relative_to(os.path.realpath(folder)) for folder in self.folders)
        if not within or found.suffix.lower() != ".html" or not found.is_file():
            return None
        return f"{self._server.url}{self._keys.setdefault(found, secrets.token_urlsafe(_KEY_BYTES))}"

    def close(self) -> None:
        """Serve them no more."""
        self._server.close()

    def _page(self, path: str) -> Page | None:
        file = next((file for file, key in self._keys.items() if path == f"/{key}"), None)
        if file is None or not (self.address(file) or "").endswith(path):  # a link by now
            return None
        return Page(file.read_bytes(), policy=_POLICY, framed_by=APP_PAGES)


async def _hang_up(connection: Connection) -> None:
    """Say nothing: pages of files open no WebSockets."""
