"""Where limbs' segments begin: the joints between them, of which an image may show nothing.

A tube that is slid along itself covers what it covered before, but for its ends. So a segment may agree with nearly all
that was measured of it and have its joint at another place. Its first third tells: where less than half of it is seen,
beside the image or where nothing was measured, the joint may be a sixth of the segment away: 4 cm of a forearm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.bodies.fingers import knuckles
from kinefit.bodies.limbs import limbs
from kinefit.bodies.surfaces import BodyMesh
from kinefit.geometry.camera import Camera
from kinefit.motion import BELIEVED

END = 1.0 / 3.0  # of a segment's length from its joint on
_STEPS = 16  # places along it
_FEWEST = 16  # pixels of it: with fewer it is far away, or other parts of the body hide it


class LimbEnds:
    """The axes of a body's segments, made once.

    Parameters
    ----------
    body : Body
    mesh : BodyMesh of it
    """

    def __init__(self, body: Body, mesh: BodyMesh) -> None:
        count = len(body.tree.segments)
        self.jointed = np.array([s for limb in limbs(body) for s in limb[1:]], int)
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
        """(S,) bool: segments of which less than half of the end at their joint is seen, where a limb goes on from it.

        Parameters
        ----------
        axes : (S, 7) as `axes` gives them
        counts : (S, 2) of each segment's end: pixels where it is foremost, and those of them that agree
        camera : Camera
        """
        out, s = np.zeros(self._count, bool), self.jointed
        inside, (drawn, agreeing) = self._inside(axes[s], camera), counts[s].T
        whole = drawn / np.maximum(inside, 1.0 / _STEPS)  # with what lies beside the image
        out[s] = (inside == 0.0) | ((whole >= _FEWEST) & (agreeing < BELIEVED * whole))
        return out

    def _inside(self, axes: NDArray, camera: Camera) -> NDArray:
        """(N,) share of the ends' axes that lies within the image."""
        t = END * (np.arange(_STEPS) + 0.5) / _STEPS
        along = axes[:, 3:6] / np.maximum(np.square(axes[:, 3:6]).sum(axis=1, keepdims=True), 1e-12)
        x = axes[:, None, :3] + t[:, None] * along[:, None]
        K, (width, height) = camera.matrix, camera.size
        z = np.maximum(x[..., 2], 1e-6)
        u, v = K[0, 0] * x[..., 0] / z + K[0, 2], K[1, 1] * x[..., 1] / z + K[1, 2]
        shown = (x[..., 2] > 0.0) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        return np.asarray(shown.mean(axis=1))
