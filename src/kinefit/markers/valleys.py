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
from kinefit.frame.results import UNOBSERVED_STD_RATIO
from kinefit.losses import Loss
from kinefit.sensors.settings import TrackSettings
from kinefit.smoothing.unwrap import boxes
from kinefit.solvers.sequence import Certainty, certainty, fit_sequence, point_equations
from kinefit.solvers.trajectory.motion_prior import MotionPrior
from kinefit.solvers.trajectory.smoothing import smooth

SAMPLE_INTERVAL_S = 0.1  # between frames of which all coordinates are looked at
FINE_INTERVAL_S = 0.03  # likewise near one that is flat along a coordinate
MIN_STD = np.radians(1.5)  # [rad] a coordinate that is better determined is not looked at
FLAT_RISE = 2.0  # a cost that rises by less at two standard deviations, where a parabola rises by 4, is flat
FULL_RISE = 4.0  # of the cost at two standard deviations, 95 % of a Gaussian
MIN_FALL = 1.0  # of the cost by which another minimum is better
MAX_STEPS = 5  # outwards along a valley, each twice as far at most
MAX_RISE = 9.0  # of the cost of any frame that motion may ask for; else the motion is livelier than was thought:
LIVELINESS = 1.0, 3.0, 10.0  # factors on its acceleration
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


def profiled(
    take: PointTake, roots: NDArray, angles: NDArray, rate: float
) -> tuple[NDArray, NDArray, Certainty, Certainty, NDArray]:
    """Frames at the best minima that profiles find, and deviations that reach as far as a frame's cost is flat.

    The profile of a coordinate: it is set off by two standard deviations to either side and all others are fitted
    anew. Where the cost falls, the frame was in another minimum than the best. Where it rises by less than half of
    what its curvature says, the step is lengthened until it does rise; all coordinates and joint centres are as unsure
    as they move on the way.

    Parameters
    ----------
    roots, angles : (F, 4, 4) [m], (F, D) [rad or m], the fitted frames, within their limits
    rate : [Hz]

    Returns
    -------
    roots, angles, deviations by the curvature, deviations by the profiles, (F, D) bool: where a coordinate is flat
    """
    tree, F = take.body.tree, len(angles)
    coarse, fine = (max(round(rate * interval), 1) for interval in (SAMPLE_INTERVAL_S, FINE_INTERVAL_S))
    profiles = _Profiles(take, roots.copy(), angles.copy())
    asked, grid = profiles.asked(), np.arange(0, F, fine)
    leaps = np.abs(np.diff(angles, 2, axis=0)) > profiles.sure.dof_std[1:-1, 6:]
    frames = np.arange(0, F, coarse)
    near = {d: frames[asked[frames, d]] for d in np.flatnonzero(asked[frames].any(axis=0)).tolist()}
    near = {d: np.union1d(own[profiles.is_flat(own, d)], 1 + np.flatnonzero(leaps[:, d])) for d, own in near.items()}
    profiles.spread()
    asked, flat = profiles.asked(), np.zeros(angles.shape, bool)
    for d, own in near.items():
        close = np.abs(grid[:, None] - own).min(axis=1, initial=F) <= coarse
        flat[grid, d] = profiles.widen(grid, d, close & asked[grid, d])
    sure = profiles.sure
    dof_std, joint_std = (
        old * _growth(old[grid], new[grid], grid, F)
        for old, new in ((sure.dof_std, profiles.dof_std), (sure.joint_std, profiles.joint_std))
    )
    nearest = np.minimum(np.round(np.arange(F) / fine).astype(int), len(grid) - 1)
    dof_std[:, 6:] = np.minimum(dof_std[:, 6:], np.maximum(sure.dof_std[:, 6:], UNOBSERVED_STD_RATIO * tree.spread))
    wide = replace(sure, dof_std=dof_std, joint_std=joint_std)
    return profiles.roots, profiles.angles, sure, wide, flat[grid[nearest]]


def _growth(old: NDArray, new: NDArray, grid: NDArray, count: int) -> NDArray:
    """Factor between deviations (G, ...) of some frames (G,), linearly interpolated at all `count` frames."""
    factor = np.ones(old.shape)
    np.divide(new, old, out=factor, where=np.isfinite(old) & (old > 0.0))
    place = np.interp(np.arange(count), grid, np.arange(len(grid)))
    low = place.astype(int)
    share = (place - low).reshape(-1, *[1] * (old.ndim - 1))
    return np.asarray((1.0 - share) * factor[low] + share * factor[np.minimum(low + 1, len(grid) - 1)])


class _Profiles:
    """Costs of frames with one coordinate set off, all others fitted anew; deviations that grow with them."""

    def __init__(self, take: PointTake, roots: NDArray, angles: NDArray) -> None:
        self.take, self.roots, self.angles = take, roots, angles
        self._free = np.zeros(take.body.tree.n_dofs, bool)
        self._better: set[int] = set()
        self._judge()
        self._costs = self._fit(np.arange(len(angles)), roots, angles, ~self._free, 0)[2]

    def _judge(self) -> None:
        t = self.take
        self.sure = certainty(
            t.body, self.roots, self.angles, t.points, t.x, sigma=t.sigma, loss=t.loss, posture=1.0
        )
        self.dof_std, self.joint_std = np.array(self.sure.dof_std), np.array(self.sure.joint_std)
        self._centres = t.body.tree.segment_poses(self.roots, self.angles)[..., :3, 3]

    def asked(self) -> NDArray:
        """(F, D) bool: angles that a frame observes, but not well."""
        tree, std = self.take.body.tree, self.sure.dof_std[:, 6:]
        return np.asarray((std > MIN_STD) & (std < UNOBSERVED_STD_RATIO * tree.spread) & ~tree.prismatic)

    def _fit(
        self, frames: NDArray, roots: NDArray, angles: NDArray, locked: NDArray, iterations: int = 40
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Roots, angles and costs of frames (N,) fitted from such poses, coordinates `locked` (n,) as they are."""
        t = self.take
        fit = fit_sequence(
            t.body, (roots, angles), t.points, t.x[frames], sigma=t.sigma, loss=t.loss, limits=t.limits, locked=locked,
            posture=1.0, tolerance=1e-3, max_iterations=iterations,
        )  # fmt: skip
        return fit.Ts_world_root, fit.angles, fit.costs

    def _set_off(self, frames: NDArray, d: int, step: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Roots and angles with coordinate d moved by step (N,), and by how much the cost rises; inf beyond limits."""
        tree, angles, locked = self.take.body.tree, self.angles[frames].copy(), self._free.copy()
        angles[:, d] += step
        locked[6 + d] = True
        roots, fitted, costs = self._fit(frames, self.roots[frames], angles, locked)
        beyond = (angles[:, d] < tree.lower[d]) | (angles[:, d] > tree.upper[d])
        return roots, fitted, np.where(beyond & self.take.limits, np.inf, costs - self._costs[frames])

    def is_flat(self, frames: NDArray, d: int) -> NDArray:
        """(N,) bool: whether the costs of some frames (N,) are flat along coordinate d; better minima are taken."""
        flat = np.zeros(len(frames), bool)
        for side in (-1.0, 1.0):
            roots, angles, rise = self._set_off(frames, d, side * 2.0 * self.sure.dof_std[frames, 6 + d])
            flat |= rise < FLAT_RISE
            some = rise < -MIN_FALL
            self._take(frames[some], roots[some], angles[some])
        return flat

    def _take(self, frames: NDArray, roots: NDArray, angles: NDArray) -> NDArray:
        """Fit frames (N,) from such poses, and take what costs clearly less than what they have; (N,) bool: which."""
        if not len(frames):
            return np.zeros(0, bool)
        roots, angles, costs = self._fit(frames, roots, angles, self._free)
        better = costs < self._costs[frames] - MIN_FALL
        own = frames[better]
        self.roots[own], self.angles[own], self._costs[own] = roots[better], angles[better], costs[better]
        self._better |= set(own.tolist())
        return np.asarray(better)

    def spread(self) -> None:
        """Frames next to those that found a better minimum try it, too."""
        for way in (1, -1):
            for f in sorted(self._better, reverse=way < 0):
                g = f + way
                while 0 <= g < len(self.angles) and self._take(np.array([g]), *self._state(g - way))[0]:
                    g += way
        self._judge()

    def _state(self, f: int) -> tuple[NDArray, NDArray]:
        return self.roots[f : f + 1], self.angles[f : f + 1]

    def widen(self, grid: NDArray, d: int, asked: NDArray) -> NDArray:
        """Widen the deviations of frames grid[asked] that are flat along coordinate d; (G,) bool: which are."""
        flat = np.zeros(len(grid), bool)
        for side in (-1.0, 1.0):
            going, step = np.flatnonzero(asked), 2.0 * self.sure.dof_std[grid, 6 + d]
            for turn in range(MAX_STEPS):
                if not len(going):
                    break
                roots, angles, rise = self._set_off(grid[going], d, side * step[going])
                if turn == 0:
                    flat[going] |= rise < FLAT_RISE
                reached = np.isfinite(rise) & flat[going]
                self._reach(grid[going[reached]], roots[reached], angles[reached], rise[reached])
                low = rise < (0.9 * FULL_RISE if turn else FLAT_RISE)
                step[going] *= np.minimum(np.sqrt(FULL_RISE / np.maximum(rise, 1.0)), 2.0)
                going = going[low]
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
    flat : (F, D) bool, frames and coordinates of `profiled`
    """
    tree, settings, margin = take.body.tree, TrackSettings(), max(round(SAMPLE_INTERVAL_S * rate), 2)
    roots, angles, memory = roots.copy(), angles.copy(), (settings.acceleration_memory, settings.smooth_memory)
    for a, b in runs_of(np.asarray(flat.any(axis=1)), 2 * margin):
        span = slice(max(a - margin, 0), b + margin)
        lower, upper, usual = boxes(tree, angles[span])
        bounds = (lower, upper) if take.limits else None
        equations = point_equations(take.body, take.points, take.x[span], sigma=take.sigma, loss=take.loss)
        acceleration = np.where(flat[span].any(axis=0), settings.angle_acceleration, FREE_ACCELERATION)
        for livelier in LIVELINESS:
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
            if (costs[1] - costs[0]).max() < MAX_RISE:
                roots[span], angles[span] = found.roots, found.angles
                break
    return roots, angles
