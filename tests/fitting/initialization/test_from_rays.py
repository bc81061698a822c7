"""A start from one camera's keypoints beside a sensor of one's own, which says how far away the body is."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import kinefit
from kinefit.observations import KeypointFrame
from kinefit.simulation import in_front, movement

POST = np.array([0.3, 2.0, -0.4])


class Ranger(kinefit.Sensor):
    name = "ranger"

    def prepare(self, frame, scene):
        return frame


@dataclass
class Ranges(kinefit.Measurement):
    """Distances [m] from a post to both wrists."""

    time: float
    distances: np.ndarray
    sensor: str = "ranger"

    def match(self, scene, reach):
        wrists = scene.body.landmarks.select(("l_wrist", "r_wrist"))
        return kinefit.RowsOf(self.rows, {"wrists": wrists}, channels=wrists.names)

    def rows(self, scene, wrists):
        away = POST - scene.positions(wrists)
        length = np.linalg.norm(away, axis=1)
        return scene.along(wrists, away / length[:, None], length - self.distances, 0.01)


BODY = kinefit.load_body("humanoid")


def seen(turn, frames=4):
    """The truth, and frames of one camera and of a ranger, of a person who faces any way."""
    truth = movement("wave", BODY, rate=30.0)
    camera = replace(in_front(truth, kinefit.simulation.KINECT.camera(name="cam")), name="cam")
    spin = np.eye(4)
    spin[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    root = truth.state(0).T_world_root
    states, steps = [], []
    points, wrists = BODY.keypoints("MEDIAPIPE_33"), BODY.landmarks.select(("l_wrist", "r_wrist"))
    rng = np.random.default_rng(0)
    for k in range(frames):
        T = truth.state(k).T_world_root.copy()
        T[:3, :3] = spin[:3, :3] @ T[:3, :3]
        state = kinefit.BodyState(T, truth.state(k).angles)
        uv = camera.project(BODY.positions(state, points)) + rng.normal(size=(len(points), 2))
        away = np.linalg.norm(POST - BODY.positions(state, wrists), axis=1) + 0.01 * rng.normal(size=2)
        pixels = KeypointFrame("cam", k / 30.0, points.names, uv, np.ones(len(points)), "MEDIAPIPE_33")
        states.append(state)
        steps.append([pixels, Ranges(k / 30.0, away)])
    return states, steps, kinefit.Rig((camera,)), root


@pytest.mark.parametrize("turn", [0.0, 1.2, 3.0])
def test_one_camera_beside_ranges_starts(turn):
    states, steps, rig, _ = seen(turn)
    tracker = kinefit.Tracker(BODY, rig, rate=30.0, sigma={"cam": 1.0}, sensors=[Ranger()], up="y")
    results = [tracker.update(step) for step in steps]
    assert results[0].quality > 0.5
    off = np.linalg.norm(results[-1].state.T_world_root[:3, 3] - states[-1].T_world_root[:3, 3])
    assert off < 0.15


def test_one_camera_alone_does_not_start():
    _, steps, rig, _ = seen(0.0)
    tracker = kinefit.Tracker(BODY, rig, rate=30.0, sigma={"cam": 1.0}, up="y")
    assert tracker.update(steps[0][:1]) is None
