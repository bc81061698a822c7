"""NWB: read back by h5py and checked by pynwb; confidence follows the error bars."""

import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi
from tests.exporters.synthetic import smooth_motion

from kinefit.errors import ExportError
from kinefit.exporters import write_nwb
from kinefit.exporters.interchange import CONFIDENCE_RADIUS_M, confidence
from kinefit.geometry.force_plates import ForcePlate


def quiet(do):
    """Of packages that warn about each other."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return do()


pynwb = quiet(lambda: pytest.importorskip("pynwb"))
quiet(lambda: pytest.importorskip("ndx_pose"))


@pytest.fixture(scope="module")
def motion():
    made = smooth_motion(15, up="z")
    std = np.array(made.joint_std)
    std[3, 2] = np.inf
    return replace(made, joint_std=std, provenance={"session": {"subject": "s01", "date": "2026-03-02"}})


def test_h5py_finds_the_joint_centres_with_their_confidence(motion, tmp_path):
    h5py = pytest.importorskip("h5py")
    write_nwb(motion, tmp_path / "a.nwb")
    with h5py.File(tmp_path / "a.nwb") as file:
        pose = file["processing/behavior/PoseEstimation"]
        for s, joint in enumerate(motion.body.joints):
            series = pose[joint]
            assert np.abs(series["data"][:] - motion.joint_centres[:, s]).max() < 1e-5
            assert np.abs(series["timestamps"][:] - motion.times).max() < 1e-9
            assert series["data"].attrs["unit"] == "meters"
            assert np.allclose(series["confidence"][:], confidence(motion.joint_std[:, s]))
        behavior = file["processing/behavior"]
        assert behavior["PoseEstimation"][motion.body.joints[2]]["confidence"][3] == 0.0
        assert np.array_equal(behavior["angles/data"][:], motion.angles)
        assert np.array_equal(behavior["angles_std/data"][:], motion.dof_std[:, 6:])
        assert np.array_equal(behavior["joint_std/data"][:], motion.joint_std)
        assert file["session_start_time"][()].decode().startswith("2026-03-02")


def test_pynwb_has_nothing_to_say(motion, tmp_path):
    write_nwb(motion, tmp_path / "a.nwb", up="y", names="hanim")
    assert not quiet(lambda: list(pynwb.validate(path=str(tmp_path / "a.nwb"))))

    def read():
        with pynwb.NWBHDF5IO(str(tmp_path / "a.nwb"), "r", load_namespaces=True) as opened:
            file = opened.read()
            pose = file.processing["behavior"]["PoseEstimation"]
            hip = pose.pose_estimation_series["r_hip"].data[:]
            return hip, pose.skeleton.nodes[:], pose.skeleton.edges[:], file.subject.subject_id

    hip, nodes, edges, subject = quiet(read)
    s = motion.body.tree.segments.index("thigh_r")
    assert np.abs(hip - motion.turned("y").joint_centres[:, s]).max() < 1e-5 and subject == "s01"
    assert nodes[s] == "r_hip" and len(edges) == len(nodes) - 1
    assert edges[s - 1].tolist() == [motion.body.tree.parents[s], s]


def test_names_that_nwb_does_not_allow_become_plain(motion, tmp_path):
    h5py = pytest.importorskip("h5py")
    write_nwb(motion, tmp_path / "a.nwb", names="mixamo")
    with h5py.File(tmp_path / "a.nwb") as file:
        assert "mixamorig_Hips" in file["processing/behavior/PoseEstimation"]


def test_confidence_is_the_probability_of_being_near():
    for sigma in (0.001, 0.008, 0.02, 0.3):
        assert np.isclose(confidence(np.full(3, sigma)), chi(3).cdf(CONFIDENCE_RADIUS_M / sigma), atol=1e-12)
    assert confidence(np.zeros(3)) == 1.0
    assert confidence(np.array([0.001, np.inf, 0.001])) == 0.0
    assert confidence(np.array([0.01, 0.01, 0.03])) < confidence(np.full(3, 0.01))


def test_a_recording_without_a_date_says_so(motion, tmp_path):
    h5py = pytest.importorskip("h5py")
    write_nwb(replace(motion, provenance={}), tmp_path / "a.nwb")
    with h5py.File(tmp_path / "a.nwb") as file:
        assert "date of the recording is not known" in file["session_description"][()].decode()


def test_what_cannot_be_written_is_told(motion, tmp_path, monkeypatch):
    with pytest.raises(ExportError, match="convention of names"):
        write_nwb(motion, tmp_path / "a.nwb", names="nobody")
    monkeypatch.setitem(sys.modules, "pynwb", None)
    with pytest.raises(ExportError, match=r"kinefit\[nwb\]"):
        write_nwb(motion, tmp_path / "a.nwb")
    assert not list(tmp_path.iterdir())


def test_force_plates_are_acquisition(motion, tmp_path):
    corners = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    force = np.tile([10.0, -5.0, 600.0], (40, 1))
    force[:8] = 0.0
    plate = ForcePlate("plate 1", corners, 1000.0, 0.25, force, np.tile([60.0, -30.0, 2.0], (40, 1)))
    write_nwb(replace(motion, plates=(plate,)), tmp_path / "a.nwb", up="y")
    turned = replace(motion, plates=(plate,)).turned("y").plates[0]
    wanted = {"force": (turned.force, "newtons"), "moment": (turned.moment, "newton meters"),
              "centre_of_pressure": (turned.centre_of_pressure(), "meters")}  # fmt: skip

    def read():
        with pynwb.NWBHDF5IO(str(tmp_path / "a.nwb"), "r", load_namespaces=True) as opened:
            acquired = opened.read().acquisition
            assert set(acquired) == {f"plate_1_{what}" for what in wanted}
            for what, (values, unit) in wanted.items():
                series = acquired[f"plate_1_{what}"]
                np.testing.assert_array_equal(series.data[:], values)
                assert (series.unit, series.rate, series.starting_time) == (unit, 1000.0, 0.25)
                assert "y up" in series.description

    quiet(read)
    assert np.isnan(wanted["centre_of_pressure"][0][:8]).all() and not quiet(
        lambda: list(pynwb.validate(path=str(tmp_path / "a.nwb")))
    )
