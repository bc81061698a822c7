"""Tracks of simulated takes for `mixed`: which sensors, under which conditions, and how far from the truth.

Every draw is recorded once; its takes (one for each mix of sensors and each condition) name some of its files. What
`kinefit.track_take` makes of a take is kept as errors and standard deviations; what it raises is kept as text.

Conditions: "smoothed" (the default), "frames" (`smooth=False`), "outliers" (20 % of keypoints and markers elsewhere, 20
% of the depth pixels at any depth, a disk of 65 px radius added to or cut from the contour in 20 % of the masks) and
"lost" (one of the mix's sensors sees nothing for 30 frames; the next one in the next draw).
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.mixed.mixed_takes import CAMERAS, MASK_SCALE, Recording, detected, record, take_text, write
from benchmarks.accuracy.video.smoothing import acceleration_noise, peak_speeds
from kinefit import Motion, track_take
from kinefit.bodies import PointSet
from kinefit.exporters.report.moments import DOUBT_DISTANCE_M, contradicted, end_variances, probably_far
from kinefit.simulation.evaluation import angle_errors

MIXES: dict[str, tuple[str, ...]] = {
    "cameras": ("keypoints",),
    "cameras_silhouettes": ("keypoints", "masks"),
    "cameras_depth": ("keypoints", "depth"),
    "cameras_markers": ("keypoints", "markers 4"),
    "all": ("keypoints", "masks", "depth", "markers 4"),
    "markers_alone": ("markers 45",),
    "markers_sparse": ("markers 20",),
    "depth_alone": ("depth",),
    "silhouettes_alone": ("first keypoints", "all masks"),
}
CONDITIONS = ("smoothed", "frames", "outliers", "lost")
LAG = 0.1  # [s] of the condition "lag": each frame knows of later ones so far ahead alone
WRONG, LOST = 0.2, 30  # share, frames
Run = tuple[str, str]  # mix, condition


@dataclass(frozen=True, eq=False)
class Outcome:
    """A tracked take beside its truth; F frames, S segments, D angles.

    Parameters
    ----------
    shift, sigma : (F, S, 3) [m] error of the joint centres and its stated standard deviation
    turn, turn_sigma : (F, D) [rad] the same of angles
    noise : float [m/s²] of the error above 10 Hz (`smoothing`)
    peak : float, speed of hands and feet that a fiftieth of the frames exceed, as a share of the truth
    doubt : (4, F, S) segments of which an end is farther off than 5 cm; how likely that is by the motion; 1 where views
        contradict; 1 where they are lost
    """

    shift: NDArray
    sigma: NDArray
    turn: NDArray
    turn_sigma: NDArray
    noise: float
    peak: float
    doubt: NDArray

    @property
    def passing(self) -> float:
        """[m] root mean square of the errors without each joint's mean error over the take."""
        return float(np.sqrt(np.mean(np.square(self.shift - self.shift.mean(axis=0)))))

    @property
    def distance(self) -> NDArray:
        """(F, S) [m] of the joint centres from the truth."""
        return np.linalg.norm(self.shift, axis=-1)


Told = dict[Run, list[Outcome | str | None]]  # of every draw, in order; None where a draw has not this run


def compare(truth: Motion, motion: Motion) -> Outcome:
    """What is kept of a tracked take."""
    turn = np.radians(angle_errors(truth, motion))  # checks frames, rate and body
    motion = motion if motion.up == truth.up else motion.turned(truth.up)
    shift = motion.segment_poses()[..., :3, 3] - truth.segment_poses()[..., :3, 3]
    few = lambda array: np.asarray(array, np.float32)
    return Outcome(
        few(shift), few(motion.joint_std), few(turn), few(motion.dof_std[:, 6:]),
        acceleration_noise(shift, truth.rate), float(np.median(peak_speeds(motion) / peak_speeds(truth))),
        np.array([
            error_of_ends(truth, motion) > DOUBT_DISTANCE_M, probably_far(end_variances(motion)),
            contradicted(motion), motion.lost,
        ]),
    )  # fmt: skip


def error_of_ends(truth: Motion, motion: Motion) -> NDArray:
    """(F, S) [m] of the end that is farther off: the joint centre, those of the children, or the surface's end."""
    tree, joints = motion.body.tree, np.linalg.norm(motion.joint_centres - truth.joint_centres, axis=-1)
    out = joints.copy()
    for s in range(len(tree.segments)):
        children = np.flatnonzero(tree.parents == s)
        if len(children):
            out[:, s] = np.maximum(joints[:, s], joints[:, children].max(axis=1))
        else:
            tips = [
                m.positions(PointSet(("tip",), np.array([s]), m.body.segment_ends()[s][None]))[:, 0]
                for m in (motion, truth)
            ]
            out[:, s] = np.maximum(joints[:, s], np.linalg.norm(tips[0] - tips[1], axis=-1))
    return out


def streams(mix: str) -> tuple[str, ...]:
    """Sensors of a mix that can be lost."""
    parts = MIXES[mix]
    cameras = CAMERAS if "all masks" in parts else CAMERAS[:2] if "keypoints" in parts else ()
    return (*cameras, *(p for p in parts if p == "depth" or p.startswith("markers")))


def without(recording: Recording, stream: str) -> Recording:
    """The recording with a sensor lost for 30 frames (a third of the take, where that is less), in its middle."""
    count = len(recording.truth)
    lost = min(LOST, count // 3)
    rows = slice((count - lost) // 2, (count + lost) // 2)
    if stream == "depth":
        depth = recording.depth.copy()
        depth[rows] = 0
        return replace(recording, depth=depth)
    if stream.startswith("markers"):
        x = np.array(recording.markers.positions)
        x[rows] = np.nan
        return replace(recording, markers=replace(recording.markers, positions=x))
    camera = CAMERAS.index(stream)
    keypoints, masks = recording.keypoints.copy(), recording.masks.copy()
    keypoints[camera, rows], masks[camera, rows] = 0.0, 0
    return replace(recording, keypoints=keypoints, masks=masks)


def spoiled(recording: Recording, draw: int) -> Recording:
    """The recording with 20 % outliers in every sensor."""
    random = np.random.default_rng([20, draw])
    depth, masks = recording.depth.copy(), recording.masks.copy()
    wrong = random.random(depth.shape) < WRONG
    depth[wrong] = random.integers(500, 5500, int(wrong.sum()))
    for mask in masks.reshape(-1, *masks.shape[2:]):
        edge = np.argwhere(cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)))
        if len(edge) and random.random() < WRONG:
            v, u = edge[random.integers(len(edge))]
            cv2.circle(mask, (int(u), int(v)), round(65 * MASK_SCALE), int(255 * random.integers(2)), -1)
    x = np.array(recording.markers.positions)
    far = random.normal(size=x.shape)
    far *= random.uniform(0.03, 0.3, x.shape[:2])[..., None] / np.linalg.norm(far, axis=-1, keepdims=True)
    x = np.where((random.random(x.shape[:2]) < WRONG)[..., None], x + far, x)
    keypoints = detected(recording.truth, recording.rig, draw, WRONG)
    return replace(
        recording, depth=depth, masks=masks, keypoints=keypoints, markers=replace(recording.markers, positions=x)
    )


def draw_runs(draw: int, frames: int, runs: Sequence[Run]) -> dict[Run, Outcome | str]:
    """Record one draw, and track it in every run."""
    recording, out = record(draw, frames, depth=any("depth" in MIXES[mix] for mix, _ in runs)), {}
    with tempfile.TemporaryDirectory() as work:
        for mix, condition in runs:
            kind = condition if condition in ("outliers", "lost") else "usual"
            stream = streams(mix)[draw % len(streams(mix))]
            folder = Path(work) / (f"lost {stream}" if kind == "lost" else kind)
            if not folder.exists():
                made = {"usual": lambda: recording, "outliers": lambda: spoiled(recording, draw)}
                write(made[kind]() if kind in made else without(recording, stream), folder)
            take = folder / f"{mix}.toml"
            take.write_text(take_text(folder, MIXES[mix]))
            try:
                lag = LAG if condition == "lag" else None
                motion = track_take(take, smooth=condition != "frames", lag=lag)[0]
                out[mix, condition] = compare(recording.truth, motion)
            except Exception as error:  # whatever it is, it is told with the figure
                out[mix, condition] = f"{type(error).__name__}: {error}".replace(work, "")
    return out


def some_of(runs: Sequence[Run], draw: int, each: int | None) -> list[Run]:
    """As many runs of one draw, the next ones in the next draw: all have their turn equally often, in a mixed order."""
    if each is None or each >= len(runs):
        return list(runs)
    mixed = np.random.default_rng(0).permutation(len(runs))
    return [runs[mixed[(draw * each + k) % len(runs)]] for k in range(each)]


def track_draws(
    draws: range, frames: int, runs: Sequence[Run], each: int | None = None, workers: int = 2
) -> Told:  # fmt: skip
    """All runs of all draws, or so many of each, in as many processes of one thread each."""
    os.environ |= dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    told: list[dict[Run, Outcome | str]] = [{} for _ in draws]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        jobs = {pool.submit(draw_runs, draw, frames, some_of(runs, draw, each)): k for k, draw in enumerate(draws)}
        for done, job in enumerate(as_completed(jobs), 1):
            told[jobs[job]] = job.result()
            print(f"  {done} of {len(draws)} draws", end="\r", file=sys.stderr, flush=True)
    return {run: [one.get(run) for one in told] for run in runs}
