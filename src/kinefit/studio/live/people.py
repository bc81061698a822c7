"""Who is tracked live, and how tall: the person chosen, followed through crowds, sized in the first seconds."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._threads import Pool
from kinefit.bodies import Body, BodyState
from kinefit.errors import KinefitError, ObservationError, TakeError, TrackingError
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.multiview.association import choose_people, confidences, meeting_points
from kinefit.fitting.tracking.recording import Recording, keypoint_records
from kinefit.fitting.tracking.sizing import fitted_to_person
from kinefit.geometry.camera import Rig
from kinefit.observations import KEYPOINT_SIGMA, KeypointFrame, Keypoints, LiftedFrame, by_record
from kinefit.observations.recordings import PersonChoice
from kinefit.sensors.channels import known_points
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation.recordings import warm_keypoints

_FITTED_STEPS = 40
_STEP_INTERVAL_S = 0.2
_MIN_SUPPORT = 0.5  # share of agreeing evidence, of a step that counts


class LiveSize:
    """Collects the first steps, starts a fit of the body to them, and returns it when it is done.

    Parameters
    ----------
    body : Body, generic
    rig : Rig
    sigma : {camera: float} [px]
    settings : TrackSettings
    height : float [m] of the person, if known
    up : vertical axis

    Attributes
    ----------
    outcome : text for the user; "" until the fit is over
    """

    def __init__(
        self, body: Body, rig: Rig, *, sigma: dict[str, float], settings: TrackSettings,
        height: float | None = None, up: str = "z",
    ) -> None:  # fmt: skip
        self._task: dict[str, Any] = {
            "body": body, "rig": rig, "sigma": sigma, "settings": settings, "height": height, "up": up,
        }  # fmt: skip
        self._steps: list[list[Any]] = []
        self._next = -float("inf")
        self._pool: Pool | None = None
        self._future: Future[Body] | None = None
        self.outcome = ""

    def after(self, frames: Sequence[Any], result: FrameResult | None) -> Body | None:
        """Handle a step; returns the fitted body once, after the fit is done."""
        if self.outcome:
            return None
        if self._future is not None:
            return self._found() if self._future.done() else None
        kinds = by_record(frames)
        seen = [*kinds[KeypointFrame], *kinds[LiftedFrame]]
        if seen and result is not None and result.support > _MIN_SUPPORT and result.time >= self._next:
            self._steps.append(seen)
            self._next = result.time + _STEP_INTERVAL_S
            if self._pool is None:  # it starts while steps are collected
                self._pool = Pool(1, _lower_priority)
                self._pool.submit(warm_keypoints)
        if len(self._steps) == _FITTED_STEPS:
            assert self._pool is not None
            try:
                self._future = self._pool.submit(fitted_body, self._steps, **self._task)
            except BrokenProcessPool:
                self._give_up()
            self._steps = []
        return None

    def restart(self) -> None:
        """Forget all steps, those of another person."""
        self.close()
        self._steps, self._future, self._next, self.outcome = [], None, -float("inf"), ""

    def close(self) -> None:
        """Cancel an unfinished fit."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None

    def _found(self) -> Body | None:
        assert self._future is not None
        try:
            body = self._future.result()
            lengths = body.segment_lengths()
            bones = {"thigh": "thigh_r-shank_r", "shank": "shank_r-foot_r", "forearm": "forearm_r-hand_r"}
            listed = ", ".join(f"{what} {100 * lengths[bone]:.1f}" for what, bone in bones.items() if bone in lengths)
            self.outcome = f"the person's size is estimated ({listed} cm)" if listed else "the person's size is known"
            return body
        except KinefitError as error:
            self.outcome = f"the person's size is not estimated, the default is used ({error.problem})"
        except BrokenProcessPool:
            self._give_up()
        finally:
            self.close()
        return None

    def _give_up(self) -> None:
        """Go on without a fit after its process has ended."""
        self.outcome = "the person's size is not estimated, the default is used (its process ended)"
        self.close()


def _lower_priority() -> None:
    """Give this process a lower priority than the session."""
    if hasattr(os, "nice"):
        os.nice(10)


def fitted_body(
    steps: Sequence[Sequence[Any]], *, body: Body, rig: Rig, sigma: dict[str, float],
    settings: TrackSettings, height: float | None, up: str,
) -> Body:  # fmt: skip
    """Fit the body's lengths to keypoints of some steps; sigma [px] by camera, height [m]."""
    records = [_with_lifted(k, steps) for k in keypoint_records(steps, 1.0 / _STEP_INTERVAL_S)]
    sigmas = [sigma.get(k.camera, KEYPOINT_SIGMA) for k in records]
    recording = Recording.of_keypoints(rig, records, sigma=sigmas, up=up)
    settings = replace(settings, view_bias=False)  # the session's own frames have none, either
    return fitted_to_person(recording, body, settings, height=height).subject.body


def _with_lifted(record: Keypoints, steps: Sequence[Sequence[Any]]) -> Keypoints:
    """The record with lifted points, if the steps have some."""
    lifted = np.full((*record.points.shape[:3], 3), np.nan)
    for i, step in enumerate(steps):
        for f in by_record(step)[LiftedFrame]:
            if (f.sensor, f.keypoint_set, f.names) == (record.camera, record.keypoint_set, record.names):
                lifted[i, 0] = f.x
    return replace(record, lifted=lifted) if np.isfinite(lifted).any() else record


# Median distance of a person's points from the predicted body, as a share of their height: the largest motion during a
# detection of 0.1 s; two people side by side are half a height apart.
_MAX_DISTANCE = 0.35
_MIN_POINTS = 4
_NEAR_M = 0.5  # of the middles of one person by two pairs of cameras
_MAX_TRIES = 60  # steps in which a chosen person, or the camera of the numbers, is waited for
_LIVE_WAYS = "first", "nearest", "largest"


class LivePerson:
    """Chooses one person's keypoints in every frame.

    The tracked person is the one that fits the body's last pose. At the start, and if no camera shows that person, it
    is the one that the cameras agree on: with most visible points, the largest, or the nearest to a point.

    Parameters
    ----------
    rig : Rig
    person : "first" (the default), "largest" or "nearest X Y Z" [m]

    Attributes
    ----------
    camera : str, the one in whose image people are numbered: it shows most of them; "" before the first detection
    count : int, people in its latest image
    number : int, of the tracked person, from 1 at the left of the image; None while it does not show that person

    Raises
    ------
    TakeError
        A choice that needs a whole recording: "moving", or a number.
    """

    def __init__(self, rig: Rig, person: int | str | None = None) -> None:
        self.rig, self.wanted = rig, PersonChoice.of(person)
        self.camera, self.count = "", 0
        self.number: int | None = None
        self._cameras, self._people = set[str](), list[NDArray]()  # so far; (K, 2) [px] of each person, from the left
        self._chosen: NDArray | None = None  # (K, 2) [px] in `camera`: of a choice, until the tracker has a pose
        self._tries = self._absent = 0  # steps
        if self.wanted.way not in _LIVE_WAYS:
            problem = f'person = "{person}" needs the whole recording'
            raise TakeError(problem, place="person", remedy='For live: "first", "largest" or "nearest X Y Z".')

    def frames(
        self, records: Sequence[Keypoints], body: Body, state: BodyState | None
    ) -> list[KeypointFrame | LiftedFrame]:
        """The tracked person's keypoints of all cameras that show the person, with lifted ones of a single camera.

        Parameters
        ----------
        records : of one frame each, of any number of people
        body : Body
        state : its last pose; None before the start
        """
        seen = [k for k in records if confidences(k, 1).any()]
        chosen = [-1] * len(seen)
        if state is not None:
            self._chosen = None
            sets = {k.keypoint_set: known_points(body, k.keypoint_set) for k in seen}
            places = {name: (points.names, body.positions(state, points)) for name, points in sets.items()}
            chosen = [self._fitting(k, *places[k.keypoint_set]) for k in seen]
        if self._chosen is not None:
            chosen = self._with_chosen(seen, self._chosen)
        elif seen and not any(p >= 0 for p in chosen):
            chosen = self._anew(seen)
        self._number_people(records, dict(zip((k.camera for k in seen), chosen)))
        out: list[KeypointFrame | LiftedFrame] = [_frame(k, p) for k, p in zip(seen, chosen) if p >= 0]
        if len(self.rig) == 1:
            out += [_lifted(k, k.lifted, p) for k, p in zip(seen, chosen) if p >= 0 and k.lifted is not None]
        return out

    def choose(self, number: int) -> None:
        """Track another person from the next frame on; the tracker must start anew.

        Raises
        ------
        ObservationError
            No such number among the people in view.
        """
        if not 0 < number <= self.count:
            problem = f"person {number} of {self.count} in view"
            raise ObservationError(problem, remedy="Choose a number from 1, counted from the left.")
        self._chosen, self._tries = self._people[number - 1], 0

    def _number_people(self, records: Sequence[Keypoints], chosen: Mapping[str, int]) -> None:
        """Number the people in the image with most of them, with the index of the tracked one by camera."""
        self._cameras.update(k.camera for k in records)
        there = [(len(found := np.flatnonzero(confidences(k, 1)[0])), k.camera == self.camera, found) for k in records]
        most = max(range(len(records)), key=lambda i: there[i][:2], default=None)
        self._absent = 0 if any(same for _, same, _ in there) else self._absent + 1
        if most is None or (0 < self._absent < _MAX_TRIES and there[most][0] <= self.count):
            return  # the camera of the numbers has no image in this step
        k, found = records[most], there[most][2]
        uv = [np.where(k.confidence[0, p, :, None] > 0.1, k.points[0, p], np.nan) for p in found]
        order = sorted(range(len(uv)), key=lambda p: float(np.nanmedian(uv[p][:, 0])))
        self._people, self.camera, self.count, self._absent = [uv[p] for p in order], k.camera, len(uv), 0
        self.number = next((n for n, p in enumerate(order, 1) if found[p] == chosen.get(k.camera)), None)

    def _with_chosen(self, seen: Sequence[Keypoints], expected: NDArray) -> list[int]:
        """The chosen person, last at (K, 2) [px] in `camera`: an index for each record, -1 for none."""
        out = [-1] * len(seen)
        self._tries += 1
        for i, k in enumerate(seen):
            if k.camera == self.camera and k.points.shape[2] == len(expected):
                cost = [_apart(uv, confidence, expected) for uv, confidence in zip(k.points[0], k.confidence[0])]
                if min(cost) < _MAX_DISTANCE:
                    out[i] = int(np.argmin(cost))
                    self._chosen = k.points[0, out[i]]
                    pairs = meeting_points(self.rig, seen, [confidences(s, 1) for s in seen], 1).items()
                    places = [x[0] for _, x in pairs if np.isfinite(x[0, 0])]
                    own = [x[0] for pair, x in pairs if (i, out[i]) in pair and np.isfinite(x[0, 0])]
                    if own:  # where most pairs of images agree: two people may be in line with a camera
                        near = np.linalg.norm(np.subtract(np.array(own)[:, None], places), axis=2) < _NEAR_M
                        out = self._nearest(seen, own[int(near.sum(axis=1).argmax())])
        if self._tries == _MAX_TRIES:
            self._chosen = None
        enough = sum(p >= 0 for p in out) >= min(len(self._cameras), 2)
        return out if enough else [-1] * len(seen)

    def _fitting(self, record: Keypoints, names: tuple[str, ...], places: NDArray) -> int:
        """Index of the person at the body's last pose, with points by name and position (K, 3) [m]; -1 for none."""
        own, of_body = _columns(tuple(record.names), names)
        if len(own) < _MIN_POINTS:
            return 0 if record.points.shape[1] == 1 else -1
        expected = self.rig[record.camera].project(places[of_body])
        cost = [
            _apart(uv[own], confidence[own], expected) for uv, confidence in zip(record.points[0], record.confidence[0])
        ]
        best = int(np.argmin(cost)) if cost else -1
        return best if best >= 0 and cost[best] < _MAX_DISTANCE else -1

    def _anew(self, records: Sequence[Keypoints]) -> list[int]:
        """Choose the person that the cameras agree on: an index for each record, -1 for none."""
        several = any(k.points.shape[1] > 1 for k in records)
        if several and self.wanted.way == "largest":
            return [int(np.argmax([_height(uv) for uv in k.points[0]])) for k in records]
        if several and self.wanted.place is not None:
            return self._nearest(records, self.wanted.place)
        try:
            return [int(own[0]) for own in choose_people(self.rig, records)]
        except TrackingError:
            return [-1] * len(records)

    def _nearest(self, records: Sequence[Keypoints], place: NDArray) -> list[int]:
        """Choose the person nearest to a point (3,) [m] by pairs of cameras: an index for each record, -1 for none."""
        meetings = meeting_points(self.rig, records, [confidences(k, 1) for k in records], 1)
        apart = {pair: float(np.linalg.norm(x[0] - place)) for pair, x in meetings.items() if np.isfinite(x[0, 0])}
        out = [-1] * len(records)
        for pair in sorted(apart, key=lambda pair: apart[pair]):
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
    """(K,), (K,) indices of the common names in two lists."""
    at = {name: k for k, name in enumerate(has)}
    both = [(at[n], k) for k, n in enumerate(names) if n in at]
    first, second = np.array(both, np.int64).reshape(-1, 2).T
    return first, second


def _apart(uv: NDArray, confidence: NDArray, expected: NDArray) -> float:
    """Median distance of points (K, 2), as a share of their height; inf if too few are detected."""
    gap = uv - expected
    far = np.sqrt(gap[:, 0] ** 2 + gap[:, 1] ** 2)
    seen = np.isfinite(far) & (confidence > 0.1)
    far = far[seen]
    if len(far) < _MIN_POINTS:
        return np.inf
    visible = expected[seen]
    height = float((visible.max(axis=0) - visible.min(axis=0)).max())
    far.sort()  # ten times as fast as np.median
    return 0.5 * float(far[(len(far) - 1) // 2] + far[len(far) // 2]) / max(height, 1.0)


def _height(uv: NDArray) -> float:
    """Height [px] of one person's points (K, 2); 0 without a person."""
    seen = np.isfinite(uv).all(axis=1)
    return float(np.ptp(uv[seen, 1])) if seen.sum() >= _MIN_POINTS else 0.0
