"""Fit a subject's body size and marker offsets jointly to one or several trials.

Fit the poses of a body to markers frame by frame, from a frame fitted without initial pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit.bodies import Body, BodyState, PointSet
from kinefit.bodies.marker_sets import MarkerPlacement, bare, find_placement, matched, subject_of
from kinefit.errors import ObservationError, TrackingError
from kinefit.fitting.initialization.from_points import pose_from_points
from kinefit.fitting.subject import fit as joint
from kinefit.fitting.subject.parameters import Gear, PointOffsets, SegmentScales, World, place_spread
from kinefit.fitting.subject.subject import SubjectFit
from kinefit.geometry.camera import Rig
from kinefit.geometry.losses import Loss
from kinefit.observations import Markers
from kinefit.sensors.base import Measurement
from kinefit.sensors.points.markers import MarkerMeasurement, MarkerSensor
from kinefit.sensors.settings import MARKER_LOSS
from kinefit.solving.trajectory.sequence import fit_sequence

_MIN_START_MARKERS = 6  # of the first frame
_MIN_START_SIGMA = 0.03  # [m] error of a body that does not have the subject's size yet
_MIN_FALL = 1.0  # of the cost to another, better minimum: less does not distinguish the two ends of a flat one
_GOOD_START_DISTANCE = 0.03  # [m] median distance at which no further start is tried


def columns(markers: Markers, names: Sequence[str]) -> NDArray:
    """(F, K, 3) [m] positions of the named markers of a recording; NaN for markers that it lacks.

    Labels are matched without subject, case and punctuation; exact spelling wins.

    Raises
    ------
    ObservationError
        A label belongs to more than one subject.
    """
    labels_of = matched(markers.names, names)
    is_exact = [label == bare(n) for n, label in zip(markers.names, labels_of)]
    where = {n: [i for i, label in enumerate(labels_of) if label == n] for n in names}
    where = {n: [i for i in candidates if is_exact[i]] or candidates for n, candidates in where.items()}
    duplicates = sorted(n for n, candidates in where.items() if len(candidates) > 1)
    if duplicates:
        raise ObservationError(
            f"{len(duplicates)} labels appear for more than one subject: {', '.join(duplicates[:6])}",
            file=markers.source or None, remedy="Fit one subject at a time: see `split_people`.",
        )
    out = np.full((len(markers), len(names), 3), np.nan)
    for k, name in enumerate(names):
        if where[name]:
            out[:, k] = markers.positions[:, where[name][0]]
    return out


def sequence_both_ways(
    body: Body, points: PointSet, x: NDArray, sigma: NDArray, *, start: BodyState | None = None,
    loss: Loss = MARKER_LOSS,
) -> tuple[NDArray, NDArray]:  # fmt: skip
    """Roots (F, 4, 4) and angles (F, D) [rad] of all frames, fitted forwards and backwards, each frame's better fit.

    A limb that is in a worse minimum stays there from frame to frame until the minima meet. The fit in the other
    direction enters these frames from their far end, in the better one.

    Parameters
    ----------
    points : K points of the body
    x, sigma : (F, K, 3), (K,) [m] positions, NaN where not visible, and standard deviations
    start : before the first frame; default: fitted without initial pose to the frame that shows most

    Raises
    ------
    TrackingError
        No frame shows enough markers to start from.
    """
    given: dict[str, Any] = {"sigma": sigma, "loss": loss, "posture": 1.0}
    if start is None:
        first, start = _start(body, points, x, sigma)
        start = fit_sequence(body, start, points, x[: first + 1][::-1], **given).last
    ahead = fit_sequence(body, start, points, x, **given)
    back = fit_sequence(body, ahead.last, points, x[::-1], **given)
    better = back.costs[::-1] < ahead.costs - _MIN_FALL
    return (
        np.where(better[:, None, None], back.Ts_world_root[::-1], ahead.Ts_world_root),
        np.where(better[:, None], back.angles[::-1], ahead.angles),
    )


def _start(body: Body, points: PointSet, x: NDArray, sigma: NDArray) -> tuple[int, BodyState]:
    """Index and state of the first frame: the best fit of a few frames with most visible markers."""
    count = np.isfinite(x).all(axis=2).sum(axis=1)
    if not count.max(initial=0) >= _MIN_START_MARKERS:
        raise TrackingError(
            f"no frame shows enough markers to start from: {int(count.max(initial=0))} at most",
            remedy=f"Give at least one frame with {_MIN_START_MARKERS} markers.",
        )
    most = np.flatnonzero(count == count.max())
    spread = np.maximum(sigma, _MIN_START_SIGMA)
    best: tuple[float, int, BodyState] | None = None
    for frame in most[np.unique(np.linspace(0, len(most) - 1, min(len(most), 4)).astype(int))]:
        state, residual = pose_from_points(body, points, x[frame], sigma=spread)
        if best is None or residual < best[0]:
            best = residual, int(frame), state
        if residual < _GOOD_START_DISTANCE:
            break
    assert best is not None
    return best[1], best[2]


MIN_LABELS = 4
"""Least number of a person's labels; fewer belong to an object ("Sync:Sync")."""


@checked
def split_people(markers: Markers) -> dict[str, Markers]:
    """Split markers by person: a dictionary from prefix to markers whose labels have no prefix.

    Without any prefixed person, all labels belong to one person called "". Otherwise the others are excluded.

    Raises
    ------
    ObservationError
        A label appears twice for one person.
    """
    columns: dict[str, list[int]] = {}
    for i, name in enumerate(markers.names):
        columns.setdefault(subject_of(name), []).append(i)
    prefixed = {person: indices for person, indices in columns.items() if person and len(indices) >= MIN_LABELS}
    people = prefixed or {"": list(range(len(markers.names)))}
    out = {}
    for person, indices in people.items():
        labels = tuple(bare(markers.names[i]) for i in indices)
        duplicates = sorted({n for n in labels if labels.count(n) > 1})
        if duplicates:
            raise ObservationError(
                f"labels appear twice{f' for {person}' if person else ''}: {', '.join(duplicates)}",
                file=markers.source or None, remedy="Name every marker of a person once.",
            )
        residual = None if markers.residual is None else markers.residual[:, indices]
        x, others = markers.positions[:, indices], people.keys() - {person}
        events = tuple(event for event in markers.events if event.subject not in others)
        out[person] = replace(markers, names=labels, positions=x, residual=residual, events=events)
    return out


Progress = Callable[[str, int, int], None]

_MIN_SIGMA = 0.005  # [m] of a marker on its segment
_MAX_SIGMA = 0.03  # [m]
_MIN_SPREAD_SHARE = 0.5  # least prior spread of a marker, as a share of its distance from the set's place
_SLIDING_SHARE = 0.1  # least sigma as a share of the prior spread: markers on soft parts slide more than on bone
_SIZE_RANGE = 0.3, 3.0  # relative to the generic body; outside, the unit is wrong
_INDEPENDENT_FRAMES = 1.0
"""Weight of all frames of one trial, as a number of frames with independent errors.

Marker errors are systematic: skin slides with the posture, and joints are no exact balls or hinges. Of 0.5, 1, 2, 4, 16
and 80, values from 0.5 to 2 give the best joint centres for four laboratories' subjects (15 to 16 mm; 20 mm with 16).
With errors counted as in `subject.excess`, the left toe marker of Plug-in-Gait's trial is 13 cm off, the ankle's angle
37 degrees. This and the constants above were chosen on the trials of benchmark `markers_fit`, which are no test set.
"""
_RANDOM_POSTURES = 40  # of the generic body, for the first estimate of the size
_MAX_RATE_HZ = 30.0  # trials are thinned to this rate
_MIN_FRAMES = 300  # kept when thinning a trial
_CALIBRATION_ROUNDS = 3  # poses of all frames, selection of frames, subject fit


@dataclass(frozen=True, eq=False)
class MarkerSubject:
    """A body of the subject's size with its marker offsets.

    Parameters
    ----------
    body : Body, scaled; its marker set `marker_set` holds the K markers at the subject's offsets.
    marker_set : name of the set
    scales : (G,) factor on the generic body per scale group.
    scale_std : (G,) standard deviation of each.
    sigma : (K,) [m] standard deviation of each marker on its segment, along each axis.
    moved : (K,) [m] distance of each marker from the set's place; a large one may be mislabelled.
    rms : [m] root mean square of the residuals' lengths in the frames used, without outliers.
    frames : number of frames used.
    fit : joint fit of lengths and offsets.
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
    """Fit body size, marker offsets and unknown gear jointly to static or moving trials of one subject.

    If a trial moves a joint, its centre (and the knee's axis) follows from the markers of both segments. Otherwise it
    follows from the landmarks under the markers and from proportions, so a static trial gives scaling by landmarks.

    Parameters
    ----------
    body : Body, generic.
    trials : labelled; labels may carry a subject's prefix ("Anna:LASI").
    marker_set : see `bodies.marker_sets.find_placement`.
    frames : most frames used, those with the most different postures.
    height : [m] of the subject, barefoot. Default: estimated from the markers.
    progress : (what, done, total) -> None

    Raises
    ------
    ObservationError
        Too few labels are known, labels belong to two subjects, the unit gives an impossible size, or `height` or
        `frames` is out of range.
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
    progress("marker offsets", 0, _CALIBRATION_ROUNDS)
    labels = dict.fromkeys(n for t in trials for n in t.names)
    placed = find_placement(body, labels, marker_set)
    positions = [columns(t, placed.points.names)[:: _stride(t)] for t in trials]
    x = np.concatenate(positions)
    if not np.isfinite(x).all(axis=2).any():
        raise ObservationError("none of the markers is visible in any frame", remedy="Check the choice of recording.")
    starts = np.cumsum([0, *map(len, positions)])
    visible = np.isfinite(x).all(axis=2)
    placed, x, visible = _visible_markers(placed, x, visible)
    known = height / body.stature if height and body.stature else None
    size = known if known is not None else first_size(body, placed, x)
    generic = replace(body, marker_sets={placed.name: placed.points}, surfaces=(), skin=None)
    lengths, groups, gear = SegmentScales(generic, known, size), len(body.scale_groups), Gear(generic)
    own = slice(groups + len(gear.names), None)  # offsets of markers, which sit on gear that is in its place
    sigma = floor = np.hypot(_MIN_SIGMA, _SLIDING_SHARE * placed.spread)
    theta = np.concatenate([lengths.mean, gear.mean, np.zeros(3 * len(placed.points))])
    fitted, spread_factor = generic.scaled(np.exp(lengths.mean)), 1.0
    for round_ in range(_CALIBRATION_ROUNDS):
        looseness = np.hypot(sigma, placed.spread) if round_ == 0 else sigma
        roots, angles, good = _all_poses(fitted, fitted.markers(placed.name), x, starts, looseness)
        count = max((frames if round_ else frames // 4) // len(trials), min(frames, 8))
        parts = [a + _spread_frames(visible[a:b], angles[a:b], good[a:b], count) for a, b in pairwise(starts)]
        chosen = np.concatenate(parts)
        if round_ == 0:
            theta[own] = _shifts(fitted, fitted.markers(placed.name), roots[good], angles[good], x[good]).ravel()
        shifts = np.linalg.norm(theta[own].reshape(-1, 3), axis=1)
        # A marker far from the set's place in all frames may have been placed there.
        spread = np.maximum(spread_factor * placed.spread, _MIN_SPREAD_SHARE * shifts)
        found = joint.fit_subject(
            generic, Rig(()), [_measured(placed, x[f], sigma) for f in chosen],
            [BodyState(roots[f], angles[f]) for f in chosen],
            (lengths, *[gear] * bool(gear.names), PointOffsets(generic, placed.name, spread)), start=theta,
            reach=joint.REACH[-1:], rounds=1, looks=_INDEPENDENT_FRAMES * sum(len(p) > 0 for p in parts),
        )  # fmt: skip
        theta, fitted = found.mean, found.body
        prior_spread = np.repeat(placed.spread, 3)
        variance = np.square(found.std[own] / prior_spread)
        spread_factor = place_spread(theta[own] / prior_spread, variance, spread_factor, 1.0)
        residuals = _residuals(found, placed.name, x[chosen])
        sigma = np.clip(_noise(residuals, len(chosen), body.tree.n_dofs), floor, _MAX_SIGMA)
        progress("marker offsets", round_ + 1, _CALIBRATION_ROUNDS)
    inlier, scales = residuals < 5.0 * 1.7 * sigma, np.exp(theta[:groups])
    whole = gear.apply(World(body.scaled(scales), Rig(())), theta[groups : own.start]).body
    named = {**whole.marker_sets, **fitted.marker_sets}
    return MarkerSubject(
        replace(whole, marker_sets=named), placed.name, scales, scales * found.std[:groups], sigma,
        np.linalg.norm(theta[own].reshape(-1, 3), axis=1), float(np.sqrt(np.mean(residuals[inlier] ** 2))),
        len(chosen), found,
    )  # fmt: skip


def _stride(trial: Markers) -> int:
    """Step by which a trial is thinned."""
    return max(1, min(round(trial.rate / _MAX_RATE_HZ), len(trial) // _MIN_FRAMES))


def _visible_markers(placed: MarkerPlacement, x: NDArray, seen: NDArray) -> tuple[MarkerPlacement, NDArray, NDArray]:
    """Remove markers that are never visible."""
    keep = seen.any(axis=0)
    return placed.select(placed.points.names[k] for k in np.flatnonzero(keep)), x[:, keep], seen[:, keep]


def first_size(body: Body, placed: MarkerPlacement, x: NDArray) -> float:
    """Size of the subject relative to the generic body, from distances that hardly depend on posture."""
    rng, tree = np.random.default_rng(0), body.tree
    away = 0.5 * tree.spread * rng.normal(size=(_RANDOM_POSTURES, len(tree.usual)))
    angles = np.clip(tree.usual + away, tree.lower, tree.upper)
    angles = np.where(np.isfinite(angles), angles, 0.0)
    body_points = body.trajectories(np.tile(np.eye(4), (_RANDOM_POSTURES, 1, 1)), angles, placed.points)
    sample = x[np.linspace(0, len(x) - 1, min(len(x), 100)).astype(int)]
    i, j = np.triu_indices(len(placed.points), 1)
    d_own = np.linalg.norm(body_points[:, i] - body_points[:, j], axis=2)
    with np.errstate(invalid="ignore"):
        d = np.linalg.norm(sample[:, i] - sample[:, j], axis=2)
    known = np.isfinite(d).any(axis=0) & (np.median(d_own, axis=0) > 0.1)
    if not known.any():
        return 1.0
    middle, middle_own = np.nanmedian(d[:, known], axis=0), np.median(d_own[:, known], axis=0)
    variance = np.var(d_own[:, known], axis=0) + placed.spread[i[known]] ** 2 + placed.spread[j[known]] ** 2
    weight = middle_own**2 / variance
    order = np.argsort(ratio := middle / middle_own)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    size = float(ratio[order][half])
    if not _SIZE_RANGE[0] < size < _SIZE_RANGE[1]:
        raise ObservationError(
            f"the person would be {size:.3g} times the body's size: the unit of the file is wrong",
            remedy="State the right one (--unit mm ...); or check that the labels are those of the marker set.",
        )
    return size


def _shifts(body: Body, points: PointSet, roots: NDArray, angles: NDArray, x: NDArray) -> NDArray:
    """(K, 3) [m] median shift of every marker from its place on its segment, over some frames.

    Laboratories place markers differently; a robust fit that starts far away would treat them as outliers.
    """
    some = np.unique(np.linspace(0, len(x) - 1, min(len(x), 200)).astype(int))
    Ts = body.tree.segment_poses(roots[some], angles[some])[:, points.segments]
    local = np.einsum("fkji,fkj->fki", Ts[..., :3, :3], x[some] - Ts[..., :3, 3])
    with np.errstate(all="ignore"):
        return np.nan_to_num(np.nanmedian(local, axis=0) - points.points)


def _measured(placed: MarkerPlacement, x: NDArray, sigma: NDArray) -> list[Measurement]:
    """Measurement of the visible markers (K, 3) [m] of one frame, with standard deviations sigma (K,) [m]."""
    here = np.flatnonzero(np.isfinite(x).all(axis=1))
    names = tuple(placed.points.names[k] for k in here)
    sensor = MarkerSensor("markers", 1.0, MARKER_LOSS, joint.REACH[-1], dict(zip(names, sigma[here].tolist())))
    return [MarkerMeasurement(sensor, names, np.ascontiguousarray(x[here]), placed.name, 0.0)]


def _all_poses(
    body: Body, points: PointSet, x: NDArray, starts: NDArray, sigma: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Roots (F, 4, 4) and angles (F, D) of every frame of all trials, and whether each fits (F,)."""
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
    distances = np.linalg.norm(x - body.trajectories(roots, angles, points), axis=2)
    visible = np.isfinite(distances).sum(axis=1) >= min(6, len(points))
    with np.errstate(invalid="ignore"):
        ratio = np.nanmedian(np.where(visible[:, None], distances / sigma, np.inf), axis=1)
    return roots, angles, visible & (ratio < 3.0 * max(float(np.nanmedian(ratio[visible])), 1.0))


def _spread_frames(visible: NDArray, angles: NDArray, is_good: NDArray, count: int) -> NDArray:
    """Indices of the most different postures by farthest-point sampling, among well visible frames."""
    usable = np.flatnonzero(is_good & (visible.sum(axis=1) >= 0.5 * visible.sum(axis=1).max(initial=0)))
    if not len(usable):
        return usable
    usable = usable[np.unique(np.linspace(0, len(usable) - 1, min(len(usable), 2000)).astype(int))]
    if len(usable) <= count:
        return usable
    a = angles[usable]
    chosen = [int(np.argmax(visible[usable].sum(axis=1)))]
    distance = np.sum((a - a[chosen[0]]) ** 2, axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.sum((a - a[chosen[-1]]) ** 2, axis=1))
    return np.sort(usable[chosen])


def _residuals(found: SubjectFit, marker_set: str, x: NDArray) -> NDArray:
    """(F, K) [m] lengths of the residuals in the frames of a fit."""
    roots, angles = (np.stack([getattr(s, n) for s in found.states]) for n in ("T_world_root", "angles"))
    return np.linalg.norm(x - found.body.trajectories(roots, angles, found.body.markers(marker_set)), axis=2)


def _noise(residuals: NDArray, frames: int, dofs: int) -> NDArray:
    """(K,) [m] standard deviation of every marker along each axis, shrunk to the common one if there are few frames.

    The median length of a residual in space is 1.54 standard deviations. Corrected for the degrees of freedom.
    """
    visible = np.isfinite(residuals)
    with np.errstate(all="ignore"):
        marker_sigma = np.nanmedian(residuals, axis=0) / 1.538
        typical = float(np.nanmedian(residuals)) / 1.538
    count = visible.sum(axis=0)
    shrunk = np.sqrt((count * np.nan_to_num(marker_sigma) ** 2 + 10 * typical**2) / (count + 10))
    freedom = 1.0 - min(dofs / max(3.0 * visible.sum() / max(frames, 1), 1.0), 0.75)
    return np.asarray(shrunk / np.sqrt(freedom))
