"""A rig written in the format of another calibration: the numbers are its own, everything else is kept."""

import json
import tomllib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from kinefit.errors import CalibrationError, ExportError, FileError
from kinefit.geometry.camera import Camera, Rig
from kinefit.geometry.se3 import exp_so3, quaternion, transform
from kinefit.readers.calibration.read import read_calibration, write_calibration
from kinefit.readers.calibration.write import write_calibration_like

K = np.array([[900.0, 0, 641.5], [0, 905.0, 352.25], [0, 0, 1]])
NEW = np.array([[1234.5678901234567, 0, 600.1], [0, 1200.9, 333.3], [0, 0, 1]])


def rig_of(matrix=K, distortion=(-0.3, 0.1, 0.001, -0.002, 0.01), turn=0.0, names=("cam01", "cam02"), model="radtan"):
    poses = [((0.3 + turn, -0.4, 0.9), (0.1 + turn, 0.2, 3.0)), ((2.0, turn, -0.3), (-1.0, 0.5 - turn, 2.0))]
    return Rig(
        tuple(
            Camera(name, (1280, 720), matrix, distortion, model, transform(exp_so3(np.array(w)), np.array(t)))
            for name, (w, t) in zip(names, poses)
        )
    )


def changed(rig, distortion=None, turn=0.2):
    """Every number of every camera is another."""
    T = transform(exp_so3(np.array([turn, -turn, 0.1])), np.array([turn, 0.1, -0.05]))
    return Rig(
        tuple(
            replace(
                camera,
                matrix=camera.matrix * [[1.1, 1, 1.01], [1, 1.2, 0.99], [1, 1, 1]],
                distortion=camera.distortion * 0.7 if distortion is None else distortion,
                T_camera_world=T @ camera.T_camera_world,
            )
            for camera in rig
        )
    )


def assert_same(found, expected):
    assert set(expected.names) <= set(found.names)
    for camera in expected:
        assert found[camera.name].size == camera.size and found[camera.name].model == camera.model
        np.testing.assert_allclose(found[camera.name].packed, camera.packed, rtol=1e-9, atol=1e-9)


def round_trip(like, path, **reading):
    """Change every camera, write, read back; returns the two texts or folders' texts."""
    before = read_calibration(like, **reading)
    after = changed(before)
    assert write_calibration_like(after, like, path, **reading) == path
    assert_same(read_calibration(path, **reading), after)
    assert sorted(f.name for f in path.parent.iterdir() if f.name.startswith(".")) == []
    return after


# ---------------------------------------------------------------- real files


@pytest.mark.parametrize(
    "name",
    [
        "video_balancing_4cam/Calib_refined_static.toml",
        "video_balancing_4cam/calibration/Calib.qca.txt",
        "mv4_landmarks_caliscope/config.toml",
        "mv4_upperbody_caliscope/config.toml",
    ],
)
def test_real_files(data_dir, tmp_path, name):
    folder, _, rest = name.partition("/")
    like = data_dir(folder) / rest
    text = like.read_text()
    round_trip(like, tmp_path / like.name)
    written = (tmp_path / like.name).read_text()
    assert like.read_text() == text and written != text
    if like.suffix == ".toml":  # nothing else has changed
        old, new = tomllib.loads(text), tomllib.loads(written)
        numbers = ("matrix", "distortions", "rotation", "translation")
        for table in (old, new):
            for value in table.values():
                for key in numbers if isinstance(value, dict) else ():
                    value.pop(key, None)
        assert old == new and text.count("\n") == written.count("\n")
    else:
        for part in ('serial="cam02"', "<?xml version='1.0' encoding='ASCII'?>", 'avg-residual="0.444749"'):
            assert part in text and part in written


def test_an_unchanged_rig_keeps_the_real_numbers(data_dir, tmp_path):
    like = data_dir("video_balancing_4cam") / "calibration" / "Calib.qca.txt"
    rig = read_calibration(like)
    write_calibration_like(rig, like, tmp_path / "Calib.qca.txt")
    text = (tmp_path / "Calib.qca.txt").read_text()
    assert 'focalLengthU="107599.671875"' in text and 'radialDistortion1="-0.046183"' in text


def test_opencv_stereo_pair_is_told_in_its_first_camera(data_dir, tmp_path):
    like, reading = data_dir("stereo_opencv_chessboard"), {"image_size": (640, 480), "unit": 0.025}
    rig = changed(read_calibration(like, **reading))
    write_calibration_like(rig, like, tmp_path / "new", **reading)
    assert sorted(f.name for f in (tmp_path / "new").iterdir()) == ["extrinsics.yml", "intrinsics.yml"]
    assert_same(read_calibration(tmp_path / "new", **reading), rig.moved(rig["left"].T_camera_world))
    assert "\nQ: !!opencv-matrix" in (tmp_path / "new" / "extrinsics.yml").read_text()


# ---------------------------------------------------------------- formats


def file_storage(path, camera):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", camera.size[0])
    storage.write("image_height", camera.size[1])
    storage.write("camera_matrix", camera.matrix)
    storage.write("distortion_coefficients", np.array(camera.distortion))
    storage.write("R", camera.T_camera_world[:3, :3].copy())
    storage.write("T", camera.T_camera_world[:3, 3].copy())
    storage.write("board", "charuco")
    storage.release()


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_opencv_folders(tmp_path, ending):
    flat, deep = tmp_path / "flat", tmp_path / "deep"
    flat.mkdir()
    for camera in rig_of():
        file_storage(flat / f"{camera.name}.{ending}", camera)
        (deep / camera.name).mkdir(parents=True)
        file_storage(deep / camera.name / f"calibration.{ending}", camera)
    for like in (flat, deep):
        round_trip(like, tmp_path / f"new_{like.name}")
    round_trip(flat / f"cam01.{ending}", tmp_path / f"cam01.{ending}")
    assert "charuco" in (tmp_path / "new_deep" / "cam02" / f"calibration.{ending}").read_text()


@pytest.mark.parametrize("header", ["%YAML:1.0\n---\n", "%YAML 1.2\n---\n", ""])
def test_yaml_of_many_cameras_keeps_comments(tmp_path, header):
    text = header + "# measured on Monday\ncameras:\n"
    for camera in rig_of():
        text += (
            f"   - name: {camera.name}\n     size: [1280, 720]\n     K: {camera.matrix.tolist()}\n"
            f"     D: {camera.distortion.tolist()}\n     rvec: {[0.1, 0.2, 0.3]}\n     t: {[[1.0], [2.0], [3.0]]}\n"
        )
    (tmp_path / "a.yml").write_text(text)
    round_trip(tmp_path / "a.yml", tmp_path / "b.yml")
    assert "# measured on Monday" in (tmp_path / "b.yml").read_text()


def test_yaml_block_sequences(tmp_path):
    block = """
cam01:
   size: [1280, 720]
   K:
      - - 900.0
        - 0.0
        - 641.5
      - [0, 905, 352.25]
      - [0, 0, 1]
   D:
      - 0.1
      - 0.2
      - 0.0
      - 0.0
   R: [ 0.1,
        0.2, 0.3 ]  # turned
   T:
      - 1.0
      - 2.0
      - 3.0
rate: 60
"""
    (tmp_path / "a.yml").write_text(block)
    round_trip(tmp_path / "a.yml", tmp_path / "b.yml")
    assert (tmp_path / "b.yml").read_text().endswith("\nrate: 60\n") and "# turned" in (tmp_path / "b.yml").read_text()


def json_text(rig, **extra):
    cameras = [
        {
            "name": c.name,
            "resolution": c.size,
            "K": c.matrix.tolist(),
            "distCoef": c.distortion.tolist(),
            "R": c.T_camera_world[:3, :3].tolist(),
            "t": (100 * c.T_camera_world[:3, 3:]).tolist(),
            "maker": "K: [1, 2] #",
        }
        for c in rig
    ]
    return json.dumps({"unit": "cm", "cameras": cameras, **extra}, indent=1)


def test_json_keeps_its_unit_and_layout(tmp_path):
    (tmp_path / "a.json").write_text(json_text(rig_of(), notes=["K"]))
    round_trip(tmp_path / "a.json", tmp_path / "b.json")
    old, new = (json.loads((tmp_path / f"{name}.json").read_text()) for name in "ab")
    assert new["unit"] == "cm" and new["notes"] == ["K"] and new["cameras"][1]["maker"] == "K: [1, 2] #"
    assert np.shape(new["cameras"][0]["t"]) == np.shape(old["cameras"][0]["t"]) == (3, 1)


def test_toml_keeps_comments_and_other_cameras(tmp_path):
    write_calibration(rig_of(), tmp_path / "a.toml")
    text = "# the new lab\n" + (tmp_path / "a.toml").read_text().replace("rotation =", "# matrix = 3\nrotation =")
    (tmp_path / "a.toml").write_text(text.replace("\n", "\r\n"), newline="")
    rig = changed(rig_of()).select(("cam02",))
    write_calibration_like(rig, tmp_path / "a.toml", tmp_path / "b.toml")
    found = read_calibration(tmp_path / "b.toml")
    assert_same(found, Rig((rig_of()["cam01"], rig["cam02"])))
    assert (tmp_path / "b.toml").read_bytes().count(b"\r\n") == (tmp_path / "a.toml").read_bytes().count(b"\r\n")
    assert "# the new lab" in (tmp_path / "b.toml").read_text()


@pytest.mark.parametrize("form", ["toml", "json", "yml", "inline"])
def test_poses_are_added_where_there_were_none(tmp_path, form):
    rows = [
        {"name": c.name, "size": [1280, 720], "matrix": c.matrix.tolist(), "dist": c.distortion.tolist()}
        for c in rig_of()
    ]
    texts = {
        "toml": "".join(
            f"[{r['name']}]\nsize = {r['size']}\nmatrix = {r['matrix']}  # px\ndist = {r['dist']}\n" for r in rows
        ),
        "inline": "".join(
            f"{r['name']} = {{size = {r['size']}, matrix = {r['matrix']}, dist = {r['dist']}}}\n" for r in rows
        ),
        "json": json.dumps(rows, indent=2),
        "yml": "cams:\n"
        + "".join(
            f"  - K: {r['matrix']}\n    name: {r['name']}\n    size: {r['size']}\n    dist: {r['dist']}\n" for r in rows
        ),
    }
    like = tmp_path / ("a." + ("toml" if form == "inline" else form))
    like.write_text(texts[form])
    with pytest.raises(CalibrationError, match="rotation and translation missing"):
        read_calibration(like)
    assert len(read_calibration(like, exteriors=False)) == 2
    write_calibration_like(rig_of(), like, tmp_path / f"b{like.suffix}")
    assert_same(read_calibration(tmp_path / f"b{like.suffix}"), rig_of())


def colmap(folder, model, parameters, ids=(7, 8)):
    folder.mkdir()
    cameras = "".join(f"{i} {model} 1280 720 {parameters}\n" for i in sorted(set(ids)))
    (folder / "cameras.txt").write_text("# Camera list\n" + cameras)
    lines = ["# Image list"]
    for i, (camera, number) in enumerate(zip(rig_of(), ids), 1):
        q, t = quaternion(camera.T_camera_world[:3, :3]), camera.T_camera_world[:3, 3]
        lines += [" ".join(map(repr, [i, *map(float, q), *map(float, t), number])) + f" {camera.name}/frame {i}.png"]
        lines += ["" if i == 1 else "12.0 13.0 -1 4.0 5.0 17"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("# points\n17 0 0 1 0 0 0 1 2 1\n")


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_RADIAL", "900 642 352.75 0.1"),
        ("OPENCV", "900 905 642 352.75 .1 .2 .3 .4"),
        ("FULL_OPENCV", "900 905 642 352.75 .1 .2 .3 .4 .5 .6 .7 .8"),
        ("OPENCV_FISHEYE", "900 905 642 352.75 .1 .02 .003 .0004"),
    ],
)
def test_colmap(tmp_path, model, parameters):
    colmap(tmp_path / "a", model, parameters)
    round_trip(tmp_path / "a", tmp_path / "b")
    assert "12.0 13.0 -1 4.0 5.0 17" in (tmp_path / "b" / "images.txt").read_text()
    assert (tmp_path / "b" / "points3D.txt").read_text() == (tmp_path / "a" / "points3D.txt").read_text()
    used = (tmp_path / "b" / "cameras.txt").read_text().split()[4]
    assert used == ("OPENCV" if model == "SIMPLE_RADIAL" else model)  # fx and fy now differ: the smallest that holds it


def test_colmap_images_of_one_camera(tmp_path):
    colmap(tmp_path / "a", "PINHOLE", "900 905 642 352.75", ids=(7, 7))
    rig = changed(read_calibration(tmp_path / "a"))
    write_calibration_like(rig, tmp_path / "a" / "images.txt", tmp_path / "b")
    assert_same(read_calibration(tmp_path / "b"), rig)
    other = Rig((rig.cameras[0], replace(rig.cameras[1], matrix=NEW)))
    with pytest.raises(CalibrationError, match="share camera 7"):
        write_calibration_like(other, tmp_path / "a", tmp_path / "c")
    assert not (tmp_path / "c").exists()


# ---------------------------------------------------------------- refusals


@pytest.fixture
def like(tmp_path):
    write_calibration(rig_of(), tmp_path / "a.toml")
    return tmp_path / "a.toml"


def test_never_over_the_old_one(like, tmp_path):
    text = like.read_text()
    for path in (like, tmp_path / "." / "a.toml"):
        with pytest.raises(ExportError, match="the original calibration"):
            write_calibration_like(rig_of(turn=0.1), like, path, overwrite=True)
    write_calibration_like(rig_of(turn=0.1), like, tmp_path / "b.toml")
    with pytest.raises(ExportError, match=r"b\.toml.*already"):
        write_calibration_like(rig_of(turn=0.2), like, tmp_path / "b.toml")
    write_calibration_like(rig_of(turn=0.2), like, tmp_path / "b.toml", overwrite=True)
    assert_same(read_calibration(tmp_path / "b.toml"), rig_of(turn=0.2))
    (tmp_path / "folder").mkdir()
    with pytest.raises(ExportError, match="already"):
        write_calibration_like(rig_of(), like, tmp_path / "folder", overwrite=True)
    assert like.read_text() == text
    assert sorted(f.name for f in tmp_path.iterdir()) == ["a.toml", "b.toml", "folder"]


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (rig_of(names=("cam01", "cam09")), "cam09.*there are: cam01, cam02"),
        (rig_of(distortion=(0.1, 0.02, 0.01, 0.001), model="fisheye"), "cam01.*lens model.*Pose2Sim TOML"),
    ],
)
def test_what_the_file_cannot_hold(like, tmp_path, rig, words):
    with pytest.raises(CalibrationError, match=words):
        write_calibration_like(rig, like, tmp_path / "b.toml")
    assert sorted(f.name for f in tmp_path.iterdir()) == ["a.toml"]


def test_missing_file_and_folder(like, tmp_path):
    with pytest.raises(FileError, match=r"none\.toml"):
        write_calibration_like(rig_of(), tmp_path / "none.toml", tmp_path / "b.toml")
    (tmp_path / "taken").write_text("")
    with pytest.raises(ExportError):
        write_calibration_like(rig_of(), like, tmp_path / "taken" / "b.toml")
    write_calibration_like(rig_of(), like, tmp_path / "new" / "b.toml")
    assert len(read_calibration(tmp_path / "new" / "b.toml")) == 2


def test_too_long_a_lens_for_a_stored_matrix(tmp_path):
    file_storage(tmp_path / "cam01.yml", rig_of()["cam01"])
    rig = rig_of(distortion=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)).select(("cam01",))
    with pytest.raises(CalibrationError, match=r"cam01\.yml.*cannot hold the rig's numbers.*Pose2Sim TOML"):
        write_calibration_like(rig, tmp_path / "cam01.yml", tmp_path / "b.yml")


def test_no_lens_and_a_longer_one(tmp_path):
    write_calibration(rig_of(distortion=()), tmp_path / "a.toml")
    full = rig_of(distortion=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8))
    write_calibration_like(full, tmp_path / "a.toml", tmp_path / "b.toml")
    assert_same(read_calibration(tmp_path / "b.toml"), full)
    write_calibration_like(rig_of(distortion=()), tmp_path / "b.toml", tmp_path / "c.toml")
    assert not read_calibration(tmp_path / "c.toml")["cam01"].distortion.any()


finite = st.floats(-3, 3)


@given(
    w=st.tuples(finite, finite, finite), t=st.tuples(finite, finite, finite), k=st.tuples(*[finite] * 5),
    focal=st.floats(100, 5000), unit=st.sampled_from(["m", "cm", "mm"]),
)
@example(w=(0, 0, 0), t=(0, 0, 0), k=(0.0, 0.0, 0.0, 0.0, 5e-323), focal=100.0, unit="m")
def test_any_numbers_survive(tmp_path_factory, w, t, k, focal, unit):
    folder = tmp_path_factory.mktemp("any")
    (folder / "a.json").write_text(json_text(rig_of()).replace('"cm"', f'"{unit}"'))
    T = transform(exp_so3(np.array(w)), np.array(t))
    camera = Camera("cam02", (1280, 720), K * [[focal / 900, 1, 1], [1, 1, 1], [1, 1, 1]], k, "radtan", T)
    write_calibration_like(Rig((camera,)), folder / "a.json", folder / "b.json")
    assert_same(read_calibration(folder / "b.json"), Rig((camera,)))
