"""Fixed-lag smoothing: each frame is returned after a lag, estimated from a sliding window with the motion prior.

The window contains the frames of the lag, and some older ones, which are still linearised again. Frames that leave the
window are marginalised: they become a quadratic cost of its first three frames (`solvers.trajectory.marginal`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.fitting.frame.results import FrameResult, frame_result
from kinefit.fitting.smoothing.online.lag_frame import FrameCosts, KnownNoise, LagFrame
from kinefit.fitting.smoothing.tracked_frames import Linearised, TrackerLike
from kinefit.fitting.smoothing.unwrap import boxes, continued
from kinefit.observations.arrays import is_number
from kinefit.sensors.base import Measurement, of_kind
from kinefit.solving.closed import on_null_space, onto
from kinefit.solving.correspondences.closures import hard_equations
from kinefit.solving.equations import block_diagonal
from kinefit.solving.trajectory.marginal import Entering, leave
from kinefit.solving.trajectory.motion_prior import MotionPrior
from kinefit.solving.trajectory.smoothing import Smoothed, posterior, smooth

_OLDER_FRAMES_S = 0.3  # [s] of frames before the lag that are still linearised
_MAX_ITERATIONS = 3  # of a window: it starts at the solution of the last one
_MAX_STEPS = np.array([0.3, 1.0])  # [m], [rad] per frame: a larger jump is a re-detected body, no motion


class FixedLag:
    """Smooths a tracker's results, with a lag of a few frames.

    Parameters
    ----------
    tracker : Tracker, or an object with its `body`, `rate`, `settings`, `scene_of` and `apart`
    lag : float [s] after which a frame is returned, one frame at least
    noise : KnownNoise; default: `KnownNoise.usual`

    Attributes
    ----------
    seconds : float [s], the lag rounded to whole frames

    Raises
    ------
    ObservationError
        The lag is less than a frame; `tracker` is no tracker.
    """

    def __init__(self, tracker: TrackerLike, lag: float, *, noise: KnownNoise | None = None) -> None:
        if not (isinstance(getattr(tracker, "body", None), Body) and is_number(lag)):
            problem = f"a {type(tracker).__name__} and a {type(lag).__name__} are not a tracker and a lag"
            raise ObservationError(problem, remedy="Give a Tracker and seconds: FixedLag(tracker, 0.1).")
        rate, settings = tracker.rate, tracker.settings
        self._lag = lag_frames(lag, rate)
        self.seconds = self._lag / rate
        self.rate, self.body = rate, tracker.body
        self._window = self._lag + max(round(_OLDER_FRAMES_S * rate), 3)
        self.noise = noise or KnownNoise.usual(self.body)
        self._memory = round(settings.smooth_memory * rate)
        memory = settings.acceleration_memory, settings.smooth_memory
        tree = self.body.tree
        self._prior = MotionPrior(
            self.noise.acceleration, memory, 1.0 / rate, tree.usual, tree.spread, couplings=tree.couplings
        )
        self._share = self._prior.posture_share
        self._costs = FrameCosts(tracker, self.noise)
        self._hard = hard_equations(self.body)
        self._begin()

    def _begin(self) -> None:
        self._frames: list[LagFrame] = []
        self._waiting = 0  # frames of the window that are not returned yet
        self._entering: Entering | None = None
        self._livelier = np.ones((0, self.body.tree.n_dofs))
        self._count = 0
        self._last_observed = np.full(len(self.body.tree.coordinates), -(10**9))  # frame number, of each coordinate

    def add(
        self, result: FrameResult | None, measurements: Sequence[Measurement] | None = None, *, ahead: int | None = None
    ) -> list[FrameResult]:
        """Add the tracker's result of a new frame; returns the smoothed frames whose lag is over, usually one.

        After a gap in time longer than the window, all waiting frames are returned, and smoothing starts again.

        Parameters
        ----------
        result : from `Tracker.update`; None, and the same result again, are ignored
        measurements : of the frame, all but keypoints; default: those of the result
        ahead : number of frames since the last one; default: from the times. 0 merges the frame with the last one.

        Raises
        ------
        ObservationError
            `result` is no FrameResult.
        """
        if result is None or (self._frames and result is self._frames[-1].result):
            return []
        of_kind(result, FrameResult, "the result", "Give a result of Tracker.update.")
        new = self._costs.frame(result, measurements)
        if not self._frames:
            self._append(new)
            return self._solved()
        last = self._frames[-1]
        elapsed = (result.time - last.result.time) * self.rate
        ahead = round(elapsed) if ahead is None else ahead
        if elapsed < 0.0 or ahead > self._window:
            out = self.finish()
            self._append(new)
            return out + self._solved()
        if ahead == 0:
            last.measurements += new.measurements
            last.points, last.surfaces, last.H = last.points + new.points, last.surfaces + new.surfaces, None
            last.result = result
            return self._solved()
        out = []
        for k in range(1, ahead):
            state = last.state.retract(k / ahead * last.state.difference(new.state))
            time = last.result.time + k / ahead * (result.time - last.result.time)
            empty = replace(result, time=time, state=state, matched=(), measurements=())
            self._append(LagFrame(empty, (), (), (), state, real=False))
            out += self._solved()
        self._append(new)
        return out + self._solved()

    def finish(self) -> list[FrameResult]:
        """Return all waiting frames, and reset: the next frame starts a new window."""
        out = self._results(self._waiting) if self._waiting else []
        self._begin()
        return out

    def _append(self, frame: LagFrame) -> None:
        if self._frames:
            before = self._frames[-1].state.angles
            angles = continued(self.body.tree, before, frame.state.angles)
            frame.state = BodyState(frame.state.T_world_root, angles)
        self._frames.append(frame)
        self._waiting += 1
        self._count += 1
        self._livelier = np.concatenate([self._livelier, np.ones((1, self._livelier.shape[1]))])
        self._allow_jump()
        self._last_observed[self._costs.observed(self._frames, len(self._frames) - 1)] = self._count

    def _allow_jump(self) -> None:
        """Raise the process noise of the newest step to its size, if the tracker re-detected the body elsewhere."""
        if len(self._frames) < 2:
            return
        recent = [f.state for f in self._frames[-4:]]
        steps = [a.difference(b) for a, b in pairwise(recent)]
        fast, slow = self._prior.keep
        change = steps[-1]
        for k, part in ((2, fast + slow), (3, -fast * slow)):
            if len(steps) >= k:
                change = change - part * steps[-k]
        limit = np.where(np.arange(len(change)) < 3, *_MAX_STEPS)
        std = 1.0 / np.sqrt(self._prior.weight)
        factor = np.where(np.abs(change) > limit, np.maximum(np.abs(change) / std, 1.0), 1.0)
        self._livelier[-2] = factor  # of the step that leads to the newest frame

    def _solved(self) -> list[FrameResult]:
        """Solve the window, and return the frames whose lag is over."""
        due = len(self._frames) - 1 - self._lag
        if due >= 0 and self._waiting > self._lag:
            self._costs.match(self._frames, due)
        self._fit()
        if self._waiting <= self._lag:
            return []
        return self._results(self._waiting - self._lag)

    def _fit(self) -> None:
        frames, tree = self._frames, self.body.tree
        while len(frames) > self._window and len(frames) > 4:
            self._marginalise_oldest()
        made = [self._costs.quadratic(self._frames, f) for f in range(len(frames))]
        H, g, cost = (np.array(v) for v in zip(*made))
        roots, angles = self._states()
        costs = Linearised(H, g, cost, roots, angles, (), np.zeros(len(cost)))
        lower, upper, mean = boxes(tree, angles)
        prior = replace(self._prior, mean=mean, activity=self._livelier)
        self._last: Smoothed = smooth(
            self.body, roots, angles, costs.equations, prior, bounds=(lower, upper), dense=True,
            entering=self._entering, max_iterations=_MAX_ITERATIONS, tolerance=1e-4,
        )  # fmt: skip
        for frame, T, q in zip(frames, self._last.roots, self._last.angles):
            frame.state = BodyState(T, q)

    def _marginalise_oldest(self) -> None:
        """Remove the oldest frame from the window, and keep its cost of the next three frames."""
        roots, angles = self._states(4)
        lower, upper, mean = boxes(self.body.tree, angles)
        H, g, _ = self._costs.quadratic(self._frames, 0)
        weight = self.body.tree.posture_precision
        H[6:, 6:] += weight
        g[6:] += weight @ (mean[0] - angles[0])
        at_limit = (angles[0] <= lower[0]) | (angles[0] >= upper[0])
        held = np.concatenate([np.full(6, not self.body.tree.root_free), at_limit])
        motion = replace(self._prior, activity=self._livelier).rows(3)
        share = block_diagonal(np.zeros((6, 6)), self._share - weight)
        self._entering = leave(self.body, (roots, angles), H, g, share, held, motion, self._entering)
        del self._frames[0]
        self._livelier = self._livelier[1:]

    def _states(self, count: int | None = None) -> tuple[NDArray, NDArray]:
        states = [f.state for f in self._frames[:count]]
        return np.stack([s.T_world_root for s in states]), np.stack([s.angles for s in states])

    def _results(self, count: int) -> list[FrameResult]:
        """Results of the first `count` waiting frames, which no longer wait."""
        first = len(self._frames) - self._waiting
        found = posterior(self.body, self._last, first, self._share).frames
        out = []
        for f in range(first, first + count):
            frame = self._frames[f]
            self._waiting -= 1
            if frame.real:
                if self._hard is not None:
                    frame.state = onto(self.body, frame.state, self._hard, limits=False)[0]
                number = self._count - len(self._frames) + f + 1
                observed = self._last_observed >= number - self._memory
                matched = (*frame.points, *frame.surfaces)
                scene, covariance = self._costs.scene(self._frames, f), self._on_closures(frame.state, found[f])
                out.append(frame_result(scene, covariance, matched, self._last.iterations, observed=observed))
        return out

    def _on_closures(self, state: BodyState, covariance: NDArray) -> NDArray:
        """Covariance (n, n) restricted to motions that keep hard closures closed."""
        return covariance if self._hard is None else on_null_space(covariance, self._hard(state)[1])


def lag_frames(lag: float, rate: float) -> int:
    """Convert a lag [s] to frames, with the frame rate [Hz].

    Raises
    ------
    ObservationError
        The lag is less than a frame.
    """
    if not (np.isfinite(lag) and round(lag * rate) >= 1):
        raise ObservationError(f"lag is {lag:g} s", remedy=f"Give at least one frame, {1.0 / rate:.3f} s.")
    return round(lag * rate)
