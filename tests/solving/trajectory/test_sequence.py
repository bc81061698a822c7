"""Whole sequences in one call: the same minima as frame by frame."""

import numpy as np
import pytest
from benchmarks.robustness.faults_solver import MAX_GAIN, SETTINGS, beyond_limits, second_call
from tests.oracle import posture, random_unit

from kinefit.bodies import BodyState, load_body
from kinefit.errors import ObservationError
from kinefit.geometry.losses import SQUARED, huber
from kinefit.solving.correspondences import plane_rows, point_rows
from kinefit.solving.correspondences.points import prior_rows
from kinefit.solving.least_squares import levenberg_marquardt
from kinefit.solving.trajectory.sequence import Planes, fit_sequence

# Two ways to one minimum stop where a step would win 1e-12 of the cost. Where points hardly hold a joint, such a step
# may move it a little: a measurement that differs by 1e-12 m can end 3e-6 m away. So the costs tell, sharply, that the
# minimum is the same, and the positions need agree only far within what was measured (5 and 10 mm).
SAME_COST, SAME_PLACE = 1e-7, 1e-3

BODY = load_body("humanoid")
POINTS = BODY.landmarks


def sway(frames=12, seed=1):
    """A smooth motion between two postures, and its points with 2 mm noise."""
    random = np.random.default_rng(seed)
    a, b = posture(BODY, seed, 0.3), posture(BODY, seed + 1, 0.3)
    states = [a.retract(t * 0.4 * a.difference(BodyState(a.T_world_root, b.angles))) for t in np.linspace(0, 1, frames)]
    x = np.stack([BODY.positions(s, POINTS) for s in states])
    return states, x, x + 0.002 * random.normal(size=x.shape)


def states_of(result):
    return [BodyState(T, q) for T, q in zip(result.Ts_world_root, result.angles, strict=True)]


@pytest.mark.parametrize("loss", [SQUARED, huber()], ids=["squared", "huber"])
@pytest.mark.parametrize("limits", [True, False])
def test_points_give_what_frame_by_frame_gives(loss, limits):
    states, _, measured = sway()
    result = fit_sequence(
        BODY, BODY.rest_state(states[0].T_world_root), POINTS, measured, loss=loss, limits=limits, tolerance=1e-12
    )
    start = BODY.rest_state(states[0].T_world_root)
    for f, found in enumerate(states_of(result)):
        make = lambda s: point_rows(BODY, s, POINTS, measured[f], sigma=0.005)  # noqa: B023
        fit = levenberg_marquardt(BODY, start, make, loss=loss, limits=limits, tolerance=1e-12, max_iterations=100)
        assert result.costs[f] == pytest.approx(fit.equations.cost, rel=SAME_COST)
        np.testing.assert_allclose(BODY.positions(found, POINTS), BODY.positions(fit.state, POINTS), atol=SAME_PLACE)
        start = fit.state
    assert np.all(result.iterations[1:] <= 8)


def test_the_posture_prior_is_that_of_every_other_fit():
    """Trunk and hips are coupled in it, which are on different branches."""
    assert BODY.tree.coupled
    states, x, _ = sway(frames=4)
    x[:, np.isin(POINTS.segments, [BODY.tree.segment(n) for n in ("abdomen", "thorax", "thigh_r", "shank_l")])] = np.nan
    start = BODY.default_state(states[0].T_world_root)
    found = fit_sequence(BODY, start, POINTS, x, posture=1.0, tolerance=1e-12)
    for f, state in enumerate(states_of(found)):
        seen = np.isfinite(x[f, :, 0])
        shown = POINTS.select([POINTS.names[k] for k in np.flatnonzero(seen)])
        make = lambda s: [point_rows(BODY, s, shown, x[f, seen], sigma=0.005), prior_rows(BODY, s)]  # noqa: B023
        fit = levenberg_marquardt(BODY, start, make, tolerance=1e-12, max_iterations=100)
        assert found.costs[f] == pytest.approx(fit.equations.cost, rel=SAME_COST)
        np.testing.assert_allclose(state.angles, fit.state.angles, atol=1e-5)
        start = fit.state


@pytest.mark.parametrize("loss", SETTINGS)
def test_solving_again_wins_nothing(loss):
    """Limits make steps bad, and hundreds of good steps lower the damping between them: it must be able to rise."""
    body, points, x = beyond_limits(1200)
    found = fit_sequence(body, body.default_state(), points, x, **SETTINGS[loss])
    at_limit = (found.angles <= body.tree.lower) | (found.angles >= body.tree.upper)
    assert at_limit.any(axis=1).mean() > 0.9
    gain = second_call(body, points, x, found.Ts_world_root, found.angles, **SETTINGS[loss])
    assert gain.max() < MAX_GAIN


def test_exact_points_are_met():
    _, x, _ = sway()
    result = fit_sequence(BODY, BODY.rest_state(), POINTS, x, tolerance=1e-10)
    for found, truth in zip(states_of(result), x, strict=True):
        np.testing.assert_allclose(BODY.positions(found, POINTS), truth, atol=1e-5)
    assert result.costs.max() < 1e-4


def test_a_frame_that_fits_exactly_does_not_stop_the_next():
    """Steps that cannot better what is exact raise the damping; the next frame must not start with that."""
    for seed in range(10):
        states, x, _ = sway(2, seed)
        three, normals = POINTS.select(POINTS.names * 3), random_unit(np.random.default_rng(seed), 2, 3 * len(POINTS))
        planes = Planes(three, np.tile(x, (1, 3, 1)), normals, 0.002)
        result = fit_sequence(BODY, states[0].retract(np.full(47, 0.01)), planes=planes)
        assert result.costs.max() < 1e-3, f"seed {seed}: {result.costs}"


@pytest.mark.parametrize("missing", [False, True])
def test_planes_give_what_frame_by_frame_gives(missing):
    states, _, _ = sway(5)
    random = np.random.default_rng(0)
    points = POINTS.select(tuple(random.permutation(POINTS.names * 3)))
    exact = np.stack([BODY.positions(s, points) for s in states])
    normal = random_unit(random, *exact.shape[:2])
    along = 0.3 * random.normal(size=exact.shape)
    on_plane = exact + along - np.sum(along * normal, axis=-1, keepdims=True) * normal  # anywhere in each plane
    on_plane += 0.003 * random.normal(size=(*exact.shape[:2], 1)) * normal
    if missing:
        on_plane[:, ::9] = np.nan
        normal[:, 4::9] = np.nan
    planes = Planes(points, on_plane, normal, sigma=0.01)
    result = fit_sequence(BODY, states[0], planes=planes, tolerance=1e-12)
    for f, found in enumerate(states_of(result)):
        make = lambda s: plane_rows(BODY, s, points, on_plane[f], normal[f], sigma=0.01)  # noqa: B023
        fit = levenberg_marquardt(BODY, states[f], make, tolerance=1e-12, max_iterations=100)
        assert result.costs[f] == pytest.approx(fit.equations.cost, rel=SAME_COST)
        np.testing.assert_allclose(BODY.positions(found, POINTS), BODY.positions(fit.state, POINTS), atol=SAME_PLACE)


def test_points_and_planes_together_and_points_that_are_missing():
    states, x, measured = sway(4)
    random = np.random.default_rng(0)
    measured[:, ::3] = np.nan
    measured[3] = np.nan  # a whole frame: planes alone
    three = POINTS.select(POINTS.names * 3)
    planes = Planes(three, np.tile(x, (1, 3, 1)), random_unit(random, 4, len(three)), 0.002)
    result = fit_sequence(BODY, states[0], POINTS, measured, planes=planes)
    for found, truth in zip(states_of(result), x, strict=True):
        assert np.linalg.norm(BODY.positions(found, POINTS) - truth, axis=1).mean() < 0.005


def test_a_frame_without_measurements_repeats_the_last():
    states, _, measured = sway(3)
    measured[1] = np.nan
    result = fit_sequence(BODY, states[0], POINTS, measured)
    np.testing.assert_array_equal(result.angles[1], result.angles[0])
    assert result.costs[1] == 0 and np.all(np.isfinite(result.angles))


def test_a_first_frame_without_measurements():
    states, x, measured = sway(3)
    measured[0] = np.nan
    result = fit_sequence(BODY, states[0], POINTS, measured)
    np.testing.assert_array_equal(result.angles[0], states[0].angles)
    found = states_of(result)[2]
    assert np.linalg.norm(BODY.positions(found, POINTS) - x[2], axis=1).mean() < 0.005


def test_limits_and_locks_hold():
    states, x, _ = sway(3)
    d = BODY.tree.coordinate("knee_angle_r")
    angles = np.array(states[0].angles)
    angles[d] = BODY.tree.lower[d] - 0.4
    far = np.repeat(BODY.positions(BodyState(states[0].T_world_root, angles), POINTS)[None], 3, axis=0)
    result = fit_sequence(BODY, states[0], POINTS, far)
    np.testing.assert_array_equal(result.angles[:, d], BODY.tree.lower[d])
    assert np.all(result.angles >= BODY.tree.lower) and np.all(result.angles <= BODY.tree.upper)
    locked = np.zeros(47, bool)
    locked[[0, 6 + d]] = True
    result = fit_sequence(BODY, states[0], POINTS, x, locked=locked)
    np.testing.assert_array_equal(result.angles[:, d], states[0].angles[d])
    np.testing.assert_array_equal(result.Ts_world_root[:, 0, 3], states[0].T_world_root[0, 3])


def test_wrong_shapes_are_told():
    states, x, _ = sway(2)
    with pytest.raises(ObservationError, match=rf"shape \(2, 5, 3\).*{len(POINTS)}, 3"):
        fit_sequence(BODY, states[0], POINTS, x[:, :5])
    with pytest.raises(ObservationError, match="of planes of shape"):
        fit_sequence(BODY, states[0], planes=Planes(POINTS, x, x[:, :5]))
