"""The solver of whole takes against dense algebra and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kinefit import BodyState, load_body
from kinefit.bodies import PointSet
from kinefit.errors import ObservationError
from kinefit.geometry import se3
from kinefit.geometry.losses import geman_mcclure
from kinefit.simulation import squat_and_wave, studio_rig
from kinefit.solving.equations import block_diagonal, dense_pattern
from kinefit.solving.trajectory import _kernels_band
from kinefit.solving.trajectory.motion_prior import MotionPrior
from kinefit.solving.trajectory.sequence import SeenPoints
from kinefit.solving.trajectory.smoothing import (
    Smoothed,
    _system,
    _workspace,
    blocks,
    posterior,
    responses,
    smooth,
)

BODY = load_body("humanoid")
TREE, N = BODY.tree, BODY.tree.n_dofs


def prior(acceleration=2.0, memory=(0.1, 1.0), dt=1 / 3):
    a = np.full(N, acceleration) * np.random.default_rng(5).uniform(0.5, 2.0, N)
    a[3:6] = acceleration  # one value for a turn: its axes are the world's
    return MotionPrior(a, memory, dt, TREE.usual, TREE.spread)


def held(weight):
    """Equations that hold every degree of freedom of frame t where it is, by weight (T, n)."""

    def make(roots, angles):
        C = np.zeros((len(roots), *TREE.chain.shape))
        C[:, np.arange(N), TREE.depth] = weight
        return C, np.zeros((len(roots), N)), np.zeros(len(roots))

    return make


def random_states(T, turn, seed=0):
    random = np.random.default_rng(seed)
    roots = np.tile(np.eye(4), (T, 1, 1))
    for t in range(T):
        step = random.normal(size=3)
        R = se3.exp_so3(turn * step / np.linalg.norm(step))
        roots[t, :3, :3] = R @ roots[max(t - 1, 0), :3, :3]
        roots[t, :3, 3] = random.normal(size=3)
    return roots, 0.3 * random.normal(size=(T, N - 6))


PATTERNS = {"tree": (TREE.chain, TREE.depth), "dense": dense_pattern(N)}


def coupled(T, random):
    """Equations that couple all degrees of freedom of a frame: blocks (n, n), of which the lower triangle is read."""
    A = random.uniform(-0.3, 0.3, (T, N, N))
    H = A @ A.transpose(0, 2, 1) + np.eye(N) * random.uniform(1, 3, (T, 1, N))
    return lambda roots, angles: (np.tril(H) + np.triu(np.full(N, np.nan), 1), np.zeros((T, N)), np.zeros(T))


def whole(system, T, pattern=PATTERNS["tree"]):
    """The whole matrix from packed and sparse blocks."""
    chain, depth = pattern
    H = np.zeros((T * N, T * N))
    first, width = blocks(BODY)
    for t in range(T):
        for k in range(N):
            for i in range(depth[k] + 1):
                H[t * N + k, t * N + chain[k, i]] += system.C[t, k, i]
            for ahead in range(min(4, T - t)):
                for b in range(width[k]):
                    if ahead > 0 or first[k] + b <= k:
                        H[(t + ahead) * N + k, t * N + first[k] + b] += system.band[ahead, t, k, b]
    return np.tril(H) + np.tril(H, -1).T


@pytest.mark.parametrize("turn", [0.0, 1e-7, 0.2, 3.0])
def test_gradient_and_curvature_of_the_motion_prior(turn):
    T, p = 6, prior()
    roots, angles = random_states(T, turn)
    none = held(np.zeros((T, N)))

    def moved(delta):
        states = [BodyState(roots[t], angles[t]).retract(delta[t]) for t in range(T)]
        moved_roots, moved_angles = np.stack([s.T_world_root for s in states]), np.stack([s.angles for s in states])
        return _system(BODY, moved_roots, moved_angles, none, p, BODY.tree.depth)

    here = moved(np.zeros((T, N)))
    _, weight = p.rows(T - 1)
    J = np.empty((T, N, T - 1, N))
    some = [0, 3, 4, 5, 6, 12, N - 1]
    for t in range(T):
        for i in some:
            delta = np.zeros((T, N))
            delta[t, i] = 1e-5
            there, back = moved(delta), moved(-delta)
            np.testing.assert_allclose((there.cost - back.cost) / 4e-5, -here.g[t, i], rtol=1e-6, atol=1e-5)
            J[t, i] = (there.changes - back.changes) / 2e-5
    H = whole(here, T).reshape(T, N, T, N)
    for a in range(T):
        for b in range(T):
            for i in some:
                posture = 1.0 / TREE.spread[i - 6] ** 2 if i >= 6 and a == b else 0.0
                expected = np.sum(weight * J[a, i] * J[b, i]) + posture
                np.testing.assert_allclose(H[a, i, b, i], expected, rtol=1e-5, atol=1e-4)
            expected = np.sum(weight * J[a, 3] * J[b, 5])
            np.testing.assert_allclose(H[a, 3, b, 5], expected, rtol=1e-5, atol=1e-4)


def nothing_enters(W):
    return np.zeros((3 * W.shape[1],) * 2)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("T", [1, 2, 3, 4, 7])
def test_factor_solution_and_covariance_are_those_of_the_dense_matrix(T, pattern):
    p = prior()
    random = np.random.default_rng(3)
    roots, angles = random_states(T, 0.4)
    make = held(random.uniform(1, 3, (T, N))) if pattern == "tree" else coupled(T, random)
    pattern = PATTERNS[pattern]
    system = _system(BODY, roots, angles, make, p, pattern[1])
    H = whole(system, T, pattern)
    W, below, x = _workspace(T, N)
    b = random.normal(size=(T, N))
    x[:, :N] = b
    packed = system.C, *pattern, system.band, *blocks(BODY)
    assert _kernels_band.factor_band(*packed, 0.3, nothing_enters(W), W, below, x)
    _kernels_band.back_substitute(W, below, x)
    expected = np.linalg.solve(H + 0.3 * np.eye(T * N), b.ravel()).reshape(T, N)
    np.testing.assert_allclose(x[:, :N], expected, atol=1e-11)

    share = np.kron(np.eye(T), block_diagonal(np.zeros((6, 6)), p.posture_share - p.precision))
    V = np.linalg.inv(H + share).reshape(T, N, T, N)
    found = posterior(BODY, Smoothed(roots, angles, system.cost, 0, True, p, system, pattern, np.zeros((T, N), bool)))
    for t in range(T):
        np.testing.assert_allclose(found.frames[t], V[t, :, t], atol=1e-9)
        if t + 1 < T:
            np.testing.assert_allclose(found.following[t], V[t + 1, :, t], atol=1e-9)
    past, _ = p.rows(max(T - 1, 0))
    for s in range(T - 1):
        c = np.zeros(T)
        c[s], c[s + 1] = -1.0, 1.0
        for back in range(min(s, 2)):
            c[s - back] -= past[s, back]
            c[s - 1 - back] += past[s, back]
        expected = np.einsum("a,aibi,b->i", c, V, c)
        np.testing.assert_allclose(found.change_variance[s], expected, atol=1e-9)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_responses_are_those_of_the_dense_matrix_without_what_is_held(pattern):
    T, random, pattern_of = 5, np.random.default_rng(8), PATTERNS[pattern]
    roots, angles = random_states(T, 0.4)
    make = held(random.uniform(1, 3, (T, N))) if pattern == "tree" else coupled(T, random)
    system, at_rest = _system(BODY, roots, angles, make, prior(), pattern_of[1]), random.random((T, N)) < 0.1
    B, free = random.normal(size=(T, N, 2)), ~at_rest.ravel()
    before = system.C.copy(), system.band.copy(), system.g.copy()
    found = responses(BODY, Smoothed(roots, angles, system.cost, 0, True, prior(), system, pattern_of, at_rest), B)
    H = whole(system, T, pattern_of)[np.ix_(free, free)]
    np.testing.assert_allclose(found.reshape(-1, 2)[free], np.linalg.solve(H, B.reshape(-1, 2)[free]), atol=1e-9)
    assert not found[at_rest].any()
    for kept, array in zip(before, (system.C, system.band, system.g)):
        np.testing.assert_array_equal(kept, array)


def test_a_matrix_that_is_not_positive_is_told():
    T = 3
    system = _system(BODY, *random_states(T, 0.1), held(np.ones((T, N))), prior(), BODY.tree.depth)
    system.C[1, 7, TREE.depth[7]] = -1e9
    W, below, x = _workspace(T, N)
    packed = system.C, TREE.chain, TREE.depth, system.band, *blocks(BODY)
    assert not _kernels_band.factor_band(*packed, 0.0, nothing_enters(W), W, below, x)


def test_first_steps_are_those_of_a_motion_that_goes_on_for_ever():
    """The prior's variance of the steps does not depend on when the take begins."""
    T, p = 60, prior(1.0, (0.1, 0.5), 1 / 20)
    past, weight = p.rows(T - 1)
    L = np.eye(T - 1)
    for s in range(T - 1):
        for back in range(min(s, 2)):
            L[s, s - 1 - back] -= past[s, back]
    V = np.linalg.inv(L.T @ np.diag(weight[:, 0]) @ L)
    np.testing.assert_allclose(np.diag(V), V[0, 0], rtol=1e-9)
    acceleration = np.sqrt(V[30, 30] + V[31, 31] - 2 * V[30, 31]) / p.dt**2
    assert np.isclose(acceleration, p.acceleration[0], rtol=0.25)  # exact for a long memory of velocity


def test_an_angle_that_nothing_observes_has_its_spread():
    T = 400
    weight = np.zeros((T, N))
    weight[:, :6] = 1e4
    roots, angles = np.tile(np.eye(4), (T, 1, 1)), np.tile(TREE.usual, (T, 1))
    p = prior(20.0, (0.2, 1.0), 1 / 60)
    found = posterior(BODY, smooth(BODY, roots, angles, held(weight), p))
    std = np.sqrt(np.einsum("ii->i", found.frames[T // 2])[6:])
    np.testing.assert_allclose(std, TREE.spread, rtol=0.02)


def test_a_take_that_shows_nothing_leaves_the_root_unknown():
    """No frame holds anything: it ends, the posture about as wide as its prior, the root without bounds."""
    roots, angles = np.tile(np.eye(4), (12, 1, 1)), np.tile(TREE.usual, (12, 1))
    p = prior(20.0, (0.2, 1.0), 1 / 60)
    found = posterior(BODY, smooth(BODY, roots, angles, held(np.zeros((12, N))), p))
    variance = np.einsum("tii->ti", found.frames)
    assert np.isfinite(variance).all() and (variance[:, :3] > 1e3).all()
    assert (np.sqrt(variance[:, 6:]) < 5.0 * TREE.spread).all()  # the prior is one of the posture over a second


def scene(noise=0.0, frames=30):
    truth = squat_and_wave(BODY, rate=30, duration=frames / 30)
    rig = studio_rig(truth)
    k = truth.body.keypoints("BODY_25B")
    x = truth.positions(k)
    uv = np.stack([camera.project(x.reshape(-1, 3)).reshape(*x.shape[:2], 2) for camera in rig], axis=1)
    uv = uv.reshape(len(x), -1, 2) + noise * np.random.default_rng(0).normal(size=(len(x), 4 * len(k), 2))
    points = PointSet(k.names * 4, np.tile(k.segments, 4), np.tile(k.points, (4, 1)))
    weight = np.full(uv.shape[:2], 1.0 / max(noise, 1.0) ** 2)
    return truth, SeenPoints(rig, points, np.repeat(np.arange(4), len(k)), uv, weight, geman_mcclure())


def test_a_take_is_found_again_from_exact_pixels_and_limits_hold():
    truth, seen = scene()
    random = np.random.default_rng(1)
    start = np.clip(truth.angles + 0.1 * random.normal(size=truth.angles.shape), TREE.lower, TREE.upper)
    acceleration = np.where(np.arange(N) < 3, 100.0, 2000.0)
    loose = MotionPrior(acceleration, (0.1, 1.0), 1 / 30, TREE.usual, TREE.spread)
    fit = smooth(BODY, truth.Ts_world_root, start, seen.equations(BODY), loose, bounds=(TREE.lower, TREE.upper))
    again = smooth(BODY, fit.roots, fit.angles, seen.equations(BODY), loose, bounds=(TREE.lower, TREE.upper))
    assert fit.converged and again.cost > (1.0 - 1e-4) * fit.cost
    knee = [TREE.coordinate(f"knee_angle_{side}") for side in "rl"]
    assert np.abs(fit.angles[:, knee] - truth.angles[:, knee]).max() < 0.01
    assert np.all(fit.angles >= TREE.lower) and np.all(fit.angles <= TREE.upper)
    upper = np.where(np.arange(N - 6) == knee[0], 0.2, TREE.upper)
    kept = smooth(BODY, truth.Ts_world_root, start, seen.equations(BODY), loose, bounds=(TREE.lower, upper))
    assert kept.angles[:, knee[0]].max() <= 0.2
    assert kept.cost > fit.cost


def test_gap_is_bridged_and_its_error_bars_grow_towards_the_middle():
    truth, seen = scene(noise=2.0, frames=60)
    seen.weight[20:40] = 0.0
    acceleration = np.where(np.arange(N) < 3, 5.0, 30.0)
    p = MotionPrior(acceleration, (0.2, 1.0), 1 / 30, TREE.usual, TREE.spread)
    start = truth.angles.copy()
    start[20:40] = start[19]
    roots = truth.Ts_world_root.copy()
    roots[20:40] = roots[19]
    fit = smooth(BODY, roots, start, seen.equations(BODY), p, bounds=(TREE.lower, TREE.upper))
    std = np.sqrt(np.einsum("tii->ti", posterior(BODY, fit).frames))
    knee = 6 + TREE.coordinate("knee_angle_r")
    assert std[19, knee] < std[22, knee] < std[25, knee] < std[29, knee] > std[35, knee] > std[40, knee]
    assert np.abs(np.diff(fit.angles[:, knee - 6], 2)).max() < 0.2


def test_pixel_variance_is_that_of_the_linearised_projection():
    truth, seen = scene(frames=2)
    random = np.random.default_rng(2)
    A = random.normal(size=(2, N, N))
    V = 1e-4 * A @ A.transpose(0, 2, 1)
    found = seen.variance(BODY, truth.Ts_world_root, truth.angles, V)

    def pixels(state):
        x = BODY.positions(state, seen.points)
        return np.stack([seen.rig.cameras[c].project(x[k][None])[0] for k, c in enumerate(seen.camera)])

    for t in range(2):
        state = truth.state(t)
        J = np.empty((N, *seen.uv.shape[1:]))
        for i in range(N):
            delta = np.zeros(N)
            delta[i] = 1e-6
            J[i] = (pixels(state.retract(delta)) - pixels(state.retract(-delta))) / 2e-6
        np.testing.assert_allclose(found[t], np.einsum("ikc,ij,jkc->kc", J, V[t], J), rtol=1e-5)


def test_resting_points_are_drawn_to_their_place():
    truth, seen = scene(noise=3.0)
    heel = BODY.keypoints("BODY_25B").select(("RHeel",))
    place = truth.positions(heel)
    acceleration = np.where(np.arange(N) < 3, 100.0, 2000.0)
    p = MotionPrior(acceleration, (0.1, 1.0), 1 / 30, TREE.usual, TREE.spread)
    free = smooth(BODY, truth.Ts_world_root, truth.angles, seen.equations(BODY), p)
    anchored = SeenPoints(
        seen.rig, seen.points, seen.camera, seen.uv, seen.weight, seen.loss, heel, place, np.full((30, 1), 1e8)
    )
    tied = smooth(BODY, truth.Ts_world_root, truth.angles, anchored.equations(BODY), p)
    off = [np.linalg.norm(BODY.trajectories(f.roots, f.angles, heel) - place, axis=2).max() for f in (free, tied)]
    assert off[0] > 1e-3 > 1e-4 > off[1]


def test_equations_that_are_not_finite_are_refused():
    _, seen = scene(frames=5)
    seen.weight[2] = np.nan
    roots, angles = np.tile(np.eye(4), (5, 1, 1)), np.tile(TREE.usual, (5, 1))
    with pytest.raises(ObservationError, match="cannot be smoothed"):
        smooth(BODY, roots, angles, seen.equations(BODY), prior())


def test_angles_that_nothing_observes_have_the_posture_priors_covariance():
    """Coupled ones too: in the middle of a long take their joint covariance is the inverse of the prior's precision."""
    p = MotionPrior(
        np.where(np.arange(N) < 6, 3.0, 40.0), (0.2, 0.5), 1 / 10, TREE.usual, TREE.spread, couplings=TREE.couplings
    )
    T = 80
    roots, angles = np.tile(np.eye(4), (T, 1, 1)), np.tile(TREE.usual, (T, 1))
    weight = np.zeros((T, N))
    weight[:, :6] = 1.0
    V = posterior(BODY, smooth(BODY, roots, angles, held(weight), p)).frames[T // 2, 6:, 6:]
    expected = np.linalg.inv(TREE.posture_precision)
    own = [TREE.coordinate(name) for name in ("lumbar_extension", "thorax_extension", "hip_flexion_r", "knee_angle_l")]
    deviation = TREE.posture_std[own]
    np.testing.assert_allclose(
        V[np.ix_(own, own)] / deviation / deviation[:, None],
        expected[np.ix_(own, own)] / deviation / deviation[:, None], atol=0.03,
    )  # fmt: skip


def test_shares_leave_what_nothing_observes_its_variance():
    p, wanted = prior(dt=1 / 60), np.geomspace(1e-3, 1e9, 13)
    found = p._shares(wanted)
    theta = np.geomspace(1e-7, np.pi, 40000)
    z = np.exp(1j * theta)
    density = np.abs((1 - z) * (1 - p.keep[0] * z) * (1 - p.keep[1] * z)) ** 2
    for w, variance in zip(found, wanted):
        assert np.trapezoid(1.0 / (w + density), theta) / np.pi == pytest.approx(variance, rel=1e-3)


def test_the_gradient_of_points_in_metres_is_that_of_their_robust_cost():
    """Markers with a loss, one of them far off, and contacts without."""
    random, count = np.random.default_rng(3), 6
    roots, angles = random_states(2, 0.2)
    points = BODY.landmarks.select(BODY.landmarks.names[: count + 2])
    places = BODY.trajectories(roots, angles, points) + random.normal(0.0, 0.03, (2, count + 2, 3))
    places[0, 1] += 0.4
    weight = np.full((2, count + 2), 1.0 / 0.02**2)
    weight[1, 2] = 0.0
    seen = SeenPoints.in_metres(points, places, weight, geman_mcclure(3.0))
    for robust in (count + 2, count):
        equations = replace(seen, robust=robust).equations(BODY)
        _, g, _ = equations(roots, angles)
        assert np.abs(g).max() > 1.0
        for k in range(N):
            costs = []
            for sign in (1.0, -1.0):
                step = sign * 1e-6 * np.eye(N)[k]
                moved = [BodyState(T, q).retract(step) for T, q in zip(roots, angles, strict=True)]
                at = np.stack([s.T_world_root for s in moved]), np.stack([s.angles for s in moved])
                costs.append(equations(*at)[2])
            np.testing.assert_allclose(-2.0 * g[:, k], (costs[0] - costs[1]) / 2e-6, rtol=1e-5, atol=2e-2)
    all_robust = seen.equations(BODY)(roots, angles)[2]
    assert replace(seen, robust=0).equations(BODY)(roots, angles)[2][0] > all_robust[0] + 100.0
