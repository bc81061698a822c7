"""Sensors that do not fit the videos, found by the person."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from kinefit.cli.checks._refine import Refined
from kinefit.geometry import se3
from kinefit.geometry.camera import Camera, Rig
from kinefit.readers.take.entries import DepthEntry, MarkersEntry
from kinefit.sensors.alignment import (
    SensorAlignment,
    alignment_line,
    doubts_of,
    marker_edits,
    misfits,
    moved_cameras,
    sensor_findings,
)

CENTRE = np.array([0.0, 1.0, 0.0])
STD = np.array([0.002] * 3 + [0.002] * 3 + [0.002])


def fit(sensor="depth", kind="depth", **moved):
    twist = np.zeros(7)
    for name, value in moved.items():
        twist[("x", "y", "z", "rx", "ry", "rz", "clock").index(name)] = value
    return SensorAlignment(sensor, kind, twist, np.diag(STD**2), CENTRE)


def take(**entries):
    return SimpleNamespace(path=Path("take.toml"), **{"depth": (), "markers": (), **entries})


DEPTH = take(depth=(DepthEntry(name="depth", camera="kinect", file="d", time_offset=0.5),))
MARKERS = take(markers=(MarkersEntry(file="m", shift=(0.1, 0.2, 0.3), turn=(0.0, 90.0, 0.0)),))


def test_a_fault_names_the_sensor_and_how_much():
    (found,) = sensor_findings([fit(x=0.03, ry=np.radians(2.0))], DEPTH)
    assert (found.severity, found.cameras) == ("fault", ("depth",))
    assert "2.00 ± " in found.text and "30.0 ± " in found.text
    assert "--refine" in found.remedy


@pytest.mark.parametrize("small", [{}, {"x": 0.004}, {"x": 0.012, "ry": 0.008}, {"ry": 0.005}])
def test_what_is_small_or_not_sure_is_good_news(small):
    assert [f.severity for f in sensor_findings([fit(**small)], DEPTH)] == ["good"]


def test_sure_and_small_is_no_misfit():
    exact = replace(fit(x=0.004), covariance=np.eye(7) * 1e-10)
    assert exact.deviations > 100.0
    assert misfits([exact]) == ()


def test_a_late_clock_is_a_doubt_with_the_line_to_write():
    found = sensor_findings([fit(clock=0.02)], DEPTH)
    assert [f.severity for f in found] == ["good", "doubt"]
    assert "time_offset = 0.5200 into [[depth]]" in found[1].remedy


def test_bars_hold_95_percent_of_errors():
    shift, turn = fit().bars
    assert shift == pytest.approx(2.795 * 0.002, rel=0.03)  # chi of three degrees of freedom
    assert turn == pytest.approx(2.795 * 0.002, rel=0.03)


def test_a_moved_camera_has_the_calibrations_name_and_sees_where_it_should():
    one = fit(x=0.03, ry=0.05)
    camera = Camera("depth", (160, 120), [[137, 0, 80], [0, 137, 60], [0, 0, 1]])
    (moved,) = moved_cameras([one], DEPTH, Rig((camera,)))
    x = np.array([0.3, 0.2, 2.0])
    assert moved.name == "kinect"
    np.testing.assert_allclose(moved.project(se3.apply(one.T, x)), camera.project(x), atol=1e-9)


def test_a_sensor_is_moved_only_where_nothing_speaks_against_it():
    one, origin = fit(x=0.03, ry=0.05), np.array([0.0, 1.0, 3.0])
    halves = one, fit(x=0.031, ry=0.05)
    why = lambda *args: "; ".join(doubts_of(*args))
    assert why(one, origin, halves, (np.zeros(7),)) == ""
    assert "another pose, 1.1° and 0 mm away" in why(one, origin, halves, (fit(ry=0.02).twist,))
    assert "no nearer" in why(replace(one, falls=False), origin, halves)
    assert "more than 30 cm or 15°" in why(fit(x=0.31), origin, halves)
    assert "more than 30 cm or 15°" in why(fit(ry=0.11), origin, halves)  # 3 m from what it sees
    assert "two halves of the frames disagree by 5.2" in why(one, origin, (one, fit(x=0.06, z=0.02, ry=0.05)))
    assert "misfit is within" in why(replace(one, covariance=1e2 * one.covariance), origin, halves)


def test_a_doubtful_sensor_is_named_and_not_refined():
    for falls, severity in ((True, "fault"), (False, "doubt")):
        one = replace(fit(x=0.03), falls=falls, doubts=("two halves disagree",))
        (found,) = sensor_findings([one], DEPTH)
        assert (found.severity, found.cameras) == (severity, ("depth",))
        assert "--refine" not in found.remedy
        assert "because two halves disagree." in found.confidence
        assert alignment_line(one) == "depth: not refined, because two halves disagree."
        assert Refined(None, (one, fit("markers", "markers", x=0.03))).moved[0].sensor == "markers"


def test_lines_of_markers_go_on_from_those_that_are_there():
    one = fit("markers", "markers", x=0.03, rz=0.05)
    shift, turn = (np.fromstring(edit.value.strip("[]"), sep=",") for edit in marker_edits(one, MARKERS))
    new = MarkersEntry(file="m", shift=tuple(shift), turn=tuple(turn)).T_world_file
    np.testing.assert_allclose(new, one.T @ MARKERS.markers[0].T_world_file, atol=2e-5)
    (found,) = sensor_findings([one], MARKERS)
    assert found.edits == marker_edits(one, MARKERS) and found.remedy.endswith("into [[markers]] 1.")
    assert alignment_line(one).startswith("markers: turned 2.86 ± ")
