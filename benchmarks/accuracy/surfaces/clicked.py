"""Poses from joints that are clicked in three images: drawn clicks, 3 px of noise in each coordinate, seeds 30 to 49.

A humanoid of other lengths than the catalogue's (each group up to 10 %) in a frame of a squat with waving before three
of the studio's cameras, and the drawn arm of `surface_body` before its own. Joints and ends that a person can click.

Then the clicks of `video_bodies` alone, 2 px in its scene, seeds 12 to 23: the frame that is clicked, before anything
is followed from it, and the same without the knuckles.
"""

from __future__ import annotations

import numpy as np

from benchmarks.accuracy.surfaces.surface_body import cameras, moving_arm
from benchmarks.accuracy.surfaces.video_bodies import CLICKS, SETUPS, another
from benchmarks.accuracy.surfaces.video_bodies import cameras as cameras_of_video
from benchmarks.figures import amount, figure
from kinefit.bodies import Body, BodyState, load_body
from kinefit.fitting.initialization.from_points import clickable, clicked_points, clicked_start
from kinefit.geometry.camera import Rig
from kinefit.geometry.se3 import log_so3
from kinefit.simulation import squat_and_wave, studio_rig

NOISE = 3.0  # [px]
BENDS = {"humanoid": ("knee_angle_r", "knee_angle_l", "elbow_flex_r", "elbow_flex_l"), "arm": ("elbow_flex_r",)}


def run() -> None:
    """Print the figures."""
    motion, studio = squat_and_wave(), Rig(studio_rig().cameras[:3])
    for name in BENDS:
        joints, bends = [], []
        for seed in range(30, amount(50, 33)):
            rng = np.random.default_rng(seed)
            if name == "humanoid":
                body = motion.body.scaled(1.0 + 0.1 * rng.uniform(-1, 1, len(motion.body.scale_groups)))
                of, state, rig = body, motion.state(int(rng.integers(len(motion)))), studio
            else:
                moving = moving_arm(seed, 1)
                of, state, rig = moving.body, moving.state(0), cameras(640)
            far, off = _errors(motion.body if name == "humanoid" else of, of, state, rig, rng, BENDS[name])
            joints.append(far)
            bends.append(off)
        figure(f"clicked_{name}_joints", 100 * float(np.median(joints)), "cm, median of the worst joint", "<= 3")
        figure(f"clicked_{name}_bends", float(np.sqrt(np.mean(np.square(bends)))), "deg RMS, knees and elbows", "<= 5")
    turns, joints = np.transpose([_of_video(seed, "") for seed in range(12, amount(24, 14))])
    figure("clicked_video_forearms", float(turns.max()), "deg, worst of 24 forearms", "<= 12")
    figure("clicked_video_joints", 1e3 * float(joints.max()), "mm, worst joint", "<= 60")
    turns, _ = np.transpose([_of_video(seed, "metacarpal") for seed in range(12, amount(24, 14))])
    figure("clicked_video_forearms_no_knuckles", float(turns.max()), "deg, worst of 24 forearms", ">= 12")


def _of_video(seed: int, without: str) -> tuple[float, float]:
    """[deg] of the worse forearm and [m] of the worst point of a whole body, from clicks but for those named so."""
    rig, motion = cameras_of_video(SETUPS["body"]), another("humanoid", seed, 30)
    rng, body, state, names = np.random.default_rng([seed, 1]), motion.body, motion.state(0), clickable(motion.body)
    x = body.positions(state, body.landmarks.select(names))
    uv = np.stack([camera.project(x) for camera in rig], axis=1) + CLICKS * rng.normal(size=(len(x), len(rig), 2))
    given = [k for k, name in enumerate(names) if not without or without not in name]
    chosen = [names[k] for k in given]
    fitted, found, _ = clicked_start(load_body("humanoid"), chosen, *clicked_points(rig, chosen, uv[given]))
    R, truth = (b.tree.forward(s.T_world_root, s.angles)[0][:, :9].reshape(-1, 3, 3)
                for b, s in ((fitted, found), (body, state)))  # fmt: skip
    turned = np.degrees(np.linalg.norm(log_so3(R @ truth.swapaxes(-1, -2)), axis=-1))
    off = np.linalg.norm(fitted.positions(found, fitted.landmarks.select(names)) - x, axis=1)
    return max(float(turned[body.tree.segments.index(f"forearm_{side}")]) for side in "rl"), float(off.max())


def _errors(
    generic: Body, truth: Body, state: BodyState, rig: Rig, rng: np.random.Generator, bends: tuple[str, ...]
) -> tuple[float, list[float]]:
    """[m] of the worst of all clicked points, [deg] of the bends."""
    names = clickable(truth)
    x = truth.positions(state, truth.landmarks.select(names))
    uv = np.stack([c.project(x) + NOISE * rng.normal(size=(len(x), 2)) for c in rig], axis=1)
    body, found, _ = clicked_start(generic, names, *clicked_points(rig, names, uv))
    there = body.positions(found, body.landmarks.select(names))
    off = [np.degrees(found.angles - state.angles)[truth.tree.coordinate(bend)] for bend in bends]
    return float(np.linalg.norm(there - x, axis=1).max()), [float(v) for v in off]
