"""The loop of all bundle adjustments: information, covariances, gauges and refused steps."""

from dataclasses import replace

import numpy as np
from tests.oracle import rig_around

from kinefit.geometry.losses import SQUARED
from kinefit.solving.bundle.adjust import BundleState, adjust
from kinefit.solving.bundle.cameras import CENTRE, COLUMNS, FOCAL, POSE, CameraPrior, PointPixels, camera_jacobian
from kinefit.solving.bundle.shape import PointProblem

RIG = rig_around((0.0, 0.0, 0.0), cameras=3)


def scene(noise=0.5, count=30):
    random = np.random.default_rng(2)
    x = random.uniform(-0.8, 0.8, (count, 3))
    point, camera = (a.ravel() for a in np.meshgrid(np.arange(count), np.arange(3), indexing="ij"))
    uv = RIG.project(x[point], camera)
    return x, PointPixels(camera, point, uv + noise * random.normal(size=uv.shape), np.full(len(uv), noise**-2))


def known_gauge():
    """The first camera and one coordinate of the second fixed; two kinds of intrinsics of the third with a prior."""
    sigma = np.zeros((3, COLUMNS))
    sigma[1:, POSE] = np.inf
    sigma[1, 2] = 0.0
    sigma[2, FOCAL], sigma[2, CENTRE] = 0.01, 5.0
    return CameraPrior(RIG, sigma)


def test_information_and_covariances_are_those_of_all_unknowns_together():
    (x, pixels), prior = scene(), known_gauge()
    start = BundleState(RIG, np.zeros(3), x)
    found = adjust(start, prior, PointProblem(pixels, SQUARED), iterations=0)
    J = np.zeros((2 * len(pixels.uv), 3 * COLUMNS + x.size))
    for m, (c, p) in enumerate(zip(pixels.camera, pixels.point, strict=True)):
        rows = slice(2 * m, 2 * m + 2)
        J[rows, c * COLUMNS : (c + 1) * COLUMNS] = camera_jacobian(RIG.cameras[c], x[p : p + 1])[0]
        J[rows, 3 * COLUMNS + 3 * p : 3 * COLUMNS + 3 * p + 3] = RIG.cameras[c].project_with_jacobian(x[p])[1]
    free, q = prior.free.ravel(), int(prior.free.sum())
    J = J[:, np.concatenate([free, np.ones(x.size, bool)])]
    H = 4.0 * J.T @ J
    S = H[:q, :q] - H[:q, q:] @ np.linalg.solve(H[q:, q:], H[q:, :q])
    scale = np.sqrt(np.diag(H)[:q])
    units = np.outer(scale, scale)
    np.testing.assert_allclose(found.S[np.ix_(free, free)] / units, S / units, atol=1e-6)
    assert not found.S[~free].any() and not found.S[:, ~free].any()
    H[range(q), range(q)] += prior.precision
    std = np.sqrt(np.diag(np.linalg.inv(H)))
    cov, (points,) = found.posterior.covariances()
    np.testing.assert_allclose(np.sqrt(np.diag(cov)), std[:q], rtol=1e-4)
    np.testing.assert_allclose(np.sqrt(np.einsum("pii->pi", points)).ravel(), std[q:], rtol=1e-4)


def test_standard_deviations_hold_for_the_errors_of_many_noises():
    x, pixels = scene(noise=0.5)
    prior, errors = known_gauge(), []
    exact = RIG.project(x[pixels.point], pixels.camera)
    for seed in range(40):
        noisy = replace(pixels, uv=exact + 0.5 * np.random.default_rng(seed).normal(size=exact.shape))
        found = adjust(BundleState(RIG, np.zeros(3), x), prior, PointProblem(noisy, SQUARED), tolerance=1e-9)
        std = np.sqrt(np.diag(found.posterior.covariances()[0]))
        errors.append(prior.departure(found.state.rig, np.zeros(3)) / std)
    pose = np.array(errors)[:, :11]  # the prior of the intrinsics is no scatter
    assert 0.85 < np.sqrt(np.mean(pose**2)) < 1.15


def test_a_step_to_no_camera_is_refused_and_the_search_goes_on():
    x, pixels = scene()
    problem, refused = PointProblem(pixels, SQUARED), []

    class Fails(PointProblem):
        def moved(self, state, delta, moves):
            if not refused:
                refused.append(True)
                raise ValueError("a distortion overflows")
            return super().moved(state, delta, moves)

    start = BundleState(RIG, np.zeros(3), x)
    found = adjust(start, known_gauge(), Fails(pixels, SQUARED), tolerance=1e-9)
    expected = adjust(start, known_gauge(), problem, tolerance=1e-9)
    assert refused and abs(found.cost / expected.cost - 1.0) < 1e-6
    assert found.cost < adjust(start, known_gauge(), problem, iterations=0).cost
