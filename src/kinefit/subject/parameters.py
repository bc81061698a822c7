"""What a subject fit may find: parameters of a world, each kind of them a few lines.

A kind of parameter is a prior and a function from values to a world. Derivatives are differences, and no sensor
knows of parameters: the solver compares the rows of the same correspondences in worlds that differ a little.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, PointSet
from kinefit.errors import BodyError, ObservationError, choices
from kinefit.geometry.camera import Rig
from kinefit.solvers.bundle.shape import PROPORTIONS, mirror_points

UNKNOWN_SIZE, KNOWN_SIZE = 0.2, 0.02
"""Standard deviation of the logarithm of a person's size, and of one whose stature is known (shoes, posture)."""

_MIDDLE = 0.002  # [m] standard deviation of a point in the middle to either side
_STEP = 1e-4  # [m, rad, logarithm] from which derivatives are taken
_BELIEF = 5.0  # measured coordinates for which a stated spread of places counts


@dataclass(frozen=True, eq=False)
class World:
    """Everything that measurements are compared with, but for poses.

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

    It may have `of_points`, True where the values move nothing but points and joints of the body: derivatives of rows
    of points then take no rows of other worlds. They take no other bodies either where it has `slopes(values, own,
    name, segment, points, out)`: of points (K, 3) of a set by name, or of joints for None, on segments (K,), where its
    body has them, it carries derivatives out (K, 3, p) by all parameters before it on, and adds its own in columns
    `own`. It may have `touches`, of each parameter the segments on which alone rows can feel it.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) names, each of one parameter."""
        ...

    @property
    def mean(self) -> NDArray:
        """(p,) prior mean."""
        ...

    @property
    def information(self) -> NDArray:
        """(p, p) inverse covariance of the prior."""
        ...

    @property
    def step(self) -> NDArray:
        """(p,) steps of the central differences."""
        ...

    def apply(self, world: World, values: NDArray) -> World:
        """The world with these values (p,); pure."""
        ...


@dataclass(frozen=True, eq=False)
class SegmentScales:
    """Logarithms of the scales of a body's lengths: `Body.scale_groups`.

    All follow the person's size, which is unknown by 20 %, or known by 2 % where `size` is given; each differs from it
    by 5 % (`PROPORTIONS`), so that a length that nothing measures goes with those that something does.

    Parameters
    ----------
    body : Body, of scales 1.
    size : float, optional
        Of the person, as a share of the body's, where the stature is known.
    about : float, mean of an unknown size.
    proportions : standard deviation of each length about the size.
    """

    body: Body
    size: float | None = None
    about: float = 1.0
    proportions: float = PROPORTIONS
    of_points = True

    def __post_init__(self) -> None:
        if not ((self.size is None or self.size > 0) and self.about > 0 and self.proportions > 0):
            problem = f"a size of {self.size} about {self.about} with proportions of {self.proportions}"
            raise BodyError(problem, remedy="Give shares of the body's size above 0.")

    @property
    def names(self) -> tuple[str, ...]:
        """(G,)."""
        return tuple(f"length {name}" for name in self.body.scale_groups)

    @property
    def mean(self) -> NDArray:
        """(G,) logarithms."""
        return np.full(len(self.names), np.log(self.about if self.size is None else self.size))

    @property
    def information(self) -> NDArray:
        """(G, G)."""
        common = UNKNOWN_SIZE if self.size is None else KNOWN_SIZE
        return np.linalg.inv(np.eye(len(self.names)) * self.proportions**2 + common**2)

    @property
    def step(self) -> NDArray:
        """(G,)."""
        return np.full(len(self.names), _STEP)

    @cached_property
    def touches(self) -> tuple[frozenset[int] | None, ...]:
        """Of each parameter the segments that it moves: its own, and all beyond; None where a skin joins segments."""
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
        """Points stretch with the scale of their segment; see `Parameters`."""
        fixed, group = self.body.gear_scale, self.body.segment_scale[segment]
        out *= np.where(fixed, 1.0, np.exp(values))[group][:, None, None]
        felt = np.flatnonzero(~fixed[group])
        out[felt, :, own.start + group[felt]] += points[felt]

    def apply(self, world: World, values: NDArray) -> World:
        """The body with these lengths; all its points, surfaces and morphs go along."""
        return replace(world, body=world.body.scaled(np.exp(values)))


@dataclass(frozen=True, eq=False)
class KnownLengths(SegmentScales):
    """The same, as sure of each as an earlier fit was.

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
        """(G, G)."""
        return np.linalg.inv(self.covariance)


@dataclass(frozen=True, eq=False)
class PointOffsets:
    """Shifts [m] of a detector's keypoints or of markers from their places on the body, along their segment's axes.

    Parameters
    ----------
    body : Body, whose set it is.
    name : of a keypoint set or of a marker set.
    std : scalar or (K,) [m] standard deviation of each point, along each axis.
    mirror : whether left and right points are shifted alike; by default those of keypoint sets are.
    """

    body: Body
    name: str
    std: ArrayLike = 0.01
    mirror: bool | None = None
    of_points = True

    def __post_init__(self) -> None:
        sets = {**self.body.keypoint_sets, **self.body.marker_sets}
        if self.name not in sets:
            raise BodyError(choices(f"set of points of body '{self.body.name}' named", self.name, sets))
        std = np.asarray(self.std, float)
        if std.shape not in ((), (len(self.points),)) or not np.all(std > 0):
            problem = f"standard deviations of shape {std.shape} for the {len(self.points)} points of '{self.name}'"
            raise BodyError(problem, remedy="Give one, or one for each point, in metres above 0.")

    @property
    def points(self) -> PointSet:
        """The K points where the body has them."""
        return {**self.body.marker_sets, **self.body.keypoint_sets}[self.name]

    @cached_property
    def _shared(self) -> tuple[NDArray, NDArray, NDArray]:
        """For each point the point that leads it, and the sign of its z; then all leaders."""
        count = len(self.points)
        lead, sign = np.arange(count), np.ones(count)
        if self.mirror if self.mirror is not None else self.name in self.body.keypoint_sets:
            lead, sign = mirror_points(self.points, self.body.tree.segments)
        return lead, sign, np.unique(lead)

    @property
    def names(self) -> tuple[str, ...]:
        """(3 L,) of the L points that lead."""
        return tuple(f"{self.name} {self.points.names[k]} {axis}" for k in self._shared[2] for axis in "xyz")

    @property
    def mean(self) -> NDArray:
        """(3 L,) [m] zero."""
        return np.zeros(len(self.names))

    @property
    def information(self) -> NDArray:
        """(3 L, 3 L) [1/m²]."""
        _, sign, leaders = self._shared
        std = np.repeat(np.broadcast_to(np.asarray(self.std, float), len(self.points))[leaders], 3)
        std[3 * np.flatnonzero(sign[leaders] == 0.0) + 2] = _MIDDLE
        return np.diag(std**-2)

    @property
    def step(self) -> NDArray:
        """(3 L,)."""
        return np.full(len(self.names), _STEP)

    @property
    def touches(self) -> tuple[frozenset[int], ...]:
        """Of each parameter the segments of the points that it shifts."""
        lead, _, leaders = self._shared
        on = [frozenset(int(s) for s in self.points.segments[lead == k]) for k in leaders]
        return tuple(segments for segments in on for _ in "xyz")

    def slopes(
        self, values: NDArray, own: slice, name: str | None, segment: NDArray, points: NDArray, out: NDArray
    ) -> None:
        """Points of this set move along their segment's axes; see `Parameters`."""
        if name == self.name:
            lead, sign, leaders = self._shared
            k, first = np.arange(len(points)), own.start + 3 * np.searchsorted(leaders, lead)
            for axis, way in enumerate((1.0, 1.0, np.where(sign == 0.0, 1.0, sign))):
                out[k, axis, first + axis] += way

    def shifts(self, values: NDArray) -> NDArray:
        """(K, 3) [m] of all points, mirrored where they share."""
        lead, sign, leaders = self._shared
        out = np.asarray(values, float).reshape(-1, 3)[np.searchsorted(leaders, lead)].copy()
        out[:, 2] *= np.where(sign == 0.0, 1.0, sign)
        return out

    def values_of(self, shifts: NDArray) -> NDArray:
        """(3 L,) of shifts (K, 3) [m] of all points; mirror images are left to those that lead them."""
        return np.asarray(shifts, float)[self._shared[2]].ravel()

    def apply(self, world: World, values: NDArray) -> World:
        """The body with its points shifted."""
        body = world.body
        if self.name in body.keypoint_sets:
            old = body.keypoints(self.name)
            return replace(world, body=body.with_keypoints(self.name, old.points + self.shifts(values)))
        old = body.markers(self.name)
        moved = PointSet(old.names, old.segments, old.points + self.shifts(values))
        return replace(world, body=replace(body, marker_sets={**body.marker_sets, self.name: moved}))


def place_spread(moved: NDArray, variance: NDArray, spread: ArrayLike, believed: float) -> float:
    """Standard deviation of how far points stand from their places on a body, as MacKay (1992) finds a prior's width.

    Parameters
    ----------
    moved, variance : (p,) [m], [m²] found with the prior standard deviation `spread`, and how certain that is
    spread : scalar or (p,) [m] prior standard deviation
    believed : [m] the same before a take is seen, which counts as much as five coordinates that a take measures

    All may be in any other unit, such as the standard deviation of each point.
    """
    measured = float(np.sum(np.maximum(1.0 - variance / np.square(spread), 0.0)))
    return float(np.sqrt((np.sum(moved**2) + _BELIEF * believed**2) / (measured + _BELIEF)))


def stacked(parameters: Sequence[Parameters]) -> tuple[tuple[str, ...], NDArray, NDArray, NDArray]:
    """Names, mean (p,), information (p, p) and steps (p,) of several kinds together.

    Raises
    ------
    ObservationError
        No parameters, or two of one name.
    """
    names = tuple(name for one in parameters for name in one.names)
    twice = sorted({name for name in names if names.count(name) > 1})
    if not names or twice:
        problem = f"two parameters named '{twice[0]}'" if twice else "no parameters to fit"
        raise ObservationError(problem, remedy="Give every kind of parameter once, such as SegmentScales(body).")
    information, first = np.zeros((len(names), len(names))), 0
    for one in parameters:
        own = slice(first, first := first + len(one.names))
        information[own, own] = one.information
    mean, step = (np.concatenate([getattr(one, what) for one in parameters]) for what in ("mean", "step"))
    return names, mean, information, step
