"""Recordings of one sensor with a time for each frame: images, clouds, keypoints, lines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.observations.arrays import freeze, sealed
from kinefit.observations.frames import (
    ClickFrame,
    ColourFrame,
    DepthFrame,
    KeypointFrame,
    LineFrame,
    MarkerFrame,
    PointCloud,
    SilhouetteFrame,
)
from kinefit.observations.recordings import Markers

_MIN_GAP_STEPS = 1.5  # of time between frames: half a step late is jitter, more is a missing frame
_MAX_TIME = 1e11  # [s]: clocks count from 1970 or from their start


def checked_times(times: NDArray, sensor: str, source: str = "") -> NDArray:
    """Read-only times (F,) [s] of a sensor's frames.

    Raises
    ------
    ObservationError
        No times; a time that is not finite, too large, or not later than the one before it.
    """
    times = np.array(times, dtype=float).ravel()
    back = np.flatnonzero(~(np.diff(times) > 0.0)) + 1
    bad = np.flatnonzero(~np.isfinite(times))
    if not len(times) or len(bad) or len(back):
        frame = int(bad[0] if len(bad) else back[0] if len(back) else 0)
        both = ", ".join(f"{t:.6g} s" for t in times[max(frame - 1, 0) : frame + 1])
        raise ObservationError(
            f"times of the frames of {sensor} do not increase ({both})" if len(times) else f"{sensor} has no frames",
            file=source or None, place=f"frame {frame}" if len(times) else None,
            remedy="Sort the frames by time and remove duplicates; a clock that was set back needs two takes.",
        )  # fmt: skip
    if max(-times[0], times[-1]) > _MAX_TIME:
        problem = f"times of the frames of {sensor} from {times[0]:.6g} to {times[-1]:.6g} s"
        raise ObservationError(problem, file=source or None, remedy="Give seconds; time_unit = \"us\" says otherwise.")
    times.flags.writeable = False
    return times


@dataclass(frozen=True, eq=False)
class SensorRecording(ABC):
    """Base of recordings of one sensor with a time for each frame.

    Parameters
    ----------
    sensor : name
    rate : float [Hz]; None: that of the median step of the times
    times : (F,) [s] in the take; strictly increasing

    Raises
    ------
    ObservationError
        Times that do not increase; a single time without a rate.
    """

    sensor: str
    rate: float
    times: NDArray

    def __post_init__(self) -> None:
        source = getattr(self, "source", "")
        freeze(self, times=checked_times(self.times, self.sensor, source))
        if self.rate is None:
            if len(self.times) < 2:
                remedy = "Give two frames or more, or the rate."
                raise ObservationError(f"{self.sensor} has one frame and no rate", file=source or None, remedy=remedy)
            freeze(self, rate=1.0 / float(np.median(np.diff(self.times))))

    @abstractmethod
    def frame(self, i: int) -> Any:
        """Frame number `i`: a measurement, or what its sensor prepares."""

    def __len__(self) -> int:
        return len(self.times)

    @property
    def gaps(self) -> NDArray:
        """(G,) int: frames after a gap of more than 1.5 steps: frames are missing, or the clock jumped."""
        return np.flatnonzero(np.diff(self.times) > _MIN_GAP_STEPS / self.rate) + 1

    def _at(self, i: int) -> tuple[int, float]:
        """Number of a frame, which counts from the end if it is negative, and its time [s]."""
        i = range(len(self))[i]
        return i, float(self.times[i])

    def nearest(self, time: float) -> int:
        """Number of the frame nearest to a time [s] of the take."""
        i = int(np.searchsorted(self.times, time))
        return min((k for k in (i - 1, i) if 0 <= k < len(self)), key=lambda k: abs(self.times[k] - time))

    def at_step(self, step: int, rate: float) -> int | None:
        """Number of the frame nearest to a step of a take, t = step / rate; None if it is half a step or more away.

        Every frame has one step. A slow sensor has steps without a frame, a fast one frames that no step uses.

        Parameters
        ----------
        rate : [Hz] of the take
        """
        i = self.nearest(step / rate)
        return i if -0.5 <= round(self.times[i] * rate - step, 6) < 0.5 else None


@dataclass(frozen=True, eq=False)
class ColourVideo(SensorRecording):
    """Colour images of one camera.

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing.
    size : (width, height) [px] of the calibration's image
    image : callable
        Frame number -> (H, W, 3) uint8 RGB in the calibration's image frame.
    source : str
        File or folder, for messages.
    notes : tuple of str
        What the reader has to say of the files.

    Raises
    ------
    ObservationError
        Times that do not increase.
    """

    size: tuple[int, int]
    image: Callable[[int], NDArray]
    source: str = ""
    notes: tuple[str, ...] = ()
    _kind: ClassVar[type[ColourFrame] | type[SilhouetteFrame]] = ColourFrame

    def frame(self, i: int) -> ColourFrame | SilhouetteFrame:
        """Frame number `i`, read now; a negative number counts from the end."""
        return self._kind(self.sensor, *_image(self, i))


class SilhouetteVideo(ColourVideo):
    """Silhouettes of one camera, as `ColourVideo` has them: its images are (H, W) uint8, 255 for pixels of the body."""

    _kind = SilhouetteFrame


def _image(video: ColourVideo | DepthVideo, i: int) -> tuple[float, NDArray]:
    """Time [s] and image of a frame, read now; a negative number counts from the end."""
    i, time = video._at(i)
    image = np.asarray(video.image(i))
    if image.shape[1::-1] != video.size:
        raise ObservationError(
            f"the image has {image.shape[1::-1]} px, its camera {video.size}", file=video.source or None,
            place=f"frame {i} of {video.sensor}", remedy="All images of a camera must have its size.",
        )  # fmt: skip
    return time, image


@dataclass(frozen=True, eq=False)
class DepthVideo(SensorRecording):
    """Depth images of one sensor.

    Parameters
    ----------
    sensor : str
        Name of its camera in the rig.
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing.
    size : (width, height) [px]
    image : callable
        Frame number -> (H, W) [m] along the optical axis; values that are not positive and finite count as missing.
    near, far : float [m]
        Range: depths outside are set to 0.
    camera : Camera or None
        The sensor's calibration, if the recording contains it.
    background : DepthVideo or None
        The empty scene, recorded by the same sensor at the same place.
    on_body : bool
        Whether everything but the body is already removed.
    source : str
        File or folder, for messages.
    notes : tuple of str
        What the reader has to say of the files.

    Raises
    ------
    ObservationError
        Times that do not increase; an impossible rate or range; a background of another size.
    """

    size: tuple[int, int]
    image: Callable[[int], NDArray]
    near: float = 0.0
    far: float = np.inf
    camera: Camera | None = None
    background: DepthVideo | None = None
    on_body: bool = False
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0.0 < self.rate < 1e6 and 0.0 <= self.near < self.far):
            raise ObservationError(
                f"rate {self.rate:g} Hz, range {self.near:g} to {self.far:g} m of {self.sensor}",
                file=self.source or None, remedy="Give frames per second, and a range in metres, the nearer end first.",
            )  # fmt: skip
        if self.background is not None and self.background.size != self.size:
            raise ObservationError(
                f"the background of {self.sensor} has {self.background.size} px, its frames have {self.size}",
                file=self.background.source or None, remedy="Record the empty scene with the same settings.",
            )  # fmt: skip

    def frame(self, i: int) -> DepthFrame:
        """Frame number `i`, read now; a negative number counts from the end.

        Raises
        ------
        ObservationError
            The image has another size than the recording.
        """
        time, image = _image(self, i)
        depth = np.array(image, np.float32)
        depth[~((depth >= self.near) & (depth <= self.far))] = 0.0
        return DepthFrame(self.sensor, time, depth)

    def without(self, frames: NDArray) -> DepthVideo:
        """The recording without some frames (N,) int; some must remain."""
        remaining = np.setdiff1d(np.arange(len(self)), frames)
        return replace(self, times=self.times[remaining], image=lambda i: self.image(int(remaining[i])))


@dataclass(frozen=True, eq=False)
class CloudVideo(SensorRecording):
    """Unordered point clouds of one sensor.

    Parameters
    ----------
    sensor : str
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing.
    points : callable
        Frame number -> (N, 3) [m] in the sensor's frame.
    T_world_sensor : (4, 4) [m]; default: the identity
    viewpoint : bool
        Whether the sensor is at the origin of its frame: only surfaces that face it are matched.
    near, far : float [m]
        Range: points nearer or farther from the origin of the sensor's frame are dropped.
    on_body : bool
        Whether everything but the body is already removed.
    segment : str or None
        The body segment of all points, if known.
    source : str
    notes : tuple of str
        What the reader has to say of the files.

    Raises
    ------
    ObservationError
        Times that do not increase.
    """

    points: Callable[[int], NDArray]
    T_world_sensor: NDArray | None = None
    viewpoint: bool = True
    near: float = 0.0
    far: float = np.inf
    on_body: bool = False
    segment: str | None = None
    source: str = ""
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        T = np.eye(4) if self.T_world_sensor is None else np.array(self.T_world_sensor, float)
        freeze(self, T_world_sensor=sealed(T))

    def frame(self, i: int) -> PointCloud:
        """Frame number `i`, read now; a negative number counts from the end."""
        (i, time), T = self._at(i), self.T_world_sensor
        assert T is not None
        x = np.asarray(self.points(i), float).reshape(-1, 3)
        x = x[np.isfinite(x).all(axis=1)]
        distance = np.linalg.norm(x, axis=1)
        x = x[(distance > 0.0) & (distance >= self.near) & (distance <= self.far)]
        viewpoint = T[:3, 3] if self.viewpoint else None
        x = x @ T[:3, :3].T + T[:3, 3]
        return PointCloud(self.sensor, time, x, viewpoint, self.on_body, self.segment)


@dataclass(frozen=True, eq=False)
class KeypointVideo(SensorRecording):
    """Keypoints of one person in one camera, detected on demand.

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing.
    names : (K,) of the keypoints
    points : callable
        Frame number -> (K, 2) [px] in the calibration's image frame, NaN for undetected keypoints, and (K,) confidence
        in 0..1.
    keypoint_set : str
        The body's keypoint set that has the names; "" for names of the body's landmarks.
    source : str
        File, for messages.

    Raises
    ------
    ObservationError
        Times that do not increase.
    """

    names: tuple[str, ...]
    points: Callable[[int], tuple[NDArray, NDArray]]
    keypoint_set: str = ""
    source: str = ""

    def frame(self, i: int) -> KeypointFrame:
        """Frame number `i`, detected now; a negative number counts from the end."""
        i, time = self._at(i)
        uv, confidence = self.points(i)
        return KeypointFrame(self.sensor, time, self.names, uv, confidence, self.keypoint_set)

    def unseen(self, time: float) -> KeypointFrame:
        """A frame without detections at a time [s], with the recording's names."""
        uv, confidence = np.full((len(self.names), 2), np.nan), np.zeros(len(self.names))
        return KeypointFrame(self.sensor, time, self.names, uv, confidence, self.keypoint_set)


@dataclass(frozen=True, eq=False)
class LineVideo(SensorRecording):
    """Image lines and edges of known objects in one camera.

    Parameters
    ----------
    sensor : str
        Name of the camera in the rig.
    rate : float [Hz]
    times : (F,) [s] in the take; strictly increasing.
    names : (L,) of the lines
    landmarks : (L,) of one or two names each
        The body's landmarks that lie on a line: the two ends of an edge, or a single point.
    ends : (F, L, 2, 2) [px]
        Two points of every line in the calibration's image frame; NaN for an undetected line.
    source : str
        File, for messages.

    Raises
    ------
    ObservationError
        Times that do not increase; shapes that do not agree.
    """

    names: tuple[str, ...]
    landmarks: tuple[tuple[str, ...], ...]
    ends: NDArray
    source: str = ""
    _kind: ClassVar[type[LineFrame]] = LineFrame

    def __post_init__(self) -> None:
        super().__post_init__()
        ends = np.array(self.ends, float)
        wanted = (len(self.times), len(self.names), 2, 2)
        if ends.shape != wanted or len(self.landmarks) != len(self.names):
            raise ObservationError(
                f"lines of {self.sensor} have shape {ends.shape}, with landmarks of {len(self.landmarks)}",
                file=self.source or None, remedy=f"Give {wanted}, and landmarks for each line.",
            )  # fmt: skip
        freeze(self, ends=sealed(ends))

    def frame(self, i: int) -> LineFrame:
        """Frame number `i`; a negative number counts from the end."""
        i, time = self._at(i)
        return self._kind(self.sensor, time, self.names, self.landmarks, self.ends[i])


class ClickVideo(LineVideo):
    """Points of the body that a person clicked in images of one camera, each as two lines that cross in it."""

    _kind = ClickFrame


@dataclass(frozen=True, eq=False)
class NamedMarkers:
    """A marker recording whose labels are names of a body's marker set.

    Parameters
    ----------
    sensor : name of the sensor
    markers : Markers, with these names
    marker_set : of the body, "" for its landmarks
    time_offset : float [s] added to the times of the markers
    std : (K,) [m] standard deviation of the set's marker places on this person; None if the body has their places
    trial : Markers, with names of the set: a static trial of the same person
    """

    sensor: str
    markers: Markers
    marker_set: str
    time_offset: float = 0.0
    std: NDArray | None = None
    trial: Markers | None = None

    def at(self, time: float) -> MarkerFrame | None:
        """The frame nearest to a time [s]; None if there is none within half a frame."""
        first = self.markers.first_time + self.time_offset
        k = round((time - first) * self.markers.rate)
        if not 0 <= k < len(self.markers):
            return None
        own = k / self.markers.rate + first
        return MarkerFrame(self.sensor, own, self.markers.names, self.markers.positions[k], self.marker_set)
