"""Images for the page of `kinefit check`: points as detected and as the other cameras predict them, errors by place."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.bias import CameraBias
from kinefit.diagnostics.keypoints import Check
from kinefit.diagnostics.views import from_others
from kinefit.errors import KinefitError
from kinefit.exporters.pictures.drawing import draw_dot, draw_line
from kinefit.exporters.report import page as p
from kinefit.geometry.camera import Camera, ImageFrame
from kinefit.preparing.faces import shown_video

_DETECTED_RGB = (255, 240, 60)
_EXPECTED_RGB = (90, 200, 255)
_CONTOUR_RGB = (15, 15, 15)
_BIAS_RGB = (255, 90, 60)
_ARROW_SCALE = 10  # a bias of 2 px is drawn 20 px long
_MAP_CELLS = (6, 10)  # of the map of residuals, along the shorter and the longer side of the image
_MIN_CELL_POINTS = 15  # fewer give no mean worth an arrow
_CROP_MARGIN = 0.12  # of the person's size, shown around the person
_LINE_REFERENCE_PX = 1100  # longer side of the pictures for which the stated line widths hold


def picture_section(check: Check) -> p.Section:
    """Of every camera one frame with its points, and a map of the mean errors."""
    pictures, maps = [], []
    assert check.views is not None
    for b in check.biases:
        c = check.views.rig.index(b.camera)
        camera = check.views.rig.cameras[c]
        seen = np.isfinite(check.views.uv[:, :, c]).all(-1).sum(axis=1)
        middle = np.abs(np.arange(len(seen)) - len(seen) / 2)
        frame = int(np.argmax(seen - 1e-3 * middle))
        ground, image = _ground(check, camera, frame)
        others = from_others(check.views.at(np.array([frame])), c)[0]
        pictures.append(
            p.picture(_points(ground, image, check.views.uv[frame, :, c], others, b), caption=_caption(b, frame))
        )
        maps.append(p.picture(_map(check, c, ground, image), caption=f"{b.camera}: median error by place"))
    first = (
        "One frame of each camera. Yellow rings: detected keypoints. Blue dots: the same points as predicted from the "
        f"other cameras. Red arrow: the bias against the other cameras, {_ARROW_SCALE} times as long."
    )
    second = (
        f"Median of projected minus detected points in each part of the image, {_ARROW_SCALE} times as long. "
        "Parallel arrows: the camera was rotated or moved. Radial arrows: wrong focal length. Curved arrows: wrong "
        "distortion."
    )
    return p.section(
        "Images", first, p.gallery(pictures), p.paragraph(second), p.gallery(maps),
        anchor="pictures",
    )  # fmt: skip


def pair(values: NDArray) -> str:
    """Two numbers [px] as text."""
    return f"{values[0]:+.1f}, {values[1]:+.1f}" if np.isfinite(values).all() else "-"


def _caption(b: CameraBias, frame: int) -> str:
    off = b.alone if np.isfinite(b.alone).all() else b.bias
    return f"{b.camera}, frame {frame}: {pair(off)} px against the other cameras"


def _ground(check: Check, camera: Camera, frame: int) -> tuple[NDArray, ImageFrame]:
    """A frame of the camera's video (grey where there is none), and how it relates to the calibration's picture."""
    seen = check.observations
    entry = next((e for e in check.take.cameras if e.name == camera.name), None) if check.take else None
    if check.take and seen is not None and entry is not None and camera.name in seen.videos:
        step = frame + seen.frames[0] - check.frames_late.get(camera.name, 0)
        try:
            with shown_video(check.take, seen, camera.name) as video:
                time = float(np.clip(step / seen.rate - entry.time_offset, 0.0, video.times[-1]))
                return np.array(video.read(video.frame_at(time) or 0)), seen.images[camera.name]
        except KinefitError:
            pass
    return np.full((camera.size[1], camera.size[0], 3), 70, np.uint8), ImageFrame.identity()


def _points(ground: NDArray, image: ImageFrame, seen: NDArray, others: NDArray, b: CameraBias) -> NDArray:
    scale = max(ground.shape) / _LINE_REFERENCE_PX
    out = (ground * 0.75).astype(np.uint8)
    pairs = list(zip(image.from_calibration(seen), image.from_calibration(others), strict=True))
    for both in pairs:
        draw_line(out, np.stack(both), _EXPECTED_RGB, max(1, round(1.5 * scale)))
    for uv, expected in pairs:
        draw_dot(out, expected, 4.5 * scale, _CONTOUR_RGB, -1)
        draw_dot(out, expected, 3.5 * scale, _EXPECTED_RGB, -1)
        draw_dot(out, uv, 6 * scale, _CONTOUR_RGB, max(2, round(4 * scale)))
        draw_dot(out, uv, 6 * scale, _DETECTED_RGB, max(1, round(2 * scale)))
    bias = b.alone if np.isfinite(b.alone).all() else b.bias
    person = image.from_calibration(seen)[np.isfinite(seen).all(-1)]
    start = np.median(person, axis=0) if len(person) else np.array(out.shape[1::-1]) / 2
    _arrow(out, start, start + _ARROW_SCALE * bias, 3 * scale)
    return _cropped(out, np.concatenate([person, [start, start + _ARROW_SCALE * bias]]))


def _cropped(picture: NDArray, shown: NDArray) -> NDArray:
    """The part of a picture about some points (N, 2)."""
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = max(40.0, _CROP_MARGIN * float(np.max(high - low)))
    (left, top), (right, bottom) = (np.rint(edge).astype(int) for edge in (low - margin, high + margin))
    return picture[max(top, 0) : max(bottom, 1), max(left, 0) : max(right, 1)]


def _map(check: Check, c: int, ground: NDArray, image: ImageFrame) -> NDArray:
    assert check.views is not None and check.x_world is not None
    camera, scale = check.views.rig.cameras[c], max(ground.shape) / _LINE_REFERENCE_PX
    uv = check.views.uv[:, :, c].reshape(-1, 2)
    error = camera.project(check.x_world.reshape(-1, 3)) - uv
    fine = np.linalg.norm(error, axis=-1) < check.views.limit
    uv, error, size = uv[fine], error[fine], np.array(camera.size)
    cells = np.where(size == size.max(), _MAP_CELLS[1], _MAP_CELLS[0])
    cell = np.clip((uv / size * cells).astype(int), 0, cells - 1)
    out = (ground * 0.4).astype(np.uint8)
    for i in range(cells[0]):
        for j in range(cells[1]):
            here = (cell == (i, j)).all(axis=1)
            if here.sum() >= _MIN_CELL_POINTS:
                start = image.from_calibration(np.median(uv[here], axis=0))
                draw_dot(out, start, 3 * scale, _EXPECTED_RGB, -1)
                _arrow(out, start, start + _ARROW_SCALE * np.median(error[here], axis=0), 2 * scale)
    return out


def _at(uv: NDArray) -> tuple[int, int]:
    u, v = np.clip(np.rint(uv), -20000, 20000).astype(int)
    return int(u), int(v)


def _arrow(out: NDArray, start: NDArray, end: NDArray, width: float) -> None:
    length = float(np.linalg.norm(end - start))
    if length > 1:
        for colour, thick in ((_CONTOUR_RGB, width + 3), (_BIAS_RGB, width)):
            tip = min(0.5, 12 * width / 3 / length + 0.1)
            cv2.arrowedLine(out, _at(start), _at(end), colour, max(1, round(thick)), cv2.LINE_AA, tipLength=tip)
