"""Overlays: the fitted skeleton on the images of cameras and depth cameras, as images and videos."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import count
from os import PathLike
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit._arguments import checked
from kinefit._files import write_image, writing
from kinefit._threads import ahead
from kinefit.bodies.motion import Motion, Residuals
from kinefit.bodies.rendering import render_body, scaled
from kinefit.bodies.rendering.looks import LOST_COLOUR
from kinefit.errors import ExportError
from kinefit.exporters.pictures import drawing
from kinefit.geometry.camera import Camera, ImageFrame
from kinefit.observations import DepthVideo
from kinefit.readers.videos.video import Video

_NOTE = (255, 200, 60)
_TICK = Fraction(1, 60000)  # [s] of times in a video: MPEG-4 has 16 bits for it
_CODECS = {"libx264": {"preset": "superfast", "crf": "21"}, "mpeg4": {"qscale": "3"}}


@checked
def write_overlay(
    motion: Motion,
    camera: Camera,
    video: Video,
    path: str | PathLike[str],
    *,
    image_frame: ImageFrame | None = None,
    residuals: Residuals | None = None,
    time_offset: float = 0.0,
    skin: bool = False,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Write a video (H.264 where the codec is there, else MPEG-4) of a motion's pictures with the fit drawn on them.

    Left is blue, right orange, the middle green, a lost segment thin, grey and dashed; of bodies with a skin or a mesh
    outlines are drawn. Measured keypoints are yellow rings, those left out as outliers red crosses; pink lines lead to
    the fitted keypoints.

    Parameters
    ----------
    motion : Motion
    camera : Camera
    video : Video
    path : path
    image_frame : ImageFrame, optional
        From the camera's calibration to the video's pictures; by default they are the same.
    residuals : Residuals, optional
        By default those that the motion holds under the camera's name.
    time_offset : float [s]
        Added to frame / rate to get the time of the take.
    skin : bool
        Whether the body's skin is drawn below its bones, translucent.
    progress : callable, optional
        Called with the number of pictures done.

    Raises
    ------
    ExportError
        The file cannot be written.
    """
    width, height = (side - side % 2 for side in video.size)  # the encoder wants even sides
    span = frames_of(motion, video.times + time_offset)

    def drawn() -> Iterator[NDArray[np.uint8]]:
        for i, image in zip(span, video.frames(span.start, span.stop)):
            frame = motion.frame_at(video.times[i] + time_offset)
            label = f"frame {i}"
            yield draw_overlay(
                image, motion, frame, camera, image_frame=image_frame, residuals=residuals, label=label, skin=skin
            )[:height, :width]

    write_pictures(drawn(), path, video.rate, (width, height), progress, times=video.times[span.start : span.stop])


def write_pictures(
    pictures: Iterator[NDArray[np.uint8]], path: str | PathLike[str], rate: float, size: tuple[int, int],
    progress: Callable[[int], None] | None = None, *, times: NDArray | Sequence[float] | None = None,
) -> None:  # fmt: skip
    """Write a video of pictures (H, W, 3) uint8 RGB at a rate [Hz], each drawn while the one before it is encoded.

    Parameters
    ----------
    size : (width, height) [px] of all, even
    progress : called with the number of pictures done
    times : (N,) [s], optional, when each is shown, each known as its picture comes; default: at the rate

    Raises
    ------
    ExportError
        The file cannot be written.
    """
    with writing(path) as temporary, _encoder(path, temporary, rate, size) as encode:
        for done, image in enumerate(ahead(pictures), start=1):
            encode(image, None if times is None else float(times[done - 1] - times[0]))
            if progress:
                progress(done)


def frames_of(motion: Motion, times: NDArray) -> range:
    """Pictures of a video, at increasing times [s], from the first to the last of a motion; all where it shows none."""
    margin = 0.5 / motion.rate
    inside = np.flatnonzero((times > motion.times[0] - margin) & (times < motion.times[-1] + margin))
    return range(inside[0], inside[-1] + 1) if len(inside) else range(len(times))


@checked
def draw_overlay(
    image: NDArray[np.uint8],
    motion: Motion,
    frame: int | None,
    camera: Camera,
    *,
    image_frame: ImageFrame | None = None,
    residuals: Residuals | None = None,
    label: str | None = None,
    skin: bool = False,
) -> NDArray[np.uint8]:
    """One picture with the fit drawn on it.

    Parameters
    ----------
    image : (H, W, 3) uint8 RGB; left as it is.
    motion, camera, image_frame, residuals, skin : see `write_overlay`.
    frame : frame of the motion, None for a picture outside of it.
    label : str, optional
        By default the number of the frame.

    Returns
    -------
    (H, W, 3) uint8 RGB
    """
    image_frame = image_frame or ImageFrame.identity()
    out = np.array(image, order="C")
    residuals = motion.residuals.get(camera.name) if residuals is None else residuals
    if residuals is not None and (residuals.unit != "px" or not residuals.of_points):
        residuals = None
    lines = [(f"{camera.name}   {label or f'frame {frame}'}", drawing.WHITE)]
    if frame is None:
        drawing.write_lines(out, [*lines, ("no motion here", _NOTE)])
        return out
    if skin:
        drawing.draw_skin(out, motion, frame, camera, image_frame)
    drawing.draw_body(out, motion, frame, camera, image_frame)
    if residuals is not None:
        drawing.draw_residuals(out, residuals, frame, image_frame)
        lines.append((_residual_text(residuals, frame), drawing.WHITE))
    drawing.write_lines(out, lines + [(note, _NOTE) for note in _notes(motion, residuals, frame)])
    return out


@checked
def write_montage(
    images: Mapping[str, NDArray[np.uint8]], path: str | PathLike[str], *, height: int = 960, gap: int = 8
) -> None:
    """Write pictures {name: (H, W, 3) uint8 RGB} side by side as one PNG (or .jpg), all `height` px tall.

    Raises
    ------
    ExportError
        No pictures, or the file cannot be written.
    """
    if not images:
        raise ExportError("there are no images to put side by side", file=path)
    row: list[NDArray] = []
    for image in images.values():
        size = (max(1, round(image.shape[1] * height / image.shape[0])), height)
        row += [np.full((height, gap, 3), 255, np.uint8), cv2.resize(image, size, interpolation=cv2.INTER_AREA)]
    write_image(path, np.concatenate(row[1:], axis=1)[..., ::-1])


def _residual_text(residuals: Residuals, frame: int) -> str:
    norms = residuals.norms[frame]
    seen = np.isfinite(norms)
    used = seen & ~residuals.rejected[frame]
    if not seen.any():
        return "no keypoints"
    text = f"residual: median {np.median(norms[seen]):.1f}, mean {np.mean(norms[seen]):.1f} px, {used.sum()} points"
    return text + (f", {int((seen & ~used).sum())} rejected" if (seen & ~used).any() else "")


def _notes(motion: Motion, residuals: Residuals | None, frame: int) -> list[str]:
    notes = []
    if residuals is not None and residuals.swapped[frame]:
        notes.append("left and right were swapped: corrected")
    if motion.quality[frame] <= 0:
        return [*notes, "not tracked"]
    lost = [name for name, gone in zip(motion.body.tree.segments, motion.lost[frame]) if gone]
    if lost:
        notes.append("lost: " + ", ".join(lost[:4]) + (f" and {len(lost) - 4} more" if len(lost) > 4 else ""))
    return notes


@contextmanager
def _encoder(
    path: str | PathLike[str], temporary: Path, rate: float, size: tuple[int, int]
) -> Iterator[Callable[[NDArray, float | None], None]]:
    """Give a function that encodes one picture (H, W, 3) after the other, each with its time [s] or None."""
    codec = next((name for name in _CODECS if name in av.codecs_available), None)
    if codec is None:
        raise ExportError(f"FFmpeg has none of the codecs {', '.join(_CODECS)}", file=path)
    exact, numbers = Fraction(rate).limit_denominator(10000), count()
    container = _with_system_errors(av.open, str(temporary), "w")
    stream = container.add_stream(codec, rate=exact, options=_CODECS[codec])
    (stream.width, stream.height), stream.pix_fmt, stream.codec_context.time_base = size, "yuv420p", _TICK

    def encode(image: NDArray, time: float | None) -> None:
        planes = cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420)  # four times as fast as FFmpeg's
        frame, number = av.VideoFrame.from_ndarray(planes, format="yuv420p"), next(numbers)
        frame.time_base, frame.pts = _TICK, round((number / exact if time is None else time) / _TICK)
        for packet in stream.encode(frame):
            _with_system_errors(container.mux, packet)

    try:
        yield encode
    except BaseException:
        with suppress(av.FFmpegError, OSError, ValueError):  # the first error is the one to tell
            container.close()
        raise
    for packet in stream.encode():
        _with_system_errors(container.mux, packet)
    _with_system_errors(container.close)


def _with_system_errors(call: Callable, *args: Any) -> Any:
    """The call; FFmpeg's errors become the system's, a muxer that cannot go on counts as a full disk."""
    try:
        return call(*args)
    except OSError:
        raise
    except av.FFmpegError as error:
        raise OSError(error.errno or errno.EIO, str(error.strerror or error)) from error


_COLOUR_RANGE_M = 0.6  # [m] in front of and behind the body that the colours are spread over
_DASH_PX = 6.0  # of a lost segment's outline
_WIDTH = 640  # [px] of a picture, at least: small sensors are enlarged


@checked
def depth_picture(
    depth: NDArray, motion: Motion, frame: int | None, camera: Camera, *, label: str = ""
) -> NDArray[np.uint8]:
    """One depth image, near red and far blue, with the outlines of all segments; holes are black.

    Outlines of lost segments are dashed and grey.

    Parameters
    ----------
    depth : (H, W) [m], 0 where nothing was measured
    frame : int or None, of the motion
    camera : Camera of the depth images

    Returns
    -------
    (H, W, 3) uint8 RGB, enlarged by a whole factor to 640 pixels of width where the image is smaller
    """
    depth = np.asarray(depth, np.float32)
    times = max(-(-_WIDTH // depth.shape[1]), 1)
    large = scaled(camera, float(times))
    middle = float(np.median(depth[depth > 0])) if (depth > 0).any() else 2.0
    raster = None
    if frame is not None:
        raster = render_body(motion.body, motion.state(frame), large)
        middle = float(np.median(raster.depth[raster.seen])) if raster.seen.any() else middle
    picture = drawing.depth_colours(depth, middle - _COLOUR_RANGE_M, middle + _COLOUR_RANGE_M)
    out = np.ascontiguousarray(np.repeat(np.repeat(picture, times, axis=0), times, axis=1))
    if raster is not None and frame is not None:
        part, lost = raster.segment, np.append(motion.lost[frame], False)  # -1, the background, is not lost
        for a, b, there in ((part[1:], part[:-1], out[1:]), (part[:, 1:], part[:, :-1], out[:, 1:])):
            there[(a != b) & ~lost[a] & ~lost[b]] = drawing.WHITE
        for s in np.flatnonzero(lost).tolist():
            for rim in drawing.segment_contours(part, s):
                drawing.draw_line(out, rim, LOST_COLOUR, 1, _DASH_PX)
    if label:
        drawing.write_lines(out, [(label, drawing.WHITE)])
    return out


@checked
def write_depth_overlay(
    motion: Motion, camera: Camera, depth: DepthVideo, path: str | PathLike[str], *,
    progress: Callable[[int], None] | None = None,
) -> None:  # fmt: skip
    """Write a video of the depth images of a motion with the fitted body's outlines.

    Raises
    ------
    ExportError
        The file cannot be written.
    """
    height, width = (n - n % 2 for n in depth_picture(depth.frame(0).depth, motion, None, camera).shape[:2])

    def drawn() -> Iterator[NDArray[np.uint8]]:
        for i in frames_of(motion, depth.times):
            at = motion.frame_at(float(depth.times[i]))
            label = f"{camera.name}   frame {i}" + ("" if at is not None else "   no motion here")
            yield depth_picture(depth.frame(i).depth, motion, at, camera, label=label)[:height, :width]

    write_pictures(drawn(), path, depth.rate, (width, height), progress)
