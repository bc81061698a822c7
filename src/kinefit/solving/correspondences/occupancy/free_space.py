"""Free space: the body cannot be where a depth sensor measured something farther away.

Surface samples against a depth image: each visible sample should lie on the surface measured at its pixel.

These rows go from the model to the data, `surface_rows` from the data to the model. Together they explain every
measured point and every visible part of the surface.

Self-collisions of a body: capsules along its surfaces are pushed apart where they overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import MeshSurface, TaperedCylinder
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry.camera import Camera
from kinefit.solving.correspondences import _kernels
from kinefit.solving.correspondences.occupancy import _kernels_space as kernels
from kinefit.solving.correspondences.targets import check_depth_image
from kinefit.solving.rows import PairRows, Rows

_VISIBILITY_MARGIN = 0.015  # [m] by which a visible sample may lie behind the body's rendered depth


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points of the body's surface.

    Parameters
    ----------
    segment : (N,) int
    point : (3, N) [m] in the root frame at rest
    normal : (3, N) unit, outward
    """

    segment: NDArray
    point: NDArray
    normal: NDArray

    def __post_init__(self) -> None:
        order = np.argsort(self.segment, kind="stable")
        for name, dtype in (("segment", np.int64), ("point", float), ("normal", float)):
            array = np.ascontiguousarray(np.asarray(getattr(self, name), dtype)[..., order])
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.segment)


def depth_image_rows(
    frames: NDArray,
    samples: SurfaceSamples,
    camera: Camera,
    depth: NDArray,
    shown: NDArray,
    *,
    reach: float = 0.05,
    facing: float = 0.2,
    sigma: float = 0.01,
) -> Rows:
    """One row for each visible sample p, measured at x: r = n·(x − p), point to plane along the model's normal n.

    Parameters
    ----------
    frames : (S, 12) of the segments: `body.tree.forward(state.T_world_root, state.angles)[0]`, or of joints that move.
    samples : SurfaceSamples
    camera : Camera of the depth sensor, depth (H, W) [m] its image, 0 where nothing was measured.
    shown : (h, w) [m]
        The body's rendered depth in that camera at any size, inf for none. Samples occluded by the body make no row.
    reach : float [m]
        Correspondence distance: a measurement may lie this far in front of a sample or behind it.
    facing : float
        Smallest cosine between a sample's normal and the line of sight.
    sigma : float [m]

    Raises
    ------
    ObservationError
        An image of another size than the camera's, a standard deviation that is not positive.
    """
    check_depth_image(depth, camera)
    if not sigma > 0:
        raise ObservationError(f"the standard deviation of a depth image is {sigma} m", remedy="Give positive metres.")
    data, segment, group = _kernels.buffers(len(samples))
    end = kernels.depth_image_rows(
        frames, samples.segment, samples.point, samples.normal, camera.packed, depth, camera.ray_table, shown,
        shown.shape[1] / camera.size[0], _VISIBILITY_MARGIN, reach, facing, 1.0 / sigma**2, data, segment, group, 0,
    )  # fmt: skip
    return Rows(np.ascontiguousarray(data[:, :end]), segment[:end], group[:end])


GRID_COLUMNS = 160  # cells across the image: a person at 2 to 4 m is some 20 to 40 cells wide, at any resolution


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """A depth image with, for every cell of pixels, the nearest cell where the body can be.

    Parameters
    ----------
    depth : (H, W) [m]
        Along the optical axis; 0 where nothing was measured, negative where another object was.
    nearest : (h, w) int32, row * w + column of that cell; -1 if the body cannot be in the image
    missing : (h, w) int32, the same among the cells that the body's present pose does not explain; -1 for none
    cell : int [px] width and height of a cell
    """

    depth: NDArray
    nearest: NDArray
    missing: NDArray
    cell: int

    @classmethod
    def of(
        cls,
        depth: NDArray,
        *,
        farthest: float,
        shown: NDArray | None = None,
        tolerance: float = 0.1,
        columns: int = GRID_COLUMNS,
    ) -> FreeSpace:
        """Free space of one depth image.

        Parameters
        ----------
        depth : (H, W) [m]
            0 where nothing was measured, negative where another object was.
        farthest : float [m]
            Largest depth of the body along the optical axis: the back of its predicted box. Nearer objects may occlude
            it, so the body can be there.
        shown : (h', w') [m], optional
            The body's rendered depth in that camera at any size, inf for none. Cells that it explains within
            `tolerance` [m] are excluded for the rest of the body: a misplaced limb then goes to where one is missing,
            not to the nearer head or trunk. Leave it out only if the pose is nearly correct.
        tolerance : float [m]
        columns : int
            Smallest number of cells across the image; more cost more and resolve contours better.

        Raises
        ------
        ObservationError
            No depth image, or a `farthest` that is not positive.
        """
        if np.ndim(depth) != 2 or not np.size(depth):
            problem = f"a depth image has shape {np.shape(depth)}"
            raise ObservationError(problem, remedy="Give (height, width) in metres.")
        if not farthest > 0.0:
            remedy = "Give it in metres along the optical axis."
            raise ObservationError(f"the farthest point of the body is {farthest} m", remedy=remedy)
        cell = max(depth.shape[1] // max(columns, 1), 1)
        nearest, missing = np.full((2, -(-depth.shape[0] // cell), -(-depth.shape[1] // cell)), -1, np.int32)
        kernels.nearest_cells(depth, farthest, cell, np.empty((0, 0), np.float32), tolerance, nearest)
        if shown is not None:
            own = np.ascontiguousarray(shown, np.float32)
            kernels.nearest_cells(depth, farthest, cell, own, tolerance, missing)
        return cls(depth, nearest, missing, cell)

    def middle(self, cells: NDArray) -> NDArray:
        """Centres (N, 2) [px] of cells (N,), given as row * w + column."""
        row, column = np.divmod(np.asarray(cells), self.nearest.shape[1])
        return np.stack([column, row], axis=1) * float(self.cell) + (0.5 * self.cell - 0.5)


def free_space_rows(
    frames: NDArray,
    samples: SurfaceSamples,
    space: FreeSpace,
    camera: Camera,
    *,
    sigma: float | None = None,
    tolerance: float = 0.1,
    reach: float = 0.5,
    chosen: NDArray | None = None,
) -> Rows:
    """One row for each sample in free space: sideways to the edge of the nearest possible cell.

    With g = −∂(distance in the image)/∂x: n = g/|g|, r = distance/|g|, w = |g|²/σ², the exact linearisation, as in
    `pixel_rows`. A sample makes no row if it faces away from the camera, or lies outside of its image, at a pixel
    without measurement, or behind the measured surface.

    Parameters
    ----------
    frames : (S, 12) of the segments: `body.tree.forward(state.T_world_root, state.angles)[0]`, or of joints that move.
    samples : SurfaceSamples
    space : FreeSpace of the camera's image
    camera : Camera
    sigma : float [px]
        Default ten cells: adjacent samples are correlated, and the nearest cell is often not the correct one, so
        measured points should dominate.
    tolerance : float [m]
        How far behind a sample a measurement must lie to contradict it: above three sigmas of the sensor plus the error
        of a surface of simple shapes.
    reach : float [m]
        Largest sideways distance: farther away lies another part, or another person.
    chosen : (N,) int64, optional
        Output: the target cell of every sample, -1 for none; see `FreeSpace.middle`.

    Raises
    ------
    ObservationError
        An image of another size than the camera's, or a sigma that is not positive.
    """
    check_depth_image(space.depth, camera)
    sigma = 10.0 * space.cell if sigma is None else sigma
    if not sigma > 0:
        raise ObservationError(f"the standard deviation of free space is {sigma} px", remedy="Give positive pixels.")
    data, segment, group = _kernels.buffers(len(samples))
    chosen = np.empty(len(samples), np.int64) if chosen is None else chosen
    end = kernels.free_space_rows(
        frames, samples.segment, samples.point, samples.normal, camera.packed, space.depth, space.nearest,
        space.missing, space.cell, tolerance, reach, 1.0 / sigma**2, chosen, data, segment, group, 0,
    )  # fmt: skip
    return Rows(np.ascontiguousarray(data[:, :end]), segment[:end], group[:end])


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
