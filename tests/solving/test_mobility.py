"""Gruebler's count beside rank and mobility; closures that cannot be met."""

from dataclasses import replace

import pytest
from tests.solving.test_closed import LEG

from kinefit.bodies import load_body, parse_body
from kinefit.errors import BodyError
from kinefit.solving.mobility import check_closed, mobility

GEAR = {"cyclist": 29, "golfer": 44, "rower": 36, "snowboarder": 41, "weight_lifter": 45}


@pytest.mark.parametrize("name", GEAR)
def test_bodies_with_gear_move_as_gruebler_says(name):
    m = mobility(load_body(name))
    assert m.agrees and m.mobility == GEAR[name] == m.open_dofs - m.rank and not m.redundant


def test_a_tree_has_all_its_freedoms():
    m = mobility(load_body("arm"))
    assert (m.links, m.open_dofs, m.gruebler, m.rank, m.mobility) == (3, 7, 7, 0, 7)


def test_a_planar_linkage_in_space_is_over_constrained():
    """Three links, three hinges and a point: F = 0 in space, but the plane's third equation says nothing."""
    m = mobility(parse_body(LEG))
    assert (m.gruebler, m.rank, m.mobility, m.equations) == (0, 2, 1, 3) and not m.agrees
    (text,) = m.redundant
    assert text == "closure 'foot' has 3 equations, of which 2 are independent of the others (in question: along z)"


def test_in_its_plane_the_pedal_is_a_four_bar_linkage_of_one_freedom():
    """N = 3, g = 4: F = 3 (3 - 4) + 4 = 1."""
    m = mobility(parse_body(LEG), planar=True)
    assert (m.links, m.joints, m.equations, m.gruebler, m.rank, m.mobility) == (3, 4, 2, 1, 2, 1)
    assert m.agrees and not m.redundant


ROD = LEG.replace('to = "pedal"', "at = [0.1, 0.7, 0.0]").replace('mode = "hard"', 'kind = "line"\naxis = "y"')
HOLDS = 'name = "axis", type = "revolute", at = [0.0, 0.6, 0.0], axes = ["z"]'
BAR = """
[[segment]]
name = "bar"
parent = "shank"
joint = { name = "ankle", type = "revolute", at = [0.0, 0.2, 0.0], axes = ["z"] }

[landmarks]
"""
FIVE_BARS = LEG.replace("\n[landmarks]\n", BAR).replace('foot = { segment = "shank"', 'foot = { segment = "bar"')


@pytest.mark.parametrize(
    "text, links, joints, freedoms",
    [
        (ROD, 3, 4, 2),  # a slider and crank of thigh and shank, and the crank of the pedal, which turns freely
        (LEG.replace(HOLDS, HOLDS.replace("revolute", "fixed").replace(', axes = ["z"]', "")), 3, 4, 0),
        (FIVE_BARS.replace("0.3, 0.0] }", "0.1, 0.0] }"), 4, 5, 2),
        (LEG.replace('mode = "hard"', 'kind = "rigid"\nmode = "hard"'), 3, 4, 0),
    ],
)
def test_planar_linkages_move_as_gruebler_says(text, links, joints, freedoms):
    m = mobility(parse_body(text), planar=True)
    assert (m.links, m.joints, m.gruebler, m.mobility) == (links, joints, freedoms, freedoms)


def test_a_body_that_leaves_the_plane_has_no_planar_count():
    with pytest.raises(BodyError, match="'snowboarder' does not move in a plane"):
        mobility(load_body("snowboarder"), planar=True)
    with pytest.raises(BodyError, match="does not move in a plane"):
        mobility(parse_body(LEG.replace('name = "hip", type = "revolute", axes = ["z"]', HIP)), planar=True)


HIP = 'name = "hip", type = "revolute", axes = ["x"]'


def test_a_closure_that_is_said_twice_is_named():
    body = load_body("snowboarder")
    again = replace(body, closures=(*body.closures, replace(body.closures[0], name="again")))
    m = mobility(again)
    assert (m.gruebler, m.rank, m.mobility) == (35, 6, 41)
    assert [line.split("'")[1] for line in m.redundant] == ["left boot", "again"]


def test_closures_that_contradict_each_other_are_told_with_what_is_left():
    far = parse_body(LEG.replace("at = [0.0, 0.6, 0.0]", "at = [0.0, 1.6, 0.0]"))
    for test in (check_closed, mobility):
        with pytest.raises(BodyError, match="contradict each other.*'foot' by 700.0 mm"):
            test(far)


def test_soft_closures_may_be_off_by_their_deviation():
    text = LEG.replace("at = [0.0, 0.6, 0.0]", "at = [0.0, 1.6, 0.0]")
    check_closed(parse_body(text.replace('mode = "hard"', "sigma = 1.0")))
    with pytest.raises(BodyError, match="contradict"):
        check_closed(parse_body(text.replace('mode = "hard"', "sigma = 0.1")))


def test_a_chain_that_cannot_move_is_told():
    held = LEG + '[[closure]]\nname = "stop"\npoint = "joint"\nat = [-0.1, 0.43874822, 0.0]\nmode = "hard"\n'
    with pytest.raises(BodyError, match="leave no motion"):
        check_closed(parse_body(held))
