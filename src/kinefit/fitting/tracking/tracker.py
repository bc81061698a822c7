"""The tracker of any mix of sensors, frame by frame: predict, match, solve, judge, recover."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from copy import copy
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import renamed
from kinefit.bodies import Body, BodyState
from kinefit.bodies.motion import Motion
from kinefit.bodies.parts import carry_dofs, carry_state
from kinefit.bodies.tree import off_the_limits
from kinefit.errors import BodyError, ObservationError, choices
from kinefit.fitting.frame.fit import Fitted, FrameFit
from kinefit.fitting.frame.prediction import Prediction
from kinefit.fitting.frame.results import FrameResult
from kinefit.fitting.frame.routing import Sensors, time_of
from kinefit.fitting.subject.subject import Subject
from kinefit.fitting.tracking.motions import Estimation, Session, axis_of, motion_of, up_vector
from kinefit.fitting.tracking.recovery import Recovery
from kinefit.geometry.camera import Rig
from kinefit.observations.arrays import is_number
from kinefit.sensors.base import Measurement, Sensor, named, of_kind
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.mobility import check_closed
from kinefit.solving.rows import AnyRows


class Tracker:
    """Follows one body from frame to frame in whatever its sensors see.

    Parameters
    ----------
    body : Body, with surfaces where depth or silhouettes are to be used.
    rig : Rig of all cameras, depth cameras among them; without cameras `Rig(())`.
    rate : float [Hz] of the frames, about: a longer gap counts as frames dropped.
    sigma : {sensor: standard deviation}
        [m] of depth, clouds, markers ("SENSOR MARKER" of one), [px] of keypoints, and of silhouettes as
        "silhouette CAMERA".
    up : vertical axis of the world ("z", "-y", ...) or (3,) upwards in it, for a start with no pose given.
    on_body : depth cameras whose images show nothing but the body: no background is learnt.
    settings : TrackSettings
    sensors : of one's own (`kinefit.sensors.base`); the built-in kinds need not be named.
    values : {sensor: {name: value}} of the sensors' own unknowns, as a subject fit estimated them.
    keep : whether results and measurements are kept, without whole images, for `motion`: some kB a frame.

    Attributes
    ----------
    dropped : int, frames that were missed so far, by their times.
    late : int, updates that came after a later one and were left out.
    """

    state_attributes = ("_time", "_seen", "dropped", "late")  # see `save_state`

    @renamed(accuracy="sigma")
    def __init__(
        self, body: Body, rig: Rig, *, rate: float = 30.0, sigma: Mapping[str, float] | None = None,
        up: str | ArrayLike = "z", on_body: Collection[str] = (), settings: TrackSettings | None = None,
        sensors: Sequence[Sensor] = (), values: Mapping[str, Mapping[str, float]] | None = None,
        keep: bool = False,
    ) -> None:  # fmt: skip
        of_kind(body, Body, "the body", 'Load it: load_body("humanoid").')
        of_kind(rig, Rig, "the rig", "Give a Rig, such as read_calibration returns; without cameras Rig(()).")
        of_kind(settings or TrackSettings(), TrackSettings, "settings", "Give TrackSettings(...), or leave it out.")
        of_kind(sigma or {}, Mapping, "sigma", 'Give {"cam01": 8.0}: a number for each sensor.', each=Real)
        of_kind(values or {}, Mapping, "values", 'Give {sensor: {name: value}}.', each=Mapping)
        of_kind(sensors, Sequence, "sensors", "Give a list of sensors.")
        of_kind(on_body, Collection, "on_body", "Give a list of names, even of one.")
        if not (is_number(rate) and 0.0 < rate < np.inf):
            raise ObservationError(f"rate is {rate} Hz", remedy="Give a positive rate.")
        self.rig, self.rate, self.up = rig, rate, up_vector(up)
        self.settings, self.values = settings or TrackSettings(), values or {}
        self.sensors = Sensors(rig, rate, sigma or {}, self.settings, sensors, tuple(on_body))
        unknown = [name for name in self.values if name not in {sensor.name for sensor in self.sensors.own}]
        if unknown:
            names = [sensor.name for sensor in self.sensors.own]
            raise ObservationError(choices("custom sensor", unknown[0], names), remedy="Leave it out of values.")
        self.others: tuple[Scene, ...] = ()
        self.dropped = self.late = 0
        self._last: FrameResult | None = None
        self._time: float | None = None
        self._direction = 1.0  # of time
        self._session = Session(rate) if keep else None
        self._wear(body)

    def _wear(self, body: Body) -> None:
        s = self.settings
        check_closed(body)
        self.body, self._seen = body, np.full(len(body.tree.coordinates), -np.inf)  # [s] when each was last observed
        self._fit = FrameFit(body, s)
        self._scene = Scene(
            body, body.default_state(np.eye(4)), self.rig, values=self.values, samples=s.samples,
            unknowns={sensor.name: sensor.unknowns for sensor in self.sensors.own},
        )  # fmt: skip
        self._recovery = Recovery(body, self.rig, self.up, s, self.rate)
        self._prediction = Prediction(
            body, 1.0 / self.rate, angle_acceleration=s.angle_acceleration, root_acceleration=s.root_acceleration,
            memory=s.velocity_memory,
        )  # fmt: skip

    @property
    def state(self) -> BodyState | None:
        """The last frame's, None before a start."""
        return self._prediction.state

    @property
    def sees_surfaces(self) -> bool:
        """Whether some sensor so far shows a person as a whole: searches in it take long."""
        return any(sensor.shows_person for sensor in self.sensors)

    @property
    def sigma(self) -> Mapping[str, float]:
        """Standard deviations as they were given, by sensor."""
        return self.sensors.sigma

    def know_background(self, sensor: str, depth: NDArray) -> None:
        """Set the empty scene of a depth camera: (H, W) [m], 0 where unknown.

        Raises
        ------
        CalibrationError
            A camera that the rig does not have.
        ObservationError
            An image of another size.
        """
        self.sensors.know_background(sensor, depth)

    def set_sigma(self, sensor: str, sigma: float) -> None:
        """Another standard deviation of a sensor from the next frame on, see `Sensors.set_sigma`."""
        self.sensors.set_sigma(sensor, sigma)

    def start_at(self, state: BodyState) -> None:
        """Take a state as that of the last frame; its velocity is unknown. BodyError for another body's."""
        of_kind(state, BodyState, "the state", "Give body.default_state(T_world_root), or a state of a Motion.")
        if len(state.angles) != len(self.body.tree.coordinates):
            problem = f"the state has {len(state.angles)} angles, the body {len(self.body.tree.coordinates)}"
            raise BodyError(problem, remedy="Give a state of this body.")
        self._prediction.start(state)
        self._recovery.started(state)
        self._seen[:] = -np.inf

    def start_over(self) -> None:
        """Forget where the body is: the next frames may show another person, somewhere else."""
        self._wear(self.body)
        self._last = None
        if self._session is not None:
            self._session.clear()

    def backwards(self, state: BodyState) -> Tracker:
        """A tracker of the same body and sensors that knows the same background, for the time before a state."""
        out = Tracker(
            self.body, self.rig, rate=self.rate, sigma=self.sigma, up=self.up, settings=self.settings,
            sensors=self.sensors.own, values=self.values,
        )  # fmt: skip
        out.sensors, out._direction = self.sensors.anew(), -1.0
        out.start_at(state)
        out._seen = self._seen.copy()
        return out

    def change_body(self, body: Body) -> None:
        """Go on with another size, another surface, a part more or less (`bodies.parts`); pose and speed are kept."""
        of_kind(body, Body, "the body", 'Load it: load_body("humanoid").')
        old, before, seen = self.body, self._prediction, np.concatenate([np.zeros(6), self._seen])
        self._wear(body)
        self._seen = carry_dofs(seen, old, body, missing=-np.inf)[6:]
        if before.state is not None:
            state = carry_state(before.state, old, body)
            std = carry_dofs(before.std, old, body, missing=np.inf)
            self._prediction.go_on(state, std, carry_dofs(before.velocity, old, body))
        self._last = None
        if self._session is not None:
            self._session.clear()

    def motion(self, *, smooth: bool = True, contacts: bool = False, name: str = "motion") -> Motion:
        """The session so far as a motion, from the first frame in which the body was found; steps dropped are bridged.

        After `change_body`, or where the clock was set back, it begins there. The body's lengths are taken for exact.

        Parameters
        ----------
        smooth, contacts : as of `track`
        name : of the motion

        Raises
        ------
        ObservationError
            A tracker that keeps nothing, or has found nothing; contacts without smoothing.
        """
        if self._session is None:
            raise ObservationError("this tracker stores no frames", remedy="Create it with keep=True.")
        if not len(self._session):
            remedy = "Call update until it returns a result, or give the first pose with start_at."
            raise ObservationError("the person was not found in this session", remedy=remedy)
        if contacts and not smooth:
            raise ObservationError("contacts=True needs smoothing", remedy="Leave out smooth=False.")
        frames = self._session.frames(self)
        subject, how = Subject.as_is(self.body), Estimation(smooth=smooth, contacts=contacts)
        more = {"frames": {"dropped": self.dropped, "late": self.late}}
        return motion_of(frames, subject, how, up=axis_of(self.up), name=name, more=more)

    def update(
        self, frames: Sequence[Any], time: float | None = None, *, others: Sequence[Scene] = (),
        guess: BodyState | None = None,
    ) -> FrameResult | None:  # fmt: skip
        """Track one step of time from what the sensors saw then.

        Parameters
        ----------
        frames : of any sensors, or measurements; none where `time` is given: the body is then where it was going.
        time : float [s], default the frames' mean.
        others : other bodies at this time, for sensors that must tell them apart; see `scene_of`.
        guess : where the body may be at this time; taken where more speaks for it.

        Returns
        -------
        FrameResult, or None until there is a start
            Frames that are older than the last ones are counted in `late`, and the last result is given again.

        Raises
        ------
        ObservationError
            No frame, or a time that is not finite, or farther from the frames' than `TrackSettings.pause`; an image of
            another size than its camera's; a sensor of one's own whose rows are none of this body.
        CalibrationError, BodyError
            A camera, segment or keypoint set that is not known.
        """
        time = time_of(frames, time, self.sensors)
        of_kind(others, Sequence, "others", "Give a list of scenes of `scene_of`.", each=Scene)
        kept = copy(self._prediction), self._last, self._seen.copy()
        before = self._time, self._recovery.clocks(), self.dropped, *kept
        learnt, self.others = self.sensors.learnt(), tuple(others)
        try:
            return self._updated(frames, time, guess)
        except BaseException:  # as if they had never come
            self._time, clocks, self.dropped, self._prediction, self._last, self._seen = before
            self._recovery.set_clocks(clocks)
            self.sensors.unlearn(learnt)
            raise
        finally:
            self.others = ()

    def _updated(self, frames: Sequence[Any], time: float, guess: BodyState | None) -> FrameResult | None:
        steps = self._steps(time)
        if steps is None:
            return self._last
        result: FrameResult | None = None
        measurements: list[Measurement] = []
        covariance: NDArray | None = None
        if self._prediction.state is not None:
            if not len(frames):
                self._prediction.halt()
            held = self._prediction.ahead(steps)
            scene, measurements = self._scene_of(frames, held[0], time)
            fitted = self._fit.run(scene, held, measurements, self._known(time))
            self._take(fitted, time)
            result, covariance = fitted.result, fitted.stated
        result = self._recovery.run(self, time, frames, measurements, result, guess)
        self._last = result
        if result is not None:
            moving = {"velocity": self.speed, "measurements": tuple(measurements), "others": self.others}
            scene = self._scene.at(result.state, time=time, covariance=covariance, **moving)
            self.sensors.check_channels(result.matched, scene)
            for m in measurements:
                sensor = self.sensors.of(m.sensor)
                if sensor is not None:
                    with named(m.sensor):
                        sensor.learn(m, scene, not result.lost.any())
            if self._session is not None:
                self._session.add(result, scene)
        return result

    def fitted(self, time: float, frames: Sequence[Any], state: BodyState, held: Any = None) -> Fitted:
        """What comes of a fit that begins at a state; nothing of it is remembered."""
        scene, measurements = self._scene_of(frames, state, time)
        return self._fit.run(scene, held, measurements, None if held is None else self._known(time))

    def between(self, time: float) -> FrameResult | None:
        """The body at a time [s] when no sensor looked, as it moved on; None until a start. Nothing is remembered."""
        if self._prediction.state is None or self._time is None:
            return None
        steps = self._direction * (time - self._time) * self.rate
        held = copy(self._prediction).ahead(min(steps, 10.0))
        return self.fitted(time, (), held[0], held).result

    def scene_of(self, state: BodyState, time: float = 0.0) -> Scene:
        """The tracker's body in a state."""
        return self._scene.at(state, time=time)

    def apart(self, scene: Scene) -> list[AnyRows]:
        """Rows that keep parts of the body from running into each other."""
        return self._fit.apart(scene)

    def _scene_of(self, frames: Sequence[Any], state: BodyState, time: float) -> tuple[Scene, list[Measurement]]:
        scene = self._scene.at(state, time=time, velocity=self.speed, others=self.others)
        measurements = self.sensors.measurements(frames, scene)
        return scene.at(state, measurements=tuple(measurements)), measurements

    def _steps(self, time: float) -> float | None:
        """Frames since the last update, which is remembered; None for one that came too late."""
        s, before = self.settings, self._time
        gone = 0.0 if before is None else self._direction * (time - before)  # [s]
        steps = 1.0 if before is None else gone * self.rate
        if before is not None and -s.pause < gone <= 0.0:
            self.late += 1
            return None
        self._time = time
        if before is not None and abs(gone) > s.pause:
            self._recovery.forget()
            if self._prediction.state is not None:
                self._prediction.start(self._prediction.state)
                self._seen[:] = -np.inf
            steps = 1.0 if steps < 0 else steps
        self.dropped += max(round(steps) - 1, 0)
        return min(steps, 10.0)

    def _known(self, time: float) -> NDArray:
        """(D,) bool: coordinates that were observed so shortly before a time [s] that they are predicted."""
        return np.abs(time - self._seen) <= self.settings.smooth_memory

    def _take(self, fitted: Fitted, time: float) -> None:
        """Go on from a fit that took its prediction into account."""
        state = fitted.result.state
        if fitted.released is None:
            self._prediction.correct(state, fitted.filtered)
        else:
            std = np.sqrt(np.maximum(np.diag(fitted.filtered), 0.0))
            self._prediction.go_on(state, std, np.where(fitted.released, 0.0, self._prediction.velocity))
        self._seen = np.where(fitted.seen, time, np.where(fitted.known, self._seen, -np.inf))
        chart = off_the_limits(self.body.tree, state.angles)
        if chart is not None:
            self._prediction.change_chart(*chart)

    def restart(self, result: FrameResult, velocity: NDArray | None = None) -> None:
        """Go on from a result that was found without a prediction; its velocity (n,) [m, rad] a frame, or unknown."""
        self._seen = np.where(np.isfinite(result.dof_std[6:]), result.time, -np.inf)
        if velocity is None:
            self._prediction.start(result.state, result.dof_std)
        else:
            self._prediction.go_on(result.state, result.dof_std, velocity)

    @property
    def velocity(self) -> NDArray:
        """(n,) [m, rad] a frame, of the last one."""
        return self._prediction.velocity

    @property
    def speed(self) -> NDArray:
        """(n,) [m/s, rad/s] of the last frame, forwards in time."""
        return self._direction * self.rate * self._prediction.velocity
