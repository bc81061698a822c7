"""One seamless skin over limbs of metaballs: cross-sections by ray casting, B-splines through them (P4, section 3.1).

Limbs that follow each other, such as upper arm, forearm and hand, are one chain. Rays from the line through its balls,
at right angles to it, end where they leave the last limb that they are in. These points are the control points of one
bicubic B-spline patch, closed around the limb. At both ends the net goes on through the pole on the opposite side, so
that the patch closes there in a point with one tangent plane; everywhere else its second derivatives are continuous.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body
from kinefit.bodies.surfaces.metaballs import LEVEL, Metaballs
from kinefit.errors import BodyError

AROUND, RINGS_A_LIMB = 32, 16
_SCANNED, _HALVED = 48, 24  # steps along a ray from its far end, halvings: to a millionth of a limb's width
_FAR = 1.2  # of a ball's radius: beyond, its field alone is below a tenth of the level


@dataclass(frozen=True, eq=False)
class SplinePatch:
    """A closed bicubic B-spline patch, uniform along and around.

    Parameters
    ----------
    control : (R, A, 3) [m] rings of control points; A is even.
    ends : (2, 3) [m] the poles before the first and after the last ring.
    """

    control: NDArray
    ends: NDArray

    @property
    def net(self) -> NDArray:
        """(R + 4, A, 3) control points that go on through the poles, on the opposite side, by one ring each."""
        half = self.control.shape[1] // 2
        first, last = np.roll(self.control[0], half, axis=0), np.roll(self.control[-1], half, axis=0)
        low = (6.0 * self.ends[0] - self.control[0] - first) / 4.0  # so that the patch passes through the pole
        high = (6.0 * self.ends[1] - self.control[-1] - last) / 4.0
        return np.concatenate([first[None], low[None], self.control, high[None], last[None]])

    def at(self, u: NDArray, v: NDArray, *, du: int = 0, dv: int = 0) -> NDArray:
        """Points, or derivatives of an order up to 2 along and around.

        Parameters
        ----------
        u : (...) from 0 at the first pole by 1 a ring to R + 1 at the last one
        v : (...) around, 0 to A

        Returns
        -------
        (..., 3)
        """
        net = self.net
        u, v = np.broadcast_arrays(np.asarray(u, float), np.asarray(v, float))
        i = np.clip(np.floor(u).astype(int), 0, len(net) - 4)
        j = np.floor(v).astype(int)
        a, b = _basis(u - i, du), _basis(v - j, dv)
        rows = i[..., None] + np.arange(4)
        columns = (j[..., None] + np.arange(-1, 3)) % net.shape[1]
        points = net[rows[..., :, None], columns[..., None, :]]
        return np.einsum("...i,...j,...ijk->...k", a, b, points)

    def mesh(self, along: int = 2) -> tuple[NDArray, NDArray, NDArray]:
        """Vertices (V, 3) [m], faces (T, 3) facing outwards, and u (V,) of each vertex.

        The first vertex is the first pole, the last one the last; `along` rings of vertices for each of the control.
        """
        R, A = self.control.shape[:2]
        rings = np.arange(1, along * (R + 1)) / along
        v = np.arange(A, dtype=float)
        x = self.at(rings[:, None], v[None]).reshape(-1, 3)
        vertices = np.concatenate([self.ends[:1], x, self.ends[1:]])
        u = np.concatenate([[0.0], np.repeat(rings, A), [R + 1.0]])
        k, j, top = np.arange(len(rings) - 1)[:, None], np.arange(A), 1 + len(rings) * A
        after = (j + 1) % A
        a, b, c, d = (1 + A * (k + step) + side for step, side in ((0, j), (0, after), (1, after), (1, j)))
        walls = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
        low = np.stack([np.zeros_like(j), 1 + after, 1 + j], -1)
        high = np.stack([np.full_like(j, top), top - A + j, top - A + after], -1)
        return vertices, np.concatenate([low, walls, high]), u


def _basis(t: NDArray, order: int) -> NDArray:
    """(..., 4) uniform cubic B-splines at t in 0..1, or their derivatives."""
    powers = {
        0: np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], -1) / 6.0,
        1: np.stack([-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2], -1) / 2.0,
        2: np.stack([1 - t, 3 * t - 2, 1 - 3 * t, t], -1),
    }
    return powers[order]


@dataclass(frozen=True, eq=False)
class ChainSkin:
    """The skin of a chain of limbs, in the root frame at rest.

    Parameters
    ----------
    segments : of its limbs, from the first on
    patch : SplinePatch
    joints : (K - 1,) u of the joints between them
    width : (K - 1,) how many rings of u are a limb's radius there
    """

    segments: tuple[int, ...]
    patch: SplinePatch
    joints: NDArray
    width: NDArray

    def weights(self, u: NDArray) -> tuple[NDArray, NDArray]:
        """Segments (V, 2) that vertices follow, and how much (V, 2): within a radius of a joint both beside it."""
        place = np.searchsorted(self.joints, u)
        segments, share = np.array(self.segments)[place], np.zeros(len(u))
        other = np.array(segments)
        for k, (joint, width) in enumerate(zip(self.joints, self.width)):
            t = np.clip(0.5 + 0.5 * (u - joint) / width, 0.0, 1.0)
            after = t * t * (3.0 - 2.0 * t)
            near = np.abs(u - joint) < width
            mine = np.where(place > k, 1.0 - after, after)
            nearer = near & (mine > share)
            other[nearer] = np.where(place > k, self.segments[k], self.segments[k + 1])[nearer]
            share[nearer] = mine[nearer]
        return np.stack([segments, other], 1), np.stack([1.0 - share, share], 1)


def chains(body: Body) -> list[tuple[Metaballs, ...]]:
    """Limbs of metaballs that follow each other without branching, in the order of their segments."""
    balls = {s.segment: s for s in body.surfaces if isinstance(s, Metaballs)}
    parents = body.tree.parents
    after = {s: [c for c in balls if parents[c] == s] for s in balls}
    out = []
    for s in sorted(balls):
        if parents[s] in balls and len(after[int(parents[s])]) == 1:
            continue
        chain = [s]
        while len(after[chain[-1]]) == 1:
            chain.append(after[chain[-1]][0])
        out.append(tuple(balls[k] for k in chain))
    return out


def chain_skin(body: Body, limbs: Sequence[Metaballs]) -> ChainSkin:
    """The skin of limbs that follow each other.

    Raises
    ------
    BodyError
        Limbs with a gap between them.
    """
    rest = body.tree.rest
    middles = np.concatenate([limb.centres + rest[limb.segment] for limb in limbs])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(middles, axis=0), axis=1))])
    kept = np.concatenate([[True], np.diff(way) > 1e-6])
    middles, way = middles[kept], way[kept]
    if len(middles) > 1:
        slopes = np.gradient(middles, way, axis=0)
    else:
        slopes = limbs[0].axes[0, [int(np.argmax(limbs[0].radii[0]))]]
    reach = 2.0 * _FAR * max(float(limb.radii.max()) for limb in limbs)
    tips = np.stack([-slopes[0], slopes[-1]])
    tips /= np.linalg.norm(tips, axis=1, keepdims=True)
    out = _last_exit(np.stack([middles[0], middles[-1]]), tips, reach, limbs, rest)
    count = RINGS_A_LIMB * len(limbs)
    share = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, count + 1) / (count + 1))  # finer at the poles
    even = np.arange(1, count + 1) / (count + 1)
    at = -out[0] + 0.5 * (share + even) * (way[-1] + out[0] + out[1])
    inside = np.clip(at, way[0], way[-1])
    centre = np.stack([np.interp(inside, way, middles[:, k]) for k in range(3)], axis=1)
    centre += np.minimum(at - inside, 0.0)[:, None] * -tips[0] + np.maximum(at - inside, 0.0)[:, None] * tips[1]
    along = np.stack([np.interp(inside, way, slopes[:, k]) for k in range(3)], axis=1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    rays = _across(along)
    starts = np.repeat(centre, AROUND, axis=0)
    far = _last_exit(starts, rays.reshape(-1, 3), reach, limbs, rest)
    if (far <= 0).any():
        place = np.round(starts[int(np.argmin(far))], 3).tolist()
        remedy = "Give larger radii along the limbs, or another ball between them."
        raise BodyError(f"limbs of metaballs do not meet near {place} m", remedy=remedy)
    rings = (starts + far[:, None] * rays.reshape(-1, 3)).reshape(count, AROUND, 3)
    ends = np.stack([middles[0] + out[0] * tips[0], middles[-1] + out[1] * tips[1]])
    u, radius = np.arange(1.0, count + 1), far.reshape(count, AROUND).mean(axis=1)
    joints, width = [], []
    for limb in limbs[1:]:
        nearest = int(np.argmin(np.linalg.norm(centre - rest[limb.segment], axis=1)))
        step = np.gradient(at)[nearest]
        joints.append(u[nearest] + float((rest[limb.segment] - centre[nearest]) @ along[nearest]) / step)
        width.append(float(radius[nearest]) / step)
    patch = SplinePatch(rings, ends)
    return ChainSkin(tuple(limb.segment for limb in limbs), patch, np.array(joints), np.array(width))


def _across(along: NDArray) -> NDArray:
    """(R, A, 3) directions at right angles to each tangent (R, 3), turned as little as can be from one to the next."""
    side = np.cross(along[0], np.eye(3)[np.argmin(np.abs(along[0]))])
    angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
    out = np.empty((len(along), AROUND, 3))
    for k, t in enumerate(along):
        side = side - (side @ t) * t
        side /= np.linalg.norm(side)
        out[k] = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(t, side)
    return out


def _last_exit(starts: NDArray, ways: NDArray, reach: float, limbs: Sequence[Metaballs], rest: NDArray) -> NDArray:
    """(N,) [m] along rays, where they leave the last limb; zero where they are in none."""

    def field(steps: NDArray) -> NDArray:
        x = starts[:, None] + steps[..., None] * ways[:, None]
        flat = x.reshape(-1, 3)
        own = [limb.field(flat - rest[limb.segment]).reshape(x.shape[:2]) for limb in limbs]
        return np.max(own, axis=0)

    steps = np.linspace(0.0, reach, _SCANNED + 1)
    within = field(np.broadcast_to(steps, (len(starts), _SCANNED + 1))) >= LEVEL
    last = _SCANNED - np.argmax(within[:, ::-1], axis=1)
    low, high = steps[last], steps[np.minimum(last + 1, _SCANNED)]
    for _ in range(_HALVED):
        middle = 0.5 * (low + high)
        inside = field(middle[:, None])[:, 0] >= LEVEL
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return np.where(within.any(axis=1), 0.5 * (low + high), 0.0)
