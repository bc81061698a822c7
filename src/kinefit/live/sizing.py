"""The person's lengths, from the first seconds of a live session: found beside it, in a process of its own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

import numpy as np

from kinefit.bodies import Body
from kinefit.errors import KinefitError
from kinefit.frame.results import FrameResult
from kinefit.geometry.camera import Rig
from kinefit.observations import KEYPOINT_SIGMA, KeypointFrame, Keypoints, LiftedFrame, by_record
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation.warm import warm_keypoints
from kinefit.tracking.recording import Recording, keypoint_records
from kinefit.tracking.sizing import fitted_to_person

_STEPS, _BETWEEN, _SEEN = 40, 0.2, 0.5  # steps that are kept, [s] between them, quality of a frame that counts


class LiveSize:
    """Keeps some steps of the beginning, has the body fitted to them, and gives it when it is there.

    Parameters
    ----------
    body : Body, generic
    rig : Rig
    sigma : {camera: float} [px]
    settings : TrackSettings
    height : float [m] of the person, where it is known
    up : vertical axis

    Attributes
    ----------
    told : what became of it, for the user; "" while it is not over
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
        self._pool: ProcessPoolExecutor | None = None
        self._future: Future[Body] | None = None
        self.told = ""

    def after(self, frames: Sequence[Any], result: FrameResult | None) -> Body | None:
        """After a step: the fitted body, once, when it is there."""
        if self.told:
            return None
        if self._future is not None:
            return self._found() if self._future.done() else None
        kinds = by_record(frames)
        seen = [*kinds[KeypointFrame], *kinds[LiftedFrame]]
        if seen and result is not None and result.support > _SEEN and result.time >= self._next:
            self._steps.append(seen)
            self._next = result.time + _BETWEEN
            if self._pool is None:  # its start takes seconds, and is over when the steps are there
                self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_behind)
                self._pool.submit(warm_keypoints)
        if len(self._steps) == _STEPS:
            assert self._pool is not None
            try:
                self._future = self._pool.submit(fitted_body, self._steps, **self._task)
            except BrokenProcessPool:
                self._give_up()
            self._steps = []
        return None

    def close(self) -> None:
        """Give up what is not there yet."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None

    def _found(self) -> Body | None:
        assert self._future is not None
        try:
            body = self._future.result()
            lengths = body.segment_lengths()
            bones = {"thigh": "thigh_r-shank_r", "shank": "shank_r-foot_r", "forearm": "forearm_r-hand_r"}
            told = ", ".join(f"{what} {100 * lengths[bone]:.1f}" for what, bone in bones.items() if bone in lengths)
            self.told = f"the person's size was found ({told} cm)" if told else "the person's size was found"
            return body
        except KinefitError as error:
            self.told = f"the person's size was not found, it is taken to be as usual ({error.problem})"
        except BrokenProcessPool:
            self._give_up()
        finally:
            self.close()
        return None

    def _give_up(self) -> None:
        """The session goes on without: a process that was ended, by whomever, holds up no pose."""
        self.told = "the person's size was not found, it is taken to be as usual (its process ended)"
        self.close()


def _behind() -> None:
    """Let the session go before this process."""
    if hasattr(os, "nice"):
        os.nice(10)


def fitted_body(
    steps: Sequence[Sequence[Any]], *, body: Body, rig: Rig, sigma: dict[str, float],
    settings: TrackSettings, height: float | None, up: str,
) -> Body:  # fmt: skip
    """The body with the person's lengths, from keypoints of some steps."""
    records = [_with_lifted(k, steps) for k in keypoint_records(steps, 1.0 / _BETWEEN)]
    sigmas = [sigma.get(k.camera, KEYPOINT_SIGMA) for k in records]
    recording = Recording.of_keypoints(rig, records, sigma=sigmas, up=up)
    settings = replace(settings, view_bias=False)  # which the session's own frames do without, too
    return fitted_to_person(recording, body, settings, height=height).subject.body


def _with_lifted(record: Keypoints, steps: Sequence[Sequence[Any]]) -> Keypoints:
    """The same with its points lifted to space, where there are any."""
    lifted = np.full((*record.points.shape[:3], 3), np.nan)
    for i, step in enumerate(steps):
        for f in by_record(step)[LiftedFrame]:
            if (f.sensor, f.keypoint_set, f.names) == (record.camera, record.keypoint_set, record.names):
                lifted[i, 0] = f.x
    return replace(record, lifted=lifted) if np.isfinite(lifted).any() else record
