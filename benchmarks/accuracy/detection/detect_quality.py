"""The detector's qualities: each camera of the balancing trial, predicted by triangulating the other three.

`kinefit detect --quality` on the four videos, people chosen over all cameras as a take does. Of each frame and landmark
with a confidence above 0.5 in at least two of the others: how far the camera's own landmark is from where the others
place it, as it was detected, and with left and right exchanged for a whole person where that is nearer. Sides are
exchanged where that more than halves the frame's median distance.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, data, figure
from benchmarks.timing import took
from kinefit.errors import AssetError, ObservationError
from kinefit.fitting.multiview.association import choose_people
from kinefit.geometry.camera import ImageFrame, Rig
from kinefit.geometry.lines import triangulate
from kinefit.images.detectors.roi import MIRROR
from kinefit.readers.assets import CAMERAS
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.landmarks.detections import read_detections
from kinefit.takes.preparing import detecting

_GOALS = {"median": ("px", "<= 11"), "mean": ("px", "<= 13"), "exchanged": ("pictures", "== 0")}
_OTHERS = 2  # cameras that must see a landmark to place it


def run() -> None:
    """Print the figures."""
    trial, reason = data("video_balancing_4cam"), "no recording"
    try:
        detecting.networks(None, print, "best")
    except (AssetError, ObservationError) as error:
        trial, reason = None, error.problem
    measured = None if trial is None else {quality: _measured(trial, quality) for quality in detecting.QUALITIES}
    for name, (unit, goal) in _GOALS.items():
        figure(f"detect_best_{name}", None if measured is None else measured["best"][name], unit, goal, reason)
    gain = None if measured is None else measured["best"]["mean"] / measured["balanced"]["mean"]
    figure("detect_best_of_balanced", gain, "of the mean of balanced", "<= 0.5", reason)


def _measured(trial: Path, quality: str) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        jobs = [
            detecting.DetectionJob(
                c, trial / "videos" / f"{c}.mp4", Path(folder) / f"{c}.npz", seconds=amount(None, (0.0, 0.05))
            )
            for c in CAMERAS
        ]  # fmt: skip
        settings = detecting.DetectionSettings(masks=False, quality=quality)
        _, spent = took(lambda: detecting.detect(jobs, settings, tell=print))
        found = [read_detections(job.file) for job in jobs]
    rig = read_calibration(trial / "Calib_refined_static.toml").select(CAMERAS)
    images = [ImageFrame.letterboxed(rig[c].size, f.size) for c, f in zip(CAMERAS, found)]
    keypoints = [f.keypoints(image_frame=image) for f, image in zip(found, images)]
    chosen = choose_people(rig, keypoints)
    uv = np.stack([_surely_seen(k.points, k.confidence, p) for k, p in zip(keypoints, chosen)], axis=2)
    off = np.stack([held_out(rig, uv, c) for c in range(len(rig))])  # (C, F, 33)
    turned = np.stack([held_out(rig, uv, c, MIRROR) for c in range(len(rig))])
    seen = np.isfinite(off).any(axis=2) & np.isfinite(turned).any(axis=2)
    exchanged = np.zeros(seen.shape, bool)
    exchanged[seen] = np.nanmedian(turned[seen], axis=1) < 0.5 * np.nanmedian(off[seen], axis=1)
    right = np.where(exchanged[..., None], turned, off)
    pictures = sum(int(f.seen.any(axis=1).sum()) for f in found)
    for what, gap in (("as detected", off), ("sides put right", right)):
        middle, mean, most = np.nanmedian(gap), np.nanmean(gap), np.nanpercentile(gap, 95)
        print(f"# {quality}, {what}: median {middle:.1f}, mean {mean:.1f}, 95 % {most:.1f} px")
    print(f"#   {1e3 * spent / pictures:.0f} ms of processor a picture")
    return {"median": float(np.nanmedian(off)), "mean": float(np.nanmean(off)), "exchanged": float(exchanged.sum())}


def _surely_seen(points: NDArray, confidence: NDArray, person: NDArray) -> NDArray:
    """(F, N, 2) [px] landmarks (F, P, N, 2) of the chosen person that are surely seen, NaN elsewhere."""
    frames = np.arange(len(person))
    sure = (confidence[frames, person] > 0.5) & (person >= 0)[:, None]
    return np.where(sure[..., None], points[frames, person], np.nan)


def held_out(rig: Rig, uv: NDArray, camera: int, names: list[int] | None = None) -> NDArray:
    """(F, N) [px] between landmarks (F, N, C, 2) of a camera, renamed, and where the other cameras place them."""
    others = [c for c in range(len(rig)) if c != camera]
    seen = np.isfinite(uv[:, :, others, 0]).sum(axis=2) >= _OTHERS
    x = triangulate(rig.select([rig.names[c] for c in others]), uv[:, :, others].reshape(-1, len(others), 2))
    at = rig.cameras[camera].project(x).reshape(*uv.shape[:2], 2)
    own = uv[:, :, camera] if names is None else uv[:, names, camera]
    return np.where(seen, np.linalg.norm(own - at, axis=2), np.nan)
