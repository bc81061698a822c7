"""Kinematic trees against a slow product of matrix exponentials, and against central differences."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import STATES, central_differences, posture, random_body, slow_motions, slow_positions, state_of

from kinefit.bodies import BodyState, KinematicTree, load_body
from kinefit.errors import BodyError
from kinefit.geometry import lines, se3

BODIES = {
    "random 0": lambda: random_body(0),
    "random 1": lambda: random_body(1, 14),
    "all sliding": lambda: random_body(2, prismatic=1.0),
    "fixed root": lambda: random_body(3, root_free=False),
    "humanoid": lambda: load_body("humanoid"),
}


@pytest.fixture(params=BODIES)
def body(request):
    return BODIES[request.param]()


@pytest.mark.parametrize("kind", STATES)
def test_forward_kinematics_is_the_product_of_exponentials(body, kind):
    state = state_of(body, kind)
    expected = slow_motions(body.tree, state)
    frames, _ = body.tree.forward(state.T_world_root, state.angles)
    np.testing.assert_allclose(frames[:, :9].reshape(-1, 3, 3), expected[:, :3, :3], atol=1e-13)
    np.testing.assert_allclose(frames[:, 9:], expected[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(
        body.positions(state, body.landmarks), slow_positions(body, state, body.landmarks), atol=1e-12
    )


def test_segment_poses_of_many_frames(body):
    states = [state_of(body, "random", seed) for seed in range(5)]
    roots, angles = np.stack([s.T_world_root for s in states]), np.stack([s.angles for s in states])
    Ts = body.tree.segment_poses(roots, angles)
    for T, state in zip(Ts, states, strict=True):
        expected = slow_motions(body.tree, state) @ se3.transform(np.eye(3), body.tree.rest)
        np.testing.assert_allclose(T, expected, atol=1e-12)
    moved = body.trajectories(roots, angles, body.landmarks)
    np.testing.assert_allclose(moved, [body.positions(s, body.landmarks) for s in states], atol=1e-12)


@pytest.mark.parametrize("kind", STATES)
def test_segment_jacobian_agrees_with_central_differences(body, kind):
    state = state_of(body, kind)
    _, screws = body.tree.forward(state.T_world_root, state.angles)
    x, centre = body.positions(state, body.landmarks), state.T_world_root[:3, 3]
    expected = central_differences(lambda s: body.positions(s, body.landmarks), body, state)
    for k, segment in enumerate(body.landmarks.segments):
        J = body.tree.segment_jacobian(screws, segment)
        moves = J[:3] + np.cross(J[3:].T, x[k] - centre).T
        np.testing.assert_allclose(moves, expected[k], atol=2e-8)


def test_segment_jacobian_turns_frames_too(body):
    """The turning part of J, by central differences of the segments' rotations."""
    state = state_of(body, "random")
    _, screws = body.tree.forward(state.T_world_root, state.angles)
    R = body.tree.segment_poses(state.T_world_root[None], state.angles[None])[0, :, :3, :3]

    def turns(s):
        R_new = body.tree.segment_poses(s.T_world_root[None], s.angles[None])[0, :, :3, :3]
        return se3.log_so3(R_new @ np.swapaxes(R, 1, 2))

    expected = central_differences(turns, body, state)
    for s in range(len(R)):
        np.testing.assert_allclose(body.tree.segment_jacobian(screws, s)[3:], expected[s], atol=1e-8)


def descendants(tree, segment):
    out = {segment}
    for s in range(segment + 1, len(tree.segments)):
        if tree.parents[s] in out:
            out.add(s)
    return out


def test_a_joint_moves_only_what_is_beyond_it(body):
    state = state_of(body, "random")
    before = body.positions(state, body.landmarks)
    for d in range(len(body.tree.coordinates)):
        angles = np.array(state.angles)
        angles[d] += 0.4
        after = body.positions(BodyState(state.T_world_root, angles), body.landmarks)
        beyond = np.isin(body.landmarks.segments, list(descendants(body.tree, int(body.tree.owners[d]))))
        assert np.array_equal(after[~beyond], before[~beyond])
        assert np.all(np.linalg.norm(after - before, axis=1)[beyond] <= 3.0)
        if body.tree.prismatic[d]:
            np.testing.assert_allclose(np.linalg.norm((after - before)[beyond], axis=1), 0.4, atol=1e-12)


def test_distances_within_a_segment_stay(body):
    a = body.positions(state_of(body, "random", 1), body.landmarks)
    b = body.positions(state_of(body, "random", 2), body.landmarks)
    segments = body.landmarks.segments
    i, j = np.nonzero(segments[:, None] == segments[None, :])
    np.testing.assert_allclose(np.linalg.norm(a[i] - a[j], axis=1), np.linalg.norm(b[i] - b[j], axis=1), atol=1e-12)


@pytest.mark.parametrize("kind", STATES)
def test_the_axis_of_a_joint_moves_like_a_line(body, kind):
    """P1-3: Ψ' = M Ψ M̃: a screw at a state is the line of its axis at rest, moved by all joints before it."""
    tree, state = body.tree, state_of(body, kind)
    _, screws = tree.forward(state.T_world_root, state.angles)
    for d in np.flatnonzero(~tree.prismatic):
        stopped = np.array(state.angles)
        stopped[d:][tree.owners[d:] == tree.owners[d]] = 0.0  # the motion up to this axis
        T = slow_motions(tree, BodyState(state.T_world_root, stopped))[tree.owners[d]]
        rest = lines.line_along(tree.rest[tree.owners[d]], tree.axes[d])
        moved = lines.move_line(T, rest)
        here = state.T_world_root[:3, 3]
        expected = np.concatenate([moved[3:] - np.cross(here, moved[:3]), moved[:3]])  # moment about the root's origin
        np.testing.assert_allclose(screws[d], expected, atol=1e-12)


def test_motion_of_the_world_moves_everything_alike(body):
    state, T = state_of(body, "random"), se3.exp(np.random.default_rng(9).normal(size=6))
    moved = BodyState(T @ state.T_world_root, state.angles)
    np.testing.assert_allclose(
        body.positions(moved, body.landmarks), se3.apply(T, body.positions(state, body.landmarks)), atol=1e-12
    )


def test_pattern_of_the_degrees_of_freedom(body):
    """`dof_parent` and `last_dof` lead from a segment through all that moves it, and through nothing else."""
    tree, state = body.tree, state_of(body, "random")
    _, screws = tree.forward(state.T_world_root, state.angles)
    assert list(tree.dof_parent[:6]) == [-1, 0, 1, 2, 3, 4]
    for s in range(len(tree.segments)):
        chain, d = set(), tree.last_dof[s]
        while d >= 0:
            chain.add(int(d))
            d = tree.dof_parent[d]
        ancestors = [a for a in range(len(tree.segments)) if s in descendants(tree, a)]
        assert chain == set(range(6)) | {6 + int(d) for d in np.flatnonzero(np.isin(tree.owners, ancestors))}
        moving = set(np.flatnonzero(np.abs(tree.segment_jacobian(screws, s)).max(axis=0) > 0).tolist())
        assert moving == chain


def test_rest_is_the_sum_of_offsets():
    tree = random_body(0).tree
    for s, parent in enumerate(tree.parents[1:], start=1):
        np.testing.assert_array_equal(tree.rest[s], tree.rest[parent] + tree.offsets[s])


def test_names_are_found_or_the_choices_told():
    tree = load_body("humanoid").tree
    assert tree.segments[tree.segment("shank_l")] == "shank_l"
    assert tree.coordinates[tree.coordinate("knee_angle_l")] == "knee_angle_l"
    with pytest.raises(BodyError, match=r"no segment 'shin'; there are: pelvis, .*shank_l"):
        tree.segment("shin")
    with pytest.raises(BodyError, match=r"no coordinate 'knee'; there are: .*knee_angle_r"):
        tree.coordinate("knee")


def test_a_tree_out_of_order_is_refused():
    tree = random_body(0).tree
    with pytest.raises(BodyError, match=r"not in order.*parents before"):
        replace(tree, parents=np.r_[-1, 5, tree.parents[2:]])
    with pytest.raises(BodyError, match="not in order"):
        replace(tree, owners=tree.owners[::-1])


def test_arrays_are_read_only():
    tree = random_body(0).tree
    for name in ("parents", "offsets", "axes", "lower", "rest", "dof_parent", "last_dof", "dof_start"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(tree, name)[0] = 1


def test_a_tree_without_joints_is_a_rigid_body():
    empty = np.empty(0)
    tree = KinematicTree(("thing",), np.array([-1]), np.zeros((1, 3)), (), *[empty] * 7)
    T = se3.exp(np.arange(6.0) / 3)
    frames, screws = tree.forward(T, empty)
    assert tree.n_dofs == 6 and screws.shape == (0, 6)
    np.testing.assert_allclose(frames[0], np.r_[T[:3, :3].ravel(), T[:3, 3]])


def test_a_state_of_another_body_is_refused():
    humanoid, arm = load_body("humanoid"), load_body("arm")
    with pytest.raises(BodyError, match=r"7 .*41|41 .*7"):
        humanoid.positions(posture(arm), humanoid.landmarks)
    with pytest.raises(BodyError, match=r"7 .*41|41 .*7"):
        humanoid.trajectories(np.eye(4)[None], np.zeros((1, 7)), humanoid.landmarks)
