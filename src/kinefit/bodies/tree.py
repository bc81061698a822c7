"""KinematicTree: joints as screws in the rest pose, forward kinematics, Jacobians.

At rest all segment frames are aligned with the root frame and lie at their joints. A segment's motion is the product of
the exponentials of all screws between it and the root (P3 eq. 6), so a point is given once, in the root frame at rest.
The degrees of freedom of a body are the root's twist (v, ω) in the world about the root's origin, then the angles.

Closed chains: landmarks constrained to points, lines or planes, segments constrained to each other (P3 3.2).

A body is an open tree. Closures between its landmarks, or between a landmark and the world, close its chains: a boot in
its binding, a hand on a bar, a pedal's axle on the bike. An unknown length of the gear, such as the distance between
the bindings, is a dimension that a subject fit estimates (P3 5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import _kernels
from kinefit.errors import BodyError, check_choice
from kinefit.geometry.lines import perpendiculars

COLUMNS = ("axes", "prismatic", "lower", "upper", "usual", "spread")
"""Arrays of a tree with an entry for each coordinate, but for the owners."""

ROOT_DOFS = ("root_tx", "root_ty", "root_tz", "root_rx", "root_ry", "root_rz")


def _frozen(array: object, dtype: type = float) -> NDArray:
    out: NDArray = np.array(array, dtype=dtype)
    out.flags.writeable = False
    return out


def _paths(parent: NDArray) -> tuple[NDArray, NDArray]:
    """Paths (n, m) from the first node to each one, padded with -1, and their depths (n,), from each parent (n,)."""
    depth = np.zeros(len(parent), np.int64)
    for k in range(1, len(parent)):
        depth[k] = depth[parent[k]] + 1
    out = np.full((len(parent), int(depth.max()) + 1), -1)
    for k in range(len(parent)):
        if k:
            out[k] = out[parent[k]]
        out[k, depth[k]] = k
    return out, depth


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """A tree of segments; parents come before children, coordinates in the order of their segments.

    Parameters
    ----------
    segments : (S,) names; the first is the root.
    parents : (S,) index of each segment's parent, -1 for the root.
    offsets : (S, 3) [m] joint centre in the parent's frame at rest (zero for the root).
    coordinates : (D,) names of the joint angles (and prismatic lengths).
    owners : (D,) index of the segment that each coordinate moves.
    axes : (D, 3) unit axes in the root-aligned rest frame; a positive angle is a right-handed rotation.
    prismatic : (D,) bool, whether a coordinate slides along its axis instead of rotating about it.
    lower, upper : (D,) [rad] or [m], limits; ±inf for none.
    usual, spread : (D,) [rad] or [m]
        Mean and standard deviation of the posture prior: the start of fits, and the estimate of what measurements do
        not observe; spread inf for no prior.
    couplings : (C, D) [1/rad] or [1/m]
        Correlated deviations from the mean posture: each row's sum c · (angles − usual) has a standard deviation of
        one. Not of the middle axis of a ball joint, whose sign changes in the joint's other chart.
    root_free : bool, False for a body with a fixed root.
    """

    segments: tuple[str, ...]
    parents: NDArray
    offsets: NDArray
    coordinates: tuple[str, ...]
    owners: NDArray
    axes: NDArray
    prismatic: NDArray
    lower: NDArray
    upper: NDArray
    usual: NDArray
    spread: NDArray
    root_free: bool = True
    couplings: NDArray = field(default_factory=lambda: np.empty((0, 0)))

    def __post_init__(self) -> None:
        for name, dtype in (("parents", np.int64), ("owners", np.int64), ("prismatic", bool)):
            object.__setattr__(self, name, _frozen(getattr(self, name), dtype))
        for name in ("offsets", "axes", "lower", "upper", "usual", "spread"):
            object.__setattr__(self, name, _frozen(getattr(self, name)))
        object.__setattr__(self, "axes", _frozen(self.axes.reshape(-1, 3)))
        lines = (len(self.couplings), len(self.coordinates))
        object.__setattr__(self, "couplings", _frozen(np.reshape(self.couplings, lines)))
        self._check_numbers()
        if np.any(np.diff(self.owners) < 0) or np.any(self.parents[1:] >= np.arange(1, len(self.parents))):
            raise BodyError("segments of a tree are not in order", remedy="Put parents before their children.")
        middle = [d.start + 1 for d in self.ball_joints]
        for d in np.flatnonzero((self.couplings != 0.0).any(axis=0)):
            if d in middle or not np.isfinite(self.spread[d]):
                why = "the middle axis of a ball joint" if d in middle else "without its own spread"
                problem = f"a coupling of {self.coordinates[d]}, {why}"
                raise BodyError(problem, remedy="Couple other coordinates, with a finite spread.")

    def _check_numbers(self) -> None:
        """Raise BodyError for a number that is not finite or out of range."""
        finite = {name: np.isfinite(getattr(self, name)) for name in ("offsets", "axes", "usual", "couplings")}
        wrong = {
            "offset": (~finite["offsets"].all(axis=-1), self.segments, "Give three numbers in metres."),
            "axis": (~finite["axes"].all(axis=1), self.coordinates, "Give a unit vector."),
            "usual": (~finite["usual"], self.coordinates, "Give an angle or a length within the limits."),
            "couplings": (~finite["couplings"].all(axis=0), self.coordinates, "Give numbers, 0 for none."),
            "limits": (~((self.lower <= self.upper) & (self.lower < np.inf) & (self.upper > -np.inf)), self.coordinates,
                       "Give the lower one first, -inf and inf for none."),
            "spread": (~(self.spread > 0.0), self.coordinates, "Give a positive number, inf for no prior."),
        }  # fmt: skip
        for what, (bad, names, remedy) in wrong.items():
            if bad.any():
                place = f"{what} of {names[np.argmax(bad)]}"
                raise BodyError("a number is not finite or out of range", place=place, remedy=remedy)

    @property
    def n_dofs(self) -> int:
        """Number of degrees of freedom: six of the root and one for each coordinate."""
        return 6 + len(self.coordinates)

    @property
    def coupled(self) -> bool:
        """Whether the posture prior couples coordinates."""
        return len(self.couplings) > 0

    @cached_property
    def posture_precision(self) -> NDArray:
        """Inverse covariance (D, D) of the posture prior, a Gaussian about `usual`; zero without a prior."""
        return _frozen(np.diag(np.square(1.0 / self.spread)) + self.couplings.T @ self.couplings)

    @cached_property
    def held_by_posture(self) -> tuple[NDArray, NDArray]:
        """Coordinates (H,) with a posture prior, and their precision matrix (H, H); its diagonal if uncoupled."""
        constrained = np.flatnonzero(np.isfinite(self.spread))
        precision = self.posture_precision[np.ix_(constrained, constrained)]
        return _frozen(constrained, np.int64), _frozen(precision if self.coupled else np.diag(precision))

    def posture_cost(self, angles: NDArray, share: float = 1.0) -> float:
        """Cost of the posture prior at angles (D,) [rad, m], times a share."""
        deviation = angles - self.usual
        return share * float(deviation @ self.posture_precision @ deviation)

    @cached_property
    def posture_std(self) -> NDArray:
        """Standard deviation (D,) [rad] or [m] of each coordinate in the posture prior; inf without a prior."""
        out, constrained = np.array(self.spread), np.flatnonzero((self.couplings != 0.0).any(axis=0))
        out[constrained] = np.sqrt(np.diag(np.linalg.inv(self.posture_precision[np.ix_(constrained, constrained)])))
        return _frozen(out)

    @cached_property
    def dof_start(self) -> NDArray:
        """Index (S+1,) of the first coordinate of each segment."""
        return _frozen(np.searchsorted(self.owners, np.arange(len(self.segments) + 1)), np.int64)

    @cached_property
    def rest(self) -> NDArray:
        """Joint centres (S, 3) [m] in the root frame at rest."""
        out = np.array(self.offsets)
        for s in range(1, len(out)):
            out[s] += out[self.parents[s]]
        return _frozen(out)

    @cached_property
    def dof_parent(self) -> NDArray:
        """Next degree of freedom towards the root (6 + D,), -1 for the first."""
        last = np.full(len(self.segments), 5)
        out = list(range(-1, 5))
        for s, parent in enumerate(self.parents):
            last[s] = last[parent] if parent >= 0 else 5
            for d in range(self.dof_start[s], self.dof_start[s + 1]):
                out.append(int(last[s]))
                last[s] = 6 + d
        return _frozen(out, np.int64)

    @cached_property
    def last_dof(self) -> NDArray:
        """Nearest degree of freedom (S,) that moves each segment."""
        last = np.full(len(self.segments), 5)
        for s, parent in enumerate(self.parents):
            last[s] = last[parent] if parent >= 0 else 5
            if self.dof_start[s + 1] > self.dof_start[s]:
                last[s] = 5 + self.dof_start[s + 1]
        return _frozen(last, np.int64)

    @cached_property
    def depth(self) -> NDArray:
        """Number (n,) of degrees of freedom above each one."""
        return _frozen(_paths(self.dof_parent)[1], np.int64)

    @cached_property
    def chain(self) -> NDArray:
        """Degrees of freedom (6 + D, m) from the root to each one, padded with -1: the pattern of the normal matrix."""
        return _frozen(_paths(self.dof_parent)[0], np.int64)

    @cached_property
    def coupled_pattern(self) -> tuple[NDArray, NDArray, NDArray]:
        """Chain (n, m) and depth (n,) of the normal matrix with the posture prior; index (n, m) of `chain` in it.

        They are the paths of its elimination tree. Without couplings they equal `chain` and `depth`; couplings, and the
        fill-in of the elimination, add entries.
        """
        meets = np.zeros((self.n_dofs, self.n_dofs), bool)
        np.put_along_axis(meets, np.maximum(self.chain, 0), True, axis=1)
        meets[6:, 6:] |= self.posture_precision != 0.0
        parent = np.full(self.n_dofs, -1, np.int64)
        for k in range(self.n_dofs - 1, 0, -1):
            above = np.flatnonzero(meets[k, :k])
            parent[k] = above[-1]
            meets[parent[k], above] = True
        chain, depth = _paths(parent)
        place = [np.searchsorted(row[: d + 1], own) for row, d, own in zip(chain, depth, self.chain)]
        return _frozen(chain, np.int64), _frozen(depth, np.int64), _frozen(place, np.int64)

    @cached_property
    def posture_entries(self) -> tuple[NDArray, NDArray]:
        """Lower triangle of `posture_precision`: (E, 3) row, column, index in `coupled_pattern`; (E,) values."""
        chain, depth, _ = self.coupled_pattern
        row, column = np.nonzero(np.tril(self.posture_precision))
        place = [np.searchsorted(chain[6 + i, : depth[6 + i] + 1], 6 + j) for i, j in zip(row, column)]
        entries = np.column_stack([row, column, np.array(place, np.int64)])
        return _frozen(entries, np.int64), _frozen(self.posture_precision[row, column])

    @cached_property
    def ball_joints(self) -> tuple[slice, ...]:
        """Coordinates of every joint with three orthogonal rotation axes; see `charts`."""
        out = []
        for s in range(len(self.segments)):
            d = slice(int(self.dof_start[s]), int(self.dof_start[s + 1]))
            axes = self.axes[d]
            turns = len(axes) == 3 and not self.prismatic[d].any()
            if turns and np.allclose(axes @ axes.T, np.eye(3), atol=1e-6):
                out.append(d)
        return tuple(out)

    def segment(self, name: str) -> int:
        """Index of a segment by name.

        Raises
        ------
        BodyError
            No such segment.
        """
        check_choice("segment", name, self.segments, BodyError)
        return self.segments.index(name)

    def coordinate(self, name: str) -> int:
        """Index of a coordinate by name.

        Raises
        ------
        BodyError
            No such coordinate.
        """
        check_choice("coordinate", name, self.coordinates, BodyError)
        return self.coordinates.index(name)

    def with_offsets(self, offsets: NDArray) -> KinematicTree:
        """The tree with other joint centres (S, 3) [m] in the parents' frames."""
        out = object.__new__(KinematicTree)  # keeps cached properties that do not depend on the offsets
        out.__dict__.update(self.__dict__, offsets=_frozen(offsets))
        out.__dict__.pop("rest", None)
        return out

    def forward(self, T_world_root: NDArray, angles: NDArray) -> tuple[NDArray, NDArray]:
        """Frames (S, 12) and screws (D, 6) of one pose, root (4, 4) and angles (D,); see `_kernels.forward`."""
        self._check_angles(angles.shape[-1])
        frames, screws = np.empty((len(self.segments), 12)), np.empty((len(self.coordinates), 6))
        _kernels.forward(
            self.parents, self.dof_start, self.prismatic, self.axes, self.rest, T_world_root, angles, frames, screws
        )
        return frames, screws

    def segment_poses(self, Ts_world_root: NDArray, angles: NDArray) -> NDArray:
        """T_world_segment (F, S, 4, 4) [m] of many poses: roots (F, 4, 4) [m], angles (F, D) [rad, m]."""
        roots = np.ascontiguousarray(Ts_world_root, dtype=float)
        frames = np.empty((len(roots), len(self.segments), 12))
        angles = np.ascontiguousarray(angles, dtype=float)
        self._check_angles(angles.shape[-1])
        _kernels.forward_many(self.parents, self.dof_start, self.prismatic, self.axes, self.rest, roots, angles, frames)
        Ts = np.zeros((*frames.shape[:2], 4, 4))
        Ts[..., :3, :3] = frames[..., :9].reshape(*frames.shape[:2], 3, 3)
        Ts[..., :3, 3] = frames[..., 9:] + (Ts[..., :3, :3] @ self.rest[:, :, None])[..., 0]
        Ts[..., 3, 3] = 1.0
        return Ts

    def _check_angles(self, count: int) -> None:
        if count != len(self.coordinates):  # a kernel would read beyond the end
            problem = f"a state with {count} angles for a body with {len(self.coordinates)}"
            raise BodyError(problem, remedy="Give a state of this body.")

    def segment_jacobian(self, screws: NDArray, segment: int) -> NDArray:
        """Jacobian J_s (6, 6 + D): twist (v, ω) of a segment about the root's origin, from screws (D, 6)."""
        out = np.zeros((6, self.n_dofs))
        out[:, :6] = np.eye(6)
        d = self.last_dof[segment]
        while d >= 6:
            out[:, d] = screws[d - 6]
            d = self.dof_parent[d]
        return out


SIGNS = np.array([1.0, -1.0, 1.0])  # derivative of the twin's angles by the angles


def twin(angles: NDArray) -> NDArray:
    """The other angles (N, 3) [rad] of the same rotation: (a + π, π − b, c + π), each in −π..π. Any leading axes."""
    return np.angle(np.exp(1j * (np.pi + SIGNS * np.asarray(angles, float))))


def off_the_limits(tree: KinematicTree, angles: NDArray) -> tuple[NDArray, NDArray] | None:
    """Switch the chart of every ball joint that is at a limit if its twin is not: angles (D,) [rad] and signs (D,).

    A limit bounds a chart, not a rotation: an arm that swings overhead reaches the end of one chart well inside the
    other. None if no joint changes.
    """
    out, signs = np.array(angles), np.ones(len(angles))
    for d in tree.ball_joints:
        low, high = tree.lower[d], tree.upper[d]
        at_limit = (angles[d] <= low) | (angles[d] >= high)
        if not at_limit.any():
            continue
        other = twin(angles[d])
        other += 2.0 * np.pi * ((other < low).astype(float) - (other > high))
        if np.all((other > low) & (other < high)):
            out[d], signs[d] = other, SIGNS
    return None if np.array_equal(signs, np.ones(len(signs))) else (out, signs)


@dataclass(frozen=True, eq=False)
class BodyState:
    """Pose of the root and all joint coordinates.

    Parameters
    ----------
    T_world_root : (4, 4) [m]
    angles : (D,) [rad], or [m] for prismatic joints.
    """

    T_world_root: NDArray
    angles: NDArray

    def __post_init__(self) -> None:
        for name in ("T_world_root", "angles"):
            try:
                array = np.array(getattr(self, name), dtype=float, order="C")
            except (TypeError, ValueError) as error:
                problem = f"a state whose {name} is a {type(getattr(self, name)).__name__}, not an array of numbers"
                raise BodyError(problem, remedy="Give a (4, 4) pose and a number for each coordinate.") from error
            if not math.isfinite(array.sum()):
                raise BodyError(f"{name} of a state are not finite", remedy="Remove unknown values.")
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def retract(self, delta: NDArray, bounds: tuple[NDArray, NDArray] | None = None) -> BodyState:
        """Move the state by δ (6 + D,): the root's twist (v, ω) [m, rad] in the world about its origin, then angles.

        bounds: lower and upper limits (D,) to which the angles are clipped; default none.

        Raises
        ------
        BodyError
            A δ of another length.
        """
        root, angles = np.empty((4, 4)), np.empty(len(self.angles))
        if bounds is None:
            free = np.full(len(self.angles), np.inf)
            bounds = -free, free
        delta = np.ascontiguousarray(delta, dtype=float)
        if delta.shape != (6 + len(angles),):
            problem = f"a step of shape {delta.shape} for a state with {len(angles)} angles"
            raise BodyError(problem, remedy=f"Give {6 + len(angles)} numbers.")
        _kernels.retract(self.T_world_root, self.angles, delta, bounds[0], bounds[1], root, angles)
        return BodyState(root, angles)

    def difference(self, other: BodyState) -> NDArray:
        """δ (6 + D,) such that `self.retract(δ)` is `other`."""
        out = np.empty(6 + len(self.angles))
        _kernels.difference(self.T_world_root, other.T_world_root, self.angles, other.angles, out)
        return out


KINDS = {"point": 3, "line": 2, "plane": 1, "rigid": 6}
"""Kinds of closures, and the number of degrees of freedom that each removes."""

FIXED = "fixed"
"""The scale group of gear, which is not scaled with the person."""

AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Closure:
    """A constraint of a landmark to another landmark, or to a position in the world.

    The other frame is that of the other landmark's segment, or the world.

    Parameters
    ----------
    name : str
    kind : "point": the landmark stays on the other point; "line", "plane": on a line or plane through it, of direction
        or normal `axis`; "rigid": its segment also keeps its orientation in the other frame.
    point : name of the landmark.
    to : name of the other landmark; "" for a position in the world.
    place : (3,) [m] position in the world, if `to` is "".
    axis : (3,) unit vector in the other frame.
    turn : (3,) [rad] rotation vector of the landmark's segment in the other frame, of a rigid closure.
    sigma, turn_sigma : [m], [rad] standard deviation of a soft closure. With the default sigma, 99.8 % of poses are
        within 5 mm of a hard closure if measured points have a sigma of 5 mm (P3 3.2).
    hard : bool, whether it holds exactly.
    place_std, turn_std : [m], [rad] prior standard deviations of an estimated position and rotation in the world; 0 if
        known.
    """

    name: str
    kind: str
    point: str
    to: str = ""
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sigma: float = 0.0005
    turn_sigma: float = math.radians(2.0)
    hard: bool = False
    place_std: float = 0.0
    turn_std: float = 0.0

    @property
    def rows(self) -> int:
        """Number of degrees of freedom that it removes."""
        return KINDS[self.kind]

    @property
    def directions(self) -> NDArray:
        """Constrained directions of the point: (3, 3), (2, 3) or (1, 3) unit vectors in the other frame."""
        axis = np.array(self.axis)
        if self.kind == "plane":
            return axis[None]
        if self.kind == "line":
            return np.stack(perpendiculars(axis))
        return np.eye(3)

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of its rows, for messages."""
        if self.kind == "line":
            return ("across the line", "across the line, the other way")
        shifts = ("off the plane",) if self.kind == "plane" else tuple(f"along {a}" for a in AXES)
        return shifts + (tuple(f"about {a}" for a in AXES) if self.kind == "rigid" else ())


@dataclass(frozen=True)
class Dimension:
    """A length or an angle of gear on which landmarks, joints and closures depend.

    Parameters
    ----------
    name : str
    value : float [m] or [rad], current value.
    along : (3,) shift per metre of everything it moves, in the frame of that.
    about : (3,) unit axis about which the `turn` of rigid closures rotates; zeros for a length.
    moves : names of landmarks, of segments (their joints move in the parent's frame), of closures.
    std : [m] or [rad] prior standard deviation of an estimated value; 0 if known.
    """

    name: str
    value: float
    along: tuple[float, float, float] = (0.0, 0.0, 0.0)
    about: tuple[float, float, float] = (0.0, 0.0, 0.0)
    moves: tuple[str, ...] = ()
    std: float = 0.0

    @property
    def turns(self) -> bool:
        """Whether it is an angle."""
        return any(self.about)


def without_landmarks(closures: tuple[Closure, ...], there: tuple[str, ...]) -> tuple[Closure, ...]:
    """The closures whose landmarks all exist."""
    return tuple(c for c in closures if c.point in there and (not c.to or c.to in there))
