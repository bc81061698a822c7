"""Measure how well points fit labels, by their distances to the labels around them; fill short gaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.findings import runs_of
from kinefit.markers.model.model import MarkerModel
from kinefit.solving.functional_joints import rigid_frames

MIN_SIGMA = 0.004
"""[m] lower bound of the standard deviation of a distance: skin and measurement noise."""

MAX_SIGMA = 0.03
"""[m] distances with a larger standard deviation are ignored."""

MIN_SPREAD = 0.03
"""[m] least extent across of markers that determine a rotation."""


class Consistency:
    """Compares each label's distances to its most rigid partners with the model.

    Parameters
    ----------
    names : labels of the model in the order of the positions; default: all in the model's order
    count : number of partners of each label
    floor, firm : [m] lower bound of a distance's standard deviation; distances with more than `firm` are ignored
    """

    def __init__(
        self, model: MarkerModel, names: Sequence[str] | None = None, *, count: int = 8, floor: float = MIN_SIGMA,
        firm: float = MAX_SIGMA,
    ):
        keep = [model.labels.index(n) for n in (model.labels if names is None else names)]
        place = {m: i for i, m in enumerate(keep)}
        segments = [tuple(place[m] for m in s if m in place) for s in model.segments]
        labels, square = len(keep), np.ix_(keep, keep)
        within = np.zeros((labels, labels), bool)
        for s in segments:
            within[np.ix_(s, s)] = True
        sigma = np.hypot(model.deviation[square], floor)
        rank = np.where(within, sigma, sigma + floor)  # at equal deviation, partners of the same segment first
        np.fill_diagonal(rank, np.inf)
        self.spread = np.hypot(MIN_SIGMA, 0.5 * sigma)
        self.segments_of = [tuple(s for s in segments if m in s) for m in range(labels)]
        self.partners = np.argsort(rank, axis=1)[:, : min(count, labels - 1)]
        self.mean = np.take_along_axis(np.asarray(model.mean)[square], self.partners, 1)
        self.sigma = np.take_along_axis(sigma, self.partners, 1)
        self.mean[self.sigma > firm] = np.nan

    def misfit(self, points: NDArray, positions: NDArray, label: int) -> NDArray:
        """(F,) median error of the distances of points (F, 3) as `label`, in standard deviations; NaN if unknown.

        positions : (F, M, 3) [m] of all labels; NaN where not visible
        """
        partners = self.partners[label]
        d = np.linalg.norm(positions[:, partners] - points[:, None], axis=-1)
        return _lower_median(np.abs(d - self.mean[label]) / self.sigma[label])

    def misfits(self, points: NDArray, positions: NDArray) -> NDArray:
        """(F, M) median error of points (F, 3) [m] as each label, in standard deviations; see `misfit`."""
        d = np.linalg.norm(positions - points[:, None], axis=-1)
        return _lower_median(np.abs(d[:, self.partners] - self.mean) / self.sigma)

    def recent_misfit(self, points: NDArray, frames: NDArray, positions: NDArray, label: int, reach: int) -> float:
        """Error of points (n, 3) [m] in frames (n,) as a label in nearby frames, in standard deviations.

        Each end is compared with the nearest frame within `reach` frames that shows the label, moved with its segment,
        or by distances where fewer than three markers of it are visible. NaN without such a frame.
        """
        visible = np.isfinite(positions[:, label, 0])
        before = np.flatnonzero(visible[max(frames[0] - reach, 0) : frames[0]])
        after = np.flatnonzero(visible[frames[-1] + 1 : frames[-1] + 1 + reach])
        pairs = []
        if len(before):
            pairs.append((int(before[-1]) + max(int(frames[0]) - reach, 0), 0))
        if len(after):
            pairs.append((int(after[0]) + int(frames[-1]) + 1, -1))
        partners, sigma = self.partners[label], np.hypot(MIN_SIGMA, 0.5 * self.sigma[label])
        errors = []
        for then, end in pairs:
            now = int(frames[end])
            _, error = self.motion_misfit(positions, then, now, points[end], label)
            if not np.isfinite(error):
                distances = np.linalg.norm(positions[then, partners] - positions[then, label], axis=-1)
                measured = np.linalg.norm(positions[now, partners] - points[end], axis=-1)
                error = float(_lower_median(np.abs(measured - distances) / sigma))
            errors.append(error)
        errors = [o for o in errors if np.isfinite(o)]
        return float(np.mean(errors)) if errors else np.nan

    def motion_misfit(self, positions: NDArray, then: int, now: int, point: NDArray, label: int) -> tuple[float, float]:
        """Distance of a point (3,) from the label's place predicted by its segment: [m], and in standard deviations.

        Of several segments the best counts; inf if none shows three other markers in both frames `then` and `now`.
        """
        best = (np.inf, np.inf)
        for segment in self.segments_of[label]:
            peers = [k for k in segment if k != label and np.isfinite(positions[[then, now], k]).all()]
            x, y = positions[then, peers], positions[now, peers]
            if len(peers) < 3 or np.linalg.svd(x - x.mean(0), compute_uv=False)[1] < MIN_SPREAD:
                continue
            R, t = rigid_frames(x, y[None])
            distance = float(np.linalg.norm(R[0] @ positions[then, label] + t[0] - point))
            sigmas = distance / float(np.median(self.spread[label, peers]) * np.sqrt(3.0))
            best = (distance, sigmas) if sigmas < best[1] else best
        return best

    def own(self, positions: NDArray) -> NDArray:
        """(F, M) misfit of every label at its own position, in standard deviations; see `misfit`."""
        out = np.empty(positions.shape[:2])
        for m in range(positions.shape[1]):
            out[:, m] = self.misfit(positions[:, m], positions, m)
        return out


def _lower_median(values: NDArray) -> NDArray:
    """Lower median along the last axis; NaN if fewer than two values are finite."""
    ordered = np.sort(values, axis=-1)  # NaN last
    counts = np.isfinite(ordered).sum(-1)
    middle = np.take_along_axis(ordered, np.maximum(counts - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    return np.where(counts >= 2, middle, np.nan)


def fill_gaps(
    model: MarkerModel, positions: NDArray, rate: float, longest: float = 0.5, alone: float = 0.1
) -> tuple[NDArray, NDArray]:
    """Fill short gaps: positions (F, M, 3) [m], and which were filled (F, M) bool.

    A gap follows the rigid motion of its segment if three other markers are visible throughout; the error at its ends
    is interpolated linearly. Otherwise a short gap follows a cubic through its ends. Gaps at the take's ends stay open.

    Parameters
    ----------
    positions : (F, M, 3) [m]; NaN where not visible
    rate : [Hz]
    longest, alone : [s] longest gap filled by its segment; by a cubic
    """
    out = np.array(positions)
    filled = np.zeros(out.shape[:2], bool)
    visible = np.isfinite(positions).all(-1)
    segments = [max((s for s in model.segments if m in s), key=len, default=()) for m in range(len(model))]
    for m, segment in enumerate(segments):
        for first, last in gaps_of(visible[:, m]):
            if last - first + 1 > longest * rate:
                continue
            rows = np.arange(first - 1, last + 2)
            peers = [k for k in segment if k != m and visible[rows, k].all()]
            x = None
            if len(peers) >= 3:
                x = _with_segment(positions[rows][:, peers], positions[[rows[0], rows[-1]], m], model.reference[peers])
            if x is None and last - first + 1 <= alone * rate:
                x = _cubic(positions[:, m], first, last)
            if x is not None:
                out[first : last + 1, m] = x
                filled[first : last + 1, m] = True
    return out, filled


def gaps_of(seen: NDArray) -> list[tuple[int, int]]:
    """First and last frame of each gap in seen (F,) bool that has both ends."""
    return [(start, stop - 1) for start, stop in runs_of(~seen) if start and stop < len(seen)]


def _with_segment(peers: NDArray, ends: NDArray, x: NDArray) -> NDArray | None:
    """(n, 3) [m] between the ends (2, 3) of a gap, moved with peers (n + 2, k, 3); None if these lie on a line."""
    if np.linalg.svd(x - x.mean(0), compute_uv=False)[1] < 0.02:  # [m]
        return None
    R, t = rigid_frames(x, peers)
    local = np.einsum("fji,fj->fi", R[[0, -1]], ends - t[[0, -1]])
    share = np.linspace(0.0, 1.0, len(peers))[1:-1, None]
    return np.einsum("fij,fj->fi", R[1:-1], (1 - share) * local[0] + share * local[1]) + t[1:-1]


def _cubic(x: NDArray, first: int, last: int) -> NDArray:
    """(n, 3) [m] cubic between the ends of a gap with the velocities of the adjacent frames."""
    from scipy.interpolate import CubicHermiteSpline

    a, b = first - 1, last + 1
    span = b - a
    va = x[a] - x[a - 1] if a > 0 and np.isfinite(x[a - 1]).all() else (x[b] - x[a]) / span
    vb = x[b + 1] - x[b] if b + 1 < len(x) and np.isfinite(x[b + 1]).all() else (x[b] - x[a]) / span
    return CubicHermiteSpline([a, b], [x[a], x[b]], [va, vb])(np.arange(first, b))
