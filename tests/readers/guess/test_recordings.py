"""Recordings of ROS 2 in a folder, and what of them a take file names."""

import numpy as np
import pytest
from benchmarks.scenes.bags import Bag

from kinefit.errors import FileError, TakeError
from kinefit.readers.guess.folder import guess_take
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations

pytest.importorskip("rosbags.rosbag2")
pytest.importorskip("mcap_ros2")

K, SIZE = np.array([[50.0, 0, 16], [0, 50.0, 12], [0, 0, 1]]), (32, 24)


def depth(bag, topic, **how):
    return bag.images(topic, "16UC1", [np.full(SIZE[::-1], 2000 + k, np.uint16) for k in range(5)], **how)


def colour(bag, topic):
    return bag.images(topic, "rgb8", [np.full((*SIZE[::-1], 3), 9 * k, np.uint8) for k in range(5)])


def two_sensors():
    """Depth and colour of two cameras whose places are known, and the depth once more as colour sees it."""
    bag, places = Bag(), []
    for k, side in enumerate(("front", "side")):
        depth(bag, f"/{side}/depth/image_raw").info(f"/{side}/depth/camera_info", K, SIZE, frame=f"{side}_d")
        colour(bag, f"/{side}/color/image_raw").info(f"/{side}/color/camera_info", K, SIZE, frame=f"{side}_c")
        place = np.eye(4)
        place[0, 3] = 0.5 * k
        places += [("map", f"{side}_d", place), ("map", f"{side}_c", place)]
    info = "/front/aligned_depth_to_color/camera_info"
    depth(bag, "/front/aligned_depth_to_color/image_raw").info(info, K, SIZE, frame="front_c")
    return bag.static(*places)


def guessed(folder):
    guess = guess_take(folder)
    (folder / "take.toml").write_text(guess.text)
    return guess, read_take(folder / "take.toml")


def test_topics_cameras_and_their_places_are_named(tmp_path):
    two_sensors().write(tmp_path / "bag")
    guess, take = guessed(tmp_path)
    assert [(d.name, d.topic) for d in take.depth] == [
        ("front_depth", "/front/depth/image_raw"), ("side_depth", "/side/depth/image_raw"),
    ]  # fmt: skip
    assert [(c.name, c.topic) for c in take.cameras] == [
        ("front_color", "/front/color/image_raw"), ("side_color", "/side/color/image_raw"),
    ]  # fmt: skip
    assert take.up == "z" and take.rate == 10.0 and take.calibration.file == tmp_path / "bag" / "bag.mcap"
    assert '# topic = "/front/aligned_depth_to_color/image_raw"' in guess.text
    assert '# format = "detect"' in guess.text
    seen = load_observations(take)
    assert len(seen.depth) == 2 and len(seen.depth[0]) == 5


def test_colour_alone_is_left_to_the_detector(tmp_path):
    colour(Bag(), "/cam/image_raw").info("/cam/camera_info", K, SIZE).write(tmp_path / "bag")
    guess, take = guessed(tmp_path)
    assert [(c.name, c.topic) for c in take.cameras] == [("cam", "/cam/image_raw")] and take.up == "-y"
    assert any("built-in detector" in note.text for note in guess.notes)


def test_depth_without_a_lens_asks_for_it(tmp_path):
    depth(Bag(), "/depth/image_raw").write(tmp_path / "bag")
    guess = guess_take(tmp_path)
    assert "# intrinsics = " in guess.text and any(note.sure == "open" for note in guess.notes)
    assert 'name = "depth"' in guess.text


def test_without_places_one_sensor_is_taken_and_the_others_are_comments(tmp_path):
    bag = Bag()
    for side in ("a", "b"):
        depth(bag, f"/{side}/image_raw").info(f"/{side}/camera_info", K, SIZE, frame=side)
    bag.write(tmp_path / "bag")
    guess, take = guessed(tmp_path)
    assert [d.name for d in take.depth] == ["a"] and '# topic = "/b/image_raw"' in guess.text
    assert any(note.about == "calibration" and "/tf_static" in note.text for note in guess.notes)


def test_the_largest_of_several_is_taken_and_others_are_told(tmp_path):
    depth(Bag(), "/depth/image_raw").info("/depth/camera_info", K, SIZE).write(tmp_path / "small")
    bag = depth(Bag(), "/depth/image_raw").info("/depth/camera_info", K, SIZE)
    colour(bag, "/other/image_raw").write(tmp_path / "large")
    guess, take = guessed(tmp_path)
    assert take.depth[0].file.is_relative_to(tmp_path / "large")
    assert any("small.mcap" in note.text and "not used" in note.text for note in guess.notes)


def test_recordings_that_are_not_read_say_so(tmp_path):
    bag = depth(Bag(), "/depth/image_raw")
    bag.write(tmp_path / "sqlite", plugin="SQLITE3")
    with pytest.raises(FileError, match="SQLite"):
        guess_take(tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    Bag().info("/depth/camera_info", K, SIZE).write(empty / "bag")
    with pytest.raises(TakeError, match="no topic of it has two images"):
        guess_take(empty)


def test_beside_markers_a_recording_is_only_told_of(tmp_path):
    from kinefit.exporters import write_trc
    from kinefit.simulation import cut, squat_and_wave

    write_trc(cut(squat_and_wave(), 0, 5), tmp_path / "walk.trc")
    depth(Bag(), "/depth/image_raw").write(tmp_path / "bag")
    guess = guess_take(tmp_path)
    assert any(note.about == "recording" and "not used" in note.text for note in guess.notes)
    assert "[[depth]]" not in guess.text
