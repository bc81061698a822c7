"""Bodies: named points, lengths that scale, and their form as arrays."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import posture, random_body

from kinefit.bodies import BodyState, MeshSurface, PointSet, TaperedCylinder, load_body
from kinefit.bodies.serial import body_from_arrays, body_to_arrays
from kinefit.errors import BodyError
from kinefit.geometry import se3

HUMANOID = load_body("humanoid")


def test_names_are_found_or_the_choices_told():
    assert len(HUMANOID.keypoints("COCO_17")) == 17
    with pytest.raises(BodyError, match=r"keypoint set of body 'humanoid' named 'COCO17'; there are: .*COCO_17"):
        HUMANOID.keypoints("COCO17")
    with pytest.raises(BodyError, match="marker set of body 'humanoid' named 'x'; there are"):
        HUMANOID.markers("x")
    with pytest.raises(BodyError, match=r"no point 'l_kne'; there are: .*l_knee"):
        HUMANOID.landmarks.index("l_kne")
    assert HUMANOID.alias("opensim", "shank_r") == "tibia_r"
    assert HUMANOID.alias("nowhere", "shank_r") == "shank_r"


def test_select_keeps_the_order_asked_for():
    chosen = HUMANOID.landmarks.select(("l_knee", "r_hip", "l_knee"))
    assert chosen.names == ("l_knee", "r_hip", "l_knee")
    whole = HUMANOID.landmarks
    np.testing.assert_array_equal(chosen.points[1], whole.points[whole.index("r_hip")])
    assert [HUMANOID.tree.segments[s] for s in chosen.segments] == ["shank_l", "thigh_r", "shank_l"]


def test_degrees_of_freedom_have_names():
    assert HUMANOID.dof_names[:7] == (
        "root_tx",
        "root_ty",
        "root_tz",
        "root_rx",
        "root_ry",
        "root_rz",
        "lumbar_extension",
    )
    assert len(set(HUMANOID.dof_names)) == HUMANOID.tree.n_dofs


def test_the_default_state_has_its_old_name_too():
    assert np.array_equal(HUMANOID.usual_state().angles, HUMANOID.default_state().angles)


def test_the_rest_state_is_within_the_limits():
    state = HUMANOID.rest_state(se3.exp(np.arange(6.0)))
    assert np.all(state.angles >= HUMANOID.tree.lower) and np.all(state.angles <= HUMANOID.tree.upper)
    np.testing.assert_array_equal(state.T_world_root, se3.exp(np.arange(6.0)))


@pytest.mark.parametrize("factor", [0.6, 1.3])
def test_one_scale_for_all_makes_a_similar_body(factor):
    scaled = HUMANOID.scaled(np.full(len(HUMANOID.scale_groups), factor))
    state = posture(HUMANOID, 3)
    at_origin = BodyState(se3.transform(state.T_world_root[:3, :3], np.zeros(3)), state.angles)
    for points, stretched in (
        (HUMANOID.landmarks, scaled.landmarks), (HUMANOID.keypoints("BODY_25B"), scaled.keypoints("BODY_25B")),
    ):  # fmt: skip
        np.testing.assert_allclose(
            scaled.positions(at_origin, stretched), factor * HUMANOID.positions(at_origin, points), atol=1e-12
        )
    assert scaled.stature == pytest.approx(factor * HUMANOID.stature)
    for a, b in zip(HUMANOID.surfaces, scaled.surfaces, strict=True):
        np.testing.assert_allclose(b.end, factor * np.array(a.end))
        np.testing.assert_allclose(b.radii, factor * np.array(a.radii))


def test_a_scale_group_stretches_its_own_lengths_on_both_sides():
    group = HUMANOID.scale_groups.index("thigh")
    scales = np.ones(len(HUMANOID.scale_groups))
    scales[group] = 1.25
    before, after = HUMANOID.segment_lengths(), HUMANOID.scaled(scales).segment_lengths()
    changed = {name: after[name] / before[name] for name in before if abs(after[name] - before[name]) > 1e-12}
    assert changed == {"thigh_r-shank_r": pytest.approx(1.25), "thigh_l-shank_l": pytest.approx(1.25)}


def test_left_and_right_share_every_scale():
    groups = dict(zip(HUMANOID.tree.segments, HUMANOID.segment_scale, strict=True))
    for name, group in groups.items():
        if name.endswith("_r"):
            assert groups[name[:-2] + "_l"] == group


def test_scaling_twice_is_scaling_by_the_product():
    random = np.random.default_rng(0)
    a, b = random.uniform(0.7, 1.4, (2, len(HUMANOID.scale_groups)))
    twice, once = HUMANOID.scaled(a).scaled(b), HUMANOID.scaled(a * b)
    np.testing.assert_allclose(twice.tree.offsets, once.tree.offsets, atol=1e-15)
    np.testing.assert_allclose(twice.landmarks.points, once.landmarks.points, atol=1e-15)
    assert twice.stature == pytest.approx(once.stature)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_scales_must_be_positive(bad):
    scales = np.ones(len(HUMANOID.scale_groups))
    scales[2] = bad
    with pytest.raises(BodyError, match=r"positive numbers.*One for each of: pelvis"):
        HUMANOID.scaled(scales)
    with pytest.raises(BodyError, match="positive numbers"):
        HUMANOID.scaled(np.ones(2))


def test_keypoints_can_be_learnt():
    points = np.array(HUMANOID.keypoints("COCO_17").points) + 0.01
    body = HUMANOID.with_keypoints("COCO_17", points)
    np.testing.assert_array_equal(body.keypoints("COCO_17").points, points)
    assert body.keypoints("COCO_17").names == HUMANOID.keypoints("COCO_17").names
    np.testing.assert_array_equal(body.keypoints("BODY_25B").points, HUMANOID.keypoints("BODY_25B").points)


def test_points_are_frozen_copies():
    points = np.zeros((1, 3))
    held = PointSet(("a",), np.array([0]), points)
    points[0, 0] = 9
    assert held.points[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        held.points[0, 0] = 1


@pytest.mark.parametrize("body", [HUMANOID, load_body("arm"), random_body(3, root_free=False)], ids=lambda b: b.name)
def test_a_body_as_arrays_comes_back_the_same(body):
    back = body_from_arrays(body_to_arrays(body))
    state = posture(body, 1)
    np.testing.assert_array_equal(back.positions(state, back.landmarks), body.positions(state, body.landmarks))
    for name in ("segments", "coordinates", "root_free"):
        assert getattr(back.tree, name) == getattr(body.tree, name)
    for name in ("parents", "owners", "axes", "prismatic", "lower", "upper", "usual", "spread", "offsets"):
        np.testing.assert_array_equal(getattr(back.tree, name), getattr(body.tree, name))
    assert (back.name, back.joints, back.scale_groups, back.stature) == (
        body.name,
        body.joints,
        body.scale_groups,
        body.stature,
    )
    assert set(back.keypoint_sets) == set(body.keypoint_sets) and back.surfaces == body.surfaces
    assert {c: dict(n) for c, n in back.aliases.items()} == {c: dict(n) for c, n in body.aliases.items()}


def test_surfaces_of_all_kinds_come_back_in_their_order():
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]])
    mesh = MeshSurface(1, corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))
    ellipse = TaperedCylinder(2, (0.1, 0, 0), (0, 0.3, 0.1), ((0.1, 0.2), (0.05, 0.04)), (0.3, 0.2, 0.9))
    body = replace(HUMANOID, surfaces=(ellipse, mesh, HUMANOID.surfaces[0]))
    back = body_from_arrays(body_to_arrays(body)).surfaces
    assert back[0] == ellipse and back[2] == HUMANOID.surfaces[0] and back[1].segment == 1
    np.testing.assert_array_equal(back[1].vertices, corners)
    np.testing.assert_array_equal(back[1].faces, mesh.faces)


def test_round_surfaces_of_older_files_are_read():
    arrays = body_to_arrays(HUMANOID)
    arrays = {k: v for k, v in arrays.items() if k not in ("surfaces/starts", "surfaces/sides")}
    count = len(HUMANOID.surfaces)
    arrays["surfaces/radii"] = np.linspace(0.05, 0.1, 2 * count).reshape(count, 2)
    for k, surface in enumerate(body_from_arrays(arrays).surfaces):
        assert surface.start == (0.0, 0.0, 0.0) and surface.end == HUMANOID.surfaces[k].end and surface.is_round
        assert surface.mean_radii == pytest.approx(arrays["surfaces/radii"][k])


def test_arrays_that_are_no_body_are_told():
    arrays = body_to_arrays(HUMANOID)
    with pytest.raises(BodyError, match="no array 'offsets'"):
        body_from_arrays({k: v for k, v in arrays.items() if k != "offsets"})
    with pytest.raises(BodyError, match="array 'axes' has shape"):
        body_from_arrays(arrays | {"axes": arrays["axes"][:3]})
    with pytest.raises(BodyError, match=r"landmarks/segments.*0 to 19"):
        body_from_arrays(arrays | {"landmarks/segments": arrays["landmarks/segments"] + 5})
