"""Random turns of the head and what a face does, with truth, by `kinefit track` with its defaults.

Simulated: a person whose lengths differ by 5 % from the catalogue's stands, sways and turns the head. The detector's
points err as those of `hands_simulated` do: 8 mm from the anatomical ones, 2 px of jitter, 1 px of drift that lasts
0.3 s, 3 % elsewhere, 5 % missing. Four cameras around the person see all of it; or one alone, with the stature stated
and depths against the hips, wrong by 5 cm for the points of a segment together (0.5 s) and by 2 cm each.
A turn's error is of the head in the world, about its own axes. Error bars are stated of the neck's angles against the
trunk: their share inside is of these.

Of the face: a face mesh beside, from four cameras 1.5 m away (a face is some 150 px high); each point stands 2 mm from
its place on this face, those of an eye 1.5 mm together; left and right alike.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.hands.hands_simulated import near_rig, somebody, tracked
from benchmarks.figures import amount, figure
from benchmarks.scenes.simulated import with_points_off
from kinefit import Keypoints, Motion, Recording, Rig, load_body, track
from kinefit.geometry import se3
from kinefit.sensors.points.lifted import HIPS
from kinefit.simulation import simulate_keypoints, studio_rig
from kinefit.simulation.evaluation import angle_errors
from kinefit.simulation.keypoints import drift
from kinefit.simulation.retarget import known_motion

POSE, FACE = "MEDIAPIPE_33", "MEDIAPIPE_478"
ERRORS = {"noise_px": 2.0, "drift_px": 1.0, "drift_time": 0.3, "outliers": 0.03, "missing": 0.05}
_SEEDS = (10, 11, 12, 13)
_RATE, _SECONDS = 30.0, 4.0
_NECK = ["neck_rotation", "neck_extension", "neck_bending"]
_SWINGS = {
    "neck_rotation": 40, "neck_extension": 20, "neck_bending": 15, "thorax_rotation": 8, "lumbar_bending": 4,
    "arm_flex_r": 20, "arm_flex_l": 20, "elbow_flex_r": 25, "elbow_flex_l": 25,
}  # fmt: skip
JAW, GAZE = "jaw_opening", ("eye_abduction_r", "eye_abduction_l", "eye_elevation_r", "eye_elevation_l")


def head_moving(seed: int, body_name: str = "humanoid", *, seconds: float = _SECONDS) -> Motion:
    """A person who stands and turns the head at random, with a face speaks and looks about; known exactly."""
    random, body = np.random.default_rng(seed), load_body(body_name)
    tree, t = body.tree, np.arange(round(seconds * _RATE)) / _RATE
    angles = np.tile(np.degrees(tree.usual), (len(t), 1))

    def wave() -> NDArray:
        return np.sin(2 * np.pi * random.uniform(0.2, 0.6) * t + random.uniform(0, 2 * np.pi))

    for name, swing in _SWINGS.items():
        angles[:, tree.coordinate(name)] += swing * wave()
    if JAW in tree.coordinates:
        sideways, upwards = 20 * wave(), 12 * wave()
        for name, values in zip((JAW, *GAZE), (20 * np.maximum(wave(), 0.0), sideways, -sideways, upwards, upwards)):
            angles[:, tree.coordinate(name)] = values
    angles = np.clip(np.radians(angles), tree.lower, tree.upper)
    roots = np.tile(se3.transform(np.eye(3), np.array([0.0, 0.95, 0.0])), (len(t), 1, 1))
    return known_motion(body, _RATE, roots, angles, name="head")


def with_own_face(truth: Motion, seed: int) -> Motion:
    """The motion, of a face whose points stand 2 mm elsewhere; those of an eye 1.5 mm together and 0.5 mm each."""
    random, segments, points = np.random.default_rng(seed), truth.body.tree.segments, truth.body.keypoints(FACE)
    eye = np.array([segments[s].startswith("eye") for s in points.segments])[:, None]
    shift = np.where(eye, 0.0005, 0.002) * random.normal(size=(len(points), 3))
    shift = shift + np.where(eye, 0.0015, 0.0) * random.normal(size=3)
    return replace(truth, body=with_points_off(truth.body, FACE, shift))


def _with_depth(truth: Motion, rig: Rig, record: Keypoints, seed: int) -> Keypoints:
    """What a network that lifts landmarks to space gives beside, in a size 5 % too small."""
    random, points = np.random.default_rng(seed), truth.body.keypoints(POSE)
    order = [points.names.index(name) for name in record.names]
    x = truth.positions(points)[:, order]
    hips = x[:, [record.names.index(name) for name in HIPS]].mean(axis=1, keepdims=True)
    lifted = 0.95 * (x - hips) @ rig.cameras[0].T_camera_world[:3, :3].T
    shared = drift((len(x), len(truth.body.tree.segments)), np.exp(-1.0 / (0.5 * _RATE)), random)
    lifted[..., 2] += 0.05 * shared[:, points.segments[order]] + 0.02 * random.normal(size=lifted.shape[:2])
    lifted[np.isnan(record.points[:, 0]).any(axis=-1)] = np.nan
    return replace(record, lifted=lifted[:, None])


def _turns(truth: Motion, motion: Motion) -> NDArray:
    """(F, 3) [deg] error of the head's turn about its vertical axis, that across and that to the front."""
    head = truth.body.tree.segment("head")
    a, b = (m.segment_poses()[:, head, :3, :3] for m in (truth, motion))
    return np.abs(np.degrees(se3.log_so3(a.swapaxes(-1, -2) @ b)))[:, (1, 2, 0)]


def _scores(truth: Motion, motion: Motion, names: list[str]) -> tuple[NDArray, NDArray]:
    """(F, K) error [deg] of angles, and whether it lies within the 95 % bars."""
    columns = [truth.body.tree.coordinate(name) for name in names]
    error = np.abs(angle_errors(truth, motion))[:, columns]
    return error, error <= 1.96 * np.degrees(motion.dof_std[:, 6:][:, columns])


def run() -> None:
    """Print every figure."""
    seconds = amount(_SECONDS, 1.0)
    for cameras, what in ((4, "turn"), (1, "turn_one_camera")):
        turns, neck, inside = [], [], []
        for seed in amount(_SEEDS, _SEEDS[:1]):
            truth = somebody(head_moving(seed, seconds=seconds), seed, POSE)
            rig = studio_rig(truth, cameras=cameras)
            seen = simulate_keypoints(truth, rig, POSE, seed=seed, **ERRORS)
            if cameras == 1:
                recording = Recording.of_keypoints(rig, [_with_depth(truth, rig, seen[0], seed)], up="y")
                motion = track(recording, load_body("humanoid"), height=truth.body.stature)
            else:
                with tempfile.TemporaryDirectory() as folder:
                    motion = tracked(rig, seen, Path(folder), "humanoid")
            turns.append(_turns(truth, motion))
            for to, values in zip((neck, inside), _scores(truth, motion, _NECK)):
                to.append(values)
        for name, value in zip(("vertical", "nod", "tilt"), np.concatenate(turns).mean(axis=0)):
            figure(f"head_{what}_{name}", float(value), "deg", "<= 2")
        figure(f"head_{what}_neck", float(np.concatenate(neck).mean()), "deg", "<= 2")
        share = 100.0 * float(np.concatenate(inside).mean())
        figure(f"head_{what}_inside_least", share, "%", ">= 90")
        figure(f"head_{what}_inside_most", share, "%", "<= 98")
    found = []
    for seed in amount(_SEEDS, _SEEDS[:1]):
        truth = with_own_face(somebody(head_moving(seed, "humanoid_face", seconds=seconds), seed, POSE), seed)
        rig = near_rig(truth, ("sellion", "suprasternale"))
        seen = [*simulate_keypoints(truth, rig, POSE, seed=seed, **ERRORS),
                *simulate_keypoints(truth, rig, FACE, seed=seed + 100, **ERRORS)]  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            motion = tracked(rig, seen, Path(folder), "humanoid_face")
        found.append(_scores(truth, motion, [JAW, *GAZE]))
    error, inside = (np.concatenate([one[k] for one in found]) for k in (0, 1))
    figure("face_jaw", float(error[:, 0].mean()), "deg", "<= 3")
    figure("face_gaze", float(error[:, 1:].mean()), "deg", "<= 3")
    for limit, goal in (("least", ">= 90"), ("most", "<= 98")):
        figure(f"face_jaw_inside_{limit}", 100.0 * float(inside[:, 0].mean()), "%", goal)
        figure(f"face_gaze_inside_{limit}", 100.0 * float(inside[:, 1:].mean()), "%", goal)
