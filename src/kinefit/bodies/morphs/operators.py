"""Pose-dependent changes of a body (P1 3): moving joints, and surfaces that blend or bulge with an angle.

Every operator depends on one joint angle, which gives a weight s from 0 to 1:

    joint motion    the joint, with all segments below it, moves by exp(s ξ), P1's interpolating motor Mₜ  (P1 3.1)
    global morph    F = F1 ω + F2 (1 − ω), s = 1 − ω: from the surface at rest to another of its topology  (P1 3.2)
    local morph     every node is shifted by s r(node) d, r a radial basis function                        (P1 3.3)

Shifts of nodes add up, so several operators may act on one patch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies.surfaces import MeshSurface, TaperedCylinder
from kinefit.bodies.tree import KinematicTree
from kinefit.errors import BodyError, check_choice
from kinefit.geometry import se3
from kinefit.geometry.cga import between, line_of, log, screw, twist_coordinates


@dataclass(frozen=True, eq=False)
class JointMotion:
    """A joint that moves with an angle (P1 3.1), such as a shoulder that sinks with the arm.

    Parameters
    ----------
    segment : str, the segment below the joint; it moves with all its descendants.
    twist : (6,) ξ = (v, ω) [m, rad] in the root frame at rest; exp(s ξ) moves the joint from its position at rest.
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
        """A translation by (3,) [m]."""
        return cls(segment, np.concatenate([np.asarray(by, float), np.zeros(3)]), steering)

    @classmethod
    def between(cls, segment: str, line: ArrayLike, other: ArrayLike, steering: Steering) -> JointMotion:
        """The shortest motion from one hinge line to another: Plücker lines (6,) [m] in the root frame at rest."""
        M = between(screw(line_of(line)), screw(line_of(other)))
        return cls(segment, twist_coordinates(log(M)), steering)

    def stretched(self, old: KinematicTree, new: KinematicTree, factors: NDArray) -> JointMotion:
        """The motion on a body whose segments were scaled by factors (S,): its shift scales with the parent."""
        s = old.segment(self.segment)
        xi = se3.adjoint(se3.transform(np.eye(3), -old.rest[s])) @ self.twist
        xi[:3] *= factors[old.parents[s]]
        return replace(self, twist=se3.adjoint(se3.transform(np.eye(3), new.rest[s])) @ xi)


@dataclass(frozen=True, eq=False)
class GlobalMorph:
    """A second surface of the same topology (P1 3.2): the angle blends from the surface at rest to it.

    Parameters
    ----------
    target : (V, 3) [m] nodes in the root frame at rest.
    steering : Steering
    """

    target: NDArray
    steering: Steering

    def field(self, x: NDArray, parameters: NDArray | None) -> NDArray:
        """Shifts (V, 3) [m] of the nodes x (V, 3) [m] at weight 1.

        Raises
        ------
        BodyError
            A target of another shape, or not finite.
        """
        if np.shape(self.target) != x.shape or not np.isfinite(self.target).all():
            problem = f"a morph to {np.shape(self.target)} nodes of a surface that has {x.shape}, or not finite"
            raise BodyError(problem, remedy="Both surfaces must have one topology.")
        return np.asarray(self.target, float) - x

    def stretched(self, old: KinematicTree, new: KinematicTree, factors: NDArray) -> GlobalMorph:
        """The morph itself if all factors (S,) are 1; given nodes cannot be scaled.

        Raises
        ------
        BodyError
            A factor other than 1.
        """
        if np.allclose(factors, 1.0):
            return self
        problem = "a body with a morph to single nodes cannot be stretched"
        raise BodyError(problem, remedy="Fit without lengths, or declare `surface` of a segment as the target.")


@dataclass(frozen=True, eq=False)
class SegmentMorph:
    """A second shape of one segment's surfaces (P1 3.2), such as a contracting muscle.

    Parameters
    ----------
    segment : str
    surfaces : one for each surface of the segment, of the same kind.
    steering : Steering
    """

    segment: str
    surfaces: tuple[TaperedCylinder | MeshSurface, ...]
    steering: Steering

    def stretched(self, old: KinematicTree, new: KinematicTree, factors: NDArray) -> SegmentMorph:
        """The morph with its surfaces scaled with their segment, by factors (S,)."""
        factor = float(factors[old.segment(self.segment)])
        return replace(self, surfaces=tuple(s.scaled(factor) for s in self.surfaces))


@dataclass(frozen=True, eq=False)
class LocalMorph:
    """A bulge (P1 3.3): shifts by r d with r = Π exp(−(x − c)² / radius²), which decreases with distance from c.

    Parameters
    ----------
    centre, radii : (n,)
        In space (n = 3) [m], or in the n parameters of the surface's nodes. An infinite radius ignores a direction.
        P1's r_x is the square of a radius.
    shift : (3,) [m] d, shift of a node at the centre at weight 1; any direction.
    steering : Steering
    segment : str, in whose frame the centre is given; default: the root frame at rest.
    on : names of the segments whose nodes it moves; default: all.
    moves : bool, whether centre and shift move with the segment, like a shoulder blade under the skin. Else the nodes
        near the centre at rest are shifted.
    tilt : (3,) [rad] rotation vector from the segment's axes to those of the radii; in space.
    turn : (3,) [rad] rotation vector of the radii's axes about the centre at weight 1, in the segment's axes.
    stretch : (3,) factors of the radii at weight 1. At weight s: exp(s turn) exp(tilt), radii · stretchˢ.

    Raises
    ------
    BodyError
        A moving bulge without a segment; radii or stretch that are not positive; a tilt or turn that is not finite.
    """

    centre: NDArray
    radii: NDArray
    shift: NDArray
    steering: Steering
    segment: str | None = None
    on: tuple[str, ...] = ()
    moves: bool = False
    tilt: ArrayLike = (0.0, 0.0, 0.0)
    turn: ArrayLike = (0.0, 0.0, 0.0)
    stretch: ArrayLike = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if self.moves and self.segment is None:
            raise BodyError("a bulge that moves needs a segment", remedy="Name the segment that carries it.")
        if not np.all(np.asarray(self.radii) > 0.0):
            raise BodyError(f"radii {list(self.radii)} of a bulge", remedy="Give positive ones; inf is no limit.")
        deforming = np.asarray([self.tilt, self.turn, self.stretch], float)
        if not np.isfinite(deforming).all() or not np.all(deforming[2] > 0.0):
            problem = f"a bulge with tilt {self.tilt}, turn {self.turn} and stretch {self.stretch}"
            raise BodyError(problem, remedy="Give finite numbers, three each, `stretch` above 0.")

    @cached_property
    def deforms(self) -> bool:
        """Whether its shape changes with the angle."""
        return bool(np.any(self.turn) or np.any(np.asarray(self.stretch) != 1.0))

    def placed(self, tree: KinematicTree) -> LocalMorph:
        """The morph with its centre in the root frame at rest."""
        if self.segment is None:
            return self
        centre = np.asarray(self.centre, float) + tree.rest[tree.segment(self.segment)]
        return replace(self, centre=centre, segment=None, moves=False)

    def field(self, x: NDArray, parameters: NDArray | None) -> NDArray:
        """Shifts (V, 3) [m] of nodes x (V, 3) [m], or of nodes with `parameters` (V, n), at weight 1.

        Raises
        ------
        BodyError
            A shift that is not three finite numbers, or centre and radii of another length.
        """
        at = x if parameters is None else parameters
        shift = np.asarray(self.shift, float)
        if shift.shape != (3,) or not np.isfinite(shift).all():
            raise BodyError(f"a bulge by {self.shift}", remedy="Give three numbers in metres.")
        r = self.value(at, 0.0) if np.any(self.tilt) else radial_basis(at, self.centre, self.radii)
        return r[:, None] * shift

    def value(self, x: NDArray, weight: float) -> NDArray:
        """Deformed radial basis function r (N,) at points x (N, 3) [m] and a weight.

        r = exp(−Σ_i (u_i / ρ_i)²) with u = (exp(s turn) exp(tilt))ᵀ (x − c), ρ = radii · stretchˢ, s the weight.
        """
        axes, radii = self._deformed(weight)
        return np.asarray(np.exp(-np.square((x - self.centre) @ (axes / radii)).sum(axis=1)))

    def slopes(self, x: NDArray, weight: float) -> tuple[NDArray, NDArray]:
        """Derivatives of `value` by the point (N, 3) [1/m] and by the weight (N,)."""
        axes, radii = self._deformed(weight)
        away, r = x - np.asarray(self.centre), self.value(x, weight)
        u = away @ axes
        pull = 2.0 * r[:, None] * u / radii**2
        growing = u * np.log(self.stretch) + np.cross(np.asarray(self.turn), away) @ axes
        return -pull @ axes.T, np.sum(pull * growing, axis=1)

    def _deformed(self, weight: float) -> tuple[NDArray, NDArray]:
        """Axes of the radii (3, 3), one a column, and the radii (3,) [m]."""
        if not (self.deforms or np.any(self.tilt)):
            return np.eye(3), np.asarray(self.radii, float)
        axes = se3.exp_so3(weight * np.asarray(self.turn)) @ se3.exp_so3(np.asarray(self.tilt))
        return axes, np.asarray(self.radii) * np.asarray(self.stretch) ** weight

    def stretched(self, old: KinematicTree, new: KinematicTree, factors: NDArray) -> LocalMorph:
        """The bulge on a body whose segments were scaled by factors (S,): scaled with its segment, if it has one."""
        if self.segment is None:
            return self
        f = float(factors[old.segment(self.segment)])
        centre, radii, shift = (f * np.asarray(v, float) for v in (self.centre, self.radii, self.shift))
        return replace(self, centre=centre, radii=radii, shift=shift)


def radial_basis(x: ArrayLike, centre: ArrayLike, radii: ArrayLike) -> NDArray:
    """Radial basis function r(x) = Π_i exp(−(x_i − c_i)² / radius_i²) (P1 3.3).

    x (V, n) with any leading axes, centre c (n,) and radii (n,) in one unit; r (V,).

    Raises
    ------
    BodyError
        Centre and radii of another length, or radii that are not positive.
    """
    x, c, radius = np.asarray(x, float), np.asarray(centre, float), np.asarray(radii, float)
    if c.shape != radius.shape or c.shape != x.shape[-1:] or not np.all(radius > 0) or not np.isfinite(c).all():
        problem = f"a bulge with centre {c} and radii {radius} for nodes of {x.shape[-1]} coordinates"
        raise BodyError(problem, remedy="Give as many of each, the radii positive.")
    return np.exp(-np.sum(((x - c) / radius) ** 2, -1))


Operator = JointMotion | GlobalMorph | SegmentMorph | LocalMorph


_MIN_ROOT_T = 1e-3  # below, √t is replaced by a straight line: its slope at 0 is unbounded
_DIFFERENCE_STEP = 1e-5  # of t, for numerical slopes

Weight = Callable[[float], tuple[float, float]]


def _root(t: float) -> tuple[float, float]:
    if t < _MIN_ROOT_T:
        return 1.0 - t / math.sqrt(_MIN_ROOT_T), -1.0 / math.sqrt(_MIN_ROOT_T)
    return 1.0 - math.sqrt(t), -0.5 / math.sqrt(t)


# ω(t) and its slope: ω(0) = 1, ω(1) = 0 (P1 3.2, figure 6)
WEIGHTS: dict[str, Weight] = {
    "linear": lambda t: (1.0 - t, -1.0),
    "sqrt": _root,
    "square": lambda t: (1.0 - t * t, -2.0 * t),
    "smoothstep": lambda t: (1.0 - t * t * (3.0 - 2.0 * t), -6.0 * t * (1.0 - t)),
}


def weight_function(weight: str | ArrayLike | Callable[[float], float]) -> Weight:
    """Function t -> (ω, dω/dt), from a name in `WEIGHTS`, a table (K, 2) of t and ω, or any function ω(t).

    Raises
    ------
    BodyError
        An unknown name; a table or function that does not go from ω(0) = 1 to ω(1) = 0.
    """
    if isinstance(weight, str):
        check_choice("weighting", weight, WEIGHTS, BodyError, remedy="Or give a table of t and ω.")
        return WEIGHTS[weight]
    if callable(weight):
        value = weight
    else:
        table = np.asarray(weight, float)
        if table.ndim != 2 or table.shape[1] != 2 or len(table) < 2 or not np.all(np.diff(table[:, 0]) > 0):
            raise BodyError(f"a table of weights of shape {table.shape}", remedy="Give rows (t, ω) with t rising.")
        value = lambda t: float(np.interp(t, table[:, 0], table[:, 1]))
    ends = float(value(0.0)), float(value(1.0))
    if not (abs(ends[0] - 1.0) < 1e-9 and abs(ends[1]) < 1e-9):
        raise BodyError(f"a weighting with ω(0) = {ends[0]} and ω(1) = {ends[1]}", remedy="It must go from 1 to 0.")

    def with_slope(t: float) -> tuple[float, float]:
        low, high = max(t - _DIFFERENCE_STEP, 0.0), min(t + _DIFFERENCE_STEP, 1.0)
        return float(value(t)), (float(value(high)) - float(value(low))) / (high - low)

    return with_slope


@dataclass(frozen=True, eq=False)
class Steering:
    """Weight of an operator as a function of a joint angle.

    Parameters
    ----------
    coordinate : str, name of the angle.
    start, end : [rad] or [m], angles of weight 0 and 1: t goes from 0 to 1 between them.
    weight : name in `WEIGHTS`, table (K, 2) of t and ω, or function ω(t).
    beyond : bool
        Whether the weight is proportional to the angle without limits, like λ θ of P1's local morphs; needs the weight
        "linear".
    """

    coordinate: str
    start: float = 0.0
    end: float = 1.0
    weight: str | ArrayLike | Callable[[float], float] = "linear"
    beyond: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.start) and math.isfinite(self.end)) or self.start == self.end:
            problem = f"a morph steered by {self.coordinate} from {self.start} to {self.end}"
            raise BodyError(problem, remedy="Give two different angles.")
        if self.beyond and not (isinstance(self.weight, str) and self.weight == "linear"):
            raise BodyError("a weighting that continues beyond its ends must be linear", remedy="Remove `beyond`.")
        self._function  # noqa: B018  raises its errors at construction

    @cached_property
    def _function(self) -> Weight:
        return weight_function(self.weight)

    def at(self, angle: float) -> tuple[float, float]:
        """Weight s = 1 − ω (a number) at an angle [rad, m], and its derivative ∂s/∂angle."""
        span = self.end - self.start
        t = (angle - self.start) / span
        if not self.beyond and not 0.0 <= t <= 1.0:
            return (0.0 if t < 0.0 else 1.0), 0.0
        omega, slope = self._function(t)
        return 1.0 - omega, -slope / span
