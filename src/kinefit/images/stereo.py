"""Depth from a stereo pair: rectification by the calibration, then semi-global matching (Hirschmüller 2008, OpenCV)."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.errors import CalibrationError, ObservationError
from kinefit.geometry.camera import Camera
from kinefit.geometry.se3 import transform
from kinefit.observations import DepthFrame

_BLOCK_PX = 5  # OpenCV advises 3 to 11; below it noise matches, above it limbs grow at their edges
_MAX_TANGENT = math.tan(math.radians(60.0))  # of a ray's angle to the axis: beyond, few rays would fill a large plane
_MIN_SHARED_VIEW = 0.05  # share of the first view that the second camera must see


class StereoRectifier:
    """Rectifies and matches the images of two cameras: a stereo pair as a depth sensor.

    The rectified view looks along the mean of both optical axes, its x axis along the baseline from the first camera to
    the second. Pairs one above the other, or in the reverse order, work too: their view is rotated. The maps are made
    once, by the cameras' own models, for any lens.

    Parameters
    ----------
    left, right : Camera
    near, far : float [m], range of depths that are searched. The number of disparities, and so the cost, follows.
    name : str, of the depth sensor; default that of the first camera with "_stereo".

    Attributes
    ----------
    camera : Camera, rectified view from the first camera's centre, without distortion; the camera of the depth images.
    baseline : float [m]

    Raises
    ------
    CalibrationError
        Cameras at one position, or whose views do not overlap within the range.
    ObservationError
        An empty range, or one that needs disparities of more than half of the image's width.
    """

    def __init__(self, left: Camera, right: Camera, *, near: float = 0.5, far: float = 5.0, name: str = "") -> None:
        place = f"cameras {left.name} and {right.name}"
        if not 0.0 < near < far < math.inf:
            raise ObservationError(f"a range of {near} to {far} m", place=place, remedy="Give 0 < near < far.")
        across = right.centre_world - left.centre_world
        self.baseline = float(np.linalg.norm(across))
        if self.baseline < 1e-4:
            problem = f"both are at the same position ({1e3 * self.baseline:.2g} mm apart)"
            raise CalibrationError(problem, place=place, remedy="Check that the calibration is theirs and in metres.")
        self.left, self.right, self.near, self.far = left, right, near, far
        R = _rotation(left, right, across / self.baseline)
        focal = float(np.mean([left.matrix[0, 0], left.matrix[1, 1], right.matrix[0, 0], right.matrix[1, 1]]))
        low, high = _view(left, R)
        low_right, high_right = _view(right, R)
        size = np.ceil(focal * (high - low)).astype(int) + 1
        cx, cy = -focal * low
        offset = 0.5 * focal * float((low_right + high_right - low - high)[0])  # of both principal points [px]
        self._offset, self._focal = offset, focal
        matrix = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
        pose = transform(R, -R @ left.centre_world)
        self.camera = Camera(name or f"{left.name}_stereo", (int(size[0]), int(size[1])), matrix, T_camera_world=pose)
        self._maps = [_map(camera, R, matrix, shift, size) for camera, shift in ((left, 0.0), (right, offset))]
        first = offset + focal * self.baseline / far
        count = focal * self.baseline * (1.0 / near - 1.0 / far)
        self._check(place, first, count)
        self._least, self._count = math.floor(first), 16 * math.ceil((count + 2.0) / 16.0)

    def _check(self, place: str, first: float, count: float) -> None:
        width = self.camera.size[0]
        if count > 0.5 * width:
            closest = self._focal * self.baseline / (0.5 * width + self._focal * self.baseline / self.far)
            problem = f"from {self.near} m on, points move by {count:.0f} px of {width} between the two images"
            raise ObservationError(problem, place=place, remedy=f"Give near={closest:.2f} or more, or a smaller image.")
        seen = [np.isfinite(m).all(axis=-1) for m in self._maps]
        shared = 0.0
        for d in (first, first + 0.5 * count, first + count):
            u = np.arange(width) - round(d)
            inside = (u >= 0) & (u < width)
            if not inside.any():
                continue
            shared = max(shared, float(np.mean(seen[0][:, inside] & seen[1][:, u[inside]])) * float(inside.mean()))
        if shared < _MIN_SHARED_VIEW:
            problem = f"the second camera sees only {100 * shared:.0f} % of the first one's view"
            remedy = "Choose two that see the same object, or another range."
            raise CalibrationError(problem, place=place, remedy=remedy)

    def rectify(self, left: NDArray, right: NDArray) -> tuple[NDArray, NDArray]:
        """Rectify both images (h, w) or (h, w, 3) RGB uint8: (H, W) or (H, W, 3) each.

        Raises
        ------
        ObservationError
            Images of another size than the cameras', or not 8-bit.
        """
        out = []
        for image, camera, maps in zip((left, right), (self.left, self.right), self._maps):
            if image.ndim not in (2, 3) or image.shape[1::-1] != camera.size or image.dtype != np.uint8:
                problem = f"an image of shape {image.shape} and type {image.dtype}, calibrated at {camera.size}"
                remedy = "Give 8-bit images of that size, or camera.scaled(size)."
                raise ObservationError(problem, place=f"camera {camera.name}", remedy=remedy)
            out.append(cv2.remap(image, np.nan_to_num(maps, nan=-1e4), None, cv2.INTER_LINEAR))
        return out[0], out[1]

    def disparity(self, left: NDArray, right: NDArray) -> NDArray:
        """Disparity (H, W) float32 [px], focal length · baseline / depth, in the rectified view; NaN without a match.

        Matches are rejected if left and right disagree by more than a pixel, if a second match is within 10 %, or in
        patches of fewer than 100 pixels (OpenCV's advice for all three).
        """
        views = [v if v.ndim == 2 else cv2.cvtColor(v, cv2.COLOR_RGB2GRAY) for v in self.rectify(left, right)]
        matcher = cv2.StereoSGBM.create(
            minDisparity=self._least, numDisparities=self._count, blockSize=_BLOCK_PX, P1=8 * _BLOCK_PX**2,
            P2=32 * _BLOCK_PX**2, disp12MaxDiff=1, preFilterCap=31, uniquenessRatio=10, speckleWindowSize=100,
            speckleRange=2, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )  # fmt: skip
        width = self.camera.size[0]
        margins = max(self._least + self._count, 0), max(-self._least, 0)  # SGBM skips pixels that may match outside
        wide = [cv2.copyMakeBorder(v, 0, 0, *margins, cv2.BORDER_REPLICATE) for v in views]
        raw = matcher.compute(*wide)[:, margins[0] : margins[0] + width].astype(np.float32) / 16.0
        moved = raw - np.float32(self._offset)
        least, most = (self._focal * self.baseline / z for z in (self.far, self.near))
        lost = (raw < self._least) | (moved < least) | (moved > most) | ~self._seen(raw)
        return np.where(lost, np.float32(np.nan), moved)

    def _seen(self, raw: NDArray) -> NDArray:
        """Pixels (H, W) bool that lie in the first image, and whose match lies in the second."""
        first, second = (np.isfinite(m).all(axis=-1) for m in self._maps)
        height, width = raw.shape
        match = np.rint(np.arange(width) - raw).astype(int)
        inside = (match >= 0) & (match < width)
        return first & inside & second[np.arange(height)[:, None], np.clip(match, 0, width - 1)]

    def depth(self, left: NDArray, right: NDArray) -> NDArray:
        """Depth (H, W) float32 [m] along the optical axis of `camera`; 0 without a match."""
        moved = self.disparity(left, right)
        return np.nan_to_num(np.float32(self._focal * self.baseline) / moved, nan=0.0)

    def frame(self, left: NDArray, right: NDArray, time: float) -> DepthFrame:
        """Depth frame of the pair's images (h, w) or (h, w, 3) uint8 at a time [s]; its camera is `camera`."""
        return DepthFrame(self.camera.name, time, self.depth(left, right))

    def deviation(self, depth: float, matching: float = 0.5) -> float:
        """Standard deviation [m] of a depth z [m] with matches of sigma `matching` [px]: z² / (f b) · matching."""
        return depth**2 / (self._focal * self.baseline) * matching


def _rotation(left: Camera, right: Camera, x: NDArray) -> NDArray:
    """Rotation (3, 3) from world to rectified view: x along the baseline, z the part of the mean axis normal to x."""
    z = left.T_camera_world[2, :3] + right.T_camera_world[2, :3]
    z = z - (z @ x) * x
    length = float(np.linalg.norm(z))
    if length < 0.1 or left.T_camera_world[2, :3] @ right.T_camera_world[2, :3] <= 0.0:
        place = f"cameras {left.name} and {right.name}"
        remedy = "Choose two that look the same way, side by side."
        raise CalibrationError("they look in different directions, or along their baseline", place=place, remedy=remedy)
    z = z / length
    return np.stack([x, np.cross(z, x), z])


def _view(camera: Camera, R: NDArray) -> tuple[NDArray, NDArray]:
    """Smallest and largest x/z and y/z (2,) of a camera's image in the rectified view."""
    w, h = camera.size
    u, v = np.linspace(0, w - 1, 33), np.linspace(0, h - 1, 33)
    border = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    ray = camera.ray(border) @ R.T
    ray = ray[np.isfinite(ray).all(axis=1)]
    ray = ray[ray[:, 2] > 1e-3]
    if not len(ray):
        remedy = "Choose two that look the same way, side by side."
        raise CalibrationError("it looks in another direction", place=f"camera {camera.name}", remedy=remedy)
    tangents = np.clip(ray[:, :2] / ray[:, 2:], -_MAX_TANGENT, _MAX_TANGENT)
    return tangents.min(axis=0), tangents.max(axis=0)


def _map(camera: Camera, R: NDArray, matrix: NDArray, shift: float, size: NDArray) -> NDArray:
    """Positions (H, W, 2) float32 [px] of the rectified view's pixels in a camera's image; NaN outside of it.

    `shift` [px]: how far the view's principal point lies left of the matrix's.
    """
    u, v = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    x, y = (u - matrix[0, 2] + shift) / matrix[0, 0], (v - matrix[1, 2]) / matrix[1, 1]
    uv = camera.project(camera.centre_world + np.stack([x, y, np.ones_like(x)], axis=-1) @ R)
    inside = np.all((uv >= -0.5) & (uv <= np.array(camera.size) - 0.5), axis=-1)
    uv[~inside] = np.nan
    return uv.astype(np.float32)
