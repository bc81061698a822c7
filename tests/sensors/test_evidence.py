"""How evidence adds up."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from kinefit.bodies import load_body
from kinefit.sensors.evidence import BELIEVED, MIN_VISIBLE_OUTLINE, Evidence

S = 10


def test_evidence_at_its_bounds():
    agreeing = np.array([0.0, MIN_VISIBLE_OUTLINE, 0.1, 0.5, 0.49, 3.0])
    told = Evidence(agreeing, np.array([0.0, 0.0, 0.1, 0.5, 0.51, 1.0]))
    assert told.hidden.tolist() == [True, False, True, False, False, False]
    assert told.lost.tolist() == [False, False, False, False, True, False]
    np.testing.assert_allclose(told.quality, [0.0, 1.0, 0.5, 0.5, 0.49, 0.75])


def test_an_unobserved_segment_between_two_observed_ones_has_the_lower_quality():
    """In one frame and in many; one at the end of a chain has none."""
    tree = load_body("humanoid").tree
    pelvis, abdomen, thorax, hand = (tree.segment(n) for n in ("pelvis", "abdomen", "thorax", "hand_r"))
    agreeing, contrary = np.zeros((2, 2, len(tree.segments)))
    agreeing[:, [pelvis, thorax]], contrary[0, pelvis], contrary[1, thorax] = 1.0, 0.25, 1.0
    quality = Evidence(agreeing, contrary).segment_quality(tree)
    np.testing.assert_allclose(quality[:, abdomen], [0.8, 0.5])
    assert (quality[:, hand] == 0.0).all()
    np.testing.assert_array_equal(Evidence(agreeing[0], contrary[0]).segment_quality(tree), quality[0])
    agreeing[:, thorax] = contrary[:, thorax] = 0.0  # nothing beyond it is observed
    assert (Evidence(agreeing, contrary).segment_quality(tree)[:, abdomen] == 0.0).all()


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


def test_an_unplaced_segment_has_no_quality_unless_another_sensor_supports_it():
    tree = load_body("humanoid").tree
    n, elbow, hand = len(tree.segments), tree.segment("forearm_r"), tree.segment("hand_r")
    unplaced = np.arange(n) == elbow
    hidden = np.where(unplaced, 0.0, 1.0)  # what is beside it agrees
    depth, silent = Evidence(hidden, np.zeros(n), unplaced=unplaced), Evidence.none(n)
    against = Evidence(np.zeros(n), np.ones(n) * MIN_VISIBLE_OUTLINE)
    for told in (depth, silent + depth, depth + silent, depth + against):
        assert told.segment_quality(tree)[elbow] == 0.0 < told.segment_quality(tree)[hand]
    seen = Evidence(np.full(n, MIN_VISIBLE_OUTLINE), np.zeros(n))
    for told in (depth + seen, seen + depth):
        assert told.segment_quality(tree)[elbow] == 1.0
    assert (depth + depth).segment_quality(tree)[elbow] == 0.0
