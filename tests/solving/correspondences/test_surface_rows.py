"""Points to surfaces: what a row says, which points make none, and that the rows pull a body into place."""

import numpy as np
import pytest

from kinefit.bodies import load_body
from kinefit.bodies.surfaces.places import nearest
from kinefit.errors import ObservationError
from kinefit.solving.correspondences import anchored_rows, surface_rows
from kinefit.solving.correspondences.surfaces import anchored

BODY = load_body("humanoid10")
STATE = BODY.default_state()


def cloud(count=400, seed=0):
    """Points (N, 3) [m] within and about the body."""
    random = np.random.default_rng(seed)
    x = BODY.positions(STATE, BODY.landmarks)
    return x[random.integers(len(x), size=count)] + random.normal(scale=0.06, size=(count, 3))


def test_a_row_leads_from_the_surface_to_its_point():
    x = cloud()
    sigma = np.linspace(0.01, 0.03, len(x))
    rows = surface_rows(BODY, STATE, x, max_distance=0.05, sigma=sigma)
    found = nearest(BODY, STATE, x, max_distance=0.05)
    assert 50 < len(rows) == np.sum(found.segment >= 0) < len(x)
    np.testing.assert_allclose(rows.point + rows.residual[:, None] * rows.direction, x[rows.group], atol=1e-12)
    np.testing.assert_array_equal(rows.segment, found.segment[rows.group])
    np.testing.assert_array_equal(rows.residual, found.distance[rows.group])
    np.testing.assert_allclose(rows.weight, sigma[rows.group] ** -2)
    assert np.abs(rows.residual).max() < 0.05


def test_points_without_measurement_and_surfaces_that_face_away_make_no_row():
    x = cloud()
    x[::3] = np.nan
    rows = surface_rows(BODY, STATE, x)
    assert not np.any(rows.group % 3 == 0) and len(rows) > 100
    eye = np.array([3.0, 0.2, 0.1])
    seen = surface_rows(BODY, STATE, x, viewpoint=eye)
    facing = np.sum(rows.direction * (eye - rows.point), axis=1) > 0
    np.testing.assert_array_equal(seen.group, rows.group[facing])
    assert 0 < len(seen) < len(rows)


def test_a_segment_that_is_known_holds():
    x = cloud()
    rows = surface_rows(BODY, STATE, x, segment=np.where(np.arange(len(x)) % 2, 3, -1), max_distance=2.0)
    assert np.all(rows.segment[rows.group % 2 == 1] == 3) and len(set(rows.segment)) > 3
    assert len(surface_rows(BODY, STATE, np.zeros((0, 3)))) == 0


def test_points_keep_what_they_found_when_the_body_moves():
    x, state = cloud(), STATE.retract(np.linspace(-0.3, 0.3, BODY.tree.n_dofs))
    frames, _ = BODY.tree.forward(state.T_world_root, state.angles)
    rows = surface_rows(BODY, state, x, max_distance=0.2)
    measured, rest, normal = anchored(rows, x, frames)
    assert len(rows) > 50
    np.testing.assert_array_equal(measured, x[rows.group])
    again = anchored_rows(frames, rows.segment, rest, normal, measured, weight=rows.weight)
    np.testing.assert_allclose(again.data, rows.data, atol=1e-12)
    away = anchored_rows(BODY.tree.forward(STATE.T_world_root, STATE.angles)[0], rows.segment, rest, normal, measured)
    R, R0 = (BODY.tree.forward(s.T_world_root, s.angles)[0][:, :9].reshape(-1, 3, 3) for s in (state, STATE))
    turned = (R0 @ R.swapaxes(1, 2))[rows.segment]
    np.testing.assert_allclose(away.direction, np.einsum("nij,nj->ni", turned, rows.direction), atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [{"sigma": 0.0}, {"max_distance": -1.0}, {"segment": 99}, {"viewpoint": (np.nan, 0, 0)}, {"viewpoint": 1.0}],
)
def test_wrong_options_are_told(wrong):
    with pytest.raises(ObservationError):
        surface_rows(BODY, STATE, cloud(10), **wrong)
    with pytest.raises(ObservationError):
        surface_rows(BODY, STATE, np.zeros(3))
