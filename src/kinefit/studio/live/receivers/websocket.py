"""Receivers of poses: pages and programs by WebSocket, avatars (VMC), laboratories (LSL), JSON lines.

Each receiver has one slot: a slow one gets the newest pose and skips those between, as their numbers show.
"""

from __future__ import annotations

import asyncio
import socket
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed

from kinefit.bodies import Body
from kinefit.bodies.motion import rotation_between_up
from kinefit.bodies.toml.joint_names import CHARACTER_BONES
from kinefit.errors import BodyError, ExportError
from kinefit.exporters.report.figure import live_figure
from kinefit.exporters.report.page import inline_policy
from kinefit.exporters.skeletons.common import Rest, rest_pose
from kinefit.geometry import se3
from kinefit.studio.live.packets import Answer, PosePacket
from kinefit.studio.live.record import written
from kinefit.studio.serving.access import APP_PAGES, Access
from kinefit.studio.serving.server import Connection, Page, PageServer

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
    ask : callback for a client's request (JSON) and its answer; None rejects all requests

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
        """Send packets and receive requests until the client disconnects."""
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
        """Pass a client's requests on; reject those that are not allowed."""

        def answer(content: Mapping[str, Any]) -> None:  # from any thread
            self.call(back, msgspec.json.encode(content))

        def back(packet: bytes) -> None:
            if len(client.answers) >= _MAX_WAITING_ANSWERS:
                connection.drop("answers are not read")
            else:
                client.answers.append(packet)
                client.news.set()

        while True:
            request = await connection.recv(decode=False)
            if not connection.has_token:
                why = "Requests need the token: connect to the address that kinefit printed, with ws instead of http."
                answer({"type": "refused", "why": why})
            elif self._ask is None:
                answer({"type": "refused", "why": "This session accepts no requests."})
            else:
                self._ask(request, answer)


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
    own = resources.files("kinefit.studio.live.receivers")
    style = (report / "page.css").read_text("utf-8") + (own / "page.css").read_text("utf-8")
    scripts = [(room / name).read_text("utf-8") for room, name in ((report, "player.js"), (own, "page.js"))]
    html = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{style}</style></head><body><main>'
        f'<h1>{escape(title)}</h1><p id="status">waiting</p>{live_figure(body, up)}<aside id="panel"></aside></main>'
        f"{''.join(f'<script>{script}</script>' for script in scripts)}</body></html>"
    )
    return Page(html.encode(), policy=inline_policy(scripts, [style], "connect-src 'self'"), framed_by=APP_PAGES)


BONES = CHARACTER_BONES["unity"]
"""{segment: bone of Unity's humanoid}."""


_TIME_TAG_NOW = struct.pack(">Q", 1)


def osc_message(address: str, *values: str | int | float) -> bytes:
    """One message with its arguments."""
    kinds = "".join("s" if isinstance(v, str) else "i" if isinstance(v, int) else "f" for v in values)
    data = b"".join([
        _text(v) if kind == "s" else struct.pack(">" + kind, v) for kind, v in zip(kinds, values)
    ])  # fmt: skip
    return _text(address) + _text("," + kinds) + data


def osc_bundle(messages: Sequence[bytes]) -> bytes:
    """A bundle of messages."""
    return b"".join([b"#bundle\0", _TIME_TAG_NOW, *(struct.pack(">i", len(m)) + m for m in messages)])


@lru_cache(maxsize=1000)  # the same addresses and bones in every pose
def _text(value: str) -> bytes:
    """A string, zero-terminated and padded to a multiple of four bytes."""
    data = value.encode() + b"\0"
    return data + b"\0" * (-len(data) % 4)


_MAX_PACKET_BYTES = 1400  # on most networks
_ZERO_POSE = (0.0,) * 7  # position and quaternion; messages are made with it once, and its numbers replaced
_ROOT = osc_message("/VMC/Ext/Root/Pos", "root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Vmc:
    """Sender of poses to a host and port.

    Parameters
    ----------
    host, port : of the avatar's program; most listen at 39539
    up : vertical axis of the session's world

    Raises
    ------
    ExportError
        An unknown host.
    BodyError
        From `hello`: a body without pelvis.
    """

    def __init__(self, host: str, port: int, *, up: str) -> None:
        self._to: Any
        try:
            family, _, _, _, self._to = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            remedy = "Give it as 192.168.1.5:39539."
            raise ExportError(f"the host '{host}:{port}' cannot be found", place="VMC", remedy=remedy) from error
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._turn = se3.transform(rotation_between_up(up, "y"), np.zeros(3))
        self._rest: Rest | None = None
        self._heads: list[bytes] = []
        self._segments = self._above = np.zeros(0, int)
        self.unsent = 0

    def hello(self, body: Body, packet: bytes) -> None:
        """Prepare the bones of a new body, each with its nearest ancestor bone; raises BodyError without a pelvis."""
        self._rest = rest_pose(body, "t", "kinefit", "VMC")
        segments, parents = body.tree.segments, body.tree.parents
        if "pelvis" not in segments:
            raise BodyError(f"body '{body.name}' has no pelvis", place="VMC", remedy="Use a humanoid body.")
        bones, ancestors = [s for s, name in enumerate(segments) if name in BONES], []
        for s in bones:
            above = int(parents[s])
            while above >= 0 and segments[above] not in BONES:
                above = int(parents[above])
            ancestors.append(above)
        self._heads = [
            osc_message("/VMC/Ext/Bone/Pos", BONES[segments[s]], *_ZERO_POSE)[: -4 * len(_ZERO_POSE)] for s in bones
        ]
        self._segments, self._above = np.array(bones), np.array(ancestors)

    def pose(self, posed: PosePacket, packet: bytes) -> None:
        """Send a pose; if the network is busy, skip it and count it in `unsent`."""
        if posed.result is None or self._rest is None:
            self._send(osc_bundle([osc_message("/VMC/Ext/OK", 0)]))
            return
        for data in self.packets(posed.Ts_world_segment, posed.time):
            self._send(data)

    def packets(self, Ts_world_segment: NDArray, time: float) -> list[bytes]:
        """OSC bundles of one pose (S, 4, 4) [m] at a time [s], none larger than a network's packet."""
        assert self._rest is not None
        segments, above = self._segments, self._above
        T = self._turn @ Ts_world_segment
        T[:, :3, :3] = T[:, :3, :3] @ self._rest.turns.swapaxes(-1, -2)
        parents = np.where((above >= 0)[:, None, None], T[np.maximum(above, 0)], np.eye(4))
        local = se3.inverse(parents) @ T[segments]
        q = se3.quaternion(local[:, :3, :3])
        numbers = np.concatenate([local[:, :3, 3] * (-1, 1, 1), q[:, 1:] * (1, -1, -1), q[:, :1]], axis=1)
        size = 4 * numbers.shape[1]
        data = numbers.astype(">f4").tobytes()
        bones = [head + data[k * size : (k + 1) * size] for k, head in enumerate(self._heads)]
        ok, now = osc_message("/VMC/Ext/OK", 1), osc_message("/VMC/Ext/T", float(time))
        return _parts([ok, now, _ROOT, *bones])

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _send(self, data: bytes) -> None:
        try:
            self._socket.sendto(data, self._to)
        except OSError:
            self.unsent += 1


def _parts(messages: list[bytes]) -> list[bytes]:
    out, part, size = [], list[bytes](), 0
    for message in messages:
        if part and size + len(message) + 4 > _MAX_PACKET_BYTES:
            out.append(osc_bundle(part))
            part, size = [], 0
        part.append(message)
        size += len(message) + 4
    return [*out, osc_bundle(part)]


class JsonLines:
    """Writes every packet as one line; "-" is the standard output.

    Raises
    ------
    ExportError
        The file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with written(self.path, "Give another file with --json."):
            self._file: BinaryIO = sys.stdout.buffer if str(path) == "-" else open(self.path, "wb")

    def hello(self, body: Body, packet: bytes) -> None:
        """Write the packet of a new body as one line."""
        self._write(packet)

    def pose(self, posed: PosePacket, packet: bytes) -> None:
        """Write the packet of a pose as one line."""
        self._write(packet)

    def close(self) -> None:
        """Close the file."""
        if self._file is not sys.stdout.buffer:
            self._file.close()

    def _write(self, packet: bytes) -> None:
        with written(self.path, "Free some space, or give another --json."):
            self._file.write(packet + b"\n")
            self._file.flush()


class Lsl:
    """Two outlets: NAME-angles [deg, of sliding coordinates m] and NAME-joints [m], each with standard deviations.

    Unobserved coordinates have the standard deviation inf. While the person is not found, and for steps that the
    session drops, nothing is sent: the streams have no nominal rate, so that readers take the samples' own time stamps.
    These are the times at which the newest frame of the step arrived, on LSL's clock. The streams' description states
    the rate of the steps (`sampling/step_rate`).

    Raises
    ------
    ExportError
        The package `pylsl`, or its library, is missing.
    """

    def __init__(self, name: str, *, rate: float) -> None:
        try:
            import pylsl
        except (ImportError, RuntimeError) as error:
            remedy = "Install it: pip install 'kinefit[lsl]'."
            raise ExportError(f"LSL needs the package pylsl ({error})", place="--lsl", remedy=remedy) from error
        self._lsl, self.name, self.rate = pylsl, name, rate
        self._outlets: list[Any] = []
        self._factor = np.ones(0)

    def hello(self, body: Body, packet: bytes) -> None:
        """Open streams for a new body; those of the previous one end."""
        tree = body.tree
        self._factor = np.where(tree.prismatic, 1.0, np.degrees(1.0))
        angles = [(name, "m" if slides else "deg") for name, slides in zip(tree.coordinates, tree.prismatic)]
        angles += [(f"{name} std", unit) for name, unit in angles]
        joints = [(f"{name} {axis}", "m") for name in tree.segments for axis in "xyz"]
        joints += [(f"{name} std", unit) for name, unit in joints]
        self._outlets = [self._outlet(kind, columns) for kind, columns in (("angles", angles), ("joints", joints))]

    def pose(self, posed: PosePacket, packet: bytes) -> None:
        """Send one sample of each stream."""
        r = posed.result
        if r is None:
            return
        f = self._factor
        angles = np.concatenate([f * r.state.angles, f * r.dof_std[6:]])
        joints = np.concatenate([posed.Ts_world_segment[:, :3, 3].ravel(), r.joint_std.ravel()])
        measured = self._lsl.local_clock() - getattr(posed, "latency", 0.0)  # [s]; 0 for poses of other programs
        for outlet, sample in zip(self._outlets, (angles, joints)):
            outlet.push_sample(sample.tolist(), measured)

    def close(self) -> None:
        """End the streams."""
        self._outlets = []

    def _outlet(self, kind: str, columns: list[tuple[str, str]]) -> Any:
        name = f"{self.name}-{kind}"
        irregular = self._lsl.IRREGULAR_RATE  # a stated rate would have readers space the samples evenly
        info = self._lsl.StreamInfo(name, "MoCap", len(columns), irregular, "double64", f"kinefit-{name}")
        sampling = info.desc().append_child("sampling")
        sampling.append_child_value("step_rate", f"{self.rate:g}")
        sampling.append_child_value("time_stamps", "arrival of the newest frame of a step")
        sampling.append_child_value("missing_samples", "person not found, or step dropped")
        channels = info.desc().append_child("channels")
        for label, unit in columns:
            channel = channels.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", unit)
        return self._lsl.StreamOutlet(info)
