"""Depth images to points: exact against plain numpy, edges cleaned and surfaces kept, fewer points evenly."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera
from kinefit.images.depth import clean, downsample, normals, slope_of, to_points

K = [[150.0, 0, 79.0], [0, 152.0, 61.0], [0, 0, 1]]


def camera(distortion=(0.1, -0.05, 0.001, -0.002, 0.01), size=(160, 124)):
    T = se3.exp(np.array([0.3, -0.2, 0.5, 0.4, 0.9, -0.3]))
    return Camera("tof", size, K, distortion, T_camera_world=T)


def plane(cam, normal, distance):
    """Depth image of a plane normal·x = distance in the camera's frame."""
    rays = np.concatenate([cam.ray_table, np.ones((1, *cam.size[::-1]))])
    with np.errstate(divide="ignore"):
        z = distance / np.tensordot(np.asarray(normal, float), rays, 1)
    return np.where((z > 0) & (z < 20), z, 0).astype(np.float32)


def test_points_project_back_to_their_pixels_at_their_depth():
    cam, rng = camera(), np.random.default_rng(0)
    depth = rng.uniform(0.5, 4, cam.size[::-1]).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0
    mask = rng.random(depth.shape) < 0.5
    x = to_points(depth, cam, mask=mask, near=1.0, far=3.0)
    v, u = np.nonzero(mask & (depth >= 1.0) & (depth <= 3.0))
    np.testing.assert_allclose(cam.project(x), np.stack([u, v], axis=1), atol=1e-6)
    z = (x @ cam.T_camera_world[:3, :3].T + cam.T_camera_world[:3, 3])[:, 2]
    np.testing.assert_allclose(z, depth[v, u], rtol=1e-7)


def test_a_step_takes_every_so_many_pixels():
    cam = camera(())
    depth = np.full(cam.size[::-1], 2.0, np.float32)
    pixels = np.round(cam.project(to_points(depth, cam, step=5)))
    np.testing.assert_array_equal(np.unique(pixels[:, 0]), np.arange(2, 160, 5))
    np.testing.assert_array_equal(np.unique(pixels[:, 1]), np.arange(2, 124, 5))


def test_pixels_that_no_ray_reaches_give_no_point():
    cam = camera((-0.9, 0.0, 0.0, 0.0))  # barrel so strong that the corners are beyond the fold
    lost = ~np.isfinite(cam.ray_table).all(axis=0)
    assert 0 < lost.sum() < lost.size
    depth = np.full(cam.size[::-1], 2.0, np.float32)
    assert len(to_points(depth, cam)) == (~lost).sum()
    assert np.isfinite(to_points(depth, cam)).all() and np.isfinite(normals(depth, cam)).all()


def test_flying_pixels_go_and_both_sides_of_the_edge_stay():
    cam = camera(())
    depth = np.full(cam.size[::-1], 3.0, np.float32)
    depth[30:90, 50:100] = 1.5
    depth[40:80, 50] = 2.2  # mixed with what is behind
    depth[10, 20] = 1.0  # a spike
    depth[60, 70] = 0.0  # a hole takes nothing with it
    out = clean(depth, cam)
    np.testing.assert_array_equal(np.argwhere((out == 0) & (depth > 0)), [[10, 20], *([v, 50] for v in range(40, 80))])


@pytest.mark.parametrize(("degrees", "kept"), [(0, True), (60, True), (80, True), (89, False)])
def test_steep_surfaces_stay_up_to_the_grazing_angle(degrees, kept):
    cam = camera(())
    angle = math.radians(degrees)
    depth = plane(cam, (math.sin(angle), 0, math.cos(angle)), 2.0 * math.cos(angle))
    middle = (slice(55, 65), slice(74, 84))
    assert (clean(depth, cam)[middle] > 0).all() == kept


def test_range_gate_and_nan():
    depth = np.array([[0.2, 0.5, 1.0, 4.0, np.nan, np.inf, -1.0]], np.float32)
    np.testing.assert_array_equal(clean(depth, near=0.5, far=4.0), [[0, 0.5, 1.0, 4.0, 0, 0, 0]])


def test_normals_of_a_plane_face_the_sensor_and_stop_at_edges():
    cam = camera(())
    n = np.array([0.5, -0.3, -1.0]) / np.linalg.norm([0.5, -0.3, -1.0])
    depth = plane(cam, n, -2.0)
    depth[:, 80:] -= 0.7
    found, x = normals(depth, cam, step=3), to_points(depth, cam, step=3)
    assert len(found) == len(x)
    u = np.round(cam.project(x)[:, 0])
    edge, inside = (np.abs(u - 79.5) < 2), (u > 4) & (u < 154) & (np.abs(u - 79.5) > 3)
    assert (found[edge] == 0).all()
    some = inside & (found != 0).any(axis=1)
    assert some.sum() > 0.9 * inside.sum()
    left = some & (u < 79)  # the right part was pushed along the rays, so it leans otherwise
    np.testing.assert_allclose(found[left], np.tile(n @ cam.T_camera_world[:3, :3], (left.sum(), 1)), atol=1e-4)
    assert (((cam.centre_world - x) * found).sum(axis=1)[some] > 0).all()


@given(st.integers(0, 500), st.floats(1, 50), st.integers(0, 100), st.integers(100, 300))
def test_downsampling_keeps_factor_minimum_and_maximum(n, factor, minimum, maximum):
    kept = downsample(np.arange(n), factor=factor, minimum=minimum, maximum=maximum)
    wanted = min(max(math.ceil(n / factor), minimum), maximum, n)
    assert len(kept) == wanted == len(set(kept.tolist()))
    if wanted > 1:  # evenly: no gap is twice another
        gaps = np.diff(kept)
        assert gaps.max() <= gaps.min() + 1


def test_what_cannot_be_is_told():
    cam = camera()
    with pytest.raises(ObservationError, match=r"shape \(3, 3\)"):
        to_points(np.zeros((3, 3)), cam)
    with pytest.raises(ObservationError, match="factor"):
        downsample(np.zeros((3, 3)), factor=0.5)
    with pytest.raises(ObservationError, match="depth image of shape"):
        clean(np.zeros(5))


def test_real_frames_lose_flying_pixels_and_little_else(data_dir):
    from kinefit.readers.depth.recordings import read_depth

    cam = Camera("sr305", (640, 480), [[476.007, 0, 313.683], [0, 476.007, 242.755], [0, 0, 1]])
    video = read_depth(data_dir("depth_sr305_upperbody") / "20210326-231615", unit=0.000125)
    for i in (0, 5, 10):
        depth = video.frame(i).depth
        cleaned = clean(depth, cam, near=0.2, far=1.5)
        assert 0 < ((depth > 0) & (cleaned == 0)).sum() < 0.01 * (depth > 0).sum()
        assert slope_of(cam) == pytest.approx(math.tan(math.radians(85)) / 476.007)
