"""A limb is sought where the colours of a body's parts show it: poses are drawn, and what each explains is summed.

With the densities of all parts fixed, an image's likelihood under a pose is, but for a constant, the sum over all
pixels of the logarithm of p_k / p, with p_k of the part that is drawn at a pixel and p of what is around the body (P3,
eq. 8, for several regions). It needs no correspondences, and tells poses apart whose contours all agree with some edge.
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

_CELLS = 40  # along a body's longest side, in which vertices of a segment are merged: limbs are two wide
_SIDE = 112  # [px] of the drawing, longer side: a forearm at 3 m is four wide
_WIDE, _DRAWS = 0.6, 24  # [rad] of the first draws about a state; how many of them, and as many of the posture prior
_BEST, _ROUNDS, _EACH = 2, 3, 12  # poses that are improved, rounds of that, draws in each
_NARROW, _CLOSER = 0.2, 0.6  # [rad] of the first of these rounds, and by how much closer draws are in the next


class Limbs:
    """The limbs of one body, each a segment that hangs on the root with all that hangs on it.

    Parameters
    ----------
    body : Body
    mesh : of its skin
    label : (T,) part of the body that each face belongs to
    drawn : state of `random` to go on from; default: that of its seed

    Attributes
    ----------
    random : what poses are drawn from
    """

    def __init__(
        self, body: Body, mesh: BodyMesh | SkinnedMesh, label: NDArray, drawn: Mapping[str, Any] | None = None
    ) -> None:
        tree, x = body.tree, mesh.vertices
        cell = ((x - x.min(axis=0)) / (float(np.ptp(x, axis=0).max()) / _CELLS)).astype(np.int64)
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
        """The state in which a limb explains an image best; all but the limb as given.

        Parameters
        ----------
        limb : its number
        others : states that are tried too
        """
        tree, own = self.body.tree, self.coordinates[limb]
        lower, upper = np.maximum(tree.lower[own], -np.pi), np.minimum(tree.upper[own], np.pi)
        usual, spread = tree.usual[own], np.minimum(tree.spread[own], 1.5)
        now, R = state.angles[own], self.random
        pool = [now[None], *(o.angles[own][None] for o in others), now + _WIDE * R.normal(size=(_DRAWS, len(own))),
                usual + spread * R.normal(size=(_DRAWS, len(own)))]  # fmt: skip
        angles = np.clip(np.concatenate(pool), lower, upper)
        at = self._window(state, camera)
        worth = np.array([self._worth(state, own, a, seen, camera, at) for a in angles])
        best, top = now, float(worth[0])
        for k in np.argsort(-worth)[:_BEST]:
            a, value, width = angles[k], float(worth[k]), _NARROW
            for _ in range(_ROUNDS):
                tried = np.clip(a + width * R.normal(size=(_EACH, len(own))), lower, upper)
                told = [self._worth(state, own, t, seen, camera, at) for t in tried]
                j = int(np.argmax(told))
                if told[j] > value:
                    a, value = tried[j], told[j]
                width *= _CLOSER
            if value > top:
                best, top = a, value
        return _with(state, own, best)

    def _window(self, state: BodyState, camera: Camera) -> Window:
        """About the body and what its limbs may reach."""
        x = self._posed(state)
        middle, size = x.mean(axis=0), 0.6 * float(np.ptp(x, axis=0).max())
        corners = middle + size * (np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3))
        return Window.about(np.ascontiguousarray(np.nan_to_num(camera.project(corners))), camera, _SIDE)

    def _posed(self, state: BodyState) -> NDArray:
        f = self.body.tree.forward(state.T_world_root, state.angles)[0][self._owner]
        return (f[:, :9].reshape(-1, 3, 3) @ self._rest[:, :, None])[..., 0] + f[:, 9:]

    def _worth(
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
