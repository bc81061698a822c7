"""What a live session tells its receivers of each step; docs/live.md describes the packets."""

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
    """A pose as receivers get it.

    Parameters
    ----------
    number : int, of the processed step, from 0
    body : Body
    result : FrameResult, None while the person is not found
    Ts_world_segment : (S, 4, 4) [m]; of no result empty
    time : float [s] of the step
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
