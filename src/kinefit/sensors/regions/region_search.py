"""Searches with regions: first poses from the image alone, and limbs that were lost.

With p₁, p₂ fixed the energy (8) of a pose is, up to a constant, minus the sum of log p₁ / p₂ over its silhouette. So a
pose costs one small rendering of a coarse mesh. Correlation of the silhouette at some rotations with the map gives
positions; random samples around the best of them, with a sigma that shrinks, refine these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.motion import BELIEVED
from kinefit.bodies.rendering import MIN_Z
from kinefit.bodies.surfaces import segment_middles
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.images import _kernels_regions as kernels
from kinefit.images.regions import SearchSettings
from kinefit.sensors.evidence import Evidence
from kinefit.sensors.regions.region_parts import Coloured, Limbs
from kinefit.sensors.scene import Scene
from kinefit.sensors.settings import TrackSettings
from kinefit.solving.correspondences import point_rows
from kinefit.solving.correspondences.points import prediction_rows
from kinefit.solving.equations import inverse
from kinefit.solving.least_squares import levenberg_marquardt

_MERGE_CELLS = 14  # of a grid about the body in which vertices are merged: two cells of the map each
_SIGMA_DECAY = 0.6  # of the samples, from round to round
_MIN_SIGMA = (0.05, 0.05)  # [lengths of the body], [rad] of the prediction
_MAX_SIGMA = (2.0, 1.0)  # [lengths of the body], [rad] of the prediction
_SEARCH_SIGMAS = 3.0  # of the prediction, which the map covers


class Seeker:
    """A coarse mesh of a body with buffers to render it.

    Parameters
    ----------
    vertices, faces : (V, 3) [m], (T, 3) of the body at rest

    Attributes
    ----------
    size : float [m] from end to end
    """

    def __init__(self, vertices: NDArray, faces: NDArray) -> None:
        self.size = float(np.ptp(vertices, axis=0).max())
        cells = ((vertices - vertices.min(axis=0)) / (self.size / _MERGE_CELLS)).astype(np.int64)
        self._cell = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
        self._number = np.bincount(self._cell)
        f = self._cell[faces]
        f = f[(f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])]
        f = f[np.unique(np.sort(f, axis=1), axis=0, return_index=True)[1]]
        self._faces, self._room = np.ascontiguousarray(f, np.int32), np.empty((6, len(self._number)))

    def posed(self, vertices: NDArray) -> NDArray:
        """(C, 3) [m] vertices of the coarse mesh, from the vertices (V, 3) [m] of the fine one."""
        sums = [np.bincount(self._cell, vertices[:, k], len(self._number)) for k in range(3)]
        return np.ascontiguousarray((np.array(sums) / self._number).T)

    def explained(self, x: NDArray, poses: NDArray, lens: NDArray, ratios: NDArray) -> tuple[NDArray, NDArray]:
        """Sums (M,) of log ratios inside the silhouettes of M poses (M, 4, 4), and the faces (h, w) rendered last."""
        depth, face = np.empty(ratios.shape, np.float32), np.empty(ratios.shape, np.int32)
        out = np.empty(len(poses))
        kernels.explained(x, self._faces, poses, lens, ratios, self._room, depth, face, out)
        return out, face


def region_starts(
    scene: Scene, camera: Camera, seeker: Seeker, seen: Coloured, information: NDArray | None, evidence: Evidence,
    s: SearchSettings, *, rigid: bool = True,
) -> list[BodyState]:  # fmt: skip
    """Alternative start states, the best first; none if the body is at its prediction.

    Parameters
    ----------
    scene : with the body at its prediction
    seen : Coloured image, with the log ratio of each bin of colours
    information : (n, n) of the prediction; None without one
    evidence : of the image on the state that the fit found from the prediction
    rigid : whether the body is rigid; a jointed one is searched for only if it is lost as a whole
    """
    agreeing, contrary = evidence.agreeing.sum(), evidence.contrary.sum()
    right = agreeing >= s.poor * (agreeing + contrary)
    if right and not rigid:
        return []
    R, t = camera.T_camera_world[:3, :3], camera.T_camera_world[:3, 3]
    x, size, spread = seeker.posed(scene.pose.vertices), seeker.size, np.full(6, np.inf)
    if information is not None:
        arm = se3.hat(scene.state.T_world_root[:3, 3] - x.mean(axis=0))
        J = np.block([[R, R @ arm], [np.zeros((3, 3)), R]])
        spread = np.sqrt(np.diag(J @ inverse(information)[:6, :6] @ J.T))
    rough = rigid and (spread[:3].max() > s.far * size or spread[3:].max() > s.turn)
    if right and not rough:
        return []
    x = x @ R.T + t
    if x[:, 2].min() < MIN_Z:
        return []
    low, high = (np.repeat([length * size, angle], 3) for length, angle in (_MIN_SIGMA, _MAX_SIGMA))
    spread = np.clip(spread, low, high)
    scale = camera.matrix[0, 0] / float(x[:, 2].mean())  # [px/m]
    step = max(round(size * scale / s.side), 1)
    uv, reach = camera.project(scene.pose.vertices), (_SEARCH_SIGMAS * spread[:2].max() + 0.25 * size) * scale
    first = np.clip(np.floor(np.nanmin(uv, axis=0) - reach), 0, camera.size).astype(int)
    last = np.clip(np.ceil(np.nanmax(uv, axis=0) + reach), 0, camera.size).astype(int)
    wide, tall = (last - first) // step
    if wide < 2 or tall < 2:
        return []
    cells, (left, top) = np.empty((tall, wide)), (int(first[0]), int(first[1]))
    kernels.ratio_map(seen.image, seen.bins, seen.ratios.whole, left, top, step, cells)
    K, half = camera.matrix, 0.5 * (step - 1)
    lens = np.array([K[0, 0] / step, K[1, 1] / step, (K[0, 2] - left - half) / step, (K[1, 2] - top - half) / step,
                     MIN_Z])  # fmt: skip
    T = camera.T_camera_world
    moved = [np.linalg.inv(T) @ m @ T @ scene.state.T_world_root for m in seek(seeker, x, cells, lens, spread, s)]
    return [BodyState(T_world_root, scene.state.angles) for T_world_root in moved]


def seek(
    seeker: Seeker, x_camera: NDArray, ratios: NDArray, lens: NDArray, spread: NDArray, s: SearchSettings
) -> NDArray:
    """Motions (K, 4, 4) of a body in the camera's frame whose silhouettes have the largest log ratios, best first.

    Parameters
    ----------
    x_camera : (C, 3) [m] the coarse mesh at its prediction
    ratios : (h, w) log ratios
    lens : (5,) fx, fy, cx, cy [cells] of the map, and the nearest depth [m] rendered
    spread : (6,) standard deviations of the prediction: along the camera's axes [m], about them [rad]
    """
    middle = x_camera.mean(axis=0)
    x = np.ascontiguousarray(x_camera - middle)
    whole = max(float(np.maximum(ratios, 0.0).sum()), 1e-9)

    def poses(p: NDArray) -> NDArray:
        return se3.transform(se3.exp_so3(p[:, 3:]), middle + p[:, :3])

    def value(p: NDArray) -> NDArray:
        sums, _ = seeker.explained(x, poses(p), lens, ratios)
        return np.asarray(sums / whole - s.doubt * np.sum((p / spread) ** 2, axis=1))

    turned = np.zeros((s.rotations, 6))
    turned[:, 3:] = _draws(s.rotations, 3) * spread[3:]
    found, small = [np.zeros(6)], ratios.astype(np.float32)
    for p in turned:
        _, face = seeker.explained(x, poses(p[None]), lens, ratios)
        rows, cols = np.flatnonzero((face >= 0).any(axis=1)), np.flatnonzero((face >= 0).any(axis=0))
        if not len(rows):
            continue
        mask = (face[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] >= 0).astype(np.float32)
        match = cv2.matchTemplate(small, mask, cv2.TM_CCORR)
        dx = (np.arange(match.shape[1]) - cols[0]) * middle[2] / lens[0]
        dy = (np.arange(match.shape[0]) - rows[0]) * middle[2] / lens[1]
        far = (dx / spread[0]) ** 2 + ((dy / spread[1]) ** 2)[:, None]
        j, i = np.unravel_index(int(np.argmax(match / whole - s.doubt * far)), match.shape)
        found.append(p + np.array([dx[i], dy[j], 0, 0, 0, 0]))
    pool = np.array(found)
    values = value(pool)
    cell = 2.0 * middle[2] / lens[0]
    width = np.minimum(0.5 * spread, [cell, cell, 0.05 * middle[2], 0.3, 0.3, 0.3])
    ends = [_improved(value, pool[k], float(values[k]), width, s) for k in np.argsort(-values)[: s.best]]
    ends.sort(key=lambda end: -end[1])
    return np.asarray(poses(np.array([p for p, _ in ends[: s.starts]])) @ se3.transform(np.eye(3), -middle))


def _improved(
    value: Callable[[NDArray], NDArray], p: NDArray, best: float, width: NDArray, s: SearchSettings
) -> tuple[NDArray, float]:
    """The best of random poses around one (6,), with a width that shrinks each round, and its value."""
    draws = _draws(s.draws, 6)
    for _ in range(s.rounds):
        tried = p + draws * width
        values = value(tried)
        k = int(np.argmax(values))
        if values[k] > best:
            p, best = tried[k], float(values[k])
        width = _SIGMA_DECAY * width
    return p, best


@lru_cache(maxsize=8)
def _draws(count: int, dimensions: int) -> NDArray:
    """(count, dimensions) normal samples, the same in every call, the first of them zero."""
    out = np.random.default_rng(7).normal(size=(count, dimensions))
    out[0] = 0.0
    return out


class Starts:
    """Searches of one sensor for a body and its limbs, which take turns.

    Parameters
    ----------
    scene : Scene with the body
    label : (T,) part of the body that each face of its skin belongs to
    settings : TrackSettings
    searches : number and time [s] of the latest search for a limb, and its random state; written in place
    """

    def __init__(self, scene: Scene, label: NDArray, settings: TrackSettings, searches: dict[str, Any]) -> None:
        self._body, self._mesh, self._label = scene.body, scene.surface.morphing.mesh, label
        self._jointed = len(scene.body.tree.segments) > 1
        self._settings, self._searches = settings, searches

    @cached_property
    def _seeker(self) -> Seeker:
        return Seeker(self._mesh.vertices, self._mesh.faces)

    @cached_property
    def _flips(self) -> Flips:
        tree, mesh = self._body.tree, self._mesh
        return Flips(self._body, segment_middles(mesh.vertices, mesh.segment, len(tree.segments)) - tree.rest)

    @cached_property
    def _limbs(self) -> Limbs:
        return Limbs(self._body, self._mesh, self._label, self._searches.get("random"))

    def whole(
        self, scene: Scene, camera: Camera, seen: Coloured, information: NDArray | None, evidence: Evidence
    ) -> list[BodyState]:
        """Start states of the whole body; information (n, n) of the prediction, see `region_starts`."""
        return region_starts(
            scene, camera, self._seeker, seen, information, evidence, self._settings.regions.search,
            rigid=not self._jointed,
        )  # fmt: skip

    def limbs(
        self, scene: Scene, camera: Camera, seen: Coloured, information: NDArray, evidence: Evidence, found: BodyState,
        time: float,
    ) -> list[BodyState]:  # fmt: skip
        """Start states of limbs, at most every `TrackSettings.search_every`: mirrored ones, and one by search.

        The searches take turns, among the lost limbs if there are any.

        Parameters
        ----------
        information : (n, n) of the prediction
        evidence : on the state `found` by the fit
        time : float [s]
        """
        limbs, flips, s, last = self._limbs, self._flips, self._settings, self._searches
        if not limbs.segments or abs(time - last.get("time", -np.inf)) < s.search_every - 1e-6:
            return []
        last["time"], last["number"] = time, last.get("number", 0) + 1
        poor = [k for k, limb in enumerate(limbs.segments) if (evidence.quality[limb] < BELIEVED).any()]
        turns = poor or range(len(limbs.segments))
        limb = turns[last["number"] % len(turns)]
        near = flips.near(scene.state, information, found, camera)[: s.regions.flips]
        sought = limbs.sought(limb, found, list(flips.of(found, camera)), seen, camera)
        last["random"] = limbs.random.bit_generator.state
        leapt = [sought] if np.abs(sought.angles - found.angles).max() > 0.0 else []
        return [*near, *leapt, *flips.untwisted(found, limbs.segments[limb])]


_MIN_FLIP_SHIFT = 0.06  # [m] of a mirrored end: with less both states converge to the same
_MAX_FLIP_MISS = 0.03  # [m] of an end from its mirrored position, which joint limits may exclude
_FLIP_END_SIGMA = 0.005  # [m] of the ends' positions in the fit that flips a limb
_FREE_SIGMA = 3.0  # [rad] or [m] of the flipped limb's coordinates
_FIXED_SIGMA = 1e-3  # [rad] or [m] of all other coordinates
_MAX_SQUARED_MAHALANOBIS = 30.0  # of a flip from the prediction
_MIN_TWIST_AXIS_COSINE = 0.9  # of a joint axis with the segment's own axis
_MIN_TWIST = 0.4  # [rad] from the default, that is worth a trial
_MAX_FLIP_ITERATIONS = 10  # of the fit that flips a limb


class Flips:
    """Mirrored states of one body's limbs: all segments but the root.

    Parameters
    ----------
    body : Body
    middle : (S, 3) [m] of each segment's surface, in its own frame: the end of a segment without children
    """

    def __init__(self, body: Body, middle: NDArray) -> None:
        tree, ends = body.tree, np.array(middle)
        self.body, self._limbs = body, [np.flatnonzero(tree.parents == s) for s in range(len(tree.segments))]
        for s, children in enumerate(self._limbs):
            if len(children):
                ends[s] = np.mean(tree.rest[children] - tree.rest[s], axis=0)
        count = np.arange(len(tree.segments))
        self._ends = PointSet(tuple(tree.segments), count, ends)
        self._joints = PointSet(tuple(tree.segments), count, np.zeros_like(ends))

    def near(self, predicted: BodyState, information: NDArray, state: BodyState, camera: Camera) -> list[BodyState]:
        """Mirrored states that the prediction, of information (n, n), allows, in order of decreasing likelihood."""
        out = []
        for other in self.of(state, camera):
            off = predicted.difference(other)
            square = float(off @ information @ off)
            if square < _MAX_SQUARED_MAHALANOBIS:
                out.append((square, other))
        return [other for _, other in sorted(out, key=lambda pair: pair[0])]

    def untwisted(self, state: BodyState, limb: NDArray) -> list[BodyState]:
        """The state with the twist of a limb's last segment reset to the default, if it is large.

        The twist of a round limb is hardly observed, and may drift to its joint limit.

        Parameters
        ----------
        limb : (L,) int, segments
        """
        tree, out = self.body.tree, []
        for s in limb:
            if len(self._limbs[s]):
                continue
            along = self._ends.points[s] / max(float(np.linalg.norm(self._ends.points[s])), 1e-9)
            for d in range(tree.dof_start[s], tree.dof_start[s + 1]):
                twisted = abs(state.angles[d] - tree.usual[d]) > _MIN_TWIST
                if abs(tree.axes[d] @ along) > _MIN_TWIST_AXIS_COSINE and twisted:
                    angles = np.array(state.angles)
                    angles[d] = tree.usual[d]
                    out.append(BodyState(state.T_world_root, angles))
        return out

    def of(self, state: BodyState, camera: Camera) -> Iterator[BodyState]:
        """States with one segment mirrored in depth, its descendants shifted with it or mirrored as well."""
        joints, ends = self.body.positions(state, self._joints), self.body.positions(state, self._ends)
        ray = joints - camera.centre_world
        ray /= np.linalg.norm(ray, axis=1)[:, None]
        shift = -2.0 * np.sum((ends - joints) * ray, axis=1)[:, None] * ray
        leans = np.linalg.norm(shift, axis=1) > _MIN_FLIP_SHIFT
        for s in np.flatnonzero(leans & (self.body.tree.parents >= 0)):
            below = self._below(int(s))
            targets = np.array(ends)
            targets[[int(s), *below]] += shift[s]
            yield from self._turned(state, int(s), below, targets)
            if len(below) and leans[below].any():
                targets = targets.copy()
                for t in below:
                    targets[[t, *self._below(t)]] += shift[t]
                yield from self._turned(state, int(s), below, targets)

    def _below(self, s: int) -> list[int]:
        return [t for child in self._limbs[s] for t in (int(child), *self._below(int(child)))]

    def _turned(self, state: BodyState, s: int, below: list[int], ends: NDArray) -> Iterator[BodyState]:
        """The state fitted to moved ends (S, 3) [m] of a limb, if its joints can reach them."""
        tree, limb, above = self.body.tree, [s, *below], tree_path(self.body, s)
        free = np.concatenate([np.zeros(6, bool), np.isin(tree.owners, [*limb, *above])])
        sigma = np.where(free, _FREE_SIGMA, _FIXED_SIGMA)
        targets = np.full_like(ends, np.nan)
        targets[[*limb, *above]] = ends[[*limb, *above]]
        found = levenberg_marquardt(
            self.body, state,
            lambda at: [point_rows(self.body, at, self._ends, targets, sigma=_FLIP_END_SIGMA),
                        prediction_rows(self.body, at, state, sigma=sigma)],
            max_iterations=_MAX_FLIP_ITERATIONS, tolerance=1e-2,
        ).state  # fmt: skip
        away = np.linalg.norm(self.body.positions(found, self._ends) - ends, axis=1)
        if away[[*limb, *above]].max() < _MAX_FLIP_MISS:
            yield found


def tree_path(body: Body, s: int) -> list[int]:
    """Segments between one and the root, both excluded."""
    out, p = [], int(body.tree.parents[s])
    while p >= 0 and body.tree.parents[p] >= 0:
        out.append(p)
        p = int(body.tree.parents[p])
    return out
