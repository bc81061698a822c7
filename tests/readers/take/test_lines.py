"""Lines of known objects in a take: read with their camera, and every wrong row named."""

import json

import numpy as np
import pytest

from kinefit.errors import FileError, KinefitError, ObservationError, TakeError
from kinefit.readers.take.file import read_take
from kinefit.readers.take.load import load_observations
from kinefit.sensors.kinds.lines import read_lines

CALIBRATION = """[cam]
name = "cam"
size = [64.0, 48.0]
matrix = [[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 3.0]
fisheye = false
"""
TABLE = "frame,line,u1,v1,u2,v2\n0,hips,1,2,30,4\n0,back,5,6,7,40\n3,hips,2,2,31,4\n"
LANDMARKS = '{ hips = ["r_asis", "l_asis"], back = ["cervicale"] }'
LINES = f'[[lines]]\ncamera = "cam"\nfile = "lines.csv"\nlandmarks = {LANDMARKS}\n'


def load(folder, lines=LINES, table=TABLE, camera="", head="rate = 30"):
    (folder / "calibration.toml").write_text(CALIBRATION)
    (folder / "lines.csv").write_text(table)
    (folder / "take.toml").write_text(
        f'[take]\n{head}\n[calibration]\nfile = "calibration.toml"\n[[camera]]\nname = "cam"\n{camera}\n{lines}'
    )
    return load_observations(read_take(folder / "take.toml"))


def test_lines_of_a_table(tmp_path):
    seen = load(tmp_path, LINES + "sigma = 1.5\n", camera="time_offset = 0.1")
    (video,) = seen.of_kind("lines")
    assert (seen.rate, seen.frames, video.sensor, video.names) == (30.0, (3, 7), "cam", ("hips", "back"))
    np.testing.assert_allclose(video.times, [0.1, 0.2])
    frame = video.frame(0)
    assert frame.landmarks == (("r_asis", "l_asis"), ("cervicale",))
    np.testing.assert_array_equal(frame.ends, [[[1, 2], [30, 4]], [[5, 6], [7, 40]]])
    assert np.isnan(video.frame(-1).ends[1]).all()
    assert [video.at_step(s, seen.rate) for s in range(3, 7)] == [0, None, None, 1]
    assert seen.recordings == (video,)


def test_the_same_as_json_and_in_the_videos_picture(tmp_path):
    rows = [{"frame": 0, "line": "hips", "u1": 10, "v1": 20, "u2": 30, "v2": 40}]
    (tmp_path / "lines.json").write_text(json.dumps(rows))
    lines = LINES.replace(".csv", ".json") + 'frame = "video"\n'
    (video,) = load(tmp_path, lines, camera='size = [128, 96]\nimage = "scaled"').of_kind("lines")
    np.testing.assert_allclose(video.frame(0).ends[0], [[4.75, 9.75], [14.75, 19.75]])
    with pytest.raises(TakeError, match="not stated which the lines use"):
        load(tmp_path, LINES, camera='size = [128, 96]\nimage = "scaled"')


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (LINES.replace('"cam"', '"cam9"'), "no camera 'cam9'"),
        (LINES.replace('["cervicale"]', '["a", "b", "c"]'), "line 'back' has 3 landmarks"),
        (LINES.replace(LANDMARKS, "{}"), "no landmarks"),
        (LINES + "sigma = 0\n", "sigma = 0. Give a positive"),
        (LINES + "accuracy = 1\n", "no key 'accuracy'"),
    ],
)
def test_wrong_entries(tmp_path, lines, message):
    with pytest.raises(TakeError, match=message):
        load(tmp_path, lines)


@pytest.mark.parametrize(
    ("table", "kind", "message", "place"),
    [
        (TABLE.replace("hips", "hip", 1), ObservationError, "no line 'hip'", "line 2"),
        (TABLE.replace("5,6,7", "5,six,7"), FileError, "six", "line 3"),
        (TABLE.replace("3,hips", "0,hips"), FileError, "twice", "line 4"),
        (TABLE.replace("frame", "f", 1), FileError, "frame", "line 2"),
        (TABLE.replace("5,6,7", "5,nan,7"), FileError, "finite", "line 3"),
        (TABLE[:23], ObservationError, "no lines", None),
    ],
)
def test_wrong_tables(tmp_path, table, kind, message, place):
    (tmp_path / "l.csv").write_text(table)
    with pytest.raises(kind, match=message) as caught:
        read_lines(tmp_path / "l.csv", ("hips", "back"))
    assert caught.value.place == place


def test_no_list_of_objects_no_file_and_another_time(tmp_path):
    (tmp_path / "l.json").write_text("{}")
    with pytest.raises(FileError, match="not a list of objects"):
        read_lines(tmp_path / "l.json", ("a",))
    with pytest.raises(FileError, match="cannot read"):
        read_lines(tmp_path / "none.csv", ("a",))
    with pytest.raises(KinefitError, match="its frames are from 0 to 0.1 s"):
        load(tmp_path, head="rate = 30\nframes = [10, 20]")
    with pytest.raises(TakeError, match="the rate is not stated"):
        load(tmp_path, head="")
