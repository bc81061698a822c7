"""Occlusion: keypoints behind a surface that a depth camera measures, and the images of several people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import PointSet
from kinefit.geometry.camera import Camera
from kinefit.observations import DepthFrame
from kinefit.sensors.scene import Scene
from kinefit.sensors.surfaces.depth_view import DepthSeen
from kinefit.solving.rows import DofRows, Rows

MIN_VISIBLE_CONFIDENCE = 0.8  # from which a keypoint counts as visible; detectors give occluded points less
MAX_VIEW_ANGLE = np.radians(10.0)  # between two cameras' views of the body: 0.5 m behind a hand they are 9 cm apart
MIN_OCCLUDED_DEPTH = 0.15  # [m] below the skin: deeper than any joint, less than a trunk is thick
_JOINT_DEPTH = 0.05  # [m] of a joint below the skin, and its standard deviation
_MEDIAN_RADIUS_PX = 1  # of the pixels about a keypoint whose median depth counts


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


_MAX_BODY_DISTANCE = 0.4  # [m] farther points belong to no body: an arm that has moved since the last frame is nearer


def drawn_together(scenes: Sequence[Scene], camera: Camera) -> NDArray | None:
    """(h, w) [m] rendered depth of the nearest of several bodies, downsampled, inf where none; None for no bodies."""
    images = [s.surface.depth(s.surface.posed(s.state), s.placed(camera)).copy() for s in scenes if s.body.surfaces]
    return np.minimum.reduce(images) if images else None


def of_others(depth: NDArray, own: NDArray, others: NDArray | None, camera: Camera) -> NDArray:
    """(H, W) bool: the measured point is nearer to another body than to the own one.

    Parameters
    ----------
    depth : (H, W) [m], 0 or less where nothing was measured
    own, others : (h, w) [m] rendered depth of the own body and of all others, inf where there is none
    camera : of the depth image
    """
    if others is None or not np.isfinite(others).any():
        return np.zeros(depth.shape, bool)
    away = _distance(depth, others, camera)
    return (depth > 0.0) & (away < _MAX_BODY_DISTANCE) & (away < _distance(depth, own, camera))


def without_others(frame: DepthFrame, others: Sequence[Scene], camera: Camera) -> DepthFrame:
    """A depth image with 0 at the pixels of other bodies."""
    drawn = drawn_together(others, camera)
    if drawn is None:
        return frame
    theirs = of_others(frame.depth, np.full_like(drawn, np.inf), drawn, camera)
    return replace(frame, depth=np.where(theirs, np.float32(0.0), frame.depth))


def outside_others(mask: NDArray, own: NDArray, others: NDArray) -> NDArray:
    """(h, w) bool: pixels of a silhouette that are nearer to another rendered body than to the own one.

    Parameters
    ----------
    mask : (h, w) silhouette of all people
    own, others : (h', w') [m] rendered depth, inf for no body; where they overlap the nearer one has the pixel
    """
    if not np.isfinite(others).any():
        return np.zeros(mask.shape, bool)
    front = np.isfinite(others) & (others < own)
    away = [cv2.distanceTransform((~seen).astype(np.uint8), cv2.DIST_L2, 3) for seen in (front, np.isfinite(own))]
    nearer = cv2.resize(away[0] - away[1], mask.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray((mask > 0) & (nearer < 0.0))


def _distance(depth: NDArray, drawn: NDArray, camera: Camera) -> NDArray:
    """(H, W) [m] distance of each measured point from the nearest rendered point of a body."""
    seen = np.isfinite(drawn)
    if not seen.any():
        return np.full(depth.shape, np.inf)
    away, label = cv2.distanceTransformWithLabels(
        (~seen).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    table = np.zeros(int(label.max()) + 1, np.float32)
    table[label[seen]] = drawn[seen]
    rows, columns = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(depth.shape, drawn.shape))
    cells = np.ix_(rows, columns)
    pixel = depth / camera.matrix[0, 0] * (camera.size[0] / drawn.shape[1])  # [m] width of a drawn pixel
    return np.asarray(np.hypot(away[cells] * pixel, depth - table[label[cells]]))
