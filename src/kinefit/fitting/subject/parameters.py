"""Parameters of a subject fit: kinds of unknowns of a world, each with a prior.

A kind of parameters is a prior and a function from values to a world. Sensors do not depend on parameters. The solver
differentiates numerically: it compares the rows of the same correspondences in slightly different worlds.

Unknowns of gear as parameters of a subject fit: dimensions, and places in the world (P3 5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.parts import known_gear, with_dimensions, with_places
from kinefit.bodies.tree import Closure, Dimension
from kinefit.errors import BodyError, ObservationError, check_choice
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.sensors.base import Matched
from kinefit.sensors.channels import ChannelResiduals
from kinefit.solving.bundle.shape import PROPORTIONS, mirror_points
from kinefit.solving.equations import residuals
from kinefit.solving.rows import AnyRows
from kinefit.solving.trajectory.variance_components import variance_components

UNKNOWN_SIZE_STD = 0.2
"""Standard deviation of the logarithm of a person's size."""

KNOWN_SIZE_STD = 0.02
"""Standard deviation of the logarithm of a person's size if the stature is known: shoes, posture."""

_MIDLINE_STD = 0.002  # [m] of a midline point to either side
_PRIOR_COORDINATES = 5.0  # number of measured coordinates that the prior value of a spread counts as


@dataclass(frozen=True, eq=False)
class World:
    """Body, cameras and sensors' unknowns: all that measurements are compared with, except the poses.

    Parameters
    ----------
    body : Body
    rig : Rig of all cameras
    values : {sensor: {name: value}} of the sensors' own unknowns.
    """

    body: Body
    rig: Rig
    values: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: MappingProxyType({}))


class Parameters(Protocol):
    """One kind of parameters: names, a prior, and a function from values to a world.

    Optional attributes make derivatives faster:

    - `of_points`: True if the values move nothing but points and joints of the body. Rows of points then need no rows
      of changed worlds.
    - `slopes(values, own, name, segment, points, out)`: analytic derivatives, which need no changed bodies either.
      `points` (K, 3) on segments (K,) are those of the set `name`, or joints for None, with the parameters applied. It
      propagates derivatives `out` (K, 3, p) by all earlier parameters, and adds its own in columns `own`.
    - `touches`: (p,) for each parameter the only segments whose rows depend on it.
    """

    difference: ClassVar[float] = 1e-4  # [m, rad, logarithm]

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) unique names."""
        ...

    @property
    def mean(self) -> NDArray:
        """(p,) prior mean; zero by default."""
        return np.zeros(len(self.names))

    @property
    def information(self) -> NDArray:
        """(p, p) inverse covariance of the prior."""
        ...

    @property
    def step(self) -> NDArray:
        """(p,) steps of the central differences, `difference` by default."""
        return np.full(len(self.names), self.difference)

    def apply(self, world: World, values: NDArray) -> World:
        """The world with these values (p,); pure."""
        ...


@dataclass(frozen=True, eq=False)
class SegmentScales(Parameters):
    """Logarithms of the scales of a body's lengths: `Body.scale_groups`.

    All lengths follow the person's size, with a standard deviation of `about_std`, or 2 % if `size` is given. Each
    length differs from it by 5 % (`PROPORTIONS`), so an unmeasured length follows the measured ones.

    Parameters
    ----------
    body : Body, of scales 1
    size : float, optional
        Size of the person as a share of the body's, if the stature is known.
    about, about_std : float
        Prior mean of an unknown size, as a share of the body's, and standard deviation of its logarithm.
    proportions : standard deviation of the logarithm of each length about the size
    """

    body: Body
    size: float | None = None
    about: float = 1.0
    about_std: float = UNKNOWN_SIZE_STD
    proportions: float = PROPORTIONS
    of_points = True

    def __post_init__(self) -> None:
        if not ((self.size is None or self.size > 0) and self.about > 0 and self.proportions > 0):
            problem = f"size = {self.size}, about = {self.about}, proportions = {self.proportions}: not all positive"
            raise BodyError(problem, remedy="Give values above 0.")

    @property
    def names(self) -> tuple[str, ...]:
        """(G,) names."""
        return tuple(f"length {name}" for name in self.body.scale_groups)

    @property
    def mean(self) -> NDArray:
        """(G,) logarithms."""
        return np.full(len(self.names), np.log(self.about if self.size is None else self.size))

    @property
    def information(self) -> NDArray:
        """(G, G) prior information of the logarithms."""
        common = self.about_std if self.size is None else KNOWN_SIZE_STD
        return np.linalg.inv(np.eye(len(self.names)) * self.proportions**2 + common**2)

    @cached_property
    def touches(self) -> tuple[frozenset[int] | None, ...]:
        """(G,) for each parameter the segments that it moves: its own and all distal ones; None for a skinned body."""
        body, count = self.body, len(self.body.scale_groups)
        if body.skin is not None or body.morphs:
            return (None,) * count
        above: list[set[int]] = []
        for parent, group in zip(body.tree.parents, body.segment_scale):
            above.append({int(group)} | (above[parent] if parent >= 0 else set()))
        return tuple(frozenset(s for s, groups in enumerate(above) if g in groups) for g in range(count))

    def slopes(
        self, values: NDArray, own: slice, name: str | None, segment: NDArray, points: NDArray, out: NDArray
    ) -> None:
        """Points (K, 3) [m] scale with their segment; derivatives go to `out` (K, 3, p), see `Parameters`."""
        fixed, group = self.body.gear_scale, self.body.segment_scale[segment]
        out *= np.where(fixed, 1.0, np.exp(values))[group][:, None, None]
        scaled = np.flatnonzero(~fixed[group])
        out[scaled, :, own.start + group[scaled]] += points[scaled]

    def apply(self, world: World, values: NDArray) -> World:
        """The body with these logarithms of scales (G,); its points, surfaces and morphs scale with it."""
        return replace(world, body=world.body.scaled(np.exp(values)))


@dataclass(frozen=True, eq=False)
class KnownLengths(SegmentScales):
    """Segment scales with the posterior of an earlier fit as prior.

    Parameters
    ----------
    scales, covariance : (G,) of the body's lengths, and (G, G) of their logarithms
    """

    scales: NDArray = field(default_factory=lambda: np.ones(0))
    covariance: NDArray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def mean(self) -> NDArray:
        """(G,) logarithms."""
        return np.log(self.scales)

    @property
    def information(self) -> NDArray:
        """(G, G) prior information of the logarithms."""
        return np.linalg.inv(self.covariance)


@dataclass(frozen=True, eq=False)
class PointOffsets(Parameters):
    """Landmark offsets [m] of a detector's keypoints or of markers, along their segment's axes.

    Parameters
    ----------
    body : Body that has the set
    name : of a keypoint set or marker set
    std : scalar or (K,) [m] prior standard deviation of each point, along each axis
    mirror : whether left and right points share an offset, mirrored; default: True for keypoint sets

    Raises
    ------
    BodyError
        The body lacks the set; standard deviations of another shape, or not above 0.
    """

    body: Body
    name: str
    std: ArrayLike = 0.01
    mirror: bool | None = None
    of_points = True

    def __post_init__(self) -> None:
        sets = {**self.body.keypoint_sets, **self.body.marker_sets}
        check_choice(f"point set of body '{self.body.name}' named", self.name, sets, BodyError)
        std = np.asarray(self.std, float)
        if std.shape not in ((), (len(self.points),)) or not np.all(std > 0):
            problem = f"std of shape {std.shape} does not fit the {len(self.points)} points of '{self.name}'"
            raise BodyError(problem, remedy="Give one value, or one for each point, in metres above 0.")

    @property
    def points(self) -> PointSet:
        """The K points at the body's own places."""
        return {**self.body.marker_sets, **self.body.keypoint_sets}[self.name]

    @cached_property
    def _shared(self) -> tuple[NDArray, NDArray, NDArray]:
        """For each point the number of the point whose offset it shares and the sign of its z; then those numbers."""
        count = len(self.points)
        lead, sign = np.arange(count), np.ones(count)
        if self.mirror if self.mirror is not None else self.name in self.body.keypoint_sets:
            lead, sign = mirror_points(self.points, self.body.tree.segments)
        return lead, sign, np.unique(lead)

    @property
    def names(self) -> tuple[str, ...]:
        """(3 L,) names, of L points with offsets of their own."""
        return tuple(f"{self.name} {self.points.names[k]} {axis}" for k in self._shared[2] for axis in "xyz")

    @property
    def information(self) -> NDArray:
        """(3 L, 3 L) [1/m²]."""
        _, sign, leaders = self._shared
        std = np.repeat(np.broadcast_to(np.asarray(self.std, float), len(self.points))[leaders], 3)
        std[3 * np.flatnonzero(sign[leaders] == 0.0) + 2] = _MIDLINE_STD
        return np.diag(std**-2)

    @property
    def touches(self) -> tuple[frozenset[int], ...]:
        """(3 L,) for each parameter the segments of the points that it moves."""
        lead, _, leaders = self._shared
        on = [frozenset(int(s) for s in self.points.segments[lead == k]) for k in leaders]
        return tuple(segments for segments in on for _ in "xyz")

    def slopes(
        self, values: NDArray, own: slice, name: str | None, segment: NDArray, points: NDArray, out: NDArray
    ) -> None:
        """Points (K, 3) [m] of this set move along their segment's axes; `out` (K, 3, p), see `Parameters`."""
        if name == self.name:
            lead, sign, leaders = self._shared
            k, first = np.arange(len(points)), own.start + 3 * np.searchsorted(leaders, lead)
            for axis, way in enumerate((1.0, 1.0, np.where(sign == 0.0, 1.0, sign))):
                out[k, axis, first + axis] += way

    def shifts(self, values: NDArray) -> NDArray:
        """(K, 3) [m] offsets of all points from values (3 L,) [m], shared ones mirrored."""
        lead, sign, leaders = self._shared
        out = np.asarray(values, float).reshape(-1, 3)[np.searchsorted(leaders, lead)].copy()
        out[:, 2] *= np.where(sign == 0.0, 1.0, sign)
        return out

    def values_of(self, shifts: NDArray) -> NDArray:
        """(3 L,) [m] values of offsets (K, 3) [m] of all points; a shared offset is that of its first point."""
        return np.asarray(shifts, float)[self._shared[2]].ravel()

    def apply(self, world: World, values: NDArray) -> World:
        """The body with its points moved by offsets (3 L,) [m]."""
        body = world.body
        if self.name in body.keypoint_sets:
            old = body.keypoints(self.name)
            return replace(world, body=body.with_keypoints(self.name, old.points + self.shifts(values)))
        old = body.markers(self.name)
        moved = PointSet(old.names, old.segments, old.points + self.shifts(values))
        return replace(world, body=replace(body, marker_sets={**body.marker_sets, self.name: moved}))


def place_spread(moved: NDArray, variance: NDArray, spread: ArrayLike, believed: float) -> float:
    """Estimate the prior standard deviation of landmark offsets from a fit, by evidence maximisation (MacKay 1992).

    Parameters
    ----------
    moved, variance : (p,) [m], [m²] posterior mean and variance of offsets, with the prior standard deviation `spread`
    spread : scalar or (p,) [m] prior standard deviation
    believed : [m] value of the estimate without data; it counts as much as five measured coordinates

    All may be in any other unit, such as the standard deviation of each point.
    """
    measured = float(np.sum(np.maximum(1.0 - variance / np.square(spread), 0.0)))
    return float(np.sqrt((np.sum(moved**2) + _PRIOR_COORDINATES * believed**2) / (measured + _PRIOR_COORDINATES)))


def with_slices(parameters: Sequence[Parameters]) -> list[tuple[Parameters, slice]]:
    """Each kind of parameters, and its slice of all p."""
    ends = np.cumsum([0, *(len(kind.names) for kind in parameters)]).tolist()
    return [(kind, slice(*ends[k : k + 2])) for k, kind in enumerate(parameters)]


def stacked(parameters: Sequence[Parameters]) -> tuple[tuple[str, ...], NDArray, NDArray, NDArray]:
    """Names, mean (p,), information (p, p) and steps (p,) of several kinds, concatenated.

    Raises
    ------
    ObservationError
        No parameters, or two of one name.
    """
    names = tuple(name for kind in parameters for name in kind.names)
    twice = sorted({name for name in names if names.count(name) > 1})
    if not names or twice:
        problem = f"two parameters named '{twice[0]}'" if twice else "no parameters to fit"
        raise ObservationError(problem, remedy="Give each kind of parameter once, such as SegmentScales(body).")
    information = np.zeros((len(names), len(names)))
    for kind, own in with_slices(parameters):
        information[own, own] = kind.information
    mean, step = (np.concatenate([getattr(kind, name) for kind in parameters]) for name in ("mean", "step"))
    return names, mean, information, step


_WHERE = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class Gear(Parameters):
    """Dimensions of a body's gear and places of closures in the world, of those that the body file marks as unknown.

    A place is a translation [m] and, for a rigid closure, a rotation vector [rad], both from the world's origin.
    Outside a subject fit, closures with an unknown place are as soft as the place is uncertain. In the fit they have
    their own standard deviation.

    Parameters
    ----------
    body : Body, as its file has it
    """

    body: Body
    of_points = True

    @cached_property
    def dimensions(self) -> tuple[Dimension, ...]:
        """Dimensions to estimate."""
        return tuple(d for d in self.body.dimensions if d.std > 0.0)

    @cached_property
    def places(self) -> tuple[Closure, ...]:
        """Closures whose place in the world is to be estimated."""
        return tuple(c for c in self.body.closures if c.place_std > 0.0)

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) names of dimensions, then of each place's axes."""
        out = [f"gear {d.name}" for d in self.dimensions]
        return (*out, *(f"{c.name} {axis}" for c in self.places for axis in _WHERE[: _count(c)]))

    @property
    def mean(self) -> NDArray:
        """(p,) [m, rad] prior mean."""
        values = [d.value for d in self.dimensions]
        return np.array(values + [v for c in self.places for v in (*c.place, *c.turn)[: _count(c)]])

    @property
    def information(self) -> NDArray:
        """(p, p) [1/m², 1/rad²] prior information."""
        std = [d.std for d in self.dimensions]
        std += [s for c in self.places for s in (*[c.place_std] * 3, *[c.turn_std] * 3)[: _count(c)]]
        return np.diag(np.array(std) ** -2.0)

    def apply(self, world: World, values: NDArray) -> World:
        """The world with gear of these values (p,) [m, rad], which count as known."""
        count = len(self.dimensions)
        wanted = dict(zip((d.name for d in self.dimensions), np.asarray(values, float)[:count].tolist()))
        body, rest = with_dimensions(world.body, wanted), np.asarray(values, float)[count:]
        places = {}
        for c in self.places:
            own, rest = rest[: _count(c)], rest[_count(c) :]
            places[c.name] = own[:3], own[3:] if c.kind == "rigid" else np.array(c.turn)
        return replace(world, body=known_gear(with_places(body, places)))

    def start(self, states: Sequence[BodyState]) -> NDArray:
        """(p,) [m, rad] values to start from: prior means of dimensions, and medians of places over tracked poses."""
        out, at = self.mean, len(self.dimensions)
        if not len(states):
            return out
        for c in self.places:
            point = self.body.landmarks.select((c.point,))
            segment = int(point.segments[0])
            x = np.array([self.body.positions(s, point)[0] for s in states])
            out[at : at + 3] = np.median(x, axis=0)
            if c.kind == "rigid":
                R = [
                    self.body.tree.segment_poses(s.T_world_root[None], s.angles[None])[0, segment, :3, :3]
                    for s in states
                ]
                out[at + 3 : at + 6] = se3.log_so3(_middle(np.array(R)))
            at += _count(c)
        return out


def _count(c: Closure) -> int:
    return 6 if c.kind == "rigid" else 3


def _middle(R: NDArray) -> NDArray:
    """(3, 3) median of rotations (K, 3, 3): the one with the smallest sum of angles to all others."""
    angle = np.arccos(np.clip((np.einsum("aij,bij->ab", R, R) - 1.0) / 2.0, -1.0, 1.0))
    return np.asarray(R[int(np.argmin(angle.sum(axis=1)))])


_MIN_RESIDUALS = 10  # of a sensor: with fewer its excess is not estimated
_MAX_ABSORBED = 0.75  # share of all biases that parameters of the fit may absorb
_MIN_EXCESS = 1e-3  # reported for a sensor whose residuals are almost zero


FrameRows = tuple[Matched, Sequence[AnyRows]]
"""A match, with sensor and channels, and its rows at the fit."""


def excess(frames: Sequence[Sequence[FrameRows]], followed: float) -> dict[str, float]:
    """{sensor: factor} by which the variance of all frames together exceeds that of their rows.

    The variance of a channel with n rows is that of its jitter plus n times that of its bias. The factor is below 1
    where residuals are smaller than the rows' standard deviations. Channels of points are points along each axis, with
    biases of one size. Channels of surfaces are whole segments, because surface errors are constant over a patch; each
    has a bias of its own size, since segments differ in the number of rows and in their bias.

    Parameters
    ----------
    frames : rows of every measurement of each frame
    followed : number of mean residuals that a fit can make zero: degrees of freedom, and parameters that data determine
    """
    collected, of_points = ChannelResiduals(), dict[str, bool]()
    for f, measured in enumerate(frames):
        for m, rows in measured:
            used = [r.weight > 0.0 if r.weight.ndim == 1 else np.ones(len(r), bool) for r in rows]
            collected.add(f, m, rows, [residuals(r) for r in rows], [w.astype(float) for w in used])
            of_points[m.sensor] = m.of_points
    found = {s: both for s, both in collected.arrays(len(frames)).items() if both[1].sum() >= _MIN_RESIDUALS}
    looks = {
        s: float(count.any(axis=0).sum() if of_points[s] else count.sum() / len(frames))
        for s, (_, count) in found.items()
    }
    absorbed, out = min(followed / max(sum(looks.values()), 1.0), _MAX_ABSORBED), {}
    for s, (values, count) in found.items():
        C = values.shape[1]
        errors = variance_components(values, leverage=np.full(C, absorbed * of_points[s]), group=np.arange(C))
        jitter, bias = (float(np.median(v)) ** 2 for v in (errors.jitter, errors.bias))
        rows = count.sum(axis=0)
        white, constant = jitter * (count**2).sum(), bias * (rows**2).sum()
        if not of_points[s]:
            sums = np.nansum(np.where(errors.outlier[..., None], np.nan, values * count), axis=0)
            constant = max((sums**2).sum() - white, 0.0)
        out[s] = max(float(white + constant) / float(rows.sum()), _MIN_EXCESS)
    return out
