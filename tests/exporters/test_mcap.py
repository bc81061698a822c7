"""MCAP: read back by rosbags, which shares no code with what writes it."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.exporters.synthetic import smooth_motion

from kinefit.errors import ExportError
from kinefit.exporters import write_mcap

pytest.importorskip("mcap_ros2")
highlevel = pytest.importorskip("rosbags.highlevel")


@pytest.fixture(scope="module")
def motion():
    return smooth_motion(12, up="y")


def messages(path):
    """{topic: [(stamp [ns], message)]}"""
    found = {}
    with highlevel.AnyReader([path]) as reader:
        for connection, stamp, raw in reader.messages():
            found.setdefault(connection.topic, []).append((stamp, reader.deserialize(raw, connection.msgtype)))
    return found


def positions(transforms):
    """{frame: (3,)} of the origins in the world, from transforms in their parents."""
    placed = {"world": (np.zeros(3), Rotation.identity())}
    for one in transforms:
        move = one.transform
        t = [getattr(move.translation, axis) for axis in "xyz"]
        r = [getattr(move.rotation, axis) for axis in "xyzw"]
        place, turn = placed[one.header.frame_id]
        placed[one.child_frame_id] = place + turn.apply(t), turn * Rotation.from_quat(r)
    return {name: place for name, (place, _) in placed.items()}


@pytest.mark.parametrize("up", ["z", "y"])
def test_rosbags_finds_every_joint(motion, tmp_path, up):
    write_mcap(motion, tmp_path / "a.mcap", up=up)
    found = messages(tmp_path / "a.mcap")
    assert set(found) == {"/tf", "/joint_states", "/joint_std"}
    truth = motion.turned(up).joint_centres
    for f, (stamp, message) in enumerate(found["/tf"]):
        assert stamp == round(motion.times[f] * 1e9)
        header = message.transforms[0].header.stamp
        assert header.sec * 10**9 + header.nanosec == stamp
        places = positions(message.transforms)
        for s, name in enumerate(motion.body.tree.segments):
            assert np.abs(places[name] - truth[f, s]).max() < 1e-5
    assert len(found["/tf"]) == len(motion)


def test_coordinates_and_their_standard_deviations(motion, tmp_path):
    write_mcap(motion, tmp_path / "a.mcap")
    found = messages(tmp_path / "a.mcap")
    for topic, truth in (("/joint_states", motion.angles), ("/joint_std", motion.dof_std[:, 6:])):
        assert np.array_equal([message.position for _, message in found[topic]], truth)
        assert found[topic][0][1].name == list(motion.body.tree.coordinates)
    assert np.isinf([message.position for _, message in found["/joint_std"]]).any()


def test_what_cannot_be_written_is_told(motion, tmp_path, monkeypatch):
    with pytest.raises(ExportError, match="begins before 0 s"):
        write_mcap(replace(motion, times=motion.times - 10.0), tmp_path / "a.mcap")
    with pytest.raises(ExportError, match="vertical axis"):
        write_mcap(motion, tmp_path / "a.mcap", up="w")
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    with pytest.raises(ExportError, match=r"kinefit\[ros\]"):
        write_mcap(motion, tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())
