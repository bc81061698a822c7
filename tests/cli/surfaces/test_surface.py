"""`kinefit surface`: photographs and videos of drawn planes, a real board, and input that cannot be."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from tests.images.photogrammetry import scenes

from kinefit.cli.surfaces._measure import in_number_order
from kinefit.cli.surfaces.surface import surface
from kinefit.errors import CalibrationError, FileError, ObservationError
from kinefit.geometry import se3
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import write_calibration

TEXTURE = scenes.Texture(0.005, 3)


def call(*words):
    return CliRunner().invoke(surface, [str(word) for word in words], catch_exceptions=True)


def pose(k):
    return se3.transform(se3.exp_so3(np.array([0.0, 0.1, 0.02 * k])), np.array([0.003 * k, 0.0, 0.002 * k]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Photographs and videos of a plane that moves, by two cameras."""
    root, rng = tmp_path_factory.mktemp("surface"), np.random.default_rng(0)
    rig = Rig(scenes.three().cameras[:2])
    write_calibration(rig, root / "calib.toml")
    for view in rig:
        (root / view.name).mkdir()
        code = cv2.VideoWriter_fourcc(*"MJPG")
        video = cv2.VideoWriter(str(root / f"{view.name}.avi"), code, 30.0, view.size)
        video.set(cv2.VIDEOWRITER_PROP_QUALITY, 100)
        for k in range(4):
            grey = np.clip(scenes.plane_image(view, TEXTURE, pose(k), 1.0, rng).grey, 0, 255).astype(np.uint8)
            if k < 3:
                cv2.imwrite(str(root / view.name / f"{k}.png"), grey)
            video.write(np.repeat(grey[..., None], 3, axis=2))
        video.release()
    return root


def test_help_has_examples():
    told = call("--help").output
    assert "CAMERA=PATH" in told and "--gauge" in told and "folders: states" in told


def test_photographs_of_states_become_tables_meshes_and_pictures(folder, tmp_path):
    out = tmp_path / "out"
    result = call(
        folder / "calib.toml", f"a={folder / 'a'}", f"b={folder / 'b'}", "-o", out, "--step", 10, "--window", 17,
        "--gauge", 100, "--still", 2,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "noise floor" in result.output and "state 2" in result.output
    names = {path.name for path in out.iterdir()}
    assert {"points_000.csv", "surface_002.vtk", "std_001.png", "displacement_002.png", "strain_xx_001.png"} <= names
    with (out / "points_002.csv").open() as file:
        rows = list(csv.DictReader(file))
    x = np.array([[float(row[f"{axis}_m"]) for axis in "xyz"] for row in rows])
    assert len(x) > 100
    assert np.abs(se3.apply(se3.inverse(pose(2)), x)[:, 2]).max() < 2e-3
    strains = np.array([float(row["strain_xx"]) for row in rows if row["strain_xx"]])
    assert len(strains) > 20 and np.abs(strains).max() < 0.02


@pytest.mark.parametrize(("kind", "scale"), [(np.uint16, 16), (np.float32, 1 / 255)])
def test_folders_of_tiff_with_more_than_eight_bits(folder, tmp_path, kind, scale):
    """12 bits in 16, as cameras for image correlation write them, and float: the same surface as of eight bits."""
    found = []
    for name in "ab":
        (tmp_path / name).mkdir()
        for k in range(3):
            grey = cv2.imread(str(folder / name / f"{k}.png"), cv2.IMREAD_GRAYSCALE)
            cv2.imwrite(str(tmp_path / name / f"state_{k}.tif"), (grey.astype(float) * scale).astype(kind))
    for place in (folder, tmp_path):
        out = tmp_path / f"out{len(found)}"
        words = [folder / "calib.toml", *(f"{name}={place / name}" for name in "ab")]
        result = call(*words, "-o", out, "--step", 10, "--window", 17)
        assert result.exit_code == 0, result.output
        with (out / "points_002.csv").open() as file:
            found.append(np.array([[float(row[f"{axis}_m"]) for axis in "xyz"] for row in csv.DictReader(file)]))
    assert len(found[1]) > 100 and abs(len(found[0]) - len(found[1])) < 0.05 * len(found[0])
    plane = se3.inverse(pose(2))
    off = [np.abs(se3.apply(plane, x)[:, 2]).max() for x in found]
    assert off[1] < max(1.5 * off[0], 1e-3)


def test_values_that_no_light_has_are_refused(folder, tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "0.tif"), np.full((40, 40), np.nan, np.float32))
    result = call(folder / "calib.toml", *(f"{name}={tmp_path / name}" for name in "ab"), "-o", tmp_path / "out")
    assert isinstance(result.exception, FileError) and "0.tif" in str(result.exception)


def read_vtk(path):
    """Points, triangles and scalars of a legacy VTK file, read by the format's own rules."""
    data, at, out = path.read_bytes(), 0, {}

    def line():
        nonlocal at
        end = data.index(b"\n", at)
        text, at = data[at:end].decode(), end + 1
        return text

    def numbers(kind, count):
        nonlocal at
        values = np.frombuffer(data, kind, count, at)
        at += values.nbytes
        return values.astype(float)

    assert line().startswith("# vtk DataFile") and line() and line() == "BINARY" and line() == "DATASET POLYDATA"
    name = None
    while at < len(data):
        words = line().split()
        if words[:1] == ["POINTS"]:
            out["points"] = numbers(">f8", 3 * int(words[1])).reshape(-1, 3)
        elif words[:1] == ["POLYGONS"]:
            out["faces"] = numbers(">i4", int(words[2])).reshape(-1, 4)[:, 1:].astype(int)
        elif words[:1] == ["SCALARS"]:
            name = words[1]
        elif words[:1] == ["LOOKUP_TABLE"]:
            out[name] = numbers(">f8", len(out["points"]))
        elif words[:1] == ["VECTORS"]:
            out[words[1]] = numbers(">f8", 3 * len(out["points"])).reshape(-1, 3)
    return out


def test_two_photographs_of_a_plate_become_a_strain_map(tmp_path):
    stretch = np.array([[1.004, 0.001], [0.0, 0.998]])
    for name, image in zip(("before", "after"), scenes.pair((200, 160), deform=stretch, noise=1.0, grain=2.0)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.clip(np.rint(image.grey), 0, 255).astype(np.uint8))
    files, out = (tmp_path / "before.png", tmp_path / "after.png"), tmp_path / "out"
    result = call(*files, "--flat", 0.05, "--gauge", 4, "--window", 21, "-o", out)
    assert result.exit_code == 0 and "strain over" in result.output, result.output
    mesh = read_vtk(out / "surface_001.vtk")
    assert len(mesh["faces"]) > 500 and mesh["faces"].max() == len(mesh["points"]) - 1
    green = 0.5 * (stretch.T @ stretch - np.eye(2))
    for name, value in (("xx", green[0, 0]), ("yy", green[1, 1]), ("xy", green[0, 1])):
        assert abs(np.nanmean(mesh[f"strain_{name}"]) - value) < 3e-4
    np.testing.assert_allclose(mesh["displacement"][:, 2], 0.0)
    board = 60 + 120 * (np.indices((160, 200)) // 12).sum(axis=0) % 240
    cv2.imwrite(str(tmp_path / "board.png"), board.astype(np.uint8))
    told = call(tmp_path / "board.png", tmp_path / "board.png", "--flat", 0.05, "-o", out)
    assert isinstance(told.exception, ObservationError) and "repeats" in str(told.exception)
    told = call("a=before.png", *files, "--flat", 0.05, "-o", out)
    assert isinstance(told.exception, ObservationError) and "a=before.png" in str(told.exception)


def test_a_flat_surface_without_texture_is_told(tmp_path):
    for name in ("before.png", "after.png"):
        cv2.imwrite(str(tmp_path / name), np.full((200, 200), 128, np.uint8))
    told = call(tmp_path / "before.png", tmp_path / "after.png", "--flat", 0.05, "-o", tmp_path / "out")
    assert isinstance(told.exception, ObservationError) and "no texture" in str(told.exception)


def test_smoothing_is_heard(folder, tmp_path):
    std = []
    for smooth in (0, 1):
        out = tmp_path / str(smooth)
        views = f"a={folder / 'a' / '0.png'}", f"b={folder / 'b' / '0.png'}"
        result = call(folder / "calib.toml", *views, "-o", out, "--step", 20, "--smooth", smooth)
        assert result.exit_code == 0, result.output
        std.append((out / "points_000.csv").read_text())
    assert std[0] != std[1]
    assert call(folder / "calib.toml", *views, "--smooth", -1).exit_code == 2


def test_videos_are_tracked(folder, tmp_path):
    out = tmp_path / "out"
    views = f"a={folder / 'a.avi'}", f"b={folder / 'b.avi'}"
    result = call(folder / "calib.toml", *views, "-o", out, "--step", 15)
    assert result.exit_code == 0, result.output
    assert "4 frames" in result.output
    with (out / "trajectories.csv").open() as file:
        rows = list(csv.DictReader(file))
    last = [row for row in rows if float(row["time_s"]) == pytest.approx(0.1)]
    assert len(last) > 30
    for name, view in (("paths_a", "a"), ("paths_b", "b"), ("velocity", "a")):
        picture = cv2.imread(str(out / f"{name}.png")).astype(int)
        grey = cv2.imread(str(folder / view / "0.png"), cv2.IMREAD_GRAYSCALE)
        assert picture.shape == (grey.shape[0], grey.shape[1] + 180, 3)
        coloured = np.ptp(picture[:, : grey.shape[1]], axis=2) > 30
        assert 0.002 < coloured.mean() < 0.5
    told = call(folder / "calib.toml", *views, "-o", out, "--gauge", 3)
    assert isinstance(told.exception, ObservationError) and "--gauge cannot be used with videos" in str(told.exception)


def test_bounds_and_neighbours_cut_paths_of_videos(folder, tmp_path):
    """The plane moves by 0.11 m/s and accelerates little: bounds above that cut nothing, bounds below it everything."""
    views = f"a={folder / 'a.avi'}", f"b={folder / 'b.avi'}"
    wide = [*views, "-o", tmp_path / "wide", "--step", 20, "--bounds", 1, 500, "--neighbours"]
    wide = call(folder / "calib.toml", *wide)
    assert wide.exit_code == 0 and ", bounds 0," in wide.output, wide.output
    none = call(folder / "calib.toml", *views, "-o", tmp_path / "none", "--step", 20, "--bounds", 0.02, 500)
    assert none.exit_code == 0 and ": 0 of " in none.output, none.output
    assert len((tmp_path / "wide" / "trajectories.csv").read_text().splitlines()) > 100
    assert len((tmp_path / "none" / "trajectories.csv").read_text().splitlines()) == 1
    assert (tmp_path / "wide" / "velocity.png").exists() and not list((tmp_path / "none").glob("*paths*"))
    told = call(folder / "calib.toml", f"a={folder / 'a'}", f"b={folder / 'b'}", "-o", tmp_path, "--bounds", 1, 50)
    assert isinstance(told.exception, ObservationError) and "--bounds needs videos" in str(told.exception)


def test_a_motion_must_be_of_the_same_videos(folder, tmp_path):
    from benchmarks.accuracy.surfaces.surface_body import moving_arm

    from kinefit.exporters.motion_file import write_motion

    views = f"a={folder / 'a.avi'}", f"b={folder / 'b.avi'}"
    motion, file = moving_arm(0, 4), tmp_path / "motion.npz"
    write_motion(motion, file)
    told = call(folder / "calib.toml", *views, "-o", tmp_path / "out", "--step", 15, "--motion", file)
    assert told.exit_code == 0, told.output  # nothing of the plane is the arm's: as without it
    for other in (replace(motion, rate=60.0), replace(motion, times=motion.times + 1.0)):
        write_motion(other, file)
        told = call(folder / "calib.toml", *views, "-o", tmp_path / "out", "--motion", file)
        assert isinstance(told.exception, FileError) and "fit videos of 30 Hz" in str(told.exception)
    told = call(folder / "calib.toml", f"a={folder / 'a'}", f"b={folder / 'b'}", "--motion", file)
    assert isinstance(told.exception, ObservationError) and "--motion needs videos" in str(told.exception)
    told = call("a.png", "b.png", "--flat", 0.05, "--motion", file)
    assert isinstance(told.exception, ObservationError) and "--flat has photographs" in str(told.exception)


def test_a_real_board_from_seeds_by_hand_is_flat(data_dir, tmp_path):
    pictures = data_dir("stereo_opencv_chessboard")
    corners = []
    for name in ("left01", "right01"):
        grey = cv2.imread(str(pictures / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
        found = cv2.findChessboardCorners(grey, (9, 6))[1]
        corners.append(cv2.cornerSubPix(grey, found, (4, 4), (-1, -1), (3, 30, 0.01)).reshape(-1, 2))
    np.savetxt(tmp_path / "seeds.csv", np.hstack(corners), delimiter=",", header="u1,v1,u2,v2", comments="")
    mask = np.zeros((480, 640), np.uint8)
    cv2.fillConvexPoly(mask, np.rint(corners[0][[0, 8, 53, 45]]).astype(np.int32), 255)
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    result = call(
        pictures, f"left={pictures / 'left01.jpg'}", f"right={pictures / 'right01.jpg'}", "--unit", 0.025,
        "--window", 41, "--seeds", tmp_path / "seeds.csv", "--mask", tmp_path / "mask.png", "--step", 8,
        "-o", tmp_path / "out",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    with (tmp_path / "out" / "points_000.csv").open() as file:
        x = np.array([[float(row[f"{axis}_m"]) for axis in "xyz"] for row in csv.DictReader(file)])
    assert len(x) > 300
    normal = np.linalg.svd(x - x.mean(axis=0))[2][-1]
    assert np.median(np.abs((x - x.mean(axis=0)) @ normal)) < 1e-3


@pytest.mark.parametrize(
    ("words", "error", "text"),
    [
        (["a={0}/a"], ObservationError, "1 views"),
        (["a={0}/a", "{0}/b"], ObservationError, "CAMERA=PATH"),
        (["a={0}/a", "b={0}/b/0.png"], ObservationError, "photographs: 3, 1"),
        (["a={0}/a", "b={0}/b.avi"], ObservationError, "1 videos"),
        (["a={0}/a", "nose={0}/b"], CalibrationError, "no camera 'nose'"),
        (["a={0}/a", "b={0}/nothing*"], FileError, "no images"),
        (["a={0}/a", "b={0}/b", "--window", "even"], ObservationError, "--window 'even'"),
        (["a={0}/a", "b={0}/b", "--window", "14"], ObservationError, "odd number"),
        (["a={0}/a", "b={0}/b", "--still", "7"], ObservationError, "--still 7 does not exist"),
        (["a={0}/a", "b={0}/b", "--seeds", "{0}/calib.toml"], FileError, "line 2: 'name = \"a\"' is no number"),
    ],
)
def test_what_cannot_be_measured_is_refused(folder, tmp_path, words, error, text):
    result = call(folder / "calib.toml", *(word.format(folder) for word in words), "-o", tmp_path / "out")
    assert isinstance(result.exception, error), result.output
    assert text in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_interlaced_photographs_and_seeds_of_too_few_columns(folder, tmp_path):
    views = f"a={folder / 'a' / '0.png'}", f"b={folder / 'b' / '0.png'}"
    result = call(folder / "calib.toml", *views, "--field", "odd", "-o", tmp_path / "out", "--step", 10)
    assert result.exit_code == 0, result.output
    assert "state 0" in result.output
    (tmp_path / "seeds.csv").write_text("1,2,3\n")
    told = call(folder / "calib.toml", *views, "--seeds", tmp_path / "seeds.csv", "-o", tmp_path / "out")
    assert isinstance(told.exception, FileError) and "3 columns, not 4" in str(told.exception)


def test_photographs_by_a_shell_s_pattern_are_in_the_order_of_their_numbers():
    by_shell = [Path(f"load_{k}.png") for k in (0, 1, 10, 11, 2)]
    assert [path.stem for path in in_number_order(by_shell)] == [f"load_{k}" for k in (0, 1, 2, 10, 11)]
    chosen = [Path(f"load_{k}.png") for k in (3, 1, 2)]
    assert in_number_order(chosen) == chosen  # as somebody put them
    assert in_number_order([Path("after.png"), Path("before.png")])[0] == Path("after.png")


def moved_texture(path, sphere=False):
    """A video of six images of a texture that moves by (2, 1) px a frame, or of a bright sphere on it."""
    rng, size = np.random.default_rng(4), (200, 150)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 30.0, size)
    texture = scenes.Texture(1.5, 5, contrast=8.0 if sphere else 40.0)
    for k in range(6):
        at = scenes.pixels(size) - k * np.array([2.0, 1.0])
        grey = texture(at) + rng.normal(size=len(at))
        if sphere:
            grey[np.hypot(*(at - (80, 60)).T) < 3] = 250
        video.write(np.repeat(np.clip(grey, 0, 255).astype(np.uint8).reshape(*size[::-1], 1), 3, axis=2))
    video.release()


def read_paths(file):
    with file.open() as lines:
        rows = list(csv.DictReader(lines))
    return [{name: float(value) if value else np.nan for name, value in row.items()} for row in rows]


def test_one_video_of_a_flat_surface_is_followed(tmp_path):
    moved_texture(tmp_path / "a.avi")
    told = call(tmp_path / "a.avi", "--flat", 2.0, "--window", 17, "--step", 20, "--reach", 5, "-o", tmp_path / "out")
    assert told.exit_code == 0, told.output
    rows = read_paths(tmp_path / "out" / "trajectories.csv")
    last = [row for row in rows if row["time_s"] == pytest.approx(5 / 30, abs=1e-5)]
    assert len(last) > 20
    for row in last:
        start = next(other for other in rows if other["point"] == row["point"])
        moved = np.array([row[axis] - start[axis] for axis in "xyz"]) / (row["time_s"] - start["time_s"])
        np.testing.assert_allclose(moved, (0.12, -0.06, 0.0), atol=0.005)
    assert (tmp_path / "out" / "paths_image.png").exists()


def test_a_bright_sphere_is_followed_by_its_centroid(tmp_path):
    moved_texture(tmp_path / "a.avi", sphere=True)
    told = call(tmp_path / "a.avi", "--flat", 1.0, "--bright", 12, "-o", tmp_path / "out")
    assert told.exit_code == 0, told.output
    rows = read_paths(tmp_path / "out" / "trajectories.csv")
    own = [row for row in rows if np.hypot(row["x"] - 0.08 - 0.06 * row["time_s"], row["y"] + 0.06) < 0.01]
    assert len({row["point"] for row in own}) == 1 and len(own) == 6
    for k, row in enumerate(own):
        np.testing.assert_allclose((row["x"], row["y"]), (0.08 + 0.002 * k, -0.06 - 0.001 * k), atol=2e-4)


def test_one_camera_follows_points_on_a_body_whose_motion_is_given(tmp_path):
    from benchmarks.accuracy.surfaces.surface_body import cameras, moving_arm
    from benchmarks.scenes.textured import textured_picture

    from kinefit.bodies.surfaces.places import body_mesh, nearest
    from kinefit.exporters.motion_file import write_motion
    from kinefit.simulation.rendering.scenes import SimulatedScene

    motion, camera = moving_arm(0, 5), cameras(320).cameras[0]
    scene = SimulatedScene(motion, body_mesh(motion.body, around=64))
    video = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter_fourcc(*"FFV1"), motion.rate, camera.size)
    for k in range(5):
        video.write(np.repeat(textured_picture(scene, k, camera, grain=0.005)[..., None], 3, axis=2))
    video.release()
    write_motion(motion, tmp_path / "motion.npz")
    write_calibration(Rig((camera,)), tmp_path / "calib.toml")
    words = [tmp_path / "calib.toml", f"{camera.name}={tmp_path / 'a.avi'}", "-o", tmp_path / "out"]
    told = call(*words, "--motion", tmp_path / "motion.npz")
    assert told.exit_code == 0, told.output
    rows = read_paths(tmp_path / "out" / "trajectories.csv")
    last = [row for row in rows if row["time_s"] == pytest.approx(4 / motion.rate, abs=1e-5)]
    assert len(last) > 30 and (tmp_path / "out" / "returns.csv").exists()
    x = np.array([[row[axis] for axis in "xyz"] for row in last])
    gap = nearest(motion.body, motion.state(4), x, max_distance=1.0).distance
    assert np.median(np.abs(gap)) < 1e-3 and gap.max() < 0.021
    told = call(*words)
    assert isinstance(told.exception, ObservationError) and "1 views" in str(told.exception)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["{0}/a.avi", "--flat", "1", "--motion", "m.npz"], "need a calibration"),
        (["{0}/calib.toml", "a={0}/a.avi", "b={0}/b.avi", "--bright", "9", "--motion", "m.npz"], "--bright has none"),
        (["{0}/calib.toml", "a={0}/a", "b={0}/b", "--bright", "9"], "--bright needs videos"),
        (["{0}/a.avi", "--flat", "1", "--bright", "9", "--window", "21"], "--window needs texture"),
        (["{0}/a.avi", "--bright", "9"], "no views"),
        (["{0}/calib.toml", "a={0}/a", "b={0}/b", "--reach", "9"], "--reach needs videos"),
    ],
)
def test_options_of_one_camera_and_bright_points_that_do_not_go_together(folder, tmp_path, words, text):
    told = call(*(word.format(folder) for word in words), "-o", tmp_path / "out")
    assert isinstance(told.exception, ObservationError) and text in str(told.exception)
