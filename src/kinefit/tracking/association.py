"""Which person: the same one in all cameras and over time, among bystanders, posters and false detections."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import TrackingError
from kinefit.geometry.camera import Rig
from kinefit.geometry.triangulation import triangulate
from kinefit.observations import Keypoints

_ENOUGH = 4  # points of a person that must be seen
_SOME = 13  # points, spread over the set, that decide whether two detections are of one person
_STRIDE = 0.3  # [m] people stay about where they are from frame to frame
_AGREE = 0.04  # two views of one person differ by less than this share of the person's height in the picture


def choose_people(rig: Rig, keypoints: Sequence[Keypoints]) -> list[NDArray]:
    """For each record the index (F,) of the person to follow in each frame, -1 for none.

    In every frame people of different records are paired when their keypoints meet in space; the largest consistent
    group is the person, by the number of keypoints seen and how sure the detector was of them; among equals the one
    nearest to where the person was.

    Raises
    ------
    TrackingError
        Nobody is seen in any frame.
    """
    frames = min(len(k) for k in keypoints)
    surety = [_surety(k, frames) for k in keypoints]
    chosen = [np.full(frames, -1) for _ in keypoints]
    if all(k.points.shape[1] == 1 for k in keypoints):
        for c, sure in zip(chosen, surety, strict=True):
            c[sure[:, 0] > 0] = 0
    else:
        meetings = _meetings(rig, keypoints, surety, frames)
        last: NDArray | None = None
        for f in range(frames):
            ranked = [(float(s[f, p]), q, int(p)) for q, s in enumerate(surety) for p in np.flatnonzero(s[f] > 0)]
            people = [(q, p) for _, q, p in sorted(ranked, reverse=True)]
            group, last = _best_group(people, meetings, surety, f, last)
            for q, p in group:
                chosen[q][f] = p
    if all(np.all(c < 0) for c in chosen):
        raise TrackingError("nobody is seen in any frame", remedy="Check that the keypoints belong to this recording.")
    return chosen


Node = tuple[int, int]  # record, person in it


def _surety(record: Keypoints, frames: int) -> NDArray:
    """(F, P) summed confidence of each person's points, 0 for one of whom too few are seen."""
    seen = np.isfinite(record.points[:frames]).all(axis=-1) & (record.confidence[:frames] > 0.1)
    total = np.where(seen, record.confidence[:frames], 0.0).sum(axis=-1)
    return np.where(seen.sum(axis=-1) >= _ENOUGH, total, 0.0)


def _meetings(
    rig: Rig, keypoints: Sequence[Keypoints], surety: Sequence[NDArray], frames: int
) -> dict[tuple[Node, Node], NDArray]:
    """Centre (F, 3) [m] in space of two detections where they are of one person, NaN elsewhere."""
    out = {}
    for i, a in enumerate(keypoints):
        for j, b in enumerate(keypoints[i + 1 :], start=i + 1):
            if a.camera == b.camera or a.names != b.names:
                continue
            pair = rig.select((a.camera, b.camera))
            for pa in range(a.points.shape[1]):
                for pb in range(b.points.shape[1]):
                    both = np.flatnonzero((surety[i][:, pa] > 0) & (surety[j][:, pb] > 0))
                    centre = np.full((frames, 3), np.nan)
                    if both.size:
                        centre[both] = _meet(pair, a, pa, b, pb, both)
                    out[(i, pa), (j, pb)] = centre
    return out


def _meet(pair: Rig, a: Keypoints, pa: int, b: Keypoints, pb: int, frames: NDArray) -> NDArray:
    """(F, 3) median point in space where two detections agree in some frames, NaN where they do not."""
    some = np.unique(np.linspace(0, len(a.names) - 1, _SOME).astype(int))
    at = frames[:, None], some
    uv = np.stack([k.points[:, p][at] for k, p in ((a, pa), (b, pb))], axis=2)
    sure = np.stack([k.confidence[:, p][at] for k, p in ((a, pa), (b, pb))], axis=2) > 0.1
    uv = np.where((np.isfinite(uv).all(axis=-1) & sure).all(axis=2)[..., None, None], uv, np.nan)
    x = triangulate(pair, uv.reshape(-1, 2, 2)).reshape(*uv.shape[:2], 3)
    error = np.stack([np.linalg.norm(c.project(x) - uv[:, :, k], axis=-1) for k, c in enumerate(pair)], axis=-1)
    with warnings.catch_warnings():  # frames without a common point are NaN, and meant to be
        warnings.simplefilter("ignore", RuntimeWarning)
        size = np.mean(np.nanmax(uv[..., 1], axis=1) - np.nanmin(uv[..., 1], axis=1), axis=1)
        agree = np.nanmedian(error.reshape(len(frames), -1), axis=1) < _AGREE * size
        agree &= np.isfinite(error).all(axis=-1).sum(axis=1) >= _ENOUGH
        return np.where(agree[:, None], np.nanmedian(x, axis=1), np.nan)


def _best_group(
    people: list[Node],
    meetings: dict[tuple[Node, Node], NDArray],
    surety: Sequence[NDArray],
    frame: int,
    last: NDArray | None,
) -> tuple[list[Node], NDArray | None]:
    """The surest set of people of different records that all meet, and where; `last` is where the person was."""
    links = {
        pair: centre[frame]
        for pair, centre in meetings.items()
        if np.isfinite(centre[frame, 0]) and pair[0] in people and pair[1] in people
    }
    best: tuple[float, list[Node], NDArray | None] = (-1.0, [], last)
    seeds = [(list(pair), centre) for pair, centre in links.items()] or [([node], None) for node in people]
    for group, centre in seeds:
        for node in people:
            if all(node[0] != m[0] and ((node, m) in links or (m, node) in links) for m in group):
                group.append(node)
        score = sum(surety[q][frame, p] for q, p in group)
        if last is not None and centre is not None:
            score *= 1.0 + np.exp(-0.5 * (np.linalg.norm(centre - last) / _STRIDE) ** 2)
        if score > best[0]:
            best = (score, group, last if centre is None else centre)
    return best[1], best[2]
