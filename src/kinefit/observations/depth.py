"""Depth recordings of one sensor, whose frames are read on demand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.observations.frames import DepthFrame, PointCloud

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
class _Recording:
    """Base of recordings of one sensor with a time for each frame."""

    sensor: str
    rate: float
    times: NDArray

    def __len__(self) -> int:
        return len(self.times)

    @property
    def gaps(self) -> NDArray:
        """(G,) int: frames after a gap of more than 1.5 steps: frames are missing, or the clock jumped."""
        return np.flatnonzero(np.diff(self.times) > _MIN_GAP_STEPS / self.rate) + 1

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
class _ImageRecording(_Recording):
    """Base of recordings of one camera's images."""

    size: tuple[int, int]
    image: Callable[[int], NDArray]
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", checked_times(self.times, self.sensor, self.source))

    def _image(self, i: int) -> tuple[float, NDArray]:
        """Time [s] and image of a frame, read now; a negative number counts from the end."""
        i = range(len(self))[i]
        image = np.asarray(self.image(i))
        if image.shape[1::-1] != self.size:
            raise ObservationError(
                f"the image has {image.shape[1::-1]} px, its camera {self.size}", file=self.source or None,
                place=f"frame {i} of {self.sensor}", remedy="All images of a camera must have its size.",
            )  # fmt: skip
        return float(self.times[i]), image


@dataclass(frozen=True, eq=False)
class DepthVideo(_Recording):
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", checked_times(self.times, self.sensor, self.source))
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
        i = range(len(self))[i]
        depth = np.array(self.image(i), np.float32)
        if depth.shape != self.size[::-1]:
            raise ObservationError(
                f"the image has shape {depth.shape}, not {self.size[::-1]}", file=self.source or None,
                place=f"frame {i} of {self.sensor}", remedy="All frames of a sensor must have one size.",
            )  # fmt: skip
        depth[~((depth >= self.near) & (depth <= self.far))] = 0.0
        return DepthFrame(self.sensor, float(self.times[i]), depth)

    def without(self, frames: NDArray) -> DepthVideo:
        """The recording without some frames (N,) int; some must remain."""
        remaining = np.setdiff1d(np.arange(len(self)), frames)
        return replace(self, times=self.times[remaining], image=lambda i: self.image(int(remaining[i])))


@dataclass(frozen=True, eq=False)
class CloudVideo(_Recording):
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

    def __post_init__(self) -> None:
        object.__setattr__(self, "times", checked_times(self.times, self.sensor, self.source))
        T = np.eye(4) if self.T_world_sensor is None else np.array(self.T_world_sensor, float)
        T.flags.writeable = False
        object.__setattr__(self, "T_world_sensor", T)

    def frame(self, i: int) -> PointCloud:
        """Frame number `i`, read now; a negative number counts from the end."""
        i, T = range(len(self))[i], self.T_world_sensor
        assert T is not None
        x = np.asarray(self.points(i), float).reshape(-1, 3)
        x = x[np.isfinite(x).all(axis=1)]
        distance = np.linalg.norm(x, axis=1)
        x = x[(distance > 0.0) & (distance >= self.near) & (distance <= self.far)]
        viewpoint = T[:3, 3] if self.viewpoint else None
        x = x @ T[:3, :3].T + T[:3, 3]
        return PointCloud(self.sensor, float(self.times[i]), x, viewpoint, self.on_body, self.segment)
