"""The one look of a body: its skin as tubes of triangles, its colours, how lost and uncertain parts are drawn.

Viewer, report and live page draw a person by these.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, MeshSurface, TaperedCylinder, load_body
from kinefit.bodies.motion import BELIEVED
from kinefit.bodies.surfaces import Metaballs
from kinefit.bodies.surfaces.mesh import tube_faces
from kinefit.bodies.surfaces.skins.body_skin import MAX_OWNERS, BodySkin, body_skins
from kinefit.bodies.surfaces.skins.skinning import SkinnedMesh, strongest

FILE = Path(__file__).with_name("person_skin.npz")
_MAX_RATIO = 3.0  # of a segment's length or width to the humanoid's: beyond, a body only has a person's names


class _Template(NamedTuple):
    """What the file holds (benchmark `person_skin.skin`), and the humanoid's rest and extents (S, 3) [m]."""

    names: list[str]
    vertices: NDArray
    faces: NDArray
    owners: NDArray
    weights: NDArray
    rest: NDArray
    extents: NDArray


def person_skin(body: Body) -> SkinnedMesh | None:
    """The skin of a body that has all segments of the humanoid, with cylinders; None for any other body.

    Every vertex is stretched in the frames of the segments that it follows, by what the body's cylinder there is longer
    and wider than the humanoid's.
    """
    of = _template()
    if not set(of.names) <= set(body.tree.segments):
        return None
    own = np.array([body.tree.segment(name) for name in of.names])
    ratios = _extents(body)[own] / of.extents
    if not np.all((ratios < _MAX_RATIO) & (ratios > 1.0 / _MAX_RATIO)):
        return None
    nodes = body.tree.rest[own][of.owners] + ratios[of.owners] * (of.vertices[:, None] - of.rest[of.owners])
    return SkinnedMesh(nodes, of.faces, own[of.owners], of.weights)


@lru_cache(maxsize=1)
def _template() -> _Template:
    body = load_body("humanoid")
    with np.load(FILE) as file:
        names = file["segments"].tolist()
        own = [body.tree.segment(name) for name in names]
        owners = file["owners"].astype(int)
        return _Template(
            names, file["vertices"].astype(float), file["faces"], owners, file["weights"].astype(float),
            body.tree.rest[own], _extents(body)[own],
        )  # fmt: skip


def _extents(body: Body) -> NDArray:
    """(S, 3) [m] along the axes of each segment's frame: of its longest cylinder; NaN where it has none."""
    out, longest = np.full((len(body.tree.segments), 3), np.nan), np.zeros(len(body.tree.segments))
    for c in body.surfaces:
        if isinstance(c, TaperedCylinder) and c.length > longest[c.segment]:
            longest[c.segment] = c.length
            out[c.segment] = np.array([*np.mean(c.radii, axis=0), c.length]) @ np.abs(c.axes)
    return out


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
    vertices = np.concatenate([points[1:-1].reshape(-1, 3), along[[0, -1], None] * u])
    heights = np.concatenate([np.repeat(along[1:-1], AROUND), along[[0, -1]]])
    segments, weights = _weights(body, c, heights, length)
    return TubeMesh(
        vertices=vertices + start + tree.rest[c.segment],
        normals=np.concatenate([normals[1:-1].reshape(-1, 3), [-u, u]]),
        colours=np.tile(np.array(side_colour(tree.segments[c.segment]), np.uint8), (len(vertices), 1)),
        triangles=tube_faces(len(along) - 3, AROUND),
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


RGB = tuple[int, int, int]

LEFT_COLOUR, RIGHT_COLOUR, CENTRE_COLOUR = (0, 114, 178), (213, 94, 0), (0, 158, 115)
"""Of the segments on either side and in the middle."""

LOST_COLOUR = (190, 190, 190)
"""Of a segment that no measurement supports; its lines are dashed."""

_QUALITY = np.array([(86, 180, 233), (240, 228, 66), RIGHT_COLOUR], float)  # good, middling, bad


def side_colour(name: str) -> RGB:
    """RGB of a segment by its name, which ends in "_l", in "_r" or in neither."""
    return LEFT_COLOUR if name.endswith("_l") else RIGHT_COLOUR if name.endswith("_r") else CENTRE_COLOUR


def to_hex(colour: RGB) -> str:
    """RGB as pages and plots write it: "#0072b2"."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def quality_ramp(values: ArrayLike) -> NDArray[np.uint8]:
    """(..., 3) uint8 RGB of values (...): blue at 0 and below, yellow at 0.5, orange at 1 and above."""
    t = 2.0 * np.clip(np.asarray(values, float), 0.0, 1.0)[..., None]
    low = _QUALITY[0] + (_QUALITY[1] - _QUALITY[0]) * np.minimum(t, 1.0)
    return np.rint(low + (_QUALITY[2] - _QUALITY[1]) * np.maximum(t - 1.0, 0.0)).astype(np.uint8)


LOST_OPACITY, UNCERTAIN_OPACITY = 0.45, 0.6
"""Of the skin of segments that no measurement supports, and of those whose place is uncertain."""

_MAX_SIGMA = 0.11  # [m] of a joint, all directions together, above which its limb may be drawn outside itself


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices (V, 3) [m], faces (T, 3) int, counterclockwise from outside."""

    vertices: NDArray
    faces: NDArray


@dataclass(frozen=True, eq=False)
class SkinPiece:
    """The part of a skin that one segment carries.

    Parameters
    ----------
    segment : int
    mesh : Mesh, its vertices in the root's frame at rest
    followed : (B,) int, segments that its vertices follow
    weights : (V, B) how much each vertex follows these; they sum to 1
    """

    segment: int
    mesh: Mesh
    followed: NDArray
    weights: NDArray


def triangle_segments(skin: TubeMesh) -> NDArray:
    """(T,) int: the segment that each triangle belongs to, the one that the ends of its longest edge follow most.

    Both halves of a quadrilateral share this edge, so borders have no teeth.
    """
    every = np.zeros((len(skin.vertices), int(skin.segments.max(initial=-1)) + 1))
    np.add.at(every, (np.arange(len(every))[:, None], skin.segments), skin.weights)
    corners = skin.vertices[skin.triangles]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).argmax(axis=1)
    rows = np.arange(len(longest))
    ends = [skin.triangles[rows, (longest + k) % 3] for k in range(2)]
    return np.asarray((every[ends[0]] + every[ends[1]]).argmax(axis=1) if len(rows) else rows)


def skin_pieces(skin: TubeMesh) -> list[SkinPiece]:
    """A skin cut along the borders of the segments (`triangle_segments`)."""
    owners = triangle_segments(skin)
    out = []
    for s in np.unique(owners):
        used, faces = np.unique(skin.triangles[owners == s], return_inverse=True)
        segments, shares = skin.segments[used], skin.weights[used]
        followed, columns = np.unique(np.where(shares > 0, segments, s), return_inverse=True)
        weights = np.zeros((len(used), len(followed)))
        np.add.at(weights, (np.arange(len(used))[:, None], columns.reshape(shares.shape)), shares)
        out.append(SkinPiece(int(s), Mesh(skin.vertices[used], faces.reshape(-1, 3)), followed, weights))
    return out


def side_colours(body: Body) -> NDArray:
    """(S, 3) uint8: left blue, right orange, the middle green."""
    return np.array([side_colour(name) for name in body.tree.segments], np.uint8).reshape(-1, 3)


def segment_looks(
    quality: NDArray, base_colours: NDArray, *, by_quality: bool, uncertain: NDArray | None = None
) -> tuple[NDArray, NDArray]:
    """Colours (S, 3) uint8 and opacities (S,) of the segments by their quality (S,) in 0..1.

    A segment that is lost is grey and translucent whatever the colours mean; one that is `uncertain` (S,) bool is a
    little translucent.
    """
    lost = np.asarray(quality) < BELIEVED
    colours = quality_ramp(1.0 - np.asarray(quality, float)) if by_quality else base_colours
    opacities = np.where(False if uncertain is None else uncertain, UNCERTAIN_OPACITY, 1.0)
    shades = np.where(lost[:, None], np.array(LOST_COLOUR, np.uint8), colours)
    return shades, np.where(lost, LOST_OPACITY, np.broadcast_to(opacities, lost.shape))


def uncertain_segments(body: Body, joint_std: NDArray) -> NDArray:
    """(..., S) bool: segments of which a joint, at either end, has sigmas (..., S, 3) [m] above 11 cm in all."""
    sigmas = np.sqrt(np.sum(np.square(np.nan_to_num(joint_std, nan=np.inf, posinf=np.inf)), axis=-1))
    out, parents = sigmas > _MAX_SIGMA, body.tree.parents
    np.logical_or.at(out.T, parents[parents >= 0], (sigmas > _MAX_SIGMA).T[parents >= 0])
    return out
