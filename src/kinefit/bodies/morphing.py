"""Bodies that change their shape with their pose (P1 3): joints that move, surfaces that blend or bulge with an angle.

Every operator is steered by one joint angle, which makes a weight s from 0 (nothing) to 1 (all of it):

    joint motion    the joint, and all beyond it, is moved by exp(s ξ), P1's interpolating motor Mₜ        (P1 3.1)
    global morph    F = F1 ω + F2 (1 − ω), s = 1 − ω: from the surface at rest to another of its topology  (P1 3.2)
    local morph     every node is shifted by s r(node) d, r a radial basis function                        (P1 3.3)

Shifts of nodes add up, so several operators may act on one patch. `morphing_cga` has the same as it is printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.body import Body
from kinefit.bodies.state import BodyState
from kinefit.bodies.steering import Steering
from kinefit.bodies.surfaces.triangles import BodyMesh
from kinefit.errors import BodyError, choices
from kinefit.geometry import se3
from kinefit.geometry.cga import between, line_of, log, screw, twist_coordinates


@dataclass(frozen=True, eq=False)
class JointMotion:
    """A joint that moves with an angle (P1 3.1): the shoulder that sinks as the arm does.

    Parameters
    ----------
    segment : str, the segment beyond the joint; it and all behind it go along.
    twist : (6,) ξ = (v, ω) [m, rad] in the root frame at rest; exp(s ξ) moves the joint from its place at rest.
    steering : Steering
    """

    segment: str
    twist: NDArray
    steering: Steering

    @classmethod
    def shift(cls, segment: str, by: ArrayLike, steering: Steering) -> JointMotion:
        """A motion by (3,) [m], without a turn."""
        return cls(segment, np.concatenate([np.asarray(by, float), np.zeros(3)]), steering)

    @classmethod
    def between(cls, segment: str, line: ArrayLike, other: ArrayLike, steering: Steering) -> JointMotion:
        """The shortest motion that takes a hinge's line to another: Plücker lines (6,) in the root frame at rest."""
        M = between(screw(line_of(line)), screw(line_of(other)))
        return cls(segment, twist_coordinates(log(M)), steering)


@dataclass(frozen=True, eq=False)
class GlobalMorph:
    """A second surface of the same topology (P1 3.2): the steering angle blends from the surface at rest to it.

    Parameters
    ----------
    target : (V, 3) [m] nodes in the root frame at rest.
    steering : Steering
    """

    target: NDArray
    steering: Steering

    def field(self, x: NDArray, parameters: NDArray | None) -> NDArray:
        """(V, 3) [m] shifts of the nodes x (V, 3) when all of it acts."""
        if np.shape(self.target) != x.shape or not np.isfinite(self.target).all():
            problem = f"a morph to {np.shape(self.target)} nodes of a surface that has {x.shape}, or not finite"
            raise BodyError(problem, remedy="Both surfaces must have one topology.")
        return np.asarray(self.target, float) - x


@dataclass(frozen=True, eq=False)
class LocalMorph:
    """A bulge (P1 3.3): shifts by r d with r = Π exp(−(x − c)² / radius²), from a centre outwards ever less.

    Parameters
    ----------
    centre, radii : (n,)
        In space (n = 3) [m], or in the surface's own parameters, of which the nodes then have n each. An infinite
        radius leaves a direction out. P1's r_x is the square of a radius.
    shift : (3,) [m] d, of a node at the centre when all of it acts; any direction.
    steering : Steering
    """

    centre: NDArray
    radii: NDArray
    shift: NDArray
    steering: Steering

    def field(self, x: NDArray, parameters: NDArray | None) -> NDArray:
        """(V, 3) [m] shifts of the nodes x (V, 3), or of those at `parameters` (V, n), when all of it acts."""
        at = x if parameters is None else parameters
        return radial_basis(at, self.centre, self.radii)[:, None] * np.asarray(self.shift, float)


def radial_basis(x: ArrayLike, centre: ArrayLike, radii: ArrayLike) -> NDArray:
    """r(x) = Π_i exp(−(x_i − c_i)² / radius_i²) (...) of x (..., n), centre (n,) and radii (n,) (P1 3.3)."""
    x, c, radius = np.asarray(x, float), np.asarray(centre, float), np.asarray(radii, float)
    if c.shape != radius.shape or c.shape != x.shape[-1:] or not np.all(radius > 0) or not np.isfinite(c).all():
        problem = f"a bulge with centre {c} and radii {radius} for nodes of {x.shape[-1]} coordinates"
        raise BodyError(problem, remedy="Give as many of each, the radii positive.")
    return np.exp(-np.sum(((x - c) / radius) ** 2, -1))


Operator = JointMotion | GlobalMorph | LocalMorph


class Morphing:
    """A body with its mesh and the operators that change both.

    Parameters
    ----------
    body : Body
    mesh : BodyMesh, nodes in the root frame at rest, each with its segment.
    operators : any number of each kind.
    parameters : (V, n) of the nodes, where local morphs are given in the surface's own parameters.

    Raises
    ------
    BodyError
        An unknown coordinate or segment; a target of another topology.
    """

    def __init__(
        self, body: Body, mesh: BodyMesh, operators: Sequence[Operator], parameters: NDArray | None = None
    ) -> None:
        self.body, self.mesh, self.operators = body, mesh, tuple(operators)
        for operator in self.operators:
            if operator.steering.coordinate not in body.tree.coordinates:
                name = operator.steering.coordinate
                raise BodyError(choices(f"angle of body '{body.name}' named", name, body.tree.coordinates))
        self._motions = [(o, body.tree.segment(o.segment)) for o in self.operators if isinstance(o, JointMotion)]
        if any(s == 0 for _, s in self._motions):
            raise BodyError("the root has no joint that could move", remedy="Name a segment beyond a joint.")
        morphs = [o for o in self.operators if not isinstance(o, JointMotion)]
        self._fields = [(o.steering, o.field(mesh.vertices, parameters)) for o in morphs]

    def _steered(self, steering: Steering, state: BodyState) -> tuple[int, float, float]:
        d = self.body.tree.coordinate(steering.coordinate)
        return (d, *steering.at(float(state.angles[d])))

    def pose(self, state: BodyState) -> MorphedPose:
        """Frames, screws and nodes of a state."""
        tree, centre = self.body.tree, state.T_world_root[:3, 3]
        plain, screws = tree.forward(state.T_world_root, state.angles)
        Ts = se3.transform(plain[:, :9].reshape(-1, 3, 3), plain[:, 9:])
        screws, moved = screws.copy(), np.broadcast_to(np.eye(4), Ts.shape).copy()
        to_centre = se3.transform(np.eye(3), -centre)
        drives: list[tuple[int, int, NDArray]] = []
        for s in range(1, len(Ts)):
            p = tree.parents[s]
            moved[s] = moved[p]
            for motion, segment in self._motions:
                if segment == s:
                    d, weight, slope = self._steered(motion.steering, state)
                    at = moved[s] @ Ts[p]
                    drives.append((6 + d, s, slope * (se3.adjoint(to_centre @ at) @ motion.twist)))
                    moved[s] = at @ se3.exp(weight * motion.twist) @ se3.inverse(Ts[p])
            own = np.arange(tree.dof_start[s], tree.dof_start[s + 1])
            about = to_centre @ moved[s] @ se3.inverse(to_centre)
            screws[own] = screws[own] @ se3.adjoint(about).T
        Ts = moved @ Ts
        frames = np.concatenate([Ts[:, :3, :3].reshape(-1, 9), Ts[:, :3, 3]], 1)
        nodes = self.mesh.vertices.copy()
        slopes: dict[int, NDArray] = {}
        for steering, field in self._fields:
            d, weight, slope = self._steered(steering, state)
            nodes += weight * field
            if slope:
                slopes[6 + d] = slopes.get(6 + d, np.zeros_like(field)) + slope * field
        return MorphedPose(self, state, np.ascontiguousarray(frames), screws, nodes, slopes, tuple(drives))


@dataclass(frozen=True, eq=False)
class MorphedPose:
    """A morphed body in one state.

    Parameters
    ----------
    morphing : Morphing
    state : BodyState
    frames : (S, 12) and screws : (D, 6), like those of `KinematicTree.forward`.
    nodes : (V, 3) [m] of the mesh, morphed, in the root frame at rest.
    slopes : degree of freedom -> (V, 3) change of the nodes by it.
    drives : (degree of freedom, segment, (6,) twist about the root's origin): what moves joints with angles.
    """

    morphing: Morphing
    state: BodyState
    frames: NDArray
    screws: NDArray
    nodes: NDArray
    slopes: dict[int, NDArray]
    drives: tuple[tuple[int, int, NDArray], ...]

    @cached_property
    def vertices(self) -> NDArray:
        """(V, 3) [m] nodes in the world."""
        mesh = self.morphing.mesh
        return BodyMesh(self.nodes, mesh.faces, mesh.segment, mesh.face_segment).posed(self.frames)

    def segment_jacobian(self, segment: int) -> NDArray:
        """J_s (6, 6 + D), as `KinematicTree.segment_jacobian`, with the joints' motions by their angles."""
        tree = self.morphing.body.tree
        out = tree.segment_jacobian(self.screws, segment)
        above = segment
        while above > 0:
            for d, s, twist in self.drives:
                if s == above:
                    out[:, d] += twist
            above = int(tree.parents[above])
        return out

    def jacobian(self, index: ArrayLike) -> NDArray:
        """(K, 3, 6 + D) change of the nodes `index` (K,) in the world by δ, the morph's own included."""
        chosen = np.asarray(index, np.int64)
        segments, arms = self.morphing.mesh.segment[chosen], self.vertices[chosen] - self.state.T_world_root[:3, 3]
        out = np.empty((len(chosen), 3, self.morphing.body.tree.n_dofs))
        for s in np.unique(segments):
            rows, J = segments == s, self.segment_jacobian(int(s))
            out[rows] = J[:3] - se3.hat(arms[rows]) @ J[3:]
            R = self.frames[s, :9].reshape(3, 3)
            for d, slope in self.slopes.items():
                out[rows, :, d] += slope[chosen[rows]] @ R.T
        return out

