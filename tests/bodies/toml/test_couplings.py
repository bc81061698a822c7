"""Departures from the usual posture that go together."""

import numpy as np
import pytest

from kinefit import BodyState, load_body
from kinefit.bodies.parts import PartJoint, with_part, without_part
from kinefit.bodies.serial import body_from_arrays, body_to_arrays
from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.bodies.toml.bodies import parse_body
from kinefit.errors import BodyError
from kinefit.solving.correspondences import prior_rows

TWO_JOINTS = """
[body]
name = "two"

[[segment]]
name = "base"
joint = { name = "ground", type = "free" }

[[segment]]
name = "a"
parent = "base"
joint = { name = "first", type = "revolute", axes = ["z"], range = [[-90, 90]], usual = [10], spread = [30] }

[[segment]]
name = "b"
parent = "base"
joint.name = "second"
joint.type = "ball"
joint.axes = ["z", "x", "y"]
joint.coordinates = ["s1", "s2", "s3"]
joint.spread = [20, 20, inf]

[[segment]]
name = "c"
parent = "b"
joint = { name = "slide", type = "prismatic", axes = ["x"], spread = [0.1] }

[[coupling]]
name = "together"
of = { first = 0.5, s1 = -1.0 }
spread = 4
"""


def test_a_coupling_makes_the_posture_prior_a_gaussian_with_covariance():
    tree = parse_body(TWO_JOINTS).tree
    both, c = [tree.coordinate("first"), tree.coordinate("s1")], np.array([0.5, -1.0])
    covariance = np.linalg.inv(np.diag(np.radians([30.0, 20.0]) ** -2.0) + np.outer(c, c) / np.radians(4.0) ** 2)
    np.testing.assert_allclose(np.linalg.inv(tree.posture_precision[np.ix_(both, both)]), covariance)
    np.testing.assert_allclose(tree.posture_std[both], np.sqrt(np.diag(covariance)))
    assert np.isclose(np.sqrt(c @ covariance @ c), np.radians(4.0), rtol=0.05)  # the spreads alone hold it loosely
    others = [d for d in range(len(tree.coordinates)) if d not in both]
    np.testing.assert_array_equal(tree.posture_std[others], tree.spread[others])
    assert tree.posture_precision[tree.coordinate("s3")].max() == 0.0  # no prior


def test_a_coupling_of_one_side_has_its_image():
    text = """
    [body]
    name = "two arms"
    mirror = true
    [[segment]]
    name = "trunk"
    joint = { name = "root", type = "free" }
    [[segment]]
    name = "arm_r"
    parent = "trunk"
    joint = { name = "j_r", type = "universal", axes = ["z", "x"], coordinates = ["a_r", "b_r"], spread = [9, 9] }
    [[coupling]]
    name = "together_r"
    of = { a_r = 1.0, b_r = -0.5 }
    spread = 4
    """
    tree = parse_body(text).tree
    lines = np.zeros((2, 4))
    for line, side in zip(lines, "rl"):
        line[[tree.coordinate(f"a_{side}"), tree.coordinate(f"b_{side}")]] = 1.0, -0.5
    np.testing.assert_allclose(tree.couplings, lines / np.radians(4.0))


def test_without_couplings_the_prior_is_what_usual_and_spread_say():
    tree = load_body("humanoid10").tree
    assert not tree.coupled
    np.testing.assert_allclose(tree.posture_precision, np.diag(1.0 / tree.spread**2), rtol=1e-12)
    np.testing.assert_array_equal(tree.posture_std, tree.spread)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("first = 0.5", "fist = 0.5", "no coordinate 'fist'"),
        ("spread = 4\n", "spread = 0\n", "spread 0"),
        ("first = 0.5, s1 = -1.0", "", "weights"),
        ("first = 0.5", "first = nan", "weights"),
        ("first = 0.5", "slide = 0.5", "slides"),
        ("first = 0.5", "s2 = 0.5", "the middle axis of a ball joint"),
        ("first = 0.5", "s3 = 0.5", "without its own spread"),
    ],
)
def test_couplings_that_cannot_be_are_refused(old, new, said):
    assert old in TWO_JOINTS
    with pytest.raises(BodyError, match="coupling") as caught:
        parse_body(TWO_JOINTS.replace(old, new), "two.toml")
    assert said in str(caught.value)


def test_a_body_keeps_its_couplings_in_files_and_as_parts_come_and_go():
    body = load_body("humanoid")
    arrays = body_to_arrays(body)
    np.testing.assert_array_equal(body_from_arrays(arrays).tree.couplings, body.tree.couplings)
    del arrays["couplings"]  # a file of before there were any
    assert not body_from_arrays(arrays).tree.coupled
    box = TaperedCylinder.round(0, (0.0, -0.3, 0.0), (0.1, 0.1))
    joint = PartJoint(coordinates=("lid",), axes=((0.0, 0.0, 1.0),))
    more = with_part(body, "bag", parent="hand_r", surfaces=box, joint=joint)
    assert more.tree.couplings.shape == (1, len(body.tree.coordinates) + 1)
    np.testing.assert_array_equal(without_part(more, "bag").tree.couplings, body.tree.couplings)
    two = parse_body(TWO_JOINTS)
    assert not without_part(two, "a").tree.coupled  # half a coupling says nothing
    assert without_part(two, "c").tree.coupled


def test_a_base_lends_its_couplings():
    own, base = (load_body(name).tree for name in ("humanoid_morphing", "humanoid"))
    assert own.coupled
    for name in ("lumbar_extension", "hip_flexion_l"):
        assert np.isclose(own.posture_std[own.coordinate(name)], base.posture_std[base.coordinate(name)])


def test_the_spine_bends_with_the_hips():
    """Where trunk and thighs are bent against each other, what is most likely is a share of it in the spine."""
    body = load_body("humanoid")
    tree, n = body.tree, len(body.tree.coordinates)
    bend = np.zeros(n)
    for name, part in (("lumbar_extension", -0.82), ("thorax_extension", -0.53), ("hip_flexion_r", 0.5)):
        bend[tree.coordinate(name)] = part
    bend[tree.coordinate("hip_flexion_l")] = 0.5
    covariance = np.linalg.inv(tree.posture_precision)
    likely = np.degrees(covariance @ bend / (bend @ covariance @ bend) * np.radians(90.0))
    spine = -0.82 * likely[tree.coordinate("lumbar_extension")] - 0.53 * likely[tree.coordinate("thorax_extension")]
    assert 24.0 < spine < 33.0


def test_prior_rows_are_those_of_the_gaussian():
    tree = parse_body(TWO_JOINTS).tree
    body = parse_body(TWO_JOINTS)
    state = BodyState(np.eye(4), np.random.default_rng(0).normal(0.0, 0.3, len(tree.coordinates)))
    rows = prior_rows(body, state)
    away = state.angles - tree.usual
    assert np.isclose(rows.residual @ rows.weight @ rows.residual, away @ tree.posture_precision @ away)
    assert 6 + tree.coordinate("s3") not in rows.index
