"""Errors that points of one segment share: found from residuals, and weighed as their covariance asks for."""

from dataclasses import replace

import numpy as np
import pytest

from kinefit import Recording, track
from kinefit.bodies import PointSet, load_body
from kinefit.fitting.smoothing.shared_errors import SharedErrors, members, shared_by
from kinefit.geometry.losses import SQUARED, geman_mcclure
from kinefit.sensors.channels import make_channels
from kinefit.simulation import simulate_keypoints, squat_and_wave, studio_rig
from kinefit.solving.trajectory.sequence import SeenPoints

MOTION = squat_and_wave(rate=20.0, duration=2.0)
RIG = studio_rig(MOTION)
BODY = load_body("humanoid")


@pytest.fixture(scope="module")
def channels():
    seen = simulate_keypoints(MOTION, RIG, noise_px=1.0, outliers=0.0, missing=0.0)
    return make_channels(BODY, RIG, seen, [3.0] * 4)


def test_points_of_one_segment_and_view_are_a_group(channels):
    member = members(channels)
    segment = channels.points.segments[channels.column]
    for k in np.flatnonzero(member >= 0):
        same = (channels.source == channels.source[k]) & (segment == segment[k])
        assert same.sum() > 1
        np.testing.assert_array_equal(same, member == member[k])
    alone = [channels.points.names[c] for c in channels.column[member < 0]]
    assert "LKnee" in alone and "Nose" not in alone


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7])
def test_the_share_is_found(channels, share):
    random, member = np.random.default_rng(1), members(channels)
    shape = (400, len(member), 2)
    common = random.standard_normal((400, member.max() + 1, 2))[:, member]
    left = 5.0 * (np.sqrt(1 - share) * random.standard_normal(shape) + np.sqrt(share) * common)
    left[random.random(shape[:2]) < 0.1] = np.nan
    found = shared_by(channels, left, np.zeros(shape[:2]), 1.0)
    assert np.all(found[member < 0] == 0.0)
    np.testing.assert_allclose(found[member >= 0], share, atol=0.06)
    mirrored = channels.partner[member >= 0]
    np.testing.assert_array_equal(found[mirrored], found[member >= 0])


def test_few_looks_share_what_the_others_of_their_set_share(channels):
    random, member = np.random.default_rng(2), members(channels)
    common = random.standard_normal((100, member.max() + 1, 2))[:, member]
    left = common + 0.5 * random.standard_normal(common.shape)  # 0.8 of the variance
    few = member == member[np.flatnonzero(member >= 0)[0]]
    left[1:, np.isin(channels.column, channels.column[few])] = np.nan
    found = shared_by(channels, left, np.zeros(left.shape[:2]), 1.0)
    assert found[few].min() > 0.6
    nothing = shared_by(channels, left[:1], np.zeros((1, len(member))), 1e-6)
    assert nothing.max() < 1e-3


def test_whitening_is_the_square_root_of_the_whole_covariance(channels):
    random, member = np.random.default_rng(3), members(channels)
    N = len(member)
    sigma, share = np.full(N, 4.0), np.where(member >= 0, 0.6, 0.0)
    shared = SharedErrors.of(channels, share, sigma)
    confidence = random.uniform(0.2, 1.0, N)
    own = np.square(sigma) * (1 - share) / confidence
    covariance = np.diag(own) + 0.6 * 16.0 * ((member[:, None] == member) & (member >= 0))
    channel = np.repeat(np.arange(N), 2)
    plain = random.normal(size=(2 * N, 5))
    found = shared.whitened(plain / np.sqrt(own[channel])[:, None], 1.0 / own, channel)
    expected = sum(plain[a::2].T @ np.linalg.solve(covariance, plain[a::2]) for a in (0, 1))
    np.testing.assert_allclose(found.T @ found, expected, rtol=1e-9)


@pytest.mark.parametrize("loss", [SQUARED, geman_mcclure()], ids=lambda loss: loss.kind)
def test_equations_of_points_that_are_shifted_together(channels, loss):
    """Against the derivative of the cost; with squares against the covariance of all errors as well."""
    random, member, tree = np.random.default_rng(4), members(channels), BODY.tree
    each = PointSet(
        channels.column.astype(str), channels.points.segments[channels.column], channels.points.points[channels.column]
    )
    state = MOTION.state(5)
    sigma, share = np.full(len(member), 4.0), np.where(member >= 0, 0.6, 0.0)
    shared = SharedErrors.of(channels, share, sigma)

    def seen_from(state):
        x = BODY.positions(state, each)
        return RIG.project(x, channels.camera)

    uv = seen_from(state) + 4.0 * random.standard_normal((len(member), 2))
    uv[::17] += 40.0
    weight = random.uniform(0.3, 1.0, len(member)) / (np.square(sigma) * (1 - share))
    weight[::11] = 0.0
    points = SeenPoints(
        RIG, each, channels.camera, uv[None], weight[None], loss, member=shared.member, shared=shared.variance
    )
    make = points.equations(BODY)

    def cost(delta):
        moved = state.retract(delta)
        return make(moved.T_world_root[None], moved.angles[None])[2][0]

    C, g, _ = make(state.T_world_root[None], state.angles[None])
    steps = 1e-5 * np.eye(tree.n_dofs)
    slope = np.array([(cost(d) - cost(-d)) / 2e-5 for d in steps])
    np.testing.assert_allclose(-0.5 * slope, g[0], rtol=2e-3, atol=3e-3 * np.abs(g[0]).max())
    if loss is not SQUARED:
        return
    used = weight > 0
    J = np.stack([(seen_from(state.retract(d)) - seen_from(state.retract(-d))) / 2e-5 for d in steps], axis=-1)[used]
    covariance = np.diag(1.0 / weight[used])
    same = (member[used][:, None] == member[used]) & (member[used] >= 0)
    covariance += 0.6 * 16.0 * same
    r = (uv - seen_from(state))[used]
    H = sum(J[:, a].T @ np.linalg.solve(covariance, J[:, a]) for a in (0, 1))
    expected = sum(J[:, a].T @ np.linalg.solve(covariance, r[:, a]) for a in (0, 1))
    np.testing.assert_allclose(g[0], expected, rtol=1e-4, atol=1e-6)
    found = np.zeros_like(H)
    for k in range(tree.n_dofs):
        above = tree.chain[k, : tree.depth[k] + 1]
        found[k, above] = found[above, k] = C[0, k, : tree.depth[k] + 1]
    where = found != 0
    np.testing.assert_allclose(found[where], H[where], rtol=1e-4, atol=1e-5 * np.abs(H).max())


@pytest.mark.parametrize("shared_px", [0.0, 6.0])
def test_a_take_tells_what_its_segments_share(shared_px):
    random, segments = np.random.default_rng(5), BODY.keypoints("BODY_25B")
    seen = []
    for record in simulate_keypoints(MOTION, RIG, noise_px=3.0, outliers=0.0, missing=0.0):
        shift = shared_px * random.standard_normal((len(MOTION), len(BODY.tree.segments), 2))
        column = [record.names.index(name) for name in segments.names]
        points = np.array(record.points)
        points[:, 0, column] += shift[:, segments.segments]
        seen.append(replace(record, points=points))
    motion = track(Recording.of_keypoints(RIG, seen, sigma=8.0, up=MOTION.up), BODY)
    told = motion.provenance["smoothing"]["shared_errors"]
    assert set(told) == set(RIG.names)
    for of_camera in told.values():
        assert of_camera.get("head", 0.0) < 0.2 if shared_px == 0.0 else of_camera["head"] > 0.5
