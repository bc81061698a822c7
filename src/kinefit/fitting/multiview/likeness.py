"""Re-identify people by appearance: the lengths of their bones and the colours of their clothes.

Both are vectors that differ less between two spans of one person than between people. The likelihood ratio of one
person to two depends on their difference only (Gaussian within and between people; the mean of all people cancels).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.fitting.multiview.association import medians
from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.geometry.lines import triangulate_robust
from kinefit.observations import Keypoints

ImageSource = Callable[[str, int], tuple[NDArray, ImageFrame | None] | None]
"""(camera, frame) -> image (H, W, 3) uint8 RGB and its image frame (None: that of the calibration), or None."""

_PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_LIMBS = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
_BONE_COUNT = 7  # the four limbs (left and right pooled), the trunk, breadth of shoulders and hips
_MAX_BONE_FRAMES = 60  # of a span, for lengths
_ERROR_TIME_S = 0.3  # after which a detector's errors are independent
_SIGMA_PER_MAD = 1.4826  # standard deviation over median absolute deviation of a normal distribution
_MIN_BONE_FRAMES = 5  # that show a bone

# Relative standard deviation of measured lengths between poses and places of one person: limbs, trunk, breadths.
# Measured with the built-in detector on a man and a woman in four cameras, between spans of half a second.
_BONE_SIGMAS = np.array([0.02, 0.025, 0.02, 0.02, 0.02, 0.04, 0.05])
_STATURE_SIGMA = 0.05  # relative, of adults of both sexes
_PROPORTION_SIGMA = 0.035  # relative, of a bone's length given the stature
_WRONG_SIZE_SHARE = 0.02  # of spans whose lengths are wrong as a whole, since they contain another person's detections

_MAX_COLOUR_FRAMES = 12  # of a span, in every camera
_MIN_PIXELS = 60  # of a part whose colours are used
_QUANTILES = (10, 50, 90)
# Standard deviations of lightness, green-red and blue-yellow (CIELAB), median and half spread: of one person in other
# light, camera or orientation; and of the clothes of different people.
_COLOUR_SIGMAS = np.array([7.0, 3.0, 3.5, 5.0, 1.5, 2.0])
_CLOTHES_SIGMAS = np.array([20.0, 10.0, 12.0, 10.0, 6.0, 6.0])
_CHANGED_CLOTHES_SHARE = 0.05  # of people who return
_SAME_CLOTHES_SHARE = 0.1  # of pairs of people


@dataclass(frozen=True, eq=False)
class Appearance:
    """Appearance of a person, for re-identification.

    Parameters
    ----------
    bones : (7,) logarithms of lengths in metres; NaN where not observed
    bones_std : (7,) standard deviations of `bones` in this span
    colours : (2, 6) of trunk and upper legs: median and half the spread of lightness, green-red and blue-yellow
        (CIELAB, 0 to 100); NaN where not observed
    """

    bones: NDArray
    bones_std: NDArray
    colours: NDArray

    @property
    def is_known(self) -> bool:
        """Whether any bone or colour is known."""
        return bool(np.isfinite(self.bones).any() or np.isfinite(self.colours).any())


def same_log_ratio(a: Appearance, b: Appearance, *, wrong_size: float = _WRONG_SIZE_SHARE) -> float:
    """Logarithm of the likelihood ratio of one person to two people; 0 if nothing is known.

    Parameters
    ----------
    wrong_size : share (0 to 1) of spans whose lengths are wrong as a whole, as they contain another person's detections
    """
    return size_log_ratio(a, b, wrong_size=wrong_size) + colour_log_ratio(a, b)


def common_cues(a: Appearance, b: Appearance) -> tuple[str, ...]:
    """Cues known of both: "size", "clothes"."""
    size, clothes = (bool(np.isfinite(d).any()) for d in (a.bones - b.bones, a.colours - b.colours))
    return ("size",) * size + ("clothes",) * clothes


def size_log_ratio(a: Appearance, b: Appearance, *, wrong_size: float = _WRONG_SIZE_SHARE) -> float:
    """The part of `same_log_ratio` from bone lengths, a number."""
    d = a.bones - b.bones
    known = np.isfinite(d)
    if not known.any():
        return 0.0
    noise = np.diag((a.bones_std**2 + b.bones_std**2 + 2.0 * _BONE_SIGMAS**2)[known])
    people = _STATURE_SIGMA**2 + _PROPORTION_SIGMA**2 * np.eye(int(known.sum()))
    one, two = _log_normal(d[known], noise), _log_normal(d[known], noise + 2.0 * people)
    wrong = np.log(wrong_size) if wrong_size > 0.0 else -np.inf
    return float(np.logaddexp(np.log1p(-wrong_size) + one - two, wrong))


def colour_log_ratio(a: Appearance, b: Appearance) -> float:
    """The part of `same_log_ratio` from the colours of clothes, a number."""
    d = (a.colours - b.colours).ravel()
    known = np.isfinite(d)
    if not known.any():
        return 0.0
    shade, clothes = (np.diag(np.tile(v**2, 2)[known]) for v in (_COLOUR_SIGMAS, _CLOTHES_SIGMAS))
    same, different = _log_normal(d[known], 2.0 * shade), _log_normal(d[known], 2.0 * (shade + clothes))
    one = np.logaddexp(np.log1p(-_CHANGED_CLOTHES_SHARE) + same, np.log(_CHANGED_CLOTHES_SHARE) + different)
    two = np.logaddexp(np.log1p(-_SAME_CLOTHES_SHARE) + different, np.log(_SAME_CLOTHES_SHARE) + same)
    return float(one - two)


def _log_normal(d: NDArray, covariance: NDArray) -> float:
    """Logarithm of a normal density without its factors of 2π."""
    return -0.5 * float(d @ np.linalg.solve(covariance, d) + np.linalg.slogdet(covariance)[1])


def joints_of(names: Sequence[str]) -> dict[tuple[str, str], int]:
    """{(side "l" or "r", part): column} of shoulders, elbows, wrists, hips, knees and ankles, by keypoints' names."""
    out = {}
    for k, name in enumerate(names):
        word = "".join(c for c in name.lower() if c.isalpha())
        for part in _PARTS:
            side = word.replace(part, "", 1)
            if part in word and side in ("l", "r", "left", "right"):
                out[side[0], part] = k
    return out


def bones_of(rig: Rig, keypoints: Sequence[Keypoints], views: Mapping[int, Sequence[tuple[int, int]]]) -> Appearance:
    """Measure the lengths of a person's bones in a span.

    Parameters
    ----------
    rig : Rig
    keypoints : records of one kind
    views : for each frame its (record, detection) pairs, of two or more cameras
    """
    joints = joints_of(keypoints[0].names)
    frames = _spread_frames(views, _MAX_BONE_FRAMES)
    columns = list(joints.values())
    uv = np.full((len(frames), len(columns), len(rig), 2), np.nan)
    limit = []
    for i, f in enumerate(frames):
        for q, p in views[f]:
            record = keypoints[q]
            visible = record.confidence[f, p, columns] > 0.1
            c = rig.index(record.camera)
            uv[i, visible, c] = record.points[f, p, columns][visible]
            if np.isfinite(uv[i, :, c]).any():
                limit.append(np.nanmax(uv[i, :, c, 1]) - np.nanmin(uv[i, :, c, 1]))
    unknown = Appearance(np.full(_BONE_COUNT, np.nan), np.full(_BONE_COUNT, np.nan), np.full((2, 6), np.nan))
    if not limit:
        return unknown
    limit_px = max(0.02 * float(np.median(limit)), 1.0)  # of the height
    x = triangulate_robust(rig, uv.reshape(-1, len(rig), 2), max_residual_px=limit_px)[0].reshape(len(frames), -1, 3)
    at = {joint: x[:, i] for i, joint in enumerate(joints)}
    unknown_point = np.full((len(frames), 3), np.nan)

    def joint(side: str, part: str) -> NDArray:
        return at.get((side, part), unknown_point)

    lengths_of = [np.concatenate([_length(joint(s, a), joint(s, b)) for s in "lr"]) for a, b in _LIMBS]
    middle = {part: 0.5 * (joint("l", part) + joint("r", part)) for part in ("shoulder", "hip")}
    lengths_of.append(_length(middle["shoulder"], middle["hip"]))
    lengths_of += [_length(joint("l", part), joint("r", part)) for part in ("shoulder", "hip")]
    rate = keypoints[0].rate
    errors = max((frames[-1] - frames[0]) / rate / _ERROR_TIME_S, 1.0)
    estimates = [_median_and_sigma(lengths, errors) for lengths in lengths_of]
    return Appearance(np.array([t[0] for t in estimates]), np.array([t[1] for t in estimates]), unknown.colours)


def _spread_frames(frames: Iterable[int], count: int) -> list[int]:
    """At most `count` of some frames, spread over them."""
    ordered = sorted(frames)
    return [ordered[i] for i in np.unique(np.linspace(0, len(ordered) - 1, count).astype(int))] if ordered else []


def _length(a: NDArray, b: NDArray) -> NDArray:
    with np.errstate(divide="ignore"):
        return np.log(np.linalg.norm(a - b, axis=-1))


def _median_and_sigma(values: NDArray, errors: float) -> tuple[float, float]:
    """Median of values and its standard deviation, given the number of independent errors; NaN with too few values."""
    values = values[np.isfinite(values)]
    if len(values) < _MIN_BONE_FRAMES:
        return np.nan, np.nan
    middle = float(np.median(values))
    spread = _SIGMA_PER_MAD * float(np.median(np.abs(values - middle)))
    return middle, 1.25 * spread / float(np.sqrt(min(errors, len(values))))


def clothes_colours(
    keypoints: Sequence[Keypoints], views: Mapping[int, Sequence[tuple[int, int]]], images: ImageSource
) -> NDArray:
    """(2, 6) colours of a person's trunk and upper legs, where no other person overlaps, see `Appearance`.

    Parameters
    ----------
    keypoints : records of one kind
    views : for each frame its (record, detection) pairs
    images : of the cameras
    """
    joints = joints_of(keypoints[0].names)
    frames = _spread_frames(views, _MAX_COLOUR_FRAMES)
    found: list[list[NDArray]] = [[], []]
    for f in frames:
        for q, p in views[f]:
            record = keypoints[q]
            parts_of = _body_polygons(record, f, p, joints)
            boxes = [_box(record, f, o) for o in range(record.points.shape[1]) if o != p]
            free = [(k, o) for k, part in enumerate(parts_of) for o in part if not any(_overlaps(o, b) for b in boxes)]
            shot = images(record.camera, f) if free else None
            if shot is None:
                continue
            image, frame = shot
            for k in (0, 1):
                parts = [frame.from_calibration(o) if frame else o for i, o in free if i == k]
                colours = _colours(image, parts)
                if colours is not None:
                    found[k].append(colours)
    unknown = np.full(6, np.nan)
    return np.stack([medians(np.array(each).T) if each else unknown for each in found])


def _body_polygons(
    record: Keypoints, frame: int, person: int, joints: Mapping[tuple[str, str], int]
) -> tuple[list[NDArray], list[NDArray]]:
    """Polygons (n, 2) [px] inside the trunk, and inside the upper legs."""
    visible = record.confidence[frame, person] > 0.3

    def at(side: str, part: str) -> NDArray:
        k = joints.get((side, part))
        return record.points[frame, person, k] if k is not None and visible[k] else np.full(2, np.nan)

    trunk = np.stack([at("l", "shoulder"), at("r", "shoulder"), at("r", "hip"), at("l", "hip")])
    trunk = trunk.mean(axis=0) + 0.65 * (trunk - trunk.mean(axis=0))
    legs = []
    for side in "lr":
        hip, knee = at(side, "hip"), at(side, "knee")
        along = knee - hip
        across = 0.08 * np.array([-along[1], along[0]])  # half the thickness of a thigh is a sixth of its length
        legs.append(np.stack([hip + 0.25 * along + s * across for s in (-1, 1)]
                             + [hip + 0.85 * along + s * across for s in (1, -1)]))  # fmt: skip
    return [trunk] if np.isfinite(trunk).all() else [], [leg for leg in legs if np.isfinite(leg).all()]


def _box(record: Keypoints, frame: int, person: int) -> NDArray:
    """(4,) [px] left, top, right and bottom of a detection's visible points; NaN without any."""
    visible = np.isfinite(record.points[frame, person]).all(axis=-1) & (record.confidence[frame, person] > 0.1)
    uv = record.points[frame, person][visible]
    return np.concatenate([uv.min(axis=0), uv.max(axis=0)]) if len(uv) else np.full(4, np.nan)


def _overlaps(polygon: NDArray, box: NDArray) -> bool:
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    return bool((low <= box[2:]).all() and (high >= box[:2]).all())


def _colours(image: NDArray, polygons: Iterable[NDArray]) -> NDArray | None:
    """(6,) colours inside polygons [px] of an image; None with too few pixels."""
    polygons = [np.round(o).astype(np.int32) for o in polygons]
    if not polygons:
        return None
    vertices = np.concatenate(polygons)
    low, high = np.maximum(vertices.min(axis=0), 0), np.minimum(vertices.max(axis=0) + 1, image.shape[1::-1])
    if not (low < high).all():
        return None
    crop = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    mask = np.zeros(crop.shape[:2], np.uint8)
    for polygon in polygons:
        cv2.fillPoly(mask, [polygon - low.astype(np.int32)], 1)
    if mask.sum() < _MIN_PIXELS:
        return None
    lab = cv2.cvtColor(crop, cv2.COLOR_RGB2LAB)[mask > 0] * [100.0 / 255.0, 1.0, 1.0]
    dark, middle, light = np.percentile(lab, _QUANTILES, axis=0)
    return np.concatenate([middle - [0.0, 128.0, 128.0], 0.5 * (light - dark)])
