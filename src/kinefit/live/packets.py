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
from kinefit.rendering.looks import uncertain_segments


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
    paused : whether the session ignores what its sensors see
    people : int, in view
    person : int, number of the tracked one as `LivePerson.people` counts them, from 1; None without a tracked person
    camera : in whose image the people are numbered; "" before the first detection
    choice : int, how many times a client has chosen another person
    """

    number: int
    body: Body
    result: FrameResult | None
    Ts_world_segment: NDArray
    time: float
    latency: float
    dropped: Mapping[str, int] = field(default_factory=dict)
    silent: Sequence[str] = ()
    paused: bool = False
    people: int = 0
    person: int | None = None
    camera: str = ""
    choice: int = 0

    def to_json(self) -> bytes:
        """The packet as JSON."""
        r = self.result
        out: dict[str, Any] = {
            "type": "pose" if r is not None else "waiting", "number": self.number, "time": round(self.time, 6),
            "latency": round(self.latency, 6), "dropped": dict(self.dropped), "silent": list(self.silent),
            "paused": self.paused, "people": self.people, "person": self.person, "camera": self.camera,
        }  # fmt: skip
        if r is not None:
            out |= pose(
                self.Ts_world_segment, r.state.angles, r.dof_std, r.joint_std, r.segment_quality, quality=r.support,
                lost=r.lost,
            )  # fmt: skip
            out["hidden"] = np.flatnonzero(r.hidden).tolist()
            out["uncertain"] = np.flatnonzero(uncertain_segments(self.body, r.joint_std)).tolist()
        return msgspec.json.encode(out)
