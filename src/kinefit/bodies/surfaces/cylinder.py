"""Tapered elliptical cylinder: the "degenerated cylinder" of five numbers (P2 2.1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._arguments import check_shape
from kinefit.errors import BodyError

Vector = tuple[float, float, float]
Radii = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class TaperedCylinder:
    """Cylinder with an elliptical cross-section that changes linearly from end to end, closed by flat caps.

    Its shape has five numbers, the length and two radii at each end; `start`, `end` and `side` give its pose.

    Parameters
    ----------
    segment : int
    start, end : (3,) [m] centres of both ends, in the segment's frame.
    radii : ((a0, b0), (a1, b1)) [m]
        Half axes at the start and at the end: a along `side`, b along axis × side.
    side : (3,), optional
        Direction of a, projected onto the plane normal to the axis. Default: x (forward), or y (up) for a cylinder
        along x.

    Raises
    ------
    BodyError
        Zero length, a radius that is not positive, a side along the axis, or numbers that are not finite.
    """

    segment: int
    start: Vector
    end: Vector
    radii: Radii
    side: Vector | None = None

    def __post_init__(self) -> None:
        start, end, radii = (np.array(v, float) for v in (self.start, self.end, self.radii))
        for array, shape, what in ((start, (3,), "an end"), (end, (3,), "an end"), (radii, (2, 2), "radii")):
            check_shape(array, shape, f"{what} of a cylinder", error=BodyError)
        if not np.isfinite([start.sum(), end.sum(), radii.sum()]).all() or radii.min() <= 0:
            problem = f"a cylinder from {start.tolist()} to {end.tolist()} has radii {radii.tolist()}"
            raise BodyError(problem, remedy="Give positive radii in metres, and finite ends.")
        length = float(np.linalg.norm(end - start))
        if length < 1e-9:
            raise BodyError("a cylinder has no length", remedy="Give an end that differs from its start.")
        for name, value in (("start", start), ("end", end), ("side", _side(self.side, (end - start) / length))):
            object.__setattr__(self, name, tuple(value.tolist()))
        object.__setattr__(self, "segment", int(self.segment))
        object.__setattr__(self, "radii", tuple(tuple(pair) for pair in radii.tolist()))

    @classmethod
    def round(
        cls, segment: int, end: ArrayLike, radii: tuple[float, float], *, start: ArrayLike = (0.0, 0.0, 0.0)
    ) -> TaperedCylinder:
        """Cylinder with circular ends of radii [m], from start (3,) [m], default the segment's joint, to end (3,)."""
        (first, last), (joint, tip) = radii, [tuple(np.asarray(v, float).tolist()) for v in (start, end)]
        return cls(segment, joint, tip, ((first, first), (last, last)))  # type: ignore[arg-type]

    @cached_property
    def length(self) -> float:
        """Length [m] from end to end."""
        return float(np.linalg.norm(np.subtract(self.end, self.start)))

    @cached_property
    def axes(self) -> NDArray:
        """Unit directions of a, of b and of the axis as rows (3, 3), right-handed, in the segment's frame."""
        u = np.subtract(self.end, self.start) / self.length
        out = np.stack([np.array(self.side), np.cross(u, np.array(self.side)), u])
        out.flags.writeable = False
        return out

    @property
    def is_round(self) -> bool:
        """Whether both ends are circles."""
        return all(a == b for a, b in self.radii)

    @property
    def mean_radii(self) -> tuple[float, float]:
        """Radii [m] of circles with the areas of both ends."""
        first, last = (float(np.sqrt(a * b)) for a, b in self.radii)
        return first, last

    @lru_cache(maxsize=4096)  # noqa: B019 (small, and reused for one body)
    def scaled(self, factor: float) -> TaperedCylinder:
        """The cylinder scaled about its segment's joint by a factor, a number > 0."""
        start, end, radii = (tuple((factor * np.array(v)).tolist()) for v in (self.start, self.end, self.radii))
        return TaperedCylinder(self.segment, start, end, radii, self.side)


def _side(side: Vector | None, axis: NDArray) -> NDArray:
    """Unit vector (3,) normal to the axis; one that is already is returned unchanged, to the last digit."""
    if side is None:
        side = (0.0, 1.0, 0.0) if abs(axis[0]) > 0.8 else (1.0, 0.0, 0.0)
    out = np.array(side, float)
    if out.shape != (3,) or not np.isfinite(out).all():
        raise BodyError(f"the side of a cylinder has no direction: {side}", remedy="Give three finite numbers.")
    if abs(out @ out - 1.0) < 1e-12 and abs(out @ axis) < 1e-12:
        return out
    out = out - (out @ axis) * axis
    norm = float(np.linalg.norm(out))
    if norm < 1e-6 * max(float(np.linalg.norm(side)), 1e-12):
        raise BodyError("the side of a cylinder lies along its axis", remedy="Give a direction at right angles to it.")
    return out / norm


class Box(NamedTuple):
    """Oriented box in a segment's frame: centre (3,) [m], axes (3, 3) rows, half edges (3,) [m] along them."""

    centre: NDArray
    axes: NDArray
    half: NDArray

    def contains(self, points: NDArray) -> NDArray:
        """Whether points (N, 3) [m] in the segment's frame lie inside: (N,) bool."""
        inside: NDArray = np.all(np.abs((points - self.centre) @ self.axes.T) <= self.half, axis=1)
        return inside


def bounding_box(cylinder: TaperedCylinder, margin: float = 0.0) -> Box:
    """Smallest box along the cylinder's own axes, enlarged by `margin` [m] on all sides (P2 2.3, limb boxes)."""
    half = np.append(np.max(cylinder.radii, axis=0), 0.5 * cylinder.length) + margin
    return Box(0.5 * np.add(cylinder.start, cylinder.end), cylinder.axes, half)
