"""Single frames of unlabelled markers: the paper's bodies, their noise, what is missing, what is too much."""

import numpy as np
import pytest
from benchmarks.synthetic_points import mean_length, random_pose, synthetic_body
from hypothesis import given, settings
from hypothesis import strategies as st

from kinefit.errors import ObservationError
from kinefit.markers.frame._kernels_evidence import evidence, largest_quaternion, least_squares, rigid
from kinefit.markers.frame.identify import IdentifySettings, identify
from kinefit.markers.frame.tables import marker_sigmas, segment_tables


@pytest.fixture(scope="module")
def body():
    return synthetic_body(44)


def test_bodies_have_the_papers_counts(body):
    large = synthetic_body(49)
    assert (len(body), len(body.segments), len(large), len(large.segments)) == (44, 13, 49, 15)
    assert max(len(m) for m in body.segments) == len(body.segments[0]) == 6
    assert all(j.marker is not None for j in body.joints)


def test_posed_bodies_keep_distances_within_segments(body):
    pose = random_pose(body, np.random.default_rng(0))
    at = pose.points[pose.truth]
    for markers in body.segments:
        i = np.ix_(list(markers), list(markers))
        assert np.allclose(np.linalg.norm(at[:, None] - at, axis=-1)[i], body.mean[i], atol=1e-9)


def test_a_frame_that_runs_out_of_work_names_nothing_wrong(body):
    wrong = right = 0
    for seed in range(4):
        pose = random_pose(body, np.random.default_rng(seed), distortion=0.08, missing=0.2, extra=10)
        found = identify(body, pose.points, settings=IdentifySettings(work=2e5))
        again = identify(body, pose.points, settings=IdentifySettings(work=2e5))
        assert (found.assignment == again.assignment).all()  # work is counted, not timed
        wrong += int(((found.assignment != pose.truth) & (found.assignment >= 0)).sum())
        whole = identify(body, pose.points)
        right += int((whole.assignment == pose.truth).sum()) - int((found.assignment == pose.truth).sum())
    assert wrong <= 2 and right > 0


@pytest.mark.parametrize("n", [2, 3, 4, 8])
@pytest.mark.parametrize("flat", [1.0, 0.01, 0.0])
def test_least_squares_are_those_of_the_rigid_motion(n, flat):
    rng = np.random.default_rng(n)
    for noise in (1e-4, 0.01, 0.3):
        x, w = rng.standard_normal((n, 3)) * [0.1, 0.1 * flat, 0.1 * flat], rng.uniform(1e4, 1e6, n)
        q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        y = x @ (q * np.sign(np.linalg.det(q))).T + noise * rng.standard_normal((n, 3)) + 1.0
        H, own = np.empty((3, 3)), np.empty((3, 3))
        rss = rigid(n, x, y, w, np.empty((3, 3)), np.empty(3), own)
        assert least_squares(n, x, y, w, H) == pytest.approx(rss, rel=1e-5, abs=1e-5)
        np.testing.assert_allclose(H, own, rtol=1e-9, atol=1e-9 * own.max())


def test_distortion_is_that_of_the_paper(body):
    rng = np.random.default_rng(1)
    at = np.array([(p := random_pose(body, rng, rotation=0.0, distortion=0.1)).points[p.truth] for _ in range(300)])
    head = list(body.segments[1])[1:]
    spread = (at[:, head] - at[:, head].mean(1, keepdims=True)).std(0).mean() / np.sqrt(1 - 1 / len(head))
    assert spread == pytest.approx(0.1 * mean_length(body.reference[list(body.segments[1])]) / np.sqrt(6), rel=0.05)


@pytest.mark.parametrize("points", [44, 49])
def test_every_pose_without_noise_is_named_entirely(points):
    model, rng = synthetic_body(points), np.random.default_rng(2)
    for _ in range(40):
        pose = random_pose(model, rng)
        found = identify(model, pose.points)
        assert (found.assignment == pose.truth).all() and not found.ambiguous and found.confidence.min() > 0.99


@pytest.mark.parametrize(
    "kind", [{"distortion": 0.04}, {"extra": 20}, {"distortion": 0.04, "extra": 5}, {"missing": 0.1}]
)
def test_noise_and_counts_need_not_be_told(body, kind):
    rng = np.random.default_rng(3)
    poses = [random_pose(body, rng, **kind) for _ in range(12)]
    found = [identify(body, p.points).assignment for p in poses]
    right = np.mean([(f == p.truth)[p.truth >= 0].mean() for f, p in zip(found, poses)])
    wrong = np.mean([((f != p.truth) & (f >= 0)).mean() for f, p in zip(found, poses)])
    assert right > 0.99 and wrong < 0.004


@pytest.mark.parametrize("off", [0.05, 0.06])  # [m] along x, beyond the noise
def test_a_displaced_marker_is_less_probable_where_labels_are_absent_and_points_unrelated(body, off):
    """As many points either way: what the search found tells how many labels are not worn."""
    rng = np.random.default_rng(8)
    pose = random_pose(body, rng, distortion=0.02)
    at = pose.points[pose.truth]
    label, absent = body.segments[1][-1], [own[-1] for own in body.segments[2:8]]
    assert label not in absent
    at[label, 0] += off
    stray = at.mean(axis=0) + rng.uniform(1.0, 1.5, (7, 3))
    worn = np.setdiff1d(np.arange(len(body)), absent)
    all_worn = identify(body, np.concatenate([at, stray[:1]])).confidence[label]
    some_worn = identify(body, np.concatenate([at[worn], stray])).confidence[label]
    odds = np.array([some_worn, all_worn]) / (1 - np.array([some_worn, all_worn]))
    assert 0.5 < some_worn < all_worn and odds[0] < 0.2 * odds[1]


def test_noise_is_found(body):
    rng = np.random.default_rng(4)
    levels = [identify(body, random_pose(body, rng, distortion=d).points).scale for d in (0.0, 0.02, 0.06)]
    assert levels[0] < 0.01 and levels[2] / levels[1] == pytest.approx(3.0, rel=0.4)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31))
def test_neither_order_nor_place_matter(body, seed):
    rng = np.random.default_rng(seed)
    pose = random_pose(body, rng, distortion=0.02)
    order, turn = rng.permutation(len(pose.points)), np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    a = identify(body, pose.points).assignment
    b = identify(body, (pose.points @ turn.T + rng.uniform(-9, 9, 3))[order]).assignment
    named = (a >= 0) & (b >= 0)
    assert (order[b[named]] == a[named]).all() and named.mean() > 0.9


def test_no_point_has_two_names(body):
    rng = np.random.default_rng(5)
    for _ in range(6):
        found = identify(body, random_pose(body, rng, distortion=0.1, missing=0.1, extra=20).points).assignment
        named = found[found >= 0]
        assert len(set(named)) == len(named)


def test_random_points_get_no_names(body):
    rng = np.random.default_rng(6)
    found = [identify(body, rng.uniform(-1, 1, (20, 3))).assignment for _ in range(3)]
    assert np.mean([(f >= 0).mean() for f in found]) < 0.1


def test_a_mirrored_body_is_not_taken_for_the_body(body):
    pose = random_pose(body, np.random.default_rng(7))
    found = identify(body, pose.points * [1, 1, -1])
    assert not ((found.assignment == pose.truth) & (pose.truth >= 0)).all()


@pytest.mark.parametrize("points", [np.zeros((4, 2)), np.full((5, 3), np.nan), np.zeros(3)])
def test_bad_points_are_refused(body, points):
    with pytest.raises(ObservationError):
        identify(body, points)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 5])
def test_few_points(body, count):
    found = identify(body, np.random.default_rng(8).uniform(-1, 1, (count, 3)))
    assert found.assignment.shape == (44,) and np.isfinite(found.confidence).all()


def test_rigid_fit_agrees_with_svd():
    rng = np.random.default_rng(9)
    for n in (3, 4, 7):
        x, y, w = rng.standard_normal((n, 3)), rng.standard_normal((n, 3)), rng.uniform(0.5, 2, n)
        R, t, H = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
        rss = rigid(n, x, y, w, R, t, H)
        a, b = (w[:, None] * x).sum(0) / w.sum(), (w[:, None] * y).sum(0) / w.sum()
        u, _, vt = np.linalg.svd((w[:, None] * (x - a)).T @ (y - b))
        best = vt.T @ np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
        assert np.allclose(R, best) and np.isclose(rss, (w[:, None] * (y - b - (x - a) @ best.T) ** 2).sum())
        assert np.allclose(H, sum(v * (d @ d * np.eye(3) - np.outer(d, d)) for v, d in zip(w, x - a)))


def test_largest_eigenvector():
    N = np.random.default_rng(10).standard_normal((4, 4))
    N += N.T
    q = np.empty(4)
    largest_quaternion(N.copy(), q)
    assert np.isclose(abs(q @ np.linalg.eigh(N)[1][:, -1]), 1.0)


def test_evidence_is_the_integral_over_all_poses():
    """Against an average over random rotations, the translation integrated in closed form."""
    rng = np.random.default_rng(11)
    x, sigma = np.array([[0.0, 0, 0], [0.3, 0, 0], [0.0, 0.2, 0.1]]), 0.03
    y = x + sigma * rng.standard_normal(x.shape)
    q = rng.standard_normal((400_000, 4))
    w, i, j, k = (q / np.linalg.norm(q, axis=1)[:, None]).T
    R = np.array([[1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)],
                  [2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)],
                  [2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)]]).transpose(2, 0, 1)  # fmt: skip
    e = (y - y.mean(0)) - np.einsum("nij,kj->nki", R, x - x.mean(0))
    log = -0.5 * (e**2).sum((1, 2)) / sigma**2 - 3 * np.log(2 * np.pi * sigma**2) - 1.5 * np.log(3.0)
    cost, _ = evidence(3, x, y, np.full(3, sigma), np.empty((10, 3)))
    assert cost == pytest.approx(-np.log(np.exp(log).mean()), abs=0.25)


def test_tables_hang_from_any_segment(body):
    for root in range(len(body.segments)):
        tables = segment_tables(body, root)
        assert tables[0].index == root and sorted(t.index for t in tables) == list(range(13))
        assert all(t.parent in {u.index for u in tables[:n]} for n, t in enumerate(tables) if n)


def test_deviations_of_distances_are_split():
    s = np.array([0.002, 0.003, 0.004, 0.005])
    assert np.allclose(marker_sigmas(np.sqrt(s[:, None] ** 2 + s**2)), s)
