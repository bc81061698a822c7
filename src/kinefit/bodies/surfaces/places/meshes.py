"""All surfaces of a body as one mesh, and points sampled evenly on them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.body import Body
from kinefit.bodies.surfaces.cylinder import TaperedCylinder
from kinefit.bodies.surfaces.mesh import BodyMesh, triangles
from kinefit.errors import BodyError


def body_mesh(body: Body, *, around: int = 20, along: int = 6) -> BodyMesh:
    """All surfaces of a body as one mesh; see `triangles` for `around` and `along`.

    Raises
    ------
    BodyError
        A body without surfaces.
    """
    if not body.surfaces:
        raise BodyError(f"body '{body.name}' has no surfaces", remedy="Give its segments a `surface`.")
    vertices, faces, segments, owners, total = [], [], [], [], 0
    for surface in body.surfaces:
        v, f = triangles(surface, around, along)
        vertices.append(v + body.tree.rest[surface.segment])
        faces.append(f + total)
        segments.append(np.full(len(v), surface.segment))
        owners.append(np.full(len(f), surface.segment))
        total += len(v)
    return BodyMesh(
        np.concatenate(vertices),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(segments).astype(np.int32),
        np.concatenate(owners).astype(np.int32),
    )


def sample(body: Body, count: int, *, seed: int = 0) -> tuple[NDArray, NDArray, NDArray]:
    """Sample points on all surfaces of a body, uniformly by area, including those inside of other surfaces.

    Parameters
    ----------
    body : Body
    count : int, number of points
    seed : int, of the random numbers

    Returns
    -------
    points : (count, 3) [m] on the surfaces, in the root frame at rest.
    normals : (count, 3) unit, outward.
    segment : (count,) int32
    """
    rng = np.random.default_rng(seed)
    mesh = body_mesh(body, around=48, along=12)
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(cross, axis=1)
    shares = np.cumsum(doubled) / doubled.sum()
    chosen = np.searchsorted(shares, (np.arange(count) + rng.random(count)) / max(count, 1))
    chosen = np.minimum(chosen, len(shares) - 1)
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    c = corners[chosen]
    points = c[:, 0] + u[:, None] * (c[:, 1] - c[:, 0]) + v[:, None] * (c[:, 2] - c[:, 0])
    normals = cross[chosen] / np.maximum(doubled[chosen], 1e-30)[:, None]
    first = 0
    for surface in body.surfaces:
        last = first + len(triangles(surface, 48, 12)[1])
        own = (chosen >= first) & (chosen < last)
        if isinstance(surface, TaperedCylinder) and own.any():
            rest = body.tree.rest[surface.segment]
            sides = own & (chosen < last - 2 * 48)  # the caps come last
            on, normals[sides] = _onto_side(surface, points[sides] - rest)
            points[sides] = on + rest
        first = last
    return points, normals, mesh.face_segment[chosen]


def _onto_side(cylinder: TaperedCylinder, points: NDArray) -> tuple[NDArray, NDArray]:
    """Project points (N, 3) [m] onto a cylinder's side at the same height and eccentric angle; points and normals."""
    p, q, h = ((points - cylinder.start) @ cylinder.axes.T).T
    first, last = np.array(cylinder.radii)
    growth = (last - first) / cylinder.length
    a, b = first[:, None] + growth[:, None] * h
    angle = np.arctan2(q / b, p / a)
    cos, sin = np.cos(angle), np.sin(angle)
    on = np.stack([a * cos, b * sin, h], 1) @ cylinder.axes + cylinder.start
    normal = np.stack([cos / a, sin / b, -(cos**2 * growth[0] / a + sin**2 * growth[1] / b)], 1)
    return on, normal / np.linalg.norm(normal, axis=1, keepdims=True) @ cylinder.axes
