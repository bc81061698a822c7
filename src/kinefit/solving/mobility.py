"""Mobility of a body with closures: Gruebler's count, and the rank of the closures' Jacobian (P3 eq. 9, 3).

Gruebler: N moving links and g joints of fᵢ freedoms leave F = 6 (N − g) + Σ fᵢ. Every joint of the tree and every
closure counts as a joint. The count ignores geometry; the rank of the closures' Jacobian at closed poses does not. If
equations are redundant, the mobility is greater than F, and the body is over-constrained.

In the plane 3 replaces 6, and a closure counts only with its equations in the plane. The paper's pedal (3.1) has the
moving links thigh, shank and crank, N = 3; the ground does not count. Its joints are hip, knee, the crank's axis and
the foot on the pedal, g = 4, one freedom each: F = 3 (3 − 4) + 4 = 1, the crank's angle. As a point on a circle (eq.
12), which takes one of three freedoms, N = 2, g = 3 and F = 3 (2 − 3) + 1 + 1 + 2 = 1 again. In space F = 0.

The paper's "rank g − F" holds if g counts the freedoms of the open chain, the unknowns of the fit: 3 − 1 = 2 for the
pedal. With g of (9), closures included, it does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import BodyError
from kinefit.solving.closed import CLOSED, null_space, onto
from kinefit.solving.correspondences.closures import closed_at, every_equation, owners
from kinefit.solving.correspondences.points import prior_rows
from kinefit.solving.equations import lock
from kinefit.solving.least_squares import levenberg_marquardt
from kinefit.solving.rows import DofRows

_MIN_SINGULAR_RATIO = 1e-6  # to the largest singular value; generic poses of the catalogue's bodies have 1e-3 and more
_MAX_OUT_OF_PLANE = 1e-6  # sine of the angle between a joint and the plane of a planar count
_FREE_STEP = 0.02  # [m, rad] of a step along a direction of the null space
_MIN_STEP_SHARE = 0.5  # of such a step that must remain after projection onto the equations
_POSES = 4  # closed poses that are examined
_MAX_STARTS = 12  # for closed poses
_CLOSURE_STD = 0.01  # [m, rad] of closures in the fit that leads to a closed pose
_MAX_CLOSURE_SIGMAS = 3.0  # residual of a soft closure in its best pose


@dataclass(frozen=True)
class Mobility:
    """Mobility of a body with closures.

    Parameters
    ----------
    links : N, number of moving segments
    joints : g, number of joints of the tree and closures
    open_dofs : degrees of freedom of the open tree, root included
    equations : number of equations of the closures, in the plane for a planar count
    gruebler : F, Gruebler's count
    rank : of the closures' Jacobian at closed poses
    mobility : number of directions in which the closed body moves by finite steps
    redundant : descriptions of redundant equations, if Gruebler's count is not the mobility
    """

    links: int
    joints: int
    open_dofs: int
    equations: int
    gruebler: int
    rank: int
    mobility: int
    redundant: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether Gruebler's count equals the mobility."""
        return self.gruebler == self.mobility


def mobility(body: Body, seed: int = 0, *, planar: bool = False) -> Mobility:
    """Compute the mobility of a body, with or without closures.

    Parameters
    ----------
    seed : int, of the random closed poses
    planar : whether Gruebler's count is that of a mechanism in a plane, with 3 in place of 6

    Raises
    ------
    BodyError
        Closures contradict each other: no pose satisfies them. `planar` with a body that does not move in a plane.
    """
    fixed, tree = lock(body, None), body.tree
    count = int(np.sum(~fixed))
    links = len(tree.segments) - (0 if tree.root_free else 1)
    joints = links + len(body.closures)
    taken = sum(_in_plane(body) if planar else (c.rows for c in body.closures))
    space = 3 if planar else 6
    F = space * (links - joints) + count + space * len(body.closures) - taken
    if not body.closures:
        return Mobility(links, joints, count, 0, F, 0, count, ())
    poses = closed_poses(body, seed)
    ranks, moves = [], []
    for state in poses:
        A = closed_at(body, state).jacobian[:, ~fixed]
        ranks.append(_rank(A))
        moves.append(_finite(body, state, fixed))
    best = int(np.argmax(ranks))
    return Mobility(
        links, joints, count, taken, F, ranks[best], moves[best],
        () if F == moves[best] else _redundant(body, closed_at(body, poses[best]).jacobian[:, ~fixed]),
    )  # fmt: skip


def _in_plane(body: Body) -> list[int]:
    """Number of equations of each closure in the plane of the body's motion."""
    state, tree = body.default_state(), body.tree
    v, w = np.split(tree.forward(state.T_world_root, state.angles)[1], 2, axis=1)
    turning = w[np.linalg.norm(w, axis=1) > 0.5]
    normal = turning[0] / np.linalg.norm(turning[0]) if len(turning) else np.zeros(3)
    out_of_plane = max(np.abs(np.cross(w, normal)).max(initial=0.0), np.abs(v @ normal).max(initial=0.0))
    if tree.root_free or not len(turning) or out_of_plane > _MAX_OUT_OF_PLANE:
        problem = f"body '{body.name}' does not move in a plane"
        remedy = "Count it in space, or fix its root, let joints turn about one direction, and slide across it."
        raise BodyError(problem, remedy=remedy)
    taken = []
    for c in body.closures:
        n = state.T_world_root[:3, :3].T @ normal if c.to else normal
        across = c.directions - np.outer(c.directions @ n, n)
        taken.append(int(np.linalg.matrix_rank(across, tol=_MAX_OUT_OF_PLANE)) + (c.kind == "rigid"))
    return taken


def closed_poses(body: Body, seed: int = 0, most: int = _POSES) -> list[BodyState]:
    """Poses in which all closures hold exactly, soft ones too; `most` of them at most.

    Raises
    ------
    BodyError
        No such pose was found.
    """
    random, out, least = np.random.default_rng(seed), list[BodyState](), (np.inf, body.default_state())
    for k in range(_MAX_STARTS):
        state, off = _closed(body, _start(body, random, 0.0 if k == 0 else 1.0))
        if off <= CLOSED:
            out.append(state)
            if len(out) == most:
                break
        elif off < least[0]:
            least = off, state
    if not out:
        raise contradictory(body, least[1])
    return out


def contradictory(body: Body, state: BodyState) -> BodyError:
    """The error that no pose satisfies all closures; it names those that are open at a nearly closed state."""
    closed, owner = closed_at(body, state), owners(body)
    open_closures = []
    for k, c in enumerate(body.closures):
        off = float(np.linalg.norm(closed.value[owner == k][:3]))
        turn = float(np.linalg.norm(closed.value[owner == k][3:]))
        if off > 1e-4 or turn > 1e-3:
            turned = f" and {np.degrees(turn):.1f} deg" if turn > 0.0 else ""
            open_closures.append(f"'{c.name}' by {1e3 * off:.1f} mm{turned}")
    problem = f"closures of body '{body.name}' that contradict each other: in the best pose found they are off, "
    remedy = "Correct the places of their landmarks and their joints' ranges, or give one of them a larger sigma."
    return BodyError(problem + ", ".join(open_closures), remedy=remedy)


@lru_cache(maxsize=16)
def check_closed(body: Body) -> None:
    """Check before tracking that a body's closures can be satisfied, and that the closed body can move.

    Raises
    ------
    BodyError
        No pose satisfies the hard closures, or the soft ones within three standard deviations; the closed body cannot
        move.
    """
    if not body.closures:
        return
    random, least = np.random.default_rng(0), (np.inf, body.default_state())
    for k in range(_MAX_STARTS):
        state, _ = _closed(body, _start(body, random, 0.0 if k == 0 else 1.0))
        closed = closed_at(body, state)
        limit = np.where(closed.hard, 1e3 * CLOSED, _MAX_CLOSURE_SIGMAS * closed.sigma + 1e-12)
        worst = float(np.max(np.abs(closed.value) / limit))
        if worst <= 1.0:
            fixed = lock(body, None)
            hard = closed.chosen(closed.hard)
            if hard.jacobian.size and not null_space(hard.jacobian, hard.value, fixed).free.shape[1]:
                problem = f"the closures of body '{body.name}' leave no motion: it is over-constrained"
                raise BodyError(problem, remedy="`kinefit body check` shows which of them are redundant.")
            return
        if worst < least[0]:
            least = worst, state
    raise contradictory(body, least[1])


def _start(body: Body, random: np.random.Generator, share: float) -> BodyState:
    """The default pose, plus a random departure times `share`, within the limits and a radian."""
    tree = body.tree
    width = np.minimum(np.where(np.isfinite(tree.upper - tree.lower), 0.5 * (tree.upper - tree.lower), 1.0), 1.0)
    delta = np.concatenate([np.zeros(6), share * width * random.uniform(-1.0, 1.0, len(width))])
    return body.default_state().retract(delta, (tree.lower, tree.upper))


def _closed(body: Body, start: BodyState) -> tuple[BodyState, float]:
    """A closed pose near a start: first by least squares with the posture prior, then by projection; its residual."""

    def rows(state: BodyState) -> list[DofRows]:
        closed = closed_at(body, state)
        return [replace(closed, sigma=np.full(len(closed.value), _CLOSURE_STD)).rows()]

    near = levenberg_marquardt(
        body, start, lambda state: [*rows(state), prior_rows(body, state)], max_iterations=60, tolerance=1e-6
    )
    near = levenberg_marquardt(body, near.state, rows, max_iterations=60, tolerance=1e-8)
    return onto(body, near.state, every_equation(body))


def _finite(body: Body, state: BodyState, fixed: NDArray) -> int:
    """Number of directions in which a closed pose moves by a finite step and can be closed again."""
    equations = every_equation(body)
    c, A = equations(state)
    free = null_space(A, c, fixed).free
    moved = np.zeros_like(free)
    for k, z in enumerate(free.T):
        closed, off = onto(body, state.retract(_FREE_STEP * z), equations, limits=False)
        if off <= CLOSED:
            moved[:, k] = state.difference(closed) / _FREE_STEP
    s = np.linalg.svd(free.T @ moved, compute_uv=False) if free.shape[1] else np.zeros(0)
    return int(np.sum(s > _MIN_STEP_SHARE))


def _redundant(body: Body, A: NDArray) -> tuple[str, ...]:
    """Descriptions of the redundant equations, closure by closure."""
    owner, out = owners(body), []
    rank = _rank(A)
    if rank == len(A):
        return ()
    U = np.linalg.svd(A)[0][:, rank:]  # combinations of equations that are identically zero
    for k, c in enumerate(body.closures):
        adds = rank - _rank(A[owner != k])
        if adds < c.rows:
            candidates = [name for name, u in zip(c.row_names, np.abs(U[owner == k]).max(axis=1)) if u > 0.1]
            text = f"closure '{c.name}' has {c.rows} equations, of which {adds} are independent of the others"
            out.append(text + (f" (in question: {', '.join(candidates)})" if candidates else ""))
    return tuple(out)


def _rank(A: NDArray) -> int:
    if not len(A):
        return 0
    s = np.linalg.svd(A, compute_uv=False)
    return int(np.sum(s > _MIN_SINGULAR_RATIO * s[0])) if s[0] > 0.0 else 0
