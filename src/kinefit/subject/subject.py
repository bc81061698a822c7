"""Who is seen: the records of a person that fits leave."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Rig
from kinefit.sensors.points.view_bias import ViewBias
from kinefit.solvers.bundle.border import Prior
from kinefit.solvers.equations import inverse
from kinefit.subject.parameters import Parameters, World
from kinefit.subject.sensor_parameters import CameraExtrinsics

TOLD = 0.1
"""Share of the prior's variance that data must explain for a direction to count as measured."""

Progress = Callable[[str, int, int], None]
"""(what is done, how many of it, of how many)."""


@dataclass(frozen=True, eq=False)
class Unmeasured:
    """A combination of parameters that the prior alone holds.

    Parameters
    ----------
    direction : (p,) in prior standard deviations, of length 1.
    share : of the prior's variance in it that data explain, below `TOLD`.
    names : of the parameters that make up most of it, the largest first.
    """

    direction: NDArray
    share: float
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class SubjectFit:
    """A person, cameras and sensors as a fit found them.

    Parameters
    ----------
    body, rig, values : the world that was found; see `World`.
    names, mean : (p,) of the parameters.
    covariance : (p, p) posterior, with the poses unknown and an excess above 1 counted.
    states : K poses, refined along.
    information : (p, p) what the sensors measure, without the prior, an excess above 1 counted.
    prior : Prior
    excess : {sensor: factor} by which what its frames measure together is less certain than its rows say; more certain
        below 1.
    cost : float
    rounds : of match and solve
    parameters : the kinds of them
    prior_world : the world that they apply to
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
        """Directions of which data explain less than a tenth of the prior's variance, the least measured first."""
        root = np.linalg.cholesky(inverse(self.prior.information))
        values, vectors = np.linalg.eigh(root.T @ self.information @ root)
        out = []
        for value, vector in zip(values, vectors.T):
            share = max(float(value), 0.0) / (1.0 + max(float(value), 0.0))
            if share < TOLD:
                moved = np.abs(root @ vector) / np.sqrt(np.diag(root @ root.T))
                largest = [k for k in np.argsort(-moved) if moved[k] > 0.3 * moved.max()]
                out.append(Unmeasured(vector, share, tuple(self.names[k] for k in largest)))
        return tuple(out)

    @property
    def std(self) -> NDArray:
        """(p,) posterior standard deviation of each parameter."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def cameras(self) -> CameraExtrinsics | None:
        """The parameters of cameras, where they were sought."""
        return next((p for p in self.parameters if isinstance(p, CameraExtrinsics)), None)

    def value(self, name: str) -> tuple[float, float]:
        """A parameter by name: its estimate and standard deviation.

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
    """A body fitted to a person: lengths (G,) as `scales` of the generic one, and the detectors' points on it.

    `fit` is the fit of keypoints that it came from, `covariance` (p, p) how sure each of its parameters is, logarithms
    of the scales first; both None for a body that was given. `length_share` (G,) is each scale's standard deviation
    over it, where other sensors gave it. `sets` are the detectors' keypoint sets that it was found from, `view_bias`
    how far beside its points they see them from each side, `frames` the frames of whose poses are those of `fit`.
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
        """A body that is the person's already."""
        return cls(body, np.ones(len(body.scale_groups)))

    @property
    def cameras(self) -> CameraExtrinsics | None:
        """The parameters of cameras, where the fit sought them."""
        return None if self.fit is None else self.fit.cameras

    @property
    def camera_errors(self) -> dict[str, NDArray]:
        """{camera: (6,) [m, rad] twist} to where cameras were found that their calibration has wrongly; else none."""
        cameras = self.cameras
        if self.fit is None or cameras is None or not cameras.wrong:
            return {}
        twists = self.fit.mean[-len(cameras.names) :].reshape(-1, 6)
        return dict(zip(cameras.free, twists)) if np.any(np.abs(twists) > np.repeat(cameras.std, 3)) else {}

    @property
    def length_std(self) -> dict[str, float]:
        """[m] standard deviation of each length, from one segment's joint to the next's: "thigh_l-shank_l"."""
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
