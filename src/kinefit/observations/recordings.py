"""Whole recordings of one sensor: frozen records, in metres, radians, seconds and pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import ImageFrame
from kinefit.observations.arrays import check_seen, frozen

_MOST_PIXELS = 200_000_000  # of an image; beyond, a size is damaged
_FACE = "nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer left_ear right_ear"
_PAIRS = "shoulder elbow wrist pinky index thumb hip knee ankle heel foot_index"
MEDIAPIPE_33 = (
    *_FACE.split(), "mouth_left", "mouth_right",
    *(f"{side}_{part}" for part in _PAIRS.split() for side in ("left", "right")),
)  # fmt: skip
"""Names of the landmarks of MediaPipe's pose network, in its order; kinefit's own detector gives the same."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """2D keypoints of all people that a detector saw in one camera.

    Parameters
    ----------
    camera : str
        Name of the camera in the rig.
    keypoint_set : str
        Name of the set ("BODY_25B", "COCO_17", "HALPE_26", "MEDIAPIPE_33"); says which names the columns have.
    names : (K,) names of the keypoints.
    rate : float [Hz]
    points : (F, P, K, 2) [px]
        In the image frame of the camera's calibration (not of a scaled or letterboxed video). NaN where unseen.
        P is the largest number of people in any frame; their order means nothing.
    confidence : (F, P, K)
        The detector's own confidence in 0..1; 0 where unseen.
    time_offset : float [s]
        Added to frame / rate to get the time of the take.
    source : str
        File or folder it came from, for messages.
    """

    camera: str
    keypoint_set: str
    names: tuple[str, ...]
    rate: float
    points: NDArray
    confidence: NDArray
    time_offset: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        check_seen(self.camera, self.rate, self.names)
        points, confidence = frozen(self.points), frozen(self.confidence)
        if points.ndim != 4 or points.shape[2:] != (len(self.names), 2) or confidence.shape != points.shape[:3]:
            raise ObservationError(
                f"keypoints of camera {self.camera} have shape {points.shape} with confidence {confidence.shape}",
                file=self.source or None,
                remedy=f"Give (frames, people, {len(self.names)}, 2) and (frames, people, {len(self.names)}).",
            )
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "confidence", confidence)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def times(self) -> NDArray:
        """(F,) [s] time of every frame in the take."""
        return np.arange(len(self)) / self.rate + self.time_offset


@dataclass(frozen=True, eq=False)
class Detections:
    """What kinefit's own detector saw in one video: people, each the same in one column, with their outlines.

    Parameters
    ----------
    camera : str
    rate : float [Hz]
    size : (width, height) [px] of the video's image.
    points : (F, P, 33, 2) [px]
        Landmarks of MEDIAPIPE_33 in the video's image; NaN where a person is not seen. P may be 0.
    confidence : (F, P, 33)
        Probability that a landmark is in the image and not hidden; 0 where a person is not seen.
    mask_runs : (N,)
        Lengths of the runs of all masks, one mask after the other by frame, then person: down the columns of the
        image, beginning outside of the person (COCO's uncompressed run-length code).
    mask_starts : (F * P + 1,)
        Where each mask begins in `mask_runs`; a mask without runs was not made.
    source : str
    """

    camera: str
    rate: float
    size: tuple[int, int]
    points: NDArray
    confidence: NDArray
    mask_runs: NDArray
    mask_starts: NDArray
    source: str = ""

    def __post_init__(self) -> None:
        points, confidence = frozen(self.points), frozen(self.confidence)
        starts, runs = frozen(self.mask_starts, int), frozen(self.mask_runs, np.uint32)
        cells = points.shape[0] * points.shape[1] if points.ndim == 4 else -1
        fits = points.shape[2:] == (33, 2) and confidence.shape == points.shape[:3] and len(starts) == cells + 1
        if not fits or starts[0] != 0 or starts[-1] != len(runs) or np.any(np.diff(starts) < 0):
            raise ObservationError(
                f"detections of camera {self.camera} have shape {points.shape} with confidence {confidence.shape}, "
                f"{len(starts)} starts of masks and {len(runs)} runs", file=self.source or None,
                remedy="Give (frames, people, 33, 2), (frames, people, 33) and frames * people + 1 starts.",
            )
        ends = np.concatenate([[0], np.cumsum(runs, dtype=np.int64)])[starts]
        sizes, pixels = np.diff(ends)[np.diff(starts) > 0], math.prod(self.size)
        if min(self.size) < 1 or pixels > _MOST_PIXELS or np.any(sizes != pixels):
            raise ObservationError(
                f"masks of {', '.join(map(str, np.unique(sizes)[:3])) or 'no'} pixels in images of {self.size}",
                file=self.source or None, remedy="Give runs that sum up to the image's pixels.",
            )  # fmt: skip
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "confidence", confidence)
        object.__setattr__(self, "mask_runs", runs)
        object.__setattr__(self, "mask_starts", starts)

    def within(self, first: int, frames: int) -> Detections:
        """The same as frames from `first` on of a video of so many; nobody is seen in the others."""
        after, people = frames - first - len(self), self.points.shape[1]
        around = ((first, after), (0, 0), (0, 0))
        return replace(
            self, points=np.pad(self.points, (*around, (0, 0)), constant_values=np.nan),
            confidence=np.pad(self.confidence, around),
            mask_starts=np.pad(self.mask_starts, (first * people, after * people), mode="edge"),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.points)

    @property
    def seen(self) -> NDArray:
        """(F, P) bool, whether a person is seen in a frame."""
        return np.isfinite(self.points).all(axis=(2, 3))

    def mask(self, frame: int, person: int) -> NDArray | None:
        """(height, width) bool, the pixels of a person; None where there is no mask."""
        cell = range(len(self))[frame] * self.points.shape[1] + range(self.points.shape[1])[person]
        runs = self.mask_runs[self.mask_starts[cell] : self.mask_starts[cell + 1]]
        if not len(runs):
            return None
        width, height = self.size
        return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T

    def keypoints(
        self, camera: str | None = None, *, image_frame: ImageFrame | None = None, time_offset: float = 0.0
    ) -> Keypoints:
        """The landmarks of all people as a detector's keypoints.

        Parameters
        ----------
        camera : str, optional
            Its name in the rig; default: the video's.
        image_frame : ImageFrame, optional
            The video's image frame, where it is not the calibration's.
        time_offset : float [s]

        Raises
        ------
        ObservationError
            Nobody is seen in any frame.
        """
        if not self.seen.any():
            raise ObservationError(
                f"nobody is seen in any of the {len(self)} frames of camera {camera or self.camera}",
                file=self.source or None,
                remedy="The detector wants a person of a tenth of the image's height or more; leave this camera out.",
            )
        points = self.points if image_frame is None else image_frame.to_calibration(self.points)
        return Keypoints(
            camera or self.camera, "MEDIAPIPE_33", MEDIAPIPE_33, self.rate, points, self.confidence,
            time_offset=time_offset, source=self.source,
        )


@dataclass(frozen=True)
class MarkerEvent:
    """Something marked in a recording.

    Parameters
    ----------
    label : str, such as "Foot Strike".
    time : float [s] on the recording's own clock, which begins with frame 1.
    context : str, such as "Left"; subject : str
    """

    label: str
    time: float
    context: str = ""
    subject: str = ""


@dataclass(frozen=True, eq=False)
class Markers:
    """3D positions of markers over time, labelled (names) or not (names such as "*1").

    Parameters
    ----------
    names : (M,)
    rate : float [Hz]
    positions : (F, M, 3) [m]
        World frame of the file; NaN where a marker was not seen.
    residual : (F, M) [m] or None
        The system's own reconstruction residual.
    up : "x", "y", "z" or None
        Vertical axis of the world, where the file says so.
    first_frame : int
        Number that the file gives its first frame.
    source : str
    unit : str, of the file that it came from: "mm", "m" ...; positions are in metres whatever it says.
    events : what was marked in the recording.
    """

    names: tuple[str, ...]
    rate: float
    positions: NDArray
    residual: NDArray | None = None
    up: str | None = None
    first_frame: int = 0
    source: str = ""
    unit: str = "m"
    events: tuple[MarkerEvent, ...] = ()

    def __post_init__(self) -> None:
        check_seen(self.source, self.rate, self.names)
        positions = frozen(self.positions)
        if positions.ndim != 3 or positions.shape[1:] != (len(self.names), 3):
            raise ObservationError(
                f"markers have shape {positions.shape} for {len(self.names)} names",
                file=self.source or None,
                remedy=f"Give (frames, {len(self.names)}, 3).",
            )
        object.__setattr__(self, "positions", positions)
        if self.residual is not None:
            object.__setattr__(self, "residual", frozen(self.residual))

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def times(self) -> NDArray:
        """(F,) [s] since the first frame."""
        return np.arange(len(self)) / self.rate


@dataclass(frozen=True, eq=False)
class SkeletonMotion:
    """A recorded motion of any skeleton: joint frames over time (BVH, ASF/AMC).

    Parameters
    ----------
    names : (J,) joint names; end sites are named after their parent with the suffix "_end".
    parents : (J,) int, -1 for the root; parents come before children.
    offsets : (J, 3) [m] rest position of each joint in its parent's rest frame (world-aligned).
    rate : float [Hz]
    Ts_world_joint : (F, J, 4, 4)
        Pose of every joint frame in the file's world, translation in metres.
    up : "x", "y" or "z".
    source : str
    """

    names: tuple[str, ...]
    parents: NDArray
    offsets: NDArray
    rate: float
    Ts_world_joint: NDArray
    up: str = "y"
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parents", frozen(self.parents, int))
        object.__setattr__(self, "offsets", frozen(self.offsets))
        object.__setattr__(self, "Ts_world_joint", frozen(self.Ts_world_joint))

    def __len__(self) -> int:
        return len(self.Ts_world_joint)

    @property
    def positions(self) -> NDArray:
        """(F, J, 3) [m] joint positions in the world."""
        return self.Ts_world_joint[..., :3, 3]

    @property
    def rest(self) -> NDArray:
        """(J, 3) [m] joint positions at rest, the roots' offsets included, in the axes of the file's world."""
        rest = np.array(self.offsets)
        for joint, parent in enumerate(self.parents):
            rest[joint] += rest[parent] if parent >= 0 else 0.0
        return rest
