"""Keypoints of one person in all cameras, with left and right corrected, and how well the cameras agree on them.

One of two cameras that was rotated about itself since the calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.findings import Finding, frame_ranges, listed
from kinefit.fitting.multiview.association import choose_people
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import triangulate, triangulate_robust
from kinefit.observations import Keypoints
from kinefit.observations.recordings import mirror_name

MAX_ERROR_SHARE = 0.03  # of the image's diagonal: cameras that differ by more did not detect the same point
MIN_CONFIDENCE = 0.3  # of a point; detectors give occluded points less
_MIN_PAIRS = 3  # left-right pairs needed to decide the sides
_SAMPLE_FRAMES = 16
_SAMPLE_POINTS = 14  # of a frame, spread over the set
_MAX_SWAPPED_ERROR = 0.6  # of swapped pairs, as a share of their error before; else the detector is believed


@dataclass(frozen=True, eq=False)
class KeypointViews:
    """Keypoints (pixels) of one person: K points in F frames of the C cameras of a rig.

    Parameters
    ----------
    rig : Rig
    names : (K,)
    partner : (K,) int
        Index of the same point on the other side; its own for a point in the middle.
    rate : float [Hz]
    uv : (F, K, C, 2) [px]
        In the calibration's image; NaN where not detected or below the confidence limit.
    swapped : (F, C) bool
        Where left and right were swapped to make `uv`.
    begins : (C,) [s]
        Time of every camera's first frame.
    """

    rig: Rig
    names: tuple[str, ...]
    partner: NDArray
    rate: float
    uv: NDArray
    swapped: NDArray
    begins: NDArray

    def __len__(self) -> int:
        return len(self.uv)

    @property
    def limit(self) -> float:
        """Largest reprojection error [px] of views of the same point."""
        return MAX_ERROR_SHARE * max(float(np.hypot(*camera.size)) for camera in self.rig)

    def at(self, frames: NDArray) -> KeypointViews:
        """The views of frames (N,) int."""
        return replace(self, uv=self.uv[frames], swapped=self.swapped[frames])

    def spread(self, count: int) -> KeypointViews:
        """At most `count` frames, spread over the recording."""
        return self.at(spread(len(self), count))

    def select(self, cameras: Sequence[str]) -> KeypointViews:
        """The views of some cameras."""
        at = [self.rig.index(name) for name in cameras]
        return replace(
            self, rig=self.rig.select(tuple(cameras)), uv=self.uv[:, :, at], swapped=self.swapped[:, at],
            begins=self.begins[at],
        )  # fmt: skip

    def pixels(self) -> NDArray:
        """All points (F · K, C, 2) [px], frame after frame."""
        return self.uv.reshape(-1, len(self.rig), 2)

    def without(self, c: int) -> KeypointViews:
        """The views of all cameras but the one of index c."""
        return self.select([name for k, name in enumerate(self.rig.names) if k != c])


def spread(length: int, count: int) -> NDArray:
    """At most `count` indices of `length` ones, evenly spread."""
    return np.unique(np.linspace(0, length - 1, min(count, length)).astype(int))


def make_views(rig: Rig, keypoints: Sequence[Keypoints], *, filled: bool = False) -> KeypointViews:
    """Select the detections of the person on which most cameras agree.

    Parameters
    ----------
    rig : Rig
    keypoints : records of the same number of frames and the same rate.
    filled : bool, whether to use the tallest detection in frames where the cameras agree on no person.

    Raises
    ------
    TrackingError
        No person is detected in any frame.
    """
    people = choose_people(rig, keypoints)
    sets: dict[str, tuple[str, ...]] = {}
    for record in keypoints:
        sets.setdefault(record.keypoint_set, record.names)
    starts = dict(zip(sets, np.cumsum([0, *map(len, sets.values())]), strict=False))
    names = tuple(name for of_set in sets.values() for name in of_set)
    frames = min(len(record) for record in keypoints)
    uv = np.full((frames, len(names), len(rig), 2), np.nan)
    begins = np.full(len(rig), np.nan)
    for record, chosen in zip(keypoints, people, strict=True):
        c, start = rig.index(record.camera), starts[record.keypoint_set]
        points, begins[c] = _of_person(record, chosen[:frames], filled), record.time_offset
        uv[:, start : start + len(record.names), c] = points
    partner = []
    for name, of_set in sets.items():
        partner += [
            starts[name] + (of_set.index(m) if (m := mirror_name(n)) in of_set else i) for i, n in enumerate(of_set)
        ]
    known = begins[np.isfinite(begins)]
    begins = np.where(np.isfinite(begins), begins, known.min())
    return KeypointViews(
        rig, names, np.array(partner), keypoints[0].rate, uv, np.zeros((frames, len(rig)), bool), begins
    )


def _of_person(record: Keypoints, chosen: NDArray, filled: bool) -> NDArray:
    """Points (F, K, 2) [px] of the chosen person; of the tallest one if the cameras agree on none in most frames.

    With `filled`, also of the tallest one in single frames without agreement.
    """
    frames = np.arange(len(chosen))
    points = np.where((record.confidence > MIN_CONFIDENCE)[..., None], record.points, np.nan)[: len(chosen)]
    if not points.shape[1]:
        return np.full((len(chosen), len(record.names), 2), np.nan)
    seen = np.isfinite(points).all(-1)
    has_person = np.any(seen, axis=(1, 2))
    disagree = np.sum(chosen >= 0) < 0.5 * has_person.sum()
    if disagree or filled:
        low, high = (np.where(seen, points[..., 1], fill) for fill in (np.inf, -np.inf))
        tall = np.where(seen.any(-1), high.max(-1) - low.min(-1), -1.0)
        chosen = np.where(has_person & (disagree | (chosen < 0)), np.argmax(tall, axis=1), chosen)
    return np.where((chosen >= 0)[:, None, None], points[frames, np.maximum(chosen, 0)], np.nan)


def meet(views: KeypointViews) -> tuple[NDArray, NDArray]:
    """Triangulate each point: x_world (F, K, 3) [m], and the cameras (F, K, C) bool that agree on it."""
    x, agree, _ = triangulate_robust(views.rig, views.pixels(), max_residual_px=views.limit)
    shape = views.uv.shape[:2]
    return x.reshape(*shape, 3), agree.reshape(*shape, len(views.rig))


def from_others(views: KeypointViews, c: int) -> NDArray:
    """Predict the points (F, K, 2) [px] of camera c from all other cameras; NaN where these do not agree."""
    uv = views.pixels().copy()
    uv[:, c] = np.nan
    x, _, _ = triangulate_robust(views.rig, uv, max_residual_px=views.limit)
    return views.rig.cameras[c].project(x).reshape(*views.uv.shape[:2], 2)


def with_sides_right(views: KeypointViews) -> KeypointViews:
    """Correct left and right in single cameras and frames, where the other cameras clearly contradict the detector.

    Needs three cameras: with two it is undecidable which one is wrong. In every frame the camera with the largest gain
    is corrected first, then the others are compared again.
    """
    paired = np.flatnonzero(views.partner != np.arange(len(views.partner)))
    cameras = len(views.rig)
    if cameras < 3 or not len(paired):
        return views
    todo = np.arange(len(views))
    for _ in range(cameras - 1):
        part = views.at(todo)
        gain = np.stack([_gain(part, c, paired) for c in range(cameras)], axis=1)  # (F, C)
        best = np.argmax(gain, axis=1)
        wrong = gain[np.arange(len(todo)), best] > 0
        if not wrong.any():
            break
        frames, which = todo[wrong], best[wrong]
        uv, swapped = views.uv.copy(), views.swapped.copy()
        uv[frames, :, which] = uv[frames[:, None], views.partner, which[:, None]]
        swapped[frames, which] ^= True
        views, todo = replace(views, uv=uv, swapped=swapped), frames
    return views


def _gain(views: KeypointViews, c: int, paired: NDArray) -> NDArray:
    """Error reduction (F,) [px] by swapping left and right in camera c; 0 where it is not clear."""
    predicted, detected = from_others(views, c)[:, paired], views.uv[:, :, c]
    error, swapped_error = (
        np.minimum(np.linalg.norm(detected[:, order] - predicted, axis=-1), views.limit)
        for order in (paired, views.partner[paired])
    )
    both = np.isfinite(error) & np.isfinite(swapped_error)
    count = both.sum(axis=1)
    before, after = (np.where(both, e, 0.0).sum(axis=1) / np.maximum(count, 1) for e in (error, swapped_error))
    return np.where((count >= 2 * _MIN_PAIRS) & (after < _MAX_SWAPPED_ERROR * before), before - after, 0.0)


def sample(views: KeypointViews) -> NDArray:
    """Sample (N, C, 2) [px] of the points of some frames."""
    at = np.ix_(spread(len(views), _SAMPLE_FRAMES), spread(len(views.names), _SAMPLE_POINTS))
    uv = views.uv[at]
    return uv.reshape(uv.shape[0] * uv.shape[1], len(views.rig), 2)


def disagreement_share(rig: Rig, uv: NDArray) -> float:
    """Mean reprojection error of views (N, C, 2) [px] of points in two or more cameras, as a share 0..1 of the limit.

    Errors are clipped at the limit. 1 where no point is visible in two cameras.
    """
    limit = MAX_ERROR_SHARE * max(float(np.hypot(*camera.size)) for camera in rig)
    detected = np.isfinite(uv).all(-1)
    detected &= (detected.sum(axis=1) >= 2)[:, None]
    if not detected.any():
        return 1.0
    _, agree, residual = triangulate_robust(rig, uv, max_residual_px=limit)
    error = np.where(agree, np.nan_to_num(residual, nan=limit, posinf=limit), limit)
    return float(np.minimum(error, limit)[detected].mean() / limit)



def points_of_others(views: KeypointViews, c: int) -> NDArray:
    """Triangulate the points of `sample` without camera c: (N, 3) [m]; NaN where no two cameras agree."""
    others = views.without(c)
    return triangulate_robust(others.rig, sample(others), max_residual_px=views.limit)[0]


def share_against(x_world: NDArray, camera: Camera, uv: NDArray, limit: float) -> float:
    """Median error of a camera's views (N, 2) [px] of points (N, 3) [m], clipped at the limit [px], as its share 0..1.

    0 where too few points are known.
    """
    both = np.isfinite(x_world).all(axis=1) & np.isfinite(uv).all(axis=1)
    if both.sum() < _SAMPLE_POINTS:
        return 0.0
    error = np.linalg.norm(camera.project(x_world[both]) - uv[both], axis=1)
    return float(np.median(np.minimum(np.nan_to_num(error, nan=limit), limit)) / limit)


def share_against_others(views: KeypointViews, c: int) -> float:
    """Median error, as a share 0..1 of the limit, of camera c against points triangulated by the other cameras."""
    return share_against(points_of_others(views, c), views.rig.cameras[c], sample(views)[:, c], views.limit)



def errors_of(rig: Rig, uv: NDArray) -> NDArray:
    """Reprojection errors (N, C) [px] of views (N, C, 2) [px] of triangulated points; infinite where there is none."""
    x = triangulate(rig, uv)
    error = np.stack([np.linalg.norm(camera.project(x) - uv[:, c], axis=-1) for c, camera in enumerate(rig)], axis=1)
    return np.nan_to_num(error, nan=np.inf, posinf=np.inf)


def median_error(rig: Rig, uv: NDArray) -> float:
    """Median reprojection error [px] of views (N, C, 2) [px] of triangulated points; infinite where there are none."""
    uv = uv[np.isfinite(uv).all(-1).sum(axis=1) >= max(2, len(rig) - 1)]
    return float(np.median(errors_of(rig, uv)[np.isfinite(uv).all(-1)])) if len(uv) else np.inf


def pair_misses(views: KeypointViews) -> NDArray:
    """Median reprojection error (C, C) [px] of each pair of cameras alone; NaN where they share fewer than 4 points."""
    uv, names = sample(views), views.rig.names
    out = np.full((len(names), len(names)), np.nan)
    for a, b in combinations(range(len(names)), 2):
        both = uv[:, [a, b]][np.isfinite(uv[:, [a, b]]).all(axis=(1, 2))]
        if len(both) >= 4:
            error = errors_of(views.rig.select((names[a], names[b])), both)
            out[a, b] = out[b, a] = float(np.median(error.max(axis=1)))
    return out


def side_findings(views: KeypointViews) -> list[Finding]:
    """Findings on frames in which the detector swapped left and right."""
    if len(views.rig) < 3:
        return [Finding("note", "sides", "Left/right swaps cannot be assigned to a camera: only two cameras.")]
    found = {name: np.flatnonzero(views.swapped[:, c]) for c, name in enumerate(views.rig.names)}
    found = {name: frames for name, frames in found.items() if len(frames)}
    if not found:
        return [Finding("good", "sides", "No left/right swaps in any camera.")]
    exchanges = [f"{len(f)} of {len(views)} frames of {name} ({frame_ranges(f, 6)})" for name, f in found.items()]
    most = max(found, key=lambda name: len(found[name]))
    mostly = len(found[most]) > 0.5 * len(views)
    remedy = f"Check whether the image of {most} is mirrored." if mostly else "Nothing: tracking corrects it."
    text = f"The detector swapped left and right in {listed(exchanges)}."
    confidence = "Certain: after correction they fit the other cameras."
    return [Finding("doubt" if mostly else "note", "sides", text, tuple(found), confidence, remedy)]


_TURN_RANGE = np.radians(1.5), np.radians(15.0)  # of a camera that was moved; calibrated ones: up to 0.7 degrees
_TURN_ROUNDS = 25  # of reweighted least squares
_MAX_TURNED_ERROR = 0.15  # after the rotation, as a share of the limit: a detector's noise is 0.07
_MIN_TURN_GAIN = 2.0  # of the error before to that after: up to 1.5 in pairs of real cameras as calibrated
_MAX_OTHER_RATIO = 0.85  # of that error to the other camera's: about the vertical, both rotations leave nearly the same
_MIN_SINE = 0.15  # of the angle between ray and baseline
_MIN_TURN_POINTS = 100  # in both images


def turned_cameras(views: KeypointViews) -> tuple[Camera, ...]:
    """Of two cameras that disagree those that agree if they are rotated about themselves, as they then stand.

    Empty if they agree as they are or with no rotation. Both, the better first, where a rotation of either explains the
    keypoints; one where a rotation of the other leaves a larger error.
    """
    if len(views.rig) != 2:
        return ()
    found = sorted((_turned(views, c) for c in (0, 1)), key=lambda one: one[0])
    (error, _, angle, camera), (other_error, _, _, other) = found
    is_near = error < _MAX_TURNED_ERROR * views.limit and _TURN_RANGE[0] < angle < _TURN_RANGE[1]
    if not is_near or min(before for _, before, _, _ in found) < _MIN_TURN_GAIN * error:
        return ()
    return (camera,) if error < _MAX_OTHER_RATIO * other_error else (camera, other)


def _turned(views: KeypointViews, c: int) -> tuple[float, float, float, Camera]:
    """Median epipolar errors [px] after and before the rotation of a camera about itself that fits the other's rays.

    And its angle [rad], and the camera as it then stands.
    """
    own, other = views.rig.cameras[c], views.rig.cameras[1 - c]
    rays, others = (camera.ray(uv) for camera, uv in zip((own, other), np.moveaxis(views.pixels(), 1, 0)[[c, 1 - c]]))
    base = other.centre_world - own.centre_world
    normals = np.cross(base / max(np.linalg.norm(base), 1e-9), others)
    sines = np.linalg.norm(normals, axis=1, keepdims=True)
    known = np.isfinite(rays + normals).all(axis=1) & (sines[:, 0] > _MIN_SINE * np.linalg.norm(others, axis=1))
    if known.sum() < _MIN_TURN_POINTS:
        return np.inf, np.inf, 0.0, own
    rays, normals, R = rays[known], (normals / sines)[known], np.eye(3)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    for _ in range(_TURN_ROUNDS):
        there = rays @ R.T
        off = np.sum(normals * there, axis=1)
        weight = 1.0 / (1.0 + np.square(off / (2.0 * np.median(np.abs(off)) + 1e-12)))
        step = np.linalg.lstsq(weight[:, None] * np.cross(there, normals), -weight * off, rcond=None)[0]
        R = se3.exp_so3(step) @ R
    T_world = se3.transform(R, own.centre_world - R @ own.centre_world)
    errors = [own.matrix[0, 0] * float(np.median(np.abs(np.sum(normals * x, axis=1)))) for x in (rays @ R.T, rays)]
    angle = float(np.linalg.norm(se3.log_so3(R)))
    return errors[0], errors[1], angle, own.with_pose(own.T_camera_world @ se3.inverse(T_world))
