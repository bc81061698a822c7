"""Results that are open: a motion with the images of its cameras and a 3D viewer; two results side by side."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kinefit.errors import ObservationError
from kinefit.exporters.pictures.overlay import draw_overlay
from kinefit.exporters.report.angles import RangeChange, all_ranges, range_changes, with_error
from kinefit.exporters.tables import curves, spoken
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.studio.app.people import ShownVideos
from kinefit.studio.app.served import ScenePage
from kinefit.studio.viewers.viewed import content_of, gather, has_same_cameras
from kinefit.takes.missing import last_found


class OpenResult:
    """What is open of motions, whose files may be written anew.

    Parameters
    ----------
    files : of the motions
    hide_faces : whether faces are hidden in its images; None if it has none
    """

    scene: ScenePage

    def __init__(self, *files: Path, hide_faces: bool | None = None) -> None:
        self._files, self._hide_faces = files, hide_faces
        self._written = self._changed()

    def is_current(self, hide_faces: bool) -> bool:
        """Whether no motion was written since, and faces are shown as they were."""
        return self._changed() == self._written and self._hide_faces in (None, hide_faces)

    def close(self) -> None:
        """Close the 3D scene."""
        self.scene.close()

    def _changed(self) -> list[int]:
        return [file.stat().st_mtime_ns if file.exists() else 0 for file in self._files]


class Review(OpenResult):
    """A motion with everything to look at it.

    Parameters
    ----------
    take : Path of the take file
    folder : Path of the person's results
    hide_faces : whether faces are hidden in all images

    Attributes
    ----------
    motion : Motion
    ranges : of all angles that were observed, as rows of the report's table
    has_cameras : whether the calibration is still the motion's; if not, images are shown without the fit
    scene : ScenePage, whose player has the clock of the page

    Raises
    ------
    KinefitError
        The take or its results cannot be read.
    """

    def __init__(self, take: Path, folder: Path, *, hide_faces: bool) -> None:
        self.folder, file = folder, folder / "motion.npz"
        super().__init__(file, hide_faces=hide_faces)
        self.motion = read_motion(file)
        self.take = last_found(replace(read_take(take), hide_faces=hide_faces))
        self.seen = load_observations(self.take)
        self.has_cameras = has_same_cameras(self.motion, self.take)
        self.ranges = [one.row for one in all_ranges(self.motion)]
        self._videos = ShownVideos(self.take, self.seen)
        self._reading = threading.Lock()
        self.scene = ScenePage(content_of([self.motion], self.take, self.seen, find=False), with_panel=False)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras with a video."""
        return tuple(self.seen.videos)

    def size(self, camera: str) -> tuple[int, int]:
        """(width, height) [px] of a camera's video."""
        return self._videos(camera).size

    def image(self, camera: str, frame: int) -> NDArray[np.uint8]:
        """A camera's image (H, W, 3) at a frame of the motion, with the fit drawn on it if `has_cameras`.

        Raises
        ------
        KinefitError
            No such camera or frame, or its video cannot be read.
        """
        if camera not in self.seen.videos or self.seen.rig is None or not 0 <= frame < len(self.motion):
            raise ObservationError(f"no image of camera {camera} at frame {frame}", remedy="Open the result again.")
        offset = next(entry.time_offset for entry in self.take.cameras if entry.name == camera)
        with self._reading:
            video = self._videos(camera)
            at = video.frame_at(float(self.motion.times[frame]) - offset)
            image = video.read(at) if at is not None else np.full((*video.size[::-1], 3), 60, np.uint8)
        if not self.has_cameras:
            return image
        residuals = self.motion.residuals.get(camera)
        return draw_overlay(
            image, self.motion, frame, self.seen.rig[camera], image_frame=self.seen.images[camera],
            residuals=residuals,
        )  # fmt: skip

    def close(self) -> None:
        """Close the 3D scene and all videos."""
        super().close()
        self._videos.close()


class RangeRow(NamedTuple):
    """How the range of motion of one angle changed, in words: "" where it is not observed."""

    angle: str
    before: str
    after: str
    change: str
    is_clear: bool


class Comparison(OpenResult):
    """Two motions, of which the first is that before.

    Parameters
    ----------
    before, after : folders of results

    Attributes
    ----------
    ranges : tuple of RangeRow
    angles : {name: (before, after), two Curve} that both motions have
    times : of both, (F,) [s] from the first frame on
    scene : ScenePage with both

    Raises
    ------
    KinefitError
        A motion cannot be read.
    """

    def __init__(self, before: Path, after: Path) -> None:
        super().__init__(before / "motion.npz", after / "motion.npz")
        content = gather(self._files)
        first, second = content.motions
        self.ranges = tuple(_row(*key, of) for key, of in range_changes(first, second).items())
        known = {curve.name: curve for curve in curves(first) if curve.unit == "deg"}
        self.angles = {curve.name: (known[curve.name], curve) for curve in curves(second) if curve.name in known}
        self.times = first.times - first.times[0], second.times - second.times[0]
        self.scene = ScenePage(content)

    def points(self, angle: str, number: int, most: int) -> list[list[float]]:
        """[s, deg] of an angle of the motion 0 or 1, at most `most` points of it."""
        curve, times = self.angles[angle][number], self.times[number]
        step = max(1, -(-len(times) // most))
        return np.column_stack([times, curve.values])[::step].round(3).tolist()


def _row(stem: str, side: str, of: RangeChange) -> RangeRow:
    first, second = (with_error(*one.span) if one else "" for one in (of.before, of.after))
    change = with_error(*of.change) if of.change else ""
    return RangeRow(f"{spoken(stem)}, {side}" if side else spoken(stem), first, second, change, of.is_clear)
