"""Every body of the catalogue is made well."""

import numpy as np
import pytest

from kinefit.bodies import BodyState, catalogue, load_body
from kinefit.bodies.surfaces import Metaballs
from kinefit.geometry import se3
from kinefit.readers.landmarks.keypoint_sets import HAND_POINTS, keypoint_names

FINGERS = ("thumb", "index", "middle", "ring", "little")


@pytest.fixture(params=catalogue())
def body(request):
    return load_body(request.param)


def other_side(name):
    if name[-2:] in ("_l", "_r"):
        return name[:-2] + {"_l": "_r", "_r": "_l"}[name[-2:]]
    return {"l_": "r_", "r_": "l_"}[name[:2]] + name[2:] if name[:2] in ("l_", "r_") else name


def test_the_catalogue_holds_what_the_documentation_names():
    assert {"humanoid", "humanoid10", "arm"} <= set(catalogue())


def test_counts():
    parts = {name: load_body(name) for name in ("humanoid", "humanoid10", "arm")}
    assert {name: (len(b.tree.segments), b.tree.n_dofs) for name, b in parts.items()} == {
        "humanoid": (20, 47), "humanoid10": (10, 25), "arm": (4, 13)}
    assert [parts[name].tree.root_free for name in parts] == [True, True, False]


def test_all_segments_hang_together(body):
    parents = body.tree.parents
    assert parents[0] == -1 and np.all(parents[1:] >= 0) and np.all(parents[1:] < np.arange(1, len(parents)))
    assert len(set(body.tree.segments)) == len(body.tree.segments)


def test_the_rest_pose_is_within_the_limits(body):
    assert np.all(body.tree.lower < body.tree.upper)
    assert np.all((body.tree.lower <= 0) & (body.tree.upper >= 0))
    assert np.array_equal(body.rest_state().angles, np.zeros(len(body.tree.coordinates)))


def test_bodies_with_two_sides_are_symmetric_in_every_pose(body):
    if other_side(body.tree.segments[-1]) not in body.tree.segments or body.closures:
        assert body.name in ("arm", "arm_metaballs") or body.gear_scale.any()
        return
    random = np.random.default_rng(0)
    angles = random.uniform(np.maximum(body.tree.lower, -2), np.minimum(body.tree.upper, 2))
    names = body.tree.coordinates
    mirrored = angles[[names.index(other_side(name)) for name in names]]
    middle = np.array([other_side(name) == name for name in names])
    flips = np.abs(body.tree.axes[:, 2]) < 0.5  # turns about x and y change their sign in the mirror
    mirrored = np.where(middle & flips, -mirrored, mirrored)
    points = body.landmarks
    order = [points.index(other_side(name)) for name in points.names]
    a = body.positions(BodyState(np.eye(4), angles), points)
    b = body.positions(BodyState(np.eye(4), mirrored), points)[order]
    np.testing.assert_allclose(a, b * (1, 1, -1), atol=1e-12)


def test_keypoints_are_those_of_their_detectors(body):
    for name, points in body.keypoint_sets.items():
        if name != "BODY_25":
            assert set(points.names) <= set(keypoint_names(name)), name
    assert len(body.keypoints("COCO_17")) == (3 if body.name.startswith("arm") else 17)


def test_sets_with_hands_are_known_to_every_body_and_their_hands_to_one_with_fingers(body):
    for name, of in (("MEDIAPIPE_75", "MEDIAPIPE_33"), ("BODY_25_HANDS", "BODY_25"), ("COCO_WHOLEBODY_133", "COCO_17")):
        if of not in body.keypoint_sets:
            assert name not in body.keypoint_sets
            continue
        plain, more = set(body.keypoints(of).names), set(body.keypoints(name).names)
        hands = set(keypoint_names(name)[-2 * HAND_POINTS :])
        assert plain <= more and more & hands == (hands if body.name == "humanoid_hands" else set())


def test_surfaces_end_at_the_next_joint_or_within_the_body(body):
    ends = body.segment_ends()
    for limb in body.surfaces:
        gear = body.gear_scale[body.segment_scale[limb.segment]]
        end = ends[limb.segment] if isinstance(limb, Metaballs) else limb.end
        shortest = 0.015 if body.tree.segments[limb.segment].startswith(FINGERS) else 0.03
        assert np.min(limb.radii) > 0 and (gear or shortest < np.linalg.norm(end) < 0.7)


def test_screws_agree_with_central_differences(body):
    random = np.random.default_rng(1)
    low, high = np.maximum(body.tree.lower, -2), np.minimum(body.tree.upper, 2)
    T = se3.exp(random.normal(size=6))
    state = BodyState(T, random.uniform(low, high))
    _, screws = body.tree.forward(state.T_world_root, state.angles)
    origin, h = T[:3, 3], 1e-6
    x = body.positions(state, body.landmarks)
    expected, found = np.empty((2, len(x), 3, body.tree.n_dofs))
    for k, segment in enumerate(body.landmarks.segments):
        J = body.tree.segment_jacobian(screws, segment)
        found[k] = J[:3] + np.cross(J[3:].T, x[k] - origin).T
    for d in range(body.tree.n_dofs):
        delta = np.zeros(body.tree.n_dofs)
        delta[d] = h
        after, before = (body.positions(state.retract(s * delta), body.landmarks) for s in (1, -1))
        expected[..., d] = (after - before) / (2 * h)
    np.testing.assert_allclose(found, expected, atol=1e-8)


def test_joints_of_small_bodies_lie_where_the_humanoid_has_them():
    humanoid = load_body("humanoid")
    for name in ("humanoid10", "arm"):
        body = load_body(name)
        shared = [p for p in body.landmarks.names if p in humanoid.landmarks.names]
        a, b = (m.points_rest(m.landmarks.select(tuple(shared))) for m in (humanoid, body))
        if name == "arm":
            a, b = a - a[shared.index("r_shoulder")], b - b[shared.index("r_shoulder")]
        np.testing.assert_allclose(a, b, atol=0.02)
