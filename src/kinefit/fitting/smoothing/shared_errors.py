"""Estimate errors that the points of one segment share: a head detected 7 px too far left has all its points there.

Eleven points of a face then determine the head's place little better than one point, and far worse than eleven points
of joints. The shared part is estimated from the take, from products of residuals of two points of one segment in one
view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.sensors.channels import Channels

_PRIOR_MEASUREMENTS = 30.0  # independent measurements of pairs that the prior value of a share counts as
_MAX_SHARE = 0.8  # of a point's variance that may be shared


def members(channels: Channels) -> NDArray:
    """(N,) int: number of each channel's group, the points of one source and segment; -1 for a single point."""
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
    """Errors that channels of one group share: a shift [px] along u and along v, independent in every frame.

    Parameters
    ----------
    member : (N,) int, group of each channel, -1 for none
    share : (N,) of a channel's variance that its group shares
    variance : (G,) [px²] of each group's shift
    """

    member: NDArray
    share: NDArray
    variance: NDArray

    @classmethod
    def of(cls, channels: Channels, share: NDArray, sigma: NDArray) -> SharedErrors:
        """Shared errors from shares (N,) of the channels' variances, with sigma (N,) [px] at full confidence."""
        grouped = members(channels)
        share = np.where(grouped >= 0, share, 0.0)
        used, index = np.unique(grouped[share > 0], return_inverse=True)
        member = np.full(len(grouped), -1)
        member[share > 0] = index
        common = np.bincount(index, (share * np.square(sigma))[share > 0], len(used))
        return cls(member, share, common / np.bincount(index, minlength=len(used)))

    @classmethod
    def none(cls, count: int) -> SharedErrors:
        """No shared errors, for a number of channels."""
        return cls(np.full(count, -1), np.zeros(count), np.zeros(0))

    def whitened(self, columns: NDArray, weight: NDArray, channel: NDArray) -> NDArray:
        """Rows (R, k) whitened by own and shared errors; u and v of each channel (R,) alternate.

        The given rows are whitened by the weights (N,) [1/px²] of own errors alone, the square root of a diagonal D.
        The result is whitened by the square root of D - D 1 (1/U + 1ᵀ D 1)⁻¹ 1ᵀ D of each group.
        """
        grouped = self.member[channel] >= 0
        if not grouped.any():
            return columns
        key = 2 * self.member[channel] + np.arange(len(channel)) % 2
        key, root = key[grouped], np.sqrt(weight[channel[grouped]])
        total = np.bincount(key, root**2, 2 * len(self.variance))
        sums = np.zeros((len(total), columns.shape[1]))
        np.add.at(sums, key, root[:, None] * columns[grouped])
        removed = (1.0 - 1.0 / np.sqrt(1.0 + np.repeat(self.variance, 2) * total)) / np.maximum(total, 1e-30)
        out = np.array(columns)
        out[grouped] -= (removed[key] * root)[:, None] * sums[key]
        return out

    def sums(self, rows: NDArray, channel: NDArray) -> NDArray:
        """(2 G, k) sums of rows (R, k) over each group, along u and v, with the rows' channels (R,)."""
        grouped = self.member[channel] >= 0
        key = 2 * self.member[channel] + np.arange(len(channel)) % 2
        out = np.zeros((2 * len(self.variance), rows.shape[1]))
        np.add.at(out, key[grouped], rows[grouped])
        return out


def shared_by(channels: Channels, left: NDArray, variance: NDArray, looks: float) -> NDArray:
    """Estimate the share (N,) of each channel's variance that all points of its group share, 0 without a group.

    A segment of a keypoint set has one share for all views, and for left and right. Rarely detected segments get the
    share of their set.

    Parameters
    ----------
    left : (T, N, 2) [px] measured minus fitted, NaN for outliers and undetected points
    variance : (T, N) [px²] of the fitted points, u plus v: the part of the errors that the fit absorbs
    looks : number of independent measurements that one frame counts as, 1 at most
    """
    member, out = members(channels), np.zeros(len(channels.column))
    lowest = np.minimum(channels.column, channels.column[channels.partner])
    sums: dict[int, dict[tuple[int, ...], NDArray]] = {}
    groups: dict[tuple[int, ...], list[int]] = {}
    for g in range(int(member.max(initial=-1)) + 1):
        in_group = member == g
        points = tuple(np.unique(lowest[in_group]).tolist())
        first = next(i for i, span in enumerate(channels.sets.values()) if span.start <= points[0] < span.stop)
        group_sums = _pair_sums(left[:, in_group], variance[:, in_group]) * (1.0, 1.0, looks)
        of_set = sums.setdefault(first, {})
        of_set[points] = of_set.get(points, 0.0) + group_sums
        groups.setdefault(points, []).append(g)
    for of_set in sums.values():
        set_share = _share(np.sum(list(of_set.values()), axis=0), 0.0)
        for points, group_sums in of_set.items():
            out[np.isin(member, groups[points])] = _share(group_sums, set_share)
    return out


def _pair_sums(left: NDArray, variance: NDArray) -> NDArray:
    """(3,) sums over frames of the shared and of the whole variance [px²] of a group's points; number of frames.

    left (T, M, 2), variance (T, M): see `shared_by`. Every frame counts alike, whatever its number of pairs.
    """
    known = np.isfinite(left).all(axis=2)
    count = known.sum(axis=1)
    some = count > 1
    r, n = np.where(known[..., None], left, 0.0)[some], count[some]
    absorbed = np.where(known, variance, 0.0)[some].sum(axis=1) / n
    squares = np.square(r).sum(axis=(1, 2))
    products = (np.square(r.sum(axis=1)).sum(axis=1) - squares) / (n * (n - 1))
    return np.array([np.sum(products + absorbed), np.sum(squares / n + absorbed), len(n)])


def _share(sums: NDArray, prior: float) -> float:
    """Shared share of the variance from `_pair_sums`, shrunk towards `prior` if there are few measurements."""
    shared, whole, measurements = sums
    weight = measurements / (measurements + _PRIOR_MEASUREMENTS)
    own = shared / whole if whole > 0 else prior
    return float(np.clip(weight * own + (1.0 - weight) * prior, 0.0, _MAX_SHARE))
