"""Free space and collisions: nearest cells against scipy, gaps against a dense search, and what both are for."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt
from tests.oracle import posture, random_body

from kinefit.bodies import Body, BodyState, KinematicTree, PointSet, load_body
from kinefit.bodies.parts import PartJoint, box, with_part
from kinefit.bodies.surfaces import TaperedCylinder
from kinefit.errors import BodyError, ObservationError
from kinefit.geometry.camera import Camera
from kinefit.solving.correspondences import collision_rows, free_space_rows
from kinefit.solving.correspondences.occupancy._kernels_space import capsule_gaps
from kinefit.solving.correspondences.occupancy.free_space import FreeSpace, SurfaceSamples, _capsules, collision_pairs
from kinefit.solving.least_squares import gauss_newton

CAMERA = Camera("depth", (320, 240), [[250.0, 0, 159.5], [0, 250.0, 119.5], [0, 0, 1]])


@given(st.integers(0, 10_000), st.sampled_from([0.001, 0.02, 0.3, 0.9]))
@settings(max_examples=25, deadline=None)
def test_nearest_cells_are_the_nearest(seed, share):
    random = np.random.default_rng(seed)
    depth = np.where(random.random((48, 64)) < share, 1.0, 5.0).astype(np.float32)
    depth[random.integers(48), random.integers(64)] = 1.0
    nearest = FreeSpace.of(depth, farthest=2.0, columns=64).nearest
    exact = distance_transform_edt(depth > 2.0)
    row, column = np.divmod(nearest, 64)
    assert np.all(depth[row, column] == 1.0)
    found = np.hypot(row - np.arange(48)[:, None], column - np.arange(64))
    np.testing.assert_allclose(found, exact, atol=1e-12)


def test_a_cell_holds_the_body_where_half_of_it_is_near_enough_and_holes_do_not_count():
    depth = np.full((8, 640), 5.0, np.float32)
    depth[:4, 40:44] = [1.0, 1.0, 5.0, 5.0]
    depth[4:6, 60:62], depth[6:, 60:62] = 1.0, 0.0  # a quarter
    space = FreeSpace.of(depth, farthest=2.0)
    assert space.cell == 4 and space.nearest.shape == (2, 160)
    assert set(np.unique(space.nearest)) == {10}
    depth[:4, 40] = 0.0
    assert np.all(FreeSpace.of(depth, farthest=2.0).nearest == -1)


def one_point(x, normal=(0.0, 0.0, -1.0)):
    """A body of one free segment and a sample on it, at x [m] in the world (the camera's frame)."""
    none = np.zeros(0)
    tree = KinematicTree(("s",), [-1], np.zeros((1, 3)), (), none, none.reshape(0, 3), none, none, none, none, none)
    points = PointSet(("p",), np.zeros(1), np.zeros((1, 3)))
    samples = SurfaceSamples(np.zeros(1), np.array(x, float)[:, None], np.array(normal, float)[:, None])
    return Body("point", tree, ("root",), ("s",), np.zeros(1, int), points), samples


def frames(body, state):
    return body.tree.forward(state.T_world_root, state.angles)[0]


def seen(person=2.0, behind=4.0):
    """A depth image of a person 40 pixels wide before a wall."""
    depth = np.full((240, 320), behind, np.float32)
    depth[40:200, 100:140] = person
    return depth


@pytest.mark.parametrize(
    "x, normal, rows",
    [
        ((0.2, 0.0, 2.0), (0, 0, -1), 1),  # beside the person: the wall is seen there
        ((0.2, 0.0, 2.0), (0, 0, 1), 0),  # turned away
        ((-0.3, 0.0, 2.0), (0, 0, -1), 0),  # on the person
        ((0.9, 0.0, 2.0), (0, 0, -1), 0),  # too far beside the person
        ((0.2, 0.0, 3.95), (0, 0, -1), 0),  # as far as the wall
        ((-0.3, 0.0, 3.0), (0, 0, -1), 0),  # behind the person
        ((3.0, 0.0, 2.0), (0, 0, -1), 0),  # beside the image
        ((0.2, 0.0, -2.0), (0, 0, 1), 0),  # behind the camera
    ],
)
def test_only_what_stands_in_free_space_makes_a_row(x, normal, rows):
    body, samples = one_point(x, normal)
    space = FreeSpace.of(seen(), farthest=2.5)
    assert len(free_space_rows(frames(body, body.rest_state()), samples, space, CAMERA)) == rows


def test_a_hole_makes_no_row():
    body, samples = one_point((0.2, 0.0, 2.0))
    space = FreeSpace.of(np.where(seen() > 3.0, 0.0, seen()).astype(np.float32), farthest=2.5)
    assert len(free_space_rows(frames(body, body.rest_state()), samples, space, CAMERA)) == 0


def test_a_sample_goes_sideways_to_the_outline():
    body, samples = one_point((0.2, 0.0, 2.0))
    space = FreeSpace.of(seen(), farthest=2.5)
    state = body.rest_state()
    rows = free_space_rows(frames(body, state), samples, space, CAMERA)
    np.testing.assert_allclose(rows.direction[0], [-1, 0, 0.2], atol=0.25)
    for _ in range(4):
        rows = free_space_rows(frames(body, state), samples, space, CAMERA)
        state = gauss_newton(body, state, rows).state if len(rows) else state
    uv = CAMERA.project(body.positions(state, PointSet(("p",), np.zeros(1), samples.point.T)))
    assert abs(uv[0, 0] - 139.5) <= space.cell and abs(uv[0, 1] - 119.5) < space.cell


def test_a_limb_astray_goes_to_where_one_is_missing():
    """Not to the trunk beside it, which the body as it stands explains; but an outline's sample goes nowhere far."""
    depth = seen()
    depth[100:120, 230:260] = 2.0  # a limb that nothing explains
    shown = np.full((120, 160), np.inf, np.float32)
    shown[20:100, 50:70] = 2.02
    near, space = FreeSpace.of(depth, farthest=2.5), FreeSpace.of(depth, farthest=2.5, shown=shown)
    assert np.all(near.missing == -1)
    rows, columns = np.divmod(np.unique(space.missing), 160)
    assert rows.min() >= 50 and rows.max() < 60 and columns.min() >= 115 and columns.max() < 130
    body, samples = one_point((0.2, 0.0, 2.0))  # 45 px right of the trunk, 45 px left of the limb
    for one, way in ((near, -1), (space, 1)):
        rows = free_space_rows(frames(body, body.rest_state()), samples, one, CAMERA)
        assert np.sign(rows.direction[0, 0]) == way
    body, samples = one_point((-0.13, 0.0, 2.0))  # 4 px beside the trunk
    rows = free_space_rows(frames(body, body.rest_state()), samples, space, CAMERA)
    assert rows.direction[0, 0] < 0 and rows.residual[0] < 0.05
    everything = FreeSpace.of(seen(), farthest=2.5, shown=shown)
    assert np.all(everything.missing == -1)


def test_free_space_refuses_what_makes_no_sense():
    body, samples = one_point((0.2, 0.0, 2.0))
    for farthest in (0.0, np.nan):
        with pytest.raises(ObservationError, match="farthest"):
            FreeSpace.of(seen(), farthest=farthest)
    with pytest.raises(ObservationError, match="shape"):
        FreeSpace.of(np.zeros(3), farthest=2.0)
    space = FreeSpace.of(seen(), farthest=2.5)
    with pytest.raises(ObservationError, match="camera depth"):
        free_space_rows(frames(body, body.rest_state()), samples, space, CAMERA.scaled((160, 120)))
    with pytest.raises(ObservationError, match="deviation"):
        free_space_rows(frames(body, body.rest_state()), samples, space, CAMERA, sigma=-1.0)


def test_gaps_of_capsules_are_the_least_distances():
    random = np.random.default_rng(4)
    starts, ends = random.normal(size=(2, 24, 3))
    ends[:3] = starts[:3]  # points
    ends[3:6] = starts[3:6] + (ends[0] - starts[7])
    starts[8:10], ends[8:10] = starts[6:8] + 0.3, ends[6:8] + 0.3  # parallel
    pairs = np.array(np.triu_indices(24, 1)).T.copy()
    frames = np.tile(np.r_[np.eye(3).ravel(), 0, 0, 0], (24, 1))
    a, b, n = np.empty((3, len(pairs), 3))
    distance = np.empty(len(pairs))
    capsule_gaps(frames, np.arange(24), starts, ends, pairs, a, b, n, distance)
    t = np.linspace(0, 1, 201)[:, None]
    for k, (i, j) in enumerate(pairs):
        p, q = starts[i] + t * (ends[i] - starts[i]), starts[j] + t * (ends[j] - starts[j])
        dense = np.sqrt((np.square(p).sum(1)[:, None] + np.square(q).sum(1) - 2 * p @ q.T).clip(0).min())
        assert dense - 0.03 < distance[k] < dense + 1e-6
    np.testing.assert_allclose(a - b, n * distance[:, None], atol=1e-12)


def test_crossing_axes_part_along_their_perpendicular():
    starts, ends = np.array([[-1.0, 0, 0], [0, -1.0, 0]]), np.array([[1.0, 0, 0], [0, 1.0, 0]])
    a, b, n = np.empty((3, 1, 3))
    distance = np.empty(1)
    frames = np.tile(np.r_[np.eye(3).ravel(), 0, 0, 0], (2, 1))
    capsule_gaps(frames, np.arange(2), starts, ends, np.array([[0, 1]]), a, b, n, distance)
    assert distance[0] == 0.0
    np.testing.assert_allclose(np.abs(n[0]), [0, 0, 1])


@pytest.mark.parametrize("name", ["humanoid", "humanoid10"])
def test_a_body_at_rest_and_in_usual_posture_does_not_collide(name):
    body = load_body(name)
    for state in (body.default_state(), body.rest_state()):
        assert len(collision_rows(body, state)) == 0


def test_an_arm_in_the_trunk_is_pushed_out_and_then_left_alone():
    body = load_body("humanoid")
    angles = np.array(body.default_state().angles)
    angles[body.tree.coordinate("arm_add_r")] = np.radians(25.0)
    state = BodyState(np.eye(4), angles)
    first = collision_rows(body, state)
    thorax, arm = body.tree.segment("thorax"), body.tree.segment("upperarm_r")
    assert {thorax, arm} in [set(p) for p in first.segments.tolist()]
    assert first.residual.max() > 0.02
    for _ in range(20):
        rows = collision_rows(body, state)
        if not len(rows) or rows.residual.max() < 1e-3:
            break
        state = gauss_newton(body, state, [rows]).state
    assert not len(rows) or rows.residual.max() < 1e-3


def test_a_mesh_gets_the_capsule_along_its_longest_side():
    body = with_part(load_body("humanoid"), "bar", parent="hand_r", surfaces=box((0.1, 1.0, 0.1)), joint=PartJoint())
    segment, starts, ends, radius = _capsules(body)
    k = list(segment).index(body.tree.segment("bar"))
    at = body.tree.rest[body.tree.segment("bar")]
    np.testing.assert_allclose(np.sort([starts[k, 1] - at[1], ends[k, 1] - at[1]]), [radius[k] - 0.5, 0.5 - radius[k]])
    np.testing.assert_allclose([starts[k, [0, 2]], ends[k, [0, 2]]], [at[[0, 2]]] * 2, atol=1e-6)
    assert 0.04 < radius[k] < 0.08


def test_pairs_may_be_named():
    body = load_body("humanoid")
    pairs = collision_pairs(body, [("forearm_r", "thorax"), ("forearm_l", "thorax")])
    names = {frozenset(body.tree.segments[s] for s in pairs.segment[p]) for p in pairs.pairs}
    assert names == {frozenset(("forearm_r", "thorax")), frozenset(("forearm_l", "thorax"))}
    with pytest.raises(BodyError, match="segment 'tail'"):
        collision_pairs(body, [("tail", "thorax")])
    bare = replace(body, surfaces=tuple(s for s in body.surfaces if s.segment != body.tree.segment("thorax")))
    with pytest.raises(BodyError, match="no surface of thorax"):
        collision_pairs(bare, [("forearm_r", "thorax")])
    with pytest.raises(ObservationError, match="deviation"):
        collision_rows(body, body.default_state(), sigma=0.0)


def test_a_body_without_surfaces_does_not_collide():
    body = random_body(1)
    assert len(collision_rows(body, body.default_state())) == 0


def test_several_surfaces_of_one_segment_do_not_push_each_other():
    body = load_body("humanoid10")
    twin = TaperedCylinder.round(3, (0.0, 0.1, 0.0), (0.05, 0.05))
    body = replace(body, surfaces=(*body.surfaces, twin, twin))
    pairs = collision_pairs(body)
    assert not np.any(pairs.segment[pairs.pairs[:, 0]] == pairs.segment[pairs.pairs[:, 1]])
    assert len(collision_rows(body, posture(body, share=0.0))) == 0
