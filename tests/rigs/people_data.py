"""A person who walks about a room and squats, seen by cameras with known poses."""

from dataclasses import replace
from functools import cache

import numpy as np

from kinefit.bodies import load_body
from kinefit.geometry import se3
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig
from kinefit.simulation.retarget import known_motion

BODY = load_body("humanoid")
ERRORS = {"noise_px": 2.0, "outliers": 0.05, "missing": 0.05}


@cache
def walker(frames=45, reach=0.7):
    """A squat on a way round a circle of `reach` [m], turning once; z up, the floor at zero."""
    still = squat_and_wave(BODY, rate=30.0, duration=frames / 30.0)
    turn = 2 * np.pi * np.arange(frames) / frames
    axis = np.zeros((frames, 3))
    axis[:, 2] = turn
    way = np.stack([reach * np.cos(turn), reach * np.sin(turn), 0 * turn], axis=1)
    roots = se3.transform(se3.exp_so3(axis), way) @ still.Ts_world_root
    return replace(known_motion(BODY, 30.0, roots, np.array(still.angles), name="walker"), up="z")


@cache
def room(cameras=4):
    """The rig about the walker, z up."""
    return studio_rig(walker(), cameras=cameras)


@cache
def seen(cameras=4, seed=0):
    """What the detectors saw of the walker."""
    return simulate_keypoints(walker(), room(cameras), "BODY_25B", seed=seed, **ERRORS)


def errors(found, truth):
    """Largest rotation [deg] and position [mm] error of a camera, the rig as a whole laid on the true one."""
    from kinefit.rigs.refine.gauge import aligned

    rig = aligned(found, truth)[0]
    turns = [
        np.linalg.norm(se3.log_so3(a.T_camera_world[:3, :3] @ b.T_camera_world[:3, :3].T))
        for a, b in zip(rig, truth, strict=True)
    ]
    places = [np.linalg.norm(a.centre_world - b.centre_world) for a, b in zip(rig, truth, strict=True)]
    return float(np.degrees(max(turns))), 1e3 * float(max(places))
