"""A first rig from what a network lifted to space in each camera alone: no lens, clock or place need be known well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.observations import Keypoints

_JOINTS = tuple(
    f"{side}_{joint}" for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for side in ("left", "right")
)
_AHEAD = np.array([0.0, 0.0, 1.0])
_MIN_CONFIDENCE = 0.6  # confidence of a landmark that takes part
_PEOPLE = 4  # of one camera that are tried
_MIN_COMMON_FRAMES = 10  # of two records whose clocks are compared
_MIN_COMMON_SHARE = 0.4  # the same, of the shorter record
_SCALE = 0.05  # [m] of the loss: landmarks of two cameras that are farther apart count less (Geman-McClure)
_STRANGERS = 0.5  # of 1 less the correlation of their movements: one person in two cameras has 0.06 to 0.29, two
# people or two days 0.57 to 0.89, of the real recordings that were looked at
_OVERLAP = 0.25  # power of the share of frames in common: who jumps moves alike a jump later, too, in fewer frames
_PERIOD_WINDOW_S = 0.15  # [s] about a period's best, in which the frames in common say nothing more
_MAX_DOUBLE_PX = 1.0  # [px] two cameras whose landmarks are mostly nearer show one video twice


_Pair = tuple[int, int, int, int]  # camera, person of it, camera, person of it


@dataclass(frozen=True, eq=False)
class FirstCameras:
    """Where cameras stand roughly, the people that they saw, and how late their clocks are.

    Parameters
    ----------
    rig : Rig, in the first camera's axes [m], of a person of the network's idea of size.
    people : for each camera the record of the one person that most cameras show.
    others : the same of each other person; of a camera that does not show them, a record in which all is unseen.
    frames_late : (C,) int [frames] to add to each camera's own, the first camera's being 0.
    """

    rig: Rig
    people: tuple[Keypoints, ...]
    others: tuple[tuple[Keypoints, ...], ...]
    frames_late: NDArray


@dataclass(frozen=True, eq=False)
class LiftedSkeleton:
    """One person of one camera: x (F, J, 3) [m] in its axes, about the hips; weight (F, J); where the hips are."""

    record: Keypoints
    x: NDArray
    weight: NDArray
    hips: NDArray  # (F, 3) [m] from the camera, by the size in the image


@dataclass(frozen=True, eq=False)
class SkeletonMatch:
    """Two skeletons laid on each other: b ≈ R a, frame f of a being frame f + lag of b.

    unlike: (2 · most + 1,) for lags from −most to most, 1 less the correlation of the movements about their means, inf
    where too little is in common. score: the same with the correlation times a power of the overlap; least at lag.
    """

    R: NDArray
    lag: int
    unlike: NDArray
    score: NDArray

    @property
    def cost(self) -> float:
        """The least score: 0 of skeletons that move alike in all frames, 1 of strangers."""
        return float(self.score.min())


def first_cameras(cameras: Sequence[Camera], keypoints: Sequence[Keypoints], *, within: float) -> FirstCameras:
    """Turns, clocks and places of cameras from landmarks that a network lifted to space in each of them.

    A network that lifts a person tells the turn of each camera against the person to 5 to 25 degrees, from any side;
    two cameras are turned against each other, and their clocks set, so that their skeletons lie on each other in all
    frames (W. Kabsch, 1976, robustly), and move alike. The distance comes from the person's size in the image. Cameras
    are taken in along the pairs that agree best, whichever person it is.

    Parameters
    ----------
    cameras : with guessed or known lenses; poses are not used.
    keypoints : one record for each camera, with `lifted`, of equal rate.
    within : float [s] clocks differ by at most this much; 0: they agree.

    Raises
    ------
    CalibrationError
        A camera in which no person is detected, the same video twice, cameras that never show the same person.
    """
    seen = [skeletons_of(c, k) for c, k in zip(cameras, keypoints, strict=True)]
    _refuse_doubles(seen)
    most = round(within * keypoints[0].rate)
    pairs: dict[_Pair, SkeletonMatch] = {}
    for i, j in combinations(range(len(seen)), 2):
        for p, q in product(range(len(seen[i])), range(len(seen[j]))):
            if (match := match_skeletons(seen[i][p], seen[j][q], most)) is not None:
                pairs[i, p, j, q] = match
                pairs[j, q, i, p] = SkeletonMatch(match.R.T, -match.lag, match.unlike[::-1], match.score[::-1])
    tree = _tree(cameras, pairs)
    late = _clocks(len(seen), keypoints[0].rate, pairs, most)
    Ts = {0: np.eye(4)}
    for i, p, j, q in tree:  # in the order in which they were taken in
        Ts[j] = _laid(seen[i][p], seen[j][q], int(late[i] - late[j])) @ Ts[i]
    rig = Rig(tuple(camera.with_pose(Ts[c]) for c, camera in enumerate(cameras)))
    groups = _people([len(people) for people in seen], pairs, late, most)
    if not groups:  # clocks that suit all pairs together suit none
        raise _strangers(cameras[1])
    first, *others = (
        tuple(seen[c][one[c]].record if c in one else record.of_one(np.full(len(record), -1))
              for c, record in enumerate(keypoints))
        for one in groups
    )  # fmt: skip
    return FirstCameras(rig, first, tuple(others), late)


def in_step(record: Keypoints, late: int, length: int) -> Keypoints:
    """A record moved by whole frames, so that frame f is what was seen at f − late; of `length` frames."""
    at = np.arange(length) - late
    inside = (at >= 0) & (at < len(record))
    at = np.clip(at, 0, len(record) - 1)
    points = np.where(inside[:, None, None, None], record.points[at], np.nan)
    confidence = np.where(inside[:, None, None], record.confidence[at], 0.0)
    lifted = None
    if record.lifted is not None:
        lifted = np.where(inside[:, None, None, None], record.lifted[at], np.nan)
    return replace(record, points=points, confidence=confidence, lifted=lifted)


def skeletons_of(camera: Camera, record: Keypoints) -> list[LiftedSkeleton]:
    """The people that a camera followed, the one seen best first."""
    assert record.lifted is not None
    out: list[LiftedSkeleton] = []
    left = record
    columns = [record.names.index(name) for name in _JOINTS]
    for _ in range(min(record.points.shape[1], _PEOPLE)):
        try:
            chosen = steadiest(left)
        except CalibrationError:
            if out:
                break
            raise
        one = left.of_one(chosen)
        assert one.lifted is not None
        x, uv = one.lifted[:, 0][:, columns], one.points[:, 0][:, columns]
        confidence = one.confidence[:, 0][:, columns]
        known = np.isfinite(x).all(axis=-1) & np.isfinite(uv).all(axis=-1) & (confidence > _MIN_CONFIDENCE)
        out.append(_placed(camera, one, np.where(known[..., None], x, np.nan), uv, np.where(known, confidence, 0.0)))
        taken = np.zeros(left.confidence.shape[:2], bool)
        taken[np.flatnonzero(chosen >= 0), chosen[chosen >= 0]] = True
        left = replace(
            left, points=np.where(taken[..., None, None], np.nan, left.points),
            confidence=np.where(taken[..., None], 0.0, left.confidence),
        )  # fmt: skip
    return out


def _placed(camera: Camera, record: Keypoints, x: NDArray, uv: NDArray, weight: NDArray) -> LiftedSkeleton:
    """With the axes of the crop turned to the camera's, and the distance at which it has its size in the image."""
    ray = camera.with_pose(np.eye(4)).ray(uv.reshape(-1, 2)).reshape(*uv.shape[:2], 3)
    ray = ray / np.where(ray[..., 2:] > 1e-6, ray[..., 2:], np.nan)
    w = np.where(np.isfinite(ray).all(axis=-1), weight, 0.0)
    total = np.maximum(w.sum(axis=1), 1e-9)
    ahead = np.einsum("fk,fkd->fd", w, np.nan_to_num(ray)) / total[:, None]
    crop = se3.shortest_turn(_AHEAD, ahead)  # it is seen as if the camera looked at its middle
    x = np.einsum("fij,fkj->fki", crop, x)
    A = np.zeros((*uv.shape, 3))
    A[..., 0, 0] = A[..., 1, 1] = 1.0
    A[..., 2] = -np.nan_to_num(ray[..., :2])
    b = np.nan_to_num(ray[..., :2] * x[..., 2:] - x[..., :2])
    normal = np.einsum("fk,fkdi,fkdj->fij", w, A, A) + 1e-9 * np.eye(3)
    hips = np.linalg.solve(normal, np.einsum("fk,fkdi,fkd->fi", w, A, b)[..., None])[..., 0]
    far = (w > 0).sum(axis=1) >= len(_JOINTS) // 2
    return LiftedSkeleton(record, x, w * far[:, None], np.where((far & (hips[:, 2] > 0))[:, None], hips, np.nan))


def _refuse_doubles(seen: Sequence[Sequence[LiftedSkeleton]]) -> None:
    """Refuse one video under two names, which shows nothing from a second side."""
    for a, b in combinations([people[0].record for people in seen], 2):
        frames = min(len(a), len(b))
        away = np.linalg.norm(a.points[:frames, 0] - b.points[:frames, 0], axis=-1)
        if np.isfinite(away).sum() > _MIN_COMMON_FRAMES and np.nanmedian(away) < _MAX_DOUBLE_PX:
            raise CalibrationError(
                f"{a.camera} and {b.camera} show the same images", place=f"camera {b.camera}",
                remedy="It is one video twice: remove one.",
            )


def _common(a: LiftedSkeleton, b: LiftedSkeleton, lag: int) -> tuple[slice, slice] | None:
    """Frames of both that belong together with a lag; None for too few."""
    first, last = max(0, -lag), min(len(a.x), len(b.x) - lag)
    if last - first < max(_MIN_COMMON_FRAMES, _MIN_COMMON_SHARE * min(len(a.x), len(b.x))):
        return None
    return slice(first, last), slice(first + lag, last + lag)


def _turned(a: LiftedSkeleton, b: LiftedSkeleton, frames: tuple[slice, slice]) -> NDArray | None:
    """(3, 3) turn that lays one skeleton on the other in frames of both, robustly; None for too few joints."""
    x, y, w = a.x[frames[0]], b.x[frames[1]], np.minimum(a.weight[frames[0]], b.weight[frames[1]])
    x, y, w = (v[w > 0] for v in (x, y, w))
    if len(w) < _MIN_COMMON_FRAMES * len(_JOINTS) // 4:
        return None
    share = w
    for _ in range(5):
        R = se3.nearest_rotation((share[:, None] * y).T @ x)
        share = w / (1.0 + np.sum((y - x @ R.T) ** 2, axis=1) / _SCALE**2) ** 2
    return R


def match_skeletons(a: LiftedSkeleton, b: LiftedSkeleton, most: int) -> SkeletonMatch | None:
    """The turn and the lag, within so many frames, with which two skeletons move alike; None for no frames."""
    unlike, score = np.full(2 * most + 1, np.inf), np.full(2 * most + 1, np.inf)
    best: tuple[NDArray, int] | None = None
    for lag in range(-most, most + 1):
        frames = _common(a, b, lag)
        if frames is None or (R := _turned(a, b, frames)) is None:
            continue
        alike = _correlation(a, b, frames, R)
        share = (frames[0].stop - frames[0].start) / min(len(a.x), len(b.x))
        unlike[lag + most], score[lag + most] = 1.0 - alike, 1.0 - alike * share**_OVERLAP
        if score[lag + most] <= score.min():
            best = R, lag
    return None if best is None else SkeletonMatch(*best, unlike, score)


def _correlation(a: LiftedSkeleton, b: LiftedSkeleton, frames: tuple[slice, slice], R: NDArray) -> float:
    """Of the movements of two skeletons about their means, one turned by R, in frames of both."""
    w = np.minimum(a.weight[frames[0]], b.weight[frames[1]])[..., None]
    x, y = np.where(w > 0, a.x[frames[0]] @ R.T, 0.0), np.where(w > 0, b.x[frames[1]], 0.0)
    total = np.maximum(w.sum(axis=0), 1e-9)
    x, y = (v - np.sum(w * v, axis=0) / total for v in (x, y))
    power = float(np.sum(w * x * x) * np.sum(w * y * y))
    return float(np.sum(w * x * y)) / max(np.sqrt(power), 1e-12)


def _tree(cameras: Sequence[Camera], pairs: dict[_Pair, SkeletonMatch]) -> list[_Pair]:
    """Pairs along which all cameras are taken in, those first whose people move most alike."""
    tree: list[_Pair] = []
    there = {0}
    while len(there) < len(cameras):
        near = [key for key in pairs if key[0] in there and key[2] not in there]
        best = min(near, key=lambda k: pairs[k].cost, default=None)
        if best is None or pairs[best].cost > _STRANGERS:
            raise _strangers(next(camera for c, camera in enumerate(cameras) if c not in there))
        tree.append(best)
        there.add(best[2])
    return tree


def _strangers(camera: Camera) -> CalibrationError:
    return CalibrationError(
        f"the people in {camera.name} move like no people in the other cameras", place=f"camera {camera.name}",
        remedy="Record a person who moves. Check that it is of the same recording, shows the same person at the same "
        "time, and was started within two seconds of the others; or remove it.",
    )


def _clocks(count: int, rate: float, pairs: dict[_Pair, SkeletonMatch], most: int) -> NDArray:
    """(C,) int [frames] to add to each camera's: with which all pairs together move most alike.

    Frames in common count in the choice between periods, and not in the last frames about it.
    """
    best: dict[tuple[int, int], SkeletonMatch] = {}
    for (i, _, j, _), match in pairs.items():
        if (i, j) not in best or match.cost < best[i, j].cost:
            best[i, j] = match
    late, at = np.zeros(count, int), np.arange(-most, most + 1)
    near = round(_PERIOD_WINDOW_S * rate)
    for turn in range(2 * count):
        before, last = late.copy(), turn >= count
        for j in range(1, count):
            total = np.zeros(len(at))
            for i in range(count):
                if (i, j) in best and (i < j or turn):
                    lag = late[i] - at  # of j's frames behind i's
                    curve = np.minimum(best[i, j].unlike if last else best[i, j].score, 1.0)
                    total += np.where(np.abs(lag) <= most, curve[np.clip(lag + most, 0, 2 * most)], 1.0)
            total[np.abs(at - late[j]) > (near if last else 2 * most)] = np.inf
            late[j] = at[np.argmin(total)]
        if last and np.array_equal(before, late):
            break
    return late


def _people(counts: Sequence[int], pairs: dict[_Pair, SkeletonMatch], late: NDArray, most: int) -> list[dict[int, int]]:
    """People as {camera: which}, those in most cameras first: with the clocks set, they move alike in each."""

    def unlike(i: int, p: int, j: int, q: int) -> float:
        lag = int(late[i] - late[j])
        match = pairs.get((i, p, j, q))
        return np.inf if match is None or abs(lag) > most else float(match.unlike[lag + most])

    left = {(c, p) for c, count in enumerate(counts) for p in range(count)}
    out: list[tuple[int, float, dict[int, int]]] = []
    while left:
        tried = []
        for root in left:
            one, cost = {root[0]: root[1]}, 0.0
            while True:
                near = [(unlike(i, p, *other), other) for i, p in one.items() for other in left if other[0] not in one]
                best = min(near, default=(np.inf, (0, 0)))
                if best[0] > _STRANGERS:
                    break
                one[best[1][0]], cost = best[1][1], cost + best[0]
            tried.append((-len(one), cost, one))
        out.append(min(tried, key=lambda trial: trial[:2]))
        left -= set(out[-1][2].items())
    return [one for size, _, one in sorted(out, key=lambda trial: trial[:2]) if size <= -2]


def _laid(a: LiftedSkeleton, b: LiftedSkeleton, lag: int) -> NDArray:
    """T_b_a (4, 4) [m] of two cameras from one person's skeletons and places in both."""
    frames = _common(a, b, lag)
    R = None if frames is None else _turned(a, b, frames)
    if frames is None or R is None:
        raise CalibrationError(
            f"{a.record.camera} and {b.record.camera} rarely see the person at the same time",
            place=f"camera {b.record.camera}", remedy="Trim the videos to the time that all cameras recorded.",
        )  # fmt: skip
    moved = b.hips[frames[1]] - a.hips[frames[0]] @ R.T
    moved = moved[np.isfinite(moved).all(axis=1)]
    return se3.transform(R, np.median(moved, axis=0) if len(moved) else np.zeros(3))


def steady_person(record: Keypoints) -> Keypoints:
    """One person of a camera in all frames: the most confident one, then the nearest to the last position.

    Raises
    ------
    CalibrationError
        No person is detected in any frame.
    """
    return record.of_one(steadiest(record))


def steadiest(record: Keypoints) -> NDArray:
    """(F,) int: which of the people `steady_person` is in each frame, -1 where unseen; raises as it does."""
    frames, people = record.points.shape[:2]
    seen = np.isfinite(record.points).all(axis=-1) & (record.confidence > 0.1)
    sure = np.where(seen, record.confidence, 0.0).sum(axis=-1)
    x = np.where(seen[..., None], record.points, np.nan)
    with np.errstate(all="ignore"):
        count = np.maximum(seen.sum(axis=2), 1)[..., None]
        centre = np.nansum(x, axis=2) / count
        size = np.sqrt(np.nansum((x - centre[:, :, None]) ** 2, axis=(2, 3)) / count[..., 0])
    size = np.where(sure > 0, size, 0.0)
    best = int(np.argmax((sure * size).max(axis=1))) if people else 0
    chosen = np.full(frames, -1)
    for order in (range(best, frames), range(best, -1, -1)):
        last: NDArray | None = None
        for f in order:
            near = 1.0 if last is None else np.exp(-np.linalg.norm(centre[f] - last, axis=1) / np.maximum(size[f], 1.0))
            score = sure[f] * size[f] * near if people else np.zeros(1)
            if score.max() > 0:
                chosen[f] = int(np.argmax(score))
                last = centre[f, chosen[f]]
    if not (chosen >= 0).any():
        raise CalibrationError(
            "no frame has a person", file=record.source or None, place=f"camera {record.camera}",
            remedy="Remove this camera, or detect again.",
        )
    return chosen
