"""Body parts in a colour image: the image drawn, limbs hidden by others, anchors of colours, seams of parts."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.rendering import Canvas
from kinefit.bodies.surfaces import BodyMesh, SkinnedMesh, TaperedCylinder
from kinefit.bodies.tree import KinematicTree
from kinefit.geometry.camera import Camera
from kinefit.geometry.losses import Loss
from kinefit.images import _kernels_regions as kernels
from kinefit.images.regions import Ratios
from kinefit.sensors.regions import _kernels_region_seams as seam_kernels
from kinefit.sensors.scene import Scene
from kinefit.solving.correspondences.contours.outlines import Rim, RimFinder, Window
from kinefit.solving.rows import DofRows

_MAX_LEVEL = 127  # of a stored log ratio, to either side of 0
# A stored band is an image whose colours are the numbers of levels, so that one kernel reads both.
_PALETTE = np.arange(32768, dtype=np.int32) % 256


@dataclass(frozen=True, eq=False)
class Coloured:
    """An image and the log ratio of each of its colours near each anchor.

    Parameters
    ----------
    image : (H, W, 3) uint8 RGB
    bins : (32768,) int32, see `colour_bins`
    ratios : Ratios
    """

    image: NDArray
    bins: NDArray
    ratios: Ratios

    def profiles(self, lines: Lines, drawn: Drawn, half: int, step: int, guard: float) -> NDArray:
        """(N, 2 half) log ratios along the normals of a contour, sampled every `step` [px]; see `kernels.profiles`."""
        out, r = np.empty((len(lines.anchor), 2 * half)), self.ratios
        kernels.profiles(
            self.image, self.bins, *r.packed, r.logs, lines.anchor, lines.outline, *drawn, lines.own, lines.beyond,
            half, step, guard, out,
        )  # fmt: skip
        return out


@dataclass(frozen=True, eq=False)
class Kept(Coloured):
    """A stored band of log ratios about a contour, in place of the image; unpacked on demand.

    Parameters
    ----------
    packed : bytes, (h, w) uint8 levels
    shape : (h, w)
    left, top : int [px] of the image
    """

    packed: bytes = b""
    shape: tuple[int, int] = (0, 0)
    left: int = 0
    top: int = 0

    @cached_property
    def _level_image(self) -> NDArray:
        levels = np.frombuffer(zlib.decompress(self.packed), np.uint8).reshape(self.shape)
        out = np.zeros((*self.shape, 3), np.uint8)
        out[..., 1], out[..., 2] = (levels >> 5) << 3, (levels & 31) << 3
        return out

    def profiles(self, lines: Lines, drawn: Drawn, half: int, step: int, guard: float) -> NDArray:
        """(N, 2 half) log ratios within the band, sampled every `step` [px]; 0 outside it."""
        moved = np.array(lines.outline)
        moved[:2] -= np.array([[self.left], [self.top]])
        there = drawn._replace(left=drawn.left - self.left, top=drawn.top - self.top)
        own = replace(lines, outline=moved, anchor=np.zeros_like(lines.anchor))
        out, r = np.empty((len(own.anchor), 2 * half)), self.ratios
        kernels.profiles(
            self._level_image, self.bins, *r.packed, r.logs, own.anchor, moved, *there, own.own, own.beyond, half, step,
            guard, out,
        )  # fmt: skip
        return out

    def __getstate__(self) -> dict[str, object]:
        return {k: v for k, v in self.__dict__.items() if k != "_level_image"}


def kept(seen: Coloured, lines: Lines, reach: int, most: float) -> Coloured:
    """The band of log ratios within `reach` [px] of a contour; `most` bounds a log ratio.

    Each pixel has the log ratio of the contour's nearest point, so that slightly shifted contours can read it, too.
    """
    height, width = seen.image.shape[:2]
    uv = np.rint(lines.outline[:2]).astype(np.int64)
    inside = (uv[0] >= 0) & (uv[0] < width) & (uv[1] >= 0) & (uv[1] < height)
    levels = Ratios.of_table(((np.arange(256) - _MAX_LEVEL) * (most / _MAX_LEVEL)).astype(np.float32)[None])
    none = np.zeros((1, 1, 3), np.uint8)
    if not inside.any():
        return Kept(none, _PALETTE, levels, zlib.compress(bytes([_MAX_LEVEL])), (1, 1), 0, 0)
    (u, v), number = uv[:, inside], np.flatnonzero(inside)
    left, top = max(int(u.min()) - reach, 0), max(int(v.min()) - reach, 0)
    crop = seen.image[top : int(v.max()) + reach + 1, left : int(u.max()) + reach + 1].astype(np.int32)
    away = np.ones(crop.shape[:2], np.uint8)
    away[v - top, u - left] = 0
    distance, label = cv2.distanceTransformWithLabels(away, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    of = np.zeros(int(label.max()) + 1, np.int64)
    of[label[v - top, u - left]] = number
    colour = ((crop[..., 0] >> 3) << 10) | ((crop[..., 1] >> 3) << 5) | (crop[..., 2] >> 3)
    value = np.zeros(crop.shape[:2])
    j, i = np.nonzero(distance <= reach)
    point, bins = of[label[j, i]], seen.bins[colour[j, i]]
    inner = lines.anchor[point] < 0
    ratio = seen.ratios.between(lines.own[point], lines.beyond[point], bins)
    ratio[~inner] = seen.ratios.at(lines.anchor[point[~inner]], bins[~inner])
    value[j, i] = ratio
    packed = np.rint(value * (_MAX_LEVEL / most) + _MAX_LEVEL).astype(np.uint8)
    return Kept(none, _PALETTE, levels, zlib.compress(packed.tobytes(), 1), packed.shape, left, top)


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


_MERGE_CELLS = 40  # along a body's longest side, in which vertices of a segment are merged: limbs are two wide
_RENDER_SIDE_PX = 112  # longer side of the rendering: a forearm at 3 m is four wide
_FIRST_SIGMA = 0.6  # [rad] of the first samples about a state
_FIRST_SAMPLES = 24  # about the state, and as many of the posture prior
_REFINED_POSES = 2
_REFINE_ROUNDS = 3
_REFINE_SAMPLES = 12  # in each round
_REFINE_SIGMA = 0.2  # [rad] of the first round
_SIGMA_DECAY = 0.6  # from round to round


class Limbs:
    """The limbs of one body: each child of the root, with all of its descendants.

    Parameters
    ----------
    body : Body
    mesh : of its skin
    label : (T,) part of the body that each face belongs to
    drawn : state of `random` to continue from; default: that of its seed

    Attributes
    ----------
    random : generator of the sampled poses
    """

    def __init__(
        self, body: Body, mesh: BodyMesh | SkinnedMesh, label: NDArray, drawn: Mapping[str, Any] | None = None
    ) -> None:
        tree, x = body.tree, mesh.vertices
        cell = ((x - x.min(axis=0)) / (float(np.ptp(x, axis=0).max()) / _MERGE_CELLS)).astype(np.int64)
        key = np.column_stack([mesh.segment, cell])
        _, first, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
        number = number.ravel()
        count = np.bincount(number)
        self._rest = np.array([np.bincount(number, x[:, k]) / count for k in range(3)]).T
        self._owner, faces = np.asarray(mesh.segment)[first], number[mesh.faces]
        solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        self._faces, self._label = np.ascontiguousarray(faces[solid], np.int32), np.ascontiguousarray(label[solid])
        self.body, root = body, np.arange(len(tree.segments))
        while (tree.parents[root] > 0).any():
            root = np.where(tree.parents[root] > 0, tree.parents[root], root)
        self.segments = [np.flatnonzero(root == s) for s in np.flatnonzero(tree.parents == 0)]
        self.coordinates = [np.flatnonzero(np.isin(tree.owners, limb)) for limb in self.segments]
        self._canvases: dict[tuple[int, int], Canvas] = {}
        self.random = np.random.default_rng(7)
        if drawn is not None:
            self.random.bit_generator.state = drawn

    def sought(self, limb: int, state: BodyState, others: list[BodyState], seen: Coloured, camera: Camera) -> BodyState:
        """The state of highest likelihood under changes of one limb.

        Parameters
        ----------
        limb : its number
        others : further states to try
        """
        tree, own = self.body.tree, self.coordinates[limb]
        lower, upper = np.maximum(tree.lower[own], -np.pi), np.minimum(tree.upper[own], np.pi)
        prior, spread = tree.usual[own], np.minimum(tree.spread[own], 1.5)
        now, R = state.angles[own], self.random
        pool = [now[None], *(o.angles[own][None] for o in others),
                now + _FIRST_SIGMA * R.normal(size=(_FIRST_SAMPLES, len(own))),
                prior + spread * R.normal(size=(_FIRST_SAMPLES, len(own)))]  # fmt: skip
        angles = np.clip(np.concatenate(pool), lower, upper)
        at = self._window(state, camera)
        worth = np.array([self._log_likelihood(state, own, a, seen, camera, at) for a in angles])
        best, top = now, float(worth[0])
        for k in np.argsort(-worth)[:_REFINED_POSES]:
            a, value, width = angles[k], float(worth[k]), _REFINE_SIGMA
            for _ in range(_REFINE_ROUNDS):
                tried = np.clip(a + width * R.normal(size=(_REFINE_SAMPLES, len(own))), lower, upper)
                values = [self._log_likelihood(state, own, t, seen, camera, at) for t in tried]
                j = int(np.argmax(values))
                if values[j] > value:
                    a, value = tried[j], values[j]
                width *= _SIGMA_DECAY
            if value > top:
                best, top = a, value
        return _with(state, own, best)

    def _window(self, state: BodyState, camera: Camera) -> Window:
        """The window about the body and all that its limbs can reach."""
        x = self._posed(state)
        middle, size = x.mean(axis=0), 0.6 * float(np.ptp(x, axis=0).max())
        corners = middle + size * (np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3))
        return Window.about(np.ascontiguousarray(np.nan_to_num(camera.project(corners))), camera, _RENDER_SIDE_PX)

    def _posed(self, state: BodyState) -> NDArray:
        f = self.body.tree.forward(state.T_world_root, state.angles)[0][self._owner]
        return (f[:, :9].reshape(-1, 3, 3) @ self._rest[:, :, None])[..., 0] + f[:, 9:]

    def _log_likelihood(
        self, state: BodyState, own: NDArray, angles: NDArray, seen: Coloured, camera: Camera, w: Window
    ) -> float:
        x = self._posed(_with(state, own, angles)) @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
        if w.size not in self._canvases:
            self._canvases[w.size] = Canvas(w.size)
        drawn = self._canvases[w.size].draw(x, self._faces, w.lens(camera))
        return kernels.likelihood(
            seen.image, seen.bins, seen.ratios.logs, drawn.face, self._label, w.left, w.top, w.scale
        )


def _with(state: BodyState, own: NDArray, angles: NDArray) -> BodyState:
    every = np.array(state.angles)
    every[own] = angles
    return BodyState(state.T_world_root, every)


_MAX_DEPTH_GAP = 0.02  # [m] between adjacent pixels of two parts that intersect
_MIN_SURFACE_SINE = 0.2  # of the angle between two surfaces: below it their intersection is not determined
_PIXEL_PAIRS_PER_POINT = 3  # along a seam
SEAM_SPACING_PX = 2.5  # of the rendering, between points of a seam: a pair of pixels is 0.71 to 1 px long
_MAX_SEAM_POINTS = 400  # in one image


@dataclass(frozen=True, eq=False)
class Seams:
    """Points of the seams of a body in one image, N.

    Parameters
    ----------
    lines : Lines that look along their normals
    segments : (N, 2) int
    points : (2, N, 3) [m] in each segment's frame, as its frame lies in the root's frame at rest
    pulls : (2, N, 3) [px/m] of both parts in the world
    at : (N, 3) [m] where the points were in the world
    """

    lines: Lines
    segments: NDArray
    points: NDArray
    pulls: NDArray
    at: NDArray

    def __len__(self) -> int:
        return len(self.at)

    @classmethod
    def found(cls, scene: Scene, finder: RimFinder, camera: Camera, drawn: Drawn, group: NDArray) -> Seams:
        """Find the seams of the body as last rendered, at a scene's state; group (S,) is the part of each segment."""
        pairs, vertices = np.empty((_MAX_SEAM_POINTS, 6)), np.ascontiguousarray(scene.pose.vertices)
        label = np.ascontiguousarray(drawn.label)
        n = seam_kernels.borders(
            drawn.face, finder.depth, finder.face_segment, label, _MAX_DEPTH_GAP, _PIXEL_PAIRS_PER_POINT, pairs
        )
        pairs = pairs[:n]
        at = np.array([drawn.left, drawn.top])
        uv = (pairs[:, 2:4] + 0.5) / drawn.scale - 0.5 + at
        middle = vertices[finder.faces[pairs[:, 0].astype(np.int64)]].mean(axis=1)
        outline, point, pulls = np.empty((4, n)), np.empty((n, 3)), np.empty((2, n, 3))
        rays = camera.ray(uv)
        far = np.sum((middle - camera.centre_world) * rays, axis=1)[:, None]
        n = seam_kernels.seams(
            camera.packed, vertices, finder.faces, pairs, uv, camera.centre_world + far * rays, _MIN_SURFACE_SINE,
            outline, point, pulls,
        )  # fmt: skip
        segments = finder.face_segment[pairs[:n, :2].astype(np.int64)]
        part = group[segments]
        lines = Lines(np.ascontiguousarray(outline[:, :n]), np.full(n, -1), part[:, 0], part[:, 1])
        local = np.stack([_local(scene, segments[:, k], point[:n]) for k in (0, 1)])
        return cls(lines, segments, local, pulls[:, :n], point[:n])

    def rows(self, scene: Scene, off: NDArray, weight: NDArray, loss: Loss) -> DofRows:
        """One row a point: the seam should lie `off` (N,) [px] further along its normal; weight (N,) [1/px²]."""
        frames, tree, state = scene.frames, scene.body.tree, scene.state
        _, screws = tree.forward(state.T_world_root, state.angles)
        J, moved = np.zeros((len(self), tree.n_dofs)), np.zeros(len(self))
        for k in (0, 1):
            f, s = frames[self.segments[:, k]], self.segments[:, k]
            x = np.einsum("nij,nj->ni", f[:, :9].reshape(-1, 3, 3), self.points[k]) + f[:, 9:]
            moved += np.sum(self.pulls[k] * (x - self.at), axis=1)
            wrench = np.concatenate([self.pulls[k], np.cross(x - state.T_world_root[:3, 3], self.pulls[k])], axis=1)
            J[:, :6] += wrench
            J[:, 6:] += (wrench @ screws.T) * _moved_by(tree)[s]
        size = np.linalg.norm(self.pulls.sum(axis=0), axis=1)
        return DofRows(J / size[:, None], (off - moved) / size, weight * size**2, np.arange(len(self)), loss)


def _local(scene: Scene, segment: NDArray, x: NDArray) -> NDArray:
    f = scene.frames[segment]
    return np.einsum("nji,nj->ni", f[:, :9].reshape(-1, 3, 3), x - f[:, 9:])


@lru_cache(maxsize=8)
def _moved_by(tree: KinematicTree) -> NDArray:
    """(S, D) 1 if a coordinate moves a segment, else 0."""
    out = np.zeros((len(tree.segments), tree.n_dofs - 6))
    for s, last in enumerate(tree.last_dof):
        chain = tree.chain[last, : tree.depth[last] + 1]
        out[s, chain[chain >= 6] - 6] = 1.0
    return out
