"""`kinefit markers fit` and `kinefit track` on one file of labelled markers: the same body, poses, quality, lost limbs.

Both through the commands' own functions, with defaults, on whole recordings: one road, so what differs is a fault.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.figures import amount, data, figure
from kinefit import Motion, track_take
from kinefit.cli.markers._fit import fit_file

TAKES = {
    "squats": "forces_nimblephysics/subject4/squats1.trc", "drop jump": "forces_nimblephysics/subject4/DJ1.trc",
    "gait": "markers_pycgm/Test_Files/Movement_trial.c3d", "run": "markers_bmc_run/run/ExpData/motion_capture_run.trc",
}  # fmt: skip
FIGURES = (
    ("joints", "mm, median", "<= 1"), ("quality", "between the means", "<= 0.01"),
    ("lost", "% of segments in frames that one says to be lost and the other not", "<= 1"),
)  # fmt: skip


def both(path: Path) -> tuple[Motion, Motion]:
    """The motion of `kinefit markers fit`, and that of `kinefit track` from a take of the same file."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        (fitted, _), *_ = fit_file(path, out=Path(folder) / "fit", formats=["motion"]).values()
        middle = time.process_time()
        take = Path(folder) / "take.toml"
        take.write_text(f'[take]\nname = "{path.stem}"\nup = "{fitted.up}"\n\n[[markers]]\nfile = "{path}"\n', "utf-8")
        tracked, *_ = track_take(take)
        spent = middle - began, time.process_time() - middle
    count = len(fitted)
    print(f"# {path.stem}: {count} frames, {1e3 * spent[0] / count:.1f} and {1e3 * spent[1] / count:.1f} ms a frame")
    return fitted, tracked


def run() -> None:
    """Print how far the two are apart, the worst of the recordings."""
    worst: dict[str, float] = {}
    for name in amount(tuple(TAKES), tuple(TAKES)[2:3]):
        relative = Path(TAKES[name])
        folder = data(relative.parts[0])
        if folder is None:
            continue
        fitted, tracked = both(folder / Path(*relative.parts[1:]))
        apart = 1e3 * np.linalg.norm(fitted.joint_centres - tracked.joint_centres, axis=2)
        told = {
            "joints": float(np.median(apart)),
            "quality": abs(float(fitted.quality.mean() - tracked.quality.mean())),
            "lost": 100.0 * float(np.mean(fitted.lost != tracked.lost)),
        }
        sure = float(np.median(tracked.joint_std / fitted.joint_std))
        print(f"# {name}: {told['joints']:.2f} mm, 95 % {np.percentile(apart, 95):.2f}, at most {apart.max():.1f}")
        print(f"# quality {fitted.quality.mean():.3f} and {tracked.quality.mean():.3f}; bars {sure:.2f} times as wide")
        worst = {key: max(value, worst.get(key, 0.0)) for key, value in told.items()}
    for key, unit, goal in FIGURES:
        figure(f"markers_roads_{key}", worst.get(key), unit, goal, "" if worst else "the recordings are absent")
