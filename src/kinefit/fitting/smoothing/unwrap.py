"""Remove jumps from angles: one chart of each ball joint for the whole take, and angles beyond a whole turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies.tree import SIGNS, KinematicTree, twin

_TURN = 2.0 * np.pi
_MAX_STEP = 1.5  # [rad] sum over the three angles: a smaller step stays in its form, since the next is 2 π away


def unwrap(tree: KinematicTree, angles: NDArray) -> NDArray:
    """Angles (T, D) of the same poses, continuous wherever the pose is.

    A ball joint keeps the chart in which most of the take is within its limits. Its angles may exceed the limits where
    only the other chart contains the rotation (an arm that swings overhead), so that they do not jump.
    """
    out = np.array(angles, float)
    turning = ~tree.prismatic
    ball = np.zeros(out.shape[1], bool)
    for d in tree.ball_joints:
        ball[d] = True
        out[:, d] = _ball(out[:, d], tree.lower[d], tree.upper[d])
    free = turning & ~ball & (tree.upper - tree.lower > _TURN)  # others cannot make a turn within their limits
    out[:, free] = np.unwrap(out[:, free], axis=0)
    return out


def continued(tree: KinematicTree, before: NDArray, angles: NDArray) -> NDArray:
    """Angles (D,) of the same pose, in the form nearest to those of the frame before (D,)."""
    out = np.array(angles, float)
    ball = np.zeros(len(out), bool)
    for d in tree.ball_joints:
        ball[d] = True
        forms = np.stack([out[d], twin(out[d])])
        forms += _TURN * np.round((before[d] - forms) / _TURN)
        far = np.abs(forms - before[d]).sum(axis=1)
        out[d] = forms[int(far[1] < far[0])]
    free = ~tree.prismatic & ~ball & (tree.upper - tree.lower > _TURN)
    out[free] += _TURN * np.round((before[free] - out[free]) / _TURN)
    return out


def boxes(tree: KinematicTree, angles: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Lower limits, upper limits and prior mean (T, D) in the charts of angles (T, D).

    A ball joint's limits are given in one chart. They are converted where its angles are in the other chart, or some
    turns away.
    """
    shape = np.shape(angles)
    lower, upper, mean = (np.array(np.broadcast_to(v, shape)) for v in (tree.lower, tree.upper, tree.usual))
    for d in tree.ball_joints:
        q = np.asarray(angles)[:, d]
        own = _nearest_turn(q, tree.lower[d], tree.upper[d])
        other = _nearest_turn(twin(q), tree.lower[d], tree.upper[d])
        swap = _outside(other, tree.lower[d], tree.upper[d]) < _outside(own, tree.lower[d], tree.upper[d])
        sign = np.where(swap[:, None], SIGNS, 1.0)
        shift = q - sign * np.where(swap[:, None], other, own)  # q = sign · (its value within limits) + shift
        ends = sign * tree.lower[d] + shift, sign * tree.upper[d] + shift
        lower[:, d], upper[:, d] = np.minimum(*ends), np.maximum(*ends)
        mean[:, d] = sign * tree.usual[d] + shift
    return lower, upper, mean


def _ball(q: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """Angles (T, 3) of a ball joint, each in the form nearest to the one before, in the chart nearest to the limits."""
    out = np.array(q)
    jumps = np.flatnonzero(np.abs(np.diff(q, axis=0)).sum(axis=1) > _MAX_STEP) + 1
    for t, end in zip(jumps, np.append(jumps[1:], len(q)), strict=False):
        forms = np.stack([q[t], twin(q[t])])
        forms += _TURN * np.round((out[t - 1] - forms) / _TURN)
        nearer = int(np.argmin(np.abs(forms - out[t - 1]).sum(axis=1)))
        out[t:end] = forms[nearer] + (SIGNS if nearer else 1.0) * (q[t:end] - q[t])
    candidates = []
    for form in (out, np.pi + SIGNS * out):
        finite = np.isfinite(low) & np.isfinite(high)
        middle = np.where(finite, 0.5 * (np.where(finite, low, 0.0) + np.where(finite, high, 0.0)), 0.0)
        candidates.append(form - _TURN * np.round((np.median(form, axis=0) - middle) / _TURN))
    return candidates[int(np.argmin([_outside(form, low, high).sum() for form in candidates]))]


def _nearest_turn(q: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """Angles moved by whole turns into their limits, or as near to them as possible."""
    below, above = np.ceil((low - q) / _TURN), np.floor((high - q) / _TURN)
    turns = np.clip(np.zeros_like(q), np.minimum(below, above), np.maximum(below, above))
    outside = below > above  # between the limits of two turns: take the nearer one
    nearer = np.where(low - (q + _TURN * above) <= (q + _TURN * below) - high, above, below)
    return q + _TURN * np.where(outside, nearer, turns)


def _outside(q: NDArray, low: NDArray, high: NDArray) -> NDArray:
    """(T,) sum of how far angles (T, 3) exceed their limits."""
    return np.asarray((np.maximum(low - q, 0.0) + np.maximum(q - high, 0.0)).sum(axis=1))
