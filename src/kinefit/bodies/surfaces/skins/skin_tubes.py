"""Tubes around limbs of metaballs: cross-sections by ray casting, and caps over their ends (P4, section 3.1).

Limbs in about one direction, such as upper arm, forearm and hand, form one tube. Rays from the line through its balls,
normal to it, end where they leave the last limb; at a closed end, rays over half a sphere form the cap. All faces are
quadrilaterals: a grid of rings and columns, and a grid on each cap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces.metaballs import LEVEL, Metaballs
from kinefit.errors import BodyError

_SCAN_STEPS = 48  # along a ray from its far end
_BISECTIONS = 24  # to a millionth of a limb's width
_MAX_RADIUS_RATIO = 1.2  # to a ball's radius: beyond, its field alone is below a tenth of the level
_LINE_POINTS = 200  # of the line through a tube's balls
_TRIAL_RINGS = 24  # to measure a tube's width, before rings are chosen that make its faces nearly square


@dataclass(frozen=True, eq=False)
class PosedLimb:
    """A limb of metaballs in a pose.

    Parameters
    ----------
    limb : Metaballs
    T : (4, 4) from its segment's frame to that of the pose
    """

    limb: Metaballs
    T: NDArray

    @property
    def centres(self) -> NDArray:
        """Centres (K, 3) [m] of its balls."""
        return np.asarray(self.limb.centres @ self.T[:3, :3].T + self.T[:3, 3])

    @property
    def way(self) -> NDArray:
        """Unit direction (3,) from its first ball to its last one."""
        if len(self.limb.centres) == 1:
            return np.asarray(self.T[:3, :3] @ self.limb.axes[0, int(np.argmax(self.limb.radii[0]))])
        gap = self.centres[-1] - self.centres[0]
        return np.asarray(gap / np.linalg.norm(gap))

    def field(self, x: NDArray) -> NDArray:
        """Field (N,) of its balls at points x (N, 3) [m]; any leading axes."""
        return self.limb.field((x - self.T[:3, 3]) @ self.T[:3, :3])


def field(limbs: Sequence[PosedLimb], x: NDArray) -> NDArray:
    """Field (N,) of several limbs at points x (N, 3) [m], any leading axes: the root of the sum of squared fields.

    At a joint of two limbs, the plain sum would make a bulge, the maximum a groove.
    """
    return np.asarray(np.sqrt(np.sum([limb.field(x) ** 2 for limb in limbs], axis=0)))


@dataclass(frozen=True, eq=False)
class Tube:
    """The control net of some limbs.

    Parameters
    ----------
    limbs : in their order
    rings : (R, A) vertices of its cross-sections
    caps : for each end a grid (n + 1, n + 1) of vertices, whose border is the last ring, or None if it is open
    vertices : (V, 3) [m]
    segment : (V,) segment of each vertex
    """

    limbs: tuple[PosedLimb, ...]
    rings: NDArray
    caps: tuple[NDArray | None, NDArray | None]
    vertices: NDArray
    segment: NDArray

    def faces(self) -> NDArray:
        """Faces (Q, 4), facing outwards: first those of the wall, ring by ring, then those of the caps, row by row."""
        after = np.roll(self.rings, -1, axis=1)
        walls = np.stack([self.rings[:-1], after[:-1], after[1:], self.rings[1:]], axis=-1).reshape(-1, 4)
        out = [walls]
        for end, cap in enumerate(self.caps):
            if cap is not None:
                quads = np.stack([cap[:-1, :-1], cap[1:, :-1], cap[1:, 1:], cap[:-1, 1:]], axis=-1).reshape(-1, 4)
                out.append(quads if end else quads[:, ::-1])
        return np.concatenate(out)

    @property
    def cut(self) -> Tube:
        """The tube without unused vertices, renumbered."""
        parts = [self.rings.ravel(), *(cap.ravel() for cap in self.caps if cap is not None)]
        kept, number = np.unique(np.concatenate(parts)), np.zeros(len(self.vertices), int)
        number[kept] = np.arange(len(kept))
        low, high = (None if cap is None else number[cap] for cap in self.caps)
        return Tube(self.limbs, number[self.rings], (low, high), self.vertices[kept], self.segment[kept])


def tube(limbs: Sequence[PosedLimb], around: int, closed: tuple[bool, bool]) -> Tube:
    """Net around limbs, with `around` corners a ring (a multiple of 8); closed: whether start and end have caps.

    Raises
    ------
    BodyError
        Limbs with a gap between them.
    """
    middles = np.concatenate([limb.centres for limb in limbs])
    owner = np.repeat([limb.limb.segment for limb in limbs], [len(limb.limb.centres) for limb in limbs])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(middles, axis=0), axis=1))])
    kept = np.concatenate([[True], np.diff(way) > 1e-6])
    balls, owner = way[kept], owner[kept]
    if len(balls) > 1:
        wide = 2.0 * float(np.mean([limb.limb.radii.min(axis=1).mean() for limb in limbs]))
        way, middles = _smooth(balls, middles[kept], wide)
        slopes = np.gradient(middles, way, axis=0)
    else:
        way, middles, slopes = balls, middles[:1], limbs[0].way[None]
    reach = 2.0 * _MAX_RADIUS_RATIO * max(float(limb.limb.radii.max()) for limb in limbs)

    def sections(at: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        centre = np.stack([np.interp(at, way, middles[:, k]) for k in range(3)], axis=1)
        along = np.stack([np.interp(at, way, slopes[:, k]) for k in range(3)], axis=1)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        side = _sides(along)
        angle = 2.0 * np.pi * np.arange(around) / around
        across = np.cross(along, side)
        rays = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * across[:, None]
        return centre, rays, np.stack([side, across, along], axis=1)

    middle = np.linspace(0.0, way[-1], _TRIAL_RINGS)
    centre, rays, _ = sections(middle)
    radius = float(np.mean(_exits(centre.repeat(around, axis=0), rays.reshape(-1, 3), reach, limbs)))
    count = max(4, 1 + round(way[-1] * around / (2.0 * np.pi * radius)))
    at = np.linspace(0.0, way[-1], count) if way[-1] > 0 else np.zeros(1)
    centre, rays, axes = sections(at)
    x = _exits(centre.repeat(around, axis=0), rays.reshape(-1, 3), reach, limbs)[:, None] * rays.reshape(-1, 3)
    vertices = [centre.repeat(around, axis=0) + x]
    segment = [owner[np.argmin(np.abs(at[:, None] - balls), axis=1)].repeat(around)]  # of the nearest balls
    rings = np.arange(len(at) * around).reshape(len(at), around)
    caps, first = list[NDArray | None](), rings.size
    for end, wanted in enumerate(closed):
        if not wanted:
            caps.append(None)
            continue
        cap, ways = _cap(rings[-end], first)
        a = axes[-end] * np.array([1.0, 1.0, 2.0 * end - 1.0])[:, None]
        ways = ways @ a
        start = np.tile(centre[-end], (len(ways), 1))
        vertices.append(start + _exits(start, ways, reach, limbs)[:, None] * ways)
        segment.append(np.full(len(ways), owner[-end]))
        caps.append(cap)
        first += len(ways)
    return Tube(tuple(limbs), rings, (caps[0], caps[1]), np.concatenate(vertices), np.concatenate(segment))


def _smooth(way: NDArray, middles: NDArray, wide: float) -> tuple[NDArray, NDArray]:
    """Smooth the line through balls over `wide` [m], so that cross-sections do not intersect: (M,), (M, 3) [m]."""
    at = np.linspace(0.0, way[-1], _LINE_POINTS)
    line = np.stack([np.interp(at, way, middles[:, k]) for k in range(3)], axis=1)
    half = min(int(np.ceil(wide / at[1])), _LINE_POINTS - 1)
    before, after = 2.0 * line[0] - line[half:0:-1], 2.0 * line[-1] - line[-2 : -half - 2 : -1]
    weight = np.hanning(2 * half + 3)[1:-1]
    longer = np.concatenate([before, line, after])
    return at, np.stack([np.convolve(longer[:, k], weight / weight.sum(), "valid") for k in range(3)], axis=1)


def _cap(ring: NDArray, first: int) -> tuple[NDArray, NDArray]:
    """Grid (n + 1, n + 1) of vertices with a ring (4 n,) as its border, and directions (M, 3) of the new vertices.

    New vertices are numbered from `first` on. Directions are along side, across and outwards.
    """
    n, ways = len(ring) // 4, list[tuple[float, float, float]]()
    half, grid = n // 2, np.full((n + 1, n + 1), -1)
    for k in range(half, -1, -1):
        line = np.arange(-k, k)
        sides = [np.full(2 * k, k), -line, np.full(2 * k, -k), line]
        a, b = (np.roll(np.concatenate([sides[i % 4] for i in (s, s + 1, s + 2, s + 3)]), -k) for s in (0, 3))
        if k == half:
            grid[half + a, half + b] = ring
            continue
        if k == 0:
            a = b = np.zeros(1, int)
        angle, tilt = 2.0 * np.pi * np.arange(len(a)) / len(a), 0.5 * np.pi * k / half
        grid[half + a, half + b] = first + len(ways) + np.arange(len(a))
        ways += [(np.cos(t) * np.sin(tilt), np.sin(t) * np.sin(tilt), np.cos(tilt)) for t in angle]
    return grid, np.array(ways)


def _sides(along: NDArray) -> NDArray:
    """Directions (R, 3) normal to each tangent (R, 3), with minimal rotation from one to the next."""
    side = np.cross(along[0], np.eye(3)[np.argmin(np.abs(along[0]))])
    out = np.empty_like(along)
    for k, t in enumerate(along):
        side = side - (side @ t) * t
        side = side / np.linalg.norm(side)
        out[k] = side
    return out


def _exits(starts: NDArray, ways: NDArray, reach: float, limbs: Sequence[PosedLimb]) -> NDArray:
    """Distances (N,) [m] along rays at which they leave the last limb.

    Raises
    ------
    BodyError
        A ray outside of all limbs: there is a gap between them.
    """

    def inside(steps: NDArray) -> NDArray:
        x = starts[:, None] + steps[..., None] * ways[:, None]
        return np.asarray(field(limbs, x) >= LEVEL)

    steps = np.linspace(0.0, reach, _SCAN_STEPS + 1)
    within = inside(np.broadcast_to(steps, (len(starts), _SCAN_STEPS + 1)))
    if not within.any(axis=1).all():
        place = np.round(starts[int(np.argmin(within.any(axis=1)))], 3).tolist()
        remedy = "Give larger radii along the limbs, or another ball between them."
        raise BodyError(f"limbs of metaballs do not meet near {place} m", remedy=remedy)
    last = _SCAN_STEPS - np.argmax(within[:, ::-1], axis=1)
    low, high = steps[last], steps[np.minimum(last + 1, _SCAN_STEPS)]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        there = inside(middle[:, None])[:, 0]
        low, high = np.where(there, middle, low), np.where(there, high, middle)
    return np.asarray(0.5 * (low + high))
