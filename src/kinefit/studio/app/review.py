"""Results that are open: a motion with the images of its cameras and a 3D viewer; two results side by side.

What has an address of its own: 3D scenes, and reports and check pages, whose scripts may be of strangers.
"""

from __future__ import annotations

import os
import secrets
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
from kinefit.readers import load_observations, read_motion, read_take
from kinefit.studio.app.people import ShownVideos
from kinefit.studio.serving.access import APP_PAGES, Access
from kinefit.studio.serving.server import Page, PageServer
from kinefit.studio.viewers.player import Player
from kinefit.studio.viewers.show import ViewerContent
from kinefit.studio.viewers.stage import open_server, quiet
from kinefit.studio.viewers.viewed import content_of, gather, has_same_cameras
from kinefit.takes.missing import last_found

_KEY_BYTES = 18
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "base-uri 'none'; form-action 'none'; sandbox allow-scripts allow-downloads"
)
"""A page with its own scripts and images and without connections, of an origin that no other page has."""


class FilePages(PageServer):
    """A server of pages that lie among recordings.

    Parameters
    ----------
    root : folder whose pages, and those in all folders below it, are served

    Attributes
    ----------
    folders : set of Path, `root` and others whose pages are served
    """

    def __init__(self, root: Path) -> None:
        self.folders = {root}
        self._keys: dict[Path, str] = {}
        super().__init__(Access())

    def address(self, file: Path) -> str | None:
        """Address of a page; None where the file, after all links, is no page, or lies outside of all folders."""
        found = Path(os.path.realpath(file))  # `Path.resolve` raises where links go in a circle
        within = any(found.is_relative_to(os.path.realpath(folder)) for folder in self.folders)
        if not within or found.suffix.lower() != ".html" or not found.is_file():
            return None
        return f"{self.url}{self._keys.setdefault(found, secrets.token_urlsafe(_KEY_BYTES))}"

    def page(self, path: str) -> Page | None:
        """The file of an address."""
        file = next((file for file, key in self._keys.items() if path == f"/{key}"), None)
        if file is None or not (self.address(file) or "").endswith(path):  # a link by now
            return None
        return Page(file.read_bytes(), policy=_POLICY, framed_by=APP_PAGES)


_END_TIMEOUT_S = 5.0  # of the frame that is shown


class ScenePage:
    """A player of motions that runs until it is closed.

    Parameters
    ----------
    content : ViewerContent
    with_panel : whether the player's controls are open at first

    Attributes
    ----------
    address : of its page, with the token
    player : Player

    Raises
    ------
    ExportError
        No port is free.
    """

    def __init__(self, content: ViewerContent, *, with_panel: bool = True) -> None:
        access = Access()
        self._server = open_server(0, access, label=content.name)
        self.address = access.url(self._server.get_port())
        self.player = Player(self._server, content)
        if not with_panel:
            self._server.gui.main_panel.minimize()
        self._ended = threading.Event()
        self._running = threading.Thread(target=self.player.run, args=(self._ended.is_set,), daemon=True)
        self._running.start()

    def close(self) -> None:
        """End the player and its server."""
        self._ended.set()
        self._running.join(_END_TIMEOUT_S)
        with quiet():
            self._server.stop()


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
