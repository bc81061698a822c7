"""Packets that a live session sends to its receivers; docs/live.md describes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.exporters.pose_lines import pose
from kinefit.frame.results import FrameResult


@dataclass(frozen=True, eq=False)
class PosePacket:
    """The pose of one step, for receivers.

    Parameters
    ----------
    number : int, of the processed step, from 0
    body : Body
    result : FrameResult; None while the person is not found
    Ts_world_segment : (S, 4, 4) [m]; empty without a result
    time : float [s] of the step
    latency : float [s] from the arrival of the newest frame in the step to this packet
    dropped : {sensor: int} frames dropped so far
    silent : sensors without new frames
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
        """The packet as JSON."""
        r = self.result
        out: dict[str, Any] = {
            "type": "pose" if r is not None else "waiting", "number": self.number, "time": round(self.time, 6),
            "latency": round(self.latency, 6), "dropped": dict(self.dropped), "silent": list(self.silent),
        }  # fmt: skip
        if r is not None:
            out |= pose(
                self.Ts_world_segment, r.state.angles, r.dof_std, r.joint_std, r.segment_quality, quality=r.support,
                lost=r.lost,
            )  # fmt: skip
            out["hidden"] = np.flatnonzero(r.hidden).tolist()
        return msgspec.json.encode(out)
