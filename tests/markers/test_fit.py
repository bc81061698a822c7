"""The plain fit of labelled markers."""

from __future__ import annotations

import numpy as np
import pytest

from kinefit import Markers, fit_markers, load_body
from kinefit.errors import ObservationError
from kinefit.evaluation import joint_errors
from kinefit.simulation import squat_and_wave


@pytest.fixture(scope="module")
def recording():
    truth = squat_and_wave(rate=60)
    points = truth.body.markers("HANIM_45")
    rng = np.random.default_rng(0)
    x = truth.positions(points) + rng.normal(0, 0.002, (len(truth), len(points), 3))
    x[rng.uniform(size=x.shape[:2]) < 0.1] = np.nan
    x[30, 5] += 0.3
    return truth, Markers(tuple(f"Anna:{n}" for n in points.names), truth.rate, x, up=truth.up)


def test_motion_is_recovered_with_gaps_and_a_ghost(recording):
    truth, markers = recording
    motion = fit_markers(load_body("humanoid"), markers)
    known = motion.joint_std.max(axis=2) < 0.01  # a segment of two markers is loose where one is missing
    assert known.mean() > 0.8
    assert joint_errors(truth, motion)[known].max() < 0.03
    assert joint_errors(truth, motion)[known].mean() < 0.004
    assert motion.residuals["markers"].weights[30, 5] < 0.01


def test_error_bars_are_those_of_the_scatter(recording):
    truth, markers = recording
    motion = fit_markers(load_body("humanoid"), markers, sigma=0.002)
    off = motion.segment_poses()[..., :3, 3] - truth.segment_poses()[..., :3, 3]
    inside = np.abs(off) < 2 * motion.joint_std
    assert 0.92 < inside.mean() <= 0.99


def test_unknown_labels_are_told():
    markers = Markers(("a", "b", "c", "d"), 100.0, np.zeros((3, 4, 3)))
    with pytest.raises(ObservationError, match="HANIM_45"):
        fit_markers(load_body("humanoid"), markers)
