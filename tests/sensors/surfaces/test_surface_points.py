"""Tracked points of a surface as a sensor: they stick to the body, and see turns that a cloud cannot."""

import numpy as np
import pytest
from tests.oracle import central_differences, design
from tests.sensors.scenes import at, posture

from kinefit import observations
from kinefit.bodies import BodyState, load_body
from kinefit.bodies.surfaces.places import sample
from kinefit.errors import ObservationError
from kinefit.fitting.tracking.tracker import Tracker
from kinefit.geometry.camera import Rig
from kinefit.observations import SurfacePointFrame
from kinefit.sensors.kinds.surface_points import SurfacePointRecording
from kinefit.sensors.scene import Scene
from kinefit.sensors.surfaces.surface_points import SurfacePointSensor

BODY = load_body("humanoid")
POINTS, NORMALS, SEGMENT = sample(BODY, 300)


def frame(state, time=0.0, rng=None, sigma=0.002):
    """Points of the surface at a state."""
    f = Scene(BODY, state, Rig(())).frames[SEGMENT]
    x = np.einsum("nij,nj->ni", f[:, :9].reshape(-1, 3, 3), POINTS) + f[:, 9:]
    if rng is not None:
        x = x + sigma * rng.normal(size=x.shape)
    return SurfacePointFrame("skin", time, np.arange(len(x)), x, np.tile(sigma**2 * np.eye(3), (len(x), 1, 1)))


def learnt(state):
    sensor, scene = SurfacePointSensor("skin"), Scene(BODY, state, Rig(()))
    for _ in range(2):
        sensor.learn(sensor.prepare(frame(state), scene), scene, True)
    return sensor


def test_anchors_are_where_the_points_were_seen():
    sensor = learnt(posture(BODY, 0))
    assert len(sensor.anchors) > 250
    right = [s == SEGMENT[i] and np.allclose(x, POINTS[i], atol=1e-9) for i, (s, x) in sensor.anchors.items()]
    assert np.mean(right) > 0.9  # at joints the nearest segment may be the other one
    before = sensor.anchors
    scene = Scene(BODY, posture(BODY, 1), Rig(()))
    sensor.learn(sensor.prepare(frame(posture(BODY, 1)), scene), scene, False)
    assert sensor.anchors is before


def test_points_are_anchored_once_the_limb_rests_in_the_cloud():
    sensor, state = SurfacePointSensor("skin"), posture(BODY, 0)
    turn = BODY.tree.coordinate("arm_rot_r")
    forearm = BODY.tree.segments.index("forearm_r")

    def learn(degrees):
        angles = np.array(state.angles)
        angles[turn] += np.radians(degrees)
        scene = Scene(BODY, BodyState(state.T_world_root, angles), Rig(()))
        sensor.learn(sensor.prepare(frame(state), scene), scene, True)
        return {s for s, _ in sensor.anchors.values()}

    learn(6)
    assert forearm not in learn(3) and len(sensor.anchors) > 100  # the trunk rests, the arm still turns
    assert forearm in (learn(0.1) | learn(0))


def test_rows_of_old_and_new_points_have_the_derivative_of_their_residuals():
    sensor, state = learnt(posture(BODY, 0)), posture(BODY, 1)
    sensor.anchors = {i: anchor for i, anchor in sensor.anchors.items() if i % 2}
    here = Scene(BODY, state, Rig(()))
    match = sensor.prepare(frame(posture(BODY, 2)), here).match(here, 0.1)
    off = state.retract(0.02 * np.random.default_rng(1).normal(size=BODY.tree.n_dofs))
    made = match.rows(here.at(off))
    assert len(made) == 4
    for k, rows in enumerate(made):
        some = np.arange(0, len(rows), 17)
        slope = central_differences(
            lambda s, k=k, i=some: match.rows(here.at(s))[k].residual[i], BODY, off, 1e-6
        )
        np.testing.assert_allclose(-design(rows, BODY, off)[some], slope, atol=1e-6)


def test_a_turn_about_the_limb_is_followed():
    rng, start = np.random.default_rng(0), at(BODY, elbow_flex_r=60, arm_add_r=-30)
    sensor = SurfacePointSensor("skin")
    tracker = Tracker(BODY, Rig(()), rate=30.0, sensors=[sensor], up="y")
    tracker.start_at(start)
    turn = BODY.tree.coordinate("arm_rot_r")
    for k in range(12):
        truth = at(BODY, elbow_flex_r=60, arm_add_r=-30, arm_rot_r=3.0 * k)
        result = tracker.update([frame(truth, k / 30.0, rng)])
    assert len(sensor.anchors) > 200
    assert abs(np.degrees(result.state.angles[turn]) - 33.0) < 6.0


def test_frames_that_are_none():
    x, c = np.zeros((3, 3)), np.zeros((3, 3, 3))
    for ids, points in ((np.array([1, 1, 2]), x), (np.arange(2), x), (np.array([0.5, 1, 2]), x), (np.arange(3), x[:2])):
        with pytest.raises(ObservationError):
            SurfacePointFrame("skin", 0.0, ids, points, c)
    x[1] = np.nan
    assert SurfacePointFrame("skin", 0.0, np.arange(3), x, c).ids.tolist() == [0, 2]
    with pytest.raises(ObservationError):
        SurfacePointSensor("skin", slide=0.0)
    scene = Scene(BODY, BODY.default_state(), Rig(()))
    with pytest.raises(ObservationError, match="SurfacePointFrame"):
        SurfacePointSensor("skin").prepare(object(), scene)
    empty = SurfacePointFrame("skin", 0.0, np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert SurfacePointSensor("skin").prepare(empty, scene).match(scene, 0.1).rows(scene) == []


def test_a_point_of_another_limb_is_let_go_and_given_anew():
    state, other = posture(BODY, 0), posture(BODY, 12)
    sensor = learnt(state)
    right = dict(sensor.anchors)
    arm = BODY.tree.segments.index("forearm_r")
    some = [i for i, (s, _) in right.items() if s == arm][:3]
    here, there = Scene(BODY, state, Rig(())), Scene(BODY, other, Rig(()))
    trunk = int(np.bincount([s for s, _ in right.values()]).argmax())
    f = here.frames[trunk]
    for i in some:  # as if seen first while the arm lay on the trunk
        g = here.frames[arm]
        x = g[:9].reshape(3, 3) @ right[i][1] + g[9:]
        sensor.anchors = {**sensor.anchors, i: (trunk, f[:9].reshape(3, 3).T @ (x - f[9:]))}
    for _ in range(2):
        sensor.learn(sensor.prepare(frame(other), there), there, True)
    assert all(sensor.anchors[i][0] == arm for i in some)
    kept = [i for i in right if i not in some and right[i][0] == sensor.anchors[i][0]]
    assert len(kept) > 0.95 * (len(right) - len(some))
    wrong = Scene(BODY, posture(BODY, 2), Rig(()))  # a pose that most points contradict takes none away
    before = set(sensor.anchors)
    sensor.learn(sensor.prepare(frame(other), wrong), wrong, True)
    assert len(before & set(sensor.anchors)) > 0.5 * len(before)


def test_how_a_limb_was_turned_at_first_lasts():
    arm = load_body("arm")
    points, _, segment = sample(arm, 200)
    sensor, tree = SurfacePointSensor("skin"), arm.tree
    tracker = Tracker(arm, Rig(()), rate=30.0, sensors=[sensor], up="y")
    angles = np.array(arm.default_state().angles)
    angles[tree.coordinate("elbow_flex_r")] = 1.2
    tracker.start_at(BodyState(np.eye(4), angles))
    forearm, turned = tree.segment("forearm_r"), tree.coordinate("pro_sup_r")
    stated, rng = [], np.random.default_rng(0)
    for k in range(18):
        angles[turned] += 0.01
        f = Scene(arm, BodyState(np.eye(4), angles), Rig(())).frames[segment]
        x = np.einsum("nij,nj->ni", f[:, :9].reshape(-1, 3, 3), points) + f[:, 9:]
        x += 1e-3 * rng.normal(size=x.shape)
        seen = SurfacePointFrame("skin", k / 30.0, np.arange(len(x)), x, np.tile(1e-6 * np.eye(3), (len(x), 1, 1)))
        result = tracker.update([seen])
        if forearm in {s for s, _ in sensor.anchors.values()}:
            stated.append(result.dof_std[6 + turned])
    at_first = np.linalg.norm(sensor.turns[forearm])
    assert len(stated) > 5 and at_first > 0.1  # [rad] a round limb's cloud tells no more
    assert min(stated) > at_first
    sensor.turns = {}
    exact = tracker.update([SurfacePointFrame("skin", 0.6, seen.ids, x, seen.covariance)])
    assert exact.dof_std[6 + turned] < 0.85 * min(stated)  # by what it says from frame to frame


def test_the_old_name_of_the_recording_is_still_there():
    with pytest.warns(FutureWarning, match="SurfacePointRecording now"):
        assert observations.SurfacePointVideo is SurfacePointRecording
