"""Poses over WebSocket, and the page that shows them: any number of receivers, none of which can keep another waiting.

Each receiver has one slot: a slow one gets the newest pose and misses those between, which it sees by their numbers.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from http import HTTPStatus
from typing import Any

import msgspec
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from kinefit.bodies import Body
from kinefit.errors import ExportError
from kinefit.live.packets import Posed
from kinefit.live.receivers.page import page

_LARGEST = 65536  # [bytes] of what a client may ask
Ask = Callable[[Mapping[str, Any]], None]


class _Client:
    """What one receiver still has to get."""

    def __init__(self) -> None:
        self.hello: bytes | None = None
        self.pose: bytes | None = None
        self.answers: list[bytes] = []
        self.news = asyncio.Event()

    async def next(self) -> list[bytes]:
        """All that is new."""
        await self.news.wait()
        self.news.clear()
        out = [one for one in (self.hello, *self.answers, self.pose) if one is not None]
        self.hello, self.pose, self.answers = None, None, []
        return out


class WebSockets:
    """Serves poses and their page at one port, to this computer alone unless `host` says otherwise.

    Parameters
    ----------
    port : the next free one is not taken: receivers are told one port. 0 for any.
    host : "127.0.0.1" or "0.0.0.0" for all networks
    title : of the page
    ask : what is done with clients' wishes; None where they are to be left unheard

    Raises
    ------
    ExportError
        The port is in use, or the host none of this computer.
    """

    def __init__(self, port: int, *, host: str = "127.0.0.1", title: str = "kinefit", ask: Ask | None = None) -> None:
        self._ask, self._title, self._host = ask, title, host
        self._clients: set[_Client] = set()
        self._hello: bytes | None = None
        self._body: Body | None = None
        self._up = "z"
        self._ready = threading.Event()
        self._wrong: OSError | None = None
        self._loop = asyncio.new_event_loop()
        self._over = asyncio.Event()
        self.port = port
        self._thread = threading.Thread(target=self._run, daemon=True, name="websocket")
        self._thread.start()
        self._ready.wait()
        if self._wrong is not None:
            self._thread.join()
            raise ExportError(
                f"nothing can be served at {host}:{port} ({self._wrong.strerror or self._wrong})", place="--port",
                remedy="Name another port, or stop what uses it.",
            )  # fmt: skip

    @property
    def address(self) -> str:
        """Of the page."""
        host = "localhost" if self._host in ("127.0.0.1", "0.0.0.0") else self._host
        return f"http://{host}:{self.port}"

    @property
    def receivers(self) -> int:
        """How many are connected."""
        return len(self._clients)

    def hello(self, body: Body, packet: bytes) -> None:
        """Tell all, and everybody who comes later, of the body."""
        self._up = msgspec.json.decode(packet)["up"]
        self._body, self._hello = body, packet
        self._loop.call_soon_threadsafe(self._spread, packet, True)

    def pose(self, posed: Posed, packet: bytes) -> None:
        """Put a pose into every receiver's slot."""
        if self._clients:
            self._loop.call_soon_threadsafe(self._spread, packet, False)

    def close(self) -> None:
        """Close all connections."""
        self._loop.call_soon_threadsafe(self._over.set)
        self._thread.join(timeout=5.0)

    def _spread(self, packet: bytes, hello: bool) -> None:
        for client in self._clients:
            if hello:
                client.hello, client.pose = packet, None
            else:
                client.pose = packet
            client.news.set()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        except OSError as error:
            self._wrong = error
        finally:
            self._ready.set()
            self._loop.close()

    async def _serve(self) -> None:
        server: Server
        async with serve(
            self._client, self._host, self.port, process_request=self._page, max_size=_LARGEST, compression=None,
        ) as server:  # fmt: skip
            self.port = next(iter(server.sockets)).getsockname()[1]
            self._ready.set()
            await self._over.wait()

    def _page(self, connection: ServerConnection, request: Request) -> Response | None:
        """The page to browsers that ask for it; WebSockets go on."""
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return None
        if request.path.partition("?")[0] != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "no such page\n")
        content = page(self._title, self._body, self._up).encode()
        headers = Headers([("Content-Type", "text/html; charset=utf-8"), ("Content-Length", str(len(content)))])
        return Response(HTTPStatus.OK.value, HTTPStatus.OK.phrase, headers, content)

    async def _client(self, connection: ServerConnection) -> None:
        client = _Client()
        if self._hello is not None:
            client.hello = self._hello
            client.news.set()
        self._clients.add(client)
        listening = asyncio.ensure_future(self._listen(connection, client))
        try:
            while True:
                for packet in await client.next():
                    await connection.send(packet.decode())
        except ConnectionClosed:
            return
        finally:
            self._clients.discard(client)
            listening.cancel()

    async def _listen(self, connection: ServerConnection, client: _Client) -> None:
        """Pass on what a client asks for; what cannot be read is answered at once."""

        def answer(told: Mapping[str, Any]) -> None:  # from any thread
            self._loop.call_soon_threadsafe(back, msgspec.json.encode(told))

        def back(packet: bytes) -> None:
            client.answers.append(packet)
            client.news.set()

        async for text in connection:
            try:
                wish = msgspec.json.decode(text)
            except msgspec.DecodeError as error:
                answer({"type": "refused", "why": f"this is no JSON: {error}"})
                continue
            if not isinstance(wish, dict) or "answer" in wish:
                answer({"type": "refused", "why": 'Ask with one JSON object, such as {"stop": true}.'})
            elif self._ask is None:
                answer({"type": "refused", "why": "This session takes no wishes."})
            else:
                self._ask({**wish, "answer": answer})
