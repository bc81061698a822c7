"""Associate the detections of one target person across cameras and time, among bystanders and false positives.

Match the detections of two detectors in one image by bounding boxes; suppress duplicate detections of one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit._mapped import kept
from kinefit.errors import ObservationError, TrackingError
from kinefit.fitting.multiview import _kernels_medians
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import triangulate
from kinefit.observations import MEDIAPIPE_478, Keypoints
from kinefit.observations.arrays import sealed

_MAX_BOX_SHIFT = 0.3  # between two detectors' boxes of one person, relative to the height
_HEAD_WORDS = ("nose", "eye", "ear", "mouth", "face")  # in names of points that a face mesh has too
_MAX_HEAD_SHIFT = 0.5  # between boxes of a face mesh and of another detector's head, relative to their size
_MAX_COPY_SHIFT = 0.03  # between points of duplicates, relative to the height: detectors' noise
_MIN_SHARED_POINTS = 4  # common to two detections
_MIN_NEAR_SHARE = 0.5  # of the common points


def match_by_boxes(people: Sequence[NDArray], source: Keypoints, target: Keypoints) -> list[NDArray]:
    """(F,) index of each person's detection in one record, given its index in another record of the same camera.

    Parameters
    ----------
    people : (F,) int each, index of the person's detection in `source`; -1 for none
    source, target : records of one camera; a face mesh is compared with the head of the other record
    """
    heads = MEDIAPIPE_478 in (source.names, target.names)
    a, b, limit = _boxes(source, heads), _boxes(target, heads), _MAX_HEAD_SHIFT if heads else _MAX_BOX_SHIFT
    out = [np.full(len(indices), -1) for indices in people]
    for f in range(min(len(a), len(b))):
        cost = np.full((len(people), b.shape[1]), np.inf)
        for i, indices in enumerate(people):
            if indices[f] >= 0:
                size = np.maximum(a[f, indices[f], 2:].max(), b[f, :, 2:].max(axis=1)) if heads else a[f, indices[f], 3]
                distance = np.linalg.norm(b[f, :, :2] - a[f, indices[f], :2], axis=1) / np.maximum(size, 1.0)
                cost[i] = np.where(np.isfinite(distance), distance, np.inf)
        for i, p in assign(cost, limit):
            out[i][f] = p
    return out


def suppress_duplicates(record: Keypoints, confidence: NDArray) -> NDArray:
    """Set the confidence (F, P) of duplicate detections to zero, the less confident of two each.

    Two detections are duplicates if they share enough points and half of these coincide.
    """
    out = confidence.copy()
    frames, count = confidence.shape
    points = np.where((record.confidence[:frames] > 0.1)[..., None], record.points[:frames], np.nan)
    height = _boxes(record)[:frames, :, 3]
    for a in range(count):
        for b in range(a + 1, count):
            both = np.flatnonzero((confidence[:, a] > 0) & (confidence[:, b] > 0))
            if both.size:
                off = np.linalg.norm(points[both, a] - points[both, b], axis=-1)
                near = np.sum(off < _MAX_COPY_SHIFT * np.maximum(height[both, a], height[both, b])[:, None], axis=1)
                duplicate = both[near >= np.maximum(_MIN_SHARED_POINTS, _MIN_NEAR_SHARE * np.isfinite(off).sum(axis=1))]
                weaker = np.where(confidence[duplicate, a] < confidence[duplicate, b], a, b)
                out[duplicate, weaker] = 0.0
    return out


def _boxes(record: Keypoints, head: bool = False) -> NDArray:
    """(F, P, 4) [px] centre, width and height of the box around each detection or its head; NaN without points.

    The centre of the box is independent of how many points a detector has in face or hands.
    """
    visible = np.isfinite(record.points).all(axis=-1) & (record.confidence > 0.1)
    if head:
        visible = visible & [any(word in name.lower() for word in _HEAD_WORDS) for name in record.names]
    uv = np.where(visible[..., None], record.points, np.nan)
    out = np.full((*uv.shape[:2], 4), np.nan)
    has_points = visible.any(axis=2)
    low, high = np.nanmin(uv[has_points], axis=1), np.nanmax(uv[has_points], axis=1)
    out[has_points] = np.concatenate([(low + high) / 2.0, high - low], axis=1)
    return out


def assign(cost: ArrayLike, most: float = np.inf) -> list[tuple[int, int]]:
    """Assign rows to columns: pairs (row, column) that maximise Σ (most − cost), each with a cost below `most`.

    Every row and every column is in one pair at most. With `most` infinite, there are as many pairs as finite costs
    allow. Solved by `scipy.optimize.linear_sum_assignment` (Crouse 2016), in O(n³).

    Parameters
    ----------
    cost : (R, C), infinite where a pair is impossible
    most : cost of leaving a row and a column unassigned, in the unit of `cost`

    Raises
    ------
    ObservationError
        NaN among the costs, or no matrix.
    """
    cost = np.asarray(cost, float)
    if cost.ndim != 2 or np.isnan(cost).any():
        problem = f"costs of shape {cost.shape}" + (", some NaN" if np.isnan(cost).any() else "")
        raise ObservationError(problem, remedy="Give a matrix; infinity where a pair is impossible.")
    from scipy.optimize import linear_sum_assignment  # half a second, for those who follow several people

    allowed = np.isfinite(cost) & (cost < most)
    if not allowed.any():
        return []
    spread = float(np.ptp(cost[allowed])) + 1.0
    unassigned = most if np.isfinite(most) else float(cost[allowed].max()) + (min(cost.shape) + 1) * spread
    pairs = zip(*linear_sum_assignment(np.where(allowed, cost - unassigned, 0.0)))
    return [(int(r), int(c)) for r, c in pairs if allowed[r, c]]


_MIN_POINTS = 4  # visible keypoints of a detection
_MAX_COMPARED_POINTS = 13  # keypoints, spread over the set, by which two detections are compared
MAX_STEP = 0.6  # [m] of a person's centre between frames: half of the body may be occluded
MAX_SPEED = 3.0  # [m/s] of an unobserved person
_SWITCH_COST_S = 1.0  # of full visibility: what a switch to another person must gain
_STEP_COST_FRAMES = 0.1  # of full visibility: what a step of MAX_STEP must gain
_MAX_PATHS = 16  # kept by the dynamic programming
_TIME_RESOLUTION_FRAMES = 0.01  # below any clock's resolution
_MAX_ERROR_SHARE = 0.04  # of two views of one person, relative to its height in the image


def choose_people(rig: Rig, keypoints: Sequence[Keypoints]) -> list[NDArray]:
    """Choose the target person: for each record the index (F,) of its detection in each frame, -1 for none.

    In every frame, detections of different records are grouped if their keypoints intersect in space. Dynamic
    programming finds the path through the groups with the largest sum of keypoint confidences over the take and few
    switches. Of several detectors' records of a camera, the most confident one is used (a face mesh last). The others
    follow by bounding boxes, or by themselves where the first sees no person and both agree elsewhere.

    Parameters
    ----------
    keypoints : records of F frames, each with detections (F, P, k, 2) [px] of one or several people

    Raises
    ------
    TrackingError
        No person is detected in any frame.
    """
    sets = list(dict.fromkeys(k.names for k in keypoints))
    of_set = {names: [q for q, k in enumerate(keypoints) if k.names == names] for names in sets}
    chosen: dict[int, NDArray] = {}
    for indices in of_set.values():
        chosen |= zip(indices, _choose_in_one_set(rig, [keypoints[q] for q in indices]))
    frames = min(len(k) for k in keypoints)
    totals = {n: sum(float(confidences(keypoints[q], frames).sum()) for q in own) for n, own in of_set.items()}
    main_set = max(totals, key=lambda n: (n != MEDIAPIPE_478, totals[n]))
    main_of = {keypoints[q].camera: q for q in reversed(of_set[main_set])}
    for q, record in enumerate(keypoints):
        main = main_of.get(record.camera, q)
        if main != q:
            by_box = match_by_boxes([chosen[main]], keypoints[main], record)[0][:frames]
            both = (by_box >= 0) & (chosen[q] >= 0)
            is_own = (chosen[main] < 0) & (np.mean((by_box == chosen[q])[both]) > 0.5 if both.any() else False)
            chosen[q] = np.where(is_own, chosen[q], by_box)
    out = [chosen[q] for q in range(len(keypoints))]
    if all(np.all(c < 0) for c in out):
        raise TrackingError("no person is seen in any frame", remedy="Check that the keypoints are of this recording.")
    return out


def person_records(keypoints: Sequence[Keypoints], people: Sequence[NDArray]) -> tuple[Keypoints, ...]:
    """Reduce records to one person, and resample them to common times.

    If a camera's frames lie between those times, its points are interpolated linearly between two frames that both show
    the point.

    Parameters
    ----------
    keypoints : Q records of the same number of frames F
    people : Q arrays (F,) int, index of the person in each record, -1 for none; see `choose_people`
    """
    start = common_start(keypoints)
    return tuple(_at_times(_select_person(record, p), start) for record, p in zip(keypoints, people, strict=True))


def _select_person(record: Keypoints, person: NDArray) -> Keypoints:
    if record.points.shape[1] == 1 and np.all(person == 0):
        return record
    selected = record.of_one(person)
    return replace(selected, points=sealed(kept(selected.points)), confidence=sealed(kept(selected.confidence)))


def _at_times(record: Keypoints, start: float) -> Keypoints:
    late = float(start - record.times[0]) * record.rate if len(record) else 0.0
    if abs(late) < _TIME_RESOLUTION_FRAMES or len(record) < 2:
        return record
    lifted = None if record.lifted is None else between_frames(record.lifted, late)
    points, confidence = (between_frames(v, late) for v in (record.points, record.confidence))
    return replace(
        record, points=sealed(kept(points)), confidence=sealed(kept(np.nan_to_num(confidence))), lifted=lifted,
        time_offset=start,
    )  # fmt: skip


def common_start(keypoints: Sequence[Keypoints]) -> float:
    """Common time [s] of the records' first frames: their median, rounded to a multiple of the frame interval."""
    rate = keypoints[0].rate
    return float(np.round(np.median([k.times[0] for k in keypoints if len(k)] or [0.0]) * rate) / rate)


def between_frames(values: NDArray, late: float) -> NDArray:
    """Values (F, ...) interpolated linearly at a fraction `late` of frames later; NaN next to missing ones."""
    at = np.clip(np.arange(len(values)) + late, 0, len(values) - 1)
    before = np.minimum(at.astype(int), len(values) - 2)
    share = (at - before).reshape(-1, *[1] * (values.ndim - 1))
    a, b = values[before], values[before + 1]
    out: NDArray = np.where(share == 0, a, np.where(share == 1, b, (1 - share) * a + share * b))
    return out


def _choose_in_one_set(rig: Rig, keypoints: Sequence[Keypoints]) -> list[NDArray]:
    """(F,) index of the target person in each of several records of one keypoint set."""
    frames = min(len(k) for k in keypoints)
    confidence = [confidences(k, frames) for k in keypoints]
    chosen = [np.full(frames, -1) for _ in keypoints]
    if all(k.points.shape[1] == 1 for k in keypoints):
        for c, sums in zip(chosen, confidence, strict=True):
            c[sums[:, 0] > 0] = 0
    else:
        meetings = meeting_points(rig, keypoints, confidence, frames)
        full_score = len(keypoints) * max(len(k.names) for k in keypoints)
        groups = []
        for f in range(frames):
            ranked = [(float(s[f, p]), q, int(p)) for q, s in enumerate(confidence) for p in np.flatnonzero(s[f] > 0)]
            people = [(q, p) for _, q, p in sorted(ranked, reverse=True)]
            links = {pair: centre[f] for pair, centre in meetings.items() if np.isfinite(centre[f, 0])}
            groups.append(group_views(people, links, confidence, f, full_score))
        for f, group in enumerate(_best_path(groups, keypoints[0].rate)):
            for q, p in group:
                chosen[q][f] = p
    return chosen


Node = tuple[int, int]  # record, person in it


def confidences(record: Keypoints, frames: int) -> NDArray:
    """(F, P) sum of the keypoint confidences of each detection; 0 with too few visible points."""
    visible = np.isfinite(record.points[:frames]).all(axis=-1) & (record.confidence[:frames] > 0.1)
    total = np.where(visible, record.confidence[:frames], 0.0).sum(axis=-1)
    return np.where(visible.sum(axis=-1) >= _MIN_POINTS, total, 0.0)


def some_columns(count: int) -> NDArray:
    """(k,) int, at most 13 columns of `count` keypoints, spread over the set."""
    return np.unique(np.linspace(0, count - 1, _MAX_COMPARED_POINTS).astype(int))


def meeting_points(
    rig: Rig, keypoints: Sequence[Keypoints], confidence: Sequence[NDArray], frames: int
) -> dict[tuple[Node, Node], NDArray]:
    """For each pair of detections its centre (F, 3) [m] where both are of one person; NaN elsewhere."""
    out = {}
    for i, a in enumerate(keypoints):
        for j, b in enumerate(keypoints[i + 1 :], start=i + 1):
            if a.camera == b.camera or a.names != b.names:
                continue
            pair = rig.select((a.camera, b.camera))
            for pa in range(a.points.shape[1]):
                for pb in range(b.points.shape[1]):
                    both = np.flatnonzero((confidence[i][:, pa] > 0) & (confidence[j][:, pb] > 0))
                    centre = np.full((frames, 3), np.nan)
                    if both.size:
                        at = both[:, None], some_columns(len(a.names))
                        uv = (np.where((k.confidence[:, p][at] > 0.1)[..., None], k.points[:, p][at], np.nan)
                              for k, p in ((a, pa), (b, pb)))  # fmt: skip
                        centre[both] = _meeting_points_of(pair, *uv)
                    out[(i, pa), (j, pb)] = centre
    return out


def link_views(
    pairs: Mapping[tuple[int, int], Rig], uv: Sequence[NDArray], nodes: Sequence[Node]
) -> dict[tuple[Node, Node], NDArray]:
    """Centre (3,) [m] of every pair of detections of one frame that are of one person.

    Parameters
    ----------
    pairs : rigs of two cameras, by the indices of their records
    uv : for each record (P, k, 2) [px] of all detections in this frame; NaN where not visible
    nodes : detections to compare
    """
    out = {}
    for (i, j), pair in pairs.items():
        a, b = ([p for q, p in nodes if q == record] for record in (i, j))
        if a and b:
            pa, pb = (k.ravel() for k in np.meshgrid(a, b, indexing="ij"))
            for m, n, centre in zip(pa, pb, _meeting_points_of(pair, uv[i][pa], uv[j][pb])):
                if np.isfinite(centre[0]):
                    out[(i, int(m)), (j, int(n))] = centre
    return out


def _meeting_points_of(pair: Rig, a: NDArray, b: NDArray) -> NDArray:
    """(N, 3) [m] median triangulated point of detections (N, k, 2) [px] of two cameras; NaN where they disagree."""
    uv = np.stack([a, b], axis=2)
    uv = np.where(np.isfinite(uv).all(axis=(2, 3))[..., None, None], uv, np.nan)
    x = triangulate(pair, uv.reshape(-1, 2, 2)).reshape(*uv.shape[:2], 3)
    error = np.stack([np.linalg.norm(c.project(x) - uv[:, :, k], axis=-1) for k, c in enumerate(pair)], axis=-1)
    size = np.mean(heights(np.moveaxis(uv, 1, 2)), axis=1)  # NaN without a common point
    consistent = medians(error.reshape(len(uv), -1)) < _MAX_ERROR_SHARE * size
    consistent &= np.isfinite(error).all(axis=-1).sum(axis=1) >= _MIN_POINTS
    return np.where(consistent[:, None], medians(np.moveaxis(x, 1, -1)), np.nan)


@dataclass(frozen=True)
class DetectionGroup:
    """Detections of one person in one frame."""

    nodes: tuple[Node, ...]
    score: float  # 1: all keypoints in all cameras with confidence 1
    centre: NDArray  # (3,) [m]; NaN with a single camera


def group_views(
    people: list[Node], meetings: Mapping[tuple[Node, Node], NDArray], confidence: Sequence[NDArray], frame: int,
    full: float,
) -> list[DetectionGroup]:  # fmt: skip
    """Group the detections of different records in a frame into people: sets that all agree pairwise.

    Without any agreeing pair, every detection is a group of its own.

    Parameters
    ----------
    people : detections, the most confident first
    meetings : centre (3,) [m] of each agreeing pair
    confidence : (F, P) for each record, see `confidences`
    full : sum of confidences that has the score 1
    """
    detections = set(people)
    links = {pair: centre for pair, centre in meetings.items() if pair[0] in detections and pair[1] in detections}
    found: dict[frozenset[Node], DetectionGroup] = {}
    for pair in links:
        group = list(pair)
        for node in people:
            if all(node[0] != m[0] and ((node, m) in links or (m, node) in links) for m in group):
                group.append(node)
        score = sum(float(confidence[q][frame, p]) for q, p in group) / full
        # over all pairs, as one of them may share only half of the body
        middle = medians(np.array([c for (a, b), c in links.items() if a in group and b in group]).T)
        found.setdefault(frozenset(group), DetectionGroup(tuple(group), score, middle))
    unknown = np.full(3, np.nan)
    return list(found.values()) or [
        DetectionGroup(((q, p),), float(confidence[q][frame, p]) / full, unknown) for q, p in people
    ]


def _best_path(groups: Sequence[Sequence[DetectionGroup]], rate: float) -> list[tuple[Node, ...]]:
    """Detections of one person in each frame (dynamic programming): the path of largest score through the groups."""
    value, centre, unseen = np.zeros(1), np.full((1, 3), np.nan), np.zeros(1)  # of every path kept
    history: list[tuple[NDArray, NDArray]] = []  # for each path its predecessor, and its group or -1
    for candidates in groups:
        at = np.array([g.centre for g in candidates]).reshape(-1, 3)
        distance = np.linalg.norm(at[:, None] - centre, axis=-1)  # (groups, paths); NaN if a centre is unknown
        is_switch = distance > MAX_STEP + MAX_SPEED * (unseen + 1) / rate
        step_share = np.where(np.isnan(distance), 0.0, np.minimum(distance / MAX_STEP, 1))
        cost = np.where(is_switch, _SWITCH_COST_S * rate, _STEP_COST_FRAMES * step_share**2)
        total = value - cost
        before = total.argmax(axis=1)
        gain = total.max(axis=1) + [g.score for g in candidates]
        at = np.where(np.isfinite(at), at, centre[before])
        value, centre = np.concatenate([gain, value]), np.concatenate([at, centre])
        before = np.concatenate([before, np.arange(len(unseen))])
        group = np.concatenate([np.arange(len(candidates)), np.full(len(unseen), -1)])
        unseen = np.concatenate([np.zeros(len(candidates)), unseen + 1])
        best = _prune_paths(value, centre, unseen)
        value, centre, unseen = value[best], centre[best], unseen[best]
        history.append((before[best], group[best]))
    path, chosen = 0, []
    for (before, group), candidates in zip(reversed(history), reversed(groups)):
        chosen.append(candidates[group[path]].nodes if group[path] >= 0 else ())
        path = int(before[path])
    return chosen[::-1]


def _prune_paths(value: NDArray, centre: NDArray, unseen: NDArray) -> list[int]:
    """Indices of the best paths with different end points, the best first."""
    best: list[int] = []
    is_near = np.linalg.norm(centre[:, None] - centre, axis=-1) < MAX_STEP
    covered = is_near & (unseen <= unseen[:, None])
    for path in np.argsort(-value, kind="stable"):
        if not covered[path, best].any():
            best.append(int(path))
        if len(best) == _MAX_PATHS:
            break
    return best


def medians(values: NDArray) -> NDArray:
    """(...) medians of the finite values (..., k) along the last axis; NaN where none is finite."""
    rows = np.ascontiguousarray(values, float).reshape(-1, values.shape[-1])
    out = np.empty(len(rows))
    _kernels_medians.medians(rows, np.empty(rows.shape[1]), out)
    return out.reshape(values.shape[:-1])


def heights(uv: NDArray) -> NDArray:
    """(...) heights [px] in the image of people with points (..., K, 2) [px]; NaN without any finite point."""
    return np.fmax.reduce(uv[..., 1], axis=-1) - np.fmin.reduce(uv[..., 1], axis=-1)


def distances(camera: Camera, x_world: NDArray, uv: NDArray) -> NDArray:
    """(T, P) median image distance of people (T, k, 3) [m] from detections (P, k, 2) [px], relative to their heights.

    Infinite with fewer than three common points.
    """
    x, detections = np.ascontiguousarray(x_world, float), np.ascontiguousarray(uv, float)
    out = np.empty((len(x), len(detections)))
    _kernels_medians.distances(camera.packed, x, detections, out)
    return out
