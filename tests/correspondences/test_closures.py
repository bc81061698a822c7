"""What closes a body's chains, against plain numpy and scipy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.oracle import slow_positions

from kinefit.bodies import BodyState, load_body
from kinefit.correspondences import _kernels_closures as kernels
from kinefit.correspondences.closures import STIFF, closed_at, closure_rows, owners
from kinefit.geometry import se3


def turned(body, state, segment):
    """(3, 3) rotation of a segment, from three of its points."""
    marks = body.landmarks
    axes = type(marks)(("o", "x", "y", "z"), np.full(4, segment), np.concatenate([np.zeros((1, 3)), np.eye(3)]))
    x = slow_positions(body, state, axes)
    return (x[1:] - x[0]).T


@pytest.mark.parametrize("name", ["cyclist", "snowboarder", "rower"])
@pytest.mark.parametrize("seed", range(2))
def test_values_in_numpy(name, seed):
    body, random = load_body(name), np.random.default_rng(seed)
    state = body.usual_state().retract(random.normal(scale=0.7, size=body.tree.n_dofs))
    closed, owner = closed_at(body, state), owners(body)
    marks = body.landmarks
    for k, c in enumerate(body.closures):
        own = closed.value[owner == k]
        x = slow_positions(body, state, marks.select((c.point,)))[0]
        R, at = np.eye(3), np.array(c.place)
        if c.to:
            at = slow_positions(body, state, marks.select((c.to,)))[0]
            R = turned(body, state, int(marks.select((c.to,)).segments[0]))
        np.testing.assert_allclose(own[: len(c.directions)], c.directions @ R.T @ (x - at), atol=1e-12)
        if c.kind == "rigid":
            mine = turned(body, state, int(marks.select((c.point,)).segments[0]))
            relative = Rotation.from_rotvec(c.turn).inv() * Rotation.from_matrix(R.T @ mine)
            np.testing.assert_allclose(own[3:], relative.as_rotvec(), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 1.5, 3.0, np.pi - 1e-4, np.pi - 1e-9])
def test_turns_of_any_size(angle):
    random = np.random.default_rng(2)
    for _ in range(5):
        axis = random.normal(size=3)
        e = angle * axis / np.linalg.norm(axis)
        found, rows = np.empty(3), np.empty((3, 3))
        kernels.rotation_vector(se3.exp_so3(e), found)
        np.testing.assert_allclose(found, e, atol=1e-9)
        M = Rotation.random(random_state=3).as_matrix()
        kernels.turn_rows(e, M, rows)
        np.testing.assert_allclose(rows, np.linalg.solve(se3.left_jacobian_so3(e), M.T), atol=1e-8)


def test_weights_are_those_of_the_deviations():
    body = load_body("cyclist")
    rows, owner = closure_rows(body, BodyState(np.eye(4), body.tree.usual)), owners(body)
    for k, c in enumerate(body.closures):
        std = 1.0 / np.sqrt(rows.weight[owner == k])
        wanted = [np.hypot(STIFF if c.hard and not c.place_std else 0.0 if c.hard else c.sigma, c.place_std)] * 3
        wanted += [np.hypot(STIFF if not c.turn_std else 0.0, c.turn_std)] * (c.rows - 3)
        np.testing.assert_allclose(std, wanted, rtol=1e-9)
    assert np.all(rows.group == -1)  # no closure is ever an outlier
