"""Places of labels that the markers around carry: many at once as one by one; ends of trajectories that need a look."""

from __future__ import annotations

import numpy as np

from kinefit.geometry.se3 import exp_so3
from kinefit.markers.audit.swaps import _ExpectedPlaces, _leaves, _nearest, _spans, gap_swaps


def _cluster(frames=120, count=8, seed=0):
    """Markers of one rigid segment that turns and travels, with gaps: positions, mean, deviation of distances."""
    random = np.random.default_rng(seed)
    shape = random.uniform(-0.2, 0.2, (count, 3))
    turn = np.linspace(0.0, 1.0, frames)
    R = np.stack([exp_so3(np.array([0.3, 1.0, 0.2]) * t) for t in turn])
    x = np.einsum("fij,kj->fki", R, shape) + np.array([1.5, 0.0, 0.0]) * turn[:, None, None]
    x += random.normal(0.0, 0.001, x.shape)
    mean = np.linalg.norm(shape[:, None] - shape, axis=-1)
    deviation = np.where(np.eye(count, dtype=bool), np.nan, random.uniform(0.002, 0.01, (count, count)))
    return x, mean, deviation


def test_places_carried_together_are_those_carried_alone_and_right():
    x, _, deviation = _cluster()
    hidden = np.array(x)
    hidden[40:60, 2], hidden[50:55, 3:5], hidden[:3, 0] = np.nan, np.nan, np.nan
    spans = [(2, 60, 61), (2, 38, 39), (0, 3, 4), (5, 52, 53)]
    alone, together = _ExpectedPlaces(hidden, deviation), _ExpectedPlaces(hidden, deviation)
    together.carry_own(spans)
    for a, first, last in spans:
        off = [[*places.off(a, a, slice(first, last + 1))] for places in (alone, together)]
        np.testing.assert_allclose(off[0], off[1], atol=1e-12)
        assert max(off[0]) < 0.005  # the label is where it should be
    assert np.isnan([*_ExpectedPlaces(hidden[:, :3], deviation[:3, :3]).off(2, 2, slice(60, 61))]).all()


def test_the_nearest_frames_are_found_however_far():
    seen = np.zeros((1000, 3), bool)
    seen[[5, 700, 701, 900, 950, 999]] = True
    assert _nearest(seen, [0, 2]).tolist() == [5, 700, 701, 900]
    assert _nearest(seen[:600], [1]).tolist() == [5]
    assert _nearest(seen[:0], [1]).tolist() == []


def test_ends_of_long_trajectories_are_looked_at_only_where_they_leap():
    x, mean, deviation = _cluster(frames=200)
    assert not any(a == 3 for a, _, _ in _spans(x, 0.02))
    leapt = np.array(x)
    leapt[-1, 3] = x[-1, 5]
    leapt[-1, 5] = np.nan
    assert (3, 199, 199) in _spans(leapt, 0.02)
    assert gap_swaps(leapt, mean, deviation) == [(3, 5, 199, 199)]
    first = leapt[::-1]
    assert gap_swaps(np.ascontiguousarray(first), mean, deviation) == [(3, 5, 0, 0)]
    short = np.array(x[:60])
    short[20:, 3] = np.nan
    assert (3, 18, 19) in _spans(short, 0.02)  # of twenty frames: it may be another's as a whole
    assert _leaves(np.cumsum([[0.0] * 3, [0.01] * 3, [0.01] * 3, [0.03] * 3], axis=0), 0.02)
    assert not _leaves(np.cumsum([[0.0] * 3, [0.01] * 3, [0.01] * 3, [0.01] * 3], axis=0), 0.02)
