"""Solve a long take in overlapping windows, and keep the middle of each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from kinefit._threads import side_by_side
from kinefit.fitting.smoothing.process_noise import SmoothTake
from kinefit.fitting.smoothing.spool import Spool
from kinefit.sensors.base import Matched
from kinefit.solving.trajectory.smoothing import Posterior

_PASS_TOLERANCES = 1e-3, 1e-5  # of two passes, each of matching all other sensors and solving, at known process noise


def parts(frames: int, window: int, overlap: int) -> list[tuple[slice, slice]]:
    """Overlapping windows of equal length: for each the frames to solve, and the frames to keep of them.

    Parameters
    ----------
    frames, window, overlap : numbers of frames
    """
    if frames <= window:
        return [(slice(0, frames), slice(0, frames))]
    count = int(np.ceil((frames - overlap) / (window - overlap)))
    window = int(np.ceil((frames + (count - 1) * overlap) / count))  # no longer than needed: each frame costs
    starts = np.round(np.linspace(0, frames - window, count)).astype(int)
    cuts = [0, *((starts[1:] + starts[:-1] + window) // 2).tolist(), frames]
    return [(slice(int(a), int(a) + window), slice(cuts[i], cuts[i + 1])) for i, a in enumerate(starts)]


def solved(
    take: SmoothTake, window: int, overlap: int, tolerances: Sequence[float] = _PASS_TOLERANCES
) -> tuple[SmoothTake, Spool[tuple[Matched, ...]] | None]:
    """Solve a take in windows; returns it at its minimum, and the matches of all sensors but the keypoints.

    Parameters
    ----------
    window, overlap : numbers of frames
    tolerances : unitless, of each pass of matching and solving; without other sensors the last one alone is used
    """
    matched, windows = None, parts(len(take.roots), window, overlap)
    for tolerance in tolerances[-1:] if take.others is None else tolerances:
        fit = partial(SmoothTake.solved, tolerance=tolerance)
        roots, angles = np.array(take.roots), np.array(take.angles)
        matched = None if take.others is None else Spool[tuple[Matched, ...]]()
        fits = side_by_side(fit, linear_parts(take, windows, matched))
        for (whole, kept), found in zip(windows, fits, strict=True):
            inside = slice(kept.start - whole.start, kept.stop - whole.start)
            roots[kept], angles[kept] = found.roots[inside], found.angles[inside]
            take.pixels.release()
        take = replace(take, roots=roots, angles=angles)
    return take, matched


def solved_with_covariances(
    take: SmoothTake, window: int, overlap: int
) -> tuple[SmoothTake, Spool[NDArray], Spool[tuple[Matched, ...]] | None]:
    """As `solved`, with covariances: the upper triangle (n (n + 1) / 2,) of each frame's (n, n).

    The returned take also has the standard deviations of speeds.
    """
    if take.others is not None:
        take, _ = solved(take, window, overlap, _PASS_TOLERANCES[:-1])
    packed, windows = np.triu_indices(take.body.tree.n_dofs), parts(len(take.roots), window, overlap)
    roots, angles = np.array(take.roots), np.array(take.angles)
    covariances, speeds = Spool[NDArray](), []
    matched = None if take.others is None else Spool[tuple[Matched, ...]]()
    fits = side_by_side(SmoothTake.fit, linear_parts(take, windows, matched, judge=True))
    for whole, kept in windows:
        fit, post = next(fits)
        inside = slice(kept.start - whole.start, kept.stop - whole.start)
        roots[kept], angles[kept] = fit.roots[inside], fit.angles[inside]
        take.pixels.release()
        speeds.append(_speed_std(post, take.dt)[max(inside.start - 1, 0) : inside.stop - 1])
        for covariance in post.frames[inside]:
            covariances.append(covariance[packed])
        del fit, post  # large, while the next parts are fitted
    moving = np.concatenate(speeds)
    speed_std = np.percentile(moving, 90.0, axis=0) if len(moving) else None
    return replace(take, roots=roots, angles=angles, speed_std=speed_std), covariances, matched


def linear_parts(
    take: SmoothTake, windows: Sequence[tuple[slice, slice]], matched: Spool[tuple[Matched, ...]] | None, *,
    judge: bool = False,
) -> Iterator[SmoothTake]:  # fmt: skip
    """Windows of a take, with other sensors matched and linearised at its states; matches are added to `matched`."""
    spans, linear = [whole for whole, _ in windows], None
    if take.others is not None:
        linear = take.others.windows(take.roots, take.angles, spans, matched, judge=judge)
    for whole in spans:
        part = take.part(whole)
        yield part if linear is None else replace(part, linear=next(linear))


def _speed_std(post: Posterior, dt: float) -> NDArray:
    """(T - 1, n) [m/s, rad/s] standard deviation of each change to the next frame, without systematic errors."""
    own = np.einsum("tii->ti", post.frames)
    return np.sqrt(np.maximum(own[1:] + own[:-1] - 2.0 * np.einsum("tii->ti", post.following), 0.0)) / dt
