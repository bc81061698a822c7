"""Who wears the markers: a body's size and where each marker sits on it, from one or several trials, all at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.marker_sets import MarkerPlacement, find_placement
from kinefit.errors import ObservationError, TrackingError
from kinefit.geometry.camera import Rig
from kinefit.markers.poses import columns, sequence_both_ways
from kinefit.observations import Markers
from kinefit.sensors.base import Measurement
from kinefit.sensors.points.markers import MarkerMeasurement, MarkerSensor
from kinefit.sensors.settings import MARKER_LOSS
from kinefit.subject import fit as joint
from kinefit.subject.parameters import PointOffsets, SegmentScales, place_spread
from kinefit.subject.subject import SubjectFit

Progress = Callable[[str, int, int], None]

_LEAST, _MOST = 0.005, 0.03  # [m] no marker is held to be better fixed or looser than this
_FAR = 0.5  # share of its distance from the set's place that a marker's spread is at least
_SLIDES = 0.1  # share of a marker's spread: one on soft parts, which may sit anywhere, slides more than one on a bone
_SIZES = 0.3, 3.0  # of a person, as a share of the generic body's: beyond is a wrong unit
_INDEPENDENT = 1.0
"""How many frames with errors of their own all the frames of one trial count for.

Marker errors last: skin slides with the posture, and a joint is not quite a ball or a hinge. So many frames say little
more than their extremes do. Of 0.5, 1, 2, 4, 16 and 80 the joint centres of four laboratories' subjects are met best
from 0.5 to 2 (15 to 16 mm, as they are; 20 mm by 16). Counted as `subject.excess` counts errors, the left toe marker
of Plug-in-Gait's trial goes 13 cm off, and the ankle's angle 37 degrees. This and the constants above were chosen on
trials that `benchmarks.markers_fit` reports on: its figures are no test on recordings that were held back.
"""
_POSTURES = 40  # random ones, in which the generic body's distances are looked up
_RATE = 30.0  # [Hz] enough to follow a person from frame to frame
_ENOUGH = 300  # frames of a trial, of which the most different are taken
_ROUNDS = 3  # of calibration: poses of the whole trial, frames chosen anew, shape


@dataclass(frozen=True, eq=False)
class MarkerSubject:
    """A body of the subject's size that wears its markers.

    Parameters
    ----------
    body : Body, scaled; its marker set `marker_set` holds the K markers at the subject's own places.
    marker_set : str
    scales : (G,) of the generic body.
    scale_std : (G,) standard deviation of each.
    sigma : (K,) [m] how far each marker moved on its segment, along each axis.
    moved : (K,) [m] how far each marker was found from where the set has it; far ones may be mislabelled.
    rms : float [m] of all residuals (lengths) of the frames used, outliers left out.
    frames : how many were used.
    fit : of lengths and places together.
    """

    body: Body
    marker_set: str
    scales: NDArray
    scale_std: NDArray
    sigma: NDArray
    moved: NDArray
    rms: float
    frames: int
    fit: SubjectFit

    @property
    def points(self) -> PointSet:
        """The K markers on the body."""
        return self.body.markers(self.marker_set)


@checked
def fit_marker_subject(
    body: Body,
    trials: Markers | Sequence[Markers],
    marker_set: str | PathLike[str] | MarkerPlacement | None = None,
    *,
    frames: int = 80,
    height: float | None = None,
    progress: Progress | None = None,
) -> MarkerSubject:
    """Size of a body and places of the markers on it, from static or moving trials of one subject, all together.

    Where a trial moves a joint, its centre (and the knee's axis) comes from how the markers of both segments move;
    where it does not, from the landmarks that markers sit on and from proportions. A static trial alone so gives what
    scaling by landmarks would give.

    Parameters
    ----------
    body : Body, generic.
    trials : labelled; labels may carry a subject's prefix ("Anna:LASI").
    marker_set : see `bodies.marker_sets.find_placement`.
    frames : how many are used at most, those of most different postures.
    height : float [m] of the subject, barefoot.

    Raises
    ------
    ObservationError
        Too few labels are known, or they are those of two subjects; a unit that makes a giant of a person; a height or
        number of frames that cannot be.
    TrackingError
        No frame shows enough markers to start from.
    """
    trials = [trials] if isinstance(trials, Markers) else list(trials)
    if not trials or frames < 1 or (height is not None and not 0.3 < height < 3.0):
        raise ObservationError(
            f"{len(trials)} trials, {frames} frames, height {height}",
            remedy="Give one trial at least, one frame at least, and a height in metres.",
        )
    progress = progress or (lambda what, done, total: None)
    progress("marker offsets", 0, _ROUNDS)
    labels = dict.fromkeys(n for t in trials for n in t.names)
    placed = find_placement(body, labels, marker_set)
    given = [columns(t, placed.points.names)[:: _stride(t)] for t in trials]
    x = np.concatenate(given)
    if not np.isfinite(x).all(axis=2).any():
        raise ObservationError("none of the markers is seen in any frame", remedy="Is this the right recording?")
    starts = np.cumsum([0, *map(len, given)])
    seen = np.isfinite(x).all(axis=2)
    placed, x, seen = _worn(placed, x, seen)
    known = height / body.stature if height and body.stature else None
    size = known if known is not None else _first_size(body, placed, x)
    generic = replace(body, marker_sets={placed.name: placed.points}, surfaces=(), skin=None)  # no need to scale those
    lengths, groups = SegmentScales(generic, known, size), len(body.scale_groups)
    sigma = floor = np.hypot(_LEAST, _SLIDES * placed.spread)
    theta = np.concatenate([lengths.mean, np.zeros(3 * len(placed.points))])
    fitted, spread_factor = generic.scaled(np.exp(lengths.mean)), 1.0
    for turn in range(_ROUNDS):
        looseness = np.hypot(sigma, placed.spread) if turn == 0 else sigma
        roots, angles, good = _all_poses(fitted, fitted.markers(placed.name), x, starts, looseness)
        count = max((frames if turn else frames // 4) // len(trials), min(frames, 8))
        parts = [a + _spread_frames(seen[a:b], angles[a:b], good[a:b], count) for a, b in pairwise(starts)]
        chosen = np.concatenate(parts)
        if turn == 0:
            theta[groups:] = _moved(fitted, fitted.markers(placed.name), roots[good], angles[good], x[good]).ravel()
        away = np.linalg.norm(theta[groups:].reshape(-1, 3), axis=1)
        # A marker that is far from the set's place in all frames may have been placed there.
        spread = np.maximum(spread_factor * placed.spread, _FAR * away)
        found = joint.fit_subject(
            generic, Rig(()), [_measured(placed, x[f], sigma) for f in chosen],
            [BodyState(roots[f], angles[f]) for f in chosen], (lengths, PointOffsets(generic, placed.name, spread)),
            start=theta, reach=joint.REACH[-1:], rounds=1, looks=_INDEPENDENT * sum(len(p) > 0 for p in parts),
        )  # fmt: skip
        theta, fitted = found.mean, found.body
        stated = np.repeat(placed.spread, 3)
        variance = np.square(found.std[groups:] / stated)
        spread_factor = place_spread(theta[groups:] / stated, variance, spread_factor, 1.0)
        residuals = _residuals(found, placed.name, x[chosen])
        sigma = np.clip(_noise(residuals, len(chosen), body.tree.n_dofs), floor, _MOST)
        progress("marker offsets", turn + 1, _ROUNDS)
    inlier, scales = residuals < 5.0 * 1.7 * sigma, np.exp(theta[:groups])
    whole = body.scaled(scales)
    named = {**whole.marker_sets, **fitted.marker_sets}
    return MarkerSubject(
        replace(whole, marker_sets=named), placed.name, scales, scales * found.std[:groups], sigma,
        np.linalg.norm(theta[groups:].reshape(-1, 3), axis=1), float(np.sqrt(np.mean(residuals[inlier] ** 2))),
        len(chosen), found,
    )  # fmt: skip


def _stride(trial: Markers) -> int:
    """Which frames of a trial are enough: every so many."""
    return max(1, min(round(trial.rate / _RATE), len(trial) // _ENOUGH))


def _worn(placed: MarkerPlacement, x: NDArray, seen: NDArray) -> tuple[MarkerPlacement, NDArray, NDArray]:
    """Without markers that are never seen."""
    keep = seen.any(axis=0)
    return placed.select(placed.points.names[k] for k in np.flatnonzero(keep)), x[:, keep], seen[:, keep]


def _first_size(body: Body, placed: MarkerPlacement, x: NDArray) -> float:
    """How many times the generic body's size the subject has: by distances that postures change little."""
    rng, tree = np.random.default_rng(0), body.tree
    away = 0.5 * tree.spread * rng.normal(size=(_POSTURES, len(tree.usual)))
    angles = np.clip(tree.usual + away, tree.lower, tree.upper)
    angles = np.where(np.isfinite(angles), angles, 0.0)
    own = body.trajectories(np.tile(np.eye(4), (_POSTURES, 1, 1)), angles, placed.points)
    some = x[np.linspace(0, len(x) - 1, min(len(x), 100)).astype(int)]
    i, j = np.triu_indices(len(placed.points), 1)
    d_own = np.linalg.norm(own[:, i] - own[:, j], axis=2)
    with np.errstate(invalid="ignore"):
        d = np.linalg.norm(some[:, i] - some[:, j], axis=2)
    known = np.isfinite(d).any(axis=0) & (np.median(d_own, axis=0) > 0.1)
    if not known.any():
        return 1.0
    middle, middle_own = np.nanmedian(d[:, known], axis=0), np.median(d_own[:, known], axis=0)
    variance = np.var(d_own[:, known], axis=0) + placed.spread[i[known]] ** 2 + placed.spread[j[known]] ** 2
    weight = middle_own**2 / variance
    order = np.argsort(ratio := middle / middle_own)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    size = float(ratio[order][half])
    if not _SIZES[0] < size < _SIZES[1]:
        raise ObservationError(
            f"the person would be {size:.3g} times the body's size: the unit of the file is wrong",
            remedy="State the right one (--unit mm ...); or check that the labels are those of the marker set.",
        )
    return size


def _moved(body: Body, points: PointSet, roots: NDArray, angles: NDArray, x: NDArray) -> NDArray:
    """(K, 3) [m] by which every marker was seen beside its place on its segment, by the median over some frames.

    A set says which segment a marker sits on, but laboratories differ in where; to a robust fit that begins far away
    such a marker would be an outlier in every frame.
    """
    some = np.unique(np.linspace(0, len(x) - 1, min(len(x), 200)).astype(int))
    Ts = body.tree.segment_poses(roots[some], angles[some])[:, points.segments]
    local = np.einsum("fkji,fkj->fki", Ts[..., :3, :3], x[some] - Ts[..., :3, 3])
    with np.errstate(all="ignore"):
        return np.nan_to_num(np.nanmedian(local, axis=0) - points.points)


def _measured(placed: MarkerPlacement, x: NDArray, sigma: NDArray) -> list[Measurement]:
    """Markers (K, 3) [m] of one frame, those that were seen, each as sure as it sits on its segment."""
    here = np.flatnonzero(np.isfinite(x).all(axis=1))
    names = tuple(placed.points.names[k] for k in here)
    sensor = MarkerSensor("markers", 1.0, MARKER_LOSS, joint.REACH[-1], dict(zip(names, sigma[here].tolist())))
    return [MarkerMeasurement(sensor, names, np.ascontiguousarray(x[here]), placed.name, 0.0)]


def _all_poses(
    body: Body, points: PointSet, x: NDArray, starts: NDArray, sigma: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Roots (F, 4, 4), angles (F, D) of every frame of every trial, and which are to be believed (F,)."""
    parts, errors = [], []
    for a, b in pairwise(starts):
        try:
            parts.append(sequence_both_ways(body, points, x[a:b], sigma))
        except TrackingError as error:
            errors.append(error)
            parts.append((np.tile(np.eye(4), (b - a, 1, 1)), np.tile(body.tree.usual, (b - a, 1))))
            x = x.copy()
            x[a:b] = np.nan
    if len(errors) == len(parts):
        raise errors[0]
    roots, angles = (np.concatenate(p) for p in zip(*parts, strict=True))
    off = np.linalg.norm(x - body.trajectories(roots, angles, points), axis=2)
    enough = np.isfinite(off).sum(axis=1) >= min(6, len(points))
    with np.errstate(invalid="ignore"):
        ratio = np.nanmedian(np.where(enough[:, None], off / sigma, np.inf), axis=1)
    return roots, angles, enough & (ratio < 3.0 * max(float(np.nanmedian(ratio[enough])), 1.0))


def _spread_frames(seen: NDArray, angles: NDArray, good: NDArray, count: int) -> NDArray:
    """Frames of most different postures (farthest points), of those that show most of the markers."""
    usable = np.flatnonzero(good & (seen.sum(axis=1) >= 0.5 * seen.sum(axis=1).max(initial=0)))
    if not len(usable):
        return usable
    usable = usable[np.unique(np.linspace(0, len(usable) - 1, min(len(usable), 2000)).astype(int))]
    if len(usable) <= count:
        return usable
    a = angles[usable]
    chosen = [int(np.argmax(seen[usable].sum(axis=1)))]
    distance = np.sum((a - a[chosen[0]]) ** 2, axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.sum((a - a[chosen[-1]]) ** 2, axis=1))
    return np.sort(usable[chosen])


def _residuals(found: SubjectFit, marker_set: str, x: NDArray) -> NDArray:
    """(F, K) [m] lengths of residuals of the frames that a fit is of."""
    roots, angles = (np.stack([getattr(s, n) for s in found.states]) for n in ("T_world_root", "angles"))
    return np.linalg.norm(x - found.body.trajectories(roots, angles, found.body.markers(marker_set)), axis=2)


def _noise(residuals: NDArray, frames: int, dofs: int) -> NDArray:
    """(K,) [m] standard deviation of every marker along each axis, drawn together where there are few frames.

    Of three residuals in space the median length is 1.54 standard deviations; what a pose takes up is put back.
    """
    seen = np.isfinite(residuals)
    with np.errstate(all="ignore"):
        own = np.nanmedian(residuals, axis=0) / 1.538
        typical = float(np.nanmedian(residuals)) / 1.538
    count = seen.sum(axis=0)
    shrunk = np.sqrt((count * np.nan_to_num(own) ** 2 + 10 * typical**2) / (count + 10))
    free = 1.0 - min(dofs / max(3.0 * seen.sum() / max(frames, 1), 1.0), 0.75)
    return np.asarray(shrunk / np.sqrt(free))
