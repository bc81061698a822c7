"""Estimate the joints between two marker segments, their ranges, and the covariance of their turns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.se3 import exp_so3, log_so3, nearest_rotation
from kinefit.markers.model.model import MarkerJoint
from kinefit.solving.functional_joints import local, nan_median

SECOND_AXIS_RATIO = 0.35
"""Range of a ball joint about its second axis over that about its first: a hip flexes through 130 degrees and spreads
through 45."""

RANGE_FACTOR = 1.3
"""Ratio of a joint's range in other motions to that in training."""

MIN_TURN_SIGMA = 0.15
"""[rad] standard deviation of turns about any axis that no training shows."""


def fit_joint(
    Rp: NDArray, tp: NDArray, Rc: NDArray, tc: NDArray, x: NDArray, y: NDArray, guess: NDArray
) -> tuple[NDArray, NDArray]:
    """Estimate the point that is constant in the frames of both segments: least squares over all frames.

    Minimises |R_p a + t_p - R_c b - t_c|². Along directions that the motion does not determine (a hinge's axis, a joint
    without motion) both points stay at the guess, which has the weight of one centimetre in three.

    Parameters
    ----------
    Rp, tp, Rc, tc : (F, 3, 3), (F, 3) [m] of the parent and of the child; NaN where unknown
    x, y : (k, 3), (F, k, 3) [m] reference and measured positions of the child's markers
    guess : (3,) [m] the joint in the reference

    Returns
    -------
    a, b : (3,), (3,) [m] the joint in the parent's and in the child's frame
    """
    if len(x) < 3:
        return fit_joint_few(Rp, tp, x, y, guess)
    valid = np.isfinite(tp).all(1) & np.isfinite(tc).all(1)
    if not valid.any():
        return guess, guess
    found, _ = _least_squares(Rp[valid], tp[valid], Rc[valid], tc[valid], np.concatenate([guess, guess]), 0.02)
    return found[:3], found[3:]


def _least_squares(
    Rp: NDArray, tp: NDArray, Rc: NDArray, tc: NDArray, start: NDArray, weight: float
) -> tuple[NDArray, NDArray]:
    """The joint (6,) [m] in both frames, with the weight of a start (6,), and its residuals (F, 3) [m]."""
    A = np.concatenate([Rp, -Rc], axis=2)
    r = tc - tp - A @ start
    H = np.einsum("fij,fik->jk", A, A) / len(A)
    step = np.linalg.solve(H + weight * np.eye(6), np.einsum("fij,fi->j", A, r) / len(A))
    return start + step, r - A @ step


def fit_joint_few(Rp: NDArray, tp: NDArray, x: NDArray, y: NDArray, guess: NDArray) -> tuple[NDArray, NDArray]:
    """Estimate the joint of a child with one or two markers: its distances to them are constant.

    Parameters and results are those of `fit_joint`.
    """
    valid = np.isfinite(tp).all(1)
    a = guess.copy()
    local = np.einsum("fji,fkj->fki", Rp[valid], y[valid] - tp[valid][:, None])
    for _ in range(5):
        away = local - a
        length = np.linalg.norm(away, axis=-1)
        typical = nan_median(length, axis=0)
        J = -away / np.maximum(length, 1e-9)[..., None]
        r = typical - length
        finite = np.isfinite(r)
        if not finite.any():
            return guess, guess
        J, r = J[finite], r[finite]
        a = a + np.linalg.solve(J.T @ J / len(r) + 0.02 * np.eye(3), J.T @ r / len(r) + 0.02 * (guess - a))
    # in the child's frame: the point at these distances from its markers that is nearest to the parent's
    b = a.copy()
    typical = nan_median(np.linalg.norm(local - a, axis=-1), axis=0)
    for _ in range(10):
        away = b - x
        length = np.linalg.norm(away, axis=-1)
        J, r = away / np.maximum(length, 1e-9)[:, None], typical - length
        b = b + np.linalg.lstsq(J, r, rcond=1e-3)[0]
    return a, b


def joint_residual(parent: tuple[NDArray, ...], child: tuple[NDArray, ...] | None, y: NDArray) -> float:
    """[m] root mean square residual of the best joint of two segments; median over the frames.

    Parameters
    ----------
    parent, child : (k, 3) shape, (F, 3, 3) rotations, (F, 3) translations; child None with fewer than 3 markers
    y : (F, k, 3) [m] markers of the child
    """
    _, Rp, tp = parent
    frame = int(np.argmax(np.isfinite(y[..., 0]).sum(1) + np.isfinite(tp[:, 0])))
    if child is not None:
        _, Rc, tc = child
        valid = np.isfinite(tp).all(1) & np.isfinite(tc).all(1)
        if valid.sum() < 3:
            return np.inf
        start = np.concatenate([local(Rp[valid], tp[valid], y[valid]).mean((0, 1)), np.zeros(3)])
        start[3:] = nan_median(local(Rc[valid], tc[valid], y[valid]), axis=(0, 1))
        _, residuals = _least_squares(Rp[valid], tp[valid], Rc[valid], tc[valid], np.nan_to_num(start), 1e-3)
        return float(np.sqrt(np.median((residuals**2).sum(1))))
    local_points = local(Rp, tp, y)
    guess = local_points[frame].copy()
    if not np.isfinite(guess).any():
        return np.inf
    a, _ = fit_joint_few(Rp, tp, y[frame] if np.isfinite(y[frame]).all() else guess, y, np.nanmean(guess, axis=0))
    length = np.linalg.norm(local_points - a, axis=-1)
    return float(np.sqrt(np.nanmedian((length - nan_median(length, axis=0)) ** 2))) if len(length) else np.inf


def _turns(Rp: NDArray, Rc: NDArray, good: NDArray) -> tuple[NDArray, NDArray, NDArray] | None:
    """Mean turn (3, 3) of a child in its parent's frame; turns about it (F, 3) [rad] in principal axes (3, 3)."""
    relative = np.einsum("fji,fjk->fik", Rp[good], Rc[good])
    relative = relative[np.isfinite(relative).all((1, 2))]
    if not len(relative):
        return None
    mean = nearest_rotation(relative.mean(0))
    turns = log_so3(np.einsum("ji,fjk->fik", mean, relative))
    _, axes = np.linalg.eigh(turns.T @ turns)
    return mean, turns @ axes, axes


def joint_ranges(Rp: NDArray, Rc: NDArray, good: NDArray) -> tuple[float, float, float]:
    """(3,) [rad] range of a joint about three orthogonal axes, largest first: the 5 % to 95 % quantile.

    Parameters
    ----------
    Rp, Rc : (F, 3, 3) of parent and child
    good : (F,) bool, frames to use
    """
    found = _turns(Rp, Rc, good)
    if found is None:
        return 0.0, 0.0, 0.0
    low, high = np.quantile(found[1], [0.05, 0.95], axis=0)
    first, second, third = np.sort(high - low)[::-1].tolist()
    return first, second, third


def reference_turn(
    Rp: NDArray, Rc: NDArray, good: NDArray, full: float
) -> tuple[NDArray | None, NDArray | None]:
    """Centre of a joint's turns (3, 3) and their covariance (3, 3) [rad²] in the child's axes; None if unobserved.

    The turns are taken as uniform over RANGE_FACTOR times the training range. To the variance is added MIN_TURN_SIGMA²,
    the square of the range `full` that training did not show, and that of half of the missing range of a second axis.

    Parameters
    ----------
    Rp, Rc : (F, 3, 3) of parent and child
    good : (F,) bool, frames to use
    full : [rad] range of such a joint about its first axis
    """
    found = _turns(Rp, Rc, good)
    if found is None:
        return None, None
    mean, turns, axes = found
    low, high = np.quantile(turns, [0.005, 0.995], axis=0)
    middle_turn = mean @ exp_so3(axes @ (0.5 * (low + high)))
    ranges = np.sort(high - low)[::-1]
    open_first = max(full - ranges[0], 0.0)
    open_second = 0.5 * max(SECOND_AXIS_RATIO * full - ranges[1], 0.0)
    square = (RANGE_FACTOR * (high - low)) ** 2 / 12 + MIN_TURN_SIGMA**2 + open_first**2 + open_second**2
    return middle_turn, (axes * square) @ axes.T


def exercised_share(joint: MarkerJoint, full: float) -> float:
    """Share (0 to 1) of a joint's range `full` [rad] that training showed; the second axis counts for half."""
    first, second, _ = joint.ranges
    return 0.5 * min(1.0, first / full) + 0.5 * min(1.0, second / (SECOND_AXIS_RATIO * full))
