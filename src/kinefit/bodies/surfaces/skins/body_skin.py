"""One seamless skin over a whole body of metaballs: tubes around its limbs, joined at branches (P4, section 3.1).

Where a limb branches off another, such as an arm from the trunk, a block of the other's net is cut out whose border has
as many corners as the limb's cross-sections, and rows of quadrilaterals join both. The result is one closed net, and
the skin is the bicubic B-spline surface over it (`subdivision`). It is built in a pose with separated limbs, in which
the arms do not touch the trunk, and transformed to the rest pose by its skin weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body
from kinefit.bodies.surfaces.metaballs import LEVEL, Metaballs
from kinefit.bodies.surfaces.skins.skin_tubes import PosedLimb, Tube, field, tube
from kinefit.bodies.surfaces.skins.skinning import check_closed, interpolated, limit, spread, subdivided
from kinefit.bodies.tree import BodyState
from kinefit.errors import BodyError
from kinefit.geometry import se3

LIMB_CORNERS = 16  # of a limb's cross-section
TRUNK_CORNERS = 32  # of the cross-section of one with branches
MAX_OWNERS = 4  # segments that a vertex follows, the default of skin files
_MIN_BEND_COSINE = np.cos(np.deg2rad(60.0))  # of directions, of a child that continues the limb
_MIN_SPREAD = np.deg2rad(12.0)  # angle from rest to the middle of a joint's limits, of limbs that are separated
_WEIGHT_ROUNDS = 8  # of smoothing the weights: over about a limb's radius to either side of a joint
_JOIN_ROUNDS = 4  # of smoothing the rows of a join


@dataclass(frozen=True, eq=False)
class BodySkin:
    """The closed net of one skin, in a pose with separated limbs.

    Parameters
    ----------
    control : (V, 3) [m] control points, in the root's frame
    faces : (Q, 4) facing outwards
    weights : (V, S) skin weights of the segments; they sum to 1
    joined : (V,) bool, whether a vertex is at a join, where no field defines the skin
    tubes : posed limbs inside the skin, tube by tube
    Ts : (S, 4, 4) from the rest pose to this one, of all segments
    """

    control: NDArray
    faces: NDArray
    weights: NDArray
    joined: NDArray
    tubes: tuple[tuple[PosedLimb, ...], ...]
    Ts: NDArray

    @property
    def limbs(self) -> tuple[PosedLimb, ...]:
        """The limbs of all tubes."""
        return tuple(limb for limbs in self.tubes for limb in limbs)

    def mesh(self, times: int = 1) -> tuple[NDArray, NDArray, NDArray]:
        """Vertices (V', 3) [m] on the skin, triangles (T, 3), weights (V', S), after some subdivisions."""
        x, weights, faces = self.control, self.weights, self.faces
        for _ in range(times):
            both, faces = subdivided(np.concatenate([x, weights], axis=1), faces)
            x, weights = both[:, :3], both[:, 3:]
        x, weights = limit(x, faces), limit(weights, faces)
        triangles = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
        return x, triangles, _largest_weights(weights)

    def at_rest(self, x: NDArray, weights: NDArray) -> NDArray:
        """Transform vertices x (V, 3) [m] with weights (V, S) from this pose to the rest pose: (V, 3) [m]."""
        T = np.einsum("vs,sij->vij", weights, self.Ts)
        return np.asarray(np.linalg.solve(T[:, :3, :3], (x - T[:, :3, 3])[..., None])[..., 0])


def _largest_weights(weights: NDArray) -> NDArray:
    """Keep the largest weights (V, S) of each vertex, normalised."""
    least = np.sort(weights, axis=1)[:, -min(MAX_OWNERS, weights.shape[1])]
    kept = np.where((weights >= least[:, None]) & (weights > 1e-3), weights, 0.0)
    return np.asarray(kept / kept.sum(axis=1, keepdims=True))


def body_skins(body: Body) -> list[BodySkin]:
    """Skins of all metaballs of a body; one if its limbs are connected.

    Raises
    ------
    BodyError
        Limbs that do not meet, or without room at a branch.
    """
    balls = {s.segment: s for s in body.surfaces if isinstance(s, Metaballs)}
    out = []
    for first in sorted(balls):
        if int(body.tree.parents[first]) not in balls:
            out.append(_skin(body, balls, first))
    return out


@dataclass(eq=False)
class _TubePart:
    """Segments of a tube, and the parts that its start and its end are joined to."""

    segments: list[int]
    start: int | None = None
    end: int | None = None


def _skin(body: Body, balls: dict[int, Metaballs], first: int) -> BodySkin:
    frames = body.tree.forward(np.eye(4), _separated_pose(body, balls, first).angles)[0]
    Ts = np.tile(np.eye(4), (len(frames), 1, 1))
    Ts[:, :3, :3] = frames[:, :9].reshape(-1, 3, 3)
    Ts[:, :3, 3] = frames[:, 9:]
    posed = {s: PosedLimb(limb, Ts[s] @ se3.transform(np.eye(3), body.tree.rest[s])) for s, limb in balls.items()}
    parts = _parts(body, posed, first)
    hosts = {part.start for part in parts}
    around = [TRUNK_CORNERS if k in hosts else LIMB_CORNERS for k in range(len(parts))]
    tubes = [
        tube([posed[s] for s in part.segments], n, (part.start is None, part.end is None))
        for part, n in zip(parts, around)
    ]
    return _joined(body, parts, tubes, Ts)


def _separated_pose(body: Body, balls: dict[int, Metaballs], first: int) -> BodyState:
    """The rest pose with branching limbs separated: at the middle of their joints' limits about the forward axis."""
    tree, state = body.tree, body.default_state()
    angles = np.zeros_like(state.angles)
    several = {s for s in balls if sum(int(tree.parents[c]) == s for c in balls) > 1}
    for s in balls:
        above = s
        while above in balls and int(tree.parents[above]) not in several:
            above = int(tree.parents[above])
        for d in np.flatnonzero((tree.owners == s) & ~tree.prismatic):
            middle = 0.5 * (tree.lower[d] + tree.upper[d])
            if above in balls and abs(tree.axes[d, 0]) > 0.95 and abs(middle) > _MIN_SPREAD and np.isfinite(middle):
                angles[d] = middle
    return BodyState(np.eye(4), angles)


def _parts(body: Body, posed: dict[int, PosedLimb], first: int) -> list[_TubePart]:
    """Tubes of a body: the child that bends least continues a limb, the others branch off."""
    parents, parts = body.tree.parents, [_TubePart([first])]
    for number, part in ((k, p) for k in range(len(posed)) if k < len(parts) for p in [parts[k]]):
        while True:
            last = part.segments[-1]
            children = [c for c in posed if int(parents[c]) == last]
            straight = [float(posed[c].way @ posed[last].way) for c in children]
            on = int(np.argmax(straight)) if children and max(straight) > _MIN_BEND_COSINE else None
            for k, child in enumerate(children):
                if k != on and len(children) == 1:  # such as a foot: the limb ends in it
                    part.end = len(parts)
                    parts.append(_TubePart([child]))
                elif k != on:
                    parts.append(_TubePart([child], start=number))
            if on is None:
                break
            part.segments.append(children[on])
    return parts


def _joined(body: Body, parts: Sequence[_TubePart], tubes: list[Tube], Ts: NDArray) -> BodySkin:
    """Join all tubes into one net."""
    joints = [(k, part.start, 0) for k, part in enumerate(parts) if part.start is not None]
    joints += [(k, part.end, -1) for k, part in enumerate(parts) if part.end is not None]
    for k, host, end in joints:
        tubes[k] = _shortened(body, tubes[k], tubes[host], end)
    first = np.cumsum([0, *(len(t.vertices) for t in tubes)])
    faces = [t.faces() for t in tubes]
    open_to = [np.ones(len(f), bool) for f in faces]
    x = np.concatenate([t.vertices for t in tubes])
    weights = np.zeros((len(x), len(body.tree.segments)))
    weights[np.arange(len(x)), np.concatenate([t.segment for t in tubes])] = 1.0
    bridges, joined = [], np.zeros(len(x), bool)
    for k, host, end in joints:
        ring = first[k] + (tubes[k].rings[0] if end == 0 else tubes[k].rings[-1, ::-1])
        block, border = _hole(body, tubes[host], faces[host], open_to[host], x[ring], tubes[k].limbs)
        open_to[host][block] = False
        border = border + first[host]
        gap = np.linalg.norm(x[border] - x[ring], axis=1).mean()
        size = np.linalg.norm(x[ring] - x[np.roll(ring, 1)], axis=1).mean()
        rows = [border]
        for t in np.linspace(0.0, 1.0, max(2, 1 + round(gap / size)))[1:-1]:
            rows.append(len(x) + np.arange(len(ring)))
            x = np.concatenate([x, (1 - t) * x[border] + t * x[ring]])
            weights = np.concatenate([weights, (1 - t) * weights[border] + t * weights[ring]])
        rows.append(ring)
        joined = np.concatenate([joined, np.ones(len(x) - len(joined), bool)])
        joined[border] = joined[ring] = True
        for a, b in pairwise(rows):
            bridges.append(np.stack([a, np.roll(a, -1), np.roll(b, -1), b], axis=1))
    net = np.concatenate([*(f[o] + n for f, o, n in zip(faces, open_to, first)), *bridges])
    kept, net = np.unique(net, return_inverse=True)
    net = net.reshape(-1, 4)
    x, weights, joined = x[kept], weights[kept], joined[kept]
    check_closed(net)
    x = np.where(joined[:, None], spread(x, net, _JOIN_ROUNDS), x)
    limbs = tuple(t.limbs for t in tubes)
    return BodySkin(interpolated(x, net), net, spread(weights, net, _WEIGHT_ROUNDS), joined, limbs, Ts)


def _shortened(body: Body, limb: Tube, host: Tube, end: int) -> Tube:
    """Remove the cross-sections of a tube that lie inside its host."""
    covered = np.flatnonzero((field(host.limbs, limb.vertices[limb.rings]) >= LEVEL).any(axis=1))
    rings = limb.rings
    if len(covered):
        rings = rings[1 + int(covered.max()) :] if end == 0 else rings[: int(covered.min())]
    if len(rings) < 2:
        name = body.tree.segments[limb.limbs[0].limb.segment]
        problem = f"limb of segment '{name}' lies inside the limb that it branches from"
        raise BodyError(problem, remedy="Make it longer, or that limb thinner.")
    return replace(limb, rings=rings).cut


def _hole(
    body: Body, host: Tube, faces: NDArray, free: NDArray, ring: NDArray, limbs: Sequence[PosedLimb]
) -> tuple[NDArray, NDArray]:
    """Faces of a tube to cut out for a limb with a ring (A, 3) [m], and the border (A,) that fits the ring best.

    Candidates are blocks of the wall and of the caps with a border of A corners that touch no face cut out before.
    """
    blocked = np.zeros(len(host.vertices), bool)
    blocked[faces[~free]] = True
    covered = field(limbs, host.vertices) >= LEVEL
    best, out = np.inf, None
    turns = (np.arange(len(ring)) + np.arange(len(ring))[:, None]) % len(ring)
    for block, loop in _blocks(host, len(ring)):
        if blocked[loop].any() or not free[block].all():
            continue
        border = host.vertices[loop]
        if len(ring) * float(np.sum((border.mean(axis=0) - ring.mean(axis=0)) ** 2)) >= best:
            continue  # a lower bound for all rotations
        inside = np.zeros(len(host.vertices), bool)
        inside[faces[block]] = True
        squares = np.sum((border[turns] - ring) ** 2, axis=(1, 2))
        shift = int(np.argmin(squares))
        cost = float(squares[shift]) * (1.0 + (covered & ~inside).sum() / len(ring))
        if cost < best:
            best, out = cost, (block, loop[turns[shift]])
    if out is None:
        name = body.tree.segments[limbs[0].limb.segment]
        raise BodyError(f"no room for the limb of segment '{name}' at its branch", remedy="Move limbs apart.")
    return out


def _blocks(host: Tube, corners: int) -> list[tuple[NDArray, NDArray]]:
    """Blocks of a tube's faces, each with its border, counter-clockwise from outside."""
    (R, A), out = host.rings.shape, []
    sizes = [(h, corners // 2 - h) for h in range(2, corners // 2 - 1)]
    wall = np.concatenate([host.rings, host.rings], axis=1)
    for h, w in sizes:
        for i in range(R - h):
            for j in range(A):
                rows = np.arange(i, i + h)[:, None] * A + (np.arange(j, j + w) % A)
                out.append((rows.ravel(), _border(wall[i : i + h + 1, j : j + w + 1])))
    number = (R - 1) * A
    for end, cap in enumerate(host.caps):
        if cap is None:
            continue
        n = len(cap) - 1
        for h, w in sizes:
            for i in range(n - h + 1):
                for j in range(n - w + 1):
                    rows = number + np.arange(i, i + h)[:, None] * n + np.arange(j, j + w)
                    loop = _border(cap[i : i + h + 1, j : j + w + 1])
                    out.append((rows.ravel(), loop[::-1] if end else loop))
        number += n * n
    return out


def _border(grid: NDArray) -> NDArray:
    """Border of a grid: along its first row, up its last column, back along the last row, and down."""
    return np.concatenate([grid[0, :-1], grid[:-1, -1], grid[-1, :0:-1], grid[:0:-1, 0]])
