"""Small recordings of known movements by several sensors, shared by the tests of the fusion tracker."""

from dataclasses import replace
from functools import cache

import numpy as np

from kinefit.bodies import load_body
from kinefit.bodies.rendering import render_body
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Rig
from kinefit.observations import DepthFrame, KeypointFrame, MarkerFrame, PointCloud
from kinefit.sensors.settings import TrackSettings
from kinefit.simulation.figures import in_front
from kinefit.simulation.movements import movement
from kinefit.simulation.rendering.scenes import SimulatedScene
from kinefit.simulation.rendering.sensors import KINECT, measured_depth

BODY = load_body("humanoid10")
RATE = 30.0
SENSOR = replace(KINECT, name="depth", size=(160, 120), focal=144.0, disparity_step=0.03)
STILL = TrackSettings(search=False)
SET = "COCO_17"


@cache
def a_motion(name="wave"):
    return movement(name, BODY, rate=RATE)


@cache
def a_rig(name="wave"):
    """The depth camera, and two of colour on both sides of it."""
    motion = a_motion(name)
    cameras = [in_front(motion, SENSOR.camera(), near=SENSOR.near, far=SENSOR.far)]
    colour = replace(SENSOR, size=(320, 240), focal=288.0)
    for side, azimuth in (("left", 0.9), ("right", -0.7)):
        cameras.append(in_front(motion, colour.camera(name=side), azimuth=azimuth))
    return Rig(tuple(cameras))


@cache
def images(name="wave", count=24):
    """Depth images of the first frames, in a room."""
    camera = a_rig(name)["depth"]
    scene = SimulatedScene.of(a_motion(name), camera)
    random = [np.random.default_rng(i) for i in range(count)]
    return [measured_depth(scene, i, camera, SENSOR, r) for i, r in enumerate(random)]


def depth_frame(i, name="wave"):
    return DepthFrame("depth", i / RATE, images(name)[i])


def keypoint_frame(i, camera, name="wave", noise=2.0):
    """What a detector sees in one of the cameras of colour."""
    points = BODY.keypoints(SET)
    uv = a_rig(name)[camera].project(BODY.positions(a_motion(name).state(i), points))
    uv = uv + noise * np.random.default_rng([i, len(camera)]).normal(size=uv.shape)
    return KeypointFrame(camera, i / RATE, points.names, uv, np.ones(len(uv)), SET)


def marker_frame(i, names, name="wave", noise=0.002, shift=0.0, sensor="mocap"):
    """Markers on the body's landmarks."""
    x = BODY.positions(a_motion(name).state(i), BODY.landmarks.select(names))
    x = x + noise * np.random.default_rng([i, len(names)]).normal(size=x.shape) + shift
    return MarkerFrame(sensor, i / RATE, names, x)


def cloud_frame(i, segment=None, name="wave", every=3):
    """Points (N, 3) of the body, or of one segment of it, as the depth camera sees them without error."""
    camera = a_rig(name)["depth"]
    drawn = render_body(BODY, a_motion(name).state(i), camera)
    on = drawn.segment >= 0 if segment is None else drawn.segment == BODY.tree.segment(segment)
    v, u = np.nonzero(on)
    rays = np.stack([r[v, u] for r in camera.ray_table] + [np.ones(len(u))], axis=1)
    T = camera.T_world_camera
    x = (rays * drawn.depth[v, u, None]) @ T[:3, :3].T + T[:3, 3]
    return PointCloud("scan", i / RATE, x[::every], camera.centre_world, on_body=True, segment=segment)


def a_tracker(name="wave", start=0, settings=STILL, **more):
    """A tracker that begins at the truth of a frame, or with nothing known where `start` is None."""
    tracker = Tracker(BODY, a_rig(name), rate=RATE, settings=settings, **{"up": "y", **more})
    if start is not None:
        tracker.start_at(a_motion(name).state(start))
    return tracker


def off(state, i, name="wave", body=BODY):
    """(L,) [m] by which the landmarks of a state are off."""
    points = BODY.landmarks
    return np.linalg.norm(body.positions(state, points) - BODY.positions(a_motion(name).state(i), points), axis=1)


def turned(state, **degrees):
    """A state with some angles turned."""
    delta = np.zeros(BODY.tree.n_dofs)
    for name, value in degrees.items():
        delta[6 + BODY.tree.coordinate(name)] = np.radians(value)
    return state.retract(delta)


def is_finite(result):
    """No state is unknown; standard deviations are numbers, infinite where only the prior speaks."""
    numbers = result.state.T_world_root, result.state.angles, result.segment_quality
    deviations = result.dof_std, result.joint_std
    return all(np.isfinite(v).all() for v in numbers) and not any(np.isnan(v).any() for v in deviations)
