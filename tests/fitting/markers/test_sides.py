"""Left and right of markers: mirrored worlds, exchanged sides and labels, and what does not decide."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit import Markers, load_body
from kinefit.bodies.marker_sets import placement, read_sides, side_pairs
from kinefit.errors import ObservationError
from kinefit.fitting.markers.sides import label_findings, refuse_wrong_sides
from kinefit.simulation import squat_and_wave

BODY = load_body("humanoid")


def _take(marker_set="PIG", keep=lambda name: True):
    truth = squat_and_wave(rate=10)
    points = placement(truth.body, marker_set).points
    points = points.select([n for n in points.names if keep(n)])
    x = truth.positions(points) + np.random.default_rng(0).normal(0, 0.003, (len(truth), len(points), 3))
    return Markers(points.names, 10.0, x)


def _exchanged(markers, pairs):
    image = pairs | {b: a for a, b in pairs.items()}
    return replace(markers, names=tuple(image.get(n, n) for n in markers.names))


def _mirrored(markers, axis=0):
    return replace(markers, positions=read_sides(markers.names, markers.positions, f"mirrored-{'xyz'[axis]}")[1])


RIGHT = _take()
NO_BACK = _take(keep=lambda name: name != "RBAK")


def test_a_right_take_has_no_finding():
    assert label_findings(BODY, RIGHT) == ()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mirrored_world_without_markers_of_one_side_names_both_causes(axis):
    (found,) = label_findings(BODY, _mirrored(NO_BACK, axis))
    assert (found.severity, found.kind) == ("fault", "sides")
    assert found.text.startswith("The world is mirrored (left-handed) or left and right labels are exchanged")
    assert "--sides mirrored-y" in found.remedy and "--sides exchanged" in found.remedy  # x is ahead, z up


def test_a_marker_of_one_side_decides_between_the_causes():
    (world,) = label_findings(BODY, _mirrored(RIGHT))
    (labels,) = label_findings(BODY, _exchanged(RIGHT, side_pairs(RIGHT.names)))
    assert world.text.startswith("The world is mirrored (left-handed):") and "RBAK" in world.confidence
    assert labels.text.startswith("Left and right labels are exchanged:") and "RBAK" in labels.confidence


def test_both_at_once_are_no_fault_that_can_be_seen():
    assert label_findings(BODY, _mirrored(_exchanged(NO_BACK, side_pairs(NO_BACK.names)))) == ()


@pytest.mark.parametrize("sides", ["exchanged", "mirrored-z"])
def test_the_remedies_mend_a_mirrored_world(sides):
    wrong = _mirrored(NO_BACK)
    with pytest.raises(ObservationError, match="left-handed"):
        refuse_wrong_sides(label_findings(BODY, wrong))
    names, positions = read_sides(wrong.names, wrong.positions, sides)
    assert label_findings(BODY, replace(wrong, names=names, positions=positions)) == ()
    assert label_findings(BODY, wrong, sides="labelled") == ()


@pytest.mark.parametrize("pair", [("RKNE", "LKNE"), ("RASI", "LASI"), ("RHEE", "RTOE"), ("LKNE", "LANK")])
def test_two_exchanged_labels_are_named(pair):
    (found,) = label_findings(BODY, _exchanged(RIGHT, dict([pair])))
    assert (found.severity, found.kind) == ("fault", "labels")
    assert found.text.startswith(f"{pair[0]} and {pair[1]} are exchanged in the whole take")


def test_exchanged_legs_are_named():
    words = ("THI", "KNE", "MKN", "TIB", "ANK", "MMA", "HEE", "TOE", "MT5", "Lat")
    legs = {a: b for a, b in side_pairs(RIGHT.names).items() if a[1:4] in words}
    (found,) = label_findings(BODY, _exchanged(RIGHT, legs))
    assert found.text.startswith("Left and right labels of the legs are exchanged")


def test_markers_that_do_not_decide_are_said_to_be_undecided():
    head = _take(keep=lambda name: name in ("RFHD", "LFHD", "RBHD", "LBHD", "RSHO", "LSHO", "C7"))
    one_plane = replace(head, positions=head.positions * (1, 1, 0.0) + (0, 0, 1))
    found = label_findings(BODY, one_plane)
    assert [(f.severity, f.kind) for f in found] == [("note", "sides")] and "undecided" in found[0].text


def test_ignored_labels_are_named_with_the_set():
    odd = replace(RIGHT, names=tuple({"RFIN": "Q1", "LFIN": "Q2"}.get(n, n) for n in RIGHT.names))
    (found,) = label_findings(BODY, odd)
    assert found.severity == "note"
    assert found.text == f"Marker set PIG: {len(odd.names) - 2} of {len(odd.names)} labels; ignored: Q1, Q2."


def test_sides_are_read_as_stated():
    x = np.arange(12.0).reshape(1, 4, 3)
    names, same = read_sides(("A:RKNE", "A:LKNE", "A:C7", "B:RKNE"), x, "exchanged")
    assert names == ("A:LKNE", "A:RKNE", "A:C7", "B:RKNE") and (same == x).all()
    assert (read_sides(("C7",), x[:, :1], "mirrored-y")[1] == [[[0, -1, 2]]]).all()
    with pytest.raises(ObservationError, match="no pairs"):
        read_sides(("C7",), x[:, :1], "exchanged")
    with pytest.raises(ObservationError, match="sides"):
        read_sides(("C7",), x[:, :1], "flipped")
