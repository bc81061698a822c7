"""Reports and check pages, which may be of strangers: each has an address of its own, and its scripts go nowhere."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from kinefit.serving.access import Access
from kinefit.serving.policy import APP_PAGES
from kinefit.serving.server import Connection, Page, PageServer

_SUFFIX = ".html"
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
    """

    def __init__(self, root: Path) -> None:
        self._folders = {_without_links(root)}
        self._keys: dict[Path, str] = {}
        self._server = PageServer(Access(), 0, page=self._page, talk=_hang_up)

    def admit(self, folder: Path) -> None:
        """Serve the pages in a folder and below it, too."""
        self._folders.add(_without_links(folder))

    def address(self, file: Path) -> str | None:
        """Address of a page; None where the file, after all links, is no page, or lies outside of all folders."""
        if not self._is_served(found := _without_links(file)):
            return None
        return f"{self._server.url}{self._keys.setdefault(found, secrets.token_urlsafe(_KEY_BYTES))}"

    def close(self) -> None:
        """Serve them no more."""
        self._server.close()

    def _is_served(self, file: Path) -> bool:
        within = any(file.is_relative_to(folder) for folder in self._folders)
        return within and file.suffix.lower() == _SUFFIX and file.is_file()

    def _page(self, path: str) -> Page | None:
        file = next((file for file, key in self._keys.items() if path == f"/{key}"), None)
        if file is None or not self._is_served(_without_links(file)):
            return None
        try:
            return Page(file.read_bytes(), policy=_POLICY, framed_by=APP_PAGES)
        except OSError:
            return None


def _without_links(path: Path) -> Path:
    """Where a path leads; links that go in a circle lead nowhere, as `Path.resolve` does not say."""
    return Path(os.path.realpath(path))


async def _hang_up(connection: Connection) -> None:
    """Say nothing: pages of files open no WebSockets."""
