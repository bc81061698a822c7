"""Serve poses over WebSocket, and a page that shows them, to any number of independent receivers.

Each receiver has one slot: a slow one gets the newest pose and skips those between, as their numbers show.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from html import escape
from importlib import resources
from typing import Any

import msgspec
from websockets.exceptions import ConnectionClosed

from kinefit.bodies import Body
from kinefit.exporters.report.figure import live_figure
from kinefit.live.packets import Answer, PosePacket
from kinefit.serving.access import APP_PAGES, Access, inline_policy
from kinefit.serving.server import Connection, Page, PageServer

_MAX_WAITING_ANSWERS = 100  # a client that leaves more unread is disconnected
Ask = Callable[[bytes, Answer], None]


class _Client:
    """Unsent packets of one receiver."""

    def __init__(self) -> None:
        self.hello: bytes | None = None
        self.pose: bytes | None = None
        self.answers: list[bytes] = []
        self.news = asyncio.Event()

    async def next(self) -> list[bytes]:
        """Wait for new packets, and return all of them."""
        await self.news.wait()
        self.news.clear()
        out = [packet for packet in (self.hello, *self.answers, self.pose) if packet is not None]
        self.hello, self.pose, self.answers = None, None, []
        return out


class WebSockets(PageServer):
    """Server of poses and their page at one port, by default to this computer alone.

    Parameters
    ----------
    port : fixed, as receivers expect it; 0 for any free one
    host : "127.0.0.1" or "0.0.0.0" for all networks
    token : of the address, see `serving.access.Access`; None for a random one
    title : of the page
    ask : callback for a client's wish (JSON) and its answer; None rejects all wishes

    Raises
    ------
    ExportError
        The port is in use, the host is none of this computer, or the token is invalid.
    """

    def __init__(
        self, port: int, *, host: str = "127.0.0.1", token: str | None = None, title: str = "kinefit",
        ask: Ask | None = None,
    ) -> None:  # fmt: skip
        self._ask, self._title = ask, title
        self._clients: set[_Client] = set()
        self._hello: bytes | None = None
        self._page = live_page(title, None, "z")
        super().__init__(Access(host, token, readers=True), port)

    def page(self, path: str) -> Page | None:
        """The page of the body; its socket's address has ws instead of http."""
        return self._page if path == "/" else None

    @property
    def receivers(self) -> int:
        """Number of connected receivers."""
        return len(self._clients)

    def hello(self, body: Body, packet: bytes) -> None:
        """Send a new body to all present and future receivers."""
        self._page = live_page(self._title, body, msgspec.json.decode(packet)["up"])
        self._hello = packet
        self.call(self._spread, packet, True)

    def pose(self, posed: PosePacket, packet: bytes) -> None:
        """Put a pose into every receiver's slot."""
        if self._clients:
            self.call(self._spread, packet, False)

    def _spread(self, packet: bytes, hello: bool) -> None:
        for client in self._clients:
            if hello:
                client.hello, client.pose = packet, None
            else:
                client.pose = packet
            client.news.set()

    async def talk(self, connection: Connection) -> None:
        """Send packets and receive wishes until the client disconnects."""
        client = _Client()
        if self._hello is not None:
            client.hello = self._hello
            client.news.set()
        self._clients.add(client)
        sending = asyncio.ensure_future(_send(connection, client))
        try:
            await self._listen(connection, client)
        finally:
            self._clients.discard(client)
            sending.cancel()

    async def _listen(self, connection: Connection, client: _Client) -> None:
        """Pass a client's wishes on; reject those that are not allowed."""

        def answer(content: Mapping[str, Any]) -> None:  # from any thread
            self.call(back, msgspec.json.encode(content))

        def back(packet: bytes) -> None:
            if len(client.answers) >= _MAX_WAITING_ANSWERS:
                connection.drop("answers are not read")
            else:
                client.answers.append(packet)
                client.news.set()

        while True:
            wish = await connection.recv(decode=False)
            if not connection.has_token:
                why = "Requests need the token: connect to the address that kinefit printed, with ws instead of http."
                answer({"type": "refused", "why": why})
            elif self._ask is None:
                answer({"type": "refused", "why": "This session accepts no requests."})
            else:
                self._ask(wish, answer)


async def _send(connection: Connection, client: _Client) -> None:
    try:
        while True:
            for packet in await client.next():
                await connection.send(packet.decode())
    except ConnectionClosed:
        return


_WAITING = '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="1"><p>waiting for the body'


def live_page(title: str, body: Body | None, up: str) -> Page:
    """Self-contained HTML page; without a body it reloads until there is one."""
    if body is None:
        return Page(_WAITING.encode(), framed_by=APP_PAGES)
    report = resources.files("kinefit.exporters.report")
    own = resources.files("kinefit.live.receivers")
    style = (report / "page.css").read_text("utf-8") + (own / "page.css").read_text("utf-8")
    scripts = [(room / name).read_text("utf-8") for room, name in ((report, "player.js"), (own, "page.js"))]
    html = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{style}</style></head><body><main>'
        f'<h1>{escape(title)}</h1><p id="status">waiting</p>{live_figure(body, up)}<aside id="panel"></aside></main>'
        f"{''.join(f'<script>{script}</script>' for script in scripts)}</body></html>"
    )
    return Page(html.encode(), policy=inline_policy(scripts, [style], "connect-src 'self'"), framed_by=APP_PAGES)
