"""Score many poses of a body by how well they explain a depth view."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.limbs import limbs, of_fingers
from kinefit.bodies.rendering import Canvas, rasterise
from kinefit.bodies.surfaces.mesh import BodyMesh
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.sensors.surfaces import _kernels_depth_view as kernels
from kinefit.sensors.surfaces.depth_view import DepthView
from kinefit.solving.correspondences.occupancy.free_space import CollisionPairs, collision_pairs

MAX_DEPTH_ERROR = 0.10  # [m] between rendered and measured surface of an explained pixel: the radius of a thigh
OVERLAP_COST = 0.5  # [1/m] of the score per metre of self-penetration: 1 % for 2 cm, the softness of flesh
POSTURE_COST = 0.004  # of the score for one standard deviation of every angle from the prior mean


def prior_sigmas(body: Body) -> NDArray:
    """(D,) [rad or m] prior standard deviation of each coordinate, at most half its range, or 1 without limits."""
    tree = body.tree
    half = 0.5 * (tree.upper - tree.lower)
    return np.minimum(tree.spread, np.where(np.isfinite(half), half, 1.0))


class _SelectedMesh(NamedTuple):
    """Mesh of some segments: vertices (V, 3) [m] in the rest pose, segment (V,), faces (T, 3), hand of each (T,).

    pairs : (P,) bool, collision pairs of segments that are both among them
    """

    vertices: NDArray
    owner: NDArray
    faces: NDArray
    fingers: NDArray
    pairs: NDArray


@dataclass(frozen=True, eq=False)
class Score:
    """Scores poses of a body in a depth view.

    Parameters
    ----------
    body : Body with surfaces
    view : DepthView
    """

    body: Body
    view: DepthView

    @cached_property
    def mesh(self) -> BodyMesh:
        """Coarse mesh of the body's surface: a pixel of the view is two centimetres wide."""
        return body_mesh(self.body, around=10, along=3)

    @cached_property
    def trunk(self) -> tuple[int, ...]:
        """Indices of the segments that belong to no limb."""
        of_limbs = {s for limb in limbs(self.body) for s in limb}
        return tuple(s for s in range(len(self.body.tree.segments)) if s not in of_limbs)

    @cached_property
    def core(self) -> tuple[int, ...]:
        """Indices of the trunk's segments and of limbs with one segment (a head), which are placed first."""
        return tuple(sorted((*self.trunk, *(limb[0] for limb in limbs(self.body) if len(limb) == 1))))

    @cached_property
    def pixels(self) -> float:
        """Number of the person's pixels, at least 1."""
        return max(float(self.view.seen.sum()), 1.0)

    @cached_property
    def _spread(self) -> NDArray:
        return prior_sigmas(self.body)

    @cached_property
    def _collision_pairs(self) -> CollisionPairs:
        return collision_pairs(self.body)

    @cached_property
    def _empty_depth(self) -> NDArray:
        return np.full(self.view.observed.shape, np.inf, np.float32)

    @cached_property
    def _selected_meshes(self) -> dict[tuple[int, ...], _SelectedMesh]:
        return {}

    @cached_property
    def _fingers(self) -> NDArray:
        """(T,) int: hand (from 1) of each face of the fingers; 0 for others."""
        mesh = self.mesh
        bends = of_fingers(self.body, mesh.face_segment, mesh.vertices[mesh.faces].mean(axis=1))
        out = np.zeros(len(bends), np.int64)
        out[bends] = 1 + np.unique(mesh.face_segment[bends], return_inverse=True)[1]
        return out

    def _mesh_of(self, segments: tuple[int, ...]) -> _SelectedMesh:
        if segments not in self._selected_meshes:
            mesh, among = self.mesh, np.zeros(len(self.body.tree.segments), bool)
            among[list(segments)] = True
            own = among[mesh.face_segment]
            used, faces = np.unique(mesh.faces[own], return_inverse=True)
            self._selected_meshes[segments] = _SelectedMesh(
                np.ascontiguousarray(mesh.vertices[used]), mesh.segment[used], faces.reshape(-1, 3).astype(np.int32),
                self._fingers[own], among[self._collision_pairs.segment[self._collision_pairs.pairs]].all(axis=1),
            )  # fmt: skip
        return self._selected_meshes[segments]

    def __call__(
        self, roots: NDArray, angles: NDArray, drawn: tuple[int, ...] | None = None, *,
        moving: tuple[int, ...] | None = None, base: NDArray | None = None,
    ) -> NDArray:  # fmt: skip
        """(B,) score of poses, at most 1: the share of the person's pixels that the pose explains, minus costs.

        Costs are rendered pixels where the sensor saw farther, self-penetration, and improbable postures. Fingers are
        stretched or folded, whichever is better.

        Parameters
        ----------
        roots, angles : (B, 4, 4), (B, D) [rad or m]
        drawn : segments that are rendered; default: all
        moving, base : segments that differ between the poses, and the depth (h, w) [m] of all others; faster
        """
        tree, view, p = self.body.tree, self.view, self._collision_pairs
        drawn = tuple(range(len(tree.segments))) if drawn is None else drawn
        part = self._mesh_of(drawn if moving is None else moving)
        out, overlap = np.empty((len(roots), 2)), np.empty(len(roots))
        roots, angles = np.ascontiguousarray(roots, float), np.ascontiguousarray(angles, float)
        pose = tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, roots, angles
        kernels.agreement(
            *pose, part.vertices, part.owner, part.faces, part.fingers, view.T_view_world, view.lens,
            view.observed, view.behind, view.trust, self._empty_depth if base is None else base, MAX_DEPTH_ERROR, out,
        )  # fmt: skip
        pair_mask = self._mesh_of(drawn).pairs
        kernels.overlaps(*pose, p.segment, p.starts, p.ends, p.pairs[pair_mask], p.apart[pair_mask], overlap)
        improbability = np.mean(((angles - tree.usual) / self._spread) ** 2, axis=1) if angles.shape[1] else 0.0
        scores: NDArray = (out[:, 0] - out[:, 1]) / self.pixels - OVERLAP_COST * overlap - POSTURE_COST * improbability
        return scores

    def depth(self, state: BodyState, drawn: tuple[int, ...]) -> NDArray:
        """(h, w) [m] rendered depth of some segments, inf elsewhere; fingers are folded where that is better."""
        view, part = self.view, self._mesh_of(drawn)
        frames, _ = self.body.tree.forward(state.T_world_root, state.angles)
        x = BodyMesh(part.vertices, part.faces, part.owner, np.zeros(0, np.int32)).posed(frames)
        x = x @ view.T_view_world[:3, :3].T + view.T_view_world[:3, 3]
        height, width = view.observed.shape
        shown = rasterise(x, part.faces, view.lens, (width, height))
        hands = np.zeros((1 + part.fingers.max(initial=0), 2))
        if len(hands) > 1:
            hand = np.append(part.fingers, 0)[shown.face]
            kernels.of_hands(shown.depth, hand, view.observed, view.behind, view.trust, MAX_DEPTH_ERROR, hands)
            folded = (hands[:, 0] <= hands[:, 1]) & (np.arange(len(hands)) > 0)
            if folded.any():
                shown = rasterise(x, part.faces[~folded[part.fingers]], view.lens, (width, height))
        return shown.depth

    def of(self, state: BodyState) -> float:
        """Score of one state, a number of at most 1; see `__call__`."""
        return float(self(state.T_world_root[None], state.angles[None])[0])

    def missing(self, state: BodyState) -> float:
        """Share (0 to 1) of the person's pixels in unexplained pieces, see `unexplained`."""
        return sum(map(len, self.unexplained(state))) / self.pixels

    def unexplained(self, state: BodyState) -> list[NDArray]:
        """Connected pieces (N, 3) [m] of the measured person that the rendered body does not explain.

        Pieces longer than half of the stature are excluded: floor, wall, furniture.
        """
        view, longest = self.view, 0.5 * self.body.stature
        rendered = self.depth(state, tuple(range(len(self.body.tree.segments))))
        unmatched = view.seen & ~(np.abs(rendered - view.observed) < MAX_DEPTH_ERROR)
        kernel, nothing = np.ones((3, 3), np.uint8), np.float32(1e3)
        nearest = cv2.erode(np.where(view.seen, view.observed, nothing), kernel)
        whole = cv2.dilate(view.observed, kernel) - nearest < MAX_DEPTH_ERROR  # no depth step nearby
        thick = cv2.morphologyEx((unmatched & whole).astype(np.uint8), cv2.MORPH_OPEN, kernel)  # without slivers
        count, piece = cv2.connectedComponents(thick)
        pieces = [view.points[piece == k] for k in range(1, count)]
        return [x for x in pieces if np.linalg.norm(np.ptp(x, axis=0)) < longest]

    def visible(self, state: BodyState) -> NDArray:
        """(S,) share (0 to 1) of each segment's rendered area that the sensor could see: in its image, not occluded."""
        tree, view, mesh = self.body.tree, self.view, self.mesh
        frames, _ = tree.forward(state.T_world_root, state.angles)
        x = mesh.posed(frames) @ view.T_view_world[:3, :3].T + view.T_view_world[:3, 3]
        h, w = view.observed.shape
        canvas = Canvas((3 * w, 3 * h))  # with the view in the middle: parts outside count as invisible
        lens = view.lens + (0, 0, w, h)
        raster = canvas.draw(x, mesh.faces, lens)
        middle = (slice(h, 2 * h), slice(w, 2 * w))
        nearer = np.where(view.seen, np.inf, view.behind)
        shown = (raster.face[middle] >= 0) & (view.trust > 0) & (raster.depth[middle] < nearer)
        count = np.bincount(mesh.face_segment[raster.face[middle][shown]], minlength=len(tree.segments))
        faces = [mesh.faces[mesh.face_segment == s] for s in range(len(tree.segments))]
        areas = [np.sum(canvas.draw(x, f, lens).face >= 0) for f in faces]
        return count / np.maximum(areas, 1.0)
