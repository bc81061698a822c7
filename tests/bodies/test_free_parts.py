"""A body of free parts stands wherever its parts are put."""

import numpy as np
import pytest

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.parts import free_parts, parts_state
from kinefit.errors import BodyError
from kinefit.geometry import se3


@pytest.fixture(params=["humanoid10", "humanoid", "arm"], scope="module")
def body(request):
    return load_body(request.param)


def test_parts_may_stand_anywhere(body):
    random, parts = np.random.default_rng(0), free_parts(body)
    for size in (1e-7, 0.1, 3.0):
        R = se3.exp_so3(size * random.normal(size=(len(body.tree.segments), 3)))
        frames = np.concatenate([R.reshape(-1, 9), random.normal(size=(len(R), 3))], axis=1)
        state = parts_state(parts, frames)
        again, _ = parts.tree.forward(state.T_world_root, state.angles)
        np.testing.assert_allclose(again, frames, atol=1e-9)


def test_a_part_turned_by_a_right_angle_about_its_middle_axis_has_a_state(body):
    parts = free_parts(body)
    for sign in (1.0, -1.0):
        R = se3.exp_so3([0.0, 0.0, 0.7]) @ se3.exp_so3([sign * np.pi / 2, 0.0, 0.0]) @ se3.exp_so3([0.0, 0.4, 0.0])
        frames = np.tile(np.append(np.eye(3).ravel(), np.zeros(3)), (len(body.tree.segments), 1))
        frames[1:, :9] = R.ravel()
        state = parts_state(parts, frames)
        again, _ = parts.tree.forward(state.T_world_root, state.angles)
        np.testing.assert_allclose(again, frames, atol=1e-7)


def test_parts_keep_segments_points_and_surfaces(body):
    parts = free_parts(body)
    assert parts.tree.segments == body.tree.segments and parts.surfaces == body.surfaces
    assert parts.tree.n_dofs == 6 * len(body.tree.segments)
    state = BodyState(np.eye(4), np.zeros(len(parts.tree.coordinates)))
    np.testing.assert_allclose(parts.positions(state, parts.landmarks), body.points_rest(body.landmarks), atol=1e-12)


def test_frames_of_another_body_are_told():
    parts = free_parts(load_body("arm"))
    with pytest.raises(BodyError, match="frames of shape"):
        parts_state(parts, np.zeros((10, 12)))
