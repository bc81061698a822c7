"""Widen standard deviations in flat valleys of the cost (profile likelihood), and resolve the valleys by motion.

Two joints without a marker between them (lumbar and thorax) may bend against each other unobserved. The curvature at
the minimum then underestimates the standard deviation, and the next frame's minimum may be at the valley's other end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.findings import runs_of
from kinefit.frame.results import UNOBSERVED_STD_RATIO
from kinefit.losses import Loss
from kinefit.sensors.settings import TrackSettings
from kinefit.smoothing.unwrap import boxes
from kinefit.solvers.sequence import Certainty, certainty, fit_sequence
from kinefit.solvers.trajectory.motion_prior import MotionPrior
from kinefit.solvers.trajectory.seen_points import SeenPoints
from kinefit.solvers.trajectory.smoothing import MakeEquations, smooth

SAMPLE_INTERVAL_S = 0.1  # between frames whose coordinates are all profiled
FINE_INTERVAL_S = 0.03  # the same near a frame that is flat along a coordinate
MIN_SIGMA = np.radians(1.5)  # [rad] coordinates with a smaller sigma are not profiled
MAX_FLAT_RISE = 2.0  # of a flat cost at two standard deviations, where a parabola rises by 4
TARGET_RISE = 4.0  # of the cost at two standard deviations, 95 % of a Gaussian
MIN_FALL = 1.0  # of the cost to another, better minimum
MAX_STEPS = 5  # along a valley, each at most twice as long as the last
MAX_COST_INCREASE = 9.0  # of any frame's cost due to the motion prior; else the next factor is tried:
ACCELERATION_FACTORS = 1.0, 3.0, 10.0  # on the prior's acceleration
FREE_ACCELERATION = 1e5  # [m/s², rad/s²] of coordinates without motion prior


@dataclass(frozen=True, eq=False)
class PointTake:
    """K points of a body measured at x (F, K, 3) [m], NaN missing, with sigma (K,) [m]; loss; whether limits hold."""

    body: Body
    points: PointSet
    x: NDArray
    sigma: NDArray
    loss: Loss
    limits: bool

    def equations(self, frames: slice) -> MakeEquations:
        """Normal equations of some frames."""
        x = self.x[frames]
        weight = np.where(np.isfinite(x).all(axis=2), 1.0 / np.square(self.sigma), 0.0)
        return SeenPoints.in_metres(self.points, np.nan_to_num(x), weight, self.loss).equations(self.body)


def profile_frames(
    take: PointTake, roots: NDArray, angles: NDArray, rate: float
) -> tuple[NDArray, NDArray, Certainty, Certainty, NDArray]:
    """Move frames to the best minima that profiles find, and widen standard deviations along flat valleys.

    To profile a coordinate, it is displaced by two standard deviations to either side and all others are fitted again.
    If the cost falls, the frame was in a worse minimum. If it rises by less than half of what its curvature predicts,
    the step is lengthened until it rises. All standard deviations then cover the motion along the valley.

    Parameters
    ----------
    roots, angles : (F, 4, 4), (F, D) [rad or m], fitted frames within the limits
    rate : [Hz]

    Returns
    -------
    roots, angles, certainty by the curvature, certainty by the profiles, (F, D) bool: flat coordinates
    """
    tree, F = take.body.tree, len(angles)
    coarse, fine = (max(round(rate * interval), 1) for interval in (SAMPLE_INTERVAL_S, FINE_INTERVAL_S))
    profiles = _Profiles(take, roots.copy(), angles.copy())
    weak, grid = profiles.weakly_observed(), np.arange(0, F, fine)
    jumps = np.abs(np.diff(angles, 2, axis=0)) > profiles.local_certainty.dof_std[1:-1, 6:]
    frames = np.arange(0, F, coarse)
    near = {d: frames[weak[frames, d]] for d in np.flatnonzero(weak[frames].any(axis=0)).tolist()}
    near = {d: np.union1d(own[profiles.is_flat(own, d)], 1 + np.flatnonzero(jumps[:, d])) for d, own in near.items()}
    profiles.propagate()
    weak, flat = profiles.weakly_observed(), np.zeros(angles.shape, bool)
    for d, own in near.items():
        close = np.abs(grid[:, None] - own).min(axis=1, initial=F) <= coarse
        flat[grid, d] = profiles.widen(grid, d, close & weak[grid, d])
    local_certainty = profiles.local_certainty
    dof_std, joint_std = (
        old * _growth(old[grid], new[grid], grid, F)
        for old, new in ((local_certainty.dof_std, profiles.dof_std), (local_certainty.joint_std, profiles.joint_std))
    )
    nearest = np.minimum(np.round(np.arange(F) / fine).astype(int), len(grid) - 1)
    most = np.maximum(local_certainty.dof_std[:, 6:], UNOBSERVED_STD_RATIO * tree.spread)
    dof_std[:, 6:] = np.minimum(dof_std[:, 6:], most)
    widened = replace(local_certainty, dof_std=dof_std, joint_std=joint_std)
    return profiles.roots, profiles.angles, local_certainty, widened, flat[grid[nearest]]


def _growth(old: NDArray, new: NDArray, grid: NDArray, count: int) -> NDArray:
    """Ratio of standard deviations (G, ...) in the frames `grid` (G,), interpolated linearly to `count` frames."""
    factor = np.ones(old.shape)
    np.divide(new, old, out=factor, where=np.isfinite(old) & (old > 0.0))
    place = np.interp(np.arange(count), grid, np.arange(len(grid)))
    low = place.astype(int)
    share = (place - low).reshape(-1, *[1] * (old.ndim - 1))
    return np.asarray((1.0 - share) * factor[low] + share * factor[np.minimum(low + 1, len(grid) - 1)])


class _Profiles:
    """Profiles of the frames' costs along single coordinates, and the standard deviations that follow."""

    def __init__(self, take: PointTake, roots: NDArray, angles: NDArray) -> None:
        self.take, self.roots, self.angles = take, roots, angles
        self._free = np.zeros(take.body.tree.n_dofs, bool)
        self._better: set[int] = set()
        self._update_certainty()
        self._costs = self._fit(np.arange(len(angles)), roots, angles, ~self._free, 0)[2]

    def _update_certainty(self) -> None:
        t = self.take
        self.local_certainty = certainty(
            t.body, self.roots, self.angles, t.points, t.x, sigma=t.sigma, loss=t.loss, posture=1.0
        )
        self.dof_std, self.joint_std = np.array(self.local_certainty.dof_std), np.array(self.local_certainty.joint_std)
        self._centres = t.body.tree.segment_poses(self.roots, self.angles)[..., :3, 3]

    def weakly_observed(self) -> NDArray:
        """(F, D) bool: angles that a frame observes weakly."""
        tree, std = self.take.body.tree, self.local_certainty.dof_std[:, 6:]
        return np.asarray((std > MIN_SIGMA) & (std < UNOBSERVED_STD_RATIO * tree.spread) & ~tree.prismatic)

    def _fit(
        self, frames: NDArray, roots: NDArray, angles: NDArray, locked: NDArray, iterations: int = 40
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Fit frames (N,) from given poses with coordinates `locked` (n,); returns roots, angles and costs."""
        t = self.take
        fit = fit_sequence(
            t.body, (roots, angles), t.points, t.x[frames], sigma=t.sigma, loss=t.loss, limits=t.limits, locked=locked,
            posture=1.0, tolerance=1e-3, max_iterations=iterations,
        )  # fmt: skip
        return fit.Ts_world_root, fit.angles, fit.costs

    def _displace(self, frames: NDArray, d: int, step: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Displace coordinate d by step (N,) and fit the others; roots, angles, rise of cost (inf beyond limits)."""
        tree, angles, locked = self.take.body.tree, self.angles[frames].copy(), self._free.copy()
        angles[:, d] += step
        locked[6 + d] = True
        roots, fitted, costs = self._fit(frames, self.roots[frames], angles, locked)
        outside = (angles[:, d] < tree.lower[d]) | (angles[:, d] > tree.upper[d])
        return roots, fitted, np.where(outside & self.take.limits, np.inf, costs - self._costs[frames])

    def is_flat(self, frames: NDArray, d: int) -> NDArray:
        """(N,) bool: whether the costs of frames (N,) are flat along coordinate d; accepts better minima."""
        flat = np.zeros(len(frames), bool)
        for side in (-1.0, 1.0):
            roots, angles, rise = self._displace(frames, d, side * 2.0 * self.local_certainty.dof_std[frames, 6 + d])
            flat |= rise < MAX_FLAT_RISE
            better = rise < -MIN_FALL
            self._accept_better(frames[better], roots[better], angles[better])
        return flat

    def _accept_better(self, frames: NDArray, roots: NDArray, angles: NDArray) -> NDArray:
        """Fit frames (N,) from given poses and accept clearly lower costs; (N,) bool: accepted."""
        if not len(frames):
            return np.zeros(0, bool)
        roots, angles, costs = self._fit(frames, roots, angles, self._free)
        better = costs < self._costs[frames] - MIN_FALL
        own = frames[better]
        self.roots[own], self.angles[own], self._costs[own] = roots[better], angles[better], costs[better]
        self._better |= set(own.tolist())
        return np.asarray(better)

    def propagate(self) -> None:
        """Try the better minima of frames in their neighbours, forwards and backwards."""
        for direction in (1, -1):
            for f in sorted(self._better, reverse=direction < 0):
                g = f + direction
                while 0 <= g < len(self.angles) and self._accept_better(np.array([g]), *self._state(g - direction))[0]:
                    g += direction
        self._update_certainty()

    def _state(self, f: int) -> tuple[NDArray, NDArray]:
        return self.roots[f : f + 1], self.angles[f : f + 1]

    def widen(self, grid: NDArray, d: int, selected: NDArray) -> NDArray:
        """Widen the standard deviations of frames grid[selected] along coordinate d if flat; (G,) bool: flat."""
        flat = np.zeros(len(grid), bool)
        for side in (-1.0, 1.0):
            active, step = np.flatnonzero(selected), 2.0 * self.local_certainty.dof_std[grid, 6 + d]
            for step_count in range(MAX_STEPS):
                if not len(active):
                    break
                roots, angles, rise = self._displace(grid[active], d, side * step[active])
                if step_count == 0:
                    flat[active] |= rise < MAX_FLAT_RISE
                reached = np.isfinite(rise) & flat[active]
                self._widen_to(grid[active[reached]], roots[reached], angles[reached], rise[reached])
                low = rise < (0.9 * TARGET_RISE if step_count else MAX_FLAT_RISE)
                step[active] *= np.minimum(np.sqrt(TARGET_RISE / np.maximum(rise, 1.0)), 2.0)
                active = active[low]
        return flat

    def _widen_to(self, frames: NDArray, roots: NDArray, angles: NDArray, rise: NDArray) -> None:
        """Widen standard deviations so that they cover states of frames (N,) whose cost has risen by `rise` (N,)."""
        if len(frames):
            sigmas = np.sqrt(np.maximum(rise, 1.0))
            moved = np.abs(angles - self.angles[frames]) / sigmas[:, None]
            self.dof_std[frames, 6:] = np.maximum(self.dof_std[frames, 6:], moved)
            centres = self.take.body.tree.segment_poses(roots, angles)[..., :3, 3]
            moved = np.abs(centres - self._centres[frames]) / sigmas[:, None, None]
            self.joint_std[frames] = np.maximum(self.joint_std[frames], moved)


def resolve_by_motion(
    take: PointTake, roots: NDArray, angles: NDArray, flat: NDArray, rate: float
) -> tuple[NDArray, NDArray]:
    """Smooth stretches of frames with flat costs: the motion prior decides along the flat coordinates.

    Parameters
    ----------
    roots, angles : (F, 4, 4), (F, D) [rad or m]
    rate : [Hz]
    flat : (F, D) bool, from `profile_frames`
    """
    tree, settings, margin = take.body.tree, TrackSettings(), max(round(SAMPLE_INTERVAL_S * rate), 2)
    roots, angles, memory = roots.copy(), angles.copy(), (settings.acceleration_memory, settings.smooth_memory)
    for a, b in runs_of(np.asarray(flat.any(axis=1)), 2 * margin):
        span = slice(max(a - margin, 0), b + margin)
        lower, upper, usual = boxes(tree, angles[span])
        bounds = (lower, upper) if take.limits else None
        equations = take.equations(span)
        acceleration = np.where(flat[span].any(axis=0), settings.angle_acceleration, FREE_ACCELERATION)
        for livelier in ACCELERATION_FACTORS:
            prior = MotionPrior(
                np.concatenate([np.full(6, FREE_ACCELERATION), livelier * acceleration]), memory, 1.0 / rate, usual,
                tree.spread, couplings=tree.couplings,
            )  # fmt: skip
            found = smooth(
                take.body, roots[span], angles[span], equations, prior, bounds=bounds, tolerance=1e-3
            )
            costs = [
                equations(*poses)[2] + np.einsum("fi,ij,fj->f", away, prior.precision, away)
                for poses in ((roots[span], angles[span]), (found.roots, found.angles))
                for away in (poses[1] - usual,)
            ]
            if (costs[1] - costs[0]).max() < MAX_COST_INCREASE:
                roots[span], angles[span] = found.roots, found.angles
                break
    return roots, angles
