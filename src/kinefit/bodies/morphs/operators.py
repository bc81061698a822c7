"""What changes a body with its pose (P1 3): joints that move, surfaces that blend or bulge with an angle.

Every operator is steered by one joint angle, which makes a weight s from 0 (nothing) to 1 (all of it):

    joint motion    the joint, and all beyond it, is moved by exp(s ξ), P1's interpolating motor Mₜ        (P1 3.1)
    global morph    F = F1 ω + F2 (1 − ω), s = 1 − ω: from the surface at rest to another of its topology  (P1 3.2)
    local morph     every node is shifted by s r(node) d, r a radial basis function                        (P1 3.3)

Shifts of nodes add up, so several operators may act on one patch. `morphing_cga` has the same as it is printed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.morphs.steering import Steering
from kinefit.bodies.surfaces.cylinder import TaperedCylinder
from kinefit.bodies.surfaces.mesh import MeshSurface
from kinefit.bodies.tree import KinematicTree
from kinefit.errors import BodyError
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

    def __post_init__(self) -> None:
        if np.shape(self.twist) != (6,) or not np.isfinite(self.twist).all():
            raise BodyError(f"a joint's motion by {self.twist}", remedy="Give six finite numbers (v, ω).")

    @classmethod
    def shift(cls, segment: str, by: ArrayLike, steering: Steering) -> JointMotion:
        """A motion by (3,) [m], without a turn."""
        return cls(segment, np.concatenate([np.asarray(by, float), np.zeros(3)]), steering)

    @classmethod
    def between(cls, segment: str, line: ArrayLike, other: ArrayLike, steering: Steering) -> JointMotion:
        """The shortest motion that takes a hinge's line to another: Plücker lines (6,) in the root frame at rest."""
        M = between(screw(line_of(line)), screw(line_of(other)))
        return cls(segment, twist_coordinates(log(M)), steering)

    def stretched(self, old: KinematicTree, new: KinematicTree, factors: NDArray) -> JointMotion:
        """The motion of a body whose segments were stretched by factors (S,): as far as its parent grew."""
        s = old.segment(self.segment)
        xi = se3.adjoint(se3.transform(np.eye(3), -old.rest[s])) @ self.twist
        xi[:3] *= factors[old.parents[s]]
        return replace(self, twist=se3.adjoint(se3.transform(np.eye(3), new.rest[s])) @ xi)


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

    def stretched(self, old: KinematicTree, new: KinematicTree, factors: NDArray) -> GlobalMorph:
        """Nodes of their own do not follow."""
        if np.allclose(factors, 1.0):
            return self
        problem = "a body that blends to nodes given one by one is to be stretched"
        raise BodyError(problem, remedy="Fit without lengths, or declare `surface` of a segment as the target.")


@dataclass(frozen=True, eq=False)
class SegmentMorph:
    """A second shape of one segment's surfaces (P1 3.2): a muscle that thickens.

    Parameters
    ----------
    segment : str
    surfaces : as many as the segment has, each of the kind of the one that it replaces.
    steering : Steering
    """

    segment: str
    surfaces: tuple[TaperedCylinder | MeshSurface, ...]
    steering: Steering

    def stretched(self, old: KinematicTree, new: KinematicTree, factors: NDArray) -> SegmentMorph:
        """Its surfaces stretched with their segment."""
        factor = float(factors[old.segment(self.segment)])
        return replace(self, surfaces=tuple(s.scaled(factor) for s in self.surfaces))


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
    segment : str, that whose frame the centre is in; default: the root frame at rest.
    on : names of the segments whose nodes it moves; default: all.
    moves : whether centre and shift go along with the segment, so that the nodes bulge that it gets to: a shoulder
        blade under the skin. Else they are those near the centre at rest.

    Raises
    ------
    BodyError
        One that moves without a segment.
    """

    centre: NDArray
    radii: NDArray
    shift: NDArray
    steering: Steering
    segment: str | None = None
    on: tuple[str, ...] = ()
    moves: bool = False

    def __post_init__(self) -> None:
        if self.moves and self.segment is None:
            raise BodyError("a bulge that moves with no segment", remedy="Name the segment that carries it.")

    def placed(self, tree: KinematicTree) -> LocalMorph:
        """With its centre in the root frame at rest."""
        if self.segment is None:
            return self
        centre = np.asarray(self.centre, float) + tree.rest[tree.segment(self.segment)]
        return replace(self, centre=centre, segment=None, moves=False)

    def field(self, x: NDArray, parameters: NDArray | None) -> NDArray:
        """(V, 3) [m] shifts of the nodes x (V, 3), or of those at `parameters` (V, n), when all of it acts."""
        at = x if parameters is None else parameters
        shift = np.asarray(self.shift, float)
        if shift.shape != (3,) or not np.isfinite(shift).all():
            raise BodyError(f"a bulge by {self.shift}", remedy="Give three numbers in metres.")
        return radial_basis(at, self.centre, self.radii)[:, None] * shift

    def stretched(self, old: KinematicTree, new: KinematicTree, factors: NDArray) -> LocalMorph:
        """The bulge on a body whose segments were stretched by factors (S,); about its segment, if it has one."""
        if self.segment is None:
            return self
        f = float(factors[old.segment(self.segment)])
        centre, radii, shift = (f * np.asarray(v, float) for v in (self.centre, self.radii, self.shift))
        return replace(self, centre=centre, radii=radii, shift=shift)


def radial_basis(x: ArrayLike, centre: ArrayLike, radii: ArrayLike) -> NDArray:
    """r(x) = Π_i exp(−(x_i − c_i)² / radius_i²) (...) of x (..., n), centre (n,) and radii (n,) (P1 3.3)."""
    x, c, radius = np.asarray(x, float), np.asarray(centre, float), np.asarray(radii, float)
    if c.shape != radius.shape or c.shape != x.shape[-1:] or not np.all(radius > 0) or not np.isfinite(c).all():
        problem = f"a bulge with centre {c} and radii {radius} for nodes of {x.shape[-1]} coordinates"
        raise BodyError(problem, remedy="Give as many of each, the radii positive.")
    return np.exp(-np.sum(((x - c) / radius) ** 2, -1))


Operator = JointMotion | GlobalMorph | SegmentMorph | LocalMorph
