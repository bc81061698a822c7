"""Serve the pages of `kinefit app` to browsers of this computer alone."""

from __future__ import annotations

import socket
import warnings
from collections.abc import Awaitable, Callable, MutableMapping
from pathlib import Path
from typing import Any

from websockets.datastructures import Headers

from kinefit.errors import ExportError
from kinefit.serving.access import Access, Refusal
from kinefit.viewers.stage import free_port

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Scope]]
Send = Callable[[Scope], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

_RECONNECT_S = 60.0  # that a page may be away, as on a machine that sleeps or computes, and goes on as it was
_POLICY_VIOLATION = 1008  # close code of a WebSocket


class Gate:
    """An application behind the rules of `Access`: requests without the token, or from other pages, end here."""

    def __init__(self, inside: Application, access: Access) -> None:
        self._inside, self._access = inside, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] in ("http", "websocket"):
            headers = Headers()
            for name, value in scope["headers"]:
                headers[name.decode("latin-1")] = value.decode("latin-1")
            found = self._access.check(scope["path"], headers, *scope["server"])
            if isinstance(found, Refusal):
                await _refuse(scope, receive, send, found)
                return
        await self._inside(scope, receive, send)


async def _refuse(scope: Scope, receive: Receive, send: Send, refusal: Refusal) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": _POLICY_VIOLATION, "reason": refusal.reason})
        return
    kind = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": int(refusal.status), "headers": kind})
    await send({"type": "http.response.body", "body": f"{refusal.reason}\n".encode()})


def serve(root: Path, port: int, access: Access, opened: Callable[[str], None]) -> None:
    """Serve the app until Ctrl-C; `opened` is called with its address once it listens.

    Parameters
    ----------
    root : folder of the session: where takes are listed, and dropped videos are put
    port : int, 0 for any; the next one that is free where it is in use
    access : who may connect

    Raises
    ------
    ExportError
        NiceGUI is missing, or no port is free.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            import uvicorn
            from fastapi import FastAPI
            from nicegui import app as pages
            from nicegui import ui
    except ImportError as error:
        remedy = "Install it: pip install 'kinefit[app]'."
        raise ExportError("kinefit app needs the package NiceGUI", remedy=remedy) from error
    from kinefit.app.desk import Desk
    from kinefit.app.pages.routes import add_pages

    listener = socket.create_server((access.host, free_port(access.host, port)))
    desk = Desk(root, prefix=f"/{access.token}")
    add_pages(desk)
    outer = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    pages.on_shutdown(desk.close)
    ui.run_with(
        outer, title="kinefit", mount_path=desk.prefix, show_welcome_message=False, reconnect_timeout=_RECONNECT_S
    )  # fmt: skip
    pages.on_startup(lambda: opened(access.url(listener.getsockname()[1])))
    config = uvicorn.Config(
        Gate(outer, access), log_level="error", ws="websockets-sansio", timeout_graceful_shutdown=2
    )  # fmt: skip
    uvicorn.Server(config).run(sockets=[listener])
