"""Landmarks lifted from one image: rows that say how far each is behind the hips, and hints of where the person is."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import central_differences, design
from tests.sensors.scenes import posture, ring

from kinefit.bodies import load_body
from kinefit.errors import BodyError, CalibrationError, ObservationError
from kinefit.observations import Keypoints, LiftedFrame
from kinefit.sensors.channels import known_points
from kinefit.sensors.points.lifted import HIPS, LiftedSensor, person_size
from kinefit.sensors.scene import Scene
from kinefit.solving.rows import PairRows

BODY, SET = load_body("humanoid"), "MEDIAPIPE_33"
POINTS = known_points(BODY, SET)
RIG = ring(1)
CAMERA = RIG.cameras[0]


def lifted(state, size=1.0, names=POINTS.names):
    """What a network that errs nowhere tells, of a person `size` times as large as the body."""
    x = BODY.positions(state, POINTS)
    hips = x[[POINTS.names.index(name) for name in HIPS]].mean(axis=0)
    ray = (hips - CAMERA.centre_world) / np.linalg.norm(hips - CAMERA.centre_world)
    own = size * (x - hips) @ CAMERA.T_camera_world[:3, :3].T
    own[:, 2] = size * (x - hips) @ ray  # along the ray to the person, as a network sees the crop
    here = [POINTS.names.index(name) for name in names]
    return LiftedFrame(CAMERA.name, 0.0, tuple(names), own[here], CAMERA.project(x)[here], SET)


def rows_of(frame, match_at, state):
    scene = Scene(BODY, match_at, RIG)
    matched = LiftedSensor(CAMERA.name, 0.2).prepare(frame, scene).match(scene, 0.03)
    return matched, matched.rows(Scene(BODY, state, RIG))[0]


def test_what_errs_nowhere_leaves_nothing():
    state = posture(BODY, 3)
    matched, rows = rows_of(lifted(state), state, state)
    assert isinstance(rows, PairRows) and np.allclose(rows.weight, 25.0)
    middle = BODY.positions(state, matched.measurement.on(BODY).hips)[0]
    hips = BODY.positions(state, POINTS.select(HIPS)).mean(axis=0)
    assert np.linalg.norm(middle - hips) < 2e-3  # in the usual posture they are the same
    assert np.abs(rows.residual).max() < 2e-2  # the network's size is told by bones, seen a little askew
    assert matched.evidence(Scene(BODY, state, RIG)).agreeing.sum() == 0


def test_rows_change_as_the_body_moves():
    state, other = posture(BODY, 3), posture(BODY, 6)
    matched, rows = rows_of(lifted(state), other, other)
    slope = central_differences(lambda s: matched.rows(Scene(BODY, s, RIG))[0].residual, BODY, other)
    assert np.allclose(design(rows, BODY, other), -slope, atol=1e-6)


@pytest.mark.parametrize("size", [0.9, 1.15])
def test_the_size_of_the_networks_person_does_not_count(size):
    state = posture(BODY, 3)
    one, other = (rows_of(lifted(state, s), state, state)[1] for s in (1.0, size))
    assert np.allclose(one.residual, other.residual, atol=1e-9)


@pytest.mark.parametrize("scale", [0.7, 1.3])
def test_depths_favour_no_size(scale):
    """Bodies of any size are as far from the network's pose, each by its own standard deviations."""
    state, other = posture(BODY, 3), posture(BODY, 6)
    matched, rows = rows_of(lifted(state), other, other)
    scaled = matched.rows(Scene(BODY.scaled(np.full(len(BODY.scale_groups), scale)), other, RIG))[0]
    costs = [np.sum(r.weight * r.residual**2) for r in (rows, scaled)]
    assert costs[1] == pytest.approx(costs[0], rel=1e-6) and costs[0] > 0.1


@pytest.mark.parametrize("person", [0.69, 1.0, 1.1])
def test_a_network_measures_the_persons_size(person):
    """A child of 1.20 m and a man of 1.93; face, hands and feet of a network are of any size, and do not count."""
    frames = [lifted(posture(BODY, k), 0.91 * person) for k in (1, 3, 6)]
    x, uv = (np.stack([getattr(f, name) for f in frames])[:, None] for name in ("x", "uv"))
    names, confidence = frames[0].names, np.ones(uv.shape[:3])
    x[..., [k for k, name in enumerate(names) if name.endswith(("eye", "index", "pinky", "heel"))], :] *= 0.5
    record = Keypoints(CAMERA.name, SET, names, 30.0, uv, confidence, lifted=x)
    assert person_size(BODY, record) == pytest.approx(person, rel=0.01)
    assert np.isnan(person_size(BODY, replace(record, lifted=None)))
    assert np.isnan(person_size(BODY, replace(record, lifted=np.full(x.shape, np.nan))))


def test_hints_are_where_the_person_is():
    state = posture(BODY, 3)
    scene = Scene(BODY, BODY.default_state(np.eye(4)), RIG)
    hints = LiftedSensor(CAMERA.name, 0.2).prepare(lifted(state, 1.1), scene).hints(scene)
    off = np.linalg.norm(BODY.positions(state, hints.points) - hints.x_world, axis=1)
    assert len(off) == len(POINTS.names) and np.median(off) < 0.1


def test_what_is_unseen_or_unknown_is_left_out():
    state, scene = posture(BODY, 3), Scene(BODY, posture(BODY, 3), RIG)
    frame = lifted(state)
    x = np.array(frame.x)
    x[5] = np.nan
    part = LiftedFrame(frame.sensor, 0.0, ("ghost", *frame.names[1:]), x, frame.uv, SET)
    made = LiftedSensor(CAMERA.name, 0.2).prepare(part, scene)
    assert made.names == tuple(n for k, n in enumerate(frame.names) if k not in (0, 5))


def test_bad_input_is_told():
    state = posture(BODY, 3)
    frame, scene = lifted(state), Scene(BODY, state, RIG)
    with pytest.raises(CalibrationError):
        LiftedSensor("cam9", 0.2).prepare(frame, scene)
    with pytest.raises(BodyError):
        none = LiftedFrame(frame.sensor, 0.0, frame.names, frame.x, frame.uv, "NO_SET")
        LiftedSensor(CAMERA.name, 0.2).prepare(none, scene)
    with pytest.raises(ObservationError, match="lifted landmarks of"):
        LiftedFrame("c", 0.0, frame.names, frame.x[:5], frame.uv, SET)
