"""A subject that is no human: a six-axis arm with a body file and a marker set of its own, by the commands (P5)."""

import pytest
from benchmarks.markers_robot import learn, make_robot, single_frames, whole_take

from kinefit.markers.model.model import load_model


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    robot = make_robot(folder)
    return robot, learn(robot, folder, 3), folder


def test_a_model_of_one_frame_names_random_poses(robot):
    robot, model, _ = robot
    assert len(robot.labels) == 30 and len(load_model(model).segments) == 7
    right, wrong, _ = single_frames(robot, model, 3, 3)
    assert right > 97.0 and wrong < 1.0


def test_its_take_is_named_and_tracked_by_the_commands(robot):
    robot, model, folder = robot
    found = whole_take(robot, model, folder, 60, 3)
    assert found["named"] > 99.0 and found["wrong"] < 0.1
    assert found["angles"] < 0.5 and found["tool"] < 1.0
