"""Size and marker offsets with poses: derivatives, and a known subject found again."""

import numpy as np
import pytest

from kinefit.bodies import BodyState, load_body
from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.losses import SQUARED
from kinefit.solvers.marker_shape import fit_marker_shape, marker_equations, marker_parameters

BODY = load_body("humanoid")
POINTS = BODY.markers("HANIM_45")


def random_state(rng, spread=0.3):
    tree = BODY.tree
    angles = np.clip(tree.usual + spread * rng.normal(size=len(tree.usual)), tree.lower, tree.upper)
    root = se3.transform(se3.exp_so3(rng.normal(size=3)), rng.normal(size=3))
    return BodyState(root, angles)


def placed(parameters, theta, state):
    moved, rest, _ = parameters.geometry(theta)
    f, _ = moved.forward(state.T_world_root, state.angles)
    f = f[POINTS.segments]
    return (f[:, :9].reshape(-1, 3, 3) @ rest[:, :, None])[..., 0] + f[:, 9:]


@pytest.mark.parametrize("spread", [0.0, 1e-7, 0.3])
def test_gradient_is_that_of_the_cost(spread):
    rng = np.random.default_rng(1)
    parameters = marker_parameters(BODY, POINTS, np.full(len(POINTS), 0.02), 1.0)
    theta = parameters.mean + 0.02 * rng.normal(size=len(parameters.mean))
    state, n = random_state(rng, spread), BODY.tree.n_dofs
    x = placed(parameters, theta, state) + 0.01 * rng.normal(size=(len(POINTS), 3))
    weight = rng.uniform(1, 2, len(POINTS))
    weight[3] = 0.0

    def cost(delta):
        away = x - placed(parameters, theta + delta[n:], state.retract(delta[:n]))
        return float(weight @ np.sum(away**2, axis=1))

    H, g = marker_equations(parameters, theta, state, x, weight, SQUARED)
    for k in rng.permutation(len(g))[:60]:
        d = np.zeros(len(g))
        d[k] = 1e-5
        assert -2.0 * g[k] == pytest.approx((cost(d) - cost(-d)) / 2e-5, abs=2e-6)
    J = np.empty((3 * len(POINTS), len(g)))
    for k in range(len(g)):
        d = np.zeros(len(g))
        d[k] = 1e-6
        plus, minus = (placed(parameters, theta + s * d[n:], state.retract(s * d[:n])) for s in (1, -1))
        J[:, k] = ((plus - minus) / 2e-6).ravel()
    full = (J * np.repeat(weight, 3)[:, None]).T @ J
    np.testing.assert_allclose(np.tril(H), np.tril(full), atol=1e-5)


def test_a_known_subject_is_found_again():
    rng = np.random.default_rng(2)
    parameters = marker_parameters(BODY, POINTS, np.full(len(POINTS), 0.02), 1.0)
    theta = parameters.mean.copy()
    theta[:10] = 1.05 + 0.03 * rng.normal(size=10)
    theta[10:] = 0.015 * rng.normal(size=len(theta) - 10)
    states = [random_state(rng, 0.4) for _ in range(30)]
    x = np.stack([placed(parameters, theta, s) for s in states]) + 0.001 * rng.normal(size=(30, len(POINTS), 3))
    x[4, 7] += 0.3  # a ghost
    near = [s.retract(0.05 * rng.normal(size=BODY.tree.n_dofs), (BODY.tree.lower, BODY.tree.upper)) for s in states]
    rough = fit_marker_shape(parameters, x, np.full(x.shape[:2], 1e3), near)  # [1/m²] so that no marker is far off
    start = np.concatenate([rough.scales, rough.offsets.ravel()])
    shape = fit_marker_shape(parameters, x, np.full(x.shape[:2], 1e6), rough.states, start=start, tolerance=1e-6)
    middle = [BODY.scale_groups.index(g) for g in ("upperarm", "forearm", "thigh", "shank")]
    assert np.abs(shape.scales[middle] - theta[middle]).max() < 0.01
    assert np.all(np.abs(shape.scales - theta[:10]) < 4 * shape.scale_std + 0.003)
    fitted = np.concatenate([shape.scales, shape.offsets.ravel()])
    off = np.linalg.norm(np.stack([placed(parameters, fitted, s) for s in shape.states]) - x, axis=2)
    assert off[4, 7] > 0.29
    off[4, 7] = 0.0
    assert np.sqrt(np.mean(off**2)) < 0.002


def test_what_does_not_belong_together_is_told():
    parameters = marker_parameters(BODY, POINTS, np.full(len(POINTS), 0.02), 1.0)
    with pytest.raises(ObservationError, match="0 states"):
        fit_marker_shape(parameters, np.zeros((0, 45, 3)), np.zeros((0, 45)), [])
