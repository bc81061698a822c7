"""Elastic bands: what they leave free and what they hold (P2 fig. 2)."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.parts import free_parts, parts_state
from kinefit.bodies.surfaces.places import sample
from kinefit.errors import BodyError
from kinefit.geometry import se3
from kinefit.solving.correspondences import band_rows, joint_bands, surface_rows
from kinefit.solving.correspondences.closures import closed_at, elliptic_bands, hinge_bands, universal_band, with_bands
from kinefit.solving.least_squares import gauss_newton, levenberg_marquardt

RANDOM = np.random.default_rng(0)


def stretched(points, omega):
    """Largest stretch of bands at points (K, 3) when one side turns about the joint's centre."""
    return np.linalg.norm(points @ se3.exp_so3(np.asarray(omega, float)).T - points, axis=1).max()


def test_a_universal_joint_turns_freely():
    assert stretched(universal_band(np.zeros(3)), RANDOM.normal(size=3)) == 0.0


def test_a_hinge_turns_about_its_axis_only():
    axis = np.array([1.0, 2.0, -1.0])
    points = hinge_bands(np.zeros(3), axis, 0.05, 3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), [0.05, 0.0, 0.05], atol=1e-15)
    assert stretched(points, axis) < 1e-12
    across = np.cross(axis, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(stretched(points, 0.3 * across / np.linalg.norm(across)), 2 * 0.05 * np.sin(0.15))


def test_an_elliptic_joint_turns_about_nothing():
    points = elliptic_bands(np.zeros(3), [[0.06, 0.0, 0.0], [0.0, 0.0, 0.04]], 4)
    for axis, reach in zip(np.eye(3), (0.04, 0.06, 0.06)):
        np.testing.assert_allclose(stretched(points, 0.2 * axis), 2 * reach * np.sin(0.1))


@pytest.mark.parametrize("name", ["humanoid10", "humanoid", "arm"])
def test_bands_of_closed_joints_are_slack(name):
    body = load_body(name)
    bands, parts = joint_bands(body, elliptic=()), free_parts(body)
    angles = RANDOM.uniform(body.tree.lower, body.tree.upper)
    frames, _ = body.tree.forward(se3.exp(RANDOM.normal(size=6)), angles)
    rows = band_rows(parts, parts_state(parts, frames), bands)
    assert len(rows) == 3 * len(bands) > 0
    np.testing.assert_allclose(rows.residual, 0.0, atol=1e-12)
    kinds = {int(s): int(np.sum(bands.joint == s)) for s in bands.joint}
    for s in range(1, len(body.tree.segments)):
        turns = body.tree.dof_start[s + 1] - body.tree.dof_start[s]
        assert kinds[s] == {0: 4, 1: 2}.get(int(turns), 1)


def test_bands_pull_parts_together_again():
    body = load_body("humanoid10")
    parts, bands = free_parts(body), joint_bands(body)
    usual = body.default_state()
    frames, _ = body.tree.forward(usual.T_world_root, usual.angles)
    apart = parts_state(parts, frames).retract(0.1 * RANDOM.normal(size=parts.tree.n_dofs))
    assert np.abs(band_rows(parts, apart, bands).residual).max() > 0.1
    fit = levenberg_marquardt(parts, apart, lambda s: [band_rows(parts, s, bands)])
    np.testing.assert_allclose(band_rows(parts, fit.state, bands).residual, 0.0, atol=1e-6)


def test_a_joint_solve_of_skin_and_bands_finds_the_pose():
    """All parts at once, over the same rows as a tree: 3,000 points of the skin, not told their limb."""
    body = load_body("humanoid10")
    parts, bands = free_parts(body), joint_bands(body, elliptic=())
    start = body.default_state()
    angles = np.array(start.angles)
    angles[[body.tree.coordinate("arm_flex_r"), body.tree.coordinate("knee_angle_l")]] += [0.3, 0.2]
    truth, _ = body.tree.forward(start.T_world_root, angles)
    rest, _, segment = sample(body, 3000)
    f = truth[segment]
    x = (f[:, :9].reshape(-1, 3, 3) @ rest[:, :, None])[..., 0] + f[:, 9:]
    frames, _ = body.tree.forward(start.T_world_root, start.angles)
    state = parts_state(parts, frames)
    for _ in range(15):
        rows = [surface_rows(parts, state, x, max_distance=0.15), band_rows(parts, state, bands)]
        state = gauss_newton(parts, state, rows, damping=10.0).state
    expected = body.positions(replace(start, angles=angles), body.landmarks)
    np.testing.assert_allclose(parts.positions(state, parts.landmarks), expected, atol=1e-4)


def test_what_has_no_bands_is_told():
    body = load_body("arm")
    with pytest.raises(BodyError, match="1 bands of a hinge"):
        joint_bands(body, along_line=1)
    sliding = replace(body, tree=replace(body.tree, prismatic=np.ones(len(body.tree.coordinates), bool)))
    with pytest.raises(BodyError, match="sliding"):
        joint_bands(sliding)


@pytest.mark.parametrize("sigmas", [{"all": 0.005}, {"elbow_r": 0.02, "neck": 0.01}])
def test_a_body_with_bands_moves_as_before_where_they_are_slack(sigmas):
    body = load_body("humanoid10")
    banded = with_bands(body, sigmas)
    angles = RANDOM.uniform(np.maximum(body.tree.lower, -1), np.minimum(body.tree.upper, 1))
    angles[body.tree.owners == body.joints.index("neck")] = 0.0  # an elliptic joint's bands resist every rotation
    new = np.zeros(len(banded.tree.coordinates))
    new[[banded.tree.coordinate(name) for name in body.tree.coordinates]] = angles
    state, was = BodyState(np.eye(4), new), BodyState(np.eye(4), angles)
    np.testing.assert_allclose(
        banded.positions(state, body.landmarks), body.positions(was, body.landmarks), atol=1e-12
    )
    np.testing.assert_allclose(closed_at(banded, state).value, 0.0, atol=1e-12)
    free = dict(zip(banded.joints, np.diff(banded.tree.dof_start)))
    banded_joints = set(body.joints[1:]) if "all" in sigmas else set(sigmas)
    assert {joint for joint, count in free.items() if count == 6} >= banded_joints
    assert set(np.unique([c.sigma for c in banded.closures])) == set(sigmas.values())
    new[banded.tree.coordinate("forearm_r_band_tx")] = 0.03
    assert np.abs(closed_at(banded, BodyState(np.eye(4), new)).value).max() == pytest.approx(0.03)


def test_joints_that_cannot_have_bands_are_named():
    with pytest.raises(BodyError, match="no joint 'nose'"):
        with_bands(load_body("humanoid10"), {"nose": 0.01})
    rower = load_body("rower")
    sliding = rower.joints[int(rower.tree.owners[rower.tree.prismatic][0])]
    with pytest.raises(BodyError, match="sliding"):
        with_bands(rower, {sliding: 0.01})
    assert with_bands(rower, {"all": 0.01}).tree.n_dofs > rower.tree.n_dofs
