"""Markers that stay behind: the person moves, they rest in space."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies.marker_sets import placement
from kinefit.identification.audit.audit import audit_take
from kinefit.identification.audit.resting import resting
from kinefit.observations import Markers
from kinefit.simulation import squat_and_wave

FIRST = 60


@pytest.fixture(scope="module")
def take():
    """Four seconds of 41 markers with 1 mm of noise; the feet stand all the time."""
    truth = squat_and_wave(rate=60.0, duration=4.0)
    points, rng = placement(truth.body, "CMU_41").points, np.random.default_rng(0)
    x = truth.positions(points)
    return Markers(points.names, truth.rate, x + rng.normal(0.0, 0.001, x.shape), up=truth.up)


def left_behind(take, label):
    x, k = np.array(take.positions), take.names.index(label)
    x[FIRST:, k] = x[FIRST, k] + np.random.default_rng(1).normal(0.0, 0.001, x[FIRST:, k].shape)
    return replace(take, positions=x)


def test_nothing_rests_in_a_clean_take(take):
    assert resting(take) == []


@pytest.mark.parametrize("label", ["LBWT", "RWRA"])
def test_a_marker_left_behind_is_named(take, label):
    found = [f for f in audit_take(left_behind(take, label)) if f.kind == "resting"]
    assert {f.labels for f in found} == {(label,)} and label in str(found[0])
    assert found[0].first >= FIRST - take.rate / 2 and found[-1].last > 200 and found[0].size > 0.05


def test_a_take_of_less_than_a_window_says_nothing(take):
    short = left_behind(take, "LBWT")
    assert resting(replace(short, positions=short.positions[FIRST : FIRST + 30])) == []
