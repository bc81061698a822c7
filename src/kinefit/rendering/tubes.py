"""A body as it is drawn: closed, smooth meshes whose vertices follow up to four segments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, MeshSurface, TaperedCylinder
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.skins.body_skin import MAX_OWNERS, BodySkin, body_skins
from kinefit.bodies.surfaces.skins.skinning import SkinnedMesh, strongest
from kinefit.rendering.colours import side_colour
from kinefit.rendering.person_skin import person_skin

AROUND, CAP, ALONG = 20, 6, 8  # vertices around a tube, rings of a rounded end, rings between the ends


@dataclass(frozen=True, eq=False)
class TubeMesh:
    """Mesh in the root frame at rest.

    Parameters
    ----------
    vertices : (V, 3) [m]
    normals : (V, 3) unit, outward.
    colours : (V, 3) uint8 RGB
    triangles : (T, 3) int, counterclockwise from outside.
    segments : (V, 4) int, the segments that each vertex follows.
    weights : (V, 4) how much it follows each; they sum to 1.
    """

    vertices: NDArray
    normals: NDArray
    colours: NDArray
    triangles: NDArray
    segments: NDArray
    weights: NDArray


def body_mesh(body: Body, *, cylinders: bool = False) -> TubeMesh:
    """The body's own skin, or a person's (`person_skin`); else, or with `cylinders`, a tube around every cylinder.

    Tubes have rounded ends. Meshes stay as they are, and one skin covers metaballs that hang together. Near a joint
    tubes and skins follow both segments.
    """
    skin = None if cylinders else body.skin or person_skin(body)
    covered = set() if skin is None else set(np.unique(skin.segment).tolist())
    others = [c for c in body.surfaces if c.segment not in covered and not isinstance(c, Metaballs)]
    parts = [] if skin is None else [_skinned(body, skin)]
    parts += [_rigid(body, c) if isinstance(c, MeshSurface) else _tube(body, c) for c in others]
    parts += [] if covered else [_metaballs(body, net) for net in body_skins(body)]
    if not parts:
        columns = ((3, float), (3, float), (3, np.uint8), (3, int), (MAX_OWNERS, int), (MAX_OWNERS, float))
        return TubeMesh(*(np.zeros((0, count), kind) for count, kind in columns))
    first = np.cumsum([0] + [len(p.vertices) for p in parts])
    return TubeMesh(
        vertices=np.concatenate([p.vertices for p in parts]),
        normals=np.concatenate([p.normals for p in parts]),
        colours=np.concatenate([p.colours for p in parts]),
        triangles=np.concatenate([p.triangles + n for p, n in zip(parts, first)]),
        segments=np.concatenate([_four(p.segments) for p in parts]),
        weights=np.concatenate([_four(p.weights) for p in parts]),
    )


def _four(columns: NDArray) -> NDArray:
    """(V, 4) with zeros for what is missing."""
    return np.pad(columns, ((0, 0), (0, MAX_OWNERS - columns.shape[1])))


def is_last(body: Body, c: TaperedCylinder) -> bool:
    """Whether neither a joint nor another surface of the segment follows at the end of a cylinder."""
    others = [s for s in body.surfaces if s is not c and s.segment == c.segment and isinstance(s, TaperedCylinder)]
    follows = any(np.linalg.norm(np.subtract(s.start, c.end)) < s.length for s in others)
    return not follows and not np.any(body.tree.parents == c.segment)


def _normals(vertices: NDArray, faces: NDArray) -> NDArray:
    """(V, 3) unit normals of vertices, of the faces about each by their areas."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.zeros_like(vertices)
    np.add.at(normals, faces, np.cross(b - a, c - a)[:, None])
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))


def _rigid(body: Body, mesh: MeshSurface) -> TubeMesh:
    count = len(mesh.vertices)
    return TubeMesh(
        vertices=mesh.vertices + body.tree.rest[mesh.segment],
        normals=_normals(mesh.vertices, mesh.faces),
        colours=np.tile(np.array(side_colour(body.tree.segments[mesh.segment]), np.uint8), (count, 1)),
        triangles=mesh.faces,
        segments=np.full((count, 2), mesh.segment),
        weights=np.tile([1.0, 0.0], (count, 1)),
    )


def _skinned(body: Body, skin: SkinnedMesh) -> TubeMesh:
    which, weights = strongest(skin.weights, MAX_OWNERS)
    colours = np.array([side_colour(name) for name in body.tree.segments], np.uint8)
    return TubeMesh(
        vertices=skin.vertices, normals=_normals(skin.vertices, skin.faces), colours=colours[skin.segment],
        triangles=skin.faces, segments=np.take_along_axis(skin.owners, which, axis=1), weights=weights,
    )


def _metaballs(body: Body, skin: BodySkin) -> TubeMesh:
    there, faces, every = skin.mesh()
    vertices = skin.at_rest(there, every)
    order = np.argsort(-every, axis=1)[:, :MAX_OWNERS]
    weights = np.take_along_axis(every, order, axis=1)
    colours = np.array([side_colour(name) for name in body.tree.segments], np.uint8)
    return TubeMesh(
        vertices=vertices, normals=_normals(vertices, faces), colours=colours[order[:, 0]], triangles=faces,
        segments=np.where(weights > 0.0, order, 0), weights=weights,
    )


def _tube(body: Body, c: TaperedCylinder) -> TubeMesh:
    tree, start, radii = body.tree, np.array(c.start), c.mean_radii
    length, (side, across, u) = c.length, c.axes
    if is_last(body, c):  # the last of a limb is as long, with its rounded end, as its surface
        length = max(0.2 * length, length - radii[1])
    along, radius, slope = _profile(length, *radii)
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    out = np.stack([np.outer(np.cos(angle), side), np.outer(np.sin(angle), across)])  # (2, AROUND, 3)
    flat = np.array(c.radii) / np.array(radii)[:, None]  # (2, 2) how an ellipse departs from a circle, at both ends
    t = np.clip(along / length, 0.0, 1.0)[:, None]
    flat = (1 - t) * flat[0] + t * flat[1]  # (rings, 2)
    points = along[:, None, None] * u + radius[:, None, None] * np.einsum("rk,kai->rai", flat, out)
    normals = np.sin(slope)[:, None, None] * u + np.cos(slope)[:, None, None] * np.einsum("rk,kai->rai", 1 / flat, out)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    vertices = np.concatenate([[along[0] * u], points[1:-1].reshape(-1, 3), [along[-1] * u]])
    heights = np.concatenate([[along[0]], np.repeat(along[1:-1], AROUND), [along[-1]]])
    segments, weights = _weights(body, c, heights, length)
    return TubeMesh(
        vertices=vertices + start + tree.rest[c.segment],
        normals=np.concatenate([[-u], normals[1:-1].reshape(-1, 3), [u]]),
        colours=np.tile(np.array(side_colour(tree.segments[c.segment]), np.uint8), (len(vertices), 1)),
        triangles=_triangles(len(along) - 2),
        segments=segments,
        weights=weights,
    )


def _profile(length: float, start: float, end: float) -> tuple[NDArray, NDArray, NDArray]:
    """Way along the axis [m], radius [m] and angle of the normal towards the axis [rad], from pole to pole."""
    tilt = np.arcsin(np.clip((start - end) / length, -0.9, 0.9))  # where cone and spheres touch
    first, last = np.linspace(-np.pi / 2, tilt, CAP + 1), np.linspace(tilt, np.pi / 2, CAP + 1)
    t = np.linspace(0, 1, ALONG + 2)[1:-1]
    a0, r0 = start * np.sin(tilt), start * np.cos(tilt)
    a1, r1 = length + end * np.sin(tilt), end * np.cos(tilt)
    along = np.concatenate([start * np.sin(first), a0 + t * (a1 - a0), length + end * np.sin(last)])
    radius = np.concatenate([start * np.cos(first), r0 + t * (r1 - r0), end * np.cos(last)])
    return along, radius, np.concatenate([first, np.full(ALONG, tilt), last])


def _triangles(rings: int) -> NDArray:
    """Vertices: pole, `rings` rings of AROUND, pole."""
    i, j = np.meshgrid(np.arange(rings - 1), np.arange(AROUND), indexing="ij")
    a, b = 1 + i * AROUND + j, 1 + i * AROUND + (j + 1) % AROUND
    walls = np.concatenate([np.stack([a, b, b + AROUND], -1), np.stack([a, b + AROUND, a + AROUND], -1)]).reshape(-1, 3)
    k = np.arange(AROUND)
    after, top, last = (k + 1) % AROUND, 1 + rings * AROUND, 1 + (rings - 1) * AROUND
    start = np.stack([np.zeros_like(k), 1 + after, 1 + k], -1)
    end = np.stack([np.full_like(k, top), last + k, last + after], -1)
    return np.concatenate([start, walls, end])


def _weights(body: Body, c: TaperedCylinder, heights: NDArray, length: float) -> tuple[NDArray, NDArray]:
    """At its joint a tube follows its parent by half, at its end the child that begins there; between, itself."""
    tree, (start, end) = body.tree, c.mean_radii
    segments = np.full((len(heights), 2), c.segment)
    other = np.zeros(len(heights))
    children = [k for k in np.flatnonzero(tree.parents == c.segment) if np.linalg.norm(tree.offsets[k] - c.end) < end]
    at_joint = np.linalg.norm(c.start) < start
    parent = tree.parents[c.segment] if at_joint else -1
    reaches = [(-heights / start, parent)] + [((heights - length) / end, k) for k in children[:1]]
    for beyond, neighbour in reaches:
        if neighbour >= 0:
            t = np.clip(0.5 + 0.5 * beyond, 0.0, 1.0)  # 0 a radius before the end, 1 a radius beyond it
            share = 0.5 * t * t * (3 - 2 * t)
            segments[share > other, 1] = neighbour
            other = np.maximum(other, share)
    return segments, np.stack([1.0 - other, other], axis=1)
