"""Silhouettes of a take: those in files, and those that a video shows before its background; the person's shape."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.bodies import Body, BodyState
from kinefit.errors import FileError, KinefitError, ObservationError
from kinefit.geometry.camera import ImageFrame
from kinefit.images.silhouette_background import BackgroundPlate
from kinefit.observations import Frame, SilhouetteFrame, SilhouetteVideo
from kinefit.readers.take.file import Take
from kinefit.readers.take.load import Observations
from kinefit.readers.take.silhouettes import in_calibration
from kinefit.readers.video import Video
from kinefit.subject.keypoints import Progress
from kinefit.subject.silhouettes import CylinderFamily, ShapeFit, fit_silhouettes
from kinefit.tracking.fusion import FusionTracker

_SIDE = 1000  # [px] of a picture that its background is taken from: larger ones are made smaller by a whole number
_LEARNT = 30  # pictures of a video from which its background is learnt
_TRIED = 100  # steps that are tracked to find the person's shape ...
_POSES = 8  # ... and how many of them it is found from: twice as many change no half axis by more than its deviation


def silhouettes_of(take: Take, seen: Observations) -> tuple[SilhouetteVideo, ...]:
    """Silhouettes of all cameras of a take, in its order.

    Raises
    ------
    KinefitError
        A picture of the background that cannot be read, or of another size than the video's.
    """
    told = {video.sensor: video for video in seen.silhouettes}
    for entry in take.silhouettes:
        if entry.format == "background":
            assert seen.rig is not None
            camera = next(c for c in take.cameras if c.name == entry.camera)
            size, frame = seen.rig[entry.camera].size, seen.images[entry.camera]
            try:
                scene = _Scene(seen.videos[entry.camera], entry.file, size, frame)
            except KinefitError as error:
                place = f"silhouette of camera {entry.camera}"
                raise type(error)(error.problem, file=error.file, place=place, remedy=error.remedy) from error
            times = camera.time_offset + np.arange(len(scene.video)) / scene.video.rate
            source = str(seen.videos[entry.camera])
            told[entry.camera] = SilhouetteVideo(entry.camera, scene.video.rate, times, size, scene.mask, source)
    return tuple(told[entry.camera] for entry in take.silhouettes)


class _Scene:
    """A video and its background, learnt when it is first asked for."""

    def __init__(self, video: Path, plate: Path | None, size: tuple[int, int], frame: ImageFrame) -> None:
        self.video, self._file, self._size, self._frame = Video(video), plate, size, frame
        if plate is not None:
            assert self.plate  # told now where it does not fit

    @cached_property
    def plate(self) -> BackgroundPlate:
        if self._file is not None:
            picture = cv2.imread(str(self._file), cv2.IMREAD_COLOR)
            if picture is None:
                raise FileError("not a picture, or damaged", file=self._file, remedy="Give a PNG or JPEG.")
            if picture.shape[1::-1] != self.video.size:
                problem = f"the background has {picture.shape[1::-1]} px, the video {self.video.size}"
                raise ObservationError(problem, file=self._file, remedy="Take it with the same camera and settings.")
            return BackgroundPlate(self._smaller(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)))
        chosen = np.unique(np.linspace(0, len(self.video) - 1, _LEARNT).astype(int))
        return BackgroundPlate.of(self._smaller(self.video.read(int(i))) for i in chosen)

    def _smaller(self, picture: NDArray) -> NDArray:
        by = -(-max(self.video.size) // _SIDE)
        size = self.video.size[0] // by, self.video.size[1] // by
        return picture if by == 1 else np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))

    def mask(self, i: int) -> NDArray:
        mask = self.plate.mask(self._smaller(self.video.read(i)))
        mask = cv2.resize(mask, self.video.size, interpolation=cv2.INTER_LINEAR)
        return in_calibration(mask, self._size, self._frame)


@dataclass(frozen=True, eq=False)
class Shaped:
    """A body of the person's shape, and where it was in the first step that it was found in."""

    body: Body
    start: tuple[int, BodyState]
    fit: ShapeFit


def shaped_by_silhouettes(
    tracker: FusionTracker, steps: Callable[[int], Sequence[Frame]], times: NDArray, *,
    start: tuple[int, BodyState] | None = None, progress: Progress | None = None,
) -> Shaped | None:  # fmt: skip
    """The person's shape: the first steps are tracked with the body as it is, then it is fitted to some of them.

    Parameters
    ----------
    tracker : FusionTracker, fresh; of no use afterwards.
    steps, times, start : as for `run_steps`

    Returns
    -------
    Shaped, or None where the body was not found, or is not of cylinders.
    """
    begin = 0
    if start is not None:
        begin, state = start
        tracker.start_at(state)
    found: dict[int, BodyState] = {}
    last = min(begin + _TRIED, len(times))
    for i in range(begin, last):
        result = tracker.update(steps(i), float(times[i]))
        if result is not None:
            found[i] = result.state
        if progress:
            progress("shape", i + 1 - begin, last - begin)
    told = {i: [f for f in steps(i) if isinstance(f, SilhouetteFrame)] for i in _spread(sorted(found), _POSES)}
    told = {i: several for i, several in told.items() if several}
    if not told:
        return None
    usual = tracker.settings.silhouette
    names = {f"silhouette {f.sensor}" for several in told.values() for f in several}
    sigma = float(np.mean([tracker.accuracy.get(name, usual) for name in names]))
    family = CylinderFamily(tracker.body)
    fit = fit_silhouettes(family, tracker.rig, list(told.values()), [found[i] for i in told], sigma=sigma)
    first = min(found)
    return Shaped(fit.body, (first, fit.states[0] if first == min(told) else found[first]), fit)


def _spread(steps: list[int], count: int) -> list[int]:
    return [steps[k] for k in dict.fromkeys(np.linspace(0, len(steps) - 1, count).astype(int))] if steps else []

