"""The person's lengths, from the first seconds of a live session: found beside it, in a process of its own."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import Any

from kinefit.bodies import Body
from kinefit.errors import KinefitError
from kinefit.frame.results import FrameResult
from kinefit.geometry.camera import Rig
from kinefit.observations import KeypointFrame, LiftedFrame
from kinefit.sensors.settings import TrackSettings
from kinefit.tracking.recording import Recording
from kinefit.tracking.sizing import channels_of, fitted_to_person

_STEPS, _BETWEEN, _SEEN = 40, 0.2, 0.5  # steps that are kept, [s] between them, quality of a frame that counts


class LiveSize:
    """Keeps some steps of the beginning, has the body fitted to them, and gives it when it is there.

    Parameters
    ----------
    body : Body, generic
    rig : Rig
    rate : float [Hz]
    sigma : {camera: float} [px]
    settings : TrackSettings
    height : float [m] of the person, where it is known
    up : vertical axis

    Attributes
    ----------
    told : what became of it, for the user; "" while it is not over
    """

    def __init__(
        self, body: Body, rig: Rig, *, rate: float, sigma: dict[str, float], settings: TrackSettings,
        height: float | None = None, up: str = "z",
    ) -> None:  # fmt: skip
        self._task: dict[str, Any] = {
            "body": body, "rig": rig, "rate": rate, "sigma": sigma, "settings": settings, "height": height, "up": up,
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
        seen = [f for f in frames if isinstance(f, KeypointFrame | LiftedFrame)]
        if seen and result is not None and result.support > _SEEN and result.time >= self._next:
            self._steps.append(seen)
            self._next = result.time + _BETWEEN
        if len(self._steps) == _STEPS:
            self._pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
            self._future = self._pool.submit(fitted_body, self._steps, **self._task)
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
            bones = ", ".join(f"{name} {lengths[name]:.3f}" for name in ("thigh_r", "shank_r") if name in lengths)
            self.told = f"the person's size was found: {bones} m" if bones else "the person's size was found"
            return body
        except KinefitError as error:
            self.told = f"the person's size was not found, it is taken to be as usual ({error.problem})"
        except BrokenProcessPool:
            self.told = "the person's size was not found, it is taken to be as usual (its process ended)"
        finally:
            self.close()
        return None


def fitted_body(
    steps: Sequence[Sequence[Any]], *, body: Body, rig: Rig, rate: float, sigma: dict[str, float],
    settings: TrackSettings, height: float | None, up: str,
) -> Body:  # fmt: skip
    """The body with the person's lengths, from keypoints of some steps."""
    seen = {f.sensor for step in steps for f in step}
    known = {name: value for name, value in sigma.items() if name in seen}
    recording = Recording.of_frames(steps, rig, rate=1.0 / _BETWEEN, sigma=known, up=up)
    person = fitted_to_person(
        recording, body, channels_of(recording, body), settings, subject=None, trial=None, height=height, size=True,
        frames=None, progress=None,
    )  # fmt: skip
    return person.subject.body
