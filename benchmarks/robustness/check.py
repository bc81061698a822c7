"""What is wrong with a recording: what `check` names on the real trial, and in recordings without mistakes."""

from __future__ import annotations

import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.video.tracking import DETECTORS, NOISE, take_text
from benchmarks.figures import each, figure, recording
from benchmarks.scenes.balancing import TRIAL
from benchmarks.scenes.motions import library
from kinefit import Keypoints, Motion
from kinefit.fitting.multiview.views import make_views, with_sides_right
from kinefit.rigs.diagnostics.checks import check_keypoints
from kinefit.rigs.diagnostics.timing import time_offsets
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig
from kinefit.takes.check import check_take

FINE = 4  # frames of a recorded motion are one of the take: quarters of a frame are exact then
LATE = (0.5, -0.25, 0.0, 0.0)  # [frames]
SHORTEST = 20  # frames of a take


def shipped(folder: Path, detector: str, where: Path, *, told: bool) -> Path:
    """Take file of the real trial with the calibration as it was shipped; with or without its `image` lines."""
    text = take_text(folder, detector).replace("Calib_refined_static.toml", "calibration/Calib.qca.txt")
    text = text.replace('unit = "m"\n', "")
    text = text if told else re.sub(r"(?m)^image = .*\n", "", text)
    path = where / f"{detector}-{'told' if told else 'untold'}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def real_trial(folder: Path, where: Path) -> None:
    """Biases, letterboxed cameras and exchanged sides of the real trial as it was shipped."""
    for detector in DETECTORS:
        check = check_take(shipped(folder, detector, where, told=True))
        biases = {b.camera: b.bias.round(1).tolist() for b in check.biases}
        named = sorted({name for found in check.findings if found.kind == "bias" for name in found.cameras})
        print(f"# {detector}: biases {biases} px, named {named}")
        sizes = [b.size for b in check.biases if b.camera in named]
        figure(f"check_bias_found_{detector}", max(sizes, default=0.0), "px", ">= 8")
        cam01 = next(b for b in check.biases if b.camera == "cam01")
        figure(f"check_cam01_shift_x_{detector}", float(cam01.bias[0]), "px", "<= -10")
        times = check.times
        if times is not None:
            print(f"# {detector}: cameras late by {times.frames.round(2).tolist()} frames")
    check = check_take(shipped(folder, "mediapipe", where, told=False))
    boxed = sorted({name for found in check.findings if found.kind == "letterboxed" for name in found.cameras})
    print(f"# letterboxed, where the take does not tell: {boxed}")
    right = len({"cam01", "cam02"} & set(boxed)) - len(set(boxed) - {"cam01", "cam02"})
    figure("check_letterboxed_named", float(right), "cameras", "== 2")


def recorded(records: list[Keypoints], late: tuple[float, ...]) -> list[Keypoints]:
    """What cameras that began so many frames later recorded, at a rate `FINE` times lower."""
    first = round(-min(*late, 0.0) * FINE)
    out = []
    for k, frames in zip(records, late, strict=True):
        rows = slice(first + round(frames * FINE), None, FINE)
        out.append(replace(k, points=k.points[rows], confidence=k.confidence[rows], rate=k.rate / FINE))
    length = min(len(k) for k in out)
    return [replace(k, points=k.points[:length], confidence=k.confidence[:length]) for k in out]


def offsets() -> None:
    """Errors of time offsets in recorded motions, fractions of frames and five whole ones."""
    errors: list[float] = []
    stated: list[NDArray] = []
    motions: dict[str, Motion] = {**library(), "squat": squat_and_wave(rate=30.0 * FINE, duration=4.0)}
    for name, truth in motions.items():
        if len(truth) < SHORTEST * FINE:
            continue
        rig = studio_rig(truth)
        seen = simulate_keypoints(truth, rig, seed=len(errors), **NOISE)
        found = time_offsets(with_sides_right(make_views(rig, recorded(seen, LATE))))
        off = found.frames - (np.array(LATE) - np.median(LATE))
        errors.append(float(np.max(np.abs(off))))
        stated.append(off / (found.std * found.rate))
        print(f"# {name}: late by {found.frames.round(2).tolist()} frames, largest error {errors[-1]:.3f}")
    print(f"# errors in stated standard errors: root mean square {np.sqrt(np.nanmean(np.square(stated))):.1f}")
    figure("check_time_offset_median", float(np.median(errors)), "frame", "<= 0.1")
    figure("check_time_offset_worst", float(np.max(errors)), "frame", "<= 0.1")


def false_alarms() -> None:
    """Recordings without mistakes."""
    alarms = doubts = 0
    numbered = ((seed, name, motion) for seed, (name, motion) in enumerate(library().items()))
    clean = [(0, "squat", squat_and_wave(duration=4.0)), *numbered]
    for seed, name, motion in clean:
        rig = studio_rig(motion)
        check = check_keypoints(rig, simulate_keypoints(motion, rig, seed=seed, **NOISE), up=motion.up)
        told = [f"{f.severity} {f.kind}" for f in check.findings if f.severity in ("fault", "doubt")]
        alarms, doubts = alarms + len(check.faults), doubts + len(told) - len(check.faults)
        if told:
            print(f"# {name}, without mistakes: {', '.join(told)}")
    figure("check_false_alarms", float(alarms), "faults", "== 0")
    print(f"# {doubts} doubts in {len(clean)} recordings without mistakes")


def run() -> None:
    """Print every figure of check."""
    with tempfile.TemporaryDirectory() as where:
        each(lambda: real_trial(recording(TRIAL), Path(where)), offsets, false_alarms)
