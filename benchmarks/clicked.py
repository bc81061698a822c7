"""Poses from joints that are clicked in three images: drawn clicks, 3 px of noise in each coordinate, seeds 30 to 49.

A humanoid of other lengths than the catalogue's (each group up to 10 %) in a frame of a squat with waving before three
of the studio's cameras, and the drawn arm of `surface_body` before its own. Joints and ends that a person can click.
"""

from __future__ import annotations

import numpy as np

from benchmarks.figures import amount, figure
from benchmarks.surface_body import cameras, moving_arm
from kinefit.bodies import Body, BodyState
from kinefit.geometry.camera import Rig
from kinefit.initialization.from_clicks import clickable, clicked_points, clicked_start
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


if __name__ == "__main__":
    run()
