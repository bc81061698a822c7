"""Re-identify lost points of a surface when a body's motion brings them back into view (P4-11).

A lost point is stored with its position on the nearest segment and its appearance in every view. In later frames the
segment's pose predicts its image point, and the rotation and foreshortening of its window.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.motion import Motion
from kinefit.bodies.surfaces.places import nearest_lines
from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry.spline_image import SplineImage

_MAX_DISTANCE = 0.05  # [m] of a point from the body
_MIN_FACING_COSINE = 0.25  # of the angle between surface normal and ray, in each camera
_MEMORY_S = 5.0  # time for which a lost point is stored
_WINDOW_MARGIN_PX = 8  # between windows of a mosaic, so that the spline of one ignores the next
_MIN_PROJECTED_AREA = 1.0  # [px²/m²] of the surface in the image; smaller is seen edge-on
_MAP_STEP = 1e-3  # [m] on the surface, for the derivative of the projection


@dataclass(frozen=True, eq=False)
class Expected:
    """Predicted image points of lost points in one frame.

    Parameters
    ----------
    index : (K,) int, among the stored points
    ids : (K,) int
    mosaics : one image per camera with the windows of all points
    at : (K, C, 2) [px] positions in the mosaics
    uv : (K, C, 2) [px] predicted image points
    maps : (K, C, 2, 2) from the mosaic to the image
    between : (K, C - 1, 2, 2) from the first image to each other one
    """

    index: NDArray
    ids: NDArray
    mosaics: list[SplineImage]
    at: NDArray
    uv: NDArray
    maps: NDArray
    between: NDArray


@dataclass(frozen=True)
class PointReturn:
    """The frames in which one point is lost, expected and found again.

    Parameters
    ----------
    point : id of the point
    lost : first frame without it
    expected : first later frame in which the motion brings it into view of all cameras; None for none
    found : frame in which it was found again; None for none so far
    """

    point: int
    lost: int
    expected: int | None
    found: int | None = None


class Vanished:
    """Stores lost points of a body and predicts where they return; `returns` lists them in the order of loss.

    Parameters
    ----------
    rig : C cameras
    motion : of the body, in the rig's world
    window : side [px] of the matching windows
    """

    def __init__(self, rig: Rig, motion: Motion, window: int) -> None:
        self.rig, self.motion = rig, motion
        self._side = window + 2 * _WINDOW_MARGIN_PX + 1
        C = len(rig)
        self._ids, self._segment, self._since = (np.zeros(0, np.int64) for _ in range(3))
        self._rest, self._normal = np.zeros((0, 3)), np.zeros((0, 3))
        self._inside, self._axes = np.zeros((0, C, 2)), np.zeros((0, C, 2, 2))
        self._crops = np.zeros((0, C, self._side, self._side), np.float32)
        self.returns: list[PointReturn] = []

    def __len__(self) -> int:
        return len(self._ids)

    def remember(self, frame: int, ids: NDArray, x_world: NDArray, uv: NDArray, images: list[SplineImage]) -> None:
        """Store points `ids` (N,) last found in a frame, at x_world (N, 3) [m] and uv (N, C, 2) [px] of its images.

        Points that are missing in a camera or not on the body are discarded.
        """
        if not (0 <= frame < len(self.motion)) or not len(ids):
            return
        frames = self._segment_frames(frame)
        _, normal, segment = nearest_lines(self.motion.body, frames, np.ascontiguousarray(x_world.T), _MAX_DISTANCE)
        kept = np.flatnonzero((segment >= 0) & np.isfinite(uv).all(axis=(1, 2)))
        R, t = self._poses_of(frames, segment[kept])
        rest = np.einsum("nji,nj->ni", R, x_world[kept] - t)
        normals = np.einsum("nji,nj->ni", R, normal.T[kept])
        corner = np.floor(uv[kept]).astype(int) - self._side // 2
        crops = np.stack([[_crop(image.grey, corner[n, c], self._side) for c, image in enumerate(images)]
                          for n in range(len(kept))]) if len(kept) else self._crops[:0]  # fmt: skip
        _, axes = self._project(frames, segment[kept], rest, normals)
        parts = (
            ("_ids", ids[kept]), ("_segment", segment[kept]), ("_since", np.full(len(kept), frame)), ("_rest", rest),
            ("_normal", normals), ("_inside", uv[kept] - corner), ("_axes", axes), ("_crops", crops),
        )  # fmt: skip
        for name, values in parts:
            setattr(self, name, np.concatenate([getattr(self, name), values]))
        self._predict_returns(frame + 1, np.arange(len(self) - len(kept), len(self)))

    def _visible(self, frame: int, index: NDArray) -> tuple[NDArray[np.bool_], NDArray, NDArray]:
        """(N,) bool: which stored points all cameras see in a frame; and the result of `_project` for them."""
        frames, segment, rest = self._segment_frames(frame), self._segment[index], self._rest[index]
        uv, axes = self._project(frames, segment, rest, self._normal[index])
        R, t = self._poses_of(frames, segment)
        x = np.einsum("nij,nj->ni", R, rest) + t
        normal = np.einsum("nij,nj->ni", R, self._normal[index])
        is_visible = np.isfinite(uv).all(axis=(1, 2)) & np.isfinite(axes).all(axis=(1, 2, 3))
        half = 0.5 * self._side
        for c, camera in enumerate(self.rig):
            ray = camera.centre_world - x
            is_visible &= np.einsum("ni,ni->n", normal, ray) > _MIN_FACING_COSINE * np.linalg.norm(ray, axis=1)
            is_visible &= ((uv[:, c] > half) & (uv[:, c] < np.array(camera.size) - half)).all(axis=1)
        for seen in (self._axes[index], axes):
            is_visible &= (np.abs(np.linalg.det(seen)) > _MIN_PROJECTED_AREA).all(axis=1)
        return is_visible, uv, axes

    def _predict_returns(self, lost: int, index: NDArray) -> None:
        """Append to `returns` the points (N,) lost in a frame, with the frame in which the motion brings them back."""
        first = np.full(len(index), -1)
        for frame in range(lost, min(len(self.motion), lost + int(_MEMORY_S * self.motion.rate) + 1)):
            pending = np.flatnonzero(first < 0)
            if not len(pending):
                break
            first[pending[self._visible(frame, index[pending])[0]]] = frame
        self.returns += [PointReturn(int(self._ids[i]), lost, int(f) if f >= 0 else None) for i, f in zip(index, first)]

    def expected(self, frame: int) -> Expected | None:
        """The stored points that should be visible in every image of a frame; None for none."""
        self._remove(frame - self._since > _MEMORY_S * self.motion.rate)
        if not len(self) or not 0 <= frame < len(self.motion):
            return None
        good, uv, axes = self._visible(frame, np.arange(len(self)))
        index = np.flatnonzero(good)
        if not len(index):
            return None
        maps = axes[index] @ np.linalg.inv(self._axes[index])
        between = axes[index, 1:] @ np.linalg.inv(axes[index, :1])
        mosaics = [SplineImage.of(self._crops[index, c].reshape(-1, self._side)) for c in range(len(self.rig))]
        at = self._inside[index].copy()
        at[..., 1] += (self._side * np.arange(len(index)))[:, None]
        return Expected(index, self._ids[index], mosaics, at, uv[index], maps, between)

    def mark_found(self, frame: int, index: NDArray) -> None:
        """Remove the points `index` (N,) that were found again in a frame, and note it in `returns`."""
        ids = set(map(int, self._ids[index]))
        self.returns = [
            replace(r, found=frame) if r.found is None and r.point in ids else r for r in self.returns
        ]
        gone = np.zeros(len(self), bool)
        gone[index] = True
        self._remove(gone)

    def _remove(self, gone: NDArray) -> None:
        for name in ("_ids", "_segment", "_since", "_rest", "_normal", "_inside", "_axes", "_crops"):
            setattr(self, name, getattr(self, name)[~gone])

    def _segment_frames(self, frame: int) -> NDArray:
        state = self.motion.state(frame)
        return self.motion.body.tree.forward(state.T_world_root, state.angles)[0]

    @staticmethod
    def _poses_of(frames: NDArray, segment: NDArray) -> tuple[NDArray, NDArray]:
        return frames[segment, :9].reshape(-1, 3, 3), frames[segment, 9:]

    def _project(self, frames: NDArray, segment: NDArray, rest: NDArray, normal: NDArray) -> tuple[NDArray, NDArray]:
        """(N, C, 2) [px] image points, and (N, C, 2, 2) [px/m] images of two tangent directions of the surface."""
        R, t = self._poses_of(frames, segment)
        helper = np.eye(3)[np.argmin(np.abs(normal), axis=1)] if len(normal) else np.zeros((0, 3))
        first = np.cross(normal, helper)
        first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
        places = [rest, rest + _MAP_STEP * first, rest + _MAP_STEP * np.cross(normal, first)]
        world = [np.einsum("nij,nj->ni", R, x) + t for x in places]
        uv = np.stack([[camera.project(x) for camera in self.rig] for x in world])  # (3, C, N, 2)
        axes = np.stack([uv[1] - uv[0], uv[2] - uv[0]], axis=-1) / _MAP_STEP  # (C, N, 2, 2)
        return uv[0].swapaxes(0, 1), axes.swapaxes(0, 1)


def _crop(grey: NDArray, corner: NDArray, side: int) -> NDArray:
    """(side, side) window of an image from a corner (u, v) [px]; the image's border is repeated outside."""
    u = np.clip(np.arange(corner[0], corner[0] + side), 0, grey.shape[1] - 1)
    v = np.clip(np.arange(corner[1], corner[1] + side), 0, grey.shape[0] - 1)
    return grey[np.ix_(v, u)]
