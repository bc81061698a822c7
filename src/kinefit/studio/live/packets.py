"""Packets that a live session sends to its receivers, and requests that it gets; docs/live.md describes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.rendering.looks import uncertain_segments
from kinefit.errors import ObservationError
from kinefit.exporters.motion_file import pose
from kinefit.fitting.frame.results import FrameResult


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


Answer = Callable[[Mapping[str, Any]], None]
"""Callback for the answer to a request, called from any thread."""

MAX_REQUEST_BYTES = 4096
"""Largest size of a request as JSON; valid ones have less than 300 bytes."""

_Name = Annotated[str, msgspec.Meta(max_length=200)]
_FORM = (
    'Send {"sensor": ..., "use": true or false}, {"sensor": ..., "sigma": ...}, {"body": ...}, {"person": ...}, '
    '{"pause": true or false} or {"stop": true}.'
)
_SINGLE_FIELDS = "body", "person", "pause", "stop"


class ClientRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """One request; the fields of other requests are None.

    Parameters
    ----------
    sensor : name of the sensor of `use` or `sigma`
    use : whether the session uses the sensor
    sigma : standard deviation of the sensor, [px] or [m]
    body : name of a body in the catalogue
    person : number of the person to track from now on, counted as in `LivePerson.people`, from 1
    pause : whether the session ignores what its sensors see
    stop : True to end the session
    """

    sensor: _Name | None = None
    use: bool | None = None
    sigma: float | None = None
    body: _Name | None = None
    person: int | None = None
    pause: bool | None = None
    stop: bool | None = None


def read_request(given: bytes | Mapping[str, Any]) -> ClientRequest:
    """Parse a request from a JSON text or a mapping.

    The record has no nested fields, so deep nesting in the input has no effect.

    Raises
    ------
    ObservationError
        Too long, no JSON, no valid request, or two requests at once.
    """
    try:
        if isinstance(given, Mapping):
            request = msgspec.convert(dict(given), ClientRequest)
        elif len(given) > MAX_REQUEST_BYTES:
            raise ObservationError(f"the request has {len(given)} bytes, more than {MAX_REQUEST_BYTES}", remedy=_FORM)
        else:
            request = msgspec.json.decode(given, type=ClientRequest)
    except msgspec.DecodeError as error:
        raise ObservationError(f"not a request: {error}", remedy=_FORM) from error
    asked = {name for name in request.__struct_fields__ if getattr(request, name) is not None}
    if asked not in ({"sensor", "use"}, {"sensor", "sigma"}, *({f} for f in _SINGLE_FIELDS)) or request.stop is False:
        raise ObservationError(f"a message with {', '.join(sorted(asked)) or 'nothing'} is not a request", remedy=_FORM)
    return request
