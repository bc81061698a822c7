"""Which person: the same one in all cameras and over time, among bystanders, posters and false detections."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit._mapped import kept
from kinefit.errors import TrackingError
from kinefit.geometry.camera import Rig
from kinefit.geometry.triangulation import triangulate
from kinefit.multiview.boxes import same_people
from kinefit.multiview.medians import medians
from kinefit.observations import MEDIAPIPE_478, Keypoints
from kinefit.observations.arrays import sealed

_ENOUGH = 4  # points of a person that must be seen
_SOME = 13  # points, spread over the set, that decide whether two detections are of one person
STRIDE = 0.6  # [m] by which the middle of a person leaps at most from frame to frame: half of the body may be unseen
SPEED = 3.0  # [m/s] people do not go further while they are unseen
_SWITCH = 1.0  # [s] going on with somebody else must show that much more of a person, seen by all cameras
_SWAY = 0.1  # frames of the same that a leap of one stride must show more: of two who stand close, the same one
_PATHS = 16  # how many people and gaps are borne in mind at a time
_CLOCK = 0.01  # frames, below the resolution of any clock
_AGREE = 0.04  # two views of one person differ by less than this share of the person's height in the picture


def choose_people(rig: Rig, keypoints: Sequence[Keypoints]) -> list[NDArray]:
    """For each record the index (F,) of the person to follow in each frame, -1 for none.

    In every frame people of different records are grouped when their keypoints meet in space. The person is the one of
    whom the groups show most over the whole take, by the number of keypoints seen and how sure the detector was of
    them; gone after from frame to frame, so that nobody else stands in for a moment (dynamic programming).

    Where a camera has records of several detectors, the person is sought in those of the surest one (in a face mesh
    last), and in the others by the boxes; alone where the surest sees nobody, if both are of one person elsewhere.

    Raises
    ------
    TrackingError
        Nobody is seen in any frame.
    """
    sets = list(dict.fromkeys(k.names for k in keypoints))
    each = {names: [q for q, k in enumerate(keypoints) if k.names == names] for names in sets}
    chosen: dict[int, NDArray] = {}
    for own in each.values():
        chosen |= zip(own, _of_one_detector(rig, [keypoints[q] for q in own]))
    frames = min(len(k) for k in keypoints)
    sure = {n: sum(float(surety_of(keypoints[q], frames).sum()) for q in own) for n, own in each.items()}
    surest = {keypoints[q].camera: q for q in reversed(each[max(sure, key=lambda n: (n != MEDIAPIPE_478, sure[n]))])}
    for q, record in enumerate(keypoints):
        main = surest.get(record.camera, q)
        if main != q:
            by_box = same_people([chosen[main]], keypoints[main], record)[0][:frames]
            both = (by_box >= 0) & (chosen[q] >= 0)
            alone = (chosen[main] < 0) & (np.mean((by_box == chosen[q])[both]) > 0.5 if both.any() else False)
            chosen[q] = np.where(alone, chosen[q], by_box)
    out = [chosen[q] for q in range(len(keypoints))]
    if all(np.all(c < 0) for c in out):
        raise TrackingError("nobody is seen in any frame", remedy="Check that the keypoints belong to this recording.")
    return out


def person_records(keypoints: Sequence[Keypoints], people: Sequence[NDArray]) -> tuple[Keypoints, ...]:
    """Records of one person alone, all of them at the times of one clock.

    A camera whose frames lie between those times has its points interpolated, linearly between two frames that both
    show the point.

    Parameters
    ----------
    keypoints : Q records of the same number of frames F
    people : Q arrays (F,) int, which person of each record, -1 for none; see `choose_people`
    """
    start = common_start(keypoints)
    return tuple(_at_times(_alone(record, p), start) for record, p in zip(keypoints, people, strict=True))


def _alone(record: Keypoints, person: NDArray) -> Keypoints:
    if record.points.shape[1] == 1 and np.all(person == 0):
        return record
    one = record.of_one(person)
    return replace(one, points=sealed(kept(one.points)), confidence=sealed(kept(one.confidence)))


def _at_times(record: Keypoints, start: float) -> Keypoints:
    late = float(start - record.times[0]) * record.rate if len(record) else 0.0
    if abs(late) < _CLOCK or len(record) < 2:
        return record
    lifted = None if record.lifted is None else between_frames(record.lifted, late)
    points, confidence = (between_frames(v, late) for v in (record.points, record.confidence))
    return replace(
        record, points=sealed(kept(points)), confidence=sealed(kept(np.nan_to_num(confidence))), lifted=lifted,
        time_offset=start,
    )  # fmt: skip


def common_start(keypoints: Sequence[Keypoints]) -> float:
    """Time [s] of the first frame of all records together: the step of the common time next to most of them."""
    rate = keypoints[0].rate
    return float(np.round(np.median([k.times[0] for k in keypoints if len(k)] or [0.0]) * rate) / rate)


def between_frames(values: NDArray, late: float) -> NDArray:
    """Values (F, ...) of frames `late` frames later, a fraction, linear between neighbours; NaN beside unseen ones."""
    at = np.clip(np.arange(len(values)) + late, 0, len(values) - 1)
    before = np.minimum(at.astype(int), len(values) - 2)
    share = (at - before).reshape(-1, *[1] * (values.ndim - 1))
    a, b = values[before], values[before + 1]
    out: NDArray = np.where(share == 0, a, np.where(share == 1, b, (1 - share) * a + share * b))
    return out


def _of_one_detector(rig: Rig, keypoints: Sequence[Keypoints]) -> list[NDArray]:
    """(F,) the person to follow in each of several records of one kind of keypoints."""
    frames = min(len(k) for k in keypoints)
    surety = [surety_of(k, frames) for k in keypoints]
    chosen = [np.full(frames, -1) for _ in keypoints]
    if all(k.points.shape[1] == 1 for k in keypoints):
        for c, sure in zip(chosen, surety, strict=True):
            c[sure[:, 0] > 0] = 0
    else:
        meetings = meetings_of(rig, keypoints, surety, frames)
        everybody = len(keypoints) * max(len(k.names) for k in keypoints)
        groups = []
        for f in range(frames):
            ranked = [(float(s[f, p]), q, int(p)) for q, s in enumerate(surety) for p in np.flatnonzero(s[f] > 0)]
            people = [(q, p) for _, q, p in sorted(ranked, reverse=True)]
            links = {pair: centre[f] for pair, centre in meetings.items() if np.isfinite(centre[f, 0])}
            groups.append(groups_of(people, links, surety, f, everybody))
        for f, group in enumerate(_one_person(groups, keypoints[0].rate)):
            for q, p in group:
                chosen[q][f] = p
    return chosen


Node = tuple[int, int]  # record, person in it


def surety_of(record: Keypoints, frames: int) -> NDArray:
    """(F, P) summed confidence of each person's points, 0 for one of whom too few are seen."""
    seen = np.isfinite(record.points[:frames]).all(axis=-1) & (record.confidence[:frames] > 0.1)
    total = np.where(seen, record.confidence[:frames], 0.0).sum(axis=-1)
    return np.where(seen.sum(axis=-1) >= _ENOUGH, total, 0.0)


def some_points(count: int) -> NDArray:
    """(k,) int: some of so many points, spread over the set."""
    return np.unique(np.linspace(0, count - 1, _SOME).astype(int))


def meetings_of(
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
                        at = both[:, None], some_points(len(a.names))
                        uv = (np.where((k.confidence[:, p][at] > 0.1)[..., None], k.points[:, p][at], np.nan)
                              for k, p in ((a, pa), (b, pb)))  # fmt: skip
                        centre[both] = _meet(pair, *uv)
                    out[(i, pa), (j, pb)] = centre
    return out


def links_of(
    pairs: Mapping[tuple[int, int], Rig], uv: Sequence[NDArray], nodes: Sequence[Node]
) -> dict[tuple[Node, Node], NDArray]:
    """Centre (3,) [m] in space of every two detections of one frame that are of one person.

    Parameters
    ----------
    pairs : {records of two cameras: their rig}
    uv : (P, k, 2) [px] of each record some points of everybody in this frame, NaN where they are not seen
    nodes : detections to look at
    """
    out = {}
    for (i, j), pair in pairs.items():
        a, b = ([p for q, p in nodes if q == record] for record in (i, j))
        if a and b:
            pa, pb = (k.ravel() for k in np.meshgrid(a, b, indexing="ij"))
            for m, n, centre in zip(pa, pb, _meet(pair, uv[i][pa], uv[j][pb])):
                if np.isfinite(centre[0]):
                    out[(i, int(m)), (j, int(n))] = centre
    return out


def _meet(pair: Rig, a: NDArray, b: NDArray) -> NDArray:
    """(N, 3) [m] median point where detections (N, k, 2) [px] of two cameras agree, NaN where they do not."""
    uv = np.stack([a, b], axis=2)
    uv = np.where(np.isfinite(uv).all(axis=(2, 3))[..., None, None], uv, np.nan)
    x = triangulate(pair, uv.reshape(-1, 2, 2)).reshape(*uv.shape[:2], 3)
    error = np.stack([np.linalg.norm(c.project(x) - uv[:, :, k], axis=-1) for k, c in enumerate(pair)], axis=-1)
    with warnings.catch_warnings():  # frames without a common point are NaN, and meant to be
        warnings.simplefilter("ignore", RuntimeWarning)
        size = np.mean(np.nanmax(uv[..., 1], axis=1) - np.nanmin(uv[..., 1], axis=1), axis=1)
        agree = medians(error.reshape(len(uv), -1)) < _AGREE * size
    agree &= np.isfinite(error).all(axis=-1).sum(axis=1) >= _ENOUGH
    return np.where(agree[:, None], medians(np.moveaxis(x, 1, -1)), np.nan)


@dataclass(frozen=True)
class DetectionGroup:
    """Detections of one frame that are of one person."""

    nodes: tuple[Node, ...]
    score: float  # 1: all cameras see all keypoints, quite sure
    centre: NDArray  # (3,) [m], NaN where one camera alone sees the person


def groups_of(
    people: list[Node], meetings: Mapping[tuple[Node, Node], NDArray], surety: Sequence[NDArray], frame: int,
    full: float,
) -> list[DetectionGroup]:  # fmt: skip
    """Largest sets of people of different records that all meet in a frame; single ones where nobody meets."""
    there = set(people)
    links = {pair: centre for pair, centre in meetings.items() if pair[0] in there and pair[1] in there}
    found: dict[frozenset[Node], DetectionGroup] = {}
    for pair in links:
        group = list(pair)
        for node in people:
            if all(node[0] != m[0] and ((node, m) in links or (m, node) in links) for m in group):
                group.append(node)
        score = sum(float(surety[q][frame, p]) for q, p in group) / full
        # of all its pairs: one of them may have only half of the person in common
        middle = medians(np.array([c for (a, b), c in links.items() if a in group and b in group]).T)
        found.setdefault(frozenset(group), DetectionGroup(tuple(group), score, middle))
    nowhere = np.full(3, np.nan)
    return list(found.values()) or [
        DetectionGroup(((q, p),), float(surety[q][frame, p]) / full, nowhere) for q, p in people
    ]


def _one_person(groups: Sequence[Sequence[DetectionGroup]], rate: float) -> list[tuple[Node, ...]]:
    """The detections of one person in each frame, none where unseen: the path through the groups that shows most."""
    value, centre, unseen = np.zeros(1), np.full((1, 3), np.nan), np.zeros(1)  # of every path that is borne in mind
    history: list[tuple[NDArray, NDArray]] = []  # for each path the one it goes on from, and its group or -1
    for there in groups:
        at = np.array([g.centre for g in there]).reshape(-1, 3)
        apart = np.linalg.norm(at[:, None] - centre, axis=-1)  # (groups, paths); NaN where a place is not known
        far = apart > STRIDE + SPEED * (unseen + 1) / rate
        sway = np.where(np.isnan(apart), 0.0, np.minimum(apart / STRIDE, 1))
        cost = np.where(far, _SWITCH * rate, _SWAY * sway**2)
        total = value - cost
        before = total.argmax(axis=1)
        gained = total.max(axis=1) + [g.score for g in there]
        at = np.where(np.isfinite(at), at, centre[before])
        value, centre = np.concatenate([gained, value]), np.concatenate([at, centre])
        before = np.concatenate([before, np.arange(len(unseen))])
        group = np.concatenate([np.arange(len(there)), np.full(len(unseen), -1)])
        unseen = np.concatenate([np.zeros(len(there)), unseen + 1])
        kept = _distinct(value, centre, unseen)
        value, centre, unseen = value[kept], centre[kept], unseen[kept]
        history.append((before[kept], group[kept]))
    path, chosen = 0, []
    for (before, group), there in zip(reversed(history), reversed(groups)):
        chosen.append(there[group[path]].nodes if group[path] >= 0 else ())
        path = int(before[path])
    return chosen[::-1]


def _distinct(value: NDArray, centre: NDArray, unseen: NDArray) -> list[int]:
    """The best paths that end at different places, the best first."""
    kept: list[int] = []
    beside = np.linalg.norm(centre[:, None] - centre, axis=-1) < STRIDE
    covered = beside & (unseen <= unseen[:, None])
    for path in np.argsort(-value, kind="stable"):
        if not covered[path, kept].any():
            kept.append(int(path))
        if len(kept) == _PATHS:
            break
    return kept
