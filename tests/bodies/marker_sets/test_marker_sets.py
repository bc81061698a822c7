import numpy as np
import pytest

from kinefit.bodies.marker_sets import find_marker_set, load_marker_set, marker_set_names
from kinefit.errors import FileError, ObservationError

MINIMAL = """
name = "X"
sides = [["R", "L"]]
single = ["RC"]
[places]
RA = [0.1, 0.2, 0.3]
[[segment]]
name = "trunk"
markers = ["A", "B", "RC"]
[[segment]]
name = "arm_r"
parent = "trunk"
joint = [0, 0, 0.2]
markers = ["RA"]
loose = { RA = 0.02 }
"""


@pytest.mark.parametrize("name", marker_set_names())
def test_every_set_is_a_tree_whose_sides_mirror(name):
    marker_set = load_marker_set(name)
    assert marker_set.segments[0].parent == -1 and len(marker_set.segments[0].markers) >= 3
    for i, s in enumerate(marker_set.segments[1:], 1):
        assert 0 <= s.parent < i and s.joint is not None and len(s.give) == len(s.markers)
    by_name = {s.name: s for s in marker_set.segments}
    for s in marker_set.segments:
        if s.name.endswith("_r"):
            left = by_name[s.name[:-1] + "l"]
            np.testing.assert_allclose(s.joint * [1, 1, -1], left.joint)
            assert 0 <= len(s.markers) - len(left.markers) <= 1  # one more on a side tells the sides apart


@pytest.mark.parametrize(
    ("name", "labels", "segments"),
    [("CMU-41", 41, 15), ("HDM05_41", 41, 15), ("PAPER_44", 44, 13), ("PAPER_49", 49, 15), ("opencap_47", 51, 12)],
)
def test_the_sets_have_their_numbers(name, labels, segments):
    marker_set = load_marker_set(name)
    assert (len(marker_set.labels), len(marker_set.segments)) == (labels, segments)


def test_labels_are_matched_whatever_the_subject_is_called_and_how_they_are_spelt():
    cmu = load_marker_set("CMU_41")
    labels = [f"Jim:{n.lower()}" for n in cmu.labels]
    assert cmu.match(labels) == cmu.labels
    assert find_marker_set(labels) is cmu
    assert find_marker_set(["a", "b", "LTHI", "c", "d"]) is None
    assert load_marker_set("STANFORD_47").is_computed("R_HJC_reg")
    assert load_marker_set("PIG").match(["nobody"]) == (None,)


def test_a_file_of_ones_own(tmp_path):
    file = tmp_path / "x.toml"
    file.write_text(MINIMAL)
    own = load_marker_set(file)
    assert own.labels == ("A", "B", "RC", "RA", "LA") and [s.name for s in own.segments] == ["trunk", "arm_r", "arm_l"]
    np.testing.assert_allclose(own.places[4], [0.1, 0.2, -0.3])
    assert np.isnan(own.places[0]).all() and own.segments[2].give == (0.02,)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('parent = "trunk"', 'parent = "trnk"', "no segment 'trnk'"),
        ('name = "arm_r"', 'name = "trunk"', "twice"),
        ("RA = [0.1, 0.2, 0.3]", "RQ = [0.1, 0.2, 0.3]", "no segment has"),
        ("joint = [0, 0, 0.2]", "joint = [0, nan, 0.2]", "not finite"),
        ("RA = 0.02", "RZ = 0.02", "RZ"),
        ('"RA"]', '"RA", "RA"]', "twice"),
        ("name = ", "nme = ", "not a marker set"),
        ("[places]", "[places", "not TOML"),
    ],
)
def test_a_wrong_file_says_what_and_where(tmp_path, old, new, said):
    file = tmp_path / "wrong.toml"
    file.write_text(MINIMAL.replace(old, new, 1))
    with pytest.raises(FileError, match=said) as caught:
        load_marker_set(file)
    assert caught.value.file == str(file)


def test_an_unknown_name_lists_what_there_is(tmp_path):
    with pytest.raises(ObservationError, match="CMU_41"):
        load_marker_set("CMU_42")
    with pytest.raises(FileError, match="cannot read"):
        load_marker_set(tmp_path / "none.toml")
