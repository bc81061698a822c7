"""How evidence adds up."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kinefit.sensors.evidence import BELIEVED, SHOWN, Evidence

S = 10


def test_evidence_at_its_bounds():
    told = Evidence(np.array([0.0, SHOWN, 0.1, 0.5, 0.49, 3.0]), np.array([0.0, 0.0, 0.1, 0.5, 0.51, 1.0]))
    assert told.hidden.tolist() == [True, False, True, False, False, False]
    assert told.lost.tolist() == [False, False, False, False, True, False]
    np.testing.assert_allclose(told.quality, [0.0, 1.0, 0.5, 0.5, 0.49, 0.75])


AMOUNTS = arrays(float, (2, S), elements=st.floats(0, 10))


@given(AMOUNTS, AMOUNTS, AMOUNTS)
def test_evidence_adds_up(a, b, c):
    a, b, c = (Evidence(*x) for x in (a, b, c))
    one, other = (a + b) + c, c + (b + a)
    np.testing.assert_allclose(one.agreeing, other.agreeing)
    np.testing.assert_allclose(one.contrary, other.contrary)
    same = a + Evidence.none(S)
    assert np.array_equal(same.agreeing, a.agreeing) and np.array_equal(same.contrary, a.contrary)
    assert not (one.hidden & ~a.hidden).any() and not (one.hidden & one.lost).any()
    assert ((one.quality >= 0) & (one.quality <= 1)).all()
    assert np.array_equal(one.lost, ~one.hidden & (one.quality < BELIEVED))


def test_a_segment_that_cameras_agree_on_elsewhere_is_lost():
    none, told = Evidence(np.ones(2), np.zeros(2)), Evidence(np.ones(2), np.ones(2), np.array([True, False]))
    for both in (none + told, told + none):
        assert both.lost.tolist() == [True, False] and both.balance == 2.0
    assert (none + none).elsewhere is None
    unseen = Evidence(np.zeros(2), np.zeros(2), np.array([True, False]))
    assert not unseen.lost.any()
