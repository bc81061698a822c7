"""Markers that stay behind: the person moves, they rest in space."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.markers.audit.audit import audit_take, resting_markers

FIRST = 60


def left_behind(take, label):
    x, k = np.array(take.positions), take.names.index(label)
    x[FIRST:, k] = x[FIRST, k] + np.random.default_rng(1).normal(0.0, 0.001, x[FIRST:, k].shape)
    return replace(take, positions=x)


def test_nothing_rests_in_a_clean_take(waving):
    assert resting_markers(waving) == []


@pytest.mark.parametrize("label", ["LBWT", "RWRA"])
def test_a_marker_left_behind_is_named(waving, label):
    found = [f for f in audit_take(left_behind(waving, label)) if f.kind == "resting"]
    assert {f.labels for f in found} == {(label,)} and label in str(found[0])
    assert found[0].first >= FIRST - waving.rate / 2 and found[-1].last > 200 and found[0].size > 0.05


def test_a_take_of_less_than_a_window_says_nothing(waving):
    short = left_behind(waving, "LBWT")
    assert resting_markers(replace(short, positions=short.positions[FIRST : FIRST + 30])) == []
