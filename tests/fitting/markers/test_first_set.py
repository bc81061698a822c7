"""A first marker set for labels that no set knows: sides, words, groups, places."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit import load_body
from kinefit.bodies.marker_sets import find_marker_set, load_marker_set, side_pairs
from kinefit.fitting.markers.first_set import first_set, known_words
from kinefit.markers.model.learn import learn_model
from kinefit.readers.markers import read_markers

BODY = load_body("humanoid")


@pytest.fixture(scope="module")
def walk(data_dir):
    folder = data_dir("markers") / "momentum"
    return read_markers(folder / "momentum__examples__process_markers_app__02_01.c3d")


@pytest.mark.parametrize(
    ("labels", "pairs"),
    [
        (("RKNE", "LKNE", "C7", "RBAC"), {"RKNE": "LKNE"}),
        (("r_knee", "L_knee", "Knee_R", "Knee_L"), {"r_knee": "L_knee", "Knee_R": "Knee_L"}),
        (("RightToe", "LeftToe", "Root"), {"RightToe": "LeftToe"}),
        (("M1", "M2"), {}),
    ],
)
def test_right_labels_find_their_left_ones(labels, pairs):
    assert side_pairs(labels) == pairs


def test_words_of_the_catalogue_are_known_on_either_side():
    labels = ["RASI", "LASI", "Knee_R", "Knee_L", "C7", "Q9"]
    words = known_words(labels, side_pairs(labels))
    assert set(words) >= {"RASI", "LASI", "Knee_R", "Knee_L", "C7"} and "Q9" not in words
    assert words["RASI"][0] == words["LASI"][0] and (words["RASI"][1], words["LASI"][1]) == (False, True)
    assert words["RASI"][0].landmark == "r_asis"


def test_a_set_is_written_that_names_segments_and_places(walk, tmp_path):
    odd = {n: n.rpartition(":")[2] for n in walk.names}
    strange = [n for n in odd.values() if n[1:] in ("THI", "SHN", "UPA", "FRM", "FIN")]
    names = tuple(f"{n[0]}zz{n[1:]}" if n in strange else n for n in odd.values())  # words that nobody knows
    written = first_set(replace(walk, names=names), body=BODY, name="LAB")
    file = tmp_path / "lab.toml"
    file.write_text(written.text, "utf-8")
    own, truth = load_marker_set(file), find_marker_set(walk.names)
    assert set(own.labels) == set(names) and own.name == "LAB" and set(written.placed) == set(names)
    for side in "RL":
        for word, segment in (("THI", "thigh"), ("SHN", "shank"), ("UPA", "upperarm"), ("FRM", "forearm")):
            assert f"{side}zz{word}" in written.segments[f"{segment}_{side.lower()}"]
    both = [label for label in truth.labels if label in own.labels]
    a = np.array([own.places[own.labels.index(n)] for n in both])
    b = np.array([truth.places[truth.labels.index(n)] for n in both])
    assert np.median(np.linalg.norm(a - b, axis=1)) < 0.05
    model = learn_model(replace(walk, names=names), template=str(file))
    assert len(model) == len(names) and max(model.mean[np.ix_(s, s)].max() for s in model.segments) < 0.65


def test_without_words_groups_are_what_moves_together(walk, tmp_path):
    take = replace(walk, names=tuple(f"M{i}" for i in range(len(walk.names))))
    written = first_set(take, body=BODY)
    assert not written.placed and not written.paired
    file = tmp_path / "my_set.toml"
    file.write_text(written.text, "utf-8")
    assert set(load_marker_set(file).labels) == set(take.names)
