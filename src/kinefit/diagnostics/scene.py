"""What the rig looks like: lenses, where the cameras stand, what each of them sees of the person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from kinefit.diagnostics.views import KeypointViews
from kinefit.findings import Finding, Severity, listed
from kinefit.geometry.camera import Camera, Rig

_VIEW = (15.0, 130.0)  # [deg] of the longer side: from a long tele lens to the widest that is not a fisheye
_SQUARE = 0.03  # fx and fy of a sensor with square pixels differ by less
_MIDDLE = 0.12  # of the picture's size, by which the principal point may be off its middle
_LIKE = 0.15  # share by which focal lengths of pictures of one size differ where the lenses are alike
_BESIDE, _OPPOSITE = 15.0, 165.0  # [deg] between two views: depth is then known 4 times worse than across
_WEAK = 4.0
_SMALL = 200  # [px] height of a person, about what pose detectors scale people to
_CELLS = 6  # of the volume along each axis, for what a camera sees of it


@dataclass(frozen=True, eq=False)
class CameraCoverage:
    """What one camera sees.

    Parameters
    ----------
    camera : str
    volume : float
        Share of the volume that the person used which lies in the picture.
    seen : float
        Share of the keypoints, over all frames, that the detector found in it.
    height_px : float [px]
        Median height of the person in the picture.
    distance : float [m]
        From the camera to the middle of the volume.
    """

    camera: str
    volume: float
    seen: float
    height_px: float
    distance: float


def lens_findings(rig: Rig) -> list[Finding]:
    """Whether focal lengths, principal points and distortions can be those of real lenses."""
    out = []
    for camera in rig:
        for problem, remedy in _lens_problems(camera):
            out.append(Finding("doubt", "lens", f"{camera.name}: {problem}.", (camera.name,), remedy=remedy))
    sizes = {camera.size for camera in rig}
    focal = np.array([camera.matrix[0, 0] for camera in rig])
    if len(sizes) == 1 and len(rig) > 2:
        off = np.abs(np.log(focal / np.median(focal)))
        for c in np.flatnonzero(off > _LIKE):
            text = f"{rig.names[c]}: focal length {focal[c]:.0f} px, that of the others {np.median(focal):.0f} px"
            remedy = "As it should be where its lens or zoom is another; else calibrate it anew."
            out.append(Finding("note", "lens", f"{text}.", (rig.names[c],), remedy=remedy))
    if not out:
        views = [_view(camera) for camera in rig]
        told = f"{min(views):.0f} to {max(views):.0f}" if max(views) - min(views) > 1 else f"{views[0]:.0f}"
        text = f"Lenses are plausible: fields of view of {told} degrees, distortion without folds."
        out.append(Finding("good", "lens", text))
    return out


def _view(camera: Camera) -> float:
    """[deg] field of view along the longer side."""
    axis = int(np.argmax(camera.size))
    if camera.model == "fisheye":
        return float(np.degrees(camera.size[axis] / camera.matrix[axis, axis]))
    return float(np.degrees(2 * np.arctan(0.5 * camera.size[axis] / camera.matrix[axis, axis])))


def _lens_problems(camera: Camera) -> list[tuple[str, str]]:
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    size, centre, view = np.array(camera.size), camera.matrix[:2, 2], _view(camera)
    again, out = "Calibrate its lens anew, or check the image size in the calibration.", []
    if not _VIEW[0] <= view <= (_VIEW[1] if camera.model != "fisheye" else 220.0):
        out.append((f"a field of view of {view:.0f} degrees (focal length {fx:.0f} px) is no common lens", again))
    if abs(np.log(fx / fy)) > _SQUARE:
        out.append(
            (f"its pixels would not be square (fx {fx:.0f}, fy {fy:.0f} px)", "Was its image stretched? " + again)
        )
    off = np.abs(centre - 0.5 * (size - 1)) / size
    if np.any(off > _MIDDLE):
        where = f"({centre[0]:.0f}, {centre[1]:.0f}) of {size[0]}x{size[1]} px"
        out.append(
            (f"its principal point {where} is far from the middle", "Was its image cropped or turned? " + again)
        )
    edge = np.linspace(0.0, 1.0, 9)
    rim = np.array([(a, b) for a in edge for b in edge if a in (0, 1) or b in (0, 1)]) * (size - 1)
    with np.errstate(invalid="ignore"):
        rays = camera.ray(rim)
    lost = ~np.isfinite(rays).all(-1)
    if lost.any():
        share = f"{100 * lost.mean():.0f} % of the image's border"
        out.append(
            (f"its distortion folds back: no ray reaches {share}", "Calibrate it with boards up to the corners.")
        )
    return out


def placement_findings(rig: Rig, x: NDArray) -> list[Finding]:
    """Whether the cameras stand so that depth can be told: x (N, 3) [m] points of the person."""
    centres = np.stack([camera.centre_world for camera in rig])
    middle, out = np.median(x, axis=0), []
    ways = middle - centres
    distance = np.linalg.norm(ways, axis=1)
    ways = ways / np.maximum(distance, 1e-9)[:, None]
    pairs = list(combinations(range(len(rig)), 2))
    angles = {(a, b): float(np.degrees(np.arccos(np.clip(ways[a] @ ways[b], -1, 1)))) for a, b in pairs}
    across = [v for v in angles.values() if _BESIDE <= v <= _OPPOSITE]
    weakness = _weakness(ways)
    enough = bool(across) and weakness <= _WEAK
    for (a, b), angle in angles.items():
        names = (rig.names[a], rig.names[b])
        if _BESIDE <= angle <= _OPPOSITE:
            continue
        how = "stand beside each other" if angle < _BESIDE else "stand opposite each other"
        gap = f"{angle:.0f} degrees and {np.linalg.norm(centres[a] - centres[b]):.2f} m apart"
        text = f"{listed(names)} {how} ({gap}): these two alone do not show how far away a point is"
        if enough:
            out.append(Finding("note", "placement", f"{text}; others do.", names))
        else:
            remedy = "Put one of them 60 to 120 degrees round the person."
            out.append(Finding("doubt", "placement", f"{text}, and no others show it well.", names, remedy=remedy))
    if across:
        best = max(across, key=lambda v: min(v, 180 - v))
        severity: Severity = "good" if enough else "doubt"
        text = f"The best angle between two views is {best:.0f} degrees; a point is known {weakness:.1f} times worse "
        remedy = "" if enough else "Spread the cameras round the person."
        out.append(Finding(severity, "placement", text + "along its worst direction than its best.", remedy=remedy))
    return out


def _weakness(ways: NDArray) -> float:
    """How much worse [times] a point is known along its worst direction than along its best."""
    information = sum(np.eye(3) - np.outer(w, w) for w in ways)
    values = np.linalg.eigvalsh(information)
    return float(np.sqrt(values[-1] / max(values[0], 1e-12)))


def coverage(views: KeypointViews, x: NDArray) -> tuple[CameraCoverage, ...]:
    """What every camera sees of the volume that the person used: x (F, K, 3) [m]."""
    known = x[np.isfinite(x).all(-1)]
    low, high = np.percentile(known, [1, 99], axis=0)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, _CELLS).T, indexing="ij"), -1).reshape(-1, 3)
    out = []
    for c, camera in enumerate(views.rig):
        uv = camera.project(grid)
        inside = np.all((uv >= -0.5) & (uv < np.array(camera.size) - 0.5), axis=-1)
        seen = np.isfinite(views.uv[:, :, c]).all(-1)
        some = seen.sum(axis=1) >= 5
        v = views.uv[some, :, c, 1]
        tall = float(np.median(np.nanmax(v, axis=1) - np.nanmin(v, axis=1))) if some.any() else np.nan
        detected = np.isfinite(views.uv).all(-1).any(axis=(0, 2))
        distance = float(np.linalg.norm(camera.centre_world - 0.5 * (low + high)))
        out.append(CameraCoverage(camera.name, float(inside.mean()), float(seen[:, detected].mean()), tall, distance))
    return tuple(out)


def coverage_findings(seen: Sequence[CameraCoverage]) -> list[Finding]:
    """Cameras that see little of the person."""
    out = []
    for c in seen:
        if c.seen < 0.5 or c.volume < 0.5:
            text = f"{c.camera} saw {100 * c.seen:.0f} % of the keypoints; it has {100 * c.volume:.0f} % of the volume."
            remedy = "Turn it towards the person, or put it farther away."
            out.append(Finding("doubt", "coverage", text, (c.camera,), remedy=remedy))
        elif c.height_px < _SMALL:
            text = f"The person is only {c.height_px:.0f} px tall in {c.camera}: keypoints are coarse."
            remedy = "Put it nearer, or record at a higher resolution."
            out.append(Finding("note", "coverage", text, (c.camera,), remedy=remedy))
    if not out and seen:
        least = 100 * min(c.volume for c in seen)
        out.append(
            Finding(
                "good",
                "coverage",
                f"Every camera has at least {least:.0f} % of the volume that the person used in view.",
            )
        )
    return out
