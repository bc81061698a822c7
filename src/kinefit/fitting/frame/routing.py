"""Route frames to their sensors, and turn them into measurements."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from kinefit import observations
from kinefit._records import restore_state, save_state
from kinefit.errors import ObservationError, choices
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.losses import SQUARED
from kinefit.observations import KEYPOINTS
from kinefit.observations.arrays import is_number
from kinefit.sensors.base import Matched, Measurement, Sensor, named, of_kind, rows_at
from kinefit.sensors.channels import ChannelNames
from kinefit.sensors.points.image_lines import ImageLineSensor
from kinefit.sensors.points.keypoints import KeypointSensor
from kinefit.sensors.points.lifted import LiftedSensor
from kinefit.sensors.points.markers import MarkerSensor
from kinefit.sensors.points.views import ViewBias
from kinefit.sensors.regions.regions import RegionSensor
from kinefit.sensors.regions.silhouette import SilhouetteSensor
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.sensors.surfaces.depth_image import DepthImageSensor
from kinefit.sensors.surfaces.depth_view import Background
from kinefit.sensors.surfaces.point_cloud import PointCloudSensor

MIN_SIGMA = 1e-5
"""[m] or [px] of a sensor: finer than any marker system. A weight is 1 / sigma²."""
MAX_SIGMA = 1e4
"""[m] or [px] of a sensor: wider than any image."""


class Sensors:
    """All sensors of a take by name: the user's own, and built-in ones, each made for its first frame.

    Parameters
    ----------
    rig : Rig
    rate : float [Hz] of the frames
    sigma : {sensor: standard deviation}
        [m] of depth, clouds and markers, of one marker as "SENSOR MARKER"; [px] of keypoints, of silhouettes as
        "silhouette CAMERA", of regions as "region CAMERA".
    settings : TrackSettings
    own : the user's own sensors
    on_body : depth cameras whose images show nothing but the body; no background is learnt for them

    Raises
    ------
    ObservationError
        Two sensors have one name, or one has none; a standard deviation is not positive.
    CalibrationError
        The rig lacks a camera of `on_body`.

    Attributes
    ----------
    stated : {depth camera: (H, W) [m]} depth of the empty scene, as given to `know_background`
    view_bias : of the keypoint detectors, see `KeypointSensor`; None for none
    """

    def __init__(
        self, rig: Rig, rate: float, sigma: Mapping[str, float], settings: TrackSettings, own: Sequence[Sensor] = (),
        on_body: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self.rig, self.rate, self.sigma, self.settings = rig, rate, dict(sigma), settings
        bad = [f"{name}: {value}" for name, value in self.sigma.items() if not 0.0 < value < np.inf]
        if bad:
            raise ObservationError(f"sigma is not positive: {', '.join(bad)}", remedy="Give positive values.")
        self._sensors: dict[str, Sensor] = {}
        for sensor in own:
            of_kind(sensor, Sensor, "a custom sensor", "Derive it from Sensor, and give it a name.")
            if not isinstance(getattr(sensor, "name", None), str) or not sensor.name:
                problem = f"the custom sensor {type(sensor).__name__} has no name"
                raise ObservationError(problem, remedy="Set name to the value of `sensor` in its frames.")
            if sensor.name in self._sensors:
                raise ObservationError(f"two sensors are named '{sensor.name}'", remedy="Give each its own name.")
            self._sensors[sensor.name] = sensor
        self._own = frozenset(self._sensors)
        self._backgrounds: dict[str, Background | None] = {rig[name].name: None for name in on_body}
        self.stated: dict[str, NDArray] = {}
        self.view_bias: ViewBias | None = None
        self._made_of: dict[str, tuple[str, str]] = {}  # {built-in sensor: kind and sensor name of its frames}
        self._channels = ChannelNames()
        self._makers: dict[type, Callable[[str], Sensor]] = {
            observations.KeypointFrame: self._keypoints, observations.MarkerFrame: self._markers,
            observations.DepthFrame: self._depth, observations.PointCloud: self._cloud,
            observations.SilhouetteFrame: self._silhouette, observations.LineFrame: self._lines,
            observations.ClickFrame: self._clicks, observations.ColourFrame: self._region,
            observations.LiftedFrame: self._lifted,
        }  # fmt: skip

    def __iter__(self) -> Any:
        return iter(self._sensors.values())

    def of(self, name: str) -> Sensor | None:
        """The sensor of this name; None if there is none, as for a measurement given directly."""
        return self._sensors.get(name)

    def measurements(self, frames: Sequence[Any], scene: Scene, *, points: bool = False) -> list[Measurement]:
        """Measurements of one time from the frames of all sensors.

        Parameters
        ----------
        frames : of one time; a `Measurement` passes as it is
        points : only of sensors that measure named points

        Raises
        ------
        ObservationError
            A sensor's `prepare` returns no measurement, or one without its name or without a time.
        """
        out, frames_of = [], dict[str, list[Any]]()
        routed = [(None if _is_prepared(f) else self._of_frame(f), f) for f in frames]
        for sensor, frame in routed:
            frames_of.setdefault("" if sensor is None else sensor.name, []).append(frame)
        for sensor, frame in routed:
            with named(frame.sensor):
                if sensor is None:
                    out.append(_checked(frame, frame.sensor))
                elif sensor.places_points or not points:
                    same = frames_of[sensor.name]
                    if not sensor.together:
                        out.append(_checked(sensor.prepare(frame, scene), sensor.name))
                    elif frame is same[0]:
                        out.append(_checked(sensor.prepare(same, scene), sensor.name))
        return out

    def check_channels(self, matched: Sequence[Matched], scene: Scene) -> None:
        """Check that the user's own sensors keep to their channels, and that no two use one name.

        Raises
        ------
        ObservationError
            They do not.
        """
        self._channels.check_step(matched)
        for m in matched:
            if m.of_points and (m.sensor in self._own or m.sensor not in self._sensors):
                self._channels.channels(m, rows_at(m, scene))

    @property
    def own(self) -> tuple[Sensor, ...]:
        """The user's own sensors, ordered by name."""
        return tuple(self._sensors[name] for name in sorted(self._own))

    def set_sigma(self, name: str, sigma: float) -> None:
        """Set a standard deviation from the next frame on: [px] of a camera's keypoints, [m] of depth and markers.

        Raises
        ------
        ObservationError
            `sigma` is no number from `MIN_SIGMA` to `MAX_SIGMA`; the sensor is the user's own and sets its own.
        """
        if not is_number(sigma) or not MIN_SIGMA <= sigma <= MAX_SIGMA or isinstance(sigma, bool):
            remedy = f"Give a number from {MIN_SIGMA:g} to {MAX_SIGMA:g}, in metres or pixels."
            raise ObservationError(f"sigma of '{name}' is {sigma}", remedy=remedy)
        if name in self._own:
            raise ObservationError(f"'{name}' is a custom sensor", remedy="Change sigma in the sensor itself.")
        self.sigma[name] = float(sigma)
        # made again for its next frame; a camera's learnt background stays
        for sensor in (KEYPOINTS, name):
            self._sensors.pop(sensor, None)

    def learnt(self) -> list[dict[str, Any]]:
        """State of the user's own sensors, for `unlearn`."""
        return [dict(vars(sensor)) for sensor in self.own]

    def unlearn(self, before: Sequence[Mapping[str, Any]]) -> None:
        """Set the user's own sensors back to an earlier state, from `learnt`."""
        for sensor, known in zip(self.own, before, strict=True):
            vars(sensor).clear()
            vars(sensor).update(known)

    @property
    def keypoints(self) -> KeypointSensor:
        """The sensor of the keypoint detectors of all cameras."""
        return cast(KeypointSensor, self._made(KEYPOINTS, observations.KeypointFrame, KEYPOINTS))

    def background(self, camera: Camera) -> Background | None:
        """Background of a depth camera; None where none is to be learnt."""
        if camera.name not in self._backgrounds:
            sigma = self.sigma.get(camera.name, self.settings.depth)
            wait = self.settings.background * self.rate
            still = np.isfinite(wait)
            self._backgrounds[camera.name] = Background(camera, sigma, max(round(wait), 2)) if still else None
        return self._backgrounds[camera.name]

    def know_background(self, sensor: str, depth: NDArray) -> None:
        """Set the depth (H, W) [m] of a camera's empty scene, 0 where it is unknown.

        Raises
        ------
        ObservationError
            The image has another size than the camera.
        CalibrationError
            The rig has no such camera.
        """
        camera = self.rig[sensor]
        if np.shape(depth) != camera.size[::-1]:
            problem = f"the background has shape {np.shape(depth)}, images of {sensor} have {camera.size[::-1]}"
            raise ObservationError(problem, remedy="Give a depth image of this camera.")
        background = self.background(camera)
        if background is not None:
            background.know(depth)
            self.stated[camera.name] = np.asarray(depth)

    def anew(self) -> Sensors:
        """Sensors for another run over the take, with the same backgrounds and keypoint layouts."""
        out = Sensors(self.rig, self.rate, self.sigma, self.settings, self.own)
        out._backgrounds, out.stated, out.view_bias = self._backgrounds, self.stated, self.view_bias
        out._sensors[KEYPOINTS] = self.keypoints
        return out

    def save_state(self) -> dict[str, Any]:
        """State of all sensors and backgrounds, for `restore_state`."""
        sensors = {name: (self._made_of.get(name), save_state(one)) for name, one in self._sensors.items()}
        backgrounds = {name: save_state(one) for name, one in self._backgrounds.items() if one is not None}
        return {"sensors": sensors, "backgrounds": backgrounds}

    def restore_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `save_state`; built-in sensors that it names are made first."""
        makers = {kind.__name__: make for kind, make in self._makers.items()}
        for name, learnt in state["backgrounds"].items():
            restore_state(self.background(self.rig[name]), learnt)
        for name, (made_of, learnt) in state["sensors"].items():
            if made_of is not None:
                self._made_of[name], (kind, sensor) = made_of, made_of
                self._sensors[name] = makers[kind](sensor)
            restore_state(self._sensors[name], learnt)

    def _of_frame(self, frame: Any) -> Sensor:
        own = self._sensors[frame.sensor] if frame.sensor in self._own else None
        return own or self._made(observations.sensor_of(frame), type(frame), frame.sensor)

    def _made(self, name: str, kind: type, of: str) -> Sensor:
        """The built-in sensor of a name, made on first use."""
        if name not in self._sensors:
            self._sensors[name] = self._makers[kind](of)
            self._made_of[name] = kind.__name__, of
        return self._sensors[name]

    def _keypoints(self, name: str) -> KeypointSensor:
        s = self.settings
        return KeypointSensor(self.rig, self.sigma, s.pixel, s.loss, s.near, self.view_bias)

    def _markers(self, name: str) -> MarkerSensor:
        s = self.settings
        each = {key.removeprefix(f"{name} "): v for key, v in self.sigma.items() if key.startswith(f"{name} ")}
        return MarkerSensor(name, self.sigma.get(name, s.marker), s.marker_loss, s.near, each)

    def _depth(self, name: str) -> DepthImageSensor:
        camera, s = self.rig[name], self.settings
        return DepthImageSensor(name, camera, self.sigma.get(name, s.depth), s, self.background(camera))

    def _cloud(self, name: str) -> PointCloudSensor:
        camera = self.rig[name] if name in self.rig else None
        return PointCloudSensor(name, self.sigma.get(name, self.settings.depth), self.settings, camera)

    def _lines(self, name: str) -> ImageLineSensor:
        s, own = self.settings, f"lines {name}"
        return ImageLineSensor(own, self.sigma.get(own, s.line), s.loss, s.near)

    def _clicks(self, name: str) -> ImageLineSensor:
        own = f"clicks {name}"
        return ImageLineSensor(own, self.sigma.get(own, self.settings.line), SQUARED, self.settings.near)

    def _region(self, name: str) -> RegionSensor:
        return RegionSensor(self.rig[name], self.sigma.get(f"region {name}"), self.settings)

    def _lifted(self, name: str) -> LiftedSensor:
        return LiftedSensor(name, self.sigma.get(f"lifted {name}", self.settings.lifted))

    def _silhouette(self, name: str) -> SilhouetteSensor:
        sigma = self.sigma.get(f"silhouette {name}", self.settings.silhouette)
        return SilhouetteSensor(self.rig[name], sigma, self.settings)


def _is_prepared(frame: Any) -> bool:
    return isinstance(frame, Measurement)


def _checked(m: Any, sensor: str) -> Measurement:
    remedy = "It must return a Measurement with the name of its `sensor`."
    of_kind(m, Measurement, f"the result of `prepare` of sensor '{sensor}'", remedy)
    if getattr(m, "sensor", None) != sensor:
        raise ObservationError(f"`prepare` of sensor '{sensor}' returned another sensor's measurement", remedy=remedy)
    if not np.isfinite(getattr(m, "time", np.nan)):
        raise ObservationError(f"a measurement of sensor '{sensor}' has no time", remedy="Set time, in seconds.")
    return m


def time_of(frames: Sequence[Any], time: float | None, own: Sensors) -> float:
    """Time [s] of one step: as given, or the frames' mean.

    Raises
    ------
    ObservationError
        No frame, or a time that is not finite; what is no frame; a sensor that is not known; a frame farther from the
        step than `TrackSettings.pause`.
    """
    names = [sensor.name for sensor in own]
    if isinstance(frames, str) or not isinstance(frames, Sequence):
        problem = f"frames is a {type(frames).__name__}, not a list"
        raise ObservationError(problem, remedy="Give a list, even of one frame: tracker.update([frame]).")
    if time is not None and not is_number(time):
        raise ObservationError(f"time is a {type(time).__name__}", remedy="Give seconds.")
    for frame in frames:
        if type(frame) in own._makers:
            continue
        if not is_number(getattr(frame, "time", 0.0)):
            raise ObservationError(f"the time of a frame is a {type(frame.time).__name__}", remedy="Give seconds.")
        if _is_prepared(frame):
            continue
        if not isinstance(getattr(frame, "sensor", None), str):
            kinds = ", ".join(kind.__name__ for kind in own._makers)
            problem = f"a {type(frame).__name__} is not a frame"
            raise ObservationError(problem, remedy=f"Give {kinds}, a Measurement, or a frame of a custom sensor.")
        if frame.sensor not in own._own:
            remedy = "Correct its name, or give the custom sensor to the tracker: sensors=[...]."
            raise ObservationError(choices("sensor", frame.sensor, names), remedy=remedy)
    if time is None:
        time = float(np.mean([f.time for f in frames])) if len(frames) else np.nan
    if not np.isfinite(time):
        problem = "the time of the frames is not finite" if len(frames) else "no frames"
        raise ObservationError(problem, remedy="Give frames of sensors, each with its time in seconds; or time.")
    for frame in frames:  # beyond a pause no velocity is known that would take the body from one time to the other
        own_time = getattr(frame, "time", time)
        if not abs(own_time - time) <= own.settings.pause:
            problem = f"a frame of sensor '{frame.sensor}' is at {own_time:.3f} s, its step at {time:.3f} s"
            raise ObservationError(problem, remedy="Give times of all sensors and steps on one clock.")
    return time
