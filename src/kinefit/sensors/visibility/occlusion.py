"""Keypoints that are seen cannot lie behind what a depth camera beside theirs has measured."""

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

SEEN = 0.8  # confidence from which a keypoint is taken to be seen; detectors are less sure of what they guess
BESIDE = np.radians(10.0)  # between two cameras' views of the body: at 0.5 m behind a hand they are 9 cm apart
THICK = 0.15  # [m] more than any joint lies below the skin, less than a trunk is thick
_SKIN = 0.05  # [m] of a joint below it, give or take as much
_AROUND = 1  # pixels about a keypoint, of which the median counts


class DepthSeen(NamedTuple):
    """A depth image for other sensors to ask: (H, W) [m], its camera, its standard deviation [m]."""

    depth: NDArray
    camera: Camera
    sigma: float


@dataclass(frozen=True, eq=False)
class Hidden:
    """Keypoints of one camera that lie too deep behind what was measured in front of them.

    Parameters
    ----------
    index : (K,) int, channels
    target, sight : (K, 3) [m] where each should lie, along the unit line of sight
    sigma : float [m]
    far : int, channels that lie so deep that they could not be seen
    """

    index: NDArray
    target: NDArray
    sight: NDArray
    sigma: float
    far: NDArray

    @property
    def key(self) -> bytes:
        """The same for the same channels."""
        return self.index.tobytes()

    def rows(self, scene: Scene, points: PointSet) -> Rows | DofRows:
        """One row a channel, up to a joint's depth below the skin; points (N,) are those of all channels."""
        mine = PointSet(
            tuple(points.names[k] for k in self.index), points.segments[self.index], points.points[self.index]
        )
        gap = np.einsum("ki,ki->k", self.sight, self.target - scene.positions(mine))
        return scene.along(mine, self.sight, gap, self.sigma)


def hidden_points(scene: Scene, points: PointSet, camera: NDArray, sure: NDArray) -> Iterator[Hidden]:
    """Points of keypoints that depth images of the same time, from beside their cameras, have something in front of.

    Parameters
    ----------
    points : PointSet of N channels; camera (N,) int, index in the rig of each
    sure : (N,) bool, those that are surely seen
    """
    told = (d for m in scene.measurements if (d := m.depth_image()) is not None)
    seen = [d._replace(camera=scene.placed(d.camera)) for d in told]
    if not seen:
        return
    root = scene.state.T_world_root[:3, 3]
    for c in np.unique(camera[sure]):
        near = beside(scene.rig.cameras[c], [d.camera for d in seen], root)
        if not near:
            continue
        index = np.flatnonzero(sure & (camera == c))
        shown = seen[near[0]]
        mine = PointSet(tuple(points.names[k] for k in index), points.segments[index], points.points[index])
        x = scene.positions(mine)
        behind = depth_behind(x, shown)
        deep = np.flatnonzero(behind > 2.0 * _SKIN)
        if len(deep):
            sight = x[deep] - shown.camera.centre_world
            sight /= np.linalg.norm(sight, axis=1, keepdims=True)
            target = x[deep] - (behind[deep, None] - _SKIN) * sight
            sigma = float(np.hypot(_SKIN, shown.sigma))
            yield Hidden(index[deep], target, sight, sigma, index[behind > THICK])


def depth_behind(x_world: NDArray, seen: DepthSeen) -> NDArray:
    """(K,) [m] how far behind the surface that was measured there each point (K, 3) lies; NaN where nothing was."""
    camera, (width, height) = seen.camera, seen.camera.size
    uv = camera.project(x_world)
    z = x_world @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
    behind = np.full(len(x_world), np.nan)
    for k in np.flatnonzero(np.isfinite(uv).all(axis=1) & (z > 0.0)):
        u, v = np.rint(uv[k]).astype(int)
        if 0 <= u < width and 0 <= v < height:
            near = seen.depth[max(v - _AROUND, 0) : v + _AROUND + 1, max(u - _AROUND, 0) : u + _AROUND + 1]
            near = near[(near > 0.0) & (near < np.inf)]
            if len(near):
                behind[k] = z[k] - np.median(near)
    return behind


def beside(camera: Camera, others: Sequence[Camera], x_world: NDArray) -> list[int]:
    """Those of the other cameras that see a place (3,) [m] from about the same side."""
    sights = np.array([c.centre_world - x_world for c in (camera, *others)])
    sights /= np.linalg.norm(sights, axis=1, keepdims=True)
    return [k for k in range(len(others)) if sights[0] @ sights[k + 1] > np.cos(BESIDE)]
