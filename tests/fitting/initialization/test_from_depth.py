"""A start with no pose given, from one depth image; limbs found again; what is wrong at the door."""

from dataclasses import replace

import numpy as np
import pytest
from tests.fitting.tracking.depth_oracle import ARMS, BODY, UP, camera, depth_of, facing

from kinefit.bodies.rendering import render_body
from kinefit.errors import BodyError, ObservationError, TrackingError
from kinefit.fitting.initialization import from_depth
from kinefit.fitting.initialization.from_depth import StartSearch, start_from_points
from kinefit.images.depth import to_points
from kinefit.simulation.figures import in_front
from kinefit.simulation.movements import movement
from kinefit.simulation.rendering.scenes import SimulatedScene
from kinefit.simulation.rendering.sensors import TOF, measured_depth

CAMERA = camera()
STATE = facing(**ARMS)
DEPTH = depth_of(BODY, STATE, CAMERA)


def joints(state):
    return BODY.tree.segment_poses(state.T_world_root[None], state.angles[None])[0, :, :3, 3]


@pytest.fixture(scope="module")
def starts():
    return start_from_points(BODY, None, CAMERA, DEPTH, up=UP)


def test_a_posture_is_found(starts):
    error = np.linalg.norm(joints(starts[0].state) - joints(STATE), axis=1)
    assert np.mean(error < 0.1) >= 0.9 and np.median(error) < 0.05
    assert starts[0].score > 0.7 and starts[0].score == max(s.score for s in starts)


def test_every_start_keeps_the_limits_and_sees_the_whole_body(starts):
    tree = BODY.tree
    for start in starts:
        assert np.all(start.state.angles >= tree.lower - 1e-9) and np.all(start.state.angles <= tree.upper + 1e-9)
    assert np.all(starts[0].visible > 0.05) and np.all(starts[0].visible <= 1.0)


@pytest.fixture(scope="module")
def noisy():
    """A standing person in a room by a table, from a time-of-flight camera: 4 cm of noise, flying pixels, holes."""
    motion = movement("point", BODY, rate=1.0)
    camera_tof = in_front(motion, TOF.camera(), near=TOF.near, far=TOF.far)
    depth = measured_depth(SimulatedScene.of(motion, camera_tof), 0, camera_tof, TOF, np.random.default_rng(0))
    return camera_tof, motion.state(0), depth


def test_a_posture_is_found_in_a_time_of_flight_image_of_a_room(noisy):
    camera_tof, state, depth = noisy
    start = start_from_points(BODY, None, camera_tof, depth, up=UP, search=StartSearch(attempts=1))[0]
    assert np.mean(np.linalg.norm(joints(start.state) - joints(state), axis=1) < 0.15) >= 0.9


@pytest.mark.slow
def test_points_with_the_noise_of_a_time_of_flight_camera_keep_their_outline(noisy):
    camera_tof, state, depth = noisy
    silhouette = render_body(BODY, state, camera_tof).depth < np.inf
    points = to_points(depth, camera_tof, mask=silhouette)
    start = start_from_points(BODY, points, camera_tof, depth, up=UP)[0]
    assert np.mean(np.linalg.norm(joints(start.state) - joints(state), axis=1) < 0.15) >= 0.9


@pytest.mark.slow
def test_the_upper_body_alone_is_enough():
    depth = DEPTH.copy()
    depth[135:] = 0.0  # cut at the hips
    cut = camera(height=135)
    K = np.array(cut.matrix)
    K[1, 2] = CAMERA.matrix[1, 2]
    start = start_from_points(BODY, None, replace(cut, matrix=K), depth[:135], up=UP, search=StartSearch(count=1))[0]
    upper = [BODY.tree.segment(n) for n in ("head", "upperarm_r", "forearm_r", "upperarm_l", "forearm_l")]
    assert np.mean(np.linalg.norm(joints(start.state) - joints(STATE), axis=1)[upper] < 0.12) >= 0.8
    assert np.all(start.visible[[BODY.tree.segment("shank_r"), BODY.tree.segment("shank_l")]] < 0.2)


@pytest.mark.slow
def test_points_alone_do_and_the_same_seed_gives_the_same():
    points = to_points(DEPTH, CAMERA, step=2)
    one, other = (start_from_points(BODY, points, CAMERA, up=UP, search=StartSearch(count=1))[0] for _ in range(2))
    assert np.array_equal(one.state.angles, other.state.angles)
    assert np.mean(np.linalg.norm(joints(one.state) - joints(STATE), axis=1) < 0.1) >= 0.8


def test_a_body_far_off_in_size_is_sized_from_all_images_that_it_explains_alike(monkeypatch):
    used = []

    def fit(body, clouds, states, **_):
        used.append(len(clouds))
        raise ObservationError("enough")

    monkeypatch.setattr(from_depth, "fit_surfaces", fit)
    small = BODY.scaled(np.full(len(BODY.scale_groups), 0.6))
    scores = [start_from_points(small, None, CAMERA, d, up=UP)[0].score for d in (DEPTH, DEPTH[:, ::-1])]
    assert max(scores) < from_depth._MIN_SIZE_SCORE
    with pytest.raises(ObservationError, match="enough"):
        from_depth.sized_start(small, [DEPTH, DEPTH[:, ::-1]], CAMERA, up=UP)
    assert used == [2]


@pytest.mark.parametrize(
    ("kind", "points", "depth", "says"),
    [
        (ObservationError, None, None, "neither"),
        (ObservationError, None, np.ones((10, 10)), "shape"),
        (TrackingError, None, np.zeros((240, 320)), "no measurement"),
        (TrackingError, None, 1000.0 * DEPTH, "millimetres"),
        (TrackingError, None, np.full((240, 320), np.nan), "no measurement"),
        (ObservationError, np.full((500, 3), np.nan), None, "0 points"),
        (ObservationError, np.zeros((0, 3)), None, "0 points"),
        (ObservationError, 1000.0 * to_points(DEPTH, CAMERA, step=3), None, "image|millimetres"),
    ],
)
def test_bad_input_is_told(kind, points, depth, says):
    with pytest.raises(kind, match=says):
        start_from_points(BODY, points, CAMERA, depth, up=UP)


def test_no_surfaces_and_no_up_are_told():
    with pytest.raises(BodyError, match="surfaces"):
        start_from_points(replace(BODY, surfaces=()), None, CAMERA, DEPTH)
    with pytest.raises(ObservationError, match="direction"):
        start_from_points(BODY, None, CAMERA, DEPTH, up=(0, 0, 0))
