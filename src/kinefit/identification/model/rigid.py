"""The points where two segments meet, with what a motion leaves open, and how far joints were turned."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.se3 import exp_so3, log_so3, nearest_rotation
from kinefit.identification.model.model import MarkerJoint
from kinefit.solvers.rigid_clusters import local, middle

SECOND_RANGE = 0.35
"""Of a joint's range: about the axis it turns about second most, where all is known. A hip flexes through 130 degrees
and spreads through 45; a hinge has no second axis, and its distances none that changes with it."""

MORE, TURN = 1.3, 0.15
"""Turns of a joint go beyond those of training by this factor, and this [rad]."""


def meet(
    Rp: NDArray, tp: NDArray, Rc: NDArray, tc: NDArray, x: NDArray, y: NDArray, guess: NDArray
) -> tuple[NDArray, NDArray]:
    """The point that is constant in both frames: a in the parent's, b in the child's, from the reference place `guess`.

    Least squares of R_p a + t_p = R_c b + t_c over all frames; along directions that the motion does not tell (a
    hinge's axis, or a joint held still) both stay at the guess, which counts as much as one centimetre in three.
    """
    if len(x) < 3:
        return meet_few(Rp, tp, x, y, guess)
    good = np.isfinite(tp).all(1) & np.isfinite(tc).all(1)
    if not good.any():
        return guess, guess
    A = np.concatenate([Rp[good], -Rc[good]], axis=2)
    r = tc[good] - tp[good] - (A @ np.concatenate([guess, guess]))
    H = np.einsum("fij,fik->jk", A, A) / good.sum()
    g = np.einsum("fij,fi->j", A, r) / good.sum()
    step = np.linalg.solve(H + 0.02 * np.eye(6), g)
    return guess + step[:3], guess + step[3:]


def meet_few(Rp: NDArray, tp: NDArray, x: NDArray, y: NDArray, guess: NDArray) -> tuple[NDArray, NDArray]:
    """The same for a child of one or two markers: the point of the parent that keeps its distance to each."""
    good = np.isfinite(tp).all(1)
    a = guess.copy()
    local = np.einsum("fji,fkj->fki", Rp[good], y[good] - tp[good][:, None])
    for _ in range(5):
        away = local - a
        length = np.linalg.norm(away, axis=-1)
        typical = middle(length, axis=0)
        J = -away / np.maximum(length, 1e-9)[..., None]
        r = typical - length
        ok = np.isfinite(r)
        if not ok.any():
            return guess, guess
        J, r = J[ok], r[ok]
        a = a + np.linalg.solve(J.T @ J / len(r) + 0.02 * np.eye(3), J.T @ r / len(r) + 0.02 * (guess - a))
    # in the child: at those distances from its markers, nearest to where the parent's lies in the reference
    b = a.copy()
    typical = middle(np.linalg.norm(local - a, axis=-1), axis=0)
    for _ in range(10):
        away = b - x
        length = np.linalg.norm(away, axis=-1)
        J, r = away / np.maximum(length, 1e-9)[:, None], typical - length
        b = b + np.linalg.lstsq(J, r, rcond=1e-3)[0]
    return a, b


def joint_residual(parent: tuple[NDArray, ...], child: tuple[NDArray, ...] | None, y: NDArray) -> float:
    """[m] how far the best joint of two segments strays: root mean square, median over frames.

    Parameters
    ----------
    parent, child : shape (k, 3), rotations (F, 3, 3), translations (F, 3); no child where it has fewer than 3 markers
    y : (F, k, 3) [m] markers of the child
    """
    _, Rp, tp = parent
    frame = int(np.argmax(np.isfinite(y[..., 0]).sum(1) + np.isfinite(tp[:, 0])))
    if child is not None:
        _, Rc, tc = child
        good = np.isfinite(tp).all(1) & np.isfinite(tc).all(1)
        if good.sum() < 3:
            return np.inf
        A = np.concatenate([Rp[good], -Rc[good]], axis=2)
        r = tc[good] - tp[good]
        start = np.concatenate([local(Rp[good], tp[good], y[good]).mean((0, 1)), np.zeros(3)])
        start[3:] = middle(local(Rc[good], tc[good], y[good]), axis=(0, 1))
        start = np.nan_to_num(start)
        H = np.einsum("fij,fik->jk", A, A) / good.sum() + 1e-3 * np.eye(6)
        g = np.einsum("fij,fi->j", A, r - A @ start) / good.sum()
        left = r - A @ (start + np.linalg.solve(H, g))
        return float(np.sqrt(np.median((left**2).sum(1))))
    here = local(Rp, tp, y)
    guess = here[frame].copy()
    if not np.isfinite(guess).any():
        return np.inf
    a, _ = meet_few(Rp, tp, y[frame] if np.isfinite(y[frame]).all() else guess, y, np.nanmean(guess, axis=0))
    length = np.linalg.norm(here - a, axis=-1)
    return float(np.sqrt(np.nanmedian((length - middle(length, axis=0)) ** 2))) if len(length) else np.inf


def _turns(Rp: NDArray, Rc: NDArray, good: NDArray) -> tuple[NDArray, NDArray, NDArray] | None:
    """Mean turn (3, 3) of a child in its parent's frame, turns about it (F, 3) [rad] along their own axes (3, 3)."""
    relative = np.einsum("fji,fjk->fik", Rp[good], Rc[good])
    relative = relative[np.isfinite(relative).all((1, 2))]
    if not len(relative):
        return None
    mean = nearest_rotation(relative.mean(0))
    turns = log_so3(np.einsum("ji,fjk->fik", mean, relative))
    _, axes = np.linalg.eigh(turns.T @ turns)
    return mean, turns @ axes, axes


def turned(Rp: NDArray, Rc: NDArray, good: NDArray) -> tuple[float, float, float]:
    """[rad] range of a joint about three axes at right angles, largest first: what 90 % of the frames lie within."""
    found = _turns(Rp, Rc, good)
    if found is None:
        return 0.0, 0.0, 0.0
    low, high = np.quantile(found[1], [0.05, 0.95], axis=0)
    first, second, third = np.sort(high - low)[::-1].tolist()
    return first, second, third


def usual_turn(
    Rp: NDArray, Rc: NDArray, good: NDArray, full: float
) -> tuple[NDArray | None, NDArray | None]:
    """Middle of a joint's turns (3, 3) and their covariance (3, 3) [rad²], in the child's axes; None where not seen.

    The covariance is that of turns spread evenly over what training showed, MORE of it, and of turns that it did not
    show: TURN about any axis; of one that went through little of its range `full` [rad] the rest of that about all
    axes; and, of what joints may turn about a second axis, half of what it did not.
    """
    found = _turns(Rp, Rc, good)
    if found is None:
        return None, None
    mean, turns, axes = found
    low, high = np.quantile(turns, [0.005, 0.995], axis=0)
    middle_turn = mean @ exp_so3(axes @ (0.5 * (low + high)))
    seen = np.sort(high - low)[::-1]
    open_first = max(full - seen[0], 0.0)
    open_second = 0.5 * max(SECOND_RANGE * full - seen[1], 0.0)
    square = (MORE * (high - low)) ** 2 / 12 + TURN**2 + open_first**2 + open_second**2
    return middle_turn, (axes * square) @ axes.T


def told(joint: MarkerJoint, full: float) -> float:
    """0..1: how much of its range `full` [rad] a joint went through; the axis it turns about second counts for half."""
    first, second, _ = joint.ranges
    return 0.5 * min(1.0, first / full) + 0.5 * min(1.0, second / (SECOND_RANGE * full))
