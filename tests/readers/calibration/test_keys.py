"""Keys beside a camera's matrix, rotation and translation: read with the right value, or refused by name."""

import json

import numpy as np
import pytest

from kinefit.errors import CalibrationError
from kinefit.geometry.se3 import exp_so3, inverse, log_so3, transform
from kinefit.readers.calibration.read import read_calibration
from kinefit.readers.calibration.write import write_calibration_like

K = [[900.0, 0, 641.5], [0, 905.0, 352.25], [0, 0, 1]]
D = [-0.21, 0.08, 0.001, -0.002, 0.01]
POSES = [transform(exp_so3(np.array(w)), np.array(t)) for w, t in (((0.3, -0.4, 0.9), (0.1, 0.2, 3.0)),
         ((2.9, 0.1, 0.2), (-1.0, 0.5, 2.0)))]  # fmt: skip
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # looks along -z, y up


def lens(**changes):
    return {k: v for k, v in ({"K": K, "dist": D, "size": [1280, 720]} | changes).items() if v is not None}


def pose(T):
    return {"R": T[:3, :3].tolist(), "t": T[:3, 3].tolist()}


def read(tmp_path, make, around=lambda tables: tables, count=2, **reading):
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(around({f"c{i}": make(T) for i, T in enumerate(POSES[:count])})))
    return read_calibration(path, **reading)


def assert_right(rig, distortion=D, model="radtan"):
    assert rig.names == tuple(f"c{i}" for i in range(len(rig))) and len(rig) == 2
    for camera, T in zip(rig, POSES):
        assert camera.size == (1280, 720) and camera.model == model
        np.testing.assert_allclose(camera.matrix, K, atol=1e-9)
        padded = np.pad(np.array(distortion, float), (0, 8 - len(distortion)))
        np.testing.assert_allclose(np.pad(camera.distortion, (0, 8 - camera.distortion.size)), padded, atol=1e-12)
        np.testing.assert_allclose(camera.T_camera_world, T, atol=1e-9)


PARTS = {"radial": [D[0], D[1], D[4]], "tangential": D[2:4]}
SCALARS = dict(zip(("k1", "k2", "p1", "p2", "k3"), D))


@pytest.mark.parametrize(
    "given",
    [
        {"kc": D}, {"coeffs": D}, {"distortion_vector": [D]}, {"dist_coeff": D}, {"lens_distortion": D},
        {"camera_distortion": D}, {"distortionParams": D}, {"D": D, "kc": [*D, 0, 0, 0]}, PARTS, SCALARS,
        {f"{key}_distortion": value for key, value in PARTS.items()},
        {"dist_coeff_k": PARTS["radial"], "dist_coeff_p": PARTS["tangential"]},
        {"RadialDistortion": PARTS["radial"], "tangential_coeffs": PARTS["tangential"], "K": np.add(
            K, [[0, 0, 1], [0, 0, 1], [0, 0, 0]]).tolist(), "size": [720, 1280]},  # MATLAB counts from one
        {"distortion": SCALARS}, {"distortion": {"model": "brown-conrady", "coeffs": D}}, {"lens": {"kc": D}},
        {"lens_model": {"name": "brown", "coeffs": D}}, {"distortion": {"type": "radtan", **PARTS}},
        {"distortion_parameters": SCALARS, "K": None, "model_type": "PINHOLE",
         "projection_parameters": {"fx": 900.0, "fy": 905.0, "cx": 641.5, "cy": 352.25}},
    ],
)  # fmt: skip
def test_a_lens_is_read_by_any_name(tmp_path, given):
    def make(T):
        return {key: value for key, value in (lens(dist=None) | pose(T) | given).items() if value is not None}

    assert_right(read(tmp_path, make))


def test_a_lens_of_tangential_terms_alone_is_read(tmp_path):
    assert_right(read(tmp_path, lambda T: lens(dist=None) | pose(T) | {"p1": 0.001}), [0, 0, 0.001, 0, 0])


@pytest.mark.parametrize(
    "given",
    [
        {"fisheye": True}, {"is_fisheye": 1}, {"distortion_model": "equidistant"}, {"camera_model": "OPENCV_FISHEYE"},
        {"projection": "fisheye"}, {"lens": "Fisheye"}, {"model_type": "KANNALA_BRANDT"}, {"distortion_type": 1},
    ],
)  # fmt: skip
def test_a_fisheye_is_read_by_any_name(tmp_path, given):
    assert_right(read(tmp_path, lambda T: lens(dist=D[:4]) | pose(T) | given), D[:4], "fisheye")
    scalars = dict(zip(("k1", "k2", "k3", "k4"), D))
    assert_right(read(tmp_path, lambda T: lens(dist=None) | pose(T) | scalars | given), D[:4], "fisheye")
    assert_right(read(tmp_path, lambda T: lens(dist=D[:4]) | pose(T), lambda cameras: {"cameras": cameras} | given),
                 D[:4], "fisheye")  # fmt: skip


TURNED = {
    "opengl": lambda T: pose(OPENGL @ T),
    "c2w": lambda T: pose(inverse(T)),
    "both": lambda T: {"extrinsic": (inverse(T) @ OPENGL).tolist()},
    "none": pose,
}


@pytest.mark.parametrize(
    ("turned", "stated"),
    [
        ("opengl", {"convention": "opengl"}), ("opengl", {"opengl": True}), ("opengl", {"is_opengl": 1}),
        ("opengl", {"coordinate_system": "Blender"}), ("opengl", {"camera_convention": "OpenGL, world to camera"}),
        ("c2w", {"c2w": True}), ("c2w", {"cam2world": "true"}), ("c2w", {"world2cam": False}), ("c2w", {"w2c": 0}),
        ("opengl", {"camera_axes": "opengl"}), ("opengl", {"style": "OpenGL"}), ("c2w", {"direction": "cam_to_world"}),
        ("none", {"distortion_order": ["k1", "k2", "p1", "p2", "k3"]}), ("none", {"transposed": False}),
        ("c2w", {"extrinsics_type": "camera-to-world"}), ("c2w", {"pose_type": "cam2world"}),
        ("both", {"convention": "opengl c2w"}), ("both", {"convention": "blender", "camera_to_world": True}),
        ("none", {"world2cam": True}), ("none", {"c2w": False}), ("none", {"convention": "OpenCV"}),
        ("none", {"opengl": False}), ("none", {"handedness": "right"}), ("none", {"convention": None}),
        ("none", {"rotation_format": "rodrigues", "radians": True}), ("none", {"scale": 1.0}),
    ],
)  # fmt: skip
def test_conventions_are_read_in_a_camera_around_it_and_in_metadata(tmp_path, turned, stated):
    make = TURNED[turned]
    assert_right(read(tmp_path, lambda T: lens() | make(T) | stated))
    assert_right(read(tmp_path, lambda T: lens() | make(T), lambda cameras: {"cameras": cameras} | stated))
    assert_right(read(tmp_path, lambda T: lens() | make(T), lambda cameras: cameras | {"metadata": stated}))


@pytest.mark.parametrize(
    "given",
    [
        lambda T: {"RT": T[:3].ravel().tolist()}, lambda T: {"extrinsic": T.ravel().tolist()},
        lambda T: {"extrinsics": [T[:3].ravel().tolist()]}, lambda T: {"c2w": inverse(T)[:3].ravel().tolist()},
        lambda T: {"R": T[:3, :3].ravel().tolist(), "t": [[v] for v in T[:3, 3]], "K": np.ravel(K).tolist()},
        lambda T: {"extrinsic_r": pose(T)["R"], "extrinsic_t": pose(T)["t"]},
        lambda T: {"rotvec": log_so3(T[:3, :3]).tolist(), "tvec": T[:3, 3].tolist()},
    ],
)  # fmt: skip
def test_flat_poses_and_tables_of_poses(tmp_path, given):
    rig = read(tmp_path, lambda T: lens() | given(T))
    assert_right(rig)
    moved = rig.moved(transform(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([0.1, 0, 0])))
    write_calibration_like(moved, tmp_path / "rig.json", tmp_path / "new.json")
    for camera, expected in zip(read_calibration(tmp_path / "new.json"), moved):
        np.testing.assert_allclose(camera.T_camera_world, expected.T_camera_world, atol=1e-9)


def test_a_table_of_rotation_and_translation_to_the_world(tmp_path):
    rig = read(tmp_path, lambda T: lens() | {"cam2world": pose(inverse(T))})
    assert_right(rig)
    with pytest.raises(CalibrationError, match="does not hold the pose"):
        write_calibration_like(rig.moved(OPENGL), tmp_path / "rig.json", tmp_path / "new.json")


@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("inch", 0.0254), (0.01, 0.01)])
def test_a_unit_is_read_where_it_stands(tmp_path, unit, metres):
    make = lambda T: lens() | pose(T) | {"t": (T[:3, 3] / metres).tolist()}
    assert_right(read(tmp_path, lambda T: make(T) | {"units": unit}))
    assert_right(read(tmp_path, make, lambda cameras: {"length_unit": unit, "cameras": cameras}))
    assert_right(read(tmp_path, make, lambda cameras: cameras | {"metadata": {"unit": unit}}))


def test_what_is_no_lens_and_no_convention_stays_silent(tmp_path):
    harmless = {
        "name": None, "serial": 123, "date": "2024-05-01", "rms": 0.31, "error": 0.2, "exposure": -7, "port": 1,
        "per_view_errors": [0.1, 0.2, 0.3, 0.4], "rotation_count": 1, "verified_resolutions": [[640, 480]],
        "fps": 29.97,
        "board_size": [9, 6], "square_size": 0.025, "model": "Basler acA1920", "type": "hd", "lens": "Fujinon 8 mm",
        "lens_focal_length": 8.5, "world_position": [1.5, 2, 3], "world_orientation": K, "distance": 3.5, "skew": 0.0,
        "xi": 0, "cov": [0.1, 0.2, 0.3, 0.4], "roi": [0.5, 0, 640, 480], "undistorted": False, "thin_prism": [0.0] * 4,
        "fov_degrees": 62.5, "software": "Blender",
    }  # fmt: skip
    assert_right(read(tmp_path, lambda T: lens() | pose(T) | {k: v for k, v in harmless.items() if v is not None}))
    undistorted = lambda T: lens(dist=None) | pose(T) | {"undistorted": True}
    assert_right(read(tmp_path, undistorted), [0.0] * 5)
    realsense = {"model": "distortion.inverse_brown_conrady", "coeffs": [0.0] * 5}
    assert_right(read(tmp_path, lambda T: lens(dist=None) | pose(T) | realsense), [0.0] * 5)
    assert_right(read(tmp_path, lambda T: lens() | pose(T) | {"camera_model": "OmniVision OV9281"}))


R = POSES[0][:3, :3]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"xi": 1.2}, "does not read xi.*lens"), ({"inverse_distortion": D}, "does not read inverse_distortion"),
        ({"undistorted": True}, "does not read undistorted"), ({"s1": 0.1}, "does not read s1"),
        ({"dist": None, "brown": D}, "does not read brown, which may be its lens"),
        ({"kc": [0.1, 0, 0, 0, 0]}, "distortion: stated twice"),
        ({"dist": None, "k1": 0.1, "k2": 0.1, "k3": 0.1, "k4": 0.1}, 'k4 of a lens.*"fisheye"'),
        ({"dist": None, "k1": 0.1, "p1": 0.1, "fisheye": True}, "p1 of a lens"),
        ({"camera_model": "ds"}, "lens of the model ds"), ({"camera_model": "eucm"}, "model eucm"),
        ({"model": "thin_prism_fisheye"}, "model thin_prism"), ({"distortion_model": "fov"}, "model fov"),
        ({"model": "inverse_brown_conrady"}, "model inverse"),
        ({"distortion_model": "my own"}, "model my own"), ({"projection": "equirectangular"}, "model equirect"),
        ({"convention": "unity"}, "convention = 'unity'"), ({"convention": "opencv y-up"}, "opencv y-up"),
        ({"handedness": "left"}, "handedness = 'left'"), ({"degrees": True}, "degrees = True"),
        ({"rotation_order": "zyx"}, "rotation_order = 'zyx'"), ({"opencv": False}, "opencv = False"),
        ({"distortion_order": "k1 k2 k3 p1 p2"}, "distortion_order"), ({"unity": True}, "unity = True"),
        ({"rvec_unit": "degrees"}, "rvec_unit"), ({"transposed": True}, "transposed"),
        ({"frame": "left-handed"}, "frame"),
        ({"rotation_unit": "deg"}, "rotation_unit = 'deg'"), ({"flip_y": True}, "flip_y = True"),
        ({"c2w": True, "world2cam": True}, "contradict.*c2w and w2c"), ({"scale": 0.001}, "does not read scale"),
        ({"R": [57.3, 10.0, 20.0]}, "more than one turn.*degrees"), ({"R": (2.5 * R).tolist()}, "scaled by 2.5"),
        ({"R": (np.diag([1, 1, -1]) @ R).tolist()}, "determinant is -1"),
        ({"R": (R + 0.01).tolist()}, "not orthonormal"), ({"unit": "furlong"}, "furlong"),
        ({"R": None, "t": None, "RT": POSES[0].T.ravel().tolist()}, "last row is not 0 0 0 1"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_named_with_what_to_do(tmp_path, changes, words):
    def make(T):
        return {key: value for key, value in (lens() | pose(T) | changes).items() if value is not None}

    with pytest.raises(CalibrationError, match=words) as caught:
        read(tmp_path, make)
    assert caught.value.remedy and "rig.json" in str(caught.value)


@pytest.mark.parametrize(
    "given", [{"quaternion": [0.1, 0.2, 0.3, 0.9]}, {"rotation_gl": R.tolist()}, {"qw": 1.0}, {"euler": [0.1, 0.2, 3]}]
)
def test_the_pose_of_a_single_camera_is_not_dropped(tmp_path, given):
    (key,) = given
    with pytest.raises(CalibrationError, match=f"does not read {key}, which may be its pose"):
        read(tmp_path, lambda T: lens() | given, count=1)
    rig = read(tmp_path, lambda T: lens() | given, exteriors=False)  # lenses alone are asked for
    assert len(rig) == 2


def test_the_views_of_a_board_are_no_pose(tmp_path):
    views = {"extrinsic_parameters": [[0.1, 0.2, 0.3, 1, 2, 3]] * 4, "rvecs": [[0.1, 0.2, 0.3]], "tvecs": [[1, 2, 3]]}
    rig = read(tmp_path, lambda T: lens() | views, count=1)
    np.testing.assert_array_equal(rig["c0"].T_camera_world, np.eye(4))


def test_cameras_that_state_different_units_are_refused(tmp_path):
    units = iter(("mm", "m"))
    with pytest.raises(CalibrationError, match="different units: m, mm"):
        read(tmp_path, lambda T: lens() | pose(T) | {"unit": next(units)})


def test_a_stereo_pair_has_its_convention(tmp_path):
    T = POSES[0]
    pair = {"K1": K, "D1": D, "K2": K, "D2": D, "size": [1280, 720], "R1": K, "P1": K, "Q": K}
    (tmp_path / "a.json").write_text(json.dumps(pair | {"R": pose(T)["R"], "T": pose(T)["t"], "convention": "opengl"}))
    rig = read_calibration(tmp_path / "a.json")
    for camera, in_opengl in zip(rig, (np.eye(4), T)):
        np.testing.assert_allclose(camera.T_camera_world, OPENGL @ in_opengl, atol=1e-9)
