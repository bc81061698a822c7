"""Parts of a body with their own colours (skin, shirt, trousers), and the two parts at each point of a contour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.surfaces import BodyMesh, SkinnedMesh, TaperedCylinder
from kinefit.correspondences.contours.rims import Rim

AROUND, OTHER = -1, -2  # labels of the background, and of pixels that are neither background nor body
_LOOKUP_OFFSET_PX = 1.0  # of the rendering, from a contour to the part outside of it


class Drawn(NamedTuple):
    """A rendered body as kernels take it; see `kernels.count`.

    Parameters
    ----------
    face : (h, w) int32 triangle of every pixel of a window; -1 for background, -2 for other bodies
    label : (T,) int part of each triangle
    left, top, scale : [px], [px] of the image, [px] of the window in one of the image
    joined : (G + 1, G + 1) bool, parts between which lines may pass; the last one is the background
    """

    face: NDArray
    label: NDArray
    left: float
    top: float
    scale: float
    joined: NDArray


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines across a contour.

    Parameters
    ----------
    outline : (4, N) u, v [px] and unit normals
    anchor : (N,) int anchor whose colour statistics apply; -1 where another part of the body lies outside
    own, beyond : (N,) int part of the body on the inside and on the outside, `AROUND` for the background
    """

    outline: NDArray
    anchor: NDArray
    own: NDArray
    beyond: NDArray


class Parts:
    """Parts of one body: its segments, those of left and right together; or the whole.

    Parameters
    ----------
    body : Body
    mesh : of its surface
    anchors : int, points of the surface with their own colour statistics; each lies on one part
    apart : whether segments are parts; else the whole body is one

    Attributes
    ----------
    group : (S,) int part of each segment
    count : int, number of parts
    label : (T,) int part of each triangle
    joined : see `Drawn`
    anchor : (V,) int anchor of each vertex
    of : (A,) int part of each anchor
    simple : whether the surface is of simple shapes or a model, no scan of the person: seams between its segments are
        not where clothes end (with seams, joints of the balancing trial are 12 mm off those from silhouettes, without
        them 8 mm)
    """

    def __init__(self, body: Body, mesh: BodyMesh | SkinnedMesh, anchors: int, apart: bool) -> None:
        names = [_without_side(name) for name in body.tree.segments] if apart else [""] * len(body.tree.segments)
        found = {name: k for k, name in enumerate(dict.fromkeys(names))}
        self.group, self.count = np.array([found[name] for name in names]), len(found)
        self.label = self.group[mesh.face_segment]
        self.simple = body.skin is not None or any(isinstance(s, TaperedCylinder) for s in body.surfaces)
        self.joined = np.eye(self.count + 1, dtype=bool)
        child = np.flatnonzero(body.tree.parents >= 0)
        a, b = self.group[child], self.group[body.tree.parents[child]]
        self.joined[a, b] = self.joined[b, a] = True
        own = np.zeros(len(mesh.vertices), np.int64)
        own[mesh.faces.ravel()] = np.repeat(self.label, 3)
        if anchors:
            self.anchor = spread_anchors(mesh.vertices, anchors, own)
            self.of = np.zeros(anchors, np.int64)
            self.of[self.anchor] = own
        else:
            self.anchor, self.of = own, np.arange(self.count)

    def lines(self, rim: Rim, drawn: Drawn) -> Lines:
        """Lines across a contour, with the parts inside and outside of it."""
        x, y = ((rim.outline[k] - at + 0.5) * drawn.scale + _LOOKUP_OFFSET_PX * rim.outline[2 + k]
                for k, at in enumerate((drawn.left, drawn.top)))  # fmt: skip
        i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        h, w = drawn.face.shape
        inside = (i >= 0) & (i < w) & (j >= 0) & (j < h)
        face = np.where(inside, drawn.face[np.clip(j, 0, h - 1), np.clip(i, 0, w - 1)], -1)
        beyond = np.where(rim.inner & (face >= 0), drawn.label[face], AROUND)
        return Lines(
            rim.outline, np.where(beyond >= 0, -1, self.anchor[rim.vertices[:, 0]]), self.group[rim.segment], beyond
        )


def spread_anchors(vertices: NDArray, count: int, part: NDArray | None = None) -> NDArray:
    """(V,) nearest of `count` anchors, spread over vertices (V, 3) [m] by farthest-point sampling.

    `part` (V,) int: anchors on other parts count as far away.
    """
    x = vertices
    if part is not None:
        size = float(np.ptp(vertices, axis=0).max())
        x = np.column_stack([vertices, 10.0 * size * np.eye(int(part.max(initial=0)) + 1)[part]])
    away = np.linalg.norm(x - x.mean(axis=0), axis=1)
    best, near = np.full(len(x), np.inf), np.zeros(len(x), np.int64)
    for k in range(min(count, len(x))):
        d = np.linalg.norm(x - x[int(np.argmax(away))], axis=1)
        near[d < best] = k
        away = best = np.minimum(best, d)
    return near


def _without_side(name: str) -> str:
    return name[:-2] if name.endswith(("_r", "_l")) else name
