"""Estimate the process noise of a person and the noise of a detector from the take that is smoothed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit._threads import side_by_side
from kinefit.bodies import Body
from kinefit.fitting.smoothing.foot_contacts import Contacts
from kinefit.fitting.smoothing.packed import MIN_INLIER_FACTOR, PackedMarkers, PackedPixels, PackedPoints
from kinefit.fitting.smoothing.shared_errors import shared_by
from kinefit.fitting.smoothing.spool import Spool
from kinefit.fitting.smoothing.tracked_frames import Linearised, TrackedFrames, squares_of, with_quadratic
from kinefit.fitting.smoothing.unwrap import boxes
from kinefit.sensors.base import Matched, rows_at
from kinefit.sensors.channels import Channels, joined
from kinefit.solving.trajectory.motion_prior import MotionPrior
from kinefit.solving.trajectory.sequence import SeenPoints
from kinefit.solving.trajectory.smoothing import Posterior, Smoothed, posterior, smooth

_MEDIAN_SQUARE_2D = 2.0 * np.log(2.0)  # median |r|² of a normal error in the plane, in σ² (Rayleigh)
_MEDIAN_SQUARE_1D = 0.4549  # median of a squared normal variable
_MIN_ROWS = 30  # of a sensor: with fewer its standard deviation is not estimated
DETECTOR_CORRELATION_TIME = 0.25
"""[s] whose frames count as one independent measurement of a point."""
_MIN_SIGMA_RATIO = 0.01  # estimated to stated sigma of a point: of exact ones, weights would leave nothing but rounding
_PRIOR_MEASUREMENTS = 30.0  # independent measurements of a point that the estimate of its source counts as
_PRIOR_CHANGES = 10.0  # changes of a degree of freedom that its prior acceleration counts as
_MAX_RELATIVE_CHANGE = 0.05  # of all estimates between rounds, below which they have converged
_ACTIVITY_STD_S = 0.15  # [s] of the window over which a limb's activity is averaged: half a quick reach or step


@dataclass(frozen=True, eq=False)
class SmoothTake:
    """Measurements of T frames with left-right swaps corrected, and states to start from.

    `pixels`, `markers`: keypoints and labelled markers; `others`: frames of all other sensors, `linear` their costs at
    the states; `acceleration` (n,) [m/s², rad/s²]: random acceleration of every degree of freedom, one standard
    deviation; `observed` (T, D) bool: coordinates that a frame nearby observes on its own; `live` (T, n): activity,
    a factor on the process noise;
    `speed_std` (n,) [m/s, rad/s]: 90th percentile over frames; `one_view`: one camera is the only sensor, so no other
    view contradicts the errors of its keypoints; `looked`: share 0..1 of the frames in which a sensor looked.
    """

    body: Body
    pixels: PackedPixels
    markers: PackedMarkers
    roots: NDArray
    angles: NDArray
    observed: NDArray
    acceleration: NDArray
    live: NDArray
    dt: float
    memory: tuple[float, float]
    contacts: Contacts | None = None
    others: TrackedFrames | None = None
    linear: Linearised | None = None
    speed_std: NDArray | None = None
    one_view: bool = False
    looked: float = 1.0

    @property
    def blocks(self) -> tuple[PackedPoints, ...]:
        """Sensors whose points are packed."""
        return self.pixels, self.markers

    def renewed(self, *, keep: bool = False) -> SmoothTake:
        """The take with all other sensors matched and linearised at its states; `keep` keeps the matches."""
        if self.others is None:
            return self
        matches = Spool[tuple[Matched, ...]]() if keep else None
        return replace(self, linear=self.others.linearised(self.roots, self.angles, keep=matches))

    def part(self, frames: slice) -> SmoothTake:
        """Some frames of the take."""
        names = ("roots", "angles", "observed", "live")
        cut = {name: getattr(self, name)[frames] for name in names}
        return replace(
            self, **cut, pixels=self.pixels.part(frames), markers=self.markers.part(frames),
            contacts=self.contacts and self.contacts.part(frames),
            others=self.others and self.others.part(frames), linear=self.linear and self.linear.part(frames),
        )  # fmt: skip

    def solver_points(self) -> SeenPoints:
        """Keypoints, markers and contacts for the solver."""
        markers, contacts = self.markers, self.contacts
        out = replace(
            self.pixels.for_solver(self.pixels.weight, self.pixels.loss), placed=markers.points, places=markers.values,
            place_weight=markers.weight, place_loss=markers.loss, robust=len(markers.points),
        )  # fmt: skip
        if contacts is None:
            return out
        return replace(
            out, placed=joined([markers.points, contacts.points]),
            places=np.concatenate([markers.values, contacts.places], axis=1),
            place_weight=np.concatenate([markers.weight, contacts.weight], axis=1),
        )  # fmt: skip

    @property
    def scale(self) -> dict[str, float]:
        """{sensor: factor on its standard deviation} of all sensors but the keypoints, a number from 1."""
        return {**self.markers.scale, **(self.others.scale if self.others else {})}

    def scaled(self, scale: Mapping[str, float]) -> SmoothTake:
        """The take with other factors {sensor: number from 1}."""
        others = self.others and replace(self.others, scale=_known(self.others.scale, scale))
        return replace(self, markers=replace(self.markers, scale=_known(self.markers.scale, scale)), others=others)

    def fit(self, *, tolerance: float = 1e-5) -> tuple[Smoothed, Posterior]:
        """Solve all frames jointly from the take's states, with covariances; `tolerance` is unitless."""
        fit = self.solved(tolerance=tolerance)
        if self.linear is None or self.linear.unsupported is None:
            return fit, posterior(self.body, fit)
        measured = replace(fit.system, C=fit.system.C - self.linear.unsupported)
        return fit, posterior(self.body, replace(fit, system=measured))

    def solved(self, *, tolerance: float = 1e-5, posture: float = 1.0) -> Smoothed:
        """Solve all frames jointly from the take's states; `tolerance` is unitless, `posture` the prior's share."""
        lower, upper, mean = boxes(self.body.tree, self.angles)
        unobserved = ~self.observed.any(axis=0)  # stays at the prior mean
        lower[:, unobserved] = upper[:, unobserved] = mean[:, unobserved]
        tree, root = self.body.tree, self.looked**0.5  # the posture counts as often as it is measured
        prior = MotionPrior(
            self.acceleration, self.memory, self.dt, mean, tree.spread / (root * posture**0.5), self.live,
            root * tree.couplings,
        )  # fmt: skip
        make = self.solver_points().equations(self.body)
        dense = self.linear is not None
        if self.linear is not None:
            make = with_quadratic(self.body, make, self.linear)
        bounds = lower, upper
        return smooth(self.body, self.roots, self.angles, make, prior, bounds=bounds, dense=dense, tolerance=tolerance)


def estimate(takes: list[SmoothTake], rounds: int) -> tuple[list[SmoothTake], int]:
    """Estimate accelerations, activity and pixel noise by iteration to a fixed point (empirical Bayes, MacKay 1992).

    With γ = Σ (1 − var(r)/a²), the number of changes r that the pixels observe, a² = Σ r² / γ. Pixels likewise.

    Parameters
    ----------
    takes : parts of one take, with the noise to start from
    rounds : int, at most

    Returns
    -------
    the parts with their noise, last states and activity, and the number of rounds
    """
    first = takes[0]
    body, channels, start = first.body, first.pixels.channels, first.acceleration
    groups, limb, count = noise_groups(body), limbs(body), 0
    takes = list(takes)
    while count < rounds:
        count += 1
        squares, informed, level = np.zeros((3, body.tree.n_dofs))
        errors: list[tuple[NDArray, NDArray, NDArray]] = []
        takes = [take.renewed(keep=True) for take in takes]
        for fitted in side_by_side(_roughly, list(takes)):
            i, (fit, post) = len(errors), fitted
            take = takes[i]
            of_r, of_gamma = _changes(take, fit, post)
            squares, informed = squares + (of_r / np.square(take.live)).sum(axis=0), informed + of_gamma.sum(axis=0)
            live = _activity(body, take.dt, of_r, of_gamma)
            level += (of_gamma * np.log(live)).sum(axis=0)
            takes[i] = replace(take, roots=fit.roots, angles=fit.angles, live=live)
            errors.append(_pixels(takes[i], post))
            del fitted, fit, post  # 100 MB for 600 frames, while two more parts are fitted
        before, pixels = takes[0].acceleration, takes[0].pixels
        level = np.bincount(limb, level) / np.maximum(np.bincount(limb, informed), 1e-12)  # goes to the accelerations
        acceleration = _accelerations(squares, informed, start / before, groups) * before
        looks = min(first.dt / first.looked / DETECTOR_CORRELATION_TIME, 1.0)
        residuals, r2, variance = (np.concatenate(p) for p in zip(*errors, strict=True))
        sigma, shared = _noise(channels, r2, variance, looks), shared_by(channels, residuals, variance, looks)
        sigma = np.maximum(sigma, _MIN_SIGMA_RATIO * channels.sigma)
        if first.one_view:  # the pose absorbs systematic errors of the only view: residuals show jitter alone
            sigma, shared = np.maximum(sigma, channels.sigma), np.zeros(len(sigma))
        scale, known = sensor_scales(takes), takes[0].scale
        changes = [
            np.abs(shared - pixels.errors.share), np.abs(np.log(acceleration / before)),
            np.abs(np.log(sigma / pixels.sigma)), [abs(np.log(v / known.get(name, 1.0))) for name, v in scale.items()],
        ]  # fmt: skip
        takes = [
            replace(
                take, acceleration=acceleration, live=take.live / np.exp(level[limb]),
                pixels=take.pixels.with_noise(sigma, shared),
            ).scaled(scale) for take in takes
        ]  # fmt: skip
        if np.concatenate(changes).max() < _MAX_RELATIVE_CHANGE:
            break
    return takes, count


def _roughly(take: SmoothTake) -> tuple[Smoothed, Posterior]:
    return take.fit(tolerance=1e-3)


def estimate_activity(take: SmoothTake, rounds: int = 3) -> SmoothTake:
    """The take with its activity estimated, for known noise; its states are those of the last round.

    `rounds` is the most; they end when no activity changes by more than a twentieth.
    """
    for _ in range(rounds):
        take = take.renewed()
        fit, post = _roughly(take)
        live = _activity(take.body, take.dt, *_changes(take, fit, post))
        change = float(np.abs(np.log(live / take.live)).max())
        take = replace(take, roots=fit.roots, angles=fit.angles, live=live)
        if change < _MAX_RELATIVE_CHANGE:
            break
    return take


def sensor_scales(takes: list[SmoothTake]) -> dict[str, float]:
    """{sensor: factor on its standard deviation} estimated from residuals, a number from 1.

    Residuals of the nearest points of a surface are smaller than their errors, so no factor is below 1.
    """
    squares: dict[str, list[NDArray]] = {}
    skipped: set[str] = set()  # sensors whose rows, of one kind in all frames, have no residuals to estimate noise from
    for take in takes:
        gaps = take.markers.gaps(take.body, take.roots, take.angles)
        inlier = take.markers.factors(gaps) > MIN_INLIER_FACTOR
        square = take.markers.stated[..., None] * np.square(gaps)
        for sensor in take.markers.sensors:
            own = take.markers.columns(sensor)
            squares.setdefault(sensor, []).append(square[:, own][inlier[:, own]].ravel())
        if take.others is None or take.linear is None:
            continue
        for f, matched in enumerate(take.linear.matched):
            scene = take.others.scene(f, take.roots, take.angles)
            for m in matched:
                if m.sensor in skipped or m.sigma_known:
                    continue
                made = [(len(rows), *squares_of(rows)) for rows in rows_at(m, scene)]
                if any(count for count, _, _ in made) and not any(len(square) for _, square, _ in made):
                    skipped.add(m.sensor)
                for _, square, factor in made:
                    squares.setdefault(m.sensor, []).append(square[factor > MIN_INLIER_FACTOR])
    inliers = {name: np.concatenate(parts) for name, parts in squares.items()}
    return {
        name: float(np.sqrt(max(np.median(s) / _MEDIAN_SQUARE_1D, 1.0))) if len(s) >= _MIN_ROWS else 1.0
        for name, s in inliers.items()
    }


def _known(old: Mapping[str, float], new: Mapping[str, float]) -> dict[str, float]:
    return {name: new.get(name, value) for name, value in old.items()}


def _changes(take: SmoothTake, fit: Smoothed, post: Posterior) -> tuple[NDArray, NDArray]:
    """(T, n) squares of changes r over their prior variance, and the share 0..1 of each that pixels observe."""
    squares, informed = np.zeros((2, *take.live.shape))
    _, weight = fit.prior.rows(len(fit.changes))
    squares[2:-1] = np.square(fit.changes[2:]) * fit.prior.weight
    informed[2:-1] = np.maximum(1.0 - post.change_variance[2:] * weight[2:], 0.0)
    unobserved = 6 + np.flatnonzero(~take.observed.any(axis=0))
    squares[:, unobserved] = informed[:, unobserved] = 0.0
    return squares, informed


def _activity(body: Body, dt: float, squares: NDArray, informed: NDArray) -> NDArray:
    """(T, n) activity: each limb's acceleration over its mean, of all its degrees of freedom in a Gaussian window."""
    reach = max(int(np.ceil(3.0 * _ACTIVITY_STD_S / dt)), 1)
    bell = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) * dt / _ACTIVITY_STD_S))
    limb = limbs(body)
    out = np.ones(squares.shape)
    for number in np.unique(limb):
        dofs = limb == number
        near = [np.convolve(v[:, dofs].sum(axis=1), bell)[reach:-reach] for v in (squares, informed)]
        log = 0.5 * np.log((near[0] + _PRIOR_CHANGES) / (near[1] + _PRIOR_CHANGES))
        out[:, dofs] = np.exp(log)[:, None]
    return out


def _accelerations(squares: NDArray, informed: NDArray, start: NDArray, groups: NDArray) -> NDArray:
    """(n,) factor on each acceleration, shrunk towards the prior `start` (n,) where the take has few changes."""
    squares, informed = np.bincount(groups, squares)[groups], np.bincount(groups, informed)[groups]
    own = 0.5 * np.log(np.maximum(squares, 1e-12) / np.maximum(informed, 1e-12))
    share = informed / (informed + _PRIOR_CHANGES)
    return np.asarray(np.exp(share * own + (1.0 - share) * np.log(start)))


def _pixels(take: SmoothTake, post: Posterior) -> tuple[NDArray, NDArray, NDArray]:
    """Residuals (T, N, 2) [px], NaN for outliers; squared at full confidence (T, N), and the fit's variance [px²]."""
    block = take.pixels
    gaps = block.gaps(take.body, take.roots, take.angles)
    inside = block.factors(gaps) > MIN_INLIER_FACTOR
    r2 = block.confidence * np.square(gaps).sum(axis=2)
    points = block.for_solver(block.weight, block.loss)
    variance = points.variance(take.body, take.roots, take.angles, post.frames).sum(axis=2)
    residuals = np.where(inside[..., None], gaps, np.nan)
    return residuals, np.where(inside, r2, np.nan), np.where(inside, block.confidence * variance, np.nan)


def _noise(channels: Channels, r2: NDArray, variance: NDArray, looks: float) -> NDArray:
    """(N,) [px] noise of every channel at full confidence, the same for left and right points of a source.

    Parameters
    ----------
    r2, variance : from `_pixels`; looks : number of independent measurements that one frame counts as, 1 at most
    """
    lowest = np.minimum(channels.column, channels.column[channels.partner])
    out = np.array(channels.sigma)
    for q in range(len(channels.sources)):
        of_source = channels.source == q
        whole = _deviation(r2[:, of_source], variance[:, of_source])
        if not np.isfinite(whole):
            continue
        for k in np.unique(lowest[of_source]):
            members = of_source & (lowest == k)
            count = looks * float(np.isfinite(r2[:, members]).sum())
            own = _deviation(r2[:, members], variance[:, members]) if count else whole
            share = count / (count + _PRIOR_MEASUREMENTS)
            out[members] = np.exp(share * np.log(max(own, 0.25 * whole)) + (1 - share) * np.log(whole))
    return out


def _deviation(r2: NDArray, variance: NDArray) -> float:
    """Standard deviation [px] from squared residuals and the variance that the fit absorbed; NaN without inliers."""
    known = np.isfinite(r2)
    if not known.any():
        return float("nan")
    remaining = float(np.median(r2[known])) / _MEDIAN_SQUARE_2D
    absorbed = 0.5 * float(np.median(variance[known]))
    return float(np.sqrt(remaining + min(absorbed, remaining)))


def limbs(body: Body) -> NDArray:
    """(n,) int: number of the limb of each degree of freedom: trunk, head, each arm, each leg (between two forks)."""
    tree = body.tree
    children = np.bincount(np.maximum(tree.parents, 0), minlength=len(tree.segments))
    children[0] -= 1  # the root is no child of its own
    out = np.zeros(len(tree.segments), int)
    for s in range(1, len(out)):
        parent = tree.parents[s]
        out[s] = out[parent] if children[parent] == 1 else s
    return np.concatenate([np.zeros(6, int), out[tree.owners]])


def noise_groups(body: Body) -> NDArray:
    """(n,) int: number of the group that shares a process noise: the root's shift, its turn, left and right joints."""
    groups: dict[str, int] = {}
    names = ["shift"] * 3 + ["turn"] * 3
    names += [c[:-2] if c.endswith(("_l", "_r")) else c for c in body.tree.coordinates]
    return np.array([groups.setdefault(name, len(groups)) for name in names])
