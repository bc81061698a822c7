"""Which segments a depth image speaks for: drawn bodies, so that the truth is known."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.rendering import render_body
from kinefit.errors import ObservationError
from kinefit.geometry.camera import Camera
from kinefit.sensors.visibility import _kernels_visibility as kernels
from kinefit.sensors.visibility.visibility import Layers, SegmentVerdict, judge_segments

CAMERA = Camera("depth", (320, 240), np.array([[275.0, 0, 159.5], [0, 275.0, 119.5], [0, 0, 1]]))
WALL = 6.0  # [m]


@pytest.fixture(scope="module")
def scene():
    """A standing body with its arms a little out, and the camera that sees it from 2.7 m in front."""
    body = load_body("humanoid10")
    state = body.rest_state()
    for side in "rl":
        state = turned(body, state, f"arm_add_{side}", -0.5)
    layers = Layers(body, CAMERA)
    x = layers.mesh.posed(body.tree.forward(state.T_world_root, state.angles)[0])
    T = np.eye(4)
    T[:3, :3] = [[0, 0, -1], [0, -1, 0], [-1, 0, 0]]  # it stands along y and looks along x
    T[:3, 3] = -T[:3, :3] @ (2.7, x[:, 1].mean(), 0.0)
    camera = CAMERA.with_pose(T)
    return body, state, camera, Layers(body, camera, mesh=layers.mesh)


def seen(body, state, camera, noise=0.0, seed=0):
    """(H, W) depth of a body before a wall."""
    depth = render_body(body, state, camera).depth.copy()
    depth[~np.isfinite(depth)] = WALL
    rng = np.random.default_rng(seed)
    return (depth + noise * rng.normal(size=depth.shape)).astype(np.float32)


def judged(body, state, layers, depth, camera, **settings):
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    return judge_segments(layers.mesh.posed(frames), layers, depth, camera, **settings)


def turned(body, state, name, radians):
    """A state with one coordinate turned."""
    delta = np.zeros(body.tree.n_dofs)
    delta[6 + body.tree.coordinate(name)] = radians
    return state.retract(delta)


def test_truth_is_trusted(scene):
    body, state, camera, layers = scene
    verdict = judged(body, state, layers, seen(body, state, camera, 0.01), camera, noise=(0.01, 0.0)).evidence
    visible = ~verdict.hidden
    assert visible.sum() >= 0.8 * len(body.tree.segments)
    assert not verdict.lost.any()
    assert verdict.quality[visible].min() > 0.7


def test_every_limb_put_elsewhere_is_flagged(scene):
    body, state, camera, layers = scene
    depth = seen(body, state, camera)
    moved = 0
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    truth = layers.mesh.posed(frames)
    for d in range(len(body.tree.coordinates)):
        other = turned(body, state, body.tree.coordinates[d], 1.3)
        frames, _ = body.tree.forward(other.T_world_root, other.angles)
        away = np.linalg.norm(layers.mesh.posed(frames) - truth, axis=1)
        count = np.maximum(np.bincount(layers.mesh.segment), 1)
        far = np.bincount(layers.mesh.segment, away) / count > 0.3
        verdict = judged(body, other, layers, depth, camera).evidence
        assert (verdict.lost | verdict.hidden)[far].all(), body.tree.coordinates[d]
        moved += far.sum()
    assert moved >= 4


def test_what_stands_behind_something_is_hidden_and_not_lost(scene):
    body, state, camera, layers = scene
    depth = seen(body, state, camera)
    depth[:] = np.minimum(depth, 0.8)  # a board before all of it
    verdict = judged(body, state, layers, depth, camera)
    drawn = verdict.counts[:, kernels.OWN] > 0
    assert verdict.evidence.hidden.all() and not verdict.evidence.lost.any()
    assert (verdict.covered[drawn & (verdict.counts[:, 1:].sum(axis=1) > 0)] == 1.0).all()


def test_a_body_that_is_not_there_is_lost(scene):
    body, state, camera, layers = scene
    empty = np.full((240, 320), WALL, np.float32)
    verdict = judged(body, state, layers, empty, camera).evidence
    assert (verdict.lost | verdict.hidden).all() and verdict.lost.sum() >= 0.7 * len(verdict.lost)


def test_no_measurement_tells_nothing(scene):
    body, state, camera, layers = scene
    verdict = judged(body, state, layers, np.zeros((240, 320), np.float32), camera).evidence
    assert verdict.hidden.all() and not verdict.lost.any() and not verdict.quality.any()


def test_a_limb_in_blank_pixels_is_flagged_and_the_others_are_not(scene):
    body, state, camera, layers = scene
    depth = seen(body, state, camera)
    depth[depth == WALL] = 0.0  # out of the sensor's range
    other = turned(body, state, "arm_add_r", -1.2)
    verdict = judged(body, other, layers, depth, camera)
    arm = np.array([s in ("upperarm_r", "forearm_r", "hand_r") for s in body.tree.segments])
    assert verdict.evidence.lost[arm & (verdict.counts[:, kernels.OWN] > 40)].all() and arm.any()
    assert not verdict.evidence.lost[~arm].any()
    assert not judged(body, state, layers, depth, camera).evidence.lost.any()


def test_holes_and_a_sensor_that_sees_little_of_the_body_tell_nothing(scene):
    body, state, camera, layers = scene
    depth = seen(body, state, camera)
    holes = depth.copy()
    holes[::6] = holes[:, ::6] = 0.0  # 5 cm apart, a pixel wide
    assert not judged(body, state, layers, holes, camera).evidence.lost.any()
    legs = depth.copy()
    legs[130:] = 0.0  # dark trousers
    verdict = judged(body, state, layers, legs, camera)
    assert not verdict.evidence.lost.any() and verdict.evidence.hidden.any()


def test_verdicts_of_sensors_add_up(scene):
    body, state, camera, layers = scene
    clear = judged(body, state, layers, seen(body, state, camera), camera)
    nothing = judged(body, state, layers, np.zeros((240, 320), np.float32), camera)
    assert np.array_equal((clear.evidence + nothing.evidence).agreeing, clear.evidence.agreeing)


def test_layers_against_plain_numpy():
    rng = np.random.default_rng(3)
    stack = rng.random((5, 12, 16)).astype(np.float32)
    stack[rng.random(stack.shape) < 0.5] = np.inf
    front, behind = np.full((2, 12 * 16), np.inf, np.float32)
    owner, counts = np.full(12 * 16, -1, np.int32), np.zeros((5, kernels.COUNTS), np.int64)
    for s, layer in enumerate(stack):
        kernels.add_layer(layer.reshape(-1), s, front, behind, owner, counts)
    ordered, flat = np.sort(stack, axis=0), stack.reshape(5, -1)
    assert np.array_equal(front, ordered[0].ravel()) and np.array_equal(behind, ordered[1].ravel())
    drawn = np.isfinite(front)
    assert np.array_equal(owner[drawn], flat.argmin(axis=0)[drawn]) and (owner[~drawn] == -1).all()
    assert np.array_equal(counts[:, kernels.OWN], np.isfinite(flat).sum(axis=1))


def test_an_image_of_another_size_is_refused(scene):
    body, state, camera, layers = scene
    with pytest.raises(ObservationError, match=r"depth image .*\(120, 160\).*scaled"):
        judged(body, state, layers, np.zeros((120, 160), np.float32), camera)


def test_a_segment_holds_the_next_one_where_enough_of_it_agrees():
    counts = np.array([[100, 25, 0, 0, 0, 75], [100, 24, 0, 0, 0, 76], [100, 40, 10, 31, 0, 0], [8, 4, 0, 0, 0, 4]])
    assert SegmentVerdict(counts, np.ones(4, bool)).holds.tolist() == [True, False, False, True]
