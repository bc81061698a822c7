"""Long takes: memory of `kinefit track` by length, the way on after SIGKILL, the page of an hour at 30 Hz.

The take is simulated: keypoints of two cameras (3 px of noise, a tenth missing, a tenth outliers) of a squat and a
wave, to and fro until it is long enough; there is no video. Memory is the largest resident set of the whole process,
with all usual formats and the report. The page is of a motion that was tracked, one time after the other.
"""

from __future__ import annotations

import signal
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.commands import begun, used
from benchmarks.figures import LEFT_OUT, amount, figure, quick
from benchmarks.scenes.simulated import to_and_fro
from kinefit.bodies import load_body
from kinefit.bodies.motion import Motion
from kinefit.exporters.report.report import write_report
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS
from kinefit.readers.motion import read_motion
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig

LENGTHS = {600: "<= 700", 6_000: "<= 700", 20_000: "<= 650", 60_000: "<= 700"}
"""Frames, and the goal of memory [MB]."""

SHORT = 600
HOUR = 108_000
_PIECE = 3_000  # frames simulated at once


def write_long_take(folder: Path, frames: int, *, seed: int = 0) -> Path:
    """Write a take of so many frames; returns its file."""
    motion = squat_and_wave(load_body("humanoid"), up="y")
    rig = studio_rig(motion, cameras=2)
    folder.mkdir(parents=True, exist_ok=True)
    write_calibration(rig, folder / "calibration.toml")
    order = to_and_fro(len(motion), frames)
    names = KEYPOINT_SETS["MEDIAPIPE_33"]
    out = {c.name: np.zeros((frames, len(names), 3), np.float32) for c in rig}
    for start in range(0, frames, _PIECE):
        which = order[start : start + _PIECE]
        fields = ("Ts_world_root", "angles", "dof_std", "joint_std", "quality", "segment_quality")
        piece = replace(
            motion, times=(start + np.arange(len(which))) / motion.rate,
            **{name: getattr(motion, name)[which] for name in fields},
        )  # fmt: skip
        for k in simulate_keypoints(piece, rig, "MEDIAPIPE_33", seed=seed + start):
            column = [names.index(n) for n in k.names]
            here = out[k.camera][start : start + len(which)]
            here[:, column, :2] = np.nan_to_num(k.points[:, 0])
            here[:, column, 2] = k.confidence[:, 0]
    text = f'[take]\nrate = {motion.rate:g}\nup = "y"\n[calibration]\nfile = "calibration.toml"\n'
    for camera in rig:
        np.save(folder / f"{camera.name}.npy", out[camera.name])
        width, height = camera.size
        text += f'[[camera]]\nname = "{camera.name}"\nsize = [{width}, {height}]\n[[keypoints]]\n'
        text += f'camera = "{camera.name}"\nfile = "{camera.name}.npy"\nformat = "mediapipe"\n'
        text += f'frame = "calibration"\nrate = {motion.rate:g}\n'
    take = folder / "take.toml"
    take.write_text(text)
    return take


def run() -> None:
    """Print memory, resume and page."""
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        for frames, goal in LENGTHS.items():
            if quick() and frames > SHORT:
                figure(f"long_memory_{frames}", None, "MB", goal, LEFT_OUT)
                continue
            take = write_long_take(folder / str(frames), amount(frames, 60))
            out = folder / f"{frames}-out"
            seconds, memory = used("track", take, "--out", out)
            figure(f"long_memory_{frames}", memory, "MB", goal)
            print(f"  {seconds:.0f} s, {sum(p.stat().st_size for p in out.rglob('*')) / 1e6:.0f} MB of results")
        figure("long_resume_equal", _resumed(folder, amount(3_000, 320)), "of 1", "== 1")
        motion = read_motion(folder / f"{SHORT}-out" / "motion.npz")
        hour, page = _repeated(motion, amount(HOUR, HOUR // 60)), folder / "report.html"
        began = time.process_time()
        write_report(hour, page)
        figure("long_page_108000", page.stat().st_size / 1e6, "MB", "<= 15")
        print(f"  of {len(hour)} frames, in {time.process_time() - began:.1f} s")


def _resumed(folder: Path, frames: int) -> float:
    """1 where a run that was killed halfway, and went on, gives the files of one that was not, all bits alike."""
    take, whole, killed = write_long_take(folder / "resume", frames), folder / "whole", folder / "killed"
    used("track", take, "--out", whole)
    process = begun("track", take, "--out", killed)
    rows = killed / "unfinished" / "so-far.csv"
    while process.poll() is None and not (rows.exists() and rows.read_bytes().count(b"\n") > frames / 2):
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    left = rows.read_bytes().count(b"\n") - 1 if rows.exists() else 0
    print(f"  killed after {left} of {frames} frames; left: {sorted(p.name for p in rows.parent.iterdir())}")
    used("track", take, "--out", killed)
    return float(same_results(whole, killed) and 0 < left < frames and not rows.parent.exists())


def same_results(one: Path, other: Path) -> bool:
    """Whether two folders of results hold the same motion and the same tables, bit for bit."""
    motions = [read_motion(out / "motion.npz") for out in (one, other)]
    names = ("times", "Ts_world_root", "angles", "dof_std", "joint_std", "quality", "segment_quality")
    same = all(np.array_equal(*(getattr(motion, name) for motion in motions)) for name in names)
    tables = [sorted((out / "tables").iterdir()) for out in (one, other)]
    return same and all(a.read_bytes() == b.read_bytes() for a, b in zip(*tables, strict=True))


def _repeated(motion: Motion, frames: int) -> Motion:
    order = np.resize(np.arange(len(motion)), frames)
    fields = ("Ts_world_root", "angles", "dof_std", "joint_std", "quality", "segment_quality")
    arrays = {name: getattr(motion, name)[order] for name in fields}
    residuals = {
        label: replace(r, **{name: getattr(r, name)[order] for name in ("values", "weights", "measured", "swapped")})
        for label, r in motion.residuals.items()
    }  # fmt: skip
    return replace(motion, times=np.arange(frames) / motion.rate, residuals=residuals, **arrays)
