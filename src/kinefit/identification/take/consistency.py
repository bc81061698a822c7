"""How well points agree, as this or that label, with the labels around them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.findings import runs_of
from kinefit.identification.model.model import MarkerModel
from kinefit.solvers.rigid_clusters import rigid_frames

FLOOR = 0.004
"""[m] least deviation of a distance: skin and measurement, whatever a short training showed."""

FIRM = 0.03
"""[m] deviation beyond which a distance says nothing of who is who."""

LEVER = 0.03
"""[m] size across of markers that tell a rotation."""


class Consistency:
    """Distances of each label to those that hold them best; takes are identified and audited by it.

    Parameters
    ----------
    names : labels of the model, in the order of the positions that are judged; default: all, as they are
    count : of partners of each label
    floor, firm : [m] least deviation of a distance; deviation beyond which it says nothing
    """

    def __init__(
        self, model: MarkerModel, names: Sequence[str] | None = None, *, count: int = 8, floor: float = FLOOR,
        firm: float = FIRM,
    ):
        keep = [model.labels.index(n) for n in (model.labels if names is None else names)]
        place = {m: i for i, m in enumerate(keep)}
        segments = [tuple(place[m] for m in s if m in place) for s in model.segments]
        labels, square = len(keep), np.ix_(keep, keep)
        within = np.zeros((labels, labels), bool)
        for s in segments:
            within[np.ix_(s, s)] = True
        sigma = np.hypot(model.deviation[square], floor)
        rank = np.where(within, sigma, sigma + floor)  # of a segment first, if as firm
        np.fill_diagonal(rank, np.inf)
        self.spread = np.hypot(FLOOR, 0.5 * sigma)
        self.homes = [tuple(s for s in segments if m in s) for m in range(labels)]
        self.who = np.argsort(rank, axis=1)[:, : min(count, labels - 1)]
        self.mean = np.take_along_axis(np.asarray(model.mean)[square], self.who, 1)
        self.sigma = np.take_along_axis(sigma, self.who, 1)
        self.mean[self.sigma > firm] = np.nan

    def misfit(self, points: NDArray, positions: NDArray, label: int) -> NDArray:
        """(F,) deviations by which half of the distances of points (F, 3) as `label` are off; NaN where none tells."""
        who = self.who[label]
        d = np.linalg.norm(positions[:, who] - points[:, None], axis=-1)
        return _lower_middle(np.abs(d - self.mean[label]) / self.sigma[label])

    def misfits(self, points: NDArray, positions: NDArray) -> NDArray:
        """(F, M) the same for points (F, 3) as any label."""
        d = np.linalg.norm(positions - points[:, None], axis=-1)
        return _lower_middle(np.abs(d[:, self.who] - self.mean) / self.sigma)

    def lately(self, points: NDArray, frames: NDArray, positions: NDArray, label: int, reach: int) -> float:
        """Deviations by which points (n, 3) of frames (n,) are off as a label, by where it was just before and after.

        Each end is compared with the nearest frame within `reach` that shows the label, carried along by those around
        it; where fewer than three are seen at both times, by distances. NaN where there is none.
        """
        seen = np.isfinite(positions[:, label, 0])
        before = np.flatnonzero(seen[max(frames[0] - reach, 0) : frames[0]])
        after = np.flatnonzero(seen[frames[-1] + 1 : frames[-1] + 1 + reach])
        pairs = []
        if len(before):
            pairs.append((int(before[-1]) + max(int(frames[0]) - reach, 0), 0))
        if len(after):
            pairs.append((int(after[0]) + int(frames[-1]) + 1, -1))
        who, sigma = self.who[label], np.hypot(FLOOR, 0.5 * self.sigma[label])
        off = []
        for then, end in pairs:
            now = int(frames[end])
            _, told = self.carried(positions, then, now, points[end], label)
            if not np.isfinite(told):
                usual = np.linalg.norm(positions[then, who] - positions[then, label], axis=-1)
                away = np.linalg.norm(positions[now, who] - points[end], axis=-1)
                told = float(_lower_middle(np.abs(away - usual) / sigma))
            off.append(told)
        off = [o for o in off if np.isfinite(o)]
        return float(np.mean(off)) if off else np.nan

    def carried(self, positions: NDArray, then: int, now: int, point: NDArray, label: int) -> tuple[float, float]:
        """How far a point (3,) is off where a segment carried the label from one frame to another: [m], deviations.

        Of several segments, the one that it is least off; inf where none shows three other markers in both frames.
        """
        best = (np.inf, np.inf)
        for home in self.homes[label]:
            peers = [k for k in home if k != label and np.isfinite(positions[[then, now], k]).all()]
            x, y = positions[then, peers], positions[now, peers]
            if len(peers) < 3 or np.linalg.svd(x - x.mean(0), compute_uv=False)[1] < LEVER:
                continue
            R, t = rigid_frames(x, y[None])
            away = float(np.linalg.norm(R[0] @ positions[then, label] + t[0] - point))
            off = away / float(np.median(self.spread[label, peers]) * np.sqrt(3.0))
            best = (away, off) if off < best[1] else best
        return best

    def own(self, positions: NDArray) -> NDArray:
        """(F, M) misfit of every label where it is."""
        out = np.empty(positions.shape[:2])
        for m in range(positions.shape[1]):
            out[:, m] = self.misfit(positions[:, m], positions, m)
        return out


def _lower_middle(off: NDArray) -> NDArray:
    """Median along the last axis, the lower one of two; NaN where fewer than two are finite."""
    ordered = np.sort(off, axis=-1)  # NaN last
    seen = np.isfinite(ordered).sum(-1)
    middle = np.take_along_axis(ordered, np.maximum(seen - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    return np.where(seen >= 2, middle, np.nan)


def fill_gaps(
    model: MarkerModel, positions: NDArray, rate: float, longest: float = 0.5, alone: float = 0.1
) -> tuple[NDArray, NDArray]:
    """Positions (F, M, 3) with short gaps filled, and which were (F, M).

    A gap goes with its segment, where three others of it are seen throughout: their rigid motion, with what it misses
    at the gap's ends spread linearly. A shorter one goes along a cubic through its ends. Ends of the take stay open.

    Parameters
    ----------
    longest, alone : [s] of a gap that is filled with its segment; without it
    """
    out = np.array(positions)
    filled = np.zeros(out.shape[:2], bool)
    seen = np.isfinite(positions).all(-1)
    homes = [max((s for s in model.segments if m in s), key=len, default=()) for m in range(len(model))]
    for m, home in enumerate(homes):
        for first, last in gaps_of(seen[:, m]):
            if last - first + 1 > longest * rate:
                continue
            rows = np.arange(first - 1, last + 2)
            peers = [k for k in home if k != m and seen[rows, k].all()]
            at = None
            if len(peers) >= 3:
                at = _with_segment(positions[rows][:, peers], positions[[rows[0], rows[-1]], m], model.reference[peers])
            if at is None and last - first + 1 <= alone * rate:
                at = _cubic(positions[:, m], first, last)
            if at is not None:
                out[first : last + 1, m] = at
                filled[first : last + 1, m] = True
    return out, filled


def gaps_of(seen: NDArray) -> list[tuple[int, int]]:
    """First and last of each gap (F,) that has both ends."""
    return [(start, stop - 1) for start, stop in runs_of(~seen) if start and stop < len(seen)]


def _with_segment(peers: NDArray, ends: NDArray, x: NDArray) -> NDArray | None:
    """(n, 3) between the ends (2, 3) of a gap, as peers (n + 2, k, 3) move; None where they lie on a line."""
    if np.linalg.svd(x - x.mean(0), compute_uv=False)[1] < 0.02:  # [m]
        return None
    R, t = rigid_frames(x, peers)
    local = np.einsum("fji,fj->fi", R[[0, -1]], ends - t[[0, -1]])
    share = np.linspace(0.0, 1.0, len(peers))[1:-1, None]
    return np.einsum("fij,fj->fi", R[1:-1], (1 - share) * local[0] + share * local[1]) + t[1:-1]


def _cubic(x: NDArray, first: int, last: int) -> NDArray:
    """(n, 3) a cubic through both ends of a gap with their velocities, from the two frames beside them."""
    a, b = first - 1, last + 1
    span = b - a
    va = x[a] - x[a - 1] if a > 0 and np.isfinite(x[a - 1]).all() else (x[b] - x[a]) / span
    vb = x[b + 1] - x[b] if b + 1 < len(x) and np.isfinite(x[b + 1]).all() else (x[b] - x[a]) / span
    u = (np.arange(1, span) / span)[:, None]
    h00, h10 = 2 * u**3 - 3 * u**2 + 1, u**3 - 2 * u**2 + u
    h01, h11 = -2 * u**3 + 3 * u**2, u**3 - u**2
    return h00 * x[a] + h10 * span * va + h01 * x[b] + h11 * span * vb
