"""Elastic bands and the motion of every limb: the last steps of VooDoo (P2 4.2.6 and 4.2.7)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body
from kinefit.geometry import se3
from kinefit.papers import _voodoo_steps as steps
from kinefit.solving.correspondences.closures import Bands
from kinefit.solving.functional_joints import absolute_orientation, move

_RANGE_LEVER = 0.1  # [m] from a joint to the points that show a limb's orientation
_ANGLE_STEPS = 6  # of Newton's method from the default angles
_MIN_EXCESS = 1e-3  # [rad] beyond a range that is corrected


def band_ends(body: Body, frames: NDArray, bands: Bands) -> tuple[NDArray, NDArray]:
    """Ends (B, 3) [m] of every band on the parent, and on the child."""
    return steps.places(body, frames, bands.parent), steps.places(body, frames, bands.child)


def band_weights(bands: Bands, measured: steps.Pairs, weight: float, least: int | None) -> tuple[NDArray, NDArray]:
    """Step 6: weights (B,) of the bands at the parent and at the child, numbers without unit.

    Without `least` every band has `weight`. Else all bands of a limb together have `weight` times the sum of its
    measurements' weights, of which at least `least` is used.
    """
    if least is None:
        every = np.full(len(bands), weight)
        return every, every
    limbs = int(max(bands.parent.segments.max(), bands.child.segments.max(), measured.limb.max(initial=0))) + 1
    total = np.maximum(np.bincount(measured.limb, measured.weight, limbs), least)
    count = np.bincount(bands.parent.segments, minlength=limbs) + np.bincount(bands.child.segments, minlength=limbs)
    each = weight * total / np.maximum(count, 1)
    return each[bands.parent.segments], each[bands.child.segments]


def band_pairs(
    bands: Bands, ends: tuple[NDArray, NDArray], own: NDArray, other: NDArray
) -> tuple[steps.Pairs, steps.Pairs]:
    """Step 6: pairs of both ends (B, 3) of every band with its middle, which is their target; weights (B,)."""
    middle = 0.5 * (ends[0] + ends[1])
    return (
        steps.Pairs(ends[0], middle, own, bands.parent.segments),
        steps.Pairs(ends[1], middle, other, bands.child.segments),
    )


def range_pairs(body: Body, frames: NDArray, weight: float) -> steps.Pairs:
    """Artificial correspondences of limbs beyond their joint's range (P2 6).

    Each axis of a limb about its joint is paired with where the nearest valid angles have it, seen from the parent.
    """
    tree, R = body.tree, frames[:, :9].reshape(-1, 3, 3)
    out = [steps.Pairs(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty(0, np.int64))]
    for s in range(1, len(frames)):
        own = slice(int(tree.dof_start[s]), int(tree.dof_start[s + 1]))
        if tree.prismatic[own].any():
            continue
        above = R[tree.parents[s]]
        angles = rotation_angles(tree.axes[own], above.T @ R[s], tree.usual[own])
        valid = np.clip(angles, tree.lower[own], tree.upper[own])
        if np.abs(valid - angles).max(initial=0.0) > _MIN_EXCESS:
            joint = R[s] @ tree.rest[s] + frames[s, 9:]
            ends, targets = _RANGE_LEVER * R[s].T, _RANGE_LEVER * (above @ _turned(tree.axes[own], valid)[-1]).T
            out.append(steps.Pairs(joint + ends, joint + targets, np.full(3, weight), np.full(3, s)))
    return steps.joined(*out)


def rotation_angles(axes: NDArray, R: NDArray, start: NDArray) -> NDArray:
    """Angles (k,) [rad] about axes (k, 3), one after the other, that come nearest to a rotation R (3, 3)."""
    angles = np.array(start, float)
    for _ in range(_ANGLE_STEPS if len(axes) else 0):
        before = _turned(axes, angles)
        moves = np.stack([before[k] @ axis for k, axis in enumerate(axes)], axis=1)
        angles += np.linalg.lstsq(moves, se3.log_so3(R @ before[-1].T), rcond=None)[0]
    return angles


def _turned(axes: NDArray, angles: NDArray) -> list[NDArray]:
    """Rotations (3, 3) before each of k axes, and after the last."""
    out = [np.eye(3)]
    for axis, angle in zip(axes, angles):
        out.append(out[-1] @ se3.exp_so3(axis * angle))
    return out


def moved(
    body: Body, frames: NDArray, measured: steps.Pairs, bands: Bands, ends: tuple[NDArray, NDArray], own: NDArray,
    other: NDArray, stay: float,
) -> NDArray:  # fmt: skip
    """Step 7: frames (S, 12) after each limb's own motion, all estimated independently in the world.

    own, other (B,): weights of the bands; stay [m²]: see `absolute_orientation`.
    """
    pairs = steps.joined(measured, *band_pairs(bands, ends, own, other))
    return move(frames, *absolute_orientation(*pairs, count=len(frames), stay=stay))


def moved_down(
    body: Body, frames: NDArray, measured: steps.Pairs, bands: Bands, ends: tuple[NDArray, NDArray], own: NDArray,
    other: NDArray, stay: float,
) -> NDArray:  # fmt: skip
    """Step 7: frames (S, 12) after each limb's own motion on top of its parent's, from the root on (P2 3.3).

    The descendants of a limb move with it before their own motion is estimated, and are pulled to its moved joint.
    """
    parents, count = body.tree.parents, len(frames)
    level = np.zeros(count, np.int64)
    for s in range(1, count):
        level[s] = level[parents[s]] + 1
    pull, hold = band_pairs(bands, ends, own, other)
    joint = ends[0]
    for k in range(level.max() + 1):
        pairs = steps.joined(measured, pull, hold._replace(target=joint))
        of = level[pairs.limb] == k
        own_pairs = steps.Pairs(*(column[of] for column in pairs))
        R, t = absolute_orientation(*own_pairs, count=count, stay=stay)
        for s in range(1, count):
            if level[s] > k:
                R[s], t[s] = R[parents[s]], t[parents[s]]
        frames = move(frames, R, t)
        measured, pull, hold = (p._replace(source=_along(p.source, R, t, p.limb)) for p in (measured, pull, hold))
        pull = pull._replace(target=_along(pull.target, R, t, pull.limb))  # both ends move
        joint = _along(joint, R, t, bands.parent.segments)
    return frames


def _along(x: NDArray, R: NDArray, t: NDArray, limb: NDArray) -> NDArray:
    return np.einsum("nij,nj->ni", R[limb], x) + t[limb]
