"""How well poses of a body explain a view, many at a time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.bodies.surfaces.triangles import BodyMesh, body_mesh
from kinefit.correspondences.collisions import CollisionPairs, collision_pairs
from kinefit.rendering import Canvas, rasterise
from kinefit.sensors import _kernels_depth_view as kernels
from kinefit.sensors.depth_view import DepthView

TOLERANCE = 0.10  # [m] a drawn surface this far from the measured one explains nothing: the radius of a thigh
OVERLAP = 0.5  # [1/m] share of the score that a metre of parts within parts costs: 2 cm, the softness of flesh, 1 %
POSTURE = 0.004  # share of the score that one standard deviation of every angle from the prior mean costs


def limbs(body: Body) -> tuple[tuple[int, ...], ...]:
    """Segments from each leaf up to where the tree branches, the nearest to the trunk first."""
    parents = body.tree.parents
    children = np.bincount(parents[parents >= 0], minlength=len(parents))
    out = []
    for leaf in np.flatnonzero(children == 0):
        limb = [int(leaf)]
        while parents[limb[-1]] > 0 and children[parents[limb[-1]]] == 1:
            limb.append(int(parents[limb[-1]]))
        if leaf > 0:
            out.append(tuple(limb[::-1]))
    return tuple(out)


def spreads(body: Body) -> NDArray:
    """(D,) [rad or m] prior standard deviation of each coordinate; half its range at most, and 1 without any limit."""
    tree = body.tree
    half = 0.5 * (tree.upper - tree.lower)
    return np.minimum(tree.spread, np.where(np.isfinite(half), half, 1.0))


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
    def _chosen(self) -> dict[tuple[int, ...], tuple[NDArray, NDArray]]:
        return {}

    def _parts(self, segments: tuple[int, ...]) -> tuple[NDArray, NDArray]:
        """(T, 3) triangles of some segments, and which pairs are both among them."""
        if segments not in self._chosen:
            among = np.zeros(len(self.body.tree.segments), bool)
            among[list(segments)] = True
            faces = np.ascontiguousarray(self.mesh.faces[among[self.mesh.face_segment]])
            self._chosen[segments] = faces, among[self._pairs.segment[self._pairs.pairs]].all(axis=1)
        return self._chosen[segments]

    def __call__(
        self, roots: NDArray, angles: NDArray, drawn: tuple[int, ...] | None = None, *,
        moving: tuple[int, ...] | None = None, base: NDArray | None = None,
    ) -> NDArray:  # fmt: skip
        """(B,) score of poses, 1 at best: share of the person explained, less what speaks against them.

        That is: what is drawn where the sensor saw past it, parts within parts, uncommon postures.

        Parameters
        ----------
        roots : (B, 4, 4), angles : (B, D)
        drawn : segments that take part; default all
        moving, base : those of them that differ between the poses, and all others as `depth` draws them: faster
        """
        tree, view, mesh, p = self.body.tree, self.view, self.mesh, self._pairs
        drawn = tuple(range(len(tree.segments))) if drawn is None else drawn
        faces = self._parts(drawn if moving is None else moving)[0]
        out, within = np.empty((len(roots), 2)), np.empty(len(roots))
        roots, angles = np.ascontiguousarray(roots, float), np.ascontiguousarray(angles, float)
        pose = tree.parents, tree.dof_start, tree.prismatic, tree.axes, tree.rest, roots, angles
        kernels.agreement(
            *pose, mesh.vertices, mesh.segment, faces, view.T_view_world, view.lens,
            view.observed, view.behind, view.trust, self._nothing if base is None else base, TOLERANCE, out,
        )  # fmt: skip
        use = self._parts(drawn)[1]
        kernels.overlaps(*pose, p.segment, p.starts, p.ends, p.pairs[use], p.apart[use], within)
        odd = np.mean(((angles - tree.usual) / self._spread) ** 2, axis=1) if angles.shape[1] else 0.0
        scores: NDArray = (out[:, 0] - out[:, 1]) / self.pixels - OVERLAP * within - POSTURE * odd
        return scores

    def depth(self, state: BodyState, drawn: tuple[int, ...]) -> NDArray:
        """(h, w) [m] depth of some segments in the view, inf where none is."""
        view = self.view
        frames, _ = self.body.tree.forward(state.T_world_root, state.angles)
        x = self.mesh.posed(frames) @ view.T_view_world[:3, :3].T + view.T_view_world[:3, 3]
        h, w = view.observed.shape
        fx, fy, cx, cy = view.lens
        return rasterise(x, self._parts(drawn)[0], fx, fy, cx, cy, (w, h)).depth

    def of(self, state: BodyState) -> float:
        """Score of one state."""
        return float(self(state.T_world_root[None], state.angles[None])[0])

    def visible(self, state: BodyState) -> NDArray:
        """(S,) share of each segment's own outline that the sensor could see: within its image, behind nothing."""
        tree, view, mesh = self.body.tree, self.view, self.mesh
        frames, _ = tree.forward(state.T_world_root, state.angles)
        x = mesh.posed(frames) @ view.T_view_world[:3, :3].T + view.T_view_world[:3, 3]
        h, w = view.observed.shape
        canvas = Canvas((3 * w, 3 * h))  # the view in the middle: how much lies beside it counts too
        lens = view.lens + (0, 0, w, h)
        raster = canvas.draw(x, mesh.faces, *lens)
        middle = (slice(h, 2 * h), slice(w, 2 * w))
        nearer = np.where(view.seen, np.inf, view.behind)
        shown = (raster.face[middle] >= 0) & (view.trust > 0) & (raster.depth[middle] < nearer)
        count = np.bincount(mesh.face_segment[raster.face[middle][shown]], minlength=len(tree.segments))
        own = [np.sum(canvas.draw(x, self._parts((s,))[0], *lens).face >= 0) for s in range(len(tree.segments))]
        return count / np.maximum(own, 1.0)
