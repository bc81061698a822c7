"""Numbers of gait: strides and steps in time and space, each with its standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import PointSet
from kinefit.bodies.lasting_errors import LastingErrors
from kinefit.bodies.motion import BRIEF_S, Motion, rotation_between_up
from kinefit.exporters.report.feet import BALL, BELT_STD, HEEL, Feet, FootEvents

QUANTITIES = (
    "stride time [s]", "cadence [steps/min]", "stance [% of cycle]", "swing [% of cycle]",
    "double support [% of cycle]", "step time [s]", "stride length [m]", "speed [m/s]",
    "step length [m]", "step width [m]", "foot progression [deg]",
)  # fmt: skip
"""Of a stride, in the order of tables."""

_LEAST_SHARE = 0.3  # of the stature, of a stride that goes anywhere: shorter ones have no direction

_SETTLING_SHARE = 0.1  # of a stride after contact: the heel slides no more, and does not rise yet

Term = tuple[str, int, float]  # landmark, frame, weight


@dataclass(frozen=True, eq=False)
class Quantity:
    """One quantity of all strides of a side.

    Parameters
    ----------
    values, stds : (N,) of each stride, with the standard deviation of its error; NaN where it was not seen
    """

    values: NDArray
    stds: NDArray

    @property
    def mean(self) -> float:
        """Of the strides in which it was seen; NaN without one."""
        return float(np.nanmean(self.values)) if np.isfinite(self.values).any() else np.nan

    @property
    def std(self) -> float:
        """Of the mean's error. Errors that last are in all strides, so more strides do not make it smaller."""
        return float(np.nanmean(self.stds)) if np.isfinite(self.values).any() else np.nan

    @property
    def spread(self) -> float:
        """Standard deviation between strides; NaN of fewer than two."""
        known = self.values[np.isfinite(self.values)]
        return float(known.std(ddof=1)) if len(known) > 1 else np.nan


def stride_quantities(motion: Motion, feet: Feet, side: str, times: NDArray) -> dict[str, Quantity]:
    """Quantities of the strides of one foot.

    Parameters
    ----------
    side : "left" or "right"
    times : (N, 2) [s] of contacts that begin and end a stride

    Returns
    -------
    {name [unit]: Quantity}
        Lengths are over the ground, which is a treadmill's belt, too, between heels that stand. A step's length is of
        the step that ends with this foot's contact, its width the other heel's distance from this foot's stride; foot
        progression is positive with the toes out.
    """
    own, other = (feet.left, feet.right) if side == "left" else (feet.right, feet.left)
    rows = [_stride(motion, feet, own, other, float(start), float(stop)) for start, stop in times]
    table = {name: np.array([row.get(name, (np.nan, np.nan)) for row in rows]) for name in QUANTITIES}
    return {name: Quantity(*pairs.T) for name, pairs in table.items() if np.isfinite(pairs[:, 0]).any()}


def _stride(
    motion: Motion, feet: Feet, own: FootEvents, other: FootEvents, start: float, stop: float
) -> dict[str, tuple[float, float]]:
    """{name: (value, standard deviation)} of the stride between two contacts of a foot."""
    length = stop - start
    ends = [_std_at(own, t) for t in (start, stop)]
    std = float(np.hypot(ends[0], ends[1]))
    out = {"stride time [s]": (length, std), "cadence [steps/min]": (120.0 / length, 120.0 * std / length**2)}
    first = _within(own.offs, own.off_std, start, stop)
    landed = _within(other.contacts, other.contact_std, start, stop)
    last = _within(other.offs, other.off_std, start, stop)
    if first:
        stance, error = 100.0 * (first[0] - start) / length, 100.0 * float(np.hypot(first[1], ends[0])) / length
        out |= {"stance [% of cycle]": (stance, error), "swing [% of cycle]": (100.0 - stance, error)}
    if landed:
        out["step time [s]"] = stop - landed[0], float(np.hypot(ends[1], landed[1]))
    if first and landed and last and last[0] < landed[0] < first[0]:
        both = 100.0 * (last[0] - start + first[0] - landed[0]) / length
        error = 100.0 * float(np.linalg.norm([ends[0], last[1], first[1], landed[1]])) / length
        out["double support [% of cycle]"] = both, error
    out |= _lengths(motion, feet, own.side[0], start, stop, landed and landed[0], first and first[0])
    if "stride length [m]" in out:
        gone, error = out["stride length [m]"]
        out["speed [m/s]"] = gone / length, float(np.hypot(error, std * gone / length) / length)
    return out


def step_quantities(motion: Motion, feet: Feet, side: str, start: float, stop: float) -> dict[str, tuple[float, float]]:
    """{name: (value, standard deviation)} of a single step between contacts: the other foot's, then this one's [s].

    Its length is along the way of the pelvis in this time.
    """
    own, other = (feet.left, feet.right) if side == "left" else (feet.right, feet.left)
    std = float(np.hypot(_std_at(other, start), _std_at(own, stop)))
    out = {"step time [s]": (stop - start, std)}
    ground, settled = _Ground(motion, feet.belt), _SETTLING_SHARE * 2.0 * (stop - start)
    begin, end = (ground.frame(t + settled) for t in (start, stop))
    way = ground.sum_of([(f"{s}_hip", at, sign * 0.5) for s in "lr" for at, sign in ((end, 1.0), (begin, -1.0))])
    if float(np.linalg.norm(way)) > 0.5 * _LEAST_SHARE * (motion.body.stature or 1.7):
        along = way / np.linalg.norm(way)
        step: list[Term] = [(ground.heel(side), end, 1.0), (ground.heel(other.side), begin, -1.0)]
        out["step length [m]"] = float(ground.sum_of(step) @ along), ground.std_of(step, along)
    return out


def _std_at(foot: FootEvents, time: float) -> float:
    """[s] of the contact nearest to a time."""
    return float(foot.contact_std[np.argmin(np.abs(foot.contacts - time))])


def _within(times: NDArray, stds: NDArray, start: float, stop: float) -> tuple[float, float] | None:
    """The only event between two times [s], with its standard deviation [s]; None where it is not the only one."""
    found = np.flatnonzero((times > start) & (times < stop))
    return (float(times[found[0]]), float(stds[found[0]])) if len(found) == 1 else None


def _lengths(
    motion: Motion, feet: Feet, side: str, start: float, stop: float, landed: float | None, off: float | None
) -> dict[str, tuple[float, float]]:
    """Of a stride of foot "l" or "r", in which the other one lands and this one leaves the ground at times [s]."""
    ground, settled = _Ground(motion, feet.belt), _SETTLING_SHARE * (stop - start)
    begin, end = (ground.frame(t + settled) for t in (start, stop))
    heel, opposite = ground.heel(side), ground.heel("r" if side == "l" else "l")
    stride: list[Term] = [(heel, end, 1.0), (heel, begin, -1.0)]
    moved = ground.sum_of(stride)
    length = float(np.linalg.norm(moved))
    if length < _LEAST_SHARE * (motion.body.stature or 1.7):
        return {}
    along = moved / length
    facing = -along if feet.backwards else along
    right = np.array([-facing[1], facing[0]])  # y is up: of x ahead, z is to the right
    out = {"stride length [m]": (length, ground.std_of(stride, along))}
    if landed is not None:
        at = ground.frame(landed + settled)
        step: list[Term] = [(heel, end, 1.0), (opposite, at, -1.0)]
        gone = float(ground.sum_of(step) @ along)
        share = 1.0 - gone / length  # of the stride, at which the other foot stands beside its line
        beside: list[Term] = [(opposite, at, 1.0), (heel, begin, share - 1.0), (heel, end, -share)]
        outward = right if side == "l" else -right
        out["step length [m]"] = gone, ground.std_of(step, along)
        out["step width [m]"] = float(ground.sum_of(beside) @ outward), ground.std_of(beside, outward)
    if off is not None:
        middle = ground.frame(0.5 * (start + off))
        foot: list[Term] = [*((f"{side}_{name}", middle, 0.5) for name in BALL), (f"{side}_{HEEL}", middle, -1.0)]
        axis, outward = ground.sum_of(foot), right if side == "r" else -right
        turned, error = np.arctan2(axis @ outward, axis @ facing), ground.turn_std_of(foot, outward, axis)
        out["foot progression [deg]"] = float(np.degrees(turned)), float(np.degrees(error))
    return out


class _Ground:
    """Places of landmarks over the ground, along x and z of a world whose y is up."""

    def __init__(self, motion: Motion, belt: NDArray) -> None:
        self._motion, self._belt, self._R = motion, belt, rotation_between_up(motion.up, "y")

    def frame(self, time: float) -> int:
        return int(np.argmin(np.abs(self._motion.times - time)))

    def heel(self, side: str) -> str:
        """The back of a side's heel, where laboratories measure steps, or the sole where the body has no such mark."""
        names = (f"{side[0]}_{name}" for name in ("calcaneus_posterior", HEEL))
        return next(name for name in names if name in self._motion.body.landmarks.names)

    def sum_of(self, terms: Sequence[Term]) -> NDArray:
        """(2,) [m] weighted sum of landmarks in some frames."""
        out = np.zeros(2)
        for name, frame, weight in terms:
            point = self._motion.body.positions(self._motion.state(frame), self._points(name))[0]
            out += weight * ((self._R @ point)[::2] - self._belt * self._motion.times[frame])
        return out

    def std_of(self, terms: Sequence[Term], direction: NDArray) -> float:
        """[m] standard deviation of that sum along a direction (2,).

        What frames and feet have in common follows from `LastingErrors`. The rest is that of the segment's joint, of
        one foot by how far its frames are apart, as in `Motion.std_of`.
        """
        motion, points = self._motion, [self._points(name) for name, _, _ in terms]
        world = self._R.T @ np.array([direction[0], 0.0, direction[1]])
        owners = np.array([one.segments[0] for one in points])
        frames, weights = np.array([term[1] for term in terms]), np.array([term[2] for term in terms])
        stds = motion.joint_std[frames, owners]
        if not np.isfinite(stds).all():
            return np.inf
        brief = np.square(stds) @ np.square(world)
        apart = np.abs(motion.times[frames][:, None] - motion.times[frames])
        together = np.zeros((len(terms), len(terms)))
        if motion.lasting is not None:
            constant, drift = self._factors(motion.lasting, points, frames, world)
            together = constant @ constant.T
            together += np.exp(-apart / max(motion.lasting.drift_time, 1e-9)) * (drift @ drift.T)
            joints = [replace(one, points=np.zeros((1, 3))) for one in points]
            lasting = np.concatenate(self._factors(motion.lasting, joints, frames, world), axis=1)
            brief = np.maximum(brief - np.square(lasting).sum(axis=1), 0.0)
        alike = (owners[:, None] == owners) * np.exp(-apart / BRIEF_S)
        together += alike * np.sqrt(np.outer(brief, brief))
        carried = BELT_STD * float(weights @ motion.times[frames]) if self._belt.any() else 0.0
        return float(np.sqrt(max(weights @ together @ weights, 0.0) + carried**2))

    def _factors(
        self, lasting: LastingErrors, points: Sequence[PointSet], frames: NDArray, world: NDArray
    ) -> tuple[NDArray, NDArray]:
        """(n, k), (n, m) [m] constant and drifting errors of n points, each in a frame, along a direction (3,).

        An error of a length moves a point by itself, and by the pose that was fitted with it: the one makes up for most
        of the other.
        """
        known, groups = lasting.parameters, self._motion.body.scale_groups
        lengths = np.zeros((lasting.constant.shape[2], len(groups)))
        for g, name in enumerate(f"length {group}" for group in groups):
            if known is not None and name in known.names:
                lengths[:, g] = known.directions[:, known.names.index(name)]
        dofs, out = np.arange(self._motion.body.tree.n_dofs), []
        for point, frame in zip(points, frames, strict=True):
            slopes, (constant, drift) = self._slopes(point, frame, world), lasting.at(np.full(len(dofs), frame), dofs)
            out.append((slopes @ constant + lengths @ self._stretch(point, frame, world), slopes @ drift))
        return np.array([one for one, _ in out]), np.array([one for _, one in out])

    def _stretch(self, point: PointSet, frame: int, world: NDArray) -> NDArray:
        """(G,) [m] of a point's way along a direction (3,) by the logarithm of each scale group's length."""
        motion, body, segment = self._motion, self._motion.body, int(point.segments[0])
        Ts = body.tree.segment_poses(motion.Ts_world_root[[frame]], motion.angles[[frame]])[0]
        out, end = np.zeros(len(body.scale_groups)), body.positions(motion.state(frame), point)[0]
        while segment >= 0:
            out[body.segment_scale[segment]] += world @ (end - Ts[segment, :3, 3])
            segment, end = int(body.tree.parents[segment]), Ts[segment, :3, 3]
        return out

    def turn_std_of(self, foot: Sequence[Term], across: NDArray, axis: NDArray) -> float:
        """[rad] standard deviation of the direction of a line `axis` (2,) [m] on a foot, in one frame."""
        world = self._R.T @ np.array([across[0], 0.0, across[1]])
        slopes = [weight * self._slopes(self._points(name), frame, world) for name, frame, weight in foot]
        slope = np.sum(slopes, axis=0) / np.linalg.norm(axis)
        used = np.flatnonzero(np.abs(slope) > 1e-9)
        return self._motion.std_of(np.full(len(used), foot[0][1]), used, slope[used])

    def _slopes(self, point: PointSet, frame: int, world: NDArray) -> NDArray:
        """(6 + D,) [m] of a point's way along a direction (3,) by each degree of freedom."""
        tree, state = self._motion.body.tree, self._motion.state(frame)
        lever = self._motion.body.positions(state, point)[0] - state.T_world_root[:3, 3]
        J = tree.segment_jacobian(tree.forward(state.T_world_root, state.angles)[1], int(point.segments[0]))
        return np.asarray(world @ J[:3] + np.cross(lever, world) @ J[3:])

    def _points(self, name: str) -> PointSet:
        return self._motion.body.landmarks.select((name,))
