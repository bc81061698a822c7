"""Frames: the data of one sensor at one time, from a live source or a recording; their kinds and sensors' names."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import check_shape, rgb_image
from kinefit.errors import ObservationError
from kinefit.observations.arrays import check_seen, freeze, frozen, numbers, sealed, typical_depth
from kinefit.observations.recordings import Keypoints

_MAX_DEPTH = 100.0  # [m] of any depth camera; a larger number is in millimetres


KEYPOINTS = "keypoints"
"""Name of the one sensor of the keypoint detectors of all cameras."""


@dataclass(frozen=True, eq=False)
class _SensorFrame:
    """What all frames have: the name of what saw it, and its time [s].

    A kind states its arrays that have a row for each of its `names`, {array: (what it is, shape of a row)}; the form of
    its sensor's name, whose prefix distinguishes kinds that share a camera; and the array that is an image.
    """

    sensor: str
    time: float
    _rows: ClassVar[Mapping[str, tuple[str, tuple[int, ...]]]] = {}
    _sensor_form: ClassVar[str] = "{}"
    _pixels: ClassVar[str] = ""

    def __post_init__(self) -> None:
        names = getattr(self, "names", ())
        check_seen(self.sensor, self.time, names)
        for name, (what, row) in self._rows.items():
            if (values := getattr(self, name)) is not None or not hasattr(type(self), name):  # None may be a default
                freeze(self, **{name: frozen(values, float, f"{what} of {self.sensor}", (len(names), *row))})


class _ImageLike(_SensorFrame):
    """A frame of one value or colour for each pixel."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) [px]."""
        height, width = getattr(self, self._pixels).shape[:2]
        return width, height


@dataclass(frozen=True, eq=False)
class DepthFrame(_ImageLike):
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

    depth: NDArray
    _pixels = "depth"

    def __post_init__(self) -> None:
        super().__post_init__()
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


@dataclass(frozen=True, eq=False)
class PointCloud(_SensorFrame):
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

    points: NDArray
    viewpoint: NDArray | None = None
    on_body: bool = False
    segment: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        points = frozen(self.points, float, f"a cloud of {self.sensor}", ("points", 3))
        object.__setattr__(self, "points", frozen(points[np.isfinite(points).all(axis=1)]))
        if self.viewpoint is not None:
            eye = frozen(self.viewpoint, float, what := f"the viewpoint of a cloud of {self.sensor}")
            check_shape(eye, (3,), what, finite=True)
            object.__setattr__(self, "viewpoint", eye)

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class KeypointFrame(_SensorFrame):
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

    names: tuple[str, ...]
    uv: NDArray
    confidence: NDArray
    keypoint_set: str = ""
    sides_known: bool = False
    _rows: ClassVar = {"confidence": ("the confidence of keypoints", ()), "uv": ("keypoints", (2,))}
    _sensor_form = KEYPOINTS

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


@dataclass(frozen=True, eq=False)
class MarkerFrame(_SensorFrame):
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

    names: tuple[str, ...]
    positions: NDArray
    marker_set: str = ""
    _rows: ClassVar = {"positions": ("markers", (3,))}


@dataclass(frozen=True, eq=False)
class SilhouetteFrame(_ImageLike):
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

    mask: NDArray
    _pixels, _sensor_form = "mask", "silhouette {}"

    def __post_init__(self) -> None:
        super().__post_init__()
        mask = numbers(self.mask, None, f"a mask of {self.sensor}")
        mask = 255 * mask.astype(np.uint8) if mask.dtype == bool else mask
        if mask.ndim != 2 or not mask.size or mask.dtype != np.uint8:
            problem = f"a mask of {self.sensor} has shape {mask.shape} and type {mask.dtype}"
            raise ObservationError(problem, remedy="Give (height, width), of bool, or of uint8 from 0 to 255.")
        object.__setattr__(self, "mask", frozen(mask, np.uint8))


@dataclass(frozen=True, eq=False)
class LineFrame(_SensorFrame):
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

    names: tuple[str, ...]
    landmarks: tuple[tuple[str, ...], ...]
    ends: NDArray
    _sensor_form = "lines {}"

    def __post_init__(self) -> None:
        super().__post_init__()
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

    _sensor_form = "clicks {}"


@dataclass(frozen=True, eq=False)
class ColourFrame(_ImageLike):
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

    image: NDArray
    _pixels, _sensor_form = "image", "region {}"

    def __post_init__(self) -> None:
        super().__post_init__()
        freeze(self, image=np.ascontiguousarray(rgb_image(self.image, f"an image of {self.sensor}")))


@dataclass(frozen=True, eq=False)
class LiftedFrame(_SensorFrame):
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

    names: tuple[str, ...]
    x: NDArray
    uv: NDArray
    keypoint_set: str
    _rows: ClassVar = {"uv": ("pixels of lifted landmarks", (2,)), "x": ("lifted landmarks", (3,))}
    _sensor_form = "lifted {}"


@dataclass(frozen=True, eq=False)
class BodyTrackerFrame(_SensorFrame):
    """Poses, or places alone, of trackers that are fixed on the body.

    Parameters
    ----------
    sensor, time : name of the system, and [s]
    names : (K,) of the trackers
    x_world : (K, 3) [m] place of each; NaN if missing
    Rs_world_tracker : (K, 3, 3) rotations, whose columns are the tracker's axes in the world; NaN if missing; default:
        all missing

    Raises
    ------
    ObservationError
        Arrays of other shapes.
    """

    names: tuple[str, ...]
    x_world: NDArray
    Rs_world_tracker: NDArray | None = None
    _rows: ClassVar = {"x_world": ("trackers", (3,)), "Rs_world_tracker": ("rotations of trackers", (3, 3))}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.Rs_world_tracker is None:
            freeze(self, Rs_world_tracker=sealed(np.full((len(self.names), 3, 3), np.nan)))


@dataclass(frozen=True, eq=False)
class SurfacePointFrame(_SensorFrame):
    """Tracked points of a surface at one time, from `photogrammetry.surface_tracking.SurfaceTracker.update`.

    Parameters
    ----------
    sensor, time : name of the sensor, and [s]
    ids : (N,) int, the same for the same point at all times
    x_world : (N, 3) [m]; NaN for missing points, which are dropped
    covariance : (N, 3, 3) [m²]

    Raises
    ------
    ObservationError
        Arrays of other shapes, or a point twice.
    """

    ids: NDArray
    x_world: NDArray
    covariance: NDArray

    def __post_init__(self) -> None:
        super().__post_init__()
        ids, x, c = numbers(self.ids, None), numbers(self.x_world), numbers(self.covariance)
        if ids.ndim != 1 or x.shape != (len(ids), 3) or c.shape != (len(ids), 3, 3) or ids.dtype.kind not in "iu":
            problem = f"{ids.dtype} ids {ids.shape}, points {x.shape}, covariances {c.shape} of {self.sensor}"
            raise ObservationError(problem, remedy="Give whole numbers (N,), (N, 3) and (N, 3, 3).")
        if len(np.unique(ids)) < len(ids):
            raise ObservationError(f"a point of {self.sensor} twice", remedy="Give every point its own number.")
        known = np.isfinite(x).all(axis=1) & np.isfinite(c).all(axis=(1, 2))
        freeze(self, ids=ids[known], x_world=x[known], covariance=c[known])


Frame = DepthFrame | PointCloud | KeypointFrame | MarkerFrame | SilhouetteFrame | LineFrame | ColourFrame | LiftedFrame
"""What a sensor of a known kind sees at one time; a `ClickFrame` is a `LineFrame`."""


def sensor_of(frame: object) -> str:
    """Name of a frame's sensor: its `sensor`, with a prefix for kinds that may share a camera."""
    return getattr(frame, "_sensor_form", "{}").format(getattr(frame, "sensor", ""))


def by_record(frames: Iterable[Any]) -> Mapping[type, list[Any]]:
    """Frames or measurements of one time by class: `by_record(frames)[DepthFrame]`; empty lists for other classes."""
    out = defaultdict[type, list[Any]](list)
    for frame in frames:
        out[type(frame)].append(frame)
    return out
