"""Body files: what they say becomes a body, and what is wrong in them is told with file, place and remedy."""

# ruff: noqa: E501  (joints are told in one line)

import numpy as np
import pytest

from kinefit.bodies import BodyState, catalogue, load_body, parse_body
from kinefit.errors import BodyError
from kinefit.geometry import se3

ROBOT = """
[body]
name = "robot"
stature = 1.0

[[segment]]
name = "base"
joint = { name = "world", type = "free" }

[[segment]]
name = "arm"
parent = "base"
scale = "limb"
joint = { name = "shoulder", type = "universal", at = [0.1, 0.5, 0.0], axes = ["z", [0.0, 2.0, 0.0]], coordinates = ["lift", "turn"], range = [[-90, 45], [-10, 20]], spread = [30, 5] }
surface = { end = [0.0, 0.3, 0.0], radii = [0.05, 0.04] }
names = { bvh = "Arm" }

[[segment]]
name = "slide"
parent = "arm"
joint = { name = "rail", type = "prismatic", at = [0.0, 0.3, 0.0], axes = ["-y"], range = [[0.0, 0.2]] }

[[segment]]
name = "tool"
parent = "slide"
joint = { name = "flange", type = "fixed", at = [0.0, 0.0, 0.1] }

[landmarks]
tip = { segment = "tool", at = [0.0, 0.0, 0.05] }
elbow = { segment = "slide", at = [0.0, 0.0, 0.0] }

[keypoints.CAM]
Tip = "tip"

[markers.SET]
points = ["tip"]
placed = { m1 = { segment = "arm", at = [0.0, 0.1, 0.05] } }
"""


def test_a_file_becomes_a_body(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT, encoding="utf-8")
    body = load_body(path)
    tree = body.tree
    assert (body.name, body.stature, tree.root_free) == ("robot", 1.0, True)
    assert tree.segments == ("base", "arm", "slide", "tool") and list(tree.parents) == [-1, 0, 1, 2]
    assert body.joints == ("world", "shoulder", "rail", "flange")
    assert tree.coordinates == ("lift", "turn", "rail") and list(tree.prismatic) == [False, False, True]
    np.testing.assert_allclose(tree.axes, [[0, 0, 1], [0, 1, 0], [0, -1, 0]])
    np.testing.assert_allclose(tree.lower, [-np.pi / 2, np.radians(-10), 0.0])
    np.testing.assert_allclose(tree.upper, [np.pi / 4, np.radians(20), 0.2])
    np.testing.assert_allclose(tree.spread, [np.radians(30), np.radians(5), 0.1])
    np.testing.assert_allclose(tree.rest[-1], [0.1, 0.8, 0.1])
    np.testing.assert_array_equal(tree.usual, 0.0)
    assert body.scale_groups == ("base", "limb", "slide", "tool")
    assert body.markers("SET").names == ("tip", "m1") and body.keypoints("CAM").names == ("Tip",)
    assert body.alias("bvh", "arm") == "Arm" and body.surfaces[0].segment == 1


def test_the_usual_posture():
    given = ROBOT.replace("spread = [30, 5]", "usual = [-30, 10]").replace("[[0.0, 0.2]]", "[[0.1, 0.2]]")
    body = parse_body(given)
    np.testing.assert_allclose(
        body.tree.usual, [np.radians(-30), np.radians(10), 0.1]
    )  # zero, or what is nearest to it
    np.testing.assert_array_equal(body.default_state().angles, body.tree.usual)


def test_joints_move_as_their_axes_say():
    body = parse_body(ROBOT)
    tip = lambda *angles: body.positions(BodyState(np.eye(4), np.array(angles)), body.landmarks.select(("tip",)))[0]
    np.testing.assert_allclose(tip(0, 0, 0), [0.1, 0.8, 0.15], atol=1e-15)
    np.testing.assert_allclose(tip(0, 0, 0.2), [0.1, 0.6, 0.15], atol=1e-15)
    np.testing.assert_allclose(tip(np.pi / 2, 0, 0), [-0.2, 0.5, 0.15], atol=1e-15)
    np.testing.assert_allclose(tip(0, np.pi / 2, 0), [0.25, 0.8, 0.0], atol=1e-15)


def test_every_type_of_joint():
    types = {"fixed": 0, "revolute": 1, "prismatic": 1, "universal": 2, "ball": 3, "free": 6}
    for kind, count in types.items():
        axes = "" if kind == "free" else f", axes = {['x', 'y', 'z'][: min(count, 3)]}".replace("'", '"')
        text = f"""
        [body]
        name = "two"
        [[segment]]
        name = "a"
        joint = {{ name = "ja", type = "fixed" }}
        [[segment]]
        name = "b"
        parent = "a"
        joint = {{ name = "jb", type = "{kind}"{axes} }}
        """
        tree = parse_body(text).tree
        assert len(tree.coordinates) == count and not tree.root_free
        assert tree.prismatic.sum() == {"prismatic": 1, "free": 3}.get(kind, 0)
        assert np.all(np.isinf(tree.lower)) and np.all(np.isinf(tree.spread))


def test_segments_may_stand_in_any_order():
    head, *segments = ROBOT.split("[[segment]]")
    last, *rest = segments[-1].split("[landmarks]")
    shuffled = head + "".join("[[segment]]" + s for s in [last, segments[1], segments[2], segments[0]])
    body, other = parse_body(ROBOT), parse_body(shuffled + "[landmarks]" + rest[0])
    assert other.tree.segments == body.tree.segments
    np.testing.assert_array_equal(other.tree.rest, body.tree.rest)


def changed(old, new):
    assert old in ROBOT
    return ROBOT.replace(old, new, 1)


# what is wrong: (text, parts of the message, place or None)
BAD = {
    "unknown parent": (changed('parent = "slide"', 'parent = "sled"'), ("no segment 'sled'", "base, arm, slide, tool"), "segment tool"),
    "cycle": (changed('parent = "base"', 'parent = "slide"'), ("arm, slide, tool", "cycle", "end at the root"), None),
    "itself as parent": (changed('parent = "slide"', 'parent = "tool"'), ("tool", "cycle"), None),
    "two roots": (changed('parent = "slide"\n', ""), ("exactly one segment without a parent", "base, tool", "Give the others"), None),
    "not the root": (changed('name = "base"\n', 'name = "base"\nparent = "tool"\n'), ("without a parent", "none"), None),
    "zero axis": (changed("[0.0, 2.0, 0.0]", "[0.0, 0.0, 0.0]"), ("turn", "no direction", "not all zero"), "joint shoulder"),
    "axis not finite": (changed("[0.0, 2.0, 0.0]", "[0.0, inf, 0.0]"), ("turn", "no direction"), "joint shoulder"),
    "axis not a number": (changed("[0.0, 2.0, 0.0]", "[0.0, nan, 0.0]"), ("turn", "no direction"), "joint shoulder"),
    "axis unknown": (changed('axes = ["-y"]', 'axes = ["up"]'), ("'up'", "no direction", '"-y"'), "joint rail"),
    "place not finite": (changed("at = [0.1, 0.5, 0.0]", "at = [0.1, nan, 0.0]"), ("finite",), "joint shoulder"),
    "landmark not finite": (changed("at = [0.0, 0.0, 0.05]", "at = [0.0, 0.0, inf]"), ("finite",), "landmark tip"),
    "segment twice": (changed('name = "tool"', 'name = "slide"'), ("segment named twice: slide",), None),
    "joint twice": (changed('name = "flange"', 'name = "rail"'), ("joint named twice: rail",), None),
    "coordinate twice": (changed('"lift", "turn"', '"lift", "lift"'), ("coordinate named twice: lift",), None),
    "marker twice": (changed("m1 =", "tip ="), ("marker named twice: tip",), "markers.SET"),
    "too few axes": (changed('axes = ["-y"], ', ""), ("prismatic joint has 1", "here 0, 1, 1, 0 and 0"), "joint rail"),
    "too many axes": (changed('axes = ["-y"]', 'axes = ["-y", "x"]'), ("prismatic joint has 1", "here 2, 1, 1, 0 and 0"), "joint rail"),
    "too few coordinates": (changed('["lift", "turn"]', '["lift"]'), ("universal joint has 2", "2, 1, 2, 0 and 2"), "joint shoulder"),
    "too few ranges": (changed("range = [[-90, 45], [-10, 20]]", "range = [[-90, 45]]"), ("universal", "2, 2, 1, 0 and 2"), "joint shoulder"),
    "too many spreads": (changed("spread = [30, 5]", "spread = [30, 5, 1]"), ("universal", "2, 2, 2, 0 and 3"), "joint shoulder"),
    "empty range": (changed("[-10, 20]", "[20, -10]"), ("range", "turn", "empty"), "joint shoulder"),
    "spread of zero": (changed("spread = [30, 5]", "spread = [30, 0]"), ("spread", "turn", "not positive"), "joint shoulder"),
    "usual beyond the range": (changed("spread = [30, 5]", "usual = [0, 25]"), ("usual 25", "turn", "-10.0 to 20.0"), "joint shoulder"),
    "usual not finite": (changed('axes = ["-y"], range = [[0.0, 0.2]]', 'axes = ["-y"], usual = [inf]'), ("usual inf", "rail"), "joint rail"),
    "unknown type": (changed('"prismatic"', '"slider"'), ("no joint type 'slider'", "prismatic"), "joint rail"),
    "landmark without segment": (changed('tip = { segment = "tool"', 'tip = { segment = "tol"'), ("no segment 'tol'", "tool"), "landmark tip"),
    "keypoint without landmark": (changed('Tip = "tip"', 'Tip = "top"'), ("no landmark 'top'", "tip, elbow"), "keypoints.CAM.Tip"),
    "marker without landmark": (changed('points = ["tip"]', 'points = ["top"]'), ("no landmark 'top'",), "markers.SET"),
    "marker without segment": (changed('m1 = { segment = "arm"', 'm1 = { segment = "leg"'), ("no segment 'leg'",), "m1"),
    "bad TOML": (changed("[body]", "[body"), ("not TOML", "line 2"), None),
    "unknown key": (changed("stature", "statur"), ("unknown field `statur`", "docs/"), "body"),
    "unknown key of a joint": (changed("axes = [\"-y\"]", "axis = [\"-y\"]"), ("unknown field `axis`",), "segment[2].joint"),
    "missing key": (changed('name = "flange", ', ""), ("missing required field `name`",), "segment[3].joint"),
    "wrong type of value": (changed("stature = 1.0", 'stature = "tall"'), ("float", "str"), "body.stature"),
    "no segments": ('segment = []\n[body]\nname = "x"\n', ("exactly one", "none"), None),
    "root placed": (changed('name = "world", type = "free"', 'name = "world", type = "free", at = [0.0, 1.0, 0.0]'), ("root", "origin"), "joint world"),
}  # fmt: skip


@pytest.mark.parametrize("what", BAD)
def test_what_is_wrong_is_told_with_file_place_and_remedy(what, tmp_path):
    text, parts, place = BAD[what]
    path = tmp_path / "robot.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(BodyError) as caught:
        load_body(path)
    error = caught.value
    message = str(error)
    assert str(error.file) == str(path) and str(path) in message
    for part in parts:
        assert part in message, message
    if place:
        assert error.place and place in error.place, message
    assert error.remedy and error.remedy in message, message


def test_a_file_that_cannot_be_read(tmp_path):
    with pytest.raises(BodyError, match=r"nowhere\.toml.*cannot read") as caught:
        load_body(tmp_path / "nowhere.toml")
    assert caught.value.remedy
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(BodyError, match=r"binary\.toml.*cannot read"):
        load_body(binary)


@pytest.mark.parametrize("name", ["humanoids", "", "../humanoid", "person.yaml"])
def test_a_body_that_the_catalogue_lacks(name):
    with pytest.raises(BodyError) as caught:
        load_body(name)
    for known in catalogue():
        assert known in str(caught.value)
    assert ".toml" in caught.value.remedy


SIDES = """
[body]
name = "sides"
mirror = true

[[segment]]
name = "trunk"
joint = { name = "root", type = "free" }

[[segment]]
name = "leg_r"
parent = "trunk"
scale = "leg"
joint = { name = "hip_r", type = "ball", at = [0.01, -0.1, 0.2], axes = ["z", "x", [0.3, 0.8, -0.4]], coordinates = ["flex_r", "add_r", "rot_r"], range = [[-30, 90], [-20, 40], [-10, 20]] }
surface = { end = [0.0, -0.4, 0.02], radii = [0.1, 0.05] }
names = { bvh = "RightUpLeg", hanim = "r_hip" }

[[segment]]
name = "ski_r"
parent = "leg_r"
joint = { name = "binding_r", type = "free", at = [0.1, -0.4, 0.03] }

[[segment]]
name = "pole_r"
parent = "leg_r"
joint = { name = "grip_r", type = "prismatic", at = [0.0, -0.2, 0.1], axes = [[0.1, 0.5, 0.7]] }

[landmarks]
nose = { segment = "trunk", at = [0.1, 0.5, 0.0] }
r_ear = { segment = "trunk", at = [0.0, 0.5, 0.1] }
r_knee = { segment = "leg_r", at = [0.02, -0.3, 0.05] }
ski_tip_r = { segment = "ski_r", at = [0.8, 0.0, 0.1] }
pole_tip_r = { segment = "pole_r", at = [0.0, -0.8, 0.3] }
"""


def other_side(name):
    return {"r": "l", "l": "r"}[name[0]] + name[1:] if name[1] == "_" else name[:-1] + {"r": "l", "l": "r"}[name[-1]]


def test_the_left_side_is_the_mirror_image_of_the_right():
    body = parse_body(SIDES)
    tree = body.tree
    assert {"leg_l", "ski_l", "pole_l"} <= set(tree.segments) and {"l_ear", "l_knee", "ski_tip_l"} <= set(
        body.landmarks.names
    )
    assert body.landmarks.names.count("nose") == 1
    right = [c for c in tree.coordinates if "_r" in c]
    left = [c.replace("_r", "_l") for c in right]
    assert sorted(right + left) == sorted(tree.coordinates)
    for a, b in zip(right, left, strict=True):
        for name in ("lower", "upper", "spread"):
            values = getattr(tree, name)
            assert values[tree.coordinate(a)] == values[tree.coordinate(b)]
    random = np.random.default_rng(0)
    angles = np.zeros((2, len(tree.coordinates)))
    for a, b in zip(right, left, strict=True):
        p, q = random.uniform(-1, 1, 2)
        angles[0, [tree.coordinate(a), tree.coordinate(b)]] = p, q
        angles[1, [tree.coordinate(a), tree.coordinate(b)]] = q, p
    here, there = (body.positions(BodyState(np.eye(4), a), body.landmarks) for a in angles)
    order = [body.landmarks.index(n if n == "nose" else other_side(n)) for n in body.landmarks.names]
    np.testing.assert_allclose(here, there[order] * (1, 1, -1), atol=1e-14)


def test_names_and_surfaces_are_mirrored_too():
    body = parse_body(SIDES)
    assert body.alias("bvh", "leg_l") == "LeftUpLeg" and body.alias("hanim", "leg_l") == "l_hip"
    assert body.surfaces[1].end == (0.0, -0.4, -0.02)
    assert body.scale_groups.count("leg") == 1
    assert body.segment_scale[body.tree.segment("leg_l")] == body.segment_scale[body.tree.segment("leg_r")]


def test_ellipses_and_several_surfaces_of_a_segment_are_read_and_mirrored():
    ellipse = "start = [0.0, 0.1, 0.05], end = [0.0, -0.4, 0.02], radii = [[0.1, 0.2], 0.05], side = [0.5, 0.0, 0.2]"
    text = SIDES.replace("{ end = [0.0, -0.4, 0.02], radii = [0.1, 0.05] }",
                         f"[\n  {{ {ellipse} }},\n  {{ end = [0.1, 0.0, 0.0], radii = [0.01, 0.02] }},\n]")  # fmt: skip
    body = parse_body(text)
    assert len(body.surfaces) == 4
    right, left = body.surfaces[0], body.surfaces[2]
    assert right.radii == left.radii == ((0.1, 0.2), (0.05, 0.05))
    assert left.start == (0.0, 0.1, -0.05) and left.segment == body.tree.segment("leg_l")
    np.testing.assert_allclose(np.array(left.side) * (1, 1, -1), right.side)
    np.testing.assert_array_equal(body.segment_ends()[right.segment], right.end)  # the first one's


@pytest.mark.parametrize("bad", ["end = [0, 0, 0]", "radii = [0.1, 0.0]", "radii = [[0.1, -0.1], 0.1]", "side = [0, 1, 0]"])
def test_a_surface_that_cannot_be_is_told_with_its_place(bad):
    good = {"end": "end = [0, -0.4, 0]", "radii": "radii = [0.1, 0.05]", "side": "side = [1, 0, 0]"}
    entry = ", ".join((good | {bad.split(" ")[0]: bad}).values())
    with pytest.raises(BodyError) as error:
        parse_body(SIDES.replace("end = [0.0, -0.4, 0.02], radii = [0.1, 0.05]", entry), "my.toml")
    assert (error.value.file, error.value.place) == ("my.toml", "surface of segment leg_r") and error.value.remedy


def test_what_is_given_for_the_left_is_kept():
    text = SIDES + 'l_ear = { segment = "trunk", at = [0.0, 0.4, -0.3] }\n'
    points = parse_body(text).landmarks
    np.testing.assert_array_equal(points.points[points.index("l_ear")], [0.0, 0.4, -0.3])


def test_a_bad_axis_of_a_mirrored_joint_is_told():
    for bad in ("q", "xyz", "up"):
        with pytest.raises(BodyError, match="no direction"):
            parse_body(SIDES.replace('axes = ["z", "x"', f'axes = ["{bad}", "x"'))


def test_the_pose_of_a_fixed_root_is_given_by_the_state():
    body = load_body("arm")
    T = se3.exp(np.arange(6.0) / 5)
    shoulder = body.positions(body.rest_state(T), body.landmarks.select(("r_shoulder",)))
    np.testing.assert_allclose(shoulder[0], T[:3, 3], atol=1e-15)
