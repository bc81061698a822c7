"""A take of two people in view: one squats, the other does so while walking past, and lists change their order."""

import json
from dataclasses import replace
from functools import cache

import numpy as np

from kinefit.readers.calibration.read import write_calibration
from kinefit.simulation import cut, simulate_keypoints, squat_and_wave, studio_rig

COUNT = 40
SET = "BODY_25B"


@cache
def motions():
    """Who stands, and who walks by a metre beside."""
    first = cut(squat_and_wave(), 0, COUNT)
    T = np.array(first.Ts_world_root)
    T[:, 0, 3] += np.linspace(0.9, 1.5, COUNT)
    return first, replace(first, Ts_world_root=T)


def joint_gap(a, b):
    """[m] mean distance of the joints of two motions."""
    return float(np.linalg.norm(a.segment_poses()[..., :3, 3] - b.segment_poses()[..., :3, 3], axis=-1).mean())


def write_take(folder, *, never=()):
    """The take's path; keypoints as OpenPose's JSON, without the points `never` of anybody in any camera."""
    rig = studio_rig(motions()[0])
    write_calibration(rig, folder / "calibration.toml")
    text = f'[take]\nrate = 30.0\nup = "{motions()[0].up}"\n[calibration]\nfile = "calibration.toml"\n'
    each = [simulate_keypoints(m, rig, SET, noise_px=2.0, seed=s) for s, m in enumerate(motions())]
    order, seen = np.random.default_rng(3), ~np.isin(each[0][0].names, never)[:, None]
    for camera, *people in zip(rig.names, *each):
        (folder / camera).mkdir()
        for f in range(COUNT):
            listed = [
                {"person_id": [k], "pose_keypoints_2d": np.nan_to_num(
                    seen * np.column_stack([p.points[f, 0], p.confidence[f, 0]])).ravel().tolist()}
                for k, p in enumerate(people)
            ]  # fmt: skip
            if order.uniform() < 0.5:
                listed.reverse()
            (folder / camera / f"{camera}_{f:012d}_keypoints.json").write_text(json.dumps({"people": listed}))
        text += f'[[camera]]\nname = "{camera}"\n[[keypoints]]\ncamera = "{camera}"\nfile = "{camera}"\n'
        text += f'set = "{SET}"\nsigma = 4.0\n'
    (folder / "take.toml").write_text(text)
    return folder / "take.toml"
