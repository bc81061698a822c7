"""Closures of a body as rows (P3 3.2, eq. 15, linearised in both points).

A point x_a of one segment stays at x_b of another (or of the world) along the directions n of b's frame:

    r = n·(x_b − x_a),    δr = −(n, x_a × n)·(δξ_a − δξ_b)

Both twists act at x_a, because n rotates with b. A rigid closure also has e = log((R_b R_turn)ᵀ R_a), with
δe = J_l⁻¹(e) (R_b R_turn)ᵀ (δω_a − δω_b). Soft closures are rows with their standard deviation, as in the paper. Hard
ones are equations for `solvers.closed`, or rows with `HARD_SIGMA` in a quadratic cost.

The paper linearises (15) as (18) and (19) instead: each point is pulled to the position of the other one, which is kept
constant. That is `point_rows` of `closure_targets`. Both have the same gradient −Jᵀ W c, and so the same solution.
Their matrices differ: Jₐᵀ W Jₐ + J_bᵀ W J_b also constrains the position of the pair, (Jₐ − J_b)ᵀ W (Jₐ − J_b) does
not.

Elastic bands that connect the parts of a body at its joints (P2 3.4, fig. 2).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.bodies import Body, BodyState, KinematicTree, PointSet, TaperedCylinder
from kinefit.bodies.parts import has_unknown_gear, with_dimensions
from kinefit.bodies.tree import Closure
from kinefit.errors import BodyError, ObservationError, check_choice
from kinefit.geometry import se3
from kinefit.solving.correspondences import _kernels, targets
from kinefit.solving.rows import DofRows, PairRows

HARD_SIGMA = 1e-4
"""[m, rad] standard deviation of a hard closure in a quadratic cost; the solution is made exact afterwards."""

_RIGID_PAIRS = 0.1 * np.concatenate([np.zeros((1, 3)), np.eye(3)])
"""(4, 3) [m] from a rigid closure's landmark to the points of its segment that represent it: about a boot's width."""


@dataclass(frozen=True, eq=False)
class Closed:
    """Closures of a body at a state: m equations c = 0.

    Parameters
    ----------
    value : (m,) [m, rad] c, error of each equation.
    jacobian : (m, n) of c by the degrees of freedom.
    sigma : (m,) [m, rad] standard deviation, including that of unknown gear; 0 if it holds exactly.
    """

    value: NDArray
    jacobian: NDArray
    sigma: NDArray

    @property
    def hard(self) -> NDArray:
        """Whether each equation (m,) holds exactly; bool."""
        return self.sigma == 0.0

    def chosen(self, some: NDArray) -> Closed:
        """The equations selected by a mask or indices (k,)."""
        return Closed(self.value[some], self.jacobian[some], self.sigma[some])

    def rows(self, stiff: float = HARD_SIGMA) -> DofRows:
        """All equations as rows; hard ones with the standard deviation `stiff` [m, rad]."""
        weight = 1.0 / np.square(np.where(self.hard, stiff, self.sigma))
        return DofRows(self.jacobian, -self.value, weight, np.full(len(weight), -1))


@dataclass(frozen=True, eq=False)
class _Table:
    """Closures of a body as arrays for `_kernels.close`: K closures, m equations."""

    segments: NDArray
    rest: NDArray
    directions: NDArray
    first: NDArray
    rigid: NDArray
    turns: NDArray
    owner: NDArray  # (m,) int
    sigma: NDArray  # (m,)


@lru_cache(maxsize=256)
def _table(body: Body) -> _Table:
    marks = body.landmarks
    names, rest = {name: k for k, name in enumerate(marks.names)}, body.points_rest(marks)
    segments, points, directions, sigma, turns = [], [], [np.zeros((0, 3))], list[float](), []
    for c in body.closures:
        a, b = names[c.point], names[c.to] if c.to else -1
        segments.append((marks.segments[a], marks.segments[b] if c.to else -1))
        points.append((rest[a], rest[b] if c.to else np.array(c.place)))
        directions.append(c.directions)
        sigma += [float(np.hypot(0.0 if c.hard else c.sigma, c.place_std))] * len(c.directions)
        turns.append(se3.exp_so3(np.array(c.turn)))
        if c.kind == "rigid":
            directions.append(np.zeros((3, 3)))
            sigma += [float(np.hypot(0.0 if c.hard else c.turn_sigma, c.turn_std))] * 3
    counts = [c.rows for c in body.closures]
    return _Table(
        np.array(segments, np.int64).reshape(-1, 2), np.array(points, float).reshape(-1, 2, 3),
        np.concatenate(directions), np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.array([c.kind == "rigid" for c in body.closures], bool), np.array(turns, float).reshape(-1, 3, 3),
        np.repeat(np.arange(len(counts)), counts), np.array(sigma, float),
    )  # fmt: skip


def owners(body: Body) -> NDArray:
    """Index (m,) of the closure of each equation."""
    return _table(body).owner


@lru_cache(maxsize=64)
def _gear_sigma(body: Body) -> NDArray:
    """Standard deviation (m,) of each equation by the unknown dimensions of gear, in the default posture."""
    variance = np.zeros(len(_table(body).owner))
    for d in body.dimensions:
        if d.std > 0.0:
            step = 0.1 * d.std
            changed = [with_dimensions(body, {d.name: d.value + s * step}) for s in (1.0, -1.0)]
            ends = [closure_values(b, body.default_state()) for b in changed]
            variance += np.square((ends[0] - ends[1]) / (2.0 * step) * d.std)
    out = np.sqrt(variance)
    out[out < 1e-9] = 0.0
    return out


def closure_values(body: Body, state: BodyState) -> NDArray:
    """Errors (m,) [m, rad] of all equations of a body's closures."""
    return _closed(body, state, 0)[0]


def _closed(body: Body, state: BodyState, lines: int) -> tuple[NDArray, NDArray]:
    """Values (m,), and their Jacobian with `lines` rows: m or 0."""
    t, tree = _table(body), body.tree
    frames, screws = tree.forward(state.T_world_root, state.angles)
    value, J = np.empty(len(t.owner)), np.zeros((lines, tree.n_dofs))
    _kernels.close(
        frames, screws, np.ascontiguousarray(state.T_world_root[:3, 3]), t.segments, t.rest, t.directions, t.first,
        t.rigid, t.turns, tree.dof_parent, tree.last_dof, value, J,
    )  # fmt: skip
    return value, J


def closed_at(body: Body, state: BodyState) -> Closed:
    """The closures of a body at a state."""
    t = _table(body)
    return Closed(*_closed(body, state, len(t.owner)), np.hypot(t.sigma, _gear_sigma(body)))


def closure_rows(body: Body, state: BodyState) -> DofRows:
    """Rows of all closures of a body, r = −c: soft ones with their standard deviation, hard ones with `HARD_SIGMA`."""
    return closed_at(body, state).rows()


def closure_targets(body: Body, state: BodyState) -> tuple[PointSet, NDArray]:
    """Points of a body's closures and their targets, in the linearisation of the paper (P3 3.2, eqs. 18, 19).

    A pair of points gives two: the target of each is the position of the other. A position in the world gives one, (18)
    alone. A rigid closure gives four pairs, as for the paper's boot and binding.

    Returns
    -------
    points : PointSet of K points.
    x_world : (K, 3) [m], constant in a step.

    Raises
    ------
    BodyError
        A closure to a line or a plane, which the paper does not have; gear that is to be estimated.
    """
    if has_unknown_gear(body):
        problem = f"body '{body.name}' has gear to estimate, which equations (18) and (19) cannot do"
        raise BodyError(problem, remedy="Give `known_gear(body)`, with fixed dimensions and positions.")
    points, x_world = [body.landmarks.select(())], [np.zeros((0, 3))]
    for c in body.closures:
        if c.kind not in ("point", "rigid"):
            problem = f"closure '{c.name}' is a {c.kind}, not a pair of points as in equations (18) and (19)"
            raise BodyError(problem, remedy='Write kind = "point" or "rigid", or take `closure_rows`.')
        shifts = _RIGID_PAIRS if c.kind == "rigid" else _RIGID_PAIRS[:1]
        turned = shifts @ se3.exp_so3(np.array(c.turn)).T
        own = _shifted(body.landmarks, c.point, shifts)
        if c.to:
            other = _shifted(body.landmarks, c.to, turned)
            points += [own, other]
            x_world += [body.positions(state, other), body.positions(state, own)]
        else:
            points.append(own)
            x_world.append(np.array(c.place) + turned)
    joined = PointSet(
        tuple(name for p in points for name in p.names), np.concatenate([p.segments for p in points]),
        np.concatenate([p.points for p in points]),
    )  # fmt: skip
    return joined, np.concatenate(x_world)


def _shifted(landmarks: PointSet, name: str, shifts: NDArray) -> PointSet:
    """Points of a landmark's segment at offsets (k, 3) [m] from it."""
    same = landmarks.select((name,) * len(shifts))
    return PointSet(same.names, same.segments, same.points + shifts)


def soft_closures(body: Body, state: BodyState) -> list[DofRows]:
    """Rows of the soft closures, if there are any."""
    if not body.closures:
        return []
    closed = closed_at(body, state)
    soft = ~closed.hard
    return [closed.chosen(soft).rows()] if soft.any() else []


def every_closure(body: Body, state: BodyState) -> list[DofRows]:
    """Rows of all closures, if there are any, for quadratic costs."""
    return [closure_rows(body, state)] if body.closures else []


@dataclass(frozen=True, eq=False)
class ClosureEquations:
    """Some of the closure equations of a body, as a function of its state.

    Parameters
    ----------
    body : Body
    chosen : (m,) bool, which of the body's equations
    """

    body: Body
    chosen: NDArray

    def __call__(self, state: BodyState) -> tuple[NDArray, NDArray]:
        """Values (h,) [m, rad] and Jacobian (h, n) at a state."""
        closed = closed_at(self.body, state)
        return closed.value[self.chosen], closed.jacobian[self.chosen]


def every_equation(body: Body) -> ClosureEquations:
    """All equations of the closures, soft ones too."""
    return ClosureEquations(body, np.ones(len(owners(body)), bool))


def hard_equations(body: Body) -> ClosureEquations | None:
    """The equations of the hard closures, which hold exactly; None without hard closures."""
    hard = np.hypot(_table(body).sigma, _gear_sigma(body)) == 0.0 if body.closures else np.zeros(0, bool)
    return ClosureEquations(body, hard) if hard.any() else None


@lru_cache(maxsize=64)
def looped(body: Body) -> NDArray:
    """Whether each coordinate (D,) is inside a closed chain, so that the others in it determine it; bool."""
    out = np.zeros(body.tree.n_dofs, bool)
    for a, b in _table(body).segments:
        paths = []
        for s in (a, b):
            path = np.zeros(len(out), bool)
            if s >= 0:
                last = int(body.tree.last_dof[s])
                path[body.tree.chain[last, : body.tree.depth[last] + 1]] = True
            paths.append(path)
        out |= paths[0] ^ paths[1]
    return out[6:]


_DEFAULT_HALF_WIDTH = 0.05  # [m] of a joint between parts without cylinders: that of an elbow

BAND = "band "
"""How names of the closures and landmarks of `with_bands` begin."""


@dataclass(frozen=True, eq=False)
class Bands:
    """Pairs of points that K elastic bands pull together.

    Parameters
    ----------
    parent, child : PointSet of K points each, on both parts of a joint; they coincide at rest.
    joint : (K,) int, segment whose joint each band belongs to.
    """

    parent: PointSet
    child: PointSet
    joint: NDArray

    def __len__(self) -> int:
        return len(self.joint)


def universal_band(centre: ArrayLike) -> NDArray:
    """One band (1, 3) [m] at a joint's centre (3,): three rotations are free, such as a shoulder's (P2 fig. 2a)."""
    return np.asarray(centre, float).reshape(1, 3)


def hinge_bands(centre: ArrayLike, axis: ArrayLike, half_width: float, count: int = 2) -> NDArray:
    """Bands (K, 3) [m], K = count, evenly along a line: the rotation about it is free, as of an elbow (P2 fig. 2b)."""
    direction = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.asarray(centre, float) + half_width * np.linspace(-1.0, 1.0, count)[:, None] * direction


def elliptic_bands(centre: ArrayLike, half_axes: ArrayLike, count: int = 4) -> NDArray:
    """Bands (K, 3) [m], K = count, on an ellipse with half axes (2, 3) [m]: no free rotation, as of a neck (2c)."""
    a, b = np.asarray(half_axes, float)
    turn = 2 * np.pi * np.arange(count)[:, None] / count
    return np.asarray(centre, float) + np.cos(turn) * a + np.sin(turn) * b


def joint_bands(
    body: Body, *, elliptic: Collection[str] = ("neck",), along_line: int = 2, along_ellipse: int = 4,
    joints: Collection[str] | None = None,
) -> Bands:
    """Bands of joints of a body: a fixed joint becomes elliptic, a revolute one a hinge, all others universal.

    Parameters
    ----------
    body : Body
        With its joints; `free_parts(body)` has the same bands, because segments keep their indices.
    elliptic : names of joints with three axes but a small range, which become elliptic too; unknown names are ignored.
    along_line, along_ellipse : int
        Number of bands of a hinge and of an elliptic joint.
    joints : names of the joints that get bands; default: all.

    Raises
    ------
    BodyError
        A sliding joint, fewer than two bands of a hinge, or than three of an ellipse.
    """
    if along_line < 2 or along_ellipse < 3:
        problem = f"{along_line} bands of a hinge and {along_ellipse} of an elliptic joint"
        raise BodyError(problem, remedy="Give two or more, and three or more.")
    tree = body.tree
    points, owners = [], []
    for s in range(1, len(tree.segments)):
        if joints is not None and body.joints[s] not in joints:
            continue
        turns = tree.axes[tree.dof_start[s] : tree.dof_start[s + 1]]
        if tree.prismatic[tree.dof_start[s] : tree.dof_start[s + 1]].any():
            raise BodyError("bands cannot have a sliding joint", place=body.joints[s], remedy="Give rotating joints.")
        if len(turns) == 0 or body.joints[s] in elliptic:
            bands = elliptic_bands(np.zeros(3), _section(body, s), along_ellipse)
        elif len(turns) == 1:
            width = float(np.linalg.norm(_section(body, s), axis=1).mean())
            bands = hinge_bands(np.zeros(3), turns[0], width, along_line)
        else:
            bands = universal_band(np.zeros(3))
        points.append(bands)
        owners.append(np.full(len(bands), s))
    x, joint = (np.concatenate(v) if v else v for v in (points, owners))
    joint = np.asarray(joint, np.int64)
    names = tuple(f"{tree.segments[s]}_{k}" for k, s in enumerate(joint))
    x = np.asarray(x, float).reshape(-1, 3)
    parent = PointSet(names, tree.parents[joint], x + tree.offsets[joint])
    return Bands(parent, PointSet(names, joint, x), joint)


def band_rows(body: Body, state: BodyState, bands: Bands, *, sigma: ArrayLike = 0.005) -> PairRows:
    """Three pair rows for each band: the points of both parts should coincide (P2 4.2.6).

    Parameters
    ----------
    body : Body
        Of free parts (`bodies.parts.free_parts`); in an ordinary body the bands are never stretched.
    state : BodyState
    bands : Bands
    sigma : scalar or (K,) [m]
        Standard deviation of a band's extension.
    """
    return coincidence_rows(body, state, bands.parent, bands.child, sigma=sigma)


def with_bands(body: Body, sigmas: Mapping[str, float]) -> Body:
    """Replace joints of a body by elastic bands, see `joint_bands`: free joints, and soft closures between band ends.

    The joint keeps its coordinates with their names and limits. It gets three slides, and the rotations that it lacks,
    which only its bands constrain.

    Parameters
    ----------
    sigmas : {name of a joint: standard deviation [m] of the extension of each of its bands}; "all" stands for every
        joint that is not named and does not slide. A band's weight is 1 / sigma².

    Raises
    ------
    BodyError
        An unknown joint, or one that slides.
    """
    tree, closures = body.tree, list(body.closures)
    sliding = {body.joints[s] for s in tree.owners[tree.prismatic].tolist()}
    sigma = {joint: sigmas["all"] for joint in body.joints[1:] if joint not in sliding} if "all" in sigmas else {}
    for joint in sigmas.keys() - {"all"}:
        check_choice("joint", joint, body.joints[1:], BodyError, remedy='Name one of these, or "all".')
        sigma[joint] = sigmas[joint]
    bands = joint_bands(body, joints=sigma)
    names = [f"{BAND}{name}" for name in bands.child.names]
    for name, joint in zip(names, bands.joint):
        closures.append(Closure(name, "point", f"{name} outer", f"{name} inner", sigma=sigma[body.joints[joint]]))
    landmarks = PointSet(
        (*body.landmarks.names, *(f"{name} outer" for name in names), *(f"{name} inner" for name in names)),
        np.concatenate([body.landmarks.segments, bands.child.segments, bands.parent.segments]),
        np.concatenate([body.landmarks.points, bands.child.points, bands.parent.points]),
    )
    for s in np.unique(bands.joint).tolist():
        own = tree.axes[tree.dof_start[s] : tree.dof_start[s + 1]]
        tree = _freed(tree, s, np.linalg.svd(own)[2][np.linalg.matrix_rank(own) :] if len(own) else np.eye(3))
    return replace(body, tree=tree, landmarks=landmarks, closures=tuple(closures))


def _freed(tree: KinematicTree, segment: int, turns: NDArray) -> KinematicTree:
    """The tree with three slides before a joint's coordinates, and rotations about further axes (k, 3) after them."""
    first, stop = int(tree.dof_start[segment]), int(tree.dof_start[segment + 1])
    at = np.repeat([first, stop], [3, len(turns)])
    names, k = list(tree.coordinates), len(at)
    names[stop:stop] = [f"{tree.segments[segment]}_band_r{i + 1}" for i in range(len(turns))]
    names[first:first] = [f"{tree.segments[segment]}_band_t{axis}" for axis in "xyz"]
    added = {
        "axes": np.concatenate([np.eye(3), turns]), "prismatic": np.arange(k) < 3, "lower": np.full(k, -np.inf),
        "upper": np.full(k, np.inf), "usual": np.zeros(k), "spread": np.full(k, np.inf),
    }  # fmt: skip
    columns = {name: np.insert(getattr(tree, name), at, values, axis=0) for name, values in added.items()}
    return replace(
        tree, coordinates=tuple(names), owners=np.insert(tree.owners, at, segment),
        couplings=np.insert(tree.couplings, at, 0.0, axis=1), **columns,
    )  # fmt: skip


def _section(body: Body, segment: int) -> NDArray:
    """Half axes (2, 3) [m] of the cross-section of a part at its joint."""
    own = [c for c in body.surfaces if isinstance(c, TaperedCylinder) and c.segment == segment]
    if not own:
        return _DEFAULT_HALF_WIDTH * np.eye(3)[[0, 2]]
    nearest = min(own, key=lambda c: float(np.linalg.norm(c.start)))
    return nearest.axes[:2] * np.array(nearest.radii[0])[:, None]


def coincidence_rows(
    body: Body, state: BodyState, points_a: PointSet, points_b: PointSet, *, sigma: ArrayLike = 0.001
) -> PairRows:
    """Three pair rows for each pair of points that should coincide: r = x_b − x_a along the world's axes.

    Parameters
    ----------
    points_a, points_b : PointSet of K points each, on different segments.
    sigma : scalar or (K,) [m]
        Standard deviation of the gap; a small one makes a closed chain.

    Raises
    ------
    ObservationError
        Different numbers of points, or a sigma that is not positive.
    """
    if len(points_a) != len(points_b):
        problem = f"{len(points_a)} points should meet {len(points_b)}"
        raise ObservationError(problem, remedy="Give equal numbers of points.")
    a, b = body.positions(state, points_a), body.positions(state, points_b)
    n = np.tile(np.eye(3), (len(a), 1))
    w = np.repeat(targets.weights(sigma, np.ones(len(a), bool), "coincidences"), 3)
    pairs = np.repeat(np.stack([points_a.segments, points_b.segments], axis=1), 3, axis=0)
    gap = (b - a).reshape(-1)
    return PairRows(pairs, np.repeat(a, 3, axis=0), np.repeat(b, 3, axis=0), n, gap, w)
