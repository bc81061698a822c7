"""Edits of the text of a take file: the keys change, and nothing else."""

import tomllib

import pytest

from kinefit.exporters.take_text import quoted, with_keys

TEXT = """# a take of Tuesday
[take]
name = "a # b"   # the trial
frames = [   # all of it
  0,  # first
  90,
]  # the end

# the left camera
[[camera]]
name = "one"

[[camera]]
name = "two"  # the right one
size = [640, 480]

[start]
at = [0, 0, 1]
angles = { knee = 5 }
"""


def test_a_value_is_replaced_and_its_comment_stays():
    new = with_keys(TEXT, "take", None, {"name": quoted('c "d" \\')})
    assert new == TEXT.replace('"a # b"', '"c \\"d\\" \\\\"')
    assert tomllib.loads(new)["take"]["name"] == 'c "d" \\'


def test_a_value_of_several_lines_is_replaced_whole():
    new = with_keys(TEXT, "take", None, {"frames": "[5, 20]"})
    assert "frames = [5, 20]  # the end\n\n# the left camera" in new
    assert tomllib.loads(new)["take"] == {"name": "a # b", "frames": [5, 20]}


def test_a_new_key_stands_below_those_of_its_table():
    new = with_keys(TEXT, "camera", 0, {"time_offset": "0.5"})
    assert new == TEXT.replace('name = "one"\n', 'name = "one"\ntime_offset = 0.5\n')
    new = with_keys(TEXT, "camera", 1, {"time_offset": "0.5", "size": None})
    assert tomllib.loads(new)["camera"] == [{"name": "one"}, {"name": "two", "time_offset": 0.5}]
    assert '"two"  # the right one' in new


@pytest.mark.parametrize("end", ["", "\n", "\n\n"])
def test_a_missing_table_is_added_at_the_end(end):
    text = TEXT.rstrip() + end
    new = with_keys(with_keys(text, "keypoints", 0, {"camera": '"one"'}), "keypoints", 1, {"camera": '"two"'})
    assert new.startswith(TEXT.rstrip())
    assert tomllib.loads(new)["keypoints"] == [{"camera": "one"}, {"camera": "two"}]
    assert tomllib.loads(with_keys("", "take", None, {"rate": "5.0"})) == {"take": {"rate": 5.0}}


def test_a_removed_key_leaves_no_trace():
    added = with_keys(TEXT, "start", None, {"step": "3"})
    assert tomllib.loads(added)["start"]["step"] == 3
    assert with_keys(added, "start", None, {"step": None}) == TEXT
    assert with_keys(TEXT, "start", None, {"step": None}) == TEXT


def test_line_ends_stay_as_they_are():
    text = TEXT.replace("\n", "\r\n")
    new = with_keys(with_keys(text, "take", None, {"rate": "5.0"}), "session", None, {"side": '"left"'})
    assert new.count("\n") == new.count("\r\n") and tomllib.loads(new)["take"]["rate"] == 5.0


def test_text_that_looks_like_a_table_is_none():
    text = 'x = """\n[take]\nrate = 1\n"""\n[take]\nlist = [\n[1, 2],\n[3, 4],\n]\nrate = 2\n'
    new = with_keys(text, "take", None, {"rate": "3"})
    assert tomllib.loads(new) == {"x": "[take]\nrate = 1\n", "take": {"list": [[1, 2], [3, 4]], "rate": 3}}
