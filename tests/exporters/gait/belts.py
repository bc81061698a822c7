"""A walk as if on a treadmill, with the forces that its feet put on plates."""

from dataclasses import replace

import numpy as np

from kinefit.exporters.report.feet import feet_alone
from kinefit.geometry.force_plates import ForcePlate

_RATE, _WEIGHT = 1000.0, 440.0  # [Hz], [N]


def on_belt(walk, speed=None):
    """The walk on a belt under it, its velocity (3,) [m/s], and its feet over the ground; default: in place."""
    hips = walk.positions(walk.body.landmarks.select(("l_hip", "r_hip"))).mean(axis=1)
    way = (hips[-1] - hips[0]) * [1.0, 1.0, 0.0] / (walk.times[-1] - walk.times[0])
    belt = -way if speed is None else -speed * way / np.linalg.norm(way)
    roots = np.array(walk.Ts_world_root)
    roots[:, :3, 3] += (walk.times - walk.times[0])[:, None] * belt
    return replace(walk, Ts_world_root=roots, plates=(), events=()), belt, feet_alone(walk)


def foot_forces(motion, foot):
    """Vertical force (N,) [N] and its place (N, 3) [m] under one foot: two humps from contact to toe-off."""
    times = np.arange(motion.times[0], motion.times[-1], 1.0 / _RATE)
    names = [f"{foot.side[0]}_{name}" for name in ("heel", "metatarsal_phalanx_1", "metatarsal_phalanx_5")]
    heel, *balls = np.moveaxis(motion.positions(motion.body.landmarks.select(tuple(names))), 1, 0)
    ends = [
        np.column_stack([np.interp(times, motion.times, axis) for axis in point.T])
        for point in (heel, np.mean(balls, axis=0))
    ]
    force, place = np.zeros(len(times)), np.zeros((len(times), 3))
    for contact in foot.contacts:
        off = min([t for t in foot.offs if t > contact], default=contact + 0.65)
        share = (times - contact) / (off - contact)
        on = (share > 0) & (share < 1)
        hump = np.sin(np.pi * share[on])
        force[on] += _WEIGHT * np.sqrt(hump) * (1.1 - 0.2 * hump**6)
        place[on] = (ends[0] + (ends[1] - ends[0]) * share[:, None])[on]
    return force, place


def plate_of(name, motion, middle, half, parts):
    """A plate about a place (2,) with half sides (2,) [m], on which forces (force, place) act."""
    signs = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    corners = np.column_stack([middle + signs * half, np.zeros(4)])
    force, moment = np.zeros((len(parts[0][0]), 3)), np.zeros((len(parts[0][0]), 3))
    for load, place in parts:
        one = load[:, None] * [0.0, 0.0, 1.0]
        force += one
        moment += np.cross(np.where(load[:, None] > 0, place - corners.mean(axis=0), 0.0), one)
    return ForcePlate(name, corners, _RATE, float(motion.times[0]), force, moment)
