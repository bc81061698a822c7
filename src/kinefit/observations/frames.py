"""Frames: the data of one sensor at one time, from a live source or a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape, rgb_image
from kinefit.errors import ObservationError
from kinefit.observations.arrays import check_seen, freeze, frozen, numbers, sealed, typical_depth
from kinefit.observations.recordings import Keypoints

_MAX_DEPTH = 100.0  # [m] of any depth camera; a larger number is in millimetres


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """One depth image.

    Parameters
    ----------
    sensor : str
        Name of its camera in the rig.
    time : float [s]
    depth : (H, W) float32 [m]
        Along the optical axis; 0 for pixels without a measurement.

    Raises
    ------
    ObservationError
        The array is no image, or its values are too large for metres.
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
        if typical > _MAX_DEPTH:
            problem = f"a depth image of {self.sensor} has a typical depth of {typical:.0f} m: probably millimetres"
            raise ObservationError(problem, remedy="Give metres: 0.001 times an image in millimetres.")
        depth.flags.writeable = False
        object.__setattr__(self, "depth", depth)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        return self.depth.shape[1], self.depth.shape[0]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """3D points on a surface (P2 2.3): of anything, of the body, or of one segment.

    Parameters
    ----------
    sensor : str
    time : float [s]
    points : (N, 3) [m] in the world; points that are not finite are dropped
    viewpoint : (3,) [m] or None
        Place of the sensor in the world: only surfaces that face it are matched. None: all are.
    on_body : bool
        Whether all points are known to be on the body.
    segment : str or None
        The segment of all points, if known.

    Raises
    ------
    ObservationError
        Arrays of other shapes; a viewpoint that is not finite.
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
    uv : (K, 2) [px] in the calibration's image frame; NaN for undetected keypoints
    confidence : (K,) in 0..1, 0 for undetected keypoints
    keypoint_set : str
        The body's keypoint set that has the names; "" for names of the body's landmarks.
    sides_known : bool
        Whether left and right are stated: no correction of swapped sides exchanges them.

    Raises
    ------
    ObservationError
        Arrays of other shapes.
    """

    sensor: str
    time: float
    names: tuple[str, ...]
    uv: NDArray
    confidence: NDArray
    keypoint_set: str = ""
    sides_known: bool = False

    @classmethod
    def of_record(cls, record: Keypoints, frame: int, time: float) -> KeypointFrame:
        """One frame of a record of one person, at a time [s]; the record's arrays are not checked again."""
        out = object.__new__(cls)
        uv, confidence = (sealed(values[frame, 0].copy()) for values in (record.points, record.confidence))
        freeze(
            out, sensor=record.camera, time=time, names=record.names, uv=uv, confidence=confidence,
            keypoint_set=record.keypoint_set,
            sides_known=record.sides_known is not None and bool(record.sides_known[frame]),
        )  # fmt: skip
        return out

    def __post_init__(self) -> None:
        check_seen(self.sensor, self.time, self.names)
        what, count = f"keypoints of {self.sensor}", len(self.names)
        confidence = frozen(self.confidence, float, f"the confidence of {what}", (count,))
        freeze(self, uv=frozen(self.uv, float, what, (count, 2)), confidence=confidence)


@dataclass(frozen=True, eq=False)
class MarkerFrame:
    """3D positions of labelled markers.

    Parameters
    ----------
    sensor : str
    time : float [s]
    names : (M,) labels
    positions : (M, 3) [m] in the world; NaN for missing markers
    marker_set : str
        The body's marker set that has the names; "" for names of the body's landmarks.
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
    """A mask of the body in one image.

    Parameters
    ----------
    sensor : str
        Name of its camera in the rig.
    time : float [s]
    mask : (H, W) uint8 or bool
        In the calibration's image frame: 255 (or True) for pixels of the body, 0 for others, between for pixels that
        its contour crosses.

    Raises
    ------
    ObservationError
        The array is no image, or not of 8 bits.
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
    """Lines in one image through points or edges of the body (P1 2.3).

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    time : float [s]
    names : (L,) of the lines
    landmarks : (L,) of one or two names each
        The body's landmarks that lie on a line: the two ends of an edge, or a single point.
    ends : (L, 2, 2) [px]
        Two points of every line in the calibration's image frame, in any order; NaN for an undetected line.

    Raises
    ------
    ObservationError
        Shapes do not agree; the two points of a line are less than a pixel apart; a line has not one or two landmarks.
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
                raise ObservationError(problem, remedy="Give two points of it that are far apart.")
        object.__setattr__(self, "ends", ends)


class ClickFrame(LineFrame):
    """Points of the body that a person clicked in one image, each as two lines that cross in it."""


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
        The array is no image of three channels of 8 bits.
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
    """3D landmarks of one person that a network estimated from one camera's image.

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    time : float [s]
    names : (K,) of the landmarks, the hips among them
    x : (K, 3) [m]
        Relative to the middle of the hips, along the calibrated image's u and v and away from the camera, at the
        network's own scale; NaN for undetected landmarks.
    uv : (K, 2) [px] the same landmarks in the calibration's image frame; NaN for undetected ones
    keypoint_set : str
        The body's keypoint set that has the names.
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
