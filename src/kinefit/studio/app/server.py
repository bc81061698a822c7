"""Serve the pages of `kinefit app` to browsers of this computer alone."""

from __future__ import annotations

import secrets
import warnings
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from http import HTTPStatus
from pathlib import Path
from typing import Any

from websockets.datastructures import Headers

from kinefit.errors import ExportError, extra
from kinefit.studio.serving.access import APP_PAGES, Access, Refusal
from kinefit.studio.serving.server import HEADERS, listen

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Scope]]
Send = Callable[[Scope], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

_RECONNECT_S = 60.0  # that a page may be away, as on a machine that sleeps or computes, and goes on as it was
_POLICY_VIOLATION = 1008  # close code of a WebSocket
_OWN_SITES = {"same-origin", "none"}  # of `Sec-Fetch-Site`: the app's own pages, and the user's address bar
_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-eval' 'nonce-{nonce}'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; "
    f"frame-src 'self' {APP_PAGES}; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
"""Of all answers: NiceGUI needs eval and styles in the page; scripts in attributes do not run."""


class Gate:
    """An application behind the rules of `Access`: requests without the token, or led by other pages, end here."""

    def __init__(self, inside: Application, access: Access) -> None:
        self._inside, self._access = inside, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] in ("http", "websocket"):
            headers = Headers()
            for name, value in scope["headers"]:
                headers[name.decode("latin-1")] = value.decode("latin-1")
            (address, port), peer = scope["server"], scope["client"] or ("", 0)
            found = self._access.check(scope["path"], headers, address, port, peer[1])
            if not (isinstance(found, Refusal) or set(headers.get_all("Sec-Fetch-Site")) <= _OWN_SITES):
                reason = "Another page led here. Copy the printed address into the address bar instead."
                found = Refusal(HTTPStatus.FORBIDDEN, reason)
            send = _with_policy(send)
            if isinstance(found, Refusal):
                await _refuse(scope, receive, send, found)
                return
        await self._inside(scope, receive, send)


async def _refuse(scope: Scope, receive: Receive, send: Send, refusal: Refusal) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": _POLICY_VIOLATION, "reason": refusal.reason})
        return
    headers = _encoded({"Content-Type": "text/plain; charset=utf-8", "Cache-Control": "no-store", **refusal.headers})
    await send({"type": "http.response.start", "status": int(refusal.status), "headers": [*headers.items()]})
    await send({"type": "http.response.body", "body": f"{refusal.reason}\n".encode()})


def _with_policy(send: Send) -> Send:
    """Send answers with the app's policy; the scripts of a page are marked as its own by a number used once."""
    nonce, is_page = secrets.token_urlsafe(18), False
    kept = {name: value for name, value in HEADERS.items() if name != "Cache-Control"}  # scripts and styles are cached
    own = kept | {"Content-Security-Policy": _POLICY.format(nonce=nonce), "X-Frame-Options": "SAMEORIGIN"}

    async def sending(message: Scope) -> None:
        nonlocal is_page
        if message["type"] == "http.response.start":
            headers = dict(message["headers"]) | _encoded(own)
            is_page = headers.get(b"content-type", b"").startswith(b"text/html")
            if is_page:
                headers.pop(b"content-length", None)
            message["headers"] = [*headers.items()]
        elif is_page and message["type"] == "http.response.body":
            message["body"] = message.get("body", b"").replace(b"<script", f'<script nonce="{nonce}"'.encode())
        await send(message)

    return sending


def _encoded(headers: Mapping[str, str]) -> dict[bytes, bytes]:
    return {name.lower().encode(): value.encode() for name, value in headers.items()}


def serve(root: Path, port: int, access: Access, opened: Callable[[int], None]) -> None:
    """Serve the app until Ctrl-C; `opened` is called with its port once it listens.

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
    known = warnings.catch_warnings(action="ignore", category=DeprecationWarning)
    with extra("app", "kinefit app needs the package NiceGUI", ExportError), known:
        import uvicorn
        from fastapi import FastAPI
        from nicegui import app as pages
        from nicegui import ui
    from kinefit.studio.app.desk import Desk
    from kinefit.studio.app.pages.routes import add_pages

    listener = listen(access.host, port, search=True)
    desk = Desk(root, prefix=f"/{access.token}")
    add_pages(desk)
    outer = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    pages.on_shutdown(desk.close)
    ui.run_with(
        outer, title="kinefit", mount_path=desk.prefix, show_welcome_message=False, reconnect_timeout=_RECONNECT_S,
        gzip_middleware_factory=None,  # pages are marked by the gate
    )  # fmt: skip
    pages.on_startup(lambda: opened(listener.getsockname()[1]))
    config = uvicorn.Config(
        Gate(outer, access), log_level="error", ws="websockets-sansio", timeout_graceful_shutdown=2
    )  # fmt: skip
    uvicorn.Server(config).run(sockets=[listener])
