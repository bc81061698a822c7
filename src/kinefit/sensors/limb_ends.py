"""Where limbs' segments begin and end: the joints between them, of which a picture may show nothing.

A tube that is slid along itself covers what it covered before, but for its ends. So a segment may agree with all that
was measured of it and have its joint at another place: where the ends on both sides of a joint lie beside the picture,
or nothing was measured there, no measurement holds it.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.fingers import knuckles
from kinefit.bodies.limbs import limbs
from kinefit.bodies.surfaces import BodyMesh
from kinefit.geometry.camera import Camera
from kinefit.sensors.evidence import SHOWN

NEAR, FAR = 0, 1  # of a segment's two ends: at its own joint, and away from it
END = 1.0 / 3.0  # of a segment's length that is an end of it
_STEPS = 16  # places along an end
FEWEST = 16  # pixels of an outline: fewer say too little


class LimbEnds:
    """The axes of a body's segments, made once.

    Parameters
    ----------
    body : Body
    mesh : BodyMesh of it
    """

    def __init__(self, body: Body, mesh: BodyMesh) -> None:
        count = len(body.tree.segments)
        self.joints = np.array([pair for limb in limbs(body) for pair in pairwise(limb)], int).reshape(-1, 2)
        own, self._of, first = [], [], [0]
        self.fingers = np.full(count, np.inf)
        at = knuckles(body)
        for s in np.unique(mesh.segment):
            index = np.flatnonzero(mesh.segment == s)
            x = mesh.vertices[index] - body.tree.rest[s]
            axis = x.mean(axis=0)
            t = x @ axis
            for end in (t <= t.min() + 0.01 * np.ptp(t), t >= t.max() - 0.01 * np.ptp(t)):
                own.append(index[end])
                first.append(first[-1] + int(end.sum()))
            self._of.append(int(s))
            if s in at and np.ptp(t) > 0.0:
                self.fingers[s] = (at[s] @ axis - t.min()) / np.ptp(t)
        self._index, self._first = np.concatenate(own), np.array(first[:-1])
        self._number, self._count = np.diff(first), count

    def axes(self, vertices_world: NDArray, camera: Camera) -> NDArray:
        """(S, 7) of each segment in the camera's frame: begin (3,) [m], axis (3,) [1/m] up to 1, fingers."""
        ends = np.add.reduceat(vertices_world[self._index], self._first, axis=0) / self._number[:, None]
        ends = (ends @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]).reshape(-1, 2, 3)
        along = ends[:, 1] - ends[:, 0]
        out = np.zeros((self._count, 7))
        out[self._of, :3] = ends[:, 0]
        out[self._of, 3:6] = along / np.maximum(np.square(along).sum(axis=1, keepdims=True), 1e-12)
        out[:, 6] = self.fingers
        return out

    def unseen(self, axes: NDArray, counts: NDArray, camera: Camera) -> NDArray:
        """(S,) bool: segments whose joint is beside the picture, or at pixels that speak for neither side of it.

        Parameters
        ----------
        axes : (S, 7) as `axes` gives them
        counts : (S, 2, 2) of each segment's ends: pixels where it is foremost, and those of them that agree
        camera : Camera
        """
        out = np.zeros(self._count, bool)
        child, parent = self.joints[:, 1], self.joints[:, 0]
        if not len(child):
            return out
        inside = np.stack([self._inside(axes[child], camera, NEAR), self._inside(axes[parent], camera, FAR)])
        drawn, agreeing = (np.stack([counts[child, NEAR, k], counts[parent, FAR, k]]).astype(float) for k in (0, 1))
        whole = drawn / np.maximum(inside, 1.0 / _STEPS)  # with what lies beside the picture
        whole = np.where(inside > 0.0, whole, whole[::-1])  # as much as of the other side, where all of it does
        beside = inside.max(axis=0) == 0.0
        few = whole.sum(axis=0) < FEWEST  # other parts of the body hide it
        out[child] = beside | (~few & (agreeing.sum(axis=0) < SHOWN * whole.sum(axis=0)))
        return out

    def _inside(self, axes: NDArray, camera: Camera, end: int) -> NDArray:
        """(N,) share of an end's axis that lies within the image."""
        t = END * (np.arange(_STEPS) + 0.5) / _STEPS + (1.0 - END) * end
        along = axes[:, 3:6] / np.maximum(np.square(axes[:, 3:6]).sum(axis=1, keepdims=True), 1e-12)
        x = axes[:, None, :3] + t[:, None] * along[:, None]
        K, (width, height) = camera.matrix, camera.size
        z = np.maximum(x[..., 2], 1e-6)
        u, v = K[0, 0] * x[..., 0] / z + K[0, 2], K[1, 1] * x[..., 1] / z + K[1, 2]
        shown = (x[..., 2] > 0.0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        return np.asarray(shown.mean(axis=1))
