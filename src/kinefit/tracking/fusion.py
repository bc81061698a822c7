"""The tracker of any mix of sensors, frame by frame: predict, correspond, solve, judge, recover."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.charts import off_the_limits
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame, Frame
from kinefit.rows import ParameterRows
from kinefit.solvers.equations import covariance, inverse, joint_std, normal_equations
from kinefit.solvers.least_squares import gauss_newton
from kinefit.tracking.fusion_settings import FusionSettings
from kinefit.tracking.depth_measurement import DepthMeasurement, Surface
from kinefit.tracking.measurements import Measurement
from kinefit.tracking.prediction import Prediction, belief


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
        Share of what the sensors can see of a segment that agrees with them.
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


class FusionTracker:
    """Follows one body from frame to frame in whatever its sensors see.

    Parameters
    ----------
    body : Body, with surfaces where depth is to be used.
    rig : Rig of all cameras, depth cameras among them.
    rate : float [Hz] of the frames, about: a longer gap counts as frames dropped.
    accuracy : {sensor: standard deviation}, [m] of depth, clouds and markers, [px] of keypoints.
    """

    def __init__(
        self, body: Body, rig: Rig, *, rate: float = 30.0, accuracy: Mapping[str, float] | None = None,
        settings: FusionSettings | None = None,
    ) -> None:  # fmt: skip
        self.rig, self.rate = rig, rate
        self.settings = settings or FusionSettings()
        self.accuracy = dict(accuracy or {})
        self.dropped = 0
        self._time: float | None = None
        self._wear(body)

    def _wear(self, body: Body) -> None:
        """Take a body, new or changed."""
        s = self.settings
        self.body = body
        self.surface = Surface(body, s.samples) if body.surfaces else None
        self._prediction = Prediction(
            body, 1.0 / self.rate, angle_acceleration=s.angle_acceleration, root_acceleration=s.root_acceleration,
            memory=s.velocity_memory,
        )  # fmt: skip

    def start_at(self, state: BodyState) -> None:
        """Take a state as that of the last frame; its velocity is unknown."""
        self._prediction.start(state)

    def update(self, frames: Sequence[Frame]) -> FusionResult:
        """Track one step of time from what the sensors saw then."""
        time = float(np.mean([f.time for f in frames]))
        steps = 1 if self._time is None else max(round((time - self._time) * self.rate), 1)
        self.dropped += steps - 1
        self._time = time
        predicted, information = self._prediction.ahead(min(steps, 10))
        measurements = [self._measurement(f, predicted) for f in frames]
        state, iterations = self._fit(predicted, information, measurements)
        return self._finish(time, state, (predicted, information), measurements, iterations)

    def _measurement(self, frame: Frame, predicted: BodyState) -> Measurement:
        assert isinstance(frame, DepthFrame) and self.surface is not None
        sigma = self.accuracy.get(frame.sensor, 0.01)
        return DepthMeasurement(frame, self.rig[frame.sensor], self.surface, predicted, sigma, self.settings)

    def _rows(self, state: BodyState, held: tuple[BodyState, NDArray], measurements: list, bound: float) -> list:
        parts = [rows for m in measurements for rows in m.rows(state, bound)]
        tree = self.body.tree
        parts.append(belief(state, *held))
        finite = np.isfinite(tree.spread)
        index = np.flatnonzero(finite)
        parts.append(ParameterRows(6 + index, (tree.usual - state.angles)[index], 1.0 / tree.spread[index] ** 2))
        return parts

    def _fit(self, predicted: BodyState, information: NDArray, measurements: list) -> tuple[BodyState, int]:
        s, state, bound = self.settings, predicted, self.settings.far
        for iteration in range(1, s.iterations + 1):
            rows = self._rows(state, (predicted, information), measurements, bound)
            step = gauss_newton(self.body, state, rows, loss=s.loss)
            state = step.state
            if step.norm < s.tolerance and bound <= s.near:
                break
            bound = max(bound * s.shrink, s.near)
        return state, iteration

    def _finish(self, time, state, held, measurements, iterations) -> FusionResult:
        rows = self._rows(state, held, measurements, self.settings.near)
        eq = normal_equations(self.body, state, rows, loss=self.settings.loss)
        posterior = inverse(eq.matrix)
        self._prediction.correct(state, posterior)
        chart = off_the_limits(self.body.tree, state.angles)
        if chart is not None:
            self._prediction.change_chart(*chart)
        n = len(self.body.tree.segments)
        return FusionResult(
            time, state, np.sqrt(np.diag(posterior)), np.zeros((n, 3)), np.ones(n), np.zeros(n, bool), np.zeros(n, bool), iterations
        )
