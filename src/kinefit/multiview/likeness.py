"""How like two people are: by the lengths of their bones, and by the colours of what they wear.

Both are vectors that differ less between two spans of one person than between people. The likelihood ratio of one
person against two needs their difference alone (Gaussian within and between; the mean of all people cancels out).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.geometry.triangulation import triangulate_robust
from kinefit.multiview.medians import medians
from kinefit.observations import Keypoints

Pictures = Callable[[str, int], tuple[NDArray, ImageFrame | None] | None]
"""Camera, frame -> image (H, W, 3) uint8 RGB and its image frame, None for the calibration's; None for no image."""

_PARTS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
_LIMBS = (("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"))
_BONES = 7  # these four, left and right together; the trunk; breadth of shoulders and hips
_FRAMES = 60  # of a span, from which lengths are taken
_APART = 0.3  # [s] after which a detector errs anew
_SPREAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_FEWEST = 5  # frames in which a bone must be seen

# Of a bone's length, as a share, what a detector makes of one person in another pose and place: bones of limbs, trunk,
# breadths. As the built-in detector has them of a real man and woman in four cameras, between spans of half a second.
_WITHIN = np.array([0.02, 0.025, 0.02, 0.02, 0.02, 0.04, 0.05])
# Adults of both sexes: stature differs by 5 % (standard deviation), a bone by 3.5 % more from what goes with stature.
_STATURE, _PROPORTION = 0.05, 0.035
_WRONG_SIZE = 0.02  # odds that lengths of a person are wrong as a whole: detections of somebody else among them

_VIEWS = 12  # frames of a span whose pictures are looked at, in every camera
_PIXELS = 60  # of a part, below which its colours say nothing
_QUANTILES = (10, 50, 90)
# Of lightness, green-red and blue-yellow (CIELAB), median and spread: of one person by another light and camera, or
# turned; and of clothes of different people.
_SHADE = np.array([7.0, 3.0, 3.5, 5.0, 1.5, 2.0])
_CLOTHES = np.array([20.0, 10.0, 12.0, 10.0, 6.0, 6.0])
_CHANGED, _ALIKE = 0.05, 0.1  # share of people who look another when they come back, and of pairs who wear the same


@dataclass(frozen=True, eq=False)
class Looks:
    """What there is to know somebody again by.

    Parameters
    ----------
    bones : (7,) logarithms of lengths; NaN of what was not seen
    bones_std : (7,) their standard deviations in this span
    colours : (2, 6) of trunk and upper legs: median and half the spread of lightness, green-red and blue-yellow
        (CIELAB, 0 to 100); NaN of what was not seen
    """

    bones: NDArray
    bones_std: NDArray
    colours: NDArray

    @property
    def is_known(self) -> bool:
        """Whether anything is."""
        return bool(np.isfinite(self.bones).any() or np.isfinite(self.colours).any())


def likeness(a: Looks, b: Looks, *, wrong_size: float = _WRONG_SIZE) -> float:
    """Logarithm of the likelihood that two are one person, over that of two people; 0 where nothing is known.

    wrong_size : share of spans whose lengths are wrong as a whole, as detections of somebody else are among them
    """
    return size_likeness(a, b, wrong_size=wrong_size) + colour_likeness(a, b)


def both_know(a: Looks, b: Looks) -> tuple[str, ...]:
    """By what two can be compared: "size", "clothes"."""
    size, clothes = (bool(np.isfinite(d).any()) for d in (a.bones - b.bones, a.colours - b.colours))
    return ("size",) * size + ("clothes",) * clothes


def size_likeness(a: Looks, b: Looks, *, wrong_size: float = _WRONG_SIZE) -> float:
    """Of `likeness` what the lengths of bones say."""
    d = a.bones - b.bones
    known = np.isfinite(d)
    if not known.any():
        return 0.0
    noise = np.diag((a.bones_std**2 + b.bones_std**2 + 2.0 * _WITHIN**2)[known])
    people = _STATURE**2 + _PROPORTION**2 * np.eye(int(known.sum()))
    one, two = _log_normal(d[known], noise), _log_normal(d[known], noise + 2.0 * people)
    wrong = np.log(wrong_size) if wrong_size > 0.0 else -np.inf
    return float(np.logaddexp(np.log1p(-wrong_size) + one - two, wrong))


def colour_likeness(a: Looks, b: Looks) -> float:
    """Of `likeness` what the colours of clothes say."""
    d = (a.colours - b.colours).ravel()
    known = np.isfinite(d)
    if not known.any():
        return 0.0
    shade, clothes = (np.diag(np.tile(v**2, 2)[known]) for v in (_SHADE, _CLOTHES))
    same, other = _log_normal(d[known], 2.0 * shade), _log_normal(d[known], 2.0 * (shade + clothes))
    one = np.logaddexp(np.log1p(-_CHANGED) + same, np.log(_CHANGED) + other)
    two = np.logaddexp(np.log1p(-_ALIKE) + other, np.log(_ALIKE) + same)
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


def bones_of(rig: Rig, keypoints: Sequence[Keypoints], views: Mapping[int, Sequence[tuple[int, int]]]) -> Looks:
    """Lengths of somebody's bones in a span.

    Parameters
    ----------
    rig : Rig
    keypoints : records of one kind
    views : {frame: (record, person in it)}, of two cameras and more
    """
    joints = joints_of(keypoints[0].names)
    frames = _spread(views, _FRAMES)
    columns = list(joints.values())
    uv = np.full((len(frames), len(columns), len(rig), 2), np.nan)
    limit = []
    for i, f in enumerate(frames):
        for q, p in views[f]:
            record = keypoints[q]
            sure = record.confidence[f, p, columns] > 0.1
            c = rig.index(record.camera)
            uv[i, sure, c] = record.points[f, p, columns][sure]
            if np.isfinite(uv[i, :, c]).any():
                limit.append(np.nanmax(uv[i, :, c, 1]) - np.nanmin(uv[i, :, c, 1]))
    unknown = Looks(np.full(_BONES, np.nan), np.full(_BONES, np.nan), np.full((2, 6), np.nan))
    if not limit:
        return unknown
    most = max(0.02 * float(np.median(limit)), 1.0)  # of the height: views of a joint that differ by less are of it
    x = triangulate_robust(rig, uv.reshape(-1, len(rig), 2), max_residual_px=most)[0].reshape(len(frames), -1, 3)
    at = {joint: x[:, i] for i, joint in enumerate(joints)}
    nowhere = np.full((len(frames), 3), np.nan)

    def joint(side: str, part: str) -> NDArray:
        return at.get((side, part), nowhere)

    each = [np.concatenate([_length(joint(s, a), joint(s, b)) for s in "lr"]) for a, b in _LIMBS]
    middle = {part: 0.5 * (joint("l", part) + joint("r", part)) for part in ("shoulder", "hip")}
    each.append(_length(middle["shoulder"], middle["hip"]))
    each += [_length(joint("l", part), joint("r", part)) for part in ("shoulder", "hip")]
    rate = keypoints[0].rate
    told = [_told(lengths, max((frames[-1] - frames[0]) / rate / _APART, 1.0)) for lengths in each]
    return Looks(np.array([t[0] for t in told]), np.array([t[1] for t in told]), unknown.colours)


def _spread(frames: Iterable[int], count: int) -> list[int]:
    """At most so many of some frames, spread over them."""
    every = sorted(frames)
    return [every[i] for i in np.unique(np.linspace(0, len(every) - 1, count).astype(int))] if every else []


def _length(a: NDArray, b: NDArray) -> NDArray:
    with np.errstate(divide="ignore"):
        return np.log(np.linalg.norm(a - b, axis=-1))


def _told(values: NDArray, errors: float) -> tuple[float, float]:
    """Median and its standard deviation, of values that have so many errors of their own; NaN where too few are."""
    values = values[np.isfinite(values)]
    if len(values) < _FEWEST:
        return np.nan, np.nan
    middle = float(np.median(values))
    spread = _SPREAD * float(np.median(np.abs(values - middle)))
    return middle, 1.25 * spread / float(np.sqrt(min(errors, len(values))))


def colours_of(
    keypoints: Sequence[Keypoints], views: Mapping[int, Sequence[tuple[int, int]]], pictures: Pictures
) -> NDArray:
    """(2, 6) colours of somebody's trunk and upper legs, see `Looks`, where nobody else is in the way.

    Parameters
    ----------
    keypoints : records of one kind
    views : {frame: (record, person in it)}
    pictures : Pictures
    """
    joints = joints_of(keypoints[0].names)
    frames = _spread(views, _VIEWS)
    found: list[list[NDArray]] = [[], []]
    for f in frames:
        for q, p in views[f]:
            record = keypoints[q]
            outlines = _outlines(record, f, p, joints)
            others = [_box(record, f, o) for o in range(record.points.shape[1]) if o != p]
            free = [(k, o) for k, part in enumerate(outlines) for o in part if not any(_meet(o, b) for b in others)]
            seen = pictures(record.camera, f) if free else None
            if seen is None:
                continue
            image, frame = seen
            for k in (0, 1):
                parts = [frame.from_calibration(o) if frame else o for i, o in free if i == k]
                told = _colours(image, parts)
                if told is not None:
                    found[k].append(told)
    nothing = np.full(6, np.nan)
    return np.stack([medians(np.array(each).T) if each else nothing for each in found])


def _outlines(
    record: Keypoints, frame: int, person: int, joints: Mapping[tuple[str, str], int]
) -> tuple[list[NDArray], list[NDArray]]:
    """Polygons (n, 2) [px] well inside the trunk, and the upper legs."""
    sure = record.confidence[frame, person] > 0.3

    def at(side: str, part: str) -> NDArray:
        k = joints.get((side, part))
        return record.points[frame, person, k] if k is not None and sure[k] else np.full(2, np.nan)

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
    """(4,) [px] left, top, right and bottom of what is seen of a detection; NaN for nobody."""
    seen = np.isfinite(record.points[frame, person]).all(axis=-1) & (record.confidence[frame, person] > 0.1)
    uv = record.points[frame, person][seen]
    return np.concatenate([uv.min(axis=0), uv.max(axis=0)]) if len(uv) else np.full(4, np.nan)


def _meet(outline: NDArray, box: NDArray) -> bool:
    low, high = outline.min(axis=0), outline.max(axis=0)
    return bool((low <= box[2:]).all() and (high >= box[:2]).all())


def _colours(image: NDArray, outlines: Iterable[NDArray]) -> NDArray | None:
    """(6,) colours within polygons [px] of an image."""
    outlines = [np.round(o).astype(np.int32) for o in outlines]
    if not outlines:
        return None
    both = np.concatenate(outlines)
    low, high = np.maximum(both.min(axis=0), 0), np.minimum(both.max(axis=0) + 1, image.shape[1::-1])
    if not (low < high).all():
        return None
    cut = np.ascontiguousarray(image[low[1] : high[1], low[0] : high[0]])
    mask = np.zeros(cut.shape[:2], np.uint8)
    for outline in outlines:
        cv2.fillPoly(mask, [outline - low.astype(np.int32)], 1)
    if mask.sum() < _PIXELS:
        return None
    lab = cv2.cvtColor(cut, cv2.COLOR_RGB2LAB)[mask > 0] * [100.0 / 255.0, 1.0, 1.0]
    dark, middle, light = np.percentile(lab, _QUANTILES, axis=0)
    return np.concatenate([middle - [0.0, 128.0, 128.0], 0.5 * (light - dark)])
