"""Fit the person's lengths to the first seconds of a live session, in a separate process."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from typing import Any

import numpy as np

from kinefit._threads import Pool
from kinefit.bodies import Body
from kinefit.errors import KinefitError
from kinefit.frame.results import FrameResult
from kinefit.geometry.camera import Rig
from kinefit.observations import KEYPOINT_SIGMA, KeypointFrame, Keypoints, LiftedFrame, by_record
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation.warm import warm_keypoints
from kinefit.tracking.recording import Recording, keypoint_records
from kinefit.tracking.sizing import fitted_to_person

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
