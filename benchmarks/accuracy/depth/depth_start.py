"""A start with no pose given, on rendered truth: postures found, limbs found again, the person's size."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import amount, figure
from benchmarks.timing import timed

_POSES, _NEAR = amount(16, 2), 0.1  # [m] a joint this near its true place is found
_PEOPLE = amount(20, 1)
_NEARLY, _MOST = 0.15, 0.8  # [m] of a start that tracking can go on from, this share of joints is so near
_UP = np.array([0.0, 1.0, 0.0])


def run() -> None:
    """Print the figures."""
    from kinefit import load_body

    body = load_body("humanoid10")
    _recovered(body)
    for name in ("tof", "kinect"):
        _movements(name)
    _size(body)


def random_state(body: Any, rng: np.random.Generator, *, sitting: bool) -> Any:
    """Somebody who stands or sits, arms any way in front, at the side or raised, turned by up to 60° either way."""
    from kinefit.bodies import BodyState

    angles, tree = np.array(body.tree.usual), body.tree
    ranges = {"arm_flex": (-30, 150), "arm_add": (-100, 5), "arm_rot": (-60, 60), "elbow_flex": (0, 120)}
    ranges |= {"hip_flexion": (-15, 35), "knee_angle": (0, 40), "hip_adduction": (-25, 5)}
    if sitting:
        ranges |= {"hip_flexion": (70, 100), "knee_angle": (60, 100), "hip_adduction": (-20, 5)}
    for name, (low, high) in ranges.items():
        for side in "rl":
            angles[tree.coordinate(f"{name}_{side}")] = np.radians(rng.uniform(low, high))
    for name, most in (("neck_extension", 20), ("neck_rotation", 30)):
        angles[tree.coordinate(name)] = np.radians(rng.uniform(-most, most))
    yaw, lean = np.radians(rng.uniform(-60, 60)), np.radians(rng.uniform(-5, 15))
    f = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    y = np.cos(lean) * _UP + np.sin(lean) * f
    z = np.cross(f, y) / np.linalg.norm(np.cross(f, y))
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    T[:3, 3] = rng.uniform(-0.4, 0.4), 0.55 if sitting else 0.95, rng.uniform(-0.4, 0.4)
    return BodyState(T, np.clip(angles, tree.lower, tree.upper))


def camera_in_front(sensor: Any) -> Any:
    """The sensor's camera, 1.1 m high, 3 m in front of the origin."""
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = -T[:3, :3] @ [0.0, 1.1, 3.0]
    return sensor.camera(T)


def seen(body: Any, states: list[Any], camera: Any, sensor: Any, *, room: bool) -> list[NDArray]:
    """The depth image of each state."""
    from kinefit.simulation.rendering.sensors import simulate_depth
    from kinefit.simulation.retarget import known_motion

    roots, angles = np.array([s.T_world_root for s in states]), np.array([s.angles for s in states])
    video = simulate_depth(known_motion(body, 1.0, roots, angles), camera, sensor, room=room)
    return [video.frame(k).depth for k in range(len(states))]


def joints(body: Any, state: Any) -> NDArray:
    """(K, 3) [m] joint centres, wrists, ankles and the top of the head."""
    names = [n for n in body.landmarks.names if n.endswith(("_wrist", "_ankle")) or n == "skull_vertex"]
    poses = body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0]
    return np.concatenate([poses[:, :3, 3], body.positions(state, body.landmarks.select(tuple(names)))])


def _recovered(body: Any) -> None:
    from kinefit.fitting.initialization.from_depth import start_from_points
    from kinefit.simulation.rendering.sensors import KINECT

    camera = camera_in_front(KINECT)
    for room, suffix in ((False, ""), (True, "_room")):
        count = _POSES if not room else _POSES // 2
        seats = [bool(i % 2) and not room for i in range(count)]
        truth = [random_state(body, np.random.default_rng(100 + i), sitting=seat) for i, seat in enumerate(seats)]
        found, spent = [], []
        for depth, state in zip(seen(body, truth, camera, KINECT, room=room), truth):
            with timed(spent):
                start = start_from_points(body, None, camera, depth, up=_UP)[0]
            found.append(np.linalg.norm(joints(body, start.state) - joints(body, state), axis=1) < _NEAR)
        rate = np.mean(found, axis=1)
        figure(f"start_recovered{suffix}", float(np.mean(rate)), f"of joints within 100 mm, {count} poses", ">= 0.9")
        if not room:
            figure("start_recovered_standing", float(np.mean(rate[0::2])), "of joints", ">= 0.9")
            figure("start_recovered_sitting", float(np.mean(rate[1::2])), "of joints", ">= 0.9")
            figure("start_seconds", float(np.median(spent)), "s CPU", "<= 3")


def _movements(sensor: str) -> None:
    """Twenty people in the midst of ten movements, in a room with a table, as a sensor of that kind sees them."""
    from kinefit.fitting.initialization.from_depth import start_from_points

    found = []
    for person, state, camera, depth in moving(sensor, _PEOPLE):
        start = start_from_points(person, None, camera, depth, up=_UP)[0]
        found.append(np.linalg.norm(joints(person, start.state) - joints(person, state), axis=1))
    error = np.array(found)
    good = np.mean(error < _NEARLY, axis=1) >= _MOST
    figure(f"start_{sensor}", float(np.mean(good)), f"of {len(good)} starts with 80 % of joints to 150 mm", ">= 0.8")
    figure(f"start_{sensor}_100", float(np.mean(error < _NEAR)), "of joints within 100 mm", ">= 0.8")
    figure(f"start_{sensor}_150", float(np.mean(error < _NEARLY)), "of joints within 150 mm", ">= 0.8")


def moving(sensor: str, count: int) -> Iterator[tuple[Any, Any, Any, NDArray]]:
    """Body, state, camera and depth image of people of all sizes in movements, every fourth at its beginning."""
    from kinefit.simulation.figures import in_front
    from kinefit.simulation.movements import MOVEMENTS, movement, people
    from kinefit.simulation.rendering.scenes import SimulatedScene
    from kinefit.simulation.rendering.sensors import DEPTH_SENSORS, measured_depth

    kind, names = DEPTH_SENSORS[sensor], tuple(MOVEMENTS)
    for k in range(count):
        crowd = people(seed=k // len(names))
        person = crowd[(3 * k + k // len(names)) % len(crowd)]
        truth = movement(names[k % len(names)], person.body, rate=10.0, speed=person.speed)
        frame = int(np.random.default_rng(1000 + k).integers(len(truth))) if k % 4 else 0
        camera = in_front(truth, kind.camera(), azimuth=person.azimuth, near=kind.near, far=kind.far)
        depth = measured_depth(SimulatedScene.of(truth, camera), frame, camera, kind, np.random.default_rng([k, frame]))
        yield person.body, truth.state(frame), camera, depth


def _size(body: Any) -> None:
    """Somebody of other lengths and girths, from three postures that are off by 5° and 3 cm."""
    from dataclasses import replace

    from kinefit.bodies.surfaces import TaperedCylinder
    from kinefit.fitting.subject.surfaces import fit_surfaces
    from kinefit.sensors.surfaces.depth_view import view_of
    from kinefit.simulation.rendering.sensors import KINECT

    camera, before, after = camera_in_front(KINECT), [], []
    for seed in range(amount(4, 1)):
        rng = np.random.default_rng(seed)
        scales = np.exp(rng.normal(0.0, 0.07) + rng.normal(0.0, 0.03, len(body.scale_groups)))
        girth = float(np.exp(rng.normal(0.05, 0.12)))
        person = body.scaled(scales)
        person = replace(person, surfaces=tuple(
            replace(s, radii=tuple((girth * a, girth * b) for a, b in s.radii)) if isinstance(s, TaperedCylinder) else s
            for s in person.surfaces
        ))  # fmt: skip
        truth = [random_state(body, rng, sitting=False) for _ in range(3)]
        views = [view_of(d, d > 0, camera) for d in seen(person, truth, camera, KINECT, room=False)]
        sigma = np.repeat((0.03, 0.05, 0.09), (3, 3, len(body.tree.coordinates)))
        states = [s.retract(sigma * rng.normal(size=len(sigma))) for s in truth]
        fit = fit_surfaces(body, [v.cloud for v in views], states, views=views)
        groups = len(scales)
        before += np.abs(np.log(scales)).tolist()
        after += np.abs(fit.mean[:groups] - np.log(scales)).tolist()
    figure("size_lengths_before", 100 * float(np.mean(before)), "% mean error of lengths", ">= 0")
    figure("size_lengths", 100 * float(np.mean(after)), "% mean error of lengths", "<= 3")
