"""`[[silhouette]]` and `[[region]]`: masks in files, by a background, by colour or by detector; colour images."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from kinefit._pictures import read_picture
from kinefit.errors import FileError, ObservationError, TakeError
from kinefit.geometry.camera import ImageFrame
from kinefit.images.silhouette import BackgroundPlate, colour_mask
from kinefit.observations import ColourVideo, Detections, SilhouetteVideo
from kinefit.observations.clocks import frame_times
from kinefit.readers.depth.images import listed
from kinefit.readers.detections import detections_file, read_detections
from kinefit.readers.take.cameras import TakeCameras, stated_frame, stated_rate
from kinefit.readers.take.entries import Pixels, Rate
from kinefit.readers.take.kinds import SensorKind, TakeEntry, refuse
from kinefit.readers.video import Video

_SIDE = 1000  # [px] of an image that its background is taken from: larger ones are made smaller by a whole number
_LEARNT = 30  # images of a video from which its background is learnt
_PICTURES = (".png", ".bmp", ".tif", ".tiff", ".jpg", ".jpeg")
_Level = Annotated[int, Meta(ge=0, le=255, description="Give [r, g, b], 0 to 255 each.")]


class SilhouetteEntry(TakeEntry, frozen=True, kw_only=True):
    """`[[silhouette]]`: which pixels of one camera show the person."""

    camera: str
    file: Path | None = None  # of "masks": folder or pattern; of "background": image of the empty scene
    format: Literal["masks", "background", "threshold", "detect"] = "masks"
    frame: Literal["calibration", "video"] | None = None  # image frame of the masks; needed where the two differ
    rate: Rate | None = None  # [Hz] of the masks; default: the camera's video, or the take
    sigma: Pixels = 4.0  # [px] standard deviation of an outline, in the calibration's image
    low: tuple[_Level, _Level, _Level] | None = None  # of "threshold": least value of each channel that is the body's
    high: tuple[_Level, _Level, _Level] | None = None  # and the largest
    channels: Literal["rgb", "hsv", "lab", "ycrcb"] | None = None  # of low and high, 8 bits each; default: rgb
    smooth: Pixels | None = None  # [px] of the Gaussian before the Laplace operator; default: 1

    def __post_init__(self) -> None:
        self._uses(self.format, {
            "file": ("masks", "background", "detect"), "frame": ("masks",), "rate": ("masks",),
            **dict.fromkeys(("low", "high", "channels", "smooth"), ("threshold",)),
        })  # fmt: skip
        none = self.file is None and self.format == "masks"
        refuse(none, "no file of masks", 'Write file = "..." (a folder), or another format.')
        if self.format == "threshold":
            remedy = "Write low = [r, g, b] and high = [r, g, b], 0 to 255 each."
            refuse(self.low is None or self.high is None, "no colour of the body", remedy)
            odd = any(a > b for a, b in zip(self.low or (), self.high or ()))
            refuse(odd, f"low = {self.low}, high = {self.high}", "Give 0 to 255, the lower ones first.")


class RegionEntry(TakeEntry, frozen=True, kw_only=True):
    """`[[region]]`: a camera in whose video the body is followed by the colours inside and outside of its contour."""

    camera: str
    sigma: Pixels | None = None  # [px] standard deviation of the contour, shape included; default: as the body is made


def read_silhouettes(
    path: Path, *, camera: str, rate: float, size: tuple[int, int], image_frame: ImageFrame | None = None,
    time_offset: float = 0.0, clock: NDArray | None = None,
) -> SilhouetteVideo:  # fmt: skip
    """Masks in a folder of images, or of a pattern such as "masks/*.png", one a frame; white is the body.

    Parameters
    ----------
    camera : str
    rate : float [Hz]
    size : (width, height) [px] of the calibration's image.
    image_frame : ImageFrame, optional
        From the calibration's image to the masks'; default: they are the same.
    time_offset : float [s] of the first mask.
    clock : (N,) [s], optional, when the frames of the camera's video are shown: masks of as many frames take its times.

    Raises
    ------
    FileError
        No images, or one that cannot be read.
    ObservationError
        A mask of another size.
    """
    files = [file for file in listed(path) if file.suffix.lower() in _PICTURES]
    if not files:
        raise FileError("no images of masks", file=path, remedy="Give a folder or pattern of PNG files, one a frame.")
    wanted = _picture_size(files[0], size, image_frame)

    def image(i: int) -> NDArray:
        mask = _mask(files[i])
        if mask.shape[::-1] != wanted:
            problem = f"the mask has {mask.shape[1]}x{mask.shape[0]} px, not {wanted[0]}x{wanted[1]}"
            raise ObservationError(problem, file=files[i], remedy="Give masks of the size of the camera's image.")
        return in_calibration(mask, size, image_frame)

    times = time_offset + frame_times(len(files), rate, clock)
    return SilhouetteVideo(camera, rate, times, size, image, str(path))


def _silhouettes(entry: SilhouetteEntry, cameras: TakeCameras) -> SilhouetteVideo:
    name, take = entry.camera, cameras.take
    size, offset, frame = cameras.size(name), cameras.offset(name), cameras.images[name]
    clock = cameras.clocks.get(name)
    if entry.format == "masks":
        assert entry.file is not None
        return read_silhouettes(
            entry.file, camera=name, rate=stated_rate(entry.rate or cameras.rates.get(f"video {name}") or take.rate),
            size=size, image_frame=stated_frame(frame, entry.frame, "masks"), time_offset=offset,
            clock=None if entry.rate else clock,
        )  # fmt: skip
    if entry.format == "detect":
        file = entry.file or detections_file(take.path, name)
        found = read_detections(file)
        if found.seen.any() and not len(found.mask_runs):
            remedy = "Run `kinefit detect` on this take: it stores silhouettes."
            raise TakeError("the detector's file has no silhouettes", file=file, remedy=remedy)
        times = offset + frame_times(len(found), found.rate, clock if found.times is None else found.times)
        image = lambda i: in_calibration(_everybody(found, i), size, frame)
        return SilhouetteVideo(name, found.rate, times, size, image, found.source)
    video = cameras.video(name)
    if entry.format == "threshold":
        image = _coloured(entry, video, size, frame)
    else:
        image = _BeforeBackground(video, entry.file, size, frame).mask
    return SilhouetteVideo(name, video.rate, offset + video.times, size, image, str(video.path))


_SPACES = {"hsv": cv2.COLOR_RGB2HSV, "lab": cv2.COLOR_RGB2Lab, "ycrcb": cv2.COLOR_RGB2YCrCb}


def _coloured(
    entry: SilhouetteEntry, video: Video, size: tuple[int, int], frame: ImageFrame
) -> Callable[[int], NDArray]:
    """What has the body's colour in a camera's video (P1 2.4).

    The mask is smoothed before the Laplace operator; where that changes its sign the mask has half its height, which is
    where an outline is looked for.
    """
    assert entry.low is not None and entry.high is not None
    low, high = entry.low, entry.high
    smooth, space = 1.0 if entry.smooth is None else entry.smooth, _SPACES.get(entry.channels or "rgb")

    def image(i: int) -> NDArray:
        picture = video.read(i)
        mask = colour_mask(picture if space is None else cv2.cvtColor(picture, space), low, high)
        return in_calibration(np.asarray(cv2.GaussianBlur(mask, (0, 0), smooth)), size, frame)

    return image


class _BeforeBackground:
    """Masks of a video before its background, which is learnt when it is first asked for."""

    def __init__(self, video: Video, plate: Path | None, size: tuple[int, int], frame: ImageFrame) -> None:
        self.video, self._file, self._size, self._frame = video, plate, size, frame
        if plate is not None:
            assert self.plate  # raises now if it does not fit

    @cached_property
    def plate(self) -> BackgroundPlate:
        if self._file is not None:
            picture = read_picture(self._file)
            if picture.shape[1::-1] != self.video.size:
                problem = f"the background has {picture.shape[1::-1]} px, the video {self.video.size}"
                raise ObservationError(problem, file=self._file, remedy="Take it with the same camera and settings.")
            return BackgroundPlate(self._smaller(picture))
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


def _everybody(found: Detections, i: int) -> NDArray:
    """All people of one image: which of them is the body is decided by where it is thought to be."""
    out = np.zeros(found.size[::-1], bool)
    for person in range(found.points.shape[1]):
        mask = found.mask(i, person)
        if mask is not None:
            out |= mask
    return 255 * out.astype(np.uint8)


def _picture_size(file: Path, size: tuple[int, int], frame: ImageFrame | None) -> tuple[int, int]:
    """Size of the masks: of the calibration's image, or of another one that a frame leads to."""
    return size if frame is None else _mask(file).shape[::-1]


def _mask(file: Path) -> NDArray:
    mask = read_picture(file, cv2.IMREAD_UNCHANGED)
    if mask.ndim == 3:
        mask = mask[..., 3] if mask.shape[2] == 4 else mask[..., :3].max(axis=2)
    if mask.dtype != np.uint8:
        mask = np.where(mask > 0, 255, 0).astype(np.uint8)
    return 255 * mask if mask.max(initial=0) == 1 else mask


def in_calibration(mask: NDArray, size: tuple[int, int], frame: ImageFrame | None) -> NDArray:
    """A mask (H, W) uint8 of the delivered image in the calibration's image of `size` (width, height)."""
    if frame is None or np.allclose(frame.T_image_calibration, np.eye(3), atol=1e-9):
        return mask
    T = frame.T_image_calibration[:2]
    return np.asarray(cv2.warpAffine(mask, T, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP))


def _load_silhouettes(entry: SilhouetteEntry, _: str, cameras: TakeCameras) -> SilhouetteVideo:
    """A `[[silhouette]]` of a take, which becomes one of its streams."""
    found = _silhouettes(entry, cameras)
    cameras.rates[f"silhouettes {found.sensor}"] = found.rate
    cameras.streams[f"silhouettes {found.sensor}"] = found.times
    return found


def _load_region(entry: RegionEntry, _: str, cameras: TakeCameras) -> ColourVideo:
    """The video of a `[[region]]` of a take, in the calibration's image frame."""
    video, size, frame = cameras.video(entry.camera), cameras.size(entry.camera), cameras.images[entry.camera]
    image = lambda i: in_calibration(video.read(i), size, frame)
    times = cameras.offset(entry.camera) + video.times
    return ColourVideo(entry.camera, video.rate, times, size, image, str(video.path))


SILHOUETTES = SensorKind(
    table="silhouette", summary="which pixels of a camera show the person", entry=SilhouetteEntry,
    read=_load_silhouettes, sigma=lambda entry: {f"silhouette {entry.camera}": entry.sigma}, replaces_keypoints=True,
    shows_everybody=True,
)  # fmt: skip

REGIONS = SensorKind(
    table="region", summary="a video in which the body is tracked by its colours", entry=RegionEntry,
    read=_load_region, sigma=lambda entry: {f"region {entry.camera}": entry.sigma} if entry.sigma else {},
    replaces_keypoints=True, shows_everybody=True,
)  # fmt: skip
