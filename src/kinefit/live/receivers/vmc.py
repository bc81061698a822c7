"""Virtual Motion Capture protocol: poses over OSC to avatars in Unity, Unreal, Blender and VRM programs.

Bones are those of Unity's humanoid, resting as a T that faces z; the world is Unity's: left-handed, x right, y up, z
forward. From kinefit's right-handed world with y up it comes by x -> -x, hence a quaternion (w, x, y, z) becomes
(w, x, -y, -z). Source: VMC protocol specification 2.7 (addresses /VMC/Ext/OK, /T, /Root/Pos, /Bone/Pos).

Open Sound Control 1.0: messages and bundles as bytes, as much of it as VMC needs (strings, int32, float32).
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.joint_names import SIDES, VRM0_FINGERS
from kinefit.errors import BodyError, ExportError
from kinefit.exporters.skeletons.rest import Rest, rest_pose
from kinefit.geometry import se3
from kinefit.live.packets import PosePacket
from kinefit.motion import rotation_between_up

_TRUNK = {"pelvis": "Hips", "abdomen": "Spine", "thorax": "Chest", "neck": "Neck", "head": "Head", "jaw": "Jaw"}
_SIDES = {
    "clavicle": "Shoulder", "upperarm": "UpperArm", "forearm": "LowerArm", "hand": "Hand", "thigh": "UpperLeg",
    "shank": "LowerLeg", "foot": "Foot", "toes": "Toes", "eye": "Eye",
}  # fmt: skip
BONES = _TRUNK | {f"{k}_{s}": words["Side"] + v for k, v in _SIDES.items() for s, words in SIDES.items()}
BONES |= {segment: name[0].upper() + name[1:] for segment, name in VRM0_FINGERS.items()}
"""Segment -> bone of Unity's humanoid."""


_AT_ONCE = struct.pack(">Q", 1)  # the time tag that says: now


def osc_message(address: str, *values: str | int | float) -> bytes:
    """One message with its arguments."""
    kinds = "".join("s" if isinstance(v, str) else "i" if isinstance(v, int) else "f" for v in values)
    data = b"".join([
        _text(v) if kind == "s" else struct.pack(">" + kind, v) for kind, v in zip(kinds, values)
    ])  # fmt: skip
    return _text(address) + _text("," + kinds) + data


def osc_bundle(messages: Sequence[bytes]) -> bytes:
    """Messages that belong together."""
    return b"".join([b"#bundle\0", _AT_ONCE, *(struct.pack(">i", len(one)) + one for one in messages)])


@lru_cache(maxsize=1000)  # the same addresses and bones in every pose
def _text(value: str) -> bytes:
    """A string, ended by a zero and filled up to a multiple of four bytes."""
    data = value.encode() + b"\0"
    return data + b"\0" * (-len(data) % 4)


_MOST = 1400  # [bytes] of one packet on most networks
_NOTHING = (0.0,) * 7  # place and turn, of which the bones' messages are made once, and the numbers put behind
_ROOT = osc_message("/VMC/Ext/Root/Pos", "root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class Vmc:
    """Sends poses to a host and port.

    Parameters
    ----------
    host, port : where the avatar listens; most programs at 39539
    up : vertical axis of the session's world

    Raises
    ------
    ExportError
        A host that is not known.
    BodyError
        From `hello`: a body without pelvis.
    """

    def __init__(self, host: str, port: int, *, up: str) -> None:
        self._to: Any
        try:
            family, _, _, _, self._to = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            remedy = 'Give it as "192.168.1.5:39539".'
            raise ExportError(f"the host '{host}:{port}' is not known", place="VMC", remedy=remedy) from error
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._turn = se3.transform(rotation_between_up(up, "y"), np.zeros(3))
        self._rest: Rest | None = None
        self._heads: list[bytes] = []
        self._segments = self._above = np.zeros(0, int)
        self.unsent = 0

    def hello(self, body: Body, packet: bytes) -> None:
        """Another body: its bones, each with the next one above that is one."""
        self._rest = rest_pose(body, "t", "kinefit", "VMC")
        segments, parents = body.tree.segments, body.tree.parents
        if "pelvis" not in segments:
            raise BodyError(f"body '{body.name}' has no pelvis", place="VMC", remedy="Follow a person: humanoid.")
        kept, lowest = [s for s, name in enumerate(segments) if name in BONES], []
        for s in kept:
            above = int(parents[s])
            while above >= 0 and segments[above] not in BONES:
                above = int(parents[above])
            lowest.append(above)
        self._heads = [
            osc_message("/VMC/Ext/Bone/Pos", BONES[segments[s]], *_NOTHING)[: -4 * len(_NOTHING)] for s in kept
        ]
        self._segments, self._above = np.array(kept), np.array(lowest)

    def pose(self, posed: PosePacket, packet: bytes) -> None:
        """Send a pose; where the network is busy, it is left out and counted in `unsent`."""
        if posed.result is None or self._rest is None:
            self._send(osc_bundle([osc_message("/VMC/Ext/OK", 0)]))
            return
        for data in self.packets(posed.Ts_world_segment, posed.time):
            self._send(data)

    def packets(self, Ts_world_segment: NDArray, time: float) -> list[bytes]:
        """OSC bundles of one pose, none larger than a network's packet."""
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
        """End it."""
        self._socket.close()

    def _send(self, data: bytes) -> None:
        try:
            self._socket.sendto(data, self._to)
        except OSError:
            self.unsent += 1


def _parts(messages: list[bytes]) -> list[bytes]:
    out, part, size = [], list[bytes](), 0
    for one in messages:
        if part and size + len(one) + 4 > _MOST:
            out.append(osc_bundle(part))
            part, size = [], 0
        part.append(one)
        size += len(one) + 4
    return [*out, osc_bundle(part)]
