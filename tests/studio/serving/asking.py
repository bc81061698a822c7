"""Ask a server of this computer for a page or a WebSocket, as a browser asks for a page of its own or a foreign one."""

import socket
import urllib.request

import viser
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

GONE = OSError, EOFError, WebSocketException
"""What a client gets that is not let in, or is sent away."""


def ws(url):
    """Address of the WebSocket of a page, as pages make it."""
    return url.replace("http", "ws", 1).rstrip("/")


def port_of(url):
    return int(url.split(":")[2].split("/")[0])


def is_let_in(url, *, host="localhost", **headers):
    """Whether a page or a WebSocket is given to who asks with these headers; never sent to the host that is named."""
    if url.startswith("http"):
        request = urllib.request.Request(url, headers={"Host": f"{host}:{port_of(url)}", **headers})
        ask = lambda: urllib.request.urlopen(request, timeout=5.0)
    else:
        there = socket.create_connection(("127.0.0.1", port_of(url)), timeout=5.0)
        options = {"sock": there, "origin": headers.get("Origin"), "subprotocols": [f"viser-v{viser.__version__}"]}
        ask = lambda: connect(url.replace("localhost", host, 1), **options)
    try:
        with ask():
            return True
    except GONE:
        return False
