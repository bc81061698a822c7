"""Self-collisions of a body: capsules along its surfaces are pushed apart where they overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import MeshSurface, TaperedCylinder
from kinefit.errors import BodyError, ObservationError
from kinefit.solving.correspondences.occupancy import _kernels_space as kernels
from kinefit.solving.rows import PairRows


@dataclass(frozen=True, eq=False)
class CollisionPairs:
    """Capsules of a body, and the pairs that must not overlap; made by `collision_pairs`.

    Parameters
    ----------
    segment : (C,) int, of each capsule
    starts, ends : (C, 3) [m] of its axis, in the root frame at rest
    radius : (C,) [m]
    pairs : (P, 2) int, capsules
    apart : (P,) [m] smallest distance of their axes: the sum of the radii, less if they overlap in default posture
    """

    segment: NDArray
    starts: NDArray
    ends: NDArray
    radius: NDArray
    pairs: NDArray
    apart: NDArray


def collision_rows(
    body: Body,
    state: BodyState,
    *,
    pairs: CollisionPairs | None = None,
    margin: float = -0.02,
    sigma: float = 0.01,
) -> PairRows:
    """One pair row for each overlapping pair of capsules: n·(x_a − x_b) should grow by the overlap.

    x_a and x_b are the closest points of the axes and n is the unit vector from b to a, so that ∂|x_a − x_b| = n·(∂x_a
    − ∂x_b) also while the closest points slide (envelope theorem). Parts that do not touch make no row.

    Parameters
    ----------
    pairs : CollisionPairs, default those of all segments that are not adjacent (cached for each body).
    margin : float [m]
        Smallest distance between the capsules. Negative, because flesh is soft and capsules are approximate: in five
        recorded motions, retargeted, they overlap by 5 mm in 37 % of the frames, and by 2 cm in 9 %.
    sigma : float [m] standard deviation by soft flesh and the approximation by capsules.

    Raises
    ------
    ObservationError
        A sigma that is not positive.
    """
    if not sigma > 0:
        raise ObservationError(f"the standard deviation of collisions is {sigma} m", remedy="Give positive metres.")
    p = _of_all(body) if pairs is None else pairs
    a, b, n, distance = _gaps(body, state, p.segment, p.starts, p.ends, p.pairs)
    missing = p.apart + margin - distance
    hit = np.flatnonzero(missing > 0.0)
    weight = np.full(len(hit), 1.0 / sigma**2)
    return PairRows(p.segment[p.pairs[hit]], a[hit], b[hit], n[hit], missing[hit], weight)


def collision_pairs(body: Body, between: Sequence[tuple[str, str]] | None = None) -> CollisionPairs:
    """Find the pairs of a body's parts that must not overlap.

    Parts that overlap at rest or in default posture (thighs at the crotch, an arm hanging at the trunk) may keep
    overlapping to the same depth.

    Parameters
    ----------
    body : Body
    between : pairs of segments' names, default all that are not parent and child; gear may touch anything.

    Raises
    ------
    BodyError
        A name that the body does not have, or a segment without a surface.
    """
    segment, starts, ends, radius = _capsules(body)
    parents = body.tree.parents
    index = np.array(np.triu_indices(len(segment), 1)).T.reshape(-1, 2)
    first, second = segment[index].T
    gear = body.gear_scale[body.segment_scale]  # may touch the body
    keep = (first != second) & (parents[first] != second) & (parents[second] != first) & ~gear[first] & ~gear[second]
    if between is not None:
        wanted = {frozenset((body.tree.segment(i), body.tree.segment(j))) for i, j in between}
        bare = sorted(body.tree.segments[s] for s in frozenset().union(*wanted) - set(segment.tolist()))
        if bare:
            raise BodyError(f"no surface of {', '.join(bare)}", remedy="Give it one, or remove it from the pairs.")
        pairs = zip(first.tolist(), second.tolist())
        keep = np.array([frozenset(p) in wanted for p in pairs], bool) & (first != second)
    index = np.ascontiguousarray(index[keep], np.int64)
    apart = radius[index].sum(axis=1)
    for state in (body.default_state(), body.rest_state()):
        apart = np.minimum(apart, _gaps(body, state, segment, starts, ends, index)[3])
    return CollisionPairs(segment, starts, ends, radius, index, apart)


@lru_cache(maxsize=16)
def _of_all(body: Body) -> CollisionPairs:
    return collision_pairs(body)


def _gaps(
    body: Body, state: BodyState, segment: NDArray, starts: NDArray, ends: NDArray, pairs: NDArray
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    a, b, n = np.empty((3, len(pairs), 3))
    distance = np.empty(len(pairs))
    kernels.capsule_gaps(frames, segment, starts, ends, pairs, a, b, n, distance)
    return a, b, n, distance


def _capsules(body: Body) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Capsule of each surface: segment (C,), ends of its axis (C, 3) in the root frame at rest, radius (C,)."""
    found = [_round(s) if isinstance(s, TaperedCylinder) else _fitted(s) for s in body.surfaces]
    segment = np.array([s.segment for s in body.surfaces], np.int64)
    start, end = np.array([[f[0] for f in found], [f[1] for f in found]], float).reshape(2, -1, 3)
    radius = np.array([f[2] for f in found], float)
    along = end - start
    length = np.linalg.norm(along, axis=1)
    inset = np.minimum(radius, 0.5 * length)  # keeps the round ends inside of the surface
    step = along * np.divide(inset, length, out=np.zeros_like(length), where=length > 0)[:, None]
    at = body.tree.rest[segment]
    return segment, start + step + at, end - step + at, radius


def _round(c: TaperedCylinder) -> tuple[NDArray, NDArray, float]:
    return np.array(c.start, float), np.array(c.end, float), float(np.mean(c.radii))


def _fitted(mesh: MeshSurface) -> tuple[NDArray, NDArray, float]:
    """Start and end of a mesh's longest principal axis, and the mean distance of its surface from that axis."""
    corners = mesh.vertices[mesh.faces]
    middles = corners.mean(axis=1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weight = area / max(float(area.sum()), 1e-30)
    centre = weight @ middles
    offset = middles - centre
    out = corners - centre
    moments = (np.einsum("t,tki,tkj->ij", weight, out, out) + 9.0 * (offset * weight[:, None]).T @ offset) / 12.0
    axis = np.linalg.eigh(moments)[1][:, -1]
    along = (mesh.vertices - centre) @ axis
    across = np.linalg.norm(offset - (offset @ axis)[:, None] * axis, axis=1)
    return centre + along.min() * axis, centre + along.max() * axis, float(weight @ across)
