"""Decide who may connect to a server of kinefit, and what its pages may do; docs/live.md describes the rules."""

from __future__ import annotations

import hmac
import ipaddress
import os
import re
import secrets
import socket
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import NamedTuple

from websockets.datastructures import Headers

from kinefit.errors import ExportError
from kinefit.studio.serving import TOKEN_VARIABLE

APP_PAGES = "http://localhost:* http://127.0.0.1:*"
"""Pages of `kinefit app`, whose port is not known, as the policies `frame-src` and `frame-ancestors` have them."""


def is_of_this_user(peer_port: int, port: int) -> bool:
    """Whether a connection between two ports of this computer was opened by this user.

    Only Linux says who opened it. Where it is not known, the answer is yes.
    """
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        with suppress(OSError):
            for line in Path(table).read_text().splitlines()[1:]:
                _, local, remote, _, _, _, _, user, *_ = line.split()
                if [int(end.rpartition(":")[2], 16) for end in (local, remote)] == [peer_port, port]:
                    return int(user) == os.getuid()
    return True


_TOKEN_BYTES = 18  # 144 random bits: 24 characters of the address
_TOKEN = re.compile(r"[A-Za-z0-9_-]{16,128}")  # stands in an address as it is; a shorter one can be tried out
_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
_ALL_ADDRESSES = ("", "0.0.0.0", "::")
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::(\d{1,5}))?")
_HTTP_PORT = 80  # of a Host without one


class Admission(NamedTuple):
    """A request that may go on: the path behind the token, and whether the token was there."""

    path: str
    has_token: bool


class Refusal(NamedTuple):
    """A request that ends here: its HTTP status, the reason in one sentence, and what the browser asks for next."""

    status: HTTPStatus
    reason: str
    then: str = ""  # path of the page, after a one-time address: asked for by a page of this server

    @property
    def headers(self) -> dict[str, str]:
        """Further headers of the answer."""
        return {"Refresh": f"0; url={self.then}"} if self.then else {}


class Access:
    """The rules of one server.

    A request is refused if its `Host` is no address of the server (a foreign name that resolves to this computer), if
    its `Origin` is another page's, or if its path does not begin with the token.

    Parameters
    ----------
    host : address or name that the server is bound to; "0.0.0.0" for all networks
    token : 16 to 128 letters, digits, "-" and "_"; a random one where it is None
    readers : whether programs of this computer may open a WebSocket without the token, to read; browsers may not, nor
        anybody where the server is open to a network

    Raises
    ------
    ExportError
        A token of another form.
    """

    def __init__(self, host: str = "127.0.0.1", token: str | None = None, *, readers: bool = False) -> None:
        self.host = host
        self.token = secrets.token_urlsafe(_TOKEN_BYTES) if token is None else token
        if not _TOKEN.fullmatch(self.token):
            remedy = f"Give 16 to 128 letters, digits, - and _, with --token or {TOKEN_VARIABLE}; or leave it out."
            raise ExportError(f"a token of {len(self.token)} characters is not valid", remedy=remedy)
        self.is_local = host == "localhost" or (_is_number(host) and ipaddress.ip_address(host).is_loopback)
        self._readers = readers and self.is_local
        self._opening = ""

    @property
    def warning(self) -> str | None:
        """Warning for a server that a network reaches; None for one of this computer alone."""
        if self.is_local:
            return None
        return (
            f"The server at {self.host or 'all addresses'} is open to the network: everyone with its token can see and "
            "control this session. The connection is not encrypted, so other computers in reach can read the token."
        )

    def url(self, port: int) -> str:
        """Address of the page at a port, with the token."""
        host = "localhost" if self.host in (*_ALL_ADDRESSES, "127.0.0.1") else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{port}/{self.token}/"

    def opening(self, port: int) -> str:
        """Address that leads to the page once, and has no token.

        It is for a browser's command line, which other users of the computer can read.
        """
        self._opening = secrets.token_urlsafe(_TOKEN_BYTES)
        return f"{self.url(port).removesuffix(f'{self.token}/')}{self._opening}/"

    def check(self, path: str, headers: Headers, address: str, port: int, peer: int = 0) -> Admission | Refusal:
        """Whether a request may go on.

        Parameters
        ----------
        path : of the request
        headers : of the request
        address, port : of this computer, at which the request arrived
        peer : port from which it was sent; 0: unknown
        """
        hosts = [host.lower() for host in headers.get_all("Host")]
        if len(hosts) != 1 or not self._is_own(hosts[0], address, port):
            return Refusal(HTTPStatus.MISDIRECTED_REQUEST, f"This host name is not served; the port is {port}.")
        origins = [origin.lower() for origin in headers.get_all("Origin")]
        if origins and origins != [f"http://{hosts[0]}"]:
            return Refusal(HTTPStatus.FORBIDDEN, "Pages of other servers may not connect.")
        given, _, rest = path.partition("?")[0].removeprefix("/").partition("/")
        secret = given.encode(errors="surrogateescape")
        if hmac.compare_digest(secret, self.token.encode()):
            return Admission(f"/{rest}", True)
        if given and hmac.compare_digest(secret, self._opening.encode()) and is_of_this_user(peer, port):
            self._opening = ""
            return Refusal(HTTPStatus.OK, "The page opens.", f"/{self.token}/")
        if given:
            reason = "The address has another token than this server, or was used before. Open the printed address."
            return Refusal(HTTPStatus.FORBIDDEN, reason)
        if self._readers and not origins and "Upgrade" in headers:
            return Admission("/", False)
        return Refusal(HTTPStatus.FORBIDDEN, "Open the address that the command printed: it ends with the token.")

    def _is_own(self, host: str, address: str, port: int) -> bool:
        """Whether a `Host` is an address of this server.

        At all addresses, every number passes: only a name can be made to resolve to another computer.
        """
        found = _HOST.fullmatch(host)
        if found is None or int(found[2] or _HTTP_PORT) != port:
            return False
        name = found[1].strip("[]")
        if name in (*_LOOPBACK_NAMES, self.host.lower(), address):
            return True
        own = socket.gethostname().lower()
        return not self.is_local and (_is_number(name) or name in (own, f"{own}.local"))


def _is_number(host: str) -> bool:
    """Whether a host is an IP address, and no name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
