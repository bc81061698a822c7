"""Which person: the same one in all cameras and over time, among bystanders, posters and false detections."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import TrackingError
from kinefit.geometry.camera import Rig
from kinefit.geometry.triangulation import triangulate
from kinefit.observations import Keypoints

_AGREE = 0.04  # two views of one person differ by less than this share of the person's height in the picture


def choose_people(rig: Rig, keypoints: Sequence[Keypoints]) -> list[NDArray]:
    """For each record the index (F,) of the person to follow in each frame, -1 for none.

    In every frame people of different records are paired when their keypoints meet in space; the largest consistent
    group is the person, by the number of keypoints seen and how sure the detector was of them; among equals the one
    that most frames agree on, by where it is. A record with one person in it is taken as that person where it agrees.

    Raises
    ------
    TrackingError
        Nobody is seen in any frame.
    """
    frames = min(len(k) for k in keypoints)
    chosen = [np.full(frames, -1) for _ in keypoints]
    last: NDArray | None = None
    crowded = any(k.points.shape[1] > 1 for k in keypoints)
    for f in range(frames):
        people = [_people(k, f) for k in keypoints]
        if crowded:
            pick, last = _best_group(rig, keypoints, people, f, last)
        else:
            pick = [p[0] if p else -1 for p in people]
        for q, person in enumerate(pick):
            chosen[q][f] = person
    if all(np.all(c < 0) for c in chosen):
        raise TrackingError(
            "nobody is seen in any frame", remedy="Check that the keypoints belong to this recording."
        )
    return chosen


def _people(record: Keypoints, frame: int) -> list[int]:
    seen = np.isfinite(record.points[frame]).all(axis=-1) & (record.confidence[frame] > 0.1)
    return [int(p) for p in np.flatnonzero(seen.sum(axis=-1) >= 4)]


def _best_group(
    rig: Rig, keypoints: Sequence[Keypoints], people: list[list[int]], frame: int, last: NDArray | None
) -> tuple[list[int], NDArray | None]:
    nodes = [(q, p) for q, ps in enumerate(people) for p in ps]
    if not nodes:
        return [-1] * len(keypoints), last
    links: dict[tuple[int, int], NDArray] = {}
    for i, (qa, pa) in enumerate(nodes):
        for j in range(i + 1, len(nodes)):
            qb, pb = nodes[j]
            a, b = keypoints[qa], keypoints[qb]
            if a.camera == b.camera or a.names != b.names:
                continue
            centre = _meet(rig, a, pa, b, pb, frame)
            if centre is not None:
                links[i, j] = centre
    best: tuple[float, list[int], NDArray | None] = (-1.0, [], last)
    seeds = [([i, j], c) for (i, j), c in links.items()] or [([i], None) for i in range(len(nodes))]
    for seed, centre in seeds:
        group = list(seed)
        for k in range(len(nodes)):
            same_record = any(nodes[k][0] == nodes[m][0] for m in group)
            if not same_record and all((min(k, m), max(k, m)) in links for m in group):
                group.append(k)
        score = sum(_surety(keypoints[nodes[m][0]], nodes[m][1], frame) for m in group)
        if last is not None and centre is not None:
            score *= 1.0 + np.exp(-0.5 * (np.linalg.norm(centre - last) / 0.3) ** 2)  # people stay where they are
        if score > best[0]:
            best = (score, group, centre if centre is not None else last)
    pick = [-1] * len(keypoints)
    for m in best[1]:
        pick[nodes[m][0]] = nodes[m][1]
    return pick, best[2]


def _surety(record: Keypoints, person: int, frame: int) -> float:
    seen = np.isfinite(record.points[frame, person]).all(axis=-1)
    return float(np.where(seen, record.confidence[frame, person], 0.0).sum())


def _meet(rig: Rig, a: Keypoints, pa: int, b: Keypoints, pb: int, frame: int) -> NDArray | None:
    """Median point in space of two detections if they are of one person, left and right exchanged or not; else None."""
    ua, ub = a.points[frame, pa], b.points[frame, pb]
    both = np.isfinite(ua).all(-1) & np.isfinite(ub).all(-1)
    both &= (a.confidence[frame, pa] > 0.1) & (b.confidence[frame, pb] > 0.1)
    if both.sum() < 4:
        return None
    pair = rig.select((a.camera, b.camera))
    size = 0.5 * (np.ptp(ua[both][:, 1]) + np.ptp(ub[both][:, 1]))
    uv = np.stack([ua[both], ub[both]], axis=1)
    x = triangulate(pair, uv)
    good = np.isfinite(x).all(axis=1)
    if good.sum() < 4:
        return None
    errors = [np.linalg.norm(camera.project(x[good]) - uv[good, c], axis=1) for c, camera in enumerate(pair)]
    if not np.nanmedian(errors) < _AGREE * size:
        return None
    return np.median(x[good], axis=0)
