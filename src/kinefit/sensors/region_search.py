"""Where a body may be that colours alone show: its silhouette sought in a small map of log ratios (P3, eq. 8).

With p₁, p₂ fixed the energy (8) of a pose is, but for a constant, minus the sum of log p₁ / p₂ over its silhouette. So
a pose costs one small drawing of a coarse mesh. Places are found by correlation of the silhouette at some rotations
with the map; the best of them are improved by drawing poses at random around them, closer and closer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import BodyState
from kinefit.geometry import se3
from kinefit.images import _kernels_regions as kernels
from kinefit.rendering import NEAR

_CELLS = 14  # of a grid about the body in which vertices are merged


@dataclass(frozen=True)
class SearchSettings:
    """How a body is sought.

    Parameters
    ----------
    side : float [cells] of the map, length of the body in it
    rotations : int, tried with all places
    best : int, of these that are improved
    rounds, draws : int, how often, and with how many poses each
    keep : int, of each round's poses the next one is drawn around
    starts : int, that are handed out
    doubt : float, share of what the body could explain by which one standard deviation off the prediction is worse
    """

    side: float = 28.0
    rotations: int = 24
    best: int = 4
    rounds: int = 4
    draws: int = 40
    keep: int = 5
    starts: int = 3
    doubt: float = 0.004


class Seeker:
    """A coarse mesh of a body with room to draw it.

    Parameters
    ----------
    vertices, faces : (V, 3), (T, 3) of the body at rest
    """

    def __init__(self, vertices: NDArray, faces: NDArray) -> None:
        self.merged, self.count, self.faces = coarse(vertices, faces)
        #: [m] from end to end
        self.size = float(np.ptp(vertices, axis=0).max())
        self._number = np.bincount(self.merged, minlength=self.count)
        self._room = np.empty((6, self.count))
        self._canvases: dict[tuple[int, int], tuple[NDArray, NDArray]] = {}

    def posed(self, vertices: NDArray) -> NDArray:
        """(C, 3) of the coarse mesh, from the vertices (V, 3) of the fine one."""
        sums = [np.bincount(self.merged, vertices[:, k], self.count) for k in range(3)]
        return np.ascontiguousarray((np.array(sums) / self._number).T)

    def explained(self, x: NDArray, poses: NDArray, lens: NDArray, ratios: NDArray) -> tuple[NDArray, NDArray]:
        """Sums (M,) of log ratios inside of the silhouettes of M poses (M, 4, 4), and the face drawn last."""
        size = ratios.shape
        if size not in self._canvases:
            self._canvases = {size: (np.empty(size, np.float32), np.empty(size, np.int32))}
        out = np.empty(len(poses))
        kernels.explained(x, self.faces, poses, lens, ratios, self._room, *self._canvases[size], out)
        return out, self._canvases[size][1]


def coarse(vertices: NDArray, faces: NDArray) -> tuple[NDArray, int, NDArray]:
    """For every vertex its cell (V,), how many cells there are, and the faces (T', 3) between different cells."""
    low, size = vertices.min(axis=0), np.ptp(vertices, axis=0).max() / _CELLS
    _, merged = np.unique(((vertices - low) / size).astype(np.int64), axis=0, return_inverse=True)
    merged = merged.ravel()
    f = merged[faces]
    f = f[(f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])]
    f = f[np.unique(np.sort(f, axis=1), axis=0, return_index=True)[1]]
    return merged, int(merged.max()) + 1, np.ascontiguousarray(f, np.int32)


@lru_cache(maxsize=8)
def _draws(count: int, dimensions: int) -> NDArray:
    """(count, dimensions) normal numbers, the same ones every time, the first of them zero."""
    out = np.random.default_rng(7).normal(size=(count, dimensions))
    out[0] = 0.0
    return out


def seek(
    seeker: Seeker, x_camera: NDArray, ratio_map: NDArray, lens: NDArray, spread: NDArray, s: SearchSettings
) -> tuple[NDArray, NDArray]:
    """Motions (K, 4, 4) of a body in the camera's frame under which its silhouette explains a map best.

    Parameters
    ----------
    x_camera : (C, 3) [m] the coarse mesh where it is expected
    ratio_map : (h, w) log ratios
    lens : (5,) fx, fy, cx, cy [cells] of the map, and the nearest depth [m] drawn
    spread : (6,) one standard deviation of where it is expected: along the camera's axes [m], about them [rad]

    Returns
    -------
    motions (K, 4, 4), and what each explains (K,) as a share of all that is the body's colour; the first is the best
    """
    middle = x_camera.mean(axis=0)
    x = np.ascontiguousarray(x_camera - middle)
    whole = max(float(np.maximum(ratio_map, 0.0).sum()), 1e-9)

    def score(p: NDArray) -> NDArray:
        sums, _ = seeker.explained(x, poses(p), lens, ratio_map)
        return sums / whole - s.doubt * np.sum((p / spread) ** 2, axis=1)

    def poses(p: NDArray) -> NDArray:
        out = np.tile(np.eye(4), (len(p), 1, 1))
        out[:, :3, :3] = se3.exp_so3(p[:, 3:])
        out[:, :3, 3] = middle + p[:, :3]
        return out

    first = np.zeros((s.rotations, 6))
    first[:, 3:] = _draws(s.rotations, 3) * spread[3:]
    found = [np.zeros((1, 6))]
    for p in first:
        _, face = seeker.explained(x, poses(p[None]), lens, ratio_map)
        rows, cols = np.flatnonzero((face >= 0).any(axis=1)), np.flatnonzero((face >= 0).any(axis=0))
        if not len(rows):
            continue
        mask = (face[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] >= 0).astype(np.float32)
        match = cv2.matchTemplate(ratio_map.astype(np.float32), mask, cv2.TM_CCORR)
        j, i = np.mgrid[: match.shape[0], : match.shape[1]]
        dx, dy = (i - cols[0]) * middle[2] / lens[0], (j - rows[0]) * middle[2] / lens[1]
        match = match / whole - s.doubt * ((dx / spread[0]) ** 2 + (dy / spread[1]) ** 2)
        k = int(np.argmax(match))
        q = p.copy()
        q[0], q[1] = dx.flat[k], dy.flat[k]
        found.append(q[None])
    pool = np.concatenate(found)
    value = score(pool)
    order = np.argsort(-value)[: s.best]
    width = np.minimum(0.5 * spread, [*(2.0 * middle[2] / lens[:2]), 0.05 * middle[2], 0.3, 0.3, 0.3])
    ends, worth = [], []
    draws = _draws(s.draws, 6)
    for k in order:
        centre, sigma = pool[k], np.array(width)
        best, top = centre, value[k]
        for _ in range(s.rounds):
            tried = centre + draws * sigma
            v = score(tried)
            chosen = np.argsort(-v)[: s.keep]
            if v[chosen[0]] > top:
                best, top = tried[chosen[0]], float(v[chosen[0]])
            centre, sigma = best, 0.6 * sigma
        ends.append(best)
        worth.append(top)
    order = np.argsort(-np.array(worth))[: s.starts]
    out = poses(np.array(ends)[order])
    back = np.eye(4)
    back[:3, 3] = -middle
    return out @ back, np.array(worth)[order]


def moved(state: BodyState, T_camera_world: NDArray, motion: NDArray) -> BodyState:
    """A state moved as a whole by a motion (4, 4) in a camera's frame."""
    T = np.linalg.inv(T_camera_world) @ motion @ T_camera_world @ state.T_world_root
    return BodyState(T, state.angles)


def lens_of(matrix: NDArray, left: int, top: int, step: int) -> NDArray:
    """(5,) fx, fy, cx, cy of a map whose cells of `step` pixels begin at a pixel, and the nearest depth drawn."""
    half = 0.5 * (step - 1)
    return np.array(
        [matrix[0, 0] / step, matrix[1, 1] / step, (matrix[0, 2] - left - half) / step,
         (matrix[1, 2] - top - half) / step, NEAR]
    )  # fmt: skip
