"""Pictures of the cameras as a 3D scene can hold them: without lens distortion, small, decoded when asked for."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.geometry.camera import Camera, ImageFrame
from kinefit.readers.video import Video

_MAX_HALF_WIDTH = np.tan(np.radians(65.0))  # a flat picture of more would be all border
_MAX_CACHE_BYTES = 96_000_000  # bytes of pictures that are kept


@dataclass(frozen=True, eq=False)
class PinholeView:
    """What a camera sees, as a flat picture: a pinhole with its axis in the middle that covers the whole image.

    Parameters
    ----------
    size : (width, height) [px] of the flat picture.
    tangents : (x, y)
        Of half its angles of view.
    """

    size: tuple[int, int]
    tangents: tuple[float, float]

    @property
    def fov(self) -> float:
        """[rad] vertical angle of view."""
        return 2.0 * float(np.arctan(self.tangents[1]))

    @property
    def aspect(self) -> float:
        """Width over height."""
        return self.tangents[0] / self.tangents[1]

    def rays(self) -> NDArray:
        """(H, W, 3) points at depth 1 in the camera's frame that the middles of the pixels show."""
        (w, h), (tx, ty) = self.size, self.tangents
        x, y = (2 * np.arange(w) + 1 - w) / w * tx, (2 * np.arange(h) + 1 - h) / h * ty
        return np.stack([*np.meshgrid(x, y), np.ones((h, w))], axis=-1)

    def pixels(self, x_camera: NDArray) -> NDArray:
        """(..., 2) [px] where points (..., 3) of the camera's frame appear in the flat picture."""
        half = 0.5 * np.array(self.size)
        return (x_camera[..., :2] / x_camera[..., 2:] / self.tangents + 1.0) * half - 0.5


def flat_view(camera: Camera, longest: int) -> PinholeView:
    """The view of a camera whose longer side has `longest` pixels."""
    w, h = camera.size
    u, v = np.linspace(-0.5, w - 0.5, 33), np.linspace(-0.5, h - 0.5, 33)
    border = np.concatenate(
        [np.stack(np.broadcast_arrays(u, y), -1) for y in v[[0, -1]]]
        + [np.stack(np.broadcast_arrays(x, v), -1) for x in u[[0, -1]]]
    )
    rays = camera.with_pose(np.eye(4)).ray(border)
    ahead = np.isfinite(rays).all(-1) & (rays[:, 2] > 0)
    slopes = np.abs(rays[ahead, :2] / rays[ahead, 2:])
    plain = 0.5 * np.array([w, h]) / camera.matrix[[0, 1], [0, 1]]  # where no ray reaches the border
    tx, ty = (float(t) for t in np.minimum(slopes.max(axis=0) if len(slopes) else plain, _MAX_HALF_WIDTH))
    scale = longest / max(tx, ty)
    return PinholeView((max(1, round(scale * tx)), max(1, round(scale * ty))), (tx, ty))


def undistortion(camera: Camera, image: ImageFrame, view: PinholeView) -> NDArray:
    """(H, W, 2) [px] of the delivered picture for every pixel of a flat view; NaN where the lens shows nothing."""
    return image.from_calibration(camera.with_pose(np.eye(4)).project(view.rays()))


def flatten(picture: NDArray[np.uint8], pixels: NDArray) -> NDArray[np.uint8]:
    """A delivered picture (H, W, 3) seen through `undistortion`'s map (h, w, 2): (h, w, 3), dark where nothing is."""
    shrink = min(1.0, max(pixels.shape[:2]) / max(picture.shape[:2]))
    if shrink < 1.0:  # by areas first: the map alone would skip pixels
        size = (max(1, round(shrink * picture.shape[1])), max(1, round(shrink * picture.shape[0])))
        ratio = np.array(size) / (picture.shape[1], picture.shape[0])
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        pixels = (pixels + 0.5) * ratio - 0.5
    maps = np.nan_to_num(pixels, nan=-1e4).astype(np.float32)
    out = cv2.remap(picture, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(40, 40, 40))
    return np.asarray(out, np.uint8)


class CameraImages:
    """Flat pictures of cameras over time, decoded on demand; the last ones are kept.

    Parameters
    ----------
    cameras : {name: Camera}
    videos : {name: path or Video}
        Of some or all of the cameras.
    images : {name: ImageFrame}, optional
        From the calibration to the video; by default they are the same.
    time_offsets : {name: float [s]}, optional
        Added to frame / rate to get the time of the take.
    rate : float [Hz], optional
        Of videos that are folders of images.

    Raises
    ------
    FileError
        A video that cannot be read.
    """

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        videos: Mapping[str, Path | Video],
        images: Mapping[str, ImageFrame] | None = None,
        time_offsets: Mapping[str, float] | None = None,
        *,
        rate: float | None = None,
    ) -> None:
        self._cameras, self._images, self._offsets = cameras, images or {}, time_offsets or {}
        self._videos: dict[str, Video] = {}
        self._maps: dict[tuple[str, int], NDArray] = {}
        self._kept: OrderedDict[tuple[str, int, int], NDArray[np.uint8]] = OrderedDict()
        try:
            for name, path in videos.items():
                self._videos[name] = path if isinstance(path, Video) else Video(path, rate=rate)
        except BaseException:
            self.close()
            raise

    def __contains__(self, name: object) -> bool:
        return name in self._videos

    def close(self) -> None:
        """Close all videos."""
        for video in self._videos.values():
            video.close()

    def frame(self, name: str, time: float) -> int | None:
        """Frame of a camera's video nearest to a time [s] of the take; None outside of the video."""
        return self._videos[name].frame_at(time - self._offsets.get(name, 0.0))

    def read(self, name: str, time: float, longest: int) -> NDArray[np.uint8] | None:
        """(h, w, 3) uint8 RGB flat picture of a camera at a time [s]; None without video, or outside of it."""
        i = self.frame(name, time) if name in self._videos else None
        if i is None:
            return None
        key = (name, i, longest)
        if key not in self._kept:
            if (name, longest) not in self._maps:
                camera, image = self._cameras[name], self._images.get(name, ImageFrame.identity())
                self._maps[name, longest] = undistortion(camera, image, flat_view(camera, longest))
            self._kept[key] = flatten(self._videos[name].read(i), self._maps[name, longest])
            while len(self._kept) > 1 and sum(p.nbytes for p in self._kept.values()) > _MAX_CACHE_BYTES:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]
