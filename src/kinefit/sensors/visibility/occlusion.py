"""Occlusion of keypoints: a visible keypoint cannot lie behind the surface that an adjacent depth camera measures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import PointSet
from kinefit.geometry.camera import Camera
from kinefit.rows import DofRows, Rows
from kinefit.sensors.scene import Scene

MIN_VISIBLE_CONFIDENCE = 0.8  # from which a keypoint counts as visible; detectors give occluded points less
MAX_VIEW_ANGLE = np.radians(10.0)  # between two cameras' views of the body: 0.5 m behind a hand they are 9 cm apart
MIN_OCCLUDED_DEPTH = 0.15  # [m] below the skin: deeper than any joint, less than a trunk is thick
_JOINT_DEPTH = 0.05  # [m] of a joint below the skin, and its standard deviation
_MEDIAN_RADIUS_PX = 1  # of the pixels about a keypoint whose median depth counts


class DepthSeen(NamedTuple):
    """A depth image for occlusion tests of other sensors: (H, W) [m], its camera, its standard deviation [m]."""

    depth: NDArray
    camera: Camera
    sigma: float


@dataclass(frozen=True, eq=False)
class Hidden:
    """Keypoints of one camera that lie too deep behind the measured surface.

    Parameters
    ----------
    index : (K,) int, channels
    target, sight : (K, 3) [m] target point of each, and (K, 3) unit line of sight along which it is pulled there
    sigma : float [m]
    far : int, channels behind `MIN_OCCLUDED_DEPTH`, which cannot be visible
    """

    index: NDArray
    target: NDArray
    sight: NDArray
    sigma: float
    far: NDArray

    @property
    def key(self) -> bytes:
        """Equal for the same channels."""
        return self.index.tobytes()

    def rows(self, scene: Scene, points: PointSet) -> Rows | DofRows:
        """One row a channel, towards a joint's depth below the skin; points (N,) are those of all channels."""
        own = PointSet(
            tuple(points.names[k] for k in self.index), points.segments[self.index], points.points[self.index]
        )
        gap = np.einsum("ki,ki->k", self.sight, self.target - scene.positions(own))
        return scene.along(own, self.sight, gap, self.sigma)


def hidden_points(scene: Scene, points: PointSet, camera: NDArray, visible: NDArray) -> Iterator[Hidden]:
    """Keypoints that are occluded in depth images of the same time from adjacent cameras.

    Parameters
    ----------
    points : PointSet of N channels; camera (N,) int, index in the rig of each
    visible : (N,) bool, channels whose detector reports them as visible
    """
    images = (d for m in scene.measurements if (d := m.depth_image()) is not None)
    seen = [d._replace(camera=scene.placed(d.camera)) for d in images]
    if not seen:
        return
    root = scene.state.T_world_root[:3, 3]
    for c in np.unique(camera[visible]):
        near = adjacent_cameras(scene.rig.cameras[c], [d.camera for d in seen], root)
        if not near:
            continue
        index = np.flatnonzero(visible & (camera == c))
        shown = seen[near[0]]
        own = PointSet(tuple(points.names[k] for k in index), points.segments[index], points.points[index])
        x = scene.positions(own)
        behind = depth_behind(x, shown)
        deep = np.flatnonzero(behind > 2.0 * _JOINT_DEPTH)
        if len(deep):
            sight = x[deep] - shown.camera.centre_world
            sight /= np.linalg.norm(sight, axis=1, keepdims=True)
            target = x[deep] - (behind[deep, None] - _JOINT_DEPTH) * sight
            sigma = float(np.hypot(_JOINT_DEPTH, shown.sigma))
            yield Hidden(index[deep], target, sight, sigma, index[behind > MIN_OCCLUDED_DEPTH])


def depth_behind(x_world: NDArray, seen: DepthSeen) -> NDArray:
    """(K,) [m] depth of each point (K, 3) behind the measured surface; NaN where nothing was measured."""
    camera, (width, height) = seen.camera, seen.camera.size
    uv = camera.project(x_world)
    z = x_world @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    behind = np.full(len(x_world), np.nan)
    for k in np.flatnonzero(np.isfinite(uv).all(axis=1) & (z > 0.0)):
        u, v = np.rint(uv[k]).astype(int)
        if 0 <= u < width and 0 <= v < height:
            rows, columns = (slice(max(i - _MEDIAN_RADIUS_PX, 0), i + _MEDIAN_RADIUS_PX + 1) for i in (v, u))
            near = seen.depth[rows, columns]
            near = near[(near > 0.0) & (near < np.inf)]
            if len(near):
                behind[k] = z[k] - np.median(near)
    return behind


def adjacent_cameras(camera: Camera, others: Sequence[Camera], x_world: NDArray) -> list[int]:
    """Indices of the other cameras whose view of a point (3,) [m] differs by at most `MAX_VIEW_ANGLE`."""
    sights = np.array([c.centre_world - x_world for c in (camera, *others)])
    sights /= np.linalg.norm(sights, axis=1, keepdims=True)
    return [k for k in range(len(others)) if sights[0] @ sights[k + 1] > np.cos(MAX_VIEW_ANGLE)]
