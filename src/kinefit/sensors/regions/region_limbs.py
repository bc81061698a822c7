"""Search for a limb by the colours of a body's parts: sample poses and compare their likelihoods.

With the colour densities of all parts fixed, an image's log likelihood under a pose is, up to a constant, the sum over
all pixels of log p_k / p, with p_k of the part rendered at a pixel and p of the background (P3, eq. 8, for several
regions). It needs no correspondences, and separates poses whose contours all agree with some edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces import BodyMesh, SkinnedMesh
from kinefit.correspondences.contours.rims import Window
from kinefit.geometry.camera import Camera
from kinefit.images import _kernels_regions as kernels
from kinefit.rendering import Canvas
from kinefit.sensors.regions.region_image import Coloured

_MERGE_CELLS = 40  # along a body's longest side, in which vertices of a segment are merged: limbs are two wide
_RENDER_SIDE_PX = 112  # longer side of the rendering: a forearm at 3 m is four wide
_FIRST_SIGMA = 0.6  # [rad] of the first samples about a state
_FIRST_SAMPLES = 24  # about the state, and as many of the posture prior
_REFINED_POSES = 2
_REFINE_ROUNDS = 3
_REFINE_SAMPLES = 12  # in each round
_REFINE_SIGMA = 0.2  # [rad] of the first round
_SIGMA_DECAY = 0.6  # from round to round


class Limbs:
    """The limbs of one body: each child of the root, with all of its descendants.

    Parameters
    ----------
    body : Body
    mesh : of its skin
    label : (T,) part of the body that each face belongs to
    drawn : state of `random` to continue from; default: that of its seed

    Attributes
    ----------
    random : generator of the sampled poses
    """

    def __init__(
        self, body: Body, mesh: BodyMesh | SkinnedMesh, label: NDArray, drawn: Mapping[str, Any] | None = None
    ) -> None:
        tree, x = body.tree, mesh.vertices
        cell = ((x - x.min(axis=0)) / (float(np.ptp(x, axis=0).max()) / _MERGE_CELLS)).astype(np.int64)
        key = np.column_stack([mesh.segment, cell])
        _, first, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
        number = number.ravel()
        count = np.bincount(number)
        self._rest = np.array([np.bincount(number, x[:, k]) / count for k in range(3)]).T
        self._owner, faces = np.asarray(mesh.segment)[first], number[mesh.faces]
        solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        self._faces, self._label = np.ascontiguousarray(faces[solid], np.int32), np.ascontiguousarray(label[solid])
        self.body, root = body, np.arange(len(tree.segments))
        while (tree.parents[root] > 0).any():
            root = np.where(tree.parents[root] > 0, tree.parents[root], root)
        self.segments = [np.flatnonzero(root == s) for s in np.flatnonzero(tree.parents == 0)]
        self.coordinates = [np.flatnonzero(np.isin(tree.owners, limb)) for limb in self.segments]
        self._canvases: dict[tuple[int, int], Canvas] = {}
        self.random = np.random.default_rng(7)
        if drawn is not None:
            self.random.bit_generator.state = drawn

    def sought(self, limb: int, state: BodyState, others: list[BodyState], seen: Coloured, camera: Camera) -> BodyState:
        """The state of highest likelihood under changes of one limb.

        Parameters
        ----------
        limb : its number
        others : further states to try
        """
        tree, own = self.body.tree, self.coordinates[limb]
        lower, upper = np.maximum(tree.lower[own], -np.pi), np.minimum(tree.upper[own], np.pi)
        prior, spread = tree.usual[own], np.minimum(tree.spread[own], 1.5)
        now, R = state.angles[own], self.random
        pool = [now[None], *(o.angles[own][None] for o in others),
                now + _FIRST_SIGMA * R.normal(size=(_FIRST_SAMPLES, len(own))),
                prior + spread * R.normal(size=(_FIRST_SAMPLES, len(own)))]  # fmt: skip
        angles = np.clip(np.concatenate(pool), lower, upper)
        at = self._window(state, camera)
        worth = np.array([self._log_likelihood(state, own, a, seen, camera, at) for a in angles])
        best, top = now, float(worth[0])
        for k in np.argsort(-worth)[:_REFINED_POSES]:
            a, value, width = angles[k], float(worth[k]), _REFINE_SIGMA
            for _ in range(_REFINE_ROUNDS):
                tried = np.clip(a + width * R.normal(size=(_REFINE_SAMPLES, len(own))), lower, upper)
                values = [self._log_likelihood(state, own, t, seen, camera, at) for t in tried]
                j = int(np.argmax(values))
                if values[j] > value:
                    a, value = tried[j], values[j]
                width *= _SIGMA_DECAY
            if value > top:
                best, top = a, value
        return _with(state, own, best)

    def _window(self, state: BodyState, camera: Camera) -> Window:
        """The window about the body and all that its limbs can reach."""
        x = self._posed(state)
        middle, size = x.mean(axis=0), 0.6 * float(np.ptp(x, axis=0).max())
        corners = middle + size * (np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3))
        return Window.about(np.ascontiguousarray(np.nan_to_num(camera.project(corners))), camera, _RENDER_SIDE_PX)

    def _posed(self, state: BodyState) -> NDArray:
        f = self.body.tree.forward(state.T_world_root, state.angles)[0][self._owner]
        return (f[:, :9].reshape(-1, 3, 3) @ self._rest[:, :, None])[..., 0] + f[:, 9:]

    def _log_likelihood(
        self, state: BodyState, own: NDArray, angles: NDArray, seen: Coloured, camera: Camera, w: Window
    ) -> float:
        x = self._posed(_with(state, own, angles)) @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
        if w.size not in self._canvases:
            self._canvases[w.size] = Canvas(w.size)
        drawn = self._canvases[w.size].draw(x, self._faces, w.lens(camera))
        return kernels.likelihood(
            seen.image, seen.bins, seen.ratios.logs, drawn.face, self._label, w.left, w.top, w.scale
        )


def _with(state: BodyState, own: NDArray, angles: NDArray) -> BodyState:
    every = np.array(state.angles)
    every[own] = angles
    return BodyState(state.T_world_root, every)
