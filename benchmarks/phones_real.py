"""Real recordings without their calibrations: `kinefit track FOLDER` on the videos alone.

`video_two_people_4cam` chose how much the points of further people count; figures are of the others. Cameras and lenses
are compared with the recording's own calibration, the motion with the one tracked with it: joints laid on as a whole,
with the scale that comes out, as no height is stated.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import LEFT_OUT, data, figure, quick
from benchmarks.phones_rooms import turns_between
from kinefit import Motion, find_cameras, track_take
from kinefit._files import write_text
from kinefit.errors import KinefitError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import read_calibration, read_found
from kinefit.readers.guess.folder import guess_take
from kinefit.simulation.evaluation import angle_errors
from kinefit.takes.missing import cameras_file

RECORDINGS = {
    "balancing": ("video_balancing_4cam", "videos", "Calib_refined_static.toml"),
    "upper_body": ("mv4_upperbody_caliscope", ".", "config.toml"),
}
_GOALS = {
    "rotation": ("deg between two cameras, median", "<= 0.5"), "focal": ("%, median", "<= 2"),
    "joints": ("mm from the motion with the calibration, laid on with its scale", "<= 10"),
    "angles": ("deg from those with the calibration", "<= 0.5"),
}  # fmt: skip


def run() -> None:
    """Print every figure of real recordings without calibration."""
    for name, (recording, videos, calibration) in RECORDINGS.items():
        folder = data(recording)
        if folder is None or quick():
            _none(name, LEFT_OUT if quick() else f"no recording {recording}")
            continue
        with tempfile.TemporaryDirectory() as work:
            try:
                found, motion, known = _tracked(folder / videos, folder / calibration, Path(work))
            except KinefitError as error:
                _none(name, f"refused: {error.problem}")
                continue
        truth = read_calibration(folder / calibration)
        pairs = dict(zip(found.names, truth.names, strict=True))
        truth = Rig(tuple(truth[pairs[n]] for n in found.names))
        lens = [100 * abs(a.matrix[0, 0] / b.matrix[0, 0] - 1) for a, b in zip(found, truth, strict=True)]
        angles = float(np.nanmean(np.abs(angle_errors(motion, known))))
        values = np.median(turns_between(found, truth)), np.median(lens), _apart(motion, known), angles
        for (what, (unit, goal)), value in zip(_GOALS.items(), values, strict=True):
            figure(f"phones_{name}_{what}", float(value), unit, goal)


def _none(name: str, why: str) -> None:
    for what, (unit, goal) in _GOALS.items():
        figure(f"phones_{name}_{what}", None, unit, goal, why)


def _tracked(videos: Path, calibration: Path, work: Path) -> tuple[Rig, Motion, Motion]:
    """The cameras found, the motion tracked with them, and that with the calibration, of the same detections."""
    for path in sorted(videos.glob("*.mp4")):
        (work / path.name).symlink_to(path)
    write_text(work / "take.toml", guess_take(work).text)
    motion = track_take(find_cameras(work / "take.toml"))[0]
    found = read_found(cameras_file(work / "take.toml"))
    assert found is not None
    (work / calibration.name).symlink_to(calibration)
    write_text(work / "known.toml", guess_take(work).text)
    (work / "take-detect").rename(work / "known-detect")
    return found.rig, motion, track_take(work / "known.toml")[0]


def _apart(motion: Motion, known: Motion) -> float:
    """[mm] mean distance of joints, laid on as a whole with the scale that fits best."""
    first, last = max(motion.times[0], known.times[0]), min(motion.times[-1], known.times[-1])
    x, y = (_joints(m, first, last) for m in (motion, known))
    frames = min(len(x), len(y))
    x, y = x[:frames].reshape(-1, 3), y[:frames].reshape(-1, 3)
    T = se3.aligned(x, y)
    own, aim = se3.apply(T, x), y.mean(axis=0)
    scale = np.sum((y - aim) * (own - own.mean(axis=0))) / np.sum((own - own.mean(axis=0)) ** 2)
    return 1e3 * float(np.linalg.norm(scale * (own - own.mean(axis=0)) + aim - y, axis=1).mean())


def _joints(motion: Motion, first: float, last: float) -> NDArray:
    inside = (motion.times >= first - 1e-6) & (motion.times <= last + 1e-6)
    return motion.segment_poses()[inside][..., :3, 3]
