"""What port scanners, browsers on https and programs that break off send to a server."""

import socket
import struct

_TLS_HELLO = bytes.fromhex("16030100c8010000c40303") + bytes(180)
_BEGUN = b"GET / HTTP/1.1\r\nHost: x\r\n"
PROBES = (
    b"", _TLS_HELLO, bytes(50), b"\xff\xfe\xfd\r\n\r\n", b"SSH-2.0-x\r\n", b"GET / HTTP/1.0\r\n\r\n",
    b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 5\r\n\r\nhello", b"CONNECT x:1 HTTP/1.1\r\n\r\n", _BEGUN,
    _BEGUN + b"\r\n", _BEGUN + b"A: " + b"x" * 20_000, _BEGUN + b"X: y\r\n" * 300, b"GET /%zz HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost:80\r\nUpgrade: websocket\r\n\r\n",
)  # fmt: skip


def break_off(client):
    """Close a socket with a reset."""
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()


def probe(port):
    """Send each probe twice to a port of this computer: once it is closed in order, once it breaks off."""
    for data in PROBES:
        for close in (socket.socket.close, break_off):
            client = socket.create_connection(("127.0.0.1", port), timeout=10)
            client.sendall(data)
            close(client)
