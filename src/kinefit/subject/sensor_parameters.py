"""Parameters of the measuring side: where cameras stand, and what sensors do not know of themselves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.rows import Rows
from kinefit.sensors.base import Sensor, Unknown
from kinefit.sensors.checks import of_kind
from kinefit.sensors.displaced import AXES, CLOCK
from kinefit.sensors.settings import CameraErrors
from kinefit.solvers import _kernels_border
from kinefit.solvers.equations import inverse
from kinefit.subject.parameters import World, place_spread

FAR_OFF = 3.0
"""Standard deviations of its calibration: one of 24 numbers is so far off in 6 % of takes."""

_WRONG = 2.0  # times its calibration's standard deviations, found of a camera, from which on it is moved
_ROUNDS = 30  # of spreads and moves in turn; the slowest change by less than a hundredth from then on
_STEP = 1e-4  # [m, rad] from which derivatives are taken
_HELD = 1e4  # times the information that single cameras have, of their common motion where it means nothing


@dataclass(frozen=True, eq=False)
class CameraExtrinsics:
    """Six parameters a camera: the twist (v, ω) [m, rad] of its pose, in its own frame.

    Cameras and bodies may move together unseen. So one camera is the gauge, and stays; or none, where other sensors
    such as markers know where the world is.

    Parameters
    ----------
    rig : Rig, from which twists count.
    held : name of the camera that stays; None where other sensors hold the world.
    std : (2,) standard deviations of v [m] and ω [rad].
    cameras : names of those that move, besides the one that is held; default: all.
    factors : (C,) of each camera that moves, on its standard deviations; default 1, see `with_errors_of`.
    calibrated : Rig, the prior mean; default: `rig`.
    own_world : bool, the mean motion of all cameras is held: the world is theirs, nothing else measures it.
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
            raise ObservationError(f"standard deviations of {self.std}", remedy="Give metres and radians above 0.")

    @classmethod
    def of(
        cls, errors: CameraErrors, rig: Rig, cameras: tuple[str, ...], factors: NDArray | None = None,
        calibrated: Rig | None = None,
    ) -> CameraExtrinsics:  # fmt: skip
        """Of cameras that stand where a calibration of these errors has them; none is held."""
        return cls(rig, None, (errors.position, errors.direction), cameras, factors, calibrated, errors.own_world)

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the cameras that move."""
        moving = self.rig.names if self.cameras is None else self.cameras
        return tuple(name for name in moving if name != self.held)

    @property
    def names(self) -> tuple[str, ...]:
        """(6 C,)."""
        return tuple(f"{camera} {axis}" for camera in self.free for axis in ("tx", "ty", "tz", "rx", "ry", "rz"))

    @property
    def mean(self) -> NDArray:
        """(6 C,) with which the cameras stand as their calibration has them."""
        return np.zeros(len(self.names)) if self.calibrated is None else self.values_of(self.calibrated)

    @property
    def information(self) -> NDArray:
        """(6 C, 6 C)."""
        own = np.diag(self.spreads.ravel() ** -2.0)
        if not (self.own_world and self.free):
            return own
        together = own @ np.concatenate([se3.adjoint(self.rig[name].T_camera_world) for name in self.free])
        common = together.T @ (together / np.diag(own)[:, None])
        return own + _HELD * together @ np.linalg.solve(common, together.T)

    @property
    def spreads(self) -> NDArray:
        """(C, 6) [m, rad] prior standard deviation of each parameter."""
        return self._times[:, None] * np.repeat(self.std, 3)

    @property
    def _times(self) -> NDArray:
        return np.ones(len(self.free)) if self.factors is None else np.asarray(self.factors, float)

    def tighter(self, share: float) -> CameraExtrinsics:
        """The same, held with so large a share of the standard deviations."""
        return replace(self, factors=share * self._times)

    def with_errors_of(self, own: slice, moved: NDArray, information: NDArray, prior: NDArray) -> CameraExtrinsics:
        """The same cameras with standard deviations as large as a take shows that their errors are.

        A multiple of the stated ones is found for all cameras together, and one for each that is drawn towards it; a
        camera that is off by far beside the others says nothing of these. See `place_spread`.

        Parameters
        ----------
        own : which of the p parameters of a fit are these cameras'
        moved : (p,) found, from the prior means
        information, prior : (p, p) of the sensors, and that with which it was found
        """
        out, prior, pull = self, prior.copy(), (information + prior) @ moved
        for _ in range(_ROUNDS):
            prior[own, own] = out.information
            covariance = inverse(prior + information)
            out = out._with_spreads_of((covariance @ pull)[own], np.diag(covariance)[own])
        return out

    def _with_spreads_of(self, moved: NDArray, variance: NDArray) -> CameraExtrinsics:
        """One round of it: from where cameras (6 C,) were found with the present standard deviations."""
        stated = np.repeat(self.std, 3)
        of = np.stack([moved.reshape(-1, 6) / stated, variance.reshape(-1, 6) / stated**2, self.spreads / stated])

        def spread(which: Any, believed: float) -> float:
            return place_spread(of[0, which], of[1, which], of[2, which], believed)

        each = np.array([spread(c, 1.0) for c in range(of.shape[1])])
        common = spread(each <= FAR_OFF * max(float(np.median(each)), 1.0), 1.0)
        return replace(self, factors=np.array([spread(c, common) for c in range(of.shape[1])]))

    @property
    def wrong(self) -> bool:
        """Whether a camera is farther off than its calibration says; two cameras do not tell which of them it is."""
        return len(self.free) > 2 and float(self._times.max()) > _WRONG

    @property
    def step(self) -> NDArray:
        """(6 C,)."""
        return np.full(len(self.names), _STEP)

    def apply(self, world: World, values: NDArray) -> World:
        """The rig with its cameras moved."""
        twist = dict(zip(self.free, np.asarray(values, float).reshape(-1, 6)))
        return replace(world, rig=moved_rig(world.rig, twist))

    def values_of(self, rig: Rig) -> NDArray:
        """(6 C,) with which the cameras stand as in another rig."""
        there = [rig[name].T_camera_world @ se3.inverse(self.rig[name].T_camera_world) for name in self.free]
        return np.concatenate([np.zeros(0), *(se3.log(T) for T in there)])

    def columns(self, rows: Rows, rig: Rig, camera: NDArray) -> NDArray:
        """(N, 6 C) how far the points of rows move along their directions with the cameras that see them, whitened.

        Parameters
        ----------
        rig : Rig, near the prior's
        camera : (N,) number in the rig of the camera that sees each row's point; none for no rows through cameras
        """
        out = np.zeros((len(rows), 6 * len(self.free)))
        if not len(camera):
            return out
        first = np.full(len(rig), -1)
        first[[rig.index(name) for name in self.free]] = 6 * np.arange(len(self.free))
        poses = np.array([c.T_camera_world for c in rig])
        _kernels_border.camera_columns(rows.data, np.ascontiguousarray(camera, np.int64), poses, first, out)
        return out


def alike(a: Rig, b: Rig) -> bool:
    """Whether two rigs are of the same cameras in the same places."""
    return a.names == b.names and all(np.array_equal(c.T_camera_world, d.T_camera_world) for c, d in zip(a, b))


def moved_rig(rig: Rig, twists: Mapping[str, ArrayLike]) -> Rig:
    """The rig with some cameras, by name, moved by twists (6,) (v, ω) [m, rad] in their own frames."""
    return Rig(tuple(
        c.with_pose(se3.exp(np.asarray(twists[c.name], float)) @ c.T_camera_world) if c.name in twists else c
        for c in rig
    ))  # fmt: skip


@dataclass(frozen=True, eq=False)
class SensorFrames:
    """Seven parameters a sensor: how its frame lies in the world, and its clock; of `Displaced` measurements.

    Something else must hold the world, such as keypoints of calibrated cameras.

    Parameters
    ----------
    sensors : names
    std : (3,) standard deviations of the shift [m] of a frame's origin, of its turn [rad] and of its clock [s].
    arms : {sensor: (3,) [m]} from the centre about which its frame turns to that origin; default: it is the centre.
    """

    sensors: tuple[str, ...]
    std: tuple[float, float, float] = (0.1, 0.087, 0.02)
    arms: Mapping[str, NDArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not all(std > 0 for std in self.std):
            raise ObservationError(f"standard deviations of {self.std}", remedy="Give m, rad and s above 0.")

    @property
    def names(self) -> tuple[str, ...]:
        """(7 S,)."""
        return tuple(f"{sensor} {what}" for sensor in self.sensors for what in (*AXES, CLOCK))

    @property
    def mean(self) -> NDArray:
        """(7 S,) zero."""
        return np.zeros(len(self.names))

    @property
    def information(self) -> NDArray:
        """(7 S, 7 S)."""
        out = np.zeros((len(self.names), len(self.names)))
        for k, sensor in enumerate(self.sensors):
            A = np.eye(7)
            A[:3, 3:6] = -se3.hat(self.arms.get(sensor, np.zeros(3)))  # shift of the origin
            out[7 * k : 7 * k + 7, 7 * k : 7 * k + 7] = A.T @ np.diag(np.repeat(self.std, (3, 3, 1)) ** -2.0) @ A
        return out

    @property
    def step(self) -> NDArray:
        """(7 S,)."""
        return np.full(len(self.names), _STEP)

    def apply(self, world: World, values: NDArray) -> World:
        """The world with the sensors' frames there."""
        own = np.asarray(values, float).reshape(-1, 7)
        frames = {s: dict(zip((*AXES, CLOCK), row.tolist())) for s, row in zip(self.sensors, own)}
        return replace(world, values={**world.values, **frames})


@dataclass(frozen=True, eq=False)
class OwnUnknowns:
    """What sensors do not know of themselves: a rope's length, a clock's delay; `Sensor.unknowns`.

    Parameters
    ----------
    unknowns : {sensor: {name: Unknown}}

    Raises
    ------
    ObservationError
        No mapping, a mean that is not finite, a standard deviation that is not positive.
    """

    unknowns: Mapping[str, Mapping[str, Unknown]]

    def __post_init__(self) -> None:
        of_kind(self.unknowns, Mapping, "unknowns of sensors", "Give {sensor: {name: Unknown}}, as `of` does.")
        for sensor, own in self.unknowns.items():
            for name, unknown in own.items():
                if not (np.isfinite(unknown.mean) and 0.0 < unknown.std < np.inf):
                    problem = f"sensor '{sensor}' knows '{name}' as {unknown.mean} ± {unknown.std}"
                    raise ObservationError(problem, remedy="Give a mean, and a standard deviation above 0.")

    @classmethod
    def of(cls, sensors: Iterable[Sensor]) -> OwnUnknowns:
        """Of all sensors that have some."""
        return cls({s.name: dict(s.unknowns) for s in sensors if s.unknowns})

    @property
    def _each(self) -> list[tuple[str, str, Unknown]]:
        return [(sensor, name, u) for sensor, own in self.unknowns.items() for name, u in own.items()]

    @property
    def names(self) -> tuple[str, ...]:
        """(p,)."""
        return tuple(f"{sensor} {name}" for sensor, name, _ in self._each)

    @property
    def mean(self) -> NDArray:
        """(p,)."""
        return np.array([u.mean for _, _, u in self._each])

    @property
    def information(self) -> NDArray:
        """(p, p)."""
        return np.diag([u.std**-2 for _, _, u in self._each])

    @property
    def step(self) -> NDArray:
        """(p,) a thousandth of each standard deviation."""
        return np.array([1e-3 * u.std for _, _, u in self._each])

    def apply(self, world: World, values: NDArray) -> World:
        """The world with these values."""
        out = {sensor: dict(own) for sensor, own in world.values.items()}
        for (sensor, name, _), value in zip(self._each, values, strict=True):
            out.setdefault(sensor, {})[name] = float(value)
        return replace(world, values=out)
