"""Serve a page and WebSockets at one port, in a thread of its own, to clients that `Access` admits."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import socket
import threading
import time
from collections.abc import Callable
from http import HTTPStatus
from typing import Any, NamedTuple

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from kinefit.errors import ExportError
from kinefit.studio.serving.access import Access, Refusal

MAX_MESSAGE_BYTES = 2**18
"""Of one message of a client: clicks of 100 joints in 50 images; a longer one closes the connection."""

MAX_FRAMES_AT_ONCE = 60.0
"""Of one client, after it was quiet for two seconds; 8 KiB count as one frame, too. Who sends more is disconnected."""

MAX_FRAMES_PER_SECOND = 30.0
"""Of one client on average: as many requests as a camera has images."""

_FRAME_BYTES = 8192.0  # that count as one frame
_SLICE_BYTES = 1024  # of what arrived, until its frames are counted: 170 of the smallest, 2 ms
_MAX_CONNECTIONS = 128  # at a time, half-open ones included; a process may have 1,024 files
_MAX_CONNECTIONS_AT_ONCE = 64.0  # of all clients: a page with 50 images opens one for each
_MAX_CONNECTIONS_PER_SECOND = 16.0  # on average; each costs 1 ms, and 2 ms where it floods
_MAX_WAITING_CONNECTIONS = 32  # in the system's queue: two seconds' worth
_PROBLEM_CONNECTIONS = "too many connections are opened"
_PORTS, _MAX_PORTS_TRIED = 65536, 100
_OPEN_TIMEOUT_S = 5.0  # of a handshake
_CLOSE_TIMEOUT_S = 1.0

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",  # the address has the token
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Of every answer."""


class Page(NamedTuple):
    """What a browser gets: content, its type, and the content security policy of a page."""

    content: bytes
    kind: str = "text/html; charset=utf-8"
    policy: str = "default-src 'none'"
    framed_by: str = "'none'"  # pages that may show it as a part of theirs, as the policy `frame-ancestors` has them


class Allowance:
    """Token bucket: a burst of events, refilled at a constant rate."""

    def __init__(self, at_once: float, per_second: float) -> None:
        self._left = self._most = at_once
        self._per_second, self._time = per_second, -float("inf")

    def has(self, now: float, cost: float = 1.0) -> bool:
        """Whether some are left at a time [s]."""
        self._left = min(self._most, self._left + (now - self._time) * self._per_second)
        self._time = now
        return self._left >= cost

    def take(self, now: float, cost: float = 1.0) -> bool:
        """Take some at a time [s]; False where fewer are left."""
        is_there = self.has(now, cost)
        self._left -= cost * is_there
        return is_there


class Connection(ServerConnection):
    """A client, with whether it has the token; one that floods is disconnected before it costs anybody time."""

    has_token = False

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._frames = Allowance(MAX_FRAMES_AT_ONCE, MAX_FRAMES_PER_SECOND)

    def connection_made(self, transport: Any) -> None:
        """Take a connection, unless too many are open."""
        super().connection_made(transport)
        if len(self.server.handlers) > _MAX_CONNECTIONS:
            transport.abort()

    def data_received(self, data: bytes) -> None:
        """Take bytes in slices, so that a flood is noticed before all of it is read."""
        for start in range(0, len(data), _SLICE_BYTES):
            part = data[start : start + _SLICE_BYTES]
            if self._count(len(part) / _FRAME_BYTES):
                super().data_received(part)

    def process_event(self, event: Any) -> None:
        """Count frames of every kind, after the handshake: messages, parts of them, pings."""
        if self.request is None or self._count(1.0):
            super().process_event(event)

    def _count(self, cost: float) -> bool:
        """Whether a client that sent so much is still heard."""
        if not self._frames.take(self.loop.time(), cost):
            self.drop("too many messages")
        return not self.transport.is_closing()

    def drop(self, reason: str) -> None:
        """Disconnect at once, without waiting for the client's consent."""
        if not self.transport.is_closing():
            self.protocol.fail(CloseCode.POLICY_VIOLATION, reason)
            self.send_data()
            self.transport.abort()


class _Listener(socket.socket):
    """A port whose connections wait in the system's queue, at no cost, while too many are opened."""

    def __init__(self, bound: socket.socket) -> None:
        super().__init__(fileno=bound.detach())
        self._opened = Allowance(_MAX_CONNECTIONS_AT_ONCE, _MAX_CONNECTIONS_PER_SECOND)

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection, or the error after which asyncio looks again in a second."""
        if not self._opened.has(time.monotonic()):
            raise OSError(errno.EMFILE, _PROBLEM_CONNECTIONS)
        accepted = super().accept()
        self._opened.take(time.monotonic())
        return accepted


def _report(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log what goes wrong in a server's thread, except that connections have to wait."""
    if _PROBLEM_CONNECTIONS not in str(context.get("exception")):
        loop.default_exception_handler(context)


Respond = Callable[[Any, Request], Response | None]


def guard(access: Access, respond: Respond) -> Respond:
    """What websockets asks of each request: `access` first, then `respond`, which sees the path behind the token."""

    def process(connection: ServerConnection, request: Request) -> Response | None:
        address, port = connection.transport.get_extra_info("sockname")[:2]
        peer = connection.transport.get_extra_info("peername", ("", 0))[1]
        found = access.check(request.path, request.headers, address, port, peer)
        if isinstance(found, Refusal):
            ends = connection.respond(found.status, f"{found.reason}\n")
            ends.headers.update(HEADERS | found.headers)
            return ends
        request.path, connection.has_token = found  # type: ignore[attr-defined]
        response = respond(connection, request)
        if response is not None:
            response.headers.update(HEADERS)
        return response

    return process


def connection_log() -> logging.Logger:
    """A logger for websockets that says nothing of port probes, TLS hellos and broken handshakes."""
    log = logging.getLogger("kinefit.studio.serving")
    log.addFilter(lambda record: record.msg != "opening handshake failed")
    return log


def listen(host: str, port: int, *, search: bool = False) -> socket.socket:
    """A socket that listens at a port of a host, 0 for any.

    Parameters
    ----------
    search : whether the next port that is free is taken where this one is in use

    Raises
    ------
    ExportError
        The port is in use, or the host none of this computer.
    """
    for candidate in [*range(port, min(port + _MAX_PORTS_TRIED, _PORTS)), 0] if search else [port]:
        try:
            found = socket.getaddrinfo(host or None, candidate, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
            return socket.create_server(found[0][4], family=found[0][0])
        except (OSError, UnicodeError) as error:  # a host that is no name at all is the second
            is_used = getattr(error, "errno", 0) in (errno.EADDRINUSE, errno.EACCES)
            if search and is_used and candidate:
                continue
            reason = getattr(error, "strerror", None) or error
            remedy = "Give another port with --port, or stop the program that uses it."
            remedy = remedy if is_used else "Use 127.0.0.1, or 0.0.0.0 for all networks."
            problem = f"the server cannot start at {host}:{candidate} ({reason})"
            raise ExportError(problem, place="--port", remedy=remedy) from error
    raise AssertionError


class PageServer:
    """A page and WebSockets at one port: a class of its own says what is there, by `page` and `talk`.

    Parameters
    ----------
    access : who may connect
    port : 0 for any; the next free one is not taken, since clients are given one port

    Raises
    ------
    ExportError
        The port is in use, or the host none of this computer.
    """

    def __init__(self, access: Access, port: int = 0) -> None:
        self.access, listener = access, listen(access.host, port)
        self.port: int = listener.getsockname()[1]
        self._loop = asyncio.SelectorEventLoop()  # which asks the listener, on every system
        self._loop.set_exception_handler(_report)
        self._over = asyncio.Event()
        self._thread = threading.Thread(target=self._run, args=(listener,), daemon=True, name="kinefit-serving")
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page, with the token."""
        return self.access.url(self.port)

    def opening(self) -> str:
        """Address that leads to the page once."""
        return self.access.opening(self.port)

    def page(self, path: str) -> Page | None:
        """What a browser gets at a path behind the token, such as "/"; None where there is nothing."""
        raise NotImplementedError

    async def talk(self, connection: Connection) -> None:
        """Talk with a WebSocket client, until this returns or the connection ends; nothing by default."""

    def call(self, act: Callable[..., object], *arguments: Any) -> None:
        """Have something done in the server's thread, from any other; nothing where the server is closed."""
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(act, *arguments)

    def close(self) -> None:
        """Close the port and all connections."""
        self.call(self._over.set)
        self._thread.join(timeout=5.0)

    def _run(self, listener: socket.socket) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve(listener))
        finally:
            self._loop.close()

    async def _serve(self, listener: socket.socket) -> None:
        async with serve(
            self._client, sock=_Listener(listener), backlog=_MAX_WAITING_CONNECTIONS, create_connection=Connection,
            process_request=guard(self.access, self._respond), logger=connection_log(), max_size=MAX_MESSAGE_BYTES,
            compression=None, open_timeout=_OPEN_TIMEOUT_S, close_timeout=_CLOSE_TIMEOUT_S,
        ):  # fmt: skip
            await self._over.wait()

    def _respond(self, connection: Connection, request: Request) -> Response | None:
        """The page to browsers that ask for it; WebSockets go on."""
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return None
        page = self.page(request.path)
        if page is None:
            return connection.respond(HTTPStatus.NOT_FOUND, "There is no such page.\n")
        headers = Headers([
            ("Content-Type", page.kind), ("Content-Length", str(len(page.content))),
            ("Content-Security-Policy", f"{page.policy}; frame-ancestors {page.framed_by}"),
        ])  # fmt: skip
        return Response(HTTPStatus.OK.value, HTTPStatus.OK.phrase, headers, page.content)

    async def _client(self, connection: ServerConnection) -> None:
        assert isinstance(connection, Connection)
        with contextlib.suppress(ConnectionClosed):
            await self.talk(connection)
