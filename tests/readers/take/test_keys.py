"""Every key of a take file is explained, old ones are read and named, keys without a use are refused."""

import re
from pathlib import Path

import numpy as np
import pytest

from kinefit.errors import TakeError
from kinefit.exporters.c3d_file import write_markers
from kinefit.observations import Markers
from kinefit.readers.take.entries import RENAMED, TABLES, Take, keys_of
from kinefit.readers.take.file import read_take
from kinefit.readers.take.kinds import BUILT_IN
from kinefit.readers.take.load import load_observations

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "take-file.md").read_text("utf-8")
TABLES = [*TABLES, *BUILT_IN]
KEYS = [(table, key) for table in TABLES for key in keys_of(table)]


def section(table):
    """What the page says of a table: from its headline to the next."""
    found = re.search(rf"^## `\[+{table}\]+`\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL)
    assert found, f"docs/take-file.md has no section of [{table}]"
    return found[1]


@pytest.mark.parametrize(("table", "key"), KEYS)
def test_the_page_explains_every_key(table, key):
    cells = [line.split("|")[1] for line in section(table).splitlines() if line.startswith("| `")]
    assert any(f"`{key}`" in cell for cell in cells), f"docs/take-file.md: [{table}] {key}"


@pytest.mark.parametrize("table", TABLES)
def test_the_page_explains_no_key_that_is_none(table):
    cells = [line.split("|")[1] for line in section(table).splitlines() if line.startswith("| `")]
    told = {key for cell in cells for key in re.findall(r"`(\w+)`", cell)}
    assert told == set(keys_of(table))


def test_old_keys_have_new_ones_and_are_none_themselves():
    for table, names in RENAMED.items():
        fields = set(keys_of(table))
        assert set(names.values()) <= fields and not set(names) & fields


def take(folder, text, *, files=("m.trc",)):
    for name in files:
        (folder / name).write_text("")
    (folder / "take.toml").write_text(text)
    return read_take(folder / "take.toml")


def test_an_old_key_is_read_and_named(tmp_path):
    with pytest.warns(FutureWarning, match=r"\[\[markers\]\] 1: 'accuracy' is now called 'sigma'"):
        old = take(tmp_path, '[[markers]]\nfile = "m.trc"\naccuracy = 0.02\n')
    assert isinstance(old, Take) and old.markers[0].sigma == 0.02
    with pytest.raises(TakeError, match="one key"):
        take(tmp_path, '[[markers]]\nfile = "m.trc"\naccuracy = 0.02\nsigma = 0.02\n')
    with pytest.raises(TakeError, match="no key 'accurracy'"):
        take(tmp_path, '[[markers]]\nfile = "m.trc"\naccurracy = 0.02\n')


CAMERA = '[calibration]\nfile = "c"\n[[camera]]\nname = "a"\nvideo = "v"\n'


@pytest.mark.parametrize(
    ("entry", "key"),
    [
        ('[[keypoints]]\ncamera = "a"\nformat = "detect"\nrate = 30', "rate"),
        ('[[keypoints]]\ncamera = "a"\nformat = "detect"\nframe = "video"', "frame"),
        ('[[keypoints]]\ncamera = "a"\nfile = "v"\nface = [1, 2, 3, 4]', "face"),
        ('[[keypoints]]\ncamera = "a"\nformat = "skin"\nfile = "v"', "file"),
        ('[[keypoints]]\ncamera = "a"\nformat = "skin"\nexcluded = [[0, 3]]', "excluded"),
        ('[[keypoints]]\ncamera = "a"\nformat = "skin"\nswapped = [[0, 3]]', "swapped"),
        ('[[silhouette]]\ncamera = "a"\nfile = "v"\nsmooth = 2', "smooth"),
        ('[[silhouette]]\ncamera = "a"\nformat = "background"\nrate = 30', "rate"),
        ('[[silhouette]]\ncamera = "a"\nformat = "background"\nlow = [1, 1, 1]', "low"),
        ('[[silhouette]]\ncamera = "a"\nformat = "detect"\nframe = "video"', "frame"),
        ('[[silhouette]]\ncamera = "a"\nformat = "threshold"\nlow = [1, 1, 1]\nhigh = [2, 2, 2]\nfile = "v"', "file"),
    ],
)
def test_a_key_without_use_is_refused(tmp_path, entry, key):
    with pytest.raises(TakeError, match=f"'{key}' has no use with format"):
        take(tmp_path, CAMERA + entry, files=("c", "v"))


@pytest.mark.parametrize("key", ["excluded", "swapped"])
@pytest.mark.parametrize(("value", "words"), [
    ("[[5, 3]]", r"has \[5, 3\]"), ("[[3, 3]]", r"has \[3, 3\]"), ("[[-1, 3]]", "-1, 3.*counted from 0"),
    ("[[0, 3], [9, 4]]", r"has \[9, 4\]"), ("[[0.5, 3]]", "whole number"), ("[0, 3]", "Write a list of ranges"),
    ("[[0, 3, 4]]", "Write a list of ranges"), ('"all"', "Write a list of ranges"),
])  # fmt: skip
def test_ranges_of_steps_that_cannot_be_are_refused(key, value, words, tmp_path):
    entry = f'[[keypoints]]\ncamera = "a"\nformat = "detect"\n{key} = {value}'
    with pytest.raises(TakeError, match=words) as caught:
        take(tmp_path, CAMERA + entry, files=("c", "v"))
    assert "keypoints" in str(caught.value) and key in str(caught.value)


def test_ranges_of_steps_have_no_use_with_a_stream(tmp_path):
    with pytest.raises(TakeError, match="'swapped' has no use with a stream"):
        take(tmp_path, '[[camera]]\nname = "a"\n[[keypoints]]\ncamera = "a"\nstream = "s"\nswapped = [[0, 1]]')


def test_a_start_has_a_place_and_a_direction_or_clicks_alone(tmp_path):
    (tmp_path / "clicks.json").write_text("{}")
    read = take(tmp_path, CAMERA + '[start]\nclicks = "clicks.json"\nclick_sigma = 0.5', files=("c", "v"))
    assert read.pose is None and read.click_sigma == 0.5 and read.clicks == tmp_path / "clicks.json"
    clicks = 'clicks = "clicks.json"\n'
    for lines in (f"{clicks}at = [0, 0, 1]", f"{clicks}step = 3", "click_sigma = 2.0", ""):
        with pytest.raises(TakeError, match="no `at` and `forward`"):
            take(tmp_path, f"{CAMERA}[start]\n{lines}", files=("c", "v"))
    with pytest.raises(TakeError, match="click_sigma = 0. Give a positive number of pixels"):
        take(tmp_path, CAMERA + '[start]\nclicks = "clicks.json"\nclick_sigma = 0', files=("c", "v"))


def test_markers_are_put_into_the_world_by_shift_and_turn(tmp_path):
    x = np.random.default_rng(0).normal(size=(3, 4, 3))
    write_markers(Markers(("a", "b", "c", "d"), 100.0, x, up="y", unit="mm"), tmp_path / "m.trc")
    file = tmp_path / "take.toml"
    file.write_text('[[markers]]\nfile = "m.trc"\nshift = [1.0, 2.0, 3.0]\nturn = [90.0, 0.0, 0.0]\n')
    (markers,) = load_observations(read_take(file)).markers
    expected = x[..., [0, 2, 1]] * [1.0, -1.0, 1.0] + [1.0, 2.0, 3.0]
    np.testing.assert_allclose(markers.positions, expected, atol=1e-5)
    assert markers.up is None


@pytest.mark.parametrize("line", ["shift = [1e5, 0, 0]", "turn = [0, 0, 500]", "turn = [0, 0, nan]"])
def test_shifts_and_turns_that_cannot_be_are_refused(line, tmp_path):
    (tmp_path / "m.trc").touch()
    file = tmp_path / "take.toml"
    file.write_text(f'[[markers]]\nfile = "m.trc"\n{line}\n')
    told = rf"1: {line.partition(' ')[0]} = \[.*\]. Give (metres|degrees, at most 360)"
    with pytest.raises(TakeError, match=told):
        read_take(file)


KEYPOINTS = '[calibration]\nfile = "m.trc"\n[[camera]]\nname = "a"\n[[keypoints]]\ncamera = "a"\nfile = "m.trc"\n'


def test_names_and_sets_of_points_with_names_of_their_own(tmp_path):
    text = KEYPOINTS + 'format = "deeplabcut"\nset = "MOUSE"\nnames = { paw_l = "LPaw", tail = "" }\n'
    (entry,) = take(tmp_path, text).keypoints
    assert (entry.set, entry.names) == ("MOUSE", {"paw_l": "LPaw", "tail": ""})
    with pytest.raises(TakeError, match="no keypoint set 'MOUSE'; there are: BODY_25B"):
        take(tmp_path, KEYPOINTS + 'format = "mmpose"\nset = "MOUSE"\n')
    with pytest.raises(TakeError, match="no keypoint set of freemocap 'COCO_17'; there are: MEDIAPIPE_33"):
        take(tmp_path, KEYPOINTS + 'format = "freemocap"\nset = "COCO_17"\n')
    with pytest.raises(TakeError, match="'names' has no use with format = \"alphapose\""):
        take(tmp_path, KEYPOINTS + 'format = "alphapose"\nnames = { a = "LKnee" }\n')
