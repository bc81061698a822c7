"""Parts come and go; what stays moves as before, and a state is carried over by names."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.oracle import central_differences, posture, random_body, slow_positions, state_of

from kinefit.bodies import BodyState, PointSet, load_body
from kinefit.bodies.parts import PartJoint, box, carry_dofs, carry_state, with_part, with_surfaces, without_part
from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.errors import BodyError, KinefitError

HINGE = PartJoint(
    at=(0.0, -0.08, 0.0), coordinates=("swing",), axes=((0.0, 0.0, 2.0),), lower=(-1.0,), upper=(1.0,), usual=(0.2,),
    spread=(0.5,),
)  # fmt: skip
CORNERS = {"corner_a": (0.1, -0.1, 0.1), "corner_b": (-0.1, -0.1, 0.1)}


def carrying():
    body = load_body("humanoid")
    crate = box((0.3, 0.2, 0.2))
    return body, with_part(body, "crate", parent="hand_r", surfaces=crate, joint=HINGE, landmarks=CORNERS)


def test_a_part_moves_with_its_parent_and_its_own_joint():
    body, more = carrying()
    old = posture(body, seed=2)
    state = carry_state(old, body, more)
    assert state.angles[-1] == 0.2 and more.tree.coordinates[-1] == "swing"
    np.testing.assert_array_equal(more.tree.axes[-1], [0, 0, 1])
    np.testing.assert_allclose(more.positions(state, body.landmarks), body.positions(old, body.landmarks), atol=1e-12)
    corners = more.landmarks.select(tuple(CORNERS))
    np.testing.assert_allclose(more.positions(state, corners), slow_positions(more, state, corners), atol=1e-12)
    _, screws = more.tree.forward(state.T_world_root, state.angles)
    J = more.tree.segment_jacobian(screws, more.tree.segment("crate"))
    origin = state.T_world_root[:3, 3]
    x = more.positions(state, corners)
    slow = central_differences(lambda s: more.positions(s, corners), more, state)
    for k in range(2):
        by_twist = J[:3] + np.cross(J[3:].T, x[k] - origin).T
        np.testing.assert_allclose(by_twist, slow[k], atol=1e-7)


def test_added_and_taken_away_is_as_before():
    body, more = carrying()
    again = without_part(more, "crate")
    for name in ("segments", "coordinates", "root_free"):
        assert getattr(again.tree, name) == getattr(body.tree, name)
    for name in ("parents", "offsets", "owners", "axes", "prismatic", "lower", "upper", "usual", "spread"):
        np.testing.assert_array_equal(getattr(again.tree, name), getattr(body.tree, name))
    assert again.surfaces == body.surfaces and again.scale_groups == body.scale_groups
    assert again.landmarks.names == body.landmarks.names and again.joints == body.joints
    np.testing.assert_array_equal(again.segment_scale, body.segment_scale)


def test_a_part_of_the_body_itself_may_go_while_it_is_observed():
    body = load_body("humanoid")
    less = without_part(body, "hand_r")
    assert "hand_r" not in less.tree.segments and len(less.surfaces) == len(body.surfaces) - 1
    assert len(less.tree.coordinates) == len(body.tree.coordinates) - np.sum(
        body.tree.owners == body.tree.segment("hand_r")
    )
    state = posture(body, seed=3)
    carried = carry_state(state, body, less)
    kept = body.landmarks.select(less.landmarks.names)
    np.testing.assert_allclose(less.positions(carried, less.landmarks), body.positions(state, kept), atol=1e-12)
    for surface in less.surfaces:
        name = less.tree.segments[surface.segment]
        assert surface.radii in [s.radii for s in body.surfaces if s.segment == body.tree.segment(name)]
    assert all("hand_r" not in names for names in less.aliases.values())
    less.scaled(np.full(len(less.scale_groups), 1.1))  # what depends on all of them still fits together


@given(st.integers(0, 500))
@settings(max_examples=30, deadline=None)
def test_any_leaf_of_any_tree_can_go(seed):
    body = random_body(seed, 7)
    leaf = next(s for k, s in enumerate(body.tree.segments) if k and k not in body.tree.parents)
    less = without_part(body, leaf)
    state = state_of(body, "random", seed)
    carried = carry_state(state, body, less)
    kept = body.landmarks.select(less.landmarks.names)
    np.testing.assert_allclose(less.positions(carried, less.landmarks), body.positions(state, kept), atol=1e-12)


def test_values_are_carried_by_name():
    body, more = carrying()
    values = np.arange(body.tree.n_dofs, dtype=float)
    np.testing.assert_array_equal(carry_dofs(values, body, more, missing=9.0), np.append(values, 9.0))
    np.testing.assert_array_equal(carry_dofs(carry_dofs(values, body, more), more, body), values)


def test_surfaces_of_one_segment_are_replaced():
    body = load_body("humanoid")
    new = TaperedCylinder(0, (0, 0, 0), (0, 0.3, 0), ((0.1, 0.2), (0.1, 0.15)))
    changed = with_surfaces(body, "thorax", [new, box((0.1, 0.1, 0.1))])
    thorax = body.tree.segment("thorax")
    own = [s for s in changed.surfaces if s.segment == thorax]
    assert len(own) == 2 and own[0].radii == new.radii
    assert [s for s in changed.surfaces if s.segment != thorax] == [s for s in body.surfaces if s.segment != thorax]
    assert not [s for s in with_surfaces(body, "thorax", []).surfaces if s.segment == thorax]


def test_a_box_is_closed_and_outward():
    shape = box((0.3, 0.2, 0.1), (0.0, 1.0, 0.0))
    corners = shape.vertices[shape.faces]
    edges = {(a, b) for face in shape.faces.tolist() for a, b in zip(face, face[1:] + face[:1])}
    assert len(edges) == 3 * len(shape.faces) and edges == {(b, a) for a, b in edges}
    volume = np.einsum("ti,ti->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume == pytest.approx(0.006)
    np.testing.assert_allclose([shape.vertices.min(0), shape.vertices.max(0)], [[-0.15, 0.9, -0.05], [0.15, 1.1, 0.05]])


def refused():
    body, more = carrying()
    crate = box((0.1, 0.1, 0.1))
    hinge = {"coordinates": ("swing",), "axes": ((0.0, 0.0, 1.0),)}
    return {
        "'pelvis' is the root": lambda: without_part(body, "pelvis"),
        "it has the children": lambda: without_part(body, "thorax"),
        "no segment 'tail'": lambda: without_part(body, "tail"),
        "no segment 'paw'": lambda: with_part(body, "crate", parent="paw", surfaces=crate),
        "segment 'crate' exists": lambda: with_part(more, "crate", parent="hand_l", surfaces=crate),
        "coordinate 'swing' exists": lambda: with_part(
            more, "bag", parent="hand_l", surfaces=crate, joint=PartJoint(**hinge)
        ),
        "landmark 'corner_a' exists": lambda: with_part(
            more, "bag", parent="hand_l", surfaces=crate, landmarks={"corner_a": (0, 0, 0)}
        ),
        "axes of its joint": lambda: with_part(
            body, "bag", parent="hand_l", surfaces=crate, joint=PartJoint(coordinates=("a",))
        ),
        "lower of its joint": lambda: with_part(
            body, "bag", parent="hand_l", surfaces=crate, joint=PartJoint(**hinge, lower=(0.0, 1.0))
        ),
        "an axis of its joint has no direction": lambda: with_part(
            body, "bag", parent="hand_l", surfaces=crate,
            joint=PartJoint(coordinates=("a",), axes=((0.0, 0.0, 0.0),)),
        ),
        "usual values": lambda: with_part(
            body, "bag", parent="hand_l", surfaces=crate, joint=PartJoint(**hinge, lower=(0.5,))
        ),
        "landmark is not finite": lambda: with_part(
            body, "bag", parent="hand_l", surfaces=crate, landmarks={"a": (np.nan, 0, 0)}
        ),
        "a box of the size": lambda: box((0.1, 0.0, 0.1)),
        "a state with 1 angles": lambda: carry_state(BodyState(np.eye(4), np.zeros(1)), body, more),
        "values of shape": lambda: carry_dofs(np.zeros(3), body, more),
    }  # fmt: skip


@pytest.mark.parametrize("message", list(refused()))
def test_what_makes_no_sense_is_refused(message):
    with pytest.raises(KinefitError, match=message) as caught:
        refused()[message]()
    assert isinstance(caught.value, BodyError)


def test_an_empty_set_of_points_is_left_where_all_were_on_the_part():
    _, more = carrying()
    only = PointSet(("corner",), [more.tree.segment("crate")], np.zeros((1, 3)))
    more = type(more)(**{**{f: getattr(more, f) for f in more.__dataclass_fields__}, "marker_sets": {"crate": only}})
    assert len(without_part(more, "crate").markers("crate")) == 0
