"""Marker sets on bodies, and the rule for labels."""

import numpy as np
import pytest

from kinefit import load_body
from kinefit.bodies.marker_sets import (
    bare,
    find_placement,
    known_set,
    load_marker_set,
    matched,
    placed_set_names,
    placement,
    subject_of,
)
from kinefit.bodies.marker_sets.sets import catalogue
from kinefit.errors import FileError, ObservationError

BODY = load_body("humanoid")


@pytest.mark.parametrize("name", placed_set_names())
def test_sets_lie_on_the_body_and_are_symmetric(name):
    placed = placement(BODY, name)
    assert len(set(placed.points.names)) == len(placed.points) >= 20
    x = BODY.points_rest(placed.points)
    ends = np.concatenate([BODY.points_rest(BODY.landmarks), BODY.tree.rest])
    nearest = np.linalg.norm(x[:, None] - ends[None], axis=2).min(axis=1)
    assert nearest.max() < 0.16  # [m] half a thigh
    assert np.all((placed.spread > 0.005) & (placed.spread <= 0.1))
    mirrored = x * (1, 1, -1)
    images = np.linalg.norm(mirrored[:, None] - x[None], axis=2).min(axis=1)
    alone = {n for n, off, z in zip(placed.points.names, images, x[:, 2]) if off > 1e-9 and abs(z) > 1e-9}
    assert alone <= set(catalogue()[name].single)  # a marker more on one side, which tells the sides apart


def test_sets_go_by_all_their_names():
    assert placement(BODY, "hdm05-41").points.names == placement(BODY, "CMU_41").points.names
    labels = placement(BODY, "STANFORD_47").points.names
    assert {"r.ASIS", "L.ASIS", "r_knee", "L_knee", "R_Shoulder", "L_Shoulder"} <= set(labels)


BAD_SETS = {
    "not TOML": "name = ",
    "not a marker set": "name = 3",
    "landmark, or a segment": 'name = "a"\n[markers]\nA = { segment = "thigh_r" }',
    "not finite": 'name = "a"\n[markers]\nA = { landmark = "r_asis", spread = -1.0 }',
}


@pytest.mark.parametrize("problem", BAD_SETS)
def test_bad_sets_are_told(tmp_path, problem):
    (tmp_path / "a.toml").write_text(BAD_SETS[problem])
    with pytest.raises(FileError, match=problem):
        placement(BODY, tmp_path / "a.toml")
    with pytest.raises(FileError, match="cannot read"):
        placement(BODY, tmp_path / "none.toml")
    with pytest.raises(ObservationError, match="no marker set 'X'"):
        placement(BODY, "X")


def test_own_set_from_a_file(tmp_path):
    (tmp_path / "a.toml").write_text(
        'name = "mine"\nsides = [["R", "L"]]\n[markers]\nRA = { landmark = "r_asis" }\nRB = { landmark = "r_psis" }\n'
        'RC = { segment = "thigh_r", at = [0.0, -0.2, 0.1], spread = 0.05 }\nRD = { landmark = "not_there" }\n'
    )
    found = find_placement(BODY, ("LA", "LB", "LC", "RA", "LD"), tmp_path / "a.toml")
    assert found.points.names == ("RA", "LA", "LB", "LC")
    assert found.points.points[3] == pytest.approx([0.0, -0.2, -0.1])
    with pytest.raises(ObservationError, match="set .* knows only 2 of the labels"):
        find_placement(BODY, ("LA", "LB", "X"), tmp_path / "a.toml")


def test_a_set_without_places_on_a_body_says_so(tmp_path):
    with pytest.raises(FileError, match="has no positions of its markers"):
        placement(BODY, "PAPER_44")
    (tmp_path / "a.toml").write_text('name = "mine"\n[markers]\nA = { landmark = "r_asis" }\n')
    with pytest.raises(FileError, match="no segment"):
        load_marker_set(tmp_path / "a.toml")
    (tmp_path / "a.toml").write_text('name = "mine"\n')
    with pytest.raises(FileError, match="no segment and no markers"):
        placement(BODY, tmp_path / "a.toml")


@pytest.mark.parametrize("name", placed_set_names())
def test_segments_and_places_are_of_the_same_labels(name):
    assert set(placement(BODY, name).points.names) == set(load_marker_set(name).labels)


def test_labels_agree_by_one_rule():
    names = ("LASI", "R.Knee", "r_knee_m", "a.b", "ab")
    labels = ("Anna:LASI", "lasi", "Bob: r_knee", "R knee-M", "a_b", "Jim:ab", "knee")
    assert matched(labels, names) == ("LASI", "LASI", "R.Knee", "r_knee_m", None, "ab", None)
    assert (bare("A:B:C"), subject_of("A:B:C"), bare("C"), subject_of("C")) == ("C", "A:B", "C", "")
    labels = [f"Anna:{n.lower()}" for n in placement(BODY, "PIG").points.names]
    assert find_placement(BODY, labels).name == "PIG"
    assert known_set(BODY, ["Anna:R_ASIS"]) == known_set(BODY, ["r_asis"])
    with pytest.raises(ObservationError, match="knows none of the labels"):
        known_set(BODY, ["nobody"])
