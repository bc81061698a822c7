"""Standard deviations that `kinefit detect --calibrate` gives, in cameras that were held out.

The built-in network's points in four videos; of each camera, by robust triangulation of the other three. Standard
deviations by confidence and point are estimated from three cameras, and judged in the fourth: how far the share of
errors within a probability is from that probability (mean over 10 to 90 % and over cameras), and how well they rank
the points that are more than 50 mm off (area under the curve, mean over cameras).
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from scipy.stats import rankdata

from benchmarks.figures import NotMeasured, amount, figure, recording
from kinefit.errors import AssetError, ObservationError
from kinefit.geometry.camera import ImageFrame
from kinefit.readers.assets import CAMERAS
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.landmarks.detections import read_detections
from kinefit.takes.preparing import detecting
from kinefit.takes.preparing.network_errors import held_out_errors, sigma_of_confidence

_PROBABILITIES = np.linspace(0.1, 0.9, 9)
_FAR_M = 0.05


def run() -> None:
    """Print the figures."""
    try:
        detecting.networks(None, print, "best")
    except (AssetError, ObservationError) as error:
        raise NotMeasured(error.problem) from error
    trial = recording("video_balancing_4cam")
    off, area = _judged(trial / "videos", trial / "Calib_refined_static.toml")
    figure("networks_sigma_calibration", off, "mean difference of shares", "<= 0.1")
    figure("networks_sigma_far", area, "area under the curve", ">= 0.92")


def _judged(videos: Path, calibration: Path) -> tuple[float, float]:
    """Mean over the cameras held out: calibration error, and area under the curve of points that are far off."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = amount(None, (0.0, 0.3))
        jobs = [
            detecting.DetectionJob(c, videos / f"{c}.mp4", Path(folder) / f"{c}.npz", seconds=seconds) for c in CAMERAS
        ]
        detecting.detect(jobs, detecting.DetectionSettings(masks=False, quality="best"), tell=print)
        found = [read_detections(job.file) for job in jobs]
    rig = read_calibration(calibration).select(CAMERAS)
    frames = [ImageFrame.letterboxed(rig[c].size, f.size) for c, f in zip(CAMERAS, found)]
    errors, judged = held_out_errors(rig, [f.keypoints(image_frame=i) for f, i in zip(found, frames)]), []
    for k, camera in enumerate(CAMERAS):
        own, sigma = errors.of(errors.camera == k), sigma_of_confidence(errors.of(errors.camera != k))
        assert sigma is not None
        said = np.array([sigma.of(c, errors.names)[p] for c, p in zip(own.confidence, own.point)])
        within = [(own.off < said * np.sqrt(-2 * np.log(1 - p))).mean() for p in _PROBABILITIES]
        off, far = float(np.abs(within - _PROBABILITIES).mean()), own.off_m > _FAR_M
        ranks, count = rankdata(said)[far].sum(), int(far.sum())
        area = (ranks - count * (count + 1) / 2) / max(count * (len(far) - count), 1)
        print(f"# {camera}: {len(far)} points, {100 * far.mean():.1f} % far, calibration {off:.3f}, area {area:.3f}")
        judged.append((off, area))
    return tuple(np.mean(judged, axis=0).tolist())  # type: ignore[return-value]
