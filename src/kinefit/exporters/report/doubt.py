"""Which segments of which frames are probably wrong: an end of them more than 8 cm from where it is, by its sigma.

A segment ends at its joint centre and at those of its children, or where its surface ends: a fingertip, the crown of
the head. What nothing observes, and has an infinite error bar, counts as uncertain as the posture prior is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kinefit.motion import Motion

DOUBT_DISTANCE_M = 0.08  # [m] from the truth: about as thick as a limb, which then lies beside itself
_DOUBTFUL = 0.11  # [m] root of the summed variances, above which `DOUBT_DISTANCE_M` is likely exceeded: 9 cm of an
# error that is alike in all directions, 12 of one along a line; on simulated takes of all sensors 10 were 45 to 61 %
_FLAT_ROOT_SIGMA = 1.0  # [m, rad] of a root that nothing holds
_MAX_STD = 1e3  # [rad, m] of a coordinate without a prior
_WINDOW = 0.05  # [s] to either side, in which most views must contradict: an outlier is alone


def doubtful(sigmas: NDArray, against: NDArray) -> NDArray:
    """(F, S) bool: segments of which an end is rather more than 8 cm off than not, or is so in most views.

    By `end_sigmas` and `contradicted`.
    """
    return np.asarray((sigmas > _DOUBTFUL) | against)


def uncertain_throughout(motion: Motion) -> dict[str, float]:
    """Segments with an end that is uncertain by more than 8 cm in most frames, and its median sigma [m]."""
    if not motion.residuals or not len(motion):
        return {}
    middle = np.median(end_sigmas(motion), axis=0)
    return {name: float(m) for name, m in zip(motion.body.tree.segments, middle) if m > DOUBT_DISTANCE_M}


def end_sigmas(motion: Motion) -> NDArray:
    """(F, S) [m] standard deviation, in all directions together, of the less certain end of each segment."""
    tree, surfaces = motion.body.tree, motion.body.segment_ends()
    prior = np.concatenate([np.full(6, _FLAT_ROOT_SIGMA), np.minimum(tree.posture_std, _MAX_STD)])
    std = np.where(np.isfinite(motion.dof_std), motion.dof_std, prior)
    known = np.linalg.norm(motion.joint_std, axis=-1)
    unbounded = ~np.isfinite(known)
    sigma = np.where(unbounded, 0.0, known)
    for s, parent in enumerate(tree.parents):  # of an unbounded one what is known of the joint before it
        if parent >= 0:
            sigma[:, s] = np.where(unbounded[:, s], sigma[:, parent], sigma[:, s])
    for f in np.flatnonzero(unbounded.any(axis=1)):
        alone = np.where(np.isfinite(motion.dof_std[f]), 0.0, prior)
        unknown = np.sqrt(_square_moves(motion, int(f)) @ np.square(alone))
        sigma[f] = np.where(unbounded[f], np.hypot(sigma[f], unknown), sigma[f])
    out = sigma.copy()
    for s in range(len(tree.segments)):
        children = np.flatnonzero(tree.parents == s)
        if len(children):
            out[:, s] = np.maximum(sigma[:, s], sigma[:, children].max(axis=1))
        elif s in surfaces:
            own = np.flatnonzero(tree.owners == s)
            levers = np.linalg.norm(np.cross(tree.axes[own], surfaces[s]), axis=-1)
            out[:, s] = np.sqrt(np.square(sigma[:, s]) + np.square(std[:, 6 + own]) @ np.square(levers))
    return out


def contradicted(motion: Motion) -> NDArray:
    """(F, S) bool: segments whose points most views, for a tenth of a second, show more than 8 cm beside the fit."""
    shape = motion.segment_quality.shape
    seen, off = np.zeros(shape), np.zeros(shape)
    for r in motion.residuals.values():
        if r.unit != "px" or not r.of_points:
            continue
        owners, there = np.asarray(r.segments), np.isfinite(r.norms)
        fitted = np.where(there[..., None], r.measured - r.values, np.nan)
        joints = np.where(there[..., None], motion.joint_centres[:, owners], np.nan)
        far = r.norms > DOUBT_DISTANCE_M * _pixels_per_metre(fitted, joints)[:, None]
        for s in np.unique(owners):
            count = there[:, owners == s].sum(axis=1)
            seen[:, s] += count > 0
            off[:, s] += 2 * (far & there)[:, owners == s].sum(axis=1) > np.maximum(count, 1)
    half = max(round(_WINDOW * motion.rate), 1)
    summed = [
        np.lib.stride_tricks.sliding_window_view(np.pad(x, ((half, half), (0, 0))), 2 * half + 1, axis=0).sum(axis=-1)
        for x in (off, seen)
    ]
    return np.asarray((2 * summed[0] > summed[1]) & (seen > 0))


def _pixels_per_metre(fitted: NDArray, joints: NDArray) -> NDArray:
    """(F,) about how large a metre at the body is in an image, from fitted points (F, K, 2) and their joints."""
    extents = []
    for x in (fitted, joints):
        count = np.isfinite(x[..., 0]).sum(axis=1)
        middle = np.nansum(x, axis=1) / np.maximum(count, 1)[:, None]
        extents.append(np.sqrt(np.nansum(np.square(x - middle[:, None]), axis=(1, 2))))
    return np.asarray(np.where(extents[1] > 0.0, extents[0] / np.maximum(extents[1], 1e-9), np.inf))


def _square_moves(motion: Motion, frame: int) -> NDArray:
    """(S, 6 + D) [m²] squared ways of the joint centres, by a unit of every degree of freedom."""
    tree, state = motion.body.tree, motion.state(frame)
    _, screws = tree.forward(state.T_world_root, state.angles)
    x = tree.segment_poses(state.T_world_root[None], state.angles[None])[0, :, :3, 3] - state.T_world_root[:3, 3]
    lines = np.concatenate([np.eye(6), screws])  # (v, ω)
    out = np.square(lines[:, :3] + np.cross(lines[:, 3:], x[:, None])).sum(axis=-1)
    moved = np.zeros(out.shape, bool)
    for s, last in enumerate(tree.last_dof):
        moved[s, tree.chain[last, : tree.depth[last] + 1]] = True
    return np.where(moved, out, 0.0)
