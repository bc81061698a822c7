"""Keypoints that are seen cannot lie behind what a depth camera beside theirs has measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.correspondences.planes import plane_rows
from kinefit.geometry.camera import Camera
from kinefit.observations import DepthFrame
from kinefit.rows import Rows

SEEN = 0.8  # confidence from which a keypoint is taken to be seen; detectors are less sure of what they guess
BESIDE = np.radians(10.0)  # between two cameras' views of the body: at 0.5 m behind a hand they are 9 cm apart
THICK = 0.15  # [m] more than any joint lies below the skin, less than a trunk is thick
_SKIN = 0.05  # [m] of a joint below it, give or take as much
_AROUND = 1  # pixels about a keypoint, of which the median counts


class InSight:
    """Points of the body that are seen, and a depth image from about the same place.

    Parameters
    ----------
    body : Body
    points : PointSet of the body that are seen
    frame : DepthFrame
    camera : Camera of the depth image
    sigma : float [m] standard deviation of a depth
    """

    def __init__(self, body: Body, points: PointSet, frame: DepthFrame, camera: Camera, sigma: float) -> None:
        self.points, self._body, self._camera, self._sigma = points, body, camera, sigma
        self._depth = frame.depth

    def behind(self, state: BodyState) -> NDArray:
        """(K,) [m] how far behind the surface that was measured there each point lies; NaN where nothing was."""
        return self._surface(state)[1]

    def rows(self, state: BodyState) -> Rows:
        """One row for every point that lies deeper than a joint below the skin, up to it again."""
        x, behind = self._surface(state)
        deep = np.flatnonzero(behind > 2.0 * _SKIN)
        sight = x[deep] - self._camera.centre_world
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        few = self.points.select(tuple(self.points.names[k] for k in deep))
        target = x[deep] - (behind[deep, None] - _SKIN) * sight
        return plane_rows(self._body, state, few, target, sight, sigma=float(np.hypot(_SKIN, self._sigma)))

    def _surface(self, state: BodyState) -> tuple[NDArray, NDArray]:
        x, camera, (width, height) = self._body.positions(state, self.points), self._camera, self._camera.size
        uv = camera.project(x)
        z = x @ camera.T_camera_world[2, :3] + camera.T_camera_world[2, 3]
        behind = np.full(len(x), np.nan)
        for k in np.flatnonzero(np.isfinite(uv).all(axis=1) & (z > 0.0)):
            u, v = np.rint(uv[k]).astype(int)
            if 0 <= u < width and 0 <= v < height:
                near = self._depth[max(v - _AROUND, 0) : v + _AROUND + 1, max(u - _AROUND, 0) : u + _AROUND + 1]
                near = near[(near > 0.0) & (near < np.inf)]
                if len(near):
                    behind[k] = z[k] - np.median(near)
        return x, behind


def beside(camera: Camera, others: Sequence[Camera], x_world: NDArray) -> list[int]:
    """Those of the other cameras that see a place (3,) [m] from about the same side."""
    sights = np.array([c.centre_world - x_world for c in (camera, *others)])
    sights /= np.linalg.norm(sights, axis=1, keepdims=True)
    return [k for k in range(len(others)) if sights[0] @ sights[k + 1] > np.cos(BESIDE)]
