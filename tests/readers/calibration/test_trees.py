"""Files of programs that state lenses and poses apart, and the cases that users reported."""

import json

import numpy as np
import pytest

from kinefit.errors import CalibrationError
from kinefit.geometry.se3 import exp_so3, inverse, quaternion, transform
from kinefit.readers.calibration.read import read_calibration

K = np.array([[900.0, 0, 641.5], [0, 905.0, 352.25], [0, 0, 1]])
D = np.array([-0.21, 0.08, 0.001, -0.002])
T = [transform(exp_so3(np.array([0.3, 0.4 * i, 0.9])), np.array([0.1 * i, 0.2, 3.0])) for i in range(3)]
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def assert_right(rig, names, poses, *, model="radtan", matrix=K, distortion=D):
    assert sorted(rig.names) == sorted(names)
    for name, pose in zip(names, poses):
        camera = rig[name]
        assert camera.model == model and camera.size == (1280, 720)
        np.testing.assert_allclose(camera.matrix, matrix, atol=1e-9)
        np.testing.assert_allclose(camera.distortion[: len(distortion)], distortion, atol=1e-12)
        np.testing.assert_allclose(camera.T_camera_world, pose, atol=1e-9)


def relative():
    return [pose @ inverse(T[0]) for pose in T]


# ---------------------------------------------------------------- cases that users reported


@pytest.mark.parametrize(
    ("case", "file", "is_relative", "coefficients"),
    [
        ("calibration-lens-kc", "rig.json", False, 5),
        ("calibration-lens-distortion_vector", "calibrated_cameras_data.yml", True, 5),
        ("calibration-says-opengl", "rig.json", False, 5),
        ("calibration-world2cam-true", "rig.json", False, 5),
        ("calibration-colmap-without-points", ".", False, 4),
        ("calibration-kalibr-camchain", "camchain.yaml", True, 4),
    ],
)
def test_a_reported_calibration_has_the_true_cameras(data_dir, case, file, is_relative, coefficients):
    cases = data_dir("cases_of_users")
    truth = np.load(cases / "calibration-lens-distortion_vector" / "truth.npz")
    rig = read_calibration(cases / case / file)
    assert len(rig) == 3
    first = np.linalg.inv(truth["T"][0]) if is_relative else np.eye(4)
    for camera, true_K, true_D, true_T in zip(rig, truth["K"], truth["D"], truth["T"]):
        np.testing.assert_allclose(camera.matrix, true_K, atol=1e-9)
        np.testing.assert_allclose(camera.distortion[:coefficients], true_D[:coefficients], atol=1e-12)
        np.testing.assert_allclose(camera.T_camera_world, true_T @ first, atol=1e-9)


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("calibration-rotation-in-degrees/rig.json", "camera cam0.*126.7 radians.*more than one turn.*degrees"),
        ("calibration-vic3d/cal.xml", "calibration of VIC-3D.*kinefit calibrate board"),
    ],
)
def test_a_reported_calibration_that_is_refused(data_dir, case, words):
    with pytest.raises(CalibrationError, match=words):
        read_calibration(data_dir("cases_of_users") / case)


# ---------------------------------------------------------------- Kalibr, MC-Calib, multical


def kalibr(path, numbers=(0, 1, 2), lens="radtan", model="pinhole", lacking=()):
    text = ""
    for i, n in sorted(enumerate(numbers), key=lambda pair: str(pair[1])):  # YAML sorts cam10 before cam2
        step = f"  T_cn_cnm1: {(T[i] @ inverse(T[i - 1])).tolist()}\n"
        text += f"cam{n}:\n" + step * (i > 0 and n not in lacking) + f"  camera_model: {model}\n"
        text += f"  distortion_coeffs: {D.tolist()}\n  distortion_model: {lens}\n  cam_overlaps: [1, 2]\n"
        text += f"  intrinsics: [900.0, 905.0, 641.5, 352.25]\n  resolution: [1280, 720]\n  rostopic: /cam{n}/image\n"
    path.write_text(text)
    return path


@pytest.mark.parametrize(("lens", "model"), [("radtan", "radtan"), ("equidistant", "fisheye")])
@pytest.mark.parametrize("numbers", [(0, 1, 2), (0, 2, 10)])
def test_kalibr_chains_its_cameras_by_number(tmp_path, lens, model, numbers):
    rig = read_calibration(kalibr(tmp_path / "camchain.yaml", numbers, lens))
    assert_right(rig, [f"cam{n}" for n in numbers], relative(), model=model)


@pytest.mark.parametrize("model", ["omni", "ds", "eucm"])
def test_other_models_of_kalibr_are_named(tmp_path, model):
    with pytest.raises(CalibrationError, match=f"camera cam0.*model {model}"):
        read_calibration(kalibr(tmp_path / "camchain.yaml", model=model))
    with pytest.raises(CalibrationError, match="camera cam0.*model fov"):
        read_calibration(kalibr(tmp_path / "camchain.yaml", lens="fov"))


def test_a_broken_chain_of_kalibr_is_named(tmp_path):
    with pytest.raises(CalibrationError, match="camera cam1, T_cn_cnm1"):
        read_calibration(kalibr(tmp_path / "camchain.yaml", lacking=(1,)))


def of_mc_calib(i, **more):
    pose = {"camera_pose_matrix": inverse(relative()[i]).tolist()}
    lens = {"camera_matrix": K.tolist(), "distortion_vector": [D.tolist()], "img_width": 1280, "img_height": 720}
    return lens | {"distortion_type": 0, "camera_group": 0} | pose | more


def test_mc_calib_has_fisheyes_by_number_and_groups(tmp_path):
    path = tmp_path / "calibrated_cameras_data.json"
    names = [f"camera_{i}" for i in range(3)]
    for number, model in ((0, "radtan"), (1, "fisheye")):
        tree = {name: of_mc_calib(i, distortion_type=number) for i, name in enumerate(names)}
        path.write_text(json.dumps({"nb_camera": 3} | tree))
        assert_right(read_calibration(path), names, relative(), model=model)
    path.write_text(json.dumps({name: of_mc_calib(i, camera_group=i // 2) for i, name in enumerate(names)}))
    with pytest.raises(CalibrationError, match="camera_group.*2 groups"):
        read_calibration(path)
    assert len(read_calibration(path, exteriors=False)) == 3  # lenses alone


@pytest.mark.parametrize("parent", ["", "c0", "c1"])
def test_multical_has_its_poses_apart(tmp_path, parent):
    """Of each alone, to a master, or each to the one before."""
    poses = T if not parent else relative()
    steps = [pose @ inverse(poses[i - 1]) if parent == "c1" and i == 2 else pose for i, pose in enumerate(poses)]
    before = [""] * 3 if not parent else ["", "_to_c0", f"_to_{parent}"]
    tree = {
        "cameras": {f"c{i}": {"model": "standard", "image_size": [1280, 720], "K": K.tolist(), "dist": [D.tolist()]}
                    for i in range(3)},
        "camera_poses": {f"c{i}{before[i]}": {"R": step[:3, :3].tolist(), "T": step[:3, 3].tolist()}
                         for i, step in enumerate(steps)},
        "image_sets": {"rgb": [{"c0": "c0/1.png"}]},
    }  # fmt: skip
    (tmp_path / "calibration.json").write_text(json.dumps(tree))
    assert_right(read_calibration(tmp_path / "calibration.json"), ["c0", "c1", "c2"], poses)
    tree["camera_poses"].popitem()
    (tmp_path / "calibration.json").write_text(json.dumps(tree))
    with pytest.raises(CalibrationError, match="camera c2: rotation and translation missing"):
        read_calibration(tmp_path / "calibration.json")


def test_cameras_may_be_called_as_quantities_are(tmp_path):
    names = ["D", "K", "R"]
    poses = [{"R": pose[:3, :3].tolist(), "t": pose[:3, 3].tolist()} for pose in T]
    lens = {"K": K.tolist(), "dist": D.tolist(), "size": [1280, 720]}
    (tmp_path / "a.json").write_text(json.dumps({name: lens | pose for name, pose in zip(names, poses)}))
    assert_right(read_calibration(tmp_path / "a.json"), names, T)


@pytest.mark.parametrize("first", ["K", "extrinsics"])
def test_quantities_by_camera_within_parts(tmp_path, first):
    names = ["left", "r"]
    tree = {
        "K": dict.fromkeys(names, K.tolist()), "dist": dict.fromkeys(names, D.tolist()), "size": [1280, 720],
        "extrinsics": {"R": {n: T[i][:3, :3].tolist() for i, n in enumerate(names)},
                       "t": {n: T[i][:3, 3].tolist() for i, n in enumerate(names)}},
    }  # fmt: skip
    tree = {first: tree[first]} | tree
    (tmp_path / "a.json").write_text(json.dumps(tree))
    assert_right(read_calibration(tmp_path / "a.json"), names, T[:2])


# ---------------------------------------------------------------- NeRF, COLMAP


def test_transforms_json_is_opengl_and_half_a_pixel_off(tmp_path):
    lens = {"fl_x": 900.0, "fl_y": 905.0, "cx": 642.0, "cy": 352.75, "w": 1280, "h": 720}
    lens |= dict(zip(("k1", "k2", "p1", "p2"), D.tolist()))
    poses = [(inverse(pose) @ OPENGL).tolist() for pose in T]
    frames = [{"file_path": f"./images/a{i}.png", "transform_matrix": pose} for i, pose in enumerate(poses)]
    ngp = {"camera_angle_x": 1.2, "aabb_scale": 16, "scale": 0.33, "offset": [0.5] * 3, "orientation_override": "none"}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(lens | ngp | {"frames": frames}))
    assert_right(read_calibration(path), ["a0", "a1", "a2"], T)
    each = [frame | lens for frame in frames]
    path.write_text(json.dumps({"camera_model": "OPENCV", "frames": each}))
    assert_right(read_calibration(path), ["a0", "a1", "a2"], T)
    fisheye = {"is_fisheye": True} | lens | dict(zip(("k1", "k2", "k3", "k4"), D.tolist())) | {"p1": 0.0, "p2": 0.0}
    path.write_text(json.dumps(fisheye | {"frames": frames}))
    assert_right(read_calibration(path), ["a0", "a1", "a2"], T, model="fisheye")
    path.write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    with pytest.raises(CalibrationError, match="camera a0, fl_x: missing"):
        read_calibration(path)


def colmap(folder, points, scale=1.0):
    images = "# images\n"
    for i, pose in enumerate(T):
        values = [*(scale * quaternion(pose[:3, :3])), *pose[:3, 3]]
        images += f"{i + 1} {' '.join(repr(float(v)) for v in values)} 7 a {i}.png\n{points[i]}"
    (folder / "cameras.txt").write_text(f"7 OPENCV 1280 720 900 905 642 352.75 {' '.join(map(repr, D.tolist()))}\n")
    (folder / "images.txt").write_text(images)
    return folder


@pytest.mark.parametrize(
    "points",
    [("\n",) * 3, ("",) * 3, ("1.5 2 -1 1e2 -3. 17\n",) * 3, ("1.5 2 -1\n", "", "\n\n"), ("# none\n", "\n", "0 0 3\n")],
)
def test_colmap_with_points_and_without(tmp_path, points):
    assert_right(read_calibration(colmap(tmp_path, points)), ["a 0", "a 1", "a 2"], T)


@pytest.mark.parametrize(
    ("points", "scale", "words"),
    [
        (("1.5 2 -1\n1.5 2 -1\n", "", ""), 1.0, "line 4: not an image.*NAME"),
        (("1.5 2\n", "", ""), 1.0, "line 3: not an image"),
        (("", "", ""), 1.1, "line 2: a quaternion of length 1.1"),
    ],
)
def test_colmap_lines_that_are_refused(tmp_path, points, scale, words):
    with pytest.raises(CalibrationError, match=words):
        read_calibration(colmap(tmp_path, points, scale))


def test_a_binary_model_of_colmap_is_named(tmp_path):
    (tmp_path / "cameras.bin").write_bytes(b"\x01")
    for path in (tmp_path, tmp_path / "cameras.bin"):
        with pytest.raises(CalibrationError, match="colmap model_converter --input_path .* --output_type TXT"):
            read_calibration(path)


# ---------------------------------------------------------------- programs that are named


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<!DOCTYPE vpml>\n<project><calibration/></project>", "VIC-3D"),
        ('<ParameterList><Parameter name="format" value="DICe_xml_calibration_file"/></ParameterList>', "DICe"),
        ('<document version="2.0.0"><chunk><sensors next_id="1"></sensors></chunk></document>', "Metashape.*COLMAP"),
        ("<calibration>\n  <projection>frame</projection></calibration>", "Metashape.*COLMAP"),
    ],
)
def test_programs_whose_files_are_not_read_are_named(tmp_path, text, words):
    path = tmp_path / "cal.xml"
    path.write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n{text}')
    with pytest.raises(CalibrationError, match=words) as caught:
        read_calibration(path)
    assert "write K, dist, R, t and size" in caught.value.remedy
