"""Recordings that users reported, and depth alone, through the commands that a user calls."""

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from kinefit import read_motion
from kinefit.cli import main
from kinefit.errors import FileError
from kinefit.readers.markers import read_markers

QUIET = ("--no-overlays", "--no-report", "--formats", "motion", "--realtime")


def run(*words):
    done = CliRunner().invoke(main, [str(word) for word in words])
    return done.exit_code, " ".join(done.output.split())


@pytest.mark.parametrize(
    ("case", "words"),
    [("c3d-contradicting-rate", "60 Hz.*100 Hz"), ("c3d-contradicting-scale", "-0.1.*0.1 .*floats")],
)
def test_a_c3d_that_contradicts_itself_is_refused(data_dir, case, words):
    with pytest.raises(FileError, match=words):
        read_markers(data_dir("cases_of_users") / case / "take.c3d")


@pytest.mark.parametrize(
    ("case", "told"),
    [("markers-mirrored-world", "mirrored (left-handed)"),
     ("markers-sides-exchanged-whole-body", "labels are exchanged")],
)  # fmt: skip
def test_wrong_sides_are_refused(data_dir, tmp_path, case, told):
    file = data_dir("cases_of_users") / case / "walk.trc"
    status, text = run("markers", "fit", file, "--formats", "mot", "-o", tmp_path)
    assert status == 2 and told in text and not any(tmp_path.iterdir())


def test_exchanged_sides_that_are_stated_are_tracked(data_dir, tmp_path):
    file = data_dir("cases_of_users") / "markers-sides-exchanged-whole-body" / "walk.trc"
    head = f'[take]\nup = "y"\nframes = [0, 30]\n[[markers]]\nfile = "{file.as_posix()}"\n'
    (tmp_path / "take.toml").write_text(head)
    status, text = run("track", tmp_path / "take.toml", *QUIET, "-o", tmp_path / "out")
    assert status == 2 and "labels are exchanged" in text and "walk.trc" in text
    (tmp_path / "take.toml").write_text(f'{head}sides = "exchanged"\n')
    assert run("track", tmp_path / "take.toml", *QUIET, "-o", tmp_path / "out")[0] == 0


def test_keypoints_without_a_set_give_a_person_of_usual_height(data_dir, tmp_path):
    take = data_dir("cases_of_users") / "openpose-body25-without-set" / "take.toml"
    status, text = run("track", take, *QUIET, "--out", tmp_path)
    assert status == 0 and "fault" not in text
    assert 1.6 < read_motion(tmp_path / "motion.npz").body.stature < 1.9


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 4])
def test_images_of_a_kinect_alone_are_a_take(data_dir, tmp_path, count):
    (tmp_path / "kinect").mkdir()
    for k, file in enumerate(sorted(data_dir("depth_skeltrack_kinect1").glob("depth-data-10*"))[:count]):
        cv2.imwrite(str(tmp_path / "kinect" / f"{k:04d}.png"), np.fromfile(file, "<u2").reshape(480, 640))
    for words in (("init", tmp_path), ("check", tmp_path), ("track", tmp_path, *QUIET)):
        status, text = run(*words)
        assert status == 0, text
    motion = read_motion(tmp_path / "take-kinefit")
    assert len(motion) == count and motion.quality.max() > 0.25
