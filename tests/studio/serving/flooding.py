"""A client that sends as fast as it goes, on this computer.

`python -m tests.studio.serving.flooding PORT TOKEN KIND SECONDS`.

It knows nothing of manners: whole bundles of frames go out at once, and where the server hangs up, it comes again.
"""

import contextlib
import socket
import sys
import time

from websockets.frames import Frame, Opcode

_HANDSHAKE = (
    "GET /{token}/ HTTP/1.1\r\nHost: localhost:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


def _frames(count, data, opcode=Opcode.TEXT, fin=True):
    return Frame(opcode, data, fin).serialize(mask=True, extensions=[]) * count


FLOODS = {
    "requests": _frames(500, b'{"sensor": "cam01", "sigma": 12}'),
    "nonsense": _frames(500, b"[" * 3000),
    "empty messages": _frames(5000, b""),
    "pings": _frames(5000, b"", Opcode.PING),
    "long messages": _frames(5, b"x" * 200_000),
    "fragments": _frames(1, b"{", fin=False) + _frames(5000, b"{", Opcode.CONT, fin=False),
    "handshakes": b"",
}


def flood(port, token, kind, seconds):
    """Send until so many seconds are over; at most 1,000,000 bundles and connections."""
    until, bundle, has_begun = time.monotonic() + seconds, FLOODS[kind], False
    for _ in range(1_000_000):
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0) as client:
            client.sendall(_HANDSHAKE.format(token=token, port=port).encode())
            client.recv(100)
            if not has_begun:
                print("connected", flush=True)
                has_begun = True
            while bundle and time.monotonic() < until:
                client.sendall(bundle)
        if time.monotonic() > until:
            return


if __name__ == "__main__":
    flood(int(sys.argv[1]), sys.argv[2], sys.argv[3], float(sys.argv[4]))
