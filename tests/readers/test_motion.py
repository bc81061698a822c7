"""The motion file gives back exactly what was written, and says what is wrong with any other file."""

from dataclasses import fields, replace

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import KinematicTree, catalogue, load_body
from kinefit.bodies.lasting_errors import LastingErrors, ParameterErrors
from kinefit.bodies.motion import ARRAYS, Residuals
from kinefit.bodies.serial import body_from_arrays, body_to_arrays
from kinefit.errors import BodyError, ExportError, FileError
from kinefit.exporters import write_motion
from kinefit.geometry.force_plates import ForcePlate
from kinefit.readers.motion import read_motion


def assert_same_arrays(a, b):
    assert list(a) == list(b)
    for key in a:
        np.testing.assert_array_equal(a[key], b[key], err_msg=key, strict=True)


def rewritten(path, **changes):
    """The motion file with arrays changed, or (None) left out."""
    with np.load(path) as archive:
        arrays = {key: archive[key] for key in archive.files}
    arrays |= changes
    np.savez(path, **{key: array for key, array in arrays.items() if array is not None})


@pytest.fixture
def written(tmp_path):
    motion = replace(smooth_motion(15, up="-z"), provenance={"track": {"accuracy": [8.0], "smooth": True}})
    factors = np.random.default_rng(0).standard_normal((2, 4, motion.dof_std.shape[1], 3)).astype(np.float16)
    square = np.random.default_rng(1).standard_normal((2, 2, 2))
    known = ParameterErrors(("thigh", "cam0 tx 1a2b"), np.array([1.0, 0.01]), *square, square[0].repeat(2, axis=0)[:3])
    wrench = np.random.default_rng(2).standard_normal((2, 30, 3))
    plate = ForcePlate("plate 1/a", np.array([[1.0, 1, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0]]), 1000.0, 0.25, *wrench)
    motion = replace(motion, lasting=LastingErrors(np.array([0, 5, 10, 14]), *factors, 0.3, known), plates=(plate,))
    write_motion(motion, tmp_path / "a.npz")
    return motion, tmp_path / "a.npz"


def test_everything_comes_back_exactly(written):
    motion, path = written
    back = read_motion(path)
    assert len(fields(motion)) == len(ARRAYS) + 9  # whoever adds one to a motion adds it to its file
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(back, name), getattr(motion, name), strict=True)
    assert (back.rate, back.up, back.name) == (motion.rate, motion.up, motion.name)
    assert back.provenance == motion.provenance
    for field in fields(ForcePlate):
        np.testing.assert_array_equal(getattr(back.plates[0], field.name), getattr(motion.plates[0], field.name))
    assert list(back.residuals) == list(motion.residuals) == ["cam 0", "cam 1", "markers/1"]
    for sensor, r in motion.residuals.items():
        for field in fields(Residuals):
            a, b = getattr(back.residuals[sensor], field.name), getattr(r, field.name)
            np.testing.assert_array_equal(a, b, err_msg=f"{sensor} {field.name}")
    for name in ("frames", "constant", "drift"):
        np.testing.assert_array_equal(getattr(back.lasting, name), getattr(motion.lasting, name), strict=True)
    assert back.lasting.drift_time == motion.lasting.drift_time
    assert back.lasting.parameters.names == motion.lasting.parameters.names
    for name in ("values", "covariance", "information", "directions"):
        a, b = (getattr(m.lasting.parameters, name) for m in (back, motion))
        np.testing.assert_array_equal(a, b, strict=True)
    assert_same_arrays(body_to_arrays(back.body), body_to_arrays(motion.body))
    np.testing.assert_array_equal(back.positions(), motion.positions())


@pytest.mark.parametrize("name", catalogue())
def test_bodies_come_back_exactly(name):
    body = load_body(name)
    back = body_from_arrays(body_to_arrays(body))
    assert_same_arrays(body_to_arrays(back), body_to_arrays(body))
    for field in fields(KinematicTree):  # also those that are added later
        one, other = getattr(back.tree, field.name), getattr(body.tree, field.name)
        np.testing.assert_array_equal(one, other, err_msg=field.name)
    assert {f.name for f in fields(body)} == {
        "name", "tree", "joints", "scale_groups", "segment_scale", "landmarks", "keypoint_sets", "marker_sets",
        "surfaces", "aliases", "stature", "mass", "morphs", "skin", "family", "closures", "dimensions",
    }  # fmt: skip
    assert back.closures == body.closures and back.dimensions == body.dimensions
    for one, other in zip(back.surfaces, body.surfaces, strict=True):
        assert type(one) is type(other)
        for field in fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), err_msg=field.name)
    assert back.aliases == dict(body.aliases)
    assert back.joints == body.joints and back.tree.root_free == body.tree.root_free
    assert (back.stature, back.mass) == (body.stature, body.mass)
    assert list(back.keypoint_sets) == list(body.keypoint_sets) and list(back.marker_sets) == list(body.marker_sets)
    state = body.rest_state()
    np.testing.assert_array_equal(back.positions(state, back.landmarks), body.positions(state, body.landmarks))


def test_a_motion_without_frames_or_residuals(tmp_path):
    motion = replace(smooth_motion(0), residuals={})
    write_motion(motion, tmp_path / "a.npz")
    assert len(read_motion(tmp_path / "a.npz")) == 0


def test_the_file_needs_nothing_but_numpy(written):
    _, path = written
    with np.load(path, allow_pickle=False) as archive:
        assert str(archive["format"]) == "kinefit motion" and int(archive["version"]) == 1
        assert all(archive[key].dtype != object for key in archive.files)
        assert "hip_flexion_r" in archive["body/coordinates"] and archive["residuals/markers%2F1/values"].shape[2] == 3


def test_other_files_are_told(tmp_path):
    text = tmp_path / "a.npz"
    text.write_text("no archive")
    other = tmp_path / "b.npz"
    np.savez(other, x=np.zeros(3))
    pickled = tmp_path / "c.npz"
    np.savez(pickled, format=np.array([{"a": 1}], dtype=object))
    for path, problem in (
        (text, "not a motion file"), (other, "not a motion file"), (pickled, "not of numbers"),
        (tmp_path / "d.npz", "no such"),
    ):  # fmt: skip
        with pytest.raises(FileError, match=problem) as caught:
            read_motion(path)
        assert caught.value.file == path and caught.value.remedy


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_told(written, share):
    _, path = written
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FileError):
        read_motion(path)


def test_a_damaged_file_is_told(written):
    _, path = written
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200] = bytes(200)
    path.write_bytes(data)
    with pytest.raises(FileError, match="damaged"):
        read_motion(path)


def test_a_later_version_is_told(written):
    _, path = written
    rewritten(path, version=np.array(2))
    with pytest.raises(FileError, match="version 2; this kinefit reads version 1"):
        read_motion(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"angles": None}, {"body/axes": None}, {"angles": np.zeros((15, 3))}, {"up": np.array("w")},
        {"angles": np.full((15, 41), np.nan)}, {"body/parents": np.zeros(20)}, {"body/owners": np.full(41, 77)},
        {"body/landmarks/segments": np.full(90, -1)}, {"residuals/cam%200/unit": np.array("feet")},
        {"residuals/cam%200/weights": np.zeros((15, 2))}, {"residuals/cam%200/segments": np.full(25, 20)},
        {"body/coordinates": np.array(["a"])}, {"rate": np.array("fast")},
    ],
)  # fmt: skip
def test_arrays_that_do_not_fit_are_told(written, changes):
    _, path = written
    rewritten(path, **changes)
    with pytest.raises(FileError) as caught:
        read_motion(path)
    assert caught.value.file == path and caught.value.remedy


def test_bodies_of_misfitting_arrays_are_told():
    arrays = body_to_arrays(load_body("humanoid"))
    with pytest.raises(BodyError, match="no array 'offsets'"):
        body_from_arrays({key: a for key, a in arrays.items() if key != "offsets"})
    with pytest.raises(BodyError, match="'axes' has shape"):
        body_from_arrays(arrays | {"axes": np.zeros((3, 3))})


def test_the_name_must_end_in_npz(tmp_path):
    with pytest.raises(ExportError, match=r"Call it a\.npz"):
        write_motion(smooth_motion(2), tmp_path / "a.dat")
    assert not list(tmp_path.iterdir())


def test_a_provenance_that_json_cannot_hold_is_refused_and_nothing_written(tmp_path):
    with pytest.raises(ExportError, match="provenance"):
        write_motion(replace(smooth_motion(3), provenance={"x": float("nan")}), tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())


def test_a_file_without_provenance_reads(written):
    _, path = written
    rewritten(path, provenance=None)
    assert read_motion(path).provenance == {}
