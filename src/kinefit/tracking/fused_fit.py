"""One time's fit: what the sensors saw becomes rows, anew in every iteration, and a state with its error bars."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.correspondences.collisions import CollisionPairs, collision_pairs, collision_rows
from kinefit.errors import BodyError
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import DepthFrame, Frame, KeypointFrame, MarkerFrame, PointCloud, SilhouetteFrame
from kinefit.rows import AnyRows, ParameterRows
from kinefit.sensors.background import Background
from kinefit.sensors.depth_image import DepthMeasurement
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.measurements import KeypointMeasurement, MarkerMeasurement, Measurement
from kinefit.sensors.occlusion import beside
from kinefit.sensors.point_cloud import CloudMeasurement
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.silhouette import SilhouetteMeasurement, outline_camera
from kinefit.sensors.surface import Surface
from kinefit.solvers.equations import Covariance, inverse, joint_std
from kinefit.solvers.least_squares import gauss_newton
from kinefit.tracking.prediction import belief

_In = TypeVar("_In")
_Out = TypeVar("_Out")

Held = tuple[BodyState, NDArray]
"""What is known beforehand: a state, and the information (n, n) of it."""


@dataclass(frozen=True, eq=False)
class FusionResult:
    """One tracked frame.

    Parameters
    ----------
    time : float [s]
    state : BodyState
    dof_std : (6 + D,) [m, rad]
    joint_std : (S, 3) [m]
    segment_quality : (S,) in 0..1
        Share of what the sensors can see of a segment that agrees with them; 0 where they see nothing of it.
    lost : (S,) bool
        Segments that what was measured speaks against.
    hidden : (S,) bool
        Segments that no sensor sees: held by the prediction and the prior alone.
    iterations : int
    """

    time: float
    state: BodyState
    dof_std: NDArray
    joint_std: NDArray
    segment_quality: NDArray
    lost: NDArray
    hidden: NDArray
    iterations: int

    @property
    def quality(self) -> float:
        """Mean quality of all segments, in 0..1."""
        return float(np.mean(self.segment_quality))


class FusedFit:
    """A body and its sensors, ready for one fit after the other.

    Parameters
    ----------
    body : Body, with surfaces where depth is to be used.
    rig : Rig
    rate : float [Hz] of the frames
    accuracy : {sensor: standard deviation}, [m] or [px], "silhouette CAMERA" for silhouettes;
        others have those of the settings.
    settings : TrackSettings
    backgrounds : {depth camera: Background}, added to when one is seen first; None for one that is to have none.
    """

    def __init__(
        self, body: Body, rig: Rig, rate: float, accuracy: Mapping[str, float], settings: TrackSettings,
        backgrounds: dict[str, Background | None],
    ) -> None:  # fmt: skip
        self.body, self.rig, self.rate, self.accuracy, self.settings = body, rig, rate, accuracy, settings
        self.surface = Surface(body, settings.samples) if body.surfaces else None
        morphing = self.surface.morphing if self.surface is not None else None
        self._moving = morphing if morphing is not None and morphing.moves_joints else None
        self._backgrounds = backgrounds
        self._pool: ThreadPoolExecutor | None = None
        self._pairs: CollisionPairs | None = collision_pairs(body) if body.surfaces else None
        self._prior = 6 + np.flatnonzero(np.isfinite(body.tree.spread))
        self._prior_weight = 1.0 / np.square(body.tree.spread[self._prior - 6])

    def measurements(self, frames: Sequence[Frame], state: BodyState) -> list[Measurement]:
        """What the sensors saw, ready to make rows about a state."""
        if self.surface is not None and any(isinstance(frame, SilhouetteFrame) for frame in frames):
            self.surface.pose(state)
            for frame in frames:  # room for each, before they are looked at side by side
                if isinstance(frame, SilhouetteFrame):
                    self.surface.rims(outline_camera(self.rig[frame.sensor], self.settings))
        return self._each(lambda frame: self._measurement(frame, frames, state), frames)

    def _each(self, do: Callable[[_In], _Out], what: Sequence[_In]) -> list[_Out]:
        """Several silhouettes side by side, on two cores, as most of it runs compiled; else one after the other."""
        if sum(isinstance(w, SilhouetteFrame | SilhouetteMeasurement) for w in what) < 2:
            return [do(w) for w in what]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(2)
        return list(self._pool.map(do, what))

    def _measurement(self, frame: Frame, frames: Sequence[Frame], state: BodyState) -> Measurement:
        s, name = self.settings, frame.sensor
        if isinstance(frame, KeypointFrame):
            accuracy, depth = self.accuracy.get(name, s.pixel), self._beside(frame, frames, state)
            return KeypointMeasurement(frame, self.body, self.rig, accuracy, self._moving, depth=depth)
        if isinstance(frame, MarkerFrame):
            return MarkerMeasurement(frame, self.body, self.accuracy.get(name, s.marker), self._moving)
        surface = self.surface or Surface(self.body, s.samples)  # which tells what is missing
        if isinstance(frame, SilhouetteFrame):
            sigma = self.accuracy.get(f"silhouette {name}", s.silhouette)
            return SilhouetteMeasurement(frame, self.rig[name], surface, surface.pose(state).vertices, sigma, s)
        if self._moving:
            problem = f"depth does not know of joints that move with angles, as those of body '{self.body.name}' do"
            raise BodyError(problem, remedy="Take the body without morphs: replace(body, morphs=()), or without depth.")
        sigma, vertices = self.accuracy.get(name, s.depth), surface.posed(state)
        if isinstance(frame, PointCloud):
            return CloudMeasurement(frame, surface, vertices, sigma, s)
        camera = self.rig[name]
        return DepthMeasurement(frame, camera, surface, vertices, sigma, s, self.background(camera))

    def _beside(
        self, frame: KeypointFrame, frames: Sequence[Frame], state: BodyState
    ) -> tuple[DepthFrame, Camera, float] | None:
        """A depth frame whose camera sees the body from about the same side, with its accuracy."""
        depths = [f for f in frames if isinstance(f, DepthFrame)]
        cameras = [self.rig[f.sensor] for f in depths]
        near = beside(self.rig[frame.sensor], cameras, state.T_world_root[:3, 3])
        if not near:
            return None
        chosen = depths[near[0]]
        return chosen, cameras[near[0]], self.accuracy.get(chosen.sensor, self.settings.depth)

    def _rows(
        self, state: BodyState, held: Held | None, measurements: Sequence[Measurement], bound: float
    ) -> list[AnyRows]:
        if self.surface is not None:
            self.surface.pose(state)
            self.surface.posed(state)
        told = self._each(lambda m: m.rows(state, bound), measurements)
        parts: list[AnyRows] = [rows for several in told for rows in several]
        if held is not None:
            parts.append(belief(state, *held))
        usual = self.body.tree.usual
        parts.append(ParameterRows(self._prior, (usual - state.angles)[self._prior - 6], self._prior_weight))
        if self._pairs is not None:
            s = self.settings
            parts.append(collision_rows(self.body, state, pairs=self._pairs, margin=-s.flesh, sigma=s.collision))
        return parts

    def run(
        self, time: float, state: BodyState, held: Held | None, measurements: Sequence[Measurement]
    ) -> tuple[FusionResult, NDArray]:
        """Fit from a state on, and judge; the result, and the covariance (n, n) with what was held."""
        s, bound, iterations = self.settings, self.settings.far, 0
        while iterations < s.iterations:
            iterations += 1
            loss = replace(s.loss, scale=s.loss.scale * bound / s.near)  # far points pull too, while all is far off
            step = gauss_newton(self.body, state, self._rows(state, held, measurements, bound), loss=loss)
            state = step.state
            gain = float(step.delta @ step.equations.gradient)  # twice the fall of the cost: squared deviations
            if gain < s.tolerance**2 * len(step.delta) and bound <= s.near:
                break
            bound = max(bound * s.shrink, s.near)
        posterior = inverse(step.equations.matrix)
        told, cov = self.judged(state, measurements), Covariance(posterior, np.empty((len(posterior), 0)))
        std, joints = np.sqrt(np.maximum(np.diag(posterior), 0.0)), joint_std(self.body, state, cov)
        result = FusionResult(time, state, std, joints, told.quality, told.lost, told.hidden, iterations)
        return result, posterior

    def judged(self, state: BodyState, measurements: Sequence[Measurement]) -> Evidence:
        """What measurements say of each segment."""
        told = Evidence.none(len(self.body.tree.segments))
        if self.surface is not None:
            self.surface.pose(state)
            self.surface.posed(state)
        for one in self._each(lambda m: m.evidence(state), measurements):
            told = told + one
        return told

    def background(self, camera: Camera) -> Background | None:
        """What stands still before a depth camera; None where nothing is to be learnt."""
        if camera.name not in self._backgrounds:
            sigma = self.accuracy.get(camera.name, self.settings.depth)
            wait = self.settings.background * self.rate
            still = np.isfinite(wait)
            self._backgrounds[camera.name] = Background(camera, sigma, max(round(wait), 2)) if still else None
        return self._backgrounds[camera.name]
