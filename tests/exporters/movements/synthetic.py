"""Movements over feet that stand: crouching to a posture and rising again."""

from dataclasses import replace

import numpy as np

from kinefit.bodies import load_body
from kinefit.geometry import se3
from kinefit.simulation import known_motion

RATE = 100.0  # [Hz]
SQUAT = {"hip": 95.0, "knee": 105.0, "ankle": 30.0, "lean": 40.0}  # [deg]
SEAT = {"hip": 90.0, "knee": 90.0, "ankle": 0.0, "lean": 0.0}


def crouching(share, posture):
    """A person who is between standing (0) and a posture (1) by a share (F,), with the heels where they are."""
    body, share = load_body("humanoid"), np.asarray(share)
    angles = np.zeros((len(share), len(body.tree.coordinates)))
    for side in "lr":
        for name, joint in (("hip_flexion", "hip"), ("knee_angle", "knee"), ("ankle_angle", "ankle")):
            angles[:, body.tree.coordinate(f"{name}_{side}")] = np.radians(posture[joint]) * share
    R = se3.exp_so3(np.outer(-np.radians(posture["lean"]) * share, [0.0, 0.0, 1.0]))
    motion = known_motion(body, RATE, se3.transform(R, np.zeros((len(share), 3))), angles)
    heels = motion.positions(body.landmarks.select(("l_heel", "r_heel"))).mean(axis=1)
    roots = np.array(motion.Ts_world_root)
    roots[:, :3, 3] -= heels
    return replace(motion, Ts_world_root=roots)


def times_down(count, *, rest=0.8, down=0.7, hold=0.4):
    """Share (F,) that goes down and up a number of times, with a rest between."""
    t = np.arange(round((rest + count * (2 * down + hold + rest)) * RATE)) / RATE
    at = [0.0]
    level = [0.0]
    for _ in range(count):
        for step, to in ((rest, 0.0), (down, 1.0), (hold, 1.0), (down, 0.0)):
            at.append(at[-1] + step)
            level.append(to)
    smooth = np.interp(t, at, level)
    return 0.5 - 0.5 * np.cos(np.pi * smooth)


def jumping(speed=2.5):
    """A person, stiff as a board, who pushes off to a speed [m/s], flies and brakes on landing; and the flight [s]."""
    g, flight = 9.81, 2.0 * speed / 9.81
    push = (speed + 0.03 * g) / 0.205  # [m/s²] so that the push and the landing end at the speeds of the flight
    knots = np.cumsum([1.0, 0.05, 0.15, 0.06, flight, 0.06, 0.15, 0.05])
    motion = crouching(np.zeros(round((knots[-1] + 1.0) * RATE)), SQUAT)
    t = np.arange(0.0, motion.times[-1] + 1e-9, 1e-4)
    up = np.cumsum(np.cumsum(np.interp(t, knots, [0.0, push, push, -g, -g, push, push, 0.0]))) * 1e-8
    roots = np.array(motion.Ts_world_root)
    roots[:, 1, 3] += np.interp(motion.times, t, up)
    return replace(motion, Ts_world_root=roots), flight
