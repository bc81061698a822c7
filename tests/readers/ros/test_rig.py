"""Cameras of a recording: lenses of CameraInfo, places of /tf_static."""

import numpy as np
import pytest
from benchmarks.scenes.bags import Bag

from kinefit import read_calibration
from kinefit.errors import CalibrationError, FileError
from kinefit.geometry import se3
from kinefit.readers.ros.recordings import reading

pytest.importorskip("rosbags.rosbag2")
pytest.importorskip("mcap_ros2")

K = [[500.0, 0, 320], [0, 501.0, 240], [0, 0, 1]]
T_map_base = se3.exp(np.array([0.3, -0.2, 1.1, 0.1, 0.4, -0.2]))
T_base_optical = se3.exp(np.array([0.01, 0.05, -0.02, -1.2, 1.2, -1.2]))
T_map_side = se3.exp(np.array([-2.0, 1.0, 1.5, 0.3, -0.4, 0.9]))


def bag():
    out = Bag().info("/front/color/camera_info", K, (640, 480), lens=(0.1, -0.02, 0, 0, 0), frame="front_optical")
    out.info("/side/color/camera_info", K, (640, 480), frame="side_optical")
    return out.info("/front/depth/camera_info", K, (640, 480), frame="front_optical")


def test_names_lenses_and_places(tmp_path):
    moves = [("map", "base", T_map_base), ("base", "front_optical", T_base_optical)]
    moves += [("map", "side_optical", T_map_side)]
    rig = read_calibration(bag().static(*moves).write(tmp_path / "bag"))
    assert set(rig.names) == {"front_color", "side_color", "depth"}
    np.testing.assert_allclose(rig["front_color"].T_world_camera, T_map_base @ T_base_optical, atol=1e-12)
    np.testing.assert_allclose(rig["side_color"].T_world_camera, T_map_side, atol=1e-12)
    assert rig["front_color"].distortion[0] == 0.1 and not len(rig["side_color"].distortion)
    assert np.array_equal(rig["depth"].matrix, K) and rig["depth"].size == (640, 480)


def test_a_camera_alone_is_the_world(tmp_path):
    rig = read_calibration(Bag().info("/camera/camera_info", K, (640, 480)).write(tmp_path / "bag").parent)
    assert rig.names == ("camera",) and np.array_equal(rig["camera"].T_camera_world, np.eye(4))


def test_what_places_no_camera_is_told(tmp_path):
    file = bag().static(("map", "side_optical", T_map_side)).write(tmp_path / "a")
    with pytest.raises(CalibrationError, match="no transform in /tf_static between the frames front_optical"):
        read_calibration(file)
    with pytest.raises(CalibrationError, match="no topic of it has a CameraInfo"):
        read_calibration(Bag().static(("map", "base", T_map_base)).write(tmp_path / "b"))
    with pytest.raises(CalibrationError, match="not calibrated"):
        read_calibration(Bag().info("/c/camera_info", np.zeros((3, 3)), (640, 480)).write(tmp_path / "c"))


def test_a_message_without_a_field_is_damage(tmp_path):
    file = Bag().info("/camera/camera_info", K, (640, 480)).write(tmp_path / "bag")
    whole = file.read_bytes()
    assert b"uint32 binning_x" in whole
    file.write_bytes(whole.replace(b"uint32 binning_x", b"uint32 binning_q"))
    with pytest.raises(FileError, match="binning_x"):
        read_calibration(file)


def test_no_more_is_asked_of_a_file_than_there_is(tmp_path):
    file = Bag().info("/camera/camera_info", K, (640, 480)).write(tmp_path / "bag")
    with reading(file) as reader:
        stream = reader._stream
        stream.seek(0)
        assert stream.read(2**50) == file.read_bytes()  # which would be room for all of it first
