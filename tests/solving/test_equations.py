"""Normal equations, their factors and covariances against dense numpy."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import (
    STATES,
    central_differences,
    design,
    posture,
    random_body,
    random_unit,
    slow_motions,
    slow_positions,
    state_of,
)

from kinefit.bodies import KinematicTree, load_body
from kinefit.errors import KinefitError
from kinefit.geometry import se3
from kinefit.geometry.losses import SQUARED, geman_mcclure, huber, tukey
from kinefit.solving import _kernels_linear
from kinefit.solving.correspondences import coincidence_rows, point_rows, prior_rows
from kinefit.solving.equations import Covariance, covariance, inverse, joint_std, normal_equations, variances
from kinefit.solving.least_squares import levenberg_marquardt
from kinefit.solving.rows import DofRows, PairRows, ParameterRows, Rows

LOSSES = {"squared": SQUARED, "huber": huber(), "tukey": tukey(), "geman-mcclure": geman_mcclure()}


def random_rows(body, state, count=120, seed=0):
    """Rows on all segments, measurements of one to three rows, some never outliers; residuals from good to hopeless."""
    random = np.random.default_rng(seed)
    group = np.repeat(np.arange(count), random.integers(1, 4, count))[:count]
    group[::17] = -1
    segment = random.integers(0, len(body.tree.segments), count)
    point = state.T_world_root[:3, 3] + random.normal(size=(count, 3))
    residual = random.normal(size=count) * 10 ** random.uniform(-2, 1.5, count)
    return Rows.of(segment, point, random_unit(random, count), residual, random.uniform(0.2, 2, count), group)


def random_pairs(body, state, count=12, seed=1):
    random = np.random.default_rng(seed)
    points = state.T_world_root[:3, 3] + random.normal(size=(2, count, 3))
    segments = random.integers(0, len(body.tree.segments), (count, 2))
    return PairRows(
        segments, *points, random_unit(random, count), random.normal(size=count), random.uniform(1, 9, count)
    )


def random_parameters(body, count=15, seed=2):
    random = np.random.default_rng(seed)
    index = random.integers(0, body.tree.n_dofs, count)
    return ParameterRows(index, random.normal(size=count), random.uniform(1, 9, count))


def random_dense(body, count=40, seed=4):
    random = np.random.default_rng(seed)
    residual = random.normal(size=count) * 10 ** random.uniform(-2, 1.5, count)
    group = np.repeat(np.arange(count), 2)[:count]
    group[::7] = -1
    return DofRows(random.normal(size=(count, body.tree.n_dofs)), residual, random.uniform(0.2, 2, count), group)


def robust_factors(rows, loss):
    """(N,) factors and Σ ρ: adjacent rows with one id, and not -1, share a factor."""
    factor, cost, i = np.ones(len(rows)), 0.0, 0
    while i < len(rows):
        j = i + 1
        while j < len(rows) and rows.group[j] == rows.group[i] >= 0:
            j += 1
        s2 = float(np.sum(rows.weight[i:j] * rows.residual[i:j] ** 2))
        s, c = np.sqrt(s2), loss.scale
        rho, factor[i:j] = (
            {
                "squared": (s2, 1.0),
                "huber": (s2, 1.0) if s <= c else (2 * c * s - c * c, c / s),
                "tukey": (c * c / 3 * (1 - max(0, 1 - s2 / c**2) ** 3), max(0, 1 - s2 / c**2) ** 2),
                "geman-mcclure": (s2 / (1 + s2 / c**2), (1 + s2 / c**2) ** -2),
            }[next(n for n, v in LOSSES.items() if v == loss)]
            if rows.group[i] >= 0
            else (s2, 1.0)
        )
        cost += rho
        i = j
    return factor, cost


def dense(parts, body, state, loss=SQUARED):
    """H, g and cost by dense matrices: Jᵀ W J."""
    H, g, cost = np.zeros((body.tree.n_dofs,) * 2), np.zeros(body.tree.n_dofs), 0.0
    for rows in parts:
        J = design(rows, body, state)
        factor, part = (
            robust_factors(rows, loss)
            if isinstance(rows, Rows | DofRows)
            else (1.0, np.sum(rows.weight * rows.residual**2))
        )
        w = rows.weight * factor
        H, g, cost = H + J.T @ (w[:, None] * J), g + J.T @ (w * rows.residual), cost + part
    return H, g, cost


BODIES = {
    "random": lambda: random_body(0),
    "larger": lambda: random_body(1, 14),
    "fixed root": lambda: random_body(3, root_free=False),
    "humanoid": lambda: load_body("humanoid"),
}


@pytest.fixture(params=BODIES)
def body(request):
    return BODIES[request.param]()


@pytest.mark.parametrize("kind", STATES)
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_normal_equations_are_the_dense_ones(body, kind, loss):
    state = state_of(body, kind)
    rows = random_rows(body, state)
    found = normal_equations(body, state, rows, loss=loss)
    H, g, cost = dense([rows], body, state, loss)
    np.testing.assert_allclose(found.factor, robust_factors(rows, loss)[0], rtol=1e-12)
    np.testing.assert_allclose(found.matrix, H, atol=1e-11 * np.abs(H).max())
    np.testing.assert_allclose(found.gradient, g, atol=1e-11 * np.abs(g).max())
    np.testing.assert_allclose(found.diagonal, np.diag(H), atol=1e-11 * np.abs(H).max())
    assert found.cost == pytest.approx(cost, rel=1e-12)


def test_rows_of_every_kind_together(body):
    state = state_of(body, "random")
    parts = [
        random_rows(body, state),
        random_pairs(body, state),
        random_parameters(body),
        random_dense(body),
        random_rows(body, state, 40, 5),
    ]
    found = normal_equations(body, state, parts, loss=huber())
    H, g, cost = dense(parts, body, state, huber())
    np.testing.assert_allclose(found.matrix, H, atol=1e-11 * np.abs(H).max())
    np.testing.assert_allclose(found.gradient, g, atol=1e-11 * np.abs(g).max())
    assert found.cost == pytest.approx(cost, rel=1e-12)


def test_shares_count_beyond_the_loss(body):
    state = state_of(body, "random")
    parts = [
        random_rows(body, state), random_pairs(body, state), random_parameters(body), random_dense(body),
    ]  # fmt: skip
    shares = (0.3, 0.5, 2.0, 0.7)
    found = normal_equations(body, state, parts, loss=huber(), shares=shares)
    each = [dense([part], body, state, huber()) for part in parts]
    H, g, cost = (sum(share * one[k] for share, one in zip(shares, each)) for k in range(3))
    np.testing.assert_allclose(found.matrix, H, atol=1e-11 * np.abs(H).max())
    np.testing.assert_allclose(found.gradient, g, atol=1e-11 * np.abs(g).max())
    assert found.cost == pytest.approx(cost, rel=1e-12)


def test_pairs_alone_and_parameters_alone(body):
    state = state_of(body, "random")
    for part in (random_pairs(body, state), random_parameters(body)):
        found = normal_equations(body, state, part)
        H, g, cost = dense([part], body, state)
        np.testing.assert_allclose(found.matrix, H, atol=1e-12 * np.abs(H).max())
        np.testing.assert_allclose(found.gradient, g, atol=1e-12 * np.abs(g).max())
        assert found.cost == pytest.approx(cost, rel=1e-12)


def test_the_gradient_is_that_of_the_robust_cost(body):
    """∂ Σρ / ∂δ = −2 g, through all row makers' derivatives and robust weights."""
    state, points = state_of(body, "random"), body.landmarks
    target = slow_positions(body, state, points) + np.random.default_rng(0).normal(scale=0.05, size=(len(points), 3))
    make = lambda s: [point_rows(body, s, points, target, sigma=0.02), prior_rows(body, s, sigma=0.7)]
    slope = central_differences(
        lambda s: np.array(normal_equations(body, s, make(s), loss=geman_mcclure()).cost), body, state
    )
    found = normal_equations(body, state, make(state), loss=geman_mcclure()).gradient
    np.testing.assert_allclose(slope, -2 * found, atol=1e-6 * np.abs(slope).max())


def test_no_rows_are_nothing(body):
    found = normal_equations(body, state_of(body, "random"), [])
    assert found.cost == 0 and not found.matrix.any() and not found.gradient.any()
    unknown = np.isinf(covariance(found).std)
    assert np.all(unknown[6:]) and np.all(unknown[:6] == body.tree.root_free)


def test_rows_of_another_body_are_refused():
    body = random_body(0)
    state, far = state_of(body, "random"), 10**8
    here = np.zeros((1, 3))
    for rows in (
        Rows.of([far], here, [[1.0, 0, 0]], [1.0], 1.0),
        PairRows([[0, far]], here, here, [[1.0, 0, 0]], [1.0], [1.0]),
        ParameterRows([far], [1.0], [1.0]),
        DofRows(np.ones((1, body.tree.n_dofs + 1)), [1.0], [1.0], [0]),
    ):
        with pytest.raises(KinefitError):
            normal_equations(body, state, rows)


def test_the_far_origin_of_the_world_costs_no_digits():
    body = random_body(0)
    state, points = state_of(body, "random"), body.landmarks
    far = se3.transform(np.eye(3), np.array([3e5, -4e6, 100.0]))  # metres, like a map's coordinates
    moved = type(state)(far @ state.T_world_root, state.angles)
    a = normal_equations(body, state, point_rows(body, state, points, body.positions(state, points) + 0.01))
    b = normal_equations(body, moved, point_rows(body, moved, points, body.positions(moved, points) + 0.01))
    np.testing.assert_allclose(b.matrix, a.matrix, atol=1e-8 * np.abs(a.matrix).max())


def patterns(body):
    n = body.tree.n_dofs
    return {"tree": (body.tree.chain, body.tree.depth), "dense": (np.tile(np.arange(n), (n, 1)), np.arange(n))}


@pytest.mark.parametrize("pattern", ["tree", "dense"])
def test_factors_and_solutions(body, pattern):
    state, n = state_of(body, "random"), body.tree.n_dofs
    parts = [random_rows(body, state, 600), ParameterRows(np.arange(n), np.zeros(n), np.ones(n))]
    if pattern == "dense":
        parts.append(random_pairs(body, state))
    H = normal_equations(body, state, parts).matrix
    chain, depth = patterns(body)[pattern]
    C = np.empty(chain.shape)
    _kernels_linear.pack(H, chain, depth, C)
    assert _kernels_linear.factor_tree(C, chain, depth)
    L = np.zeros((n, n))
    for k in range(n):
        L[k, chain[k, : depth[k] + 1]] = C[k, : depth[k] + 1]
    L[np.arange(n), np.arange(n)] = 1 / np.diag(L)  # kept inverted
    np.testing.assert_allclose(L.T @ L, H, atol=1e-11 * np.abs(H).max())
    b = np.random.default_rng(0).normal(size=n)
    x = b.copy()
    _kernels_linear.solve_tree(C, chain, depth, x)
    np.testing.assert_allclose(x, np.linalg.solve(H, b), rtol=1e-7, atol=1e-10)
    _kernels_linear.pack(H, chain, depth, C)
    out = np.empty((n, n))
    assert _kernels_linear.invert(C, chain, depth, out)
    np.testing.assert_allclose(out, np.linalg.inv(H), rtol=1e-7, atol=1e-10)


def test_packing_is_undone_by_unpacking(body):
    state, n = state_of(body, "random"), body.tree.n_dofs
    H = normal_equations(body, state, random_rows(body, state)).matrix
    C, back = np.empty(body.tree.chain.shape), np.zeros((n, n))
    _kernels_linear.pack(H, body.tree.chain, body.tree.depth, C)
    _kernels_linear.unpack(C, body.tree.chain, body.tree.depth, back)
    np.testing.assert_array_equal(back, H)  # nothing of H lies outside the tree's pattern


def test_what_is_not_positive_has_no_factors():
    body = random_body(0)
    chain, depth = patterns(body)["dense"]
    H = np.eye(body.tree.n_dofs)
    H[4, 4] = -1.0
    assert not _kernels_linear.factor_tree(H, chain, depth)
    H[4, 4] = np.nan
    assert not _kernels_linear.factor_tree(H, chain, depth)


@pytest.mark.parametrize("pairs", [False, True])
def test_covariance_is_the_inverse(body, pairs):
    state, n = state_of(body, "random"), body.tree.n_dofs
    parts = [random_rows(body, state, 600), ParameterRows(np.arange(n), np.zeros(n), np.ones(n))]
    parts += [random_pairs(body, state)] if pairs else []
    equations = normal_equations(body, state, parts)
    free = slice(0 if body.tree.root_free else 6, n)
    cov = covariance(equations).matrix
    np.testing.assert_allclose(cov[free, free], np.linalg.inv(equations.matrix[free, free]), rtol=1e-7, atol=1e-11)
    assert not cov[: free.start].any()


def test_what_is_locked_is_known():
    body = random_body(0)
    state, n = state_of(body, "random"), body.tree.n_dofs
    equations = normal_equations(body, state, random_rows(body, state, 600))
    locked = np.isin(np.arange(n), [1, 4, 8])
    cov = covariance(equations, locked=locked).matrix
    assert not cov[locked].any() and not cov[:, locked].any()
    free = np.flatnonzero(~locked)
    np.testing.assert_allclose(
        cov[np.ix_(free, free)], np.linalg.inv(equations.matrix[np.ix_(free, free)]), rtol=1e-7, atol=1e-11
    )


def arm_scene(seed=0):
    """An arm whose shoulder may move, with its landmarks."""
    body = load_body("arm")
    return body, posture(body, seed, 0.3), body.landmarks


def test_covariance_agrees_with_sampled_noise():
    """Poses fitted to 700 draws of noise scatter as the covariance says, and so do the joint centres."""
    body = load_body("humanoid10")
    truth, points = posture(body, 0, 0.3), body.landmarks
    x, sigma, random = body.positions(truth, points), 0.002, np.random.default_rng(0)
    cov = covariance(normal_equations(body, truth, point_rows(body, truth, points, x, sigma=sigma)))
    spread, cov = cov, cov.matrix
    assert np.all(np.isfinite(cov))
    states = []
    for _ in range(700):
        target = x + sigma * random.normal(size=x.shape)
        make = lambda s: point_rows(body, s, points, target, sigma=sigma)  # noqa: B023
        states.append(levenberg_marquardt(body, truth, make, limits=False, tolerance=1e-6).state)
    steps = np.array([truth.difference(s) for s in states])
    np.testing.assert_allclose(steps.std(axis=0), np.sqrt(np.diag(cov)), rtol=0.12)
    correlation = cov / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    np.testing.assert_allclose(np.corrcoef(steps.T), correlation, atol=0.17)
    centres = body.tree.segment_poses(np.stack([s.T_world_root for s in states]), np.stack([s.angles for s in states]))
    np.testing.assert_allclose(centres[..., :3, 3].std(axis=0), joint_std(body, truth, spread), rtol=0.12)


def test_a_fixed_root_is_known():
    """The arm's shoulder stays where it is put, so seven angles are all that is unknown."""
    body, truth, points = arm_scene()
    equations = normal_equations(body, truth, point_rows(body, truth, points, body.positions(truth, points)))
    cov = covariance(equations).matrix
    np.testing.assert_array_equal(cov[:6], 0)
    np.testing.assert_allclose(cov[6:, 6:], np.linalg.inv(equations.matrix[6:, 6:]), rtol=1e-7)


def test_what_nothing_observes_is_unbounded():
    body, truth, points = arm_scene()
    upper = points.select(tuple(n for n, s in zip(points.names, points.segments, strict=True) if s <= 1))
    cov = covariance(normal_equations(body, truth, point_rows(body, truth, upper, body.positions(truth, upper))))
    told = dict(zip(body.dof_names, cov.std, strict=True))
    for name in ("elbow_flex_r", "pro_sup_r", "wrist_flex_r", "wrist_dev_r"):
        assert np.isinf(told[name])
    std = joint_std(body, truth, cov)
    assert np.all(np.isinf(std[3]).any())  # the wrist hangs on the elbow


def without_right_arm(body):
    """The landmarks with the right arm's left out, but for its shoulder and its elbow."""
    arm = [body.tree.segment(n) for n in ("upperarm_r", "forearm_r", "hand_r")]
    names = [n for n, s in zip(body.landmarks.names, body.landmarks.segments, strict=True) if s not in arm]
    return body.landmarks.select((*names, "r_shoulder", "r_elbow"))


UNSEEN = {"arm_rot_r", "elbow_flex_r", "pro_sup_r", "wrist_flex_r", "wrist_dev_r"}
TWIST = {"lumbar_rotation", "thorax_extension", "thorax_bending", "thorax_rotation"}


@pytest.mark.parametrize(
    ("truth", "unknown"),
    [
        # no point lies on the abdomen: its turn about the line between its two ball joints is free in every posture
        (load_body("humanoid").rest_state(), UNSEEN | {"lumbar_rotation", "thorax_rotation"}),
        (posture(load_body("humanoid"), 2, 0.3), UNSEEN | TWIST),
    ],
    ids=["at rest", "in a posture"],
)  # fmt: skip
def test_a_turn_about_a_line_of_points_is_unbounded(truth, unknown):
    """Shoulder and elbow tell nothing of the upper arm's turn about the line between them; all else is known."""
    body = load_body("humanoid")
    few = without_right_arm(body)
    cov = covariance(normal_equations(body, truth, point_rows(body, truth, few, body.positions(truth, few))))
    assert {n for n, v in zip(body.dof_names, cov.std, strict=True) if np.isinf(v)} == unknown
    std = joint_std(body, truth, cov)
    told = dict(zip(body.tree.segments, np.isinf(std).any(axis=1), strict=True))
    assert told["hand_r"] and not told["hand_l"] and not told["foot_r"]


def test_angles_that_only_count_together():
    """Two joints about one line: only their sum is known, so both are unbounded, but the points beyond are known."""
    base = random_body(5, 4, prismatic=0.0)
    tree = KinematicTree(
        base.tree.segments, np.array([-1, 0, 1, 2]), np.array([[0, 0, 0], [0.2, 0, 0], [0, 0, 0.3], [0, 0.4, 0.0]]),
        ("a", "b", "c"), np.array([1, 2, 3]), np.array([[0, 0, 1.0], [0, 0, 1.0], [1.0, 0, 0]]), np.zeros(3, bool),
        np.full(3, -3.0), np.full(3, 3.0), np.zeros(3), np.ones(3),
    )  # fmt: skip
    body = replace(base, tree=tree)
    keep = tuple(n for n, s in zip(body.landmarks.names, body.landmarks.segments, strict=True) if s != 1)
    points = body.landmarks.select(keep)
    state = body.rest_state(se3.exp(np.arange(6.0) / 7))
    cov = covariance(
        normal_equations(body, state, point_rows(body, state, points, body.positions(state, points)))
    ).matrix
    assert [np.isinf(v) for v in np.diag(cov)] == [False] * 6 + [True, True, False]


def test_joint_std_is_the_spread_carried_along(body):
    state, n = state_of(body, "random"), body.tree.n_dofs
    A = np.random.default_rng(0).normal(size=(n, n))
    cov = A @ A.T / n

    def centres(s):
        return (slow_motions(body.tree, s) @ se3.transform(np.eye(3), body.tree.rest))[:, :3, 3]

    J = central_differences(centres, body, state)
    expected = np.sqrt(np.einsum("sin,nm,sim->si", J, cov, J))
    np.testing.assert_allclose(
        joint_std(body, state, Covariance(cov, np.empty((n, 0)))), expected, rtol=1e-6, atol=1e-8
    )


def test_a_contact_adds_certainty():
    body, truth, points = arm_scene()
    rows = point_rows(body, truth, points, body.positions(truth, points))
    with_contact = [
        rows,
        coincidence_rows(body, truth, points.select(("r_shoulder",)), points.select(("r_dactylion",))),
    ]
    a, b = (covariance(normal_equations(body, truth, parts)).matrix for parts in (rows, with_contact))
    assert np.all(np.diag(b) <= np.diag(a) + 1e-15) and np.any(np.diag(b) < 0.9 * np.diag(a))


def test_inverses_of_small_matrices():
    random = np.random.default_rng(5)
    A = random.normal(size=(40, 30))
    H = A.T @ A + np.diag(10.0 ** random.uniform(-3, 3, 30))
    np.testing.assert_allclose(inverse(H), np.linalg.inv(H), rtol=1e-9, atol=1e-12)
    assert np.array_equal(inverse(H), inverse(H).T)
    np.testing.assert_allclose(variances(H), np.diag(np.linalg.inv(H)), rtol=1e-9)
    H[3] = H[:, 3] = 0.0  # of one nothing is known
    np.testing.assert_allclose(variances(H), np.diag(np.linalg.pinv(H)), rtol=1e-6, atol=1e-12)
