"""What the turns of joints say for and against explanations: against plain numpy, and of a foot that is turned."""

import numpy as np
import pytest
from benchmarks.synthetic_points import synthetic_body
from scipy.optimize import minimize

from kinefit.geometry.se3 import exp_so3, log_so3
from kinefit.markers.frame._kernels_posture import turn_costs
from kinefit.markers.frame.identify import identify, posture_of
from kinefit.markers.model.learn import learn_model
from kinefit.observations import Markers


def chain(rng, turn):
    """Two segments of five and two markers that meet in a joint, the second turned by `turn` (3,) from the usual."""
    x = np.concatenate([rng.uniform(-0.2, 0.2, (5, 3)), rng.uniform(-0.1, 0.1, (2, 3)) + [0.0, 0.0, 0.5]])
    here, there = np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, 0.3])
    Rp, tp = exp_so3(rng.standard_normal(3)), rng.standard_normal(3)
    middle = exp_so3(np.array([0.4, 0.0, 0.1]))
    Rc = Rp @ middle @ exp_so3(turn)
    points = np.vstack([x[:5] @ Rp.T + tp, (x[5:] - here) @ Rc.T + Rp @ there + tp])
    return x, here, there, middle, points + 0.002 * rng.standard_normal(points.shape)


def least(x, y, w, R0, G):
    """min over R of sum w |y - R x - t|^2 + v' G v, v = log(R R0'), and that R; plain numpy and scipy."""
    x, y = x - np.average(x, 0, w), y - np.average(y, 0, w)

    def f(v):
        return float((w[:, None] * (y - x @ (exp_so3(v) @ R0).T) ** 2).sum() + v @ G @ v)

    u, _, vt = np.linalg.svd((w[:, None] * y).T @ x)
    free = (u * [1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    best = min((minimize(f, s, tol=1e-12) for s in (np.zeros(3), log_so3(free @ R0.T))), key=lambda m: m.fun)
    return best.fun, exp_so3(best.x) @ R0


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.3, -0.4)])
def test_costs_are_those_of_plain_numpy(turn):
    rng, sigma, spread = np.random.default_rng(1), np.full(7, 0.004), 0.01
    x, here, there, middle, points = chain(rng, np.array(turn))
    give = np.diag([0.3, 0.05, 0.04]) + 0.01
    out, most = np.zeros(2), 12.0
    labels = np.array([[0, 1, 2, 3, 4, 5, 6], [0, 1, 2, 3, 4, 6, 5]])
    turn_costs(
        labels, points, np.array([0, 5, 7]), np.arange(7), x, sigma, np.array([-1, 0]),
        np.array([np.zeros(3), here]), np.array([np.zeros(3), there]), np.array([0.0, spread]),
        np.array([np.eye(3), middle]), np.array([np.full((3, 3), -1.0), give]), most, out,
    )  # fmt: skip
    w = 1 / sigma[:5] ** 2
    _, Rp = least(x[:5], points[:5], w, np.eye(3), np.zeros((3, 3)))
    r = (x[:5] - x[:5].mean(0)) @ Rp.T
    H = (w[:, None, None] * ((r**2).sum(1)[:, None, None] * np.eye(3) - r[:, :, None] * r[:, None])).sum(0)
    P = np.linalg.inv(H + np.eye(3) / 10)
    tp = points[:5].mean(0) - Rp @ x[:5].mean(0)
    R0 = Rp @ middle
    G = np.linalg.inv(P + R0 @ give @ R0.T)
    joint = 1 / (spread**2 + 1 / w.sum() + 2 / 3 * there @ there * np.trace(P) / 3)
    for h, order in enumerate(labels):
        xs = np.vstack([x[5:], here])
        ys, ws = np.vstack([points[order[5:]], Rp @ there + tp]), np.array([*1 / sigma[5:] ** 2, joint])
        with_turns, _ = least(xs, ys, ws, R0, G)
        free, _ = least(xs, ys, ws, R0, np.zeros((3, 3)))
        assert out[h] == pytest.approx(min(0.5 * (with_turns - free), most), rel=0.02, abs=0.02)


@pytest.fixture(scope="module")
def hinged():
    """A shank with a foot of three markers, of nearly the same shape turned about its length, that mostly nods."""
    rng = np.random.default_rng(2)
    shank = np.array([[0.0, 0, 0.4], [0.05, 0.02, 0.2], [-0.04, 0.03, 0.1], [0.03, -0.04, 0.3]])
    foot = np.array([[0.12, 0.0, -0.05], [0.08, 0.035, -0.06], [0.08, -0.035, -0.061]])
    frames = []
    for _ in range(200):
        R, t = exp_so3(0.5 * rng.standard_normal(3)), rng.standard_normal(3)
        nod = exp_so3(np.array([rng.uniform(-0.25, 0.25), rng.uniform(-0.9, 0.9), rng.uniform(-0.25, 0.25)]))
        frames.append(np.vstack([shank, foot @ nod.T]) @ R.T + t + 0.0005 * rng.standard_normal((7, 3)))
    names = ("s1", "s2", "s3", "s4", "toe", "in", "out")
    return Markers(names, 100.0, np.array(frames))


def test_a_learnt_hinge_tells_a_foot_from_itself_turned_over(hinged):
    model = learn_model(hinged, template="")
    known = posture_of(model)
    assert known is not None and all(j.turn is not None for j in model.joints)
    spread = np.sqrt(np.linalg.eigvalsh(model.joints[0].give))
    assert spread[2] > 1.5 * spread[0]  # it gives about one axis more than about the others
    at = [model.labels.index(n) for n in ("in", "out")]
    right = []
    for f in range(0, 200, 20):
        points = hinged.positions[f][[hinged.names.index(n) for n in model.labels]]
        found = identify(model, points)
        right.append((found.assignment == np.arange(7))[at].all() and found.confidence[at].min() > 0.8)
    assert np.mean(right) > 0.9


def test_models_that_no_motion_taught_say_nothing_of_turns():
    assert posture_of(synthetic_body(44)) is None
