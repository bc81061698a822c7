"""Detections of `kinefit detect` in one video: landmarks, masks and hands of people."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._image_headers import MAX_IMAGE_PIXELS
from kinefit.errors import ObservationError
from kinefit.geometry.camera import ImageFrame
from kinefit.observations.arrays import freeze, frozen
from kinefit.observations.recordings import Keypoints
from kinefit.observations.videos import checked_times

_FACE = "nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer left_ear right_ear"
_PAIRS = "shoulder elbow wrist pinky index thumb hip knee ankle heel foot_index"
MEDIAPIPE_33 = (
    *_FACE.split(), "mouth_left", "mouth_right",
    *(f"{side}_{part}" for part in _PAIRS.split() for side in ("left", "right")),
)  # fmt: skip
"""Names of the landmarks of MediaPipe's pose network, in its order; kinefit's own detector has the same."""

_FINGERS = ("index", "middle", "ring", "pinky")
MEDIAPIPE_HAND_21 = (
    "hand_wrist", "thumb_cmc", "thumb_mcp", "thumb_ip", "thumb_tip",
    *(f"{finger}_{joint}" for finger in _FINGERS for joint in ("mcp", "pip", "dip", "tip")),
)  # fmt: skip
"""Names of the landmarks of MediaPipe's hand network, in its order, without the side (`left_`, `right_`)."""

MEDIAPIPE_75 = (*MEDIAPIPE_33, *(f"{side}_{name}" for side in ("left", "right") for name in MEDIAPIPE_HAND_21))
"""Names of the landmarks of a person with both hands: of the pose network, then of the left and the right hand."""

_MESH = {  # points that are landmarks of bodies
    10: "forehead_top", 151: "forehead", 9: "glabella", 168: "nose_bridge", 6: "nose_bone", 195: "nose_ridge",
    4: "nose_point", 2: "nose_base", 17: "lower_lip", 18: "chin_groove", 200: "chin_upper", 199: "chin_front",
    152: "chin",
}  # fmt: skip
_MESH_SIDES = {  # right and left
    "eye_outer": (33, 263), "eye_inner": (133, 362), "forehead_side": (103, 332), "cheekbone": (116, 345),
    "temple": (127, 356), "chin_side": (32, 262), "chin_below": (176, 400), "iris": (468, 473),
    "iris_top": (470, 475), "iris_bottom": (472, 477), "iris_inner": (469, 476), "iris_outer": (471, 474),
}  # fmt: skip
_MESH_NAMES = {k: f"face_{name}" for k, name in _MESH.items()} | {
    k: f"{side}_face_{name}" for name, pair in _MESH_SIDES.items() for side, k in zip(("right", "left"), pair)
}
MEDIAPIPE_478 = tuple(_MESH_NAMES.get(k, f"face_{k}") for k in range(478))
"""Names of the points of MediaPipe's face mesh, in its order; the last ten are the irises'."""

_OPENPOSE_FINGERS = "Thumb Index Middle Ring Little"
OPENPOSE_HAND_42 = tuple(
    f"{side}Hand{point}" for side in "LR"
    for point in ("Wrist", *(f"{finger}{k}" for finger in _OPENPOSE_FINGERS.split() for k in range(1, 5)))
)  # fmt: skip
"""Names of the points of both hands of OpenPose and COCO-WholeBody, which are in MediaPipe's order."""

WITH_HANDS = {
    "MEDIAPIPE_33": ("MEDIAPIPE_75", MEDIAPIPE_75[33:]), "COCO_17": ("COCO_WHOLEBODY_133", OPENPOSE_HAND_42),
    "HALPE_26": ("COCO_WHOLEBODY_133", OPENPOSE_HAND_42), "BODY_25": ("BODY_25_HANDS", OPENPOSE_HAND_42),
}  # fmt: skip
"""{keypoint set: set that has hands, too, and the names of both hands in it}"""


@dataclass(frozen=True, eq=False)
class Detections:
    """Detections of `kinefit detect` in one video: people, each in one column, with their masks.

    Parameters
    ----------
    camera : str
    rate : float [Hz]
    size : (width, height) [px] of the video's image
    points : (F, P, K, 2) [px]
        Landmarks in the video's image, of MEDIAPIPE_33 or of `names`; NaN in frames without the person. P may be 0.
    confidence : (F, P, K)
        Probability that a landmark is in the image and not occluded; 0 in frames without the person.
    mask_runs : (N,)
        Run lengths of all masks, ordered by frame, then person: down the columns of the image, starting with pixels
        outside the mask (COCO's uncompressed run-length encoding).
    mask_starts : (F * P + 1,)
        Start of each mask in `mask_runs`; a cell without runs has no mask.
    source : str
    lifted : (F, P, K, 3) [m], optional
        3D landmarks relative to the middle of the hips, along the image's u and v and away from the camera, at the
        network's own scale; NaN in frames without the person. None from networks that give none.
    hands : (F, P, 2, 21, 2) [px], optional
        Landmarks of MEDIAPIPE_HAND_21 of the left and the right hand; NaN for undetected hands. Hands may be detected
        without the person's body.
    hand_confidence : (F, P, 2, 21), with `hands`
        Probability that a landmark is of this hand and in the image; 0 for undetected hands.
    face : (F, P, 478, 2) [px], optional
        Points of MEDIAPIPE_478; NaN for undetected faces.
    face_confidence : (F, P, 478), with `face`
        Probability that there is a face, 0 for points outside of the image and where no face is seen.
    times : (F,) [s], optional
        Time of each frame from the first, increasing; None: at the rate.
    keypoint_set : str
        Set that the names are of; "" for landmarks of the body.
    names : (K,) str
        Of the points.
    network : str
        File of a network of one's own; "" for the built-in one.
    looked : (F,) bool, optional
        Frames whose image was looked at; None: all.

    Raises
    ------
    ObservationError
        Arrays of other shapes; masks of another size than the image; times that do not increase.
    """

    camera: str
    rate: float
    size: tuple[int, int]
    points: NDArray
    confidence: NDArray
    mask_runs: NDArray
    mask_starts: NDArray
    source: str = ""
    lifted: NDArray | None = None
    hands: NDArray | None = None
    hand_confidence: NDArray | None = None
    times: NDArray | None = None
    face: NDArray | None = None
    face_confidence: NDArray | None = None
    keypoint_set: str = "MEDIAPIPE_33"
    names: tuple[str, ...] = MEDIAPIPE_33
    network: str = ""
    looked: NDArray | None = None

    def __post_init__(self) -> None:
        points, confidence = frozen(self.points), frozen(self.confidence)
        starts, runs = frozen(self.mask_starts, int), frozen(self.mask_runs, np.uint32)
        cells = points.shape[0] * points.shape[1] if points.ndim == 4 else -1
        count = len(self.names)
        fits = points.shape[2:] == (count, 2) and confidence.shape == points.shape[:3]
        fits = fits and starts.shape == (cells + 1,) and runs.ndim == 1
        if not fits or starts[0] != 0 or starts[-1] != len(runs) or np.any(np.diff(starts) < 0):
            raise ObservationError(
                f"detections of camera {self.camera} have shape {points.shape} with confidence {confidence.shape}, "
                f"starts of masks {starts.shape} and runs {runs.shape}", file=self.source or None,
                remedy=f"Give (frames, people, {count}, 2), (frames, people, {count}), (frames * people + 1,) starts, "
                "(N,) runs.",
            )
        lifted = self.lifted
        if lifted is not None:
            what = f"lifted landmarks of camera {self.camera}"
            lifted = frozen(lifted, float, what, (*points.shape[:3], 3), self.source)
        shapes: dict[str, tuple[int, ...]] = {"hand": (2, 21), "face": (478,)}
        for part, confidence_of in (("hands", "hand_confidence"), ("face", "face_confidence")):
            shape_of = shapes[part[:4]]
            values, confidences = getattr(self, part), getattr(self, confidence_of)
            if values is not None or confidences is not None:
                what, shape = f"{part} of camera {self.camera}", (*points.shape[:2], *shape_of)
                values = frozen(values, float, what, (*shape, 2), self.source)
                confidences = frozen(confidences, float, f"the confidence of {what}", shape, self.source)
            freeze(self, **{part: values, confidence_of: confidences})
        ends = np.concatenate([[0], np.cumsum(runs, dtype=np.int64)])[starts]
        sizes, pixels = np.diff(ends)[np.diff(starts) > 0], math.prod(self.size)
        if min(self.size) < 1 or pixels > MAX_IMAGE_PIXELS or np.any(sizes != pixels):
            raise ObservationError(
                f"masks of {', '.join(map(str, np.unique(sizes)[:3])) or 'no'} pixels in images of {self.size}",
                file=self.source or None, remedy="Give runs that sum up to the image's pixels.",
            )  # fmt: skip
        freeze(self, points=points, confidence=confidence, mask_runs=runs, mask_starts=starts, lifted=lifted)
        times = self.times
        if times is not None:
            times = checked_times(times, f"camera {self.camera}", self.source)
            times = frozen(times, float, f"times of camera {self.camera}", points.shape[:1], self.source)
        looked = self.looked
        if looked is not None:
            looked = frozen(looked, bool, f"looks of camera {self.camera}", points.shape[:1], self.source)
        freeze(self, times=times, looked=looked)

    def within(self, first: int, frames: int) -> Detections:
        """The detections padded to a longer video, as its frames from `first` on, without times; no one in the others.

        Parameters
        ----------
        first, frames : number of the first frame in that video, and its number of frames
        """
        after, people = frames - first - len(self), self.points.shape[1]

        def padded(array: NDArray, value: float) -> NDArray:
            return np.pad(array, ((first, after), *[(0, 0)] * (array.ndim - 1)), constant_values=value)

        values: dict[str, float] = dict.fromkeys(("points", "lifted", "hands", "face"), np.nan)
        values |= dict.fromkeys(("confidence", "hand_confidence", "face_confidence"), 0.0) | {"looked": True}
        arrays = {name: getattr(self, name) for name in values}
        given: dict[str, Any] = {n: padded(array, values[n]) for n, array in arrays.items() if array is not None}
        starts = np.pad(self.mask_starts, (first * people, after * people), mode="edge")
        return replace(self, **given, times=None, mask_starts=starts)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def seen(self) -> NDArray:
        """(F, P) bool: whether a person, or a hand alone, is detected in a frame."""
        detected = np.isfinite(self.points).all(axis=(2, 3))
        return detected if self.hands is None else detected | np.isfinite(self.hands).all(axis=(3, 4)).any(axis=2)

    @property
    def has_faces(self) -> bool:
        """Whether a frame shows a face."""
        return self.face_confidence is not None and bool(self.face_confidence.any())

    def mask(self, frame: int, person: int) -> NDArray | None:
        """Mask (H, W) bool of a person in a frame; None if there is none."""
        cell = range(len(self))[frame] * self.points.shape[1] + range(self.points.shape[1])[person]
        runs = self.mask_runs[self.mask_starts[cell] : self.mask_starts[cell + 1]]
        if not len(runs):
            return None
        width, height = self.size
        return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T

    def keypoints(
        self, camera: str | None = None, *, image_frame: ImageFrame | None = None, time_offset: float = 0.0,
        face: bool = False,
    ) -> Keypoints:  # fmt: skip
        """The landmarks of all people as a detector's keypoints: of their own set, with hands of the set that has them.

        Parameters
        ----------
        camera : str, optional
            Name of the camera in the rig; default: the video's.
        image_frame : ImageFrame, optional
            The video's image frame, if it is not the calibration's.
        time_offset : float [s]
        face : bool
            The faces alone, MEDIAPIPE_478, in place of these.

        Raises
        ------
        ObservationError
            No person, or no face, is detected in any frame; faces were not looked for.
        """
        if not self.seen.any():
            raise ObservationError(
                f"no person is detected in any of the {len(self)} frames of camera {camera or self.camera}",
                file=self.source or None,
                remedy="The detector needs a person of a tenth of the image's height or more; or remove this camera.",
            )
        points, confidence, lifted, names = self.points, self.confidence, self.lifted, self.names
        keypoint_set = self.keypoint_set
        if face:
            points, confidence, lifted, names = *self._faces(camera), None, MEDIAPIPE_478
            keypoint_set = "MEDIAPIPE_478"
        elif self.hands is not None and self.hand_confidence is not None and keypoint_set in WITH_HANDS:
            people, (keypoint_set, hands) = self.seen.shape, WITH_HANDS[keypoint_set]
            names = (*names, *hands)
            points = np.concatenate([points, self.hands.reshape(*people, 42, 2)], axis=2)
            confidence = np.concatenate([confidence, self.hand_confidence.reshape(*people, 42)], axis=2)
            if lifted is not None:  # hands are not lifted
                lifted = np.concatenate([lifted, np.full((*people, 42, 3), np.nan)], axis=2)
        if image_frame is not None:
            points, lifted = in_calibration(points, lifted, image_frame)
        return Keypoints(
            camera or self.camera, keypoint_set, names, self.rate, points, confidence,
            time_offset=time_offset, source=self.source, lifted=lifted, looked=self.looked,
        )

    def _faces(self, camera: str | None) -> tuple[NDArray, NDArray]:
        """Points and confidence of the faces; ObservationError where there are none."""
        if self.has_faces and self.face is not None and self.face_confidence is not None:
            return self.face, self.face_confidence
        problem = "faces were not detected" if self.face is None else f"no face is found in any of {len(self)} frames"
        remedy = "Run kinefit detect --face." if self.face is None else "Remove the camera's face."
        raise ObservationError(
            f"{problem} of camera {camera or self.camera}", file=self.source or None, remedy=remedy,
        )  # fmt: skip


def in_calibration(
    points: NDArray, lifted: NDArray | None, image_frame: ImageFrame
) -> tuple[NDArray, NDArray | None]:
    """Convert landmarks (..., 2) [px] and 3D landmarks (..., 3) [m] to the calibration's image frame."""
    if lifted is not None:
        axes = image_frame.to_calibration(np.eye(2)) - image_frame.to_calibration(np.zeros((1, 2)))
        axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        lifted = np.concatenate([lifted[..., :2] @ axes, lifted[..., 2:]], axis=-1)
    return image_frame.to_calibration(points), lifted
