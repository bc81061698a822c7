"""A few frames behind live: each frame's estimate is that of a window of frames solved with the motion prior.

The window reaches from the newest frame back over the lag, and some more frames before, which are still linearised
anew. What left the window stays as a quadratic cost of its first three frames (`solvers.marginal`), so that nothing of
it is forgotten.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.frame.results import BLIND, FrameResult, judged
from kinefit.multiview.observability import SHORTEST, levers
from kinefit.rows import AnyRows
from kinefit.sensors.base import Matched, Measurement, matched_by, rows_at
from kinefit.sensors.keypoints import KeypointMatched
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.smoothing.known_noise import KnownNoise, known_sigma
from kinefit.smoothing.linearised import weaker
from kinefit.smoothing.process_noise import INLIER
from kinefit.smoothing.unwrap import boxes, continued
from kinefit.solvers import _kernels_smoothing
from kinefit.solvers.equations import inverse, normal_equations
from kinefit.solvers.marginal import Entering, leave
from kinefit.solvers.smoothing import Equations, MotionPrior, Smoothed, blocks, posterior, smooth

_BEFORE = 0.3  # [s] of frames before the lag that are still linearised anew
_TRIED = 3  # steps of a window: it begins where the last one ended
_LEAP = np.array([0.3, 1.0])  # [m], [rad] a frame: a larger jump is a body found elsewhere, no motion


class Follows(Protocol):
    """What is asked of a tracker."""

    body: Body
    rate: float
    settings: TrackSettings

    def scene_of(self, state: BodyState, time: float = 0.0) -> Scene:
        """The tracker's body in a state."""

    def apart(self, scene: Scene) -> Sequence[AnyRows]:
        """Rows that keep parts of the body from running into each other."""


@dataclass(eq=False)
class _Frame:
    """A frame of the window: what was measured, and where the body is by the last solution."""

    result: FrameResult
    measurements: tuple[Measurement, ...]
    points: tuple[Matched, ...]  # matched once; linearised anew in every window
    surfaces: tuple[Matched, ...]  # matched again before the frame is handed out
    state: BodyState
    real: bool = True
    about: BodyState | None = None
    H: NDArray | None = None  # of the surfaces, about that state
    g: NDArray | None = None
    cost: float = 0.0


class FixedLag:
    """Smooths what a tracker gives, a few frames behind it.

    Parameters
    ----------
    tracker : Tracker, or what has its `body`, `rate`, `settings`, `scene_of` and `apart`
    lag : float [s] by which frames come later, a frame at least
    noise : KnownNoise; default: the settings' accelerations, which are those of quick movements

    Attributes
    ----------
    seconds : float, the lag in whole frames

    Raises
    ------
    ObservationError
        A lag of less than a frame.
    """

    def __init__(self, tracker: Follows, lag: float, *, noise: KnownNoise | None = None) -> None:
        rate, settings = tracker.rate, tracker.settings
        self._lag = lag_frames(lag, rate)
        self.seconds = self._lag / rate
        self._tracker, self.body = tracker, tracker.body
        self._most = self._lag + max(round(_BEFORE * rate), 3)
        self.noise = noise or KnownNoise.of_settings(self.body, settings)
        self._memory = round(settings.smooth_memory * rate)
        memory = settings.acceleration_memory, settings.smooth_memory
        tree = self.body.tree
        self._prior = MotionPrior(self.noise.acceleration, memory, 1.0 / rate, tree.usual, tree.spread)
        share = self._prior.posture_share - 1.0 / np.square(tree.spread)
        self._share = np.concatenate([np.zeros(6), share])
        self._spread = np.diag(np.concatenate([np.full(6, 1.0), 1.0 / np.square(tree.spread)]))
        self._sigma: dict[int, tuple[Any, NDArray]] = {}
        self._begin()

    def _begin(self) -> None:
        self._frames: list[_Frame] = []
        self._waiting = 0  # frames of the window that were not handed out yet
        self._entering: Entering | None = None
        self._livelier = np.ones((0, self.body.tree.n_dofs))
        self._count = 0
        self._told = np.full(len(self.body.tree.coordinates), -(10**9))  # the last frame that tells of each coordinate

    def add(
        self, result: FrameResult | None, measurements: Sequence[Measurement] | None = None, *, ahead: int | None = None
    ) -> list[FrameResult]:
        """Take the tracker's result of a new frame, and hand out those for which the lag is over, mostly one.

        A gap in time of more than the window ends it: what waits is handed out, and it begins anew.

        Parameters
        ----------
        result : as `Tracker.update` gives it; None, and the same one again, count for nothing.
        measurements : what it was made from, all but keypoints; default: as the result has them
        ahead : frames since the last one; default: by its time. Less than half a frame is joined to it.
        """
        if result is None or (self._frames and result is self._frames[-1].result):
            return []
        new = self._frame(result, measurements)
        if not self._frames:
            self._append(new)
            return self._solved()
        last = self._frames[-1]
        gone = (result.time - last.result.time) * self._tracker.rate
        ahead = round(gone) if ahead is None else ahead
        if gone < 0.0 or ahead > self._most:
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
            nothing = replace(result, time=time, state=state, matched=(), measurements=())
            self._append(_Frame(nothing, (), (), (), state, real=False))
            out += self._solved()
        self._append(new)
        return out + self._solved()

    def finish(self) -> list[FrameResult]:
        """All frames that wait for later ones; what comes then begins anew."""
        out = self._handed(self._waiting) if self._waiting else []
        self._begin()
        return out

    def _frame(self, result: FrameResult, measurements: Sequence[Measurement] | None) -> _Frame:
        scene = self._tracker.scene_of(result.state, result.time)
        if measurements is None:
            measurements, matched = result.measurements, list(result.matched)
        else:
            reach = self._tracker.settings.near
            matched = [m for m in result.matched if isinstance(m, KeypointMatched)]
            scene = scene.at(result.state, measurements=tuple(measurements))
            matched += [matched_by(m, scene, reach) for m in measurements]
        loose = {m.sensor for m in measurements if not m.settled}
        points = tuple(m for m in matched if m.sensor not in loose)
        surfaces = tuple(m for m in matched if m.sensor in loose)
        return _Frame(result, tuple(measurements), points, surfaces, result.state)

    def _append(self, frame: _Frame) -> None:
        if self._frames:
            before = self._frames[-1].state.angles
            angles = continued(self.body.tree, before, frame.state.angles)
            frame.state = BodyState(frame.state.T_world_root, angles)
        self._frames.append(frame)
        self._waiting += 1
        self._count += 1
        self._livelier = np.concatenate([self._livelier, np.ones((1, self._livelier.shape[1]))])
        self._leap()
        self._learn(frame)

    def _leap(self) -> None:
        """Where the tracker found the body elsewhere, the newest change of its steps is as large as it is."""
        if len(self._frames) < 2:
            return
        recent = [f.state for f in self._frames[-4:]]
        steps = [a.difference(b) for a, b in zip(recent, recent[1:])]
        fast, slow = self._prior.keep
        change = steps[-1]
        for k, part in ((2, fast + slow), (3, -fast * slow)):
            if len(steps) >= k:
                change = change - part * steps[-k]
        limit = np.where(np.arange(len(change)) < 3, *_LEAP)
        usual = 1.0 / np.sqrt(self._prior.weight)
        factor = np.where(np.abs(change) > limit, np.maximum(np.abs(change) / usual, 1.0), 1.0)
        self._livelier[-2] = factor  # of the step that leads to the newest frame

    def _learn(self, frame: _Frame) -> None:
        """Which coordinates a frame tells of on its own."""
        scene = self._scene(len(self._frames) - 1)
        pixels = [m for m in frame.points if isinstance(m, KeypointMatched)]
        others = [m for m in (*frame.points, *frame.surfaces) if not isinstance(m, KeypointMatched)]
        tree, told = self.body.tree, np.zeros(len(self._told), bool)
        H = np.zeros_like(self._spread)
        for several, far in ((others, False), (pixels, True)):
            if several:
                H = H + normal_equations(self.body, scene.state, self._rows(several, scene)).matrix
                seen = np.sqrt(np.maximum(np.diag(inverse(H + self._spread)), 0.0))[6:] <= BLIND * tree.spread
                told |= seen & self._far(pixels, scene) if far else seen
        self._told[told] = self._count

    def _far(self, pixels: Sequence[KeypointMatched], scene: Scene) -> NDArray:
        """(D,) bool: coordinates that move a keypoint that is seen."""
        out = np.zeros(len(self._told), bool)
        for m in pixels:
            inside = (m.weight > 0) & (m.loss.factor(m.squares(scene)) > INLIER)
            points, state = m.measurement.layout.points_of(self.body), scene.state
            out |= levers(self.body, points, inside[None], state.T_world_root[None], state.angles[None])[0] > SHORTEST
        return out

    def _scene(self, f: int) -> Scene:
        """Of a frame of the window, with its velocity there."""
        frame, (a, b) = self._frames[f], (max(f - 1, 0), min(f + 1, len(self._frames) - 1))
        velocity = None
        if b > a:
            first, last = self._frames[a], self._frames[b]
            gone = max(last.result.time - first.result.time, 1e-6)
            velocity = first.state.difference(last.state) / gone
        scene = self._tracker.scene_of(frame.state, frame.result.time)
        return scene.at(frame.state, measurements=frame.measurements, velocity=velocity)

    def _rows(self, matched: Sequence[Matched], scene: Scene) -> list[AnyRows]:
        rows = []
        for m in matched:
            m = self._known(m) if isinstance(m, KeypointMatched) else m
            rows += [weaker(r, self.noise.scale.get(m.sensor, 1.0)) for r in rows_at(m, scene)]
        return rows

    def _known(self, m: KeypointMatched) -> KeypointMatched:
        """Keypoints with the noise that is known."""
        loss = self._tracker.settings.loss
        if not self.noise.pixel_sigma:
            return m if m.loss is loss else _like(m, replace(m, loss=loss))
        layout = m.measurement.layout
        if id(layout) not in self._sigma:
            self._sigma[id(layout)] = layout, known_sigma(layout.channels, self.noise) / layout.channels.sigma
        return _like(m, replace(m, loss=loss, weight=m.weight / np.square(self._sigma[id(layout)][1])))

    def _match(self, f: int) -> None:
        """Find the correspondences of a frame's surfaces anew."""
        frame, reach = self._frames[f], self._tracker.settings.near
        again = [m for m in frame.measurements if not m.settled]
        if again:
            scene = self._scene(f)
            frame.surfaces, frame.H = tuple(matched_by(m, scene, reach) for m in again), None

    def _quadratic(self, f: int) -> tuple[NDArray, NDArray, float]:
        """Cost c − 2 gᵀδ + δᵀHδ of a frame's measurements about where it is now: H, g, c."""
        frame, body, n = self._frames[f], self.body, self.body.tree.n_dofs
        H, g, cost = np.zeros((n, n)), np.zeros(n), 0.0
        if frame.points or (frame.surfaces and frame.H is None):
            scene = self._scene(f)
        if frame.points:
            points = normal_equations(body, scene.state, self._rows(frame.points, scene))
            H, g, cost = points.matrix, points.gradient, points.cost
        if frame.surfaces:
            if frame.H is None:
                parts = [*self._rows(frame.surfaces, scene), *self._tracker.apart(scene)]
                made = normal_equations(body, scene.state, parts)
                frame.about, frame.H, frame.g, frame.cost = frame.state, made.matrix, made.gradient, made.cost
            assert frame.about is not None and frame.g is not None
            delta = frame.about.difference(frame.state)
            moved = frame.H @ delta
            H, g = H + frame.H, g + frame.g - moved
            cost += frame.cost - 2.0 * float(frame.g @ delta) + float(moved @ delta)
        return H, g, cost

    def _solved(self) -> list[FrameResult]:
        """Solve the window, and hand out what is due."""
        due = len(self._frames) - 1 - self._lag
        if due >= 0 and self._waiting > self._lag:
            self._match(due)
        self._fit()
        if self._waiting <= self._lag:
            return []
        return self._handed(self._waiting - self._lag)

    def _fit(self) -> None:
        frames, tree = self._frames, self.body.tree
        while len(frames) > self._most and len(frames) > 4:
            self._leave()
        made = [self._quadratic(f) for f in range(len(frames))]
        H, g, cost = (np.array(v) for v in zip(*made))
        roots, angles = self._states()
        lower, upper, usual = boxes(tree, angles)
        prior = replace(self._prior, usual=usual, liveliness=self._livelier)

        def equations(new_roots: NDArray, new_angles: NDArray) -> Equations:
            delta = np.empty(g.shape)
            _kernels_smoothing.differences(roots, new_roots, angles, new_angles, delta)
            moved = np.einsum("tij,tj->ti", H, delta)
            costs = cost - 2.0 * np.einsum("ti,ti->t", g, delta) + np.einsum("ti,ti->t", moved, delta)
            return np.array(H), g - moved, costs

        self._last: Smoothed = smooth(
            self.body, roots, angles, equations, prior, bounds=(lower, upper), dense=True, entering=self._entering,
            max_iterations=_TRIED, tolerance=1e-4,
        )  # fmt: skip
        for frame, T, q in zip(frames, self._last.roots, self._last.angles):
            frame.state = BodyState(T, q)

    def _leave(self) -> None:
        """Take the oldest frame out of the window, and keep what it tells of the next three."""
        roots, angles = self._states(4)
        lower, upper, usual = boxes(self.body.tree, angles)
        H, g, _ = self._quadratic(0)
        weight = 1.0 / np.square(self.body.tree.spread)
        H[np.arange(6, len(H)), np.arange(6, len(H))] += weight
        g[6:] += weight * (usual[0] - angles[0])
        held = np.concatenate([np.full(6, not self.body.tree.root_free), (angles[0] <= lower[0]) | (angles[0] >= upper[0])])
        past, strength = replace(self._prior, liveliness=self._livelier).rows(3)
        self._entering = leave(
            self.body, roots, angles, H, g, self._share, held, past, strength, blocks(self.body), self._entering
        )
        del self._frames[0]
        self._livelier = self._livelier[1:]

    def _states(self, count: int | None = None) -> tuple[NDArray, NDArray]:
        states = [f.state for f in self._frames[:count]]
        return np.stack([s.T_world_root for s in states]), np.stack([s.angles for s in states])

    def _handed(self, count: int) -> list[FrameResult]:
        """Results of the first frames that wait."""
        first = len(self._frames) - self._waiting
        found = posterior(self.body, self._last, first).frames
        out = []
        for f in range(first, first + count):
            frame = self._frames[f]
            self._waiting -= 1
            if frame.real:
                number = self._count - len(self._frames) + f + 1
                observed = self._told >= number - self._memory
                matched = (*frame.points, *frame.surfaces)
                out.append(judged(self._scene(f), found[f], matched, self._last.iterations, observed=observed))
        return out


def lag_frames(lag: float, rate: float) -> int:
    """A lag [s] in frames.

    Raises
    ------
    ObservationError
        Less than a frame.
    """
    if not (np.isfinite(lag) and round(lag * rate) >= 1):
        raise ObservationError(f"a lag of {lag:g} s", remedy=f"Give a frame at least, {1.0 / rate:.3f} s.")
    return round(lag * rate)


def _like(old: Matched, new: KeypointMatched) -> KeypointMatched:
    """With the time of another match."""
    object.__setattr__(new, "time", old.time)
    return new
