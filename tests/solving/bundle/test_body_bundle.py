"""Body and cameras in one fit."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import posture, rig_around

from kinefit.bodies import BodyState, load_body
from kinefit.geometry.losses import geman_mcclure
from kinefit.solving.bundle.adjust import BundleState, adjust
from kinefit.solving.bundle.cameras import COLUMNS, FOCAL, TIME, CameraPrior, PointPixels, departure, moved_rig
from kinefit.solving.bundle.shape import BodyProblem, PixelFrames, shape_parameters

BODY = load_body("humanoid")
SET = BODY.keypoints("BODY_25B")
RIG = rig_around((0.0, 0.0, 0.0), cameras=3)
GROUPS = len(BODY.scale_groups)


def seen(frames=15, noise=1.0):
    random = np.random.default_rng(0)
    states = []
    for k in range(frames):
        state = posture(BODY, 100 + k, 0.35)
        T = np.array(state.T_world_root)
        T[:3, 3] = random.uniform(-0.5, 0.5, 3)
        states.append(BodyState(T, state.angles))
    x = np.stack([BODY.positions(s, SET) for s in states])
    uv = np.concatenate([c.project(x) for c in RIG], axis=1)
    uv += noise * random.normal(size=uv.shape)
    camera, column = np.repeat(np.arange(3), len(SET)), np.tile(np.arange(len(SET)), 3)
    weight = np.full(uv.shape[:2], max(noise, 0.5) ** -2)
    return PixelFrames(SET, camera, column, uv, weight, np.ones(len(column)), np.zeros(uv.shape)), states


def model():
    return shape_parameters(BODY, SET, np.ones(GROUPS), 0.05, 0.01)


def sigma(**others):
    out = np.zeros((3, COLUMNS))
    out[1:, :3], out[1:, 3:6] = 0.05, 0.03
    for name, value in others.items():
        out[:, {"focal": FOCAL, "time": TIME}[name]] = value
    return out


def test_derivatives_by_the_cameras_agree_with_differences():
    pixels, states = seen(frames=1, noise=3.0)
    parameters, loss = model(), geman_mcclure()
    random = np.random.default_rng(1)
    velocity, share = random.normal(scale=100, size=(len(pixels.column), 2)), random.uniform(0.2, 1, len(pixels.column))
    theta, first = parameters.mean, BODY.tree.n_dofs + len(parameters.mean)

    def cost(delta):
        rig = moved_rig(RIG, delta)
        left = pixels.uv[0] - rig.project(BODY.positions(states[0], pixels.points)[pixels.column], pixels.camera)
        left -= delta[pixels.camera, TIME, None] * velocity
        s2 = pixels.weight[0] * np.sum(left**2, axis=1)
        return float(np.sum(share * s2 / (1 + s2 / loss.scale**2)))

    moving = replace(pixels, share=share, velocity=velocity[None])
    place = CameraPrior(RIG, np.ones((3, COLUMNS))).place
    H, g, _ = parameters.equations(theta, states[0], RIG, place, moving, 0, loss)
    assert H.shape == (first + 3 * COLUMNS,) * 2
    for k in range(3 * COLUMNS):
        step = np.zeros(3 * COLUMNS)
        step[k] = 1e-6
        slope = (cost(step.reshape(3, -1)) - cost(-step.reshape(3, -1))) / 2e-6
        assert -2.0 * g[first + k] == pytest.approx(slope, rel=1e-4, abs=1e-2 * np.abs(g).max() * 1e-3)


def from_mean(rig, states, x=None):
    return BundleState(rig, np.zeros(len(rig)), np.zeros((0, 3)) if x is None else x, model().mean, states)


def fit_body_and_cameras(model, pixels, start, prior, static=None):
    static = static or PointPixels(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))
    problem = BodyProblem(static, model=model, frames=pixels)
    return adjust(start, prior, problem, iterations=20, tolerance=1e-3).state


def test_cameras_that_were_knocked_come_back_with_the_body():
    pixels, states = seen()
    delta = np.random.default_rng(2).normal(scale=0.01, size=(3, COLUMNS)) * (sigma() > 0)
    start = moved_rig(RIG, delta)
    found = fit_body_and_cameras(model(), pixels, from_mean(start, states), CameraPrior(start, sigma()))
    left = np.abs(departure(found.rig, RIG))
    assert left[:, :3].max() < 0.02 and left[:, 3:6].max() < 2e-3
    assert np.abs(departure(start, RIG)).max() > 5 * left[:, 3:6].max()


def test_static_points_join_and_hold_the_cameras():
    pixels, states = seen(frames=4, noise=4.0)
    random = np.random.default_rng(3)
    x = random.uniform(-1.0, 1.0, (15, 3))
    point, camera = (a.ravel() for a in np.meshgrid(np.arange(15), np.arange(3), indexing="ij"))
    uv = np.stack([RIG.cameras[c].project(x[p]) for p, c in zip(point, camera, strict=True)])
    static = PointPixels(camera, point, uv, np.full(len(uv), 25.0))
    prior = CameraPrior(RIG, sigma())
    away = []
    for known, start in ((None, None), (static, x + 0.01)):
        found = fit_body_and_cameras(model(), pixels, from_mean(RIG, states, start), prior, static=known)
        seen_at = np.stack([found.rig.cameras[c].project(x[p]) for p, c in zip(point, camera, strict=True)])
        away.append(np.abs(seen_at - uv).mean())
    assert away[1] < 0.4 * away[0]
    np.testing.assert_allclose(found.blocks, x, atol=0.01)


def test_the_order_of_what_is_known_decides_what_moves():
    pixels, states = seen(frames=4)
    fixed = CameraPrior(RIG, np.zeros((3, COLUMNS)))
    found = fit_body_and_cameras(model(), pixels, from_mean(RIG, states), fixed)
    np.testing.assert_allclose(departure(found.rig, RIG), 0.0, atol=1e-9)
    np.testing.assert_array_equal(found.offsets, 0.0)
