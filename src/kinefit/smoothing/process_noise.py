"""Process noise of a person and noise of a detector: estimated from the take that is smoothed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import release, room
from kinefit._threads import side_by_side
from kinefit.bodies import Body, PointSet
from kinefit.losses import Loss
from kinefit.sensors.base import Matched, rows_at
from kinefit.sensors.channels import Channels
from kinefit.smoothing.foot_contacts import Contacts
from kinefit.smoothing.limbs import alike, limbs
from kinefit.smoothing.linearised import Linearised, OtherSensors, squares_of, with_quadratic
from kinefit.smoothing.shared_errors import SharedErrors, shared_by
from kinefit.smoothing.spool import Spool, stretches
from kinefit.smoothing.unwrap import boxes
from kinefit.solvers.trajectory.motion_prior import MotionPrior
from kinefit.solvers.trajectory.seen_points import SeenPoints
from kinefit.solvers.trajectory.smoothing import Posterior, Smoothed, posterior, smooth

INLIER = 0.25  # robust factor (Geman-McClure: within its scale) above which a residual is noise
_RAYLEIGH = 2.0 * np.log(2.0)  # median |r|² of a normal error in the plane, in σ²
_MEDIAN = 0.4549  # of a squared normal variable
_ROWS = 30  # of a sensor, with fewer of which its standard deviation stays as it is stated
_LOOK = 0.25  # [s] for which a detector errs alike, so that its frames count as one look at a point
_SAMPLES = 30.0  # looks at a point that count as much as all the others of its source together
_FRAMES = 10.0  # changes of a degree of freedom that count as much as what was assumed of it
_SETTLED = 0.05  # relative change of all estimates below which they are left
_BURST = 0.15  # [s] over which a limb is taken to be equally lively: half of a quick reach or step


@dataclass(frozen=True, eq=False)
class Strength:
    """What is estimated from a take.

    Parameters
    ----------
    acceleration : (n,) [m/s², rad/s²] random acceleration of every degree of freedom, one standard deviation.
    sigma : (N,) [px] noise of every channel at full confidence.
    shared : (N,) share of its variance that all points of a segment have in common in a view.
    """

    acceleration: NDArray
    sigma: NDArray
    shared: NDArray

    def change(self, other: Strength) -> float:
        """Largest relative difference of anything in it."""
        pairs = zip(*((s.acceleration, s.sigma) for s in (self, other)), strict=True)
        shared = float(np.abs(self.shared - other.shared).max(initial=0.0))
        return max(shared, *(float(np.abs(np.log(a / b)).max(initial=0.0)) for a, b in pairs))


@dataclass(frozen=True, eq=False)
class SmoothTake:
    """Measurements of all frames as used (left and right put right), and states to start from.

    `swapped` (T, N) bool: channels that changed sides for it;
    `told` (T, D) bool: coordinates that some frame not far away observes on its own; `live` (T, n): its process noise
    over time, as a factor; `others`: what all sensors but the keypoints measured, `linear` the same about
    the states; `speed_std` (n,) [m/s, rad/s] of the rates of change, which nine tenths of the frames fall below;
    `one_view`: nothing but one camera saw the person, and nothing contradicts what its pixels are off by.
    """

    body: Body
    channels: Channels
    points: PointSet
    uv: NDArray
    confidence: NDArray
    swapped: NDArray
    roots: NDArray
    angles: NDArray
    told: NDArray
    live: NDArray
    dt: float
    loss: Loss
    memory: tuple[float, float]
    contacts: Contacts | None = None
    others: OtherSensors | None = None
    linear: Linearised | None = None
    speed_std: NDArray | None = None
    one_view: bool = False

    def renewed(self, *, keep: bool = False) -> SmoothTake:
        """With all other sensors matched and linearised anew about the states; `keep` keeps the matches."""
        if self.others is None:
            return self
        matches = Spool[tuple[Matched, ...]]() if keep else None
        return replace(self, linear=self.others.linearised(self.body, self.roots, self.angles, keep=matches))

    def part(self, frames: slice) -> SmoothTake:
        """A stretch of it."""
        names = ("uv", "confidence", "swapped", "roots", "angles", "told", "live")
        cut = {name: getattr(self, name)[frames] for name in names}
        return replace(
            self, **cut, contacts=self.contacts and self.contacts.part(frames),
            others=self.others and self.others.part(frames), linear=self.linear and self.linear.part(frames),
        )  # fmt: skip

    def seen(self, sigma: NDArray, shared: NDArray | None = None) -> SeenPoints:
        """Its pixels and contacts as the solver takes them; sigma (N,) [px], shared (N,) as of `Strength`."""
        known = SharedErrors.of(self.channels, np.zeros(len(sigma)) if shared is None else shared, sigma)
        out = SeenPoints(
            self.channels.rig, self.points, self.channels.camera, self.uv,
            self.confidence / (np.square(sigma) * (1.0 - known.share)), self.loss, member=known.member,
            shared=known.variance,
        )  # fmt: skip
        if self.contacts is None:
            return out
        held = self.contacts
        return replace(out, anchored=held.points, anchors=held.places, anchor_weight=held.weight)

    def fitted(self, roots: NDArray, angles: NDArray) -> NDArray:
        """(T, N, 2) [px] where the points are seen."""
        x = self.body.trajectories(roots, angles, self.points)
        out = np.empty((*x.shape[:2], 2))
        for c, camera in enumerate(self.channels.rig):
            mine = self.channels.camera == c
            out[:, mine] = camera.project(x[:, mine].reshape(-1, 3)).reshape(len(x), -1, 2)
        return out

    def factors(self, sigma: NDArray, fitted: NDArray) -> NDArray:
        """(T, N) robust factor of every channel, 0 where unseen."""
        r2 = np.square(self.uv - fitted).sum(axis=2)
        used = (self.confidence > 0) & np.isfinite(r2)
        s2 = np.where(used, self.confidence * r2 / np.square(sigma), 0.0)
        return np.where(used, self.loss.factor(s2), 0.0)

    def agreeing(self, sigma: NDArray) -> NDArray:
        """(T, N) robust factor of every channel at its states, 0 where unseen."""
        out = room(self.confidence.shape)
        for some in stretches(len(self.roots)):
            part = self.part(some)
            out[some] = part.factors(sigma, part.fitted(part.roots, part.angles))
            release(self.uv, self.confidence, out)
        return out

    def fit(self, strength: Strength, *, tolerance: float = 1e-5) -> tuple[Smoothed, Posterior]:
        """All frames together, from where they are, and how sure they are."""
        fit = self.solved(strength, tolerance=tolerance)
        if self.linear is None or self.linear.unsure is None:
            return fit, posterior(self.body, fit)
        sure = replace(fit.system, C=fit.system.C - self.linear.unsure)
        return fit, posterior(self.body, replace(fit, system=sure))

    def solved(self, strength: Strength, *, tolerance: float = 1e-5) -> Smoothed:
        """All frames together, from where they are."""
        lower, upper, usual = boxes(self.body.tree, self.angles)
        never = ~self.told.any(axis=0)  # stays at the prior mean
        lower[:, never] = upper[:, never] = usual[:, never]
        tree = self.body.tree
        prior = MotionPrior(
            strength.acceleration, self.memory, self.dt, usual, tree.spread, self.live, tree.couplings
        )  # fmt: skip
        make = self.seen(strength.sigma, strength.shared).equations(self.body)
        dense = self.linear is not None
        if self.linear is not None:
            make = with_quadratic(self.body, make, self.linear)
        bounds = lower, upper
        return smooth(self.body, self.roots, self.angles, make, prior, bounds=bounds, dense=dense, tolerance=tolerance)


def estimate(
    takes: list[SmoothTake], settings_start: tuple[float, float], rounds: int
) -> tuple[Strength, list[SmoothTake], int]:
    """Accelerations, liveliness and pixel noise at which neither changes any more (empirical Bayes, MacKay 1992).

    With γ = Σ (1 − var(r)/a²), how many of the changes r the pixels observe, a² = Σ r² / γ; and likewise for pixels.

    Parameters
    ----------
    takes : parts of one take.
    settings_start : [m/s²], [rad/s²] accelerations of the root and of the angles to start from.
    rounds : int, at most.

    Returns
    -------
    strength, the parts as fitted last with their liveliness, and how many rounds it took
    """
    body, channels, n = takes[0].body, takes[0].channels, takes[0].body.tree.n_dofs
    start = np.where(np.arange(n) < 3, *settings_start)
    strength = Strength(start, np.array(channels.sigma), np.zeros(len(channels.sigma)))
    groups, limb, count = alike(body), limbs(body), 0
    takes = list(takes)
    while count < rounds:
        count += 1
        squares, informed, level = np.zeros((3, n))
        errors: list[tuple[NDArray, NDArray, NDArray]] = []
        takes = [take.renewed(keep=True) for take in takes]
        for fitted in side_by_side(partial(_roughly, strength), list(takes)):
            i, (fit, post) = len(errors), fitted
            take = takes[i]
            of_r, of_gamma = _changes(take, fit, post)
            squares, informed = squares + (of_r / np.square(take.live)).sum(axis=0), informed + of_gamma.sum(axis=0)
            live = _liveliness(body, take.dt, of_r, of_gamma)
            level += (of_gamma * np.log(live)).sum(axis=0)
            takes[i] = replace(take, roots=fit.roots, angles=fit.angles, live=live)
            errors.append(_pixels(takes[i], strength, post))
            del fitted, fit, post  # of 600 frames some 100 MB, while two more parts are fitted
        level = np.bincount(limb, level) / np.maximum(np.bincount(limb, informed), 1e-12)  # the accelerations have it
        takes = [replace(take, live=take.live / np.exp(level[limb])) for take in takes]
        acceleration = _accelerations(squares, informed, start / strength.acceleration, groups) * strength.acceleration
        looks = min(takes[0].dt / _LOOK, 1.0)
        left, r2, variance = (np.concatenate(p) for p in zip(*errors, strict=True))
        sigma, shared = _noise(channels, r2, variance, looks), shared_by(channels, left, variance, looks)
        if takes[0].one_view:  # a pose follows what its only view is off by: residuals show the jitter alone
            sigma, shared = np.maximum(sigma, channels.sigma), np.zeros(len(sigma))
        found = Strength(acceleration, sigma, shared)
        change = found.change(strength)
        strength = found
        if takes[0].others is not None:
            scale = sensor_scales(takes)
            change = max(change, _largest_change(takes[0].others.scale, scale))
            takes = [replace(t, others=t.others and replace(t.others, scale=scale)) for t in takes]
        if change < _SETTLED:
            break
    return strength, takes, count


def _roughly(strength: Strength, take: SmoothTake) -> tuple[Smoothed, Posterior]:
    return take.fit(strength, tolerance=1e-3)


def enliven(take: SmoothTake, strength: Strength, rounds: int = 3) -> SmoothTake:
    """The same take with its liveliness, where the rest is known."""
    for _ in range(rounds):
        take = take.renewed()
        fit, post = _roughly(strength, take)
        live = _liveliness(take.body, take.dt, *_changes(take, fit, post))
        take = replace(take, roots=fit.roots, angles=fit.angles, live=live)
    return take


def sensor_scales(takes: list[SmoothTake]) -> dict[str, float]:
    """Factor of each sensor's standard deviation that its residuals ask for, 1 at least.

    What is left over of the nearest points of a surface is smaller than their errors, so that a stated standard
    deviation is never made smaller.
    """
    squares: dict[str, list[NDArray]] = {}
    silent: set[str] = set()  # sensors whose rows, of one kind in all frames, have no noise that could be estimated
    for take in takes:
        assert take.others is not None and take.linear is not None
        for f, matched in enumerate(take.linear.matched):
            scene = take.others.scene(f, take.roots, take.angles)
            for m in matched:
                if m.sensor in silent:
                    continue
                made = [(len(rows), *squares_of(rows)) for rows in rows_at(m, scene)]
                if any(count for count, _, _ in made) and not any(len(square) for _, square, _ in made):
                    silent.add(m.sensor)
                for _, square, factor in made:
                    squares.setdefault(m.sensor, []).append(square[factor > INLIER])
    told = {name: np.concatenate(parts) for name, parts in squares.items()}
    return {
        name: float(np.sqrt(max(np.median(s) / _MEDIAN, 1.0))) if len(s) >= _ROWS else 1.0 for name, s in told.items()
    }


def _largest_change(old: dict[str, float], new: dict[str, float]) -> float:
    return max((abs(np.log(v / old.get(name, 1.0))) for name, v in new.items()), default=0.0)


def _changes(take: SmoothTake, fit: Smoothed, post: Posterior) -> tuple[NDArray, NDArray]:
    """(T, n) squares of r over their prior variance, and how far the pixels observe each, 0..1; zero where unknown."""
    squares, informed = np.zeros((2, *take.live.shape))
    _, weight = fit.prior.rows(len(fit.changes))
    squares[2:-1] = np.square(fit.changes[2:]) * fit.prior.weight
    informed[2:-1] = np.maximum(1.0 - post.change_variance[2:] * weight[2:], 0.0)
    never = 6 + np.flatnonzero(~take.told.any(axis=0))
    squares[:, never] = informed[:, never] = 0.0
    return squares, informed


def _liveliness(body: Body, dt: float, squares: NDArray, informed: NDArray) -> NDArray:
    """(T, n) how much more than its mean each limb accelerates at a time, over all its degrees of freedom together."""
    reach = max(int(np.ceil(3.0 * _BURST / dt)), 1)
    bell = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) * dt / _BURST))
    limb = limbs(body)
    out = np.ones(squares.shape)
    for one in np.unique(limb):
        mine = limb == one
        near = [np.convolve(v[:, mine].sum(axis=1), bell)[reach:-reach] for v in (squares, informed)]
        log = 0.5 * np.log((near[0] + _FRAMES) / (near[1] + _FRAMES))
        out[:, mine] = np.exp(log)[:, None]
    return out


def _accelerations(squares: NDArray, informed: NDArray, start: NDArray, groups: NDArray) -> NDArray:
    """(n,) by what factor each should change: to start (n,), where the take says little."""
    squares, informed = np.bincount(groups, squares)[groups], np.bincount(groups, informed)[groups]
    own = 0.5 * np.log(np.maximum(squares, 1e-12) / np.maximum(informed, 1e-12))
    share = informed / (informed + _FRAMES)
    return np.asarray(np.exp(share * own + (1.0 - share) * np.log(start)))


def _pixels(take: SmoothTake, strength: Strength, post: Posterior) -> tuple[NDArray, NDArray, NDArray]:
    """Residuals (T, N, 2) [px], NaN for outliers; squared at full confidence (T, N), and the fit's variance [px²]."""
    fitted = take.fitted(take.roots, take.angles)
    inside = take.factors(strength.sigma, fitted) > INLIER
    r2 = take.confidence * np.square(take.uv - fitted).sum(axis=2)
    variance = take.seen(strength.sigma).variance(take.body, take.roots, take.angles, post.frames).sum(axis=2)
    left = np.where(inside[..., None], take.uv - fitted, np.nan)
    return left, np.where(inside, r2, np.nan), np.where(inside, take.confidence * variance, np.nan)


def _noise(channels: Channels, r2: NDArray, variance: NDArray, looks: float) -> NDArray:
    """(N,) [px] noise of every channel at full confidence, points of one source and name (either side) together.

    Parameters
    ----------
    r2, variance : from `_pixels`; looks : independent looks that one frame amounts to.
    """
    lowest = np.minimum(channels.column, channels.column[channels.partner])
    out = np.array(channels.sigma)
    for q in range(len(channels.sources)):
        mine = channels.source == q
        whole = _deviation(r2[:, mine], variance[:, mine])
        if not np.isfinite(whole):
            continue
        for k in np.unique(lowest[mine]):
            members = mine & (lowest == k)
            count = looks * float(np.isfinite(r2[:, members]).sum())
            own = _deviation(r2[:, members], variance[:, members]) if count else whole
            share = count / (count + _SAMPLES)
            out[members] = np.exp(share * np.log(max(own, 0.25 * whole)) + (1 - share) * np.log(whole))
    return out


def _deviation(r2: NDArray, variance: NDArray) -> float:
    """[px] from what is left over and what of the error the fit followed; NaN where nothing is seen."""
    known = np.isfinite(r2)
    if not known.any():
        return float("nan")
    middle = float(np.median(r2[known])) / _RAYLEIGH
    followed = 0.5 * float(np.median(variance[known]))
    return float(np.sqrt(middle + min(followed, middle)))
