"""Errors that the points of one segment share: a head that is seen 7 px too far left has all of its points there.

Eleven points of a face then tell little more of where the head is than one does, and far less than eleven points of
joints would. What is shared is found from the take: of two points of one segment in one view the products of what a
fit leaves over.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.sensors.channels import Channels

_SAMPLES = 30.0  # looks at pairs of points that count as much as knowing nothing of what they share
_MOST = 0.8  # of a point's variance that may be shared


def members(channels: Channels) -> NDArray:
    """(N,) int: number of the group of points of one source and segment that a channel is of; -1 where it is alone."""
    segment = channels.points.segments[channels.column] if len(channels.column) else channels.column
    out = np.full(len(segment), -1)
    keys = channels.source * (segment.max(initial=0) + 1) + segment
    found, index, count = np.unique(keys, return_inverse=True, return_counts=True)
    several = np.flatnonzero(count > 1)
    number = np.full(len(found), -1)
    number[several] = np.arange(len(several))
    out[:] = number[index]
    return out


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """What channels of one group have in common: a shift [px] along u and along v, new in every frame.

    Parameters
    ----------
    member : (N,) int, group of each channel, -1 for none
    share : (N,) of its variance that a channel has in common with its group
    variance : (G,) [px²] of each group's shift
    """

    member: NDArray
    share: NDArray
    variance: NDArray

    @classmethod
    def of(cls, channels: Channels, share: NDArray, sigma: NDArray) -> SharedErrors:
        """Of shares (N,) of what channels err by, sigma (N,) [px] at full confidence."""
        grouped = members(channels)
        share = np.where(grouped >= 0, share, 0.0)
        used, index = np.unique(grouped[share > 0], return_inverse=True)
        member = np.full(len(grouped), -1)
        member[share > 0] = index
        common = np.bincount(index, (share * np.square(sigma))[share > 0], len(used))
        return cls(member, share, common / np.bincount(index, minlength=len(used)))

    @classmethod
    def none(cls, count: int) -> SharedErrors:
        """Of so many channels that each err for themselves."""
        return cls(np.full(count, -1), np.zeros(count), np.zeros(0))

    def whitened(self, columns: NDArray, weight: NDArray, channel: NDArray) -> NDArray:
        """Rows (R, k), u and v of each channel (R,) in turn, whitened by all of their errors.

        They come whitened by weights (N,) [1/px²] of own errors alone: by the square root of a diagonal D, in place of
        that of D - D 1 (1/U + 1ᵀ D 1)⁻¹ 1ᵀ D of each group.
        """
        grouped = self.member[channel] >= 0
        if not grouped.any():
            return columns
        key = 2 * self.member[channel] + np.arange(len(channel)) % 2
        key, root = key[grouped], np.sqrt(weight[channel[grouped]])
        total = np.bincount(key, root**2, 2 * len(self.variance))
        sums = np.zeros((len(total), columns.shape[1]))
        np.add.at(sums, key, root[:, None] * columns[grouped])
        less = (1.0 - 1.0 / np.sqrt(1.0 + np.repeat(self.variance, 2) * total)) / np.maximum(total, 1e-30)
        out = np.array(columns)
        out[grouped] -= (less[key] * root)[:, None] * sums[key]
        return out

    def sums(self, rows: NDArray, channel: NDArray) -> NDArray:
        """(2 G, k) sums of rows (R, k) of each group along u and v."""
        grouped = self.member[channel] >= 0
        key = 2 * self.member[channel] + np.arange(len(channel)) % 2
        out = np.zeros((2 * len(self.variance), rows.shape[1]))
        np.add.at(out, key[grouped], rows[grouped])
        return out


def shared_by(channels: Channels, left: NDArray, variance: NDArray, looks: float) -> NDArray:
    """(N,) share of each channel's variance that all points of its group have in common, 0 where it is alone.

    Segments of a keypoint set are judged over all views, left and right as one; where they are seen rarely, they share
    as much as the others of their set do.

    Parameters
    ----------
    left : (T, N, 2) [px] measured minus fitted, NaN for outliers and where unseen.
    variance : (T, N) [px²] of where the fit sees the points, u and v together: what it follows of the errors.
    looks : independent looks that one frame amounts to.
    """
    member, out = members(channels), np.zeros(len(channels.column))
    lowest = np.minimum(channels.column, channels.column[channels.partner])
    sums: dict[int, dict[tuple[int, ...], NDArray]] = {}
    groups: dict[tuple[int, ...], list[int]] = {}
    for g in range(int(member.max(initial=-1)) + 1):
        mine = member == g
        points = tuple(np.unique(lowest[mine]).tolist())
        first = next(i for i, span in enumerate(channels.sets.values()) if span.start <= points[0] < span.stop)
        told = _in_common(left[:, mine], variance[:, mine]) * (1.0, 1.0, looks)
        of_set = sums.setdefault(first, {})
        of_set[points] = of_set.get(points, 0.0) + told
        groups.setdefault(points, []).append(g)
    for of_set in sums.values():
        whole = _share(np.sum(list(of_set.values()), axis=0), 0.0)
        for points, told in of_set.items():
            out[np.isin(member, groups[points])] = _share(told, whole)
    return out


def _in_common(left: NDArray, variance: NDArray) -> NDArray:
    """Sums over frames of what pairs of a group's points have in common, and of their whole variance [px²]; frames.

    left (T, M, 2), variance (T, M) as of `shared_by`; every frame counts alike, however many pairs it has.
    """
    seen = np.isfinite(left).all(axis=2)
    count = seen.sum(axis=1)
    some = count > 1
    r, n = np.where(seen[..., None], left, 0.0)[some], count[some]
    followed = np.where(seen, variance, 0.0)[some].sum(axis=1) / n
    squares = np.square(r).sum(axis=(1, 2))
    products = (np.square(r.sum(axis=1)).sum(axis=1) - squares) / (n * (n - 1))
    return np.array([np.sum(products + followed), np.sum(squares / n + followed), len(n)])


def _share(told: NDArray, usual: float) -> float:
    """Of sums as of `_in_common`, the frames as looks; as `usual` where these are few."""
    common, whole, looks = told
    known = looks / (looks + _SAMPLES)
    own = common / whole if whole > 0 else usual
    return float(np.clip(known * own + (1.0 - known) * usual, 0.0, _MOST))
