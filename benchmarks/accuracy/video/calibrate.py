"""Cameras from the people in view: refined, and from nothing. `python -m benchmarks video calibrate`.

On the real balancing trial the shipped calibration is the start; points of the scene read by hand, which no refinement
was given, tell how good the result is. On recorded motions projected into four cameras the truth is known.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.video.static_points import static_residual
from benchmarks.accuracy.video.tracking import (
    DETECTORS,
    NOISE,
    Trial,
    held_out,
    median_residual,
    middle,
    read_trial,
)
from benchmarks.figures import amount, each, figure, whole_recording
from benchmarks.scenes.balancing import TRIAL
from benchmarks.scenes.motions import library
from benchmarks.timing import took
from kinefit import Keypoints, Motion, Recording, Rig, load_body, track
from kinefit.geometry import se3
from kinefit.geometry.lines import triangulate
from kinefit.readers.calibration.read import read_calibration
from kinefit.rigs.people.calibrate import calibrate_people
from kinefit.rigs.refine.gauge import aligned
from kinefit.rigs.refine.refine import refine
from kinefit.rigs.refine.result import Refinement
from kinefit.simulation import cut, simulate_keypoints, studio_rig

RESIDUAL = {"openpose": 7.0, "mediapipe": 9.0}
MOTIONS = ["wash 02_10", "jumping jacks 13_30", "reach 14_20", "twists and squats 13_30", "lift 02_06", "bend 02_06"]
LATE = (0.0, 0.4, -1.7, 5.0)  # frames that each camera's clock is late
FOCAL = (1.02, 0.98, 1.02, 0.98)
_LONGEST, _DISTANCE, _SURE = amount(600, 30), 5.0, 0.3  # frames; [m]; confidence


def agreement(rig: Rig, motion: Motion, keypoints: tuple[Keypoints, ...]) -> float:
    """[px] median distance of sure keypoints from their triangulation, in every camera; person and sides as tracked."""
    uv = np.stack([motion.residuals[name].measured for name in rig.names], axis=2)
    sure = []
    for record, name in zip(keypoints, rig.names, strict=True):
        columns = [record.names.index(n) for n in motion.residuals[name].names]
        sure.append(record.confidence[:, :, columns].max(axis=1))
    weight = np.stack(sure, axis=2)
    uv = np.where((weight > _SURE)[..., None], uv, np.nan).reshape(-1, len(rig), 2)
    x = triangulate(rig, uv, weight.reshape(-1, len(rig)))
    return float(np.nanmedian(np.linalg.norm(np.stack([c.project(x) for c in rig], axis=1) - uv, axis=-1)))


def distance_px(rig: Rig, other: Rig, motion: Motion) -> float:
    """[px] median distance between where two rigs see the person, one laid on the other as a whole."""
    rig, x = aligned(rig, other)[0], motion.positions().reshape(-1, 3)
    return float(np.nanmedian([np.linalg.norm(a.project(x) - b.project(x), axis=-1) for a, b in zip(rig, other)]))


def real_trial(folder: Path, where: Path) -> None:
    """The shipped calibration refined, the good one refined, and none at all."""
    shipped = read_calibration(folder / "calibration/Calib.qca.txt")
    good = read_calibration(folder / "Calib_refined_static.toml")
    body = load_body("humanoid")
    for detector in DETECTORS:
        trial = read_trial(folder, detector, where)
        goal = f"<= {RESIDUAL[detector]:g}"
        found, seconds = took(partial(refine, shipped, trial.keypoints, body))
        for line in found.summary_lines():
            print(f"# {detector}: {line}")
        after = track(Recording.of_keypoints(found.rig, trial.keypoints), body)
        figure(f"refine_residual_{detector}", agreement(found.rig, after, trial.keypoints), "px", goal)
        figure(f"refine_body_residual_{detector}", median_residual(after), "px", goal)
        errors = held_out(Trial(trial.take, found.rig, trial.keypoints), after)
        outside = middle(np.concatenate([e.reshape(-1, 2) for e in errors.values()]))
        figure(f"refine_held_out_{detector}", outside / median_residual(after), "x", "<= 1.4")
        figure(f"refine_static_{detector}", static_residual(found.rig), "px", "<= 3")
        again = refine(good, trial.keypoints, body)
        figure(f"refine_static_from_good_{detector}", static_residual(again.rig), "px", "<= 3")
        figure(f"refine_seconds_{detector}", seconds, "s", "<= 20")
        alone = calibrate_people(tuple(shipped), trial.keypoints, body)
        figure(f"people_real_{detector}", distance_px(alone.rig, found.rig, found.motion), "px", "<= 6")


def delayed(record: Keypoints, frames: float) -> Keypoints:
    """The keypoints of a camera whose clock is late by some frames: it sees what comes."""
    at = np.clip(np.arange(len(record)) + frames, 0, len(record) - 1)
    low = np.minimum(at.astype(int), len(record) - 2)
    share = (at - low)[:, None, None]
    points = (1 - share[..., None]) * record.points[low] + share[..., None] * record.points[low + 1]
    return replace(record, points=points, confidence=np.minimum(record.confidence[low], record.confidence[low + 1]))


def spoilt(record: Keypoints, random: np.random.Generator) -> Keypoints:
    """Exact keypoints with the errors of NOISE."""
    shape = record.confidence.shape
    wrong, lost = random.random(shape) < NOISE["outliers"], random.random(shape) < NOISE["missing"]
    angle, reach = random.uniform(0, 2 * np.pi, shape), random.uniform(20.0, 200.0, shape)
    jump = np.where(wrong, reach, 0.0)[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    points = record.points + NOISE["noise_px"] * random.standard_normal(record.points.shape) + jump
    confidence = np.where(lost | (record.confidence == 0), 0.0, np.where(wrong, 0.55, 0.8))
    return replace(record, points=np.where(lost[..., None], np.nan, points), confidence=confidence)


def camera_errors(found: Rig, truth: Rig, centre: NDArray) -> tuple[list[float], list[float]]:
    """Rotation [deg] and position [mm at 5 m] of every camera, the rig laid on the true one as a whole."""
    rig = aligned(found, truth)[0]
    turns, places = [], []
    for a, b in zip(rig, truth, strict=True):
        turn = se3.log_so3(a.T_camera_world[:3, :3] @ b.T_camera_world[:3, :3].T)
        turns.append(float(np.degrees(np.linalg.norm(turn))))
        away = np.linalg.norm(b.centre_world - centre)
        places.append(float(1e3 * np.linalg.norm(a.centre_world - b.centre_world) * _DISTANCE / away))
    return turns, places


def synthetic() -> None:
    """Recorded motions seen by four cameras whose poses, then also focal lengths, then also clocks, are unknown."""
    turns: list[float] = []
    places: list[float] = []
    focal: list[float] = []
    clocks: list[float] = []
    body = load_body("humanoid")
    for name, truth in library(amount(MOTIONS, ["jumping jacks 13_30"])).items():
        motion = cut(truth, 0, min(len(truth), _LONGEST))
        rig, centre = studio_rig(motion), motion.Ts_world_root[:, :3, 3].mean(axis=0)
        options = {"up": motion.up, "sigma": NOISE["noise_px"]}
        seen = simulate_keypoints(motion, rig, seed=1, **NOISE)
        turn, place = camera_errors(calibrate_people(tuple(rig), seen, body, **options).rig, rig, centre)
        scale = [np.array([[f, 1, 1], [1, f, 1], [1, 1, 1]]) for f in FOCAL]
        wrong = tuple(replace(c, matrix=c.matrix * s) for c, s in zip(rig, scale, strict=True))
        found: Refinement = calibrate_people(wrong, seen, body, focal=True, **options)
        lens = [100 * abs(a.matrix[0, 0] / b.matrix[0, 0] - 1) for a, b in zip(found.rig, rig, strict=True)]
        random = np.random.default_rng(0)
        exact = simulate_keypoints(motion, rig, noise_px=0, outliers=0, missing=0)
        late = [spoilt(delayed(k, f), random) for k, f in zip(exact, LATE, strict=True)]
        found = calibrate_people(tuple(rig), late, body, time_offsets=True, **options)
        clock = [abs(t * motion.rate - f) for t, f in zip(found.time_offsets.values(), LATE, strict=True)]
        turns, places, focal, clocks = turns + turn, places + place, focal + lens, clocks + clock[1:]
        print(
            f"# {name}, {len(motion)} frames: rotation {np.round(turn, 3)} deg, position {np.round(place, 1)} mm, "
            f"focal length {np.round(lens, 2)} %, clocks {np.round(clock[1:], 3)} frames", flush=True,
        )  # fmt: skip
    absent = "the recorded motions are absent"
    for what, values, unit, goal in (
        ("rotation", turns, "deg", "<= 0.1"), ("position", places, "mm at 5 m", "<= 5"),
        ("focal", focal, "%", "<= 0.3"), ("time_offset", clocks, "frames", "<= 0.1"),
    ):  # fmt: skip
        figure(f"people_{what}", float(np.sqrt(np.mean(np.square(values)))) if values else None, unit, goal, absent)


def run() -> None:
    """Print every figure of calibration from people."""
    with tempfile.TemporaryDirectory() as where:
        each(lambda: real_trial(whole_recording(TRIAL), Path(where)), synthetic)
