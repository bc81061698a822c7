"""Keypoints of one person in all cameras, with left and right corrected: the input of the calibration checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Rig
from kinefit.geometry.triangulation import triangulate_robust
from kinefit.multiview.association import choose_people
from kinefit.observations import Keypoints
from kinefit.observations.recordings import mirror_name

MAX_ERROR_SHARE = 0.03  # of the image's diagonal: cameras that differ by more did not detect the same point
MIN_CONFIDENCE = 0.3  # of a point; detectors give occluded points less
_MIN_PAIRS = 3  # left-right pairs needed to decide the sides
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
        return self.at(np.unique(np.linspace(0, len(self) - 1, min(count, len(self))).astype(int)))

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
