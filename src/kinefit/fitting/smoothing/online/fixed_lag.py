"""Fixed-lag smoothing: each frame is returned after a lag, estimated from a sliding window with the motion prior.

The window contains the frames of the lag, and some older ones, which are still linearised again. Frames that leave the
window are marginalised: they become a quadratic cost of its first three frames (`solvers.trajectory.marginal`).

One frame of a sliding window: its measurements, matched and linearised as a quadratic cost of the pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.fitting.frame.fit import rows_of, rows_of_points
from kinefit.fitting.frame.results import UNOBSERVED_STD_RATIO, FrameResult, frame_result
from kinefit.fitting.smoothing.tracked_frames import Linearised, TrackerLike
from kinefit.fitting.smoothing.unwrap import boxes, continued
from kinefit.observations.arrays import is_number
from kinefit.sensors.base import Matched, Measurement, matched_by, of_kind
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.keypoints import KeypointMatched, pixels_and_others, pixels_of
from kinefit.sensors.scene import Scene
from kinefit.solving.closed import on_null_space, onto
from kinefit.solving.correspondences.closures import every_closure, hard_equations, looped
from kinefit.solving.equations import block_diagonal, inverse, normal_equations
from kinefit.solving.rows import AnyRows
from kinefit.solving.trajectory.motion_prior import MotionPrior
from kinefit.solving.trajectory.smoothing import Entering, Smoothed, leave, posterior, smooth


@dataclass(eq=False)
class LagFrame:
    """A frame of the window: its measurements, and the body's state in the last solution."""

    result: FrameResult
    measurements: tuple[Measurement, ...]
    points: tuple[Matched, ...]  # matched once, linearised in every window
    surfaces: tuple[Matched, ...]  # matched again before the frame is returned
    state: BodyState
    real: bool = True
    about: BodyState | None = None
    H: NDArray | None = None  # of the surfaces, about that state
    g: NDArray | None = None
    cost: float = 0.0


class FrameCosts:
    """Makes the frames of a window and their costs.

    Parameters
    ----------
    tracker : see `TrackerLike`
    noise : KnownNoise
    """

    def __init__(self, tracker: TrackerLike, noise: KnownNoise) -> None:
        self.tracker, self.noise, self.body = tracker, noise, tracker.body
        self._sigma: dict[int, tuple[Any, NDArray]] = {}

    def frame(self, result: FrameResult, measurements: Sequence[Measurement] | None) -> LagFrame:
        """A frame of a tracker's result and its measurements, all but keypoints; None: those of the result."""
        scene = self.tracker.scene_of(result.state, result.time)
        if measurements is None:
            measurements, matched = result.measurements, list(result.matched)
        else:
            reach = self.tracker.settings.near
            scene = scene.at(result.state, measurements=tuple(measurements))
            matched = [*pixels_of(result.matched), *(matched_by(m, scene, reach) for m in measurements)]
        loose = {m.sensor for m in measurements if not m.settled}
        points = tuple(m for m in matched if m.sensor not in loose)
        surfaces = tuple(m for m in matched if m.sensor in loose)
        return LagFrame(result, tuple(measurements), points, surfaces, result.state)

    def observed(self, frames: Sequence[LagFrame], f: int) -> NDArray:
        """(D,) bool: coordinates that a frame observes on its own."""
        frame, scene, tree = frames[f], self.scene(frames, f), self.body.tree
        moved = [(m, m.moves(scene)) for m in (*frame.points, *frame.surfaces)]
        moving = [of_points for _, of_points in moved if of_points is not None]
        observed = np.zeros(len(tree.coordinates), bool)
        H = np.diag(np.concatenate([np.full(6, 1.0), 1.0 / np.square(tree.spread)]))
        closed = every_closure(self.body, scene.state)
        if closed:
            H = H + normal_equations(self.body, scene.state, closed).matrix
        for in_images in (False, True):
            matched = [m for m, of_points in moved if (of_points is not None) == in_images]
            if matched:
                H = H + normal_equations(self.body, scene.state, self._rows(matched, scene, frame.points)).matrix
                new = np.sqrt(np.maximum(np.diag(inverse(H)), 0.0))[6:] <= UNOBSERVED_STD_RATIO * tree.spread
                observed |= new & (np.any(moving, axis=0) | looped(self.body)) if in_images else new
        return observed

    def scene(self, frames: Sequence[LagFrame], f: int) -> Scene:
        """The scene of a frame of the window, with its velocity there."""
        frame, (a, b) = frames[f], (max(f - 1, 0), min(f + 1, len(frames) - 1))
        velocity = None
        if b > a:
            first, last = frames[a], frames[b]
            elapsed = max(last.result.time - first.result.time, 1e-6)
            velocity = first.state.difference(last.state) / elapsed
        scene = self.tracker.scene_of(frame.state, frame.result.time)
        return scene.at(frame.state, measurements=frame.measurements, velocity=velocity)

    def _rows(self, matched: Sequence[Matched], scene: Scene, points: Sequence[Matched] = ()) -> list[AnyRows]:
        """Rows of matches; `points` are all matches of points of the frame, which decide how surfaces count."""
        pixels, others = pixels_and_others(matched)
        weighted = [*map(self._with_known_noise, pixels), *others]
        count = rows_of_points(scene, [m for m in points if m not in matched])
        return rows_of(scene, weighted, self.tracker.settings, self.noise.scale, points=count)

    def _with_known_noise(self, m: KeypointMatched) -> KeypointMatched:
        """Keypoints weighted by `KnownNoise.pixel_sigma`."""
        loss = self.tracker.settings.loss
        if not self.noise.pixel_sigma:
            return m if m.loss is loss else _with_time(m, replace(m, loss=loss))
        layout = m.measurement.layout
        if id(layout) not in self._sigma:
            self._sigma[id(layout)] = layout, known_sigma(layout.channels, self.noise) / layout.channels.sigma
        return _with_time(m, replace(m, loss=loss, weight=m.weight / np.square(self._sigma[id(layout)][1])))

    def match(self, frames: Sequence[LagFrame], f: int) -> None:
        """Match a frame's surfaces again at its present state."""
        frame, reach = frames[f], self.tracker.settings.near
        again = [m for m in frame.measurements if not m.settled]
        if again:
            scene = self.scene(frames, f)
            frame.surfaces, frame.H = tuple(matched_by(m, scene, reach) for m in again), None

    def quadratic(self, frames: Sequence[LagFrame], f: int) -> tuple[NDArray, NDArray, float]:
        """Cost c − 2 gᵀδ + δᵀHδ of a frame's measurements about its present state: H (n, n), g (n,), c (a number)."""
        frame, body, n = frames[f], self.body, self.body.tree.n_dofs
        H, g, cost = np.zeros((n, n)), np.zeros(n), 0.0
        if frame.points or body.closures or (frame.surfaces and frame.H is None):
            scene = self.scene(frames, f)
        if frame.points or body.closures:
            rows = [*self._rows(frame.points, scene), *every_closure(body, scene.state)]
            points = normal_equations(body, scene.state, rows)
            H, g, cost = points.matrix, points.gradient, points.cost
        if frame.surfaces:
            if frame.H is None:
                parts = [*self._rows(frame.surfaces, scene, frame.points), *self.tracker.apart(scene)]
                made = normal_equations(body, scene.state, parts)
                frame.about, frame.H, frame.g, frame.cost = frame.state, made.matrix, made.gradient, made.cost
            assert frame.about is not None and frame.g is not None
            delta = frame.about.difference(frame.state)
            moved = frame.H @ delta
            H, g = H + frame.H, g + frame.g - moved
            cost += frame.cost - 2.0 * float(frame.g @ delta) + float(moved @ delta)
        return H, g, cost


def _with_time(old: Matched, new: KeypointMatched) -> KeypointMatched:
    """The new match, with the time of the old one."""
    object.__setattr__(new, "time", old.time)
    return new


_DEFAULT_ACCELERATIONS = 5.0, 30.0  # [m/s²], [rad/s²] of root and angles: quick; everyday takes have 1 to 4, 4 to 20


@dataclass(frozen=True, eq=False)
class KnownNoise:
    """Process noise of a person and noise of sensors, known before a take.

    Parameters
    ----------
    acceleration : (n,) [m/s², rad/s²] random acceleration of every degree of freedom, one standard deviation
    pixel_sigma : {source of keypoints: {point: standard deviation [px] at full confidence}}; others keep theirs
    scale : {sensor: factor on its standard deviation}
    """

    acceleration: NDArray
    pixel_sigma: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def usual(cls, body: Body) -> KnownNoise:
        """Accelerations of a person who moves quickly, 5 m/s² and 30 rad/s², and the sensors' own noise.

        Calm movements have half of that. They are smoothed a little less than they could be.
        """
        return cls(np.where(np.arange(body.tree.n_dofs) < 3, *_DEFAULT_ACCELERATIONS))

    @classmethod
    def of_take(cls, body: Body, provenance: Mapping[str, Any]) -> KnownNoise:
        """Noise estimated from another take: the `Motion.provenance` of its smoothed motion.

        Raises
        ------
        ObservationError
            The motion was not smoothed as a whole, or has another body.
        """
        smoothing = provenance.get("smoothing", {})
        found = smoothing.get("acceleration", {})
        names = ("root_shift",) * 3 + ("root_turn",) * 3 + body.tree.coordinates
        missing = [name for name in names if name not in found]
        if missing:
            problem = f"the motion has no process noise of {missing[0]}"
            raise ObservationError(problem, remedy="Give a motion of this body, smoothed over the whole take.")
        acceleration = np.maximum(np.array([found[name] for name in names]), 1e-3)
        return cls(acceleration, smoothing.get("pixel_sigma", {}), smoothing.get("sigma_factor", {}))

    def as_record(self, body: Body) -> dict[str, Any]:
        """The noise as a provenance record by name, readable by `of_take`."""
        names = ("root_shift", "root_turn", *body.tree.coordinates)
        values = [self.acceleration[0], *self.acceleration[5:]]
        return {
            "acceleration": {name: float(f"{v:.4g}") for name, v in zip(names, values)},
            "pixel_sigma": {source: dict(of) for source, of in self.pixel_sigma.items()},
            "sigma_factor": dict(self.scale),
        }  # fmt: skip


def known_sigma(channels: Channels, noise: KnownNoise) -> NDArray:
    """(N,) [px] standard deviations of keypoints: known ones, else the channels' own."""
    out = np.array(channels.sigma)
    for k, (q, c) in enumerate(zip(channels.source, channels.column)):
        out[k] = noise.pixel_sigma.get(channels.sources[q], {}).get(channels.points.names[c], out[k])
    return out


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
