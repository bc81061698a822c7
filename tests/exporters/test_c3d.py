"""C3D: frames that its header cannot count, and what is refused. Joint positions: test_options.py."""

from dataclasses import replace

import numpy as np
import pytest
from tests.exporters.synthetic import smooth_motion

from kinefit.bodies import PointSet, load_body
from kinefit.bodies.motion import Motion
from kinefit.errors import ExportError
from kinefit.exporters import write_c3d
from kinefit.readers.markers import read_markers


@pytest.mark.parametrize("up", ["y", "z"])
def test_our_own_reader_gets_all_of_it(tmp_path, up):
    motion = smooth_motion(9, up=up)
    write_c3d(motion, tmp_path / "a.c3d", unit="cm")
    read = read_markers(tmp_path / "a.c3d")
    expected = [*motion.body.joints, *motion.body.landmarks.names]
    assert expected.count("neck") == 2  # a joint and a landmark
    assert list(read.names) == expected[:31] + ["neck_2"] + expected[32:]
    truth = np.concatenate([motion.segment_poses()[..., :3, 3], motion.positions()], axis=1)
    assert np.abs(read.positions - truth).max() < 1e-6
    assert (read.up, read.rate, read.first_frame) == (up, motion.rate, 121)


def test_angles_are_points_that_the_file_names_as_such(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    motion = smooth_motion(9)
    std = np.full_like(motion.dof_std, 0.1)
    names = list(motion.body.tree.coordinates)
    columns = [6 + names.index(f"hip_{what}_l") for what in ("flexion", "adduction", "rotation")]
    std[4, columns] = np.inf
    motion = replace(motion, dof_std=std)
    write_c3d(motion, tmp_path / "a.c3d")
    read = ezc3d.c3d(str(tmp_path / "a.c3d"))
    point = read["parameters"]["POINT"]
    names = list(point["ANGLES"]["value"])
    assert {"LHipAngles", "RKneeAngles", "PelvisAngles", "BackAngles"} <= set(names)
    assert point["ANGLE_UNITS"]["value"] == ["deg"]
    labels = list(point["LABELS"]["value"])
    found = read["data"]["points"][:3, labels.index("LHipAngles")].T
    truth = np.degrees(motion.angles[:, np.array(columns) - 6])
    seen = np.arange(9) != 4
    assert np.abs(found[seen] - truth[seen]).max() < 1e-3
    assert np.isnan(found[4]).all()
    assert not set(names) & set(read_markers(tmp_path / "a.c3d").names)


def long_motion(frames, landmarks=1):
    body = load_body("arm")
    points = PointSet(tuple(f"p{k}" for k in range(landmarks)), np.zeros(landmarks), np.zeros((landmarks, 3)))
    tree = body.tree
    S, D = len(tree.segments), len(tree.coordinates)
    roots = np.tile(np.eye(4), (frames, 1, 1))
    roots[:, 0, 3] = 1e-5 * np.arange(frames)
    return Motion(
        body=replace(body, landmarks=points), rate=100.0, times=np.arange(frames) / 100, Ts_world_root=roots,
        angles=np.zeros((frames, D)), dof_std=np.zeros((frames, 6 + D)), joint_std=np.zeros((frames, S, 3)),
        quality=np.ones(frames), segment_quality=np.ones((frames, S)),
    )  # fmt: skip


def test_more_frames_than_its_header_counts(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    motion = long_motion(66000)
    write_c3d(motion, tmp_path / "a.c3d")
    assert len(read_markers(tmp_path / "a.c3d").positions) == 66000
    read = ezc3d.c3d(str(tmp_path / "a.c3d"))["data"]["points"]
    assert read.shape == (4, 8, 66000)
    assert np.abs(read[0, 0] / 1000 - motion.segment_poses()[:, 0, 0, 3]).max() < 1e-6


def test_more_points_than_one_list_of_labels_holds(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    write_c3d(long_motion(3, landmarks=400), tmp_path / "a.c3d")
    names = read_markers(tmp_path / "a.c3d").names
    assert len(names) == 404 and names[-1] == "p399" and names[300] == "p296"
    assert ezc3d.c3d(str(tmp_path / "a.c3d"))["data"]["points"].shape == (4, 407, 3)  # with those of angles


def test_what_it_cannot_hold_is_refused(tmp_path):
    with pytest.raises(ExportError, match="0 frames"):
        write_c3d(smooth_motion(0), tmp_path / "a.c3d")
    early = smooth_motion(3)
    with pytest.raises(ExportError, match="from frame -"):
        write_c3d(replace(early, times=early.times - 9), tmp_path / "a.c3d")
    assert not list(tmp_path.iterdir())
