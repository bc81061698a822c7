"""Regions of interest of the landmark network: rotated squares, what it sees in them, masks of people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from kinefit.images.detectors.layouts import BLAZEPOSE, SIZE, PointLayout

MASK = (1, SIZE, SIZE, 1)  # shape of the output that is the mask
_LANDMARK_COUNT = len(BLAZEPOSE.names)  # two more points give the region in the next image
_HEATMAP_PX = 64  # side
_WINDOW_PX = np.arange(-3, 4)  # of a heatmap around a landmark
_MIN_PEAK = 0.5  # probability in a heatmap that moves its landmark
_MAX_EXCHANGED = 0.5  # of the median distance of both answers, left where sides are exchanged: one of them is wrong

MIRROR = BLAZEPOSE.mirror
"""For each landmark of the built-in network the one on the other side."""


@dataclass(frozen=True, eq=False)
class PersonLandmarks:
    """Output of the landmark network for a crop.

    Parameters
    ----------
    points : (K, 2) [px of the crop]
    visibility, presence : (K,) 0..1
        Probability that a landmark is not occluded; that it lies in the crop.
    middle, rim : (2,) [px of the crop]
        Middle of the body and a point above it on the circle around the body: they give the next region.
    score : float, 0..1
        Probability of a person.
    mask : (256, 256) float32, probability that a pixel of the crop belongs to the person; None if not requested, or
        where the network gives none.
    lifted : (K, 3) [m]
        Landmarks in space, from the middle of the hips, along the crop's u and v and away from the camera. Their scale
        is the network's. None where the network gives none.
    """

    points: NDArray
    visibility: NDArray
    presence: NDArray
    middle: NDArray
    rim: NDArray
    score: float
    mask: NDArray[np.float32] | None
    lifted: NDArray | None


class PoseModel:
    """Detects a person's landmarks and mask in a crop.

    Parameters
    ----------
    interpreter
        Of `pose_landmark_full.tflite` or a network with the same inputs and outputs; the mask may be missing.

    Raises
    ------
    KeyError
        The network has no input or output of a required shape.
    """

    def __init__(self, interpreter: Any) -> None:
        self._interpreter = interpreter
        inputs = {tuple(int(n) for n in o["shape"]): o["index"] for o in interpreter.get_input_details()}
        self._input = inputs[1, SIZE, SIZE, 3]
        outputs = {tuple(int(n) for n in o["shape"]): o["index"] for o in interpreter.get_output_details()}
        self._landmarks, self._score = outputs[1, 195], outputs[1, 1]
        self._mask, self._heat = outputs.get(MASK), outputs[1, _HEATMAP_PX, _HEATMAP_PX, 39]
        self._lifted = outputs[1, 117]

    def __call__(self, crop: NDArray[np.uint8]) -> PersonLandmarks:
        """Landmarks of the person in an RGB crop (256, 256, 3)."""
        read = self._interpreter.get_tensor
        self._interpreter.set_tensor(self._input, (crop * np.float32(1 / 255))[None])
        self._interpreter.invoke()
        landmarks = read(self._landmarks).reshape(39, 5).astype(float)
        points = refine(landmarks[:, :2], read(self._heat)[0])
        visibility, presence = _sigmoid(landmarks[:_LANDMARK_COUNT, 3:].T)
        mask = None if self._mask is None else _sigmoid(read(self._mask)[0, :, :, 0])
        return PersonLandmarks(
            points[:_LANDMARK_COUNT], visibility, presence, points[_LANDMARK_COUNT], points[_LANDMARK_COUNT + 1],
            float(read(self._score).item()), mask,
            read(self._lifted).reshape(39, 3)[:_LANDMARK_COUNT].astype(float),
        )


def mean_with_mirrored(
    seen: PersonLandmarks, mirrored: PersonLandmarks, layout: PointLayout = BLAZEPOSE
) -> PersonLandmarks:
    """Average the landmarks of a crop and of its mirror image: errors to one side cancel.

    Those of the crop are returned if the mirror image shows no person, or if left and right are swapped in it.
    """

    def back(points: NDArray) -> NDArray:
        return np.column_stack([layout.size[0] - 1 - points[:, 0], points[:, 1]])

    order = layout.mirror
    points = back(mirrored.points)[order]
    apart, exchanged = (np.median(np.linalg.norm(seen.points - p, axis=1)) for p in (points, points[order]))
    if mirrored.score < layout.limits[0] or exchanged < _MAX_EXCHANGED * apart:
        return seen
    ends = (np.stack([seen.middle, seen.rim]) + back(np.stack([mirrored.middle, mirrored.rim]))) / 2
    mask, lifted = seen.mask, seen.lifted
    if lifted is not None and mirrored.lifted is not None:
        lifted = (lifted + mirrored.lifted[order] * [-1, 1, 1]) / 2
    if mask is not None and mirrored.mask is not None:
        mask = (mask + mirrored.mask[:, ::-1]) * np.float32(0.5)
    return replace(
        seen, points=(seen.points + points) / 2, middle=ends[0], rim=ends[1],
        visibility=(seen.visibility + mirrored.visibility[order]) / 2,
        presence=(seen.presence + mirrored.presence[order]) / 2, lifted=lifted, mask=mask,
    )  # fmt: skip


def refine(points: NDArray, heat: NDArray) -> NDArray:
    """Refine points (K, 2) [px of the crop] by the centre of mass of their heatmaps (64, 64, K) of logits nearby.

    A point stays where its heatmap is flat, or if it lies outside of it.
    """
    step = SIZE / _HEATMAP_PX
    cell = np.floor(points / step).astype(int)
    inside = ((cell >= 0) & (cell < _HEATMAP_PX)).all(axis=1)
    v, u = (cell[:, None, k] + _WINDOW_PX for k in (1, 0))
    in_map = ((v >= 0) & (v < _HEATMAP_PX))[:, :, None] & ((u >= 0) & (u < _HEATMAP_PX))[:, None, :]
    vc, uc = np.clip(v, 0, _HEATMAP_PX - 1), np.clip(u, 0, _HEATMAP_PX - 1)
    weight = _sigmoid(heat[vc[:, :, None], uc[:, None, :], np.arange(len(points))[:, None, None]]) * in_map
    total = weight.sum(axis=(1, 2))
    moved = inside & (weight.max(axis=(1, 2)) >= _MIN_PEAK) & (total > 0)
    total = np.where(moved, total, 1.0)
    mean = np.column_stack([(weight * u[:, None, :]).sum(axis=(1, 2)), (weight * v[:, :, None]).sum(axis=(1, 2))])
    return np.where(moved[:, None], mean / total[:, None] * step, points)


def _sigmoid(x: NDArray) -> NDArray:
    return 0.5 * (1 + np.tanh(0.5 * x))  # does not overflow


_ROI_SCALE = 1.25  # of the published method: the square's side to the diameter of the circle around the person
_MIN_CUTOFF_HZ = 0.01  # of the filter, at rest; all three as published with the network
_CUTOFF_SLOPE = 10.0  # [s] growth of the cutoff with speed
_SPEED_CUTOFF_HZ = 1.0  # of the filtered speed
_PERIOD = 1 / 30  # [s] that these constants are meant for


@dataclass(frozen=True, eq=False)
class Roi:
    """A square region of an image.

    Parameters
    ----------
    centre : (2,) [px]
    side : float [px]
    turn : float [rad]
        Rotation, clockwise in the image (u right, v down): 0 for an upright person, π/2 if the head is to the right.
    """

    centre: NDArray
    side: float
    turn: float

    @classmethod
    def around_person(cls, middle: ArrayLike, rim: ArrayLike) -> Roi:
        """Square around a person, from the middle (2,) [px] of the hips and a point (2,) [px] above it on the circle.

        Source: Bazarevsky et al., BlazePose: On-device real-time body pose tracking, 2020.
        """
        middle, rim = np.asarray(middle, float), np.asarray(rim, float)
        du, dv = rim - middle
        return cls(middle, 2 * _ROI_SCALE * float(np.hypot(du, dv)), float(np.arctan2(du, -dv)))

    @classmethod
    def around_points(cls, points: NDArray, up: NDArray, sides: float) -> Roi:
        """Square of `sides` times the extent of points (N, 2) [px] around them, turned upright along `up` (2,)."""
        turn = float(np.arctan2(up[0], -up[1]))
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        turned = points @ R
        low, high = turned.min(axis=0), turned.max(axis=0)
        return cls(R @ (low + high) / 2, sides * float((high - low).max()), turn)

    def A_image_crop(self, size: int | tuple[int, int]) -> NDArray:
        """Affine map (2, 3) from the pixels of a crop to those of the image.

        Parameters
        ----------
        size : side [px] of the crop, or its width and height: the region's side is then its height
        """
        width, height = (size, size) if isinstance(size, int) else size
        scale = self.side / height
        c, s = scale * np.cos(self.turn), scale * np.sin(self.turn)
        linear = np.array([[c, -s], [s, c]])
        return np.column_stack([linear, self.centre - linear @ [width / 2, height / 2]])

    def crop(
        self, image: NDArray[np.uint8], size: int | tuple[int, int], border: int = cv2.BORDER_REPLICATE
    ) -> NDArray[np.uint8]:
        """Crop the region from an image (H, W, 3): (height, width, 3) uint8 of `size`; see `A_image_crop`.

        Outside, the image's border is repeated, or what `border` of OpenCV says.
        """
        return cv2.warpAffine(
            image, self.A_image_crop(size), (size, size) if isinstance(size, int) else size,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=border,
        )

    def to_image(self, points_crop: NDArray, size: int | tuple[int, int]) -> NDArray:
        """Points (N, 2) [px] in the image, from points of the crop of `size` px; any leading axes."""
        A = self.A_image_crop(size)
        return points_crop @ A[:, :2].T + A[:, 2]

    def to_upright(self, points_crop: NDArray) -> NDArray:
        """Rotate points (N, 3) [m] from the crop's axes u, v and viewing direction to those of the image."""
        c, s = np.cos(self.turn), np.sin(self.turn)
        return points_crop @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T

    def corners(self) -> NDArray:
        """Corners (4, 2) [px] in the image."""
        return self.to_image(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]), 1)


def is_inside(points: NDArray, shape: Sequence[int]) -> NDArray:
    """(...) bool, which points (..., 2) [px] lie in an image of a shape (H, W, ...)."""
    return np.asarray(((points > -0.5) & (points < np.array(shape[1::-1]) - 0.5)).all(axis=-1))


@dataclass(frozen=True, eq=False)
class Steady:
    """The two points of a region, filtered over time: jitter of the region causes jitter of the landmarks in it.

    A low-pass filter whose cutoff rises with speed: no jitter at rest, no lag in motion.
    Source: Casiez et al., 1€ filter, CHI 2012, with the constants published with BlazePose.

    Parameters
    ----------
    value, raw : (2, 2) [px]
        Middle and point on the circle (see `Roi.around_person`), filtered, and as last given.
    speed : (2, 2) [1/s] in sides of the region
    """

    value: NDArray
    raw: NDArray
    speed: NDArray

    @classmethod
    def at(cls, points: NDArray) -> Steady:
        """Start the filter at points (2, 2) [px]."""
        return cls(points, points, np.zeros_like(points))

    def over(self, points: NDArray, frames: int) -> Steady:
        """Filter the points (2, 2) [px] of an image so many frames later, evenly on the way there in those between."""
        out = self
        for k in range(frames):
            out = out.follow(self.raw + (k + 1) / frames * (points - self.raw))
        return out

    def ahead(self, frames: int) -> Steady:
        """The filter so many frames later, as its points move on."""
        radius = float(np.linalg.norm(self.raw[1] - self.raw[0]))
        return self.over(self.raw + frames * 2 * radius * _PERIOD * self.speed, frames)

    def follow(self, points: NDArray) -> Steady:
        """Filter the points (2, 2) [px] of the next image."""
        radius = max(float(np.linalg.norm(points[1] - points[0])), 1e-6)
        speed = self.speed + _share(_SPEED_CUTOFF_HZ) * ((points - self.raw) / (2 * radius * _PERIOD) - self.speed)
        value = self.value + _share(_MIN_CUTOFF_HZ + _CUTOFF_SLOPE * np.abs(speed)) * (points - self.value)
        return Steady(value, points, speed)

    @property
    def roi(self) -> Roi:
        """Region [px] of the filtered points."""
        return Roi.around_person(*self.value)


def _share(cutoff: ArrayLike) -> NDArray:
    """Weight 0..1 of the new value in a first-order low-pass filter with a cutoff [Hz]."""
    turns = 2 * np.pi * _PERIOD * np.asarray(cutoff)
    return turns / (1 + turns)


MIN_MASK = 0.5
"""Probability of a pixel of the person."""

_MIN_COVERED_PROBABILITY = 0.3  # of a pixel that is painted over
_DILATION = np.ones((7, 7), np.uint8)  # [px of the crop] of masks that are painted over
_LIMB = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (15, 15))  # [px of the crop] of points on a body's outline
_PAINT_GREY = 128
_MIN_HIP_DISTANCE = 0.3  # [sides of the region] between two people; one person tracked twice has less


def extent_mask(points: NDArray, size: tuple[int, int]) -> NDArray[np.float32]:
    """Mask (256, 256) of a region around points (N, 2) [px of its crop of a size]: their hull, and a limb's width."""
    mask, (width, height) = np.zeros((SIZE, SIZE), np.float32), size
    square = (points - [width / 2, height / 2]) * (SIZE / height) + SIZE / 2
    if len(points):
        cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(square).astype(np.int32)), 1.0)
    return np.asarray(cv2.dilate(mask, _LIMB), np.float32)


def without_others(
    crop: NDArray[np.uint8], roi: Roi, own: tuple[Roi, NDArray] | None, others: Sequence[tuple[Roi, NDArray]]
) -> NDArray[np.uint8]:
    """Paint over other people in a crop, except for pixels of the person's own last mask.

    People at the same position are not painted over: they may be duplicates of this person.
    """
    other_people = [
        shape for shape in others
        if np.linalg.norm(shape[0].centre - roi.centre) > _MIN_HIP_DISTANCE * min(shape[0].side, roi.side)
    ]  # fmt: skip
    masks = [cv2.dilate(moved_mask(shape, roi), _DILATION) for shape in other_people]
    masks = [mask for mask in masks if mask.any()]
    if masks:
        own_mask = moved_mask(own, roi) if own else np.zeros(crop.shape[:2], np.uint8)
        crop[(np.maximum.reduce(masks) > 0) & (own_mask == 0)] = _PAINT_GREY
    return crop


def moved_mask(shape: tuple[Roi, NDArray], roi: Roi) -> NDArray[np.uint8]:
    """Resample the mask of one region to another: (SIZE, SIZE), 1 where its probability exceeds `MIN_MASK`."""
    A_roi_image = cv2.invertAffineTransform(roi.A_image_crop(SIZE))
    A = A_roi_image @ np.vstack([shape[0].A_image_crop(SIZE), [0, 0, 1]])
    return (cv2.warpAffine(shape[1], A, (SIZE, SIZE)) > MIN_MASK).astype(np.uint8)


def mask_runs(mask: NDArray[np.float32], roi: Roi, shape: tuple[int, int]) -> NDArray[np.uint32]:
    """Encode a mask (256, 256) of a region as run lengths, down the columns of an image (height, width) [px]."""
    height, width = shape
    nothing = np.array([width * height], np.uint32)
    rows, columns = (np.flatnonzero((mask > MIN_MASK).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return nothing
    box = np.array([[u, v] for u in (columns[0] - 1, columns[-1] + 1) for v in (rows[0] - 1, rows[-1] + 1)])
    corners = roi.to_image(box, SIZE)
    u0, v0 = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, [width, height])
    u1, v1 = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 1, 0, [width, height])
    if u0 >= u1 or v0 >= v1:
        return nothing
    A = roi.A_image_crop(SIZE)[::-1]  # each row of `soft` is a column of the image, between two empty pixels
    A[:, 2] -= v0 - 1, u0
    soft = cv2.warpAffine(mask, A, (int(v1 - v0) + 2, int(u1 - u0)), flags=cv2.INTER_LINEAR)
    inside = soft > MIN_MASK
    inside[:, [0, -1]] = False
    u, v = np.divmod(np.flatnonzero(inside[:, 1:] != inside[:, :-1]), v1 - v0 + 1)
    changes = (u + u0) * height + v + v0
    return np.diff(np.concatenate([[0], changes, [width * height]])).astype(np.uint32)


def cover(image: NDArray[np.uint8], shapes: Iterable[tuple[Roi, NDArray]]) -> NDArray[np.uint8]:
    """Paint over the tracked people in an image (H, W, 3), so that the detector finds other people.

    The detector was made for images of one person and misses a second one close by.
    """
    covered = image.copy()
    for roi, mask in shapes:
        wide = cv2.dilate((mask > _MIN_COVERED_PROBABILITY).astype(np.uint8), _DILATION)
        size = (image.shape[1], image.shape[0])
        covered[cv2.warpAffine(wide, roi.A_image_crop(SIZE), size, flags=cv2.INTER_NEAREST) > 0] = _PAINT_GREY
    return covered
