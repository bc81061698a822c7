"""Seams between parts of different colours, such as a sleeve's end at an elbow or two links of a robot.

The contour of a limb that points at the camera does not show its length; the seam at its joint does. A seam is the
curve in which the surfaces of two parts intersect, and moves with both: its points stay on both surfaces. With a and b
the normals of these, which move by dx_a and dx_b there, and with g = α a + β b the derivative of the pixel along the
seam's normal in the image, the seam moves by α a·dx_a + β b·dx_b.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.tree import KinematicTree
from kinefit.correspondences.contours.rims import RimFinder
from kinefit.geometry.camera import Camera
from kinefit.losses import Loss
from kinefit.rows import DofRows
from kinefit.sensors.regions import _kernels_region_seams as kernels
from kinefit.sensors.regions.region_parts import Drawn, Lines
from kinefit.sensors.scene import Scene

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
        n = kernels.borders(
            drawn.face, finder.depth, finder.face_segment, label, _MAX_DEPTH_GAP, _PIXEL_PAIRS_PER_POINT, pairs
        )
        pairs = pairs[:n]
        at = np.array([drawn.left, drawn.top])
        uv = (pairs[:, 2:4] + 0.5) / drawn.scale - 0.5 + at
        middle = vertices[finder.faces[pairs[:, 0].astype(np.int64)]].mean(axis=1)
        outline, point, pulls = np.empty((4, n)), np.empty((n, 3)), np.empty((2, n, 3))
        rays = camera.ray(uv)
        far = np.sum((middle - camera.centre_world) * rays, axis=1)[:, None]
        n = kernels.seams(
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
