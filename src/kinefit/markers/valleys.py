"""Flat valleys of a frame's cost: bars as wide as the cost is flat, and motion over time decides where in them it is.

Two joints with no marker between them (lumbar and thorax) may bend against each other while no marker tells. The
curvature at the minimum then says less than the cost does some degrees on: bars from it deny the rest of the valley,
and the next frame's minimum may be at its other end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, PointSet
from kinefit.findings import runs_of
from kinefit.losses import Loss
from kinefit.sensors.settings import TrackSettings
from kinefit.smoothing.unwrap import boxes
from kinefit.solvers.sequence import Certainty, fit_sequence, point_equations
from kinefit.solvers.trajectory.motion_prior import MotionPrior
from kinefit.solvers.trajectory.smoothing import smooth

SAMPLE_INTERVAL_S = 0.1  # between frames of which all coordinates are looked at
FINE_INTERVAL_S = 0.03  # likewise near one that is flat along a coordinate
MIN_STD = np.radians(1.5)  # [rad] a coordinate that is better determined is not looked at
FLAT_RISE = 2.0  # a cost that rises by less at two standard deviations, where a parabola rises by 4, is flat
FULL_RISE = 4.0  # of the cost at two standard deviations, 95 % of a Gaussian
MAX_STEPS = 5  # outwards along a valley, each twice as far at most
FREE_ACCELERATION = 1e5  # [m/s², rad/s²] of coordinates that motion does not hold


@dataclass(frozen=True, eq=False)
class PointTake:
    """Points (K) of a body measured at x (F, K, 3) [m], NaN for none, sigma (K,) [m]; loss; whether limits hold."""

    body: Body
    points: PointSet
    x: NDArray
    sigma: NDArray
    loss: Loss
    limits: bool


def widened(
    take: PointTake, roots: NDArray, angles: NDArray, sure: Certainty, rate: float
) -> tuple[Certainty, NDArray]:
    """Deviations that reach as far as a frame's cost is flat, and in which frames and coordinates it is, (F, D) bool.

    The profile of a coordinate: it is set off by two standard deviations to either side and all others are fitted
    anew. Where the cost rises by less than half of what its curvature says, the step is lengthened until it does rise;
    all coordinates and joint centres are as unsure as they move on the way.

    Parameters
    ----------
    roots, angles : (F, 4, 4) [m], (F, D) [rad or m], the fitted frames
    rate : [Hz]
    """
    tree, F = take.body.tree, len(angles)
    coarse, fine = (max(round(rate * interval), 1) for interval in (SAMPLE_INTERVAL_S, FINE_INTERVAL_S))
    profiles = _Profiles(take, roots, angles, np.array(sure.dof_std), np.array(sure.joint_std), boxes(tree, angles))
    std = sure.dof_std[:, 6:]
    asked = (std > MIN_STD) & (std < 0.95 * tree.spread) & ~tree.prismatic
    flat, frames, grid = np.zeros(angles.shape, bool), np.arange(0, F, coarse), np.arange(0, F, fine)
    for d in np.flatnonzero(asked[frames].any(axis=0)).tolist():
        own = frames[asked[frames, d]]
        own = own[profiles.flat(own, d)]
        close = np.abs(grid[:, None] - own).min(axis=1, initial=F) <= coarse
        own = grid[close & asked[grid, d]]
        if len(own):
            flat[own, d] = profiles.widen(own, d)
    dof_std, joint_std = (
        old * _between(new[grid] / np.maximum(old[grid], 1e-12), grid, F)
        for old, new in ((sure.dof_std, profiles.dof_std), (sure.joint_std, profiles.joint_std))
    )
    nearest = np.minimum(np.round(np.arange(F) / fine).astype(int), len(grid) - 1)
    return replace(sure, dof_std=dof_std, joint_std=joint_std), flat[grid[nearest]]


def _between(values: NDArray, grid: NDArray, count: int) -> NDArray:
    """Values (G, ...) of some frames (G,) at all `count` frames, linearly interpolated; 1 where they are not finite."""
    place = np.interp(np.arange(count), grid, np.arange(len(grid)))
    low = place.astype(int)
    share = (place - low).reshape(-1, *[1] * (values.ndim - 1))
    known = np.nan_to_num(values, nan=1.0, posinf=1.0)
    return np.asarray((1.0 - share) * known[low] + share * known[np.minimum(low + 1, len(grid) - 1)])


@dataclass(eq=False)
class _Profiles:
    """Costs of frames with one coordinate set off, all others fitted; deviations (F, n), (F, S, 3) that grow with it.

    bounds : lower and upper ends and prior mean (F, D) in the charts of the angles
    """

    take: PointTake
    roots: NDArray
    angles: NDArray
    dof_std: NDArray
    joint_std: NDArray
    bounds: tuple[NDArray, NDArray, NDArray]

    def __post_init__(self) -> None:
        self._curvature_std = self.dof_std.copy()
        tree = self.take.body.tree
        within = (self.angles >= tree.lower) & (self.angles <= tree.upper)
        self._inside = np.asarray(within.all(axis=1) & self.take.limits)
        everything = np.arange(len(self.angles))
        self._costs = self._fit(everything, self.angles, np.ones(tree.n_dofs, bool), 0)[2]
        self._centres = tree.segment_poses(self.roots, self.angles)[..., :3, 3]

    def _fit(
        self, frames: NDArray, angles: NDArray, locked: NDArray, iterations: int = 40
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Roots, angles and costs of frames fitted from such angles, coordinates `locked` (n,) as they are."""
        t = self.take
        roots, fitted, costs = self.roots[frames].copy(), np.array(angles), np.empty(len(frames))
        for limits in (True, False):
            own = self._inside[frames] == limits
            if own.any():
                fit = fit_sequence(
                    t.body, (roots[own], angles[own]), t.points, t.x[frames[own]], sigma=t.sigma, loss=t.loss,
                    limits=limits, locked=locked, posture=1.0, usual=self.bounds[2][frames[own]], tolerance=1e-3,
                    max_iterations=iterations,
                )  # fmt: skip
                roots[own], fitted[own], costs[own] = fit.Ts_world_root, fit.angles, fit.costs
        return roots, fitted, costs

    def _set_off(self, frames: NDArray, d: int, step: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Roots and angles with coordinate d moved by step (N,), and by how much the cost rises; inf beyond limits."""
        angles, locked = self.angles[frames].copy(), np.zeros(self.dof_std.shape[1], bool)
        angles[:, d] += step
        locked[6 + d] = True
        roots, fitted, costs = self._fit(frames, angles, locked)
        beyond = (angles[:, d] < self.bounds[0][frames, d]) | (angles[:, d] > self.bounds[1][frames, d])
        return roots, fitted, np.where(beyond & self.take.limits, np.inf, costs - self._costs[frames])

    def flat(self, frames: NDArray, d: int) -> NDArray:
        """Of some frames (N,) whether the cost is flat along coordinate d, (N,) bool."""
        step = 2.0 * self._curvature_std[frames, 6 + d]
        return np.min([self._set_off(frames, d, side * step)[2] for side in (-1.0, 1.0)], axis=0) < FLAT_RISE

    def widen(self, frames: NDArray, d: int) -> NDArray:
        """Widen the deviations of frames (N,) that are flat along coordinate d; which are, (N,) bool."""
        flat = np.zeros(len(frames), bool)
        for side in (-1.0, 1.0):
            step, going = 2.0 * self._curvature_std[frames, 6 + d], np.ones(len(frames), bool)
            for first in [True] + [False] * (MAX_STEPS - 1):
                some = frames[going]
                roots, angles, rise = self._set_off(some, d, side * step[going])
                if first:
                    flat |= rise < FLAT_RISE
                low = rise < FLAT_RISE if first else rise < 0.9 * FULL_RISE
                reached = np.isfinite(rise) & (flat[going] if first else True)
                self._reach(some[reached], roots[reached], angles[reached], rise[reached])
                longer = np.minimum(np.sqrt(FULL_RISE / np.maximum(rise[low], 1.0)), 2.0)
                going[np.flatnonzero(going)] = low
                step[going] *= longer
                if not going.any():
                    break
        return flat

    def _reach(self, frames: NDArray, roots: NDArray, angles: NDArray, rise: NDArray) -> None:
        """Widen deviations such that states of frames, at which the cost has risen by so much, are within them."""
        if len(frames):
            sigmas = np.sqrt(np.maximum(rise, 1.0))
            moved = np.abs(angles - self.angles[frames]) / sigmas[:, None]
            self.dof_std[frames, 6:] = np.maximum(self.dof_std[frames, 6:], moved)
            centres = self.take.body.tree.segment_poses(roots, angles)[..., :3, 3]
            moved = np.abs(centres - self._centres[frames]) / sigmas[:, None, None]
            self.joint_std[frames] = np.maximum(self.joint_std[frames], moved)


def settled_by_motion(
    take: PointTake, roots: NDArray, angles: NDArray, flat: NDArray, rate: float
) -> tuple[NDArray, NDArray]:
    """Stretches in which the cost is flat, all frames of one together: motion decides along the flat coordinates.

    Parameters
    ----------
    flat : (F, D) bool, frames and coordinates of `widened`
    """
    tree, settings, margin = take.body.tree, TrackSettings(), max(round(SAMPLE_INTERVAL_S * rate), 2)
    roots, angles = roots.copy(), angles.copy()
    for a, b in runs_of(np.asarray(flat.any(axis=1)), 2 * margin):
        span = slice(max(a - margin, 0), b + margin)
        acceleration = np.full(tree.n_dofs, FREE_ACCELERATION)
        acceleration[6:][flat[span].any(axis=0)] = settings.angle_acceleration
        lower, upper, usual = boxes(tree, angles[span])
        prior = MotionPrior(
            acceleration, (settings.acceleration_memory, settings.smooth_memory), 1.0 / rate, usual, tree.spread,
            couplings=tree.couplings,
        )  # fmt: skip
        equations = point_equations(take.body, take.points, take.x[span], sigma=take.sigma, loss=take.loss)
        found = smooth(
            take.body, roots[span], angles[span], equations, prior, bounds=(lower, upper) if take.limits else None,
            tolerance=1e-3,
        )  # fmt: skip
        roots[span], angles[span] = found.roots, found.angles
    return roots, angles
