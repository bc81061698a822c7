"""Calibrations as other programs and people write them, from a known rig, by formulas that share nothing with ours."""

import json
from xml.sax.saxutils import quoteattr

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from kinefit._processes import python
from kinefit.errors import CalibrationError, FileError, KinefitError
from kinefit.readers.calibration.read import read_calibration, write_calibration
from kinefit.readers.calibration.write import write_calibration_like

SIZE = (1280, 720)
K = {
    "01": [[900.0, 0, 641.5], [0, 905.0, 352.25], [0, 0, 1]],
    "02": [[1010.0, 0, 630.0], [0, 1000.0, 366.0], [0, 0, 1]],
}
DIST = {"01": [-0.21, 0.08, 0.001, -0.002, 0.01], "02": [0.05, -0.02, -0.0007, 0.0004, 0.0]}
RVEC = {"01": [1.3, -0.4, 0.5], "02": [1.1, 0.9, -0.6]}
CENTRE = {"01": [0.4, -4.2, 1.6], "02": [-3.1, -3.0, 2.2]}  # [m]
POINTS = np.random.default_rng(7).uniform([-0.8, -0.8, 0.0], [0.8, 0.8, 2.0], (200, 3))


def rodrigues(w):
    angle = np.linalg.norm(w)
    x, y, z = np.divide(w, angle)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def looking(centre):
    """World to camera, x right, y down, z towards (0, 0, 1)."""
    z = np.subtract((0, 0, 1.0), centre)
    z = z / np.linalg.norm(z)
    x = np.cross(z, (0, 0, 1.0))
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


ROT = {name: rodrigues(np.multiply(0.05, RVEC[name])) @ looking(CENTRE[name]) for name in K}
T = {name: -ROT[name] @ CENTRE[name] for name in K}  # [m]


def rotation_vector(R):
    """By the logarithm of a rotation: eigenvector of one."""
    values, vectors = np.linalg.eig(R)
    axis = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    angle = np.arccos((np.trace(R) - 1) / 2)
    return min((angle * axis, -angle * axis), key=lambda w: np.abs(rodrigues(w) - R).max())


def xyzw(R):
    w = rotation_vector(R)
    half = np.linalg.norm(w) / 2
    return [*(np.sin(half) * w / (2 * half)), np.cos(half)]


def projected(name, dist=None):
    """OpenCV's documented formula."""
    k1, k2, p1, p2, k3 = DIST[name] if dist is None else dist
    X, Y, Z = ROT[name] @ POINTS.T + T[name][:, None]
    assert Z.min() > 0.5
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    (fx, s, cx), (_, fy, cy), _ = K[name]
    return np.stack([fx * u + s * v + cx, fy * v + cy], axis=1)


def assert_projects(rig, names=None, dist=None):
    for name, own in (names or {name: name for name in K}).items():
        assert rig[own].size == SIZE
        np.testing.assert_allclose(rig[own].project(POINTS), projected(name, dist), atol=1e-6)


def camera(name, unit=1.0):
    """Of the CMU Panoptic Studio's kind; `unit`: of length, a metre being one."""
    return {
        "name": name, "resolution": list(SIZE), "K": K[name], "distCoef": DIST[name], "R": ROT[name].tolist(),
        "t": (T[name][:, None] * unit).tolist(),
    }  # fmt: skip


# ---------------------------------------------------------------- programs


def test_cmu_panoptic_is_in_centimetres(tmp_path):
    cameras = [{"type": "hd", "panel": 0, "node": i, **camera(name, 100)} for i, name in enumerate(K)]
    path = tmp_path / "calibration_171204.json"
    path.write_text(json.dumps({"calibDataSource": "made", "cameras": cameras}))
    assert_projects(read_calibration(path))


def matrix_yaml(key, value):
    array = np.atleast_2d(np.asarray(value, float))
    shape = f"   rows: {array.shape[0]}\n   cols: {array.shape[1]}\n   dt: d\n"
    return f"{key}: !!opencv-matrix\n{shape}   data: {array.ravel().tolist()}\n"


def write_easymocap(folder, sizes=True, names=("01", "02")):
    listed = "names:\n" + "".join(f'   - "{name}"\n' for name in names)
    intri = extri = "%YAML:1.0\n---\n" + listed
    for name in names:
        intri += matrix_yaml(f"K_{name}", K[name]) + matrix_yaml(f"dist_{name}", [DIST[name]])
        intri += f"H_{name}: {SIZE[1]}\nW_{name}: {SIZE[0]}\n" if sizes else ""
        extri += matrix_yaml(f"R_{name}", rotation_vector(ROT[name])[:, None]) + matrix_yaml(f"Rot_{name}", ROT[name])
        extri += matrix_yaml(f"T_{name}", T[name][:, None])
    (folder / "intri.yml").write_text(intri)
    (folder / "extri.yml").write_text(extri)


def test_easymocap_folder_is_read_and_written_back(tmp_path):
    (tmp_path / "a").mkdir()
    write_easymocap(tmp_path / "a")
    rig = read_calibration(tmp_path / "a")
    assert rig.names == ("01", "02")
    assert_projects(rig)
    moved = rig.moved(np.array([[0, -1, 0, 0.3], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    write_calibration_like(moved, tmp_path / "a", tmp_path / "b")
    text = (tmp_path / "b" / "extri.yml").read_text()
    for whole in (text, text.replace("Rot_", "Unused_")):  # the matrix and the vector are the same rotation
        (tmp_path / "b" / "extri.yml").write_text(whole)
        for one, other in zip(read_calibration(tmp_path / "b"), moved):
            np.testing.assert_allclose(one.T_camera_world, other.T_camera_world, atol=1e-9)


def freemocap(square):
    tables = [
        f"[cam_{i}]\nname = \"{name}\"\nsize = {list(SIZE)}\nmatrix = {K[name]}\ndistortions = {DIST[name]}\n"
        f"rotation = {rotation_vector(ROT[name]).tolist()}\ntranslation = {(1000 * T[name]).tolist()}\n"
        f"world_position = {np.multiply(1000, CENTRE[name]).tolist()}\nworld_orientation = {ROT[name].T.tolist()}\n"
        for i, name in enumerate(K)
    ]  # fmt: skip
    return "".join(tables) + f"[metadata]\nadjusted = false\nerror = 0.0\ncharuco_square_size = {square}\n"


def test_freemocap_is_in_millimetres(tmp_path):
    path = tmp_path / "session_camera_calibration.toml"
    path.write_text(freemocap(58.0))
    assert_projects(read_calibration(path))
    path.write_text(freemocap(1))  # nobody stated the board's squares
    with pytest.raises(CalibrationError, match="cannot be metres"):
        read_calibration(path)


def theia(size="sensorDimU", capitals=False):
    parts = []
    for name in K:
        (fx, s, cx), (_, fy, cy), _ = K[name]
        k1, k2, p1, p2, k3 = DIST[name]
        of_size = {size: SIZE[0], size[:-1] + "V": SIZE[1]} if size == "sensorDimU" else {
            "sensorMinU": 0, "sensorMinV": 0, "sensorMaxU": SIZE[0] - 1, "sensorMaxV": SIZE[1] - 1,
        }  # fmt: skip
        lens = of_size | {
            "focallength": 8.0, "focalLengthU": fx, "focalLengthV": fy, "centerPointU": cx, "centerPointV": cy,
            "skew": s, "radialDistortion1": k1, "radialDistortion2": k2, "radialDistortion3": k3,
            "tangentialDistortion1" if capitals else "tangentalDistortion1": p1, "tangentalDistortion2": p2,
        }  # fmt: skip
        turn = {f"r{i + 1}{j + 1}": ROT[name][i, j] for i in range(3) for j in range(3)}
        pose = dict(zip("xyz", 1000 * T[name])) | turn
        inner = "".join(
            f"<{tag} " + " ".join(f"{k}={quoteattr(repr(float(v)))}" for k, v in values.items()) + "/>"
            for tag, values in (("transform", pose), ("intrinsic", lens))
        )
        parts.append(f'<camera active="1" serial="{name}" viewrotation="0">{inner}</camera>')
    text = "<calibration><results/><cameras>" + "".join(parts) + "</cameras></calibration>"
    for word in ("calibration>", "cameras>", "camera ", "camera>", "transform", "intrinsic ") if capitals else ():
        text = text.replace(f"<{word}", f"<{word.title()}").replace(f"</{word}", f"</{word.title()}")
    return text


@pytest.mark.parametrize(("size", "capitals"), [("sensorDimU", False), ("sensorMaxU", False), ("sensorDimU", True)])
def test_theia_is_in_pixels_and_gives_the_translation(tmp_path, size, capitals):
    path = tmp_path / "calibration.txt"
    path.write_text(theia(size, capitals))
    assert_projects(read_calibration(path))


def test_qualisys_without_a_field_of_view_has_subpixels_and_the_position(tmp_path):
    parts = []
    for name in K:
        (fx, _, cx), (_, fy, cy), _ = np.multiply(64.0, K[name])
        k1, k2, p1, p2, k3 = DIST[name]
        r = np.diag([1, -1, -1]) @ ROT[name]  # Qualisys' cameras look along -z, y up
        place = " ".join(f'{axis}="{1000 * v!r}"' for axis, v in zip("xyz", CENTRE[name]))
        turn = " ".join(f'r{i + 1}{j + 1}="{float(r[i, j])!r}"' for i in range(3) for j in range(3))
        parts.append(
            f'<camera active="1" serial="{name}" viewrotation="0"><transform {place} {turn}/><intrinsic sensorMinU="0" '
            f'sensorMaxU="81919.000000" sensorMinV="0" sensorMaxV="46079.000000" '
            f'focalLengthU="{fx}" focalLengthV="{fy}" centerPointU="{cx}" centerPointV="{cy}" skew="0" '
            f'radialDistortion1="{k1}" radialDistortion2="{k2}" '
            f'radialDistortion3="{k3}" tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/></camera>'
        )
    path = tmp_path / "a.qca.txt"
    path.write_text(f"<calibration><cameras>{''.join(parts)}</cameras></calibration>")
    assert_projects(read_calibration(path))
    path.write_text(path.read_text().replace('viewrotation="0"', 'viewrotation="90"'))
    with pytest.raises(CalibrationError, match="view is rotated by 90"):
        read_calibration(path)


# ---------------------------------------------------------------- Vicon


def vicon(lens="", attributes="", frames=1, **changes):
    cameras = []
    for name in K:
        (fx, _, cx), *_ = K[name]
        values = {
            "FOCAL_LENGTH": fx, "PRINCIPAL_POINT": f"{cx} {K[name][1][2]}",
            "ORIENTATION": " ".join(map(repr, map(float, xyzw(ROT[name])))),
            "POSITION": " ".join(repr(1000.0 * v) for v in CENTRE[name]),
        } | changes  # fmt: skip
        frame = " ".join(f'{key}="{value}"' for key, value in values.items() if value is not None)
        frame = f'<KeyFrame FRAME="0" {frame} {lens.format(cx=cx, cy=K[name][1][2])}/>' * frames
        size = f'SENSOR_SIZE="{SIZE[0]} {SIZE[1]}"'
        cameras.append(
            f'<Camera DEVICEID="{name}" TYPE="VideoInputDevice:X" ISDV="1" {size} {attributes}>'
            f"<KeyFrames>{frame}</KeyFrames></Camera>"
        )
    cameras += ['<Camera DEVICEID="77" TYPE="Vantage5" ISDV="0"><KeyFrames><KeyFrame/></KeyFrames></Camera>']
    return f'<?xml version="1.0" encoding="UTF-8"?><Cameras VERSION="2.0">{"".join(cameras)}</Cameras>'


@pytest.fixture
def square(monkeypatch):
    """Vicon has one focal length."""
    for name in K:
        monkeypatch.setitem(K, name, [[K[name][0][0], 0, K[name][0][2]], [0, K[name][0][0], K[name][1][2]], [0, 0, 1]])


def test_vicon_without_distortion(tmp_path, square):
    path = tmp_path / "trial.xcp"
    path.write_text(vicon())
    rig = read_calibration(path)
    assert rig.names == ("01", "02")  # the cameras that film
    assert_projects(rig, dist=[0] * 5)
    with pytest.raises(CalibrationError, match="read, not written"):
        write_calibration_like(rig, path, tmp_path / "b.xcp")


@pytest.mark.parametrize("k", [(2e-8, -3e-15, 0.0), (-3e-8, 2e-15, 1e-21), (8e-8, 4e-14, 0.0)])
@pytest.mark.parametrize("second", [True, False])
def test_vicon_lenses_lead_from_distorted_to_ideal(tmp_path, square, k, second):
    """Every pixel of the image, laid through Vicon's own formula, is where the ideal camera sees the ray."""
    if not second and k[2]:
        return
    lens = 'VICON_RADIAL2="Vicon3Parameter {{cx}} {{cy}} {} {} {}"' if second else 'VICON_RADIAL="{} {}"'
    path = tmp_path / "trial.xcp"
    path.write_text(vicon(lens.format(*k)))
    v, u = np.mgrid[0 : SIZE[1] : 12j, 0 : SIZE[0] : 12j].reshape(2, -1)
    for camera in read_calibration(path):
        centre = np.array([K[camera.name][0][2], K[camera.name][1][2]])
        offset = np.stack([u, v], axis=1) - centre
        r2 = (offset**2).sum(1, keepdims=True)
        ideal = offset * (1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3)
        assert np.abs(ideal - offset).max() > 5  # it is no trifle
        rays = np.hstack([ideal / K[camera.name][0][0], np.ones((len(u), 1))]) @ ROT[camera.name]
        seen = camera.project(CENTRE[camera.name] + 3.0 * rays)
        np.testing.assert_allclose(seen, np.stack([u, v], axis=1), atol=0.01)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        ({"frames": 2}, "2 key frames: the camera moves"),
        ({"ORIENTATION": "0 0 0 0"}, "quaternion of length 0, not 1"),
        ({"ORIENTATION": None}, "camera 01, ORIENTATION.*4 numbers"),
        ({"POSITION": "1 2"}, "camera 01, POSITION.*3 numbers"),
        ({"FOCAL_LENGTH": "nan"}, "camera 01, FOCAL_LENGTH.*finite"),
        ({"attributes": 'PIXEL_ASPECT_RATIO="1.09"'}, "not square"),
        ({"attributes": 'SKEW="0.1"'}, "not square"),
        ({"lens": 'VICON_RADIAL2="Vicon3Parameter 600 300 1e-8 0 0"'}, "the centre of distortion is not"),
        ({"lens": 'VICON_RADIAL2="ViconFisheye 641.5 352.25 1e-8 0 0"'}, "lens 'ViconFisheye'"),
        ({"lens": 'VICON_RADIAL2="Vicon3Parameter 641.5 352.25 1e-8"'}, "VICON_RADIAL2.*5 numbers"),
        ({"lens": 'VICON_RADIAL="-0.2 0.1"'}, "OpenCV's lens cannot hold"),
        ({"lens": 'VICON_RADIAL="1e-8 0 0 0"'}, "4 coefficients"),
    ],
)  # fmt: skip
def test_vicon_files_that_are_refused(tmp_path, made, words):
    path = tmp_path / "trial.xcp"
    path.write_text(vicon(**made))
    with pytest.raises(CalibrationError, match=words) as caught:
        read_calibration(path)
    assert caught.value.remedy and str(path) in str(caught.value)


# ---------------------------------------------------------------- MATLAB


def matlab(name, old):
    """`toStruct` of one camera: pixels from one, sizes as rows and columns, before R2022b the transposed matrix."""
    ones = np.add(K[name], [[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    k1, k2, p1, p2, k3 = DIST[name]
    return {
        "ImageSize": [SIZE[1], SIZE[0]], "RadialDistortion": [k1, k2, k3], "TangentialDistortion": [p1, p2],
        "WorldUnits": "millimeters", "RotationVectors": [[0.1, 0.2, 0.3]], "IntrinsicMatrix" if old else "K":
        (ones.T if old else ones).tolist(),
    }  # fmt: skip


@pytest.mark.parametrize("old", [True, False])
@pytest.mark.parametrize("ending", ["mat", "json"])
def test_matlab_stereo_parameters(tmp_path, old, ending):
    """The first camera is the world: x2 = x1 R + t, points as rows."""
    R = ROT["02"] @ ROT["01"].T
    t = 1000 * (T["02"] - R @ T["01"])
    pose = {"RotationOfCamera2": R.T.tolist(), "TranslationOfCamera2": t.tolist()} if old else {
        "PoseCamera2": {"Dimensionality": 3, "R": R.tolist(), "Translation": t.tolist()}
    }  # fmt: skip
    tree = {"CameraParameters1": matlab("01", old), "CameraParameters2": matlab("02", old)} | pose
    path = tmp_path / f"stereo.{ending}"
    savemat(path, {"stereoParams": tree}) if ending == "mat" else path.write_text(json.dumps(tree))
    rig = read_calibration(path)
    T_first = np.eye(4)
    T_first[:3, :3], T_first[:3, 3] = ROT["01"], T["01"]
    assert_projects(rig.moved(np.linalg.inv(T_first)), {"01": "left", "02": "right"})


@pytest.mark.parametrize("names", [("cameraMatrix1", "distCoeffs1"), ("K1", "D1"), ("K_1", "dist_1"), ("M1", "D1")])
def test_a_stereo_pair_by_any_names(tmp_path, names):
    R = ROT["02"] @ ROT["01"].T
    tree = {"R": R.tolist(), "T": (T["02"] - R @ T["01"]).tolist(), "imageSize": SIZE}
    for i, name in enumerate(K, 1):
        tree |= {key.replace("1", str(i)): values[name] for key, values in zip(names, (K, DIST))}
    (tmp_path / "stereo.json").write_text(json.dumps(tree))
    T_first = np.eye(4)
    T_first[:3, :3], T_first[:3, 3] = ROT["01"], T["01"]
    rig = read_calibration(tmp_path / "stereo.json")
    assert_projects(rig.moved(np.linalg.inv(T_first)), {"01": "left", "02": "right"})


@pytest.mark.parametrize("old", [True, False])
def test_matlab_structs_of_cameras(tmp_path, old):
    cameras = {}
    for name in K:
        ones = np.add(K[name], [[0, 0, 1], [0, 0, 1], [0, 0, 0]])
        cameras[f"cam{name}"] = {
            "K": ones.T if old else ones, "R": ROT[name].T if old else ROT[name], "t": T[name],
            "imageSize": [SIZE[1], SIZE[0]], "dist": DIST[name],
        }  # fmt: skip
    savemat(tmp_path / "a.mat", cameras)
    assert_projects(read_calibration(tmp_path / "a.mat"), {name: f"cam{name}" for name in K})
    (tmp_path / "all").mkdir()
    for name, one in cameras.items():
        savemat(tmp_path / "all" / f"{name}.mat", one)
    assert_projects(read_calibration(tmp_path / "all"), {name: f"cam{name}" for name in K})


def test_matlab_files_that_are_refused(tmp_path):
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file, cut")
    with pytest.raises(FileError, match="not a readable MATLAB file"):
        read_calibration(path)
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400))
    with pytest.raises(FileError, match="7.3.*-v7"):
        read_calibration(path)
    savemat(path, {"K": K["01"], "imageSize": [300, 200]})
    with pytest.raises(CalibrationError, match=r"lies outside.*\[rows, columns\]"):
        read_calibration(path)
    (tmp_path / "fish.json").write_text(json.dumps({"Intrinsics": {"MappingCoefficients": [1, 2, 3, 4]}}))
    with pytest.raises(CalibrationError, match="fisheye model"):
        read_calibration(tmp_path / "fish.json")


def test_objects_of_matlab_are_refused(data_dir):
    folder = data_dir("stereo_dic_cylinder") / "BAcheckerboardImages"
    with pytest.raises(CalibrationError, match="objects.*toStruct"):
        read_calibration(folder / "cameraCBparameters_cam_201.mat")


# ---------------------------------------------------------------- any names


def pose_rows(name):
    return np.hstack([ROT[name], T[name][:, None]]).tolist()


def back(name):
    return [*np.hstack([ROT[name].T, np.array(CENTRE[name])[:, None]]).tolist(), [0, 0, 0, 1]]


def lens(name):
    return {"K": K[name], "dist": DIST[name], "imgSize": SIZE}


NAMINGS = {
    "RT": lambda n: lens(n) | {"RT": pose_rows(n)},
    "extrinsic 4 x 4": lambda n: lens(n) | {"extrinsic": [*pose_rows(n), [0, 0, 0, 1]]},
    "camera to world": lambda n: lens(n) | {"camera_to_world": back(n)},
    "c2w 3 x 4": lambda n: lens(n) | {"c2w": back(n)[:3]},
    "vectors": lambda n: lens(n) | {"rvec": rotation_vector(ROT[n]).tolist(), "tvec": T[n].tolist()},
    "parts": lambda n: {
        "intrinsic": {"fx": K[n][0][0], "fy": K[n][1][1], "cx": K[n][0][2], "cy": K[n][1][2], "width": 1280, "h": 720},
        "distortion": dict(zip(("k1", "k2", "p1", "p2", "k3"), DIST[n])),
        "extrinsic": {"R": ROT[n].tolist(), "T": T[n].tolist()},
    },
    "four numbers": lambda n: {
        "intrinsics": [K[n][0][0], K[n][1][1], K[n][0][2], K[n][1][2]], "distortion_coeffs": DIST[n],
        "image_shape": [720, 1280, 3], "R": ROT[n].tolist(), "t": T[n].tolist(),
    },
    "K and k": lambda n: {"k": DIST[n], "K": K[n], "image-size": SIZE, "R": ROT[n].tolist(), "t": T[n].tolist()},
    "rows, as JARVIS": lambda n: {
        "intrinsicMatrix": np.transpose(K[n]).tolist(), "distortionCoefficients": [DIST[n]], "image_size": SIZE,
        "R": ROT[n].T.tolist(), "T": [T[n].tolist()],
    },
    "ROS": lambda n: {
        "camera_name": n, "image_width": 1280, "image_height": 720,
        "camera_matrix": {"rows": 3, "cols": 3, "data": np.ravel(K[n]).tolist()}, "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": DIST[n]}, "R": ROT[n].tolist(), "t": T[n].tolist(),
    },
}  # fmt: skip


def inline(value):
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}" = {inline(inner)}' for key, inner in value.items()) + "}"
    return json.dumps(value)


@pytest.mark.parametrize("naming", NAMINGS)
@pytest.mark.parametrize("ending", ["json", "yaml", "toml"])
def test_any_sensible_names(tmp_path, naming, ending):
    trees = {f"c{name}": NAMINGS[naming](name) for name in K}
    path = tmp_path / f"mine.{ending}"
    if ending == "json":
        path.write_text(json.dumps({"cameras": trees}))
    else:
        toml, lines = ending == "toml", []
        for name, tree in trees.items():
            lines += [f"[{name}]" if toml else f"{name}:"]
            lines += [f'"{key}" = {inline(v)}' if toml else f"  {key}: {json.dumps(v)}" for key, v in tree.items()]
        path.write_text("\n".join(lines) + "\n")
    assert_projects(read_calibration(path), {n: n if naming == "ROS" else f"c{n}" for n in K})


def test_a_table_for_each_quantity(tmp_path):
    poses = {"R": {n: R.tolist() for n, R in ROT.items()}, "t": {n: t.tolist() for n, t in T.items()}}
    tree = {"K": K, "dist": DIST, "resolution": SIZE} | poses
    (tmp_path / "a.json").write_text(json.dumps(tree))
    assert_projects(read_calibration(tmp_path / "a.json"))


def test_rows_are_written_back_as_rows(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps({name: NAMINGS["rows, as JARVIS"](name) for name in K}))
    rig = read_calibration(path)
    write_calibration_like(rig, path, tmp_path / "b.json")
    tree = json.loads((tmp_path / "b.json").read_text())
    np.testing.assert_allclose(tree["01"]["R"], ROT["01"].T, atol=1e-9)
    np.testing.assert_allclose(tree["01"]["intrinsicMatrix"], np.transpose(K["01"]), atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"distortion_model": "omni"}, "lens of the model omni.*Undistort"),
        ({"camera_model": "double_sphere"}, "lens of the model double_sphere"),
        ({"RT": [[1, 0], [0, 1]]}, r"pose of shape \(2, 2\)"),
        ({"RT": np.transpose([*pose_rows("01"), [0, 0, 0, 1]]).tolist()}, "last row is not 0 0 0 1"),
        ({"RT": None, "R": [0, 0, 0, 1], "t": [0, 0, 0]}, "rotation has shape"),
        ({"RT": None}, "rotation and translation missing"),
        ({"imgSize": None}, r"camera c01.*size of its image is missing.*size = \[width, height\].*\[\[camera\]\]"),
        ({"K": [1, 2, 3]}, "camera matrix.*3 x 3"),
        ({"K": [900, 640, 900, 360], "dist": "none"}, "distortion.*numbers"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_told(tmp_path, changes, words):
    path = tmp_path / "a.json"
    path.write_text(json.dumps({f"c{n}": NAMINGS["RT"](n) | changes for n in K}))
    with pytest.raises(CalibrationError, match=words) as caught:
        read_calibration(path)
    assert caught.value.remedy and str(path) in str(caught.value)


def test_sizes_are_asked_for_by_name(tmp_path):
    write_easymocap(tmp_path, sizes=False)
    assert_projects(read_calibration(tmp_path, image_size={"01": SIZE, "02": SIZE}.get))
    with pytest.raises(CalibrationError, match=r"camera 02: the size of its image is missing"):
        read_calibration(tmp_path, image_size={"01": SIZE}.get)
    write_calibration(read_calibration(tmp_path, image_size=SIZE), tmp_path / "all.toml")
    assert_projects(read_calibration(tmp_path / "all.toml"))


# ---------------------------------------------------------------- written back, and damaged


def trees():
    panoptic = [{"type": "hd", "panel": 0, "node": i, **camera(name, 100)} for i, name in enumerate(K)]
    stereo = {f"CameraParameters{i}": matlab(name, True) for i, name in enumerate(K, 1)}
    stereo |= {"RotationOfCamera2": np.eye(3).tolist(), "TranslationOfCamera2": [100.0, 0, 0]}
    own = {key: {f"c{name}": make(name) for name in K} for key, make in NAMINGS.items()}
    return own | {"panoptic": {"cameras": panoptic}, "stereo": stereo}


@pytest.mark.parametrize("kind", ["panoptic", "freemocap", "camera to world", "c2w 3 x 4", "RT"])
def test_units_and_directions_are_kept_where_a_rig_is_written_like_another(tmp_path, kind):
    path = tmp_path / ("a.toml" if kind == "freemocap" else "a.json")
    path.write_text(freemocap(58.0) if kind == "freemocap" else json.dumps(trees()[kind]))
    rig = read_calibration(path)
    turn = np.array([[0, -1, 0, 0.3], [1, 0, 0, -0.2], [0, 0, 1, 0.1], [0, 0, 0, 1]])
    write_calibration_like(rig.moved(turn), path, tmp_path / f"b{path.suffix}")
    for one, other in zip(read_calibration(tmp_path / f"b{path.suffix}"), rig.moved(turn)):
        np.testing.assert_allclose(one.T_camera_world, other.T_camera_world, atol=1e-9)


def leaves(tree, path=()):
    yield path
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ():
        yield from leaves(value, (*path, key))


JUNK = [None, "x", "", [], {}, 0, -1, True, [[1], [2, 3]], {"K": [1]}, [None], 1e300, [[0, 0, 0]] * 3, {"data": "x"}]


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_a_value_that_is_wrong_anywhere_is_a_typed_error_or_a_rig(tmp_path_factory, data):
    tree = json.loads(json.dumps(trees()[data.draw(st.sampled_from(sorted(trees())))]))
    *way, last = data.draw(st.sampled_from([path for path in leaves(tree) if path]))
    inner = tree
    for key in way:
        inner = inner[key]
    inner[last] = data.draw(st.sampled_from(JUNK))
    path = tmp_path_factory.mktemp("wrong") / "a.json"
    path.write_text(json.dumps(tree))
    _typed_or_rig(path)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_a_text_that_is_cut_is_a_typed_error_or_a_rig(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("cut")
    write_easymocap(folder)
    text = data.draw(st.sampled_from([vicon(), theia(), freemocap(58.0), (folder / "intri.yml").read_text()]))
    path = folder / "cut.txt"
    path.write_text(text[: data.draw(st.integers(0, len(text)))])
    _typed_or_rig(path)


def _typed_or_rig(path):
    try:
        assert len(read_calibration(path, image_size=SIZE)) >= 1
    except KinefitError as error:
        assert str(path) in str(error) and error.remedy


def test_a_matlab_file_that_ends_its_reader_is_damaged(tmp_path, monkeypatch):
    path = tmp_path / "a.mat"
    savemat(path, {"K": np.eye(3), "s": {"a": np.zeros((2, 3)), "n": "cam"}, "c": np.array([1, "x", [1, 2]], object)})
    data = path.read_bytes()
    for at, value in ((213, 8), (442, 216)):  # on which scipy 1.17 crashes, if both are there
        data = data[:at] + bytes([value]) + data[at + 1 :]
    path.write_bytes(data)
    with pytest.raises((FileError, CalibrationError), match="a.mat"):
        read_calibration(path)
    words = python("-c", "import os; os.abort()")
    monkeypatch.setattr("kinefit.readers.calibration.programs.python", lambda *_: words)
    with pytest.raises(FileError, match=r"a\.mat: not a readable MATLAB file: scipy's reader crashes"):
        read_calibration(path)
    words[:] = python("-c", "import time; time.sleep(60)")
    monkeypatch.setattr("kinefit.readers.calibration.programs._MAX_READ_S", 0.2)
    with pytest.raises(FileError, match="does not end within"):
        read_calibration(path)
