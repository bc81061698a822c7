"""What a live session tells its receivers: JSON, one object a packet. docs/live.md describes the protocol.

Lengths are metres, angles radians, times seconds; rotations are unit quaternions (w, x, y, z); what nothing observes
has the standard deviation null.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.frame.results import FrameResult
from kinefit.geometry import se3

FORMAT, VERSION = "kinefit live", 1
_DIGITS = 5  # decimals of lengths and angles: a hundredth of a millimetre


@dataclass(frozen=True, eq=False)
class Posed:
    """A pose as receivers get it.

    Parameters
    ----------
    number : int, of the processed frame, from 0
    body : Body
    result : FrameResult, None while the person is not found
    Ts_world_segment : (S, 4, 4) [m]; of no result empty
    time : float [s] of the frame
    latency : float [s] from the arrival of the newest frame that took part to this packet
    dropped : {sensor: int} frames that were dropped so far
    silent : sensors that bring nothing
    """

    number: int
    body: Body
    result: FrameResult | None
    Ts_world_segment: NDArray
    time: float
    latency: float
    dropped: Mapping[str, int] = field(default_factory=dict)
    silent: Sequence[str] = ()

    def to_json(self) -> bytes:
        """The packet."""
        out: dict[str, Any] = {
            "type": "pose" if self.result is not None else "waiting", "number": self.number,
            "time": round(self.time, 6), "latency": round(self.latency, 6), "dropped": dict(self.dropped),
            "silent": list(self.silent),
        }  # fmt: skip
        r = self.result
        if r is not None:
            T = self.Ts_world_segment
            places = np.concatenate([T[:, :3, 3], se3.quaternion(T[:, :3, :3])], axis=1)
            out |= {
                "segments": _rounded(places), "joint_std": _told(r.joint_std), "angles": _rounded(r.state.angles),
                "root_std": _told(r.dof_std[:6]), "angle_std": _told(r.dof_std[6:]), "quality": round(r.support, 3),
                "segment_quality": np.round(r.segment_quality, 3).tolist(), "lost": np.flatnonzero(r.lost).tolist(),
                "hidden": np.flatnonzero(r.hidden).tolist(),
            }  # fmt: skip
        return msgspec.json.encode(out)


def hello(body: Body, *, name: str, rate: float, up: str, sensors: Sequence[str]) -> bytes:
    """What a receiver must know before the first pose, and again where the body changes."""
    tree = body.tree
    return msgspec.json.encode({
        "type": "hello", "format": FORMAT, "version": VERSION, "name": name, "rate": rate, "up": up,
        "body": body.name, "segments": list(tree.segments), "parents": tree.parents.tolist(),
        "offsets": _rounded(tree.offsets), "coordinates": list(tree.coordinates),
        "units": ["m" if slides else "rad" for slides in tree.prismatic], "sensors": list(sensors),
    })  # fmt: skip


def _rounded(values: NDArray) -> Any:
    return np.round(values, _DIGITS).tolist()


def _told(std: NDArray) -> Any:
    """Standard deviations as JSON has them."""
    if np.isfinite(std).all():
        return _rounded(std)
    return [_told(one) if np.ndim(one) else (round(float(one), _DIGITS) if np.isfinite(one) else None) for one in std]
