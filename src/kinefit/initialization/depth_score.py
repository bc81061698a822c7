"""How well poses of a body explain a view, many at a time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.fingers import of_fingers
from kinefit.bodies.limbs import limbs
from kinefit.bodies.surfaces.triangles import BodyMesh, body_mesh
from kinefit.correspondences.occupancy.collisions import CollisionPairs, collision_pairs
from kinefit.rendering import Canvas, rasterise
from kinefit.sensors.surfaces import _kernels_depth_view as kernels
from kinefit.sensors.surfaces.depth_view import DepthView

TOLERANCE = 0.10  # [m] a drawn surface this far from the measured one explains nothing: the radius of a thigh
OVERLAP = 0.5  # [1/m] share of the score that a metre of parts within parts costs: 2 cm, the softness of flesh, 1 %
POSTURE = 0.004  # share of the score that one standard deviation of every angle from the prior mean costs


def spreads(body: Body) -> NDArray:
    """(D,) [rad or m] prior standard deviation of each coordinate; half its range at most, and 1 without any limit."""
    tree = body.tree
    half = 0.5 * (tree.upper - tree.lower)
    return np.minimum(tree.spread, np.where(np.isfinite(half), half, 1.0))


class _Parts(NamedTuple):
    """Some segments: vertices (V, 3) [m] at rest and their segments (V,), triangles (T, 3), whose fingers each is (T,).

    And which pairs of segments are both among them.
    """

    vertices: NDArray
    owner: NDArray
    faces: NDArray
    fingers: NDArray
    pairs: NDArray


@dataclass(frozen=True, eq=False)
class Score:
    """Compares poses of a body with a view.

    Parameters
    ----------
    body : Body with surfaces
    view : DepthView
    """

    body: Body
    view: DepthView

    @cached_property
    def mesh(self) -> BodyMesh:
        """The body's surface, coarse: a pixel of the view is two centimetres wide."""
        return body_mesh(self.body, around=10, along=3)

    @cached_property
    def trunk(self) -> tuple[int, ...]:
        """Segments that belong to no limb."""
        of_limbs = {s for limb in limbs(self.body) for s in limb}
        return tuple(s for s in range(len(self.body.tree.segments)) if s not in of_limbs)

    @cached_property
    def core(self) -> tuple[int, ...]:
        """The trunk and limbs of one segment (a head): what is placed first."""
        return tuple(sorted((*self.trunk, *(limb[0] for limb in limbs(self.body) if len(limb) == 1))))

    @cached_property
    def pixels(self) -> float:
        """Pixels of the person, one at least."""
        return max(float(self.view.seen.sum()), 1.0)

    @cached_property
    def _spread(self) -> NDArray:
        return spreads(self.body)

    @cached_property
    def _pairs(self) -> CollisionPairs:
        return collision_pairs(self.body)

    @cached_property
    def _nothing(self) -> NDArray:
        return np.full(self.view.observed.shape, np.inf, np.float32)

    @cached_property
    def _chosen(self) -> dict[tuple[int, ...], _Parts]:
        return {}

    @cached_property
    def _fingers(self) -> NDArray:
        """(T,) int: of which hand's fingers triangles are, counted from 1; 0 for the others."""
        mesh = self.mesh
        bends = of_fingers(self.body, mesh.face_segment, mesh.vertices[mesh.faces].mean(axis=1))
        out = np.zeros(len(bends), np.int64)
        out[bends] = 1 + np.unique(mesh.face_segment[bends], return_inverse=True)[1]
        return out

    def _parts(self, segments: tuple[int, ...]) -> _Parts:
        if segments not in self._chosen:
            mesh, among = self.mesh, np.zeros(len(self.body.tree.segments), bool)
            among[list(segments)] = True
            own = among[mesh.face_segment]
            used, faces = np.unique(mesh.faces[own], return_inverse=True)
            self._chosen[segments] = _Parts(
                np.ascontiguousarray(mesh.vertices[used]), mesh.segment[used], faces.reshape(-1, 3).astype(np.int32),
                self._fingers[own], among[self._pairs.segment[self._pairs.pairs]].all(axis=1),
            )  # fmt: skip
        return self._chosen[segments]

    def __call__(
        self, roots: NDArray, angles: NDArray, drawn: tuple[int, ...] | None = None, *,
        moving: tuple[int, ...] | None = None, base: NDArray | None = None,
    ) -> NDArray:  # fmt: skip
        """(B,) score of poses, 1 at best: share of the person explained, less what speaks against them.

        That is: what is drawn where the sensor saw past it, parts within parts, uncommon postures. Fingers are
        stretched or folded, as they are better.

        Parameters
        ----------
        roots : (B, 4, 4), angles : (B, D)
        drawn : segments that take part; default all
        moving, base : those of them that differ between the poses, and all others as `depth` draws them: faster
        """
        tree, view, p = self.body.tree, self.view, self._pairs
        drawn = tuple(range(len(tree.segments))) if drawn is None else drawn
        part = self._parts(drawn if moving is None else moving)
        out, within = np.empty((len(roots), 2)), np.empty(len(roots))
        roots, angles = np.ascontiguousarray(roots, float), np.ascontiguousarray(angles, float)
        pose = tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, roots, angles
        kernels.agreement(
            *pose, part.vertices, part.owner, part.faces, part.fingers, view.T_view_world, view.lens,
            view.observed, view.behind, view.trust, self._nothing if base is None else base, TOLERANCE, out,
        )  # fmt: skip
        use = self._parts(drawn).pairs
        kernels.overlaps(*pose, p.segment, p.starts, p.ends, p.pairs[use], p.apart[use], within)
        odd = np.mean(((angles - tree.usual) / self._spread) ** 2, axis=1) if angles.shape[1] else 0.0
        scores: NDArray = (out[:, 0] - out[:, 1]) / self.pixels - OVERLAP * within - POSTURE * odd
        return scores

    def depth(self, state: BodyState, drawn: tuple[int, ...]) -> NDArray:
        """(h, w) [m] depth of some segments in the view, inf where none is; fingers are folded where that is better."""
        view, part = self.view, self._parts(drawn)
        frames, _ = self.body.tree.forward(state.T_world_root, state.angles)
        x = BodyMesh(part.vertices, part.faces, part.owner, np.zeros(0, np.int32)).posed(frames)
        x = x @ view.T_view_world[:3, :3].T + view.T_view_world[:3, 3]
        height, width = view.observed.shape
        shown = rasterise(x, part.faces, view.lens, (width, height))
        hands = np.zeros((1 + part.fingers.max(initial=0), 2))
        if len(hands) > 1:
            hand = np.append(part.fingers, 0)[shown.face]
            kernels.of_hands(shown.depth, hand, view.observed, view.behind, view.trust, TOLERANCE, hands)
            folded = (hands[:, 0] <= hands[:, 1]) & (np.arange(len(hands)) > 0)
            if folded.any():
                shown = rasterise(x, part.faces[~folded[part.fingers]], view.lens, (width, height))
        return shown.depth

    def of(self, state: BodyState) -> float:
        """Score of one state."""
        return float(self(state.T_world_root[None], state.angles[None])[0])

    def missing(self, state: BodyState) -> float:
        """Share of the person in pieces of a limb's size that nothing of the body is drawn at, nor near it."""
        return sum(map(len, self.unexplained(state))) / self.pixels

    def unexplained(self, state: BodyState) -> list[NDArray]:
        """Pieces (N, 3) [m] of the person that nothing of the body is drawn at, nor near it.

        What is longer than half of the person is a floor, a wall, furniture.
        """
        view, longest = self.view, 0.5 * self.body.stature
        drawn = self.depth(state, tuple(range(len(self.body.tree.segments))))
        far = view.seen & ~(np.abs(drawn - view.observed) < TOLERANCE)
        around, nothing = np.ones((3, 3), np.uint8), np.float32(1e3)
        nearest = cv2.erode(np.where(view.seen, view.observed, nothing), around)
        whole = cv2.dilate(view.observed, around) - nearest < TOLERANCE  # no step in depth parts it
        thick = cv2.morphologyEx((far & whole).astype(np.uint8), cv2.MORPH_OPEN, around)  # no sliver along an outline
        count, piece = cv2.connectedComponents(thick)
        pieces = [view.points[piece == k] for k in range(1, count)]
        return [x for x in pieces if np.linalg.norm(np.ptp(x, axis=0)) < longest]

    def visible(self, state: BodyState) -> NDArray:
        """(S,) share of each segment's own outline that the sensor could see: within its image, behind nothing."""
        tree, view, mesh = self.body.tree, self.view, self.mesh
        frames, _ = tree.forward(state.T_world_root, state.angles)
        x = mesh.posed(frames) @ view.T_view_world[:3, :3].T + view.T_view_world[:3, 3]
        h, w = view.observed.shape
        canvas = Canvas((3 * w, 3 * h))  # the view in the middle: how much lies beside it counts too
        lens = view.lens + (0, 0, w, h)
        raster = canvas.draw(x, mesh.faces, lens)
        middle = (slice(h, 2 * h), slice(w, 2 * w))
        nearer = np.where(view.seen, np.inf, view.behind)
        shown = (raster.face[middle] >= 0) & (view.trust > 0) & (raster.depth[middle] < nearer)
        count = np.bincount(mesh.face_segment[raster.face[middle][shown]], minlength=len(tree.segments))
        faces = [mesh.faces[mesh.face_segment == s] for s in range(len(tree.segments))]
        own = [np.sum(canvas.draw(x, f, lens).face >= 0) for f in faces]
        return count / np.maximum(own, 1.0)
