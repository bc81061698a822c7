"""Cameras against OpenCV, against their own inverse, and against finite differences."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinefit.errors import CalibrationError, ObservationError
from kinefit.geometry.camera import Camera, ImageFrame, Rig
from kinefit.geometry.lines import triangulate, triangulate_robust
from kinefit.geometry.se3 import exp_so3, transform

SIZE = (1280, 720)
MATRIX = np.array([[900.0, 0, 641.5], [0, 905.0, 352.25], [0, 0, 1]])
POSE = transform(exp_so3(np.array([0.3, -0.4, 0.9])), np.array([0.1, 0.2, 3.0]))
LENSES = [
    ("radtan", ()),
    ("radtan", (-0.3, 0.1, 0.001, -0.002)),
    ("radtan", (0.17, -0.25, 0.003, 0.002, 0.12)),
    ("radtan", (0.1, -0.2, 0.001, 0.002, 0.05, 0.2, -0.1, 0.02)),
    ("radtan", (-0.33, -0.013, 0.0, 0.0, 0.0, 0.0, 0.0, -0.19)),
    ("fisheye", ()),
    ("fisheye", (-0.02, 0.01, -0.003, 0.0005)),
    ("fisheye", (0.1, 0.02, 0.01, 0.001)),
]
lenses = pytest.mark.parametrize(("model", "distortion"), LENSES)


def camera_with(model="radtan", distortion=(), matrix=MATRIX, pose=POSE, name="cam"):
    return Camera(name, SIZE, matrix, distortion, model, pose)


def points_in_view(camera, count=400, seed=0):
    """Points 1.5 to 6 m along rays within and a little beside the image."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.05, 1.05, (count, 2)) * camera.size
    return camera.centre_world + camera.ray(uv) * rng.uniform(1.5, 6, (count, 1))


@lenses
def test_projects_like_opencv(model, distortion):
    camera = camera_with(model, distortion)
    x_world = points_in_view(camera)
    x_world = x_world[np.isfinite(x_world).all(1)]
    assert len(x_world) > 300
    R, t = cv2.Rodrigues(POSE[:3, :3])[0], POSE[:3, 3]
    k = np.array(distortion or (0.0,) * 4)
    project = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
    expected = project(x_world[:, None], R, t, MATRIX, k)[0][:, 0]
    np.testing.assert_allclose(camera.project(x_world), expected, atol=1e-9, rtol=0)


@lenses
def test_ray_and_project_are_inverse_over_the_whole_image(model, distortion):
    camera = camera_with(model, distortion)
    uv = np.stack(np.meshgrid(np.linspace(0, 1279, 60), np.linspace(0, 719, 40)), -1)
    directions = camera.ray(uv)
    assert directions.shape == (40, 60, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-15)
    x_world = camera.centre_world + 2.5 * directions
    np.testing.assert_allclose(camera.project(x_world), uv, atol=1e-9, rtol=0)
    np.testing.assert_allclose(camera.ray(camera.project(x_world)), directions, atol=1e-12, rtol=0)


@lenses
def test_jacobian_agrees_with_finite_differences(model, distortion):
    matrix = MATRIX + np.array([[0, 1.7, 0], [0, 0, 0], [0, 0, 0]])  # with skew
    camera = camera_with(model, distortion, matrix)
    axis = camera.centre_world + 2 * camera.T_world_camera[:3, 2]
    x_world = np.concatenate([points_in_view(camera), axis + np.array([[0, 0, 0], [1e-7, 0, 0], [0, 1e-4, 0]])])
    uv, jacobian = camera.project_with_jacobian(x_world)
    np.testing.assert_array_equal(uv, camera.project(x_world))
    h = 1e-5
    numeric = [(camera.project(x_world + h * e) - camera.project(x_world - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(jacobian, np.stack(numeric, -1), rtol=1e-6, atol=2e-4)


def test_skew_moves_u_by_the_distorted_y():
    x_world = np.array([0.4, -0.3, 2.0])
    plain = Camera("a", SIZE, MATRIX, (-0.3, 0.1, 0.001, -0.002))
    skewed = Camera("a", SIZE, MATRIX + np.array([[0, 3.0, 0], [0, 0, 0], [0, 0, 0]]), plain.distortion)
    uv = plain.project(x_world)
    expected = uv + [3.0 * (uv[1] - MATRIX[1, 2]) / MATRIX[1, 1], 0]
    np.testing.assert_allclose(skewed.project(x_world), expected, atol=1e-10)
    np.testing.assert_allclose(skewed.ray(expected) * np.linalg.norm(x_world), x_world, atol=1e-12)


def test_behind_the_camera_is_nan():
    assert np.isnan(Camera("a", SIZE, MATRIX).project([0.1, 0.2, -1.0])).all()
    wide = Camera("a", SIZE, MATRIX, (), "fisheye")
    assert np.isfinite(wide.project([1.0, 0.2, -0.1])).all(), "a fisheye lens sees beyond 90 degrees"
    assert np.isnan(wide.project([0.0, 0.0, -1.0])).all()


def test_folding_distortion_is_cut_where_it_turns():
    camera = Camera("a", SIZE, MATRIX, (-0.5, 0.0, 0.0, 0.0))  # r (1 - r²/2) turns at r = sqrt(2/3)
    turn = np.sqrt(2 / 3)
    assert np.isfinite(camera.project([turn * 0.999, 0, 1])).all()
    assert np.isnan(camera.project([turn * 1.001, 0, 1])).all()
    beyond = MATRIX[0, 2] + 1.01 * MATRIX[0, 0] * turn * (1 - turn**2 / 2)
    assert np.isnan(camera.ray([beyond, MATRIX[1, 2]])).all()


def test_unseeable_pixels_and_nan_points_stay_nan():
    camera = camera_with()
    assert np.isnan(camera.ray([np.nan, 3.0])).all()
    assert np.isnan(camera.project([np.nan, 0.0, 0.0])).all()


@given(st.floats(0.2, 3.0), st.floats(0.2, 3.0))
def test_scaled_camera_sees_the_scaled_image(fx, fy):
    camera = camera_with("radtan", (-0.3, 0.1, 0.001, -0.002))
    size = (round(SIZE[0] * fx), round(SIZE[1] * fy))
    x_world = points_in_view(camera, 20)
    expected = ImageFrame.scaled(SIZE, size).from_calibration(camera.project(x_world))
    np.testing.assert_allclose(camera.scaled(size).project(x_world), expected, atol=1e-8)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"matrix": np.diag([0.0, 900, 1])}, "focal"),
        ({"matrix": np.full((3, 3), np.nan)}, "finite"),
        ({"matrix": MATRIX.T}, "matrix"),
        ({"matrix": "x"}, "numbers"),
        ({"T_camera_world": np.diag([1.0, 1, -1, 1])}, "right-handed"),
        ({"T_camera_world": np.diag([1.1, 1, 1, 1])}, "orthonormal"),
        ({"distortion": np.zeros(7)}, "7 distortion"),
        ({"distortion": [0.0, 1e200, 0.0, 0.0]}, r"coefficient of 1e\+200"),
        ({"model": "orthographic"}, "radtan, fisheye"),
        ({"size": (0, 720)}, "size"),
    ],
)
def test_bad_camera_is_a_typed_error_that_names_it(change, word):
    with pytest.raises(CalibrationError, match=word) as caught:
        Camera(**({"name": "cam7", "size": SIZE, "matrix": MATRIX} | change))
    assert "cam7" in str(caught.value) and caught.value.remedy


def test_arrays_are_read_only():
    camera = camera_with()
    for array in (camera.matrix, camera.T_camera_world, camera.packed, Rig((camera,)).packed):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_letterbox_of_the_balancing_trial():
    frame = ImageFrame.letterboxed((1088, 1920), (1080, 1920))
    shift = frame.from_calibration([0.0, 0.0])
    assert shift[1] == pytest.approx(7.06, abs=0.01) and shift[0] == pytest.approx(0, abs=0.01)
    assert frame.scale == pytest.approx((1080 / 1088, 1080 / 1088))
    corners = frame.from_calibration([[-0.5, -0.5], [1087.5, 1919.5]])
    np.testing.assert_allclose(corners[:, 0], [-0.5, 1079.5])
    assert corners[:, 1].mean() == pytest.approx(959.5), "bars of equal height"


@given(st.integers(0, 3), st.integers(2, 3000), st.integers(2, 3000))
def test_frames_invert_and_turn_as_images_do(turns, width, height):
    frame = ImageFrame.rotated((640, 480), 90 * turns).then(
        ImageFrame.letterboxed((640, 480) if turns % 2 == 0 else (480, 640), (width, height))
    )
    uv = np.array([[0.0, 0.0], [639, 479], [3, 400], [320, 240]])
    np.testing.assert_allclose(frame.to_calibration(frame.from_calibration(uv)), uv, atol=1e-9)
    np.testing.assert_allclose(ImageFrame.identity().from_calibration(uv), uv)


@pytest.mark.parametrize("turns", range(4))
def test_rotation_is_clockwise(turns):
    image = np.arange(6 * 4).reshape(4, 6)
    turned = np.rot90(image, -turns)
    u, v = np.meshgrid(np.arange(6), np.arange(4))
    there = ImageFrame.rotated((6, 4), 90 * turns).from_calibration(np.stack([u, v], -1)).astype(int)
    np.testing.assert_array_equal(turned[there[..., 1], there[..., 0]], image)


def test_bad_frames_are_refused():
    for make in (
        lambda: ImageFrame.rotated((640, 480), 45),
        lambda: ImageFrame.scaled((640, 480), (0, 10)),
        lambda: ImageFrame(np.zeros((3, 3))),
    ):
        with pytest.raises(CalibrationError):
            make()


def ring(count=4, distortion=(-0.05, 0.14, 0.0006, 0.0007)):
    """Cameras on a circle of 4 m, 1.5 m high (z up), looking at (0, 0, 1)."""
    cameras = []
    for i in range(count):
        angle = 2 * np.pi * i / count + 0.2
        centre = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1.5])
        forward = np.array([0, 0, 1.0]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        cameras.append(Camera(f"cam{i + 1:02d}", SIZE, MATRIX, distortion, "radtan", transform(R, -R @ centre)))
    return Rig(tuple(cameras))


def test_rig_names_its_cameras():
    rig = ring()
    assert rig["cam03"] is rig.cameras[2] and len(rig) == 4 and rig.packed.shape == (4, 29)
    assert rig.select(("cam04", "cam01")).names == ("cam04", "cam01")
    with pytest.raises(CalibrationError, match="cam01, cam02, cam03, cam04"):
        rig["cam9"]
    with pytest.raises(CalibrationError, match="cam01"):
        Rig((rig["cam01"], rig["cam01"]))
    assert Rig(()).names == () and len(Rig(())) == 0  # markers alone


def test_moved_rig_sees_moved_points_alike():
    rig = ring()
    x = np.array([[0.1, 0.2, 1.1]])
    moved_x = x @ POSE[:3, :3].T + POSE[:3, 3]
    for before, after in zip(rig, rig.moved(POSE)):
        np.testing.assert_allclose(after.project(moved_x), before.project(x), atol=1e-9)


def seen_by(rig, x_world):
    return np.stack([camera.project(x_world) for camera in rig], axis=1)


def test_triangulation_is_exact_without_noise():
    rig, rng = ring(), np.random.default_rng(1)
    x_world = rng.uniform([-0.7, -0.7, 0], [0.7, 0.7, 2], (200, 3))
    points = seen_by(rig, x_world)
    points[::3, 1] = np.nan
    np.testing.assert_allclose(triangulate(rig, points), x_world, atol=1e-9)
    found, inliers, residual = triangulate_robust(rig, points, max_residual_px=5)
    np.testing.assert_allclose(found, x_world, atol=1e-9)
    assert not inliers[::3, 1].any() and np.isnan(residual[::3, 1]).all()
    assert inliers.sum() == np.isfinite(points[..., 0]).sum() and np.nanmax(residual) < 1e-6


def test_triangulation_minimises_the_weighted_pixel_error():
    rig, rng = ring(), np.random.default_rng(2)
    x_world = rng.uniform([-0.7, -0.7, 0], [0.7, 0.7, 2], (50, 3))
    points = seen_by(rig, x_world) + rng.normal(0, 3, (50, 4, 2))
    weights = rng.uniform(0.2, 1, (50, 4))
    found = triangulate(rig, points, weights)

    def cost(x):
        return (weights[..., None] * (seen_by(rig, x) - points) ** 2).sum((1, 2))

    for direction in np.concatenate([np.eye(3), -np.eye(3)]):
        assert (cost(found + 1e-4 * direction) > cost(found)).all()


def test_robust_triangulation_leaves_out_the_wrong_camera():
    rig, rng = ring(), np.random.default_rng(3)
    x_world = rng.uniform([-0.7, -0.7, 0], [0.7, 0.7, 2], (500, 3))
    points = seen_by(rig, x_world) + rng.normal(0, 1.0, (500, 4, 2))
    wrong = rng.integers(0, 4, 500)
    angle = rng.uniform(0, 2 * np.pi, 500)
    points[np.arange(500), wrong] += 150 * np.stack([np.cos(angle), np.sin(angle)], -1)
    found, inliers, residual = triangulate_robust(rig, points, max_residual_px=10)
    error = np.linalg.norm(found - x_world, axis=1)
    right = ~inliers[np.arange(500), wrong] & (inliers.sum(1) == 3)
    assert right.mean() > 0.99 and np.median(error) < 0.01
    assert residual[inliers].max() <= 10
    plain = np.linalg.norm(triangulate(rig, points) - x_world, axis=1)
    assert np.median(plain) > 10 * np.median(error)


def test_no_agreement_no_point():
    rig = ring()
    lone = np.full((1, 4, 2), np.nan)
    lone[0, 2] = 100.0
    apart = seen_by(rig, np.array([[0.0, 0, 1.0]]))
    apart[0, :, 1] += [0, 200, -200, 400]
    two = apart.copy()
    two[0, 2:] = np.nan
    for points in (lone, two):
        found, inliers, residual = triangulate_robust(rig, points, max_residual_px=5)
        assert np.isnan(found).all() and not inliers.any() and np.isnan(residual).all()
    assert np.isnan(triangulate(rig, lone)).all()
    same = Rig((rig["cam01"], Camera("twin", SIZE, MATRIX, (), "radtan", rig["cam01"].T_camera_world)))
    assert np.isnan(triangulate(same, np.full((1, 2, 2), 300.0))).all(), "one viewpoint gives no depth"


def test_bad_points_are_refused():
    rig = ring()
    good = np.zeros((5, 4, 2))
    for points, weights in ((good[:, :3], None), (good, np.ones((5, 3))), (good, -np.ones((5, 4)))):
        with pytest.raises(ObservationError):
            triangulate(rig, points, weights)
    with pytest.raises(ObservationError, match="pixel"):
        triangulate_robust(rig, good, max_residual_px=0)
    assert triangulate(rig, good[:0]).shape == (0, 3)
