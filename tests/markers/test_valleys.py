"""Flat valleys of a frame's cost: true bars, and motion that decides where in them a frame is."""

from __future__ import annotations

import numpy as np
import pytest

from kinefit import load_body
from kinefit.bodies import BodyState
from kinefit.bodies.marker_sets import placement
from kinefit.markers.valleys import PointTake, profile_frames, resolve_by_motion
from kinefit.sensors.settings import MARKER_LOSS
from kinefit.solvers.sequence import fit_sequence

RATE, FRAMES = 60.0, 60
BODY = load_body("humanoid")
TRUNK = [BODY.tree.coordinates.index(f"{part}_extension") for part in ("lumbar", "thorax")]


@pytest.fixture(scope="module")
def bow():
    """Lumbar and thorax bent against each other, with no marker between them: truth, and what is fitted to markers."""
    tree, points, rng = BODY.tree, placement(BODY, "STANFORD_47").points, np.random.default_rng(0)
    angles = np.tile(tree.usual, (FRAMES, 1))
    angles[:, TRUNK] = np.radians([-30.0, 30.0]) * np.sin(np.linspace(0.0, np.pi, FRAMES))[:, None]
    roots = np.tile(np.eye(4), (FRAMES, 1, 1))
    x = BODY.trajectories(roots, angles, points)
    x = x + rng.normal(0, 0.005, x.shape[1:]) + rng.normal(0, 0.005, x.shape)
    take = PointTake(BODY, points, x, np.full(len(points), 0.007), MARKER_LOSS, True)
    fit = fit_sequence(
        BODY, BodyState(roots[0], angles[0]), points, x, sigma=take.sigma, loss=MARKER_LOSS, posture=1.0
    )
    return take, angles, fit, profile_frames(take, fit.Ts_world_root, fit.angles, RATE)


def _rise(take, roots, angles, frame, d, step):
    """Of a frame's cost, with one angle set off and all others fitted anew."""
    costs = []
    for away in (0.0, step, -step):
        moved, locked = angles[[frame]].copy(), np.zeros(BODY.tree.n_dofs, bool)
        moved[:, d] += away
        locked[6 + d] = away != 0.0
        costs += fit_sequence(
            BODY, (roots[[frame]], moved), take.points, take.x[[frame]], sigma=take.sigma, loss=MARKER_LOSS,
            posture=1.0, locked=locked, limits=False,
        ).costs.tolist()  # fmt: skip
    return min(costs[1:]) - costs[0]


def test_bars_reach_as_far_as_the_cost_is_flat(bow):
    take, _, _, (roots, angles, sure, wide, flat) = bow
    frame, d = int(np.argmax(wide.dof_std[:, 6 + TRUNK[1]] / sure.dof_std[:, 6 + TRUNK[1]])), TRUNK[1]
    assert flat[frame, d]
    assert _rise(take, roots, angles, frame, d, 2.0 * sure.dof_std[frame, 6 + d]) < 2.5
    assert _rise(take, roots, angles, frame, d, 2.0 * wide.dof_std[frame, 6 + d]) > 3.0
    assert (wide.dof_std >= sure.dof_std * (1.0 - 1e-12)).all()
    assert (wide.joint_std >= sure.joint_std * (1.0 - 1e-12)).all()


def test_what_is_determined_keeps_its_bars(bow):
    _, _, _, (_, _, sure, wide, flat) = bow
    legs = [BODY.tree.coordinates.index(f"knee_angle_{side}") for side in "lr"]
    assert not flat[:, legs].any()
    np.testing.assert_allclose(wide.dof_std[:, 6:][:, legs], sure.dof_std[:, 6:][:, legs], rtol=0.1)


def test_motion_decides_in_a_valley(bow):
    take, truth, fit, (roots, angles, _, _, flat) = bow
    found = resolve_by_motion(take, roots, angles, flat, RATE)[1]
    off = [np.abs(some[:, TRUNK] - truth[:, TRUNK]).max(axis=0) for some in (found, fit.angles)]
    assert (off[0] < 0.9 * off[1]).all()
    steps = [np.abs(np.diff(some[:, TRUNK], axis=0)).max() for some in (found, fit.angles)]
    assert steps[0] < 0.8 * steps[1]


def test_a_frame_in_a_worse_minimum_takes_the_better_one(bow):
    take, _, fit, _ = bow
    roots, angles = fit.Ts_world_root.copy(), fit.angles.copy()
    angles[20:30, TRUNK] += np.radians([25.0, -25.0])
    found = profile_frames(take, roots, angles, RATE)[1]
    np.testing.assert_allclose(found[20:30, TRUNK], fit.angles[20:30, TRUNK], atol=np.radians(3.0))


def test_equations_of_points_are_those_of_the_fit(bow):
    take, _, fit, _ = bow
    C, g, costs = take.equations(slice(None))(fit.Ts_world_root, fit.angles)
    away = fit.angles - BODY.tree.usual
    precision = BODY.tree.posture_precision
    np.testing.assert_allclose(costs + np.einsum("fi,ij,fj->f", away, precision, away), fit.costs, rtol=1e-4)
    pull = -away @ precision
    inside = (fit.angles > BODY.tree.lower + 1e-9) & (fit.angles < BODY.tree.upper - 1e-9)
    assert np.abs((g[:, 6:] + pull)[inside]).max() < 0.05 * np.abs(pull).max()
    assert C.shape == (FRAMES, *BODY.tree.chain.shape)


def test_each_frame_may_begin_at_its_own_start(bow):
    take, _, fit, _ = bow
    back = slice(None, None, -1)
    again = fit_sequence(
        BODY, (fit.Ts_world_root[back], fit.angles[back]), take.points, take.x[back], sigma=take.sigma,
        loss=MARKER_LOSS, posture=1.0,
    )  # fmt: skip
    np.testing.assert_allclose(again.angles[back], fit.angles, atol=2e-2)
    assert again.iterations.max() <= 5
