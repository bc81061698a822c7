"""Whole-take smoothing: all frames in one sparse least-squares problem, with a prior on changes of motion.

With v_s the step from frame s to s + 1 of every degree of freedom (the root's rotation as a rotation vector in the
world), the prior assumes that r_s = v_s − (κ + λ) v_{s−1} + κ λ v_{s−2} is white noise: an acceleration that decays by
λ per frame drives a velocity that decays by κ per frame (Singer 1970; Särkkä & Svensson, Bayesian Filtering and
Smoothing, 2023). Each frame is coupled to the next three. Levenberg-Marquardt solves the system with a block band
Cholesky factor; covariances are blocks of its inverse (Takahashi et al. 1973).

Marginalise the oldest frames of a sliding window: they become a quadratic cost of its first three frames.

The motion prior couples a frame to the next three. So earlier frames affect later ones only through three frames, and
eliminating one more frame (a Schur complement) leaves a cost of the next three.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, KinematicTree
from kinefit.errors import ObservationError
from kinefit.solving.equations import dense_pattern, inverse
from kinefit.solving.least_squares import Damping, descend
from kinefit.solving.trajectory import _kernels_band, _kernels_smoothing
from kinefit.solving.trajectory.motion_prior import MotionPrior


@dataclass(frozen=True, eq=False)
class Entering:
    """Quadratic cost − 2 gᵀδ + δᵀHδ of three consecutive frames, from marginalised earlier ones.

    Parameters
    ----------
    roots, angles : (3, 4, 4), (3, D) states from which δ counts
    H, g : (3 n, 3 n), (3 n,)
    H_covariance : (3 n, 3 n) H for covariances, with `MotionPrior.posture_share` of the posture prior
    """

    roots: NDArray
    angles: NDArray
    H: NDArray
    g: NDArray
    H_covariance: NDArray

    def moved(self, roots: NDArray, angles: NDArray) -> NDArray:
        """δ (3 n,) to three other states (3, 4, 4), (3, D)."""
        out = np.empty((3, len(self.g) // 3))
        _kernels_smoothing.differences(self.roots, roots, self.angles, angles, out)
        return out.ravel()

    def add(self, roots: NDArray, angles: NDArray, g: NDArray) -> float:
        """Add the gradient at the first three of T states to g (T, n); returns the cost (a number)."""
        delta = self.moved(np.ascontiguousarray(roots[:3]), np.ascontiguousarray(angles[:3]))
        pull = self.H @ delta
        g[:3] += (self.g - pull).reshape(3, -1)
        return float(delta @ pull - 2.0 * self.g @ delta)


def padded(n: int) -> int:
    """Size of the blocks in which `factor_band` has n unknowns (int): a multiple of four."""
    return 4 * -(-n // 4)


def start_of(
    entering: Entering | None, n: int, held: NDArray | None = None, *, covariance: bool = False
) -> NDArray:
    """H (3 p, 3 p) for `factor_band`, with n of p unknowns in each frame, without `held` (3, n) bool."""
    p = padded(n)
    out = np.zeros((3, p, 3, p))
    if entering is not None:
        H = np.array(entering.H_covariance if covariance else entering.H)
        if held is not None and held.any():
            H[held.ravel()] = 0.0
            H[:, held.ravel()] = 0.0
        out[:, :n, :, :n] = H.reshape(3, n, 3, n)
    return out.reshape(3 * p, 3 * p)


def blocks(body: Body) -> tuple[NDArray, NDArray]:
    """First column (n,) and width (n,) of each row of a block of the prior: 3 for the root's rotation, else 1."""
    first, width = np.arange(body.tree.n_dofs), np.ones(body.tree.n_dofs, np.int64)
    first[3:6], width[3:6] = 3, 3
    return first, width


def leave(
    body: Body, states: tuple[NDArray, NDArray], H: NDArray, g: NDArray, posture: NDArray, held: NDArray,
    motion: tuple[NDArray, NDArray], entering: Entering | None,
) -> Entering:  # fmt: skip
    """Marginalise the first of four frames; returns the cost of the other three.

    Parameters
    ----------
    states : roots (4, 4, 4) and angles (4, D)
    H, g : (n, n), (n,) of the first frame's measurements and posture prior
    posture : (n, n) weight of the posture prior in a covariance minus that in the fit
    held : (n,) bool, degrees of freedom of the first frame at a limit
    motion : past (3, 2) and weight (3, n) of the three steps, see `MotionPrior.rows`
    entering : cost of the first three frames from earlier ones; it contains the prior of the first two steps
    """
    n, (roots, angles), (past, weight) = len(g), states, motion
    weight = np.array(weight)
    A, b = np.zeros((4, n, 4, n)), np.zeros((4, n))
    if entering is not None:
        weight[:2] = 0.0
        delta = entering.moved(roots[:3], angles[:3])
        A[:3, :, :3] = entering.H.reshape(3, n, 3, n)
        b[:3] = (entering.g - entering.H @ delta).reshape(3, n)
    A[0, :, 0] += H
    b[0] += g
    steps, band = np.empty((3, n)), np.zeros((4, 4, n, 3))
    _kernels_smoothing.velocities(roots, angles, steps)
    _kernels_smoothing.add_motion(steps, np.ascontiguousarray(past), weight, *blocks(body), band, b)
    A += _unpacked(band, *blocks(body))
    A_covariance = np.array(A)
    if entering is not None:
        A_covariance[:3, :, :3] += (entering.H_covariance - entering.H).reshape(3, n, 3, n)
    A_covariance[0, :, 0] += posture
    A[0, held], b[0, held] = 0.0, 0.0
    A[:, :, 0, held] = 0.0
    A[0, held, 0, held] = 1.0
    H_marginal, g_marginal = _schur(A.reshape(4 * n, 4 * n), b.ravel(), n)
    H_covariance, _ = _schur(A_covariance.reshape(4 * n, 4 * n), b.ravel(), n)
    return Entering(np.array(roots[1:]), np.array(angles[1:]), H_marginal, g_marginal, H_covariance)


def _unpacked(band: NDArray, first: NDArray, width: NDArray) -> NDArray:
    """Dense (T, n, T, n) from blocks (4, T, n, 3) between frames, see `_kernels_band`."""
    T, n = band.shape[1:3]
    out = np.zeros((T, n, T, n))
    for i in range(n):
        for k in range(width[i]):
            j = first[i] + k
            for ahead in range(4):
                for t in range(T - ahead):
                    out[t + ahead, i, t, j] = band[ahead, t, i, k]
                    out[t, j, t + ahead, i] = band[ahead, t, i, k]
    return out


def _schur(A: NDArray, b: NDArray, n: int) -> tuple[NDArray, NDArray]:
    """Schur complement of A (4 n, 4 n), b (4 n,) without the first n unknowns: (3 n, 3 n), (3 n,)."""
    p = padded(n)
    alone = np.zeros((p, p))
    alone[:n, :n] = inverse(A[:n, :n] + 1e-12 * np.trace(A) / len(A) * np.eye(n))
    below, fall, removed = np.zeros((3 * p, p)), np.empty((3 * p, p)), np.empty((3 * p, 3 * n))
    below[: 3 * n, :n] = A[n:, :n]
    _kernels_band.product(below, alone, fall)
    _kernels_band.product(fall, np.ascontiguousarray(below[: 3 * n].T), removed)
    schur = A[n:, n:] - removed[: 3 * n]
    return 0.5 * (schur + schur.T), b[n:] - fall[: 3 * n, :n] @ b[:n]


_MAX_DAMPING = 1e12  # over the mean diagonal: with more the cost cannot fall

Equations = tuple[NDArray, NDArray, NDArray]
MakeEquations = Callable[[NDArray, NDArray], Equations]


@dataclass(frozen=True, eq=False)
class _BandEquations:
    """Undamped normal equations; see `_kernels_band`."""

    C: NDArray
    band: NDArray
    g: NDArray
    cost: float
    changes: NDArray
    entering: Entering | None = None


@dataclass(frozen=True, eq=False)
class Smoothed:
    """All frames of a take, fitted jointly.

    Parameters
    ----------
    roots : (T, 4, 4) [m], T_world_root; angles : (T, D) [rad or m]
    cost : float
    iterations : int, number of steps tried
    converged : bool
    held : (T, n) bool, degrees of freedom that are fixed or at a limit
    """

    roots: NDArray
    angles: NDArray
    cost: float
    iterations: int
    converged: bool
    prior: MotionPrior
    system: _BandEquations
    pattern: tuple[NDArray, NDArray]
    held: NDArray

    @property
    def changes(self) -> NDArray:
        """(T - 1, n) changes r_s [m, rad] per frame²."""
        return self.system.changes


@dataclass(frozen=True, eq=False)
class Posterior:
    """Covariances of a smoothed take.

    Parameters
    ----------
    frames : (T, n, n) covariance of every frame
    following : (T - 1, n, n) cross-covariance of frame t + 1 (rows) and frame t (columns)
    change_variance : (T - 1, n) of every r_s
    """

    frames: NDArray
    following: NDArray
    change_variance: NDArray


def smooth(
    body: Body,
    roots: NDArray,
    angles: NDArray,
    equations: MakeEquations,
    prior: MotionPrior,
    *,
    bounds: tuple[NDArray, NDArray] | None = None,
    dense: bool = False,
    entering: Entering | None = None,
    max_iterations: int = 30,
    tolerance: float = 1e-5,
) -> Smoothed:
    """Minimise the cost of all frames and of the motion prior jointly.

    Parameters
    ----------
    roots, angles : (T, 4, 4), (T, D) to start from; angles without jumps of 2π
    equations : (roots, angles) -> (C (T, n, m) packed along the tree, g (T, n), cost (T,))
        Called at every state tried; its arrays are modified.
    bounds : (T, D) lower and upper limits of every angle
    dense : bool
        Whether the equations couple degrees of freedom beyond the tree's pattern: C is (T, n, n), of which the lower
        triangle is read. If the posture prior is coupled, packed equations are made dense here.
    entering : Entering
        Cost of the first three frames from marginalised earlier ones; it contains the prior of the first two steps.
    tolerance : stop when the predicted fall of the cost is below this share of it

    Raises
    ------
    ObservationError
        The equations are not finite.
    """
    tree = body.tree
    if prior.coupled and not dense:
        equations, dense = _made_dense(body, equations), True
    chain, depth = pattern = dense_pattern(tree.n_dofs) if dense else (tree.chain, tree.depth)
    lower, upper = (np.array(np.broadcast_to(b, angles.shape), float) for b in bounds or (-np.inf, np.inf))
    n, (W, below, delta) = tree.n_dofs, _workspace(len(roots), tree.n_dofs)

    def at(roots: NDArray, angles: NDArray) -> Smoothed:
        system = _system(body, roots, angles, equations, prior, depth, entering)
        held = _held(body, system, angles, lower, upper)
        return Smoothed(roots, angles, system.cost, 0, False, prior, system, pattern, held)

    def solve(now: Smoothed, damping: float) -> tuple[NDArray, float]:
        C, band, g, start = _within_limits(body, now)
        delta[:, :n], step = g, delta[:, :n]
        if not _kernels_band.factor_band(C, chain, depth, band, *blocks(body), damping, start, W, below, delta):
            return step, -1.0
        _kernels_band.back_substitute(W, below, delta)
        return step, float(np.vdot(step, g) + damping * np.vdot(step, step))

    def follow(now: Smoothed, step: NDArray) -> Smoothed:
        roots, angles = np.empty_like(now.roots), np.empty_like(now.angles)
        _kernels_smoothing.retract_all(now.roots, now.angles, step, lower, upper, roots, angles)
        return at(roots, angles)

    start = at(np.array(roots, float, order="C"), np.clip(np.array(angles, float, order="C"), lower, upper))
    mean = float(start.system.C[:, np.arange(n), depth].mean() + start.system.band[0, :, :, 0].mean())
    if not np.isfinite(start.cost) or not np.isfinite(mean):
        raise ObservationError("this take cannot be smoothed", remedy="Check that all weights and pixels are finite.")
    end = descend(
        start, solve, follow, iterations=max_iterations, tolerance=tolerance, nothing=1e-16 * start.cost + 1e-300,
        damping=Damping(1e-9, most=_MAX_DAMPING).times(mean), last=True,
    )  # fmt: skip
    return replace(end.at, iterations=end.iterations, converged=end.converged)


def _held(body: Body, at: _BandEquations, angles: NDArray, lower: NDArray, upper: NDArray) -> NDArray:
    """(T, n) bool: degrees of freedom that are fixed, or at a limit and pulled beyond it."""
    g = at.g[:, 6:]
    moving = ((angles <= lower) & (g < 0)) | ((angles >= upper) & (g > 0))
    return np.concatenate([np.full((len(g), 6), not body.tree.root_free), moving], axis=1)


def _within_limits(body: Body, at: Smoothed) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """C, band and g of the system without the degrees of freedom held, and the start for `factor_band`."""
    s = at.system
    start = start_of(s.entering, at.held.shape[1], at.held[:3])
    if not at.held.any():
        return s.C, s.band, s.g, start
    C, band, g = s.C.copy(), s.band.copy(), s.g.copy()
    _kernels_smoothing.hold(at.held, *blocks(body), *at.pattern, C, band, g)
    return C, band, g, start


def responses(body: Body, smoothed: Smoothed, B: NDArray) -> NDArray:
    """A⁻¹ B (T, n, p) for the system A of a smoothed take and B (T, n, p); 0 where limits hold."""
    (C, band, _, start), (chain, depth) = _within_limits(body, smoothed), smoothed.pattern
    n, out = B.shape[1], np.array(B)
    out[smoothed.held] = 0.0
    W, below, delta = _workspace(len(B), n)
    tiny = 1e-12 * float(C[:, np.arange(n), depth].mean())
    for k in range(B.shape[2]):
        delta[:, :n] = out[..., k]
        while not _kernels_band.factor_band(C, chain, depth, band, *blocks(body), tiny, start, W, below, delta):
            tiny, delta[:, :n] = 10.0 * tiny, out[..., k]
        _kernels_band.back_substitute(W, below, delta)
        out[..., k] = delta[:, :n]
    return out


def _made_dense(body: Body, equations: MakeEquations) -> MakeEquations:
    def dense(roots: NDArray, angles: NDArray) -> Equations:
        packed, g, cost = equations(roots, angles)
        return _lower(packed, body.tree), g, cost

    return dense


def unpacked(packed: NDArray, tree: KinematicTree) -> NDArray:
    """Symmetric (T, n, n) of matrices (T, n, m) that are packed along the tree."""
    out = _lower(packed, tree)
    return out + np.tril(out, -1).transpose(0, 2, 1)


def _lower(packed: NDArray, tree: KinematicTree) -> NDArray:
    """Lower triangles (T, n, n) of matrices (T, n, m) that are packed along the tree; 0 above."""
    out = np.zeros((*packed.shape[:2], tree.n_dofs))
    _kernels_smoothing.add_packed(packed, tree.chain, tree.depth, out)
    return out


def _workspace(T: int, n: int) -> tuple[NDArray, NDArray, NDArray]:
    p = padded(n)
    return np.empty((T, p, p)), np.empty((T, 3 * p, p)), np.zeros((T, p))


def _system(
    body: Body,
    roots: NDArray,
    angles: NDArray,
    equations: MakeEquations,
    prior: MotionPrior,
    depth: NDArray,
    entering: Entering | None = None,
) -> _BandEquations:
    T, n = len(roots), body.tree.n_dofs
    C, g, cost = equations(roots, angles)
    precision, away = prior.precision, prior.mean - angles
    pull = away @ precision
    _add_posture(C, precision, depth)
    g[:, 6:] += pull
    cost = cost + np.sum(pull * away, axis=1)
    steps, band = np.empty((max(T - 1, 0), n)), np.zeros((4, T, n, 3))
    _kernels_smoothing.velocities(roots, angles, steps)
    past, weight = prior.rows(len(steps))
    if entering is not None:
        weight[:2] = 0.0  # contained in `entering`
        cost[0] += entering.add(roots, angles, g)
    total = float(cost.sum()) + _kernels_smoothing.add_motion(steps, past, weight, *blocks(body), band, g)
    changes = steps.copy()
    changes[1:] -= past[1:, :1] * steps[:-1]
    changes[2:] -= past[2:, 1:] * steps[:-2]
    return _BandEquations(C, band, g, total, changes, entering)


def posterior(body: Body, smoothed: Smoothed, since: int = 0, share: NDArray | None = None) -> Posterior:
    """Covariances of a smoothed take: blocks of the inverse of the undamped system.

    Joint limits are ignored, as in a frame's covariance.

    Parameters
    ----------
    since : int, first frame whose covariance is computed; earlier ones are NaN
    share : (D, D) the prior's `posture_share`; default: computed here
    """
    s, prior, (chain, depth) = smoothed.system, smoothed.prior, smoothed.pattern
    T, n = s.g.shape
    C = s.C.copy()
    share = prior.posture_share if share is None else share
    _add_posture(C, share - prior.precision, depth)
    W, below, nothing = _workspace(T, n)
    tiny = max(1e-12 * float(s.C[:, np.arange(n), depth].mean()), 1e-12)  # nothing measured: C is 0
    start = start_of(s.entering, n, covariance=True)
    while not _kernels_band.factor_band(C, chain, depth, s.band, *blocks(body), tiny, start, W, below, nothing):
        tiny *= 10.0
    frames, following = np.full((T, n, n), np.nan), np.full((max(T - 1, 0), n, n), np.nan)
    past, _ = prior.rows(max(T - 1, 0))
    variance = np.zeros((max(T - 1, 0), n))
    _kernels_band.covariance_blocks(W, below, past, since, frames, following, variance)
    return Posterior(frames, following, variance)


def _add_posture(C: NDArray, weight: NDArray, depth: NDArray) -> None:
    """Add a weight (D, D) of angles to every block of C; only its diagonal if C is packed."""
    n = len(depth)
    if C.shape[2] == n:
        C[:, 6:, 6:] += weight
    else:
        C[:, np.arange(6, n), depth[6:]] += np.diag(weight)
