"""Landmarks and mask of one person in a region of an image: the landmark network of BlazePose.

Source: Bazarevsky et al., BlazePose, 2020; the refinement by heatmaps is that of its published pipeline.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit.observations import MEDIAPIPE_33

SIZE = 256  # [px] side of the network's image
MASK = (1, SIZE, SIZE, 1)  # shape of the output that is the mask
_LANDMARK_COUNT = 33  # of MEDIAPIPE_33; two more points give the region in the next image
_HEATMAP_PX = 64  # side
_WINDOW_PX = np.arange(-3, 4)  # of a heatmap around a landmark
_MIN_PEAK = 0.5  # probability in a heatmap that moves its landmark
_MIN_SCORE = 0.5  # of somebody in the mirror image
_MAX_EXCHANGED = 0.5  # of the median distance of both answers, left where sides are exchanged: one of them is wrong

MIRROR = [
    MEDIAPIPE_33.index(n.replace("left", "?").replace("right", "left").replace("?", "right")) for n in MEDIAPIPE_33
]
"""For each landmark the one on the other side."""


@dataclass(frozen=True, eq=False)
class PersonLandmarks:
    """Output of the landmark network for a crop.

    Parameters
    ----------
    points : (33, 2) [px of the crop]
    visibility, presence : (33,) 0..1
        Probability that a landmark is not occluded; that it lies in the crop.
    middle, rim : (2,) [px of the crop]
        Middle of the hips and a point above it on the circle around the body: they give the next region.
    score : float, 0..1
        Probability of a person.
    mask : (256, 256) float32, probability that a pixel of the crop belongs to the person; None if not requested.
    lifted : (33, 3) [m]
        Landmarks in space, from the middle of the hips, along the crop's u and v and away from the camera. Their scale
        is the network's.
    """

    points: NDArray
    visibility: NDArray
    presence: NDArray
    middle: NDArray
    rim: NDArray
    score: float
    mask: NDArray[np.float32] | None
    lifted: NDArray


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


def mean_with_mirrored(seen: PersonLandmarks, mirrored: PersonLandmarks) -> PersonLandmarks:
    """Average the landmarks of a crop and of its mirror image: errors to one side cancel.

    Those of the crop are returned if the mirror image shows no person, or if left and right are swapped in it.
    """

    def back(points: NDArray) -> NDArray:
        return np.column_stack([SIZE - 1 - points[:, 0], points[:, 1]])

    points = back(mirrored.points)[MIRROR]
    apart, exchanged = (np.median(np.linalg.norm(seen.points - p, axis=1)) for p in (points, points[MIRROR]))
    if mirrored.score < _MIN_SCORE or exchanged < _MAX_EXCHANGED * apart:
        return seen
    ends = (np.stack([seen.middle, seen.rim]) + back(np.stack([mirrored.middle, mirrored.rim]))) / 2
    mask = seen.mask
    if mask is not None and mirrored.mask is not None:
        mask = (mask + mirrored.mask[:, ::-1]) * np.float32(0.5)
    return replace(
        seen, points=(seen.points + points) / 2, middle=ends[0], rim=ends[1],
        visibility=(seen.visibility + mirrored.visibility[MIRROR]) / 2,
        presence=(seen.presence + mirrored.presence[MIRROR]) / 2,
        lifted=(seen.lifted + mirrored.lifted[MIRROR] * [-1, 1, 1]) / 2,
        mask=mask,
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
