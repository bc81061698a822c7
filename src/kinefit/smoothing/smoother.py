"""A whole take at once: every frame fitted together with a motion prior whose strength the take itself tells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState, PointSet
from kinefit.multiview.left_right import find_swaps, limb_groups
from kinefit.multiview.observability import SHORTEST, levers, near
from kinefit.sensors.channels import Channels
from kinefit.smoothing.foot_contacts import find_contacts
from kinefit.smoothing.gaps import bridged
from kinefit.smoothing.process_noise import INLIER, SmoothTake, Strength, enliven, estimate
from kinefit.smoothing.unwrap import unwrap
from kinefit.solvers.equations import Covariance, joint_std
from kinefit.tracking.tracker import FrameResult, Settings, informing, judged, prior_alone

_PARTS = 3  # of a long take, from which its strength is estimated
_ENOUGH = 6  # pixels that hold a root; with fewer a frame is lost
_LOOKS = 2  # at where the soles rest, the second with them held


def smooth_results(
    body: Body,
    channels: Channels,
    results: Sequence[FrameResult],
    rate: float,
    settings: Settings,
    *,
    contacts: bool = False,
    up: str = "z",
    window: int = 600,
    overlap: int = 60,
) -> tuple[list[FrameResult], dict[str, Any]]:
    """Tracked frames, smoothed together.

    Outliers and exchanged sides are those of the track, judged anew once.

    Parameters
    ----------
    results : F frames from a `Tracker`.
    rate : float [Hz]
    contacts : bool
        Hold the soles still where they rest on a level floor; `up` is the world's vertical axis.
    window, overlap : frames of a part that is solved at once, and how many it shares with the next.

    Returns
    -------
    results, and what was estimated, as `Motion.provenance` has it.
    """
    swapped = np.stack([r.swapped for r in results])
    take = _take(body, channels, results, swapped, rate, settings)
    strength, take, rounds = _estimate(take, settings, window, overlap)
    roots, angles, covariances = _solve(take, strength, window, overlap)
    again = _swaps(take, strength, roots, angles)
    if not np.array_equal(again, swapped):
        uv, confidence = _exchanged(channels, again)
        take, swapped = replace(take, uv=uv, confidence=confidence, roots=roots, angles=angles), again
        roots, angles, covariances = _solve(take, strength, window, overlap)
    for _ in range(_LOOKS if contacts else 0):  # error bars stay those without: that a sole rests is no measurement
        found = find_contacts(body, roots, angles, rate, up)
        take = replace(take, roots=roots, angles=angles, contacts=found)
        roots, angles, _ = _solve(take, strength, window, overlap)
    angles = unwrap(body.tree, angles)
    fitted, weight = take.fitted(roots, angles), take.confidence / np.square(channels.sigma)
    # Outliers and quality are told by the accuracy that was stated, as for a single frame: they compare between takes.
    factor, informs = take.factors(channels.sigma, fitted), informing(body, channels)
    took_part = take.confidence / np.square(strength.sigma) * take.factors(strength.sigma, fitted)
    smoothed = []
    for f in range(len(roots)):
        state, used = BodyState(roots[f], angles[f]), np.where(weight[f][:, None] > 0, take.uv[f], np.nan)
        std = _deviations(body, state, covariances[f], take.told[f])
        result = judged(channels, informs, state, std, used, weight[f], factor[f], fitted[f], swapped[f])
        smoothed.append(replace(result, weight=took_part[f]))
    return smoothed, _told(take, strength, rounds)


def _deviations(body: Body, state: BodyState, covariance: NDArray, told: NDArray) -> tuple[NDArray, NDArray]:
    """Of the degrees of freedom (n,), inf for coordinates known from the prior alone; of the joint centres (S, 3)."""
    cov = Covariance(covariance, np.empty((len(covariance), 0)))
    blind = np.concatenate([np.zeros(6, bool), ~told | prior_alone(body, cov.std)])
    return np.where(blind, np.inf, cov.std), joint_std(body, state, cov)


def _take(
    body: Body, channels: Channels, results: Sequence[FrameResult], swapped: NDArray, rate: float, settings: Settings
) -> SmoothTake:
    """What was tracked, in angles without jumps."""
    roots, angles = (np.stack([getattr(r.state, n) for r in results]) for n in ("T_world_root", "angles"))
    names = tuple(channels.points.names[c] for c in channels.column)
    points = PointSet(names, channels.points.segments[channels.column], channels.points.points[channels.column])
    inliers = np.stack([r.factor for r in results]) > INLIER
    told = np.stack([np.isfinite(r.dof_std[6:]) for r in results])  # in its own frame, not only through others
    told &= levers(body, points, inliers, roots, angles) > SHORTEST
    lost = inliers.sum(axis=1) < _ENOUGH
    roots, angles = bridged(roots, unwrap(body.tree, angles), lost, settings.smooth_memory * rate)
    return SmoothTake(
        body, channels, points, *_exchanged(channels, swapped), roots, angles,
        near(told, round(settings.smooth_memory * rate)), np.ones((len(roots), body.tree.n_dofs)), 1.0 / rate,
        settings.loss, (settings.acceleration_memory, settings.smooth_memory),
    )  # fmt: skip


def _exchanged(channels: Channels, swapped: NDArray) -> tuple[NDArray, NDArray]:
    """Pixels (F, N, 2) and confidences (F, N) with sides put right, 0 where unseen."""
    order = np.where(swapped, channels.partner, np.arange(swapped.shape[1]))
    uv = np.take_along_axis(channels.uv[: len(swapped)], order[:, :, None], axis=1)
    confidence = np.take_along_axis(channels.confidence[: len(swapped)], order, axis=1)
    return uv, np.where(np.isfinite(uv).all(axis=2), confidence, 0.0)


def parts(frames: int, window: int, overlap: int) -> list[tuple[slice, slice]]:
    """Overlapping windows: what is solved, and what of the take is kept from it."""
    if frames <= window:
        return [(slice(0, frames), slice(0, frames))]
    count = int(np.ceil((frames - overlap) / (window - overlap)))
    starts = np.round(np.linspace(0, frames - window, count)).astype(int)
    cuts = [0, *((starts[1:] + starts[:-1] + window) // 2).tolist(), frames]
    return [(slice(int(a), int(a) + window), slice(cuts[i], cuts[i + 1])) for i, a in enumerate(starts)]


def _estimate(take: SmoothTake, settings: Settings, window: int, overlap: int) -> tuple[Strength, SmoothTake, int]:
    """Strength of a few parts of the take, and the take with the liveliness of all."""
    windows = [whole for whole, _ in parts(len(take.roots), window, overlap)]
    chosen = np.unique(np.linspace(0, len(windows) - 1, _PARTS).round().astype(int))
    start = settings.root_acceleration, settings.angle_acceleration
    strength, pieces, rounds = estimate([take.part(windows[i]) for i in chosen], start, settings.smooth_rounds)
    done = dict(zip(chosen.tolist(), pieces, strict=True))
    roots, angles, live = np.array(take.roots), np.array(take.angles), np.array(take.live)
    for i, (whole, kept) in enumerate(parts(len(take.roots), window, overlap)):
        piece = done[i] if i in done else enliven(take.part(whole), strength)
        inside = slice(kept.start - whole.start, kept.stop - whole.start)
        roots[kept], angles[kept], live[kept] = piece.roots[inside], piece.angles[inside], piece.live[inside]
    return strength, replace(take, roots=roots, angles=angles, live=live), rounds


def _solve(take: SmoothTake, strength: Strength, window: int, overlap: int) -> tuple[NDArray, NDArray, NDArray]:
    """Roots, angles and covariances of all frames."""
    roots, angles = np.array(take.roots), np.array(take.angles)
    n = take.body.tree.n_dofs
    covariances = np.empty((len(roots), n, n))
    for whole, kept in parts(len(roots), window, overlap):
        fit, post = take.part(whole).fit(strength)
        inside = slice(kept.start - whole.start, kept.stop - whole.start)
        roots[kept], angles[kept], covariances[kept] = fit.roots[inside], fit.angles[inside], post.frames[inside]
    return roots, angles, covariances


def _swaps(take: SmoothTake, strength: Strength, roots: NDArray, angles: NDArray) -> NDArray:
    """(F, N) bool, channels to exchange with their partner, judged by the smoothed motion."""
    channels, groups = take.channels, limb_groups(take.body, take.channels)
    fitted, (uv, confidence) = take.fitted(roots, angles), _exchanged(channels, np.zeros(take.confidence.shape, bool))
    weight = confidence / np.square(channels.sigma)
    return np.stack([find_swaps(channels, groups, uv[f], weight[f], fitted[f]) for f in range(len(roots))])


def _told(take: SmoothTake, strength: Strength, rounds: int) -> dict[str, Any]:
    coordinates = ("root_shift", "root_turn", *take.body.tree.coordinates)
    values = [strength.acceleration[0], *strength.acceleration[5:]]
    sigma = {
        label: {
            take.points.names[i]: round(float(strength.sigma[i]), 2)
            for i in np.flatnonzero(take.channels.source == q)
        }
        for q, label in enumerate(take.channels.sources)
    }
    return {
        "acceleration": {name: round(float(v), 2) for name, v in zip(coordinates, values, strict=True)},
        "acceleration_memory": take.memory[0],
        "velocity_memory": take.memory[1],
        "pixel_sigma": sigma,
        "liveliest": round(float(take.live.max()), 2),
        "contacts": 0 if take.contacts is None else int(np.any(take.contacts.weight > 0, axis=1).sum()),
        "rounds": rounds,
    }
