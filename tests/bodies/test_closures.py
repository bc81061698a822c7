"""Closures and dimensions of body files: what they say, what they become on other bodies, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import load_body, parse_body
from kinefit.bodies.parts import has_unknown_gear, known_gear, with_dimensions, without_part
from kinefit.bodies.serial import body_from_arrays, body_to_arrays
from kinefit.bodies.toml.bodies import catalogue_text
from kinefit.errors import BodyError

LAMP = """
[body]
name = "lamp"
mirror = true

[[segment]]
name = "base"
joint = { name = "stand", type = "free" }

[[segment]]
name = "arm_r"
parent = "base"
joint = { name = "shoulder_r", type = "revolute", at = [0.0, 0.0, 0.2], axes = ["z"] }

[[segment]]
name = "rod"
parent = "arm_r"
scale = "fixed"
joint = { name = "pin", type = "ball", at = [0.0, 0.5, 0.0], axes = ["x", "y", "z"] }

[usual]
shoulder_r = 30

[landmarks]
r_tip = { segment = "arm_r", at = [0.0, 0.5, 0.0] }
rod_end = { segment = "rod", at = [0.0, 0.0, -0.4] }

[[closure]]
name = "rod end"
point = "l_tip"
to = "rod_end"
"""


def test_a_body_of_the_catalogue_can_be_copied_and_changed(tmp_path):
    text = catalogue_text("snowboarder")
    path = tmp_path / "snowboarder.toml"
    path.write_text(text.replace("value = 0.52", 'value = "estimate"'))
    mine, whole = load_body(path), load_body("snowboarder")
    assert has_unknown_gear(mine) and not has_unknown_gear(whole)
    assert [d.std for d in mine.dimensions] == [0.06, 0.0]
    assert whole.closures == mine.closures and whole.closures[0].hard
    assert not has_unknown_gear(known_gear(mine))


def test_a_posture_is_stated_once_for_both_sides():
    body = parse_body(LAMP)
    names = body.tree.coordinates
    assert np.degrees(body.tree.usual[[names.index("shoulder_r"), names.index("shoulder_l")]]) == pytest.approx(30)


def test_closures_of_one_side_have_an_image():
    floor = '[[closure]]\nname = "floor_r"\nkind = "plane"\npoint = "r_tip"\nat = [0.0, 0.0, 0.1]\naxis = [0, 1, 1]\n'
    right, left = parse_body(LAMP + floor).closures[1:]
    assert (right.point, left.point) == ("r_tip", "l_tip") and left.name == "floor_l"
    np.testing.assert_allclose(np.array(left.axis) * np.sqrt(2), [0.0, 1.0, -1.0])


def test_gear_is_not_stretched_with_the_person():
    body = load_body("weight_lifter")
    taller = body.scaled(np.full(len(body.scale_groups), 1.1))
    bar = taller.landmarks.select(("bar_left", "l_grip")).points
    np.testing.assert_allclose(bar, body.landmarks.select(("bar_left", "l_grip")).points * [[1.0], [1.1]])


def test_dimensions_move_what_they_name():
    body = load_body("cyclist")
    longer = with_dimensions(body, {"crank length": 0.18, "saddle height": 0.76})
    crank = longer.tree.offsets - body.tree.offsets
    moved = {longer.tree.segments[s]: crank[s] for s in np.flatnonzero(np.abs(crank).max(axis=1) > 0)}
    assert set(moved) == {"left_crank", "left_pedal"}
    np.testing.assert_allclose(list(moved.values()), [[0.0, 0.01, 0.0]] * 2, atol=1e-12)
    saddle = longer.landmarks.select(("saddle",)).points - body.landmarks.select(("saddle",)).points
    np.testing.assert_allclose(saddle, [[-0.0028, 0.0096, 0.0]])
    boots = with_dimensions(load_body("snowboarder"), {"boot angle": np.radians(25.0)})
    np.testing.assert_allclose(np.degrees(boots.closures[0].turn), [0.0, 25.0, 0.0], atol=1e-9)
    back = with_dimensions(longer, {"crank length": 0.17, "saddle height": 0.75})
    np.testing.assert_allclose(back.tree.offsets, body.tree.offsets, atol=1e-15)


def test_keypoints_and_markers_on_a_landmark_go_where_a_dimension_moves_it():
    body = load_body("snowboarder")
    marks = replace(body.landmarks.select(("left_binding", "r_knee")), names=("a", "b"))
    body = replace(body, keypoint_sets={"K": marks}, marker_sets={"M": marks})
    wider = with_dimensions(body, {"boot distance": 0.55})
    for points in (wider.keypoints("K"), wider.markers("M")):
        np.testing.assert_allclose(points.points - marks.points, [[0.0, 0.0, -0.03], [0.0, 0.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize("name", ["cyclist", "snowboarder"])
def test_saved_bodies_keep_their_closures(name):
    body = load_body(name)
    again = body_from_arrays(body_to_arrays(body))
    assert again.closures == body.closures and again.dimensions == body.dimensions


def test_a_part_that_goes_takes_its_closures_along():
    body = without_part(load_body("snowboarder"), "board")
    assert not body.closures


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('point = "l_tip"', 'point = "tip"', "closure rod end: no landmark 'tip'.*r_tip"),
        ('to = "rod_end"', 'to = "rod"', "closure rod end: no landmark 'rod'"),
        ('to = "rod_end"', "", "one of them is needed"),
        ('to = "rod_end"', 'to = "rod_end"\nat = "estimate"', "one of them is needed"),
        ('to = "rod_end"', 'at = "somewhere"', "three numbers in metres, or \"estimate\""),
        ('to = "rod_end"', 'to = "rod_end"\nkind = "glue"', "no kind of closure 'glue'"),
        ('to = "rod_end"', 'to = "rod_end"\nmode = "stiff"', "no mode 'stiff'"),
        ('to = "rod_end"', 'to = "rod_end"\nkind = "line"', "axis None.*lines and planes"),
        ('to = "rod_end"', 'to = "rod_end"\nkind = "line"\naxis = [0, 0, 0]', "no direction"),
        ('to = "rod_end"', 'to = "rod_end"\nturn = [0, 0, 9]', "only rigid closures"),
        ('to = "rod_end"', 'to = "rod_end"\nmode = "hard"\nsigma = 0.1', "cannot have a standard deviation"),
        ('to = "rod_end"', 'to = "rod_end"\nsigma = 0.0', "positive"),
        ('point = "l_tip"', 'point = "rod_end"', "of one segment"),
        ('name = "rod end"', 'name = "rod end"\nstrength = 3', "not a body file.*strength"),
        ("shoulder_r = 30", "elbow_r = 30", "usual elbow_"),
    ],
)
def test_wrong_closures_are_told(old, new, told):
    assert old in LAMP
    with pytest.raises(BodyError, match=told):
        parse_body(LAMP.replace(old, new))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"moves": '["rod_ends"]'}, "nothing of the body"),
        ({"moves": "[]"}, "moves nothing"),
        ({"along": ""}, "one of them is needed"),
        ({"about": "about = [0, 1, 0]"}, "one of them is needed"),
        ({"along": "", "about": "about = [0, 1, 0]"}, "Angles turn rigid closures"),
        ({"value": '"guess"'}, "a number, or \"estimate\""),
        ({"value": '"estimate"', "std": ""}, "with std = None"),
        ({"moves": '["rod end"]'}, "shifts closure"),
        ({"value": "nan"}, "not finite"),
        ({"value": "-inf"}, "not finite"),
        ({"along": "along = [1e308, 0, 0]", "value": "9.0"}, "not a dimension"),
    ],
)
def test_wrong_dimensions_are_told(changes, told):
    given = {
        "value": "0.4", "moves": '["rod_end"]', "along": "along = [0, 0, -1]", "about": "", "std": "std = 0.1"
    } | changes
    text = '[[dimension]]\nname = "length"\nvalue = {value}\ndrawn = 0.4\nmoves = {moves}\n{along}\n{about}\n{std}\n'
    with pytest.raises(BodyError, match=told):
        parse_body(LAMP + text.format(**given))


def test_a_dimension_that_is_no_number_is_told():
    body = load_body("cyclist")
    with pytest.raises(BodyError, match="of nan"):
        with_dimensions(body, {body.dimensions[0].name: float("nan")})
