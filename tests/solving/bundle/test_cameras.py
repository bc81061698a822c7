"""Cameras as unknowns: their parameters, derivatives, and free points taken out."""

import numpy as np
import pytest
from tests.oracle import rig_around

from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.losses import SQUARED
from kinefit.solving.bundle.adjust import BundleState, adjust
from kinefit.solving.bundle.cameras import (
    COLUMNS,
    FOCAL,
    TIME,
    CameraPrior,
    PointPixels,
    camera_jacobian,
    departure,
    moved_camera,
    moved_rig,
)
from kinefit.solving.bundle.shape import PointProblem


def bundle_adjust(rig, pixels, x, prior, **options):
    return adjust(BundleState(rig, np.zeros(len(rig)), x), prior, PointProblem(pixels), **options).state


def point_arrow(rig, free, pixels, x):
    state = BundleState(rig, np.zeros(len(rig)), x)
    return PointProblem(pixels, SQUARED).linearised(state, CameraPrior(rig, free))[:2]


def residuals(rig, offsets, pixels, x):
    projected = [rig.cameras[c].project(x[p]) for c, p in zip(pixels.camera, pixels.point, strict=True)]
    return pixels.uv - projected - offsets[pixels.camera, None] * pixels.motion


LENSES = {
    "plain": ("radtan", ()),
    "radtan": ("radtan", (-0.2, 0.08, 0.002, -0.001)),
    "rational": ("radtan", (-0.2, 0.08, 0.002, -0.001, 0.01, 0.03, -0.01, 0.002)),
    "fisheye": ("fisheye", (-0.05, 0.01, -0.002, 0.001)),
}


def a_camera(lens):
    model, k = LENSES[lens]
    camera = rig_around((0.0, 0.0, 0.0), cameras=4).cameras[1]
    matrix = np.array([[1500.0, 3.0, 540.0], [0.0, 1480.0, 950.0], [0.0, 0.0, 1.0]])
    return Camera("c", (1088, 1920), matrix, np.array(k), model, camera.T_camera_world)


@pytest.mark.parametrize("lens", LENSES)
def test_derivatives_by_a_cameras_parameters(lens):
    camera, x = a_camera(lens), np.random.default_rng(0).uniform(-0.7, 0.7, (6, 3))
    J = camera_jacobian(camera, x)
    for k in range(TIME - (lens == "fisheye")):
        step = np.zeros(COLUMNS)
        step[k] = 1e-6
        numeric = (moved_camera(camera, step).project(x) - moved_camera(camera, -step).project(x)) / 2e-6
        np.testing.assert_allclose(J[:, :, k], numeric, rtol=1e-5, atol=3e-5)
        assert np.abs(J[:, :, k]).max() > 5e-4


def test_the_way_between_two_rigs_leads_there():
    rig = rig_around((0.0, 0.0, 0.0), cameras=3)
    delta = np.random.default_rng(1).normal(scale=0.05, size=(3, COLUMNS))
    delta[:, TIME] = 0.0
    moved = moved_rig(rig, delta)
    np.testing.assert_allclose(departure(moved, rig), delta, atol=1e-9)
    assert moved.cameras[0].matrix[0, 0] == pytest.approx(rig.cameras[0].matrix[0, 0] * np.exp(delta[0, FOCAL]))


def many_points(noise=0.5, count=40):
    random = np.random.default_rng(2)
    rig = rig_around((0.0, 0.0, 0.0), cameras=3)
    x = random.uniform(-0.8, 0.8, (count, 3))
    point, camera = (a.ravel() for a in np.meshgrid(np.arange(count), np.arange(3), indexing="ij"))
    uv = np.stack([rig.cameras[c].project(x[p]) for p, c in zip(point, camera, strict=True)])
    pixels = PointPixels(camera, point, uv + noise * random.normal(size=uv.shape), np.full(len(uv), 4.0))
    return rig, x, pixels


def test_points_taken_out_leave_the_dense_solution():
    rig, x, pixels = many_points()
    free = np.ones((3, COLUMNS))
    free[1:, TIME] = free[0, :6] = 0.0
    motion = np.random.default_rng(3).normal(size=(len(pixels.uv), 2))
    pixels = PointPixels(pixels.camera, pixels.point, pixels.uv, pixels.weight, motion)
    arrow, _ = point_arrow(rig, free, pixels, x)
    S_found, b_found, (back_found,) = arrow.reduced(*arrow.relative(0.0))
    size, used = int(free.sum()), np.concatenate([free.ravel() > 0, np.ones(x.size, bool)])
    J = np.zeros((2 * len(pixels.uv), len(used)))
    for m, (c, p) in enumerate(zip(pixels.camera, pixels.point, strict=True)):
        rows = slice(2 * m, 2 * m + 2)
        J[rows, c * COLUMNS : (c + 1) * COLUMNS] = camera_jacobian(rig.cameras[c], x[p : p + 1])[0]
        J[rows, c * COLUMNS + TIME] = motion[m]
        J[rows, free.size + 3 * p : free.size + 3 * p + 3] = rig.cameras[c].project_with_jacobian(x[p])[1]
    J = J[:, used]
    r = residuals(rig, np.zeros(3), pixels, x).ravel()
    H, g = 4.0 * J.T @ J, 4.0 * J.T @ r
    A, B, D = H[:size, :size], H[:size, size:], H[size:, size:]
    S = A - B @ np.linalg.solve(D, B.T)
    np.testing.assert_allclose(S_found, S, atol=1e-5 * np.abs(A).max())
    np.testing.assert_allclose(b_found, g[:size] - B @ np.linalg.solve(D, g[size:]), rtol=1e-4, atol=1e-3)
    delta = 1e-3 * np.random.default_rng(4).normal(size=size)
    back = np.linalg.solve(D, g[size:] - B.T @ delta).reshape(-1, 3)
    np.testing.assert_allclose(back_found[..., -1] - back_found[..., :-1] @ delta, back, atol=1e-8)


def test_a_bundle_of_free_points_finds_the_cameras_again():
    rig, x, pixels = many_points(noise=0.0, count=120)
    sigma = np.zeros((3, COLUMNS))
    sigma[1:, :6] = 1.0  # the first camera holds the place, the second's prior the scale
    sigma[1, 2] = 0.0
    delta = np.random.default_rng(5).normal(scale=0.01, size=(3, COLUMNS)) * (sigma > 0)
    start = moved_rig(rig, delta)
    start_x = x + np.random.default_rng(6).normal(scale=0.02, size=x.shape)
    bundle = bundle_adjust(start, pixels, start_x, CameraPrior(start, sigma), iterations=60, tolerance=1e-12)
    left = residuals(bundle.rig, bundle.offsets, pixels, bundle.blocks)
    assert np.abs(left).max() < 0.05
    assert np.abs(departure(bundle.rig, rig)).max() < 2e-3


def test_outliers_hardly_move_a_bundle():
    rig, x, pixels = many_points(noise=0.5, count=150)
    uv = pixels.uv.copy()
    uv[::13] += 80.0
    spoilt = PointPixels(pixels.camera, pixels.point, uv, pixels.weight)
    sigma = np.zeros((3, COLUMNS))
    sigma[:, :6] = 0.01
    clean, robust = (bundle_adjust(rig, p, x, CameraPrior(rig, sigma)).rig for p in (pixels, spoilt))
    assert np.abs(departure(robust, clean)).max() < 1.5e-3


def test_what_a_camera_cannot_see_counts_as_an_outlier():
    rig, x, pixels = many_points(count=30)
    behind = x.copy()
    behind[0] = rig.cameras[0].centre_world - 1.0 * rig.cameras[0].T_camera_world[2, :3]
    arrow, cost = point_arrow(rig, np.ones((3, COLUMNS)), pixels, behind)
    assert np.isfinite(arrow.H).all() and np.isfinite(arrow.g).all() and np.isfinite(cost)


def test_a_fixed_parameter_stays():
    rig, x, pixels = many_points()
    sigma = np.zeros((3, COLUMNS))
    sigma[:, 3:6] = 0.1
    moved = bundle_adjust(rig, pixels, x, CameraPrior(rig, sigma)).rig
    for a, b in zip(moved, rig, strict=True):
        np.testing.assert_allclose(a.centre_world, b.centre_world, atol=1e-12)
        np.testing.assert_array_equal(a.matrix, b.matrix)
    assert isinstance(moved, Rig)
