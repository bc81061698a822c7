"""One result that is open: its motion, the images of its cameras with the fit drawn on them, and its 3D viewer."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kinefit.app.images import ShownVideos
from kinefit.app.served import ScenePage
from kinefit.batch.viewed import content_of, has_same_cameras
from kinefit.errors import ObservationError
from kinefit.exporters.pictures.overlay import draw_overlay
from kinefit.readers.motion import read_motion
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.takes.missing import last_found


class Review:
    """A motion with everything to look at it.

    Parameters
    ----------
    take : Path of the take file
    folder : Path of the person's results
    hide_faces : whether faces are hidden in all images

    Attributes
    ----------
    motion : Motion
    has_cameras : whether the calibration is still the motion's; if not, images are shown without the fit
    scene : ScenePage, whose player has the clock of the page

    Raises
    ------
    KinefitError
        The take or its results cannot be read.
    """

    def __init__(self, take: Path, folder: Path, *, hide_faces: bool) -> None:
        self.folder, self._hide_faces = folder, hide_faces
        file = folder / "motion.npz"
        self._written = file.stat().st_mtime_ns if file.exists() else 0
        self.motion = read_motion(file)
        self.take = last_found(replace(read_take(take), hide_faces=hide_faces))
        self.seen = load_observations(self.take)
        self.has_cameras = has_same_cameras(self.motion, self.take)
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

    def is_current(self, hide_faces: bool) -> bool:
        """Whether the motion was not written since, and faces are shown as they were."""
        file = self.folder / "motion.npz"
        return file.exists() and file.stat().st_mtime_ns == self._written and hide_faces == self._hide_faces

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
        self.scene.close()
        self._videos.close()
