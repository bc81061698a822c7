"""One frame of a sliding window: its measurements, matched and linearised as a quadratic cost of the pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.fitting.frame.fit import rows_of, rows_of_points
from kinefit.fitting.frame.results import UNOBSERVED_STD_RATIO, FrameResult
from kinefit.fitting.smoothing.tracked_frames import TrackerLike
from kinefit.sensors.base import Matched, Measurement, matched_by
from kinefit.sensors.channels import Channels
from kinefit.sensors.points.keypoints import KeypointMatched, pixels_of
from kinefit.sensors.scene import Scene
from kinefit.solving.correspondences.closures import every_closure, looped
from kinefit.solving.equations import inverse, normal_equations
from kinefit.solving.rows import AnyRows


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
        weighted = [self._with_known_noise(m) if isinstance(m, KeypointMatched) else m for m in matched]
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
