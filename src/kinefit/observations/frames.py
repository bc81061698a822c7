"""What one sensor saw at one time: what a live source hands to the tracker, and what a recording is made of."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape, rgb_image
from kinefit.errors import ObservationError
from kinefit.observations.arrays import check_seen, freeze, frozen, numbers, sealed, typical_depth
from kinefit.observations.recordings import Keypoints

_FARTHEST = 100.0  # [m] that any depth camera measures; a tenth of a metre in millimetres


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """One depth image.

    Parameters
    ----------
    sensor : str
        Name of its camera in the rig.
    time : float [s]
    depth : (H, W) float32 [m]
        Along the optical axis; 0 where nothing was measured.

    Raises
    ------
    ObservationError
        No image, or one whose numbers are too large for metres.
    """

    sensor: str
    time: float
    depth: NDArray

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time)
        depth = numbers(self.depth, np.float32, f"a depth image of {self.sensor}")
        if depth.ndim != 2 or not depth.size:
            raise ObservationError(
                f"a depth image of {self.sensor} has shape {depth.shape}", remedy="Give (height, width) in metres."
            )
        if not (depth.min() >= 0.0 and depth.max() < np.inf):
            depth[~((depth > 0.0) & (depth < np.inf))] = 0.0
        typical = typical_depth(depth)
        if typical > _FARTHEST:
            problem = f"millimetres taken for metres? A depth image of {self.sensor} shows things {typical:.0f} m away"
            raise ObservationError(problem, remedy="Give metres: 0.001 times an image in millimetres.")
        depth.flags.writeable = False
        object.__setattr__(self, "depth", depth)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.depth.shape[1], self.depth.shape[0]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """3D points that lie on some surface (P2 2.3): anywhere, on the body, or on one segment of it.

    Parameters
    ----------
    sensor : str
    time : float [s]
    points : (N, 3) [m] in the world
    viewpoint : (3,) [m] or None
        Where the sensor stood, in the world: only a side that faces it can have been seen.
    on_body : bool
        Whether all points are known to be the body's.
    segment : str or None
        The one segment that they are on, where that is known.
    """

    sensor: str
    time: float
    points: NDArray
    viewpoint: NDArray | None = None
    on_body: bool = False
    segment: str | None = None

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time)
        points = frozen(self.points, float, f"a cloud of {self.sensor}", ("points", 3))
        object.__setattr__(self, "points", frozen(points[np.isfinite(points).all(axis=1)]))
        if self.viewpoint is not None:
            eye = frozen(self.viewpoint, float, what := f"the viewpoint of a cloud of {self.sensor}")
            check_shape(eye, (3,), what, finite=True)
            object.__setattr__(self, "viewpoint", eye)

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class KeypointFrame:
    """2D keypoints of one person in one camera.

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    time : float [s]
    names : (K,) of the keypoints
    uv : (K, 2) [px] in the calibration's image frame; NaN where unseen
    confidence : (K,) in 0..1, 0 where unseen
    keypoint_set : str
        The body's keypoint set that the names belong to; "" for names of the body's landmarks.
    """

    sensor: str
    time: float
    names: tuple[str, ...]
    uv: NDArray
    confidence: NDArray
    keypoint_set: str = ""

    @classmethod
    def of_record(cls, record: Keypoints, frame: int, time: float) -> KeypointFrame:
        """The person of a record of one, at a frame and a time [s]; not checked again, as the record was."""
        made = object.__new__(cls)
        uv, sure = (sealed(values[frame, 0].copy()) for values in (record.points, record.confidence))
        freeze(
            made, sensor=record.camera, time=time, names=record.names, uv=uv, confidence=sure,
            keypoint_set=record.keypoint_set,
        )  # fmt: skip
        return made

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time, self.names)
        what, count = f"keypoints of {self.sensor}", len(self.names)
        confidence = frozen(self.confidence, float, f"the confidence of {what}", (count,))
        freeze(self, uv=frozen(self.uv, float, what, (count, 2)), confidence=confidence)


@dataclass(frozen=True, eq=False)
class MarkerFrame:
    """3D positions of labelled markers: point to point.

    Parameters
    ----------
    sensor : str
    time : float [s]
    names : (M,)
    positions : (M, 3) [m] in the world; NaN where unseen
    marker_set : str
        The body's marker set that the names belong to; "" for names of the body's landmarks.
    """

    sensor: str
    time: float
    names: tuple[str, ...]
    positions: NDArray
    marker_set: str = ""

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time, self.names)
        freeze(self, positions=frozen(self.positions, float, f"markers of {self.sensor}", (len(self.names), 3)))


@dataclass(frozen=True, eq=False)
class SilhouetteFrame:
    """Which pixels of one image show the body.

    Parameters
    ----------
    sensor : str
        Name of its camera in the rig.
    time : float [s]
    mask : (H, W) uint8 or bool
        In the calibration's image frame: 255 (or True) where the body is, 0 where it is not, between for an edge that
        lies within the pixel.

    Raises
    ------
    ObservationError
        No image, or one that is not of 8 bits.
    """

    sensor: str
    time: float
    mask: NDArray

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time)
        mask = numbers(self.mask, None, f"a mask of {self.sensor}")
        mask = 255 * mask.astype(np.uint8) if mask.dtype == bool else mask
        if mask.ndim != 2 or not mask.size or mask.dtype != np.uint8:
            problem = f"a mask of {self.sensor} has shape {mask.shape} and type {mask.dtype}"
            raise ObservationError(problem, remedy="Give (height, width), of bool, or of uint8 from 0 to 255.")
        object.__setattr__(self, "mask", frozen(mask, np.uint8))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.mask.shape[1], self.mask.shape[0]


@dataclass(frozen=True, eq=False)
class LineFrame:
    """Lines in one image that points or edges of the body lie on (P1 2.3).

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    time : float [s]
    names : (L,) of the lines
    landmarks : (L,) of one or two names each
        The body's landmarks that lie on a line: the two ends of an edge, or a single point.
    ends : (L, 2, 2) [px]
        Two points of every line in the calibration's image frame, in any order; NaN for one that was not seen.

    Raises
    ------
    ObservationError
        Shapes that do not agree; a line through one or two equal points, or of no or more than two landmarks.
    """

    sensor: str
    time: float
    names: tuple[str, ...]
    landmarks: tuple[tuple[str, ...], ...]
    ends: NDArray

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time, self.names)
        for own in self.landmarks if isinstance(self.landmarks, Sequence) else [None]:
            check_seen(self.sensor, self.time, own)
        ends = frozen(self.ends, float, f"a record of lines of {self.sensor}")
        if ends.shape != (len(self.names), 2, 2) or len(self.landmarks) != len(self.names):
            problem = f"lines of {self.sensor} have shape {ends.shape}, with landmarks of {len(self.landmarks)}"
            raise ObservationError(problem, remedy=f"Give ({len(self.names)}, 2, 2), and landmarks for each line.")
        for name, own, (a, b) in zip(self.names, self.landmarks, ends):
            if not 1 <= len(set(own)) == len(own) <= 2:
                problem = f"line '{name}' of {self.sensor} has the landmarks {', '.join(own) or 'none'}"
                raise ObservationError(problem, remedy="Give the two ends of an edge, or one point that lies on it.")
            if np.linalg.norm(a - b) < 1.0:
                problem = f"the points of line '{name}' of {self.sensor} are less than a pixel apart"
                raise ObservationError(problem, remedy="Give two points of it far from each other.")
        object.__setattr__(self, "ends", ends)


@dataclass(frozen=True, eq=False)
class ColourFrame:
    """One colour image.

    Parameters
    ----------
    sensor : str
        Name of its camera in the rig.
    time : float [s]
    image : (H, W, 3) uint8 RGB
        In the calibration's image frame. It is not copied.

    Raises
    ------
    ObservationError
        No image, or one that is not of three channels of 8 bits.
    """

    sensor: str
    time: float
    image: NDArray

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time)
        freeze(self, image=np.ascontiguousarray(rgb_image(self.image, f"an image of {self.sensor}")))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.image.shape[1], self.image.shape[0]


@dataclass(frozen=True, eq=False)
class LiftedFrame:
    """Landmarks of one person that a network lifted from one camera's image to space.

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    time : float [s]
    names : (K,) of the landmarks, the hips among them
    x : (K, 3) [m]
        From the middle of the hips, along the calibrated image's u and v and away from the camera, of a person of the
        network's idea of size; NaN where unseen.
    uv : (K, 2) [px] the same landmarks in the calibration's image frame; NaN where unseen
    keypoint_set : str
        The body's keypoint set that the names belong to.
    """

    sensor: str
    time: float
    names: tuple[str, ...]
    x: NDArray
    uv: NDArray
    keypoint_set: str

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time, self.names)
        what, count = f"lifted landmarks of {self.sensor}", len(self.names)
        uv = frozen(self.uv, float, f"pixels of {what}", (count, 2))
        freeze(self, x=frozen(self.x, float, what, (count, 3)), uv=uv)


Frame = DepthFrame | PointCloud | KeypointFrame | MarkerFrame | SilhouetteFrame | LineFrame | ColourFrame | LiftedFrame


KEYPOINTS = "keypoints"
"""Name of the sensor that the keypoint detectors of all cameras are together."""

_NAMES = {
    KeypointFrame: KEYPOINTS, SilhouetteFrame: "silhouette {}", LineFrame: "lines {}", ColourFrame: "region {}",
    LiftedFrame: "lifted {}",
}  # fmt: skip


def sensor_of(frame: object) -> str:
    """Name of the sensor that a frame is of: where several see with one camera, with what is seen there."""
    return _NAMES.get(type(frame), "{}").format(getattr(frame, "sensor", ""))


def by_record(frames: Iterable[Any]) -> Mapping[type, list[Any]]:
    """Frames of one time, sorted by their record: `by_record(frames)[DepthFrame]`, empty where there is none."""
    out = defaultdict[type, list[Any]](list)
    for frame in frames:
        out[type(frame)].append(frame)
    return out
