"""What is wrong with a recording: what `check` names on the real trial, and of mistakes made on purpose."""

from __future__ import annotations

import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import data, figure
from benchmarks.motions import library
from benchmarks.tracking import DETECTORS, NOISE, TRIAL, take_text
from kinefit import Keypoints, Motion, Rig
from kinefit.fitting.multiview.views import make_views, with_sides_right
from kinefit.rigs.diagnostics.checks import Checked, check_keypoints
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


def faults(rig: Rig, seen: list[Keypoints], up: str) -> Checked:
    """A check of simulated keypoints."""
    return check_keypoints(rig, seen, up=up)


def mistakes() -> None:
    """Mistakes made on purpose, and recordings with none."""
    truth = squat_and_wave(duration=4.0)
    rig = studio_rig(truth)
    seen = simulate_keypoints(truth, rig, **NOISE)
    alarms = len(faults(rig, seen, truth.up).faults)
    doubts = 0
    clean = list(library().items())
    for number, (name, motion) in enumerate(clean):
        studio = studio_rig(motion)
        check = faults(studio, simulate_keypoints(motion, studio, seed=number, **NOISE), motion.up)
        told = [f"{f.severity} {f.kind}" for f in check.findings if f.severity in ("fault", "doubt")]
        alarms, doubts = alarms + len(check.faults), doubts + len(told) - len(check.faults)
        if told:
            print(f"# {name}, without mistakes: {', '.join(told)}")
    figure("check_false_alarms", float(alarms), "faults", "== 0")
    print(f"# {doubts} doubts in {len(clean) + 1} recordings without mistakes")
    order = ("cam03", "cam02", "cam01", "cam04")
    swapped = faults(rig, [replace(k, camera=name) for k, name in zip(seen, order, strict=True)], truth.up)
    found = [f for f in swapped.faults if f.kind == "swapped" and set(f.cameras) == {"cam01", "cam03"}]
    figure("check_swapped_cameras_found", float(len(found)), "", "== 1")
    ceiling = faults(rig.moved(np.diag([1.0, -1.0, -1.0, 1.0])), seen, truth.up)
    figure("check_mirrored_found", float(sum(f.kind == "up" for f in ceiling.faults)), "", "== 1")
    late = [replace(k, points=k.points[5:], confidence=k.confidence[5:]) if k.camera == "cam02" else k for k in seen]
    late = [replace(k, points=k.points[: len(late[1])], confidence=k.confidence[: len(late[1])]) for k in late]
    times = [f for f in faults(rig, late, truth.up).faults if f.kind == "time" and f.cameras == ("cam02",)]
    figure("check_five_frames_found", float(len(times)), "", "== 1")


def run() -> None:
    """Print every figure of check."""
    folder = data(TRIAL)
    if folder is None:
        for detector in DETECTORS:
            figure(f"check_bias_found_{detector}", None, "px", ">= 8", "the real trial is absent")
    else:
        with tempfile.TemporaryDirectory() as where:
            real_trial(folder, Path(where))
    offsets()
    mistakes()


if __name__ == "__main__":
    run()
