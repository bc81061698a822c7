"""Recordings of named features: keypoints, image lines of known objects, and markers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.observations.depth import _Recording, checked_times
from kinefit.observations.frames import ClickFrame, KeypointFrame, LineFrame, MarkerFrame
from kinefit.observations.recordings import Markers


@dataclass(frozen=True, eq=False)
class KeypointVideo(_Recording):
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", checked_times(self.times, self.sensor, self.source))

    def frame(self, i: int) -> KeypointFrame:
        """Frame number `i`, detected now; a negative number counts from the end."""
        i = range(len(self))[i]
        uv, confidence = self.points(i)
        return KeypointFrame(self.sensor, float(self.times[i]), self.names, uv, confidence, self.keypoint_set)

    def unseen(self, time: float) -> KeypointFrame:
        """A frame without detections at a time [s], with the recording's names."""
        uv, confidence = np.full((len(self.names), 2), np.nan), np.zeros(len(self.names))
        return KeypointFrame(self.sensor, time, self.names, uv, confidence, self.keypoint_set)


@dataclass(frozen=True, eq=False)
class LineVideo(_Recording):
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", checked_times(self.times, self.sensor, self.source))
        ends = np.array(self.ends, float)
        wanted = (len(self.times), len(self.names), 2, 2)
        if ends.shape != wanted or len(self.landmarks) != len(self.names):
            raise ObservationError(
                f"lines of {self.sensor} have shape {ends.shape}, with landmarks of {len(self.landmarks)}",
                file=self.source or None, remedy=f"Give {wanted}, and landmarks for each line.",
            )  # fmt: skip
        ends.flags.writeable = False
        object.__setattr__(self, "ends", ends)

    def frame(self, i: int) -> LineFrame:
        """Frame number `i`; a negative number counts from the end."""
        i = range(len(self))[i]
        return LineFrame(self.sensor, float(self.times[i]), self.names, self.landmarks, self.ends[i])


class ClickVideo(LineVideo):
    """Points of the body that a person clicked in images of one camera, each as two lines that cross in it."""

    def frame(self, i: int) -> ClickFrame:
        """Frame number `i`; a negative number counts from the end."""
        i = range(len(self))[i]
        return ClickFrame(self.sensor, float(self.times[i]), self.names, self.landmarks, self.ends[i])


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
    """

    sensor: str
    markers: Markers
    marker_set: str
    time_offset: float = 0.0
    std: NDArray | None = None

    def at(self, time: float) -> MarkerFrame | None:
        """The frame nearest to a time [s]; None if there is none within half a frame."""
        first = self.markers.first_time + self.time_offset
        k = round((time - first) * self.markers.rate)
        if not 0 <= k < len(self.markers):
            return None
        own = k / self.markers.rate + first
        return MarkerFrame(self.sensor, own, self.markers.names, self.markers.positions[k], self.marker_set)
