"""A take of a ROS 2 recording: tracked by the command as the same images in files are."""

import cv2
import numpy as np
import pytest
from benchmarks.scenes.bags import Bag
from click.testing import CliRunner

from kinefit import read_motion
from kinefit.cli import main
from kinefit.errors import FileError, ObservationError, TakeError
from kinefit.geometry.camera import Rig
from kinefit.readers.calibration.read import write_calibration
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.simulation import TOF, cut, in_front, simulate_depth, squat_and_wave

pytest.importorskip("rosbags.rosbag2")
pytest.importorskip("mcap_ros2")

TAKE = '[take]\nrate = 10.0\nup = "z"\nstart = "start.npz"\n'


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A folder with the same depth images as files and as topics of a recording, and a start."""
    from kinefit.exporters import write_motion

    folder = tmp_path_factory.mktemp("ros")
    motion = cut(squat_and_wave(rate=10.0), 0, 4)
    camera = in_front(motion, TOF.camera(), near=TOF.near, far=TOF.far)
    video = simulate_depth(motion, camera, TOF, seed=1)
    counts = [np.rint(1000 * video.frame(i).depth).astype(np.uint16) for i in range(len(motion))]
    (folder / "depth").mkdir()
    for i, image in enumerate(counts):
        cv2.imwrite(str(folder / "depth" / f"{i}.png"), image)
    write_calibration(Rig((camera,)), folder / "calibration.toml")
    write_motion(cut(motion, 0, 1), folder / "start.npz")
    grey = [np.full((6, 8), 9, np.uint8)] * 4
    bag = Bag().images("/front/depth/image_raw", "16UC1", counts).images("/front/color", "mono8", grey)
    bag.info("/front/depth/camera_info", camera.matrix, camera.size, frame="front_optical")
    bag.static(("map", "front_optical", camera.T_world_camera)).write(folder / "bag")
    return folder, camera.name


def tracked(path, out):
    told = CliRunner().invoke(main, ["track", str(path), "--out", str(out), "--no-overlays", "--formats", "motion"])
    assert told.exit_code == 0, told.output
    return read_motion(out / "motion.npz")


def test_the_result_is_that_of_the_same_images_in_files(seen, tmp_path):
    folder, name = seen
    files = f'[calibration]\nfile = "calibration.toml"\n[[depth]]\nname = "tof"\ncamera = "{name}"\nfile = "depth"\n'
    (folder / "files.toml").write_text(TAKE + files)
    (folder / "ros.toml").write_text(
        TAKE + '[calibration]\nfile = "bag/bag.mcap"\n[[depth]]\nname = "tof"\ncamera = "depth"\n'
        'file = "bag/bag.mcap"\ntopic = "/front/depth/image_raw"\n'
    )
    a, b = tracked(folder / "files.toml", tmp_path / "a"), tracked(folder / "ros.toml", tmp_path / "b")
    assert len(a) == len(b) == 4
    np.testing.assert_allclose(b.angles, a.angles, atol=1e-6)
    np.testing.assert_allclose(b.positions(), a.positions(), atol=1e-6)


def test_a_folder_with_a_recording_becomes_a_take_that_tracks(seen, tmp_path):
    folder, _ = seen
    told = CliRunner().invoke(main, ["init", str(folder / "bag"), "--out", str(tmp_path / "take.toml")])
    assert told.exit_code == 0, told.output
    assert "/front/depth/image_raw, 4 images, 10 Hz" in told.output
    take = read_take(tmp_path / "take.toml")
    assert [(d.name, d.topic) for d in take.depth] == [("depth", "/front/depth/image_raw")] and take.rate == 10.0
    text = (tmp_path / "take.toml").read_text().replace("[take]", f'[take]\nstart = "{folder / "start.npz"}"', 1)
    (tmp_path / "take.toml").write_text(text.replace('up = "-y"', 'up = "z"'))
    assert len(tracked(tmp_path / "take.toml", tmp_path / "out")) == 4


@pytest.mark.parametrize(("lines", "error", "told"), [
    ('file = "bag/bag.mcap"\ntopic = "/side/depth"', ObservationError, "no topic /side/depth; .*: /front/depth"),
    ('file = "bag/bag.mcap"\ntopic = "/front/color"', ObservationError, "/front/color has images of mono8, no depth"),
    ('file = "depth"\ntopic = "/front/depth"', TakeError, "'topic' has no use with depth"),
    ('file = "bag/other.mcap"\ntopic = "/front/depth"', FileError, "no such file"),
    ('file = "bag/bag.mcap"\ntopic = "/"', TakeError, "without a name"),
])  # fmt: skip
def test_topics_that_are_not_there_are_told(seen, lines, error, told):
    folder, _ = seen
    (folder / "odd.toml").write_text(f'[take]\nrate = 10.0\n[[depth]]\nname = "tof"\n{lines}\n')
    with pytest.raises(error, match=told):
        load_observations(read_take(folder / "odd.toml"))


def test_a_missing_extra_names_its_command(seen, monkeypatch):
    folder, _ = seen
    monkeypatch.setitem(__import__("sys").modules, "mcap.reader", None)
    (folder / "extra.toml").write_text('[[depth]]\nname = "tof"\nfile = "bag/bag.mcap"\n')
    with pytest.raises(FileError, match=r"pip install 'kinefit\[ros\]'"):
        load_observations(read_take(folder / "extra.toml"))
