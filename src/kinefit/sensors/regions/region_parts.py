"""Parts of a body that have colours of their own (skin, shirt, trousers), and which of them a contour lies between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.surfaces import BodyMesh, SkinnedMesh, TaperedCylinder
from kinefit.correspondences.contours.rims import Rim

AROUND, OTHER = -1, -2  # labels of what is around the body, and of what is neither that nor the body
_BESIDE = 1.0  # [px] of the drawing from a contour to what is beyond it


class Drawn(NamedTuple):
    """A body as it was drawn, as kernels take it; see `kernels.count`.

    Parameters
    ----------
    face : (h, w) int32 triangle of every pixel of a window; -1 where there is none, -2 where something else is
    label : (T,) int part of each triangle
    left, top, scale : [px], [px] of the image, [px] of the window in one of the image
    joined : (G + 1, G + 1) bool, parts that lines may pass between; the last one is what is around the body
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
    anchor : (N,) int place of the surface whose statistic they have; -1 where the body itself lies beyond
    own, beyond : (N,) int part of the body on the inside and on the outside, `AROUND` for none
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
    anchors : int, places of the surface with statistics of their own; each lies on one part
    apart : whether segments are parts

    Attributes
    ----------
    group : (S,) int part of each segment
    count : int, number of parts
    label : (T,) int part of each triangle
    joined : see `Drawn`
    anchor : (V,) int place of each vertex
    of : (A,) int part of each place
    simple : whether the surface is one of simple shapes or of a model, and no mesh of the very body: seams between its
        segments are not where clothes end (beside them joints of the balancing trial are 12 mm from where silhouettes
        have them, without 8)
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
        """What the lines of a contour are compared with; where it is drawn before another part, both parts."""
        x, y = ((rim.outline[k] - at + 0.5) * drawn.scale + _BESIDE * rim.outline[2 + k]
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
    """(V,) the nearest of some vertices that are spread over all of them, each as far from the others as can be.

    `part` (V,) int: one on another part counts as far away.
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
