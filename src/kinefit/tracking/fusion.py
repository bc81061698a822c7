"""The tracker of any mix of sensors, frame by frame: predict, correspond, solve, judge, recover."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from copy import copy
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.charts import off_the_limits
from kinefit.bodies.parts import carry_dofs, carry_state
from kinefit.errors import BodyError, KinefitError, ObservationError
from kinefit.geometry.camera import Rig
from kinefit.initialization.candidates import LEAP, dofs_of_limbs, find_limbs, find_starts
from kinefit.initialization.depth_search import Search
from kinefit.observations import Frame
from kinefit.sensors.background import Background
from kinefit.sensors.depth_image import DepthMeasurement
from kinefit.sensors.measurements import KeypointMeasurement, MarkerMeasurement, Measurement
from kinefit.sensors.point_cloud import CloudMeasurement
from kinefit.sensors.settings import TrackSettings
from kinefit.solvers.equations import inverse
from kinefit.tracking.fused_fit import FusedFit, FusionResult, Held
from kinefit.tracking.prediction import Prediction, forgetting

__all__ = ["FusionResult", "FusionTracker"]

_SPEED = 3.0  # [m/s] of a hand in a brisk wave; a limb found farther away than that must be the more certain


class FusionTracker:
    """Follows one body from frame to frame in whatever its sensors see.

    Parameters
    ----------
    body : Body, with surfaces where depth is to be used.
    rig : Rig of all cameras, depth cameras among them.
    rate : float [Hz] of the frames, about: a longer gap counts as frames dropped.
    accuracy : {sensor: standard deviation}
        [m] of depth, clouds and markers, [px] of keypoints, and of silhouettes as "silhouette CAMERA".
    up : (3,) upwards in the world, for a start with no pose given.
    on_body : depth cameras whose images show nothing but the body: no background is learnt.

    Attributes
    ----------
    dropped : int, frames that were missed so far, by their times.
    late : int, updates that came after a later one and were left out.
    """

    def __init__(
        self, body: Body, rig: Rig, *, rate: float = 30.0, accuracy: Mapping[str, float] | None = None,
        up: ArrayLike = (0.0, 1.0, 0.0), on_body: Collection[str] = (), settings: TrackSettings | None = None,
    ) -> None:  # fmt: skip
        if not 0.0 < rate < np.inf:
            raise ObservationError(f"frames at {rate} Hz", remedy="Give a positive rate.")
        self.rig, self.rate, self.up = rig, rate, np.asarray(up, float)
        self.settings = settings or TrackSettings()
        self.accuracy = dict(accuracy or {})
        bad = [f"{name}: {value}" for name, value in self.accuracy.items() if not 0.0 < value < np.inf]
        if bad:
            raise ObservationError(f"standard deviations of {', '.join(bad)}", remedy="Give positive ones.")
        self.dropped = self.late = 0
        self._last: FusionResult | None = None
        self._time: float | None = None
        self._sought = self._lost_since = -np.inf
        self._backgrounds: dict[str, Background | None] = dict.fromkeys(on_body)
        self._wear(body)

    def _wear(self, body: Body) -> None:
        s = self.settings
        self.body = body
        self._fit = FusedFit(body, self.rig, self.rate, self.accuracy, s, self._backgrounds)
        self._good = np.full(len(body.tree.segments), -np.inf)  # [s] when each segment was last where it was thought
        self._prediction = Prediction(
            body, 1.0 / self.rate, angle_acceleration=s.angle_acceleration, root_acceleration=s.root_acceleration,
            memory=s.velocity_memory,
        )  # fmt: skip

    @property
    def state(self) -> BodyState | None:
        """The last frame's, None before a start."""
        return self._prediction.state

    def know_background(self, sensor: str, depth: NDArray) -> None:
        """Tell what a depth camera sees when nobody is there: (H, W) [m], 0 where that is not known.

        Raises
        ------
        CalibrationError
            A camera that the rig does not have.
        ObservationError
            An image of another size.
        """
        camera = self.rig[sensor]
        if np.shape(depth) != camera.size[::-1]:
            problem = f"a background of shape {np.shape(depth)}, camera {sensor} has {camera.size}"
            raise ObservationError(problem, remedy="Give an image of this camera.")
        background = self._fit.background(camera)
        if background is not None:
            background.know(depth)

    def start_at(self, state: BodyState) -> None:
        """Take a state as that of the last frame; its velocity is unknown."""
        if len(state.angles) != len(self.body.tree.coordinates):
            problem = f"a state of {len(state.angles)} angles, the body has {len(self.body.tree.coordinates)}"
            raise BodyError(problem, remedy="Give a state of this body.")
        self._prediction.start(state)

    def backwards(self, state: BodyState) -> FusionTracker:
        """A tracker of the same body and sensors that knows the same background, for the time before a state."""
        out = FusionTracker(
            self.body, self.rig, rate=self.rate, accuracy=self.accuracy, up=self.up, settings=self.settings
        )
        out._backgrounds.update(self._backgrounds)
        out.start_at(state)
        return out

    def change_body(self, body: Body) -> None:
        """Go on with another size, another surface, a part more or less (`bodies.parts`); pose and speed are kept."""
        old, before = self.body, self._prediction
        self._wear(body)
        if before.state is not None:
            state = carry_state(before.state, old, body)
            std = carry_dofs(before.std, old, body, missing=np.inf)
            self._prediction.go_on(state, std, carry_dofs(before.velocity, old, body))
        self._last = None

    def update(self, frames: Sequence[Frame], time: float | None = None) -> FusionResult | None:
        """Track one step of time from what the sensors saw then.

        Parameters
        ----------
        frames : of any sensors; none where `time` is given: the body is then where it was thought to go.
        time : float [s], default the frames' mean.

        Returns
        -------
        FusionResult, or None until there is a start
            Frames that are older than the last ones are counted in `late`, and the last result is given again.

        Raises
        ------
        ObservationError
            No frame, or a time that is not finite; an image of another size than its camera's.
        CalibrationError, BodyError
            A camera, segment or keypoint set that is not known.
        """
        time = _time_of(frames, time)
        before = self._time, self._sought, self._lost_since, self.dropped, copy(self._prediction)
        try:
            return self._updated(frames, time)
        except KinefitError:  # as if they had never come
            self._time, self._sought, self._lost_since, self.dropped, self._prediction = before
            raise

    def _updated(self, frames: Sequence[Frame], time: float) -> FusionResult | None:
        steps = self._steps(time)
        if steps is None:
            return self._last
        result: FusionResult | None = None
        measurements: list[Measurement] = []
        if self._prediction.state is not None:
            held = self._prediction.ahead(steps)
            measurements = self._fit.measurements(frames, held[0])
            result, posterior = self._fit.run(time, held[0], held, measurements)
            self._take(result.state, posterior)
        result = self._recovered(time, frames, measurements, result)
        self._last = result
        if result is not None:
            for m in measurements:
                if isinstance(m, DepthMeasurement):
                    m.learn(result.state, not result.lost.any())
        return result

    def _steps(self, time: float) -> float | None:
        """Frames since the last update, which is remembered; None for one that came too late."""
        s, before = self.settings, self._time
        steps = 1.0 if before is None else (time - before) * self.rate
        if before is not None and -s.pause < time - before <= 0.0:
            self.late += 1
            return None
        self._time = time
        if before is not None and abs(time - before) > s.pause:
            self._sought = self._lost_since = -np.inf
            if self._prediction.state is not None:
                self._prediction.start(self._prediction.state)
            steps = 1.0 if steps < 0 else steps
        self.dropped += max(round(steps) - 1, 0)
        return min(steps, 10.0)

    def _take(self, state: BodyState, posterior: NDArray) -> None:
        """Go on from a fit that took its prediction into account."""
        self._prediction.correct(state, posterior)
        chart = off_the_limits(self.body.tree, state.angles)
        if chart is not None:
            self._prediction.change_chart(*chart)

    def _recovered(
        self, time: float, frames: Sequence[Frame], measurements: list[Measurement], result: FusionResult | None
    ) -> FusionResult | None:
        """What is lost for some time is sought, and taken where more speaks for it."""
        s = self.settings
        if result is not None:
            seek = result.lost | (~result.hidden & (result.segment_quality < s.doubtful))
            self._good[~seek] = time
            if not seek.any():
                self._lost_since = time
                return result
        waited = result is None or time - self._lost_since >= s.search_after
        if not s.search or not waited or time - self._sought < s.search_every - 0.25 / self.rate:
            return result
        self._sought = time
        if result is None or result.lost[0] or result.quality < s.poor:
            return self._started(time, frames, result)
        view = next((view for m in measurements if (view := m.view()) is not None), None)
        if view is None:
            return result
        search = Search(self.body, view, self.up, np.random.default_rng(0))
        free = dofs_of_limbs(self.body, seek)
        held = result.state, forgetting(inverse(np.diag(result.dof_std**2)), free)
        now = best = search.score.of(result.state) - LEAP * _against(result.state, measurements)
        for state, least in find_limbs(search, result.state, seek):
            found = self._fitted(time, frames, state, held)
            value = search.score.of(found.state) - LEAP * _against(found.state, measurements)
            surfaces = [m for m in measurements if isinstance(m, DepthMeasurement | CloudMeasurement)]
            seen = not (self._fit.judged(found.state, surfaces).hidden & seek).any()  # else it would hide, not be found
            if seen and value > max(best, now + least * self._leap(time, result, found, seek)):
                best, result, self._lost_since = value, found, time
                self._prediction.go_on(found.state, found.dof_std, np.where(free, 0.0, self._prediction.velocity))
        return result

    def _leap(self, time: float, old: FusionResult, new: FusionResult, seek: NDArray) -> float:
        """How much faster than usual a limb would have moved since it was last seen where it was, 1 at least."""
        elapsed = time - float(self._good[seek].min())
        points = self.body.landmarks
        gone = self.body.positions(new.state, points) - self.body.positions(old.state, points)
        return max(float(np.linalg.norm(gone, axis=1).max(initial=0.0)) / (_SPEED * elapsed), 1.0)

    def _started(self, time: float, frames: Sequence[Frame], result: FusionResult | None) -> FusionResult | None:
        for state in find_starts(self.body, self.rig, frames, self.up):
            found = self._fitted(time, frames, state, None)
            poor = found.lost[0] or found.quality < self.settings.poor
            if not poor and (result is None or _better(found, result)):
                result, self._lost_since = found, time
                self._prediction.start(found.state, found.dof_std)
        return result

    def _fitted(
        self, time: float, frames: Sequence[Frame], state: BodyState, held: Held | None
    ) -> FusionResult:
        return self._fit.run(time, state, held, self._fit.measurements(frames, state))[0]


def _against(state: BodyState, measurements: list[Measurement]) -> float:
    """How many keypoints and markers a state does not agree with; half for one that is ten deviations off."""
    points = [m for m in measurements if isinstance(m, KeypointMeasurement | MarkerMeasurement)]
    square = [m.square(state) for m in points]
    return sum(float(np.sum(1.0 - 100.0 / (s + 100.0))) for s in square)


def _better(new: FusionResult, old: FusionResult) -> bool:
    """Fewer segments are lost, or as many and more speaks for those that are seen."""
    lost = int(new.lost.sum()), int(old.lost.sum())
    return lost[0] < lost[1] or (lost[0] == lost[1] and new.quality > old.quality + 0.05)


def _time_of(frames: Sequence[Frame], time: float | None) -> float:
    for frame in frames:
        if not isinstance(frame, Frame):
            problem = f"a {type(frame).__name__} among the frames"
            raise ObservationError(problem, remedy=f"Give {', '.join(kind.__name__ for kind in get_args(Frame))}.")
    if time is None:
        time = float(np.mean([f.time for f in frames])) if len(frames) else np.nan
    if not np.isfinite(time):
        problem = "frames whose time is not finite" if len(frames) else "no frame"
        raise ObservationError(problem, remedy="Give what the sensors saw, each with its time in seconds.")
    return time
