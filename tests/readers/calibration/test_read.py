"""Every calibration format: real files, small generated ones, and broken ones."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinefit.errors import CalibrationError, ExportError, FileError, KinefitError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.lines import triangulate, triangulate_robust
from kinefit.geometry.se3 import exp_so3, quaternion, transform
from kinefit.readers.calibration.read import read_calibration, read_opencv_stereo, write_calibration

K = np.array([[900.0, 0, 641.5], [0, 905.0, 352.25], [0, 0, 1]])
DISTORTION = (-0.3, 0.1, 0.001, -0.002, 0.01)


def small_rig(distortion=DISTORTION, model="radtan"):
    poses = [
        transform(exp_so3(np.array(w)), np.array(t))
        for w, t in (((0.3, -0.4, 0.9), (0.1, 0.2, 3.0)), ((np.pi - 1e-9, 0, 0), (-1.0, 0.5, 2.0)))
    ]
    return Rig(tuple(Camera(f"cam0{i}", (1280, 720), K, distortion, model, T) for i, T in enumerate(poses, 1)))


def assert_same(found, expected, atol=1e-12):
    assert found.names == expected.names
    for a, b in zip(found, expected):
        assert a.size == b.size and a.model == b.model
        np.testing.assert_allclose(a.matrix, b.matrix, atol=atol)
        np.testing.assert_allclose(a.packed, b.packed, rtol=1e-12, atol=atol)


def file_storage(path, camera, **extra):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", camera.size[0])
    storage.write("image_height", camera.size[1])
    storage.write("camera_matrix", camera.matrix)
    storage.write("distortion_coefficients", np.array(camera.distortion))
    storage.write("R", camera.T_camera_world[:3, :3].copy())
    storage.write("T", camera.T_camera_world[:3, 3].copy())
    for key, value in extra.items():
        storage.write(key, value)
    storage.release()


# ---------------------------------------------------------------- real files


def test_pose2sim_file_of_the_balancing_trial(data_dir):
    rig = read_calibration(data_dir("video_balancing_4cam") / "Calib_refined_static.toml")
    assert rig.names == ("cam01", "cam02", "cam03", "cam04")
    assert rig["cam03"].size == (1088, 1920) and rig["cam03"].matrix[0, 0] == pytest.approx(1681.598, abs=1e-3)
    np.testing.assert_allclose(rig["cam01"].centre_world, [1.4602, -1.9092, 1.8965], atol=1e-4)


def test_qualisys_agrees_with_the_refined_calibration(data_dir):
    folder = data_dir("video_balancing_4cam")
    refined = read_calibration(folder / "Calib_refined_static.toml")
    shipped = read_calibration(folder / "calibration")  # the folder holds just that file
    np.testing.assert_allclose(shipped["cam01"].T_camera_world, refined["cam01"].T_camera_world, atol=1e-9)
    x_world = np.random.default_rng(0).uniform([-0.5, -0.5, 0], [0.5, 0.5, 2], (200, 3))
    for a, b in zip(refined, shipped):
        np.testing.assert_allclose(a.matrix, b.matrix, atol=1e-9)
        assert np.median(np.linalg.norm(a.project(x_world) - b.project(x_world), axis=1)) < 30  # it is off by that


def best_person(people, rig):
    """Keypoints (K, C, 2) and confidences of the combination of people that the cameras agree on."""
    count, confidence = len(people), 0.3
    best = (-1, None, None)
    for choice in np.ndindex(*(len(p) for p in people)):
        picked = np.stack([people[c][choice[c]] for c in range(count)], axis=1)
        weights = np.where(picked[..., 2] > confidence, picked[..., 2], 0)
        points = np.where(weights[..., None] > 0, picked[..., :2], np.nan)
        agreed = triangulate_robust(rig, points, weights, max_residual_px=50)[1].sum()
        if agreed > best[0]:
            best = (agreed, points, weights)
    return best[1:]


@pytest.mark.parametrize(
    ("file", "expected"), [("Calib_refined_static.toml", 8.3), ("calibration/Calib.qca.txt", 12.4)]
)
def test_keypoints_of_the_balancing_trial_meet(data_dir, file, expected):
    folder = data_dir("video_balancing_4cam")
    rig = read_calibration(folder / file)
    points, weights = [], []
    for frame in range(0, 100, 5):
        people = []
        for name in rig.names:
            text = (folder / "openpose_json" / name / f"{name}.{frame:04d}.json").read_text()
            people.append([np.reshape(p["pose_keypoints_2d"], (-1, 3)) for p in json.loads(text)["people"]])
        p, w = best_person(people, rig)
        points.append(p)
        weights.append(w)
    _, inliers, residual = triangulate_robust(rig, np.concatenate(points), np.concatenate(weights), max_residual_px=100)
    assert np.median(residual[inliers]) == pytest.approx(expected, abs=0.5)


def test_caliscope_landmarks_triangulate_to_the_recorded_points(data_dir):
    folder = data_dir("mv4_landmarks_caliscope")
    rig = read_calibration(folder / "config.toml")
    assert rig.names == ("cam_0", "cam_1", "cam_2", "cam_3") and rig["cam_2"].size == (1280, 720)
    seen = {}
    with (folder / "HOLISTIC" / "xy_HOLISTIC.csv").open() as file:
        for row in csv.DictReader(file):
            if int(row["sync_index"]) < 40:
                pixels = seen.setdefault((row["sync_index"], row["point_id"]), np.full((4, 2), np.nan))
                pixels[int(row["port"])] = float(row["img_loc_x"]), float(row["img_loc_y"])
    with (folder / "HOLISTIC" / "xyz_HOLISTIC.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if (row["sync_index"], row["point_id"]) in seen]
    points = np.stack([seen[row["sync_index"], row["point_id"]] for row in rows])
    expected = np.array([[float(row[f"{axis}_coord"]) for axis in "xyz"] for row in rows])
    assert len(expected) > 1000
    error = np.linalg.norm(triangulate(rig, points) - expected, axis=1)
    assert np.nanmedian(error) < 0.015  # theirs is linear, ours minimises pixels


def test_second_caliscope_file(data_dir):
    rig = read_calibration(data_dir("mv4_upperbody_caliscope") / "config.toml")
    assert len(rig) == 4 and all(np.linalg.norm(c.centre_world) < 2 for c in rig)


def test_opencv_stereo_pair(data_dir):
    folder = data_dir("stereo_opencv_chessboard")
    rig = read_opencv_stereo(folder / "intrinsics.yml", folder / "extrinsics.yml", image_size=(640, 480), unit=0.025)
    assert rig.names == ("left", "right")
    np.testing.assert_allclose(rig["left"].T_camera_world, np.eye(4))
    assert np.linalg.norm(rig["right"].centre_world) == pytest.approx(3.3429 * 0.025, abs=1e-4)
    assert rig["left"].distortion[7] == pytest.approx(-0.4046902)
    assert_same(read_calibration(folder, image_size=(640, 480), unit=0.025), rig)
    with pytest.raises(CalibrationError, match="image_size"):
        read_calibration(folder)
    with pytest.raises(CalibrationError, match="R, T missing.*extrinsics"):
        read_calibration(folder / "intrinsics.yml")


# ---------------------------------------------------------------- generated files


@pytest.mark.parametrize(("model", "distortion"), [("radtan", DISTORTION), ("fisheye", (0.1, 0.02, 0.01, 0.001))])
def test_written_calibration_reads_back(tmp_path, model, distortion):
    rig = small_rig(distortion, model)
    write_calibration(rig, tmp_path / "rig.toml")
    assert_same(read_calibration(tmp_path / "rig.toml"), rig, atol=1e-9)
    assert [f.name for f in tmp_path.iterdir()] == ["rig.toml"]


def test_odd_names_survive_writing(tmp_path):
    camera = Camera('left "A" é.1', (640, 480), K)
    write_calibration(Rig((camera,)), tmp_path / "rig.toml")
    assert read_calibration(tmp_path / "rig.toml").names == (camera.name,)


def test_write_leaves_nothing_half_done(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ExportError, match="file.rig.toml: cannot be written"):
        write_calibration(small_rig(), tmp_path / "file" / "rig.toml")
    (tmp_path / "taken").mkdir()
    with pytest.raises(ExportError):
        write_calibration(small_rig(), tmp_path / "taken")
    assert sorted(f.name for f in tmp_path.iterdir()) == ["file", "taken"]


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_opencv_folder_of_one_file_a_camera(tmp_path, ending):
    rig = small_rig()
    for camera in rig:
        file_storage(tmp_path / f"{camera.name}.{ending}", camera)
    assert_same(read_calibration(tmp_path), rig)


def test_opencv_folder_a_camera(tmp_path):
    rig = small_rig()
    for camera in rig:
        (tmp_path / camera.name).mkdir()
        file_storage(tmp_path / camera.name / "calibration.yml", camera)
    assert_same(read_calibration(tmp_path), rig)


@pytest.mark.parametrize("header", ["%YAML:1.0\n---\n", "%YAML 1.2\n---\n", "---\n", ""])
def test_both_yaml_headers(tmp_path, header):
    rig = small_rig()
    file_storage(tmp_path / "cam01.yml", rig["cam01"])
    body = (tmp_path / "cam01.yml").read_text().split("---\n", 1)[1]
    (tmp_path / "cam01.yml").write_text(header + body)
    assert_same(read_calibration(tmp_path / "cam01.yml"), rig.select(("cam01",)))


def test_plain_json_of_many_cameras(tmp_path):
    rig = small_rig()
    cameras = [
        {
            "name": c.name,
            "resolution": c.size,
            "K": c.matrix.tolist(),
            "distCoef": c.distortion.tolist(),
            "R": c.T_camera_world[:3, :3].tolist(),
            "t": (100 * c.T_camera_world[:3, 3:]).tolist(),
        }
        for c in rig
    ]
    (tmp_path / "a.json").write_text(json.dumps({"cameras": cameras, "unit": "cm"}))
    assert_same(read_calibration(tmp_path / "a.json"), rig)
    (tmp_path / "b.json").write_text(json.dumps(cameras))
    assert_same(read_calibration(tmp_path / "b.json", unit="cm"), rig)


def test_intrinsics_alone_put_the_world_into_the_camera(tmp_path):
    storage = cv2.FileStorage(str(tmp_path / "mine.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array([0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]))
    storage.release()
    rig = read_calibration(tmp_path / "mine.yml")
    assert rig.names == ("mine",) and rig["mine"].distortion.size == 8
    np.testing.assert_array_equal(rig["mine"].T_camera_world, np.eye(4))


def aniposelib_text(scale=1.0, rotation="[0.3, -0.4, 0.9]"):
    return f"""
[cam_0]
name = "A"
size = [1280, 720]
matrix = [[900.0, 0.0, 641.5], [0.0, 905.0, 352.25], [0.0, 0.0, 1.0]]
distortions = [-0.3, 0.1, 0.001, -0.002, 0.01]
rotation = {rotation}
translation = [{0.1 * scale}, {0.2 * scale}, {3.0 * scale}]
[cam_1]
name = "B"
size = [1280, 720]
matrix = [[900.0, 0.0, 641.5], [0.0, 905.0, 352.25], [0.0, 0.0, 1.0]]
distortions = [-0.3, 0.1, 0.001, -0.002, 0.01]
rotation = [3.1415926525897933, 0.0, 0.0]
translation = [{-1.0 * scale}, {0.5 * scale}, {2.0 * scale}]
[metadata]
adjusted = false
error = 0.3
"""


def test_aniposelib_and_its_unit(tmp_path):
    path, rig = tmp_path / "calibration.toml", small_rig()
    expected = Rig(tuple(replace(camera, name=name) for name, camera in zip("AB", rig)))
    path.write_text(aniposelib_text())
    assert_same(read_calibration(path), expected, atol=1e-9)
    path.write_text(aniposelib_text(scale=1000))
    assert_same(read_calibration(path, unit="mm"), expected, atol=1e-9)
    with pytest.raises(CalibrationError, match=r"camera A.*cannot be metres.*unit = \"mm\""):
        read_calibration(path)
    path.write_text(aniposelib_text(scale=1000) + 'unit = "mm"\n')
    assert_same(read_calibration(path), expected, atol=1e-9)
    with pytest.raises(CalibrationError, match="furlong.*mm"):
        read_calibration(path, unit="furlong")


COLMAP = {
    "SIMPLE_PINHOLE": ("900 642 352.75", (900, 900), (0,) * 8, "radtan"),
    "PINHOLE": ("900 905 642 352.75", (900, 905), (0,) * 8, "radtan"),
    "SIMPLE_RADIAL": ("900 642 352.75 0.1", (900, 900), (0.1, 0, 0, 0, 0, 0, 0, 0), "radtan"),
    "RADIAL": ("900 642 352.75 0.1 0.2", (900, 900), (0.1, 0.2, 0, 0, 0, 0, 0, 0), "radtan"),
    "OPENCV": ("900 905 642 352.75 .1 .2 .3 .4", (900, 905), (0.1, 0.2, 0.3, 0.4, 0, 0, 0, 0), "radtan"),
    "FULL_OPENCV": (
        "900 905 642 352.75 .1 .2 .3 .4 .5 .6 .7 .8",
        (900, 905),
        (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        "radtan",
    ),
    "OPENCV_FISHEYE": ("900 905 642 352.75 .1 .2 .3 .4", (900, 905), (0.1, 0.2, 0.3, 0.4), "fisheye"),
}


@pytest.mark.parametrize("model", COLMAP)
def test_colmap_text(tmp_path, model):
    parameters, focal, distortion, lens = COLMAP[model]
    (tmp_path / "cameras.txt").write_text(f"# cameras\n7 {model} 1280 720 {parameters}\n")
    lines = ["# images"]
    for i, camera in enumerate(small_rig(), 1):
        q, t = quaternion(camera.T_camera_world[:3, :3]), camera.T_camera_world[:3, 3]
        lines += [" ".join(map(repr, [i, *map(float, q), *map(float, t), 7])) + f" {camera.name}/frame {i}.png"]
        lines += ["" if i == 1 else "12.0 13.0 -1 4.0 5.0 17"]
    (tmp_path / "images.txt").write_text("\n".join(lines) + "\n")
    rig = read_calibration(tmp_path)
    assert rig.names == ("frame 1", "frame 2")
    for camera, expected in zip(rig, small_rig()):
        assert camera.size == (1280, 720) and camera.model == lens
        np.testing.assert_allclose(camera.matrix, [[focal[0], 0, 641.5], [0, focal[1], 352.25], [0, 0, 1]])
        np.testing.assert_allclose(camera.distortion, distortion)
        np.testing.assert_allclose(camera.T_camera_world, expected.T_camera_world, atol=1e-9)
    (tmp_path / "cameras.txt").write_text(f"7 {model} 1280 720 {parameters} 1\n")
    with pytest.raises(CalibrationError, match=r"cameras\.txt, line 1.*" + model):
        read_calibration(tmp_path)


# ---------------------------------------------------------------- broken files

SHORT_MATRIX = "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1., 0. ]"


@pytest.mark.parametrize(
    ("name", "text", "error", "words"),
    [
        ("a.toml", "[cam\nmatrix=", CalibrationError, "TOML"),
        ("a.toml", "[other]\nx = 1\n", CalibrationError, "no camera"),
        ("a.toml", aniposelib_text().replace("size = [1280, 720]", "", 1), CalibrationError, "camera A.*image_size"),
        ("a.toml", aniposelib_text().replace("900.0", "0.0", 1), CalibrationError, "camera A.*focal"),
        ("a.toml", aniposelib_text().replace("900.0", "nan", 1), CalibrationError, "camera A, camera matrix.*finite"),
        ("a.toml", aniposelib_text().replace("0.002, 0.01]", "0.002, 0.01, 0.2]", 1), CalibrationError, "6 distortion"),
        ("a.toml", aniposelib_text(rotation="[0.1]"), CalibrationError, "camera A.*rotation"),
        ("a.toml", aniposelib_text(rotation="[[1,0,0],[0,1,0],[0,0,-1]]"), CalibrationError, "camera A.*right-handed"),
        ("a.toml", aniposelib_text().replace("rotation = [0.3, -0.4, 0.9]", ""), CalibrationError, "rotation missing"),
        ("a.toml", aniposelib_text().replace('"B"', '"A"'), CalibrationError, "two cameras of one name"),
        ("a.json", '{"camera_matrix": {"type_id"', CalibrationError, "JSON"),
        ("a.json", "{}", CalibrationError, "no camera"),
        ("a.json", "[]", CalibrationError, "no camera"),
        ("a.yml", SHORT_MATRIX, CalibrationError, "YAML"),
        ("a.yml", SHORT_MATRIX.replace(" ]", ""), CalibrationError, "YAML"),
        ("a.xml", "<?xml version='1.0'?><calibration><cameras><camera", CalibrationError, "XML"),
        ("a.xml", "<?xml version='1.0'?><html/>", FileError, "Qualisys"),
        ("a.txt", "nothing of the kind", FileError, "OpenCV"),
        ("a.txt", "", FileError, "OpenCV"),
    ],
)  # fmt: skip
def test_broken_files_tell_what_is_wrong(tmp_path, name, text, error, words):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(error, match=words) as caught:
        read_calibration(path)
    assert str(path) in str(caught.value) and caught.value.remedy


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(FileError, match="no such"):
        read_calibration(tmp_path / "gone.toml")
    (tmp_path / "a.toml").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(FileError, match="text"):
        read_calibration(tmp_path / "a.toml")
    with pytest.raises(CalibrationError, match="no camera"):
        (tmp_path / "empty").mkdir()
        read_calibration(tmp_path / "empty")
    (tmp_path / "colmap").mkdir()
    (tmp_path / "colmap" / "cameras.bin").write_bytes(b"\x01")
    with pytest.raises(CalibrationError, match="model_converter"):
        read_calibration(tmp_path / "colmap")


def qualisys_text(**changes):
    values = {"active": "1", "viewrotation": "0", "focal": "64000", "r11": "1"} | changes
    return f"""<?xml version="1.0"?><calibration><cameras>
<camera active="{values["active"]}" serial="s1" viewrotation="{values["viewrotation"]}">
<fov_video bottom="719" left="10" right="1289" top="0"/>
<transform r11="{values["r11"]}" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"
 x="100" y="200" z="3000"/>
<intrinsic focalLengthU="{values["focal"]}" focalLengthV="64000" centerPointU="41600" centerPointV="23040"
 radialDistortion1="-0.1" radialDistortion2="0.2" radialDistortion3="0.3" tangentalDistortion1="0.001"
 tangentalDistortion2="0.002" skew="0"/></camera></cameras></calibration>"""


def test_qualisys_units_and_order(tmp_path):
    path = tmp_path / "a.qca.txt"
    path.write_text(qualisys_text())
    camera = read_calibration(path)["s1"]
    assert camera.size == (1280, 720)
    np.testing.assert_allclose(camera.matrix, [[1000, 0, 640], [0, 1000, 360], [0, 0, 1]])
    np.testing.assert_allclose(camera.distortion, [-0.1, 0.2, 0.001, 0.002, 0.3])
    np.testing.assert_allclose(camera.centre_world, [0.1, 0.2, 3.0])
    np.testing.assert_allclose(camera.project([0.1, 0.2, 0.0]), [640, 360], atol=1e-9)  # it looks down


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"active": "0"}, "no camera"),
        ({"viewrotation": "90"}, "camera s1.*rotated"),
        ({"focal": "abc"}, "camera s1, intrinsic.*focalLengthU"),
        ({"r11": "-1"}, "camera s1, transform.*right-handed"),
    ],
)
def test_broken_qualisys(tmp_path, changes, words):
    path = tmp_path / "a.qca.txt"
    path.write_text(qualisys_text(**changes))
    with pytest.raises(CalibrationError, match=words):
        read_calibration(path)


@given(st.data())
def test_a_file_cut_anywhere_is_a_typed_error_or_a_rig(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("cut")
    file_storage(folder / "whole.yml", small_rig()["cam01"])
    file_storage(folder / "whole.json", small_rig()["cam01"])
    texts = [aniposelib_text(), qualisys_text(), *((folder / f"whole.{e}").read_text() for e in ("yml", "json"))]
    text = data.draw(st.sampled_from(texts))
    path = folder / "cut.txt"
    path.write_text(text[: data.draw(st.integers(0, len(text)))])
    try:
        assert len(read_calibration(path)) >= 1
    except KinefitError as error:
        assert str(path) in str(error) and error.remedy
