"""Cameras are found along with the person, unless the take says that their calibration is exact."""

import numpy as np
import pytest

from kinefit import read_take, track_take
from kinefit.errors import TakeError
from kinefit.geometry import se3
from kinefit.readers.take.load import load_observations
from kinefit.simulation import write_synthetic_take
from kinefit.tracking.cameras import as_found, sentences


@pytest.fixture(scope="module")
def take(tmp_path_factory):
    return write_synthetic_take(tmp_path_factory.mktemp("cameras"))


def stating(take, text):
    path = take.with_name("stated.toml")
    told = take.read_text("utf-8").replace("[calibration]", f"frames = [0, 12]\n[calibration]\n{text}", 1)
    path.write_text(told, "utf-8")
    return path


def test_cameras_move_no_farther_than_their_calibration_is_unsure_and_overlays_follow(take):
    path = stating(take, "")
    calibrated = load_observations(read_take(path)).rig
    motion, seen = track_take(path)
    cameras = motion.provenance["cameras"]
    assert set(cameras) == set(calibrated.names)
    prior = np.repeat((0.003, np.radians(0.1)), 3)
    for name, told in cameras.items():
        assert np.all(np.abs(told["moved"]) < 3.0 * prior) and np.all(np.array(told["std"]) < 1.01 * prior)
        between = seen.rig[name].T_camera_world @ np.linalg.inv(calibrated[name].T_camera_world)
        np.testing.assert_allclose(se3.log(between), told["moved"], atol=1e-9)
    assert as_found(seen.rig, {}).cameras == seen.rig.cameras


def test_an_exact_calibration_stays_and_leaves_smaller_bars(take):
    free, _ = track_take(stating(take, "position_sigma = 0.01\nrotation_sigma = 0.3"), smooth=False)
    path = stating(take, "position_sigma = 0\nrotation_sigma = 0")
    exact, seen = track_take(path, smooth=False)
    assert "cameras" not in exact.provenance
    calibrated = load_observations(read_take(path)).rig
    assert all(np.array_equal(a.T_camera_world, b.T_camera_world) for a, b in zip(seen.rig, calibrated))
    root = [np.median(m.joint_std[:, 0]) for m in (exact, free)]
    assert root[0] < root[1]


def test_a_camera_that_is_farther_off_than_it_can_be_is_named():
    told = {"cameras": {"a": {"moved": [0.004, 0, 0, 0, 0.006, 0]}, "b": {"moved": [0.0, 0.004, 0, 0, 0.001, 0]}}}
    (sentence,) = sentences(told, (0.003, 0.00175))
    assert sentence.startswith("camera a was found 4 mm and 0.34 degrees from its calibration")
    assert not sentences(told, None) and not sentences({}, (0.003, 0.00175))


@pytest.mark.parametrize(
    "text",
    [
        "position_sigma = 0.003", "rotation_sigma = 0.1", "position_sigma = -0.1\nrotation_sigma = 0.1",
        "position_sigma = 0\nrotation_sigma = 0.1", "position_sigma = 2.0\nrotation_sigma = 0.1",
        "position_sigma = nan\nrotation_sigma = 0.1",
    ],
)  # fmt: skip
def test_sigmas_that_cannot_be_are_told(take, text):
    with pytest.raises(TakeError, match=r"\[calibration\].*position_sigma"):
        read_take(stating(take, text))
