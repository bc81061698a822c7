"""Check a rig: lenses, placement of the cameras, and how much of the person each one sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.findings import Finding, Severity, listed
from kinefit.fitting.multiview.views import KeypointViews, turned_cameras
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig

_FIELD_OF_VIEW_RANGE = (15.0, 130.0)  # [deg] of the longer side: from a long tele lens to the widest without fisheye
_MAX_ASPECT_ERROR = 0.03  # log ratio of fx and fy of a sensor with square pixels
_MAX_CENTRE_OFFSET = 0.12  # of the principal point from the middle, as a share of the image's size
_MAX_FOCAL_DIFFERENCE = 0.15  # log ratio, of equal lenses and image sizes
_MIN_ANGLE = 15.0  # [deg] between the lines of two views: below, depth is 4 times less certain than what is lateral
_MAX_ANISOTROPY = 4.0  # of a point's standard deviations
_MIN_HEIGHT_PX = 200  # of a person: pose detectors scale people to about this
_GRID_CELLS = 6  # of the volume along each axis, for a camera's coverage


@dataclass(frozen=True, eq=False)
class CameraCoverage:
    """Coverage of the person by one camera.

    Parameters
    ----------
    camera : str
    volume : float in 0..1
        Share of the person's volume of motion that lies in the image.
    seen : float in 0..1
        Share of the keypoints, over all frames, that were detected.
    height_px : float [px]
        Median height of the person in the image.
    distance : float [m]
        From the camera to the centre of the volume.
    """

    camera: str
    volume: float
    seen: float
    height_px: float
    distance: float


def lens_findings(rig: Rig) -> list[Finding]:
    """Check that focal lengths, principal points and distortions are those of real lenses."""
    out = [Finding("doubt", "lens", f"{camera.name}: {problem}.", (camera.name,), remedy=remedy)
           for camera in rig for problem, remedy in _lens_problems(camera)]  # fmt: skip
    sizes = {camera.size for camera in rig}
    focal = np.array([camera.matrix[0, 0] for camera in rig])
    if len(sizes) == 1 and len(rig) > 2:
        off = np.abs(np.log(focal / np.median(focal)))
        for c in np.flatnonzero(off > _MAX_FOCAL_DIFFERENCE):
            text = f"{rig.names[c]}: focal length {focal[c]:.0f} px, other cameras {np.median(focal):.0f} px"
            remedy = "Nothing if it has another lens or zoom; else calibrate it again."
            out.append(Finding("note", "lens", f"{text}.", (rig.names[c],), remedy=remedy))
    if not out:
        views = [_view(camera) for camera in rig]
        angles = f"{min(views):.0f} to {max(views):.0f}" if max(views) - min(views) > 1 else f"{views[0]:.0f}"
        text = f"Lenses are plausible: fields of view of {angles} degrees, distortion invertible over the image."
        out.append(Finding("good", "lens", text))
    return out


def _view(camera: Camera) -> float:
    """Field of view [deg] along the longer side."""
    axis = int(np.argmax(camera.size))
    half = 0.5 * camera.size[axis] / camera.matrix[axis, axis]
    return float(np.degrees(2 * (half if camera.model == "fisheye" else np.arctan(half))))


def _lens_problems(camera: Camera) -> list[tuple[str, str]]:
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    size, centre, view = np.array(camera.size), camera.matrix[:2, 2], _view(camera)
    again = "Calibrate its lens again, or check the image size in the calibration."
    widest = _FIELD_OF_VIEW_RANGE[1] if camera.model != "fisheye" else 220.0
    where = f"({centre[0]:.0f}, {centre[1]:.0f}) of {size[0]}x{size[1]} px"
    edge = np.linspace(0.0, 1.0, 9)
    border = np.array([(a, b) for a in edge for b in edge if a in (0, 1) or b in (0, 1)]) * (size - 1)
    with np.errstate(invalid="ignore"):
        lost = ~np.isfinite(camera.ray(border)).all(-1)
    share = f"{100 * lost.mean():.0f} % of the image's border"
    problems = (
        (not _FIELD_OF_VIEW_RANGE[0] <= view <= widest,
         f"a field of view of {view:.0f} degrees (focal length {fx:.0f} px) is implausible", again),
        (abs(np.log(fx / fy)) > _MAX_ASPECT_ERROR,
         f"its pixels are not square (fx {fx:.0f}, fy {fy:.0f} px)", f"Is its image stretched? {again}"),
        (np.any(np.abs(centre - 0.5 * (size - 1)) / size > _MAX_CENTRE_OFFSET),
         f"its principal point {where} is far from the middle", f"Is its image cropped or rotated? {again}"),
        (lost.any(), f"its distortion model is not invertible at {share}",
         "Calibrate it with boards up to the corners."),
    )  # fmt: skip
    return [(problem, remedy) for is_wrong, problem, remedy in problems if is_wrong]


def placement_findings(rig: Rig, x: NDArray) -> list[Finding]:
    """Check that the angles between the cameras determine depth, for the person's points x (N, 3) [m]."""
    centres = np.stack([camera.centre_world for camera in rig])
    middle, out = np.median(x, axis=0), []
    ways = middle - centres
    distance = np.linalg.norm(ways, axis=1)
    ways = ways / np.maximum(distance, 1e-9)[:, None]
    pairs = combinations(range(len(rig)), 2)
    angles = {(a, b): float(np.degrees(np.arccos(np.clip(ways[a] @ ways[b], -1, 1)))) for a, b in pairs}
    across = [v for v in angles.values() if min(v, 180.0 - v) >= _MIN_ANGLE]
    anisotropy = _anisotropy(ways)
    enough = bool(across) and anisotropy <= _MAX_ANISOTROPY
    for (a, b), angle in angles.items():
        if min(angle, 180.0 - angle) >= _MIN_ANGLE:
            continue
        names = (rig.names[a], rig.names[b])
        how = "are side by side" if angle < _MIN_ANGLE else "face each other"
        gap = f"{angle:.0f} degrees and {np.linalg.norm(centres[a] - centres[b]):.2f} m apart"
        text = f"{listed(names)} {how} ({gap}): these two alone do not determine depth"
        if enough:
            out.append(Finding("note", "placement", f"{text}; other pairs do.", names))
        else:
            remedy = "Place one of them 60 to 120 degrees around the person."
            out.append(Finding("doubt", "placement", f"{text}, and no other pair does well.", names, remedy=remedy))
    if across:
        best = max(across, key=lambda v: min(v, 180 - v))
        severity: Severity = "good" if enough else "doubt"
        text = f"The best angle between two views is {best:.0f} degrees. A point's standard deviation is "
        text += f"{anisotropy:.1f} times larger in its worst direction than in its best."
        remedy = "" if enough else "Spread the cameras around the person."
        out.append(Finding(severity, "placement", text, remedy=remedy))
    return out


def _anisotropy(ways: NDArray) -> float:
    """Ratio of a point's largest to its smallest standard deviation, from viewing directions (C, 3)."""
    information = sum(np.eye(3) - np.outer(w, w) for w in ways)
    values = np.linalg.eigvalsh(information)
    return float(np.sqrt(values[-1] / max(values[0], 1e-12)))


def turn_findings(views: KeypointViews) -> tuple[list[Finding], KeypointViews]:
    """A fault for the one of two cameras that was rotated since the calibration, and the views with it turned back."""
    found = turned_cameras(views)
    if not found:
        return [], views
    turns = [se3.log(views.rig[c.name].T_camera_world @ se3.inverse(c.T_camera_world))[3:] for c in found]
    which = " or ".join(f"{c.name} by {np.degrees(np.linalg.norm(w)):.1f} degrees" for c, w in zip(found, turns))
    text = f"A camera was rotated since the calibration: {which}. Turned back, the two cameras agree."
    confidence = "Certain: a rotation of the other camera explains the keypoints worse."
    if len(found) > 1:
        confidence = "Likely; the images do not show which of the two. With depth or markers, kinefit track does."
    names, remedy = tuple(c.name for c in found), "Calibrate again (kinefit calibrate people or board)."
    back = replace(views, rig=views.rig.with_camera(found[0]))
    return [Finding("fault", "moved", text, names, confidence, remedy)], back


def coverage(views: KeypointViews, x: NDArray) -> tuple[CameraCoverage, ...]:
    """Coverage of the person's volume of motion by every camera, from points x (F, K, 3) [m]."""
    known = x[np.isfinite(x).all(-1)]
    low, high = np.percentile(known, [1, 99], axis=0)
    detected = np.isfinite(views.uv).all(-1).any(axis=(0, 2))
    grid = np.stack(np.meshgrid(*np.linspace(low, high, _GRID_CELLS).T, indexing="ij"), -1).reshape(-1, 3)
    out = []
    for c, camera in enumerate(views.rig):
        uv = camera.project(grid)
        inside = np.all((uv >= -0.5) & (uv < np.array(camera.size) - 0.5), axis=-1)
        seen = np.isfinite(views.uv[:, :, c]).all(-1)
        v = views.uv[seen.sum(axis=1) >= 5, :, c, 1]
        tall = float(np.median(np.nanmax(v, axis=1) - np.nanmin(v, axis=1))) if len(v) else np.nan
        distance = float(np.linalg.norm(camera.centre_world - 0.5 * (low + high)))
        out.append(CameraCoverage(camera.name, float(inside.mean()), float(seen[:, detected].mean()), tall, distance))
    return tuple(out)


def coverage_findings(seen: Sequence[CameraCoverage]) -> list[Finding]:
    """Findings on cameras that see little of the person."""
    out = []
    for c in seen:
        if c.seen < 0.5 or c.volume < 0.5:
            text = f"{c.camera} sees {100 * c.seen:.0f} % of the keypoints and {100 * c.volume:.0f} % of the volume."
            remedy = "Point it at the person, or move it farther away."
            out.append(Finding("doubt", "coverage", text, (c.camera,), remedy=remedy))
        elif c.height_px < _MIN_HEIGHT_PX:
            text = f"The person is only {c.height_px:.0f} px tall in {c.camera}: keypoints are inaccurate."
            remedy = "Move the camera nearer, or record at a higher resolution."
            out.append(Finding("note", "coverage", text, (c.camera,), remedy=remedy))
    if not out and seen:
        least = f"{100 * min(c.volume for c in seen):.0f} %"
        text = f"Every camera sees at least {least} of the volume in which the person moves."
        out.append(Finding("good", "coverage", text))
    return out
