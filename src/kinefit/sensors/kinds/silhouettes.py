"""`[[silhouette]]` and `[[region]]`: masks in files, by a background, by colour or by detector; colour images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from kinefit._pictures import read_picture
from kinefit.errors import FileError, ObservationError, TakeError, located
from kinefit.geometry.camera import ImageFrame
from kinefit.images.silhouette import BackgroundPlate, colour_mask
from kinefit.observations import ColourVideo, Detections, SilhouetteVideo
from kinefit.observations.clocks import NamedFrames, frame_times, frames_by_name, is_even, nominal_rate
from kinefit.readers.depth.images import listed
from kinefit.readers.landmarks.detections import detections_file, read_detections
from kinefit.readers.take.cameras import TakeCameras, stated_frame, stated_rate
from kinefit.readers.take.entries import Pixels, Rate
from kinefit.readers.take.kinds import SensorKind, TakeEntry, refuse
from kinefit.readers.videos.video import Video

_SIDE = 1000  # [px] of an image that its background is taken from: larger ones are made smaller by a whole number
_LEARNT = 30  # images of a video from which its background is learnt
_SAMPLED_MASKS = 7  # of a recording, by which it is decided what is the body in them
_WHITE = 127
_MAX_BODY_SHARE = 0.5  # of an image that a body covers, with
_MAX_BODY_BORDER = 0.9  # of the image's border
_MIN_FLAT_SHARE = 0.02  # of the pixels that are not 0, in values that are labels: the values of soft edges have fewer
_MAX_COLOUR_ERROR = 24  # of 255, of a compressed colour
_MAX_STRAY_SHARE = 0.005  # of the pixels: soft edges and compression
_MAX_GREY_SHARE = 0.25  # of the pixels, in masks with wide soft edges
_MIN_COLOUR_SHARE = 0.002  # of the pixels, in a flat colour
_COLOUR_BIN = 32
_NAME_MASKS = "Name the folder or pattern of the masks: white is the body."
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
    image_size: tuple[int, int] | None = None, time_offset: float = 0.0, clock: NDArray | None = None,
) -> SilhouetteVideo:  # fmt: skip
    """Masks in a folder of images, or of a pattern such as "masks/*.png", one a frame; white is the body.

    In images of other values or colours the body is all that differs from the background: labels, palettes, an alpha
    channel that is not constant. Masks of another size and the same shape are scaled.

    Parameters
    ----------
    camera : str
    rate : float [Hz] at which the numbers in the files' names count.
    size : (width, height) [px] of the calibration's image.
    image_frame : ImageFrame, optional
        From the calibration's image to the masks'; default: they are the same.
    image_size : (width, height) [px] of the masks' image; default: `size`.
    time_offset : float [s] of the first mask.
    clock : (N,) [s], optional, when the frames of the camera's video are shown: masks of as many frames take its times,
        fewer masks those of the frames that their numbers name.

    Raises
    ------
    FileError
        No images, or one that cannot be read.
    ObservationError
        A mask of another shape; photographs, or labels of the whole image; an inverted mask; two files of one number.
    """
    files = [file for file in listed(path) if file.suffix.lower() in _PICTURES]
    if not files:
        raise FileError("no images of masks", file=path, remedy="Give a folder or pattern of PNG files, one a frame.")
    with located(path):
        numbered = frames_by_name([file.name for file in files], "masks")
        times, said = _mask_times(numbered, rate, clock)
        code = MaskCode.of(_sampled(files))
    wanted = image_size or (size if image_frame is None else code.size)
    _check_shape(code.size, wanted, files[0])
    scaled = f"masks have {code.size[0]}x{code.size[1]} px: scaled to {wanted[0]}x{wanted[1]}" * (code.size != wanted)
    notes = tuple(text for text in (said, code.note, scaled) if text)

    def image(i: int) -> NDArray:
        mask = code.mask(read_picture(files[i], cv2.IMREAD_UNCHANGED))
        _check_shape(mask.shape[::-1], wanted, files[i])
        mask = mask if mask.shape[::-1] == wanted else cv2.resize(mask, wanted, interpolation=cv2.INTER_LINEAR)
        return in_calibration(mask, size, image_frame)

    own_rate = rate if is_even(times, rate) or len(times) < 2 else nominal_rate(times)
    return SilhouetteVideo(camera, own_rate, time_offset + times, size, image, str(path), notes)


def _sampled(files: Sequence[Path]) -> list[NDArray]:
    """The masks, as stored, by which it is decided how all are to be read; the first has to be readable."""
    out = [read_picture(files[0], cv2.IMREAD_UNCHANGED)]
    for i in sorted({round(k) for k in np.linspace(0, len(files) - 1, _SAMPLED_MASKS)} - {0}):
        with suppress(FileError):  # raised where the mask is asked for
            out.append(read_picture(files[i], cv2.IMREAD_UNCHANGED))
    return out


def _mask_times(numbered: NamedFrames, rate: float, clock: NDArray | None) -> tuple[NDArray, str]:
    """Times (N,) [s] of masks from the video's first frame on, and what is worth saying of them."""
    times, said = numbered.on_clock(rate, "masks")
    if clock is None or numbered.times is not None or numbered.numbers[-1] > len(clock):
        return times, said
    if len(clock) == len(times):
        return clock, ""
    first = 1 if numbered.numbers[0] == 1 or numbered.numbers[-1] == len(clock) else 0
    return clock[numbered.numbers - first], f"{len(times)} masks of the video's {len(clock)} frames, by their numbers"


def _check_shape(size: tuple[int, int], wanted: tuple[int, int], file: Path) -> None:
    """Raise ObservationError where the size (width, height) [px] of a mask has not the shape that is wanted."""
    if abs(size[0] * wanted[1] - size[1] * wanted[0]) > max(*size, *wanted):  # a pixel by rounding
        problem = f"the mask has {size[0]}x{size[1]} px, not {wanted[0]}x{wanted[1]}"
        raise ObservationError(problem, file=file, remedy="Give masks of the size of the camera's image.")


@dataclass(frozen=True, eq=False)
class MaskCode:
    """Which values of mask images are the body, estimated from some of the recording's images.

    Parameters
    ----------
    size : (width, height) [px] of the images
    by_alpha : whether the alpha channel is the mask
    background : colour or value of the background, of images in which all else is the body; None: white is the body
    tolerance : difference of a channel from the background, above which it is the body
    note : what is worth saying
    """

    size: tuple[int, int]
    by_alpha: bool = False
    background: NDArray | None = None
    tolerance: int = 0
    note: str = ""

    @classmethod
    def of(cls, images: Sequence[NDArray]) -> MaskCode:
        """The code of some images of a recording, each (H, W) or (H, W, channels) as stored.

        Raises
        ------
        ObservationError
            Photographs; labels of the whole image; masks in which the body is black.
        """
        by_alpha = any(image.ndim == 3 and image.shape[2] == 4 and np.ptp(image[..., 3]) > 0 for image in images)
        code = cls(images[0].shape[1::-1], by_alpha)
        values = [code._values(image) for image in images]
        pixels = np.concatenate([image.reshape(len(image) * image.shape[1], -1).max(axis=1) for image in values])
        if any(np.mean(np.ptp(image.astype(int), axis=2) > _MAX_COLOUR_ERROR) > _MAX_STRAY_SHARE for image in values):
            code = replace(code, **_colour_code(values))
        elif pixels.dtype != np.uint8 or pixels.max(initial=0) <= 1:
            code = replace(code, background=np.zeros(1, int))
        else:
            code = replace(code, **_grey_code(pixels))
        masks = [mask for mask in (code.mask(image) > _WHITE for image in images) if mask.any()]
        share = float(np.median([mask.mean() for mask in masks] or [0.0]))
        if share > _MAX_BODY_SHARE and np.median([_border(mask).mean() for mask in masks]) > _MAX_BODY_BORDER:
            what = "white" if code.background is None else "all but the background's value"
            problem = f"{what} covers {100 * share:.0f} % of the masks and their border: inverted, or labels of all"
            remedy = "Make the body white and all else black. A body that fills the image looks the same."
            raise ObservationError(problem, remedy=remedy)
        return code

    def mask(self, image: NDArray) -> NDArray:
        """(H, W) uint8, 255 for the body, of an image as stored."""
        values = self._values(image)
        if self.background is None:
            return values.max(axis=2)
        apart = np.abs(values.astype(float) - self.background).max(axis=2) > self.tolerance
        return np.where(apart, 255, 0).astype(np.uint8)

    def _values(self, image: NDArray) -> NDArray:
        """(H, W, 1 or 3) of an image: grey, colours, or its alpha channel where that is the mask."""
        if image.ndim == 2:
            return image[..., None]
        return image[..., 3:] if self.by_alpha and image.shape[2] == 4 else image[..., :3]


def _border(image: NDArray) -> NDArray:
    """The pixels of an image's four edges, (N) or (N, channels)."""
    return np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])


def _grey_code(values: NDArray) -> dict[str, Any]:
    """How grey values (N,) uint8 of masks are to be read, as fields of `MaskCode`; refuses photographs."""
    found, counts = np.unique(values[values > 0], return_counts=True)
    flat = found[counts > _MIN_FLAT_SHARE * counts.sum()]
    on_flat = float(np.isin(values, [0, *flat]).mean())
    if flat.size and flat[0] < 255 - _MAX_COLOUR_ERROR and on_flat > 1.0 - _MAX_STRAY_SHARE:
        listed = ", ".join(str(value) for value in flat[:8])
        note = f"images of the values 0 and {listed}: all but 0 is taken as the body"
        return {"background": np.zeros(1, int), "note": note}
    levels = float(np.mean((values > _MAX_COLOUR_ERROR) & (values < 255 - _MAX_COLOUR_ERROR)))
    if levels > _MAX_GREY_SHARE:
        raise ObservationError(f"images of many grey values, in {100 * levels:.0f} % of the pixels", remedy=_NAME_MASKS)
    return {}


def _colour_code(images: Sequence[NDArray]) -> dict[str, Any]:
    """How images (H, W, 3) of flat colours are to be read, as fields of `MaskCode`; refuses photographs."""
    pixels = np.concatenate([image.reshape(-1, 3) for image in images])
    counts = np.unique(pixels // _COLOUR_BIN, axis=0, return_counts=True)[1]
    if counts[counts > _MIN_COLOUR_SHARE * len(pixels)].sum() < (1.0 - _MAX_GREY_SHARE) * len(pixels):
        raise ObservationError("images of many colours: photographs, or drawn over them", remedy=_NAME_MASKS)
    colours, counts = np.unique(np.concatenate([_border(image) for image in images]), axis=0, return_counts=True)
    background = colours[np.argmax(counts)].astype(int)
    note = f"coloured images: all but the colour of their border, {background[::-1].tolist()}, is taken as the body"
    return {"background": background, "tolerance": _MAX_COLOUR_ERROR, "note": note}


def _silhouettes(entry: SilhouetteEntry, cameras: TakeCameras) -> SilhouetteVideo:
    name, take = entry.camera, cameras.take
    size, offset, frame = cameras.size(name), cameras.offset(name), cameras.images[name]
    clock = cameras.clocks.get(name)
    if entry.format == "masks":
        assert entry.file is not None
        return read_silhouettes(
            entry.file, camera=name, rate=stated_rate(entry.rate or cameras.rates.get(f"video {name}") or take.rate),
            size=size, image_frame=(stated := stated_frame(frame, entry.frame, "masks")), time_offset=offset,
            image_size=None if stated is None else cameras.image_size(name), clock=None if entry.rate else clock,
        )  # fmt: skip
    if entry.format == "detect":
        file = entry.file or detections_file(take.path, name)
        found = read_detections(file)
        if found.seen.any() and not len(found.mask_runs):
            remedy = "Run `kinefit detect` on this take: the built-in detector stores silhouettes."
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
