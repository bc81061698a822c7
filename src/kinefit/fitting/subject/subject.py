"""Records of a fitted person: `Subject`, `SubjectFit`, and combinations of parameters left unmeasured."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.fitting.subject.parameters import Parameters, World
from kinefit.fitting.subject.sensor_parameters import CameraExtrinsics
from kinefit.geometry.camera import Rig
from kinefit.sensors.points.views import ViewBias
from kinefit.solving.bundle.border import Prior
from kinefit.solving.equations import inverse

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
        `excess.excess`
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
        ends = np.cumsum([0, *(len(kind.names) for kind in self.parameters)]).tolist()
        return [(kind, slice(*ends[k : k + 2])) for k, kind in enumerate(self.parameters)]

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
