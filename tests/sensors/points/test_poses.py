"""Poses of another program: rows against central differences, a size, offsets and errors that last, another world."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.movements import BODY, RATE, SENSOR, a_motion
from tests.oracle import STATES, central_differences, state_of

from kinefit import Recording, track
from kinefit.errors import BodyError, ObservationError
from kinefit.fitting.subject.parameters import SegmentScales
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.observations import BodyTrackerFrame, MarkerFrame
from kinefit.sensors.points.poses import PoseErrors, PoseSensor
from kinefit.sensors.scene import Scene
from kinefit.simulation.figures import in_front

JOINTS = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
POINTS = {f"{side}{joint}": f"{side}_{joint}" for side in "lr" for joint in JOINTS} | {"neck": "neck"}
CAMERA = in_front(a_motion(), SENSOR.camera(), near=SENSOR.near, far=SENSOR.far)
SIZE, SIGMA = 0.9, 0.015


def lengths(body=BODY, size=1.0):
    at = body.landmarks.select(tuple(POINTS.values()))
    x = size * body.points_rest(at)
    return {(a, b): float(np.linalg.norm(p - q)) for a, p in zip(POINTS, x) for b, q in zip(POINTS, x) if a != b}


def sensor(size=1.0, **options):
    return PoseSensor("poses", POINTS, lengths(size=size), **options)


def joints(state, body=BODY):
    return body.positions(state, body.landmarks.select(tuple(POINTS.values())))


def scene(state, body=BODY, **more):
    return Scene(body, state, Rig((CAMERA,)), **more)


@pytest.mark.parametrize("kind", STATES)
@pytest.mark.parametrize("up", [None, "camera"])
def test_rows_agree_with_central_differences(kind, up):
    state, rng = state_of(BODY, kind, seed=3), np.random.default_rng(0)
    of = sensor(camera="depth", up=up, errors=PoseErrors(offset=0.025))
    values = {"poses": {name: 0.02 * rng.normal() for name in of.unknowns}}
    frame = BodyTrackerFrame("poses", 0.0, tuple(POINTS), joints(state) + 0.1 * rng.normal(size=(len(POINTS), 3)))
    at = scene(state, values=values)
    matched = of.prepare(frame, at).match(at, 0.03)
    (rows,) = matched.rows(at)
    expected = central_differences(lambda s: matched.rows(scene(s, values=values))[0].residual, BODY, state)
    assert np.allclose(rows.jacobian, -expected, atol=1e-6)
    assert len(rows) == 3 * (len(POINTS) + 1) and matched.channels == (*POINTS, "root")


def test_a_body_of_any_size_fits_equally_well_with_the_file_as_much_larger():
    state = a_motion().state(5)
    frame = BodyTrackerFrame("poses", 0.0, tuple(POINTS), joints(state) @ se3.exp_so3(np.array([0.02, 0, 0])))
    of = sensor(size=1.0)
    squares = []
    for scale, stated in ((1.0, True), (1.3, True), (1.3, False)):
        body = BODY.scaled(np.full(len(BODY.scale_groups), scale))
        T = se3.transform(state.T_world_root[:3, :3], scale * state.T_world_root[:3, 3])
        values = {"poses": {"size": float(np.log(scale))}} if stated else {}
        at = Scene(body, replace(state, T_world_root=T), Rig(()), values=values)
        (rows,) = of.prepare(frame, at).match(scene(state), 0.03).rows(at)
        squares.append(float(rows.weight @ rows.residual**2))
        assert np.isclose(of.person_size(body)[0], 1.0 / scale)
    assert squares[0] > 1e-3 and np.allclose(squares, squares[0], rtol=1e-6)


@pytest.mark.parametrize("name", ["length thigh", "length upperarm", "length trunk"])
def test_lengths_move_the_rows_of_their_own_segments_alone(name):
    """What the fit of the person takes for granted (`DofRows.segment`): else it would leave out what rows depend on."""
    scales, state = SegmentScales(BODY), a_motion().state(5)
    k, values = scales.names.index(name), {"poses": {"size": 0.1}}
    frame = BodyTrackerFrame("poses", 0.0, tuple(POINTS), joints(state))
    matched = sensor().prepare(frame, scene(state)).match(scene(state), 0.03)
    bodies = [BODY, BODY.scaled(np.exp(0.1 * (np.arange(len(scales.names)) == k)))]
    before, after = (matched.rows(scene(state, body, values=values))[0] for body in bodies)
    moved = np.flatnonzero(np.abs(after.residual - before.residual) > 1e-9)
    assert len(moved) and set(before.segment[moved].tolist()) <= scales.touches[k]


def test_joints_of_the_pelvis_are_surer_than_those_of_limbs():
    state = a_motion().state(5)
    frame = BodyTrackerFrame("poses", 0.0, tuple(POINTS), joints(state))
    sigma = dict(zip(POINTS, sensor().prepare(frame, scene(state)).sigmas(scene(state))))
    assert sigma["lhip"] == 0.5 * PoseErrors.sigma and sigma["lknee"] == sigma["rwrist"] == PoseErrors.sigma


def test_errors_are_larger_along_the_ray():
    state = a_motion().state(5)
    at = scene(state)
    ray = joints(state)[[0, 6]].mean(axis=0) - CAMERA.centre_world
    ray, across = ray / np.linalg.norm(ray), np.cross(ray, [0.0, 1.0, 0.0])
    found = []
    for way in (ray, across / np.linalg.norm(across)):
        x = joints(state)
        x[list(POINTS).index("rwrist")] += 0.05 * way
        matched = sensor().prepare(BodyTrackerFrame("poses", 0.0, tuple(POINTS), x), at).match(at, 0.03)
        found.append(matched.squares(at).max())
    assert np.isclose(found[1] / found[0], PoseErrors.depth_factor**2)


@pytest.fixture(scope="module")
def recovered():
    """A person of 0.9 of the body's size, joints 2 cm off, the same for left and right, and errors that last 0.5 s."""
    small, rng, count = BODY.scaled(np.full(len(BODY.scale_groups), SIZE)), np.random.default_rng(0), 60
    truth, at = a_motion(), small.landmarks.select(tuple(POINTS.values()))
    off = {joint: 0.02 * v / np.linalg.norm(v) for joint in JOINTS for v in [rng.normal(size=3)]}
    moved = np.array([off.get(n[1:], np.zeros(3)) * (1.0, 1.0, -1.0 if n[0] == "l" else 1.0) for n in POINTS])
    shifted = replace(at, points=at.points + moved)
    drift, steps, noise = np.exp(-1.0 / (0.5 * RATE)), [], SIGMA * rng.normal(size=(len(POINTS), 3))
    for i in range(count):
        noise = drift * noise + np.sqrt(1.0 - drift**2) * SIGMA * rng.normal(size=noise.shape)
        x = small.positions(truth.state(i), shifted) + noise
        steps.append([BodyTrackerFrame("poses", i / RATE, tuple(POINTS), x)])
    own = sensor(size=SIZE, errors=PoseErrors(sigma=SIGMA, offset=0.025))
    found = track(Recording.of_frames(steps, Rig(()), rate=RATE, up="y", sensors=[own]), BODY, size=True)
    x_seen = np.array([frame.x_world for (frame,) in steps])
    return small, found, x_seen, np.array([small.positions(truth.state(i), at) for i in range(count)])


def test_size_and_bones_of_a_person_are_found(recovered):
    _, found, x_seen, _ = recovered
    shape = found.provenance["shape"]
    scales = np.exp([v[0] for name, v in shape.items() if name.startswith("length ")])
    stds = [v[1] for name, v in shape.items() if name.startswith("length ")]
    assert np.all(np.abs(np.log(scales / SIZE)) < 2.0 * np.array(stds)) and max(stds) < 0.1
    x = found.joint_centres[:, [BODY.tree.segment("thigh_r"), BODY.tree.segment("shank_r")]]
    seen = x_seen[:, [list(POINTS).index("rhip"), list(POINTS).index("rknee")]]
    spread = [np.linalg.norm(np.diff(both, axis=1), axis=2).std() for both in (x, seen)]
    assert spread[0] < 1e-9 < 5e-3 < spread[1]


def test_joints_are_nearer_than_they_were_and_their_bars_hold(recovered):
    _, found, x_seen, truth = recovered
    at = found.body.landmarks.select(tuple(POINTS.values()))
    x = np.array([found.body.positions(found.state(i), at) for i in range(len(found))])
    against = [v - v[:, [0, 6]].mean(axis=1, keepdims=True) for v in (x, x_seen, truth)]
    after, before = (np.linalg.norm(v - against[2], axis=2).mean() for v in against[:2])
    assert after < before
    limbs = [BODY.tree.segment(f"{name}_{s}") for name in ("thigh", "shank", "upperarm", "forearm") for s in "lr"]
    own = [list(POINTS).index(f"{s}{name}") for name in ("hip", "knee", "shoulder", "elbow") for s in "lr"]
    inside = np.abs(found.joint_centres[:, limbs] - truth[:, own]) < 1.96 * found.joint_std[:, limbs]
    assert inside.mean() > 0.9


def test_another_world_is_placed_by_what_other_sensors_see():
    truth, rng = a_motion(), np.random.default_rng(1)
    T_file_world = se3.transform(se3.exp_so3(np.array([0.0, 2.0, 0.0])), np.array([1.0, 0.2, -3.0]))
    body = replace(BODY, marker_sets={"all": BODY.landmarks})
    steps = []
    for i in range(20):
        state = truth.state(i)
        seen = BODY.positions(state, BODY.landmarks) + 0.002 * rng.normal(size=(len(BODY.landmarks), 3))
        x = se3.apply(T_file_world, joints(state)) + 0.01 * rng.normal(size=(len(POINTS), 3))
        steps.append([
            MarkerFrame("system", i / RATE, BODY.landmarks.names, seen, "all"),
            BodyTrackerFrame("poses", i / RATE, tuple(POINTS), x),
        ])  # fmt: skip
    recording = Recording.of_frames(steps, Rig(()), rate=RATE, up="y", sensors=[sensor(up="y")])
    found = track(recording, body, size=False, smooth=False)
    left = found.residuals["poses"].values
    assert np.isfinite(left[2:]).all() and np.sqrt(np.nanmean(left**2)) < 0.015
    assert np.linalg.norm(found.joint_centres - truth.joint_centres[:20], axis=2).mean() < 0.01


def test_what_is_refused():
    state = a_motion().state(0)
    with pytest.raises(ObservationError, match="1 hips"):
        PoseSensor("p", {"a": "l_hip", "b": "r_knee"}, {})
    with pytest.raises(ObservationError, match="not all are positive"):
        PoseErrors(sigma=0.0)
    odd = {"a": "l_hip", "b": "r_hip", "c": "r_kne"}
    with pytest.raises(BodyError, match="joint 'c'.*no.*'r_kne'"):
        PoseSensor("p", odd, {}).prepare(BodyTrackerFrame("p", 0.0, tuple("abc"), np.zeros((3, 3))), scene(state))
    alone = BodyTrackerFrame("poses", 0.0, ("lhip", "lknee"), np.zeros((2, 3)))
    assert not sensor().prepare(alone, scene(state)).match(scene(state), 0.03).rows(scene(state))
