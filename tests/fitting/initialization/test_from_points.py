"""A start with no pose given: points in space, bone lengths, a pose."""

from dataclasses import replace

import numpy as np
import pytest
from tests.oracle import posture, rig_around

from kinefit.bodies import BodyState, load_body
from kinefit.bodies.limbs import rigid_pairs
from kinefit.errors import TrackingError
from kinefit.fitting.initialization.from_points import aligned_root, first_scales, pose_from_points
from kinefit.geometry import se3
from kinefit.observations import Keypoints
from kinefit.sensors.channels import make_channels
from kinefit.sensors.points.views import triangulated, triangulated_frame

BODY = load_body("humanoid")
SET = "BODY_25B"
POINTS = BODY.keypoints(SET)
RIG = rig_around((0.0, 0.0, 0.0))


def near_origin(seed, share=0.3):
    state = posture(BODY, seed, share)
    T = np.array(state.T_world_root)
    T[:3, 3] *= 0.2
    return BodyState(T, state.angles)


def channels_of(x, noise=0.0, seed=0, spoil=None):
    """Channels of points (F, K, 3) [m] in all cameras; `spoil` changes (camera, uv (F, K, 2))."""
    random, records = np.random.default_rng(seed), []
    for c, camera in enumerate(RIG):
        uv = camera.project(x) + noise * random.normal(size=(*x.shape[:2], 2))
        uv = spoil(c, uv) if spoil else uv
        records.append(Keypoints(camera.name, SET, POINTS.names, 25.0, uv[:, None], np.ones((len(x), 1, len(POINTS)))))
    return make_channels(BODY, RIG, records, [8.0] * len(RIG))


FRAMES = np.stack([BODY.positions(near_origin(k), POINTS) for k in range(6)])


def test_exact_pixels_give_the_points():
    channels = channels_of(FRAMES)
    np.testing.assert_allclose(triangulated(channels, np.arange(6)), FRAMES, atol=1e-6)
    x, swapped = triangulated_frame(channels, channels.uv[2], channels.confidence[2])
    np.testing.assert_allclose(x, FRAMES[2], atol=1e-6)
    assert not swapped.any()


def test_a_point_that_only_one_camera_sees_is_unknown():
    def spoil(camera, uv):
        uv[:, 4] = np.nan if camera else uv[:, 4]
        return uv

    x = triangulated(channels_of(FRAMES, spoil=spoil), np.arange(6))
    assert np.all(np.isnan(x[:, 4])) and np.all(np.isfinite(np.delete(x, 4, axis=1)))


def test_a_wild_point_in_one_camera_does_not_pull():
    def spoil(camera, uv):
        uv[:, 7] += 200.0 * (camera == 1)
        return uv

    x = triangulated(channels_of(FRAMES, spoil=spoil), np.arange(6))
    np.testing.assert_allclose(x, FRAMES, atol=1e-6)


@pytest.mark.parametrize(
    "frames",
    [
        (1, 2, 4, 5),
        (0, 3),
    ],
    ids=["far apart", "40 px apart"],
)
def test_exchanged_sides_of_one_camera_are_found(frames):
    """Noise is 2 px; left and right are 40 to 100 px apart in the pictures."""
    clean = channels_of(FRAMES, noise=2.0)
    for camera, f in [(c, f) for c in range(4) for f in frames]:
        mine = clean.camera == camera
        uv = np.where(mine[:, None], clean.uv[f][clean.partner], clean.uv[f])
        x, swapped = triangulated_frame(clean, uv, clean.confidence[f])
        expected, _ = triangulated_frame(clean, clean.uv[f], clean.confidence[f])
        assert list(np.flatnonzero(swapped)) == [camera]
        np.testing.assert_allclose(x, expected, atol=1e-9)


def test_bones_are_pairs_of_points_that_no_angle_moves_apart():
    states = [near_origin(k, 0.6) for k in range(5)]
    x = np.stack([BODY.positions(s, POINTS) for s in states])
    pairs = rigid_pairs(BODY, POINTS)
    for i, j, _, length in pairs:
        np.testing.assert_allclose(np.linalg.norm(x[:, i] - x[:, j], axis=1), length, atol=1e-9)
    named = {frozenset((POINTS.names[i], POINTS.names[j])): BODY.scale_groups[g] for i, j, g, _ in pairs}
    assert named[frozenset(("LHip", "LKnee"))] == "thigh" and named[frozenset(("RElbow", "RWrist"))] == "forearm"
    assert frozenset(("LHip", "LAnkle")) not in named


@pytest.mark.parametrize("seed", range(3))
def test_first_scales_of_a_known_person(seed):
    scales = np.random.default_rng(seed).uniform(0.85, 1.2, len(BODY.scale_groups))
    person = BODY.scaled(scales)
    x = np.stack([person.positions(near_origin(k), person.keypoints(SET)) for k in range(6)])
    x[:, 3] = np.nan
    x[2:4, 8:12] = np.nan
    found = first_scales(BODY, POINTS, x)
    measured = sorted({g for _, _, g, _ in rigid_pairs(BODY, POINTS)})
    limbs = [BODY.scale_groups.index(n) for n in ("thigh", "shank", "upperarm", "forearm", "foot")]
    assert set(limbs) <= set(measured)
    np.testing.assert_allclose(found[limbs], scales[limbs], rtol=1e-6)
    noisy = x + np.random.default_rng(0).normal(scale=0.01, size=x.shape)
    np.testing.assert_allclose(first_scales(BODY, POINTS, noisy)[limbs], scales[limbs], rtol=0.08)


def test_lengths_that_nothing_measures_follow_the_others_or_the_height():
    person = BODY.scaled(np.full(len(BODY.scale_groups), 1.1))
    x = np.stack([person.positions(near_origin(k), person.keypoints(SET)) for k in range(3)])
    group = BODY.scale_groups.index("hand")
    assert group not in {g for _, _, g, _ in rigid_pairs(BODY, POINTS)}
    assert first_scales(BODY, POINTS, x)[group] == pytest.approx(1.1, rel=1e-3)
    assert first_scales(BODY, POINTS, x, height=0.95 * BODY.stature)[group] == pytest.approx(0.95, rel=1e-6)


def test_scales_that_cannot_be_are_told():
    with pytest.raises(TrackingError, match=r"no bone.*calibration"):
        first_scales(BODY, POINTS, np.full((2, len(POINTS), 3), np.nan))
    with pytest.raises(TrackingError, match=r'1000 times.*unit = "mm"'):
        first_scales(BODY, POINTS, 1000 * FRAMES)


@pytest.mark.parametrize("heading", np.radians([0, 45, 90, 135, 180, 225, 270, 315]))
def test_the_resting_body_is_laid_on_its_points_whatever_the_heading(heading):
    truth = BODY.default_state(se3.transform(se3.exp_so3([0.0, heading, 0.0]), [0.5, 0.2, -1.0]))
    T = aligned_root(BODY, POINTS, BODY.positions(truth, POINTS))
    turn = se3.log_so3(T[:3, :3] @ truth.T_world_root[:3, :3].T)
    assert np.linalg.norm(turn) < np.radians(15) and np.linalg.norm(T[:3, 3] - truth.T_world_root[:3, 3]) < 0.1


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("seed", range(12))
def test_a_posture_is_found_from_its_points_alone(seed, up):
    """Any heading, any place, in worlds that stand on y and on z; 10 mm of noise and a few points missing."""
    random, state = np.random.default_rng(seed), posture(BODY, seed, 0.3)
    world = np.eye(4) if up == "y" else se3.exp([0, 0, 0, np.pi / 2, 0, 0])
    truth = BodyState(world @ state.T_world_root, state.angles)
    x = BODY.positions(truth, POINTS)
    measured = x + 0.01 * random.normal(size=x.shape)
    measured[random.permutation(len(x))[:4]] = np.nan
    found, left = pose_from_points(BODY, POINTS, measured)
    assert left < 0.03
    off = np.linalg.norm(BODY.positions(found, POINTS) - x, axis=1)
    known = np.isfinite(measured).all(axis=1)
    assert np.median(off) < 0.02 and off[known].max() < 0.05
    assert np.all(found.angles >= BODY.tree.lower) and np.all(found.angles <= BODY.tree.upper)


def test_a_wild_point_does_not_spoil_the_pose():
    truth = posture(BODY, 3, 0.3)
    x = BODY.positions(truth, POINTS)
    spoilt = x.copy()
    spoilt[[4, 15]] += (0.8, -0.5, 0.6)
    found, _ = pose_from_points(BODY, POINTS, spoilt)
    off = np.linalg.norm(BODY.positions(found, POINTS) - x, axis=1)
    assert np.median(off) < 0.02


def test_a_fixed_root_is_put_where_its_points_are():
    truth = posture(BODY, 4, 0.3)
    standing = replace(BODY, tree=replace(BODY.tree, root_free=False))
    x = BODY.positions(truth, POINTS)
    found, left = pose_from_points(standing, POINTS, x)
    free, _ = pose_from_points(BODY, POINTS, x)
    assert left < 0.02 and np.linalg.norm(truth.difference(found)[:3]) < 0.03
    assert np.allclose(found.T_world_root, free.T_world_root) and np.allclose(found.angles, free.angles)


def test_a_start_that_is_known():
    truth = posture(BODY, 5, 0.3)
    near = truth.retract(np.full(47, 0.02))
    found, left = pose_from_points(BODY, POINTS, BODY.positions(truth, POINTS), near=near)
    assert left < 0.02 and np.linalg.norm(truth.difference(found)[:3]) < 0.03


def test_too_few_points_are_told():
    x = np.full((len(POINTS), 3), np.nan)
    x[:5] = FRAMES[0, :5]
    with pytest.raises(TrackingError, match="fewer than six points"):
        pose_from_points(BODY, POINTS, x)
