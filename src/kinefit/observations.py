"""What one sensor saw: frozen records, in metres, radians, seconds and pixels.

Readers make them, correspondences use them; nothing here opens a file or knows a body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError


def _frozen(array: NDArray, dtype: type = float) -> NDArray:
    array = np.array(array, dtype=dtype)
    array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class Keypoints:
    """2D keypoints of all people that a detector saw in one camera.

    Parameters
    ----------
    camera : str
        Name of the camera in the rig.
    keypoint_set : str
        Name of the set ("BODY_25B", "COCO_17", "HALPE_26", "MEDIAPIPE_33"); tells which names the columns have.
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
        points, confidence = _frozen(self.points), _frozen(self.confidence)
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
    """

    names: tuple[str, ...]
    rate: float
    positions: NDArray
    residual: NDArray | None = None
    up: str | None = None
    first_frame: int = 0
    source: str = ""

    def __post_init__(self) -> None:
        positions = _frozen(self.positions)
        if positions.ndim != 3 or positions.shape[1:] != (len(self.names), 3):
            raise ObservationError(
                f"markers have shape {positions.shape} for {len(self.names)} names",
                file=self.source or None,
                remedy=f"Give (frames, {len(self.names)}, 3).",
            )
        object.__setattr__(self, "positions", positions)
        if self.residual is not None:
            object.__setattr__(self, "residual", _frozen(self.residual))

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
        object.__setattr__(self, "parents", _frozen(self.parents, int))
        object.__setattr__(self, "offsets", _frozen(self.offsets))
        object.__setattr__(self, "Ts_world_joint", _frozen(self.Ts_world_joint))

    def __len__(self) -> int:
        return len(self.Ts_world_joint)

    @property
    def positions(self) -> NDArray:
        """(F, J, 3) [m] joint positions in the world."""
        return self.Ts_world_joint[..., :3, 3]
