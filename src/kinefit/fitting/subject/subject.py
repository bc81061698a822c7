"""Records of a fitted person: `Subject`, `SubjectFit`, and combinations of parameters left unmeasured.

Parameters of cameras and sensors: extrinsics, frames and clocks, and a sensor's own unknowns.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.fitting.subject.parameters import Parameters, World, place_spread, with_slices
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.sensors.base import Sensor, Unknown, of_kind
from kinefit.sensors.displaced import AXES, CLOCK
from kinefit.sensors.points.views import ViewBias
from kinefit.sensors.settings import CameraErrors
from kinefit.solving.bundle.border import Prior
from kinefit.solving.equations import inverse
from kinefit.solving.rows import Rows

OUTLIER_SIGMAS = 3.0
"""Standard deviations of a camera's calibration: one of 24 numbers is farther off in 6 % of takes."""

_MIN_WRONG_FACTOR = 2.0  # estimated over stated standard deviations of a camera: above it the calibration is wrong
_ROUNDS = 30  # of alternating spreads and moves; the slowest change by less than a hundredth from then on
_GAUGE_FACTOR = 1e4  # of information of the cameras' common motion over that of single cameras, where it is a gauge


@dataclass(frozen=True, eq=False)
class CameraExtrinsics(Parameters):
    """Extrinsics of cameras: six parameters each, the twist (v, ω) [m, rad] of the pose in the camera's own frame.

    No measurement of cameras observes a common motion of cameras and bodies. So one camera is the gauge and stays, or
    none if other sensors, such as markers, measure in the world.

    Parameters
    ----------
    rig : Rig, at zero twists
    held : name of the camera that stays; None if other sensors constrain the world
    std : (2,) standard deviations of v [m] and ω [rad]
    cameras : names of the cameras that move, besides `held`; default: all
    factors : (C,) for each camera that moves, on its standard deviations; default: 1, see `with_errors_of`
    calibrated : Rig, the prior mean; default: `rig`
    own_world : bool, whether the mean motion of all cameras is the gauge: nothing else measures in the world

    Raises
    ------
    ObservationError
        A standard deviation is not above 0.
    CalibrationError
        The rig lacks a camera.
    """

    rig: Rig
    held: str | None
    std: tuple[float, float] = (0.02, 0.01)
    cameras: tuple[str, ...] | None = None
    factors: NDArray | None = None
    calibrated: Rig | None = None
    own_world: bool = False

    def __post_init__(self) -> None:
        for name in (*(self.cameras or ()), *(() if self.held is None else (self.held,))):
            self.rig.index(name)
        if not all(std > 0 for std in self.std):
            raise ObservationError(f"std is {self.std}", remedy="Give values above 0, in metres and radians.")

    @classmethod
    def of(
        cls, errors: CameraErrors, rig: Rig, cameras: tuple[str, ...], factors: NDArray | None = None,
        calibrated: Rig | None = None,
    ) -> CameraExtrinsics:  # fmt: skip
        """Parameters of cameras whose calibration has these errors; none of them is the gauge.

        Parameters
        ----------
        errors : standard deviations of position [m] and direction [rad]
        cameras : names of the C cameras that move
        factors : (C,) on the standard deviations, see `with_errors_of`
        calibrated : Rig, the prior mean; default: `rig`
        """
        return cls(rig, None, (errors.position, errors.direction), cameras, factors, calibrated, errors.own_world)

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the cameras that move."""
        moving = self.rig.names if self.cameras is None else self.cameras
        return tuple(name for name in moving if name != self.held)

    @property
    def names(self) -> tuple[str, ...]:
        """(6 C,) names."""
        return tuple(f"{camera} {axis}" for camera in self.free for axis in ("tx", "ty", "tz", "rx", "ry", "rz"))

    @property
    def mean(self) -> NDArray:
        """(6 C,) [m, rad] prior mean: the twists to the calibrated poses."""
        return np.zeros(len(self.names)) if self.calibrated is None else self.values_of(self.calibrated)

    @property
    def information(self) -> NDArray:
        """(6 C, 6 C) prior information."""
        own = np.diag(self.spreads.ravel() ** -2.0)
        if not (self.own_world and self.free):
            return own
        joint = own @ np.concatenate([se3.adjoint(self.rig[name].T_camera_world) for name in self.free])
        common = joint.T @ (joint / np.diag(own)[:, None])
        return own + _GAUGE_FACTOR * joint @ np.linalg.solve(common, joint.T)

    @property
    def spreads(self) -> NDArray:
        """(C, 6) [m, rad] prior standard deviation of each parameter."""
        return self._times[:, None] * np.repeat(self.std, 3)

    @property
    def _times(self) -> NDArray:
        return np.ones(len(self.free)) if self.factors is None else np.asarray(self.factors, float)

    def tighter(self, share: float) -> CameraExtrinsics:
        """The same cameras with standard deviations multiplied by `share`, a number above 0."""
        return replace(self, factors=share * self._times)

    def with_errors_of(self, own: slice, moved: NDArray, information: NDArray, prior: NDArray) -> CameraExtrinsics:
        """The same cameras with standard deviations estimated from a fit.

        One factor is estimated for all cameras, and one for each camera with the common factor as prior. A camera far
        more off than the others does not count for the common factor. See `place_spread`.

        Parameters
        ----------
        own : slice of these cameras' parameters among the fit's p
        moved : (p,) estimates minus prior means
        information, prior : (p, p) of the sensors, and of the prior of that fit
        """
        out, prior, pull = self, prior.copy(), (information + prior) @ moved
        for _ in range(_ROUNDS):
            prior[own, own] = out.information
            covariance = inverse(prior + information)
            out = out._with_spreads_of((covariance @ pull)[own], np.diag(covariance)[own])
        return out

    def _with_spreads_of(self, moved: NDArray, variance: NDArray) -> CameraExtrinsics:
        """One round: factors from mean and variance (6 C,) of the cameras with the present standard deviations."""
        stated = np.repeat(self.std, 3)
        m, v, s = moved.reshape(-1, 6) / stated, variance.reshape(-1, 6) / stated**2, self.spreads / stated

        def spread(cameras: Any, believed: float) -> float:
            return place_spread(m[cameras], v[cameras], s[cameras], believed)

        each = np.array([spread(c, 1.0) for c in range(len(m))])
        common = spread(each <= OUTLIER_SIGMAS * max(float(np.median(each)), 1.0), 1.0)
        return replace(self, factors=np.array([spread(c, common) for c in range(len(m))]))

    @property
    def wrong(self) -> bool:
        """Whether a camera's calibration is wrong; always False for two cameras, where it could be either of them."""
        return len(self.free) > 2 and float(self._times.max()) > _MIN_WRONG_FACTOR

    def apply(self, world: World, values: NDArray) -> World:
        """The world with cameras moved by twists (6 C,) [m, rad]."""
        twist = dict(zip(self.free, np.asarray(values, float).reshape(-1, 6)))
        return replace(world, rig=moved_rig(world.rig, twist))

    def values_of(self, rig: Rig) -> NDArray:
        """(6 C,) [m, rad] twists from `self.rig` to the poses in another rig."""
        moves = [rig[name].T_camera_world @ se3.inverse(self.rig[name].T_camera_world) for name in self.free]
        return np.concatenate([np.zeros(0), *(se3.log(T) for T in moves)])

    def columns(self, rows: Rows, rig: Rig, camera: NDArray) -> NDArray:
        """(N, 6 C) whitened derivatives of rows by the poses of the cameras that measured them.

        Parameters
        ----------
        rig : Rig, near the prior's
        camera : (N,) number in the rig of each row's camera; empty if the rows come from no camera
        """
        out = np.zeros((len(rows), 6 * len(self.free)))
        if not len(camera):
            return out
        T = np.array([c.T_camera_world for c in rig])[camera]
        x, turned = se3.apply(T, rows.data[:3].T), T[:, :3, :3] @ (np.sqrt(rows.data[7]) * rows.data[3:6]).T[..., None]
        J = np.concatenate([turned[..., 0], np.cross(x, turned[..., 0])], axis=1)
        for k, name in enumerate(self.free):
            own = camera == rig.index(name)
            out[own, 6 * k : 6 * k + 6] = J[own]
        return out


def same_cameras(a: Rig, b: Rig) -> bool:
    """Whether two rigs have the same cameras with the same poses."""
    return a.names == b.names and all(np.array_equal(c.T_camera_world, d.T_camera_world) for c, d in zip(a, b))


def moved_rig(rig: Rig, twists: Mapping[str, ArrayLike]) -> Rig:
    """The rig with some cameras moved: {camera: twist (6,) (v, ω) [m, rad] in the camera's own frame}."""
    return Rig(tuple(
        c.with_pose(se3.exp(np.asarray(twists[c.name], float)) @ c.T_camera_world) if c.name in twists else c
        for c in rig
    ))  # fmt: skip


@dataclass(frozen=True, eq=False)
class SensorFrames(Parameters):
    """Pose of a sensor's frame in the world and its clock offset, of `Displaced` measurements: seven parameters each.

    Other sensors must constrain the world, such as keypoints of calibrated cameras.

    Parameters
    ----------
    sensors : names of S sensors
    std : (3,) standard deviations of a frame's translation [m], its rotation [rad] and its clock offset [s]
    arms : {sensor: (3,) [m]} from the centre of the frame's rotation to its origin; default: zero

    Raises
    ------
    ObservationError
        A standard deviation is not above 0.
    """

    sensors: tuple[str, ...]
    std: tuple[float, float, float] = (0.1, 0.087, 0.02)
    arms: Mapping[str, NDArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not all(std > 0 for std in self.std):
            raise ObservationError(f"std is {self.std}", remedy="Give values above 0, in metres, radians and seconds.")

    @property
    def names(self) -> tuple[str, ...]:
        """(7 S,) names."""
        return tuple(f"{sensor} {what}" for sensor in self.sensors for what in (*AXES, CLOCK))

    @property
    def information(self) -> NDArray:
        """(7 S, 7 S) prior information."""
        out = np.zeros((len(self.names), len(self.names)))
        for k, sensor in enumerate(self.sensors):
            A = np.eye(7)
            A[:3, 3:6] = -se3.hat(self.arms.get(sensor, np.zeros(3)))  # shift of the origin
            out[7 * k : 7 * k + 7, 7 * k : 7 * k + 7] = A.T @ np.diag(np.repeat(self.std, (3, 3, 1)) ** -2.0) @ A
        return out

    def apply(self, world: World, values: NDArray) -> World:
        """The world with sensors' frames and clocks of these values (7 S,) [m, rad, s]."""
        own = np.asarray(values, float).reshape(-1, 7)
        frames = {s: dict(zip((*AXES, CLOCK), row.tolist())) for s, row in zip(self.sensors, own)}
        return replace(world, values={**world.values, **frames})


@dataclass(frozen=True, eq=False)
class OwnUnknowns(Parameters):
    """Unknowns of sensors, such as a rope's length or a clock's delay: `Sensor.unknowns`.

    Parameters
    ----------
    unknowns : {sensor: {name: Unknown}}

    Raises
    ------
    ObservationError
        `unknowns` is no mapping; a mean is not finite; a standard deviation is not positive.
    """

    unknowns: Mapping[str, Mapping[str, Unknown]]

    def __post_init__(self) -> None:
        of_kind(self.unknowns, Mapping, "unknowns of sensors", "Give {sensor: {name: Unknown}}, as `of` does.")
        for sensor, own in self.unknowns.items():
            for name, unknown in own.items():
                if not (np.isfinite(unknown.mean) and 0.0 < unknown.std < np.inf):
                    problem = f"unknown '{name}' of sensor '{sensor}' is {unknown.mean} ± {unknown.std}"
                    raise ObservationError(problem, remedy="Give a finite mean and a standard deviation above 0.")

    @classmethod
    def of(cls, sensors: Iterable[Sensor]) -> OwnUnknowns:
        """Unknowns of all sensors that have some."""
        return cls({s.name: dict(s.unknowns) for s in sensors if s.unknowns})

    @property
    def _each(self) -> list[tuple[str, str, Unknown]]:
        return [(sensor, name, u) for sensor, own in self.unknowns.items() for name, u in own.items()]

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) names."""
        return tuple(f"{sensor} {name}" for sensor, name, _ in self._each)

    @property
    def mean(self) -> NDArray:
        """(p,) prior mean, each in its own unit."""
        return np.array([u.mean for _, _, u in self._each])

    @property
    def information(self) -> NDArray:
        """(p, p) prior information."""
        return np.diag([u.std**-2 for _, _, u in self._each])

    @property
    def step(self) -> NDArray:
        """(p,) steps of finite differences: a thousandth of each standard deviation."""
        return np.array([1e-3 * u.std for _, _, u in self._each])

    def apply(self, world: World, values: NDArray) -> World:
        """The world with these values (p,) of the unknowns."""
        own = {sensor: {**world.values.get(sensor, {}), **new} for sensor, new in self.values(values).items()}
        return replace(world, values={**world.values, **own})

    def values(self, values: NDArray) -> dict[str, dict[str, float]]:
        """{sensor: {name: value}} of values (p,)."""
        each = iter(np.asarray(values, float).tolist())
        return {sensor: {name: next(each) for name in own} for sensor, own in self.unknowns.items()}


MIN_MEASURED_SHARE = 0.1
"""Share of the prior's variance that data must explain for a direction to count as measured."""

Progress = Callable[[str, int, int], None]
"""Called with the name of the work, the number of steps done and the number of all steps."""


@dataclass(frozen=True, eq=False)
class Unmeasured:
    """A combination of parameters that the prior alone constrains.

    Parameters
    ----------
    direction : (p,) unit vector, in prior standard deviations
    share : of the prior's variance along it that data explain, below `MIN_MEASURED_SHARE`
    names : of its largest parameters, the largest first
    """

    direction: NDArray
    share: float
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SubjectFit:
    """Fitted person, cameras and sensors.

    Parameters
    ----------
    body, rig, values : the fitted world, see `World`
    names, mean : (p,) names and estimates of the parameters
    covariance : (p, p) posterior with the poses marginalised, inflated by an excess above 1
    states : K fitted poses
    information : (p, p) of the sensors without the prior, deflated by an excess above 1
    prior : Prior
    excess : {sensor: factor} by which the variance of all its frames together exceeds that of its rows, see
        `parameters.excess`
    cost : float
    rounds : of match and solve
    parameters : kinds of parameters
    prior_world : the world to which they apply
    """

    body: Body
    rig: Rig
    values: Mapping[str, Mapping[str, float]]
    names: tuple[str, ...]
    mean: NDArray
    covariance: NDArray
    states: tuple[BodyState, ...]
    information: NDArray
    prior: Prior
    excess: Mapping[str, float]
    cost: float
    rounds: int
    parameters: tuple[Parameters, ...]
    prior_world: World

    @cached_property
    def unmeasured(self) -> tuple[Unmeasured, ...]:
        """Directions along which data explain less than a tenth of the prior's variance, the least measured first."""
        root = np.linalg.cholesky(inverse(self.prior.information))
        values, vectors = np.linalg.eigh(root.T @ self.information @ root)
        out = []
        for value, vector in zip(values, vectors.T):
            share = max(float(value), 0.0) / (1.0 + max(float(value), 0.0))
            if share < MIN_MEASURED_SHARE:
                moved = np.abs(root @ vector) / np.sqrt(np.diag(root @ root.T))
                largest = [k for k in np.argsort(-moved) if moved[k] > 0.3 * moved.max()]
                out.append(Unmeasured(vector, share, tuple(self.names[k] for k in largest)))
        return tuple(out)

    @property
    def std(self) -> NDArray:
        """(p,) posterior standard deviation of each parameter."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def kinds(self) -> list[tuple[Parameters, slice]]:
        """Each kind of parameters, and its slice of all p."""
        return with_slices(self.parameters)

    def record(self) -> dict[str, list[float]]:
        """{parameter: [estimate, standard deviation]}, each in its own unit."""
        each = zip(self.names, self.mean, self.std)
        return {name: [round(float(m), 4), round(float(s), 4)] for name, m, s in each}

    @property
    def cameras(self) -> CameraExtrinsics | None:
        """The parameters of cameras; None if the fit had none."""
        return next((p for p in self.parameters if isinstance(p, CameraExtrinsics)), None)

    def value(self, name: str) -> tuple[float, float]:
        """Estimate and standard deviation of the parameter of this name, in its own unit.

        Raises
        ------
        ObservationError
            No such parameter.
        """
        if name not in self.names:
            raise ObservationError(f"no parameter '{name}' was fitted", remedy=f"Fitted are: {', '.join(self.names)}.")
        k = self.names.index(name)
        return float(self.mean[k]), float(self.std[k])


@dataclass(frozen=True, eq=False)
class Subject:
    """A body fitted to a person: its lengths and the landmark offsets of the detectors' keypoints.

    Parameters
    ----------
    body : Body, fitted
    scales : (G,) lengths over those of the generic body
    fit : the keypoint fit; None for a given body
    covariance : (p, p) posterior of the fit's parameters, logarithms of the scales first; None for a given body
    length_share : (G,) standard deviation of each scale over the scale, if other sensors determined it
    sets : keypoint sets that the fit used
    view_bias : the detectors' bias by direction of view
    frames : numbers of the frames whose poses are in `fit`
    """

    body: Body
    scales: NDArray
    fit: SubjectFit | None = None
    covariance: NDArray | None = None
    length_share: NDArray | None = None
    sets: tuple[str, ...] = ()
    view_bias: ViewBias | None = None
    frames: tuple[int, ...] = ()

    @classmethod
    def as_is(cls, body: Body) -> Subject:
        """The subject of a body that needs no fit: scales of 1."""
        return cls(body, np.ones(len(body.scale_groups)))

    @property
    def cameras(self) -> CameraExtrinsics | None:
        """The parameters of cameras; None if there is no fit, or it had none."""
        return None if self.fit is None else self.fit.cameras

    @property
    def camera_errors(self) -> dict[str, NDArray]:
        """{camera: (6,) [m, rad] twist} from calibrated to fitted pose, if the calibration is wrong; else empty."""
        cameras = self.cameras
        if self.fit is None or cameras is None or not cameras.wrong:
            return {}
        twists = self.fit.mean[-len(cameras.names) :].reshape(-1, 6)
        return dict(zip(cameras.free, twists)) if np.any(np.abs(twists) > np.repeat(cameras.std, 3)) else {}

    @property
    def length_std(self) -> dict[str, float]:
        """{"thigh_l-shank_l": [m]} standard deviation of each length from one segment's joint to the next's."""
        share = self.length_share
        if self.covariance is not None:
            share = np.sqrt(np.diag(self.covariance)[: len(self.scales)])
        if share is None:
            return {}
        share = np.where(self.body.gear_scale, 0.0, share)
        tree = self.body.tree
        lengths = np.linalg.norm(tree.offsets, axis=1)
        return {
            f"{tree.segments[p]}-{tree.segments[s]}": float(lengths[s] * share[self.body.segment_scale[p]])
            for s, p in enumerate(tree.parents) if p >= 0
        }  # fmt: skip
