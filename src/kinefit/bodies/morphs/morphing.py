"""Pose a body with its skin, moving joints and morphing surfaces (P1 3).

`operators` defines a body's operators, this module applies them. The derivative of every node includes that of its
morphs, which P1 treats as constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.body import Body, PointSet
from kinefit.bodies.morphs import operators as kinds
from kinefit.bodies.morphs.operators import GlobalMorph, JointMotion, LocalMorph, Operator, SegmentMorph, radial_basis
from kinefit.bodies.surfaces import BodyMesh, MeshSurface, SkinnedMesh, triangles
from kinefit.bodies.surfaces.places import body_mesh
from kinefit.bodies.surfaces.skins import _kernels_skinning as kernels
from kinefit.bodies.tree import BodyState
from kinefit.errors import BodyError, choices
from kinefit.geometry import se3

__all__ = [
    "GlobalMorph", "JointMotion", "LocalMorph", "MorphedPose", "Morphing", "Operator", "SegmentMorph", "radial_basis",
]

_AROUND, _ALONG = 20, 6  # nodes of cylinders, see `body_mesh`
_MIN_BULGE = 1e-8  # of a radial basis function: derivatives of smaller values are ignored
_MAX_LOW_PASSES = 40  # for the coarsest approximation of a mesh


class Morphing:
    """A body with its skin, and the operators that change both.

    Parameters
    ----------
    body : Body
    mesh : nodes in the root frame at rest with their segments; default: the body's skin, or else its surfaces.
    operators : any number of each kind; default: the body's own.
    parameters : (V, n) of the nodes, for local morphs in the surface's parameters.

    Attributes
    ----------
    mesh : the posed mesh, with `faces`, `segment` and `face_segment`.
    skin : SkinnedMesh, the same.

    Raises
    ------
    BodyError
        An unknown coordinate or segment; a target of another topology; a body without surfaces.
    """

    def __init__(
        self,
        body: Body,
        mesh: BodyMesh | SkinnedMesh | None = None,
        operators: Sequence[Operator] | None = None,
        parameters: NDArray | None = None,
    ) -> None:
        self.body = body
        self.mesh = mesh or body.skin or body_mesh(body, around=_AROUND, along=_ALONG)
        self.skin = self.mesh if isinstance(self.mesh, SkinnedMesh) else SkinnedMesh.of_mesh(self.mesh)
        self.operators = body.morphs if operators is None else tuple(operators)
        tree, x = body.tree, self.mesh.vertices
        if self.skin.owners.size and self.skin.owners.max() >= len(tree.segments):
            problem = f"a skin with segment {self.skin.owners.max()} for a body with {len(tree.segments)}"
            raise BodyError(problem, remedy="Take the skin of this body.")
        for o in self.operators:
            if o.steering.coordinate not in tree.coordinates:
                name = o.steering.coordinate
                raise BodyError(choices(f"angle of body '{body.name}' named", name, tree.coordinates))
        motions = [(o, tree.segment(o.segment)) for o in self.operators if isinstance(o, JointMotion)]
        if any(s == 0 for _, s in motions):
            raise BodyError("the root has no joint that could move", remedy="Name a segment that has a joint.")
        self._motions: dict[int, list[JointMotion]] = {}
        for o, s in motions:
            self._motions.setdefault(s, []).append(o)
        self._fields: list[tuple[kinds.Steering, NDArray]] = []
        # Bulges of one function r, at rest, that act together; nodes, their shares, and the segment that carries them.
        self._bulges: list[tuple[list[LocalMorph], NDArray, NDArray, int | None]] = []
        together: dict[object, list[LocalMorph]] = {}
        for o in self.operators:
            if isinstance(o, GlobalMorph):
                self._fields.append((o.steering, o.field(x, parameters)))
            elif isinstance(o, SegmentMorph):
                self._fields.append((o.steering, self._segment_field(o)))
            elif isinstance(o, LocalMorph) and (o.moves or o.deforms):
                carrier, share = tree.segment(str(o.segment)) if o.moves else None, self._node_shares(o)[:, 0]
                one = (carrier, o.on, *(np.asarray(v, float).tobytes() for v in (o.centre, o.radii, o.tilt)))
                bulges = together.setdefault(id(o) if o.deforms else one, [])
                bulges.append(o.placed(tree))
                if len(bulges) == 1:
                    nodes = np.flatnonzero(share)
                    self._bulges.append((bulges, nodes, share[nodes], carrier))
            elif isinstance(o, LocalMorph):
                self._fields.append((o.steering, self._node_shares(o) * o.placed(tree).field(x, parameters)))
        above = np.eye(len(tree.segments), dtype=bool)
        for s in range(1, len(tree.segments)):
            above[s] |= above[tree.parents[s]]
        self._above = above

    @property
    def is_rigid(self) -> bool:
        """Whether every node belongs to one segment and nothing morphs, so that `Rows` describe the body."""
        return not self.operators and self.skin.owners.shape[1] == 1

    @property
    def moves_joints(self) -> bool:
        """Whether a joint moves with an angle, so that frames differ from those of the tree alone."""
        return bool(self._motions)

    def levels(self, count: int) -> list[Morphing]:
        """Low-pass approximations from coarse to fine, the last one unchanged, for a coarse-to-fine fit (P1 2.4).

        Fourier surfaces are approximated by lower orders, all other meshes by `low_pass`.
        """
        skin, out = self.skin, []
        own = () if self.mesh is self.body.skin else self.body.surfaces
        sizes = [len(triangles(s, _AROUND, _ALONG)[0]) for s in own]
        if sum(sizes) != len(skin.nodes):  # the mesh is not that of the surfaces
            own = ()
        series = {
            sum(sizes[:k]): s.low_pass_shifts(count)
            for k, s in enumerate(own) if isinstance(s, MeshSurface) and s.series is not None
        }  # fmt: skip
        for k in range(count - 1):
            passes = round(_MAX_LOW_PASSES * ((count - 1 - k) / (count - 1)) ** 2)
            shift = low_pass(skin.vertices, skin.faces, passes) - skin.vertices
            for first, shifts in series.items():
                shift[first : first + len(shifts[k])] = shifts[k]
            smooth = copy(self)
            smooth.skin = smooth.mesh = SkinnedMesh(skin.nodes + shift[:, None], skin.faces, skin.owners, skin.weights)
            out.append(smooth)
        return [*out, self]

    def _node_shares(self, morph: LocalMorph) -> NDArray:
        """Share (V, 1) of each node that belongs to segments of a local morph."""
        if not morph.on:
            return np.ones((len(self.skin.nodes), 1))
        chosen = np.isin(self.skin.owners, [self.body.tree.segment(name) for name in morph.on])
        return np.sum(self.skin.weights * chosen, 1, keepdims=True)

    def _segment_field(self, morph: SegmentMorph) -> NDArray:
        """Shifts (V, 3) [m] from a segment's surfaces to their second shape, for the mesh of the body's surfaces."""
        here, body = self.body.tree.segment(morph.segment), self.body
        place, remedy = f"morph of {morph.segment}", "Give one for each of the segment's surfaces, of the same kind."
        meshes = [triangles(s, _AROUND, _ALONG) for s in body.surfaces]
        if sum(len(v) for v, _ in meshes) != len(self.mesh.vertices) or self.mesh is body.skin:
            problem = "a segment's surface blends to another, but the body's skin or mesh has other points"
            raise BodyError(problem, place=place, remedy="Use a global morph of all its nodes.")
        targets = list(morph.surfaces)
        if len(targets) != sum(s.segment == here for s in body.surfaces):
            raise BodyError(f"{len(targets)} surfaces as the target of others", place=place, remedy=remedy)
        out, first = np.zeros_like(self.mesh.vertices), 0
        for surface, (v, faces) in zip(body.surfaces, meshes):
            if surface.segment == here:
                target, other = triangles(targets.pop(0), _AROUND, _ALONG)
                if target.shape != v.shape or not np.array_equal(other, faces):
                    raise BodyError("a surface that blends to one of another topology", place=place, remedy=remedy)
                out[first : first + len(v)] = target - v
            first += len(v)
        return out

    def _weight_of(self, steering: kinds.Steering, state: BodyState) -> tuple[int, float, float]:
        d = self.body.tree.coordinate(steering.coordinate)
        return (d, *steering.at(float(state.angles[d])))

    def _with_joint_motions(self, state: BodyState) -> tuple[NDArray, NDArray, list[tuple[int, int, NDArray]]]:
        """Frames (S, 12) and screws (D, 6) with the joints moved, and the derivatives of joint motions by angles."""
        tree, centre = self.body.tree, state.T_world_root[:3, 3]
        plain, screws = tree.forward(state.T_world_root, state.angles)
        drives: list[tuple[int, int, NDArray]] = []
        if not self._motions:
            return plain, screws, drives
        Ts = se3.transform(plain[:, :9].reshape(-1, 3, 3), plain[:, 9:])
        moved: dict[int, NDArray] = {}  # of segments below a moving joint
        to_centre, back = se3.transform(np.eye(3), -centre), se3.transform(np.eye(3), centre)
        for s in range(1, len(Ts)):
            p = int(tree.parents[s])
            if p in moved:
                moved[s] = moved[p]
            for motion in self._motions.get(s, ()):
                d, weight, slope = self._weight_of(motion.steering, state)
                at = moved.get(s, np.eye(4)) @ Ts[p]
                if slope:
                    drives.append((6 + d, s, slope * (se3.adjoint(to_centre @ at) @ motion.twist)))
                moved[s] = at @ se3.exp(weight * motion.twist) @ se3.inverse(Ts[p])
            if s in moved:
                own = slice(tree.dof_start[s], tree.dof_start[s + 1])
                screws[own] = screws[own] @ se3.adjoint(to_centre @ moved[s] @ back).T
        frames = plain.copy()
        for s, motion_of_s in moved.items():
            T = motion_of_s @ Ts[s]
            frames[s, :9], frames[s, 9:] = T[:3, :3].ravel(), T[:3, 3]
        return frames, screws, drives

    def pose(self, state: BodyState) -> MorphedPose:
        """Frames, screws and nodes of a state."""
        frames, screws, drives = self._with_joint_motions(state)
        shift: NDArray | None = None
        for steering, field in self._fields:
            if weight := self._weight_of(steering, state)[1]:
                shift = weight * field if shift is None else shift + weight * field
        for bulges, nodes, share, bone in self._bulges:
            weights = [self._weight_of(bulge.steering, state)[1] for bulge in bulges]
            if any(weights):
                shift = np.zeros_like(self.skin.vertices) if shift is None else shift
                _, y, along, back = self._carried(bulges, nodes, bone, frames)
                shift[nodes] += (share * bulges[0].value(y, weights[0]))[:, None] * (weights @ along @ back)
        return MorphedPose(self, state, frames, screws, shift, tuple(drives))

    def _carried(
        self, bulges: Sequence[LocalMorph], nodes: NDArray, bone: int | None, frames: NDArray
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Bulges that move with a bone, r(y) of nodes y in the bone's frame in this pose, or that deform.

        A node x at rest on segment n has y = T_bone⁻¹ T_n x, and is shifted by s r(y, s) R_nᵀ R_bone d. Without a bone
        y = x, and the shift is s r(x, s) d.

        Returns
        -------
        T_n x (k, 3) [m], y (k, 3) [m], R_bone d (b, 3) [m] of each bulge, and R_n, (k, 3, 3) or (3, 3).
        """
        x, shifts = self.skin.vertices[nodes], np.array([bulge.shift for bulge in bulges], float)
        if bone is None:
            return x, x, shifts, np.eye(3)
        R, t = frames[:, :9].reshape(-1, 3, 3), frames[:, 9:]
        back = R[self.skin.segment[nodes]]
        at = np.einsum("vij,vj->vi", back, x) + t[self.skin.segment[nodes]]
        return at, (at - t[bone]) @ R[bone], shifts @ R[bone].T, back

    def _slopes(self, pose: MorphedPose) -> dict[int, NDArray]:
        """Derivatives (V, 3) of the nodes at rest by degrees of freedom; see `MorphedPose`.

        An angle that moves segment n relative to a bulge's bone with (v, ω) changes y of `_carried` by R_boneᵀ (v + ω ×
        T_n x), and rotates R_nᵀ R_bone d by −ω.
        """
        out: dict[int, NDArray] = {}

        def add(dof: int, nodes: NDArray | slice, change: NDArray) -> None:
            if dof not in out:
                out[dof] = np.zeros_like(self.skin.vertices)
            out[dof][nodes] += change

        for steering, field in self._fields:
            d, _, slope = self._weight_of(steering, pose.state)
            if slope:
                add(6 + d, slice(None), slope * field)
        R = pose.frames[:, :9].reshape(-1, 3, 3)
        for bulges, nodes, share, bone in self._bulges:
            steered = [self._weight_of(bulge.steering, pose.state) for bulge in bulges]
            weights = [weight for _, weight, _ in steered]
            at, y, each, back = self._carried(bulges, nodes, bone, pose.frames)
            by_point, by_weight = bulges[0].slopes(y, weights[0])
            r, owner = share * bulges[0].value(y, weights[0]), self.skin.segment[nodes]
            for (d, weight, slope), of_one in zip(steered, each):
                if slope:
                    add(6 + d, nodes, slope * (r + weight * share * by_weight)[:, None] * (of_one @ back))
            if bone is None or not any(weights):
                continue
            along = weights @ each
            for n in np.unique(owner[r > _MIN_BULGE]):
                own = np.flatnonzero((owner == n) & (r > _MIN_BULGE))
                apart = pose.segment_jacobian(int(n)) - pose.segment_jacobian(bone)
                moving = np.flatnonzero(np.abs(apart).max(axis=0) > 0.0)
                v, w = apart[:3, moving], apart[3:, moving]
                rise = share[own, None] * by_point[own] @ R[bone].T  # of r, in the world
                more = rise @ v + np.cross(at[own] - pose.state.T_world_root[:3, 3], rise) @ w
                turned = r[own, None, None] * np.cross(w.T, along)
                change = (more[:, :, None] * along - turned) @ R[n]
                for k, of_k in zip(moving, change.swapaxes(0, 1)):
                    add(int(k), nodes[own], of_k)
        return out


@dataclass(frozen=True, eq=False)
class MorphedPose:
    """A body with its skin in one state.

    Parameters
    ----------
    morphing : Morphing
    state : BodyState
    frames : (S, 12) and screws : (D, 6), like those of `KinematicTree.forward`.
    shift : (V, 3) [m] of the nodes at rest, by all morphs; None without an active morph.
    drives : (degree of freedom, segment, (6,) twist about the root's origin): derivatives of joint motions by angles.
    """

    morphing: Morphing
    state: BodyState
    frames: NDArray
    screws: NDArray
    shift: NDArray | None
    drives: tuple[tuple[int, int, NDArray], ...]

    @cached_property
    def slopes(self) -> dict[int, NDArray]:
        """Degree of freedom -> (V, 3) derivative of the nodes at rest by it."""
        return self.morphing._slopes(self)

    def positions(self, points: PointSet) -> NDArray:
        """Points (K, 3) [m] in the world, with the motions of joints."""
        f = self.frames[points.segments]
        x = self.morphing.body.points_rest(points)
        return np.asarray((f[:, :9].reshape(-1, 3, 3) @ x[:, :, None])[..., 0] + f[:, 9:])

    @property
    def nodes(self) -> NDArray:
        """Morphed nodes (V, 3) [m] of the mesh in the root frame at rest."""
        x = self.morphing.mesh.vertices
        return x.copy() if self.shift is None else x + self.shift

    @cached_property
    def vertices(self) -> NDArray:
        """Nodes (V, 3) [m] in the world."""
        return self.morphing.skin.posed(self.frames, self.shift)

    def segment_jacobian(self, segment: int) -> NDArray:
        """Jacobian J_s (6, 6 + D), as `KinematicTree.segment_jacobian`, with the motions of joints."""
        out = self.morphing.body.tree.segment_jacobian(self.screws, segment)
        for d, s, twist in self.drives:
            if self.morphing._above[segment, s]:
                out[:, d] += twist
        return out

    def along(self, index: ArrayLike, direction: ArrayLike, share: ArrayLike | None = None) -> NDArray:
        """Derivatives n·∂x/∂δ (N, 6 + D) of surface points along directions n, including those of the morphs.

        Parameters
        ----------
        index : (N,) int, nodes; or (N, C), the nodes that each point lies between.
        direction : (N, 3) in the world.
        share : (N, C) barycentric coordinates; default 1.

        Raises
        ------
        BodyError
            Arrays that do not match, or nodes out of range.
        """
        skin, tree = self.morphing.skin, self.morphing.body.tree
        n = np.ascontiguousarray(direction, float)
        chosen = np.ascontiguousarray(np.asarray(index, np.int64).reshape(len(n), -1))
        part = np.ones(chosen.shape) if share is None else np.ascontiguousarray(share, float)
        if part.shape != chosen.shape or n.shape != (len(n), 3):
            problem = f"points between nodes {chosen.shape} with shares {part.shape} and directions {n.shape}"
            raise BodyError(problem, remedy="Give (N, C), (N, C) and (N, 3).")
        if chosen.size and not 0 <= chosen.min() <= chosen.max() < len(skin.nodes):
            raise BodyError(f"node numbers beyond the {len(skin.nodes)} of the surface", remedy="Count from 0.")
        nodes = skin.nodes if self.shift is None else skin.nodes + self.shift[:, None]
        drive_dof = np.array([d for d, _, _ in self.drives], np.int64)
        drive_segment = np.array([s for _, s, _ in self.drives], np.int64)
        drive_twist = np.array([t for _, _, t in self.drives]).reshape(-1, 6)
        centre, out = np.ascontiguousarray(self.state.T_world_root[:3, 3]), np.empty((len(n), tree.n_dofs))
        kernels.moves(
            nodes, skin.owners, skin.weights, chosen, part, n, centre, self.frames, self.screws, tree.dof_parent,
            tree.last_dof, drive_dof, drive_segment, drive_twist, self.morphing._above, out,
        )  # fmt: skip
        if self.slopes:
            R = self.frames[:, :9].reshape(-1, 3, 3)
            moving = np.flatnonzero(self._are_moving[chosen].any(axis=1))
            back = part[moving, :, None] * np.einsum(
                "nck,nckij,ni->ncj", skin.weights[chosen[moving]], R[skin.owners[chosen[moving]]], n[moving]
            )  # fmt: skip
            for d, slope in self.slopes.items():
                out[moving, d] += np.einsum("ncj,ncj->n", back, slope[chosen[moving]])
        return out

    @cached_property
    def _are_moving(self) -> NDArray:
        """(V,) bool: nodes that a morph moves with an angle."""
        return np.any([slope.any(axis=1) for slope in self.slopes.values()], axis=0)

    def jacobian(self, index: ArrayLike) -> NDArray:
        """Derivatives (K, 3, 6 + D) of the nodes `index` (K,) in the world by δ, including those of the morphs."""
        chosen = np.repeat(np.asarray(index, np.int64), 3)
        axes = np.tile(np.eye(3), (len(chosen) // 3, 1))
        return self.along(chosen, axes).reshape(-1, 3, self.morphing.body.tree.n_dofs)


_LAMBDA, _MU = 0.5, -0.525  # of Taubin: frequencies below 1/λ + 1/μ = 0.095 of the mesh's highest pass


def low_pass(vertices: NDArray, faces: NDArray, passes: int) -> NDArray:
    """Remove the high frequencies of a mesh: vertices (V, 3) [m]; more passes make a steeper filter.

    Source: Taubin, A signal processing approach to fair surface design (SIGGRAPH 1995). Eigenvectors of the mesh's
    Laplacian are its frequencies; alternating steps of positive and negative weight keep the low ones without
    shrinking.

    Parameters
    ----------
    vertices : (V, 3) [m]
    faces : (T, 3) int
    passes : int; 0 returns the mesh unchanged.
    """
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    a, b = edges.T
    count = np.maximum(np.bincount(a, minlength=len(vertices)) + np.bincount(b, minlength=len(vertices)), 1)[:, None]
    x = np.array(vertices, float)
    for k in range(2 * passes):
        total = np.zeros_like(x)
        for axis in range(3):
            total[:, axis] = np.bincount(a, x[b, axis], len(x)) + np.bincount(b, x[a, axis], len(x))
        x += (_MU if k % 2 else _LAMBDA) * np.where(count > 0, total / count - x, 0.0)
    return x
