"""Metaballs: ellipsoids on a segment whose fields blend into one surface, Σ w exp(-2 d) = 1/2 (P4, eqs. 7, 8 and 15).

They scale with the segment. Fits use the exact surface (`nearest`). Rendering, anchors and exports use a closed mesh of
cross-sections, made by ray casting (P4, section 3.1), whose faces do not change with the radii.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.surfaces.mesh import MAX_LENGTH, MeshSurface, tube_faces
from kinefit.errors import BodyError
from kinefit.geometry.lines import perpendiculars

LEVEL = 0.5  # of the field on the surface (P4, w_t)
_MIN_RADIUS = 1e-4  # [m] below what any sensor resolves
_MAX_LOG_WEIGHT = 12.0  # such a ball's surface is at 2.5 of its radii, and nearly solid
_AROUND, _RINGS = 32, 24  # corners of a cross-section, and cross-sections
_SCAN_STEPS = 12  # outwards along a ray, to below the level
_BISECTIONS = 7  # of the last step
_SECANT_STEPS = 4  # after that


class Derivatives(NamedTuple):
    """A field (N,) and its exact derivatives: by the point (N, 3), radii (N, K, 3), weights (N, K) and length (N,).

    The last one is by the logarithm of a common factor of centres and radii.
    """

    value: NDArray
    by_point: NDArray
    by_radii: NDArray
    by_weights: NDArray
    by_length: NDArray


def _empty() -> NDArray:
    return np.zeros(0)


@dataclass(frozen=True, eq=False)
class Metaballs(MeshSurface):
    """K ellipsoids of one segment; made by `of`.

    Parameters
    ----------
    segment, vertices, faces : as of a mesh: the surface's cross-sections.
    centres : (K, 3) [m] in the segment's frame.
    radii : (K, 3) [m] at which d = 1 along the axes; the surface of a single ball of weight 1 is at 0.589 of them.
    weights : (K,) of the fields; larger ones give sharper edges.
    axes : (K, 3, 3) directions of the ellipsoids' axes, as rows.
    """

    centres: NDArray = field(default_factory=_empty)
    radii: NDArray = field(default_factory=_empty)
    weights: NDArray = field(default_factory=_empty)
    axes: NDArray = field(default_factory=_empty)

    def __post_init__(self) -> None:
        """Skip the checks of a mesh: cross-sections between two poles are closed and oriented by construction."""
        for value in (self.vertices, self.faces):
            value.flags.writeable = False

    @classmethod
    def of(
        cls, segment: int, centres: ArrayLike, radii: ArrayLike, weights: ArrayLike | None = None,
        axes: ArrayLike | None = None,
    ) -> Metaballs:  # fmt: skip
        """Surface of ellipsoids: centres, radii (K, 3) [m], weights (K,), default 1, axes (K, 3, 3), default aligned.

        Raises
        ------
        BodyError
            Numbers that are not finite, radii or weights that are not positive, balls that do not blend into one.
        """
        c = np.array(centres, float)
        r = np.array(radii, float)
        if c.ndim != 2 or c.shape[1:] != (3,) or r.shape != c.shape or not len(c):
            raise BodyError(f"metaballs of centres {c.shape} and radii {r.shape}", remedy="Give (K, 3) each.")
        w = np.ones(len(c)) if weights is None else np.array(weights, float)
        A = np.tile(np.eye(3), (len(c), 1, 1)) if axes is None else np.array(axes, float)
        if w.shape != (len(c),) or A.shape != (len(c), 3, 3):
            raise BodyError(f"metaballs of weights {w.shape}, axes {A.shape}", remedy="Give (K,) and (K, 3, 3).")
        if not all(np.isfinite(v).all() for v in (c, r, w, A)) or r.min() <= 0 or w.min() <= 0:
            k = int(np.argmin(np.minimum(r.min(axis=1), w)))
            problem = f"ball {k + 1} has radii {np.round(r[k], 4).tolist()} m, weight {w[k]:g}"
            raise BodyError(problem, remedy="Give positive numbers; radii that collapse need more points.")
        out_of_range = (np.maximum(np.abs(c), r).max(axis=1) > MAX_LENGTH) | (r.min(axis=1) < _MIN_RADIUS)
        out_of_range |= np.abs(np.log(w)) > _MAX_LOG_WEIGHT
        if out_of_range.any():
            k = int(np.argmax(out_of_range))
            problem = f"ball {k + 1} at {c[k].tolist()} m has radii {r[k].tolist()} m, weight {w[k]:g}"
            remedy = f"Give metres below {MAX_LENGTH:.0f}, radii above {_MIN_RADIUS:g}, and weights near 1."
            raise BodyError(problem, remedy=remedy)
        vertices, faces = _mesh(c, r, w, A)
        for value in (c, r, w, A):
            value.flags.writeable = False
        return cls(segment, vertices, faces, c, r, w, A)

    def changed(self, radii: ArrayLike, weights: ArrayLike | None = None) -> Metaballs:
        """The metaballs with other radii (K, 3) [m] and weights (K,)."""
        return Metaballs.of(self.segment, self.centres, radii, self.weights if weights is None else weights, self.axes)

    def mirrored(self) -> Metaballs:
        """The metaballs mirrored at the plane z = 0."""
        flip = np.array([1.0, 1.0, -1.0])
        return Metaballs.of(self.segment, self.centres * flip, self.radii, self.weights, self.axes * flip)

    def _with_vertices(self, segment: int, vertices: NDArray, factor: float) -> Metaballs:
        return Metaballs(
            segment, vertices, self.faces, self.centres * factor, self.radii * factor, self.weights, self.axes
        )

    def field(self, x: ArrayLike) -> NDArray:
        """Field (N,) at points (N, 3) [m] in the segment's frame: above 1/2 inside, below it outside."""
        return _field(np.asarray(x, float), self.centres, self.radii, self.weights, self.axes)

    def derivatives(self, x: ArrayLike) -> Derivatives:
        """The field and its derivatives at points (N, 3) [m] in the segment's frame."""
        x = np.asarray(x, float)
        count = len(self.radii)
        value, by_point, by_length = np.zeros(len(x)), np.zeros((len(x), 3)), np.zeros(len(x))
        by_radii, by_weights = np.empty((len(x), count, 3)), np.empty((len(x), count))
        for k, (c, r, w, A) in enumerate(zip(self.centres, self.radii, self.weights, self.axes)):
            B = A / r[:, None]
            q = (x - c) @ B.T
            square = q * q
            by_weights[:, k] = e = np.exp(-2.0 * square.sum(axis=1))
            part = (w * e)[:, None]
            along = (-4.0 * part * q) @ B
            by_radii[:, k] = 4.0 * part * square / r
            value += part[:, 0]
            by_point += along
            by_length += by_radii[:, k] @ r - along @ c
        return Derivatives(value, by_point, by_radii, by_weights, by_length)


def _field(x: NDArray, centres: NDArray, radii: NDArray, weights: NDArray, axes: NDArray) -> NDArray:
    out = np.zeros(x.shape[:-1])
    for c, r, w, A in zip(centres, radii, weights, axes):
        q = (x - c) @ (A / r[:, None]).T
        out += w * np.exp(-2.0 * np.einsum("...i,...i->...", q, q))
    return out


def _log_field(x: NDArray, centres: NDArray, radii: NDArray, weights: NDArray, axes: NDArray) -> NDArray:
    """Logarithm of the field, finite also where the field underflows."""
    logs = np.stack([np.log(w) - 2.0 * (((x - c) @ (A / r[:, None]).T) ** 2).sum(-1)
                     for c, r, w, A in zip(centres, radii, weights, axes)])  # fmt: skip
    return np.logaddexp.reduce(logs, axis=0)


def _mesh(centres: NDArray, radii: NDArray, weights: NDArray, axes: NDArray) -> tuple[NDArray, NDArray]:
    """Vertices and faces of two poles and the cross-sections between them, by rays from the line through the balls."""
    along, spine = _spine(centres, radii, axes)
    balls = centres, radii, weights, axes
    reach = float(np.ptp(centres @ along) + 3.0 * radii.max())
    out = (spine[0], -along), (spine[-1], along)
    ends = [_first_outside(at[None], way[None], reach, balls)[0] for at, way in out]
    low, high = spine[0] @ along - ends[0], spine[-1] @ along + ends[1]
    share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, _RINGS + 1) / (_RINGS + 1))
    heights = low + share * (high - low)
    knots = spine @ along
    offsets = spine - knots[:, None] * along
    middles = np.stack([np.interp(heights, knots, offsets[:, k]) for k in range(3)], axis=1) + heights[:, None] * along
    hollow = _field(middles, *balls) < LEVEL
    if hollow.any():
        at = np.round(middles[np.argmax(hollow)], 3).tolist()
        problem = f"metaballs do not join: their field is below 1/2 near {at} m"
        raise BodyError(problem, remedy="Give larger radii along the limb, or another ball between them.")
    angle, (side, across) = 2.0 * np.pi * np.arange(_AROUND) / _AROUND, perpendiculars(along)
    ways = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * across
    starts = np.repeat(middles, _AROUND, axis=0)
    rays = np.tile(ways, (_RINGS, 1))
    rings = starts + _first_outside(starts, rays, 3.0 * float(radii.max()) + reach, balls)[:, None] * rays
    poles = np.stack([spine[0] - ends[0] * along, spine[-1] + ends[1] * along])
    return np.concatenate([rings, poles]), tube_faces(_RINGS - 1, _AROUND)


def _spine(centres: NDArray, radii: NDArray, axes: NDArray) -> tuple[NDArray, NDArray]:
    """Direction (3,) of a limb, and its balls' centres (K, 3) in their order along it."""
    if len(centres) == 1:
        return axes[0, int(np.argmax(radii[0]))], centres
    along = centres[-1] - centres[0]
    size = float(np.linalg.norm(along))
    if size < 1e-6:
        raise BodyError("the first and the last metaball are at the same position", remedy="Give them along the limb.")
    along = along / size
    height = centres @ along
    if (np.diff(height) <= 0).any():
        raise BodyError("metaballs are not in their order along the limb", remedy="Give them from end to end.")
    return along, centres


def _first_outside(starts: NDArray, ways: NDArray, reach: float, balls: tuple[NDArray, ...]) -> NDArray:
    """Distance (N,) [m] along rays at which the field first falls below the level; zero if it starts below it."""
    steps = reach * (np.arange(1, _SCAN_STEPS + 1) / _SCAN_STEPS) ** 2  # finer near the start, where thin limbs end
    values = _field(starts[:, None] + steps[:, None] * ways[:, None], *balls)
    first = np.argmax(values < LEVEL, axis=1)
    low, high = np.where(first > 0, steps[first - 1], 0.0), steps[first]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        inside = _field(starts + middle[:, None] * ways, *balls) >= LEVEL
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    at, step = 0.5 * (low + high), 1e-6 * reach
    for _ in range(_SECANT_STEPS):
        here, there = (_log_field(starts + s[:, None] * ways, *balls) - np.log(LEVEL) for s in (at, at + step))
        at = np.clip(at - step * here / np.where(np.abs(there - here) > 1e-15, there - here, -1e-15), low, high)
    return at


class BallTable(NamedTuple):
    """Metaballs of a body for kernels.

    Parameters
    ----------
    limbs : (G, 7) segment, first ball, one after the last, centre (3) and radius of a sphere around the surface; [m] in
        the root frame at rest.
    balls : (B, 13) centre (3) [m] in that frame, axes over radii (9) row by row [1/m], weight.
    """

    limbs: NDArray
    balls: NDArray


def pack_balls(surfaces: Any, rest: NDArray) -> BallTable:
    """Table of metaballs; rest (S, 3) [m] joint centres in the root frame at rest."""
    limbs, balls = list[list[float]](), list[list[float]]()
    for s in surfaces:
        first = len(balls)
        for c, r, w, A in zip(s.centres, s.radii, s.weights, s.axes):
            balls.append([*(c + rest[s.segment]), *(A / r[:, None]).ravel(), w])
        middle = 0.5 * (s.vertices.min(axis=0) + s.vertices.max(axis=0))
        radius = float(np.linalg.norm(s.vertices - middle, axis=1).max())
        limbs.append([s.segment, first, len(balls), *(middle + rest[s.segment]), 1.01 * radius])
    return BallTable(np.array(limbs, float), np.array(balls, float))
