"""People among each other as detectors see them in real rooms, simulated with truth, through `track`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.people.people_crowds import RATE, Crowd, crowd
from benchmarks.accuracy.people.people_simulated import errors_of, frames_on_one, motion_of, owners_of
from benchmarks.figures import amount, figure
from kinefit.fitting.multiview.people import people_of

KINDS = amount(("cross", "hide", "leave", "crowd"), ("leave",))
SEEDS = amount((50, 51, 52), (51,))  # 21, 22 and 30 to 35 were looked at
CLOSE_SEEDS = amount((50, 51, 52), (51,))  # 30 to 32 were looked at
RELIEVED_SEEDS = amount(tuple(range(50, 60)), (50,))  # 30 to 37 were looked at
_NOISE = 5.0  # [px]
_MISSED = 0.15  # of all frames a person is missed by a camera, for a second each time
_FURNITURE = 0.4  # of all pairs of person and camera: legs are hidden for half of the time
_DOUBLED = 0.15  # of all frames and cameras: somebody is detected a second time, by some of the points
_MERGED = 0.1  # chance a frame, where two are near each other in a picture, that the nearer takes a limb of the other
_SWALLOWED = 0.7  # of these the other is not detected then
_THING = 0.5  # of all cameras: something that stands still is taken for a person
_LEGS = tuple(range(11, 17))  # of COCO_17
_LIMBS = ((5, 7, 9), (6, 8, 10), (11, 13, 15), (12, 14, 16), (7, 9), (0, 1, 2, 3, 4))


def run() -> None:
    """Print every figure."""
    given, taken, lost, invented, on_one, right = 0, 0, 0, 0, 0, []
    for kind in KINDS:
        for seed in SEEDS:
            seen = rough(crowd(kind, seed, amount(200, 150), "COCO_17", _NOISE), seed)
            people = people_of(seen.rig, seen.keypoints)
            whose = [owners_of(seen.order, one.chosen) for one in people]
            owners = [int(np.bincount(w[w >= 0]).argmax()) for w in whose]
            mixed = sum(int(((w >= 0) & (w != owner)).sum()) for w, owner in zip(whose, owners))
            taken, given = taken + mixed, given + sum(int((w >= 0).sum()) for w in whose)
            count = len(seen.motions)
            lost, invented = lost + count - len(set(owners)), invented + len(owners) - len(set(owners))
            best = [0.0] * count  # of somebody who is lost nothing is right
            motions = [motion_of(seen, people, k) for k in range(len(people))]
            for motion, owner in zip(motions, owners):
                best[owner] = max(best[owner], errors_of(seen, motion, owner)[1])
            right += best
            two = frames_on_one(seen, motions)
            on_one += two
            print(
                f"# {kind} {seed}: {count} people, {len(seen.rig)} cameras: found {len(people)}, {mixed} views "
                f"with another's detection, {two} frames with two on one; "
                f"PCP {', '.join(f'{100 * one:.1f}' for one in best)} %", flush=True,
            )  # fmt: skip
    figure("people_rough_mixed", 100 * taken / given, "% of the views", "<= 1")
    figure("people_rough_lost", float(lost), "people", "<= 0")
    figure("people_rough_invented", float(invented), "people", "<= 0")
    figure("people_rough_pcp", 100 * float(np.mean(right)), "%", ">= 98")
    _close(on_one)


def _close(on_one: int) -> None:
    """Two bodies on one person, among people who stand closer, too; and those who leave as another comes."""
    relieved = 0
    for seed in CLOSE_SEEDS:
        seen = rough(crowd("throng", seed, amount(200, 150), "COCO_17", _NOISE), seed)
        people = people_of(seen.rig, seen.keypoints)
        two = frames_on_one(seen, [motion_of(seen, people, k) for k in range(len(people))])
        on_one += two
        print(f"# throng {seed}: found {len(people)} of {len(seen.motions)}, {two} frames with two on one", flush=True)
    for seed in RELIEVED_SEEDS:
        seen = crowd("relieve", seed, amount(200, 150), "COCO_17", _NOISE)
        owners = [owners_of(seen.order, one.chosen) for one in people_of(seen.rig, seen.keypoints)]
        relieved += any((of == 1).any() and (of == 2).any() for of in owners)
    figure("people_on_one", float(on_one), "frames in which two tracked bodies stand on one person", "== 0")
    figure("people_relieved", float(relieved), f"of {len(RELIEVED_SEEDS)} who leave and who come taken for one", "== 0")


def rough(seen: Crowd, seed: int) -> Crowd:
    """What real detectors add: whole people missed, legs behind furniture, people twice, merged, and things."""
    random = np.random.default_rng(1000 + seed)
    records, orders = [], []
    for record, order in zip(seen.keypoints, seen.order):
        points = np.take_along_axis(record.points, order[:, :, None, None], axis=1)  # in the order of the people
        sure = np.take_along_axis(record.confidence, order[:, :, None], axis=1)
        frames, count, names, _ = points.shape
        for p in range(count):
            _hide(points, sure, _spans(random, frames, _MISSED, RATE), p, tuple(range(names)))
            if random.random() < _FURNITURE:
                _hide(points, sure, _spans(random, frames, 0.5, 2 * RATE), p, _LEGS)
        camera = seen.rig[record.camera]
        middles = np.stack([m.positions().mean(axis=1) for m in seen.motions], axis=1)
        _merge(points, sure, np.linalg.norm(middles - camera.centre_world, axis=-1), random)
        more, how_sure = _besides(points, random)
        points, sure = np.concatenate([points, more], axis=1), np.concatenate([sure, how_sure], axis=1)
        mixed = np.stack([random.permutation(points.shape[1]) for _ in range(frames)])
        records.append(replace(
            record, points=np.take_along_axis(points, mixed[:, :, None, None], axis=1),
            confidence=np.take_along_axis(sure, mixed[:, :, None], axis=1),
        ))  # fmt: skip
        orders.append(np.argsort(mixed, axis=1)[:, :count])
    return replace(seen, keypoints=tuple(records), order=tuple(orders))


def _spans(random: np.random.Generator, frames: int, share: float, length: float) -> NDArray:
    """(F,) bool: stretches of so many frames, more or less, until a share of all is reached."""
    out = np.zeros(frames, bool)
    while out.mean() < share:
        first = random.integers(frames)
        out[first : first + random.integers(round(0.5 * length), round(2 * length))] = True
    return out


def _hide(points: NDArray, sure: NDArray, when: NDArray, person: int, which: tuple[int, ...]) -> None:
    at = np.ix_(when, [person], which)
    points[at], sure[at] = np.nan, 0.0


def _merge(points: NDArray, sure: NDArray, away: NDArray, random: np.random.Generator) -> None:
    """Limbs of those behind go to those before them, for some frames at a time."""
    frames, count = away.shape
    middle = np.full((frames, count, 2), np.nan)
    height = np.full((frames, count), np.nan)
    some = np.isfinite(points).all(axis=-1).any(axis=-1)
    middle[some] = np.nanmean(points[some], axis=1)
    height[some] = np.nanmax(points[some][..., 1], axis=1) - np.nanmin(points[some][..., 1], axis=1)
    for a, b in ((a, b) for a in range(count) for b in range(count) if a != b):
        near = (np.abs(middle[:, a, 0] - middle[:, b, 0]) < 0.25 * height[:, a]) & (away[:, a] < away[:, b])
        f = 0
        while f < frames:
            if near[f] and random.random() < _MERGED:
                limb, last = _LIMBS[random.integers(len(_LIMBS))], f + random.integers(3, 15)
                for g in (g for g in range(f, min(last, frames)) if near[g]):
                    points[g, a, limb], sure[g, a, limb] = points[g, b, limb], sure[g, b, limb]
                    if random.random() < _SWALLOWED:
                        points[g, b], sure[g, b] = np.nan, 0.0
                f = last
            f += 1


def _besides(points: NDArray, random: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Second detections of people, and a thing, (F, 2, K, 2) [px], with how sure they are (F, 2, K)."""
    frames, count, names, _ = points.shape
    more, sure = np.full((frames, 2, names, 2), np.nan), np.zeros((frames, 2, names))
    for f in np.flatnonzero(random.uniform(size=frames) < _DOUBLED):
        kept = random.uniform(size=names) < 0.6
        more[f, 0, kept] = points[f, random.integers(count), kept] + random.normal(0.0, _NOISE, (kept.sum(), 2))
        sure[f, 0, kept] = 0.5
    if random.random() < _THING:
        like = points[random.integers(frames), random.integers(count)]
        place = like + [random.uniform(-300, 300), random.uniform(-100, 100)]
        there = random.uniform(size=frames) < 0.6
        more[there, 1] = place + random.normal(0.0, 4.0, (int(there.sum()), names, 2))
        sure[there, 1] = 0.6
    sure[~np.isfinite(more).all(axis=-1)] = 0.0
    return more, sure
