"""Points of a surface that vanished, and where a body's motion brings them back into view (P4-11).

A point that is lost is remembered with its place on the nearest segment and with what it looked like in every view. In
later frames the segment's pose says where it must be seen, and how its window is turned and foreshortened there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.surfaces.closest.nearest import nearest_lines
from kinefit.geometry.camera import Rig
from kinefit.motion import Motion
from kinefit.photogrammetry.spline_image import SplineImage

_NEAR = 0.05  # [m] from the body's surface, beyond which a point is none of the body's
_FACING = 0.25  # cosine of the angle under which each camera must see the surface
_SECONDS = 5.0  # for which a point is remembered
_BORDER = 8  # [px] about a window, that its neighbour in a mosaic does not change the spline
_EDGE_ON = 1.0  # [px²/m²] of a square on the surface as it is seen: less is none
_STEP = 1e-3  # [m] on the surface, over which a window's map is taken


@dataclass(frozen=True, eq=False)
class Expected:
    """Where vanished points should be seen.

    Parameters
    ----------
    index : (K,) of the remembered points
    ids : (K,)
    mosaics : of each camera, what they looked like
    at : (K, C, 2) [px] their places in the mosaics
    uv : (K, C, 2) [px] where they should be in the images
    maps : (K, C, 2, 2) from a mosaic to the image
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
    """When a vanished point comes back, in frames.

    Parameters
    ----------
    point : its name
    lost : first frame without it
    expected : first frame from then on in which the motion brings it into view of all cameras; None: in none
    found : frame in which it was found again; None: in none so far
    """

    point: int
    lost: int
    expected: int | None
    found: int | None = None


class Vanished:
    """Remembers lost points of a body; `returns` says when each comes back, in the order in which they were lost.

    Parameters
    ----------
    rig : Rig
    motion : of the body, in the rig's world
    window : side [px] of the windows
    """

    def __init__(self, rig: Rig, motion: Motion, window: int) -> None:
        self.rig, self.motion = rig, motion
        self._side = window + 2 * _BORDER + 1
        C = len(rig)
        self._ids, self._segment, self._since = (np.zeros(0, np.int64) for _ in range(3))
        self._rest, self._normal = np.zeros((0, 3)), np.zeros((0, 3))
        self._inside, self._axes = np.zeros((0, C, 2)), np.zeros((0, C, 2, 2))
        self._crops = np.zeros((0, C, self._side, self._side), np.float32)
        self.returns: list[PointReturn] = []

    def __len__(self) -> int:
        return len(self._ids)

    def remember(self, frame: int, ids: NDArray, x_world: NDArray, uv: NDArray, images: list[SplineImage]) -> None:
        """Points (N,) that were last seen in a frame, at (N, 3) [m] and (N, C, 2) [px] of its images.

        Those that not every camera saw, or that are none of the body's, are let go.
        """
        if not (0 <= frame < len(self.motion)) or not len(ids):
            return
        frames = self._frames(frame)
        _, normal, segment = nearest_lines(self.motion.body, frames, np.ascontiguousarray(x_world.T), _NEAR)
        on = np.flatnonzero((segment >= 0) & np.isfinite(uv).all(axis=(1, 2)))
        R, t = self._of(frames, segment[on])
        rest = np.einsum("nji,nj->ni", R, x_world[on] - t)
        out = np.einsum("nji,nj->ni", R, normal.T[on])
        corner = np.floor(uv[on]).astype(int) - self._side // 2
        crops = np.stack([[_crop(image.grey, corner[n, c], self._side) for c, image in enumerate(images)]
                          for n in range(len(on))]) if len(on) else self._crops[:0]  # fmt: skip
        _, axes = self._seen(frames, segment[on], rest, out)
        parts = (
            ("_ids", ids[on]), ("_segment", segment[on]), ("_since", np.full(len(on), frame)), ("_rest", rest),
            ("_normal", out), ("_inside", uv[on] - corner), ("_axes", axes), ("_crops", crops),
        )  # fmt: skip
        for name, values in parts:
            setattr(self, name, np.concatenate([getattr(self, name), values]))
        self._foretell(frame + 1, np.arange(len(self) - len(on), len(self)))

    def _visible(self, frame: int, index: NDArray) -> tuple[NDArray[np.bool_], NDArray, NDArray]:
        """(N,) which remembered points all cameras see by the motion, and their places and directions as of `_seen`."""
        frames, segment, rest = self._frames(frame), self._segment[index], self._rest[index]
        uv, axes = self._seen(frames, segment, rest, self._normal[index])
        R, t = self._of(frames, segment)
        x = np.einsum("nij,nj->ni", R, rest) + t
        out = np.einsum("nij,nj->ni", R, self._normal[index])
        good = np.isfinite(uv).all(axis=(1, 2)) & np.isfinite(axes).all(axis=(1, 2, 3))
        half = 0.5 * self._side
        for c, camera in enumerate(self.rig):
            to = camera.centre_world - x
            good &= np.einsum("ni,ni->n", out, to) > _FACING * np.linalg.norm(to, axis=1)
            good &= ((uv[:, c] > half) & (uv[:, c] < np.array(camera.size) - half)).all(axis=1)
        for seen in (self._axes[index], axes):
            good &= (np.abs(np.linalg.det(seen)) > _EDGE_ON).all(axis=1)
        return good, uv, axes

    def _foretell(self, lost: int, index: NDArray) -> None:
        """Note when the motion brings points, lost in a frame, into view again."""
        first = np.full(len(index), -1)
        for frame in range(lost, min(len(self.motion), lost + int(_SECONDS * self.motion.rate) + 1)):
            waiting = np.flatnonzero(first < 0)
            if not len(waiting):
                break
            first[waiting[self._visible(frame, index[waiting])[0]]] = frame
        self.returns += [PointReturn(int(self._ids[i]), lost, int(f) if f >= 0 else None) for i, f in zip(index, first)]

    def expected(self, frame: int) -> Expected | None:
        """Those that should be in view in every image of a frame; None where there are none."""
        self._forget(frame - self._since > _SECONDS * self.motion.rate)
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

    def found(self, frame: int, index: NDArray) -> None:
        """Forget points that are back in a frame."""
        ids = set(map(int, self._ids[index]))
        self.returns = [
            replace(of, found=frame) if of.found is None and of.point in ids else of for of in self.returns
        ]
        gone = np.zeros(len(self), bool)
        gone[index] = True
        self._forget(gone)

    def _forget(self, gone: NDArray) -> None:
        for name in ("_ids", "_segment", "_since", "_rest", "_normal", "_inside", "_axes", "_crops"):
            setattr(self, name, getattr(self, name)[~gone])

    def _frames(self, frame: int) -> NDArray:
        state = self.motion.state(frame)
        return self.motion.body.tree.forward(state.T_world_root, state.angles)[0]

    @staticmethod
    def _of(frames: NDArray, segment: NDArray) -> tuple[NDArray, NDArray]:
        return frames[segment, :9].reshape(-1, 3, 3), frames[segment, 9:]

    def _seen(self, frames: NDArray, segment: NDArray, rest: NDArray, normal: NDArray) -> tuple[NDArray, NDArray]:
        """(N, C, 2) [px] places in the images, and (N, C, 2, 2) how two directions on the surface lie there [px/m]."""
        R, t = self._of(frames, segment)
        helper = np.eye(3)[np.argmin(np.abs(normal), axis=1)] if len(normal) else np.zeros((0, 3))
        first = np.cross(normal, helper)
        first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
        places = [rest, rest + _STEP * first, rest + _STEP * np.cross(normal, first)]
        world = [np.einsum("nij,nj->ni", R, x) + t for x in places]
        uv = np.stack([[camera.project(x) for camera in self.rig] for x in world])  # (3, C, N, 2)
        axes = np.stack([uv[1] - uv[0], uv[2] - uv[0]], axis=-1) / _STEP  # (C, N, 2, 2)
        return uv[0].swapaxes(0, 1), axes.swapaxes(0, 1)


def _crop(grey: NDArray, corner: NDArray, side: int) -> NDArray:
    """(side, side) of an image from a corner (u, v) on, its border repeated beyond it."""
    u = np.clip(np.arange(corner[0], corner[0] + side), 0, grey.shape[1] - 1)
    v = np.clip(np.arange(corner[1], corner[1] + side), 0, grey.shape[0] - 1)
    return grey[np.ix_(v, u)]
