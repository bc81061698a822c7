"""Points with names of the user's own: DeepLabCut, SLEAP and Sports2D, as these programs write them."""

import pickle

import numpy as np
import pytest

from kinefit.errors import FileError, KinefitError, ObservationError
from kinefit.readers.guess.files import find_keypoints, find_markers
from kinefit.readers.landmarks.keypoint_sets import KEYPOINT_SETS, _spelled
from kinefit.readers.landmarks.keypoints import read_keypoints
from kinefit.readers.markers import read_markers
from kinefit.readers.plugins import KEYPOINTS

h5py = pytest.importorskip("h5py")
PARTS = ("left_knee", "right_knee", "nose")  # of COCO_17: 13, 14, 0
AT = [13, 14, 0]


def points(people=1, parts=3, frames=5):
    """(F, P, K, 3) x, y [px], confidence, with a point, a person and a frame that are not seen."""
    data = np.random.default_rng(0).uniform(100.0, 600.0, (frames, people, parts, 3)).round(3)
    data[..., 2] = np.random.default_rng(1).uniform(0.1, 1.0, data.shape[:3]).round(3)
    data[1, 0, 1], data[2] = np.nan, np.nan
    if people > 1:
        data[3, 1] = np.nan
    return data


def columns(people, parts):
    individuals = [()] if people == 1 else [(f"p{k}",) for k in range(people)]
    return [("net", *who, part, axis) for who in individuals for part in parts for axis in ("x", "y", "likelihood")]


def deeplabcut_csv(path, data, parts=PARTS):
    names = ["scorer", *["individuals"][: data.shape[1] > 1], "bodyparts", "coords"]
    heads = [[name, *row] for name, row in zip(names, zip(*columns(data.shape[1], parts)))]
    rows = [[k, *("" if np.isnan(v) else v for v in row)] for k, row in enumerate(data.reshape(len(data), -1))]
    path.write_text("\n".join(",".join(map(str, row)) for row in [*heads, *rows]) + "\n")
    return path


def deeplabcut_h5(path, data, parts=PARTS):
    """As pandas writes a table by `to_hdf(..., "df_with_missing", format="table")`."""
    width = 3 * data.shape[1] * data.shape[2]
    table = np.zeros(len(data), [("index", "<i8"), ("values_block_0", "<f8", (width,))])
    table["index"], table["values_block_0"] = np.arange(len(data)), data.reshape(len(data), width)
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group["table"] = table
        axes = pickle.dumps([(1, columns(data.shape[1], parts))], 0)
        group.attrs["pandas_type"], group.attrs["non_index_axes"] = np.bytes_("frame_table"), np.bytes_(axes)
    return path


def sleap_h5(path, data, parts=PARTS):
    """As SLEAP exports an analysis: its arrays are transposed for MATLAB."""
    with h5py.File(path, "w") as file:
        file["tracks"], file["point_scores"] = data[..., :2].transpose(1, 3, 2, 0), data[..., 2].transpose(1, 2, 0)
        file["node_names"] = np.array(parts, "S")
        file["track_names"] = np.array([f"track_{k}" for k in range(data.shape[1])], "S")
    return path


def sleap_csv(path, data, parts=PARTS):
    lines = ["track,frame_idx,instance.score," + ",".join(f"{p}.{a}" for p in parts for a in ("x", "y", "score"))]
    for k, frame in enumerate(data):
        for who, person in enumerate(frame):
            if np.isfinite(person).any():
                cells = ["" if np.isnan(v) else str(v) for v in person.ravel()]
                lines.append(",".join([f"track_{who}", str(k), "0.97", *cells]))
    path.write_text("\n".join(lines) + "\n")
    return path


FORMS = {
    "deeplabcut csv": ("a.csv", deeplabcut_csv), "deeplabcut h5": ("a.h5", deeplabcut_h5),
    "sleap csv": ("a.csv", sleap_csv), "sleap h5": ("a.h5", sleap_h5),
}  # fmt: skip


@pytest.mark.parametrize("people", [1, 2])
@pytest.mark.parametrize("form", FORMS)
def test_every_form_gives_the_points_that_were_written(tmp_path, form, people):
    (name, write), data = FORMS[form], points(people)
    path = write(tmp_path / name, data)
    assert KEYPOINTS.name_of(path) == form.partition(" ")[0]
    seen = read_keypoints(path, camera="c", rate=25.0)
    assert (seen.keypoint_set, len(seen.names), seen.camera, seen.rate) == ("COCO_17", 17, "c", 25.0)
    np.testing.assert_allclose(seen.points[:, :, AT], data[..., :2])
    np.testing.assert_allclose(seen.confidence[:, :, AT], np.nan_to_num(data[..., 2]))
    assert seen.confidence.any(axis=(0, 1)).sum() == 3
    (found,), remarks = find_keypoints([path], [])
    assert (found.format, found.frames, found.points, remarks) == (form.partition(" ")[0], len(data), 17, [])


def test_a_table_that_deeplabcut_wrote_twice_is_used_once(tmp_path):
    files = [deeplabcut_csv(tmp_path / "a.csv", points()), deeplabcut_h5(tmp_path / "a.h5", points())]
    assert [found.path.name for found in find_keypoints(files, [])[0]] == ["a.csv"]
    assert [found.path.name for found in find_keypoints(files[1:], [])[0]] == ["a.h5"]


def test_points_labelled_by_hand_count_fully(tmp_path):
    data = points()
    data[0, 0, :, 2] = np.nan
    seen = read_keypoints(sleap_h5(tmp_path / "a.h5", data), camera="c", rate=25.0)
    assert (seen.confidence[0, 0, AT] == 1.0).all() and not seen.confidence[2].any()


def test_spellings_are_of_one_point_and_no_two_points_are_alike():
    for name in ("left_knee", "LKnee", "l_knee", "L-Knee", "leftKnee", "LEFT KNEE", "knee_l", "KneeLeft", "kneeL"):
        assert _spelled(name) == ("l", "knee"), name
    assert _spelled("RBigToe") == _spelled("right_big_toe") == ("r", "bigtoe")
    assert _spelled("Nose") == _spelled("nose") == ("", "nose") and _spelled("lower_back") == ("", "lowerback")
    assert all(len({_spelled(name) for name in names}) == len(names) for names in KEYPOINT_SETS.values())


@pytest.mark.parametrize("form", FORMS)
def test_names_of_no_set_are_listed_and_can_be_stated(tmp_path, form):
    name, write = FORMS[form]
    path = write(tmp_path / name, points(), ("knie_links", "right_knee", "tail"))
    with pytest.raises(ObservationError, match="names of no point of COCO_17: knie_links, tail") as caught:
        read_keypoints(path, camera="c", rate=25.0)
    assert caught.value.file == path and "names = {" in caught.value.remedy
    names = {"knie_links": "LKnee", "tail": ""}
    seen = read_keypoints(path, camera="c", rate=25.0, names=names)
    np.testing.assert_allclose(seen.points[:, 0, AT[:2]], points()[:, 0, :2, :2])
    assert not seen.confidence[..., 0].any()
    with pytest.raises(ObservationError, match="two names of one point"):
        read_keypoints(path, camera="c", rate=25.0, names={"knie_links": "RKnee", "tail": ""})
    with pytest.raises(ObservationError, match="no point in this file named 'paw'; there are: knie_links"):
        read_keypoints(path, camera="c", rate=25.0, names={"paw": "LKnee"})
    halpe = read_keypoints(path, camera="c", rate=25.0, keypoint_set="HALPE_26", names=names)
    assert halpe.keypoint_set == "HALPE_26" and len(halpe.names) == 26


def test_a_set_of_the_body_s_own_has_the_names_of_the_file(tmp_path):
    path = deeplabcut_csv(tmp_path / "a.csv", points(), ("snout", "tail", "paw"))
    seen = read_keypoints(path, camera="c", rate=25.0, keypoint_set="MOUSE", names={"paw": "forepaw"})
    assert (seen.keypoint_set, seen.names) == ("MOUSE", ("snout", "tail", "forepaw"))
    np.testing.assert_allclose(seen.points, points()[..., :2])


def changed(old, new):
    return lambda text: text.replace(old, new, 1)


BAD = {
    "a cell is not a number": (deeplabcut_csv, changed("\n0,", "\n0,abc")),
    "rows of different lengths": (deeplabcut_csv, changed("coords,x", "coords")),
    "columns likelihood beside, or without, x, y": (deeplabcut_csv, lambda text: text.replace("likelihood", "x")),
    "frame = 0.5": (deeplabcut_csv, changed("\n0,", "\n0.5,")),
    "1 frames in 90000001|frames in 90000001": (deeplabcut_csv, changed("\n0,", "\n90000000,")),
    "a cell is not a number.": (sleap_csv, changed(",0,0.97", ",zero,0.97")),
    "frame_idx = -4": (sleap_csv, changed(",0,0.97", ",-4,0.97")),
}


@pytest.mark.parametrize("problem", BAD)
def test_a_bad_table_is_named(tmp_path, problem):
    write, change = BAD[problem]
    path = write(tmp_path / "a.csv", points())
    path.write_text(change(path.read_text()))
    with pytest.raises((ObservationError, FileError), match=problem) as caught:
        read_keypoints(path, camera="c", rate=25.0)
    assert str(caught.value.file) == str(path) and caught.value.remedy


def test_nothing_seen_and_a_depth_in_place_of_a_likelihood(tmp_path):
    with pytest.raises(ObservationError, match="no point of camera c is seen in any of 5 frames"):
        read_keypoints(sleap_h5(tmp_path / "a.h5", points() * np.nan), camera="c", rate=25.0)
    data = points(parts=3, frames=40)
    data[..., 2] = np.random.default_rng(0).normal(0.0, 5.0, data.shape[:3])
    with pytest.raises(ObservationError, match="no confidence or visibility"):
        read_keypoints(deeplabcut_csv(tmp_path / "a.csv", data), camera="c", rate=25.0)


def test_as_many_names_as_points(tmp_path):
    path = sleap_h5(tmp_path / "a.h5", points(), ("nose", "left_knee"))
    with pytest.raises(FileError, match="2 names of 3 points"):
        read_keypoints(path, camera="c", rate=25.0)


@pytest.mark.parametrize("form", ["deeplabcut h5", "sleap h5"])
def test_damaged_hdf5_is_refused(tmp_path, form):
    name, write = FORMS[form]
    path = write(tmp_path / name, points())
    whole = path.read_bytes()
    for cut in (40, len(whole) // 2, len(whole) - 200):
        path.write_bytes(whole[:cut])
        with pytest.raises(KinefitError):
            read_keypoints(path, camera="c", rate=25.0)


def test_code_in_the_names_of_a_table_is_not_run(tmp_path):
    path = deeplabcut_h5(tmp_path / "a.h5", points())
    with h5py.File(path, "a") as file:
        evil = b"cbuiltins\nopen\n(V" + str(tmp_path / "made").encode() + b"\nVw\ntR."
        file["df_with_missing"].attrs["non_index_axes"] = np.bytes_(evil)
    with pytest.raises(FileError, match=r"another form"):
        read_keypoints(path, camera="c", rate=25.0)
    assert not (tmp_path / "made").exists()


def sports2d(path, data, first=0, rate=50.0):
    """As Sports2D writes its coordinates in pixels: a TRC that states metres, with z = 0."""
    names = ("Hip", "RKnee", "LBigToe")
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{len(data)}\t3\tm\t{rate}\t0\t{len(data)}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t\t", "\t\t" + "\t".join(f"X{k}\tY{k}\tZ{k}" for k in (1, 2, 3)),
    ]  # fmt: skip
    for k, row in enumerate(data[:, 0]):
        cells = [f"{v}" if np.isfinite(v) else "" for x, y, _ in row for v in (x, y, 0.0 * x)]
        lines.append("\t".join([str(k), f"{(k + first) / rate}", *cells]))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_sports2d_in_pixels(tmp_path):
    path, data = sports2d(tmp_path / "walk_Sports2D_px_person00.trc", points()), points()
    seen = read_keypoints(path, camera="c", rate=50.0)
    at = [KEYPOINT_SETS["HALPE_26"].index(name) for name in ("Hip", "RKnee", "LBigToe")]
    assert seen.keypoint_set == "HALPE_26"
    np.testing.assert_allclose(seen.points[:, 0, at], data[:, 0, :, :2])
    np.testing.assert_array_equal(seen.confidence[:, 0, at], np.isfinite(data[:, 0, :, 0]))
    later = read_keypoints(sports2d(path, data, first=7), camera="c", rate=50.0)
    np.testing.assert_allclose(later.points[7:], seen.points)
    assert not later.confidence[:7].any()
    assert find_markers([path], []) == [] and find_keypoints([path], [])[0][0].format == "sports2d"
    with pytest.raises(ObservationError, match="its points are pixels of an image.*sports2d"):
        read_markers(path)


def test_sports2d_in_metres_is_of_markers(tmp_path):
    path = sports2d(tmp_path / "walk_Sports2D_m_person00.trc", points() * [0.005, -0.005, 1.0])
    assert KEYPOINTS.name_of(path) is None and find_markers([path], []) == [path]
    assert read_markers(path).positions.shape == (5, 3, 3)
