"""Who of all that detectors see now is the person who is followed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import TakeError, TrackingError
from kinefit.geometry.camera import Rig
from kinefit.multiview.association import choose_people, confidences, meeting_points
from kinefit.observations import KeypointFrame, Keypoints, LiftedFrame
from kinefit.observations.person import PersonChoice
from kinefit.sensors.channels import known_points

_NEAR = 0.35  # median distance of a person's points from where the body is expected, as a share of their height: in a
# tenth of a second of detector's time nobody goes farther, and two who stand side by side are half a height apart
_FEW = 4  # points that tell
_WAYS = "first", "nearest", "largest"


class LivePerson:
    """Chooses, frame by frame, one person's keypoints among those of everybody.

    Who is followed is whoever fits the body's last pose; where no camera shows that person, and to begin with, whoever
    the cameras agree on: of whom most is seen, who is largest, or nearest to a place.

    Parameters
    ----------
    rig : Rig
    person : "first" (the default), "largest" or "nearest X Y Z" [m]: what needs the whole take is refused

    Raises
    ------
    TakeError
        A person who is told apart only by a whole recording: "moving", or a number.
    """

    def __init__(self, rig: Rig, person: int | str | None = None) -> None:
        self.rig, self.wanted = rig, PersonChoice.of(person)
        if self.wanted.way not in _WAYS:
            problem = f'person = "{person}" is known only when all is over'
            raise TakeError(problem, place="person", remedy='Live: "first", "largest" or "nearest X Y Z".')

    def frames(
        self, records: Sequence[Keypoints], body: Body, state: BodyState | None
    ) -> list[KeypointFrame | LiftedFrame]:
        """That person's keypoints; nothing of cameras that do not show the person. A camera alone is lifted to space.

        Parameters
        ----------
        records : of one frame each, of any number of people
        body : Body
        state : its last pose, None before a start
        """
        seen = [k for k in records if confidences(k, 1).any()]
        chosen = [-1] * len(seen)
        if state is not None:
            sets = {k.keypoint_set: known_points(body, k.keypoint_set) for k in seen}
            places = {name: (points.names, body.positions(state, points)) for name, points in sets.items()}
            chosen = [self._fitting(k, *places[k.keypoint_set]) for k in seen]
        if seen and not any(p >= 0 for p in chosen):
            chosen = self._anew(seen)
        out: list[KeypointFrame | LiftedFrame] = [_frame(k, p) for k, p in zip(seen, chosen) if p >= 0]
        if len(self.rig) == 1:
            out += [_lifted(k, k.lifted, p) for k, p in zip(seen, chosen) if p >= 0 and k.lifted is not None]
        return out

    def _fitting(self, record: Keypoints, names: tuple[str, ...], places: NDArray) -> int:
        """Who of a record is where the body was last, its points by name and place (K, 3) [m]; -1 for none."""
        own, mine = _columns(tuple(record.names), names)
        if len(own) < _FEW:
            return 0 if record.points.shape[1] == 1 else -1
        expected = self.rig[record.camera].project(places[mine])
        cost = [
            _apart(uv[own], confidence[own], expected) for uv, confidence in zip(record.points[0], record.confidence[0])
        ]
        best = int(np.argmin(cost)) if cost else -1
        return best if best >= 0 and cost[best] < _NEAR else -1

    def _anew(self, records: Sequence[Keypoints]) -> list[int]:
        """Whoever the cameras agree on."""
        several = any(k.points.shape[1] > 1 for k in records)
        if several and self.wanted.way == "largest":
            return [int(np.argmax([_height(one) for one in k.points[0]])) for k in records]
        if several and self.wanted.place is not None:
            return self._nearest(records, self.wanted.place)
        try:
            return [int(own[0]) for own in choose_people(self.rig, records)]
        except TrackingError:
            return [-1] * len(records)

    def _nearest(self, records: Sequence[Keypoints], place: NDArray) -> list[int]:
        """Of each record the one who is in the group of two whose middle is nearest to a place."""
        meetings = meeting_points(self.rig, records, [confidences(k, 1) for k in records], 1)
        apart = {pair: float(np.linalg.norm(x[0] - place)) for pair, x in meetings.items() if np.isfinite(x[0, 0])}
        out = [-1] * len(records)
        for pair in sorted(apart, key=lambda one: apart[one]):
            first = out if all(p < 0 for p in out) else None
            if first is not None or any(out[q] == p for q, p in pair):
                for q, p in pair:
                    out[q] = p if out[q] < 0 else out[q]
        return out


def _frame(record: Keypoints, person: int) -> KeypointFrame:
    return KeypointFrame(
        record.camera, float(record.times[0]), record.names, record.points[0, person], record.confidence[0, person],
        record.keypoint_set,
    )  # fmt: skip


def _lifted(record: Keypoints, lifted: NDArray, person: int) -> LiftedFrame:
    x, uv = lifted[0, person], record.points[0, person]
    return LiftedFrame(record.camera, float(record.times[0]), record.names, x, uv, record.keypoint_set)


@lru_cache(maxsize=64)
def _columns(has: tuple[str, ...], names: tuple[str, ...]) -> tuple[NDArray, NDArray]:
    """(K,), (K,) places of the same names in two lists."""
    at = {name: k for k, name in enumerate(has)}
    both = [(at[n], k) for k, n in enumerate(names) if n in at]
    own, mine = np.array(both, np.int64).reshape(-1, 2).T
    return own, mine


def _apart(uv: NDArray, confidence: NDArray, expected: NDArray) -> float:
    """Median distance of points (K, 2), as a share of their height; inf where too few are seen."""
    gap = uv - expected
    far = np.sqrt(gap[:, 0] ** 2 + gap[:, 1] ** 2)
    seen = np.isfinite(far) & (confidence > 0.1)
    far = far[seen]
    if len(far) < _FEW:
        return np.inf
    there = expected[seen]
    height = float((there.max(axis=0) - there.min(axis=0)).max())
    far.sort()  # in place of np.median: a tenth of its time
    return 0.5 * float(far[(len(far) - 1) // 2] + far[len(far) // 2]) / max(height, 1.0)


def _height(uv: NDArray) -> float:
    """[px] of one person's points (K, 2); 0 for nobody."""
    seen = np.isfinite(uv).all(axis=1)
    return float(np.ptp(uv[seen, 1])) if seen.sum() >= _FEW else 0.0
