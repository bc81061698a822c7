"""Surfaces of drawn planes: places, standard deviations, images that do not fit, interlaced fields."""

import numpy as np
import pytest
from tests.images.photogrammetry import scenes

from kinefit.cli.surfaces._measure import field_camera, field_of
from kinefit.errors import CalibrationError, ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.images.photogrammetry.intersection import intersect
from kinefit.images.photogrammetry.least_squares_matching import Grid
from kinefit.images.photogrammetry.spline_image import SplineImage
from kinefit.images.photogrammetry.surface import measure, measure_states, rigid_motion, surface_strain

TEXTURE = scenes.Texture(0.005, 3)
TILT = se3.transform(se3.exp_so3(np.array([0.05, 0.15, 0.0])), np.array([0.0, 0.01, 0.02]))
GRID = Grid.of((200, 150), 12, margin=12)


def images(rig, pose=TILT, noise=3.0, seed=0):
    rng = np.random.default_rng(seed)
    return [scenes.plane_image(view, TEXTURE, pose, noise, rng) for view in rig]


def heights(surface, pose=TILT):
    """Distance (M,) of the measured points from the plane, and its stated standard deviation."""
    n, seen = pose[:3, 2], surface.measured
    distance = (surface.x_world[seen] - pose[:3, 3]) @ n
    return distance, np.sqrt(np.einsum("i,nij,j->n", n, surface.covariance[seen], n))


@pytest.mark.parametrize(("cameras", "constrained"), [(2, False), (2, True), (3, False), (3, True)])
def test_a_plane_is_measured_as_well_as_stated(cameras, constrained):
    rig = Rig(scenes.three().cameras[:cameras])
    surface = measure(rig, images(rig), GRID, constrained=constrained)
    assert surface.measured.mean() > 0.95 and len(surface.triangles) > 100
    distance, std = heights(surface)
    assert np.sqrt(np.mean(distance**2)) < 4e-4
    assert 0.6 < np.sqrt(np.mean((distance / std) ** 2)) < 1.4
    assert np.nanmedian(surface.parallax) < 0.1


def test_more_images_are_better_than_two():
    rig = scenes.three()
    errors = [heights(measure(r, images(r), GRID))[0].std() for r in (Rig(rig.cameras[:2]), rig)]
    assert errors[1] < errors[0]


def test_intersection_has_the_covariance_of_its_jacobian():
    rig, rng = scenes.three(), np.random.default_rng(1)
    x = rng.uniform(-0.05, 0.05, (400, 3))
    noise = np.array([[0.09, 0.03], [0.03, 0.04]])
    root = np.linalg.cholesky(noise)
    uv = np.stack([view.project(x) + rng.normal(size=(400, 2)) @ root.T for view in rig], axis=1)
    told = intersect(rig, uv, np.broadcast_to(noise, (400, 3, 2, 2)))
    gap = told.x_world - x
    square = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(told.covariance), gap)
    assert square.mean() == pytest.approx(3.0, rel=0.15)
    uv[0, :2] = np.nan
    assert np.isnan(intersect(rig, uv, np.broadcast_to(noise, (400, 3, 2, 2))).x_world[0]).all()


def test_images_of_another_size_are_refused():
    rig = Rig(scenes.three().cameras[:2])
    told = images(rig)
    small = SplineImage.of(told[1].grey[:100])
    with pytest.raises(CalibrationError, match="camera b.*200x100.*200x150"):
        measure(rig, [told[0], small], GRID)
    with pytest.raises(ObservationError, match="1 images for 2"):
        measure(rig, told[:1], GRID)


def test_no_texture_and_texture_that_repeats_are_refused():
    rig, rng = Rig(scenes.three().cameras[:2]), np.random.default_rng(0)
    blank = [SplineImage.of(120 + rng.normal(size=(150, 200))) for _ in rig]
    with pytest.raises(ObservationError, match="no texture"):
        measure(rig, blank, GRID)

    def stripes(x):
        return 128 + 50 * np.sin(2 * np.pi * x[:, 0] / 0.03) * np.sin(2 * np.pi * x[:, 1] / 0.03)

    told = [scenes.plane_image(view, stripes, TILT) for view in rig]
    with pytest.raises(ObservationError, match="repeats"):
        measure(rig, told, GRID)


def test_cameras_in_one_place_are_refused():
    rig = Rig(scenes.three(apart=0.004).cameras[:2])
    with pytest.raises(CalibrationError, match="degrees at most"):
        measure(rig, images(rig), GRID)
    rig = Rig(scenes.three(apart=0.0).cameras[:2])
    with pytest.raises(CalibrationError, match="camera b.*at the position of camera a"):
        measure(rig, images(rig), GRID)


@pytest.mark.parametrize("field", ["odd", "even"])
def test_a_field_of_an_interlaced_image_measures_the_same_plane(field):
    rig = Rig(scenes.three().cameras[:2])
    x = np.array([[0.01, 0.02, 0.0]])
    half = field_camera(rig.cameras[0], field)
    line = rig.cameras[0].project(x)[0, 1]
    assert half.project(x)[0, 1] == pytest.approx((line - (field == "even")) / 2)
    halves = Rig(tuple(field_camera(view, field) for view in rig))
    told = [SplineImage.of(field_of(image.grey, field)) for image in images(rig, noise=1.0)]
    surface = measure(halves, told, Grid.of(told[0].size, 10, margin=12))
    assert surface.measured.mean() > 0.8
    assert np.median(np.abs(heights(surface)[0])) < 5e-4


@pytest.mark.parametrize("incremental", [False, True])
def test_states_tell_the_rigid_motion(incremental):
    rig = Rig(scenes.three().cameras[:2])
    steps = [se3.exp(np.array([0.004 * k, 0.002 * k, 0.006 * k, 0.0, 0.02 * k, 0.03 * k])) for k in range(3)]
    states = [images(rig, T @ TILT, noise=1.0, seed=k) for k, T in enumerate(steps)]
    surfaces = measure_states(rig, states, GRID, window=21, incremental=incremental)
    for T, surface in zip(steps[1:], surfaces[1:]):
        found, residual = rigid_motion(surfaces[0].x_world, surface.x_world)
        assert np.isfinite(residual).all(axis=1).mean() > 0.7
        gap = se3.log(found @ se3.inverse(T))
        assert np.abs(gap).max() < 2e-3
        assert np.sqrt(np.nanmean(residual**2)) < 2e-4
    strain = surface_strain(surfaces[0], surfaces[-1], 0.12, 21)
    assert np.isfinite(strain.xx).mean() > 0.3
    z = strain.xx[np.isfinite(strain.xx)] / strain.std_xx[np.isfinite(strain.xx)]
    assert np.sqrt(np.mean(z**2)) < 2.0  # a rigid motion strains nothing
