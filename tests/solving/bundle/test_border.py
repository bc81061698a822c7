"""Poses with a border of shared parameters: against a dense solver that knows all unknowns at once."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from tests.oracle import posture

from kinefit.bodies import BodyState, load_body
from kinefit.errors import ObservationError
from kinefit.geometry.losses import SQUARED, huber
from kinefit.solving import _kernels_linear
from kinefit.solving.bundle.border import Prior, solve
from kinefit.solving.bundle.border_frames import MAX_POSE_STEPS, Weighing
from kinefit.solving.correspondences import _kernels, prior_rows, targets
from kinefit.solving.equations import columns, residuals
from kinefit.solving.rows import PairRows, ParameterRows

ARM = load_body("arm")
HUMANOID = load_body("humanoid")


@dataclass(frozen=True, eq=False)
class Landmarks:
    """An arm of unknown lengths (logarithms), its landmarks (K, 3) measured in every frame."""

    seen: list
    sigma: float = 0.01
    loss: object = None

    def body(self, theta):
        return ARM.scaled(np.exp(theta))

    def parts(self, theta, frame, state):
        body = self.body(theta)
        x = self.seen[frame]
        rows = targets.fill(_kernels.point_rows, 3, body, state, body.landmarks, x, np.full(len(x), self.sigma**-2))
        return [("mocap", replace(rows, loss=self.loss))]


def task(frames=3, seed=0, loss=None):
    random = np.random.default_rng(seed)
    truth = random.normal(scale=0.05, size=3)
    body = ARM.scaled(np.exp(truth))
    tree = ARM.tree
    states = [BodyState(np.eye(4), np.clip(tree.usual + random.normal(scale=0.3, size=7), tree.lower, tree.upper))
              for _ in range(frames)]  # fmt: skip
    seen = [body.positions(s, body.landmarks) + 0.01 * random.normal(size=(len(body.landmarks), 3)) for s in states]
    return Landmarks(seen, loss=loss), states, Prior(np.zeros(3), np.diag([400.0, 100.0, 400.0]))


def dense(problem, states, prior, posture=0.01):
    """All unknowns together, by scipy: parameters, angles (K, D), and the information of θ with angles eliminated."""
    tree, p = ARM.tree, len(prior.mean)

    def all_residuals(z):
        theta, angles = z[:p], z[p:].reshape(len(states), -1)
        out = [np.linalg.cholesky(prior.information).T @ (theta - prior.mean)]
        for f, a in enumerate(angles):
            out += [residuals(r) for _, r in problem.parts(theta, f, BodyState(np.eye(4), a))]
            out.append(np.sqrt(posture) * (a - tree.usual) / tree.spread)
        return np.concatenate(out)

    low = np.concatenate([np.full(p, -1.0), np.tile(tree.lower, len(states))]) - 1e-9
    high = np.concatenate([np.full(p, 1.0), np.tile(tree.upper, len(states))]) + 1e-9
    start = np.concatenate([prior.mean, *(s.angles for s in states)])
    found = least_squares(all_residuals, start, bounds=(low, high), jac="3-point", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    H = found.jac.T @ found.jac
    information = H[:p, :p] - H[:p, p:] @ np.linalg.solve(H[p:, p:], H[p:, :p]) - prior.information
    return found.x[:p], found.x[p:].reshape(len(states), -1), information, 2.0 * found.cost


@pytest.mark.parametrize("seed", range(4))
def test_it_finds_what_a_dense_solver_finds(seed):
    problem, states, prior = task(seed=seed)
    theta, angles, information, cost = dense(problem, states, prior)
    iterations = 60, MAX_POSE_STEPS
    found = solve(problem, np.zeros(3), states, prior, np.full(3, 1e-4), tolerance=1e-10, iterations=iterations)
    assert found.converged
    assert found.cost == pytest.approx(cost, rel=1e-6)
    assert np.allclose(found.theta, theta, atol=2e-4)  # a fiftieth of a bar: derivatives are kept for small steps
    assert np.allclose([s.angles for s in found.states], angles, atol=5e-3)
    free = np.all((angles > ARM.tree.lower + 1e-6) & (angles < ARM.tree.upper - 1e-6))
    if free:
        assert np.allclose(found.information, information, rtol=0.02, atol=1.0)
    assert np.allclose(found.information, found.information.T)
    assert all(np.array_equal(s.T_world_root, np.eye(4)) for s in found.states)  # this body's root is fixed


def test_limits_hold():
    problem, states, prior = task()
    beyond = [s.retract(np.concatenate([np.zeros(6), np.full(7, 3.0)])) for s in states]
    found = solve(problem, np.zeros(3), beyond, prior, np.full(3, 1e-4))
    for s in found.states:
        assert np.all((s.angles >= ARM.tree.lower) & (s.angles <= ARM.tree.upper))


@pytest.mark.parametrize("seed", range(3))
def test_solving_again_wins_nothing_where_limits_hold(seed):
    problem, states, prior = task(frames=8, seed=seed)
    random, tree = np.random.default_rng(seed), ARM.tree
    beyond = [BodyState(np.eye(4), tree.usual + random.normal(scale=0.8, size=7)) for _ in states]
    problem = Landmarks([ARM.positions(s, ARM.landmarks) for s in beyond])
    found = solve(problem, np.zeros(3), states, prior, np.full(3, 1e-4))
    assert any(np.any((s.angles == tree.lower) | (s.angles == tree.upper)) for s in found.states)
    again = solve(problem, found.theta, found.states, prior, np.full(3, 1e-4))
    assert found.converged and again.cost > (1.0 - 1e-4) * found.cost


def test_a_loss_keeps_an_outlier_from_the_lengths():
    problem, states, prior = task(frames=4, loss=huber(1.5))
    calm = solve(problem, np.zeros(3), states, prior, np.full(3, 1e-4))
    wild = [x.copy() for x in problem.seen]
    wild[0][4] += 0.5
    robust = solve(replace(problem, seen=wild), np.zeros(3), states, prior, np.full(3, 1e-4))
    plain = solve(replace(problem, seen=wild, loss=SQUARED), np.zeros(3), states, prior, np.full(3, 1e-4))
    assert np.abs(robust.theta - calm.theta).max() < 0.02 < np.abs(plain.theta - calm.theta).max()


def test_a_share_leaves_the_prior_more_to_say():
    problem, states, prior = task()
    full = solve(problem, np.zeros(3), states, prior, np.full(3, 1e-4))
    less = solve(problem, np.zeros(3), states, prior, np.full(3, 1e-4), weighing=Weighing({"mocap": 0.01}))
    assert np.allclose(less.information, 0.01 * full.information, rtol=0.05)
    assert np.linalg.norm(less.theta) < np.linalg.norm(full.theta)


def test_rows_of_every_kind_have_their_columns():
    state = posture(HUMANOID, 1, 0.3)
    n, random = HUMANOID.tree.n_dofs, np.random.default_rng(0)
    W = np.cov(random.normal(size=(3, 9)))
    joint = ParameterRows(np.array([7, 9, 11]), np.array([0.1, 0.2, -0.3]), W)
    J, r = columns(joint, HUMANOID, state), residuals(joint)
    assert np.allclose(J.T @ J, np.einsum("ai,ab,bj->ij", np.eye(n)[joint.index], W, np.eye(n)[joint.index]))
    assert np.allclose(J.T @ r, np.eye(n)[joint.index].T @ W @ joint.residual)
    prior = prior_rows(HUMANOID, state, sigma=HUMANOID.tree.spread)
    assert np.allclose(columns(prior, HUMANOID, state).sum(0)[prior.index], np.sqrt(prior.weight))
    hands = HUMANOID.landmarks.select(("r_wrist", "l_wrist"))
    step = 1e-6 * random.normal(size=n)

    def pair(state):
        a, b = HUMANOID.positions(state, hands)
        return PairRows(hands.segments[None], a[None], b[None], [[0.6, 0.8, 0.0]], [(b - a) @ [0.6, 0.8, 0.0]], [4.0])

    moved = residuals(pair(state)) - residuals(pair(state.retract(step)))
    assert moved == pytest.approx(columns(pair(state), HUMANOID, state) @ step, rel=1e-4)
    with pytest.raises(ObservationError, match="degree of freedom 60"):
        columns(ParameterRows(np.array([60]), np.zeros(1), np.ones(1)), HUMANOID, state)


def test_small_sums():
    random = np.random.default_rng(0)
    A, B, H = random.normal(size=(30, 6)), random.normal(size=(30, 4)), np.ones((6, 4))
    _kernels_linear.gram(A, B, H)
    assert np.allclose(H, 1.0 + A.T @ B)
